"""Emulated time: the same bytes whatever the computer does, and a clock that waits for nobody."""

import hashlib
import multiprocessing
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from rig_session import bench, from_yaml, pictures, replaced, rig, scene_text

from dbthermal.instruments import protocols
from dbthermal.instruments.clock import START, SYSTEM, EmulatedClock, Task
from dbthermal.instruments.devices import open_devices
from dbthermal.instruments.recording import Limits, Preview, open_capture

LIMITS, LIMIT = Limits(chunk=30, reserve=0, queue=3), 600.0
SWEEP = from_yaml(
    replaced(("[300.0, 290.0, 310.0]", "[300.0, 290.0]"), ("duration: 0.15", "duration: 0.6"))
)
SCENE = from_yaml(replaced(("duration: 0.15", "duration: 1.2"), text=scene_text()))


def recorded(folder: Path) -> dict[str, str]:
    """Record a sweep and a scene with a preview; names and checksums of all files."""
    order: list[float] = []

    def show(preview: Preview) -> None:
        order.append(preview.time)

    with rig(SWEEP) as devices:
        devices.prepare()
        protocols.record_sweep(
            devices,
            folder,
            set_temperature=lambda kelvin: vars(devices.world).update(blackbody_temperature=kelvin),
            limits=LIMITS,
            preview=show,
        )
    with rig(SCENE) as devices:
        devices.prepare()
        protocols.record_scene(devices, folder / "scene.zarr", limits=LIMITS, preview=show)
    files = {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }
    return {**files, "previews": str(order)}


def spin() -> None:
    """Keep a core busy."""
    while True:
        pass


@contextmanager
def load(processes: int) -> Iterator[None]:
    """Keep the computer busy with some processes."""
    context = multiprocessing.get_context("spawn")
    busy = [context.Process(target=spin, daemon=True) for _ in range(processes)]
    for process in busy:
        process.start()
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.join()


@contextmanager
def single_core() -> Iterator[None]:
    """Run on one core, where the system can tell a process so."""
    if not hasattr(os, "sched_setaffinity"):
        pytest.skip("the system does not bind a process to a core")
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def test_a_recording_has_the_same_bytes_under_load_and_on_one_core(tmp_path: Path) -> None:
    """Every file of a sweep and of a scene is the same, at rest, under load and on one core."""
    first = recorded(tmp_path / "rest")
    assert len(first) > 100
    with load(2):
        assert recorded(tmp_path / "load") == first
    with single_core():
        assert recorded(tmp_path / "core") == first
    capture = open_capture(tmp_path / "load" / "scene.zarr")
    assert capture.attrs["started"].startswith(f"{START:%Y-%m-%dT}")
    totals = capture.attrs["totals"]
    assert {band: total["frames"] for band, total in totals.items()} == {"8-14": 120, "9.5": 121}
    assert all(total["refused"] == total["lost"] == 0 for total in totals.values())


def test_real_time_is_an_option() -> None:
    """A bench on the computer's clock takes the time that it says."""
    world = bench(SCENE, clock=SYSTEM)
    with open_devices(SCENE, world, pictures(world)) as devices:
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
