"""Addresses of devices, byte streams to those on a serial line, and the clock of all of them.

``serial:///dev/ttyACM0`` is a serial port (``serial://COM3`` on Windows); `parse` has the rules of
all addresses, none of which names a program or a library.

Drivers and recorder take the time, wait, and start their threads by a `Clock` alone: `SYSTEM` for
hardware, an `EmulatedClock` for emulated devices. On the latter a single thread runs at a time.
When it waits, the next thread is the first in the order of waits whose condition holds or whose
time has come; if there is none the clock leaps to the earliest end of a wait. So a program, and
all that it writes, does not depend on the load of the machine, its cores, or the speed of its disk.
"""

import math
import queue
import re
import threading
import time as system_time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol, Self, TypeVar

from dbthermal import _text as texts

if TYPE_CHECKING:
    import serial

__all__ = [
    "START",
    "SYSTEM",
    "Clock",
    "EmulatedClock",
    "SerialTransport",
    "Task",
    "Transport",
    "TransportError",
    "open_serial",
    "parse",
]
__dir__ = __all__.copy

Item = TypeVar("Item")

START: Final = datetime(2000, 1, 1, tzinfo=UTC)  # at time 0 of every emulated clock
_ROOM: Final = 1.0  # emulated wait for a place in a buffer whose reader has ended [s]
_POLL: Final = 0.05  # between two looks at the waits, by the computer's clock [s]
WRITE_TIMEOUT: Final = 1.0  # longest wait until the operating system took the bytes to send [s]
SETTLING: Final = 0.05  # time between taking RTS down and up, as in Thorlabs's example [s]

_NODE = r"/dev/(?!\S*\.\.)[^\s?#\\]+"

# Form of the addresses of each scheme, and its regular expression.
_RULES: Final[Mapping[str, tuple[str, str]]] = {
    "v4l2": ("v4l2:///dev/<node>", f"v4l2://{_NODE}"),
    "serial": ("serial:///dev/<port>", f"serial://({_NODE}|COM[0-9]+)"),
    "tc08": ("tc08:", "tc08:"),
}
_LONGEST: Final = 200  # [character]


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
        """Hold a lock while a block lasts, in which the thread may wait on this clock."""
        with lock:
            yield

    @contextmanager
    def joined(self, entered: threading.Event | None = None) -> Iterator[None]:
        """Let this thread take part in an order; a new one sets its event when it does."""
        if entered is not None:
            entered.set()
        yield


SYSTEM: Final = Clock()


class Task(threading.Thread):
    """A thread that waits on a clock; the event `ended` is set at the end of its work."""

    def __init__(
        self, clock: Clock, name: str, work: Callable[..., Any], *values: Any, daemon: bool = True
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
        with self._clock.joined(self._entered):
            try:
                self._work(*self._values)
            finally:
                self.ended.set()


class _Wait:
    """Wait of a thread until a condition holds, or until a time [s]."""

    def __init__(self, condition: Callable[[], bool], end: float) -> None:
        self.condition, self.end, self.thread = condition, end, threading.get_ident()
        self.held = False  # True if the condition held before the end
        self.over = threading.Event()


class EmulatedClock(Clock):
    """Clock of an emulated bench, which begins at time 0, on 1 January 2000.

    Threads take part in its order if they are a `Task`, or inside `joined`. Any thread may wait on
    it, but those outside the order run beside it, and what they do depends on the computer.
    """

    def __init__(self) -> None:
        self._now = 0.0
        self._lock = threading.Lock()
        self._waits: list[_Wait] = []
        self._members = set[int]()  # threads of the order, of which those run that do not wait

    def __call__(self) -> float:
        """Time since the start [s]."""
        return self._now

    def utc(self) -> datetime:
        """Emulated date and time of day."""
        return START + timedelta(seconds=self._now)

    def sleep(self, seconds: float) -> None:
        """Let the other threads run until a time has passed [s]."""
        self._wait(lambda: False, seconds)

    def wait(self, event: threading.Event, timeout: float) -> bool:
        """Let the other threads run until an event is set, at most `timeout` [s]."""
        return self._wait(event.is_set, timeout)

    def get(self, items: "queue.SimpleQueue[Item]", timeout: float) -> Item:
        """Let the other threads run until a queue has an item; `queue.Empty` if it gets none."""
        self._wait(lambda: not items.empty(), timeout)
        return items.get_nowait()

    def has_room(self, room: threading.Semaphore) -> bool:
        """Wait for a place in a buffer: its reader is awaited in emulated time."""
        return self._wait(lambda: room.acquire(blocking=False), _ROOM)

    @contextmanager
    def hold(self, lock: threading.Lock) -> Iterator[None]:
        """Hold a lock while a block lasts; the other threads run until it is free."""
        taken = threading.Event()  # the condition may be evaluated by another thread

        def take() -> bool:
            if lock.acquire(blocking=False):
                taken.set()
            return taken.is_set()

        try:
            self._wait(take)
            yield
        finally:
            if taken.is_set():
                lock.release()

    @contextmanager
    def joined(self, entered: threading.Event | None = None) -> Iterator[None]:
        """Take part in the order while a block lasts; see `Clock.joined`."""
        # A place in the order: now, or, of a new thread, after all that wait.
        turn = _Wait(lambda: True, self._now)
        with self._lock:
            is_member = turn.thread in self._members
            self._members.add(turn.thread)
            if entered is not None:
                self._waits.append(turn)
        if entered is not None:
            entered.set()
            self._await(turn)
        try:
            yield
        finally:
            if not is_member:  # the next thread runs
                with self._lock:
                    self._members.discard(turn.thread)
                    self._next()

    def _wait(self, condition: Callable[[], bool], timeout: float = math.inf) -> bool:
        """Wait until a condition holds, at most `timeout` [s]; True if it does."""
        turn = _Wait(condition, self._now + timeout)
        try:
            with self._lock:
                self._waits.append(turn)
                self._next()
            self._await(turn)
        except BaseException:  # an interrupt: this thread goes on
            with self._lock:
                self._waits = [wait for wait in self._waits if wait is not turn]
            raise
        return turn.held

    def _await(self, turn: _Wait) -> None:
        while not turn.over.wait(_POLL):
            with self._lock:
                self._next()

    def _next(self) -> None:
        """Let the next thread run, if none does."""
        while self._waits and self._members <= {wait.thread for wait in self._waits}:
            for chosen in self._waits:
                chosen.held = chosen.condition()
                if chosen.held or chosen.end <= self._now:
                    break
            else:  # no condition holds: the clock leaps to the earliest end
                chosen = min(self._waits, key=lambda wait: wait.end)
                if math.isinf(chosen.end):
                    return  # a thread outside the order has what all wait for
                self._now = chosen.end
            self._waits.remove(chosen)
            chosen.over.set()


def parse(url: str, scheme: str) -> str:
    """File of the device at an address of a scheme; ValueError names the address and its form."""
    form, expression = _RULES[scheme]
    if re.fullmatch(expression, url) is None or len(url) > _LONGEST:
        raise ValueError(f"Invalid address {texts.shown(url)}. Must be {form}.")
    return url.partition(":")[2].removeprefix("//")


class Closing:
    """Context manager that closes at its end; a failure of that hides no error inside it."""

    def close(self) -> None:
        """Release the device; a second call does nothing."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: object
    ) -> None:
        try:
            self.close()
        except (OSError, RuntimeError) as closing:
            if error is None:
                raise
            error.add_note(f"Closing failed too. {closing}")


class TransportError(OSError):
    """The device is gone, its port cannot be opened, or it takes no bytes."""


class Transport(Protocol):
    """A line to a device, on its clock; each method raises `TransportError` if it is gone."""

    is_simulated: bool  # True if the device is emulated

    @property
    def clock(self) -> Clock:
        """Clock of the device's times and time limits."""

    def write(self, data: bytes) -> None:
        """Send all bytes."""

    def read(self, size: int, timeout: float) -> bytes:
        """Wait for bytes: at most `size`, often fewer; none only if `timeout` [s] went by."""

    def close(self) -> None:
        """Release the line; a second call does nothing."""


class SerialTransport(Closing):
    """A `Transport` over an open port of pyserial; `url` is its name in messages."""

    is_simulated, clock = False, SYSTEM

    def __init__(self, port: "serial.Serial", url: str) -> None:
        self.url, self._port = url, port

    def write(self, data: bytes) -> None:
        """Send all bytes; `TransportError` if the device takes none for `WRITE_TIMEOUT`."""
        with _named("write to", self.url):
            self._port.write(data)

    def read(self, size: int, timeout: float) -> bytes:
        """Wait for bytes, at most `timeout` [s]; see `Transport.read`."""
        with _named("read from", self.url):
            self._port.timeout = timeout
            first: bytes = self._port.read(1)
            waiting = min(size - 1, self._port.in_waiting) if first else 0
            return first + (self._port.read(waiting) if waiting else b"")

    def close(self) -> None:
        """Release the port."""
        with _named("close", self.url):
            self._port.close()


@contextmanager
def _named(action: str, port: str, rule: str = "The device must stay connected") -> Iterator[None]:
    """Name port and action in the errors of pyserial, which are OSError."""
    try:
        yield
    except OSError as error:
        raise TransportError(f"Could not {action} '{port}': {error}. {rule}.") from error


def open_serial(url: str, *, baudrate: int, rtscts: bool = False) -> SerialTransport:
    """Open the line to a device by its address, for this program alone; nothing is sent.

    Speed [bit/s], and whether RTS and CTS control its flow, RTS being taken down and up once.
    ValueError for another address, TransportError if the port cannot be opened.
    """
    path = parse(url, "serial")
    # A pseudo-terminal would let an emulator pass for hardware.
    if Path(path).resolve().is_relative_to("/dev/pts"):
        raise ValueError(f"Invalid address '{url}', a pseudo-terminal. Must be a device's port.")

    import serial  # noqa: PLC0415 - an optional package, which cameras without a port do without

    options = {"rtscts": rtscts, "exclusive": True, "write_timeout": WRITE_TIMEOUT}
    with _named("open", path, "It must exist, be yours to use, and in no other program's use"):
        port = serial.Serial(path, baudrate, **options)
    with ExitStack() as stack:
        line = stack.enter_context(SerialTransport(port, url))
        if rtscts:
            with _named("set RTS of", url):
                port.rts = False
                line.clock.sleep(SETTLING)
                port.rts = True
        stack.pop_all()
    return line
