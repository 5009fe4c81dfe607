"""Readers of videos drawn in a palette.

Such a video is what its authors show: 8 bit, compressed, each frame scaled between its own
extremes. Its values are positions in a palette, not radiometric, and its attributes say so.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from dbthermal import _text as texts
from dbthermal import schema
from dbthermal._arrays import Array
from dbthermal._compiled import compiled
from reproduction.palettes._decoding import MEMORY, Film, decode

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
    60 decode to other values without complaint. `sha256` excludes that.

    Parameters
    ----------
    path : str or Path
        Regular file in MP4, MOV, Matroska, WebM or AVI, of one video that FFmpeg decodes. Addresses
        and playlists are refused, and nothing that the file names is opened.
    palette : str
        Name of a continuous colour map of matplotlib, such as ``"plasma"`` or ``"turbo"``.
    memory : float
        Largest memory that the video may take, about 9 bytes a pixel and frame [byte]; refused
        before it is taken.
    sha256 : str, optional
        Checksum of the file, 64 lower-case digits; the file is refused if it has another.

    Returns
    -------
    DataArray
        Positions (time, y, x), float32 in [0, 1]; time [s] since the first frame, from the stream's
        timestamps. Attributes: ``radiometric`` = 0, ``palette``, ``palette_residual`` (RMS distance
        of the pixels from the palette in RGB, 0-255), ``palettes_compared`` (median
        distances from each of them), ``source`` and a ``note``.

    Raises
    ------
    OSError
        If the file cannot be opened.
    TypeError, ValueError
        If the palette is unknown or another fits better; the file is of another container or
        checksum, takes more than `memory`, a number, cannot be decoded to its end or has a damaged
        frame; its timestamps do not increase, or its frames or its length are not the declared
        ones.

    Examples
    --------
    A wedge drawn in plasma and encoded at 10 Hz comes back within 0.05.

    >>> import numpy as np
    >>> from tempfile import TemporaryDirectory
    >>> from matplotlib import colormaps
    >>> from dbthermal import store
    >>> wedge = np.broadcast_to(np.linspace(0.1, 0.9, 64), (3, 48, 64))
    >>> with TemporaryDirectory() as folder:
    ...     frames = colormaps["plasma"](wedge, bytes=True)[..., :3]
    ...     store.save_video(frames, f"{folder}/wedge.mp4", {}, rate=10.0)
    ...     movie = palette_video(f"{folder}/wedge.mp4")
    >>> bool(abs(movie - wedge).max() < 0.05), movie.time.values.tolist()  # [1], [s]
    (True, [0.0, 0.1, 0.2])
    """
    path = texts.as_path(path)
    colours = _palette(palette)
    video = _distinct(decode(path, None, memory, sha256))
    position, _, distance = _nearest(video.colours, colours)
    residual = float(np.sqrt(np.average(distance**2, weights=video.share)))
    attrs = _attrs(path, palette, residual, video.colours, video.share)
    return xr.DataArray(position[video.index], video.coords, attrs=attrs, name="movie")


def masked_palette_video(
    path: str | Path,
    palette: str = "turbo",
    width: int | None = None,
    *,
    memory: float = MEMORY,
    sha256: str | None = None,
) -> xr.Dataset:
    """Video whose object is drawn in a palette while the rest is gray.

    A pixel is valid where its colour is nearer to the palette than to gray, in the measure of
    `palette_video`. Compression pulls single pixels between strong colours over that line, so the
    object's outline is best taken from the share of frames in which a pixel is valid.

    Parameters
    ----------
    path : str or Path
        File as for `palette_video`.
    palette : str
        Name of a continuous colour map of matplotlib.
    width : int, optional
        Columns to keep [pixel], left of a printed colour bar.
    memory, sha256 : optional
        As for `palette_video`.

    Returns
    -------
    Dataset
        `value` (time, y, x), float32 in [0, 1], a position also where it is not valid; `valid`
        (time, y, x), bool. Attributes of `value` as in `palette_video`, but ``palette_residual`` is
        the median over the coloured pixels.

    Raises
    ------
    FileNotFoundError, TypeError, ValueError
        As `palette_video`; also if the video is narrower than `width`, or has no coloured pixel.

    Examples
    --------
    The left half of the video is drawn in turbo, the right half is gray.

    >>> import numpy as np
    >>> from tempfile import TemporaryDirectory
    >>> from matplotlib import colormaps
    >>> from dbthermal import store
    >>> frames = np.full((3, 48, 64, 3), 90, dtype=np.uint8)
    >>> frames[:, :, :32] = colormaps["turbo"](np.linspace(0.2, 0.8, 32), bytes=True)[:, :3]
    >>> with TemporaryDirectory() as folder:
    ...     store.save_video(frames, f"{folder}/half.mp4", {}, rate=10.0)
    ...     masked_palette_video(f"{folder}/half.mp4").valid[0, 24, [10, 50]].values.tolist()
    [True, False]
    """
    path = texts.as_path(path)
    colours = _palette(palette)
    video = _distinct(decode(path, width, memory, sha256))
    position, from_palette, distance = _nearest(video.colours, colours)
    coloured = np.ptp(video.colours, axis=1) > _COLOURED
    if not coloured.any():
        raise ValueError(f"No coloured pixel in '{path.name}'. Must show an object in a palette.")
    share = video.share[coloured]
    residual = np.quantile(distance[coloured], 0.5, weights=share, method="inverted_cdf")
    valid = from_palette < np.linalg.norm(_ycc(video.colours)[:, 1:], axis=1)
    attrs = _attrs(path, palette, float(residual), video.colours[coloured], share)
    dims = tuple(video.coords)
    mask_attrs = {"units": "1", "long_name": "nearer to the palette than to gray"}
    return xr.Dataset(
        {
            "value": (dims, position[video.index], attrs),
            "valid": (dims, valid[video.index], mask_attrs),
        },
        video.coords,
    )


@dataclass(frozen=True)
class _Video:
    """Frames as `index` (time, y, x) into their distinct `colours` (n, 3), and each one's share."""

    colours: Array
    share: Array
    index: NDArray[np.uint32]
    coords: dict[str, Any]


def _distinct(film: Film) -> _Video:
    """Replace each code, in place, by its place among the distinct ones."""
    codes = film.codes
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
    coords = {"time": ("time", film.times, schema.COORDINATES["time"].attrs)} | {
        dim: (dim, np.arange(size), {"units": "1", "long_name": "pixel"})
        for dim, size in zip("yx", codes.shape[1:], strict=True)
    }
    return _Video(colours, count / count.sum(), codes, coords)


def _palette(name: str) -> Array:
    """Colours (256, 3) [0-255] of a palette."""
    from matplotlib import colormaps  # noqa: PLC0415  (drawing is not needed to read a spectrum)

    if name not in colormaps or colormaps[name].N != 256:
        raise ValueError(f"Unknown palette '{name}'. Must be a colour map of matplotlib with 256.")
    return np.asarray(colormaps[name](np.arange(256))[:, :3] * 255.0)


def _ycc(colours: Array) -> Array:
    ycc: Array = colours @ _YCC.T
    return ycc


def _nearest(colours: Array, palette: Array) -> tuple[NDArray[np.float32], Array, Array]:
    """Position in the palette, distance from it in the measure, and in RGB [0-255]."""
    place, distance = np.empty((2, len(colours)))
    _project(_ycc(colours), _ycc(palette), place, distance)
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
            one, two, three = x - corners[i, 0], y - corners[i, 1], z - corners[i, 2]
            squares[i] = one * one + two * two + three * three
        best, within = np.inf, (np.sqrt(squares.min()) + longest) ** 2
        for i in range(len(steps)):
            if min(squares[i], squares[i + 1]) > within:
                continue
            along, left = 0.0, 0.0
            for k in range(3):
                along += (points[p, k] - corners[i, k]) * steps[i, k]
            share = min(max(along / max(lengths[i], 1e-300), 0.0), 1.0)
            for k in range(3):
                left += (points[p, k] - corners[i, k] - share * steps[i, k]) ** 2
            if left < best:
                best, place[p] = left, i + share
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
