"""Emulated cameras show the simulation, and its truth is kept beside the recordings."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from captures import emissivity_of
from refused import assert_raises, assert_refused

from dbthermal import response as responses
from dbthermal import simulation, store
from dbthermal.instruments.emulated import World
from reproduction.experiments import emulated
from reproduction.experiments.emulated import Bench

SHAPE = (12, 16)
RIG = simulation.Rig(gain_std=0.0, offset_std=0.0, bad_fraction=0.0)


def views() -> emulated.Views:
    """Views of a small rig."""
    return emulated.Views(RIG, simulation.pattern(RIG, SHAPE, np.random.default_rng(1)), seed=2)


def test_blackbody_follows_the_world() -> None:
    """Every frame shows the blackbody as warm as it is now, with the rig's noise."""
    world = World()
    pictures = views().blackbody(world)
    for temperature in (285.0, 330.0):
        world.blackbody_temperature = temperature
        for band, picture in pictures.items():
            frames = np.array([picture(0.0) for _ in range(100)], dtype=np.float64)
            expected = responses.curve(RIG.response(), band).counts(np.array(temperature))
            std = np.hypot(float(RIG.response()["noise"].sel(band=band)), 0.29)
            # 19,200 samples: their mean within five of its deviations, and the rounding's.
            mean_std = std / np.sqrt(frames.size)
            assert frames.mean() == pytest.approx(float(expected), abs=5 * mean_std)
            assert frames.std() == pytest.approx(std, rel=0.03)


def test_recordings_have_each_its_own_noise() -> None:
    """What a calibration leaves of its noise does not cancel against that of a scene."""
    made, world = views(), World(blackbody_temperature=300.0)
    pictures = [made.blackbody(world), made.blackbody(world), made.movie(scene())]
    for band in RIG.bands:
        frames = [picture[band](0.0).astype(np.float64).ravel() for picture in pictures]
        # 192 pixels: of independent noise within four deviations.
        together = np.asarray(np.corrcoef(frames))[np.triu_indices(3, 1)]
        assert np.abs(together).max() < 4 / 192**0.5


def scene() -> xr.Dataset:
    """An object that warms evenly before a background that steps."""
    time = np.arange(11) / 10
    warm = np.broadcast_to(300 + 10 * time[:, np.newaxis, np.newaxis], (11, *SHAPE))
    background = np.where(np.arange(11)[:, np.newaxis, np.newaxis] < 5, 295.0, 300.0)
    cold = np.broadcast_to(background, (11, *SHAPE))
    return simulation.scene(time, warm, cold, emissivity_of(0.8, 0.6))


def test_truth_at_the_times_of_a_capture() -> None:
    """Truth is interpolated to the recording's clock, and not extrapolated."""
    began = scene().assign_attrs(began=100.0)
    capture = xr.Dataset(coords={"time": [0.05, 0.15]}, attrs={"clock_origin": 100.2})
    found = emulated.shown(began, capture)
    np.testing.assert_allclose(found["object_temperature"][:, 0, 0], [302.5, 303.5], atol=1e-9)
    np.testing.assert_allclose(found["time"], [0.05, 0.15])
    assert_refused("Invalid times", emulated.shown, began, capture.assign_attrs(clock_origin=99.0))


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
    """Truth is cleared with emulated recordings, and not beside hardware's or foreign files."""
    emulated.clear(tmp_path / "none")
    for name in ("", "scene.zarr", "notes.txt"):
        folder = tmp_path / f"with {name}"
        assert emulated.truth(folder) == {}
        emulated.keep_truth(folder, {}, shown=scene(), response=RIG.response())
        found = emulated.truth(folder)
        assert set(found) == {"shown", "response"}
        xr.testing.assert_equal(found["shown"], scene())
        if name == "scene.zarr":
            store.save(RIG.response().assign_attrs(is_simulated=False), folder / name, {})
        elif name:
            (folder / name).write_text("mine", encoding="utf-8")
        if name:
            assert_raises(FileExistsError, name, emulated.clear, folder)
            assert len(list(folder.iterdir())) == 3
        else:
            emulated.clear(folder)
            assert not folder.exists()
