"""What went wrong once at the edges of the rig: names, ends, limits, and numbers that must stay."""

import errno
import gc
import os
import pty
import threading
import tty
from ctypes import c_int8, c_int16, c_int32
from pathlib import Path

import numpy as np
import pytest
from rig_devices import LoggerBench

from dbthermal.instruments import inventory, permissions, transport
from dbthermal.instruments.boson import Boson, commands
from dbthermal.instruments.emulated import boson as emulated_boson
from dbthermal.instruments.emulated import usb as emulated
from dbthermal.instruments.emulated.apt import EmulatedApt
from dbthermal.instruments.emulated.port import EmulatedPort
from dbthermal.instruments.emulated.world import World
from dbthermal.instruments.tc08 import Flag
from dbthermal.instruments.tc08.library import SIGNATURES
from dbthermal.instruments.tc08.stream import LONGEST, Timeline
from dbthermal.instruments.transport import SerialTransport, TransportError, open_serial


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("sim://boson?sn", "Must have each option once, as option=value"),
        ("sim://boson?sn=", "Must have each option once"),
        ("sim://boson?sn=1&sn=2", "Must have each option once"),
        ("sim://boson/a?name=b", "Must have each option once"),
        ("sim://boson#wide", "Must have each option once"),
        ("sim://boson/a?camera=b", "Unknown option 'camera' beside 'name'"),
        ("sim://boson?sn=abc", r"Invalid option sn=abc .* \(int\) in 0 to 4294967295"),
        ("sim://boson?sn=-3", "Invalid option sn=-3"),
        ("sim://boson?sn=7.5", "Invalid option sn=7.5"),
        ("sim://boson?fpa=nan", r"Invalid option fpa=nan .* \(float\) in 0.0 to 655.0"),
        ("sim://apt?offset=inf", "Invalid option offset=inf"),
        ("sim://apt?sn=x", "Invalid option sn=x"),
        ("serial:///dev/ttyACM0?baud=9600", "with options. Must have none"),
        ("pty:///dev/pts/0#1", "with options. Must have none"),
    ],
)
def test_a_name_says_nothing_in_vain(url: str, message: str) -> None:
    """What is not understood in a name is an error that shows it, and nothing is left out."""
    with pytest.raises(ValueError, match=message):
        open_serial(url, baudrate=115200)


def test_the_path_of_an_emulator_is_its_name() -> None:
    """Of two emulated cameras, the one that the address names is opened."""
    world = World()
    for name, number in (("boson", 1), ("wide", 2)):
        world.add_camera(name, number)
    with Boson.from_url("sim://boson/wide", world=world) as camera:
        assert camera.serial_number() == 2


def test_an_emulator_ends_if_its_port_cannot_be_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    """No thread and no terminal stays behind."""
    started: list[EmulatedPort] = []
    start = emulated_boson.start

    def note(options: dict[str, str], world: World | None) -> EmulatedPort:
        started.append(start(options, world))
        return started[0]

    def refuse(path: str, **_: object) -> None:
        raise TransportError(f"Could not open '{path}'.")

    monkeypatch.setattr(emulated_boson, "start", note)
    monkeypatch.setattr(transport, "_open_port", refuse)
    with pytest.raises(TransportError, match="Could not open"):
        open_serial("sim://boson", baudrate=921600)
    assert not started[0]._thread.is_alive()


def held() -> tuple[int, int]:
    """Threads and open files of this program."""
    gc.collect()
    return threading.active_count(), len([*Path("/proc/self/fd").iterdir()])


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="open files are counted on Linux")
def test_nothing_is_left_open() -> None:
    """After fifty cameras, half of them pulled out, no more files and threads are held."""
    threads, files = held()
    for number in range(50):
        world = World()
        state = world.add_camera("boson", number)
        with Boson.from_url("sim://boson", world=world) as camera:
            assert camera.serial_number() == number
            state.plugged = number % 2 == 0
    after = held()
    assert (after[0] <= threads, after[1] <= files) == (True, True)


class Broken:
    """A device with an error in it."""

    plugged = True

    def receive(self, data: bytes) -> None:
        """Fail."""
        raise ArithmeticError(f"an error in the emulator at {data!r}")

    def poll(self) -> list[bytes]:
        """Say nothing."""
        return []

    def next_due(self) -> float:
        """At once."""
        return 0.0


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_an_emulator_that_fails_hangs_up() -> None:
    """An error in an emulated device ends its line, and the driver does not wait for it."""
    with EmulatedPort(Broken()) as port, open_serial(f"pty://{port.path}", baudrate=9600) as line:
        line.write(b"x")
        with pytest.raises(TransportError, match="must stay connected"):
            line.read(1, 30.0)


def test_a_line_that_takes_no_bytes_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """Writing ends, too, where nobody reads."""
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
    """A serial port that fails as it is told."""

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
    """A terminal without RTS says so; a port that was pulled out is an error."""
    lines = {
        number: SerialTransport(Port(number), "serial:///dev/ttyUSB0", is_simulated=False)
        for number in (errno.ENOTTY, errno.EIO)
    }
    assert not lines[errno.ENOTTY].set_rts(level=True)
    with pytest.raises(TransportError, match="Could not set RTS of 'serial:///dev/ttyUSB0'"):
        lines[errno.EIO].set_rts(level=True)


def test_an_emulator_ends_though_its_port_does_not_close() -> None:
    """Whatever happens at the end of a line, its emulator does not go on."""
    ended = []
    line = SerialTransport(
        Port(errno.EIO), "sim://boson", is_simulated=True, after=lambda: ended.append(1)
    )
    with pytest.raises(OSError, match=os.strerror(errno.EIO)):
        line.close()
    assert ended == [1]


def test_emulated_devices_have_room_for_their_numbers() -> None:
    """The largest serial numbers are said by the emulators as they are."""
    with Boson.from_url("sim://boson?sn=4294967295&fpa=655") as camera:
        assert camera.serial_number() == 2**32 - 1
        assert camera.read(commands.FPA_TEMPERATURE_KELVIN) == 655.0
        assert camera.read(commands.FPA_COUNTS) == 65500
    assert len(EmulatedApt(World(), serial_number=2**32 - 1)._info.pack()) == 84


def test_types_of_the_library_are_those_of_its_header() -> None:
    """Four functions return 32 bits, where the vendor's own wrapper has 16; a letter is 8 bits."""
    names = {
        name.removeprefix("usb_tc08_")
        for name, (result, _) in SIGNATURES.items()
        if result is c_int32
    }
    assert names == {"get_minimum_interval_ms", "run", "get_temp", "get_temp_deskew"}
    assert {result for result, _ in SIGNATURES.values()} == {c_int16, c_int32}
    assert SIGNATURES["usb_tc08_set_channel"][1] == [c_int16, c_int16, c_int8]


def test_flags_keep_their_numbers() -> None:
    """They are stored with recordings, so that each is a bit of its own for ever."""
    assert {flag.name: flag.value for flag in Flag} == {
        "OVERFLOW": 1,
        "MISSING": 2,
        "OUT_OF_RANGE": 4,
        "NO_JUNCTION": 8,
        "VOLTAGE": 16,
    }


def test_a_cold_junction_that_is_too_old_is_none() -> None:
    """A sample 1.4 intervals away counts, one 1.6 intervals away does not."""
    timeline = Timeline(2.0)
    timeline.add_junction(np.array([10.0]), np.array([296.15]))
    assert np.isnan(timeline.junction_at(np.array([13.2]))).all()
    assert timeline.junction_at(np.array([12.8])).tolist() == [296.15]


@pytest.mark.parametrize("interval", [np.nan, np.inf, -1.0, LONGEST + 1.0, 1.0005])
def test_an_interval_that_does_not_fit_is_refused(interval: float) -> None:
    """No interval is wrapped to fit 32 bits, and none that is no number reaches the library."""
    driver = LoggerBench().ready()
    with pytest.raises(ValueError, match=r"Must be 0\.3 s or longer, to 2147483\.647 s"):
        driver.stream(interval)


def test_a_node_of_a_group_without_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the system has no name for a node's group, its number is given."""
    node = tmp_path / "dev" / "ttyUSB0"
    node.parent.mkdir()
    node.touch()

    def nameless(_: Path) -> str:
        raise KeyError("gid")

    about = list(node.stat())
    about[0], about[5] = 0o020660, 4321  # its mode and group
    monkeypatch.setattr(permissions, "_stat", lambda _: os.stat_result(about))
    monkeypatch.setattr(os, "access", lambda *_: False)
    monkeypatch.setattr(Path, "group", nameless)
    backend = emulated.EmulatedBackend(emulated.apt())
    emulated.write_sysfs(tmp_path, backend)
    (found,) = inventory.find(backend, sysfs=tmp_path, dev=node.parent)
    assert "in its group '4321'" in found.warnings[0]


def test_a_device_that_vanishes_from_sysfs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A device that is pulled out while it is looked at is listed without its number."""

    def vanished(*_: object, **__: object) -> str:
        raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))

    backend = emulated.EmulatedBackend(emulated.boson(fault="permission"))
    emulated.write_sysfs(tmp_path, backend)
    monkeypatch.setattr(Path, "read_text", vanished)
    (found,) = inventory.find(backend, sysfs=tmp_path, dev=tmp_path)
    assert found.serial is None
    assert found.warnings[0].startswith("No permission to open it.")
