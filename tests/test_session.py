"""A session says what it is, and its steps wait for what they need."""

from pathlib import Path

import numpy as np
import pytest

from dbthermal.instruments import protocols
from dbthermal.instruments.emulated.frames import EmulatedCamera, Faults
from dbthermal.instruments.emulated.world import World
from dbthermal.instruments.fetching import Limits, Reading
from dbthermal.instruments.frames_source import Counts
from dbthermal.instruments.session import Session

TEXT = """
name: plate
simulated: true
protocol: response
duration: 0.25
frame_rate: 100
shape: [8, 12]
cameras:
  "8-14":
    video: {simulated: "sim://camera/wide", hardware: "v4l2:///dev/video0"}
    control: {simulated: "sim://boson/wide", hardware: "serial:///dev/ttyACM0"}
  9.5:
    video: {simulated: "sim://camera/narrow", hardware: "v4l2:///dev/video2"}
devices:
  filter_wheel: {simulated: "sim://apt/wheel", hardware: "serial:///dev/ttyUSB0"}
filters: {1: "9.5"}
thermocouples: {1: plate}
blackbody: {temperatures: [290.0, 300.0], stability: 0.1, window: 3, timeout: 20}
"""


def bench() -> World:
    """A bench with both cameras and the filter in the beam."""
    world = World(filters={1: "9.5"}, blackbody_temperature=280.0)
    world.add_camera("wide", 1)
    world.add_camera("narrow", 2)
    return world


def replaced(old: str, new: str) -> str:
    """Return the session with another text in one place."""
    assert TEXT.count(old) == 1
    return TEXT.replace(old, new)


def test_session_is_read(tmp_path: Path) -> None:
    """All that the file says is there, and one switch chooses all addresses."""
    (tmp_path / "a.yaml").write_text(TEXT, encoding="utf-8")
    session = Session.load(tmp_path / "a.yaml")
    wheel, video = session.devices["filter_wheel"], session.cameras["9.5"].video
    assert session.bands == ("8-14", "9.5")
    assert (session.url(wheel), session.url(video)) == ("sim://apt/wheel", "sim://camera/narrow")
    real = Session.from_yaml(replaced("simulated: true", "simulated: false"))
    assert real.url(wheel) == "serial:///dev/ttyUSB0"
    assert real.content()["blackbody"]["temperatures"] == (290.0, 300.0)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("protocol: response", "protocol: sweep", "Unknown protocol 'sweep'. Must be one of"),
        ("protocol: response", "protocol: scene", "of protocol 'scene'. Must have no blackbody"),
        ("duration: 0.25", "", "Missing 'duration' in the session. Must be given"),
        ("duration: 0.25", "duration: -1", "Invalid duration -1. Must be positive"),
        ("duration: 0.25", "time: 1", "Unknown 'time' in the session"),
        ("simulated: true", "simulated: maybe", "Invalid simulated 'maybe'. Must be true or false"),
        ("duration: 0.25", "duration: long", "Invalid duration 'long'. Must be a number"),
        ("[290.0, 300.0]", "[290.0, -3]", "Must be positive"),
        ("[290.0, 300.0]", "[]", "Invalid blackbody temperatures"),
        ("thermocouples: {1: plate}", "devices: [", "Invalid session. Must be YAML"),
        (
            '{simulated: "sim://apt/wheel", ',
            "{",
            "Missing 'simulated' in the device 'filter_wheel'",
        ),
    ],
)
def test_invalid_sessions_are_refused(old: str, new: str, message: str) -> None:
    """The error names the key, the value and the rule."""
    with pytest.raises((ValueError, TypeError)) as raised:
        Session.from_yaml(replaced(old, new))
    assert message in str(raised.value)


def test_cameras_are_opened_by_their_addresses() -> None:
    """The emulated camera behind the wheel sees the filter in the beam; all are closed."""
    session = Session.from_yaml(TEXT)
    with protocols.open_sources(session, bench(), faults={"9.5": Faults(seed=3)}) as sources:
        wide, narrow = sources.values()
    assert isinstance(wide, EmulatedCamera)
    assert isinstance(narrow, EmulatedCamera)
    assert (wide.band, narrow.band, narrow.faults.seed) == ("8-14", None, 3)
    with pytest.raises(ConnectionError, match="it is closed"):
        narrow.read()


def test_other_addresses_are_refused() -> None:
    """No world, no emulated camera; and no address of another kind."""
    with (
        pytest.raises(ValueError, match="Invalid address 'sim://camera/wide' of the camera of"),
        protocols.open_sources(Session.from_yaml(TEXT)),
    ):
        pass


class Clock:
    """A clock that goes on only while somebody sleeps."""

    def __init__(self) -> None:
        self.now = 0.0

    def sleep(self, duration: float) -> None:
        """Let time pass."""
        self.now += duration


def wait(readings: list[float], clock: Clock) -> float:
    """Wait for 300 K with these readings, one a second; the last one stays."""
    values = iter(readings)
    return protocols.wait_stable(
        Session.from_yaml(TEXT),
        300.0,
        lambda: next(values, readings[-1]),
        clock=lambda: clock.now,
        sleep=clock.sleep,
    )


def test_rest_is_waited_for() -> None:
    """A window of readings near the goal and near one another is rest, and its mean is given."""
    clock = Clock()
    found = wait([299.0, 299.5, 300.02, 300.0, 300.04, 300.02], clock)
    assert found == pytest.approx(300.02)
    assert clock.now == 5.0


@pytest.mark.parametrize("readings", [[310.0], [300.0, 300.3] * 20])
def test_no_rest_is_an_error(readings: list[float]) -> None:
    """A temperature that rests elsewhere, or swings, is not taken for the step."""
    with pytest.raises(TimeoutError, match=r"No rest at 300\.0 K within 20 s"):
        wait(readings, Clock())


def test_steps_become_movies(tmp_path: Path) -> None:
    """Each temperature of the blackbody is recorded, and all together are a calibration."""
    world, session = bench(), Session.from_yaml(TEXT)
    pattern = np.arange(96, dtype=np.uint16).reshape(8, 12)

    def picture(seconds: float) -> Counts:
        level = round(10 * world.blackbody_temperature) + round(100 * seconds) % 2
        return (pattern + level).astype(np.uint16)

    clock = Clock()
    with protocols.open_sources(session, world, {"8-14": picture, "9.5": picture}) as sources:
        summaries = protocols.record_steps(
            session,
            sources,
            tmp_path,
            set_temperature=lambda value: setattr(world, "blackbody_temperature", value),
            readings={"blackbody": Reading(lambda: world.blackbody_temperature)},
            limits=Limits(chunk=5, reserve=0),
            clock=lambda: clock.now,
            sleep=clock.sleep,
        )
    assert [summary.path.name for summary in summaries] == ["plate_00.zarr", "plate_01.zarr"]
    paths = {290.0: summaries[0].path, 300.0: summaries[1].path}
    movies = protocols.blackbody_movies(paths, frames=8)
    assert movies["counts"].shape == (2, 2, 8, 8, 12)
    rise = np.diff(movies["counts"].astype(float).mean("frame"), axis=1)
    np.testing.assert_allclose(rise, 100.0, rtol=0, atol=0.5)
    with pytest.raises(ValueError, match=r"Must have 900\."):
        protocols.blackbody_movies(paths, frames=900)
