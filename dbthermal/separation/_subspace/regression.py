"""Robust straight-line regression of many pixels at once, by Tukey's redescending weights."""

from dataclasses import dataclass
from typing import Final, TypeVar

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri

Array = npt.NDArray[np.float64]
Precision = TypeVar("Precision", np.float32, np.float64)

TUNING: Final = 4.685
"""Tukey's constant: 95 % efficiency for normal noise (Huber 1981, doi:10.1002/0471725250)."""

# Share of the points that must lie on the line: the scale is taken from their deviation, as an
# absolute deviation of that rank -> standard deviation of a normal distribution.
_SHARE: Final = 0.3
_TO_STD: Final = 1.0 / float(ndtri(0.5 * (1.0 + _SHARE)))
_ANNEALING: Final = 0.7
_STARTING_STEPS: Final = 5
_STARTING_POINTS: Final = 100
_STEPS: Final = 3


@dataclass(frozen=True)
class Line:
    """
    Line fitted to each pixel.

    Attributes
    ----------
    slope, intercept : ndarray, shape (pixel,)
        Slope, and the ordinate where the abscissa is zero.
    scale : ndarray, shape (pixel,)
        Robust standard deviation of the residuals, at least the noise.
    residual : ndarray, shape (time, pixel)
        Ordinate less the line.
    spread : ndarray, shape (pixel,)
        Weighted sum of squares of the abscissa about its mean.
    variance : ndarray, shape (pixel,)
        Variance of the slope, with the residuals' correlation in time taken into account.
    weights : ndarray, shape (time, pixel)
        Final weights in [0, 1].
    """

    slope: Array
    intercept: Array
    scale: Array
    residual: Array
    spread: Array
    variance: Array
    weights: Array


def regress(abscissa: Array, ordinate: Array, noise: float, start: Line | None = None) -> Line:
    r"""
    Regress an ordinate on an abscissa, down-weighting what lies off the line.

    Iteratively reweighted least squares with :math:`w = (1 - (r / c s)^2)^2` inside
    :math:`c s` and 0 outside. The scale s is the median absolute deviation, renewed at every
    step and never below the noise. A first fit tries several starts, see `_first_residual`.

    Parameters
    ----------
    abscissa, ordinate : ndarray, shape (time, pixel)
        The points, in one unit.
    noise : float
        Standard deviation of the ordinate's noise; smallest scale.
    start : Line, optional
        An earlier fit of nearly the same points, whose weights are taken up.

    Returns
    -------
    Line
        The fit.

    Notes
    -----
    With residuals of lag-one correlation :math:`\rho` only :math:`(1 - \rho) / (1 + \rho)` of
    the points are independent; the variance is divided by that fraction.

    References
    ----------
    .. [1] Beaton, Tukey (1974), Technometrics 16, 147, doi:10.1080/00401706.1974.10489171
    """
    if start is None:
        residual = _first_residual(abscissa, ordinate, noise)
    else:
        residual = _fit(abscissa, ordinate, start.weights)[2]
    for _ in range(_STEPS):
        scale = np.maximum(noise, _TO_STD * _ranked_magnitude(residual))
        weights = _tukey(residual, scale)
        slope, intercept, residual, spread = _fit(abscissa, ordinate, weights)
    return Line(
        slope=slope,
        intercept=intercept,
        scale=scale,
        residual=residual,
        spread=spread,
        variance=scale**2 / spread / _independent(residual, weights),
        weights=weights,
    )


def plain_slope(abscissa: Array, ordinate: Array) -> Array:
    """
    Slope of the ordinary least-squares line of each pixel.

    Parameters
    ----------
    abscissa, ordinate : ndarray, shape (time, pixel)
        The points, in one unit.

    Returns
    -------
    ndarray, shape (pixel,)
        Slope [1].
    """
    return _fit(abscissa, ordinate, np.ones_like(abscissa))[0]


def _first_residual(abscissa: Array, ordinate: Array, noise: float) -> Array:
    """
    Residual from the best of three starts: all points, those above, those below the plain line.

    What disturbs a resting background lies mostly on one side of it, and one of the halves is
    then nearly free of it. Each start closes in on the densest half of the points by a scale that
    is a fraction of the deviation; the one with the smallest deviation wins, pixel by pixel. A
    hundred points in single precision are enough to start from.
    """
    every = slice(None, None, max(1, abscissa.shape[0] // _STARTING_POINTS))
    # About its mean, or single precision would not resolve a small spread.
    across, up = abscissa - abscissa.mean(axis=0), ordinate - ordinate.mean(axis=0)
    few = across[every].astype(np.float32), up[every].astype(np.float32)
    plain = _fit(*few, np.ones_like(few[0]))[2]
    slope, intercept, smallest = (np.full(plain.shape[1], np.inf) for _ in range(3))
    for start in (np.ones_like(plain), plain >= 0, plain <= 0):
        weights = start.astype(np.float32)
        for _ in range(_STARTING_STEPS):
            *line, residual, _ = _fit(*few, weights)
            deviation = _ranked_magnitude(residual)
            weights = _tukey(residual, np.maximum(noise, _ANNEALING * _TO_STD * deviation))
        better = deviation < smallest
        slope, intercept = np.where(better, line, (slope, intercept))
        smallest = np.where(better, deviation, smallest)
    return np.asarray(up - intercept - slope * across)


def _fit(
    abscissa: npt.NDArray[Precision],
    ordinate: npt.NDArray[Precision],
    weights: npt.NDArray[Precision],
) -> tuple[
    npt.NDArray[Precision], npt.NDArray[Precision], npt.NDArray[Precision], npt.NDArray[Precision]
]:
    """Weighted least squares: slope, intercept, residual (time, pixel), spread."""
    total = weights.sum(axis=0)
    weighted = weights * abscissa
    middle = weighted.sum(axis=0) / total
    centre = np.einsum("tp,tp->p", weights, ordinate) / total
    spread = np.einsum("tp,tp->p", weighted, abscissa) - total * middle**2
    slope = (np.einsum("tp,tp->p", weighted, ordinate) - total * middle * centre) / spread
    intercept = centre - slope * middle
    return slope, intercept, ordinate - intercept - slope * abscissa, spread


def _ranked_magnitude(residual: npt.NDArray[Precision]) -> Array:
    """Absolute value of rank `_SHARE` over time; in single precision, which is much faster."""
    magnitude = np.abs(residual.T, dtype=np.float32, casting="same_kind")
    middle = int(_SHARE * residual.shape[0])
    return np.asarray(np.partition(magnitude, middle, axis=1)[:, middle], dtype=np.float64)


def _tukey(residual: npt.NDArray[Precision], scale: Array) -> npt.NDArray[Precision]:
    kept = residual * (1.0 / (TUNING * scale)).astype(residual.dtype)
    kept *= kept
    np.subtract(1.0, kept, out=kept)
    np.maximum(kept, 0.0, out=kept)
    kept *= kept
    return np.asarray(kept)


def _independent(residual: Array, weights: Array) -> Array:
    """Fraction of independent points, from the lag-one correlation of the kept residuals."""
    kept = residual * weights
    energy = np.einsum("tp,tp->p", kept, kept)
    lagged = np.einsum("tp,tp->p", kept[1:], kept[:-1])
    correlation = np.clip(
        np.divide(lagged, energy, out=np.zeros_like(energy), where=energy > 0), 0, 0.98
    )
    return np.asarray((1.0 - correlation) / (1.0 + correlation))
