r"""Object temperature and emissivities of one tile, given the reflection ratios.

Steps 2 and 3 of `method`, whose numbers of equations are used here. The error of the ratios enters
the object through one number, the error :math:`\epsilon` of :math:`w \cdot \kappa`, of variance
:math:`\sigma^2` times the null variance, and that of `_level_std`.

The emissivity is the slope of the first band's signal against the object's own (eq. 7). A part of
the background that changes as the object does, :math:`y = \ldots + c \, u_1(x)`, changes the slope
by :math:`(1 - e_1) c`, and nothing in the data tells the two apart. So its size is assumed, in two
ways that add:

- a drift: over the capture, the background's change along the object's curve lies anywhere within
  a limit that the user states;
- an extrapolation: the part of the resting background's change that is *not* along the object's
  curve is seen. Its spectrum over the smooth functions is continued to the curve, as that of a
  random walk, whose energy falls with the square of the degree; or as a line in time, where one
  beside the object's curve changes the slope by more.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import ndtri, stdtrit

from dbthermal import _smooth as smooth
from dbthermal import mixing
from dbthermal._arrays import like, namespace
from dbthermal.separation._subspace import residuals
from dbthermal.separation._subspace.reflection_ratio import ReflectionRatio
from dbthermal.separation._tiles import Array, Mask, Tile, Whole

ROUNDS: Final = 3
# Change of the slope with the emissivity that it starts from, below which it is extrapolated to
# where both are the same (Aitken): the bands' responses differ far from the reference temperature.
FASTEST: Final = 0.8
# Energy of the object's change over that of its noise, below which its emissivity is undefined.
OBJECT_TO_NOISE: Final = 10.0
# The background counts as resting within so many standard deviations, in that share of frames.
WITHIN: Final = 3.0
RESTING: Final = 0.3
# Degrees of the polynomials over which a spectrum is averaged: from, and up to, not including;
# and degrees of freedom lost: of the first three, one is along the object's curve.
OCTAVES: Final = ((1, 4, 1), (4, 8, 0))
# Energy of the bend between the two responses, in units of the second band's noise, from which it
# is worth taking out: it moves no linear function of the signal by more standard deviations.
BEND: Final = 0.2
# Times that it is taken out at most: it changes with the background that it is computed of.
BENDS: Final = 2
# Bound of a 95 % interval of the normal distribution.
NORMAL95: Final = float(ndtri(0.975))


@dataclass(frozen=True)
class Emission:
    """Object and emissivities, with the derivatives that carry their uncertainty."""

    temperature: Array  # of the object (time, pixel) [K]
    temperature_std: Array  # its standard deviation (time, pixel) [K]
    sensitivity: Array  # its derivative with epsilon (time, pixel) [K]
    smooth_variance: Array  # its variance from the smoothed noise (time, pixel) [K^2]
    emissivity: Array  # (band, pixel) [1]
    emissivity_covariance: Array  # (band, band, pixel) [1]
    epsilon_variance: Array  # of epsilon (pixel) [1]
    level_std: Array  # of the ratios, through the background's level (band, pixel) [1]
    noise_variance: Array  # of e_1, from the regression's noise (pixel) [1]
    drift_variance: Array  # of e_1, from the background's slow part (pixel) [1]
    constant: Mask  # the object changes too little for its emissivity (pixel)
    restless: Mask  # the background hardly rests (pixel)
    line: residuals.Line  # the last regression


def estimate(
    tile: Tile,
    functions: smooth.Subspace,
    ratios: ReflectionRatio,
    background_drift: float,
    start: residuals.Line | None = None,
) -> Emission:
    """
    Object temperature and emissivities, steps 2 and 3 of `method`, with their uncertainty.

    The regression starts from the line of nearly the same signals, if there is one.
    """
    fit = _alternate(tile, functions, ratios, start)
    line, first, noise = fit.line, fit.emissivity, like(tile.noise, tile.signals)
    xp = namespace(noise)
    # Eq. 6 by implicit differentiation: dx/deps = (dh/deps - dq/deps) / h', var x = var q / h'^2.
    sensitivity = (fit.partial - functions.object_part @ ratios.coefficients[0]) / fit.steepness
    leverage, used = functions.leverage[:, ratios.order - 1], ratios.order + functions.steps
    smooth_variance = leverage * ratios.null_variance / fit.steepness**2
    # What the criterion for the order leaves of the object's curve is as large as the noise that
    # one more function would have cost, log N times.
    omitted = smooth_variance * float(np.log(tile.time.size)) / used
    # Variance of the slope: of the ordinate's noise, and of the abscissa's.
    kernel = line.kernel(fit.emitted)
    noise_variance = line.variance + first**2 * _curve_variance(kernel, functions, ratios)
    curve_std = first * xp.sqrt(ratios.null_variance)
    walk, upper = walk_variance(line, fit.emitted, functions, noise[0], curve_std, used)
    # A uniform distribution in [-d, d] has the variance d^2 / 3.
    limit = (1.0 - first) * background_drift / np.sqrt(3.0)
    linear = _linear_variance(tile, functions, ratios, fit, limit)
    change = xp.amax(fit.emitted, axis=0) - xp.amin(fit.emitted, axis=0)
    drifting = (limit / change) ** 2 + xp.maximum(upper, linear)
    if tile.material is not None:
        known = ratios.pooled & xp.isfinite(tile.material.emissivity + tile.material.noise_variance)
        noise_variance = xp.where(known, tile.material.noise_variance, noise_variance)
        drifting = xp.where(known, tile.material.drift_variance, drifting)
    level_std = _level_std(tile, ratios, fit, noise_variance + walk)
    by_level = (ratios.null_weights * level_std).sum(axis=0)
    epsilon = ratios.inverse_energy * ratios.null_variance + by_level**2
    # Residual of the line in a frame of rest: s_1^2 + e_1^2 var x.
    expected = noise[0] ** 2 + first**2 * (sensitivity**2 * epsilon + smooth_variance + omitted)
    emissivity = 1.0 - ratios.ratio * (1.0 - first)
    return Emission(
        temperature=fit.temperature,
        temperature_std=xp.sqrt(_fieller(sensitivity, epsilon) + smooth_variance),
        sensitivity=sensitivity,
        smooth_variance=smooth_variance,
        emissivity=emissivity,
        emissivity_covariance=_emissivity_covariance(
            emissivity[0], noise_variance + drifting, ratios, noise, level_std
        ),
        epsilon_variance=epsilon,
        level_std=level_std,
        noise_variance=noise_variance,
        drift_variance=drifting,
        constant=fit.constant,
        restless=(line.residual**2 < WITHIN**2 * expected).sum(axis=0) < RESTING * tile.time.size,
        line=line,
    )


@dataclass(frozen=True)
class _Fit:
    """Object and emissivity after the alternation, and the derivatives at the last step."""

    temperature: Array  # of the object (time, pixel) [K]
    emitted: Array  # u_1(x) of the last regression (time, pixel) [K]
    emissivity: Array  # of the first band (pixel) [1]
    constant: Mask  # (pixel)
    line: residuals.Line
    steepness: Array  # h'(x) (time, pixel) [1]
    partial: Array  # see `_newton` (time, pixel) [K]


def _alternate(
    tile: Tile,
    functions: smooth.Subspace,
    ratios: ReflectionRatio,
    line: residuals.Line | None,
) -> _Fit:
    """Alternate the object temperature (eq. 6) and the first emissivity (eq. 7)."""
    # Eq. 5: q = w.z, smoothed, less the steps of the camera.
    xp = namespace(tile.signals)
    smoothed = xp.einsum("bp,bcp->cp", ratios.null_weights, ratios.coefficients)
    target = functions.object_part @ smoothed
    temperature = tile.temperature(1, target)
    middle, known = _middle(ratios.ratio), xp.zeros_like(ratios.pooled)
    if tile.material is not None:
        told = ratios.pooled & xp.isfinite(tile.material.emissivity)
        middle = xp.where(told, tile.material.emissivity, middle)
        known = told & xp.isfinite(tile.material.noise_variance)
    # The robust line is sought on a curve that is right to second order, or it locks elsewhere.
    guess = _plain_slope(tile.blackbody(0, temperature), tile.signals[0])
    emissivity = xp.where((guess > 0) & (guess < 1), guess, middle)
    temperature = _newton(tile, ratios, emissivity, target, temperature)[0]
    before = slope_before = xp.full_like(emissivity, np.nan)
    for _ in range(ROUNDS):
        emitted = tile.blackbody(0, temperature)
        line = residuals.regress(emitted, tile.signals[0], tile.noise[0], start=line)
        functions_used = ratios.order + functions.steps
        constant = line.energy < OBJECT_TO_NOISE * functions_used * ratios.null_variance
        moved, change = line.slope - slope_before, emissivity - before
        slow = xp.abs(moved) < FASTEST * xp.abs(change)
        rate = xp.where(slow, moved / xp.where(slow, change, 1.0), 0.0)
        before, slope_before = emissivity, line.slope
        extrapolated = line.slope + (line.slope - before) * rate / (1.0 - rate)
        emissivity = xp.where(constant | known, middle, extrapolated)
        constant = constant & ~known
        temperature, steepness, partial = _newton(tile, ratios, emissivity, target, temperature)
    assert line is not None
    return _Fit(temperature, emitted, emissivity, constant, line, steepness, partial)


def _plain_slope(abscissa: Array, ordinate: Array) -> Array:
    """Slope (pixel) of the ordinary least-squares line through points (time, pixel)."""
    centred = abscissa - abscissa.mean(axis=0)
    return (centred * ordinate).sum(axis=0) / (centred**2).sum(axis=0)


def _level_std(tile: Tile, ratios: ReflectionRatio, fit: _Fit, variance: Array) -> Array:
    r"""
    Signed standard deviation (band, pixel) [1] of the ratios through the background's level.

    Rapid changes have the ratios :math:`\kappa_m u_m'(y) / u_1'(y)`, and y is known as well as e_1,

    .. math:: \delta \kappa_m = \kappa_m \, \delta y \, \mathrm{d} \ln (u_m' / u_1') / \mathrm{d} y,
              \quad \delta y = (u_1(y) - u_1(x)) \, \delta e_1 / (1 - e_1)

    in the mean over time, with the `variance` of e_1; or as any temperature that is calibrated.
    """
    curve = tile.curves[0]
    around = tile.reference + np.array([-0.5, 0.5])  # [K]
    slopes = np.log(np.stack([one.slope(around) for one in tile.curves]))
    rates = np.diff(slopes - slopes[0], axis=1)
    reflected, xp = (tile.signals[0] - fit.emitted).mean(axis=0), namespace(variance)
    std = xp.abs(reflected) * xp.sqrt(variance) / (1.0 - fit.emissivity) ** 2
    # A uniform distribution of width d has the variance d^2 / 12.
    widest = float((curve.highest - curve.lowest) / np.sqrt(12.0))
    return ratios.ratio * like(rates, std) * xp.where(std < widest, std, widest)


def _fieller(sensitivity: Array, epsilon: Array) -> Array:
    """
    Variance (time, pixel) [K^2] of the object through epsilon, of variance (pixel) [1].

    The object is a ratio with an uncertain denominator: half the width of its 95 % interval by
    Fieller's theorem (1954), doi:10.1111/j.2517-6161.1954.tb00159.x
    """
    return sensitivity**2 * epsilon / (1.0 - NORMAL95**2 * epsilon) ** 2


def _emissivity_covariance(
    first: Array, slope_variance: Array, ratios: ReflectionRatio, noise: Array, level_std: Array
) -> Array:
    r"""
    Covariance of the emissivities (band, band, pixel) [1], from the ratios and the slope (eq. 8).

    .. math:: \delta e_1 = -e_1 (1 - e_1) \epsilon + \delta o, \quad
              \delta e_m = \kappa_m \delta e_1 - (1 - e_1) \delta \kappa_m
    """
    ratio, weights = ratios.ratio, ratios.null_weights
    reflectivity, squares = 1.0 - first, (noise**2)[:, np.newaxis]
    pairs, energy = ratio[:, np.newaxis] * ratio, ratios.inverse_energy
    # Of kappa_m with epsilon, over sigma^2: s_m^2 w_m - kappa_m s_1^2 w_1; with one another:
    # kappa_m kappa_n s_1^2, and the variances of eq. 4.
    with_epsilon = squares * weights - ratio * squares[0] * weights[0]
    with_epsilon[0] = 0.0
    between = pairs * squares[0] * energy
    between[0], between[:, 0] = 0.0, 0.0
    for band, variance in enumerate(ratios.variance):
        between[band, band] = variance
    # Terms with epsilon: (e_1 (1 - e_1))^2 kappa_m kappa_n var(eps) and, of both with the other,
    # e_1 (1 - e_1)^2 kappa_m cov(kappa_n, eps).
    cross = ratio[:, np.newaxis] * with_epsilon
    through = (first * reflectivity) ** 2 * pairs * ratios.null_variance
    through += first * reflectivity**2 * (cross + cross.swapaxes(0, 1))
    # Through the background's level: -(1 - e_1) (kappa_m e_1 deps + dkappa_m).
    by_level = reflectivity * (ratio * first * (weights * level_std).sum(axis=0) + level_std)
    covariance = pairs * slope_variance + through * energy + reflectivity**2 * between
    return covariance + by_level[:, np.newaxis] * by_level


def walk_variance(
    line: residuals.Line,
    emitted: Array,
    functions: smooth.Subspace,
    noise: float,
    curve_std: Array | float = 0.0,
    order: Whole | int = 1,
) -> tuple[Array, Array]:
    r"""
    Variance (pixel) [1] of the regression's slope from a background that walks; its upper bound.

    With the unit coefficients :math:`\xi_j` of the object's curve `emitted` (time, pixel) of norm
    :math:`|u|`, and the energy A of a random walk in the residual's spectrum, the larger of those
    of two octaves; for the bound, at the upper end of their 95 % interval,

    .. math:: \mathrm{var}(e_1) = \frac{A}{|u|^2} \sum_j \frac{\xi_j^2}{j^2}

    The residual holds the `noise` of the signal and, below the `order`, that of the object's curve.
    """
    columns, xp = functions.rising, namespace(emitted)
    degree = like(np.arange(1.0, columns.shape[1] + 1)[:, np.newaxis], emitted)
    # Spectra of the residual, over the share of frames that the weights keep, and of the curve.
    share = line.weights.mean(axis=0)
    spectrum = columns.T @ (line.residual * line.weights) / share
    curve = columns.T @ emitted
    energy = (curve**2).sum(axis=0)
    unit = curve / xp.sqrt(energy)
    # The part orthogonal to the object's curve is the background's alone.
    spectrum = spectrum - unit * (unit * spectrum).sum(axis=0)
    # Energy of a walk at degree 1: j^2 times that at degree j, less the noise's.
    walk = degree**2 * (spectrum**2 - noise**2 / share - curve_std**2 * (degree < order))
    octaves, widened = [0.0 * energy], [0.0 * energy]
    for low, high, lost in OCTAVES:
        if (freedom := len(walk[low - 1 : high - 1]) - lost) > 0:
            octaves.append(walk[low - 1 : high - 1].sum(axis=0) / freedom)
            widened.append(octaves[-1] * (stdtrit(freedom, 0.975) / NORMAL95) ** 2)
    scale = (unit**2 / degree**2).sum(axis=0) / energy
    expected, upper = (scale * xp.amax(xp.stack(one), axis=0) for one in (octaves, widened))
    return expected, upper


def _linear_variance(
    tile: Tile, functions: smooth.Subspace, ratios: ReflectionRatio, fit: _Fit, limit: Array
) -> Array:
    r"""
    Variance (pixel) [1] of the slope from a linear drift of size d, seen with a variance v.

    :math:`\gamma^2 k (k d^2 + v)`, k = D / (D + v), with D of the `limit` [K] or of what is seen.
    """
    drift, xp = functions.rising[:, 0], namespace(limit)
    slope, size, kernel = _drift_beside(fit.line, fit.emitted, drift)
    variance = tile.noise[0] ** 2 * xp.einsum("tp,tp->p", kernel, kernel)
    variance += fit.emissivity**2 * _curve_variance(kernel, functions, ratios)
    before = xp.maximum((limit / (drift.max() - drift.min())) ** 2, size**2 + variance)
    share = before / (before + variance)
    return slope**2 * share * (share * size**2 + variance)


def _drift_beside(line: residuals.Line, curve: Array, drift: Array) -> tuple[Array, Array, Array]:
    """
    Slope of a linear drift (time) on the object's curve, its size in the residual, and its kernel.

    Weighted twice, for a large drift takes the weight from the frames that tell it best.
    """
    weights, xp = line.weights, namespace(curve)
    for last in (False, True):
        weighted, total = weights * curve, weights.sum(axis=0)
        mean, middle = weighted.sum(axis=0) / total, drift @ weights / total
        energy = xp.einsum("tp,tp->p", weighted, curve) - total * mean**2
        slope = (drift @ weighted - total * mean * middle) / energy
        # w (t - gamma u), about its mean, over its product with t.
        kernel = drift[:, np.newaxis] * weights
        kernel -= (middle - slope * mean) * weights
        kernel -= slope * weighted
        kernel /= drift @ kernel
        size = xp.einsum("tp,tp->p", kernel, line.residual)
        if not last:
            beside = drift[:, np.newaxis] - (middle - slope * mean) - slope * curve
            scaled = (line.residual - size * beside) / (residuals.TUNING * line.scale)
            weights = xp.clip(1.0 - scaled**2, min=0.0) ** 2
    return slope, size, kernel


def _curve_variance(kernel: Array, functions: smooth.Subspace, ratios: ReflectionRatio) -> Array:
    """Variance (pixel) of the sum of a kernel (time, pixel) over the object's smoothed noise."""
    part = (functions.object_part.T @ kernel) * functions.columns(ratios.order)
    return ratios.null_variance * (part**2).sum(axis=0)


def _middle(ratio: Array) -> Array:
    """Middle of the interval that the ratios leave for e_1, for a constant object."""
    xp = namespace(ratio)
    largest = xp.amax(ratio, axis=0)
    return 0.5 + 0.5 * xp.where(largest > 1.0, 1.0 - 1.0 / largest, 0.0)


def _newton(
    tile: Tile, ratios: ReflectionRatio, emissivity: Array, target: Array, temperature: Array
) -> tuple[Array, Array, Array]:
    r"""
    One Newton step towards the object, :math:`h(x) = \sum w_m e_m u_m(x) = q` (eq. 6).

    Returns the new x, h'(x), and the part of the first band's signal in :math:`\partial h /
    \partial \epsilon` at the old x.
    """
    factors = ratios.null_weights * (1.0 - ratios.ratio * (1.0 - emissivity))
    emitted = [tile.blackbody(band, temperature) for band in range(len(factors))]
    slopes = [curve.slope(temperature) for curve in tile.curves]
    value, steepness = weighted(emitted, factors), weighted(slopes, factors)
    # The error of w.kappa moves weight from the other bands to the first, by their share in it.
    others = emitted[1]
    if len(emitted) > 2:
        others = weighted(emitted[1:], _shares(ratios, tile.noise))
    partial = mixing.mixed(emissivity, emitted[0], others)
    return temperature + (target - value) / steepness, steepness, partial


def weighted(parts: list[Array], weights: Array) -> Array:
    """Sum over the bands of (time, pixel), weighted by (band, pixel)."""
    total = parts[0] * weights[0]
    for part, weight in zip(parts[1:], weights[1:], strict=True):
        total += part * weight
    return total


def _shares(ratios: ReflectionRatio, noise: tuple[float, ...]) -> Array:
    """Share (band - 1, pixel) [1] of the ratios but the first in the variance of epsilon."""
    squares = like(noise, ratios.ratio)[:, np.newaxis] ** 2
    parts = (ratios.null_weights**2 * (squares + ratios.ratio**2 * squares[0]))[1:]
    return parts / parts.sum(axis=0)
