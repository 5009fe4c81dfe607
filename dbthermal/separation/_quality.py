"""Data quality: which samples of a capture are valid, and which pixels cannot be used."""

from collections.abc import Iterator, Mapping
from functools import reduce
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import _samples as samples
from dbthermal import _smooth as smooth
from dbthermal import schema
from dbthermal._arrays import Array, Mask, stride
from dbthermal.schema import Status

Bits = npt.NDArray[np.uint32]

MOST_MISSING: Final = 0.5  # share of the frames without which a pixel is not solved
LONGEST_GAP: Final = 2  # frames in a row that may be bridged in a pixel
LONGEST_SHARE: Final = 0.01  # of the frames, in a row: as many may be in a long capture
MOST_BRIDGED: Final = 0.15  # share of the frames from which a pixel lacks too many to be bridged

# Frames from which fewer pixels are sampled, of as many samples together.
_LONG: Final = 2048
_UNUSABLE: Final = np.uint32(
    Status.INVALID_SAMPLES | Status.CONSTANT_SIGNAL | Status.DEAD_PIXEL | Status.NO_REFLECTION_PAIR
)


def status_bits(conditions: Mapping[Status, Mask]) -> Bits:
    """Combine conditions (pixel), each of a bit of the status, into the status (pixel)."""
    bits = [holds * np.uint32(bit) for bit, holds in conditions.items()]
    return np.asarray(np.bitwise_or.reduce(bits), dtype=np.uint32)


def unusable(status: Bits) -> Mask:
    """Return the pixels that cannot be separated."""
    return np.asarray((status & _UNUSABLE) != 0)


def grains(capture: xr.Dataset, noise: npt.ArrayLike = np.inf) -> list[samples.Grain]:
    """Grain of each band of a part of the capture; with the noise (band) [count], if known."""
    flat = samples.some_pixels(capture["counts"])
    limits = np.broadcast_to(noise, len(flat)).tolist()
    bands = zip(flat, limits, strict=True)
    return [samples.grain(band, np.isfinite(band), limit) for band, limit in bands]


def read(
    window: xr.Dataset,
    fewest: int = 1,
    larger_grains: list[samples.Grain] | None = None,
    most_missing: float = MOST_MISSING,
) -> tuple[Array, Mask, Bits]:
    """Read the samples of a part of the capture, and judge its pixels.

    Returns the counts (band, time, pixel) [count], zero where they are invalid and in unusable
    pixels; the samples that are valid in all bands (time, pixel), by their values and by the
    variable `mask`, in frames that repeat none (`_samples.copies`); and the status (pixel). A pixel
    that has less than the `fewest` valid frames, or lacks more than `most_missing`, cannot be
    solved. The `grains` of a larger part, if known, tell what repeats by chance.
    """
    raw = window["counts"].values
    counts = raw.reshape(*raw.shape[:2], -1)  # judged in its own precision, which is cheaper
    valid = np.ones(counts.shape[1:], dtype=bool)
    ends = np.stack([counts.min(axis=1), counts.max(axis=1)], axis=1)
    if not schema.measured(ends).all():  # NaN is both
        valid = np.all(schema.measured(counts), axis=0)
    if "mask" in window:
        valid &= window["mask"].broadcast_like(window["counts"][0]).values.reshape(valid.shape)
    counts = _kept(counts, valid)
    levels = grains(window) if larger_grains is None else larger_grains
    bands = zip(counts, levels, ends, strict=True)
    saturated = [samples.heaped(band, valid, grain, end) for band, grain, end in bands]
    same = [samples.repeated(band, valid) for band in counts]
    frozen, copied = _frozen(same, valid, [grain.chance for grain in levels])
    valid &= ~copied[:, np.newaxis]
    counts = _kept(counts, valid).astype(np.float64)
    frames = samples.counted(valid)
    invalid = too_few(valid, fewest, most_missing)
    if valid.all():
        constant = np.any([band.all(axis=0) for band in same], axis=0) & ~invalid
    else:
        highest = counts.max(axis=1, where=valid, initial=-np.inf)
        lowest = counts.min(axis=1, where=valid, initial=np.inf)
        constant = np.any(highest == lowest, axis=0) & ~invalid
    status = status_bits(
        {
            Status.INVALID_SAMPLES: invalid,
            Status.CONSTANT_SIGNAL: constant & (frames > 1),
            Status.SATURATED: np.any(saturated, axis=0),
            Status.FROZEN_FRAMES: frozen & ~invalid & ~constant,
        }
    )
    if "status" in window:
        status |= window["status"].values.reshape(-1).astype(np.uint32)
    if (without := unusable(status)).any():
        counts[:, :, without] = 0.0
    return counts, valid, status


def _kept(counts: npt.NDArray[Any], valid: Mask) -> npt.NDArray[Any]:
    """Counts (band, time, pixel) with zero for samples that are not valid (time, pixel)."""
    return counts if valid.all() else np.where(valid, counts, counts.dtype.type(0))


def too_few(valid: Mask, fewest: int, most_missing: float = MOST_MISSING) -> Mask:
    """Pixels (pixel) with fewer valid frames (time, pixel) than can be solved, see `read`."""
    least = max(fewest, (1.0 - most_missing) * len(valid))
    return np.asarray(samples.counted(valid) < least)


def bridge(counts: Array, valid: Mask, time: Array) -> tuple[Array, Mask]:
    """Bridge short gaps of single pixels by lines; return counts and usable samples."""
    if valid.all():
        return counts, valid
    sampled = valid.mean(axis=0) > MOST_MISSING  # beside an object most pixels have no samples
    common = valid[:, sampled].sum(axis=1) > MOST_MISSING * sampled.sum()
    # Gaps in frames that most pixels have, of pixels with few gaps.
    gap = ~valid & common[:, np.newaxis]
    gap &= gap.sum(axis=0) < MOST_BRIDGED * len(valid)
    if not np.any(gap):
        return counts, valid
    # Nearest valid frames before and after each gap.
    frame, pixel = np.nonzero(gap)
    selected, place = np.unique(pixel, return_inverse=True)
    places = np.arange(len(valid))[:, np.newaxis]
    before = np.maximum.accumulate(np.where(valid[:, selected], places, -len(valid)))[frame, place]
    after = np.where(valid[::-1, selected], places, -len(valid))
    after = len(valid) - 1 - np.maximum.accumulate(after)[::-1][frame, place]
    # A line between near frames, the same in all bands, which mix object and background alike.
    longest = max(LONGEST_GAP, int(LONGEST_SHARE * len(valid)))
    short = after - before <= longest + 1
    frame, pixel, start, end = (band[short] for band in (frame, pixel, before, after))
    share = (time[frame] - time[start]) / (time[end] - time[start])
    filled = counts.copy()
    line = (1.0 - share) * counts[:, start, pixel] + share * counts[:, end, pixel]
    filled[:, frame, pixel] = line
    bridged = valid.copy()
    bridged[frame, pixel] = True
    return filled, bridged


def frame_sets(valid: Mask, status: Bits) -> Iterator[tuple[Mask, Mask]]:
    """Yield sets of frames (time), and the pixels (pixel) that have these frames and no others."""
    usable = ~unusable(status)
    if not np.any(usable):
        return
    if np.all(valid | ~usable):
        yield np.ones(valid.shape[0], dtype=bool), usable
        return
    packed = np.packbits(valid, axis=0)
    _, places, group = np.unique(packed, axis=1, return_index=True, return_inverse=True)
    for index, pixel in enumerate(places):
        pixels = (group.ravel() == index) & usable
        if np.any(pixels):
            yield valid[:, pixel], pixels


def common_frames(
    counts: Array, valid: Mask, status: Bits, fewest: int = 1
) -> list[tuple[Mask, Mask]]:
    """Frames (time) that most pixels have, and the pixels (pixel) that have them all."""
    usable = ~unusable(status)
    if not np.any(usable):
        return []
    frames = np.count_nonzero(valid & usable, axis=1) > MOST_MISSING * np.count_nonzero(usable)
    enough = frames.sum() >= fewest
    complete = usable & enough & np.all(valid[frames], axis=0)
    # Flag and clear, in place, pixels that lack a frame; all pixels where frames are too few.
    status[usable & ~complete] |= np.uint32(Status.INVALID_SAMPLES)
    counts[:, :, usable & ~complete] = 0.0
    return [(frames, complete)] if np.any(complete) else []


def sample(corrected: xr.Dataset, pixels: int, *, bridged: bool = False) -> tuple[Array, Mask]:
    """Counts (band, time, pixel) [count] of about so many good pixels, and their frames (time)."""
    length = corrected.sizes["time"]
    if length > _LONG:  # the step is rounded down: up to four times as many pixels are read
        pixels = max(1, pixels * _LONG // (4 * length))
    step = stride((corrected.sizes["y"], corrected.sizes["x"]), pixels)
    # Pixels on an even grid, at the frames that most of them have.
    grid = slice(None, None, step)
    counts, valid, status = read(corrected.isel(y=grid, x=grid))
    # Good pixels have no bit but that of frozen frames.
    good = (status & ~np.uint32(Status.FROZEN_FRAMES)) == 0
    frames = np.mean(valid[:, good], axis=1) > MOST_MISSING if np.any(good) else good[:0]
    mask = good & np.all(valid[frames], axis=0) if np.any(good) else good
    if mask.any() or not (bridged and good.any()):
        return counts[:, frames][:, :, mask], frames
    # Where no pixel has all of these frames, those that lack few are bridged, if asked.
    good &= np.mean(valid[frames], axis=0) > 1.0 - MOST_BRIDGED
    films = np.where(valid, counts, np.nan)[:, frames][:, :, good]
    return np.stack([smooth.bridge(film, good[good]) for film in films]), frames


def _frozen(same: list[Mask], valid: Mask, chances: list[float]) -> tuple[Mask, Mask]:
    """Pixels (pixel) frozen in a band or all, and frames (time) in which a band is a copy."""
    # `same`: samples that repeat the sample before, by band.
    copied = [samples.copies(*pair, valid) for pair in zip(same, chances, strict=True)]
    pixels = samples.frozen(reduce(np.logical_and, same), float(np.prod(chances)))
    for band, copy, chance in zip(same, copied, chances, strict=True):
        pixels |= samples.frozen(band, chance) | samples.frozen(copy[:, np.newaxis], 0.0)
    return pixels, np.any(copied, axis=0)
