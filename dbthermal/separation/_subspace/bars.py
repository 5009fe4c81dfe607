"""Variances of the outputs of one pixel of two bands (eq. 8, 10), and if its residual is noise.

Compiled; as in `emission` and `residuals`.
"""

from math import log, sqrt
from typing import Any, NamedTuple

import numpy as np

from dbthermal._arrays import Array
from dbthermal.separation._subspace import emission as emissions
from dbthermal.separation._subspace import kernels, regression, residuals
from dbthermal.separation._subspace.kernels import inlined
from dbthermal.separation._subspace.pixel import Line, Model, Ratio, Work, weights


class Bars(NamedTuple):
    """Numbers of `emission.Emission`, of one pixel; its curves are in the work space."""

    covariance: tuple[float, float, float]  # of the emissivities
    epsilon: float
    level: float
    noise_variance: float
    drift_variance: float
    restless: bool


@inlined
def _curve_variance(model: Model, kernel: Array, count: int, variance: float, work: Work) -> float:
    """Variance of a kernel's sum over the object's smoothed noise."""
    part = work.columns[:count]
    kernels.projected(model.object_part, model.spans, count, kernel, part)
    return float(variance * kernels.dot(part, part))


@inlined
def _walk(model: Model, curve_variance: float, count: int, work: Work) -> tuple[float, float]:
    """Variance of the slope by a background that walks, and its bound; `emission.walk_variance`."""
    degrees, kept, (spectrum, curve) = len(model.rising), work.spare, work.spectra
    share = kernels.mean(work.weights)
    for t in range(kept.size):
        kept[t] = work.residual[t] * work.weights[t] / share
    kernels.projected_both(model.rising, model.whole, kept, work.emitted, work.spectra)
    energy, product = kernels.dot(curve, curve), kernels.dot(curve, spectrum)
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


@inlined
def _linear(model: Model, ratios: Ratio, line: Line, limit: float, work: Work) -> float:
    """Variance of the slope by a linear drift, as `emission._linear_variance`."""
    drift, frames, count = model.rising[0], work.first.size, ratios.order + model.steps
    emitted, residual, weights, kernel = work.emitted, work.residual, work.weights, work.kernel
    slope, level, _ = regression.moments(emitted, drift, weights)
    size, length = 0.0, 0.0
    for t in range(frames):
        part = weights[t] * (drift[t] - level - slope * emitted[t])
        length += part * drift[t]
        size += part * residual[t]
    size /= length
    # Once more, with the weights of the residual less that drift.
    inverse, kept = 1.0 / (residuals.TUNING * line.scale), work.variance
    for t in range(frames):
        off = (residual[t] - size * (drift[t] - level - slope * emitted[t])) * inverse
        inside = max(1.0 - off * off, 0.0)
        kept[t] = inside * inside
    slope, level, _ = regression.moments(emitted, drift, kept)
    size, length = 0.0, 0.0
    for t in range(frames):
        kernel[t] = kept[t] * (drift[t] - level - slope * emitted[t])
        length += kernel[t] * drift[t]
        size += kernel[t] * residual[t]
    size /= length
    variance = model.noise[0] ** 2 * kernels.dot(kernel, kernel)
    curve = _curve_variance(model, kernel, count, ratios.null_variance, work)
    variance = (variance + line.emissivity[0] ** 2 * curve) / length**2
    before = max((limit / model.spread) ** 2, size**2 + variance)
    share = before / (before + variance)
    return float(slope**2 * share * (share * size**2 + variance))


@inlined
def _propagate(model: Model, ratios: Ratio, epsilon: float, first: float, work: Work) -> bool:
    """Variance of the object, and whether the background hardly rests; see `emission.estimate`."""
    count, null, noise = ratios.order + model.steps, ratios.null_variance, model.noise[0]
    # Of eq. 6 by implicit differentiation, and what the residual of a frame of rest holds.
    sensitivity, smooth_variance, curve = work.sensitivity, work.smooth_variance, work.rapid
    kernels.combined(model.object_part, model.spans, work.coefficients[0], count, curve)
    resting, more, leverage = 0.0, 1.0 + log(work.first.size) / count, model.leverage
    beside = 1.0 / (1.0 - emissions.NORMAL95**2 * epsilon) ** 2
    one, two = weights(ratios, first)
    inverse = 1.0 / two
    for t in range(work.first.size):
        flat = 1.0 / work.steepness[t]
        # The second band's signal before the last step, of the value of h; see `emission._newton`.
        other = (work.target[t] - work.lack[t] - one * work.emitted[t]) * inverse
        partial = other + first * (work.emitted[t] - other)
        sensitivity[t] = (partial - curve[t]) * flat
        smooth_variance[t] = leverage[ratios.order - 1, t] * null * flat**2
        square = sensitivity[t] ** 2 * epsilon
        expected = noise**2 + first**2 * (square + smooth_variance[t] * more)
        rests = work.residual[t] ** 2 < emissions.WITHIN**2 * expected
        resting += 1.0 if rests else 0.0
        work.variance[t] = square * beside + smooth_variance[t]
    return resting < emissions.RESTING * work.first.size


@inlined
def bars(model: Model, ratios: Ratio, line: Line, work: Work) -> Bars:
    """Variances of emissivities, object and background, as `emission.estimate`; in place."""
    z, emitted, weights, kernel = work.first, work.emitted, work.weights, work.kernel
    count, null, w = ratios.order + model.steps, ratios.null_variance, ratios.weights
    # Kernel of the slope, sum k z; its variance, of the ordinate's noise and the abscissa's.
    total, product, reflected = 0.0, 0.0, 0.0
    for t in range(z.size):
        total += weights[t]
        product += weights[t] * emitted[t]
        reflected += z[t] - emitted[t]
    for t in range(z.size):
        kernel[t] = weights[t] * (emitted[t] - product / total) / line.energy
    first = line.emissivity[0]
    noise_variance = line.variance
    noise_variance += first**2 * _curve_variance(model, kernel, count, null, work)
    walk, upper = _walk(model, first**2 * null, count, work)
    limit = (1.0 - first) * model.drift
    linear = _linear(model, ratios, line, limit, work)
    drift_variance = (limit / kernels.range_of(emitted)) ** 2 + max(upper, linear)
    if line.known:
        noise_variance, drift_variance = work.material[3], work.material[4]
    # Of the ratio, through the background's level; see `emission._level_std`.
    level = abs(reflected / z.size) * sqrt(noise_variance + walk) / (1.0 - first) ** 2
    widest = (model.highest - model.lowest) / sqrt(12.0)
    level = widest if np.isnan(level) else min(level, widest)
    level *= ratios.ratio * model.rate
    epsilon = ratios.inverse_energy * null + (w[1] * level) ** 2
    restless = _propagate(model, ratios, epsilon, first, work)
    _background(model, ratios, line, epsilon, noise_variance + drift_variance, work)
    covariance = _covariance(model, ratios, first, noise_variance + drift_variance, level)
    return Bars(covariance, epsilon, level, noise_variance, drift_variance, restless)


@inlined
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


@inlined
def _background(
    model: Model, ratios: Ratio, line: Line, epsilon: float, slope: float, work: Work
) -> None:
    """Variance of the background (eq. 10), and of both by a pattern, in place."""
    noise, pattern, w = model.noise, model.pattern, ratios.weights
    first, last = line.emissivity
    one, two = ((1.0 - first) / noise[0]) ** 2, ((1.0 - last) / noise[1]) ** 2
    precision = one + two
    one, two = one / precision, two / precision
    share = one * first / (1.0 - first) + two * last / (1.0 - last)
    # Through epsilon, (y - x) e_1 + r dx/deps; its covariance with v_1, w_1 s_1^2 sigma^2; and the
    # variance of s_1 v_1, (s_1^2 - 1 / |v|^2) sigma^2.
    covariance = 2.0 * noise[0] ** 2 * w[0] * ratios.inverse_energy
    of_first = noise[0] ** 2 - 1.0 / (1.0 / noise[0] ** 2 + (ratios.ratio / noise[1]) ** 2)
    steady = of_first * ratios.inverse_energy + slope / (1.0 - first) ** 2
    variance = work.background_variance
    for t in range(variance.size):
        curvature = one * work.back_slope[t] ** 2 + two * work.other_back_slope[t] ** 2
        contrast = work.background[t] - work.temperature[t]
        through = contrast * first + share * work.sensitivity[t]
        value = 1.0 / (precision * curvature) + share**2 * work.smooth_variance[t]
        value += through * (through * epsilon - contrast * covariance)
        variance[t] = value + contrast**2 * steady
    if pattern[0] > 0.0 or pattern[1] > 0.0:
        direct0, direct1 = one / (1.0 - first), two / (1.0 - last)
        kernels.blackbody(model.first, work.background, work.mean, work.spare)
        kernels.blackbody(model.first, work.temperature, work.mean, work.kernel)
        kernels.blackbody(model.second, work.temperature, work.mean, work.lack)
        for t in range(variance.size):
            slope0, slope1 = work.kernel[t], work.lack[t]
            steepness = w[0] * first * slope0 + w[1] * last * slope1
            through = direct0 * first * slope0 + direct1 * last * slope1
            a, b = w[0] / steepness, w[1] / steepness
            work.variance[t] += (pattern[0] * a) ** 2 + (pattern[1] * b) ** 2
            value = (pattern[0] * (direct0 - through * a)) ** 2
            value += (pattern[1] * (direct1 - through * b)) ** 2
            variance[t] += value / work.spare[t] ** 2


@inlined
def judge(model: Model, ratios: Ratio, work: Work, record: Any, sums: Array) -> None:
    """Is the null residual noise? And its sums over blocks, with those of the object's curve."""
    residual, rapid, coefficients = work.null_residual, work.rapid, work.coefficients
    count, w = ratios.order + model.steps, ratios.weights
    if model.stepless:  # the smooth curves of the object are those of the signals
        kernels.copy(work.target, residual)
    else:
        for j in range(count):
            work.columns[j] = w[0] * coefficients[0, j] + w[1] * coefficients[1, j]
        kernels.combined(model.functions, model.spans, coefficients[0], count, rapid)
        kernels.combined(model.functions, model.spans, work.columns, count, residual)
    for t in range(rapid.size):
        rapid[t] = work.first[t] - rapid[t]
        residual[t] = w[0] * work.first[t] + w[1] * work.straight[t] - residual[t]
    record.correlation, record.delay, record.unexplained = _unsteady(model, ratios, work)
    for block in range(model.parts.size - 1):
        one, other = 0.0, 0.0
        # Whole numbers without a sign: an index from the end need not be looked for.
        for t in range(np.uintp(model.parts[block]), np.uintp(model.parts[block + 1])):
            one += residual[t]
            other += work.target[t]
        sums[0, block], sums[1, block] = one, other


@inlined
def _unsteady(model: Model, ratios: Ratio, work: Work) -> tuple[float, float, bool]:
    """Autocorrelation, delay of the bands, and whether the residual is noise; see `residuals`."""
    residual, rapid, steep = work.null_residual, work.rapid, work.spare
    frames, null, noise = residual.size, ratios.null_variance, model.noise[0]
    energy = kernels.dot(residual, residual)
    lagged = 0.0
    for lag in range(1, residuals.LAGS + 1):
        lagged += kernels.dot(residual[lag:], residual[: frames - lag])
    correlation = lagged / (residuals.LAGS * energy) if energy > 0 else 0.0
    common = ratios.weights[0] * noise**2
    free = (frames - ratios.order - model.steps) * common
    # A matched filter with the differences between frames, of a band that is late or early.
    late, early, changes = free, -free, 0.0
    limit, steep[frames - 1] = residuals.CHANGE * sqrt(2.0) * noise, 0.0
    for t in range(frames - 1):
        change = rapid[t + 1] - rapid[t]
        late += residual[t] * change
        early += residual[t + 1] * change
        changes += change**2
        steep[t] = 1.0 if abs(change) > limit else 0.0
    score = max(abs(late), abs(early)) / sqrt(null * changes) if null * changes > 0 else 0.0
    # Energy in the frames at a change.
    count, at_changes = steep[0], steep[0] * residual[0] ** 2
    for t in range(1, frames):
        at = max(steep[t], steep[t - 1])
        count += at
        at_changes += at * residual[t] ** 2
    variance = 2.0 / (9.0 * max(count, 1.0))
    mean = at_changes / (null * count) if count > 0 else 1.0
    score = max(score, (mean ** (1.0 / 3.0) - (1.0 - variance)) / sqrt(variance))
    return (
        correlation * sqrt(residuals.LAGS * frames),
        score,
        _unexplained(model, ratios, work, common),
    )


@inlined
def _unexplained(model: Model, ratios: Ratio, work: Work, common: float) -> bool:
    """As `residuals.unexplained`."""
    blocks, residual, rapid = model.edges.size - 1, work.null_residual, work.rapid
    sums, together, share = work.sensitivity, 0.0, common / ratios.null_variance
    products, squares = work.kernel, work.mean
    for t in range(residual.size):
        independent = rapid[t] - share * residual[t]
        products[t] = residual[t] * independent
        squares[t] = independent**2
    for block in range(blocks):
        total, product, square = 0.0, 0.0, 0.0
        for t in range(np.uintp(model.edges[block]), np.uintp(model.edges[block + 1])):
            total += residual[t]
            product += products[t]
            square += squares[t]
        sums[block] = total
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
