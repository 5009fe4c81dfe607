"""The interface of a camera: all that recorder, sessions and live view need of any camera.

`FrameSource` gives frames with two clocks, a number, flags and metadata; `CameraControl`, which a
camera may lack, sets its modes and reads its temperature and the state of its shutter. `KINDS`
names the module of each kind of camera, which is imported when a session asks for it. A driver
hands on a damaged frame with flags; it neither hides nor mends it.
"""

import importlib
import math
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from enum import IntEnum
from types import MappingProxyType
from typing import Final, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from dbthermal import _text as texts
from dbthermal.correction._temporal import FEWEST_COPIES
from dbthermal.instruments.transport import Clock, Transport
from dbthermal.schema import Flags

__all__ = ["KINDS", "CameraControl", "CameraKind", "Frame", "FrameFlag", "FrameSource", "Metadata"]
__dir__ = __all__.copy

Counts = npt.NDArray[np.uint16]
Identity = Mapping[str, str | bool]

FRAME_TIMEOUT: Final = 1.0  # longest wait for a frame by default [s]
# Beginnings of the names of two readings, which the band follows.
FPA_READING: Final = "fpa "  # temperature of the focal-plane array [K]
FFC_READING: Final = "ffc "  # `FfcStatus`

KINDS: Final = MappingProxyType(
    {"boson": "dbthermal.instruments.boson", "y16": "dbthermal.instruments.v4l2"}
)
"""Module of each kind of camera; its ``KIND`` is a `CameraKind`."""


class FrameFlag(Flags):
    """State of one frame; the driver sets the first three bits, the recorder the rest."""

    DRIVER_ERROR = 1, "the driver reports damaged data"
    WRONG_SIZE = 2, "fewer or more bytes than a frame has: missing ones are 0"
    FOREIGN_CLOCK = 4, "the device time is not on the host's monotonic clock"
    SHUTTER_CLOSED = 8, "the shutter is closed, or the offsets were just renewed"
    FRAMES_LOST_BEFORE = 16, "the sequence number leaps: frames are missing before it"
    SEQUENCE_STANDS = 32, "the sequence number does not rise: repeated, or started anew"
    TIME_STANDS = 64, "the device time does not rise, or is not known"
    TIME_WRONG = 128, "the device time is before the start, or after the host's"
    PADDED = 256, "no frame: the band has fewer than another, and its last one is repeated"
    IMAGE_REPEATED = 512, "no pixel differs from the frame before: frozen, or saturated"


GOOD: Final = FrameFlag(0)  # no flag

# Flags of a frame with wrong counts, and maybe wrong telemetry.
DAMAGED: Final = FrameFlag.DRIVER_ERROR | FrameFlag.WRONG_SIZE

_WRONG_TIME = FrameFlag.SEQUENCE_STANDS | FrameFlag.TIME_STANDS | FrameFlag.TIME_WRONG
UNTIMED: Final = DAMAGED | _WRONG_TIME | FrameFlag.PADDED
"""Flags of a frame that is recorded but is no measurement: it gets no exposure time. A repeated
image keeps its time, for a closed aperture looks the same."""


FfcStatus = IntEnum("FfcStatus", "NONE_PERFORMED IMMINENT IN_PROGRESS COMPLETE", start=0)
"""State of a camera's flat-field correction (FFC)."""


class NoFrameError(TimeoutError):
    """No frame came in time; the next one may."""


class SourceLostError(ConnectionError):
    """The source is gone, unplugged or closed, and gives no more frames."""


@dataclass(frozen=True)
class Metadata:
    """Metadata that a camera gives with a frame, besides its image."""

    frame_counter: int = -1  # camera's number of the frame, -1 if it gives none
    last_ffc_frame: int | None = None  # frame_counter at the last flat-field correction
    fpa_temperature: float = math.nan  # of the focal-plane array [K]


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame as it came: its counts are not written to again, a leap of the number is a loss."""

    counts: Counts  # raw signal (y, x) [count]
    device_time: float  # exposure, by the camera's or the kernel's stamp [s]; NaN: no measurement
    host_time: float  # arrival, on the host's monotonic clock [s]
    sequence: int  # number that the driver gives each frame
    flags: FrameFlag = GOOD  # damage, and kind of its clock
    telemetry: Counts | None = None  # rows (row, x) as they came, see `telemetry.decode`
    metadata: Metadata | None = None  # decoded from the telemetry


@dataclass(frozen=True)
class Stream:
    """Format of a stream of frames."""

    shape: tuple[int, int] = (512, 640)  # rows and columns of the image, without telemetry [pixel]
    frame_rate: float = 60.0  # [Hz]
    telemetry_rows: int = 0  # below the image: 2 for a Boson with telemetry on


class FrameSource(Protocol):
    """An open camera that gives a sequence of frames."""

    shape: tuple[int, int]  # rows and columns of the image, without telemetry [pixel]
    telemetry_rows: int  # that come with each frame, 0 for none
    frame_rate: float  # nominal [Hz]
    identity: Mapping[str, str]  # model, serial number and device; text by name
    is_simulated: bool  # True if the camera is emulated

    @property
    def clock(self) -> Clock:
        """Clock of the times of arrival."""

    def read(self, timeout: float = FRAME_TIMEOUT) -> Frame:
        """Wait at most `timeout` [s] for a frame; `NoFrameError` or `SourceLostError` without."""

    def close(self) -> None:
        """Stop and release the device; a second call does nothing."""


class CameraControl(Protocol):
    """The command port of a camera that has one; failures are RuntimeError or OSError."""

    is_simulated: bool  # True if the camera is emulated

    def identity(self) -> Identity:
        """Serial number, versions, modes and ``is_simulated``, for the record of a capture."""

    def prepare(self, telemetry_rows: int) -> None:
        """Set 16-bit counts, telemetry and FFC on command only; ValueError if one is not kept."""

    def run_ffc(self) -> int:
        """Run a flat-field correction, wait for its end, return its frame on the camera's count."""

    def ffc_status(self) -> FfcStatus:
        """State of the flat-field correction, and so of the shutter."""

    def fpa_temperature(self) -> float:
        """Temperature of the focal-plane array [K]."""

    def close(self) -> None:
        """Release the port; a second call does nothing."""


@dataclass(frozen=True)
class CameraKind:
    """A kind of camera: its frames, and the driver of its command port; ``KIND`` of its module."""

    open_frames: Callable[[str, Stream], AbstractContextManager[FrameSource]]
    control: Callable[[Transport], AbstractContextManager[CameraControl]] | None = None
    baudrate: int = 115_200  # speed of the command port's line [bit/s]
    telemetry_rows: tuple[int, ...] = (0,)  # numbers of telemetry rows that it can give


def camera_kind(name: str) -> CameraKind:
    """Import the kind of camera of this name; ValueError if it is not one of `KINDS`."""
    texts.check_listed("Unknown kind of camera", name, sorted(KINDS))
    kind: CameraKind = importlib.import_module(KINDS[name]).KIND
    return kind


class Shutter(NamedTuple):
    """State of a camera's shutter after a frame; see `next_shutter`."""

    closed: bool = False  # True if the frame is flagged `FrameFlag.SHUTTER_CLOSED`
    copies: int = 0  # frames in a row, up to this frame, that repeat the image before
    last_ffc_frame: int | None = None  # frame of the last correction, from telemetry


def next_shutter(
    before: Shutter,
    *,
    repeated: bool,
    last_ffc_frame: int | None = None,
    ffc_status: FfcStatus | None = None,
) -> Shutter:
    """State of a camera's shutter after the next frame, from telemetry, serial line and image.

    A camera freezes its image while the shutter is closed. The flag need not begin at the first
    copy: `dbthermal.correction.find_shutter` makes one event of every run of copies that holds or
    touches a flagged frame. What is not known of the frame is None.
    """
    # By telemetry the offsets were renewed since the frame before. This costs a frame more than
    # needed, but finds every renewal, even where the frozen frames were lost.
    latest = before.last_ffc_frame if last_ffc_frame is None else last_ffc_frame
    renewed = before.last_ffc_frame not in {None, latest}
    # The serial line says so: older than the frame, it counts against no image that changes.
    announced = ffc_status in {FfcStatus.IMMINENT, FfcStatus.IN_PROGRESS}
    # The third copy in a row, without telemetry; fewer are lost frames. The serial line, which is
    # read once a second, may miss an event.
    copies = before.copies + 1 if repeated else 0
    frozen = latest is None and copies >= FEWEST_COPIES
    closed = renewed or (repeated and (before.closed or announced or frozen))
    return Shutter(closed, copies, latest)
