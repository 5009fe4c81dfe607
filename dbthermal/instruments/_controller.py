"""APT stepper controller of a filter wheel: requests and replies, identity, speeds, one motor.

APT has no sequence numbers, and a controller reports the end of a move at any time: the next
message is not always the reply. Messages are told apart by identifier, source and channel.

A controller that is addressed wrongly says nothing, one that was just switched on may have speeds
near 0 and a motor without current, and one that was sold under one name may give another. So the
address is searched for, the model is checked, and each setting is read back.

References
----------
pylablib 1.4.5, ``Thorlabs/kinesis.py`` (scales and units of speed); instrumentkit,
``thorlabsapt.py`` (25600 counts for an FW103); thorlabs_apt_device 0.3.8, ``bsc.py`` (the same
units, and addresses). Facts alone, no code.
"""

import logging
import threading
from dataclasses import dataclass, replace
from typing import Annotated, Final, Literal

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as checked_dataclass

from dbthermal.instruments import _apt as apt
from dbthermal.instruments._apt import Id
from dbthermal.instruments.transport import Transport

POSITIONS: Final = 6  # slots of the wheel, numbered from 1
CHANNEL: Final = 1  # of the motor at its address

ADDRESSES: Final = ((apt.RACK, apt.BAY_1), (apt.UNIT, apt.UNIT))
"""Where a controller is looked for, in order: address of its identity, and of its motor. A BSC20x
is a rack and silently ignores messages to a unit."""

REPLY_TIMEOUT: Final = 1.0  # [s]
ATTEMPTS: Final = 2  # number of times that a request is sent before its reply counts as missing
READ_SIZE: Final = 256  # largest number of bytes that are read at once
MAXIMUM_UNSOLICITED: Final = 65536  # [byte] an endless stream comes from another device
ACCURACY: Final = 0.01  # largest relative difference of a speed that is read back

_EVENTS = (Id.MOT_MOVE_COMPLETED, Id.MOT_MOVE_STOPPED, Id.MOT_MOVE_HOMED)
_NOTICES = (Id.HW_RESPONSE, Id.HW_RICHRESPONSE)
_LOGGER = logging.getLogger(__name__)

# Speeds are whole numbers of 32 bits to the controllers, which is 97 turns/s in the finer units;
# slower than the lowest a turn would take longer than the wheel is waited for.
Speed = Annotated[float, Field(strict=True, ge=0.1, le=90.0)]


@checked_dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Settings:
    """Properties of one wheel and its controller; ValueError if one is out of its range.

    Which direction and switch a wheel needs for homing is uncertain: None keeps what the controller
    has.
    """

    # Of the controller; another one is then refused.
    serial_number: Annotated[int, Field(strict=True, ge=1, lt=2**32)] | None = None
    # From the home position to slot 1 [deg]; differs by wheel: look.
    home_offset: Annotated[float, Field(strict=True, gt=-360.0, lt=360.0)] = 0.0
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

    def target(self, position: int, offset: float = 0.0) -> int:
        """Absolute place [count] of a slot, 1 to 6; `offset` [deg] is that of slot 1 after homing.

        A sixth of a turn is not a whole number of counts. Each place is rounded by itself, so that
        errors never add up. ValueError if the slot is another.
        """
        if position not in range(1, POSITIONS + 1):
            raise ValueError(f"Invalid filter position {position}. Must lie in 1 to {POSITIONS}.")
        return round(((position - 1) / POSITIONS + offset / 360.0) * self.turn)

    def position(self, count: int, tolerance: float, offset: float = 0.0) -> int | None:
        """Slot within `tolerance` [deg] of a place [count] of any turn; None between two slots."""
        sixths = (count / self.turn - offset / 360.0) * POSITIONS
        nearest = round(sixths)
        near = abs(sixths - nearest) * 360.0 / POSITIONS <= tolerance
        return nearest % POSITIONS + 1 if near else None

    def degrees(self, counts: int) -> float:
        """Angle [deg] of a number of counts."""
        return counts / self.turn * 360.0

    def device_speeds(self, velocity: float, acceleration: float) -> tuple[int, int]:
        """Velocity and acceleration in device units, of those in turns/s and turns/s^2."""
        counts = velocity * self.turn, acceleration * self.turn
        return round(counts[0] * self.velocity), round(counts[1] * self.acceleration)


# 200 full steps of 2048 microsteps, and of 128.
BSC20X: Final = Scale(turn=409_600, velocity=53.68, acceleration=53.68 * 204.94e-6)
BSC10X: Final = Scale(turn=25_600, velocity=1.0, acceleration=1.0)
# Beginnings of the model names that are accepted; some BSC201 call themselves SCC201.
MODELS: Final = {"BSC20": BSC20X, "SCC20": BSC20X, "BSC10": BSC10X, "BSC00": BSC10X}


class WheelError(RuntimeError):
    """The wheel or its controller does not do what it should."""


class NoReplyError(WheelError, TimeoutError):
    """The controller did not reply in time."""


class WheelTimeoutError(WheelError, TimeoutError):
    """The wheel moved, but did not arrive in time."""


class WrongDeviceError(WheelError):
    """Another device is at this address."""


class StalledWheelError(WheelError):
    """The wheel does not move, or stopped elsewhere."""


class NotHomedError(WheelError):
    """The controller does not know where the wheel is."""


class Controller:
    """One motor of a controller at the other end of a line, for one thread at a time.

    `unit` and `motor` are its addresses, `info` and `scale` its identity and its units: valid after
    `find`. The line stays the caller's to close. All raise TransportError if the device is gone,
    and NoReplyError if it is silent.
    """

    def __init__(self, transport: Transport, settings: Settings) -> None:
        self.unit, self.motor = ADDRESSES[0]
        self._decoder = apt.Decoder((apt.HOST,), apt.CONTROLLERS)
        self._transport = transport
        self._settings = settings
        self._clock = transport.clock
        self._info: apt.Info | None = None
        # A recorder asks for the position in a thread of its own, while others turn the wheel.
        self._line = threading.Lock()
        self._events: list[apt.Message] = []
        self._notices: list[apt.Notice] = []

    @property
    def info(self) -> apt.Info:
        """Identity of the controller; `WheelError` before `find`."""
        if self._info is None:
            raise WheelError(
                "The wheel is not connected. Must be opened by `FilterWheel.from_url`."
            )
        return self._info

    @property
    def scale(self) -> Scale:
        """Units of the controller; `WheelError` before `find`."""
        return self._scale_of(self.info)

    def find(self) -> apt.Info:
        """Search for a controller at each address, and check its model and serial number.

        WrongDeviceError if the device is another one.
        """
        for unit, motor in ADDRESSES:
            try:
                for identifier in (Id.HW_NO_FLASH_PROGRAMMING, Id.HW_STOP_UPDATEMSGS):
                    self._transport.write(apt.command(identifier, destination=unit))
                info = apt.Info.parse(self._request(Id.HW_REQ_INFO, Id.HW_GET_INFO, unit=unit))
            except NoReplyError:
                continue
            self._scale_of(info)
            self._info, self.unit, self.motor = info, unit, motor
            self._collect()
            self._notices.clear()  # it need not know all messages of the greeting
            return info
        if dropped := self._decoder.dropped:
            raise WrongDeviceError(
                f"{dropped} bytes came that are no APT messages. Must be an APT controller."
            )
        tried = ", ".join(f"0x{unit:02X}" for unit, _ in ADDRESSES)
        raise NoReplyError(f"No APT controller answered at {tried}. It must be on.")

    def prepare(self) -> None:
        """Set the speeds, read them back, and enable the motor; WheelError if it takes not all."""
        wanted = self._settings.velocity, self._settings.acceleration
        velocity, acceleration = self.scale.device_speeds(*wanted)
        speeds = apt.VelocityParameters(CHANNEL, 0, acceleration, velocity)
        self._send(Id.MOT_SET_VELPARAMS, data=speeds.pack())
        reply = self._request(Id.MOT_REQ_VELPARAMS, Id.MOT_GET_VELPARAMS)
        actual = apt.VelocityParameters.parse(reply)
        _must_agree("velocity", actual.maximum, speeds.maximum)
        _must_agree("acceleration", actual.acceleration, speeds.acceleration)
        self._set_home()
        self._send(Id.MOD_SET_CHANENABLESTATE, CHANNEL, apt.YES)
        reply = self._request(Id.MOD_REQ_CHANENABLESTATE, Id.MOD_GET_CHANENABLESTATE)
        if reply.param2 not in {apt.YES, apt.NO}:
            raise WheelError(f"Unknown state {reply.param2} of the motor. Must be 1 or 2.")
        if reply.param2 == apt.NO:
            raise WheelError("The controller did not enable the motor. It must be connected.")
        self.raise_notice()

    def status(self) -> apt.Status:
        """Position and state of the motor."""
        return apt.Status.parse(self._request(Id.MOT_REQ_STATUSUPDATE, Id.MOT_GET_STATUSUPDATE))

    def start_home(self) -> None:
        """Begin to search for the home switch; raises as `start_move`."""
        self._forget_events()
        self._send(Id.MOT_MOVE_HOME, CHANNEL)

    def start_move(self, target: int) -> None:
        """Begin a move to an absolute place [count]; WheelError if an error was reported before."""
        self._forget_events()
        self._send(Id.MOT_MOVE_ABSOLUTE, data=apt.Position(CHANNEL, target).pack())

    def stop(self) -> None:
        """Stop by a ramp."""
        self._send(Id.MOT_MOVE_STOP, CHANNEL, apt.NO)

    def has_reported(self, identifier: Id) -> bool:
        """True if the motor reported this since the last start of a motion."""
        return (identifier, self.motor) in {(event.id, event.source) for event in self._events}

    def raise_notice(self) -> None:
        """WheelError with the text of the errors that the controller reported by itself."""
        if self._notices:
            reported = self._reported()
            self._notices.clear()
            raise WheelError(f"The controller is not well.{reported}")

    def _scale_of(self, info: apt.Info) -> Scale:
        """Scale of a controller, if it is one that drives this wheel."""
        expected = self._settings.serial_number
        if expected is not None and info.serial_number != expected:
            raise WrongDeviceError(f"Wrong controller {info.serial_number}. Must be {expected}.")
        for beginning, scale in MODELS.items():
            if info.model.startswith(beginning):
                return scale
        rule = f"Its model must begin with one of {sorted(MODELS)}"
        raise WrongDeviceError(f"Wrong device '{info.model}', number {info.serial_number}. {rule}.")

    def _set_home(self) -> None:
        """Set the speed of homing, and direction and switch where the settings give them."""
        settings = self._settings
        before = self._home_parameters()
        parameters = replace(
            before,
            direction=settings.home_direction or before.direction,
            limit_switch=settings.home_limit_switch or before.limit_switch,
            velocity=self.scale.device_speeds(settings.home_velocity, 0.0)[0],
        )
        self._send(Id.MOT_SET_HOMEPARAMS, data=parameters.pack())
        actual = self._home_parameters()
        _must_agree("home velocity", actual.velocity, parameters.velocity)
        if replace(actual, velocity=parameters.velocity) != parameters:
            raise WheelError(f"The controller has {actual}. Must be {parameters}.")

    def _home_parameters(self) -> apt.HomeParameters:
        reply = self._request(Id.MOT_REQ_HOMEPARAMS, Id.MOT_GET_HOMEPARAMS)
        return apt.HomeParameters.parse(reply)

    def _send(self, identifier: Id, channel: int = 0, value: int = 0, data: bytes = b"") -> None:
        """Send a message without a reply to the motor; TransportError if the device is gone."""
        message = apt.command(identifier, channel, value, data=data, destination=self.motor)
        self._transport.write(message)

    def _request(self, identifier: Id, reply: Id, *, unit: int | None = None) -> apt.Message:
        """Reply of the motor to a request, or of a unit; events that come between are kept.

        Only requests are repeated, never what moves the wheel. Messages that came before the
        request are not its reply. A reply that comes after its limit may be taken for that of the
        repetition, and is then older than it seems, but replies never change their order.
        """
        source, channel = (self.motor, CHANNEL) if unit is None else (unit, 0)
        request = apt.command(identifier, channel, destination=source)
        with self._clock.hold(self._line):
            for _ in range(ATTEMPTS if unit is None else 1):
                self._collect()
                self._transport.write(request)
                if (message := self._wait(reply, source, channel)) is not None:
                    return message
                self._decoder.discard()  # half a message whose rest did not come in time
        raise NoReplyError(
            f"No answer {reply.name} from address 0x{source:02X} in {REPLY_TIMEOUT} s. "
            f"The controller must be on and in no other program's use.{self._reported()}"
        )

    def _wait(self, reply: Id, source: int, channel: int) -> apt.Message | None:
        """Read until the reply comes, of a channel unless 0; None if it does not in time."""
        deadline = self._clock() + REPLY_TIMEOUT
        while (remaining := deadline - self._clock()) > 0:
            if not (received := self._transport.read(READ_SIZE, remaining)):
                return None
            for message in reversed(self._sorted(received)):
                about = (
                    int.from_bytes(message.data[:2], "little") if message.data else message.param1
                )
                if (message.id, message.source) == (reply, source) and channel in {0, about}:
                    return message
        return None

    def _collect(self) -> None:
        """Take in all bytes that have come so far."""
        count = 0
        while received := self._transport.read(READ_SIZE, 0.0):
            self._sorted(received)
            count += len(received)
            if count > MAXIMUM_UNSOLICITED:
                raise WrongDeviceError(
                    f"More than {MAXIMUM_UNSOLICITED} unsolicited bytes came. Must be an APT "
                    "controller."
                )

    def _sorted(self, received: bytes) -> list[apt.Message]:
        """Keep events and notices, return the other messages."""
        others = []
        for message in self._decoder.feed(received):
            if message.id in _EVENTS:
                self._events.append(message)
            elif message.id in _NOTICES:
                notice = apt.Notice.parse(message)
                _LOGGER.warning("Controller of the filter wheel: %s", notice)
                self._notices.append(notice)
            else:
                others.append(message)
        return others

    def _forget_events(self) -> None:
        """Forget the ends of earlier motions, and raise the errors that were reported."""
        with self._clock.hold(self._line):
            self._collect()
        self._events.clear()
        self.raise_notice()

    def _reported(self) -> str:
        """Text of the errors that the controller reported, as a part of a message."""
        return "".join(
            f" It reported error {notice.code} of message 0x{notice.id:04X}: {notice.notes}."
            for notice in self._notices
        )


def _must_agree(name: str, actual: int, expected: int) -> None:
    """Raise if a controller did not take a speed."""
    if abs(actual - expected) > ACCURACY * expected:
        raise WheelError(f"The controller has {name} {actual}. Must be {expected} [device units].")
