"""How fast the emulated rig records, and with how much memory; for `make bench`."""

import os
import resource
import time
from pathlib import Path

import numpy as np
import pytest

from dbthermal.instruments.emulated.frames import EmulatedCamera, Movie
from dbthermal.instruments.emulated.world import World
from dbthermal.instruments.record import record
from dbthermal.instruments.session import Camera, Device, Session


@pytest.mark.bench
def test_two_full_cameras_for_a_minute(tmp_path: Path) -> None:
    """Two cameras of 640 x 512 at 60 Hz are recorded for a minute without a lost frame."""
    noise = np.random.default_rng(0).normal(20_000, 15, (20, 512, 640)).astype(np.uint16)
    world, sources = World(), {}
    for number, band in enumerate(("8-14", "9.5")):
        world.add_camera(band, number)
        movie = Movie(noise, 60.0, endless=True)
        sources[band] = EmulatedCamera(world, band, {band: movie}, band, telemetry_rows=2)
    camera = Camera(Device("sim://camera/any", "v4l2:///dev/video0"))
    cameras = dict.fromkeys(sources, camera)
    session = Session("rate", True, "scene", 60.0, cameras, telemetry_rows=2)
    start = time.process_time()
    summary = record(session, dict(sources), tmp_path / "a.zarr")
    busy = (time.process_time() - start) / (60 * (os.cpu_count() or 1))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{summary.totals}, {100 * busy:.0f} % of the cores, peak {peak:.0f} MB")
    for total in summary.totals.values():
        assert total["frames"] >= 60 * 60 - 5
        assert total["lost"] + total["refused"] + total["damaged"] == 0
    assert peak < 1000
