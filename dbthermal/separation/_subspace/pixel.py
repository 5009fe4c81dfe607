"""Steps 1 to 4 of `method` for one pixel, of any number of bands, compiled; bars are in `bars`."""

from math import erfc, exp, sqrt
from typing import Any, Final, NamedTuple

import numpy as np

from dbthermal._arrays import Array
from dbthermal.separation._frames import newton, null_weights
from dbthermal.separation._subspace import kernels, reflection_ratio, regression
from dbthermal.separation._subspace.kernels import compiled, inlined
from dbthermal.separation._tiles import Whole

ROUNDS: Final = 3
# Change of the slope with the emissivity that it starts from, below which it is extrapolated to
# where both are the same (Aitken): the bands' responses differ far from the reference temperature.
FASTEST: Final = 0.8
# Energy of the object's change over that of its noise, below which its emissivity is undefined.
OBJECT_TO_NOISE: Final = 10.0
# Energy of the bend between the two responses, in units of the second band's noise, from which it
# is worth taking out: it moves no linear function of the signal by more standard deviations.
BEND: Final = 0.2
# Times that it is taken out at most: it changes with the background that it is computed of.
BENDS: Final = 2


class Model(NamedTuple):
    """All that the pixels of a tile share; columns of functions lie along time."""

    tables: Array  # responses, see `kernels.response` (band, number)
    functions: Array  # (column, time), of `smooth.Subspace`
    object_part: Array  # (column, time)
    spans: Whole  # first frames of these functions, and the ends (column, 2)
    rising: Array  # (degree, time)
    whole: Whole  # first frames of the rising functions, and the ends (degree, 2)
    spread: float  # range of the first rising function
    leverage: Array  # (order, time)
    steps: int
    stepless: bool  # no function has a step of the camera: both are the same
    drift: float  # limit of the background's, over the square root of three [K]
    rates: Array  # change of the ratios of the responses' slopes with the background (band) [1/K]
    gray: Array  # ratios of the slopes at temperatures of the background (temperature, band) [1]
    chances: tuple[float, float]  # limits of chi-squares: of a material's ratios, of a gray body
    widened: Array  # of the octaves' variances, at the end of their 95 % interval [1]
    edges: Whole  # of the blocks of a residual
    limits: tuple[float, float]  # of its chi-square statistics
    parts: Whole  # of the means by which pieces are asked for
    lowest: float  # calibrated temperatures [K]
    highest: float


class Work(NamedTuple):
    """Signals and curves (time) of one pixel, and blocks of pixels that are read and written."""

    first: Array  # signal of the first band [K]
    target: Array  # null combination of the bands, smoothed (eq. 5)
    temperature: Array  # of the object [K]
    emitted: Array  # signal of the object at the last regression
    steepness: Array  # h'(x) before the last step towards the object
    lack: Array  # q - h(x) there [K]
    weights: Array  # of the regression
    residual: Array
    kernel: Array
    spare: Array
    mean: Array  # signal of the background
    background: Array  # [K]
    curvature: Array  # of the sum of eq. 9 by the background
    sensitivity: Array  # derivative of the object's temperature with epsilon [K]
    smooth_variance: Array  # of the object, from the smoothed noise [K^2]
    variance: Array  # of the object, and of the background [K^2]
    background_variance: Array
    null_residual: Array
    rapid: Array
    signals: Array  # (band, time) [K], as all that follow
    straight: Array  # less the bend of the reflections
    at_object: Array  # signals of the object
    reflected: Array  # signals of the background in each band
    bend: Array  # of the reflections (eq. 11), and as it was taken out
    removed: Array
    few: Any  # in single precision (6, time)
    coefficients: Array  # of the signals on the functions (band, column)
    columns: Array  # (column)
    spectra: Array  # (2, degree)
    scatter: Array  # whitened, outside the functions of each order (eq. 3) (order, band, band)
    turned: Array  # (band, band), to find principal axes, and what turns it
    turns: Array
    axis: Array  # (band), along the rapid changes of the whitened signals, as all that follow
    material_axis: Array  # the same of the material
    ratio: Array  # reflection ratios [1]
    null_weights: Array  # w of eq. 5
    emissivity: Array
    factors: Array  # w_m e_m of eq. 6
    share: Array  # of the bands in the background
    level: Array  # deviation of the ratios by the background's level
    noise: Array  # standard deviation of the signals [K]
    pattern: Array  # residual fixed pattern [K]
    material: Array  # inverse energy, emissivity, its two variances, spread, ratios; NaN for none
    inside: Array  # signals of some pixels [K] (pixel, band, time)
    outside: Any  # their films, in single precision (pixel, 4, time)


class Line(NamedTuple):
    """Robust line of step 3 (eq. 7)."""

    variance: float  # of the slope
    scale: float  # of the residual [K]
    energy: float  # of the object's curve [K^2]
    known: bool  # the emissivity is the material's


@compiled
def ratios(model: Model, work: Work, record: Any) -> None:
    r"""Step 1; coefficients, ratios and null combination in place, and how well they are known.

    With S the background's energy in the first band, n = N - K degrees of freedom, and
    :math:`|v|^2 = \sum \kappa_m^2 / s_m^2`, the variance of the ratios is that of eq. 4 with
    :math:`\sigma^2 = 1 / S + n / (S^2 |v|^2)` (Fuller 1987, doi:10.1002/9780470316665). The first
    term alone is the Cramer-Rao bound; see `limits.bounds`.
    """
    noise, material, ratio, axis = work.noise, work.material, work.ratio, work.axis
    bands, orders, frames = noise.size, len(work.scatter), work.first.size
    scatter(model, work)
    pooled, along = not np.isnan(material[6]), work.material_axis
    # A material's ratios are used unless the pixel's rapid changes contradict them by 4 sigma.
    if pooled:
        length = 0.0
        for m in range(bands):
            along[m] = material[5 + m] / noise[m]
            length += along[m] ** 2
        for m in range(bands):
            along[m] /= sqrt(length)
        pooled = _agrees(work.scatter[_order(work, pooled, frames)], along, model.chances[0])
    order = _order(work, pooled, frames)
    free, chosen = frames - model.steps - (order + 1.0), work.scatter[order]
    null = _across(chosen, work, pooled)
    largest = kernels.principal(chosen, work.turned, work.turns, axis)
    # Eq. 4: sigma^2 of the energy along the axis less the noise's, over |v|^2.
    ratio[0], length = 1.0, 0.0
    for m in range(1, bands):
        ratio[m] = axis[m] * noise[m] / (axis[0] * noise[0])
    for m in range(bands):
        length += (ratio[m] / noise[m]) ** 2
    energy = (largest - free) / length
    inverse = (energy + free / length) / energy**2 if energy > 0 else np.inf
    if pooled:
        # The mean of the posterior, of the material's ratio for a prior with its spread.
        spread = material[4]
        blend = spread / (spread + inverse) if spread > 0 else 0.0
        for m in range(1, bands):
            ratio[m] = material[5 + m] + (
                blend * (ratio[m] - material[5 + m]) if blend > 0 else 0.0
            )
        inverse = (1.0 - blend) * (spread + (1.0 - blend) * material[0])
    variance = null_weights(ratio, noise, work.null_weights)
    matrix = work.scatter[orders - 1]
    least, trace = _across(matrix, work, pooled), 0.0
    for m in range(bands):
        trace += matrix[m, m]
    record.inverse_energy, record.null_variance = inverse, variance
    record.order, record.pooled = order + 1, pooled
    record.contrast = (trace - least) * (bands - 1.0) / least if least > 0 else np.inf
    record.reduced_chi2 = null / ((bands - 1.0) * free)


@inlined
def scatter(model: Model, work: Work) -> None:
    """Scatter of the whitened signals outside the functions of each order (eq. 3)."""
    straight, coefficients = work.straight, work.coefficients
    bands, frames = work.noise.size, work.first.size
    for m in range(0, bands - 1, 2):
        first, second = straight[m, :frames], straight[m + 1, :frames]
        kernels.projected_both(model.functions, model.spans, first, second, coefficients[m : m + 2])
    if bands % 2:
        band, count = bands - 1, len(model.functions)
        kernels.projected(
            model.functions, model.spans, count, straight[band, :frames], coefficients[band]
        )
    # The basis is orthonormal: |P z|^2 = |z|^2 - sum of squared coefficients.
    for m in range(bands):
        for n in range(m + 1):
            product = kernels.dot(straight[m, :frames], straight[n, :frames])
            first, second = coefficients[m], coefficients[n]
            scale = 1.0 / (work.noise[m] * work.noise[n])
            for j in range(model.steps):
                product -= first[j] * second[j]
            for order in range(len(work.scatter)):
                product -= first[model.steps + order] * second[model.steps + order]
                work.scatter[order, m, n] = work.scatter[order, n, m] = product * scale


@inlined
def _agrees(scatter: Array, axis: Array, limit: float) -> bool:
    """As `reflection_ratio.agrees`."""
    along, square = 0.0, 0.0
    for m in range(axis.size):
        turned = kernels.dot(scatter[m], axis)
        along += axis[m] * turned
        square += turned**2
    return square / along - along < limit


@inlined
def _across(scatter: Array, work: Work, pooled: float) -> float:
    """Energy of a scatter across its principal axis, or across the material's."""
    trace, along, axis = 0.0, 0.0, work.material_axis
    if pooled:
        for m in range(axis.size):
            along += axis[m] * kernels.dot(scatter[m], axis)
    else:
        along = kernels.principal(scatter, work.turned, work.turns, work.axis)
    for m in range(axis.size):
        trace += scatter[m, m]
    return trace - along


@inlined
def _order(work: Work, pooled: float, frames: int) -> int:
    """Order less one: that of the lowest information criterion, plus one."""
    scatter = work.scatter
    lowest = min(reflection_ratio.LOWEST_ORDER, len(scatter) - 1) - 1
    # N ln E + K ln N is least where E N^(K / N) is.
    # Of the energy across the axis (Schwarz 1978, doi:10.1214/aos/1176344136).
    best, least, price, step = lowest, np.inf, 1.0, frames ** (1.0 / frames)
    for order in range(lowest, len(scatter) - 1):
        criterion = price * max(_across(scatter[order], work, pooled), reflection_ratio.TINY)
        price *= step
        if criterion < least:
            best, least = order, criterion
    # Plus one: a part of the object's curve too small to be significant still biases the ratio to
    # first order, while one function more costs little variance.
    return best + 1 if len(scatter) > 1 else 0


@inlined
def may_be_gray(model: Model, record: Any, work: Work) -> bool:
    r"""Say whether equal emissivities are not excluded by the signals as they are.

    All that changes in a gray body changes the bands in proportion to the slopes of their
    responses, :math:`\dot z_m = (1 - e) \, u_m'(y) \, \dot y`: before a background warmer than
    the reference its ratios are not 1. That temperature cannot be told beside a gray body; it is as
    likely to lie between any two of some temperatures. The chance is the mean over them of that of
    the chi-square, with a degree of freedom for each band but one, of the nearest ratios between.
    """
    noise, ratio, bands, length = work.noise, work.ratio, work.noise.size, 0.0
    for m in range(bands):
        length += (ratio[m] / noise[m]) ** 2
    nearest, chance, off, before = np.inf, 0.0, work.turned[0], work.turned[1]
    for i in range(len(model.gray)):
        # The part of g / s orthogonal to v; its variance is sigma^2.
        product, step, square, turned = 0.0, 0.0, 0.0, 0.0
        for m in range(bands):
            product += model.gray[i, m] * ratio[m] / noise[m] ** 2 / length
        for m in range(bands):
            before[m] = off[m]
            off[m] = (model.gray[i, m] - product * ratio[m]) / noise[m]
            step += (off[m] - before[m]) ** 2
            turned -= before[m] * (off[m] - before[m])
        if i > 0:
            share = min(max(turned / max(step, reflection_ratio.TINY), 0.0), 1.0)
            for m in range(bands):
                square += (before[m] + share * (off[m] - before[m])) ** 2
            statistic = square / record.inverse_energy
            nearest = min(nearest, statistic)
            chance += _chance(statistic, bands - 1) / (len(model.gray) - 1.0)
    return nearest < model.chances[1] and chance > reflection_ratio.GRAY_CHANCE


@inlined
def _chance(statistic: float, freedom: int) -> float:
    """Chance of a larger chi-square, as a sum of terms that add two degrees of freedom each."""
    half, odd = 0.5 * statistic, freedom % 2
    chance, power = erfc(sqrt(half)) if odd else exp(-half), 0.5 if odd else 1.0
    term = exp(-half) * (2.0 * sqrt(half / np.pi) if odd else half)
    while 2.0 * power < freedom:
        chance, power = chance + term, power + 1.0
        term *= half / power
    return chance


@inlined
def _mixed(model: Model, work: Work, emissivity: float) -> tuple[float, ...]:
    """Polynomial of h (eq. 6); the weights w_m e_m in place."""
    factors, tables = work.factors, model.tables
    for m in range(factors.size):
        factors[m] = work.null_weights[m] * (1.0 - work.ratio[m] * (1.0 - emissivity))
    first, second = kernels.response(tables, 0), kernels.response(tables, 1)
    mixed = kernels.mixed(factors[0], first.signal, factors[1], second.signal)
    for m in range(2, factors.size):
        mixed = kernels.mixed(1.0, mixed, factors[m], kernels.response(tables, m).signal)
    return mixed


@inlined
def _approach(model: Model, emissivity: float, work: Work, emitted: Array) -> None:
    """A step of Newton towards h(x) = q (eq. 6); h' and q - h before it, u_1 after, in place."""
    first, now, after = kernels.response(model.tables, 0), work.temperature, work.spare
    target, middle, scale, outside = work.target, first.middle, 1.0 / first.half, 0.0
    mixed = _mixed(model, work, emissivity)
    for t in range(now.size):
        x = (now[t] - middle) * scale
        y, work.lack[t], slope = newton(mixed, target[t], x)
        outside += 0.0 if (abs(x) <= 1.0) & (abs(y) <= 1.0) else 1.0
        work.steepness[t] = slope * scale
        after[t] = middle + first.half * y
        emitted[t] = kernels.polynomial(first.signal, y)
    if outside > 0.0:
        for t in range(now.size):
            if not max(abs(now[t] - middle), abs(after[t] - middle)) <= first.half:
                value, slope = 0.0, 0.0
                for m in range(work.factors.size):
                    u, a = kernels.exact(kernels.response(model.tables, m), now[t])
                    value += work.factors[m] * u
                    slope += work.factors[m] * a
                work.lack[t], work.steepness[t] = target[t] - value, slope
                after[t] = now[t] + work.lack[t] / work.steepness[t]
                emitted[t] = kernels.exact(first, after[t])[0]
    kernels.copy(after, now)


@inlined
def combined(weights: Array, coefficients: Array, count: int, columns: Array) -> None:
    """Sum of the bands' coefficients (band, column), weighted, in place."""
    kernels.fill(columns[:count], 0.0)
    for m in range(weights.size):
        for j in range(count):
            columns[j] += weights[m] * coefficients[m, j]


@compiled
def emission(model: Model, record: Any, work: Work, rounds: int) -> Line:
    """Steps 2 and 3 in turns: the object (eq. 5, 6) and the emissivities (eq. 7), in place."""
    z, weights, temperature = work.first, work.weights, work.temperature
    count, material, largest = record.order + model.steps, work.material, 1.0
    combined(work.null_weights, work.coefficients, count, work.columns)
    kernels.combined(model.object_part, model.spans, work.columns, count, work.target)
    kernels.temperature(kernels.response(model.tables, 1), work.target, temperature)
    # Middle of the interval that the ratios leave for e_1, for a constant object.
    for m in range(1, work.ratio.size):
        largest = max(largest, work.ratio[m])
    middle = 0.5 * (1.0 + (largest - 1.0) / largest)
    middle = material[1] if record.pooled and not np.isnan(material[1]) else middle
    # The robust line is sought on a curve that is right to second order, or it locks elsewhere.
    first = kernels.response(model.tables, 0)
    kernels.blackbody(first, temperature, work.emitted, work.spare)
    kernels.fill(work.lack, 1.0)
    guess = regression.moments(work.emitted, z, work.lack)[0]
    fixed, constant = record.pooled and not np.isnan(material[1] + material[2]), False
    emissivity = guess if 0 < guess < 1 and not fixed else middle
    slope, variance, scale, energy = 0.0, 0.0, 0.0, 0.0
    before, slope_before, is_started = np.nan, np.nan, rounds > 0
    for turn in range(ROUNDS):
        _approach(model, emissivity, work, work.emitted)
        if fixed and turn < ROUNDS - 1:  # the line is for its residual alone
            continue
        slope, variance, scale, energy = regression.regress(
            work.emitted, z, work.noise[0], weights, work.residual, work.few, is_started
        )
        is_started = True
        constant = energy < OBJECT_TO_NOISE * count * record.null_variance and not fixed
        rate = (slope - slope_before) / (emissivity - before)
        before, slope_before = emissivity, slope
        emissivity = material[1] if fixed else middle if constant else slope
        if abs(rate) < FASTEST and not fixed and not constant:
            emissivity += (slope - before) * rate / (1.0 - rate)
    _approach(model, emissivity, work, work.at_object[0, : z.size])
    for m in range(work.ratio.size):
        work.emissivity[m] = 1.0 - work.ratio[m] * (1.0 - emissivity)
    record.constant = constant
    return Line(variance, scale, energy, fixed)


@compiled
def background(model: Model, work: Work) -> None:
    """Step 4 (eq. 9), in place."""
    tables, emissivity, share, frames = model.tables, work.emissivity, work.share, work.first.size
    mean, result, step, curvature = work.mean, work.background, work.spare, work.curvature
    first, total, outside = kernels.response(tables, 0), 0.0, 0.0
    for m in range(share.size):
        share[m] = ((1.0 - emissivity[m]) / work.noise[m]) ** 2
        total += share[m]
    kernels.fill(mean, 0.0)
    for m in range(share.size):
        share[m] /= total
        e, weight, inverse = emissivity[m], share[m], 1.0 / (1.0 - emissivity[m])
        z, emitted = work.signals[m, :frames], work.at_object[m, :frames]
        reflected = work.reflected[m, :frames]
        if m > 0:
            table = kernels.response(tables, m)
            kernels.blackbody(table, work.temperature, emitted, work.spare)
        for t in range(frames):
            reflected[t] = (z[t] - e * emitted[t]) * inverse
            mean[t] += weight * reflected[t]
    # From the temperature of the mean signal, one Gauss-Newton step on the exact responses.
    kernels.temperature(first, mean, result)
    kernels.fill(step, 0.0)
    kernels.fill(curvature, 0.0)
    middle, half, scale = first.middle, first.half, 1.0 / first.half
    for m in range(share.size):
        signal, weight = kernels.response(tables, m).signal, share[m]
        reflected = work.reflected[m, :frames]
        for t in range(frames):
            u, a = kernels.with_slope(signal, (result[t] - middle) * scale)
            step[t] += weight * a * (reflected[t] - u)
            curvature[t] += weight * a * a
    for t in range(frames):
        x = (result[t] - middle) * scale
        y = x + step[t] / curvature[t]
        outside += 0.0 if (abs(x) <= 1.0) & (abs(y) <= 1.0) else 1.0
        mean[t], curvature[t] = middle + half * y, curvature[t] * scale**2
    if outside > 0.0:
        _outside(model, work)
    kernels.copy(mean, result)
    _bend(model, work, outside)


@inlined
def _bend(model: Model, work: Work, outside: float) -> None:
    r"""Part of the reflections that the responses bend apart (eq. 11), in place.

    :math:`(1 - e_m) \, (u_m(y) - u_1(y))`: taken from band m, it leaves the same signal
    :math:`u_1(y)` reflected in all, so that the reflection ratios are one number for small and
    large changes of the background. Zero where a background or an emissivity is not physical.
    """
    first, result, frames = kernels.response(model.tables, 0), work.background, work.first.size
    physical, scale = 0.0 < work.emissivity[0] < 1.0, 1.0 / first.half
    for m in range(1, work.emissivity.size):
        bend, factor = work.bend[m, :frames], 1.0 - work.emissivity[m]
        second = kernels.response(model.tables, m)
        difference = kernels.mixed(1.0, second.signal, -1.0, first.signal)
        for t in range(frames):
            bend[t] = factor * kernels.polynomial(difference, (result[t] - first.middle) * scale)
        for t in range(frames if outside > 0.0 else 0):
            if not abs(result[t] - first.middle) <= first.half:
                exact = kernels.exact(second, result[t])[0] - kernels.exact(first, result[t])[0]
                bend[t] = factor * exact
        physical &= 0.0 < work.emissivity[m] < 1.0 and kernels.mean(bend) * 0.0 == 0.0
    for m in range(1, work.emissivity.size if not physical else 1):
        kernels.fill(work.bend[m, :frames], 0.0)


@inlined
def _outside(model: Model, work: Work) -> None:
    """As `background`, of the frames where the polynomials do not hold."""
    tables, result, mean = model.tables, work.background, work.mean
    first = kernels.response(tables, 0)
    for t in range(mean.size):
        off = max(abs(result[t] - first.middle), abs(mean[t] - first.middle))
        if not off <= first.half:
            step, curvature = 0.0, 0.0
            for m in range(work.share.size):
                u, a = kernels.exact(kernels.response(tables, m), result[t])
                step += work.share[m] * a * (work.reflected[m, t] - u)
                curvature += work.share[m] * a * a
            mean[t], work.curvature[t] = result[t] + step / curvature, curvature
