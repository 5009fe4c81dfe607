"""Robust regression line of one pixel, compiled; as in `residuals`, within rounding."""

from typing import Any, Final

import numpy as np
import numpy.typing as npt

from dbthermal._arrays import Array
from dbthermal.separation._subspace import kernels, residuals
from dbthermal.separation._subspace.kernels import compiled

_GUESSES: Final = 60  # of the value of a rank, at most


@compiled
def ranked(values: npt.NDArray[np.float32], rank: int, guess: float) -> float:
    """
    Value of a rank, from 0, of values that are not negative, from a guess: no sorting.

    By interpolation between the numbers of values below two others. The bits of such numbers, as
    whole numbers, are in the same order, and NaN above all.
    """
    bits = values.view(np.uint32)
    least, most = np.float32(0.0), np.float32(values.size)
    low, high = np.float32(0.0), np.float32(np.inf)
    middle, goal = np.float32(guess), np.float32(rank)
    for turn in range(_GUESSES):
        below = np.float32(0.0)  # sums of one kind are taken many at once
        for t in range(values.size):
            below += np.float32(1.0) if values[t] < middle else np.float32(0.0)
        if below <= goal:
            low, least = middle, below
        else:
            high, most = middle, below
        if below == goal:
            break
        if high == np.float32(np.inf):  # small values are about as many in each interval
            growth = (goal + np.float32(0.5)) / max(below, np.float32(0.5))
            middle = low * min(max(growth, np.float32(1.01)), np.float32(4.0))
        elif turn % 3 == 2:
            middle = np.float32(0.5) * (low + high)
        else:
            share = (goal + np.float32(0.5) - least) / (most - least)
            middle = low + share * (high - low)
        if not low < middle < high:
            break
    lowest, above = np.float32(low).view(np.uint32), np.uint32(0xFFFFFFFF)
    for t in range(bits.size):  # what is below the bound wraps around
        above = min(above, np.uint32(bits[t] - lowest))
    return float(np.uint32(lowest + above).view(np.float32))


def _of(real: type[np.float32] | type[np.float64]) -> tuple[Any, Any]:
    """Weighted line, and that of bisquare weights, of arrays of a precision, compiled."""
    zero, one = real(0.0), real(1.0)

    @compiled
    def moments(x: Any, y: Any, weights: Any) -> Any:
        """Slope and intercept of a weighted line, and the energy of the abscissa about its mean."""
        total, first, second, square, product = zero, zero, zero, zero, zero
        for t in range(x.size):
            w = weights[t]
            wx = w * x[t]
            total += w
            first += wx
            second += w * y[t]
            square += wx * x[t]
            product += wx * y[t]
        middle, centre = first / total, second / total
        energy = square - total * middle * middle
        slope = (product - total * middle * centre) / energy
        return slope, centre - slope * middle, energy

    @compiled
    def reweighted(x: Any, y: Any, residual: Any, scale: float, weights: Any) -> Any:
        """As `moments`, with Tukey's bisquare weights of residuals, in place."""
        inverse = real(1.0 / (residuals.TUNING * scale))
        for t in range(x.size):
            r = residual[t] * inverse
            kept = max(one - r * r, zero)
            weights[t] = kept * kept
        return moments(x, y, weights)

    return moments, reweighted


moments, reweighted = _of(np.float64)
_moments, _reweighted = _of(np.float32)


@compiled
def _started(x: Array, y: Array, noise: float, residual: Array, few: Any) -> None:
    """Residual from the best of three starts, in place; see `residuals.regress`."""
    middle, centre = kernels.mean(x), kernels.mean(y)
    count = min(x.size, residuals.STARTING_POINTS)
    xs, ys, rest = few[0, :count], few[1, :count], few[2, :count]
    weights, plain, magnitude = few[3, :count], few[4, :count], few[5, :count]
    for i in range(count):
        t = i if count == x.size else i * x.size // residuals.STARTING_POINTS
        xs[i], ys[i], weights[i] = x[t] - middle, y[t] - centre, 1.0
    slope, intercept, _ = _moments(xs, ys, weights)
    for i in range(count):
        plain[i] = ys[i] - intercept - slope * xs[i]
    rank, zero = int(residuals.SHARE * count), np.float32(0.0)
    best, best_slope, best_intercept = np.inf, np.inf, np.inf
    for start in range(3):
        sign = np.float32(2 * start - 3) if start > 0 else zero
        for i in range(count):
            weights[i] = 1.0 if sign * plain[i] >= zero else 0.0
        slope, intercept, _ = _moments(xs, ys, weights)
        deviation = 0.0
        for turn in range(residuals.STARTING_STEPS):
            if turn > 0:
                scale = max(noise, residuals.ANNEALING * residuals.TO_STD * deviation)
                slope, intercept, _ = _reweighted(xs, ys, rest, scale, weights)
            total = zero
            for i in range(count):
                rest[i] = ys[i] - intercept - slope * xs[i]
                magnitude[i] = abs(rest[i])
                total += magnitude[i]
            guess = deviation if turn > 0 else 0.5 * total / count
            deviation = ranked(magnitude, rank, max(guess, noise / residuals.TO_STD))
        if deviation < best:
            best, best_slope, best_intercept = deviation, slope, intercept
    for t in range(x.size):
        residual[t] = y[t] - centre - best_intercept - best_slope * (x[t] - middle)


@compiled
def regress(
    x: Array, y: Array, noise: float, weights: Array, residual: Array, few: Any, again: int
) -> tuple[float, float, float, float]:
    """
    Robust line, as `residuals.regress`; residual and weights in place.

    Slope, its variance, the scale, and the energy of the abscissa.
    """
    if again:
        slope, intercept, _ = moments(x, y, weights)
        for t in range(x.size):
            residual[t] = y[t] - intercept - slope * x[t]
    else:
        _started(x, y, noise, residual, few)
    magnitude, rank = few[5], int(residuals.SHARE * x.size)
    deviation = 0.0
    for t in range(x.size):
        magnitude[t] = abs(residual[t])
    for _ in range(residuals.STEPS):
        deviation = ranked(magnitude, rank, max(deviation, noise / residuals.TO_STD))
        scale = max(noise, residuals.TO_STD * deviation)
        slope, intercept, energy = reweighted(x, y, residual, scale, weights)
        for t in range(x.size):
            residual[t] = y[t] - intercept - slope * x[t]
            magnitude[t] = abs(residual[t])
    kept, lagged = (residual[0] * weights[0]) ** 2, 0.0
    for t in range(1, x.size):
        one = residual[t] * weights[t]
        kept += one * one
        lagged += one * residual[t - 1] * weights[t - 1]
    correlation = min(max(lagged / kept if kept > 0 else 0.0, 0.0), residuals.MOST_CORRELATED)
    independent = (1.0 - correlation) / (1.0 + correlation)
    return slope, scale**2 / energy / independent, scale, energy
