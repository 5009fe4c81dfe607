"""Meshes of the twins against the sizes, areas and volumes that geometry gives them."""

import itertools
from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from reproduction.twins import bodies, surfaces

SHAPES: dict[str, Callable[[], trimesh.Trimesh]] = {
    "plate": lambda: surfaces.plate(0.3, 0.2, 0.01),
    "ellipsoid": lambda: surfaces.ellipsoid((0.1, 0.12, 0.2), (0.0, 0.1, 0.0), 0.01),
    "capsule": lambda: surfaces.capsule((0.1, 0.0, 1.0), (0.1, 0.2, 0.9), 0.03, 0.005),
    "wineglass": surfaces.wineglass,
    "coffee_pot": surfaces.coffee_pot,
}
OPEN = {"plate", "wineglass", "coffee_pot"}


@pytest.mark.parametrize("name", SHAPES)
def test_topology(name: str) -> None:
    """A closed shape is a ball with its normals outward; an open one is a disc; no stray vertex;
    no face is a sliver, poles, seams and corners included: 1 is equilateral, 0 is flat.
    """
    mesh = SHAPES[name]()
    assert mesh.is_watertight == (name not in OPEN)
    assert mesh.is_winding_consistent
    assert mesh.euler_number == (1 if name in OPEN else 2)
    assert np.unique(mesh.faces).size == len(mesh.vertices)
    assert name in OPEN or mesh.volume > 0
    edges = np.roll(mesh.triangles, -1, axis=1) - mesh.triangles
    assert np.min(4.0 * np.sqrt(3.0) * mesh.area_faces / (edges**2).sum(axis=(1, 2))) > 0.6


@pytest.mark.parametrize(
    ("name", "width", "height"),
    [("wineglass", 0.084, 0.21), ("coffee_pot", 0.136, 0.165)],
)
def test_vessels(name: str, width: float, height: float) -> None:
    """A vessel is as large as described, stands on z = 0, and its upright wall faces outward."""
    mesh = SHAPES[name]()
    np.testing.assert_allclose(mesh.extents, [width, width, height], rtol=0, atol=2e-4)
    assert mesh.vertices[:, 2].min() == 0
    radial = mesh.triangles_center[:, :2]
    radial = radial / np.linalg.norm(radial, axis=1, keepdims=True)
    standing = np.abs(mesh.face_normals[:, 2]) < 0.5
    outward = np.einsum("fi,fi->f", radial, mesh.face_normals[:, :2])
    assert standing.sum() > 1000
    assert outward[standing].min() > 0.8


def test_plate_faces_the_viewer() -> None:
    """A plate stands on z = 0, centred in x, with its normal along -y and its full area."""
    plate = surfaces.plate(0.3, 0.2, 0.007)
    np.testing.assert_allclose(plate.face_normals, [[0.0, -1.0, 0.0]] * len(plate.faces))
    np.testing.assert_allclose(plate.bounds, [[-0.15, 0, 0], [0.15, 0, 0.2]], atol=1e-15)
    assert plate.area == pytest.approx(0.06, rel=1e-12)


CAPSULE = np.pi * (0.01 + 0.02), np.pi * (0.05**3 * 4 / 3 + 0.05**2 * 0.2)
ELLIPSOID = 2 * np.pi * (0.01 + 0.02 * (np.pi / 3) / np.sqrt(0.75)), 4 / 3 * np.pi * 0.002


@pytest.mark.parametrize(
    ("shape", "size"),
    [
        (lambda h: surfaces.capsule((0, 0, 0), (0, 0.2, 0), 0.05, h), CAPSULE),
        (lambda h: surfaces.ellipsoid((0.1, 0.1, 0.2), (0, 0, 0), h), ELLIPSOID),
    ],
    ids=["capsule", "ellipsoid"],
)
def test_area_and_volume(
    shape: Callable[[float], trimesh.Trimesh], size: tuple[float, float]
) -> None:
    """Area and volume approach the closed forms from below, with the square of the spacing."""
    area, volume = size
    missing = [
        (1.0 - mesh.area / area, 1.0 - mesh.volume / volume)
        for mesh in (shape(0.01), shape(0.005), shape(0.0025))
    ]
    order = np.log2([np.divide(*pair) for pair in itertools.pairwise(np.array(missing))])
    assert np.all(np.array(missing[-1]) > 0)
    assert np.all(np.array(missing[-1]) < 2e-3)
    np.testing.assert_allclose(order, 2.0, rtol=0, atol=0.25)


@pytest.mark.parametrize("end", [(0, 0, 0.2), (0, 0, -0.2), (0.1, -0.1, 0.1)])
def test_capsule_lies_between_its_ends(end: tuple[float, float, float]) -> None:
    """Every vertex of a capsule is its radius away from the segment, whatever its direction."""
    capsule = surfaces.capsule((0, 0, 0), end, 0.02, 0.004)
    axis = np.array(end, dtype=float)
    along = np.clip(capsule.vertices @ axis / (axis @ axis), 0.0, 1.0)
    distance = np.linalg.norm(capsule.vertices - along[:, None] * axis, axis=1)
    np.testing.assert_allclose(distance, 0.02, rtol=0, atol=2e-6)


def test_wrong_sizes() -> None:
    """A size that is not positive raises an error."""
    with pytest.raises(ValueError, match=r"Invalid length and spacing .m. 0.0"):
        surfaces.plate(0.0, 0.1, 0.01)
    with pytest.raises(ValueError, match=r"Invalid .* spacing .m. nan"):
        surfaces.ellipsoid((1, 1, 1), (0, 0, 0), np.nan)


def test_rabbit_sits_on_the_table() -> None:
    """The built-in rabbit is of six closed parts, as high as the bunny."""
    rabbit = bodies.rabbit()
    assert rabbit.is_watertight
    assert rabbit.body_count == 6
    np.testing.assert_allclose(rabbit.bounds[:, 2], [0.0, bodies.BUNNY_HEIGHT], rtol=0, atol=1e-3)
