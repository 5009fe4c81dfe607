"""Compiled arithmetic of one pixel: responses as polynomials, and sums over time.

A pixel's curves stay in the processor's cache, and a step costs what its sums cost. What is stated
for arrays in `response` is repeated within rounding.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache
from math import sqrt
from typing import Any, Final, NamedTuple

import numpy as np
from numba import njit
from numpy.polynomial import Chebyshev

from dbthermal import planck
from dbthermal._arrays import Array
from dbthermal._compiled import kept
from dbthermal.response import Curve, LinearCurve
from dbthermal.separation import _tiles as tiles

_ERROR: Final = 2e-7  # of a response's polynomials [K]
_START_ERROR: Final = 0.01  # of the inverse, of which a step of Newton leaves less than 1e-6 [K]
_MARGIN: Final = 0.25  # of the calibrated range, beside it, in which they hold
_TERMS: Final = 10  # of a polynomial
# Degrees, and shares of the range: of a wide one, such as a maker's, the outer parts stay exact.
_TRIALS: Final = (
    *((degree, 1.0) for degree in range(1, _TERMS)),
    *((_TERMS - 1, 0.85**k) for k in range(1, 14)),
)

# Squares of a matrix, at most: two eigenvalues that differ by 1e-9 are told apart; and what is left
# of the smaller ones [1].
_SQUARES, _ROUNDED = 34, 1e-15

# Nothing is allocated within: to count references to the parts of arrays takes a fifth of the time.
_OPTIONS: Final[dict[str, Any]] = {"nogil": True, "error_model": "numpy", "_nrt": False}
entered: Final[Callable[..., Any]] = kept(**_OPTIONS)
"""Decorator of compiled functions that are called from outside."""
# Sums may be taken in any order; NaN stays NaN.
_FLAGS: Final = {"reassoc", "contract", "nsz", "arcp"}
# Python does not call them: to compile an entry for it takes as long as the function.
_WITHIN: Final = _OPTIONS | {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
compiled: Final[Callable[..., Any]] = njit(fastmath=_FLAGS, **_WITHIN)
"""Decorator of functions that are compiled into those that call them."""
allocating: Final[Callable[..., Any]] = njit(fastmath=_FLAGS, **_WITHIN | {"_nrt": True})
"""As `compiled`, for functions that make arrays."""
# Steps stay `compiled`: to compile all of them as a single function takes twice as long.
inlined: Final[Callable[..., Any]] = njit(fastmath=_FLAGS, forceinline=True, **_WITHIN)
"""As `compiled`, for parts of a step: to hand over the 300 numbers of a work space takes long."""
merged: Final[Callable[..., Any]] = njit(fastmath=_FLAGS, inline="always", **_WITHIN)
"""As `inlined`, in one place, from the source: it is not compiled by itself first."""
_numbers: Final[Callable[..., Any]] = njit(fastmath=_FLAGS | {"nnan"}, **_WITHIN)


class Table(NamedTuple):
    """Response of a band: polynomials of (temperature - middle) / half; exact outside."""

    signal: tuple[float, ...]  # coefficients of u(T) - T_r [K], rising
    slope: tuple[float, ...]  # of u'(T) [1]
    inverse: tuple[float, ...]  # of T of (signal - middle_signal) / half_signal, nearly [K]
    middle: float  # [K]
    half: float  # [K]
    middle_signal: float  # less the reference [K]
    half_signal: float  # [K]
    linear: bool
    amplitude: float  # C / a [K], or the slope over a
    wavelength: float  # A [m]
    shift: float  # B [m K]
    offset: float  # (O - U(T_r)) / a [K]


def rows(curves: Sequence[Curve]) -> Array:
    """Responses of some bands (band, number), on one range, for `response`."""
    return np.array([np.hstack(table(curve, *curves)) for curve in curves])


@compiled
def response(rows: Array, band: int) -> Table:
    """Response of a band of `rows`."""
    c = rows[band]
    return Table(
        (c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8], c[9]),
        (c[10], c[11], c[12], c[13], c[14], c[15], c[16], c[17], c[18], c[19]),
        (c[20], c[21], c[22], c[23], c[24], c[25], c[26], c[27], c[28], c[29]),
        c[30],
        c[31],
        c[32],
        c[33],
        c[34] > 0.0,
        c[35],
        c[36],
        c[37],
        c[38],
    )


@lru_cache
def table(curve: Curve, *second: Curve) -> Table:
    """Polynomials of a response, of the least degree that keeps an error in all bands."""
    margin = _MARGIN * (curve.highest - curve.lowest)
    widest = np.array([max(curve.lowest - margin, 0.5 * curve.lowest), curve.highest + margin])
    for degree, share in _TRIALS:
        low, high = (curve.reference + share * (widest - curve.reference)).tolist()
        dense = np.linspace(low, high, 1001)
        errors, starts = [], []
        for band in (*second, curve):
            u = Chebyshev.interpolate(_signal, degree, [low, high], args=(band,))
            slope, ends = u.deriv(), _signal(np.array([low, high]), band)
            errors += [u(dense) - _signal(dense, band), slope(dense) - band.slope(dense)]
            inverse = Chebyshev.interpolate(_temperature, _TERMS - 1, ends, args=(band,))
            starts += [inverse(_signal(dense, band)) - dense]
        if np.abs(errors).max() < _ERROR and np.abs(starts).max() < _START_ERROR:
            break
    else:
        raise ValueError(
            f"Invalid response in band '{curve.band}': {np.abs(errors).max():.1g} K from a "
            f"polynomial of degree {degree}. Must be smooth over its range, {curve.lowest} to "
            f"{curve.highest} K."
        )
    a = curve.reference_slope
    return Table(
        signal=_coefficients(u),
        slope=_coefficients(slope),
        inverse=_coefficients(inverse),
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


def _signal(temperature: Array, curve: Curve) -> Array:
    return curve.signal(temperature) - curve.reference


def _temperature(signal: Array, curve: Curve) -> Array:
    return curve.temperature(signal + curve.reference)


def _coefficients(series: Chebyshev) -> tuple[float, ...]:
    powers = np.polynomial.chebyshev.cheb2poly(series.coef)
    return tuple(np.pad(powers, (0, _TERMS - powers.size)).tolist())


@compiled
def exact(table: Table, temperature: float) -> tuple[float, float]:
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
    """Polynomial of ten rising coefficients (Horner's scheme), in registers."""
    high = c[5] + x * (c[6] + x * (c[7] + x * (c[8] + x * c[9])))
    return c[0] + x * (c[1] + x * (c[2] + x * (c[3] + x * (c[4] + x * high))))


@compiled
def with_slope(c: tuple[float, ...], x: float) -> tuple[float, float]:
    """Polynomial of ten rising coefficients, and its derivative."""
    slope, value = c[9], c[9] * x + c[8]
    slope, value = slope * x + value, value * x + c[7]
    slope, value = slope * x + value, value * x + c[6]
    slope, value = slope * x + value, value * x + c[5]
    slope, value = slope * x + value, value * x + c[4]
    slope, value = slope * x + value, value * x + c[3]
    slope, value = slope * x + value, value * x + c[2]
    slope, value = slope * x + value, value * x + c[1]
    return value * x + c[0], slope * x + value


@compiled
def mixed(u: float, a: tuple[float, ...], v: float, b: tuple[float, ...]) -> tuple[float, ...]:
    """Ten coefficients of a sum of two polynomials."""
    low = u * a[0] + v * b[0], u * a[1] + v * b[1], u * a[2] + v * b[2]
    mid = u * a[3] + v * b[3], u * a[4] + v * b[4], u * a[5] + v * b[5]
    high = u * a[6] + v * b[6], u * a[7] + v * b[7], u * a[8] + v * b[8]
    return low + mid + high + (u * a[9] + v * b[9],)


@compiled
def blackbody(table: Table, temperature: Array, signal: Array, slope: Array) -> None:
    """Signal less the reference [K] and slope [1] of a blackbody (time) [K], in place."""
    outside, scale = 0.0, 1.0 / table.half  # a sum: a largest value would not be taken many at once
    for t in range(temperature.size):
        x = (temperature[t] - table.middle) * scale
        outside += 0.0 if abs(x) <= 1.0 else 1.0
        signal[t], rate = with_slope(table.signal, x)
        slope[t] = rate * scale
    if outside > 0.0:
        for t in range(temperature.size):
            if not abs(temperature[t] - table.middle) <= table.half:
                signal[t], slope[t] = exact(table, temperature[t])


@compiled
def temperature(table: Table, signal: Array, result: Array) -> None:
    """Temperature of a signal (time) [K] within 0.01 K, in place; NaN where undefined."""
    outside, scale = 0.0, 1.0 / table.half_signal
    for t in range(signal.size):
        x = (signal[t] - table.middle_signal) * scale
        outside += 0.0 if abs(x) <= 1.0 else 1.0
        result[t] = polynomial(table.inverse, x)
    if outside > 0.0:
        for t in range(signal.size):
            if not abs(signal[t] - table.middle_signal) <= table.half_signal:
                result[t] = inverse(table, signal[t])


@compiled
def inverse(table: Table, signal: float) -> float:
    """Temperature [K] of a blackbody with any signal less the reference [K]."""
    excess = signal - table.offset
    if table.linear:
        return float(excess / table.amplitude)
    if excess > 0.0:
        scale = planck.SECOND_RADIATION_CONSTANT / np.log1p(table.amplitude / excess)
        return float((scale - table.shift) / table.wavelength)
    return float(np.nan)


@compiled
def fill(result: Array, value: float) -> None:
    for t in range(result.size):
        result[t] = value


@compiled
def copy(values: Array, result: Array) -> None:
    for t in range(values.size):
        result[t] = values[t]


@compiled
def dot(first: Array, second: Array) -> float:
    total = 0.0
    for t in range(first.size):
        total += first[t] * second[t]
    return total


@compiled
def mean(values: Array) -> float:
    total = 0.0
    for t in range(values.size):
        total += values[t]
    return total / values.size


@compiled
def principal(matrix: Array, projector: Array, square: Array, axis: Array) -> float:
    """Largest eigenvalue of a symmetric matrix; its vector, of any length, in place."""
    count = axis.size
    # The longer of two expressions for the vector.
    if count == 2:
        a, b, d = matrix[0, 0], matrix[0, 1], matrix[1, 1]
        largest = 0.5 * (a + d) + sqrt(0.25 * (a - d) ** 2 + b * b)
        axis[0], axis[1] = (largest - d, b) if a >= d else (b, largest - a)
        return largest
    # Squares of a matrix of trace 1 tend to the projector on its principal axis.
    trace, best, largest, length = 0.0, 0, 0.0, 0.0
    for i in range(count):
        copy(matrix[i], square[i])
        trace += matrix[i, i]
    for _ in range(_SQUARES):
        for i, j in np.ndindex(count, count):
            projector[i, j] = square[i, j] / trace
        trace = 0.0
        for i, j in np.ndindex(count, count):
            square[i, j] = dot(projector[i], projector[j])
        for i in range(count):
            trace += square[i, i]
        if 1.0 - trace < _ROUNDED:
            break
    for i in range(count):
        best = i if projector[i, i] > projector[best, best] else best
    copy(projector[best], axis)
    for i in range(count):
        largest += axis[i] * dot(matrix[i], axis)
        length += axis[i] ** 2
    return largest / length


@_numbers
def range_of(values: Array) -> Any:
    """Largest less smallest value; with a NaN any number, so that many are compared at once."""
    low, high = values[0], values[0]
    for t in range(values.size):
        low = min(low, values[t])
        high = max(high, values[t])
    return high - low


@compiled
def combined(columns: Array, spans: tiles.Whole, scales: Array, count: int, result: Array) -> None:
    """Sum of the first columns (column, time) times scales, in place."""
    fill(result, 0.0)
    for j in range(0, count - count % 4, 4):
        start, stop = spans[j, 0], spans[j + 3, 1]
        a, b = columns[j, start:stop], columns[j + 1, start:stop]
        c, d = columns[j + 2, start:stop], columns[j + 3, start:stop]
        w, x, y, z = scales[j], scales[j + 1], scales[j + 2], scales[j + 3]
        section = result[start:stop]
        for t in range(section.size):
            section[t] += w * a[t] + x * b[t] + y * c[t] + z * d[t]
    for j in range(count - count % 4, count):
        start, stop = spans[j]
        column, section, scale = columns[j, start:stop], result[start:stop], scales[j]
        for t in range(section.size):
            section[t] += scale * column[t]


@compiled
def projected(columns: Array, spans: tiles.Whole, count: int, curve: Array, result: Array) -> None:
    """Products of the first columns (column, time) with a curve, in place."""
    for j in range(0, count - count % 4, 4):
        start, stop, w, x, y, z = spans[j, 0], spans[j + 3, 1], 0.0, 0.0, 0.0, 0.0
        a, b = columns[j, start:stop], columns[j + 1, start:stop]
        c, d = columns[j + 2, start:stop], columns[j + 3, start:stop]
        section = curve[start:stop]
        for t in range(section.size):
            w += a[t] * section[t]
            x += b[t] * section[t]
            y += c[t] * section[t]
            z += d[t] * section[t]
        result[j], result[j + 1], result[j + 2], result[j + 3] = w, x, y, z
    for j in range(count - count % 4, count):
        start, stop = spans[j]
        result[j] = dot(columns[j, start:stop], curve[start:stop])


@compiled
def projected_both(columns: Array, spans: tiles.Whole, first: Array, last: Array, to: Any) -> None:
    """Products of all columns with two curves, in place; each column is read once."""
    count = len(columns)
    for j in range(0, count - count % 2, 2):
        start, stop, a, b, c, d = spans[j, 0], spans[j + 1, 1], 0.0, 0.0, 0.0, 0.0
        column, next_column = columns[j, start:stop], columns[j + 1, start:stop]
        section, last_section = first[start:stop], last[start:stop]
        for t in range(section.size):
            a += column[t] * section[t]
            b += next_column[t] * section[t]
            c += column[t] * last_section[t]
            d += next_column[t] * last_section[t]
        to[0, j], to[0, j + 1], to[1, j], to[1, j + 1] = a, b, c, d
    for j in range(count - count % 2, count):
        start, stop = spans[j]
        to[0, j] = dot(columns[j, start:stop], first[start:stop])
        to[1, j] = dot(columns[j, start:stop], last[start:stop])
