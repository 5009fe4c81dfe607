"""Contracts that every device keeps on its emulator and on hardware, frames also on a stub.

To hold hardware against it, name the devices in DBTHERMAL_BOSON (serial:///dev/ttyACM0),
DBTHERMAL_WHEEL (serial:///dev/ttyUSB0), DBTHERMAL_TC08 (tc08:) and DBTHERMAL_VIDEO
(v4l2:///dev/video0), and run with -m hardware: the wheel turns, a shutter closes, nothing is saved.
Frames are those of a Boson, 512x640 at 60 Hz, unless DBTHERMAL_VIDEO_KIND (boson),
DBTHERMAL_VIDEO_SHAPE (rows x columns: 512x640) and DBTHERMAL_VIDEO_RATE (60) [Hz] say otherwise.
"""

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pytest
from faulty_camera import frames, two_cameras
from faulty_devices import FILTERS, QUICK, BosonBench, LoggerBench, connected
from refused import assert_raises
from test_v4l2 import BYTES, GOOD, STREAM, Driver, session

from dbthermal.instruments import boson, filterwheel, inventory, v4l2
from dbthermal.instruments import camera as interface
from dbthermal.instruments.boson import BAUDRATE, Boson
from dbthermal.instruments.devices import open_devices
from dbthermal.instruments.emulated import World
from dbthermal.instruments.emulated.devices import EmulatedApt
from dbthermal.instruments.filterwheel import FilterWheel
from dbthermal.instruments.tc08 import TC08, load
from dbthermal.instruments.transport import TransportError, open_serial


def address(name: str) -> str:
    """Name of a real device, from the environment."""
    if name not in os.environ:
        pytest.fail(f"{name} is not set: it names the device to test")
    return os.environ[name]


class Opened(NamedTuple):
    """An open device, emulated or hardware, and a function that opens a second client."""

    device: Any
    is_simulated: bool
    again: Callable[[], object] | None = None


def emulated_camera(_: ExitStack) -> Opened:
    """A Boson's driver on the emulator."""
    return Opened(BosonBench().camera, True)


def real_camera(_: ExitStack) -> Opened:
    """A Boson."""
    port = partial(open_serial, address("DBTHERMAL_BOSON"), baudrate=BAUDRATE)
    return Opened(Boson(port()), False, port)


def emulated_wheel(_: ExitStack) -> Opened:
    """A wheel's driver on the emulator, with a fast wheel."""
    return Opened(connected(EmulatedApt(World()), QUICK), True)


def real_wheel(_: ExitStack) -> Opened:
    """A wheel."""
    url = address("DBTHERMAL_WHEEL")
    port = partial(open_serial, url, baudrate=filterwheel.BAUDRATE, rtscts=True)
    return Opened(connected(port()), False, port)


def emulated_logger(_: ExitStack) -> Opened:
    """A TC-08's driver on the emulated library."""
    bench = LoggerBench()
    return Opened(bench.driver.open(), True, lambda: TC08(bench.unit).open())


def real_logger(_: ExitStack) -> Opened:
    """A TC-08 with a type-T thermocouple in socket 1, at room temperature."""
    assert address("DBTHERMAL_TC08") == "tc08:"
    return Opened(TC08(load()).open(), False, lambda: TC08(load()).open())


def stub_video(_: ExitStack) -> Opened:
    """The V4L2 driver on a stand-in for the kernel's calls."""
    answers = [(BYTES, GOOD, 1000 * number, number) for number in range(10)]
    kernel = Driver(answers=answers).kernel()
    return Opened(v4l2.Capture("/dev/video0", STREAM, kernel), False)


def emulated_video(_: ExitStack) -> Opened:
    """An emulated camera."""
    picture = np.ones((4, 6), dtype=np.uint16)
    return Opened(two_cameras(lambda _: picture, (4, 6), 60.0)["9.5"], True)


def y16_video(stack: ExitStack) -> Opened:
    """The emulated Y16 camera of a session, as `open_devices` opens it."""
    devices = stack.enter_context(open_devices(session(shape=[4, 6], frame_rate=60)))
    return Opened(devices.sources["8-14"], True)


def real_video(stack: ExitStack) -> Opened:
    """Frames of a camera, opened by its kind in the format that the environment says."""
    url = address("DBTHERMAL_VIDEO")
    kind = interface.camera_kind(os.environ.get("DBTHERMAL_VIDEO_KIND", "boson"))
    rows, columns = os.environ.get("DBTHERMAL_VIDEO_SHAPE", "512x640").split("x")
    rate = float(os.environ.get("DBTHERMAL_VIDEO_RATE", "60"))
    stream = interface.Stream((int(rows), int(columns)), rate)
    return Opened(stack.enter_context(kind.open_frames(url, stream)), False)


Opening = Callable[[ExitStack], Opened]

CAMERAS: list[Opening] = [emulated_camera, real_camera]
WHEELS: list[Opening] = [emulated_wheel, real_wheel]
LOGGERS: list[Opening] = [emulated_logger, real_logger]
VIDEOS: list[Opening] = [stub_video, emulated_video, y16_video, real_video]


CLOSED = (TransportError, RuntimeError, interface.SourceLostError)
NAMES = {"model", "part_number", "serial_number"}


def opens(*ways: Opening) -> pytest.MarkDecorator:
    """Parametrise a test by ways to open a device; those on hardware are marked `hardware`."""
    marks = {True: [pytest.mark.hardware], False: []}
    cases = [
        pytest.param(way, id=way.__name__, marks=marks[way.__name__.startswith("real")])
        for way in ways
    ]
    return pytest.mark.parametrize("opened", cases, indirect=True)


@pytest.fixture
def opened(request: pytest.FixtureRequest) -> Iterator[Opened]:
    """A device that is open."""
    with ExitStack() as stack:
        way = request.param(stack)
        with closing(way.device):
            yield way


def identity(device: Any) -> Mapping[str, object]:
    """Identity of a device, by name."""
    details: Any = device.identity
    return details() if callable(details) else details  # type: ignore[no-any-return]


def ask(device: Any) -> object:
    """Ask the simplest question of a device."""
    if isinstance(device, FilterWheel):
        return device.status()
    return identity(device) if isinstance(device, Boson | TC08) else device.read()


# What all devices keep.


@opens(*CAMERAS, *WHEELS, *LOGGERS, *VIDEOS)
def test_a_device_says_who_it_is(opened: Opened) -> None:
    """The identity is constant, names the device, and says if it is emulated."""
    details = identity(opened.device)
    assert dict(details) == dict(identity(opened.device))
    names = [value for name, value in details.items() if name in NAMES]
    assert names != []
    assert all(names)
    assert opened.device.is_simulated is details.get("is_simulated", opened.is_simulated)
    assert opened.device.is_simulated is opened.is_simulated


@opens(*CAMERAS, *WHEELS, *LOGGERS, *VIDEOS)
def test_close_is_final(opened: Opened) -> None:
    """At the end of `with` it is closed, and says so with a remedy; a second close does nothing."""
    with opened.device as device:
        ask(device)
    assert_raises(CLOSED, r"[Mm]ust|is closed", ask, opened.device)
    opened.device.close()
    assert_raises(CLOSED, r"[Mm]ust|is closed", ask, opened.device)


@opens(*CAMERAS[1:], *WHEELS[1:], *LOGGERS)
def test_a_device_has_one_client(opened: Opened) -> None:
    """A second client gets an error with a remedy, and the first is not disturbed."""
    assert opened.again is not None
    assert_raises(OSError, "other program", opened.again)
    ask(opened.device)


# What each kind keeps besides.


@opens(*CAMERAS)
def test_a_camera_corrects_its_offsets(opened: Opened) -> None:
    """It has a number and a temperature; a correction ends, at a frame after the last."""
    camera: Boson = opened.device
    assert camera.identity()["serial_number"] == str(camera.serial_number())
    assert camera.serial_number() > 0
    assert 220 < camera.fpa_temperature() < 380
    before = camera.read(boson.LAST_FFC_FRAME)
    camera._clock.sleep(0.05)
    assert camera.run_ffc() > before
    assert camera.ffc_status() is interface.FfcStatus.COMPLETE


@opens(*CAMERAS)
def test_a_camera_keeps_a_mode(opened: Opened) -> None:
    """The FFC mode is set and read back."""
    camera: Boson = opened.device
    before = camera.read(boson.FFC_MODE)
    camera.set(boson.FFC_MODE, boson.FfcMode.MANUAL)
    assert camera.read(boson.FFC_MODE) is boson.FfcMode.MANUAL
    camera.set(boson.FFC_MODE, before)
    assert camera.read(boson.FFC_MODE) is before


@opens(*WHEELS)
def test_a_wheel_goes_to_every_slot(opened: Opened) -> None:
    """A homed wheel reaches every slot and reports its band."""
    wheel: FilterWheel = opened.device
    wheel.home()
    for position in (1, 4, 2, 6, 3, 5):
        wheel.move_to(position)
        assert wheel.position() == position
    assert wheel.band() == FILTERS[5]


@opens(*LOGGERS)
def test_a_logger_reads_a_room(opened: Opened) -> None:
    """Cold junction and tip have temperatures that rooms have; a socket that is off has none."""
    logger: TC08 = opened.device
    logger.set_channels({1: "plate"})
    scan = logger.single()
    assert 273.0 < scan.temperature[0] < 320.0
    assert 200.0 < scan.temperature[1] < 400.0
    assert np.isnan(scan.temperature[2])


@opens(*VIDEOS)
def test_frames_follow_one_another(opened: Opened) -> None:
    """Frames have the source's shape, numbers that rise by one, times that rise."""
    source: interface.FrameSource = opened.device
    results = list(frames(source, 10))
    assert {frame.counts.shape for frame in results} == {source.shape}
    assert {frame.counts.dtype for frame in results} == {np.dtype(np.uint16)}
    assert np.all(np.diff([frame.sequence for frame in results]) == 1)
    assert np.all(np.diff([frame.device_time for frame in results]) > 0)
    assert {frame.telemetry is None for frame in results} == {source.telemetry_rows == 0}
    with pytest.raises(interface.NoFrameError, match="No frame from"):  # silence is no loss
        source.read(0.0)


@pytest.mark.hardware
def test_the_rig_is_found() -> None:
    """The inventory lists the whole rig without a warning."""
    results = inventory.find()
    assert [device.kind for device in results] == [inventory.BOSON, *inventory.KINDS]
    assert [device.warnings for device in results] == [()] * 4
