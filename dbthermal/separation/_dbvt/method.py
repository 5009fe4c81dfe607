r"""The paper's optimiser, algorithm DBVT: smooth signals, noise and emissivities of every pixel.

The smooth signal :math:`\tilde I_1(t)`, the offset :math:`\tilde I_2(0)`, both emissivities and the
noise of every frame minimise five losses (`objective`); the temperatures follow in closed form
(`calibrated`). The objective is that of Narayanan et al. (2026), doi:10.48550/arXiv.2509.11334; the
search (`newton`) is ours.

A random start lies on the wrong side of equal emissivities half of the time, behind a ridge that
only the reconstruction makes: the other losses have one valley, that of the emission ratio. So a
homotopy raises its weight from stage to stage (Allgower, Georg 2003,
doi:10.1137/1.9780898719154). The paper's identities are linear in the temperatures: the
nonlinearity of an exact response is taken out of the second band, and the search goes on.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch
from torch import Tensor

from dbthermal import mixing
from dbthermal.schema import Status
from dbthermal.separation._baselines import WITHOUT_STD, calibrated
from dbthermal.separation._dbvt import DbvtSettings, newton, objective
from dbthermal.separation._dbvt.objective import Images, Unknowns
from dbthermal.separation._inputs import Method
from dbthermal.separation._quality import status_bits
from dbthermal.separation._subspace import method as subspace
from dbthermal.separation._tiles import Array, Estimate, Mask, Tile

# Largest departure of an interval from the median one, relative to it.
_UNEVEN: Final = 0.5
# Interval at which finished columns are removed from the search [step].
_SWEEP: Final = 10
# Number of torch's threads, which is the process's, before the first of several tiles.
_THREADS: Final = threading.Lock()
_BEFORE: Final[list[int]] = []


def separate(tile: Tile, settings: DbvtSettings) -> Estimate:
    """Point estimate of one tile; `not_converged` where the kept start was still improving."""
    ignored = np.errstate(invalid="ignore", divide="ignore", over="ignore")
    with ignored, torch.inference_mode(), _one_thread():
        minimum = _search(tile, settings)
        kept = _least(minimum.loss, tile.signals.shape[-1])
        return _report(tile, minimum, kept, settings)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Keep torch to the calling thread: tiles run side by side, and its threads would contend."""
    with _THREADS:
        _BEFORE.append(torch.get_num_threads())
        torch.set_num_threads(1)
    try:
        yield
    finally:
        with _THREADS:  # the first tile to begin stored the number that the last to end restores
            first = _BEFORE[0] if len(_BEFORE) == 1 else 1
            _BEFORE.pop()
            torch.set_num_threads(first)


@dataclass(frozen=True)
class Minimum:
    """End of a search: unknowns, objective (column,) [1], and columns that stopped improving."""

    unknowns: Unknowns
    loss: Tensor
    converged: Tensor


def homotopy(unknowns: Unknowns, images: Images, settings: DbvtSettings, stages: int) -> Minimum:
    """Minimise the objective from starts, the reconstruction's weight growing over the stages."""
    for stage in range(stages - 1):
        images = _weighted(unknowns, images, settings, stage / (stages - 1))
        search = newton.begin(unknowns, images, settings)
        for _ in range(settings.stage_steps):
            unknowns, search = newton.step(unknowns, search, images, settings)
    return _last_stage(unknowns, _weighted(unknowns, images, settings, 1.0), settings)


def _weighted(
    unknowns: Unknowns, images: Images, settings: DbvtSettings, progress: float
) -> Images:
    """Images with their deviation for the present noise, and the reconstruction's share."""
    deviation = objective.deviation(
        images.signals, unknowns.noise, images.sigma, settings.deviation_floor
    )
    # share = first^(1 - progress), first = first_share (sigma_2 / deviation_2)^2
    first = settings.first_share * (images.sigma[1] / deviation[1]) ** 2
    return replace(images, deviation=deviation, share=first.clamp(max=1.0) ** (1.0 - progress))


def _last_stage(unknowns: Unknowns, images: Images, settings: DbvtSettings) -> Minimum:
    """Steps until no column improves; finished columns are removed at intervals."""
    search = newton.begin(unknowns, images, settings)
    columns = torch.arange(search.loss.numel(), device=search.loss.device)
    state, progress, part = unknowns, search, images
    for count in range(1, settings.steps + 1):
        state, progress = newton.step(state, progress, part, settings)
        last = count == settings.steps
        if last or count % _SWEEP == 0:
            unknowns = unknowns.put(columns, state)
            search = search.put(columns, progress)
            active = progress.stalled < settings.patience
            columns = columns[active]
            if last or not bool(active.any()):
                break
            state, progress = state.select(active), progress.select(active)
            part = part.select(active)
    converged = (search.stalled >= settings.patience) & torch.isfinite(search.loss)
    return Minimum(unknowns, search.loss, converged)


def _even(time: Array) -> float:
    """Interval of an even clock [s]."""
    steps = np.diff(time)
    interval = float(np.median(steps))
    worst = int(np.argmax(np.abs(steps - interval)))
    if abs(steps[worst] - interval) > _UNEVEN * interval:
        raise ValueError(
            f"Invalid interval {steps[worst]:.3g} s of 'time' after {time[worst]:.6g} s for method "
            f"'dbvt'. Must be {interval:.3g} s throughout: its smoothness loss is of even frames."
        )
    return interval


def tensors(tile: Tile, columns: int, settings: DbvtSettings) -> Images:
    """Signals of a tile on the device, for every start; columns are pixels times starts."""
    one = _tensor(np.ones(columns), settings)
    signals = _tensor(tile.signals, settings).repeat(1, 1, columns // tile.signals.shape[-1])
    sigma = torch.stack([noise * one for noise in tile.noise])
    noise = torch.zeros_like(signals)
    deviation = objective.deviation(signals, noise, sigma, settings.deviation_floor)
    return Images(signals, deviation, sigma, one * _even(tile.time), one)


def _starts(tile: Tile, settings: DbvtSettings) -> tuple[Unknowns, Mask]:
    """Starts, and those of them (column,) that are the subspace separator's.

    Columns are the pixels of the first start, of the second, and so on.
    """
    frames, pixels = tile.signals.shape[1:]
    columns = pixels * settings.starts
    emissivity = tile.rng.uniform(settings.margin, 1.0 - settings.margin, (2, columns))
    smooth = np.tile(tile.signals[0] * (not settings.smooth_from_zero), settings.starts)
    informed = np.zeros(columns, dtype=bool)
    if settings.start == "subspace":
        informed[:pixels] = _inform(tile, emissivity[:, :pixels], smooth[:, :pixels])
    # Mean over time of I_2 - k_1 [I1~(t) - I1~(0)]
    second = np.tile(tile.signals[1], settings.starts)
    rise = emissivity[1] / emissivity[0] * (smooth - smooth[0])
    offset = np.mean(second - rise, axis=0) * (not settings.smooth_from_zero)
    noise = np.zeros((2, frames, columns))
    parts = (smooth, offset, emissivity, noise)
    return Unknowns(*(_tensor(part, settings) for part in parts)), informed


def _inform(tile: Tile, emissivity: Array, smooth: Array) -> Mask:
    """Overwrite a start with the subspace separator's solution, where it is complete."""
    solution = subspace.separate(tile, subspace.SubspaceSettings())
    share = solution.emissivity[0]
    emitted = tile.blackbody(0, solution.object_temperature)
    known = np.all(np.isfinite(emitted * share), axis=0)
    known &= np.all((solution.emissivity > 0) & (solution.emissivity < 1), axis=0)
    # The smooth signal is that of the object before the median background.
    rest = np.median(mixing.background(share, tile.signals[0], emitted), axis=0)
    emissivity[:, known] = solution.emissivity[:, known]
    smooth[:, known] = mixing.mixed(share, emitted, rest)[:, known]
    return np.asarray(known)


def _tensor(values: Array, settings: DbvtSettings) -> Tensor:
    dtype: torch.dtype = getattr(torch, settings.precision)
    return torch.as_tensor(values, dtype=dtype, device=settings.device)


def _search(tile: Tile, settings: DbvtSettings) -> Minimum:
    """Minimum of every start: random ones by homotopy, informed ones without."""
    unknowns, informed = _starts(tile, settings)
    images = tensors(tile, informed.size, settings)
    for mask, stages in ((~informed, settings.stages), (informed, 1)):
        columns = torch.as_tensor(np.flatnonzero(mask), device=images.share.device)
        if columns.numel():
            part = homotopy(unknowns.select(columns), images.select(columns), settings, stages)
            unknowns = unknowns.put(columns, part.unknowns)
    minimum = homotopy(unknowns, images, settings, 1)
    bend = np.zeros(unknowns.smooth.shape)
    for _ in range(settings.bend_updates):
        update = _nonlinearity(tile, minimum.unknowns, images, bend)
        if np.array_equal(update, bend):
            break
        bend = update
        signals = torch.stack([images.signals[0], images.signals[1] - _tensor(bend, settings)])
        minimum = homotopy(minimum.unknowns, replace(images, signals=signals), settings, 1)
    return minimum


def _nonlinearity(tile: Tile, unknowns: Unknowns, images: Images, bend: Array) -> Array:
    r"""Departure of the second band from the linear identities (time, column) [K].

    .. math:: e_2 [u_2(x) - u_1(x)] + (1 - e_2) [u_2(y) - u_1(y)]

    Zero where a temperature leaves the range of the response, and for a linear one.
    """
    emissivity = _array(unknowns.emissivity)
    first, second = _array(images.signals - unknowns.noise)
    second = second - bend
    emission, reflection = emissivity[1] / emissivity[0], (1 - emissivity[1]) / (1 - emissivity[0])
    inside, departures = np.ones(bend.shape[1], dtype=bool), []
    # u_1(x) = (z_2 - k_2 z_1) / (1 - k_2), u_1(y) = (z_2 - k_1 z_1) / (1 - k_1)
    for ratio in (reflection, emission):
        signal = (second - ratio * first) / (1 - ratio)
        temperature = tile.temperature(0, signal)
        curve = tile.curves[0]
        inside &= np.all((temperature >= curve.lowest) & (temperature <= curve.highest), axis=0)
        departures.append(tile.blackbody(1, temperature) - signal)
    return np.where(inside, mixing.mixed(emissivity[1], *departures), 0.0)


def _least(loss: Tensor, pixels: int) -> Tensor:
    """Column of the start of least objective, for each pixel."""
    finite = torch.where(torch.isfinite(loss), loss, torch.inf).reshape(-1, pixels)
    place = torch.arange(pixels, device=loss.device)
    return finite.argmin(dim=0) * pixels + place


def _report(tile: Tile, minimum: Minimum, kept: Tensor, settings: DbvtSettings) -> Estimate:
    """Temperatures at the emissivities of the kept columns, by the calibrated closed form."""
    unknowns = minimum.unknowns.select(kept)
    emissivity = _array(unknowns.emissivity)
    lost = ~np.isfinite(_array(minimum.loss[kept]))
    signals = tile.signals
    if settings.temperatures_from == "corrected":
        signals = signals - _array(unknowns.noise)
    solution = calibrated.separate(
        replace(tile, signals=signals, emissivity=emissivity, emissivity_covariance=None),
        calibrated.CalibratedSettings(smooth=False),
    )
    unfinished: Mask = lost | ~minimum.converged[kept].cpu().numpy()
    return replace(
        solution,
        **{name: np.full_like(getattr(solution, name), np.nan) for name in METHOD.not_estimated},
        status=solution.status | status_bits({Status.NOT_CONVERGED: unfinished}),
    ).undefine(lost, lost, lost)


def _array(values: Tensor) -> Array:
    return np.asarray(values.cpu().numpy(), dtype=np.float64)


METHOD: Final = Method(
    separate,
    settings=DbvtSettings,
    minimum_frames=8,
    every_frame=True,
    even_times=True,
    not_estimated=WITHOUT_STD,
)
"""The paper's optimiser, for `solve`."""
