"""Feature maps of a capture that show borders of materials, and cells cut along their edges.

Maps are the means of the bands' signals over time and their reflected part. Waterpixels: a
watershed from a regular grid of markers floods the edge strength, which is a statistic in standard
deviations rather than a gradient in some unit; a smooth gradient is a plateau to it and makes no
border. The watershed is scikit-image's, imported when it is used.
"""

import importlib
from typing import Final

import numpy as np
import xarray as xr
from scipy import ndimage

from dbthermal import response as responses
from dbthermal import schema
from dbthermal._arrays import Array, Mask, release, select
from dbthermal.noise import MAD
from dbthermal.separation._inputs import Labels

_ROWS: Final = 64  # rows of a capture that are read at a time
# Standard deviation of the Gaussian window of the edge statistic, and distance of the windows'
# centres from the pixel, to both sides [pixel].
_BLUR: Final = 1.0
_REACH: Final = 1
# Edge strength [standard deviation] that a path longer by one pixel is worth.
_COMPACTNESS: Final = 0.5
_EMPTY: Final = 1e-3  # share of the largest weight below which a window holds nothing [1]


def mean_signals(
    corrected: xr.Dataset, response: xr.Dataset, bands: list[int], noise: Array
) -> tuple[Array, Array, Array]:
    """Mean signals (band, y, x) [K] of the bands, variances, and the reference's change [K]."""
    counts = corrected["counts"]
    shape = (len(bands), counts.sizes["y"], counts.sizes["x"])
    means, frames, change = np.empty(shape), np.empty(shape), np.empty(shape[1:])
    # The change is the mean of the last third of the frames less that of the first.
    third = max(counts.sizes["time"] // 3, 1)
    thirds = slice(third), slice(third, -third), slice(-third, None)
    names = [str(counts["band"].values[band]) for band in bands]
    curves = responses.curves(response, names)
    for index, (band, curve) in enumerate(zip(bands, curves, strict=True)):
        for top in range(0, shape[1], _ROWS):
            rows = slice(top, top + _ROWS)
            block = counts.isel(band=band, y=rows).values
            valid = schema.measured(block)
            block = block if valid.all() else np.where(valid, block, 0.0)
            sums, numbers = (
                np.stack([film[selected].sum(axis=0, dtype=np.float64) for selected in thirds])
                for film in (block, valid)
            )
            frames[index, rows] = numbers.sum(axis=0)
            with np.errstate(invalid="ignore"):  # without a sample
                means[index, rows] = curve.linearise(sums.sum(axis=0) / frames[index, rows])
                if index == 0:
                    change[rows] = np.diff(curve.linearise(sums[::2] / numbers[::2]), axis=0)[0]
    # var(mean) = s_m^2 / N, and var(pattern) = var(z_m - z_r from pixel to pixel) - both of these
    inverse = np.divide(1.0, frames, out=np.full(shape, np.inf), where=frames > 0)
    variances = noise[:, np.newaxis, np.newaxis] ** 2 * inverse
    # Neighbours that differ by more than noise, as by a residual fixed pattern, add a variance.
    for index in range(1, len(bands)):
        image = means[index] - means[0]
        bend = (image[2:] - 2.0 * image[1:-1] + image[:-2]) / np.sqrt(6.0)  # of variance s^2
        valid = np.abs(bend[np.isfinite(bend)])
        scatter = MAD * float(np.median(valid)) if valid.size else 0.0
        of_noise = float(np.median(variances[0] + variances[index]))
        variances[index] += max(scatter**2 - of_noise, 0.0)
    return means, variances, change


def reflected_difference(result: xr.Dataset, bands: list[int], of: Mask) -> tuple[Array, Array]:
    r"""Reflection in differences of the bands' mean signals, (band - 1, y, x) [K], and variance.

    .. math:: (k_m - 1) (1 - e_{ref}) (\bar y - \mathrm{median}\, y)
    """
    dark = 1.0 - result["emissivity"].values[bands[0]]
    share = (result["reflection_ratio"].values[bands[1:]] - 1.0) * dark
    films = [result[f"background_temperature{name}"].values for name in ("", "_std")]
    frames, (excess, deviation) = len(films[0]), np.zeros((2, *of.shape))
    for row in np.flatnonzero(of.any(axis=1)):
        film, std = (select(array[:, row], of[row]) for array in films)
        # Sorted along contiguous samples: far faster than a median along the first axis.
        ordered = np.sort(film.T.copy(), axis=1)
        # The background at rest, which makes no edges.
        median = ordered[:, [(frames - 1) // 2, frames // 2]].mean(axis=1)
        excess[row, of[row]] = film.mean(axis=0) - median
        deviation[row, of[row]] = std.mean(axis=0)
        release()
    # var(mean - median) = (pi / 2 - 1) s^2 / N of normal noise
    variance = (np.pi / 2 - 1) * (share * deviation) ** 2 / frames
    # 0 where nothing moved, without a background estimate, and at pixels not selected.
    valid = np.isfinite(share * excess * variance)
    return np.where(valid, share * excess, 0.0), np.where(valid, variance, 0.0)


def edges(maps: Array, variances: Array) -> Array:
    r"""Strength (y, x) of an edge through each pixel of maps (feature, y, x) [standard deviation].

    Weighted means before and after a pixel are compared, along y and along x; the larger of

    .. math:: t^2 = \sum_f \frac{(m_+ - m_-)^2}{\mathrm{var}(m_+) + \mathrm{var}(m_-)}

    counts, 0 where all features are NaN.
    """
    sound = np.isfinite(maps) & np.isfinite(variances) & (variances > 0)
    weight = np.divide(1.0, variances, out=np.zeros_like(maps), where=sound)
    window = np.array([0.0, _BLUR, _BLUR])
    # m = sum g w f / sum g w,  var(m) = sum g^2 w / (sum g w)^2
    total = ndimage.gaussian_filter(weight, window)
    # The square of a Gaussian is a narrower Gaussian.
    squares = ndimage.gaussian_filter(weight, window / np.sqrt(2)) / (4 * np.pi * _BLUR**2)
    weighted = ndimage.gaussian_filter(weight * np.where(sound, maps, 0.0), window)
    valid = total > _EMPTY * weight.max(axis=(1, 2), keepdims=True)
    mean = np.divide(weighted, total, out=np.zeros_like(total), where=valid)
    variance = np.divide(squares, total**2, out=np.full_like(total, np.inf), where=valid)
    return np.asarray(np.sqrt(np.maximum(*(_contrast(mean, variance, axis) for axis in (1, 2)))))


def _contrast(mean: Array, variance: Array, axis: int) -> Array:
    """Squared difference of the means on both sides along an axis, over its variance."""
    size = mean.shape[axis]
    before, after = (np.clip(np.arange(size) + s, 0, size - 1) for s in (-_REACH, _REACH))
    difference = mean.take(after, axis) - mean.take(before, axis)
    total = variance.take(after, axis) + variance.take(before, axis)
    return np.asarray(np.sum(difference**2 / total, axis=0))


def superpixels(strength: Array, valid: Mask, spacing: int) -> Labels:
    """Connected cells of about `spacing` by `spacing` pixels, numbered from 1; 0 where not valid.

    Waterpixels of the edge strength: Machairas et al. (2015), IEEE Trans. Image Process. 24, 3707,
    doi:10.1109/TIP.2015.2451011.
    """
    segmentation = importlib.import_module("skimage.segmentation")
    rows, columns = (np.arange(min(spacing // 2, n - 1), n, spacing) for n in strength.shape)
    markers = np.zeros(strength.shape, dtype=np.intp)
    markers[np.ix_(rows, columns)] = 1 + np.arange(rows.size * columns.size).reshape(rows.size, -1)
    grown = {"markers": markers * valid, "mask": valid, "compactness": _COMPACTNESS}
    flooded = segmentation.watershed(strength, **grown)
    return connected(np.where(valid, 1 + flooded, 0))


def connected(values: Labels) -> Labels:
    """Numbers (y, x) from 1 of the parts of equal value connected by sides; 0 where that is 0."""
    measure = importlib.import_module("skimage.measure")
    return np.asarray(measure.label(values, connectivity=1), dtype=np.intp)
