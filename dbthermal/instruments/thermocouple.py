"""Type-T thermocouples (copper, constantan) on the ITS-90: voltage <-> temperature.

A thermocouple gives the difference of the voltages of its tip and of the terminals to which it is
connected, the cold junction. Both follow the same reference function E(t), so that

    E(tip) = voltage at the terminals + E(cold junction).

NIST defines E(t), and gives an approximate inverse that is off by up to 0.04 K: it starts a Newton
iteration on the definition, so that the two functions are inverses of one another to within
rounding. A real thermocouple follows the tables to 0.5 K, if it is of the better class of type T.
"""

from typing import Final

import numpy as np
import numpy.typing as npt
from numpy.polynomial.polynomial import polyder, polyval
from scipy.constants import zero_Celsius

from dbthermal._arrays import Array

__all__ = ["EMF", "TEMPERATURE", "emf", "temperature"]
__dir__ = __all__.copy

Coefficients = npt.NDArray[np.floating] | tuple[float, ...]

TEMPERATURE: Final = (3.15, 673.15)
"""Range of `emf` [K]: -270 to 400 °C."""

EMF: Final = (-5.603, 20.872)
"""Range of `temperature` [mV], against a cold junction at 0 °C: -200 to 400 °C."""

# Coefficients c_i of E = sum c_i t^i [mV °C^-i] below and above 0 °C, and of the approximate
# inverses t = sum d_i E^i [°C mV^-i]; see the references of `emf`.
_FORWARD_BELOW = (
    *(0.0, 0.387481063640e-01, 0.441944343470e-04, 0.118443231050e-06, 0.200329735540e-07),
    *(0.901380195590e-09, 0.226511565930e-10, 0.360711542050e-12, 0.384939398830e-14),
    *(0.282135219250e-16, 0.142515947790e-18, 0.487686622860e-21, 0.107955392700e-23),
    *(0.139450270620e-26, 0.797951539270e-30),
)
_FORWARD_ABOVE = (
    *(0.0, 0.387481063640e-01, 0.332922278800e-04, 0.206182434040e-06, -0.218822568460e-08),
    *(0.109968809280e-10, -0.308157587720e-13, 0.454791352900e-16, -0.275129016730e-19),
)
_INVERSE_BELOW = (
    *(0.0, 2.5949192e1, -2.1316967e-1, 7.9018692e-1, 4.2527777e-1, 1.3304473e-1),
    *(2.0241446e-2, 1.2668171e-3),
)
_INVERSE_ABOVE = (
    *(0.0, 2.592800e1, -7.602961e-1, 4.637791e-2, -2.165394e-3, 6.048144e-5, -7.293422e-7),
)

# The start is off by 0.04 K; Newton squares that, times E'' / 2 E', below 0.01 /K: two are enough.
_STEPS = 3


def emf(temperature: npt.ArrayLike) -> Array:
    r"""Voltage [mV] of a type-T thermocouple whose terminals are at 0 °C, by the ITS-90 [1]_ [2]_.

    .. math:: E = \sum_i c_i t^i, \quad t = T - 273.15\,\mathrm{K}

    Of temperatures T of the tip [K], an array of any shape, in 3.15 to 673.15. ValueError if one
    lies outside or is NaN; it names the first.

    References
    ----------
    .. [1] NIST ITS-90 Thermocouple Database, SRD 60, doi:10.18434/T4S888
    .. [2] Burns, Scroger, Strouse, Croarkin, Guthrie (1993), NIST Monograph 175,
       doi:10.6028/NIST.MONO.175

    Examples
    --------
    >>> emf([273.15, 373.15]).round(3).tolist()  # mV
    [0.0, 4.279]
    """
    return _emf(_inside("temperature", temperature, TEMPERATURE, "K") - zero_Celsius)


def temperature(emf_mV: npt.ArrayLike, junction_temperature: npt.ArrayLike) -> Array:  # noqa: N803
    """Temperature [K] of the tip from the voltage at the terminals: the exact inverse of `emf`.

    Of the voltage [mV] and the temperature of the terminals, the cold junction [K], arrays that are
    broadcast against one another. The range ends at 20.872 mV, as NIST's does, which is 400 °C
    rounded up: there the result is 673.1505 K. ValueError if a cold junction lies outside 3.15 to
    673.15 K, or a voltage, referred to 0 °C, outside -5.603 to 20.872 mV, or one of them is NaN.

    Examples
    --------
    A meter reads 4.279 mV, and its terminals are at 25 °C; the tip is at 120.88 °C.

    >>> f"{float(temperature(4.279, 298.15)) - 273.15:.3f}"
    '120.882'
    """
    voltage = np.asarray(emf_mV, dtype=np.float64) + emf(junction_temperature)
    voltage = _inside("voltage, referred to 0 °C,", voltage, EMF, "mV")
    celsius = _piecewise(voltage, _INVERSE_BELOW, _INVERSE_ABOVE)
    for _ in range(_STEPS):
        slope = _piecewise(celsius, polyder(_FORWARD_BELOW), polyder(_FORWARD_ABOVE))
        celsius = celsius - (_emf(celsius) - voltage) / slope
    return np.asarray(celsius + zero_Celsius)


def _emf(celsius: Array) -> Array:
    """Reference function: voltage [mV] at a temperature [°C]."""
    return _piecewise(celsius, _FORWARD_BELOW, _FORWARD_ABOVE)


def _piecewise(argument: Array, below: Coefficients, above: Coefficients) -> Array:
    """Polynomial with one set of coefficients below zero and another above."""
    return np.asarray(np.where(argument < 0.0, polyval(argument, below), polyval(argument, above)))


def _inside(name: str, value: npt.ArrayLike, limits: tuple[float, float], unit: str) -> Array:
    """Values as float64, if all lie within the limits."""
    values = np.asarray(value, dtype=np.float64)
    outside = ~((values >= limits[0]) & (values <= limits[1]))  # True for NaN
    if np.any(outside):
        raise ValueError(
            f"Invalid {name} {values[outside].flat[0]} {unit} of a type-T thermocouple. "
            f"Must lie in {limits[0]} to {limits[1]} {unit}."
        )
    return values
