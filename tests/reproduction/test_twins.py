"""Twins: scenes that satisfy the schema, match their description, and can be separated."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
import xarray as xr
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from dbthermal import metrics, response, schema, separation, simulation
from dbthermal.simulation import Rig
from reproduction import twins
from reproduction.twins import TWINS, Capture, Stage, solids, surfaces, vessels
from reproduction.twins.panes import WITHDRAWAL
from reproduction.twins.props import Writing
from reproduction.twins.rays import Camera, Caster
from reproduction.twins.stage import AMBIENT, clock
from reproduction.twins.surroundings import Actor, Pose
from reproduction.twins.vessels import Vessel

GLASS = xr.DataArray(
    [0.86, 0.72], dims="band", coords={"band": ["8-14", "9.5"]}, attrs={"units": "1"}
)
SHORT = Capture(GLASS, shape=(24, 32), time=clock(12, rate=2.0))
SLOW = Capture(GLASS, shape=(36, 48), time=clock(36, rate=1.0))
FILLED = {"glass_plate", "fingers", "fingerprint"}  # whose plate is larger than the image


def rng(seed: int = 1) -> np.random.Generator:
    """Seeded random numbers."""
    return np.random.default_rng(seed)


@pytest.fixture
def scan(mirror: Path) -> trimesh.Trimesh:
    """The Stanford bunny."""
    return trimesh.load_mesh(mirror / "meshes" / "stanford-bunny.obj", process=False)


@pytest.fixture(scope="module", params=TWINS)
def scene(request: pytest.FixtureRequest) -> xr.Dataset:
    """Each of the twins, small and short."""
    return twins.twin(request.param, SHORT, rng())


@pytest.fixture(scope="module")
def rig() -> xr.Dataset:
    """Response of the default rig."""
    return Rig().response()


def test_scene_is_complete(scene: xr.Dataset) -> None:
    """Dims, units and labels are those of a scene, and it says which twin it is."""
    for name in ("object_temperature", "background_temperature", "emissivity"):
        schema.check_variable(scene[name], schema.STAGES["separated"][name], name)
    assert scene.attrs["origin"] == "simulated"
    assert scene.attrs["twin"] in TWINS
    assert 0.1 < float(scene["object_share"].mean()) <= 1.0 + 1e-9


def test_temperatures_are_those_of_a_room(scene: xr.Dataset) -> None:
    """Temperatures lie between a wet finger's stroke and a hot drink."""
    for name in ("object_temperature", "background_temperature"):
        assert float(scene[name].min()) > AMBIENT - Writing().drop - 0.1
        assert float(scene[name].max()) < 345.0


def test_beside_the_object_the_background_is_seen(scene: xr.Dataset) -> None:
    """Beside the object both temperatures are equal; a plate fills the view."""
    beyond = scene["object_share"].values == 0
    assert (scene.attrs["twin"] in FILLED) == (not beyond.any())
    np.testing.assert_array_equal(
        scene["object_temperature"].values[:, beyond],
        scene["background_temperature"].values[:, beyond],
    )


def test_observed_with_noise_only(scene: xr.Dataset, rig: xr.Dataset) -> None:
    """A rig can observe it: the stage `corrected`."""
    corrected = schema.check(simulation.observe(scene, rig, rng()), "corrected")
    assert corrected["counts"].shape[1:] == scene["object_temperature"].shape


@pytest.mark.parametrize(
    "name", ["fingers", *(pytest.param(n, marks=pytest.mark.slow) for n in TWINS if n != "fingers")]
)
def test_the_seed_makes_the_scene(name: str) -> None:
    """The same seed gives the same scene; another seed gives other ways, where anything moves."""
    scene, again, other = (twins.twin(name, SHORT, rng(seed)) for seed in (1, 1, 2))
    xr.testing.assert_identical(again, scene)
    still = bool(np.ptp(scene["background_temperature"].values) < 1e-9)
    assert still == (name == "fingerprint")
    assert still == scene["background_temperature"].equals(other["background_temperature"])


def obstructed(stage: Stage, time: np.ndarray) -> bool:
    """True if an actor hides a pixel of the object from the camera at some time."""
    directions = stage.camera.directions()
    origins = np.broadcast_to(stage.camera.position, directions.shape)
    hits = Caster(stage.mesh).cast(origins, directions)
    origins, directions, behind = origins[hits.met], directions[hits.met], hits.distance[hits.met]
    for actor in stage.actors:
        caster = Caster(actor.mesh)
        for now in time if actor.motion else time[:1]:
            pose = actor.motion(float(now)) if actor.motion else Pose()
            if np.any(caster.cast(*pose.inwards(origins, directions)).distance < behind):
                return True
    return False


LONG = replace(SHORT, time=clock(70, rate=2.0))


@pytest.mark.parametrize(
    ("name", "seed"),
    [
        pytest.param(name, seed, marks=() if seed == 1 and name == "bunny" else pytest.mark.slow)
        for name in TWINS
        for seed in (1, 2, 3)
    ],
)
def test_nothing_comes_before_the_object(name: str, seed: int) -> None:
    """No actor hides the object from the camera in 35 s."""
    assert not obstructed(TWINS[name](LONG, rng(seed)), LONG.time)


@pytest.mark.data
def test_nothing_comes_before_the_scan(scan: trimesh.Trimesh) -> None:
    """No actor hides the scanned bunny, whose ears reach higher."""
    assert not obstructed(solids.bunny(LONG, rng(), scan=scan), LONG.time)


def inside(stage: Stage) -> bool:
    """True if every vertex of the object lies within the image."""
    places = stage.camera.project(stage.mesh.vertices)
    return bool(np.all((places > -0.5) & (places < np.array(stage.camera.shape) - 0.5)))


def test_the_whole_rabbit_is_seen() -> None:
    """No vertex of the built-in rabbit lies beyond the image, ears and feet included."""
    assert inside(solids.bunny(SHORT, rng()))


@pytest.mark.data
def test_the_whole_scan_is_seen(scan: trimesh.Trimesh) -> None:
    """No vertex of the scanned bunny does, and its head is in the left half."""
    stage = solids.bunny(SHORT, rng(), scan=scan)
    assert inside(stage)
    head = stage.mesh.vertices[:, 2] > 0.11
    assert stage.mesh.vertices[head, 0].mean() < -0.01  # m


@pytest.mark.parametrize(
    ("name", "celsius"),
    [("wineglass", 63.6), pytest.param("coffee_pot", 63.1, marks=pytest.mark.slow)],
)
def test_vessels_peak_where_the_paper_s_did(name: str, celsius: float) -> None:
    """The outer wall at the thermocouple peaks at 63.6 and 63.1 degrees Celsius."""
    readings = twins.thermocouple_readings(
        twins.twin(name, SLOW, rng()), rng(), std=0.0, offset_std=0.0, bead=1
    )
    np.testing.assert_allclose(float(readings.max()) - 273.15, celsius, rtol=0, atol=0.15)  # K


@pytest.mark.slow
@pytest.mark.parametrize("name", ["wineglass", "coffee_pot"])
def test_vessels_can_be_separated(name: str, rig: xr.Dataset) -> None:
    """With unknown emissivities the thermocouple's pixels are right to 1.7 % of Celsius."""
    scene = twins.twin(name, Capture(GLASS, shape=(36, 48)), rng())
    y, x = int(scene["thermocouple_y"][0]), int(scene["thermocouple_x"][0])
    bead = {"y": slice(y - 1, y + 2), "x": slice(x - 1, x + 2)}
    separated = separation.solve(simulation.observe(scene.isel(bead), rig, rng()), rig)
    error = metrics.relative_error_celsius(
        separated["object_temperature"].mean(("y", "x")),
        scene["object_temperature"].isel(bead).mean(("y", "x")),
    )
    assert float(error.mean()) < 1.7


def test_the_level_rises() -> None:
    """At the end of the pouring the wall is wet below the level, dry above, and was dry before."""
    vessel = vessels.WINEGLASS
    height = np.array([0.10, 0.14, 0.21])
    before, after = (vessel.wetted(height, vessel.start + t) for t in (0.0, vessel.duration))
    assert before.max() < 0.01
    np.testing.assert_allclose(after, [1.0, 1.0, 0.0], rtol=0, atol=0.01)


def test_prints_fade() -> None:
    """A print is warmest when the capture starts, by at least 1 K, and only fades from then on."""
    scene = twins.twin("fingerprint", SLOW, rng(), spacing=0.006)
    peak = scene["object_temperature"].max(("y", "x")).values - AMBIENT
    assert peak[0] > 1.0
    assert np.all(np.diff(peak) < 0)
    assert peak[-1] > 0.2
    np.testing.assert_allclose(scene["background_temperature"], AMBIENT, rtol=0, atol=1e-9)  # K


def test_a_visitor_moves_behind_a_print() -> None:
    """A person far away moves the plate's background and leaves the print as it is."""
    alone, visited = (
        twins.twin("fingerprint", SLOW, rng(), spacing=0.006, visitor=visitor)
        for visitor in (False, True)
    )
    xr.testing.assert_equal(alone["object_temperature"], visited["object_temperature"])
    assert float(visited["background_temperature"].max()) > AMBIENT + 5


def test_fingers_are_reflection_only() -> None:
    """The plate stays at room temperature while warm skin is reflected, now and then."""
    scene = twins.twin("fingers", SLOW, rng())
    np.testing.assert_allclose(scene["object_temperature"], AMBIENT, rtol=0, atol=1e-9)  # K
    warm = scene["background_temperature"] > AMBIENT + 5
    assert warm.any("time").mean() > 0.2
    assert not warm.all("time").any()


def test_letters_are_reflected_in_the_plate() -> None:
    """While CV is written the plate reflects strokes colder than the room, more and more."""
    scene = twins.twin("glass_plate", SLOW, rng())
    cold = (scene["background_temperature"] < AMBIENT - 1).sum(("y", "x")).values
    assert cold[0] == 0
    assert cold[8] > 0
    assert cold[15] > 1.5 * cold[8]


def test_letters_stay_when_the_hand_has_left() -> None:
    """A second after the last stroke no skin is seen; 15 s later CV is still 2 K cold and more."""
    writing = Writing(start=1.0)
    gone = float(writing.path()[0][-1]) + WITHDRAWAL
    capture = replace(SLOW, shape=(72, 96), time=np.array([0.0, gone, gone + 15.0]))
    scene = twins.twin("glass_plate", capture, rng(), writing=writing)
    change = scene["background_temperature"].isel(time=[1, 2]) - AMBIENT
    assert float(change.max()) < 1e-9
    assert np.all((change < -2).mean(("y", "x")) > 0.03)


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
    stage = Stage("ball", plate, warm, camera, [ball], mirrored=float(np.linalg.norm(BALL)))
    capture = Capture(GLASS, shape=(90, 120), time=clock(2), baseline=0.04)
    return twins.take(stage, replace(capture, **changes))  # type: ignore[arg-type]


def middle(warmth: np.ndarray) -> np.ndarray:
    """Row and column of the middle of what is warmer than the room [pixel]."""
    weight = warmth - AMBIENT
    return np.asarray(np.tensordot(np.indices(weight.shape), weight, 2) / weight.sum())


def test_parallax_is_that_of_a_mirror_image() -> None:
    """Each camera sees a ball's mirror image where it is, and the true shift tells one from two."""
    scene = ball_mirrored()
    image, stage = BALL * (1, -1, 1), Camera((0.0, -1.0, 0.0), (0.0, 0.0, 0.0), (90, 120))
    first = middle(scene["background_temperature"].values[0])
    second = middle(scene["second_background_temperature"].values[0])
    np.testing.assert_allclose(first, stage.project(image), rtol=0, atol=0.05)  # pixel
    np.testing.assert_allclose(second, stage.beside(0.04).project(image), rtol=0, atol=0.05)
    # The point of the plate through which the second camera sees the ball.
    eye = np.array([0.04, -1.0, 0.0])
    row, column = stage.project(eye + (image - eye) / (image[1] + 1.0)).round().astype(int)
    seen = scene.isel(y=row, x=column)
    np.testing.assert_allclose(
        seen["shift"], stage.project(image) - [row, column], rtol=0, atol=1.0
    )


def resampled(scene: xr.Dataset, rig: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Band 2's reflection at the object's points, and band 1's at the true shift (time, pixel)."""
    seen = scene.assign(emissivity=0.0 * scene["emissivity"] + 1e-6)
    views = twins.registered(seen, twins.observe(seen, rig.assign(noise=0.0 * rig["noise"]), rng()))
    kelvin = response.apparent_temperature(rig, views["counts"]).values
    known = (scene["shift"].notnull().all("axis") & scene["on_object"]).values
    moved = np.indices(known.shape) + scene["shift"].values
    first = [map_coordinates(frame, moved[:, known], order=5) for frame in kelvin[0]]
    return kelvin[1][:, known], np.array(first)


@pytest.mark.parametrize("name", ["wineglass", pytest.param("coffee_pot", marks=pytest.mark.slow)])
def test_nothing_aliases(name: str, rig: xr.Dataset) -> None:
    """Resampled by the true shift, the second band's reflection is that of the first.

    What is left is a tenth of the change: the bodies are at several distances, and square pixels
    pass a little of what is finer than they are.
    """
    capture = Capture(GLASS, shape=(72, 96), time=clock(40), baseline=0.04)
    second, first = resampled(twins.twin(name, capture, rng()), rig)
    moving = np.nanstd(first, axis=0) > 0.5
    left = np.nanstd(second - first, axis=0)[moving] / np.nanstd(first, axis=0)[moving]
    print(f"{name}: {np.median(left):.3f} of the change left, {np.quantile(left, 0.9):.3f} in 90 %")
    assert np.median(left) < 0.1


def test_the_lens_keeps_the_mean() -> None:
    """Blur and pixels move no warmth: a ball's image has one sum, at any blur and any rays."""
    sums = [
        float(
            (ball_mirrored(shape=(45, 60), **change)["background_temperature"][0] - AMBIENT).sum()
        )
        for change in ({}, {"blur": 1.5}, {"rays": 6})
    ]
    np.testing.assert_allclose(sums, sums[0], rtol=0.01)


def test_a_surface_is_registered(rig: xr.Dataset) -> None:
    """By the geometry both bands show the same point of the surface; hidden ones are missing."""
    capture = Capture(GLASS, shape=(72, 96), time=clock(3), baseline=0.04)
    scene = twins.twin("coffee_pot", capture, rng())
    seen = scene.assign(emissivity=0 * scene["emissivity"] + 0.999999)
    views = twins.registered(seen, twins.observe(seen, rig, rng()))
    kelvin = response.apparent_temperature(rig, views["counts"])
    apart = (kelvin[1] - kelvin[0]).where(scene["on_object"]).mean("time")
    assert float(abs(apart).quantile(0.9)) < 1.0  # [K], of 40 K from level to rim, in noise
    assert bool(views["counts"][1].isnull().where(~scene["on_object"]).any())
    assert 0.7 < float(views["noise_factor"][1]) < 1.0


def test_a_baseline_needs_a_second_view(rig: xr.Dataset) -> None:
    """The first camera's view does not depend on the baseline; without one all is of one place."""
    one = twins.twin("coffee_pot", SHORT, rng())
    two = twins.twin("coffee_pot", replace(SHORT, baseline=0.04), rng())
    for name in ("object_temperature", "background_temperature", "on_object"):
        np.testing.assert_array_equal(two[name], one[name])
    assert not two["second_background_temperature"].equals(two["background_temperature"])
    plain = simulation.observe(one, rig, rng())
    xr.testing.assert_identical(twins.observe(one, rig, rng()), plain)


def test_a_scan_is_stood_on_the_table() -> None:
    """A rabbit scanned with y up, in millimetres, is 0.15 m high; its z faces the camera."""
    upright = solids.rabbit()
    lying = surfaces.moved(upright, Rotation.from_euler("x", -90.0, degrees=True), scale=1e3)
    stood = solids.bunny(SHORT, rng(), scan=lying).mesh
    np.testing.assert_allclose(stood.vertices[:, 2].min(), 0.0, rtol=0, atol=1e-12)  # m
    np.testing.assert_allclose(np.ptp(stood.vertices[:, 2]), 0.15, rtol=0, atol=1e-12)  # m
    np.testing.assert_allclose(stood.face_normals, upright.face_normals, rtol=0, atol=1e-9)


def test_thermocouples_read_the_mean_under_the_bead() -> None:
    """Without errors a reading is the mean of 3 x 3 pixels; a probe's offset is constant."""
    scene = twins.twin("glass_plate", SHORT, rng())
    y, x = int(scene["thermocouple_y"][0]), int(scene["thermocouple_x"][0])
    near = scene["object_temperature"][:, y - 1 : y + 2, x - 1 : x + 2].mean(("y", "x"))
    exact = twins.thermocouple_readings(scene, rng(), std=0.0, offset_std=0.0)[0]
    np.testing.assert_allclose(exact, near, rtol=0, atol=1e-9)  # K
    shifted = twins.thermocouple_readings(scene, rng(), std=0.0, offset_std=0.5)[0] - exact
    assert abs(float(shifted[0])) > 0.01
    np.testing.assert_allclose(shifted, shifted[0], rtol=0, atol=1e-9)  # K


def test_a_probe_is_on_its_ring() -> None:
    """A probe is at its angle on the ring of vertices that is nearest to its height."""
    cone = surfaces.revolved([(0.05, 0.0), (0.03, 0.1)], 0.03)
    place = np.array(surfaces.on_wall(cone, 0.013, 30.0))
    assert place[2] in cone.vertices[:, 2]
    radius = 0.05 - 0.2 * place[2]
    expected = radius * np.array([0.5, -np.sqrt(0.75)])
    np.testing.assert_allclose(place[:2], expected, rtol=0, atol=1e-12)  # m


def vessel(**changes: object) -> Vessel:
    """A wineglass with changes."""
    return replace(vessels.WINEGLASS, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: twins.twin("teapot", SHORT, rng()), "Unknown twin 'teapot'"),
        (lambda: Capture(GLASS[:1], baseline=0.04), "Must be two"),
        (lambda: Capture(GLASS.rename(band="filter")), "Must be .band,."),
        (lambda: Capture(GLASS, blur=0.0), "Invalid blur 0.0"),
        (
            lambda: twins.thermocouple_readings(twins.twin("fingers", SHORT, rng()), rng(), bead=2),
            "Invalid bead 2 pixels. Must be odd",
        ),
        (
            lambda: twins.thermocouple_readings(twins.twin("bulb", SHORT, rng()), rng(), bead=31),
            "its bead reaches beyond the object",
        ),
        (
            lambda: twins.twin("wineglass", SHORT, rng(), vessel=vessel(probe=(0.01, 0.0))),
            "Must be on the object",
        ),
        (
            lambda: twins.twin("wineglass", SHORT, rng(), vessel=vessel(probe=(0.152, 180.0))),
            "behind another part of the object. Must be seen by the camera",
        ),
    ],
)
def test_refusals(wrong: object, message: str) -> None:
    """Invalid twins, vessels, baselines and beads raise a ValueError with the rule."""
    with pytest.raises(ValueError, match=message):
        wrong()  # type: ignore[operator]
