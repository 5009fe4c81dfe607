"""Byte streams: names, pseudo-terminals, unplugging, dialogues and recordings."""

import io
import json
import math
import subprocess
import sys
from collections.abc import Iterator

import pytest

from dbthermal.instruments.dialogue import Dialogue, Pair, Recording
from dbthermal.instruments.emulated.port import EmulatedPort, Loop
from dbthermal.instruments.transport import SerialTransport, TransportError, open_serial

AWKWARD = bytes.fromhex("8E 0A 0D 11 13 00 FF AE 03 04 1A 7F")


class Echo:
    """A device that says what it is told."""

    def __init__(self) -> None:
        self.plugged = True
        self.said: list[bytes] = []

    def receive(self, data: bytes) -> None:
        """Take in bytes."""
        self.said.append(data)

    def poll(self) -> list[bytes]:
        """Give them back."""
        said, self.said = self.said, []
        return said

    def next_due(self) -> float:
        """Nothing comes by itself."""
        return math.inf


@pytest.fixture
def port() -> Iterator[EmulatedPort]:
    """A pseudo-terminal with an echo."""
    with EmulatedPort(Echo()) as port:
        yield port


@pytest.fixture
def line(port: EmulatedPort) -> Iterator[SerialTransport]:
    """A transport to the echo."""
    with open_serial(f"pty://{port.path}", baudrate=115200) as line:
        yield line


def read_all(line: SerialTransport, size: int) -> bytes:
    """Read until `size` bytes are there or one second brings none."""
    received = b""
    while len(received) < size and (piece := line.read(4096, 1.0)):
        received += piece
    return received


def test_a_pseudo_terminal_changes_no_byte(line: SerialTransport) -> None:
    """Line ends, flow control and end-of-file bytes pass unchanged."""
    line.write(AWKWARD)
    assert read_all(line, len(AWKWARD)) == AWKWARD


def test_reads_are_short_and_time_out(line: SerialTransport) -> None:
    """A read gives at most what is asked for, and nothing once its time is up."""
    line.write(b"abc")
    assert line.read(1, 1.0) == b"a"
    assert read_all(line, 2) == b"bc"
    assert line.read(1, 0.0) == b""


def test_a_device_is_not_blocked_by_a_driver_that_does_not_read(line: SerialTransport) -> None:
    """More than the terminal's buffer holds is kept until it is read."""
    for _ in range(20):
        line.write(bytes(1000))
    assert read_all(line, 20_000) == bytes(20_000)


def test_an_unplugged_device_is_an_error_with_its_name(port: EmulatedPort) -> None:
    """Pulling the plug ends reads and writes with the name of the port, not with silence."""
    with open_serial(f"pty://{port.path}", baudrate=115200) as line:
        port.device.plugged = False  # type: ignore[misc]
        with pytest.raises(TransportError, match=f"Could not read from 'pty://{port.path}'"):
            line.read(1, 2.0)
        with pytest.raises(TransportError, match="must stay connected"):
            line.write(b"x")


def test_closing_twice_is_the_same_as_once(port: EmulatedPort) -> None:
    """A line and an emulator may be closed again; a closed line takes nothing."""
    line = open_serial(f"pty://{port.path}", baudrate=115200)
    for _ in range(2):
        line.close()
    with pytest.raises(TransportError):
        line.read(1, 0.1)
    port.close()


def test_a_line_is_one_programs(port: EmulatedPort, line: SerialTransport) -> None:
    """What is open cannot be opened again: two programs would take each other's replies."""
    assert line.is_simulated
    with pytest.raises(TransportError, match="in no other program's use"):
        open_serial(f"pty://{port.path}", baudrate=115200)


def test_a_pseudo_terminal_has_no_rts(line: SerialTransport) -> None:
    """Setting a line that is not there says so, and is no error."""
    assert not line.set_rts(level=True)


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("/dev/ttyACM0", "Must begin with serial://, pty:// or sim://"),
        ("serial://", "Must begin with serial://"),
        ("sim://toaster", r"Must be one of \['apt', 'boson'\] after sim://"),
        ("sim://boson?colour=red", "Unknown option 'colour'"),
    ],
)
def test_a_wrong_name_is_refused(url: str, message: str) -> None:
    """The message says what a name must be."""
    with pytest.raises(ValueError, match=message):
        open_serial(url, baudrate=115200)


def test_an_emulator_cannot_pass_for_hardware(port: EmulatedPort) -> None:
    """A pseudo-terminal under the name of a serial port is refused."""
    with pytest.raises(ValueError, match=r"a pseudo-terminal\. Must begin with pty://"):
        open_serial(f"serial://{port.path}", baudrate=115200)


def test_a_missing_port_is_an_error_with_its_name() -> None:
    """The message names the port."""
    with pytest.raises(TransportError, match="Could not open '/dev/nothing-here'"):
        open_serial("serial:///dev/nothing-here", baudrate=115200)


def test_a_simulated_device_ends_with_its_line() -> None:
    """The emulator behind sim:// is started and ended with the transport."""
    line = open_serial("sim://boson?sn=7", baudrate=921600)
    path = line._port.port
    line.close()
    with pytest.raises(TransportError, match=f"Could not open '{path}'"):
        open_serial(f"pty://{path}", baudrate=921600)


def test_a_loop_in_memory_is_a_transport() -> None:
    """The echo answers at once, silence takes no time on an injected clock, an end is an end."""
    times = iter(range(100))
    loop = Loop(Echo(), clock=lambda: float(next(times)), sleep=lambda _: None)
    loop.write(b"abc")
    assert (loop.read(2, 1.0), loop.read(2, 1.0), loop.read(2, 5.0)) == (b"ab", b"c", b"")
    loop.close()
    with pytest.raises(TransportError, match="It must stay connected and open"):
        loop.write(b"x")


def test_a_recording_plays_back() -> None:
    """What was noted, with times and directions, is a dialogue."""
    stream, times = io.StringIO(), iter([0.5, 0.75, 1.0])
    with Dialogue([(b"\x01", [b"\x02", b"", b"\x03"])]) as device:
        line = Recording(device, stream, clock=lambda: next(times))
        line.write(b"\x01")
        assert [line.read(9, 1.0) for _ in range(3)] == [b"\x02", b"", b"\x03"]
        assert line.is_simulated
    lines = stream.getvalue().splitlines()
    assert json.loads(lines[1]) == {"time": 0.75, "direction": "read", "hex": "02"}
    with Dialogue.from_lines(lines) as again:
        again.write(b"\x01")
        assert again.read(9, 1.0) + again.read(9, 1.0) == b"\x02\x03"


@pytest.mark.parametrize(
    ("pairs", "steps", "message"),
    [
        ([(b"a", b"b")], ["a"], "Left unread"),
        ([(b"a", None)], [], "Left unwritten"),
        ([(b"ab", None)], ["a"], "Cut short"),
        ([(b"a", None)], ["b"], "Unexpected 62 was written. Must be 61"),
        ([], ["a"], "Must be nothing more"),
        ([(b"a", b"b"), (b"c", None)], ["a", "c"], "Unread .* but 63 was written"),
        ([(None, b"a")], [], "Left unread"),
    ],
)
def test_a_dialogue_allows_no_rest(pairs: list[Pair], steps: list[str], message: str) -> None:
    """What is not read, not written, or not expected fails."""

    def talk() -> None:
        with Dialogue(pairs) as line:
            for step in steps:
                line.write(step.encode())

    with pytest.raises(AssertionError, match=message):
        talk()


def test_a_dialogue_speaks_unasked_and_in_pieces() -> None:
    """Answers come in the pieces given, after writes in any pieces, and by themselves."""
    with Dialogue([(None, b"hi"), (b"ab", [b"c", b"de"]), (None, b"!")]) as line:
        assert line.read(9, 1.0) == b"hi"
        line.write(b"a")
        line.write(b"b")
        assert [line.read(1, 1.0) for _ in range(5)] == [b"c", b"d", b"e", b"!", b""]


def test_another_error_is_not_hidden_by_leftovers() -> None:
    """An error inside a dialogue is shown rather than what it left behind."""
    with pytest.raises(KeyError, match="first thing"), Dialogue([(b"a", None)]):
        raise KeyError("the first thing that went wrong")


def test_importing_the_instruments_is_light() -> None:
    """The package loads no library that talks to devices."""
    code = "import sys, dbthermal.instruments; print({'serial', 'usb', 'numpy'} & {*sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
