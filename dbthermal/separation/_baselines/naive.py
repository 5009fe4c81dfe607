r"""Naive least squares: both emissivities and every frame's temperatures from the images alone.

.. math:: \min_{e_1, e_2, x(t), y(t)} \sum_{m, t}
          \frac{[e_m u_m(x(t)) + (1 - e_m) u_m(y(t)) - z_m(t)]^2}{s_m^2}

without any prior. N frames give 2 N numbers and ask for 2 N + 2: for nearly every pair of
emissivities there are temperatures that meet the images exactly, so the objective is zero at wrong
answers too and cannot tell them apart. This is the naive baseline of Narayanan et al. (2026),
doi:10.48550/arXiv.2509.11334: several random starts, of which the one of least objective is kept.

The search is Levenberg and Marquardt's (Marquardt 1963, doi:10.1137/0111030), on the logits of the
emissivities and the logarithms of the temperatures, so that both stay physical. The normal
equations have the shape of an arrow: a 2x2 block for each frame and a border of two columns for the
emissivities. They are solved block by block, through the Schur complement of the border (Triggs et
al. 2000, doi:10.1007/3-540-44480-7_21), for all pixels and starts at once.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.special import expit, logit

from dbthermal import planck
from dbthermal.schema import Status
from dbthermal.separation._quality import status_bits
from dbthermal.separation._tiles import Array, Estimate, Mask, Method, Tile

# Damping of the first step, relative to the diagonal of the normal equations, and its range; the
# Schur complement is proportional to the damping, and is rounding below the least.
_FIRST_DAMPING: Final = 1e-2
_DAMPING: Final = (1e-8, 1e12)
# What the damping is multiplied by after a step that lowers the objective, and one that does not.
_EASIER: Final = 0.2
_HARDER: Final = 8.0
# A step that changes a logit by more is not taken: it would end where the logit's slope is nil.
_LONGEST: Final = 3.0


Columns = npt.NDArray[np.intp]


@dataclass(frozen=True)
class NaiveSettings:
    """
    Options of the naive baseline.

    Attributes
    ----------
    starts : int
        Random starts: emissivities uniform in (0, 1); object and background each at the image's
        apparent temperature in the quieter band, shifted for all of time by a random amount.
    spread : float
        Standard deviation of that shift [K].
    iterations : int
        Most steps from each start.
    tolerance : float
        A start is done when its objective, a sample's mean squared residual in units of the noise's
        variance, is below this, or a step lowers it by less than this fraction [1].
    """

    starts: int = 5
    spread: float = 2.0
    iterations: int = 100
    tolerance: float = 1e-6

    def __post_init__(self) -> None:
        """Refuse numbers that are no search."""
        for name in ("starts", "iterations"):
            if not getattr(self, name) >= 1:
                raise ValueError(
                    f"Invalid {name} {getattr(self, name)} of method 'naive'. Must be at least 1."
                )
        planck.require_positive("spread [K] of method 'naive'", self.spread)
        planck.require_positive("tolerance of method 'naive'", self.tolerance)


@dataclass(frozen=True)
class _State:
    """Where the search stands: a column for each pixel and start."""

    logits: Array  # (2, column)
    logarithms: Array  # of object and background temperature / K, (2, time, column)
    damping: Array  # (column,)
    objective: Array  # (column,)
    going: Mask  # (column,)

    def taken(self, columns: Mask | Columns) -> "_State":
        """Some of the columns."""
        return _State(**{name: value[..., columns] for name, value in vars(self).items()})


def separate(tile: Tile, settings: NaiveSettings, truth: Array | None = None) -> Estimate:
    """
    Separate one tile.

    Parameters
    ----------
    tile : Tile
        Signals of two bands.
    settings : NaiveSettings
        Starts and limits of the search.
    truth : ndarray, shape (time, pixel), optional
        True object temperature [K], for an experiment: the start nearest to it is kept, which
        cannot be done in practice. Not reached from `solve`.

    Returns
    -------
    Estimate
        Temperatures and emissivities, without deviations; `not_converged` where the start that is
        kept was still improving at the last step, or found no finite objective.
    """
    with np.errstate(invalid="ignore", divide="ignore", over="ignore", under="ignore"):
        state = _search(tile, settings)
        kept = state.taken(_choice(state, settings, truth))
        temperatures, emissivity = np.exp(kept.logarithms), expit(kept.logits)
    lost = ~np.isfinite(kept.objective)
    return (
        Estimate(
            object_temperature=temperatures[0],
            object_temperature_std=np.full_like(temperatures[0], np.nan),
            background_temperature=temperatures[1],
            background_temperature_std=np.full_like(temperatures[1], np.nan),
            emissivity=emissivity,
            emissivity_std=np.full_like(emissivity, np.nan),
            status=status_bits({Status.NOT_CONVERGED: kept.going | lost}),
        )
        .undefine(lost, lost, lost)
        .check_range(tile.curves[0], deviations=False)
    )


def _choice(state: _State, settings: NaiveSettings, truth: Array | None) -> Columns:
    """Column of the start that each pixel keeps: of least objective, or nearest the truth."""
    pixels = state.objective.size // settings.starts
    cost = state.objective.reshape(settings.starts, pixels)
    if truth is not None:
        warm = np.exp(state.logarithms[0]).reshape(-1, settings.starts, pixels)
        cost = np.mean((warm - truth[:, np.newaxis]) ** 2, axis=0)
    start = np.argmin(np.where(np.isfinite(cost), cost, np.inf), axis=0)
    return np.asarray(start * pixels + np.arange(pixels))


def _search(tile: Tile, settings: NaiveSettings) -> _State:
    """Run all starts to their end; columns are the starts of all pixels, start by start."""
    signals = np.tile(tile.signals, (1, 1, settings.starts))
    state = _start(tile, signals, settings)
    for _ in range(settings.iterations):
        columns = state.going
        if not np.any(columns):
            break
        moved = _step(tile, signals[..., columns], state.taken(columns), settings.tolerance)
        for name, value in vars(state).items():
            value[..., columns] = getattr(moved, name)
    return state


def _start(tile: Tile, signals: Array, settings: NaiveSettings) -> _State:
    """Random emissivities, and temperatures near the image's."""
    columns = signals.shape[-1]
    logits = logit(tile.rng.uniform(np.finfo(np.float64).tiny, 1.0, (2, columns)))
    shifts = settings.spread * tile.rng.standard_normal((2, 1, columns))
    logarithms = np.log(tile.temperature(0, signals[0]) + shifts)
    objective = _objective(_residual(tile, signals, expit(logits), np.exp(logarithms)))
    damping = np.full(columns, _FIRST_DAMPING)
    return _State(logits, logarithms, damping, objective, np.isfinite(objective))


def _residual(tile: Tile, signals: Array, emissivity: Array, temperatures: Array) -> Array:
    """Signals less the model, in units of the noise, (band, time, column)."""
    rest = np.empty_like(signals)
    for band, share in enumerate(emissivity):
        warm, cold = (tile.blackbody(band, part) for part in temperatures)
        rest[band] = (signals[band] - cold - share * (warm - cold)) / tile.noise[band]
    return rest


def _objective(residual: Array) -> Array:
    """Mean square over bands and time, (column,)."""
    return np.asarray(np.mean(residual**2, axis=(0, 1)))


def _step(tile: Tile, signals: Array, state: _State, tolerance: float) -> _State:
    """One damped step of every column; it is taken where it lowers the objective."""
    logits_step, logarithms_step = _solve(tile, signals, state)
    tried = replace(
        state,
        logits=state.logits + logits_step,
        logarithms=state.logarithms + logarithms_step,
    )
    residual = _residual(tile, signals, expit(tried.logits), np.exp(tried.logarithms))
    objective = _objective(residual)
    better = objective < state.objective  # false where it is NaN
    better &= np.all(np.abs(logits_step) < _LONGEST, axis=0)
    smallest, largest = _DAMPING
    damping = np.maximum(state.damping * np.where(better, _EASIER, _HARDER), smallest)
    done = better & (objective < tolerance)
    done |= better & (state.objective - objective < tolerance * state.objective)
    return _State(
        np.where(better, tried.logits, state.logits),
        np.where(better, tried.logarithms, state.logarithms),
        damping,
        np.where(better, objective, state.objective),
        ~done & (damping < largest),
    )


def _solve(tile: Tile, signals: Array, state: _State) -> tuple[Array, Array]:
    """Solve the damped normal equations: steps of the logits and of the logarithms."""
    inner, border = _jacobian(tile, state)
    residual = _residual(tile, signals, expit(state.logits), np.exp(state.logarithms))
    # Marquardt's damping, in proportion to the diagonal, and Levenberg's, of every logarithm and
    # logit alike: without it an emissivity of 0 or 1 within rounding is a singular system.
    harder, damping = 1.0 + state.damping, state.damping
    # Frame by frame: ((a, b), (b, c)) of the temperatures, and their columns of the border.
    a, c = (np.sum(inner[:, part] ** 2, axis=0) * harder + damping for part in (0, 1))
    b = np.sum(inner[:, 0] * inner[:, 1], axis=0)
    blocks = (a, b, c)
    forces = np.einsum("mktp,mtp->ktp", inner, residual)
    sides = [inner[band] * border[band] for band in (0, 1)]
    solved = [_symmetric(blocks, side) for side in sides]
    force = _symmetric(blocks, forces)
    schur = np.array([[-np.sum(u * v, axis=(0, 1)) for v in solved] for u in sides])
    right = np.stack([-np.sum(side * force, axis=(0, 1)) for side in sides])
    for band in (0, 1):
        schur[band, band] += np.sum(border[band] ** 2, axis=0) * harder + damping
        right[band] += np.sum(border[band] * residual[band], axis=0)
    logits = _symmetric((schur[0, 0], schur[0, 1], schur[1, 1]), right)
    return logits, force - logits[0] * solved[0] - logits[1] * solved[1]


def _jacobian(tile: Tile, state: _State) -> tuple[Array, Array]:
    """
    Derivatives of the model in units of the noise.

    With the logarithms of the temperatures, (band, 2, time, column), and with the band's own logit,
    (band, time, column).
    """
    temperatures, shares = np.exp(state.logarithms), expit(state.logits)
    inner = np.empty((2, *temperatures.shape))
    border = np.empty_like(temperatures)
    for band, share in enumerate(shares):
        slopes = tile.curves[band].slope(temperatures) * temperatures / tile.noise[band]
        inner[band] = slopes * np.stack([share, 1.0 - share])[:, np.newaxis]
        warm, cold = (tile.blackbody(band, part) for part in temperatures)
        border[band] = share * (1.0 - share) * (warm - cold) / tile.noise[band]
    return inner, border


def _symmetric(matrix: tuple[Array, Array, Array], right: Array) -> Array:
    """Solve ((a, b), (b, c)) x = right, the two rows along the first axis."""
    a, b, c = matrix
    return np.asarray(
        np.stack([c * right[0] - b * right[1], a * right[1] - b * right[0]]) / (a * c - b * b)
    )


METHOD: Final = Method(
    separate,
    settings=NaiveSettings,
    not_estimated=("object_temperature_std", "background_temperature_std", "emissivity_std"),
)
"""Least squares without a prior, for `solve`."""
