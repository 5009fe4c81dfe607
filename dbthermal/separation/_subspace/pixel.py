"""Steps 1 to 4 of `method` for one pixel of two bands, compiled; the equations stand in `steps`."""

from math import erfc, log, sqrt
from typing import Final, NamedTuple

import numpy as np
from scipy.special import chdtri
from scipy.stats import chi2

from dbthermal import planck
from dbthermal._arrays import Array
from dbthermal.separation._subspace import emission as emissions
from dbthermal.separation._subspace import kernels, reflection_ratio, residuals
from dbthermal.separation._subspace.kernels import Table, compiled
from dbthermal.separation._subspace.shared import Model, Work

CHANCE: Final = float(chi2.isf(reflection_ratio.CHANCE, 1))
_GRAY_LIMIT: Final = float(chdtri(1, reflection_ratio.GRAY_CHANCE))
_TINY: Final = float(np.finfo(np.float64).tiny)


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
def _temperature(table: Table, signal: Array, result: Array, work: Work) -> None:
    """Temperature [K] of a blackbody with a signal (time) [K], in place; NaN where undefined."""
    x, value, slope, largest = work.spare, work.emitted, work.slope, 0.0
    for t in range(signal.size):
        x[t] = (signal[t] - table.middle_signal) / table.half_signal
        largest = max(largest, abs(x[t]))
    for t in range(signal.size):
        result[t] = kernels.polynomial(table.rough, x[t])
    for _ in range(2):  # Newton's steps
        kernels.blackbody(table, result, value, slope, work.place)
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


@compiled
def _ratios(model: Model, work: Work) -> Ratio:
    """Step 1 of the signals of both bands; their coefficients (2, column) in place."""
    noise, orders, steps = model.noise, model.leverage.shape[0], model.steps
    z, s, material = work.first, work.straight, work.material
    coefficients, scatter = work.coefficients, work.scatter
    columns, frames = model.functions.shape
    held = np.zeros(3)
    for j in range(columns):
        one, other = kernels.dot(model.functions[j], z), kernels.dot(model.functions[j], s)
        coefficients[0, j], coefficients[1, j] = one, other
    total = kernels.dot(z, z), kernels.dot(z, s), kernels.dot(s, s)
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
    if not np.isnan(known):
        order = _order(scatter, share, True, lowest, frames)
        a, b, d = scatter[order]
        turned = a * share[0] + b * share[1], b * share[0] + d * share[1]
        along = share[0] * turned[0] + share[1] * turned[1]
        statistic = (turned[0] ** 2 + turned[1] ** 2) / along - along
        pooled = statistic < CHANCE
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
    a: float, b: float, d: float, axis: tuple[float, float], known: float
) -> tuple[float, float]:
    """Energy along the axis of a scatter, the principal one or a known one, and across it."""
    if known:
        along = axis[0] ** 2 * a + 2.0 * axis[0] * axis[1] * b + axis[1] ** 2 * d
    else:
        along = 0.5 * (a + d) + sqrt(0.25 * (a - d) ** 2 + b * b)
    return along, a + d - along


@compiled
def _order(
    scatter: Array, axis: tuple[float, float], known: float, lowest: int, frames: int
) -> int:
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
def may_be_gray(model: Model, ratios: Ratio) -> bool:
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


@compiled
def _newton(model: Model, ratios: Ratio, emissivity: float, work: Work) -> None:
    """One step of `emission._newton`, in place; h' and the partial derivative in the work space."""
    emitted, other, slope, other_slope = (
        work.emitted,
        work.other_emitted,
        work.slope,
        work.second_slope,
    )
    steepness, partial = work.steepness, work.partial
    target, temperature = work.target, work.temperature
    kernels.blackbody(model.first, temperature, emitted, slope, work.place)
    kernels.blackbody(model.second, temperature, other, other_slope, work.place)
    one = ratios.weights[0] * emissivity
    two = ratios.weights[1] * (1.0 - ratios.ratio * (1.0 - emissivity))
    for t in range(target.size):
        steepness[t] = one * slope[t] + two * other_slope[t]
        partial[t] = other[t] + emissivity * (emitted[t] - other[t])
        temperature[t] += (target[t] - one * emitted[t] - two * other[t]) / steepness[t]


@compiled
def _curve_variance(model: Model, kernel: Array, count: int, variance: float) -> float:
    """Variance of a kernel's sum over the object's smoothed noise."""
    total: float = 0.0
    for j in range(count):
        total += kernels.dot(model.object_part[j], kernel) ** 2
    return variance * float(total)


@compiled
def _walk(model: Model, curve_variance: float, count: int, work: Work) -> tuple[float, float]:
    """Variance of the slope by a background that walks, and its bound; `emission.walk_variance`."""
    degrees, frames = model.rising.shape
    residual, weights, emitted = work.residual, work.weights, work.emitted
    spectrum, curve = np.empty(degrees), np.empty(degrees)
    share = weights.mean()
    energy, product = 0.0, 0.0
    for j in range(degrees):
        total = 0.0
        for t in range(frames):
            total += model.rising[j, t] * residual[t] * weights[t]
        spectrum[j], curve[j] = total / share, kernels.dot(model.rising[j], emitted)
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
    model: Model, ratios: Ratio, emissivity: float, scale: float, limit: float, work: Work
) -> float:
    """Variance of the slope by a linear drift, as `emission._linear_variance`."""
    drift, frames, count = model.rising[0], work.first.size, ratios.order + model.steps
    emitted, residual, weights = work.emitted, work.residual, work.weights
    kernel, again = work.kernel, work.spare
    kept, slope, size = weights, 0.0, 0.0
    for last in range(2):
        slope, level, _ = kernels.moments(emitted, drift, kept)
        length, size = 0.0, 0.0
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
    variance = model.noise[0] ** 2 * kernels.dot(kernel, kernel)
    variance += emissivity**2 * _curve_variance(model, kernel, count, ratios.null_variance)
    spread = drift.max() - drift.min()
    before = max((limit / spread) ** 2, size**2 + variance)
    share = before / (before + variance)
    return float(slope**2 * share * (share * size**2 + variance))


@compiled
def _propagate(model: Model, ratios: Ratio, epsilon: float, first: float, work: Work) -> bool:
    """Variance of the object, and whether the background hardly rests; see `emission.estimate`."""
    count, null, noise = ratios.order + model.steps, ratios.null_variance, model.noise[0]
    # Of eq. 6 by implicit differentiation, and what the residual of a frame of rest holds.
    sensitivity, smooth_variance = work.sensitivity, work.smooth_variance
    kernels.combined(model.object_part, work.coefficients[0], count, sensitivity)
    resting, more = 0, 1.0 + log(work.first.size) / count
    beside = (1.0 - emissions.NORMAL95**2 * epsilon) ** 2
    for t in range(work.first.size):
        sensitivity[t] = (work.partial[t] - sensitivity[t]) / work.steepness[t]
        smooth_variance[t] = model.leverage[ratios.order - 1, t] * null / work.steepness[t] ** 2
        square = sensitivity[t] ** 2 * epsilon
        expected = noise**2 + first**2 * (square + smooth_variance[t] * more)
        resting += work.residual[t] ** 2 < emissions.WITHIN**2 * expected
        work.variance[t] = square / beside + smooth_variance[t]
    return resting < emissions.RESTING * work.first.size


@compiled
def _emission(model: Model, ratios: Ratio, work: Work) -> Emission:
    """Steps 2 and 3, as `emission.estimate`; the rows that it leaves are named in `_pixel`."""
    z, coefficients, material = work.first, work.coefficients, work.material
    emitted, target = work.emitted, work.target
    temperature, weights, residual = work.temperature, work.weights, work.residual
    kernel, spare, place, few = work.kernel, work.spare, work.place, work.few
    frames, noise, count = z.size, model.noise[0], ratios.order + model.steps
    w, null = ratios.weights, ratios.null_variance
    combined = w[0] * coefficients[0] + w[1] * coefficients[1]
    kernels.combined(model.object_part, combined, count, target)
    _temperature(model.second, target, temperature, work)
    largest = max(1.0, ratios.ratio)
    middle = 0.5 * (1.0 + (largest - 1.0) / largest)
    kernels.blackbody(model.first, temperature, emitted, spare, place)
    weights[:] = 1.0
    guess = kernels.moments(emitted, z, weights)[0]
    emissivity = guess if 0 < guess < 1 else middle
    _newton(model, ratios, emissivity, work)
    known = ratios.pooled and not np.isnan(material[2])
    constant = False
    slope, variance, scale, energy = 0.0, 0.0, 0.0, 0.0
    for turn in range(emissions.ROUNDS):
        kernels.blackbody(model.first, temperature, emitted, spare, place)
        slope, variance, scale, energy = kernels.regress(
            emitted, z, noise, weights, residual, few, turn > 0
        )
        constant = energy < emissions.OBJECT_TO_NOISE * count * null and not known
        emissivity = material[2] if known else middle if constant else slope
        _newton(model, ratios, emissivity, work)
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
    walk, upper = _walk(model, first**2 * null, count, work)
    limit = (1.0 - first) * model.drift
    linear = _linear(model, ratios, first, scale, limit, work)
    drift_variance = (limit / (high - low)) ** 2 + max(upper, linear)
    if known:
        noise_variance, drift_variance = material[3], material[4]
    level = abs(reflected / frames) * sqrt(noise_variance + walk) / (1.0 - first) ** 2
    widest = (model.highest - model.lowest) / sqrt(12.0)
    level = widest if np.isnan(level) else min(level, widest)
    level *= ratios.ratio * model.rate
    by_level = w[1] * level
    epsilon = ratios.inverse_energy * null + by_level**2
    restless = _propagate(model, ratios, epsilon, first, work)
    return Emission(
        (first, 1.0 - ratios.ratio * (1.0 - first)),
        _covariance(model, ratios, first, noise_variance + drift_variance, level),
        epsilon,
        level,
        noise_variance,
        drift_variance,
        constant,
        restless,
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
def _background(model: Model, ratios: Ratio, emission: Emission, work: Work) -> None:
    """Step 4, as `emission.estimate_background` and `pattern_variances`, in place."""
    z, other = work.first, work.second
    emitted, second, slope, second_slope = (
        work.emitted,
        work.other_emitted,
        work.slope,
        work.second_slope,
    )
    temperature, background, mean, x = work.temperature, work.background, work.mean, work.place
    of_object, variance = work.variance, work.background_variance
    noise, pattern, w = model.noise, model.pattern, ratios.weights
    (first, last), epsilon = emission.emissivity, emission.epsilon
    one, two = ((1.0 - first) / noise[0]) ** 2, ((1.0 - last) / noise[1]) ** 2
    precision = one + two
    one, two = one / precision, two / precision
    kernels.blackbody(model.first, temperature, emitted, slope, x)
    kernels.blackbody(model.second, temperature, second, second_slope, x)
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
    kernels.blackbody(model.first, background, emitted, slope, x)
    kernels.blackbody(model.second, background, second, second_slope, x)
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
        kernels.blackbody(model.first, background, emitted, slope, x)
    for t in range(z.size):
        variance[t] = reflected[t] + variance[t] / slope[t] ** 2


@compiled
def solve(model: Model, work: Work) -> tuple[Ratio, Emission]:
    """Steps 1 to 4, and the bend of the reflections (eq. 11) in the work space."""
    ratios = _ratios(model, work)
    emission = _emission(model, ratios, work)
    _background(model, ratios, emission, work)
    first, last = emission.emissivity
    bend, finite = work.bend, 0.0
    kernels.blackbody(model.first, work.background, work.emitted, work.slope, work.place)
    kernels.blackbody(model.second, work.background, work.other_emitted, work.slope, work.place)
    for t in range(bend.size):
        bend[t] = (1.0 - last) * (work.other_emitted[t] - work.emitted[t])
        finite += bend[t] * 0.0
    if not (0 < first < 1 and 0 < last < 1 and finite == 0):
        bend[:] = 0.0
    return ratios, emission
