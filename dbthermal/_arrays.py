"""Types of arrays, films in memory or on disk, and arrays that are computed when they are read.

Films on disk are in files that vanish with the process, and are used as arrays. Their pages count
as the process's memory until they are released (`release`). A long capture fits in memory raw, but
not corrected as well: it is read like an array on disk, with the memory of the selected rows.
"""

import mmap
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from math import prod
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, Final, TypeVar
from weakref import WeakSet

import numpy as np
import numpy.typing as npt
import xarray as xr
from threadpoolctl import threadpool_limits
from xarray.backends import BackendArray
from xarray.core import indexing

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Values = npt.NDArray[Any]
Call = TypeVar("Call", bound=Callable[..., Any])

_LEAST: Final = 2**20  # bytes of an array that is worth a file
_PART: Final = 2**25  # bytes of a film that are held at once
_BLOCK: Final = 2**24  # samples of a block that is computed at once
_FOLDER: ContextVar[Path | None] = ContextVar("folder", default=None)
_MAPS: WeakSet[mmap.mmap] = WeakSet()


def without_blas_threads(function: Call) -> Call:
    """Decorate a function of small matrix products, on which the library's threads lose time."""
    # On two busy processors their waiting in loops was two thirds of a separation's time.
    limited: Call = threadpool_limits.wrap(limits=1, user_api="blas")(function)
    return limited


def stride(shape: tuple[int, ...], number: int) -> int:
    """Step along every axis that selects about so many values of a shape, at most 2^n times."""
    step = (prod(shape) / number) ** (1.0 / len(shape))
    return max(1, int(round(step, 9)))  # a whole root is whole


def quotient(numerator: Any, denominator: Any, otherwise: float) -> Any:
    """Quotient where the denominator is positive, and another value elsewhere."""
    positive = denominator > 0
    return np.where(positive, numerator / np.where(positive, denominator, 1.0), otherwise)


def select(values: Any, selected: Any, axis: int = -1) -> Any:
    """Values at the selected indices or mask along an axis, in the same order of axes in memory."""
    return values.take(np.flatnonzero(selected) if selected.dtype == bool else selected, axis=axis)


@contextmanager
def on_disk(folder: Path) -> Iterator[None]:
    """Make the films of this thread in files of a folder."""
    before = _FOLDER.set(folder)
    try:
        yield
    finally:
        _FOLDER.reset(before)


def made_on_disk() -> bool:
    """Say that films are made in files here."""
    return _FOLDER.get() is not None


def empty(shape: tuple[int, ...], dtype: npt.DTypeLike) -> Values:
    """Make an array without values; OSError if the disk has no room for it."""
    folder, size = _FOLDER.get(), int(np.prod(shape)) * np.dtype(dtype).itemsize
    if folder is None or size < _LEAST:
        return np.empty(shape, dtype)
    try:
        with TemporaryFile(dir=folder) as file:  # without a name: the map alone keeps it
            file.truncate(size)
            if hasattr(os, "posix_fallocate"):  # a full disk is an error here, and kills later
                os.posix_fallocate(file.fileno(), 0, size)
            pages = mmap.mmap(file.fileno(), size)
    except OSError as error:
        label = f"No film of {size / 1e6:.3g} MB in '{folder}'"
        raise OSError(f"{label}: {error.strerror}. Must have room, and be writable.") from error
    _MAPS.add(pages)
    return np.frombuffer(pages, dtype).reshape(shape)


def copied(values: Values) -> Values:
    """Copy an array."""
    result = empty(values.shape, values.dtype)
    for rows in stretches(values):
        result[rows] = values[rows]
    return result


def stretches(film: Values) -> Iterator[slice]:
    """Yield places along the first axis of a film, whose pages are given back after each."""
    step = max(1, _PART * len(film) // max(1, film.nbytes))
    for start in range(0, len(film), step):
        yield slice(start, start + step)
        release()


def release() -> None:
    """Give the pages of all films on disk back, which are read anew when they are used."""
    for pages in list(_MAPS) if hasattr(mmap, "MADV_DONTNEED") else []:
        pages.madvise(mmap.MADV_DONTNEED)


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
        return np.asarray(result[tuple(slice(None) if place.ndim else 0 for place in places)])


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
