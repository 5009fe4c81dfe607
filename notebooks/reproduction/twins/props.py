"""Objects among the surroundings: a toy car, a board that is written on."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import trimesh

from reproduction.twins.rays import Array
from reproduction.twins.surfaces import ellipsoid
from reproduction.twins.surroundings import Actor, Motion, painted

_SPACING: Final = 0.006
"""Distance of the vertices of a toy [m]."""


def toy(motion: Motion, *, body: float = 303.15, motor: float = 315.15) -> Actor:
    """Toy car, 0.16 m long, that runs along x on z = 0, body and bonnet at temperatures [K]."""
    frame = trimesh.creation.box((0.16, 0.07, 0.04)).apply_translation((0, 0, 0.035))
    cabin = trimesh.creation.box((0.08, 0.06, 0.04)).apply_translation((-0.02, 0, 0.07))
    bonnet = ellipsoid((0.03, 0.03, 0.012), (0.05, 0, 0.055), _SPACING)
    return painted([(frame, body), (cabin, body), (bonnet, motor)], motion)


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
