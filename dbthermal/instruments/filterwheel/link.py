"""Talk with an APT controller: questions and their answers, and what it says unasked.

APT has no sequence numbers, and a controller reports the end of a move whenever it comes: the next
message is not always the answer. Messages are told apart by identifier, source and channel.
"""

import logging
import time as system_time
from collections.abc import Callable
from typing import Final

from dbthermal.instruments import apt
from dbthermal.instruments.transport import Transport

ATTEMPTS: Final = 2
"""How often a question is asked before its answer is missed."""

READ_SIZE: Final = 256
"""Most bytes that are read at once."""

MAXIMUM_UNASKED: Final = 65536
"""Most bytes that may have come unasked: a line that talks without end is another device's."""

_EVENTS = (apt.Id.MOT_MOVE_COMPLETED, apt.Id.MOT_MOVE_STOPPED, apt.Id.MOT_MOVE_HOMED)
_NOTICES = (apt.Id.HW_RESPONSE, apt.Id.HW_RICHRESPONSE)
_LOGGER = logging.getLogger(__name__)


class WheelError(RuntimeError):
    """The wheel or its controller does not do what it should."""


class NoReplyError(WheelError, TimeoutError):
    """The controller did not answer in time."""


class WheelTimeoutError(WheelError, TimeoutError):
    """The wheel moved, but did not arrive in time."""


class WrongDeviceError(WheelError):
    """Another device is at this name."""


class ControllerError(WheelError):
    """The controller itself reported an error."""


class StalledWheelError(WheelError):
    """The wheel does not move, or stopped elsewhere."""


class NotHomedError(WheelError):
    """The controller does not know where the wheel is."""


class Link:
    """
    One controller at the other end of a line, for one thread at a time.

    Parameters
    ----------
    transport : Transport
        Open; who made the link closes it.
    reply_timeout : float
        Longest wait for an answer [s].
    clock : callable
        Gives the time [s].

    Attributes
    ----------
    decoder : Decoder
        Counts the bytes that were no message.
    """

    def __init__(
        self,
        transport: Transport,
        *,
        reply_timeout: float,
        clock: Callable[[], float] = system_time.monotonic,
    ) -> None:
        self.decoder = apt.Decoder((apt.HOST,), apt.CONTROLLERS)
        self._transport = transport
        self._reply_timeout = reply_timeout
        self._clock = clock
        self._events: list[apt.Message] = []
        self._notices: list[apt.Notice] = []

    def send(self, request: bytes) -> None:
        """Send a message that has no answer; `TransportError` if the device is gone."""
        self._transport.write(request)

    def ask(
        self,
        request: bytes,
        reply: apt.Id,
        *,
        source: int,
        channel: int | None = None,
        attempts: int = ATTEMPTS,
    ) -> apt.Message:
        """
        Ask, and wait for the answer; what comes between is kept if it is an event.

        Only questions are repeated, never what moves the wheel. What came before the question is
        no answer to it. One that comes after its limit may be taken for that of the repetition,
        and is then older than it seems, but answers never change their order.

        Parameters
        ----------
        request : bytes
            A message.
        reply : Id
            Of its answer.
        source : int
            Address that answers.
        channel : int, optional
            That must answer; any, unless given.
        attempts : int
            How often to ask.

        Returns
        -------
        Message
            The answer.

        Raises
        ------
        NoReplyError
            If there was none.
        WrongDeviceError
            If more than `MAXIMUM_UNASKED` bytes came before.
        TransportError
            If the device is gone.
        """
        for _ in range(attempts):
            self._collect()
            self._transport.write(request)
            answer = self._wait(reply, source, channel)
            if answer is not None:
                return answer
            self.decoder.discard()  # half a message whose rest did not come in time
        raise NoReplyError(
            f"No answer {reply.name} from address 0x{source:02X} in {self._reply_timeout} s. "
            f"The controller must be on and in no other program's use.{self._reported()}"
        )

    def forget_events(self) -> None:
        """Forget which motions have ended, before a new one is begun."""
        self._collect()
        self._events.clear()

    def forget_notices(self) -> None:
        """Forget the errors that the controller reported; they are in the log."""
        self._collect()
        self._notices.clear()

    def take_event(self, identifier: apt.Id, source: int) -> bool:
        """Whether the controller reported this since `forget_events`, or the last call."""
        kept = [event for event in self._events if (event.id, event.source) != (identifier, source)]
        found = len(kept) < len(self._events)
        self._events = kept
        return found

    def raise_notice(self) -> None:
        """
        Raise what the controller reported by itself, if it did.

        Raises
        ------
        ControllerError
            With its text.
        """
        if self._notices:
            reported = self._reported()
            self._notices.clear()
            raise ControllerError(f"The controller is not well.{reported}")

    def _wait(self, reply: apt.Id, source: int, channel: int | None) -> apt.Message | None:
        """Read until the answer comes or time is up."""
        deadline = self._clock() + self._reply_timeout
        while (left := deadline - self._clock()) > 0:
            received = self._transport.read(READ_SIZE, left)
            if not received:
                return None
            answers = [
                message
                for message in self._sorted(received)
                if (message.id, message.source) == (reply, source)
                and (channel is None or channel == _channel(message))
            ]
            if answers:
                return answers[-1]
        return None

    def _collect(self) -> None:
        """Take in what has come so far."""
        count = 0
        while received := self._transport.read(READ_SIZE, 0.0):
            self._sorted(received)
            count += len(received)
            if count > MAXIMUM_UNASKED:
                raise WrongDeviceError(
                    f"More than {MAXIMUM_UNASKED} bytes came unasked. Must be an APT controller."
                )

    def _sorted(self, received: bytes) -> list[apt.Message]:
        """Keep events and notices, return the other messages."""
        others = []
        for message in self.decoder.feed(received):
            if message.id in _EVENTS:
                self._events.append(message)
            elif message.id in _NOTICES:
                self._note(apt.Notice.parse(message))
            else:
                others.append(message)
        return others

    def _note(self, notice: apt.Notice) -> None:
        """Keep an error that the controller reports."""
        _LOGGER.warning("Controller of the filter wheel: %s", notice)
        self._notices.append(notice)

    def _reported(self) -> str:
        """Return what the controller reported, as a part of a message."""
        return "".join(
            f" It reported error {notice.code} of message 0x{notice.id:04X}: {notice.notes}."
            for notice in self._notices
        )


def _channel(message: apt.Message) -> int:
    """Return the channel that a message is about."""
    return int.from_bytes(message.data[:2], "little") if message.data else message.param1
