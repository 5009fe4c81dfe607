"""Planck's law: spectral radiance of a blackbody, its derivative and its exact inverse.

All functions take wavelength in metres and temperature in kelvin, broadcast, and work in SI
units. The constants are the exact ones of the 2019 SI, from `scipy.constants`.
"""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy import constants

from dbthermal._arrays import Array
from dbthermal._numbers import POSITIVE, WAVELENGTH, real_numbers

__all__ = [
    "FIRST_RADIATION_CONSTANT",
    "SECOND_RADIATION_CONSTANT",
    "brightness_temperature",
    "spectral_radiance",
    "spectral_radiance_slope",
]
__dir__ = __all__.copy

FIRST_RADIATION_CONSTANT: float = 2.0 * constants.h * constants.c**2
"""2 h c^2, first radiation constant for radiance [W m^2 sr^-1]."""

SECOND_RADIATION_CONSTANT: float = constants.h * constants.c / constants.k
"""h c / k, second radiation constant [m K]."""

Spectral = Callable[[npt.ArrayLike, npt.ArrayLike], Array]


def spectral_radiance(wavelength: npt.ArrayLike, temperature: npt.ArrayLike) -> Array:
    r"""Spectral radiance of a blackbody [W m^-2 sr^-1 m^-1].

    .. math:: L(\lambda, T) = \frac{2 h c^2}{\lambda^5 (\exp(c_2 / \lambda T) - 1)}

    The first equation of the paper (doi:10.48550/arXiv.2509.11334) has the factor :math:`\lambda^5`
    and the :math:`-1` on one level of the denominator; this is the law as Planck gave it.

    ValueError if a wavelength or a temperature is not finite and positive, a wavelength beyond
    0.3 m, or a DataArray of another unit; TypeError if it is no real number.

    Parameters
    ----------
    wavelength, temperature : array_like
        Wavelength [m] and temperature [K], broadcast against one another.

    Examples
    --------
    Temperature of a surface of emissivity 0.9 at 300 K that reflects nothing.

    >>> radiance = spectral_radiance(10e-6, 300.0)
    >>> round(float(radiance) * 1e-6, 3)  # [W m^-2 sr^-1 um^-1]
    9.924
    >>> round(float(brightness_temperature(10e-6, 0.9 * radiance)), 1)  # [K]
    293.6
    """
    wavelength = real_numbers("wavelength [m]", wavelength, WAVELENGTH)
    temperature = real_numbers("temperature [K]", temperature, POSITIVE)
    exponent = SECOND_RADIATION_CONSTANT / (wavelength * temperature)
    # exp(-x) / (1 - exp(-x)) in place of 1 / (exp(x) - 1): no overflow on the Wien side.
    factor = FIRST_RADIATION_CONSTANT / wavelength**5
    return np.asarray(factor * np.exp(-exponent) / -np.expm1(-exponent))


def spectral_radiance_slope(wavelength: npt.ArrayLike, temperature: npt.ArrayLike) -> Array:
    r"""Derivative [W m^-2 sr^-1 m^-1 K^-1] of the blackbody's spectral radiance with temperature.

    .. math:: \frac{\partial L}{\partial T} = L \, \frac{x}{T (1 - e^{-x})}, \quad
              x = c_2 / \lambda T

    Errors as `spectral_radiance`.

    Parameters
    ----------
    wavelength, temperature : array_like
        Wavelength [m] and temperature [K].
    """
    radiance = spectral_radiance(wavelength, temperature)
    temperature = np.asarray(temperature, dtype=np.float64)
    exponent = SECOND_RADIATION_CONSTANT / (np.asarray(wavelength) * temperature)
    return np.asarray(radiance * exponent / (temperature * -np.expm1(-exponent)))


def brightness_temperature(wavelength: npt.ArrayLike, radiance: npt.ArrayLike) -> Array:
    r"""Temperature [K] of the blackbody of a spectral radiance, the exact inverse of Planck's law.

    .. math:: T = \frac{c_2}{\lambda \ln(1 + 2 h c^2 / \lambda^5 L)}

    Errors as `spectral_radiance`.

    Parameters
    ----------
    wavelength, radiance : array_like
        Wavelength [m] and spectral radiance [W m^-2 sr^-1 m^-1].

    See the example of `spectral_radiance`.
    """
    wavelength = real_numbers("wavelength [m]", wavelength, WAVELENGTH)
    radiance = real_numbers("spectral radiance [W m^-2 sr^-1 m^-1]", radiance, POSITIVE)
    ratio = FIRST_RADIATION_CONSTANT / (wavelength**5 * radiance)
    return np.asarray(SECOND_RADIATION_CONSTANT / (wavelength * np.log1p(ratio)))
