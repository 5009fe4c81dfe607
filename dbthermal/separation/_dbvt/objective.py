r"""The paper's objective: five losses of one pixel's smooth signal, noise and emissivities.

Narayanan et al. (2026), doi:10.48550/arXiv.2509.11334, algorithm 1, with its slips put right:
the reconstruction starts from the second band's smooth signal (the paper prints the first's), the
mean of the noise enters by its square (the paper prints a signed mean, which has no lower bound),
and a signal is never divided by less than its noise. Signals are linearised, so that both slopes
a_m are 1. Sums over time are means, so that no weight depends on the number of frames.
"""

from dataclasses import dataclass, fields
from typing import Self

import torch
from torch import Tensor

from dbthermal.separation._dbvt import DbvtSettings


@dataclass(frozen=True)
class Columns:
    """Record of tensors whose last axis is the column: the pixel, or the start and pixel."""

    def select(self, columns: Tensor) -> Self:
        """The same for some columns, by number or mask."""
        return type(self)(*(getattr(self, field.name)[..., columns] for field in fields(self)))

    def put(self, columns: Tensor, part: Self) -> Self:
        """The same with some columns, by number, replaced by those of a part."""
        values = []
        for field in fields(self):
            value = getattr(self, field.name).clone()
            value[..., columns] = getattr(part, field.name)
            values.append(value)
        return type(self)(*values)


@dataclass(frozen=True)
class Unknowns(Columns):
    """Unknowns of the objective."""

    smooth: Tensor  # smooth signal of the first band (time, column) [K]
    offset: Tensor  # first value of the second band's smooth signal (column,) [K]
    emissivity: Tensor  # (2, column) [1]
    noise: Tensor  # of both bands (2, time, column) [K]


@dataclass(frozen=True)
class Images(Columns):
    """Signals of both bands, the quieter first, and the scales of the objective."""

    signals: Tensor  # linearised (2, time, column) [K]
    deviation: Tensor  # by which the signals are normalised (2, column) [K]
    sigma: Tensor  # standard deviation of the noise (2, column) [K]
    interval: Tensor  # of the frames (column,) [s]
    share: Tensor  # of the reconstruction's weight that counts (column,) [1]


def ratios(emissivity: Tensor) -> tuple[Tensor, Tensor]:
    r"""Emission and reflection ratio, :math:`k_1 = e_2 / e_1, k_2 = (1-e_2) / (1-e_1)`."""
    first, second = emissivity
    return second / first, (1.0 - second) / (1.0 - first)


def second_smooth(unknowns: Unknowns) -> Tensor:
    r"""Smooth signal of the second band (time, column) [K].

    .. math:: \tilde I_2(t) = \tilde I_2(t-1) + k_1 [\tilde I_1(t) - \tilde I_1(t-1)]
              = \tilde I_2(0) + k_1 [\tilde I_1(t) - \tilde I_1(0)] \qquad (1)
    """
    emission, _ = ratios(unknowns.emissivity)
    return unknowns.offset + emission * (unknowns.smooth - unknowns.smooth[0])


def deviation(signals: Tensor, noise: Tensor, sigma: Tensor, floor: float) -> Tensor:
    r"""Standard deviation over time (2, column) [K] of the corrected signals, at least the noise.

    The corrected signal is :math:`\ddot I_m = I_m - n_m`; the mean drops out of a comparison.
    """
    return torch.maximum((signals - noise).std(dim=1), floor * sigma)


def departures(unknowns: Unknowns, images: Images) -> tuple[Tensor, Tensor, Tensor]:
    r"""Departures from the smooth signals, and the error of the reconstruction, (time, column) [K].

    .. math:: p_m = \ddot I_m - \tilde I_m, \quad
              \hat I_2 = \tilde I_2 + k_2 (\ddot I_1 - \tilde I_1), \quad
              r = \ddot I_2 - \hat I_2 = p_2 - k_2 p_1 \qquad (2)
    """
    first = images.signals[0] - unknowns.noise[0] - unknowns.smooth
    second = images.signals[1] - unknowns.noise[1] - second_smooth(unknowns)
    return first, second, second - ratios(unknowns.emissivity)[1] * first


def losses(unknowns: Unknowns, images: Images, settings: DbvtSettings) -> dict[str, Tensor]:
    """Weighted losses (column,) [1] by their names; their sum is the objective."""
    emission, _ = ratios(unknowns.emissivity)
    first, second, error = departures(unknowns, images)
    frames = unknowns.smooth.shape[0]
    # gamma_1 (1 + k_1^2) mean (I1~'' / curvature)^2, for the second smooth signal bends k_1 times.
    bend = torch.diff(unknowns.smooth, n=2, dim=0) / (settings.curvature * images.interval**2)
    smoothness = settings.smoothness * (1 + emission**2) * (bend**2).sum(dim=0) / frames
    # gamma_2 mean H(p_m / deviation_m)
    threshold = settings.huber_threshold * images.sigma / images.deviation
    huber = [
        _huber(part / images.deviation[band], threshold[band]).mean(dim=0)
        for band, part in enumerate((first, second))
    ]
    # gamma_3 mean (r / sigma_2)^2
    share = settings.reconstruction * images.share
    # gamma_4 mean (n_m / sigma_m)^2 and gamma_5 (mean n_m / sigma_m)^2
    relative = unknowns.noise / images.sigma[:, None]
    return {
        "smoothness": smoothness,
        "huber": settings.huber * (huber[0] + huber[1]),
        "reconstruction": share * ((error / images.sigma[1]) ** 2).mean(dim=0),
        "noise": settings.noise * (relative**2).mean(dim=1).sum(dim=0),
        "noise_mean": settings.noise_mean * (relative.mean(dim=1) ** 2).sum(dim=0),
    }


def total(unknowns: Unknowns, images: Images, settings: DbvtSettings) -> Tensor:
    """The objective (column,) [1]."""
    return torch.stack(list(losses(unknowns, images, settings).values())).sum(dim=0)


def _huber(value: Tensor, threshold: Tensor) -> Tensor:
    """Huber's loss (1964), doi:10.1214/aoms/1177703732, over its threshold."""
    size = value.abs()
    return torch.where(size <= threshold, value**2 / (2 * threshold), size - threshold / 2)
