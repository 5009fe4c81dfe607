"""Meshes of the twins: plates, ellipsoids, limbs, and vessels turned about the z axis.

Lengths are in metres, z is up, the normals point outward. Most shapes are those of
`trimesh.creation`; here they get vertices at a `spacing`, so that a mesh refines by one number.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from dbthermal.planck import require_positive
from dbthermal.simulation.rays import Array

Profile = tuple[tuple[float, float], ...]

WINEGLASS_PROFILE: Final[Profile] = (
    *((0.0370, 0.0000), (0.0250, 0.0040), (0.0100, 0.0080), (0.0050, 0.0150), (0.0040, 0.0300)),
    *((0.0040, 0.0700), (0.0055, 0.0860), (0.0160, 0.0960), (0.0300, 0.1090), (0.0400, 0.1290)),
    *((0.0420, 0.1450), (0.0400, 0.1700), (0.0355, 0.1950), (0.0330, 0.2100)),
)
"""Radius and height of the outer wall of a wineglass, foot to rim, drawn for this project after
glasses of some 0.4 l [m]."""

COFFEE_POT_PROFILE: Final[Profile] = (
    *((0.0480, 0.0000), (0.0560, 0.0040), (0.0630, 0.0150), (0.0680, 0.0400), (0.0680, 0.0600)),
    *((0.0630, 0.0900), (0.0530, 0.1150), (0.0430, 0.1350), (0.0400, 0.1480), (0.0430, 0.1650)),
)
"""Radius and height of the outer wall of a glass coffee pot, bottom to rim, drawn for this
project after pots of some 1.2 l [m]."""

BULB_PROFILE: Final[Profile] = (
    *((0.0130, 0.0000), (0.0140, 0.0100), (0.0180, 0.0220), (0.0240, 0.0340), (0.0285, 0.0450)),
    *((0.0300, 0.0550), (0.0285, 0.0648), (0.0240, 0.0735), (0.0170, 0.0802), (0.0090, 0.0841)),
    (0.0, 0.0855),
)
"""Radius and height of the glass of a light bulb 60 mm wide, cap to top, drawn for this project
after the common A60 shape [m]."""


def plate(width: float, height: float, spacing: float) -> trimesh.Trimesh:
    """
    Upright rectangle in the plane y = 0, centred in x, from z = 0 up, with its normal along -y.

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
    """Stretched geodesic sphere about a point; along its longest axis `spacing` is the largest."""
    edge = np.arctan(2.0) * max(semi_axes) / require_positive("spacing [m]", spacing)
    ball = trimesh.creation.icosphere(max(0, int(np.ceil(np.log2(edge)))))
    return trimesh.Trimesh(ball.vertices * semi_axes + middle, ball.faces, process=False)


def capsule(
    start: npt.ArrayLike, end: npt.ArrayLike, radius: float, spacing: float
) -> trimesh.Trimesh:
    """Cylinder with round ends, centred at two points: a finger, an arm, a leg."""
    start, end = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    count = 2 * _pieces(np.pi * radius, spacing)
    mesh = trimesh.creation.capsule(np.linalg.norm(end - start), radius, count=[count, count])
    turn, _ = Rotation.align_vectors([end - start], [(0.0, 0.0, 1.0)])
    return moved(mesh, turn, (start + end) / 2.0)


def vessel(profile: Profile, spacing: float, *, floor: bool) -> trimesh.Trimesh:
    """Smooth profile turned about the z axis, open at its top rim, with a flat floor or without."""
    points = np.array(profile)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    places = np.linspace(0.0, along[-1], _pieces(along[-1], spacing) + 1)
    wall = PchipInterpolator(along, points)(places)
    wall[-1] = points[-1]  # a pole stays one, whatever the rounding of the interpolation
    if floor:
        radii = np.linspace(0.0, points[0, 0], _pieces(points[0, 0], spacing) + 1)[:-1]
        wall = np.concatenate([np.stack([radii, np.full(radii.size, points[0, 1])], 1), wall])
    return revolved(wall, spacing)


def revolved(profile: npt.ArrayLike, spacing: float) -> trimesh.Trimesh:
    """Profile of radius and height (point, 2) [m] turned about the z axis, outside to its right."""
    profile = np.asarray(profile, dtype=np.float64)
    sections = _pieces(2.0 * np.pi * profile[:, 0].max(), spacing)
    return trimesh.creation.revolve(profile, sections=sections)


def wineglass(spacing: float = 0.003) -> trimesh.Trimesh:
    """Outer wall of a wineglass, 0.21 m high on a foot 74 mm wide, with a stem of 8 mm."""
    return vessel(WINEGLASS_PROFILE, spacing, floor=True)


def coffee_pot(spacing: float = 0.004) -> trimesh.Trimesh:
    """Outer wall of a glass coffee pot, 0.165 m high and 0.136 m wide."""
    return vessel(COFFEE_POT_PROFILE, spacing, floor=True)


def bulb(spacing: float = 0.0015) -> trimesh.Trimesh:
    """Glass of a light bulb, 60 mm wide and 86 mm high, open below, where its cap begins."""
    return vessel(BULB_PROFILE, spacing, floor=False)


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
    require_positive("length and spacing [m]", (length, spacing))
    return max(1, int(np.ceil(length / spacing - 1e-9)))


def on_wall(mesh: trimesh.Trimesh, height: float, angle: float) -> tuple[float, float, float]:
    """
    Point on the wall of a mesh of revolution about the z axis.

    The angle about the axis is from negative y towards positive x [degrees]; x, y and z are in [m].
    """
    levels, first = np.unique(mesh.vertices[:, 2], return_index=True)
    radii: Array = np.linalg.norm(mesh.vertices[first, :2], axis=1)
    radius, turn = float(np.interp(height, levels, radii)), np.radians(angle)
    return radius * float(np.sin(turn)), -radius * float(np.cos(turn)), height
