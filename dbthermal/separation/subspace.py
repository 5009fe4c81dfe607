r"""The subspace separator: closed forms for a smooth object before an abrupt background.

1. The direction of the rapid changes gives the reflection ratio :math:`k_2` (`direction`).
2. :math:`q = z_2 - k_2 z_1` holds no background. Smoothed in the subspace, it is inverted for the
   object temperature: :math:`h(x) = (1 - k_2) u_2(x) + k_2 e_1 (u_2(x) - u_1(x)) = q`.
3. The slope of a robust regression of :math:`z_1` on :math:`u_1(x)` is :math:`e_1`, if the
   background rests now and then; :math:`e_2 = 1 - k_2 (1 - e_1)`. Steps 2 and 3 alternate
   (`emission`).
4. The background follows from both bands, weighted by their noise (`background`). Where it changes
   by many kelvins its two signals are no longer proportional: what bends them apart is taken out
   of the second band, and steps 1 to 4 are done again.

Every output carries a standard deviation, propagated from the noise. Second-order blind source
separation in the sense of Belouchrani et al. (1997), doi:10.1109/78.554307, for the image
formation of Narayanan et al. (2026), doi:10.48550/arXiv.2509.11334.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from dbthermal import smooth
from dbthermal.separation import background, direction, emission
from dbthermal.separation.problem import Array, Method, Problem, Separated, flag

# Thresholds of the flags, in standard deviations.
_CONTRAST_SIGMAS: Final = 8.0
_MISFIT_SIGMAS: Final = 8.0
_MEMORY_SIGMAS: Final = 3.5
_GRAY_SIGMAS: Final = 4.0
# Energy of the bend between the two responses, in units of the second band's noise, from which it
# is worth taking out: it moves no linear function of the signal by more standard deviations.
_BEND: Final = 0.2


@dataclass(frozen=True)
class _Estimate:
    """Everything that one pass over a tile finds."""

    found: direction.Direction
    emission: emission.Emission
    background: Array
    background_variance: Array
    memory: Array


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
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        estimate = _pass(problem, problem, functions)
        result = _report(problem, estimate)
        bend = background.bend(problem, estimate.emission, estimate.background)
        energy = np.sum((bend - bend.mean(axis=0)) ** 2, axis=0)
        bent = energy > (_BEND * problem.noise[1]) ** 2
        if not np.any(bent):
            return result
        part = replace(problem, signals=problem.signals[:, :, bent])
        first, second = part.signals
        straight = replace(part, signals=np.stack([first, second - bend[:, bent]]))
        return result.updated(bent, _report(part, _pass(part, straight, functions)))


def _pass(problem: Problem, straight: Problem, functions: Array) -> _Estimate:
    """Steps 1 to 4; the first three on signals whose reflections are proportional."""
    found = direction.estimate(straight.signals, functions, problem.noise)
    object_found = emission.estimate(straight, functions, found)
    reflected = background.estimate(problem, object_found, found)
    memory = direction.memory(straight.signals, functions, found)
    return _Estimate(found, object_found, *reflected, memory)


def _report(problem: Problem, estimate: _Estimate) -> Separated:
    """Standard deviations, flags, and NaN where a quantity is undefined."""
    found, fit = estimate.found, estimate.emission
    frames = problem.time.size
    still = found.contrast < 1.0 + _CONTRAST_SIGMAS / np.sqrt(frames)
    still |= ~np.isfinite(found.variance)
    gray = ~still & (np.abs(1.0 - found.ratio) < _GRAY_SIGMAS * np.sqrt(found.variance))
    undefined = still | gray
    unidentified = undefined | fit.constant
    nonphysical = ~unidentified & np.any((fit.emissivity <= 0) | (fit.emissivity >= 1), axis=0)
    spread = 2.0 * (frames - found.order)
    own = np.stack([fit.own_variance, found.ratio**2 * fit.own_variance])
    result = Separated(
        object_temperature=fit.temperature,
        object_temperature_std=np.sqrt(fit.per_ratio**2 * found.variance + fit.smooth_variance),
        background_temperature=estimate.background,
        background_temperature_std=np.sqrt(estimate.background_variance),
        emissivity=fit.emissivity,
        emissivity_std=np.sqrt(fit.emissivity_per_ratio**2 * found.variance + own),
        status=flag(
            {
                "no_background_motion": still,
                "gray": gray,
                "constant_object": ~undefined & fit.constant,
                "background_never_rests": ~unidentified & fit.restless,
                "nonphysical_emissivity": nonphysical,
                "object_not_smooth": (estimate.memory > _MEMORY_SIGMAS)
                | (found.misfit > 1.0 + _MISFIT_SIGMAS * 2.0 / np.sqrt(spread)),
            }
        ),
    )
    return result.without(undefined, unidentified, unidentified | nonphysical).ranged(problem)


METHOD: Final = Method(separate, minimum_frames=32)
"""The subspace separator, for `solve`."""
