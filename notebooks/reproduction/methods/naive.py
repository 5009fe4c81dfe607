r"""Naive least squares: both emissivities and every frame's temperatures from the images alone.

.. math:: \min_{e_1, e_2, x(t), y(t)} \sum_{m, t}
          \frac{[e_m u_m(x(t)) + (1 - e_m) u_m(y(t)) - z_m(t)]^2}{s_m^2}

without any prior. N frames give 2 N numbers for 2 N + 2 unknowns: nearly every pair of emissivities
meets the images exactly, and the objective is zero at wrong answers too. This is the naive baseline
of Narayanan et al. (2026), doi:10.48550/arXiv.2509.11334: the best of several random starts.

The search is Levenberg and Marquardt's (Marquardt 1963, doi:10.1137/0111030), on the logits of the
emissivities and the logarithms of the temperatures, so that both stay physical. The normal
equations, a 2x2 block for each frame and a border of two columns for the emissivities, are solved
through the Schur complement of the border (Triggs et al. 2000, doi:10.1007/3-540-44480-7_21).
"""

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from scipy.special import expit, logit

from dbthermal import mixing
from dbthermal._numbers import POSITIVE, real_numbers
from dbthermal.schema import Status
from dbthermal.separation import Method
from dbthermal.separation._inputs import check_fields
from dbthermal.separation._quality import status_bits
from dbthermal.separation._tiles import WITHOUT_STD, Array, Estimate, Mask, Pixels, Tile

# Damping of the first step, relative to the diagonal of the normal equations, and its range; the
# Schur complement is proportional to the damping, and is rounding below the least.
_FIRST_DAMPING: Final = 1e-2
_DAMPING: Final = (1e-8, 1e12)
# Factors of the damping after a step that lowers the objective, and one that does not.
_EASIER, _HARDER = 0.2, 8.0
# A step that changes a logit by more is not taken: it would end where the logit's slope is nil.
_LONGEST: Final = 3.0


def require(settings: Any, method: str, name: str, holds: Any, rule: str) -> None:
    """Refuse a setting of a method for which a rule does not hold."""
    if not holds:
        value = getattr(settings, name)
        raise ValueError(f"Invalid {name} {value} of method '{method}'. Must {rule}.")


@dataclass(frozen=True)
class NaiveSettings:
    """Options of the naive baseline.

    A random start has emissivities uniform in (0, 1), object and background each at the image's
    apparent temperature in the quieter band, shifted for all of time by a random amount. It is done
    when its objective, a sample's mean squared residual in units of the noise's variance, is below
    the tolerance [1], or a step lowers it by less than this fraction.
    """

    starts: int = 5
    shift_std: float = 2.0  # standard deviation of the shift [K]
    iterations: int = 100  # most steps from each start
    tolerance: float = 1e-6

    def __post_init__(self) -> None:
        """Refuse numbers that are not positive."""
        check_fields(self, "naive")
        for name in ("starts", "iterations"):
            require(self, "naive", name, getattr(self, name) >= 1, "be at least 1")
        real_numbers("shift_std [K] of method 'naive'", self.shift_std, POSITIVE)
        real_numbers("tolerance of method 'naive'", self.tolerance, POSITIVE)


@dataclass(frozen=True)
class _State(Pixels):
    """State of the search; its "pixels" are the starts of all pixels, start by start."""

    logits: Array  # (2, column)
    logarithms: Array  # of object and background temperature / K, (2, time, column)
    damping: Array  # (column,)
    residual: Array  # see `_residual` (band, time, column)
    objective: Array  # (column,)
    active: Mask  # (column,)


def separate(tile: Tile, settings: NaiveSettings) -> Estimate:
    """Point estimate of one tile; `not_converged` where the kept start was still improving."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore", under="ignore"):
        state = _search(tile, settings)
        cost = np.where(np.isfinite(state.objective), state.objective, np.inf)
        pixels = tile.signals.shape[-1]
        start = np.argmin(cost.reshape(settings.starts, pixels), axis=0)
        kept = state.select_pixels(start * pixels + np.arange(pixels))
        (temperature, background), emissivity = np.exp(kept.logarithms), expit(kept.logits)
    lost = ~np.isfinite(kept.objective)
    status = status_bits({Status.NOT_CONVERGED: kept.active | lost})
    arrays = [np.where(lost, np.nan, array) for array in (temperature, emissivity, background)]
    estimate = Estimate.without_std(tile, arrays[0], status, *arrays[1:])
    return estimate.check_range(tile.curves[0], not_estimated=WITHOUT_STD)


def _search(tile: Tile, settings: NaiveSettings) -> _State:
    """State at the end of all starts: random emissivities, and temperatures near the image's."""
    signals = np.tile(tile.signals, (1, 1, settings.starts))
    columns = signals.shape[-1]
    logits = logit(tile.rng.uniform(np.finfo(np.float64).tiny, 1.0, (2, columns)))
    shifts = settings.shift_std * tile.rng.standard_normal((2, 1, columns))
    logarithms = np.log(tile.temperature(0, signals[0]) + shifts)
    residual, objective = _residual(tile, signals, logits, logarithms)
    damping = np.full(columns, _FIRST_DAMPING)
    state = _State(logits, logarithms, damping, residual, objective, np.isfinite(objective))
    for _ in range(settings.iterations):
        active = state.active.copy()
        if not np.any(active):
            break
        before = state.select_pixels(active)
        after = _step(tile, signals[..., active], before, settings.tolerance)
        state.replace_pixels(active, after)
    return state


def _residual(tile: Tile, signals: Array, logits: Array, logarithms: Array) -> tuple[Array, Array]:
    """Signals less the model over the noise (band, time, column); its mean square (column,)."""
    model = tile.mixed(expit(logits), np.exp(logarithms))
    residual = (signals - model) / np.array(tile.noise)[:, np.newaxis, np.newaxis]
    return residual, np.mean(residual**2, axis=(0, 1))


def _step(tile: Tile, signals: Array, state: _State, tolerance: float) -> _State:
    """One damped step of every column; it is taken where it lowers the objective."""
    logits_step, logarithms_step = _solve(tile, state)
    logits, logarithms = state.logits + logits_step, state.logarithms + logarithms_step
    residual, objective = _residual(tile, signals, logits, logarithms)
    better = objective < state.objective  # false where it is NaN
    better &= np.all(np.abs(logits_step) < _LONGEST, axis=0)
    smallest, largest = _DAMPING
    damping = np.maximum(state.damping * np.where(better, _EASIER, _HARDER), smallest)
    done = better & (objective < tolerance)
    done |= better & (state.objective - objective < tolerance * state.objective)
    return replace(
        state,
        logits=np.where(better, logits, state.logits),
        logarithms=np.where(better, logarithms, state.logarithms),
        damping=damping,
        residual=np.where(better, residual, state.residual),
        objective=np.where(better, objective, state.objective),
        active=~done & (damping < largest),
    )


def _solve(tile: Tile, state: _State) -> tuple[Array, Array]:
    """Steps of the logits and of the logarithms, from the damped normal equations.

    With T the 2x2 block of a frame's temperatures, S its columns of the border and B the border's
    own block, the logits solve :math:`(B - S^T T^{-1} S) l = b - S^T T^{-1} f`.
    """
    inner, border = _jacobian(tile, state)
    # Marquardt's damping, in proportion to the diagonal, and Levenberg's, of every logarithm and
    # logit alike: without it an emissivity of 0 or 1 within rounding is a singular system.
    harder, damping = 1.0 + state.damping, state.damping
    # T = ((a, b), (b, c)) frame by frame, f = J^T r
    a, c = (np.sum(inner[:, layer] ** 2, axis=0) * harder + damping for layer in (0, 1))
    b = np.sum(inner[:, 0] * inner[:, 1], axis=0)
    blocks = (a, b, c)
    forces = np.einsum("mktp,mtp->ktp", inner, state.residual)
    sides = [inner[band] * border[band] for band in (0, 1)]
    solved = [_symmetric(blocks, side) for side in sides]
    force = _symmetric(blocks, forces)
    schur = np.array([[-np.sum(u * v, axis=(0, 1)) for v in solved] for u in sides])
    right = np.stack([-np.sum(side * force, axis=(0, 1)) for side in sides])
    for band in (0, 1):
        schur[band, band] += np.sum(border[band] ** 2, axis=0) * harder + damping
        right[band] += np.sum(border[band] * state.residual[band], axis=0)
    logits = _symmetric((schur[0, 0], schur[0, 1], schur[1, 1]), right)
    return logits, force - logits[0] * solved[0] - logits[1] * solved[1]


def _jacobian(tile: Tile, state: _State) -> tuple[Array, Array]:
    """Derivatives of the model over the noise, with ln T (band, 2, ...) and logit (band, ...)."""
    temperatures, emissivity = np.exp(state.logarithms), expit(state.logits)
    inner = np.empty((2, *temperatures.shape))
    border = np.empty_like(temperatures)
    for band, weights in enumerate(mixing.matrix(emissivity)):
        # dz/d ln T = (e, 1 - e) u'(T) T,  dz/d logit = e (1 - e) [u(x) - u(y)]
        slopes = tile.curves[band].slope(temperatures) * temperatures / tile.noise[band]
        inner[band] = slopes * weights.T[:, np.newaxis]
        emitted, reflected = (tile.blackbody(band, temperature) for temperature in temperatures)
        border[band] = np.prod(weights, axis=1) * (emitted - reflected) / tile.noise[band]
    return inner, border


def _symmetric(matrix: tuple[Array, Array, Array], right: Array) -> Array:
    """Solve ((a, b), (b, c)) x = right, the two rows along the first axis."""
    a, b, c = matrix
    rows = np.stack([c * right[0] - b * right[1], a * right[1] - b * right[0]])
    return np.asarray(rows / (a * c - b * b))


METHOD: Final = Method(separate, NaiveSettings, "naive", not_estimated=WITHOUT_STD)
"""Least squares without a prior, for `solve`."""
