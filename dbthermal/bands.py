"""Spectral bands, and the exact pair temperature <-> in-band radiance.

A band is a top hat between two edges, which is how the paper names its filters (centre and full
width at half maximum). `Band.radiance` and `Band.temperature` are inverses of one another to
rounding, because the second solves the first and uses no table.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import numpy as np
import numpy.typing as npt

from dbthermal import _numbers, _text, planck
from dbthermal._arrays import Array

__all__ = ["FILTERS", "TEMPERATURE_RANGE", "Band", "get"]
__dir__ = __all__.copy

TEMPERATURE_RANGE: Final = (100.0, 2000.0)
"""Temperatures [K] between which the pair radiance, temperature is defined."""

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(40)
_NEWTON_STEPS = 50
_LONGEST: Final = 1e-3  # of thermal radiation [m]; beyond, a wavelength is in micrometres


@dataclass(frozen=True)
class Band:
    """A spectral band with a top-hat transmission.

    Attributes
    ----------
    name : str
        Its name, such as "9.5".
    lower, upper : float
        Lower and upper edge [m], at most 1 mm, or a ValueError.
    """

    name: str
    lower: float
    upper: float

    def __post_init__(self) -> None:
        name, edges = f"edges of band '{self.name}'", (self.lower, self.upper)
        lower, upper = _numbers.real_numbers(name, edges)
        if not 0 < lower < upper <= _LONGEST:
            rule = f"finite with 0 < lower < upper, at most {_LONGEST} m: metres, not micrometres"
            raise ValueError(f"Invalid {name} {lower} m, {upper} m. Must be {rule}.")

    @property
    def centre(self) -> float:
        """Central wavelength [m]."""
        return 0.5 * (self.lower + self.upper)

    @property
    def width(self) -> float:
        """Full width at half maximum [m]."""
        return self.upper - self.lower

    def nodes(self) -> tuple[Array, Array]:
        """Gauss-Legendre nodes (node) [m], increasing, and weights (node) [m], over the band.

        The weights add up to the width. Planck's law over 8-14 um is integrated to rounding.
        """
        return self.centre + 0.5 * self.width * _NODES, 0.5 * self.width * _WEIGHTS

    def radiance(self, temperature: npt.ArrayLike) -> Array:
        r"""In-band radiance [W m^-2 sr^-1] of blackbodies at temperatures [K] of any shape.

        .. math:: B(T) = \int_{\lambda_l}^{\lambda_u} L(\lambda, T) \, d\lambda

        ValueError for a temperature outside `TEMPERATURE_RANGE`.
        """
        return self._integral(planck.spectral_radiance, self._within_range(temperature))

    def slope(self, temperature: npt.ArrayLike) -> Array:
        """Derivative dB/dT [W m^-2 sr^-1 K^-1] of `radiance`, with its errors."""
        return self._integral(planck.spectral_radiance_slope, self._within_range(temperature))

    def temperature(self, radiance: npt.ArrayLike) -> Array:
        r"""Temperature [K] of blackbodies by in-band radiance [W m^-2 sr^-1]; inverts `radiance`.

        Newton's method on :math:`\ln B` as a function of :math:`1/T`, nearly a straight line, run
        until the temperature no longer changes. Raises ValueError for a radiance that is not of a
        temperature within `TEMPERATURE_RANGE`.
        """
        name, limits = f"radiance [W m-2 sr-1] in band '{self.name}'", np.array(TEMPERATURE_RANGE)
        lowest, highest = self.radiance(limits).tolist()
        radiance = _numbers.real_numbers(name, radiance, (lowest, highest))
        inverse = 1.0 / planck.brightness_temperature(self.centre, radiance / self.width)
        for _ in range(_NEWTON_STEPS):
            temperature = 1.0 / inverse
            value = self._integral(planck.spectral_radiance, temperature)
            slope = self._integral(planck.spectral_radiance_slope, temperature)
            step = np.log(radiance / value) * value / slope / temperature**2
            inverse = inverse - step
            if np.all(np.abs(step) <= 4.0 * np.finfo(np.float64).eps * inverse):
                return 1.0 / inverse
        number = f"{_NEWTON_STEPS} Newton steps"
        raise RuntimeError(f"No convergence in band '{self.name}' after {number}.")

    def _integral(self, function: planck.Spectral, temperature: Array) -> Array:
        # One pass a node instead of a (..., node) array: whole images fit in memory.
        total = np.zeros_like(temperature)
        for wavelength, weight in zip(*self.nodes(), strict=True):
            total += weight * function(wavelength, temperature)
        return total

    def _within_range(self, temperature: npt.ArrayLike) -> Array:
        name = f"temperature [K] in band '{self.name}'"
        return _numbers.real_numbers(name, temperature, TEMPERATURE_RANGE)


_FWHM: Final = {"8.5": 0.5, "9.5": 0.5, "10.6": 1.5, "12.1": 0.5}  # by centre [um]
FILTERS: Final[Mapping[str, Band]] = MappingProxyType(
    {"8-14": Band("8-14", 8e-6, 14e-6)}
    | {
        name: Band(name, (float(name) - 0.5 * fwhm) * 1e-6, (float(name) + 0.5 * fwhm) * 1e-6)
        for name, fwhm in _FWHM.items()
    }
)
"""The camera's own band and the four filters of the paper (section 5, experimental setup;
doi:10.48550/arXiv.2509.11334): centre and full width at half maximum, as top hats."""


def get(name: str) -> Band:
    """Band of `FILTERS` by its name.

    Parameters
    ----------
    name : str
        Name; KeyError, which lists those known, for another.

    Examples
    --------
    >>> sorted(FILTERS)
    ['10.6', '12.1', '8-14', '8.5', '9.5']
    >>> band = get("9.5")
    >>> radiance = band.radiance(300.0)
    >>> round(float(radiance), 4), round(float(band.temperature(radiance)), 6)
    (4.97, 300.0)
    """
    _text.check_listed("Unknown band", name, sorted(FILTERS), KeyError)
    return FILTERS[name]
