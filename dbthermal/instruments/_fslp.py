"""FSLP, the framing of the FLIR Boson's serial line: pure functions from bytes to frames and back.

A frame is the start byte 8E, then channel, sequence number, command, status, data and checksum,
big-endian and with three byte values escaped, then the end byte AE.

References
----------
Facts alone were taken, no code: FLIR/rawBoson, ``rawBoson.c`` (commit 0f192d6); openmv/openmv,
``drivers/boson`` (commit cbbb877); frames quoted in thurberdog/ghostCommand (commit 35dc641) and in
LJMUAstroecology/flirpy issue 21.
"""

import binascii
import re
import struct
from dataclasses import dataclass
from typing import Final

from dbthermal import _numbers

COMMAND_CHANNEL: Final = 0x00  # of commands and replies; frames of all others are ignored
REQUEST: Final = 0xFFFFFFFF  # status of a request; that of a reply is 0 or an error code
MAXIMUM_DATA: Final = 751  # most bytes of data in a frame to send, as in FLIR/rawBoson
MAXIMUM_FRAME: Final = 2048  # most unescaped bytes received: the buffer of the vendor's receiver

_START, _END, _ESCAPE = b"\x8e", b"\xae", b"\x9e"
_SPECIAL = _START + _END + _ESCAPE
_SHIFT = 0x0D  # an escaped byte is sent as the escape byte and the value less this
_ESCAPED = re.compile(rb"\x9e[\x81\x91\xa1]")
_HEADER = struct.Struct(">BIII")
_CHECKSUM = struct.Struct(">H")


@dataclass(frozen=True)
class Frame:
    """An undamaged frame."""

    channel: int  # `COMMAND_CHANNEL`, or that of debug text and other traffic, 0 to 255
    sequence: int  # number of the request, echoed by its reply, unsigned, 32 bits
    command: int  # identifier of the function, unsigned, 32 bits
    status: int  # `REQUEST`, or of a reply 0 for success, else an error code
    data: bytes = b""  # arguments or result of the function; empty in error replies


def checksum(content: bytes) -> int:
    """CRC-16/AUG-CCITT (SPI-FUJITSU) of an unescaped frame, from channel to data."""
    return binascii.crc_hqx(content, 0x1D0F)


def encode(frame: Frame) -> bytes:
    """Bytes of a frame; header, data and checksum are all escaped.

    TypeError or ValueError if a number does not fit its field, or the data are too long.
    """
    numbers = {"channel": frame.channel, "sequence number": frame.sequence}
    numbers |= {"command": frame.command, "status": frame.status}
    for name, value in numbers.items():
        _numbers.whole_number(name, value, (0, 0xFF if name == "channel" else 0xFFFFFFFF))
    if (size := len(frame.data)) > MAXIMUM_DATA:
        raise ValueError(f"Invalid data of {size} bytes. Must be at most {MAXIMUM_DATA}.")
    content = _HEADER.pack(*numbers.values()) + frame.data
    content += _CHECKSUM.pack(checksum(content))
    pieces = (_ESCAPE + bytes((v - _SHIFT,)) if v in _SPECIAL else bytes((v,)) for v in content)
    return _START + b"".join(pieces) + _END


def next_sequence(sequence: int) -> int:
    """Next larger sequence number without a byte that would be escaped; 0 after the largest."""
    following = ((sequence + 1) % (1 << 32)).to_bytes(4, "big")
    for position, value in enumerate(following):
        if value in _SPECIAL:  # the least number above: the bytes behind start from zero
            raised = following[:position] + bytes([value + 1]) + bytes(3 - position)
            return int.from_bytes(raised, "big")
    return int.from_bytes(following, "big")


class Decoder:
    """Finds the frames in a stream of bytes, however it is cut into pieces.

    Bytes between frames are ignored. A start byte always begins anew. A frame that is cut short,
    too long or too short, holds an illegal escape or has the wrong checksum is dropped and counted
    in `damaged`: each start byte began a frame that was returned, is counted, or is still open.
    """

    def __init__(self) -> None:
        self.damaged = 0
        self._content: bytes | None = None  # since the last start byte; None between frames

    @property
    def is_open(self) -> bool:
        """True if a frame has begun and not yet ended."""
        return self._content is not None

    def feed(self, received: bytes) -> list[Frame]:
        """Take in any number of bytes; return the undamaged frames that they complete."""
        frames = []
        for number, piece in enumerate(bytes(received).split(_START)):
            if number:  # a start byte came before it
                self.damaged += self.is_open
                self._content = b""
            if self._content is None:
                continue
            self._content, end, _ = (self._content + piece).partition(_END)
            if end or len(self._content) > 2 * MAXIMUM_FRAME:  # each byte may be escaped
                frame, self._content = _frame(self._content), None
                frames += [frame] if frame else []
                self.damaged += frame is None
        return frames


def _frame(escaped: bytes) -> Frame | None:
    """Frame of the bytes between start and end; None if it is damaged."""
    content = _ESCAPED.sub(lambda pair: bytes((pair[0][1] + _SHIFT,)), escaped)
    body, sent = content[: -_CHECKSUM.size], content[-_CHECKSUM.size :]
    if _ESCAPE in _ESCAPED.sub(b"", escaped) or not _HEADER.size <= len(body) < MAXIMUM_FRAME - 1:
        return None
    if _CHECKSUM.pack(checksum(body)) != sent:
        return None
    channel, sequence, command, status = _HEADER.unpack_from(body)
    return Frame(channel, sequence, command, status, body[_HEADER.size :])
