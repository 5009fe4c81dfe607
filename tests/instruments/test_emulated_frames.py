"""The emulated camera shows its world, and has the faults that are set."""

import numpy as np
import pytest
from device_benches import Clock
from faulty_camera import Faults, FaultyCamera, Movie, frames

from dbthermal.instruments import telemetry
from dbthermal.instruments.camera import (
    Counts,
    Frame,
    FrameFlag,
    NoFrameError,
    SourceLostError,
)
from dbthermal.instruments.emulated import camera as emulated
from dbthermal.instruments.emulated.world import World

SHAPE, RATE = (8, 80), 10.0


def level(counts: int) -> Movie:
    """A movie of 100 even frames, each one count above the one before."""
    steps = np.arange(counts, counts + 100, dtype=np.uint16)
    return Movie(np.broadcast_to(steps[:, None, None], (100, *SHAPE)), RATE, endless=True)


def camera(faults: Faults | None = None, band: str | None = "8-14", rows: int = 0) -> FaultyCamera:
    """A camera on a bench with a wheel of two filters, on a simulated clock."""
    clock = Clock(1000.0)
    world = World(clock=clock, filters={1: "9.5", 2: "11"})
    world.add_camera("wide", 93588)
    pictures = {"8-14": level(1000), "9.5": level(2000), "11": level(3000)}
    return FaultyCamera(world, "wide", pictures, band, SHAPE, RATE, rows, faults=faults or Faults())


def shown(frame: Frame) -> int:
    """Counts of the first pixel."""
    return int(frame.counts[0, 0])


def test_frames_come_at_their_rate() -> None:
    """Number, picture and both clocks go on together."""
    found = list(frames(camera(), 5))
    assert [frame.sequence for frame in found] == list(range(5))
    assert [shown(frame) for frame in found] == list(range(1000, 1005))
    times = [frame.device_time for frame in found]
    np.testing.assert_allclose(times, 1000 + np.arange(5) / RATE, rtol=0, atol=1e-9)
    assert all(frame.host_time == pytest.approx(frame.device_time) for frame in found)


def test_it_says_that_it_is_emulated() -> None:
    """Identity and `is_simulated` label the camera as emulated."""
    assert camera().is_simulated
    assert "emulated" in camera().identity["model"]
    assert camera().identity["device"].startswith("sim://")


def test_wheel_changes_what_is_seen() -> None:
    """Behind the wheel the band is the filter's; between two filters the beam is closed."""
    behind = camera(band=None)
    found = [shown(behind.read())]
    for position in (2, None, 3):
        behind.world.wheel_position = position
        found.append(shown(behind.read()))
    assert found == [2000, 3001, emulated.CLOSED, emulated.CLOSED]


def test_shutter_freezes_and_leaves_other_offsets() -> None:
    """During a correction the image stands, without a flag; after it each pixel has an offset."""
    source = camera(Faults(ffc=frozenset({3}), offset_step=20.0))
    found = list(frames(source, 12))
    assert all(frame.flags == 0 for frame in found)
    assert all(np.array_equal(frame.counts, found[2].counts) for frame in found[3:8])
    step = found[8].counts.astype(int) - 1008
    assert 15 < step.std() < 25
    np.testing.assert_array_equal(found[9].counts.astype(int) - 1009, step)


def test_shutter_may_be_anothers_command() -> None:
    """A correction that was started over the serial line freezes the frames too."""
    source = camera()
    last = shown(source.read())
    source.world.start_ffc("wide", 0.25)
    assert [shown(frame) - last for frame in frames(source, 4)] == [0, 0, 3, 4]


def test_telemetry_says_what_the_camera_is_about() -> None:
    """Counter, corrections and temperature are in the rows, and in the world."""
    source = camera(Faults(ffc=frozenset({3})), rows=2)
    source.world.camera("wide").fpa_temperature = 311.2
    last = list(frames(source, 6))[-1]
    assert last.telemetry is not None
    fields = telemetry.decode(last.telemetry)
    assert [fields[name] for name in ("frame_counter", "last_ffc_frame")] == [5, 3]
    assert fields["camera_serial"] == 93588
    assert fields["fpa_temperature"] == pytest.approx(311.2, abs=1e-9)
    assert last.metadata == telemetry.metadata(last.telemetry)


def test_dropped_frames_leave_a_gap() -> None:
    """A frame that never comes is missing in the numbers, and takes its time."""
    found = list(frames(camera(Faults(dropped=frozenset({2, 3}))), 4))
    assert [frame.sequence for frame in found] == [0, 1, 4, 5]
    assert found[2].device_time - found[1].device_time == pytest.approx(0.3)


def test_nobody_reads() -> None:
    """Frames beyond the buffers are lost while nobody reads, and leave a gap in the numbers."""
    source = camera()
    source.read()
    source.clock.sleep(0.75)
    assert source.read().sequence == 1
    source.clock.sleep(4.0)
    assert source.read().sequence == 47


def test_damage() -> None:
    """A corrupt frame is flagged unless its fault is hidden; missing bytes of a short one are 0."""
    faults = Faults(corrupt=frozenset({1}), unseen=frozenset({2}), short=frozenset({3}))
    found = list(frames(camera(faults), 5))
    expected = [0, FrameFlag.DRIVER_ERROR, 0, FrameFlag.WRONG_SIZE, 0]
    assert [frame.flags for frame in found] == expected
    lower = [int(np.ptp(frame.counts[4:].astype(int))) for frame in found]
    assert [value > 0 for value in lower] == [False, True, True, False, False]
    assert (found[3].counts[4:] == 0).all()


def test_repeated_image_has_its_own_number() -> None:
    """A repeated image has a new sequence number."""
    found = list(frames(camera(Faults(repeated=frozenset({2}))), 4))
    assert [shown(frame) for frame in found] == [1000, 1001, 1001, 1003]
    assert [frame.sequence for frame in found] == [0, 1, 2, 3]


def test_clock_of_its_own() -> None:
    """A drifting clock advances at its rate, and is labelled as the camera's own."""
    found = list(frames(camera(Faults(clock_rate=1.01)), 3))
    assert np.diff([frame.device_time for frame in found]) == pytest.approx(0.101)
    assert all(frame.flags == FrameFlag.FOREIGN_CLOCK for frame in found)


def test_unplugged_and_closed() -> None:
    """A camera that is gone, or was closed, says which."""
    source = camera(Faults(unplugged=2))
    list(frames(source, 2))
    with pytest.raises(SourceLostError, match="emulated camera 'wide': it is unplugged"):
        source.read()
    assert not source.world.camera("wide").plugged
    with camera() as other:
        pass
    other.close()
    with pytest.raises(SourceLostError, match="it is closed"):
        other.read()


def test_no_frame_in_time() -> None:
    """A wait shorter than a frame ends without one; the next wait has it."""
    source = camera()
    source.read()
    with pytest.raises(NoFrameError, match=r"No frame from emulated camera 'wide' in 0\.01 s"):
        source.read(0.01)
    assert source.read().sequence == 1


def test_scene_begins_when_it_is_told() -> None:
    """Before, its beginning is seen; then pictures and thermocouples go with its own time."""
    clock = Clock(1000.0)
    world = World(clock=clock, scene=lambda time: {"plate": 300.0 + time}, waits=True)
    world.add_camera("wide", 1)
    world.thermocouples[1] = "plate"
    clock.sleep(5.0)
    source = FaultyCamera(world, "wide", {"8-14": level(1000)}, "8-14", SHAPE, RATE)
    assert [shown(frame) for frame in frames(source, 3)] == [1000] * 3
    assert (world.scene_time(), world.thermocouple_temperature(1)) == (0.0, 300.0)
    world.begin()
    assert world.scene_began == clock()
    assert [shown(frame) for frame in frames(source, 3)] == [1001, 1002, 1003]
    assert world.thermocouple_temperature(1) == pytest.approx(300.3)
    world.begin()
    assert (world.scene_time(), world.scene_time(1.0)) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("picture", "message"),
    [
        (np.zeros((3, 4), dtype=np.uint16), r"Invalid picture \(3, 4\) of uint16 in band '8-14'"),
        (np.zeros(SHAPE, dtype=np.float64), r"Must be \(8, 80\) of uint16"),
    ],
)
def test_pictures_are_counts(picture: Counts, message: str) -> None:
    """A picture of another size or type raises an error."""
    source = camera()
    source.pictures = {"8-14": lambda _: picture}
    with pytest.raises(ValueError, match=message):
        source.read()


def test_unknown_names() -> None:
    """A band without a picture, and a camera that is not on the bench, are named."""
    source = camera(band="12")
    with pytest.raises(KeyError, match="Unknown band '12'"):
        source.read()
    with pytest.raises(KeyError, match="Unknown camera 'narrow'"):
        FaultyCamera(source.world, "narrow", {})


def test_world_has_places_and_slots() -> None:
    """Thermocouples read what they are at; names are checked."""
    world = World(scene=lambda time: {"plate": 300.0 + time}, clock=Clock(1000.0))
    world.thermocouples.update({1: "plate", 2: "blackbody", 4: "moon"})
    world.blackbody_temperature = 320.0
    assert [world.thermocouple_temperature(channel) for channel in (1, 2)] == [300.0, 320.0]
    assert np.isnan(world.thermocouple_temperature(3))
    with pytest.raises(KeyError, match="Unknown place 'moon' of thermocouple 4"):
        world.thermocouple_temperature(4)
    world.add_camera("wide", 1)
    with pytest.raises(ValueError, match="Repeated camera 'wide'"):
        world.add_camera("wide", 2)
