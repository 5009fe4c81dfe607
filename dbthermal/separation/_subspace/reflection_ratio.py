r"""Reflection ratios of the bands, by total least squares of their rapid changes, per pixel.

With the smooth subspace projected out, what remains of the bands is background plus noise, and the
background enters along :math:`\kappa_m = (1 - e_m) / (1 - e_1)`. With the noise known, that
direction is the principal axis of the noise-whitened scatter: a closed form (Deming's regression),
in any number of bands. Numbers of equations are those of `method`.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import chdtrc, chdtri, ndtr

from dbthermal import _smooth as smooth
from dbthermal._arrays import host, like, namespace, quotient
from dbthermal.separation._tiles import Array, Mask, Material, Whole

LOWEST_ORDER: Final = 3
HIGHEST_ORDER: Final = 14
"""Smallest and largest smooth subspace that the data may choose (number of functions)."""

# Functions by which the two largest orders differ that the ratios of a material are compared at.
FEWER: Final = 4

TEMPERATURES: Final = 9
"""Background temperatures, over the calibrated range, at which a gray body is looked for."""

CHANCE: Final = float(2.0 * ndtr(-4.0))
"""Chance of four standard deviations, at which a hypothesis on the ratios is rejected."""

# Chance at which a gray body passes for another: a tenth of what is promised of a status of 0.
GRAY_CHANCE: Final = 1e-4
_TINY: Final = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True)
class ReflectionRatio:
    """Reflection ratios of each pixel, and the combination of bands without background."""

    ratio: Array  # kappa: rapid change of each band over that of the first (band, pixel) [1]
    variance: Array  # of the ratios (band, pixel) [1], 0 in the first band
    inverse_energy: Array  # sigma^2 of eq. 4 (pixel) [1/K^2]; infinite without background energy
    null_weights: Array  # w of eq. 5: no background, all of the object (band, pixel) [1]
    null_variance: Array  # noise variance of that combination (pixel) [K^2]
    order: Whole  # number of smooth functions used (pixel)
    contrast: Array  # variance along the axis over that across it, at the largest order (pixel) [1]
    reduced_chi2: Array  # variance across the axis over the noise's, 1 if the model holds (pixel)
    coefficients: Array  # of the signals on the functions, 0 beyond the order (band, column, pixel)
    scatter: Array  # noise-whitened scatter of rapid changes less noise (band, band, pixel) [1]
    rapid_scatter: Array  # the same at the `rapid_orders` (2, band, band, pixel) [1]
    pooled: Mask  # the material's ratios are used, and the pixel does not contradict them (pixel)


def estimate(
    signals: Array, functions: smooth.Subspace, noise: Array, material: Material | None = None
) -> ReflectionRatio:
    r"""
    Estimate the ratios, and choose the order of the smooth subspace, from the data.

    The signals are (band, time, pixel), the quietest band first, with `noise` (band) in their unit.
    The order is that of the lowest Bayesian information criterion of the energy across the axis,
    **plus one**: a part of the object's curve too small to be significant there still biases the
    ratio to first order, while one function more costs little variance. The ratios of a material
    are used unless the pixel's own rapid changes contradict them by four standard deviations.

    Notes
    -----
    With S the background's energy in the first band, n = N - K degrees of freedom, and
    :math:`|v|^2 = \sum \kappa_m^2 / s_m^2`, the variance of the ratios is that of eq. 4 with

    .. math:: \sigma^2 = \frac{1}{S} + \frac{n}{S^2 |v|^2}

    The first term alone is the Cramer-Rao bound; see `limits.ratio_variance_bound`.

    References
    ----------
    .. [1] Fuller (1987), Measurement Error Models, doi:10.1002/9780470316665
    .. [2] Schwarz (1978), Annals of Statistics 6, 461, doi:10.1214/aos/1176344136
    """
    xp, frames, others = namespace(signals), signals.shape[1], len(noise) - 1
    # Eq. 3: scatter of the whitened signals z_m / s_m outside the smooth functions, at all orders.
    whitened = signals / noise[:, np.newaxis, np.newaxis]
    coefficients = functions.functions.T @ whitened
    scatter = _scatter(whitened, coefficients, functions.steps)
    orders = like(np.arange(1.0, functions.orders + 1)[:, np.newaxis], signals)
    freedom = frames - functions.steps - orders
    # Its energy is the largest eigenvalue along the axis, noise alone across it.
    total = xp.einsum("opbb->op", scatter)
    largest = xp.linalg.eigvalsh(scatter)[..., -1]
    pooled = xp.zeros_like(total[0], dtype=xp.bool)
    if material is not None:
        axis = material.ratio / noise[:, np.newaxis]
        axis = axis / xp.sqrt(xp.einsum("bp,bp->p", axis, axis))
        along = xp.einsum("bp,opbc,cp->op", axis, scatter, axis)
        pooled = _agrees(scatter, choose_order(total - along, frames), axis)
        largest = xp.where(pooled, along, largest)
    null_energy = total - largest
    order = choose_order(null_energy, frames)
    rows = xp.arange(len(order), device=order.device)
    chosen, free = scatter[order, rows], freedom[order, 0]
    ratio = principal_ratio(chosen, noise)
    # Energy along the axis less the noise's n, over |v|^2: S of the first band, for eq. 4.
    whitened_ratio = ratio / noise[:, np.newaxis]
    length = xp.einsum("bp,bp->p", whitened_ratio, whitened_ratio)
    energy = xp.linalg.eigvalsh(chosen)[..., -1] - free
    inverse = inverse_energy(energy / length, length, free)
    if material is not None:
        # The mean of the posterior, of the material's ratio for a prior with its spread.
        own = quotient(material.spread, material.spread + inverse, 0.0)
        mean = material.ratio + own * (ratio - material.ratio)
        ratio = xp.where(pooled, xp.where(own > 0, mean, material.ratio), ratio)
        common = (1.0 - own) * (material.spread + (1.0 - own) * material.inverse_energy)
        inverse = xp.where(pooled, common, inverse)
    weights, variance = null_combination(ratio, noise)
    rapid, unit = rapid_orders(functions.orders) - 1, like(np.eye(len(noise))[..., None], signals)
    return ReflectionRatio(
        ratio=ratio,
        variance=ratio_variance(ratio, inverse, noise),
        inverse_energy=inverse,
        null_weights=weights,
        null_variance=variance,
        order=order + 1,
        contrast=quotient(largest[-1] * others, null_energy[-1], np.inf),
        reduced_chi2=null_energy[order, rows] / (others * free),
        coefficients=coefficients * noise[:, np.newaxis, np.newaxis] * functions.columns(order + 1),
        scatter=xp.moveaxis(chosen, 0, -1) - free * unit,
        rapid_scatter=xp.moveaxis(scatter[rapid], 1, -1) - freedom[rapid][..., None, None] * unit,
        pooled=pooled,
    )


def rapid_orders(orders: int) -> Whole:
    """
    Two large orders (2,): that of all functions, and before it of a few less.

    What the order of one pixel leaves of its object, unseen in its noise, adds up over the pixels
    of a material.
    """
    return np.array([max(1, orders - FEWER), orders])


def principal_ratio(scatter: Array, noise: Array) -> Array:
    """Ratios (band, pixel) [1] of a whitened scatter (pixel, band, band): its principal axis."""
    axis = namespace(scatter).linalg.eigh(scatter)[1][..., -1].T * noise[:, np.newaxis]
    return axis / axis[0]


def null_combination(ratio: Array, noise: Array) -> tuple[Array, Array]:
    r"""
    Weights (band, pixel) of the bands that cancel the background, and their noise variance (pixel).

    Least variance with :math:`\sum w_m = 1`, :math:`\sum w_m \kappa_m = 0` (eq. 5); for two bands
    :math:`w = (-\kappa_2, 1) / (1 - \kappa_2)`.
    """
    # Whitened, the constraints are the vectors v = kappa / s and u = 1 / s; the part of u that is
    # orthogonal to v, r = u - v (u.v) / |v|^2, gives w = r / (s |r|^2) of variance 1 / |r|^2.
    along = ratio / noise[:, np.newaxis]
    emitted = 1.0 / noise[:, np.newaxis]
    share = (along * emitted).sum(axis=0) / (along**2).sum(axis=0)
    orthogonal = emitted - share * along
    variance = 1.0 / (orthogonal**2).sum(axis=0)
    return orthogonal * variance / noise[:, np.newaxis], variance


def inverse_energy(energy: Array, length: Array, freedom: Array | float) -> Array:
    """
    Inverse of the background's effective energy: sigma^2 of `estimate` [1/K^2].

    Of the energy S in the first band [K^2], the squared length of the whitened ratios [1/K^2], and
    the degrees of freedom. Infinite where the energy is not positive.
    """
    numerator = energy + freedom / length
    return quotient(quotient(numerator, energy, np.inf), energy, np.inf)


def ratio_variance(ratio: Array, inverse: Array, noise: Array) -> Array:
    r"""Variance :math:`\sigma^2 (s_m^2 + \kappa_m^2 s_1^2)` of ratios (band, pixel) (eq. 4)."""
    result = inverse * _ratio_error(ratio, noise)
    result[0] = 0.0
    return result


def energy_of_variance(ratio: Array, variance: Array, noise: Array) -> Array:
    r"""Inverse energies :math:`\sigma^2` (band - 1, pixel) of ratios and variances (eq. 4)."""
    return variance[1:] / _ratio_error(ratio, noise)[1:]


def _ratio_error(ratio: Array, noise: Array) -> Array:
    squares = (noise**2)[:, np.newaxis]
    return squares + ratio**2 * squares[0]


def may_be_gray(ratios: ReflectionRatio, noise: Array, slopes: Array) -> Mask:
    r"""
    Pixels (pixel) of which equal emissivities are not excluded, from its signals as they are.

    All that changes in a gray body changes the bands in proportion to the `slopes`
    (temperature, band) [1] of their responses, :math:`\dot z_m = (1 - e) \, u_m'(y) \, \dot y`:
    before a background warmer than the reference its ratios are not 1. That temperature cannot
    be told beside a gray body; it is as likely to lie between any two of the temperatures. The
    chance is the mean over them of that of the chi-square, with a degree of freedom for each band
    but one, of the nearest ratios between the two.
    """
    xp, along = namespace(noise), ratios.ratio / noise[:, np.newaxis]
    unit = along / xp.sqrt((along**2).sum(axis=0))
    gray = slopes / slopes[:, :1] / noise
    # The part of g / s orthogonal to v, as in `null_combination`; its variance is sigma^2.
    off = gray[..., np.newaxis] - (gray @ unit)[:, np.newaxis] * unit
    start, step = off[:-1], xp.diff(off, axis=0)
    length = xp.clip(xp.einsum("tbp,tbp->tp", step, step), min=_TINY)
    share = xp.clip(-xp.einsum("tbp,tbp->tp", start, step) / length, 0.0, 1.0)
    between = start + share[:, np.newaxis] * step
    nearest = xp.einsum("tbp,tbp->tp", between, between) / ratios.inverse_energy
    freedom = len(noise) - 1
    # The mean is no larger than the largest chance: few pixels need it.
    near = xp.amin(nearest, axis=0) < chdtri(freedom, GRAY_CHANCE)
    chance = chdtrc(freedom, host(nearest[:, near])).mean(axis=0)
    gray = xp.zeros_like(near)
    gray[near] = like(chance > GRAY_CHANCE, near)
    return gray


def plane(signals: Array, noise: Array) -> tuple[Array, Array]:
    """
    Combinations (2, time, pixel) of signals (band, time, pixel) with noise of 1, and their axes.

    Object and background change more than two bands along two lines: of the whitened signals all
    but the noise lies in one plane, with axes (2, band, pixel) [1]. Two bands are the plane.
    """
    white = signals / noise[:, np.newaxis, np.newaxis]
    if len(noise) == 2:
        return white, np.repeat(np.eye(2)[..., np.newaxis], signals.shape[2], axis=2)
    changes = white - white.mean(axis=1, keepdims=True)
    scatter = np.einsum("btp,ctp->pbc", changes, changes)
    axes = np.linalg.eigh(scatter)[1][..., -2:].transpose(2, 1, 0)
    return np.einsum("abp,btp->atp", axes, white), axes


def null_energy(white: Array, functions: smooth.Subspace, axis: Array) -> tuple[Array, Whole]:
    """
    Energy across the axis of rapid changes of a `plane` (2, time, pixel), and functions used.

    Of the functions that the lowest information criterion selects, and one more; across a known
    `axis` (2, pixel) where it is not NaN.
    """
    held = np.einsum("tf,btp->bfp", functions.functions, white, optimize=True)
    pairs = ((0, 0), (0, 1), (1, 1))
    a, b, d = (
        np.einsum("tp,tp->p", white[i], white[j])
        - np.cumsum(held[i] * held[j], axis=0)[functions.steps :]
        for i, j in pairs
    )
    principal = 0.5 * (a + d) - np.sqrt(0.25 * (a - d) ** 2 + b * b)
    known = axis[1] ** 2 * a - 2.0 * axis[0] * axis[1] * b + axis[0] ** 2 * d
    energy = np.where(np.isnan(known), principal, known)
    order = choose_order(energy, white.shape[1])
    used = order + 1 + functions.steps
    return energy[order, np.arange(order.size)], used


def choose_order(null_energy: Array, frames: int) -> Whole:
    """Order less one (pixel) of the lowest information criterion of an energy (order, pixel)."""
    if len(null_energy) == 1:
        return like(np.zeros(null_energy.shape[1], dtype=np.intp), null_energy)
    xp, price = namespace(null_energy), np.arange(1, len(null_energy) + 1) * np.log(frames)
    criterion = frames * xp.log(xp.clip(null_energy, min=_TINY))
    criterion += like(price[:, np.newaxis], null_energy)
    lowest = min(LOWEST_ORDER, null_energy.shape[0] - 1) - 1
    return lowest + xp.argmin(criterion[lowest:-1], axis=0) + 1


def _scatter(whitened: Array, coefficients: Array, steps: int) -> Array:
    """Scatter (order, pixel, band, band) of the signals outside the functions of each order."""
    xp, (bands, _, pixels) = namespace(whitened), whitened.shape
    shape = coefficients.shape[1] - steps, pixels, bands, bands
    result = xp.empty(shape, dtype=whitened.dtype, device=whitened.device)
    for one in range(bands):
        for other in range(one, bands):
            # The basis is orthonormal: |P z|^2 = |z|^2 - sum of squared coefficients.
            total = xp.einsum("tp,tp->p", whitened[one], whitened[other])
            held = xp.cumsum(coefficients[one] * coefficients[other], axis=0)[steps:]
            result[:, :, one, other] = result[:, :, other, one] = total - held
    return result


def _agrees(scatter: Array, order: Whole, axis: Array) -> Mask:
    """Pixels of which the scatter at an order agrees with a known axis; false for NaN."""
    return agrees(scatter[order, like(np.arange(len(order)), order)], axis)


def agrees(scatter: Array, axis: Array) -> Mask:
    """
    Pixels of which the scatter (pixel, band, band) agrees with a unit axis (band, pixel).

    Of a background along the unit vector v and white noise, the part across v is not correlated
    with that along it: :math:`|S v|^2 / (v^T S v) - v^T S v` is a chi-square variable.
    """
    xp = namespace(axis)
    turned = xp.einsum("pbc,cp->bp", scatter, axis)
    along = xp.einsum("bp,bp->p", axis, turned)
    statistic = xp.einsum("bp,bp->p", turned, turned) / along - along
    return statistic < chdtri(len(axis) - 1, CHANCE)
