"""The vendor's library of the TC-08, ``libusbtc08``, as ctypes needs it: nothing is loaded here.

The TC-08's USB protocol is not public, so that this library is the only way to its readings. It is
Pico Technology's own, it is not part of this project, and it is loaded when a program asks for it.
Names, types, limits and error numbers are those of the header ``usbtc08.h`` that the vendor
publishes; four functions return 32 bits, where the vendor's own Python wrapper (picosdk 1.1)
declares 16.

`dbthermal.instruments.tc08.unit` makes a thermometer of it. Both were tested against an emulated
library object and against a stub compiled from the public signatures, not against hardware.
"""

import ctypes
import ctypes.util
import os
from collections.abc import Mapping
from ctypes import POINTER, c_char, c_float, c_int8, c_int16, c_int32
from types import MappingProxyType
from typing import Any, Final

Library = Any
"""A library bound by `load`, or an object with the same functions, such as the emulated one.

Where C takes a pointer to one value, an array of one is passed, which both kinds take.
"""

ENVIRONMENT: Final = "DBTHERMAL_USBTC08"
"""Environment variable with the path of the library."""

SAMPLES: Final = 600
"""Most samples of a channel that the library keeps and returns."""

CHANNELS: Final = 9
"""Channels of a unit: 0 is the cold junction, 1 to 8 are the sockets."""

KELVIN: Final = 2
"""Number of the unit of temperature; 0 °C, 1 °F, 3 °R."""

ERRORS: Final[Mapping[int, str]] = MappingProxyType(
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
        12: "the USB pipes of the unit could not be had",
        13: "no calibration date was found",
        14: "the installed kernel driver (picopp) is too old",
        15: "a function of Pico's driver failed",
        16: "the communication with the unit is lost",
    }
)
"""Meaning of the library's error numbers; 15 and 16 are often taken for one another."""


class TC08Error(RuntimeError):
    """
    A function of the library failed.

    Parameters
    ----------
    what : str
        What was to be done.
    code : int
        The library's error number.

    Attributes
    ----------
    code : int
        The same; its meaning is in `ERRORS`.
    """

    def __init__(self, what: str, code: int) -> None:
        meaning = ERRORS.get(code, "a number that its header does not have")
        super().__init__(f"The TC-08 could not {what}: error {code}, {meaning}.")
        self.code = code


class UnitInfo(ctypes.Structure):
    """
    Identity of a unit as the library writes it: 40 bytes, packed or not.

    Attributes
    ----------
    size : int
        Size of the structure [byte], to be set by the caller.
    driver, serial, calibration_date : bytes
        Texts.
    kernel_driver, hardware, variant : int
        Versions.
    """

    _fields_ = (
        ("size", c_int16),
        ("driver", c_char * 12),
        ("kernel_driver", c_int16),
        ("hardware", c_int16),
        ("variant", c_int16),
        ("serial", c_char * 11),
        ("calibration_date", c_char * 9),
    )


_SHORT, _LONG, _FLOAT = POINTER(c_int16), POINTER(c_int32), POINTER(c_float)
_STREAM = [c_int16, _FLOAT, _LONG, c_int32, _SHORT, c_int16, c_int16, c_int16]

SIGNATURES: Final[Mapping[str, tuple[Any, list[Any]]]] = MappingProxyType(
    {
        "usb_tc08_open_unit_async": (c_int16, []),
        "usb_tc08_open_unit_progress": (c_int16, [_SHORT, _SHORT]),
        "usb_tc08_set_mains": (c_int16, [c_int16, c_int16]),
        "usb_tc08_set_channel": (c_int16, [c_int16, c_int16, c_int8]),
        "usb_tc08_get_minimum_interval_ms": (c_int32, [c_int16]),
        "usb_tc08_get_single": (c_int16, [c_int16, _FLOAT, _SHORT, c_int16]),
        "usb_tc08_run": (c_int32, [c_int16, c_int32]),
        "usb_tc08_stop": (c_int16, [c_int16]),
        "usb_tc08_get_temp": (c_int32, _STREAM),
        "usb_tc08_get_temp_deskew": (c_int32, _STREAM),
        "usb_tc08_get_unit_info": (c_int16, [c_int16, POINTER(UnitInfo)]),
        "usb_tc08_get_last_error": (c_int16, [c_int16]),
        "usb_tc08_close_unit": (c_int16, [c_int16]),
    }
)
"""Result type and argument types of every function that is used."""


def load(path: str | None = None, environment: Mapping[str, str] = os.environ) -> Library:
    """
    Load the vendor's library and declare the types of its functions.

    Parameters
    ----------
    path : str, optional
        File of the library. Without it, the variable `ENVIRONMENT` names the file, and without
        that, the system's own search must find ``usbtc08``.
    environment : mapping
        Where the variable is looked up.

    Returns
    -------
    Library
        With the functions of `SIGNATURES`.

    Raises
    ------
    FileNotFoundError
        If no library is named and none is found.
    OSError
        If the file cannot be loaded, or lacks a function.
    """
    name = path or environment.get(ENVIRONMENT) or ctypes.util.find_library("usbtc08")
    if name is None:
        raise FileNotFoundError(
            "No library 'usbtc08'. Must be installed (libusbtc08 of Pico Technology, often in "
            f"/opt/picoscope/lib), or named by its path or by the variable {ENVIRONMENT}."
        )
    library = ctypes.CDLL(name)
    for function, (result, arguments) in SIGNATURES.items():
        if not hasattr(library, function):
            raise OSError(f"Invalid library '{name}' without {function}. Must be libusbtc08.")
        getattr(library, function).restype = result
        getattr(library, function).argtypes = arguments
    return library
