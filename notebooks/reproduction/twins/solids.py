"""A bulb with a palm print before somebody with a hot cup, and a bunny before moving toys."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from dbthermal.simulation import heat
from dbthermal.simulation._mesh import Surface
from dbthermal.simulation._rays import Array, Camera
from dbthermal.simulation._surroundings import Actor, Motion, Pose, Room, gliding
from reproduction.twins import surfaces
from reproduction.twins.panes import Touch
from reproduction.twins.people import Route, hand, imprint, pacing, person
from reproduction.twins.probes import on_wall
from reproduction.twins.props import cup, toy
from reproduction.twins.stage import AMBIENT, TABLE, Capture, Stage, passers_by, since, table


@dataclass(frozen=True)
class Bulb:
    """
    A light bulb that is off.

    Attributes
    ----------
    thickness : float
        Of its glass [m].
    air, gas : float
        Coefficients to the air outside and the gas inside [W m^-2 K^-1]; 2 to 25 for free
        convection in gases, table 1.1 of Bergman et al. (2011), Fundamentals of Heat and Mass
        Transfer.
    emissivity : float
        Total hemispherical emissivity of glass [1], for its radiation alone: about 0.9.
    """

    thickness: float = 0.0008
    air: float = 6.0
    gas: float = 5.0
    emissivity: float = 0.9

    def exchanges(self) -> list[heat.Exchange]:
        """What both sides exchange."""
        both = heat.Convection(self.air + self.gas, AMBIENT)
        return [both, heat.Radiation(self.emissivity, AMBIENT)]


_GRIP: Final = (0.045, -0.070)
"""Where the middle of the palm lies on the bulb: height, and way round it from the front [m]."""


def bulb(
    capture: Capture,
    rng: np.random.Generator,
    *,
    glass: Bulb | None = None,
    touch: Touch | None = None,
    uncovered: float = 8.0,
) -> Stage:
    """
    A bulb that was held by a hand, before somebody who walks about and sips from a hot cup.

    Parameters
    ----------
    capture : Capture
        How it is recorded.
    rng : Generator
        Source of the ways and the sips.
    glass : Bulb, optional
        The bulb.
    touch : Touch, optional
        How it was held; over before the capture starts.
    uncovered : float
        When the lid is taken off the cup [s].

    Returns
    -------
    Stage
        For `take`.
    """
    glass, touch = glass or Bulb(), touch or Touch()
    surface = surfaces.bulb()
    shell = heat.Shell(surface.vertices, surface.faces, glass.thickness, heat.GLASS)
    exchanges = [*glass.exchanges(), touch.press(_held(surface))]
    route = pacing(SIPPING, capture.time, rng)
    return Stage(
        "bulb",
        surface,
        since(touch.start, shell, capture.time, exchanges),
        Camera((0.0, -0.32, 0.060), (0.0, 0.0, 0.046), capture.shape),
        [
            table(-STAND),
            *person(route, height=-TABLE - STAND),
            cup(_sips(route, rng), uncovered=uncovered),
        ],
        Room(AMBIENT),
        [on_wall(surface, 0.055, 5.0)],
    )


def _held(surface: Surface) -> Array:
    """Share of each vertex of a bulb that a hand touches, which reaches round it."""
    x, y, z = surface.vertices.T
    way = np.hypot(x, y) * np.arctan2(x, -y)
    return imprint(np.stack([z - _GRIP[0], way - _GRIP[1]], axis=1))


STAND: Final = 0.25
"""Height of the bulb's socket above the table [m]."""
SIPPING: Final = ((-1.0, -0.8), (0.05, -0.7), (1.0, -0.8), (1.0, 0.4))
"""Way of somebody with a cup, x and y from the bulb [m]."""
CUP_HEIGHTS: Final = (1.10, 1.50)
"""Height of the cup above the floor: held, and at the mouth [m]."""
CUP_PLACE: Final = (0.05, 0.26)
"""Where the cup is held, x and y from the middle of the body [m]."""


def _sips(route: Route, rng: np.random.Generator) -> Motion:
    """Motion of a cup that is carried along a route and raised to the mouth now and then."""
    low, high = (height - TABLE - STAND for height in CUP_HEIGHTS)
    times, heights = [float(route.times[0])], [low]
    while times[-1] < route.times[-1]:
        times += [*(times[-1] + np.cumsum(rng.uniform((1.5, 0.5, 0.8, 0.5), (3.5, 0.9, 2.0, 0.9))))]
        heights += [low, high, high, low]

    def motion(time: float) -> Pose:
        x, y = route.place(time) + CUP_PLACE
        return Pose(translation=(x, y, float(np.interp(time, times, heights))))

    return motion


@dataclass(frozen=True)
class Lamp:
    """
    A lamp that heats the bunny, a thin shell.

    Attributes
    ----------
    flux : float
        Absorbed where the surface faces the lamp [W m^-2].
    towards : tuple of float
        Direction to the lamp, any length.
    start, rise : float
        When it is switched on, and its time constant [s].
    thickness : float
        Of the shell [m].
    air : float
        Coefficient to still air [W m^-2 K^-1].
    emissivity : float
        Total hemispherical emissivity of the bunny [1], for its radiation alone.
    """

    flux: float = 3000.0
    towards: tuple[float, float, float] = (-1.0, -0.8, 1.0)
    start: float = -2.0
    rise: float = 2.0
    thickness: float = 0.0015
    air: float = 6.0
    emissivity: float = 0.9

    def exchanges(self, surface: Surface) -> list[heat.Exchange]:
        """What the surface exchanges."""
        towards = np.asarray(self.towards) / np.linalg.norm(self.towards)
        facing = np.maximum(surface.vertex_normals @ towards, 0.0)

        def flux(time: float) -> Array:
            on = -np.expm1(-max(time - self.start, 0.0) / self.rise)
            return np.asarray(self.flux * on * facing)

        return [
            heat.Heating(flux),
            heat.Convection(self.air, AMBIENT),
            heat.Radiation(self.emissivity, AMBIENT),
        ]


BUNNY_HEIGHT: Final = 0.15
"""Height of the bunny on the table [m]."""


def bunny(
    capture: Capture,
    rng: np.random.Generator,
    *,
    scan: Surface | None = None,
    lamp: Lamp | None = None,
) -> Stage:
    """
    The Stanford bunny, which looks to the left, or a built-in rabbit, which looks at the camera.

    It is heated by a lamp. A car runs to and fro, a toy is flown about by a hand, and two people
    walk near.

    Parameters
    ----------
    capture : Capture
        How it is recorded.
    rng : Generator
        Source of all ways.
    scan : Surface, optional
        The bunny as scanned: y up, seen along -z, looking to negative x, in any unit. Without one,
        `rabbit` is taken.
    lamp : Lamp, optional
        The lamp, and the shell that it heats.

    Returns
    -------
    Stage
        For `take`.
    """
    lamp, surface = lamp or Lamp(), rabbit() if scan is None else _stood(scan)
    shell = heat.Shell(surface.vertices, surface.faces, lamp.thickness, heat.CERAMIC)
    return Stage(
        "bunny",
        surface,
        since(lamp.start, shell, capture.time, lamp.exchanges(surface)),
        Camera((0.0, -0.54, 0.36), (0.0, 0.0, 0.07), capture.shape),
        [table(), *_toys(capture.time, rng), *passers_by(capture.time, rng)],
        Room(AMBIENT),
    )


def _stood(scan: Surface) -> Surface:
    """A scan (y up) on the table, z up, its z towards the camera, as high as the bunny."""
    turned = surfaces.moved(surfaces.pruned(scan), Rotation.from_euler("x", 90.0, degrees=True))
    low, high = turned.vertices.min(axis=0), turned.vertices.max(axis=0)
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


def rabbit(spacing: float = 0.004) -> Surface:
    """
    A rabbit of six ellipsoids that sits on the plane z = 0 and faces negative y.

    Parameters
    ----------
    spacing : float
        Distance of the vertices [m].

    Returns
    -------
    Surface
        The parts, side by side; no heat flows from one to another.
    """
    parts = [
        surfaces.moved(surfaces.ellipsoid(semi_axes, spacing), translation=middle)
        for middle, semi_axes in RABBIT
    ]
    return surfaces.merge(parts)
