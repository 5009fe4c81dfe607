"""Steps 1 to 4 of `method` for one pixel of two bands, compiled; their bars are in `bars`."""

from math import erfc, sqrt
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.special import chdtri

from dbthermal._arrays import Array
from dbthermal.separation._subspace import emission as emissions
from dbthermal.separation._subspace import kernels, reflection_ratio, regression
from dbthermal.separation._subspace.kernels import inlined
from dbthermal.separation._tiles import Whole

CHANCE: Final = float(chdtri(1, reflection_ratio.CHANCE))
_GRAY_LIMIT: Final = float(chdtri(1, reflection_ratio.GRAY_CHANCE))
_TINY: Final = float(np.finfo(np.float64).tiny)


class Model(NamedTuple):
    """All that the pixels of a tile share; columns of functions lie along time."""

    first: kernels.Table
    second: kernels.Table
    functions: Array  # (column, time), of `smooth.Subspace`
    object_part: Array  # (column, time)
    spans: Whole  # first frames of these functions, and the ends (column, 2)
    rising: Array  # (degree, time)
    whole: Whole  # of these (degree, 2)
    spread: float  # of the first of these
    leverage: Array  # (order, time)
    steps: int
    stepless: bool  # no function has a step of the camera: both are the same
    noise: tuple[float, float]  # [K]
    pattern: tuple[float, float]  # [K]
    drift: float  # limit of the background's, over the square root of three [K]
    rate: float  # change of the ratio of the responses' slopes with the background [1/K]
    gray: Array  # ratios of the slopes at temperatures of the background [1]
    widened: Array  # of the octaves' variances, at the end of their 95 % interval [1]
    edges: Whole  # of the blocks of a residual
    limits: tuple[float, float]  # of its chi-square statistics
    parts: Whole  # of the means by which pieces are asked for
    lowest: float  # calibrated temperatures [K]
    highest: float


class Work(NamedTuple):
    """Signals and curves (time) of one pixel, and of some as they are read and written."""

    first: Array  # signals [K]
    second: Array
    straight: Array  # the second less the bend of the reflections
    target: Array  # null combination of the bands, smoothed (eq. 5)
    temperature: Array  # of the object [K]
    emitted: Array  # signal of the object at the last regression
    steepness: Array  # h'(x) before the last step towards the object
    lack: Array  # q - h(x) there [K]
    weights: Array  # of the regression
    residual: Array
    kernel: Array
    spare: Array
    at_object: Array  # signals of the object
    other_at_object: Array
    mean: Array  # signal of the background
    background: Array  # [K]
    back_slope: Array
    other_back_slope: Array
    bend: Array  # of the reflections (eq. 11), and as it was taken out
    removed: Array
    sensitivity: Array  # see `emission.Emission`
    smooth_variance: Array
    variance: Array  # of the object, and of the background [K^2]
    background_variance: Array
    null_residual: Array
    rapid: Array
    few: Any  # in single precision (6, time)
    coefficients: Array  # of the signals on the functions (2, column)
    columns: Array  # (column)
    spectra: Array  # (2, degree)
    scatter: Array  # see `reflection_ratio`, first, mixed and last element (order, 3)
    material: Array  # ratio, inverse energy, emissivity, its two variances, spread; NaN for none
    inside: Array  # signals of some pixels [K] (pixel, 2, time)
    outside: Any  # their films, in single precision (pixel, 4, time)


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


class Line(NamedTuple):
    """Robust line of step 3 (eq. 7), and the emissivities that follow from it."""

    emissivity: tuple[float, float]
    variance: float  # of the slope
    scale: float  # of the residual [K]
    energy: float  # of the object's curve [K^2]
    constant: bool
    known: bool  # the emissivity is the material's


@inlined
def ratios(model: Model, work: Work) -> Ratio:
    """Step 1; coefficients (2, column) in place."""
    curves = work.first, work.straight
    kernels.projected_both(model.functions, model.spans, curves[0], curves[1], work.coefficients)
    _scatter(model, work)
    noise, scatter, material = model.noise, work.scatter, work.material
    orders, frames = len(scatter), work.first.size
    known = material[0] / noise[1] * noise[0]
    share = 1.0 / sqrt(1.0 + known**2), known / sqrt(1.0 + known**2)
    pooled = False
    if not np.isnan(known):
        a, b, d = scatter[_order(scatter, share, True, frames)]
        turned = a * share[0] + b * share[1], b * share[0] + d * share[1]
        along = share[0] * turned[0] + share[1] * turned[1]
        statistic = (turned[0] ** 2 + turned[1] ** 2) / along - along
        pooled = statistic < CHANCE
    order = _order(scatter, share, pooled, frames)
    free = frames - model.steps - (order + 1.0)
    a, b, d = scatter[order]
    largest, null = _energies(a, b, d, share, False)
    # The axis by the longer of two expressions.
    across, up = (largest - d, b) if a >= d else (b, largest - a)
    ratio = up / across * (noise[1] / noise[0])
    # Eq. 4: sigma^2 of the energy along the axis less the noise's, over |v|^2.
    length = 1.0 / noise[0] ** 2 + (ratio / noise[1]) ** 2
    energy = (largest - free) / length
    inverse = (energy + free / length) / energy**2 if energy > 0 else np.inf
    if pooled:
        null = _energies(a, b, d, share, True)[1]
        # The mean of the posterior, of the material's ratio for a prior with its spread.
        own = material[5] / (material[5] + inverse) if material[5] > 0 else 0.0
        ratio = material[0] + own * (ratio - material[0]) if own > 0 else material[0]
        inverse = (1.0 - own) * (material[5] + (1.0 - own) * material[1])
    last = scatter[orders - 1]
    most, least = _energies(last[0], last[1], last[2], share, pooled)
    weights, variance = _null_combination(ratio, noise)
    return Ratio(
        ratio,
        inverse,
        weights,
        variance,
        order + 1,
        most / least if least > 0 else np.inf,
        null / free,
        (a - free, b, d - free),
        pooled,
    )


@inlined
def _scatter(model: Model, work: Work) -> None:
    """Scatter (order, 3) of the whitened signals outside the functions of each order (eq. 3)."""
    z, s, coefficients, steps = work.first, work.straight, work.coefficients, model.steps
    a, b, d = kernels.dot(z, z), kernels.dot(z, s), kernels.dot(s, s)
    one, two = 1.0 / model.noise[0], 1.0 / model.noise[1]
    # The basis is orthonormal: |P z|^2 = |z|^2 - sum of squared coefficients.
    for j in range(coefficients.shape[1]):
        a -= coefficients[0, j] ** 2
        b -= coefficients[0, j] * coefficients[1, j]
        d -= coefficients[1, j] ** 2
        if j >= steps:
            scatter = work.scatter[j - steps]
            scatter[0], scatter[1], scatter[2] = a * one * one, b * one * two, d * two * two


@inlined
def _null_combination(
    ratio: float, noise: tuple[float, float]
) -> tuple[tuple[float, float], float]:
    """Weights w of eq. 5 and the variance of that combination, as `null_combination`."""
    along0, along1, one, two = 1.0 / noise[0], ratio / noise[1], 1.0 / noise[0], 1.0 / noise[1]
    part = (along0 * one + along1 * two) / (along0**2 + along1**2)
    off0, off1 = one - part * along0, two - part * along1
    variance = 1.0 / (off0**2 + off1**2)
    return (off0 * variance * one, off1 * variance * two), variance


@inlined
def _energies(
    a: float, b: float, d: float, axis: tuple[float, float], known: float
) -> tuple[float, float]:
    """Energy along the axis of a scatter, the principal one or a known one, and across it."""
    if known:
        along = axis[0] ** 2 * a + 2.0 * axis[0] * axis[1] * b + axis[1] ** 2 * d
    else:
        along = 0.5 * (a + d) + sqrt(0.25 * (a - d) ** 2 + b * b)
    return along, a + d - along


@inlined
def _order(scatter: Array, axis: tuple[float, float], known: float, frames: int) -> int:
    """Order less one of the lowest information criterion, see `reflection_ratio.choose_order`."""
    lowest = min(reflection_ratio.LOWEST_ORDER, len(scatter) - 1) - 1
    # N ln E + K ln N is least where E N^(K / N) is.
    best, least, price, step = lowest, np.inf, 1.0, frames ** (1.0 / frames)
    for order in range(lowest, scatter.shape[0] - 1):
        a, b, d = scatter[order]
        criterion = price * max(_energies(a, b, d, axis, known)[1], _TINY)
        price *= step
        if criterion < least:
            best, least = order, criterion
    return best + 1 if scatter.shape[0] > 1 else 0


@inlined
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


@inlined
def weights(ratios: Ratio, emissivity: float) -> tuple[float, float]:
    """Weights w_m e_m of the bands' signals in h (eq. 6)."""
    last = 1.0 - ratios.ratio * (1.0 - emissivity)
    return ratios.weights[0] * emissivity, ratios.weights[1] * last


@inlined
def _approach(model: Model, ratios: Ratio, emissivity: float, work: Work, emitted: Array) -> None:
    """A step of Newton towards h(x) = q (eq. 6); h' and q - h before it, u_1 after, in place."""
    first, second, now, after = model.first, model.second, work.temperature, work.spare
    target, middle, scale, outside = work.target, first.middle, 1.0 / first.half, 0.0
    one, two = weights(ratios, emissivity)
    mixed = kernels.mixed(one, first.signal, two, second.signal)
    for t in range(now.size):
        x = (now[t] - middle) * scale
        value, slope = kernels.with_slope(mixed, x)
        y = x + (target[t] - value) / slope
        outside += 0.0 if (abs(x) <= 1.0) & (abs(y) <= 1.0) else 1.0
        work.lack[t], work.steepness[t] = target[t] - value, slope * scale
        after[t] = middle + first.half * y
        emitted[t] = kernels.polynomial(first.signal, y)
    if outside > 0.0:
        for t in range(now.size):
            if not max(abs(now[t] - middle), abs(after[t] - middle)) <= first.half:
                a, slope = kernels.exact(first, now[t])
                b, other_slope = kernels.exact(second, now[t])
                work.lack[t] = target[t] - one * a - two * b
                work.steepness[t] = one * slope + two * other_slope
                after[t] = now[t] + work.lack[t] / work.steepness[t]
                emitted[t] = kernels.exact(first, after[t])[0]
    kernels.copy(after, now)


@inlined
def emission(model: Model, ratios: Ratio, work: Work, again: int) -> Line:
    """Steps 2 and 3 in turns: the object (eq. 5, 6) and the first emissivity (eq. 7), in place."""
    z, weights, temperature = work.first, work.weights, work.temperature
    count, w, material = ratios.order + model.steps, ratios.weights, work.material
    for j in range(count):
        work.columns[j] = w[0] * work.coefficients[0, j] + w[1] * work.coefficients[1, j]
    kernels.combined(model.object_part, model.spans, work.columns, count, work.target)
    kernels.temperature(model.second, work.target, temperature)
    largest = max(1.0, ratios.ratio)
    middle = 0.5 * (1.0 + (largest - 1.0) / largest)
    middle = material[2] if ratios.pooled and not np.isnan(material[2]) else middle
    # The robust line is sought on a curve that is right to second order, or it locks elsewhere.
    kernels.blackbody(model.first, temperature, work.emitted, work.spare)
    kernels.fill(work.lack, 1.0)
    guess = regression.moments(work.emitted, z, work.lack)[0]
    emissivity = guess if 0 < guess < 1 else middle
    known = ratios.pooled and not np.isnan(material[2] + material[3])
    constant = False
    slope, variance, scale, energy = 0.0, 0.0, 0.0, 0.0
    before, slope_before = np.nan, np.nan
    for turn in range(emissions.ROUNDS):
        _approach(model, ratios, emissivity, work, work.emitted)
        slope, variance, scale, energy = regression.regress(
            work.emitted, z, model.noise[0], weights, work.residual, work.few, again + turn > 0
        )
        constant = energy < emissions.OBJECT_TO_NOISE * count * ratios.null_variance and not known
        rate = (slope - slope_before) / (emissivity - before)
        before, slope_before = emissivity, slope
        emissivity = material[2] if known else middle if constant else slope
        if abs(rate) < emissions.FASTEST and not known and not constant:
            emissivity += (slope - before) * rate / (1.0 - rate)
    _approach(model, ratios, emissivity, work, work.at_object)
    other = 1.0 - ratios.ratio * (1.0 - emissivity)
    return Line((emissivity, other), variance, scale, energy, constant, known)


@inlined
def background(model: Model, line: Line, work: Work) -> None:
    """Step 4 (eq. 9), and the bend of the reflections (eq. 11), in place."""
    z, other, mean, result, bend = work.first, work.second, work.mean, work.background, work.bend
    first, last = line.emissivity
    one, two = ((1.0 - first) / model.noise[0]) ** 2, ((1.0 - last) / model.noise[1]) ** 2
    one, two = one / (one + two), two / (one + two)
    inverse, other_inverse, reflected = 1.0 / (1.0 - first), 1.0 / (1.0 - last), work.spare
    kernels.blackbody(model.second, work.temperature, work.other_at_object, reflected)
    for t in range(z.size):
        reflected[t] = (z[t] - first * work.at_object[t]) * inverse
        bend[t] = (other[t] - last * work.other_at_object[t]) * other_inverse
        mean[t] = one * reflected[t] + two * bend[t]
    # From the temperature of the mean signal, one Gauss-Newton step on the exact responses.
    kernels.temperature(model.first, mean, result)
    middle, half, scale, outside = model.first.middle, model.first.half, 1.0 / model.first.half, 0.0
    apart = kernels.mixed(1.0, model.second.signal, -1.0, model.first.signal)
    for t in range(z.size):
        x = (result[t] - middle) * scale
        u, a = kernels.with_slope(model.first.signal, x)
        v, b = kernels.with_slope(model.second.signal, x)
        step = one * a * (reflected[t] - u) + two * b * (bend[t] - v)
        y = x + step / (one * a**2 + two * b**2)
        outside += 0.0 if (abs(x) <= 1.0) & (abs(y) <= 1.0) else 1.0
        work.back_slope[t], work.other_back_slope[t] = a * scale, b * scale
        mean[t] = middle + half * y
        bend[t] = (1.0 - last) * kernels.polynomial(apart, y)
    if outside > 0.0:
        for t in range(z.size):
            if not max(abs(result[t] - middle), abs(mean[t] - middle)) <= half:
                u, a = kernels.exact(model.first, result[t])
                v, b = kernels.exact(model.second, result[t])
                other_reflected = (other[t] - last * work.other_at_object[t]) * other_inverse
                step = one * a * (reflected[t] - u) + two * b * (other_reflected - v)
                work.back_slope[t], work.other_back_slope[t] = a, b
                mean[t] = result[t] + step / (one * a**2 + two * b**2)
                apart_exactly = kernels.exact(model.second, mean[t])[0]
                apart_exactly -= kernels.exact(model.first, mean[t])[0]
                bend[t] = (1.0 - last) * apart_exactly
    kernels.copy(mean, result)
    finite = kernels.mean(bend) * 0.0
    if not (0 < first < 1 and 0 < last < 1 and finite == 0):
        kernels.fill(bend, 0.0)
