"""The emulated camera shows its world; `test_faults` has what a camera does wrong."""

import math
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from faulty_camera import frames
from faulty_devices import Clock

from dbthermal.instruments import telemetry
from dbthermal.instruments.emulated import CLOSED, EmulatedCamera, Picture, World

SHAPE, RATE = (8, 80), 10.0


def level(counts: int) -> Picture:
    """A movie of even frames, each one count above the one before."""
    return lambda time: np.full(SHAPE, counts + math.floor(time * RATE + 1e-6), dtype=np.uint16)


def camera(band: str | None = "8-14", rows: int = 0, **scene: Any) -> EmulatedCamera:
    """A camera on a bench with a wheel of two filters, on a simulated clock."""
    world = World(clock=Clock(1000.0), filters={1: "9.5", 2: "11"}, **scene)
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
    assert [world.thermocouple_temperature(channel) for channel in (1, 2)] == [300.0, 296.15]
    with pytest.raises(KeyError, match="Unknown band '12'"):
        source.read()
    for picture in (np.zeros((3, 4), dtype=np.uint16), np.zeros(SHAPE)):
        source.pictures = {"12": Mock(return_value=picture)}
        with pytest.raises(ValueError, match=r"Invalid picture .* Must be \(8, 80\) of uint16"):
            source.read()
    with pytest.raises(KeyError, match="Unknown camera 'narrow'"):
        EmulatedCamera(world, "narrow", {})
    with pytest.raises(ValueError, match="Repeated camera 'wide'"):
        world.add_camera("wide", 2)
    assert np.isnan(world.thermocouple_temperature(3))
    with pytest.raises(KeyError, match="Unknown place 'moon' of thermocouple 4"):
        world.thermocouple_temperature(4)
