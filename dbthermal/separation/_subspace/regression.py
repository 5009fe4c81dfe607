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
    def reweighted(x: Any, y: Any, slope: Any, intercept: Any, scale: float) -> Any:
        """As `moments`, with Tukey's bisquare weights of the residuals of another line."""
        inverse = real(1.0 / (residuals.TUNING * scale))
        total, first, second, square, product = zero, zero, zero, zero, zero
        for t in range(x.size):
            r = (y[t] - intercept - slope * x[t]) * inverse
            kept = max(one - r * r, zero)
            w = kept * kept
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

    return moments, reweighted


moments, reweighted = _of(np.float64)
_moments, _reweighted = _of(np.float32)


@compiled
def _started(x: Array, y: Array, noise: float, few: Any) -> tuple[float, float]:
    """Slope and intercept of the best of three starts; see `residuals.regress`."""
    middle, centre = kernels.mean(x), kernels.mean(y)
    count = min(x.size, residuals.STARTING_POINTS)
    xs, ys, weights = few[0, :count], few[1, :count], few[2, :count]
    plain, magnitude = few[3, :count], few[4, :count]
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
                slope, intercept, _ = _reweighted(xs, ys, slope, intercept, scale)
            total = zero
            for i in range(count):
                magnitude[i] = abs(ys[i] - intercept - slope * xs[i])
                total += magnitude[i]
            guess = deviation if turn > 0 else 0.5 * total / count
            deviation = ranked(magnitude, rank, max(guess, noise / residuals.TO_STD))
        if deviation < best:
            best, best_slope, best_intercept = deviation, slope, intercept
    return float(best_slope), float(centre + best_intercept - best_slope * middle)


@compiled
def regress(
    x: Array, y: Array, noise: float, weights: Array, residual: Array, few: Any, again: int
) -> tuple[float, float, float, float]:
    """
    Robust line, as `residuals.regress`; residual and weights in place.

    Slope, its variance, the scale, and the energy of the abscissa.
    """
    if again:
        slope, intercept, energy = moments(x, y, weights)
    else:
        slope, intercept = _started(x, y, noise, few)
        energy = 0.0
    magnitude, rank, last = few[4], int(residuals.SHARE * x.size), (slope, intercept)
    deviation, scale = 0.0, noise
    # Residuals and weights are made anew where they are used: a long capture's leave the cache.
    for _ in range(residuals.STEPS):
        last = slope, intercept
        for t in range(x.size):
            magnitude[t] = abs(y[t] - intercept - slope * x[t])
        deviation = ranked(magnitude, rank, max(deviation, noise / residuals.TO_STD))
        scale = max(noise, residuals.TO_STD * deviation)
        slope, intercept, energy = reweighted(x, y, slope, intercept, scale)
    inverse = 1.0 / (residuals.TUNING * scale)
    for t in range(x.size):
        residual[t] = y[t] - intercept - slope * x[t]
        off = (y[t] - last[1] - last[0] * x[t]) * inverse
        inside = max(1.0 - off * off, 0.0)
        weights[t] = inside * inside
    kept, lagged = (residual[0] * weights[0]) ** 2, 0.0
    for t in range(1, x.size):
        one = residual[t] * weights[t]
        kept += one * one
        lagged += one * residual[t - 1] * weights[t - 1]
    correlation = min(max(lagged / kept if kept > 0 else 0.0, 0.0), residuals.MOST_CORRELATED)
    independent = (1.0 - correlation) / (1.0 + correlation)
    return slope, scale**2 / energy / independent, scale, energy
