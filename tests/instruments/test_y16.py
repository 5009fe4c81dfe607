"""A generic 16-bit camera, and shutter events of cameras up to the corrected capture."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_v4l2 import BYTES, GOOD, Driver

from dbthermal import correction
from dbthermal.instruments import v4l2
from dbthermal.instruments.camera import FrameFlag, Stream
from dbthermal.instruments.devices import open_devices
from dbthermal.instruments.emulated import FFC_DURATION
from dbthermal.instruments.protocols import record_scene
from dbthermal.instruments.recording import Limits, open_capture
from dbthermal.instruments.session import Session

RATE = 50.0


def session(**changes: object) -> Session:
    """The session of the parameters, with few pixels."""
    file = Path(__file__).parents[2] / "params" / "sessions" / "y16.yaml"
    return Session.load(file, {"shape": [16, 80], **changes})


def test_hardware_gives_frames_without_telemetry(monkeypatch: pytest.MonkeyPatch) -> None:
    """All rows of a frame are image, and the identity comes from the kernel alone."""
    kernel = Driver(answers=[(BYTES, GOOD, 1000, 7)]).kernel()
    monkeypatch.setattr(v4l2, "Kernel", lambda: kernel)
    with v4l2.KIND.open_frames("v4l2:///dev/video0", Stream((6, 8))) as source:
        frame = source.read()
    assert (frame.counts.shape, frame.telemetry, frame.metadata) == ((6, 8), None, None)
    assert (frame.sequence, {*source.identity}) == (7, {"device", "model", "bus", "driver"})
    with pytest.raises(ValueError, match=r"Invalid address 'serial:///dev/ttyACM0'\. Must"):
        v4l2.KIND.open_frames("serial:///dev/ttyACM0", Stream())


def test_it_has_neither_telemetry_nor_command_port() -> None:
    """A session with telemetry or a command port raises an error before a device is opened."""
    with pytest.raises(
        ValueError, match=r"telemetry_rows of band '8-14', a y16, 2\. Must be one of"
    ):
        session(telemetry_rows=2)
    plain = session()
    with pytest.raises(ValueError, match="Invalid control of kind 'y16', which has none"):
        replace(plain.cameras["8-14"], control="serial:///dev/ttyACM0")


def test_its_shutter_is_told_by_frozen_images(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A correction of its own is flagged from the third copy on, and found whole afterwards."""
    models = {"y16": ("emulated Y16 camera", 1.0)}  # corrects its offsets every second
    monkeypatch.setattr("dbthermal.instruments.emulated.camera.MODELS", models)
    camera = {"kind": "y16", "video": "v4l2:///dev/video0"}
    short = session(cameras={"8-14": camera}, duration=1.8, frame_rate=RATE)
    with open_devices(short) as devices:
        identity = devices.identities()["8-14"]
        assert (identity["device"], identity["model"]) == ("sim://y16/8-14", "emulated Y16 camera")
        record_scene(devices, tmp_path / "a.zarr", limits=Limits(reserve=0))
    capture = open_capture(tmp_path / "a.zarr")
    repeated = (capture["frame_flags"] & int(FrameFlag.IMAGE_REPEATED)) != 0
    closed = (capture["frame_flags"] & int(FrameFlag.SHUTTER_CLOSED)) != 0
    frozen = np.count_nonzero(repeated)
    assert 10 < frozen <= FFC_DURATION * RATE + 1
    assert np.count_nonzero(closed) == frozen - 2
    assert not np.any(closed & ~repeated)
    events = correction.find_shutter(capture, closed=closed)
    assert (events["renewed"].all(), *events["frames"].values) == (True, frozen)
