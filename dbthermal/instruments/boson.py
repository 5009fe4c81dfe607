"""FLIR Boson: driver of the camera's command port, the commands that it sends, and their bytes.

A frame of the serial line (FSLP) is the start byte 8E, then channel, sequence number, command,
status, data and checksum, big-endian and with three byte values escaped, then the end byte AE.

A busy camera answers late; without sequence numbers every later command then gets the reply of the
command before (openmv/openmv, pull request 3265). Here each request has a new number. Connecting
sends and resets nothing, and nothing is ever written to the camera's flash memory.

Facts alone, none of the vendor's text or code: openmv/openmv, ``drivers/boson`` (commit cbbb877,
identifiers, enumerations, status codes); FLIR/rawBoson, ``rawBoson.c`` (commit 0f192d6); frames in
thurberdog/ghostCommand (commit 35dc641) and in LJMUAstroecology/flirpy issue 21.
"""

import binascii
import re
import struct
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from types import MappingProxyType
from typing import Any, Final, Generic, TypeVar

from scipy.constants import zero_Celsius

from dbthermal.instruments import telemetry, v4l2
from dbthermal.instruments.camera import CameraKind, FfcStatus, Identity
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
COMMAND_CHANNEL: Final = 0x00  # of commands and replies; frames of all others are ignored
REQUEST: Final = 0xFFFFFFFF  # status of a request; that of a reply is 0 or an error code
MAXIMUM_DATA: Final = 751  # most bytes of data in a frame to send, as in FLIR/rawBoson
MAXIMUM_FRAME: Final = 2048  # most unescaped bytes received: the buffer of the vendor's receiver
_START, _END, _ESCAPE = b"\x8e", b"\xae", b"\x9e"
_SPECIAL = _START + _END + _ESCAPE
_SHIFT = 0x0D  # an escaped byte is sent as the escape byte and the value less this
_ESCAPED = re.compile(rb"\x9e[\x81\x91\xa1]")
_RAISED = bytes.maketrans(_SPECIAL, bytes(v + 1 for v in _SPECIAL))  # next that need no escape
_HEADER = struct.Struct(">BIII")
_CHECKSUM = struct.Struct(">H")

T = TypeVar("T")
EnumT = TypeVar("EnumT", bound=IntEnum)

Switch = IntEnum("Switch", "OFF ON", start=0)
"""State of a function."""

FfcMode = IntEnum("FfcMode", "MANUAL AUTO EXTERNAL SHUTTER_TEST", start=0)
"""Trigger of a flat-field correction; if it is external the shutter stays open before the scene."""

GainMode = IntEnum("GainMode", "HIGH LOW AUTO DUAL MANUAL", start=0)
"""Sensitivity; low gain has the larger range of temperatures."""

Ir16Mode = IntEnum("Ir16Mode", "COUNTS_16 COUNTS_14 TLINEAR", start=0)
"""Content of the 16-bit USB video: counts, counts of 14 bits, or scaled temperature."""

TelemetryLocation = IntEnum("TelemetryLocation", "TOP BOTTOM", start=0)
"""Place of the telemetry rows: before the image or after it."""


@dataclass(frozen=True)
class Reading(Generic[T]):
    """A value that is read from the camera."""

    name: str  # for messages
    command: int  # identifier
    convert: Callable[..., T]  # value of the unpacked data; ValueError if they have no meaning
    layout: str = ">I"  # data of the reply, as in `struct`, big-endian


@dataclass(frozen=True)
class Setting(Reading[EnumT]):
    """A mode that is read as a 32-bit number, and set by the identifier before."""

    convert: type[EnumT]
    layout: str = ">i"


SERIAL_NUMBER: Final = Reading("serial number", 0x00050002, int)
PART_NUMBER: Final = Reading(
    "part number", 0x00050004, lambda raw: raw.split(b"\0", 1)[0].decode("ascii"), ">20s"
)
SENSOR_SERIAL_NUMBER: Final = Reading("sensor serial number", 0x00050006, int)
SOFTWARE_REVISION: Final = Reading(
    "software revision", 0x00050022, lambda *numbers: ".".join(map(str, numbers)), ">III"
)
FPA_TEMPERATURE: Final = Reading(
    "FPA temperature [K]", 0x00050030, lambda tenths: float(tenths / 10.0 + zero_Celsius), ">h"
)
FFC_IN_PROGRESS: Final = Reading("FFC in progress", 0x0005000C, Switch, ">h")
FFC_STATUS: Final = Reading("FFC status", 0x00050054, FfcStatus, ">i")
LAST_FFC_FRAME: Final = Reading("frame of the last FFC", 0x0005005D, int)

FFC_MODE: Final = Setting("FFC mode", 0x00050013, FfcMode)
GAIN_MODE: Final = Setting("gain mode", 0x00050015, GainMode)
IR16_MODE: Final = Setting("IR16 mode", 0x000E000E, Ir16Mode)
TELEMETRY: Final = Setting("telemetry", 0x00040002, Switch)
TELEMETRY_LOCATION: Final = Setting("telemetry location", 0x00040004, TelemetryLocation)

_MODES = FFC_MODE, GAIN_MODE, IR16_MODE, TELEMETRY, TELEMETRY_LOCATION
SETTINGS: Final[tuple[Setting[Any], ...]] = _MODES
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


@dataclass(frozen=True)
class Packet:
    """An undamaged frame."""

    channel: int  # `COMMAND_CHANNEL`, or that of debug text and other traffic, 0 to 255
    sequence: int  # number of the request, echoed by its reply, unsigned, 32 bits
    command: int  # identifier of the function, unsigned, 32 bits
    status: int  # `REQUEST`, or of a reply 0 for success, else an error code
    data: bytes = b""  # arguments or result of the function; empty in error replies


def checksum(content: bytes) -> int:
    """CRC-16/AUG-CCITT (SPI-FUJITSU) of an unescaped frame, from channel to data."""
    return binascii.crc_hqx(content, 0x1D0F)


def encode(frame: Packet) -> bytes:
    """Bytes of a frame; ValueError or struct.error if data or a number do not fit their field."""
    if (size := len(frame.data)) > MAXIMUM_DATA:
        raise ValueError(f"Invalid data of {size} bytes. Must be at most {MAXIMUM_DATA}.")
    content = _HEADER.pack(frame.channel, frame.sequence, frame.command, frame.status) + frame.data
    content += _CHECKSUM.pack(checksum(content))
    # Header, data and checksum are all escaped.
    pieces = (_ESCAPE + bytes((v - _SHIFT,)) if v in _SPECIAL else bytes((v,)) for v in content)
    return _START + b"".join(pieces) + _END


def next_sequence(sequence: int) -> int:
    """Larger sequence number without a byte that would be escaped; 0 after the largest."""
    following = ((sequence + 1) % (1 << 32)).to_bytes(4, "big")
    return int.from_bytes(following.translate(_RAISED), "big")


class Decoder:
    """Finds the frames in a stream of bytes, however it is cut into pieces."""

    def __init__(self) -> None:
        self.damaged = 0  # dropped frames: cut, too long or short, wrong escape or checksum
        self.pending: bytes | None = None  # since the last start byte; None between frames

    def feed(self, received: bytes) -> list[Packet]:
        """Take in any number of bytes; return the undamaged frames that they complete."""
        frames = []
        for number, piece in enumerate(bytes(received).split(_START)):
            if number:  # a start byte came before it, and begins anew
                self.damaged += self.pending is not None
                self.pending = b""
            if self.pending is None:
                continue
            self.pending, end, _ = (self.pending + piece).partition(_END)
            if end or len(self.pending) > 2 * MAXIMUM_FRAME:  # each byte may be escaped
                frame, self.pending = _frame(self.pending), None
                frames += [frame] if frame else []
                self.damaged += frame is None
        return frames


def _frame(escaped: bytes) -> Packet | None:
    """Packet of the bytes between start and end; None if it is damaged."""
    content = _ESCAPED.sub(lambda pair: bytes((pair[0][1] + _SHIFT,)), escaped)
    body, sent = content[: -_CHECKSUM.size], content[-_CHECKSUM.size :]
    if _ESCAPE in _ESCAPED.sub(b"", escaped) or not _HEADER.size <= len(body) < MAXIMUM_FRAME - 1:
        return None
    if _CHECKSUM.pack(checksum(body)) != sent:
        return None
    channel, sequence, command, status = _HEADER.unpack_from(body)
    return Packet(channel, sequence, command, status, body[_HEADER.size :])


class BosonError(RuntimeError):
    """The camera refused a command, or its reply is wrong."""


class BosonTimeoutError(BosonError, TimeoutError):
    """No reply came in time; a command that changes the camera may have been carried out."""


class Boson(Closing):
    """A camera's command port, a `camera.CameraControl`; for any number of threads.

    Each method raises `BosonTimeoutError` if no reply comes, `BosonError` if a wrong one does or
    the camera refuses, and `TransportError` if it is gone.

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
        self._decoder = Decoder()
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
            raise BosonError(f"Invalid reply of {len(data)} bytes to '{name}'. Must have {size}.")
        try:
            return reading.convert(*struct.unpack(reading.layout, data))
        except ValueError as error:
            raise BosonError(f"Invalid reply to '{name}': {error}") from error

    def set(self, setting: Setting[EnumT], value: EnumT) -> None:
        """Set one of `SETTINGS` until power-off; a wrong value is a ValueError."""
        if value not in {*setting.convert}:
            choices = ", ".join(f"{member.value} ({member.name})" for member in setting.convert)
            raise ValueError(f"Invalid {setting.name} {value}. Must be one of {choices}.")
        data = struct.pack(setting.layout, value)
        self._command(f"set {setting.name}", setting.command - 1, data)

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
            "gain_mode": self.read(GAIN_MODE).name.lower(),
            "ffc_mode": self.read(FFC_MODE).name.lower(),
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
            if (state := self.read(setting)) != value:
                label = f"Invalid {setting.name} {state!r} of camera {self.serial_number()}"
                raise ValueError(f"{label}, set to {value!r}. Must be as it was set.")

    def run_ffc(self, *, timeout: float = FFC_TIMEOUT) -> int:
        """Run a flat-field correction, return its frame; BosonTimeoutError after `timeout` [s]."""
        # At its start the status is still "complete", of the correction before: it must change, or
        # the frame number of the last correction must.
        before = self.read(LAST_FFC_FRAME)
        changed = self.ffc_status() != FfcStatus.COMPLETE
        self._command("run FFC", RUN_FFC)
        deadline = self._clock() + timeout
        while True:
            # Without a reply, while the shutter is closed, it asks again until the time limit.
            with suppress(BosonTimeoutError):
                busy = bool(self.read(FFC_IN_PROGRESS, repeats=0))
                if busy or self.read(FFC_STATUS, repeats=0) != FfcStatus.COMPLETE:
                    changed = True
                elif (last := self.read(LAST_FFC_FRAME, repeats=0)) != before or changed:
                    return last
            if self._clock() >= deadline:
                raise BosonTimeoutError(f"No flat-field correction within {timeout:g} s.")
            self._clock.sleep(POLL)

    def _command(self, name: str, command: int, data: bytes = b"") -> None:
        """Send a command that changes the camera, once; its reply must be empty."""
        if reply := self._exchange(name, command, data):
            raise BosonError(f"Invalid reply of {len(reply)} bytes to '{name}'. Must be empty.")

    def _exchange(self, name: str, command: int, data: bytes = b"", *, repeats: int = 0) -> bytes:
        """Send a request, again under a new number if no reply comes; return the reply's data."""
        for _ in range(repeats + 1):
            with self._clock.hold(self._lock):
                self._sequence = next_sequence(self._sequence)
                request = Packet(COMMAND_CHANNEL, self._sequence, command, REQUEST, data)
                self._transport.write(encode(request))
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

    def _reply(self, name: str) -> Packet | None:
        """Reply to the last request, None if it does not come in time; other frames are ignored."""
        key = (COMMAND_CHANNEL, self._sequence)
        deadline, received = self._clock() + REPLY_TIMEOUT, 0
        while (remaining := deadline - self._clock()) > 0:
            if not (piece := self._transport.read(_READ_SIZE, remaining)):
                break
            received += len(piece)
            if received > MAXIMUM_RECEIVED:
                rule = "Must be a Boson's command port that no other program uses"
                raise BosonError(f"No reply to '{name}' within {MAXIMUM_RECEIVED} bytes. {rule}.")
            for frame in self._decoder.feed(piece):
                if (frame.channel, frame.sequence) == key and frame.status != REQUEST:
                    return frame
        return None


# Of a session's ``kind: boson``.
_OPEN_FRAMES = partial(v4l2.open_url, decode=telemetry.metadata)
KIND: Final = CameraKind(_OPEN_FRAMES, Boson, BAUDRATE, (0, telemetry.ROWS))
