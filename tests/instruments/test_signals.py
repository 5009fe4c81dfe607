"""SIGTERM, SIGHUP and a closed terminal end a recording whole; its command has their status."""

import os
import pty
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from file_operations import before_operation, operations_of
from rig_session import LIMIT, replaced, scene_text
from test_capture_file import CaptureFile
from test_record import SMALL, bench, interrupt, session, written

from dbthermal import store
from dbthermal.instruments.recording import Preview, SignalExit, raised_signals, record

ENDING = (signal.SIGTERM, signal.SIGHUP)
SCENE = scene_text().replace('3: "11"', "3: 10.6")


@pytest.fixture(autouse=True)
def as_in_a_script() -> Iterator[None]:
    """Undo what nohup and the session of the tests do: the signals end the program."""
    before = {number: signal.signal(number, signal.SIG_DFL) for number in ENDING}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@contextmanager
def acquiring(
    folder: Path, duration: float, *, before: str = "pass", output: int = subprocess.DEVNULL
) -> Iterator[subprocess.Popen[bytes]]:
    """Run the command in a process of its own, once it writes frames."""
    text = replaced(("duration: 0.15", f"duration: {duration}"), text=SCENE)
    (folder / "a.yaml").write_text(text, encoding="utf-8")
    code = f"import sys; {before}; from dbthermal.__main__ import main; sys.exit(main())"
    command = [sys.executable, "-c", code, "record", str(folder / "a.yaml"), str(folder)]
    process = subprocess.Popen(
        [*command, "--simulate"], stdout=output, stderr=output, start_new_session=True
    )
    try:
        until = time.monotonic() + LIMIT
        while not written(folder / "plate.zarr") and time.monotonic() < until:
            assert process.poll() in {None, 0}
            time.sleep(0.05)
        yield process
    finally:
        process.kill()
        process.wait()


def test_the_command_ends_as_by_the_keyboard(tmp_path: Path) -> None:
    """Told to end by two signals, the command closes its recording with the reason of the end."""
    with acquiring(tmp_path, 600.0) as process:
        for number in (signal.SIGSTOP, *ENDING, signal.SIGCONT):  # they come at once
            process.send_signal(number)
        status = process.wait(LIMIT)
    opened = store.open_dataset(tmp_path / "plate.zarr")
    assert (opened.attrs["closed"], opened.attrs["complete"]) == (True, False)
    assert status in {128 + number for number in ENDING}
    assert opened.attrs["ended"] == signal.Signals(status - 128).name
    assert opened.sizes["time"] == max(opened.attrs["frames_written"].values()) > 0


def test_a_closed_terminal_keeps_the_recording(tmp_path: Path) -> None:
    """A terminal that is closed ends the command, and the recording is closed and whole."""
    ours, theirs = pty.openpty()
    control = "import fcntl, termios; fcntl.ioctl(1, termios.TIOCSCTTY, 0)"
    with acquiring(tmp_path, 600.0, before=control, output=theirs) as process:
        os.close(theirs)
        os.close(ours)
        assert process.wait(LIMIT) == 128 + signal.SIGHUP
    opened = store.open_dataset(tmp_path / "plate.zarr")
    assert (opened.attrs["closed"], opened.attrs["ended"]) == (True, "SIGHUP")


def test_a_closed_pipe_ends_nothing(tmp_path: Path) -> None:
    """If nobody reads what the command prints, the recording goes on to its end."""
    ours, theirs = os.pipe()
    with acquiring(tmp_path, 5.0, output=theirs) as process:
        os.close(theirs)
        os.close(ours)
        assert process.wait(LIMIT) == 0
    assert store.open_dataset(tmp_path / "plate.zarr").attrs["ended"] == "duration"


@pytest.mark.parametrize("number", ENDING)
def test_a_script_ends_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    """Called by a script, a recording is closed, whatever comes meanwhile, and the script ends."""
    before, sources, close = [*map(signal.getsignal, ENDING)], bench(), CaptureFile.close

    def hit(file: CaptureFile, *, complete: bool, ended: str) -> None:
        for another in (*ENDING, *ENDING):
            interrupt(number=another)
            sources["9.5"].clock.sleep(1.0)  # which lets the main thread look
        close(file, complete=complete, ended=ended)

    def end(_: Preview) -> None:
        signal.raise_signal(number)

    monkeypatch.setattr(CaptureFile, "close", hit)
    with pytest.raises(SignalExit) as raised:
        record(session(60.0), sources, tmp_path / "a.zarr", limits=SMALL, preview=end)
    assert raised.value.code == 128 + number
    assert [*map(signal.getsignal, ENDING)] == before
    attrs = store.open_dataset(tmp_path / "a.zarr").attrs
    assert (attrs["closed"], attrs["ended"]) == (True, number.name)


def test_what_the_program_handles_is_left_alone() -> None:
    """A signal that is ignored, as under nohup, or handled, is not raised; nor in a thread."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with raised_signals():
        signal.raise_signal(signal.SIGHUP)
    results = []

    def look() -> None:
        with raised_signals():
            results.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=look)
    thread.start()
    thread.join()
    assert results == [signal.SIG_DFL]


@pytest.mark.parametrize("every", [250, pytest.param(40, marks=pytest.mark.slow)])
def test_signals_at_any_moment(tmp_path: Path, every: int) -> None:
    """Told to end before any file operation, a recording is closed with all its frames."""

    def run(path: Path) -> None:
        record(session(0.15), bench(), path, limits=SMALL)

    operations = operations_of(lambda: run(tmp_path / "first.zarr"))
    for moment in [*range(1, 60, 7), *range(60, operations, every)]:  # first the empty store
        path, number, ended = tmp_path / f"{moment}.zarr", ENDING[moment % 2], "duration"
        with before_operation(moment, partial(interrupt, number=number)):
            try:
                run(path)
            except SignalExit as end:
                ended = end.name
        if not path.exists():  # it came before there was one
            assert ended == number.name
            continue
        opened = store.open_dataset(path)
        frames = list(opened.attrs["frames_written"].values())
        assert opened.attrs["closed"] or not any(frames)
        assert opened.attrs.get("ended", ended) in {ended, "duration"}
        for place, count in enumerate(frames):
            np.testing.assert_array_equal(np.diff(opened["sequence"][place, :count]), 1)
    assert all(".zarr-" in file.name for file in tmp_path.glob(".*"))  # hidden, and of no store
