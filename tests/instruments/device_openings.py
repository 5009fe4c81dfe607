"""Ways to open each device of the rig for tests: an emulator, hardware; for frames also a stub."""

import os
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from device_benches import FILTERS, QUICK, LoggerBench
from faulty_camera import two_cameras
from test_v4l2 import BYTES, GOOD, STREAM, Driver

from dbthermal.instruments import filterwheel, v4l2
from dbthermal.instruments.boson import BAUDRATE, Boson
from dbthermal.instruments.camera import Stream, camera_kind
from dbthermal.instruments.devices import open_devices
from dbthermal.instruments.emulated import World
from dbthermal.instruments.emulated.camera import EmulatedBoson
from dbthermal.instruments.emulated.devices import EmulatedApt
from dbthermal.instruments.filterwheel import FilterWheel, Settings
from dbthermal.instruments.session import Session
from dbthermal.instruments.tc08 import TC08
from dbthermal.instruments.transport import Transport, open_serial


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


def connected(line: Transport, settings: Settings | None = None) -> FilterWheel:
    """A wheel's driver that is connected."""
    wheel = FilterWheel(line, FILTERS, settings)
    wheel.connect()
    return wheel


def emulated_camera(_: ExitStack) -> Opened:
    """A Boson's driver on the emulator."""
    (world := World()).add_camera("wide", 93588)
    return Opened(Boson(EmulatedBoson(world, "wide")), True)


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
    url = address("DBTHERMAL_TC08")
    return Opened(TC08.from_url(url), False, lambda: TC08.from_url(url))


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
    file = Path(__file__).parents[2] / "params" / "sessions" / "y16.yaml"
    session = Session.load(file, {"shape": [4, 6], "frame_rate": 60})
    return Opened(stack.enter_context(open_devices(session)).sources["8-14"], True)


def real_video(stack: ExitStack) -> Opened:
    """Frames of a camera, opened by its kind in the format that the environment says."""
    url = address("DBTHERMAL_VIDEO")
    kind = camera_kind(os.environ.get("DBTHERMAL_VIDEO_KIND", "boson"))
    rows, columns = os.environ.get("DBTHERMAL_VIDEO_SHAPE", "512x640").split("x")
    rate = float(os.environ.get("DBTHERMAL_VIDEO_RATE", "60"))
    stream = Stream((int(rows), int(columns)), rate)
    return Opened(stack.enter_context(kind.open_frames(url, stream)), False)


Opening = Callable[[ExitStack], Opened]

CAMERAS: list[Opening] = [emulated_camera, real_camera]
WHEELS: list[Opening] = [emulated_wheel, real_wheel]
LOGGERS: list[Opening] = [emulated_logger, real_logger]
VIDEOS: list[Opening] = [stub_video, emulated_video, y16_video, real_video]
