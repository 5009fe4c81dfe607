"""The Boson's driver on its emulator: faults as a user sees them, and the emulator's fidelity."""

from collections import deque
from typing import Any

import pytest
from device_benches import BosonBench, Clock
from faulty_boson import Fault, FaultyBoson
from hypothesis import given
from hypothesis import strategies as st
from test_boson import SERIAL, SET_GAIN
from test_fslp import SERIAL_REQUEST

from dbthermal.instruments import _fslp as fslp
from dbthermal.instruments.boson import (
    Boson,
    BosonError,
    BosonReplyError,
    BosonStatusError,
    BosonTimeoutError,
    commands,
)
from dbthermal.instruments.boson.commands import Setting
from dbthermal.instruments.camera import FfcStatus, GainMode
from dbthermal.instruments.emulated.boson import EmulatedBoson
from dbthermal.instruments.emulated.line import Line
from dbthermal.instruments.emulated.world import FFC_DURATION, World
from dbthermal.instruments.transport import TransportError


@pytest.fixture
def bench() -> BosonBench:
    """An emulated camera in memory, on a clock of its own."""
    return BosonBench()


@pytest.mark.parametrize("setting", commands.SETTINGS, ids=lambda setting: setting.name)
def test_every_setting_is_kept(bench: BosonBench, setting: Setting[Any]) -> None:
    """Every value of every setting is read back as set."""
    for value in setting.kind:
        bench.camera.set(setting, value)
        assert bench.camera.get(setting) == value


def test_every_reading_has_a_value(bench: BosonBench) -> None:
    """All readings are answered, at values whose bytes need escapes too."""
    bench.state.serial_number = 0x8E9EAE81
    bench.state.fpa_temperature = bench.state.last_ffc_temperature = 0x0C9E / 10
    readings = [one for one in vars(commands).values() if isinstance(one, commands.Reading)]
    values = {reading.name: bench.camera.read(reading) for reading in readings}
    assert values["serial number"] == 0x8E9EAE81
    assert values["FPA temperature [K]"] == pytest.approx(323.0, abs=0.05)
    assert values["FFC status"] is FfcStatus.NONE_PERFORMED
    assert values["part number"] == "EMULATED-BOSON-640"


@pytest.mark.parametrize("sequence", [0x8E9EAE00, 0x0000AE8E, 0x9E9E9E9E])
def test_the_emulator_echoes_any_sequence_number(bench: BosonBench, sequence: int) -> None:
    """Headers that need escapes are understood and answered."""
    frames = bench.exchange(fslp.encode(sequence, SERIAL))
    assert frames == [fslp.Frame(0, sequence, SERIAL, 0, (93588).to_bytes(4))]


@pytest.mark.parametrize(
    ("command", "data", "request_status", "status"),
    [
        (0x0000FFFF, b"", fslp.REQUEST, 0x161),
        (SERIAL, b"", 0, 0x162),
        (SET_GAIN, b"\x00", fslp.REQUEST, 0x17D),
        (SERIAL, b"\x00", fslp.REQUEST, 0x17E),
        (SET_GAIN, b"\x00\x00\x00\x05", fslp.REQUEST, 0x203),
    ],
)
def test_the_emulator_refuses_as_a_camera_does(
    bench: BosonBench, command: int, data: bytes, request_status: int, status: int
) -> None:
    """Unknown commands, wrong sizes and wrong values have their status and no data."""
    frames = bench.exchange(fslp.encode(1, command, data, request_status))
    assert frames == [fslp.Frame(0, 1, command, status)]


@pytest.mark.parametrize(
    "noise", [b"\x00\x11", SERIAL_REQUEST[:9], SERIAL_REQUEST[:-2] + b"\0\xae"]
)
def test_the_emulator_listens_on_after_noise(bench: BosonBench, noise: bytes) -> None:
    """Noise, incomplete frames and frames with a wrong checksum are not answered."""
    other = fslp.encode(5, SERIAL, channel=1)
    assert [f.sequence for f in bench.exchange(noise + other + SERIAL_REQUEST)] == [1]


@given(st.lists(st.binary(max_size=60), max_size=6))
def test_the_emulator_takes_any_bytes(pieces: list[bytes]) -> None:
    """After any bytes the emulator answers the next valid request."""
    bench = BosonBench()
    for piece in pieces:
        bench.loop.write(piece)
        bench.loop.read(4096, 0.0)
    assert bench.camera.serial_number() == 93588


@pytest.mark.parametrize(
    ("fault", "timeouts"),
    [
        (Fault.DROP, 1),
        (Fault.LATE, 1),
        (Fault.HOLD, 1),
        (Fault.BAD_CHECKSUM, 1),
        (Fault.ILLEGAL_ESCAPE, 1),
        (Fault.CUT, 1),
        (Fault.DEBUG_TEXT, 0),
    ],
)
def test_a_fault_of_the_line_is_overcome(bench: BosonBench, fault: Fault, timeouts: int) -> None:
    """A fault costs at most the wait for a reply; this and the next reading are right."""
    bench.spoil(fault)
    start = bench.clock.now
    assert bench.camera.fpa_temperature() == pytest.approx(308.15, abs=0.05)
    assert timeouts <= bench.clock.now - start < timeouts + 1.0  # [s]
    assert bench.camera.serial_number() == 93588


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        (Fault.WRONG_COMMAND, BosonReplyError),
        (Fault.SHORT, BosonReplyError),
        (Fault.BUSY, BosonStatusError),
    ],
)
def test_a_fault_of_the_camera_is_an_error(
    bench: BosonBench, fault: Fault, error: type[BosonError]
) -> None:
    """A reply of another command, a short one and a refusal reach the user; the line goes on."""
    bench.spoil(fault)
    with pytest.raises(error):
        bench.camera.fpa_temperature()
    assert bench.camera.serial_number() == 93588


def test_a_change_that_is_answered_late_is_done_once(bench: BosonBench) -> None:
    """A late acknowledgement raises a timeout error, and the change is made once."""
    bench.spoil(Fault.LATE)
    with pytest.raises(BosonTimeoutError, match="set gain mode"):
        bench.camera.set(commands.GAIN_MODE, GainMode.LOW)
    assert bench.camera.get(commands.GAIN_MODE) is GainMode.LOW


def test_replies_may_come_byte_by_byte(bench: BosonBench) -> None:
    """Single bytes make whole replies."""
    bench.device.faults.single_bytes = True
    assert bench.camera.identity()["serial_number"] == "93588"


@pytest.mark.parametrize("stalls", [False, True])
def test_a_correction_is_waited_for(bench: BosonBench, stalls: bool) -> None:
    """A correction is awaited for the shutter's time, also while the camera does not answer."""
    bench.device.faults.ffc_stalls = stalls
    for number in (1, 2):
        start = bench.clock.now
        frame = bench.camera.run_ffc()
        assert FFC_DURATION <= bench.clock.now - start < FFC_DURATION + 0.2
        assert (bench.state.ffc_count, bench.state.last_ffc_frame) == (number, frame)
    assert bench.camera.ffc_status() is FfcStatus.COMPLETE


def test_a_correction_that_stalls_past_the_timeout_shifts_no_reply(bench: BosonBench) -> None:
    """Replies that a closed shutter delays past their time are not taken for later ones."""
    bench.device.faults.ffc_stalls = True
    bench.camera.timeout = 0.1
    bench.world.start_ffc("boson")
    assert bench.camera.read(commands.SERIAL_NUMBER, repeats=9) == 93588
    assert bench.camera.fpa_temperature() == pytest.approx(308.15, abs=0.05)


def test_a_correction_that_takes_too_long_is_an_error(bench: BosonBench) -> None:
    """A correction beyond its time limit raises an error that gives the limit."""
    with pytest.raises(BosonTimeoutError, match=r"No flat-field correction within 0\.2 s"):
        bench.camera.run_ffc(timeout=0.2)


def test_an_unplugged_camera_is_an_error(bench: BosonBench) -> None:
    """A reading of an unplugged camera raises a TransportError."""
    bench.state.plugged = False
    with pytest.raises(TransportError):
        bench.camera.serial_number()


@pytest.mark.parametrize("has_frames", [True, False])
def test_frames_are_counted_once(has_frames: bool) -> None:
    """The frame of a correction is on the count of the frame source, if there is one."""
    world = World(clock=(clock := Clock()))
    state = world.add_camera("boson", 7)
    state.has_frames, state.frame_count = has_frames, 41
    line = Line(EmulatedBoson(world, "boson"), clock)
    camera = Boson(line)
    clock.sleep(5)
    assert camera.run_ffc() == (41 if has_frames else 300)


def test_every_reply_comes_until_the_plug_is_pulled() -> None:
    """Byte by byte and with text between, a hundred replies are right; then the plug is pulled."""
    world = World()
    world.add_camera("boson", 2**32 - 1)
    device = FaultyBoson(world, "boson")
    device.faults.single_bytes = True
    device.faults.once = deque([Fault.DEBUG_TEXT, None] * 50)
    with Boson(Line(device, world.clock)) as camera:
        assert {camera.serial_number() for _ in range(100)} == {2**32 - 1}
        world.camera("boson").plugged = False
        with pytest.raises(TransportError, match="must stay connected"):
            camera.serial_number()
