r"""Steps 1 to 4 of `method` for two bands, one pixel after another, compiled.

The same equations as `reflection_ratio`, `emission`, `residuals` and `method` state for arrays,
whose results they repeat within rounding (a test). A pixel's signals stay in the processor's
cache, and the responses are polynomials (`Table`), so that a step costs what its sums cost.
"""

from collections.abc import Callable
from functools import lru_cache
from math import erfc, log, sqrt
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit
from numpy.polynomial import Chebyshev
from scipy.special import chdtri, stdtrit
from scipy.stats import chi2

from dbthermal import _smooth as smooth
from dbthermal import planck
from dbthermal.response import Curve, LinearCurve
from dbthermal.separation import _tiles as tiles
from dbthermal.separation._subspace import emission as emissions
from dbthermal.separation._subspace import pieces, reflection_ratio, residuals
from dbthermal.separation._subspace.steps import Solution
from dbthermal.separation._tiles import Tile

Array = npt.NDArray[np.float64]

_ERROR: Final = 1e-7  # of a response's polynomials [K]
_MARGIN: Final = 0.25  # of the calibrated range, beside it, that they hold in
_TERMS: Final = 12  # of a polynomial
_BLOCK: Final = 16  # pixels whose samples are turned at once
_BISECTIONS: Final = 22
_ROUGH: Final = 7  # degree of the inverse that two Newton steps begin with

_CHANCE1: Final = float(chi2.isf(reflection_ratio.CHANCE, 1))
_GRAY_LIMIT: Final = float(chdtri(1, reflection_ratio.GRAY_CHANCE))
_TINY: Final = float(np.finfo(np.float64).tiny)
# Sums may be taken in any order; NaN stays NaN.
_FLAGS: Final = {"reassoc", "contract", "nsz", "arcp"}
compiled: Final[Callable[..., Any]] = njit(
    cache=True, nogil=True, fastmath=_FLAGS, error_model="numpy"
)


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
    low = max(curve.lowest - margin, 0.5 * curve.lowest)
    ends = np.array([low, curve.highest + margin])
    dense = np.linspace(*ends, 1001)
    exact, slope = curve.signal(dense) - curve.reference, curve.slope(dense)
    for degree in range(1, _TERMS):
        parts = [
            Chebyshev.interpolate(function, degree, domain=ends)
            for function in (lambda t: curve.signal(t) - curve.reference, curve.slope)
        ]
        errors = [np.abs(part(dense) - one).max() for part, one in zip(parts, (exact, slope))]
        if max(errors) < _ERROR:
            break
    else:
        raise ValueError(f"Invalid response in band '{curve.band}'. Must be smooth over its range.")
    signals = exact[[0, -1]]
    inverse = Chebyshev.interpolate(
        lambda s: curve.temperature(s + curve.reference), _ROUGH, domain=signals
    )
    series = [np.polynomial.chebyshev.cheb2poly(part.coef) for part in (*parts, inverse)]
    coefficients = [tuple(np.pad(one, (0, _TERMS - one.size)).tolist()) for one in series]
    a = curve.reference_slope
    return Table(
        *coefficients,
        float(ends.mean()),
        float(np.ptp(ends) / 2),
        float(signals.mean()),
        float(np.ptp(signals) / 2),
        isinstance(curve, LinearCurve),
        curve.amplitude / a,
        curve.wavelength,
        curve.shift,
        (curve.offset - curve.reference_counts) / a,
    )


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
def _polynomial(c: tuple[float, ...], x: float) -> float:
    """Polynomial of twelve rising coefficients (Horner's scheme), in registers."""
    high = c[6] + x * (c[7] + x * (c[8] + x * (c[9] + x * (c[10] + x * c[11]))))
    return c[0] + x * (c[1] + x * (c[2] + x * (c[3] + x * (c[4] + x * (c[5] + x * high)))))


@compiled
def _blackbody(table: Table, temperature: Array, signal: Array, slope: Array, x: Array) -> None:
    """Signal less the reference [K] and slope [1] of a blackbody (time) [K], in place."""
    largest = 0.0
    for t in range(temperature.size):
        x[t] = (temperature[t] - table.middle) / table.half
        largest = max(largest, abs(x[t]))
    for t in range(temperature.size):
        signal[t], slope[t] = _polynomial(table.signal, x[t]), _polynomial(table.slope, x[t])
    if not largest <= 1.0:
        for t in range(temperature.size):
            if not abs(x[t]) <= 1.0:
                signal[t], slope[t] = _exact(table, temperature[t])


@compiled
def _dot(one: Array, other: Array) -> float:
    total = 0.0
    for t in range(one.size):
        total += one[t] * other[t]
    return total


@compiled
def _combined(columns: Array, coefficients: Array, count: int, result: Array) -> None:
    """Sum of the first columns (column, time) times coefficients, in place."""
    result[:] = 0.0
    for j in range(count):
        for t in range(result.size):
            result[t] += coefficients[j] * columns[j, t]


@njit(cache=True, nogil=True, fastmath=_FLAGS | {"nnan"})
def _ranked(values: npt.NDArray[np.float32], rank: int) -> float:
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
def _moments(x: Any, y: Any, weights: Any) -> tuple[float, float, float]:
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
    slope, intercept, _ = _moments(xs, ys, weights)
    for i in range(count):
        plain[i] = ys[i] - intercept - slope * xs[i]
    rank = int(residuals.SHARE * count)
    best, best_slope, best_intercept = np.inf, np.inf, np.inf
    for start in range(3):
        for i in range(count):
            inside = start == 0 or (start == 1 and plain[i] >= 0) or (start == 2 and plain[i] <= 0)
            weights[i] = 1.0 if inside else 0.0
        for _ in range(residuals.STARTING_STEPS):
            slope, intercept, _ = _moments(xs, ys, weights)
            for i in range(count):
                rest[i] = abs(ys[i] - intercept - slope * xs[i])
            deviation = _ranked(rest, rank)
            scale = max(noise, residuals.ANNEALING * residuals.TO_STD * deviation)
            _bisquare(rest, scale, weights)
        if deviation < best:
            best, best_slope, best_intercept = deviation, slope, intercept
    for t in range(x.size):
        residual[t] = y[t] - centre - best_intercept - best_slope * (x[t] - middle)


@compiled
def _regress(
    x: Array, y: Array, noise: float, weights: Array, residual: Array, few: Any, again: bool
) -> tuple[float, float, float, float]:
    """
    Robust line, as `residuals.regress`; residual and weights in place.

    Slope, its variance, the scale, and the energy of the abscissa.
    """
    if again:
        slope, intercept, _ = _moments(x, y, weights)
        for t in range(x.size):
            residual[t] = y[t] - intercept - slope * x[t]
    else:
        _started(x, y, noise, residual, few)
    magnitude, rank = few[5], int(residuals.SHARE * x.size)
    for _ in range(residuals.STEPS):
        for t in range(x.size):
            magnitude[t] = abs(residual[t])
        scale = max(noise, residuals.TO_STD * _ranked(magnitude, rank))
        _bisquare(residual, scale, weights)
        slope, intercept, energy = _moments(x, y, weights)
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


class Model(NamedTuple):
    """All that the pixels of a tile share; columns of functions lie along time."""

    first: Table
    second: Table
    functions: Array  # (column, time), of `smooth.Subspace`
    object_part: Array  # (column, time)
    rising: Array  # (degree, time)
    leverage: Array  # (order, time)
    steps: int
    noise: tuple[float, float]  # [K]
    pattern: tuple[float, float]  # [K]
    drift: float  # limit of the background's, over the square root of three [K]
    rate: float  # change of the ratio of the responses' slopes with the background [1/K]
    gray: Array  # ratios of the slopes at temperatures of the background [1]
    widened: Array  # of the octaves' variances, at the end of their 95 % interval [1]
    edges: npt.NDArray[np.intp]  # of the blocks of a residual
    limits: tuple[float, float]  # of its chi-square statistics
    parts: npt.NDArray[np.intp]  # of the means by which pieces are asked for
    lowest: float  # calibrated temperatures [K]
    highest: float


class Work(NamedTuple):
    """Curves (time) of one pixel, and a few in single precision (6, time)."""

    emitted: Array
    second: Array
    slope: Array
    second_slope: Array
    place: Array
    steepness: Array
    partial: Array
    target: Array
    temperature: Array
    weights: Array
    residual: Array
    kernel: Array
    spare: Array
    variance: Array
    smooth_variance: Array
    sensitivity: Array
    background: Array
    background_variance: Array
    bend: Array
    null_residual: Array
    straight: Array
    change: Array
    rapid: Array
    reflected: Array
    other_reflected: Array
    mean: Array
    few: Any


@compiled
def _temperature(table: Table, signal: Array, result: Array, work: Work) -> None:
    """Temperature [K] of a blackbody with a signal (time) [K], in place; NaN where undefined."""
    x, value, slope, largest = work.spare, work.emitted, work.slope, 0.0
    for t in range(signal.size):
        x[t] = (signal[t] - table.middle_signal) / table.half_signal
        largest = max(largest, abs(x[t]))
    for t in range(signal.size):
        result[t] = _polynomial(table.rough, x[t])
    for _ in range(2):  # Newton's steps
        _blackbody(table, result, value, slope, work.place)
        for t in range(signal.size):
            result[t] += (signal[t] - value[t]) / slope[t]
    if not largest <= 1.0:
        for t in range(signal.size):
            if not abs(x[t]) <= 1.0:
                excess = signal[t] - table.offset
                if table.linear:
                    result[t] = excess / table.amplitude
                elif excess > 0.0:
                    scale = planck.SECOND_RADIATION_CONSTANT / np.log1p(table.amplitude / excess)
                    result[t] = (scale - table.shift) / table.wavelength
                else:
                    result[t] = np.nan


class Ratio(NamedTuple):
    """As `reflection_ratio.ReflectionRatio`, of one pixel."""

    ratio: float
    inverse_energy: float
    weights: tuple[float, float]
    null_variance: float
    order: int
    contrast: float
    reduced_chi2: float
    scatter: tuple[float, float, float]
    pooled: bool


@compiled
def _ratios(
    model: Model, z: Array, s: Array, coefficients: Array, scatter: Array, material: Any
) -> Ratio:
    """Step 1 of the signals of both bands; their coefficients (2, column) in place."""
    noise, orders, steps = model.noise, model.leverage.shape[0], model.steps
    columns, frames = model.functions.shape
    held = np.zeros(3)
    for j in range(columns):
        one, other = _dot(model.functions[j], z), _dot(model.functions[j], s)
        coefficients[0, j], coefficients[1, j] = one, other
    total = _dot(z, z), _dot(z, s), _dot(s, s)
    unit = noise[0] ** 2, noise[0] * noise[1], noise[1] ** 2
    for j in range(columns):
        one, other = coefficients[0, j], coefficients[1, j]
        held[0] += one * one
        held[1] += one * other
        held[2] += other * other
        if j >= steps:
            for i in range(3):
                scatter[j - steps, i] = (total[i] - held[i]) / unit[i]
    # Energy across the axis, by order: the smaller eigenvalue, or that of a known axis.
    known = material[0] / noise[1] * noise[0]
    share = 1.0 / sqrt(1.0 + known**2), known / sqrt(1.0 + known**2)
    lowest = min(reflection_ratio.LOWEST_ORDER, orders - 1) - 1
    pooled = False
    if known == known:
        order = _order(scatter, share, True, lowest, frames)
        a, b, d = scatter[order]
        turned = a * share[0] + b * share[1], b * share[0] + d * share[1]
        along = share[0] * turned[0] + share[1] * turned[1]
        statistic = (turned[0] ** 2 + turned[1] ** 2) / along - along
        pooled = statistic < _CHANCE1
    order = _order(scatter, share, pooled, lowest, frames)
    free = frames - steps - (order + 1.0)
    a, b, d = scatter[order]
    largest, null = _energies(a, b, d, share, pooled)
    if pooled:
        ratio = material[0]
    else:
        # The longer of two expressions for the axis.
        across, up = (largest - d, b) if a >= d else (b, largest - a)
        ratio = up / across * (noise[1] / noise[0])
    length = 1.0 / noise[0] ** 2 + (ratio / noise[1]) ** 2
    energy = (largest - free) / length
    inverse = (energy + free / length) / energy**2 if energy > 0 else np.inf
    if pooled:
        inverse = material[1]
    along0, along1, emitted0, emitted1 = (
        1.0 / noise[0],
        ratio / noise[1],
        1.0 / noise[0],
        1.0 / noise[1],
    )
    part = (along0 * emitted0 + along1 * emitted1) / (along0**2 + along1**2)
    off0, off1 = emitted0 - part * along0, emitted1 - part * along1
    variance = 1.0 / (off0**2 + off1**2)
    last = scatter[orders - 1]
    most, least = _energies(last[0], last[1], last[2], share, pooled)
    return Ratio(
        ratio,
        inverse,
        (off0 * variance / noise[0], off1 * variance / noise[1]),
        variance,
        order + 1,
        most / least if least > 0 else np.inf,
        null / free,
        (a - free, b, d - free),
        pooled,
    )


@compiled
def _energies(
    a: float, b: float, d: float, axis: tuple[float, float], known: bool
) -> tuple[float, float]:
    """Energy along the axis of a scatter, the principal one or a known one, and across it."""
    if known:
        along = axis[0] ** 2 * a + 2.0 * axis[0] * axis[1] * b + axis[1] ** 2 * d
    else:
        along = 0.5 * (a + d) + sqrt(0.25 * (a - d) ** 2 + b * b)
    return along, a + d - along


@compiled
def _order(scatter: Array, axis: tuple[float, float], known: bool, lowest: int, frames: int) -> int:
    """Order less one of the lowest information criterion, see `reflection_ratio.choose_order`."""
    best, least = lowest, np.inf
    for order in range(lowest, scatter.shape[0] - 1):
        a, b, d = scatter[order]
        null = max(_energies(a, b, d, axis, known)[1], _TINY)
        criterion = frames * log(null) + (order + 1) * log(frames)
        if criterion < least:
            best, least = order, criterion
    return best + 1 if scatter.shape[0] > 1 else 0


@compiled
def _may_be_gray(model: Model, ratios: Ratio) -> bool:
    """As `reflection_ratio.may_be_gray`: in two bands the part across the axis is one number."""
    noise = model.noise
    along0, along1 = 1.0 / noise[0], ratios.ratio / noise[1]
    length = sqrt(along0**2 + along1**2)
    nearest, chance, before = np.inf, 0.0, 0.0
    for i in range(model.gray.size):
        off = (model.gray[i] / noise[1] * along0 - along1 / noise[0]) / length
        if i > 0:
            apart = 0.0 if off * before <= 0 else min(abs(off), abs(before))
            statistic = apart**2 / ratios.inverse_energy
            nearest = min(nearest, statistic)
            chance += erfc(sqrt(0.5 * statistic)) / (model.gray.size - 1)
        before = off
    return nearest < _GRAY_LIMIT and chance > reflection_ratio.GRAY_CHANCE


class Emission(NamedTuple):
    """Numbers of `emission.Emission`, of one pixel; its curves are rows of the work space."""

    emissivity: tuple[float, float]
    covariance: tuple[float, float, float]
    epsilon: float
    level: float
    noise_variance: float
    drift_variance: float
    constant: bool
    restless: bool


@compiled
def _newton(
    model: Model, ratios: Ratio, emissivity: float, target: Array, temperature: Array, work: Work
) -> None:
    """One step of `emission._newton`, in place; h' and the partial derivative in the work space."""
    emitted, other, slope, other_slope = work.emitted, work.second, work.slope, work.second_slope
    steepness, partial = work.steepness, work.partial
    _blackbody(model.first, temperature, emitted, slope, work.place)
    _blackbody(model.second, temperature, other, other_slope, work.place)
    one = ratios.weights[0] * emissivity
    two = ratios.weights[1] * (1.0 - ratios.ratio * (1.0 - emissivity))
    for t in range(target.size):
        steepness[t] = one * slope[t] + two * other_slope[t]
        partial[t] = other[t] + emissivity * (emitted[t] - other[t])
        temperature[t] += (target[t] - one * emitted[t] - two * other[t]) / steepness[t]


@compiled
def _curve_variance(model: Model, kernel: Array, count: int, variance: float) -> float:
    total = 0.0
    for j in range(count):
        total += _dot(model.object_part[j], kernel) ** 2
    return variance * total


@compiled
def _walk(
    model: Model, residual: Array, weights: Array, emitted: Array, curve_variance: float, count: int
) -> tuple[float, float]:
    """Variance of the slope by a background that walks, and its bound; `emission.walk_variance`."""
    degrees, frames = model.rising.shape
    spectrum, curve = np.empty(degrees), np.empty(degrees)
    share = weights.mean()
    energy, product = 0.0, 0.0
    for j in range(degrees):
        total = 0.0
        for t in range(frames):
            total += model.rising[j, t] * residual[t] * weights[t]
        spectrum[j], curve[j] = total / share, _dot(model.rising[j], emitted)
        energy += curve[j] ** 2
        product += curve[j] * spectrum[j]
    scale, expected, upper = 0.0, 0.0, 0.0
    for j in range(degrees):
        scale += curve[j] ** 2 / (j + 1.0) ** 2
        spectrum[j] -= curve[j] * product / energy
    for octave in range(len(emissions.OCTAVES)):
        low, high, lost = emissions.OCTAVES[octave]
        walk, last = 0.0, min(high - 1, degrees)
        for j in range(low - 1, last):
            noise = model.noise[0] ** 2 / share + (curve_variance if j + 1 < count else 0.0)
            walk += (j + 1.0) ** 2 * (spectrum[j] ** 2 - noise)
        freedom = last - (low - 1) - lost
        if freedom > 0:
            expected = max(expected, walk / freedom)
            upper = max(upper, walk / freedom * model.widened[octave])
    return scale / energy**2 * expected, scale / energy**2 * upper


@compiled
def _linear(
    model: Model,
    ratios: Ratio,
    emissivity: float,
    emitted: Array,
    residual: Array,
    weights: Array,
    scale: float,
    limit: float,
    kernel: Array,
    again: Array,
) -> float:
    """Variance of the slope by a linear drift, as `emission._linear_variance`."""
    drift, frames, count = model.rising[0], emitted.size, ratios.order + model.steps
    kept, slope, size = weights, 0.0, 0.0
    for last in range(2):
        total, mean, middle, square, product = 0.0, 0.0, 0.0, 0.0, 0.0
        for t in range(frames):
            w = kept[t]
            wu = w * emitted[t]
            total += w
            mean += wu
            middle += w * drift[t]
            square += wu * emitted[t]
            product += wu * drift[t]
        mean, middle = mean / total, middle / total
        slope = (product - total * mean * middle) / (square - total * mean**2)
        level, length, size = middle - slope * mean, 0.0, 0.0
        for t in range(frames):
            kernel[t] = kept[t] * (drift[t] - level - slope * emitted[t])
            length += kernel[t] * drift[t]
            size += kernel[t] * residual[t]
        size /= length
        for t in range(frames):
            kernel[t] /= length
        if last == 0:
            inverse = 1.0 / (residuals.TUNING * scale)
            for t in range(frames):
                r = (residual[t] - size * (drift[t] - level - slope * emitted[t])) * inverse
                inside = max(1.0 - r * r, 0.0)
                again[t] = inside * inside
            kept = again
    variance = model.noise[0] ** 2 * _dot(kernel, kernel)
    variance += emissivity**2 * _curve_variance(model, kernel, count, ratios.null_variance)
    spread = drift.max() - drift.min()
    before = max((limit / spread) ** 2, size**2 + variance)
    share = before / (before + variance)
    return slope**2 * share * (share * size**2 + variance)


@compiled
def _emission(
    model: Model, ratios: Ratio, z: Array, coefficients: Array, material: Any, work: Work
) -> Emission:
    """Steps 2 and 3, as `emission.estimate`; the rows that it leaves are named in `_pixel`."""
    emitted, steepness, partial, target = work.emitted, work.steepness, work.partial, work.target
    temperature, weights, residual = work.temperature, work.weights, work.residual
    kernel, spare, place, few = work.kernel, work.spare, work.place, work.few
    frames, noise, count = z.size, model.noise[0], ratios.order + model.steps
    w, null = ratios.weights, ratios.null_variance
    combined = w[0] * coefficients[0] + w[1] * coefficients[1]
    _combined(model.object_part, combined, count, target)
    _temperature(model.second, target, temperature, work)
    largest = max(1.0, ratios.ratio)
    middle = 0.5 * (1.0 + (largest - 1.0) / largest)
    _blackbody(model.first, temperature, emitted, spare, place)
    weights[:] = 1.0
    guess = _moments(emitted, z, weights)[0]
    emissivity = guess if 0 < guess < 1 else middle
    _newton(model, ratios, emissivity, target, temperature, work)
    known = ratios.pooled and material[2] == material[2]
    constant = False
    slope, variance, scale, energy = 0.0, 0.0, 0.0, 0.0
    for turn in range(emissions.ROUNDS):
        _blackbody(model.first, temperature, emitted, spare, place)
        slope, variance, scale, energy = _regress(
            emitted, z, noise, weights, residual, few, turn > 0
        )
        constant = energy < emissions.OBJECT_TO_NOISE * count * null and not known
        emissivity = material[2] if known else middle if constant else slope
        _newton(model, ratios, emissivity, target, temperature, work)
    # The slope's variance, of the ordinate's noise, and of the abscissa's.
    total, product, reflected, low, high = 0.0, 0.0, 0.0, np.inf, -np.inf
    for t in range(frames):
        total += weights[t]
        product += weights[t] * emitted[t]
        reflected += z[t] - emitted[t]
        low, high = min(low, emitted[t]), max(high, emitted[t])
    for t in range(frames):
        kernel[t] = weights[t] * (emitted[t] - product / total) / energy
    first = emissivity
    noise_variance = variance + first**2 * _curve_variance(model, kernel, count, null)
    walk, upper = _walk(model, residual, weights, emitted, first**2 * null, count)
    limit = (1.0 - first) * model.drift
    linear = _linear(model, ratios, first, emitted, residual, weights, scale, limit, kernel, spare)
    drift_variance = (limit / (high - low)) ** 2 + max(upper, linear)
    if known:
        noise_variance, drift_variance = material[3], material[4]
    level = abs(reflected / frames) * sqrt(noise_variance + walk) / (1.0 - first) ** 2
    widest = (model.highest - model.lowest) / sqrt(12.0)
    level = level if level <= widest else widest
    level *= ratios.ratio * model.rate
    by_level = w[1] * level
    epsilon = ratios.inverse_energy * null + by_level**2
    # Of eq. 6 by implicit differentiation, and what the residual of a frame of rest holds.
    sensitivity, smooth_variance = work.sensitivity, work.smooth_variance
    _combined(model.object_part, coefficients[0], count, sensitivity)
    resting, more = 0, 1.0 + log(frames) / count
    beside = (1.0 - emissions.NORMAL95**2 * epsilon) ** 2
    for t in range(frames):
        sensitivity[t] = (partial[t] - sensitivity[t]) / steepness[t]
        smooth_variance[t] = model.leverage[ratios.order - 1, t] * null / steepness[t] ** 2
        square = sensitivity[t] ** 2 * epsilon
        expected = noise**2 + first**2 * (square + smooth_variance[t] * more)
        resting += residual[t] ** 2 < emissions.WITHIN**2 * expected
        work.variance[t] = square / beside + smooth_variance[t]
    return Emission(
        (first, 1.0 - ratios.ratio * (1.0 - first)),
        _covariance(model, ratios, first, noise_variance + drift_variance, level),
        epsilon,
        level,
        noise_variance,
        drift_variance,
        constant,
        resting < emissions.RESTING * frames,
    )


@compiled
def _covariance(
    model: Model, ratios: Ratio, first: float, slope_variance: float, level: float
) -> tuple[float, float, float]:
    """Covariance of the emissivities (eq. 8), as `emission._emissivity_covariance`."""
    k, w, energy = ratios.ratio, ratios.weights, ratios.inverse_energy
    one, two, reflectivity = model.noise[0] ** 2, model.noise[1] ** 2, 1.0 - first
    with_epsilon = two * w[1] - k * one * w[0]
    variance = energy * (two + k**2 * one)
    through, cross = (first * reflectivity) ** 2 * ratios.null_variance, first * reflectivity**2
    a = slope_variance + through * energy
    b = k * slope_variance + (k * through + cross * with_epsilon) * energy
    d = k**2 * (slope_variance + through * energy) + 2.0 * cross * k * with_epsilon * energy
    d += reflectivity**2 * variance
    by_level = reflectivity * first * w[1] * level, reflectivity * (k * first * w[1] + 1.0) * level
    return a + by_level[0] ** 2, b + by_level[0] * by_level[1], d + by_level[1] ** 2


@compiled
def _background(
    model: Model, ratios: Ratio, emission: Emission, z: Array, other: Array, work: Work
) -> None:
    """Step 4, as `emission.estimate_background` and `pattern_variances`, in place."""
    emitted, second, slope, second_slope = work.emitted, work.second, work.slope, work.second_slope
    temperature, background, mean, x = work.temperature, work.background, work.mean, work.place
    of_object, variance = work.variance, work.background_variance
    noise, pattern, w = model.noise, model.pattern, ratios.weights
    (first, last), epsilon = emission.emissivity, emission.epsilon
    one, two = ((1.0 - first) / noise[0]) ** 2, ((1.0 - last) / noise[1]) ** 2
    precision = one + two
    one, two = one / precision, two / precision
    _blackbody(model.first, temperature, emitted, slope, x)
    _blackbody(model.second, temperature, second, second_slope, x)
    share = one * first / (1.0 - first) + two * last / (1.0 - last)
    reflected, other_reflected = work.reflected, work.other_reflected
    direct0, direct1 = one / (1.0 - first), two / (1.0 - last)
    patterned = pattern[0] > 0.0 or pattern[1] > 0.0
    for t in range(z.size):
        reflected[t] = (z[t] - first * emitted[t]) / (1.0 - first)
        other_reflected[t] = (other[t] - last * second[t]) / (1.0 - last)
        mean[t] = one * reflected[t] + two * other_reflected[t]
        variance[t] = 0.0
    if patterned:
        for t in range(z.size):
            steepness = w[0] * first * slope[t] + w[1] * last * second_slope[t]
            through = direct0 * first * slope[t] + direct1 * last * second_slope[t]
            a, b = w[0] / steepness, w[1] / steepness
            of_object[t] += (pattern[0] * a) ** 2 + (pattern[1] * b) ** 2
            variance[t] = (pattern[0] * (direct0 - through * a)) ** 2
            variance[t] += (pattern[1] * (direct1 - through * b)) ** 2
    _temperature(model.first, mean, background, work)
    _blackbody(model.first, background, emitted, slope, x)
    _blackbody(model.second, background, second, second_slope, x)
    covariance = 2.0 * noise[0] ** 2 * w[0] * ratios.inverse_energy
    of_first = noise[0] ** 2 - 1.0 / (1.0 / noise[0] ** 2 + (ratios.ratio / noise[1]) ** 2)
    steady = of_first * ratios.inverse_energy
    steady += (emission.noise_variance + emission.drift_variance) / (1.0 - first) ** 2
    for t in range(z.size):
        a, b = slope[t], second_slope[t]
        curvature = one * a**2 + two * b**2
        step = one * a * (reflected[t] - emitted[t]) + two * b * (other_reflected[t] - second[t])
        background[t] += step / curvature
        contrast = background[t] - temperature[t]
        through = contrast * first + share * work.sensitivity[t]
        value = 1.0 / (precision * curvature) + share**2 * work.smooth_variance[t]
        value += through * (through * epsilon - contrast * covariance)
        value += contrast**2 * steady
        reflected[t] = value
    if patterned:
        _blackbody(model.first, background, emitted, slope, x)
    for t in range(z.size):
        variance[t] = reflected[t] + variance[t] / slope[t] ** 2


@compiled
def _unsteady(
    model: Model, ratios: Ratio, residual: Array, rapid: Array
) -> tuple[float, float, bool]:
    """Autocorrelation, delay of the bands, and whether the residual is noise; see `residuals`."""
    frames, null, noise = residual.size, ratios.null_variance, model.noise[0]
    energy = _dot(residual, residual)
    lagged = 0.0
    for lag in range(1, residuals.LAGS + 1):
        lagged += _dot(residual[lag:], residual[: frames - lag])
    correlation = lagged / (residuals.LAGS * energy) if energy > 0 else 0.0
    free = frames - ratios.order - model.steps
    common = ratios.weights[0] * noise**2
    late, early, changes = free * common, -free * common, 0.0
    edge, limit = False, residuals.CHANGE * sqrt(2.0) * noise
    count, at_changes = 0, 0.0
    for t in range(frames):
        steep = False
        if t + 1 < frames:
            change = rapid[t + 1] - rapid[t]
            late += residual[t] * change
            early += residual[t + 1] * change
            changes += change**2
            steep = abs(change) > limit
        if steep or edge:
            count += 1
            at_changes += residual[t] ** 2 / null
        edge = steep
    score = max(abs(late), abs(early)) / sqrt(null * changes) if null * changes > 0 else 0.0
    variance = 2.0 / (9.0 * max(count, 1))
    mean = at_changes / count if count > 0 else 1.0
    score = max(score, (mean ** (1.0 / 3.0) - (1.0 - variance)) / sqrt(variance))
    return (
        correlation * sqrt(residuals.LAGS * frames),
        score,
        _unexplained(model, ratios, residual, rapid, common),
    )


@compiled
def _unexplained(model: Model, ratios: Ratio, residual: Array, rapid: Array, common: float) -> bool:
    """As `residuals.unexplained`."""
    blocks = model.edges.size - 1
    sums, together = np.zeros(blocks), 0.0
    leverage = model.leverage[ratios.order - 1]
    for block in range(blocks):
        product, square = 0.0, 0.0
        for t in range(model.edges[block], model.edges[block + 1]):
            sums[block] += residual[t]
            product += residual[t] * rapid[t] - common * (1.0 - leverage[t])
            square += rapid[t] ** 2
        together += product**2 / square if square > 0 else 0.0
    if together / ratios.null_variance > model.limits[0]:
        return True
    edges, step = model.edges, 1
    while blocks > 1:
        for block in range(blocks):
            length = edges[(block + 1) * step] - edges[block * step]
            if sums[block] ** 2 > model.limits[1] * ratios.null_variance * length:
                return True
        blocks //= 2
        step *= 2
        for block in range(blocks):
            sums[block] = sums[2 * block] + sums[2 * block + 1]
    return False


@compiled
def _solve(
    model: Model,
    z: Array,
    other: Array,
    straight: Array,
    coefficients: Array,
    scatter: Array,
    material: Any,
    work: Work,
) -> tuple[Ratio, Emission]:
    """Steps 1 to 4, and the bend of the reflections (eq. 11) in the work space."""
    ratios = _ratios(model, z, straight, coefficients, scatter, material)
    emission = _emission(model, ratios, z, coefficients, material, work)
    _background(model, ratios, emission, z, other, work)
    first, last = emission.emissivity
    bend, finite = work.bend, 0.0
    _blackbody(model.first, work.background, work.emitted, work.slope, work.place)
    _blackbody(model.second, work.background, work.second, work.slope, work.place)
    for t in range(z.size):
        bend[t] = (1.0 - last) * (work.second[t] - work.emitted[t])
        finite += bend[t] * 0.0
    if not (0 < first < 1 and 0 < last < 1 and finite == 0):
        bend[:] = 0.0
    return ratios, emission


@compiled
def _film(
    temperature: Array, variance: Array, model: Model, value: Any, std: Any
) -> tuple[int, int, bool]:
    """A temperature and its deviation, NaN where useless; samples lost, NaN, and out of range."""
    lost, missing, beyond = 0, 0, False
    for t in range(temperature.size):
        one, deviation = temperature[t], sqrt(variance[t])
        missing += one != one
        margin = tiles.RANGE_SIGMAS * (deviation if deviation == deviation else 0.0)
        beyond |= one < model.lowest - margin or one > model.highest + margin
        if abs(one) < tiles.USELESS and deviation < tiles.USELESS:
            value[t], std[t] = one, deviation
        else:
            lost += 1
            value[t], std[t] = np.nan, np.nan
    return lost, missing, beyond


_NUMBERS: Final = (
    *("ratio", "inverse_energy", "first_weight", "second_weight", "null_variance", "order"),
    *("contrast", "reduced_chi2", "first_emissivity", "second_emissivity", "epsilon", "level"),
    *("noise_variance", "drift_variance", "correlation", "delay"),
    *("object_lost", "object_missing", "background_lost", "background_missing"),
)
_CONDITIONS: Final = (
    *("pooled", "gray", "constant", "restless", "rough", "object_beyond", "background_beyond"),
)
_SYMMETRIC: Final = [("covariance", np.float64, 3), ("scatter", np.float64, 3)]
RECORD: Final = np.dtype(
    [(name, np.float64) for name in _NUMBERS]
    + [(name, np.bool_) for name in _CONDITIONS]
    + [*_SYMMETRIC, ("rapid_scatter", np.float64, (2, 3))]
)
"""Numbers of a pixel; a symmetric matrix of two bands as its first, mixed and last element."""


@compiled
def _pixel(
    model: Model,
    z: Array,
    other: Array,
    material: Any,
    least: float,
    work: Work,
    films: Any,
    record: Any,
    sums: Array,
) -> None:
    """Steps 1 to 4, on the exact model where it matters, and all that the flags need."""
    straight, bend, change = work.straight, work.bend, work.change
    orders, steps = model.leverage.shape[0], model.steps
    coefficients, scatter = np.empty((2, model.functions.shape[0])), np.empty((orders, 3))
    straight[:] = other
    change[:] = 0.0
    ratios, emission = _solve(model, z, other, straight, coefficients, scatter, material, work)
    gray = _may_be_gray(model, ratios)
    for _ in range(emissions.BENDS):
        middle, energy = 0.0, 0.0
        for t in range(z.size):
            middle += bend[t] - change[t]
        middle /= z.size
        for t in range(z.size):
            energy += (bend[t] - change[t] - middle) ** 2
        if not energy > (least * model.noise[1]) ** 2:
            break
        least = emissions.BEND
        for t in range(z.size):
            change[t] = bend[t]
            straight[t] = other[t] - bend[t]
        ratios, emission = _solve(model, z, other, straight, coefficients, scatter, material, work)
    count, w = ratios.order + steps, ratios.weights
    residual, rapid, curve = work.null_residual, work.rapid, work.target
    combined = w[0] * coefficients[0] + w[1] * coefficients[1]
    _combined(model.functions, coefficients[0], count, rapid)
    _combined(model.functions, combined, count, residual)
    for t in range(z.size):
        rapid[t] = z[t] - rapid[t]
        residual[t] = w[0] * z[t] + w[1] * straight[t] - residual[t]
    correlation, delay, rough = _unsteady(model, ratios, residual, rapid)
    for block in range(model.parts.size - 1):
        for t in range(model.parts[block], model.parts[block + 1]):
            sums[0, block] += residual[t]
            sums[1, block] += curve[t]
    lost, missing, beyond = _film(work.temperature, work.variance, model, films[0], films[1])
    record.object_lost, record.object_missing, record.object_beyond = lost, missing, beyond
    lost, missing, beyond = _film(
        work.background, work.background_variance, model, films[2], films[3]
    )
    record.background_lost, record.background_missing = lost, missing
    record.background_beyond = beyond
    record.ratio, record.inverse_energy = ratios.ratio, ratios.inverse_energy
    record.first_weight, record.second_weight = w
    record.null_variance, record.order = ratios.null_variance, ratios.order
    record.contrast, record.reduced_chi2 = ratios.contrast, ratios.reduced_chi2
    record.pooled, record.gray = ratios.pooled, gray
    record.first_emissivity, record.second_emissivity = emission.emissivity
    record.epsilon, record.level = emission.epsilon, emission.level
    record.noise_variance = emission.noise_variance
    record.drift_variance = emission.drift_variance
    record.constant, record.restless = emission.constant, emission.restless
    record.correlation, record.delay, record.rough = correlation, delay, rough
    for i in range(3):
        record.covariance[i], record.scatter[i] = emission.covariance[i], ratios.scatter[i]
    for place in range(2):
        order = max(1, orders - reflection_ratio.FEWER * (1 - place))
        for i in range(3):
            free = 0.0 if i == 1 else z.size - steps - order
            record.rapid_scatter[place, i] = scatter[order - 1, i] - free


@compiled
def _pixels(
    model: Model,
    signals: Array,
    materials: Array,
    least: float,
    films: Any,
    record: Array,
    sums: Array,
) -> None:
    """All pixels of signals (2, time, pixel), a few at a time in the order of time."""
    frames, pixels = signals.shape[1:]
    work = Work(
        np.empty(frames),
        np.empty(frames),
        np.empty(frames),
        np.empty(frames),
        np.empty(frames),
        np.empty(frames),
        np.empty(frames),
        np.empty(frames),
        np.empty(frames),
        np.empty(frames),
        np.empty(frames),
        np.empty(frames),
        np.empty(frames),
        np.empty(frames),
        np.empty(frames),
        np.empty(frames),
        np.empty(frames),
        np.empty(frames),
        np.empty(frames),
        np.empty(frames),
        np.empty(frames),
        np.empty(frames),
        np.empty(frames),
        np.empty(frames),
        np.empty(frames),
        np.empty(frames),
        np.empty((6, frames), np.float32),
    )
    inside, outside = np.empty((2, _BLOCK, frames)), np.empty((4, _BLOCK, frames), np.float32)
    for start in range(0, pixels, _BLOCK):
        size = min(_BLOCK, pixels - start)
        for band in range(2):
            for t in range(frames):
                for p in range(size):
                    inside[band, p, t] = signals[band, t, start + p]
        for p in range(size):
            material = materials[start + p]
            _pixel(
                model,
                inside[0, p],
                inside[1, p],
                material,
                least,
                work,
                outside[:, p],
                record[start + p],
                sums[start + p],
            )
        for film in range(4):
            for t in range(frames):
                for p in range(size):
                    films[film, t, start + p] = outside[film, p, t]


def model(tile: Tile, functions: smooth.Subspace, drift: float) -> Model:
    """All that the pixels of a tile of two bands share."""
    first, second = tile.curves
    around = tile.reference + np.array([-0.5, 0.5])  # [K]
    rates = np.diff(np.log(second.slope(around) / first.slope(around)))
    temperatures = np.linspace(first.lowest, first.highest, reflection_ratio.TEMPERATURES)
    degrees = functions.rising.shape[1]
    freedom = [min(high - 1, degrees) - low + 1 - lost for low, high, lost in emissions.OCTAVES]
    edges, limits = residuals.blocks(tile.time.size)
    return Model(
        first=table(first),
        second=table(second),
        functions=np.ascontiguousarray(functions.functions.T),
        object_part=np.ascontiguousarray(functions.object_part.T),
        rising=np.ascontiguousarray(functions.rising.T),
        leverage=np.ascontiguousarray(functions.leverage().T),
        steps=functions.steps,
        noise=tile.noise,
        pattern=(0.0, 0.0) if tile.pattern is None else tile.pattern,
        drift=drift / np.sqrt(3.0),
        rate=float(rates[0]),
        gray=second.slope(temperatures) / first.slope(temperatures),
        widened=(stdtrit(np.maximum(freedom, 1), 0.975) / emissions.NORMAL95) ** 2,
        edges=edges,
        limits=limits,
        parts=pieces.blocks(tile.time.size),
        lowest=first.lowest,
        highest=first.highest,
    )


def solve(
    tile: Tile, functions: smooth.Subspace, drift: float, least: float = emissions.BEND
) -> Solution:
    """As `steps.solve`, of two bands."""
    shared, material = model(tile, functions, drift), tile.material
    frames, pixels = tile.signals.shape[1:]
    materials = np.full((pixels, 5), np.nan)
    if material is not None:
        numbers = (material.ratio[1], material.inverse_energy, material.emissivity)
        materials[:] = np.stack([*numbers, material.noise_variance, material.drift_variance], 1)
    films = np.empty((4, frames, pixels), np.float32)
    record, sums = np.zeros(pixels, RECORD), np.zeros((pixels, 2, shared.parts.size - 1))
    _pixels(shared, tile.signals, materials, least, films, record, sums)
    ratio = np.stack([np.ones(pixels), record["ratio"]])
    variance = reflection_ratio.ratio_variance(
        ratio, record["inverse_energy"], np.array(tile.noise)
    )
    variance[1] += record["level"] ** 2
    # The first, mixed and last element of a symmetric matrix (..., 3), as one (..., 2, 2, pixel).
    covariance, scatter, rapid = (
        np.moveaxis(record[name][..., [[0, 1], [1, 2]]], 0, -1)
        for name in ("covariance", "scatter", "rapid_scatter")
    )
    return Solution(
        *films,
        *(
            np.stack([record[f"object_{name}"], record[f"background_{name}"]])
            for name in ("missing", "lost", "beyond")
        ),
        ratio=ratio,
        ratio_variance=variance,
        null_weights=np.stack([record["first_weight"], record["second_weight"]]),
        order=record["order"].astype(np.intp),
        scatter=scatter,
        rapid_scatter=rapid,
        emissivity=np.stack([record["first_emissivity"], record["second_emissivity"]]),
        emissivity_covariance=covariance,
        epsilon_variance=record["epsilon"],
        unexplained=record["rough"],
        sums=sums.transpose(1, 2, 0),
        **{
            name: record[name].copy()
            for name in ("inverse_energy", "null_variance", "contrast", "reduced_chi2", "pooled")
            + ("noise_variance", "drift_variance", "constant", "restless", "gray")
            + ("correlation", "delay")
        },
    )
