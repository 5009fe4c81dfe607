"""Robust regression, which finds a line beside outliers on one side; of one pixel, compiled."""

from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri

from dbthermal._arrays import Array
from dbthermal.separation._subspace import kernels
from dbthermal.separation._subspace.kernels import compiled

TUNING: Final = 4.685
"""Tukey's constant: 95 % efficiency for normal noise (Huber 1981, doi:10.1002/0471725250)."""

# Share of the points that must lie on the line: the scale is taken from their deviation, as an
# absolute deviation of that rank -> standard deviation of a normal distribution.
SHARE: Final = 0.3
TO_STD: Final = 1.0 / float(ndtri(0.5 * (1.0 + SHARE)))
ANNEALING: Final = 0.7
STARTING_STEPS: Final = 5
STARTING_POINTS: Final = 128
STEPS: Final = 3
# Frames on either side of a reflection that hold its edge: by 0, 1, 2, 3 and 5, and true objects,
# emissivities of 24 materials in simulated worlds are .28, .17, .11, .09 and .08 thousandths off.
EDGE: Final = 2
# Largest correlation of neighbouring residuals: a wholly slow residual would have 1.
MOST_CORRELATED: Final = 0.98
_GUESSES: Final = 60  # of the value of a rank, at most


@compiled
def ranked(values: npt.NDArray[np.float32], rank: int, guess: float) -> float:
    """Value of a rank, from 0, of values that are not negative, from a guess: no sorting."""
    # The bits of such values, as whole numbers, are in the same order, and NaN above all.
    bits = values.view(np.uint32)
    low_count, high_count = np.float32(0.0), np.float32(values.size)
    low, high = np.float32(0.0), np.float32(np.inf)
    middle, goal = np.float32(guess), np.float32(rank)
    for turn in range(_GUESSES):
        count = np.float32(0.0)  # sums of one kind are taken many at once
        for t in range(values.size):
            count += np.float32(1.0) if values[t] < middle else np.float32(0.0)
        if count <= goal:
            low, low_count = middle, count
        else:
            high, high_count = middle, count
        if count == goal:
            break
        if high == np.float32(np.inf):  # small values are about as many in each interval
            growth = (goal + np.float32(0.5)) / max(count, np.float32(0.5))
            middle = low * min(max(growth, np.float32(1.01)), np.float32(4.0))
        elif turn % 3 == 2:
            middle = np.float32(0.5) * (low + high)
        else:
            # Interpolated between the numbers of values below two bounds.
            share = (goal + np.float32(0.5) - low_count) / (high_count - low_count)
            middle = low + share * (high - low)
        if not low < middle < high:
            break
    lowest, above = np.float32(low).view(np.uint32), np.uint32(0xFFFFFFFF)
    for t in range(bits.size):  # what is below the bound wraps around
        above = min(above, np.uint32(bits[t] - lowest))
    return float(np.uint32(lowest + above).view(np.float32))


@compiled
def bisquare(off: float) -> float:
    """Tukey's weight of a residual over the tuning constant times the scale, 0 beyond 1."""
    root = max(1.0 - off * off, 0.0)
    return root * root


@compiled
def moments(x: Any, y: Any, weights: Any) -> Any:
    """Slope and intercept of a weighted line, and the energy of the abscissa about its mean."""
    zero = x.dtype.type(0.0)  # all in the precision of the points
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
    real = x.dtype.type
    zero, one, inverse = real(0.0), real(1.0), real(1.0 / (TUNING * scale))
    total, first, second, square, product = zero, zero, zero, zero, zero
    for t in range(x.size):
        r = (y[t] - intercept - slope * x[t]) * inverse
        root = max(one - r * r, zero)
        w = root * root
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
def _started(x: Array, y: Array, noise: float, scratch: Any) -> tuple[float, float]:
    """Slope and intercept of the best of three starts: all points, points above, below a line."""
    middle, centre = kernels.mean(x), kernels.mean(y)
    # Some points in single precision, about their mean, are enough to start from.
    count = min(x.size, STARTING_POINTS)
    xs, ys, weights = scratch[0, :count], scratch[1, :count], scratch[2, :count]
    plain, magnitude = scratch[3, :count], scratch[4, :count]
    for i in range(count):
        t = i if count == x.size else i * x.size // STARTING_POINTS
        xs[i], ys[i], weights[i] = x[t] - middle, y[t] - centre, 1.0
    slope, intercept, _ = moments(xs, ys, weights)
    for i in range(count):
        plain[i] = ys[i] - intercept - slope * xs[i]
    rank, zero = int(SHARE * count), np.float32(0.0)
    best, best_slope, best_intercept = np.inf, np.inf, np.inf
    # Disturbances of a resting background lie mostly on one side of it: half of the points is
    # then nearly free of disturbances. The start with the smallest deviation wins.
    for start in range(3):
        sign = np.float32(2 * start - 3) if start > 0 else zero
        for i in range(count):
            weights[i] = 1.0 if sign * plain[i] >= zero else 0.0
        slope, intercept, _ = moments(xs, ys, weights)
        deviation = 0.0
        # Close in on the densest half of the points, by a scale of a fraction of the deviation.
        for turn in range(STARTING_STEPS):
            if turn > 0:
                scale = max(noise, ANNEALING * TO_STD * deviation)
                slope, intercept, _ = reweighted(xs, ys, slope, intercept, scale)
            total = zero
            for i in range(count):
                magnitude[i] = abs(ys[i] - intercept - slope * xs[i])
                total += magnitude[i]
            guess = deviation if turn > 0 else 0.5 * total / count
            deviation = ranked(magnitude, rank, max(guess, noise / TO_STD))
        if deviation < best:
            best, best_slope, best_intercept = deviation, slope, intercept
    return float(best_slope), float(centre + best_intercept - best_slope * middle)


@compiled
def _weigh(x: Array, y: Array, line: Any, scale: float, weights: Array, distance: Array) -> None:
    """Weights of points by a line, in place; none for neighbours of outliers, if half is kept.

    A reflection's edge is soft: frames next to it still hold some of it, which is no noise.
    """
    inverse, end, total, support = 1.0 / (TUNING * scale), x.size - 1, 0.0, 0.0
    for t in range(x.size):
        distance[t] = abs(y[t] - line[1] - line[0] * x[t]) * inverse
        total += bisquare(distance[t])
    for t in range(x.size):
        farthest = distance[t]
        for lag in range(1, EDGE + 1):
            farthest = max(farthest, distance[max(t - lag, 0)], distance[min(t + lag, end)])
        weights[t] = bisquare(distance[t]) if farthest < 1.0 else 0.0
        support += weights[t]
    for t in range(x.size if support < 0.5 * total else 0):
        weights[t] = bisquare(distance[t])


@compiled
def regress(
    x: Array, y: Array, noise: float, weights: Array, residual: Array, few: Any, is_started: int
) -> tuple[float, float, float, float]:
    """Robust line of Tukey's bisquare weights: slope, its variance, scale, energy of abscissa.

    Iteratively reweighted least squares (Beaton and Tukey 1974, doi:10.1080/00401706.1974.10489171)
    with :math:`w = (1 - (r / c s)^2)^2` inside :math:`c s` and 0 outside. The scale s is the
    absolute deviation of rank 30 %, as a standard deviation, renewed at every step and never below
    the `noise` of the ordinate. Residual and weights are in place.
    """
    # From weights of nearly the same points, or anew.
    if is_started:
        slope, intercept, energy = moments(x, y, weights)
    else:
        slope, intercept = _started(x, y, noise, few)
        energy = 0.0
    magnitude, rank = few[4], int(SHARE * x.size)
    deviation, scale = 0.0, noise
    # Residuals and weights are made anew where they are used: a long capture's leave the cache.
    for step in range(STEPS):
        if step > 0:
            slope, intercept, energy = reweighted(x, y, slope, intercept, scale)
        for t in range(x.size):
            magnitude[t] = abs(y[t] - intercept - slope * x[t])
        deviation = ranked(magnitude, rank, max(deviation, noise / TO_STD))
        scale = max(noise, TO_STD * deviation)
    _weigh(x, y, (slope, intercept), scale, weights, residual)
    slope, intercept, energy = moments(x, y, weights)
    for t in range(x.size):
        residual[t] = y[t] - intercept - slope * x[t]
    square, lagged = (residual[0] * weights[0]) ** 2, 0.0
    for t in range(1, x.size):
        weighted = residual[t] * weights[t]
        square += weighted * weighted
        lagged += weighted * residual[t - 1] * weights[t - 1]
    correlation = min(max(lagged / square if square > 0 else 0.0, 0.0), MOST_CORRELATED)
    # Of residuals of lag-one correlation rho only (1 - rho) / (1 + rho) of the points count.
    independent = (1.0 - correlation) / (1.0 + correlation)
    return slope, scale**2 / energy / independent, scale, energy


def lines(abscissa: Array, ordinate: Any, noise: float) -> tuple[Array, Array, Array, Array]:
    """Slopes, variances, energies (pixel), weights (time, pixel) of robust lines, see `regress`."""
    frames, pixels = abscissa.shape
    rows = [np.ascontiguousarray(values.T, np.float64) for values in (abscissa, ordinate)]
    weights, numbers = np.empty((pixels, frames)), np.empty((3, pixels))
    work = np.empty(frames), np.full((5, frames), np.inf, np.float32)
    _lines(*rows, float(noise), weights, *work, numbers)
    slope, variance, energy = numbers
    # Weights k of the ordinate z in the slope, sum k z.
    kernel = weights.T * abscissa
    kernel -= weights.T * (kernel.sum(axis=0) / weights.T.sum(axis=0))
    return slope, variance, energy, kernel / energy


@kernels.entered
def _lines(
    x: Array, y: Array, noise: float, weights: Array, residual: Array, scratch: Any, numbers: Array
) -> None:
    """As `regress`, of many pixels (pixel, time), without a start; in place."""
    for p in range(len(x)):
        numbers[0, p], numbers[1, p], _, numbers[2, p] = regress(
            x[p], y[p], noise, weights[p], residual, scratch, False
        )
