"""Exposure times of each camera, missing frames, and interpolation between frames."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.sparse import csr_array

from dbthermal import _numbers, schema
from dbthermal._arrays import Array, Mask
from dbthermal._smooth import Whole

_COINCIDENT: Final = 0.01  # distance within which a sample is taken as it is [frame period]
_GAP: Final = 1.5  # longest gap that is interpolated across [frame period]
_EVEN: Final = 0.05  # largest relative deviation of a step from the median of an even clock [1]
_MINIMUM_FRAMES: Final = 2
_ROW: Final = 64  # fewest frames in a row, of a recording that pauses
PAUSE: Final = 20  # gap in a camera's frames from which it is a pause [frame period]


@dataclass(frozen=True)
class Interpolation:
    r"""Interpolation in time by a line between two frames, bent by those around them.

    .. math:: I(t) = (1 - w) I_{before} + w I_{after} + \sum_{i=-1}^{2} b_i I_{before + i}

    Half-way between frames the line keeps 71 % of a wave with a period of four frames, the cubic
    88 %. The bend b is the cubic's, times a share (`_offset.bent`); 0 without four frames in a row.
    """

    before: Whole  # frames (wanted)
    after: Whole
    weight: Array  # w (wanted) [1]
    bend: Array  # b (wanted, 4) [1]
    valid: Mask  # false across a gap or past an end (wanted)
    stamps: Array  # exposure times (time) [s]
    swing: float = 0.125  # share of the largest step by which a bend may deviate beside a step

    def apply(
        self, frames: npt.NDArray[Any], out: npt.NDArray[Any], largest_step: float = np.inf
    ) -> None:
        """Write the interpolated frames (wanted, ...) into `out`, NaN where they are not valid."""

        @lru_cache(maxsize=3)  # of the frames' intervals in turn
        def steps(before: int, after: int) -> npt.NDArray[Any]:
            return self._step(frames, before, after) > largest_step

        places = zip(self.before.tolist(), self.after.tolist(), strict=True)
        for place, (before, after) in enumerate(places):
            weight = self.weight[place]
            if not self.valid[place]:
                out[place] = np.nan
            elif weight in (0.0, 1.0):  # a sample as it is: NaN times zero is not zero
                out[place] = frames[after if weight else before]
            else:
                out[place] = (1.0 - weight) * frames[before] + weight * frames[after]
                # Unknown where a signal steps, and beside a step where the bend overshoots.
                unknown = steps(before, after)
                if self.bend[place].any():
                    block = frames[before - 1 : after + 2]
                    bend = np.tensordot(self.bend[place].astype(block.dtype), block, 1)
                    out[place] += np.nan_to_num(bend)
                    neighbours = steps(before - 1, before) | steps(after, after + 1)
                    unknown = unknown | neighbours & (np.abs(bend) > self.swing * largest_step)
                out[place][unknown] = np.nan

    def _step(self, frames: npt.NDArray[Any], before: int, after: int) -> npt.NDArray[Any]:
        """Change between two samples, or its excess over the neighbouring changes, the smaller."""
        change, time = frames[after] - frames[before], self.stamps
        rates = [
            (frames[end] - frames[start]) / (time[end] - time[start])
            for start, end in ((before - 1, before), (after, after + 1))
            if start >= 0 and end < len(frames) and np.isfinite(time[end] - time[start])
        ]
        width = time[after] - time[before]
        neighbours = [np.where(np.isnan(rate), change, rate * width) for rate in rates]
        excess = change - sum(neighbours) / max(len(neighbours), 1)
        return np.asarray(np.minimum(np.abs(change), np.abs(excess)))

    def matrix(self, bend: float = 1.0) -> csr_array:
        """Weights (wanted, time) [1] of all frames, with a multiple of the bend; 0 if not valid."""
        weights = bend * self.bend
        weights[:, 1:3] += np.stack([1.0 - self.weight, self.weight], axis=1)
        row, place = np.nonzero(weights * self.valid[:, np.newaxis])
        frames = np.stack([self.before - 1, self.before, self.after, self.after + 1], axis=1)
        shape = self.valid.size, self.stamps.size
        return csr_array((weights[row, place], (row, frames[row, place])), shape=shape)

    def noise_factors(self) -> tuple[float, float]:
        """Independent noise over that before, of frames and of their second differences [1]."""
        weights = self.matrix()[self.valid]
        twice = weights[2:] - 2.0 * weights[1:-1] + weights[:-2]
        square = (weights**2).sum() / max(weights.shape[0], 1)
        return float(square**0.5), float(((twice**2).sum() / max(6 * twice.shape[0], 1)) ** 0.5)

    def labels(self, segment: Whole) -> Whole:
        """Segment (wanted) of each interpolated frame, from those of the samples (time)."""
        return np.where(self.weight == 1, segment[self.after], segment[self.before])


def exposure_times(corrected: xr.Dataset) -> Array:
    """Exposure times (band, time) [s] of each band's frames, NaN where there is no frame.

    TypeError or ValueError if the dataset is no capture, or the times have other dims or another
    unit, are fewer than two of a band, or do not increase.

    Parameters
    ----------
    corrected : Dataset
        Capture with `exposure_time`; without it `time` is taken, in every band.
    """
    counts = schema.check(corrected, "corrected")["counts"]
    if "exposure_time" not in corrected:
        stamps = np.tile(corrected["time"].values.astype(np.float64), (counts.sizes["band"], 1))
    else:
        stamps = corrected["exposure_time"].values.astype(np.float64)
    for band, row in zip(counts["band"].values, stamps, strict=True):
        label = f"exposure times of band '{band}'"
        schema.rising_numbers(row[~np.isnan(row)], label, "s", _MINIMUM_FRAMES)
    return stamps


def fill_times(stamps: Array) -> Array:
    """Exposure times (time) [s] of one camera, with those of missing frames (NaN) interpolated.

    Parameters
    ----------
    stamps : Array
        Times (time) [s], NaN where a frame is missing; before the first and after the last by a
        frame period each. TypeError or ValueError for fewer than two, or if they do not rise.
    """
    stamps = _numbers.real_numbers("exposure times [s]", stamps)
    label = "exposure times of the camera"
    schema.rising_numbers(stamps[~np.isnan(stamps)], label, "s", _MINIMUM_FRAMES)
    slots, step = np.arange(stamps.size), frame_period(stamps)
    recorded = np.flatnonzero(np.isfinite(stamps))
    interpolated = np.interp(slots, recorded, stamps[recorded])
    outside = slots - np.clip(slots, recorded[0], recorded[-1])
    return np.asarray(interpolated + step * outside)


def missing(frames: npt.NDArray[Any]) -> Mask:
    """Frames (time) that are NaN in all pixels, or an exact copy of the frame before."""
    result = np.array([bool(np.all(np.isnan(frame))) for frame in frames])
    for place in range(1, len(frames)):
        result[place] |= np.array_equal(frames[place], frames[place - 1], equal_nan=True)
    return result


def frame_period(stamps: Array) -> float:
    """Median step [s] from one frame of a camera to the next; stamps (time) may be NaN."""
    (recorded,) = np.nonzero(np.isfinite(stamps))
    return float(np.median(np.diff(stamps[recorded]) / np.diff(recorded)))


def even_times(stamps: Array, reach: int) -> Array:
    """Even times [s] in steps of the longest frame period, for exposure times (band, time)."""
    step = max(frame_period(row) for row in stamps)
    shared = bool(np.all(stamps == stamps[0]))
    # Even times that all bands share are taken as they are.
    if shared and np.all(np.abs(np.diff(stamps[0]) - step) <= _EVEN * step):
        return np.asarray(stamps[0])
    # From the latest start to the earliest end, within `reach` steps of a frame.
    start, stop = float(np.nanmin(stamps, axis=1).max()), float(np.nanmax(stamps, axis=1).min())
    if stop - start < step:
        label = f"Invalid exposure times: the bands overlap from {start} to {stop} s"
        raise ValueError(f"{label}. Must overlap by two frames, {step} s apart.")
    nearest = np.unique(np.rint((stamps[np.isfinite(stamps)] - start) / step))
    slots = np.unique(nearest[:, np.newaxis] + np.arange(-reach, reach + 1.0))
    return np.asarray(start + step * slots[(slots >= 0) & (slots * step < stop - start)])


def require_steady(stamps: Array, bands: list[str]) -> None:
    """Refuse exposure times (band, time) [s] of frames that arrive in bursts."""
    for band, row in zip(bands, stamps, strict=True):
        times, period = row[np.isfinite(row)], frame_period(row)
        steps = np.diff(times)
        # Share of steps near the period, and of frames in rows of at least `_ROW` without a pause.
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


def interpolation(stamps: Array, present: Mask, wanted: Array, segment: Whole) -> Interpolation:
    """Interpolation of frames exposed at `stamps` (time) [s], at `wanted` times [s], by cubics."""
    usable = np.flatnonzero(present & np.isfinite(stamps))
    if usable.size < _MINIMUM_FRAMES:
        rule = f"at least {_MINIMUM_FRAMES}: the others are NaN or copies of the frame before"
        raise ValueError(f"Invalid number {usable.size} of valid frames. Must be {rule}.")
    times, step = stamps[usable], frame_period(np.where(present, stamps, np.nan))
    # Frames before and after each wanted time, and weight of the frame after.
    right = np.clip(np.searchsorted(times, wanted), 1, usable.size - 1)
    width = times[right] - times[right - 1]
    weight = (wanted - times[right - 1]) / width
    # A sample exposed within 1 % of a frame period is taken as it is.
    nearest = np.rint(weight)
    weight = np.where(np.abs(weight - nearest) * width <= _COINCIDENT * step, nearest, weight)
    # Interpolate between neighbours at most one and a half periods apart, within one segment.
    joined = (np.diff(times) <= _GAP * step) & (np.diff(segment[usable]) == 0)
    between = (weight > 0) & (weight < 1) & joined[right - 1]
    valid = (weight == 0) | (weight == 1) | between
    in_a_row = np.pad(joined & (np.diff(usable) == 1), (1, 1))
    four = between & in_a_row[right - 1] & in_a_row[right] & in_a_row[right + 1]
    # Bend: the cubic through four frames in a row (Lagrange), less the line.
    nodes, same = times[right[four, np.newaxis] + np.arange(-2, 2)], np.eye(4, dtype=bool)
    away, spacing = wanted[four, np.newaxis] - nodes, nodes[:, :, np.newaxis] - nodes[:, np.newaxis]
    bend = np.zeros((wanted.size, 4))
    bend[four] = np.prod(np.where(same, 1.0, away[:, np.newaxis] / (spacing + same)), axis=2)
    bend[four, 1:3] -= np.stack([1.0 - weight[four], weight[four]], axis=1)
    return Interpolation(usable[right - 1], usable[right], weight, bend, valid, stamps)
