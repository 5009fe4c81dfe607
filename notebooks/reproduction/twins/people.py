"""What moves among the surroundings: people with their routes and hands, a toy, a written board.

Temperatures of people are those that a thermal camera reads of skin and clothes indoors.
"""

import itertools
from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.spatial.transform import Rotation

from dbthermal._arrays import Array
from reproduction.twins.surfaces import capsule, ellipsoid
from reproduction.twins.surroundings import Actor, Motion, Pose, hinged, painted

_SPACING: Final = 0.03  # distance of the vertices of a body [m]
_FINE: Final = 0.004  # distance of the vertices of a hand [m]


@dataclass(frozen=True)
class Route:
    """Walk over the floor in straight lines, at a steady pace between its stops.

    Times at the stops [s], two or more; x and y of each (stop, 2) [m]; length of a step [m].
    """

    times: Array
    places: Array
    stride: float = 0.7

    def place(self, time: float) -> Array:
        """Place (2,) at a time [s]: x and y [m]; before and after, that of the nearest stop."""
        return np.array([np.interp(time, self.times, along) for along in self.places.T])

    def phase(self, time: float) -> float:
        """Phase of the steps [rad], which grows by pi a stride."""
        lengths = np.linalg.norm(np.diff(self.places, axis=0), axis=1)
        walked = np.interp(time, self.times, np.concatenate([[0.0], np.cumsum(lengths)]))
        return float(np.pi * walked / self.stride)

    def heading(self, time: float) -> float:
        """Direction of the walk at a time [s], from x [rad]; at a stop, that of the walk to it."""
        legs = np.diff(self.places, axis=0)
        walked = np.flatnonzero(np.any(legs != 0, axis=1))
        leg = np.searchsorted(self.times, time, side="right") - 1
        last = walked[max(0, int(np.searchsorted(walked, leg, side="right")) - 1)]
        return float(np.arctan2(legs[last, 1], legs[last, 0]))


_PACE, _PAUSE = (0.5, 1.0), (0.3, 2.0)  # least and largest: pace of a leg [m/s], pause [s]


def pacing(corners: npt.ArrayLike, time: Array, rng: np.random.Generator) -> Route:
    """Route back and forth along corners (stop, 2) [m] that covers the times [s].

    The first end, the pace of each leg and the pauses are random.
    """
    points = np.asarray(corners, dtype=np.float64)[:: int(rng.choice([-1, 1]))]
    endless = itertools.cycle([*points, *points[-2:0:-1]])
    times, places = [float(time[0])], [next(endless)]
    while times[-1] < time[-1]:
        stop, start = next(endless), times[-1] + rng.uniform(*_PAUSE)
        length = float(np.linalg.norm(stop - places[-1]))
        times += [start, start + length / rng.uniform(*_PACE)]
        places += [places[-1], stop]
    return Route(np.array(times), np.array(places))


SHOULDER, HIP, CROWN, BREADTH = 1.42, 0.90, 1.75, 0.42
"""Heights of shoulder, hip and crown, and breadth from shoulder to shoulder, of a person who stands
with the feet at z = 0 and walks along x [m]."""
SKIN, HAND, CLOTHES = 307.15, 305.15, 302.65  # temperatures of face, hands and clothes [K]
SWING: Final = 0.45  # largest angle of legs and arms [rad]


def person(route: Route, *, height: float = 0.0) -> list[Actor]:
    """Adult who walks a route on a floor of a height [m]: trunk with head, two legs, two arms."""
    middle, half = (HIP + SHOULDER) / 2, (SHOULDER - HIP) / 2 + 0.06
    trunk = ellipsoid((0.13, BREADTH / 2, half), (0, 0, middle), _SPACING)
    head = ellipsoid((0.10, 0.08, 0.13), (0, 0, CROWN - 0.13), _SPACING)
    upper = painted([(trunk, CLOTHES), (head, SKIN)])
    actors = [_walking(upper, route, height, 0.0, 0.0)]
    for side in (-1.0, 1.0):
        x = side * 0.1
        leg = painted([(capsule((0, x, HIP), (0, x, 0.08), 0.08, _SPACING), CLOTHES)])
        y = side * (BREADTH / 2 + 0.02)
        sleeve = capsule((0, y, SHOULDER), (0, y, HIP - 0.02), 0.05, _SPACING)
        fist = ellipsoid((0.05, 0.03, 0.08), (0, y, HIP - 0.12), _SPACING)
        arm = painted([(sleeve, CLOTHES), (fist, HAND)])
        actors.append(_walking(leg, route, height, HIP, side * SWING))
        actors.append(_walking(arm, route, height, SHOULDER, -side * SWING))
    return actors


def _walking(limb: Actor, route: Route, floor: float, joint: float, swing: float) -> Actor:
    """Part of a body on its route, swinging in step about a joint at a height."""

    @cache  # two cameras ask for each time
    def motion(time: float) -> Pose:
        upright = Rotation.from_euler("z", route.heading(time))
        angle = Rotation.from_euler("y", swing * np.sin(route.phase(time)))
        return Pose(upright, (*route.place(time), floor)) @ hinged((0.0, 0.0, joint), angle)

    return Actor(limb.mesh, limb.temperature, motion)


@dataclass(frozen=True)
class Finger:
    """Finger of a flat hand in the plane y = 0: x and z of its ends, half its thickness [m]."""

    root: tuple[float, float]
    tip: tuple[float, float]
    radius: float


PALM: Final = (0.042, 0.014, 0.050)  # semi-axes of the palm, whose middle is the origin [m]
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
_WARMTH, _RATE = 306.15, 0.8  # temperature of a hand [K], bends of its first finger [1/s]
_SOFTNESS: Final = 0.002  # width of the edge of a print [m]


def hand(motion: Motion, *, flex: float = 0.0) -> list[Actor]:
    """Hand on its forearm, flat in the plane y = 0: palm with forearm, and five fingers.

    The motion is that of the palm. Each finger bends at its root by up to `flex` [rad]: the first
    at `_RATE`, each of the others a little more often.
    """
    bones = (ellipsoid(PALM, (0.0, 0.0, 0.0), _FINE), capsule(*FOREARM, _SPACING))
    palm = painted([(bone, _WARMTH) for bone in bones], motion)
    return [palm, *(_finger(n, motion, flex) for n in range(len(FINGERS)))]


def _finger(number: int, motion: Motion, flex: float) -> Actor:
    finger = FINGERS[number]
    root, tip = ((x, 0.0, z) for x, z in (finger.root, finger.tip))

    @cache
    def bent(time: float) -> Pose:
        phase = 2.0 * np.pi * _RATE * (1.0 + 0.13 * number) * time + number
        return motion(time) @ hinged(root, Rotation.from_euler("x", flex * np.sin(phase)))

    return painted([(capsule(root, tip, finger.radius, _FINE), _WARMTH)], bent)


def imprint(places: npt.ArrayLike) -> Array:
    """Contact of a flat hand with a surface: 1 under the hand, 0 beyond it, smooth between.

    Of places (place, 2), x and z in the plane of the hand [m].
    """
    places = np.asarray(places, dtype=np.float64)
    scale = np.linalg.norm(places / (PALM[0], PALM[2]), axis=1)
    palm = (1.0 - scale) * min(PALM[0], PALM[2])
    fingers = [finger.radius - _to_segment(places, finger.root, finger.tip) for finger in FINGERS]
    return np.asarray(0.5 * (1.0 + np.tanh(np.max([palm, *fingers], axis=0) / _SOFTNESS)))


def _to_segment(places: Array, *ends: tuple[float, float]) -> Array:
    """Distance [m] of places (place, 2) from the segment between two points."""
    start, end = np.array(ends)
    along = end - start
    share = np.clip((places - start) @ along / (along @ along), 0.0, 1.0)
    return np.asarray(np.linalg.norm(places - start - share[:, np.newaxis] * along, axis=1))


_TOY, _MOTOR = 0.006, 315.15  # distance of the vertices [m], and temperature of the bonnet [K]


def toy(motion: Motion, *, body: float = 303.15) -> Actor:
    """Toy car, 0.16 m long, that runs along x on z = 0: body at a temperature [K], warm bonnet."""
    frame = trimesh.creation.box((0.16, 0.07, 0.04)).apply_translation((0, 0, 0.035))
    cabin = trimesh.creation.box((0.08, 0.06, 0.04)).apply_translation((-0.02, 0, 0.07))
    bonnet = ellipsoid((0.03, 0.03, 0.012), (0.05, 0, 0.055), _TOY)
    return painted([(frame, body), (cabin, body), (bonnet, _MOTOR)], motion)


LETTERS: Final = {
    "C": tuple(
        (0.5 + 0.5 * np.cos(angle), 0.5 + 0.5 * np.sin(angle))
        for angle in np.radians(np.linspace(45.0, 315.0, 28))
    ),
    "V": ((0.0, 1.0), (0.5, 0.0), (1.0, 1.0)),
}
"""Letter -> the path of the pen, in a square of unit size."""


@dataclass(frozen=True)
class Writing:
    """Letters that a cold, wet finger writes on a board, one after the other.

    A fresh stroke is colder than the board by nearly the wet-bulb depression, which at 22 degrees
    Celsius is 8.2 K in air of 40 % and 6.6 K in air of 50 % humidity [1]_; at a coefficient of 10 W
    m^-2 K^-1 and 6 K, 1 um of water takes 41 s to evaporate.

    References
    ----------
    .. [1] Stull (2011), Wet-Bulb Temperature from Relative Humidity and Air Temperature, Journal of
       Applied Meteorology and Climatology 50, 2267, doi:10.1175/JAMC-D-11-0143.1
    """

    text: str = "CV"  # letters of `LETTERS`
    start: float = 3.0  # of the first letter [s]
    pace: float = 0.05  # of the finger [m/s]
    pause: float = 1.5  # after each letter [s]
    size: float = 0.10  # height of the letters [m]
    gap: float = 0.04  # between two letters [m]
    stroke: float = 0.016  # width of a stroke [m]
    drop: float = 6.0  # how much colder than the board a fresh stroke is [K]
    drying: float = 40.0  # time in which that falls to 1/e [s]

    def path(self) -> tuple[Array, Array]:
        """Times (point,) [s] and places (point, 2) [m] of the finger, about the text's middle."""
        times, places, now = [], [], self.start
        for number, letter in enumerate(self.text):
            points = _dense(np.array(LETTERS[letter]) * self.size, self.stroke / 8.0)
            lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
            times.append(now + np.concatenate([[0.0], np.cumsum(lengths)]) / self.pace)
            places.append(points + np.array([number * (self.size + self.gap), 0.0]))
            now = times[-1][-1] + self.pause
        width = len(self.text) * (self.size + self.gap) - self.gap
        return np.concatenate(times), np.concatenate(places) - (width / 2.0, self.size / 2.0)


def _dense(points: Array, step: float) -> Array:
    """A polyline with more points on it, at most a step apart."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    places = np.linspace(0.0, along[-1], int(np.ceil(along[-1] / step)) + 1)
    return np.stack([np.interp(places, along, column) for column in points.T], axis=1)


def board(
    mesh: trimesh.Trimesh, places: Array, writing: Writing, temperature: float, motion: Motion
) -> Actor:
    r"""Board with cold strokes that appear as they are written, and fade.

    .. math:: T(t) = T_0 - d \, e^{-(t - t_w) / \tau} \quad (t \ge t_w)

    The place (vertex, 2) of each vertex is about the text's middle [m], T_0 the temperature of the
    dry board [K].
    """
    times, path = writing.path()
    near = np.linalg.norm(places[:, np.newaxis] - path, axis=2) < writing.stroke / 2.0
    written = np.min(np.where(near, times, np.inf), axis=1)

    def warmth(time: float) -> Array:
        fresh = np.where(written <= time, writing.drop, 0.0)
        age = np.where(written <= time, time - written, 0.0)
        return np.asarray(temperature - fresh * np.exp(-age / writing.drying))

    return Actor(mesh, warmth, motion)
