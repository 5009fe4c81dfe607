"""Films that a separation fills: in memory, or in files that vanish with the process.

A result larger than memory is written and read as an array; its pages are the file's. They count as
the process's memory, too, until they are `released`.
"""

import mmap
import os
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, Final
from weakref import WeakSet

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[Any]

_LEAST: Final = 2**20  # bytes of an array that is worth a file
_FOLDER: ContextVar[Path | None] = ContextVar("folder", default=None)
_MAPS: WeakSet[mmap.mmap] = WeakSet()


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
    with TemporaryFile(dir=folder) as file:  # without a name: the map alone keeps it
        file.truncate(size)
        if hasattr(os, "posix_fallocate"):  # a full disk is an error here, and kills later
            os.posix_fallocate(file.fileno(), 0, size)
        pages = mmap.mmap(file.fileno(), size)
    _MAPS.add(pages)
    return np.frombuffer(pages, dtype).reshape(shape)


def copied(values: Values) -> Values:
    """Copy an array."""
    result = empty(values.shape, values.dtype)
    for part, own in zip(result, values, strict=True):
        part[...] = own
        release()
    return result


def release() -> None:
    """Give the pages of all films on disk back, which are read anew when they are used."""
    for pages in list(_MAPS) if hasattr(mmap, "MADV_DONTNEED") else []:
        pages.madvise(mmap.MADV_DONTNEED)
