"""Recordings that pause, and clocks that are set: bounded memory, right offsets, or an error."""

import tracemalloc

import numpy as np
import numpy.typing as npt
import pytest
import xarray as xr
from captures import RIG, plain_capture

from dbthermal import alignment

Floats = npt.NDArray[np.float64]

FRAMES = 300
EVEN = np.arange(FRAMES) / 10.0  # s
PAUSED = EVEN + 3600.0 * (EVEN >= 12.0)


def filmed(stamps: Floats, real: Floats | None = None, pixels: int = 256) -> xr.Dataset:
    """Counts of a plate that warms while people pass, each band at its own real times (band, time).

    Made without the package's simulation: gray levels, edges of 0.1 s, a pass every 4 s or so.
    """
    rng, real = np.random.default_rng(1), stamps if real is None else real
    counts = np.empty((2, stamps.shape[1], pixels))
    span = np.nanmax(real)
    passes = [np.sort(rng.uniform(-2.0, min(span, 40.0), 10)) for _ in range(pixels)]
    passes = [np.concatenate([one, one + 3600.0]) for one in passes]
    widths = rng.uniform(0.4, 1.5, pixels)
    warm = 20.0 * rng.uniform(0.5, 1.0, pixels)
    for band, (share, noise) in enumerate(((0.14, 0.03), (0.28, 0.3))):
        for pixel in range(pixels):
            since = real[band][:, np.newaxis] - passes[pixel]
            gone = (np.tanh(since / 0.1) - np.tanh((since - widths[pixel]) / 0.1)).sum(axis=1) / 2
            slow = warm[pixel] * -np.expm1(-np.fmax(real[band], 0.0) / (0.4 * span))
            counts[band, :, pixel] = (1.0 - share) * slow + share * 4.0 * gone
        counts[band] += rng.normal(0.0, noise, counts[band].shape)
    image = (16000.0 + 115.0 * counts).reshape(2, -1, 16, pixels // 16).astype(np.float32)
    return plain_capture(image, stamps[0], exposure_time=(("band", "time"), stamps))


@pytest.mark.parametrize("late", [-0.27, -0.1, 0.05, 0.13])
def test_offset_across_a_pause(late: float) -> None:
    """Across a pause of an hour the offset is right within 0.1 frame, and `align` names it."""
    stamps = np.stack([PAUSED, PAUSED])
    aligned = alignment.align(filmed(stamps, stamps + np.array([[0.0], [late]])))
    found, time = aligned.attrs["time_offset"][1], aligned["time"].values
    assert found == pytest.approx(late, abs=0.01)
    before = np.searchsorted(PAUSED, 3600.0) - 1
    np.testing.assert_allclose(aligned.attrs["pauses"], time[[before, before + 1]])
    assert max(aligned.attrs["frames_lost"]) <= 6  # at two ends of two recordings
    assert aligned.sizes["time"] == FRAMES


def test_cameras_that_pause_on_their_own() -> None:
    """Cameras that start anew after a pause at other phases, and lose frames, keep their stamps."""
    rng = np.random.default_rng(3)
    other = np.sort(rng.permutation(FRAMES)[:-12]) / 10.0
    other = np.concatenate([other + np.where(other >= 12.0, 3600.037, 0.0), np.full(12, np.nan)])
    stamps = np.stack([PAUSED, other])
    capture = filmed(stamps, stamps + np.array([[0.0], [0.06]]))
    assert alignment.time_offset(capture) == pytest.approx(0.06, abs=0.01)


def test_memory_of_a_pause() -> None:
    """A pause of an hour, or of 30 years, takes hardly more memory than none."""
    sizes = []
    for pause in (0.0, 3.6e3, 1e9):
        times = EVEN + pause * (EVEN >= 12.0)
        capture = filmed(np.stack([times, times + 0.03]))
        tracemalloc.start()
        alignment.align(capture)
        sizes.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert max(sizes) < 1.5 * sizes[0]


@pytest.mark.parametrize("band", [0, 1])
@pytest.mark.parametrize("step", [-2.0, 0.3, 11.0, 3600.0])
def test_a_clock_that_is_set(band: int, step: float) -> None:
    """A camera's clock that is set, either way, is refused by band and time, with any offset."""
    wrong, real = np.stack([EVEN, EVEN]), np.stack([EVEN, EVEN])
    wrong[band, 140:] += step
    what = r"'counts'|band '9.5'" if step < 0 else f"times of band '{RIG.bands[band]}'"
    how = "13.9 s is followed" if step < 0 else r"a step of [0-9.]* s after 13.9 s"
    for offset in (None, 0.0):
        with pytest.raises(ValueError, match=rf"({what}).*: {how}"):
            alignment.align(filmed(wrong, real), offset=offset)


@pytest.mark.parametrize("lost", [1, 30, 100])
def test_lost_frames_are_no_clock_that_is_set(lost: int) -> None:
    """A gap in one camera's stamps alone, of frames that it lost, is no error."""
    gap = np.concatenate([np.delete(EVEN, slice(150, 150 + lost)), np.full(lost, np.nan)])
    aligned = alignment.align(filmed(np.stack([EVEN, gap])))
    assert aligned.attrs["time_offset"][1] == pytest.approx(0.0, abs=0.01)
    assert max(aligned.attrs["frames_lost"]) <= lost + 1


NUMBER = np.arange(FRAMES)
ARRIVALS = {
    "bursts of 8": NUMBER // 8 * 0.8 + NUMBER % 8 * 1e-4,
    "bursts of 32": NUMBER // 32 * 3.2 + NUMBER % 32 * 1e-3,
    "at random": np.cumsum(np.random.default_rng(1).exponential(0.1, FRAMES)),
    "slower and slower": np.expm1(NUMBER / 40.0),
}


@pytest.mark.parametrize("kind", ARRIVALS)
def test_times_of_arrival_have_no_frame_period(kind: str) -> None:
    """An offset in frames of a clock that has no frame period is refused by band."""
    capture = filmed(np.stack([ARRIVALS[kind]] * 2), np.stack([EVEN, EVEN + 0.05]))
    with pytest.raises(ValueError, match=r"Invalid exposure times of band '8-14': .* in bursts"):
        alignment.time_offset(capture)
