"""Reflection ratios of each material, from the scatters of its pixels."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from dbthermal._arrays import Array, Mask
from dbthermal.separation._inputs import Labels
from dbthermal.separation._pooling import gradients
from dbthermal.separation._subspace import reflection_ratio
from dbthermal.separation._tiles import Pixels, Survey

_OUTLIER_SIGMAS: Final = 4.0  # deviations beyond which a pixel is not of the material
_ORDER_SIGMAS: Final = 3.0  # deviations beyond which ratios at two orders differ not by chance
# Least energy along an axis: in deviations of the noise's energy, and as a share of it [1].
_ENERGY_SIGMAS: Final = 8.0
_LEAST_ENERGY: Final = 0.01


@dataclass(frozen=True)
class Image:
    """Materials of all pixels of an image, and which of the pixels are surveyed."""

    labels: Labels  # (pixel,)
    surveyed: Labels  # numbers of pixels in the image (surveyed,)
    width: int

    def expand(self, values: Array) -> Array:
        """Values (..., material) at each pixel (..., pixel); NaN at those without a material."""
        return np.where(self.labels >= 0, values[..., self.labels], np.nan)

    def gradient(
        self, label: int, known: Labels, cost: gradients.Cost, limit: int = gradients.DEGREE
    ) -> gradients.Gradient:
        """Gradient at all pixels of a label, from some that are surveyed, see `gradients.fit`."""
        asked = np.flatnonzero(self.labels == label)
        start, places = (np.divmod(pixels, self.width) for pixels in (self.surveyed[known], asked))
        return gradients.fit(start, places, cost, limit)


@dataclass(frozen=True)
class Common(Pixels):
    """Ratios of each pixel by its material."""

    ratio: Array  # (band, pixel) [1]
    variance: Array  # of the ratios, common to neighbours (pixel) [1/K^2]
    spread: Array  # of single pixels about the ratios (pixel) [1/K^2]


def total(labels: Labels, values: Array, count: int) -> Array:
    """Sum of values (pixel) over each material."""
    labelled = labels >= 0
    return np.asarray(np.bincount(labels[labelled], values[labelled], count), dtype=np.float64)


@dataclass(frozen=True)
class Ratios:
    """Ratios of each material."""

    ratio: Array  # (band, material) [1]
    variance: Array  # (material) [1/K^2]
    rapid: Mask  # ratio taken at the largest order, not at the pixels' orders (material)

    def common(self, labels: Labels) -> Common:
        """Ratios of pixels by their labels (pixel,)."""
        return Common(self.ratio[:, labels], self.variance[labels], np.zeros(labels.size))


def estimate(
    labels: Labels, count: int, survey: Survey, noise: Array, *, even: bool = False
) -> Ratios:
    """Ratios of scatters summed at each pixel's order, or the largest where a curve may hide."""
    scatters = [*zip(survey.scatter, survey.frames, strict=True)]
    # Few pixels of much energy do not turn the axis: they are to be found as outliers.
    if even:
        scatters = [_even(labels, count, *scatter) for scatter in scatters]
    at_order, fewer, most = (_at_order(labels, count, *scatter, noise) for scatter in scatters)
    resolved = np.isfinite(most[1])
    ratio, variance = (np.where(resolved, *pair) for pair in zip(most, at_order, strict=True))
    # An object's curve that hides in noise, of an energy A = s^2 / (k - 1)^2, turns the ratio by
    # (k - 1) A / E beside a reflection of energy E, s the deviation of the null combination.
    error = noise[1:, np.newaxis] ** 2 + (ratio[1:] * noise[0]) ** 2
    pixels = total(labels, 1.0 * (survey.frames[0] > 0), count)
    hidden = (pixels * variance) ** 2 * np.max(error / (ratio[1:] - 1.0) ** 2, axis=0)
    rapid = _excess(at_order, most, error) > 0.0
    # The largest order is less certain, and taken if the curve may turn the ratio of the material.
    rapid |= resolved & ~(hidden < _OUTLIER_SIGMAS**2 * variance)
    ratio, variance = (np.where(rapid, *pair) for pair in zip(most, at_order, strict=True))
    # What fewer functions change, beyond noise, is a variance; and where the largest order tells
    # nothing, what the pixels' orders may hide.
    excess = np.where(rapid, _excess(fewer, most, error), 0.0)
    return Ratios(ratio, variance + np.where(resolved, excess, hidden), rapid)


def _even(labels: Labels, count: int, scatter: Array, frames: Array) -> tuple[Array, Array]:
    """Scatters and their frames, of about the same energy in all pixels of a material."""
    # Their sum is the spatial sign covariance (Locantore et al. 1999, doi:10.1007/BF02595862).
    energy = np.einsum("bbp->p", scatter) + len(scatter) * frames
    inverse = np.where(frames > 0, 1.0 / energy, 0.0)
    number = total(labels, np.where(frames > 0, 1.0, 0.0), count)
    weight = inverse * (number / total(labels, inverse, count))[labels]
    return scatter * weight, frames * weight


def _at_order(
    labels: Labels, count: int, scatter: Array, frames: Array, noise: Array
) -> tuple[Array, Array]:
    """Ratios (band, material) of scatters summed over each, and their variance [1/K^2]."""
    bands = range(len(noise))
    summed = np.array([[total(labels, scatter[i, j], count) for j in bands] for i in bands])
    informed = np.einsum("bbm->m", summed) > 0
    summed = np.where(informed, summed, np.eye(len(noise))[..., np.newaxis])
    ratio = reflection_ratio.principal_ratio(np.moveaxis(summed, -1, 0), noise)
    freedom = total(labels, frames, count)
    # Energy along the axis, over that of the noise: a whole picture sees what is not there.
    whitened = ratio / noise[:, np.newaxis]
    unit = whitened / np.sqrt((whitened**2).sum(axis=0))
    along = np.einsum("bm,bcm,cm->m", unit, summed, unit)
    informed &= along > np.maximum(_ENERGY_SIGMAS * np.sqrt(2.0 * freedom), _LEAST_ENERGY * freedom)
    variance = reflection_ratio.inverse_energy(summed, ratio, noise, freedom)
    return np.where(informed, ratio, np.nan), np.where(informed, variance, np.nan)


def _excess(smaller: tuple[Array, Array], larger: tuple[Array, Array], error: Array) -> Array:
    """Square of the difference of ratios at two orders beyond chance [1/K^2], over their error."""
    square = np.max((smaller[0] - larger[0])[1:] ** 2 / error, axis=0)
    # The smaller order is the more certain: the difference has the difference of their variances
    # (Hausman 1978, doi:10.2307/1913827).
    expected = np.abs(larger[1] - smaller[1])
    return np.where(square > _ORDER_SIGMAS**2 * expected, square - expected, 0.0)


def outliers(
    labels: Labels, material: Ratios, common: Common, survey: Survey, noise: Array
) -> Mask:
    """Pixels whose ratio, at the orders of their material, is not the common ratio."""
    rapid = material.rapid[labels]
    whitened = common.ratio / noise[:, np.newaxis]
    result = np.zeros(labels.shape, dtype=bool)
    for order in range(1, len(survey.frames)):
        scatter = np.where(rapid, survey.scatter[order], survey.scatter[0])
        frames = np.where(rapid, survey.frames[order], survey.frames[0])
        whole = np.moveaxis(scatter + frames * np.eye(len(noise))[..., np.newaxis], -1, 0)
        pixel_ratio = np.where(rapid, reflection_ratio.principal_ratio(whole, noise), survey.ratio)
        inverse = reflection_ratio.inverse_energy(scatter, pixel_ratio, noise, frames)
        variance = reflection_ratio.ratio_variance(pixel_ratio, inverse + common.spread, noise)
        score = np.max((np.abs(pixel_ratio - common.ratio) / np.sqrt(variance))[1:], axis=0)
        score = np.where(labels >= 0, np.nan_to_num(score), 0.0)
        farthest = np.zeros(len(material.rapid))
        np.maximum.at(farthest, labels, score)
        # Pixels far off pull the ratio, and go first: at least half as far as the farthest.
        distant = score > np.maximum(_OUTLIER_SIGMAS, 0.5 * farthest[labels])
        # By the deviation of the material's ratio in the pixel, too: near black, pixels that tell
        # little have ratios of a wide and skew distribution.
        result |= distant & ~reflection_ratio.agrees(whole, whitened)
    informed = np.isfinite(material.variance[labels])
    return np.asarray(result & informed & (survey.frames[0] > 0) & (labels >= 0))


def graded(
    image: Image,
    labels: Labels,
    level: Ratios,
    survey: Survey,
    noise: Array,
    limit: int = gradients.DEGREE,
) -> tuple[Common, Mask]:
    r"""Ratios with their gradients, up to a degree, and spreads; materials with either.

    In the plane of the whitened bands the ratio is the angle :math:`\vartheta` from the common
    axis u towards the axis n across it. A pixel's scatter C of white noise and n degrees of freedom
    tells it by :math:`a = u^T C u - n^T C n`, :math:`b = n^T C u`, of variance u^T C u + n.
    """
    ratio, variance = image.expand(level.ratio), image.expand(level.variance)
    spread, uneven = np.zeros(image.labels.size), np.zeros(len(level.variance) + 1, dtype=bool)
    scatter, frames = survey.scatter[-1], survey.frames[-1]
    fits, at = [], []
    for label in map(int, np.flatnonzero(np.isfinite(level.variance))):
        pixels = np.flatnonzero((labels == label) & (frames > 0))
        if pixels.size == 0:
            continue
        whitened = level.ratio[:, label] / noise
        length, scatters = whitened @ whitened, scatter[..., pixels]
        axes = np.linalg.qr(whitened[:, np.newaxis], mode="complete")[0]
        axes *= np.sign(axes[0, 0])
        seen = np.einsum("bi,bcp,cj->ijp", axes, scatters, axes)
        asked, vector = np.flatnonzero(image.labels == label), axes[:, :1]
        for number, across in enumerate(axes.T[1:], 1):
            square, variances = seen[0, 0] - seen[number, number], seen[0, 0] + frames[pixels]
            cost = gradients.Cost(square, seen[number, 0], variances)
            gradient = image.gradient(label, pixels, cost, limit)
            if gradient.degree > 0:
                vector = vector + gradient.value * across[:, np.newaxis]
                variance[asked] = np.maximum(variance[asked], length * gradient.variance)
            fits.append(gradient)
            at.append((label, asked, length))
        if any(gradient.degree > 0 for gradient in fits[1 - len(noise) :]):
            ratio[:, asked] = vector * noise[:, np.newaxis] / (vector[0] * noise[0])
    for (label, asked, length), gradient, square in zip(
        at, fits, gradients.spreads(fits), strict=True
    ):
        spread[asked] = np.maximum(spread[asked], length * square)
        uneven[label] |= gradient.degree > 0 or square > 0
    return Common(ratio, variance, spread), uneven
