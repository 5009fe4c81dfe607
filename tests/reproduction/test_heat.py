"""Heat in shells against closed forms, one mechanism at a time, then together; and refusals.

CJ is Carslaw, Jaeger (1959), Conduction of Heat in Solids, 2nd edition, Oxford.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import trimesh
from refused import refused
from scipy.constants import Stefan_Boltzmann as SIGMA
from scipy.special import erfc

from reproduction import heat
from reproduction.twins import surfaces

Array = npt.NDArray[np.float64]

THICKNESS, AMBIENT, FILM = 0.003, 295.0, 1e9  # [m], [K]; a coefficient that holds [W/m2K]
CAPACITY = heat.GLASS.density * heat.GLASS.specific_heat * THICKNESS
ALPHA = heat.GLASS.conductivity / (heat.GLASS.density * heat.GLASS.specific_heat)  # [m^2/s]
SPOT = trimesh.creation.icosphere(0, 0.01)


def shell(surface: trimesh.Trimesh) -> heat.Shell:
    """A surface of 3 mm of glass."""
    return heat.Shell(surface, THICKNESS, heat.GLASS)


def spot(
    times: npt.ArrayLike, first: float, terms: Sequence[heat.Exchange], **options: float
) -> Array:
    """Temperature (time) of a spot that does not conduct."""
    return heat.simulate(shell(SPOT), np.asarray(times), first, terms, **options)[:, 0]


def strip(length: float, spacing: float) -> tuple[heat.Shell, Array, npt.NDArray[np.bool_]]:
    """A narrow strip of glass, the distance of its vertices from its left end, and that end."""
    surface = surfaces.plate(length, 2 * spacing, spacing)
    x = surface.vertices[:, 0] + length / 2
    return shell(surface), x, x < spacing / 2


def orders(errors: Sequence[float]) -> Array:
    """Observed orders of convergence when a size is halved time after time."""
    return np.array([np.log2(coarse / fine) for coarse, fine in itertools.pairwise(errors)])


def test_half_space() -> None:
    """A held edge warms by erfc(x / 2 sqrt(alpha t)) (CJ 2.4), a flux by 2 q sqrt(t / pi k rho c)
    (CJ 2.9): within 0.1 % and 0.2 %.
    """
    body, x, edge = strip(0.1, 0.0005)
    times, flux = np.arange(0.0, 101.0, 10.0), 1000.0
    held = heat.Convection(np.where(edge, FILM, 0.0), AMBIENT + 40.0)
    warmed = heat.simulate(body, times, AMBIENT, [held], step=0.5)[2:]
    exact = AMBIENT + 40.0 * erfc(x / (2.0 * np.sqrt(ALPHA * times[2:, None])))
    np.testing.assert_allclose(warmed, exact, rtol=0, atol=1e-3 * 40.0)  # K
    z = body.mesh.vertices[:, 2]
    length = np.where((z == z.min()) | (z == z.max()), 0.00025, 0.0005)
    inflow = heat.Heating(np.where(edge, flux * THICKNESS * length / body.area, 0.0))
    warmed = heat.simulate(body, times, AMBIENT, [inflow], step=0.5)[1:]
    depth = np.sqrt(ALPHA * times[1:, None])
    scaled = x / (2 * depth)
    ierfc = np.exp(-(scaled**2)) / np.sqrt(np.pi) - scaled * erfc(scaled)
    exact = 2.0 * flux * depth / heat.GLASS.conductivity * ierfc
    np.testing.assert_allclose(warmed - AMBIENT, exact, rtol=0, atol=2e-3 * exact.max())


@pytest.mark.parametrize("second", [0.0, 500.0])
def test_lumped_exponential(second: float) -> None:
    """Air outside and liquid inside pull to their weighted mean at the rate (h1 + h2) / rho c d."""
    sides = [heat.Convection(12.0, AMBIENT), heat.Convection(second, 350.0)]
    rate = (12.0 + second) / CAPACITY
    target = (12.0 * AMBIENT + second * 350.0) / (12.0 + second)
    times = np.linspace(0.0, 3.0 / rate, 31)
    exact = target + (320.0 - target) * np.exp(-rate * times)
    cooled = spot(times, 320.0, sides, step=0.01 / rate)
    np.testing.assert_allclose(cooled, exact, rtol=0, atol=1e-5 * abs(320.0 - target))


def cooling_time(temperature: Array, first: float, surroundings: float, emissivity: float) -> Array:
    """Time in which radiation cools from the first temperature (Bergman et al. 2011, eq. 5.18)."""

    def primitive(value: npt.ArrayLike) -> Array:
        ratio = np.asarray(value, dtype=np.float64) / surroundings
        return np.log(np.abs((1.0 + ratio) / (1.0 - ratio))) + 2.0 * np.arctan(ratio)

    unit = CAPACITY / (4.0 * emissivity * SIGMA * surroundings**3)
    return np.asarray(unit * (primitive(temperature) - primitive(first)))


def test_radiation() -> None:
    """T^4 takes the time of the closed form; a flux q ends at T_s^4 + q / (2 eps sigma)."""
    times, side = np.linspace(0.0, 1500.0, 31), heat.Radiation(0.9, AMBIENT)
    cooled = spot(times, 700.0, [side], step=2.0)
    exact = cooling_time(cooled[1:], 700.0, AMBIENT, 0.9)
    np.testing.assert_allclose(exact / times[1:], 1.0, rtol=0, atol=5e-5)
    level = spot([0.0, 1e4, 2e4], AMBIENT, [side, side, heat.Heating(800.0)], step=200.0)[-1]
    balance = (AMBIENT**4 + 800.0 / (2.0 * 0.9 * SIGMA)) ** 0.25
    np.testing.assert_allclose(level, balance, rtol=0, atol=1e-5)  # K


def mode_error(surface: trimesh.Trimesh, mode: Array, decay: float) -> tuple[float, float]:
    """Error of an eigenmode after one e-folding over its first size: rms, and the largest."""
    body = shell(surface)
    last = heat.simulate(body, [0.0, 1.0 / decay], AMBIENT + mode, step=0.005 / decay)[-1]
    error, share = last - AMBIENT - mode * np.exp(-1.0), body.area / body.area.sum()
    rms = np.sqrt(share @ error**2 / (share @ mode**2))
    return float(rms), float(np.abs(error).max() / np.abs(mode).max())


def plate_mode(spacing: float) -> tuple[float, float]:
    """Of cos(pi x / a) cos(pi z / b) on a plate with insulated edges, which decays at alpha k^2."""
    plate = surfaces.plate(0.1, 0.06, spacing)
    x, _, z = plate.vertices.T
    mode = 10.0 * np.cos(np.pi * (x / 0.1 + 0.5)) * np.cos(np.pi * z / 0.06)
    return mode_error(plate, mode, ALPHA * np.pi**2 * (0.1**-2 + 0.06**-2))


def ball_mode(degree: int, subdivisions: int) -> tuple[float, float]:
    """Of a spherical harmonic, which decays at l (l + 1) alpha / R^2."""
    ball = trimesh.creation.icosphere(subdivisions, 0.05)
    height = ball.vertices[:, 2] / 0.05
    mode = 10.0 * (height if degree == 1 else 1.5 * height**2 - 0.5)
    return mode_error(ball, mode, degree * (degree + 1) * ALPHA / 0.05**2)


@pytest.mark.parametrize(
    "errors",
    [
        lambda: [plate_mode(spacing) for spacing in (0.01, 0.005, 0.0025)],
        lambda: [ball_mode(1, subdivisions) for subdivisions in (3, 4)],
        lambda: [ball_mode(2, subdivisions) for subdivisions in (3, 4)],
    ],
    ids=["plate", "sphere, l = 1", "sphere, l = 2"],
)
def test_order_in_space(errors: Callable[[], list[tuple[float, float]]]) -> None:
    """The error of an eigenmode is O(h^2), and at last below 0.5 %."""
    rms, largest = zip(*errors(), strict=True)
    assert largest[-1] < 5e-3
    np.testing.assert_allclose(orders(rms), 2.0, rtol=0, atol=0.1)


def test_order_in_time() -> None:
    """All terms together: the error falls with the square of the step."""
    number = np.arange(len(SPOT.vertices))
    terms: list[heat.Exchange] = [
        heat.Convection(
            lambda time: np.asarray(60.0 + 50.0 * np.sin(0.02 * time + number)),
            lambda time: 330.0 + 20.0 * np.cos(0.03 * time),
        ),
        heat.Radiation(0.9, AMBIENT),
        heat.Heating(lambda time: 500.0 * np.sin(0.01 * time) ** 2),
        heat.Convection(FILM * np.eye(len(SPOT.vertices))[0], lambda time: 400.0 - 0.1 * time),
    ]
    ends = [
        heat.simulate(shell(SPOT), [0.0, 200.0], 400.0, terms, step=s, tolerance=1e-10)[-1]
        for s in (20.0, 10.0, 5.0, 2.5, 0.1)
    ]
    errors = [float(np.abs(end - ends[-1]).max()) for end in ends[:-1]]
    np.testing.assert_allclose(orders(errors), 2.0, rtol=0, atol=0.15)


def test_stiff_step_is_damped() -> None:
    """A step 1,000 times the time constant lands on the fluid's temperature: L-stable."""
    last = spot([0.0, CAPACITY], AMBIENT, [heat.Convection(1000.0, 350.0)])[-1]
    np.testing.assert_allclose(last, 350.0, rtol=0, atol=0.5)


def test_heat_is_kept() -> None:
    """Conduction conserves heat and spreads a step between its extremes; a flux is kept as well."""
    glass = surfaces.vessel(surfaces.WINEGLASS_PROFILE, 0.004)
    body, first = shell(glass), AMBIENT + 40.0 * (glass.vertices[:, 2] > 0.1)
    spread = heat.simulate(body, [0.0, 0.01, 0.1, 1.0, 10.0, 60.0], first, step=10.0)
    np.testing.assert_allclose(spread @ body.capacity, first @ body.capacity, rtol=1e-12)
    assert spread.min() > AMBIENT - 1e-9
    assert spread.max() < AMBIENT + 40.0 + 1e-9
    body = shell(trimesh.creation.icosphere(3, 0.02))
    flux = np.random.default_rng(1).uniform(0.0, 1000.0, len(body.mesh.vertices))
    warmed = heat.simulate(body, [0.0, 5.0, 30.0], AMBIENT, [heat.Heating(flux)], step=1.0)
    gained, expected = (warmed - AMBIENT) @ body.capacity, flux @ body.area
    np.testing.assert_allclose(gained, np.array([0.0, 5.0, 30.0]) * expected, rtol=1e-9)


def test_unevenly_spaced_times() -> None:
    """The times select samples, and change no solution; functions are called within them alone."""
    called: list[float] = []

    def coefficient(time: float) -> float:
        called.append(time)
        return 50.0

    air = (heat.Convection(coefficient, 350.0), heat.Radiation(0.9, AMBIENT))
    even, uneven = (
        spot(times, AMBIENT, air, step=0.5) for times in (np.arange(101.0), [0.0, 3.0, 10.0, 100.0])
    )
    np.testing.assert_allclose(uneven, even[[0, 3, 10, 100]], rtol=0, atol=1e-4)
    assert (min(called), max(called)) == (0.0, 100.0)


TRIANGLE, FACE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), [[0, 1, 2]]


def bent(vertices: Array, faces: Any, thickness: float = 1e-3) -> Callable[[], object]:
    """Shell of some vertices and faces."""
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    return lambda: heat.Shell(mesh, thickness, heat.GLASS)


def exchanging(term: heat.Exchange) -> Callable[[], object]:
    """One second of an exchange."""
    return lambda: spot([0.0, 1.0], AMBIENT, [term])


test_what_is_not_physical = refused(
    lambda call: call(),
    [
        (bent(TRIANGLE * np.nan, FACE), "Invalid vertex 0 that is not fin"),
        (bent(TRIANGLE, [[0, 1, 1]]), "Invalid vertex 2 of no face"),
        (bent(TRIANGLE * (1.0, 0.0, 0.0), FACE), "Invalid face 0 without an area"),
        (bent(TRIANGLE, [[0, 1, 2], [2, 1, 0]]), "Invalid face 1, as an earlier one"),
        (bent(TRIANGLE, FACE, 0.0), r"Invalid thickness \[m\] of a shell 0.0"),
        (exchanging(heat.Convection(-1.0, 300.0)), "coefficient of convection -1.0 at 0 s"),
        (exchanging(heat.Convection(1.0, np.ones(2))), r"Invalid shape \(2,\) of the temperature"),
        (exchanging(heat.Convection(lambda t: np.inf if t > 0.1 else 0.0, 300.0)), "coef.* inf"),
        (exchanging(heat.Radiation(1.2, 300.0)), r"emissivity of radiation 1.2.* in \[0, 1\]"),
        (exchanging(heat.Radiation(0.9, lambda t: 300.0 - 4e3 * t)), "temperature of radiation -"),
        (exchanging(heat.Heating(np.nan)), "Invalid flux of heating nan"),
        (lambda: heat.Solid(1.0, -1.0, 1.0), r"Invalid density of a solid -1\.0"),
        (lambda: spot([0.0, 0.0], 300.0, []), "Invalid time 0.0 s"),
        (lambda: spot([], 300.0, []), r"Invalid times of shape \(0,\)"),
        (lambda: spot([0.0], -1.0, []), "Invalid initial temperature -1.0"),
        (lambda: heat.simulate(shell(SPOT), [0.0], [1.0]), r"Invalid shape \(1,\) of the initial"),
        (lambda: spot([0.0], 300.0, [], step=0.0), r"Invalid step \[s\] 0.0"),
        (
            lambda: spot([0.0, 1e5], AMBIENT, [heat.Heating(-100.0)], step=10.0),
            r"Invalid temperature -.* Must be above 0 K",  # and no negative temperature
        ),
        (
            lambda: spot([0.0, 100.0], 500.0, [heat.Radiation(0.9, AMBIENT)], tolerance=1e-30),
            r"No convergence at 29\.\d+ s: .* Must be below 1e-",
        ),
    ],
    error=(ValueError, ArithmeticError),
)
