"""Statistics of residuals in time, of many pixels at once.

Robust regression finds a line beside outliers on one side; the autocorrelation and the interband
delay test a residual for white noise, which it is if the model holds; a change point is the step
of an object that breaks the cue of its smoothness.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final, TypeVar

import numpy as np
import numpy.typing as npt
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.special import chdtri, ndtri

from dbthermal import _smooth as smooth
from dbthermal._arrays import like, namespace, quotient
from dbthermal.separation._subspace.reflection_ratio import CHANCE, ReflectionRatio
from dbthermal.separation._tiles import Array, Mask, Pixels, Whole

Precision = TypeVar("Precision", np.float32, np.float64)

TUNING: Final = 4.685
"""Tukey's constant: 95 % efficiency for normal noise (Huber 1981, doi:10.1002/0471725250)."""

LAGS: Final = 5
"""Frames over which `autocorrelation` looks for a correlation."""

AROUND: Final = 1.0
"""Time in which a step of the object is most of its change [s]."""

# Share of the points that must lie on the line: the scale is taken from their deviation, as an
# absolute deviation of that rank -> standard deviation of a normal distribution.
SHARE: Final = 0.3
TO_STD: Final = 1.0 / float(ndtri(0.5 * (1.0 + SHARE)))
ANNEALING: Final = 0.7
STARTING_STEPS: Final = 5
STARTING_POINTS: Final = 128
STEPS: Final = 3
# Largest correlation of neighbouring residuals: that of one all slow would be 1.
MOST_CORRELATED: Final = 0.98
# Deviations of noise from which a difference between frames is a change.
CHANGE: Final = 5.0
# Share of the change within a second that a sudden step makes.
_MOST: Final = 2.0 / 3.0
# Parts of the capture, and the total variation of their means over its range, from which a signal
# returns.
_PARTS: Final = 24
_RETURNED: Final = 1.7
# Frames of the shortest blocks of a residual.
_BLOCK: Final = 9


@dataclass(frozen=True)
class Line(Pixels):
    """Straight line fitted to each pixel's points."""

    slope: Array  # (pixel)
    scale: Array  # robust standard deviation of the residuals, at least the noise (pixel)
    residual: Array  # ordinate less the line (time, pixel)
    energy: Array  # weighted sum of squares of the abscissa about its mean (pixel)
    variance: Array  # of the slope, with the residuals' correlation in time (pixel)
    weights: Array  # final weights in [0, 1] (time, pixel)

    def kernel(self, abscissa: Array) -> Array:
        """Weights k (time, pixel) of the ordinate z in the slope, sum k z."""
        kernel = self.weights * abscissa
        kernel -= self.weights * (kernel.sum(axis=0) / self.weights.sum(axis=0))
        return kernel / self.energy


def regress(abscissa: Array, ordinate: Array, noise: float, start: Line | None = None) -> Line:
    r"""
    Robust regression of an ordinate on an abscissa (time, pixel), with Tukey's bisquare weights.

    Iteratively reweighted least squares with :math:`w = (1 - (r / c s)^2)^2` inside
    :math:`c s` and 0 outside. The scale s is the absolute deviation of rank 30 %, as a standard
    deviation, renewed at every step and never below the `noise` of the ordinate. A first fit tries
    several starts, see `_first_residual`; a `start` of nearly the same points gives its weights.

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
    for _ in range(STEPS):
        scale = namespace(residual).clip(TO_STD * _ranked_magnitude(residual), min=noise)
        weights = _tukey(residual, scale)
        slope, _, residual, energy = _fit(abscissa, ordinate, weights)
    # var(slope) = s^2 / sum w (x - mean)^2, over the fraction of independent points.
    variance = scale**2 / energy / _independent(residual, weights)
    return Line(slope, scale, residual, energy, variance, weights)


def null_residual(signals: Array, functions: smooth.Subspace, ratios: ReflectionRatio) -> Array:
    """
    Residual (time, pixel) [K] of the null combination of bands, its smooth part taken out.

    White noise of the null variance where the model holds.
    """
    xp = namespace(signals)
    residual = xp.einsum("bp,btp->tp", ratios.null_weights, signals)
    smoothed = xp.einsum("bp,bcp->cp", ratios.null_weights, ratios.coefficients)
    residual -= functions.functions @ smoothed
    return residual


def autocorrelation(residual: Array) -> Array:
    """
    Mean autocorrelation (pixel) of a residual (time, pixel) over lags of 1 to `LAGS` frames.

    In standard deviations of white noise. A change of the object that the smooth functions do not
    follow, or a background with other ratios, leaves a correlation.
    """
    einsum = namespace(residual).einsum
    energy = einsum("tp,tp->p", residual, residual)
    lagged = sum(einsum("tp,tp->p", residual[lag:], residual[:-lag]) for lag in range(1, LAGS + 1))
    mean = quotient(lagged, LAGS * energy, 0.0)
    # White noise of N frames: each lag has the variance 1 / N, independently of the others.
    return mean * float(np.sqrt(LAGS * residual.shape[0]))


def interband_delay(
    residual: Array,
    first: Array,
    functions: smooth.Subspace,
    ratios: ReflectionRatio,
    noise: float,
) -> Array:
    r"""
    Score (pixel) of rapid changes that are not simultaneous in all bands.

    A band that is a frame late, or early, leaves the difference between two frames of the others'
    signal. The null residual r is therefore held against both differences of the `first` band's
    signal (time, pixel) [K] of standard deviation `noise` [K], a matched filter,

    .. math:: \sum_t r(t) \, (z_1(t \pm 1) - z_1(t)) + n \, w_1 s_1^2

    where the last term takes out that the residual holds the noise of :math:`z_1(t)`. A delay that
    changes sign, as after an interpolation between frames, is seen in the energy of the residual
    in the frames at a change, over that of the noise. The score is the largest in magnitude, in
    standard deviations of white noise.
    """
    xp, rapid = namespace(first), first - functions.functions @ ratios.coefficients[0]
    change = xp.diff(rapid, axis=0)
    freedom = residual.shape[0] - ratios.order - functions.steps
    common = freedom * ratios.null_weights[0] * noise**2
    late = xp.einsum("tp,tp->p", residual[:-1], change) + common
    early = xp.einsum("tp,tp->p", residual[1:], change) - common
    strongest = xp.maximum(xp.abs(late), xp.abs(early))
    variance = ratios.null_variance * xp.einsum("tp,tp->p", change, change)
    score = quotient(strongest, xp.sqrt(variance), 0.0)
    return xp.maximum(score, _excess(residual, change, ratios.null_variance, noise))


@lru_cache(maxsize=16)
def blocks(frames: int) -> tuple[Whole, tuple[float, float]]:
    """Edges of the blocks of `unexplained`, and the limits of its two statistics."""
    number = 2 ** int(np.log2(frames / _BLOCK))
    edges = np.round(np.linspace(0, frames, number + 1)).astype(np.intp)
    return edges, (float(chdtri(number, CHANCE)), float(chdtri(1.0, CHANCE / (2 * number))))


def unexplained(residual: Array, rapid: Array, null_variance: Array, common: Array) -> Mask:
    r"""
    Pixels of which the null residual r (time, pixel) [K] is not white noise in some part of time.

    Its sum over some block, of those of repeated halving, is beyond that of noise: a change of the
    object that the smooth functions do not follow. Or blocks differ in its correlation with the
    rapid changes: these have not one ratio,

    .. math:: \sum_b \frac{(\sum_t r h)^2}{\sigma^2 \sum_t h^2}, \quad
              h = z_1 - r \, w_1 s_1^2 / \sigma^2

    which is a chi-square variable, for the noise of h is independent of that of r: the `rapid` part
    of the first band's signal (time, pixel) [K] less what has the covariance `common` (pixel) [K^2]
    with the residual.
    """
    edges, (most, limit) = blocks(len(residual))
    xp, length = namespace(residual), like(np.diff(edges)[:, np.newaxis], residual)
    variance = xp.where(null_variance > 0, null_variance, np.inf)
    rapid = rapid - common / variance * residual
    sums, products, squares = (
        block_sums(part, edges) for part in (residual, residual * rapid, rapid**2)
    )
    result = quotient(products**2, squares, 0.0).sum(axis=0) / variance > most
    while len(sums) > 1:
        result |= xp.any(sums**2 > limit * variance * length, axis=0)
        sums, length = sums[::2] + sums[1::2], length[::2] + length[1::2]
    return result


def block_sums(values: Array, edges: Whole) -> Array:
    """Sums (block, ...) of values (time, ...) between edges, of which none are the same."""
    xp = namespace(values)
    total = xp.cumsum(values, axis=0)[like(edges[1:] - 1, values)]
    return xp.concatenate([total[:1], xp.diff(total, axis=0)])


def returning(signal: Array) -> Mask:
    """
    Pixels of a signal (time, pixel) that falls again by most of what it rose, or the reverse.

    Of means over parts of the capture: their total variation over their range is 1 for a change
    that stays, 2 for one that comes and goes.
    """
    parts = np.array_split(signal, min(_PARTS, len(signal)))
    means = np.stack([part.mean(axis=0) for part in parts])
    variation = np.abs(np.diff(means, axis=0)).sum(axis=0)
    return np.asarray(variation > _RETURNED * np.ptp(means, axis=0))


def sudden(curve: Array, std: Array, time: Array) -> Mask:
    """
    Pixels of which a curve (time, pixel) [K] steps from one frame to the next.

    By more than most of its change within a second, and beyond its standard deviations; not over a
    pause of the frames.
    """
    interval = np.diff(time)
    usual = float(np.median(interval))
    # A clock of bursts has a median far below its mean.
    frames = min(time.size, max(3, 2 * int(np.ceil(0.5 * AROUND / usual))))
    step = np.abs(np.diff(curve, axis=0))
    noise = np.sqrt(std[1:] ** 2 + std[:-1] ** 2)
    jumps = (step > CHANGE * noise) & (interval < 2.0 * usual)[:, np.newaxis]
    result = np.any(jumps, axis=0)
    some, size = curve[:, result], (frames, 1)  # of the others the surroundings say nothing
    around = maximum_filter(some, size)[1:] - minimum_filter(some, size)[1:]
    result[result] = np.any(jumps[:, result] & (step[:, result] > _MOST * around), axis=0)
    return np.asarray(result)


def _first_residual(abscissa: Array, ordinate: Array, noise: float) -> Array:
    """
    Residual from the best of three starts: all points, those above, those below the plain line.

    Disturbances of a resting background lie mostly on one side of it, and one of the halves is
    then nearly free of it. Each start closes in on the densest half of the points by a scale that
    is a fraction of the deviation; the one with the smallest deviation wins, pixel by pixel. Some
    points in single precision are enough to start from.
    """
    xp, count = namespace(abscissa), min(len(abscissa), STARTING_POINTS)
    every = like(np.arange(count) * len(abscissa) // count, abscissa)
    # About its mean, or single precision would not resolve a small range.
    centred, up = abscissa - abscissa.mean(axis=0), ordinate - ordinate.mean(axis=0)
    x, z = (xp.asarray(part[every], dtype=xp.float32) for part in (centred, up))
    plain = _fit(x, z, xp.ones_like(x))[2]
    slope = intercept = smallest = xp.full_like(centred[0], np.inf)
    for start in (xp.ones_like(plain), plain >= 0, plain <= 0):
        weights = xp.asarray(start, dtype=xp.float32)
        for _ in range(STARTING_STEPS):
            one, other, residual, _ = _fit(x, z, weights)
            deviation = _ranked_magnitude(residual)
            weights = _tukey(residual, xp.clip(ANNEALING * TO_STD * deviation, min=noise))
        better = deviation < smallest
        slope, intercept = xp.where(better, one, slope), xp.where(better, other, intercept)
        smallest = xp.where(better, deviation, smallest)
    return up - intercept - slope * centred


def _fit(
    abscissa: npt.NDArray[Precision],
    ordinate: npt.NDArray[Precision],
    weights: npt.NDArray[Precision],
) -> tuple[
    npt.NDArray[Precision], npt.NDArray[Precision], npt.NDArray[Precision], npt.NDArray[Precision]
]:
    """Weighted least squares: slope, intercept, residual (time, pixel), energy of the abscissa."""
    einsum, total = namespace(weights).einsum, weights.sum(axis=0)
    weighted = weights * abscissa
    middle = weighted.sum(axis=0) / total
    centre = einsum("tp,tp->p", weights, ordinate) / total
    energy = einsum("tp,tp->p", weighted, abscissa) - total * middle**2
    slope = (einsum("tp,tp->p", weighted, ordinate) - total * middle * centre) / energy
    intercept = centre - slope * middle
    return slope, intercept, ordinate - intercept - slope * abscissa, energy


def _ranked_magnitude(residual: npt.NDArray[Precision]) -> Array:
    """Absolute value of rank `SHARE` over time; in single precision, which is much faster."""
    xp, middle = namespace(residual), int(SHARE * residual.shape[0])
    magnitude = xp.abs(xp.asarray(residual.T, dtype=xp.float32))
    if xp is np:
        value = np.partition(magnitude, middle, axis=1)[:, middle]
    else:
        value = xp.kthvalue(magnitude, middle + 1).values
    return xp.asarray(value, dtype=xp.float64)


def _tukey(residual: npt.NDArray[Precision], scale: Array) -> npt.NDArray[Precision]:
    """Tukey's bisquare weights, (1 - (r / c s)^2)^2 inside c s."""
    xp = namespace(residual)
    kept = residual * xp.asarray(1.0 / (TUNING * scale), dtype=residual.dtype)
    kept = xp.clip(1.0 - kept * kept, min=0.0)
    return kept * kept


def _independent(residual: Array, weights: Array) -> Array:
    """Fraction of independent points, from the lag-one correlation of the kept residuals."""
    xp, kept = namespace(residual), residual * weights
    energy = xp.einsum("tp,tp->p", kept, kept)
    lagged = xp.einsum("tp,tp->p", kept[1:], kept[:-1])
    correlation = xp.clip(quotient(lagged, energy, 0.0), 0, MOST_CORRELATED)
    return (1.0 - correlation) / (1.0 + correlation)


def _excess(residual: Array, change: Array, null_variance: Array, noise: float) -> Array:
    """
    Energy beyond that of the noise in frames at a change, in standard deviations (pixel).

    A chi-square variable of few degrees of freedom has a long tail: its cube root is nearly normal
    (Wilson, Hilferty 1931, doi:10.1073/pnas.17.12.684).
    """
    xp = namespace(residual)
    steps = xp.abs(change) > CHANGE * np.sqrt(2.0) * noise
    at = xp.zeros_like(residual, dtype=xp.bool)
    at[1:] |= steps
    at[:-1] |= steps
    count = xp.sum(at, axis=0, dtype=xp.float64)
    energy = xp.einsum("tp,tp->p", residual * at, residual) / null_variance
    mean = quotient(energy, count, 1.0)
    # The cube root of a chi-square over its n degrees has the mean 1 - v and the variance v.
    variance = 2.0 / (9.0 * xp.clip(count, min=1))
    return (mean ** (1.0 / 3.0) - (1.0 - variance)) / xp.sqrt(variance)
