"""Reflection ratios and emissivity of each material, from the surveys of its pixels.

And pooled pixels held to what each tells alone: values replaced, or deviations widened.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, TypeAlias

import numpy as np
import xarray as xr
from scipy.ndimage import maximum_filter, median_filter, minimum_filter

from dbthermal._arrays import release
from dbthermal._samples import neighbour_mean
from dbthermal.schema import Status
from dbthermal.separation._inputs import Inputs, Labels
from dbthermal.separation._pooling import gradients
from dbthermal.separation._subspace import reflection_ratio
from dbthermal.separation._tiles import LEAST_MEAN, Array, Mask, Material, Survey

MOST: Final = 2048
"""Pixels of one material that are surveyed: more would not lower its systematic error."""

Surveyor: TypeAlias = Callable[[Inputs, Material | None, Mask], Survey]
"""Surveys some pixels of the image (pixel), alone or with the ratios of their materials."""

Regroup: TypeAlias = Callable[[Material | None], Labels]
"""New labels (pixel) of materials, from the estimates of the materials before."""

Restore: TypeAlias = Callable[[Mask], None]  # separates selected pixels (y, x) alone again

# Share of a material's pixels with an emissivity alone, from which they tell it for all [1].
_COVERAGE: Final = 0.98
_ROUNDS: Final = 6  # rounds of leaving out pixels that are not of the material
# Rounds of a gradient and of the pixels that are not of the material along it: in 22 simulated
# pictures seven of rising degree are better by 2 % at most, none leaves objects 12 % further off.
_GRADED: Final = 2
_INNER: Final = 0.8  # share of its pixels that a ratio needs; by 0.5 objects are 2 % further off
_MAJORITY: Final = 0.5  # share of pixels with an emissivity alone that speaks for their material
# Pixels on either side of which a resampled one is made; single ones in a material are no border.
_REACH, _WINDOW = 2, 3
_GAIN: Final = 0.5  # deviation of a ratio pooled over that alone, from which it hardly helps [1]
_GRAY_SHARE: Final = 0.5  # share of gray pixels from which their material is [1]
# Square of the difference in deviations that is no chance, of a pixel and of its neighbours [1].
_UNLIKELY, _UNLIKELY_MEAN = 4.0, 1.5
_VICINITY: Final = 1.5  # deviation of the neighbourhood that shares such errors [pixel]
_FRAMES: Final = 64  # that tell how much an object differs, about

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
        self,
        label: int,
        measured: Labels,
        cost: gradients.Cost,
        limits: tuple[float, float] = (-np.inf, np.inf),
    ) -> gradients.Gradient:
        """Gradient at all pixels of a label within limits, from surveyed ones; `gradients.fit`."""
        pixels = np.flatnonzero(self.labels == label)
        start, places = divmod(self.surveyed[measured], self.width), divmod(pixels, self.width)
        result = gradients.fit(start, places, cost)
        # A polynomial may leave the limits beyond the surveyed pixels: then it is a constant.
        within = (result.value > limits[0]) & (result.value < limits[1])
        return result if np.all(within) else gradients.fit(start, places, cost, degrees=0)


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

    def common(self, labels: Labels) -> Material:
        """Ratios of pixels by their labels (pixel,)."""
        return Material.of_ratios(self.ratio[:, labels], self.variance[labels])


def materials(
    inputs: Inputs, survey: Surveyor, surveys: Survey | None, stated: Material | None = None
) -> Material | None:
    """Ratios and emissivity of the material of each pixel of the image; None if none are told."""
    labels, noise = inputs.labels, inputs.noise[inputs.bands]
    assert labels is not None
    width, unknown = inputs.capture.sizes["x"], np.full(labels.size, np.nan)
    selected = select(_inner(labels.reshape(-1, width)))
    places = np.flatnonzero(selected)
    # Stated ratios stay, and pixels are surveyed with them.
    if surveys is None:
        before = None if stated is None else replace(stated, noise_variance=unknown)
        surveys = survey(inputs, before, selected)
    count = int(labels.max()) + 1
    per_pixel = _usual(labels[places], count, surveys.select_pixels(places))
    if not np.any(per_pixel.frames[0] > 0):
        return None
    image = Image(labels, places, width)
    material = estimate(image, labels[places], per_pixel, noise, stated)
    conditions = per_pixel.frames[0] > 0, np.isfinite(per_pixel.emissivity)
    sound, valid = (total(labels[places], 1.0 * holds, count) for holds in conditions)
    # Pixels with an emissivity alone are a selection by their ratios: unless they are nearly all of
    # their material, all its pixels are surveyed again, with its ratios.
    pixels = (valid <= _COVERAGE * sound)[labels[places]] & np.isfinite(material.ratio[-1, places])
    if stated is not None or not np.any(pixels):
        return material
    selected[places] = pixels
    # The emissivity is a guess, of constant objects alone.
    surveys = survey(inputs, replace(material, noise_variance=unknown), selected)
    per_pixel.replace_pixels(pixels, surveys.select_pixels(selected))
    return estimate(image, labels[places], per_pixel, noise, stated)


def _inner(labels: Labels) -> Labels:
    """Labels (pixel), -1 at the border of a material if most of its pixels lie inside."""
    # What a lens mixes agrees with either material, and biases its ratio by up to 4 deviations.
    inner = minimum_filter(labels, _WINDOW) == maximum_filter(labels, _WINDOW)
    within = np.bincount(labels[inner] + 1, minlength=labels.max() + 2)
    narrow = within < _INNER * np.bincount(labels.ravel() + 1)
    return np.where(inner | narrow[labels + 1], labels, -1).ravel()


def select(labels: Labels) -> Mask:
    """At most `MOST` pixels of each material, spread evenly over it, by their labels (pixel,)."""
    order = np.argsort(labels, kind="stable")
    ordered = labels[order]
    start = np.searchsorted(ordered, ordered)
    count = np.bincount(ordered[ordered >= 0], minlength=1)
    stride = np.maximum(1, -(-count // MOST))
    result = np.zeros(labels.shape, dtype=bool)
    place = np.arange(ordered.size) - start
    result[order] = (ordered >= 0) & (place % stride[ordered] == 0)
    return result


def estimate(
    image: Image, labels: Labels, survey: Survey, noise: Array, material: Material | None = None
) -> Material:
    """Ratios and emissivity at all pixels, from surveyed pixels of given labels (surveyed,)."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        count = int(image.labels.max()) + 1
        survey = _usual(labels, count, survey)
        # The principal axis of the added scatters is the maximum of the likelihood, without the
        # bias of a mean of ratios. The emissivity is the mean of the pixels' emissivities,
        # corrected to these ratios.
        ratio_set, group, removable = _sound(labels, count, survey, noise)
        if material is None:
            common, group = _common(image, labels, (ratio_set, group, removable), survey, noise)
        else:
            # Ratios of a stated material are kept; NaN of a material without information.
            stated = np.isfinite(material.ratio[-1])
            ratio = np.where(stated, material.ratio, image.expand(ratio_set.ratio))
            variance = np.where(stated, material.inverse_energy, image.expand(ratio_set.variance))
            common = Material.of_ratios(ratio, variance, material.spread)
        return _material(image, common, group, survey)


def _usual(labels: Labels, count: int, survey: Survey) -> Survey:
    """Survey with low emissivities only of materials in which they are the rule."""
    # Elsewhere they are errors; without them where they are the rule, the errors alone would count.
    value = survey.emissivity
    low = np.mean(1.0 - survey.ratio * (1.0 - value), axis=0) < LEAST_MEAN
    balance = total(labels, low * 1.0 - (np.isfinite(value) & ~low), count)
    return replace(survey, emissivity=np.where(low & (balance[labels] <= 0.0), np.nan, value))


def _sound(labels: Labels, count: int, survey: Survey, noise: Array) -> tuple[Ratios, Labels, Mask]:
    """Ratios of each material, labels of agreeing pixels, and pixels that may be left out."""
    # A pixel that takes a rapid object for the background has by far the largest energy.
    measured = np.isfinite(survey.emissivity) * 1.0
    sound = np.where(measured > 0, labels, -1)
    ratio_set = _ratios(sound, count, survey, noise, even=True)
    outliers = _outliers(labels, ratio_set, ratio_set.common(labels), survey, noise)
    # Near black the few that have an emissivity alone are selected by their own ratio.
    surveyed = np.where(survey.frames[0] > 0, 1.0, 0.0)
    mostly_measured = total(labels, measured, count) > _MAJORITY * total(labels, surveyed, count)
    removable = np.append(mostly_measured, False)[labels]
    group = np.where(outliers & removable, -1, labels)
    for _ in range(_ROUNDS):
        ratio_set = _ratios(group, count, survey, noise, even=True)
        outliers = _outliers(group, ratio_set, ratio_set.common(labels), survey, noise)
        if not np.any(outliers):
            break
        group = np.where(outliers, -1, group)
    return _ratios(group, count, survey, noise), group, removable


def _ratios(
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


def _outliers(
    labels: Labels, material: Ratios, common: Material, survey: Survey, noise: Array
) -> Mask:
    """Pixels whose ratio, at the orders of their material, is not the common ratio."""
    rapid = material.rapid[labels]
    whitened = common.ratio / noise[:, np.newaxis]
    result = np.zeros(labels.shape, dtype=bool)
    for order in range(1, len(survey.frames)):
        scatter = np.where(rapid, survey.scatter[order], survey.scatter[0])
        frames = np.where(rapid, survey.frames[order], survey.frames[0])
        tensor = np.moveaxis(scatter + frames * np.eye(len(noise))[..., np.newaxis], -1, 0)
        pixel_ratio = np.where(rapid, reflection_ratio.principal_ratio(tensor, noise), survey.ratio)
        inverse = reflection_ratio.inverse_energy(scatter, pixel_ratio, noise, frames)
        inverse = inverse + common.inverse_energy + common.spread
        variance = reflection_ratio.ratio_variance(pixel_ratio, inverse, noise)
        score = np.max((np.abs(pixel_ratio - common.ratio) / np.sqrt(variance))[1:], axis=0)
        score = np.where(labels >= 0, np.nan_to_num(score), 0.0)
        farthest = np.zeros(len(material.rapid))
        np.maximum.at(farthest, labels, score)
        # Pixels far off pull the ratio, and go first: at least half as far as the farthest.
        distant = score > np.maximum(_OUTLIER_SIGMAS, 0.5 * farthest[labels])
        # By the deviation of the material's ratio in the pixel, too: near black, pixels that tell
        # little have ratios of a wide and skew distribution.
        result |= distant & ~reflection_ratio.agrees(tensor, whitened)
    return np.asarray(result & np.isfinite(material.variance[labels]) & (survey.frames[0] > 0))


def _with_gradients(
    image: Image, labels: Labels, level: Ratios, survey: Survey, noise: Array
) -> tuple[Material, Mask]:
    r"""Ratios with their gradients, and spreads; materials with either.

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
        tensor = np.einsum("bi,bcp,cj->ijp", axes, scatters, axes)
        places, vector = np.flatnonzero(image.labels == label), axes[:, :1]
        for number, normal in enumerate(axes.T[1:], 1):
            square, variances = tensor[0, 0] - tensor[number, number], tensor[0, 0] + frames[pixels]
            cost = gradients.Cost(square, tensor[number, 0], variances)
            # Between the angles at which a band's ratio would be zero.
            zeros = axes[:, 0] / np.where(normal == 0.0, np.nan, -normal)
            limits = np.nanmax(zeros[zeros < 0.0]), np.nanmin(zeros[zeros > 0.0])
            gradient = image.gradient(label, pixels, cost, limits)
            if gradient.degree > 0:
                vector = vector + gradient.value * normal[:, np.newaxis]
                variance[places] = np.maximum(variance[places], length * gradient.variance)
            fits.append(gradient)
            at.append((label, places, length))
        if any(gradient.degree > 0 for gradient in fits[1 - len(noise) :]):
            ratio[:, places] = vector * noise[:, np.newaxis] / (vector[0] * noise[0])
    for (label, places, length), gradient, square in zip(
        at, fits, gradients.spreads(fits), strict=True
    ):
        spread[places] = np.maximum(spread[places], length * square)
        uneven[label] |= gradient.degree > 0 or square > 0
    return Material.of_ratios(ratio, variance, spread), uneven


def _common(
    image: Image, labels: Labels, sound: tuple[Ratios, Labels, Mask], survey: Survey, noise: Array
) -> tuple[Material, Labels]:
    """Ratios of all pixels with their gradients, and labels of the pixels that agree with them."""
    pooled, group, removable = sound
    # Few pixels with an emissivity alone, a selection by their ratios, tell no gradient.
    subset = np.where(removable, group, -1)
    common, uneven = _with_gradients(image, subset, pooled, survey, noise)
    if not np.any(uneven):
        return common, group
    # Along a gradient pixels far from its middle are no outliers, and the scatters, which are
    # added, have one axis only without the gradient.
    for _ in range(_GRADED):
        local = common.select_pixels(image.surveyed)
        group = np.where(uneven[labels], labels, group)
        group = np.where(removable & _outliers(group, pooled, local, survey, noise), -1, group)
        change = pooled.ratio[:, labels] / local.ratio
        factor = np.where(np.isfinite(change), change, 1.0)
        even = replace(survey, scatter=survey.scatter * factor[:, np.newaxis] * factor)
        pooled = _ratios(group, uneven.size - 1, even, noise)
        common, _ = _with_gradients(image, np.where(removable, group, -1), pooled, survey, noise)
    return common, group


def _material(image: Image, common: Material, labels: Labels, survey: Survey) -> Material:
    """Emissivity of the first band, its variance from noise, and that from drift [1], to ratios."""
    count = int(image.labels.max()) + 1
    # With p = w . kappa of the common ratios, before a background at rest the null combination has
    # a slope of 1 - (1 - e_1) p with the object's signal, and the regression one of e_1 over that.
    product = (survey.null_weights * common.ratio[:, image.surveyed]).sum(axis=0)
    value = survey.emissivity * (1.0 - product) / (1.0 - survey.emissivity * product)
    valid = (labels >= 0) & np.isfinite(value)
    where = np.where(valid, labels, -1)
    terms = value, survey.noise_variance, survey.drift_variance
    value, noise, drift = (np.where(valid, term, 0.0) for term in terms)
    # Weights 1 / (var + median var): no pixel outweighs all others by a small variance.
    typical = np.median(noise[valid]) if np.any(valid) else np.nan
    weight = np.where(valid, 1.0 / (noise + typical), 0.0)
    norm = total(where, weight, count)
    mean = total(where, weight * value, count) / norm
    # var(mean) = sum w^2 (e - mean)^2 / (sum w)^2 n / (n - 1), at least sum w^2 var / (sum w)^2
    residual = np.where(valid, (value - mean[where]) ** 2, 0.0)
    pixels = total(where, np.ones_like(value), count)
    scatter = total(where, weight**2 * residual, count) / norm**2
    scatter *= pixels / np.maximum(pixels - 1, 1)
    expected = total(where, weight**2 * noise, count) / norm**2
    # All pixels mirror the same people: var(mean) = sum_s (sum_i w k_s)^2 n / (n - 2) of n spans of
    # time, of the residual's influence k in each (Liang, Zeger 1986, doi:10.1093/biomet/73.1.13),
    # beside that of the noise (Cameron et al. 2011, doi:10.1198/jbes.2010.07136).
    spans = [total(where, weight * np.nan_to_num(span), count) for span in survey.influence]
    timed = np.var(spans, axis=0) * len(spans) ** 2 / (len(spans) - 2) / norm**2
    common_error = np.maximum(timed - expected, 0.0)
    result = replace(
        common,
        emissivity=image.expand(mean),
        noise_variance=image.expand(np.maximum(scatter, expected) + common_error),
        drift_variance=image.expand(total(where, weight * drift, count) / norm),
    )
    return _graded(image, result, where, (value - mean[where], noise, weight))


def _graded(
    image: Image, material: Material, labels: Labels, sample: tuple[Array, Array, Array]
) -> Material:
    """Emissivity with its gradients, from differences of single pixels, variances, and weights."""
    emissivity, variance = material.emissivity.copy(), material.noise_variance.copy()
    numbers, fits = np.unique(labels[labels >= 0]), []
    for label in numbers:
        pixels = np.flatnonzero(labels == label)
        difference, noise, weight = (values[pixels] for values in sample)
        cost = gradients.Cost(weight, weight * difference, weight**2 * noise)
        fits.append(image.gradient(label, pixels, cost))
    for label, fit, spread in zip(numbers, fits, gradients.spreads(fits), strict=True):
        pixels = image.labels == label
        # What differs by no more than the error from drift may be that.
        if np.var(fit.value) + spread > material.drift_variance[pixels][0]:
            emissivity[pixels] += fit.value
            variance[pixels] = np.maximum(variance[pixels], fit.variance) + spread
    return replace(material, emissivity=emissivity, noise_variance=variance)


def regrouped(
    inputs: Inputs, materials: Callable[[Inputs], Material | None], regroup: Regroup | None
) -> tuple[Inputs, Material | None]:
    """Inputs, and the estimates of their materials, after a regrouping if the first ask for it."""
    material = materials(inputs)
    labels = None if regroup is None else regroup(material)
    if labels is None or np.all(labels == inputs.labels):
        return inputs, material
    inputs = replace(inputs, labels=labels)
    return inputs, materials(inputs)


def hold(
    per_pixel: xr.Dataset, pooled: xr.Dataset, labels: xr.DataArray, restore: Restore | None
) -> None:
    """Restore pixels, or widen their deviations, where pooled values contradict the pixel alone."""
    apart = restore is None  # of displaced cameras all films of each pixel alone are kept: copied
    # A pixel alone has the ratio of its own changes, with errors of the cameras' pairing or of
    # mixing at an edge; at its material's ratio these errors are in the object.
    sound, valid = (result["status"].values == 0 for result in (per_pixel, pooled))
    # A pixel stays alone without a label, where only so it has no flag, where most of its material
    # is gray, and of cameras apart where pooling hardly makes its ratio more certain.
    stay = sound & (~valid | (labels.values < 0))
    if apart:
        ratios = [result["reflection_ratio_std"].values for result in (pooled, per_pixel)]
        stay |= sound & np.any(ratios[0] > _GAIN * ratios[1], axis=0)
    flags = np.uint32(Status.GRAY), np.uint32(Status.NO_BACKGROUND_MOTION)
    gray = (pooled["status"].values & flags[0]) != 0
    gray_pixels, still = ((per_pixel["status"].values & flag) != 0 for flag in flags)
    stay |= _share(labels.values, gray) > _GRAY_SHARE
    common, stds = sound & valid & ~stay, per_pixel["object_temperature_std"].values
    # At one place nothing is added if most moving pixels of the material are gray alone.
    if not apart:
        common &= _share(np.where(still, -1, labels.values), gray_pixels) <= _GRAY_SHARE
    films = [result["object_temperature"].values for result in (pooled, per_pixel)]
    # Mean square D of the objects' difference, in deviations of the pixel alone.
    square, variance = np.zeros((2, *common.shape))
    sampled = slice(None, None, max(1, len(stds) // _FRAMES))
    for row, columns in enumerate(map(np.flatnonzero, sound & valid)):
        samples = (film[sampled, row].take(columns, axis=1) for film in (*films, stds))
        value, base, std = (sample.astype(np.float64) for sample in samples)
        square[row, columns] = np.nanmean(((value - base) / std) ** 2, axis=0)
        variance[row, columns] = np.nanmean(std**2, axis=0)
        release()
    # Of cameras apart, pixels that stay alone have their deviations widened, too.
    excess = np.where(stay & apart & (square > _UNLIKELY), square, 0.0)
    local = np.where(common, neighbour_mean(square, common, _VICINITY), 0.0)
    regions, size = median_filter(labels.values, _WINDOW, mode="nearest"), 1 + 2 * _REACH
    border = minimum_filter(regions, size) < maximum_filter(regions, size)
    # D times the variance alone is added if D of the pixel or around is no chance, or at a border.
    widened = common & (border | (square > _UNLIKELY) | (local > _UNLIKELY_MEAN))
    square = np.where(widened, np.maximum(square, local), 1.0 * (stay & sound))
    mean = neighbour_mean(square * variance, common | (stay & sound), _VICINITY)
    constant = np.where(valid & ~sound, np.nan_to_num(mean), 0.0)
    factor, film = square * common, pooled["object_temperature_std"].values
    copied = per_pixel.drop_dims([] if apart else "x").items()
    maps = [(pooled[name].values, array.values) for name, array in copied if "x" in array.dims]
    if restore is not None and stay.any():
        restore(stay)
    wider = (factor > 0) | (constant > 0)
    for row in map(int, np.flatnonzero((wider | stay).any(axis=1))):
        columns, places = np.flatnonzero(wider[row]), np.flatnonzero(stay[row])
        base, std = (array[:, row].take(columns, axis=1) for array in (stds, film))
        added = factor[row, columns] * np.nan_to_num(base) ** 2 + constant[row, columns]
        film[:, row, columns] = np.sqrt(std**2 + added)
        for target, variable in maps:
            target[..., row, places] = variable[..., row, places]
        film[:, row, places] *= np.sqrt(1.0 + excess[row, places])
        release()


def _share(labels: Array, holds: Mask) -> Array:
    """Share (y, x) of each pixel's material for which a condition holds; 0 without a material."""
    numbers = np.unique(labels, return_inverse=True)[1].ravel()
    share = np.bincount(numbers, holds.ravel()) / np.bincount(numbers)
    return np.where(labels >= 0, share[numbers].reshape(labels.shape), 0.0)
