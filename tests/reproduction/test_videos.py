"""The published scenes: rules on simulated films; notebook 12 asserts what the real ones show."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import xarray as xr
from hostile_files import coloured, video, wave

from reproduction import uncalibrated
from reproduction import videos as published

Floats = npt.NDArray[np.float64]


def test_inputs(tmp_path: Path) -> None:
    """Both bands come as uncalibrated pictures; bands that differ or are missing are refused."""
    bands = {"toy-0-bg.mp4": 64, "toy-1-bg.mp4": 64, "odd-0-bg.mp4": 64, "odd-1-bg.mp4": 32}
    frames = {name: coloured(wave()[:6, :, :width], "plasma") for name, width in bands.items()}
    toy = {name: video(tmp_path / name, movie) for name, movie in frames.items()}
    movie = published.inputs(toy, "toy")
    assert dict(movie.sizes) == {"band": 2, "time": 6, "y": 48, "x": 64}
    assert movie["band"].values.tolist() == ["8-14", "9.5"]
    np.testing.assert_allclose(movie["time"], np.arange(6) / 10, rtol=0, atol=1e-9)  # s
    assert (movie.attrs["radiometric"], movie.attrs["scene"]) == (0, "toy")
    assert max(movie.attrs["palette_residual"]) < 10  # of 255
    np.testing.assert_array_equal(movie[0], movie[1])  # the same wave was filmed
    with pytest.raises(ValueError, match=r"Invalid shapes \(6, 48, 64\), \(6, 48, 32\) of scene"):
        published.inputs(toy, "odd")
    with pytest.raises(FileNotFoundError, match=r"Missing video 'plate-0-bg.mp4'. .*toy-0-bg.mp4"):
        published.inputs(toy, "plate")


FRAMES, HEIGHT, WIDTH = 120, 72, 112
OUTLINE = np.hypot(np.arange(HEIGHT)[:, np.newaxis] - 36, np.arange(WIDTH) - 60) < 30
BALL = xr.DataArray(OUTLINE, dims=("y", "x"))
DOWN, RIGHT = 0.6, 4.3  # pixel


def stage(seed: int, apart: tuple[float, float] = (DOWN, RIGHT)) -> tuple[Floats, Floats]:
    """A simulated scene (band, time, y, x) [K] of a warming ball before a wall, and its reflection.

    People walk in the ball's mirror; the second band shows them at p where the first does at p + d.
    The reflection (time, y, x) is the second band's, in the first band's unit.
    """
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    wall = 293 + 2 * np.sin(x / 9) * np.cos(y / 11)
    ball = 300 + 6 * np.cos(x / 15) + 4 * np.sin(y / 10)
    time = np.arange(FRAMES)[:, np.newaxis, np.newaxis]
    walks = [(rng.uniform(30, 90), rng.uniform(20, 52), rng.uniform(-1.2, 1.2)) for _ in range(6)]

    def people(down: float, right: float) -> Floats:
        total = np.zeros((FRAMES, HEIGHT, WIDTH))
        for start, height, speed in walks:
            place = start + speed * (time - 60) - right
            total += np.exp(-(((x - place) / 4) ** 2) - ((y + down - height) / 7) ** 2)
        return np.asarray(4.0 * total * OUTLINE)

    # Shown at p by the second band is what the first shows at p + d.
    warm = np.where(OUTLINE, ball + 30 * time / FRAMES, wall)
    reflection = people(*apart)
    return np.stack([warm + people(0.0, 0.0), warm + 2.0 * reflection]), reflection


def shown(scene: Floats, seed: int = 0) -> Floats:
    """Positions in a palette (band, time, y, x), between the extremes of each frame, with noise."""
    low, high = (part(scene, axis=(2, 3), keepdims=True) for part in (np.min, np.max))
    noise = 0.004 * np.random.default_rng(seed).standard_normal(scene.shape)
    return np.asarray(np.clip((scene - low) / (high - low) + noise, 0, 1))


def labelled(movie: Floats) -> xr.DataArray:
    """Movie (band, time, y, x) with its coordinates."""
    coords = {"band": ["8-14", "9.5"], "time": np.arange(movie.shape[1]) / 10}
    return xr.DataArray(movie, coords, ("band", "time", "y", "x"))


@pytest.mark.parametrize("apart", [(0.0, 0.0), (-1.4, -9.7)])
def test_displacement_of_the_reflections(apart: tuple[float, float]) -> None:
    """It is right to 0.3 pixel, whatever the still edges say, and undone there is none."""
    scene, _ = stage(3, apart)
    undone = uncalibrated.unscaled(labelled(shown(scene)), published.still(BALL))
    found = uncalibrated.reflections_shift(undone, BALL)
    np.testing.assert_allclose(found, apart, rtol=0, atol=0.3)
    np.testing.assert_allclose(uncalibrated.edges_shift(undone), 0, rtol=0, atol=0.2)
    both = uncalibrated.moved(undone, found)
    assert uncalibrated.reflections_shift(both, BALL).values == pytest.approx(0, abs=0.3)


def test_unknown_displacement() -> None:
    """One beyond the search is not known: nothing can be moved by it."""
    noise = np.random.default_rng(2).standard_normal((2, 40, 60, 90))
    noise[1] = np.roll(noise[0], -60, axis=2)
    everywhere = xr.DataArray(np.ones((60, 90), bool), dims=("y", "x"))
    found = uncalibrated.reflections_shift(labelled(noise), everywhere)
    unknown = found * np.nan
    with pytest.raises(ValueError, match="Unknown displacement of the reflections"):
        uncalibrated.moved(labelled(noise), unknown)
    assert uncalibrated.shared_outline(everywhere, unknown).all()


def test_scene_of_fewer_results(tmp_path: Path) -> None:
    """Videos whose results show fewer frames are read, compared in two ways, and reported."""
    scene, reflection = stage(5)
    movies = shown(scene)
    paths = {f"toy-{n}-bg.mp4": coloured(movies[n], "plasma") for n in (0, 1)}
    theirs = np.abs(reflection - reflection.mean(axis=0))[20:110]
    theirs = np.clip(theirs / theirs.max(axis=(1, 2), keepdims=True), 0.05, 1)
    drawn = np.where(OUTLINE[..., np.newaxis], coloured(theirs, "turbo"), np.uint8(60))
    paths |= {f"toys_{kind}_Tbdiff_video.mp4": drawn for kind in published.KINDS}
    files = {name: video(tmp_path / name, frames) for name, frames in paths.items()}
    read = published.scene(files, "toy", "toys")
    assert (read.first, read.movie.sizes["time"]) == (20, 90)
    assert read.margin > 3
    with pytest.raises(ValueError, match=r"Invalid results of \(90, 72, 112\).*\(80, 72, 112\)"):
        published.first_frame(read.movie[:, :80], read.theirs["uncalib"]["value"], read.outline)
    assert float((read.outline == OUTLINE).mean()) > 0.98
    compared, left_out = published.compare_all({"toy": read}, 20)
    assert left_out == {}
    found, text = compared["toy"], published.report(compared)
    assert found.undone.attrs["scale_undone"] == ["8-14", "9.5"]
    np.testing.assert_allclose(found.reflections, [DOWN, RIGHT], rtol=0, atol=0.3)
    # Bands as far apart as the people are wide share too little until that is undone.
    assert {*found.left_out} == {"scale undone"}
    assert float(found.table.sel(way="both undone", map="uncalib", pixels="object")) > 0.6
    assert "| toy | both undone | 0." in text
    assert "scale undone left out: Invalid signal" in text


def test_scene_that_cannot_be_separated_is_left_out() -> None:
    """Nothing moves: the scene is left out, and said why."""
    scene, _ = stage(6)
    still = labelled(shown(np.repeat(scene[:, :1], 40, axis=1)))
    theirs = xr.Dataset({"value": still[0], "valid": xr.ones_like(still[0], dtype=bool)})
    read = published.Scene(still, dict.fromkeys(published.KINDS, theirs), BALL, 0, np.inf)
    compared, left_out = published.compare_all({"toy": read}, 10)
    assert compared == {}
    assert "pixels have a correlation above 0.5" in left_out["toy"]


def test_agreement() -> None:
    """The strongest frames are compared; unit and sign of our growing reflection do not matter."""
    time, y, x = np.ogrid[:10, :30, :60]
    ours = xr.DataArray(
        (time + 1) * np.sin((x + 5 * time) / 9) * np.cos(y / 11),
        dims=("time", "y", "x"),
        coords={"time": np.arange(10.0)},
    )
    value = 0.01 * abs(ours)
    value[9] = -value[9]
    theirs = xr.Dataset({"value": value, "valid": xr.ones_like(ours, dtype=bool)})
    theirs["valid"][:, :8] = False
    inside = xr.DataArray(np.arange(60) >= 4, dims="x").expand_dims(y=30)
    ours[4, :8] = 1e3  # outside the authors' map: no score
    frames = published.strongest(ours, theirs["valid"][0], 3)
    np.testing.assert_array_equal(frames, [7, 8, 9])
    found = published.agreement(ours, theirs, frames, inside)
    np.testing.assert_allclose(found, [1.0, 1.0, -1.0], rtol=0, atol=0.01)
    again = published.agreement(-5 * ours, theirs, frames, inside)
    np.testing.assert_allclose(again, found, rtol=0, atol=1e-9)
    with pytest.raises(ValueError, match=r"Invalid shape \(10, 30, 60\) .* Must be \(9, 30, 60\)"):
        published.agreement(ours[1:], theirs, np.arange(3), inside)
    with pytest.raises(ValueError, match="Constant or unknown map"):
        published.agreement(0 * ours, theirs, frames, inside)
