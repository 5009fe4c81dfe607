"""Exposure times of each camera, missing frames, and linear interpolation between frames."""

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import schema
from dbthermal._arrays import Array, Mask

Indices = npt.NDArray[np.intp]

# A sample nearer than this to the wanted time is taken as it is [frame period].
_COINCIDENT: Final = 0.01
# Longest gap across which a line is drawn [frame period].
_GAP: Final = 1.5
# Largest relative deviation of a time step from the median of an even clock [1].
_EVEN: Final = 0.05
_MINIMUM_FRAMES: Final = 2
# Fewest frames in a row, of a recording that pauses.
_ROW: Final = 64
PAUSE: Final = 20
"""Length from which a gap in a camera's frames is a pause of the recording [frame period]."""


@dataclass(frozen=True)
class Interpolation:
    r"""Linear interpolation in time, :math:`I(t) = (1 - w) I_{before} + w I_{after}`.

    For a signal that changes by sudden steps, and for a random walk, this line is the expected
    value between two samples: its error has mean zero and is independent of its value, so that a
    regression on it is not biased (Berkson 1950, doi:10.1080/01621459.1950.10483349). At a step its
    error is up to half of the step, though.

    `before`, `after` (wanted): frames; `weight` (wanted): w [1]; `valid` (wanted): false across a
    gap or past an end; `stamps` (time): exposure times [s].
    """

    before: Indices
    after: Indices
    weight: Array
    valid: Mask
    stamps: Array

    def apply(
        self, frames: npt.NDArray[Any], out: npt.NDArray[Any], largest_step: float = np.inf
    ) -> None:
        """Write the interpolated frames (wanted, ...) into `out`, NaN where not valid.

        Between two samples that differ by more than `largest_step` no value is known: NaN.
        """
        for place, weight in enumerate(self.weight):
            before, after = frames[self.before[place]], frames[self.after[place]]
            if not self.valid[place]:
                out[place] = np.nan
            elif weight in (0.0, 1.0):  # a sample as it is: NaN times zero is not zero
                out[place] = after if weight else before
            else:
                out[place] = (1.0 - weight) * before + weight * after
                out[place][self._step(frames, place) > largest_step] = np.nan

    def _step(self, frames: npt.NDArray[Any], place: int) -> npt.NDArray[Any]:
        """Change between two samples, or its excess over the neighbouring changes if smaller."""
        before, after = int(self.before[place]), int(self.after[place])
        change, time = frames[after] - frames[before], self.stamps
        rates = [
            (frames[late] - frames[early]) / (time[late] - time[early])
            for early, late in ((before - 1, before), (after, after + 1))
            if early >= 0 and late < len(frames) and np.isfinite(time[late] - time[early])
        ]
        width = time[after] - time[before]
        beside = [np.where(np.isnan(rate), change, rate * width) for rate in rates]
        excess = change - sum(beside) / max(len(beside), 1)
        return np.asarray(np.minimum(np.abs(change), np.abs(excess)))

    def within(self, segment: Indices) -> "Interpolation":
        """Same interpolation, not valid between frames of different segments (time)."""
        mixed = (segment[self.before] != segment[self.after]) & (self.weight % 1.0 > 0)
        return replace(self, valid=self.valid & ~mixed)

    def labels(self, segment: Indices) -> Indices:
        """Segment (wanted) of each interpolated frame, from those of the samples (time)."""
        return np.where(self.weight == 1, segment[self.after], segment[self.before])


def exposure_times(corrected: xr.Dataset) -> Array:
    """Exposure times (band, time) [s] of each band's frames, NaN where there is no frame.

    Parameters
    ----------
    corrected : Dataset
        Capture with `exposure_time`; without it `time` is taken, in every band.

    Raises
    ------
    TypeError, ValueError
        If the times have other dims or another unit, fewer than two of a band are finite, or they
        do not increase.
    """
    counts = corrected["counts"]
    if "exposure_time" not in corrected:
        stamps = np.tile(corrected["time"].values.astype(np.float64), (counts.sizes["band"], 1))
    else:
        schema.check_variable(corrected["exposure_time"], schema.EXPOSURE_TIME, "'exposure_time'")
        stamps = corrected["exposure_time"].values.astype(np.float64)
    for band, row in zip(counts["band"].values, stamps, strict=True):
        _check_stamps(row[~np.isnan(row)], str(band))
    return stamps


def fill_times(stamps: Array) -> Array:
    """Exposure times (time) [s] of one camera, with those of missing frames (NaN) interpolated.

    They increase strictly; before the first and after the last frame by a frame period.

    Parameters
    ----------
    stamps : Array
        Times (time) [s], NaN where a frame is missing.
    """
    slots, step = np.arange(stamps.size), frame_period(stamps)
    recorded = np.flatnonzero(np.isfinite(stamps))
    inside = np.interp(slots, recorded, stamps[recorded])
    early, late = np.minimum(slots - recorded[0], 0), np.maximum(slots - recorded[-1], 0)
    return np.asarray(inside + step * (early + late))


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
    """Number of shutter events before each frame (time), 0 without a variable `segment`."""
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
    """Frames (time) that are NaN in all pixels, or a copy of the frame before.

    A driver that loses a frame may deliver the last one again; noise never repeats a whole frame.
    """
    result = np.array([bool(np.all(np.isnan(frame))) for frame in frames])
    for place in range(1, len(frames)):
        result[place] |= np.array_equal(frames[place], frames[place - 1], equal_nan=True)
    return result


def frame_period(stamps: Array) -> float:
    """Median step [s] from one frame of a camera to the next; stamps (time) may be NaN."""
    (recorded,) = np.nonzero(np.isfinite(stamps))
    return float(np.median(np.diff(stamps[recorded]) / np.diff(recorded)))


def even_times(stamps: Array, reach: int) -> Array:
    """Evenly spaced times [s] that all cameras, exposure times (band, time), can be brought to.

    The stamps themselves where all bands share even ones (steps within 5 % of their median); else
    from the last camera's start to the first one's end, in steps of the longest frame period. Where
    the cameras pause, only times within `reach` steps of a frame: as many as there are frames.
    """
    step = max(frame_period(row) for row in stamps)
    shared = bool(np.all(stamps == stamps[0]))
    if shared and np.all(np.abs(np.diff(stamps[0]) - step) <= _EVEN * step):
        return np.asarray(stamps[0])
    start, stop = float(np.nanmin(stamps, axis=1).max()), float(np.nanmax(stamps, axis=1).min())
    if stop - start < step:
        raise ValueError(
            f"Invalid exposure times: the bands overlap from {start} to {stop} s. Must overlap by "
            f"two frames, {step} s apart."
        )
    nearest = np.unique(np.rint((stamps[np.isfinite(stamps)] - start) / step))
    slots = np.unique(nearest[:, np.newaxis] + np.arange(-reach, reach + 1.0))
    return np.asarray(start + step * slots[(slots >= 0) & (slots * step < stop - start)])


def require_steady(stamps: Array, bands: list[str]) -> None:
    """Refuse exposure times (band, time) [s] in which a camera has no frame period.

    As of frames that arrive in bursts: of half of the steps it must be the period within 50 %, and
    half of the frames must lie between pauses in rows of `_ROW` at least.
    """
    for band, row in zip(bands, stamps, strict=True):
        times, period = row[np.isfinite(row)], frame_period(row)
        steps = np.diff(times)
        even = np.mean(np.abs(steps - period) <= 0.5 * period)
        rows = np.diff(np.flatnonzero(np.r_[True, steps > PAUSE * period, True]))
        share = rows[rows >= min(_ROW, times.size)].sum() / times.size
        if even < 0.5 or share < 0.5:
            raise ValueError(
                f"Invalid exposure times of band '{band}': {100 * even:.0f} % of the steps are the "
                f"median {period:.3g} s within half of it, and {100 * share:.0f} % of the frames "
                f"lie in rows of {_ROW} without a pause of {PAUSE} such steps. Must be half each: "
                "times of exposure, not of arrival in bursts; or give the offset."
            )


def pauses(times: Array) -> Array:
    """Times (pause, 2) [s] of the frames before and after each pause of a camera."""
    after = 1 + np.flatnonzero(np.diff(times) > PAUSE * frame_period(times))
    return np.stack([times[after - 1], times[after]], axis=1)


def interpolation(stamps: Array, present: Mask, wanted: Array) -> Interpolation:
    """Interpolation of the frames present, exposed at `stamps` (time) [s], at times `wanted` [s].

    Valid where a frame was exposed within 1 % of a period of the wanted time, or one each before
    and after it, no more than one and a half frame periods apart.
    """
    usable = np.flatnonzero(present & np.isfinite(stamps))
    if usable.size < _MINIMUM_FRAMES:
        raise ValueError(
            f"Invalid capture of {usable.size} valid frames. Must be at least {_MINIMUM_FRAMES}: "
            "the others are NaN or copies of the frame before."
        )
    times, step = stamps[usable], frame_period(np.where(present, stamps, np.nan))
    right = np.clip(np.searchsorted(times, wanted), 1, usable.size - 1)
    width = times[right] - times[right - 1]
    weight = (wanted - times[right - 1]) / width
    nearest = np.rint(weight)
    weight = np.where(np.abs(weight - nearest) * width <= _COINCIDENT * step, nearest, weight)
    between = (weight > 0) & (weight < 1) & (width <= _GAP * step)
    valid = (weight == 0) | (weight == 1) | between
    return Interpolation(usable[right - 1], usable[right], weight, valid, stamps)
