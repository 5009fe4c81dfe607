"""Note what goes over a line, byte for byte, and play it back: for tests and for diagnosis.

`Recording` wraps any transport; `Dialogue` stands in for a device that says what was noted, or
what a test writes down, and fails if the driver says anything else or leaves anything unread.
"""

import json
import time as system_time
from collections.abc import Callable, Iterable, Sequence
from types import TracebackType
from typing import Final, TextIO

from dbthermal.instruments.closing import Closing
from dbthermal.instruments.transport import Transport

Pair = tuple[bytes | None, bytes | Sequence[bytes] | None]
"""What a driver must write, or None, and what the device answers, in one piece or in several."""


class Recording(Closing):
    """
    A transport that notes every byte of another: one line of JSON for each write and read.

    A line has ``time`` [s] on `clock`, ``direction`` (``"write"`` or ``"read"``) and ``hex``. A
    read that found nothing leaves no line. `Dialogue.from_lines` plays it back.

    Parameters
    ----------
    transport : Transport
        What is noted; closed with this one.
    stream : TextIO
        Where the lines go; each is flushed, none is closed.
    clock : callable
        Gives the time [s].
    """

    def __init__(
        self,
        transport: Transport,
        stream: TextIO,
        *,
        clock: Callable[[], float] = system_time.monotonic,
    ) -> None:
        self._transport = transport
        self._stream = stream
        self._clock = clock

    @property
    def is_simulated(self) -> bool:
        """Whether no hardware is at the other end."""
        return self._transport.is_simulated

    def write(self, data: bytes) -> None:
        """Note the bytes, then send them; see `Transport.write`."""
        self._note("write", data)
        self._transport.write(data)

    def read(self, size: int, timeout: float) -> bytes:
        """Receive bytes and note them; see `Transport.read`."""
        received = self._transport.read(size, timeout)
        if received:
            self._note("read", received)
        return received

    def close(self) -> None:
        """Close what is noted."""
        self._transport.close()

    def _note(self, direction: str, data: bytes) -> None:
        line = {"time": self._clock(), "direction": direction, "hex": data.hex(" ")}
        self._stream.write(json.dumps(line) + "\n")
        self._stream.flush()


class Dialogue(Closing):
    """
    A transport for tests that expects certain bytes, gives certain answers, and allows no rest.

    Used as a context manager it checks at its end, unless something else went wrong, that all was
    written and all was read. The idea is pymeasure's ``expected_protocol``.

    Parameters
    ----------
    pairs : iterable of tuple
        What must be written, or None if the device speaks unasked, and what it answers, or None.
        An answer in several pieces takes one read for each; an empty piece is a read that
        times out, and so is a read for which nothing is left.
    """

    is_simulated: Final = True

    def __init__(self, pairs: Iterable[Pair]) -> None:
        self._pairs = list(pairs)
        self._written = b""
        self._answers: list[bytes] = []
        self._next()

    @classmethod
    def from_lines(cls, lines: Iterable[str]) -> "Dialogue":
        """
        Play back what `Recording` noted, byte for byte, without its times.

        Parameters
        ----------
        lines : iterable of str
            JSON, one object each.

        Returns
        -------
        Dialogue
            Each write with the reads up to the next.
        """
        pairs: list[tuple[bytes | None, list[bytes]]] = []
        for line in lines:
            noted = json.loads(line)
            piece = bytes.fromhex(noted["hex"])
            if noted["direction"] == "write":
                pairs.append((piece, []))
            else:
                if not pairs:
                    pairs.append((None, []))
                pairs[-1][1].append(piece)
        return cls(pairs)

    def write(self, data: bytes) -> None:
        """Compare what a driver sends with what it should."""
        _must(not self._answers, f"Unread {self._answers!r}, but {data.hex(' ')} was written.")
        _must(bool(self._pairs), f"Unexpected {data.hex(' ')} was written. Must be nothing more.")
        expected = self._pairs[0][0] or b""
        self._written += data
        _must(
            expected.startswith(self._written),
            f"Unexpected {self._written.hex(' ')} was written. Must be {expected.hex(' ')}.",
        )
        if self._written == expected:
            self._answer()

    def read(self, size: int, timeout: float) -> bytes:  # noqa: ARG002 - no time goes by
        """Give the next piece of the answer, at most `size` bytes of it; none if none is left."""
        if not self._answers:
            return b""
        piece = self._answers.pop(0)
        if piece[size:]:
            self._answers.insert(0, piece[size:])
        elif not self._answers:
            self._next()
        return piece[:size]

    def close(self) -> None:
        """Do nothing, so that a driver's own end does not hide what is left."""

    def finish(self) -> None:
        """Fail if something was not written or not read."""
        _must(not self._answers, f"Left unread: {self._answers!r}. Must be nothing.")
        _must(not self._written, f"Cut short: {self._written.hex(' ')}. Must be whole.")
        _must(not self._pairs, f"Left unwritten: {self._pairs!r}. Must be nothing.")

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is None:
            self.finish()

    def _answer(self) -> None:
        """Make the answer of the first pair ready to be read."""
        _, answer = self._pairs.pop(0)
        pieces = [answer] if isinstance(answer, bytes) else list(answer or ())
        self._written, self._answers = b"", pieces
        if not pieces:
            self._next()

    def _next(self) -> None:
        """Let the device speak, if it is to do so unasked."""
        if self._pairs and self._pairs[0][0] is None:
            self._answer()


def _must(holds: bool, message: str) -> None:  # noqa: FBT001 - like `assert`, which -O removes
    if not holds:
        raise AssertionError(message)
