"""A triangle mesh as a record: areas, normals, volume, topology; and what joins and moves it.

Lengths are in metres, z is up. Faces turn counter-clockwise seen from outside, so the normals
point outward. The shapes themselves are in `reproduction.twins.surfaces`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

_FLATTEST: Final = 1e-9
"""A face whose area falls below this fraction of its longest edge squared is degenerate [1]."""


@dataclass(frozen=True, eq=False)
class Surface:
    """
    A triangle mesh.

    The arrays are kept as read-only copies.

    Attributes
    ----------
    vertices : ndarray, shape (vertex, 3)
        Positions x, y, z [m].
    faces : ndarray, shape (face, 3)
        Three vertex numbers a face, counter-clockwise seen from outside.

    Raises
    ------
    ValueError
        If a shape is wrong, a position is not finite, a face names a vertex that does not exist
        or has no area.
    """

    vertices: Array
    faces: Indices

    def __post_init__(self) -> None:
        """Copy, protect and check the arrays."""
        for name, dtype in (("vertices", np.float64), ("faces", np.int64)):
            given = np.asarray(getattr(self, name))
            if given.ndim != 2 or given.shape[1] != 3 or given.shape[0] == 0:
                raise ValueError(f"Invalid shape {given.shape} of {name}. Must be (n, 3), n > 0.")
            if name == "faces" and not np.issubdtype(given.dtype, np.integer):
                raise ValueError(f"Invalid type {given.dtype} of faces. Must be integers.")
            kept = np.array(given, dtype=dtype, order="C")
            kept.flags.writeable = False
            object.__setattr__(self, name, kept)
        self._check()

    def _check(self) -> None:
        """Refuse positions that are not finite, numbers out of range and faces without area."""
        bad = np.flatnonzero(~np.isfinite(self.vertices).all(axis=1))
        if bad.size:
            raise ValueError(f"Invalid vertex {bad[0]}: {self.vertices[bad[0]]}. Must be finite.")
        if self.faces.min() < 0 or self.faces.max() >= len(self.vertices):
            raise ValueError(
                f"Invalid vertex numbers {self.faces.min()} to {self.faces.max()} in the faces. "
                f"Must lie in [0, {len(self.vertices)})."
            )
        longest = np.linalg.norm(self._edges, axis=2).max(axis=1)
        flat = np.flatnonzero(~(self.face_areas > _FLATTEST * longest**2))
        if flat.size:
            raise ValueError(
                f"Invalid face {flat[0]} with vertices {self.faces[flat[0]].tolist()} "
                f"({flat.size} such). Must have an area."
            )

    @cached_property
    def _edges(self) -> Array:
        """Edge vectors of every face, (face, 3, 3) [m]."""
        corners = self.vertices[self.faces]
        return np.asarray(np.roll(corners, -1, axis=1) - corners)

    @cached_property
    def _area_vectors(self) -> Array:
        """Normal of every face, as long as its area, (face, 3) [m^2]."""
        return 0.5 * np.cross(self._edges[:, 0], self._edges[:, 1])

    @cached_property
    def face_areas(self) -> Array:
        """Area of every face, (face,) [m^2]."""
        return np.asarray(np.linalg.norm(self._area_vectors, axis=1))

    @cached_property
    def face_normals(self) -> Array:
        """Unit normal of every face, outward, (face, 3) [1]."""
        return self._area_vectors / self.face_areas[:, None]

    @cached_property
    def vertex_normals(self) -> Array:
        """
        Unit normal at every vertex, (vertex, 3) [1].

        The mean of the faces around the vertex, weighted by their areas.

        Raises
        ------
        ValueError
            If a vertex belongs to no face, or to faces that cancel.
        """
        total = np.zeros_like(self.vertices)
        np.add.at(total, self.faces, self._area_vectors[:, None, :])
        length = np.linalg.norm(total, axis=1, keepdims=True)
        if not np.all(length > 0):
            raise ValueError(
                f"Invalid vertex {np.flatnonzero(length == 0)[0]}: no normal. "
                "Must belong to a face; see `pruned`."
            )
        return np.asarray(total / length)

    @property
    def area(self) -> float:
        """Sum of the faces' areas [m^2]."""
        return float(self.face_areas.sum())

    @cached_property
    def _directed(self) -> tuple[Indices, Indices]:
        """Numbers of vertices from and to which every face's edges run, each (3 face,)."""
        return self.faces.ravel(), np.roll(self.faces, -1, axis=1).ravel()

    @property
    def closed(self) -> bool:
        """Whether every edge is shared by two faces of the same sense: there is an inside."""
        start, end = self._directed
        there = np.sort(start * len(self.vertices) + end)
        back = np.sort(end * len(self.vertices) + start)
        return bool(np.array_equal(there, back) and np.all(np.diff(there) > 0))

    @property
    def euler_characteristic(self) -> int:
        """Used vertices less edges plus faces: 2 for a sphere, 1 for a disc, 0 for a tube."""
        ends = np.sort(np.stack(self._directed), axis=0)
        edges = np.unique(ends[0] * len(self.vertices) + ends[1]).size
        return int(np.unique(self.faces).size - edges + len(self.faces))

    @property
    def volume(self) -> float:
        r"""
        Volume inside, by the divergence theorem, negative if the normals point inward [m^3].

        .. math:: V = \frac{1}{6} \sum_f p_0 \cdot (p_1 \times p_2)

        Raises
        ------
        ValueError
            If the surface is not closed.
        """
        if not self.closed:
            raise ValueError("Invalid surface: it has an edge or two senses. Must be closed.")
        first, second, third = np.moveaxis(self.vertices[self.faces], 1, 0)
        return float(np.einsum("fi,fi->", first, np.cross(second, third)) / 6.0)


def merge(surfaces: Sequence[Surface]) -> Surface:
    """
    Several surfaces as one, side by side: nothing is joined, no heat flows from one to another.

    Parameters
    ----------
    surfaces : sequence of Surface
        At least one.

    Returns
    -------
    Surface
        Vertices and faces in the given order.

    Raises
    ------
    ValueError
        If there is none.
    """
    if not surfaces:
        raise ValueError("Invalid surfaces (). Must be at least one.")
    first = np.cumsum([0, *(len(surface.vertices) for surface in surfaces[:-1])])
    return Surface(
        np.concatenate([surface.vertices for surface in surfaces]),
        np.concatenate([s.faces + start for s, start in zip(surfaces, first, strict=True)]),
    )


def moved(
    surface: Surface,
    rotation: Rotation | None = None,
    translation: npt.ArrayLike = (0.0, 0.0, 0.0),
    *,
    scale: float = 1.0,
) -> Surface:
    """
    A surface scaled and rotated about the origin, then translated.

    Parameters
    ----------
    surface : Surface
        What to move.
    rotation : scipy.spatial.transform.Rotation, optional
        Rotation; none if left out.
    translation : array_like, shape (3,)
        Translation [m].
    scale : float
        Factor of all lengths, positive [1].

    Returns
    -------
    Surface
        A new surface with the same faces.

    Raises
    ------
    ValueError
        If the scale is not finite and positive, or the translation is not three numbers.
    """
    if not (np.isfinite(scale) and scale > 0):
        raise ValueError(f"Invalid scale {scale}. Must be finite and positive.")
    shift = np.asarray(translation, dtype=np.float64)
    if shift.shape != (3,):
        raise ValueError(f"Invalid translation {translation!r} m. Must be three numbers.")
    turned = surface.vertices if rotation is None else surface.vertices @ rotation.as_matrix().T
    return Surface(scale * turned + shift, surface.faces)


def pruned(surface: Surface) -> Surface:
    """
    A surface without the vertices that no face uses, as scanned meshes have them.

    Parameters
    ----------
    surface : Surface
        Any surface.

    Returns
    -------
    Surface
        The same faces over fewer vertices, in the same order.
    """
    used, numbers = np.unique(surface.faces, return_inverse=True)
    return Surface(surface.vertices[used], numbers.reshape(surface.faces.shape))


def welded(vertices: Array, faces: Indices, resolution: float) -> Surface:
    """
    A surface whose vertices at the same place are made one.

    Parameters
    ----------
    vertices : ndarray, shape (vertex, 3)
        Positions, some of them repeated [m].
    faces : ndarray, shape (face, 3)
        Vertex numbers.
    resolution : float
        Distance below which two vertices are the same [m]; far below the spacing.

    Returns
    -------
    Surface
        Every vertex is the first one found at its place.
    """
    cells = np.round(vertices / resolution).astype(np.int64)
    _, first, numbers = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    return Surface(vertices[first], numbers.reshape(-1)[faces])


def positive_lengths(name: str, value: npt.ArrayLike) -> Array:
    """Return lengths as floats, all finite and positive, or raise a ValueError."""
    lengths = np.asarray(value, dtype=np.float64)
    if not np.all(np.isfinite(lengths) & (lengths > 0)):
        raise ValueError(f"Invalid {name} {value!r} m. Must be finite and positive.")
    return lengths


def pieces(length: npt.ArrayLike, spacing: npt.ArrayLike) -> Indices:
    """How many equal pieces of at most the spacing make up a length; 1e-9 forgives rounding."""
    return np.ceil(np.asarray(length) / spacing - 1e-9).clip(min=1).astype(np.int64)
