"""The emulated camera shows its world, and emulated time gives the same bytes on any computer.

`test_faults` has what a camera does wrong.
"""

import hashlib
import math
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import rig_session
from faulty_camera import frames
from faulty_devices import clock_at
from refused import assert_raises, assert_refused
from rig_session import LIMIT, bench, from_yaml, replaced, rig, scene_text

from dbthermal.instruments import protocols, telemetry
from dbthermal.instruments.devices import open_devices
from dbthermal.instruments.emulated import CLOSED, EmulatedCamera, Picture, World
from dbthermal.instruments.recording import Limits, Preview, open_capture
from dbthermal.instruments.transport import START, SYSTEM, EmulatedClock, Task

SHAPE, RATE = (8, 80), 10.0


def level(counts: int) -> Picture:
    """A movie of even frames, each one count above the one before."""
    return lambda time: np.full(SHAPE, counts + math.floor(time * RATE + 1e-6), dtype=np.uint16)


def camera(band: str | None = "8-14", rows: int = 0, **scene: Any) -> EmulatedCamera:
    """A camera on a bench with a wheel of two filters, on a simulated clock."""
    world = World(clock=clock_at(1000.0), filters={1: "9.5", 2: "11"}, **scene)
    world.add_camera("wide", 93588)
    pictures = {"8-14": level(1000), "9.5": level(2000), "11": level(3000)}
    return EmulatedCamera(world, "wide", pictures, band, SHAPE, RATE, rows)


def shown(source: EmulatedCamera, number: int = 1) -> list[int]:
    """Counts of the first pixel of the next frames."""
    return [int(frame.counts[0, 0]) for frame in frames(source, number)]


def test_wheel_changes_what_is_seen() -> None:
    """Behind the wheel the band is the filter's; between two filters the beam is closed."""
    behind = camera(band=None)
    counts = shown(behind)
    for position in (2, None, 3):
        behind.world.wheel_position = position
        counts += shown(behind)
    assert counts == [2000, 3001, CLOSED, CLOSED]


def test_telemetry_says_what_the_camera_is_about() -> None:
    """Counter, corrections and temperature are in the rows; a correction freezes the image."""
    source = camera(rows=2)
    source.world.camera("wide").fpa_temperature = 311.2
    (last,) = shown(source)
    source.world.start_ffc("wide", 0.25)
    assert [value - last for value in shown(source, 4)] == [0, 0, 3, 4]
    frame = source.read()
    assert frame.telemetry is not None
    fields = telemetry.decode(frame.telemetry)
    assert [fields[name] for name in ("frame_counter", "camera_serial")] == [5, 93588]
    assert fields["last_ffc_frame"] in {0, 1}
    assert fields["fpa_temperature"] == pytest.approx(311.2, abs=1e-9)
    assert frame.metadata == telemetry.metadata(frame.telemetry)


def test_nobody_reads() -> None:
    """Frames beyond the buffers are lost while nobody reads, and leave a gap in the numbers."""
    source = camera()
    source.read()
    source.clock.sleep(0.75)
    assert source.read().sequence == 1
    source.clock.sleep(4.0)
    assert source.read().sequence == 47


def test_scene_begins_when_it_is_told() -> None:
    """Before, its beginning is seen; then pictures and thermocouples go with its own time."""
    source = camera(scene=lambda time: {"plate": 300.0 + time}, waits=True)
    world = source.world
    world.thermocouples[1] = "plate"
    world.clock.sleep(5.0)
    assert shown(source, 3) == [1000] * 3
    assert (world.scene_time(), world.thermocouple_temperature(1)) == (0.0, 300.0)
    world.begin()
    assert world.scene_began == world.clock()
    assert shown(source, 3) == [1001, 1002, 1003]
    assert world.thermocouple_temperature(1) == pytest.approx(300.3)
    world.begin()
    assert (world.scene_time(), world.scene_time(world.clock() - 1.0)) == (0.0, 0.0)


def test_what_does_not_fit_the_bench_is_named() -> None:
    """Pictures of another size or type, unknown bands, cameras and places, repeated cameras."""
    source = camera(band="12", scene=lambda time: {"plate": 300.0 + time})
    world = source.world
    world.thermocouples.update({1: "plate", 2: "blackbody", 4: "moon"})
    tips = [world.thermocouple_temperature(channel) for channel in (1, 2, 3)]
    np.testing.assert_array_equal(tips, [300.0, 296.15, np.nan])
    refusals: list[tuple[Callable[[], object], str]] = [
        (source.read, "Unknown band '12'"),
        (lambda: EmulatedCamera(world, "narrow", {}), "Unknown camera 'narrow'"),
        (lambda: world.thermocouple_temperature(4), "Unknown place of thermocouple 4 'moon'"),
    ]
    for call, message in refusals:
        assert_raises(KeyError, message, call)
    assert_refused("Repeated camera 'wide'", world.add_camera, "wide", 2)
    for picture in (np.zeros((3, 4), dtype=np.uint16), np.zeros(SHAPE)):
        source.pictures = {"12": Mock(return_value=picture)}
        assert_refused(r"Invalid picture .* Must be \(8, 80\) of uint16", source.read)


LIMITS = Limits(chunk=30, reserve=0, queue=3)
SWEEP = from_yaml(
    replaced(("[300.0, 290.0, 310.0]", "[300.0, 290.0]"), ("duration: 0.15", "duration: 0.3"))
)
SCENE = from_yaml(replaced(("duration: 0.15", "duration: 0.6"), text=scene_text()))


def recorded(folder: Path) -> dict[str, str]:
    """Record a sweep and a scene with a preview; names and checksums of all files."""
    order: list[float] = []

    def show(preview: Preview) -> None:
        order.append(preview.time)

    with rig(SWEEP, prepared=True) as devices:
        heat = partial(setattr, devices.world, "blackbody_temperature")
        options: Any = {"set_temperature": heat, "limits": LIMITS, "preview": show}
        protocols.record_sweep(devices, folder, **options)
    with rig(SCENE, prepared=True) as devices:
        protocols.record_scene(devices, folder / "scene.zarr", limits=LIMITS, preview=show)
    files = {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }
    return {**files, "previews": str(order)}


def test_a_recording_has_the_same_bytes_under_load_and_on_one_core(tmp_path: Path) -> None:
    """Every file of a sweep and of a scene is the same, at rest, under load and on one core."""
    first = recorded(tmp_path / "rest")
    assert len(first) > 100
    with ExitStack() as stack:
        for _ in range(2):
            busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
            stack.callback(stack.enter_context(busy).kill)
        assert recorded(tmp_path / "load") == first
    capture = open_capture(tmp_path / "load" / "scene.zarr")
    assert capture.attrs["started"].startswith(f"{START:%Y-%m-%dT}")
    totals = capture.attrs["totals"]
    assert {band: total["frames"] for band, total in totals.items()} == {"8-14": 60, "9.5": 61}
    assert all(total["refused"] == total["lost"] == 0 for total in totals.values())
    if not hasattr(os, "sched_setaffinity"):
        pytest.skip("the system does not bind a process to a core")
    with ExitStack() as stack:
        stack.callback(os.sched_setaffinity, 0, cores := os.sched_getaffinity(0))
        os.sched_setaffinity(0, {min(cores)})
        assert recorded(tmp_path / "core") == first


def test_real_time_is_an_option() -> None:
    """A bench on the computer's clock takes the time that it says."""
    world = bench(SCENE, clock=SYSTEM)
    with open_devices(SCENE, world, rig_session.pictures(world)) as devices:
        assert devices.clock is SYSTEM
        start = SYSTEM()
        devices.clock.sleep(0.05)
        assert SYSTEM() - start >= 0.05
        assert start <= devices.sources["9.5"].read().host_time <= SYSTEM()


def test_tasks_take_turns_in_the_order_of_their_times() -> None:
    """One thread runs at a time; equal times keep the order of the waits; sleeping costs none."""
    clock, order = EmulatedClock(), list[str]()

    def work(name: str, period: float) -> None:
        for number in range(3):
            clock.sleep(period)
            order.append(f"{name}{number} at {clock():g}")

    with clock.joined():
        tasks = [Task(clock, name, work, name, period) for name, period in (("a", 6e6), ("b", 9e6))]
        for task in tasks:
            task.start()
        assert order == []
        assert all(clock.wait(task.ended, 1e9) for task in tasks)
    steps = ["a0 at 6e+06", "b0 at 9e+06", "a1 at 1.2e+07", "b1 at 1.8e+07", "a2 at 1.8e+07"]
    assert order == [*steps, "b2 at 2.7e+07"]
    assert not clock.wait(threading.Event(), 5.0)
    assert (clock(), (clock.utc() - START).total_seconds()) == (27_000_005.0, 27_000_005.0)


def test_a_lock_and_an_interrupt_stop_no_other_thread() -> None:
    """A held lock is awaited in emulated time; a thread that left by an error blocks nobody."""
    clock, lock, order = EmulatedClock(), threading.Lock(), list[float]()

    def hold() -> None:
        with clock.hold(lock):
            clock.sleep(2.0)

    def leave() -> None:
        with clock.joined():
            task.start()
            clock.sleep(1.0)
            raise ZeroDivisionError

    task = Task(clock, "holder", hold)
    with pytest.raises(ZeroDivisionError):
        leave()
    with clock.hold(lock):
        order.append(clock())
    assert task.ended.wait(LIMIT)
    assert order == [2.0]
