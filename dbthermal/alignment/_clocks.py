"""When each camera's frames were exposed, which of them are missing, and how to reach between."""

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import schema

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Indices = npt.NDArray[np.intp]

EXPOSURE_TIME: Final = schema.Variable(
    ("band", "time"), "float64", "s", "when the frame was exposed"
)
"""Optional variable `exposure_time` of a capture: each camera's own stamps, NaN for no frame."""

SAME: Final = 0.01
"""A sample nearer than this to the wanted time is taken as it is [frame period]."""

_GAP: Final = 1.5
_EVEN: Final = 0.05
_MINIMUM_FRAMES: Final = 2


@dataclass(frozen=True)
class Interpolation:
    r"""
    Which two frames a line through goes at each wanted time.

    .. math:: I(t) = (1 - w) I_{before} + w I_{after}

    For a signal that changes by sudden steps, and for a random walk, this line is the expected
    value between two samples: what it misses has mean zero and is independent of what it gives, so
    a regression on it is not biased [1]_. At a step it misses by up to the half of it, though.

    Attributes
    ----------
    before, after : ndarray of int, shape (wanted,)
        Frames.
    share : ndarray, shape (wanted,)
        w, the weight of the frame after [1].
    known : ndarray of bool, shape (wanted,)
        False where the line would reach over a gap or past an end.
    stamps : ndarray, shape (time,)
        When the frames were exposed [s].

    References
    ----------
    .. [1] Berkson (1950), Journal of the American Statistical Association 45, 164,
       doi:10.1080/01621459.1950.10483349
    """

    before: Indices
    after: Indices
    share: Array
    known: Mask
    stamps: Array

    def apply(
        self, frames: npt.NDArray[Any], out: npt.NDArray[Any], largest: float = np.inf
    ) -> None:
        """
        Write the interpolated frames, NaN where they are not known.

        Parameters
        ----------
        frames : ndarray, shape (time, ...)
            Samples, in any unit.
        out : ndarray, shape (wanted, ...)
            Where the result goes, floating.
        largest : float
            Step between two samples, in their unit, beyond which nothing between them is known.
        """
        for place, share in enumerate(self.share):
            before, after = frames[self.before[place]], frames[self.after[place]]
            if not self.known[place]:
                out[place] = np.nan
            elif share in (0.0, 1.0):  # a sample as it is: NaN times zero is not zero
                out[place] = after if share else before
            else:
                out[place] = (1.0 - share) * before + share * after
                out[place][self._step(frames, place) > largest] = np.nan

    def _step(self, frames: npt.NDArray[Any], place: int) -> npt.NDArray[Any]:
        """Change between two samples, or how much it is more than beside them: the smaller."""
        before, after = int(self.before[place]), int(self.after[place])
        change, time = frames[after] - frames[before], self.stamps
        rates = [
            (frames[late] - frames[early]) / (time[late] - time[early])
            for early, late in ((before - 1, before), (after, after + 1))
            if early >= 0 and late < len(frames) and np.isfinite(time[late] - time[early])
        ]
        width = time[after] - time[before]
        known = [np.where(np.isnan(rate), change, rate * width) for rate in rates]
        more = change - sum(known) / max(len(known), 1)
        return np.asarray(np.minimum(np.abs(change), np.abs(more)))

    def within(self, segment: Indices) -> "Interpolation":
        """
        Leave out what would mix samples from both sides of a shutter event.

        Parameters
        ----------
        segment : ndarray of int, shape (time,)
            From `segments`.

        Returns
        -------
        Interpolation
            The same, known in fewer places.
        """
        mixed = (segment[self.before] != segment[self.after]) & (self.share % 1.0 > 0)
        return replace(self, known=self.known & ~mixed)

    def labels(self, segment: Indices) -> Indices:
        """
        Segment that each interpolated frame is of.

        Parameters
        ----------
        segment : ndarray of int, shape (time,)
            From `segments`.

        Returns
        -------
        ndarray of int, shape (wanted,)
            Of the frame after where that is taken as it is, else of the one before.
        """
        return np.where(self.share == 1, segment[self.after], segment[self.before])


def exposures(corrected: xr.Dataset) -> Array:
    """
    When each band's frames were exposed.

    Parameters
    ----------
    corrected : Dataset
        Stage `corrected` of `schema`, optionally with `exposure_time` (band, time) [s].

    Returns
    -------
    ndarray, shape (band, time)
        The stamps [s], NaN where there is no frame; without stamps, `time` in every band.

    Raises
    ------
    TypeError, ValueError
        If the stamps have other dims or another unit, fewer than two of a band are finite, or
        they do not increase.
    """
    counts = corrected["counts"]
    if "exposure_time" not in corrected:
        stamps = np.tile(corrected["time"].values.astype(np.float64), (counts.sizes["band"], 1))
    else:
        schema.check_variable(corrected["exposure_time"], EXPOSURE_TIME, "'exposure_time'")
        stamps = corrected["exposure_time"].values.astype(np.float64)
    for band, row in zip(counts["band"].values, stamps, strict=True):
        _check_stamps(row[~np.isnan(row)], str(band))
    return stamps


def _check_stamps(stamps: Array, band: str) -> None:
    if stamps.size < _MINIMUM_FRAMES or not np.all(np.isfinite(stamps)):
        raise ValueError(
            f"Invalid exposure times of band '{band}': {stamps.size} stamps. Must be finite, "
            f"{_MINIMUM_FRAMES} at least, or NaN where there is no frame."
        )
    steps = np.diff(stamps)
    if np.any(steps <= 0):
        place = int(np.argmax(steps <= 0))
        raise ValueError(
            f"Unordered exposure times of band '{band}': {stamps[place]} s is followed by "
            f"{stamps[place + 1]} s. Must increase strictly."
        )


def segments(corrected: xr.Dataset) -> Indices:
    """
    How many shutter events came before each frame.

    Parameters
    ----------
    corrected : Dataset
        Optionally with `segment` (time).

    Returns
    -------
    ndarray of int, shape (time,)
        The numbers; all 0 where nothing is known of them.

    Raises
    ------
    ValueError
        If they have other dims, or are no whole numbers.
    """
    if "segment" not in corrected:
        return np.zeros(corrected.sizes["time"], dtype=np.intp)
    segment = corrected["segment"]
    if segment.dims != ("time",) or segment.dtype.kind not in "iu":
        raise ValueError(
            f"Invalid segment {segment.dims} of {segment.dtype}. "
            "Must be ('time',) of whole numbers."
        )
    return np.asarray(segment.values, dtype=np.intp)


def missing(frames: npt.NDArray[Any]) -> Mask:
    """
    Frames that hold nothing: NaN in all pixels, or a copy of the frame before.

    A driver that loses a frame may hand out the last one again. Noise repeats a whole frame never.

    Parameters
    ----------
    frames : ndarray, shape (time, ...)
        Samples of one band.

    Returns
    -------
    ndarray of bool, shape (time,)
        Where they are missing.
    """
    result = np.array([bool(np.all(np.isnan(frame))) for frame in frames])
    for place in range(1, len(frames)):
        result[place] |= np.array_equal(frames[place], frames[place - 1], equal_nan=True)
    return result


def period(stamps: Array) -> float:
    """
    Frame period of one camera.

    Parameters
    ----------
    stamps : ndarray, shape (time,)
        Exposure times [s], NaN where there is no frame.

    Returns
    -------
    float
        Median step between frames [s].
    """
    return float(np.median(np.diff(stamps[np.isfinite(stamps)])))


def filled(stamps: Array) -> Array:
    """
    Exposure times without holes: a slot without a frame gets a time between its neighbours.

    Parameters
    ----------
    stamps : ndarray, shape (time,)
        Exposure times [s], NaN where there is no frame.

    Returns
    -------
    ndarray, shape (time,)
        Times [s], strictly increasing; before the first and after the last frame, a frame period
        apart.
    """
    slots, step = np.arange(stamps.size), period(stamps)
    good = np.flatnonzero(np.isfinite(stamps))
    inside = np.interp(slots, good, stamps[good])
    early, late = np.minimum(slots - good[0], 0), np.maximum(slots - good[-1], 0)
    return np.asarray(inside + step * (early + late))


def even(stamps: Array) -> Array:
    """
    Evenly spaced times that all cameras can be brought to.

    Parameters
    ----------
    stamps : ndarray, shape (band, time)
        Exposure times [s], NaN where there is no frame.

    Returns
    -------
    ndarray, shape (any,)
        The stamps themselves where all bands share even ones (steps within 5 % of their median);
        else from the last camera's start to the first one's end, in steps of the longest frame
        period [s].

    Raises
    ------
    ValueError
        If the cameras' recordings do not overlap by two frames.
    """
    step = max(period(row) for row in stamps)
    shared = bool(np.all(stamps == stamps[0]))
    if shared and np.all(np.abs(np.diff(stamps[0]) - step) <= _EVEN * step):
        return np.asarray(stamps[0])
    start, stop = float(np.nanmin(stamps, axis=1).max()), float(np.nanmax(stamps, axis=1).min())
    if stop - start < step:
        raise ValueError(
            f"Invalid exposure times: the bands overlap from {start} to {stop} s. Must overlap by "
            f"two frames, {step} s apart."
        )
    return np.arange(start, stop, step)


def interpolation(stamps: Array, present: Mask, wanted: Array) -> Interpolation:
    """
    Find the frames between which each wanted time lies.

    Parameters
    ----------
    stamps : ndarray, shape (time,)
        Exposure times [s], NaN where there is no frame.
    present : ndarray of bool, shape (time,)
        Which frames hold something, see `missing`.
    wanted : ndarray, shape (wanted,)
        Times [s].

    Returns
    -------
    Interpolation
        Known where a frame was exposed at that time (within `SAME` of a period), or one each
        before and after it, no more than one and a half frame periods apart.

    Raises
    ------
    ValueError
        If fewer than two frames hold something.
    """
    good = np.flatnonzero(present & np.isfinite(stamps))
    if good.size < _MINIMUM_FRAMES:
        raise ValueError(
            f"Invalid capture of {good.size} frames that hold something. Must be at least "
            f"{_MINIMUM_FRAMES}: the others are NaN or copies of the frame before."
        )
    times, step = stamps[good], period(stamps[good])
    right = np.clip(np.searchsorted(times, wanted), 1, good.size - 1)
    width = times[right] - times[right - 1]
    share = (wanted - times[right - 1]) / width
    share = np.where(np.abs(share - np.rint(share)) * width <= SAME * step, np.rint(share), share)
    known = (share == 0) | (share == 1) | ((share > 0) & (share < 1) & (width <= _GAP * step))
    return Interpolation(good[right - 1], good[right], share, known, stamps)
