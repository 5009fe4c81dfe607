"""An emulated Boson with the faults that are reported of real cameras."""

import math
from collections import deque
from dataclasses import dataclass, field
from enum import Enum, auto

from dbthermal.instruments import _fslp as fslp
from dbthermal.instruments.emulated.boson import EmulatedBoson
from dbthermal.instruments.emulated.world import World

DEBUG_CHANNEL = 0x99
"""Channel on which a camera sends text that nobody asked for."""

BUSY = 0x283


class Fault(Enum):
    """Faults of one reply."""

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
    Faults of a camera's command port; may be changed at any time.

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
    """

    once: deque[Fault | None] = field(default_factory=deque)
    late: float = 1.5
    single_bytes: bool = False
    ffc_stalls: bool = False


class FaultyBoson(EmulatedBoson):
    """The emulated camera with faults."""

    def __init__(self, world: World, name: str) -> None:
        super().__init__(world, name)
        self.faults = Faults()
        self._inbox: deque[tuple[fslp.Frame, Fault | None, float]] = deque()
        self._held = b""

    def request(self, frame: fslp.Frame) -> None:
        """Take in one request with its fault, to be answered when it is due."""
        fault = self.faults.once.popleft() if self.faults.once else None
        delay = self.faults.late if fault is Fault.LATE else 0.0
        self._inbox.append((frame, fault, self._world.time + delay))

    def poll(self) -> list[bytes]:
        """Give the replies that are due, with their faults."""
        replies = []
        while self._inbox and self.next_due() <= 0:
            frame, fault, _ = self._inbox.popleft()
            replies.append(self._spoilt(frame, fault))
        if self.faults.single_bytes:
            return [bytes([byte]) for reply in replies for byte in reply]
        return [reply for reply in replies if reply]

    def next_due(self) -> float:
        """Time until a reply is due [s]; infinite without a request."""
        if not self._inbox:
            return math.inf
        due = self._inbox[0][2]
        if self.faults.ffc_stalls:
            due = max(due, self.camera.ffc_until)
        return due - self._world.time

    def _spoilt(self, frame: fslp.Frame, fault: Fault | None) -> bytes:
        """Bytes of the reply to a request, with its fault."""
        reply = _misshapen(self.reply(frame), fault)
        if fault in {Fault.BUSY, Fault.SHORT, Fault.WRONG_COMMAND}:
            status, data = (BUSY, b"") if fault is Fault.BUSY else self.answer(frame)
            command = frame.command + (fault is Fault.WRONG_COMMAND)
            data = data[:-1] if fault is Fault.SHORT else data
            reply = fslp.encode(frame.sequence, command, data, status)
        reply = self._held + reply
        self._held = reply if fault is Fault.HOLD else b""
        return b"" if fault in {Fault.HOLD, Fault.DROP} else reply


def _misshapen(reply: bytes, fault: Fault | None) -> bytes:
    """Damage the bytes of a reply."""
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
