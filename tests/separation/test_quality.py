"""Data quality: valid samples, bits of the status, gaps, and sets of frames."""

import numpy as np
import numpy.typing as npt
import pytest
import xarray as xr

from dbthermal.schema import Status
from dbthermal.separation import _quality as quality

FRAMES = 20
Place = tuple[int | slice, int | slice, int]


def part(dtype: str = "float32", pixels: int = 6) -> xr.Dataset:
    """Part of a capture (band, time, y, x) of noise about 1000 counts, one row high."""
    rng = np.random.default_rng(1)
    counts = 1000.0 + 20.0 * rng.standard_normal((2, FRAMES, 1, pixels))
    return xr.Dataset({"counts": (("band", "time", "y", "x"), counts.astype(dtype))})


def spoilt(*values: tuple[Place, float], dtype: str = "float32") -> xr.Dataset:
    """The same with some counts replaced, by index (band, time, pixel)."""
    result = part(dtype)
    for (band, time, pixel), value in values:
        result["counts"].values[band, time, 0, pixel] = value
    return result


def bits(*flags: tuple[int, Status]) -> npt.NDArray[np.uint32]:
    """Status (pixel) with a bit in some pixels."""
    result = np.zeros(6, dtype=np.uint32)
    for pixel, bit in flags:
        result[pixel] |= np.uint32(bit)
    return result


def test_good_samples_pass_unchanged() -> None:
    """Counts as float64, all valid, no bit."""
    counts, valid, status = quality.read(part())
    np.testing.assert_array_equal(counts, part()["counts"].values[:, :, 0].astype(np.float64))
    assert valid.all()
    assert not status.any()


def test_bits_of_bad_pixels() -> None:
    """NaN in one band is invalid in all; pixels of few, constant or frozen frames are flagged."""
    every, some = slice(None), slice(0, 11)
    bad = spoilt(
        ((0, 3, 0), np.nan),
        ((1, some, 1), np.nan),
        ((0, every, 2), 7.0),
        ((every, slice(4, 9), 3), 1000.0),
    )
    counts, valid, status = quality.read(bad)
    expected = bits(
        (1, Status.INVALID_SAMPLES), (2, Status.CONSTANT_SIGNAL), (3, Status.FROZEN_FRAMES)
    )
    np.testing.assert_array_equal(status, expected)
    assert valid[:, 0].sum() == FRAMES - 1
    assert np.all(counts[:, 3, 0] == 0.0)
    assert np.all(counts[:, :, [1, 2]] == 0.0)  # unusable
    np.testing.assert_array_equal(quality.unusable(status), [False, True, True] + 3 * [False])


def test_a_heap_on_one_level_is_saturation() -> None:
    """Samples that heap on the highest or lowest value are flagged, except masked ones."""
    low, high = ((0, slice(2, 9), 1), 900.0), ((1, slice(2, 9), 4), 1100.0)
    wild = spoilt(low, high, ((1, slice(2, 9), 5), 1100.0))
    mask = np.ones((FRAMES, 1, 6), dtype=bool)
    mask[2:9, 0, 5] = False
    _, valid, status = quality.read(wild.assign(mask=(("time", "y", "x"), mask)))
    flagged = np.flatnonzero(status & np.uint32(Status.SATURATED))
    np.testing.assert_array_equal(flagged, [1, 4])
    assert not valid[2:9, 5].any()


def test_one_band_that_stands_is_frozen_and_copies_are_left_out() -> None:
    """A frame that repeats in one band is no sample; three are flagged, and so is one pixel."""
    for copies, flag in ((1, 0), (2, 0), (3, Status.FROZEN_FRAMES)):
        _, valid, status = quality.read(spoilt(*repeats(1, 7, copies)))
        np.testing.assert_array_equal(np.flatnonzero(~valid[:, 0]), 7 + np.arange(copies))
        assert np.all(status == flag)
    _, valid, status = quality.read(spoilt(((0, slice(4, 13), 3), 1000.0)))
    np.testing.assert_array_equal(status, bits((3, Status.FROZEN_FRAMES)))
    assert valid.all()


def repeats(band: int, first: int, number: int) -> list[tuple[Place, float]]:
    """Replacements that make so many frames of a band copies of the one before."""
    before = part()["counts"].values[band, first - 1, 0]
    frames = slice(first, first + number)
    return [((band, frames, pixel), float(value)) for pixel, value in enumerate(before)]


@pytest.mark.parametrize("noise", [0.05, 0.3, 0.8, 1.2, 3.4, 30.0])
def test_whole_counts_repeat_by_chance(noise: float) -> None:
    """Rounded counts that rest, rise and step stay without a flag, from 0.05 to 30 counts."""
    assert flags_of_whole_counts(noise, range(2)) == 0


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.05, 0.1, 0.2, 0.3, 0.5, 0.8, 1.2, 2.0, 3.4, 30.0])
def test_whole_counts_repeat_by_chance_in_many(noise: float) -> None:
    """At most one in 1e3 of 6400 such pixels is flagged."""
    number = flags_of_whole_counts(noise, range(20))
    print(f"noise {noise} count: {number} of 6400 clean pixels flagged")
    assert number <= 6


def flags_of_whole_counts(noise: float, seeds: range) -> int:
    """Flagged pixels, 320 a seed, of rounded counts under a gain, an offset a pixel."""
    number = 0
    for seed in seeds:
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
        counts = (raw * gain + offset).astype(np.float32)[:, :, np.newaxis]
        capture = xr.Dataset({"counts": (("band", "time", "y", "x"), counts)})
        known = quality.grains(capture, np.array([noise, noise])) if seed % 2 else None
        status = quality.read(capture, 1, known)[2]
        number += int(np.count_nonzero(status & np.uint32(Status.SATURATED | Status.FROZEN_FRAMES)))
    return number


def test_status_of_the_capture_is_kept() -> None:
    """A pixel that the correction marked as dead is unusable, and keeps its bit."""
    known = part().assign(status=(("y", "x"), bits((2, Status.DEAD_PIXEL))[np.newaxis]))
    counts, _, status = quality.read(known)
    assert status[2] == Status.DEAD_PIXEL
    assert np.all(counts[:, :, 2] == 0.0)


def test_short_gaps_are_bridged_by_a_line() -> None:
    """Gaps of one and two frames are interpolated in time; longer ones and ends are not."""
    time = np.cumsum(np.r_[1.0, np.full(FRAMES - 1, 0.1)])
    time[7:] += 0.3  # an uneven clock
    counts = np.stack([5.0 * time, -3.0 * time])[..., np.newaxis] * np.ones(6)
    valid = np.ones((FRAMES, 6), dtype=bool)
    valid[6, 0] = valid[8:10, 1] = valid[12:15, 2] = valid[0, 3] = False
    filled, usable = quality.bridge(np.where(valid, counts, 0.0), valid, time)
    np.testing.assert_allclose(filled[:, :, :2], counts[:, :, :2], rtol=1e-12)
    np.testing.assert_array_equal(usable.all(axis=0), [True, True, False, False, True, True])


def test_gaps_beside_an_object_are_bridged() -> None:
    """Pixels without any sample, as most are beside an object, do not say which gaps are short."""
    counts, valid = np.ones((2, FRAMES, 6)), np.zeros((FRAMES, 6), dtype=bool)
    valid[:, :3] = True
    valid[6, 0] = valid[9, :3] = False
    usable = quality.bridge(counts, valid, np.arange(float(FRAMES)))[1]
    np.testing.assert_array_equal(usable[6], [True, True, True, False, False, False])
    assert not usable[9].any()  # a frame that all of the object lack is one that was lost


def test_longer_gaps_of_a_long_capture_are_bridged() -> None:
    """A hundredth of the capture is bridged, and not a frame more."""
    frames = 1000
    counts, valid = np.ones((2, frames, 5)), np.ones((frames, 5), dtype=bool)
    valid[100:110, 0] = valid[100:111, 1] = False
    usable = quality.bridge(counts, valid, np.arange(float(frames)))[1]
    np.testing.assert_array_equal(usable.all(axis=0), [True, False, True, True, True])


def test_pixels_of_the_same_frames_are_one_set() -> None:
    """Every usable pixel is in one set, and has its frames."""
    valid = np.ones((FRAMES, 6), dtype=bool)
    valid[3, [1, 4]] = valid[9, 2] = False
    status = bits((5, Status.DEAD_PIXEL))
    pairs = quality.frame_sets(valid, status)
    sets = {tuple(map(int, np.flatnonzero(pixels))): frames for frames, pixels in pairs}
    assert set(sets) == {(0, 3), (1, 4), (2,)}
    assert not sets[(1, 4)][3]
    assert sets[(1, 4)].sum() == FRAMES - 1
    assert list(quality.frame_sets(valid, np.full(6, Status.DEAD_PIXEL, np.uint32))) == []


def test_common_frames_leave_out_who_lacks_one() -> None:
    """A frame that most pixels lack is left out for all; pixels that lack another are unsolved."""
    valid = np.ones((FRAMES, 6), dtype=bool)
    valid[3, :5] = valid[9, 2] = False
    counts, status = np.ones((2, FRAMES, 6)), bits()
    ((frames, pixels),) = quality.common_frames(counts, valid, status)
    np.testing.assert_array_equal(np.flatnonzero(~frames), [3])
    np.testing.assert_array_equal(np.flatnonzero(~pixels), [2])
    np.testing.assert_array_equal(status, bits((2, Status.INVALID_SAMPLES)))
    assert np.all(counts[:, :, 2] == 0.0)
    assert quality.common_frames(counts, valid, status, fewest=FRAMES) == []
    assert np.all(status == Status.INVALID_SAMPLES)


def test_sample_is_even_and_good() -> None:
    """A sample has about the requested number of unflagged pixels, at their common frames."""
    whole = part(pixels=600)
    whole["counts"].values[0, 4, 0, :] = np.nan
    whole["counts"].values[0, 7, 0, :60] = np.nan
    counts, frames = quality.sample(whole, 150)
    np.testing.assert_array_equal(np.flatnonzero(~frames), [4])
    assert counts.shape == (2, FRAMES - 1, 270)
