"""The built-in surfaces: plates, boxes, balls, limbs, and vessels turned about the z axis.

Lengths are in metres, z is up, the normals point outward. Every shape takes the `spacing` of its
vertices, and its triangles are close to even, so a mesh refines by halving one number.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import ConvexHull

from dbthermal.simulation._mesh import (
    Array,
    Indices,
    Surface,
    merge,
    moved,
    pieces,
    positive_lengths,
    pruned,
    welded,
)
from reproduction.twins.turned import (
    BULB_PROFILE,
    COFFEE_POT_CAVITY,
    COFFEE_POT_PROFILE,
    WINEGLASS_CAVITY,
    WINEGLASS_PROFILE,
    bulb,
    capsule,
    coffee_pot,
    revolution,
    wineglass,
)

__all__ = [
    "BULB_PROFILE",
    "COFFEE_POT_CAVITY",
    "COFFEE_POT_PROFILE",
    "WINEGLASS_CAVITY",
    "WINEGLASS_PROFILE",
    "Surface",
    "box",
    "bulb",
    "capsule",
    "coffee_pot",
    "ellipsoid",
    "merge",
    "moved",
    "plate",
    "pruned",
    "revolution",
    "sphere",
    "wineglass",
]


def _grid(columns: int, rows: int) -> tuple[Array, Indices]:
    """Points of the unit square, (point, 2), and two faces a cell, counter-clockwise."""
    across, up = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1))
    number = np.arange(across.size).reshape(across.shape)
    low, right = number[:-1, :-1].ravel(), number[:-1, 1:].ravel()
    above, far = number[1:, :-1].ravel(), number[1:, 1:].ravel()
    faces = np.concatenate([np.stack([low, right, far], 1), np.stack([low, far, above], 1)])
    return np.stack([across.ravel(), up.ravel()], axis=1), faces


def plate(width: float, height: float, spacing: float) -> Surface:
    """
    An upright rectangle in the plane y = 0, seen from the side of negative y.

    The vertices form a regular grid with all diagonals parallel: there the Laplacian of the mesh
    is the five-point difference.

    Parameters
    ----------
    width, height : float
        Extent in x, centred, and in z, from 0 [m].
    spacing : float
        Largest distance of neighbours along x and z [m].

    Returns
    -------
    Surface
        Normals along -y; vertices row by row from below, x increasing within a row.

    Raises
    ------
    ValueError
        If a length is not finite and positive.
    """
    size = positive_lengths("size of a plate", (width, height))
    columns, rows = pieces(size, positive_lengths("spacing", spacing))
    points, faces = _grid(int(columns), int(rows))
    across = (points[:, 0] - 0.5) * width
    return Surface(np.stack([across, np.zeros(len(points)), points[:, 1] * height], 1), faces)


def box(size: Sequence[float], spacing: float) -> Surface:
    """
    A closed box on the plane z = 0, centred in x and y.

    Parameters
    ----------
    size : sequence of float
        Extent in x, y and z [m].
    spacing : float
        Largest distance of neighbours along the edges [m].

    Returns
    -------
    Surface
        Six grids that share the vertices of their edges.

    Raises
    ------
    ValueError
        If a length is not finite and positive.
    """
    extent = positive_lengths("size of a box", size)
    if extent.shape != (3,):
        raise ValueError(f"Invalid size of a box {size} m. Must be three lengths.")
    counts = pieces(extent, positive_lengths("spacing", spacing))
    vertices, faces, start = [], [], 0
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        points, cells = _grid(int(counts[first]), int(counts[second]))
        for side in (0.0, 1.0):
            place = np.full((len(points), 3), side)
            place[:, [first, second]] = points
            vertices.append((place - (0.5, 0.5, 0.0)) * extent)
            faces.append(start + (cells if side else cells[:, ::-1]))
            start += len(points)
    return welded(np.concatenate(vertices), np.concatenate(faces), 1e-6 * float(spacing))


def sphere(radius: float, spacing: float) -> Surface:
    """
    A geodesic sphere around the origin: an icosahedron whose faces are cut evenly.

    Parameters
    ----------
    radius : float
        Radius of the vertices [m].
    spacing : float
        Distance of neighbours, which the cut edges of the icosahedron do not exceed [m].

    Returns
    -------
    Surface
        10 n^2 + 2 vertices, where n is the number of pieces of an edge.

    Raises
    ------
    ValueError
        If a length is not finite and positive.
    """
    radius, spacing = (
        float(positive_lengths("radius", radius)),
        float(positive_lengths("spacing", spacing)),
    )
    ratio = (1.0 + np.sqrt(5.0)) / 2.0
    corners = np.array([(0.0, s, t * ratio) for s in (-1.0, 1.0) for t in (-1.0, 1.0)])
    corners = np.concatenate([np.roll(corners, shift, axis=1) for shift in range(3)])
    corners /= np.hypot(1.0, ratio)
    sides = corners[ConvexHull(corners).simplices]
    inward = np.linalg.det(sides) < 0
    sides[inward] = sides[inward][:, ::-1]
    arc = radius * np.arctan(2.0)
    weights, cells = _triangle(int(pieces(arc, spacing)))
    points = np.einsum("pk,fkd->fpd", weights, sides)
    points /= np.linalg.norm(points, axis=2, keepdims=True)
    faces = cells + len(weights) * np.arange(len(sides))[:, None, None]
    unit = welded(points.reshape(-1, 3), faces.reshape(-1, 3), 1e-6 * spacing / radius)
    return Surface(radius * unit.vertices, unit.faces)


def _triangle(pieces: int) -> tuple[Array, Indices]:
    """Barycentric points of a triangle with cut edges, (point, 3), and its small faces."""
    points = [(i, j) for i in range(pieces + 1) for j in range(pieces + 1 - i)]
    number = {point: index for index, point in enumerate(points)}
    up = [(p, (p[0] + 1, p[1]), (p[0], p[1] + 1)) for p in points if sum(p) < pieces]
    down = [(q, (p[0] + 1, p[1] + 1), r) for p, q, r in up if sum(p) < pieces - 1]
    faces = np.array([[number[corner] for corner in face] for face in up + down])
    first, second = np.array(points, dtype=np.float64).T / pieces
    return np.stack([1.0 - first - second, first, second], axis=1), faces


def ellipsoid(semi_axes: Sequence[float], spacing: float) -> Surface:
    """
    An ellipsoid around the origin, as a stretched sphere.

    Parameters
    ----------
    semi_axes : sequence of float
        Half the extent in x, y and z [m].
    spacing : float
        Distance of neighbours along the longest axis; they are closer elsewhere [m].

    Returns
    -------
    Surface
        Closed.

    Raises
    ------
    ValueError
        If a length is not finite and positive.
    """
    axes = positive_lengths("semi-axes", semi_axes)
    if axes.shape != (3,):
        raise ValueError(f"Invalid semi-axes {semi_axes} m. Must be three lengths.")
    unit = sphere(1.0, spacing / float(axes.max()))
    return Surface(unit.vertices * axes, unit.faces)
