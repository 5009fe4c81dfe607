"""Raw 16-bit frames (Y16) of any camera on Linux, with the kernel's stamps, numbers and flags.

A thin use of Video4Linux2, in ten calls; numbers, sizes and layouts are those of 64-bit Linux
(``linux/videodev2.h``, https://docs.kernel.org/userspace-api/media/v4l). The kernel's stamp of a
frame is on CLOCK_MONOTONIC. That of uvcvideo claims to be of the start of the exposure; likely,
unless that module is told to use the camera's clock, it is of the frame's first packet.

`KIND` is a camera without command port or telemetry: nothing is known of it but its frames. The
state of its shutter follows from frozen images, see `camera.next_shutter`, and it corrects its
offsets when it decides to.
"""

import errno
import importlib
import mmap
import os
import select
import struct
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from dbthermal.instruments.camera import (
    DAMAGED,
    FRAME_TIMEOUT,
    GOOD,
    CameraKind,
    Counts,
    Frame,
    FrameFlag,
    Metadata,
    NoFrameError,
    SourceLostError,
    Stream,
)
from dbthermal.instruments.clock import SYSTEM, Clock
from dbthermal.instruments.transport import Closing, parse

__all__ = ["BUFFERS", "KIND", "Y16", "Capture", "Kernel", "open_url"]
__dir__ = __all__.copy

# Pixel format ``Y16`` and a space: 16 bits a pixel, little-endian, before any gain control.
Y16: Final = 0x20363159
# Frames that the kernel holds while no program reads, the most it can: half a second at 60 Hz, in
# which a busy computer gets round to read again. Beyond, it drops frames.
BUFFERS: Final = 32

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

CAPTURE: Final = 1  # V4L2_BUF_TYPE_VIDEO_CAPTURE
MMAP: Final = 1  # V4L2_MEMORY_MMAP
_PROGRESSIVE: Final = 1  # V4L2_FIELD_NONE
_CAPTURES: Final = 0x04000001  # V4L2_CAP_VIDEO_CAPTURE | V4L2_CAP_STREAMING
_ERROR: Final = 0x40  # V4L2_BUF_FLAG_ERROR
_CLOCK_MASK: Final = 0xE000  # V4L2_BUF_FLAG_TIMESTAMP_MASK
_MONOTONIC: Final = 0x2000  # V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC
_GONE: Final = (errno.ENODEV, errno.EIO)
_BYTES: Final = 2  # of a pixel
_MICRO: Final = 1e-6
_RATE_TOLERANCE: Final = 1e-3
_TYPE: Final = struct.pack("=I", CAPTURE)

Decode = Callable[[Counts], Metadata]


@dataclass(frozen=True)
class Kernel:
    """The calls to the kernel, as in `os`, `fcntl`, `mmap` and `select`; tests hand in others."""

    open: Callable[[str, int], int] = os.open
    close: Callable[[int], None] = os.close
    ioctl: Callable[[int, int, bytearray], int] = field(
        default_factory=lambda: importlib.import_module("fcntl").ioctl  # not on Windows
    )
    map: Callable[[int, int, int], Any] = field(
        default=lambda file, length, offset: mmap.mmap(file, length, offset=offset)
    )
    select: Callable[..., tuple[Sequence[Any], Sequence[Any], Sequence[Any]]] = select.select
    clock: Clock = SYSTEM

    def ask(self, file: int, number: int, argument: bytearray) -> None:
        """Call `ioctl`, again where a signal came between; OSError if the kernel refuses."""
        while True:
            try:
                self.ioctl(file, number, argument)
            except InterruptedError:
                continue
            return


class Capture(Closing):
    """A camera's node that streams Y16 frames, a `camera.FrameSource`; nothing is reset.

    `decode` reads the metadata of a frame from its telemetry rows. Its identity is the node, name
    and bus of the camera, and the driver with its version, on which a stamp's meaning depends.
    OSError if the node cannot be opened or is busy; ValueError if it gives no Y16, or another
    format or rate.
    """

    is_simulated = False

    def __init__(
        self, path: str, stream: Stream, kernel: Kernel | None = None, decode: Decode | None = None
    ) -> None:
        self.path, self.stream = path, stream
        self.shape, self.frame_rate = stream.shape, stream.frame_rate
        self.telemetry_rows = stream.telemetry_rows
        self._kernel = kernel or Kernel()
        self.clock, self._decode = self._kernel.clock, decode
        self._maps: list[Any] = []
        self._file: int | None = self._kernel.open(path, os.O_RDWR | os.O_NONBLOCK)
        try:
            self.identity: Mapping[str, str] = {"device": path, **self._agree(self._file)}
            self._map_buffers(self._file)
            self._kernel.ask(self._file, STREAMON, bytearray(_TYPE))
        except BaseException:
            self.close()
            raise

    def read(self, timeout: float = FRAME_TIMEOUT) -> Frame:
        """Wait for the next frame, a copy; see `camera.FrameSource.read`."""
        if self._file is None:
            raise SourceLostError(f"No frames from '{self.path}': it is closed.")
        file, buffer, clock = self._file, _buffer(0), self.clock
        deadline = clock() + timeout
        while self._kernel.select([file], [], [], max(0.0, deadline - clock()))[0]:
            if self._taken(file, buffer):
                break
        else:
            raise NoFrameError(f"No frame from '{self.path}' in {timeout} s.")
        try:
            return self._frame(buffer, clock())
        finally:
            self._give_back(file, buffer)

    def close(self) -> None:
        """Stop the stream and close the node; a second call does nothing."""
        if self._file is None:
            return
        file, self._file = self._file, None
        try:
            self._kernel.ask(file, STREAMOFF, bytearray(_TYPE))
        except OSError as error:
            if error.errno != errno.ENODEV:  # unplugged: nothing is left to stop
                raise
        finally:
            for mapped in self._maps:
                mapped.close()
            self._maps.clear()
            self._kernel.close(file)

    def _agree(self, file: int) -> dict[str, str]:
        """Set format and rate; a driver sets the nearest that it can, which is an error here."""
        # The node must give video in the format.
        captures, identity = _capability(file, self._kernel)
        offered = _formats(file, self._kernel) if captures else []
        if Y16 not in offered:
            names = [
                code.to_bytes(4, "little").decode("ascii", "backslashreplace") for code in offered
            ]
            raise ValueError(f"Invalid video node '{self.path}' with {names}. Must offer 'Y16 '.")
        # The format, with every row.
        rows, columns = self.stream.rows, self.shape[1]
        line = _BYTES * columns
        wanted = columns, rows, Y16, _PROGRESSIVE, line, rows * line
        argument = bytearray(FORMAT.pack(CAPTURE, *wanted, 0))
        self._kernel.ask(file, S_FMT, argument)
        agreed = FORMAT.unpack(argument)[1:7]
        if agreed != wanted:
            raise ValueError(
                f"Invalid format of '{self.path}': {agreed} (columns, rows, code, field, bytes of "
                f"a row, bytes of a frame). Must be {wanted}: is the telemetry set as requested?"
            )
        # The rate.
        rate = self.frame_rate
        argument = bytearray(PARAMETERS.pack(CAPTURE, 0, 0, 1000, round(1000 * rate), 0, 0))
        self._kernel.ask(file, S_PARM, argument)
        numerator, denominator = PARAMETERS.unpack(argument)[3:5]
        if numerator == 0 or abs(denominator / numerator - rate) > _RATE_TOLERANCE * rate:
            raise ValueError(
                f"Invalid frame period {numerator}/{denominator} s of '{self.path}'. "
                f"Must be 1/{rate} s."
            )
        return identity

    def _map_buffers(self, file: int) -> None:
        request = bytearray(REQUEST.pack(BUFFERS, CAPTURE, MMAP))
        self._kernel.ask(file, REQBUFS, request)
        for index in range(REQUEST.unpack(request)[0]):
            buffer = _buffer(index)
            self._kernel.ask(file, QUERYBUF, buffer)
            offset, length = BUFFER.unpack(buffer)[9:11]
            self._maps.append(self._kernel.map(file, length, offset))
            self._kernel.ask(file, QBUF, buffer)

    def _taken(self, file: int, buffer: bytearray) -> bool:
        """Take the buffer of a frame; False if it was announced but is missing."""
        try:
            self._kernel.ask(file, DQBUF, buffer)
        except BlockingIOError:
            return False
        except OSError as error:
            if error.errno in _GONE:
                text = f"No more frames from '{self.path}': {error.strerror}."
                raise SourceLostError(text) from error
            raise
        return True

    def _give_back(self, file: int, buffer: bytearray) -> None:
        try:
            self._kernel.ask(file, QBUF, buffer)
        except OSError as error:
            if error.errno not in _GONE:  # else the next `read` reports the loss
                raise

    def _frame(self, buffer: bytearray, host_time: float) -> Frame:
        """Copy a frame out of its buffer and translate the kernel's flags."""
        index, _, used, state, _, seconds, micros, sequence, *_ = BUFFER.unpack(buffer)
        image = np.zeros((self.stream.rows, self.shape[1]), dtype="<u2")
        size = min(used, image.nbytes)
        image.reshape(-1).view(np.uint8)[:size] = np.frombuffer(self._maps[index], np.uint8, size)
        flags = FrameFlag.DRIVER_ERROR if state & _ERROR else GOOD
        flags |= FrameFlag.WRONG_SIZE if used != image.nbytes else GOOD
        flags |= FrameFlag.FOREIGN_CLOCK if state & _CLOCK_MASK != _MONOTONIC else GOOD
        counts, rows, metadata = image.astype(np.uint16, copy=False), None, None
        if self.telemetry_rows:
            counts, rows = counts[: self.shape[0]], counts[self.shape[0] :]
            metadata = self._decode(rows) if self._decode and not flags & DAMAGED else None
        stamp = seconds + _MICRO * micros
        return Frame(counts, stamp, host_time, sequence, flags, rows, metadata)


def open_url(url: str, stream: Stream, decode: Decode | None = None) -> Capture:
    """Open the node of an address ``v4l2:///dev/video0``.

    ValueError if the address is of another kind; OSError on another system than Linux.
    """
    node = parse(url, ("v4l2",)).target
    if not sys.platform.startswith("linux"):
        raise OSError(f"No video on '{sys.platform}'. Must be Linux, for V4L2.")
    return Capture(node, stream, decode=decode)


KIND: Final = CameraKind(open_url)  # of a session's ``kind: y16``


def _capability(file: int, kernel: Kernel) -> tuple[bool, dict[str, str]]:
    """True if the node captures video (others of a camera give metadata), and its identity."""
    capability = bytearray(CAPABILITY.size)
    kernel.ask(file, QUERYCAP, capability)
    *texts, version, _, node = CAPABILITY.unpack(capability)
    driver, card, bus = (text.rstrip(b"\0").decode("utf-8", "backslashreplace") for text in texts)
    release = f"{version >> 16}.{version >> 8 & 0xFF}.{version & 0xFF}"
    identity = {"model": card, "bus": bus, "driver": f"{driver} {release}"}
    return node & _CAPTURES == _CAPTURES, identity


def _formats(file: int, kernel: Kernel) -> list[int]:
    codes: list[int] = []
    while True:
        entry = bytearray(FORMAT_ENTRY.pack(len(codes), CAPTURE, 0, b"", 0))
        try:
            kernel.ask(file, ENUM_FMT, entry)
        except OSError as error:
            if error.errno == errno.EINVAL:  # the end of the list
                return codes
            raise
        codes.append(FORMAT_ENTRY.unpack(entry)[4])


def _buffer(index: int) -> bytearray:
    """Argument for a buffer of this number."""
    return bytearray(BUFFER.pack(index, CAPTURE, 0, 0, 0, 0, 0, 0, MMAP, 0, 0))
