r"""Steps 1 to 4 of `method` for two bands, one pixel after another, compiled.

The equations of `steps`, whose results are repeated within rounding.
"""

import hashlib
from collections.abc import Callable
from contextlib import suppress
from math import sqrt
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.special import stdtrit

from dbthermal import _smooth as smooth
from dbthermal import planck
from dbthermal._arrays import Array
from dbthermal.separation import _tiles as tiles
from dbthermal.separation._subspace import emission as emissions
from dbthermal.separation._subspace import kernels, pieces, pixel, reflection_ratio, residuals
from dbthermal.separation._subspace.kernels import compiled
from dbthermal.separation._subspace.pixel import Ratio
from dbthermal.separation._subspace.shared import Model, Work
from dbthermal.separation._subspace.steps import FILMS, Solution
from dbthermal.separation._tiles import Tile

_BLOCK: Final = 16  # pixels whose samples are turned at once


@compiled
def _unsteady(
    model: Model, ratios: Ratio, residual: Array, rapid: Array
) -> tuple[float, float, bool]:
    """Autocorrelation, delay of the bands, and whether the residual is noise; see `residuals`."""
    frames, null, noise = residual.size, ratios.null_variance, model.noise[0]
    energy = kernels.dot(residual, residual)
    lagged = 0.0
    for lag in range(1, residuals.LAGS + 1):
        lagged += kernels.dot(residual[lag:], residual[: frames - lag])
    correlation = lagged / (residuals.LAGS * energy) if energy > 0 else 0.0
    free = frames - ratios.order - model.steps
    common = ratios.weights[0] * noise**2
    late, early, changes = free * common, -free * common, 0.0
    edge, limit = False, residuals.CHANGE * sqrt(2.0) * noise
    count, at_changes = 0, 0.0
    for t in range(frames):
        steep = False
        if t + 1 < frames:
            change = rapid[t + 1] - rapid[t]
            late += residual[t] * change
            early += residual[t + 1] * change
            changes += change**2
            steep = abs(change) > limit
        if steep or edge:
            count += 1
            at_changes += residual[t] ** 2 / null
        edge = steep
    score = max(abs(late), abs(early)) / sqrt(null * changes) if null * changes > 0 else 0.0
    variance = 2.0 / (9.0 * max(count, 1))
    mean = at_changes / count if count > 0 else 1.0
    score = max(score, (mean ** (1.0 / 3.0) - (1.0 - variance)) / sqrt(variance))
    return (
        correlation * sqrt(residuals.LAGS * frames),
        score,
        _unexplained(model, ratios, residual, rapid, common),
    )


@compiled
def _unexplained(model: Model, ratios: Ratio, residual: Array, rapid: Array, common: float) -> bool:
    """As `residuals.unexplained`."""
    blocks = model.edges.size - 1
    sums, together = np.zeros(blocks), 0.0
    leverage = model.leverage[ratios.order - 1]
    for block in range(blocks):
        product, square = 0.0, 0.0
        for t in range(model.edges[block], model.edges[block + 1]):
            sums[block] += residual[t]
            product += residual[t] * rapid[t] - common * (1.0 - leverage[t])
            square += rapid[t] ** 2
        together += product**2 / square if square > 0 else 0.0
    if together / ratios.null_variance > model.limits[0]:
        return True
    edges, step = model.edges, 1
    while blocks > 1:
        for block in range(blocks):
            length = edges[(block + 1) * step] - edges[block * step]
            if sums[block] ** 2 > model.limits[1] * ratios.null_variance * length:
                return True
        blocks //= 2
        step *= 2
        for block in range(blocks):
            sums[block] = sums[2 * block] + sums[2 * block + 1]
    return False


@compiled
def _film(
    temperature: Array, variance: Array, model: Model, value: Any, std: Any
) -> tuple[int, int, bool]:
    """A temperature and its deviation, NaN where useless; samples lost, NaN, and out of range."""
    lost, missing, beyond = 0, 0, False
    for t in range(temperature.size):
        one, deviation = temperature[t], sqrt(variance[t])
        missing += np.isnan(one)
        margin = tiles.RANGE_SIGMAS * (0.0 if np.isnan(deviation) else deviation)
        beyond |= one < model.lowest - margin or one > model.highest + margin
        if abs(one) < tiles.USELESS and deviation < tiles.USELESS:
            value[t], std[t] = one, deviation
        else:
            lost += 1
            value[t], std[t] = np.nan, np.nan
    return lost, missing, beyond


_NUMBERS: Final = (
    *("ratio", "inverse_energy", "first_weight", "second_weight", "null_variance", "order"),
    *("contrast", "reduced_chi2", "first_emissivity", "second_emissivity", "epsilon"),
    *("ratio_variance", "noise_variance", "drift_variance", "correlation", "delay"),
    *("object_lost", "object_missing", "background_lost", "background_missing"),
)
_CONDITIONS: Final = (
    *("pooled", "gray", "constant", "restless", "rough", "object_beyond", "background_beyond"),
)
_SYMMETRIC: Final = [("covariance", np.float64, 3), ("scatter", np.float64, 3)]
RECORD: Final = np.dtype(
    [(name, np.float64) for name in _NUMBERS]
    + [(name, np.bool_) for name in _CONDITIONS]
    + [*_SYMMETRIC, ("rapid_scatter", np.float64, (2, 3))]
)
"""Numbers of a pixel; a symmetric matrix of two bands as its first, mixed and last element."""


class Solved(NamedTuple):
    """Films, numbers and sums of all pixels."""

    films: npt.NDArray[np.float32]  # object, deviation, background, deviation (4, time, pixel) [K]
    record: Any  # `RECORD` (pixel)
    sums: Array  # (pixel, 2, block) [K]


@compiled
def _energy(bend: Array, removed: Array) -> float:
    """Energy about the mean of what a bend has changed."""
    total, square = 0.0, 0.0
    for t in range(bend.size):
        change = bend[t] - removed[t]
        total += change
        square += change**2
    return square - total**2 / bend.size


@compiled
def _pixel(model: Model, least: float, work: Work, films: Any, record: Any, sums: Array) -> None:
    """Steps 1 to 4, on the exact model where it matters, and all that the flags need."""
    straight, bend, change = work.straight, work.bend, work.change
    orders, steps = model.leverage.shape[0], model.steps
    z, other, coefficients = work.first, work.second, work.coefficients
    scatter = work.scatter
    straight[:] = other
    change[:] = 0.0
    ratios, emission = pixel.solve(model, work)
    gray = pixel.may_be_gray(model, ratios)
    for _ in range(emissions.BENDS):
        energy = _energy(bend, change)
        if not energy > (least * model.noise[1]) ** 2:
            break
        least = emissions.BEND
        for t in range(z.size):
            change[t] = bend[t]
            straight[t] = other[t] - bend[t]
        ratios, emission = pixel.solve(model, work)
    count, w = ratios.order + steps, ratios.weights
    residual, rapid, curve = work.null_residual, work.rapid, work.target
    combined = w[0] * coefficients[0] + w[1] * coefficients[1]
    kernels.combined(model.functions, coefficients[0], count, rapid)
    kernels.combined(model.functions, combined, count, residual)
    for t in range(z.size):
        rapid[t] = z[t] - rapid[t]
        residual[t] = w[0] * z[t] + w[1] * straight[t] - residual[t]
    correlation, delay, rough = _unsteady(model, ratios, residual, rapid)
    for block in range(model.parts.size - 1):
        for t in range(model.parts[block], model.parts[block + 1]):
            sums[0, block] += residual[t]
            sums[1, block] += curve[t]
    lost, missing, beyond = _film(work.temperature, work.variance, model, films[0], films[1])
    record.object_lost, record.object_missing, record.object_beyond = lost, missing, beyond
    lost, missing, beyond = _film(
        work.background, work.background_variance, model, films[2], films[3]
    )
    record.background_lost, record.background_missing = lost, missing
    record.background_beyond = beyond
    record.ratio, record.inverse_energy = ratios.ratio, ratios.inverse_energy
    record.first_weight, record.second_weight = w
    record.null_variance, record.order = ratios.null_variance, ratios.order
    record.contrast, record.reduced_chi2 = ratios.contrast, ratios.reduced_chi2
    record.pooled, record.gray = ratios.pooled, gray
    record.first_emissivity, record.second_emissivity = emission.emissivity
    record.epsilon = emission.epsilon
    error = model.noise[1] ** 2 + (ratios.ratio * model.noise[0]) ** 2  # eq. 4
    record.ratio_variance = ratios.inverse_energy * error + emission.level**2
    record.noise_variance = emission.noise_variance
    record.drift_variance = emission.drift_variance
    record.constant, record.restless = emission.constant, emission.restless
    record.correlation, record.delay, record.rough = correlation, delay, rough
    for i in range(3):
        record.covariance[i], record.scatter[i] = emission.covariance[i], ratios.scatter[i]
    for place in range(2):
        order = max(1, orders - reflection_ratio.FEWER * (1 - place))
        for i in range(3):
            free = 0.0 if i == 1 else z.size - steps - order
            record.rapid_scatter[place, i] = scatter[order - 1, i] - free


@compiled
def _turn(samples: Any, start: int, size: int, turned: Any) -> None:
    """Samples (kind, time, pixel) of a few pixels as (kind, pixel, time), in place."""
    for kind in range(turned.shape[0]):
        for t in range(turned.shape[2]):
            for p in range(size):
                turned[kind, p, t] = samples[kind, t, start + p]


@compiled
def _return(turned: Any, start: int, size: int, samples: Any) -> None:
    """The reverse of `_turn`, in place."""
    for kind in range(turned.shape[0]):
        for t in range(turned.shape[2]):
            for p in range(size):
                samples[kind, t, start + p] = turned[kind, p, t]


def _compiled(digest: str) -> Callable[..., None]:
    """Steps of all pixels of a tile, compiled once for sources of one digest."""

    @njit(nogil=True, error_model="numpy")
    def separate(
        model: Model, signals: Array, materials: Array, least: float, work: Work, solved: Solved
    ) -> None:
        if not digest:  # a constant of the compiled code, which is kept with it
            return
        frames, pixels = signals.shape[1:]
        inside, outside = np.empty((2, _BLOCK, frames)), np.empty((4, _BLOCK, frames), np.float32)
        for start in range(0, pixels, _BLOCK):
            size = min(_BLOCK, pixels - start)
            _turn(signals, start, size, inside)
            for p in range(size):
                here = start + p
                work.first[:], work.second[:] = inside[0, p], inside[1, p]
                work.material[:] = materials[here]
                _pixel(model, least, work, outside[:, p], solved.record[here], solved.sums[here])
            _return(outside, start, size, solved.films)

    with suppress(RuntimeError):  # without a folder that may be written each process compiles
        separate.enable_caching()
    return separate


_SOURCES: Final = [*Path(__file__).parent.glob("*.py"), Path(planck.__file__), Path(tiles.__file__)]
_separate: Final = _compiled(
    hashlib.sha256(b"".join(one.read_bytes() for one in sorted(_SOURCES))).hexdigest()
)


def _share(tile: Tile, functions: smooth.Subspace, drift: float) -> Model:
    """All that the pixels of a tile of two bands share."""
    first, second = tile.curves
    around = tile.reference + np.array([-0.5, 0.5])  # [K]
    rates = np.diff(np.log(second.slope(around) / first.slope(around)))
    temperatures = np.linspace(first.lowest, first.highest, reflection_ratio.TEMPERATURES)
    degrees = functions.rising.shape[1]
    freedom = [min(high - 1, degrees) - low + 1 - lost for low, high, lost in emissions.OCTAVES]
    edges, limits = residuals.blocks(tile.time.size)
    return Model(
        first=kernels.table(first),
        second=kernels.table(second),
        functions=np.ascontiguousarray(functions.functions.T),
        object_part=np.ascontiguousarray(functions.object_part.T),
        rising=np.ascontiguousarray(functions.rising.T),
        leverage=np.ascontiguousarray(functions.leverage().T),
        steps=int(functions.steps),
        noise=(float(tile.noise[0]), float(tile.noise[1])),
        pattern=(0.0, 0.0) if tile.pattern is None else (tile.pattern[0], tile.pattern[1]),
        drift=drift / np.sqrt(3.0),
        rate=float(rates[0]),
        gray=second.slope(temperatures) / first.slope(temperatures),
        widened=(stdtrit(np.maximum(freedom, 1), 0.975) / emissions.NORMAL95) ** 2,
        edges=edges,
        limits=limits,
        parts=pieces.blocks(tile.time.size),
        lowest=first.lowest,
        highest=first.highest,
    )


def _work_space(functions: smooth.Subspace) -> Work:
    """Arrays for the signals and curves of one pixel."""
    frames, columns = functions.functions.shape
    rest: dict[str, Any] = {
        "few": np.empty((6, frames), np.float32),
        "coefficients": np.empty((2, columns)),
        "scatter": np.empty((functions.orders, 3)),
        "material": np.empty(5),
    }
    return Work(**{name: np.empty(frames) for name in Work._fields} | rest)


def solve(
    tile: Tile, functions: smooth.Subspace, drift: float, least: float = emissions.BEND
) -> Solution:
    """As `steps.solve`, of two bands."""
    work, shared = _work_space(functions), _share(tile, functions, drift)
    material = tile.material
    frames, pixels = tile.signals.shape[1:]
    materials = np.full((pixels, 5), np.nan)
    if material is not None:
        numbers = (material.ratio[1], material.inverse_energy, material.emissivity)
        materials[:] = np.stack([*numbers, material.noise_variance, material.drift_variance], 1)
    films = np.empty((4, frames, pixels), np.float32)
    record, sums = np.zeros(pixels, RECORD), np.zeros((pixels, 2, shared.parts.size - 1))
    signals = np.ascontiguousarray(tile.signals, dtype=np.float64)
    _separate(shared, signals, materials, float(least), work, Solved(films, record, sums))
    # The first, mixed and last element of a symmetric matrix (..., 3), as one (..., 2, 2, pixel).
    covariance, scatter, rapid = (
        np.moveaxis(record[name][..., [[0, 1], [1, 2]]], 0, -1)
        for name in ("covariance", "scatter", "rapid_scatter")
    )
    single = (
        *("inverse_energy", "null_variance", "contrast", "reduced_chi2", "pooled", "gray"),
        *("noise_variance", "drift_variance", "constant", "restless", "correlation", "delay"),
    )
    named: dict[str, Any] = {name: record[name] for name in single}
    for name in ("missing", "lost", "beyond"):
        named[name] = np.stack([record[f"object_{name}"], record[f"background_{name}"]])
    named |= zip(FILMS, films, strict=True)
    return Solution(
        ratio=np.stack([np.ones(pixels), record["ratio"]]),
        ratio_variance=np.stack([np.zeros(pixels), record["ratio_variance"]]),
        null_weights=np.stack([record["first_weight"], record["second_weight"]]),
        order=record["order"].astype(np.intp),
        scatter=scatter,
        rapid_scatter=rapid,
        emissivity=np.stack([record["first_emissivity"], record["second_emissivity"]]),
        emissivity_covariance=covariance,
        epsilon_variance=record["epsilon"],
        unexplained=record["rough"],
        sums=sums.transpose(1, 2, 0),
        **named,
    )
