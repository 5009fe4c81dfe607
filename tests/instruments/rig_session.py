"""A small rig of two cameras, wheel and thermocouples, described in YAML and emulated."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from dbthermal.instruments.camera import Counts
from dbthermal.instruments.devices import Devices, open_devices
from dbthermal.instruments.emulated import Picture, World, emulated_world
from dbthermal.instruments.recording import Limits
from dbthermal.instruments.session import Session

SHAPE = (4, 80)
LEVELS = {"8-14": 1000, "9.5": 20_000, "11": 40_000}
"""Counts in each band [count], to which ten for each kelvin of the blackbody are added."""

QUICK = Limits(chunk=5, reserve=0, reading_period=0.05, preview_period=0.02)
"""No space is kept free, and readings come often."""

LIMIT = 600.0  # how long a process may take on a busy machine [s]

TEXT = """
name: plate
simulated: true
protocol: response
duration: 0.15
frame_rate: 100
shape: [4, 80]
telemetry_rows: 2
cameras:
  "8-14":
    video: "v4l2:///dev/video0"
    control: "serial:///dev/ttyACM0"
  9.5:
    video: "v4l2:///dev/video2"
    control: "serial:///dev/ttyACM1"
devices:
  filter_wheel: "serial:///dev/ttyUSB0"
  thermocouples: "tc08:"
filters: {1: 9.5, 3: "11"}
wheel: {velocity: 50.0, home_velocity: 50.0, acceleration: 2000.0}
sweep: [9.5, 11]
thermocouples: {1: blackbody, 4: plate}
blackbody: {temperatures: [300.0, 290.0, 310.0], stability: 0.1, window: 3, timeout: 20}
"""


def from_yaml(text: str = TEXT) -> Session:
    """Session that is loaded from a text."""
    with TemporaryDirectory() as folder:
        (file := Path(folder) / "session.yaml").write_text(text, encoding="utf-8")
        return Session.load(file)


def replaced(*changes: tuple[str, str], text: str = TEXT) -> str:
    """Return the session with other texts, each in one place."""
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    return text


def scene_text() -> str:
    """Return a session of the same rig that records a scene."""
    lines = replaced(("protocol: response", "protocol: scene")).splitlines()
    return "\n".join(line for line in lines if not line.startswith(("sweep", "blackbody")))


def bench(session: Session, **settings: Any) -> World:
    """World of a session, with a plate at 330 K and quick flat-field corrections."""
    world = emulated_world(session, scene=lambda _: {"plate": 330.0}, **settings)
    vars(world)["start_ffc"] = partial(world.start_ffc, duration=0.05)
    return world


def pictures(world: World) -> dict[str, Picture]:
    """Counts of the emulated bands: a level, ten times the blackbody's kelvin, and stripes."""

    def frame_counts(level: int, _: float) -> Counts:
        row = level + round(10 * world.blackbody_temperature) + np.arange(SHAPE[1]) % 2
        return np.broadcast_to(row, SHAPE).astype(np.uint16)

    return {band: partial(frame_counts, level) for band, level in LEVELS.items()}


@contextmanager
def rig(
    session: Session, world: World | None = None, *, prepared: bool = False
) -> Iterator[Devices]:
    """Devices of an emulated session, with its pictures; also prepared for a measurement."""
    world = bench(session) if world is None else world
    with open_devices(session, world, pictures(world)) as devices:
        if prepared:
            devices.prepare()
        yield devices
