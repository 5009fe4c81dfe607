"""Scale of a picture's frames, undone from still surroundings: simulated, with known scales."""

import re

import numpy as np
import pytest
import xarray as xr
from captures import polynomials
from numpy.typing import NDArray

from dbthermal import separation
from reproduction import scales

Floats = NDArray[np.float64]
FRAMES, HEIGHT, WIDTH = 200, 40, 60
TIME = np.arange(FRAMES) / 10.0  # s
RATIO = 2.0
STILL = np.broadcast_to(np.arange(WIDTH) >= 30, (HEIGHT, WIDTH))


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


def picture(scene: Floats, rng: np.random.Generator, *, between: bool = True) -> xr.DataArray:
    """Picture of 8 bit, between the extremes of each frame or of all, with noise of one step."""
    axes = (2, 3) if between else (1, 2, 3)
    low, high = (part(scene, axis=axes, keepdims=True) for part in (np.min, np.max))
    shown = (scene - low) / (high - low) + rng.normal(0, 1 / 255, scene.shape)
    return xr.DataArray(
        np.rint(255 * shown) / 255,
        dims=("band", "time", "y", "x"),
        coords={"band": ["8-14", "9.5"], "time": TIME},
    )


def still() -> xr.DataArray:
    """Pixels off the object."""
    return xr.DataArray(STILL, dims=("y", "x"))


@pytest.mark.parametrize("walkers", [False, True])
def test_scale_is_undone(walkers: bool) -> None:
    """Each frame's gain is the true one within 2 %, with people before a third of the wall, too."""
    rng = np.random.default_rng(5)
    truth, _ = scene(rng, walkers=walkers)
    undone = scales.unscaled(picture(truth, rng), still())
    gain = 1 / np.ptp(truth, axis=(2, 3))
    gain /= gain.mean(axis=1, keepdims=True)
    error = undone["gain"].values / gain - 1
    print(f"people {walkers}: gains from {gain.min():.2f} to {gain.max():.2f}, {error.std():.4f}")
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
    with pytest.raises(ValueError, match="pixels have a correlation below"):
        separation.uncalibrated_reflection(shown)  # for its scale moves all of them together
    found = separation.uncalibrated_reflection(scales.unscaled(shown, still()))
    functions = polynomials(TIME, found.attrs["order"])
    both = found["reflection"].values, reflection
    rapid = [part[:, 20:, :30].reshape(FRAMES, -1) for part in both]
    rapid = [part - functions @ (functions.T @ part) for part in rapid]
    agreement = float(np.corrcoef(rapid[0].ravel(), rapid[1].ravel())[0, 1])
    print(f"ratio {found.attrs['pooled_ratio']:.2f}, correlation {agreement:.2f}")
    assert found.attrs["pooled_ratio"] == pytest.approx(RATIO, rel=0.1)
    assert agreement > 0.8


def test_constant_scale_is_left() -> None:
    """A scale that is the same in all frames explains nothing, and no value is changed."""
    rng = np.random.default_rng(7)
    shown = picture(scene(rng)[0], rng, between=False)
    undone = scales.unscaled(shown, still())
    assert undone.attrs["scale_undone"] == []
    assert max(undone.attrs["scale_explained"]) < 0.5
    np.testing.assert_array_equal(undone, shown)
    assert float(abs(undone["gain"] - 1).max()) == 0.0


@pytest.mark.parametrize(
    ("pixels", "message"),
    [
        (np.zeros((HEIGHT, WIDTH), bool), "Invalid still pixels: 0 of them. Must be at least 200"),
        (np.ones((HEIGHT, 5), bool), "the still pixels"),
    ],
)
def test_refused_still_pixels(pixels: NDArray[np.bool_], message: str) -> None:
    """Too few still pixels, or those of another picture, raise an error."""
    rng = np.random.default_rng(9)
    shown = picture(scene(rng)[0], rng)
    with pytest.raises(ValueError, match=re.escape(message)):
        scales.unscaled(shown, xr.DataArray(pixels, dims=("y", "x")))


@pytest.mark.parametrize("gain", [0.0, -1.0, np.nan])
def test_refused_gain(gain: float) -> None:
    """A gain that is not positive raises an error."""
    rng = np.random.default_rng(9)
    shown = picture(scene(rng)[0], rng)
    shown = shown.assign_coords(gain=(("band", "time"), np.full((2, FRAMES), gain)))
    with pytest.raises(ValueError, match=r"Invalid gain .* of a frame. Must be finite and > 0"):
        separation.uncalibrated_reflection(shown)
