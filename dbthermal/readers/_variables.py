"""Arrays in files of NumPy, NetCDF 3 and MATLAB 5 to 7, left on disk, by headers read in here."""

import math
import struct
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal._arrays import empty, stretches
from dbthermal.readers import _recording as recordings

_NUMPY_HEADER: Final = 2**16  # of NumPy's format, at most [byte]
_STORED: Final = dict(  # MATLAB's types of stored numbers; `_CLASSES` are those of its arrays
    enumerate(["i1", "u1", "i2", "u2", "i4", "u4", "f4", "-", "f8", "-", "-", "i8", "u8"], 1)
)
_CLASSES: Final = dict(enumerate(["f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"], 6))
_MATRIX, _PACKED = 14, 15  # kinds of variables
_COMPLEX: Final = 0x800  # flag
_BEGIN: Final = 128  # header of a file [byte]
_HEAD: Final = 2**12  # bytes of a variable, within which its numbers begin
# NetCDF 3: types of numbers, tags of lists.
_TYPES: Final = ["-", "i1", "S1", ">i2", ">i4", ">f4", ">f8", "u1", ">u2", ">u4", ">i8", ">u8"]
_DIMS, _VARIABLES, _ATTRIBUTES = 10, 11, 12  # tags of lists
_NETCDF_HEADER: Final = 2**20  # at most [byte]
_MOST_DIMS: Final = 32  # of a variable


class Unread:
    """Array of a file, read when it is used."""

    shape: tuple[int, ...]
    values: Any
    ndim = property(lambda self: len(self.shape))
    size = property(lambda self: math.prod(self.shape))

    def __getitem__(self, place: Any) -> Any:
        """Numbers at a place."""
        return self.values[place]


@dataclass(frozen=True)
class Stream(Unread):
    """Array of NumPy's format, whose numbers follow in a stream."""

    stream: IO[bytes]
    name: str
    shape: tuple[int, ...]
    by_columns: bool
    dtype: np.dtype[Any]

    @cached_property
    def values(self) -> Any:
        """Numbers of a line."""
        content = self.stream.read(self.size * self.dtype.itemsize)
        return np.frombuffer(content, self.dtype, self.size)

    def counts(self) -> npt.NDArray[Any]:
        """Counts, which must end where the header says."""
        counts, size = empty(self.shape[:: -1 if self.by_columns else 1], np.uint16), 0
        for frames in stretches(counts):
            size += self.stream.readinto(counts[frames].view("u1").data)  # type: ignore[attr-defined]
            if not self.dtype.isnative:
                counts[frames].byteswap(inplace=True)
        size += len(self.stream.read(1))
        if size != counts.nbytes:
            label = f"{size} bytes or more of counts in '{self.name}'"
            raise ValueError(f"Truncated or damaged {label}. Must be {counts.nbytes}, as stated.")
        return counts.T if self.by_columns else counts


def numpy_arrays(path: Path, stack: ExitStack) -> dict[str, Any]:
    """Arrays of a .npz, whose checksums must be right, by name, behind their headers."""
    archive, listed = stack.enter_context(zipfile.ZipFile(path)), dict[str, Any]()
    recordings.check_pieces(len(archive.namelist()), path.stat().st_size, f"files in '{path.name}'")
    for member in archive.infolist():
        name = member.filename.removesuffix(".npy")
        if name == member.filename:
            rule = "Must hold arrays of NumPy alone: unpack it"
            raise ValueError(f"Invalid file '{name}' in '{path.name}'. {rule}.")
        if member.compress_type not in {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
            label = f"compression {member.compress_type} of '{member.filename}' of '{path.name}'"
            raise ValueError(f"Invalid {label}. Must be none or deflate, as of NumPy.")
        listed[name] = numpy_array(path, stack.enter_context(archive.open(member)))
    return {name: array for name, array in listed.items() if array.ndim == 3 or array.dtype != "O"}


def numpy_array(path: Path, stream: IO[bytes]) -> Stream:
    """Array in NumPy's format, behind its header."""
    major, minor = np.lib.format.read_magic(stream)
    read = getattr(np.lib.format, f"read_array_header_{major}_{minor}")
    start = stream.read(2 * major)
    if (length := int.from_bytes(start, "little")) > _NUMPY_HEADER:
        raise ValueError(f"Header of {length} bytes. Must be at most {_NUMPY_HEADER}.")
    with warnings.catch_warnings(action="error"):  # of headers mended as of Python 2
        return Stream(stream, path.name, *read(BytesIO(start + stream.read(length))))


@dataclass(frozen=True)
class Numbers(Unread):
    """Array of a file of MATLAB."""

    path: Path
    name: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    stored: np.dtype[Any]  # type of the numbers in the file, which may be smaller
    span: tuple[int, int]  # place and length of the variable in the file [byte]
    begin: int  # of the numbers in the variable, as it is unpacked [byte]
    whole: int  # length of the variable, unpacked [byte]; 0 if it is not packed

    @cached_property
    def values(self) -> Any:
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


def matlab_arrays(path: Path) -> dict[str, Numbers]:
    """Numeric arrays of MATLAB by name; ValueError unless the file ends where its variables do."""
    # Versions 5 to 7, from the maker's "MAT-File Format": SciPy's reader crashes on damaged files.
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
    unpacked = 8 + whole if packed else 0
    return Numbers(path, name, shape, np.dtype(form), stored, span, begin, unpacked)


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


def netcdf_arrays(path: Path) -> dict[str, xr.Variable]:
    """Variables of NetCDF 3, unread; ValueError unless the file ends where its header says."""
    # Offsets of 32 and 64 bits, and data of 64 bits, from Unidata's "NetCDF Classic Format".
    with path.open("rb") as stream:
        header = _Header(stream.read(_NETCDF_HEADER))
    forms, file_size = header.variables(), path.stat().st_size
    # Variables over the dim of length 0 lie in records, a slab of each variable, filled up unless
    # there is only one slab: sizes of variables or slabs, and of a record.
    sizes = {name: math.prod(shape) * dtype.itemsize for name, (*_, shape, dtype) in forms.items()}
    recorded = [name for name, (dims, _, _, shape, _) in forms.items() if len(dims) > len(shape)]
    record = sum(-(-sizes[name] // 4) * 4 for name in recorded)  # each filled up
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
        first = [records] if name in recorded else []
        strides = [record] * len(first) + steps
        values = np.ndarray([*first, *shape], dtype, content.data, start, strides)
        listed[name] = xr.Variable(dims, values, attrs)
    return listed


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
            attrs, dtype, _ = self.attributes(), np.dtype(_TYPES[self.number(4)]), self.number()
            shape = [size for place, (_, size) in enumerate(dims) if size or place]
            start = self.number(4 if self.content[3] == 1 else 8)
            listed[name] = [dim for dim, _ in dims], attrs, start, shape, dtype
        return listed

    def attributes(self) -> dict[str, Any]:
        """Attributes, texts and numbers, of the file or of a variable."""
        listed = dict[str, Any]()
        for _ in range(self.length(_ATTRIBUTES)):
            name, dtype, number = self.text(), np.dtype(_TYPES[self.number(4)]), self.number()
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

    def text(self) -> str:
        """Name."""
        return self.taken(self.number()).decode()

    def number(self, width: int | None = None) -> int:
        """Whole number."""
        return int.from_bytes(self.taken(width or self.width))

    def taken(self, size: int) -> bytes:
        """Next bytes, with what fills them up."""
        start, self.at = self.at, self.at + -(-size // 4) * 4
        if self.at > len(self.content):
            raise ValueError(f"Header up to byte {self.at}. Must end within {len(self.content)}.")
        return self.content[start : start + size]
