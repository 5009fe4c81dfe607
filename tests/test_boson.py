"""The Boson's driver and its emulator: byte dialogues, faults, and a contract that all keep."""

import os
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from enum import IntEnum

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dbthermal.instruments import fslp
from dbthermal.instruments.boson import (
    Boson,
    BosonError,
    BosonReplyError,
    BosonStatusError,
    BosonTimeoutError,
    commands,
)
from dbthermal.instruments.boson.commands import (
    FfcMode,
    FfcStatus,
    GainMode,
    Ir16Mode,
    Setting,
    Switch,
    SyncMode,
)
from dbthermal.instruments.boson.link import MAXIMUM_RECEIVED
from dbthermal.instruments.dialogue import Dialogue, Pair
from dbthermal.instruments.emulated.boson import BOOT_DURATION, IMMINENT, EmulatedBoson
from dbthermal.instruments.emulated.boson_faults import DEBUG_CHANNEL, Fault
from dbthermal.instruments.emulated.port import EmulatedPort, Loop
from dbthermal.instruments.emulated.world import FFC_DURATION, World
from dbthermal.instruments.transport import TransportError

SERIAL, FPA, GAIN, SET_GAIN = 0x00050002, 0x00050030, 0x00050015, 0x00050014
SERIAL_REQUEST = bytes.fromhex("8E 00 00 00 00 01 00 05 00 02 FF FF FF FF 01 0B AE")
SERIAL_REPLY = bytes.fromhex("8E 00 00 00 00 01 00 05 00 02 00 00 00 00 00 01 6D 94 30 10 AE")
ESCAPED_REPLY = bytes.fromhex("8E 00 00 00 00 00 00 05 00 30 00 00 00 00 01 AF 9E 91 99 AE")


class Clock:
    """A time that only waiting moves."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        """Time [s]."""
        return self.now

    def sleep(self, duration: float) -> None:
        """Wait [s]."""
        self.now += duration


class Bench:
    """An emulated camera and its driver, on one clock."""

    def __init__(self, serial_number: int = 93588) -> None:
        self.clock = Clock()
        self.world = World(clock=self.clock)
        self.state = self.world.add_camera("boson", serial_number)
        self.device = EmulatedBoson(self.world, "boson")
        self.loop = Loop(self.device, clock=self.clock, sleep=self.clock.sleep)
        self.camera = Boson(self.loop, first_sequence=1, clock=self.clock, sleep=self.clock.sleep)

    def spoil(self, *faults: Fault | None) -> None:
        """Give the next requests these faults."""
        self.device.faults.once = deque(faults)

    def exchange(self, request: bytes) -> list[fslp.Frame]:
        """Send bytes past the driver and decode what comes back."""
        self.loop.write(request)
        return fslp.Decoder().feed(self.loop.read(4096, 0.1))


@pytest.fixture
def bench() -> Bench:
    """An emulated camera in memory, on a clock of its own."""
    return Bench()


def reply(sequence: int, command: int, data: bytes = b"", status: int = 0) -> bytes:
    """Bytes of a reply."""
    return fslp.encode(sequence, command, data, status)


def camera_of(pairs: list[Pair] | Dialogue, first_sequence: int = 1) -> Boson:
    """Driver that takes part in a dialogue."""
    dialogue = pairs if isinstance(pairs, Dialogue) else Dialogue(pairs)
    clock = Clock()
    return Boson(dialogue, first_sequence=first_sequence, clock=clock, sleep=clock.sleep)


# Dialogues: bytes that a driver must write, and what it makes of those that come.


def test_the_public_serial_number_is_read() -> None:
    """The public request is sent, and the public reply is serial number 93588."""
    with Dialogue([(SERIAL_REQUEST, SERIAL_REPLY)]) as line:
        assert camera_of(line).serial_number() == 93588


def test_the_public_escaped_temperature_is_read() -> None:
    """The public reply whose checksum is escaped is 43.1 °C, in any pieces."""
    pieces = [ESCAPED_REPLY[:17], ESCAPED_REPLY[17:18], ESCAPED_REPLY[18:]]
    with Dialogue([(fslp.encode(0, FPA), pieces)]) as line:
        kelvin = camera_of(line, first_sequence=0).fpa_temperature()
    assert kelvin == pytest.approx(43.1 + 273.15, abs=1e-9)


def test_a_temperature_below_zero_celsius_has_a_sign() -> None:
    """FF85 is -12.3 °C, which other software reads as 6541.3 °C."""
    with Dialogue([(fslp.encode(1, FPA), reply(1, FPA, b"\xff\x85"))]) as line:
        assert camera_of(line).fpa_temperature() == pytest.approx(260.85, abs=1e-9)


def test_a_late_reply_is_not_taken_for_the_next() -> None:
    """A reply that comes after its time is discarded, and the question asked anew."""
    both = reply(1, FPA, b"\x00\x01") + reply(2, FPA, b"\x01\x7c")
    with Dialogue([(fslp.encode(1, FPA), None), (fslp.encode(2, FPA), both)]) as line:
        camera = camera_of(line)
        assert camera.fpa_temperature() == pytest.approx(311.15, abs=1e-9)
    assert (camera.statistics.timeouts, camera.statistics.discarded) == (1, 1)


def test_frames_of_other_channels_and_echoes_are_discarded() -> None:
    """Debug text and the request itself are no reply."""
    text = fslp.encode(1, SERIAL, b"text", 0, channel=DEBUG_CHANNEL)
    with Dialogue([(SERIAL_REQUEST, text + SERIAL_REQUEST + SERIAL_REPLY)]) as line:
        camera = camera_of(line)
        assert camera.serial_number() == 93588
    assert camera.statistics.discarded == 2


def test_a_damaged_reply_is_asked_for_again() -> None:
    """A wrong checksum is as good as no reply, and is counted."""
    spoilt = SERIAL_REPLY[:-2] + b"\x11\xae"
    again = (fslp.encode(2, SERIAL), reply(2, SERIAL, b"\x00\x00\x00\x07"))
    with Dialogue([(SERIAL_REQUEST, spoilt), again]) as line:
        camera = camera_of(line)
        assert camera.serial_number() == 7
    assert camera.statistics.damaged == 1


def test_a_mute_camera_is_asked_three_times() -> None:
    """Readings are asked for again twice, then it is an error that says how long it took."""
    line = Dialogue([(fslp.encode(n, SERIAL), None) for n in (1, 2, 3)])
    with pytest.raises(BosonTimeoutError, match="No reply to 'serial number' within 1 s"):
        camera_of(line).serial_number()
    line.finish()


def test_a_change_is_sent_once() -> None:
    """What changes the camera is never repeated: it may have been done."""
    line = Dialogue([(fslp.encode(1, SET_GAIN, b"\x00\x00\x00\x01"), None)])
    with pytest.raises(BosonTimeoutError, match="No reply to 'set gain mode'"):
        camera_of(line).set(commands.GAIN_MODE, GainMode.LOW)
    line.finish()


@pytest.mark.parametrize(
    ("status", "text"),
    [(0x203, "value out of range"), (0x283, "camera busy"), (0x6A4, "flash"), (0x999, "unknown")],
)
def test_a_refusal_says_why(status: int, text: str) -> None:
    """The status of an error is in the exception, and its meaning in the message."""
    camera = camera_of([(SERIAL_REQUEST, reply(1, SERIAL, status=status))])
    with pytest.raises(BosonStatusError, match=f"status 0x{status:X}, {text}") as refusal:
        camera.serial_number()
    assert refusal.value.status == status


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (reply(1, FPA, b"\x01\x7c"), "of command 0x00050030. Must be of command 0x00050002"),
        (reply(1, SERIAL, b"\x00\x01"), "Invalid serial number of 2 bytes. Must have 4"),
        (reply(1, SERIAL, bytes(5)), "Invalid serial number of 5 bytes. Must have 4"),
    ],
)
def test_a_reply_that_is_none_is_an_error(answer: bytes, message: str) -> None:
    """A reply to another command, or of the wrong size, is not believed."""
    with pytest.raises(BosonReplyError, match=message.replace(".", r"\.")):
        camera_of([(SERIAL_REQUEST, answer)]).serial_number()


def test_a_value_without_meaning_is_an_error() -> None:
    """A status of 9 and a part number that is no text are errors."""
    wrong = reply(1, 0x00050054, b"\x00\x00\x00\x09")
    with pytest.raises(BosonReplyError, match="9 is not a valid FfcStatus"):
        camera_of([(fslp.encode(1, 0x00050054), wrong)]).ffc_status()
    wrong = reply(1, 0x00050004, b"\xff" * 20)
    with pytest.raises(BosonReplyError, match="Invalid reply to 'part number'"):
        camera_of([(fslp.encode(1, 0x00050004), wrong)]).read(commands.PART_NUMBER)


def test_an_acknowledgement_with_data_is_an_error() -> None:
    """Nobody knows what they would mean."""
    camera = camera_of([(fslp.encode(1, 0x00050007), reply(1, 0x00050007, b"\x00"))])
    with pytest.raises(BosonReplyError, match="Invalid reply of 1 bytes to 'run FFC'"):
        camera.start_ffc()


def test_a_line_that_never_ends_is_an_error() -> None:
    """However much comes that is no reply, the wait for one has an end."""
    camera = camera_of([(SERIAL_REQUEST, [bytes(4096)] * (MAXIMUM_RECEIVED // 4096 + 1))])
    with pytest.raises(BosonReplyError, match="within 65536 bytes"):
        camera.serial_number()


@given(st.lists(st.binary(max_size=60), max_size=6))
def test_any_answer_is_a_value_or_a_documented_error(answer: list[bytes]) -> None:
    """Whatever bytes come, the driver gives a number or one of its own errors, and ends."""
    camera = camera_of([(SERIAL_REQUEST, answer)])
    with suppress(BosonError):
        camera._read(commands.SERIAL_NUMBER, repeats=0)


@pytest.mark.parametrize("setting", commands.SETTINGS, ids=lambda setting: setting.name)
def test_what_is_not_allowed_is_not_sent(setting: Setting[int]) -> None:
    """A value outside the range of a setting is refused before a byte is written."""
    with pytest.raises(ValueError, match=r"Invalid .* -1\. Must be one of"):
        camera_of([]).set(setting, -1)


def test_the_message_of_a_wrong_value_names_the_right_ones() -> None:
    """The choices are in the message."""
    choices = r"Invalid gain mode 7\. Must be one of 0 \(HIGH\), 1 \(LOW\), 2 \(AUTO\)"
    with pytest.raises(ValueError, match=choices):
        commands.GAIN_MODE.data(7)


def test_commands_are_the_public_ones() -> None:
    """No identifier is used twice, and some are as published."""
    used = [reading.command for reading in commands.READINGS]
    used += [number for s in commands.SETTINGS for number in (s.command, s.set_command)]
    assert len({*used}) == len(used)
    assert (commands.IR16_MODE.set_command, commands.IR16_MODE.command) == (0xE000D, 0xE000E)
    assert commands.IR16_MODE.data(Ir16Mode.TLINEAR) == b"\x00\x00\x00\x02"
    assert (commands.AVERAGER.set_command, commands.SYNC_MODE.set_command) == (0xB, 0x50098)


# The emulator behind the driver: what faults look like to a user.


@pytest.mark.parametrize("setting", commands.SETTINGS, ids=lambda setting: setting.name)
def test_every_setting_is_kept(bench: Bench, setting: Setting[int]) -> None:
    """What is set is read back."""
    members = [*setting.kind] if issubclass(setting.kind, IntEnum) else [2, 8]
    for value in members:
        bench.camera.set(setting, value)
        assert bench.camera.get(setting) == value


def test_every_reading_has_a_value(bench: Bench) -> None:
    """All readings are answered, at values whose bytes need escapes too."""
    bench.state.serial_number = 0x8E9EAE81
    bench.state.fpa_temperature = bench.state.last_ffc_temperature = 0x0C9E / 10
    values = {reading.name: bench.camera.read(reading) for reading in commands.READINGS}
    assert values["serial number"] == 0x8E9EAE81
    assert values["FPA temperature [K]"] == pytest.approx(323.0, abs=0.05)
    assert values["FFC status"] is FfcStatus.NONE_PERFORMED
    assert values["part number"] == "EMULATED-BOSON-640"


@pytest.mark.parametrize("sequence", [0x8E9EAE00, 0x0000AE8E, 0x9E9E9E9E])
def test_the_emulator_echoes_any_sequence_number(bench: Bench, sequence: int) -> None:
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
        (0x0000000D, b"\x00\x03", fslp.REQUEST, 0x203),
    ],
)
def test_the_emulator_refuses_as_a_camera_does(
    bench: Bench, command: int, data: bytes, request_status: int, status: int
) -> None:
    """Unknown commands, wrong sizes and wrong values have their status and no data."""
    frames = bench.exchange(fslp.encode(1, command, data, request_status))
    assert frames == [fslp.Frame(0, 1, command, status)]


@pytest.mark.parametrize(
    "noise", [b"\x00\x11", SERIAL_REQUEST[:9], SERIAL_REQUEST[:-2] + b"\0\xae"]
)
def test_the_emulator_listens_on_after_noise(bench: Bench, noise: bytes) -> None:
    """Rubbish, a frame cut short, and one with a wrong checksum are not answered."""
    other = fslp.encode(5, SERIAL, channel=1)
    assert [f.sequence for f in bench.exchange(noise + other + SERIAL_REQUEST)] == [1]


@given(st.lists(st.binary(max_size=60), max_size=6))
def test_the_emulator_takes_any_bytes(pieces: list[bytes]) -> None:
    """Whatever is written, it does not fail, and answers the next good request."""
    bench = Bench()
    for piece in pieces:
        bench.loop.write(piece)
        bench.loop.read(4096, 0.0)
    assert bench.camera.serial_number() == 93588


@pytest.mark.parametrize(
    ("fault", "timeouts", "discarded", "damaged"),
    [
        (Fault.DROP, 1, 0, 0),
        (Fault.LATE, 1, 1, 0),
        (Fault.HOLD, 1, 1, 0),
        (Fault.BAD_CHECKSUM, 1, 0, 1),
        (Fault.ILLEGAL_ESCAPE, 1, 0, 1),
        (Fault.CUT, 1, 0, 1),
        (Fault.DEBUG_TEXT, 0, 1, 0),
    ],
)
def test_a_fault_of_the_line_is_overcome_and_counted(
    bench: Bench, fault: Fault, timeouts: int, discarded: int, damaged: int
) -> None:
    """The right value is read in spite of it, and the next one too; the statistics tell."""
    bench.spoil(fault)
    assert bench.camera.fpa_temperature() == pytest.approx(308.15, abs=0.05)
    assert bench.camera.serial_number() == 93588
    found = bench.camera.statistics
    assert (found.timeouts, found.discarded, found.damaged) == (timeouts, discarded, damaged)


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        (Fault.WRONG_COMMAND, BosonReplyError),
        (Fault.SHORT, BosonReplyError),
        (Fault.BUSY, BosonStatusError),
    ],
)
def test_a_fault_of_the_camera_is_an_error(
    bench: Bench, fault: Fault, error: type[BosonError]
) -> None:
    """A reply of another command, a short one and a refusal reach the user; the line goes on."""
    bench.spoil(fault)
    with pytest.raises(error):
        bench.camera.fpa_temperature()
    assert bench.camera.serial_number() == 93588


def test_a_change_that_is_answered_late_is_done_once(bench: Bench) -> None:
    """The user is told that no reply came, and finds the change made."""
    bench.spoil(Fault.LATE)
    with pytest.raises(BosonTimeoutError, match="set gain mode"):
        bench.camera.set(commands.GAIN_MODE, GainMode.LOW)
    assert bench.camera.get(commands.GAIN_MODE) is GainMode.LOW


def test_replies_may_come_byte_by_byte(bench: Bench) -> None:
    """Single bytes make whole replies."""
    bench.device.faults.single_bytes = True
    assert bench.camera.identity().serial_number == 93588


@pytest.mark.parametrize("stalls", [False, True])
def test_a_correction_is_waited_for(bench: Bench, stalls: bool) -> None:
    """It takes as long as the shutter does, whether or not the camera answers meanwhile."""
    bench.device.faults.ffc_stalls = stalls
    for number in (1, 2):
        start = bench.clock.now
        frame = bench.camera.run_ffc()
        assert FFC_DURATION <= bench.clock.now - start < FFC_DURATION + 0.2
        assert (bench.state.ffc_count, bench.state.last_ffc_frame) == (number, frame)
    assert bench.camera.ffc_status() is FfcStatus.COMPLETE


def test_a_correction_that_stalls_past_the_timeout_shifts_no_reply(bench: Bench) -> None:
    """Replies that a closed shutter delays past their time are not taken for later ones."""
    bench.device.faults.ffc_stalls = True
    bench.camera._link.timeout = 0.1
    bench.camera.start_ffc()
    assert bench.camera._read(commands.SERIAL_NUMBER, repeats=9) == 93588
    assert bench.camera.fpa_temperature() == pytest.approx(308.15, abs=0.05)
    assert bench.camera.statistics.discarded == bench.camera.statistics.timeouts > 0


def test_a_correction_that_takes_too_long_is_an_error(bench: Bench) -> None:
    """The wait has an end that the message names."""
    with pytest.raises(BosonTimeoutError, match=r"No flat-field correction within 0\.2 s"):
        bench.camera.run_ffc(timeout=0.2)


@pytest.mark.parametrize("reason", ["temperature", "frames"])
def test_the_camera_corrects_itself(bench: Bench, reason: str) -> None:
    """In automatic mode a drift or a number of frames starts one, after it said so."""
    if reason == "temperature":
        bench.state.fpa_temperature += 2.5
    else:
        bench.state.frame_count += 18000
    assert bench.camera.read(commands.FFC_DESIRED) == 1
    assert bench.camera.ffc_status() is FfcStatus.IMMINENT
    bench.clock.sleep(IMMINENT)
    assert bench.camera.ffc_status() is FfcStatus.IN_PROGRESS
    assert bench.camera.read(commands.FFC_IN_PROGRESS) is Switch.ON
    bench.clock.sleep(FFC_DURATION)
    assert bench.camera.ffc_status() is FfcStatus.COMPLETE


def test_the_camera_leaves_it_to_the_user_in_manual_mode(bench: Bench) -> None:
    """In manual mode a drift makes a correction desired, and no more."""
    bench.camera.set(commands.FFC_MODE, FfcMode.MANUAL)
    bench.state.fpa_temperature += 5
    bench.clock.sleep(60)
    assert bench.camera.read(commands.FFC_DESIRED) == 1
    assert bench.camera.ffc_status() is FfcStatus.NONE_PERFORMED


def test_pulses_are_followed_if_they_come(bench: Bench) -> None:
    """Slave mode stays once frames are counted."""
    bench.camera.follow_pulses()
    assert bench.camera.get(commands.SYNC_MODE) is SyncMode.SLAVE


def test_pulses_that_do_not_come_are_an_error(bench: Bench) -> None:
    """Without frames synchronisation is disabled again, and the user is told."""
    bench.device.faults.pulses = False
    with pytest.raises(BosonError, match=r"No external pulses: .* was disabled again"):
        bench.camera.follow_pulses()
    assert bench.camera.get(commands.SYNC_MODE) is SyncMode.DISABLED
    before = bench.camera.frame_count()
    bench.clock.sleep(1.0)
    assert bench.camera.frame_count() == before + 60


def test_a_camera_is_mute_while_it_boots(bench: Bench) -> None:
    """It is asked until it answers, which takes as long as booting does."""
    assert bench.camera.reboot()
    assert not bench.device.streaming
    start = bench.clock.now
    assert bench.camera.wait_until_booted() == 93588
    assert BOOT_DURATION <= bench.clock.now - start < BOOT_DURATION + 1.1


def test_a_camera_that_does_not_boot_is_an_error(bench: Bench) -> None:
    """The wait has an end; a reboot without acknowledgement says so."""
    bench.spoil(Fault.DROP)
    assert not bench.camera.reboot()
    with pytest.raises(BosonTimeoutError, match="No answer within 1 s"):
        bench.camera.wait_until_booted(timeout=1.0)


def test_settings_are_lost_unless_they_are_saved(bench: Bench) -> None:
    """Flash memory is written when it is asked for, and never else."""
    bench.camera.set(commands.AVERAGER, Switch.ON)
    bench.camera.reboot()
    bench.camera.wait_until_booted()
    assert (bench.camera.get(commands.AVERAGER), bench.device.flash_writes) == (Switch.OFF, 0)
    bench.camera.set(commands.AVERAGER, Switch.ON)
    bench.camera.save_defaults()
    bench.camera.reboot()
    bench.camera.wait_until_booted()
    assert (bench.camera.get(commands.AVERAGER), bench.device.flash_writes) == (Switch.ON, 1)


def test_an_unplugged_camera_is_an_error(bench: Bench) -> None:
    """No question is repeated to a camera that is gone."""
    bench.state.plugged = False
    with pytest.raises(TransportError):
        bench.camera.serial_number()


def test_an_emulated_frame_source_counts_the_frames() -> None:
    """Where frames come from a source, the camera reports the source's count."""
    world = World(clock=(clock := Clock()))
    state = world.add_camera("boson", 7)
    device = EmulatedBoson(world, "boson", free_running=False)
    camera = Boson(Loop(device, clock=clock, sleep=clock.sleep), clock=clock, sleep=clock.sleep)
    state.frame_count = 41
    clock.sleep(5)
    assert camera.frame_count() == 41


# What every camera keeps: in memory, on a pseudo-terminal, and a real one if there is one.


@pytest.fixture(params=["loop", "port", pytest.param("hardware", marks=pytest.mark.hardware)])
def camera(request: pytest.FixtureRequest) -> Iterator[Boson]:
    """A camera of each kind; DBTHERMAL_BOSON names a real one, serial:///dev/ttyACM0 for one."""
    urls = {"port": "sim://boson?sn=93588", "hardware": os.environ.get("DBTHERMAL_BOSON", "")}
    made = Bench().camera if request.param == "loop" else Boson.from_url(urls[request.param])
    with made as camera:
        yield camera


def test_a_camera_says_who_it_is(camera: Boson) -> None:
    """It has a serial number that stays, and says whether it is emulated."""
    identity = camera.identity()
    assert identity.serial_number == camera.wait_until_booted() > 0
    assert identity.is_simulated == ("EMULATED" in identity.part_number)


def test_a_camera_has_a_temperature(camera: Boson) -> None:
    """Both ways to ask for it agree within their steps and what it drifts meanwhile."""
    other = camera.read(commands.FPA_TEMPERATURE_KELVIN)
    assert camera.fpa_temperature() == pytest.approx(other, abs=0.5)
    assert 220 < other < 380


def test_a_camera_counts_frames(camera: Boson) -> None:
    """The count rises, at the frame rate or a part of it."""
    before = camera.frame_count()
    camera._sleep(0.2)
    assert 0 < camera.frame_count() - before < 30


def test_a_camera_corrects_its_offsets(camera: Boson) -> None:
    """A correction ends, and has the number of a frame after the last."""
    before = camera.read(commands.LAST_FFC_FRAME)
    camera._sleep(0.05)
    assert camera.run_ffc() > before
    assert camera.ffc_status() is FfcStatus.COMPLETE


def test_a_camera_keeps_a_mode(camera: Boson) -> None:
    """The shutter's mode is set and read back."""
    before = camera.get(commands.FFC_MODE)
    camera.set(commands.FFC_MODE, FfcMode.MANUAL)
    assert camera.get(commands.FFC_MODE) is FfcMode.MANUAL
    camera.set(commands.FFC_MODE, before)


def test_a_pseudo_terminal_brings_every_reply_until_it_hangs_up() -> None:
    """Byte by byte and with text between, a hundred replies are right; then the plug is pulled."""
    world = World()
    world.add_camera("boson", 93588)
    device = EmulatedBoson(world, "boson")
    device.faults.single_bytes = True
    device.faults.once = deque([Fault.DEBUG_TEXT, None] * 50)
    with EmulatedPort(device) as port, Boson.from_url(f"pty://{port.path}") as camera:
        assert {camera.serial_number() for _ in range(100)} == {93588}
        assert camera.statistics.discarded == 50
        world.camera("boson").plugged = False
        with pytest.raises(TransportError, match="must stay connected"):
            camera.serial_number()


def test_independent_software_understands_the_emulator() -> None:
    """Flirpy 0.6.2, unchanged, reads and sets; its known error of the sign is seen, too."""
    flirpy = pytest.importorskip("flirpy.camera.boson", reason="flirpy is only for this check")
    world = World()
    state = world.add_camera("boson", 93588)
    state.fpa_temperature = state.last_ffc_temperature = 273.15 + 43.1  # its checksum is escaped
    with EmulatedPort(EmulatedBoson(world, "boson")) as port:
        camera = flirpy.Boson(port=port.path)
        assert (camera.get_camera_serial(), camera.get_fpa_temperature()) == (93588, 43.1)
        assert camera.get_part_number().strip("\0 ") == "EMULATED-BOSON-640"
        camera.set_ffc_manual()
        camera.do_ffc()
        assert (camera.get_ffc_mode(), camera.get_ffc_state(), state.ffc_count) == (0, 1, 1)
        state.fpa_temperature = 260.85
        assert camera.get_fpa_temperature() == 6541.3
        camera.close()
