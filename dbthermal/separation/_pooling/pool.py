"""Reflection ratios and emissivity of each material, from the surveys of its pixels."""

from collections.abc import Callable
from dataclasses import replace
from typing import Final, TypeAlias

import numpy as np

from dbthermal.separation._inputs import Inputs, Labels
from dbthermal.separation._pooling import gradients, ratios
from dbthermal.separation._pooling.ratios import Common, Image, Ratios, total
from dbthermal.separation._tiles import Array, Mask, Material, Survey

MOST: Final = 2048
"""Pixels of one material that are surveyed: more would not lower its systematic error."""

Surveyor: TypeAlias = Callable[[Inputs, Material | None, Mask], Survey]
"""Surveys some pixels of the image (pixel), alone or with the ratios of their materials."""

# Share of a material's pixels that have an emissivity alone, from which it is theirs [1].
_MOST_TOLD: Final = 0.98
# Rounds of leaving out pixels that are not of the material.
_ROUNDS: Final = 6
# Share of the pixels from which those with an emissivity of their own speak for a material [1].
_MAJORITY: Final = 0.5


def materials(
    inputs: Inputs, survey: Surveyor, surveys: Survey | None, known: Material | None = None
) -> Material | None:
    """Ratios and emissivity of the material of each pixel of the image; None if none are told.

    Of the surveys of all pixels alone, made of some if not at hand. Those that have an emissivity
    alone are a selection by their ratios: unless they are nearly all of their material, all of it
    are surveyed again, with its ratios. Those `known` stay, and pixels are surveyed with them.
    """
    labels, noise = inputs.labels, inputs.noise[inputs.bands]
    assert labels is not None
    selected, unknown = select(labels), np.full(labels.size, np.nan)
    places = np.flatnonzero(selected)
    if surveys is None:
        before = None if known is None else replace(known, noise_variance=unknown)
        surveys = survey(inputs, before, selected)
    alone = surveys.select_pixels(places)
    if not np.any(alone.frames[0] > 0):
        return None
    image = Image(labels, places, inputs.capture.sizes["x"])
    found = estimate(image, labels[places], alone, noise, known)
    count = int(labels.max()) + 1
    sound, told = (
        total(labels[places], 1.0 * part, count)
        for part in (alone.frames[0] > 0, np.isfinite(alone.emissivity))
    )
    again = (told <= _MOST_TOLD * sound)[labels[places]] & np.isfinite(found.ratio[-1, places])
    if known is not None or not np.any(again):
        return found
    selected[places] = again
    # The emissivity is a guess, of constant objects alone.
    more = survey(inputs, replace(found, noise_variance=unknown), selected).select_pixels(selected)
    alone.replace_pixels(again, more)
    return estimate(image, labels[places], alone, noise, known)


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
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        count = int(image.labels.max()) + 1
        found, used, most = _sound(labels, count, survey, noise)
        if known is None:
            common, used = _common(image, labels, (found, used, most), survey, noise)
        else:
            stated = np.isfinite(known.ratio[-1])
            ratio = np.where(stated, known.ratio, image.expand(found.ratio))
            variance = np.where(stated, known.inverse_energy, image.expand(found.variance))
            common = Common(ratio, variance, known.spread)
        return _material(image, common, used, survey)


def _sound(labels: Labels, count: int, survey: Survey, noise: Array) -> tuple[Ratios, Labels, Mask]:
    """Ratios of each material, labels of the pixels that agree, and those that may be left out."""
    # A pixel that takes a rapid object for the background has an energy beyond all others'.
    told = np.isfinite(survey.emissivity) * 1.0
    sound = np.where(told > 0, labels, -1)
    found = ratios.estimate(sound, count, survey, noise, even=True)
    outliers = ratios.outliers(labels, found, found.common(labels), survey, noise)
    # Near black the few that have an emissivity alone are selected by their own ratio.
    surveyed = np.where(survey.frames[0] > 0, 1.0, 0.0)
    most = total(labels, told, count) > _MAJORITY * total(labels, surveyed, count)
    of_most = np.append(most, False)[labels]
    used = np.where(outliers & of_most, -1, labels)
    for _ in range(_ROUNDS):
        found = ratios.estimate(used, count, survey, noise, even=True)
        outliers = ratios.outliers(used, found, found.common(labels), survey, noise)
        if not np.any(outliers):
            break
        used = np.where(outliers, -1, used)
    return ratios.estimate(used, count, survey, noise), used, of_most


def _common(
    image: Image, labels: Labels, sound: tuple[Ratios, Labels, Mask], survey: Survey, noise: Array
) -> tuple[Common, Labels]:
    """Ratios of all pixels with their gradients, and labels of the pixels that agree with them.

    Along a gradient those far from its middle are no outliers, and the scatters, which are added,
    have one axis only if it is taken out. Where few pixels have an emissivity alone, a selection by
    their ratios, no gradient is told. A degree more in each round, for what goes through the
    middle alone leads astray beyond it.
    """
    found, used, most = sound
    seen = np.where(most, used, -1)
    common, uneven = ratios.graded(image, seen, found, survey, noise)
    if not np.any(uneven):
        return common, used
    common, _ = ratios.graded(image, seen, found, survey, noise, limit=1)
    for degree in range(2, _ROUNDS + 2):
        here = common.at(image.surveyed)
        used = np.where(uneven[labels], labels, used)
        for _ in range(_ROUNDS):
            outliers = most & ratios.outliers(used, found, here, survey, noise)
            if not np.any(outliers):
                break
            used = np.where(outliers, -1, used)
        even = ratios.scaled(survey, found.ratio[:, labels] / here.ratio)
        found = ratios.estimate(used, uneven.size - 1, even, noise)
        seen, limit = np.where(most, used, -1), min(degree, gradients.DEGREE)
        common, _ = ratios.graded(image, seen, found, survey, noise, limit)
    return common, used


def _material(image: Image, common: Common, labels: Labels, survey: Survey) -> Material:
    """Emissivity of the first band, its variance from noise, and that from drift [1], to ratios."""
    count = int(image.labels.max()) + 1
    # With p = w . kappa of the common ratios, before a background at rest the null combination has
    # a slope of 1 - (1 - e_1) p with the object's signal, and the regression one of e_1 over that.
    product = (survey.null_weights * common.ratio[:, image.surveyed]).sum(axis=0)
    value = survey.emissivity * (1.0 - product) / (1.0 - survey.emissivity * product)
    known = (labels >= 0) & np.isfinite(value)
    where = np.where(known, labels, -1)
    value, noise, drift = (
        np.where(known, part, 0.0) for part in (value, survey.noise_variance, survey.drift_variance)
    )
    # Weights 1 / (var + median var): no pixel outweighs all others by a small variance.
    typical = np.median(noise[known]) if np.any(known) else np.nan
    weight = np.where(known, 1.0 / (noise + typical), 0.0)
    whole = total(where, weight, count)
    mean = total(where, weight * value, count) / whole
    # var(mean) = sum w^2 (e - mean)^2 / (sum w)^2 n / (n - 1), at least sum w^2 var / (sum w)^2
    residual = np.where(known, (value - mean[where]) ** 2, 0.0)
    pixels = total(where, np.ones_like(value), count)
    scatter = total(where, weight**2 * residual, count) / whole**2
    scatter *= pixels / np.maximum(pixels - 1, 1)
    expected = total(where, weight**2 * noise, count) / whole**2
    result = Material(
        ratio=common.ratio,
        inverse_energy=common.variance,
        emissivity=image.expand(mean),
        noise_variance=image.expand(np.maximum(scatter, expected)),
        drift_variance=image.expand(total(where, weight * drift, count) / whole),
        spread=common.spread,
    )
    return _graded(image, result, where, (value - mean[where], noise, weight))


def _graded(
    image: Image, material: Material, labels: Labels, sample: tuple[Array, Array, Array]
) -> Material:
    """Emissivity with its gradients, from differences of single pixels, variances, and weights."""
    emissivity, variance = material.emissivity.copy(), material.noise_variance.copy()
    every, fits = np.unique(labels[labels >= 0]), []
    for label in every:
        pixels = np.flatnonzero(labels == label)
        apart, noise, weight = (part[pixels] for part in sample)
        cost = gradients.Cost(weight, weight * apart, weight**2 * noise)
        fits.append(image.gradient(label, pixels, cost))
    for label, fit, spread in zip(every, fits, gradients.spreads(fits), strict=True):
        pixels = image.labels == label
        # What differs by no more than the error from drift may be that.
        if np.var(fit.value) + spread > material.drift_variance[pixels][0]:
            emissivity[pixels] += fit.value
            variance[pixels] = np.maximum(variance[pixels], fit.variance) + spread
    return replace(material, emissivity=emissivity, noise_variance=variance)
