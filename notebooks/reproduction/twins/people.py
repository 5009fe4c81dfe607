"""People among the surroundings: how they walk, and how their bodies and hands are built.

Temperatures are those that a thermal camera reads of skin and clothes indoors.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from dbthermal.simulation._mesh import Surface
from dbthermal.simulation._rays import Array
from dbthermal.simulation._surroundings import Actor, Motion, Pose, hinged, painted
from dbthermal.simulation._times import increasing
from reproduction.twins import surfaces

_SPACING: Final = 0.03
"""Distance of the vertices of a body [m]."""
_FINE: Final = 0.004
"""Distance of the vertices of a hand [m]."""


@dataclass(frozen=True)
class Route:
    """
    A way over the floor, walked in straight lines at a steady pace between its stops.

    Attributes
    ----------
    times : ndarray, shape (stop,)
        When each stop is passed [s], increasing; two or more.
    places : ndarray, shape (stop, 2)
        Where it is: x and y [m].
    stride : float
        Way from one step to the next [m].
    """

    times: Array
    places: Array
    stride: float = 0.7

    def __post_init__(self) -> None:
        """Refuse a way back in time, and places that are none or not one for each time."""
        increasing(self.times, "a route")
        if self.places.shape != (self.times.size, 2) or not np.all(np.isfinite(self.places)):
            raise ValueError(
                f"Invalid places of shape {self.places.shape} of a route. Must be finite, "
                f"({self.times.size}, 2)."
            )

    def place(self, time: float) -> Array:
        """Place (2,) at a time [s]: x and y [m]; before and after, that of the nearest stop."""
        return np.array([np.interp(time, self.times, along) for along in self.places.T])

    def phase(self, time: float) -> float:
        """Phase of the steps [rad], which grows by pi a stride."""
        ways = np.linalg.norm(np.diff(self.places, axis=0), axis=1)
        walked = np.interp(time, self.times, np.concatenate([[0.0], np.cumsum(ways)]))
        return float(np.pi * walked / self.stride)

    def heading(self, time: float) -> float:
        """Direction of the walk at a time [s], from x [rad]; who stands faces where he came to."""
        legs = np.diff(self.places, axis=0)
        walked = np.flatnonzero(np.any(legs != 0, axis=1))
        leg = np.searchsorted(self.times, time, side="right") - 1
        last = walked[max(0, int(np.searchsorted(walked, leg, side="right")) - 1)]
        return float(np.arctan2(legs[last, 1], legs[last, 0]))


def pacing(
    way: npt.ArrayLike,
    time: Array,
    rng: np.random.Generator,
    *,
    pace: tuple[float, float] = (0.5, 1.0),
    pause: tuple[float, float] = (0.3, 2.0),
) -> Route:
    """
    Back and forth along a way, with a pause at each of its corners.

    Parameters
    ----------
    way : array_like, shape (stop, 2)
        Its corners, x and y [m].
    time : ndarray, shape (time,)
        Times [s] that the route must cover.
    rng : Generator
        Source of the first end, the paces and the pauses.
    pace : tuple of float
        Slowest and fastest pace [m/s].
    pause : tuple of float
        Shortest and longest pause [s].

    Returns
    -------
    Route
        The way.
    """
    corners = np.asarray(way, dtype=np.float64)[:: int(rng.choice([-1, 1]))]
    there_and_back = itertools.cycle([*corners, *corners[-2:0:-1]])
    times, places = [float(time[0])], [next(there_and_back)]
    while times[-1] < time[-1]:
        stop, start = next(there_and_back), times[-1] + rng.uniform(*pause)
        length = float(np.linalg.norm(stop - places[-1]))
        times += [start, start + length / rng.uniform(*pace)]
        places += [places[-1], stop]
    return Route(np.array(times), np.array(places))


@dataclass(frozen=True)
class Build:
    """
    Measures and temperatures of a person, who stands with the feet at z = 0 and walks along x.

    Attributes
    ----------
    shoulder, hip, crown : float
        Heights [m].
    breadth : float
        From shoulder to shoulder [m].
    skin, hand, clothes : float
        Temperatures [K] of the face, the hands and the clothes.
    swing : float
        Largest angle of legs and arms [rad].
    """

    shoulder: float = 1.42
    hip: float = 0.90
    crown: float = 1.75
    breadth: float = 0.42
    skin: float = 307.15
    hand: float = 305.15
    clothes: float = 302.65
    swing: float = 0.45


def person(route: Route, build: Build | None = None, *, height: float = 0.0) -> list[Actor]:
    """
    A person who walks a route, with legs and arms that swing.

    Parameters
    ----------
    route : Route
        The way.
    build : Build, optional
        Measures and temperatures; an adult's.
    height : float
        Height of the floor [m].

    Returns
    -------
    list of Actor
        Trunk with head, two legs and two arms.
    """
    build = build or Build()
    upper = painted([(_trunk(build), build.clothes), (_head(build), build.skin)])
    actors = [_walking(upper, route, height, 0.0, 0.0)]
    for side in (-1.0, 1.0):
        leg = painted([(_leg(build, side), build.clothes)])
        arm = painted([(_arm(build, side), build.clothes), (_fist(build, side), build.hand)])
        actors.append(_walking(leg, route, height, build.hip, side * build.swing))
        actors.append(_walking(arm, route, height, build.shoulder, -side * build.swing))
    return actors


def _ball(semi_axes: Sequence[float], place: npt.ArrayLike) -> Surface:
    return surfaces.moved(surfaces.ellipsoid(semi_axes, _SPACING), translation=place)


def _trunk(build: Build) -> Surface:
    middle, half = (build.hip + build.shoulder) / 2, (build.shoulder - build.hip) / 2 + 0.06
    return _ball((0.13, build.breadth / 2, half), (0, 0, middle))


def _head(build: Build) -> Surface:
    return _ball((0.10, 0.08, 0.13), (0, 0, build.crown - 0.13))


def _leg(build: Build, side: float) -> Surface:
    return surfaces.capsule((0, side * 0.1, build.hip), (0, side * 0.1, 0.08), 0.08, _SPACING)


def _arm(build: Build, side: float) -> Surface:
    y = side * (build.breadth / 2 + 0.02)
    return surfaces.capsule((0, y, build.shoulder), (0, y, build.hip - 0.02), 0.05, _SPACING)


def _fist(build: Build, side: float) -> Surface:
    return _ball((0.05, 0.03, 0.08), (0, side * (build.breadth / 2 + 0.02), build.hip - 0.12))


def _walking(part: Actor, route: Route, floor: float, joint: float, swing: float) -> Actor:
    """The part on its way, swung about a joint at a height, in step."""

    def motion(time: float) -> Pose:
        upright = Rotation.from_euler("z", route.heading(time))
        angle = Rotation.from_euler("y", swing * np.sin(route.phase(time)))
        return Pose(upright, (*route.place(time), floor)) @ hinged((0.0, 0.0, joint), angle)

    return Actor(part.surface, part.temperature, motion)


@dataclass(frozen=True)
class Finger:
    """
    A finger of a flat hand in the plane y = 0.

    Attributes
    ----------
    root, tip : tuple of float
        x and z of its two ends [m].
    radius : float
        Half its thickness [m].
    """

    root: tuple[float, float]
    tip: tuple[float, float]
    radius: float


PALM: Final = (0.042, 0.014, 0.050)
"""Semi-axes of the palm, whose middle is the origin [m]."""
FOREARM: Final = ((0.0, 0.0, -0.05), (0.0, 0.0, -0.30), 0.028)
"""Wrist and elbow, and half the thickness [m]."""
FINGERS: Final = (
    Finger((-0.035, -0.010), (-0.078, 0.035), 0.010),
    Finger((-0.028, 0.035), (-0.040, 0.105), 0.009),
    Finger((-0.009, 0.040), (-0.011, 0.120), 0.009),
    Finger((0.010, 0.038), (0.015, 0.110), 0.009),
    Finger((0.028, 0.030), (0.041, 0.085), 0.008),
)
"""Thumb to little finger of a right hand, seen from its back; fingers point up."""


def hand(
    motion: Motion, skin: float = 306.15, *, flex: float = 0.0, rate: float = 0.8
) -> list[Actor]:
    """
    A hand on its forearm, flat in the plane y = 0, whose fingers may move one by one.

    Parameters
    ----------
    motion : function of time
        Pose of the palm.
    skin : float
        Temperature [K].
    flex : float
        Largest angle by which a finger bends at its root [rad].
    rate : float
        How often the first finger bends [1/s]; each of the others a little more often.

    Returns
    -------
    list of Actor
        Palm with forearm, and five fingers.
    """
    bones = (surfaces.ellipsoid(PALM, _FINE), surfaces.capsule(*FOREARM, _SPACING))
    palm = painted([(bone, skin) for bone in bones], motion)
    return [palm, *(_finger(n, motion, skin, flex, rate) for n in range(len(FINGERS)))]


def _finger(number: int, motion: Motion, skin: float, flex: float, rate: float) -> Actor:
    shape = FINGERS[number]
    root, tip = ((x, 0.0, z) for x, z in (shape.root, shape.tip))

    def bent(time: float) -> Pose:
        phase = 2.0 * np.pi * rate * (1.0 + 0.13 * number) * time + number
        return motion(time) @ hinged(root, Rotation.from_euler("x", flex * np.sin(phase)))

    return painted([(surfaces.capsule(root, tip, shape.radius, _FINE), skin)], bent)


def imprint(places: npt.ArrayLike, softness: float = 0.002) -> Array:
    """
    Where a flat hand touches a surface.

    Parameters
    ----------
    places : array_like, shape (place, 2)
        x and z in the plane of the hand [m].
    softness : float
        Width of the edge [m].

    Returns
    -------
    ndarray, shape (place,)
        1 under the hand, 0 beyond it, smooth between.
    """
    places = np.asarray(places, dtype=np.float64)
    scale = np.linalg.norm(places / (PALM[0], PALM[2]), axis=1)
    palm = (1.0 - scale) * min(PALM[0], PALM[2])
    fingers = [part.radius - _to_segment(places, part.root, part.tip) for part in FINGERS]
    return np.asarray(0.5 * (1.0 + np.tanh(np.max([palm, *fingers], axis=0) / softness)))


def _to_segment(places: Array, *ends: tuple[float, float]) -> Array:
    """Distance of places (place, 2) from the segment between two points [m]."""
    start, end = np.array(ends)
    along = end - start
    share = np.clip((places - start) @ along / (along @ along), 0.0, 1.0)
    return np.asarray(np.linalg.norm(places - start - share[:, np.newaxis] * along, axis=1))
