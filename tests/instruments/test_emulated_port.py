"""The line between an emulated device and its driver: its end, and released resources."""

import gc
import threading
from pathlib import Path

import pytest
from loopback import Loop
from test_transport import Echo

from dbthermal.instruments.boson import Boson
from dbthermal.instruments.emulated import boson as emulated_boson
from dbthermal.instruments.emulated.port import EmulatedPort
from dbthermal.instruments.emulated.world import World
from dbthermal.instruments.transport import TransportError, open_serial


def test_a_loop_in_memory_is_a_transport() -> None:
    """The echo answers at once, silence takes no time on an injected clock, an end is an end."""
    times = iter(range(100))
    loop = Loop(Echo(), clock=lambda: float(next(times)), sleep=lambda _: None)
    loop.write(b"abc")
    assert (loop.read(2, 1.0), loop.read(2, 1.0), loop.read(2, 5.0)) == (b"ab", b"c", b"")
    loop.close()
    with pytest.raises(TransportError, match="It must stay connected and open"):
        loop.write(b"x")


def test_an_emulator_ends_if_its_port_cannot_be_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    """No thread and no terminal stays behind."""
    started: list[EmulatedPort] = []
    start = emulated_boson.start

    def note(options: dict[str, str], world: World | None) -> EmulatedPort:
        started.append(start(options, world))
        return started[0]

    def refuse(path: str, *_: object, **__: object) -> None:
        raise OSError(f"no '{path}'")

    monkeypatch.setattr(emulated_boson, "start", note)
    monkeypatch.setattr("serial.Serial", refuse)
    with pytest.raises(TransportError, match="Could not open"):
        open_serial("sim://boson", baudrate=921600)
    assert not started[0]._thread.is_alive()


def held() -> tuple[int, int]:
    """Threads and open files of this program."""
    gc.collect()
    return threading.active_count(), len([*Path("/proc/self/fd").iterdir()])


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="open files are counted on Linux")
def test_nothing_is_left_open() -> None:
    """Fifty cameras, half of them unplugged, leave no open files and threads."""
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
        """No bytes."""
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
