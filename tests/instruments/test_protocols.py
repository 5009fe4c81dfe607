"""The rig waits for the blackbody, sweeps it through all filters, and what it recorded opens."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from faulty_camera import Faults, FaultyCamera
from rig_session import LEVELS, QUICK, SHAPE, bench, from_yaml, pictures, replaced, rig, scene_text

from dbthermal import store
from dbthermal.instruments import protocols, recording
from dbthermal.instruments.camera import SourceLostError
from dbthermal.instruments.devices import Devices
from dbthermal.instruments.recording import Preview, Summary, notes, open_capture
from dbthermal.instruments.transport import EmulatedClock

QUICKLY = ("window: 3", "window: 0.02")
ONE = replaced(("[300.0, 290.0, 310.0]", "[300.0]"), QUICKLY)
TWO = replaced(("[300.0, 290.0, 310.0]", "[300.0, 290.0], accuracy: 0.05"), QUICKLY)


def faulty(devices: Devices, band: str, faults: Faults) -> Devices:
    """The devices with a camera that has faults."""
    world, form = devices.world, (None, SHAPE, 100.0, 2)
    camera = FaultyCamera(world, band, pictures(world), *form, faults=faults)
    return replace(devices, sources={**devices.sources, band: camera})


def swept(
    devices: Devices,
    folder: Path,
    log: list[float] | None = None,
    preview: Callable[[Preview], None] | None = None,
) -> list[Summary]:
    """Sweep a blackbody that is at once where it is set."""
    temperatures = [] if log is None else log

    def set_temperature(value: float) -> None:
        devices.world.blackbody_temperature = value
        temperatures.append(value)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(protocols, "STABILITY_PERIOD", 0.01)
        return protocols.record_sweep(
            devices, folder, set_temperature=set_temperature, limits=QUICK, preview=preview
        )


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Summary]]:
    """Record two temperatures through two filters."""
    folder = tmp_path_factory.mktemp("sweep")
    with rig(from_yaml(TWO), prepared=True) as devices:
        return folder, swept(devices, folder)


def test_sweep(recorded: tuple[Path, list[Summary]]) -> None:
    """Each temperature and filter is a recording; joined, bands have the counts of their filter."""
    folder, steps = recorded
    names = [f"plate_{number:02d}_{band}.zarr" for number in range(2) for band in ("9.5", "11")]
    assert [step.path.name for step in steps] == names
    assert sorted(path.name for path in folder.iterdir()) == sorted(names)
    movies = recording.open_sweep(folder, "plate", frames=8)
    assert movies.attrs["blackbody_accuracy"] == 0.05  # K, of the session; nothing else is stated
    assert "blackbody_emissivity" not in movies.attrs
    assert movies["counts"].shape == (3, 2, 8, *SHAPE)
    assert list(movies["band"].values) == ["8-14", "9.5", "11"]
    np.testing.assert_allclose(movies["temperature"], [290.0, 300.0], rtol=0, atol=1e-4)  # [K]
    level = xr.DataArray(list(LEVELS.values()), dims="band") + 10 * movies["temperature"].round(2)
    exact = level + xr.DataArray(np.arange(SHAPE[1]) % 2, dims="x")
    np.testing.assert_array_equal(movies["counts"] - exact, 0 * movies["counts"])
    assert movies.attrs["is_simulated"] is True
    # Devices, slot of the wheel and blackbody are in each recording, under its band's name.
    identities = store.open_dataset(folder / names[3]).attrs["identities"]
    assert set(identities) == {"8-14", "11", "filter_wheel", "thermocouples"}
    assert identities["11"]["part_number"] == "EMULATED-BOSON-640"
    result = {source: value for _, kind, source, value in notes(steps[3].path) if kind == "reading"}
    assert (result["filter_wheel"], result["ffc 11"]) == (3, 3)
    assert result["blackbody"] == pytest.approx(290.0, abs=1e-4)


def test_bench_series_are_means_over_regions(recorded: tuple[Path, list[Summary]]) -> None:
    """Counts are of region and good frames, corrected, and temperatures are those read."""
    region = {"plate": (slice(0, 2), slice(0, 10))}
    series = recording.bench_series(recorded[0], "plate", region)["plate"]
    means = np.array([3000.5, 2900.5]) + np.array(list(LEVELS.values()))[:, None]
    np.testing.assert_allclose(series["counts"], means, rtol=0, atol=1e-9)  # [count]
    np.testing.assert_allclose(series["object_temperature"], [330.0] * 2, rtol=0, atol=1e-4)
    np.testing.assert_allclose(series["background_temperature"], [300.0, 290.0], rtol=0, atol=1e-4)
    coords = {"band": list(LEVELS)}
    ones = xr.DataArray(np.ones((3, *SHAPE)), dims=("band", "y", "x"), coords=coords)
    bad = (xr.DataArray(np.arange(SHAPE[1]) % 2, dims="x") == ones).transpose("band", "y", "x")
    correction = xr.Dataset({"gain": 0.5 * ones, "offset": 7 * ones, "bad": bad})
    corrected = recording.bench_series(recorded[0], "plate", region, correction)["plate"]
    np.testing.assert_allclose(corrected["counts"], 0.5 * (means - 0.5) + 7, rtol=0, atol=1e-2)
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


def test_interrupted_sweep_goes_on(tmp_path: Path) -> None:
    """A resumed sweep keeps complete recordings, names an incomplete one, and records the rest."""
    log: list[float] = []

    def interrupt(_: Preview) -> None:
        if len(log) > 1:
            raise KeyboardInterrupt

    with rig(from_yaml(TWO), prepared=True) as devices:
        with pytest.raises(KeyboardInterrupt):
            swept(devices, tmp_path, log, preview=interrupt)
        cut = tmp_path / "plate_01_9.5.zarr"
        with pytest.raises(ValueError, match=r"Incomplete recording '.*plate_01_9\.5\.zarr'"):
            swept(devices, tmp_path, log)
        cut.rename(tmp_path / "cut.zarr")
        times = {path: path.stat().st_mtime_ns for path in tmp_path.glob("plate_00_*/zarr.json")}
        assert len(times) == 2
        log.clear()
        steps = swept(devices, tmp_path, log)
        assert log == [290.0]
        assert {path: path.stat().st_mtime_ns for path in times} == times
        assert (len(steps), steps[0].ended) == (4, "duration")
        assert steps[0].totals["8-14"]["frames"] > 8
        assert swept(devices, tmp_path, log) == steps
        # Offsets are corrected before the sweep, and at each temperature that is recorded.
        assert {camera.ffc_count for camera in devices.world.cameras.values()} == {4}
    new_plan = from_yaml(replaced(("[300.0, 290.0, 310.0]", "[301.0, 290.0]")))
    with rig(new_plan) as devices, pytest.raises(ValueError, match=r"Must be of 301\.0 K"):
        swept(devices, tmp_path)


def test_a_step_must_be_of_one_state(tmp_path: Path) -> None:
    """A wheel or a blackbody that moves during a step is an error, at once or on opening it."""
    with rig(from_yaml(ONE), prepared=True) as devices:
        wheel = devices.wheel
        assert wheel is not None
        for _ in range(2):
            with pytest.raises(ValueError, match=r"Invalid slots .* of filter '9\.5' throughout"):
                swept(devices, tmp_path / "wheel", preview=lambda _: wheel.move_to(2))
        lost = faulty(devices, "9.5", Faults(unplugged=3))

        def drift(_: Preview) -> None:
            if (tmp_path / "plate_00_11.zarr").exists():
                devices.world.blackbody_temperature = 300.5

        swept(devices, tmp_path, preview=drift)
        with pytest.raises(ValueError, match=r"Invalid readings \[300.*\] K of 'blackbody'"):
            recording.open_sweep(tmp_path, "plate", frames=8)
        with pytest.raises(SourceLostError, match=r"plate_00_9\.5\.zarr' ended: source lost"):
            swept(lost, tmp_path / "lost")
    assert [path.name for path in (tmp_path / "lost").iterdir()] == ["plate_00_9.5.zarr"]


def test_blackbody_must_be_read(tmp_path: Path) -> None:
    """A sweep without a reading of the blackbody raises an error before it begins."""
    with (
        rig(from_yaml()) as devices,
        pytest.raises(ValueError, match="Must have and read a blackbody"),
    ):
        swept(replace(devices, thermocouples=None), tmp_path)


def test_sweep_without_a_wheel(tmp_path: Path) -> None:
    """Two cameras of fixed bands have one recording at each temperature."""
    words = ("filter", "wheel", "sweep")
    lines = [line for line in ONE.splitlines() if not any(word in line for word in words)]
    with rig(from_yaml("\n".join(lines)), prepared=True) as devices:
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


def wait_for_rest(read: Callable[[float], float]) -> tuple[float, float]:
    """Mean that is found where 300 K are waited for, by a reading of the time, and the time."""
    clock = EmulatedClock()
    result = protocols.wait_stable(from_yaml(), 300.0, lambda: read(clock()), clock=clock)
    return result, clock()


@pytest.mark.parametrize(
    ("read", "mean", "time"),
    [
        # A window of readings near the set point and near one another ends the wait.
        (lambda t: [299.0, 299.5, 300.02, 300.0, 300.04, 300.02][round(t)], 300.02, 5.0),
        # A stable reading half a kelvin off the set point counts as reached.
        (lambda _: 300.6, 300.6, 3.0),
        # From 9 s on four readings of a blackbody that takes its time differ by less than 0.1 K.
        (
            lambda t: 300.0 - 10.0 * math.exp(-t / 2.0),
            300 - 10 * np.exp(-np.arange(9, 13) / 2).mean(),
            12.0,
        ),
    ],
)
def test_rest_is_waited_for(read: Callable[[float], float], mean: float, time: float) -> None:
    """The wait ends with the mean of a stable window; one elsewhere, or none, is an error."""
    assert wait_for_rest(read) == pytest.approx((mean, time), rel=0, abs=1e-9)
    for restless in (lambda _: 301.6, lambda t: 300.0 + 0.3 * (round(t) % 2)):
        with pytest.raises(TimeoutError, match=r"No rest at 300\.0 K within 20 s"):
            wait_for_rest(restless)


def test_a_short_recording_is_named(tmp_path: Path) -> None:
    """A recording that is short in a band, or was cut, is named with good and promised frames."""
    session = from_yaml(replaced(("duration: 0.15", "duration: 0.5"), text=scene_text()))
    for name, frames in (("whole", 10_000), ("short", 29)):
        with rig(session, prepared=True) as devices:
            short = faulty(devices, "9.5", Faults(corrupt=frozenset(range(frames, 10_000))))
            path = tmp_path / name / f"{name}.zarr"
            protocols.record_scene(short, path, limits=QUICK)
    recording.require_whole(tmp_path / "whole")
    message = r"short': 'short', band '9\.5': \d+ good frames of 50 promised\. Must have 95%"
    with pytest.raises(ValueError, match=message):
        recording.require_whole(tmp_path / "short")
