"""Meshes of the twins against geometry; moving bodies around them: writing, hands and routes."""

import itertools
from collections.abc import Callable

import numpy as np
import pytest
import trimesh
from refused import assert_refused

from reproduction.twins import bodies, surfaces
from reproduction.twins.panes import pointing
from reproduction.twins.people import FINGERS, Route, Writing, board, imprint, pacing
from reproduction.twins.stage import AMBIENT, clock
from reproduction.twins.surroundings import Pose

SHAPES: dict[str, Callable[[], trimesh.Trimesh]] = {
    "plate": lambda: surfaces.plate(0.3, 0.2, 0.01),
    "ellipsoid": lambda: surfaces.ellipsoid((0.1, 0.12, 0.2), (0.0, 0.1, 0.0), 0.01),
    "capsule": lambda: surfaces.capsule((0.1, 0.0, 1.0), (0.1, 0.2, 0.9), 0.03, 0.005),
    "wineglass": lambda: surfaces.vessel(surfaces.WINEGLASS_PROFILE, 0.003),
    "coffee_pot": lambda: surfaces.vessel(surfaces.COFFEE_POT_PROFILE, 0.004),
}
OPEN = {"plate", "wineglass", "coffee_pot"}


@pytest.mark.parametrize("name", SHAPES)
def test_topology(name: str) -> None:
    """Closed shapes are balls, open ones discs, normals outward, no stray vertex or sliver."""
    mesh = SHAPES[name]()
    assert mesh.is_watertight == (name not in OPEN)
    assert mesh.is_winding_consistent
    assert mesh.euler_number == (1 if name in OPEN else 2)
    assert np.unique(mesh.faces).size == len(mesh.vertices)
    assert name in OPEN or mesh.volume > 0
    edges = np.roll(mesh.triangles, -1, axis=1) - mesh.triangles
    assert np.min(4.0 * np.sqrt(3.0) * mesh.area_faces / (edges**2).sum(axis=(1, 2))) > 0.6


@pytest.mark.parametrize(
    ("name", "width", "height"), [("wineglass", 0.084, 0.21), ("coffee_pot", 0.136, 0.165)]
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
    assert_refused(r"Invalid length and spacing .m. 0.0", surfaces.plate, 0.0, 0.1, 0.01)
    assert_refused(r"Invalid .* spacing .m. nan", surfaces.ellipsoid, (1, 1, 1), (0, 0, 0), np.nan)


def test_rabbit_sits_on_the_table() -> None:
    """The built-in rabbit is of six closed parts, as high as the bunny."""
    rabbit = bodies.rabbit()
    assert rabbit.is_watertight
    assert rabbit.body_count == 6
    np.testing.assert_allclose(rabbit.bounds[:, 2], [0.0, bodies.BUNNY_HEIGHT], rtol=0, atol=1e-3)


def test_writing_appears_and_fades() -> None:
    """A stroke is as cold as it was written, after it was written, and rewarms by 1/e."""
    writing = Writing("V", start=2.0, pace=0.1, drop=4.0, drying=10.0)
    times, path = writing.path()
    flat = surfaces.plate(0.2, 0.2, 0.002)
    places = np.asarray(flat.vertices)[:, [0, 2]] - (0.0, 0.1)
    actor = board(flat, places, writing, AMBIENT, lambda _: Pose())
    vertex = int(np.argmin(np.linalg.norm(places - path[-1], axis=1)))
    last = float(times[-1])
    warmth = [actor.warmth(now)[vertex] for now in (last - 1.0, last, last + 10.0)]
    np.testing.assert_allclose(warmth, [AMBIENT, AMBIENT - 4, AMBIENT - 4 / np.e], rtol=0, atol=0.1)


def test_the_index_writes_the_strokes() -> None:
    """The index's tip is a radius in front of each stroke, and nearer than other fingers."""
    writing, ends = Writing(start=3.0), np.array([(f.tip[0], 0.0, f.tip[1]) for f in FINGERS])
    for time, place in zip(*writing.path(), strict=True):
        tips = pointing(writing, float(time)).outwards(ends)
        expected = (-place[0], -FINGERS[1].radius, place[1])
        np.testing.assert_allclose(tips[1], expected, rtol=0, atol=1e-12)  # m
        others = [-tip[1] - part.radius for tip, part in zip(tips, FINGERS, strict=True)]
        assert min(others[:1] + others[2:]) > 0.002  # m


def test_pacing_keeps_its_pace() -> None:
    """Between the corners of the way the pace lies in its range, and pauses are pauses."""
    corners, rng = ((-2.0, 0.0), (0.0, 0.0), (2.0, 1.0)), np.random.default_rng(1)
    route = pacing(corners, clock(), rng)
    lengths = np.linalg.norm(np.diff(route.places, axis=0), axis=1)
    speeds = lengths / np.diff(route.times)
    np.testing.assert_array_equal(speeds[::2], 0.0)
    assert np.all((speeds[1::2] > 0.5) & (speeds[1::2] < 1.0))
    assert route.times[-1] >= 34.9


def test_who_stands_faces_where_he_came_to() -> None:
    """A walk along y heads for y, and so does the pause after it."""
    route = Route(np.array([0.0, 1.0, 2.0, 3.0]), np.array([[0, 0], [0, 1], [0, 1], [1.0, 1]]))
    headings = [route.heading(time) for time in (-1.0, 0.5, 1.5, 2.5, 9.0)]
    np.testing.assert_allclose(headings, [np.pi / 2] * 3 + [0.0] * 2, rtol=0, atol=1e-12)


def test_a_hand_touches_under_palm_and_fingers() -> None:
    """The print is 1 at the palm and on a finger, 0 between the fingers and beyond."""
    share = imprint([(0.0, 0.0), (-0.010, 0.10), (-0.06, 0.06), (0.0, 0.2)])
    np.testing.assert_allclose(share, [1, 1, 0, 0], rtol=0, atol=1e-3)
