"""A device in a byte dialogue that a test writes down; any unread or unwritten byte fails.

The idea is pymeasure's ``expected_protocol``.
"""

from collections.abc import Iterable, Sequence

from dbthermal.instruments.transport import Clock, Closing, EmulatedClock

Pair = tuple[bytes | None, bytes | Sequence[bytes] | None]
"""What a driver must write, or None, and what the device answers, in one piece or in several."""


class Dialogue(Closing):
    """A transport that expects certain bytes, gives certain answers, and fails on leftovers.

    Used as a context manager it checks at its end that all was written and all was read. An answer
    in several pieces takes one read for each; a read for which nothing is left times out.
    """

    is_simulated = True

    def __init__(self, pairs: Iterable[Pair]) -> None:
        self.clock: Clock = EmulatedClock()
        self._pairs, self._written = list(pairs), b""
        self._answers: list[bytes] = []
        self._answer()

    def write(self, data: bytes) -> None:
        """Compare what a driver sends with what it should."""
        assert not self._answers, f"Unread {self._answers!r}, but {data.hex(' ')} was written."
        expected = (self._pairs[0][0] if self._pairs else None) or b""
        self._written += data
        assert expected.startswith(self._written), (
            f"Unexpected {self._written.hex(' ')} was written. Must be {expected.hex(' ')}."
        )
        self._answer()

    def read(self, size: int, timeout: float) -> bytes:  # noqa: ARG002 - no time goes by
        """Give the next piece of the answer, at most `size` bytes; empty if all is read."""
        if not self._answers:
            return b""
        piece = self._answers.pop(0)
        if piece[size:]:
            self._answers.insert(0, piece[size:])
        self._answer()
        return piece[:size]

    def close(self) -> None:
        """Do nothing, so that a driver's own clean-up does not hide leftovers."""

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Fail if something was not written or not read."""
        if kind is None:
            leftover = (self._answers, self._written, self._pairs)
            assert not any(leftover), f"Left unread, cut short and unwritten: {leftover!r}."

    def _answer(self) -> None:
        """Make answers ready to be read once all is written that the device waits for."""
        while self._pairs and not self._answers and self._written == (self._pairs[0][0] or b""):
            _, answer = self._pairs.pop(0)
            self._answers = [answer] if isinstance(answer, bytes) else list(answer or ())
            self._written = b""
