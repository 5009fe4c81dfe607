"""Byte streams: names, pseudo-terminals, unplugging, and lines that fail."""

import contextlib
import errno
import os
import pkgutil
import pty
import subprocess
import sys
import tty
from collections.abc import Iterator

import pytest
import serial

from dbthermal import instruments
from dbthermal.instruments.boson import Boson
from dbthermal.instruments.camera import KINDS
from dbthermal.instruments.emulated.world import World
from dbthermal.instruments.transport import SerialTransport, TransportError, open_serial

AWKWARD = bytes.fromhex("8E 0A 0D 11 13 00 FF AE 03 04 1A 7F")


class Terminal:
    """A raw pseudo-terminal: `far` is the device's end, `line` a transport at the driver's."""

    def __init__(self) -> None:
        self.far, near = pty.openpty()
        tty.setraw(near)
        self.path = os.ttyname(near)
        self.line = self.opened()
        os.close(near)

    def opened(self) -> SerialTransport:
        """Open the driver's end."""
        port = serial.Serial(self.path, exclusive=True, write_timeout=0.05)
        return SerialTransport(port, "serial:///dev/ttyACM0")


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    """A pseudo-terminal with a line that is open."""
    opened = Terminal()
    yield opened
    opened.line.close()
    with contextlib.suppress(OSError):
        os.close(opened.far)


def test_a_serial_line_changes_no_byte(terminal: Terminal) -> None:
    """Line ends, flow control and end-of-file bytes pass unchanged, both ways."""
    terminal.line.write(AWKWARD)
    assert os.read(terminal.far, 4096) == AWKWARD
    os.write(terminal.far, AWKWARD)
    received = b""
    while len(received) < len(AWKWARD):
        received += terminal.line.read(4096, 1.0)
    assert received == AWKWARD


def test_reads_are_short_and_time_out(terminal: Terminal) -> None:
    """A read gives at most the requested size, and nothing after its timeout."""
    os.write(terminal.far, b"abc")
    assert terminal.line.read(1, 1.0) == b"a"
    assert terminal.line.read(1, 1.0) + terminal.line.read(1, 1.0) == b"bc"
    assert terminal.line.read(1, 0.0) == b""


def test_an_unplugged_device_is_an_error_with_its_name(terminal: Terminal) -> None:
    """Pulling the plug ends reads and writes with the name of the port, not with silence."""
    os.close(terminal.far)
    with pytest.raises(TransportError, match="Could not read from 'serial:///dev/ttyACM0'"):
        terminal.line.read(1, 2.0)
    with pytest.raises(TransportError, match="must stay connected"):
        terminal.line.write(b"x")


def test_closing_twice_is_the_same_as_once(terminal: Terminal) -> None:
    """A second close does nothing; a closed line raises an error."""
    for _ in range(2):
        terminal.line.close()
    with pytest.raises(TransportError):
        terminal.line.read(1, 0.1)


def test_a_line_is_one_programs(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    """A port that is open cannot be opened again."""
    assert not terminal.line.is_simulated
    with pytest.raises(ValueError, match="a pseudo-terminal"):
        open_serial(f"serial://{terminal.path}", baudrate=115200)
    monkeypatch.setattr("pathlib.Path.is_relative_to", lambda *_: False)
    with pytest.raises(TransportError, match="in no other program's use"):
        open_serial(f"serial://{terminal.path}", baudrate=115200)


def test_a_line_that_takes_no_bytes_is_an_error(terminal: Terminal) -> None:
    """A write that nobody reads ends with an error after its timeout."""
    with pytest.raises(TransportError, match=r"Could not write to .*timeout"):
        terminal.line.write(bytes(1 << 20))
    terminal.line._port.reset_output_buffer()


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("/dev/ttyACM0", "Invalid address '/dev/ttyACM0'. Must be serial:///dev/<port> or sim://"),
        ("serial://", "Must be serial:///dev/<port> or sim://<emulator>/<name>"),
        ("sim://toaster", r"Must be one of \['apt', 'boson'\] after sim://"),
        ("sim://boson?sn=7", "Invalid address 'sim://boson.sn=7'"),
        ("sim://boson#wide", "Invalid address 'sim://boson#wide'"),
        ("serial:///dev/ttyACM0?baud=9600", "Invalid address 'serial:///dev/ttyACM0.baud"),
        ("pty:///dev/pts/0", "Invalid address 'pty:///dev/pts/0'"),
        ("serial:///dev/../etc/passwd", "Invalid address"),
        ("serial:///etc/a", "Invalid address"),
    ],
)
def test_a_wrong_name_is_refused(url: str, message: str) -> None:
    """An unknown part of an address raises a ValueError with the rule."""
    with pytest.raises(ValueError, match=message):
        open_serial(url, baudrate=115200)


def test_the_path_of_an_emulator_is_its_name() -> None:
    """The address selects one of two emulated cameras by its name."""
    world = World()
    for name, number in (("boson", 1), ("wide", 2)):
        world.add_camera(name, number)
    with Boson.from_url("sim://boson/wide", world=world) as camera:
        assert camera.serial_number() == 2


def test_a_missing_port_is_an_error_with_its_name() -> None:
    """The message names the port."""
    with pytest.raises(TransportError, match="Could not open '/dev/nothing-here'"):
        open_serial("serial:///dev/nothing-here", baudrate=115200)


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


def test_what_went_wrong_is_not_hidden_by_closing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A failure to close is added as a note to the error that came before it."""
    monkeypatch.setattr("serial.Serial", lambda *_, **__: Port(errno.EIO))
    with pytest.raises(TransportError, match="Could not set RTS of 'serial://") as caught:
        open_serial("serial:///dev/ttyUSB0", baudrate=115200, rtscts=True)
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
    assert instruments.tc08.CHANNELS == 9
    with pytest.raises(AttributeError, match="Unknown module 'dialogue'"):
        _ = instruments.dialogue
