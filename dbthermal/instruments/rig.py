"""The rig: what a session is recorded with, and what is done to it between recordings.

`Devices.prepare` sets the cameras for a measurement and homes the wheel, `Devices.select` turns a
filter into the beam. Both are called for by the user, or by a protocol, never by opening.

Nothing here was ever run on hardware.
"""

import threading
import time as system_time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any, Final

from dbthermal.instruments.boson import Boson, BosonError, commands
from dbthermal.instruments.boson.commands import Ir16Mode, Setting, Switch, TelemetryLocation
from dbthermal.instruments.camera import FfcMode, FrameFlag, FrameSource, NoFrameError
from dbthermal.instruments.emulated.world import World
from dbthermal.instruments.filterwheel import FilterWheel, NotHomedError
from dbthermal.instruments.recording import Reading
from dbthermal.instruments.session import Session
from dbthermal.instruments.tc08 import TC08, Flag, Scan, TC08Error

SCAN_AGE: Final = 1.0
"""Longest time for which a scan of all thermocouples gives the readings of its channels [s]."""

FLUSH_TIMEOUT: Final = 2.0
"""Longest time in which the frames that a driver holds are read and thrown away [s]."""

WHEEL: Final = "filter_wheel"
"""Name of the wheel, and of the reading of its slot."""

Identity = dict[str, str | bool]


class ReadingError(RuntimeError):
    """An instrument gave no number; a recording notes it and goes on."""


@dataclass
class Thermocouples:
    """
    The logger's channels, of which one scan gives the readings of all.

    Attributes
    ----------
    logger : TC08
        Open, its channels set.
    names : mapping
        Channel to what it measures.
    clock : callable
        Host's clock [s], that of the logger.
    """

    logger: TC08
    names: Mapping[int, str]
    clock: Callable[[], float] = system_time.monotonic

    def __post_init__(self) -> None:
        self._lock = threading.Lock()
        self._scan: Scan | None = None
        self._given: set[int] = set()

    def read(self, channel: int) -> float:
        """
        Temperature of one channel; each reading of a channel is a measurement of its own.

        Parameters
        ----------
        channel : int
            1 to 8.

        Returns
        -------
        float
            [K].

        Raises
        ------
        ReadingError
            If it is no temperature, or the logger fails.
        """
        with self._lock:
            scan = self._current(channel)
        if scan.flag[channel]:
            raise ReadingError(
                f"No temperature of thermocouple '{self.names[channel]}' in channel {channel}: "
                f"{Flag(int(scan.flag[channel]))!r}. Must be connected, and within its range."
            )
        return float(scan.temperature[channel])

    def _current(self, channel: int) -> Scan:
        scan = self._scan
        if scan is None or channel in self._given or self.clock() - scan.time > SCAN_AGE:
            try:
                self._scan = scan = self.logger.single()
            except TC08Error as error:
                raise ReadingError(f"No temperatures: {error}") from error
            self._given.clear()
        self._given.add(channel)
        return scan


@dataclass(frozen=True)
class Devices:
    """
    What a session is recorded with; see `open_devices`.

    Attributes
    ----------
    session : Session
        What is recorded.
    sources : mapping
        Band to the camera's frames, in the session's order.
    cameras : mapping
        Band to the camera's command port, of the cameras that have one.
    wheel : FilterWheel or None
        The filter wheel.
    logger : TC08 or None
        The thermocouple logger.
    world : World or None
        The emulated bench of an emulated session.
    thermocouples : Thermocouples or None
        The logger's readings.
    """

    session: Session
    sources: Mapping[str, FrameSource]
    cameras: Mapping[str, Boson] = field(default_factory=dict)
    wheel: FilterWheel | None = None
    logger: TC08 | None = None
    world: World | None = None
    thermocouples: Thermocouples | None = None

    def readings(self) -> dict[str, Reading]:
        """
        What is asked beside the frames, for `dbthermal.instruments.recording.record`.

        Returns
        -------
        dict
            Each thermocouple by its name [K]; ``fpa <band>``, the temperature of the focal-plane
            array [K]; ``ffc <band>``, a `dbthermal.instruments.boson.commands.FfcStatus`;
            ``filter_wheel``, the slot in the beam. They raise `ReadingError`, WheelError or OSError
            where the instrument gives none.
        """
        found: dict[str, Reading] = {}
        if self.thermocouples is not None:
            for channel, name in self.thermocouples.names.items():
                found[name] = Reading(partial(self.thermocouples.read, channel))
        for band, camera in self.cameras.items():
            found[f"fpa {band}"] = Reading(_answer(camera.fpa_temperature))
            found[f"ffc {band}"] = Reading(_answer(camera.ffc_status), "1")
        if self.wheel is not None:
            found[WHEEL] = Reading(self.wheel.position, "1")
        return found

    def identities(self) -> dict[str, Identity]:
        """
        Which devices these are, for the record of a recording.

        Returns
        -------
        dict
            Band, or ``filter_wheel``, ``thermocouples``, to names and numbers of the device and
            ``is_simulated``.

        Raises
        ------
        ValueError
            If frames and command port of a band are those of two cameras.
        BosonError, TC08Error, OSError
            If a device does not answer.
        """
        found: dict[str, Identity] = {}
        for band, source in self.sources.items():
            identity: Identity = {**source.identity, "is_simulated": source.is_simulated}
            if band in self.cameras:
                control: Identity = _record(self.cameras[band].identity())
                _require_same(band, identity, control)
                identity |= control
            found[band] = identity
        if self.wheel is not None:
            found[WHEEL] = _record(self.wheel.identity())
        if self.logger is not None:
            found["thermocouples"] = _record(self.logger.identity())
        return found

    def prepare(self) -> None:
        """
        Make the devices ready to measure: set the cameras, correct their offsets, turn the wheel.

        Each camera gives 16-bit counts, corrects its offsets on command only, and gives telemetry
        as the session says; each setting is read back. Then the offsets are corrected, and the
        wheel is homed if it has to be, and turned to the session's band.

        Raises
        ------
        ValueError
            If a camera is set to another value than it was told.
        BosonError, WheelError, OSError
            If a device refuses, fails or is gone.
        """
        for band, camera in self.cameras.items():
            for setting, value in _settings(self.session):
                camera.set(setting, value)
                found = camera.get(setting)
                if found != value:
                    raise ValueError(
                        f"Invalid {setting.name} {found!r} of the camera of band '{band}', set "
                        f"to {value!r}. Must be as it was set."
                    )
        self.correct_offsets()
        if self.wheel is not None and self.session.filtered is not None:
            self._turn(self.wheel, self.session.filtered)

    def correct_offsets(self) -> None:
        """
        Run a flat-field correction of each camera before its shutter, and wait until it is over.

        Raises
        ------
        BosonError, OSError
            If a camera refuses, fails or is gone.
        """
        for camera in self.cameras.values():
            camera.run_ffc()

    def select(self, band: str) -> "Devices":
        """
        Turn a filter into the beam.

        Parameters
        ----------
        band : str
            One of the session's filters.

        Returns
        -------
        Devices
            The same devices, of which the camera behind the wheel is that of this band.

        Raises
        ------
        ValueError
            If there is no wheel, or no such filter.
        WheelError, TransportError
            As `FilterWheel.select`.
        """
        own = self.session.filtered
        if self.wheel is None or own is None:
            raise ValueError(f"Invalid band '{band}' of a session without a wheel.")
        self.wheel.select(band)

        def renamed(mapping: Mapping[str, Any]) -> dict[str, Any]:
            return {band if name == own else name: value for name, value in mapping.items()}

        return replace(
            self,
            session=replace(self.session, cameras=renamed(self.session.cameras)),
            sources=renamed(self.sources),
            cameras=renamed(self.cameras),
        )

    def flush(self, clock: Callable[[], float] = system_time.monotonic) -> None:
        """
        Throw away the frames that the drivers hold: they show what was before.

        Parameters
        ----------
        clock : callable
            Host's clock, that of the frames [s].

        Raises
        ------
        SourceLostError
            If a camera is gone.
        """
        start = clock()
        for source in self.sources.values():
            while clock() - start < FLUSH_TIMEOUT:
                try:
                    frame = source.read(0.0)
                except NoFrameError:
                    break
                if frame.device_time >= start and FrameFlag.FOREIGN_CLOCK not in frame.flags:
                    break

    @staticmethod
    def _turn(wheel: FilterWheel, band: str) -> None:
        try:
            wheel.select(band)
        except NotHomedError:
            wheel.home()
            wheel.select(band)


def _settings(session: Session) -> tuple[tuple[Setting[Any], int], ...]:
    """What a camera must be set to for a measurement."""
    rows = session.telemetry_rows
    return (
        (commands.IR16_MODE, Ir16Mode.COUNTS_16),
        (commands.FFC_MODE, FfcMode.MANUAL),
        (commands.TELEMETRY, Switch.ON if rows else Switch.OFF),
        *(((commands.TELEMETRY_LOCATION, TelemetryLocation.BOTTOM),) if rows else ()),
    )


def _answer(ask: Callable[[], float]) -> Callable[[], float]:
    """Ask a camera, whose errors are no end of a recording."""

    def read() -> float:
        try:
            return ask()
        except BosonError as error:
            raise ReadingError(f"No answer: {error}") from error

    return read


def _record(identity: Any) -> Identity:
    """Text by name, and whether it is simulated."""
    return {
        name: value if isinstance(value, bool) else str(value)
        for name, value in asdict(identity).items()
    }


def _require_same(band: str, source: Identity, control: Identity) -> None:
    numbers = source.get("serial_number"), control["serial_number"]
    if numbers[0] not in {None, numbers[1]}:
        raise ValueError(
            f"Invalid cameras {numbers} of band '{band}': frames come from the first, commands go "
            "to the second. Must be one camera."
        )
