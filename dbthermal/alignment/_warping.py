"""Resampling of views over their pixels: registration, and the shift of what is mirrored."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.ndimage import map_coordinates

from dbthermal import _rows, schema
from dbthermal._coordinates import laid_on

Array = npt.NDArray[np.float64]
Movie = npt.NDArray[np.float32]

# A pixel position is rounded to this, so that a border met exactly is not missed [pixel].
_DIGITS: Final = 9


def positions(matrix: Array, shape: tuple[int, ...]) -> Array:
    r"""
    Row and column (2, y, x) [pixel], in another view, of the pixels of the first.

    .. math:: (x', y', 1)^T \propto H (x, y, 1)^T, counted from 0 at the centre of the first pixel.
    """
    rows, columns = np.indices(shape, dtype=np.float64)
    column, row, scale = np.einsum(
        "ij,jyx->iyx", matrix, np.stack([columns, rows, np.ones_like(rows)])
    )
    return np.asarray(np.round(np.stack([row, column]) / scale, _DIGITS))


def registered(corrected: xr.Dataset, matrices: Array, *, lazy: bool) -> tuple[xr.Dataset, Array]:
    """
    All views, and the status, on the first one's grid.

    Also the deviation (band) [1] of independent pixels over that before, root mean square.
    """
    shape = corrected["counts"].shape[2:]
    places = [
        None if np.array_equal(matrix, np.eye(3)) else positions(matrix, shape)
        for matrix in matrices
    ]
    factors = np.ones(len(places))
    for band, place in enumerate(places):
        if place is not None:
            weight = place % 1.0  # bilinear: 1 - w and w along each axis
            factors[band] = np.sqrt(np.prod((1.0 - weight) ** 2 + weight**2, axis=0).mean())
    return _resampled(corrected, places, lazy=lazy), factors


def displaced(corrected: xr.Dataset, field: xr.Dataset, *, lazy: bool) -> xr.Dataset:
    """Views of which all show the same reflection at a pixel; NaN where the field is not known."""
    field = laid_on(
        schema.check(field, "reflection_shift"), corrected, "the reflection shift", "the capture"
    )
    shift = field["shift"].where(field["known"]).transpose("axis", "y", "x").values
    place = np.indices(shift.shape[1:], dtype=np.float64) + shift
    reference = str(field.attrs["reference_band"])
    places = [place if str(band) == reference else None for band in corrected["band"].values]
    return _resampled(corrected, places, lazy=lazy)


def single(counts: npt.NDArray[Any]) -> Movie:
    """Counts in single precision, NaN where they are infinite or beyond it."""
    return np.where(schema.measured(counts), counts, np.nan).astype(np.float32, copy=False)


def _resampled(corrected: xr.Dataset, places: Sequence[Array | None], *, lazy: bool) -> xr.Dataset:
    """Counts and status of each view at places (2, y, x) [pixel]; as they are, for none."""
    counts = corrected["counts"]

    def views(rows: slice) -> Movie:
        """Some rows of all bands."""
        result = np.empty(counts[:, :, rows].shape, dtype=np.float32)
        for out, view, place in zip(result, counts, places, strict=True):
            out[...] = (
                single(view.isel(y=rows).values) if place is None else _at(view, place[:, rows])
            )
        return result

    moved = _rows.lazy(views, counts) if lazy else counts.copy(data=views(slice(None)))
    result = corrected.assign(counts=moved)
    if "status" in corrected:
        status = corrected["status"]
        result = result.assign(status=status.copy(data=_status_at(status, places)))
    return result


def _at(view: xr.DataArray, place: Array) -> Movie:
    """Samples (time, ...) of a view at places (2, ...), bilinear; NaN outside of it."""
    with np.errstate(invalid="ignore"):
        last = np.array(view.shape[1:])[:, np.newaxis, np.newaxis] - 1
        inside = np.all((place >= 0) & (place <= last), axis=0)
    result = np.full((len(view), *inside.shape), np.nan, dtype=np.float32)
    if not inside.any():
        return result
    top, bottom = (int(end(place[0][inside])) for end in (np.min, np.max))
    frames = single(view.isel(y=slice(top, bottom + 2)).values)
    wanted = place[:, inside] - np.array([[top], [0]])
    for frame, out in zip(frames, result, strict=True):
        # Beside the border "nearest" only meets a weight of zero.
        out[inside] = map_coordinates(frame, wanted, order=1, mode="nearest")
    return result


def _status_at(status: xr.DataArray, places: Sequence[Array | None]) -> npt.NDArray[Any]:
    """Bits of every pixel that a resampled one may be made of, in any of the views."""
    result, bits = np.zeros_like(status.values), np.unique(status.values)
    for place in places:
        for value in bits[bits > 0]:
            share = (status.values == value).astype(np.float64)
            if place is not None:
                outside = np.nan_to_num(place, nan=-2.0)
                share = map_coordinates(share, outside, order=1, mode="constant")
            result[share > 0] |= value
    return result
