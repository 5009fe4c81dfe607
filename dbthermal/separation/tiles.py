"""Tiles: a capture is read in blocks of rows, and separated a few hundred pixels at a time.

So the memory beyond the result stays small, a lazy capture is never read whole, and every tile
fits in the processor's cache.
"""

from collections.abc import Iterator
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import schema
from dbthermal.separation.problem import Array, Flags, Mask, Separated, flag

Tile = tuple[slice, slice]
"""Rows and columns of a tile."""

PIXELS: Final = 320
"""Pixels in a tile, unless a method sets its own number."""

MOST_MISSING: Final = 0.5
"""Share of the frames without which a pixel is not solved."""

_BLOCK_ROWS: Final = 32
# Frames in a row that noise repeats by chance in less than one of 1e8 pixels.
_FROZEN_FRAMES: Final = 4
_ALL_UNDEFINED: Final = ("invalid_samples", "constant_signal", "dead_pixel")


def blocks(corrected: xr.Dataset, *, whole_image: bool = False) -> Iterator[slice]:
    """
    Blocks of rows, each read at once: a lazy capture is then decoded about once.

    Parameters
    ----------
    corrected : Dataset
        The capture.
    whole_image : bool
        All rows in one block.

    Yields
    ------
    slice
        Rows.
    """
    height = corrected.sizes["y"]
    rows = height if whole_image else _BLOCK_ROWS
    for top in range(0, height, rows):
        yield slice(top, min(top + rows, height))


def cover(corrected: xr.Dataset, pixels: int = PIXELS) -> Iterator[Tile]:
    """
    Tiles that cover the image, along rows.

    Parameters
    ----------
    corrected : Dataset
        The capture.
    pixels : int
        Pixels in a tile, at most.

    Yields
    ------
    tuple of slice
        Rows and columns.
    """
    height, width = corrected.sizes["y"], corrected.sizes["x"]
    columns = min(width, pixels)
    rows = max(1, pixels // columns)
    for top in range(0, height, rows):
        for left in range(0, width, columns):
            yield slice(top, min(top + rows, height)), slice(left, min(left + columns, width))


def moved(tile: Tile, top: int) -> Tile:
    """
    Place of a block's tile in the whole image.

    Parameters
    ----------
    tile : tuple of slice
        Rows and columns in the block.
    top : int
        First row of the block.

    Returns
    -------
    tuple of slice
        Rows and columns in the image.
    """
    return slice(tile[0].start + top, tile[0].stop + top), tile[1]


def generator(seed: int, tile: Tile) -> np.random.Generator:
    """
    A tile's own source of randomness, independent of all others of this seed.

    Parameters
    ----------
    seed : int
        Seed.
    tile : tuple of slice
        Rows and columns in the image.

    Returns
    -------
    Generator
        The same for the same seed and place, and not that of the seed itself.
    """
    key = (tile[0].start, tile[1].start)
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))


def shape_of(tile: Tile) -> tuple[int, int]:
    """
    Size of a tile.

    Parameters
    ----------
    tile : tuple of slice
        Rows and columns.

    Returns
    -------
    tuple of int
        Number of rows and of columns.
    """
    return tile[0].stop - tile[0].start, tile[1].stop - tile[1].start


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
        (pixel).
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
            "saturated": _saturated(raw),
            "frozen_frames": _frozen(counts, there) & ~invalid & ~constant,
        }
    )
    if "status" in corrected:
        status |= part["status"].values.reshape(-1).astype(np.uint16)
    counts[:, :, unusable(status)] = 0.0
    return counts, there, status


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


def unusable(status: Flags) -> Mask:
    """
    Where nothing can be computed.

    Parameters
    ----------
    status : ndarray of uint16
        Bits.

    Returns
    -------
    ndarray of bool
        True for such a pixel.
    """
    masks = sum(schema.FLAGS[name] for name in _ALL_UNDEFINED)
    return np.asarray((status & np.uint16(masks)) != 0)


def _saturated(raw: npt.NDArray[Any]) -> Mask:
    """Where whole-number counts reach an end of their type."""
    if raw.dtype.kind not in "ui":
        return np.zeros(raw.shape[-1], dtype=bool)
    ends = np.iinfo(raw.dtype)
    return np.asarray(np.any((raw == ends.max) | (raw == max(ends.min, 0)), axis=(0, 1)))


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
    good = (status & ~np.uint16(schema.FLAGS["frozen_frames"])) == 0
    frames = np.mean(there[:, good], axis=1) > MOST_MISSING if np.any(good) else good[:0]
    good &= np.all(there[frames], axis=0) if np.any(good) else False
    return counts[:, frames][:, :, good], frames


def allocate(corrected: xr.Dataset) -> xr.Dataset:
    """
    Make an empty result of the stage `separated`.

    Parameters
    ----------
    corrected : Dataset
        The capture.

    Returns
    -------
    Dataset
        Variables of `schema.STAGES["separated"]`, not yet filled; coordinates of the capture.
    """
    coordinates = {
        name: corrected[name] for name in ("band", "time", "y", "x") if name in corrected.coords
    }
    kept = {
        name: value
        for name, value in corrected.attrs.items()
        if name in ("origin", "radiometric", "source", "twin")
    }
    arrays = {}
    for name, variable in schema.STAGES["separated"].items():
        shape = tuple(corrected.sizes[dim] for dim in variable.dims)
        attrs = schema.status_attrs() if name == "status" else variable.attrs
        attrs = {**attrs, **kept}
        empty = np.empty(shape, dtype=variable.dtype)
        arrays[name] = xr.DataArray(empty, dims=variable.dims, attrs=attrs)
    return xr.Dataset(arrays, coords=coordinates, attrs=kept)


def write(
    result: xr.Dataset,
    tile: Tile,
    bands: list[int],
    status: Flags,
    parts: list[tuple[Mask, Mask, Separated]],
) -> None:
    """
    Put a tile's result in its place.

    Parameters
    ----------
    result : Dataset
        From `allocate`; filled in place.
    tile : tuple of slice
        Rows and columns.
    bands : list of int
        Order of the problem's bands in the capture.
    status : ndarray of uint16, shape (pixel,)
        From `read`; pixels of no part become NaN and keep only these bits.
    parts : list of tuple
        Frames (time), pixels (pixel), and what the method found there; NaN in other frames.
    """
    rows, columns = tile
    shape = shape_of(tile)
    for name, variable in schema.STAGES["separated"].items():
        target = result[name].values[..., rows, columns]
        if name == "status":
            target[...] = status.reshape(shape)
        else:
            target[...] = np.nan
        for frames, pixels, found in parts:
            values = getattr(found, name)
            if values is None:
                continue
            where = pixels.reshape(shape)
            if name == "status":
                target[where] |= values
            elif "band" in variable.dims:
                for index, band in enumerate(bands):
                    target[band][where] = values[index]
            else:
                _put(target, frames, where, values)


def _put(target: npt.NDArray[np.floating], frames: Mask, where: Mask, values: Array) -> None:
    """Put values (time, pixel) at some frames and pixels of (time, y, x), in place."""
    if np.all(frames) and np.all(where):
        target[...] = values.reshape(target.shape)
        return
    rows, columns = np.nonzero(where)
    target[np.flatnonzero(frames)[:, np.newaxis], rows, columns] = values
