"""Variances of the outputs of one pixel (eq. 8, 10), and if its residual is noise; compiled."""

from functools import lru_cache
from math import log, sqrt
from typing import Any, Final

import numpy as np
from scipy.special import chdtri, ndtri

from dbthermal._arrays import Array
from dbthermal.separation._subspace import kernels, regression
from dbthermal.separation._subspace.kernels import compiled, inlined
from dbthermal.separation._subspace.pixel import Line, Model, Work, combined
from dbthermal.separation._subspace.reflection_ratio import CHANCE
from dbthermal.separation._tiles import SPANS, Whole

# The background counts as resting within so many standard deviations, in that share of frames.
WITHIN: Final = 3.0
RESTING: Final = 0.3
# Degrees of the polynomials over which a spectrum is averaged: from, and up to, not including;
# and degrees of freedom lost: of the first three, one is along the object's curve.
OCTAVES: Final = ((1, 4, 1), (4, 8, 0))
NORMAL95: Final = float(ndtri(0.975))  # bound of a 95 % interval of the normal distribution
LAGS: Final = 5  # frames over which a residual's mean autocorrelation is taken
CHANGE: Final = 5.0  # deviations of noise from which a difference between frames is a change
# Largest residual, in deviations, by which spans of time tell an emissivity's error: by 4.685, 5.3
# and 6, emissivities of 24 materials in simulated worlds are 1.2, 1.0 and .8 stated deviations off.
FARTHEST: Final = 5.3
_BLOCK: Final = 9  # frames of the shortest blocks of a residual


@lru_cache(maxsize=16)
def blocks(frames: int) -> tuple[Whole, tuple[float, float]]:
    """Edges of the blocks of a residual, and limits of both statistics by which it is noise."""
    number = 2 ** int(np.log2(frames / _BLOCK))
    edges = np.round(np.linspace(0, frames, number + 1)).astype(np.intp)
    return edges, (float(chdtri(number, CHANCE)), float(chdtri(1.0, CHANCE / (2 * number))))


@inlined
def _curve_variance(model: Model, kernel: Array, count: int, variance: float, work: Work) -> float:
    """Variance of a kernel's sum over the object's smoothed noise."""
    projection = work.columns[:count]
    kernels.projected(model.object_part, model.spans, count, kernel, projection)
    return float(variance * kernels.dot(projection, projection))


@inlined
def _walk(model: Model, curve_variance: float, count: int, work: Work) -> tuple[float, float]:
    r"""Variance [1] of the slope by a background that walks, and its upper bound.

    With the unit coefficients :math:`\xi_j` of the object's curve of norm :math:`|u|`, and the
    energy A of a random walk in the residual's spectrum, the larger of those of two octaves; for
    the bound, at the upper end of their 95 % interval,
    :math:`\mathrm{var}(e_1) = A / |u|^2 \sum_j \xi_j^2 / j^2`.
    """
    degrees, residual, (spectrum, curve) = len(model.rising), work.spare, work.spectra
    share = kernels.mean(work.weights)
    for t in range(residual.size):
        residual[t] = work.residual[t] * work.weights[t] / share
    kernels.projected_both(model.rising, model.whole, residual, work.emitted, work.spectra)
    energy, product = kernels.dot(curve, curve), kernels.dot(curve, spectrum)
    scale, expected, upper = 0.0, 0.0, 0.0
    for j in range(degrees):
        scale += curve[j] ** 2 / (j + 1.0) ** 2
        spectrum[j] -= curve[j] * product / energy
    for octave in range(len(OCTAVES)):
        low, high, lost = OCTAVES[octave]
        walk, end = 0.0, min(high - 1, degrees)
        for j in range(low - 1, end):
            noise = work.noise[0] ** 2 / share + (curve_variance if j + 1 < count else 0.0)
            walk += (j + 1.0) ** 2 * (spectrum[j] ** 2 - noise)
        freedom = end - (low - 1) - lost
        if freedom > 0:
            expected = max(expected, walk / freedom)
            upper = max(upper, walk / freedom * model.widened[octave])
    return scale / energy**2 * expected, scale / energy**2 * upper


@inlined
def _linear(model: Model, record: Any, line: Line, limit: float, work: Work) -> float:
    r"""Variance [1] of the slope by a linear drift of size d, seen with a variance v.

    :math:`\gamma^2 k (k d^2 + v)`, k = D / (D + v), with D of the `limit` [K] or of what is seen.
    Weighted twice, for a large drift takes the weight from the frames that tell it best.
    """
    drift, frames, count = model.rising[0], work.first.size, record.order + model.steps
    emitted, residual, weights, kernel = work.emitted, work.residual, work.weights, work.kernel
    inverse, factors = 1.0 / (regression.TUNING * line.scale), work.variance
    kernels.copy(weights, factors)
    slope, level, size, length = 0.0, 0.0, 0.0, 1.0
    for turn in range(2):
        # Once more with the weights of the residual less that drift.
        for t in range(frames if turn > 0 else 0):
            error = residual[t] - size * (drift[t] - level - slope * emitted[t])
            factors[t] = regression.bisquare(error * inverse)
        slope, level, _ = regression.moments(emitted, drift, factors)
        size, length = 0.0, 0.0
        for t in range(frames):
            kernel[t] = factors[t] * (drift[t] - level - slope * emitted[t])
            length += kernel[t] * drift[t]
            size += kernel[t] * residual[t]
        size /= length
    variance = work.noise[0] ** 2 * kernels.dot(kernel, kernel)
    curve = _curve_variance(model, kernel, count, record.null_variance, work)
    variance = (variance + work.emissivity[0] ** 2 * curve) / length**2
    before = max((limit / model.spread) ** 2, size**2 + variance)
    share = before / (before + variance)
    return float(slope**2 * share * (share * size**2 + variance))


@inlined
def _propagate(model: Model, record: Any, epsilon: float, work: Work) -> bool:
    r"""Variance of the object, in place, and whether the background hardly rests.

    By implicit differentiation of eq. 6, :math:`dx/d\epsilon = (dh/d\epsilon - dq/d\epsilon) / h'`
    and :math:`var(x) = var(q) / h'^2`. The object is a ratio with an uncertain denominator: half
    the width of its 95 % interval by Fieller's theorem (1954),
    doi:10.1111/j.2517-6161.1954.tb00159.x
    """
    count, null, noise = record.order + model.steps, record.null_variance, work.noise[0]
    sensitivity, smooth_variance, curve = work.sensitivity, work.smooth_variance, work.rapid
    first, frames, total, factors = work.emissivity[0], work.first.size, 0.0, work.factors
    kernels.combined(model.object_part, model.spans, work.coefficients[0], count, curve)
    # The error moves weight from the other bands to the first, by their share in its variance.
    for m in range(1, factors.size):
        error = work.noise[m] ** 2 + (work.ratio[m] * noise) ** 2
        factors[m] = work.null_weights[m] ** 2 * error
        total += factors[m]
    emitted = work.at_object[0, :frames]
    for t in range(frames):
        sensitivity[t] = first * emitted[t] - curve[t]
    for m in range(1, factors.size):
        factor, emitted = (1.0 - first) * factors[m] / total, work.at_object[m, :frames]
        for t in range(frames):
            sensitivity[t] += factor * emitted[t]
    # What the criterion for the order leaves of the object's curve is as large as the noise that
    # one more function would have cost, log N times. The residual of a frame of rest holds both.
    resting, factor, leverage = 0.0, 1.0 + log(frames) / count, model.leverage[record.order - 1]
    widening = 1.0 / (1.0 - NORMAL95**2 * epsilon) ** 2
    for t in range(frames):
        flat = 1.0 / work.steepness[t]
        sensitivity[t] *= flat
        smooth_variance[t] = leverage[t] * null * flat**2
        square = sensitivity[t] ** 2 * epsilon
        expected = noise**2 + first**2 * (square + smooth_variance[t] * factor)
        resting += 1.0 if work.residual[t] ** 2 < WITHIN**2 * expected else 0.0
        work.variance[t] = square * widening + smooth_variance[t]
    return resting < RESTING * frames


@compiled
def bars(model: Model, record: Any, line: Line, work: Work, covariance: Any) -> None:
    """Variances of emissivities, object and background, in place."""
    z, emitted, weights, kernel = work.first, work.emitted, work.weights, work.kernel
    count, null, w = record.order + model.steps, record.null_variance, work.null_weights
    # Kernel of the slope, sum k z; its variance, of the ordinate's noise and the abscissa's.
    total, product, reflected = 0.0, 0.0, 0.0
    for t in range(z.size):
        total += weights[t]
        product += weights[t] * emitted[t]
        reflected += z[t] - emitted[t]
    first, noise_variance, drift_variance = work.emissivity[0], work.material[2], work.material[3]
    walk, upper = _walk(model, first**2 * null, count, work)
    if not line.known:
        # Frames that the line leaves out, beside reflections, show how much of them it still holds.
        inverse = 1.0 / (FARTHEST * line.scale)
        for t in range(z.size):
            centred = (emitted[t] - product / total) / line.energy
            kernel[t] = weights[t] * centred
            factor = regression.bisquare(work.residual[t] * inverse)
            record.influence[t * SPANS // z.size] += factor * centred * work.residual[t]
        noise_variance = line.variance
        noise_variance += first**2 * _curve_variance(model, kernel, count, null, work)
        limit = (1.0 - first) * model.drift
        linear = _linear(model, record, line, limit, work)
        drift_variance = (limit / kernels.range_of(emitted)) ** 2 + max(upper, linear)
    # Rapid changes have the ratios k_m u_m'(y) / u_1'(y), and y is known as well as e_1, in the
    # mean over time, dy = (u_1(y) - u_1(x)) de_1 / (1 - e_1); or as any temperature calibrated.
    level = abs(reflected / z.size) * sqrt(noise_variance + walk) / (1.0 - first) ** 2
    widest = (model.highest - model.lowest) / sqrt(12.0)
    level, by_level = widest if np.isnan(level) else min(level, widest), 0.0
    for m in range(w.size):
        work.level[m] = level * work.ratio[m] * model.rates[m]
        by_level += w[m] * work.level[m]
    epsilon = record.inverse_energy * null + by_level**2
    record.restless = _propagate(model, record, epsilon, work)
    _background(model, record, epsilon, noise_variance + drift_variance, work)
    _covariance(record, noise_variance + drift_variance, work, covariance)
    record.epsilon_variance = epsilon
    record.noise_variance, record.drift_variance = noise_variance, drift_variance


@inlined
def _covariance(record: Any, slope_variance: float, work: Work, covariance: Any) -> None:
    r"""Covariance of the emissivities (eq. 8), from the ratios and the slope, in place.

    :math:`\delta e_1 = -e_1 (1 - e_1) \epsilon + \delta o` and
    :math:`\delta e_m = \kappa_m \delta e_1 - (1 - e_1) \delta \kappa_m`, with
    :math:`\epsilon = \sum w_m \delta \kappa_m`.
    """
    k, change, error, bands = work.ratio, work.turned, work.turns, work.ratio.size
    first, square = work.emissivity[0], work.noise[0] ** 2
    for m, n in np.ndindex(bands, bands):
        same = 1.0 if m == n else 0.0
        change[m, n] = (1.0 - first) * (first * k[m] * work.null_weights[n] + same)
        # Of the ratios (eq. 4), and through the background's level; the first one is 1.
        error[m, n] = record.inverse_energy * (k[m] * k[n] * square + same * work.noise[m] ** 2)
        error[m, n] += work.level[m] * work.level[n]
    for m, n in np.ndindex(bands, bands):
        covariance[m, n] = k[m] * k[n] * slope_variance
        for i in range(1, bands):
            for j in range(1, bands):
                covariance[m, n] += change[m, i] * error[i, j] * change[n, j]


@inlined
def _background(model: Model, record: Any, epsilon: float, slope: float, work: Work) -> None:
    r"""Variance of the background (eq. 10), in place.

    .. math:: \delta y = (y - x) \left( s_1 \delta v_1 - e_1 \epsilon
              + \frac{\delta o}{1 - e_1} \right) - r \, \delta x

    where r is the weighted mean of :math:`e_m / (1 - e_m)` and :math:`v = \kappa / s`.
    """
    noise, share, variance = work.noise, work.share, work.background_variance
    first, total, object_share, length = work.emissivity[0], 0.0, 0.0, 0.0
    for m in range(noise.size):
        total += ((1.0 - work.emissivity[m]) / noise[m]) ** 2
        object_share += share[m] * work.emissivity[m] / (1.0 - work.emissivity[m])
        length += (work.ratio[m] / noise[m]) ** 2
    # Through epsilon, (y - x) e_1 + r dx/deps; its covariance with v_1, w_1 s_1^2 sigma^2; and the
    # variance of s_1 v_1, (s_1^2 - 1 / |v|^2) sigma^2.
    covariance = 2.0 * noise[0] ** 2 * work.null_weights[0] * record.inverse_energy
    steady = (noise[0] ** 2 - 1.0 / length) * record.inverse_energy + slope / (1.0 - first) ** 2
    for t in range(variance.size):
        contrast = work.background[t] - work.temperature[t]
        through = contrast * first + object_share * work.sensitivity[t]
        value = 1.0 / (total * work.curvature[t]) + object_share**2 * work.smooth_variance[t]
        value += through * (through * epsilon - contrast * covariance)
        variance[t] = value + contrast**2 * steady
    patterned = 0.0
    for m in range(noise.size):
        patterned += work.pattern[m]
    if patterned > 0.0:
        _pattern(model, work)


@inlined
def _pattern(model: Model, work: Work) -> None:
    r"""Variance of object and background by a residual fixed pattern, added in place.

    An offset :math:`\delta_m` of each band, constant in time, is no slope and no rapid change: the
    emissivities are free of it. With the shares g of the bands in the background,

    .. math:: \delta x = \frac{1}{h'} \sum w_m \delta_m, \quad
              u' \delta y = \sum g_m \frac{\delta_m - e_m u_m' \delta x}{1 - e_m}
    """
    steepness, through, slope = work.kernel, work.lack, work.spare
    kernels.fill(steepness, 0.0)
    kernels.fill(through, 0.0)
    for m in range(work.share.size):
        table, e = kernels.response(model.tables, m), work.emissivity[m]
        kernels.blackbody(table, work.temperature, work.mean, slope)
        direct = work.share[m] * e / (1.0 - e)
        for t in range(slope.size):
            steepness[t] += work.null_weights[m] * e * slope[t]
            through[t] += direct * slope[t]
    kernels.blackbody(kernels.response(model.tables, 0), work.background, work.mean, slope)
    for m in range(work.share.size):
        direct, square = work.share[m] / (1.0 - work.emissivity[m]), work.pattern[m] ** 2
        for t in range(slope.size):
            share = work.null_weights[m] / steepness[t]
            work.variance[t] += square * share**2
            off = (direct - through[t] * share) / slope[t]
            work.background_variance[t] += square * off**2


@compiled
def judge(model: Model, work: Work, record: Any, sums: Array) -> None:
    """Judge if the null residual is noise; sums of it and of the object's curve over blocks."""
    residual, rapid, coefficients = work.null_residual, work.rapid, work.coefficients
    count, w, frames = record.order + model.steps, work.null_weights, work.first.size
    if model.stepless:  # object and signals have the same smooth functions
        kernels.copy(work.target, residual)
    else:
        combined(w, coefficients, count, work.columns)
        kernels.combined(model.functions, model.spans, coefficients[0], count, rapid)
        kernels.combined(model.functions, model.spans, work.columns, count, residual)
    for t in range(frames):
        rapid[t], residual[t] = work.first[t] - rapid[t], -residual[t]
    for m in range(w.size):
        weight, signal = w[m], work.straight[m, :frames]
        for t in range(frames):
            residual[t] += weight * signal[t]
    record.correlation, record.delay, record.unexplained = _unsteady(model, record, work)
    for block in range(model.parts.size - 1):
        residual_sum, curve_sum = 0.0, 0.0
        # Whole numbers without a sign: an index from the end need not be looked for.
        for t in range(np.uintp(model.parts[block]), np.uintp(model.parts[block + 1])):
            residual_sum += residual[t]
            curve_sum += work.target[t]
        sums[0, block], sums[1, block] = residual_sum, curve_sum


@inlined
def _unsteady(model: Model, record: Any, work: Work) -> tuple[float, float, bool]:
    r"""Autocorrelation, delay of the bands, and whether the residual is noise.

    A band that is a frame late or early leaves the difference between two frames in the null
    residual r. A matched filter shows it,
    :math:`\sum_t r(t) \, (z_1(t \pm 1) - z_1(t)) + n \, w_1 s_1^2`, whose last term takes out that
    r holds the noise of :math:`z_1(t)`.
    """
    residual, rapid, steep = work.null_residual, work.rapid, work.spare
    frames, null, noise = residual.size, record.null_variance, work.noise[0]
    energy = kernels.dot(residual, residual)
    lagged = 0.0
    for lag in range(1, LAGS + 1):
        lagged += kernels.dot(residual[lag:], residual[: frames - lag])
    correlation = lagged / (LAGS * energy) if energy > 0 else 0.0
    common = work.null_weights[0] * noise**2
    free = (frames - record.order - model.steps) * common
    # A matched filter with the differences between frames, of a band that is late or early.
    late, early, changes = free, -free, 0.0
    limit, steep[frames - 1] = CHANGE * sqrt(2.0) * noise, 0.0
    for t in range(frames - 1):
        change = rapid[t + 1] - rapid[t]
        late += residual[t] * change
        early += residual[t + 1] * change
        changes += change**2
        steep[t] = 1.0 if abs(change) > limit else 0.0
    score = max(abs(late), abs(early)) / sqrt(null * changes) if null * changes > 0 else 0.0
    # Energy in the frames at a change.
    # It shows a delay that changes sign, as after an interpolation between frames.
    count, at_changes = steep[0], steep[0] * residual[0] ** 2
    for t in range(1, frames):
        at = max(steep[t], steep[t - 1])
        count += at
        at_changes += at * residual[t] ** 2
    # The cube root of a chi-square of few degrees of freedom is nearly normal (Wilson, Hilferty
    # 1931, doi:10.1073/pnas.17.12.684).
    variance = 2.0 / (9.0 * max(count, 1.0))
    mean = at_changes / (null * count) if count > 0 else 1.0
    score = max(score, (mean ** (1.0 / 3.0) - (1.0 - variance)) / sqrt(variance))
    return correlation * sqrt(LAGS * frames), score, _unexplained(model, record, work, common)


@inlined
def _unexplained(model: Model, record: Any, work: Work, common: float) -> bool:
    r"""Say whether the null residual r [K] is no white noise in some part of time.

    Its sum over some block, of those of repeated halving, is beyond that of noise: a change of the
    object that the smooth functions do not follow. Or blocks differ in its correlation with the
    rapid changes, which have not one ratio: :math:`\sum_b (\sum_t r h)^2 / \sigma^2 \sum_t h^2`,
    with :math:`h = z_1 - r \, w_1 s_1^2 / \sigma^2` of independent noise, is a chi-square variable.
    """
    blocks, residual, rapid = model.edges.size - 1, work.null_residual, work.rapid
    sums, statistic, share = work.sensitivity, 0.0, common / record.null_variance
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
        statistic += product**2 / square if square > 0 else 0.0
    if statistic / record.null_variance > model.limits[0]:
        return True
    edges, step = model.edges, 1
    while blocks > 1:
        for block in range(blocks):
            length = edges[(block + 1) * step] - edges[block * step]
            if sums[block] ** 2 > model.limits[1] * record.null_variance * length:
                return True
        blocks //= 2
        step *= 2
        for block in range(blocks):
            sums[block] = sums[2 * block] + sums[2 * block + 1]
    return False
