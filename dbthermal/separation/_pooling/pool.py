"""Reflection ratios and emissivity of each material, from the surveys of its pixels."""

from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

import numpy as np

from dbthermal.separation import _tiles as tiles
from dbthermal.separation._inputs import Inputs, Labels
from dbthermal.separation._pooling import gradients
from dbthermal.separation._subspace import reflection_ratio
from dbthermal.separation._tiles import Array, Mask, Material, Survey

MOST: Final = 2048
"""Pixels of one material that are surveyed: more would not lower its systematic error."""

# Share of the pixels of the materials that have an emissivity alone, from which it is theirs [1].
_MOST_TOLD: Final = 0.98
# Deviations beyond which a pixel is not of the material, and rounds of leaving such ones out.
_OUTLIER_SIGMAS: Final = 4.0
_ROUNDS: Final = 6
# Deviations beyond which the order of the pixels is too small for their material.
_ORDER_SIGMAS: Final = 3.0
# Share of the pixels from which those with an emissivity of their own speak for a material [1].
_MAJORITY: Final = 0.5
# Energy along the axis from which there is one: deviations of the noise's, and share of it [1].
_ENERGY_SIGMAS: Final = 8.0
_LEAST_ENERGY: Final = 0.01


def materials(
    inputs: Inputs,
    threads: Executor,
    bar: Any,
    *,
    every: bool = False,
    surveyed: Labels | None = None,
    known: Material | None = None,
) -> Material | None:
    """Ratios and emissivity of the material of each pixel of the image; None if none are told.

    Pixels that have an emissivity alone are a selection by their ratios: unless they are nearly
    all, or `every` is set, all are surveyed again with the ratios of their material. The labels
    (pixel) of those that are `surveyed`, -1 for others, if not all are. Ratios that are `known`
    stay.
    """
    whole = inputs.labels
    if whole is None:
        return None
    labels = whole if surveyed is None else surveyed
    selected, blocks = select(labels), inputs.blocks

    def pooled(before: Material | None) -> tuple[Material | None, float]:
        """Materials, and the share of their pixels that have an emissivity."""
        survey = partial(_survey, inputs, selected, bar, before)
        surveys = [part for block in threads.map(survey, blocks) for part in block]
        if not surveys:
            return None, 0.0
        places = np.concatenate([place for place, _ in surveys])
        together = surveys[0][1].join([part for _, part in surveys[1:]])
        image = Image(whole, places, inputs.capture.sizes["x"])
        found = estimate(image, labels[places], together, inputs.noise[inputs.bands], known)
        told = np.isfinite(together.emissivity).sum() / max((together.frames > 0).sum(), 1)
        return found, told

    if known is not None:
        return pooled(replace(known, emissivity=np.full_like(known.emissivity, np.nan)))[0]
    material, told = pooled(None)
    if material is None or every or told > _MOST_TOLD:
        return material
    return pooled(replace(material, emissivity=np.full_like(material.emissivity, np.nan)))[0]


def _survey(
    inputs: Inputs, selected: Mask, bar: Any, material: Material | None, rows: slice
) -> list[tuple[Labels, Survey]]:
    """Survey the selected pixels of a block of rows; with their numbers in the image."""
    surveys = []
    for cut in tiles.cut(inputs, rows, material):
        numbers = tiles.numbers(cut.window, inputs.capture.sizes["x"])
        for _, pixels, tile in cut.parts:
            wanted = selected[numbers[pixels]]
            if np.any(wanted):
                part = tile if np.all(wanted) else tile.select_pixels(wanted)
                survey: Survey = inputs.apply(inputs.method.survey, part)
                # Whitened by one noise for all, not by that of the tile.
                scale = np.array(part.noise) / inputs.noise[inputs.bands]
                square = np.multiply.outer(scale, scale)[..., np.newaxis]
                scatters = survey.scatter * square, survey.rapid_scatter * square
                survey = replace(survey, scatter=scatters[0], rapid_scatter=scatters[1])
                surveys.append((numbers[pixels][wanted], survey))
        if material is None:
            bar.update(cut.status.size)
    return surveys


def select(labels: Labels) -> Mask:
    """At most `MOST` pixels of each material, spread evenly over it, by their labels (pixel,)."""
    order = np.argsort(labels, kind="stable")
    ordered = labels[order]
    first = np.searchsorted(ordered, ordered)
    count = np.bincount(ordered[ordered >= 0], minlength=1)
    stride = np.maximum(1, -(-count // MOST))
    result = np.zeros(labels.shape, dtype=bool)
    place = np.arange(ordered.size) - first
    result[order] = (ordered >= 0) & (place % stride[ordered] == 0)
    return result


@dataclass(frozen=True)
class Image:
    """Materials of all pixels of an image, and which of the pixels are surveyed."""

    labels: Labels  # (pixel,)
    surveyed: Labels  # numbers of pixels in the image (surveyed,)
    width: int

    def expand(self, values: Array) -> Array:
        """Values (..., material) at each pixel (..., pixel); NaN at those without a material."""
        return np.where(self.labels >= 0, values[..., self.labels], np.nan)

    def gradient(self, label: int, known: Labels, cost: gradients.Cost) -> gradients.Gradient:
        """Gradient at all pixels of a label, of some that are surveyed."""
        asked = np.flatnonzero(self.labels == label)
        places = (np.divmod(one, self.width) for one in (self.surveyed[known], asked))
        return gradients.fit(*places, cost)


@dataclass(frozen=True)
class _Common:
    """Ratios of each pixel by its material."""

    ratio: Array  # (band, pixel) [1]
    variance: Array  # of them, common to neighbours (pixel) [1/K^2]
    spread: Array  # of single pixels about them (pixel) [1/K^2]


def estimate(
    image: Image, labels: Labels, survey: Survey, noise: Array, known: Material | None = None
) -> Material:
    r"""Ratios and emissivity at all pixels, from surveyed ones of given labels (surveyed,).

    The scatters of the pixels are added, and their principal axis gives the material's ratios: the
    maximum of the likelihood, without the bias of a mean of ratios. The emissivity is the mean of
    the pixels' own, corrected to these ratios. Both may have `gradients` over the place. A pixel
    that differs from its material by more than four standard deviations is left out. The noise is
    that of the bands (band,) [K]; NaN for a material without information. Ratios (band, pixel) that
    are `known` are those.
    """
    count = int(image.labels.max()) + 1
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        # A pixel that takes a rapid object for the background has an energy beyond all others'.
        told = np.isfinite(survey.emissivity) * 1.0
        sound = np.where(told > 0, labels, -1)
        found = _ratios(sound, count, survey, noise, even=True)
        outliers = _outliers(labels, found, found.ratio[:, labels], survey, noise)
        # Near black the few that have an emissivity alone are selected by their own ratio.
        surveyed = np.where(survey.frames > 0, 1.0, 0.0)
        most = _sum(labels, told, count) > _MAJORITY * _sum(labels, surveyed, count)
        most = np.append(most, False)[labels]
        used = np.where(outliers & most, -1, labels)
        for _ in range(_ROUNDS):
            found = _ratios(used, count, survey, noise, even=True)
            outliers = _outliers(used, found, found.ratio[:, labels], survey, noise)
            if not np.any(outliers):
                break
            used = np.where(outliers, -1, used)
        found = _ratios(used, count, survey, noise)
        if known is not None:
            stated = np.isfinite(known.ratio[-1])
            ratio = np.where(stated, known.ratio, image.expand(found.ratio))
            variance = np.where(stated, known.inverse_energy, image.expand(found.variance))
            return _material(image, _Common(ratio, variance, known.spread), used, survey)
        common, graded = _graded(image, used, found, survey, noise)
        for _ in range(_ROUNDS if np.any(graded) else 0):
            # Along a gradient those far from its middle are no outliers, and no axis is common.
            ratio, before = common.ratio[:, image.surveyed], used
            used = np.where(graded[labels], labels, used)
            for _ in range(_ROUNDS):
                used = np.where(most & _outliers(used, found, ratio, survey, noise), -1, used)
            found = _ratios(used, count, _turned(survey, found.ratio[:, labels] / ratio), noise)
            common, graded = _graded(image, used, found, survey, noise)
            if np.array_equal(used, before):
                break
        return _material(image, common, used, survey)


def _turned(survey: Survey, change: Array) -> Survey:
    """Survey with the rapid changes of each pixel times a factor (band, pixel), where known."""
    factor = np.where(np.isfinite(change), change, 1.0)
    factor = factor[:, np.newaxis] * factor
    scatter, rapid = survey.scatter * factor, survey.rapid_scatter * factor
    return replace(survey, scatter=scatter, rapid_scatter=rapid)


def _graded(
    image: Image, labels: Labels, found: "_Ratios", survey: Survey, noise: Array
) -> tuple[_Common, Mask]:
    r"""Ratios with their gradients over the place, and the materials that have one.

    In the plane of the whitened bands the ratio is the angle :math:`\vartheta` from the common
    axis u towards the axis n across it. A pixel's scatter C of white noise and n degrees of freedom
    tells it by :math:`a = u^T C u - n^T C n`, :math:`b = n^T C u`, of variance u^T C u + n.
    """
    ratio, variance = image.expand(found.ratio), image.expand(found.variance)
    spread, graded = np.zeros(image.labels.size), np.zeros(len(found.variance) + 1, dtype=bool)
    scatter = np.where(found.rapid[labels], survey.rapid_scatter[1], survey.scatter)
    frames = np.where(found.rapid[labels], survey.rapid_frames[1], survey.frames)
    fits, at = [], []
    for label in np.flatnonzero(np.isfinite(found.variance)):
        pixels = np.flatnonzero((labels == label) & (frames > 0))
        whitened = found.ratio[:, label] / noise
        length, parts = whitened @ whitened, scatter[..., pixels]
        axes = np.linalg.qr(whitened[:, np.newaxis], mode="complete")[0]
        axes *= np.sign(axes[0, 0])
        seen = np.einsum("bi,bcp,cj->ijp", axes, parts, axes)
        asked, vector = np.flatnonzero(image.labels == label), axes[:, :1]
        for number, across in enumerate(axes.T[1:], 1):
            cost = gradients.Cost(
                seen[0, 0] - seen[number, number], seen[number, 0], seen[0, 0] + frames[pixels]
            )
            one = image.gradient(label, pixels, cost)
            if one.degree > 0:
                graded[label] = True
                vector = vector + one.value * across[:, np.newaxis]
                variance[asked] = np.maximum(variance[asked], length * one.variance)
            fits.append(one)
            at.append((asked, length))
        if graded[label]:
            ratio[:, asked] = vector * noise[:, np.newaxis] / (vector[0] * noise[0])
    for (asked, length), square in zip(at, gradients.spreads(fits), strict=True):
        spread[asked] = np.maximum(spread[asked], length * square)
    return _Common(ratio, variance, spread), graded


def _sum(labels: Labels, values: Array, count: int) -> Array:
    """Sum of values (pixel) over each material."""
    known = labels >= 0
    return np.asarray(np.bincount(labels[known], values[known], count), dtype=np.float64)


def _inverse_energy(scatter: Array, ratio: Array, noise: Array, freedom: Array) -> Array:
    """Variance [1/K^2] of ratios (band, n) that stand on a whitened scatter (band, band, n)."""
    # With v = kappa / s, the energy in the first band is S = v^T C v / |v|^4.
    whitened = ratio / noise[:, np.newaxis]
    length = (whitened**2).sum(axis=0)
    energy = np.einsum("bn,bcn,cn->n", whitened, scatter, whitened) / length**2
    return reflection_ratio.inverse_energy(energy, length, freedom)


@dataclass(frozen=True)
class _Ratios:
    """Ratios of each material."""

    ratio: Array  # (band, material) [1]
    variance: Array  # (material) [1/K^2]
    rapid: Mask  # at the largest order, not at those of the pixels (material)


def _ratios(
    labels: Labels, count: int, survey: Survey, noise: Array, *, even: bool = False
) -> _Ratios:
    """Ratios of the summed scatters, at the order of each pixel unless the largest contradicts it.

    Then at that; and what fewer functions would change, beyond noise, is a variance. With `even`
    weights few pixels of much energy do not turn the axis: they are to be found as outliers.
    """
    used, frames = survey.scatter, survey.frames
    parts = [(used, frames), *zip(survey.rapid_scatter, survey.rapid_frames, strict=True)]
    if even:
        parts = [_even(labels, count, *part) for part in parts]
    own, fewer, most = (_at_order(labels, count, *part, noise) for part in parts)
    rapid = _apart(own, most, noise)[0] > _ORDER_SIGMAS
    ratio, variance = (np.where(rapid, *pair) for pair in zip(most, own, strict=True))
    return _Ratios(ratio, variance + np.where(rapid, _apart(fewer, most, noise)[1], 0.0), rapid)


def _even(labels: Labels, count: int, scatter: Array, frames: Array) -> tuple[Array, Array]:
    """Scatters and their frames, of about the same energy in all pixels of a material.

    Their sum is the spatial sign covariance (Locantore et al. 1999, doi:10.1007/BF02595862).
    """
    energy = np.einsum("bbp->p", scatter) + len(scatter) * frames
    inverse = np.where(frames > 0, 1.0 / energy, 0.0)
    weight = (
        inverse
        * (_sum(labels, np.where(frames > 0, 1.0, 0.0), count) / _sum(labels, inverse, count))[
            labels
        ]
    )
    return scatter * weight, frames * weight


def _at_order(
    labels: Labels, count: int, scatter: Array, frames: Array, noise: Array
) -> tuple[Array, Array]:
    """Ratios (band, material) of scatters summed over each, and their variance [1/K^2]."""
    bands = range(len(noise))
    total = np.array([[_sum(labels, scatter[i, j], count) for j in bands] for i in bands])
    informed = np.einsum("bbm->m", total) > 0
    total = np.where(informed, total, np.eye(len(noise))[..., np.newaxis])
    ratio = reflection_ratio.principal_ratio(np.moveaxis(total, -1, 0), noise)
    freedom = _sum(labels, frames, count)
    # Energy along the axis, over that of the noise: a whole picture sees what is not there.
    whitened = ratio / noise[:, np.newaxis]
    unit = whitened / np.sqrt((whitened**2).sum(axis=0))
    along = np.einsum("bm,bcm,cm->m", unit, total, unit)
    informed &= along > np.maximum(_ENERGY_SIGMAS * np.sqrt(2.0 * freedom), _LEAST_ENERGY * freedom)
    variance = _inverse_energy(total, ratio, noise, freedom)
    return np.where(informed, ratio, np.nan), np.where(informed, variance, np.nan)


def _apart(
    one: tuple[Array, Array], other: tuple[Array, Array], noise: Array
) -> tuple[Array, Array]:
    """Difference of the ratios at two orders in standard deviations, and its excess [1/K^2].

    The estimate at the smaller order is the more certain one, and their difference has the
    difference of their variances (Hausman 1978, doi:10.2307/1913827).
    """
    scale = noise[1:, np.newaxis] ** 2 + (other[0][1:] * noise[0]) ** 2
    square = np.max((one[0] - other[0])[1:] ** 2 / scale, axis=0)
    expected = np.abs(other[1] - one[1])
    return np.sqrt(square / expected), np.maximum(square - expected, 0.0)


def _outliers(
    labels: Labels, material: _Ratios, common: Array, survey: Survey, noise: Array
) -> Mask:
    """Pixels whose ratio, at the orders of their material, is not the common one (band, pixel).

    Both by its own deviation, and by that of the material's ratio in the pixel: near black, pixels
    that tell little have ratios of a wide and skew distribution. Those far off pull the ratio, and
    go first: at least half as far as the farthest of the material.
    """
    rapid = material.rapid[labels]
    axis = common / noise[:, np.newaxis]
    axis = axis / np.sqrt((axis**2).sum(axis=0))
    result = np.zeros(labels.shape, dtype=bool)
    for large, large_frames in zip(survey.rapid_scatter, survey.rapid_frames, strict=True):
        scatter = np.where(rapid, large, survey.scatter)
        frames = np.where(rapid, large_frames, survey.frames)
        whole = np.moveaxis(scatter + frames * np.eye(len(noise))[..., np.newaxis], -1, 0)
        own = np.where(rapid, reflection_ratio.principal_ratio(whole, noise), survey.ratio)
        inverse = _inverse_energy(scatter, own, noise, frames)
        std = np.sqrt(reflection_ratio.ratio_variance(own, inverse, noise))
        score = np.nan_to_num(np.max(np.abs(own - common)[1:] / std[1:], axis=0)) * (labels >= 0)
        farthest = np.zeros(len(material.rapid))
        np.maximum.at(farthest, labels, score)
        apart = score > np.maximum(_OUTLIER_SIGMAS, 0.5 * farthest[labels])
        result |= apart & ~reflection_ratio.agrees(whole, axis)
    known = np.isfinite(material.variance[labels])
    return np.asarray(result & known & (survey.frames > 0) & (labels >= 0))


def _material(image: Image, common: _Common, labels: Labels, survey: Survey) -> Material:
    """Emissivity of the first band, its variance from noise, and that from drift [1], to ratios."""
    count = int(image.labels.max()) + 1
    # e_1 at the common ratios: e_1 - e_1 (1 - e_1) w . kappa
    product = (survey.null_weights * common.ratio[:, image.surveyed]).sum(axis=0)
    value = survey.emissivity * (1.0 - (1.0 - survey.emissivity) * product)
    known = (labels >= 0) & np.isfinite(value)
    where = np.where(known, labels, -1)
    value, noise, drift = (
        np.where(known, part, 0.0) for part in (value, survey.noise_variance, survey.drift_variance)
    )
    # Weights 1 / (var + median var): no pixel outweighs all others by a small variance.
    typical = np.median(noise[known]) if np.any(known) else np.nan
    weight = np.where(known, 1.0 / (noise + typical), 0.0)
    total = _sum(where, weight, count)
    mean = _sum(where, weight * value, count) / total
    # var(mean) = sum w^2 (e - mean)^2 / (sum w)^2 n / (n - 1), at least sum w^2 var / (sum w)^2
    residual = np.where(known, (value - mean[where]) ** 2, 0.0)
    pixels = _sum(where, np.ones_like(value), count)
    scatter = _sum(where, weight**2 * residual, count) / total**2
    scatter *= pixels / np.maximum(pixels - 1, 1)
    expected = _sum(where, weight**2 * noise, count) / total**2
    result = Material(
        ratio=common.ratio,
        inverse_energy=common.variance,
        emissivity=image.expand(mean),
        noise_variance=image.expand(np.maximum(scatter, expected)),
        drift_variance=image.expand(_sum(where, weight * drift, count) / total),
        spread=common.spread,
    )
    fits = {}
    for label in np.unique(where[known]):
        some = np.flatnonzero(where == label)
        w = weight[some]
        cost = gradients.Cost(w, w * (value[some] - mean[label]), w**2 * noise[some])
        fits[label] = image.gradient(label, some, cost)
    for (label, fit), square in zip(fits.items(), gradients.spreads([*fits.values()]), strict=True):
        pixels = np.flatnonzero(image.labels == label)
        # Drift changes from pixel to pixel, too, by no more than its variance.
        if np.var(fit.value) + square > result.drift_variance[pixels[0]]:
            result.emissivity[pixels] += fit.value
            result.noise_variance[pixels] = np.maximum(result.noise_variance[pixels], fit.variance) + square
    return result
