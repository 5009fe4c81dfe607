"""Filter wheel FW103 of Thorlabs on an APT stepper controller: six slots, named by their band.

`FilterWheel` is the driver, `Settings` the properties of one wheel and its controller. An FW103 is
a bare stepper stage, not to be confused with the FW102C and FW212C, which speak ASCII. It has no
encoder: its position is a count of commanded steps. A controller that stops short of its target, or
never starts, is an error here; steps lost under way are not detected until `FilterWheel.home`.

A motion is over when two things agree: the controller reports its end or the moving bits are clear,
and the wheel is where it should be. Neither is enough alone. Bits were seen to stick, the report of
an earlier move may come late, and before a move starts the bits are clear too.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, Self

from dbthermal.instruments import _apt as apt
from dbthermal.instruments._controller import (
    Controller,
    NoReplyError,
    NotHomedError,
    Settings,
    StalledWheelError,
    WheelError,
    WheelTimeoutError,
    WrongDeviceError,
)
from dbthermal.instruments.camera import Identity
from dbthermal.instruments.transport import Closing, Transport, open_serial

__all__ = [
    "FilterWheel",
    "NoReplyError",
    "NotHomedError",
    "Settings",
    "StalledWheelError",
    "WheelError",
    "WheelTimeoutError",
    "WrongDeviceError",
]
__dir__ = __all__.copy

TOLERANCE: Final = 0.1  # largest distance of the wheel from a slot [deg]
HOME_TIMEOUT: Final = 60.0  # longest search for the home switch [s]
MOVE_TIMEOUT: Final = 20.0  # longest move [s]
START_TIMEOUT: Final = 1.0  # until a move is seen to start [s]
STALL_TIMEOUT: Final = 2.0  # for which the position may not change in a move [s]
POLL_INTERVAL: Final = 0.05  # between two status requests [s]
BAUDRATE: Final = 115_200  # [bit/s]
# State that is an error; it is uncertain if a wheel's controller sets these bits.
FAULTS: Final = apt.StatusBits.POSITION_ERROR | apt.StatusBits.OVERLOAD
# Bits of a wheel that moves. The jogging bits are left out: they were seen to stick.
MOVING: Final = (
    apt.StatusBits.MOVING_FORWARD | apt.StatusBits.MOVING_REVERSE | apt.StatusBits.HOMING
)
CONFIRMATIONS: Final = 2  # status replies that must agree before a motion is over, or failed


class FilterWheel(Closing):
    """A filter wheel whose line is open, for one thread at a time; see `from_url`.

    `filters` has the band in each slot, 1 to 6. All methods raise `WheelError` or a kind of it if
    the controller reports an error, falls silent or is not connected, TransportError if it is gone.
    """

    def __init__(
        self,
        transport: Transport,
        filters: Mapping[int, str],
        settings: Settings | None = None,
    ) -> None:
        self.filters, self.settings = filters, settings or Settings()
        self._transport = transport
        self._controller = Controller(transport, self.settings)
        self._clock = transport.clock
        self._is_lost = False  # the counter may not be where the wheel is

    @classmethod
    def from_url(
        cls,
        url: str,
        filters: Mapping[int, str],
        settings: Settings | None = None,
        *,
        world: object | None = None,
    ) -> Self:
        """Open the line as `transport.open_serial`, and `connect`; the wheel does not move."""
        line = open_serial(url, baudrate=BAUDRATE, rtscts=True, world=world)
        wheel = cls(line, filters, settings)
        try:
            wheel.connect()
        except BaseException:
            wheel.close()
            raise
        return wheel

    def connect(self) -> apt.Info:
        """Find the controller, check its identity, set the speeds and enable the motor."""
        info = self._controller.find()
        self._controller.prepare()
        return info

    @property
    def is_simulated(self) -> bool:
        """True if an emulator is at the other end."""
        return self._transport.is_simulated

    def identity(self) -> Identity:
        """Model (not always that on the label), numbers and addresses of the controller."""
        controller, info = self._controller, self._controller.info
        return {
            "model": info.model,
            "serial_number": str(info.serial_number),
            "firmware": info.firmware,
            "addresses": f"0x{controller.unit:02X}, 0x{controller.motor:02X}",
            "is_simulated": self.is_simulated,
        }

    def status(self) -> apt.Status:
        """Position [count] and state of the motor."""
        return self._controller.status()

    def home(self) -> None:
        """Search for the home switch, from which all places count.

        The speeds are set before: where they are near 0, as in some controllers that were just
        switched on, homing does nothing and says nothing. StalledWheelError or WheelTimeoutError if
        the wheel does not start, stops before the switch, or takes too long, and was stopped.
        """
        self._controller.prepare()
        self._require_rest()
        self._is_lost = True
        self._controller.start_home()
        # The counter may stand while a controller searches for the switch: no stall limit.
        limits = HOME_TIMEOUT, HOME_TIMEOUT
        self._follow(_Motion("Search for home", apt.Id.MOT_MOVE_HOMED, *limits), _is_home)
        self._is_lost = False

    def move_to(self, position: int) -> None:
        """Turn a slot, 1 to 6, into the beam, and confirm that it is there.

        ValueError if the slot is another; NotHomedError if the controller was not homed since it
        was switched on, or steps may be lost since; StalledWheelError if the wheel does not move,
        stops elsewhere, or the controller reports a fault: it must be homed before the next move;
        WheelTimeoutError if it takes too long, and was stopped.
        """
        scale = self._controller.scale
        target = scale.target(position, self.settings.home_offset)
        self._require_home(self._require_rest())

        def has_arrived(motion: _Motion, status: apt.Status) -> bool:
            distance = abs(scale.degrees(status.position - target))
            return distance <= TOLERANCE and (motion.reported or motion.rests > 0)

        name = f"Move to {scale.degrees(target):.2f} deg"
        limits = MOVE_TIMEOUT, STALL_TIMEOUT
        self._controller.start_move(target)
        try:
            self._follow(_Motion(name, apt.Id.MOT_MOVE_COMPLETED, *limits), has_arrived)
        except StalledWheelError:
            self._is_lost = True
            raise

    def select(self, band: str) -> None:
        """Turn a band's filter into the beam; ValueError if it has none, else as `move_to`."""
        slots = {name: position for position, name in self.filters.items()}
        if band not in slots:
            raise ValueError(f"Invalid band '{band}' of the wheel. Must be one of {sorted(slots)}.")
        self.move_to(slots[band])

    def position(self) -> int:
        """Slot in the beam, 1 to 6; WheelError between two slots, in a move, or if not homed."""
        status = self._require_rest()
        self._require_home(status)
        scale = self._controller.scale
        position = scale.position(status.position, TOLERANCE, self.settings.home_offset)
        if position is None:
            raise WheelError(
                f"The wheel is between two slots, at {scale.degrees(status.position):.2f} deg. "
                f"Must be within {TOLERANCE} deg of one: move it."
            )
        return position

    def band(self) -> str:
        """Name of the filter in the beam; raises as `position`, and if this slot has no filter."""
        position = self.position()
        if position not in self.filters:
            known = dict(self.filters)
            raise WheelError(f"No filter in slot {position}. Filters are in {known}.")
        return self.filters[position]

    def stop(self) -> None:
        """Stop the wheel by a ramp."""
        self._controller.stop()

    def close(self) -> None:
        """Close the line; the wheel stays where it is. A second call does nothing."""
        self._transport.close()

    def _require_rest(self) -> apt.Status:
        """Status of a wheel that does not move."""
        status = self._controller.status()
        if status.bits & MOVING:
            raise WheelError("The wheel is still moving. Must be at rest: wait, or stop it.")
        return status

    def _require_home(self, status: apt.Status) -> None:
        """Raise unless the controller knows where the wheel is."""
        if self._is_lost or not status.bits & apt.StatusBits.HOMED:
            raise NotHomedError(
                "The wheel was not homed since it was switched on, or has lost steps since. "
                "Must be homed."
            )

    def _follow(self, motion: "_Motion", is_over: "Callable[[_Motion, apt.Status], bool]") -> None:
        """Poll until a motion is over; stop the wheel if it takes too long."""
        motion.began = motion.changed = self._clock()
        controller, confirmed = self._controller, 0
        while confirmed < CONFIRMATIONS:
            status = controller.status()
            controller.raise_notice()
            if faults := status.bits & FAULTS:
                controller.stop()
                raise StalledWheelError(
                    f"The controller reports {faults.name}, and the wheel was stopped. "
                    "Must be none."
                )
            motion.update(status, self._clock())
            motion.reported = controller.has_reported(motion.end)
            confirmed = confirmed + 1 if is_over(motion, status) else 0
            if not confirmed:
                self._check(motion, status)
            self._clock.sleep(POLL_INTERVAL)

    def _check(self, motion: "_Motion", status: apt.Status) -> None:
        """Raise if the wheel rests where it should not, stands still, or takes too long."""
        place = f"at {self._controller.scale.degrees(status.position):.2f} deg"
        now = self._clock()
        started = motion.moved or now - motion.began > START_TIMEOUT
        if started and motion.rests >= CONFIRMATIONS:
            action = "stopped" if motion.moved else "did not start and is"
            raise StalledWheelError(f"{motion.name}: the wheel {action} {place}. Must arrive.")
        if now - motion.began > motion.timeout:
            self._controller.stop()
            raise WheelTimeoutError(
                f"{motion.name}: the wheel was still {place} after {motion.timeout} s, and was "
                "stopped. Must arrive in this time."
            )
        if now - motion.changed > motion.stall:
            self._controller.stop()
            raise StalledWheelError(
                f"{motion.name}: the wheel stood {place} for {motion.stall} s while it should "
                "move, and was stopped. Must turn freely."
            )


@dataclass
class _Motion:
    """Name, end report and limits [s] of one motion, and its course so far, times in s."""

    name: str
    end: apt.Id
    timeout: float
    stall: float
    began: float = 0.0
    changed: float = 0.0
    last: int | None = None
    moved: bool = False
    reported: bool = False
    rests: int = 0

    def update(self, status: apt.Status, time: float) -> None:
        """Take in one status."""
        moving = bool(status.bits & MOVING)
        self.moved |= moving or (self.last is not None and status.position != self.last)
        if status.position != self.last:
            self.last, self.changed = status.position, time
        self.rests = 0 if moving else self.rests + 1


def _is_home(motion: _Motion, status: apt.Status) -> bool:
    """True if the switch was found: the homed bit alone may be that of an earlier search."""
    homed = status.bits & (apt.StatusBits.HOMED | apt.StatusBits.HOMING)
    done = motion.reported or (motion.moved and motion.rests > 0)
    return done and homed == apt.StatusBits.HOMED
