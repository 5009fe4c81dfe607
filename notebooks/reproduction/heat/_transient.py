"""A shell through time: an L-stable step of second order, with exact radiation."""

import itertools
import math
from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.linalg import splu

from dbthermal._arrays import Array
from dbthermal.planck import require_positive
from reproduction.heat._exchange import Balance, Exchange, combine
from reproduction.heat._shell import Shell

TOLERANCE: Final = 1e-6
"""Largest error of the iteration in a stage of a step [K]."""

_GAMMA: Final = 1.0 - np.sqrt(0.5)
"""Diagonal of the two-stage scheme, the smaller root of 2 g^2 - 4 g + 1 = 0 [1]."""

_CONTRACTION: Final = 0.5
"""Contraction of the error above which an iteration gets a new factorisation [1]."""

_ITERATIONS: Final = 40  # largest number of iterations of a stage; each at least halves the error

_EVEN: Final = 1e-7
"""Relative difference below which two steps, or a step and its limit, are the same [1]."""


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

    Parameters
    ----------
    shell : Shell
        The body.
    time : array_like, shape (time,)
        Increasing times [s]; the first is that of the initial temperature.
    initial : float or array_like, shape (vertex,)
        Initial temperature [K].
    exchanges : sequence of Exchange
        Heat exchanges; one record for each side and cause, none for an insulated body.
    step : float, optional
        Longest internal step [s]: every interval of `time` is cut evenly into as few steps as
        this allows. One step an interval if left out.
    tolerance : float
        Largest error of the iteration in a stage [K].

    Raises
    ------
    ValueError
        If a parameter has the wrong shape or is not physical, or an exchange at some time is not.
    ArithmeticError
        If a temperature falls to 0 K or below, or a stage does not converge.

    References
    ----------
    .. [1] Alexander (1977), Diagonally Implicit Runge-Kutta Methods for Stiff O.D.E.'s, SIAM
       Journal on Numerical Analysis 14(6), doi:10.1137/0714068

    Examples
    --------
    A square of glass in air, without conduction, relaxes with the time constant
    :math:`\rho c d / h`, here 562.5 s.

    >>> import trimesh
    >>> from reproduction import heat
    >>> corners = [[0.0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]]
    >>> square = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]])
    >>> plate = heat.Shell(square, 0.003, heat.GLASS)
    >>> air = heat.Convection(10.0, 293.15)
    >>> temperature = heat.simulate(plate, [0.0, 562.5], 303.15, [air], step=5.0)
    >>> (temperature[-1] - 293.15).round(2).tolist()
    [3.68, 3.68, 3.68, 3.68]
    """
    times = _times(time)
    limit = np.inf if step is None else float(require_positive("step [s]", step))
    stepper = _Stepper(shell, exchanges, float(require_positive("tolerance [K]", tolerance)))
    temperature = stepper.start(_initial(initial, shell.size), times[0])
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

    def __init__(self, shell: Shell, exchanges: Sequence[Exchange], tolerance: float) -> None:
        self.shell, self.exchanges, self.tolerance = shell, exchanges, tolerance
        self.weight = 0.0
        self.slope = np.zeros(shell.size)

    def start(self, temperature: Array, time: float) -> Array:
        """Initial temperature [K]; keep its rate of change [K/s]."""
        balance = combine(self.exchanges, time, temperature.size)
        heat = self.shell.area * balance.flux(temperature) - self.shell.stiffness @ temperature
        self.rate = heat / self.shell.capacity
        return temperature

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
        balance = combine(self.exchanges, time, base.size)
        temperature = base + weight * self.rate
        if not np.all(temperature > 0):
            temperature = before.copy()
        slope = balance.slope(temperature)
        for _ in range(_ITERATIONS):
            same = math.isclose(self.weight, weight, rel_tol=_EVEN)
            if not same or self._shrink(slope) > _CONTRACTION:
                self._factorise(weight, slope)
            change = self._correct(temperature, base, balance, weight)
            ahead = balance.slope(temperature)
            shrink = max(self._shrink(slope), self._shrink(ahead))
            if shrink < 1 and shrink / (1 - shrink) * change <= self.tolerance:
                self.rate = (temperature - base) / weight
                return _physical(temperature, time)
            slope = ahead
        raise ArithmeticError(
            f"No convergence at {time:g} s: {change:g} K after {_ITERATIONS} iterations. "
            f"Must be below {self.tolerance:g} K; take a shorter step."
        )

    def _shrink(self, slope: Array) -> float:
        """Bound of the factor by which an iteration shrinks the error [1]."""
        inertia = self.shell.capacity_per_area / self.weight
        return float(np.max(np.abs(slope - self.slope) / (inertia + self.slope)))

    def _factorise(self, weight: float, slope: Array) -> None:
        r"""Factorise the matrix of a stage, :math:`C + w K + w A \bar b`."""
        self.weight, self.slope = weight, slope
        diagonal = self.shell.capacity + weight * self.shell.area * slope
        matrix = sparse.diags(diagonal, format="csr") + weight * self.shell.stiffness
        options = {"SymmetricMode": True}
        self.factors = splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", options=options)

    def _correct(self, temperature: Array, base: Array, balance: Balance, weight: float) -> float:
        """Correct the temperature of a stage in place; return the largest correction [K]."""
        shell = self.shell
        heat = shell.area * balance.flux(temperature) - shell.stiffness @ temperature
        residual = shell.capacity * (temperature - base) - weight * heat
        change = self.factors.solve(residual)
        temperature -= change
        return float(np.max(np.abs(change)))


def _physical(temperature: Array, time: float) -> Array:
    """Return a temperature that is above 0 K everywhere, or raise an ArithmeticError."""
    lowest = int(np.argmin(temperature))
    if not temperature[lowest] > 0:
        raise ArithmeticError(
            f"Invalid temperature {temperature[lowest]:g} K of vertex {lowest} at {time:g} s. "
            "Must be above 0 K; cool less or take a shorter step."
        )
    return temperature


def _times(time: npt.ArrayLike) -> Array:
    """Return times that are finite and increase, or raise a ValueError."""
    times = np.asarray(time, dtype=np.float64)
    if times.ndim != 1 or not times.size or not np.all(np.isfinite(times)):
        raise ValueError(f"Invalid times of shape {times.shape}. Must be finite, one at least.")
    backward = np.flatnonzero(np.diff(times) <= 0)
    if backward.size:
        raise ValueError(f"Invalid time {times[backward[0] + 1]} s. Must be above the one before.")
    return times


def _initial(initial: npt.ArrayLike, vertices: int) -> Array:
    """Return a copy of an initial temperature for every vertex, or raise a ValueError."""
    array = np.asarray(initial, dtype=np.float64)
    if array.shape not in {(), (vertices,)}:
        raise ValueError(
            f"Invalid shape {array.shape} of the initial temperature. "
            f"Must be a number or ({vertices},)."
        )
    bad = ~(np.isfinite(array) & (array > 0))
    if np.any(bad):
        raise ValueError(
            f"Invalid initial temperature {array[bad].flat[0]} K. Must be finite and above 0 K."
        )
    return np.array(np.broadcast_to(array, (vertices,)))
