"""Exchange requests and replies with a FLIR Boson, so that no reply passes for another's.

A camera that is busy answers late, after its driver gave up; read naively, every later command
then gets the reply of the one before (openmv/openmv, pull request 3265). Here each request has a
sequence number of its own, and whatever does not carry it is discarded and counted. Tested against
public byte vectors and an emulator, not against hardware.
"""

import threading
import time as system_time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from dbthermal.instruments import fslp
from dbthermal.instruments.boson.commands import meaning
from dbthermal.instruments.closing import Closing
from dbthermal.instruments.transport import Transport

REPLY_TIMEOUT: Final = 1.0
"""Longest wait for a reply [s], as in the vendor's own software."""

REPEATS: Final = 2
"""How often a reading is asked for again if no reply came; what changes the camera never is."""

MAXIMUM_RECEIVED: Final = 65536
"""Most bytes to look through for one reply: a line that talks without end is an error."""

_READ_SIZE = 4096


class BosonError(RuntimeError):
    """The camera did not do what it was asked to."""


class BosonTimeoutError(BosonError, TimeoutError):
    """No reply came in time; a command that changes the camera may have been carried out."""


class BosonReplyError(BosonError):
    """A reply came that is none: of another command, of the wrong size, or without meaning."""


class BosonStatusError(BosonError):
    """
    The camera refused.

    Attributes
    ----------
    status : int
        Its status, see `boson.commands.STATUSES`.
    """

    def __init__(self, message: str, status: int) -> None:
        super().__init__(message)
        self.status = status


@dataclass
class Statistics:
    """
    What happened on the line so far; all zero on a good one.

    Attributes
    ----------
    discarded : int
        Undamaged frames of other channels or other requests: debug text, and late replies.
    damaged : int
        Frames that were cut short or had a wrong checksum or an illegal escape.
    timeouts : int
        Requests that were not answered in time.
    """

    discarded: int = 0
    damaged: int = 0
    timeouts: int = 0


class Link(Closing):
    """
    One line to one camera; an exchange at a time, from any thread.

    Parameters
    ----------
    transport : Transport
        Open; closed with the link.
    timeout : float
        Longest wait for a reply [s].
    first_sequence : int, optional
        Near the first request's number. By default it comes from the time of day, so that replies
        to a program that ended are not taken for this one's.
    clock : callable
        Gives the time [s].

    Attributes
    ----------
    statistics : Statistics
        What happened so far.
    """

    def __init__(
        self,
        transport: Transport,
        *,
        timeout: float = REPLY_TIMEOUT,
        first_sequence: int | None = None,
        clock: Callable[[], float] = system_time.monotonic,
    ) -> None:
        first = system_time.time_ns() // 1000 if first_sequence is None else first_sequence
        self.statistics = Statistics()
        self.timeout = timeout
        self._transport = transport
        self._clock = clock
        self._decoder = fslp.Decoder()
        self._sequence = (first - 1) % (1 << 32)
        self._lock = threading.Lock()

    @property
    def is_simulated(self) -> bool:
        """Whether no hardware is at the other end."""
        return self._transport.is_simulated

    def ask(self, name: str, command: int, *, repeats: int = REPEATS) -> bytes:
        """
        Ask for something that changes nothing, again if no reply comes.

        Parameters
        ----------
        name : str
            For messages.
        command : int
            Identifier.
        repeats : int
            How often it is asked for again.

        Returns
        -------
        bytes
            Data of the reply.

        Raises
        ------
        BosonTimeoutError, BosonReplyError, BosonStatusError
            If no reply comes, a wrong one does, or the camera refuses.
        TransportError
            If the camera is gone.
        """
        for _ in range(repeats):
            try:
                return self._exchange(name, command, b"")
            except BosonTimeoutError:
                continue
        return self._exchange(name, command, b"")

    def tell(self, name: str, command: int, data: bytes = b"") -> None:
        """
        Tell the camera to do something, once.

        Parameters
        ----------
        name : str
            For messages.
        command : int
            Identifier.
        data : bytes
            What it takes.

        Raises
        ------
        BosonTimeoutError, BosonReplyError, BosonStatusError
            If no reply comes, and it may or may not have been done; a wrong one does; or the
            camera refuses.
        TransportError
            If the camera is gone.
        """
        reply = self._exchange(name, command, data)
        if reply:
            raise BosonReplyError(
                f"Invalid reply of {len(reply)} bytes to '{name}'. Must be empty."
            )

    def close(self) -> None:
        """Give the line back, once an exchange of another thread is over; twice is as once."""
        with self._lock:
            self._transport.close()

    def _exchange(self, name: str, command: int, data: bytes) -> bytes:
        """Send one request and return the data of its reply."""
        with self._lock:
            self._sequence = fslp.next_sequence(self._sequence)
            self._transport.write(fslp.encode(self._sequence, command, data))
            reply = self._reply(name)
        if reply.command != command:
            raise BosonReplyError(
                f"Invalid reply to '{name}', of command 0x{reply.command:08X}. "
                f"Must be of command 0x{command:08X}."
            )
        if reply.status:
            raise BosonStatusError(
                f"Refused '{name}' by the camera: status 0x{reply.status:X}, "
                f"{meaning(reply.status)}. Must be 0, OK.",
                reply.status,
            )
        return reply.data

    def _reply(self, name: str) -> fslp.Frame:
        """Wait for the reply to the last request; discard all else."""
        deadline = self._clock() + self.timeout
        received = 0
        while (remaining := deadline - self._clock()) > 0:
            piece = self._transport.read(_READ_SIZE, remaining)
            if not piece:
                break
            received += len(piece)
            if received > MAXIMUM_RECEIVED:
                raise BosonReplyError(
                    f"No reply to '{name}' within {MAXIMUM_RECEIVED} bytes. "
                    "Must be a Boson's command port that no other program uses."
                )
            found = self._mine(self._decoder.feed(piece))
            if found is not None:
                return found
        self.statistics.timeouts += 1
        raise BosonTimeoutError(
            f"No reply to '{name}' within {self.timeout:g} s. Must be a Boson's command port, "
            "and the camera through with booting."
        )

    def _mine(self, frames: list[fslp.Frame]) -> fslp.Frame | None:
        """Reply to the last request, if it is among the frames; the others are counted."""
        place = (fslp.COMMAND_CHANNEL, self._sequence)
        mine = [
            frame
            for frame in frames
            if (frame.channel, frame.sequence) == place and frame.status != fslp.REQUEST
        ]
        self.statistics.discarded += len(frames) - len(mine[:1])
        self.statistics.damaged = self._decoder.damaged
        return mine[0] if mine else None
