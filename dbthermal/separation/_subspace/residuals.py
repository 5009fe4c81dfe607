"""Changes and residuals in time, of many pixels at once.

A change point is the step of an object that breaks the cue of its smoothness.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from scipy.special import chdtri

from dbthermal.separation._subspace import regression
from dbthermal.separation._subspace.reflection_ratio import CHANCE
from dbthermal.separation._tiles import Array, Whole

LAGS: Final = 5
"""Frames over which a residual's mean autocorrelation is taken."""

# Deviations of noise from which a difference between frames is a change.
CHANGE: Final = 5.0
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
