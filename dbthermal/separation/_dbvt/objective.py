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

from dbthermal import planck


@dataclass(frozen=True)
class Weights:
    r"""
    Weights and scales of the losses; none of them is published.

    The scales are the noise's wherever they can be, so that one set serves at every noise level. A
    weight of 0 leaves a loss out.

    Attributes
    ----------
    smoothness : float
        :math:`\gamma_1`, of the squared second differences in units of `curvature` [1].
    huber : float
        :math:`\gamma_2`, of the Huber loss, which is divided by its threshold: beyond it the slope
        is 1, whatever the threshold [1].
    reconstruction : float
        :math:`\gamma_3`, of the squared reconstruction error in units of the second band's noise
        [1]: the normalised error, its weight set by the signal-to-noise ratio.
    noise : float
        :math:`\gamma_4`, of the noise's square in units of each band's own noise [1]. With 0 no
        noise is modelled: it is held at zero, and its mean with it.
    noise_mean : float
        :math:`\gamma_5`, of the square of the noise's mean over time, in the same units [1].
    curvature : float
        Second derivative of a smooth signal that costs 1 [K/s^2].
    huber_threshold : float
        Where the Huber loss turns from square to linear, in units of each band's noise [1].
    deviation_floor : float
        Least deviation by which a signal is divided, in units of its noise [1].
    """

    smoothness: float = 1.0
    huber: float = 0.5
    reconstruction: float = 10.0
    noise: float = 1.0
    noise_mean: float = 1.0
    curvature: float = 0.5
    huber_threshold: float = 1.0
    deviation_floor: float = 1.0

    def __post_init__(self) -> None:
        """Refuse negative weights, and scales that are none."""
        for name in ("smoothness", "huber", "reconstruction", "noise", "noise_mean"):
            value = getattr(self, name)
            if not 0 <= value < float("inf"):
                raise ValueError(f"Invalid {name} {value} of method 'dbvt'. Must be at least 0.")
        for name in ("curvature", "huber_threshold", "deviation_floor"):
            planck.require_positive(f"{name} of method 'dbvt'", getattr(self, name))


@dataclass(frozen=True)
class Columned:
    """A record of tensors whose last axis is the pixel, or the pixel and start: the column."""

    def taken(self, columns: Tensor) -> Self:
        """
        Some of the columns.

        Parameters
        ----------
        columns : Tensor
            Their numbers, or a mask.

        Returns
        -------
        Columned
            The same record of these columns.
        """
        return type(self)(*(getattr(self, field.name)[..., columns] for field in fields(self)))

    def put(self, columns: Tensor, part: Self) -> Self:
        """
        Replace some columns.

        Parameters
        ----------
        columns : Tensor
            Their numbers.
        part : Columned
            What they become, in their order.

        Returns
        -------
        Columned
            The whole with the part put in.
        """
        values = []
        for field in fields(self):
            value = getattr(self, field.name).clone()
            value[..., columns] = getattr(part, field.name)
            values.append(value)
        return type(self)(*values)

    def chosen(self, other: Self, where: Tensor) -> Self:
        """
        Some columns of this record, the others of another.

        Parameters
        ----------
        other : Columned
            The other record, of the same shapes.
        where : Tensor of bool, shape (column,)
            Which columns are this record's.

        Returns
        -------
        Columned
            The mixture.
        """
        names = [field.name for field in fields(self)]
        pairs = [(getattr(self, name), getattr(other, name)) for name in names]
        return type(self)(*(torch.where(where, mine, theirs) for mine, theirs in pairs))


@dataclass(frozen=True)
class Unknowns(Columned):
    """
    What the objective is minimised over.

    Attributes
    ----------
    smooth : Tensor, shape (time, column)
        Smooth signal of the first band [K].
    offset : Tensor, shape (column,)
        First value of the second band's smooth signal [K].
    emissivity : Tensor, shape (2, column)
        Emissivities [1].
    noise : Tensor, shape (2, time, column)
        Noise of both bands [K].
    """

    smooth: Tensor
    offset: Tensor
    emissivity: Tensor
    noise: Tensor


@dataclass(frozen=True)
class Images(Columned):
    """
    What the objective is given.

    Attributes
    ----------
    signals : Tensor, shape (2, time, column)
        Linearised signals of the quieter and the other band [K].
    deviation : Tensor, shape (2, column)
        Standard deviation by which the signals are normalised, see `deviation` [K].
    sigma : Tensor, shape (2, column)
        Standard deviation of the noise [K].
    interval : Tensor, shape (column,)
        Time from frame to frame [s].
    share : Tensor, shape (column,)
        Share of the reconstruction's weight that counts [1].
    """

    signals: Tensor
    deviation: Tensor
    sigma: Tensor
    interval: Tensor
    share: Tensor


def ratios(emissivity: Tensor) -> tuple[Tensor, Tensor]:
    r"""
    Emission and reflection ratio, :math:`k_1 = e_2 / e_1` and :math:`k_2 = (1-e_2) / (1-e_1)`.

    Parameters
    ----------
    emissivity : Tensor, shape (2, column)
        Emissivities [1].

    Returns
    -------
    tuple of Tensor
        k1 and k2 [1].
    """
    first, second = emissivity
    return second / first, (1.0 - second) / (1.0 - first)


def second_smooth(unknowns: Unknowns) -> Tensor:
    r"""
    Smooth signal of the second band.

    .. math:: \tilde I_2(t) = \tilde I_2(t-1) + k_1 [\tilde I_1(t) - \tilde I_1(t-1)]
              = \tilde I_2(0) + k_1 [\tilde I_1(t) - \tilde I_1(0)]

    Parameters
    ----------
    unknowns : Unknowns
        Smooth signal of the first band, offset, emissivities.

    Returns
    -------
    Tensor, shape (time, column)
        Signal [K].
    """
    emission, _ = ratios(unknowns.emissivity)
    return unknowns.offset + emission * (unknowns.smooth - unknowns.smooth[0])


def deviation(signals: Tensor, noise: Tensor, sigma: Tensor, floor: float) -> Tensor:
    r"""
    Standard deviation over time of the noise-corrected signals :math:`\ddot I_m`, at least noise.

    Both sides of a comparison are normalised alike, so that the mean drops out.

    Parameters
    ----------
    signals, noise : Tensor, shape (2, time, column)
        Signals and estimated noise [K].
    sigma : Tensor, shape (2, column)
        Standard deviation of the noise [K].
    floor : float
        Least deviation in units of it [1].

    Returns
    -------
    Tensor, shape (2, column)
        Deviation [K].
    """
    return torch.maximum((signals - noise).std(dim=1), floor * sigma)


def departures(unknowns: Unknowns, images: Images) -> tuple[Tensor, Tensor, Tensor]:
    r"""
    Departures from the smooth signals, and the error of the reconstruction.

    .. math:: p_m = \ddot I_m - \tilde I_m, \quad
              \hat I_2 = \tilde I_2 + k_2 (\ddot I_1 - \tilde I_1), \quad
              r = \ddot I_2 - \hat I_2 = p_2 - k_2 p_1

    Parameters
    ----------
    unknowns, images
        See there.

    Returns
    -------
    tuple of Tensor, shape (time, column)
        p1, p2 and r [K].
    """
    first = images.signals[0] - unknowns.noise[0] - unknowns.smooth
    second = images.signals[1] - unknowns.noise[1] - second_smooth(unknowns)
    return first, second, second - ratios(unknowns.emissivity)[1] * first


def losses(unknowns: Unknowns, images: Images, weights: Weights) -> dict[str, Tensor]:
    r"""
    The weighted losses.

    Parameters
    ----------
    unknowns, images, weights
        See there.

    Returns
    -------
    dict of Tensor, shape (column,)
        `smoothness` of both bands, `huber` of both, `reconstruction` of the second, `noise` and
        `noise_mean` of both [1]; their sum is the objective.
    """
    emission, _ = ratios(unknowns.emissivity)
    first, second, rest = departures(unknowns, images)
    bend = torch.diff(unknowns.smooth, n=2, dim=0) / (weights.curvature * images.interval**2)
    frames = unknowns.smooth.shape[0]
    relative = unknowns.noise / images.sigma[:, None]
    threshold = weights.huber_threshold * images.sigma / images.deviation
    far = [
        _huber(part / images.deviation[band], threshold[band]).mean(dim=0)
        for band, part in enumerate((first, second))
    ]
    share = weights.reconstruction * images.share
    return {
        "smoothness": weights.smoothness * (1 + emission**2) * (bend**2).sum(dim=0) / frames,
        "huber": weights.huber * (far[0] + far[1]),
        "reconstruction": share * ((rest / images.sigma[1]) ** 2).mean(dim=0),
        "noise": weights.noise * (relative**2).mean(dim=1).sum(dim=0),
        "noise_mean": weights.noise_mean * (relative.mean(dim=1) ** 2).sum(dim=0),
    }


def _huber(value: Tensor, threshold: Tensor) -> Tensor:
    """Huber's loss (1964), doi:10.1214/aoms/1177703732, over its threshold."""
    size = value.abs()
    return torch.where(size <= threshold, value**2 / (2 * threshold), size - threshold / 2)
