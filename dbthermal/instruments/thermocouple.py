"""Type-T thermocouples (copper, constantan) on the ITS-90: voltage <-> temperature.

A thermocouple gives the difference of two voltages: that of its tip, and that of the terminals to
which it is connected, the cold junction. Both belong to the same function E(t), so that

    E(tip) = voltage at the terminals + E(cold junction).

NIST gives E(t) as a definition, and beside it an inverse that is an approximation: it is off by up
to 0.04 K. Here the inverse is the start of a Newton iteration on the definition, and what is left
is rounding, so that the two functions are inverses of one another.

The coefficients and the tables are public data of NIST; no thermocouple follows them better than
its tolerance (0.5 K for the better class of type T), and what a calibration has to reckon with is
that tolerance, not the arithmetic.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.constants import zero_Celsius

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Piece:
    """
    A reference function of one kind of thermocouple and its approximate inverse, on one range.

    Attributes
    ----------
    forward : tuple of float
        Coefficients c_i of E = sum c_i t^i [mV °C^-i].
    inverse : tuple of float
        Coefficients d_i of t = sum d_i E^i [°C mV^-i].
    """

    forward: tuple[float, ...]
    inverse: tuple[float, ...]


@dataclass(frozen=True)
class Range:
    """
    Limits of a function's argument, ends included.

    Attributes
    ----------
    lowest, highest : float
        Ends [K] or [mV].
    unit : str
        Their unit.
    """

    lowest: float
    highest: float
    unit: str

    def holds(self, value: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """
        Tell which values lie in the range.

        Parameters
        ----------
        value : array_like
            The values, in the range's unit.

        Returns
        -------
        ndarray of bool
            False for NaN too.
        """
        values = np.asarray(value, dtype=np.float64)
        return np.asarray((values >= self.lowest) & (values <= self.highest))

    def require(self, what: str, value: npt.ArrayLike) -> Array:
        """
        Return values that all lie in the range.

        Parameters
        ----------
        what : str
            What they are, for the error.
        value : array_like
            The values, in the range's unit.

        Returns
        -------
        ndarray
            The values as float64, same shape.

        Raises
        ------
        ValueError
            If one lies outside or is NaN; the error names the first.
        """
        values = np.asarray(value, dtype=np.float64)
        bad = ~self.holds(values)
        if np.any(bad):
            raise ValueError(
                f"Invalid {what} {values[bad].flat[0]} {self.unit} of a type-T thermocouple. "
                f"Must lie in {self.lowest} to {self.highest} {self.unit}."
            )
        return values


# Type T of NIST Standard Reference Database 60, doi:10.18434/T4S888; Burns et al. (1993), NIST
# Monograph 175, doi:10.6028/NIST.MONO.175.
BELOW: Final = Piece(
    forward=(
        *(0.0, 0.387481063640e-01, 0.441944343470e-04, 0.118443231050e-06, 0.200329735540e-07),
        *(0.901380195590e-09, 0.226511565930e-10, 0.360711542050e-12, 0.384939398830e-14),
        *(0.282135219250e-16, 0.142515947790e-18, 0.487686622860e-21, 0.107955392700e-23),
        *(0.139450270620e-26, 0.797951539270e-30),
    ),
    inverse=(
        *(0.0, 2.5949192e1, -2.1316967e-1, 7.9018692e-1, 4.2527777e-1, 1.3304473e-1),
        *(2.0241446e-2, 1.2668171e-3),
    ),
)
"""Reference function of type T from -270 to 0 °C, and its inverse from -200 to 0 °C."""

ABOVE: Final = Piece(
    forward=(
        *(0.0, 0.387481063640e-01, 0.332922278800e-04, 0.206182434040e-06, -0.218822568460e-08),
        *(0.109968809280e-10, -0.308157587720e-13, 0.454791352900e-16, -0.275129016730e-19),
    ),
    inverse=(
        *(0.0, 2.592800e1, -7.602961e-1, 4.637791e-2, -2.165394e-3, 6.048144e-5, -7.293422e-7),
    ),
)
"""Reference function of type T from 0 to 400 °C, and its inverse."""

TEMPERATURE: Final = Range(3.15, 673.15, "K")
"""Range of `emf`: -270 to 400 °C."""

EMF: Final = Range(-5.603, 20.872, "mV")
"""Range of `temperature`, against a cold junction at 0 °C: -200 to 400 °C."""

# The start is off by 0.04 K; Newton squares that, times E'' / 2 E', below 0.01 /K: two are enough.
_STEPS = 3


def emf(temperature: npt.ArrayLike) -> Array:
    r"""
    Voltage of a type-T thermocouple whose cold junction is at 0 °C.

    .. math:: E = \sum_i c_i t^i, \quad t = T - 273.15\,\mathrm{K}

    Parameters
    ----------
    temperature : array_like
        Temperature of the tip [K], in 3.15 to 673.15.

    Returns
    -------
    ndarray
        Voltage [mV], same shape.

    Raises
    ------
    ValueError
        If a temperature lies outside the range or is NaN; the error names the first.

    References
    ----------
    .. [1] NIST ITS-90 Thermocouple Database, SRD 60, doi:10.18434/T4S888
    .. [2] Burns, Scroger, Strouse, Croarkin, Guthrie (1993), NIST Monograph 175,
       doi:10.6028/NIST.MONO.175
    """
    return _forward(TEMPERATURE.require("temperature", temperature) - zero_Celsius)


def sensitivity(temperature: npt.ArrayLike) -> Array:
    """
    Derivative of `emf`, the Seebeck coefficient: 0.039 mV/K at 0 °C, 0.016 mV/K at -200 °C.

    Parameters
    ----------
    temperature : array_like
        Temperature [K], in 3.15 to 673.15.

    Returns
    -------
    ndarray
        Sensitivity [mV/K], same shape; an error of the voltage, divided by it, is one of the
        temperature.

    Raises
    ------
    ValueError
        As `emf`.
    """
    return _slope(TEMPERATURE.require("temperature", temperature) - zero_Celsius)


def temperature(emf_mV: npt.ArrayLike, junction_temperature: npt.ArrayLike) -> Array:  # noqa: N803
    """
    Temperature of the tip from the voltage at the terminals: the exact inverse of `emf`.

    NIST's approximate inverse of the sum of the voltage and the cold junction's own is refined by
    Newton's method on the reference function, to within rounding (1e-9 K).

    Parameters
    ----------
    emf_mV : array_like
        Voltage at the terminals [mV].
    junction_temperature : array_like
        Temperature of the terminals, the cold junction [K]; broadcast against the voltage.

    Returns
    -------
    ndarray
        Temperature [K], of the broadcast shape. The range ends at 20.872 mV, as NIST's does, which
        is 400 °C rounded up: there the result is 673.1505 K.

    Raises
    ------
    ValueError
        If a cold junction lies outside 3.15 to 673.15 K, or a voltage, referred to 0 °C, outside
        -5.603 to 20.872 mV, or one of them is NaN: the voltage of an open thermocouple has no
        temperature.

    Examples
    --------
    A meter reads 4.279 mV, and its terminals are at 25 °C; the tip is at 120.88 °C. Without the
    cold junction it would be taken for 100 °C.

    >>> f"{float(temperature(4.279, 298.15)) - 273.15:.3f}"
    '120.882'
    """
    at_junction = emf(junction_temperature)
    total = np.asarray(emf_mV, dtype=np.float64) + at_junction
    EMF.require("voltage, referred to 0 °C,", total)
    celsius = _where(total, _polynomial(BELOW.inverse, total), _polynomial(ABOVE.inverse, total))
    for _ in range(_STEPS):
        celsius = celsius - (_forward(celsius) - total) / _slope(celsius)
    return np.asarray(celsius + zero_Celsius)


def _forward(celsius: Array) -> Array:
    """Voltage [mV] at a temperature [°C]."""
    below, above = (_polynomial(piece.forward, celsius) for piece in (BELOW, ABOVE))
    return _where(celsius, below, above)


def _slope(celsius: Array) -> Array:
    """Sensitivity [mV/K] at a temperature [°C]."""
    slopes = (np.polynomial.polynomial.polyder(piece.forward) for piece in (BELOW, ABOVE))
    below, above = (_polynomial(slope, celsius) for slope in slopes)
    return _where(celsius, below, above)


def _polynomial(coefficients: npt.ArrayLike, argument: Array) -> Array:
    return np.asarray(
        np.polynomial.polynomial.polyval(argument, np.asarray(coefficients, dtype=np.float64))
    )


def _where(argument: Array, below: Array, above: Array) -> Array:
    """Choose the piece; at zero both are zero."""
    return np.asarray(np.where(argument < 0.0, below, above))
