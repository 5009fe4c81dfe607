r"""Direction of the reflection: the ratios of the bands' rapid changes, per pixel.

With the smooth subspace projected out, what is left of the bands is background plus noise, and the
background enters along :math:`\kappa = (1 - e_m) / (1 - e_1)`, the reflection ratios. With the
noise known, that direction is the principal axis of the noise-whitened covariance: a closed form
(Deming's regression), in any number of bands.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2, norm

from dbthermal import _smooth as smooth

Array = npt.NDArray[np.float64]
Whole = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]

LOWEST_ORDER: Final = 3
HIGHEST_ORDER: Final = 14
"""Smallest and largest smooth subspace that the data may choose (number of functions)."""

# Chance of four standard deviations.
_CHANCE: Final = float(2.0 * norm.sf(4.0))


@dataclass(frozen=True)
class Direction:
    r"""
    Direction of the rapid changes in the space of the bands, per pixel.

    Attributes
    ----------
    ratio : ndarray, shape (band, pixel)
        Reflection ratios :math:`\kappa`: change of each band over change of the first [1].
    spread : ndarray, shape (pixel,)
        Variance of the direction: :math:`\kappa_m` has the variance
        :math:`\sigma^2 (s_m^2 + \kappa_m^2 s_1^2)` [1/K^2]; infinite where no background energy
        is left.
    weights : ndarray, shape (band, pixel)
        Best combination of the bands that holds no background, and all of the object:
        :math:`w \cdot \kappa = 0`, :math:`\sum w = 1` [1].
    across : ndarray, shape (pixel,)
        Variance of the noise of that combination [K^2].
    order : ndarray of int, shape (pixel,)
        Number of smooth functions used.
    contrast : ndarray, shape (pixel,)
        Variance along the direction over variance across it, in units of the noise [1], with the
        largest smooth subspace: what of the object a smaller one leaves is no motion.
    misfit : ndarray, shape (pixel,)
        Variance across the direction over that of the noise, 1 where the model holds [1].
    coefficients : ndarray, shape (band, column, pixel)
        Coefficients of the signals on the smooth functions, zero beyond the pixel's order.
    scatter : ndarray, shape (band, band, pixel)
        Noise-whitened scatter of the rapid changes, less that of the noise.
    given : ndarray of bool, shape (pixel,)
        Where the ratio was known beforehand, and the pixel's own does not contradict it.
    """

    ratio: Array
    spread: Array
    weights: Array
    across: Array
    order: Whole
    contrast: Array
    misfit: Array
    coefficients: Array
    scatter: Array
    given: Mask


@dataclass(frozen=True)
class Known:
    """
    Ratios that are known beforehand, as from all pixels of one material.

    Attributes
    ----------
    ratio : ndarray, shape (band, pixel)
        Reflection ratios [1]; NaN for the pixels that find their own.
    spread : ndarray, shape (pixel,)
        Their variance, as `Direction.spread` [1/K^2].
    """

    ratio: Array
    spread: Array


def estimate(
    signals: Array, functions: smooth.Subspace, noise: Array, known: Known | None = None
) -> Direction:
    r"""
    Estimate the direction, and choose the order of the smooth subspace, from the data.

    The order is that of the lowest Bayesian information criterion of what lies across the
    direction, **plus one**: a part of the object's curve too small to be significant there still
    biases the ratio to first order, while one function more costs little variance.

    Parameters
    ----------
    signals : ndarray, shape (band, time, pixel)
        Signals, the quietest band first.
    functions : Subspace
        Smooth functions.
    noise : ndarray, shape (band,)
        Standard deviation of the noise of each band, in the units of the signals.
    known : Known, optional
        Ratios that are not to be estimated, but where the pixel's own rapid changes contradict
        them by four standard deviations.

    Returns
    -------
    Direction
        The direction and what it stands on.

    Notes
    -----
    With S the background's energy in the first band, n = N - K, and
    :math:`|v|^2 = \sum \kappa_m^2 / s_m^2`:

    .. math:: \sigma^2 = \frac{1}{S} + \frac{n}{S^2 |v|^2}

    The first term alone is the Cramer-Rao bound; see `limits.ratio_variance`.

    References
    ----------
    .. [1] Fuller (1987), Measurement Error Models, doi:10.1002/9780470316665
    .. [2] Schwarz (1978), Annals of Statistics 6, 461, doi:10.1214/aos/1176344136
    """
    frames = signals.shape[1]
    whitened = signals / noise[:, np.newaxis, np.newaxis]
    coefficients = np.einsum("tc,btp->bcp", functions.functions, whitened, optimize=True)
    scatter = _scatter(whitened, coefficients, functions.steps)
    freedom = frames - functions.steps - np.arange(1.0, functions.orders + 1)[:, np.newaxis]
    total = np.einsum("opbb->op", scatter)
    largest = np.asarray(np.linalg.eigvalsh(scatter)[..., -1], dtype=np.float64)
    given = np.zeros(signals.shape[2], dtype=bool)
    if known is not None:
        unit = known.ratio / noise[:, np.newaxis]
        unit = unit / np.sqrt(np.einsum("bp,bp->p", unit, unit))
        along = np.einsum("bp,opbc,cp->op", unit, scatter, unit)
        given = _fits(scatter, choose_order(total - along, frames), unit)
        largest = np.where(given, along, largest)
    across = total - largest
    order = choose_order(across, frames)
    rows = np.arange(order.size)
    chosen, free = scatter[order, rows], freedom[order, 0]
    ratio = axis_of(chosen, noise)
    if known is not None:
        ratio = np.where(given, known.ratio, ratio)
    whitened_ratio = ratio / noise[:, np.newaxis]
    length = np.einsum("bp,bp->p", whitened_ratio, whitened_ratio)
    along = largest[order, rows]
    spread = estimated_spread((along - free) / length, length, free)
    if known is not None:
        spread = np.where(given, known.spread, spread)
    weights, variance = combination(ratio, noise)
    others = len(noise) - 1
    contrast = np.full(order.shape, np.inf)
    np.divide(largest[-1] * others, across[-1], out=contrast, where=across[-1] > 0)
    return Direction(
        ratio=ratio,
        spread=spread,
        weights=weights,
        across=variance,
        order=order + 1,
        contrast=contrast,
        misfit=across[order, rows] / (others * free),
        coefficients=coefficients * noise[:, np.newaxis, np.newaxis] * functions.columns(order + 1),
        scatter=np.moveaxis(chosen, 0, -1) - free * np.eye(len(noise))[..., np.newaxis],
        given=given,
    )


def _fits(scatter: Array, order: Whole, unit: Array) -> Mask:
    """
    Where the scatter does not contradict a known direction; false for NaN.

    Of a background along the unit vector v and white noise, what is across is not correlated with
    what is along: :math:`|S v|^2 / (v^T S v) - v^T S v` is a chi-square variable.
    """
    chosen = scatter[order, np.arange(order.size)]
    turned = np.einsum("pbc,cp->bp", chosen, unit)
    along = np.einsum("bp,bp->p", unit, turned)
    across = np.einsum("bp,bp->p", turned, turned) / along - along
    return np.asarray(across < chi2.isf(_CHANCE, len(unit) - 1))


def combination(ratio: Array, noise: Array) -> tuple[Array, Array]:
    r"""
    Best combination of bands that holds the object and no background.

    Least variance with :math:`\sum w_m = 1`, :math:`\sum w_m \kappa_m = 0`; for two bands
    :math:`w = (-\kappa_2, 1) / (1 - \kappa_2)`.

    Parameters
    ----------
    ratio : ndarray, shape (band, pixel)
        Reflection ratios [1].
    noise : ndarray, shape (band,)
        Noise of the bands.

    Returns
    -------
    tuple of ndarray
        Weights (band, pixel), and the variance of the combination (pixel).
    """
    along = ratio / noise[:, np.newaxis]
    emitted = np.broadcast_to(1.0 / noise[:, np.newaxis], along.shape)
    share = (along * emitted).sum(axis=0) / (along**2).sum(axis=0)
    free = emitted - share * along
    variance = 1.0 / (free**2).sum(axis=0)
    return free * variance / noise[:, np.newaxis], variance


def axis_of(scatter: Array, noise: Array) -> Array:
    """
    Ratios of a whitened scatter: its principal axis.

    Parameters
    ----------
    scatter : ndarray, shape (..., band, band)
        Noise-whitened scatter.
    noise : ndarray, shape (band,)
        Noise of the bands.

    Returns
    -------
    ndarray, shape (band, pixel)
        Change of each band over change of the first [1].
    """
    axis = np.linalg.eigh(scatter)[1][..., -1].T * noise[:, np.newaxis]
    return np.asarray(axis / axis[0])


def _scatter(whitened: Array, coefficients: Array, steps: int) -> Array:
    """Scatter (order, pixel, band, band) of what the functions leave."""
    bands, _, pixels = whitened.shape
    result = np.empty((coefficients.shape[1] - steps, pixels, bands, bands))
    for one in range(bands):
        for other in range(one, bands):
            total = np.einsum("tp,tp->p", whitened[one], whitened[other])
            held = np.cumsum(coefficients[one] * coefficients[other], axis=0)[steps:]
            result[:, :, one, other] = result[:, :, other, one] = total - held
    return result


def choose_order(across: Array, frames: int) -> Whole:
    """
    Index of the order to use: lowest information criterion, plus one.

    Parameters
    ----------
    across : ndarray, shape (order, pixel)
        Energy across the direction for each order.
    frames : int
        Number of frames.

    Returns
    -------
    ndarray of int, shape (pixel,)
        Index into the orders, 0 for the constant alone.
    """
    orders = np.arange(1, across.shape[0] + 1)[:, np.newaxis]
    tiny = np.finfo(np.float64).tiny
    criterion = frames * np.log(np.maximum(across, tiny)) + orders * np.log(frames)
    lowest = min(LOWEST_ORDER, across.shape[0] - 1) - 1
    best = lowest + np.argmin(criterion[lowest:-1], axis=0)
    return np.asarray(best + 1)


def ratio_variance(found: Direction, noise: Array) -> Array:
    r"""
    Variance of the reflection ratios, :math:`\sigma^2 (s_m^2 + \kappa_m^2 s_1^2)`.

    Parameters
    ----------
    found : Direction
        The direction.
    noise : ndarray, shape (band,)
        Noise of the bands.

    Returns
    -------
    ndarray, shape (band, pixel)
        Variance [1], 0 in the first band.
    """
    squares = (noise**2)[:, np.newaxis]
    result = found.spread * (squares + found.ratio**2 * squares[0])
    result[0] = 0.0
    return np.asarray(result)


def estimated_spread(energy: Array, length: Array, freedom: npt.ArrayLike) -> Array:
    """
    Variance of the direction, given the background's energy; see `estimate`.

    Parameters
    ----------
    energy : ndarray
        Energy S of the background in the first band, orthogonal to the smooth subspace [K^2].
    length : ndarray
        Squared length of the whitened ratios [1/K^2].
    freedom : array_like
        Number of frames less that of the functions.

    Returns
    -------
    ndarray
        Variance [1/K^2]; infinite where the energy is not positive.
    """
    numerator = energy + np.asarray(freedom) / length
    return np.divide(numerator, energy**2, out=np.full_like(energy, np.inf), where=energy > 0)
