"""Frames of a video file: all of them, undamaged by all that its decoder can tell, or none.

FFmpeg reads many things that are no file: addresses, playlists, patterns of names, files in files.
So the bytes are read here, and their container is decided here, from a short list. Nothing else is
opened. Most codecs, H.264 among them, carry no checksum: damage to their compressed numbers often
decodes without complaint. Only the checksum of the file excludes it.
"""

import hashlib
import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from dbthermal import _text as texts
from dbthermal import schema

MEMORY: Final = 2.0**30
"""Largest memory that a video may take, by default [byte]."""

PIXEL: Final = 9
"""Memory of a pixel of a frame: number of its colour, position in the palette, mask [byte]."""

_CONTAINERS: Final = {
    "mp4": (4, (b"ftyp", b"moov", b"mdat", b"wide", b"free")),
    "matroska": (0, (b"\x1a\x45\xdf\xa3",)),
    "avi": (8, (b"AVI ",)),
}
"""FFmpeg's name of a container -> where its mark stands in the file [byte], and the marks."""


class Film(NamedTuple):
    """Frames of a video as packed colours (time, y, x), red highest, and their coordinates."""

    codes: NDArray[np.uint32]
    coords: dict[str, Any]


def decode(path: Path, width: int | None, memory: float, sha256: str | None) -> Film:
    """Decode a video left of `width` [pixel]; see `dbthermal.readers.palette_video`."""
    import av  # noqa: PLC0415  (a spectrum needs no video codec)

    content = texts.regular_file(path, int(memory)).read_bytes()
    found = hashlib.sha256(content).hexdigest()
    if sha256 is not None and found != sha256:
        raise ValueError(f"Wrong SHA-256 {found} of '{path.name}'. Must be {sha256}.")
    # The largest frame that may be decoded, and checks where a codec has checksums.
    options = {"max_pixels": str(int(memory / PIXEL)), "err_detect": "crccheck"}
    try:
        with av.open(
            io.BytesIO(content),
            format=_container(content, path),
            options=options,
            metadata_errors="replace",
            io_open=_refuse_to_open,
        ) as container:
            return _frames(container, options, width, memory, path)
    except av.FFmpegError as error:
        raise ValueError(
            f"Damaged video '{path.name}': '{error}'. Must decode to its end."
        ) from error


def _refuse_to_open(url: str, *_: Any) -> NoReturn:
    raise PermissionError(f"Refused to open '{url}', which a video names. Must be one file.")


def _container(content: bytes, path: Path) -> str:
    for name, (offset, marks) in _CONTAINERS.items():
        if content[offset : offset + 4] in marks:
            return name
    raise ValueError(f"Invalid video '{path.name}'. Must be MP4, MOV, Matroska, WebM or AVI.")


def _frames(
    container: Any, options: dict[str, str], width: int | None, memory: float, path: Path
) -> Film:
    """Decode all packets, once their number and the frames' size are known and allowed."""
    if len(container.streams.video) != 1 or container.streams.video[0].codec_context is None:
        number = len(container.streams.video)
        raise ValueError(f"Invalid {number} video streams in '{path.name}'. Must be a known one.")
    stream = container.streams.video[0]
    packets = [*container.demux(stream)]  # the last is empty: it asks for the frames still held
    number = sum(packet.size > 0 for packet in packets)
    height, columns = stream.codec_context.height, stream.codec_context.width
    _check_size(number, stream.frames, (height, columns), memory, path)
    if width is not None and not 0 < width <= columns:
        raise ValueError(
            f"Invalid width {width} for '{path.name}'. Must be from 1 to {columns} pixels."
        )
    codes = np.empty((number, height, width or columns), dtype=np.uint32)
    times: list[float | None] = []
    stream.codec_context.options = options
    stream.codec_context.thread_count = 1  # others lose marks of damage
    for frame in _undamaged(packets, path):
        if len(times) == number or (frame.height, frame.width) != (height, columns):
            raise ValueError(
                f"Damaged video '{path.name}': frame {len(times)} of {frame.height} x "
                f"{frame.width} pixels. Must be {number} of {height} x {columns}."
            )
        rgb = frame.to_ndarray(format="rgb24")[:, :width]
        codes[len(times)] = rgb @ np.array([2**16, 2**8, 1], dtype=np.uint32)
        times.append(frame.time)
    if not times or len(times) != number:
        raise ValueError(
            f"Truncated video '{path.name}': {len(times)} frames decoded, {number} present. "
            "Must be equal."
        )
    seconds = np.array(times, dtype=np.float64)  # None becomes NaN
    if not np.all(np.diff(seconds, prepend=seconds[0] - 1) > 0):
        raise ValueError(f"Unordered timestamps in '{path.name}'. Must increase strictly.")
    _check_duration(container, stream, seconds, path)
    return Film(codes, _coords(seconds, codes.shape[1:]))


def _check_size(
    number: int, declared: int, shape: tuple[int, int], memory: float, path: Path
) -> None:
    """Raise ValueError if frames are missing, or all of them need more memory than is allowed."""
    if number != (declared or number):
        raise ValueError(
            f"Truncated video '{path.name}': {number} frames present, {declared} declared. "
            "Must be equal."
        )
    needed = number * shape[0] * shape[1] * PIXEL
    if needed > memory:
        raise ValueError(
            f"Invalid size of '{path.name}': {number} frames of {shape[0]} x {shape[1]} pixels "
            f"take {needed:.3g} bytes. Must be at most memory={memory:.3g}."
        )


def _undamaged(packets: Sequence[Any], path: Path) -> Iterator[Any]:
    """Yield the frames of packets; ValueError at the first that the decoder marks as damaged."""
    count = 0
    for packet in packets:
        frames = packet.decode()
        if packet.is_corrupt or any(frame.is_corrupt for frame in frames):
            raise ValueError(
                f"Damaged video '{path.name}': frame {count} or a later one is marked corrupt. "
                "Must decode without damage."
            )
        yield from frames
        count += len(frames)


def _check_duration(container: Any, stream: Any, seconds: NDArray[Any], path: Path) -> None:
    """Compare the length of the play with the declared one, to half a frame."""
    declared = []
    if stream.duration is not None:
        declared.append(float(stream.duration * stream.time_base))
    if container.duration is not None:
        declared.append(container.duration / 1e6)  # FFmpeg counts microseconds
    if not declared and not stream.frames:
        raise ValueError(f"Unknown length of '{path.name}'. Must declare its frames or its time.")
    rate = stream.guessed_rate or np.inf  # [Hz]; without it, any declared time is wrong
    interval = np.median(np.diff(seconds)) if len(seconds) > 1 else 1 / rate
    length = seconds[-1] - seconds[0] + interval
    for value in declared:
        if abs(value - length) > interval / 2:
            raise ValueError(
                f"Truncated video '{path.name}': {length:g} s of frames, {value:g} s declared. "
                "Must be equal."
            )


def _coords(seconds: NDArray[Any], shape: tuple[int, ...]) -> dict[str, Any]:
    time = ("time", seconds - seconds[0], schema.COORDINATES["time"].attrs)
    pixels = {dim: (dim, np.arange(size)) for dim, size in zip("yx", shape, strict=True)}
    attrs = {"units": "1", "long_name": "pixel"}
    return {"time": time} | {dim: (*pixel, attrs) for dim, pixel in pixels.items()}
