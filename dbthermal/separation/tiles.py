"""Tiles: a capture is read in blocks of rows, and separated a few hundred pixels at a time.

So the memory beyond the result stays small, a lazy capture is never read whole, and every tile
fits in the processor's cache.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import schema
from dbthermal.separation.problem import Array, Flags, Mask, Problem, Separated, flag

Tile = tuple[slice, slice]
"""Rows and columns of a tile."""

Known = tuple[Array, Array] | None
"""Emissivity and its standard deviation, each (band, y, x), or none."""

_PIXELS: Final = 320
_BLOCK_ROWS: Final = 32
# Frames in a row that noise repeats by chance in less than one of 1e8 pixels.
_FROZEN_FRAMES: Final = 4
_ALL_UNDEFINED: Final = ("invalid_samples", "constant_signal", "dead_pixel")


def blocks(corrected: xr.Dataset) -> Iterator[slice]:
    """
    Blocks of rows, each read at once: a lazy capture is then decoded about once.

    Parameters
    ----------
    corrected : Dataset
        The capture.

    Yields
    ------
    slice
        Rows.
    """
    height = corrected.sizes["y"]
    for top in range(0, height, _BLOCK_ROWS):
        yield slice(top, min(top + _BLOCK_ROWS, height))


def rows_of(given: Known, rows: slice) -> Known:
    """
    Known emissivities of a block of rows.

    Parameters
    ----------
    given : tuple of ndarray or None
        From `known_emissivity`.
    rows : slice
        The block.

    Returns
    -------
    tuple of ndarray or None
        The same of these rows.
    """
    return None if given is None else (given[0][:, rows], given[1][:, rows])


def cover(corrected: xr.Dataset) -> Iterator[Tile]:
    """
    Tiles that cover the image, along rows.

    Parameters
    ----------
    corrected : Dataset
        The capture.

    Yields
    ------
    tuple of slice
        Rows and columns.
    """
    height, width = corrected.sizes["y"], corrected.sizes["x"]
    columns = min(width, _PIXELS)
    rows = max(1, _PIXELS // columns)
    for top in range(0, height, rows):
        for left in range(0, width, columns):
            yield slice(top, min(top + rows, height)), slice(left, min(left + columns, width))


def read(corrected: xr.Dataset, tile: Tile) -> tuple[Array, Flags]:
    """
    Counts of a tile, and what is wrong with its pixels.

    Parameters
    ----------
    corrected : Dataset
        The capture.
    tile : tuple of slice
        Rows and columns.

    Returns
    -------
    tuple of ndarray
        Counts (band, time, pixel) [count], with the pixels that nothing can be computed of set
        to zero; status (pixel).
    """
    rows, columns = tile
    part = corrected.isel(y=rows, x=columns)
    raw = part["counts"].values
    raw = raw.reshape(*raw.shape[:2], -1)
    counts = raw.astype(np.float64)
    invalid = ~np.all(np.isfinite(counts), axis=(0, 1))
    counts[:, :, invalid] = 0.0
    constant = np.any(counts.max(axis=1) == counts.min(axis=1), axis=0) & ~invalid
    status = flag(
        {
            "invalid_samples": invalid,
            "constant_signal": constant & (counts.shape[1] > 1),
            "saturated": _saturated(raw),
            "frozen_frames": _frozen(counts) & ~invalid & ~constant,
        }
    )
    if "status" in corrected:
        status |= part["status"].values.reshape(-1).astype(np.uint16)
    return counts, status


def _saturated(raw: npt.NDArray[Any]) -> Mask:
    """Where whole-number counts reach an end of their type."""
    if raw.dtype.kind not in "ui":
        return np.zeros(raw.shape[-1], dtype=bool)
    ends = np.iinfo(raw.dtype)
    return np.asarray(np.any((raw == ends.max) | (raw == max(ends.min, 0)), axis=(0, 1)))


def _frozen(counts: Array) -> Mask:
    """Where both bands repeat their counts in several frames in a row."""
    if counts.shape[1] <= _FROZEN_FRAMES:
        return np.zeros(counts.shape[2], dtype=bool)
    same = np.all(counts[:, 1:] == counts[:, :-1], axis=0)
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
    unknown = status.values & ~np.asarray(sum(schema.FLAGS.values()), dtype=status.dtype)
    if np.any(unknown):
        raise ValueError(
            f"Unknown bits {int(unknown.max())} in the status. Must be of {dict(schema.FLAGS)}."
        )


def sample(corrected: xr.Dataset, pixels: int) -> Array:
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
    ndarray, shape (band, time, pixel)
        Counts [count] of pixels without any flag but that of frozen frames.
    """
    height, width = corrected.sizes["y"], corrected.sizes["x"]
    step = max(1, int(np.sqrt(height * width / pixels)))
    part = corrected.isel(y=slice(None, None, step), x=slice(None, None, step))
    counts, status = read(part, (slice(None), slice(None)))
    return counts[:, :, (status & ~np.uint16(schema.FLAGS["frozen_frames"])) == 0]


def known_emissivity(
    corrected: xr.Dataset, emissivity: xr.DataArray | None, std: xr.DataArray | None
) -> Known:
    """
    Check known emissivities and spread them over the image.

    Parameters
    ----------
    corrected : Dataset
        The capture.
    emissivity, std : DataArray, optional
        Emissivity and its standard deviation, (band) or (band, y, x) [1]; without a coordinate
        `band`, in the capture's order.

    Returns
    -------
    tuple of ndarray or None
        Both as (band, y, x), in the capture's order of bands; None where none is given.

    Raises
    ------
    TypeError
        If one is not a DataArray.
    ValueError
        If a band is missing, dims differ, a value is not in (0, 1), a deviation is negative, or
        the bands have the same emissivity everywhere.
    """
    if emissivity is None:
        if std is not None:
            raise ValueError("Invalid emissivity_std without an emissivity. Give both.")
        return None
    values = _spread(corrected, emissivity, "emissivity")
    bad = ~((values > 0) & (values < 1))
    if np.any(bad):
        band, y, x = np.argwhere(bad)[0]
        raise ValueError(
            f"Invalid emissivity {values[band, y, x]} in band "
            f"'{corrected['band'].values[band]}', pixel ({y}, {x}). Must lie in (0, 1)."
        )
    if np.all(values[0] == values[1]):
        raise ValueError(
            f"Invalid emissivities {values[:, 0, 0]}: the same in both bands. Must differ; "
            "a gray body cannot be separated."
        )
    deviations = np.zeros_like(values) if std is None else _spread(corrected, std, "emissivity_std")
    if not np.all(deviations >= 0):
        raise ValueError("Invalid emissivity_std. Must be zero or positive, not NaN.")
    return values, deviations


def _spread(corrected: xr.Dataset, array: xr.DataArray, what: str) -> Array:
    if not isinstance(array, xr.DataArray):
        raise TypeError(f"Invalid {what} of type {type(array).__name__}. Must be a DataArray.")
    if array.dims not in (("band",), ("band", "y", "x")):
        raise ValueError(
            f"Invalid dims {array.dims} of {what}. Must be ('band',) or ('band', 'y', 'x')."
        )
    if array.attrs.get("units", "1") != "1":
        raise ValueError(f"Invalid units '{array.attrs['units']}' of {what}. Must be '1'.")
    wanted = [str(name) for name in corrected["band"].values]
    if "band" not in array.coords and array.sizes["band"] == len(wanted):
        places = list(range(len(wanted)))  # unlabelled dimensions align by position, as in xarray
    else:
        places = schema.band_positions(array, wanted, what)
    values = array.values[places].astype(np.float64)
    shape = (2, corrected.sizes["y"], corrected.sizes["x"])
    if values.ndim == 3 and values.shape != shape:
        raise ValueError(f"Invalid shape {values.shape} of {what}. Must be {shape}.")
    return np.broadcast_to(values.reshape(2, *values.shape[1:] or (1, 1)), shape)


def with_emissivity(problem: Problem, given: Known, tile: Tile, bands: list[int]) -> Problem:
    """
    Add a tile's known emissivities to its problem.

    Parameters
    ----------
    problem : Problem
        The tile's signals.
    given : tuple of ndarray or None
        From `known_emissivity`.
    tile : tuple of slice
        Rows and columns.
    bands : list of int
        Order of the problem's bands in the capture.

    Returns
    -------
    Problem
        The same problem, with `emissivity` and `emissivity_std` where given.
    """
    if given is None:
        return problem
    value, std = (array[(slice(None), *tile)].reshape(2, -1)[bands] for array in given)
    return replace(problem, emissivity=value, emissivity_std=std)


def allocate(corrected: xr.Dataset, given: Known) -> xr.Dataset:
    """
    Make an empty result of the stage `separated`.

    Parameters
    ----------
    corrected : Dataset
        The capture.
    given : tuple of ndarray or None
        Known emissivities, which the result's attributes mention.

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
        if name in ("origin", "radiometric", "source")
    }
    arrays = {}
    for name, variable in schema.STAGES["separated"].items():
        shape = tuple(corrected.sizes[dim] for dim in variable.dims)
        attrs = schema.status_attrs() if name == "status" else variable.attrs
        attrs = {**attrs, **kept}
        empty = np.empty(shape, dtype=variable.dtype)
        arrays[name] = xr.DataArray(empty, dims=variable.dims, attrs=attrs)
    source = "capture" if given is None else "given"
    return xr.Dataset(arrays, coords=coordinates, attrs={**kept, "emissivity_source": source})


def write(
    result: xr.Dataset, tile: Tile, bands: list[int], found: Separated, status: Flags
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
    found : Separated
        What the method found.
    status : ndarray of uint16, shape (pixel,)
        From `read`; pixels that nothing can be computed of become NaN and keep only these bits.
    """
    rows, columns = tile
    shape = (rows.stop - rows.start, columns.stop - columns.start)
    masks = sum(schema.FLAGS[name] for name in _ALL_UNDEFINED)
    unusable = (status & np.uint16(masks)) != 0
    for name in schema.STAGES["separated"]:
        values = getattr(found, name)
        if name == "status":
            values = np.where(unusable, status, status | values)
        else:
            values[..., unusable] = np.nan
        values = values.reshape(*values.shape[:-1], *shape)
        target = result[name].values
        for index in range(2) if name.startswith("emissivity") else (...,):
            place = bands[index] if isinstance(index, int) else ...
            target[(place, rows, columns)] = values[index]
