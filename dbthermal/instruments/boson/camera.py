"""FLIR Boson: read its temperatures and counters, set its modes, run its shutter.

The driver of the camera's command port; `dbthermal.instruments.video.v4l2` takes its frames. It was
written from public descriptions (see `boson.commands`) and tested against public byte vectors and
an emulator, not against hardware. Connecting sends nothing and resets nothing, and nothing is
written to the camera's flash memory unless `Boson.save_defaults` is called.
"""

import time as system_time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeVar

from dbthermal.instruments.boson import commands
from dbthermal.instruments.boson.commands import Reading, Setting, SyncMode
from dbthermal.instruments.boson.link import (
    REPEATS,
    REPLY_TIMEOUT,
    BosonError,
    BosonReplyError,
    BosonTimeoutError,
    Link,
    Statistics,
)
from dbthermal.instruments.camera import FfcStatus
from dbthermal.instruments.closing import Closing
from dbthermal.instruments.transport import Transport, open_serial

if TYPE_CHECKING:
    from dbthermal.instruments.emulated.world import World

T = TypeVar("T")
IntT = TypeVar("IntT", bound=int)

BAUDRATE: Final = 921600
"""Speed of the line [bit/s]; over USB probably without effect."""

BOOT_TIMEOUT: Final = 10.0
"""Longest wait for a camera to boot [s]; about 3 s are reported, without a primary source."""

FFC_TIMEOUT: Final = 10.0
"""Longest wait for a flat-field correction [s]."""

SYNC_TIMEOUT: Final = 2.0
"""Longest wait for external pulses [s]."""

SYNC_FRAMES: Final = 5
"""Frames that must come for external pulses to count as there."""

POLL: Final = 0.05
"""Time between two questions while waiting [s]."""


@dataclass(frozen=True)
class Identity:
    """
    Which camera it is, for a capture's record.

    Attributes
    ----------
    serial_number, sensor_serial_number : int
        Of camera and sensor.
    part_number : str
        Of the camera.
    software_revision : str
        As ``"1.2.3"``.
    is_simulated : bool
        Whether it is an emulated one.
    """

    serial_number: int
    sensor_serial_number: int
    part_number: str
    software_revision: str
    is_simulated: bool


class Boson(Closing):
    """
    One camera's command port; a context manager, for any number of threads.

    Each method raises `BosonTimeoutError` if no reply comes, `BosonReplyError` if a wrong one does,
    `BosonStatusError` if the camera refuses, and `TransportError` if it is gone. A reading is asked
    for again if no reply comes; what changes the camera never is.

    Parameters
    ----------
    transport : Transport
        Open; closed with the camera. See `from_url`.
    timeout : float
        Longest wait for a reply [s].
    repeats : int
        How often a reading is asked for again.
    first_sequence : int, optional
        See `Link`.
    clock, sleep : callable
        Give the time and wait [s].
    """

    def __init__(
        self,
        transport: Transport,
        *,
        timeout: float = REPLY_TIMEOUT,
        repeats: int = REPEATS,
        first_sequence: int | None = None,
        clock: Callable[[], float] = system_time.monotonic,
        sleep: Callable[[float], None] = system_time.sleep,
    ) -> None:
        self._link = Link(transport, timeout=timeout, first_sequence=first_sequence, clock=clock)
        self._repeats = repeats
        self._clock = clock
        self._sleep = sleep

    @classmethod
    def from_url(
        cls, url: str, *, timeout: float = REPLY_TIMEOUT, world: "World | None" = None
    ) -> "Boson":
        """
        Open a camera's command port by its name; nothing is sent.

        Parameters
        ----------
        url : str
            ``serial:///dev/ttyACM0``, ``pty:///dev/pts/3`` or ``sim://boson``; see `open_serial`.
        timeout : float
            Longest wait for a reply [s].
        world : World, optional
            What an emulated camera is part of.

        Raises
        ------
        ValueError, TransportError
            If there is no such kind of device, or it cannot be opened.
        """
        return cls(open_serial(url, baudrate=BAUDRATE, world=world), timeout=timeout)

    @property
    def is_simulated(self) -> bool:
        """Whether no hardware is at the other end."""
        return self._link.is_simulated

    @property
    def statistics(self) -> Statistics:
        """What happened on the line so far."""
        return self._link.statistics

    def close(self) -> None:
        """Give the port back; the camera goes on as it is. A second time does nothing."""
        self._link.close()

    def read(self, reading: Reading[T]) -> T:
        """
        Ask for one value.

        Parameters
        ----------
        reading : Reading
            One of `boson.commands.READINGS`.

        Returns
        -------
        T
            The value, in the unit that the reading's name says.
        """
        return self._read(reading, self._repeats)

    def get(self, setting: Setting[IntT]) -> IntT:
        """
        Ask how something is set.

        Parameters
        ----------
        setting : Setting
            One of `boson.commands.SETTINGS`.

        Returns
        -------
        IntT
            Member of its enumeration, or a number.
        """
        return self.read(setting.reading)

    def set(self, setting: Setting[IntT], value: IntT) -> None:
        """
        Set something; it lasts until power-off. The averager may need `save_defaults` and a reboot.

        Parameters
        ----------
        setting : Setting
            One of `boson.commands.SETTINGS`.
        value : IntT
            Member of its enumeration, or a number.

        Raises
        ------
        ValueError
            If the value is not allowed; nothing is sent.
        """
        self._link.tell(f"set {setting.name}", setting.set_command, setting.data(value))

    def serial_number(self) -> int:
        """Serial number of the camera."""
        return self.read(commands.SERIAL_NUMBER)

    def identity(self) -> Identity:
        """Which camera it is, for a capture's record."""
        major, minor, patch = self.read(commands.SOFTWARE_REVISION)
        return Identity(
            serial_number=self.serial_number(),
            sensor_serial_number=self.read(commands.SENSOR_SERIAL_NUMBER),
            part_number=self.read(commands.PART_NUMBER),
            software_revision=f"{major}.{minor}.{patch}",
            is_simulated=self.is_simulated,
        )

    def fpa_temperature(self) -> float:
        """Temperature of the focal-plane array [K], in steps of 0.1 K."""
        return self.read(commands.FPA_TEMPERATURE)

    def frame_count(self) -> int:
        """Frames since the sensor started."""
        return self.read(commands.FRAME_COUNT)

    def ffc_status(self) -> FfcStatus:
        """Where the camera is with its flat-field correction."""
        return self.read(commands.FFC_STATUS)

    def start_ffc(self) -> None:
        """Start a flat-field correction (FFC), and do not wait for it."""
        self._link.tell(commands.RUN_FFC.name, commands.RUN_FFC.command)

    def run_ffc(self, *, timeout: float = FFC_TIMEOUT) -> int:
        """
        Run a flat-field correction and wait until it is complete.

        When it starts the camera still says "complete" of the one before. So another status has to
        be seen, or the frame number of the last correction has to change.

        Parameters
        ----------
        timeout : float
            Longest wait [s]; while the shutter is closed the camera may not answer.

        Returns
        -------
        int
            Number of the frame of this correction, on the camera's count.

        Raises
        ------
        BosonTimeoutError
            If it is not complete in time.
        """
        before = self.read(commands.LAST_FFC_FRAME)
        changed = self.ffc_status() != FfcStatus.COMPLETE

        def finished() -> int | None:
            nonlocal changed
            in_progress = self._read(commands.FFC_IN_PROGRESS, 0)
            if in_progress or self._read(commands.FFC_STATUS, 0) != FfcStatus.COMPLETE:
                changed = True
                return None
            last = self._read(commands.LAST_FFC_FRAME, 0)
            return last if changed or last != before else None

        self.start_ffc()
        return self._wait("flat-field correction", finished, timeout)

    def wait_until_booted(self, *, timeout: float = BOOT_TIMEOUT) -> int:
        """
        Ask for the serial number until the camera answers; it is mute while it boots.

        Parameters
        ----------
        timeout : float
            Longest wait [s].

        Returns
        -------
        int
            Serial number.

        Raises
        ------
        BosonTimeoutError
            If it does not answer in time.
        """
        return self._wait("answer", lambda: self._read(commands.SERIAL_NUMBER, 0), timeout)

    def follow_pulses(self, *, frames: int = SYNC_FRAMES, timeout: float = SYNC_TIMEOUT) -> None:
        """
        Let external pulses start the frames, once frames are seen to come.

        Without pulses a camera in this mode delivers nothing and is reported to crash; so if no
        frames come the mode is set back to disabled, and that is an error.

        Parameters
        ----------
        frames : int
            By how many the camera's frame count has to advance.
        timeout : float
            Longest wait for them [s].

        Raises
        ------
        BosonError
            If they do not come; external synchronisation is then disabled. If the camera does not
            answer either, its mode is unknown.
        """
        try:  # a mode that was set without an answer has to be undone too
            self.set(commands.SYNC_MODE, SyncMode.SLAVE)
            goal = self.frame_count() + frames
            self._wait(f"{frames} frames", lambda: self.frame_count() >= goal or None, timeout)
        except BosonError as error:
            self.set(commands.SYNC_MODE, SyncMode.DISABLED)
            raise BosonError(
                f"No external pulses: {error} External synchronisation was disabled again."
            ) from error

    def reboot(self) -> bool:
        """Restart the camera; return whether it answered before. See `wait_until_booted`."""
        try:
            self._link.tell(commands.REBOOT.name, commands.REBOOT.command)
        except BosonTimeoutError:
            return False
        return True

    def save_defaults(self) -> None:
        """Make the present settings those at power-on, in flash memory, which wears."""
        self._link.tell(commands.SAVE_DEFAULTS.name, commands.SAVE_DEFAULTS.command)

    def _read(self, reading: Reading[T], repeats: int) -> T:
        reply = self._link.ask(reading.name, reading.command, repeats=repeats)
        try:
            return reading.value(reply)
        except ValueError as error:
            raise BosonReplyError(f"Invalid reply to '{reading.name}': {error}") from error

    def _wait(self, name: str, ask: Callable[[], T | None], timeout: float) -> T:
        """Ask until there is a value; a camera that is mute is asked again until time is up."""
        deadline = self._clock() + timeout
        while True:
            try:
                if (value := ask()) is not None:
                    return value
            except BosonTimeoutError:
                pass
            if self._clock() >= deadline:
                raise BosonTimeoutError(f"No {name} within {timeout:g} s.")
            self._sleep(POLL)
