r"""Ray casting: intersections of camera rays with a mesh, and rays mirrored at its surface.

Meshes are `trimesh.Trimesh`, directions unit vectors in a world whose z points up, lengths in
metres. The mirror law is :math:`r = d - 2 (d \cdot n) n` for a ray along d and a unit normal n,
which is interpolated between the vertices' normals (smooth shading), so that a reflection does not
break up along the edges of the mesh.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt
import trimesh
from trimesh.ray.ray_pyembree import RayMeshIntersector

from dbthermal._arrays import Array, Mask
from dbthermal._compiled import kept

Point = tuple[float, float, float]

MISSED: Final = -1  # face number of a ray that meets nothing

_UP: Final = (0.0, 0.0, 1.0)
# A reflected ray starts this far off the surface, in units of the mesh's size: well above the
# rounding of single precision, well below what can be seen.
_LIFT: Final = 1e-4
_SAME: Final = 1e-3  # two points on a surface are one within this, in units of the mesh's size


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with square pixels.

    At a position, with a target at the middle of its view [m], of a shape (rows, columns) and a
    horizontal field of view [degrees]; 24 in the paper.
    """

    position: Point
    target: Point
    shape: tuple[int, int]
    field_of_view: float = 24.0

    def __post_init__(self) -> None:
        """Check field of view, shape and direction."""
        if not 0 < self.field_of_view < 180:
            rule = "Must lie in (0, 180)"
            raise ValueError(f"Invalid field_of_view {self.field_of_view} degrees. {rule}.")
        if min(self.shape) < 1:
            raise ValueError(f"Invalid shape {self.shape} of the camera. Must be positive.")
        right = np.cross(np.subtract(self.target, self.position), _UP)
        if not np.linalg.norm(right) > 0:
            message = f"Invalid target {self.target} of the camera at {self.position}"
            raise ValueError(f"{message}. Must not be straight above or below.")

    @cached_property
    def axes(self) -> Array:
        """Unit vectors to the right, down and forward, shape (3, 3), a row each."""
        forward = unit(np.subtract(self.target, self.position))
        right = unit(np.cross(forward, _UP))
        return np.stack([right, np.cross(forward, right), forward])

    @property
    def _pixel(self) -> float:
        """Size of a pixel at unit distance [1]."""
        return float(2.0 * np.tan(np.radians(self.field_of_view) / 2.0) / self.shape[1])

    def directions(self, places: npt.ArrayLike | None = None) -> Array:
        """Unit vectors (..., 3) of the rays through rows and columns (..., 2) [pixel].

        By default through the pixels' middles, (pixel, 3) in C order.
        """
        if places is None:
            places = np.indices(self.shape).reshape(2, -1).T
        middle = (np.array(self.shape) - 1.0) / 2.0
        down, right = np.moveaxis((np.asarray(places) - middle) * self._pixel, -1, 0)
        return unit(np.stack([right, down, np.ones_like(right)], axis=-1) @ self.axes)

    def project(self, points: npt.ArrayLike) -> Array:
        """Row and column (..., 2) [pixel] at which points (..., 3) [m] appear.

        The inverse of `directions`; whole numbers are the middles of pixels. Raises a ValueError
        if a point lies behind the camera.
        """
        right, down, depth = np.moveaxis((np.asarray(points) - self.position) @ self.axes.T, -1, 0)
        if not np.all(depth > 0):
            raise ValueError(f"Invalid depth {np.min(depth)} m of a point. Must be positive.")
        middle = (np.array(self.shape) - 1.0) / 2.0
        places = np.stack([down, right], axis=-1) / (depth[..., np.newaxis] * self._pixel)
        return np.asarray(places + middle)

    def beside(self, baseline: float) -> "Camera":
        """Same camera moved to the right by a baseline [m], looking at the same target."""
        place = np.asarray(self.position) + baseline * self.axes[0]
        return replace(self, position=(float(place[0]), float(place[1]), float(place[2])))


@dataclass(frozen=True)
class Hits:
    """First intersections of rays with a mesh.

    `face` (ray) is the face that is met, or `MISSED`; `distance` (ray) that from the ray's origin
    [m], infinite where nothing is met; `weights` (ray, 3) the barycentric weights of the face's
    corners [1], zero where nothing is met.
    """

    face: npt.NDArray[np.int64]
    distance: Array
    weights: Array

    @property
    def met(self) -> Mask:
        """Rays that meet the mesh, shape (ray,)."""
        return np.asarray(self.face != MISSED)

    def select(self, rays: Mask) -> "Hits":
        """Intersections of the selected rays, in their order."""
        return Hits(self.face[rays], self.distance[rays], self.weights[rays])


@kept(nogil=True, error_model="numpy")
def _on_faces(
    face: npt.NDArray[np.int64], origins: Array, directions: Array, corners: Array
) -> tuple[Array, Array]:
    """Distance (ray,) and weights (ray, 3) in the faces' planes, as by Moller, Trumbore (1997)."""
    distance, weights = np.full(face.size, np.inf), np.zeros((face.size, 3))
    right, lower, way, normal, across = np.empty((5, 3))
    for ray in range(face.size):
        if face[ray] == MISSED:
            continue
        first, second, third = corners[face[ray]]
        towards = directions[ray]
        for k in range(3):
            right[k], lower[k] = second[k] - first[k], third[k] - first[k]
            way[k] = origins[ray, k] - first[k]
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            normal[k] = towards[i] * lower[j] - towards[j] * lower[i]
            across[k] = way[i] * right[j] - way[j] * right[i]
        scale = right[0] * normal[0] + right[1] * normal[1] + right[2] * normal[2]
        u = (way[0] * normal[0] + way[1] * normal[1] + way[2] * normal[2]) / scale
        v = (towards[0] * across[0] + towards[1] * across[1] + towards[2] * across[2]) / scale
        # A ray along the edge of a face may leave it by rounding: back onto it.
        shares = np.maximum(1.0 - u - v, 0.0), np.maximum(u, 0.0), np.maximum(v, 0.0)
        total, along = shares[0] + shares[1] + shares[2], 0.0
        for k in range(3):
            weights[ray, k] = shares[k] / total
        for k in range(3):
            place = weights[ray, 0] * first[k] + weights[ray, 1] * second[k]
            along += (place + weights[ray, 2] * third[k] - origins[ray, k]) * towards[k]
        distance[ray] = along
    return distance, weights


class Caster:
    """Ray caster for one mesh [m], whose normals point outward."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self.faces = np.asarray(mesh.faces)
        self.corners: Array = np.asarray(mesh.vertices)[self.faces]
        self.normals = vertex_normals(mesh)[self.faces]
        self.face_normals: Array = np.asarray(mesh.face_normals)
        self.size = float(mesh.scale)
        self._intersector = RayMeshIntersector(mesh)

    def cast(self, origins: Array, directions: Array) -> Hits:
        """First intersection of each ray, of origins [m] and unit directions (ray, 3).

        The face is found in single precision, the point on it in double.
        """
        origins = np.array(np.broadcast_to(origins, directions.shape))
        face = np.asarray(self._intersector.intersects_first(origins, directions), dtype=np.int64)
        return Hits(face, *_on_faces(face, origins, np.array(directions), self.corners))

    def points(self, hits: Hits) -> Array:
        """Points of intersection (ray, 3) [m]; all rays must meet the mesh."""
        return np.asarray(np.einsum("rc,rcx->rx", hits.weights, self.corners[hits.face]))

    def interpolate(self, hits: Hits, values: Array) -> Array:
        """Values (..., ray) linear within a face, of values (..., vertex); all rays must meet."""
        terms = (values[..., self.faces[hits.face, corner]] for corner in range(3))
        return np.asarray(sum(term * hits.weights[:, corner] for corner, term in enumerate(terms)))

    def mirrored(self, hits: Hits, directions: Array) -> tuple[Array, Array]:
        """Origins [m] and directions (ray, 3) of rays that the mesh reflects, on either side.

        All rays must meet the mesh. The reflected ones start a little off the surface. Where the
        interpolated normal would send one into its own face, as it may at a silhouette, the
        face's normal is taken.
        """
        flat = self.face_normals[hits.face]
        smooth = unit(np.einsum("rc,rcx->rx", hits.weights, self.normals[hits.face]))
        outward = -np.sign(np.einsum("rx,rx->r", directions, flat))[:, np.newaxis] * flat
        reflected = mirror(directions, smooth)
        inward = np.einsum("rx,rx->r", reflected, outward) <= 0
        reflected[inward] = mirror(directions[inward], flat[inward])
        return self.points(hits) + _LIFT * self.size * outward, reflected

    def visible(self, points: Array, position: npt.ArrayLike) -> Mask:
        """Points (point, 3) of the surface that no part of it hides from a position (3,) [m]."""
        way = points - np.asarray(position)
        hits = self.cast(np.broadcast_to(np.asarray(position), points.shape), unit(way))
        return np.asarray(hits.distance > np.linalg.norm(way, axis=-1) - _SAME * self.size)


def unit(vectors: npt.ArrayLike) -> Array:
    """Vectors (..., 3) divided by their length."""
    vectors = np.asarray(vectors, dtype=np.float64)
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def vertex_normals(mesh: trimesh.Trimesh) -> Array:
    """Unit normals (vertex, 3), the mean of the faces around a vertex weighted by their areas."""
    total = np.zeros((len(mesh.vertices), 3))
    area_vectors = np.asarray(mesh.face_normals) * np.asarray(mesh.area_faces)[:, np.newaxis]
    np.add.at(total, np.asarray(mesh.faces), area_vectors[:, np.newaxis, :])
    return unit(total)


def mirror(directions: Array, normals: Array) -> Array:
    r"""Mirror law :math:`r = d - 2 (d \cdot n) n` for directions and unit normals (..., 3)."""
    along = np.sum(directions * normals, axis=-1, keepdims=True)
    return np.asarray(directions - 2.0 * along * normals)
