"""Addresses of devices, and byte streams to those on a serial line.

``serial:///dev/ttyACM0`` is a serial port (``serial://COM3`` on Windows); `parse` has the rules of
all addresses. An address never names a program or a library: an environment variable names that of
the TC-08.
"""

import re
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Final, Protocol, Self

from dbthermal import _text as texts
from dbthermal.instruments.clock import SYSTEM, Clock

if TYPE_CHECKING:
    import serial

__all__ = ["SerialTransport", "Transport", "TransportError", "open_serial", "parse"]
__dir__ = __all__.copy

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


def parse(url: str, scheme: str) -> str:
    """File of the device at an address of a scheme; ValueError names the address and its form."""
    form, expression = _RULES[scheme]
    if re.fullmatch(expression, url) is None or len(url) > _LONGEST:
        raise ValueError(f"Invalid address {texts.shown(url)}. Must be {form}.")
    return url.partition(":")[2].removeprefix("//")


class Closing:
    """Context manager that closes at its end, without hiding an error inside it.

    A failure to close becomes a note of that error; it is raised only if there is none.
    """

    def close(self) -> None:
        """Release the device; a second call does nothing."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
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
        with self.named("write to"):
            self._port.write(data)

    def read(self, size: int, timeout: float) -> bytes:
        """Wait for bytes, at most `timeout` [s]; see `Transport.read`."""
        with self.named("read from"):
            self._port.timeout = timeout
            first: bytes = self._port.read(1)
            waiting = min(size - 1, self._port.in_waiting) if first else 0
            return first + (self._port.read(waiting) if waiting else b"")

    def close(self) -> None:
        """Release the port."""
        with self.named("close"):
            self._port.close()

    @contextmanager
    def named(self, action: str) -> Iterator[None]:
        """Name port and action in the errors of pyserial, which are OSError."""
        try:
            yield
        except OSError as error:
            rule = "The device must stay connected"
            raise TransportError(f"Could not {action} '{self.url}': {error}. {rule}.") from error


def open_serial(url: str, *, baudrate: int, rtscts: bool = False) -> SerialTransport:
    """Open the line to a device by its address, for this program alone; nothing is sent.

    `baudrate` [bit/s] is the speed of the line. With `rtscts` its flow is controlled by RTS and
    CTS, and RTS is taken down and up once. ValueError for another address, or a pseudo-terminal,
    which would let an emulator pass for hardware; TransportError if the port cannot be opened.
    """
    path = parse(url, "serial")
    if Path(path).resolve().is_relative_to("/dev/pts"):
        raise ValueError(f"Invalid address '{url}', a pseudo-terminal. Must be a device's port.")

    import serial  # noqa: PLC0415 - an optional package, which cameras without a port do without

    options = {"rtscts": rtscts, "exclusive": True, "write_timeout": WRITE_TIMEOUT}
    try:
        port = serial.Serial(path, baudrate, **options)
    except OSError as error:
        rule = "It must exist, be yours to use, and in no other program's use"
        raise TransportError(f"Could not open '{path}': {error}. {rule}.") from error
    with ExitStack() as stack:
        line = stack.enter_context(SerialTransport(port, url))
        if rtscts:
            with line.named("set RTS of"):
                port.rts = False
                line.clock.sleep(SETTLING)
                port.rts = True
        stack.pop_all()
    return line
