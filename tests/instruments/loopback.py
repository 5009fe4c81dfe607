"""A line to an emulated device in memory, on an injected clock without real waiting."""

import time as system_time
from collections import deque
from collections.abc import Callable
from typing import Final

from dbthermal.instruments.emulated.port import TICK, Device
from dbthermal.instruments.transport import Closing, TransportError


class Loop(Closing):
    """
    A transport straight to an emulated device, in memory and on an injected clock.

    Parameters
    ----------
    device : Device
        The emulated device.
    clock, sleep : callable
        Give the time and wait [s]; the device must be on the same clock.

    Attributes
    ----------
    is_simulated : bool
        True.
    """

    is_simulated: Final = True

    def __init__(
        self,
        device: Device,
        *,
        clock: Callable[[], float] = system_time.monotonic,
        sleep: Callable[[float], None] = system_time.sleep,
    ) -> None:
        self._device = device
        self._clock = clock
        self._sleep = sleep
        self._pieces: deque[bytes] = deque()
        self._closed = False

    def write(self, data: bytes) -> None:
        """Give bytes to the device; see `Transport.write`."""
        self._check()
        self._device.receive(data)

    def read(self, size: int, timeout: float) -> bytes:
        """Give one piece of the device's output; see `Transport.read`."""
        deadline = self._clock() + timeout
        while True:
            self._check()
            self._pieces.extend(self._device.poll())
            if self._pieces:
                piece = self._pieces.popleft()
                if piece[size:]:
                    self._pieces.appendleft(piece[size:])
                return piece[:size]
            remaining = deadline - self._clock()
            if remaining <= 0:
                return b""
            self._sleep(min(remaining, max(self._device.next_due(), TICK)))

    def close(self) -> None:
        """End; a second time does nothing."""
        self._closed = True

    def _check(self) -> None:
        if self._closed or not self._device.plugged:
            raise TransportError("Lost the emulated device. It must stay connected and open.")
