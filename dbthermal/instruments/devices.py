"""The devices of a session, opened together: cameras, their command ports, wheel, thermocouples.

Opening sends nothing that changes a camera, and moves nothing; what is opened is `Devices`. In an
emulated session all emulators share one world, so that the wheel's place decides what the camera
behind it sees.

Nothing here was ever run on hardware.
"""

from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import fields
from typing import Any, Final
from urllib.parse import urlsplit

from dbthermal.instruments import filterwheel, telemetry
from dbthermal.instruments.boson import Boson
from dbthermal.instruments.camera import FrameSource, Stream
from dbthermal.instruments.emulated import blackbody
from dbthermal.instruments.emulated.frames import EmulatedCamera, Faults, Picture
from dbthermal.instruments.emulated.world import ROOM, World
from dbthermal.instruments.filterwheel import FilterWheel
from dbthermal.instruments.rig import Devices, ReadingError, Thermocouples
from dbthermal.instruments.session import Session, check_one_of
from dbthermal.instruments.tc08 import TC08

__all__ = ["Devices", "ReadingError", "Thermocouples", "emulated_world", "open_devices"]

KIND: Final = "T"
"""Letter of the rig's thermocouples."""

SERIAL_NUMBERS: Final = 93588
"""Number of the first emulated camera of a session; the others follow."""


@contextmanager
def open_devices(
    session: Session,
    world: World | None = None,
    pictures: Mapping[str, Picture] | None = None,
    faults: Mapping[str, Faults] | None = None,
) -> Iterator[Devices]:
    """
    Open the devices of a session: the real ones, or, by its one switch, the emulated ones.

    Addresses are ``v4l2:///dev/video0``, ``serial:///dev/ttyACM0`` and ``tc08:``; and in an
    emulated session ``sim://camera/<name>`` and ``sim://boson/<name>``, with the name of a camera
    of the world, ``sim://apt/<any>`` and ``sim://tc08``.

    Parameters
    ----------
    session : Session
        What is opened.
    world : World, optional
        The emulated bench; by default `emulated_world` at room temperature.
    pictures : mapping, optional
        Band to what the emulated cameras see in it; by default, with the default world, its
        blackbody, see `dbthermal.instruments.emulated.blackbody`.
    faults : mapping, optional
        Band to what goes wrong with its emulated camera.

    Yields
    ------
    Devices
        Closed in the end.

    Raises
    ------
    ValueError
        If an address is of another kind, or there is a world, pictures or faults for hardware.
    KeyError
        If the world has no such camera.
    OSError, WheelError, TC08Error
        If a device cannot be opened, or is another one.
    """
    if session.simulated:
        if world is None:
            room = dict.fromkeys(session.thermocouples.values(), ROOM)
            world = emulated_world(session, scene=lambda _: room, waits=True)
            pictures = blackbody.pictures(session, world) if pictures is None else pictures
    elif world is not None or pictures or faults:
        raise ValueError(f"Invalid world for the hardware of '{session.name}'. Must be None.")
    with ExitStack() as stack:
        sources: dict[str, FrameSource] = {}
        cameras: dict[str, Boson] = {}
        for band, camera in session.cameras.items():
            fault = (faults or {}).get(band, Faults())
            sources[band] = stack.enter_context(
                _source(session, band, world, pictures or {}, fault)
            )
            if camera.control is not None:
                cameras[band] = stack.enter_context(_control(session.url(camera.control), world))
        wheel = stack.enter_context(_wheel(session, world)) if session.filters else None
        logger = stack.enter_context(_logger(session, world)) if session.thermocouples else None
        scans = None if logger is None else Thermocouples(logger, session.thermocouples)
        yield Devices(session, sources, cameras, wheel, logger, world, scans)


def emulated_world(session: Session, **settings: Any) -> World:
    """
    Bench with the cameras, filters and thermocouples of an emulated session.

    Parameters
    ----------
    session : Session
        What is emulated; its thermocouples are at what they are named after.
    **settings
        As for `World`.

    Returns
    -------
    World
        For `open_devices`.
    """
    world = World(filters=session.filters, **settings)
    furnish(world, session)
    return world


def furnish(world: World, session: Session) -> None:
    """
    Put the cameras and thermocouples of an emulated session on a bench.

    Parameters
    ----------
    world : World
        The bench.
    session : Session
        What is emulated; its thermocouples are at what they are named after.

    Raises
    ------
    ValueError
        If there is a camera of such a name.
    """
    world.thermocouples.update(session.thermocouples)
    for number, camera in enumerate(session.cameras.values()):
        world.add_camera(_name(session.url(camera.video)), SERIAL_NUMBERS + number)


def _source(
    session: Session,
    band: str,
    world: World | None,
    pictures: Mapping[str, Picture],
    faults: Faults,
) -> AbstractContextManager[FrameSource]:
    url = session.url(session.cameras[band].video)
    form = session.shape, session.frame_rate, session.telemetry_rows
    if url.startswith("v4l2:///") and world is None:
        from dbthermal.instruments.video import v4l2  # noqa: PLC0415 - Linux only

        stream = Stream(*form)
        return v4l2.Capture.open(urlsplit(url).path, stream, decode=telemetry.metadata)
    if not url.startswith("sim://camera/") or world is None:
        raise ValueError(
            f"Invalid address '{url}' of the camera of band '{band}'. Must be 'v4l2:///dev/...', "
            "or 'sim://camera/<name>' if simulated."
        )
    own = None if band == session.filtered else band
    return EmulatedCamera(world, _name(url), pictures, own, *form, faults)


def _control(url: str, world: World | None) -> Boson:
    """Open a command port; the frames of an emulated camera are its frame source's to count."""
    if world is not None and not url.startswith("pty:"):
        if not url.startswith("sim://boson/"):
            raise ValueError(f"Invalid address '{url}' of a camera. Must be 'sim://boson/<name>'.")
        world.camera(_name(url))
        url = f"{url}?frames=source"
    return Boson.from_url(url, world=world)


def _wheel(session: Session, world: World | None) -> FilterWheel:
    known = {entry.name for entry in fields(filterwheel.Settings)} - {"filters"}
    check_one_of("setting of the wheel", session.wheel, sorted(known))
    settings = filterwheel.Settings(filters=session.filters, **session.wheel)
    return FilterWheel.from_url(session.url(session.devices["filter_wheel"]), settings, world=world)


def _logger(session: Session, world: World | None) -> TC08:
    logger = TC08.from_url(session.url(session.devices["thermocouples"]), world=world)
    try:
        logger.set_channels(dict.fromkeys(session.thermocouples, KIND))
    except BaseException:
        logger.close()
        raise
    return logger


def _name(url: str) -> str:
    """Name of an emulated camera in its world."""
    return urlsplit(url).path.lstrip("/")
