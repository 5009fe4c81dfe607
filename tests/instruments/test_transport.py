"""Byte streams: names, pseudo-terminals, unplugging, and lines that fail."""

import errno
import math
import os
import pkgutil
import pty
import subprocess
import sys
import tty
from collections.abc import Iterator

import pytest

from dbthermal import instruments
from dbthermal.instruments import transport
from dbthermal.instruments.boson import Boson
from dbthermal.instruments.camera import KINDS
from dbthermal.instruments.emulated.port import EmulatedPort
from dbthermal.instruments.emulated.world import World
from dbthermal.instruments.transport import SerialTransport, TransportError, open_serial

AWKWARD = bytes.fromhex("8E 0A 0D 11 13 00 FF AE 03 04 1A 7F")


class Echo:
    """A device that echoes its input."""

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
    """Read until `size` bytes have come, or no byte in one second."""
    received = b""
    while len(received) < size and (piece := line.read(4096, 1.0)):
        received += piece
    return received


def test_a_pseudo_terminal_changes_no_byte(line: SerialTransport) -> None:
    """Line ends, flow control and end-of-file bytes pass unchanged."""
    line.write(AWKWARD)
    assert read_all(line, len(AWKWARD)) == AWKWARD


def test_reads_are_short_and_time_out(line: SerialTransport) -> None:
    """A read gives at most the requested size, and nothing after its timeout."""
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
    """A second close of line and emulator does nothing; a closed line raises an error."""
    line = open_serial(f"pty://{port.path}", baudrate=115200)
    for _ in range(2):
        line.close()
    with pytest.raises(TransportError):
        line.read(1, 0.1)
    port.close()


def test_a_line_is_one_programs(port: EmulatedPort, line: SerialTransport) -> None:
    """A port that is open cannot be opened again."""
    assert line.is_simulated
    with pytest.raises(TransportError, match="in no other program's use"):
        open_serial(f"pty://{port.path}", baudrate=115200)


def test_a_pseudo_terminal_has_no_rts(line: SerialTransport) -> None:
    """Setting RTS on a pseudo-terminal returns False."""
    assert not line.set_rts(level=True)


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("/dev/ttyACM0", "Invalid address '/dev/ttyACM0'. Must be serial:///dev/<port> or pty://"),
        ("serial://", "Must be serial:///dev/<port> or pty:///dev/<terminal> or sim://<emu"),
        ("sim://toaster", r"Must be one of \['apt', 'boson'\] after sim://"),
        ("sim://boson?colour=red", "Unknown option 'colour'"),
        ("sim://boson?sn", r"or sim://<emulator>/<name>\?<option>=<value>"),
        ("sim://boson?sn=", "Invalid address 'sim://boson.sn='"),
        ("sim://boson?sn=1&sn=2", "Repeated option 'sn' in address .* Must be listed once"),
        ("sim://boson/a?name=b", "Repeated option 'name' in address .* Must be listed once"),
        ("sim://boson#wide", "Invalid address 'sim://boson#wide'"),
        ("sim://boson?sn=abc", r"Invalid option sn=abc .* \(int\) in 0 to 4294967295"),
        ("sim://boson?sn=-3", "Invalid option sn=-3"),
        ("sim://boson?sn=7.5", "Invalid option sn=7.5"),
        ("sim://boson?fpa=nan", r"Invalid option fpa=nan .* \(float\) in 0.0 to 655.0"),
        ("sim://apt?offset=inf", "Invalid option offset=inf"),
        ("sim://apt?sn=x", "Invalid option sn=x"),
        ("serial:///dev/ttyACM0?baud=9600", "Invalid address 'serial:///dev/ttyACM0.baud"),
        ("pty:///dev/pts/0#1", "Invalid address 'pty:///dev/pts/0#1'"),
        ("serial:///dev/../etc/passwd", "Invalid address"),
        ("serial:///etc/a", "Invalid address"),
    ],
)
def test_a_wrong_name_is_refused(url: str, message: str) -> None:
    """An unknown option or part of a name raises a ValueError with the rule."""
    with pytest.raises(ValueError, match=message):
        open_serial(url, baudrate=115200)


def test_the_path_of_an_emulator_is_its_name() -> None:
    """The address selects one of two emulated cameras by its name."""
    world = World()
    for name, number in (("boson", 1), ("wide", 2)):
        world.add_camera(name, number)
    with Boson.from_url("sim://boson/wide", world=world) as camera:
        assert camera.serial_number() == 2


def test_an_emulator_cannot_pass_for_hardware(port: EmulatedPort) -> None:
    """A pseudo-terminal as a `serial://` address raises an error."""
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


def test_a_line_that_takes_no_bytes_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """A write that nobody reads ends with an error after its timeout."""
    monkeypatch.setattr(transport, "WRITE_TIMEOUT", 0.05)
    master, slave = pty.openpty()
    try:
        tty.setraw(slave)
        with open_serial(f"pty://{os.ttyname(slave)}", baudrate=9600) as line:
            with pytest.raises(TransportError, match=r"Could not write to .*timeout"):
                line.write(bytes(1 << 20))
            line._port.reset_output_buffer()
    finally:
        os.close(master)
        os.close(slave)


class Port:
    """A serial port that fails with a certain error."""

    def __init__(self, number: int) -> None:
        self.number = number

    def __setattr__(self, name: str, value: object) -> None:
        if name == "rts":
            raise OSError(self.number, os.strerror(self.number))
        super().__setattr__(name, value)

    def close(self) -> None:
        """Fail, too."""
        raise OSError(self.number, os.strerror(self.number))


def test_only_a_missing_line_is_no_rts() -> None:
    """A port without RTS returns False; an unplugged port raises an error."""
    lines = {
        number: SerialTransport(Port(number), "serial:///dev/ttyUSB0", is_simulated=False)
        for number in (errno.ENOTTY, errno.EIO)
    }
    assert not lines[errno.ENOTTY].set_rts(level=True)
    with pytest.raises(TransportError, match="Could not set RTS of 'serial:///dev/ttyUSB0'"):
        lines[errno.EIO].set_rts(level=True)


def test_an_emulator_ends_though_its_port_does_not_close() -> None:
    """An emulator is ended even if its port fails to close."""
    ended = []
    line = SerialTransport(
        Port(errno.EIO), "sim://boson", is_simulated=True, after=lambda: ended.append(1)
    )
    with pytest.raises(TransportError, match=f"Could not close .*{os.strerror(errno.EIO)}"):
        line.close()
    assert ended == [1]


def test_what_went_wrong_is_not_hidden_by_closing() -> None:
    """A failure to close is added as a note to the error that came before it."""
    line = SerialTransport(Port(errno.EIO), "serial:///dev/ttyUSB0", is_simulated=False)
    with pytest.raises(KeyError, match="first thing") as caught, line:
        raise KeyError("the first thing that went wrong")
    assert caught.value.__notes__[0].startswith("Closing failed too. Could not close 'serial://")


def test_importing_the_instruments_is_light() -> None:
    """The package loads no library that talks to devices."""
    code = "import sys, dbthermal.instruments; print({'serial', 'usb', 'numpy'} & {*sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_every_module_is_on_the_map() -> None:
    """The package says what each of its modules is for; kinds of cameras are listed by theirs."""
    names = {module.name for module in pkgutil.iter_modules(instruments.__path__)}
    names -= {module.rpartition(".")[2] for module in KINDS.values()}
    assert {name for name in names if f"`{name}`" not in (instruments.__doc__ or "")} == set()


def test_completion_shows_the_rooms() -> None:
    """Completion of the package offers its modules, each of which is imported when it is used."""
    assert dir(instruments) == sorted(instruments.__all__)
    assert instruments.thermocouple.emf(273.15) == 0.0
    with pytest.raises(AttributeError, match="Unknown module 'dialogue'"):
        _ = instruments.dialogue
