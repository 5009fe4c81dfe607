"""Superpixels: small cells of an image whose borders lie on the edges of its pictures.

Waterpixels: a watershed from a regular grid of markers floods the edge strength, which is a
statistic in standard deviations rather than a gradient in some unit. A smooth gradient is a plateau
to it and makes no border. The watershed is scikit-image's; nothing else here needs that library.
"""

from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from skimage.measure import label
from skimage.segmentation import watershed

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Labels = npt.NDArray[np.intp]

_BLUR: Final = 1.0
"""Standard deviation of the Gaussian window of the edge statistic [pixel]."""

_REACH: Final = 1
"""Distance of the windows' centres from the pixel, to both sides [pixel]."""

_COMPACTNESS: Final = 0.5
"""Edge strength [standard deviation] that a path longer by one pixel is worth."""

_EMPTY: Final = 1e-3
"""Share of the largest weight below which a window holds nothing [1]."""


def edges(pictures: Array, variances: Array) -> Array:
    r"""
    Strength of an edge through each pixel, in standard deviations.

    Weighted means before and after a pixel are compared, along y and along x:

    .. math:: t^2 = \sum_f \frac{(m_+ - m_-)^2}{\mathrm{var}(m_+) + \mathrm{var}(m_-)}

    Parameters
    ----------
    pictures : ndarray, shape (feature, y, x)
        Values in any units; NaN where there is none.
    variances : ndarray, shape (feature, y, x)
        Their variances, in the squares of those units.

    Returns
    -------
    ndarray, shape (y, x)
        The larger t of both directions [1]; 0 where no feature has a value.
    """
    known = np.isfinite(pictures) & np.isfinite(variances) & (variances > 0)
    weight = np.divide(1.0, variances, out=np.zeros_like(pictures), where=known)
    window = np.array([0.0, _BLUR, _BLUR])
    total = ndimage.gaussian_filter(weight, window)
    # The square of a Gaussian is a narrower Gaussian.
    squares = ndimage.gaussian_filter(weight, window / np.sqrt(2)) / (4 * np.pi * _BLUR**2)
    summed = ndimage.gaussian_filter(weight * np.where(known, pictures, 0.0), window)
    held = total > _EMPTY * weight.max(axis=(1, 2), keepdims=True)
    mean = np.divide(summed, total, out=np.zeros_like(total), where=held)
    variance = np.divide(squares, total**2, out=np.full_like(total, np.inf), where=held)
    return np.asarray(np.sqrt(np.maximum(*(_contrast(mean, variance, axis) for axis in (1, 2)))))


def _contrast(mean: Array, variance: Array, axis: int) -> Array:
    """Squared difference of the means on both sides along an axis, over its variance."""
    size = mean.shape[axis]
    before, after = (np.clip(np.arange(size) + s, 0, size - 1) for s in (-_REACH, _REACH))
    difference = mean.take(after, axis) - mean.take(before, axis)
    spread = variance.take(after, axis) + variance.take(before, axis)
    return np.asarray(np.sum(difference**2 / spread, axis=0))


def cells(strength: Array, valid: Mask, spacing: int) -> Labels:
    """
    Cut an image into connected cells of about `spacing` by `spacing` pixels.

    Parameters
    ----------
    strength : ndarray, shape (y, x)
        From `edges`.
    valid : ndarray of bool, shape (y, x)
        Pixels that belong to a cell; the others are walls.
    spacing : int
        Distance of the markers [pixel].

    Returns
    -------
    ndarray of int, shape (y, x)
        Numbers of the cells from 1; 0 where not valid.

    References
    ----------
    .. [1] Machairas et al. (2015), IEEE Transactions on Image Processing 24, 3707,
       doi:10.1109/TIP.2015.2451011
    """
    rows, columns = (np.arange(min(spacing // 2, n - 1), n, spacing) for n in strength.shape)
    markers = np.zeros(strength.shape, dtype=np.intp)
    markers[np.ix_(rows, columns)] = 1 + np.arange(rows.size * columns.size).reshape(rows.size, -1)
    flooded = watershed(  # type: ignore[no-untyped-call]
        strength, markers * valid, mask=valid, compactness=_COMPACTNESS
    )
    return connected(np.where(valid, 1 + flooded, 0))


def connected(values: Labels) -> Labels:
    """
    Number the connected parts of equal value, through the sides of pixels.

    Parameters
    ----------
    values : ndarray of int, shape (y, x)
        Values; 0 is no part.

    Returns
    -------
    ndarray of int, shape (y, x)
        Numbers from 1; 0 where the value is 0.
    """
    numbers = label(values, connectivity=1)  # type: ignore[no-untyped-call]
    return np.asarray(numbers, dtype=np.intp)
