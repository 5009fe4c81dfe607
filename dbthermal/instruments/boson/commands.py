"""Commands of a FLIR Boson that the driver sends: identifiers, layouts and meanings of the answers.

References
----------
Identifiers, enumerations and status codes: openmv/openmv, ``drivers/boson/include`` (commit
cbbb877). Facts alone, none of the vendor's text or code.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from types import MappingProxyType
from typing import Any, Final, Generic, TypeVar

from scipy.constants import zero_Celsius

from dbthermal.instruments.camera import FfcMode, FfcStatus, GainMode

__all__ = [
    "FFC_IN_PROGRESS",
    "FFC_MODE",
    "FFC_STATUS",
    "FPA_TEMPERATURE",
    "GAIN_MODE",
    "IR16_MODE",
    "LAST_FFC_FRAME",
    "PART_NUMBER",
    "RUN_FFC",
    "SENSOR_SERIAL_NUMBER",
    "SERIAL_NUMBER",
    "SETTINGS",
    "SOFTWARE_REVISION",
    "STATUSES",
    "TELEMETRY",
    "TELEMETRY_LOCATION",
    "Ir16Mode",
    "Reading",
    "Setting",
    "Switch",
    "TelemetryLocation",
]
__dir__ = __all__.copy

T = TypeVar("T")
EnumT = TypeVar("EnumT", bound=IntEnum)


class Switch(IntEnum):
    """State of a function that is either off or on."""

    OFF = 0
    ON = 1


class Ir16Mode(IntEnum):
    """Content of the 16-bit USB video: counts, counts of 14 bits, or scaled temperature."""

    COUNTS_16 = 0
    COUNTS_14 = 1
    TLINEAR = 2


class TelemetryLocation(IntEnum):
    """Place of the telemetry rows: before the image or after it."""

    TOP = 0
    BOTTOM = 1


@dataclass(frozen=True)
class Reading(Generic[T]):
    """A value that is read from the camera."""

    name: str  # for messages
    command: int  # identifier
    layout: str  # data of the reply, as in `struct`, big-endian
    convert: Callable[..., T]  # value of the unpacked data; ValueError if they have no meaning

    def value(self, data: bytes) -> T:
        """Value of the data of a reply; ValueError if they are of another size or meaning."""
        size = struct.calcsize(self.layout)
        if len(data) != size:
            raise ValueError(f"Invalid {self.name} of {len(data)} bytes. Must have {size}.")
        return self.convert(*struct.unpack(self.layout, data))


@dataclass(frozen=True)
class Setting(Generic[EnumT]):
    """A mode that is set by one command, as a 32-bit number, and read by the next identifier."""

    name: str
    set_command: int
    kind: type[EnumT]

    @property
    def reading(self) -> Reading[EnumT]:
        """Command that reads the mode back."""
        return Reading(self.name, self.set_command + 1, ">i", self.kind)

    def data(self, value: EnumT) -> bytes:
        """Data of the command that sets it; ValueError if the value is not of its enumeration."""
        if value not in {*self.kind}:
            choices = ", ".join(f"{member.value} ({member.name})" for member in self.kind)
            raise ValueError(f"Invalid {self.name} {value}. Must be one of {choices}.")
        return struct.pack(">i", value)


def _text(raw: bytes) -> str:
    """Text up to its padding of zeros."""
    return raw.split(b"\0", 1)[0].decode("ascii")


def _kelvin(tenths: int) -> float:
    """Temperature [K] of signed tenths of a degree Celsius."""
    return float(tenths / 10.0 + zero_Celsius)


SERIAL_NUMBER: Final = Reading("serial number", 0x00050002, ">I", int)
PART_NUMBER: Final = Reading("part number", 0x00050004, ">20s", _text)
SENSOR_SERIAL_NUMBER: Final = Reading("sensor serial number", 0x00050006, ">I", int)
SOFTWARE_REVISION: Final = Reading(
    "software revision", 0x00050022, ">III", lambda *parts: ".".join(map(str, parts))
)
FPA_TEMPERATURE: Final = Reading("FPA temperature [K]", 0x00050030, ">h", _kelvin)
FFC_IN_PROGRESS: Final = Reading("FFC in progress", 0x0005000C, ">h", Switch)
FFC_STATUS: Final = Reading("FFC status", 0x00050054, ">i", FfcStatus)
LAST_FFC_FRAME: Final = Reading("frame of the last FFC", 0x0005005D, ">I", int)

FFC_MODE: Final = Setting("FFC mode", 0x00050012, FfcMode)
GAIN_MODE: Final = Setting("gain mode", 0x00050014, GainMode)
IR16_MODE: Final = Setting("IR16 mode", 0x000E000D, Ir16Mode)
TELEMETRY: Final = Setting("telemetry", 0x00040001, Switch)
TELEMETRY_LOCATION: Final = Setting("telemetry location", 0x00040003, TelemetryLocation)

SETTINGS: Final[tuple[Setting[Any], ...]] = (
    FFC_MODE,
    GAIN_MODE,
    IR16_MODE,
    TELEMETRY,
    TELEMETRY_LOCATION,
)
"""All settings."""

RUN_FFC: Final = 0x00050007
"""Command that starts a flat-field correction."""

STATUSES: Final = MappingProxyType(
    {
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
        **dict.fromkeys(range(0x6A4, 0x6AE), "flash error"),
    }
)
"""Meaning of each status of a refusal."""
