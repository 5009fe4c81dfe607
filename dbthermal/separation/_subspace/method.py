r"""The subspace separator: closed forms for a smooth object before an abrupt background.

1. The direction of the rapid changes gives the reflection ratios :math:`\kappa_m = (1 - e_m) /
   (1 - e_1)` (`direction`).
2. The combination of bands :math:`q = \sum w_m z_m` with :math:`w \cdot \kappa = 0` holds no
   background. Smoothed in the subspace, it is inverted for the object temperature:
   :math:`\sum w_m e_m u_m(x) = q`.
3. The slope of a robust regression of :math:`z_1` on :math:`u_1(x)` is :math:`e_1`, if the
   background rests now and then; :math:`e_m = 1 - \kappa_m (1 - e_1)`. Steps 2 and 3 alternate
   (`emission`). What a slow part of the background can do to the slope is carried in its standard
   deviation (`slow`).
4. The background follows from all bands, weighted by their noise (`background`). Where it changes
   by many kelvins its signals are no longer proportional: what bends them apart is taken out, and
   steps 1 to 4 are done again, on the exact model.
5. Where what is left is no noise, one jump of the object is looked for (`jumps`), and taken into
   the subspace.

Every output carries a standard deviation, propagated from the noise. Second-order blind source
separation in the sense of Belouchrani et al. (1997), doi:10.1109/78.554307, for the image
formation of Narayanan et al. (2026), doi:10.48550/arXiv.2509.11334.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, TypeVar

import numpy as np
from scipy.special import ndtri

from dbthermal import _smooth as smooth
from dbthermal import schema
from dbthermal.schema import Status
from dbthermal.separation._quality import status_bits
from dbthermal.separation._subspace import (
    background,
    emission,
)
from dbthermal.separation._subspace import (
    change_points as jumps,
)
from dbthermal.separation._subspace import (
    diagnostics as residual,
)
from dbthermal.separation._subspace import (
    drift_prior as slow,
)
from dbthermal.separation._subspace import (
    reflection_ratio as direction,
)
from dbthermal.separation._tiles import Array, Estimate, Mask, Method, Survey, Tile

# Thresholds of the flags, in standard deviations.
_CONTRAST_SIGMAS: Final = 8.0
_MISFIT_SIGMAS: Final = 8.0
_MEMORY_SIGMAS: Final = 3.5
_GRAY_SIGMAS: Final = 4.0
_APART_SIGMAS: Final = 4.0
_BROKEN: Final = np.uint32(schema.FLAGS["object_not_smooth"] | schema.FLAGS["bands_apart"])
# Flags of pixels in which a jump of the object is looked for.
_SUSPECT: Final = np.uint32(
    sum(
        schema.FLAGS[name]
        for name in (
            "object_not_smooth",
            "gray",
            "nonphysical_emissivity",
            "roles_may_be_swapped",
            "background_never_rests",
        )
    )
)
# Bound of a 95 % interval of the normal distribution.
_NORMAL95: Final = float(ndtri(0.975))
# Energy of the bend between the two responses, in units of the second band's noise, from which it
# is worth taking out: it moves no linear function of the signal by more standard deviations.
_BEND: Final = 0.2


Record = TypeVar("Record", Estimate, Survey)


@dataclass(frozen=True)
class SubspaceSettings:
    """
    Options of the method.

    Attributes
    ----------
    background_drift : float
        Prior: the background drifts along with the object's own curve by at most this, up or
        down, over the capture [K], each drift as likely. No method can see that part; it only
        widens the error bars of emissivity and background.
    """

    background_drift: float = 3.0

    def __post_init__(self) -> None:
        """Refuse what is no standard deviation."""
        if not 0 <= self.background_drift < np.inf:
            raise ValueError(
                f"Invalid background_drift {self.background_drift} K. Must be zero or positive."
            )


@dataclass(frozen=True)
class _Estimate:
    """Everything that one pass over a tile finds."""

    found: direction.Direction
    emission: emission.Emission
    background: Array
    background_variance: Array
    memory: Array
    lateness: Array


def separate(tile: Tile, settings: SubspaceSettings) -> Estimate:
    """
    Separate one tile.

    Parameters
    ----------
    tile : Tile
        Signals of two bands or more, and what is known of them.
    settings : SubspaceSettings
        Options.

    Returns
    -------
    Estimate
        Temperatures, emissivities, standard deviations and flags.
    """
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        result = _exact(tile, _functions(tile), settings, _report)
        return _with_jumps(tile, result, settings)


def survey(tile: Tile, settings: SubspaceSettings) -> Survey:
    """
    What the pixels of a tile tell of their materials, each alone.

    Parameters
    ----------
    tile : Tile
        The tile.
    settings : SubspaceSettings
        Options.

    Returns
    -------
    Survey
        Scatter and emissivity of the pixels that have no flag; the others tell nothing.
    """
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        # Together the pixels see what is too small to be seen in each.
        return _exact(tile, _functions(tile), settings, _tell, least=0.0)


def _tell(tile: Tile, estimate: _Estimate) -> Survey:
    """Only broken models are left out: a choice by the estimate itself would bias the sum."""
    status = _report(tile, estimate).status
    fit, found = estimate.emission, estimate.found
    moving = (status & _BROKEN) == 0
    return Survey(
        scatter=np.where(moving, found.scatter, 0.0),
        frames=moving * np.asarray(tile.time.size - found.order, dtype=np.float64),
        ratio=found.ratio,
        null_weights=found.weights,
        emissivity=np.where(status == 0, fit.emissivity[0], np.nan),
        noise_variance=fit.own_variance,
        drift_variance=fit.common_variance,
    )


def _functions(tile: Tile, jump: int | None = None) -> smooth.Subspace:
    order = min(direction.HIGHEST_ORDER, tile.time.size // 4)
    return smooth.subspace(tile.time, order, segment=tile.segment, jump=jump)


def _exact(
    tile: Tile,
    functions: smooth.Subspace,
    settings: SubspaceSettings,
    finish: Callable[[Tile, _Estimate], Record],
    least: float = _BEND,
) -> Record:
    """Steps 1 to 4, where it matters a second time on signals with proportional reflections."""
    estimate = _pass(tile, tile, functions, settings)
    result = finish(tile, estimate)
    bend = background.bend(tile, estimate.emission, estimate.background)
    apart = bend - bend.mean(axis=1, keepdims=True)
    energy = np.einsum("btp,btp->bp", apart, apart)
    bent = np.any(energy > (least * np.array(tile.noise[1:])[:, np.newaxis]) ** 2, axis=0)
    if not np.any(bent):
        return result
    part = tile.select_pixels(bent)
    straight = part.signals.copy()
    straight[1:] -= bend[..., bent]
    again = _pass(part, replace(part, signals=straight), functions, settings)
    return result.replace_pixels(bent, finish(part, again))


def _pass(
    tile: Tile, straight: Tile, functions: smooth.Subspace, settings: SubspaceSettings
) -> _Estimate:
    """Steps 1 to 4; the first three on signals whose reflections are proportional."""
    noise, shared = np.array(tile.noise), tile.material
    known = None if shared is None else direction.Known(shared.ratio, shared.inverse_energy)
    found = direction.estimate(straight.signals, functions, noise, known)
    prior = slow.Prior(settings.background_drift)
    object_found = emission.estimate(straight, functions, found, prior)
    reflected = background.estimate(tile, object_found, found)
    left = residual.of_combination(straight.signals, functions, found)
    lateness = residual.lateness(left, straight.signals[0], functions, found, tile.noise[0])
    return _Estimate(found, object_found, *reflected, residual.memory(left), lateness)


def _report(tile: Tile, estimate: _Estimate) -> Estimate:
    """Standard deviations, flags, and NaN where a quantity is undefined."""
    found, fit = estimate.found, estimate.emission
    flags = _flags(tile, estimate)
    still, undefined = (
        flags[Status.NO_BACKGROUND_MOTION],
        flags[Status.NO_BACKGROUND_MOTION] | flags[Status.GRAY],
    )
    unidentified = undefined | fit.constant
    of_ratio = direction.ratio_variance(found, np.array(tile.noise))
    result = Estimate(
        object_temperature=fit.temperature,
        object_temperature_std=_object_std(estimate),
        background_temperature=estimate.background,
        background_temperature_std=np.sqrt(estimate.background_variance),
        emissivity=fit.emissivity,
        emissivity_std=np.sqrt(emission.variance(found, fit, np.array(tile.noise))),
        reflection_ratio=np.where(still, np.nan, found.ratio),
        reflection_ratio_std=np.where(still, np.nan, np.sqrt(of_ratio)),
        status=status_bits(flags),
    )
    no_background = unidentified | flags[Status.NONPHYSICAL_EMISSIVITY]
    return result.undefine(undefined, unidentified, no_background).check_range(tile.curves[0])


def _object_std(estimate: _Estimate) -> Array:
    """
    Standard deviation of the object temperature (time, pixel) [K].

    The object is a ratio with an uncertain denominator: half the width of its 95 % interval by
    Fieller's theorem (1954), doi:10.1111/j.2517-6161.1954.tb00159.x
    """
    found, fit = estimate.found, estimate.emission
    epsilon = found.spread * found.across
    through = fit.per_direction**2 * epsilon / (1.0 - _NORMAL95**2 * epsilon) ** 2
    return np.asarray(np.sqrt(through + fit.smooth_variance))


def _flags(tile: Tile, estimate: _Estimate) -> dict[Status, Mask]:
    """What is wrong with each pixel."""
    found, fit = estimate.found, estimate.emission
    frames, others = tile.time.size, len(tile.noise) - 1
    still = ~found.given & (found.contrast < 1.0 + _CONTRAST_SIGMAS / np.sqrt(frames))
    # Not even in the quietest band is there more than its noise.
    still |= ~found.given & (found.scatter[0, 0] <= 0)
    still |= ~np.isfinite(found.spread)
    gray = ~still & (found.spread * found.across > 1.0 / _GRAY_SIGMAS**2)
    told = ~still & ~gray & ~fit.constant
    nonphysical = told & np.any((fit.emissivity <= 0) | (fit.emissivity >= 1), axis=0)
    misfit = 2.0 * _MISFIT_SIGMAS / np.sqrt(2.0 * others * (frames - found.order))
    return {
        Status.NO_BACKGROUND_MOTION: still,
        Status.GRAY: gray,
        Status.CONSTANT_OBJECT: ~still & ~gray & fit.constant,
        Status.BACKGROUND_NEVER_RESTS: told & fit.restless,
        Status.NONPHYSICAL_EMISSIVITY: nonphysical,
        Status.ROLES_MAY_BE_SWAPPED: told & ~nonphysical & (fit.emissivity.mean(axis=0) < 0.5),
        Status.BANDS_APART: ~still & (estimate.lateness > _APART_SIGMAS),
        Status.OBJECT_NOT_SMOOTH: (estimate.memory > _MEMORY_SIGMAS)
        | (found.misfit > 1.0 + misfit),
    }


def _with_jumps(tile: Tile, result: Estimate, settings: SubspaceSettings) -> Estimate:
    """Step 5: pixels that do not fit are solved anew with a jump in the subspace."""
    functions, inside = _functions(tile), jumps.candidates(tile.time)
    ramp = jumps.spread(tile.time)
    if inside.size == 0:
        return result
    suspect = ((result.status & _SUSPECT) != 0) | jumps.alone(tile.signals[0], functions, ramp)
    if not np.any(suspect):
        return result
    noise = np.array(tile.noise)
    frame, gain = jumps.find(tile.signals[..., suspect], functions, noise, inside, ramp)
    first = np.full(suspect.shape, -1)
    first[suspect] = np.where(gain > 0, frame, -1)
    for jump in np.unique(first[first >= 0]):
        kept = jumps.outside(tile.time, int(jump), tile.segment)
        before = int(kept[:jump].sum())
        part = tile.select_pixels(first == jump).select_frames(kept)
        functions = _functions(part, jump=before if 0 < before < part.time.size else None)
        again = _exact(part, functions, settings, _report)
        again = replace(again, status=again.status | np.uint32(schema.FLAGS["object_jump"]))
        result = result.replace_pixels(first == jump, again.expand_frames(kept))
    return result


METHOD: Final = Method(
    separate, settings=SubspaceSettings, minimum_frames=32, survey=survey, any_bands=True
)
"""The subspace separator, for `solve`."""
