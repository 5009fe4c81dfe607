"""Heated bodies, near which people or toys move: wineglass and coffee pot being filled, a bunny."""

from dataclasses import dataclass
from typing import Final, cast

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from dbthermal._arrays import Array
from reproduction import heat
from reproduction.twins import surfaces
from reproduction.twins.people import hand, toy
from reproduction.twins.rays import Camera, Point, vertex_normals
from reproduction.twins.stage import AMBIENT, Capture, Stage, passers_by, since, table
from reproduction.twins.surroundings import Actor, Motion, Pose, gliding


@dataclass(frozen=True)
class Vessel:
    r"""A glass vessel, and how it is filled.

    The wall is a thin shell: below the level of the drink, heat passes from the drink through half
    of the wall to its middle, :math:`1 / h = 1 / h_\mathrm{drink} + d / 2k`; above it from warm,
    moist air; outside it goes to air and by radiation to the room.
    """

    name: str
    profile: surfaces.Profile  # of the outer wall [m]
    spacing: float  # distance of the mesh's vertices [m]
    view: tuple[Point, Point]  # position and target of the first camera [m]

    # Temperature of the drink when it is poured [K]; those of the two vessels below are chosen so
    # that the thermocouple peaks where the paper's did: 63.6 and 63.1 degrees Celsius.
    drink: float
    bottom: float  # height of the bottom [m]
    level: float  # height of the drink's surface when all is poured [m]
    thickness: float  # of the wall [m]
    solid: heat.Solid  # of the wall
    probe: tuple[float, float]  # of the thermocouple: height [m], angle from the camera [degrees]
    start: float = -3.0  # of the pouring [s]
    duration: float = 8.0  # of the pouring [s]
    ripple: float = 0.012  # height over which the rising surface laps the wall [m]
    cooling: float = 2000.0  # time constant of the drink [s]; a cup loses some 1 K a minute
    # Coefficients [W m^-2 K^-1], by table 1.1 of Bergman et al. (2011), Fundamentals of Heat and
    # Mass Transfer: free convection in liquids 50 to 1000, in gases 2 to 25.
    wet: float = 400.0  # from the drink to the wall
    moist: float = 10.0  # from the air inside, above the drink
    moist_temperature: float = 308.15  # of that air [K]
    air: float = 6.0  # to still air outside
    emissivity: float = 0.9  # total hemispherical, of glass, for its radiation alone [1]

    def _poured(self, time: float) -> float:
        """Share of the drink that is poured at a time [s]."""
        return float(np.clip((time - self.start) / self.duration, 0.0, 1.0))

    def wetted(self, height: Array, time: float) -> Array:
        """Share of the time that the drink touches the wall at some heights [m], in [0, 1]."""
        lowest = self.bottom - 3.0 * self.ripple
        level = lowest + self._poured(time) * (self.level - lowest)
        return np.asarray(0.5 * (1.0 + np.tanh((level - height) / self.ripple)))

    def exchanges(self, mesh: trimesh.Trimesh) -> list[heat.Exchange]:
        """Exchanges of each vertex of the wall, inside and outside."""
        height = np.asarray(mesh.vertices)[:, 2]
        hollow = height >= self.bottom
        wall = self.thickness / (2.0 * self.solid.conductivity)
        conductance = 1.0 / (1.0 / self.wet + wall)

        def wet(time: float) -> Array:
            return conductance * hollow * self.wetted(height, time)

        def dry(time: float) -> Array:
            return self.moist * hollow * (1.0 - self.wetted(height, time))

        def drink(time: float) -> float:
            remaining = np.exp(-max(time - self.start, 0.0) / self.cooling)
            return float(AMBIENT + (self.drink - AMBIENT) * remaining)

        def moist(time: float) -> float:
            return AMBIENT + (self.moist_temperature - AMBIENT) * self._poured(time)

        return [
            heat.Convection(wet, drink),
            heat.Convection(dry, moist),
            heat.Convection(self.air, AMBIENT),
            heat.Radiation(self.emissivity, AMBIENT),
        ]


WINEGLASS: Final = Vessel(
    "wineglass",
    surfaces.WINEGLASS_PROFILE,
    spacing=0.003,
    view=((0.0, -0.55, 0.165), (0.0, 0.0, 0.145)),
    drink=340.09,
    bottom=0.096,
    level=0.175,
    thickness=0.0015,
    solid=heat.GLASS,
    probe=(0.152, -12.0),
)
"""A wineglass with a wall of 1.5 mm."""

COFFEE_POT: Final = Vessel(
    "coffee_pot",
    surfaces.COFFEE_POT_PROFILE,
    spacing=0.004,
    view=((0.0, -0.65, 0.11), (0.0, 0.0, 0.08)),
    drink=342.11,
    bottom=0.0,
    level=0.110,
    thickness=0.0022,
    solid=heat.BOROSILICATE,
    probe=(0.050, 10.0),
)
"""A coffee pot of borosilicate glass with a wall of 2.2 mm."""


def filled(capture: Capture, rng: np.random.Generator, vessel: Vessel) -> Stage:
    """Vessel on a table that is being filled, with two people walking near."""
    mesh = surfaces.vessel(vessel.profile, vessel.spacing)
    wall, camera = (vessel.thickness, vessel.solid), Camera(*vessel.view, capture.shape)
    warm = since(vessel.start, mesh, wall, capture.time, vessel.exchanges(mesh))
    actors, probe = [table(), *passers_by(capture.time, rng)], surfaces.on_wall(mesh, *vessel.probe)
    return Stage(vessel.name, mesh, warm, camera, actors, [probe])


EMISSIVITY: Final = 0.9  # total hemispherical emissivity of the bunny [1], for its radiation alone
AIR: Final = 6.0
"""Coefficient to still air [W m^-2 K^-1]; 2 to 25 for free convection in gases, table 1.1 of
Bergman et al. (2011), Fundamentals of Heat and Mass Transfer."""

BUNNY_HEIGHT: Final = 0.15  # height of the bunny on the table [m]
BUNNY_WALL: Final = (0.0015, heat.CERAMIC)  # thickness [m] and solid of the bunny, a thin shell
LAMP_FLUX: Final = 3000.0  # flux of the lamp that is absorbed where the surface faces it [W m^-2]
LAMP_TOWARDS: Final = (-1.0, -0.8, 1.0)  # direction to the lamp, of any length
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

    room = (heat.Convection(AIR, AMBIENT), heat.Radiation(EMISSIVITY, AMBIENT))
    warm = since(LAMP_START, mesh, BUNNY_WALL, capture.time, [heat.Heating(flux), *room])
    camera = Camera((0.0, -0.54, 0.36), (0.0, 0.0, 0.07), capture.shape)
    actors = [table(), *_toys(capture.time, rng), *passers_by(capture.time, rng)]
    return Stage("bunny", mesh, warm, camera, actors)


def _stood(scan: trimesh.Trimesh) -> trimesh.Trimesh:
    """A scan (y up) on the table, z up, its z towards the camera, as high as the bunny."""
    turned = surfaces.moved(scan, Rotation.from_euler("x", 90.0, degrees=True))
    turned.remove_unreferenced_vertices()
    low, high = turned.bounds
    scale = BUNNY_HEIGHT / float(high[2] - low[2])
    foot = np.array([(low[0] + high[0]) / 2.0, (low[1] + high[1]) / 2.0, low[2]])
    return surfaces.moved(turned, translation=-scale * foot, scale=scale)


LANE: Final = -0.24  # y of the lane of the car [m]
LANE_HALF: Final = 0.45  # how far it goes to either side [m]
FLIGHT: Final = ((-0.40, -0.35, 0.30), (0.40, -0.05, 0.45))
"""Lowest and highest x, y and z between which a toy is flown about, above the line of sight [m]."""


def _toys(time: Array, rng: np.random.Generator) -> list[Actor]:
    """A car that runs to and fro on the table, and a toy that a hand flies about above it."""
    steps = rng.uniform(0.6, 1.8, 2 + int((time[-1] - time[0]) / 0.6))
    times = time[0] + np.concatenate([[0.0], np.cumsum(steps)])
    flight = gliding(times, rng.uniform(*FLIGHT, (times.size, 3)))
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
    ellipsoids = [surfaces.ellipsoid(semi_axes, middle, spacing) for middle, semi_axes in RABBIT]
    return cast("trimesh.Trimesh", trimesh.util.concatenate(ellipsoids))
