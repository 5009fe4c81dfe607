r"""The subspace separator: closed forms for a smooth object before an abrupt background.

The image formation (`mixing`) of band m, with noise of standard deviation :math:`s_m`, is

.. math:: z_m = e_m u_m(x) + (1 - e_m) u_m(y) + n_m \qquad (1)

1. The rapid changes of the bands lie along the reflection ratios (`pixel`)

   .. math:: \kappa_m = (1 - e_m) / (1 - e_1) \qquad (2)

   the principal axis of the whitened signals' scatter outside the smooth subspace (by P):

   .. math:: S_{mn} = \sum_t (P z_m)(P z_n) / (s_m s_n) \qquad (3)

   .. math:: \mathrm{var}(\kappa_m) = \sigma^2 (s_m^2 + \kappa_m^2 s_1^2) \qquad (4)

2. The null combination of bands holds no background. Smoothed in the subspace, it is inverted for
   the object temperature (`pixel`):

   .. math:: q = \sum w_m z_m, \quad \sum w_m \kappa_m = 0, \quad \sum w_m = 1 \qquad (5)

   .. math:: h(x) = \sum w_m e_m u_m(x) = q \qquad (6)

3. If the background rests now and then, a robust regression of :math:`z_1` on :math:`u_1(x)` has
   the slope :math:`e_1`. Steps 2 and 3 alternate.

   .. math:: e_1 = \mathrm{d} z_1 / \mathrm{d} u_1(x), \quad
             e_m = 1 - \kappa_m (1 - e_1) \qquad (7)

   Its standard deviation (8) includes the effect of the background's slow part on the slope.
4. The background minimises, at every frame, with a variance (10) by propagation,

   .. math:: \sum_m \frac{(1 - e_m)^2}{s_m^2}
             \left[ \frac{z_m - e_m u_m(x)}{1 - e_m} - u_m(y) \right]^2 \qquad (9)

   Where it changes by many kelvins its signals are no longer proportional: the part that bends
   them apart (11) is taken out, and steps 1 to 4 are done again, on the exact model. It is known
   as well as the background's mean temperature, whose error the ratios carry. Near a gray body,
   whose ratios it makes alone, it is not known at all: such ratios are flagged.
5. Where the residual is not noise, or as many polynomials as there are hardly follow, the object
   is taken to change rapidly now and then. Its curve is then a polynomial in each of some pieces of
   the time, and steps 1 to 4 are done with these. Pieces and ratios are sought together, by the
   least description length (12) (`pieces`): one of the bands' rapid changes lie along the
   reflection ratios, others along the emissivities, and the object's are those that fewer pieces
   describe. Of the two best explanations the one without a flag is taken, if both are likely.

Every output carries a standard deviation, propagated from the noise. Second-order blind source
separation in the sense of Belouchrani et al. (1997), doi:10.1109/78.554307, for the image
formation of Narayanan et al. (2026), doi:10.48550/arXiv.2509.11334.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import numpy as np
from scipy.special import chdtri

from dbthermal import _smooth as smooth
from dbthermal._arrays import Array, select
from dbthermal.schema import Status
from dbthermal.separation._inputs import Method, check_fields
from dbthermal.separation._quality import status_bits
from dbthermal.separation._subspace import division, fused, pieces, reflection_ratio
from dbthermal.separation._subspace.fused import FILMS, Solution
from dbthermal.separation._tiles import BROKEN, LEAST_MEAN, LOW, Estimate, Mask, Tile, Whole

# Thresholds of the flags, in standard deviations.
_CONTRAST_SIGMAS: Final = 8.0
_CHI2_SIGMAS: Final = 8.0
_CORRELATION_SIGMAS: Final = 3.5
_DELAY_SIGMAS: Final = 4.0
# Deviation by noise of an emissivity outside (0, 1) from which it says nothing [1].
_UNKNOWN: Final = 0.1
_HARDLY_CHANGES: Final = np.uint32(Status.CONSTANT_OBJECT | Status.NONPHYSICAL_EMISSIVITY)
# Ratios of two emissivities of one material [1]: 98 of 100 of the libraries lie in 0.78 to 1.21, in
# whatever order their bands are.
_EMITTED: Final = (0.7, 1.3)
_ORDERS: Final = 6  # last orders of the smooth curve at which its polynomials may be too few
# Flags of pixels in which rapid changes of the object are looked for.
_SUSPECT: Final = np.uint32(
    Status.OBJECT_NOT_SMOOTH
    | Status.GRAY
    | Status.CONSTANT_OBJECT
    | Status.NONPHYSICAL_EMISSIVITY
    | Status.ROLES_MAY_BE_SWAPPED
    | Status.BACKGROUND_NEVER_RESTS
)
# Cost of an explanation over that of the best, up to which it is preferred if it has no flag.
_MARGIN: Final = 40.0
# A step between two pieces is judged by what each tells, without the choice of where it ends [1].
_AS_GIVEN: Final = (1.0 + smooth.CHANGE_POINT / smooth.PIECE_ORDER) ** -0.5
# Pieces of a rapid object, at most, whose bands seem apart in one smooth curve.
_MOST_PIECES: Final = 10
# Polynomials of a piece in a survey, beside those of a pixel alone.
_NUMBERS: Final = (smooth.PIECE_ORDER + 3, 2 * smooth.PIECE_ORDER)


@dataclass(frozen=True)
class SubspaceSettings:
    """Options of the method "subspace".

    Attributes
    ----------
    background_drift : float
        Prior: the background drifts along with the object's own curve by at most this, up or
        down, over the capture [K], each drift as likely. No method can see that part; it only
        widens the error bars of emissivity and background.
    """

    background_drift: float = 3.0

    def __post_init__(self) -> None:
        """Refuse a drift that is negative or not finite."""
        check_fields(self, "subspace")
        if not 0 <= (drift := self.background_drift) < np.inf:
            raise ValueError(f"Invalid background_drift {drift} K. Must be zero or positive.")


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def separate(tile: Tile, settings: SubspaceSettings) -> Estimate:
    """Separate one tile of two bands or more."""
    functions, starts, drift = _functions(tile), tile.division, settings.background_drift
    # A pixel keeps its division of the time from a pass before, unless it has a flag.
    if starts is None or not starts.any():
        return _searched(tile, functions, drift)
    places = np.flatnonzero(starts.any(axis=0))
    chosen, first = tile.select_pixels(places), starts[:, places]
    solution = fused.solve(chosen, functions, drift, _parts(chosen, first, functions))
    estimate = _report(chosen, solution)
    sound = estimate.status == 0
    estimate = _finished(chosen, estimate, first, functions)
    searched = np.ones(starts.shape[1], dtype=bool)
    searched[places[sound]] = False
    if not searched.any():
        return estimate
    result = _searched(tile.select_pixels(searched), functions, drift)
    result = result.select_pixels(np.maximum(np.cumsum(searched) - 1, 0))
    if result.division is None:
        result = replace(result, division=np.zeros_like(starts))
    result.replace_pixels(places[sound], estimate.select_pixels(sound))
    return result


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def separate_smooth(tile: Tile, settings: SubspaceSettings) -> Estimate:
    """Separate one tile of objects that change smoothly, without pieces of time."""
    return _report(tile, fused.solve(tile, _functions(tile), settings.background_drift))


def _functions(tile: Tile) -> smooth.Subspace:
    segment = tile.segment
    return _known_functions(tile.time.tobytes(), None if segment is None else segment.tobytes())


@lru_cache(maxsize=4)
def _known_functions(times: bytes, events: bytes | None) -> smooth.Subspace:
    """Smooth functions over some times: most tiles have the same."""
    segment = None if events is None else np.frombuffer(events, dtype=np.intp)
    return smooth.largest(np.frombuffer(times), segment)


def _report(tile: Tile, solution: Solution) -> Estimate:
    """Values, standard deviations and flags; NaN, in the films in place, where undefined."""
    flags = _flags(tile, solution)
    still = flags[Status.NO_BACKGROUND_MOTION]
    ambiguous = solution.constant | flags[Status.NONPHYSICAL_EMISSIVITY]
    ambiguous &= flags[Status.ROLES_MAY_BE_SWAPPED]
    undefined = still | flags[Status.GRAY] | ambiguous
    unidentified = undefined | solution.constant
    no_background = unidentified | flags[Status.NONPHYSICAL_EMISSIVITY]
    status = status_bits(flags)
    # A temperature without a number in all samples of a pixel with a flag needs no further flag.
    lost = (solution.lost > 0) & ((solution.missing < tile.time.size) | (status == 0))
    beyond = (lost | solution.beyond) & ~np.stack([undefined, no_background])
    status |= status_bits({Status.OUTSIDE_RESPONSE: np.any(beyond, axis=0)})
    films = {name: getattr(solution, name) for name in FILMS}
    for name, film in films.items():
        mask = undefined if name.startswith("object") else no_background
        if mask.any():
            np.copyto(film, np.nan, where=mask)
    covariance = np.where(unidentified, np.nan, solution.emissivity_covariance)
    result = Estimate(
        **films,
        emissivity=np.where(unidentified, np.nan, solution.emissivity),
        emissivity_std=np.sqrt(np.einsum("bbp->bp", covariance)),
        emissivity_covariance=covariance,
        drift_std=np.where(unidentified, np.nan, np.sqrt(solution.drift_variance)),
        reflection_ratio=np.where(still, np.nan, solution.ratio),
        reflection_ratio_std=np.where(still, np.nan, np.sqrt(solution.ratio_variance)),
        status=status,
    )
    result = result.check_range(tile.curves[0], not_estimated=FILMS)
    status = result.status
    # An object that is taken for the background has the ratio of emissivities.
    exchanged = (status & np.uint32(Status.ROLES_MAY_BE_SWAPPED)) != 0
    exchanged &= (status & _HARDLY_CHANGES) != 0
    sound = ((status & BROKEN) == 0) & ~exchanged
    return replace(result, survey=solution.survey(sound, (status & ~LOW) == 0))


def _flags(tile: Tile, solution: Solution) -> dict[Status, Mask]:
    """Conditions (pixel) of the bits of the status."""
    frames, second_bands, emissivity = tile.time.size, len(tile.noise) - 1, solution.emissivity
    still = solution.contrast < 1.0 + _CONTRAST_SIGMAS / np.sqrt(frames)
    # The quietest band holds no more than its noise either.
    still |= solution.scatter[0, 0, 0] <= 0
    still = (still & ~solution.pooled) | ~np.isfinite(solution.inverse_energy)
    # Ratios of 1, where eq. 5 is singular, are not excluded.
    singular = solution.epsilon_variance > 1.0 / chdtri(second_bands, reflection_ratio.CHANCE)
    gray = ~still & (singular | solution.gray)
    defined = ~still & ~gray & ~solution.constant
    nonphysical = defined & np.any((emissivity <= 0) | (emissivity >= 1), axis=0)
    swapped = defined & ~nonphysical & (emissivity.mean(axis=0) < LEAST_MEAN)
    constant = ~still & ~gray & solution.constant
    # Before an object that hardly changes, what changes would be the background: comes and goes.
    resting = constant | (nonphysical & (solution.noise_variance > _UNKNOWN**2))
    swapped[resting] = ~pieces.returning(select(tile.signals[0], resting))
    # Or along a ratio of emissivities, as of an object that is switched on and off.
    emitted = np.all((solution.ratio > _EMITTED[0]) & (solution.ratio < _EMITTED[1]), axis=0)
    swapped |= constant & emitted
    # A reduced chi-square of f degrees of freedom has the standard deviation sqrt(2 / f).
    excess = 2.0 * _CHI2_SIGMAS / np.sqrt(2.0 * second_bands * solution.freedom[0])
    rough = (solution.correlation > _CORRELATION_SIGMAS) | solution.unexplained
    return {
        Status.NO_BACKGROUND_MOTION: still,
        Status.GRAY: gray,
        Status.CONSTANT_OBJECT: constant,
        Status.BACKGROUND_NEVER_RESTS: defined & solution.restless,
        Status.NONPHYSICAL_EMISSIVITY: nonphysical,
        Status.ROLES_MAY_BE_SWAPPED: swapped,
        Status.BANDS_APART: ~still & (solution.delay > _DELAY_SIGMAS),
        Status.OBJECT_NOT_SMOOTH: rough | (solution.reduced_chi2 > 1.0 + excess),
    }


def _searched(tile: Tile, functions: smooth.Subspace, drift: float) -> Estimate:
    """All steps: pixels that do not fit are solved anew with polynomials in pieces of the time."""
    solution = fused.solve(tile, functions, drift)
    number = solution.order + functions.steps
    candidates = pieces.asked(solution.sums, tile.time, solution.null_variance, number)
    candidates |= solution.order > functions.orders - _ORDERS
    result = _report(tile, solution)
    suspect = np.flatnonzero(candidates | ((result.status & _SUSPECT) != 0))
    if suspect.size == 0:
        return result
    first = np.zeros((tile.time.size, suspect.size), dtype=bool)
    suspects, best = tile.select_pixels(suspect), result.select_pixels(suspect)
    noise = suspects.scaled(tile.noise)
    white, axes = pieces.plane(suspects.signals, noise)
    axis = np.full((2, suspect.size), np.nan)
    if suspects.material is not None:
        axis = np.einsum("abp,bp->ap", axes, suspects.material.ratio / noise)
        axis /= np.sqrt((axis**2).sum(axis=0))
    pooled = np.where(solution.pooled[suspect], axis, np.nan)
    energy, count = pieces.null_energy(white, functions, pooled)
    divisions, costs = division.divide(white, tile.time, tile.segment, axis)
    # Outside the plane a function fits noise in each further band.
    penalty = (pieces.COST - 1.0) * (len(noise) - 2)
    costs += penalty * pieces.FUNCTIONS * divisions.sum(axis=1)
    cost = energy + (pieces.COST + penalty) * count  # of one smooth curve
    lowest = np.minimum(cost, costs.min(axis=0))
    for divided, price in zip(divisions, costs, strict=True):
        # A sound explanation gives way to a cheaper one; a flagged one to any that is likely.
        flagged = (best.status != 0) | (cost > lowest + _MARGIN)
        trial = (price < cost) | (flagged & (price < lowest + _MARGIN))
        # One piece is a smooth curve.
        places = np.flatnonzero(trial & (divided.sum(axis=0) > 1))
        if places.size == 0:
            continue
        chosen = suspects.select_pixels(places)
        groups = _parts(chosen, divided[:, places], functions)
        resolved = _report(chosen, fused.solve(chosen, functions, drift, groups))
        cheaper = price[places] < cost[places] - _MARGIN
        better = (resolved.status == 0) | (flagged[places] & cheaper)
        places, resolved = places[better], resolved.select_pixels(better)
        best.replace_pixels(places, resolved)
        cost[places], first[:, places] = price[places], divided[:, places]
    best = _finished(suspects, best, first, functions)
    # A delay of the bands asks for a piece at each change of the background, which hide it.
    asynchronous = result.status[suspect] & np.uint32(Status.BANDS_APART)
    hidden = first.sum(axis=0) > _MOST_PIECES
    status = best.status | np.where((best.status != 0) | hidden, asynchronous, np.uint32(0))
    # Pieces without a flag are kept for the next pass.
    first[:, hidden | ((status & ~np.uint32(Status.OBJECT_JUMP)) != 0)] = False
    result = replace(result, division=np.zeros((tile.time.size, candidates.size), dtype=bool))
    result.replace_pixels(suspect, replace(best, status=status))
    return result


def _finished(tile: Tile, estimate: Estimate, first: Mask, functions: smooth.Subspace) -> Estimate:
    """Estimate with its division, a survey by more functions of the pieces, and flags of jumps."""
    divided = np.asarray(first.any(axis=0))
    surveyed = divided & tile.surveyed
    if tile.material is not None:  # pixels with its emissivity need no scatter
        surveyed &= np.isnan(tile.material.noise_variance)
    if surveyed.any():
        straight = _straight(tile.select_pixels(surveyed), estimate.select_pixels(surveyed))
    noise = tile.scaled(tile.noise)[:, surveyed]
    for place, number in enumerate(_NUMBERS if surveyed.any() else (), 1):
        groups = _parts(tile, first[:, surveyed], functions, number)
        estimate.replace_scatter(place, surveyed, *pieces.outside(straight, noise, groups))
    std = _AS_GIVEN * estimate.object_temperature_std
    jumping = divided & pieces.sudden(estimate.object_temperature, std, tile.time)
    status = estimate.status | status_bits({Status.OBJECT_JUMP: jumping})
    return replace(estimate, status=status, division=first)


def _straight(tile: Tile, estimate: Estimate) -> Array:
    """Signals (pixel, band, time) [K] less the bend of the background (eq. 11)."""
    signals, emissivity = tile.signals.copy(), estimate.emissivity
    reference = tile.blackbody(0, estimate.background_temperature)
    physical = np.all((emissivity > 0) & (emissivity < 1), axis=0)
    for band in range(1, len(signals)):
        bend = tile.blackbody(band, estimate.background_temperature) - reference
        signals[band] -= np.where(physical, np.nan_to_num((1.0 - emissivity[band]) * bend), 0.0)
    return np.ascontiguousarray(signals.transpose(2, 0, 1))


def _parts(
    tile: Tile, first: Mask, functions: smooth.Subspace, number: int = smooth.PIECE_ORDER
) -> Iterator[tuple[Whole, smooth.Subspace]]:
    """Yield pixels whose pieces begin with the same frames (time, pixel), and their functions."""
    groups: dict[bytes, list[int]] = {}
    for place, begins in enumerate(first.T):
        groups.setdefault(begins.tobytes(), []).append(place)
    for places in map(np.array, groups.values()):
        begins = tile.time, first[:, places[0]], functions.rising
        yield places, smooth.piecewise(*begins, segment=tile.segment, number=number)


METHOD: Final = Method(
    separate,
    settings=SubspaceSettings,
    minimum_frames=32,
    check_clock=pieces.check_clock,
    pools=True,
    any_bands=True,
    compiled=True,
)
"""The subspace separator, for `solve`."""
