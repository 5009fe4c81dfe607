"""Raw 16-bit frames (Y16) of any camera on Linux, with the kernel's stamps, numbers and flags.

A thin use of Video4Linux2, in ten calls; numbers, sizes and layouts are those of 64-bit Linux
(``linux/videodev2.h``, https://docs.kernel.org/userspace-api/media/v4l). The kernel's stamp of a
frame is on CLOCK_MONOTONIC. That of uvcvideo claims to be of the start of the exposure; likely,
unless that module is told to use the camera's clock, it is of the frame's first packet.

`KIND` is a camera without command port or telemetry: the state of its shutter follows from frozen
images, see `camera.next_shutter`.
"""

import errno
import importlib
import mmap
import os
import select
import struct
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from dbthermal.instruments import camera
from dbthermal.instruments.camera import Counts, Frame, FrameFlag, Metadata, Stream
from dbthermal.instruments.transport import SYSTEM, Clock, Closing, parse

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
_TYPE = struct.Struct("=I")

_CAPTURE: Final = 1  # V4L2_BUF_TYPE_VIDEO_CAPTURE
_MMAP: Final = 1  # V4L2_MEMORY_MMAP
_PROGRESSIVE: Final = 1  # V4L2_FIELD_NONE
_CAPTURES: Final = 0x04000001  # V4L2_CAP_VIDEO_CAPTURE | V4L2_CAP_STREAMING
_ERROR: Final = 0x40  # V4L2_BUF_FLAG_ERROR
_CLOCK_MASK: Final = 0xE000  # V4L2_BUF_FLAG_TIMESTAMP_MASK
_MONOTONIC: Final = 0x2000  # V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC
_GONE: Final = (errno.ENODEV, errno.EIO)
_BYTES: Final = 2  # of a pixel
_RATE_TOLERANCE: Final = 1e-3

Decode = Callable[[Counts], Metadata]


@dataclass(frozen=True)
class Kernel:
    """The calls to the kernel, as in `os`, `fcntl`, `mmap` and `select`; tests hand in others."""

    open: Callable[[str, int], int] = os.open
    close: Callable[[int], None] = os.close
    ioctl: Callable[[int, int, bytearray], int] = field(
        default_factory=lambda: importlib.import_module("fcntl").ioctl  # not on Windows
    )
    map: Callable[..., Any] = mmap.mmap
    select: Callable[..., tuple[Sequence[Any], Sequence[Any], Sequence[Any]]] = select.select
    clock: Clock = SYSTEM


class Capture(Closing):
    """A camera's node that streams Y16 frames, a `camera.FrameSource`; nothing is reset.

    OSError if the node cannot be opened or is busy; ValueError if it gives no Y16, or another
    format or rate. `decode` reads the metadata of a frame from its telemetry rows.
    """

    is_simulated = False

    def __init__(
        self, path: str, stream: Stream, kernel: Kernel | None = None, decode: Decode | None = None
    ) -> None:
        self.path, self._decode = path, decode
        self.shape, self.frame_rate = stream.shape, stream.frame_rate
        self.telemetry_rows = stream.telemetry_rows
        self._form = stream.shape[0] + stream.telemetry_rows, stream.shape[1]  # of a whole frame
        self._kernel = kernel or Kernel()
        self.clock = self._kernel.clock
        self._maps: list[Any] = []
        self._file: int | None = self._kernel.open(path, os.O_RDWR | os.O_NONBLOCK)
        try:
            self.identity: Mapping[str, str] = {"device": path, **self._capability()}
            self._agree()
            # Buffers, as many as the kernel grants, all of them queued.
            (count, *_) = self._ask(REQBUFS, REQUEST, BUFFERS, _CAPTURE, _MMAP)
            for index in range(count):
                offset, length = self._ask(QUERYBUF, BUFFER, *_buffer(index))[9:]
                self._maps.append(self._kernel.map(self._file, length, offset=offset))
                self._ask(QBUF, BUFFER, *_buffer(index))
            self._ask(STREAMON, _TYPE, _CAPTURE)
        except BaseException:
            self.close()
            raise

    def read(self, timeout: float = camera.FRAME_TIMEOUT) -> Frame:
        """Wait for the next frame, a copy; see `camera.FrameSource.read`."""
        if self._file is None:
            raise camera.SourceLostError(f"No frames from '{self.path}': it is closed.")
        deadline = self.clock() + timeout
        # Until a frame is announced, and is there.
        while self._kernel.select([self._file], [], [], max(0.0, deadline - self.clock()))[0]:
            try:
                buffer = self._ask(DQBUF, BUFFER, *_buffer(0))
            except BlockingIOError:
                if self.clock() < deadline:
                    continue  # announced, and missing
                break
            except OSError as error:
                if error.errno not in _GONE:
                    raise
                text = f"No more frames from '{self.path}': {error.strerror}."
                raise camera.SourceLostError(text) from error
            # A copy of it; the buffer goes back to the kernel whatever happens.
            try:
                return self._frame(buffer, self.clock())
            finally:
                try:
                    self._ask(QBUF, BUFFER, *_buffer(buffer[0]))
                except OSError as error:
                    if error.errno not in _GONE:  # else the next `read` reports the loss
                        raise
        raise camera.NoFrameError(f"No frame from '{self.path}' in {timeout} s.")

    def close(self) -> None:
        """Stop the stream and close the node; a second call does nothing."""
        if self._file is None:
            return
        try:
            self._ask(STREAMOFF, _TYPE, _CAPTURE)
        except OSError as error:
            if error.errno != errno.ENODEV:  # unplugged: nothing is left to stop
                raise
        finally:
            file, self._file = self._file, None
            for mapped in self._maps:
                mapped.close()
            self._maps.clear()
            self._kernel.close(file)

    def _ask(self, number: int, layout: struct.Struct, *values: Any) -> tuple[Any, ...]:
        """Answer to a call, made again where a signal came between; OSError if it is refused."""
        if self._file is None:
            raise camera.SourceLostError(f"No frames from '{self.path}': it is closed.")
        argument = bytearray(layout.pack(*values))
        while True:
            with suppress(InterruptedError):
                self._kernel.ioctl(self._file, number, argument)
                return layout.unpack(argument)

    def _capability(self) -> dict[str, str]:
        """Identity of the node, which must give video in the format."""
        *texts, version, _, node = self._ask(QUERYCAP, CAPABILITY, b"", b"", b"", 0, 0, 0)
        offered: list[int] = []
        while node & _CAPTURES == _CAPTURES:  # others of a camera's nodes give metadata
            try:
                entry = self._ask(ENUM_FMT, FORMAT_ENTRY, len(offered), _CAPTURE, 0, b"", 0)
            except OSError as error:
                if error.errno == errno.EINVAL:  # the end of the list
                    break
                raise
            offered.append(entry[4])
        # It must offer the format.
        if Y16 not in offered:
            codes = [code.to_bytes(4, "little") for code in offered]
            names = [code.decode("ascii", "backslashreplace") for code in codes]
            raise ValueError(f"Invalid video node '{self.path}' with {names}. Must offer 'Y16 '.")
        texts = [raw.rstrip(b"\0").decode("utf-8", "backslashreplace") for raw in texts]
        driver, model, bus = texts
        release = f"{version >> 16}.{version >> 8 & 0xFF}.{version & 0xFF}"
        return {"model": model, "bus": bus, "driver": f"{driver} {release}"}

    def _agree(self) -> None:
        """Set format and rate; a driver sets the nearest that it can, which is an error here."""
        # The format, with every row.
        rows, columns = self._form
        line = _BYTES * columns
        wanted = columns, rows, Y16, _PROGRESSIVE, line, rows * line
        agreed = self._ask(S_FMT, FORMAT, _CAPTURE, *wanted, 0)[1:7]
        if agreed != wanted:
            raise ValueError(
                f"Invalid format of '{self.path}': {agreed} (columns, rows, code, field, bytes of "
                f"a row, bytes of a frame). Must be {wanted}: is the telemetry set as requested?"
            )
        # The rate.
        rate = self.frame_rate
        period = 1000, round(1000 * rate)
        numerator, denominator = self._ask(S_PARM, PARAMETERS, _CAPTURE, 0, 0, *period, 0, 0)[3:5]
        if numerator == 0 or abs(denominator / numerator - rate) > _RATE_TOLERANCE * rate:
            period_text = f"Invalid frame period {numerator}/{denominator} s of '{self.path}'"
            raise ValueError(f"{period_text}. Must be 1/{rate} s.")

    def _frame(self, buffer: tuple[int, ...], host_time: float) -> Frame:
        """Copy a frame out of its buffer and translate the kernel's flags."""
        index, _, used, state, _, seconds, micros, sequence, *_ = buffer
        # The image, with zeros in place of missing bytes.
        image = np.zeros(self._form, dtype="<u2")
        size = min(used, image.nbytes)
        image.reshape(-1).view(np.uint8)[:size] = np.frombuffer(self._maps[index], np.uint8, size)
        # The state of the frame and of its stamp.
        flags = FrameFlag.DRIVER_ERROR if state & _ERROR else camera.GOOD
        flags |= FrameFlag.WRONG_SIZE if used != image.nbytes else camera.GOOD
        flags |= FrameFlag.FOREIGN_CLOCK if state & _CLOCK_MASK != _MONOTONIC else camera.GOOD
        # Image and telemetry apart.
        counts, rows, metadata = image.astype(np.uint16, copy=False), None, None
        if self.telemetry_rows:
            counts, rows = counts[: self.shape[0]], counts[self.shape[0] :]
            metadata = self._decode(rows) if self._decode and not flags & camera.DAMAGED else None
        return Frame(counts, seconds + 1e-6 * micros, host_time, sequence, flags, rows, metadata)


def _buffer(index: int) -> tuple[int, ...]:
    """Argument for a buffer of this number, see `BUFFER`."""
    return index, _CAPTURE, 0, 0, 0, 0, 0, 0, _MMAP, 0, 0


def open_url(url: str, stream: Stream, decode: Decode | None = None) -> Capture:
    """Open the node of an address ``v4l2:///dev/video0``; ValueError, OSError if not on Linux."""
    node = parse(url, "v4l2")
    if not sys.platform.startswith("linux"):
        raise OSError(f"No video on '{sys.platform}'. Must be Linux, for V4L2.")
    return Capture(node, stream, decode=decode)


KIND: Final = camera.CameraKind(open_url)  # of a session's ``kind: y16``
