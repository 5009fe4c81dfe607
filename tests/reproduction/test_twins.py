"""Twins: scenes that satisfy the schema and match their description; notebook 08 separates them."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import trimesh
import xarray as xr
from numpy.random import default_rng
from refused import refused
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from dbthermal import response, schema, simulation
from dbthermal.simulation import Rig
from reproduction import twins
from reproduction.twins import TWINS, bodies, stage, surfaces
from reproduction.twins.people import Writing
from reproduction.twins.rays import Camera, Caster
from reproduction.twins.stage import AMBIENT, Capture, Stage, clock
from reproduction.twins.surroundings import Actor, Pose

GLASS = xr.DataArray(
    [0.86, 0.72], dims="band", coords={"band": ["8-14", "9.5"]}, attrs={"units": "1"}
)
SHORT = Capture(GLASS, shape=(24, 32), time=clock(12, rate=2.0))
SLOW = Capture(GLASS, shape=(36, 48), time=clock(36, rate=1.0))
LONG = replace(SHORT, time=clock(70, rate=2.0))
LARGE = Capture(GLASS, shape=(72, 96), time=clock(40), baseline=0.04)
FILLED = {"glass_plate", "fingers", "fingerprint"}  # whose plate is larger than the image
RESPONSE = Rig().response()
OBJECT, BACKGROUND = "object_temperature", "background_temperature"


@pytest.mark.parametrize("name", TWINS)
def test_scene_is_complete(name: str) -> None:
    """A scene of `separated` that a rig observes; the same seed gives it, another others."""
    options = {"spacing": 0.006} if name == "fingerprint" else {}  # m: a coarse mesh is quick
    scene = twins.twin(name, SHORT, default_rng(1), **options)
    for part in (OBJECT, BACKGROUND, "emissivity"):
        schema.check_variable(scene[part], schema.STAGES["separated"][part], part)
    assert (scene.attrs["origin"], scene.attrs["twin"]) == ("simulated", name)
    assert 0.1 < float(scene["object_share"].mean()) <= 1.0 + 1e-9
    for part in (OBJECT, BACKGROUND):  # between a wet finger's stroke and a hot drink
        assert float(scene[part].min()) > AMBIENT - Writing().drop - 0.1
        assert float(scene[part].max()) < 345.0
    beyond = scene["object_share"].values == 0
    assert (name in FILLED) == (not beyond.any())
    emitted, seen = (scene[part].values[:, beyond] for part in (OBJECT, BACKGROUND))
    np.testing.assert_array_equal(emitted, seen)
    corrected = schema.check(simulation.observe(scene, RESPONSE, default_rng(1)), "corrected")
    assert corrected["counts"].shape[1:] == scene[OBJECT].shape
    if name in ("fingers", "fingerprint"):
        again, other = (twins.twin(name, SHORT, default_rng(seed), **options) for seed in (1, 2))
        xr.testing.assert_identical(again, scene)
        assert scene[BACKGROUND].equals(other[BACKGROUND]) == (name == "fingerprint")


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("name", TWINS)
def test_nothing_comes_before_the_object(name: str, seed: int) -> None:
    """No actor hides a pixel of the object from the camera in 35 s, with any of three seeds."""
    seen, time = TWINS[name](LONG, default_rng(seed)), LONG.time
    directions = seen.camera.directions()
    origins = np.broadcast_to(seen.camera.position, directions.shape)
    hits = Caster(seen.mesh).cast(origins, directions)
    origins, directions, behind = origins[hits.met], directions[hits.met], hits.distance[hits.met]
    for actor in seen.actors:
        caster = Caster(actor.mesh)
        for now in time if actor.motion else time[:1]:
            pose = actor.motion(float(now)) if actor.motion else Pose()
            assert np.all(caster.cast(*pose.inwards(origins, directions)).distance >= behind)


def test_a_scan_is_stood_on_the_table() -> None:
    """A rabbit scanned lying, in millimetres, is 0.15 m high, and seen as a whole."""
    upright, seen = bodies.rabbit(), bodies.bunny(SHORT, default_rng(1))
    places = seen.camera.project(seen.mesh.vertices)
    assert np.all((places > -0.5) & (places < np.array(seen.camera.shape) - 0.5))
    lying = surfaces.moved(upright, Rotation.from_euler("x", -90.0, degrees=True), scale=1e3)
    stood = bodies.bunny(SHORT, default_rng(1), scan=lying).mesh
    np.testing.assert_allclose(stood.vertices[:, 2].min(), 0.0, rtol=0, atol=1e-12)  # m
    np.testing.assert_allclose(np.ptp(stood.vertices[:, 2]), 0.15, rtol=0, atol=1e-12)  # m
    np.testing.assert_allclose(stood.face_normals, upright.face_normals, rtol=0, atol=1e-9)


VESSELS = ["wineglass", pytest.param("coffee_pot", marks=pytest.mark.slow)]


@pytest.mark.parametrize("name", VESSELS)
def test_vessels_peak_where_the_paper_s_did(name: str) -> None:
    """The outer wall at the thermocouple peaks at 63.6 and 63.1 degrees Celsius."""
    celsius = {"wineglass": 63.6, "coffee_pot": 63.1}[name]
    scene = twins.twin(name, SLOW, default_rng(1))
    readings = stage.thermocouple_readings(scene, default_rng(1), std=0.0, offset_std=0.0, bead=1)
    np.testing.assert_allclose(float(readings.max()) - 273.15, celsius, rtol=0, atol=0.15)  # K


def test_prints_fade() -> None:
    """A print only fades from the start; a far person moves the background alone."""
    alone, visited = (
        twins.twin("fingerprint", SLOW, default_rng(1), spacing=0.006, visitor=visitor)
        for visitor in (False, True)
    )
    peak = alone[OBJECT].max(("y", "x")).values - AMBIENT
    assert peak[0] > 1.0
    assert np.all(np.diff(peak) < 0)
    assert peak[-1] > 0.2
    np.testing.assert_allclose(alone[BACKGROUND], AMBIENT, rtol=0, atol=1e-9)  # K
    xr.testing.assert_equal(alone[OBJECT], visited[OBJECT])
    assert float(visited[BACKGROUND].max()) > AMBIENT + 5


BALL = np.array([0.1, -1.5, 0.05])
"""Middle of a warm ball before a mirror [m]."""


def ball_mirrored(**changes: object) -> xr.Dataset:
    """A ball of 310 K and 0.1 m before a plate in y = 0, seen by cameras 1 m before it, 4 cm apart.

    Changes are to the capture. The true shift is that of the ball's distance.
    """
    plate = surfaces.plate(2.0, 2.0, 2.0).apply_translation((0, 0, -1))
    mesh = trimesh.creation.icosphere(4, 0.05)
    ball = Actor(mesh, np.full(len(mesh.vertices), 310.0), lambda _: Pose(translation=BALL))
    camera = Camera((0.0, -1.0, 0.0), (0.0, 0.0, 0.0), (90, 120))
    warm = np.full((2, len(plate.vertices)), AMBIENT)
    set_up = Stage("ball", plate, warm, camera, [ball], mirrored=float(np.linalg.norm(BALL)))
    capture = Capture(GLASS, shape=(90, 120), time=clock(2), baseline=0.04)
    return stage.take(set_up, replace(capture, **changes))  # type: ignore[arg-type]


def middle(warmth: np.ndarray) -> np.ndarray:
    """Row and column of the middle of what is warmer than the room [pixel]."""
    weight = warmth - AMBIENT
    return np.asarray(np.tensordot(np.indices(weight.shape), weight, 2) / weight.sum())


def test_parallax_is_that_of_a_mirror_image() -> None:
    """Each camera sees a ball's mirror image where it is, and the true shift leads to the first."""
    scene = ball_mirrored()
    image, camera = BALL * (1, -1, 1), Camera((0.0, -1.0, 0.0), (0.0, 0.0, 0.0), (90, 120))
    first, second = (middle(scene[f"{name}{BACKGROUND}"].values[0]) for name in ("", "second_"))
    np.testing.assert_allclose(first, camera.project(image), rtol=0, atol=0.05)  # pixel
    np.testing.assert_allclose(second, camera.beside(0.04).project(image), rtol=0, atol=0.05)
    # The point of the plate through which the second camera sees the ball.
    eye = np.array([0.04, -1.0, 0.0])
    row, column = camera.project(eye + (image - eye) / (image[1] + 1.0)).round().astype(int)
    shift = scene["shift"].isel(y=row, x=column)
    np.testing.assert_allclose(shift, camera.project(image) - [row, column], rtol=0, atol=1.0)


@pytest.mark.parametrize("name", VESSELS)
def test_nothing_aliases(name: str) -> None:
    """Resampled by the true shift, the second band's reflection is that of the first, but for a
    tenth of the change: bodies are at several distances, pixels pass what is finer than they are.
    """
    scene = twins.twin(name, LARGE, default_rng(1))
    seen = scene.assign(emissivity=0.0 * scene["emissivity"] + 1e-6)
    quiet = RESPONSE.assign(noise=0.0 * RESPONSE["noise"])
    views = stage.registered(seen, stage.observe(seen, quiet, default_rng(1)))
    kelvin = response.apparent_temperature(RESPONSE, views["counts"]).values
    known = (scene["shift"].notnull().all("axis") & scene["on_object"]).values
    moved = (np.indices(known.shape) + scene["shift"].values)[:, known]
    first = np.array([map_coordinates(frame, moved, order=5) for frame in kelvin[0]])
    apart, change = (np.nanstd(part, axis=0) for part in (kelvin[1][:, known] - first, first))
    assert np.median((apart / change)[change > 0.5]) < 0.1


def test_the_lens_keeps_the_mean() -> None:
    """Blur and pixels move no warmth: a ball's image has one sum, at any blur and any rays."""
    changes: list[dict[str, object]] = [{}, {"blur": 1.5}, {"rays": 6}]
    scenes = [ball_mirrored(shape=(45, 60), baseline=0.0, **change) for change in changes]
    sums = [float((scene[BACKGROUND][0] - AMBIENT).sum()) for scene in scenes]
    np.testing.assert_allclose(sums, sums[0], rtol=0.01)


def test_a_surface_is_registered() -> None:
    """By the geometry both bands show the same point of the surface; hidden ones are missing."""
    scene = twins.twin("coffee_pot", replace(LARGE, time=clock(3)), default_rng(1))
    seen = scene.assign(emissivity=0 * scene["emissivity"] + 0.999999)
    views = stage.registered(seen, stage.observe(seen, RESPONSE, default_rng(1)))
    kelvin = response.apparent_temperature(RESPONSE, views["counts"])
    apart = (kelvin[1] - kelvin[0]).where(scene["on_object"]).mean("time")
    assert float(abs(apart).quantile(0.9)) < 1.0  # [K], of 40 K from level to rim, in noise
    assert bool(views["counts"][1].isnull().where(~scene["on_object"]).any())
    assert 0.7 < float(views["noise_factor"][1]) < 1.0


def test_thermocouples_read_the_mean_under_the_bead() -> None:
    """Without errors a reading is the mean of 3 x 3 pixels; a probe's offset is constant."""
    scene = twins.twin("glass_plate", SHORT, default_rng(1))
    y, x = int(scene["thermocouple_y"][0]), int(scene["thermocouple_x"][0])
    near = scene[OBJECT][:, y - 1 : y + 2, x - 1 : x + 2].mean(("y", "x"))
    exact = stage.thermocouple_readings(scene, default_rng(1), std=0.0, offset_std=0.0)[0]
    np.testing.assert_allclose(exact, near, rtol=0, atol=1e-9)  # K
    shifted = stage.thermocouple_readings(scene, default_rng(1), std=0.0, offset_std=0.5)[0] - exact
    assert abs(float(shifted[0])) > 0.01
    np.testing.assert_allclose(shifted, shifted[0], rtol=0, atol=1e-9)  # K


def bead(name: str, size: int) -> Callable[[], object]:
    """Readings of a twin by a bead of some pixels."""
    return lambda: stage.thermocouple_readings(
        twins.twin(name, SHORT, default_rng(1)), default_rng(1), bead=size
    )


def probe(height: float, angle: float) -> Callable[[], object]:
    """A wineglass with a thermocouple at a height [m] and an angle [degree]."""
    moved = replace(bodies.WINEGLASS, probe=(height, angle))
    return lambda: twins.twin("wineglass", SHORT, default_rng(1), vessel=moved)


test_refusals = refused(
    lambda wrong: wrong(),
    [
        (lambda: twins.twin("teapot", SHORT, default_rng(1)), "Unknown twin 'teapot'"),
        (bead("fingers", 2), "Invalid bead 2 pixels. Must be odd"),
        (bead("coffee_pot", 31), "its bead reaches beyond the object"),
        (probe(0.01, 0.0), "Must be on the object"),
        (probe(0.152, 180.0), "behind another part of the object. Must be seen by the camera"),
    ],
)
