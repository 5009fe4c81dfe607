"""Pico TC-08 thermocouple logger: single readings of eight thermocouples and their cold junction.

The TC-08's USB protocol is not public. Its readings come through the vendor's own library
``libusbtc08``, which is not part of this project and is loaded only when a unit is opened. Names,
types and error numbers are those of the header ``usbtc08.h`` that the vendor publishes.

A reading without a temperature is NaN. Not every open thermocouple can be
detected: one may also read a noisy room temperature (picotech.com, topic 29871). Move the
blackbody, and see whether the reading follows.
"""

import ctypes
import ctypes.util
import os
import threading
from collections.abc import Mapping
from ctypes import POINTER, c_char, c_float, c_int8, c_int16
from types import MappingProxyType
from typing import Any, Final, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from dbthermal.instruments.camera import Identity
from dbthermal.instruments.transport import SYSTEM, Clock, Closing

__all__ = ["ERRORS", "TC08", "ReadingError", "Scan", "TC08Error", "load"]
__dir__ = __all__.copy

# A library bound by `load`, or an object with the same functions, such as the emulated one. Where C
# takes a pointer to one value, an array of length one is passed, which suits either.
Library = Any

ENVIRONMENT: Final = "DBTHERMAL_USBTC08"  # variable with the path of the library
CHANNELS: Final = 9  # 0 is the cold junction, 1 to 8 are the sockets
KIND: Final = "T"  # the library's letter of the rig's thermocouples
KELVIN: Final = 2  # the library's number of the unit; 0 is °C, 1 °F, 3 °R
OPEN_TIMEOUT: Final = 30.0  # [s] the library downloads the firmware first
POLL: Final = 0.05  # [s] between two progress requests
SCAN_AGE: Final = 1.0  # longest time for which a scan gives the readings of its channels [s]

# Meaning of the library's error numbers; 15 and 16 are often taken for one another.
ERRORS: Final = MappingProxyType(
    {
        0: "no error",
        1: "the operating system is not supported",
        2: "no channels are set",
        3: "an argument is invalid",
        4: "the hardware version is not supported; a newer library may know it",
        5: "incorrect mode: a single reading while streaming, or old and new functions mixed",
        6: "the units are still being enumerated",
        7: "the unit does not respond",
        8: "its firmware could not be downloaded",
        9: "its EEPROM is missing or corrupt",
        10: "the enumerated unit is not found: it was pulled out, or another program has it",
        11: "a threading function failed",
        12: "the USB pipes of the unit could not be opened",
        13: "no calibration date was found",
        14: "the installed kernel driver (picopp) is too old",
        15: "a function of Pico's driver failed",
        16: "the communication with the unit is lost",
    }
)


class TC08Error(RuntimeError):
    """A function of the library failed: `code` is its error number, explained in `ERRORS`."""

    def __init__(self, action: str, code: int) -> None:
        meaning = ERRORS.get(code, "a number that its header does not list")
        super().__init__(f"The TC-08 could not {action}: error {code}, {meaning}.")
        self.code = code


class ReadingError(RuntimeError):
    """A thermocouple gave no temperature; a recording notes it and goes on."""


class UnitInfo(ctypes.Structure):
    """Identity of a unit as the library writes it: 40 bytes, whose number the caller sets."""

    _fields_ = (
        ("size", c_int16),
        ("driver", c_char * 12),
        ("kernel_driver", c_int16),
        ("hardware", c_int16),
        ("variant", c_int16),
        ("serial", c_char * 11),
        ("calibration_date", c_char * 9),
    )


# Argument types of the functions that are used; each of them returns 16 bits.
SIGNATURES: Final = MappingProxyType(
    {
        "usb_tc08_open_unit_async": [],
        "usb_tc08_open_unit_progress": [POINTER(c_int16), POINTER(c_int16)],
        "usb_tc08_set_channel": [c_int16, c_int16, c_int8],
        "usb_tc08_get_single": [c_int16, POINTER(c_float), POINTER(c_int16), c_int16],
        "usb_tc08_get_unit_info": [c_int16, POINTER(UnitInfo)],
        "usb_tc08_get_last_error": [c_int16],
        "usb_tc08_close_unit": [c_int16],
    }
)


class Scan(NamedTuple):
    """A reading of all nine channels, of which index 0 is the cold junction."""

    time: float  # middle of the conversion of one channel after another, on the host's clock [s]
    temperature: npt.NDArray[np.float64]  # (9,) [K]; NaN if open, off, beyond range, not above 0 K
    overflow: npt.NDArray[np.bool_]  # (9,) True where the voltage was beyond the converter's range


class TC08(Closing):
    """A TC-08, once it is opened; several threads may `read`.

    The `library` is from `load`, or an emulated one.

    Examples
    --------
    >>> from dbthermal.instruments.emulated import World, devices
    >>> bench = World(blackbody_temperature=310.0)
    >>> bench.thermocouples[1] = "blackbody"
    >>> with TC08(devices.EmulatedTC08(bench)).open() as logger:
    ...     logger.set_channels({1: "blackbody"})
    ...     print(f"{logger.read(1):.2f} K")
    310.00 K
    """

    def __init__(self, library: Library) -> None:
        self._library = library
        # The vendor's library has neither of these attributes.
        self.is_simulated = bool(getattr(library, "is_simulated", False))
        self.clock: Clock = getattr(library, "clock", SYSTEM)
        self.channels: Mapping[int, str] = {}  # place of the tip by channel
        self._handle = 0
        self._lock = threading.Lock()
        self._scan: Scan | None = None
        self._used: set[int] = set()  # channels whose value in the scan was given

    def open(self, *, timeout: float = OPEN_TIMEOUT) -> Self:
        """Open the first free unit in `timeout` [s]; TimeoutError, OSError or RuntimeError."""
        if self._handle:
            raise RuntimeError("The TC-08 is open already. Must be closed first.")
        if not self._library.usb_tc08_open_unit_async():
            raise self._error("be opened")
        # Wait until its firmware is there.
        handle, percent = (c_int16 * 1)(), (c_int16 * 1)()
        deadline = self.clock() + timeout
        while not (progress := self._library.usb_tc08_open_unit_progress(handle, percent)):
            if self.clock() >= deadline:
                state = f"The TC-08 is not open after {timeout} s, at {percent[0]} %"
                rule = "Must have its firmware by then: pull it out and plug it in again"
                raise TimeoutError(f"{state}. {rule}.")
            self.clock.sleep(POLL)
        # What became of it.
        if progress < 0:
            raise self._error("be opened")
        if not handle[0]:
            rule = "Must be plugged in, and free: no other program may have it"
            raise ConnectionError(f"No TC-08. {rule}.")
        self._handle = int(handle[0])
        return self

    def close(self) -> None:
        """Close the unit, once; TC08Error if the library could not, as after unplugging."""
        if self._handle:
            try:
                self._call("close_unit", "close")
            finally:
                self._handle, self.channels = 0, {}

    def identity(self) -> Identity:
        """Identity of the unit; TC08Error or RuntimeError if the library fails or it is closed."""
        unit = (UnitInfo * 1)()
        unit[0].size = ctypes.sizeof(UnitInfo)
        self._call("get_unit_info", "read its identity", unit)
        texts = (unit[0].serial, unit[0].calibration_date, unit[0].driver)
        serial, date, driver = (text.decode("ascii", "backslashreplace") for text in texts)
        return {
            "serial_number": serial,
            "calibration_date": date,  # in the vendor's format
            "driver": driver,
            "hardware": str(unit[0].hardware),
            "variant": str(unit[0].variant),
            "is_simulated": self.is_simulated,
        }

    def set_channels(self, channels: Mapping[int, str]) -> None:
        """Set the channels, 1 to 8, that have a thermocouple of type T, and the places of the tips.

        ValueError for another channel, or none; TC08Error or RuntimeError if the library fails.
        """
        if not channels:
            raise ValueError("Invalid channels. Must be one at least.")
        for channel in channels:
            if channel not in range(1, CHANNELS):
                raise ValueError(f"Invalid channel {channel}. Must lie in 1 to {CHANNELS - 1}.")
        self.channels, self._scan = {}, None  # until all are set; an older scan is not of these
        # The cold junction, and a type or off for each socket.
        for channel in range(CHANNELS):
            letter = (KIND if channel in channels else " ") if channel else "C"
            action = f"set channel {channel} to '{letter}'"
            self._call("set_channel", action, channel, ord(letter))
        self.channels = dict(channels)

    def read(self, channel: int) -> float:
        """Temperature of a channel [K]; `ReadingError` if open or overflowed, else as `single`."""
        # A scan serves all channels: it is used while it is new, and once by each.
        with self.clock.hold(self._lock):
            scan = self._scan
            if scan is None or channel in self._used or self.clock() - scan.time > SCAN_AGE:
                self._scan = scan = self.single()
                self._used.clear()
            self._used.add(channel)
        if np.isnan(temperature := float(scan.temperature[channel])):
            reason = "overflow" if scan.overflow[channel] else "open"
            label = f"thermocouple '{self.channels[channel]}' in channel {channel}: {reason}"
            rule = "Must be connected, and within its range"
            raise ReadingError(f"No temperature of {label}. {rule}.")
        return temperature

    def single(self) -> Scan:
        """Read all channels once; TC08Error or RuntimeError if the library fails, or is closed."""
        if self._handle and not self.channels:
            raise RuntimeError("The TC-08 has no channels yet. Must be set by set_channels first.")
        values, overflow = (c_float * CHANNELS)(), (c_int16 * 1)()
        # It takes 0.2 s for one thermocouple, 0.9 s for eight.
        start = self.clock()
        self._call("get_single", "take a single reading", values, overflow, KELVIN)
        middle = 0.5 * (start + self.clock())
        # The library's nine values, where they are temperatures.
        kelvin = np.array(values, dtype=np.float64)
        beyond = (overflow[0] >> np.arange(CHANNELS)) & 1 > 0
        valid = np.isfinite(kelvin) & (kelvin > 0.0) & ~beyond
        return Scan(middle, np.where(valid, kelvin, np.nan), beyond)

    def _call(self, function: str, action: str, *arguments: Any) -> None:
        """Call a function of the library on the open unit; it returns 0 if it fails."""
        if not self._handle:
            raise RuntimeError("The TC-08 is closed. Must be opened first.")
        if not getattr(self._library, f"usb_tc08_{function}")(self._handle, *arguments):
            raise self._error(action)

    def _error(self, action: str) -> TC08Error:
        return TC08Error(action, self._library.usb_tc08_get_last_error(self._handle))


def load() -> Library:
    """Load the vendor's library and declare its types; OSError if it is missing, or another."""
    # The variable, or the system's search, names the file.
    name = os.environ.get(ENVIRONMENT) or ctypes.util.find_library("usbtc08")
    if name is None:
        raise FileNotFoundError(
            "No library 'usbtc08'. Must be installed (libusbtc08 of Pico Technology, often in "
            f"/opt/picoscope/lib), or named by the variable {ENVIRONMENT}."
        )
    library = ctypes.CDLL(name)
    for function, arguments in SIGNATURES.items():
        if not hasattr(library, function):
            raise OSError(f"Invalid library '{name}' without {function}. Must be libusbtc08.")
        getattr(library, function).restype = c_int16
        getattr(library, function).argtypes = arguments
    return library
