"""The Boson's line: threads, ends, and waits for what is slow or lost."""

import struct
import threading
import time
from collections.abc import Callable

import pytest
from device_benches import BosonBench
from dialogue import Dialogue, Pair
from faulty_boson import Fault
from test_boson import reply

from dbthermal.instruments import _fslp as fslp
from dbthermal.instruments.boson import (
    REPLY_TIMEOUT,
    Boson,
    BosonError,
    commands,
)
from dbthermal.instruments.camera import FfcStatus
from dbthermal.instruments.clock import SYSTEM
from dbthermal.instruments.transport import Closing, TransportError


def in_thread(work: Callable[[], object]) -> threading.Thread:
    """Start a thread."""
    thread = threading.Thread(target=work)
    thread.start()
    return thread


def test_a_correction_that_is_slow_to_start_is_waited_for() -> None:
    """The camera still says that the last correction is complete: not that of this one."""
    asked: list[tuple[int, bytes]] = [
        (commands.LAST_FFC_FRAME.command, struct.pack(">I", 700)),
        (commands.FFC_STATUS.command, struct.pack(">i", FfcStatus.COMPLETE)),
        (commands.RUN_FFC, b""),
    ]
    for frame in (700, 700, 1234):
        asked += [
            (commands.FFC_IN_PROGRESS.command, b"\x00\x00"),
            (commands.FFC_STATUS.command, struct.pack(">i", FfcStatus.COMPLETE)),
            (commands.LAST_FFC_FRAME.command, struct.pack(">I", frame)),
        ]
    pairs: list[Pair] = [
        (fslp.encode(number, command), reply(number, command, data))
        for number, (command, data) in enumerate(asked, start=1)
    ]
    with Dialogue(pairs) as line:
        camera = Boson(line, first_sequence=1)
        assert camera.run_ffc() == 1234


def test_a_mute_camera_ends_a_wait_in_time() -> None:
    """A wait for a correction outlasts its limit by one reply at most, not by three repeated."""
    bench = BosonBench()
    bench.camera.run_ffc()
    bench.spoil(None, None, None, *[Fault.DROP] * 99)
    start = bench.clock.now
    with pytest.raises(BosonError, match="No flat-field correction within 3 s"):
        bench.camera.run_ffc(timeout=3.0)
    assert bench.clock.now - start <= 3.0 + REPLY_TIMEOUT + 0.2


def test_each_program_begins_at_another_number() -> None:
    """The first sequence number depends on the time of day, which identifies stale replies."""
    asked = []
    for later in (0.0, 0.1):
        line = Dialogue([])
        line.clock.sleep(later)
        with pytest.raises(AssertionError, match="Must be nothing more") as sent:
            Boson(line).serial_number()
        asked.append(str(sent.value))
    assert asked[0] != asked[1]


class Slow(Closing):
    """
    A camera that answers with a delay, and notes requests before its answer.

    Attributes
    ----------
    overlaps : int
        Requests that came before the last was answered, or after the line was closed.
    """

    is_simulated, clock = True, SYSTEM

    def __init__(self) -> None:
        self.overlaps = 0
        self.reading = threading.Event()
        self._answers: list[bytes] = []
        self._closed = False

    def write(self, data: bytes) -> None:
        """Take one request."""
        if self._closed:
            raise TransportError("closed")
        self.overlaps += bool(self._answers)
        (frame,) = fslp.Decoder().feed(data)
        self._answers.append(
            reply(frame.sequence, frame.command, bytes(4 if frame.command == 0x00050002 else 2))
        )

    def read(self, size: int, timeout: float) -> bytes:  # noqa: ARG002 - as a line has
        """Answer."""
        self.reading.set()
        time.sleep(0.002)
        self.overlaps += self._closed
        return self._answers.pop(0)

    def close(self) -> None:
        """End."""
        self._closed = True


def test_threads_take_turns() -> None:
    """Two threads that ask at once each get their reply, one exchange after the other."""
    line = Slow()
    camera = Boson(line)
    threads = [
        in_thread(lambda: [camera.serial_number() for _ in range(20)]),
        in_thread(lambda: [camera.fpa_temperature() for _ in range(20)]),
    ]
    for thread in threads:
        thread.join()
    assert line.overlaps == 0


def test_closing_waits_for_an_exchange_of_another_thread() -> None:
    """The line is closed between two exchanges, and the next one is an error that is documented."""
    line = Slow()
    errors: list[TransportError] = []

    def ask() -> None:
        try:
            while True:
                camera.serial_number()
                time.sleep(0.001)
        except TransportError as error:
            errors.append(error)

    camera = Boson(line)
    thread = in_thread(ask)
    line.reading.wait()
    camera.close()
    thread.join()
    assert (len(errors), line.overlaps) == (1, 0)


def test_a_camera_may_be_closed_twice() -> None:
    """A second close does nothing."""
    camera = Boson(Slow())
    for _ in range(2):
        camera.close()
    with pytest.raises(TransportError):
        camera.serial_number()
