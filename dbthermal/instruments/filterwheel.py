"""Filter wheel FW103 of Thorlabs on an APT stepper controller: six slots, named by their band.

`FilterWheel` is the driver, `Settings` the properties of a wheel and its controller. An FW103 is a
bare stepper stage, not to be confused with the FW102C and FW212C, which speak ASCII. It has no
encoder: its position is a count of commanded steps. A controller that stops short of its target, or
never starts, is an error here; steps lost under way are not detected until `FilterWheel.home`.

A controller that was just switched on may have speeds near 0 and a motor without current: each
setting is read back. A motion is over when the controller reports its end or the moving bits are
clear, and the wheel is where it should be. Neither is enough alone: bits were seen to stick, the
report of an earlier move may come late, and before a move starts the bits are clear too.

Facts alone, no code, were taken from pylablib 1.4.5, ``Thorlabs/kinesis.py`` (scales and units of
speed), instrumentkit, ``thorlabsapt.py`` (25600 counts for an FW103), and thorlabs_apt_device
0.3.8, ``bsc.py`` (the same units, and addresses).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntFlag
from typing import Annotated, Final, Literal

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as checked_dataclass

from dbthermal.instruments import _apt as apt
from dbthermal.instruments._apt import CHANNEL, Controller, Id, NoReplyError, WheelError
from dbthermal.instruments.camera import Identity
from dbthermal.instruments.transport import Closing, Transport

__all__ = [
    "FilterWheel",
    "NoReplyError",
    "NotHomedError",
    "Settings",
    "StalledWheelError",
    "WheelError",
]
__dir__ = __all__.copy

POSITIONS: Final = 6  # slots of the wheel, numbered from 1
BAUDRATE: Final = 115_200  # [bit/s]
ACCURACY: Final = 0.01  # largest relative difference of a setting that is read back

TOLERANCE: Final = 0.1  # largest distance of the wheel from a slot [deg]
HOME_TIMEOUT: Final = 60.0  # longest search for the home switch [s]
MOVE_TIMEOUT: Final = 20.0  # longest move [s]
START_TIMEOUT: Final = 1.0  # until a move is seen to start [s]
STALL_TIMEOUT: Final = 2.0  # for which the position may not change in a move [s]
POLL_INTERVAL: Final = 0.05  # between two status requests [s]
CONFIRMATIONS: Final = 2  # status replies that must agree before a motion is over, or failed


class StatusBits(IntFlag):
    """State of a motor: the bits that a filter wheel needs; the rest are kept as they come."""

    MOVING_FORWARD = 1 << 4
    MOVING_REVERSE = 1 << 5
    JOGGING_FORWARD = 1 << 6
    JOGGING_REVERSE = 1 << 7
    CONNECTED = 1 << 8
    HOMING = 1 << 9
    HOMED = 1 << 10
    # Bit 12 is read as "tracking" by some and as "interlock" by others.
    POSITION_ERROR = 1 << 14
    OVERLOAD = 1 << 24
    ENABLED = 1 << 31


# State that is an error; it is uncertain if a wheel's controller sets these bits.
FAULTS: Final = StatusBits.POSITION_ERROR | StatusBits.OVERLOAD
# Bits of a wheel that moves. The jogging bits are left out: they were seen to stick.
MOVING: Final = StatusBits.MOVING_FORWARD | StatusBits.MOVING_REVERSE | StatusBits.HOMING

# Speeds are whole numbers of 32 bits to the controllers, which is 97 turns/s in the finer units;
# slower than the lowest a turn would take longer than the wheel is waited for.
Speed = Annotated[float, Field(strict=True, ge=0.1, le=90.0)]


@checked_dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Settings:
    """Properties of a wheel and its controller; ValueError if one is out of its range."""

    # Of the controller; any other is then refused.
    serial_number: Annotated[int, Field(strict=True, ge=1, lt=2**32)] | None = None
    # From the home position to slot 1 [deg]; differs by wheel: look.
    home_offset: Annotated[float, Field(strict=True, gt=-360.0, lt=360.0)] = 0.0
    # Which direction and switch a wheel needs is uncertain: None keeps what the controller has.
    home_direction: Literal[1, 2] | None = None  # 1 forward, 2 reverse
    home_limit_switch: Literal[1, 4] | None = None  # 1 the reverse switch, 4 the forward one
    velocity: Speed = 1.0  # [turn/s]
    home_velocity: Speed = 0.2  # [turn/s]
    acceleration: Annotated[float, Field(strict=True, ge=0.1, le=1e5)] = 1.0  # [turn/s^2]


@dataclass(frozen=True)
class Scale:
    """Units of a controller."""

    turn: int  # counts of one turn of the wheel
    velocity: float  # device units of one count/s
    acceleration: float  # device units of one count/s^2

    def target(self, position: int, offset: float) -> int:
        """Absolute place [count] of a slot, 1 to 6, or ValueError; offset of slot 1 [deg]."""
        if position not in range(1, POSITIONS + 1):
            raise ValueError(f"Invalid filter position {position}. Must lie in 1 to {POSITIONS}.")
        # Each place is rounded by itself, so that errors never add up.
        return round(((position - 1) / POSITIONS + offset / 360.0) * self.turn)

    def position(self, count: float, offset: float, tolerance: float = TOLERANCE) -> int | None:
        """Slot within a tolerance [deg] of a place [count] of any turn; None between two slots."""
        sixths = (count / self.turn - offset / 360.0) * POSITIONS
        nearest = round(sixths)
        near = abs(sixths - nearest) * 360.0 / POSITIONS <= tolerance
        return nearest % POSITIONS + 1 if near else None

    def degrees(self, counts: int) -> float:
        """Angle [deg] of a number of counts."""
        return counts / self.turn * 360.0


# 200 full steps of 2048 microsteps, and of 128.
BSC20X: Final = Scale(turn=409_600, velocity=53.68, acceleration=53.68 * 204.94e-6)
BSC10X: Final = Scale(turn=25_600, velocity=1.0, acceleration=1.0)
# First five letters of the model names that are accepted; some BSC201 call themselves SCC201.
MODELS: Final = {"BSC20": BSC20X, "SCC20": BSC20X, "BSC10": BSC10X, "BSC00": BSC10X}


class StalledWheelError(WheelError):
    """The wheel does not move, or stopped elsewhere."""


class NotHomedError(WheelError):
    """The controller does not know where the wheel is."""


class FilterWheel(Closing):
    """A filter wheel at the end of an open line, for one thread at a time; `connect` comes first.

    `filters` has the band in each slot, 1 to 6. All methods raise `WheelError` or a kind of it if
    the controller reports an error, falls silent or is not connected, TransportError if it is gone.
    """

    def __init__(
        self, transport: Transport, filters: Mapping[int, str], settings: Settings | None = None
    ) -> None:
        self.filters, self.settings = filters, settings or Settings()
        self.is_simulated = transport.is_simulated
        self._transport, self._clock = transport, transport.clock
        self._controller = Controller(transport)
        self._identity: Identity = {}  # until it is connected
        self._scale = BSC20X
        self._is_lost = False  # the counter may not be where the wheel is

    def connect(self) -> None:
        """Find and check the controller, set the speeds, enable the motor; nothing moves."""
        info, expected = self._controller.connect(), self.settings.serial_number
        model = apt.text(info.model)
        if expected is not None and info.serial_number != expected:
            raise WheelError(f"Wrong controller {info.serial_number}. Must be {expected}.")
        if (beginning := model[:5]) not in MODELS:
            rule = f"Its model must begin with one of {sorted(MODELS)}"
            raise WheelError(f"Wrong device '{model}', number {info.serial_number}. {rule}.")
        self._scale = MODELS[beginning]
        self._identity = {
            "model": model,
            "serial_number": str(info.serial_number),
            "firmware": f"{info.major}.{info.interim}.{info.minor}",
            "addresses": f"0x{self._controller.unit:02X}, 0x{self._controller.motor:02X}",
            "is_simulated": self.is_simulated,
        }
        self._prepare()

    def identity(self) -> Identity:
        """Model (not always that on the label), numbers and addresses of the controller."""
        if not self._identity:
            raise WheelError("The wheel is not connected. Must be, by `FilterWheel.connect`.")
        return self._identity

    def status(self) -> apt.Status:
        """Position [count] and state of the motor."""
        return apt.parse(apt.Status, self._controller.request(Id.MOT_REQ_STATUSUPDATE))

    def home(self) -> None:
        """Search for the home switch, where places count from; StalledWheelError, WheelError."""
        self.identity()
        self._prepare()
        self._resting(homed=False)
        self._is_lost = True
        self._controller.begin(Id.MOT_MOVE_HOME, CHANNEL)
        # The counter may stand while a controller searches for the switch: no stall limit. The
        # homed bit alone may be that of an earlier search: the wheel must have moved.
        action = "Search for home", Id.MOT_MOVE_HOMED, (HOME_TIMEOUT, HOME_TIMEOUT)
        mask = StatusBits.HOMED | StatusBits.HOMING
        self._follow(*action, lambda status: status.bits & mask == StatusBits.HOMED)
        self._is_lost = False

    def move_to(self, position: int) -> None:
        """Turn a slot, 1 to 6, into the beam, and confirm that it is there; ValueError for another.

        NotHomedError if the controller was not homed since it was switched on, or lost steps since;
        StalledWheelError, after which it must be homed, if the wheel does not move, stops elsewhere
        or has a fault; WheelError if it takes too long, and was stopped.
        """
        target = (scale := self._scale).target(position, self.settings.home_offset)
        self._resting(homed=True)
        # The move, until the wheel is there.
        self._controller.begin(Id.MOT_MOVE_ABSOLUTE, data=apt.pack(apt.Position(CHANNEL, target)))
        name, limits = f"Move to {scale.degrees(target):.2f} deg", (MOVE_TIMEOUT, STALL_TIMEOUT)

        def arrived(status: apt.Status) -> bool:
            return abs(scale.degrees(status.position - target)) <= TOLERANCE

        try:
            self._follow(name, Id.MOT_MOVE_COMPLETED, limits, arrived)
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
        status = self._resting(homed=True)
        position = self._scale.position(status.position, self.settings.home_offset)
        if position is None:
            label = f"The wheel is between two slots, {self._place(status)}"
            raise WheelError(f"{label}. Must be within {TOLERANCE} deg of one: move it.")
        return position

    def band(self) -> str:
        """Name of the filter in the beam; raises as `position`, and if this slot has no filter."""
        position = self.position()
        if position not in self.filters:
            raise WheelError(f"No filter in slot {position}. Filters are in {dict(self.filters)}.")
        return self.filters[position]

    def stop(self) -> None:
        """Stop the wheel by a ramp."""
        self._controller.send(Id.MOT_MOVE_STOP, CHANNEL, apt.NO)

    def close(self) -> None:
        """Close the line; the wheel stays where it is. A second call does nothing."""
        self._transport.close()

    def _prepare(self) -> None:
        """Set the speeds, read them back, and enable the motor; WheelError if it takes not all."""
        settings, scale, request = self.settings, self._scale, self._controller.request
        # The speeds of moves.
        speed = scale.turn * scale.velocity  # of one turn/s [device units]
        acceleration = round(settings.acceleration * scale.turn * scale.acceleration)
        speeds = apt.Speeds(CHANNEL, 0, acceleration, round(settings.velocity * speed))
        self._set("", Id.MOT_SET_VELPARAMS, speeds)
        # The speed of homing, and direction and switch where the settings have them.
        before = apt.parse(apt.Home, request(Id.MOT_REQ_HOMEPARAMS))
        home = before._replace(
            direction=settings.home_direction or before.direction,
            limit_switch=settings.home_limit_switch or before.limit_switch,
            velocity=round(settings.home_velocity * speed),
        )
        self._set("home ", Id.MOT_SET_HOMEPARAMS, home)
        # The motor's current.
        self._controller.send(Id.MOD_SET_CHANENABLESTATE, CHANNEL, apt.YES)
        state = request(Id.MOD_REQ_CHANENABLESTATE).param2
        if state not in {apt.YES, apt.NO}:
            raise WheelError(f"Unknown state {state} of the motor. Must be 1 or 2.")
        if state == apt.NO:
            raise WheelError("The controller did not enable the motor. It must be connected.")
        self._controller.check()

    def _set(self, prefix: str, identifier: Id, wanted: apt.Speeds | apt.Home) -> None:
        """Set a record of numbers, and read it back; WheelError if the controller has others."""
        self._controller.send(identifier, data=apt.pack(wanted))
        actual = apt.parse(type(wanted), self._controller.request(Id(identifier + 1)))
        for name in reversed(wanted._fields):
            value, expected = getattr(actual, name), getattr(wanted, name)
            is_used = name != "minimum"  # the controllers ignore this speed
            if is_used and abs(value - expected) > ACCURACY * abs(expected):
                has = f"The controller has {prefix}{name} {value}"
                raise WheelError(f"{has}. Must be {expected} [device units].")

    def _resting(self, *, homed: bool) -> apt.Status:
        """Status of a wheel that must not move, and whose place the controller must know."""
        self.identity()  # once it is connected
        status = self.status()
        if status.bits & MOVING:
            raise WheelError("The wheel is still moving. Must be at rest: wait, or stop it.")
        if homed and (self._is_lost or not status.bits & StatusBits.HOMED):
            label = "The wheel was not homed since it was switched on, or has lost steps since"
            raise NotHomedError(f"{label}. Must be homed.")
        return status

    def _place(self, status: apt.Status) -> str:
        return f"at {self._scale.degrees(status.position):.2f} deg"

    def _follow(
        self, name: str, end: Id, limits: tuple[float, float], goal: Callable[[apt.Status], bool]
    ) -> None:
        """Poll until a motion is at its goal; raise if it fails, with a moving wheel stopped."""
        # Limits are the longest motion, and the longest time at one place [s].
        start = changed = self._clock()
        moved, rests, confirmed, count = False, 0, 0, None
        while confirmed < CONFIRMATIONS:
            status = self.status()
            self._controller.check()
            if faults := status.bits & FAULTS:
                self.stop()
                label = f"The controller reports {StatusBits(faults).name}"
                raise StalledWheelError(f"{label}, and the wheel was stopped. Must be none.")
            # The course of the motion so far.
            now, moving = self._clock(), bool(status.bits & MOVING)
            moved |= moving or count not in {None, status.position}
            if status.position != count:
                count, changed = status.position, now
            rests = 0 if moving else rests + 1
            # Over, by its end and its place; in a search for home the wheel must have moved.
            rested = rests > 0 and (moved or end is not Id.MOT_MOVE_HOMED)
            ended = rested or end in self._controller.ended
            confirmed = confirmed + 1 if ended and goal(status) else 0
            # Failed: at rest elsewhere, too long under way, or standing still.
            place = self._place(status)
            if confirmed:
                pass  # until it is confirmed as often as needed
            elif rests >= CONFIRMATIONS and (moved or now - start > START_TIMEOUT):
                action = "stopped" if moved else "did not start and is"
                raise StalledWheelError(f"{name}: the wheel {action} {place}. Must arrive.")
            elif now - start > limits[0]:
                self.stop()
                label = f"{name}: the wheel was still {place} after {limits[0]} s, and was stopped"
                raise WheelError(f"{label}. Must arrive in this time.")
            elif now - changed > limits[1]:
                self.stop()
                label = f"{name}: the wheel stood {place} for {limits[1]} s while it should move"
                raise StalledWheelError(f"{label}, and was stopped. Must turn freely.")
            self._clock.sleep(POLL_INTERVAL)
