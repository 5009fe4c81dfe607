"""The line between an emulated device and its driver: a raw pseudo-terminal in real time."""

import os
import pty
import select
import threading
import tty
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Final, Protocol, TypeVar

from dbthermal.instruments.transport import Closing

Number = TypeVar("Number", bound=float)

TICK: Final = 0.01
"""Longest time after which a port looks whether it is to end, or the device was pulled out [s]."""

_READ_SIZE = 4096


class Device(Protocol):
    """An emulated device: it takes bytes, and gives bytes when it is polled."""

    @property
    def plugged(self) -> bool:
        """False once it was pulled out."""

    def receive(self, data: bytes) -> None:
        """Take in bytes from the driver."""

    def poll(self) -> list[bytes]:
        """Give the bytes that are due, each piece in a write of its own."""

    def next_due(self) -> float:
        """Time until something may be due [s]; infinite if it waits for bytes."""


class EmulatedPort(Closing):
    """A raw pseudo-terminal on which a thread lets an emulated device answer.

    `path` is the driver's end, as in ``/dev/pts/3``. If the device is pulled out, or an error in it
    ends the thread, the terminal hangs up, as a real one does. Bytes that a driver does not read
    are kept, without blocking the device, which only the thread calls once it is started.
    """

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
        """Carry bytes until the device is pulled out, or the port is closed."""
        waiting: deque[bytes] = deque()
        try:
            while self.device.plugged and not self._ending.is_set():
                timeout = min(TICK, max(0.0, self.device.next_due()))
                writers = [self._master] if waiting else []
                ready, writable, _ = select.select([self._master], writers, [], timeout)
                if ready:
                    self.device.receive(os.read(self._master, _READ_SIZE))
                waiting.extend(self.device.poll())
                if writable:
                    piece = waiting.popleft()
                    if rest := piece[os.write(self._master, piece) :]:
                        waiting.appendleft(rest)
        finally:
            os.close(self._master)
            os.close(self._slave)


def require_known(options: Mapping[str, str], names: Sequence[str]) -> None:
    """Raise ValueError for an option of an emulator's address that it does not have."""
    for name in sorted(options.keys() - {*names}):
        rule = f"Must be one of {', '.join(names)}." if names else "It has no options."
        raise ValueError(f"Unknown option '{name}' of an emulator. {rule}")


def number(
    options: Mapping[str, str], name: str, default: Number, limits: tuple[Number, Number]
) -> Number:
    """Number that an option gives, as in ``sim://boson?sn=7``, of the type of `default`.

    ValueError if it is no such number, or outside the limits.
    """
    if name not in options:
        return default
    lowest, highest = limits
    try:
        value = type(default)(options[name])
        allowed = lowest <= value <= highest  # which NaN is not
    except ValueError:
        allowed = False
    if not allowed:
        raise ValueError(
            f"Invalid option {name}={options[name]} of an emulator. "
            f"Must be a number ({type(default).__name__}) in {lowest} to {highest}."
        )
    return value
