"""Transient heat in thin shells: conduction along a surface, and exchange with its surroundings.

`Shell` is the body, of a thickness and a `Solid`; `Convection`, `Radiation` and `Heating` are its
exchanges; `simulate` states the balance and steps it through time. Every exchange is, at one time,
a flux a - b T - s T^4 into the shell, so any number of them add up to three numbers a vertex.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Final, TypeAlias

import numpy as np
import numpy.typing as npt
import robust_laplacian
import trimesh
from scipy import sparse
from scipy.constants import Stefan_Boltzmann
from scipy.sparse.linalg import splu

from dbthermal._arrays import Array
from dbthermal._numbers import POSITIVE, real_numbers

Varying: TypeAlias = float | Array | Callable[[float], float | Array]
"""A number, one for each vertex (vertex,), or a function of time [s] that returns either."""


@dataclass(frozen=True, eq=False)
class Convection:
    """Exchange with a fluid, or through a contact: h (T_fluid - T).

    Coefficient of heat transfer h, not negative [W m^-2 K^-1], and temperature of the fluid [K].
    With a very large coefficient, such as 1e9 W m^-2 K^-1, a prescribed temperature.
    """

    coefficient: Varying
    temperature: Varying

    def terms(self, time: float, vertices: int) -> tuple[Array | float, ...]:
        """Terms a, b, s of `Balance` at a time [s]; ValueError for what is not physical."""
        coefficient = _evaluate("coefficient of convection", self.coefficient, time, vertices, 0.0)
        fluid = _evaluate("temperature of convection", self.temperature, time, vertices, 0.0)
        return coefficient * fluid, coefficient, 0.0


@dataclass(frozen=True, eq=False)
class Radiation:
    """Exchange of one side with large surroundings: emissivity sigma (T_s^4 - T^4).

    Total hemispherical emissivity, in [0, 1], and radiant temperature T_s of the surroundings [K].
    """

    emissivity: Varying
    temperature: Varying

    def terms(self, time: float, vertices: int) -> tuple[Array | float, ...]:
        """Terms a, b, s of `Balance`, see `Convection.terms`."""
        emissivity = _evaluate("emissivity of radiation", self.emissivity, time, vertices, 0.0, 1.0)
        radiant = _evaluate("temperature of radiation", self.temperature, time, vertices, 0.0)
        quartic = Stefan_Boltzmann * emissivity
        return quartic * radiant**4, 0.0, quartic


@dataclass(frozen=True, eq=False)
class Heating:
    """Prescribed flux into the shell [W m^-2], such as absorbed light; negative if it cools."""

    flux: Varying

    def terms(self, time: float, vertices: int) -> tuple[Array | float, ...]:
        """Terms a, b, s of `Balance`, see `Convection.terms`."""
        return _evaluate("flux of heating", self.flux, time, vertices), 0.0, 0.0


Exchange: TypeAlias = Convection | Radiation | Heating


class Balance:
    """Flux a - b T - s T^4 into a shell at one time [s], the sum of all exchanges.

    Of a, b and s (vertex,) in [W m^-2], [W m^-2 K^-1] and [W m^-2 K^-4].
    """

    def __init__(self, exchanges: Sequence[Exchange], time: float, vertices: int) -> None:
        total = np.zeros((3, vertices))
        for exchange in exchanges:
            for place, term in enumerate(exchange.terms(time, vertices)):
                total[place] += term
        self.constant, self.linear, self.quartic = total

    def flux(self, temperature: Array) -> Array:
        """Flux into the shell at temperatures [K], (vertex,) [W m^-2]."""
        return self.constant - (self.linear + self.quartic * temperature**3) * temperature

    def slope(self, temperature: Array) -> Array:
        """Negative derivative of the flux with the temperature, (vertex,) [W m^-2 K^-1]."""
        return self.linear + 4.0 * self.quartic * temperature**3


def _evaluate(
    name: str,
    value: Varying,
    time: float,
    vertices: int,
    lowest: float = -np.inf,
    highest: float = np.inf,
) -> Array:
    """Varying quantity at a time [s] and every vertex (vertex,), finite and within limits."""
    array = np.asarray(value(time) if callable(value) else value, dtype=np.float64)
    if array.shape not in {(), (vertices,)}:
        rule = f"Must be a number or ({vertices},)"
        raise ValueError(f"Invalid shape {array.shape} of the {name} at {time:g} s. {rule}.")
    bad = ~(np.isfinite(array) & (array >= lowest) & (array <= highest))
    if np.any(bad):
        rule = f"be finite, and lie in [{lowest:g}, {highest:g}]"
        raise ValueError(f"Invalid {name} {array[bad].flat[0]} at {time:g} s. Must {rule}.")
    return np.broadcast_to(array, (vertices,))


_FLATTEST: Final = 1e-9
"""A face that is flatter than this fraction of the mesh's size has no area [1]."""


@dataclass(frozen=True)
class Solid:
    """Thermal properties of a solid, constant over the temperatures of a scene."""

    conductivity: float  # k [W m^-1 K^-1]
    density: float  # [kg m^-3]
    specific_heat: float  # at constant pressure, c [J kg^-1 K^-1]

    def __post_init__(self) -> None:
        """Refuse a property that is not finite and positive."""
        for field in fields(self):
            real_numbers(f"{field.name} of a solid", getattr(self, field.name), POSITIVE)


# At 300 K, from table A.3 of Bergman, Lavine, Incropera, DeWitt (2011), Fundamentals of Heat and
# Mass Transfer, 7th edition, Wiley, ISBN 978-0-470-50197-9.

GLASS: Final = Solid(conductivity=1.4, density=2500.0, specific_heat=750.0)
"""Plate glass, soda-lime, at 300 K: table A.3 of Bergman et al. (2011)."""

BOROSILICATE: Final = Solid(conductivity=1.4, density=2225.0, specific_heat=835.0)
"""Pyrex at 300 K: table A.3 of Bergman et al. (2011)."""

CERAMIC: Final = Solid(conductivity=1.5, density=2400.0, specific_heat=1050.0)
"""Porcelain near room temperature, round values: material-properties.org, page "Porcelain"."""


@dataclass(frozen=True, eq=False)
class Shell:
    r"""A shell so thin that its temperature is uniform through it.

    That holds while the Biot number :math:`h d / k` is far below 1: 0.02 for 3 mm of glass in
    still air, but 1 where hot water wets it. There the half wall up to the middle belongs in
    series with the fluid, :math:`1 / (1/h + d / 2k)`, and the outer face still lags by some
    :math:`d^2 / 2 \alpha` (6 s).

    ValueError if a number is not finite, a vertex belongs to no face, or a face is repeated or has
    no area. The sense of the faces does not matter; edges may be open (insulated) or shared by more
    than two faces.
    """

    mesh: trimesh.Trimesh  # [m]
    thickness: float  # d [m]
    solid: Solid

    def __post_init__(self) -> None:
        """Check thickness and mesh."""
        real_numbers("thickness [m] of a shell", self.thickness, POSITIVE)
        mesh = self.mesh
        if mesh.is_empty:
            raise ValueError("Empty mesh of a shell. Must have a face.")
        for what, holds in (
            ("vertex {} that is not finite", np.isfinite(mesh.vertices).all(axis=1)),
            ("vertex {} of no face", mesh.referenced_vertices),
            ("face {} without an area", mesh.nondegenerate_faces(_FLATTEST * mesh.scale)),
            ("face {}, as an earlier one", mesh.unique_faces()),
        ):
            for number in np.flatnonzero(~np.asarray(holds)):
                raise ValueError(f"Invalid {what.format(number)}. Must be left out.")

    @cached_property
    def _operators(self) -> tuple[Any, Array]:
        r"""
        Weak Laplacian [1], :math:`(L T)_i = \int \nabla \varphi_i \cdot \nabla T dA`, area [m^2].

        Built on intrinsic Delaunay triangles, so no off-diagonal element is positive (but for
        rounding) and the step obeys the maximum principle whatever the triangles are: Sharp, Crane
        (2020), Computer Graphics Forum 39(5), doi:10.1111/cgf.14069.
        """
        laplacian, mass = robust_laplacian.mesh_laplacian(
            np.array(self.mesh.vertices, dtype=np.float64), np.array(self.mesh.faces)
        )
        return sparse.csr_matrix(laplacian), np.asarray(mass.diagonal())

    @property
    def area(self) -> Array:
        """Share of the surface of every vertex, (vertex,) [m^2]; it adds up to the faces' area."""
        return self._operators[1]

    @cached_property
    def stiffness(self) -> Any:
        r"""Conduction :math:`k d L` as a sparse matrix, (vertex, vertex) [W/K].

        Symmetric, positive semidefinite: heat leaves vertex i at the rate :math:`(k d L T)_i`;
        its rows add up to zero.
        """
        return self.solid.conductivity * self.thickness * self._operators[0]

    @property
    def capacity_per_area(self) -> float:
        r"""Heat capacity :math:`\rho c d` of a square metre [J m^-2 K^-1]."""
        return self.solid.density * self.solid.specific_heat * self.thickness

    @property
    def capacity(self) -> Array:
        """Heat capacity of every vertex, (vertex,) [J/K]."""
        return self.capacity_per_area * self.area


TOLERANCE: Final = 1e-6  # largest error of the iteration in a stage of a step [K]
# Diagonal of the two-stage scheme, the smaller root of 2 g^2 - 4 g + 1 = 0 [1]; contraction of the
# error above which an iteration gets a new factorisation [1].
_GAMMA, _CONTRACTION = 1.0 - np.sqrt(0.5), 0.5
_ITERATIONS: Final = 40  # largest number of iterations of a stage; each at least halves the error
_EVEN: Final = 1e-7  # relative difference below which two steps, or a step and its limit, are equal


def simulate(
    shell: Shell,
    time: npt.ArrayLike,
    initial: npt.ArrayLike,
    exchanges: Sequence[Exchange] = (),
    *,
    step: float | None = None,
    tolerance: float = TOLERANCE,
) -> Array:
    r"""Transient temperature (time, vertex) [K] of a thin shell, insulated at an edge of the mesh.

    .. math:: \rho c d \, \dot T = \nabla \cdot (k d \, \nabla T) + \sum_i h_i (T_i - T)
              + \sum_j \varepsilon_j \sigma (T_j^4 - T^4) + q

    In space, the intrinsic Laplacian with a lumped mass (`Shell`): second order in the edge
    length. In time, Alexander's stiffly accurate two-stage scheme (SDIRK2) [1]_, L-stable and of
    second order in the step; where a function of time jumps within a step, of first. Both stages
    share one sparse factorisation, which is reused for all steps of one length.

    The initial temperature [K] is a number or (vertex,), at the first of the increasing times
    (time,) [s]; the exchanges are one for each side and cause, none for an insulated body. Every
    interval of the times is cut evenly into as few steps as the longest `step` [s] allows, one by
    default. `tolerance` is the largest error of the iteration in a stage [K].

    ValueError if a parameter has the wrong shape or is not physical, or an exchange at some time is
    not. ArithmeticError if a temperature falls to 0 K or below, or a stage does not converge.

    References
    ----------
    .. [1] Alexander (1977), Diagonally Implicit Runge-Kutta Methods for Stiff O.D.E.'s, SIAM
       Journal on Numerical Analysis 14(6), doi:10.1137/0714068
    """
    times = _times(time)
    limit = np.inf if step is None else float(real_numbers("step [s]", step, POSITIVE))
    temperature = _initial(initial, len(shell.area))
    stepper = _Stepper(shell, exchanges, temperature, times[0])
    stepper.tolerance = float(real_numbers("tolerance [K]", tolerance, POSITIVE))
    result = np.empty((times.size, temperature.size))
    result[0] = temperature
    for index in range(1, times.size):
        first, last = times[index - 1], times[index]
        count = max(1, int(np.ceil((last - first) / limit - _EVEN)))
        # linspace ends exactly on the sample: no function is called beyond the last time.
        for begin, end in itertools.pairwise(np.linspace(first, last, count + 1).tolist()):
            temperature = stepper.advance(temperature, begin, end)
        result[index] = temperature
    return result


class _Stepper:
    r"""Steps of one shell, with the factorisation they share.

    A stage solves :math:`C (T - B) = w (A f(T) - K T)` for T, with the capacity C, the base B,
    the weight w (a time), the vertices' areas A, the flux f and the stiffness K, by

    .. math:: T \leftarrow T - (C + w K + w A \bar b)^{-1} [C (T - B) - w (A f(T) - K T)]

    where :math:`\bar b` is a slope of the flux from some earlier time. The matrix has no positive
    element off its diagonal, so an iteration shrinks the largest error at least by
    :math:`\max |b - \bar b| / (\rho c d / w + \bar b)`. The bound serves twice: it says when to
    stop, and when the factorisation is too old.
    """

    tolerance = TOLERANCE

    def __init__(
        self, shell: Shell, exchanges: Sequence[Exchange], temperature: Array, time: float
    ) -> None:
        self.shell, self.exchanges = shell, exchanges
        self.weight, self.slope = 0.0, np.zeros(len(shell.area))
        balance = Balance(exchanges, time, temperature.size)
        self.rate = self.heat(temperature, balance) / shell.capacity  # [K/s]

    def heat(self, temperature: Array, balance: Balance) -> Array:
        """Heat (vertex,) [W] that flows into every vertex."""
        flux, stiffness = balance.flux(temperature), self.shell.stiffness
        return np.asarray(self.shell.area * flux - stiffness @ temperature)

    def advance(self, temperature: Array, begin: float, end: float) -> Array:
        r"""Temperature [K] at the end of a step from a time to another [s].

        .. math:: T_1 = T + \gamma \tau F(t + \gamma \tau, T_1), \quad
                  T_2 = T + (1 - \gamma) \tau F(t + \gamma \tau, T_1)
                  + \gamma \tau F(t + \tau, T_2)
        """
        weight = _GAMMA * (end - begin)
        self._stage(temperature, temperature, begin + weight, weight)
        base = temperature + (end - begin - weight) * self.rate
        return self._stage(base, temperature, end, weight)

    def _stage(self, base: Array, before: Array, time: float, weight: float) -> Array:
        """Solve a stage; its rate of change [K/s] is kept for the next one."""
        shell, balance = self.shell, Balance(self.exchanges, time, base.size)
        temperature = base + weight * self.rate
        if not np.all(temperature > 0):
            temperature = before.copy()
        slope = balance.slope(temperature)
        for _ in range(_ITERATIONS):
            same = math.isclose(self.weight, weight, rel_tol=_EVEN)
            if not same or self._shrink(slope) > _CONTRACTION:
                # Factorise the matrix of the stage, C + w K + w A b.
                self.weight, self.slope = weight, slope
                diagonal = shell.capacity + weight * shell.area * slope
                matrix = sparse.diags(diagonal, format="csr") + weight * shell.stiffness
                options = {"permc_spec": "MMD_AT_PLUS_A", "options": {"SymmetricMode": True}}
                self.factors = splu(matrix.tocsc(), **options)
            heat = weight * self.heat(temperature, balance)
            correction = self.factors.solve(shell.capacity * (temperature - base) - heat)
            temperature -= correction
            change = float(np.max(np.abs(correction)))
            ahead = balance.slope(temperature)
            shrink = max(self._shrink(slope), self._shrink(ahead))
            if shrink < 1 and shrink / (1 - shrink) * change <= self.tolerance:
                self.rate = (temperature - base) / weight
                lowest = int(np.argmin(temperature))
                if temperature[lowest] > 0:
                    return temperature
                raise ArithmeticError(
                    f"Invalid temperature {temperature[lowest]:g} K of vertex {lowest} at {time:g} "
                    "s. Must be above 0 K; cool less or take a shorter step."
                )
            slope = ahead
        raise ArithmeticError(
            f"No convergence at {time:g} s: {change:g} K after {_ITERATIONS} iterations. "
            f"Must be below {self.tolerance:g} K; take a shorter step."
        )

    def _shrink(self, slope: Array) -> float:
        """Bound of the factor by which an iteration shrinks the error [1]."""
        inertia = self.shell.capacity_per_area / self.weight
        return float(np.max(np.abs(slope - self.slope) / (inertia + self.slope)))


def _times(time: npt.ArrayLike) -> Array:
    """Return times that are finite and increase, or raise a ValueError."""
    times = np.asarray(time, dtype=np.float64)
    if times.ndim != 1 or not times.size or not np.all(np.isfinite(times)):
        raise ValueError(f"Invalid times of shape {times.shape}. Must be finite, one at least.")
    for index in np.flatnonzero(np.diff(times) <= 0):
        raise ValueError(f"Invalid time {times[index + 1]} s. Must be above the one before.")
    return times


def _initial(initial: npt.ArrayLike, vertices: int) -> Array:
    """Return a copy of an initial temperature for every vertex, or raise a ValueError."""
    array = np.asarray(initial, dtype=np.float64)
    if array.shape not in {(), (vertices,)}:
        label = f"Invalid shape {array.shape} of the initial temperature"
        raise ValueError(f"{label}. Must be a number or ({vertices},).")
    real_numbers("initial temperature", array, POSITIVE)
    return np.array(np.broadcast_to(array, (vertices,)))
