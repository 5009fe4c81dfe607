r"""The paper's optimiser, algorithm DBVT: smooth signals, noise and emissivities of every pixel.

The smooth signal :math:`\tilde I_1(t)`, the offset :math:`\tilde I_2(0)`, both emissivities and the
noise of every frame minimise five losses (`objective`); the temperatures follow in closed form
(`calibrated`). The paper does not publish the losses' weights, the threshold, the descent, its
steps or when it stops: here they are `Settings`, chosen on simulated materials and noise levels.
The descent is as strong as we could make it (`descent`); it is not the paper's, the objective is.

The paper's identities are linear in the temperatures. With an exact response what bends the two
bands apart is taken out of the second band with the temperatures found, and the search goes on.

Narayanan, Ramanagopal, Narasimhan (2026), doi:10.48550/arXiv.2509.11334.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch
from torch import Tensor

from dbthermal.separation._baselines import calibrated
from dbthermal.separation._dbvt import objective
from dbthermal.separation._dbvt.homotopy import Minimum, minimise
from dbthermal.separation._dbvt.newton import Limits
from dbthermal.separation._dbvt.objective import Images, Unknowns, Weights
from dbthermal.separation._problem import Method, Problem
from dbthermal.separation._separated import Array, Mask, Separated, flag
from dbthermal.separation._subspace import method as subspace

STARTS: Final = ("random", "subspace")
"""Where the search may start."""
SIGNALS: Final = ("corrected", "measured")
"""What the temperatures may be computed from."""
PRECISIONS: Final = ("float64", "float32")
"""Floating-point types."""
# Largest departure of an interval from the median one, relative to it.
_UNEVEN: Final = 0.5
# torch's number of threads is the process's: what it was before the first of several tiles.
_THREADS: Final = threading.Lock()
_BEFORE: Final[list[int]] = []


@dataclass(frozen=True)
class DbvtSettings(Weights, Limits):
    """
    Options of the paper's optimiser; with those of `objective.Weights` and `descent.Limits`.

    Attributes
    ----------
    start : {"random", "subspace"}
        Emissivities uniform in (0, 1), as published; or emissivities and object of this project's
        own separator, and at random where it has none.
    starts : int
        Random starts, of which the one of least objective is kept; 1 as published. A start at the
        separator comes before them, and is one of them.
    smooth_from_zero : bool
        A random start's smooth signal is zero, as published, and not the signal itself.
    bend_updates : int
        How often what an exact response bends apart is taken out; 0 for the paper's linear
        identities.
    temperatures_from : {"corrected", "measured"}
        Signals without their estimated noise, or as measured.
    batch : int
        Pixels in a tile.
    device : str
        Where to compute, in torch's words: "cpu", "cuda".
    precision : {"float64", "float32"}
        Floating-point type.
    """

    start: str = "random"
    starts: int = 1
    smooth_from_zero: bool = False
    bend_updates: int = 1
    temperatures_from: str = "corrected"
    batch: int = 512
    device: str = "cpu"
    precision: str = "float64"

    def __post_init__(self) -> None:
        """Refuse choices that do not exist and numbers that are no search."""
        Weights.__post_init__(self)
        Limits.__post_init__(self)
        choices = {"start": STARTS, "temperatures_from": SIGNALS, "precision": PRECISIONS}
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed:
                raise ValueError(
                    f"Unknown {name} '{getattr(self, name)}' of method 'dbvt'. "
                    f"Must be one of {allowed}."
                )
        for name in ("starts", "batch"):
            if not getattr(self, name) >= 1:
                raise ValueError(
                    f"Invalid {name} {getattr(self, name)} of method 'dbvt'. Must be at least 1."
                )
        if torch.device(self.device).type == "cuda" and not torch.cuda.is_available():
            raise ValueError(f"Invalid device '{self.device}' of method 'dbvt'. None is here.")
        if not self.bend_updates >= 0:
            raise ValueError(
                f"Invalid bend_updates {self.bend_updates} of method 'dbvt'. Must be at least 0."
            )


def separate(problem: Problem, settings: DbvtSettings) -> Separated:
    """
    Separate one tile.

    Parameters
    ----------
    problem : Problem
        Signals of two bands.
    settings : DbvtSettings
        The objective and how it is minimised.

    Returns
    -------
    Separated
        Temperatures and emissivities, without deviations; `not_converged` where the kept start was
        still improving at the last step, or has no finite objective, which leaves NaN.

    Raises
    ------
    ValueError
        If the frames are not evenly spaced in time, or the device is not there.
    """
    quiet = np.errstate(invalid="ignore", divide="ignore", over="ignore")
    with quiet, torch.inference_mode(), _one_thread():
        minimum = _search(problem, settings)
        kept = _choice(minimum.loss, problem.signals.shape[-1])
        return _report(problem, minimum, kept, settings)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Keep torch to the calling thread: tiles run side by side, and its threads would contend."""
    with _THREADS:
        _BEFORE.append(torch.get_num_threads())
        torch.set_num_threads(1)
    try:
        yield
    finally:
        with _THREADS:  # the first tile to begin found the number that the last to end leaves
            first = _BEFORE[0] if len(_BEFORE) == 1 else 1
            _BEFORE.pop()
            torch.set_num_threads(first)


def _even(time: Array) -> float:
    """Interval of an even clock [s]."""
    steps = np.diff(time)
    interval = float(np.median(steps))
    away = int(np.argmax(np.abs(steps - interval)))
    if abs(steps[away] - interval) > _UNEVEN * interval:
        raise ValueError(
            f"Invalid interval {steps[away]:.3g} s after {time[away]:.3g} s for method 'dbvt'. "
            f"Must be {interval:.3g} s throughout: its smoothness loss is of even frames."
        )
    return interval


def images(problem: Problem, columns: int, settings: DbvtSettings) -> Images:
    """
    Bring a tile to the device.

    Parameters
    ----------
    problem : Problem
        The tile.
    columns : int
        Pixels times starts.
    settings : DbvtSettings
        Device and precision.

    Returns
    -------
    Images
        The tile for every start, with all of the reconstruction's weight.
    """
    like = _tensor(np.ones(columns), settings)
    signals = _tensor(problem.signals, settings).repeat(1, 1, columns // problem.signals.shape[-1])
    sigma = torch.stack([noise * like for noise in problem.noise])
    interval = like * _even(problem.time)
    none = torch.zeros_like(signals)
    deviation = objective.deviation(signals, none, sigma, settings.deviation_floor)
    return Images(signals, deviation, sigma, interval, like)


def start(problem: Problem, settings: DbvtSettings) -> tuple[Unknowns, Mask]:
    """
    Draw the starts.

    Parameters
    ----------
    problem : Problem
        The tile, with its source of randomness.
    settings : DbvtSettings
        How many, and where.

    Returns
    -------
    Unknowns
        Columns are the pixels of the first start, of the second, and so on.
    ndarray of bool, shape (column,)
        Which of them start at what the subspace separator found.
    """
    frames, pixels = problem.signals.shape[1:]
    columns = pixels * settings.starts
    drawn = problem.rng.uniform(settings.margin, 1.0 - settings.margin, (2, columns))
    smooth = np.tile(problem.signals[0] * (not settings.smooth_from_zero), settings.starts)
    informed = np.zeros(columns, dtype=bool)
    if settings.start == "subspace":
        informed[:pixels] = _inform(problem, drawn[:, :pixels], smooth[:, :pixels])
    second = np.tile(problem.signals[1], settings.starts)
    rise = drawn[1] / drawn[0] * (smooth - smooth[0])
    offset = np.mean(second - rise, axis=0) * (not settings.smooth_from_zero)
    nothing = np.zeros((2, frames, columns))
    return Unknowns(
        *(_tensor(part, settings) for part in (smooth, offset, drawn, nothing))
    ), informed


def _inform(problem: Problem, emissivity: Array, smooth: Array) -> Mask:
    """Overwrite a start with what the subspace separator finds, where it finds all of it."""
    found = subspace.separate(problem, subspace.SubspaceSettings())
    emitted = problem.blackbody(0, found.object_temperature) * found.emissivity[0]
    known = np.all(np.isfinite(emitted), axis=0)
    known &= np.all((found.emissivity > 0) & (found.emissivity < 1), axis=0)
    rest = np.median(problem.signals[0] - emitted, axis=0)
    emissivity[:, known] = found.emissivity[:, known]
    smooth[:, known] = (emitted + rest)[:, known]
    return np.asarray(known)


def _tensor(values: Array, settings: DbvtSettings) -> Tensor:
    dtype: torch.dtype = getattr(torch, settings.precision)
    return torch.as_tensor(values, dtype=dtype, device=settings.device)


def _search(problem: Problem, settings: DbvtSettings) -> Minimum:
    """All starts to their end."""
    unknowns, informed = start(problem, settings)
    given = images(problem, informed.size, settings)
    for mask, stages in ((~informed, settings.stages), (informed, 1)):
        columns = torch.as_tensor(np.flatnonzero(mask), device=given.share.device)
        if columns.numel():
            part = minimise(
                unknowns.taken(columns), given.taken(columns), settings, settings, stages
            )
            unknowns = unknowns.put(columns, part.unknowns)
    minimum = minimise(unknowns, given, settings, settings, 1)
    bend = np.zeros(unknowns.smooth.shape)
    for _ in range(settings.bend_updates):
        straight = _straightened(problem, minimum, given, bend)
        if np.array_equal(straight, bend):
            break
        bend = straight
        signals = torch.stack([given.signals[0], given.signals[1] - _tensor(bend, settings)])
        minimum = minimise(minimum.unknowns, replace(given, signals=signals), settings, settings, 1)
    return minimum


def _straightened(problem: Problem, minimum: Minimum, given: Images, bend: Array) -> Array:
    r"""
    What bends the two bands apart, :math:`e_2 [u_2(x) - u_1(x)] + (1 - e_2) [u_2(y) - u_1(y)]`.

    Zero where a temperature leaves the range of the response, and for a linear one.
    """
    emissivity = _array(minimum.unknowns.emissivity)
    first, second = _array(given.signals - minimum.unknowns.noise)
    second = second - bend
    emission, reflection = emissivity[1] / emissivity[0], (1 - emissivity[1]) / (1 - emissivity[0])
    shares = (emissivity[1], 1 - emissivity[1])
    total, outside = np.zeros_like(bend), np.zeros(bend.shape[1], dtype=bool)
    for ratio, share in zip((reflection, emission), shares, strict=True):
        signal = (second - ratio * first) / (1 - ratio)
        temperature = problem.temperature(0, signal)
        inside = (temperature >= problem.curves[0].lowest) & (
            temperature <= problem.curves[0].highest
        )
        outside |= ~np.all(inside, axis=0)
        total += share * (problem.blackbody(1, temperature) - signal)
    return np.where(outside, 0.0, total)


def _choice(loss: Tensor, pixels: int) -> Tensor:
    """Column of the start of least objective, for each pixel."""
    finite = torch.where(torch.isfinite(loss), loss, torch.inf).reshape(-1, pixels)
    place = torch.arange(pixels, device=loss.device)
    return finite.argmin(dim=0) * pixels + place


def _report(problem: Problem, minimum: Minimum, kept: Tensor, settings: DbvtSettings) -> Separated:
    """Temperatures from the emissivities, by the closed form and Newton's steps."""
    unknowns = minimum.unknowns.taken(kept)
    emissivity = _array(unknowns.emissivity)
    lost = ~np.isfinite(_array(minimum.loss[kept]))
    signals = problem.signals
    if settings.temperatures_from == "corrected":
        signals = signals - _array(unknowns.noise)
    found = calibrated.separate(
        replace(problem, signals=signals, emissivity=emissivity, emissivity_std=None)
    )
    unfinished: Mask = lost | ~minimum.converged[kept].cpu().numpy()
    return replace(
        found,
        **{name: np.full_like(getattr(found, name), np.nan) for name in METHOD.not_estimated},
        status=found.status | flag({"not_converged": unfinished}),
    ).without(lost, lost, lost)


def _array(values: Tensor) -> Array:
    return np.asarray(values.cpu().numpy(), dtype=np.float64)


METHOD: Final = Method(
    separate,
    settings=DbvtSettings,
    minimum_frames=8,
    every_frame=True,
    not_estimated=("object_temperature_std", "background_temperature_std", "emissivity_std"),
)
"""The paper's optimiser, for `solve`."""
