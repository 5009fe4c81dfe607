"""Background temperature of one tile, given its object and emissivities: step 4 of `method`."""

import numpy as np

from dbthermal import mixing
from dbthermal._arrays import like, namespace
from dbthermal.separation._subspace.emission import Emission, weighted
from dbthermal.separation._subspace.reflection_ratio import ReflectionRatio
from dbthermal.separation._tiles import Array, Tile


def estimate(tile: Tile, emission: Emission, ratios: ReflectionRatio) -> tuple[Array, Array]:
    r"""
    Background temperature (time, pixel) [K] from all bands, and its variance [K^2] (eq. 9, 10).

    The bands are weighted by their noise; NaN where no temperature gives the signal. The variance
    comes from the noise, the ratios, the smoothed object and the first emissivity's own variance,

    .. math:: \delta y = (y - x) \left( s_1 \delta v_1 - e_1 \epsilon
              + \frac{\delta o}{1 - e_1} \right) - r \, \delta x

    where r is the weighted mean of :math:`e_m / (1 - e_m)` and :math:`v = \kappa / s`.
    """
    bands = range(len(tile.noise))
    noise = like(tile.noise, tile.signals)[:, np.newaxis]
    reflectivity = 1.0 - emission.emissivity
    precision = (reflectivity / noise) ** 2
    total = precision.sum(axis=0)
    weights = precision / total
    reflected = [
        mixing.background(
            emission.emissivity[m], tile.signals[m], tile.blackbody(m, emission.temperature)
        )
        for m in bands
    ]
    # Start from the mean signal, then one Gauss-Newton step of eq. 9 on the exact responses.
    start = tile.temperature(0, weighted(reflected, weights))
    slopes = [curve.slope(start) for curve in tile.curves]
    curvature = sum(weights[m] * slopes[m] ** 2 for m in bands)
    step = sum(weights[m] * slopes[m] * (reflected[m] - tile.blackbody(m, start)) for m in bands)
    background = start + step / curvature
    # Eq. 10, term by term: through epsilon, (y - x) e_1 + r dx/deps; its covariance with v_1,
    # w_1 s_1^2 sigma^2; and the variance of s_1 v_1, (s_1^2 - 1 / |v|^2) sigma^2.
    first, first_noise = emission.emissivity[0], tile.noise[0]
    object_share = (weights * emission.emissivity / reflectivity).sum(axis=0)
    contrast = background - emission.temperature
    through = contrast * first + object_share * emission.sensitivity
    covariance = 2.0 * first_noise**2 * ratios.null_weights[0] * ratios.inverse_energy
    of_first = first_noise**2 - 1.0 / ((ratios.ratio / noise) ** 2).sum(axis=0)
    slope = (emission.noise_variance + emission.drift_variance) / (1.0 - first) ** 2
    variance = 1.0 / (total * curvature) + object_share**2 * emission.smooth_variance
    variance += through * (through * emission.epsilon_variance - contrast * covariance)
    variance += contrast**2 * (of_first * ratios.inverse_energy + slope)
    return background, variance


def pattern_variances(
    tile: Tile, emission: Emission, ratios: ReflectionRatio, background: Array
) -> tuple[Array | float, Array | float]:
    r"""
    Variances (time, pixel) [K^2] of object and background from a residual fixed pattern.

    An offset :math:`\delta_m` of each band, constant in time, is no slope and no rapid change: the
    emissivities are free of it. With the weights g of the bands in the background,

    .. math:: \delta x = \frac{1}{h'} \sum w_m \delta_m, \quad
              u' \delta y = \sum g_m \frac{\delta_m - e_m u_m' \delta x}{1 - e_m}
    """
    if tile.pattern is None:
        return 0.0, 0.0
    emitted = [
        share * curve.slope(emission.temperature)
        for share, curve in zip(emission.emissivity, tile.curves, strict=True)
    ]
    steepness, slope = weighted(emitted, ratios.null_weights), tile.curves[0].slope(background)
    reflectivity = 1.0 - emission.emissivity
    precision = (reflectivity / like(tile.noise, tile.signals)[:, np.newaxis]) ** 2
    direct = precision / precision.sum(axis=0) / reflectivity
    through = weighted(emitted, direct)
    of_object = of_background = 0.0
    for std, weight, share in zip(tile.pattern, ratios.null_weights, direct, strict=True):
        part = weight / steepness
        of_object = of_object + (std * part) ** 2
        of_background = of_background + (std * (share - through * part) / slope) ** 2
    return of_object, of_background


def bend(tile: Tile, emission: Emission, background: Array) -> Array:
    r"""
    Part of the reflections (band - 1, time, pixel) [K] that the responses bend apart (eq. 11).

    :math:`(1 - e_m) \, (u_m(y) - u_1(y))`: taken from band m, it leaves the same signal
    :math:`u_1(y)` reflected in all, so that the reflection ratios are one number for small and
    large changes of the background. Zero where a background or an emissivity is not physical.
    """
    xp, first = namespace(background), tile.blackbody(0, background)
    signal = xp.stack(
        [
            (1.0 - emission.emissivity[m]) * (tile.blackbody(m, background) - first)
            for m in range(1, len(tile.noise))
        ]
    )
    physical = xp.all((emission.emissivity > 0) & (emission.emissivity < 1), axis=0)
    physical &= xp.all(xp.isfinite(signal), axis=(0, 1))
    return xp.where(physical, signal, 0.0)
