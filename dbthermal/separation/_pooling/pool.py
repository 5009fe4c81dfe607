"""Reflection ratios and emissivity of each material, from the surveys of its pixels."""

from dataclasses import fields
from typing import Final

import numpy as np
import numpy.typing as npt

from dbthermal.separation._subspace import reflection_ratio
from dbthermal.separation._tiles import Array, Mask, Material, Survey

Labels = npt.NDArray[np.intp]

MOST: Final = 2048
"""Pixels of one material that are surveyed: more would not lower its systematic error."""

# Deviations beyond which a pixel is not of the material, and rounds of leaving such ones out.
_OUTLIER_SIGMAS: Final = 4.0
_ROUNDS: Final = 3


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


def join(parts: list[Survey]) -> Survey:
    """Survey of the pixels of all parts, one after another."""
    names = [field.name for field in fields(Survey)]
    return Survey(*(np.concatenate([getattr(p, name) for p in parts], axis=-1) for name in names))


def expand(materials: Material, labels: Labels) -> Material:
    """Materials at pixels of given labels (pixel,); NaN at those without a material, -1."""
    values = (getattr(materials, field.name) for field in fields(Material))
    return Material(*(np.where(labels >= 0, value[..., labels], np.nan) for value in values))


def estimate(labels: Labels, count: int, survey: Survey, noise: Array) -> Material:
    r"""
    Ratios and emissivity of so many materials from surveyed pixels and their labels (pixel,).

    The scatters of the pixels are added, and their principal axis gives the material's ratios: the
    maximum of the likelihood, without the bias of a mean of ratios. The emissivity is the mean of
    the pixels' own, corrected to the common ratios. A pixel that differs from its material by more
    than four standard deviations is left out. The noise is that of the bands (band,) [K]; NaN for a
    material without information.
    """
    used = labels
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        for _ in range(_ROUNDS):
            ratio, inverse_energy = _ratios(used, count, survey, noise)
            used = np.where(_outliers(used, ratio, survey, noise), -1, used)
        return Material(ratio, inverse_energy, *_emissivities(used, count, survey, ratio))


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


def _ratios(labels: Labels, count: int, survey: Survey, noise: Array) -> tuple[Array, Array]:
    """Ratios (band, material) of the summed scatters, and their variance [1/K^2]."""
    bands = range(len(noise))
    scatter = np.array([[_sum(labels, survey.scatter[i, j], count) for j in bands] for i in bands])
    informed = np.einsum("bbm->m", scatter) > 0
    scatter = np.where(informed, scatter, np.eye(len(noise))[..., np.newaxis])
    ratio = reflection_ratio.principal_ratio(np.moveaxis(scatter, -1, 0), noise)
    variance = _inverse_energy(scatter, ratio, noise, _sum(labels, survey.frames, count))
    return np.where(informed, ratio, np.nan), np.where(informed, variance, np.nan)


def _outliers(labels: Labels, ratio: Array, survey: Survey, noise: Array) -> Mask:
    """Pixels whose own ratio is not that of their material."""
    inverse = _inverse_energy(survey.scatter, survey.ratio, noise, survey.frames)
    variance = reflection_ratio.ratio_variance(survey.ratio, inverse, noise)
    apart = np.abs(survey.ratio - ratio[:, labels]) > _OUTLIER_SIGMAS * np.sqrt(variance)
    return np.asarray(np.any(apart[1:], axis=0) & (survey.frames > 0) & (labels >= 0))


def _emissivities(
    labels: Labels, count: int, survey: Survey, ratio: Array
) -> tuple[Array, Array, Array]:
    """Emissivity (material) of the first band, its variance from noise, and that from drift [1]."""
    # e_1 at the common ratios: e_1 - e_1 (1 - e_1) w . kappa
    product = (survey.null_weights * ratio[:, labels]).sum(axis=0)
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
    return mean, np.maximum(scatter, expected), _sum(where, weight * drift, count) / total
