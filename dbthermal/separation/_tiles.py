"""Tiles: a capture is read in blocks of rows, and separated a few hundred pixels at a time.

So the memory beyond the result stays small, a lazy capture is never read whole, and every tile
fits in the processor's cache.
"""

from collections.abc import Iterator
from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import schema
from dbthermal.separation._separated import Array, Flags, Mask, Separated

Tile = tuple[slice, slice]
"""Rows and columns of a tile."""

PIXELS: Final = 320
"""Pixels in a tile, unless a method sets its own number."""

_BLOCK_ROWS: Final = 32


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
    there: Mask,
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
    status : ndarray of uint32, shape (pixel,)
        From `read`; pixels of no part become NaN and keep only these bits.
    there : ndarray of bool, shape (time, pixel)
        Frames that the capture has; the temperatures of others are NaN.
    parts : list of tuple
        Frames (time), pixels (pixel), and what the method found there; NaN in other frames.
    """
    rows, columns = tile
    shape = shape_of(tile)
    complete = any(np.all(frames) and np.all(pixels) for frames, pixels, _ in parts)
    for name, variable in schema.STAGES["separated"].items():
        target = result[name].values[..., rows, columns]
        if name == "status":
            target[...] = status.reshape(shape)
        elif not complete or any(getattr(found, name) is None for _, _, found in parts):
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
        if "time" in variable.dims and not np.all(there):
            target[~there.reshape(-1, *shape)] = np.nan


def _put(target: npt.NDArray[np.floating], frames: Mask, where: Mask, values: Array) -> None:
    """Put values (time, pixel) at some frames and pixels of (time, y, x), in place."""
    if np.all(frames) and np.all(where):
        target[...] = values.reshape(target.shape)
        return
    rows, columns = np.nonzero(where)
    target[np.flatnonzero(frames)[:, np.newaxis], rows, columns] = values
