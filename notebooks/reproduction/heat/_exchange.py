"""Heat exchange of a shell with its surroundings, per area and at a time.

Every exchange is, at one time, a flux a - b T - s T^4 into the shell, so any number of them add
up to three numbers a vertex.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy.constants import Stefan_Boltzmann

from dbthermal._arrays import Array

Varying: TypeAlias = float | Array | Callable[[float], float | Array]
"""A number, one for each vertex, or a function of time [s] that returns either."""


@dataclass(frozen=True, eq=False)
class Balance:
    """Flux a - b T - s T^4 into a shell at one time, as a function of its temperature T.

    Of a, b and s (vertex,) in [W m^-2], [W m^-2 K^-1] and [W m^-2 K^-4].
    """

    constant: Array
    linear: Array
    quartic: Array

    def flux(self, temperature: Array) -> Array:
        """Flux into the shell at temperatures [K], (vertex,) [W m^-2]."""
        return self.constant - (self.linear + self.quartic * temperature**3) * temperature

    def slope(self, temperature: Array) -> Array:
        """Negative derivative of the flux with the temperature, (vertex,) [W m^-2 K^-1]."""
        return self.linear + 4.0 * self.quartic * temperature**3


class Exchange(ABC):
    """Base of the heat exchanges of a shell: convection, radiation and heating."""

    @abstractmethod
    def balance(self, time: float, vertices: int) -> tuple[Array, Array, Array]:
        """Terms a, b, s of `Balance` at a time [s] for a number of vertices.

        ValueError if an attribute does not fit the vertices or is not physical.
        """


@dataclass(frozen=True, eq=False)
class Convection(Exchange):
    """Exchange with a fluid, or through a contact: h (T_fluid - T).

    With a very large coefficient, such as 1e9 W m^-2 K^-1, a prescribed temperature.

    Attributes
    ----------
    coefficient : float, ndarray (vertex,) or function of time
        Coefficient of heat transfer h, not negative [W m^-2 K^-1].
    temperature : float, ndarray (vertex,) or function of time
        Temperature of the fluid [K].
    """

    coefficient: Varying
    temperature: Varying

    def balance(self, time: float, vertices: int) -> tuple[Array, Array, Array]:
        """Terms a, b, s of `Balance` at a time [s]; see `Exchange.balance`."""
        coefficient = _not_negative("coefficient of convection", self.coefficient, time, vertices)
        temperature = _not_negative("temperature of convection", self.temperature, time, vertices)
        return coefficient * temperature, coefficient, np.zeros(vertices)


@dataclass(frozen=True, eq=False)
class Radiation(Exchange):
    """Exchange of one side with large surroundings: emissivity sigma (T_s^4 - T^4).

    Attributes
    ----------
    emissivity : float, ndarray (vertex,) or function of time
        Total hemispherical emissivity, in [0, 1].
    temperature : float, ndarray (vertex,) or function of time
        Radiant temperature T_s of the surroundings [K].
    """

    emissivity: Varying
    temperature: Varying

    def balance(self, time: float, vertices: int) -> tuple[Array, Array, Array]:
        """Terms a, b, s of `Balance` at a time [s]; see `Exchange.balance`."""
        emissivity = _evaluate("emissivity of radiation", self.emissivity, time, vertices)
        outside = (emissivity < 0) | (emissivity > 1)
        if np.any(outside):
            raise ValueError(
                f"Invalid emissivity {emissivity[outside][0]} of radiation at {time:g} s. "
                "Must lie in [0, 1]."
            )
        surroundings = _not_negative("temperature of radiation", self.temperature, time, vertices)
        quartic = Stefan_Boltzmann * emissivity
        return quartic * surroundings**4, np.zeros(vertices), quartic


@dataclass(frozen=True, eq=False)
class Heating(Exchange):
    """Prescribed flux into the shell, such as absorbed light; negative if it cools.

    Attributes
    ----------
    flux : float, ndarray (vertex,) or function of time
        Heat per area and time q [W m^-2].
    """

    flux: Varying

    def balance(self, time: float, vertices: int) -> tuple[Array, Array, Array]:
        """Terms a, b, s of `Balance` at a time [s]; see `Exchange.balance`."""
        nothing = np.zeros(vertices)
        return _evaluate("flux of heating", self.flux, time, vertices), nothing, nothing


def combine(exchanges: Sequence[Exchange], time: float, vertices: int) -> Balance:
    """Sum of all exchanges at a time [s] as one flux."""
    total = np.zeros((3, vertices))
    for exchange in exchanges:
        total += np.stack(exchange.balance(time, vertices))
    return Balance(*total)


def _evaluate(name: str, value: Varying, time: float, vertices: int) -> Array:
    """Varying quantity at a time [s] and every vertex (vertex,), finite, or a ValueError."""
    array = np.asarray(value(time) if callable(value) else value, dtype=np.float64)
    if array.shape not in {(), (vertices,)}:
        raise ValueError(
            f"Invalid shape {array.shape} of the {name} at {time:g} s. "
            f"Must be a number or ({vertices},)."
        )
    if not np.all(np.isfinite(array)):
        raise ValueError(
            f"Invalid {name} {array[~np.isfinite(array)].flat[0]} at {time:g} s. Must be finite."
        )
    return np.broadcast_to(array, (vertices,))


def _not_negative(name: str, value: Varying, time: float, vertices: int) -> Array:
    """As `_evaluate`, and not negative."""
    array = _evaluate(name, value, time, vertices)
    if np.any(array < 0):
        raise ValueError(
            f"Invalid {name} {array[array < 0][0]} at {time:g} s. Must not be negative."
        )
    return array
