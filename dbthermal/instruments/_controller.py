"""An APT controller at the end of a line: requests, replies, and what it reports by itself.

A controller that is addressed wrongly says nothing: its address is searched for. APT has no
sequence numbers, and a controller reports the end of a move at any time: the next message is not
always the reply. So messages are identified by identifier, source and channel.
"""

import logging
import threading
from typing import Final

from dbthermal.instruments import _apt as apt
from dbthermal.instruments._apt import Id, Message
from dbthermal.instruments.transport import Transport

CHANNEL: Final = 1  # of the motor at its address

SEARCHED: Final = ((apt.RACK, apt.BAY_1), (apt.UNIT, apt.UNIT))
"""Where a controller is looked for, in order: address of its identity, and of its motor. A BSC20x
is a rack and silently ignores messages to a unit."""

REPLY_TIMEOUT: Final = 1.0  # [s]
ATTEMPTS: Final = 2  # number of times that a request is sent before its reply counts as missing
MAXIMUM_UNSOLICITED: Final = 65536  # [byte] an endless stream comes from another device

_READ_SIZE = 256  # largest number of bytes that are read at once
_LOGGER = logging.getLogger(__name__)


class WheelError(RuntimeError):
    """The wheel or its controller does not do what it should."""


class NoReplyError(WheelError, TimeoutError):
    """The controller did not reply in time."""


class Controller:
    """Requests to a controller and its replies, with what it reports by itself.

    The reply to a request has the next number, see `Id`.
    """

    def __init__(self, transport: Transport) -> None:
        self.unit, self.motor = SEARCHED[0]
        self.decoder = apt.Decoder((apt.HOST,), apt.CONTROLLERS)
        self._transport, self._clock = transport, transport.clock
        # A recorder asks for the position in one thread while another turns the wheel.
        self._lock = threading.Lock()
        self._ended: set[tuple[int, int]] = set()  # identifier and source of ends of a motion
        self._notices: list[str] = []  # a sentence each

    def connect(self) -> apt.Info:
        """Find the address of the controller, and return its identity."""
        for self.unit, self.motor in SEARCHED:
            for identifier in (Id.HW_NO_FLASH_PROGRAMMING, Id.HW_STOP_UPDATEMSGS):
                self._transport.write(apt.encode(Message(identifier, destination=self.unit)))
            try:
                reply = self.request(Id.HW_REQ_INFO, self.unit, 0, attempts=1)
            except NoReplyError:
                continue
            self._collect()
            self._notices.clear()  # it need not know all messages of the greeting
            return apt.parse(apt.Info, reply)
        if self.decoder.dropped:
            raise WheelError(
                f"{self.decoder.dropped} bytes came that are no APT messages. "
                "Must be an APT controller."
            )
        tried = ", ".join(f"0x{unit:02X}" for unit, _ in SEARCHED)
        raise NoReplyError(f"No APT controller answered at {tried}. It must be on.")

    def send(self, identifier: Id, channel: int = 0, value: int = 0, data: bytes = b"") -> None:
        """Send a message without a reply to the motor."""
        message = Message(identifier, channel, value, self.motor, apt.HOST, data)
        self._transport.write(apt.encode(message))

    def begin(self, identifier: Id, channel: int = 0, data: bytes = b"") -> None:
        """Send the start of a motion, once earlier ends are forgotten; WheelError as `check`."""
        with self._clock.hold(self._lock):
            self._collect()
        self._ended.clear()
        self.check()
        self.send(identifier, channel, data=data)

    def has_reported(self, identifier: Id) -> bool:
        """True if the motor reported this since the last start of a motion."""
        return (identifier, self.motor) in self._ended

    def check(self) -> None:
        """WheelError with the text of the errors that the controller reported by itself."""
        if self._notices:
            reported = "".join(self._notices)
            self._notices.clear()
            raise WheelError(f"The controller is not well.{reported}")

    def request(
        self,
        identifier: Id,
        unit: int | None = None,
        channel: int = CHANNEL,
        *,
        attempts: int = ATTEMPTS,
    ) -> Message:
        """Reply to a request, of the motor by default, of any channel if 0; or NoReplyError.

        Only requests are repeated, never what moves the wheel. What came before is not the reply; a
        late one may be taken for that of the repetition, and is older than it seems, but replies
        stay in order.
        """
        unit, reply = unit or self.motor, Id(identifier + 1)
        request = apt.encode(Message(identifier, channel, 0, unit))
        with self._clock.hold(self._lock):
            for _ in range(attempts):
                self._collect()
                self._transport.write(request)
                deadline = self._clock() + REPLY_TIMEOUT
                while (remaining := deadline - self._clock()) > 0:
                    if not (received := self._transport.read(_READ_SIZE, remaining)):
                        break
                    for message in reversed(self._replies(received)):
                        data = message.data
                        about = int.from_bytes(data[:2], "little") if data else message.param1
                        if (message.id, message.source) == (reply, unit) and channel in {0, about}:
                            return message
                self.decoder.discard()  # half a message whose rest did not come in time
        raise NoReplyError(
            f"No answer {reply.name} from address 0x{unit:02X} in {REPLY_TIMEOUT} s. "
            f"The controller must be on and in no other program's use.{''.join(self._notices)}"
        )

    def _collect(self) -> None:
        """Take in all bytes that have come so far."""
        count = 0
        while received := self._transport.read(_READ_SIZE, 0.0):
            self._replies(received)
            count += len(received)
            if count > MAXIMUM_UNSOLICITED:
                came = f"More than {MAXIMUM_UNSOLICITED} unsolicited bytes came"
                raise WheelError(f"{came}. Must be an APT controller.")

    def _replies(self, received: bytes) -> list[Message]:
        """Messages that may be replies; ends of a motion and notices are kept."""
        replies = []
        for message in self.decoder.feed(received):
            match message.id:
                case Id.MOT_MOVE_COMPLETED | Id.MOT_MOVE_STOPPED | Id.MOT_MOVE_HOMED:
                    self._ended.add((message.id, message.source))
                case Id.HW_RESPONSE | Id.HW_RICHRESPONSE:
                    error = apt.parse(apt.Notice, message) if message.data else apt.Notice()
                    about = f"error {error.code} of message 0x{error.id:04X}"
                    self._notices.append(f" It reported {about}: {apt.text(error.notes)}.")
                    _LOGGER.warning("Controller of the filter wheel:%s", self._notices[-1])
                case _:
                    replies.append(message)
        return replies
