"""Byte streams: names, pseudo-terminals, unplugging, lines that fail, and lines in memory."""

import contextlib
import errno
import os
import pkgutil
import pty
import subprocess
import sys
import tty
from collections.abc import Iterator
from typing import NamedTuple
from unittest.mock import Mock, PropertyMock

import pytest
import serial
from refused import assert_raises, assert_refused, refused

from dbthermal import instruments
from dbthermal.instruments.camera import KINDS
from dbthermal.instruments.transport import SerialTransport, TransportError, open_serial

AWKWARD = bytes.fromhex("8E 0A 0D 11 13 00 FF AE 03 04 1A 7F")


class Terminal(NamedTuple):
    """A raw pseudo-terminal: its path, the device's end, and a line at the driver's."""

    path: str
    far: int
    line: SerialTransport


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    """A pseudo-terminal with a line that is open."""
    far, near = pty.openpty()
    tty.setraw(near)
    port = serial.Serial(path := os.ttyname(near), exclusive=True, write_timeout=0.05)
    os.close(near)
    yield Terminal(path, far, line := SerialTransport(port, "serial:///dev/ttyACM0"))
    line.close()
    with contextlib.suppress(OSError):
        os.close(far)


def test_a_serial_line_changes_no_byte(terminal: Terminal) -> None:
    """Line ends and control bytes pass unchanged, both ways; a read gives what was asked for."""
    terminal.line.write(AWKWARD)
    assert os.read(terminal.far, 4096) == AWKWARD
    os.write(terminal.far, AWKWARD)
    received = terminal.line.read(1, 60.0)
    assert received == AWKWARD[:1]
    while len(received) < len(AWKWARD):
        received += terminal.line.read(4096, 60.0)
    assert received == AWKWARD
    assert terminal.line.read(1, 0.0) == b""


def test_an_unplugged_device_is_an_error_with_its_name(terminal: Terminal) -> None:
    """Pulling the plug ends reads and writes with the name of the port, not with silence."""
    os.close(terminal.far)
    with pytest.raises(TransportError, match="Could not read from 'serial:///dev/ttyACM0'"):
        terminal.line.read(1, 60.0)
    assert_raises(TransportError, "must stay connected", terminal.line.write, b"x")
    for _ in range(2):
        terminal.line.close()
    with pytest.raises(TransportError):
        terminal.line.read(1, 0.1)


def test_a_line_is_one_programs(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    """A port that is open cannot be opened again."""
    assert not terminal.line.is_simulated
    assert_refused("a pseudo-terminal", open_serial, f"serial://{terminal.path}", baudrate=115200)
    monkeypatch.setattr("pathlib.Path.is_relative_to", lambda *_: False)
    with pytest.raises(TransportError, match="in no other program's use"):
        open_serial(f"serial://{terminal.path}", baudrate=115200)


def test_a_line_that_takes_no_bytes_is_an_error(terminal: Terminal) -> None:
    """A write that nobody reads ends with an error after its timeout."""
    with pytest.raises(TransportError, match=r"Could not write to .*timeout"):
        terminal.line.write(bytes(1 << 20))
    terminal.line._port.reset_output_buffer()


test_a_wrong_name_is_refused = refused(
    lambda url: open_serial(url, baudrate=115200),
    [
        ("/dev/ttyACM0", "Invalid address '/dev/ttyACM0'. Must be serial:///dev/<port>"),
        ("serial://", "Invalid address 'serial://'. Must be serial:///dev/<port>"),
        ("sim://boson/wide", "Invalid address 'sim://boson/wide'"),
        ("serial:///dev/ttyACM0?baud=9600", "Invalid address 'serial:///dev/ttyACM0.baud"),
        ("pty:///dev/pts/0", "Invalid address 'pty:///dev/pts/0'"),
        ("serial:///dev/../etc/passwd", "Invalid address"),
        ("serial:///etc/a", "Invalid address"),
        ("serial:///dev/nothing-here", "Could not open '/dev/nothing-here'"),
    ],
    error=(ValueError, TransportError),
)


def test_what_went_wrong_is_not_hidden_by_closing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A failure to close is added as a note to the error that came before it."""
    failure = OSError(errno.EIO, os.strerror(errno.EIO))
    port = Mock(**{"close.side_effect": failure})
    type(port).rts = PropertyMock(side_effect=failure)
    monkeypatch.setattr("serial.Serial", Mock(return_value=port))
    with pytest.raises(TransportError, match="Could not set RTS of 'serial://") as caught:
        open_serial("serial:///dev/ttyUSB0", baudrate=115200, rtscts=True)
    assert caught.value.__notes__[0].startswith("Closing failed too. Could not close 'serial://")


def test_importing_the_instruments_is_light() -> None:
    """No library is loaded before its use, of devices by the drivers, of figures by the watch."""
    code = (
        "import sys; from dbthermal import instruments as all\n"
        "print({'serial', 'usb', 'numpy'} & {*sys.modules})\n"
        "all.tc08.CHANNELS; print({'serial', 'usb'} & {*sys.modules})\n"
        "all.live.Watch; print({'matplotlib', 'IPython', 'torch'} & {*sys.modules})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == 3 * ["set()"]


def test_every_module_is_on_the_map() -> None:
    """The package says what each of its modules is for, and offers them for completion."""
    names = {module.name for module in pkgutil.iter_modules(instruments.__path__)}
    names -= {module.rpartition(".")[2] for module in KINDS.values()}
    assert {name for name in names if f"`{name}`" not in (instruments.__doc__ or "")} == set()
    with pytest.raises(AttributeError, match="Unknown module 'dialogue'"):
        _ = instruments.dialogue
