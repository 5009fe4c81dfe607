r"""Fisher information of one pixel's film, with the background eliminated frame by frame.

The model is :math:`z_m(t) = e_m u_m(x(t)) + (1 - e_m) u_m(y(t))` + noise of standard deviation
:math:`s_m`, with x in a smooth subspace, :math:`x = \Phi c`. Everything is divided by the noise
here, so that the information is the sum of squares of derivatives.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Final, Protocol

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

REMAINDER: Final = 0.1
"""Energy, in units of the noise's variance, that a smooth subspace may leave of the object."""

HIGHEST_ORDER: Final = 30
"""Largest smooth subspace that is tried (number of functions)."""

# Information in a direction, relative to that on its parameters were each the only unknown, below
# which it is rounding: a deviation a million times larger tells nothing of any quantity here.
_BLIND: Final = 1e-12
# Squared share of a quantity's gradient along such directions, above which it depends on them.
_TOUCHED: Final = 1e-8


class Blackbody(Protocol):
    """Linearised signal u(T) [K] of a blackbody in one band, and its slope [1]."""

    def signal(self, temperature: npt.ArrayLike) -> Array:
        """Signal [K] at temperatures [K]."""

    def slope(self, temperature: npt.ArrayLike) -> Array:
        """Derivative [1] of the signal at temperatures [K]."""


@dataclass(frozen=True)
class Film:
    """
    Derivatives of every sample with the unknowns, over the noise, at the truth.

    Attributes
    ----------
    emissivity : ndarray, shape (band, pixel)
        Emissivity [1].
    contrast : ndarray, shape (band, time, pixel)
        With the band's emissivity, :math:`(u_m(x) - u_m(y)) / s_m` [1].
    emission, reflection : ndarray, shape (band, time, pixel)
        With object and background temperature, :math:`e_m u_m'(x) / s_m` and
        :math:`(1 - e_m) u_m'(y) / s_m` [1/K].
    resting : ndarray of bool, shape (time, pixel)
        Frames in which the background is at one level.
    """

    emissivity: Array
    contrast: Array
    emission: Array
    reflection: Array
    resting: Mask

    def of(self, pixels: npt.NDArray[np.intp]) -> "Film":
        """Some of the pixels."""
        return Film(
            **{field.name: getattr(self, field.name)[..., pixels] for field in fields(self)}
        )

    def weight(self) -> Array:
        r"""
        What is left of a sample once the background of its frame is eliminated.

        :math:`1 - v v^T / v^T v` with v the reflection, over the bands, where the background is
        free; the unit matrix where it rests.

        Returns
        -------
        ndarray, shape (band, band, time, pixel)
            Projection [1].
        """
        free = ~self.resting / np.sum(self.reflection**2, axis=0)
        outer = self.reflection[:, np.newaxis] * self.reflection * free
        unit = np.eye(len(self.reflection))[..., np.newaxis, np.newaxis]
        return np.asarray(unit - outer)


def film(
    blackbodies: Sequence[Blackbody],
    noise: Array,
    truth: tuple[Array, Array, Array],
    resting: Mask,
) -> Film:
    """
    Derivatives at a truth.

    Parameters
    ----------
    blackbodies : sequence of Blackbody
        Of each band.
    noise : ndarray, shape (band,)
        Standard deviation of the linearised signals [K].
    truth : tuple of ndarray
        Object and background temperature, (time, pixel) [K], and emissivity (band, pixel) [1].
    resting : ndarray of bool, shape (time, pixel)
        Frames in which the background is at one level.

    Returns
    -------
    Film
        The derivatives.
    """
    warm, cold, emissivity = truth
    scaled = list(zip(blackbodies, noise, emissivity, strict=True))
    return Film(
        emissivity=emissivity,
        contrast=np.stack([(u.signal(warm) - u.signal(cold)) / s for u, s, _ in scaled]),
        emission=np.stack([e * u.slope(warm) / s for u, s, e in scaled]),
        reflection=np.stack([(1.0 - e) * u.slope(cold) / s for u, s, e in scaled]),
        resting=resting,
    )


def smallest_order(seen: Film, warm: Array, functions: Array) -> npt.NDArray[np.intp]:
    r"""
    Size of the smallest smooth subspace that the true object lies in, as far as the noise shows.

    A subspace leaves :math:`r = x - \Phi \Phi^T x`. Its energy in the samples, the free background
    eliminated, in units of the noise's variance,

    .. math:: \sum_t r(t)^2 \, p(t)^T W(t) \, p(t) \le 0.1

    with p the derivatives with the object and W of `Film.weight`. It shifts no quantity by more
    than its square root, 0.32, of that quantity's own bound (Cauchy and Schwarz). Where no frame
    rests and the bands are two, this is the energy left in :math:`z_2 - k_2 z_1`, the combination
    that holds no background, over the variance of its noise.

    Parameters
    ----------
    seen : Film
        Derivatives.
    warm : ndarray, shape (time, pixel)
        Object temperature [K].
    functions : ndarray, shape (time, order)
        Smooth functions to choose from.

    Returns
    -------
    ndarray of int, shape (pixel,)
        Number of functions; one more than there are where none suffices.
    """
    sensitivity = np.einsum("itp,ijtp,jtp->tp", seen.emission, seen.weight(), seen.emission)
    order = np.full(warm.shape[1], functions.shape[1] + 1)
    left = warm.copy()
    for count, function in enumerate(functions.T, start=1):
        left -= np.outer(function, function @ left)
        enough = np.sum(sensitivity * left**2, axis=0) <= REMAINDER
        order[enough & (order > count)] = count
    return order


@dataclass(frozen=True)
class Spread:
    """
    Inverse of Fisher informations, which may be singular, in factors.

    Attributes
    ----------
    scale : ndarray, shape (pixel, unknown)
        Deviation of each unknown, were it the only one, the background included.
    directions : ndarray, shape (pixel, unknown, direction)
        Principal directions of the information about the unknowns in units of `scale`.
    information : ndarray, shape (pixel, direction)
        Information along them [1]; what is at most 1e-12 is rounding.
    """

    scale: Array
    directions: Array
    information: Array

    def variance(self, gradient: Array) -> Array:
        """
        Smallest variance of quantities that depend on the unknowns.

        Parameters
        ----------
        gradient : ndarray, shape (pixel or 1, quantity, unknown)
            Derivative of each quantity with the unknowns.

        Returns
        -------
        ndarray, shape (pixel, quantity)
            Variance; infinite where the quantity depends on a direction without information.
        """
        along = ((gradient * self.scale[:, np.newaxis]) @ self.directions) ** 2
        blind = self.information <= _BLIND
        lost = along @ blind[..., np.newaxis] > _TOUCHED * along.sum(axis=-1, keepdims=True)
        inverse = np.divide(1.0, self.information, out=np.zeros_like(blind, float), where=~blind)
        return np.where(lost, np.inf, along @ inverse[..., np.newaxis])[..., 0]


def spread(seen: Film, functions: Array, prior: float = 0.0) -> Spread:
    """
    Information about emissivities, object and resting level, the free background eliminated.

    Parameters
    ----------
    seen : Film
        Derivatives.
    functions : ndarray, shape (time, order)
        Smooth subspace of the object.
    prior : float
        Information about each emissivity from elsewhere, one over its variance [1].

    Returns
    -------
    Spread
        Its inverse. The unknowns follow one another: the emissivities (band), the object's
        coefficients (order) [K], the resting level [K].
    """
    rest = seen.reflection * seen.resting
    left = np.einsum("ijtp,jtp->itp", seen.weight(), seen.emission)
    of_emissivity = np.einsum("itp,ijtp,jtp->pij", seen.contrast, seen.weight(), seen.contrast)
    of_emissivity = of_emissivity + prior * np.eye(len(seen.contrast))
    of_both = np.einsum("itp,tk->pik", seen.contrast * left, functions)
    products = functions[:, :, np.newaxis] * functions[:, np.newaxis]
    of_object = np.einsum("tp,tkl->pkl", np.sum(seen.emission * left, axis=0), products)
    level_emissivity = np.einsum("itp,itp->pi", seen.contrast, rest)[..., np.newaxis]
    level_object = np.einsum("tp,tk->pk", np.sum(seen.emission * rest, axis=0), functions)
    level = np.sum(rest**2, axis=(0, 1))[:, np.newaxis, np.newaxis]
    column = np.concatenate([level_emissivity, level_object[..., np.newaxis]], axis=1)
    upper = np.concatenate([of_emissivity, of_both], axis=2)
    lower = np.concatenate([np.swapaxes(of_both, 1, 2), of_object], axis=2)
    block = np.concatenate([np.concatenate([upper, lower], axis=1), column], axis=2)
    row = np.concatenate([np.swapaxes(column, 1, 2), level], axis=2)
    scale = _alone(seen, functions, rest, prior)
    information = np.concatenate([block, row], axis=1)
    scaled = information * scale[:, np.newaxis] * scale[..., np.newaxis]
    values, directions = np.linalg.eigh(scaled)
    return Spread(scale, directions, values)


def _alone(seen: Film, functions: Array, rest: Array, prior: float) -> Array:
    """Deviation (pixel, unknown) of each unknown, were it the only one; 1 where nothing tells."""
    parts = [
        np.sum(seen.contrast**2, axis=1).T + prior,
        np.sum(seen.emission**2, axis=0).T @ functions**2,
        np.sum(rest**2, axis=(0, 1))[:, np.newaxis],
    ]
    energy = np.concatenate(parts, axis=1)
    inverse = np.divide(1.0, energy, out=np.ones_like(energy), where=energy > 0)
    return np.asarray(np.sqrt(inverse))
