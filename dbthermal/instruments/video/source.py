"""What every camera gives, whatever is behind it: frames with two clocks, a number and flags.

A `FrameSource` is the V4L2 driver (`dbthermal.instruments.video.v4l2`) or the emulated camera
(`dbthermal.instruments.emulated.frames`); the recorder knows only this. A frame that is damaged is
handed on and says so in its flags: to hide it, or to mend it, is not the driver's matter.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import IntFlag
from types import MappingProxyType
from typing import Final, Protocol

import numpy as np
import numpy.typing as npt

Counts = npt.NDArray[np.uint16]

FRAME_TIMEOUT: Final = 1.0
"""How long to wait for a frame, unless told otherwise [s]; a Boson gives 30 or 60 a second."""


class FrameFlag(IntFlag):
    """What is to be known of one frame; `MEANINGS` has a sentence for each bit."""

    DRIVER_ERROR = 1
    WRONG_SIZE = 2
    FOREIGN_CLOCK = 4
    SHUTTER_CLOSED = 8
    FRAMES_LOST_BEFORE = 16
    SEQUENCE_STANDS = 32
    TIME_STANDS = 64
    TIME_WRONG = 128
    PADDED = 256
    IMAGE_REPEATED = 512


GOOD: Final = FrameFlag(0)
"""No flag."""

MEANINGS: Final = MappingProxyType(
    {
        FrameFlag.DRIVER_ERROR: "the driver says that the data are damaged",
        FrameFlag.WRONG_SIZE: "fewer or more bytes than a frame has: what is missing is 0",
        FrameFlag.FOREIGN_CLOCK: "the device time is not on the host's monotonic clock",
        FrameFlag.SHUTTER_CLOSED: "the camera says that its shutter is closed",
        FrameFlag.FRAMES_LOST_BEFORE: "the sequence number leaps: frames are missing before it",
        FrameFlag.SEQUENCE_STANDS: "the sequence number does not rise: repeated, or started anew",
        FrameFlag.TIME_STANDS: "the device time does not rise, or is not known",
        FrameFlag.TIME_WRONG: "the device time is before the start, or after the host's",
        FrameFlag.PADDED: "no frame: the band has fewer than another, and its last one is repeated",
        FrameFlag.IMAGE_REPEATED: "no pixel differs from the frame before: frozen, or saturated",
    }
)
"""The first four are the source's to set, the others the recorder's, who sees the frame before."""

UNTIMED: Final = (
    FrameFlag.DRIVER_ERROR
    | FrameFlag.WRONG_SIZE
    | FrameFlag.SEQUENCE_STANDS
    | FrameFlag.TIME_STANDS
    | FrameFlag.TIME_WRONG
    | FrameFlag.PADDED
)
"""A frame with one of these is recorded but is no measurement: it gets no exposure time. A repeated
image keeps its time, for a closed aperture looks so, too: `dbthermal.correction.find_shutter`."""

DAMAGED: Final = FrameFlag.DRIVER_ERROR | FrameFlag.WRONG_SIZE
"""A frame with one of these has wrong counts, and maybe wrong telemetry."""


class NoFrameError(TimeoutError):
    """No frame came in time; the next one may."""


class SourceLostError(ConnectionError):
    """The source is gone, unplugged or closed, and gives no more frames."""


@dataclass(frozen=True, eq=False)
class Frame:
    """
    One frame as it came.

    Attributes
    ----------
    counts : ndarray of uint16, shape (y, x)
        Raw signal [count]; the frame's own, no driver writes to it again.
    device_time : float
        When the frame was exposed, by the camera's or the kernel's stamp [s]; NaN if not known.
    host_time : float
        When the host had it, on its monotonic clock [s].
    sequence : int
        Number that the driver gives each frame; a leap is a loss.
    flags : FrameFlag
        What is wrong with it; 0 is good.
    telemetry : ndarray of uint16, shape (row, x), or None
        Telemetry rows as they came; see `dbthermal.instruments.video.telemetry.decode`.
    """

    counts: Counts
    device_time: float
    host_time: float
    sequence: int
    flags: FrameFlag = GOOD
    telemetry: Counts | None = None


class FrameSource(Protocol):
    """A camera that is open and gives frames, one after the other."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the image, without telemetry [pixel]."""
        ...

    @property
    def telemetry_rows(self) -> int:
        """Rows of telemetry that come with each frame, 0 for none."""
        ...

    @property
    def frame_rate(self) -> float:
        """Nominal rate [Hz]."""
        ...

    @property
    def identity(self) -> Mapping[str, str]:
        """What it is: model, serial number, device; text by name."""
        ...

    @property
    def is_simulated(self) -> bool:
        """True if no camera is behind it."""
        ...

    def read(self, timeout: float = FRAME_TIMEOUT) -> Frame:
        """
        Wait for the next frame.

        Parameters
        ----------
        timeout : float
            How long to wait [s].

        Returns
        -------
        Frame
            The next one; damaged ones too, with flags.

        Raises
        ------
        NoFrameError
            If none came in time.
        SourceLostError
            If the source is gone or closed.
        """
        ...

    def close(self) -> None:
        """Stop and let the device go; a second call does nothing."""
        ...


def frames(source: FrameSource, number: int, timeout: float = FRAME_TIMEOUT) -> Iterator[Frame]:
    """
    Yield a number of frames.

    Parameters
    ----------
    source : FrameSource
        Open.
    number : int
        How many.
    timeout : float
        How long to wait for each [s].

    Yields
    ------
    Frame
        In the order in which they come.

    Raises
    ------
    NoFrameError, SourceLostError
        As `FrameSource.read`.
    """
    for _ in range(number):
        yield source.read(timeout)
