"""Raw counts that are clipped below the end of their type, or stand, in one band."""

import numpy as np
import numpy.typing as npt
import pytest
import xarray as xr

from dbthermal.correction import correct_capture
from dbthermal.schema import Status

Floats = npt.NDArray[np.float64]
BANDS, SHAPE, FRAMES = ["8-14", "9.5"], (16, 24), 200


def recorded(seed: int, noise: float = 3.4) -> tuple[Floats, xr.Dataset]:
    """Whole counts (band, time, y, x) of a warming wall and its reflections, and its correction."""
    rng, time = np.random.default_rng(seed), np.arange(FRAMES) / 10.0
    gain = 1.0 + 0.02 * rng.standard_normal((2, *SHAPE))
    offset = 40.0 * rng.standard_normal((2, *SHAPE))
    wall = (
        300.0 * (1.0 - np.exp(-time / 8.0))[:, None, None] * np.linspace(1, 1.5, SHAPE[0])[:, None]
    )
    mirrored = np.zeros((FRAMES, *SHAPE))
    for start in rng.integers(0, FRAMES - 20, 6):
        column = rng.integers(0, SHAPE[1] - 8)
        mirrored[start : start + rng.integers(5, 40), :, column : column + 8] += (
            400.0 * rng.random()
        )
    signal = np.stack([0.86 * wall + 0.14 * mirrored, 0.18 * wall + 0.07 * mirrored])
    level = 20000.0 + signal + noise * rng.standard_normal(signal.shape)
    maps = ("band", "y", "x")
    correction = {"gain": (maps, gain), "offset": (maps, offset), "bad": (maps, gain < 0)}
    raw = np.rint((level - offset[:, np.newaxis]) / gain[:, np.newaxis])
    return raw, xr.Dataset(correction, {"band": BANDS})


def marked(raw: Floats, correction: xr.Dataset, bit: Status) -> npt.NDArray[np.bool_]:
    """Pixels (y, x) that the correction marks with a bit."""
    capture = xr.Dataset(
        {"counts": (("band", "time", "y", "x"), raw.astype(np.uint16))},
        {"band": BANDS, "time": np.arange(FRAMES) / 10.0},
    )
    status = correct_capture(capture, correction, bad_pixels=None)["status"].values
    return np.asarray(status & np.uint32(bit) != 0)


@pytest.mark.parametrize("band", [0, 1])
@pytest.mark.parametrize("share", [0.99, 0.9, 0.5])
def test_a_level_within_the_type_clips_all_that_reach_it(band: int, share: float) -> None:
    """Each pixel with a sample at the camera's level is saturated, above or below, and no other."""
    for sign in (1, -1):
        raw, correction = recorded(1)
        level = sign * np.rint(np.quantile(sign * raw[band], share))
        raw[band] = sign * np.minimum(sign * raw[band], sign * level)
        reached = np.any(raw[band] == level, axis=0)
        np.testing.assert_array_equal(marked(raw, correction, Status.SATURATED), reached)


@pytest.mark.parametrize("band", [0, 1])
def test_a_region_that_stands_is_frozen(band: int) -> None:
    """A part of one image that repeats for 12 frames is marked, and nothing else."""
    raw, correction = recorded(1)
    raw[band, 50:62, :10] = raw[band, 49, :10]
    found = marked(raw, correction, Status.FROZEN_FRAMES)
    assert found[:10].all()
    assert not found[10:].any()


@pytest.mark.parametrize("noise", [0.3, 1.2, 12.0])
def test_clean_counts_are_not_marked(noise: float) -> None:
    """Rounded counts of any noise neither heap nor stand."""
    for seed in range(2):
        raw, correction = recorded(seed, noise)
        for bit in (Status.SATURATED, Status.FROZEN_FRAMES):
            assert not marked(raw, correction, bit).any()
