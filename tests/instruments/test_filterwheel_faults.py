"""Faults of a filter wheel: those that are overcome, and the errors of the others."""

import logging

import pytest
from device_benches import FILTERS, Clock, WheelBench
from hypothesis import given, settings
from hypothesis import strategies as st

from dbthermal.instruments import _apt as apt
from dbthermal.instruments._controller import MAXIMUM_UNSOLICITED
from dbthermal.instruments.filterwheel import (
    FilterWheel,
    NoReplyError,
    NotHomedError,
    StalledWheelError,
    WheelError,
    WheelTimeoutError,
    WrongDeviceError,
)
from dbthermal.instruments.transport import Closing, TransportError


def test_unset_speeds_make_homing_do_nothing() -> None:
    """A controller that ignores the speeds fails on connecting, before it is homed."""
    bench = WheelBench()
    bench.device.faults.deaf_to = {apt.Id.MOT_SET_VELPARAMS}
    with pytest.raises(WheelError, match=r"velocity 0. Must be 21987328"):
        bench.wheel.connect()
    bench.device.faults.deaf_to = {apt.Id.MOT_SET_HOMEPARAMS}
    with pytest.raises(WheelError, match=r"home velocity 0. Must be 4397466"):
        bench.wheel.connect()
    bench.device.faults.deaf_to = {apt.Id.MOT_MOVE_HOME}
    with pytest.raises(StalledWheelError, match="Search for home: the wheel did not start"):
        bench.homed()


def test_an_earlier_search_for_home_does_not_count() -> None:
    """Neither the bit nor the report of an earlier search for home ends the next one."""
    bench = WheelBench()
    wheel = bench.homed()
    bench.device.receive(apt.command(apt.Id.MOT_MOVE_HOME, 1, destination=apt.BAY_1))
    bench.clock.sleep(10.0)
    wheel.status()
    bench.device.faults.deaf_to = {apt.Id.MOT_MOVE_HOME}
    with pytest.raises(StalledWheelError, match="did not start"):
        wheel.home()


def test_motor_that_is_not_enabled() -> None:
    """A controller that does not power the motor is detected on connecting."""
    bench = WheelBench()
    bench.device.faults.deaf_to = {apt.Id.MOD_SET_CHANENABLESTATE}
    with pytest.raises(WheelError, match="did not enable the motor"):
        bench.wheel.connect()


@pytest.mark.parametrize(
    "faults",
    [
        {"single_bytes": True},
        {"hold": True},
        {"noise": b"\xff\x12\x04"},
        {"stray_completed": True},
        {"unreported": True},
        {"long_reports": True},
        {"late": 0.3},
        {"drop": 1},
        {"stuck": apt.StatusBits.JOGGING_FORWARD | apt.StatusBits.JOGGING_REVERSE},
        {"slow": 1.5},
    ],
    ids=lambda faults: next(iter(faults)),
)
def test_harmless_faults(faults: dict[str, object]) -> None:
    """Split, merged, late, missing, unasked and noisy answers: the wheel is where it should be."""
    bench = WheelBench()
    wheel = bench.homed()
    for name, value in faults.items():
        setattr(bench.device.faults, name, value)
    for position in (3, 6, 2):
        wheel.move_to(position)
        assert bench.world.wheel_position == position == wheel.position()


def test_moving_bits_that_stick() -> None:
    """With stuck motion bits a move ends by its report, and the next move raises an error."""
    bench = WheelBench()
    wheel = bench.homed()

    def stick() -> None:
        bench.device.faults.stuck = apt.StatusBits.MOVING_FORWARD

    bench.clock.events.append((bench.clock.now + 0.3, stick))
    wheel.move_to(3)
    assert bench.world.wheel_position == 3
    with pytest.raises(WheelError, match="still moving"):
        wheel.move_to(4)


def test_stall() -> None:
    """A wheel that stands though it should move is stopped, and must be homed again."""
    bench = WheelBench()
    wheel = bench.homed()
    bench.device.faults.stands_after = 20.0
    message = r"Move to 120.00 deg: the wheel stood at 20.00 deg for 2.0 s .* was stopped"
    with pytest.raises(StalledWheelError, match=message):
        wheel.move_to(3)
    assert bench.sent(apt.Id.MOT_MOVE_STOP)
    with pytest.raises(NotHomedError, match="lost steps"):
        wheel.move_to(1)
    bench.device.faults.stands_after = 360.0
    wheel.home()
    wheel.move_to(3)
    assert bench.world.wheel_position == 3


def test_move_that_ends_elsewhere() -> None:
    """A reported end of a move away from its target raises an error."""
    bench = WheelBench()
    wheel = bench.homed()
    bench.device.faults.stops_short = 1.5
    with pytest.raises(StalledWheelError, match=r"the wheel stopped at 118.50 deg. Must arrive"):
        wheel.move_to(3)


def test_move_that_does_not_start() -> None:
    """A move that the controller ignores is an error after a while."""
    bench = WheelBench()
    wheel = bench.homed()
    bench.device.faults.deaf_to = {apt.Id.MOT_MOVE_ABSOLUTE}
    with pytest.raises(StalledWheelError, match=r"the wheel did not start and is at 0.00 deg"):
        wheel.move_to(3)
    assert bench.clock.now < 60.0


def test_slow_wheel() -> None:
    """A move or a search for home that takes too long is stopped, and says where it was."""
    bench = WheelBench()
    wheel = bench.homed()
    bench.device.faults.slow = 30.0
    with pytest.raises(WheelTimeoutError, match=r"still at .* deg after 20.0 s, and was stopped"):
        wheel.move_to(4)
    bench.device.faults.slow = 1.0
    wheel.move_to(4)
    bench.device.faults.slow = 30.0
    with pytest.raises(WheelTimeoutError, match=r"Search for home: .* after 60.0 s"):
        wheel.home()
    with pytest.raises(NotHomedError):
        wheel.move_to(1)


def test_lost_steps_are_seen_by_nobody() -> None:
    """Without an encoder lost steps are not detected; homing restores the position."""
    bench = WheelBench()
    wheel = bench.homed()
    bench.device.faults.slips = 5.0
    wheel.move_to(3)
    assert (wheel.position(), bench.world.wheel_position) == (3, None)
    bench.device.faults.slips = 0.0
    wheel.home()
    wheel.move_to(3)
    assert bench.world.wheel_position == 3


def test_errors_of_the_controller() -> None:
    """An error that the controller reports stops the next command once, with its text."""
    bench = WheelBench()
    wheel = bench.homed()
    bench.device.faults.notice = "motor hot"
    with pytest.raises(WheelError, match="It reported error 1 of message 0x0480: motor hot"):
        wheel.move_to(3)
    assert not bench.sent(apt.Id.MOT_MOVE_ABSOLUTE)
    wheel.move_to(3)
    bench.device.faults.notice = "motor cold"
    with pytest.raises(WheelError, match="motor cold"):
        wheel.home()


def test_an_overload_costs_the_position() -> None:
    """After an overload steps may be lost: the wheel has to be homed before it turns again."""
    bench = WheelBench()
    wheel = bench.homed()
    bench.device.faults.stuck = apt.StatusBits.OVERLOAD
    with pytest.raises(StalledWheelError, match="reports OVERLOAD, and the wheel was stopped"):
        wheel.move_to(3)
    assert bench.sent(apt.Id.MOT_MOVE_STOP)
    bench.device.faults.stuck = apt.StatusBits(0)
    with pytest.raises(NotHomedError):
        wheel.move_to(3)
    wheel.home()
    wheel.move_to(3)
    assert bench.world.wheel_position == 3


def test_answers_that_come_too_late(monkeypatch: pytest.MonkeyPatch) -> None:
    """Answers later than the limit may be those of an older question: never a wrong slot."""
    bench, patient = WheelBench(), WheelBench()
    wheel = bench.homed()
    bench.device.faults.late = patient.device.faults.late = 1.2
    wheel.move_to(3)
    assert bench.world.wheel_position == wheel.position() == 3
    with pytest.raises(StalledWheelError, match="did not start"):
        wheel.move_to(6)
    monkeypatch.setattr("dbthermal.instruments._controller.REPLY_TIMEOUT", 1.5)
    patient.homed().move_to(6)
    assert patient.world.wheel_position == 6


def test_silence_in_a_move() -> None:
    """A controller that falls silent is an error in bounded time, not a wait for ever."""
    bench = WheelBench()
    wheel = bench.homed()
    bench.device.faults.silent = True
    before = bench.clock.now
    with pytest.raises(NoReplyError, match="must be on and in no other program's use"):
        wheel.move_to(2)
    assert bench.clock.now - before < 3.0


def test_unplugged() -> None:
    """A cable that was pulled out is an error at once, and closing is still allowed, twice."""
    bench = WheelBench()
    wheel = bench.homed()
    bench.device.plugged = False
    with pytest.raises(TransportError, match="Lost the emulated device"):
        wheel.move_to(2)
    wheel.close()
    wheel.close()


def test_late_report_of_an_earlier_move() -> None:
    """A stale report before the wheel starts does not end the move, nor make it a stall."""
    bench = WheelBench()
    wheel = bench.homed()
    bench.device.faults.stray_completed = True
    bench.device.faults.late = 0.4
    wheel.move_to(4)
    assert bench.world.wheel_position == 4


@settings(max_examples=60)
@given(st.binary(max_size=12), st.integers(0, 3))
def test_noise_on_the_line(noise: bytes, drop: int) -> None:
    """With any bytes before every answer, and some missing: the right slot, or a known error."""
    bench = WheelBench()
    bench.device.faults.noise = noise
    bench.device.faults.drop = drop
    try:
        bench.homed().move_to(2)
    except WheelError:
        assert bench.clock.now < 200.0
    else:
        assert bench.world.wheel_position == 2


class Endless(Closing):
    """A device that talks without end."""

    is_simulated = True

    def __init__(self, limit: int) -> None:
        self.left, self.clock = limit, Clock()

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
    """An endless stream of bytes ends the wait with an error."""
    line = Endless(2 * MAXIMUM_UNSOLICITED)
    wheel = FilterWheel(line, {})
    with pytest.raises(WrongDeviceError, match="More than 65536 unsolicited bytes came"):
        wheel.connect()


class Unplugged(Closing):
    """A line that is gone after a number of reads and writes."""

    is_simulated = True

    def __init__(self, line: Closing, steps: int) -> None:
        self.line, self.steps, self.clock = line, steps, line.clock

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
    """Unplugging at any step raises the documented error, and closing still works."""
    bench = WheelBench()
    line = Unplugged(bench.wheel._transport, steps)  # type: ignore[arg-type]
    wheel = FilterWheel(line, FILTERS)

    def use() -> None:
        wheel.connect()
        wheel.home()
        wheel.select("9.5")

    with pytest.raises(TransportError, match="unplugged"):
        use()
    for _ in range(2):
        wheel.close()


def test_a_lost_position_stays_lost() -> None:
    """Though the controller still says that it was homed, the driver does not believe it."""
    bench = WheelBench()
    wheel = bench.homed()
    bench.device.faults.deaf_to = {apt.Id.MOT_MOVE_HOME}
    with pytest.raises(StalledWheelError):
        wheel.home()
    bench.device.faults.deaf_to = set()
    wheel.stop()
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


def test_a_speed_that_is_a_little_off_is_refused() -> None:
    """A controller that sets a speed 2 % lower raises an error."""
    bench = WheelBench()
    bench.device.faults.weak = 0.98
    with pytest.raises(WheelError, match=r"The controller has velocity \d+\. Must be 21987328"):
        bench.wheel.connect()


def test_passing_a_target_is_no_arrival() -> None:
    """A wheel that still moves is not there, however near to its target it is seen twice."""
    bench = WheelBench()
    bench.homed()
    bench.device.faults.stands_after = 60.05
    bench.device.faults.unreported = True
    with pytest.raises(StalledWheelError, match=r"stood at 60\.05 deg for 2\.0 s"):
        bench.wheel.move_to(3)
    assert bench.sent(apt.Id.MOT_MOVE_STOP)
