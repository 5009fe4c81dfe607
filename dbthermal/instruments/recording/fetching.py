"""The threads of a recording: one for each camera, one for all other instruments.

None of them waits for the disk or for another instrument: a command that a camera answers late,
because it corrects its offsets just then, costs no frame.
"""

import math
import queue
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from dbthermal.instruments.camera import Frame, FrameSource, NoFrameError, SourceLostError
from dbthermal.instruments.recording.contents import Note
from dbthermal.instruments.recording.tape import CHUNK


@dataclass(frozen=True)
class Reading:
    """
    Another instrument, asked now and then.

    Attributes
    ----------
    read : callable
        Gives a number; may take its time. OSError, RuntimeError and ValueError are taken for a
        reading that failed, which is noted; what else it raises ends the recording.
    units : str
        Of the number.
    """

    read: Callable[[], float]
    units: str = "K"


@dataclass(frozen=True)
class Limits:
    """
    How much is held, and how long is waited.

    Attributes
    ----------
    chunk : int
        Frames of a chunk: what a kill may cost.
    queue : int
        Frames of each band held until they are written.
    reserve : int
        Space that must stay free [byte].
    silence : float
        Wait for a frame before it is noted that none came [s].
    reading_period : float
        Time from reading to reading [s].
    patience : float
        Wait, at the end, for a device that hangs [s].
    preview_period : float
        Least time from preview to preview [s].
    """

    chunk: int = CHUNK
    queue: int = 120
    reserve: int = 10**9
    silence: float = 1.0
    reading_period: float = 1.0
    patience: float = 10.0
    preview_period: float = 0.2


@dataclass
class Run:
    """
    What the threads of one recording share.

    Attributes
    ----------
    limits : Limits
        How much is held, and how long is waited.
    clock : callable
        Host's monotonic clock [s].
    deadline : float
        When it is over [s].
    stop : Event
        The caller's wish to end.
    frames : SimpleQueue
        Band, frame, and number of frames refused before it.
    room : dict
        Band to how many more of its frames may be in the queue; to be released when one is taken.
    notes : SimpleQueue
        Kind, source, time and value.
    errors : list
        What the threads met and did not expect.
    lost : list
        Bands whose source is gone.
    refused : dict
        Band to frames refused after the last one that was not, when its thread is done.
    over : Event
        Set when all is to end.
    """

    limits: Limits
    clock: Callable[[], float]
    deadline: float
    stop: threading.Event
    frames: queue.SimpleQueue[tuple[str, Frame, int]] = field(default_factory=queue.SimpleQueue)
    room: dict[str, threading.Semaphore] = field(default_factory=dict)
    notes: queue.SimpleQueue[tuple[Note, str, float, float]] = field(
        default_factory=queue.SimpleQueue
    )
    errors: list[BaseException] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    refused: dict[str, int] = field(default_factory=dict)
    over: threading.Event = field(default_factory=threading.Event)

    def going(self) -> bool:
        """Whether to go on."""
        return not (self.over.is_set() or self.stop.is_set() or self.clock() >= self.deadline)


def fetch(run: Run, band: str, source: FrameSource) -> None:
    """
    Bring the frames of one source to the queue, until it is over.

    Where the band has no more room in the queue a frame is refused, and the next one that is not
    says how many were.

    Parameters
    ----------
    run : Run
        What the threads share.
    band : str
        Of the source.
    source : FrameSource
        Open.
    """
    refused = 0
    try:
        while run.going():
            try:
                frame = source.read(run.limits.silence)
            except NoFrameError:
                run.notes.put((Note.NO_FRAME, band, run.clock(), run.limits.silence))
                continue
            if run.room[band].acquire(blocking=False):
                run.frames.put((band, frame, refused))
                refused = 0
            else:
                refused += 1
    except SourceLostError:
        run.lost.append(band)
        run.notes.put((Note.SOURCE_LOST, band, run.clock(), math.nan))
    except BaseException as error:  # noqa: BLE001 - raised again in the caller's thread
        run.errors.append(error)
        run.over.set()
    finally:
        run.refused[band] = refused


def ask(run: Run, readings: Mapping[str, Reading]) -> None:
    """
    Ask all other instruments, one after the other, until it is over.

    Parameters
    ----------
    run : Run
        What the threads share.
    readings : mapping
        Name to instrument.
    """
    try:
        while readings and run.going():
            for name, reading in readings.items():
                try:
                    value, kind = float(reading.read()), Note.READING
                except (OSError, RuntimeError, ValueError):
                    value, kind = math.nan, Note.READING_FAILED
                run.notes.put((kind, name, run.clock(), value))
            run.over.wait(min(run.limits.reading_period, max(0.0, run.deadline - run.clock())))
    except BaseException as error:  # noqa: BLE001 - raised again in the caller's thread
        run.errors.append(error)
        run.over.set()
