"""The filter wheel's line: talk without end, unplugging, and what is not to be believed."""

import logging
from collections.abc import Callable
from dataclasses import replace

import pytest
from rig_devices import Clock, WheelBench

from dbthermal.instruments import apt
from dbthermal.instruments.filterwheel import (
    BSC20X,
    FilterWheel,
    NotHomedError,
    Settings,
    StalledWheelError,
    WheelError,
    WrongDeviceError,
)
from dbthermal.instruments.filterwheel.link import MAXIMUM_UNASKED
from dbthermal.instruments.filterwheel.motion import Motion
from dbthermal.instruments.transport import Closing, TransportError


class Endless(Closing):
    """A device that talks without end."""

    is_simulated = True

    def __init__(self, limit: int) -> None:
        self.left = limit

    def write(self, data: bytes) -> None:
        """Take anything."""

    def read(self, size: int, timeout: float) -> bytes:  # noqa: ARG002 - it never waits
        """Talk; far beyond what the driver should listen to, the test fails."""
        self.left -= size
        if self.left < 0:
            pytest.fail("The driver listens without end.")
        return bytes(size)

    def close(self) -> None:
        """End."""


def test_a_device_that_never_ends_is_another_one() -> None:
    """Where more comes unasked than a controller says in its life, the wait ends and says why."""
    clock = Clock()
    line = Endless(2 * MAXIMUM_UNASKED)
    wheel = FilterWheel(line, Settings(), clock=clock, sleep=clock.sleep)
    with pytest.raises(WrongDeviceError, match="More than 65536 bytes came unasked"):
        wheel.connect()


class Unplugged(Closing):
    """A line that is gone after a number of reads and writes."""

    is_simulated = True

    def __init__(self, line: Closing, steps: int) -> None:
        self.line, self.steps = line, steps

    def _step(self, name: str, *arguments: object) -> bytes:
        self.steps -= 1
        if self.steps < 0:
            raise TransportError("unplugged")
        found: bytes = getattr(self.line, name)(*arguments)
        return found

    def write(self, data: bytes) -> None:
        """Send."""
        self._step("write", data)

    def read(self, size: int, timeout: float) -> bytes:
        """Receive."""
        return self._step("read", size, timeout)

    def close(self) -> None:
        """End."""
        self.line.close()


@pytest.mark.parametrize("steps", [*range(0, 90, 3)])
def test_unplugging_at_any_step(steps: int) -> None:
    """Wherever the cable is pulled out, the error is the documented one, and closing works."""
    bench = WheelBench()
    line = Unplugged(bench.wheel._transport, steps)  # type: ignore[arg-type]
    wheel = FilterWheel(line, bench.wheel.settings, clock=bench.clock, sleep=bench.clock.sleep)

    def use() -> None:
        wheel.connect()
        wheel.home()
        wheel.select("9.5")

    with pytest.raises(TransportError, match="unplugged"):
        use()
    for _ in range(2):
        wheel.close()


def fail_to_home(bench: WheelBench) -> None:
    """Begin a search for home that fails."""
    bench.device.faults.deaf_to = {apt.Id.MOT_MOVE_HOME}
    with pytest.raises(StalledWheelError):
        bench.wheel.home()
    bench.device.faults.deaf_to = set()


def stop_at_once_and_again(bench: WheelBench) -> None:
    """Stop without a ramp, then with one."""
    bench.wheel.stop(immediate=True)
    bench.wheel.stop()


@pytest.mark.parametrize("spoil", [fail_to_home, stop_at_once_and_again])
def test_a_lost_position_stays_lost(spoil: Callable[[WheelBench], None]) -> None:
    """Though the controller still says that it was homed, the driver does not believe it."""
    bench = WheelBench()
    wheel = bench.homed()
    spoil(bench)
    assert wheel.status().bits & apt.StatusBits.HOMED
    with pytest.raises(NotHomedError, match="Must be homed"):
        wheel.position()


def test_errors_of_the_greeting_are_logged_and_forgotten(caplog: pytest.LogCaptureFixture) -> None:
    """A controller need not know all that it is greeted with; what it says is in the log."""
    bench = WheelBench()
    bench.device.faults.notice = "unknown message"
    with caplog.at_level(logging.WARNING):
        bench.wheel.connect()
    assert "unknown message" in caplog.text


@pytest.mark.parametrize("kind", ["velocity", "acceleration"])
def test_a_speed_that_is_a_little_off_is_refused(kind: str) -> None:
    """A controller that takes 2 % less than it was told is not the one that was described."""
    bench = WheelBench()
    take = bench.device._set_velocity

    def take_less(message: apt.Message) -> None:
        given = apt.VelocityParameters.parse(message)
        field = {"velocity": "maximum"}.get(kind, kind)
        less = replace(given, **{field: round(0.98 * getattr(given, field))})
        take(apt.Message(message.id, 0, 0, message.destination, message.source, less.pack()))

    bench.device._set_velocity = take_less  # type: ignore[method-assign]
    with pytest.raises(WheelError, match=rf"The controller has {kind} \d+\. Must be \d+"):
        bench.wheel.connect()


class Passing:
    """A controller whose wheel passes its target, and turns on."""

    scale = BSC20X

    def __init__(self, places: list[int]) -> None:
        self.places = places
        self.stopped = False
        self.link, self.motor = self, apt.BAY_1

    def status(self) -> apt.Status:
        """Moving, from place to place."""
        bits = apt.StatusBits.MOVING_FORWARD | apt.StatusBits.HOMED
        return apt.Status(1, self.places.pop(0), 0, bits)

    def stop(self) -> None:
        """Note it."""
        self.stopped = True

    def raise_notice(self) -> None:
        """Nothing is reported."""

    def take_event(self, identifier: apt.Id, source: int) -> bool:  # noqa: ARG002 - never
        """Nothing is reported."""
        return False


def test_passing_a_target_is_no_arrival() -> None:
    """A wheel that still moves is not there, however near to its target it is seen twice."""
    clock, target = Clock(), BSC20X.target(2)
    controller = Passing([target - 9, target - 5, target - 2, target, *[target + 9] * 99])
    settings = Settings(stall_timeout=1.0)
    motion = Motion(controller, settings, clock, clock.sleep)  # type: ignore[arg-type]
    with pytest.raises(StalledWheelError, match=r"stood at 60\.01 deg for 1\.0 s"):
        motion.move(target)
    assert controller.stopped


def test_a_motor_that_runs_on_counts_in_32_bits() -> None:
    """The emulated counter wraps round, as a controller's does, and the status still comes."""
    bench = WheelBench()
    bench.wheel.connect()
    bench.device.receive(apt.set_position(1, 2**31 - 1, destination=apt.BAY_1))
    bench.device.receive(apt.move_relative(1, 10, destination=apt.BAY_1))
    bench.clock.sleep(10.0)
    assert bench.wheel.status().position == -(2**31) + 9
