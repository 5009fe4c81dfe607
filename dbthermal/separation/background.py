"""The background of one tile, given the object and the emissivities."""

import numpy as np

from dbthermal.separation.direction import Direction
from dbthermal.separation.emission import Emission
from dbthermal.separation.problem import Array, Problem


def estimate(problem: Problem, emission: Emission, found: Direction) -> tuple[Array, Array]:
    """
    Background temperature from both bands, weighted by their noise.

    Parameters
    ----------
    problem : Problem
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
    reflectivity = 1.0 - emission.emissivity
    weights = (reflectivity / np.array(problem.noise)[:, np.newaxis]) ** 2
    total = weights.sum(axis=0)
    weights = weights / total
    reflected = [
        (problem.signals[m] - emission.emissivity[m] * problem.blackbody(m, emission.temperature))
        / reflectivity[m]
        for m in (0, 1)
    ]
    # Start from the mean signal, then one Gauss-Newton step on the two exact responses.
    start = problem.temperature(0, weights[0] * reflected[0] + weights[1] * reflected[1])
    slopes = [curve.slope(start) for curve in problem.curves]
    curvature = weights[0] * slopes[0] ** 2 + weights[1] * slopes[1] ** 2
    step = sum(
        weights[m] * slopes[m] * (reflected[m] - problem.blackbody(m, start)) for m in (0, 1)
    )
    background = start + step / curvature
    own = (weights * emission.emissivity / reflectivity).sum(axis=0)
    contrast = background - emission.temperature
    through_emissivity = (weights / reflectivity * emission.emissivity_per_ratio).sum(axis=0)
    per_ratio = contrast * through_emissivity - own * emission.per_ratio
    per_emissivity = contrast * (weights / reflectivity * [np.ones_like(own), found.ratio]).sum(
        axis=0
    )
    variance = (
        1.0 / (total * curvature)
        + per_ratio**2 * found.variance
        + own**2 * emission.smooth_variance
        + per_emissivity**2 * emission.own_variance
    )
    return background, variance


def bend(problem: Problem, emission: Emission, background: Array) -> Array:
    r"""
    What the two responses' difference adds to the second band's reflection.

    .. math:: (1 - e_2) \, (u_2(y) - u_1(y))

    Taken from the second band, it leaves the same signal :math:`u_1(y)` reflected in both, so
    that the reflection ratio is one number for small and large changes of the background.

    Parameters
    ----------
    problem : Problem
        The tile.
    emission : Emission
        Object and emissivities.
    background : ndarray, shape (time, pixel)
        Background temperature [K].

    Returns
    -------
    ndarray, shape (time, pixel)
        Signal [K]; zero where a background or an emissivity is not physical.
    """
    gap = problem.blackbody(1, background) - problem.blackbody(0, background)
    signal = (1.0 - emission.emissivity[1]) * gap
    physical = np.all((emission.emissivity > 0) & (emission.emissivity < 1), axis=0)
    return np.where(physical & np.all(np.isfinite(signal), axis=0), signal, 0.0)
