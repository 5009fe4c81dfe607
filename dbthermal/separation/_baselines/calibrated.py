r"""Separation with known emissivities: two equations in two temperatures, frame by frame.

.. math:: z_m = e_m u_m(x) + (1 - e_m) u_m(y), \quad m = 1, 2 \qquad (1)

is solved for x and y by Newton's method from the linear closed form of Narayanan et al. (2026),
equation 12, doi:10.48550/arXiv.2509.11334. No prior in time: each frame stands alone, so the noise
is the price.
"""

from typing import Final

import numpy as np

from dbthermal import mixing
from dbthermal.schema import Status
from dbthermal.separation._inputs import Method
from dbthermal.separation._quality import status_bits
from dbthermal.separation._tiles import Array, Estimate, Tile

_STEPS: Final = 5
# Largest last step of a sample that is solved [K].
_CONVERGED: Final = 1e-3
# Bands that differ by less are gray, by so many standard deviations or by rounding.
_GRAY_SIGMAS: Final = 4.0
_LEAST_DIFFERENCE: Final = 1e-6


def separate(tile: Tile) -> Estimate:
    """Temperatures with their standard deviations, at the known emissivities (2, pixel)."""
    if tile.emissivity is None:
        raise ValueError("Missing emissivity. Method 'calibrated' must be given one.")
    emissivity = tile.emissivity
    covariance = np.zeros((2, *emissivity.shape))
    if tile.emissivity_covariance is not None:
        covariance = tile.emissivity_covariance
    (first, both), (_, second) = covariance
    noise = (tile.noise[0], tile.noise[1])
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        temperatures, last_step = _newton(tile, emissivity)
        jacobian = _jacobian(tile, emissivity, temperatures)
        stds = np.sqrt(temperature_variance(jacobian, noise, temperatures, covariance))
    # var(e_1 - e_2); rounding may leave less than nothing of it.
    spread = np.sqrt(np.maximum(first + second - 2.0 * both, 0.0))
    least = np.maximum(_LEAST_DIFFERENCE, _GRAY_SIGMAS * spread)
    gray = np.abs(emissivity[0] - emissivity[1]) <= least
    solved = np.all(np.abs(last_step) < _CONVERGED, axis=(0, 1))
    solved &= np.all(np.isfinite(stds), axis=(0, 1))
    undefined = gray | ~solved
    return (
        Estimate(
            object_temperature=temperatures[0],
            object_temperature_std=stds[0],
            background_temperature=temperatures[1],
            background_temperature_std=stds[1],
            emissivity=emissivity,
            emissivity_std=np.sqrt(np.stack([first, second])),
            status=status_bits({Status.GRAY: gray, Status.OUTSIDE_RESPONSE: ~solved & ~gray}),
        )
        .undefine(undefined, np.zeros_like(gray), undefined)
        .check_range(tile.curves[0])
    )


def temperature_variance(
    jacobian: Array, noise: tuple[float, float], temperatures: Array, covariance: Array
) -> Array:
    r"""
    Variance (2, ...) of object and background [K^2] of a single frame; the Cramer-Rao bound.

    From the derivatives (band, 2, ...) of the signals with the two temperatures (2, ...) [K], the
    noise of the signals [K] and the covariance (2, 2, ...) of the emissivities [1]. For slopes 1

    .. math:: \mathrm{var}(x) = [(1-e_2)^2 s_1^2 + (1-e_1)^2 s_2^2] / (e_1-e_2)^2, \quad
              \mathrm{var}(y) = [e_2^2 s_1^2 + e_1^2 s_2^2] / (e_1-e_2)^2 \qquad (2)
    """
    # An uncertain emissivity is a noise of dz/de = u(x) - u(y): s_m^2 + (x - y)^2 var(e_m).
    squared = (temperatures[0] - temperatures[1]) ** 2
    first, second = (noise[m] ** 2 + squared * covariance[m, m] for m in range(2))
    both = squared * covariance[0, 1]
    # var = J^-1 C J^-T, with J^-1 = ((d, -b), (-c, a)) / det J.
    ((a, b), (c, d)) = jacobian
    determinant = a * d - b * c
    energy = np.stack(
        [
            d**2 * first + b**2 * second - 2.0 * b * d * both,
            c**2 * first + a**2 * second - 2.0 * a * c * both,
        ]
    )
    return np.asarray(energy / determinant**2)


def _newton(tile: Tile, emissivity: Array) -> tuple[Array, Array]:
    """Object and background temperature (2, time, pixel) [K], and the last change of both."""
    temperatures = _invert(_weights(emissivity), tile.signals) + tile.reference
    step = np.zeros_like(temperatures)
    for _ in range(_STEPS):
        residual = tile.signals - tile.mixed(emissivity, temperatures)
        step = _invert(_jacobian(tile, emissivity, temperatures), residual)
        temperatures = temperatures + step
    return np.asarray(temperatures), step


def _weights(emissivity: Array) -> Array:
    """Mixing matrix (band, 2, 1, pixel): weights of object and background."""
    return np.moveaxis(mixing.matrix(emissivity), -1, 1)[:, :, np.newaxis]


def _jacobian(tile: Tile, emissivity: Array, temperatures: Array) -> Array:
    """Derivative (band, 2, time, pixel) of equation (1) with the two temperatures [1]."""
    slopes = np.stack([curve.slope(temperatures) for curve in tile.curves])
    return np.asarray(_weights(emissivity) * slopes)


def _invert(matrix: Array, signals: Array) -> Array:
    """Solve the two-by-two system of every sample."""
    ((a, b), (c, d)) = matrix
    determinant = a * d - b * c
    first, second = signals
    return np.asarray(np.stack([d * first - b * second, a * second - c * first]) / determinant)


METHOD: Final = Method(separate, knows_emissivity=True)
"""The closed form for known emissivities, for `solve`."""
