"""The built-in surfaces against the areas and volumes that geometry gives them."""

import itertools
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from reproduction.twins import surfaces
from reproduction.twins.surfaces import Surface

SHAPES: dict[str, Callable[[], Surface]] = {
    "plate": lambda: surfaces.plate(0.3, 0.2, 0.01),
    "box": lambda: surfaces.box((0.1, 0.2, 0.3), 0.02),
    "sphere": lambda: surfaces.sphere(0.1, 0.01),
    "ellipsoid": lambda: surfaces.ellipsoid((0.1, 0.12, 0.2), 0.01),
    "capsule": lambda: surfaces.capsule((0.1, 0.0, 1.0), (0.1, 0.2, 0.9), 0.03, 0.005),
    "wineglass": surfaces.wineglass,
    "coffee_pot": surfaces.coffee_pot,
    "bulb": surfaces.bulb,
}
OPEN = {"plate", "wineglass", "coffee_pot", "bulb"}


def quality(surface: Surface) -> np.ndarray:
    """Shape of every face: 1 for an equilateral triangle, 0 for a flat one."""
    corners = surface.vertices[surface.faces]
    squares = ((np.roll(corners, -1, axis=1) - corners) ** 2).sum(axis=(1, 2))
    return np.asarray(4.0 * np.sqrt(3.0) * surface.face_areas / squares)


@pytest.mark.parametrize("name", SHAPES)
def test_topology(name: str) -> None:
    """What has an inside is closed and a ball; what is open is a disc; no vertex is unused."""
    surface = SHAPES[name]()
    assert surface.closed == (name not in OPEN)
    assert surface.euler_characteristic == (1 if name in OPEN else 2)
    assert np.unique(surface.faces).size == len(surface.vertices)


@pytest.mark.parametrize("name", SHAPES)
def test_even_triangles(name: str) -> None:
    """No face is a sliver, poles, seams and corners included."""
    worst = quality(SHAPES[name]()).min()
    print(f"{name}: worst face {worst:.2f}, {len(SHAPES[name]().vertices)} vertices")
    assert worst > 0.6


@pytest.mark.parametrize("name", sorted(SHAPES.keys() - OPEN))
def test_normals_point_outward(name: str) -> None:
    """The volume inside is positive, and so is every normal's share of a way from the middle."""
    surface = SHAPES[name]()
    assert surface.volume > 0
    outward = surface.vertices - (surface.vertices.max(axis=0) + surface.vertices.min(axis=0)) / 2
    assert np.einsum("vi,vi->v", surface.vertex_normals, outward).min() > 0


@pytest.mark.parametrize("name", ["wineglass", "coffee_pot", "bulb"])
def test_vessels_face_outward(name: str) -> None:
    """Where a vessel's wall stands, its normals point away from the axis."""
    surface = SHAPES[name]()
    middle = surface.vertices[surface.faces].mean(axis=1)
    radial = middle[:, :2] / np.linalg.norm(middle[:, :2], axis=1, keepdims=True)
    standing = np.abs(surface.face_normals[:, 2]) < 0.5
    outward = np.einsum("fi,fi->f", radial, surface.face_normals[:, :2])
    assert standing.sum() > 1000
    assert outward[standing].min() > 0.8


def test_plate_faces_the_viewer() -> None:
    """A plate stands on z = 0, centred in x, with its normal along -y and its full area."""
    plate = surfaces.plate(0.3, 0.2, 0.007)
    np.testing.assert_allclose(plate.face_normals, [[0.0, -1.0, 0.0]] * len(plate.faces))
    np.testing.assert_allclose(plate.vertices.min(axis=0), [-0.15, 0.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(plate.vertices.max(axis=0), [0.15, 0.0, 0.2], atol=1e-15)
    assert plate.area == pytest.approx(0.06, rel=1e-12)


def test_box() -> None:
    """A box has the area and the volume of a box, to rounding."""
    box = surfaces.box((0.1, 0.2, 0.3), 0.013)
    assert box.area == pytest.approx(2 * (0.02 + 0.06 + 0.03), rel=1e-12)
    assert box.volume == pytest.approx(0.006, rel=1e-12)


def profile_of_a_cone(spacing: float) -> Surface:
    """A closed cone, 0.1 m high on a base of radius 0.05 m."""
    return surfaces.revolution([0.0, 0.05, 0.0], [0.0, 0.0, 0.1], spacing)


def drum(spacing: float) -> Surface:
    """A closed cylinder, 0.1 m high, of radius 0.05 m."""
    return surfaces.revolution([0.0, 0.05, 0.05, 0.0], [0.0, 0.0, 0.1, 0.1], spacing)


@pytest.mark.parametrize(
    ("shape", "area", "volume"),
    [
        (lambda h: surfaces.sphere(0.1, h), 4e-2 * np.pi, 4e-3 / 3 * np.pi),
        (drum, 0.015 * np.pi, 2.5e-4 * np.pi),
        (
            profile_of_a_cone,
            np.pi * 0.05 * (0.05 + np.hypot(0.05, 0.1)),
            np.pi * 0.05**2 * 0.1 / 3,
        ),
        (
            lambda h: surfaces.capsule((0, 0, 0), (0, 0.2, 0), 0.05, h),
            np.pi * (0.01 + 0.02),
            np.pi * (0.05**3 * 4 / 3 + 0.05**2 * 0.2),
        ),
        (
            lambda h: surfaces.ellipsoid((0.1, 0.1, 0.2), h),
            2 * np.pi * (0.01 + 0.02 * (np.pi / 3) / np.sqrt(0.75)),
            4 / 3 * np.pi * 0.002,
        ),
    ],
    ids=["sphere", "drum", "cone", "capsule", "ellipsoid"],
)
def test_area_and_volume(shape: Callable[[float], Surface], area: float, volume: float) -> None:
    """Area and volume approach the closed forms from below, with the square of the spacing."""
    missing = [
        (1.0 - surface.area / area, 1.0 - surface.volume / volume)
        for surface in (shape(0.01), shape(0.005), shape(0.0025))
    ]
    order = np.log2([np.divide(*pair) for pair in itertools.pairwise(np.array(missing))])
    print("area, volume missing:", np.array(missing).round(5).tolist(), "orders", order.round(2))
    assert np.all(np.array(missing[-1]) > 0)
    assert np.all(np.array(missing[-1]) < 2e-3)
    np.testing.assert_allclose(order, 2.0, rtol=0, atol=0.25)


def test_open_tube() -> None:
    """A wall without ends is a tube: open, of Euler characteristic 0."""
    tube = surfaces.revolution([0.05, 0.05], [0.0, 0.1], 0.002)
    assert not tube.closed
    assert tube.euler_characteristic == 0
    assert tube.area == pytest.approx(0.01 * np.pi, rel=1e-3)


def test_profile_keeps_its_corners() -> None:
    """A drum keeps its edges, whatever the spacing."""
    points = drum(0.0067).vertices
    radius = np.hypot(points[:, 0], points[:, 1])
    for level in (0.0, 0.1):
        assert np.isclose(radius[points[:, 2] == level].max(), 0.05, rtol=0, atol=1e-12)


@pytest.mark.parametrize("spacing", [0.002, 0.004])
def test_spacing(spacing: float) -> None:
    """Neighbours are as far apart as was asked for: the median within 15 %."""
    for surface in (surfaces.wineglass(spacing), surfaces.sphere(0.1, spacing)):
        corners = surface.vertices[surface.faces]
        edges = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
        assert np.median(edges) == pytest.approx(spacing, rel=0.15)


def test_sizes_of_the_vessels() -> None:
    """The vessels are as large as their descriptions say, and stand on z = 0."""
    for surface, width, height in (
        (surfaces.wineglass(), 0.084, 0.21),
        (surfaces.coffee_pot(), 0.136, 0.165),
        (surfaces.bulb(), 0.06, 0.0855),
    ):
        np.testing.assert_allclose(
            np.ptp(surface.vertices, axis=0), [width, width, height], rtol=0, atol=2e-4
        )
        assert surface.vertices[:, 2].min() == 0


@given(
    st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    st.tuples(*[st.floats(-5.0, 5.0)] * 3),
    st.floats(0.1, 10.0),
)
@settings(max_examples=25, deadline=None)
def test_motion_keeps_the_shape(
    turn: tuple[float, float, float], shift: tuple[float, float, float], scale: float
) -> None:
    """Rotation and translation change no area, no volume; a scale does by its powers."""
    box = surfaces.box((0.1, 0.2, 0.3), 0.1)
    rotation = Rotation.from_rotvec(turn)
    moved = surfaces.moved(box, rotation, shift, scale=scale)
    assert moved.area == pytest.approx(scale**2 * box.area, rel=1e-9)
    assert moved.volume == pytest.approx(scale**3 * box.volume, rel=1e-9)
    expected = rotation.apply(np.array(box.face_normals))
    np.testing.assert_allclose(moved.face_normals, expected, rtol=0, atol=1e-9)


def test_rotation_about_z() -> None:
    """A quarter turn about z takes x to y, before the translation."""
    plate = surfaces.plate(0.2, 0.1, 0.1)
    moved = surfaces.moved(plate, Rotation.from_euler("z", 90, degrees=True), (1.0, 2.0, 3.0))
    expected = np.stack([np.ones(6), 2.0 + plate.vertices[:, 0], 3.0 + plate.vertices[:, 2]], 1)
    np.testing.assert_allclose(moved.vertices, expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize("end", [(0, 0, 0.2), (0, 0, -0.2), (0.1, -0.1, 0.1)])
def test_capsule_lies_between_its_ends(end: tuple[float, float, float]) -> None:
    """Every vertex of a capsule is its radius away from the segment, whatever its direction."""
    capsule = surfaces.capsule((0, 0, 0), end, 0.02, 0.004)
    axis = np.array(end, dtype=float)
    along = np.clip(capsule.vertices @ axis / (axis @ axis), 0.0, 1.0)
    distance = np.linalg.norm(capsule.vertices - along[:, None] * axis, axis=1)
    np.testing.assert_allclose(distance, 0.02, rtol=0, atol=2e-6)


def test_merge() -> None:
    """Merged surfaces keep their areas, their order and their topology."""
    box, ball = surfaces.box((0.1, 0.1, 0.1), 0.05), surfaces.sphere(0.1, 0.05)
    both = surfaces.merge([box, ball])
    assert both.area == pytest.approx(box.area + ball.area, rel=1e-12)
    assert both.closed
    assert both.euler_characteristic == 4
    np.testing.assert_array_equal(both.faces[len(box.faces) :], ball.faces + len(box.vertices))


def test_pruned() -> None:
    """A vertex that no face uses is left out, and the faces stay where they are."""
    box = surfaces.box((0.1, 0.1, 0.1), 0.05)
    ragged = Surface(np.concatenate([np.zeros((3, 3)), box.vertices]), box.faces + 3)
    with pytest.raises(ValueError, match="Invalid vertex 0: no normal"):
        _ = ragged.vertex_normals
    pruned = surfaces.pruned(ragged)
    np.testing.assert_array_equal(pruned.vertices, box.vertices)
    np.testing.assert_array_equal(pruned.faces, box.faces)


def test_normals_of_a_sphere() -> None:
    """The vertex normals of a sphere point along its radii, within half a degree."""
    ball = surfaces.sphere(0.1, 0.01)
    cosine = np.einsum("vi,vi->v", ball.vertex_normals, ball.vertices / 0.1)
    print(f"normals: {np.rad2deg(np.arccos(cosine.min())):.2f} degrees")
    assert cosine.min() > np.cos(np.deg2rad(0.5))


def test_surfaces_are_kept() -> None:
    """A surface is a copy that nobody can change."""
    vertices = np.eye(3)
    surface = Surface(vertices, np.array([[0, 1, 2]]))
    vertices[0] = 7.0
    assert surface.vertices.max() == 1.0
    with pytest.raises(ValueError, match="read-only"):
        surface.vertices[0] = 7.0


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Surface(np.eye(3)[:, :2], np.array([[0, 1, 2]])), r"Invalid shape \(3, 2\)"),
        (lambda: Surface(np.eye(3), np.array([[0.0, 1.0, 2.0]])), "Invalid type float64"),
        (lambda: Surface(np.eye(3) + np.inf, np.array([[0, 1, 2]])), "Invalid vertex 0"),
        (lambda: Surface(np.eye(3), np.array([[0, 1, 3]])), "Invalid vertex numbers 0 to 3"),
        (lambda: Surface(np.eye(3), np.array([[0, 1, 1]])), "Invalid face 0 with vertices"),
        (lambda: surfaces.wineglass().volume, "Must be closed"),
        (lambda: surfaces.merge([]), r"Invalid surfaces \(\)"),
        (lambda: surfaces.plate(0.0, 0.1, 0.01), "Invalid size of a plate"),
        (lambda: surfaces.box((1.0, 1.0), 0.1), "Must be three lengths"),
        (lambda: surfaces.sphere(0.1, np.nan), "Invalid spacing nan m"),
        (lambda: surfaces.ellipsoid((1.0, 1.0, -1.0), 0.1), "Invalid semi-axes"),
        (lambda: surfaces.capsule((0, 0, 0), (0, 0, 0), 1.0, 0.1), "Invalid length of a capsule"),
        (lambda: surfaces.revolution([1.0, 0.0, 1.0], [0, 1, 2], 0.1), "Invalid radius 0.0 m"),
        (lambda: surfaces.revolution([1.0, 1.0], [0.0, 0.0], 0.1), "a point is repeated"),
        (lambda: surfaces.revolution([1.0], [0.0], 0.1), r"Invalid profile of shape \(1, 2\)"),
        (lambda: surfaces.moved(surfaces.bulb(), scale=0.0), "Invalid scale 0.0"),
        (lambda: surfaces.moved(surfaces.bulb(), None, (0.0, 1.0)), "Invalid translation"),
    ],
)
def test_invalid(call: Callable[[], object], message: str) -> None:
    """What is no surface is refused with a reason."""
    with pytest.raises(ValueError, match=message):
        call()
