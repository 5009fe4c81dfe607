"""Record a session: the frames of all cameras and the readings beside them, to one store.

A thread for each camera fetches its frames, one more asks the other instruments, so that none waits
for another; what they bring goes through a queue of bounded length to the thread that writes (see
`recording.writing`). If the disk is too slow the queue fills, frames are refused, and
the recording says how many and when. The caller's thread shows the preview. Whatever ends it, also
an interrupt by the keyboard, the frames that came are on the disk.
"""

import errno
import threading
import time as system_time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from dbthermal import store
from dbthermal.instruments.camera import Frame, FrameSource
from dbthermal.instruments.recording import writing
from dbthermal.instruments.recording.fetching import Limits, Reading, Run, ask, fetch
from dbthermal.instruments.recording.tape import Tape
from dbthermal.instruments.recording.writing import Written
from dbthermal.instruments.session import Session

_POLL: Final = 0.01  # least wait of the one who looks on [s]
_BYTES: Final = 2  # of a pixel


@dataclass(frozen=True)
class Preview:
    """
    What there is to show while it is recorded.

    Attributes
    ----------
    time : float
        Since the start [s].
    frames : mapping
        Band to its last frame, the bands left out that had none.
    totals : mapping
        Band to numbers of frames: ``frames``, ``lost``, ``refused``, ``damaged``.
    readings : mapping
        Name to the last value of each reading, NaN if it failed.
    units : mapping
        Name to unit of each reading; in kelvin unless named.
    """

    time: float
    frames: Mapping[str, Frame]
    totals: Mapping[str, Mapping[str, int]]
    readings: Mapping[str, float]
    units: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Summary:
    """
    How a recording went.

    Attributes
    ----------
    path : Path
        Where it is.
    ended : str
        Why it ended: ``"duration"``, ``"stopped"``, ``"source lost"``, which does not end it before
        the last source is lost, or ``"no frames"`` where a band had none.
    totals : mapping
        As in `Preview`.
    """

    path: Path
    ended: str
    totals: Mapping[str, Mapping[str, int]]


def record(  # noqa: PLR0913 - the one entrance; all but the first three are by name
    session: Session,
    sources: Mapping[str, FrameSource],
    path: str | Path,
    *,
    readings: Mapping[str, Reading] | None = None,
    identities: Mapping[str, Mapping[str, str | bool]] | None = None,
    limits: Limits | None = None,
    preview: Callable[[Preview], None] | None = None,
    stop: threading.Event | None = None,
    clock: Callable[[], float] = system_time.monotonic,
) -> Summary:
    """
    Record until the session's duration is over, `stop` is set or no source is left.

    Frames that a driver held from before the start, as their stamps say, are not taken: they show
    another filter, or another scene. Two seconds later such a stamp is taken for a wrong one.

    Parameters
    ----------
    session : Session
        What is recorded.
    sources : mapping
        Band to an open source, in the session's order; they stay open.
    path : str or Path
        Store to make, ``*.zarr``; see `dbthermal.instruments.recording.capture.open_capture`.
    readings : mapping, optional
        Name to what else is asked: thermocouples, the cameras' temperatures, the blackbody.
    identities : mapping, optional
        Band, or name of another device, to what it is: kept beside what the sources say.
    limits : Limits, optional
        How much is held, and how long is waited.
    preview : callable, optional
        Called now and then with a `Preview`, in the caller's thread; it may take its time.
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
        What a source, a reading or the preview raised; what was recorded is kept. So it is when
        the keyboard interrupts: what came is written first. A second interrupt ends the wait, not
        the writing.
    """
    limits, readings = limits or Limits(), readings or {}
    _check(session, sources)
    start = clock()
    known = _identified(sources, identities or {})
    units = {name: reading.units for name, reading in readings.items()}
    tape = _tape(session, sources, Path(path), units, known, start, limits)
    run = Run(limits, clock, clock() + session.duration, stop or threading.Event())
    run.room.update((band, threading.Semaphore(limits.queue)) for band in sources)
    written = Written(start)
    fetching = [
        threading.Thread(target=fetch, args=(run, *item), name=item[0], daemon=True)
        for item in sources.items()
    ]
    asking = threading.Thread(target=ask, args=(run, readings), name="readings", daemon=True)
    # No daemon: it ends its work whatever becomes of this thread.
    writer = threading.Thread(
        target=writing.write, args=(run, tape, written, fetching, asking), name="writer"
    )
    try:
        writer.start()
        _look_on(run, written, preview, units)
    except BaseException:
        written.interrupted = True
        raise
    finally:
        run.over.set()
        if writer.ident is not None:  # None only where an interrupt came before its start
            written.done.wait()
    if run.errors:
        raise run.errors[0]
    return Summary(Path(path), written.ended, written.totals)


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


def _identified(
    sources: Mapping[str, FrameSource], identities: Mapping[str, Mapping[str, str | bool]]
) -> dict[str, dict[str, str | bool]]:
    """Merge what the sources say of themselves with what else is known."""
    own = {band: dict(source.identity) for band, source in sources.items()}
    return {
        name: {**own.get(name, {}), **identities.get(name, {})} for name in {**own, **identities}
    }


def _tape(
    session: Session,
    sources: Mapping[str, FrameSource],
    path: Path,
    units: Mapping[str, str],
    identities: Mapping[str, Mapping[str, str | bool]],
    start: float,
    limits: Limits,
) -> Tape:
    """Begin the store, if there is room for all of it, uncompressed."""
    folder = path.absolute().parent
    folder.mkdir(parents=True, exist_ok=True)
    rows, columns = session.shape
    frames = sum(session.duration * source.frame_rate for source in sources.values())
    needed = limits.reserve + int(_BYTES * rows * columns * frames)
    free = writing.free(folder)
    if free < needed:
        raise OSError(
            errno.ENOSPC, f"Too little space: {free} bytes are free. Must be {needed}", str(folder)
        )
    attrs = {
        "is_simulated": session.simulated,
        "origin": "simulated, emulated rig" if session.simulated else "measured",
        "identities": identities,
        "frame_rates": {band: source.frame_rate for band, source in sources.items()},
        "started": datetime.now(UTC).isoformat(timespec="milliseconds"),
        "provenance": store.provenance(session.content()),
    }
    return Tape(path, sources, readings=units, origin=start, attrs=attrs, chunk=limits.chunk)


def _look_on(
    run: Run,
    written: Written,
    preview: Callable[[Preview], None] | None,
    units: Mapping[str, str],
) -> None:
    """Show what is recorded, until there is no more."""
    period = _POLL  # until there is something to show
    # Not `Thread.join`: interrupted, that of Python 3.11 takes a running thread for an ended one.
    while not written.done.wait(period):
        if preview and written.frames and run.going():
            period = max(_POLL, run.limits.preview_period)
            time = run.clock() - written.start
            parts = dict(written.frames), written.totals, dict(written.readings), units
            preview(Preview(time, *parts))
