"""Noise of the two bands, estimated from a capture in which everything moves.

A second difference in time removes the object. The background is removed twice: its rare steps by
trimming, and what it moves all the time by the bands, because noise is independent between them
and the background is not.
"""

from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr, ndtri

from dbthermal import smooth

Array = npt.NDArray[np.float64]

MINIMUM_FRAMES: Final = 16
"""Fewest frames from which a noise is estimated."""

_ORDER = 8
_TRIM = 3.0
_SIGNIFICANCE = 3.0
# Median absolute deviation -> standard deviation of a normal distribution.
_MAD = 1.0 / float(ndtri(0.75))
# Variance of a normal distribution cut at +-_TRIM standard deviations, relative to the uncut one.
_DENSITY = np.exp(-(_TRIM**2) / 2.0) / np.sqrt(2.0 * np.pi)
_TRIMMED_VARIANCE = float(1.0 - 2.0 * _TRIM * _DENSITY / (1.0 - 2.0 * ndtr(-_TRIM)))
# Standard deviation of a correlation of second differences, times sqrt(frames): their
# autocorrelation is 1, -2/3, 1/6, so sqrt(1 + 2 (4/9 + 1/36)).
_CORRELATION_STD = np.sqrt(35.0 / 18.0)


def second_difference(signal: Array) -> Array:
    """
    Second difference in time, scaled so that white noise keeps its variance.

    Parameters
    ----------
    signal : ndarray, shape (time, ...)
        Signal, in any unit.

    Returns
    -------
    ndarray, shape (time - 2, ...)
        Scaled second difference, in the same unit.
    """
    return np.asarray(np.diff(signal, n=2, axis=0) / np.sqrt(6.0))


def estimate(first: Array, second: Array, time: npt.ArrayLike) -> tuple[float, float]:
    r"""
    Noise of two bands from their signals.

    For each pixel, with D the covariance of the trimmed second differences and k the ratio of the
    bands' rapid changes (from their covariance one frame apart, where noise does not enter),

    .. math:: s_1^2 = D_{11} - D_{12} / k, \quad s_2^2 = D_{22} - k D_{12}

    where D12 is significant, else the diagonal. The result is the median over the pixels.

    With rests and pulses both noises come out within 2 %. Where every pixel's background walks
    without rest, the quieter band's is too high by up to a half, worst at a memory near 10 s, for
    a pixel alone then does not show what the bands share.

    Parameters
    ----------
    first, second : ndarray, shape (time, pixel)
        Signals of the two bands, each in a unit of its own.
    time : array_like, shape (time,)
        Times [s].

    Returns
    -------
    tuple of float
        Standard deviations of the noise, in the signals' units.

    Raises
    ------
    ValueError
        If there are fewer than `MINIMUM_FRAMES` frames, no pixel, or a noise comes out as zero.
    """
    frames, pixels = first.shape
    if frames < MINIMUM_FRAMES or pixels == 0:
        raise ValueError(
            f"Invalid capture of {frames} frames and {pixels} usable pixels to estimate a noise "
            f"from. Must have at least {MINIMUM_FRAMES} frames and 1 pixel; or give the noise."
        )
    covariance = _trimmed_covariance(second_difference(first), second_difference(second))
    ratio = _lagged_ratio(first, second, time)
    auto_first, cross, auto_second = covariance
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = np.abs(cross) / np.sqrt(auto_first * auto_second)
        shared = correlation > _SIGNIFICANCE * _CORRELATION_STD / np.sqrt(frames)
        shared &= ratio * cross > 0
        variances = (
            np.where(shared, auto_first - cross / ratio, auto_first),
            np.where(shared, auto_second - ratio * cross, auto_second),
        )
    result = [float(np.median(variance)) for variance in variances]
    if not min(result) > 0:
        raise ValueError(
            f"Invalid noise variances {result} estimated from the data. Must be positive: "
            "the signals do not vary from frame to frame; give the noise."
        )
    return float(np.sqrt(result[0])), float(np.sqrt(result[1]))


def _trimmed_covariance(first: Array, second: Array) -> tuple[Array, Array, Array]:
    """Variances and covariance (pixel) over the frames in which neither band steps."""
    keep = np.ones(first.shape, dtype=bool)
    for difference in (first, second):
        keep &= np.abs(difference) <= _TRIM * _MAD * np.median(np.abs(difference), axis=0)
    count = keep.sum(axis=0) * _TRIMMED_VARIANCE
    products = (first * first, first * second, second * second)
    auto_first, cross, auto_second = ((p * keep).sum(axis=0) / count for p in products)
    return auto_first, cross, auto_second


def _lagged_ratio(first: Array, second: Array, time: npt.ArrayLike) -> Array:
    """Ratio (pixel) of the bands' rapid changes, from covariances one frame apart."""
    functions = smooth.basis(time, _ORDER)
    first, second = (signal - functions @ (functions.T @ signal) for signal in (first, second))
    cross = (first[1:] * second[:-1] + first[:-1] * second[1:]).sum(axis=0)
    auto = 2.0 * (first[1:] * first[:-1]).sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(cross / auto)
