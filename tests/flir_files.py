"""FLIR recordings made from counts, in all forms that the format allows."""

import struct
import zlib
from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

Counts = NDArray[np.uint16]
Values = Mapping[int, float] | None
CONSTANTS = {0x58: 21106.77, 0x5C: 1501.0, 0x60: 1.0, 0x30C: 0.012545258}


def scene(frames: int = 3, shape: tuple[int, int] = (24, 32)) -> Counts:
    """Smooth counts with noise, each frame another."""
    rng = np.random.default_rng(5)
    y, x = np.mgrid[: shape[0], : shape[1]]
    image = 17900 + 20 * y + 13 * x
    noise = rng.normal(0, 4, (frames, *shape))
    return np.asarray(image + 100 * np.arange(frames)[:, None, None] + noise, dtype=np.uint16)


def compressed(image: Counts, codec: str) -> bytes:
    """Image by a codec of FFmpeg; PNG with its bytes swapped, as in FLIR's cameras."""
    values = image.byteswap() if codec == "png" else image
    picture = av.VideoFrame.from_ndarray(values, format="gray16le")
    if codec == "png":
        picture = picture.reformat(format="gray16be")
    context: Any = av.CodecContext.create(codec, "w")
    context.height, context.width = image.shape
    context.pix_fmt, context.time_base = picture.format.name, Fraction(1, 25)
    return b"".join(bytes(packet) for packet in [*context.encode(picture), *context.encode(None)])


def geometry(image: Counts, number: int, order: str) -> bytes:
    """First 32 bytes of image and camera."""
    height, width = image.shape
    return struct.pack(order + "16H", 2, width, height, *[0] * 9, number, 0, 0, 0)


def camera(image: Counts, number: int, seconds: float, order: str, values: Values = None) -> bytes:
    """Camera's record of 2476 bytes."""
    record = bytearray(2476)
    record[:32] = geometry(image, number, order)
    stated = {0x20: 0.95, 0x24: 1.0, 0x28: 293.15, 0x2C: 293.15, 0x30: 293.15, 0x34: 1.0, 0x3C: 0.5}
    stated |= CONSTANTS | {0x90: 393.15, 0x94: 233.15}
    stated |= values or {}
    for place, value in stated.items():
        struct.pack_into(order + "f", record, place, value)
    struct.pack_into(order + "i", record, 0x308, -7340)
    struct.pack_into(order + "H", record, 0x464, 30)
    whole = int(seconds)
    struct.pack_into(order + "II", record, 0x384, whole, round((seconds - whole) * 1000))
    record[0xD4:0xE0] = b"Made up 1\0\xff\xff"
    return bytes(record)


def frame(records: Sequence[tuple[int, int, bytes]], order: str = "<", *, sums: bool) -> bytes:
    """Header, directory and records of a frame."""
    place, count = 64 + 32 * (len(records) + 1), len(records) + 1
    entries, content = b"", b""
    for kind, subtype, body in records:
        checksum = zlib.crc32(body) if sums else 0
        entry = (kind, subtype, 100, 1, place + len(content), len(body), 0, 0, checksum)
        entries, content = entries + struct.pack(order + "HHIIIIIII", *entry), content + body
    head = b"FFF\0" + b"Tests".ljust(16, b"\0") + struct.pack(order + "3I", 100, 64, count)
    return head.ljust(64, b"\0") + entries + bytes(32) + content


def sequence(
    counts: Counts,
    codec: str = "",
    order: str = "<",
    *,
    inner: str = "<",
    seconds: Sequence[float] | None = None,
    sums: bool = False,
    values: Values = None,
    packed: bytes = b"",
) -> bytes:
    """All frames, one after the other, zeros between; `inner` is the order in the records."""
    times = [1.5e9 + 0.125 + k / 10 for k in range(len(counts))] if seconds is None else seconds
    parts = []
    for number, (image, moment) in enumerate(zip(counts, times, strict=True)):
        body = packed or compressed(image, codec) if codec else image.astype(f"{inner}u2").tobytes()
        kind = {"": 2, "png": 3, "jpegls": 4}[codec]
        records = [
            (32, 0, camera(image, number, moment, inner, values)),
            (1, kind, geometry(image, number, inner) + body),
            (43, 1, b"FFF\0 is no header in here"),
        ]
        parts.append(frame(records, order, sums=sums) + bytes(8))
    return b"".join(parts)


def jpeg(content: bytes, size: int = 3000) -> bytes:
    """Radiometric JPEG: the container in pieces, within a picture."""
    pieces = [content[k : k + size] for k in range(0, len(content), size)]
    heads = [b"FLIR\0\x01" + bytes([k, len(pieces) - 1]) for k in range(len(pieces))]
    segments = [
        b"\xff\xe1" + struct.pack(">H", len(head + piece) + 2) + head + piece
        for head, piece in zip(heads, pieces, strict=True)
    ]
    exif = b"\xff\xe1\x00\x08Exif\0\0"
    return b"\xff\xd8" + exif + b"".join(segments) + b"\xff\xda\x00\x02picture\xff\xd9"
