"""Solids, and a thin shell: a surface mesh of a thickness and a solid, with its two operators."""

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Final

import numpy as np
import robust_laplacian
import trimesh
from scipy import sparse

from dbthermal._arrays import Array
from dbthermal.planck import require_positive

_FLATTEST: Final = 1e-9
"""A face that is flatter than this fraction of the mesh's size has no area [1]."""


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
    :math:`d^2 / 2 \alpha` (6 s).

    Attributes
    ----------
    mesh : Trimesh
        Surface [m]. The sense of the faces does not matter; edges may be open (insulated) or shared
        by more than two faces.
    thickness : float
        Thickness d [m].
    solid : Solid
        Material.

    Raises
    ------
    ValueError
        If a number is not finite, a vertex belongs to no face, or a face is repeated or has no
        area.
    """

    mesh: trimesh.Trimesh
    thickness: float
    solid: Solid

    def __post_init__(self) -> None:
        """Check thickness and mesh."""
        require_positive("thickness [m] of a shell", self.thickness)
        mesh = self.mesh
        if mesh.is_empty:
            raise ValueError("Empty mesh of a shell. Must have a face.")
        for what, holds in (
            ("vertex {} that is not finite", np.isfinite(mesh.vertices).all(axis=1)),
            ("vertex {} of no face", mesh.referenced_vertices),
            ("face {} without an area", mesh.nondegenerate_faces(_FLATTEST * mesh.scale)),
            ("face {}, as an earlier one", mesh.unique_faces()),
        ):
            if not np.all(holds):
                number = np.flatnonzero(~np.asarray(holds))[0]
                raise ValueError(f"Invalid {what.format(number)}. Must be left out.")

    @property
    def size(self) -> int:
        """Number of vertices."""
        return len(self.mesh.vertices)

    @cached_property
    def _operators(self) -> tuple[Any, Array]:
        r"""
        Weak Laplacian [1], :math:`(L T)_i = \int \nabla \varphi_i \cdot \nabla T dA`, area [m^2].

        Built on intrinsic Delaunay triangles, so no off-diagonal element is positive (but for
        rounding) and the step obeys the maximum principle whatever the triangles are: Sharp, Crane
        (2020), Computer Graphics Forum 39(5), doi:10.1111/cgf.14069.
        """
        laplacian, mass = robust_laplacian.mesh_laplacian(
            np.array(self.mesh.vertices, dtype=np.float64), np.array(self.mesh.faces)
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
