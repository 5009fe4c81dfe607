"""Missing samples (NaN, masks, shutter events) leave the other values as they are."""

from typing import Any

import numpy as np
import pytest
import xarray as xr

from dbthermal import schema, separation
from dbthermal.simulation import Rig
from reproduction import experiments

RIG = Rig()
TIME = np.arange(350) / 10.0
GLASS: dict[str, Any] = {"emissivity": [0.86, 0.72], "start": 20, "stop": 60}
PIXELS = 20
FRAMES = ("object_temperature", "background_temperature")
INVALID = schema.Status.INVALID_SAMPLES
Case = tuple[xr.Dataset, xr.Dataset, xr.Dataset]


@pytest.fixture(scope="module")
def case() -> Case:
    """Scene, capture and response of 20 pixels of glass."""
    return experiments.simulate(GLASS, RIG, TIME, PIXELS, seed=1)


def without(capture: xr.Dataset, there: np.ndarray) -> xr.Dataset:
    """The capture with NaN in place of missing samples (..., time, y, x), in all bands."""
    used = xr.DataArray(there, dims=("time", "y", "x"))
    return capture.assign(counts=capture["counts"].where(used))


def assert_agree(found: xr.Dataset, expected: xr.Dataset, frames: np.ndarray) -> None:
    """Assert the values of the shorter capture at its frames, and NaN at the others."""
    for name in schema.STAGES["separated"]:
        values = found[name].values
        if name.startswith(FRAMES):
            assert np.all(np.isnan(values[~frames]))
            values = values[frames]
        np.testing.assert_allclose(values, expected[name].values, rtol=1e-5, atol=1e-6)


def lost(fraction: float, seed: int = 0) -> np.ndarray:
    """Mask of the frames (time): some missing at random, and one long gap."""
    there = np.random.default_rng(seed).random(350) >= fraction
    there[120:150] = False
    return np.asarray(there)


@pytest.mark.parametrize(
    ("band", "value"), [([0], np.nan), ([1], np.inf), ([0, 1], -np.inf), ([0, 1], np.nan)]
)
def test_missing_frames_are_as_if_never_taken(case: Case, band: list[int], value: float) -> None:
    """Missing frames, in one band or both, leave all other frames' results as they are."""
    _, capture, response = case
    frames = lost(0.1)
    spoilt = capture.copy(deep=True)
    for one in band:
        spoilt["counts"].values[one, ~frames] = value
    expected = separation.solve(capture.isel(time=frames), response)
    assert_agree(separation.solve(spoilt, response), expected, frames)


@pytest.mark.parametrize("noise_known", [True, False])
def test_masks_of_frames(case: Case, noise_known: bool) -> None:
    """A mask over time is the capture without these frames, noise known or not."""
    _, capture, response = case
    response = response if noise_known else response.drop_vars(["noise", "netd"])
    frames = lost(0.2, seed=3)
    found = separation.solve(capture, response, mask=xr.DataArray(frames, dims="time"))
    assert_agree(found, separation.solve(capture.isel(time=frames), response), frames)


def test_masks_of_pixels(case: Case) -> None:
    """Pixels that are masked are flagged and NaN, the others as they were."""
    _, capture, response = case
    used = np.arange(PIXELS)[np.newaxis] % 3 > 0
    found = separation.solve(capture, response, mask=xr.DataArray(used, dims=("y", "x")))
    whole = separation.solve(capture, response)
    assert np.all(found["status"].values[~used] == INVALID)
    for name in schema.STAGES["separated"]:
        if name != "status":
            assert np.all(np.isnan(found[name].values[..., ~used]))
        np.testing.assert_allclose(
            found[name].values[..., used], whole[name].values[..., used], rtol=1e-6
        )


def test_masks_of_samples_are_nan(case: Case) -> None:
    """A mask of single samples is the same as NaN there, each pixel with its own frames."""
    _, capture, response = case
    there = np.random.default_rng(4).random((350, 1, PIXELS)) > 0.25  # too many to be bridged
    masked = separation.solve(capture, response, mask=xr.DataArray(there, dims=("time", "y", "x")))
    spoilt = separation.solve(without(capture, there), response)
    xr.testing.assert_identical(masked, spoilt)
    assert np.all(np.isnan(masked["object_temperature"].values[~there]))
    assert np.all(np.isfinite(masked["object_temperature"].values[there]))
    pixel = capture.isel(x=[7]).isel(time=there[:, 0, 7])
    alone = separation.solve(pixel, response)
    assert_agree(masked.isel(x=[7]), alone, there[:, 0, 7])


@pytest.mark.parametrize(("missing", "good"), [(170, True), (180, False)])
def test_half_of_the_frames_must_be_there(case: Case, missing: int, good: bool) -> None:
    """A pixel with less than half of its frames is NaN and flagged."""
    _, capture, response = case
    there = np.ones((350, 1, PIXELS), dtype=bool)
    there[np.random.default_rng(5).permutation(350)[:missing], 0, 3] = False
    result = separation.solve(without(capture, there), response)
    assert bool(result["status"].values[0, 3] != INVALID) == good
    assert bool(np.any(np.isfinite(result["object_temperature"].values[:, 0, 3]))) == good
    assert not np.any(np.delete(result["status"].values[0], 3))


def test_a_segment_without_a_step_costs_little(case: Case) -> None:
    """An event without a step changes the object by less than 0.15 K, and sets no flag."""
    _, capture, response = case
    plain = separation.solve(capture, response)
    freed = separation.solve(capture.assign(segment=("time", np.repeat([3, 4], 175))), response)
    assert not np.any(freed["status"])
    apart = freed["object_temperature"] - plain["object_temperature"]
    assert float(np.sqrt((apart**2).mean())) < 0.15  # [K]
    constant = separation.solve(capture.assign(segment=("time", np.full(350, 9))), response)
    xr.testing.assert_identical(constant["object_temperature"], plain["object_temperature"])


BAD: dict[str, tuple[dict[str, Any], Any, type[Exception], str]] = {
    "mask of numbers": ({}, xr.DataArray(np.ones(350), dims="time"), TypeError, "dtype float64 of"),
    "mask of a list": ({}, [True] * 350, TypeError, "Invalid mask of type list"),
    "mask too short": ({}, xr.DataArray(np.ones(9, bool), dims="time"), ValueError, "of the mask"),
    "mask of bands": ({}, xr.DataArray([True, True], dims="band"), ValueError, "of the mask"),
    "half segments": ({"segment": ("time", np.ones(350))}, None, TypeError, "dtype float64 of"),
    "falling": ({"segment": ("time", np.arange(350)[::-1])}, None, ValueError, "do not fall"),
    "of pixels": ({"segment": ("x", np.arange(PIXELS))}, None, ValueError, "Must be .'time',"),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_masks_and_segments(case: Case, what: str) -> None:
    """Invalid masks and numbers of segments raise an error with the rule."""
    new, mask, error, message = BAD[what]
    _, capture, response = case
    with pytest.raises(error, match=message):
        separation.solve(capture.assign(new), response, mask=mask)


def test_unequal_gaps_need_a_known_noise(case: Case) -> None:
    """Gaps in different frames of every pixel raise a ValueError that asks for the noise."""
    _, capture, response = case
    there = np.random.default_rng(8).random((350, 1, PIXELS)) > 0.02
    with pytest.raises(ValueError, match=r"0 usable pixels .* or give the noise"):
        separation.solve(without(capture, there), response.drop_vars(["noise", "netd"]))
