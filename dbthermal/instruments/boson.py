"""FLIR Boson: driver of the camera's command port, and the commands that it sends.

A busy camera answers late; without sequence numbers every later command then gets the reply of the
command before (openmv/openmv, pull request 3265). Here each request has a new number, and frames
without it are discarded. Connecting sends and resets nothing, and nothing is ever written to the
camera's flash memory. `KIND` opens camera and command port for a session.

References
----------
Identifiers, enumerations and status codes: openmv/openmv, ``drivers/boson/include`` (commit
cbbb877). Facts alone, none of the vendor's text or code.
"""

import struct
import threading
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from types import MappingProxyType
from typing import Any, Final, Generic, TypeVar

from scipy.constants import zero_Celsius

from dbthermal.instruments import _fslp, telemetry, v4l2
from dbthermal.instruments.camera import CameraKind, FfcMode, FfcStatus, GainMode, Identity
from dbthermal.instruments.transport import Closing, Transport

__all__ = ["KIND", "Boson", "BosonError", "BosonTimeoutError"]
__dir__ = __all__.copy

BAUDRATE: Final = 921600  # speed of the line [bit/s]; over USB probably without effect
REPLY_TIMEOUT: Final = 1.0  # longest wait for a reply [s], as in the vendor's own software
REPEATS: Final = 2  # of a reading without a reply; what changes the camera is sent once
FFC_TIMEOUT: Final = 10.0  # longest wait for a flat-field correction [s]
POLL: Final = 0.05  # time between two questions while waiting [s]
MAXIMUM_RECEIVED: Final = 65536  # most bytes to search for one reply: some lines talk without end
_READ_SIZE: Final = 4096

T = TypeVar("T")
EnumT = TypeVar("EnumT", bound=IntEnum)


class Switch(IntEnum):
    """State of a function."""

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


SERIAL_NUMBER: Final = Reading("serial number", 0x00050002, ">I", int)
PART_NUMBER: Final = Reading(
    "part number", 0x00050004, ">20s", lambda raw: raw.split(b"\0", 1)[0].decode("ascii")
)
SENSOR_SERIAL_NUMBER: Final = Reading("sensor serial number", 0x00050006, ">I", int)
SOFTWARE_REVISION: Final = Reading(
    "software revision", 0x00050022, ">III", lambda *numbers: ".".join(map(str, numbers))
)
FPA_TEMPERATURE: Final = Reading(
    "FPA temperature [K]", 0x00050030, ">h", lambda tenths: float(tenths / 10.0 + zero_Celsius)
)
FFC_IN_PROGRESS: Final = Reading("FFC in progress", 0x0005000C, ">h", Switch)
FFC_STATUS: Final = Reading("FFC status", 0x00050054, ">i", FfcStatus)
LAST_FFC_FRAME: Final = Reading("frame of the last FFC", 0x0005005D, ">I", int)

FFC_MODE: Final = Setting("FFC mode", 0x00050012, FfcMode)
GAIN_MODE: Final = Setting("gain mode", 0x00050014, GainMode)
IR16_MODE: Final = Setting("IR16 mode", 0x000E000D, Ir16Mode)
TELEMETRY: Final = Setting("telemetry", 0x00040001, Switch)
TELEMETRY_LOCATION: Final = Setting("telemetry location", 0x00040003, TelemetryLocation)

SETTINGS: Final[tuple[Setting[Any], ...]] = (
    *(FFC_MODE, GAIN_MODE, IR16_MODE, TELEMETRY, TELEMETRY_LOCATION),
)
RUN_FFC: Final = 0x00050007  # command that starts a flat-field correction

# Meaning of each status of a refusal.
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


class BosonError(RuntimeError):
    """The camera refused a command, or its reply is wrong."""


class BosonTimeoutError(BosonError, TimeoutError):
    """No reply came in time; a command that changes the camera may have been carried out."""


class Boson(Closing):
    """A camera's command port, a `camera.CameraControl`; for any number of threads.

    Each method raises `BosonTimeoutError` if no reply comes, `BosonError` if a wrong one does or
    the camera refuses, and `TransportError` if it is gone. A reading is requested again if no reply
    comes; a command that changes the camera never is.

    Examples
    --------
    >>> from dbthermal.instruments.emulated import World, devices
    >>> bench = World()
    >>> state = bench.add_camera("8-14", 93588)
    >>> with Boson(devices.EmulatedBoson(bench, "8-14")) as port:
    ...     port.fpa_temperature(), port.identity()["is_simulated"]  # K
    (308.15, True)
    """

    def __init__(self, transport: Transport, *, first_sequence: int | None = None) -> None:
        # From the time of day, so that a reply to a program that ended is not taken for a new one.
        moment = int(1e6 * transport.clock.utc().timestamp())
        first = moment if first_sequence is None else first_sequence
        self.is_simulated = transport.is_simulated
        self._transport, self._clock = transport, transport.clock
        self._decoder = _fslp.Decoder()
        self._sequence = (first - 1) % (1 << 32)
        self._lock = threading.Lock()

    def close(self) -> None:
        """Release the port, once an exchange of another thread is over; the camera goes on."""
        with self._clock.hold(self._lock):
            self._transport.close()

    def read(self, reading: Reading[T], *, repeats: int = REPEATS) -> T:
        """Value of a `Reading`, in the unit that its name says."""
        data = self._exchange(reading.name, reading.command, repeats=repeats)
        # Data of the size and with the meaning of this reading.
        size, name = struct.calcsize(reading.layout), reading.name
        if len(data) != size:
            message = f"Invalid reply of {len(data)} bytes to '{name}'. Must have {size}."
            raise BosonError(message)
        try:
            return reading.convert(*struct.unpack(reading.layout, data))
        except ValueError as error:
            raise BosonError(f"Invalid reply to '{name}': {error}") from error

    def get(self, setting: Setting[EnumT]) -> EnumT:
        """State of a setting."""
        return self.read(setting.reading)

    def set(self, setting: Setting[EnumT], value: EnumT) -> None:
        """Set one of `SETTINGS` until power-off; a wrong value is a ValueError."""
        if value not in {*setting.kind}:
            choices = ", ".join(f"{member.value} ({member.name})" for member in setting.kind)
            raise ValueError(f"Invalid {setting.name} {value}. Must be one of {choices}.")
        self._command(f"set {setting.name}", setting.set_command, struct.pack(">i", value))

    def serial_number(self) -> int:
        """Serial number of the camera."""
        return self.read(SERIAL_NUMBER)

    def identity(self) -> Identity:
        """Numbers, versions and modes of the camera, and ``is_simulated``."""
        return {
            "serial_number": str(self.serial_number()),
            "sensor_serial_number": str(self.read(SENSOR_SERIAL_NUMBER)),
            "part_number": self.read(PART_NUMBER),
            "software_revision": self.read(SOFTWARE_REVISION),
            "gain_mode": self.get(GAIN_MODE).name.lower(),
            "ffc_mode": self.get(FFC_MODE).name.lower(),
            "is_simulated": self.is_simulated,
        }

    def fpa_temperature(self) -> float:
        """Temperature of the focal-plane array [K], in steps of 0.1 K."""
        return self.read(FPA_TEMPERATURE)

    def ffc_status(self) -> FfcStatus:
        """State of the flat-field correction."""
        return self.read(FFC_STATUS)

    def prepare(self, telemetry_rows: int) -> None:
        """Set 16-bit counts, FFC on command only, and telemetry below the image; read all back."""
        settings: dict[Setting[Any], IntEnum] = {
            IR16_MODE: Ir16Mode.COUNTS_16,
            FFC_MODE: FfcMode.MANUAL,
            TELEMETRY: Switch(bool(telemetry_rows)),
            **({TELEMETRY_LOCATION: TelemetryLocation.BOTTOM} if telemetry_rows else {}),
        }
        for setting, value in settings.items():
            self.set(setting, value)
            state = self.get(setting)
            if state != value:
                label = f"Invalid {setting.name} {state!r} of camera {self.serial_number()}"
                raise ValueError(f"{label}, set to {value!r}. Must be as it was set.")

    def run_ffc(self, *, timeout: float = FFC_TIMEOUT) -> int:
        """Run a flat-field correction, wait until it is complete, return its frame number.

        At its start the status is still "complete", of the correction before: it must change, or
        the frame number of the last correction must. While the shutter is closed the camera may
        not answer; `BosonTimeoutError` after `timeout` [s].
        """
        before = self.read(LAST_FFC_FRAME)
        changed = self.ffc_status() != FfcStatus.COMPLETE
        self._command("run FFC", RUN_FFC)
        deadline = self._clock() + timeout
        while True:
            try:
                busy = bool(self.read(FFC_IN_PROGRESS, repeats=0))
                if busy or self.read(FFC_STATUS, repeats=0) != FfcStatus.COMPLETE:
                    changed = True
                elif (last := self.read(LAST_FFC_FRAME, repeats=0)) != before or changed:
                    return last
            except BosonTimeoutError:
                pass  # no reply while the shutter is closed: requested again until the time limit
            if self._clock() >= deadline:
                raise BosonTimeoutError(f"No flat-field correction within {timeout:g} s.")
            self._clock.sleep(POLL)

    def _command(self, name: str, command: int, data: bytes = b"") -> None:
        """Send a command that changes the camera, once; its reply must be empty."""
        if reply := self._exchange(name, command, data):
            size = len(reply)
            raise BosonError(f"Invalid reply of {size} bytes to '{name}'. Must be empty.")

    def _exchange(self, name: str, command: int, data: bytes = b"", *, repeats: int = 0) -> bytes:
        """Send a request, again under a new number if no reply comes; return the reply's data."""
        for _ in range(repeats + 1):
            with self._clock.hold(self._lock):
                self._sequence = _fslp.next_sequence(self._sequence)
                number, status = self._sequence, _fslp.REQUEST
                request = _fslp.Frame(_fslp.COMMAND_CHANNEL, number, command, status, data)
                self._transport.write(_fslp.encode(request))
                if reply := self._reply(name):
                    break
        else:
            rule = "Must be a Boson's command port, and the camera through with booting"
            raise BosonTimeoutError(f"No reply to '{name}' within {REPLY_TIMEOUT:g} s. {rule}.")
        # What the reply says.
        if reply.command != command:
            label = f"Invalid reply to '{name}', of command 0x{reply.command:08X}"
            raise BosonError(f"{label}. Must be of command 0x{command:08X}.")
        if reply.status:
            meaning = STATUSES.get(reply.status, "unknown status")
            label = f"Refused '{name}' by the camera: status 0x{reply.status:X}, {meaning}"
            raise BosonError(f"{label}. Must be 0, OK.")
        return reply.data

    def _reply(self, name: str) -> _fslp.Frame | None:
        """Reply to the last request, None if it does not come in time; other frames are ignored."""
        key = (_fslp.COMMAND_CHANNEL, self._sequence)
        deadline, received = self._clock() + REPLY_TIMEOUT, 0
        while (remaining := deadline - self._clock()) > 0:
            if not (piece := self._transport.read(_READ_SIZE, remaining)):
                break
            received += len(piece)
            if received > MAXIMUM_RECEIVED:
                rule = "Must be a Boson's command port that no other program uses"
                raise BosonError(f"No reply to '{name}' within {MAXIMUM_RECEIVED} bytes. {rule}.")
            for frame in self._decoder.feed(piece):
                if (frame.channel, frame.sequence) == key and frame.status != _fslp.REQUEST:
                    return frame
        return None


# Of a session's ``kind: boson``.
KIND: Final = CameraKind(
    partial(v4l2.open_url, decode=telemetry.metadata), Boson, BAUDRATE, (0, telemetry.ROWS)
)
