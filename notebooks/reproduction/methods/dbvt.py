r"""The paper's optimiser, algorithm DBVT: smooth signals, noise and emissivities of every pixel.

The smooth signal :math:`\tilde I_1(t)`, the offset :math:`\tilde I_2(0)`, both emissivities and the
noise of every frame minimise five losses (`dbvt_objective`); the temperatures follow in closed
form (`calibrated`). The objective is that of Narayanan et al. (2026),
doi:10.48550/arXiv.2509.11334; the steps of the search are this project's.

A random start lies on the wrong side of equal emissivities half of the time, behind a ridge that
only the reconstruction makes: the other losses have one valley, that of the emission ratio. So a
homotopy raises its weight from stage to stage (Allgower, Georg 2003,
doi:10.1137/1.9780898719154). The paper's identities are linear in the temperatures: the
nonlinearity of an exact response is taken out of the second band, and the search goes on.
"""

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from dbthermal import mixing
from dbthermal._numbers import POSITIVE, real_numbers
from dbthermal.schema import Status
from dbthermal.separation import Method
from dbthermal.separation import _calibrated as calibrated
from dbthermal.separation._inputs import check_fields
from dbthermal.separation._quality import status_bits
from dbthermal.separation._subspace import method as subspace
from dbthermal.separation._tiles import WITHOUT_STD, Array, Estimate, Mask, Tile
from reproduction.methods import dbvt_objective as objective
from reproduction.methods.naive import require

# Largest departure of an interval from the median one, relative to it.
_UNEVEN: Final = 0.5
_CHOICES: Final = {"start": ("random", "subspace"), "temperatures_from": ("corrected", "measured")}


@dataclass(frozen=True)
class DbvtSettings:
    r"""Options of the paper's optimiser: losses, starts, homotopy, Newton's steps.

    None is published. A weight of 0 leaves a loss out, of the noise it is then held at zero. One
    stage of the homotopy has all of the reconstruction from the start. A start takes emissivities
    uniform in (0, 1), as published, or emissivities and object of the subspace separator, and at
    random where it has none; all but the first are random.
    """

    # Weights gamma_1 to gamma_5 of the losses in `dbvt_objective` [1]: of the curvature, the Huber
    # loss over its threshold, the reconstruction error, the noise, and its mean.
    smoothness: float = 1.0
    huber: float = 0.5
    reconstruction: float = 10.0
    noise: float = 1.0
    noise_mean: float = 1.0
    curvature: float = 0.5  # second derivative of a smooth signal that costs 1 [K/s^2]
    # Where the Huber loss turns linear, and the least deviation by which a signal is divided, in
    # units of each band's noise [1].
    huber_threshold: float = 1.0
    deviation_floor: float = 1.0
    stages: int = 9  # of the homotopy
    stage_steps: int = 9  # in each stage but the last
    # Weight of the reconstruction's normalised error in the first stage over `reconstruction` [1];
    # the last counts it in units of the noise.
    first_share: float = 1e-6
    steps: int = 80  # most in the last stage, which ends when
    patience: int = 8  # so many in a row lower the objective by less than
    tolerance: float = 1e-5  # this fraction [1]
    largest_step: float = 0.2  # change of an emissivity in a step [1]
    margin: float = 0.01  # least distance of an emissivity from 0 and 1 [1]
    start: str = "random"  # or "subspace"
    starts: int = 1  # of which the lowest objective is kept; 1 as published
    smooth_from_zero: bool = False  # a random start's smooth signal, as published
    bend_updates: int = 1  # times the response's nonlinearity is taken out; 0 as published
    temperatures_from: str = "corrected"  # for the estimated noise, or "measured"
    batch: int = 512  # pixels in a tile

    def __post_init__(self) -> None:
        """Refuse unknown choices and numbers outside their range."""
        check_fields(self, "dbvt")
        for name, allowed in _CHOICES.items():
            if getattr(self, name) not in allowed:
                message = f"Unknown {name} '{getattr(self, name)}' of method 'dbvt'"
                raise ValueError(f"{message}. Must be one of {allowed}.")
        weights = ("smoothness", "huber", "reconstruction", "noise", "noise_mean", "bend_updates")
        counts = ("stages", "stage_steps", "steps", "patience", "starts", "batch")
        for least, names in enumerate((weights, counts)):
            for name in names:
                holds = least <= getattr(self, name) < float("inf")
                require(self, "dbvt", name, holds, f"be at least {least}")
        positive = ("curvature", "huber_threshold", "deviation_floor")
        for name in (*positive, "first_share", "tolerance", "largest_step"):
            real_numbers(f"{name} of method 'dbvt'", getattr(self, name), POSITIVE)
        require(self, "dbvt", "margin", 0 < self.margin < 0.5, "lie in (0, 0.5)")


def separate(tile: Tile, settings: DbvtSettings) -> Estimate:
    """Point estimate of one tile; `not_converged` where the kept start was still improving."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        search = Search(tile, settings)
        loss, converged = search.run()
        # Start of least objective, for each pixel.
        pixels = tile.signals.shape[-1]
        finite = np.where(np.isfinite(loss), loss, np.inf).reshape(-1, pixels)
        kept = finite.argmin(axis=0) * pixels + np.arange(pixels)
        lost = ~np.isfinite(loss[kept])
        return _report(tile, search, kept, lost, lost | ~converged[kept])


def _inform(tile: Tile, emissivity: Array, smooth: Array) -> Mask:
    """Overwrite a start with the subspace separator's solution, where it is complete."""
    solution = subspace.separate(tile, subspace.SubspaceSettings())
    share = solution.emissivity[0]
    emitted = tile.blackbody(0, solution.object_temperature)
    solved = np.all(np.isfinite(emitted * share), axis=0)
    solved &= np.all((solution.emissivity > 0) & (solution.emissivity < 1), axis=0)
    # The smooth signal is that of the object before the median background.
    still = np.median(mixing.background(share, tile.signals[0], emitted), axis=0)
    emissivity[:, solved] = solution.emissivity[:, solved]
    smooth[:, solved] = mixing.mixed(share, emitted, still)[:, solved]
    return np.asarray(solved)


class Search:
    """Unknowns of all starts of a tile, see `dbvt_objective`: those of the first one, and so on."""

    def __init__(self, tile: Tile, settings: DbvtSettings) -> None:
        """Start at random emissivities, or at the subspace separator's solution."""
        self.tile, self.settings = tile, settings
        frames, pixels = tile.signals.shape[1:]
        columns = pixels * settings.starts
        emissivity = tile.rng.uniform(settings.margin, 1.0 - settings.margin, (2, columns))
        smooth = np.tile(tile.signals[0] * (not settings.smooth_from_zero), settings.starts)
        self.informed = np.zeros(columns, dtype=bool)
        if settings.start == "subspace":
            self.informed[:pixels] = _inform(tile, emissivity[:, :pixels], smooth[:, :pixels])
        # Mean over time of I_2 - k_1 [I1~(t) - I1~(0)]
        signals = np.tile(tile.signals, settings.starts)
        rise = emissivity[1] / emissivity[0] * (smooth - smooth[0])
        offset = np.mean(signals[1] - rise, axis=0) * (not settings.smooth_from_zero)
        self.scalars = np.stack([offset, *emissivity], axis=1)
        self.signals = np.moveaxis(signals, -1, 0).copy()
        self.films = np.zeros((columns, 3, frames))
        self.films[:, 0] = smooth.T
        values = {name: float(getattr(settings, name)) for name in objective.Weights._fields}
        steps = np.diff(tile.time)
        interval = float(np.median(steps))
        worst = int(np.argmax(np.abs(steps - interval)))
        if abs(steps[worst] - interval) > _UNEVEN * interval:
            raise ValueError(
                f"Invalid interval {steps[worst]:.3g} s of 'time' after {tile.time[worst]:.6g} s "
                f"for method 'dbvt'. Must be {interval:.3g} s throughout: its smoothness loss is "
                "of even frames."
            )
        values["curvature"] *= interval**2
        self.weights = objective.Weights(**values)

    def run(self) -> tuple[Array, Mask]:
        """Objective (column,) [1], and columns that stopped improving."""
        self._minimise(np.where(self.informed, 1, self.settings.stages))
        once = np.ones(self.informed.size, dtype=np.int64)
        end, bend = self._minimise(once), np.zeros(self.films[:, 0].shape)
        for _ in range(self.settings.bend_updates):
            update = self._nonlinearity()
            if np.array_equal(update, bend):
                break
            self.signals[:, 1] += bend - update
            bend, end = update, self._minimise(once)
        return end

    def _minimise(self, stages: npt.NDArray[np.int64]) -> tuple[Array, Mask]:
        """As `run`, of the images as they are, in a number of stages of each column."""
        loss, converged = np.empty(len(stages)), np.zeros(len(stages), dtype=bool)
        for column, number in enumerate(stages):
            for stage in range(number):
                progress = stage / (number - 1) if number > 1 else 1.0
                loss[column], converged[column] = self._descend(column, progress)
        return loss, converged

    def _descend(self, column: int, progress: float) -> tuple[float, bool]:
        """Minimise the objective of a column, with the reconstruction's weight of that progress."""
        settings, sigma, last = self.settings, self.tile.noise, progress == 1.0
        images, films, scalars = self.signals[column], self.films[column], self.scalars[column]
        deviation = [
            objective.deviation(*band, settings.deviation_floor)
            for band in zip(images, films[1:], sigma, strict=True)
        ]
        # share = first^(1 - progress), first = first_share (sigma_2 / deviation_2)^2
        first = min(settings.first_share * (sigma[1] / deviation[1]) ** 2, 1.0)
        scale = objective.Scale(sigma, tuple(deviation), first ** (1.0 - progress))
        steps = settings.steps if last else settings.stage_steps
        patience = settings.patience if last else steps + 1
        minimum = objective.descend(films, scalars, images, scale, self.weights, steps, patience)
        self.films[column], self.scalars[column], loss, converged = minimum
        return loss, converged

    def _nonlinearity(self) -> Array:
        r"""Departure of the second band from the linear identities (column, time) [K].

        .. math:: e_2 [u_2(x) - u_1(x)] + (1 - e_2) [u_2(y) - u_1(y)]

        Zero where a temperature leaves the range of the response, and for a linear one.
        """
        tile, (_, e1, e2) = self.tile, self.scalars.T[..., np.newaxis]
        first, second = np.moveaxis(self.signals - self.films[:, 1:], 1, 0)
        in_range, departures = np.ones(len(first), dtype=bool), []
        # u_1(x) = (z_2 - k_2 z_1) / (1 - k_2), u_1(y) = (z_2 - k_1 z_1) / (1 - k_1)
        for ratio in ((1 - e2) / (1 - e1), e2 / e1):
            signal = (second - ratio * first) / (1 - ratio)
            temperature, curve = tile.temperature(0, signal), tile.curves[0]
            within = (temperature >= curve.lowest) & (temperature <= curve.highest)
            in_range &= np.all(within, axis=1)
            departures.append(tile.blackbody(1, temperature) - signal)
        return np.where(in_range[:, np.newaxis], mixing.mixed(e2, *departures), 0.0)


def _report(
    tile: Tile, search: Search, kept: npt.NDArray[np.intp], lost: Mask, unfinished: Mask
) -> Estimate:
    """Temperatures at the emissivities of the kept columns, by the calibrated closed form."""
    emissivity, signals = search.scalars[kept, 1:].T, tile.signals
    if search.settings.temperatures_from == "corrected":
        signals = signals - np.moveaxis(search.films[kept, 1:], 0, -1)
    solution = calibrated.separate(
        replace(tile, signals=signals, emissivity=emissivity, emissivity_covariance=None),
        calibrated.CalibratedSettings(smooth=False),
    )
    # NaN where the pixel is lost, and everywhere in what this method does not estimate.
    missing = dict.fromkeys(("object_temperature", "background_temperature", "emissivity"), lost)
    missing |= dict.fromkeys(METHOD.not_estimated, np.ones_like(lost))
    arrays: dict[str, Any] = {
        name: np.where(pixels, np.nan, getattr(solution, name)) for name, pixels in missing.items()
    }
    status = solution.status | status_bits({Status.NOT_CONVERGED: unfinished})
    return replace(solution, **arrays, status=status)


METHOD: Final = Method(
    separate, DbvtSettings, "dbvt", minimum_frames=8, every_frame=True, not_estimated=WITHOUT_STD
)
"""The paper's optimiser, for `solve`."""
