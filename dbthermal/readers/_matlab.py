"""Numeric arrays of MATLAB's files of versions 5 to 7, on disk, with their axes in reverse.

From the maker's "MAT-File Format". SciPy's reader crashes on damaged files.
"""

import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

# Types of numbers as they are stored, and as MATLAB has them.
_STORED: Final = dict(
    enumerate(["i1", "u1", "i2", "u2", "i4", "u4", "f4", "-", "f8", "-", "-", "i8", "u8"], 1)
)
_CLASSES: Final = dict(enumerate(["f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"], 6))
_MATRIX, _PACKED = 14, 15  # kinds of variables
_COMPLEX: Final = 0x800  # flag
_BEGIN: Final = 128  # header of a file [byte]
_HEAD: Final = 2**12  # bytes of a variable, within which its numbers begin


@dataclass(frozen=True)
class Numbers:
    """Array of a file, read when it is used."""

    path: Path
    name: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    stored: np.dtype[Any]  # type of the numbers in the file, which may be smaller
    span: tuple[int, int]  # place and length of the variable in the file [byte]
    begin: int  # of the numbers in the variable, as it is unpacked [byte]
    whole: int  # length of the variable, unpacked [byte]; 0 if it is not packed

    ndim = property(lambda self: len(self.shape))
    size = property(lambda self: math.prod(self.shape))

    def __getitem__(self, place: Any) -> Any:
        """Numbers at a place."""
        return self._values[place]

    @cached_property
    def _values(self) -> Any:
        """All numbers."""
        place, length = self.span
        if not self.whole:
            numbers: Any = np.memmap(self.path, self.stored, "r", place + self.begin, self.shape)
            return numbers.astype(self.dtype, copy=False)
        with self.path.open("rb") as stream:
            stream.seek(place)
            packed = stream.read(length)
        content = (unpack := zlib.decompressobj()).decompress(packed, self.whole + 1)
        if len(content) != self.whole or not unpack.eof:
            raise ValueError(f"Damaged '{self.name}'. Must unpack to {self.whole} bytes.")
        numbers = np.frombuffer(content, self.stored, self.size, self.begin)
        return numbers.reshape(self.shape).astype(self.dtype, copy=False)


def arrays(path: Path) -> dict[str, Numbers]:
    """Numeric arrays by name; ValueError unless the file ends where its variables do."""
    listed, at, size = dict[str, Numbers](), _BEGIN, path.stat().st_size
    with path.open("rb") as stream:
        order = {b"IM": "<", b"MI": ">"}[stream.read(_BEGIN)[-2:]]
        while at < size:
            stream.seek(at)
            tag = stream.read(8)
            kind, length = struct.unpack(f"{order}II", tag)
            if kind not in {_MATRIX, _PACKED}:
                raise ValueError(f"Kind {kind} of the variable at {at}. Must be 14 or 15.")
            if at + 8 + length > size:
                raise ValueError(f"Truncated at {size}. Must have {at + 8 + length} bytes or more.")
            head = tag + stream.read(min(length, _HEAD))
            span = (at, 8 + length) if kind == _MATRIX else (at + 8, length)
            if kind == _PACKED:
                head = zlib.decompressobj().decompress(head[8:], _HEAD)
            if variable := _variable(path, head, order, span, packed=kind == _PACKED):
                listed[variable.name] = variable
            at += 8 + length
    return listed


def _variable(
    path: Path, head: bytes, order: str, span: tuple[int, int], *, packed: bool
) -> Numbers | None:
    """Array by the first bytes of a variable; None of text, cells, structures, complex numbers."""
    kind, whole = struct.unpack_from(f"{order}II", head)
    if kind != _MATRIX:
        raise ValueError(f"Kind {kind} of a packed variable. Must be {_MATRIX}.")
    elements = _elements(head, order)
    flags = struct.unpack_from(f"{order}I", head, next(elements)[1])[0]
    if (form := _CLASSES.get(flags & 0xFF)) is None or flags & _COMPLEX:
        return None
    (_, place, length), (_, start, letters) = next(elements), next(elements)
    shape = struct.unpack_from(f"{order}{length // 4}i", head, place)[::-1]
    name = head[start : start + letters].decode()
    kind, begin, length = next(elements)
    stored = np.dtype(order + _STORED[kind])
    if length != stored.itemsize * math.prod(shape) or begin + length > 8 + whole:
        rule = f"Must be {stored.itemsize} x {shape}, within its {whole}"
        raise ValueError(f"{length} bytes of '{name}'. {rule}.")
    return Numbers(
        path, name, shape, np.dtype(form), stored, span, begin, 8 + whole if packed else 0
    )


def _elements(head: bytes, order: str) -> Iterator[tuple[int, int, int]]:
    """Yield kind, place and length of the elements of a variable; small ones lie in their tag."""
    at = 8
    while True:
        kind, length = struct.unpack_from(f"{order}II", head, at)
        if kind >> 16:
            yield kind & 0xFFFF, at + 4, kind >> 16
            at += 8
        else:
            yield kind, at + 8, length
            at += 8 + -(-length // 8) * 8
