r"""The subspace separator: closed forms for a smooth object before an abrupt background.

1. The direction of the rapid changes gives the reflection ratio :math:`k_2` (`direction`).
2. :math:`q = z_2 - k_2 z_1` holds no background. Smoothed in the subspace, it is inverted for the
   object temperature: :math:`h(x) = (1 - k_2) u_2(x) + k_2 e_1 (u_2(x) - u_1(x)) = q`.
3. The slope of a robust regression of :math:`z_1` on :math:`u_1(x)` is :math:`e_1`, if the
   background rests now and then; :math:`e_2 = 1 - k_2 (1 - e_1)`. Steps 2 and 3 alternate.
4. The background follows from both bands, weighted by their noise.

Every output carries a standard deviation, propagated from the noise. Second-order blind source
separation in the sense of Belouchrani et al. (1997), doi:10.1109/78.554307, for the image
formation of Narayanan et al. (2026), doi:10.48550/arXiv.2509.11334.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from dbthermal import smooth
from dbthermal.separation import direction, robust
from dbthermal.separation.problem import Array, Problem, Separated, flag, outside

_ROUNDS: Final = 2
# Thresholds of the flags, in standard deviations or as said.
_CONTRAST_SIGMAS: Final = 8.0
_MISFIT_SIGMAS: Final = 8.0
_GRAY_SIGMAS: Final = 3.0
_OBJECT_TO_NOISE: Final = 10.0
_WITHIN: Final = 3.0
_RESTING: Final = 0.3


@dataclass(frozen=True)
class _Fit:
    """Object and emissivity of one tile, with the derivatives that carry their uncertainty."""

    temperature: Array  # (time, pixel) [K]
    per_ratio: Array  # dx/dk2 (time, pixel) [K]
    smooth_variance: Array  # of x from the smoothed noise (time, pixel) [K^2]
    emissivity: Array  # (2, pixel)
    emissivity_per_ratio: Array  # de/dk2 (2, pixel)
    own_variance: Array  # of e1 other than by k2 (pixel)
    constant: npt.NDArray[np.bool_]
    restless: npt.NDArray[np.bool_]


def separate(problem: Problem) -> Separated:
    """
    Separate one tile.

    Parameters
    ----------
    problem : Problem
        Signals of two bands and what is known of them.

    Returns
    -------
    Separated
        Temperatures, emissivities, standard deviations and flags.
    """
    frames = problem.time.size
    functions = smooth.basis(problem.time, min(direction.HIGHEST_ORDER, frames // 4))
    found = direction.estimate(problem.signals, functions, problem.noise)
    freedom = frames - found.order
    still = found.contrast < 1.0 + _CONTRAST_SIGMAS / np.sqrt(frames)
    still |= ~np.isfinite(found.variance)
    gray = ~still & (np.abs(1.0 - found.ratio) < _GRAY_SIGMAS * np.sqrt(found.variance))
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        fit = _object(problem, functions, found)
        background, background_std = _background(problem, fit, found)
        variance = fit.per_ratio**2 * found.variance + fit.smooth_variance
        emissivity_std = np.sqrt(
            fit.emissivity_per_ratio**2 * found.variance
            + np.stack([fit.own_variance, found.ratio**2 * fit.own_variance])
        )
    undefined = still | gray
    unidentified = undefined | fit.constant
    nonphysical = ~unidentified & np.any((fit.emissivity <= 0) | (fit.emissivity >= 1), axis=0)
    std = np.where(undefined, np.nan, np.sqrt(variance))
    result = Separated(
        object_temperature=np.where(undefined, np.nan, fit.temperature),
        object_temperature_std=std,
        background_temperature=np.where(unidentified | nonphysical, np.nan, background),
        background_temperature_std=np.where(unidentified | nonphysical, np.nan, background_std),
        emissivity=np.where(unidentified, np.nan, fit.emissivity),
        emissivity_std=np.where(unidentified, np.nan, emissivity_std),
        status=flag(
            {
                "no_background_motion": still,
                "gray": gray,
                "constant_object": ~undefined & fit.constant,
                "background_never_rests": ~unidentified & fit.restless,
                "nonphysical_emissivity": nonphysical,
                "object_not_smooth": found.misfit > 1.0 + _MISFIT_SIGMAS * np.sqrt(2.0 / freedom),
            }
        ),
    )
    return _flag_outside(result, problem)


def _object(problem: Problem, functions: Array, found: direction.Direction) -> _Fit:
    """Alternate the object temperature and the emissivity, steps 2 and 3."""
    ratio, (first, second) = found.ratio, found.coefficients
    clean = functions @ (second - ratio * first)
    across = problem.noise[1] ** 2 + (ratio * problem.noise[0]) ** 2
    temperature = problem.temperature(1, clean / (1.0 - ratio))
    # What k2 leaves possible for e1; its middle serves where the object does not tell.
    middle = 0.5 * (1.0 + np.maximum(0.0, 1.0 - 1.0 / np.maximum(ratio, 1e-9)))
    # The robust line is sought on a curve that is right to second order, or it locks elsewhere.
    guess = robust.plain_slope(problem.blackbody(0, temperature), problem.signals[0])
    emissivity = np.where((guess > 0) & (guess < 1), guess, middle)
    temperature = _newton(problem, ratio, emissivity, clean, temperature)[0]
    line: robust.Line | None = None
    for _ in range(_ROUNDS):
        own = problem.blackbody(0, temperature)
        line = robust.regress(own, problem.signals[0], problem.noise[0], start=line)
        noise_energy = found.order * across / (1.0 - ratio) ** 2
        constant = line.spread < _OBJECT_TO_NOISE * noise_energy
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
    return _Fit(
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


def _background(problem: Problem, fit: _Fit, found: direction.Direction) -> tuple[Array, Array]:
    """Background temperature from both bands, weighted by their noise, and its deviation."""
    reflectivity = 1.0 - fit.emissivity
    weights = (reflectivity / np.array(problem.noise)[:, np.newaxis]) ** 2
    total = weights.sum(axis=0)
    weights = weights / total
    reflected = [
        (problem.signals[m] - fit.emissivity[m] * problem.blackbody(m, fit.temperature))
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
    own = (weights * fit.emissivity / reflectivity).sum(axis=0)
    contrast = background - fit.temperature
    through_emissivity = (weights / reflectivity * fit.emissivity_per_ratio).sum(axis=0)
    per_ratio = contrast * through_emissivity - own * fit.per_ratio
    per_emissivity = contrast * (weights / reflectivity * [np.ones_like(own), found.ratio]).sum(
        axis=0
    )
    variance = (
        1.0 / (total * curvature)
        + per_ratio**2 * found.variance
        + own**2 * fit.smooth_variance
        + per_emissivity**2 * fit.own_variance
    )
    return background, np.sqrt(variance)


def _flag_outside(result: Separated, problem: Problem) -> Separated:
    """Add the flag for temperatures outside the response's range."""
    curve = problem.curves[0]
    beyond = outside(result.object_temperature, result.object_temperature_std, curve)
    beyond |= outside(result.background_temperature, result.background_temperature_std, curve)
    result.status[...] |= flag({"outside_response": beyond})
    return result
