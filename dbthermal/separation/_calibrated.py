r"""Separation with known emissivities: as many equations as bands, in two temperatures, per frame.

.. math:: z_m = e_m u_m(x) + (1 - e_m) u_m(y) \qquad (1)

is solved for x and y by Newton's method from the linear closed form of Narayanan et al. (2026),
equation 12, doi:10.48550/arXiv.2509.11334, all bands weighted by their noise, see
`_frames`. Each frame stands alone; then the object is smoothed over as many frames as its
own curve allows. Errors of the emissivities are not lessened by that. For two bands and slopes 1,
the noise of a frame is

.. math:: \mathrm{var}(x) = [(1-e_2)^2 s_1^2 + (1-e_1)^2 s_2^2] / (e_1-e_2)^2, \quad
          \mathrm{var}(y) = [e_2^2 s_1^2 + e_1^2 s_2^2] / (e_1-e_2)^2 \qquad (2)
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from dbthermal.schema import Status
from dbthermal.separation import _frames as frames
from dbthermal.separation import _windows as windows
from dbthermal.separation._inputs import Method, check_fields
from dbthermal.separation._quality import status_bits
from dbthermal.separation._tiles import Array, Estimate, Mask, Tile

# Bands that differ by less are gray, by so many standard deviations or by rounding.
_GRAY_SIGMAS: Final = 4.0
_LEAST_DIFFERENCE: Final = 1e-6
# Variance about the reference of a background that may have any temperature [K^2].
_PRIOR_VARIANCE: Final = 1e12


@dataclass(frozen=True)
class CalibratedSettings:
    """Options of the method "calibrated".

    Attributes
    ----------
    smooth : bool
        Smooth the object over as many frames as its curve allows; if not, each frame stands alone.
    """

    smooth: bool = True

    def __post_init__(self) -> None:
        check_fields(self, "calibrated")


def separate(tile: Tile, settings: CalibratedSettings) -> Estimate:
    """Temperatures with their standard deviations, at the known emissivities (band, pixel)."""
    e, covariance = tile.emissivity, tile.emissivity_covariance
    assert e is not None
    if covariance is None:
        covariance = np.zeros((len(e), *e.shape))
    level = np.zeros(e.shape[1])
    # Solve every frame, and smooth the object.
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        shared = np.pad(covariance, ((0, 1), (0, 1), (0, 0)))  # the level is of no weight
        solution = frames.solve(tile, e, level, np.full_like(level, _PRIOR_VARIANCE), shared)
        solved = np.isfinite(solution.signal)
        signal, var = solution.signal, solution.white
        if settings.smooth and len(signal) > 1:
            signal, var = windows.smooth(signal, var, solved, tile.time)
        var = var + solution.shared
        values = list[Array]()
        for mean, variance in ((signal, var), (solution.background, solution.background_variance)):
            values += frames.temperatures(tile, np.where(solved, mean, np.nan), variance)
        gray = _gray(e, covariance)
    # Flag gray pixels, and those without a solution.
    solved &= np.all(np.isfinite(values), axis=0)
    lost = ~np.all(solved, axis=0) & ~gray
    values = [np.where(solved & ~gray, value, np.nan) for value in values]
    status = status_bits({Status.GRAY: gray, Status.OUTSIDE_RESPONSE: lost})
    std = np.sqrt(np.einsum("bbp->bp", covariance))
    warm, warm_std, cold, cold_std = values
    estimate = Estimate(warm, warm_std, cold, cold_std, e, std, status)
    return estimate.check_range(tile.curves[0])


def _gray(emissivity: Array, covariance: Array) -> Mask:
    """Pixels (pixel) of which no band differs for certain from the first."""
    dark = 1.0 - emissivity
    # At a ratio (1 - e_m) / (1 - e_1) of 1 the system is singular; the ratio's error counts.
    ratio = dark / dark[0]
    squares = np.einsum("bbp->bp", covariance)
    variance = squares + ratio**2 * squares[0] - 2.0 * ratio * covariance[0]
    std = np.sqrt(np.maximum(variance, 0.0)) / dark[0]
    threshold = np.maximum(_LEAST_DIFFERENCE / dark[0], _GRAY_SIGMAS * std)
    return np.asarray(np.all(np.abs(ratio - 1.0) <= threshold, axis=0))


METHOD: Final = Method(separate, settings=CalibratedSettings, knows_emissivity=True, any_bands=True)
"""The closed form for known emissivities, for `solve`."""
