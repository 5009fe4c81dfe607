"""Types of arrays, and films in memory or on disk.

Films on disk are in files that vanish with the process, and are used as arrays. Their pages count
as the process's memory until they are released (`release`).
"""

import mmap
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from math import prod
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, Final, TypeVar
from weakref import WeakSet

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Call = TypeVar("Call", bound=Callable[..., Any])

_LEAST: Final = 2**20  # bytes of an array that is worth a file
_PART: Final = 2**25  # bytes of a film that are held at once
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
    selected = np.flatnonzero(selected) if selected.dtype == bool else selected
    return values.take(selected, axis=axis)


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


def empty(shape: tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
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
        label = f"No film of {size / 1e6:.3g} MB in '{folder}', beside the output"
        raise OSError(f"{label}: {error.strerror}. Must have room, and be writable.") from error
    _MAPS.add(pages)
    return np.frombuffer(pages, dtype).reshape(shape)


def copied(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Copy an array."""
    result = empty(values.shape, values.dtype)
    for rows in stretches(values):
        result[rows] = values[rows]
    return result


def stretches(film: npt.NDArray[Any]) -> Iterator[slice]:
    """Yield places along the first axis of a film, whose pages are given back after each."""
    step = max(1, _PART * len(film) // max(1, film.nbytes))
    for start in range(0, len(film), step):
        yield slice(start, start + step)
        release()


def release() -> None:
    """Give the pages of all films on disk back, which are read anew when they are used."""
    for pages in list(_MAPS) if hasattr(mmap, "MADV_DONTNEED") else []:
        pages.madvise(mmap.MADV_DONTNEED)
