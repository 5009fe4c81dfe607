"""What the compiled steps of a tile of two bands share: functions of time, limits, work space."""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import stdtrit

from dbthermal import _smooth as smooth
from dbthermal.separation._subspace import emission as emissions
from dbthermal.separation._subspace import kernels, pieces, reflection_ratio, residuals
from dbthermal.separation._tiles import Tile

Array = npt.NDArray[np.float64]


class Model(NamedTuple):
    """All that the pixels of a tile share; columns of functions lie along time."""

    first: kernels.Table
    second: kernels.Table
    functions: Array  # (column, time), of `smooth.Subspace`
    object_part: Array  # (column, time)
    rising: Array  # (degree, time)
    leverage: Array  # (order, time)
    steps: int
    noise: tuple[float, float]  # [K]
    pattern: tuple[float, float]  # [K]
    drift: float  # limit of the background's, over the square root of three [K]
    rate: float  # change of the ratio of the responses' slopes with the background [1/K]
    gray: Array  # ratios of the slopes at temperatures of the background [1]
    widened: Array  # of the octaves' variances, at the end of their 95 % interval [1]
    edges: npt.NDArray[np.intp]  # of the blocks of a residual
    limits: tuple[float, float]  # of its chi-square statistics
    parts: npt.NDArray[np.intp]  # of the means by which pieces are asked for
    lowest: float  # calibrated temperatures [K]
    highest: float


class Work(NamedTuple):
    """Signals and curves (time) of one pixel."""

    first: Array  # signals [K]
    second: Array
    straight: Array  # the second less the bend of the reflections
    emitted: Array
    other_emitted: Array
    slope: Array
    second_slope: Array
    place: Array
    steepness: Array
    partial: Array
    target: Array
    temperature: Array
    weights: Array
    residual: Array
    kernel: Array
    spare: Array
    variance: Array
    smooth_variance: Array
    sensitivity: Array
    background: Array
    background_variance: Array
    bend: Array
    null_residual: Array
    change: Array
    rapid: Array
    reflected: Array
    other_reflected: Array
    mean: Array
    few: Any  # in single precision (6, time)
    coefficients: Array  # of the signals on the functions (2, column)
    scatter: Array  # see `reflection_ratio`, first, mixed and last element (order, 3)
    material: Array  # ratio, inverse energy, emissivity, its two variances; NaN for none


def share(tile: Tile, functions: smooth.Subspace, drift: float) -> Model:
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
        steps=functions.steps,
        noise=(tile.noise[0], tile.noise[1]),
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


def work_space(model: Model) -> Work:
    """Arrays for the signals and curves of one pixel."""
    columns, frames = model.functions.shape
    rest: dict[str, Any] = {
        "few": np.empty((6, frames), np.float32),
        "coefficients": np.empty((2, columns)),
        "scatter": np.empty((len(model.leverage), 3)),
        "material": np.empty(5),
    }
    return Work(**{name: np.empty(frames) for name in Work._fields} | rest)
