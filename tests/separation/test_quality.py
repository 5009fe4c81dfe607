"""Data quality of the counts: bits of bad pixels, and none of good ones."""

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import xarray as xr
from captures import RIG, plain_capture
from marks import long

from dbthermal import separation
from dbthermal.schema import Status

FRAMES, PIXELS = 20, 6
Place = tuple[int | slice, int | slice, int]
CHECKED = np.uint32(
    Status.INVALID_SAMPLES | Status.CONSTANT_SIGNAL | Status.FROZEN_FRAMES | Status.SATURATED
)


def capture_of(counts: npt.NDArray[np.float64]) -> xr.Dataset:
    """Capture one row high of counts (band, time, pixel)."""
    return plain_capture(counts[:, :, np.newaxis].astype(np.float32))


def plain() -> npt.NDArray[np.float64]:
    """Counts (band, time, pixel) of noise about 20000."""
    noise = np.random.default_rng(1).standard_normal((2, FRAMES, PIXELS))
    return np.asarray(20000.0 + 20.0 * noise)


def read(capture: xr.Dataset, noise: float = 20.0, **options: Any) -> xr.Dataset:
    """Temperatures as the camera reads them by noise [count], with what is said of the samples."""
    response = RIG.response()
    response = response.assign(noise=response["noise"].copy(data=[noise, noise]))
    return separation.solve(capture, response, "apparent", **options)


def bits(result: xr.Dataset) -> npt.NDArray[np.uint32]:
    """What is said of the samples of each pixel."""
    status: npt.NDArray[np.uint32] = result["status"].values[0]
    return status & CHECKED


def test_bits_of_bad_pixels() -> None:
    """Too few samples, a constant band, a pixel that stands for frames: each its own bit."""
    counts = plain()
    assert not bits(read(capture_of(counts))).any()
    counts[0, 3, 0] = np.nan
    counts[1, :11, 1] = np.nan
    counts[0, :, 2] = 20007.0
    counts[:, 4:9, 3] = 20000.0
    flags = [0, Status.INVALID_SAMPLES, Status.CONSTANT_SIGNAL, Status.FROZEN_FRAMES, 0, 0]
    np.testing.assert_array_equal(bits(read(capture_of(counts))), flags)


def test_a_heap_on_one_level_is_saturation() -> None:
    """Samples that heap on the highest or lowest value are flagged, except masked ones."""
    counts = plain()
    counts[0, 2:9, 1], counts[1, 2:9, 4:] = 19900.0, 20100.0
    capture, mask = capture_of(counts), np.ones((FRAMES, 1, PIXELS), dtype=bool)
    mask[2:9, 0, 5] = False
    used = xr.DataArray(mask, dims=("time", "y", "x"))
    np.testing.assert_array_equal(np.flatnonzero(bits(read(capture, mask=used))), [1, 4])


@pytest.mark.parametrize(("copies", "flag"), [(1, 0), (2, 0), (3, Status.FROZEN_FRAMES)])
def test_copies_of_a_frame_are_left_out(copies: int, flag: int) -> None:
    """A frame that repeats in one band is no sample; three are flagged."""
    counts = plain()
    counts[1, 7 : 7 + copies] = counts[1, 6]
    result = read(capture_of(counts))
    assert np.all(bits(result) == flag)
    empty = result["object_temperature"].isnull().all(("y", "x"))
    np.testing.assert_array_equal(np.flatnonzero(empty), 7 + np.arange(copies))


@pytest.mark.parametrize(
    ("noise", "seeds"),
    [(noise, 2) for noise in (0.05, 0.3, 0.8, 1.2, 3.4, 30.0)]
    + long(*((noise, 20) for noise in (0.05, 0.1, 0.2, 0.3, 0.5, 0.8, 1.2, 2.0, 3.4, 30.0))),
)
def test_whole_counts_repeat_by_chance(noise: float, seeds: int) -> None:
    """Of rounded counts that rest, rise and step, at most one in 1e3 of many has a flag."""
    number = 0
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        frames = (350, 100, 1000)[seed % 3]
        rise = 300.0 * (1.0 - np.exp(-np.arange(frames) / 80.0)) * (seed % 4 > 0)
        pulses = np.zeros((frames, 320))
        for pixel in range(320):
            for start in rng.integers(0, frames, rng.integers(0, 6)):
                pulses[start : start + rng.integers(2, 60), pixel] += rng.uniform(-40, 150)
        signal = np.stack([0.9 * rise[:, None] + 0.1 * pulses, 0.2 * rise[:, None] + 0.1 * pulses])
        raw = np.rint(20000.0 + signal + noise * rng.standard_normal(signal.shape))
        gain, offset = 1.0 + 0.02 * rng.standard_normal(320), 40.0 * rng.standard_normal(320)
        flags = bits(read(capture_of(raw * gain + offset), noise))
        number += int(np.count_nonzero(flags & ~np.uint32(Status.CONSTANT_SIGNAL)))
    print(f"noise {noise} count: {number} of {320 * seeds} clean pixels flagged")
    assert number <= 0.001 * 320 * seeds
