"""Payloads of APT messages, as records: `parse` reads a message, `pack` gives its data again.

Positions are in counts, speeds in the device's units, channels count from 1.
"""

import struct
from collections.abc import Collection
from dataclasses import astuple, dataclass
from enum import IntFlag
from typing import ClassVar, Self

from dbthermal.instruments.apt._framing import NO, YES, Id, Message


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
    """Payload of numbers in the order of the record's fields."""

    _FORMAT: ClassVar[struct.Struct]
    _IDS: ClassVar[tuple[Id, ...]]

    @classmethod
    def parse(cls, message: Message) -> Self:
        """Record of a message; ValueError if it is another, or of another length."""
        return cls(*cls._FORMAT.unpack(_data(message, cls._IDS, cls._FORMAT.size)))

    def pack(self) -> bytes:
        """Data of the message; ValueError if a number does not fit its field."""
        return _packed(self._FORMAT, self, *astuple(self))


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

    channel: int
    position: int
    encoder: int
    bits: StatusBits

    @classmethod
    def parse(cls, message: Message) -> Self:
        """Status of MOT_GET_STATUSUPDATE, of whose longer form the end is not read."""
        data = _data(message, cls._IDS, cls._FORMAT.size, longer=True)
        channel, position, encoder, bits = cls._FORMAT.unpack_from(data)
        return cls(channel, position, encoder, StatusBits(bits))


@dataclass(frozen=True)
class Info:
    """Identity of a controller.

    `model` is such as ``BSC201``, or ``SCC201``, which some that were sold as BSC201 say; `type`
    is 44 for brushless, 45 for a rack, others are not certain; `firmware` is
    ``major.interim.minor``; `notes` are 60 bytes that only the maker understands.
    """

    _FORMAT: ClassVar[struct.Struct] = struct.Struct("<I8sH4B60sHHH")

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
        fields = cls._FORMAT.unpack(_data(message, (Id.HW_GET_INFO,), cls._FORMAT.size))
        serial_number, model, kind, minor, interim, major = fields[:6]
        text = model.rstrip(b"\0 ").decode("ascii", errors="backslashreplace")
        firmware = f"{major}.{interim}.{minor}"
        hardware, modification, channels = fields[8:]
        return cls(serial_number, text, kind, firmware, hardware, modification, channels, fields[7])

    def pack(self) -> bytes:
        """Data of the message; ValueError if the model or a number does not fit."""
        major, interim, minor = (int(part) for part in self.firmware.split("."))
        identity = (self.serial_number, _text("model", self.model, 8), self.type)
        versions = (self.hardware, self.modification, self.channels)
        return _packed(
            self._FORMAT, self, *identity, minor, interim, major, 0, self.notes, *versions
        )


@dataclass(frozen=True)
class Notice:
    """Error that the controller reports by itself: message that caused it (or 0), code, text."""

    _FORMAT: ClassVar[struct.Struct] = struct.Struct("<HH64s")

    id: int
    code: int
    notes: str

    @classmethod
    def parse(cls, message: Message) -> Self:
        """Error of HW_RICHRESPONSE, or of HW_RESPONSE, which has no further data."""
        if message.id == Id.HW_RESPONSE:
            return cls(0, 0, "an error without a text")
        data = _data(message, (Id.HW_RICHRESPONSE,), cls._FORMAT.size)
        cause, code, notes = cls._FORMAT.unpack(data)
        return cls(cause, code, notes.split(b"\0")[0].decode("ascii", errors="backslashreplace"))

    def pack(self) -> bytes:
        """Data of HW_RICHRESPONSE; ValueError if the notes or a number do not fit."""
        return _packed(self._FORMAT, self, self.id, self.code, _text("notes", self.notes, 64))


def is_enabled(message: Message) -> bool:
    """State of a channel in MOD_GET_CHANENABLESTATE; ValueError if it is another message."""
    _data(message, (Id.MOD_GET_CHANENABLESTATE,), 0)
    if message.param2 not in {YES, NO}:
        raise ValueError(f"Invalid param2 {message.param2} of the enable state. Must be 1 or 2.")
    return message.param2 == YES


def _packed(layout: struct.Struct, record: object, *fields: int | bytes) -> bytes:
    """Fields of a record as bytes, if each fits."""
    try:
        return layout.pack(*fields)
    except struct.error as error:
        raise ValueError(f"Invalid {record}. Its fields must hold it: {error}.") from error


def _text(name: str, text: str, size: int) -> bytes:
    """ASCII bytes of a text, if it fits its field."""
    if len(text) > size or not text.isascii():
        raise ValueError(f"Invalid {name} '{text}'. Must be ASCII of at most {size} characters.")
    return text.encode("ascii")


def _data(message: Message, ids: Collection[Id], size: int, *, longer: bool = False) -> bytes:
    """Data of a message, if it is one of `ids` and has the size [byte]."""
    if message.id not in ids:
        names = sorted(known.name for known in ids)
        raise ValueError(f"Invalid message 0x{message.id:04X}. Must be one of {names}.")
    if len(message.data) < size or (len(message.data) > size and not longer):
        raise ValueError(
            f"Invalid data of {len(message.data)} bytes of message 0x{message.id:04X}. "
            f"Must be {size}."
        )
    return message.data
