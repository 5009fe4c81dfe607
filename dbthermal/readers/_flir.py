"""Recordings of FLIR's cameras: counts, clock, and what the camera's record says.

A file has records, found by their directory, never by their mark. A frame is a header of 64 bytes
(mark, maker of the file, at 20 the version, whose size tells the byte order, at 24 place and length
of the directory), a directory of 32 bytes a record (type, subtype, version, number, at 12 offset
and length, at 28 a CRC-32, 0 for none) and the records. Frames follow one another, zeros between.
In a JPEG they lie in the joined APP1 segments that begin with ``FLIR``. Read from files, and from
the table of P. Harvey's ExifTool (FLIR.pm).
"""

import re
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from datetime import UTC, datetime
from itertools import islice
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import _numbers
from dbthermal import _text as texts
from dbthermal._arrays import Array, Mask, empty, release
from dbthermal.readers import _formats, _recording
from dbthermal.readers._recording import MEMORY, Clock, Counts, FileFlag
from dbthermal.schema import warned

_IMAGE, _CAMERA = 1, 32  # types of records
_MARKS: Final = (b"FFF\0", b"AFF\0")
_HEADER, _ENTRY = 64, 32  # sizes [byte]
_MOST_RECORDS: Final = 1024  # in a frame; the files at hand have up to 14
_PADDING: Final = 32  # by which the last record of a file may seem to pass its end [byte]
_ALIGNED: Final = 4  # to a multiple of which some cameras fill up [byte]
_SEGMENT: Final = b"FLIR\0\x01"
_NO_ZERO: Final = re.compile(rb"[^\0]")
_FIELDS: Final = {  # place in the camera's record [byte], type, and limits of plausible values
    "emissivity": (0x20, "f", 0.01, 1.0),
    "object_distance": (0x24, "f", 0.0, 1e4),
    "reflected_temperature": (0x28, "f", 173.0, 373.0),
    "atmospheric_temperature": (0x2C, "f", 200.0, 340.0),
    "window_temperature": (0x30, "f", 200.0, 340.0),
    "window_transmission": (0x34, "f", 0.01, 1.0),
    "relative_humidity": (0x3C, "f", 0.0, 1.0),
    "planck_R1": (0x58, "f", 1.0, 1e9),
    "planck_B": (0x5C, "f", 500.0, 10000.0),
    "planck_F": (0x60, "f", 0.1, 10.0),
    "planck_O": (0x308, "i", -65536, 65536),
    "planck_R2": (0x30C, "f", 1e-6, 1e6),
    "range_max": (0x90, "f", 200.0, 4000.0),
    "range_min": (0x94, "f", 70.0, 2000.0),
    "frame_rate": (0x464, "H", 1, 1000),
}
_TEXTS: Final = {
    "camera_model": (0xD4, 32),
    "camera_part_number": (0xF4, 16),
    "camera_serial_number": (0x104, 16),
    "camera_software": (0x114, 16),
    "lens_model": (0x170, 32),
    "lens_part_number": (0x190, 16),
    "lens_serial_number": (0x1A0, 16),
    "filter_model": (0x1EC, 16),
    "filter_part_number": (0x1FC, 32),
    "filter_serial_number": (0x21C, 32),
}
_TIME: Final = 0x384  # whole seconds since 1970 UTC, milliseconds
_CAMERA_SIZE: Final = 0x466
_IMAGE_SIZE: Final = 32  # of what precedes the counts
_NUMBER: Final = 24  # place of the frame's number, in image and camera
_FIRST_CLOCK: Final = datetime(2001, 1, 1, tzinfo=UTC).timestamp()  # clocks never set begin before
_CONSTANTS: Final = ("planck_R1", "planck_R2", "planck_B", "planck_F", "planck_O")

_Content = bytes | mmap


class _Record(NamedTuple):
    """Place of a record in its file [byte], and its CRC-32, 0 for none."""

    start: int
    stop: int
    checksum: int


_Frame = Mapping[int, _Record]  # record by its type


class _Image(NamedTuple):
    """Counts as a file holds them: numbers as they are, or compressed by a codec."""

    shape: tuple[int, int]
    order: str  # of the bytes, as numpy writes it; "" if a codec gives numbers
    codec: str
    body: bytes


def flir(
    path: _formats.Paths,
    *,
    frames: slice | None = None,
    rows: slice = slice(None),
    clock: Clock | None = None,
    byte_order: str | None = None,
    memory: float = MEMORY,
) -> xr.Dataset:
    """Counts of a FLIR recording or radiometric picture: .fff, .seq, .csq or .jpg.

    Emissivity, distance, reflected and atmospheric temperature that somebody entered into the
    camera are shown as attributes and never applied; `calibration.maker_response` makes a response
    of the maker's Planck constants.

    The bytes of an image are in the order that its header states; in a PNG FLIR's cameras have
    swapped them. In the right order an image is smoother: that decides for PNG, and is held against
    the header. A record with a checksum (JPEG) must fit it. FLIR's sequences have none: a damaged
    pixel or, in JPEG-LS, one flipped bit in ten changes counts without complaint.

    OSError if a file cannot be opened, ImportError without the extra ``recordings`` for compressed
    ones; TypeError or ValueError if a file is no FLIR recording, damaged or too large; frames differ
    in size or in the maker's constants; the byte order is unclear or contradicts the image; the
    counts have 8 bits; or the times are unknown or fall.

    Parameters
    ----------
    path : str, Path or sequence
        Regular file, or the files of one camera in the order of time, such as pictures.
    frames : slice, optional
        Frames to read, not negative; of a long or damaged recording only those are looked at.
    rows : slice, optional
        Rows of the image to keep, as for `tiff`.
    clock : float or array_like, optional
        Frame rate of the file [Hz] or time of each selected frame [s], in place of its times; a
        warning if they differ by more than half a frame.
    byte_order, memory : {"little", "big"} or None, float
        Order of an image's bytes, in place of what is decided; largest memory that the counts may
        take [byte], refused before it is taken.

    Returns
    -------
    Dataset
        `counts` (time, y, x) [count], uint16; `exposure_time` (time) [s] since the first frame, by
        the camera's clock (milliseconds), NaN where it stands; `frame_flags` (time), which mark
        lost frames, by gaps of the clock, and images that are not of their frame's time.
        Attributes: ``start`` (UTC), ``source``, ``format``, ``byte_order``, ``byte_order_by``,
        ``implausible`` (values that no thermographer means), and the camera's record as
        ``file_...``, temperatures in K, distance in m, rate in Hz.

    Examples
    --------
    >>> from dbthermal import readers
    >>> readers.flir("recording.ravi")
    Traceback (most recent call last):
    ValueError: Refused 'recording.ravi': export its counts as 16-bit TIFF with the maker's program and use readers.tiff.
    """  # noqa: E501
    paths = _formats.files(path, "flir")
    name = _recording.label(paths)
    _numbers.real_number("memory", memory, _numbers.POSITIVE)
    wanted = slice(None) if frames is None else frames
    stated = "" if byte_order is None else _recording.byte_order(name, byte_order)
    # Records of the selected frames.
    with ExitStack() as stack:
        try:
            selected = islice(_walk(paths, memory, stack), wanted.start, wanted.stop, wanted.step)
        except (AttributeError, TypeError, ValueError) as error:
            raise ValueError(f"Invalid frames {frames}. Must be >= 0, and the step > 0.") from error
        if not (listed := [*selected]):
            raise ValueError(f"Invalid frames={frames} of '{name}'. Must select at least one.")
        # Images, all of the form of the first.
        form = _image(*listed[0], stated)._replace(body=b"")
        stored = sum(file.stat().st_size for file in paths)
        shape = len(listed), *form.shape
        counts = empty(_recording.check_memory(shape, memory, name, stored, rows), np.uint16)
        for number, listing in enumerate(listed):
            image, place = _image(*listing, stated), listing[-1]
            if image._replace(body=b"") != form:
                unlike = f"{image.shape}, {image.codec} of {place}"
                raise ValueError(f"Invalid image {unlike}. Must be {form.shape}, {form.codec}.")
            if image.codec == "none":
                values: Counts = np.frombuffer(image.body, f"{image.order}u2").reshape(form.shape)
            elif image.codec == "png":
                values = _recording.png(image.body, place)
            else:
                codecs = _recording.optional("imagecodecs", "recordings")
                with _recording.damage_named(f"Damaged image in {place}", "JPEG-LS that decodes"):
                    values = codecs.jpegls_decode(image.body)
                values = _recording.decoded(values, image.shape, place)
            counts[number] = values[rows]
            release()
        seconds, same_number, attrs = _cameras(listed, timed=clock is None)
    # Byte order, flags and times.
    order, by = _order(counts, form, byte_order, name)
    flags = np.where(same_number, 0, FileFlag.NUMBERS_DIFFER.value).astype(np.uint16)
    seconds, sentences = np.where(same_number, seconds, np.nan), _recording.copies(counts, paths)
    if clock is not None:  # a rate is that of all frames; clocks of cameras may be wrong
        every = 1 if np.ndim(np.asarray(clock)) else wanted.step or 1
        by_clock = every * _recording.stamps(clock, len(counts), name)
        rising = seconds > np.append(-np.inf, np.fmax.accumulate(seconds)[:-1])
        try:
            if rising.any():
                _recording.check_times(seconds[rising], "s", by_clock[rising], name)
        except ValueError as error:
            sentences.append(re.sub("Must .*", "Must agree: clock= is used.", str(error)))
        seconds = by_clock
    about = {"source": name, "format": f"FLIR, {form.codec}", "byte_order": order}
    about |= {"byte_order_by": by, **attrs}
    doubts = [note for note in attrs["implausible"].split("; ") if note.startswith("checksum")]
    made = _recording.recording(counts, seconds, name, about, flags)
    return warned(made, *sentences, *(f"Wrong {it}: has it been edited?" for it in doubts[:1]))


_Found = tuple[_Content, _Frame, str]


def _walk(paths: Sequence[Path], memory: float, stack: ExitStack) -> Iterator[_Found]:
    """Yield content, records and name of each frame of some files; ValueError where damaged."""
    for path in paths:
        file = stack.enter_context(path.open("rb"))
        content: _Content = stack.enter_context(mmap(file.fileno(), 0, access=ACCESS_READ))
        if still := content[:2] == b"\xff\xd8":
            texts.regular_file(path, int(memory))
            content = _of_jpeg(content, path.name)
        number = 0
        at: int | None = 0
        try:
            while at is not None:
                place = f"frame {number} of '{path.name}'"
                records, stop = _frame(content, at, f"{place}, at byte {at}")
                yield content, records, place
                at, number = _following(content, at, stop, still=still), number + 1
        except ValueError as error:
            before = f" Those before it: frames=slice(0, {number})." if number else ""
            raise ValueError(f"{error}{before}") from error


def _image(content: _Content, records: _Frame, place: str, stated: str) -> _Image:
    """Form and bytes of an image, of a stated byte order, whose sizes agree wherever they are."""
    body, fault = _checked(content, records[_IMAGE])
    if fault:
        raise ValueError(f"Damaged image in {place}: {fault}.")
    head, body = body[:_IMAGE_SIZE], body[_IMAGE_SIZE:]
    order = {b"\2\0": "<", b"\0\2": ">"}.get(head[:2])
    if order is None or len(head) < _IMAGE_SIZE:
        raise ValueError(f"Damaged image in {place}: it begins with {head[:2]!r}. Must be 2.")
    # Sizes by the header, and by the compressed image.
    width, height = struct.unpack_from(f"{order}HH", head, 2)
    image = _Image((height, width), stated or order, "none", body)
    size = (height, width, 16)
    if body[:8] == _formats.PNG:
        image = image._replace(order="", codec="png")
        size = _recording.png_size(body, place)
    elif body[:2] == b"\xff\xd8":
        image = image._replace(order="", codec="jpegls")
        size = _jpegls_size(body, place)
    elif len(body) != 2 * width * height:
        label = f"{len(body)} bytes of counts in {place}"
        raise ValueError(f"Truncated or damaged {label}. Must be 2 x {width} x {height}.")
    if size != (height, width, 16) or not width * height:
        label = f"{size[0]} x {size[1]} pixels of {size[2]} bits in {place}"
        raise ValueError(f"Invalid {label}. Must be {height} x {width} of 16, as its header says.")
    return image


def _jpegls_size(body: bytes, place: str) -> tuple[int, int, int]:
    """Height, width and bits that a JPEG-LS image states, which must be whole."""
    if not body.rstrip(b"\0").endswith(b"\xff\xd9"):
        raise ValueError(f"Truncated image in {place}: no end of JPEG. Must be whole.")
    for marker, start, _ in _segments(body, place):
        if marker == 0xF7:
            bits, height, width, _ = struct.unpack_from(">BHHB", body, start)
            return height, width, bits
    raise ValueError(f"Invalid JPEG in {place}, of 8 bits. Must be JPEG-LS: record 16-bit counts.")


def _order(counts: Counts, form: _Image, stated: str | None, name: str) -> tuple[str, str]:
    """Byte order of the counts, which are swapped in place if need be, and what decided it."""
    if form.codec == "jpegls":
        return "none: numbers are coded", "codec"
    order = _recording.ORDERS[form.order or ">"]  # a PNG has its highest byte first
    decided = "caller" if stated else "header" if form.order else "smoothness"
    sign = _recording.smoother(counts)
    if order != (stated or order) or (decided == "smoothness" and sign < 0):
        counts.byteswap(inplace=True)
        order, sign = "little" if order == "big" else "big", -sign
    label = f"'{name}': its images are smoother with their bytes swapped"
    if stated and sign < 0:
        raise ValueError(f"Invalid byte_order '{stated}' for {label}. Must be the other one.")
    if not stated and ((sign == 0 and not form.order) or sign < 0):
        rule = "Must be stated: byte_order='little' or 'big'"
        raise ValueError(f"Unclear byte order in {label}, or as smooth. {rule}.")
    return order, decided


def _cameras(listed: Sequence[_Found], *, timed: bool) -> tuple[Array, Mask, dict[str, Any]]:
    """Times (time) [s], agreement of the numbers (time), attributes, of the camera's records."""
    milliseconds, first = np.full(len(listed), np.nan), dict[str, Any]()
    numbers, doubts = np.zeros((len(listed), 3), dtype=np.int64), dict[int, str]()
    for number, (content, records, place) in enumerate(listed):
        if _CAMERA not in records:
            continue
        # The record, in its byte order.
        body, fault = _checked(content, records[_CAMERA])
        if fault:
            doubts[number] = f"checksum of the camera's record in {place}, {fault}"
        if len(body) < _CAMERA_SIZE or body[:2] not in {b"\2\0", b"\0\2"}:
            if not timed:  # the clock is stated: no time is needed of a damaged record
                continue
            label = f"record of the camera in {place}, {len(body)} bytes from {body[:2]!r}"
            rule = f"Must be {_CAMERA_SIZE} at least, and begin with 2; with clock= it is not read"
            raise ValueError(f"Damaged {label}. {rule}.")
        order = "<" if body[0] else ">"
        # Numbers and time of the frame.
        start = records[_IMAGE].start
        image = "<" if content[start] else ">"
        (of_image,) = struct.unpack_from(f"{image}H", content, start + _NUMBER)
        (of_camera,) = struct.unpack_from(f"{order}H", body, _NUMBER)
        numbers[number] = id(content), of_image, of_camera
        whole, thousandths = struct.unpack_from(f"{order}II", body, _TIME)
        if whole:
            milliseconds[number] = whole * 1000 + (thousandths & 0xFFFF)
        # Settings and constants, which must not change after the first frame.
        camera = {
            key: struct.unpack_from(order + code, body, start)[0]
            for key, (start, code, *_) in _FIELDS.items()
        }
        first = first or camera | {"body": body}
        for key in _CONSTANTS:
            if camera[key] != first[key]:
                change = f"{key} {camera[key]:g} of {place}, {first[key]:g} before"
                rule = "Must be one range of the camera: select its frames by frames="
                raise ValueError(f"Invalid {change}. {rule}.")
    # Times of records with a wrong checksum, as of edited texts, count if there are no others.
    if len(doubts) < len(listed):
        milliseconds[[*doubts]] = np.nan
    first_time = milliseconds[np.isfinite(milliseconds)][:1]
    attrs = _attrs(first, *first_time / 1000) if first else {"implausible": ""}
    attrs["implausible"] = "; ".join(filter(None, [attrs["implausible"], *doubts.values()]))
    seconds = (milliseconds - (first_time if first_time.size else 0)) / 1000
    return seconds, _numbers_agree(numbers), attrs


def _numbers_agree(numbers: npt.NDArray[np.int64]) -> Mask:
    """Agreement (time) of the numbers (time, [file, image, camera]) of frames."""
    agree = np.ones(len(numbers), dtype=bool)
    for file in np.unique(numbers[:, 0]):
        (frames,) = np.nonzero(numbers[:, 0] == file)
        image, camera = numbers[frames, 1:].T
        if np.ptp(image) and np.ptp(camera):  # both count, each from any start: they rise together
            apart, shares = np.unique((image - camera) % 2**16, return_counts=True)
            usual = apart[shares.argmax()] if 2 * shares.max() > len(frames) else 0
            agree[frames] = (image - camera) % 2**16 == usual
    return agree


def _attrs(camera: dict[str, Any], seconds: float | None = None) -> dict[str, Any]:
    """Attributes of a camera's record: its values as written, and the implausible values."""
    body, attrs, implausible = camera.pop("body"), dict[str, Any](), list[str]()
    for key, value in camera.items():
        _, code, low, high = _FIELDS[key]
        # Shortest decimal that is the same 32-bit number: 0.95, not 0.949999988.
        number = float(str(np.float32(value))) if code == "f" else int(value)
        if not low <= number <= high:
            celsius = f" K ({number - 273.15:.1f} degrees Celsius)" if "temp" in key else ""
            implausible.append(f"{key} {number:g}{celsius}")
        if np.isfinite(number):
            attrs[f"file_{key}"] = number
    for key, (start, size) in _TEXTS.items():
        text = body[start : start + size].partition(b"\0")[0].decode("latin-1")
        attrs[f"file_{key}"] = "".join(letter for letter in text if letter.isprintable())
    if seconds is not None:
        moment = datetime.fromtimestamp(seconds, UTC)
        attrs["start"] = moment.isoformat(timespec="milliseconds")
        if seconds < _FIRST_CLOCK:
            implausible.append(f"date {moment:%Y-%m-%d}, as of a clock that was never set")
    return {"implausible": "; ".join(implausible), **attrs}


def _following(content: _Content, start: int, stop: int, *, still: bool) -> int | None:
    """Place of the frame behind a frame from start to stop; None at the end of the file."""
    # Behind the last record lie zeros, or bytes that fill the frame up to a multiple of 4.
    for behind in (stop, start + -(-(stop - start) // _ALIGNED) * _ALIGNED):
        if (byte := _NO_ZERO.search(content, behind)) is None:
            return None
        at, head = byte.start(), content[byte.start() : byte.start() + _HEADER]
        if any(mark.startswith(head[: len(mark)]) for mark in _MARKS):
            return at
    return None if still or len(head) < _HEADER else at  # a still has one frame, then filling


def _checked(content: _Content, record: _Record) -> tuple[bytes, str]:
    """Bytes of a record, and a sentence on its checksum if that is wrong."""
    value = content[record.start : record.stop]
    if record.checksum in {0, checksum := zlib.crc32(value)}:
        return value, ""
    return value, f"CRC-32 {checksum:08x}. Must be {record.checksum:08x}, as listed"


def _segments(content: _Content, name: str) -> Iterator[tuple[int, int, int]]:
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


def _of_jpeg(content: _Content, name: str) -> bytes:
    """Container that the APP1 segments of a radiometric JPEG hold, joined."""
    bodies = [content[at:stop] for marker, at, stop in _segments(content, name) if marker == 0xE1]
    if not (payloads := [body for body in bodies if body.startswith(_SEGMENT)]):
        label = f"'{name}', an ordinary JPEG or one of another maker"
        rule = "Must be a radiometric JPEG; else export 16-bit counts as TIFF and use readers.tiff"
        raise ValueError(f"No thermal data of FLIR in {label}. {rule}.")
    numbers = [tuple(payload[6:8]) for payload in payloads]
    if numbers != [(i, numbers[0][-1]) for i in range(numbers[0][-1] + 1)] or len(payloads[-1]) < 8:
        label = f"FLIR segments {[i for i, *_ in numbers]}"
        raise ValueError(f"Damaged JPEG '{name}': {label}. Must be whole and in order.")
    return b"".join(payload[8:] for payload in payloads)


def _frame(content: _Content, at: int, place: str) -> tuple[_Frame, int]:
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
        if kind in {_IMAGE, _CAMERA} and kind in records:
            raise ValueError(f"Repeated record of type {kind} in {place}. Must be listed once.")
        records[kind] = _Record(at + start, min(at + start + length, size), checksum)
    # Records must lie one behind another, within the file.
    spans.sort()
    stops = [_HEADER, *(stop for _, stop in spans)]
    for before, (start, stop) in zip(stops, spans, strict=False):
        if start < before or at + stop > size + _PADDING:
            label = f"record from {start} to {stop} of {place}"
            rule = f"Must follow {before}, and end within the {size - at} bytes left"
            raise ValueError(f"Truncated or damaged file: {label}. {rule}.")
    if _IMAGE not in records:
        raise ValueError(f"Missing image in {place}. Has records {sorted(records)}.")
    return records, min(at + stops[-1], size)
