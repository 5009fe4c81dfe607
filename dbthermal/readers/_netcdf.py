"""Arrays of NetCDF 3 in its three forms (offsets of 32 and 64 bits, data of 64 bits), on disk.

A header lists dims, attributes and variables. Variables over the dim of length 0 lie in records,
which hold a slab of each. From the specification of Unidata, "NetCDF Classic Format".
"""

import math
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import xarray as xr

_TYPES: Final = ("i1", "S1", ">i2", ">i4", ">f4", ">f8", "u1", ">u2", ">u4", ">i8", ">u8")  # from 1
_DIMS, _VARIABLES, _ATTRIBUTES = 10, 11, 12  # tags of lists
_LONGEST: Final = 2**20  # of a header [byte]
_STEP: Final = 4  # to a multiple of which all is filled up [byte]


class _Variable(NamedTuple):
    """Dims, attributes and place of a variable; `shape` is that in the file or in a record."""

    dims: list[str]
    attrs: dict[str, Any]
    dtype: np.dtype[Any]
    start: int
    shape: list[int]
    in_records: bool

    @property
    def size(self) -> int:
        """Bytes of the variable in the file or in a record."""
        return math.prod(self.shape) * self.dtype.itemsize


def arrays(path: Path) -> dict[str, xr.Variable]:
    """Variables of a file, not yet read; ValueError unless it ends where its header says."""
    with path.open("rb") as stream:
        header = _Header(stream.read(_LONGEST))
    variables, size = header.variables(), path.stat().st_size
    # Size and number of the records; a single variable of small numbers is not filled up.
    recorded = [variable for variable in variables.values() if variable.in_records]
    record = sum(_filled(variable.size) for variable in recorded)
    record = recorded[0].size if len(recorded) == 1 else record
    records = header.records
    if records == 256**header.width - 1:  # written as a stream
        records = (size - min(v.start for v in recorded)) // record if record else 0
    # All lie one behind another, and the last one ends with the file.
    stop = header.at
    for name, variable in sorted(variables.items(), key=lambda item: item[1].start):
        if variable.start < stop:
            raise ValueError(
                f"Overlapping '{name}' at {variable.start}. Must begin from {stop} on."
            )
        stop = variable.start + variable.size
    if recorded:
        stop += (records - 1) * record
    content, listed = np.memmap(path, "u1", "r"), dict[str, xr.Variable]()
    if not stop <= size < stop + max(record, _STEP):  # some writers fill a block up
        raise ValueError(f"{size} bytes with {records} records. Must end at {stop}, as it states.")
    for name, (dims, attrs, dtype, start, shape, in_records) in variables.items():
        steps = [*np.cumprod([dtype.itemsize, *shape[:0:-1]])[::-1].tolist()][: len(shape)]
        over, strides = ([records, *shape], [record, *steps]) if in_records else (shape, steps)
        values = np.ndarray(over, dtype, content.data, start, strides)
        listed[name] = xr.Variable(dims, values, attrs)
    return listed


def _filled(size: int) -> int:
    return -(-size // _STEP) * _STEP


class _Header:
    """Header of a file, from whose bytes its parts are taken one after another."""

    def __init__(self, content: bytes) -> None:
        self.content, self.at = content, 4
        self.width = 8 if content[3] == 5 else 4  # of a number [byte]
        self.records = self.number()
        self.dims = [(self.text(), self.number()) for _ in range(self.length(_DIMS))]
        self.attributes()

    def variables(self) -> dict[str, _Variable]:
        """Variables by their names."""
        listed = dict[str, _Variable]()
        for _ in range(self.length(_VARIABLES)):
            name = self.text()
            dims = [self.dims[self.number()] for _ in range(self.number())]
            attrs, dtype, _ = self.attributes(), self.dtype(), self.number()
            start = self.number(4 if self.content[3] == 1 else 8)
            in_records = bool(dims) and dims[0][1] == 0
            shape = [size for _, size in dims[in_records:]]
            names = [dim for dim, _ in dims]
            listed[name] = _Variable(names, attrs, dtype, start, shape, in_records)
        return listed

    def attributes(self) -> dict[str, Any]:
        """Attributes, of the file or of a variable."""
        return {self.text(): self.values() for _ in range(self.length(_ATTRIBUTES))}

    def values(self) -> Any:
        """Value of an attribute: text, or numbers."""
        dtype, size = self.dtype(), self.number()
        values = np.frombuffer(self.taken(size * dtype.itemsize), dtype)
        return values.tobytes().decode() if dtype.kind == "S" else np.squeeze(values)[()]

    def length(self, tag: int) -> int:
        """Length of a list."""
        actual, length = self.number(4), self.number()
        if (actual, length) != (0, 0) and actual != tag:
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
