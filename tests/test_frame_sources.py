"""The contract of all sources of frames: the driver on a stand-in kernel, and the emulated camera.

To hold a real camera against it, name its node in DBTHERMAL_VIDEO and run with -m hardware.
"""

import os
from collections.abc import Callable

import numpy as np
import pytest
from test_v4l2 import BYTES, GOOD, STREAM, Driver

from dbthermal.instruments import v4l2
from dbthermal.instruments.emulated.frames import EmulatedCamera
from dbthermal.instruments.emulated.world import World
from dbthermal.instruments.frames_source import FrameSource, NoFrameError, SourceLostError, frames
from dbthermal.instruments.v4l2_calls import Stream


def on_stand_in() -> FrameSource:
    """The V4L2 driver on a kernel that has ten frames."""
    answers = [(BYTES, GOOD, 1000 * number, number) for number in range(10)]
    return v4l2.Capture.open("/dev/video0", STREAM, Driver(answers=answers).kernel())


def emulated() -> FrameSource:
    """An emulated camera that is quick."""
    world = World()
    world.add_camera("wide", 1)
    picture = np.ones((4, 6), dtype=np.uint16)
    pictures = {"8-14": lambda _: picture}
    return EmulatedCamera(world, "wide", pictures, "8-14", (4, 6), 500.0)


def hardware() -> FrameSource:
    """A real camera."""
    return v4l2.Capture.open(os.environ["DBTHERMAL_VIDEO"], Stream())


SOURCES = [on_stand_in, emulated, pytest.param(hardware, marks=pytest.mark.hardware)]


@pytest.mark.parametrize("opened", SOURCES)
def test_frames_follow_one_another(opened: Callable[[], FrameSource]) -> None:
    """Frames have the source's shape, numbers that rise by one and times that rise."""
    source = opened()
    found = list(frames(source, 10))
    source.close()
    assert {frame.counts.shape for frame in found} == {source.shape}
    assert {frame.counts.dtype for frame in found} == {np.dtype(np.uint16)}
    assert np.all(np.diff([frame.sequence for frame in found]) == 1)
    assert np.all(np.diff([frame.device_time for frame in found]) > 0)
    assert {frame.telemetry is None for frame in found} == {source.telemetry_rows == 0}
    assert all(isinstance(text, str) for text in source.identity.values())


@pytest.mark.parametrize("opened", SOURCES)
def test_close_is_final(opened: Callable[[], FrameSource]) -> None:
    """Closed, and closed again, a source gives no more frames."""
    source = opened()
    source.close()
    source.close()
    with pytest.raises(SourceLostError, match="it is closed"):
        source.read()


@pytest.mark.parametrize("opened", SOURCES)
def test_silence_is_no_loss(opened: Callable[[], FrameSource]) -> None:
    """After a wait without a frame the source is as before."""
    source = opened()
    list(frames(source, 10))
    with pytest.raises(NoFrameError, match="No frame from"):
        source.read(0.0)
    source.close()
