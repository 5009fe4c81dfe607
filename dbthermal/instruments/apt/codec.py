"""Framing of APT messages: six bytes, or six and data, without checksum or start byte.

A header is ``id, id, param1, param2, destination, source``, or ``id, id, length, length,
destination | 0x80, source`` and then the data, little-endian. As nothing marks where a message
begins, a receiver must know which ones there can be: it drops bytes until identifier, length and
both addresses are possible.

References
----------
See `dbthermal.instruments.apt`.
"""

import operator
import struct
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from enum import IntEnum
from types import MappingProxyType
from typing import Final

HOST: Final = 0x01
"""Address of the computer."""

RACK: Final = 0x11
"""Address of a rack's own board, to which a BSC20x counts."""

BAY_1: Final = 0x21
"""Address of the first bay of a rack, its first motor; that of bay 10 is 0x2A."""

UNIT: Final = 0x50
"""Address of a controller that is no rack."""

CONTROLLERS: Final = frozenset({RACK, *range(BAY_1, BAY_1 + 10), UNIT})
"""Addresses of racks, of their ten bays, and of units."""

ADDRESSES: Final = CONTROLLERS | {HOST}
"""All addresses."""

HEADER: Final = 6
"""Length of a header, and of a message without data [byte]."""

MAXIMUM_DATA: Final = 255
"""Most data of a message, as documented [byte]."""

_SHORT = struct.Struct("<HBBBB")
_LONG = struct.Struct("<HHBB")
_HAS_DATA = 0x80


class Id(IntEnum):
    """Identifiers of the messages that are known here, named as the maker names them."""

    HW_DISCONNECT = 0x0002
    HW_REQ_INFO = 0x0005
    HW_GET_INFO = 0x0006
    HW_START_UPDATEMSGS = 0x0011
    HW_STOP_UPDATEMSGS = 0x0012
    HW_NO_FLASH_PROGRAMMING = 0x0018
    RACK_REQ_BAYUSED = 0x0060
    RACK_GET_BAYUSED = 0x0061
    HW_RESPONSE = 0x0080
    HW_RICHRESPONSE = 0x0081
    MOD_SET_CHANENABLESTATE = 0x0210
    MOD_REQ_CHANENABLESTATE = 0x0211
    MOD_GET_CHANENABLESTATE = 0x0212
    MOD_IDENTIFY = 0x0223
    MOT_SET_POSCOUNTER = 0x0410
    MOT_REQ_POSCOUNTER = 0x0411
    MOT_GET_POSCOUNTER = 0x0412
    MOT_SET_VELPARAMS = 0x0413
    MOT_REQ_VELPARAMS = 0x0414
    MOT_GET_VELPARAMS = 0x0415
    MOT_REQ_STATUSBITS = 0x0429
    MOT_GET_STATUSBITS = 0x042A
    MOT_SET_HOMEPARAMS = 0x0440
    MOT_REQ_HOMEPARAMS = 0x0441
    MOT_GET_HOMEPARAMS = 0x0442
    MOT_MOVE_HOME = 0x0443
    MOT_MOVE_HOMED = 0x0444
    MOT_MOVE_RELATIVE = 0x0448
    MOT_MOVE_ABSOLUTE = 0x0453
    MOT_MOVE_COMPLETED = 0x0464
    MOT_MOVE_STOP = 0x0465
    MOT_MOVE_STOPPED = 0x0466
    MOT_SUSPEND_ENDOFMOVEMSGS = 0x046B
    MOT_RESUME_ENDOFMOVEMSGS = 0x046C
    MOT_REQ_STATUSUPDATE = 0x0480
    MOT_GET_STATUSUPDATE = 0x0481
    MOT_REQ_DCSTATUSUPDATE = 0x0490
    MOT_GET_DCSTATUSUPDATE = 0x0491
    MOT_ACK_DCSTATUSUPDATE = 0x0492


_DATA = {
    Id.HW_GET_INFO: (84,),
    Id.HW_RICHRESPONSE: (68,),
    Id.MOT_SET_POSCOUNTER: (6,),
    Id.MOT_GET_POSCOUNTER: (6,),
    Id.MOT_SET_VELPARAMS: (14,),
    Id.MOT_GET_VELPARAMS: (14,),
    Id.MOT_GET_STATUSBITS: (6,),
    Id.MOT_SET_HOMEPARAMS: (14,),
    Id.MOT_GET_HOMEPARAMS: (14,),
    Id.MOT_MOVE_RELATIVE: (0, 6),
    Id.MOT_MOVE_ABSOLUTE: (0, 6),
    Id.MOT_MOVE_COMPLETED: (0, 14),
    Id.MOT_MOVE_STOPPED: (0, 14),
    Id.MOT_GET_STATUSUPDATE: (14, 28),
    Id.MOT_GET_DCSTATUSUPDATE: (14,),
}

LENGTHS: Final[Mapping[int, tuple[int, ...]]] = MappingProxyType(
    {int(known): _DATA.get(known, (0,)) for known in Id}
)
"""Lengths of data that each message can have [byte]; 0 is the form without."""


@dataclass(frozen=True)
class Message:
    """
    One message.

    Attributes
    ----------
    id : int
        What it is; see `Id`.
    param1, param2 : int
        Of a message without data, each 0 to 255; 0 in one with data.
    destination, source : int
        Addresses, 0 to 127 and 0 to 255.
    data : bytes
        Empty in the short form.
    """

    id: int
    param1: int
    param2: int
    destination: int
    source: int
    data: bytes = b""


def encode(message: Message) -> bytes:
    """
    Bytes of a message, ready to send.

    Parameters
    ----------
    message : Message
        With data it takes the long form, which has no parameters.

    Returns
    -------
    bytes
        `HEADER` bytes, and the data.

    Raises
    ------
    TypeError, ValueError
        If a number is not whole, or does not fit its field, there are too many data, or both
        parameters and data.
    """
    for name, value, most in (
        ("identifier", message.id, 0xFFFF),
        ("param1", message.param1, 0xFF),
        ("param2", message.param2, 0xFF),
        ("destination", message.destination, 0x7F),
        ("source", message.source, 0xFF),
        ("number of data", len(message.data), MAXIMUM_DATA),
    ):
        if not 0 <= operator.index(value) <= most:
            raise ValueError(f"Invalid {name} {value} of a message. Must lie in 0 to {most}.")
    if not message.data:
        fields = (message.id, message.param1, message.param2, message.destination, message.source)
        return _SHORT.pack(*fields)
    if message.param1 or message.param2:
        given = (message.param1, message.param2)
        raise ValueError(f"Invalid parameters {given} of a message with data. Must be 0.")
    addresses = (message.destination | _HAS_DATA, message.source)
    return _LONG.pack(message.id, len(message.data), *addresses) + message.data


class Decoder:
    """
    Finds the messages in a stream of bytes, however it is cut into pieces.

    A byte with which no possible message begins is dropped and counted, and the search goes on
    with the next. So every byte that came in belongs to a message that was returned, is counted
    in `dropped`, or is `pending`.

    Parameters
    ----------
    destinations, sources : collection of int
        Addresses that are possible; by default all, so that a noted line is read in both
        directions. Who knows whom it talks to says so, and takes less noise for a message.

    Attributes
    ----------
    dropped : int
        Bytes that belonged to no message so far.
    """

    def __init__(
        self,
        destinations: Collection[int] = ADDRESSES,
        sources: Collection[int] = ADDRESSES,
    ) -> None:
        self.dropped = 0
        self._destinations = frozenset(destinations)
        self._sources = frozenset(sources)
        self._buffer = bytearray()

    @property
    def pending(self) -> int:
        """Bytes that may begin a message whose end has not come."""
        return len(self._buffer)

    def feed(self, received: bytes) -> list[Message]:
        """
        Take in the next bytes of the stream.

        Parameters
        ----------
        received : bytes
            Any number, of any value.

        Returns
        -------
        list of Message
            Those that they complete. An unknown identifier, or one of `Id` with a length that it
            never has, is no message.
        """
        self._buffer += received
        messages = []
        start = 0
        while len(self._buffer) - start >= HEADER:
            length = self._data_length(start)
            if length is None:
                start, self.dropped = start + 1, self.dropped + 1
            elif len(self._buffer) - start < HEADER + length:
                break
            else:
                messages.append(self._message(start, length))
                start += HEADER + length
        del self._buffer[:start]
        return messages

    def discard(self) -> None:
        """Drop and count what is pending: its end did not come in time."""
        self.dropped += len(self._buffer)
        self._buffer.clear()

    def _data_length(self, start: int) -> int | None:
        """Length of the data after a header [byte], None if it is no possible header."""
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
        """Return the whole message that begins there."""
        identifier, *params, destination, source = _SHORT.unpack_from(self._buffer, start)
        first, second = (0, 0) if length else params
        data = bytes(self._buffer[start + HEADER : start + HEADER + length])
        return Message(identifier, first, second, destination & ~_HAS_DATA, source, data)
