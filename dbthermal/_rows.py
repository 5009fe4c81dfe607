"""Arrays that are computed when they are read, some rows of the image at a time.

A long capture fits in memory raw, but not corrected as well. It is read like an array on disk, with
the memory of the selected rows.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from xarray.backends import BackendArray
from xarray.core import indexing

from dbthermal._arrays import empty, made_on_disk, release

Values = npt.NDArray[Any]

_BLOCK: Final = 2**24  # samples of a block that is computed at once


class _Rows(BackendArray):
    """Array (..., y, x) of float32 by a function of some rows, and columns."""

    dtype = np.dtype("float32")

    def __init__(self, compute: Callable[[slice, slice], Values], shape: tuple[int, ...]) -> None:
        self._compute, self.shape = compute, shape

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Values:
        kind = indexing.IndexingSupport.OUTER
        return np.asarray(indexing.explicit_indexing_adapter(key, self.shape, kind, self._read))

    def _read(self, key: tuple[Any, ...]) -> Values:
        """Values at a number, slice or array of indices along each dim."""
        # Compute the blocks that hold wanted rows.
        places = [np.arange(size)[index] for size, index in zip(self.shape, key, strict=True)]
        *leading, rows, columns = (np.atleast_1d(place) for place in places)
        result = np.empty([*map(len, leading), rows.size, columns.size], dtype=self.dtype)
        for block in blocks(self.shape):
            (wanted,) = np.nonzero((rows >= block.start) & (rows < block.stop))
            if wanted.size:
                first, last = rows[wanted].min(), rows[wanted].max()
                low, high = (int(end(columns)) if columns.size else 0 for end in (np.min, np.max))
                values = self._compute(slice(int(first), int(last) + 1), slice(low, high + 1))
                for axis, index in enumerate((*leading, rows[wanted] - first, columns - low)):
                    values = values[(slice(None),) * axis + (_even(index),)]
                result[..., _even(wanted), :] = values
                release()
        whole = (slice(None) if place.ndim else 0 for place in places)
        return np.asarray(result[tuple(whole)])


def _even(places: Values) -> Any:
    """Slice of rising indices with one step, which copies nothing; other indices as they are."""
    steps = np.unique(np.diff(places))
    if places.size == 0 or steps.size > 1 or np.any(steps < 1):
        return places
    return slice(int(places[0]), int(places[-1]) + 1, int(steps[0]) if steps.size else 1)


def blocks(shape: tuple[int, ...], samples: int = 0) -> Iterator[slice]:
    """Yield rows of an array (..., y, x) that are computed at once, about so many samples."""
    height = shape[-2]
    rows = max(1, min(height, (samples or _BLOCK) * height // max(1, int(np.prod(shape)))))
    for top in range(0, height, rows):
        yield slice(top, min(top + rows, height))


def windows(shape: tuple[int, ...], samples: int = 0) -> Iterator[tuple[slice, slice]]:
    """Yield rows and columns of an array (..., y, x), as `blocks`; parts of a row that has more."""
    column = int(np.prod(shape)) // max(1, shape[-2] * shape[-1])
    for rows in blocks(shape, samples):
        pixels = max(1, (samples or _BLOCK) // max(1, column * (rows.stop - rows.start)))
        for start in range(0, shape[-1], pixels):
            yield rows, slice(start, min(start + pixels, shape[-1]))


def slabs(dataset: xr.Dataset, rows: Iterable[slice]) -> Iterator[xr.Dataset]:
    """Yield blocks of rows of a dataset; the memory of those before is freed."""
    for block in rows:
        release()
        yield dataset.isel(y=block, missing_dims="ignore")


def lazy(compute: Callable[[slice], Values], like: xr.DataArray) -> xr.DataArray:
    """Array with the coordinates and attributes of another, computed by rows, on disk only once."""
    return by_pixels(lambda rows, columns: compute(rows)[..., columns], like)


def by_pixels(compute: Callable[[slice, slice], Values], like: xr.DataArray) -> xr.DataArray:
    """As `lazy`, by a function of rows and columns, that needs no others."""
    array = _Rows(compute, like.shape)
    if made_on_disk():  # all rows are computed once, into a film
        film = empty(like.shape, _Rows.dtype)
        for rows in blocks(like.shape):
            film[..., rows, :] = compute(rows, slice(None))
            release()
        array = _Rows(lambda rows, columns: film[..., rows, columns], like.shape)
    variable = xr.Variable(like.dims, indexing.LazilyIndexedArray(array), like.attrs)
    return xr.DataArray(variable, coords=like.coords, name=like.name)


def changed(like: xr.DataArray, change: Callable[[Values], Values], *, lazy: bool) -> xr.DataArray:
    """Array with other values, of the same type, by rows when they are read, or now."""

    def compute(rows: slice, columns: slice = slice(None)) -> Values:
        values = like.isel(y=rows, x=columns).values
        return np.asarray(change(values), dtype=values.dtype)

    return by_pixels(compute, like) if lazy else like.copy(data=compute(slice(None)))
