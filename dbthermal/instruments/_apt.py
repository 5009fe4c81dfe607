"""Thorlabs APT, the binary protocol of stepper controllers: bytes to messages, and back.

Pure functions and a `Decoder`, without input or output, for `dbthermal.instruments.filterwheel`.
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
from dataclasses import astuple, dataclass
from enum import IntEnum, IntFlag
from typing import Any, ClassVar, Final, Self

# Addresses: computer, a rack's own board (a BSC20x counts as a rack), the first of its ten bays,
# and a controller that is not a rack.
HOST: Final = 0x01
RACK: Final = 0x11
BAY_1: Final = 0x21
UNIT: Final = 0x50
CONTROLLERS: Final = frozenset({RACK, *range(BAY_1, BAY_1 + 10), UNIT})
ADDRESSES: Final = CONTROLLERS | {HOST}

YES: Final = 1
NO: Final = 2

_HEADER: Final = 6  # [byte]
_SHORT = struct.Struct("<HBBBB")
_LONG = struct.Struct("<HHBB")
_HAS_DATA = 0x80
_LONGEST = 0xFF  # data, as documented [byte]
_IDENTIFIERS = 0x1000  # all documented identifiers of controllers are below
_RACK_TYPE = 45  # of a controller in its `Info`


class Id(IntEnum):
    """Messages that a filter wheel needs, and that a controller may send, by the maker's names.

    `lengths` are those that the data of a message can have [byte], 0 without data.
    """

    lengths: tuple[int, ...]

    def __new__(cls, value: int, *lengths: int) -> Self:
        """Make an identifier from its number and its lengths."""
        member = int.__new__(cls, value)
        member._value_, member.lengths = value, lengths or (0,)
        return member

    HW_REQ_INFO = 0x0005
    HW_GET_INFO = 0x0006, 84
    HW_STOP_UPDATEMSGS = 0x0012  # nothing starts them: some BSC then stop answering after 5 s
    HW_NO_FLASH_PROGRAMMING = 0x0018  # first of all messages
    HW_RESPONSE = 0x0080
    HW_RICHRESPONSE = 0x0081, 68
    MOD_SET_CHANENABLESTATE = 0x0210
    MOD_REQ_CHANENABLESTATE = 0x0211
    MOD_GET_CHANENABLESTATE = 0x0212
    MOT_SET_VELPARAMS = 0x0413, 14
    MOT_REQ_VELPARAMS = 0x0414
    MOT_GET_VELPARAMS = 0x0415, 14
    MOT_SET_HOMEPARAMS = 0x0440, 14
    MOT_REQ_HOMEPARAMS = 0x0441
    MOT_GET_HOMEPARAMS = 0x0442, 14
    MOT_MOVE_HOME = 0x0443
    MOT_MOVE_HOMED = 0x0444
    MOT_MOVE_ABSOLUTE = 0x0453, 0, 6
    MOT_MOVE_COMPLETED = 0x0464, 0, 14
    MOT_MOVE_STOP = 0x0465  # value 1 at once, 2 by a ramp
    MOT_MOVE_STOPPED = 0x0466, 0, 14
    MOT_REQ_STATUSUPDATE = 0x0480
    MOT_GET_STATUSUPDATE = 0x0481, 14, 28


_LENGTHS = {int(identifier): identifier.lengths for identifier in Id}


@dataclass(frozen=True)
class Message:
    """A message: identifier, parameters (0 to 255, 0 if there are data), addresses and data."""

    id: int
    param1: int
    param2: int
    destination: int
    source: int
    data: bytes = b""


def encode(message: Message) -> bytes:
    """Bytes of a message to send; with data in the long form, which has no parameters.

    ValueError if a number is not whole, or does not fit its field, or the data are too long.
    """
    size = len(message.data)
    if size > _LONGEST or message.destination & _HAS_DATA:
        rule = f"Must have at most {_LONGEST} bytes of data, and a destination below {_HAS_DATA}"
        raise ValueError(f"Invalid {message}. {rule}.")
    if size and (message.param1 or message.param2):
        raise ValueError(f"Invalid {message} with data. Its parameters must be 0.")
    try:
        if not size:
            return _SHORT.pack(*astuple(message)[:-1])
        destination = message.destination | _HAS_DATA
        return _LONG.pack(message.id, size, destination, message.source) + message.data
    except struct.error as error:
        raise ValueError(f"Invalid {message}. Its fields must hold it: {error}.") from error


def command(
    identifier: Id, channel: int = 0, value: int = 0, *, data: bytes = b"", destination: int
) -> bytes:
    """Bytes of a message from the computer to a controller.

    Short, it has the `channel` from 1, which in a rack is 1 in every bay, and a `value`; long, the
    `data` of a record. A controller silently ignores messages to another `destination`. ValueError
    if a number does not fit its field, or the data have no such length.
    """
    if len(data) not in identifier.lengths:
        rule = f"Must be one of {identifier.lengths}"
        raise ValueError(f"Invalid data of {len(data)} bytes of {identifier.name}. {rule}.")
    return encode(Message(identifier, channel, value, destination, HOST, data))


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

    def __init__(
        self, destinations: Collection[int] = ADDRESSES, sources: Collection[int] = ADDRESSES
    ) -> None:
        self.dropped = 0
        self.pending = bytearray()  # may begin a message whose end has not come
        self._destinations, self._sources = frozenset(destinations), frozenset(sources)

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
            elif len(self.pending) - start < _HEADER + length:
                break
            else:
                messages.append(self._message(start, length))
                start += _HEADER + length
        del self.pending[:start]
        return messages

    def discard(self) -> None:
        """Drop and count the pending bytes: their end did not come in time."""
        self.dropped += len(self.pending)
        self.pending.clear()

    def _data_length(self, start: int) -> int | None:
        """Length of the data after a header [byte], None if the header is impossible."""
        identifier, length, destination, source = _LONG.unpack_from(self.pending, start)
        is_long = bool(destination & _HAS_DATA)
        length = length if is_long else 0
        lengths = _LENGTHS.get(identifier, range(_LONGEST + 1) if identifier < _IDENTIFIERS else ())
        possible = (
            destination & ~_HAS_DATA in self._destinations
            and source in self._sources
            and length in lengths
            and bool(length) == is_long
        )
        return length if possible else None

    def _message(self, start: int, length: int) -> Message:
        identifier, *params, destination, source = _SHORT.unpack_from(self.pending, start)
        first, second = (0, 0) if length else params
        data = bytes(self.pending[start + _HEADER : start + _HEADER + length])
        return Message(identifier, first, second, destination & ~_HAS_DATA, source, data)


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


@dataclass(frozen=True)
class Record:
    """Data of a message from a `Decoder`: numbers in the order of the record's fields.

    Data behind the last field are not read.
    """

    _FORMAT: ClassVar[struct.Struct]

    @classmethod
    def parse(cls, message: Message) -> Self:
        """Record of a message."""
        return cls(*cls._FORMAT.unpack_from(message.data))

    def pack(self) -> bytes:
        """Data of the message; ValueError if a number or a text does not fit its field."""
        try:
            return self._FORMAT.pack(*self._fields())
        except struct.error as error:
            raise ValueError(f"Invalid {self}. Its fields must hold it: {error}.") from error

    def _fields(self) -> tuple[Any, ...]:
        return astuple(self)


@dataclass(frozen=True)
class Position(Record):
    """Absolute position [count]."""

    _FORMAT = struct.Struct("<Hi")

    channel: int
    position: int


@dataclass(frozen=True)
class VelocityParameters(Record):
    """Speeds of a move; `maximum` is near 0 when some controllers are switched on."""

    _FORMAT = struct.Struct("<Hiii")

    channel: int
    minimum: int
    acceleration: int
    maximum: int


@dataclass(frozen=True)
class HomeParameters(Record):
    """Search for the home switch; with a `velocity` near 0, as after power-on, it does nothing."""

    _FORMAT = struct.Struct("<HHHii")

    channel: int
    direction: int  # 1 forward, 2 reverse
    limit_switch: int  # 1 the reverse switch, 4 the forward one
    velocity: int
    offset: int  # from the switch to the position 0 [count]


@dataclass(frozen=True)
class Status(Record):
    """Position counter, encoder counter (a filter wheel has none) [count] and state of a motor."""

    _FORMAT = struct.Struct("<HiiI")

    channel: int
    position: int
    encoder: int
    bits: StatusBits

    def __post_init__(self) -> None:
        object.__setattr__(self, "bits", StatusBits(self.bits))


@dataclass(frozen=True)
class Info(Record):
    """Identity of a controller, in HW_GET_INFO.

    Versions of the hardware follow, which are not read, and are packed as those of a rack.
    """

    _FORMAT = struct.Struct("<I8sH4B60sHHH")

    serial_number: int
    model: str  # ``BSC201``, or ``SCC201``, which some that were sold as BSC201 say
    firmware: str  # ``major.interim.minor``
    notes: bytes = bytes(60)  # that only the maker understands

    @classmethod
    def parse(cls, message: Message) -> Self:
        """Identity of a message; bytes of the model that are not ASCII are spelled out."""
        number, model, _, minor, interim, major, _, notes, *_ = cls._FORMAT.unpack(message.data)
        return cls(number, _text(model.rstrip(b"\0 ")), f"{major}.{interim}.{minor}", notes)

    def _fields(self) -> tuple[Any, ...]:
        if len(self.model) > 8 or not self.model.isascii():
            raise ValueError(f"Invalid model '{self.model}'. Must be at most 8 ASCII characters.")
        major, interim, minor = map(int, self.firmware.split("."))
        identity = (self.serial_number, self.model.encode("ascii"), _RACK_TYPE)
        return *identity, minor, interim, major, 0, self.notes, 1, 0, 1


@dataclass(frozen=True)
class Notice(Record):
    """Error that the controller reports by itself: message that caused it (or 0), code, text."""

    _FORMAT = struct.Struct("<HH64s")

    id: int
    code: int
    notes: str

    @classmethod
    def parse(cls, message: Message) -> Self:
        """Error of HW_RICHRESPONSE, or of HW_RESPONSE, which has no further data."""
        if message.id == Id.HW_RESPONSE:
            return cls(0, 0, "an error without a text")
        cause, code, notes = cls._FORMAT.unpack(message.data)
        return cls(cause, code, _text(notes.split(b"\0")[0]))


def _text(raw: bytes) -> str:
    return raw.decode("ascii", errors="backslashreplace")
