r"""Dual-wavelength pyrometry: the temperature of a gray body from the ratio of two radiances.

The background is neglected,

.. math:: R = \frac{L_1}{L_2} = \frac{e_1 B_1(T)}{e_2 B_2(T)} = \frac{B_1(T)}{B_2(T)}
          \quad\text{if}\quad e_1 = e_2 \qquad (1)

if no background is reflected and the emissivity is the same in both bands, see Araujo (2017), Meas.
Sci. Technol. 28, 082002, doi:10.1088/1361-6501/aa7b4b. Near room temperature neither holds. Bands
of any width are inverted exactly, and the radiances are smoothed before their ratio is taken, since
9.5 against 8-14 um changes by 0.16 % a kelvin only.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from scipy.interpolate import CubicSpline

from dbthermal import _smooth as smooth
from dbthermal import bands, planck
from dbthermal.response import Curve
from dbthermal.schema import Status
from dbthermal.separation import Method
from dbthermal.separation._inputs import check_fields
from dbthermal.separation._quality import status_bits
from dbthermal.separation._tiles import WITHOUT_BACKGROUND, Array, Estimate, Tile
from reproduction.methods.naive import require

KINDS: Final = ("wide", "narrow")
# Knots of the table of ln R, in which 1/T is nearly straight: the spline is within 1 uK.
_KNOTS: Final = 256


@dataclass(frozen=True)
class RatioSettings:
    r"""Options of dual-wavelength pyrometry.

    The radiance is that in the whole band ("wide"), or the spectral radiance at the band's centre;
    both by Planck's law, and exact for a blackbody; for a gray body "wide" is, and "narrow" only as
    far as a band is narrow. Wien's law, with which the method is usually written,
    :math:`1/T = [\ln R - 5 \ln(\lambda_2/\lambda_1)] / [c_2 (1/\lambda_2 - 1/\lambda_1)]`, is 3 K
    off at 9.5 and 11 um near room temperature.
    """

    kind: str = "wide"
    # Polynomials of time that both radiances are smoothed with, by least squares; None for none.
    order: int | None = 5

    def __post_init__(self) -> None:
        """Refuse unknown kinds and orders without a function."""
        check_fields(self, "ratio")
        if self.kind not in KINDS:
            rule = f"Must be one of {KINDS}"
            raise ValueError(f"Unknown kind '{self.kind}' of method 'ratio'. {rule}.")
        require(self, "ratio", "order", self.order is None or self.order >= 1, "be at least 1")


def separate(tile: Tile, settings: RatioSettings) -> Estimate:
    """Temperature of a gray body before a background that emits nothing.

    NaN where no temperature in the response's range has the ratio. The emissivity is the mean over
    time of the radiance over that of a blackbody at this temperature, in the quieter band.
    """
    first, second = tile.curves
    inverse = _inverse((first, second), settings.kind)
    temperatures = (tile.temperature(band, signal) for band, signal in enumerate(tile.signals))
    pairs = zip(tile.curves, temperatures, strict=True)
    radiances = np.stack([_radiance(curve, settings.kind, apparent) for curve, apparent in pairs])
    if settings.order is not None:
        functions = smooth.polynomial_basis(tile.time, settings.order)
        radiances = functions @ (functions.T @ radiances)
    with np.errstate(invalid="ignore", divide="ignore"):
        temperature = inverse(np.log(radiances[0] / radiances[1]))
    # e = L_1 / B_1(T)
    valid = ~np.isnan(temperature)
    blackbody = _radiance(first, settings.kind, temperature)
    emissivity = np.divide(radiances[0], blackbody, out=np.zeros_like(blackbody), where=valid)
    frames = valid.sum(axis=0)
    mean = np.full(frames.shape, np.nan)
    np.divide(emissivity.sum(axis=0), frames, out=mean, where=frames > 0)
    odd = (mean <= 0) | (mean >= 1)
    bits = {Status.OUTSIDE_RESPONSE: frames < len(valid), Status.NONPHYSICAL_EMISSIVITY: odd}
    both = np.stack([mean, mean])
    estimate = Estimate.without_std(tile, temperature, status_bits(bits), both)
    return estimate.check_range(first, not_estimated=WITHOUT_BACKGROUND)


def _radiance(curve: Curve, kind: str, temperature: Array) -> Array:
    """Radiance of a blackbody in a band; NaN where the temperature is no blackbody's."""
    band = bands.get(curve.band)
    lowest, highest = bands.TEMPERATURE_RANGE
    valid = (temperature >= lowest) & (temperature <= highest)
    law = band.radiance if kind == "wide" else partial(planck.spectral_radiance, band.centre)
    result = np.full_like(temperature, np.nan)
    result[valid] = law(temperature[valid])
    return result


def _inverse(curves: tuple[Curve, Curve], kind: str) -> Callable[[Array], Array]:
    """Inverse of equation (1): temperature of ln R, NaN outside the response's range."""
    grid = np.linspace(1.0 / curves[0].lowest, 1.0 / curves[0].highest, _KNOTS)
    first, second = (_radiance(curve, kind, 1.0 / grid) for curve in curves)
    logarithm = np.log(first / second)
    steps = np.diff(logarithm)
    if not (np.all(steps > 0) or np.all(steps < 0)):
        turn = int(np.argmax(np.sign(steps) != np.sign(steps[0])))
        raise ValueError(
            f"Invalid bands '{curves[0].band}', '{curves[1].band}' of method 'ratio': the ratio of "
            f"their radiances is stationary near {1.0 / grid[turn]:.1f} K. Must be monotonic over "
            f"the response's range [{curves[0].lowest}, {curves[0].highest}] K."
        )
    order = np.argsort(logarithm)
    spline = CubicSpline(logarithm[order], grid[order], extrapolate=False)
    return lambda value: np.asarray(1.0 / spline(value))


METHOD: Final = Method(separate, RatioSettings, "ratio", not_estimated=WITHOUT_BACKGROUND)
"""Dual-wavelength pyrometry, for `solve`."""
