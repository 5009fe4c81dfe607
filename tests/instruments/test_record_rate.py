"""Frame rate, processor load and memory of recordings on the emulated rig.

``pytest -m bench tests/instruments/test_record_rate.py --capture=no`` prints it. The cameras
are emulated: what is measured is the way from a frame that is there to the disk, not USB.
"""

import os
import resource
import shutil
import time
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
from faulty_camera import Movie

from dbthermal.instruments.clock import SYSTEM
from dbthermal.instruments.emulated.camera import EmulatedCamera
from dbthermal.instruments.emulated.world import World
from dbthermal.instruments.recording import record
from dbthermal.instruments.session import Camera, Session

SHAPE, RATE, MINUTE = (512, 640), 60.0, 60.0
FASTER = (90.0, 120.0, 180.0, 240.0, 300.0)  # of two emulated cameras [Hz]; no Boson gives these
SLOWER = (45.0, 30.0, 20.0, 10.0)
TRIAL = 5.0  # how long each of these is recorded [s]


@dataclass(frozen=True)
class Measured:
    """Result of one recording: frames, share of all cores, peak of memory [MB]."""

    rate: float
    seconds: float
    totals: Mapping[str, Mapping[str, int]]
    share: float
    peak: float

    @property
    def missing(self) -> int:
        """Frames that were lost, refused or damaged."""
        return sum(total[name] for total in self.totals.values() for name in total) - sum(
            total["frames"] for total in self.totals.values()
        )

    def __str__(self) -> str:
        frames = " + ".join(str(total["frames"]) for total in self.totals.values())
        return (
            f"2 cameras of 640 x 512, {self.rate:g} Hz, {self.seconds:g} s: {frames} frames, "
            f"{self.missing} missing, {self.share:.0%} of {os.cpu_count()} cores, "
            f"peak {self.peak:.0f} MB"
        )


def measure(rate: float, seconds: float, path: Path) -> Measured:
    """Record two emulated cameras, with noise in their frames, which compresses badly."""
    noise = np.random.default_rng(0).normal(20_000, 15, (20, *SHAPE)).astype(np.uint16)
    world, sources = World(clock=SYSTEM), {}  # in real time
    for number, band in enumerate(("8-14", "9.5")):
        world.add_camera(band, number)
        movie = Movie(noise, rate, endless=True)
        sources[band] = EmulatedCamera(world, band, {band: movie}, band, SHAPE, rate, 2)
    cameras = dict.fromkeys(sources, Camera("v4l2:///dev/video0"))
    session = Session("rate", True, "scene", seconds, cameras, rate, SHAPE, 2)
    start = time.process_time()
    totals = record(session, dict(sources), path).totals
    share = (time.process_time() - start) / (seconds * (os.cpu_count() or 1))
    shutil.rmtree(path)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return Measured(rate, seconds, totals, share, peak)


def fresh(rate: float, seconds: float, folder: Path) -> Measured:
    """Measure in a new process, so that the memory is its own, and print the result."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        found = pool.submit(measure, rate, seconds, folder / f"{rate}-{seconds}.zarr").result()
    print(found)
    return found


@pytest.mark.bench
def test_two_full_cameras_for_a_minute(tmp_path: Path) -> None:
    """Two cameras of 640 x 512 at 60 Hz: a minute without a lost frame, in bounded memory."""
    print()
    short, whole = (fresh(RATE, seconds, tmp_path) for seconds in (MINUTE / 3, MINUTE))
    holds = RATE
    for rate in FASTER if whole.missing == 0 else SLOWER:
        missing = fresh(rate, TRIAL, tmp_path).missing
        if (missing == 0) != (whole.missing == 0):
            holds = rate if missing == 0 else holds
            break
        holds = rate
    print(f"Highest rate tried that holds: {holds:g} Hz for both cameras")
    assert whole.missing == 0, f"{holds:g} Hz holds"
    assert min(total["frames"] for total in whole.totals.values()) >= RATE * MINUTE - 5
    assert whole.peak < short.peak + 50, "memory grows with time"
    assert whole.peak < 1000
