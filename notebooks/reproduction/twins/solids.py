"""A bunny among moving toys."""

from typing import Final, cast

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from reproduction import heat
from reproduction.twins import surfaces
from reproduction.twins.people import hand
from reproduction.twins.props import toy
from reproduction.twins.rays import Array, Camera, vertex_normals
from reproduction.twins.stage import AMBIENT, Capture, Stage, passers_by, since, table
from reproduction.twins.surroundings import Actor, Motion, Pose, gliding

EMISSIVITY: Final = 0.9
"""Total hemispherical emissivity of the bunny [1], for its radiation alone."""
AIR: Final = 6.0
"""Coefficient to still air [W m^-2 K^-1]; 2 to 25 for free convection in gases, table 1.1 of
Bergman et al. (2011), Fundamentals of Heat and Mass Transfer."""

BUNNY_HEIGHT: Final = 0.15
"""Height of the bunny on the table [m]."""
BUNNY_WALL: Final = (0.0015, heat.CERAMIC)
"""Thickness [m] and solid of the bunny, a thin shell."""
LAMP_FLUX: Final = 3000.0
"""Flux of the lamp that is absorbed where the surface faces it [W m^-2]."""
LAMP_TOWARDS: Final = (-1.0, -0.8, 1.0)
"""Direction to the lamp, of any length."""
LAMP_START, LAMP_RISE = -2.0, 2.0
"""Time at which the lamp is switched on, and its time constant [s]."""


def bunny(
    capture: Capture, rng: np.random.Generator, *, scan: trimesh.Trimesh | None = None
) -> Stage:
    """The Stanford bunny, which looks to the left, or a built-in rabbit, which looks at the camera.

    It is heated by a lamp. A car runs to and fro, a toy is flown about by a hand, and two people
    walk near. A scan is y up, seen along -z, looking to negative x, in any unit; without one, the
    `rabbit` is taken.
    """
    mesh = rabbit() if scan is None else _stood(scan)
    towards = np.asarray(LAMP_TOWARDS) / np.linalg.norm(LAMP_TOWARDS)
    facing = np.maximum(vertex_normals(mesh) @ towards, 0.0)

    def flux(time: float) -> Array:
        on = -np.expm1(-max(time - LAMP_START, 0.0) / LAMP_RISE)
        return np.asarray(LAMP_FLUX * on * facing)

    exchanges = [
        heat.Heating(flux),
        heat.Convection(AIR, AMBIENT),
        heat.Radiation(EMISSIVITY, AMBIENT),
    ]
    return Stage(
        "bunny",
        mesh,
        since(LAMP_START, mesh, BUNNY_WALL, capture.time, exchanges),
        Camera((0.0, -0.54, 0.36), (0.0, 0.0, 0.07), capture.shape),
        [table(), *_toys(capture.time, rng), *passers_by(capture.time, rng)],
    )


def _stood(scan: trimesh.Trimesh) -> trimesh.Trimesh:
    """A scan (y up) on the table, z up, its z towards the camera, as high as the bunny."""
    turned = surfaces.moved(scan, Rotation.from_euler("x", 90.0, degrees=True))
    turned.remove_unreferenced_vertices()
    low, high = turned.bounds
    scale = BUNNY_HEIGHT / float(high[2] - low[2])
    foot = np.array([(low[0] + high[0]) / 2.0, (low[1] + high[1]) / 2.0, low[2]])
    return surfaces.moved(turned, translation=-scale * foot, scale=scale)


LANE: Final = -0.24
"""y of the lane of the car [m]."""
LANE_HALF: Final = 0.45
"""How far it goes to either side [m]."""
FLIGHT: Final = ((-0.40, -0.35, 0.30), (0.40, -0.05, 0.45))
"""Lowest and highest x, y and z between which a toy is flown about, above the line of sight [m]."""


def _toys(time: Array, rng: np.random.Generator) -> list[Actor]:
    """A car that runs to and fro on the table, and a toy that a hand flies about above it."""
    flight = _flown(time, rng)
    hold = Pose(Rotation.from_euler("x", 180.0, degrees=True), (0.0, 0.03, 0.16))
    return [
        toy(_to_and_fro(time, rng)),
        toy(flight, body=AMBIENT + 4.0),
        *hand(lambda now: flight(now) @ hold),
    ]


def _to_and_fro(time: Array, rng: np.random.Generator) -> Motion:
    times, places, side = [float(time[0])], [(-LANE_HALF, LANE, 0.0)], -1.0
    while times[-1] < time[-1]:
        side = -side
        start = times[-1] + rng.uniform(0.2, 1.5)
        times += [start, start + 2.0 * LANE_HALF / rng.uniform(0.25, 0.6)]
        places += [places[-1], (side * LANE_HALF, LANE, 0.0)]
    return gliding(times, places)


def _flown(time: Array, rng: np.random.Generator) -> Motion:
    steps = rng.uniform(0.6, 1.8, 2 + int((time[-1] - time[0]) / 0.6))
    times = time[0] + np.concatenate([[0.0], np.cumsum(steps)])
    return gliding(times, rng.uniform(*FLIGHT, (times.size, 3)))


RABBIT: Final = (
    ((0.0, 0.012, 0.048), (0.042, 0.055, 0.048)),
    ((0.0, -0.042, 0.088), (0.026, 0.030, 0.026)),
    ((-0.014, -0.030, 0.124), (0.008, 0.006, 0.026)),
    ((0.014, -0.030, 0.124), (0.008, 0.006, 0.026)),
    ((-0.022, -0.050, 0.012), (0.013, 0.022, 0.012)),
    ((0.022, -0.050, 0.012), (0.013, 0.022, 0.012)),
)
"""Middle and semi-axes of the parts of a rabbit: body, head, ears, feet [m]."""


def rabbit(spacing: float = 0.004) -> trimesh.Trimesh:
    """Rabbit of six ellipsoids that sits on the plane z = 0 and faces negative y.

    The parts are side by side; no heat flows from one to another.
    """
    parts = [surfaces.ellipsoid(semi_axes, middle, spacing) for middle, semi_axes in RABBIT]
    return cast("trimesh.Trimesh", trimesh.util.concatenate(parts))
