r"""Response curves of one band: temperature <-> counts, and the linearised signal.

Everything downstream of a calibration computes in the linearised signal
:math:`z = T_r + (I - U(T_r)) / a`, in kelvin, and in the blackbody's own signal :math:`u(T)`, with
:math:`u(T_r) = T_r` and slope 1 there.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dbthermal import planck

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Curve:
    r"""
    Sakuma-Hattori response of one band.

    .. math:: U(T) = \frac{C}{\exp(c_2 / (A T + B)) - 1} + O

    Attributes
    ----------
    band : str
        Name of the band.
    amplitude : float
        C [count].
    wavelength : float
        A, effective wavelength [m].
    shift : float
        B [m K].
    offset : float
        O [count].
    reference : float
        Reference temperature :math:`T_r` [K].
    lowest, highest : float
        Calibrated range [K].

    References
    ----------
    .. [1] Sakuma, Hattori (1982), in Temperature: its Measurement and Control in Science and
       Industry 5, 421-427
    .. [2] Saunders, White (2003), Metrologia 40, 195, doi:10.1088/0026-1394/40/4/309
    """

    band: str
    amplitude: float
    wavelength: float
    shift: float
    offset: float
    reference: float
    lowest: float
    highest: float

    def counts(self, temperature: npt.ArrayLike) -> Array:
        """
        Counts of a blackbody that fills the pixel.

        Parameters
        ----------
        temperature : array_like
            Temperature [K].

        Returns
        -------
        ndarray
            Counts [count]; outside the calibrated range the curve is extrapolated.
        """
        exponent = planck.SECOND_RADIATION_CONSTANT / self._scale(temperature)
        return np.asarray(self.amplitude / np.expm1(exponent) + self.offset)

    def count_slope(self, temperature: npt.ArrayLike) -> Array:
        """
        Derivative of `counts`.

        Parameters
        ----------
        temperature : array_like
            Temperature [K].

        Returns
        -------
        ndarray
            Slope [count/K].
        """
        scale = self._scale(temperature)
        exponent = planck.SECOND_RADIATION_CONSTANT / scale
        excess = np.expm1(exponent)
        growth = self.amplitude / excess * (1.0 + 1.0 / excess)
        return np.asarray(growth * exponent * self.wavelength / scale)

    def inverse(self, counts: npt.ArrayLike) -> Array:
        """
        Temperature of the blackbody with given counts: the exact inverse of `counts`.

        Parameters
        ----------
        counts : array_like
            Counts [count].

        Returns
        -------
        ndarray
            Temperature [K]; NaN where no temperature gives such counts (at or below the offset).
        """
        excess = np.asarray(counts, dtype=np.float64) - self.offset
        ratio = np.full_like(excess, np.nan)
        np.divide(self.amplitude, excess, out=ratio, where=excess > 0)
        scale = planck.SECOND_RADIATION_CONSTANT / np.log1p(ratio)
        return np.asarray((scale - self.shift) / self.wavelength)

    @property
    def reference_counts(self) -> float:
        """Counts at the reference temperature [count]."""
        return float(self.counts(self.reference))

    @property
    def reference_slope(self) -> float:
        """Slope a at the reference temperature [count/K]."""
        return float(self.count_slope(self.reference))

    def linearise(self, counts: npt.ArrayLike) -> Array:
        """
        Linearised signal z of counts.

        Parameters
        ----------
        counts : array_like
            Counts [count].

        Returns
        -------
        ndarray
            Signal [K].
        """
        excess = np.asarray(counts, dtype=np.float64) - self.reference_counts
        return self.reference + excess / self.reference_slope

    def signal(self, temperature: npt.ArrayLike) -> Array:
        """
        Linearised signal u(T) of a blackbody.

        Parameters
        ----------
        temperature : array_like
            Temperature [K].

        Returns
        -------
        ndarray
            Signal [K].
        """
        return self.linearise(self.counts(temperature))

    def slope(self, temperature: npt.ArrayLike) -> Array:
        """
        Derivative of `signal`.

        Parameters
        ----------
        temperature : array_like
            Temperature [K].

        Returns
        -------
        ndarray
            Slope [1].
        """
        return self.count_slope(temperature) / self.reference_slope

    def temperature(self, signal: npt.ArrayLike) -> Array:
        """
        Temperature of the blackbody with a given linearised signal; inverse of `signal`.

        Parameters
        ----------
        signal : array_like
            Signal [K].

        Returns
        -------
        ndarray
            Temperature [K]; NaN where there is none.
        """
        excess = np.asarray(signal, dtype=np.float64) - self.reference
        return self.inverse(self.reference_counts + self.reference_slope * excess)

    def _scale(self, temperature: npt.ArrayLike) -> Array:
        return self.wavelength * np.asarray(temperature, dtype=np.float64) + self.shift


@dataclass(frozen=True)
class Line(Curve):
    """
    The paper's linear response, counts = slope * T + intercept, with the same methods.

    Attributes
    ----------
    amplitude : float
        Slope [count/K].
    offset : float
        Intercept [count]; `wavelength` and `shift` are not used.
    """

    def counts(self, temperature: npt.ArrayLike) -> Array:
        """Counts at a temperature [K]; see `Curve.counts`."""
        return self.amplitude * np.asarray(temperature, dtype=np.float64) + self.offset

    def count_slope(self, temperature: npt.ArrayLike) -> Array:
        """Slope [count/K], the same at each temperature; see `Curve.count_slope`."""
        return np.full_like(np.asarray(temperature, dtype=np.float64), self.amplitude)

    def inverse(self, counts: npt.ArrayLike) -> Array:
        """Temperature [K] of counts; see `Curve.inverse`."""
        return (np.asarray(counts, dtype=np.float64) - self.offset) / self.amplitude


def require_range(temperature: npt.ArrayLike, of: Curve, what: str) -> Array:
    """
    Return temperatures that all lie in the calibrated range of a curve.

    Parameters
    ----------
    temperature : array_like
        Temperatures [K].
    of : Curve
        The curve.
    what : str
        What they are, for the error.

    Returns
    -------
    ndarray
        The temperatures as float64.

    Raises
    ------
    ValueError
        If one lies outside the range or is NaN; the error names the first.
    """
    values = np.asarray(temperature, dtype=np.float64)
    bad = ~((values >= of.lowest) & (values <= of.highest))
    if np.any(bad):
        raise ValueError(
            f"Invalid {what} {values[bad].flat[0]} K in band '{of.band}'. Must lie in the "
            f"response's range [{of.lowest}, {of.highest}] K."
        )
    return values
