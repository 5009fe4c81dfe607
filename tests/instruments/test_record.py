"""A recording keeps every frame, counts the lost ones, and survives faults and interrupts."""

import errno
import shutil
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import xarray as xr
from faulty_camera import Faults, FaultyCamera
from test_capture_file import CaptureFile

from dbthermal import alignment, correction, store
from dbthermal.instruments.camera import Counts, Frame, FrameFlag, FrameSource
from dbthermal.instruments.clock import Clock
from dbthermal.instruments.emulated.camera import EmulatedCamera
from dbthermal.instruments.emulated.clock import EmulatedClock
from dbthermal.instruments.emulated.world import World
from dbthermal.instruments.recording import (
    Limits,
    Preview,
    Reading,
    _recorder,
    notes,
    open_capture,
    record,
)
from dbthermal.instruments.session import Camera, Session

SHAPE, RATE, CHUNK = (16, 24), 100.0, 5
BANDS = ("8-14", "9.5")
SMALL = Limits(chunk=CHUNK, reserve=0, silence=0.1, reading_period=0.05, preview_period=0.0)
PATTERN = np.random.default_rng(1).integers(5000, 6000, SHAPE).astype(np.uint16)


def picture(time: float) -> Counts:
    """Counts that tell the time, in hundredths of a second, pixel by pixel."""
    return (PATTERN + round(RATE * time)).astype(np.uint16)


def session(duration: float = 0.3) -> Session:
    """Two emulated cameras with small frames."""
    cameras = {band: Camera(f"v4l2:///dev/video{place}") for place, band in enumerate(BANDS)}
    return Session("test", True, "scene", duration, cameras, RATE, SHAPE)


def bench(
    first: Faults | None = None,
    second: Faults | None = None,
    *,
    telemetry_rows: int = 0,
    clock: Clock | None = None,
) -> dict[str, FrameSource]:
    """Two cameras on one bench, with their faults."""
    world, sources = World(clock=clock), {}
    for number, (band, faults) in enumerate(zip(BANDS, (first, second), strict=True)):
        world.add_camera(band, 100 + number)
        sources[band] = FaultyCamera(
            world,
            band,
            dict.fromkeys(BANDS, picture),
            band,
            SHAPE,
            RATE,
            telemetry_rows,
            faults=faults or Faults(),
        )
    return dict(sources)


def short_file(path: Path) -> CaptureFile:
    """A capture file of one camera, which is handed frames by hand."""
    source = {BANDS[0]: bench()[BANDS[0]]}
    return CaptureFile(path, source, readings={"plate": "K"}, origin=0.0, attrs={}, chunk=CHUNK)


def shot(number: int, *, at: float | None = None, flags: int = 0) -> Frame:
    """A good frame of this number."""
    time = number / RATE if at is None else at
    return Frame(picture(number / RATE), time, time + 0.001, number, FrameFlag(flags))


def test_recording_is_a_capture(tmp_path: Path) -> None:
    """Each frame is what was to be seen when it was exposed, on one clock for both bands."""
    sources = bench()
    summary = record(session(), sources, tmp_path / "a.zarr", limits=SMALL)
    opened = open_capture(tmp_path / "a.zarr")
    steps = opened["exposure_time"].diff("time").values
    np.testing.assert_allclose(steps[np.isfinite(steps)], 1 / RATE, rtol=0, atol=1e-6)
    assert summary.ended == "duration"
    for band in BANDS:
        total = summary.totals[band]["frames"]
        one = opened.sel(band=band).isel(time=slice(0, total))
        np.testing.assert_array_equal(one["sequence"], np.arange(total))
        shown = (one["counts"].values - PATTERN)[:, 0, 0].astype(int)
        np.testing.assert_array_equal(np.diff(shown), 1)


def test_recording_says_what_made_it(tmp_path: Path) -> None:
    """Identities, the switch, the session and the versions are in the store."""
    record(session(), bench(telemetry_rows=12), tmp_path / "a.zarr", limits=SMALL)
    opened = open_capture(tmp_path / "a.zarr")
    assert opened.attrs["is_simulated"] is True
    assert opened.attrs["identities"]["9.5"]["model"] == "emulated Boson"
    assert opened.attrs["provenance"]["parameters"]["name"] == "test"
    assert (opened.attrs["complete"], opened.attrs["ended"]) == (True, "duration")
    np.testing.assert_allclose(opened["fpa_temperature"][0, 0], 308.2, rtol=0, atol=0.06)


def test_identities_beside_those_of_the_sources(tmp_path: Path) -> None:
    """Further identities of cameras and devices are added to those of the frame sources."""
    camera: dict[str, str | bool] = {"software_revision": "1.2.3", "is_simulated": True}
    known: dict[str, dict[str, str | bool]] = {"9.5": camera, "wheel": {"model": "a"}}
    path = tmp_path / "a.zarr"
    record(session(), bench(), path, identities=known, limits=SMALL)
    found = open_capture(path).attrs["identities"]
    assert found["9.5"] == {
        "device": "sim://boson/9.5",
        "model": "emulated Boson",
        "serial_number": "101",
        **camera,
    }
    assert (set(found), found["wheel"]) == ({*BANDS, "wheel"}, {"model": "a"})


def test_frames_from_before_are_not_taken(tmp_path: Path) -> None:
    """Frames that the driver held from before the start are discarded."""
    sources = bench()
    for source in sources.values():
        source.read()
    sources["9.5"].clock.sleep(0.05)
    summary = record(session(), sources, tmp_path / "a.zarr", limits=SMALL)
    opened = open_capture(tmp_path / "a.zarr")
    assert float(opened["exposure_time"].min()) >= 0
    assert int(opened["sequence"][:, 0].min()) > 4
    assert all(total["lost"] == 0 for total in summary.totals.values())


def test_duration_begins_with_the_first_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The duration counts from the first frame, however long the file takes to create."""
    clock, rate, made = EmulatedClock(), 60.0, _recorder._new_file
    world = World(clock=clock)
    world.add_camera("8-14", 1)
    source = EmulatedCamera(world, "8-14", {"8-14": picture}, "8-14", SHAPE, rate)
    source.read()  # from now on it holds frames

    def slowly(*parameters: Any) -> CaptureFile:
        clock.sleep(0.44)
        return made(*parameters)

    monkeypatch.setattr(_recorder, "_new_file", slowly)
    one = Session("test", True, "scene", 2.0, {"8-14": Camera("v4l2:///dev/video0")}, rate, SHAPE)
    limits = Limits(chunk=200, reserve=0, queue=200)
    summary = record(one, {"8-14": source}, tmp_path / "a.zarr", limits=limits)
    times = open_capture(tmp_path / "a.zarr")["exposure_time"][0]
    assert abs(summary.totals["8-14"]["frames"] - 2.0 * rate) <= 1
    assert 0 <= times[0] < 1 / rate
    assert abs(times[-1] - 2.0) <= 1 / rate
    assert store.open_dataset(tmp_path / "a.zarr").attrs["clock_origin"] == 0.44


@pytest.mark.parametrize("telemetry_rows", [0, 12])
def test_recording_goes_on_to_alignment(telemetry_rows: int, tmp_path: Path) -> None:
    """A recording with losses and a shutter event goes through correction and alignment.

    The camera reports the event by its telemetry, or without any by its frozen image.
    """
    first = Faults(dropped=frozenset({7, 8}), corrupt=frozenset({20}))
    second = Faults(ffc=frozenset({10}), offset_step=20.0)
    sources = bench(first, second, telemetry_rows=telemetry_rows)
    record(session(0.9), sources, tmp_path / "a.zarr", limits=SMALL)
    capture = open_capture(tmp_path / "a.zarr")
    ones = np.ones((2, *SHAPE))
    gain, offset, bad = (("band", "y", "x"), ones), (("band", "y", "x"), 0 * ones), ones > 1
    unity = xr.Dataset(
        {"gain": gain, "offset": offset, "bad": (("band", "y", "x"), bad)},
        coords={"band": list(BANDS)},
    )
    corrected = correction.correct_capture(capture, unity, bad_pixels=None)
    assert corrected.attrs["shutter_events"] == 1
    assert [number > 0 for number in corrected.attrs["shutter_closed_frames"]] == [False, True]
    aligned = alignment.align(corrected, offset=0.0)
    assert int(aligned["segment"].max()) == 1
    exact = aligned["counts"].sel(band="8-14").values - PATTERN
    level = exact - RATE * aligned["time"].values[:, None, None]
    np.testing.assert_allclose(
        level - np.nanmedian(level), np.where(np.isnan(level), np.nan, 0), atol=1.0
    )


@pytest.mark.parametrize(
    ("faults", "kind", "value"),
    [
        (Faults(dropped=frozenset({7, 8})), "frames_lost", 2),
        (Faults(corrupt=frozenset({7})), "damaged", FrameFlag.DRIVER_ERROR),
        (Faults(short=frozenset({7})), "damaged", FrameFlag.WRONG_SIZE),
        (Faults(ffc=frozenset({7})), "shutter_closed", 9),
    ],
)
def test_faults_are_noted(faults: Faults, kind: str, value: int, tmp_path: Path) -> None:
    """A fault is in the log for its own camera, and for no other."""
    record(session(), bench(None, faults), tmp_path / "a.zarr", limits=SMALL)
    found = [note[1:] for note in notes(tmp_path / "a.zarr")]
    assert found == [(kind, "9.5", value)]


def test_damaged_frames_are_kept_without_time(tmp_path: Path) -> None:
    """A corrupt frame is in the store, with its flag, and has no exposure time."""
    faults = Faults(corrupt=frozenset({7}))
    record(session(), bench(faults), tmp_path / "a.zarr", limits=SMALL)
    frame = open_capture(tmp_path / "a.zarr").isel(band=0, time=7)
    assert (int(frame["sequence"]), int(frame["frame_flags"])) == (7, FrameFlag.DRIVER_ERROR)
    assert np.isnan(frame["exposure_time"])
    assert np.isfinite(frame["device_time"])


def test_unplugged_camera_leaves_the_other(tmp_path: Path) -> None:
    """One camera is pulled out: the other is recorded to the end, and the store says it."""
    sources = bench(None, Faults(unplugged=12))
    summary = record(session(), sources, tmp_path / "a.zarr", limits=SMALL)
    assert (summary.ended, summary.totals["9.5"]["frames"]) == ("source lost", 12)
    assert summary.totals["8-14"]["frames"] > 20
    opened = open_capture(tmp_path / "a.zarr")
    assert opened.attrs["complete"] is False
    assert [note[1:3] for note in notes(tmp_path / "a.zarr")] == [("source_lost", "9.5")]
    padding = opened.isel(band=1, time=slice(12, None))
    assert np.isnan(padding["exposure_time"]).all()
    assert (padding["counts"] == opened["counts"][1, 11]).all()


def test_last_source_lost_ends_it(tmp_path: Path) -> None:
    """The loss of the last camera ends the recording."""
    gone = Faults(unplugged=6)
    sources = bench(gone, gone)
    summary = record(session(60.0), sources, tmp_path / "a.zarr", limits=SMALL)
    assert sources["9.5"].clock() < 1.0
    assert summary.ended == "source lost"


def test_clock_of_its_own_is_fitted(tmp_path: Path) -> None:
    """Stamps of a drifting clock are no exposure times until they are put on the host's."""
    sources = bench(None, Faults(clock_rate=1.05))
    record(session(0.6), sources, tmp_path / "a.zarr", limits=SMALL)
    with pytest.raises(ValueError, match=r"Invalid exposure times of band '9\.5': 0 stamps"):
        open_capture(tmp_path / "a.zarr")
    fitted = open_capture(tmp_path / "a.zarr", fitted=True)
    np.testing.assert_allclose(fitted.attrs["clock_rates"], [1, 1 / 1.05], rtol=0, atol=0.02)


def test_numbers_that_stand_are_flagged(tmp_path: Path) -> None:
    """A repeated sequence number or time is flagged, and a restart of the numbers is not lost."""
    short = short_file(tmp_path / "a.zarr")
    for frame in (shot(0), shot(1), shot(1), shot(2, at=0.005), shot(3), shot(0, at=0.04)):
        short.frame("8-14", frame)
    short.frame("8-14", shot(1, at=0.05))
    short.close(complete=True, ended="stopped")
    flags = open_capture(tmp_path / "a.zarr")["frame_flags"][0]
    again = FrameFlag.SEQUENCE_STANDS | FrameFlag.TIME_STANDS | FrameFlag.IMAGE_REPEATED
    expected = [0, 0, again, FrameFlag.TIME_STANDS, 0, FrameFlag.SEQUENCE_STANDS, 0]
    np.testing.assert_array_equal(flags, expected)
    assert [note[3] for note in notes(tmp_path / "a.zarr")] == [0, -3]


def test_readings_come_beside_the_frames(tmp_path: Path) -> None:
    """Readings are noted with their time; a failure is NaN, and the recording goes on."""
    answers = iter([300.0, 301.0])

    def read() -> float:
        value = next(answers, None)
        if value is None:
            raise TimeoutError("No answer.")
        return value

    readings = {"plate": Reading(read)}
    record(session(), bench(), tmp_path / "a.zarr", readings=readings, limits=SMALL)
    found = [note[1:] for note in notes(tmp_path / "a.zarr")]
    assert found[:2] == [("reading", "plate", 300.0), ("reading", "plate", 301.0)]
    assert {kind for kind, _, _ in found[2:]} == {"reading_failed"}


def test_errors_end_it_and_keep_what_came(tmp_path: Path) -> None:
    """An error in a reading or a preview is raised after the frames are stored."""
    sources = bench()

    def wrong() -> float:
        sources["9.5"].clock.sleep(0.1)
        raise KeyError("plate")

    with pytest.raises(KeyError, match="plate"):
        record(session(9.0), sources, tmp_path / "a.zarr", readings={"a": Reading(wrong)})

    def show(_: Preview) -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        record(session(9.0), bench(), tmp_path / "b.zarr", limits=SMALL, preview=show)
    for name, ended in (("a.zarr", "error"), ("b.zarr", "interrupted")):
        opened = store.open_dataset(tmp_path / name)
        assert (opened.attrs["complete"], opened.attrs["ended"]) == (False, ended)
        assert opened.sizes["time"] >= 1


def test_stopped_by_the_user(tmp_path: Path) -> None:
    """A recording that the user stops is complete."""
    stop = threading.Event()
    limits = Limits(chunk=CHUNK, reserve=0, preview_period=0.2)
    summary = record(
        session(60.0),
        bench(),
        tmp_path / "a.zarr",
        limits=limits,
        stop=stop,
        preview=lambda shown: stop.set() if shown.totals["9.5"]["frames"] > 7 else None,
    )
    assert summary.ended == "stopped"
    assert store.open_dataset(tmp_path / "a.zarr").attrs["complete"] is True


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    """An existing folder raises a FileExistsError and is not overwritten."""
    (tmp_path / "a.zarr").mkdir()
    with pytest.raises(FileExistsError, match="Must be a new recording"):
        record(session(), bench(), tmp_path / "a.zarr", limits=SMALL)


def test_wrong_sources_are_refused(tmp_path: Path) -> None:
    """Emulated frames in a session of hardware, and wrong bands, raise a ValueError."""
    hardware = Session("test", False, "scene", 1.0, session().cameras, RATE, SHAPE)
    with pytest.raises(ValueError, match=r"is_simulated is True\. Must be False, as the session"):
        record(hardware, bench(), tmp_path / "a.zarr")
    swapped = dict(reversed(bench().items()))
    with pytest.raises(ValueError, match=r"Invalid sources \['9\.5', '8-14'\]"):
        record(session(), swapped, tmp_path / "a.zarr")
    assert not (tmp_path / "a.zarr").exists()


def test_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Too little space is an error before it begins, and ends it on the way with all it has."""
    limits = Limits(chunk=CHUNK, reserve=1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=5000))
    with pytest.raises(OSError, match=r"Too little space: 5000 bytes are free\. Must be 47080"):
        record(session(), bench(), tmp_path / "a.zarr", limits=limits)
    answers = iter([10**9, 10**9, 999])
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=next(answers)))
    with pytest.raises(OSError, match="Too little space: 999 bytes") as raised:
        record(session(), bench(), tmp_path / "a.zarr", limits=limits)
    assert raised.value.errno == errno.ENOSPC
    opened = store.open_dataset(tmp_path / "a.zarr")
    assert (opened.attrs["ended"], opened.attrs["complete"]) == ("no space", False)
    assert opened.sizes["time"] >= CHUNK


def test_device_that_hangs(tmp_path: Path) -> None:
    """A device that never answers costs an error that names it, and no frame."""
    limits = Limits(chunk=CHUNK, reserve=0, patience=0.1)
    sources = bench()

    def hang() -> float:
        sources["9.5"].clock.sleep(20.0)
        return 0.0

    readings = {"plate": Reading(hang)}
    with pytest.raises(TimeoutError, match="No answer of the device of 'readings' within 0"):
        record(session(), sources, tmp_path / "a.zarr", readings=readings, limits=limits)
    assert store.open_dataset(tmp_path / "a.zarr").attrs["frames_written"]["9.5"] > 20


def test_no_frames_at_all(tmp_path: Path) -> None:
    """A recording without frames is closed and opens, but is not a valid capture."""
    gone = Faults(unplugged=0)
    record(session(), bench(gone, gone), tmp_path / "a.zarr", limits=SMALL)
    assert store.open_dataset(tmp_path / "a.zarr").sizes["time"] == 0
    with pytest.raises(ValueError, match="Empty 'counts' of the corrected"):
        open_capture(tmp_path / "a.zarr")
