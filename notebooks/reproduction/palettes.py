"""Videos drawn in a palette, as positions in the palette.

Such a video is what its authors show: 8 bit, compressed, each frame scaled between its own
extremes. Its values are not radiometric, and its attributes say so.

FFmpeg reads many things that are no file: addresses, playlists, patterns of names, files in files.
So the bytes are read here, and their container is decided here, from a short list. Nothing else is
opened. Most codecs, H.264 among them, carry no checksum: damage to their compressed numbers often
decodes without complaint. Only the checksum of the file excludes it.
"""

import hashlib
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NoReturn

import av
import numpy as np
import xarray as xr
from matplotlib import colormaps
from numpy.typing import NDArray

from dbthermal import _text as texts
from dbthermal import schema
from dbthermal._arrays import Array
from dbthermal._compiled import compiled
from dbthermal._numbers import POSITIVE, real_numbers

MEMORY: Final = 2.0**30  # largest memory that a video may take, by default [byte]
PIXEL: Final = 9  # memory of a pixel: number of its colour, position in the palette, mask [byte]

_CONTAINERS: Final = {
    "mp4": (4, (b"ftyp", b"moov", b"mdat", b"wide", b"free")),
    "matroska": (0, (b"\x1a\x45\xdf\xa3",)),
    "avi": (8, (b"AVI ",)),
}
"""FFmpeg's name of a container -> where its mark stands in the file [byte], and the marks."""


Film = tuple[NDArray[np.uint32], Array]
"""Frames of a video as packed colours (time, y, x), red highest, and their times (time,) [s]."""


def _decode(path: Path, width: int | None, memory: float, sha256: str | None) -> Film:
    """Decode a video left of `width` [pixel]; see `palette_video`."""
    real_numbers("memory", memory, POSITIVE)
    content = texts.regular_file(path, int(memory)).read_bytes()
    kinds = _CONTAINERS.items()
    form = next((name for name, (at, marks) in kinds if content[at : at + 4] in marks), None)
    digest = hashlib.sha256(content).hexdigest()
    if sha256 is not None and digest != sha256:
        raise ValueError(f"Wrong SHA-256 {digest} of '{path.name}'. Must be {sha256}.")
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
    return codes, seconds - seconds[0]


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


# Palettes in which thermal pictures are drawn, compared in so many pixels; another is better only
# if it is nearer by a step of 8 bit.
_COMPARED: Final = (
    *("plasma", "inferno", "magma", "viridis", "cividis"),
    *("turbo", "jet", "hot", "coolwarm", "gray"),
)
_SAMPLE, _STEP = 4096, 1.0

_YCC: Final = np.array(
    [
        [0.299, 0.587, 0.114],  # luma, ITU-R BT.601
        [-0.084368, -0.165632, 0.25],  # half the blue and half the red difference
        [0.25, -0.209344, -0.040656],
    ]
)
_COLOURED: Final = 30  # least difference between the channels of a coloured pixel [0-255]


def palette_video(
    path: str | Path, palette: str = "plasma", *, memory: float = MEMORY, sha256: str | None = None
) -> xr.DataArray:
    """Video drawn in a palette, as positions in the palette.

    Each pixel gets the position of the nearest point on the line through the palette's colours in
    Y'CbCr, finer than its steps; luma counts whole and chroma half, of which four pixels share a
    sample. Measured on synthetic H.264 videos, the RMS error is 6-28 % (plasma) and 7-15 % (turbo)
    below that of the nearest of 256 colours in RGB. A palette and its reverse cannot be told apart.
    Noise takes pixels off the palette: how far is stated, and only a video that another common
    palette fits better is refused.

    H.264 carries no checksum: of 200 files with one flipped bit, a block of zeros or a cut, up to
    60 decode to other values without complaint. `sha256`, of 64 lower-case digits, excludes that.

    The file, in MP4, MOV, Matroska, WebM or AVI, is of one video that takes at most so much memory
    [byte], about 9 a pixel and frame; a larger one is refused before it is taken. So are addresses
    and playlists, and nothing that the file names is opened. The palette is a continuous colour map
    of matplotlib.

    The result has positions (time, y, x), float32 in [0, 1]; time [s] since the first frame, from
    the stream's timestamps. Attributes: ``radiometric`` = 0, ``palette``, ``palette_residual`` (RMS
    distance of the pixels from the palette in RGB, 0-255), ``palettes_compared`` (median distances
    from each of them), ``source`` and a ``note``.

    OSError if the file cannot be opened. TypeError or ValueError if the palette is unknown or
    another fits better; the file is of another container or checksum, is too large, cannot be
    decoded to its end or has a damaged frame; its timestamps do not increase, or its frames or its
    length are not the declared ones.
    """
    path = texts.as_path(path)
    colours = _palette(palette)
    video = _distinct(*_decode(path, None, memory, sha256))
    position, _, distance = _nearest(video.colours, colours)
    residual = float(np.sqrt(np.average(distance**2, weights=video.share)))
    attrs = _attrs(path, palette, residual, video.colours, video.share)
    return xr.DataArray(position[video.index], video.coords, attrs=attrs, name="movie")


def masked_palette_video(
    path: str | Path, palette: str = "turbo", width: int | None = None
) -> xr.Dataset:
    """Video whose object is drawn in a palette while the rest is gray; see `palette_video`.

    A pixel is valid where its colour is nearer to the palette than to gray, in the same measure.
    Compression pulls single pixels between strong colours over that line, so the object's outline
    is best taken from the share of frames in which a pixel is valid. Columns to keep are those left
    of a printed colour bar [pixel].

    The dataset has `value` (time, y, x), float32 in [0, 1], a position also where it is not valid,
    whose ``palette_residual`` is the median over the coloured pixels, and `valid` (time, y, x),
    bool. ValueError, too, if the video is narrower than `width`, or has no coloured pixel.
    """
    path = texts.as_path(path)
    colours = _palette(palette)
    video = _distinct(*_decode(path, width, MEMORY, None))
    position, from_palette, distance = _nearest(video.colours, colours)
    coloured = np.ptp(video.colours, axis=1) > _COLOURED
    if not coloured.any():
        raise ValueError(f"No coloured pixel in '{path.name}'. Must show an object in a palette.")
    share = video.share[coloured]
    residual = np.quantile(distance[coloured], 0.5, weights=share, method="inverted_cdf")
    valid = from_palette < np.linalg.norm((video.colours @ _YCC.T)[:, 1:], axis=1)
    attrs = _attrs(path, palette, float(residual), video.colours[coloured], share)
    dims = tuple(video.coords)
    mask_attrs = {"units": "1", "long_name": "nearer to the palette than to gray"}
    mask = (dims, valid[video.index], mask_attrs)
    return xr.Dataset({"value": (dims, position[video.index], attrs), "valid": mask}, video.coords)


@dataclass(frozen=True)
class _Video:
    """Frames as `index` (time, y, x) into their distinct `colours` (n, 3), and each one's share."""

    colours: Array
    share: Array
    index: NDArray[np.uint32]
    coords: dict[str, Any]


def _distinct(codes: NDArray[np.uint32], times: Array) -> _Video:
    """Replace each code, in place, by its place among the distinct ones."""
    present = np.zeros(2**24, dtype=bool)
    for frame in codes:
        present[frame] = True
    distinct = np.flatnonzero(present)
    place = np.zeros(2**24, dtype=np.uint32)
    place[distinct] = np.arange(distinct.size)
    count = np.zeros(distinct.size)
    for frame in codes:
        frame[...] = place[frame]
        count += np.bincount(frame.ravel(), minlength=distinct.size)
    colours = (distinct[:, np.newaxis] >> np.array([16, 8, 0]) & 255).astype(np.float64)
    coords = {"time": ("time", times, schema.COORDINATES["time"].attrs)} | {
        dim: (dim, np.arange(size), {"units": "1", "long_name": "pixel"})
        for dim, size in zip("yx", codes.shape[1:], strict=True)
    }
    return _Video(colours, count / count.sum(), codes, coords)


def _palette(name: str) -> Array:
    """Colours (256, 3) [0-255] of a palette."""
    if name not in colormaps or colormaps[name].N != 256:
        raise ValueError(f"Unknown palette '{name}'. Must be a colour map of matplotlib with 256.")
    return np.asarray(colormaps[name](np.arange(256))[:, :3] * 255.0)


def _nearest(colours: Array, palette: Array) -> tuple[NDArray[np.float32], Array, Array]:
    """Position in the palette, distance from it in the measure, and in RGB [0-255]."""
    place, distance = np.empty((2, len(colours)))
    _project(colours @ _YCC.T, palette @ _YCC.T, place, distance)
    first = np.minimum(place.astype(np.intp), len(palette) - 2)
    nearest = palette[first] + (place - first)[:, np.newaxis] * np.diff(palette, axis=0)[first]
    position = (place / (len(palette) - 1)).astype(np.float32)
    return position, distance, np.linalg.norm(colours - nearest, axis=1)


@compiled
def _project(points: Array, corners: Array, place: Array, distance: Array) -> None:
    """Place [corner] on a line through corners (corner, 3) nearest to points (n, 3), and how near.

    In place. A part of the line that is nearer than all corners ends within its length of them.
    """
    steps = corners[1:] - corners[:-1]
    lengths, squares = np.sum(steps**2, axis=1), np.empty(len(corners))
    longest = np.sqrt(lengths.max())
    for p in range(len(points)):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        for i in range(len(corners)):
            red, green, blue = x - corners[i, 0], y - corners[i, 1], z - corners[i, 2]
            squares[i] = red * red + green * green + blue * blue
        best, within = np.inf, (np.sqrt(squares.min()) + longest) ** 2
        for i in range(len(steps)):
            if min(squares[i], squares[i + 1]) > within:
                continue
            along, remainder = 0.0, 0.0
            for k in range(3):
                along += (points[p, k] - corners[i, k]) * steps[i, k]
            share = min(max(along / max(lengths[i], 1e-300), 0.0), 1.0)
            for k in range(3):
                remainder += (points[p, k] - corners[i, k] - share * steps[i, k]) ** 2
            if remainder < best:
                best, place[p] = remainder, i + share
        distance[p] = np.sqrt(best)


def _attrs(
    path: Path, palette: str, residual: float, colours: Array, share: Array
) -> dict[str, Any]:
    """Attributes of positions in a palette; ValueError if another fits the colours better."""
    summed = np.cumsum(share)
    levels = (np.arange(_SAMPLE) + 0.5) / _SAMPLE * summed[-1]
    sample, names = colours[np.searchsorted(summed, levels)], {palette, *_COMPARED}
    fits = {name: float(np.median(_nearest(sample, _palette(name))[2])) for name in names}
    order = sorted(fits, key=lambda name: fits[name])
    if fits[order[0]] < fits[palette] - _STEP:
        raise ValueError(
            f"Palette '{palette}' does not fit '{path.name}': its pixels are {fits[palette]:.1f} "
            f"from it, but {fits[order[0]]:.1f} from '{order[0]}' (0-255). Must be the nearest."
        )
    return {
        "units": "1",
        "long_name": f"position in the palette {palette}",
        "radiometric": 0,
        "palette": palette,
        "palette_residual": residual,
        "palettes_compared": ", ".join(f"{name} {fits[name]:.1f}" for name in order),
        "source": path.name,
        "note": "not radiometric: 8 bit, compressed, scaled per frame",
    }
