"""Line to an APT controller: requests and replies, its identity, speeds and motor.

APT has no sequence numbers, and a controller reports the end of a move at any time: the next
message is not always the reply. Messages are told apart by identifier, source and channel.

A controller that is addressed wrongly says nothing, one that was just switched on may have speeds
near 0 and a motor without current, and one that was sold under one name may give another. So the
address is searched for, the model is checked, and each setting is read back.
"""

import logging
import threading
import time as system_time
from collections.abc import Callable
from dataclasses import replace
from typing import Final

from dbthermal.instruments import apt
from dbthermal.instruments.apt import Id
from dbthermal.instruments.filterwheel._settings import CHANNEL, MODELS, Scale, Settings
from dbthermal.instruments.transport import Transport

ATTEMPTS: Final = 2  # number of times that a request is sent before its reply counts as missing
READ_SIZE: Final = 256  # largest number of bytes that are read at once
MAXIMUM_UNSOLICITED: Final = 65536  # [byte] an endless stream comes from another device
ACCURACY: Final = 0.01  # largest relative difference of a speed that is read back

_EVENTS = (Id.MOT_MOVE_COMPLETED, Id.MOT_MOVE_STOPPED, Id.MOT_MOVE_HOMED)
_NOTICES = (Id.HW_RESPONSE, Id.HW_RICHRESPONSE)
_LOGGER = logging.getLogger(__name__)


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

    def __init__(
        self,
        transport: Transport,
        settings: Settings,
        *,
        clock: Callable[[], float] = system_time.monotonic,
    ) -> None:
        self.unit, self.motor = settings.addresses[0]
        self._decoder = apt.Decoder((apt.HOST,), apt.CONTROLLERS)
        self._transport = transport
        self._settings = settings
        self._clock = clock
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
        for unit, motor in self._settings.addresses:
            try:
                info = self._greet(unit)
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
        tried = ", ".join(f"0x{unit:02X}" for unit, _ in self._settings.addresses)
        raise NoReplyError(f"No APT controller answered at {tried}. It must be on.")

    def prepare(self) -> None:
        """Set the speeds, read them back, and enable the motor; WheelError if it takes not all."""
        self._set_velocity()
        self._set_home()
        self._send(Id.MOD_SET_CHANENABLESTATE, CHANNEL, apt.YES)
        reply = self._request(Id.MOD_REQ_CHANENABLESTATE, Id.MOD_GET_CHANENABLESTATE)
        try:
            enabled = apt.is_enabled(reply)
        except ValueError as error:
            raise WheelError(f"Unknown state of the motor: {error}") from error
        if not enabled:
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

    def _greet(self, unit: int) -> apt.Info:
        """Begin as the maker's example does, and ask for the identity."""
        for identifier in (Id.HW_NO_FLASH_PROGRAMMING, Id.HW_STOP_UPDATEMSGS):
            self._transport.write(apt.command(identifier, destination=unit))
        request = apt.command(Id.HW_REQ_INFO, destination=unit)
        return apt.Info.parse(self._exchange(request, Id.HW_GET_INFO, unit, attempts=1))

    def _scale_of(self, info: apt.Info) -> Scale:
        """Scale of a controller, if it is one that drives this wheel."""
        expected = self._settings.serial_number
        if expected is not None and info.serial_number != expected:
            raise WrongDeviceError(f"Wrong controller {info.serial_number}. Must be {expected}.")
        for beginning, scale in MODELS.items():
            if info.model.startswith(beginning):
                return scale
        raise WrongDeviceError(
            f"Wrong device '{info.model}', number {info.serial_number}. "
            f"Its model must begin with one of {sorted(MODELS)}."
        )

    def _set_velocity(self) -> None:
        acceleration = self.scale.device_acceleration(self._settings.acceleration)
        velocity = self.scale.device_velocity(self._settings.velocity)
        speeds = apt.VelocityParameters(CHANNEL, 0, acceleration, velocity)
        self._send(Id.MOT_SET_VELPARAMS, data=speeds.pack())
        reply = self._request(Id.MOT_REQ_VELPARAMS, Id.MOT_GET_VELPARAMS)
        actual = apt.VelocityParameters.parse(reply)
        _must_agree("velocity", actual.maximum, speeds.maximum)
        _must_agree("acceleration", actual.acceleration, speeds.acceleration)

    def _set_home(self) -> None:
        """Set the speed of homing, and direction and switch where the settings give them."""
        settings = self._settings
        before = self._home_parameters()
        parameters = replace(
            before,
            direction=settings.home_direction or before.direction,
            limit_switch=settings.home_limit_switch or before.limit_switch,
            velocity=self.scale.device_velocity(settings.home_velocity),
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

    def _request(self, identifier: Id, reply: Id) -> apt.Message:
        """Reply of the motor to a request."""
        request = apt.command(identifier, CHANNEL, destination=self.motor)
        return self._exchange(request, reply, self.motor, channel=CHANNEL)

    def _exchange(
        self,
        request: bytes,
        reply: Id,
        source: int,
        *,
        channel: int | None = None,
        attempts: int = ATTEMPTS,
    ) -> apt.Message:
        """Send a request and wait for its reply; events that come between are kept.

        Only requests are repeated, never what moves the wheel. Messages that came before the
        request are not its reply. A reply that comes after its limit may be taken for that of the
        repetition, and is then older than it seems, but replies never change their order.
        """
        with self._line:
            for _ in range(attempts):
                self._collect()
                self._transport.write(request)
                message = self._wait(reply, source, channel)
                if message is not None:
                    return message
                self._decoder.discard()  # half a message whose rest did not come in time
        raise NoReplyError(
            f"No answer {reply.name} from address 0x{source:02X} in "
            f"{self._settings.reply_timeout} s. "
            f"The controller must be on and in no other program's use.{self._reported()}"
        )

    def _wait(self, reply: Id, source: int, channel: int | None) -> apt.Message | None:
        """Read until the reply comes; None if it does not in time."""
        deadline = self._clock() + self._settings.reply_timeout
        while (remaining := deadline - self._clock()) > 0:
            if not (received := self._transport.read(READ_SIZE, remaining)):
                return None
            replies = [
                message
                for message in self._sorted(received)
                if (message.id, message.source) == (reply, source)
                and (channel is None or channel == _channel(message))
            ]
            if replies:
                return replies[-1]
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
        with self._line:
            self._collect()
        self._events.clear()
        self.raise_notice()

    def _reported(self) -> str:
        """Text of the errors that the controller reported, as a part of a message."""
        return "".join(
            f" It reported error {notice.code} of message 0x{notice.id:04X}: {notice.notes}."
            for notice in self._notices
        )


def _channel(message: apt.Message) -> int:
    """Channel that a message is about."""
    return int.from_bytes(message.data[:2], "little") if message.data else message.param1


def _must_agree(name: str, actual: int, expected: int) -> None:
    """Raise if a controller did not take a speed."""
    if abs(actual - expected) > ACCURACY * expected:
        raise WheelError(f"The controller has {name} {actual}. Must be {expected} [device units].")
