"""Plates of glass: heated while a board is reflected in them, touched by fingers, or only near."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from dbthermal.simulation import heat
from dbthermal.simulation._mesh import Surface
from dbthermal.simulation._rays import Array, Camera
from dbthermal.simulation._surroundings import Actor, Motion, Pose, Room, gliding
from reproduction.twins import surfaces
from reproduction.twins.people import FINGERS, hand, imprint, pacing, person
from reproduction.twins.props import Writing, board
from reproduction.twins.stage import AMBIENT, TABLE, Capture, Stage, since


@dataclass(frozen=True)
class Pane:
    """
    An upright plate of glass in the plane y = 0, and the air on both of its sides.

    Attributes
    ----------
    width, height : float
        Size [m].
    thickness : float
        Thickness [m].
    spacing : float
        Distance of the vertices [m].
    air : float
        Coefficient to still air [W m^-2 K^-1]; 2 to 25 for free convection in gases, table 1.1
        of Bergman et al. (2011), Fundamentals of Heat and Mass Transfer.
    emissivity : float
        Total hemispherical emissivity of glass [1], for its radiation alone: about 0.9.
    """

    width: float = 0.36
    height: float = 0.28
    thickness: float = 0.003
    spacing: float = 0.005
    air: float = 5.0
    emissivity: float = 0.9

    def surface(self) -> Surface:
        """The plate, its middle at the origin."""
        upright = surfaces.plate(self.width, self.height, self.spacing)
        return surfaces.moved(upright, translation=(0.0, 0.0, -self.height / 2.0))

    def exchanges(self) -> list[heat.Exchange]:
        """What both sides exchange with the room."""
        side = [heat.Convection(self.air, AMBIENT), heat.Radiation(self.emissivity, AMBIENT)]
        return [*side, *side]

    def shell(self) -> heat.Shell:
        """The plate as a body."""
        surface = self.surface()
        return heat.Shell(surface.vertices, surface.faces, self.thickness, heat.GLASS)


@dataclass(frozen=True)
class Gun:
    """
    A hot-air gun behind the plate.

    Attributes
    ----------
    temperature : float
        Of the jet where it meets the plate [K].
    coefficient : float
        Of its heat transfer in the middle [W m^-2 K^-1]; 25 to 250 for forced convection in gases,
        table 1.1 of Bergman et al. (2011).
    radius : float
        Standard deviation of its Gaussian spot [m].
    start, rise : float
        When it is brought near, and how long that takes [s].
    """

    temperature: float = 423.15
    coefficient: float = 55.0
    radius: float = 0.035
    start: float = -1.0
    rise: float = 1.5

    def blast(self, surface: Surface) -> heat.Exchange:
        """What it does to a plate about the origin."""
        away = np.hypot(surface.vertices[:, 0], surface.vertices[:, 2])
        spot = self.coefficient * np.exp(-(away**2) / (2.0 * self.radius**2))

        def coefficient(time: float) -> Array:
            return np.asarray(0.5 * (1.0 + np.tanh((time - self.start) / self.rise)) * spot)

        return heat.Convection(coefficient, self.temperature)


_BEFORE: Final = 6.0
"""The gun starts to be brought near this many of its rise times before its start [1]."""
BOARD_SIZE: Final = (0.34, 0.20)
"""Width and height of the board [m]."""
BOARD_DISTANCE: Final = 0.55
"""How far the board is from the plate's middle [m]."""
BOARD_SPACING: Final = 0.004
"""Distance of the board's vertices [m]."""
SLANT: Final = Rotation.from_euler("yx", (0.9, -0.6))
"""How a hand is held that writes: slanted, so that its index is foremost, and tilted forward."""
AWAY: Final = (0.0, -0.5)
"""Where the hand comes from and goes to, from the stroke: x and z on the board [m]."""
WITHDRAWAL: Final = 1.0
"""How long it takes to come, and to go [s]."""


def glass_plate(
    capture: Capture,
    rng: np.random.Generator,
    *,
    pane: Pane | None = None,
    gun: Gun | None = None,
    writing: Writing | None = None,
) -> Stage:
    """
    A plate heated by a hot-air gun, in which a board is seen while somebody writes on it.

    Parameters
    ----------
    capture : Capture
        How it is recorded.
    rng : Generator
        Source of the moment at which the writing begins, within 2 s.
    pane : Pane, optional
        The plate.
    gun : Gun, optional
        The gun.
    writing : Writing, optional
        What is written, and how; the letters CV with a cold, wet finger.

    Returns
    -------
    Stage
        For `take`.
    """
    pane, gun = pane or Pane(), gun or Gun()
    writing = writing or Writing(start=float(rng.uniform(2.0, 4.0)))
    surface = pane.surface()
    exchanges = [*pane.exchanges(), gun.blast(surface)]
    camera = Camera((0.24, -0.62, 0.0), (0.0, 0.0, 0.0), capture.shape)
    return Stage(
        "glass_plate",
        surface,
        since(gun.start - _BEFORE * gun.rise, pane.shell(), capture.time, exchanges),
        camera,
        _written(writing, camera),
        Room(AMBIENT),
        [(0.02, 0.0, 0.01)],
    )


def _written(writing: Writing, camera: Camera) -> list[Actor]:
    """The board where the middle of the view is mirrored to, facing the plate, and the writer."""
    away = np.array([-camera.position[0], camera.position[1], 0.0])
    away /= np.linalg.norm(away)
    turn = Rotation.from_euler("z", np.arctan2(-away[0], away[1]))
    width, height = BOARD_SIZE
    flat = surfaces.plate(width, height, BOARD_SPACING)
    flat = surfaces.moved(flat, translation=(0.0, 0.0, -height / 2.0))
    pose = Pose(turn, BOARD_DISTANCE * away)
    # Mirrored, the text reads from left to right.
    places = flat.vertices[:, [0, 2]] * (-1.0, 1.0)
    strokes = board(flat, places, writing, AMBIENT, lambda _: pose)
    return [strokes, *hand(lambda now: pose @ pointing(writing, now))]


def pointing(writing: Writing, time: float) -> Pose:
    """
    Pose of a hand whose index writes on a board: it comes from below, writes, and goes.

    Parameters
    ----------
    writing : Writing
        What is written.
    time : float
        Time [s].

    Returns
    -------
    Pose
        In the frame of the board, whose plane is y = 0, seen from negative y, mirrored in x. The
        tip's middle is a finger's radius in front of the stroke.
    """
    times, path = writing.path()
    times = np.concatenate([[times[0] - WITHDRAWAL], times, [times[-1] + WITHDRAWAL]])
    path = np.concatenate([path[:1] + AWAY, path, path[-1:] + AWAY])
    x, z = (float(np.interp(time, times, along)) for along in path.T)
    index = FINGERS[1]
    tip = SLANT.apply((index.tip[0], 0.0, index.tip[1]))
    return Pose(SLANT, np.array([-x, -index.radius, z]) - tip)


NEAR: Final = 0.15
"""How far a hand is in front of the plate [m]."""


def fingers(capture: Capture, rng: np.random.Generator, *, pane: Pane | None = None) -> Stage:
    """
    A plate at room temperature, in front of which fingers move: reflection only.

    Parameters
    ----------
    capture : Capture
        How it is recorded.
    rng : Generator
        Source of the hand's motion.
    pane : Pane, optional
        The plate.

    Returns
    -------
    Stage
        For `take`. The plate's temperature is constant, so no method can tell its emissivity.
    """
    pane = pane or Pane()
    surface = pane.surface()
    camera = Camera((0.33, -0.39, 0.0), (0.0, 0.0, 0.0), capture.shape)
    return Stage(
        "fingers",
        surface,
        np.full((capture.time.size, len(surface.vertices)), AMBIENT),
        camera,
        hand(waving(capture.time, rng), flex=0.5),
        Room(AMBIENT),
        [(0.0, 0.0, 0.03)],
    )


def waving(time: Array, rng: np.random.Generator) -> Motion:
    """
    A hand before the plate that comes into view, moves about, and leaves, again and again.

    Parameters
    ----------
    time : ndarray, shape (time,)
        Times [s].
    rng : Generator
        Source of the places and the times.

    Returns
    -------
    function of time
        The pose.
    """
    view, out = (-NEAR * 0.85, -NEAR, -0.03), (-NEAR * 0.85, -NEAR, -0.40)
    times, places = [float(time[0])], [np.array(out)]
    while times[-1] < time[-1]:
        inside = np.array(view) + rng.uniform(-1.0, 1.0, (3, 3)) * (0.03, 0.0, 0.03)
        places += [*inside, np.array(out), np.array(out)]
        times += [*(times[-1] + np.cumsum(rng.uniform(0.4, 1.6, 5)))]
    return gliding(times, places)


@dataclass(frozen=True)
class Touch:
    """
    Skin pressed on something before the capture.

    Attributes
    ----------
    start, duration : float
        When it begins and how long it lasts [s]; over before the capture starts at 0.
    skin : float
        Temperature of the skin [K].
    contact : float
        Conductance from the warm tissue to the surface [W m^-2 K^-1]: some 1 mm of outer skin
        of 0.2 to 0.3 W m^-1 K^-1.
    """

    start: float = -6.0
    duration: float = 5.0
    skin: float = 306.15
    contact: float = 250.0

    def press(self, share: Array) -> heat.Exchange:
        """What it does to a body of which a share, in [0, 1], of each vertex is touched."""

        def contact(time: float) -> Array:
            return self.contact * share * (self.start <= time < self.start + self.duration)

        return heat.Convection(contact, self.skin)


VISIT: Final = ((-2.2, -3.2), (2.6, -3.4))
"""Way of somebody far away, x and y from the plate [m]."""


def fingerprint(
    capture: Capture,
    rng: np.random.Generator,
    *,
    pane: Pane | None = None,
    touch: Touch | None = None,
    visitor: bool = False,
) -> Stage:
    """
    Prints of a hand that dissipate on a plate, before a uniform background: emission only.

    Parameters
    ----------
    capture : Capture
        How it is recorded.
    rng : Generator
        Source of the visitor's way.
    pane : Pane, optional
        The plate.
    touch : Touch, optional
        How it was touched.
    visitor : bool
        Whether somebody walks by, 3 m away. Without, nothing moves that is reflected, and the
        direction of the reflection is undefined.

    Returns
    -------
    Stage
        For `take`.
    """
    pane, touch = pane or Pane(spacing=0.003), touch or Touch()
    surface = pane.surface()
    share = imprint(surface.vertices[:, [0, 2]] + (0.0, 0.03))
    exchanges = [*pane.exchanges(), touch.press(share)]
    return Stage(
        "fingerprint",
        surface,
        since(touch.start, pane.shell(), capture.time, exchanges),
        Camera((0.12, -0.50, 0.02), (0.0, 0.0, 0.0), capture.shape),
        person(pacing(VISIT, capture.time, rng), height=-TABLE - pane.height / 2)
        if visitor
        else [],
        Room(AMBIENT),
        [(0.0, 0.0, -0.03)],
    )
