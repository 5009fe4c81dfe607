"""Whoever looks on, or interrupts, a recording is written to its end."""

import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from test_record import BANDS, CHUNK, SMALL, bench, session

from dbthermal import store
from dbthermal.instruments import record, tape
from dbthermal.instruments.capture import notes, open_capture
from dbthermal.instruments.emulated.frames import EmulatedCamera
from dbthermal.instruments.fetching import Limits
from dbthermal.instruments.frames_source import Frame, FrameFlag
from dbthermal.instruments.record import Preview


def slow_down(monkeypatch: pytest.MonkeyPatch) -> None:
    """Writing a frame takes 0.03 s, three times as long as to take one."""
    frame = tape.Tape.frame

    def slow(own: tape.Tape, band: str, shot: Frame, refused: int = 0) -> None:
        time.sleep(0.03)
        frame(own, band, shot, refused)

    monkeypatch.setattr(tape.Tape, "frame", slow)


def test_slow_disk_refuses_frames_and_counts_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every frame of a queue that overflows is either there or counted as refused or lost."""
    limits, path = Limits(chunk=CHUNK, reserve=0, queue=2), tmp_path / "a.zarr"
    slow_down(monkeypatch)
    summary = record.record(session(0.5), bench(), path, limits=limits)
    opened = open_capture(path)
    for place, band in enumerate(BANDS):
        total = summary.totals[band]
        assert total["refused"] > 5
        last = int(opened["sequence"][place].max())
        noted = [n[3] for n in notes(path) if n[1:3] == ("frames_refused", band)]
        assert sum(noted) == total["refused"]
        behind = sum(total.values()) - 1 - last
        assert 0 <= behind <= noted[-1]
        flags = np.bitwise_or.reduce(opened["frame_flags"][place].values)
        assert FrameFlag.FRAMES_LOST_BEFORE & int(flags)


def written(path: Path) -> int:
    """Frames of all bands that a recording says it has."""
    return int(sum(store.open_dataset(path).attrs["frames_written"].values()))


def test_writing_does_not_wait_for_the_preview(tmp_path: Path) -> None:
    """While something is drawn, frames are written."""
    path, seen = tmp_path / "a.zarr", []

    def draw(_: Preview) -> None:
        until = time.monotonic() + 20
        while not (chunks := written(path) // CHUNK) and time.monotonic() < until:
            time.sleep(0.01)
        seen.append(chunks)

    record.record(session(1.0), bench(), path, limits=SMALL, preview=draw)
    assert seen[0] >= 1


def test_keyboard_interrupt_keeps_everything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Interrupted while the disk is slow, all frames that came are written, and it says so."""
    slow_down(monkeypatch)
    came: list[int] = []
    read = EmulatedCamera.read

    def counting(camera: EmulatedCamera, timeout: float = 1.0) -> Frame:
        frame = read(camera, timeout)
        came.append(frame.sequence)
        return frame

    monkeypatch.setattr(EmulatedCamera, "read", counting)
    main = threading.main_thread().ident
    assert main is not None
    limits, path = Limits(chunk=CHUNK, reserve=0, preview_period=0.3), tmp_path / "a.zarr"
    with pytest.raises(KeyboardInterrupt):
        record.record(
            session(60.0),
            bench(),
            path,
            limits=limits,
            preview=lambda _: signal.pthread_kill(main, signal.SIGINT),
        )
    opened = store.open_dataset(path)
    assert (opened.attrs["closed"], opened.attrs["ended"]) == (True, "interrupted")
    assert written(path) == len(came)
    found = opened["sequence"].values
    assert sorted(found[found >= 0]) == sorted(came)
