r"""Separation with known emissivities: two equations in two temperatures, frame by frame.

For each frame :math:`z_m = e_m u_m(x) + (1 - e_m) u_m(y)`, m = 1, 2, is solved for x and y by
Newton's method from the linear closed form of Narayanan et al. (2026), equation 12,
doi:10.48550/arXiv.2509.11334. No prior in time: each frame stands alone, so the noise is the
price; see `limits.calibrated_variance`.
"""

from typing import Final

import numpy as np

from dbthermal import limits
from dbthermal.schema import Status
from dbthermal.separation._quality import status_bits
from dbthermal.separation._tiles import Array, Estimate, Method, Tile

_STEPS: Final = 5
# Largest last step of a sample that is solved [K].
_CONVERGED: Final = 1e-3
# Bands that differ by less are gray, by so many standard deviations or by rounding.
_GRAY_SIGMAS: Final = 4.0
_LEAST_DIFFERENCE: Final = 1e-6


def separate(tile: Tile) -> Estimate:
    """
    Separate one tile, given its emissivities.

    Parameters
    ----------
    tile : Tile
        Signals, and `emissivity` (2, pixel) in (0, 1), different in the two bands.

    Returns
    -------
    Estimate
        Temperatures with their standard deviations; the emissivities as given.

    Raises
    ------
    ValueError
        If the tile has no emissivity.
    """
    if tile.emissivity is None:
        raise ValueError("Missing emissivity. Method 'calibrated' must be given one.")
    emissivity = tile.emissivity
    emissivity_std = (
        np.zeros_like(emissivity) if tile.emissivity_std is None else tile.emissivity_std
    )
    noise = (tile.noise[0], tile.noise[1])
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        temperatures, last_step = _newton(tile, emissivity)
        mixing = _mixing(tile, emissivity, temperatures)
        variances = limits.calibrated_variance(mixing, noise, temperatures, emissivity_std)
        stds = np.sqrt(variances)
    apart = np.maximum(_LEAST_DIFFERENCE, _GRAY_SIGMAS * np.hypot(*emissivity_std))
    gray = np.abs(emissivity[0] - emissivity[1]) <= apart
    solved = np.all(np.abs(last_step) < _CONVERGED, axis=(0, 1))
    solved &= np.all(np.isfinite(stds), axis=(0, 1))
    undefined = gray | ~solved
    none = np.zeros_like(gray)
    return (
        Estimate(
            object_temperature=temperatures[0],
            object_temperature_std=stds[0],
            background_temperature=temperatures[1],
            background_temperature_std=stds[1],
            emissivity=emissivity,
            emissivity_std=emissivity_std,
            status=status_bits({Status.GRAY: gray, Status.OUTSIDE_RESPONSE: ~solved & ~gray}),
        )
        .undefine(undefined, none, undefined)
        .check_range(tile.curves[0])
    )


def _newton(tile: Tile, emissivity: Array) -> tuple[Array, Array]:
    """Object and background temperature, (2, time, pixel), and the last change of both."""
    weights = np.stack([emissivity, 1.0 - emissivity], axis=1)[:, :, np.newaxis]
    temperatures = _invert(weights, tile.signals) + tile.reference
    step = np.zeros_like(temperatures)
    for _ in range(_STEPS):
        residual = tile.signals - np.stack(
            [(weights[m] * tile.blackbody(m, temperatures)).sum(axis=0) for m in (0, 1)]
        )
        step = _invert(_mixing(tile, emissivity, temperatures), residual)
        temperatures = temperatures + step
    return np.asarray(temperatures), step


def _mixing(tile: Tile, emissivity: Array, temperatures: Array) -> Array:
    """Derivative of the signals with the two temperatures, (band, 2, time, pixel)."""
    weights = np.stack([emissivity, 1.0 - emissivity], axis=1)[:, :, np.newaxis]
    slopes = np.stack([curve.slope(temperatures) for curve in tile.curves])
    return np.asarray(weights * slopes)


def _invert(mixing: Array, signals: Array) -> Array:
    """Solve the two-by-two system of every sample."""
    ((a, b), (c, d)) = mixing
    determinant = a * d - b * c
    first, second = signals
    return np.asarray(np.stack([d * first - b * second, a * second - c * first]) / determinant)


METHOD: Final = Method(separate, knows_emissivity=True)
"""The closed form for known emissivities, for `solve`."""
