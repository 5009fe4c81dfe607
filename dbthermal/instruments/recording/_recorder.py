"""The recorder: the frames of all cameras and the readings beside them, into one capture file.

A thread for each camera fetches its frames, a further thread reads the instruments: a camera that
corrects its offsets answers late, and that costs no frame. A queue of bounded length leads to the
thread that writes; if the disk is too slow, frames are refused and counted. The caller's thread
shows the preview; whatever ends that, the frames that came before are written.
"""

import errno
import math
import os
import queue
import shutil
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Final

from dbthermal import store
from dbthermal.instruments import camera
from dbthermal.instruments.recording._capture_file import CHUNK, CaptureFile, Note
from dbthermal.instruments.session import Session
from dbthermal.instruments.transport import Clock, Task
from dbthermal.store._whole import SignalExit, raised_signals

Identities = Mapping[str, Mapping[str, str | bool]]
Totals = Mapping[str, Mapping[str, int]]

_SHOW_POLL: Final = 0.01  # least wait between two looks for a preview [s]
_WRITE_POLL: Final = 0.05  # how long the writer waits for a frame [s]
_HELD: Final = 2.0  # how long after the start a frame may still come that a driver held [s]
_BYTES: Final = 2  # of a pixel


@dataclass(frozen=True)
class Reading:
    """An instrument that is read beside the frames.

    Attributes
    ----------
    read, units : callable, str
        Reads a value, in this unit, and may take its time. Its OSError, RuntimeError and ValueError
        are noted as a failed reading; any other error ends the recording.
    """

    read: Callable[[], float]
    units: str = "K"


@dataclass(frozen=True)
class Limits:
    """Sizes and waiting times of a recording.

    Attributes
    ----------
    chunk, queue, reserve : int
        Frames of a chunk, the most that a kill may cost, and of each band held until written; space
        that must stay free [byte].
    silence, reading_period, patience, preview_period : float
        Wait for a frame before it is noted that none came, time from reading to reading, wait at
        the end for a device that hangs, and least time from preview to preview [s].
    """

    chunk: int = CHUNK
    queue: int = 120
    reserve: int = 10**9
    silence: float = 1.0
    reading_period: float = 1.0
    patience: float = 10.0
    preview_period: float = 0.2


@dataclass(frozen=True)
class Preview:
    """State of a recording while it goes on.

    Attributes
    ----------
    time, frames, totals : float, mapping, mapping
        Time since the start [s]; by band, its last frame, and its numbers of ``frames``, ``lost``,
        ``refused``, ``damaged``.
    readings, units : mapping
        Last value of each reading, NaN if it failed, and its unit, else kelvin.
    """

    time: float
    frames: Mapping[str, camera.Frame]
    totals: Totals
    readings: Mapping[str, float]
    units: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Summary:
    """Result of a recording.

    Attributes
    ----------
    path, totals : Path, mapping
        Folder of the recording, wherever it lies now; as in `Preview`.
    ended : str
        ``"duration"``, ``"source lost"`` (it goes on until the last source is lost), or
        ``"no frames"`` if a band had none.
    """

    path: Path
    ended: str
    totals: Totals


def record(
    session: Session,
    sources: Mapping[str, camera.FrameSource],
    path: str | Path,
    *,
    readings: Mapping[str, Reading] | None = None,
    identities: Identities | None = None,
    limits: Limits | None = None,
    preview: Callable[[Preview], None] | None = None,
) -> Summary:
    """Record until the end of the session's duration, or the loss of the last camera.

    Frames that a driver buffered before the start, by their stamps, are not recorded. Two seconds
    after the start such a stamp counts as wrong. If the folder, or one above it, is renamed or
    moved on its disk, the recording goes on in it.

    FileExistsError if `path` exists, ValueError if the sources are not those of the session, or
    emulated and it is not, OSError if there is too little space, or the folder or one in it was
    deleted or replaced. An error of a source, a reading or the preview, an interrupt by the
    keyboard, and SIGTERM or SIGHUP in the main thread, as `SignalExit`, are raised when what was
    recorded is kept; a second interrupt ends the wait, not the writing.

    Parameters
    ----------
    session, sources : Session, mapping
        Bands, format, duration; band to an open source, in the session's order; they stay open.
    path : str or Path
        Folder ``*.zarr`` to make; see `open_capture`.
    readings, identities : mapping, optional
        Name to an instrument; name or band to model and numbers, beside those of the sources.
    limits, preview : optional
        `Limits`; and a function called now and then with a `Preview` in the caller's thread, which
        may take its time.
    """
    limits, clock = limits or Limits(), _check(session, sources)
    with raised_signals(), clock.joined():
        # The writer starts the other threads, this one shows the preview.
        run = _Run(session, sources, Path(path), readings or {}, identities or {}, limits)
        # No daemon: it ends its work whatever becomes of this thread.
        writer = Task(clock, "writer", run.write, daemon=False)
        try:
            writer.start()
            run.show(preview)
        except BaseException as error:
            run.interrupted = error.name if isinstance(error, SignalExit) else "interrupted"
            raise
        finally:
            run.over.set()
            if writer.ident is not None:  # None only where an interrupt came before its start
                while not clock.wait(run.done, limits.silence):
                    pass
    if run.errors:
        raise run.errors[0]
    return Summary(run.file.recording.place(), run.ended, run.file.totals)


def _check(session: Session, sources: Mapping[str, camera.FrameSource]) -> Clock:
    """Clock of the sources; ValueError unless they are those of the session."""
    if tuple(sources) != session.bands:
        rule = f"Must be the bands {list(session.bands)}"
        raise ValueError(f"Invalid sources {list(sources)}. {rule}.")
    clock = next(iter(sources.values())).clock
    for band, source in sources.items():
        if source.clock is not clock:
            raise ValueError(f"Invalid clock of band '{band}'. Must be that of the other sources.")
        for name, expected in (("is_simulated", session.simulated), ("shape", session.shape)):
            if (value := getattr(source, name)) != expected:
                rule = f"Must be {expected}, as the session says"
                raise ValueError(f"Invalid source of band '{band}': {name} is {value}. {rule}.")
    return clock


class _Run:
    """A recording in a new file: the threads that fetch, read and write, and their shared state."""

    def __init__(
        self,
        session: Session,
        sources: Mapping[str, camera.FrameSource],
        path: Path,
        readings: Mapping[str, Reading],
        identities: Identities,
        limits: Limits,
    ) -> None:
        self.readings, self.limits = readings, limits
        self.clock = next(iter(sources.values())).clock
        # Room on the disk for all frames, uncompressed.
        folder = path.absolute().parent
        folder.mkdir(parents=True, exist_ok=True)
        frames = sum(session.duration * source.frame_rate for source in sources.values())
        _check_space(folder, limits.reserve + int(_BYTES * math.prod(session.shape) * frames))
        # What the recording says of its devices.
        devices = {band: source.identity for band, source in sources.items()}
        attrs = {
            "is_simulated": session.simulated,
            "origin": "simulated, emulated rig" if session.simulated else "measured",
            "identities": {
                name: {**devices.get(name, {}), **identities.get(name, {})}
                for name in {**devices, **identities}
            },
            "frame_rates": {band: source.frame_rate for band, source in sources.items()},
            "provenance": store.provenance(asdict(session)),
        }
        self.units = {name: reading.units for name, reading in readings.items()}
        self.file = CaptureFile(path, sources, self.units, attrs, chunk=limits.chunk)
        self.start = self.file.begin()  # to make the file may have taken a while
        self.end = self.start + session.duration
        self.over, self.done = threading.Event(), threading.Event()
        self.errors: list[BaseException] = []
        self.interrupted, self.ended = "", ""
        # For the preview: last frames that are written, and last readings.
        self.last_frames: dict[str, camera.Frame] = {}
        self.last_readings: dict[str, float] = {}
        # Work for the writer: notes, and at most `limits.queue` frames of each band.
        self._work: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._room = {band: threading.Semaphore(limits.queue) for band in sources}
        self._lost_sources, self._written = list[str](), 0  # frames
        self._fetching = [
            Task(self.clock, band, self._guarded, partial(self._fetch, band, source))
            for band, source in sources.items()
        ]
        reading = Task(self.clock, "readings", self._guarded, self._read)
        self._threads = [*self._fetching, reading]

    def _is_going(self) -> bool:
        """True until the end of the duration, or an error."""
        return not (self.over.is_set() or self.clock() >= self.end)

    def _guarded(self, work: Callable[[], None]) -> None:
        """Do a thread's work; an error ends the recording, and is raised in the caller's thread."""
        try:
            work()
        except BaseException as error:  # noqa: BLE001
            self.errors.append(error)
            self.over.set()

    def _put_note(self, kind: Note, source: str, value: float = math.nan) -> None:
        self._work.put(partial(self.file.note, kind, source, self.clock(), value))

    def _fetch(self, band: str, source: camera.FrameSource) -> None:
        """Queue the frames of a source for the writer, until the end."""
        refused = 0
        try:
            while self._is_going():
                try:
                    frame = source.read(self.limits.silence)
                except camera.NoFrameError:
                    self._put_note(Note.NO_FRAME, band, self.limits.silence)
                    continue
                # Without room it is refused; the next one carries the number of refused frames.
                if self.clock.has_room(self._room[band]):
                    self._work.put(partial(self._frame, band, frame, refused))
                    refused = 0
                else:
                    refused += 1
        except camera.SourceLostError:
            self._lost_sources.append(band)
            self._put_note(Note.SOURCE_LOST, band)
        finally:
            self._work.put(partial(self.file.refused, band, refused, self.clock()))

    def _read(self) -> None:
        """Read the instruments in turn, until the end."""
        while self.readings and self._is_going():
            for name, reading in self.readings.items():
                try:
                    value, kind = float(reading.read()), Note.READING
                except (OSError, RuntimeError, ValueError):
                    value, kind = math.nan, Note.READING_FAILED
                self._put_note(kind, name, value)
                self.last_readings[name] = value
            remaining = max(0.0, self.end - self.clock())
            self.clock.wait(self.over, min(self.limits.reading_period, remaining))

    def show(self, preview: Callable[[Preview], None] | None) -> None:
        """Call the preview at its period, until the last frame is written."""
        period = _SHOW_POLL  # until there is something to show
        # Not `Thread.join`: interrupted, Python 3.11's takes a running thread for an ended one.
        while not self.clock.wait(self.done, period):
            if preview and self.last_frames and self._is_going():
                period = max(_SHOW_POLL, self.limits.preview_period)
                time, totals = self.clock() - self.start, self.file.totals
                frames, readings = dict(self.last_frames), dict(self.last_readings)
                preview(Preview(time, frames, totals, readings, self.units))

    def write(self) -> None:
        """Start the other threads, write frames and notes until the end, and close the file."""
        self._guarded(self._write)
        self.over.set()
        for thread in self._threads:
            # A thread that hangs in its device must not keep what was recorded.
            if thread.ident and not self.clock.wait(thread.ended, self.limits.patience):
                late = f"within {self.limits.patience} s after the end. Must keep its time limits."
                message = f"No answer of the device of '{thread.name}' {late}"
                self.errors.append(TimeoutError(message))
        # After an error of writing itself the file stays as it is on the disk.
        if not self.file.broken:
            self._guarded(self._finish)
        self.done.set()

    def _write(self) -> None:
        for thread in self._threads:
            thread.start()
        while self._is_going() and not all(task.ended.is_set() for task in self._fetching):
            with suppress(queue.Empty):
                self.clock.get(self._work, _WRITE_POLL)()

    def _finish(self) -> None:
        """Write what is left in the queue, and close the file with the reason of the end."""
        while not self._work.empty():
            self._work.get_nowait()()
        if self.errors:
            is_full = getattr(self.errors[0], "errno", 0) == errno.ENOSPC
            self.ended = "no space" if is_full else "error"
        elif self.interrupted or self._lost_sources:
            self.ended = self.interrupted or "source lost"
        else:
            self.ended = "duration" if len(self.last_frames) == len(self._room) else "no frames"
        self.file.close(complete=self.ended == "duration", ended=self.ended)

    def _frame(self, band: str, frame: camera.Frame, refused: int) -> None:
        """Write a frame, unless the driver held it from before the start."""
        has_device_clock = camera.FrameFlag.FOREIGN_CLOCK in frame.flags  # which cannot say
        early = frame.device_time < self.start and frame.host_time < self.start + _HELD
        if band in self.last_frames or not early or has_device_clock:
            flags = self.file.frame(band, frame, refused)
            self.last_frames[band] = replace(frame, flags=flags)
        self._room[band].release()
        self._written += 1
        if self._written % self.limits.chunk == 0 and self._is_going():
            _check_space(self.file.recording.root, self.limits.reserve)


def _check_space(path: Path, least: int) -> None:
    if (available := shutil.disk_usage(path).free) < least:
        message = f"Too little space: {available} bytes are free. Must be {least}"
        raise OSError(errno.ENOSPC, message, os.path.realpath(path))
