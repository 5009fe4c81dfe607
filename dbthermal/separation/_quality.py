"""Samples of a tile: which are there, and which pixels cannot be used."""

from collections.abc import Iterator
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import schema
from dbthermal.separation._separated import Array, Flags, Mask, flag
from dbthermal.separation._tiles import Tile

MOST_MISSING: Final = 0.5
"""Share of the frames without which a pixel is not solved."""

LONGEST_GAP: Final = 2
"""Frames in a row that may be bridged in a pixel."""

MOST_BRIDGED: Final = 0.15
"""Share of the frames from which a pixel lacks too many to be bridged."""

# Frames in a row that noise repeats by chance in less than one of 1e8 pixels.
_FROZEN_FRAMES: Final = 4
_ALL_UNDEFINED: Final = ("invalid_samples", "constant_signal", "dead_pixel")


def read(corrected: xr.Dataset, tile: Tile, fewest: int = 1) -> tuple[Array, Mask, Flags]:
    """
    Counts of a tile, which of them are there, and what is wrong with its pixels.

    Parameters
    ----------
    corrected : Dataset
        The capture; a variable `mask`, (time), (y, x) or (time, y, x), marks what to use.
    tile : tuple of slice
        Rows and columns.
    fewest : int
        Frames without which a pixel cannot be solved.

    Returns
    -------
    tuple of ndarray
        Counts (band, time, pixel) [count], zero where they are missing and for pixels that
        nothing can be computed of; which frames are there in all bands (time, pixel); status
        (pixel). See `bridged` for pixels that lack a few.
    """
    part = corrected.isel(y=tile[0], x=tile[1])
    raw = part["counts"].values
    raw = raw.reshape(*raw.shape[:2], -1)
    counts = raw.astype(np.float64)
    there = np.all(np.isfinite(counts), axis=0)
    if "mask" in part:
        there &= part["mask"].broadcast_like(part["counts"][0]).values.reshape(there.shape)
    counts[:, ~there] = 0.0
    frames = there.sum(axis=0)
    invalid = frames < max(fewest, MOST_MISSING * len(there))
    highest = counts.max(axis=1, where=there, initial=-np.inf)
    lowest = counts.min(axis=1, where=there, initial=np.inf)
    constant = np.any(highest == lowest, axis=0) & ~invalid
    status = flag(
        {
            "invalid_samples": invalid,
            "constant_signal": constant & (frames > 1),
            "saturated": _saturated(raw, there),
            "frozen_frames": _frozen(counts, there) & ~invalid & ~constant,
        }
    )
    if "status" in corrected:
        status |= part["status"].values.reshape(-1).astype(np.uint32)
    counts[:, :, unusable(status)] = 0.0
    return counts, there, status


def bridged(counts: Array, there: Mask, time: Array) -> tuple[Array, Mask]:
    """
    Bridge short gaps of single pixels by a line in all bands.

    A line between the same two frames in all bands holds the same mixture of object and
    background, so nothing is biased, and all pixels of a tile keep the same frames. The result of
    such a frame is no measurement, and is not given.

    Parameters
    ----------
    counts : ndarray, shape (band, time, pixel)
        Counts [count].
    there : ndarray of bool, shape (time, pixel)
        Which frames each pixel has.
    time : ndarray, shape (time,)
        Times [s].

    Returns
    -------
    tuple of ndarray
        Counts, and which frames are there or bridged: gaps of `LONGEST_GAP` frames that most other
        pixels have, in pixels that lack few.
    """
    common = there.mean(axis=1) > MOST_MISSING
    wanted = ~there & common[:, np.newaxis]
    wanted &= wanted.sum(axis=0) < MOST_BRIDGED * len(there)
    if not np.any(wanted):
        return counts, there
    place = np.arange(len(there))[:, np.newaxis]
    before = np.maximum.accumulate(np.where(there, place, -1), axis=0)
    after = np.minimum.accumulate(np.where(there, place, len(there))[::-1], axis=0)[::-1]
    wanted &= (before >= 0) & (after < len(there)) & (after - before <= LONGEST_GAP + 1)
    frame, pixel = np.nonzero(wanted)
    first, last = before[frame, pixel], after[frame, pixel]
    share = (time[frame] - time[first]) / (time[last] - time[first])
    filled = counts.copy()
    filled[:, frame, pixel] = (1.0 - share) * counts[:, first, pixel] + share * counts[
        :, last, pixel
    ]
    return filled, there | wanted


def patterns(there: Mask, unusable: Mask) -> Iterator[tuple[Mask, Mask]]:
    """
    Pixels that have the same frames.

    Parameters
    ----------
    there : ndarray of bool, shape (time, pixel)
        Which frames each pixel has.
    unusable : ndarray of bool, shape (pixel,)
        Pixels that nothing can be computed of.

    Yields
    ------
    tuple of ndarray of bool
        Frames (time), and the pixels (pixel) that have these and no others.
    """
    if np.all(unusable):
        return
    if np.all(there[:, ~unusable]):
        yield np.ones(there.shape[0], dtype=bool), ~unusable
        return
    packed = np.packbits(there, axis=0)
    _, first, group = np.unique(packed, axis=1, return_index=True, return_inverse=True)
    for index, pixel in enumerate(first):
        pixels = (group.ravel() == index) & ~unusable
        if np.any(pixels):
            yield there[:, pixel], pixels


def common(there: Mask, unusable: Mask, fewest: int = 1) -> tuple[Mask, Mask]:
    """
    Frames that most of the pixels have, for methods that need the same of all.

    Parameters
    ----------
    there : ndarray of bool, shape (time, pixel)
        Which frames each pixel has.
    unusable : ndarray of bool, shape (pixel,)
        Pixels that nothing can be computed of.
    fewest : int
        Frames without which no pixel can be solved.

    Returns
    -------
    tuple of ndarray of bool
        These frames (time), and the usable pixels (pixel) that lack any of them; all of the usable
        pixels where these frames are too few.
    """
    if np.all(unusable):
        return np.ones(there.shape[0], dtype=bool), np.zeros_like(unusable)
    frames = np.mean(there[:, ~unusable], axis=1) > MOST_MISSING
    enough = frames.sum() >= fewest
    return frames, ~unusable & ~(enough & np.all(there[frames], axis=0))


def unusable(status: Flags) -> Mask:
    """
    Where nothing can be computed.

    Parameters
    ----------
    status : ndarray of uint32
        Bits.

    Returns
    -------
    ndarray of bool
        True for such a pixel.
    """
    masks = sum(schema.FLAGS[name] for name in _ALL_UNDEFINED)
    return np.asarray((status & np.uint32(masks)) != 0)


def _saturated(raw: npt.NDArray[Any], there: Mask) -> Mask:
    """Where whole-number counts that are used reach an end of their type."""
    if raw.dtype.kind not in "ui":
        return np.zeros(raw.shape[-1], dtype=bool)
    ends = np.iinfo(raw.dtype)
    at_an_end = (raw == ends.max) | (raw == max(ends.min, 0))
    return np.asarray(np.any(at_an_end & there, axis=(0, 1)))


def _frozen(counts: Array, there: Mask) -> Mask:
    """Where both bands repeat their counts in several frames in a row."""
    if counts.shape[1] <= _FROZEN_FRAMES:
        return np.zeros(counts.shape[2], dtype=bool)
    same = np.all(counts[:, 1:] == counts[:, :-1], axis=0) & there[1:] & there[:-1]
    run = same[: same.shape[0] - _FROZEN_FRAMES + 1].copy()
    for shift in range(1, _FROZEN_FRAMES):
        run &= same[shift : shift + run.shape[0]]
    return np.asarray(np.any(run, axis=0))


def check_status(corrected: xr.Dataset) -> None:
    """
    Check a status that the capture brings along.

    Parameters
    ----------
    corrected : Dataset
        The capture.

    Raises
    ------
    ValueError
        If its `status` is not (y, x) of unsigned integers with bits of `schema.FLAGS`.
    """
    if "status" not in corrected:
        return
    status = corrected["status"]
    if status.dims != ("y", "x") or status.dtype.kind not in "ui":
        raise ValueError(
            f"Invalid status {status.dims} of {status.dtype}. Must be ('y', 'x') of whole numbers."
        )
    unknown = status.values.astype(np.int64) & ~sum(schema.FLAGS.values())
    if np.any(unknown):
        raise ValueError(
            f"Unknown bits {int(unknown.max())} in the status. Must be of {dict(schema.FLAGS)}."
        )


def sample(corrected: xr.Dataset, pixels: int) -> tuple[Array, Mask]:
    """
    Counts of usable pixels spread evenly over the image.

    Parameters
    ----------
    corrected : Dataset
        The capture.
    pixels : int
        About how many.

    Returns
    -------
    tuple of ndarray
        Counts (band, time, pixel) [count] of pixels without any flag but that of frozen frames, at
        the frames that most of them have; and which frames these are (time).
    """
    height, width = corrected.sizes["y"], corrected.sizes["x"]
    step = max(1, int(np.sqrt(height * width / pixels)))
    part = corrected.isel(y=slice(None, None, step), x=slice(None, None, step))
    counts, there, status = read(part, (slice(None), slice(None)))
    good = (status & ~np.uint32(schema.FLAGS["frozen_frames"])) == 0
    frames = np.mean(there[:, good], axis=1) > MOST_MISSING if np.any(good) else good[:0]
    good &= np.all(there[frames], axis=0) if np.any(good) else False
    return counts[:, frames][:, :, good], frames
