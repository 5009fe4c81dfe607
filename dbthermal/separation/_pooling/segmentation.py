"""Cells of an image, cut along its visible edges, and joined while their pooled features agree.

Waterpixels: a watershed from a regular grid of markers floods the edge strength of maps (mean of
the bands' signals, their reflected part), which is a statistic in standard deviations rather than a
gradient in some unit; a smooth gradient is a plateau to it and makes no border. The watershed is
scikit-image's, imported when it is used. Then the statistics of `materials`: pooled features, the
tests of two regions and of their border, and the order in which they are joined.
"""

import heapq
import importlib
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import xarray as xr
from scipy import ndimage
from scipy.ndimage import binary_dilation, distance_transform_cdt
from scipy.special import chdtri

from dbthermal import response as responses
from dbthermal import schema
from dbthermal._arrays import Array, Mask, release, select
from dbthermal.noise import MAD
from dbthermal.separation._inputs import Labels
from dbthermal.separation._pooling import gradients

_ROWS: Final = 64  # rows of a capture that are read at a time
# Standard deviation of the Gaussian window of the edge statistic, and distance of the windows'
# centres from the pixel, to both sides [pixel].
_BLUR: Final = 1.0
_REACH: Final = 1
# Edge strength [standard deviation] that a path longer by one pixel is worth.
_COMPACTNESS: Final = 0.5
_EMPTY: Final = 1e-3  # share of the largest weight below which a window holds nothing [1]
# Difference of the ratios beside a border, relative to these, that no gradient makes [1], and in
# deviations; variance of a median of normal values over that of their mean.
_CONTRAST, _SIGMAS = 0.2, 3.0
_ERROR: Final = 0.08  # from the ratio of the emissivities, where the object's own changes make it
_MEDIAN: Final = np.pi / 2.0


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


@dataclass(frozen=True)
class Features:
    """Estimates of every pixel, and how they pool."""

    values: Array  # (feature, y, x); NaN without an estimate
    variances: Array  # (feature, y, x), in the square of the unit
    common: Mask  # errors that neighbours share: a mean is no surer than one pixel (feature,)
    tolerance: Array  # relative standard deviation that pooling does not reduce (feature,) [1]

    def window(self, window: tuple[slice, ...]) -> "Features":
        """Features of some rows and columns."""
        places = (slice(None), *window)
        return replace(self, values=self.values[places], variances=self.variances[places])

    def sums(self, cells: Labels) -> Array:
        """Sums over cells (4, feature, cell + 1) of weight w, w f, w f^2, and number of pixels."""
        valid = np.isfinite(self.values) & np.isfinite(self.variances) & (self.variances > 0)
        # The inverse variance, 0 without an estimate; pixels of no cell come first.
        weight = np.divide(1.0, self.variances, out=np.zeros_like(self.values), where=valid)
        values = np.where(weight > 0, self.values, 0.0)
        sums = (weight, weight * values, weight * values**2, weight > 0)
        size, flat = int(cells.max()) + 1, cells.ravel()
        return np.array([[np.bincount(flat, m.ravel(), size) for m in term] for term in sums])


def mixed(cells: Labels, features: Features, error_rate: float) -> Mask:
    r"""Cells (cell + 1,) whose pixels disagree; cells of one material only at the error rate.

    .. math:: \sum_p (f_p - \bar f)^2 / s_p^2 > \chi^2_{n - 1}(1 - \alpha / \mathrm{cells})
    """
    total, first, second, count = features.sums(cells)
    # sum w (f - mean)^2 = sum w f^2 - (sum w f)^2 / sum w
    chi_square = second - np.divide(first**2, total, out=np.zeros_like(total), where=total > 0)
    freedom = np.maximum(count - 1, 1)
    limit = chdtri(freedom, error_rate / max(total.shape[1] - 1, 1))
    return np.asarray(np.any(chi_square > limit, axis=0))


def neighbours(cells: Labels) -> Labels:
    """Pairs (pair, 2) of cells that touch along a side of a pixel, each once, smaller first."""
    sides = [(cells[1:], cells[:-1]), (cells[:, 1:], cells[:, :-1])]
    pairs = np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in sides])
    pairs = pairs[(pairs[:, 0] != pairs[:, 1]) & np.all(pairs > 0, axis=1)]
    return np.asarray(np.unique(np.sort(pairs, axis=1), axis=0))


class Regions:
    r"""Regions of cells (y, x), numbered from 1, that are joined while their features agree.

    The statistic of two regions a and b, with pooled features :math:`\bar f`,

    .. math:: T = \sum_f \frac{(\bar f_a - \bar f_b)^2}
        {\mathrm{var}(\bar f_a) + \mathrm{var}(\bar f_b) + (\epsilon_f \bar f)^2}

    is chi-square over the features that both have, if they are of one material. The first feature
    is that whose differences must be resolved.
    """

    def __init__(
        self, cells: Labels, features: Features, error_rate: float, share: float = 1.0
    ) -> None:
        self._total, self._first, _, self._count = features.sums(cells)
        # So many pixels share an error of a feature that is not common to all.
        for sums in (self._total, self._first):
            sums[~features.common] /= share
        self._common = features.common[:, np.newaxis, np.newaxis]
        self._tolerance = features.tolerance[:, np.newaxis]
        freedom = np.arange(features.common.size + 1)
        # The error rate is divided over the borders, which are fewer than three for each cell.
        borders = 3 * self._total.shape[1]
        self._limits = chdtri(np.maximum(freedom, 1), error_rate / borders)
        self._parent = np.arange(self._total.shape[1])

    def root(self, cell: int) -> int:
        """Cell that stands for the region of a cell."""
        parent = self._parent
        while parent[cell] != cell:
            parent[cell] = parent[parent[cell]]
            cell = int(parent[cell])
        return cell

    def roots(self) -> Labels:
        """Roots (cell + 1,) of all cells; the root of pixels without a cell comes first."""
        while np.any(self._parent != self._parent[self._parent]):
            self._parent = self._parent[self._parent]
        return self._parent.copy()

    def known(self) -> Mask:
        """Roots (cell + 1,) of regions with an estimate of the first feature."""
        return np.asarray(self._total[0] > 0)

    def compare(self, first: Labels, second: Labels) -> tuple[Array, Array]:
        """Statistic over its limit, and resolution, of pairs (pair,) of regions by their roots."""
        mean, variance, comparable = self.pooled(np.stack([first, second]))  # (feature, 2, pair)
        joint = np.all(comparable, axis=1)
        # var(f_a - f_b) = var(f_a) + var(f_b) + (epsilon f)^2
        total = variance.sum(axis=1) + (self._tolerance * mean.mean(axis=1)) ** 2
        # The statistic is 0 where no feature can be compared.
        difference = np.where(joint, mean[:, 1] - mean[:, 0], 0.0)
        statistic = np.sum(difference**2 / np.where(joint, total, 1.0), axis=0)
        # Resolution: relative difference of the first feature at the limit, infinite if unknown.
        visible = np.sqrt(self._limits[1] * total[0])
        size = np.where(joint[0], np.abs(mean[0].mean(axis=0)), 0.0)
        resolution = np.divide(visible, size, out=np.full_like(visible, np.inf), where=size > 0)
        return statistic / self._limits[joint.sum(axis=0)], resolution

    def join_alike(self, pairs: Labels, resolution: float) -> None:
        """Join neighbours (pair, 2) that agree within a resolution [1], the most alike first."""
        joined = True
        while joined:
            joined = False
            statistic, resolved = self.compare(*self.roots()[pairs].T)
            alike = np.flatnonzero((statistic <= 1.0) & (resolved <= resolution))
            queue = [(float(statistic[i]), int(pairs[i, 0]), int(pairs[i, 1])) for i in alike]
            heapq.heapify(queue)
            while queue:
                before, region, neighbour = heapq.heappop(queue)
                first, second = self.root(region), self.root(neighbour)
                if first == second:
                    continue
                now, resolved_now = self._compare_one(first, second)
                if now > 1.0 or resolved_now > resolution:
                    continue
                # Grown since it was queued, and less alike: later.
                if now > before:
                    heapq.heappush(queue, (now, first, second))
                    continue
                self.join(first, second)
                joined = True

    def join_in_order(self, pairs: Labels, order: Array) -> None:
        """Join neighbours (pair, 2) by rising order (pair,), unless their features disagree."""
        for index in np.argsort(order, kind="stable"):
            first, second = (self.root(int(cell)) for cell in pairs[index])
            if first != second and self._compare_one(first, second)[0] <= 1.0:
                self.join(first, second)

    def pooled(self, regions: Labels) -> tuple[Array, Array, Mask]:
        """Means of regions, by their roots, variances, and valid ones: (feature, *shape)."""
        # mean = sum w f / sum w,  var = 1 / sum w, times the pixels for an error that all share
        total = self._total[:, regions]
        valid = total > 0
        safe = np.where(valid, total, 1.0)
        pixels = np.where(self._common, self._count[:, regions], 1.0)
        return self._first[:, regions] / safe, pixels / safe, valid

    def _compare_one(self, first: int, second: int) -> tuple[float, float]:
        """Compare a pair of regions, as `compare` does, without arrays: there are many pairs."""
        statistic, features, resolution = 0.0, 0, np.inf
        for k, (total, sums) in enumerate(zip(self._total, self._first, strict=True)):
            if total[first] > 0 and total[second] > 0:
                mean_a, mean_b = sums[first] / total[first], sums[second] / total[second]
                pixels = self._count[k, [first, second]] if self._common[k, 0, 0] else (1.0, 1.0)
                mean = 0.5 * abs(mean_a + mean_b)
                variance = pixels[0] / total[first] + pixels[1] / total[second]
                variance += (self._tolerance[k, 0] * mean) ** 2
                statistic, features = (statistic + (mean_b - mean_a) ** 2 / variance, features + 1)
                if k == 0 and mean > 0:
                    resolution = np.sqrt(self._limits[1] * variance) / mean
        return statistic / self._limits[features], resolution

    def join(self, first: int, second: int) -> None:
        """Join two regions by their roots."""
        self._parent[second] = first
        for values in (self._total, self._first, self._count):
            values[:, first] += values[:, second]
            values[:, second] = 0.0


def alike(first: Mask, second: Mask, ratios: Features, maps: Features) -> bool:
    """Say that the ratios on both sides of a border (y, x) may be those of one material."""
    sound = np.all(np.isfinite(ratios.values) & (ratios.variances > 0), axis=0)
    sides = [sound & region for region in (first, second)]
    if not all(region.any() for region in sides):
        return True
    middle = np.array([np.median(ratios.values[:, region], axis=1) for region in sides])
    variance = [np.median(ratios.variances[:, region], axis=1) / region.sum() for region in sides]
    error = np.sqrt(_MEDIAN * np.sum(variance, axis=0))

    def near(expected: Array, ratio: Array, share: float) -> bool:
        return bool(
            np.all(np.abs(ratio - expected) <= np.maximum(_SIGMAS * error, share * expected))
        )

    if near(middle.mean(axis=0), middle[0], 0.5 * _CONTRAST):
        return True
    # Where a side mirrors nobody, its ratio is that of emissivities: what changes is the object.
    for region, mean, opposite in zip(sides, middle, middle[::-1], strict=True):
        values = maps.values[-1, region]
        if np.isfinite(values).any():
            emissivity = np.nanmedian(values)
            if near((1.0 - mean * (1.0 - emissivity)) / emissivity, opposite, _ERROR):
                return True
    return False


def continuous(
    first: Mask, second: Mask, features: Features, resolution: float, reach: int
) -> bool:
    """Say that the pixels' own features go on across the border of two regions (y, x)."""
    border = (binary_dilation(first) & second) | (binary_dilation(second) & first)
    values, variances = features.values, features.variances
    union = (first | second) & (distance_transform_cdt(~border, "chessboard") <= reach)
    union &= np.all(np.isfinite(values) & (variances > 0), axis=0)
    if not np.any(union):
        return False
    least = np.where(features.common, 0.0, resolution * np.abs(np.mean(values[:, union], axis=1)))
    y, x = np.nonzero(union)
    return gradients.continuous((y, x), values[:, union], variances[:, union], second[union], least)
