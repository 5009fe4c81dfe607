"""Checks of what a user gives beside the capture: emissivities, mask, materials."""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import schema
from dbthermal.separation._problem import Problem
from dbthermal.separation._separated import Array
from dbthermal.separation._tiles import Tile


@dataclass(frozen=True)
class Given:
    """Known emissivities and their standard deviations (band, y, x) [1] of the whole image."""

    emissivity: Array | None = None
    emissivity_std: Array | None = None

    def put_into(self, problem: Problem, tile: Tile, bands: list[int]) -> Problem:
        """Add the emissivities of a tile, at rows and columns of the image, to its problem."""
        if self.emissivity is None or self.emissivity_std is None:
            return problem
        value, std = (
            array[(slice(None), *tile)].reshape(len(bands), -1)[bands]
            for array in (self.emissivity, self.emissivity_std)
        )
        return replace(problem, emissivity=value, emissivity_std=std)


def known_emissivity(
    corrected: xr.Dataset, emissivity: xr.DataArray | None, std: xr.DataArray | None
) -> tuple[Array, Array] | None:
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
    shape = (len(wanted), corrected.sizes["y"], corrected.sizes["x"])
    if values.ndim == 3 and values.shape != shape:
        raise ValueError(f"Invalid shape {values.shape} of {what}. Must be {shape}.")
    return np.broadcast_to(values.reshape(2, *values.shape[1:] or (1, 1)), shape)


def labels(corrected: xr.Dataset, pool: xr.DataArray | None) -> npt.NDArray[np.intp] | None:
    """
    Check labels of materials.

    Parameters
    ----------
    corrected : Dataset
        The capture.
    pool : DataArray, optional
        (y, x), integer; negative for pixels that share nothing.

    Returns
    -------
    ndarray of int or None
        Labels (pixel), numbered from 0 without gaps, -1 for none.

    Raises
    ------
    TypeError
        If they are not a DataArray of integers.
    ValueError
        If their dims or sizes are not the capture's.
    """
    if pool is None:
        return None
    if not isinstance(pool, xr.DataArray):
        raise TypeError(f"Invalid pool of type {type(pool).__name__}. Must be a DataArray.")
    if pool.dtype.kind not in "iu":
        raise TypeError(f"Invalid dtype {pool.dtype} of the pool. Must be whole numbers.")
    sizes = {dim: corrected.sizes[dim] for dim in ("y", "x")}
    if pool.dims != ("y", "x") or dict(pool.sizes) != sizes:
        raise ValueError(f"Invalid pool {dict(pool.sizes)}. Must be {sizes}.")
    flat = pool.values.ravel()
    names = np.unique(flat[flat >= 0])
    return np.where(flat >= 0, np.searchsorted(names, flat), -1).astype(np.intp)


def with_mask(corrected: xr.Dataset, mask: xr.DataArray | None) -> xr.Dataset:
    """
    Check which samples to use, and the shutter's segments, beside the capture.

    Parameters
    ----------
    corrected : Dataset
        The capture; a `segment` (time) counts the shutter events before each frame.
    mask : DataArray, optional
        (time), (y, x) or (time, y, x), true for the samples to use.

    Returns
    -------
    Dataset
        The capture with the variable `mask`, where one is given.

    Raises
    ------
    TypeError
        If the mask is not a DataArray of booleans.
    ValueError
        If its dims or sizes are others, or a segment is no count of events.
    """
    if "segment" in corrected:
        segment = corrected["segment"]
        falling = segment.dtype.kind in "iu" and np.any(np.diff(segment.values.astype(int)) < 0)
        if segment.dims != ("time",) or segment.dtype.kind not in "iu" or falling:
            raise ValueError(
                f"Invalid segment {segment.dims} of {segment.dtype}. Must be ('time',) of whole "
                "numbers that do not fall."
            )
        events, frames = len(np.unique(segment)) - 1, segment.size
        if events > frames // 4:
            raise ValueError(
                f"Invalid segment: {events} shutter events in {frames} frames. "
                "Must be at most one in four."
            )
    if mask is None:
        return corrected.drop_vars("mask", errors="ignore")
    if not isinstance(mask, xr.DataArray):
        raise TypeError(f"Invalid mask of type {type(mask).__name__}. Must be a DataArray.")
    if mask.dtype != bool:
        raise TypeError(f"Invalid dtype {mask.dtype} of the mask. Must be bool.")
    sizes = {str(dim): corrected.sizes.get(str(dim), 0) for dim in mask.dims}
    allowed = (("time",), ("y", "x"), ("time", "y", "x"))
    if mask.dims not in allowed or dict(mask.sizes) != sizes:
        raise ValueError(
            f"Invalid mask {dict(mask.sizes)}. Must have dims of {allowed} and the capture's sizes."
        )
    return corrected.assign(mask=(mask.dims, mask.values))
