"""Capture by Video4Linux2: calls to the kernel, and frames with its stamps and flags."""

import ctypes
import errno
import mmap
import struct
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from faulty_camera import frames
from faulty_devices import clock_at
from hypothesis import given
from hypothesis import strategies as st
from refused import assert_raises, assert_refused

from dbthermal import correction
from dbthermal.instruments import v4l2
from dbthermal.instruments.camera import FrameFlag, NoFrameError, SourceLostError, Stream
from dbthermal.instruments.devices import open_devices
from dbthermal.instruments.emulated import FFC_DURATION
from dbthermal.instruments.protocols import record_scene
from dbthermal.instruments.recording import Limits, open_capture
from dbthermal.instruments.session import Session

STREAM = Stream(shape=(4, 6), telemetry_rows=2)
BYTES = 2 * 6 * 6
GOOD = 0x12000  # stamp of the monotonic clock, of the start of exposure


@dataclass
class Driver:
    """Stands in for the kernel: a node with a format, a rate and frames to give."""

    formats: tuple[int, ...] = (0x32315559, v4l2.Y16)
    capabilities: int = 0x04200001
    rows: int = 6
    rate: int = 60
    answers: list[tuple[int, int, int, int]] = field(default_factory=list)
    calls: list[int] = field(default_factory=list)
    maps: list[mmap.mmap] = field(default_factory=list)
    queued: list[int] = field(default_factory=list)
    files: set[int] = field(default_factory=set)  # that are open
    lost: int = 0
    lost_at: tuple[int, ...] = (v4l2.DQBUF, v4l2.STREAMOFF)
    signals: int = 0

    def kernel(self) -> v4l2.Kernel:
        """Calls to this driver."""
        return v4l2.Kernel(
            open=self._open,
            close=self.files.remove,
            ioctl=self._ioctl,
            map=self._map,
            select=lambda *_: ([3], [], []) if self.answers or self.lost else ([], [], []),
            clock=clock_at(12.5),
        )

    def _open(self, *_: object) -> int:
        self.files.add(3)
        return 3

    def _map(self, file: int, length: int, offset: int) -> mmap.mmap:
        assert (file, offset) == (3, 4096 * len(self.maps))
        self.maps.append(mmap.mmap(-1, length))
        return self.maps[-1]

    def _ioctl(self, file: int, number: int, argument: bytearray) -> int:
        assert file == 3
        if self.signals:
            self.signals -= 1
            raise InterruptedError(errno.EINTR, "Interrupted system call")
        self.calls.append(number)
        if self.lost and number in self.lost_at:
            raise OSError(self.lost, "No such device")
        self._reply(number, argument, struct.unpack_from("=I", argument)[0])
        return 0

    def _reply(self, number: int, argument: bytearray, index: int) -> None:
        match number:
            case v4l2.QUERYCAP:
                names = b"uvcvideo", b"Boson: FLIR Video", b"usb-1.2"
                argument[:] = v4l2.CAPABILITY.pack(*names, 0x60C05, 0, self.capabilities)
            case v4l2.ENUM_FMT if index >= len(self.formats):
                raise OSError(errno.EINVAL, "Invalid argument")
            case v4l2.ENUM_FMT:
                argument[:] = v4l2.FORMAT_ENTRY.pack(index, 1, 0, b"", self.formats[index])
            case v4l2.S_FMT:
                kind, columns, _, code, place, line, _, space = v4l2.FORMAT.unpack(argument)
                form = (kind, columns, self.rows, code, place, line, self.rows * line, space)
                argument[:] = v4l2.FORMAT.pack(*form)
            case v4l2.S_PARM:
                argument[:] = v4l2.PARAMETERS.pack(1, 0, 0, 1, self.rate, 0, 0)
            case v4l2.QUERYBUF:
                place = 4096 * index
                argument[:] = v4l2.BUFFER.pack(index, 1, 0, 0, 0, 0, 0, 0, 1, place, BYTES)
            case v4l2.QBUF:
                self.queued.append(index)
            case v4l2.DQBUF:
                used, flags, micros, number = self.answers.pop(0)
                if used < 0:
                    raise BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")
                index = self.queued.pop(0)
                self.maps[index][:] = np.arange(number, number + BYTES // 2, dtype="<u2").tobytes()
                values = index, 1, used, flags, 1, 7, micros, number, 1, 4096 * index, BYTES
                argument[:] = v4l2.BUFFER.pack(*values)


def opened(driver: Driver) -> v4l2.Capture:
    """Open the node of a driver."""
    return v4l2.Capture("/dev/video0", STREAM, driver.kernel())


# Numbers of the calls in `linux/videodev2.h`: direction (1 write, 2 read, 3 both), number, size.
CALLS = [
    *((v4l2.QUERYCAP, 2, 0, 104), (v4l2.ENUM_FMT, 3, 2, 64), (v4l2.S_FMT, 3, 5, 208)),
    *((v4l2.REQBUFS, 3, 8, 20), (v4l2.QUERYBUF, 3, 9, 88), (v4l2.QBUF, 3, 15, 88)),
    *((v4l2.DQBUF, 3, 17, 88), (v4l2.STREAMON, 1, 18, 4), (v4l2.STREAMOFF, 1, 19, 4)),
    (v4l2.S_PARM, 3, 22, 204),
]
UNREAD = {"timecode", "reserved2", "request_fd"}


class Buffer(ctypes.Structure):
    """``struct v4l2_buffer`` as in ``linux/videodev2.h``, laid out by the compiler's rules."""

    _fields_ = (
        *((name, ctypes.c_uint32) for name in ("index", "type", "bytesused", "flags", "field")),
        *((name, ctypes.c_int64) for name in ("seconds", "microseconds")),  # struct timeval
        ("timecode", ctypes.c_uint32 * 4),
        *((name, ctypes.c_uint32) for name in ("sequence", "memory")),
        ("offset", ctypes.c_uint64),  # union with a pointer
        *((name, ctypes.c_uint32) for name in ("length", "reserved2", "request_fd")),
    )


def test_calls_have_the_kernels_numbers_and_layouts() -> None:
    """Each call and each number of a buffer is where a C compiler on 64-bit Linux puts it."""
    for call, direction, number, size in CALLS:
        assert call == direction << 30 | size << 16 | ord("V") << 8 | number
    layouts = v4l2.CAPABILITY, v4l2.FORMAT, v4l2.BUFFER, v4l2.PARAMETERS
    assert [layout.size for layout in layouts] == [104, 208, ctypes.sizeof(Buffer), 204]
    buffer = Buffer.from_buffer_copy(v4l2.BUFFER.pack(*range(1, 12)))
    names = [entry[0] for entry in Buffer._fields_ if entry[0] not in UNREAD]
    assert [getattr(buffer, name) for name in names] == list(range(1, 12))


def test_frames_come_in_order_with_stamp_number_and_telemetry() -> None:
    """Image and telemetry apart, both clocks, the number; each buffer goes back to the kernel."""
    driver = Driver(answers=[(BYTES, GOOD, 250_000, number) for number in range(20)])
    with opened(driver) as capture:
        first, *later_frames = frames(capture, 20)
        for memory in driver.maps:  # the kernel may write its buffers again: frames stay
            memory[:] = bytes(BYTES)
    np.testing.assert_array_equal(first.counts.ravel(), np.arange(24))
    assert first.telemetry is not None
    np.testing.assert_array_equal(first.telemetry.ravel(), np.arange(24, 36))
    assert (first.device_time, first.host_time, first.sequence, first.flags) == (7.25, 12.5, 0, 0)
    assert [frame.sequence for frame in later_frames] == list(range(1, 20))
    texts = "/dev/video0", "Boson: FLIR Video", "usb-1.2", "uvcvideo 6.12.5"
    assert capture.identity == dict(zip(("device", "model", "bus", "driver"), texts, strict=True))
    assert driver.calls == [
        *(v4l2.QUERYCAP, *(3 * [v4l2.ENUM_FMT]), v4l2.S_FMT, v4l2.S_PARM, v4l2.REQBUFS),
        *(v4l2.BUFFERS * [v4l2.QUERYBUF, v4l2.QBUF]),
        *(v4l2.STREAMON, *(20 * [v4l2.DQBUF, v4l2.QBUF]), v4l2.STREAMOFF),
    ]


@pytest.mark.parametrize(
    ("used", "flags", "expected"),
    [
        (BYTES, GOOD | 0x40, FrameFlag.DRIVER_ERROR),
        (10, GOOD, FrameFlag.WRONG_SIZE),
        (0, GOOD | 0x40, FrameFlag.WRONG_SIZE | FrameFlag.DRIVER_ERROR),
        (BYTES + 2, GOOD, FrameFlag.WRONG_SIZE),
        (BYTES, 0x4000, FrameFlag.FOREIGN_CLOCK),
    ],
)
def test_damage_is_told(used: int, flags: int, expected: FrameFlag) -> None:
    """A damaged frame has its flags, and zeros in place of missing bytes."""
    with opened(Driver(answers=[(used, flags, 0, 5)])) as capture:
        frame = capture.read()
    assert frame.flags == expected
    assert np.count_nonzero(frame.counts) == min(used // 2, 24)


def test_no_frame_in_time() -> None:
    """An announced frame that is missing is no lost frame."""
    driver = Driver(answers=[(-1, 0, 0, 0)])
    with opened(driver) as capture:
        assert_raises(NoFrameError, "No frame from '/dev/video0'", capture.read, 0.1)
        driver.answers = [(-1, 0, 0, 0), (BYTES, GOOD, 0, 5)]  # announced, and there a little later
        assert capture.read(0.1).sequence == 5


def test_frames_that_are_never_there_do_not_prolong_the_wait() -> None:
    """A driver that announces frames without end, and has none, ends a read at its time limit."""
    driver = Driver(answers=[(-1, 0, 0, 0)] * 200)
    kernel = driver.kernel()

    def select(*_: object) -> tuple[list[int], list[int], list[int]]:
        kernel.clock.sleep(0.01)
        return [3], [], []

    with v4l2.Capture("/dev/video0", STREAM, replace(kernel, select=select)) as capture:
        assert_raises(NoFrameError, "No frame from '/dev/video0'", capture.read, 0.1)
        assert len(driver.answers) > 180


def test_unplugging_is_told_and_close_still_works() -> None:
    """The last frame before unplugging is returned, then reads are errors; the node is closed."""
    driver = Driver(answers=[(BYTES, GOOD, 0, 5)])
    capture = opened(driver)
    driver.lost, driver.lost_at = errno.ENODEV, (v4l2.QBUF,)
    assert capture.read().sequence == 5
    driver.lost_at = (v4l2.DQBUF, v4l2.STREAMOFF)
    with pytest.raises(SourceLostError, match="No more frames from '/dev/video0': No such device"):
        capture.read()
    for _ in range(2):
        capture.close()
    assert driver.files == set()
    assert all(memory.closed for memory in driver.maps)
    assert_raises(SourceLostError, "it is closed", capture.read)


def test_buffer_goes_back_whatever_happens(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither an error while a frame is copied nor a signal takes a buffer from the kernel."""
    driver = Driver(answers=[(BYTES, GOOD, 0, number) for number in range(2)], signals=3)
    with opened(driver) as capture:
        with monkeypatch.context() as patch:
            patch.setattr(v4l2, "Frame", lambda *_: 1 / 0)
            with pytest.raises(ZeroDivisionError):
                capture.read()
        assert sorted(driver.queued) == list(range(v4l2.BUFFERS))
        driver.signals = 2
        assert capture.read().sequence == 1
        driver.signals = 1
    assert driver.files == set()


@pytest.mark.parametrize(
    ("driver", "message"),
    [
        (Driver(formats=(0x32315559,)), r"with \['YU12'\]\. Must offer 'Y16 '"),
        (Driver(capabilities=0x04A00000), r"with \[\]\. Must offer 'Y16 '"),
        (Driver(rows=4), r"Must be \(6, 6, .* is the telemetry set as requested"),
        (Driver(rate=30), r"Invalid frame period 1/30 s of '/dev/video0'\. Must be 1/60\.0 s"),
        (Driver(rate=0), "Invalid frame period 1/0 s"),
    ],
)
def test_other_streams_are_refused(driver: Driver, message: str) -> None:
    """A format or rate other than the requested one raises a ValueError, and the node is closed."""
    assert_refused(message, opened, driver)
    assert driver.files == set()


def test_other_systems_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Elsewhere than on Linux opening is a clear error."""
    monkeypatch.setattr(sys, "platform", "darwin")
    with pytest.raises(OSError, match=r"No video on 'darwin'\. Must be Linux"):
        v4l2.open_url("v4l2:///dev/video0", STREAM)


numbers = st.tuples(*(st.integers(0, highest) for highest in (2**31, 2**32 - 1, 10**6 - 1, 60_000)))


@given(st.lists(numbers, max_size=20))
def test_whatever_the_kernel_says_is_a_frame(answers: list[tuple[int, int, int, int]]) -> None:
    """Any sizes, flags and numbers give frames of the agreed shape, with the kernel's numbers."""
    with opened(Driver(answers=[*answers])) as capture:
        for answer in answers:
            frame = capture.read()
            assert (frame.sequence, frame.counts.shape) == (answer[3], (4, 6))
            assert (answer[0] != BYTES) == (FrameFlag.WRONG_SIZE in frame.flags)


RATE = 50.0


def session(**changes: object) -> Session:
    """The session of the parameters, with few pixels."""
    file = Path(__file__).parents[2] / "params" / "sessions" / "y16.yaml"
    return Session.load(file, {"shape": [16, 80], **changes})


def test_hardware_gives_frames_without_telemetry(monkeypatch: pytest.MonkeyPatch) -> None:
    """All rows of a frame are image, and the identity comes from the kernel alone."""
    kernel = Driver(answers=[(BYTES, GOOD, 1000, 7)]).kernel()
    monkeypatch.setattr(v4l2, "Kernel", lambda: kernel)
    with v4l2.KIND.open_frames("v4l2:///dev/video0", Stream((6, 8))) as source:
        frame = source.read()
    assert (frame.counts.shape, frame.telemetry, frame.metadata) == ((6, 8), None, None)
    assert (frame.sequence, {*source.identity}) == (7, {"device", "model", "bus", "driver"})
    with pytest.raises(ValueError, match=r"Invalid address 'serial:///dev/ttyACM0'\. Must"):
        v4l2.KIND.open_frames("serial:///dev/ttyACM0", Stream())


def test_it_has_neither_telemetry_nor_command_port() -> None:
    """A session with telemetry or a command port raises an error before a device is opened."""
    assert_refused(
        r"telemetry_rows of band '8-14', a y16, 2\. Must be one of", session, telemetry_rows=2
    )
    plain = session()
    with pytest.raises(ValueError, match="Invalid control of kind 'y16', which has none"):
        replace(plain.cameras["8-14"], control="serial:///dev/ttyACM0")


def test_its_shutter_is_told_by_frozen_images(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A correction of its own is flagged from the third copy on, and found whole afterwards."""
    models = {"y16": ("emulated Y16 camera", 1.0)}  # corrects its offsets every second
    monkeypatch.setattr("dbthermal.instruments.emulated.MODELS", models)
    camera = {"kind": "y16", "video": "v4l2:///dev/video0"}
    short = session(cameras={"8-14": camera}, duration=1.8, frame_rate=RATE)
    with open_devices(short) as devices:
        identity = devices.identities()["8-14"]
        assert (identity["device"], identity["model"]) == ("sim://y16/8-14", "emulated Y16 camera")
        record_scene(devices, tmp_path / "a.zarr", limits=Limits(reserve=0))
    capture = open_capture(tmp_path / "a.zarr")
    repeated = (capture["frame_flags"] & int(FrameFlag.IMAGE_REPEATED)) != 0
    closed = (capture["frame_flags"] & int(FrameFlag.SHUTTER_CLOSED)) != 0
    frozen = np.count_nonzero(repeated)
    assert 10 < frozen <= FFC_DURATION * RATE + 1
    assert np.count_nonzero(closed) == frozen - 2
    assert not np.any(closed & ~repeated)
    events = correction.find_shutter(capture, closed=closed)
    assert (events["renewed"].all(), *events["frames"].values) == (True, frozen)
