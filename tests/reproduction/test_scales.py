"""Pictures scaled anew in each frame, and their reflections: simulated, with known uncalibrated."""

from functools import partial

import numpy as np
import pytest
import xarray as xr
from captures import polynomials
from numpy.typing import NDArray
from refused import assert_refused, refused

from reproduction import uncalibrated

Floats = NDArray[np.float64]
FRAMES, HEIGHT, WIDTH = 200, 40, 60
TIME = np.arange(FRAMES) / 10.0  # s
RATIO = 2.0
NOISE = np.array([0.004, 0.005])
STILL = np.broadcast_to(np.arange(WIDTH) >= 30, (HEIGHT, WIDTH))
WALL = xr.DataArray(STILL, dims=("y", "x"))  # pixels off the object


def scene(rng: np.random.Generator, *, walkers: bool = False) -> tuple[Floats, Floats]:
    """Scene in two bands (band, time, y, x) [K] beside its reflection (time, y, x) in the first.

    The object, left, heats by 50 K in its middle and mirrors passers-by in its lower half; the wall
    beside it is still, but for a person who walks before a third of it.
    """
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    wall = 293.0 + 3.0 * np.sin(x / 7) * np.cos(y / 9)
    heat = 50.0 * np.exp(-((x - 15) ** 2 + (y - 20) ** 2) / 100) * ~STILL
    object_part = wall + heat * (TIME / TIME[-1])[:, np.newaxis, np.newaxis] ** 1.5
    since = TIME[:, np.newaxis, np.newaxis] - rng.uniform(0, 18, (5, 1, 1, WIDTH)) - y / 40
    passing = ((since > 0) & (since < 1.5)).sum(axis=0) * 1.0
    reflection = passing * (~STILL & (y >= 20))
    if walkers:
        object_part = object_part + 8.0 * passing * (x >= 50)
    return np.stack([object_part + reflection, object_part + RATIO * reflection]), reflection


def labelled(values: Floats, **attrs: object) -> xr.DataArray:
    """Two bands (band, time, y, x) with their coordinates."""
    coords = {"band": ["8-14", "9.5"], "time": TIME}
    return xr.DataArray(values, coords, ("band", "time", "y", "x"), attrs=attrs)


def picture(scene: Floats, rng: np.random.Generator, *, between: bool = True) -> xr.DataArray:
    """Picture of 8 bit, between the extremes of each frame or of all, with noise of one step."""
    axes = (2, 3) if between else (1, 2, 3)
    low, high = (part(scene, axis=axes, keepdims=True) for part in (np.min, np.max))
    shown = (scene - low) / (high - low) + rng.normal(0, 1 / 255, scene.shape)
    return labelled(np.rint(255 * shown) / 255)


@pytest.mark.parametrize("walkers", [False, True])
def test_scale_is_undone(walkers: bool) -> None:
    """Each frame's gain is the true one within 2 %, with people before a third of the wall, too."""
    rng = np.random.default_rng(5)
    truth, _ = scene(rng, walkers=walkers)
    undone = uncalibrated.unscaled(picture(truth, rng), WALL)
    gain = 1 / np.ptp(truth, axis=(2, 3))
    gain /= gain.mean(axis=1, keepdims=True)
    error = undone["gain"].values / gain - 1
    assert undone.attrs["scale_undone"] == ["8-14", "9.5"]
    assert min(undone.attrs["scale_explained"]) > 0.97
    assert np.sqrt(np.mean(error**2)) < 0.02
    wall = undone[:, :, :, 30:50]
    moved = wall.mean(("y", "x")).std("time") / wall.mean("time").std(("y", "x"))
    assert float(moved.max()) < 0.02  # of its contrast


def test_reflection_of_a_scaled_picture() -> None:
    """The reflection is that of the scene where the scale is undone, else there is none."""
    rng = np.random.default_rng(6)
    truth, reflection = scene(rng)
    shown = picture(truth, rng)
    assert_refused("pixels have a correlation below", uncalibrated.uncalibrated_reflection, shown)
    found = uncalibrated.uncalibrated_reflection(uncalibrated.unscaled(shown, WALL))
    functions = polynomials(TIME, found.attrs["order"])
    both = found["reflection"].values, reflection
    rapid = [part[:, 20:, :30].reshape(FRAMES, -1) for part in both]
    rapid = [part - functions @ (functions.T @ part) for part in rapid]
    agreement = float(np.corrcoef(rapid[0].ravel(), rapid[1].ravel())[0, 1])
    assert found.attrs["pooled_ratio"] == pytest.approx(RATIO, rel=0.1)
    assert agreement > 0.8


def test_constant_scale_is_left() -> None:
    """A scale that is the same in all frames explains nothing, and no value is changed."""
    rng = np.random.default_rng(7)
    shown = picture(scene(rng)[0], rng, between=False)
    undone = uncalibrated.unscaled(shown, WALL)
    assert undone.attrs["scale_undone"] == []
    assert max(undone.attrs["scale_explained"]) < 0.5
    np.testing.assert_array_equal(undone, shown)
    assert float(abs(undone["gain"] - 1).max()) == 0.0


def pulses() -> Floats:
    """Reflection in the left half, in the first band's unit (time, y, x)."""
    rng = np.random.default_rng(4)
    start = rng.uniform(0.0, 18.0, (6, 1, HEIGHT, WIDTH))
    since = TIME[:, np.newaxis, np.newaxis] - start
    inside = (since > 0) & (since < 1.5)
    return np.asarray(0.03 * inside.sum(axis=0) * (np.arange(WIDTH) < WIDTH // 2))


def movie(scaling: float = 0.0) -> xr.DataArray:
    """Two bands of a warming object that reflects in its left half, each frame scaled anew."""
    rng = np.random.default_rng(8)
    profile = 0.3 + 0.2 * np.sin(np.arange(HEIGHT) / 4)[:, np.newaxis] * np.ones(WIDTH)
    emission = profile * (1 + 0.5 * np.sqrt(TIME / 20 + 0.1))[:, np.newaxis, np.newaxis]
    bands = []
    for ratio, noise in zip((1.0, RATIO), NOISE, strict=True):
        clean = emission + ratio * pulses()
        gain, offset = scaling * rng.standard_normal((2, FRAMES, 1, 1))
        bands.append((1 + gain) * clean + offset + noise * rng.standard_normal(clean.shape))
    return labelled(np.stack(bands), units="1", radiometric=0)


@pytest.fixture(scope="module")
def signal() -> xr.DataArray:
    """Movie whose frames' gains and offsets are off by 0.002."""
    return movie(0.002)


@pytest.fixture(scope="module")
def parts(signal: xr.DataArray) -> xr.Dataset:
    """Emission and reflection of the movie."""
    return uncalibrated.uncalibrated_reflection(signal)


def test_ratio_and_noise(parts: xr.Dataset) -> None:
    """The ratio within 3 %, the noises' within 5 %; only reflecting pixels correlate."""
    for attrs in (parts.attrs, uncalibrated.uncalibrated_reflection(movie()).attrs):
        assert attrs["pooled_ratio"] == pytest.approx(RATIO, rel=0.03)
        assert attrs["noise_ratio"] == pytest.approx((NOISE[1] / NOISE[0]) ** 2, rel=0.05)
        assert attrs["correlated_pixels"] == HEIGHT * WIDTH // 2
    left = {"x": slice(WIDTH // 2)}
    ratio = parts["ratio"].isel(left)
    assert float(ratio.mean()) == pytest.approx(RATIO, rel=0.02)
    assert float(ratio.std()) < 0.1
    assert float(parts["correlation"].isel(left).min()) > 0.8
    assert float(abs(parts["correlation"].isel(x=slice(WIDTH // 2, None))).max()) < 0.35


def test_reflection_is_the_true_one(signal: xr.DataArray, parts: xr.Dataset) -> None:
    """Its error is the best linear estimate's; with the emission it adds up to the band."""
    total = parts["emission"].astype(float) + parts["reflection"].astype(float)
    np.testing.assert_allclose(total, signal[0], rtol=0, atol=1e-7)
    assert parts["emission"].dtype == parts["reflection"].dtype == np.float32
    functions = polynomials(TIME, parts.attrs["order"])
    true = pulses().reshape(FRAMES, -1)
    true -= functions @ (functions.T @ true)
    error = parts["reflection"].values.reshape(FRAMES, -1) - true
    noise = (NOISE[0] ** -2 + RATIO**2 * NOISE[1] ** -2) ** -0.5
    assert float(np.sqrt(np.mean(error**2))) == pytest.approx(noise, rel=0.1)
    assert float(np.std(true)) > 3 * noise


def scaled(movie: xr.DataArray, gain: float) -> xr.DataArray:
    """Movie whose frames have a gain."""
    return movie.assign_coords(gain=(("band", "time"), np.full((2, FRAMES), gain)))


GAIN = "Invalid gain .* of a frame. Must be finite and > 0"
FEW = "Invalid still pixels: 0 of them. Must be at least 200"


test_refused_signal = refused(
    lambda signal, change: uncalibrated.uncalibrated_reflection(change(signal)),
    [
        (lambda it: it.isel(band=[0]), "Invalid signal {'band': 1"),
        (lambda it: it.isel(band=[0, 1, 1]), "Must be (band, time, y, x) of two bands"),
        (lambda it: it.transpose("time", "band", "y", "x"), "Must be (band, time, y, x)"),
        (lambda it: it.where(it["time"] > 0), "Invalid signal: NaN or infinite"),
        (lambda it: it[:, :8], "Invalid order 9 of the smooth subspace"),
        (lambda it: it[..., :30], "correlation below 0.1 in magnitude. Must be at least 100"),
        (lambda it: it[..., 30:], "0 pixels have a correlation above 0.5"),
        *((partial(scaled, gain=it), GAIN) for it in (0.0, -1.0, np.nan)),
        (lambda it: uncalibrated.unscaled(it, WALL & False), FEW),
        (lambda it: uncalibrated.unscaled(it, WALL[:, :5] | True), "the still pixels"),
    ],
    "signal",
)
