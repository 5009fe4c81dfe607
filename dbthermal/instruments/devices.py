"""The devices of a session, opened together: cameras, their command ports, wheel, thermocouples.

Opening sends nothing that changes a camera, and moves nothing. In an emulated session all emulators
share a world, so that the wheel's position decides what the camera behind it sees; they are
imported only then.
"""

import importlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Final

from dbthermal.instruments import camera as interface
from dbthermal.instruments.camera import CameraControl, Counts, FrameSource, Identity
from dbthermal.instruments.filterwheel import BAUDRATE, FilterWheel, NotHomedError
from dbthermal.instruments.recording import Reading
from dbthermal.instruments.session import LOGGER, WHEEL, Session
from dbthermal.instruments.tc08 import TC08, load
from dbthermal.instruments.transport import SYSTEM, Clock, Transport, open_serial

__all__ = ["Devices", "open_devices"]
__dir__ = __all__.copy

FLUSH_TIMEOUT: Final = 2.0  # longest time in which the frames that a driver holds are read [s]


@dataclass(frozen=True)
class Devices:
    """The open devices of a session; see `open_devices`."""

    session: Session
    sources: Mapping[str, FrameSource]  # frames by band, in the session's order
    cameras: Mapping[str, CameraControl] = field(default_factory=dict)  # command ports by band
    wheel: FilterWheel | None = None
    thermocouples: TC08 | None = None  # their logger
    world: Any = None  # emulated bench (`emulated.World`) of an emulated session

    @property
    def clock(self) -> Clock:
        """Clock of all devices."""
        return SYSTEM if self.world is None else self.world.clock

    def readings(self) -> dict[str, Reading]:
        """Instruments that are read beside the frames, by name, for `recording.record`."""
        readings: dict[str, Reading] = {}
        # Thermocouples [K], focal-plane arrays [K], states of shutters, and the slot in the beam.
        if (logger := self.thermocouples) is not None:
            for channel, name in logger.channels.items():
                readings[name] = Reading(partial(logger.read, channel))
        for band, camera in self.cameras.items():
            readings[interface.FPA_READING + band] = Reading(camera.fpa_temperature)
            readings[interface.FFC_READING + band] = Reading(camera.ffc_status, "1")
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
            identity: Identity = {**source.identity, "is_simulated": source.is_simulated}
            control = self.cameras[band].identity() if band in self.cameras else {}
            # Frames and command port must be those of one camera.
            numbers = identity.get("serial_number"), control.get("serial_number")
            if None not in numbers and numbers[0] != numbers[1]:
                state = "frames come from the first, commands go to the second"
                rule = "Must be one camera"
                raise ValueError(f"Invalid cameras {numbers} of band '{band}': {state}. {rule}.")
            identities[band] = {**identity, **control}
        for name, device in ((WHEEL, self.wheel), (LOGGER, self.thermocouples)):
            if device is not None:
                identities[name] = device.identity()
        return identities

    def prepare(self) -> None:
        """Set the cameras, correct their offsets, home the wheel if need be, turn it to its band.

        ValueError if a camera does not keep a setting, see `CameraControl.prepare`; RuntimeError or
        OSError if a device refuses, fails or is gone.
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
        """Turn a filter into the beam; the devices with the camera behind it named after its band.

        ValueError if the session has no wheel, or no such filter; else as `FilterWheel.select`.
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
            with suppress(interface.NoFrameError):
                while self.clock() - start < FLUSH_TIMEOUT:
                    frame = source.read(0.0)
                    has_own_clock = interface.FrameFlag.FOREIGN_CLOCK in frame.flags
                    if frame.device_time >= start and not has_own_clock:
                        break


@contextmanager
def open_devices(
    session: Session,
    world: Any = None,
    pictures: Mapping[str, Callable[[float], Counts]] | None = None,
) -> Iterator[Devices]:
    """Open the devices of a session: the real ones, or, by its one switch, the emulated ones.

    `world` is the emulated bench, an `emulated.World`, by default one at room temperature,
    and `pictures` has by band the counts that an emulated camera sees in it, at a time of the scene
    [s]; by default, with the default world, its blackbody. The devices are closed in the end.

    ValueError if an address or a camera is of another kind, or world or pictures are given for
    hardware, KeyError if the world has no such camera; OSError, WheelError or TC08Error if a device
    cannot be opened, or is another one.

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
        world = _emulated().emulated_world(session, waits=True)
        if pictures is None:
            pictures = _emulated().blackbody_pictures(session, world)
    if not session.simulated and (world is not None or pictures):
        raise ValueError(f"Invalid world for the hardware of '{session.name}'. Must be None.")
    with ExitStack() as stack:
        # Frames and command ports of the cameras.
        form = session.shape, session.frame_rate, session.telemetry_rows
        sources: dict[str, FrameSource] = {}
        controls: dict[str, CameraControl] = {}
        for band, camera in session.cameras.items():
            kind = interface.camera_kind(camera.kind)
            if world is None:
                source = kind.open_frames(camera.video, interface.Stream(*form))
            else:
                beam = None if band == session.filtered else band
                view = world, band, pictures or {}, beam, *form
                source = _emulated().EmulatedCamera(*view, kind=camera.kind)
            sources[band] = stack.enter_context(source)
            if camera.control is not None and kind.control is not None:
                line = _line(world, camera.kind, camera.control, band, baudrate=kind.baudrate)
                controls[band] = stack.enter_context(kind.control(line))
        # The wheel.
        wheel = logger = None
        if session.filters:
            line = _line(world, WHEEL, session.devices[WHEEL], baudrate=BAUDRATE, rtscts=True)
            wheel = stack.enter_context(FilterWheel(line, session.filters, session.wheel))
            wheel.connect()
        # The thermocouples.
        if session.thermocouples:
            library = load() if world is None else _emulated(".devices").EmulatedTC08(world)
            logger = stack.enter_context(TC08(library).open())
            logger.set_channels(session.thermocouples)
        yield Devices(session, sources, controls, wheel, logger, world)


def _line(world: Any, kind: str, url: str, *name: str, **form: Any) -> Transport:
    """Open a serial line to hardware, or to the emulator of this kind of device in a world."""
    if world is None:
        return open_serial(url, **form)
    line: Transport = _emulated(".devices").LINES[kind](world, *name)
    return line


def _emulated(module: str = "") -> Any:
    """A module of the emulators, or the bench; nothing imports them before they are needed."""
    return importlib.import_module(f"dbthermal.instruments.emulated{module}")
