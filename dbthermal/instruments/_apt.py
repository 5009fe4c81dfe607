"""Thorlabs APT, the binary protocol of stepper controllers, and a controller at the end of a line.

A message is a header of six bytes, ``id, id, param1, param2, destination, source``, or
``id, id, length, length, destination | 0x80, source`` followed by data; all little-endian, without
checksum or start byte. A receiver therefore drops bytes until identifier, length and both addresses
are possible. Positions are in counts, speeds in the device's units, channels count from 1.

A controller that is addressed wrongly says nothing: its address is searched for. APT has no
sequence numbers, and a controller reports the end of a move at any time: the next message is not
always the reply. So messages are identified by identifier, source and channel.

Facts alone were taken, no code: yaq-project/thorlabs-apt-protocol 29.0.0, moonshot-nagayama-pj/PnPQ
(messages), Thorlabs/Motion_Control_Examples (commit bbdeca5, start of the line), pylablib 1.4.5
(scale of the FW103 wheel), thorlabs_apt_device 0.3.8 (addresses of racks).
"""

import logging
import struct
import threading
from collections.abc import Collection
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, Final, NamedTuple, TypeVar

from dbthermal.instruments.transport import Transport

# Addresses: computer, a rack's own board (a BSC20x counts as a rack), the first of its ten bays,
# and a controller that is not a rack.
HOST: Final = 0x01
RACK: Final = 0x11
BAY_1: Final = 0x21
UNIT: Final = 0x50
CONTROLLERS: Final = frozenset({RACK, *range(BAY_1, BAY_1 + 10), UNIT})

YES, NO = 1, 2
CHANNEL: Final = 1  # of the motor at its address
# Where a controller is looked for, in order: address of its identity, and of its motor. A BSC20x
# is a rack and silently ignores messages to a unit.
SEARCHED: Final = ((RACK, BAY_1), (UNIT, UNIT))
REPLY_TIMEOUT: Final = 1.0  # [s]
ATTEMPTS: Final = 2  # number of times that a request is sent before its reply counts as missing
MAXIMUM_UNSOLICITED: Final = 65536  # [byte] an endless stream comes from another device

_READ_SIZE = 256  # largest number of bytes that are read at once
_LOGGER = logging.getLogger(__name__)
_SHORT = struct.Struct("<HBBBB")
_LONG = struct.Struct("<HHBB")
_HEADER = _SHORT.size
_HAS_DATA = 0x80
_LONGEST = 0xFF  # data, as documented [byte]
_IDENTIFIERS = 0x1000  # all documented identifiers of controllers are below


class Id(IntEnum):
    """Messages that a filter wheel needs, and that a controller may send, by the maker's names."""

    # After ``SET`` comes the number of the request of the same parameters, then of its reply.
    HW_REQ_INFO = 0x0005
    HW_GET_INFO = 0x0006
    HW_STOP_UPDATEMSGS = 0x0012  # nothing starts them: some BSC then stop answering after 5 s
    HW_NO_FLASH_PROGRAMMING = 0x0018  # first of all messages
    HW_RESPONSE = 0x0080
    HW_RICHRESPONSE = 0x0081
    MOD_SET_CHANENABLESTATE = 0x0210
    MOD_REQ_CHANENABLESTATE = 0x0211
    MOD_GET_CHANENABLESTATE = 0x0212
    MOT_SET_VELPARAMS = 0x0413
    MOT_REQ_VELPARAMS = 0x0414
    MOT_GET_VELPARAMS = 0x0415
    MOT_SET_HOMEPARAMS = 0x0440
    MOT_REQ_HOMEPARAMS = 0x0441
    MOT_GET_HOMEPARAMS = 0x0442
    MOT_MOVE_HOME = 0x0443
    MOT_MOVE_HOMED = 0x0444
    MOT_MOVE_ABSOLUTE = 0x0453
    MOT_MOVE_COMPLETED = 0x0464
    MOT_MOVE_STOP = 0x0465  # value 1 at once, 2 by a ramp
    MOT_MOVE_STOPPED = 0x0466
    MOT_REQ_STATUSUPDATE = 0x0480
    MOT_GET_STATUSUPDATE = 0x0481


# Lengths that the data of a message can have [byte].
_PARAMETERS = (Id.MOT_SET_VELPARAMS, Id.MOT_GET_VELPARAMS, Id.MOT_SET_HOMEPARAMS)
LENGTHS: Final[dict[int, tuple[int, ...]]] = {
    **dict.fromkeys(Id, (0,)),
    **dict.fromkeys((*_PARAMETERS, Id.MOT_GET_HOMEPARAMS), (14,)),
    **dict.fromkeys((Id.MOT_MOVE_COMPLETED, Id.MOT_MOVE_STOPPED), (0, 14)),
    Id.MOT_MOVE_ABSOLUTE: (0, 6),
    Id.MOT_GET_STATUSUPDATE: (14, 28),
    Id.HW_GET_INFO: (84,),
    Id.HW_RICHRESPONSE: (68,),
}


class Message(NamedTuple):
    """A message: identifier, parameters (0 to 255, 0 if there are data), addresses and data."""

    id: int
    param1: int = 0  # mostly the channel
    param2: int = 0
    destination: int = HOST
    source: int = HOST
    data: bytes = b""


class Position(NamedTuple):
    """Absolute position [count]."""

    channel: int
    position: int


class Speeds(NamedTuple):
    """Speeds of a move; the largest, `velocity`, is near 0 after power-on of some controllers."""

    channel: int
    minimum: int
    acceleration: int
    velocity: int


class Home(NamedTuple):
    """Search for the home switch; with a `velocity` near 0, as after power-on, it does nothing."""

    channel: int
    direction: int  # 1 forward, 2 reverse
    limit_switch: int  # 1 the reverse switch, 4 the forward one
    velocity: int
    offset: int  # from the switch to the position 0 [count]


class Status(NamedTuple):
    """Position counter, encoder counter (a filter wheel has none) [count] and bits of its state."""

    channel: int
    position: int
    encoder: int
    bits: int


class Info(NamedTuple):
    """Identity of a controller; by default the versions are those of an emulated one."""

    serial_number: int
    model: bytes  # ``BSC201``, or ``SCC201``, which some that were sold as BSC201 say
    kind: int = 45  # a rack
    minor: int = 0  # parts of the firmware's version
    interim: int = 0
    major: int = 1
    notes: bytes = b""  # that only the maker understands
    hardware: int = 1
    modification: int = 0
    channels: int = 1


class Notice(NamedTuple):
    """Error that the controller reports by itself: message that caused it (or 0), code, text."""

    id: int = 0
    code: int = 0
    notes: bytes = b"an error without a text"


# Data of each record, whose fields are in this order; data behind the last field are not read.
_LAYOUTS: Final[dict[type[tuple[Any, ...]], struct.Struct]] = {
    Position: struct.Struct("<Hi"),
    Speeds: struct.Struct("<Hiii"),
    Home: struct.Struct("<HHHii"),
    Status: struct.Struct("<HiiI"),
    Info: struct.Struct("<I8sH3Bx60sHHH"),
    Notice: struct.Struct("<HH64s"),
}
Record = TypeVar("Record", bound=tuple[Any, ...])


def parse(kind: type[Record], message: Message) -> Record:
    """Record in the data of a message from a `Decoder`."""
    return kind(*_LAYOUTS[kind].unpack_from(message.data))


def pack(record: tuple[Any, ...]) -> bytes:
    """Data of a message; ValueError if a number does not fit its field."""
    return _packed(_LAYOUTS[type(record)], record, *record)


def _packed(layout: struct.Struct, record: tuple[Any, ...], *values: Any) -> bytes:
    try:
        return layout.pack(*values)
    except struct.error as error:
        raise ValueError(f"Invalid {record}. Its fields must hold it: {error}.") from error


def text(raw: bytes) -> str:
    """Text up to its padding; bytes that are not ASCII are spelled out."""
    return raw.split(b"\0")[0].rstrip(b" ").decode("ascii", "backslashreplace")


def encode(message: Message) -> bytes:
    """Bytes of a message to send; ValueError if a number or the data do not fit their fields."""
    size, lengths = len(message.data), LENGTHS.get(message.id)
    if lengths is not None and size not in lengths:
        name = Id(message.id).name
        raise ValueError(f"Invalid data of {size} bytes of {name}. Must be one of {lengths}.")
    if size > _LONGEST or message.destination & _HAS_DATA:
        rule = f"Must have at most {_LONGEST} bytes of data, and a destination below {_HAS_DATA}"
        raise ValueError(f"Invalid {message}. {rule}.")
    # The long form, with data, has no parameters.
    if size and (message.param1 or message.param2):
        raise ValueError(f"Invalid {message} with data. Its parameters must be 0.")
    if not size:
        return _packed(_SHORT, message, *message[:-1])
    destination = message.destination | _HAS_DATA
    return _packed(_LONG, message, message.id, size, destination, message.source) + message.data


@dataclass
class Decoder:
    """Finds the messages in a stream of bytes, however it is cut into pieces.

    Each received byte belongs to a message that was returned, is counted in `dropped`, or is
    `pending`.
    """

    # The fewer are possible, the less noise passes for a message; by default both directions.
    destinations: Collection[int] = CONTROLLERS | {HOST}
    sources: Collection[int] = CONTROLLERS | {HOST}
    dropped: int = field(default=0, init=False)
    pending: bytearray = field(default_factory=bytearray, init=False)  # beginning of a message

    def feed(self, received: bytes) -> list[Message]:
        """Messages that the next bytes of the stream complete."""
        self.pending += received
        messages, start = [], 0
        while len(self.pending) - start >= _HEADER:
            identifier, size, destination, source = _LONG.unpack_from(self.pending, start)
            # The long form, with the length of its data, is marked in the destination.
            is_long, address = bool(destination & _HAS_DATA), destination & ~_HAS_DATA
            # A message that is not in `Id` may have any length: nothing in its data is a message.
            size, every = size if is_long else 0, range(_LONGEST + 1)
            sizes = LENGTHS.get(identifier, every if identifier < _IDENTIFIERS else ())
            possible = address in self.destinations and source in self.sources
            # With this byte begins no message.
            if not possible or size not in sizes or bool(size) != is_long:
                start, self.dropped = start + 1, self.dropped + 1
                continue
            # A message, or its beginning.
            end = start + _HEADER + size
            if len(self.pending) < end:
                break
            first, second = (0, 0) if size else self.pending[start + 2 : start + 4]
            data = bytes(self.pending[start + _HEADER : end])
            messages.append(Message(identifier, first, second, address, source, data))
            start = end
        del self.pending[:start]
        return messages

    def discard(self) -> None:
        """Drop and count the pending bytes: their end did not come in time."""
        self.dropped += len(self.pending)
        self.pending.clear()


class WheelError(RuntimeError):
    """The wheel or its controller does not do what it should."""


class NoReplyError(WheelError, TimeoutError):
    """The controller did not reply in time."""


class Controller:
    """Requests to a controller, its replies, of the next number, and its reports by itself."""

    def __init__(self, transport: Transport) -> None:
        self.unit, self.motor = SEARCHED[0]
        self.decoder = Decoder((HOST,), CONTROLLERS)
        self._transport, self._clock = transport, transport.clock
        # A recorder asks for the position in one thread while another turns the wheel.
        self._lock = threading.Lock()
        self.ended = set[int]()  # what the motor reported since the last start of a motion
        self._notices: list[str] = []  # a sentence each

    def connect(self) -> Info:
        """Find the address of the controller, and return its identity."""
        for self.unit, self.motor in SEARCHED:
            for identifier in (Id.HW_NO_FLASH_PROGRAMMING, Id.HW_STOP_UPDATEMSGS):
                self._transport.write(encode(Message(identifier, destination=self.unit)))
            try:
                reply = self.request(Id.HW_REQ_INFO, self.unit, 0, attempts=1)
            except NoReplyError:
                continue
            self._collect()
            self._notices.clear()  # it need not know all messages of the greeting
            return parse(Info, reply)
        if self.decoder.dropped:
            came = f"{self.decoder.dropped} bytes came that are no APT messages"
            raise WheelError(f"{came}. Must be an APT controller.")
        tried = ", ".join(f"0x{unit:02X}" for unit, _ in SEARCHED)
        raise NoReplyError(f"No APT controller answered at {tried}. It must be on.")

    def send(self, identifier: Id, channel: int = 0, value: int = 0, data: bytes = b"") -> None:
        """Send a message without a reply to the motor."""
        self._transport.write(encode(Message(identifier, channel, value, self.motor, HOST, data)))

    def begin(self, identifier: Id, channel: int = 0, data: bytes = b"") -> None:
        """Send the start of a motion, once earlier ends are forgotten; WheelError as `check`."""
        with self._clock.hold(self._lock):
            self._collect()
        self.ended.clear()
        self.check()
        self.send(identifier, channel, data=data)

    def check(self) -> None:
        """WheelError with the text of the errors that the controller reported by itself."""
        if self._notices:
            reported = "".join(self._notices)
            self._notices.clear()
            raise WheelError(f"The controller is not well.{reported}")

    def request(
        self, identifier: Id, unit: int = 0, channel: int = CHANNEL, *, attempts: int = ATTEMPTS
    ) -> Message:
        """Reply to a request, of the motor by default, of any channel if 0; or NoReplyError."""
        unit, reply = unit or self.motor, Id(identifier + 1)
        request = encode(Message(identifier, channel, 0, unit))
        with self._clock.hold(self._lock):
            # Only requests are repeated, never what moves the wheel.
            for _ in range(attempts):
                # What came before is no reply; a late one may count as that of the repetition.
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
                    self.ended |= {message.id} if message.source == self.motor else set()
                case Id.HW_RESPONSE | Id.HW_RICHRESPONSE:
                    error = parse(Notice, message) if message.data else Notice()
                    about = f"error {error.code} of message 0x{error.id:04X}"
                    self._notices.append(f" It reported {about}: {text(error.notes)}.")
                    _LOGGER.warning("Controller of the filter wheel:%s", self._notices[-1])
                case _:
                    replies.append(message)
        return replies
