r"""Steps 1 to 4 of `method` for two bands, one pixel after another, compiled.

The equations of `steps`, whose results are repeated within rounding.
"""

from collections.abc import Iterable
from functools import lru_cache
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import stdtrit

from dbthermal import _smooth as smooth
from dbthermal._arrays import Array
from dbthermal.response import Curve
from dbthermal.separation import _tiles as tiles
from dbthermal.separation._subspace import bars, kernels, pieces, pixel, reflection_ratio, residuals
from dbthermal.separation._subspace import emission as emissions
from dbthermal.separation._subspace.kernels import inlined
from dbthermal.separation._subspace.pixel import Model, Ratio, Work
from dbthermal.separation._subspace.steps import FILMS, Solution
from dbthermal.separation._tiles import Tile, Whole

# Samples that are turned at once, to stay in the cache, and the fewest pixels.
_TURNED: Final = 2**14
_BLOCK: Final = 8
_VECTOR: Final = 64  # numbers that a loop takes at once, at most
_PAGE, _APART = 512, 24  # numbers of a page, and of three lines of the cache
_ZERO, _ONE, _NAN = np.float32(0.0), np.float32(1.0), np.float32(np.nan)
_SIGMAS, _USELESS = np.float32(tiles.RANGE_SIGMAS), np.float32(tiles.USELESS)


@inlined
def _film(
    temperature: Array, variance: Array, model: Model, value: Any, std: Any
) -> tuple[Any, Any, Any]:
    """A temperature and its deviation, NaN where useless; and what is wrong with them."""
    lost, missing, beyond, zero, one = _ZERO, _ZERO, _ZERO, _ZERO, _ONE
    lowest, highest = np.float32(model.lowest), np.float32(model.highest)
    for t in range(temperature.size):
        kelvin, deviation = np.float32(temperature[t]), np.sqrt(np.float32(variance[t]))
        missing += one if np.isnan(kelvin) else zero
        margin = _SIGMAS * (zero if np.isnan(deviation) else deviation)
        beyond += one if (kelvin < lowest - margin) | (kelvin > highest + margin) else zero
        useful = (abs(kelvin) < _USELESS) & (deviation < _USELESS)
        value[t] = kelvin if useful else _NAN
        std[t] = deviation if useful else _NAN
    for t in range(temperature.size):  # not above: it would not be taken many at once
        lost += one if np.isnan(value[t]) else zero
    return lost, missing, beyond > zero


_FIELDS: Final[dict[Any, dict[str, tuple[int, ...]]]] = {
    np.float64: {
        **dict.fromkeys(["inverse_energy", "null_variance", "contrast", "reduced_chi2"], ()),
        **dict.fromkeys(["epsilon_variance", "noise_variance", "drift_variance"], ()),
        **dict.fromkeys(["correlation", "delay", "cost"], ()),
        **dict.fromkeys(["ratio", "ratio_variance", "null_weights", "emissivity"], (2,)),
        **dict.fromkeys(["missing", "lost"], (2,)),
        **dict.fromkeys(["scatter", "emissivity_covariance"], (2, 2)),
        "rapid_scatter": (2, 2, 2),
    },
    np.bool_: {
        **dict.fromkeys(["pooled", "gray", "constant", "restless", "unexplained"], ()),
    },
    np.intp: {"order": (), "beyond": (2,)},  # no arrays of truth values in a record
}
RECORD: Final = np.dtype(
    [(name, kind, shape) for kind, shapes in _FIELDS.items() for name, shape in shapes.items()]
)
"""Numbers of a pixel, the fields of a `Solution` without films and sums."""


class Solved(NamedTuple):
    """Films, numbers and sums of all pixels."""

    films: npt.NDArray[np.float32]  # object, deviation, background, deviation (4, time, pixel) [K]
    record: Any  # `RECORD` (pixel)
    sums: Array  # (2, block, pixel) [K]


@inlined
def _energy(bend: Array, removed: Array) -> float:
    """Energy about the mean of what a bend has changed."""
    total, square = 0.0, 0.0
    for t in range(bend.size):
        change = bend[t] - removed[t]
        total += change
        square += change**2
    return square - total**2 / bend.size


@inlined
def _pixel(model: Model, least: float, work: Work, films: Any, record: Any, sums: Array) -> None:
    """Steps 1 to 4, on the exact model where it matters, and all that the flags need."""
    kernels.copy(work.second, work.straight)
    kernels.fill(work.removed, 0.0)
    gray, again = False, 0
    while True:
        ratios = pixel.ratios(model, work)
        line = pixel.emission(model, ratios, work, again)
        pixel.background(model, line, work)
        # The bend of a gray body is not known: it is told from the signals as they are.
        if again == 0:
            gray, used = pixel.may_be_gray(model, ratios), ratios.order + model.steps
            free = work.bend.size - used
            record.cost = ratios.reduced_chi2 * free + pieces.COST * used  # eq. 12
        energy = _energy(work.bend, work.removed)
        if again == emissions.BENDS or not energy > (least * model.noise[1]) ** 2:
            break
        least, again = emissions.BEND, again + 1
        for t in range(work.bend.size):
            work.removed[t] = work.bend[t]
            work.straight[t] = work.second[t] - work.bend[t]
    deviations = bars.bars(model, ratios, line, work)
    bars.judge(model, ratios, work, record, sums)
    object_ = _film(work.temperature, work.variance, model, films[0], films[1])
    background = _film(work.background, work.background_variance, model, films[2], films[3])
    for i, judged in enumerate((object_, background)):
        record.lost[i], record.missing[i], record.beyond[i] = judged
    _write_ratio(model, ratios, deviations.level, record)
    _write_scatter(model, ratios, work.scatter, record)
    record.gray, record.constant, record.restless = gray, line.constant, deviations.restless
    record.epsilon_variance = deviations.epsilon
    record.noise_variance = deviations.noise_variance
    record.drift_variance = deviations.drift_variance
    record.emissivity[0], record.emissivity[1] = line.emissivity
    _write_symmetric(deviations.covariance, record.emissivity_covariance)


@inlined
def _write_ratio(model: Model, ratios: Ratio, level: float, record: Any) -> None:
    record.ratio[0], record.ratio[1] = 1.0, ratios.ratio
    error = model.noise[1] ** 2 + (ratios.ratio * model.noise[0]) ** 2  # eq. 4
    record.ratio_variance[1] = ratios.inverse_energy * error + level**2
    record.inverse_energy, record.null_variance = ratios.inverse_energy, ratios.null_variance
    record.null_weights[0], record.null_weights[1] = ratios.weights
    record.order, record.pooled = ratios.order, ratios.pooled
    record.contrast, record.reduced_chi2 = ratios.contrast, ratios.reduced_chi2


@inlined
def _write_scatter(model: Model, ratios: Ratio, scatter: Array, record: Any) -> None:
    """Scatter less noise, at the order of the pixel and at `reflection_ratio.rapid_orders`."""
    _write_symmetric(ratios.scatter, record.scatter)
    orders, rows = len(scatter), model.functions.shape[1] - model.steps
    for place in range(2):
        order = max(1, orders - reflection_ratio.FEWER * (1 - place))
        a, b, d = scatter[order - 1]
        free = rows - order
        _write_symmetric((a - free, b, d - free), record.rapid_scatter[place])


@inlined
def _write_symmetric(elements: tuple[float, float, float], matrix: Any) -> None:
    """First, mixed and last element of a symmetric matrix, in place."""
    matrix[0, 0], matrix[0, 1], matrix[1, 0] = elements[0], elements[1], elements[1]
    matrix[1, 1] = elements[2]


@inlined
def _turn(samples: Any, places: Whole, turned: Any) -> None:
    """Samples (kind, time, pixel) of a few pixels as (pixel, kind, time), in place."""
    for kind in range(turned.shape[1]):
        for t in range(turned.shape[2]):
            row = samples[kind, t]
            for p in range(places.size):
                turned[p, kind, t] = row[np.uintp(places[p])]


@inlined
def _return(turned: Any, places: Whole, samples: Any) -> None:
    """The reverse of `_turn`, in place."""
    for kind in range(turned.shape[1]):
        for t in range(turned.shape[2]):
            row = samples[kind, t]
            for p in range(places.size):
                row[np.uintp(places[p])] = turned[p, kind, t]


@kernels.entered
def _separate(
    model: Model,
    signals: Array,
    places: Whole,
    materials: Array,
    least: float,
    work: Work,
    solved: Solved,
) -> None:
    """Steps of some pixels of a tile."""
    inside, outside, pixels = work.inside, work.outside, places.size
    block = len(inside)
    for start in range(0, pixels, block):
        together = places[start : start + block]
        _turn(signals, together, inside)
        for p in range(together.size):
            here = np.uintp(together[p])
            kernels.copy(inside[p, 0], work.first)
            kernels.copy(inside[p, 1], work.second)
            kernels.copy(materials[here], work.material)
            _pixel(model, least, work, outside[p], solved.record[here], solved.sums[..., here])
        _return(outside, together, solved.films)


def _share(tile: Tile, functions: smooth.Subspace, drift: float) -> Model:
    """All that the pixels of a tile of two bands share."""
    first, second = tile.curves
    rate, gray = _ratios(first, second)
    degrees = functions.rising.shape[1]
    freedom = [min(high - 1, degrees) - low + 1 - lost for low, high, lost in emissions.OCTAVES]
    edges, limits = residuals.blocks(tile.time.size)
    return Model(
        first=kernels.table(first, second),
        second=kernels.table(second, first),
        **_columns(functions),
        rising=np.ascontiguousarray(functions.rising.T),
        whole=np.full((degrees, 2), [0, tile.time.size]),
        spread=float(np.ptp(functions.rising[:, 0])),
        noise=(float(tile.noise[0]), float(tile.noise[1])),
        pattern=(0.0, 0.0) if tile.pattern is None else (tile.pattern[0], tile.pattern[1]),
        drift=drift / np.sqrt(3.0),
        rate=rate,
        gray=gray,
        widened=(stdtrit(np.maximum(freedom, 1), 0.975) / emissions.NORMAL95) ** 2,
        edges=edges,
        limits=limits,
        parts=pieces.blocks(tile.time.size),
        lowest=first.lowest,
        highest=first.highest,
    )


def _columns(functions: smooth.Subspace) -> dict[str, Any]:
    """Fields of a `Model` that hold functions of time, columns along it."""
    columns = np.ascontiguousarray(functions.functions.T)
    stepless = functions.object_part is functions.functions
    # The same array, if it holds the same, stays in the cache.
    of_object = columns if stepless else np.ascontiguousarray(functions.object_part.T)
    return {
        "functions": columns,
        "object_part": of_object,
        "spans": functions.spans,
        "leverage": np.ascontiguousarray(functions.leverage.T),
        "steps": int(functions.steps),
        "stepless": stepless,
    }


@lru_cache
def _ratios(first: Curve, second: Curve) -> tuple[float, Array]:
    """Relative rate of the ratio of the slopes at the reference [1/K], and some of the ratios."""
    around = first.reference + np.array([-0.5, 0.5])  # [K]
    rates = np.diff(np.log(second.slope(around) / first.slope(around)))
    temperatures = np.linspace(first.lowest, first.highest, reflection_ratio.TEMPERATURES)
    return float(rates[0]), second.slope(temperatures) / first.slope(temperatures)


def _work_space(frames: int, degrees: int) -> dict[str, Any]:
    """Arrays for the signals and curves of one pixel."""
    # Places of one frame that lie a multiple of a page apart would drive each other from the cache.
    apart = -(-frames // _PAGE) * _PAGE + _APART
    curves = dict(zip(Work._fields, np.empty((len(Work._fields), apart))[:, :frames], strict=True))
    block = max(_BLOCK, _TURNED // frames)
    return curves | {
        # Whole vectors of infinite values behind the last frame: a rank is of those before.
        "few": np.full((5, -(-frames // _VECTOR) * _VECTOR), np.inf, np.float32),
        "spectra": np.empty((2, degrees)),
        "material": np.empty(6),
        "inside": np.empty((block, 2, frames)),
        "outside": np.empty((block, 4, frames), np.float32),
    }


def solve(
    tile: Tile, functions: smooth.Subspace, drift: float, least: float = emissions.BEND
) -> Solution:
    """As `steps.solve`, of two bands."""
    every = np.arange(tile.signals.shape[2])
    return solve_parts(tile, functions, [(every, functions)], drift, least)


def solve_parts(
    tile: Tile,
    functions: smooth.Subspace,
    parts: Iterable[tuple[Whole, smooth.Subspace]],
    drift: float,
    least: float = emissions.BEND,
) -> Solution:
    """As `solve`, of all pixels in parts, each with functions of its own of the same rising ones.

    One part after another is taken: of a long capture the functions of all would be much memory.
    """
    shared, material = _share(tile, functions, drift), tile.material
    frames, pixels = tile.signals.shape[1:]
    materials = np.full((pixels, 6), np.nan)
    if material is not None:
        numbers = (material.ratio[1], material.inverse_energy, material.emissivity)
        rest = (material.noise_variance, material.drift_variance, material.spread)
        materials[:] = np.stack([*numbers, *rest], 1)
    films = np.empty((4, frames, pixels), np.float32)
    record, sums = np.zeros(pixels, RECORD), np.zeros((2, shared.parts.size - 1, pixels))
    signals = np.ascontiguousarray(tile.signals, dtype=np.float64)
    solved, freedom = Solved(films, record, sums), np.empty(pixels, np.intp)
    space = _work_space(frames, len(shared.rising))
    for places, own in parts:
        model, count = shared._replace(**_columns(own)), own.functions.shape[1]
        space["coefficients"], space["columns"] = np.empty((2, count)), np.empty(count)
        space["scatter"] = np.empty((own.orders, 3))
        _separate(model, signals, places, materials, float(least), Work(**space), solved)
        freedom[places] = frames - own.steps - record["order"][places]
    named: dict[str, Any] = {
        name: record[name].transpose(*range(1, record[name].ndim), 0) for name in RECORD.names or ()
    }
    named |= {
        "freedom": freedom,
        "beyond": named["beyond"] > 0,
        **dict(zip(FILMS, films, strict=True)),
    }
    return Solution(sums=sums, **named)
