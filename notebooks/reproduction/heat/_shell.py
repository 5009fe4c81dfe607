"""Solids, and a thin shell: a surface mesh of a thickness and a solid, with its two operators."""

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import robust_laplacian
from scipy import sparse

from dbthermal._arrays import Array
from dbthermal.planck import require_positive

_FLATTEST: Final = 1e-9
"""A face whose area falls below this fraction of its longest edge squared is degenerate [1]."""


@dataclass(frozen=True)
class Solid:
    """Thermal properties of a solid, constant over the temperatures of a scene.

    Attributes
    ----------
    conductivity : float
        Thermal conductivity k [W m^-1 K^-1].
    density : float
        Density [kg m^-3].
    specific_heat : float
        Specific heat at constant pressure c [J kg^-1 K^-1].
    """

    conductivity: float
    density: float
    specific_heat: float

    def __post_init__(self) -> None:
        """Refuse a property that is not finite and positive."""
        for field in fields(self):
            require_positive(f"{field.name} of a solid", getattr(self, field.name))


# At 300 K, from table A.3 of Bergman, Lavine, Incropera, DeWitt (2011), Fundamentals of Heat and
# Mass Transfer, 7th edition, Wiley, ISBN 978-0-470-50197-9.

GLASS: Final = Solid(conductivity=1.4, density=2500.0, specific_heat=750.0)
"""Plate glass, soda-lime, at 300 K: table A.3 of Bergman et al. (2011)."""

BOROSILICATE: Final = Solid(conductivity=1.4, density=2225.0, specific_heat=835.0)
"""Pyrex at 300 K: table A.3 of Bergman et al. (2011)."""

CERAMIC: Final = Solid(conductivity=1.5, density=2400.0, specific_heat=1050.0)
"""Porcelain near room temperature, round values: material-properties.org, page "Porcelain"."""


@dataclass(frozen=True, eq=False)
class Shell:
    r"""A shell so thin that its temperature is uniform through it.

    That holds while the Biot number :math:`h d / k` is far below 1: 0.02 for 3 mm of glass in
    still air, but 1 where hot water wets it. There the half wall up to the middle belongs in
    series with the fluid, :math:`1 / (1/h + d / 2k)`, and the outer face still lags by some
    :math:`d^2 / 2 \alpha` (6 s). The arrays are kept as read-only copies.

    Attributes
    ----------
    vertices : ndarray, shape (vertex, 3)
        Positions [m].
    faces : ndarray, shape (face, 3)
        Three vertex numbers a face. Their sense does not matter; edges may be open (insulated)
        or shared by more than two faces.
    thickness : float
        Thickness d [m].
    solid : Solid
        Material.

    Raises
    ------
    ValueError
        If a shape or a number is wrong, a vertex belongs to no face, or a face is repeated or
        has no area.
    """

    vertices: Array
    faces: npt.NDArray[np.int64]
    thickness: float
    solid: Solid

    def __post_init__(self) -> None:
        """Copy, protect and check the arrays."""
        if not (np.isfinite(self.thickness) and self.thickness > 0):
            raise ValueError(
                f"Invalid thickness {self.thickness} m of a shell. Must be finite and positive."
            )
        if not np.issubdtype(np.asarray(self.faces).dtype, np.integer):
            raise ValueError(
                f"Invalid type {np.asarray(self.faces).dtype} of faces. Must be integers."
            )
        for name, dtype in (("vertices", np.float64), ("faces", np.int64)):
            kept = np.array(getattr(self, name), dtype=dtype, order="C")
            if kept.ndim != 2 or kept.shape[1] != 3 or not len(kept):
                raise ValueError(f"Invalid shape {kept.shape} of {name}. Must be (n, 3), n > 0.")
            kept.flags.writeable = False
            object.__setattr__(self, name, kept)
        _check_vertices(self.vertices, self.faces)
        _check_faces(self.vertices, self.faces)

    @cached_property
    def _operators(self) -> tuple[Any, Array]:
        r"""
        Weak Laplacian [1], :math:`(L T)_i = \int \nabla \varphi_i \cdot \nabla T dA`, area [m^2].

        Built on intrinsic Delaunay triangles, so no off-diagonal element is positive (but for
        rounding) and the step obeys the maximum principle whatever the triangles are: Sharp, Crane
        (2020), Computer Graphics Forum 39(5), doi:10.1111/cgf.14069.
        """
        laplacian, mass = robust_laplacian.mesh_laplacian(
            np.array(self.vertices), np.array(self.faces)
        )
        return sparse.csr_matrix(laplacian), np.asarray(mass.diagonal())

    @property
    def area(self) -> Array:
        """Share of the surface of every vertex, (vertex,) [m^2]; it adds up to the faces' area."""
        return self._operators[1]

    @cached_property
    def stiffness(self) -> Any:
        r"""Conduction :math:`k d L` as a sparse matrix, (vertex, vertex) [W/K].

        Symmetric, positive semidefinite: heat leaves vertex i at the rate :math:`(k d L T)_i`;
        its rows add up to zero.
        """
        return self.solid.conductivity * self.thickness * self._operators[0]

    @property
    def capacity_per_area(self) -> float:
        r"""Heat capacity :math:`\rho c d` of a square metre [J m^-2 K^-1]."""
        return self.solid.density * self.solid.specific_heat * self.thickness

    @property
    def capacity(self) -> Array:
        """Heat capacity of every vertex, (vertex,) [J/K]."""
        return self.capacity_per_area * self.area


def _check_vertices(vertices: Array, faces: npt.NDArray[np.int64]) -> None:
    """Refuse positions that are not finite, numbers that do not exist and unused vertices."""
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if bad.size:
        raise ValueError(f"Invalid vertex {bad[0]}: {vertices[bad[0]]} m. Must be finite.")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(
            f"Invalid vertex numbers {faces.min()} to {faces.max()} in the faces. "
            f"Must lie in [0, {len(vertices)})."
        )
    unused = np.setdiff1d(np.arange(len(vertices)), faces)
    if unused.size:
        raise ValueError(
            f"Invalid vertex {unused[0]}: in no face ({unused.size} such). "
            "Must belong to a face, or be left out."
        )


def _check_faces(vertices: Array, faces: npt.NDArray[np.int64]) -> None:
    """Refuse faces without an area and repeated faces."""
    corners = vertices[faces]
    edges = np.roll(corners, -1, axis=1) - corners
    area = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    longest = np.linalg.norm(edges, axis=2).max(axis=1)
    flat = np.flatnonzero(~(area > _FLATTEST * longest**2))
    if flat.size:
        raise ValueError(
            f"Invalid face {flat[0]} with vertices {faces[flat[0]].tolist()} "
            f"({flat.size} such). Must have an area."
        )
    different, count = np.unique(np.sort(faces, axis=1), axis=0, return_counts=True)
    if np.any(count > 1):
        raise ValueError(
            f"Invalid face with vertices {different[count > 1][0].tolist()}: given "
            f"{count.max()} times. Must be given once."
        )
