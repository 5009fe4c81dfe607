"""Subsample of a picture, gaps of a signal, mean of the neighbours: each once, for all rooms."""

from math import prod

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter

from dbthermal._arrays import Array, Mask


def stride(shape: tuple[int, ...], number: int) -> int:
    """Step along every axis of a shape that selects about so many values, evenly spaced.

    Rounded down: at most 2^n times the number are selected along n axes.
    """
    step = (prod(shape) / number) ** (1.0 / len(shape))
    return max(1, int(round(step, 9)))  # a whole root is whole


def bridged(signal: Array, valid: Mask, time: Array) -> Array:
    """Signal (time, ...) with its missing frames (time) on the line between the valid ones.

    Before the first and behind the last valid frame it stays at their values.
    """
    if valid.all() or not valid.any():
        return signal
    # The valid frames on either side of each missing one, and the share of the later.
    frames, missing = np.flatnonzero(valid), np.flatnonzero(~valid)
    place = np.searchsorted(frames, missing)
    before, after = (frames[np.clip(place + step, 0, frames.size - 1)] for step in (-1, 0))
    gap = np.where(after > before, time[after] - time[before], 1.0)
    share = ((time[missing] - time[before]) / gap).reshape(-1, *(1,) * (signal.ndim - 1))
    share = np.where((after > before).reshape(share.shape), share, 0.0)
    result = signal.copy()
    result[missing] = (1.0 - share) * signal[before] + share * signal[after]
    return result


def neighbour_mean(
    values: npt.NDArray[np.floating], weight: npt.NDArray[np.floating], width: float
) -> Array:
    """Weighted mean (..., y, x) of the pixels around each, by a Gaussian of a width [pixel].

    Pixels of weight 0 do not count, whatever their value; NaN where no pixel counts.
    """
    sums = [
        gaussian_filter(part, width, mode="constant", axes=(-2, -1))
        for part in (np.where(weight > 0, weight * values, 0.0), weight * 1.0)
    ]
    empty = np.full(sums[0].shape, np.nan)
    return np.asarray(np.divide(sums[0], sums[1], out=empty, where=sums[1] > 0))
