"""Changes and residuals in time, of many pixels at once.

A change point is the step of an object that breaks the cue of its smoothness.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.special import chdtri

from dbthermal.separation._subspace import regression
from dbthermal.separation._subspace.reflection_ratio import CHANCE
from dbthermal.separation._tiles import Array, Mask, Whole

LAGS: Final = 5
"""Frames over which a residual's mean autocorrelation is taken."""

AROUND: Final = 1.0
"""Time in which a step of the object is most of its change [s]."""

# Deviations of noise from which a difference between frames is a change.
CHANGE: Final = 5.0
# Share of the change within a second that a sudden step makes.
_MOST: Final = 2.0 / 3.0
# Parts of the capture, and the total variation of their means over its range, from which a signal
# returns.
_PARTS: Final = 24
_RETURNED: Final = 1.7
# Frames of the shortest blocks of a residual.
_BLOCK: Final = 9


@dataclass(frozen=True)
class Lines:
    """Straight lines through each pixel's points."""

    slope: Array  # (pixel)
    variance: Array  # of the slope, with the residuals' correlation in time (pixel)
    energy: Array  # weighted sum of squares of the abscissa about its mean (pixel)
    weights: Array  # in [0, 1] (time, pixel)

    def kernel(self, abscissa: Array) -> Array:
        """Weights k (time, pixel) of the ordinate z in the slope, sum k z."""
        kernel = self.weights * abscissa
        kernel -= self.weights * (kernel.sum(axis=0) / self.weights.sum(axis=0))
        return np.asarray(kernel / self.energy)


def regress(abscissa: Array, ordinate: Array, noise: float) -> Lines:
    """Robust regression of an ordinate on an abscissa (time, pixel), see `regression.regress`."""
    frames, pixels = abscissa.shape
    rows = [np.ascontiguousarray(values.T, np.float64) for values in (abscissa, ordinate)]
    weights, numbers = np.empty((pixels, frames)), np.empty((pixels, 3 + frames))
    few = np.full((5, frames), np.inf, np.float32)
    regression.lines(*rows, float(noise), weights, few, numbers)
    slope, variance, energy = numbers[:, :3].T
    return Lines(slope, variance, energy, weights.T)


@lru_cache(maxsize=16)
def blocks(frames: int) -> tuple[Whole, tuple[float, float]]:
    """Edges of the blocks of a residual, and limits of both statistics by which it is noise."""
    number = 2 ** int(np.log2(frames / _BLOCK))
    edges = np.round(np.linspace(0, frames, number + 1)).astype(np.intp)
    return edges, (float(chdtri(number, CHANCE)), float(chdtri(1.0, CHANCE / (2 * number))))


def returning(signal: Array) -> Mask:
    """
    Pixels of a signal (time, pixel) that falls again by most of what it rose, or the reverse.

    Of means over parts of the capture: their total variation over their range is 1 for a change
    that stays, 2 for one that comes and goes.
    """
    parts = np.array_split(signal, min(_PARTS, len(signal)))
    means = np.stack([part.mean(axis=0) for part in parts])
    variation = np.abs(np.diff(means, axis=0)).sum(axis=0)
    return np.asarray(variation > _RETURNED * np.ptp(means, axis=0))


def sudden(curve: Array, std: Array, time: Array) -> Mask:
    """
    Pixels of which a curve (time, pixel) [K] steps from one frame to the next.

    By more than most of its change within a second, and beyond its standard deviations; not over a
    pause of the frames.
    """
    interval = np.diff(time)
    usual = float(np.median(interval))
    # A clock of bursts has a median far below its mean.
    frames = min(time.size, max(3, 2 * int(np.ceil(0.5 * AROUND / usual))))
    step = np.abs(np.diff(curve, axis=0))
    noise = np.sqrt(std[1:] ** 2 + std[:-1] ** 2)
    jumps = (step > CHANGE * noise) & (interval < 2.0 * usual)[:, np.newaxis]
    result = np.any(jumps, axis=0)
    some, size = curve[:, result], (frames, 1)  # of the others the surroundings say nothing
    around = maximum_filter(some, size)[1:] - minimum_filter(some, size)[1:]
    result[result] = np.any(jumps[:, result] & (step[:, result] > _MOST * around), axis=0)
    return np.asarray(result)
