"""Invalid shells, solids, exchanges and simulations of heat raise errors."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
import trimesh

from reproduction import heat

Array = npt.NDArray[np.float64]

AMBIENT = 295.0
SPOT = trimesh.creation.icosphere(0, 0.01)
BODY = heat.Shell(SPOT.vertices, SPOT.faces, 0.003, heat.GLASS)

TRIANGLE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
FACE = np.array([[0, 1, 2]])


@pytest.mark.parametrize(
    ("vertices", "faces", "thickness", "message"),
    [
        (TRIANGLE[:, :2], FACE, 1e-3, r"Invalid shape \(3, 2\) of vertices"),
        (TRIANGLE * np.nan, FACE, 1e-3, "Invalid vertex 0"),
        (TRIANGLE, FACE * 1.0, 1e-3, "Invalid type float64 of faces"),
        (TRIANGLE, FACE + 1, 1e-3, "Invalid vertex numbers 1 to 3"),
        (TRIANGLE, np.array([[0, 1, 1]]), 1e-3, "Invalid vertex 2: in no face"),
        (TRIANGLE * (1.0, 0.0, 0.0), FACE, 1e-3, "Invalid face 0 with vertices"),
        (TRIANGLE, np.array([[0, 1, 2], [2, 1, 0]]), 1e-3, "given 2 times"),
        (TRIANGLE, FACE, 0.0, "Invalid thickness 0.0 m"),
    ],
)
def test_invalid_shell(
    vertices: Array, faces: npt.NDArray[np.int64], thickness: float, message: str
) -> None:
    """An invalid mesh or thickness of a shell raises a ValueError with the reason."""
    with pytest.raises(ValueError, match=message):
        heat.Shell(vertices, faces, thickness, heat.GLASS)


def test_invalid_solid() -> None:
    """A solid has positive properties."""
    with pytest.raises(ValueError, match=r"Invalid density of a solid -1\.0"):
        heat.Solid(1.0, -1.0, 1.0)


@pytest.mark.parametrize(
    ("exchange", "message"),
    [
        (heat.Convection(-1.0, 300.0), "Invalid coefficient of convection -1.0 at 0 s"),
        (heat.Convection(1.0, np.ones(2)), r"Invalid shape \(2,\) of the temperature"),
        (heat.Convection(lambda time: 1.0 / (time < 0.1) - 1.0, 300.0), "coefficient .* inf"),
        (heat.Radiation(1.2, 300.0), r"Invalid emissivity 1.2 of radiation.* Must lie in \[0, 1\]"),
        (heat.Radiation(0.9, lambda time: 300.0 - 4e3 * time), "temperature of radiation -"),
        (heat.Heating(np.nan), "Invalid flux of heating nan"),
    ],
)
@pytest.mark.filterwarnings("ignore:divide by zero")
def test_invalid_exchange(exchange: heat.Exchange, message: str) -> None:
    """An exchange that is not physical, at any time, is an error that says when."""
    with pytest.raises(ValueError, match=message):
        heat.simulate(BODY, [0.0, 1.0], AMBIENT, [exchange])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda body: heat.simulate(body, [0.0, 0.0], 300.0), "Invalid time 0.0 s"),
        (lambda body: heat.simulate(body, [], 300.0), r"Invalid times of shape \(0,\)"),
        (lambda body: heat.simulate(body, [0.0], -1.0), "Invalid initial temperature -1.0 K"),
        (lambda body: heat.simulate(body, [0.0], [1.0]), r"Invalid shape \(1,\) of the initial"),
        (lambda body: heat.simulate(body, [0.0], 300.0, step=0.0), r"Invalid step \[s\] 0.0"),
    ],
)
def test_invalid_simulation(call: Callable[[heat.Shell], Array], message: str) -> None:
    """Invalid times, steps and temperatures of a simulation raise a ValueError."""
    with pytest.raises(ValueError, match=message):
        call(BODY)


def test_below_absolute_zero() -> None:
    """A constant cooling ends in an error, not in a negative temperature."""
    with pytest.raises(ArithmeticError, match=r"Invalid temperature -.* Must be above 0 K"):
        heat.simulate(BODY, [0.0, 1e5], AMBIENT, [heat.Heating(-100.0)], step=10.0)


def test_tolerance_below_rounding() -> None:
    """A stage that cannot reach its tolerance is an error."""
    with pytest.raises(ArithmeticError, match=r"No convergence at 29\.\d+ s: .* Must be below 1e-"):
        heat.simulate(BODY, [0.0, 100.0], 500.0, [heat.Radiation(0.9, AMBIENT)], tolerance=1e-30)
