"""Thorlabs APT, the binary protocol of stepper controllers: bytes to messages, and back.

Pure functions and one `Decoder`, without input or output; `dbthermal.instruments.filterwheel`
speaks it. A message is a header of six bytes, ``id, id, param1, param2, destination, source``, or
``id, id, length, length, destination | 0x80, source`` followed by data; all little-endian, without
checksum or start byte. A receiver therefore drops bytes until identifier, length and both addresses
are possible. Data are records: `parse` reads a message, `pack` gives its data again; positions are
in counts, speeds in the device's units, channels count from 1.

Of the protocol this holds what a filter wheel needs, and the messages that a controller may send
by itself. Tested against public byte vectors, against the release 29.0.0 of thorlabs-apt-protocol
and against an emulator, not against hardware.

References
----------
Facts alone were taken, no code: yaq-project/thorlabs-apt-protocol 29.0.0, moonshot-nagayama-pj/PnPQ
(messages), Thorlabs/Motion_Control_Examples (commit bbdeca5, start of the line), pylablib 1.4.5
(scale of the FW103 wheel), thorlabs_apt_device 0.3.8 (addresses of racks).
"""

import struct
from collections.abc import Collection
from dataclasses import astuple, dataclass
from enum import IntFlag
from typing import Any, ClassVar, Self

from dbthermal.instruments.apt._framing import (
    ADDRESSES,
    BAY_1,
    CONTROLLERS,
    HOST,
    NO,
    RACK,
    UNIT,
    YES,
    Decoder,
    Id,
    Message,
    command,
    encode,
)

__all__ = [
    "ADDRESSES",
    "BAY_1",
    "CONTROLLERS",
    "HOST",
    "NO",
    "RACK",
    "UNIT",
    "YES",
    "Decoder",
    "HomeParameters",
    "Id",
    "Info",
    "Message",
    "Notice",
    "Position",
    "Status",
    "StatusBits",
    "VelocityParameters",
    "command",
    "encode",
    "is_enabled",
]
__dir__ = __all__.copy


class StatusBits(IntFlag):
    """State of a motor: the bits on which public sources agree; others are kept as they come.

    Bit 12 is read as "tracking" by some and as "interlock" by others, and has no name here. The
    jogging bits of one controller were seen to stick: nothing here relies on them.
    """

    FORWARD_LIMIT = 1 << 0
    REVERSE_LIMIT = 1 << 1
    FORWARD_SOFT_LIMIT = 1 << 2
    REVERSE_SOFT_LIMIT = 1 << 3
    MOVING_FORWARD = 1 << 4
    MOVING_REVERSE = 1 << 5
    JOGGING_FORWARD = 1 << 6
    JOGGING_REVERSE = 1 << 7
    CONNECTED = 1 << 8
    HOMING = 1 << 9
    HOMED = 1 << 10
    SETTLED = 1 << 13
    POSITION_ERROR = 1 << 14
    OVERLOAD = 1 << 24
    ENABLED = 1 << 31


@dataclass(frozen=True)
class Record:
    """Data of a message: numbers in the order of the record's fields."""

    _FORMAT: ClassVar[struct.Struct]
    _IDS: ClassVar[tuple[Id, ...]]
    _MORE: ClassVar[bool] = False  # True if more data may follow, which are not read

    @classmethod
    def parse(cls, message: Message) -> Self:
        """Record of a message; ValueError if it is another, or of another length."""
        return cls(*cls._unpacked(message))

    def pack(self) -> bytes:
        """Data of the message; ValueError if a number or a text does not fit its field."""
        return self._packed(*astuple(self))

    @classmethod
    def _unpacked(cls, message: Message) -> tuple[Any, ...]:
        _require_id(message, cls._IDS)
        number, size = len(message.data), cls._FORMAT.size
        if number < size or (number > size and not cls._MORE):
            raise ValueError(
                f"Invalid data of {number} bytes of message 0x{message.id:04X}. Must be {size}."
            )
        return cls._FORMAT.unpack_from(message.data)

    def _packed(self, *fields: int | bytes) -> bytes:
        try:
            return self._FORMAT.pack(*fields)
        except struct.error as error:
            raise ValueError(f"Invalid {self}. Its fields must hold it: {error}.") from error


@dataclass(frozen=True)
class Position(Record):
    """Absolute position [count], signed, of 32 bits."""

    _FORMAT = struct.Struct("<Hi")
    _IDS = (Id.MOT_MOVE_ABSOLUTE,)

    channel: int
    position: int


@dataclass(frozen=True)
class VelocityParameters(Record):
    """Speeds of a move; `maximum` is near 0 when some controllers are switched on."""

    _FORMAT = struct.Struct("<Hiii")
    _IDS = (Id.MOT_GET_VELPARAMS, Id.MOT_SET_VELPARAMS)

    channel: int
    minimum: int
    acceleration: int
    maximum: int


@dataclass(frozen=True)
class HomeParameters(Record):
    """Search for the home switch.

    `direction` is 1 forward, 2 reverse; `limit_switch` 1 the reverse one, 4 the forward one;
    `offset` [count] is from the switch to the position 0. `velocity` is near 0 when some
    controllers are switched on: homing then does nothing.
    """

    _FORMAT = struct.Struct("<HHHii")
    _IDS = (Id.MOT_GET_HOMEPARAMS, Id.MOT_SET_HOMEPARAMS)

    channel: int
    direction: int
    limit_switch: int
    velocity: int
    offset: int


@dataclass(frozen=True)
class Status(Record):
    """Position counter, encoder counter (a filter wheel has none) [count] and state of a motor."""

    _FORMAT = struct.Struct("<HiiI")
    _IDS = (Id.MOT_GET_STATUSUPDATE,)
    _MORE = True

    channel: int
    position: int
    encoder: int
    bits: StatusBits

    def __post_init__(self) -> None:
        object.__setattr__(self, "bits", StatusBits(self.bits))


@dataclass(frozen=True)
class Info(Record):
    """Identity of a controller.

    `model` is such as ``BSC201``, or ``SCC201``, which some that were sold as BSC201 say; `type`
    is 44 for brushless, 45 for a rack, others are not certain; `firmware` is
    ``major.interim.minor``; `notes` are 60 bytes that only the maker understands.
    """

    _FORMAT = struct.Struct("<I8sH4B60sHHH")
    _IDS = (Id.HW_GET_INFO,)

    serial_number: int
    model: str
    type: int
    firmware: str
    hardware: int
    modification: int
    channels: int
    notes: bytes = bytes(60)

    @classmethod
    def parse(cls, message: Message) -> Self:
        """Identity of HW_GET_INFO; bytes of the model that are not ASCII are spelled out."""
        number, model, kind, minor, interim, major, _, notes, *versions = cls._unpacked(message)
        hardware, modification, channels = versions
        name, firmware = _text(model.rstrip(b"\0 ")), f"{major}.{interim}.{minor}"
        return cls(number, name, kind, firmware, hardware, modification, channels, notes)

    def pack(self) -> bytes:
        """Data of the message; ValueError if a number or a text does not fit its field."""
        major, interim, minor = map(int, self.firmware.split("."))
        model = _ascii("model", self.model, 8)
        versions = (self.hardware, self.modification, self.channels)
        identity = (self.serial_number, model, self.type, minor, interim, major, 0)
        return self._packed(*identity, self.notes, *versions)


@dataclass(frozen=True)
class Notice(Record):
    """Error that the controller reports by itself: message that caused it (or 0), code, text."""

    _FORMAT = struct.Struct("<HH64s")
    _IDS = (Id.HW_RICHRESPONSE,)

    id: int
    code: int
    notes: str

    @classmethod
    def parse(cls, message: Message) -> Self:
        """Error of HW_RICHRESPONSE, or of HW_RESPONSE, which has no further data."""
        if message.id == Id.HW_RESPONSE:
            return cls(0, 0, "an error without a text")
        cause, code, notes = cls._unpacked(message)
        return cls(cause, code, _text(notes.split(b"\0")[0]))

    def pack(self) -> bytes:
        """Data of HW_RICHRESPONSE; ValueError if a number or the text does not fit its field."""
        return self._packed(self.id, self.code, _ascii("notes", self.notes, 64))


def is_enabled(message: Message) -> bool:
    """State of a channel in MOD_GET_CHANENABLESTATE; ValueError if it is another message."""
    _require_id(message, (Id.MOD_GET_CHANENABLESTATE,))
    if message.param2 not in {YES, NO}:
        raise ValueError(f"Invalid param2 {message.param2} of the enable state. Must be 1 or 2.")
    return message.param2 == YES


def _require_id(message: Message, ids: Collection[Id]) -> None:
    if message.id not in ids:
        names = sorted(known.name for known in ids)
        raise ValueError(f"Invalid message 0x{message.id:04X}. Must be one of {names}.")


def _text(raw: bytes) -> str:
    return raw.decode("ascii", errors="backslashreplace")


def _ascii(name: str, text: str, size: int) -> bytes:
    """ASCII bytes of a text, if it fits its field."""
    if len(text) > size or not text.isascii():
        raise ValueError(f"Invalid {name} '{text}'. Must be ASCII of at most {size} characters.")
    return text.encode("ascii")
