"""Emulated cameras show the simulation, and its truth is kept beside the recordings."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from dbthermal import response as responses
from dbthermal import simulation, store
from dbthermal.emissivity import embedded_table
from dbthermal.instruments.emulated import World
from reproduction.experiments import emulated_rig
from reproduction.experiments.emulated_bench import Bench

SHAPE = (12, 16)
RIG = simulation.Rig(gain_std=0.0, offset_std=0.0, bad_fraction=0.0)
MATERIALS = ["plate window glass", "silver paint"]
PLACES = {
    name: (slice(2, 10), slice(8 * number, 8 * number + 6)) for number, name in enumerate(MATERIALS)
}


def views(rig: simulation.Rig = RIG) -> emulated_rig.Views:
    """Views of a small rig."""
    detector = simulation.pattern(rig, SHAPE, np.random.default_rng(1))
    return emulated_rig.Views(rig, detector, seed=2)


def expected(band: str, temperature: float) -> float:
    """Counts of a blackbody."""
    return float(responses.curve(RIG.response(), band).counts(np.array(temperature)))


def mean_of(picture: emulated_rig.Picture, frames: int = 200) -> np.ndarray:
    """Mean counts of many frames."""
    return np.asarray(np.mean([picture(0.0) for _ in range(frames)], axis=0))


def test_blackbody_follows_the_world() -> None:
    """Every frame shows the blackbody as warm as it is now, with the rig's noise."""
    world = World()
    pictures = views().blackbody(world)
    for temperature in (285.0, 330.0):
        world.blackbody_temperature = temperature
        for band, picture in pictures.items():
            frames = np.array([picture(0.0) for _ in range(100)], dtype=np.float64)
            noise = float(RIG.response()["noise"].sel(band=band))
            # 19,200 samples: their mean within five of its deviations, and the rounding's.
            mean_std = np.hypot(noise, 0.29) / np.sqrt(frames.size)
            assert frames.mean() == pytest.approx(expected(band, temperature), abs=5 * mean_std)
            assert frames.std() == pytest.approx(np.hypot(noise, 0.29), rel=0.03)


def test_recordings_have_each_its_own_noise() -> None:
    """What a calibration leaves of its noise does not cancel against that of a scene."""
    made, world = views(), World(blackbody_temperature=300.0)
    pictures = [made.blackbody(world), made.blackbody(world), made.movie(scene())]
    for band in RIG.bands:
        frames = [picture[band](0.0).astype(np.float64).ravel() for picture in pictures]
        # 192 pixels: of independent noise within four deviations.
        together = np.asarray(np.corrcoef(frames))[np.triu_indices(3, 1)]
        assert np.abs(together).max() < 4 / 192**0.5


def test_fixed_pattern_is_the_detectors() -> None:
    """A rig with a fixed pattern shows it, and its dead pixels at 0."""
    rig = simulation.Rig(bad_fraction=0.05)
    made = views(rig)
    world = World(blackbody_temperature=300.0)
    for band, picture in made.blackbody(world).items():
        here = made.detector.sel(band=band)
        clean = expected(band, 300.0) * here["gain"].values + here["offset"].values
        seen, dead = mean_of(picture), here["dead"].values
        assert np.all(seen[dead] == 0)
        noise = float(made.response["noise"].sel(band=band))
        np.testing.assert_allclose(seen[~dead], clean[~dead], rtol=0, atol=5 * noise / 200**0.5)


def test_samples_reflect_the_blackbody() -> None:
    """Counts of a sample are the mixture, of its own temperature and of the blackbody's."""
    own = {"plate window glass": 320.0, "silver paint": 310.0}
    world = World(blackbody_temperature=290.0, scene=lambda _: own)
    table = embedded_table()["emissivity"].sel(material=MATERIALS)
    for band, picture in views().samples(world, table, PLACES).items():
        seen, noise = mean_of(picture), float(RIG.response()["noise"].sel(band=band))
        for name, place in PLACES.items():
            share = float(table.sel(material=name, band=band))
            mixed = share * expected(band, own[name]) + (1 - share) * expected(band, 290.0)
            np.testing.assert_allclose(seen[place], mixed, rtol=0, atol=5 * noise / 200**0.5)
        assert seen[0].mean() == pytest.approx(expected(band, 290.0), abs=noise)


def scene() -> xr.Dataset:
    """An object that warms evenly before a background that steps."""
    time = np.arange(11) / 10
    emissivity = xr.DataArray([0.8, 0.6], dims="band", coords={"band": list(RIG.bands)})
    warm = np.broadcast_to(300 + 10 * time[:, np.newaxis, np.newaxis], (11, *SHAPE))
    background = np.where(np.arange(11)[:, np.newaxis, np.newaxis] < 5, 295.0, 300.0)
    return simulation.scene(time, warm, np.broadcast_to(background, (11, *SHAPE)), emissivity)


def test_movie_goes_on_between_its_frames() -> None:
    """Counts at and between the frames are the simulation's; other times raise a ValueError."""
    quiet = simulation.Rig(gain_std=0.0, offset_std=0.0, bad_fraction=0.0, noise=(1e-4, 1e-4))
    clean = simulation.observe(scene(), quiet.response(), np.random.default_rng(0))["counts"]
    for band, picture in views(quiet).movie(scene()).items():
        frames = clean.sel(band=band).values
        np.testing.assert_allclose(picture(0.3), frames[3], rtol=0, atol=0.6)  # [count]
        np.testing.assert_allclose(
            picture(0.42), 0.8 * frames[4] + 0.2 * frames[5], rtol=0, atol=0.6
        )
        np.testing.assert_allclose(picture(1.0), frames[10], rtol=0, atol=0.6)
        for time in (-0.01, 1.01):
            with pytest.raises(ValueError, match="Invalid time"):
                picture(time)


def test_truth_at_the_times_of_a_capture() -> None:
    """Truth is interpolated to the recording's clock, and not extrapolated."""
    began = scene().assign_attrs(began=100.0)
    capture = xr.Dataset(coords={"time": [0.05, 0.15]}, attrs={"clock_origin": 100.2})
    found = emulated_rig.shown(began, capture)
    np.testing.assert_allclose(found["object_temperature"][:, 0, 0], [302.5, 303.5], atol=1e-9)
    np.testing.assert_allclose(found["time"], [0.05, 0.15])
    with pytest.raises(ValueError, match="Invalid times"):
        emulated_rig.shown(began, capture.assign_attrs(clock_origin=99.0))


def test_thermometers_have_their_errors() -> None:
    """Readings scatter by the stated deviation, and are exact without one."""
    world = Bench(np.random.default_rng(3), {"blackbody": 0.1})
    world.thermocouples.update({1: "blackbody", 2: "room"})
    read = np.array([world.thermocouple_temperature(1) for _ in range(2000)])
    assert read.std() == pytest.approx(0.1, rel=0.06)  # four deviations of 2000 samples
    assert read.mean() == pytest.approx(world.blackbody_temperature, abs=0.01)  # [K]
    assert {world.thermocouple_temperature(2) for _ in range(5)} == {296.15}
    assert np.isnan(world.thermocouple_temperature(3))


def test_samples_are_heated_step_by_step() -> None:
    """Each step sets the blackbody, and samples within their limits."""
    ends = dict.fromkeys(MATERIALS, (318.0, 343.0))
    world = Bench(np.random.default_rng(4), {}, ends)
    seen = []
    for temperature in (290.0, 300.0, 310.0):
        world.step(temperature)
        here = world.scene_temperatures()
        assert here["blackbody"] == temperature
        seen += [here[name] for name in MATERIALS]
    assert len(set(seen)) == 6
    assert 318.0 <= min(seen) < max(seen) <= 343.0


def test_thermocouple_follows_what_it_touches() -> None:
    """A thermocouple reads the scene's course from its beginning, and the start before it."""
    now = [100.0]
    course = xr.DataArray([300.0, 310.0], dims="time", coords={"time": [0.0, 10.0]})
    world = Bench(
        np.random.default_rng(5), {}, touched={"plate": course}, clock=lambda: now[0], waits=True
    )
    world.thermocouples[2] = "plate"
    now[0] = 105.0
    assert world.thermocouple_temperature(2) == 300.0
    world.begin()
    now[0] = 107.5
    assert world.thermocouple_temperature(2) == pytest.approx(302.5, abs=1e-9)  # [K]


def test_truth_lies_beside_the_recordings(tmp_path: Path) -> None:
    """Truth is opened by name, and cleared with the emulated recordings; a folder with a recording
    of hardware or a foreign file is not cleared.
    """
    emulated_rig.clear(tmp_path / "none")
    for name in ("", "scene.zarr", "notes.txt"):
        folder = tmp_path / f"with {name}"
        assert emulated_rig.truth(folder) == {}
        emulated_rig.keep_truth(folder, {}, shown=scene(), response=RIG.response())
        found = emulated_rig.truth(folder)
        assert set(found) == {"shown", "response"}
        xr.testing.assert_equal(found["shown"], scene())
        if name == "scene.zarr":
            store.save(RIG.response().assign_attrs(is_simulated=False), folder / name, {})
        elif name:
            (folder / name).write_text("mine", encoding="utf-8")
        if name:
            with pytest.raises(FileExistsError, match=name):
                emulated_rig.clear(folder)
            assert len(list(folder.iterdir())) == 3
        else:
            emulated_rig.clear(folder)
            assert not folder.exists()
