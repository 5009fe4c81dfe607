"""A recording says what made it, survives faults, and ends whole; see `test_faults` for frames."""

import errno
import shutil
import signal
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import xarray as xr
from faulty_camera import BANDS, Faults, FaultyCamera, two_bands, two_cameras
from refused import assert_raises, assert_refused
from rig_session import LIMIT
from test_capture_file import CaptureFile

from dbthermal import alignment, correction, store
from dbthermal.instruments.camera import Counts, Frame, FrameFlag, FrameSource
from dbthermal.instruments.emulated import World
from dbthermal.instruments.recording import Limits, Preview, Reading, notes, open_capture, record
from dbthermal.instruments.session import Camera, Session
from dbthermal.instruments.transport import Clock, EmulatedClock

SHAPE, RATE, CHUNK = (16, 24), 100.0, 5
SMALL = Limits(chunk=CHUNK, reserve=0, silence=0.1, reading_period=0.05, preview_period=0.0)
PATTERN = np.random.default_rng(1).integers(5000, 6000, SHAPE).astype(np.uint16)
GONE = Faults(unplugged=6)


def picture(time: float) -> Counts:
    """Counts that tell the time, in hundredths of a second, pixel by pixel."""
    return (PATTERN + round(RATE * time)).astype(np.uint16)


def session(duration: float = 0.3) -> Session:
    """Two emulated cameras with small frames."""
    return two_bands(duration, SHAPE, RATE)


def bench(*faults: Faults, rows: int = 0, world: World | None = None) -> dict[str, FrameSource]:
    """Two cameras on one bench, with their faults."""
    by_band = dict(zip(BANDS, faults, strict=bool(faults)))
    return dict(two_cameras(picture, SHAPE, RATE, rows, faults=by_band, world=world))


def written(path: Path) -> int:
    """Frames of all bands that a recording says it has; 0 before it is begun."""
    try:
        return int(sum(store.open_dataset(path).attrs["frames_written"].values()))
    except FileNotFoundError:
        return 0


def test_recording_says_what_made_it(tmp_path: Path) -> None:
    """Identities, further ones beside them, the session and the versions are in the store."""
    camera: dict[str, str | bool] = {"software_revision": "1.2.3", "is_simulated": True}
    identities: dict[str, dict[str, str | bool]] = {"9.5": camera, "wheel": {"model": "a"}}
    path = tmp_path / "a.zarr"
    record(session(), bench(rows=12), path, identities=identities, limits=SMALL)
    opened = open_capture(path)
    assert opened.attrs["is_simulated"] is True
    assert opened.attrs["provenance"]["parameters"]["name"] == "test"
    assert (opened.attrs["complete"], opened.attrs["ended"]) == (True, "duration")
    np.testing.assert_allclose(opened["fpa_temperature"][0, 0], 308.2, rtol=0, atol=0.06)
    entries = opened.attrs["identities"]
    source = {"device": "sim://boson/9.5", "model": "emulated Boson", "serial_number": "101"}
    assert entries["9.5"] == {**source, **camera}
    assert (set(entries), entries["wheel"]) == ({*BANDS, "wheel"}, {"model": "a"})


def test_duration_begins_with_the_first_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames of before are not taken, nor lost; the first begins the duration, late as it is."""
    world, rate = World(), 60.0
    world.add_camera("8-14", 1)
    source = FaultyCamera(world, "8-14", {"8-14": picture}, "8-14", SHAPE, rate)
    source.read()  # from now on it holds frames
    delays, usage = iter([0.44]), shutil.disk_usage

    def slowly(folder: Path) -> object:
        world.clock.sleep(next(delays, 0.0))
        return usage(folder)

    monkeypatch.setattr(shutil, "disk_usage", slowly)
    plan = Session("test", True, "scene", 2.0, {"8-14": Camera("v4l2:///dev/video0")}, rate, SHAPE)
    limits = Limits(chunk=200, reserve=0, queue=200)
    summary = record(plan, {"8-14": source}, tmp_path / "a.zarr", limits=limits)
    opened = open_capture(tmp_path / "a.zarr")
    times = opened["exposure_time"][0]
    assert abs(summary.totals["8-14"]["frames"] - 2.0 * rate) <= 1
    assert summary.totals["8-14"]["lost"] == 0
    assert 0 <= times[0] < 1 / rate
    assert abs(times[-1] - 2.0) <= 1 / rate
    assert opened.attrs["clock_origin"] == 0.44


@pytest.mark.parametrize("rows", [0, 12])
def test_recording_goes_on_to_alignment(rows: int, tmp_path: Path) -> None:
    """Losses and a shutter event, from telemetry or images, go through correction and alignment."""
    first = Faults(dropped=frozenset({7, 8}), corrupt=frozenset({20}))
    second = Faults(ffc=frozenset({10}), offset_step=20.0)
    record(session(0.9), bench(first, second, rows=rows), tmp_path / "a.zarr", limits=SMALL)
    capture = open_capture(tmp_path / "a.zarr")
    ones = xr.DataArray(np.ones((2, *SHAPE)), dims=("band", "y", "x"), coords={"band": [*BANDS]})
    unity = xr.Dataset({"gain": ones, "offset": 0 * ones, "bad": ones > 1})
    corrected = correction.correct_capture(capture, unity, bad_pixels=None)
    assert corrected.attrs["shutter_events"] == 1
    assert [number > 0 for number in corrected.attrs["shutter_closed_frames"]] == [False, True]
    aligned = alignment.align(corrected, offset=0.0)
    assert int(aligned["segment"].max()) == 1
    exact = aligned["counts"].sel(band="8-14").values - PATTERN
    level = exact - RATE * aligned["time"].values[:, None, None]
    expected = np.where(np.isnan(level), np.nan, 0)
    np.testing.assert_allclose(level - np.nanmedian(level), expected, atol=1.0)


def test_last_source_lost_ends_it(tmp_path: Path) -> None:
    """The loss of the last camera ends it; without any frame it opens, but is no capture."""
    sources, path = bench(GONE, GONE), tmp_path / "a.zarr"
    assert record(session(60.0), sources, path, limits=SMALL).ended == "source lost"
    assert sources["9.5"].clock() < 1.0
    never = Faults(unplugged=0)
    record(session(), bench(never, never), tmp_path / "b.zarr", limits=SMALL)
    assert store.open_dataset(tmp_path / "b.zarr").sizes["time"] == 0
    assert_refused("Empty 'counts' of the corrected", open_capture, tmp_path / "b.zarr")


def test_errors_end_it_and_keep_what_came(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An error in a reading, a preview or a camera's thread is raised after frames are stored."""
    sources, names = bench(), [tmp_path / f"{name}.zarr" for name in "abc"]

    def wrong() -> float:
        sources["9.5"].clock.sleep(0.1)
        raise KeyError("plate")

    with pytest.raises(KeyError, match="plate"):
        record(session(9.0), sources, names[0], readings={"a": Reading(wrong)}, limits=SMALL)
    fail = Mock(side_effect=ZeroDivisionError)
    with pytest.raises(ZeroDivisionError):
        record(session(9.0), bench(), names[1], limits=SMALL, preview=fail)
    monkeypatch.setattr(FaultyCamera, "read", Mock(side_effect=SystemExit("left")))
    assert_raises(SystemExit, "left", record, session(9.0), bench(), names[2], limits=SMALL)
    cases = zip(names, ("error", "interrupted", "error"), (1, 1, 0), strict=True)
    for path, ended, frames in cases:
        opened = store.open_dataset(path)
        assert (opened.attrs["complete"], opened.attrs["ended"]) == (False, ended)
        assert opened.sizes["time"] >= frames


def test_what_is_refused(tmp_path: Path) -> None:
    """An existing folder, emulated frames in a session of hardware, and wrong bands are named."""
    path = tmp_path / "a.zarr"
    hardware = Session("test", False, "scene", 1.0, session().cameras, RATE, SHAPE)
    with pytest.raises(ValueError, match=r"is_simulated is True\. Must be False, as the session"):
        record(hardware, bench(), path)
    with pytest.raises(ValueError, match=r"Invalid sources \['9\.5', '8-14'\]"):
        record(session(), dict(reversed(bench().items())), path)
    assert not path.exists()
    path.mkdir()
    with pytest.raises(FileExistsError, match="Must be a new recording"):
        record(session(), bench(), path, limits=SMALL)


def test_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Too little space is an error before it begins, and ends it on the way with all it has."""
    limits, path = Limits(chunk=CHUNK, reserve=1000), tmp_path / "a.zarr"
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=5000))
    with pytest.raises(OSError, match=r"Too little space: 5000 bytes are free\. Must be 47080"):
        record(session(), bench(), path, limits=limits)
    answers = iter([10**9, 10**9, 999])
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=next(answers)))
    with pytest.raises(OSError, match="Too little space: 999 bytes") as raised:
        record(session(), bench(), path, limits=limits)
    assert raised.value.errno == errno.ENOSPC
    opened = store.open_dataset(path)
    assert (opened.attrs["ended"], opened.attrs["complete"]) == ("no space", False)
    assert opened.sizes["time"] >= CHUNK


def test_device_that_hangs(tmp_path: Path) -> None:
    """A device that never answers costs an error that names it, and no frame."""
    limits, path, sources = Limits(chunk=CHUNK, reserve=0, patience=0.1), tmp_path / "a", bench()

    def hang() -> float:
        sources["9.5"].clock.sleep(20.0)
        return 0.0

    readings = {"plate": Reading(hang)}
    with pytest.raises(TimeoutError, match="No answer of the device of 'readings' within 0"):
        record(session(), sources, path.with_suffix(".zarr"), readings=readings, limits=limits)
    opened = store.open_dataset(path.with_suffix(".zarr"))
    assert opened.attrs["frames_written"]["9.5"] > 20


@pytest.fixture(autouse=True)
def keyboard() -> Iterator[None]:
    """Let the keyboard interrupt: what a shell starts in the background ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def interrupt(_: Preview | None = None, number: signal.Signals = signal.SIGINT) -> None:
    """Interrupt the main thread as the keyboard does, or by another signal."""
    main = threading.main_thread().ident
    assert main is not None
    signal.pthread_kill(main, number)


class HastyClock(EmulatedClock):
    """Emulated time in which no camera waits for the disk."""

    has_room = Clock.has_room


def slow_disk(monkeypatch: pytest.MonkeyPatch, world: World) -> None:
    """Writing a frame takes 0.03 s, three times as long as to take one."""
    frame = CaptureFile.frame

    def slow(file: CaptureFile, band: str, shot: Frame, refused: int = 0) -> FrameFlag:
        world.clock.sleep(0.03)
        return frame(file, band, shot, refused)

    monkeypatch.setattr(CaptureFile, "frame", slow)


def test_slow_disk_refuses_frames_and_counts_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames of an overflowing queue are stored, or counted as refused or lost."""
    limits, path = Limits(chunk=CHUNK, reserve=0, queue=2), tmp_path / "a.zarr"
    slow_disk(monkeypatch, world := World(clock=HastyClock()))
    summary = record(session(0.5), bench(world=world), path, limits=limits)
    opened = open_capture(path)
    for place, band in enumerate(BANDS):
        total = summary.totals[band]
        assert total["refused"] > 5
        noted = [n[3] for n in notes(path) if n[1:3] == ("frames_refused", band)]
        assert sum(noted) == total["refused"]
        behind = sum(total.values()) - 1 - int(opened["sequence"][place].max())
        assert 0 <= behind <= noted[-1]
        flags = np.bitwise_or.reduce(opened["frame_flags"][place].values)
        assert FrameFlag.FRAMES_LOST_BEFORE & int(flags)


def test_writing_does_not_wait_for_the_preview(tmp_path: Path) -> None:
    """While something is drawn, frames are written."""
    path, progress, sources = tmp_path / "a.zarr", list[int](), bench()
    clock = sources["9.5"].clock

    def draw(_: Preview) -> None:
        while not (chunks := written(path) // CHUNK if not progress else 1) and clock() < 0.9:
            clock.sleep(0.1)
        progress.append(chunks)

    record(session(1.0), sources, path, limits=SMALL, preview=draw)
    assert progress[0] >= 1


@pytest.mark.parametrize("drawing", [True, False])
def test_keyboard_interrupt_keeps_everything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, drawing: bool
) -> None:
    """A keyboard interrupt keeps all frames, and the store is marked as interrupted."""
    slow_disk(monkeypatch, world := World())
    came, read = list[int](), FaultyCamera.read

    def counting(camera: FaultyCamera, timeout: float = 1.0) -> Frame:
        frame = read(camera, timeout)
        came.append(frame.sequence)
        if len(came) == 40 and not drawing:
            interrupt()
        return frame

    monkeypatch.setattr(FaultyCamera, "read", counting)
    limits, path = Limits(chunk=CHUNK, reserve=0, preview_period=0.3), tmp_path / "a.zarr"
    show = interrupt if drawing else None
    with pytest.raises(KeyboardInterrupt):
        record(session(60.0), bench(world=world), path, limits=limits, preview=show)
    opened = store.open_dataset(path)
    assert (opened.attrs["closed"], opened.attrs["ended"]) == (True, "interrupted")
    assert written(path) == len(came)
    numbers = opened["sequence"].values
    assert sorted(numbers[numbers >= 0]) == sorted(came)


def test_a_camera_that_gives_nothing_is_told(tmp_path: Path) -> None:
    """A camera without a frame makes the recording incomplete, and its silence is in the log."""
    sources, path = bench(world=(world := World())), tmp_path / "a.zarr"
    world.camera("9.5").phase = 1e9  # its first frame is far off
    summary = record(session(), sources, path, limits=SMALL)
    assert (summary.ended, summary.totals["9.5"]["frames"]) == ("no frames", 0)
    assert store.open_dataset(path).attrs["complete"] is False
    assert ("no_frame", "9.5", 0.1) in [note[1:] for note in notes(path)]


def test_wrong_stamps_cost_no_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A camera whose stamps are all of long ago is recorded, without times, once none is held."""
    read = FaultyCamera.read

    def stampless(camera: FaultyCamera, timeout: float = 1.0) -> Frame:
        frame = read(camera, timeout)
        return replace(frame, device_time=-1.0) if camera.name == "9.5" else frame

    monkeypatch.setattr(FaultyCamera, "read", stampless)
    summary = record(session(2.2), bench(), tmp_path / "a.zarr", limits=SMALL)
    frames = slice(0, summary.totals["9.5"]["frames"])
    band_data = store.open_dataset(tmp_path / "a.zarr").sel(band="9.5").isel(time=frames)
    assert band_data.sizes["time"] > 5
    assert (band_data["frame_flags"] & int(FrameFlag.TIME_WRONG)).all()
    assert np.isnan(band_data["exposure_time"]).all()


def test_second_interrupt_stops_no_writing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Interrupted again while it waits for the writer, it returns; the writer ends its work."""
    path, free, close = tmp_path / "a.zarr", threading.Event(), CaptureFile.close

    def interrupted_close(file: CaptureFile, *, complete: bool, ended: str) -> None:
        interrupt()
        assert free.wait(LIMIT)
        close(file, complete=complete, ended=ended)

    monkeypatch.setattr(CaptureFile, "close", interrupted_close)
    with pytest.raises(KeyboardInterrupt):
        record(session(60.0), bench(), path, limits=SMALL, preview=interrupt)
    assert store.open_dataset(path).attrs["closed"] is False
    free.set()
    (writer,) = (thread for thread in threading.enumerate() if thread.name == "writer")
    writer.join(LIMIT)
    assert store.open_dataset(path).attrs["ended"] == "interrupted"
