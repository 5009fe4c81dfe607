"""What can be asked of a FLIR Boson: identifiers, layouts, ranges and the meaning of its answers.

A `Reading` is asked for, a `Setting` is read and set, an `Action` is done; `Boson` takes any of
them. Only the facts that driver and emulator need are here, none of the vendor's text or code.

References
----------
Identifiers, enumerations and status codes: openmv/openmv, ``drivers/boson/include`` (commit
cbbb877). What is marked uncertain comes from secondary sources: LJMUAstroecology/flirpy 0.6.2 and
belivan/flir_stereo.
"""

import operator
import struct
from collections.abc import Callable, Container
from dataclasses import dataclass
from enum import IntEnum
from types import MappingProxyType
from typing import Any, Final, Generic, TypeVar

from scipy.constants import zero_Celsius

from dbthermal.instruments.camera import FfcMode, FfcStatus, GainMode
from dbthermal.instruments.fslp import REQUEST

T = TypeVar("T")
IntT = TypeVar("IntT", bound=int)


class Switch(IntEnum):
    """Whether something is done."""

    OFF = 0
    ON = 1


class SyncMode(IntEnum):
    """Whether the camera gives the pulses that start frames, or takes them."""

    DISABLED = 0
    MASTER = 1
    SLAVE = 2


class Ir16Mode(IntEnum):
    """What the 16-bit USB video carries: counts, counts of 14 bits, or scaled temperature."""

    COUNTS_16 = 0
    COUNTS_14 = 1
    TLINEAR = 2


class TelemetryLocation(IntEnum):
    """Whether the telemetry rows come before the image or after it."""

    TOP = 0
    BOTTOM = 1


class TelemetryPacking(IntEnum):
    """How a word of telemetry is laid out."""

    WORDS_16 = 0
    Y = 1
    BYTES = 2


class TelemetryOrder(IntEnum):
    """Order of the bytes in a word of telemetry."""

    DEFAULT = 0
    SWAPPED = 1


@dataclass(frozen=True)
class Reading(Generic[T]):
    """
    Something to ask for.

    Attributes
    ----------
    name : str
        Name for messages.
    command : int
        Identifier.
    layout : str
        Data of the reply, as in `struct`, big-endian.
    convert : callable
        Gives the value, from what `struct` gives; raises ValueError if it is none.
    """

    name: str
    command: int
    layout: str
    convert: Callable[..., T]

    def value(self, data: bytes) -> T:
        """
        Value that a reply holds.

        Parameters
        ----------
        data : bytes
            Of the reply.

        Returns
        -------
        T
            The value.

        Raises
        ------
        ValueError
            If the data have the wrong size or mean nothing.
        """
        size = struct.calcsize(self.layout)
        if len(data) != size:
            raise ValueError(f"Invalid {self.name} of {len(data)} bytes. Must have {size}.")
        return self.convert(*struct.unpack(self.layout, data))


@dataclass(frozen=True)
class Setting(Generic[IntT]):
    """
    Something to read and to set.

    Attributes
    ----------
    name : str
        Name, and unit in brackets, for messages.
    set_command, command : int
        Identifiers: to set, and to read.
    layout : str
        Data of both, as in `struct`, big-endian: one number.
    kind : type
        An enumeration, or int.
    allowed : container of int
        The values that may be set.
    """

    name: str
    set_command: int
    command: int
    layout: str
    kind: type[IntT]
    allowed: Container[int]

    @property
    def reading(self) -> Reading[IntT]:
        """How it is read."""
        return Reading(self.name, self.command, self.layout, self.kind)

    def data(self, value: int) -> bytes:
        """
        Data of the command that sets it.

        Parameters
        ----------
        value : int
            One of `allowed`.

        Returns
        -------
        bytes
            To send.

        Raises
        ------
        TypeError, ValueError
            If the value is no whole number, or not allowed.
        """
        if operator.index(value) not in self.allowed:
            raise ValueError(f"Invalid {self.name} {value}. Must be one of {self._choices()}.")
        return struct.pack(self.layout, value)

    def _choices(self) -> str:
        if issubclass(self.kind, IntEnum):
            return ", ".join(f"{member.value} ({member.name})" for member in self.kind)
        return str(self.allowed)


@dataclass(frozen=True)
class Action:
    """Something to do: its name for messages, and its identifier."""

    name: str
    command: int


def _text(raw: bytes) -> str:
    """Text up to its padding of zeros."""
    return raw.split(b"\0", 1)[0].decode("ascii")


def _tenths(raw: int) -> float:
    return raw / 10.0


def _tenths_celsius(raw: int) -> float:
    return float(raw / 10.0 + zero_Celsius)


def _revision(major: int, minor: int, patch: int) -> tuple[int, int, int]:
    return major, minor, patch


def _enumeration(name: str, set_command: int, kind: type[IntT]) -> Setting[IntT]:
    """A setting of an enumeration: read by the next identifier, sent in 32 bits."""
    values: Any = kind  # a type of enumeration is iterable, which `type[int]` does not say
    return Setting(name, set_command, set_command + 1, ">i", kind, frozenset(map(int, values)))


SERIAL_NUMBER: Final = Reading("serial number", 0x00050002, ">I", int)
PART_NUMBER: Final = Reading("part number", 0x00050004, ">20s", _text)
SENSOR_SERIAL_NUMBER: Final = Reading("sensor serial number", 0x00050006, ">I", int)
SENSOR_PART_NUMBER: Final = Reading("sensor part number", 0x0005003F, ">32s", _text)
SOFTWARE_REVISION: Final = Reading("software revision", 0x00050022, ">III", _revision)
FPA_TEMPERATURE: Final = Reading("FPA temperature [K]", 0x00050030, ">h", _tenths_celsius)
FPA_TEMPERATURE_KELVIN: Final = Reading("FPA temperature [K]", 0x00050031, ">H", _tenths)
FPA_COUNTS: Final = Reading("FPA temperature [count]", 0x00020001, ">H", int)
FFC_IN_PROGRESS: Final = Reading("FFC in progress", 0x0005000C, ">h", Switch)
FFC_STATUS: Final = Reading("FFC status", 0x00050054, ">i", FfcStatus)
FFC_DESIRED: Final = Reading("FFC desired", 0x00050055, ">I", int)
LAST_FFC_FRAME: Final = Reading("frame of the last FFC", 0x0005005D, ">I", int)
LAST_FFC_TEMPERATURE: Final = Reading(
    "FPA temperature of the last FFC [K]", 0x0005005E, ">H", _tenths
)
TABLE_SWITCH_DESIRED: Final = Reading("desired NUC table", 0x0005005F, ">H", int)
RADIOMETRY_CAPABLE: Final = Reading("radiometry capable", 0x0042007D, ">i", Switch)
FRAME_COUNT: Final = Reading("frame count of the sensor", 0x00020002, ">I", int)
ISP_FRAME_COUNT: Final = Reading("frame count of the processor", 0x000500AC, ">I", int)
FRAME_RATE: Final = Reading("frame rate [Hz]", 0x000E0007, ">I", int)
UPTIME: Final = Reading("time since power-up [s]", 0x000E0008, ">I", int)

READINGS: Final = tuple(value for value in list(globals().values()) if isinstance(value, Reading))
"""All readings."""

FFC_MODE: Final = _enumeration("FFC mode", 0x00050012, FfcMode)
APPLY_FFC: Final = _enumeration("FFC applied", 0x00000003, Switch)
GAIN_MODE: Final = _enumeration("gain mode", 0x00050014, GainMode)
AVERAGER: Final = _enumeration("averager", 0x0000000B, Switch)
SYNC_MODE: Final = _enumeration("external sync mode", 0x00050098, SyncMode)
TELEMETRY: Final = _enumeration("telemetry", 0x00040001, Switch)
TELEMETRY_LOCATION: Final = _enumeration("telemetry location", 0x00040003, TelemetryLocation)
TELEMETRY_PACKING: Final = _enumeration("telemetry packing", 0x00040005, TelemetryPacking)
TELEMETRY_ORDER: Final = _enumeration("telemetry order", 0x00040007, TelemetryOrder)
IR16_MODE: Final = _enumeration("IR16 mode", 0x000E000D, Ir16Mode)
TLINEAR: Final = _enumeration("TLinear", 0x003E0001, Switch)
TEMPERATURE_STABLE: Final = _enumeration("temperature stable", 0x00420000, Switch)
FFC_FRAMES: Final = Setting(
    "number of FFC frames", 0x0000000D, 0x0000000E, ">H", int, (2, 4, 8, 16)
)
FFC_TEMPERATURE_STEP: Final = Setting(  # its scale is uncertain: flirpy's
    "FFC temperature threshold [0.1 K]", 0x00050008, 0x00050009, ">H", int, range(1 << 16)
)
FFC_FRAME_STEP: Final = Setting(
    "FFC frame threshold", 0x0005000A, 0x0005000B, ">I", int, range(1 << 32)
)

SETTINGS: Final[tuple[Setting[Any], ...]] = tuple(
    value for value in list(globals().values()) if isinstance(value, Setting)
)
"""All settings."""

RUN_FFC: Final = Action("run FFC", 0x00050007)
REBOOT: Final = Action("reboot", 0x00050010)
SAVE_DEFAULTS: Final = Action("save power-on defaults to flash", 0x00050018)

STATUSES: Final = MappingProxyType(
    {
        0x000: "OK",
        0x161: "bad command identifier",
        0x162: "bad status of the request",
        0x17D: "too few bytes of data",
        0x17E: "too many bytes of data",
        0x17F: "buffer overflow",
        0x180: "the camera's function failed",
        0x181: "invalid input of the camera's function",
        0x1B0: "feature not enabled",
        0x201: "error",
        0x202: "not ready",
        0x203: "value out of range",
        0x204: "bad checksum",
        0x205: "bad pointer",
        0x206: "wrong size of the data",
        0x207: "undefined function",
        0x208: "illegal address",
        0x20B: "deprecated function",
        0x26D: "communication timeout",
        0x26E: "communication read error",
        0x26F: "communication count error",
        0x281: "configuration error",
        0x283: "camera busy",
    }
)
"""Meaning of each status of a reply."""

_FLASH = range(0x6A4, 0x6AE)


def meaning(status: int) -> str:
    """
    Meaning of a status.

    Parameters
    ----------
    status : int
        Of a reply.

    Returns
    -------
    str
        A few words; "unknown status" if it is in no public list.
    """
    if status == REQUEST:
        return "a request, not a reply"
    return "flash error" if status in _FLASH else STATUSES.get(status, "unknown status")
