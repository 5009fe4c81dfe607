"""Plates of glass: heated while a board is reflected, touched by a hand, and before a hand."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from dbthermal._arrays import Array
from reproduction import heat
from reproduction.twins import surfaces
from reproduction.twins.people import FINGERS, Writing, board, hand, imprint, pacing, person
from reproduction.twins.rays import Camera
from reproduction.twins.stage import AMBIENT, TABLE, Capture, Stage, since
from reproduction.twins.surroundings import Actor, Motion, Pose, gliding


@dataclass(frozen=True)
class Pane:
    """An upright plate of glass in the plane y = 0, and the air on both of its sides.

    Size, thickness and distance of the vertices [m]. The coefficient to still air [W m^-2 K^-1] is
    one of free convection in gases, 2 to 25, table 1.1 of Bergman et al. (2011), Fundamentals of
    Heat and Mass Transfer; the total hemispherical emissivity of glass, about 0.9, is for its
    radiation.
    """

    width: float = 0.36
    height: float = 0.28
    thickness: float = 0.003
    spacing: float = 0.005
    air: float = 5.0
    emissivity: float = 0.9

    def mesh(self) -> trimesh.Trimesh:
        """The plate, its middle at the origin."""
        upright = surfaces.plate(self.width, self.height, self.spacing)
        return surfaces.moved(upright, translation=(0.0, 0.0, -self.height / 2.0))

    def temperature(
        self, start: float, mesh: trimesh.Trimesh, time: Array, *sources: heat.Exchange
    ) -> Array:
        """Temperature (time, vertex) [K] with both sides to the room and sources from a start."""
        side = (heat.Convection(self.air, AMBIENT), heat.Radiation(self.emissivity, AMBIENT))
        return since(start, mesh, (self.thickness, heat.GLASS), time, [*side, *side, *sources])


@dataclass(frozen=True)
class Gun:
    """A hot-air gun behind the plate.

    Temperature of the jet at the plate [K]; coefficient in the middle [W m^-2 K^-1], 25 to 250 for
    forced convection in gases, table 1.1 of Bergman et al. (2011); standard deviation of its
    Gaussian spot [m]; time at which it is half near, and time in which it is brought near [s].
    """

    temperature: float = 423.15
    coefficient: float = 55.0
    radius: float = 0.035
    start: float = -1.0
    rise: float = 1.5

    def blast(self, mesh: trimesh.Trimesh) -> heat.Exchange:
        """Convection to a plate about the origin."""
        distance = np.hypot(mesh.vertices[:, 0], mesh.vertices[:, 2])
        spot = self.coefficient * np.exp(-(distance**2) / (2.0 * self.radius**2))

        def coefficient(time: float) -> Array:
            return np.asarray(0.5 * (1.0 + np.tanh((time - self.start) / self.rise)) * spot)

        return heat.Convection(coefficient, self.temperature)


_BEFORE: Final = 6.0
"""The gun starts to be brought near this many of its rise times before its start [1]."""
BOARD_SIZE: Final = (0.34, 0.20)  # width and height of the board [m]
BOARD_DISTANCE: Final = 0.55  # how far the board is from the plate's middle [m]
BOARD_SPACING: Final = 0.004  # distance of the board's vertices [m]
SLANT: Final = Rotation.from_euler("yx", (0.9, -0.6))
"""Orientation of a hand that writes: slanted, so that its index is foremost, and tilted forward."""
AWAY: Final = (0.0, -0.5)
"""Where the hand comes from and goes to, from the stroke: x and z on the board [m]."""
WITHDRAWAL: Final = 1.0  # time in which it comes, and goes [s]


def glass_plate(capture: Capture, rng: np.random.Generator) -> Stage:
    """Plate heated by a hot-air gun, in which a board is reflected while somebody writes on it.

    The letters CV with a cold, wet finger, begun at a random moment within 2 s.
    """
    pane, gun, writing = Pane(), Gun(), Writing(start=float(rng.uniform(2.0, 4.0)))
    mesh, start = pane.mesh(), gun.start - _BEFORE * gun.rise
    camera = Camera((0.24, -0.62, 0.0), (0.0, 0.0, 0.0), capture.shape)
    warm = pane.temperature(start, mesh, capture.time, gun.blast(mesh))
    actors, probe = _written(writing, camera), (0.02, 0.0, 0.01)
    return Stage("glass_plate", mesh, warm, camera, actors, [probe], BOARD_DISTANCE)


def _written(writing: Writing, camera: Camera) -> list[Actor]:
    """The board where the middle of the view is reflected to, facing the plate, and the writer."""
    away = np.array([-camera.position[0], camera.position[1], 0.0])
    away /= np.linalg.norm(away)
    turn = Rotation.from_euler("z", np.arctan2(-away[0], away[1]))
    width, height = BOARD_SIZE
    flat = surfaces.plate(width, height, BOARD_SPACING)
    flat = surfaces.moved(flat, translation=(0.0, 0.0, -height / 2.0))
    pose = Pose(turn, BOARD_DISTANCE * away)
    # Mirrored, the text reads from left to right.
    places = np.asarray(flat.vertices)[:, [0, 2]] * (-1.0, 1.0)
    strokes = board(flat, places, writing, AMBIENT, lambda _: pose)
    return [strokes, *hand(lambda now: pose @ pointing(writing, now))]


def pointing(writing: Writing, time: float) -> Pose:
    """
    Pose at a time [s] of a hand whose index writes on a board: it comes from below, writes, goes.

    In the frame of the board, whose plane is y = 0, seen from negative y, mirrored in x. The tip's
    middle is a finger's radius in front of the stroke.
    """
    times, path = writing.path()
    times = np.concatenate([[times[0] - WITHDRAWAL], times, [times[-1] + WITHDRAWAL]])
    path = np.concatenate([path[:1] + AWAY, path, path[-1:] + AWAY])
    x, z = (float(np.interp(time, times, along)) for along in path.T)
    index = FINGERS[1]
    tip = SLANT.apply((index.tip[0], 0.0, index.tip[1]))
    return Pose(SLANT, np.array([-x, -index.radius, z]) - tip)


NEAR: Final = 0.15  # how far a hand is in front of the plate [m]


def fingers(capture: Capture, rng: np.random.Generator) -> Stage:
    """Plate at room temperature, in front of which fingers move: reflection only.

    The plate's temperature is constant, so no method can tell its emissivity.
    """
    mesh = Pane().mesh()
    camera = Camera((0.33, -0.39, 0.0), (0.0, 0.0, 0.0), capture.shape)
    level = np.full((capture.time.size, len(mesh.vertices)), AMBIENT)
    actors = hand(_waving(capture.time, rng), flex=0.5)
    return Stage("fingers", mesh, level, camera, actors, [(0.0, 0.0, 0.03)])


def _waving(time: Array, rng: np.random.Generator) -> Motion:
    """A hand before the plate that comes into view, moves about, and leaves, again and again."""
    view, out = (-NEAR * 0.85, -NEAR, -0.03), (-NEAR * 0.85, -NEAR, -0.40)
    times, places = [float(time[0])], [np.array(out)]
    while times[-1] < time[-1]:
        corners = np.array(view) + rng.uniform(-1.0, 1.0, (3, 3)) * (0.03, 0.0, 0.03)
        places += [*corners, np.array(out), np.array(out)]
        times += [*(times[-1] + np.cumsum(rng.uniform(0.4, 1.6, 5)))]
    return gliding(times, places)


@dataclass(frozen=True)
class Touch:
    """Skin pressed on an object before the capture.

    Beginning and length of the contact [s], over before the capture starts at 0; temperature of the
    skin [K]; conductance from the warm tissue to the surface [W m^-2 K^-1]: some 1 mm of outer skin
    of 0.2 to 0.3 W m^-1 K^-1.
    """

    start: float = -6.0
    duration: float = 5.0
    skin: float = 306.15
    contact: float = 250.0

    def press(self, share: Array) -> heat.Exchange:
        """Contact with a body of which a share, in [0, 1], of each vertex is touched."""

        def contact(time: float) -> Array:
            return self.contact * share * (self.start <= time < self.start + self.duration)

        return heat.Convection(contact, self.skin)


VISIT: Final = ((-2.2, -3.2), (2.6, -3.4))
"""Route of a visitor far away, x and y from the plate [m]."""


def fingerprint(
    capture: Capture, rng: np.random.Generator, *, visitor: bool = False, spacing: float = 0.003
) -> Stage:
    """Prints of a hand that fade on a plate, before a uniform background: emission only.

    With a visitor somebody walks by, 3 m away; without, nothing moves that is reflected, and the
    reflection ratio is undefined.
    """
    pane, touch = Pane(spacing=spacing), Touch()
    mesh = pane.mesh()
    share = imprint(np.asarray(mesh.vertices)[:, [0, 2]] + (0.0, 0.03))
    warm = pane.temperature(touch.start, mesh, capture.time, touch.press(share))
    camera = Camera((0.12, -0.50, 0.02), (0.0, 0.0, 0.0), capture.shape)
    floor = -TABLE - pane.height / 2
    actors = person(pacing(VISIT, capture.time, rng), height=floor) if visitor else []
    return Stage("fingerprint", mesh, warm, camera, actors, [(0.0, 0.0, -0.03)])
