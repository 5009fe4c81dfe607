"""Surfaces of revolution about the z axis: any profile, limbs, and three vessels of glass."""

import itertools
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from dbthermal.simulation._mesh import Array, Indices, Surface, moved, pieces, positive_lengths

Profile = tuple[tuple[float, float], ...]

WINEGLASS_PROFILE: Final[Profile] = (
    *((0.0370, 0.0000), (0.0250, 0.0040), (0.0100, 0.0080), (0.0050, 0.0150), (0.0040, 0.0300)),
    *((0.0040, 0.0700), (0.0055, 0.0860), (0.0160, 0.0960), (0.0300, 0.1090), (0.0400, 0.1290)),
    *((0.0420, 0.1450), (0.0400, 0.1700), (0.0355, 0.1950), (0.0330, 0.2100)),
)
"""Radius and height of the outer wall of a wineglass, foot to rim, drawn for this project after
glasses of some 0.4 l [m]."""

WINEGLASS_CAVITY: Final = (0.0960, 0.2100)
"""Heights between which the wineglass is hollow, bottom of the bowl and rim [m]."""

COFFEE_POT_PROFILE: Final[Profile] = (
    *((0.0480, 0.0000), (0.0560, 0.0040), (0.0630, 0.0150), (0.0680, 0.0400), (0.0680, 0.0600)),
    *((0.0630, 0.0900), (0.0530, 0.1150), (0.0430, 0.1350), (0.0400, 0.1480), (0.0430, 0.1650)),
)
"""Radius and height of the outer wall of a glass coffee pot, bottom to rim, drawn for this
project after pots of some 1.2 l [m]."""

COFFEE_POT_CAVITY: Final = (0.0, 0.1650)
"""Heights between which the coffee pot is hollow [m]."""

BULB_PROFILE: Final[Profile] = (
    *((0.0130, 0.0000), (0.0140, 0.0100), (0.0180, 0.0220), (0.0240, 0.0340), (0.0285, 0.0450)),
    *((0.0300, 0.0550), (0.0285, 0.0648), (0.0240, 0.0735), (0.0170, 0.0802), (0.0090, 0.0841)),
    (0.0, 0.0855),
)
"""Radius and height of the glass of a light bulb 60 mm wide, cap to top, drawn for this project
after the common A60 shape [m]."""

_ROW: Final = np.sqrt(0.75)
"""Distance of the rows of equilateral triangles, in their sides [1]."""

_CORNER: Final = np.deg2rad(30.0)
"""A profile that turns by more than this has a corner, which the mesh keeps [rad]."""

_SAMPLES: Final = 400
"""Points along a smooth profile before it is cut into pieces of the asked spacing."""


def revolution(radius: npt.ArrayLike, height: npt.ArrayLike, spacing: float) -> Surface:
    """
    A profile turned about the z axis.

    The profile is cut into rows of equal distance, and every row holds as many vertices as its
    circle has room for, so the triangles stay even up to the poles. Corners of more than 30
    degrees are kept.

    Parameters
    ----------
    radius, height : array_like, shape (point,)
        The profile as a polyline [m]. The outside lies to its right: a wall runs upward. The
        radius is zero at a pole, which can only be an end; another end is an open rim.
    spacing : float
        Distance of neighbours [m].

    Returns
    -------
    Surface
        Closed if both ends are poles.

    Raises
    ------
    ValueError
        If the profile is not two arrays of one length of at least 2, repeats a point, or has a
        radius that is negative, or zero between the ends.
    """
    profile = np.stack(np.broadcast_arrays(radius, height), axis=-1).astype(np.float64)
    _check_profile(profile)
    rows = _rows(profile, float(positive_lengths("spacing", spacing)))
    counts = np.maximum(3, np.round(2.0 * np.pi * rows[:, 0] / spacing)).astype(np.int64)
    counts[rows[:, 0] == 0] = 1
    first = np.cumsum([0, *counts])
    # Every second row is turned by half a step, as the rows of equilateral triangles are.
    turns = [(np.arange(n) + 0.5 * (row % 2)) / n for row, n in enumerate(counts)]
    angle = 2.0 * np.pi * np.concatenate(turns)
    distance, level = np.repeat(rows, counts, axis=0).T
    faces = [_band(*pair) for pair in zip(first[:-2], turns[:-1], turns[1:], strict=True)]
    place = np.stack([distance * np.cos(angle), distance * np.sin(angle), level], axis=1)
    return Surface(place, np.concatenate(faces))


def _check_profile(profile: Array) -> None:
    """Raise a ValueError unless a polyline can be turned about the z axis."""
    if profile.ndim != 2 or len(profile) < 2 or not np.all(np.isfinite(profile)):
        raise ValueError(f"Invalid profile of shape {profile.shape}. Must be finite, 2 points on.")
    if np.any(profile[:, 0] < 0) or np.any(profile[1:-1, 0] == 0):
        raise ValueError(
            f"Invalid radius {profile[:, 0].min()} m in the profile. "
            "Must be positive, or zero at an end."
        )
    if np.any(np.hypot(*np.diff(profile, axis=0).T) == 0):
        raise ValueError("Invalid profile: a point is repeated. Must differ from the one before.")


def _rows(profile: Array, spacing: float) -> Array:
    """Points along a profile at equal distances between its corners, (row, 2) [m]."""
    step = np.diff(profile, axis=0)
    turn = np.abs(np.diff(np.unwrap(np.arctan2(step[:, 1], step[:, 0]))))
    ends = [0, *(np.flatnonzero(turn > _CORNER) + 1), len(profile) - 1]
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*step.T))])
    row = _ROW * spacing
    cuts = [
        np.linspace(along[a], along[b], int(pieces(along[b] - along[a], row)) + 1)[:-1]
        for a, b in itertools.pairwise(ends)
    ]
    places = np.concatenate([*cuts, along[-1:]])
    return np.stack([np.interp(places, along, column) for column in profile.T], axis=1)


def _band(first: int, lower: Array, upper: Array) -> Indices:
    """
    Faces between two neighbouring rings, of any two numbers of vertices.

    Parameters
    ----------
    first : int
        Number of the first vertex of the lower ring; those of the upper ring follow it.
    lower, upper : ndarray
        Angles of the vertices, in turns.

    Returns
    -------
    ndarray, shape (face, 3)
        One face for each edge of either ring, in the order of the middles of the edges; a ring
        of one vertex is a pole and has no edge.
    """
    below, above = len(lower), len(upper)
    bottom, top = lower + 0.5 / below, upper + 0.5 / above
    j, k = np.arange(below), np.arange(above)
    tip = np.searchsorted(top, bottom, side="left") % above
    foot = np.searchsorted(bottom, top, side="right") % below
    start = first + below
    standing = np.stack([first + j, first + (j + 1) % below, start + tip], axis=1)
    hanging = np.stack([start + k, first + foot, start + (k + 1) % above], axis=1)
    return np.concatenate(
        [standing[: below if below > 1 else 0], hanging[: above if above > 1 else 0]]
    )


def capsule(start: npt.ArrayLike, end: npt.ArrayLike, radius: float, spacing: float) -> Surface:
    """
    A cylinder with round ends between two points: a finger, an arm, a leg.

    Parameters
    ----------
    start, end : array_like, shape (3,)
        Centres of the two round ends [m].
    radius : float
        Radius [m].
    spacing : float
        Distance of neighbours [m].

    Returns
    -------
    Surface
        Closed.

    Raises
    ------
    ValueError
        If the points coincide, or a length is not finite and positive.
    """
    axis = np.asarray(end, dtype=np.float64) - np.asarray(start, dtype=np.float64)
    length = float(positive_lengths("length of a capsule", np.linalg.norm(axis)))
    angle = np.linspace(0.0, np.pi / 2.0, _SAMPLES // 4)
    quarter = float(positive_lengths("radius", radius)) * np.stack([np.sin(angle), np.cos(angle)])
    upright = revolution(
        np.concatenate([quarter[0], quarter[0, ::-1]]),
        np.concatenate([-quarter[1], length + quarter[1, ::-1]]),
        spacing,
    )
    rotation, _ = Rotation.align_vectors([axis], [(0.0, 0.0, 1.0)])
    return moved(upright, rotation, start)


def _turned(points: Profile, spacing: float, *, floor: bool) -> Surface:
    """A smooth profile through given points turned, with a flat floor beneath it if asked."""
    radius, height = np.array(points).T
    along = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(radius), np.diff(height)))])
    places = np.linspace(0.0, along[-1], _SAMPLES)
    distance, level = (PchipInterpolator(along, column)(places) for column in (radius, height))
    distance[-1] = radius[-1]  # a pole stays one, whatever the rounding of the interpolation
    if floor:
        distance, level = np.insert(distance, 0, 0.0), np.insert(level, 0, height[0])
    return revolution(distance, level, spacing)


def wineglass(spacing: float = 0.003) -> Surface:
    """
    Outer wall of a wineglass, 0.21 m high on a foot 74 mm wide, open at the rim.

    Parameters
    ----------
    spacing : float
        Distance of neighbours; the stem is 8 mm thick [m].

    Returns
    -------
    Surface
        `WINEGLASS_PROFILE` turned, with the underside of the foot. It is hollow between the
        heights of `WINEGLASS_CAVITY`.
    """
    return _turned(WINEGLASS_PROFILE, spacing, floor=True)


def coffee_pot(spacing: float = 0.004) -> Surface:
    """
    Outer wall of a glass coffee pot, 0.165 m high and 0.136 m wide, open at the rim.

    Parameters
    ----------
    spacing : float
        Distance of neighbours [m].

    Returns
    -------
    Surface
        `COFFEE_POT_PROFILE` turned, with its bottom.
    """
    return _turned(COFFEE_POT_PROFILE, spacing, floor=True)


def bulb(spacing: float = 0.0015) -> Surface:
    """
    Glass of a light bulb, 60 mm wide and 86 mm high, open where its cap begins.

    Parameters
    ----------
    spacing : float
        Distance of neighbours [m].

    Returns
    -------
    Surface
        `BULB_PROFILE` turned, the cap below.
    """
    return _turned(BULB_PROFILE, spacing, floor=False)
