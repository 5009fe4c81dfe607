"""The object and the emissivities of one tile, given the direction of the reflection."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from dbthermal import _smooth as smooth
from dbthermal.separation._subspace import drift_prior as slow
from dbthermal.separation._subspace import regression as robust
from dbthermal.separation._subspace.reflection_ratio import Direction, ratio_variance
from dbthermal.separation._tiles import Array, Tile

_ROUNDS: Final = 2
# Energy of the object's change over that of its noise, below which its emissivity is not told.
_OBJECT_TO_NOISE: Final = 10.0
# The background counts as resting within so many standard deviations, in that share of frames.
_WITHIN: Final = 3.0
_RESTING: Final = 0.3


@dataclass(frozen=True)
class Emission:
    r"""
    Object and emissivities, with the derivatives that carry their uncertainty.

    The direction's error enters the object through one number, the error :math:`\epsilon` of
    :math:`w \cdot \kappa`, of variance :math:`\sigma^2 \, \mathrm{across}`.

    Attributes
    ----------
    temperature : ndarray, shape (time, pixel)
        Object temperature [K].
    per_direction : ndarray, shape (time, pixel)
        Its derivative with :math:`\epsilon` [K].
    smooth_variance : ndarray, shape (time, pixel)
        Its variance from the smoothed noise [K^2].
    emissivity : ndarray, shape (band, pixel)
        Emissivities [1].
    own_variance, common_variance : ndarray, shape (pixel,)
        Variances of the first emissivity that do not come from the direction: from the noise of
        the regression, and from the background's slow part [1].
    constant, restless : ndarray of bool, shape (pixel,)
        Where the object does not change enough to tell the emissivity, and where the background
        hardly rests.
    """

    temperature: Array
    per_direction: Array
    smooth_variance: Array
    emissivity: Array
    own_variance: Array
    common_variance: Array
    constant: npt.NDArray[np.bool_]
    restless: npt.NDArray[np.bool_]


def estimate(
    tile: Tile, functions: smooth.Subspace, found: Direction, prior: slow.Prior
) -> Emission:
    """
    Alternate the object temperature and the emissivity, steps 2 and 3 of `subspace`.

    Parameters
    ----------
    tile : Tile
        The tile.
    functions : Subspace
        Smooth functions.
    found : Direction
        Direction of the reflection.
    prior : Prior
        What is assumed of the background's slow part.

    Returns
    -------
    Emission
        Object and emissivities.
    """
    smoothed = np.einsum("bp,bcp->cp", found.weights, found.coefficients)
    clean = functions.own @ smoothed
    temperature = tile.temperature(1, clean)
    middle = _middle(found.ratio)
    # The robust line is sought on a curve that is right to second order, or it locks elsewhere.
    guess = robust.plain_slope(tile.blackbody(0, temperature), tile.signals[0])
    emissivity = np.where((guess > 0) & (guess < 1), guess, middle)
    temperature = _newton(tile, found, emissivity, clean, temperature)[0]
    line: robust.Line | None = None
    for _ in range(_ROUNDS):
        own = tile.blackbody(0, temperature)
        line = robust.regress(own, tile.signals[0], tile.noise[0], start=line)
        constant = line.spread < _OBJECT_TO_NOISE * found.order * found.across
        emissivity = np.where(constant, middle, line.slope)
        if tile.material is not None:
            given = found.given & np.isfinite(tile.material.emissivity)
            constant = constant & ~given
            emissivity = np.where(given, tile.material.emissivity, emissivity)
        temperature, steepness, emitted = _newton(tile, found, emissivity, clean, temperature)
    assert line is not None
    per_direction = (emitted - functions.own @ found.coefficients[0]) / steepness
    leverage = functions.leverage()[:, found.order - 1]
    smooth_variance = leverage * found.across / steepness**2
    # What the criterion for the order leaves of the object's curve is as large as the noise that
    # one more function would have cost, log N times.
    left_out = smooth_variance * np.log(tile.time.size) / found.order
    expected = tile.noise[0] ** 2 + emissivity**2 * (
        per_direction**2 * found.spread * found.across + smooth_variance + left_out
    )
    own_variance = line.variance + emissivity**2 * found.across / line.spread
    drifting = slow.variance(line, own, 1.0 - emissivity, functions, tile.noise[0], prior)
    if tile.material is not None:
        given = found.given & np.isfinite(tile.material.emissivity)
        own_variance = np.where(given, tile.material.noise_variance, own_variance)
        drifting = np.where(given, tile.material.drift_variance, drifting)
    return Emission(
        temperature=temperature,
        per_direction=per_direction,
        smooth_variance=smooth_variance,
        emissivity=1.0 - found.ratio * (1.0 - emissivity),
        own_variance=own_variance,
        common_variance=drifting,
        constant=constant,
        restless=np.mean(line.residual**2 < _WITHIN**2 * expected, axis=0) < _RESTING,
    )


def variance(found: Direction, fit: Emission, noise: Array) -> Array:
    r"""
    Variance of the emissivities, from the direction and from the first one's own variance.

    .. math:: \delta e_1 = -e_1 (1 - e_1) \epsilon + \delta o, \quad
              \delta e_m = \kappa_m \delta e_1 - (1 - e_1) \delta \kappa_m

    Parameters
    ----------
    found : Direction
        Direction of the reflection.
    fit : Emission
        Emissivities and the first one's own variance.
    noise : ndarray, shape (band,)
        Noise of the bands [K].

    Returns
    -------
    ndarray, shape (band, pixel)
        Variance [1].
    """
    ratio, first = found.ratio, fit.emissivity[0]
    dark, squares = 1.0 - first, (noise**2)[:, np.newaxis]
    # Covariance of the ratios with epsilon, over the direction's variance.
    common = squares * found.weights - ratio * squares[0] * found.weights[0]
    common[0] = 0.0
    through = (ratio * first * dark) ** 2 * found.across + 2.0 * ratio * first * dark**2 * common
    own = ratio**2 * (fit.own_variance + fit.common_variance)
    return np.asarray(own + through * found.spread + dark**2 * ratio_variance(found, noise))


def _middle(ratio: Array) -> Array:
    """Middle of what the ratios leave possible for e1, for where the object does not tell."""
    largest = ratio.max(axis=0)
    lowest = np.zeros_like(largest)
    np.divide(largest - 1.0, largest, out=lowest, where=largest > 1.0)
    return np.asarray(0.5 * (1.0 + lowest))


def _newton(
    tile: Tile, found: Direction, emissivity: Array, clean: Array, temperature: Array
) -> tuple[Array, Array, Array]:
    r"""
    One step towards the object, :math:`h(x) = \sum w_m e_m u_m(x) = q`.

    Returns the new x, h'(x), and what the first band holds of :math:`\partial h / \partial
    \epsilon` beside its own signal, at the old x.
    """
    factors = found.weights * (1.0 - found.ratio * (1.0 - emissivity))
    own = [tile.blackbody(band, temperature) for band in range(len(factors))]
    slopes = [curve.slope(temperature) for curve in tile.curves]
    value, steepness = _weighted(own, factors), _weighted(slopes, factors)
    other = own[1] if len(own) == 2 else _weighted(own[1:], _shares(found, tile.noise))
    emitted = other - emissivity * (other - own[0])
    return temperature + (clean - value) / steepness, steepness, np.asarray(emitted)


def _weighted(parts: list[Array], weights: Array) -> Array:
    """Sum over the bands of (time, pixel), weighted by (band, pixel)."""
    total = parts[0] * weights[0]
    for part, weight in zip(parts[1:], weights[1:], strict=True):
        total += part * weight
    return np.asarray(total)


def _shares(found: Direction, noise: tuple[float, ...]) -> Array:
    """Share (band - 1, pixel) of the ratios but the first in the variance of epsilon."""
    squares = (np.array(noise) ** 2)[:, np.newaxis]
    parts = (found.weights**2 * (squares + found.ratio**2 * squares[0]))[1:]
    return np.asarray(parts / parts.sum(axis=0))
