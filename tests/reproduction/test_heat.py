"""Heat in shells against closed forms, one mechanism at a time, then together.

CJ is Carslaw, Jaeger (1959), Conduction of Heat in Solids, 2nd edition, Oxford. The tests print
the errors that they measure.
"""

import itertools
import time as clock
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.constants import Stefan_Boltzmann as SIGMA
from scipy.special import erfc

from reproduction import heat
from reproduction.heat._exchange import Balance
from reproduction.twins import surfaces

Array = npt.NDArray[np.float64]

THICKNESS = 0.003
AMBIENT = 295.0
CAPACITY = heat.GLASS.density * heat.GLASS.specific_heat * THICKNESS
ALPHA = heat.GLASS.conductivity / (heat.GLASS.density * heat.GLASS.specific_heat)  # [m^2/s]
SPOT = trimesh.creation.icosphere(0, 0.01)


def shell(surface: trimesh.Trimesh, solid: heat.Solid = heat.GLASS) -> heat.Shell:
    """A surface of 3 mm of a solid."""
    return heat.Shell(surface.vertices, surface.faces, THICKNESS, solid)


def strip(length: float, spacing: float) -> tuple[heat.Shell, Array, npt.NDArray[np.bool_]]:
    """A narrow strip of glass, the distance of its vertices from its left end, and that end."""
    surface = surfaces.plate(length, 2 * spacing, spacing)
    x = surface.vertices[:, 0] + length / 2
    return shell(surface), x, x < spacing / 2


def orders(errors: list[float]) -> Array:
    """Observed orders of convergence when a size is halved time after time."""
    return np.array([np.log2(coarse / fine) for coarse, fine in itertools.pairwise(errors)])


def report(errors: list[float]) -> str:
    """The errors and the orders between them, to be printed."""
    return " ".join(f"{error:.1e}" for error in errors) + f" orders {orders(errors).round(2)}"


def test_half_space_held() -> None:
    """A held edge warms a half-space by erfc(x / 2 sqrt(alpha t)) (CJ 2.4): within 0.1 %."""
    body, x, edge = strip(0.1, 0.0005)
    times = np.arange(0.0, 101.0, 10.0)
    held = heat.Convection(np.where(edge, 1e9, 0.0), AMBIENT + 40.0)
    found = heat.simulate(body, times, AMBIENT, [held], step=0.5)[2:]
    exact = AMBIENT + 40.0 * erfc(x / (2.0 * np.sqrt(ALPHA * times[2:, None])))
    error = np.abs(found - exact).max() / 40.0
    print(f"half-space, held: {error:.1e} of the step")
    assert error < 1e-3


def test_half_space_heated() -> None:
    """A constant flux into a half-space warms its face by 2 q sqrt(t / pi k rho c) (CJ 2.9)."""
    body, x, edge = strip(0.1, 0.0005)
    flux, times = 1000.0, np.arange(0.0, 101.0, 10.0)
    z = body.vertices[:, 2]
    length = np.where((z == z.min()) | (z == z.max()), 0.00025, 0.0005)
    given_heat = np.where(edge, flux * THICKNESS * length / body.area, 0.0)
    found = heat.simulate(body, times, AMBIENT, [heat.Heating(given_heat)], step=0.5)
    depth = np.sqrt(ALPHA * times[1:, None])
    ierfc = np.exp(-((x / (2 * depth)) ** 2)) / np.sqrt(np.pi) - x / (2 * depth) * erfc(
        x / (2 * depth)
    )
    exact = 2.0 * flux * depth / heat.GLASS.conductivity * ierfc
    error = np.abs(found[1:] - AMBIENT - exact).max() / exact.max()
    print(f"half-space, heated: {error:.1e} of the rise")
    assert error < 2e-3


@pytest.mark.parametrize("second", [0.0, 500.0])
def test_lumped_exponential(second: float) -> None:
    """Air outside and liquid inside pull to their weighted mean at the rate (h1 + h2) / rho c d."""
    sides = [heat.Convection(12.0, AMBIENT), heat.Convection(second, 350.0)]
    rate = (12.0 + second) / CAPACITY
    target = (12.0 * AMBIENT + second * 350.0) / (12.0 + second)
    times = np.linspace(0.0, 3.0 / rate, 31)
    found = heat.simulate(shell(SPOT), times, 320.0, sides, step=0.01 / rate)
    exact = target + (320.0 - target) * np.exp(-rate * times[:, None])
    error = np.abs(found - exact).max() / abs(320.0 - target)
    print(f"lumped exponential, second side {second:g} W/m2K: {error:.1e} of the step")
    assert error < 1e-5


def test_fluid_that_warms() -> None:
    """Behind a fluid that warms steadily the shell lags by rho c d / h times the rate."""
    fluid = heat.Convection(100.0, lambda time: AMBIENT + 0.5 * time)
    lag = CAPACITY / 100.0
    times = np.linspace(0.0, 400.0, 41)
    found = heat.simulate(shell(SPOT), times, AMBIENT, [fluid], step=1.0)
    exact = AMBIENT + 0.5 * (times - lag * (1.0 - np.exp(-times / lag)))[:, None]
    error = np.abs(found - exact).max()
    print(f"fluid that warms: {error:.1e} K of {np.ptp(exact):.0f} K")
    assert error < 1e-3


def cooling_time(temperature: Array, first: float, surroundings: float, emissivity: float) -> Array:
    """Time in which radiation cools from the first temperature (Bergman et al. 2011, eq. 5.18)."""

    def primitive(value: npt.ArrayLike) -> Array:
        ratio = np.asarray(value, dtype=np.float64) / surroundings
        return np.log(np.abs((1.0 + ratio) / (1.0 - ratio))) + 2.0 * np.arctan(ratio)

    unit = CAPACITY / (4.0 * emissivity * SIGMA * surroundings**3)
    return np.asarray(unit * (primitive(temperature) - primitive(first)))


def test_radiative_cooling() -> None:
    """From 700 K the exact T^4 takes the time of the closed form, not that of its tangent."""
    times = np.linspace(0.0, 1500.0, 31)
    found = heat.simulate(shell(SPOT), times, 700.0, [heat.Radiation(0.9, AMBIENT)], step=2.0)
    exact = cooling_time(found[1:, 0], 700.0, AMBIENT, 0.9)
    error = np.abs(exact / times[1:] - 1.0).max()
    print(f"radiative cooling: {error:.1e} of the time, to {found[-1, 0]:.1f} K")
    assert error < 5e-5


def test_radiative_balance() -> None:
    """A prescribed flux q is radiated by both sides: T^4 = T_s^4 + q / (2 eps sigma)."""
    sides = [heat.Radiation(0.9, AMBIENT), heat.Radiation(0.9, AMBIENT), heat.Heating(800.0)]
    found = heat.simulate(shell(SPOT), [0.0, 1e4, 2e4], AMBIENT, sides, step=200.0)[-1]
    exact = (AMBIENT**4 + 800.0 / (2.0 * 0.9 * SIGMA)) ** 0.25
    print(f"radiative balance: {np.abs(found - exact).max():.1e} K at {exact:.2f} K")
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-5)


def test_fin() -> None:
    """A held base and convection: cosh m(L - x) / cosh mL with m^2 = h / k d, insulated tip."""
    body, x, edge = strip(0.05, 0.0005)
    air, base = (
        heat.Convection(20.0, AMBIENT),
        heat.Convection(np.where(edge, 1e9, 0.0), AMBIENT + 40.0),
    )
    found = heat.simulate(body, [0.0, 1e4], AMBIENT, [air, base], step=100.0)[-1]
    rate = np.sqrt(20.0 / (heat.GLASS.conductivity * THICKNESS))
    exact = AMBIENT + 40.0 * np.cosh(rate * (0.05 - x)) / np.cosh(rate * 0.05)
    print(f"fin: {np.abs(found - exact).max() / 40.0:.1e} of the step")
    np.testing.assert_allclose(found, exact, rtol=0, atol=2e-3)


def mode_error(surface: trimesh.Trimesh, mode: Array, decay: float) -> tuple[float, float]:
    """Error of an eigenmode after one e-folding over its first size: rms, and the largest."""
    body = shell(surface)
    found = heat.simulate(body, [0.0, 1.0 / decay], AMBIENT + mode, step=0.005 / decay)[-1]
    error, share = found - AMBIENT - mode * np.exp(-1.0), body.area / body.area.sum()
    rms = np.sqrt(share @ error**2 / (share @ mode**2))
    return float(rms), float(np.abs(error).max() / np.abs(mode).max())


def test_order_in_space_on_a_plate() -> None:
    """Insulated edges: cos(pi x / a) cos(pi z / b) decays at alpha k^2; the error is O(h^2)."""
    errors = []
    for spacing in (0.01, 0.005, 0.0025):
        plate = surfaces.plate(0.1, 0.06, spacing)
        x, _, z = plate.vertices.T
        mode = 10.0 * np.cos(np.pi * (x / 0.1 + 0.5)) * np.cos(np.pi * z / 0.06)
        errors.append(mode_error(plate, mode, ALPHA * np.pi**2 * (0.1**-2 + 0.06**-2)))
    rms, largest = (list(column) for column in zip(*errors, strict=True))
    print("plate, rms:", report(rms), "largest:", report(largest))
    assert largest[-1] < 5e-3
    np.testing.assert_allclose(orders(rms), 2.0, rtol=0, atol=0.1)


@pytest.mark.parametrize("degree", [1, 2])
def test_order_in_space_on_a_sphere(degree: int) -> None:
    """A spherical harmonic decays at l (l + 1) alpha / R^2; the error is O(h^2)."""
    errors = []
    for subdivisions in (3, 4):
        ball = trimesh.creation.icosphere(subdivisions, 0.05)
        height = ball.vertices[:, 2] / 0.05
        mode = 10.0 * (height if degree == 1 else 1.5 * height**2 - 0.5)
        errors.append(mode_error(ball, mode, degree * (degree + 1) * ALPHA / 0.05**2))
    rms, largest = (list(column) for column in zip(*errors, strict=True))
    print(f"sphere, l = {degree}, rms:", report(rms), "largest:", report(largest))
    assert largest[-1] < 5e-3
    np.testing.assert_allclose(orders(rms), 2.0, rtol=0, atol=0.1)


def test_irregular_triangles() -> None:
    """A tube of needles conducts along its axis as a strip does: within 0.5 %."""
    angle, level = np.meshgrid(np.arange(60) * np.pi / 30, np.linspace(0.0, 0.1, 61), indexing="ij")
    number = np.arange(60 * 61).reshape(60, 61)
    beside = np.roll(number, -1, axis=0)
    corners = [number[:, :-1], beside[:, :-1], beside[:, 1:], number[:, 1:]]
    quads = np.stack([c.ravel() for c in corners], axis=1)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    skew = level + 0.03 * np.sin(angle) * np.sin(np.pi * level / 0.1)
    place = np.stack([0.01 * np.cos(angle), 0.01 * np.sin(angle), skew], axis=-1).reshape(-1, 3)
    tube = trimesh.Trimesh(place, faces, process=False)
    _, error = mode_error(
        tube, 10.0 * np.cos(np.pi * place[:, 2] / 0.1), ALPHA * (np.pi / 0.1) ** 2
    )
    print(f"tube of skewed triangles: {error:.1e}")
    assert error < 5e-3


def everything(time: float) -> Array:
    """A coefficient of convection that changes smoothly in time, from vertex to vertex."""
    return np.asarray(60.0 + 50.0 * np.sin(0.02 * time + np.arange(len(SPOT.vertices))))


def test_order_in_time() -> None:
    """All terms together: the error falls with the square of the step."""
    terms: list[heat.Exchange] = [
        heat.Convection(everything, lambda time: 330.0 + 20.0 * np.cos(0.03 * time)),
        heat.Radiation(0.9, AMBIENT),
        heat.Heating(lambda time: 500.0 * np.sin(0.01 * time) ** 2),
        heat.Convection(1e9 * np.eye(len(SPOT.vertices))[0], lambda time: 400.0 - 0.1 * time),
    ]
    ends = [
        heat.simulate(shell(SPOT), [0.0, 200.0], 400.0, terms, step=s, tolerance=1e-10)
        for s in (20.0, 10.0, 5.0, 2.5, 0.1)
    ]
    errors = [float(np.abs(end[-1] - ends[-1][-1]).max()) for end in ends[:-1]]
    print("time [K]:", report(errors))
    np.testing.assert_allclose(orders(errors), 2.0, rtol=0, atol=0.15)


def test_stiff_step_is_damped() -> None:
    """A step 1,000 times the time constant lands on the fluid's temperature: L-stable."""
    fluid = heat.Convection(1000.0, 350.0)
    long = 1000.0 * CAPACITY / 1000.0
    found = heat.simulate(shell(SPOT), [0.0, long], AMBIENT, [fluid])[-1]
    print(f"stiff: {np.abs(found - 350.0).max():.1e} K of 55 K")
    np.testing.assert_allclose(found, 350.0, rtol=0, atol=0.5)


def test_insulated_body_keeps_its_heat() -> None:
    """Conduction conserves heat: the sum of capacity times temperature is constant."""
    glass = surfaces.wineglass(0.004)
    body = shell(glass)
    first = AMBIENT + 40.0 * (glass.vertices[:, 2] > 0.1)
    found = heat.simulate(body, np.arange(0.0, 60.0, 5.0), first)
    change = np.abs(found @ body.capacity / (first @ body.capacity) - 1.0).max()
    print(f"insulated body: {change:.1e} of its heat")
    assert change < 1e-12


def test_given_heat_is_kept() -> None:
    """An insulated body keeps all the heat of a prescribed flux."""
    body = shell(trimesh.creation.icosphere(3, 0.02))
    flux = np.random.default_rng(1).uniform(0.0, 1000.0, len(body.vertices))
    found = heat.simulate(body, [0.0, 5.0, 30.0], AMBIENT, [heat.Heating(flux)], step=1.0)
    np.testing.assert_allclose(
        (found - AMBIENT) @ body.capacity,
        np.array([0.0, 5.0, 30.0]) * (flux @ body.area),
        rtol=1e-9,
    )


def test_no_overshoot() -> None:
    """Without sources a step in temperature spreads between its first extremes."""
    glass = surfaces.wineglass(0.004)
    first = AMBIENT + 40.0 * (glass.vertices[:, 2] > 0.1)
    found = heat.simulate(shell(glass), [0.0, 0.01, 0.1, 1.0, 10.0], first, step=10.0)
    print(f"extremes: {found.min() - AMBIENT:.1e} and {found.max() - AMBIENT - 40.0:.1e} K beyond")
    assert found.min() > AMBIENT - 1e-9
    assert found.max() < AMBIENT + 40.0 + 1e-9


def test_unevenly_spaced_times() -> None:
    """The output times select samples, and do not change the solution."""
    air = [heat.Convection(50.0, 350.0), heat.Radiation(0.9, AMBIENT)]
    even = heat.simulate(shell(SPOT), np.arange(0.0, 101.0), AMBIENT, air, step=0.5)
    uneven = heat.simulate(shell(SPOT), [0.0, 3.0, 10.0, 100.0], AMBIENT, air, step=0.5)
    np.testing.assert_allclose(uneven, even[[0, 3, 10, 100]], rtol=0, atol=1e-4)


def test_functions_are_asked_within_the_times() -> None:
    """Functions of time are called between the first and the last time, both included."""
    asked: list[float] = []

    def coefficient(time: float) -> float:
        asked.append(time)
        return 10.0

    air = heat.Convection(coefficient, 350.0)
    heat.simulate(shell(SPOT), np.arange(7) * 0.1, AMBIENT, [air], step=0.03)
    assert (min(asked), max(asked)) == (0.0, 6 * 0.1)


def test_coefficient_that_jumps() -> None:
    """The factorisation follows a liquid that arrives: each side of the jump is exponential."""
    liquid = heat.Convection(lambda time: 1.0 if time < 10.0 else 2000.0, 350.0)
    times = np.array([0.0, 10.0, 20.0])
    found = heat.simulate(shell(SPOT), times, AMBIENT, [liquid], step=0.01)[:, 0]
    slow, fast = np.exp(-np.diff(times) * (1.0, 2000.0) / CAPACITY)
    exact = 350.0 - 55.0 * np.array([1.0, slow, slow * fast])
    print(f"jump: {np.abs(found - exact).max():.1e} K of 55 K")
    np.testing.assert_allclose(found, exact, rtol=0, atol=0.1)


@given(st.tuples(*[st.floats(0.0, 1e3)] * 2), st.floats(0.0, 1.0), st.floats(150.0, 900.0))
@settings(max_examples=50)
def test_slope_of_the_flux(terms: tuple[float, float], emissivity: float, kelvin: float) -> None:
    """The slope is the derivative of the flux with the temperature, sign changed."""
    balance = Balance(*(np.array([value]) for value in (*terms, SIGMA * emissivity)))
    here = np.array([kelvin])
    difference = (balance.flux(here - 0.01) - balance.flux(here + 0.01)) / 0.02
    np.testing.assert_allclose(balance.slope(here), difference, rtol=1e-6, atol=1e-6)


def test_area_and_stiffness() -> None:
    """Areas add up to the surface; a uniform shell conducts nothing, a warmer vertex loses heat."""
    glass = surfaces.wineglass(0.006)
    body = shell(glass)
    assert body.area.sum() == pytest.approx(glass.area, rel=1e-12)
    uniform = np.full(len(glass.vertices), AMBIENT)
    np.testing.assert_allclose(body.stiffness @ uniform, 0.0, rtol=0, atol=1e-9)
    assert body.stiffness.diagonal().min() > 0


@pytest.mark.data
def test_bunny(mirror: Path) -> None:
    """A scanned mesh with holes and unused vertices warms as a lumped body does."""
    scan = trimesh.load_mesh(mirror / "meshes" / "stanford-bunny.obj", process=False)
    scan.remove_unreferenced_vertices()
    body = shell(scan)
    begin = clock.perf_counter()
    times = np.arange(0.0, 2.0, 0.1)
    found = heat.simulate(body, times, AMBIENT, [heat.Convection(100.0, 350.0)])
    print(f"bunny: {(clock.perf_counter() - begin) / times.size:.3f} s a frame")
    exact = 350.0 - 55.0 * np.exp(-100.0 * times / CAPACITY)
    np.testing.assert_allclose(found, exact[:, None] * np.ones_like(found), rtol=0, atol=1e-4)


@pytest.mark.bench
def test_cost() -> None:
    """A surface of 5,000 vertices takes about a second for 350 frames."""
    glass = surfaces.wineglass()
    terms = [heat.Convection(100.0, 350.0), heat.Radiation(0.9, AMBIENT)]
    begin = clock.perf_counter()
    heat.simulate(shell(glass), np.arange(350) / 10.0, AMBIENT, terms)
    seconds = clock.perf_counter() - begin
    print(f"{len(glass.vertices)} vertices, 350 frames: {seconds:.2f} s")
    assert seconds < 5.0
