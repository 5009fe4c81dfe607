r"""Reflection ratios of the bands, by total least squares of their rapid changes, per pixel.

With the smooth subspace projected out, what remains of the bands is background plus noise, and the
background enters along :math:`\kappa_m = (1 - e_m) / (1 - e_1)`. With the noise known, that
direction is the principal axis of the noise-whitened scatter: a closed form (Deming's regression),
in any number of bands. Numbers of equations are those of `method`.
"""

from typing import Final

import numpy as np
from scipy.special import chdtri, ndtr

from dbthermal._arrays import quotient
from dbthermal.separation._tiles import Array, Mask

LOWEST_ORDER: Final = 3
"""Smallest smooth subspace that the data may choose (number of functions)."""

# Functions by which the two large orders differ that the ratios of a material are compared at. What
# the order of a pixel leaves of its object, unseen in its noise, adds up over a material's pixels.
FEWER: Final = 4

TEMPERATURES: Final = 9
"""Background temperatures, over the calibrated range, at which a gray body is looked for."""

CHANCE: Final = float(2.0 * ndtr(-4.0))
"""Chance of four standard deviations, at which a hypothesis on the ratios is rejected."""

# Chance at which a gray body passes for another: a tenth of what is promised of a status of 0.
GRAY_CHANCE: Final = 1e-4
TINY: Final = float(np.finfo(np.float64).tiny)


def principal_ratio(scatter: Array, noise: Array) -> Array:
    """Ratios (band, pixel) [1] of a whitened scatter (pixel, band, band): its principal axis."""
    axis = np.linalg.eigh(scatter)[1][..., -1].T * noise.reshape(len(noise), -1)
    return np.asarray(axis / axis[0])


def null_combination(ratio: Array, noise: Array) -> tuple[Array, Array]:
    r"""Weights (band, pixel) of bands that cancel the background, and noise variance (pixel).

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


def inverse_energy(scatter: Array, ratio: Array, noise: Array, freedom: Array) -> Array:
    """Inverse of the background's effective energy: sigma^2 of `pixel.ratios` (pixel) [1/K^2].

    Of ratios (band, pixel) that stand on a whitened scatter (band, band, pixel) of white noise of
    so many degrees of freedom. Infinite where the energy is not positive.
    """
    # With v = kappa / s, the energy in the first band is S = v^T C v / |v|^4.
    whitened = ratio / noise.reshape(len(noise), -1)
    length = (whitened**2).sum(axis=0)
    energy = np.einsum("bp,bcp,cp->p", whitened, scatter, whitened) / length**2
    return np.asarray(quotient(energy + freedom / length, energy**2 * (energy > 0), np.inf))


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


def agrees(scatter: Array, whitened: Array) -> Mask:
    """Pixels of which the scatter (pixel, band, band) agrees with whitened ratios (band, pixel).

    Of a background along the unit vector v and white noise, the part across v is not correlated
    with that along it: :math:`|S v|^2 / (v^T S v) - v^T S v` is a chi-square variable.
    """
    axis = whitened / np.sqrt((whitened**2).sum(axis=0))
    turned = np.einsum("pbc,cp->bp", scatter, axis)
    along = (axis * turned).sum(axis=0)
    statistic = (turned**2).sum(axis=0) / along - along
    return np.asarray(statistic < chdtri(len(axis) - 1, CHANCE))
