"""The rig waits for the blackbody, sweeps it through all filters, and what it recorded opens."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from faulty_camera import Faults, FaultyCamera
from rig_session import (
    LEVELS,
    QUICK,
    SHAPE,
    TEXT,
    bench,
    from_yaml,
    pictures,
    replaced,
    rig,
    scene_text,
)

from dbthermal import store
from dbthermal.instruments import protocols, recording
from dbthermal.instruments.camera import SourceLostError
from dbthermal.instruments.devices import Devices
from dbthermal.instruments.emulated.clock import EmulatedClock
from dbthermal.instruments.recording import Preview, Summary, _reader, notes, open_capture

QUICKLY = ("window: 3", "window: 0.02")
ONE = replaced(("[300.0, 290.0, 310.0]", "[300.0]"), QUICKLY)
TWO = replaced(("[300.0, 290.0, 310.0]", "[300.0, 290.0]"), QUICKLY)


def setter(devices: Devices, log: list[float] | None = None) -> Callable[[float], None]:
    """Set the emulated blackbody, and note it."""

    def set_temperature(value: float) -> None:
        assert devices.world is not None
        devices.world.blackbody_temperature = value
        if log is not None:
            log.append(value)

    return set_temperature


def swept(
    devices: Devices,
    folder: Path,
    log: list[float] | None = None,
    preview: Callable[[Preview], None] | None = None,
) -> list[Summary]:
    """Sweep a blackbody that is at once where it is set."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(protocols, "STABILITY_PERIOD", 0.01)
        set_temperature = setter(devices, log)
        return protocols.record_sweep(
            devices, folder, set_temperature=set_temperature, limits=QUICK, preview=preview
        )


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Summary]]:
    """Record two temperatures through two filters."""
    folder = tmp_path_factory.mktemp("sweep")
    with rig(from_yaml(TWO)) as devices:
        devices.prepare()
        return folder, swept(devices, folder)


def test_each_temperature_and_filter_is_a_recording(recorded: tuple[Path, list[Summary]]) -> None:
    """Names say which; the temperature is the one that was read meanwhile."""
    folder, steps = recorded
    names = [f"plate_{number:02d}_{band}.zarr" for number in range(2) for band in ("9.5", "11")]
    assert [step.path.name for step in steps] == names
    assert sorted(path.name for path in folder.iterdir()) == sorted(names)
    found = [_reader.mean_reading(step.path, "blackbody") for step in steps[::2]]
    np.testing.assert_allclose(found, [300.0, 290.0], rtol=0, atol=1e-4)  # [K]


def test_wheel_decides_what_is_seen(recorded: tuple[Path, list[Summary]]) -> None:
    """Joined, all bands have the counts of their filter at the temperature that was read."""
    movies = recording.open_sweep(recorded[0], "plate", frames=8)
    assert movies["counts"].shape == (3, 2, 8, *SHAPE)
    assert list(movies["band"].values) == ["8-14", "9.5", "11"]
    np.testing.assert_allclose(movies["temperature"], [290.0, 300.0], rtol=0, atol=1e-4)
    level = xr.DataArray(list(LEVELS.values()), dims="band") + 10 * movies["temperature"].round(2)
    exact = level + xr.DataArray(np.arange(SHAPE[1]) % 2, dims="x")
    np.testing.assert_array_equal(movies["counts"] - exact, 0 * movies["counts"])
    assert movies.attrs["is_simulated"] is True


def test_recording_says_what_it_was_made_with(recorded: tuple[Path, list[Summary]]) -> None:
    """Devices, slot of the wheel and blackbody are in each recording, under its band's name."""
    path = recorded[0] / "plate_01_11.zarr"
    identities = store.open_dataset(path).attrs["identities"]
    assert set(identities) == {"8-14", "11", "filter_wheel", "thermocouples"}
    assert identities["11"]["part_number"] == "EMULATED-BOSON-640"
    found = {source: value for _, kind, source, value in notes(path) if kind == "reading"}
    assert found["filter_wheel"] == 3
    assert found["blackbody"] == pytest.approx(290.0, abs=1e-4)
    assert found["ffc 11"] == 3


def test_bench_series_are_means_over_regions(recorded: tuple[Path, list[Summary]]) -> None:
    """Counts are of region and good frames, corrected, and temperatures are those read."""
    region = {"plate": (slice(0, 2), slice(0, 10))}
    series = recording.bench_series(recorded[0], "plate", region)["plate"]
    seen = np.array([3000.5, 2900.5]) + np.array(list(LEVELS.values()))[:, None]
    np.testing.assert_allclose(series["counts"], seen, rtol=0, atol=1e-9)  # [count]
    np.testing.assert_allclose(series["object_temperature"], [330.0] * 2, rtol=0, atol=1e-4)
    np.testing.assert_allclose(series["background_temperature"], [300.0, 290.0], rtol=0, atol=1e-4)
    ones = np.ones((3, *SHAPE))
    bad = ones > 1
    bad[..., 1::2] = True  # of each band the columns that see one count more
    dims = ("band", "y", "x")
    correction = xr.Dataset(
        {"gain": (dims, 0.5 * ones), "offset": (dims, 7 * ones), "bad": (dims, bad)},
        coords={"band": list(LEVELS)},
    )
    corrected = recording.bench_series(recorded[0], "plate", region, correction)["plate"]
    np.testing.assert_allclose(corrected["counts"], 0.5 * (seen - 0.5) + 7, rtol=0, atol=1e-2)
    with pytest.raises(ValueError, match="No frame or no pixel of band '8-14'"):
        recording.bench_series(recorded[0], "plate", {"plate": (slice(9, 9), slice(0, 2))})
    with pytest.raises(ValueError, match="No reading of 'wall' in the recording"):
        recording.bench_series(recorded[0], "plate", {"wall": (slice(0, 2), slice(0, 2))})


def test_what_is_missing_is_named(recorded: tuple[Path, list[Summary]], tmp_path: Path) -> None:
    """Missing sweeps, frames, readings and recordings each raise an error that names them."""
    folder, _ = recorded
    with pytest.raises(FileNotFoundError, match="No recording of a sweep 'dish'"):
        recording.open_sweep(folder, "dish", frames=8)
    with pytest.raises(ValueError, match=r"plate_00_9\.5\.zarr' with .* Must have 900\."):
        recording.open_sweep(folder, "plate", frames=900)
    (tmp_path / "plate_00_9.5.zarr").symlink_to(folder / "plate_00_9.5.zarr")
    with pytest.raises(ValueError, match=r"Missing recording '.*plate_00_11\.zarr' of the sweep"):
        recording.open_sweep(tmp_path, "plate", frames=8)


def test_recordings_of_a_step_must_agree(
    recorded: tuple[Path, list[Summary]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A blackbody that drifted between two filters has no one temperature."""
    values = iter([300.0, 300.2])
    monkeypatch.setattr(_reader, "mean_reading", lambda *_: next(values))
    with pytest.raises(ValueError, match=r"Invalid readings \[300\.0, 300\.2\] K of 'blackbody'"):
        recording.open_sweep(recorded[0], "plate", frames=8)


def test_interrupted_sweep_goes_on(tmp_path: Path) -> None:
    """A resumed sweep keeps complete recordings, names an incomplete one, and records the rest."""
    log: list[float] = []

    def interrupt(_: Preview) -> None:
        if len(log) > 1:
            raise KeyboardInterrupt

    with rig(from_yaml(TWO)) as devices:
        devices.prepare()
        with pytest.raises(KeyboardInterrupt):
            swept(devices, tmp_path, log, preview=interrupt)
        cut = tmp_path / "plate_01_9.5.zarr"
        with pytest.raises(ValueError, match=r"Incomplete recording '.*plate_01_9\.5\.zarr'"):
            swept(devices, tmp_path, log)
        cut.rename(tmp_path / "cut.zarr")
        was = {path: path.stat().st_mtime_ns for path in tmp_path.glob("plate_00_*/zarr.json")}
        assert len(was) == 2
        log.clear()
        steps = swept(devices, tmp_path, log)
        assert log == [290.0]
        assert {path: path.stat().st_mtime_ns for path in was} == was
        assert (len(steps), steps[0].ended) == (4, "duration")
        assert steps[0].totals["8-14"]["frames"] > 8
        assert swept(devices, tmp_path, log) == steps
        # Offsets are corrected before the sweep, and at each temperature that is recorded.
        assert devices.world is not None
        assert {camera.ffc_count for camera in devices.world.cameras.values()} == {4}
    other = from_yaml(replaced(("[300.0, 290.0, 310.0]", "[301.0, 290.0]")))
    with rig(other) as devices, pytest.raises(ValueError, match=r"Must be of 301\.0 K"):
        swept(devices, tmp_path)


def test_wheel_that_turns_away_is_told(tmp_path: Path) -> None:
    """A wheel that turns during a recording raises an error, then and when the sweep is opened."""
    with rig(from_yaml(ONE)) as devices:
        devices.prepare()
        wheel = devices.wheel
        assert wheel is not None

        def turn(_: Preview) -> None:
            wheel.move_to(2)

        for _ in range(2):
            with pytest.raises(ValueError, match=r"Invalid slots .* of filter '9\.5' throughout"):
                swept(devices, tmp_path, preview=turn)


def test_lost_camera_ends_the_sweep(tmp_path: Path) -> None:
    """An unplugged camera ends the sweep with an incomplete recording."""
    with rig(from_yaml(ONE)) as devices:
        devices.prepare()
        assert devices.world is not None
        world, form = devices.world, (devices.session.shape, 100.0, 2)
        faulty = FaultyCamera(
            world, "8-14", pictures(world), "8-14", *form, faults=Faults(unplugged=3)
        )
        devices = replace(devices, sources={**devices.sources, "8-14": faulty})  # noqa: PLW2901
        with pytest.raises(SourceLostError, match=r"plate_00_9\.5\.zarr' ended: source lost"):
            swept(devices, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["plate_00_9.5.zarr"]


def test_blackbody_must_be_read(tmp_path: Path) -> None:
    """A sweep without a reading of the blackbody raises an error before it begins."""
    with pytest.raises(ValueError, match="Must have one named 'blackbody'"):
        from_yaml(replaced(("{1: blackbody, 4: plate}", "{4: plate}")))
    with rig(from_yaml(TEXT)) as devices:
        silent = replace(devices, thermocouples=None)
        with pytest.raises(ValueError, match="Must have and read a blackbody"):
            swept(silent, tmp_path)


def test_sweep_without_a_wheel(tmp_path: Path) -> None:
    """Two cameras of fixed bands have one recording at each temperature."""
    lines = [line for line in ONE.splitlines() if "filter" not in line and "wheel" not in line]
    text = "\n".join(line for line in lines if not line.startswith("sweep"))
    session = from_yaml(text)
    with rig(session) as devices:
        devices.prepare()
        steps = swept(devices, tmp_path)
    assert [step.path.name for step in steps] == ["plate_00.zarr"]
    movies = recording.open_sweep(tmp_path, "plate", frames=8)
    np.testing.assert_array_equal(movies["counts"][:, 0, 0, 0, 0], [4000, 23_000])


def test_scene_begins_with_its_recording(tmp_path: Path) -> None:
    """Everything is recorded beside the frames, whose scene began just before the first of them."""
    session = from_yaml(scene_text())
    world = bench(session, waits=True)
    with rig(session, world) as devices:
        with pytest.raises(RuntimeError, match="Must be homed"):
            protocols.record_scene(devices, tmp_path / "a.zarr")
        devices.prepare()
        assert world.scene_began == np.inf
        summary = protocols.record_scene(devices, tmp_path / "a.zarr", limits=QUICK)
        assert devices.wheel is not None
        devices.wheel.select("11")
        with pytest.raises(ValueError, match=r"Must be '9\.5': prepare the devices"):
            protocols.record_scene(devices, tmp_path / "b.zarr")
    capture = open_capture(summary.path)
    assert 0 <= capture.attrs["clock_origin"] - world.scene_began < 1
    assert float(capture["exposure_time"].min()) >= 0
    assert capture.attrs["identities"]["9.5"]["serial_number"] == "93589"
    assert {"plate", "blackbody", "fpa 9.5"} <= {note[2] for note in notes(summary.path)}


def wait(readings: list[float], clock: EmulatedClock) -> float:
    """Wait for 300 K with these readings, one a second; the last one stays."""
    values = iter(readings)
    return protocols.wait_stable(
        from_yaml(TEXT),
        300.0,
        lambda: next(values, readings[-1]),
        clock=clock,
    )


def test_rest_is_waited_for() -> None:
    """A window of readings near the set point and near one another ends the wait with its mean."""
    clock = EmulatedClock()
    found = wait([299.0, 299.5, 300.02, 300.0, 300.04, 300.02], clock)
    assert found == pytest.approx(300.02)
    assert clock() == 5.0


def test_thermocouple_may_be_off() -> None:
    """A stable reading half a kelvin off the set point counts as reached."""
    clock = EmulatedClock()
    assert wait([300.6], clock) == pytest.approx(300.6)
    assert clock() == 3.0


@pytest.mark.parametrize("readings", [[301.6], [300.0, 300.3] * 20])
def test_no_rest_is_an_error(readings: list[float]) -> None:
    """A temperature that settles elsewhere or oscillates raises an error."""
    with pytest.raises(TimeoutError, match=r"No rest at 300\.0 K within 20 s"):
        wait(readings, EmulatedClock())


def test_blackbody_takes_its_time() -> None:
    """The emulated blackbody is waited for until it is near, and no longer."""
    clock = EmulatedClock()
    start = clock()
    found = protocols.wait_stable(
        from_yaml(TEXT),
        300.0,
        lambda: 300.0 - 10.0 * math.exp((start - clock()) / 2.0),
        clock=clock,
    )
    assert clock() == 12.0  # from 9 s on four readings differ by less than 0.1 K
    assert found == pytest.approx(300 - 10 * np.exp(-np.arange(9, 13) / 2).mean(), abs=1e-9)


def test_a_short_recording_is_named(tmp_path: Path) -> None:
    """A recording that is short in a band, or was cut, is named with good and promised frames."""
    session = from_yaml(replaced(("duration: 0.15", "duration: 0.5"), text=scene_text()))
    for name, frames in (("whole", None), ("short", 29)):
        with rig(session) as devices:
            devices.prepare()
            camera = devices.sources["9.5"]
            if frames is not None:
                faults = Faults(corrupt=frozenset(range(frames, 10_000)))
                world = devices.world
                assert world is not None
                camera = FaultyCamera(
                    world, "9.5", pictures(world), None, SHAPE, 100.0, 2, faults=faults
                )
            sources = {**devices.sources, "9.5": camera}
            path = tmp_path / name / f"{name}.zarr"
            protocols.record_scene(replace(devices, sources=sources), path, limits=QUICK)
    recording.require_whole(tmp_path / "whole")
    told = r"short': 'short', band '9\.5': \d+ good frames of 50 promised\. Must have 95%"
    with pytest.raises(ValueError, match=told):
        recording.require_whole(tmp_path / "short")
