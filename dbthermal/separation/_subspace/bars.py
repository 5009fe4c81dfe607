"""Variances of the outputs of one pixel of two bands (eq. 8, 10), compiled; as in `emission`."""

from math import log, sqrt
from typing import NamedTuple

import numpy as np

from dbthermal._arrays import Array
from dbthermal.separation._subspace import emission as emissions
from dbthermal.separation._subspace import kernels, regression
from dbthermal.separation._subspace.kernels import inlined
from dbthermal.separation._subspace.pixel import Line, Ratio, weights
from dbthermal.separation._subspace.shared import Model, Work


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
    emitted, residual, weights = work.emitted, work.residual, work.weights
    kernel, again = work.kernel, work.spare
    kept, slope, size, length = weights, 0.0, 0.0, 0.0
    slope, level, _ = regression.moments(emitted, drift, kept)
    for last in range(2):
        length, size = 0.0, 0.0
        for t in range(frames):
            kernel[t] = kept[t] * (drift[t] - level - slope * emitted[t])
            length += kernel[t] * drift[t]
            size += kernel[t] * residual[t]
        size /= length
        if last == 0:
            for t in range(frames):
                again[t] = residual[t] - size * (drift[t] - level - slope * emitted[t])
            kept = work.variance
            slope, level, _ = regression.reweighted(emitted, drift, again, line.scale, kept)
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
