"""Records that go into a recording and come out of it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from dbthermal.instruments.camera import Frame
from dbthermal.instruments.recording._capture_file import CHUNK


@dataclass(frozen=True)
class Reading:
    """Another instrument that is read beside the frames.

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
    chunk, queue : int
        Frames of a chunk, the most that a kill may cost, and of each band held until written.
    reserve : int
        Space that must stay free [byte].
    silence, patience : float
        Wait for a frame before it is noted that none came, and at the end for a device that
        hangs [s].
    reading_period, preview_period : float
        Time from reading to reading, and least time from preview to preview [s].
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
    time : float
        Time since the start [s].
    frames : mapping of str to Frame
        Last frame of each band that had one.
    totals : mapping
        Numbers of frames of each band: ``frames``, ``lost``, ``refused``, ``damaged``.
    readings, units : mapping
        Last value of each reading, NaN if it failed, and its unit, else kelvin.
    """

    time: float
    frames: Mapping[str, Frame]
    totals: Mapping[str, Mapping[str, int]]
    readings: Mapping[str, float]
    units: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Summary:
    """Result of a recording.

    Attributes
    ----------
    path : Path
        Folder of the recording, wherever it lies now.
    ended : str
        ``"duration"``, ``"stopped"``, ``"source lost"`` (it goes on until the last source is lost),
        or ``"no frames"`` if a band had none.
    totals : mapping
        As in `Preview`.
    """

    path: Path
    ended: str
    totals: Mapping[str, Mapping[str, int]]
