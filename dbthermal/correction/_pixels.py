"""Bad pixels that only a capture shows: noisy, stuck, and those that jump by themselves.

A blackbody finds the pixels that are bad at the time of the calibration (`fit_correction`). Some
turn bad later, or blink (random telegraph signal) too seldom for it.
"""

from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.ndimage import maximum_filter1d, median_filter
from scipy.special import ndtri

from dbthermal import schema
from dbthermal.correction._nonuniformity import OUTLIER
from dbthermal.noise import MAD
from dbthermal.schema import Status

Array = npt.NDArray[np.float64]
Single = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

# Fewest frames from which a pixel is judged.
_MINIMUM_FRAMES: Final = 16
# Share of a pixel's changes, the smallest ones, that is noise: the rest may be the scene's.
_QUIET = 0.8
# Mean magnitude of that share of a standard normal distribution.
_QUIET_MEAN = 2.0 * (1.0 - np.exp(-0.5 * ndtri(0.9) ** 2)) / np.sqrt(2.0 * np.pi) / _QUIET
# A pixel is held against those around it: the median of a window this wide, and the eight nearest.
_WINDOW = 5
_NEIGHBOURS = [(y, x) for y in range(3) for x in range(3) if (y, x) != (1, 1)]
# A neighbour shares a jump of which it shows this part, earlier or later by at most so many seconds
# or, at slow frame rates, frames.
_SHARED = 0.3
_REACH_SECONDS = 0.2
_REACH_FRAMES = 5
# Differences of the logarithm of the noise that are rounding [1].
_ROUNDING = 0.01
# Samples of a block of rows.
_BLOCK = 8_000_000


def mark_bad(corrected: xr.Dataset, *, threshold: float = OUTLIER) -> xr.Dataset:
    r"""
    Mark pixels that are noisy, stuck or jump by themselves, in any band.

    Noise. A pixel's noise s is the mean magnitude of the smaller four fifths of its second
    differences in time, so that neither object nor walkers enter. With m the median of s over 5 by
    5 pixels, a pixel is bad whose :math:`\ln (s / m)` lies more than `threshold` robust standard
    deviations (1.48 times the median absolute deviation over the image) off the median. A pixel
    that never changes is bad.

    Jumps. A pixel is bad that changes from one frame to the next by more than `threshold` standard
    deviations of a difference, :math:`\sqrt 2 m`, while none of its eight neighbours changes in the
    same direction by 0.3 of it within 0.2 s or five frames, the longer. Someone walking by is seen
    by neighbours, be it a little later; a detector that blinks is alone. Frames that are NaN, the
    steps between segments, and 0.2 s or five frames at either end do not count. A scene's detail
    that is one pixel wide, such as a wire, cannot be told from a pixel that blinks, and is marked,
    too.

    Parameters
    ----------
    corrected : Dataset
        Stage `corrected` of `schema`, after `mark_shutter`; read in blocks of rows.
    threshold : float
        Limit of the robust z-score of the noise, and of a jump relative to the noise of a
        difference [1].

    Returns
    -------
    Dataset
        The dataset with the bit `Status.DEAD_PIXEL` set in `status` (y, x), other bits as they
        were, the counts unchanged; and the attributes ``noisy_pixels`` and ``jumping_pixels``,
        their numbers, and ``bad_threshold``.

    Raises
    ------
    TypeError, ValueError
        If the threshold is not positive, or a band has fewer frames that are not NaN than 16, or
        than 0.4 s and three frames more.

    Examples
    --------
    One pixel blinks: it is 80 counts too high for a second.

    >>> import numpy as np, xarray as xr
    >>> counts = np.random.default_rng(1).normal(20000, 4, (1, 60, 12, 12))  # [count]
    >>> counts[0, 30:40, 5, 7] += 80
    >>> corrected = xr.Dataset(
    ...     {"counts": (("band", "time", "y", "x"), counts)},
    ...     {"band": ["8-14"], "time": np.arange(60) / 10.0},
    ... )
    >>> marked = mark_bad(corrected)
    >>> np.argwhere(marked.status.values).tolist(), marked.jumping_pixels
    ([[5, 7]], 1)
    """
    counts = schema.check(corrected, "corrected")["counts"]
    if not threshold > 0:
        raise ValueError(f"Invalid threshold {threshold} of bad pixels. Must be positive.")
    segment = corrected["segment"].values if "segment" in corrected else None
    image = (counts.sizes["y"], counts.sizes["x"])
    noisy, jumping = np.zeros(image, dtype=bool), np.zeros(image, dtype=bool)
    reach = _reach(counts["time"].values.astype(np.float64))
    for band in range(counts.sizes["band"]):
        movie = counts.isel(band=band)
        frames = _frames(movie, max(_MINIMUM_FRAMES, 2 * reach + 3))
        part = np.zeros(frames.size) if segment is None else segment[frames]
        movie, stepped = movie.isel(time=frames), np.diff(part) != 0
        level = _noise(movie)
        usual = median_filter(level, size=_WINDOW, mode="mirror")
        noisy |= _outliers(level, usual, threshold)
        jumping |= _jumps(movie, threshold * np.sqrt(2.0) * usual, stepped, reach)
    before = corrected["status"].values if "status" in corrected else np.zeros(image, np.uint32)
    status = before | (noisy | jumping) * np.uint32(Status.DEAD_PIXEL)
    return corrected.assign(status=(("y", "x"), status, schema.status_attrs())).assign_attrs(
        noisy_pixels=int(noisy.sum()),
        jumping_pixels=int(jumping.sum()),
        bad_threshold=threshold,
    )


def _reach(time: Array) -> int:
    """Frames by which neighbours may show a change earlier or later."""
    if time.size < _MINIMUM_FRAMES:
        return _REACH_FRAMES
    return max(_REACH_FRAMES, int(np.ceil(_REACH_SECONDS / float(np.median(np.diff(time))))))


def _frames(movie: xr.DataArray, fewest: int) -> npt.NDArray[np.int64]:
    """Positions of the frames of a band that are not NaN."""
    finite = np.zeros(movie.sizes["time"], dtype=bool)
    for rows in _blocks(movie):
        finite |= np.isfinite(movie.isel(y=rows).values).any(axis=(1, 2))
    if finite.sum() < fewest:
        raise ValueError(
            f"Invalid band '{movie['band'].item()}' of {finite.sum()} frames that are not NaN. "
            f"Must have at least {fewest}, to judge a pixel."
        )
    return np.flatnonzero(finite)


def _samples(movie: xr.DataArray, rows: slice) -> Single:
    """Counts of some rows, NaN where they are no measurement."""
    counts = movie.isel(y=rows).values
    return np.where(schema.measured(counts), counts, np.nan).astype(np.float32)


def _blocks(movie: xr.DataArray) -> list[slice]:
    """Rows that are read at once."""
    height = movie.sizes["y"]
    rows = max(1, _BLOCK // (movie.sizes["time"] * movie.sizes["x"]))
    return [slice(top, min(top + rows, height)) for top in range(0, height, rows)]


def _noise(movie: xr.DataArray) -> Array:
    """Noise (y, x) [count] from the quiet part of the second differences; see `mark_bad`."""
    level = np.empty((movie.sizes["y"], movie.sizes["x"]))
    for rows in _blocks(movie):
        signal = _samples(movie, rows)
        second = np.abs(signal[1:-1] - 0.5 * (signal[:-2] + signal[2:]))
        quiet = int(_QUIET * second.shape[0])
        second.partition(quiet, axis=0)
        level[rows] = second[:quiet].mean(axis=0, dtype=np.float64)
    return np.asarray(level / (_QUIET_MEAN * np.sqrt(1.5)))


def _outliers(level: Array, usual: Array, threshold: float) -> Mask:
    """Pixels whose noise differs from that of their surroundings by more than the threshold."""
    with np.errstate(divide="ignore", invalid="ignore"):
        apart = np.log(level / usual)  # minus infinity where nothing changes
    finite = np.isfinite(apart)
    if not finite.any():
        return np.asarray(level == 0)
    centre = np.median(apart[finite])
    scale = max(MAD * float(np.median(np.abs(apart[finite] - centre))), _ROUNDING)
    return np.asarray((np.abs(apart - centre) > threshold * scale) | (level == 0))


def _jumps(movie: xr.DataArray, limit: Array, stepped: Mask, reach: int) -> Mask:
    """Pixels (y, x) that change by more than their limit [count] while no neighbour does."""
    jumping = np.zeros(limit.shape, dtype=bool)
    for rows in _blocks(movie):
        # A row more on each side: the neighbours.
        top, bottom = max(rows.start - 1, 0), min(rows.stop + 1, limit.shape[0])
        change = np.diff(_samples(movie, slice(top, bottom)), axis=0)
        change[stepped] = 0.0  # new offsets after a shutter event
        change[~np.isfinite(change)] = 0.0
        here = slice(rows.start - top, rows.stop - top)
        for signed in (change, -change):
            jumping[rows] |= _alone(signed, limit[top:bottom], reach)[here]
    return jumping


def _alone(change: Single, limit: Array, reach: int) -> Mask:
    """Pixels (y, x) that rise by more than their limit in a frame, and no neighbour about then."""
    shape = limit.shape
    nearby = maximum_filter1d(change, 2 * reach + 1, axis=0, mode="constant")
    nearby = np.pad(nearby, ((0, 0), (1, 1), (1, 1)))
    around = np.zeros_like(change)
    for y, x in _NEIGHBOURS:
        np.maximum(around, nearby[:, y : y + shape[0], x : x + shape[1]], out=around)
    alone = (change > limit) & (around < _SHARED * change)
    return np.asarray(np.any(alone[reach:-reach], axis=0))
