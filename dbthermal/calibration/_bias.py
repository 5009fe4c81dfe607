"""Errors that all readings of one series have in common, for the emissivity of a material."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from dbthermal import planck
from dbthermal.response import Curve

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Bias:
    r"""
    Errors that all readings of one series have in common, each uniform in a range.

    A range's middle is corrected for, and its standard deviation, the width over
    :math:`\sqrt{12}`, is carried into the result: a rectangular distribution, clause 4.3.7 of the
    Guide to the expression of uncertainty in measurement (JCGM 100:2008).

    Attributes
    ----------
    object_tolerance : float
        Largest offset of the thermocouple's readings, either way [K].
    contact : tuple of float
        Least and largest fraction of the object's excess over the air that the thermocouple
        misses, because it conducts heat away [1].
    air_temperature : float
        Of the air, and of the room [K].
    background_tolerance : float
        Largest offset of the reflected body's temperature, either way [K].
    stray : tuple of float
        Least and largest fraction of the reflection that comes from the room and not from the
        blackbody: a surface that is not quite smooth, a blackbody not quite black [1].
    """

    object_tolerance: float = 0.0
    contact: tuple[float, float] = (0.0, 0.0)
    air_temperature: float = 295.15
    background_tolerance: float = 0.0
    stray: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        """Refuse ranges that are none."""
        for name in ("object_tolerance", "background_tolerance"):
            value = getattr(self, name)
            if not 0 <= value < np.inf:
                raise ValueError(f"Invalid {name} {value} K. Must be zero or positive.")
        for name in ("contact", "stray"):
            least, largest = getattr(self, name)
            if not 0 <= least <= largest < 1:
                raise ValueError(
                    f"Invalid {name} ({least}, {largest}). Must be a range within [0, 1)."
                )
        planck.require_positive("air_temperature [K]", self.air_temperature)

    @property
    def _felt(self) -> float:
        """Fraction of the object's excess over the air that the thermocouple feels [1]."""
        return 1.0 - 0.5 * (self.contact[0] + self.contact[1])

    @property
    def _mirrored(self) -> float:
        """Fraction of the reflection that comes from the blackbody [1]."""
        return 1.0 - 0.5 * (self.stray[0] + self.stray[1])

    def corrected(self, reading: Array) -> Array:
        r"""
        Object temperature from the thermocouple's, by the middle m of the contact error.

        .. math:: T = T_a + \frac{R - T_a}{1 - m}

        Parameters
        ----------
        reading : ndarray
            R, as read [K].

        Returns
        -------
        ndarray
            T, corrected [K].
        """
        return self.air_temperature + (reading - self.air_temperature) / self._felt

    def emitted(self, curve: Curve, temperature: Array, std: float) -> tuple[Array, Array]:
        r"""
        Effect of the thermocouple's errors on the object's own signal.

        What the reading is off by, the corrected temperature is off by :math:`1 / (1 - m)` times
        as much; so is it by the error of m, times the excess over the air.

        Parameters
        ----------
        curve : Curve
            Response of the band.
        temperature : ndarray, shape (measurement,)
            Corrected object temperature [K].
        std : float
            Standard deviation of one reading [K].

        Returns
        -------
        tuple of ndarray, (measurement,) and (2, measurement)
            Deviation independent from reading to reading, and what a standard deviation of the
            offset and of the contact error does [count].
        """
        scale = curve.count_slope(temperature) / self._felt
        contact = _std(self.contact) * (temperature - self.air_temperature)
        offset = np.full_like(temperature, self.object_tolerance / 3.0**0.5)
        return np.asarray(scale * std), np.asarray(scale * np.stack([offset, contact]))

    def reflection(self, curve: Curve, temperature: Array) -> Array:
        r"""
        Signal that the object reflects, by the middle s of the stray part.

        .. math:: W_b = (1 - s) \, U(T_b) + s \, U(T_a)

        Parameters
        ----------
        curve : Curve
            Response of the band.
        temperature : ndarray, shape (measurement,)
            Temperature of the reflected blackbody, as it shows it [K].

        Returns
        -------
        ndarray, shape (measurement,)
            Reflected signal [count].
        """
        room = curve.counts(self.air_temperature)
        return np.asarray(room + self._mirrored * (curve.counts(temperature) - room))

    def reflected(self, curve: Curve, temperature: Array, std: float) -> tuple[Array, Array]:
        """
        Effect of the blackbody's errors on the reflected signal, of which it is 1 - s.

        Parameters
        ----------
        curve : Curve
            Response of the band.
        temperature : ndarray, shape (measurement,)
            Its temperature [K].
        std : float
            Standard deviation of one reading [K].

        Returns
        -------
        tuple of ndarray, (measurement,) and (2, measurement)
            Deviation independent from reading to reading, and what a standard deviation of the
            offset and of the stray part does [count].
        """
        scale = self._mirrored * curve.count_slope(temperature)
        offset = scale * self.background_tolerance / 3.0**0.5
        excess = curve.counts(temperature) - curve.counts(self.air_temperature)
        return np.asarray(scale * std), np.stack([offset, _std(self.stray) * excess])


NO_BIAS: Final = Bias()
"""Readings whose errors are independent."""


def _std(span: tuple[float, float]) -> float:
    """Standard deviation of a uniform distribution."""
    return float((span[1] - span[0]) / np.sqrt(12.0))
