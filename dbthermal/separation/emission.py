"""The object and the emissivities of one tile, given the direction of the reflection."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from dbthermal import smooth
from dbthermal.separation import robust
from dbthermal.separation.direction import Direction
from dbthermal.separation.problem import Array, Problem

_ROUNDS: Final = 2
# Energy of the object's change over that of its noise, below which its emissivity is not told.
_OBJECT_TO_NOISE: Final = 10.0
# The background counts as resting within so many standard deviations, in that share of frames.
_WITHIN: Final = 3.0
_RESTING: Final = 0.3


@dataclass(frozen=True)
class Emission:
    """
    Object and emissivities, with the derivatives that carry their uncertainty.

    Attributes
    ----------
    temperature : ndarray, shape (time, pixel)
        Object temperature [K].
    per_ratio : ndarray, shape (time, pixel)
        Its derivative with the reflection ratio [K].
    smooth_variance : ndarray, shape (time, pixel)
        Its variance from the smoothed noise [K^2].
    emissivity, emissivity_per_ratio : ndarray, shape (2, pixel)
        Emissivities [1] and their derivatives with the ratio.
    own_variance : ndarray, shape (pixel,)
        Variance of the first emissivity that does not come from the ratio [1].
    constant, restless : ndarray of bool, shape (pixel,)
        Where the object does not change enough to tell the emissivity, and where the background
        hardly rests.
    """

    temperature: Array
    per_ratio: Array
    smooth_variance: Array
    emissivity: Array
    emissivity_per_ratio: Array
    own_variance: Array
    constant: npt.NDArray[np.bool_]
    restless: npt.NDArray[np.bool_]


def estimate(problem: Problem, functions: Array, found: Direction) -> Emission:
    """
    Alternate the object temperature and the emissivity, steps 2 and 3 of `subspace`.

    Parameters
    ----------
    problem : Problem
        The tile.
    functions : ndarray, shape (time, order)
        Smooth functions.
    found : Direction
        Direction of the reflection.

    Returns
    -------
    Emission
        Object and emissivities.
    """
    ratio, (first, second) = found.ratio, found.coefficients
    clean = functions @ (second - ratio * first)
    across = problem.noise[1] ** 2 + (ratio * problem.noise[0]) ** 2
    temperature = problem.temperature(1, clean / (1.0 - ratio))
    middle = _middle(ratio)
    # The robust line is sought on a curve that is right to second order, or it locks elsewhere.
    guess = robust.plain_slope(problem.blackbody(0, temperature), problem.signals[0])
    emissivity = np.where((guess > 0) & (guess < 1), guess, middle)
    temperature = _newton(problem, ratio, emissivity, clean, temperature)[0]
    line: robust.Line | None = None
    for _ in range(_ROUNDS):
        own = problem.blackbody(0, temperature)
        line = robust.regress(own, problem.signals[0], problem.noise[0], start=line)
        constant = line.spread < _OBJECT_TO_NOISE * found.order * across / (1.0 - ratio) ** 2
        emissivity = np.where(constant, middle, line.slope)
        temperature, steepness, emitted = _newton(problem, ratio, emissivity, clean, temperature)
    assert line is not None
    per_ratio = (emitted - functions @ first) / steepness
    smooth_variance = smooth.leverage(functions)[:, found.order - 1] * across / steepness**2
    expected = problem.noise[0] ** 2 + emissivity**2 * (
        per_ratio**2 * found.variance + smooth_variance
    )
    slope_per_ratio = -emissivity * (1.0 - emissivity) / (1.0 - ratio)
    through_fit = emissivity**2 * across / ((1.0 - ratio) ** 2 * line.spread)
    return Emission(
        temperature=temperature,
        per_ratio=per_ratio,
        smooth_variance=smooth_variance,
        emissivity=np.stack([emissivity, 1.0 - ratio * (1.0 - emissivity)]),
        emissivity_per_ratio=np.stack(
            [slope_per_ratio, emissivity - 1.0 + ratio * slope_per_ratio]
        ),
        own_variance=line.variance + through_fit,
        constant=constant,
        restless=np.mean(line.residual**2 < _WITHIN**2 * expected, axis=0) < _RESTING,
    )


def _middle(ratio: Array) -> Array:
    """Middle of what k2 leaves possible for e1, for where the object does not tell."""
    lowest = np.zeros_like(ratio)
    np.divide(ratio - 1.0, ratio, out=lowest, where=ratio > 1.0)
    return np.asarray(0.5 * (1.0 + lowest))


def _newton(
    problem: Problem, ratio: Array, emissivity: Array, clean: Array, temperature: Array
) -> tuple[Array, Array, Array]:
    """One step towards h(x) = q: the new x, h'(x), and -dh/dk2 at the old x."""
    own, other = (problem.blackbody(band, temperature) for band in (0, 1))
    slopes = [curve.slope(temperature) for curve in problem.curves]
    emitted = other - emissivity * (other - own)
    steepness = (1.0 - ratio) * slopes[1] + ratio * emissivity * (slopes[1] - slopes[0])
    value = other - ratio * emitted
    return temperature + (clean - value) / steepness, steepness, emitted
