r"""Dual-wavelength pyrometry: the temperature of a gray body from the ratio of two radiances.

.. math:: R = \frac{L_1}{L_2} = \frac{e_1 B_1(T)}{e_2 B_2(T)} = \frac{B_1(T)}{B_2(T)}
          \quad\text{if}\quad e_1 = e_2

No background is reflected and the emissivity is the same in both bands: the two assumptions of the
method, see Araujo (2017), Meas. Sci. Technol. 28, 082002, doi:10.1088/1361-6501/aa7b4b. Near room
temperature neither holds, which is what this baseline shows. What it can do itself it does well:
bands of any width are inverted exactly, and the radiances are smoothed before their ratio is taken,
since 9.5 against 8-14 um changes by 0.16 % a kelvin only.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.interpolate import CubicSpline

from dbthermal import _smooth as smooth
from dbthermal import bands, planck
from dbthermal.response import Curve
from dbthermal.schema import Status
from dbthermal.separation._quality import status_bits
from dbthermal.separation._tiles import Array, Estimate, Method, Tile

KINDS: Final = ("wide", "narrow")
r"""Kinds of radiance: in the whole band, or spectral at the band's centre; both by Planck's law.

Usually the method is written with Wien's, which at 9.5 and 11 um is 3 K off near room temperature:
:math:`1/T = [\ln R - 5 \ln(\lambda_2/\lambda_1)] / [c_2 (1/\lambda_2 - 1/\lambda_1)]`."""

# Knots of the table of ln R, in which 1/T is nearly straight: the spline is within 1 uK.
_KNOTS: Final = 256

Inverse = Callable[[Array], Array]


@dataclass(frozen=True)
class RatioSettings:
    """
    Options of dual-wavelength pyrometry.

    Attributes
    ----------
    kind : {"wide", "narrow"}
        See `KINDS`. Both are exact for a blackbody; for a gray body "wide" is, and "narrow" only as
        far as a band is narrow.
    order : int or None
        The two radiances are smoothed by least squares with this many polynomials of time
        (`smooth.polynomial_basis`) before their ratio is taken; None leaves them as they are.
    """

    kind: str = "wide"
    order: int | None = 5

    def __post_init__(self) -> None:
        """Refuse kinds that do not exist, and orders that are none."""
        if self.kind not in KINDS:
            raise ValueError(
                f"Unknown kind '{self.kind}' of method 'ratio'. Must be one of {KINDS}."
            )
        if self.order is not None and not self.order >= 1:
            raise ValueError(f"Invalid order {self.order} of method 'ratio'. Must be at least 1.")


def separate(tile: Tile, settings: RatioSettings) -> Estimate:
    """
    Temperature of one tile as a gray body's before a background that emits nothing.

    Parameters
    ----------
    tile : Tile
        Signals of two bands of `bands.FILTERS`.
    settings : RatioSettings
        Kind of radiance, and smoothing.

    Returns
    -------
    Estimate
        Object temperature, NaN where no temperature in the response's range has the ratio, with the
        flag `outside_response`; emissivity, the same in both bands: radiance over that of a
        blackbody at this temperature, in the quieter band, mean over the frames that have one.
        Neither background nor deviations.

    Raises
    ------
    KeyError
        If a band is not one of `bands.FILTERS`.
    ValueError
        If the ratio of the radiances is not monotonic over the response's range, as for 8-14 and
        10.6 um, which is stationary near 33 C; or there are fewer frames than polynomials.
    """
    first, second = tile.curves
    inverse = _inverse((first, second), settings.kind)
    radiances = _radiances(tile, settings)
    with np.errstate(invalid="ignore", divide="ignore"):
        temperature = inverse(np.log(radiances[0] / radiances[1]))
    known = ~np.isnan(temperature)
    expected = _radiance(tile.curves[0], settings.kind, temperature)
    share = np.divide(radiances[0], expected, out=np.zeros_like(expected), where=known)
    frames = known.sum(axis=0)
    mean = np.full(frames.shape, np.nan)
    np.divide(share.sum(axis=0), frames, out=mean, where=frames > 0)
    unknown = np.full_like(temperature, np.nan)
    return Estimate(
        object_temperature=temperature,
        object_temperature_std=unknown,
        background_temperature=unknown.copy(),
        background_temperature_std=unknown.copy(),
        emissivity=np.stack([mean, mean]),
        emissivity_std=np.full((2, mean.size), np.nan),
        status=status_bits(
            {
                Status.OUTSIDE_RESPONSE: frames < temperature.shape[0],
                Status.NONPHYSICAL_EMISSIVITY: (mean <= 0) | (mean >= 1),
            }
        ),
    )


def _radiances(tile: Tile, settings: RatioSettings) -> Array:
    """Radiance of each band, (2, time, pixel), smoothed; NaN where there is none."""
    signals = tile.signals
    found = np.stack(
        [
            _radiance(curve, settings.kind, tile.temperature(band, signals[band]))
            for band, curve in enumerate(tile.curves)
        ]
    )
    if settings.order is None:
        return found
    functions = smooth.polynomial_basis(tile.time, settings.order)
    return np.asarray(functions @ (functions.T @ found))


def _radiance(curve: Curve, kind: str, temperature: Array) -> Array:
    """Radiance of a blackbody in a band; NaN where the temperature is no blackbody's."""
    band = bands.get(curve.band)
    lowest, highest = bands.TEMPERATURE_RANGE
    known = (temperature >= lowest) & (temperature <= highest)
    result = np.full_like(temperature, np.nan)
    if kind == "wide":
        result[known] = band.radiance(temperature[known])
    else:
        result[known] = planck.spectral_radiance(band.centre, temperature[known])
    return result


def _inverse(curves: tuple[Curve, Curve], kind: str) -> Inverse:
    """Temperature of the logarithm of the ratio, NaN outside the response's range."""
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


METHOD: Final = Method(
    separate,
    settings=RatioSettings,
    not_estimated=(
        "object_temperature_std",
        "background_temperature",
        "background_temperature_std",
        "emissivity_std",
    ),
)
"""Dual-wavelength pyrometry, for `solve`."""
