"""What can go wrong with an emulated FLIR Boson: the faults that are reported of real ones."""

from collections import deque
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import Final

from dbthermal.instruments import fslp

DEBUG_CHANNEL: Final = 0x99
"""Channel on which a camera sends text that nobody asked for."""


class Fault(Enum):
    """What can go wrong with one reply."""

    DROP = auto()  # it never comes
    LATE = auto()  # it comes after `Faults.late`, and so do those behind it
    HOLD = auto()  # it comes together with the next one
    BAD_CHECKSUM = auto()
    ILLEGAL_ESCAPE = auto()
    CUT = auto()  # its second half is lost
    WRONG_COMMAND = auto()
    SHORT = auto()  # its last byte of data is missing, and the checksum is right
    BUSY = auto()  # it refuses
    DEBUG_TEXT = auto()  # text on another channel comes first


@dataclass
class Faults:
    """
    Knobs that make an emulated camera misbehave; may be turned at any time.

    Attributes
    ----------
    once : deque of Fault
        For the next requests, one each; None for none.
    late : float
        Delay of `Fault.LATE` [s].
    single_bytes : bool
        Replies come byte by byte.
    ffc_stalls : bool
        No reply while the shutter is closed.
    pulses : bool
        Whether external pulses come, for a camera that waits for them.
    """

    once: deque[Fault | None] = field(default_factory=deque)
    late: float = 1.5
    single_bytes: bool = False
    ffc_stalls: bool = False
    pulses: bool = True


def misshapen(reply: bytes, fault: Fault | None) -> bytes:
    """
    Damage a reply as a fault says.

    Parameters
    ----------
    reply : bytes
        One frame.
    fault : Fault or None
        Those that are not about the bytes change nothing.

    Returns
    -------
    bytes
        To send.
    """
    match fault:
        case Fault.BAD_CHECKSUM:
            # The byte before the end, to a value that needs no escape.
            return reply[:-2] + bytes([0x00 if reply[-2] else 0x01]) + reply[-1:]
        case Fault.ILLEGAL_ESCAPE:
            return reply[:-1] + b"\x9e\x00" + reply[-1:]
        case Fault.CUT:
            return reply[: len(reply) // 2]
        case Fault.DEBUG_TEXT:
            return fslp.encode(0, 0, b"emulated debug text", 0, channel=DEBUG_CHANNEL) + reply
        case _:
            return reply
