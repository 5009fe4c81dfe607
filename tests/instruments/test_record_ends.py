"""Ends of a recording: full queues, interrupts, lost cameras and failed threads."""

import signal
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from faulty_camera import BANDS, Faults, FaultyCamera
from test_capture_file import CaptureFile
from test_record import CHUNK, SMALL, bench, session
from test_signals import LIMIT, written

from dbthermal import store
from dbthermal.instruments.camera import Frame, FrameFlag
from dbthermal.instruments.clock import EmulatedClock
from dbthermal.instruments.emulated import World
from dbthermal.instruments.recording import Limits, Preview, notes, open_capture, record


@pytest.fixture(autouse=True)
def keyboard() -> Iterator[None]:
    """Let the keyboard interrupt: what a shell starts in the background ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def interrupt(_: Preview | None = None) -> None:
    """Interrupt the main thread as the keyboard does."""
    main = threading.main_thread().ident
    assert main is not None
    signal.pthread_kill(main, signal.SIGINT)


class HastyClock(EmulatedClock):
    """Emulated time in which no camera waits for the disk."""

    def has_room(self, room: threading.Semaphore) -> bool:
        """Take a place in a buffer; False if it is full."""
        return room.acquire(blocking=False)


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
    sources, path = bench(None, Faults(mute=True)), tmp_path / "a.zarr"
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


def test_a_thread_that_exits_ends_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A SystemExit in a camera's thread ends the recording with the state "error"."""

    def leave(*_: object) -> Frame:
        raise SystemExit("left")

    monkeypatch.setattr(FaultyCamera, "read", leave)
    with pytest.raises(SystemExit, match="left"):
        record(session(9.0), bench(), tmp_path / "a.zarr", limits=SMALL)
    assert store.open_dataset(tmp_path / "a.zarr").attrs["ended"] == "error"
