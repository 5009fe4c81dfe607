"""Functions of time, limits and work space of the compiled steps of a tile of two bands."""

from typing import Any, NamedTuple

from dbthermal._arrays import Array
from dbthermal.separation._subspace import kernels
from dbthermal.separation._tiles import Whole


class Model(NamedTuple):
    """All that the pixels of a tile share; columns of functions lie along time."""

    first: kernels.Table
    second: kernels.Table
    functions: Array  # (column, time), of `smooth.Subspace`
    object_part: Array  # (column, time)
    spans: Whole  # first frames of these functions, and the ends (column, 2)
    rising: Array  # (degree, time)
    whole: Whole  # of these (degree, 2)
    spread: float  # of the first of these
    leverage: Array  # (order, time)
    steps: int
    stepless: bool  # no function has a step of the camera: both are the same
    noise: tuple[float, float]  # [K]
    pattern: tuple[float, float]  # [K]
    drift: float  # limit of the background's, over the square root of three [K]
    rate: float  # change of the ratio of the responses' slopes with the background [1/K]
    gray: Array  # ratios of the slopes at temperatures of the background [1]
    widened: Array  # of the octaves' variances, at the end of their 95 % interval [1]
    edges: Whole  # of the blocks of a residual
    limits: tuple[float, float]  # of its chi-square statistics
    parts: Whole  # of the means by which pieces are asked for
    lowest: float  # calibrated temperatures [K]
    highest: float


class Work(NamedTuple):
    """Signals and curves (time) of one pixel, and of some as they are read and written."""

    first: Array  # signals [K]
    second: Array
    straight: Array  # the second less the bend of the reflections
    target: Array  # null combination of the bands, smoothed (eq. 5)
    temperature: Array  # of the object [K]
    emitted: Array  # signal of the object at the last regression
    steepness: Array  # h'(x) before the last step towards the object
    lack: Array  # q - h(x) there [K]
    weights: Array  # of the regression
    residual: Array
    kernel: Array
    spare: Array
    at_object: Array  # signals of the object
    other_at_object: Array
    mean: Array  # signal of the background
    background: Array  # [K]
    back_slope: Array
    other_back_slope: Array
    bend: Array  # of the reflections (eq. 11), and as it was taken out
    removed: Array
    sensitivity: Array  # see `emission.Emission`
    smooth_variance: Array
    variance: Array  # of the object, and of the background [K^2]
    background_variance: Array
    null_residual: Array
    rapid: Array
    few: Any  # in single precision (6, time)
    coefficients: Array  # of the signals on the functions (2, column)
    columns: Array  # (column)
    spectra: Array  # (2, degree)
    scatter: Array  # see `reflection_ratio`, first, mixed and last element (order, 3)
    material: Array  # ratio, inverse energy, emissivity, its two variances, spread; NaN for none
    inside: Array  # signals of some pixels [K] (pixel, 2, time)
    outside: Any  # their films, in single precision (pixel, 4, time)
