"""The line between an emulated device and its driver, in memory."""

import math

import pytest

from dbthermal.instruments.emulated.clock import EmulatedClock
from dbthermal.instruments.emulated.line import Line
from dbthermal.instruments.transport import TransportError

AWKWARD = bytes.fromhex("8E 0A 0D 11 13 00 FF AE 03 04 1A 7F")


class Echo:
    """A device that echoes its input."""

    def __init__(self) -> None:
        self.plugged = True
        self.said: list[bytes] = []

    def receive(self, data: bytes) -> None:
        """Take in bytes."""
        self.said.append(data)

    def poll(self) -> list[bytes]:
        """Give them back."""
        said, self.said = self.said, []
        return said

    def next_due(self) -> float:
        """Nothing comes by itself."""
        return math.inf


def test_reads_are_short_and_time_out() -> None:
    """All bytes come back unchanged, in order, and silence takes no time on an injected clock."""
    line = Line(Echo(), EmulatedClock())
    line.write(AWKWARD)
    line.write(b"ab")
    assert (line.read(10, 1.0) + line.read(4096, 1.0), line.read(2, 1.0)) == (AWKWARD, b"ab")
    assert line.read(2, 5.0) == b""


def test_an_end_is_an_end() -> None:
    """A line that was closed, twice, and one whose device was unplugged raise errors."""
    closed, device = Line(Echo(), EmulatedClock()), Echo()
    for _ in range(2):
        closed.close()
    device.plugged = False
    for line in (closed, Line(device, EmulatedClock())):
        with pytest.raises(TransportError, match="It must stay connected and open"):
            line.write(b"x")
        with pytest.raises(TransportError, match="It must stay connected and open"):
            line.read(1, 30.0)
