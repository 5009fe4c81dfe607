r"""Rays: what a pinhole camera sees of a mesh, and where a mirror-like surface looks.

Directions are unit vectors in a world whose z points up; lengths are in metres. The mirror law is
:math:`r = d - 2 (d \cdot n) n` for a ray along d that meets a surface of unit normal n, which is
interpolated between the vertices' normals (smooth shading), so that a reflection does not break
up along the edges of the mesh.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt
import trimesh
from trimesh.ray.ray_pyembree import RayMeshIntersector

from dbthermal.simulation._mesh import Surface

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]
Point = tuple[float, float, float]

MISSED: Final = -1
"""Face number of a ray that meets nothing."""

# A reflected ray starts this far off the surface, in units of the mesh's size: well above the
# rounding of single precision, well below what can be seen.
_LIFT: Final = 1e-4
# Two points on a surface are one within this, in units of the mesh's size.
_SAME: Final = 1e-3


@dataclass(frozen=True)
class Camera:
    """
    A pinhole camera with square pixels.

    Attributes
    ----------
    position, target : tuple of float
        Where it is, and the point that its middle looks at [m].
    shape : tuple of int
        Rows and columns.
    field_of_view : float
        Horizontal field of view [degrees]; 24 in the paper.
    up : tuple of float
        Direction that is up in the image.
    """

    position: Point
    target: Point
    shape: tuple[int, int]
    field_of_view: float = 24.0
    up: Point = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        """Refuse what is no camera."""
        if not 0 < self.field_of_view < 180:
            raise ValueError(
                f"Invalid field_of_view {self.field_of_view} degrees. Must lie in (0, 180)."
            )
        if min(self.shape) < 1:
            raise ValueError(f"Invalid shape {self.shape} of the camera. Must be positive.")
        across = np.cross(np.subtract(self.target, self.position), self.up)
        if not np.linalg.norm(across) > 0:
            raise ValueError(
                f"Invalid up {self.up} of the camera at {self.position}. Must not be parallel to "
                f"the view, towards {self.target}."
            )

    @cached_property
    def axes(self) -> Array:
        """Unit vectors to the right, down and forward, shape (3, 3), a row each."""
        forward = unit(np.subtract(self.target, self.position))
        right = unit(np.cross(forward, self.up))
        return np.stack([right, np.cross(forward, right), forward])

    @property
    def _pixel(self) -> float:
        """Size of a pixel at unit distance [1]."""
        return float(2.0 * np.tan(np.radians(self.field_of_view) / 2.0) / self.shape[1])

    def directions(self, offset: npt.ArrayLike = (0.0, 0.0)) -> Array:
        """
        Directions of the rays, one a pixel.

        Parameters
        ----------
        offset : array_like, shape (2,) or (pixel, 2)
            Row and column, relative to the pixel's middle [pixel].

        Returns
        -------
        ndarray, shape (pixel, 3)
            Unit vectors, pixels in C order.
        """
        places = np.indices(self.shape).reshape(2, -1).T + np.asarray(offset)
        middle = (np.array(self.shape) - 1.0) / 2.0
        down, right = ((places - middle) * self._pixel).T
        return unit(np.stack([right, down, np.ones_like(right)], axis=-1) @ self.axes)

    def project(self, points: npt.ArrayLike) -> Array:
        """
        Where points appear in the image; the inverse of `directions`.

        Parameters
        ----------
        points : array_like, shape (..., 3)
            Points [m].

        Returns
        -------
        ndarray, shape (..., 2)
            Row and column of the point [pixel]; whole numbers are the middles of pixels.

        Raises
        ------
        ValueError
            If a point lies behind the camera.
        """
        right, down, depth = np.moveaxis((np.asarray(points) - self.position) @ self.axes.T, -1, 0)
        if not np.all(depth > 0):
            raise ValueError(f"Invalid depth {np.min(depth)} m of a point. Must be positive.")
        middle = (np.array(self.shape) - 1.0) / 2.0
        places = np.stack([down, right], axis=-1) / (depth[..., np.newaxis] * self._pixel)
        return np.asarray(places + middle)

    def beside(self, baseline: float) -> "Camera":
        """
        Another camera of the same kind that looks at the same target.

        Parameters
        ----------
        baseline : float
            How far it is to the right of this one [m].

        Returns
        -------
        Camera
            The other camera.
        """
        place = np.asarray(self.position) + baseline * self.axes[0]
        return replace(self, position=(float(place[0]), float(place[1]), float(place[2])))


@dataclass(frozen=True)
class Hits:
    """
    Where rays first meet a mesh.

    Attributes
    ----------
    face : ndarray of int, shape (ray,)
        Face that is met, or `MISSED`.
    distance : ndarray, shape (ray,)
        Way from the ray's origin [m], infinite where nothing is met.
    weights : ndarray, shape (ray, 3)
        Barycentric weights of the face's corners [1], zero where nothing is met.
    """

    face: Index
    distance: Array
    weights: Array

    @property
    def met(self) -> Mask:
        """Rays that meet the mesh, shape (ray,)."""
        return np.asarray(self.face != MISSED)

    def of(self, rays: Mask) -> "Hits":
        """Hits of some of the rays, in their order."""
        return Hits(self.face[rays], self.distance[rays], self.weights[rays])


class Caster:
    """
    A mesh that rays can be cast at.

    Parameters
    ----------
    surface : Surface
        The mesh; its normals point outward.
    """

    def __init__(self, surface: Surface) -> None:
        mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
        self.surface = surface
        self.corners: Array = surface.vertices[surface.faces]
        self.size = float(mesh.scale)
        self._intersector = RayMeshIntersector(mesh)

    def cast(self, origins: Array, directions: Array) -> Hits:
        """
        First meeting of each ray with the mesh.

        The face is found in single precision, the place on it in double.

        Parameters
        ----------
        origins, directions : ndarray, shape (ray, 3)
            Origins [m] and unit vectors.

        Returns
        -------
        Hits
            One a ray.
        """
        origins, directions = np.broadcast_arrays(origins, directions)
        face = np.asarray(self._intersector.intersects_first(origins, directions), dtype=np.int64)
        hits = Hits(face, np.full(face.shape, np.inf), np.zeros((face.size, 3)))
        met = hits.met
        weights = self._weights(face[met], origins[met], directions[met])
        place = np.einsum("rc,rcx->rx", weights, self.corners[face[met]])
        hits.weights[met] = weights
        hits.distance[met] = np.einsum("rx,rx->r", place - origins[met], directions[met])
        return hits

    def _weights(self, face: Index, origins: Array, directions: Array) -> Array:
        """Barycentric weights where rays meet the planes of faces that they are known to meet."""
        first, second, third = self.corners[face].swapaxes(0, 1)
        right, left, way = second - first, third - first, origins - first
        across = np.cross(directions, left)
        scale = np.einsum("rx,rx->r", right, across)
        u = np.einsum("rx,rx->r", way, across) / scale
        v = np.einsum("rx,rx->r", directions, np.cross(way, right)) / scale
        # A ray along the rim of a face may leave it by rounding: back onto it.
        inside = np.maximum(np.stack([1.0 - u - v, u, v], axis=-1), 0.0)
        return np.asarray(inside / inside.sum(axis=-1, keepdims=True))

    def points(self, hits: Hits) -> Array:
        """Points that are met, shape (ray, 3) [m]; only for rays that meet the mesh."""
        return np.asarray(np.einsum("rc,rcx->rx", hits.weights, self.corners[hits.face]))

    def interpolate(self, hits: Hits, values: Array) -> Array:
        """
        Values at the points that are met, linear within a face.

        Parameters
        ----------
        hits : Hits
            Rays that all meet the mesh.
        values : ndarray, shape (..., vertex)
            Values at the vertices.

        Returns
        -------
        ndarray, shape (..., ray)
            Values at the points, in the same unit.
        """
        parts = (values[..., self.surface.faces[hits.face, corner]] for corner in range(3))
        return np.asarray(sum(part * hits.weights[:, corner] for corner, part in enumerate(parts)))

    def mirrored(self, hits: Hits, directions: Array) -> tuple[Array, Array]:
        """
        Rays mirrored where they meet the mesh; both of its sides are mirrors.

        Parameters
        ----------
        hits : Hits
            Rays that all meet the mesh.
        directions : ndarray, shape (ray, 3)
            Their directions.

        Returns
        -------
        origins, directions : ndarray, shape (ray, 3)
            Of the mirrored rays. They start a little off the surface. Where the interpolated
            normal would send one into its own face, as it may at a silhouette, the face's normal
            is taken.
        """
        flat, smooth = self.surface.face_normals[hits.face], self._smooth_normals(hits)
        side = -np.sign(np.einsum("rx,rx->r", directions, flat))[:, np.newaxis]
        outward = side * flat
        mirrored = mirror(directions, smooth)
        inward = np.einsum("rx,rx->r", mirrored, outward) <= 0
        mirrored[inward] = mirror(directions[inward], flat[inward])
        return self.points(hits) + _LIFT * self.size * outward, mirrored

    def _smooth_normals(self, hits: Hits) -> Array:
        """Unit normals interpolated between the vertices', shape (ray, 3)."""
        corners = self.surface.vertex_normals[self.surface.faces[hits.face]]
        return unit(np.einsum("rc,rcx->rx", hits.weights, corners))

    def visible(self, points: Array, position: npt.ArrayLike) -> Mask:
        """
        Which points of the surface are seen from a position.

        Parameters
        ----------
        points : ndarray, shape (point, 3)
            Points on the surface [m].
        position : array_like, shape (3,)
            Where one looks from [m].

        Returns
        -------
        ndarray of bool, shape (point,)
            False where another part of the mesh is in the way.
        """
        way = points - np.asarray(position)
        hits = self.cast(np.broadcast_to(np.asarray(position), points.shape), unit(way))
        return np.asarray(hits.distance > np.linalg.norm(way, axis=-1) - _SAME * self.size)


def unit(vectors: npt.ArrayLike) -> Array:
    """Vectors (..., 3) divided by their length."""
    vectors = np.asarray(vectors, dtype=np.float64)
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def mirror(directions: Array, normals: Array) -> Array:
    r"""
    Mirror law, :math:`r = d - 2 (d \cdot n) n`.

    Parameters
    ----------
    directions, normals : ndarray, shape (..., 3)
        Directions of the rays, and unit normals, of either sign.

    Returns
    -------
    ndarray, shape (..., 3)
        Directions of the mirrored rays.
    """
    along = np.sum(directions * normals, axis=-1, keepdims=True)
    return np.asarray(directions - 2.0 * along * normals)
