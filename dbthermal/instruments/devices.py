"""The devices of a session, opened together: cameras, their command ports, wheel, thermocouples.

Opening sends nothing that changes a camera, and moves nothing. In an emulated session all emulators
share a world, so that the wheel's position decides what the camera behind it sees; they are
imported only then.
"""

import importlib
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Final

from dbthermal.instruments.camera import (
    FFC_READING,
    FPA_READING,
    CameraControl,
    Counts,
    FrameFlag,
    FrameSource,
    Identity,
    NoFrameError,
    Stream,
    camera_kind,
)
from dbthermal.instruments.clock import SYSTEM, Clock
from dbthermal.instruments.filterwheel import FilterWheel, NotHomedError
from dbthermal.instruments.recording import Reading
from dbthermal.instruments.session import LOGGER, WHEEL, Session
from dbthermal.instruments.tc08 import TC08, Flag, Scan, TC08Error

__all__ = ["Devices", "ReadingError", "Thermocouples", "open_devices"]
__dir__ = __all__.copy

SCAN_AGE: Final = 1.0  # longest time for which a scan gives the readings of its channels [s]
FLUSH_TIMEOUT: Final = 2.0  # longest time in which the frames that a driver holds are read [s]


class ReadingError(RuntimeError):
    """An instrument gave no number; a recording notes it and goes on."""


@dataclass
class Thermocouples:
    """The logger's channels, by the places of their tips; one scan gives the readings of all."""

    logger: TC08
    names: Mapping[int, str]

    def __post_init__(self) -> None:
        self._lock = threading.Lock()
        self._scan: Scan | None = None
        self._used: set[int] = set()  # channels whose value in the scan was given

    def read(self, channel: int) -> float:
        """Temperature of a channel [K], never the same measurement twice.

        `ReadingError` if it is no temperature, or the logger fails.
        """
        with self.logger.clock.hold(self._lock):
            scan = self._scan
            if scan is None or channel in self._used or self.logger.clock() - scan.time > SCAN_AGE:
                try:
                    self._scan = scan = self.logger.single()
                except TC08Error as error:
                    raise ReadingError(f"No temperatures: {error}") from error
                self._used.clear()
            self._used.add(channel)
        if scan.flag[channel]:
            raise ReadingError(
                f"No temperature of thermocouple '{self.names[channel]}' in channel {channel}: "
                f"{Flag(int(scan.flag[channel]))!r}. Must be connected, and within its range."
            )
        return float(scan.temperature[channel])


@dataclass(frozen=True)
class Devices:
    """The open devices of a session; see `open_devices`."""

    session: Session
    sources: Mapping[str, FrameSource]  # frames by band, in the session's order
    cameras: Mapping[str, CameraControl] = field(default_factory=dict)  # command ports by band
    wheel: FilterWheel | None = None
    thermocouples: Thermocouples | None = None  # readings of the logger
    world: Any = None  # emulated bench (`emulated.world.World`) of an emulated session

    @property
    def clock(self) -> Clock:
        """Clock of all devices."""
        return SYSTEM if self.world is None else self.world.clock

    def readings(self) -> dict[str, Reading]:
        """Instruments that are read beside the frames, for `recording.record`.

        Each thermocouple by its name [K]; ``fpa <band>``, the temperature of the focal-plane array
        [K]; ``ffc <band>``, a `camera.FfcStatus`; ``filter_wheel``, the slot in the beam.
        """
        readings: dict[str, Reading] = {}
        if self.thermocouples is not None:
            for channel, name in self.thermocouples.names.items():
                readings[name] = Reading(partial(self.thermocouples.read, channel))
        for band, camera in self.cameras.items():
            readings[FPA_READING + band] = Reading(camera.fpa_temperature)
            readings[FFC_READING + band] = Reading(camera.ffc_status, "1")
        if self.wheel is not None:
            readings[WHEEL] = Reading(self.wheel.position, "1")
        return readings

    def identities(self) -> dict[str, Identity]:
        """Names and numbers of cameras, by band, and of devices; each says ``is_simulated``.

        ValueError if frames and command port of a band are those of two cameras; RuntimeError or
        OSError if a device does not answer.
        """
        identities: dict[str, Identity] = {}
        for band, source in self.sources.items():
            # The frames of a camera, and its command port.
            identity: Identity = {**source.identity, "is_simulated": source.is_simulated}
            if band in self.cameras:
                control = self.cameras[band].identity()
                numbers = identity.get("serial_number"), control["serial_number"]
                if numbers[0] not in {None, numbers[1]}:
                    raise ValueError(
                        f"Invalid cameras {numbers} of band '{band}': frames come from the first, "
                        "commands go to the second. Must be one camera."
                    )
                identity = {**identity, **control}
            identities[band] = identity
        # The devices.
        if self.wheel is not None:
            identities[WHEEL] = self.wheel.identity()
        if self.thermocouples is not None:
            identities[LOGGER] = self.thermocouples.logger.identity()
        return identities

    def prepare(self) -> None:
        """Set the cameras, correct their offsets, home the wheel if need be, turn it to its band.

        Cameras give 16-bit counts, correct their offsets on command only, and give the session's
        telemetry. ValueError if a camera does not keep a setting, RuntimeError or OSError if a
        device refuses, fails or is gone.
        """
        for camera in self.cameras.values():
            camera.prepare(self.session.telemetry_rows)
        self.correct_offsets()
        if self.wheel is not None and self.session.filtered is not None:
            try:
                self.wheel.select(self.session.filtered)
            except NotHomedError:
                self.wheel.home()
                self.wheel.select(self.session.filtered)

    def correct_offsets(self) -> None:
        """Run a flat-field correction of each camera before its shutter, and wait for its end."""
        for camera in self.cameras.values():
            camera.run_ffc()

    def select(self, band: str) -> "Devices":
        """Turn one of the session's filters into the beam; as `FilterWheel.select`.

        Returns the devices with the camera behind the wheel named after this band; ValueError if
        the session has no wheel, or no such filter.
        """
        before = self.session.filtered
        if self.wheel is None or before is None:
            raise ValueError(f"Invalid band '{band}' of a session without a wheel.")
        self.wheel.select(band)

        def renamed(mapping: Mapping[str, Any]) -> dict[str, Any]:
            return {band if name == before else name: value for name, value in mapping.items()}

        session = replace(self.session, cameras=renamed(self.session.cameras))
        return replace(
            self, session=session, sources=renamed(self.sources), cameras=renamed(self.cameras)
        )

    def flush(self) -> None:
        """Discard frames that the drivers hold of the scene before; SourceLostError if lost."""
        start = self.clock()
        for source in self.sources.values():
            while self.clock() - start < FLUSH_TIMEOUT:
                try:
                    frame = source.read(0.0)
                except NoFrameError:
                    break
                if frame.device_time >= start and FrameFlag.FOREIGN_CLOCK not in frame.flags:
                    break


@contextmanager
def open_devices(
    session: Session,
    world: Any = None,
    pictures: Mapping[str, Callable[[float], Counts]] | None = None,
) -> Iterator[Devices]:
    """Open the devices of a session: the real ones, or, by its one switch, the emulated ones.

    `world` is the emulated bench, an `emulated.world.World`, by default one at room temperature,
    and `pictures` has by band the counts that an emulated camera sees in it, at a time of the scene
    [s]; by default, with the default world, its blackbody. The devices are closed in the end.

    Raises
    ------
    ValueError
        If an address or a camera is of another kind, or world or pictures are given for hardware.
    KeyError
        If the world has no such camera.
    OSError, WheelError, TC08Error
        If a device cannot be opened, or is another one.

    Examples
    --------
    >>> from dbthermal.instruments.session import Camera, Session
    >>> camera = Camera("v4l2:///dev/video0", "serial:///dev/ttyACM0")
    >>> session = Session("pot", True, "scene", 60.0, {"8-14": camera})
    >>> with open_devices(session) as devices:
    ...     devices.identities()["8-14"]["model"], devices.readings()["fpa 8-14"].read()  # K
    ('emulated Boson', 308.15)
    """
    # The bench of an emulated session.
    if session.simulated and world is None:
        world = _emulated("world").emulated_world(session, waits=True)
        if pictures is None:
            pictures = _emulated("camera").blackbody_pictures(session, world)
    if not session.simulated and (world is not None or pictures):
        raise ValueError(f"Invalid world for the hardware of '{session.name}'. Must be None.")
    with ExitStack() as stack:
        # Frames and command ports of the cameras.
        sources: dict[str, FrameSource] = {}
        cameras: dict[str, CameraControl] = {}
        for band, camera in session.cameras.items():
            sources[band] = stack.enter_context(_frames(session, band, world, pictures or {}))
            open_control = camera_kind(camera.kind).open_control
            if camera.control is not None and open_control is not None:
                url = f"sim://{camera.kind}/{band}" if session.simulated else camera.control
                cameras[band] = stack.enter_context(open_control(url, world))
        wheel = thermocouples = None
        # The wheel.
        if session.filters:
            url = "sim://apt" if session.simulated else session.devices[WHEEL]
            opened = FilterWheel.from_url(url, session.filters, session.wheel, world=world)
            wheel = stack.enter_context(opened)
        # The thermocouples.
        if session.thermocouples:
            if world is None:
                logger = TC08.from_url(session.devices[LOGGER])
            else:
                unit = _emulated("tc08").EmulatedTC08(world.thermocouple_temperature, world.clock)
                logger = TC08(unit).open()
            stack.enter_context(logger).set_channels(session.thermocouples)
            thermocouples = Thermocouples(logger, session.thermocouples)
        yield Devices(session, sources, cameras, wheel, thermocouples, world)


def _emulated(module: str) -> Any:
    """A module of the emulators, which nothing imports before it is needed."""
    return importlib.import_module(f"dbthermal.instruments.emulated.{module}")


def _frames(
    session: Session, band: str, world: Any, pictures: Mapping[str, Any]
) -> AbstractContextManager[FrameSource]:
    """Open the frames of a band's camera."""
    camera = session.cameras[band]
    form = session.shape, session.frame_rate, session.telemetry_rows
    if world is None:
        return camera_kind(camera.kind).open_frames(camera.video, Stream(*form))
    unfiltered = None if band == session.filtered else band
    source: AbstractContextManager[FrameSource] = _emulated("camera").EmulatedCamera(
        world, band, pictures, unfiltered, *form, kind=camera.kind
    )
    return source
