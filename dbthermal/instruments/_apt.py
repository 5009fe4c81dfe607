"""Thorlabs APT, the binary protocol of stepper controllers: bytes to messages, and back.

A message is a header of six bytes, ``id, id, param1, param2, destination, source``, or
``id, id, length, length, destination | 0x80, source`` followed by data; all little-endian, without
checksum or start byte. A receiver therefore drops bytes until identifier, length and both addresses
are possible. Positions are in counts, speeds in the device's units, channels count from 1.

References
----------
Facts alone were taken, no code: yaq-project/thorlabs-apt-protocol 29.0.0, moonshot-nagayama-pj/PnPQ
(messages), Thorlabs/Motion_Control_Examples (commit bbdeca5, start of the line), pylablib 1.4.5
(scale of the FW103 wheel), thorlabs_apt_device 0.3.8 (addresses of racks).
"""

import struct
from collections.abc import Collection
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag
from typing import Any, Final, NamedTuple, TypeVar

# Addresses: computer, a rack's own board (a BSC20x counts as a rack), the first of its ten bays,
# and a controller that is not a rack.
HOST: Final = 0x01
RACK: Final = 0x11
BAY_1: Final = 0x21
UNIT: Final = 0x50
CONTROLLERS: Final = frozenset({RACK, *range(BAY_1, BAY_1 + 10), UNIT})

YES: Final = 1
NO: Final = 2
_SHORT = struct.Struct("<HBBBB")
_LONG = struct.Struct("<HHBB")
_HEADER = _SHORT.size
_HAS_DATA = 0x80
_LONGEST = 0xFF  # data, as documented [byte]
_IDENTIFIERS = 0x1000  # all documented identifiers of controllers are below


class Id(IntEnum):
    """Messages that a filter wheel needs, and that a controller may send, by the maker's names.

    After ``SET`` comes the number of the request of the same parameters, then that of its reply.
    """

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
LENGTHS: Final[dict[int, tuple[int, ...]]] = {
    **dict.fromkeys(Id, (0,)),
    **dict.fromkeys((Id.MOT_SET_VELPARAMS, Id.MOT_GET_VELPARAMS), (14,)),
    **dict.fromkeys((Id.MOT_SET_HOMEPARAMS, Id.MOT_GET_HOMEPARAMS), (14,)),
    **dict.fromkeys((Id.MOT_MOVE_COMPLETED, Id.MOT_MOVE_STOPPED), (0, 14)),
    Id.HW_GET_INFO: (84,),
    Id.HW_RICHRESPONSE: (68,),
    Id.MOT_MOVE_ABSOLUTE: (0, 6),
    Id.MOT_GET_STATUSUPDATE: (14, 28),
}


class StatusBits(IntFlag):
    """State of a motor: the bits that a filter wheel needs; the rest are kept as they come.

    Bit 12 is read as "tracking" by some and as "interlock" by others, and has no name here.
    """

    MOVING_FORWARD = 1 << 4
    MOVING_REVERSE = 1 << 5
    JOGGING_FORWARD = 1 << 6
    JOGGING_REVERSE = 1 << 7
    CONNECTED = 1 << 8
    HOMING = 1 << 9
    HOMED = 1 << 10
    POSITION_ERROR = 1 << 14
    OVERLOAD = 1 << 24
    ENABLED = 1 << 31


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
    """Position counter, encoder counter (a filter wheel has none) [count] and `StatusBits`."""

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
    """Bytes of a message to send; with data in the long form, which has no parameters.

    A controller silently ignores messages to another destination than its own; a channel is 1 in
    every bay of a rack. ValueError if a number is not whole, or does not fit its field, or the data
    are too long, or have a length that messages of this `Id` never have.
    """
    size, lengths = len(message.data), LENGTHS.get(message.id)
    if lengths is not None and size not in lengths:
        name = Id(message.id).name
        raise ValueError(f"Invalid data of {size} bytes of {name}. Must be one of {lengths}.")
    if size > _LONGEST or message.destination & _HAS_DATA:
        rule = f"Must have at most {_LONGEST} bytes of data, and a destination below {_HAS_DATA}"
        raise ValueError(f"Invalid {message}. {rule}.")
    if size and (message.param1 or message.param2):
        raise ValueError(f"Invalid {message} with data. Its parameters must be 0.")
    if not size:
        return _packed(_SHORT, message, *message[:-1])
    destination = message.destination | _HAS_DATA
    return _packed(_LONG, message, message.id, size, destination, message.source) + message.data


@dataclass
class Decoder:
    """Finds the messages in a stream of bytes, however it is cut into pieces.

    A byte with which no possible message begins is dropped and counted, and the search goes on with
    the next. Each received byte belongs to a message that was returned, is counted in `dropped`, or
    is `pending`. The fewer `destinations` and `sources` are possible, the less noise passes for a
    message; by default all are, so that a line is read in both directions.

    Examples
    --------
    >>> decoder = Decoder()
    >>> [message] = decoder.feed(bytes.fromhex("ff 44 04 01 00 01 21"))
    >>> Id(message.id).name, decoder.dropped
    ('MOT_MOVE_HOMED', 1)
    """

    destinations: Collection[int] = CONTROLLERS | {HOST}
    sources: Collection[int] = CONTROLLERS | {HOST}
    dropped: int = field(default=0, init=False)
    pending: bytearray = field(default_factory=bytearray, init=False)  # beginning of a message

    def feed(self, received: bytes) -> list[Message]:
        """Messages that the next bytes of the stream complete.

        A message that is well formed but not in `Id` is returned whole, so that nothing in its data
        is taken for a message. A message of `Id` with a length that it never has is noise.
        """
        self.pending += received
        messages, start = [], 0
        while len(self.pending) - start >= _HEADER:
            length = self._data_length(start)
            if length is None:
                start, self.dropped = start + 1, self.dropped + 1
                continue
            # A message, or its beginning.
            end = start + _HEADER + length
            if len(self.pending) < end:
                break
            identifier, *params, destination, source = _SHORT.unpack_from(self.pending, start)
            first, second = (0, 0) if length else params
            data = bytes(self.pending[start + _HEADER : end])
            address = destination & ~_HAS_DATA
            messages.append(Message(identifier, first, second, address, source, data))
            start = end
        del self.pending[:start]
        return messages

    def discard(self) -> None:
        """Drop and count the pending bytes: their end did not come in time."""
        self.dropped += len(self.pending)
        self.pending.clear()

    def _data_length(self, start: int) -> int | None:
        """Length of the data after a header [byte], None if the header is impossible."""
        identifier, length, destination, source = _LONG.unpack_from(self.pending, start)
        # The long form is marked in the destination.
        is_long = bool(destination & _HAS_DATA)
        length = length if is_long else 0
        lengths = LENGTHS.get(identifier, range(_LONGEST + 1) if identifier < _IDENTIFIERS else ())
        possible = (
            destination & ~_HAS_DATA in self.destinations
            and source in self.sources
            and length in lengths
            and bool(length) == is_long
        )
        return length if possible else None
