"""Arrays of NetCDF 3 in its three forms (offsets of 32 and 64 bits, data of 64 bits), on disk.

A header lists dims, attributes and variables. Variables over the dim of length 0 lie in records,
which hold a slab of each. From the specification of Unidata, "NetCDF Classic Format".
"""

import math
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr

_TYPES: Final = ("i1", "S1", ">i2", ">i4", ">f4", ">f8", "u1", ">u2", ">u4", ">i8", ">u8")  # from 1
_DIMS, _VARIABLES, _ATTRIBUTES = 10, 11, 12  # tags of lists
_LONGEST: Final = 2**20  # of a header [byte]
_MOST_DIMS: Final = 32  # of a variable


def arrays(path: Path) -> dict[str, xr.Variable]:
    """Variables of a file, not yet read; ValueError unless it ends where its header says."""
    with path.open("rb") as stream:
        header = _Header(stream.read(_LONGEST))
    forms, file_size = header.variables(), path.stat().st_size
    # Size of a variable or its slab, and of a record; a single slab is not filled up.
    sizes = {name: math.prod(shape) * dtype.itemsize for name, (*_, shape, dtype) in forms.items()}
    recorded = [name for name, (dims, _, _, shape, _) in forms.items() if len(dims) > len(shape)]
    record = sum(_filled(sizes[name]) for name in recorded)
    record = sizes[recorded[0]] if len(recorded) == 1 else record
    records = header.records
    if records == 256**header.width - 1:  # written as a stream
        records = (file_size - min(forms[name][2] for name in recorded)) // max(record, 1)
    # All lie one behind another, and the last one ends with the file.
    stop = header.at
    for start, name in sorted((form[2], name) for name, form in forms.items()):
        if start < stop:
            raise ValueError(f"Overlapping '{name}' at {start}. Must begin from {stop} on.")
        stop = start + sizes[name]
    stop += (records - 1) * record if recorded else 0
    if not stop <= file_size < stop + max(record, 4):  # some writers fill a block up
        raise ValueError(f"{file_size} bytes, {records} records. Must end at {stop}, as it states.")
    content, listed = np.memmap(path, "u1", "r"), dict[str, xr.Variable]()
    for name, (dims, attrs, start, shape, dtype) in forms.items():
        steps = [math.prod(shape[axis + 1 :]) * dtype.itemsize for axis in range(len(shape))]
        over, strides = (
            ([records, *shape], [record, *steps]) if name in recorded else (shape, steps)
        )
        values = np.ndarray(over, dtype, content.data, start, strides)
        listed[name] = xr.Variable(dims, values, attrs)
    return listed


def _filled(size: int) -> int:
    """Size with what fills it up to a multiple of 4 bytes."""
    return -(-size // 4) * 4


_Form = tuple[list[str], dict[str, Any], int, list[int], np.dtype[Any]]


class _Header:
    """Header of a file, from whose bytes its parts are taken one after another."""

    def __init__(self, content: bytes) -> None:
        self.content, self.at = content, 4
        self.width = 8 if content[3] == 5 else 4  # of a number [byte]
        self.records = self.number()
        self.dims = [(self.text(), self.number()) for _ in range(self.length(_DIMS))]
        self.attributes()

    def variables(self) -> dict[str, _Form]:
        """Dims, attributes, place, shape (in the file or a record) and type by the name."""
        listed = dict[str, _Form]()
        for _ in range(self.length(_VARIABLES)):
            name, number = self.text(), self.number()
            if number > _MOST_DIMS:
                raise ValueError(f"{number} dims of '{name}'. Must be at most {_MOST_DIMS}.")
            dims = [self.dims[self.number()] for _ in range(number)]
            attrs, dtype, _ = self.attributes(), self.dtype(), self.number()
            shape = [size for place, (_, size) in enumerate(dims) if size or place]
            start = self.number(4 if self.content[3] == 1 else 8)
            listed[name] = [dim for dim, _ in dims], attrs, start, shape, dtype
        return listed

    def attributes(self) -> dict[str, Any]:
        """Attributes, texts and numbers, of the file or of a variable."""
        listed = dict[str, Any]()
        for _ in range(self.length(_ATTRIBUTES)):
            name, dtype, number = self.text(), self.dtype(), self.number()
            content = self.taken(number * dtype.itemsize)
            is_text, values = dtype.kind == "S", np.squeeze(np.frombuffer(content, dtype))
            listed[name] = content.decode() if is_text else values[()]
        return listed

    def length(self, tag: int) -> int:
        """Length of a list."""
        actual, length = self.number(4), self.number()
        if length and actual != tag:
            raise ValueError(f"Tag {actual} before byte {self.at}. Must be {tag}.")
        return length

    def dtype(self) -> np.dtype[Any]:
        """Type of numbers, as NumPy has it."""
        return np.dtype(dict(enumerate(_TYPES, 1))[self.number(4)])

    def text(self) -> str:
        """Name."""
        return self.taken(self.number()).decode()

    def number(self, width: int | None = None) -> int:
        """Whole number."""
        return int.from_bytes(self.taken(width or self.width))

    def taken(self, size: int) -> bytes:
        """Next bytes, with what fills them up."""
        start, self.at = self.at, self.at + _filled(size)
        if self.at > len(self.content):
            raise ValueError(f"Header up to byte {self.at}. Must end within {len(self.content)}.")
        return self.content[start : start + size]
