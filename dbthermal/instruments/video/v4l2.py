"""Raw 16-bit frames of a camera on Linux, with the kernel's stamps, numbers and flags.

A thin use of Video4Linux2, in a few calls (see `video.v4l2_calls`). The kernel's
stamp of a frame is on CLOCK_MONOTONIC. That of uvcvideo claims to be of the start of the exposure
(https://docs.kernel.org/userspace-api/media/v4l/buffer.html); likely, unless that module is told to
use the camera's clock, it is of the frame's first packet. Tested with a stand-in for the kernel's
calls, not against a camera.
"""

import errno
import struct
from collections.abc import Callable, Mapping
from typing import Any, Final, Self

import numpy as np

from dbthermal.instruments.camera import (
    DAMAGED,
    FRAME_TIMEOUT,
    GOOD,
    Counts,
    Frame,
    FrameFlag,
    Metadata,
    NoFrameError,
    SourceLostError,
    Stream,
)
from dbthermal.instruments.closing import Closing
from dbthermal.instruments.video import v4l2_calls as calls
from dbthermal.instruments.video.v4l2_calls import Kernel

_ERROR: Final = 0x40  # V4L2_BUF_FLAG_ERROR
_CLOCK_MASK: Final = 0xE000  # V4L2_BUF_FLAG_TIMESTAMP_MASK
_MONOTONIC: Final = 0x2000  # V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC
_GONE: Final = (errno.ENODEV, errno.EIO)
_MICRO: Final = 1e-6
_TYPE: Final = struct.pack("=I", calls.CAPTURE)


class Capture(Closing):
    """
    A camera's node that streams Y16 frames; open one with `Capture.open`.

    It is a `FrameSource` and a context manager, and `close` may be called again. It resets nothing.

    Parameters
    ----------
    path : str
        The node, such as ``"/dev/video0"``.
    stream : Stream
        What to ask of the camera.
    kernel : Kernel, optional
        Calls to the kernel.

    Attributes
    ----------
    identity : mapping
        ``device``, the node, and, once open, ``model``, what the driver calls the camera, ``bus``,
        where it is plugged in, and ``driver``.
    is_simulated : bool
        False.
    """

    is_simulated: Final = False

    def __init__(
        self,
        path: str,
        stream: Stream,
        kernel: Kernel | None = None,
        decode: Callable[[Any], Metadata] | None = None,
    ) -> None:
        self.path, self.stream = path, stream
        self._decode = decode
        self.identity: Mapping[str, str] = {"device": path}
        self._kernel = kernel or Kernel()
        self._file: int | None = None
        self._maps: list[Any] = []

    @classmethod
    def open(
        cls,
        path: str,
        stream: Stream | None = None,
        kernel: Kernel | None = None,
        decode: Callable[[Any], Metadata] | None = None,
    ) -> Self:
        """
        Open a node, agree on format and rate, and start the stream.

        Parameters
        ----------
        path : str
            Such as ``"/dev/video0"``.
        stream : Stream, optional
            What to ask of the camera; 640 x 512 pixels at 60 Hz, without telemetry.
        kernel : Kernel, optional
            Calls to the kernel.
        decode : callable, optional
            Reads the metadata of a frame from its telemetry rows.

        Returns
        -------
        Capture
            Streaming.

        Raises
        ------
        OSError
            If the node cannot be opened, is busy, or this is not Linux.
        ValueError
            If the node gives no Y16, or the driver agrees to another format or rate.
        """
        capture = cls(path, stream or Stream(), kernel, decode)
        capture._start()
        return capture

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the image, without telemetry [pixel]."""
        return self.stream.shape

    @property
    def telemetry_rows(self) -> int:
        """Rows of telemetry that come with each frame."""
        return self.stream.telemetry_rows

    @property
    def frame_rate(self) -> float:
        """Rate that was agreed on [Hz]."""
        return self.stream.frame_rate

    def read(self, timeout: float = FRAME_TIMEOUT) -> Frame:
        """
        Wait for the next frame; see `dbthermal.instruments.camera.FrameSource.read`.

        Parameters
        ----------
        timeout : float
            How long to wait [s].

        Returns
        -------
        Frame
            A copy; the buffer is the kernel's again. Damaged frames say so in their flags.

        Raises
        ------
        NoFrameError
            If none came in time.
        SourceLostError
            If the camera is gone, or this is closed.
        """
        file, buffer = self._opened(), _buffer(0)
        deadline = self._kernel.clock() + timeout
        while self._announced(file, deadline):
            if self._taken(file, buffer):
                break
        else:
            raise NoFrameError(f"No frame from '{self.path}' in {timeout} s.")
        try:
            return self._frame(buffer, self._kernel.clock())
        finally:
            self._give_back(file, buffer)

    def close(self) -> None:
        """Stop the stream and close the node; a second call does nothing."""
        if self._file is None:
            return
        file, self._file = self._file, None
        try:
            self._kernel.ask(file, calls.STREAMOFF, bytearray(_TYPE))
        except OSError as error:
            if error.errno != errno.ENODEV:  # unplugged: there is nothing left to stop
                raise
        finally:
            for memory in self._maps:
                memory.close()
            self._maps.clear()
            self._kernel.close(file)

    def _start(self) -> None:
        self._file = file = calls.open_node(self.path, self._kernel)
        try:
            identity = calls.agree(file, self.path, self.stream, self._kernel)
            self.identity = {"device": self.path, **identity}
            self._map_buffers(file)
            self._kernel.ask(file, calls.STREAMON, bytearray(_TYPE))
        except BaseException:
            self.close()
            raise

    def _map_buffers(self, file: int) -> None:
        request = bytearray(calls.REQUEST.pack(calls.BUFFERS, calls.CAPTURE, calls.MMAP))
        self._kernel.ask(file, calls.REQBUFS, request)
        for index in range(calls.REQUEST.unpack(request)[0]):
            buffer = _buffer(index)
            self._kernel.ask(file, calls.QUERYBUF, buffer)
            offset, length = calls.BUFFER.unpack(buffer)[9:11]
            self._maps.append(self._kernel.map(file, length, offset))
            self._kernel.ask(file, calls.QBUF, buffer)

    def _opened(self) -> int:
        if self._file is None:
            raise SourceLostError(f"No frames from '{self.path}': it is closed.")
        return self._file

    def _announced(self, file: int, deadline: float) -> bool:
        wait = max(0.0, deadline - self._kernel.clock())
        return bool(self._kernel.select([file], [], [], wait)[0])

    def _taken(self, file: int, buffer: bytearray) -> bool:
        """Take the buffer of a frame; False if none is there, though it was announced."""
        try:
            self._kernel.ask(file, calls.DQBUF, buffer)
        except BlockingIOError:
            return False
        except OSError as error:
            if error.errno not in _GONE:
                raise
            message = f"No more frames from '{self.path}': {error.strerror}."
            raise SourceLostError(message) from error
        return True

    def _give_back(self, file: int, buffer: bytearray) -> None:
        try:
            self._kernel.ask(file, calls.QBUF, buffer)
        except OSError as error:
            if error.errno not in _GONE:  # else the next `read` tells that this frame was the last
                raise

    def _frame(self, buffer: bytearray, host_time: float) -> Frame:
        """Copy a frame out of its buffer and translate what the kernel says of it."""
        index, _, used, said, _, seconds, micros, sequence, *_ = calls.BUFFER.unpack(buffer)
        image = np.zeros((self.stream.rows, self.shape[1]), dtype="<u2")
        size = min(used, image.nbytes)
        image.reshape(-1).view(np.uint8)[:size] = np.frombuffer(self._maps[index], np.uint8, size)
        flags = FrameFlag.DRIVER_ERROR if said & _ERROR else GOOD
        flags |= FrameFlag.WRONG_SIZE if used != image.nbytes else GOOD
        flags |= FrameFlag.FOREIGN_CLOCK if said & _CLOCK_MASK != _MONOTONIC else GOOD
        counts, telemetry = _split(image.astype(np.uint16, copy=False), self.stream)
        whole = telemetry is not None and not flags & DAMAGED
        metadata = self._decode(telemetry) if self._decode and whole else None
        time = seconds + _MICRO * micros
        return Frame(counts, time, host_time, sequence, flags, telemetry, metadata)


def _buffer(index: int) -> bytearray:
    """Argument for a buffer of this number."""
    return bytearray(calls.BUFFER.pack(index, calls.CAPTURE, 0, 0, 0, 0, 0, 0, calls.MMAP, 0, 0))


def _split(image: Counts, stream: Stream) -> tuple[Counts, Counts | None]:
    """Image, and telemetry rows if there are."""
    rows = stream.telemetry_rows
    if rows == 0:
        return image, None
    return (
        (image[rows:], image[:rows]) if stream.telemetry_first else (image[:-rows], image[-rows:])
    )
