"""Compiled arithmetic of one pixel: responses as polynomials, sums over time, a robust line.

A pixel's curves stay in the processor's cache, and a step costs what its sums cost. What is stated
for arrays in `response` and `residuals` is repeated within rounding.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit
from numpy.polynomial import Chebyshev

from dbthermal import planck
from dbthermal._arrays import Array
from dbthermal.response import Curve, LinearCurve
from dbthermal.separation._subspace import residuals

_ERROR: Final = 1e-7  # of a response's polynomials [K]
_MARGIN: Final = 0.25  # of the calibrated range, beside it, in which they hold
_TERMS: Final = 12  # of a polynomial
_ROUGH: Final = 7  # degree of the inverse that two Newton steps begin with
_BISECTIONS: Final = 22  # of the range of values, in which a rank is sought

# Sums may be taken in any order; NaN stays NaN.
_FLAGS: Final = {"reassoc", "contract", "nsz", "arcp"}
compiled: Final[Callable[..., Any]] = njit(nogil=True, fastmath=_FLAGS, error_model="numpy")
"""Decorator of functions that are compiled into those that call them."""


class Table(NamedTuple):
    """Response of a band, as polynomials of (temperature - middle) / half; exact beside them."""

    signal: tuple[float, ...]  # coefficients of u(T) - T_r [K], rising
    slope: tuple[float, ...]  # of u'(T) [1]
    rough: tuple[float, ...]  # of T of (signal - middle_signal) / half_signal [K]
    middle: float  # [K]
    half: float  # [K]
    middle_signal: float  # less the reference [K]
    half_signal: float  # [K]
    linear: bool
    amplitude: float  # C / a [K], or the slope over a
    wavelength: float  # A [m]
    shift: float  # B [m K]
    offset: float  # (O - U(T_r)) / a [K]


@lru_cache
def table(curve: Curve) -> Table:
    """Polynomials of a response, of the least degree that keeps an error."""
    margin = _MARGIN * (curve.highest - curve.lowest)
    low, high = max(curve.lowest - margin, 0.5 * curve.lowest), curve.highest + margin
    dense = np.linspace(low, high, 1001)

    def signal(temperature: Array) -> Array:
        return curve.signal(temperature) - curve.reference

    for degree in range(1, _TERMS):
        u, slope = (Chebyshev.interpolate(f, degree, [low, high]) for f in (signal, curve.slope))
        errors = np.abs([u(dense) - signal(dense), slope(dense) - curve.slope(dense)])
        if errors.max() < _ERROR:
            break
    else:
        raise ValueError(
            f"Invalid response in band '{curve.band}': {errors.max():.1g} K from a polynomial of "
            f"degree {degree}. Must be smooth over its range, {curve.lowest} to {curve.highest} K."
        )
    ends, a = signal(np.array([low, high])), curve.reference_slope
    inverse = Chebyshev.interpolate(lambda s: curve.temperature(s + curve.reference), _ROUGH, ends)
    return Table(
        signal=_coefficients(u),
        slope=_coefficients(slope),
        rough=_coefficients(inverse),
        middle=0.5 * (low + high),
        half=0.5 * (high - low),
        middle_signal=float(ends.mean()),
        half_signal=0.5 * float(ends[1] - ends[0]),
        linear=isinstance(curve, LinearCurve),
        amplitude=curve.amplitude / a,
        wavelength=curve.wavelength,
        shift=curve.shift,
        offset=(curve.offset - curve.reference_counts) / a,
    )


def _coefficients(series: Chebyshev) -> tuple[float, ...]:
    powers = np.polynomial.chebyshev.cheb2poly(series.coef)
    return tuple(np.pad(powers, (0, _TERMS - powers.size)).tolist())


@compiled
def _exact(table: Table, temperature: float) -> tuple[float, float]:
    """Signal less the reference [K] and slope [1] of a blackbody at any temperature [K]."""
    if table.linear:
        return table.amplitude * temperature + table.offset, table.amplitude
    scale = table.wavelength * temperature + table.shift
    exponent = planck.SECOND_RADIATION_CONSTANT / scale
    excess = np.expm1(exponent)
    share = table.amplitude / excess
    slope = share * (1.0 + 1.0 / excess) * exponent * table.wavelength / scale
    return share + table.offset, slope


@compiled
def polynomial(c: tuple[float, ...], x: float) -> float:
    """Polynomial of twelve rising coefficients (Horner's scheme), in registers."""
    high = c[6] + x * (c[7] + x * (c[8] + x * (c[9] + x * (c[10] + x * c[11]))))
    return c[0] + x * (c[1] + x * (c[2] + x * (c[3] + x * (c[4] + x * (c[5] + x * high)))))


@compiled
def blackbody(table: Table, temperature: Array, signal: Array, slope: Array, x: Array) -> None:
    """Signal less the reference [K] and slope [1] of a blackbody (time) [K], in place."""
    largest = 0.0
    for t in range(temperature.size):
        x[t] = (temperature[t] - table.middle) / table.half
        largest = max(largest, abs(x[t]))
    for t in range(temperature.size):
        signal[t], slope[t] = polynomial(table.signal, x[t]), polynomial(table.slope, x[t])
    if not largest <= 1.0:
        for t in range(temperature.size):
            if not abs(x[t]) <= 1.0:
                signal[t], slope[t] = _exact(table, temperature[t])


@compiled
def dot(one: Array, other: Array) -> float:
    total = 0.0
    for t in range(one.size):
        total += one[t] * other[t]
    return total


@compiled
def combined(columns: Array, coefficients: Array, count: int, result: Array) -> None:
    """Sum of the first columns (column, time) times coefficients, in place."""
    result[:] = 0.0
    for j in range(count):
        for t in range(result.size):
            result[t] += coefficients[j] * columns[j, t]


@njit(nogil=True, fastmath=_FLAGS | {"nnan"}, error_model="numpy")
def ranked(values: npt.NDArray[np.float32], rank: int) -> float:
    """Value of a rank, from 0, of values that are not negative, by bisection: no sorting."""
    low, high = np.float32(0.0), np.float32(0.0)
    for t in range(values.size):
        high = max(high, values[t])
    for _ in range(_BISECTIONS):
        middle = np.float32(0.5) * (low + high)
        below = np.float32(0.0)  # sums of one kind are taken many at once
        for t in range(values.size):
            below += np.float32(1.0) if values[t] < middle else np.float32(0.0)
        if below <= rank:
            low = middle
        else:
            high = middle
        if below == rank:
            break
    result = np.float32(np.inf)
    for t in range(values.size):
        result = min(result, values[t] if values[t] >= low else np.float32(np.inf))
    return float(result)


@compiled
def moments(x: Any, y: Any, weights: Any) -> tuple[float, float, float]:
    """Slope and intercept of a weighted line, and the energy of the abscissa about its mean."""
    total, first, second, square, product = 0.0, 0.0, 0.0, 0.0, 0.0
    for t in range(x.size):
        w = weights[t]
        wx = w * x[t]
        total += w
        first += wx
        second += w * y[t]
        square += wx * x[t]
        product += wx * y[t]
    middle, centre = first / total, second / total
    energy = square - total * middle**2
    slope = (product - total * middle * centre) / energy
    return slope, centre - slope * middle, energy


@compiled
def _bisquare(residual: Any, scale: float, weights: Any) -> None:
    """Tukey's bisquare weights of residuals, in place."""
    inverse = 1.0 / (residuals.TUNING * scale)
    for t in range(residual.size):
        r = residual[t] * inverse
        kept = max(1.0 - r * r, 0.0)
        weights[t] = kept * kept


@compiled
def _started(x: Array, y: Array, noise: float, residual: Array, few: Any) -> None:
    """Residual from the best of three starts, in place; see `residuals.regress`."""
    middle, centre = x.mean(), y.mean()
    step = max(1, x.size // residuals.STARTING_POINTS)
    count = (x.size + step - 1) // step
    xs, ys, rest = few[0, :count], few[1, :count], few[2, :count]
    weights, plain = few[3, :count], few[4, :count]
    for i in range(count):
        xs[i], ys[i] = x[i * step] - middle, y[i * step] - centre
    weights[:] = 1.0
    slope, intercept, _ = moments(xs, ys, weights)
    for i in range(count):
        plain[i] = ys[i] - intercept - slope * xs[i]
    rank = int(residuals.SHARE * count)
    best, best_slope, best_intercept = np.inf, np.inf, np.inf
    for start in range(3):
        for i in range(count):
            inside = start == 0 or (start == 1 and plain[i] >= 0) or (start == 2 and plain[i] <= 0)
            weights[i] = 1.0 if inside else 0.0
        for _ in range(residuals.STARTING_STEPS):
            slope, intercept, _ = moments(xs, ys, weights)
            for i in range(count):
                rest[i] = abs(ys[i] - intercept - slope * xs[i])
            deviation = ranked(rest, rank)
            scale = max(noise, residuals.ANNEALING * residuals.TO_STD * deviation)
            _bisquare(rest, scale, weights)
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
    for _ in range(residuals.STEPS):
        for t in range(x.size):
            magnitude[t] = abs(residual[t])
        scale = max(noise, residuals.TO_STD * ranked(magnitude, rank))
        _bisquare(residual, scale, weights)
        slope, intercept, energy = moments(x, y, weights)
        for t in range(x.size):
            residual[t] = y[t] - intercept - slope * x[t]
    kept, lagged = (residual[0] * weights[0]) ** 2, 0.0
    for t in range(1, x.size):
        one = residual[t] * weights[t]
        kept += one * one
        lagged += one * residual[t - 1] * weights[t - 1]
    correlation = min(max(lagged / kept if kept > 0 else 0.0, 0.0), residuals.MOST_CORRELATED)
    independent = (1.0 - correlation) / (1.0 + correlation)
    return slope, scale**2 / energy / independent, scale, energy
