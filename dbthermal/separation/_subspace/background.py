"""The background of one tile, given the object and the emissivities."""

import numpy as np

from dbthermal.separation._subspace.emission import Emission
from dbthermal.separation._subspace.reflection_ratio import Direction
from dbthermal.separation._tiles import Array, Tile


def estimate(tile: Tile, emission: Emission, found: Direction) -> tuple[Array, Array]:
    r"""
    Background temperature from all bands, weighted by their noise.

    Its variance comes from the noise, the direction, the smoothed object and the first
    emissivity's own variance: with :math:`\epsilon` of `Emission`,

    .. math:: \delta y = (y - x) \left( s_1 \delta v_1 - e_1 \epsilon
              + \frac{\delta o}{1 - e_1} \right) - r \, \delta x

    where r is the weighted mean of :math:`e_m / (1 - e_m)` and :math:`v = \kappa / s`.

    Parameters
    ----------
    tile : Tile
        The tile.
    emission : Emission
        Object and emissivities.
    found : Direction
        Direction of the reflection.

    Returns
    -------
    tuple of ndarray, shape (time, pixel)
        Background temperature [K], NaN where none gives such a signal, and its variance [K^2].
    """
    bands = range(len(tile.noise))
    noise = np.array(tile.noise)[:, np.newaxis]
    reflectivity = 1.0 - emission.emissivity
    precision = (reflectivity / noise) ** 2
    total = precision.sum(axis=0)
    weights = precision / total
    reflected = [
        (tile.signals[m] - emission.emissivity[m] * tile.blackbody(m, emission.temperature))
        / reflectivity[m]
        for m in bands
    ]
    # Start from the mean signal, then one Gauss-Newton step on the exact responses.
    start = tile.temperature(0, np.asarray(sum(weights[m] * reflected[m] for m in bands)))
    slopes = [curve.slope(start) for curve in tile.curves]
    curvature = sum(weights[m] * slopes[m] ** 2 for m in bands)
    step = sum(weights[m] * slopes[m] * (reflected[m] - tile.blackbody(m, start)) for m in bands)
    background = start + step / curvature
    first, first_noise = emission.emissivity[0], tile.noise[0]
    emitted = (weights * emission.emissivity / reflectivity).sum(axis=0)
    contrast = background - emission.temperature
    through = contrast * first + emitted * emission.per_direction
    of_first = first_noise**2 - 1.0 / ((found.ratio / noise) ** 2).sum(axis=0)
    own = (emission.own_variance + emission.common_variance) / (1.0 - first) ** 2
    common = 2.0 * first_noise**2 * found.weights[0] * found.spread
    variance = 1.0 / (total * curvature) + emitted**2 * emission.smooth_variance
    variance += through * (through * (found.across * found.spread) - contrast * common)
    variance += contrast**2 * (of_first * found.spread + own)
    return background, np.asarray(variance)


def bend(tile: Tile, emission: Emission, background: Array) -> Array:
    r"""
    What the responses' differences add to the reflections of the bands but the first.

    .. math:: (1 - e_m) \, (u_m(y) - u_1(y))

    Taken from band m, it leaves the same signal :math:`u_1(y)` reflected in all, so that the
    reflection ratios are one number for small and large changes of the background.

    Parameters
    ----------
    tile : Tile
        The tile.
    emission : Emission
        Object and emissivities.
    background : ndarray, shape (time, pixel)
        Background temperature [K].

    Returns
    -------
    ndarray, shape (band - 1, time, pixel)
        Signal [K]; zero where a background or an emissivity is not physical.
    """
    first = tile.blackbody(0, background)
    signal = np.stack(
        [
            (1.0 - emission.emissivity[m]) * (tile.blackbody(m, background) - first)
            for m in range(1, len(tile.noise))
        ]
    )
    physical = np.all((emission.emissivity > 0) & (emission.emissivity < 1), axis=0)
    physical &= np.all(np.isfinite(signal), axis=(0, 1))
    return np.where(physical, signal, 0.0)
