"""Clock of a rig: that of the computer, or emulated time that leaps from event to event.

Drivers and recorder take the time, wait, and start their threads by a `Clock` alone. That of
hardware is `SYSTEM`; `dbthermal.instruments.emulated.clock` has the one of emulated devices.
"""

import queue
import threading
import time as system_time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import Any, Final, TypeVar

__all__ = ["SYSTEM", "Clock", "Task"]
__dir__ = __all__.copy

Item = TypeVar("Item")


class Clock:
    """The computer's clock: called, it returns the monotonic time [s]."""

    def __call__(self) -> float:
        """Time [s] since an arbitrary start."""
        return system_time.monotonic()

    def utc(self) -> datetime:
        """Date and time of day."""
        return datetime.now(UTC)

    def sleep(self, seconds: float) -> None:
        """Wait for a time [s]."""
        system_time.sleep(seconds)

    def wait(self, event: threading.Event, timeout: float) -> bool:
        """Wait until an event is set, at most `timeout` [s]; True if it is."""
        return event.wait(timeout)

    def get(self, items: "queue.SimpleQueue[Item]", timeout: float) -> Item:
        """Wait at most `timeout` [s] for the next item of a queue; `queue.Empty` without any."""
        return items.get(timeout=timeout)

    def has_room(self, room: threading.Semaphore) -> bool:
        """Take a place in a buffer; False if it is full."""
        return room.acquire(blocking=False)

    @contextmanager
    def hold(self, lock: threading.Lock) -> Iterator[None]:
        """Hold a lock while a block lasts; it may wait on this clock in it."""
        with lock:
            yield

    @contextmanager
    def joined(self) -> Iterator[None]:
        """Let this thread take part in the order of a clock that has one, while a block lasts."""
        yield

    def enter(self, entered: threading.Event) -> None:
        """Begin the work of a thread, and set an event when it has its place in the order."""
        entered.set()

    def leave(self) -> None:
        """End the work of a thread."""


SYSTEM: Final = Clock()


class Task(threading.Thread):
    """A thread that waits on a clock; the event `ended` is set at the end of its work."""

    def __init__(
        self,
        clock: Clock,
        name: str,
        work: Callable[..., object],
        *values: Any,
        daemon: bool = True,
    ) -> None:
        super().__init__(name=name, daemon=daemon)
        self.ended = threading.Event()
        self._clock, self._work, self._values = clock, work, values
        self._entered = threading.Event()

    def start(self) -> None:
        """Begin; the thread has its place in the order of the clock when this returns."""
        super().start()
        self._entered.wait()

    def run(self) -> None:
        """Work until the end."""
        self._clock.enter(self._entered)
        try:
            self._work(*self._values)
        finally:
            self.ended.set()
            self._clock.leave()
