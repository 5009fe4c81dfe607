"""Meshes of the twins: plates, ellipsoids, limbs, and vessels turned about the z axis.

Lengths are in metres, z is up, the normals point outward. Unlike those of `trimesh.creation`, the
shapes have even triangles up to the poles, at a `spacing` that refines a mesh by one number.
"""

import itertools
from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from dbthermal._arrays import Array
from dbthermal._numbers import POSITIVE, real_numbers
from reproduction.twins.rays import unit

Profile = tuple[tuple[float, float], ...]

WINEGLASS_PROFILE: Final[Profile] = (
    *((0.0370, 0.0000), (0.0250, 0.0040), (0.0100, 0.0080), (0.0050, 0.0150), (0.0040, 0.0300)),
    *((0.0040, 0.0700), (0.0055, 0.0860), (0.0160, 0.0960), (0.0300, 0.1090), (0.0400, 0.1290)),
    *((0.0420, 0.1450), (0.0400, 0.1700), (0.0355, 0.1950), (0.0330, 0.2100)),
)
"""Radius and height of the outer wall of a wineglass, foot to rim, drawn for this project after
glasses of some 0.4 l: 0.21 m high on a foot 74 mm wide, with a stem of 8 mm [m]."""

COFFEE_POT_PROFILE: Final[Profile] = (
    *((0.0480, 0.0000), (0.0560, 0.0040), (0.0630, 0.0150), (0.0680, 0.0400), (0.0680, 0.0600)),
    *((0.0630, 0.0900), (0.0530, 0.1150), (0.0430, 0.1350), (0.0400, 0.1480), (0.0430, 0.1650)),
)
"""Radius and height of the outer wall of a glass coffee pot, bottom to rim, drawn for this
project after pots of some 1.2 l [m]."""

_ROW: Final = np.sqrt(0.75)  # distance of the rows of equilateral triangles, in their sides [1]
_CORNER: Final = np.deg2rad(30.0)  # angle of a profile's corners, which the mesh keeps [rad]
_SAMPLES: Final = 400  # points along a smooth profile before it is cut into rows


def plate(width: float, height: float, spacing: float) -> trimesh.Trimesh:
    """Upright rectangle in the plane y = 0, centred in x, from z = 0 up, with its normal along -y.

    The vertices form a regular grid, row by row from below, with all diagonals parallel: there
    the Laplacian of the mesh is the five-point difference.
    """
    columns, rows = (_pieces(length, spacing) for length in (width, height))
    x, z = np.meshgrid(
        np.linspace(-width / 2.0, width / 2.0, columns + 1), np.linspace(0.0, height, rows + 1)
    )
    number = np.arange(x.size).reshape(x.shape)
    low, right = number[:-1, :-1].ravel(), number[:-1, 1:].ravel()
    above, far = number[1:, :-1].ravel(), number[1:, 1:].ravel()
    faces = np.concatenate([np.stack([low, right, far], 1), np.stack([low, far, above], 1)])
    vertices = np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1)
    return trimesh.Trimesh(vertices, faces, process=False)


def ellipsoid(semi_axes: Sequence[float], middle: npt.ArrayLike, spacing: float) -> trimesh.Trimesh:
    """Stretched geodesic sphere about a point; along its longest axis `spacing` is the largest.

    The faces of an icosahedron are cut evenly, its edges into n pieces: 10 n^2 + 2 vertices.
    """
    count = _pieces(np.arctan(2.0) * max(semi_axes), spacing)
    grid = [(i, j) for i in range(count + 1) for j in range(count + 1 - i)]
    number = {point: index for index, point in enumerate(grid)}
    up = [((i, j), (i + 1, j), (i, j + 1)) for i, j in grid if i + j < count]
    down = [(q, (p[0] + 1, p[1] + 1), r) for p, q, r in up if sum(p) < count - 1]
    cells = np.array([[number[corner] for corner in face] for face in up + down])
    first, second = np.array(grid, dtype=np.float64).T / count
    weights = np.stack([1.0 - first - second, first, second], axis=1)
    points = np.einsum("pk,fkd->fpd", weights, trimesh.creation.icosahedron().triangles)
    faces = cells + len(grid) * np.arange(len(points))[:, np.newaxis, np.newaxis]
    # Processed, the vertices that neighbouring faces share become one.
    ball = trimesh.Trimesh(unit(points).reshape(-1, 3), faces.reshape(-1, 3))
    vertices = ball.vertices * np.asarray(semi_axes) + np.asarray(middle)
    return trimesh.Trimesh(vertices, ball.faces, process=False)


def capsule(
    start: npt.ArrayLike, end: npt.ArrayLike, radius: float, spacing: float
) -> trimesh.Trimesh:
    """Cylinder with round ends, centred at two points: a finger, an arm, a leg."""
    axis = np.asarray(end, dtype=np.float64) - np.asarray(start, dtype=np.float64)
    angle = np.linspace(0.0, np.pi / 2.0, _SAMPLES // 4)
    radial, axial = radius * np.sin(angle), radius * np.cos(angle)
    below, above = np.stack([radial, -axial], 1), np.stack([radial, axial], 1)[::-1]
    profile = np.concatenate([below, above + np.array([0.0, np.linalg.norm(axis)])])
    turn, _ = Rotation.align_vectors([axis], [(0.0, 0.0, 1.0)])
    return moved(revolved(profile, spacing), turn, start)


def vessel(profile: Profile, spacing: float) -> trimesh.Trimesh:
    """Smooth profile turned about the z axis, open at its top rim, with a flat floor."""
    points = np.array(profile)
    along = _along(points)
    wall = PchipInterpolator(along, points)(np.linspace(0.0, along[-1], _SAMPLES))
    return revolved(np.concatenate([[(0.0, points[0, 1])], wall]), spacing)


def revolved(profile: npt.ArrayLike, spacing: float) -> trimesh.Trimesh:
    """Profile of radius and height (point, 2) [m] turned about the z axis, outside to its right.

    It is cut into rows of equal distance between its corners, and every row holds as many vertices
    as its circle has room for. The radius is zero at a pole, which can only be an end; another end
    is an open rim.
    """
    rows = _rows(np.asarray(profile, dtype=np.float64), spacing)
    counts = np.maximum(3, np.round(2.0 * np.pi * rows[:, 0] / spacing)).astype(np.int64)
    counts[rows[:, 0] == 0] = 1
    first = np.cumsum([0, *counts])
    # Every second row is turned by half a step, as the rows of equilateral triangles are.
    turns = [(np.arange(n) + 0.5 * (row % 2)) / n for row, n in enumerate(counts)]
    angle = 2.0 * np.pi * np.concatenate(turns)
    radius, height = np.repeat(rows, counts, axis=0).T
    faces = [_band(*pair) for pair in zip(first[:-2], turns[:-1], turns[1:], strict=True)]
    vertices = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
    return trimesh.Trimesh(vertices, np.concatenate(faces), process=False)


def _along(points: Array) -> Array:
    """Arc length (point,) [m] of a polyline."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])


def _rows(profile: Array, spacing: float) -> Array:
    """Points along a profile at equal distances between its corners, (row, 2) [m]."""
    step = np.diff(profile, axis=0)
    turn = np.abs(np.diff(np.unwrap(np.arctan2(step[:, 1], step[:, 0]))))
    ends = [0, *(np.flatnonzero(turn > _CORNER) + 1), len(profile) - 1]
    along = _along(profile)
    cuts = [
        np.linspace(along[a], along[b], _pieces(along[b] - along[a], _ROW * spacing) + 1)[:-1]
        for a, b in itertools.pairwise(ends)
    ]
    places = np.concatenate([*cuts, along[-1:]])
    return np.stack([np.interp(places, along, column) for column in profile.T], axis=1)


def _band(first: int, lower: Array, upper: Array) -> npt.NDArray[np.int64]:
    """Faces (face, 3) between two neighbouring rings with vertices at angles [turns].

    `first` is the number of the lower ring's first vertex; those of the upper follow. There is one
    face for each edge of either ring; a ring of one vertex is a pole and has no edge.
    """
    below, above = len(lower), len(upper)
    bottom, top = lower + 0.5 / below, upper + 0.5 / above  # middles of the edges
    j, k = np.arange(below), np.arange(above)
    tip = np.searchsorted(top, bottom, side="left") % above
    foot = np.searchsorted(bottom, top, side="right") % below
    start = first + below
    standing = np.stack([first + j, first + (j + 1) % below, start + tip], axis=1)
    hanging = np.stack([start + k, first + foot, start + (k + 1) % above], axis=1)
    return np.concatenate([standing[: below * (below > 1)], hanging[: above * (above > 1)]])


def moved(
    mesh: trimesh.Trimesh,
    rotation: Rotation | None = None,
    translation: npt.ArrayLike = (0.0, 0.0, 0.0),
    *,
    scale: float = 1.0,
) -> trimesh.Trimesh:
    """Copy of a mesh, scaled and rotated about the origin, then translated [m]."""
    matrix = np.eye(4)
    matrix[:3, :3] = scale * (np.eye(3) if rotation is None else rotation.as_matrix())
    matrix[:3, 3] = translation
    return mesh.copy().apply_transform(matrix)


def _pieces(length: float, spacing: float) -> int:
    """Number of equal pieces of at most the spacing in a length; 1e-9 forgives rounding."""
    real_numbers("length and spacing [m]", (length, spacing), POSITIVE)
    return max(1, int(np.ceil(length / spacing - 1e-9)))


def on_wall(mesh: trimesh.Trimesh, height: float, angle: float) -> tuple[float, float, float]:
    """Point x, y, z [m] on the wall of a mesh of revolution, on the ring nearest to a height [m].

    The angle about the axis is from negative y towards positive x [degrees].
    """
    x, y, ring = mesh.vertices[np.argmin(np.abs(mesh.vertices[:, 2] - height))]
    radius, turn = float(np.hypot(x, y)), np.radians(angle)
    return radius * float(np.sin(turn)), -radius * float(np.cos(turn)), float(ring)
