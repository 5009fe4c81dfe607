"""Ray casting and moving surroundings: against closed forms of geometry."""

from dataclasses import replace
from functools import partial
from typing import cast

import numpy as np
import trimesh
from refused import refused
from scipy.spatial.transform import Rotation

from reproduction.twins.rays import Camera, Caster, mirror, unit
from reproduction.twins.surfaces import ellipsoid
from reproduction.twins.surroundings import Actor, Motion, Pose, incident

CAMERA = Camera(position=(0.1, -0.6, 0.3), target=(0.0, 0.0, 0.05), shape=(45, 60))
FRONT = Camera(position=(0.0, -1.0, 0.0), target=(0.0, 0.0, 0.0), shape=(90, 120))
DIRECTIONS = FRONT.directions()
ORIGINS = np.broadcast_to(FRONT.position, DIRECTIONS.shape)
RADIUS = 0.1  # m
ROOM, SKIN = 295.15, 307.15  # K


def sphere(subdivisions: int = 4) -> Caster:
    """Sphere about the origin."""
    spacing = RADIUS * 1.107 / 2**subdivisions
    return Caster(ellipsoid((RADIUS,) * 3, (0.0, 0.0, 0.0), spacing))


def wall(turn: float = 0.0) -> trimesh.Trimesh:
    """A plate 2 m wide and high, in the plane y = 0 unless turned about z [degrees]."""
    corners = np.array([[-1.0, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]])
    corners = Rotation.from_euler("z", turn, degrees=True).apply(corners)
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


def ball(radius: float, temperature: float = SKIN, motion: Motion | None = None) -> Actor:
    """A ball of one temperature."""
    mesh = trimesh.creation.icosphere(4, radius)
    return Actor(mesh, np.full(len(mesh.vertices), temperature), motion)


def test_field_of_view_is_horizontal() -> None:
    """From edge to edge the image spans 24 degrees across; the image's right is the world's."""
    half = np.tan(np.radians(12.0)) * 119 / 120  # to the middle of the last pixel
    edges = DIRECTIONS.reshape(90, 120, 3)[:, -1, 0]
    np.testing.assert_allclose(edges.max(), half / np.hypot(1, half), rtol=0, atol=1e-4)
    expected = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # right, down, forward
    np.testing.assert_allclose(FRONT.axes, expected, rtol=0, atol=1e-15)


test_no_camera_and_nothing_behind_it = refused(
    lambda call, *arguments: call(*arguments),
    [
        (partial(replace, CAMERA, field_of_view=180.0), "180.0 degrees. Must lie in (0, 180)"),
        (partial(replace, CAMERA, shape=(0, 4)), "shape .* Must be positive"),
        (partial(replace, CAMERA, target=(0.1, -0.6, 0.0)), "target .* Must not be straight above"),
        (FRONT.project, [0.0, -2.0, 0.0], "Must be positive"),
    ],
    error=ValueError,
)


def test_plane_mirrors_as_the_law_says() -> None:
    """On a plane y turns round; linear functions on the vertices are themselves there."""
    caster = Caster(wall())
    hits = caster.cast(ORIGINS, DIRECTIONS)
    starts, mirrored = caster.mirrored(hits, DIRECTIONS)
    np.testing.assert_allclose(mirrored, DIRECTIONS * [1, -1, 1], rtol=0, atol=1e-12)
    met = ORIGINS + DIRECTIONS / DIRECTIONS[:, [1]]
    np.testing.assert_allclose(caster.points(hits), met, rtol=0, atol=1e-12)  # m
    np.testing.assert_allclose(starts - met, [[0, -2.83e-4, 0]] * len(met), rtol=0, atol=1e-6)
    slopes = np.array([[3.0, 5.0, 7.0], [1.0, -1.0, 2.0]])
    values = caster.interpolate(hits, slopes @ wall().vertices.T)
    np.testing.assert_allclose(values, slopes @ met.T, rtol=0, atol=1e-12)


def test_sphere_mirrors_as_the_law_says() -> None:
    """Smooth shading on a faceted sphere gives the mirror directions of the true sphere."""
    caster = sphere(subdivisions=5)
    hits = caster.cast(ORIGINS, DIRECTIONS)
    origins, directions = ORIGINS[hits.met], DIRECTIONS[hits.met]
    along = np.sum(origins * directions, axis=1)
    root = np.sqrt(along**2 - np.sum(origins**2, axis=1) + RADIUS**2)
    normals = unit(origins + (-along - root)[:, np.newaxis] * directions)
    inner = np.sum(normals * directions, axis=1) < -0.5  # not at the rim, where facets show
    _, mirrored = caster.mirrored(hits.select(hits.met), directions)
    cosines = np.sum(mirrored * mirror(directions, normals), axis=1)[inner]
    assert np.degrees(np.arccos(cosines.min())) < 0.2


def test_sphere_covers_its_solid_angle() -> None:
    """The pixels on a sphere, weighted by their solid angle, add up to that of its cone."""
    forward = DIRECTIONS @ FRONT.axes[2]
    pixel = (2 * np.tan(np.radians(12.0)) / 120) ** 2
    solid = np.sum(pixel * forward[sphere().cast(ORIGINS, DIRECTIONS).met] ** 3)
    np.testing.assert_allclose(solid, 2 * np.pi * (1 - np.sqrt(1 - RADIUS**2)), rtol=0.01)


def test_hidden_points() -> None:
    """The visible points of a sphere are those within the horizon's cone."""
    points = RADIUS * unit(np.random.default_rng(4).normal(size=(500, 3)))
    height = points @ np.array([0.0, -1.0, 0.0])
    clear = np.abs(height - RADIUS**2) > 0.006
    seen = sphere(subdivisions=5).visible(points * (1 - 1e-4), FRONT.position)
    np.testing.assert_array_equal(seen[clear], (height > RADIUS**2)[clear])


def test_concave_surface_sees_itself() -> None:
    """A ray into a corner meets the second mirror; none of a sphere meets it again."""
    corner = Caster(cast("trimesh.Trimesh", trimesh.util.concatenate([wall(45.0), wall(-45.0)])))
    hits = corner.cast(ORIGINS, DIRECTIONS)
    again = corner.cast(*corner.mirrored(hits, DIRECTIONS))
    assert again.met.all()
    assert np.all(again.face // 2 != hits.face // 2)
    coarse = sphere(subdivisions=2)
    hits = coarse.cast(ORIGINS, DIRECTIONS)
    again = coarse.cast(*coarse.mirrored(hits.select(hits.met), DIRECTIONS[hits.met]))
    assert not again.met.any()


def test_pose_moves_rays_as_it_moves_the_body() -> None:
    """A body moved and rays at rest meet as rays moved back and a body at rest."""
    pose = Pose(Rotation.from_euler("zx", [0.3, 0.5]), (0.2, 0.1, -0.1))
    inner = Pose(Rotation.from_euler("y", 0.7), (0.0, 0.0, 0.2))
    point = np.array([[0.1, 0.2, 0.3]])
    world = (pose @ inner).outwards(point)
    np.testing.assert_allclose(world, pose.outwards(inner.outwards(point)), rtol=0, atol=1e-15)
    inside, turned = (pose @ inner).inwards(world, point)
    np.testing.assert_allclose(inside, point, rtol=0, atol=1e-15)  # m
    back = (pose.rotation * inner.rotation).apply(turned)
    np.testing.assert_allclose(back, point, rtol=0, atol=1e-15)


RAY = np.zeros((1, 3)), np.array([[0.0, -1.0, 0.0]])


def test_person_crosses_when_predicted() -> None:
    """A ball at 1 m/s is seen along a ray while it is within its radius of it."""
    time = np.arange(0.0, 4.0, 0.01)
    actor = ball(0.2, motion=lambda now: Pose(translation=(now - 2.0, -3.0, 0.0)))
    warm = time[incident(*RAY, time, ROOM, [actor])[:, 0] > ROOM + 1]
    np.testing.assert_allclose(warm[[0, -1]], [1.8, 2.2], rtol=0, atol=0.011)  # s


def test_the_nearest_actor_hides_the_others() -> None:
    """Of two bodies along a ray the nearer one is seen, in either order, as warm as it is now."""
    mesh, pose = ball(0.2).mesh, Pose(translation=(0.0, -2.0, 0.0))
    near = Actor(mesh, lambda now: np.full(len(mesh.vertices), 300 + now), lambda _: pose)
    far = ball(0.4, 310.0, motion=lambda _: Pose(translation=(0.0, -3.0, 0.0)))
    for actors in ([near, far], [far, near]):
        seen = incident(*RAY, np.arange(3.0), ROOM, actors)[:, 0]
        np.testing.assert_allclose(seen, [300.0, 301.0, 302.0], rtol=0, atol=1e-9)  # K
