r"""Direction of the reflection: the ratio k2 of the bands' rapid changes, per pixel.

With the smooth subspace projected out, what is left of both bands is background plus noise, and
the background enters along :math:`(1 - e_1, 1 - e_2)`. With the noise known, that direction is
the principal axis of the noise-whitened covariance: a closed form (Deming's regression).
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from dbthermal import smooth

Array = npt.NDArray[np.float64]

MEMORY_LAGS: Final = 5
"""Frames over which `memory` looks for a correlation."""

LOWEST_ORDER: Final = 3
HIGHEST_ORDER: Final = 14
"""Smallest and largest smooth subspace that the data may choose (number of functions)."""


@dataclass(frozen=True)
class Direction:
    """
    Direction of the rapid changes in the plane of the two bands, per pixel.

    Attributes
    ----------
    ratio : ndarray, shape (pixel,)
        k2, change of the second band over change of the first [1].
    variance : ndarray, shape (pixel,)
        Variance of the ratio; infinite where no background energy is left.
    order : ndarray of int, shape (pixel,)
        Number of smooth functions used.
    contrast : ndarray, shape (pixel,)
        Variance along the direction over variance across it, in units of the noise [1], with the
        largest smooth subspace: what of the object a smaller one leaves is no motion.
    misfit : ndarray, shape (pixel,)
        Variance across the direction over that of the noise, 1 where the model holds [1].
    coefficients : ndarray, shape (2, order, pixel)
        Coefficients of the two signals on the smooth functions, zero beyond the pixel's order.
    """

    ratio: Array
    variance: Array
    order: npt.NDArray[np.intp]
    contrast: Array
    misfit: Array
    coefficients: Array


def estimate(signals: Array, functions: Array, noise: tuple[float, float]) -> Direction:
    r"""
    Estimate the direction, and choose the order of the smooth subspace, from the data.

    The order is that of the lowest Bayesian information criterion of the combination of bands
    that holds no background, :math:`z_2 - k_2 z_1`, **plus one**: a part of the object's curve
    too small to be significant there still biases the ratio to first order, while one function
    more costs little variance.

    Parameters
    ----------
    signals : ndarray, shape (2, time, pixel)
        Signals of the two bands.
    functions : ndarray, shape (time, order)
        Smooth functions, from `smooth.basis`.
    noise : tuple of float
        Standard deviation of the noise of each band, in the units of the signals.

    Returns
    -------
    Direction
        The direction and what it stands on.

    Notes
    -----
    Variance of the ratio, with S the background's energy in the first band and n = N - K:

    .. math:: \mathrm{var}(k) = \frac{(s_2^2 + k^2 s_1^2) S + n s_1^2 s_2^2}{S^2}

    The first term alone is the Cramer-Rao bound; see `limits.ratio_variance`.

    References
    ----------
    .. [1] Fuller (1987), Measurement Error Models, doi:10.1002/9780470316665
    .. [2] Schwarz (1978), Annals of Statistics 6, 461, doi:10.1214/aos/1176344136
    """
    frames, orders = functions.shape
    freedom = frames - np.arange(1, orders + 1, dtype=np.float64)[:, np.newaxis]
    whitened = [signal / std for signal, std in zip(signals, noise, strict=True)]
    first, second, cross = (
        smooth.residual_energy(functions, whitened[i], whitened[j]) / freedom
        for i, j in ((0, 0), (1, 1), (0, 1))
    )
    centre, radius = 0.5 * (first + second), np.hypot(0.5 * (first - second), cross)
    largest, smallest = centre + radius, centre - radius
    order = choose_order(smallest, frames)
    contrast = np.full(largest.shape[1], np.inf)
    np.divide(largest[-1], smallest[-1], out=contrast, where=smallest[-1] > 0)
    smallest, first, second, cross = (
        np.take_along_axis(values, order[np.newaxis], axis=0)[0]
        for values in (smallest, first, second, cross)
    )
    angle = 0.5 * np.arctan2(2.0 * cross, first - second)
    ratio = noise[1] / noise[0] * np.tan(angle)
    energy = (frames - order - 1) * (first - 1.0) * noise[0] ** 2
    kept = np.arange(orders)[:, np.newaxis] <= order
    return Direction(
        ratio=ratio,
        variance=estimated_variance(ratio, energy, noise, frames - order - 1),
        order=order + 1,
        contrast=contrast,
        misfit=smallest,
        coefficients=np.stack([(functions.T @ signal) * kept for signal in signals]),
    )


def memory(signals: Array, functions: Array, found: Direction) -> Array:
    r"""
    Mean autocorrelation of what is left of :math:`z_2 - k_2 z_1`, over a few frames.

    White noise leaves nothing but scatter. A change of the object that the smooth functions do not
    follow, or a background along another direction, leaves a correlation.

    Parameters
    ----------
    signals : ndarray, shape (2, time, pixel)
        Signals of the two bands.
    functions : ndarray, shape (time, order)
        Smooth functions.
    found : Direction
        From `estimate`.

    Returns
    -------
    ndarray, shape (pixel,)
        Mean over lags of 1 to `MEMORY_LAGS` frames, in standard deviations of white noise.
    """
    smooth_part = functions @ (found.coefficients[1] - found.ratio * found.coefficients[0])
    left = signals[1] - found.ratio * signals[0] - smooth_part
    energy = np.einsum("tp,tp->p", left, left)
    lagged = np.zeros_like(energy)
    for lag in range(1, MEMORY_LAGS + 1):
        lagged += np.einsum("tp,tp->p", left[lag:], left[:-lag])
    mean = np.divide(lagged, MEMORY_LAGS * energy, out=np.zeros_like(energy), where=energy > 0)
    return np.asarray(mean * np.sqrt(MEMORY_LAGS * left.shape[0]))


def choose_order(misfit: Array, frames: int) -> npt.NDArray[np.intp]:
    """
    Index of the order to use: lowest information criterion, plus one.

    Parameters
    ----------
    misfit : ndarray, shape (order, pixel)
        Variance across the direction for each order.
    frames : int
        Number of frames.

    Returns
    -------
    ndarray of int, shape (pixel,)
        Index into the orders, 0 for the constant alone.
    """
    orders = np.arange(1, misfit.shape[0] + 1)[:, np.newaxis]
    tiny = np.finfo(np.float64).tiny
    freedom = (frames - orders) / frames
    criterion = frames * np.log(np.maximum(misfit * freedom, tiny)) + orders * np.log(frames)
    lowest = min(LOWEST_ORDER, misfit.shape[0] - 1) - 1
    best = lowest + np.argmin(criterion[lowest:-1], axis=0)
    return np.asarray(best + 1)


def estimated_variance(
    ratio: Array, energy: Array, noise: tuple[float, float], freedom: npt.ArrayLike
) -> Array:
    """
    Variance of the ratio, given the background's energy; see `estimate`.

    Parameters
    ----------
    ratio : ndarray
        k2 [1].
    energy : ndarray
        Energy of the background in the first band, orthogonal to the smooth subspace.
    noise : tuple of float
        Standard deviations of the noise.
    freedom : array_like
        Number of frames less the order.

    Returns
    -------
    ndarray
        Variance [1]; infinite where the energy is not positive.
    """
    across = noise[1] ** 2 + ratio**2 * noise[0] ** 2
    numerator = across * energy + np.asarray(freedom) * (noise[0] * noise[1]) ** 2
    positive = energy > 0
    return np.divide(numerator, energy**2, out=np.full_like(energy, np.inf), where=positive)
