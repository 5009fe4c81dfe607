"""Framing of APT messages: six bytes, or six and data, without checksum or start byte."""

import operator
import struct
from collections.abc import Collection, Mapping
from dataclasses import astuple, dataclass
from enum import IntEnum
from types import MappingProxyType
from typing import Final

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


class Id(IntEnum):
    """Identifiers of the messages that are known here, by the maker's names."""

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
    MOT_GET_DCSTATUSUPDATE = 0x0491


LENGTHS: Final[Mapping[int, tuple[int, ...]]] = MappingProxyType(
    {
        **dict.fromkeys(Id, (0,)),
        Id.HW_GET_INFO: (84,),
        Id.HW_RICHRESPONSE: (68,),
        Id.MOT_SET_VELPARAMS: (14,),
        Id.MOT_GET_VELPARAMS: (14,),
        Id.MOT_SET_HOMEPARAMS: (14,),
        Id.MOT_GET_HOMEPARAMS: (14,),
        Id.MOT_MOVE_ABSOLUTE: (0, 6),
        Id.MOT_MOVE_COMPLETED: (0, 14),
        Id.MOT_MOVE_STOPPED: (0, 14),
        Id.MOT_GET_STATUSUPDATE: (14, 28),
        Id.MOT_GET_DCSTATUSUPDATE: (14,),
    }
)
"""Lengths of data that each message can have [byte]; 0 is the form without data."""


@dataclass(frozen=True)
class Message:
    """One message: identifier, parameters (0 to 255, 0 if there are data), addresses and data."""

    id: int
    param1: int
    param2: int
    destination: int
    source: int
    data: bytes = b""


def encode(message: Message) -> bytes:
    """Bytes of a message, ready to send; with data in the long form.

    TypeError or ValueError if a number is not whole, or does not fit its field, the data are too
    long, or there are both data and parameters, which the long form does not have.

    Examples
    --------
    >>> encode(Message(Id.HW_REQ_INFO, 0, 0, destination=UNIT, source=HOST)).hex(" ")
    '05 00 00 00 50 01'
    """
    for name, value, most in (
        ("identifier", message.id, 0xFFFF),
        ("param1", message.param1, 0xFF),
        ("param2", message.param2, 0xFF),
        ("destination", message.destination, 0x7F),
        ("source", message.source, 0xFF),
        ("number of data", len(message.data), 0xFF),  # as documented
    ):
        if not 0 <= operator.index(value) <= most:
            raise ValueError(f"Invalid {name} {value} of a message. Must lie in 0 to {most}.")
    if not message.data:
        return _SHORT.pack(*astuple(message)[:-1])
    if message.param1 or message.param2:
        parameters = (message.param1, message.param2)
        raise ValueError(f"Invalid parameters {parameters} of a message with data. Must be 0.")
    addresses = (message.destination | _HAS_DATA, message.source)
    return _LONG.pack(message.id, len(message.data), *addresses) + message.data


def command(
    identifier: Id, channel: int = 0, value: int = 0, *, data: bytes = b"", destination: int
) -> bytes:
    """Bytes of a message from the computer to a controller.

    Short, it has two parameters, the `channel` from 1, which in a rack is 1 in every bay, and a
    `value`; long, the `data` from the ``pack`` of a record. A controller silently ignores messages
    to another `destination`. ValueError if a number does not fit its field, or the message never
    has data of this length.

    Examples
    --------
    >>> command(Id.MOT_MOVE_HOME, 1, destination=BAY_1).hex(" ")
    '43 04 01 00 21 01'
    """
    if len(data) not in LENGTHS[identifier]:
        raise ValueError(
            f"Invalid data of {len(data)} bytes of {identifier.name}. "
            f"Must be one of {LENGTHS[identifier]}."
        )
    return encode(Message(identifier, channel, value, destination, HOST, data))


class Decoder:
    """Finds the messages in a stream of bytes, however it is cut into pieces.

    A byte with which no possible message begins is dropped and counted, and the search goes on with
    the next. Each received byte belongs to a message that was returned, is counted in `dropped`, or
    is `pending`. The fewer `destinations` and `sources` are possible, the less noise passes for a
    message; by default all are, so that a line is read in both directions.

    Examples
    --------
    A message that a wheel has come home, after one byte of noise:

    >>> decoder = Decoder()
    >>> [message] = decoder.feed(bytes.fromhex("ff 44 04 01 00 01 21"))
    >>> Id(message.id).name, decoder.dropped
    ('MOT_MOVE_HOMED', 1)
    """

    def __init__(
        self, destinations: Collection[int] = ADDRESSES, sources: Collection[int] = ADDRESSES
    ) -> None:
        self.dropped = 0
        self._destinations, self._sources = frozenset(destinations), frozenset(sources)
        self._buffer = bytearray()

    @property
    def pending(self) -> int:
        """Number of bytes that may begin a message whose end has not come."""
        return len(self._buffer)

    def feed(self, received: bytes) -> list[Message]:
        """Messages that the next bytes of the stream complete.

        An unknown identifier, or one of `Id` with a length that it never has, is not a message.
        """
        self._buffer += received
        messages, start = [], 0
        while len(self._buffer) - start >= _HEADER:
            length = self._data_length(start)
            if length is None:
                start, self.dropped = start + 1, self.dropped + 1
            elif len(self._buffer) - start < _HEADER + length:
                break
            else:
                messages.append(self._message(start, length))
                start += _HEADER + length
        del self._buffer[:start]
        return messages

    def discard(self) -> None:
        """Drop and count the pending bytes: their end did not come in time."""
        self.dropped += len(self._buffer)
        self._buffer.clear()

    def _data_length(self, start: int) -> int | None:
        """Length of the data after a header [byte], None if the header is impossible."""
        identifier, length, destination, source = _LONG.unpack_from(self._buffer, start)
        length = length if destination & _HAS_DATA else 0
        possible = (
            destination & ~_HAS_DATA in self._destinations
            and source in self._sources
            and length in LENGTHS.get(identifier, ())
            and bool(length) == bool(destination & _HAS_DATA)
        )
        return length if possible else None

    def _message(self, start: int, length: int) -> Message:
        identifier, *params, destination, source = _SHORT.unpack_from(self._buffer, start)
        first, second = (0, 0) if length else params
        data = bytes(self._buffer[start + _HEADER : start + _HEADER + length])
        return Message(identifier, first, second, destination & ~_HAS_DATA, source, data)
