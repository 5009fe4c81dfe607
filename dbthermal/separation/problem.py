"""What every separation method is given and gives back: one tile of pixels."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dbthermal import schema
from dbthermal.response import Curve

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.uint16]


@dataclass(frozen=True)
class Problem:
    """
    One tile of a corrected capture in two bands, the quieter band first.

    Attributes
    ----------
    signals : ndarray, shape (2, time, pixel)
        Linearised signals less the reference temperature [K]; finite.
    time : ndarray, shape (time,)
        Times [s].
    curves : tuple of Curve
        Response of each band, with one reference temperature.
    noise : tuple of float
        Standard deviation of the signals' noise [K], at the reference temperature.
    emissivity, emissivity_std : ndarray, shape (2, pixel), optional
        Known emissivities and their standard deviations [1], for methods that need them.
    """

    signals: Array
    time: Array
    curves: tuple[Curve, Curve]
    noise: tuple[float, float]
    emissivity: Array | None = None
    emissivity_std: Array | None = None

    @property
    def reference(self) -> float:
        """Reference temperature [K] that the signals are relative to."""
        return self.curves[0].reference

    def blackbody(self, band: int, temperature: Array) -> Array:
        """
        Signal of a blackbody in a band, relative to the reference.

        Parameters
        ----------
        band : int
            0 or 1.
        temperature : ndarray
            Temperature [K].

        Returns
        -------
        ndarray
            Signal [K].
        """
        return self.curves[band].signal(temperature) - self.reference

    def temperature(self, band: int, signal: Array) -> Array:
        """
        Inverse of `blackbody`.

        Parameters
        ----------
        band : int
            0 or 1.
        signal : ndarray
            Signal relative to the reference [K].

        Returns
        -------
        ndarray
            Temperature [K]; NaN where there is none.
        """
        return self.curves[band].temperature(signal + self.reference)


@dataclass(frozen=True)
class Separated:
    """
    What a method finds for one tile; NaN where a quantity is undefined, with a flag that says so.

    Attributes
    ----------
    object_temperature, object_temperature_std : ndarray, shape (time, pixel)
        Object temperature and its standard deviation [K].
    background_temperature, background_temperature_std : ndarray, shape (time, pixel)
        Background temperature and its standard deviation [K].
    emissivity, emissivity_std : ndarray, shape (2, pixel)
        Emissivities and their standard deviations [1].
    status : ndarray of uint16, shape (pixel,)
        Bits of `schema.FLAGS`.
    """

    object_temperature: Array
    object_temperature_std: Array
    background_temperature: Array
    background_temperature_std: Array
    emissivity: Array
    emissivity_std: Array
    status: Flags


def flag(conditions: dict[str, npt.NDArray[np.bool_]]) -> Flags:
    """
    Combine named conditions into status bits.

    Parameters
    ----------
    conditions : dict of ndarray of bool, shape (pixel,)
        Names of `schema.FLAGS`, and where each holds.

    Returns
    -------
    ndarray of uint16, shape (pixel,)
        The bits.
    """
    parts = [holds * np.uint16(schema.FLAGS[name]) for name, holds in conditions.items()]
    return np.asarray(np.bitwise_or.reduce(parts), dtype=np.uint16)


def outside(temperature: Array, std: Array, curve: Curve) -> npt.NDArray[np.bool_]:
    """
    Where a temperature leaves the calibrated range by more than its noise explains.

    Parameters
    ----------
    temperature, std : ndarray, shape (time, pixel)
        Temperature and standard deviation [K].
    curve : Curve
        The response.

    Returns
    -------
    ndarray of bool, shape (pixel,)
        True if any sample is more than five standard deviations outside.
    """
    margin = 5.0 * std
    below, above = temperature < curve.lowest - margin, temperature > curve.highest + margin
    return np.asarray(np.any(below | above, axis=0))
