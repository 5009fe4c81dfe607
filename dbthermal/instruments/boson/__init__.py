"""FLIR Boson: driver of the camera's command port; `KIND` opens it for a session.

A camera that is busy answers late, after its driver gave up; read naively, every later command then
gets the reply of the one before (openmv/openmv, pull request 3265). Here each request has a
sequence number of its own, and frames that do not carry it are discarded. Connecting
sends and resets nothing, and nothing is ever written to the camera's flash memory.
"""

import threading
from enum import IntEnum
from typing import Any, Final

from dbthermal.instruments import _fslp as fslp
from dbthermal.instruments import telemetry
from dbthermal.instruments.boson import commands
from dbthermal.instruments.boson.commands import EnumT, Reading, Setting, T
from dbthermal.instruments.camera import CameraKind, FfcMode, FfcStatus, Identity, over_v4l2
from dbthermal.instruments.transport import Closing, Transport, open_serial

__all__ = [
    "KIND",
    "Boson",
    "BosonError",
    "BosonReplyError",
    "BosonStatusError",
    "BosonTimeoutError",
    "commands",
]
__dir__ = __all__.copy

BAUDRATE: Final = 921600  # speed of the line [bit/s]; over USB probably without effect
REPLY_TIMEOUT: Final = 1.0  # longest wait for a reply [s], as in the vendor's own software
REPEATS: Final = 2  # of a reading without a reply; what changes the camera is sent once
FFC_TIMEOUT: Final = 10.0  # longest wait for a flat-field correction [s]
POLL: Final = 0.05  # time between two questions while waiting [s]
MAXIMUM_RECEIVED: Final = 65536  # most bytes to search for one reply: some lines talk without end
_READ_SIZE: Final = 4096


class BosonError(RuntimeError):
    """The camera did not carry out a command."""


class BosonTimeoutError(BosonError, TimeoutError):
    """No reply came in time; a command that changes the camera may have been carried out."""


class BosonReplyError(BosonError):
    """The reply is of another command, of the wrong size, or without meaning."""


class BosonStatusError(BosonError):
    """The camera refused; `status` is a key of `commands.STATUSES`."""

    def __init__(self, message: str, status: int) -> None:
        super().__init__(message)
        self.status = status


class Boson(Closing):
    """One camera's command port, a `camera.CameraControl`; for any number of threads.

    Each method raises `BosonTimeoutError` if no reply comes, `BosonReplyError` if a wrong one does,
    `BosonStatusError` if the camera refuses, and `TransportError` if it is gone. A reading is
    requested again if no reply comes; a command that changes the camera never is.

    Examples
    --------
    >>> with Boson.from_url("sim://boson/wide") as camera:
    ...     camera.fpa_temperature(), camera.identity()["is_simulated"]  # K
    (308.15, True)
    """

    def __init__(
        self,
        transport: Transport,
        *,
        timeout: float = REPLY_TIMEOUT,
        first_sequence: int | None = None,
    ) -> None:
        # From the time of day: replies to a program that ended are not taken for this one's.
        moment = int(1e6 * transport.clock.utc().timestamp())
        first = moment if first_sequence is None else first_sequence
        self.is_simulated = transport.is_simulated
        self.timeout = timeout
        self._transport = transport
        self._clock = transport.clock
        self._decoder = fslp.Decoder()
        self._sequence = (first - 1) % (1 << 32)
        self._lock = threading.Lock()

    @classmethod
    def from_url(cls, url: str, world: object | None = None) -> "Boson":
        """Open ``serial:///dev/ttyACM0`` or ``sim://boson``, see `open_serial`; nothing is sent."""
        return cls(open_serial(url, baudrate=BAUDRATE, world=world))

    def close(self) -> None:
        """Release the port, once an exchange of another thread is over; the camera goes on."""
        with self._clock.hold(self._lock):
            self._transport.close()

    def read(self, reading: Reading[T], *, repeats: int = REPEATS) -> T:
        """Value of one of the readings of `commands`, in the unit that its name says."""
        reply = self._exchange(reading.name, reading.command, repeats=repeats)
        try:
            return reading.value(reply)
        except ValueError as error:
            raise BosonReplyError(f"Invalid reply to '{reading.name}': {error}") from error

    def get(self, setting: Setting[EnumT]) -> EnumT:
        """State of one of `commands.SETTINGS`."""
        return self.read(setting.reading)

    def set(self, setting: Setting[EnumT], value: EnumT) -> None:
        """Set one of `commands.SETTINGS` until power-off; a wrong value is a ValueError."""
        self._tell(f"set {setting.name}", setting.set_command, setting.data(value))

    def serial_number(self) -> int:
        """Serial number of the camera."""
        return self.read(commands.SERIAL_NUMBER)

    def identity(self) -> Identity:
        """Numbers, versions and modes of the camera, and ``is_simulated``."""
        return {
            "serial_number": str(self.serial_number()),
            "sensor_serial_number": str(self.read(commands.SENSOR_SERIAL_NUMBER)),
            "part_number": self.read(commands.PART_NUMBER),
            "software_revision": self.read(commands.SOFTWARE_REVISION),
            "gain_mode": self.get(commands.GAIN_MODE).name.lower(),
            "ffc_mode": self.get(commands.FFC_MODE).name.lower(),
            "is_simulated": self.is_simulated,
        }

    def fpa_temperature(self) -> float:
        """Temperature of the focal-plane array [K], in steps of 0.1 K."""
        return self.read(commands.FPA_TEMPERATURE)

    def ffc_status(self) -> FfcStatus:
        """State of the flat-field correction."""
        return self.read(commands.FFC_STATUS)

    def prepare(self, telemetry_rows: int) -> None:
        """Set 16-bit counts, FFC on command only, and telemetry below the image; read all back."""
        settings: list[tuple[Setting[Any], IntEnum]] = [
            (commands.IR16_MODE, commands.Ir16Mode.COUNTS_16),
            (commands.FFC_MODE, FfcMode.MANUAL),
            (commands.TELEMETRY, commands.Switch(bool(telemetry_rows))),
        ]
        if telemetry_rows:
            below = commands.TelemetryLocation.BOTTOM
            settings.append((commands.TELEMETRY_LOCATION, below))
        for setting, value in settings:
            self.set(setting, value)
            state = self.get(setting)
            if state != value:
                raise ValueError(
                    f"Invalid {setting.name} {state!r} of camera {self.serial_number()}, set to "
                    f"{value!r}. Must be as it was set."
                )

    def run_ffc(self, *, timeout: float = FFC_TIMEOUT) -> int:
        """Run a flat-field correction, wait until it is complete, return its frame number.

        At its start the camera still says "complete" of the one before: another status has to be
        seen, or another frame number of the last correction. While the shutter is closed the camera
        may not answer; `BosonTimeoutError` after `timeout` [s].
        """
        before = self.read(commands.LAST_FFC_FRAME)
        changed = self.ffc_status() != FfcStatus.COMPLETE
        self._tell("run FFC", commands.RUN_FFC)
        deadline = self._clock() + timeout
        while True:
            try:
                busy = bool(self.read(commands.FFC_IN_PROGRESS, repeats=0))
                if busy or self.read(commands.FFC_STATUS, repeats=0) != FfcStatus.COMPLETE:
                    changed = True
                elif (last := self.read(commands.LAST_FFC_FRAME, repeats=0)) != before or changed:
                    return last
            except BosonTimeoutError:
                pass  # no reply while the shutter is closed: requested again until the time limit
            if self._clock() >= deadline:
                raise BosonTimeoutError(f"No flat-field correction within {timeout:g} s.")
            self._clock.sleep(POLL)

    def _tell(self, name: str, command: int, data: bytes = b"") -> None:
        """Send a command that changes the camera, once; its reply must be empty."""
        reply = self._exchange(name, command, data)
        if reply:
            raise BosonReplyError(
                f"Invalid reply of {len(reply)} bytes to '{name}'. Must be empty."
            )

    def _exchange(self, name: str, command: int, data: bytes = b"", *, repeats: int = 0) -> bytes:
        """Send a request, again if no reply comes, and return the data of its reply."""
        for _ in range(repeats):
            try:
                return self._exchange(name, command, data)
            except BosonTimeoutError:
                continue
        with self._clock.hold(self._lock):
            self._sequence = fslp.next_sequence(self._sequence)
            self._transport.write(fslp.encode(self._sequence, command, data))
            reply = self._reply(name)
        if reply.command != command:
            raise BosonReplyError(
                f"Invalid reply to '{name}', of command 0x{reply.command:08X}. "
                f"Must be of command 0x{command:08X}."
            )
        if reply.status:
            meaning = commands.STATUSES.get(reply.status, "unknown status")
            raise BosonStatusError(
                f"Refused '{name}' by the camera: status 0x{reply.status:X}, {meaning}. "
                "Must be 0, OK.",
                reply.status,
            )
        return reply.data

    def _reply(self, name: str) -> fslp.Frame:
        """Wait for the reply to the last request; discard all other frames."""
        deadline = self._clock() + self.timeout
        received = 0
        while (remaining := deadline - self._clock()) > 0:
            if not (piece := self._transport.read(_READ_SIZE, remaining)):
                break
            received += len(piece)
            if received > MAXIMUM_RECEIVED:
                raise BosonReplyError(
                    f"No reply to '{name}' within {MAXIMUM_RECEIVED} bytes. "
                    "Must be a Boson's command port that no other program uses."
                )
            key = (fslp.COMMAND_CHANNEL, self._sequence)
            for frame in self._decoder.feed(piece):
                if (frame.channel, frame.sequence) == key and frame.status != fslp.REQUEST:
                    return frame
        rule = "Must be a Boson's command port, and the camera through with booting"
        raise BosonTimeoutError(f"No reply to '{name}' within {self.timeout:g} s. {rule}.")


KIND: Final = CameraKind(over_v4l2(telemetry.metadata), Boson.from_url, (0, telemetry.ROWS))
"""The kind of camera of a session's ``kind: boson``."""
