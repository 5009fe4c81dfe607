"""The line between an emulated device and its driver: byte for byte, in memory."""

import threading
from typing import Final, Protocol

from dbthermal.instruments.clock import Clock
from dbthermal.instruments.transport import Closing, TransportError

TICK: Final = 0.01  # shortest wait until the device is asked again if it has something to say [s]


class Device(Protocol):
    """An emulated device: it takes bytes, and gives bytes when it is polled."""

    @property
    def plugged(self) -> bool:
        """False once it was pulled out."""

    def receive(self, data: bytes) -> None:
        """Take in bytes from the driver."""

    def poll(self) -> list[bytes]:
        """Give the bytes that are due, each piece to be read by itself."""

    def next_due(self) -> float:
        """Time until something may be due [s]; infinite if it waits for bytes."""


class Line(Closing):
    """A `transport.Transport` to an emulated device, on its clock; for any number of threads.

    Bytes that a driver does not read are kept. `TransportError` once the device is pulled out.
    """

    is_simulated = True

    def __init__(self, device: Device, clock: Clock) -> None:
        self._device, self.clock = device, clock
        self._lock = threading.Lock()
        self._pieces: list[bytes] = []
        self._closed = False

    def write(self, data: bytes) -> None:
        """Give bytes to the device; see `Transport.write`."""
        with self._lock:
            self._check()
            self._device.receive(data)

    def read(self, size: int, timeout: float) -> bytes:
        """Give one piece of the device's output; see `Transport.read`."""
        deadline = self.clock() + timeout
        while True:
            with self._lock:
                self._check()
                self._pieces += self._device.poll()
                if self._pieces:
                    piece = self._pieces.pop(0)
                    if piece[size:]:
                        self._pieces.insert(0, piece[size:])
                    return piece[:size]
                pause = max(self._device.next_due(), TICK)
            remaining = deadline - self.clock()
            if remaining <= 0:
                return b""
            self.clock.sleep(min(remaining, pause))

    def close(self) -> None:
        """End; a second time does nothing."""
        self._closed = True

    def _check(self) -> None:
        if self._closed or not self._device.plugged:
            raise TransportError("Lost the emulated device. It must stay connected and open.")
