"""Frame rate, processor load and memory of recordings on the emulated rig.

``pytest -m bench tests/instruments/test_record_rate.py --capture=no`` prints it. The cameras
are emulated: what is measured is the way from a frame that is there to the disk, not USB.
"""

import os
import resource
import shutil
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
from faulty_camera import two_bands, two_cameras

from dbthermal.instruments.emulated import World
from dbthermal.instruments.recording import record
from dbthermal.instruments.transport import SYSTEM

SHAPE, RATE, MINUTE = (512, 640), 60.0, 60.0


def measure(rate: float, seconds: float, path: Path) -> tuple[list[int], int, float]:
    """Frames in each band of noise, which compresses badly, those missing, peak of memory [MB]."""
    noise = np.random.default_rng(0).normal(20_000, 15, (20, *SHAPE)).astype(np.uint16)
    world = World(clock=SYSTEM)  # in real time
    sources = two_cameras(lambda at: noise[int(at * rate) % 20], SHAPE, rate, 2, world=world)
    session = two_bands(seconds, SHAPE, rate, 2)
    start = time.process_time()
    totals = record(session, dict(sources), path).totals
    share = (time.process_time() - start) / (seconds * (os.cpu_count() or 1))
    shutil.rmtree(path)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    frames = [total["frames"] for total in totals.values()]
    missing = sum(sum(total.values()) for total in totals.values()) - sum(frames)
    print(
        f"2 cameras of 640 x 512, {rate:g} Hz, {seconds:g} s: {frames} frames, {missing} missing, "
        f"{share:.0%} of {os.cpu_count()} cores, peak {peak:.0f} MB"
    )
    return frames, missing, peak


def fresh(rate: float, seconds: float, folder: Path) -> tuple[list[int], int, float]:
    """Measure in a new process, so that the memory is its own."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(measure, rate, seconds, folder / f"{rate}-{seconds}.zarr").result()


@pytest.mark.bench
def test_two_full_cameras_for_a_minute(tmp_path: Path) -> None:
    """Two cameras of 640 x 512 at 60 Hz: a minute without a lost frame, in bounded memory."""
    print()
    _, _, early = fresh(RATE, MINUTE / 3, tmp_path)
    frames, missing, peak = fresh(RATE, MINUTE, tmp_path)
    assert missing == 0
    assert min(frames) >= RATE * MINUTE - 5
    assert peak < early + 50, "memory grows with time"
    assert peak < 1000
