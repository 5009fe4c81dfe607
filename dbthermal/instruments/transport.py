"""Byte streams to devices, each opened by its address.

``serial:///dev/ttyACM0`` is a serial port (``serial://COM3`` on Windows), ``pty:///dev/pts/3`` a
pseudo-terminal of an emulated device, and ``sim://boson?sn=7`` an emulator that is started for the
caller and ends with the transport. Nothing is sent when one is opened. Tested on pseudo-terminals,
not on hardware.
"""

import errno
import importlib
from collections.abc import Callable
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import TYPE_CHECKING, Final, Protocol, Self

from dbthermal.instruments import _addresses as addresses

if TYPE_CHECKING:
    import serial

__all__ = ["EMULATORS", "Closing", "SerialTransport", "Transport", "TransportError", "open_serial"]
__dir__ = __all__.copy

WRITE_TIMEOUT: Final = 1.0  # longest wait until the operating system took the bytes to send [s]

EMULATORS: Final = MappingProxyType(
    {"boson": "dbthermal.instruments.emulated.boson", "apt": "dbthermal.instruments.emulated.apt"}
)
"""Module of each emulator, imported when it is started: its ``start(options, world)`` returns an
object with `path` and `close`."""

_SCHEMES = ("serial", "pty", "sim")
_NO_LINE = (errno.ENOTTY, errno.EINVAL)


class Closing:
    """Context manager that closes at its end, without hiding an error inside it.

    A failure to close is raised if there was no other error, and else added to it as a note.
    """

    def close(self) -> None:
        """Release what is held; a second time does nothing."""
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
    """A line to a device, as a driver needs it; a context manager in each implementation."""

    @property
    def is_simulated(self) -> bool:
        """True if the device is emulated."""

    def write(self, data: bytes) -> None:
        """Send all bytes; `TransportError` if the device is gone."""

    def read(self, size: int, timeout: float) -> bytes:
        """Wait until bytes came, or `timeout` [s] went by; `TransportError` if the device is gone.

        Return at most `size` bytes and often fewer; none only if `timeout` went by.
        """

    def close(self) -> None:
        """Release the line; a second time does nothing. `TransportError` if it cannot."""


class SerialTransport(Closing):
    """An open serial port of pyserial, or pseudo-terminal; see `open_serial`.

    `url` is its name in messages; `after` is called once it is closed, to end an emulator.
    """

    def __init__(
        self,
        port: "serial.Serial",
        url: str,
        *,
        is_simulated: bool,
        after: Callable[[], None] | None = None,
    ) -> None:
        self.url = url
        self.is_simulated = is_simulated
        self._port = port
        self._after = after

    def write(self, data: bytes) -> None:
        """Send all bytes; `TransportError` if the device takes none for `WRITE_TIMEOUT`."""
        try:
            self._port.write(data)
        except OSError as error:  # pyserial's errors are of this kind
            raise self._lost("write to", error) from error

    def read(self, size: int, timeout: float) -> bytes:
        """Wait until bytes came, or `timeout` [s] went by; see `Transport.read`."""
        try:
            self._port.timeout = timeout
            first: bytes = self._port.read(1)
            more = min(size - 1, self._port.in_waiting) if first else 0
            return first + (self._port.read(more) if more else b"")
        except OSError as error:
            raise self._lost("read from", error) from error

    def set_rts(self, *, level: bool) -> bool:
        """Set the line RTS; False if the port has none, as is true of every pseudo-terminal."""
        try:
            self._port.rts = level
        except OSError as error:
            if error.errno not in _NO_LINE:
                raise self._lost("set RTS of", error) from error
            return False
        return True

    def close(self) -> None:
        """Release the port and end its emulator, also if the port does not close."""
        after, self._after = self._after, None
        try:
            self._port.close()
        except OSError as error:
            raise self._lost("close", error) from error
        finally:
            if after is not None:
                after()

    def _lost(self, action: str, error: OSError) -> TransportError:
        return TransportError(
            f"Could not {action} '{self.url}': {error}. The device must stay connected."
        )


def open_serial(
    url: str, *, baudrate: int, rtscts: bool = False, world: object | None = None
) -> SerialTransport:
    """Open the line to a device by its address, for this program alone; nothing is sent.

    ``sim://boson/wide`` is ``sim://boson?name=wide``. `baudrate` [bit/s] is the speed of the line,
    `rtscts` its flow control by RTS and CTS, and `world` the emulated bench that a ``sim://``
    device is part of; by default one of its own. ValueError for another address, unknown options,
    or a pseudo-terminal as a serial port, which would let an emulator pass for hardware;
    TransportError if the port cannot be opened.
    """
    import serial  # noqa: PLC0415 - an optional package, which drivers of other devices do without

    address = addresses.parse(url, _SCHEMES)
    path, after = address.target, None
    if address.scheme == "sim":
        if path not in EMULATORS:
            rule = f"Must be one of {sorted(EMULATORS)} after sim://"
            raise ValueError(f"Invalid address '{url}'. {rule}.")
        options = {**address.options, **({"name": address.name} if address.name else {})}
        emulated = importlib.import_module(EMULATORS[path]).start(options, world)
        path, after = emulated.path, emulated.close
    elif address.scheme == "serial" and Path(path).resolve().is_relative_to("/dev/pts"):
        raise ValueError(f"Invalid address '{url}', a pseudo-terminal. Must begin with pty://.")
    try:
        port = serial.Serial(
            path, baudrate, rtscts=rtscts, exclusive=True, write_timeout=WRITE_TIMEOUT
        )
    except OSError as error:
        if after is not None:
            after()
        raise TransportError(
            f"Could not open '{path}': {error}. It must exist, be yours to use, and in no "
            "other program's use."
        ) from error
    return SerialTransport(port, url, is_simulated=address.scheme != "serial", after=after)
