"""Functions of time, limits and work space of the compiled steps of a tile of two bands."""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from dbthermal._arrays import Array
from dbthermal.separation._subspace import kernels


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
