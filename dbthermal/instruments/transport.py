"""Byte streams to devices, each opened by one name like an address.

``serial:///dev/ttyACM0`` is a serial port (``serial://COM3`` on Windows), ``pty:///dev/pts/3`` a
pseudo-terminal on which somebody emulates a device, and ``sim://boson?sn=7`` an emulator that is
started for the caller and ends with the transport. Nothing is sent when one is opened. Tested
on pseudo-terminals, not on hardware.
"""

import errno
import importlib
from collections.abc import Callable
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, Protocol
from urllib.parse import parse_qsl, urlsplit

import serial

from dbthermal.instruments.closing import Closing

if TYPE_CHECKING:
    from dbthermal.instruments.emulated.world import World

WRITE_TIMEOUT: Final = 1.0
"""Longest wait until the operating system took the bytes to send [s]."""

EMULATORS: Final = MappingProxyType(
    {
        "boson": "dbthermal.instruments.emulated.boson",
        "apt": "dbthermal.instruments.emulated.apt",
    }
)
"""Module of each emulator: its ``start(options, world)`` gives something with `path` and `close`.
"""

_SCHEMES = ("serial", "pty", "sim")
_NO_LINE = (errno.ENOTTY, errno.EINVAL)


class TransportError(OSError):
    """The device is gone, its port cannot be opened, or it takes no bytes."""


class Transport(Protocol):
    """What a driver needs of a line to its device; a context manager in each implementation."""

    @property
    def is_simulated(self) -> bool:
        """Whether no hardware is at the other end."""

    def write(self, data: bytes) -> None:
        """Send all bytes; `TransportError` if the device is gone."""

    def read(self, size: int, timeout: float) -> bytes:
        """
        Wait until something has come, or `timeout` [s] went by.

        Return what is there, at most `size` bytes and often fewer; none only if `timeout` went by.
        `TransportError` if the device is gone.
        """

    def close(self) -> None:
        """Give the line back; a second time does nothing. `TransportError` if it cannot."""


class SerialTransport(Closing):
    """
    A serial port, or a pseudo-terminal, that is open already; see `open_serial`.

    Parameters
    ----------
    port : Serial
        Open, of pyserial.
    url : str
        Name for messages.
    is_simulated : bool
        Whether an emulator is at the other end.
    after : callable, optional
        Called once the port is closed, to end an emulator.
    """

    def __init__(
        self,
        port: serial.Serial,
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
        """
        Send all bytes.

        Parameters
        ----------
        data : bytes
            To send.

        Raises
        ------
        TransportError
            If the device is gone or takes no bytes for `WRITE_TIMEOUT`, or the port is closed.
        """
        try:
            self._port.write(data)
        except OSError as error:  # pyserial's errors are of this kind
            raise self._lost("write to", error) from error

    def read(self, size: int, timeout: float) -> bytes:
        """
        Wait until something has come, or `timeout` went by.

        Parameters
        ----------
        size : int
            Most bytes to return, at least 1.
        timeout : float
            Longest wait [s].

        Returns
        -------
        bytes
            Often fewer than `size`; none only if `timeout` went by.

        Raises
        ------
        TransportError
            If the device is gone, or the port is closed.
        """
        try:
            self._port.timeout = timeout
            first: bytes = self._port.read(1)
            more = min(size - 1, self._port.in_waiting) if first else 0
            return first + (self._port.read(more) if more else b"")
        except OSError as error:
            raise self._lost("read from", error) from error

    def set_rts(self, *, level: bool) -> bool:
        """
        Set the line RTS, where there is one.

        Parameters
        ----------
        level : bool
            True asserts it.

        Returns
        -------
        bool
            False if the port has no such line, as is true of every pseudo-terminal.

        Raises
        ------
        TransportError
            If the device is gone.
        """
        try:
            self._port.rts = level
        except OSError as error:
            if error.errno not in _NO_LINE:
                raise self._lost("set RTS of", error) from error
            return False
        return True

    def close(self) -> None:
        """
        Give the port back and end its emulator; a second time does nothing.

        Raises
        ------
        TransportError
            If the port does not close; its emulator is ended all the same.
        """
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
    url: str,
    *,
    baudrate: int,
    rtscts: bool = False,
    world: "World | None" = None,
) -> SerialTransport:
    """
    Open the line to a device by its name; nothing is sent.

    Parameters
    ----------
    url : str
        ``serial:///dev/ttyACM0``, ``pty:///dev/pts/3`` or ``sim://boson?sn=7``, where the emulator
        says which options it takes; ``sim://boson/wide`` is ``sim://boson?name=wide``.
    baudrate : int
        Speed of the line [bit/s].
    rtscts : bool
        Flow control by the lines RTS and CTS.
    world : World, optional
        What a ``sim://`` device is part of; by default one of its own.

    Returns
    -------
    SerialTransport
        Open, and no other program's.

    Raises
    ------
    ValueError
        If the name is none of these, says more than is understood, or gives a pseudo-terminal as a
        serial port, which would let an emulator pass for hardware.
    TransportError
        If the port cannot be opened.
    """
    parts = urlsplit(url)
    if parts.scheme not in _SCHEMES or not parts.netloc + parts.path:
        raise ValueError(f"Invalid device '{url}'. Must begin with serial://, pty:// or sim://.")
    if parts.scheme == "sim":
        return _open_emulated(url, world, baudrate=baudrate, rtscts=rtscts)
    if parts.query or parts.fragment:
        raise ValueError(f"Invalid device '{url}' with options. Must have none but after sim://.")
    path = parts.netloc + parts.path
    if parts.scheme == "serial" and Path(path).resolve().is_relative_to("/dev/pts"):
        raise ValueError(f"Invalid device '{url}', a pseudo-terminal. Must begin with pty://.")
    port = _open_port(path, baudrate=baudrate, rtscts=rtscts)
    return SerialTransport(port, url, is_simulated=parts.scheme == "pty")


def _open_emulated(
    url: str, world: "World | None", *, baudrate: int, rtscts: bool
) -> SerialTransport:
    """Start the emulator that `url` names, and open its end of the line."""
    parts = urlsplit(url)
    if parts.netloc not in EMULATORS:
        raise ValueError(
            f"Invalid device '{url}'. Must be one of {sorted(EMULATORS)} after sim://."
        )
    emulated = importlib.import_module(EMULATORS[parts.netloc]).start(_options(url), world)
    try:
        port = _open_port(emulated.path, baudrate=baudrate, rtscts=rtscts)
    except TransportError:
        emulated.close()
        raise
    return SerialTransport(port, url, is_simulated=True, after=emulated.close)


def _options(url: str) -> dict[str, str]:
    """Options of an emulator, by their names: its path is its name."""
    parts = urlsplit(url)
    pairs = parse_qsl(parts.query, keep_blank_values=True)
    pairs += [("name", parts.path.removeprefix("/"))] if parts.path else []
    options = dict(pairs)
    if "" in options.values() or len(options) < len(pairs) or parts.fragment:
        raise ValueError(f"Invalid device '{url}'. Must have each option once, as option=value.")
    return options


def _open_port(path: str, *, baudrate: int, rtscts: bool) -> serial.Serial:
    """Open a port for this program alone."""
    try:
        return serial.Serial(
            path, baudrate, rtscts=rtscts, exclusive=True, write_timeout=WRITE_TIMEOUT
        )
    except OSError as error:
        raise TransportError(
            f"Could not open '{path}': {error}. It must exist, be yours to use, and in no "
            "other program's use."
        ) from error
