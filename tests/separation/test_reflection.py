"""Reflections as pictures: simulated movies with known ratio, noise and scaling, and a result."""

import re
from collections.abc import Callable

import numpy as np
import pytest
import xarray as xr
from captures import emissivity_of, polynomials
from numpy.typing import NDArray

from dbthermal import response as responses
from dbthermal import separation, simulation
from dbthermal.simulation import Background, Rig

Floats = NDArray[np.float64]
FRAMES, HEIGHT, WIDTH = 240, 24, 40
RATIO = 2.1
NOISE = np.array([0.004, 0.005])
TIME = np.arange(FRAMES) / 10.0  # s
FILM = np.arange(350) / 10.0  # s


def pulses() -> Floats:
    """Reflection in the left half, in the first band's unit (time, y, x)."""
    rng = np.random.default_rng(4)
    start = rng.uniform(0.0, 22.0, (6, 1, HEIGHT, WIDTH))
    inside = (TIME[:, np.newaxis, np.newaxis] - start > 0) & (
        TIME[:, np.newaxis, np.newaxis] - start < 1.5
    )
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
        noisy = (1 + gain) * clean + offset + noise * rng.standard_normal(clean.shape)
        bands.append(noisy)
    return xr.DataArray(
        np.stack(bands),
        dims=("band", "time", "y", "x"),
        coords={"band": ["8-14", "9.5"], "time": TIME},
        attrs={"units": "1", "radiometric": 0},
    )


@pytest.fixture(scope="module")
def signal() -> xr.DataArray:
    """Movie whose frames' gains and offsets are off by 0.002."""
    return movie(0.002)


@pytest.fixture(scope="module")
def found(signal: xr.DataArray) -> xr.Dataset:
    """Emission and reflection of the movie."""
    return separation.uncalibrated_reflection(signal)


def test_ratio_and_noise(found: xr.Dataset) -> None:
    """The ratio is recovered within 3 %, the ratio of the noises within 5 %, of scaled frames too;
    pixels with a reflection have its ratio without bias, the others have no correlation.
    """
    for attrs in (found.attrs, separation.uncalibrated_reflection(movie()).attrs):
        assert attrs["pooled_ratio"] == pytest.approx(RATIO, rel=0.03)
        assert attrs["noise_ratio"] == pytest.approx((NOISE[1] / NOISE[0]) ** 2, rel=0.05)
        assert attrs["correlated_pixels"] == HEIGHT * WIDTH // 2
    left = {"x": slice(WIDTH // 2)}
    ratio = found["ratio"].isel(left)
    assert float(ratio.mean()) == pytest.approx(RATIO, rel=0.02)
    assert float(ratio.std()) < 0.1
    assert float(found["correlation"].isel(left).min()) > 0.8
    assert float(abs(found["correlation"].isel(x=slice(WIDTH // 2, None))).max()) < 0.35


def test_reflection_is_the_true_one(signal: xr.DataArray, found: xr.Dataset) -> None:
    """Its error is that of the best linear estimate, without the scaling; with the emission it adds
    up to the first band, to the rounding of float32.
    """
    total = found["emission"].astype(float) + found["reflection"].astype(float)
    np.testing.assert_allclose(total, signal[0], rtol=0, atol=1e-7)
    assert found["emission"].dtype == found["reflection"].dtype == np.float32
    functions = polynomials(TIME, found.attrs["order"])
    true = pulses().reshape(FRAMES, -1)
    true -= functions @ (functions.T @ true)
    error = found["reflection"].values.reshape(FRAMES, -1) - true
    noise = (NOISE[0] ** -2 + RATIO**2 * NOISE[1] ** -2) ** -0.5
    assert float(np.sqrt(np.mean(error**2))) == pytest.approx(noise, rel=0.1)
    assert float(np.std(true)) > 3 * noise


def test_unit_does_not_matter(signal: xr.DataArray, found: xr.Dataset) -> None:
    """Bands in units of their own give the ratio in those units, and the same reflection."""
    scale = xr.DataArray([100.0, 300.0], dims="band")
    other = separation.uncalibrated_reflection(scale * signal)
    assert other.attrs["pooled_ratio"] == pytest.approx(3 * found.attrs["pooled_ratio"], rel=1e-9)
    np.testing.assert_allclose(other["reflection"], 100 * found["reflection"], rtol=0, atol=1e-5)


def test_mask(signal: xr.DataArray, found: xr.Dataset) -> None:
    """Pixels outside the mask do not enter ratio and noise, but are separated."""
    mask = xr.DataArray(np.arange(HEIGHT) < 18, dims="y").expand_dims(x=WIDTH, axis=1)
    spoiled = signal.where(mask, signal * xr.DataArray([1.0, 0.2], dims="band"))
    masked = separation.uncalibrated_reflection(spoiled.transpose(*signal.dims), mask=mask)
    assert masked.attrs["correlated_pixels"] == 18 * WIDTH // 2
    assert masked.attrs["pooled_ratio"] == pytest.approx(RATIO, rel=0.03)
    assert masked.attrs["noise_ratio"] == pytest.approx((NOISE[1] / NOISE[0]) ** 2, rel=0.05)
    assert float(masked["ratio"][18:, : WIDTH // 2].median()) < 0.5
    assert masked["reflection"].shape == found["reflection"].shape


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        (lambda it: it.isel(band=[0]), {}, "Invalid signal {'band': 1"),
        (lambda it: it.isel(band=[0, 1, 1]), {}, "Must be (band, time, y, x) of two bands"),
        (lambda it: it.transpose("time", "band", "y", "x"), {}, "Must be (band, time, y, x)"),
        (lambda it: it.where(it["time"] > 0), {}, "Invalid signal: NaN or infinite"),
        (lambda it: it, {"correlated": 1.0}, "Invalid correlation 1.0. Must lie in (0, 1)"),
        (lambda it: it, {"correlated": np.nan}, "Invalid correlation nan"),
        (lambda it: it, {"correlated": 0.999}, "0 pixels have a correlation above 0.999"),
        (lambda it: it, {"order": 0}, "Invalid order 0 of the smooth subspace"),
        (lambda it: it, {"order": 241}, "Invalid order 241 of the smooth subspace"),
        (lambda it: it, {"mask": xr.DataArray(np.ones((2, 2)), dims=("y", "x"))}, "of the mask"),
        (lambda it: it[..., :20], {}, "correlation below 0.1 in magnitude. Must be at least 100"),
        (lambda it: it[..., 20:], {}, "0 pixels have a correlation above 0.5"),
    ],
)
def test_refused(
    signal: xr.DataArray,
    change: Callable[[xr.DataArray], xr.DataArray],
    options: dict[str, float],
    message: str,
) -> None:
    """Other dimensions, NaN, and movies with too few pixels raise an error."""
    with pytest.raises(ValueError, match=re.escape(message)):
        separation.uncalibrated_reflection(change(signal), **options)  # type: ignore[arg-type]


def test_reflected_change() -> None:
    """It is the share of the background's change that the first band sees, for objects that change
    and for those that do not.
    """
    rig, value = Rig(noise=(0.003, 0.035)), emissivity_of(0.86, 0.72)
    for stop in (293.15, 303.15):  # a constant object, and one that warms
        rng = np.random.default_rng(4)
        scene = simulation.independent_pixels(
            FILM, value, Background(), 40, rng, start=293.15, stop=stop
        )
        capture = simulation.observe(scene, rig.response(), rng)
        result = separation.solve(capture, rig.response())
        apparent = responses.apparent_temperature(rig.response(), capture["counts"])
        found = separation.reflected_change(apparent, result)
        true = 0.14 * (
            scene["background_temperature"] - scene["background_temperature"].mean("time")
        )
        assert found.dims == ("time", "y", "x")
        assert float(found.notnull().all("time").mean()) > 0.95
        error = float(np.sqrt(((found - true) ** 2).mean()))
        print(f"object to {stop} K: {error:.3f} K")
        assert error < 0.02  # [K], of changes of 0.4 K


def test_reflected_change_of_another_band() -> None:
    """Bands in another order raise a ValueError."""
    result = xr.Dataset(coords={"band": ["8-14", "9.5"]})
    apparent = xr.DataArray(np.zeros((2, 1, 1, 1)), dims=("band", "time", "y", "x"))
    with pytest.raises(ValueError, match=r"Invalid first band '9\.5'. Must be '8-14'"):
        separation.reflected_change(apparent.assign_coords(band=["9.5", "8-14"]), result)
