"""Container of FLIR's recordings: its records, found by their directory, never by their mark.

A frame is a header of 64 bytes (mark, maker of the file, at 20 the version, whose size tells the
byte order, at 24 place and length of the directory), a directory of 32 bytes a record (type,
subtype, version, number, at 12 offset and length, at 28 a CRC-32, 0 for none) and the records.
Frames follow one another, zeros between. In a JPEG they lie in the joined APP1 segments that begin
with ``FLIR``. Read from files, and from the table of P. Harvey's ExifTool (FLIR.pm).
"""

import re
import struct
import zlib
from collections.abc import Iterator, Mapping
from mmap import mmap
from typing import Final, NamedTuple

IMAGE: Final = 1
CAMERA: Final = 32

_MARKS: Final = (b"FFF\0", b"AFF\0")
_HEADER, _ENTRY = 64, 32  # sizes [byte]
_MOST_RECORDS: Final = 1024  # in a frame; the files at hand have up to 14
_PADDING: Final = 32  # by which the last record of a file may seem to pass its end [byte]
_ALIGNED: Final = 4  # to a multiple of which some cameras fill up [byte]
_SEGMENT: Final = b"FLIR\0\x01"
_NO_ZERO: Final = re.compile(rb"[^\0]")

Content = bytes | mmap


class Record(NamedTuple):
    """Place of a record in its file [byte], and its CRC-32, 0 for none."""

    start: int
    stop: int
    checksum: int


Frame = Mapping[int, Record]  # record by its type


def frames(content: Content, name: str, *, still: bool) -> Iterator[Frame]:
    """Yield the records of each frame of a file; ValueError by frame and byte where damaged."""
    at: int | None = 0
    number = 0
    while at is not None:
        records, stop = _frame(content, at, f"frame {number} of '{name}', at byte {at}")
        yield records
        at, number = _following(content, at, stop, still=still), number + 1


def _following(content: Content, start: int, stop: int, *, still: bool) -> int | None:
    """Place of the frame behind a frame from start to stop; None at the end of the file."""
    # Behind the last record lie zeros, or bytes that fill the frame up to a multiple of 4.
    filled = start + -(-(stop - start) // _ALIGNED) * _ALIGNED
    for behind in (stop, filled):
        if (byte := _NO_ZERO.search(content, behind)) is None:
            return None
        at, head = byte.start(), content[byte.start() : byte.start() + _HEADER]
        if any(mark.startswith(head[: len(mark)]) for mark in _MARKS):
            return at
    return None if still or len(head) < _HEADER else at  # a still has one frame, then filling


def body(content: Content, record: Record) -> tuple[bytes, str]:
    """Bytes of a record, and a sentence on its checksum if that is wrong."""
    value = content[record.start : record.stop]
    if record.checksum in {0, checksum := zlib.crc32(value)}:
        return value, ""
    return value, f"CRC-32 {checksum:08x}. Must be {record.checksum:08x}, as listed"


def segments(content: Content, name: str) -> Iterator[tuple[int, int, int]]:
    """Yield (marker, start, stop) of the segments of a JPEG, up to its compressed data."""
    at = 2
    while content[at : at + 2] not in {b"\xff\xda", b"\xff\xd9"}:
        if content[at : at + 2] == b"\xff\xff":  # a fill byte
            at += 1
            continue
        head = content[at : at + 4]
        length = int.from_bytes(head[2:])
        if len(head) < 4 or head[0] != 0xFF or length < 2 or at + 2 + length > len(content):
            rule = "Must be a marker and the length of a segment"
            raise ValueError(f"Damaged JPEG '{name}': {head.hex()} at byte {at}. {rule}.")
        yield head[1], at + 4, at + 2 + length
        at += 2 + length


def of_jpeg(content: Content, name: str) -> bytes:
    """Container that the APP1 segments of a radiometric JPEG hold, joined."""
    bodies = [content[at:stop] for marker, at, stop in segments(content, name) if marker == 0xE1]
    if not (payloads := [body for body in bodies if body.startswith(_SEGMENT)]):
        label = f"'{name}', an ordinary JPEG or one of another maker"
        rule = "Must be a radiometric JPEG; else export 16-bit counts as TIFF and use readers.tiff"
        raise ValueError(f"No thermal data of FLIR in {label}. {rule}.")
    numbers = [tuple(payload[6:8]) for payload in payloads]
    if numbers != [(i, numbers[0][-1]) for i in range(numbers[0][-1] + 1)] or len(payloads[-1]) < 8:
        label = f"FLIR segments {[i for i, *_ in numbers]}"
        raise ValueError(f"Damaged JPEG '{name}': {label}. Must be whole and in order.")
    return b"".join(payload[8:] for payload in payloads)


def _frame(content: Content, at: int, place: str) -> tuple[Frame, int]:
    """Records of the frame that begins at a byte, and the byte after its last record."""
    size = len(content)
    # Header, and the byte order by its version.
    if (mark := content[at : at + 4]) not in _MARKS or at + _HEADER > size:
        hint = "" if at else "; is it no recording of FLIR? Then export 16-bit counts as TIFF"
        rule = f"Must be FLIR's: 'FFF' or 'AFF'{hint}"
        raise ValueError(f"Invalid header {mark!r} of {place}. {rule}.")
    orders = [o for o in "><" if 100 <= struct.unpack_from(f"{o}I", content, at + 20)[0] < 200]
    if not orders:
        version = content[at + 20 : at + 24].hex()
        raise ValueError(f"Invalid version {version} of {place}. Must be from 100 to 199.")
    # Directory of the records.
    directory, count = struct.unpack_from(f"{orders[0]}II", content, at + 24)
    listed = directory + _ENTRY * count
    if directory < _HEADER or count > _MOST_RECORDS or at + listed > size:
        label = f"directory of {count} records at {directory} of {place}"
        rule = f"Must be in the file, and of {_MOST_RECORDS} at most"
        raise ValueError(f"Damaged file: {label}. {rule}.")
    records, spans = {}, [(directory, listed)]
    for entry in range(directory, listed, _ENTRY):
        numbers = struct.unpack_from(f"{orders[0]}HHIIIIIII", content, at + entry)
        kind, start, length, checksum = numbers[0], *numbers[4:6], numbers[-1]
        if not kind or not length:
            continue
        spans.append((start, start + length))
        if kind in {IMAGE, CAMERA} and kind in records:
            raise ValueError(f"Repeated record of type {kind} in {place}. Must be listed once.")
        records[kind] = Record(at + start, min(at + start + length, size), checksum)
    # Records must lie one behind another, within the file.
    spans.sort()
    stops = [_HEADER, *(stop for _, stop in spans)]
    for before, (start, stop) in zip(stops, spans, strict=False):
        if start < before or at + stop > size + _PADDING:
            label = f"record from {start} to {stop} of {place}"
            rule = f"Must follow {before}, and end within the {size - at} bytes left"
            raise ValueError(f"Truncated or damaged file: {label}. {rule}.")
    if IMAGE not in records:
        raise ValueError(f"Missing image in {place}. Has records {sorted(records)}.")
    return records, min(at + stops[-1], size)
