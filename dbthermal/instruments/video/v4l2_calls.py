"""Calls of Video4Linux2: their numbers and layouts, and how a node's format is agreed on.

Numbers of the calls, sizes and layouts are those of 64-bit Linux (``linux/videodev2.h``,
https://docs.kernel.org/userspace-api/media/v4l); the sizes are asserted below. Tested with a
stand-in for the kernel's calls, not against a camera.
"""

import errno
import mmap
import os
import select
import struct
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

try:
    import fcntl
except ImportError as missing:  # Windows
    raise ImportError(f"No video on '{sys.platform}'. Must be Linux, for V4L2.") from missing

from dbthermal.instruments.camera import Stream

Y16: Final = 0x20363159
"""Pixel format ``Y16 ``: 16 bits a pixel, little-endian, before any gain control."""

BUFFERS: Final = 32
"""Frames that the kernel holds while nobody reads, the most it can; beyond, it drops: half a second
at 60 Hz, in which a busy computer gets round to read again."""

QUERYCAP: Final = 0x80685600
ENUM_FMT: Final = 0xC0405602
S_FMT: Final = 0xC0D05605
REQBUFS: Final = 0xC0145608
QUERYBUF: Final = 0xC0585609
QBUF: Final = 0xC058560F
DQBUF: Final = 0xC0585611
STREAMON: Final = 0x40045612
STREAMOFF: Final = 0x40045613
S_PARM: Final = 0xC0CC5616

CAPABILITY = struct.Struct("=16s32s32sIII12x")
FORMAT_ENTRY = struct.Struct("=III32sI16x")
FORMAT = struct.Struct("=I4xIIIIIII172x")
REQUEST = struct.Struct("=III8x")
BUFFER = struct.Struct("=IIIII4xqq16xIIQI12x")
PARAMETERS = struct.Struct("=IIIIIII176x")

for _number, _layout in (
    (QUERYCAP, CAPABILITY),
    (ENUM_FMT, FORMAT_ENTRY),
    (S_FMT, FORMAT),
    (REQBUFS, REQUEST),
    (QUERYBUF, BUFFER),
    (S_PARM, PARAMETERS),
):
    # The number of a call holds the size of its argument.
    assert _number >> 16 & 0x3FFF == _layout.size

CAPTURE: Final = 1  # V4L2_BUF_TYPE_VIDEO_CAPTURE
MMAP: Final = 1  # V4L2_MEMORY_MMAP
_PROGRESSIVE: Final = 1  # V4L2_FIELD_NONE
_VIDEO_CAPTURE: Final = 0x1  # V4L2_CAP_VIDEO_CAPTURE
_STREAMING: Final = 0x04000000  # V4L2_CAP_STREAMING
_BYTES: Final = 2  # of a pixel
_RATE_TOLERANCE: Final = 1e-3


@dataclass(frozen=True)
class Kernel:
    """
    The calls to the kernel; tests hand in others.

    Attributes
    ----------
    open, close, ioctl, map, select, clock : callable
        As `os.open`, `os.close`, `fcntl.ioctl`, `mmap.mmap`, `select.select`, `time.monotonic`.
    platform : str
        As `sys.platform`.
    """

    open: Callable[[str, int], int] = os.open
    close: Callable[[int], None] = os.close
    ioctl: Callable[[int, int, bytearray], int] = fcntl.ioctl
    map: Callable[[int, int, int], Any] = field(
        default=lambda file, length, offset: mmap.mmap(file, length, offset=offset)
    )
    select: Callable[..., tuple[Sequence[Any], Sequence[Any], Sequence[Any]]] = select.select
    clock: Callable[[], float] = time.monotonic
    platform: str = sys.platform

    def ask(self, file: int, number: int, argument: bytearray) -> None:
        """
        Call `ioctl`, again where a signal came between: unlike other calls, Python's does not.

        Parameters
        ----------
        file : int
            Open node.
        number : int
            Of the call.
        argument : bytearray
            Its argument, which the kernel changes.

        Raises
        ------
        OSError
            If the kernel refuses.
        """
        while True:
            try:
                self.ioctl(file, number, argument)
            except InterruptedError:
                continue
            return


def formats(path: str, kernel: Kernel | None = None) -> list[int]:
    """
    List the pixel formats of a video node; empty for a node that captures no video.

    One camera has several nodes ``/dev/video*``: the one that lists `Y16` is to be opened.

    Parameters
    ----------
    path : str
        Such as ``"/dev/video0"``.
    kernel : Kernel, optional
        Calls to the kernel.

    Returns
    -------
    list of int
        Codes of four characters, least significant first.

    Raises
    ------
    OSError
        If the node cannot be opened, or this is not Linux.
    """
    kernel = kernel or Kernel()
    file = open_node(path, kernel)
    try:
        return _formats(file, kernel) if _captures(file, kernel)[0] else []
    finally:
        kernel.close(file)


def open_node(path: str, kernel: Kernel) -> int:
    """
    Open a video node.

    Parameters
    ----------
    path : str
        The node.
    kernel : Kernel
        Calls to the kernel.

    Returns
    -------
    int
        Open file, to be closed by the caller.

    Raises
    ------
    OSError
        If it cannot be opened, or this is not Linux.
    """
    if not kernel.platform.startswith("linux"):
        message = f"No video on '{kernel.platform}'. Must be Linux, for V4L2"
        raise OSError(errno.ENOSYS, message, path)
    return kernel.open(path, os.O_RDWR | os.O_NONBLOCK)


def agree(file: int, path: str, wanted: Stream, kernel: Kernel) -> dict[str, str]:
    """
    Set format and rate. A driver sets what is nearest to what it cannot do: here an error.

    Parameters
    ----------
    file : int
        Open node.
    path : str
        Its name.
    wanted : Stream
        Format and rate.
    kernel : Kernel
        Calls to the kernel.

    Returns
    -------
    dict
        ``model``, what the driver calls the camera, ``bus``, where it is plugged in, and
        ``driver`` with its version, on which it depends what a stamp means.

    Raises
    ------
    OSError
        If the driver refuses, such as when the camera is in use.
    ValueError
        If the node gives no Y16, or the driver agrees to another format or rate.
    """
    captures, identity = _captures(file, kernel)
    offered = _formats(file, kernel) if captures else []
    if Y16 not in offered:
        names = [code.to_bytes(4, "little").decode("ascii", "backslashreplace") for code in offered]
        raise ValueError(f"Invalid video node '{path}' with {names}. Must offer 'Y16 '.")
    _agree_on_format(file, path, wanted, kernel)
    _agree_on_rate(file, path, wanted.frame_rate, kernel)
    return identity


def _captures(file: int, kernel: Kernel) -> tuple[bool, dict[str, str]]:
    """Whether the node captures video (a camera has others, for metadata), and its identity."""
    capability = bytearray(CAPABILITY.size)
    kernel.ask(file, QUERYCAP, capability)
    *texts, version, _, node = CAPABILITY.unpack(capability)
    driver, card, bus = (text.rstrip(b"\0").decode("utf-8", "backslashreplace") for text in texts)
    release = f"{version >> 16}.{version >> 8 & 0xFF}.{version & 0xFF}"
    wanted = _VIDEO_CAPTURE | _STREAMING
    identity = {"model": card, "bus": bus, "driver": f"{driver} {release}"}
    return node & wanted == wanted, identity


def _formats(file: int, kernel: Kernel) -> list[int]:
    found: list[int] = []
    while True:
        entry = bytearray(FORMAT_ENTRY.pack(len(found), CAPTURE, 0, b"", 0))
        try:
            kernel.ask(file, ENUM_FMT, entry)
        except OSError as error:
            if error.errno == errno.EINVAL:  # the end of the list
                return found
            raise
        found.append(FORMAT_ENTRY.unpack(entry)[4])


def _agree_on_format(file: int, path: str, stream: Stream, kernel: Kernel) -> None:
    rows, columns = stream.rows, stream.shape[1]
    line = _BYTES * columns
    wanted = columns, rows, Y16, _PROGRESSIVE, line, rows * line
    argument = bytearray(FORMAT.pack(CAPTURE, *wanted, 0))
    kernel.ask(file, S_FMT, argument)
    got = FORMAT.unpack(argument)[1:7]
    if got != wanted:
        raise ValueError(
            f"Invalid format of '{path}': {got} (columns, rows, code, field, bytes of a row, bytes "
            f"of a frame). Must be {wanted}: is the telemetry set as requested?"
        )


def _agree_on_rate(file: int, path: str, rate: float, kernel: Kernel) -> None:
    argument = bytearray(PARAMETERS.pack(CAPTURE, 0, 0, 1000, round(1000 * rate), 0, 0))
    kernel.ask(file, S_PARM, argument)
    numerator, denominator = PARAMETERS.unpack(argument)[3:5]
    if numerator == 0 or abs(denominator / numerator - rate) > _RATE_TOLERANCE * rate:
        raise ValueError(
            f"Invalid frame period {numerator}/{denominator} s of '{path}'. Must be 1/{rate} s."
        )
