"""Where an emulated device meets a driver: a raw pseudo-terminal, or a loop in memory.

The pseudo-terminal has a path that any program can open, and runs in real time. The loop is for
tests: time is injected, so that waiting takes none.
"""

import os
import pty
import select
import threading
import time as system_time
import tty
from collections import deque
from collections.abc import Callable
from typing import Final, Protocol

from dbthermal.instruments.closing import Closing
from dbthermal.instruments.transport import TransportError

TICK: Final = 0.01
"""Longest time after which a port looks whether it is to end, or the device was pulled out [s]."""

_READ_SIZE = 4096


class Device(Protocol):
    """An emulated device: it takes bytes, and is asked what it has to say."""

    @property
    def plugged(self) -> bool:
        """False once it was pulled out."""

    def receive(self, data: bytes) -> None:
        """Take in bytes from the driver."""

    def poll(self) -> list[bytes]:
        """Give what is due to be sent now, each piece in a write of its own."""

    def next_due(self) -> float:
        """Time until something may be due [s]; infinite if nothing will unless bytes come."""


class EmulatedPort(Closing):
    """
    A raw pseudo-terminal on which a thread lets an emulated device answer.

    If the device is pulled out, or an error in it ends the thread, the terminal hangs up, as a real
    one does. What a driver does not read is kept, without blocking the device.

    Parameters
    ----------
    device : Device
        Called from the thread only, once it is started.

    Attributes
    ----------
    device : Device
        The emulated device.
    path : str
        Of the end for the driver, as in ``/dev/pts/3``.
    is_simulated : bool
        True.
    """

    is_simulated: Final = True

    def __init__(self, device: Device) -> None:
        self.device = device
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)  # else line ends and flow-control bytes are changed
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="emulated device", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread and hang up; a second time does nothing."""
        self._ending.set()
        self._thread.join()

    def _serve(self) -> None:
        try:
            self._let_talk()
        finally:
            os.close(self._master)
            os.close(self._slave)

    def _let_talk(self) -> None:
        """Carry bytes until the device is pulled out, or the port is closed."""
        waiting: deque[bytes] = deque()
        while self.device.plugged and not self._ending.is_set():
            timeout = min(TICK, max(0.0, self.device.next_due()))
            writers = [self._master] if waiting else []
            ready, writable, _ = select.select([self._master], writers, [], timeout)
            if ready:
                self.device.receive(os.read(self._master, _READ_SIZE))
            waiting.extend(self.device.poll())
            if writable:
                piece = waiting.popleft()
                rest = piece[os.write(self._master, piece) :]
                if rest:
                    waiting.appendleft(rest)


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
        """Give one piece of what the device says; see `Transport.read`."""
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
