"""The thread of a recording that writes: nobody who looks on, or interrupts, can disturb it.

What a notebook's user does comes to the main thread: a preview that is drawn slowly, or raises, an
interrupt by the keyboard, twice maybe. None of them stops a chunk half-way, for the chunks are
written here, and the frames that came before are written, too, before this thread ends.
"""

import errno
import queue
import shutil
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from dbthermal.instruments.camera import Frame, FrameFlag
from dbthermal.instruments.recording.contents import Note
from dbthermal.instruments.recording.fetching import Run
from dbthermal.instruments.recording.tape import Tape

_POLL: Final = 0.05  # how long the writer waits before it looks whether all is over [s]
_HELD: Final = 2.0  # how long after the start a frame may still come that a driver held [s]


@dataclass
class Written:
    """
    What is on the tape, for those who look on.

    Attributes
    ----------
    start : float
        Host's clock at the start [s].
    frames : dict
        Band to its last frame.
    totals : mapping
        Band to numbers of frames, see `dbthermal.instruments.recording.tape.Tape.totals`.
    readings : dict
        Name to the last value of each reading, NaN if it failed.
    interrupted : bool
        To be set before `Run.over` where neither time nor a wish ended the recording.
    ended : str
        Why it ended, once it did.
    done : Event
        Set when nothing more is written.
    """

    start: float
    frames: dict[str, Frame] = field(default_factory=dict)
    totals: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    readings: dict[str, float] = field(default_factory=dict)
    interrupted: bool = False
    ended: str = ""
    done: threading.Event = field(default_factory=threading.Event)


def write(
    run: Run,
    tape: Tape,
    written: Written,
    fetching: Sequence[threading.Thread],
    asking: threading.Thread,
) -> None:
    """
    Start the threads, write what they bring until all is over, and close the recording.

    Errors go to `Run.errors`. After one of writing itself the recording is left as it is on the
    disk, for nothing more can be written.

    Parameters
    ----------
    run : Run
        What the threads share.
    tape : Tape
        Where it goes.
    written : Written
        What those who look on see.
    fetching : sequence of Thread
        One for each source.
    asking : Thread
        Of all other instruments.
    """
    try:
        for thread in (*fetching, asking):
            thread.start()
        _write(run, tape, written, fetching)
    except BaseException as error:  # noqa: BLE001 - raised again in the caller's thread
        run.errors.append(error)
    run.over.set()
    _join(run, (*fetching, asking))
    try:
        if not tape.broken:
            _drain(run, tape, written)
            written.ended = _reason(run, written)
            complete = written.ended in {"duration", "stopped"}
            tape.close(complete=complete, ended=written.ended)
    except BaseException as error:  # noqa: BLE001 - as above
        run.errors.append(error)
    finally:
        written.totals = tape.totals
        written.done.set()


def free(path: Path) -> int:
    """
    Space that is free.

    Parameters
    ----------
    path : Path
        A folder.

    Returns
    -------
    int
        On its file system [byte].
    """
    return shutil.disk_usage(path).free


def _write(run: Run, tape: Tape, written: Written, fetching: Sequence[threading.Thread]) -> None:
    number = 0
    while run.going() and any(thread.is_alive() for thread in fetching):
        _take_notes(run, tape, written)
        try:
            item = run.frames.get(timeout=_POLL)
        except queue.Empty:
            continue
        _take(tape, written, *item)
        run.room[item[0]].release()
        number += 1
        if number % run.limits.chunk == 0:
            _check_space(tape.recording.path, run.limits.reserve)


def _take(tape: Tape, written: Written, band: str, frame: Frame, refused: int) -> None:
    """Take a frame, unless it is one that the driver held from before the start."""
    own_clock = FrameFlag.FOREIGN_CLOCK in frame.flags  # which cannot say
    early = frame.device_time < written.start and frame.host_time < written.start + _HELD
    if band not in written.frames and early and not own_clock:
        return
    flags = tape.frame(band, frame, refused)
    written.frames[band] = replace(frame, flags=flags)
    written.totals = tape.totals


def _take_notes(run: Run, tape: Tape, written: Written) -> None:
    while not run.notes.empty():
        note: Any = run.notes.get_nowait()
        tape.note(*note)
        if note[0] in {Note.READING, Note.READING_FAILED}:
            written.readings[note[1]] = note[3]


def _drain(run: Run, tape: Tape, written: Written) -> None:
    """Write what is still in the queues, when the threads are done."""
    while not run.frames.empty():
        _take(tape, written, *run.frames.get_nowait())
    _take_notes(run, tape, written)
    for band, number in run.refused.items():
        tape.refused(band, number, run.clock())


def _reason(run: Run, written: Written) -> str:
    """Tell why it ended."""
    if run.errors:
        return "no space" if getattr(run.errors[0], "errno", 0) == errno.ENOSPC else "error"
    if written.interrupted:
        return "interrupted"
    if run.lost:
        return "source lost"
    if len(written.frames) < len(run.room):
        return "no frames"
    return "stopped" if run.stop.is_set() else "duration"


def _join(run: Run, threads: Sequence[threading.Thread]) -> None:
    """Wait for the threads; one that hangs in its device must not keep what was recorded."""
    for thread in (thread for thread in threads if thread.ident is not None):
        thread.join(run.limits.patience)
        if thread.is_alive():
            run.errors.append(
                TimeoutError(
                    f"No answer of the device of '{thread.name}' within {run.limits.patience} s "
                    "after the end. Must keep its time limits."
                )
            )


def _check_space(path: Path, reserve: int) -> None:
    left = free(path)
    if left < reserve:
        message = f"Too little space: {left} bytes are free. Must be {reserve}"
        raise OSError(errno.ENOSPC, message, str(path))
