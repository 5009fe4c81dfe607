"""Robust straight-line regression of many pixels at once, by Tukey's redescending weights."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

TUNING: Final = 4.685
"""Tukey's constant: 95 % efficiency for normal noise (Huber 1981, doi:10.1002/0471725250)."""

_MAD: Final = 1.482602218505602
_ANNEALING: Final = 0.7
_STARTING_STEPS: Final = 5
_STEPS: Final = 3


@dataclass(frozen=True)
class Line:
    """
    Line fitted to each pixel.

    Attributes
    ----------
    slope, centre : ndarray, shape (pixel,)
        Slope, and the ordinate at the weighted mean abscissa.
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
    centre: Array
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
    step and never below the noise. A first fit tries several starts, see `_start`.

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
    weights = _start(abscissa, ordinate, noise) if start is None else start.weights
    for _ in range(_STEPS):
        residual = _fit(abscissa, ordinate, weights)[2]
        scale = np.maximum(noise, _MAD * _median_magnitude(residual))
        weights = _tukey(residual, scale)
    slope, centre, residual, spread = _fit(abscissa, ordinate, weights)
    return Line(
        slope=slope,
        centre=centre,
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


def _start(abscissa: Array, ordinate: Array, noise: float) -> Array:
    """
    Weights of the best of three starts: all points, those above, those below the plain line.

    What disturbs a resting background lies mostly on one side of it, and one of the halves is
    then nearly free of it. Each start closes in on the densest half of the points by a scale that
    is a fraction of the deviation; the one with the smallest deviation wins, pixel by pixel.
    """
    plain = _fit(abscissa, ordinate, np.ones_like(abscissa))[2]
    best: Array | None = None
    for start in (np.ones_like(plain), (plain >= 0).astype(float), (plain <= 0).astype(float)):
        weights = start
        for _ in range(_STARTING_STEPS):
            residual = _fit(abscissa, ordinate, weights)[2]
            deviation = _MAD * _median_magnitude(residual)
            weights = _tukey(residual, np.maximum(noise, _ANNEALING * deviation))
        if best is None:
            best, smallest = weights, deviation
        else:
            best = np.where(deviation < smallest, weights, best)
            smallest = np.minimum(deviation, smallest)
    assert best is not None
    return best


def _fit(abscissa: Array, ordinate: Array, weights: Array) -> tuple[Array, Array, Array, Array]:
    """Weighted least squares: slope, centre, residual (time, pixel), spread."""
    total = weights.sum(axis=0)
    middle = np.einsum("tp,tp->p", weights, abscissa) / total
    centre = np.einsum("tp,tp->p", weights, ordinate) / total
    across, up = abscissa - middle, ordinate - centre
    weighted = weights * across
    spread = np.einsum("tp,tp->p", weighted, across)
    slope = np.einsum("tp,tp->p", weighted, up) / spread
    return slope, centre, up - slope * across, spread


def _median_magnitude(residual: Array) -> Array:
    """Upper median over time of the absolute value; in single precision, which is much faster."""
    magnitude = np.abs(residual.T, dtype=np.float32, casting="same_kind")
    middle = residual.shape[0] // 2
    return np.asarray(np.partition(magnitude, middle, axis=1)[:, middle], dtype=np.float64)


def _tukey(residual: Array, scale: Array) -> Array:
    ratio = residual / (TUNING * scale)
    kept = np.maximum(1.0 - ratio * ratio, 0.0)
    return np.asarray(kept * kept)


def _independent(residual: Array, weights: Array) -> Array:
    """Fraction of independent points, from the lag-one correlation of the kept residuals."""
    kept = residual * weights
    energy = np.einsum("tp,tp->p", kept, kept)
    lagged = np.einsum("tp,tp->p", kept[1:], kept[:-1])
    correlation = np.clip(
        np.divide(lagged, energy, out=np.zeros_like(energy), where=energy > 0), 0, 0.98
    )
    return np.asarray((1.0 - correlation) / (1.0 + correlation))
