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
from dbthermal.planck import require_positive

MEMORY: Final = 2.0**30  # largest memory that a video may take, by default [byte]
PIXEL: Final = 9  # memory of a pixel: number of its colour, position in the palette, mask [byte]

_CONTAINERS: Final = {
    "mp4": (4, (b"ftyp", b"moov", b"mdat", b"wide", b"free")),
    "matroska": (0, (b"\x1a\x45\xdf\xa3",)),
    "avi": (8, (b"AVI ",)),
}
"""FFmpeg's name of a container -> where its mark stands in the file [byte], and the marks."""


class Film(NamedTuple):
    """Frames of a video as packed colours (time, y, x), red highest, and their times [s]."""

    codes: NDArray[np.uint32]
    times: NDArray[np.float64]


def decode(path: Path, width: int | None, memory: float, sha256: str | None) -> Film:
    """Decode a video left of `width` [pixel]; see `palette_video`."""
    import av  # noqa: PLC0415  (a spectrum needs no video codec)

    require_positive("memory", memory)
    content = texts.regular_file(path, int(memory)).read_bytes()
    kinds = _CONTAINERS.items()
    form = next((name for name, (at, marks) in kinds if content[at : at + 4] in marks), None)
    found = hashlib.sha256(content).hexdigest()
    if sha256 is not None and found != sha256:
        raise ValueError(f"Wrong SHA-256 {found} of '{path.name}'. Must be {sha256}.")
    if form is None:
        raise ValueError(f"Invalid video '{path.name}'. Must be MP4, MOV, Matroska, WebM or AVI.")
    # The largest frame that may be decoded, and checks where a codec has checksums.
    options = {"max_pixels": str(int(memory / PIXEL)), "err_detect": "crccheck"}
    try:
        with av.open(
            io.BytesIO(content),
            format=form,
            options=options,
            metadata_errors="replace",
            io_open=_refuse_to_open,
        ) as container:
            return _frames(container, options, width, memory, path)
    except av.FFmpegError as error:
        message = f"Damaged video '{path.name}': '{error}'. Must decode to its end."
        raise ValueError(message) from error


def _refuse_to_open(url: str, *_: Any) -> NoReturn:
    raise PermissionError(f"Refused to open '{url}', which a video names. Must be one file.")


def _frames(
    container: Any, options: dict[str, str], width: int | None, memory: float, path: Path
) -> Film:
    """Decode all packets, once their number and the frames' size are known and allowed."""
    if len(streams := container.streams.video) != 1 or streams[0].codec_context is None:
        rule = "Must be a known one"
        raise ValueError(f"Invalid {len(streams)} video streams in '{path.name}'. {rule}.")
    stream = streams[0]
    packets = [*container.demux(stream)]  # the last is empty: it asks for the frames still held
    number = sum(packet.size > 0 for packet in packets)
    height, columns = stream.codec_context.height, stream.codec_context.width
    if number != (stream.frames or number):
        _refuse_truncated(path, f"{number} frames present, {stream.frames} declared")
    if (needed := number * height * columns * PIXEL) > memory:
        raise ValueError(
            f"Invalid size of '{path.name}': {number} frames of {height} x {columns} pixels "
            f"take {needed:.3g} bytes. Must be at most memory={memory:.3g}."
        )
    if width is not None and not 0 < width <= columns:
        rule = f"Must be from 1 to {columns} pixels"
        raise ValueError(f"Invalid width {width} for '{path.name}'. {rule}.")
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
        _refuse_truncated(path, f"{len(times)} frames decoded, {number} present")
    seconds = np.array(times, dtype=np.float64)  # None becomes NaN
    if not np.all(np.diff(seconds, prepend=seconds[0] - 1) > 0):
        raise ValueError(f"Unordered timestamps in '{path.name}'. Must increase strictly.")
    _check_duration(container, seconds, path)
    _check_segment(path)
    return Film(codes, seconds - seconds[0])


def _undamaged(packets: Sequence[Any], path: Path) -> Iterator[Any]:
    """Yield the frames of packets; ValueError at the first that the decoder marks as damaged."""
    count = 0
    for packet in packets:
        frames = packet.decode()
        if packet.is_corrupt or any(frame.is_corrupt for frame in frames):
            what = f"frame {count} or a later one is marked corrupt"
            raise ValueError(f"Damaged video '{path.name}': {what}. Must decode without damage.")
        yield from frames
        count += len(frames)


def _check_duration(container: Any, seconds: NDArray[Any], path: Path) -> None:
    """Compare the length of the play with the declared one, to half a frame."""
    stream = container.streams.video[0]
    lengths = (stream.duration, stream.time_base), (container.duration, 1e-6)
    declared = [float(length * unit) for length, unit in lengths if length is not None]
    if not declared and not stream.frames:
        raise ValueError(f"Unknown length of '{path.name}'. Must declare its frames or its time.")
    rate = stream.guessed_rate or np.inf  # [Hz]; without it, any declared time is wrong
    interval = np.median(np.diff(seconds)) if len(seconds) > 1 else 1 / rate
    length = seconds[-1] - seconds[0] + interval
    for value in declared:
        if abs(value - length) > interval / 2:
            _refuse_truncated(path, f"{length:g} s of frames, {value:g} s declared")


def _check_segment(path: Path) -> None:
    """Compare a Matroska file's size with its segment's, which a cut leaves too large."""
    with path.open("rb") as stream:
        head = stream.read(300)
    if (place := head.find(b"\x18\x53\x80\x67", 0, 200) + 4) > 4:  # RFC 8794, section 4: sizes
        width = 9 - head[place].bit_length()
        size, unknown = int.from_bytes(head[place : place + width]), 1 << 7 * width
        end = place + width + size - unknown
        if size + 1 < 2 * unknown and end > path.stat().st_size:
            _refuse_truncated(path, f"{path.stat().st_size} bytes, {end} declared")


def _refuse_truncated(path: Path, lengths: str) -> NoReturn:
    raise ValueError(f"Truncated video '{path.name}': {lengths}. Must be equal.")
