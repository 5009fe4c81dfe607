"""Record a session: the frames of all cameras and the readings beside them, to one store.

A thread for each camera fetches its frames, one more asks the other instruments, so that none waits
for another; what they bring goes through a queue of bounded length to the caller's thread, which
writes. If the disk is too slow the queue fills, frames are refused, and the recording says how many
and when. Whatever ends it, the frames that came are on the disk.
"""

import errno
import queue
import shutil
import threading
import time as system_time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from dbthermal import provenance
from dbthermal.instruments.fetching import Limits, Reading, Run, ask, fetch
from dbthermal.instruments.frames_source import Frame, FrameSource
from dbthermal.instruments.session import Session
from dbthermal.instruments.tape import Note, Tape

_POLL: Final = 0.05  # how long the writer waits before it looks whether all is over [s]
_BYTES: Final = 2  # of a pixel


def _free(path: Path) -> int:
    return shutil.disk_usage(path).free


@dataclass(frozen=True)
class Preview:
    """
    What there is to show while it is recorded.

    Attributes
    ----------
    time : float
        Since the start [s].
    frames : mapping
        Band to its last frame.
    totals : mapping
        Band to numbers of frames: ``frames``, ``lost``, ``refused``, ``damaged``.
    readings : mapping
        Name to the last value of each reading, NaN if it failed.
    """

    time: float
    frames: Mapping[str, Frame]
    totals: Mapping[str, Mapping[str, int]]
    readings: Mapping[str, float]


@dataclass(frozen=True)
class Summary:
    """
    How a recording went.

    Attributes
    ----------
    path : Path
        Where it is.
    ended : str
        Why it ended: ``"duration"``, ``"stopped"``, ``"source lost"``, which
        does not end it before the last source is lost.
    totals : mapping
        As in `Preview`.
    """

    path: Path
    ended: str
    totals: Mapping[str, Mapping[str, int]]


def record(
    session: Session,
    sources: Mapping[str, FrameSource],
    path: str | Path,
    *,
    readings: Mapping[str, Reading] | None = None,
    limits: Limits | None = None,
    preview: Callable[[Preview], None] | None = None,
    stop: threading.Event | None = None,
    clock: Callable[[], float] = system_time.monotonic,
) -> Summary:
    """
    Record until the session's duration is over, `stop` is set or no source is left.

    Parameters
    ----------
    session : Session
        What is recorded.
    sources : mapping
        Band to an open source, in the session's order; they stay open.
    path : str or Path
        Store to make, ``*.zarr``; see `dbthermal.instruments.capture.open_capture`.
    readings : mapping, optional
        Name to what else is asked: thermocouples, the cameras' temperatures, the blackbody.
    limits : Limits, optional
        How much is held, and how long is waited.
    preview : callable, optional
        Called now and then with a `Preview`; what time it takes, the queue must bridge.
    stop : Event, optional
        Ends the recording when set.
    clock : callable
        Host's monotonic clock [s], that of the sources' stamps.

    Returns
    -------
    Summary
        How it went; the same is in the store.

    Raises
    ------
    FileExistsError
        If there is something at `path`.
    OSError
        If there is too little space, before or on the way; what was recorded is kept.
    ValueError
        If the sources are not the session's, or are emulated where it says hardware, or vice versa.
    Exception
        What a source, a reading or the preview raised; what was recorded is kept.
    """
    limits, readings = limits or Limits(), readings or {}
    _check(session, sources)
    start = clock()
    tape = _tape(session, sources, Path(path), readings, start, limits)
    run = Run(limits, clock, clock() + session.duration, stop or threading.Event())
    run.room.update((band, threading.Semaphore(limits.queue)) for band in sources)
    threads = [
        *(
            threading.Thread(target=fetch, args=(run, *item), name=item[0], daemon=True)
            for item in sources.items()
        ),
        threading.Thread(target=ask, args=(run, readings), name="readings", daemon=True),
    ]
    ended = "interrupted"
    for thread in threads:
        thread.start()
    try:
        ended = _write(run, tape, threads[:-1], preview, start)
    except OSError as error:
        ended = "no space" if error.errno == errno.ENOSPC else "error"
        raise
    finally:
        run.over.set()
        _join(run, threads)
        if not tape.broken:
            _drain(run, tape)
            ended = "error" if run.errors else ended
            tape.close(complete=ended in {"duration", "stopped"}, ended=ended)
    if run.errors:
        raise run.errors[0]
    return Summary(Path(path), ended, tape.totals)


def _check(session: Session, sources: Mapping[str, FrameSource]) -> None:
    if tuple(sources) != session.bands:
        raise ValueError(
            f"Invalid sources {list(sources)}. Must be the bands {list(session.bands)}."
        )
    for band, source in sources.items():
        if source.is_simulated != session.simulated:
            raise ValueError(
                f"Invalid source of band '{band}': is_simulated is {source.is_simulated}. "
                f"Must be {session.simulated}, as the session says."
            )
        if source.shape != session.shape:
            raise ValueError(
                f"Invalid shape {source.shape} of band '{band}'. Must be {session.shape}."
            )


def _tape(
    session: Session,
    sources: Mapping[str, FrameSource],
    path: Path,
    readings: Mapping[str, Reading],
    start: float,
    limits: Limits,
) -> Tape:
    """Begin the store, if there is room for all of it, uncompressed."""
    folder = path.absolute().parent
    folder.mkdir(parents=True, exist_ok=True)
    rows, columns = session.shape
    frames = sum(session.duration * source.frame_rate for source in sources.values())
    needed = limits.reserve + int(_BYTES * rows * columns * frames)
    free = _free(folder)
    if free < needed:
        raise OSError(
            errno.ENOSPC, f"Too little space: {free} bytes are free. Must be {needed}", str(folder)
        )
    attrs = {
        "is_simulated": session.simulated,
        "identities": {band: dict(source.identity) for band, source in sources.items()},
        "frame_rates": {band: source.frame_rate for band, source in sources.items()},
        "started": datetime.now(UTC).isoformat(timespec="milliseconds"),
        "provenance": provenance.record(session.content()),
    }
    units = {name: reading.units for name, reading in readings.items()}
    return Tape(path, sources, readings=units, origin=start, attrs=attrs, chunk=limits.chunk)


def _write(
    run: Run,
    tape: Tape,
    fetching: list[threading.Thread],
    preview: Callable[[Preview], None] | None,
    start: float,
) -> str:
    """Write what comes until all is over; tell why."""
    last: dict[str, Frame] = {}
    values: dict[str, float] = {}
    written, shown = 0, -float("inf")
    while run.going() and any(thread.is_alive() for thread in fetching):
        _take_notes(run, tape, values)
        try:
            band, frame, refused = run.frames.get(timeout=_POLL)
        except queue.Empty:
            continue
        tape.frame(band, frame, refused)
        run.room[band].release()
        last[band] = frame
        written += 1
        if written % run.limits.chunk == 0:
            _check_space(tape.recording.path, run.limits.reserve)
        if preview and run.clock() - shown >= run.limits.preview_period:
            shown = run.clock()
            preview(Preview(shown - start, dict(last), tape.totals, dict(values)))
    if run.stop.is_set():
        return "stopped"
    return "source lost" if run.lost else "duration"


def _join(run: Run, threads: list[threading.Thread]) -> None:
    """Wait for the threads; one that hangs in its device must not keep what was recorded."""
    for thread in threads:
        thread.join(run.limits.patience)
        if thread.is_alive():
            run.errors.append(
                TimeoutError(
                    f"No answer of the device of '{thread.name}' within {run.limits.patience} s "
                    "after the end. Must keep its time limits."
                )
            )


def _check_space(path: Path, reserve: int) -> None:
    free = _free(path)
    if free < reserve:
        message = f"Too little space: {free} bytes are free. Must be {reserve}"
        raise OSError(errno.ENOSPC, message, str(path))


def _drain(run: Run, tape: Tape) -> None:
    """Write what is still in the queues, when the threads are done."""
    while not run.frames.empty():
        tape.frame(*run.frames.get_nowait())
    _take_notes(run, tape, {})
    for band, number in run.refused.items():
        tape.refused(band, number, run.clock())


def _take_notes(run: Run, tape: Tape, values: dict[str, float]) -> None:
    while not run.notes.empty():
        note: Any = run.notes.get_nowait()
        tape.note(*note)
        if note[0] in {Note.READING, Note.READING_FAILED}:
            values[note[1]] = note[3]
