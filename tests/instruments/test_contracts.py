"""Contracts that every device keeps on its emulator and on hardware, frames also on a stub.

To hold hardware against it, name the devices in DBTHERMAL_BOSON (serial:///dev/ttyACM0),
DBTHERMAL_WHEEL (serial:///dev/ttyUSB0), DBTHERMAL_TC08 (tc08:) and DBTHERMAL_VIDEO
(v4l2:///dev/video0), and run with -m hardware: the wheel turns, a shutter closes, nothing is saved.
Frames are those of a Boson, 512x640 at 60 Hz, unless DBTHERMAL_VIDEO_KIND (boson),
DBTHERMAL_VIDEO_SHAPE (rows x columns: 512x640) and DBTHERMAL_VIDEO_RATE (60) [Hz] say otherwise.
"""

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing
from typing import Any

import numpy as np
import pytest
from device_benches import FILTERS
from device_openings import CAMERAS, LOGGERS, VIDEOS, WHEELS, Opened, Opening
from faulty_camera import frames

from dbthermal.instruments import boson, inventory
from dbthermal.instruments.boson import Boson
from dbthermal.instruments.camera import (
    FfcMode,
    FfcStatus,
    FrameSource,
    NoFrameError,
    SourceLostError,
)
from dbthermal.instruments.filterwheel import FilterWheel
from dbthermal.instruments.tc08 import TC08, Flag
from dbthermal.instruments.transport import TransportError

CLOSED = (TransportError, RuntimeError, SourceLostError)
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
    if isinstance(device, Boson | FilterWheel | TC08):
        return device.identity()
    details: Mapping[str, object] = device.identity
    return details


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
    with pytest.raises(CLOSED, match=r"[Mm]ust|is closed"):
        ask(opened.device)
    opened.device.close()
    with pytest.raises(CLOSED, match=r"[Mm]ust|is closed"):
        ask(opened.device)


@opens(*CAMERAS[1:], *WHEELS[1:], *LOGGERS)
def test_a_device_has_one_client(opened: Opened) -> None:
    """A second client gets an error with a remedy, and the first is not disturbed."""
    assert opened.again is not None
    with pytest.raises(OSError, match="other program"):
        opened.again()
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
    assert camera.ffc_status() is FfcStatus.COMPLETE


@opens(*CAMERAS)
def test_a_camera_keeps_a_mode(opened: Opened) -> None:
    """The FFC mode is set and read back; an unknown mode raises a ValueError."""
    camera: Boson = opened.device
    before = camera.get(boson.FFC_MODE)
    camera.set(boson.FFC_MODE, FfcMode.MANUAL)
    assert camera.get(boson.FFC_MODE) is FfcMode.MANUAL
    wrong: Any = 4
    with pytest.raises(ValueError, match="Invalid FFC mode 4"):
        camera.set(boson.FFC_MODE, wrong)
    camera.set(boson.FFC_MODE, before)
    assert camera.get(boson.FFC_MODE) is before


@opens(*WHEELS)
def test_a_wheel_goes_to_every_slot(opened: Opened) -> None:
    """A homed wheel reaches every slot and reports its band; slot 7 raises a ValueError."""
    wheel: FilterWheel = opened.device
    wheel.home()
    for position in (1, 4, 2, 6, 3, 5):
        wheel.move_to(position)
        assert wheel.position() == position
    with pytest.raises(ValueError, match=r"Invalid filter position 7\. Must lie in 1 to 6"):
        wheel.move_to(7)
    assert wheel.band() == FILTERS[5]


@opens(*LOGGERS)
def test_a_logger_reads_a_room(opened: Opened) -> None:
    """Cold junction and tip have temperatures that rooms have; a socket that is off has none."""
    logger: TC08 = opened.device
    logger.set_channels({1: "plate"})
    scan = logger.single()
    assert 273.0 < scan.temperature[0] < 320.0
    assert 200.0 < scan.temperature[1] < 400.0
    assert list(scan.flag[:3]) == [0, 0, Flag.MISSING]
    assert np.isnan(scan.temperature[2])
    with pytest.raises(ValueError, match=r"Invalid channel 9\. Must lie in 1 to 8"):
        logger.set_channels({9: "tip"})


@opens(*VIDEOS)
def test_frames_follow_one_another(opened: Opened) -> None:
    """Frames have the source's shape, numbers that rise by one, times that rise."""
    source: FrameSource = opened.device
    results = list(frames(source, 10))
    assert {frame.counts.shape for frame in results} == {source.shape}
    assert {frame.counts.dtype for frame in results} == {np.dtype(np.uint16)}
    assert np.all(np.diff([frame.sequence for frame in results]) == 1)
    assert np.all(np.diff([frame.device_time for frame in results]) > 0)
    assert {frame.telemetry is None for frame in results} == {source.telemetry_rows == 0}
    with pytest.raises(NoFrameError, match="No frame from"):  # silence is no loss
        source.read(0.0)


@pytest.mark.hardware
def test_the_rig_is_found() -> None:
    """The inventory lists the whole rig without a warning."""
    results = inventory.find()
    assert [device.kind for device in results] == [inventory.BOSON, *inventory.KINDS]
    assert [device.warnings for device in results] == [()] * 4
