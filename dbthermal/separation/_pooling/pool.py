"""What the pixels of one material share, from what each tells alone."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from dbthermal.separation._subspace import reflection_ratio as direction
from dbthermal.separation._tiles import Array, Mask, Material, Survey

Labels = npt.NDArray[np.intp]

MOST: Final = 2048
"""Pixels of one material that are asked: more would not lower what is left of systematic error."""

# Deviations beyond which a pixel is not of the material, and rounds of leaving such ones out.
_OUTLIER_SIGMAS: Final = 4.0
_ROUNDS: Final = 3


@dataclass(frozen=True)
class Materials:
    """
    Ratios and emissivity of each material, and which pixels are of it.

    Attributes
    ----------
    label : ndarray of int, shape (pixel,)
        Material of each pixel; -1 for those that share nothing.
    ratio : ndarray, shape (band, material)
        Reflection ratios [1].
    inverse_energy : ndarray, shape (material,)
        Their variance, see `direction.Direction` [1/K^2].
    emissivity, noise_variance, drift_variance : ndarray, shape (material,)
        Emissivity of the first band and its variances, see `Material` [1].
    """

    label: Labels
    ratio: Array
    inverse_energy: Array
    emissivity: Array
    noise_variance: Array
    drift_variance: Array

    def shared(self, pixels: Labels) -> Material:
        """
        Spread the materials over some pixels.

        Parameters
        ----------
        pixels : ndarray of int
            Which pixels.

        Returns
        -------
        Material
            NaN for those that share nothing.
        """
        label = self.label[pixels]
        parts = (
            self.ratio,
            self.inverse_energy,
            self.emissivity,
            self.noise_variance,
            self.drift_variance,
        )
        return Material(*(np.where(label >= 0, part[..., label], np.nan) for part in parts))


def asked(labels: Labels) -> Mask:
    """
    Which pixels are asked for what they tell: all of a small material, some of a large one.

    Parameters
    ----------
    labels : ndarray of int, shape (pixel,)
        Material of each pixel, -1 for none.

    Returns
    -------
    ndarray of bool, shape (pixel,)
        True for at most `MOST` pixels of each material, spread evenly over it.
    """
    order = np.argsort(labels, kind="stable")
    of = labels[order]
    first = np.searchsorted(of, of)
    count = np.bincount(of[of >= 0], minlength=1)
    stride = np.maximum(1, -(-count // MOST))
    result = np.zeros(labels.shape, dtype=bool)
    result[order] = (of >= 0) & ((np.arange(of.size) - first) % stride[of] == 0)
    return result


def combine(labels: Labels, count: int, survey: Survey, noise: Array) -> Materials:
    r"""
    Ratios and emissivity of each material from its pixels.

    The scatters of the pixels are added, and their principal axis is the material's direction: the
    maximum of the likelihood, without the bias of a mean of ratios. The emissivity is the mean of
    the pixels' own, corrected to the common direction,
    :math:`e_1 - e_1 (1 - e_1) \, w \cdot \bar\kappa`, weighted by their variances. A pixel that
    differs from its material by more than four standard deviations is left out.

    Parameters
    ----------
    labels : ndarray of int, shape (pixel,)
        Material of each pixel that was asked, -1 for none.
    count : int
        Number of materials in the image; of some, no pixel may have been asked.
    survey : Survey
        These pixels.
    noise : ndarray, shape (band,)
        Noise of the bands [K].

    Returns
    -------
    Materials
        The materials; NaN for one of which no pixel tells anything.
    """
    label = labels
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        for _ in range(_ROUNDS):
            ratio, spread = _directions(label, count, survey, noise)
            label = np.where(_strange(label, ratio, survey, noise), -1, label)
        return Materials(labels, ratio, spread, *_emissivities(label, count, survey, ratio))


def joined(parts: list[Survey]) -> Survey:
    """
    Join the surveys of tiles.

    Parameters
    ----------
    parts : list of Survey
        In the order of the pixels.

    Returns
    -------
    Survey
        All pixels.
    """
    names = Survey.__dataclass_fields__
    return Survey(
        **{name: np.concatenate([getattr(part, name) for part in parts], axis=-1) for name in names}
    )


def _sum(label: Labels, values: Array, count: int) -> Array:
    """Sum of values (pixel) over each material."""
    known = label >= 0
    return np.asarray(np.bincount(label[known], values[known], count), dtype=np.float64)


def _directions(label: Labels, count: int, survey: Survey, noise: Array) -> tuple[Array, Array]:
    bands = range(len(noise))
    scatter = np.array([[_sum(label, survey.scatter[i, j], count) for j in bands] for i in bands])
    told = np.einsum("bbm->m", scatter) > 0
    scatter = np.where(told, scatter, np.eye(len(noise))[..., np.newaxis])
    ratio = direction.principal_ratio(np.moveaxis(scatter, -1, 0), noise)
    whitened = ratio / noise[:, np.newaxis]
    length = (whitened**2).sum(axis=0)
    energy = np.einsum("bm,bcm,cm->m", whitened, scatter, whitened) / length**2
    spread = direction.inverse_energy(energy, length, _sum(label, survey.frames, count))
    return np.where(told, ratio, np.nan), np.where(told, spread, np.nan)


def _strange(label: Labels, ratio: Array, survey: Survey, noise: Array) -> Array:
    """Where a pixel's own ratio is not that of its material."""
    whitened = survey.ratio / noise[:, np.newaxis]
    length = (whitened**2).sum(axis=0)
    energy = np.einsum("bp,bcp,cp->p", whitened, survey.scatter, whitened) / length**2
    spread = direction.inverse_energy(energy, length, survey.frames)
    deviation = np.sqrt(spread * (noise[1:, np.newaxis] ** 2 + (survey.ratio[1:] * noise[0]) ** 2))
    apart = np.abs(survey.ratio[1:] - ratio[1:, label]) > _OUTLIER_SIGMAS * deviation
    return np.asarray(np.any(apart, axis=0) & (survey.frames > 0) & (label >= 0))


def _emissivities(
    label: Labels, count: int, survey: Survey, ratio: Array
) -> tuple[Array, Array, Array]:
    off = (survey.null_weights * ratio[:, label]).sum(axis=0)
    value = survey.emissivity * (1.0 - (1.0 - survey.emissivity) * off)
    known = (label >= 0) & np.isfinite(value)
    where = np.where(known, label, -1)
    typical = np.median(survey.noise_variance[known]) if np.any(known) else np.nan
    weight = np.where(known, 1.0 / (survey.noise_variance + typical), 0.0)
    value, common = (np.where(known, part, 0.0) for part in (value, survey.drift_variance))
    total = _sum(where, weight, count)
    mean = _sum(where, weight * value, count) / total
    residual = np.where(known, (value - mean[where]) ** 2, 0.0)
    pixels = _sum(where, np.ones_like(value), count)
    scatter = _sum(where, weight**2 * residual, count) / total**2
    scatter *= pixels / np.maximum(pixels - 1, 1)
    stated = _sum(where, weight**2 * np.where(known, survey.noise_variance, 0.0), count) / total**2
    return mean, np.maximum(scatter, stated), _sum(where, weight * common, count) / total
