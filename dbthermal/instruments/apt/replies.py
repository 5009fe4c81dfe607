"""What a controller answers: a record for each payload, from the data of a message and back.

Each record's ``parse`` reads a `Message`, and refuses one of another kind; its ``pack`` gives the
data again, which the emulator and the requests that set parameters need. Numbers are in the
device's own units: counts of the position, and for speeds what
`dbthermal.instruments.filterwheel.Scale` says.

References
----------
See `dbthermal.instruments.apt`.
"""

import struct
from collections.abc import Collection
from dataclasses import astuple, dataclass
from enum import IntFlag
from typing import ClassVar, Self

from dbthermal.instruments.apt.codec import Id, Message

_INFO = struct.Struct("<I8sH4B60sHHH")
_NOTICE = struct.Struct("<HH64s")
_STATUS = struct.Struct("<HiiI")
_STATUS_BITS = struct.Struct("<HI")


class StatusBits(IntFlag):
    """
    State of a motor, the bits that are agreed on; others are kept as they come.

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
class Info:
    """
    Who the controller is.

    Attributes
    ----------
    serial_number : int
        On its label.
    model : str
        Such as ``BSC201``, or ``SCC201``, which some that were sold as BSC201 say.
    type : int
        44 brushless, 45 rack; others are not certain.
    firmware : str
        ``major.interim.minor``.
    hardware : int
        Version.
    modification : int
        Modification state.
    channels : int
        Motors.
    notes : bytes
        60 bytes that only the maker understands.
    """

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
        """
        Read a message.

        Parameters
        ----------
        message : Message
            HW_GET_INFO.

        Returns
        -------
        Info
            Its content; bytes of the model that are no ASCII text are spelled out.

        Raises
        ------
        ValueError
            If it is another message, or of another length.
        """
        fields = _INFO.unpack(_data(message, {Id.HW_GET_INFO}, _INFO.size))
        serial_number, model, kind, minor, interim, major = fields[:6]
        notes, hardware, modification, channels = fields[7:]
        text = model.rstrip(b"\0 ").decode("ascii", errors="backslashreplace")
        firmware = f"{major}.{interim}.{minor}"
        return cls(serial_number, text, kind, firmware, hardware, modification, channels, notes)

    def pack(self) -> bytes:
        """Return the data of the message; ValueError if the model or a number does not fit."""
        major, interim, minor = (int(part) for part in self.firmware.split("."))
        kind = (self.serial_number, _text("model", self.model, 8), self.type)
        versions = (self.hardware, self.modification, self.channels)
        return _packed(_INFO, self, *kind, minor, interim, major, 0, self.notes, *versions)


@dataclass(frozen=True)
class Status:
    """
    Where a motor is and what it does.

    Attributes
    ----------
    channel : int
        From 1.
    position : int
        Counter of commanded steps [count].
    encoder : int
        Counter of an encoder, which a filter wheel does not have [count].
    bits : StatusBits
        State.
    """

    channel: int
    position: int
    encoder: int
    bits: StatusBits

    @classmethod
    def parse(cls, message: Message) -> Self:
        """
        Read a message.

        Parameters
        ----------
        message : Message
            MOT_GET_STATUSUPDATE, of either length; what the longer one has behind is not read.

        Returns
        -------
        Status
            Its content.

        Raises
        ------
        ValueError
            If it is another message, or too short.
        """
        data = _data(message, {Id.MOT_GET_STATUSUPDATE}, _STATUS.size, longer=True)
        channel, position, encoder, bits = _STATUS.unpack_from(data)
        return cls(channel, position, encoder, StatusBits(bits))

    def pack(self) -> bytes:
        """Return the data, in its shorter form; ValueError if a number does not fit its field."""
        return _packed(_STATUS, self, self.channel, self.position, self.encoder, int(self.bits))


@dataclass(frozen=True)
class _Numbers:
    """A payload of numbers alone, in the order of the record."""

    _FORMAT: ClassVar[struct.Struct]
    _IDS: ClassVar[frozenset[Id]]

    @classmethod
    def parse(cls, message: Message) -> Self:
        """Read a message that gives or sets them; ValueError if it is another."""
        return cls(*cls._FORMAT.unpack(_data(message, cls._IDS, cls._FORMAT.size)))

    def pack(self) -> bytes:
        """Return the data of the message; ValueError if a number does not fit its field."""
        return _packed(self._FORMAT, self, *astuple(self))


@dataclass(frozen=True)
class Position(_Numbers):
    """
    Position counter.

    Attributes
    ----------
    channel : int
        From 1.
    position : int
        Signed, 32 bits [count].
    """

    _FORMAT = struct.Struct("<Hi")
    _IDS = frozenset(
        {Id.MOT_GET_POSCOUNTER, Id.MOT_SET_POSCOUNTER, Id.MOT_MOVE_ABSOLUTE, Id.MOT_MOVE_RELATIVE}
    )

    channel: int
    position: int


@dataclass(frozen=True)
class VelocityParameters(_Numbers):
    """
    Speeds of a move, in the device's units.

    Attributes
    ----------
    channel : int
        From 1.
    minimum : int
        Velocity at the start, as a rule 0.
    acceleration : int
        Of the ramps.
    maximum : int
        Velocity between the ramps. Near 0 when some controllers are switched on.
    """

    _FORMAT = struct.Struct("<Hiii")
    _IDS = frozenset({Id.MOT_GET_VELPARAMS, Id.MOT_SET_VELPARAMS})

    channel: int
    minimum: int
    acceleration: int
    maximum: int


@dataclass(frozen=True)
class HomeParameters(_Numbers):
    """
    How the motor looks for its home switch, in the device's units.

    Attributes
    ----------
    channel : int
        From 1.
    direction : int
        1 forward, 2 reverse.
    limit_switch : int
        1 the reverse one, 4 the forward one.
    velocity : int
        Of the search. Near 0 when some controllers are switched on: homing then does nothing.
    offset : int
        From the switch to the place that is called 0 [count].
    """

    _FORMAT = struct.Struct("<HHHii")
    _IDS = frozenset({Id.MOT_GET_HOMEPARAMS, Id.MOT_SET_HOMEPARAMS})

    channel: int
    direction: int
    limit_switch: int
    velocity: int
    offset: int


@dataclass(frozen=True)
class Notice:
    """
    An error that the controller reports by itself.

    Attributes
    ----------
    id : int
        Of the message that caused it, 0 if none did.
    code : int
        The controller's number for it.
    notes : str
        Its text.
    """

    id: int
    code: int
    notes: str

    @classmethod
    def parse(cls, message: Message) -> Self:
        """Read HW_RICHRESPONSE, or HW_RESPONSE, which says nothing; ValueError if another."""
        if message.id == Id.HW_RESPONSE:
            return cls(0, 0, "an error without a text")
        cause, code, notes = _NOTICE.unpack(_data(message, {Id.HW_RICHRESPONSE}, _NOTICE.size))
        text = notes.split(b"\0")[0].decode("ascii", errors="backslashreplace")
        return cls(cause, code, text)

    def pack(self) -> bytes:
        """Return the data of HW_RICHRESPONSE; ValueError if the notes or a number do not fit."""
        return _packed(_NOTICE, self, self.id, self.code, _text("notes", self.notes, 64))


def is_enabled(message: Message) -> bool:
    """Whether MOD_GET_CHANENABLESTATE says that the channel is enabled; ValueError if another."""
    return _flag(message, Id.MOD_GET_CHANENABLESTATE)


def is_occupied(message: Message) -> bool:
    """Whether RACK_GET_BAYUSED says that something is in the bay; ValueError if another."""
    return _flag(message, Id.RACK_GET_BAYUSED)


def status_bits(message: Message) -> StatusBits:
    """State of the motor, from MOT_GET_STATUSBITS; ValueError if another."""
    data = _data(message, {Id.MOT_GET_STATUSBITS}, _STATUS_BITS.size)
    return StatusBits(_STATUS_BITS.unpack(data)[1])


def _packed(layout: struct.Struct, record: object, *fields: int | bytes) -> bytes:
    """Return the fields of a record as bytes, if each fits."""
    try:
        return layout.pack(*fields)
    except struct.error as error:
        raise ValueError(f"Invalid {record}. Its fields must hold it: {error}.") from error


def _text(name: str, text: str, size: int) -> bytes:
    """Return a text if it fits its field."""
    if len(text) > size or not text.isascii():
        raise ValueError(f"Invalid {name} '{text}'. Must be ASCII of at most {size} characters.")
    return text.encode("ascii")


def _flag(message: Message, identifier: Id) -> bool:
    """Read the second parameter: 1 yes, 2 no."""
    _data(message, {identifier}, 0)
    if message.param2 not in {1, 2}:
        raise ValueError(f"Invalid param2 {message.param2} of {identifier.name}. Must be 1 or 2.")
    return message.param2 == 1


def _data(message: Message, ids: Collection[Id], size: int, *, longer: bool = False) -> bytes:
    """Return the data of a message if it is one of these, and long enough."""
    if message.id not in ids:
        names = sorted(known.name for known in ids)
        raise ValueError(f"Invalid message 0x{message.id:04X}. Must be one of {names}.")
    if len(message.data) < size or (len(message.data) > size and not longer):
        raise ValueError(
            f"Invalid data of {len(message.data)} bytes of message 0x{message.id:04X}. "
            f"Must be {size}."
        )
    return message.data
