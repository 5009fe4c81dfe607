"""The Boson's driver: byte for byte, with faults of camera and line, and for several threads."""

import struct
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from operator import methodcaller
from typing import Any, NoReturn

import pytest
from dialogue import Dialogue, Pair
from faulty_devices import BosonBench, reply, request
from hypothesis import given
from hypothesis import strategies as st
from test_codecs import FRAMES

from dbthermal.instruments import boson
from dbthermal.instruments.boson import Boson, BosonError, BosonTimeoutError, Reading
from dbthermal.instruments.camera import FfcStatus
from dbthermal.instruments.emulated import FFC_DURATION, World
from dbthermal.instruments.emulated.devices import EmulatedBoson
from dbthermal.instruments.transport import SYSTEM, TransportError

# Identifiers and layouts of openmv/openmv, drivers/boson (commit cbbb877): to read; to set, and
# the values from 0; the error numbers.
READINGS = {
    "SERIAL_NUMBER": (0x00050002, ">I"),
    "PART_NUMBER": (0x00050004, ">20s"),
    "SENSOR_SERIAL_NUMBER": (0x00050006, ">I"),
    "SOFTWARE_REVISION": (0x00050022, ">III"),
    "FPA_TEMPERATURE": (0x00050030, ">h"),
    "FFC_IN_PROGRESS": (0x0005000C, ">h"),
    "FFC_STATUS": (0x00050054, ">i"),
    "LAST_FFC_FRAME": (0x0005005D, ">I"),
}
SETTINGS = {
    "FFC_MODE": (0x00050012, "MANUAL AUTO EXTERNAL SHUTTER_TEST"),
    "GAIN_MODE": (0x00050014, "HIGH LOW AUTO DUAL MANUAL"),
    "TELEMETRY": (0x00040001, "OFF ON"),
    "TELEMETRY_LOCATION": (0x00040003, "TOP BOTTOM"),
    "IR16_MODE": (0x000E000D, "COUNTS_16 COUNTS_14 TLINEAR"),
}
STATES = "NONE_PERFORMED IMMINENT IN_PROGRESS COMPLETE"
STATUSES = [
    *(0x161, 0x162, 0x17D, 0x17E, 0x17F, 0x180, 0x181, 0x1B0, 0x201, 0x202, 0x203, 0x204),
    *(0x205, 0x206, 0x207, 0x208, 0x20B, 0x26D, 0x26E, 0x26F, 0x281, 0x283),
    *range(0x6A4, 0x6AE),
]
SERIAL, PART, FPA, SET_GAIN, STATUS = 0x50002, 0x50004, 0x50030, 0x50014, 0x50054
FOUND = {name: entry for name, entry in vars(boson).items() if isinstance(entry, Reading)}
# Public frames: serial number 93588, and 43.1 °C with an escaped checksum.
SERIAL_REQUEST, SERIAL_REPLY, ESCAPED_REPLY, *_ = map(bytes.fromhex, FRAMES)


@pytest.fixture
def bench() -> BosonBench:
    """An emulated camera in memory, on a clock of its own."""
    return BosonBench()


def test_commands_are_the_published_ones() -> None:
    """Readings, settings, states and errors have their published numbers, none of them twice."""
    modes = {name: (command + 1, ">i") for name, (command, _) in SETTINGS.items()}
    assert {name: (entry.command, entry.layout) for name, entry in FOUND.items()} == {
        **READINGS,
        **modes,
    }
    assert {*boson.SETTINGS} == {FOUND[name] for name in SETTINGS}
    assert [(state.value, state.name) for state in FfcStatus] == [*enumerate(STATES.split())]
    assert boson.RUN_FFC == 0x00050007
    assert [*boson.STATUSES] == STATUSES
    assert len({*boson.STATUSES.values()}) == len(STATUSES) - 9  # ten are of the flash memory


@pytest.mark.parametrize("name", SETTINGS)
def test_every_setting_is_kept(bench: BosonBench, name: str) -> None:
    """Every value is sent, and read back as set, and so is each reading; another is refused."""
    (command, members), setting = SETTINGS[name], FOUND[name]
    assert isinstance(setting, boson.Setting)
    kind: Any = setting.convert
    assert [(value.value, value.name) for value in kind] == [*enumerate(members.split())]
    for value in kind:
        bench.camera.set(setting, value)
        assert bench.camera.read(setting) is value
        with Dialogue([(request(1, command, struct.pack(">i", value)), reply(1, command))]) as line:
            Boson(line, first_sequence=1).set(setting, value)
    bench.state.serial_number = 0x8E9EAE81  # its bytes need escapes
    values = {reading.name: bench.camera.read(reading) for reading in FOUND.values()}
    assert (values["serial number"], values["part number"]) == (0x8E9EAE81, "EMULATED-BOSON-640")
    assert values["FFC status"] is FfcStatus.NONE_PERFORMED
    choices = f"0 .{kind(0).name}., 1 .{kind(1).name}."
    wrong: Any = -1
    with pytest.raises(ValueError, match=rf"Invalid {setting.name} -1\. Must be one of {choices}"):
        Boson(Dialogue([]), first_sequence=1).set(setting, wrong)


PIECES = [ESCAPED_REPLY[:17], ESCAPED_REPLY[17:18], ESCAPED_REPLY[18:]]
LATE = reply(1, FPA, b"\x00\x01") + reply(2, FPA, b"\x01\x7c")
OTHERS = reply(1, SERIAL, b"debug text", channel=0x99) + SERIAL_REQUEST  # and an echo
DAMAGED = SERIAL_REPLY[:-2] + b"\x11\xae"
# Dialogues that end in a value: reading, bytes, value. Other software reads FF85 as 6541.3 °C.
TALKS: list[tuple[Reading[Any], list[Pair], float]] = [
    (boson.SERIAL_NUMBER, [(SERIAL_REQUEST, SERIAL_REPLY)], 93588),
    (boson.FPA_TEMPERATURE, [(request(0, FPA), PIECES)], 43.1 + 273.15),
    (boson.FPA_TEMPERATURE, [(request(1, FPA), reply(1, FPA, b"\xff\x85"))], 260.85),
    (boson.FPA_TEMPERATURE, [(request(1, FPA), None), (request(2, FPA), LATE)], 311.15),
    (boson.SERIAL_NUMBER, [(SERIAL_REQUEST, OTHERS + SERIAL_REPLY)], 93588),
    (
        boson.SERIAL_NUMBER,
        [(SERIAL_REQUEST, DAMAGED), (request(2, SERIAL), reply(2, SERIAL, b"\0\0\0\7"))],
        7,
    ),
]


@pytest.mark.parametrize(("reading", "pairs", "value"), TALKS)
def test_dialogues_that_give_a_value(
    reading: Reading[Any], pairs: list[Pair], value: float
) -> None:
    """Public bytes are sent and understood, and what is no reply to the request is discarded."""
    first = int(pairs[0][0] != request(0, FPA))
    with Dialogue(pairs) as line:
        assert Boson(line, first_sequence=first).read(reading) == pytest.approx(value, abs=1e-9)


# What asks for the exchange of a command.
ASKED = {entry.command: methodcaller("read", entry) for entry in FOUND.values()}
ASKED[SET_GAIN] = methodcaller("set", boson.GAIN_MODE, boson.GainMode.LOW)
LOW_GAIN, ONE_BYTE = request(1, SET_GAIN, b"\x00\x00\x00\x01"), reply(1, SET_GAIN, b"\0")
MUTE: list[Pair] = [(request(n, SERIAL), None) for n in (1, 2, 3)]
ENDLESS: list[Pair] = [(SERIAL_REQUEST, [bytes(4096)] * (boson.MAXIMUM_RECEIVED // 4096 + 1))]


@pytest.mark.parametrize(
    ("command", "answer", "error", "message"),
    [
        (SERIAL, MUTE, BosonTimeoutError, "No reply to 'serial number' within 1 s"),
        (SERIAL, ENDLESS, BosonError, "within 65536 bytes"),
        (SERIAL, reply(1, FPA, b"\x01\x7c"), BosonError, "Must be of command 0x00050002"),
        (SERIAL, reply(1, SERIAL, b"\0\1"), BosonError, "of 2 bytes to .* Must have 4"),
        (SERIAL, reply(1, SERIAL, status=0x283), BosonError, "0x283, camera busy"),
        (SERIAL, reply(1, SERIAL, status=0x6A4), BosonError, "0x6A4, flash"),
        (SERIAL, reply(1, SERIAL, status=0x999), BosonError, "0x999, unknown"),
        (STATUS, reply(1, STATUS, b"\0\0\0\x09"), BosonError, "9 is not a valid FfcStatus"),
        (PART, reply(1, PART, b"\xff" * 20), BosonError, "Invalid reply to 'part number'"),
        (SET_GAIN, [(LOW_GAIN, None)], BosonTimeoutError, "No reply to 'set gain mode'"),
        (SET_GAIN, [(LOW_GAIN, ONE_BYTE)], BosonError, "reply of 1 bytes to 'set gain mode'"),
    ],
)
def test_exchanges_that_fail(
    command: int, answer: bytes | list[Pair], error: type[BosonError], message: str
) -> None:
    """A mute camera is asked three times, but set once; other replies are errors that say why."""
    pairs = [(request(1, command), answer)] if isinstance(answer, bytes) else answer
    with Dialogue(pairs) as line, pytest.raises(error, match=message):
        ASKED[command](Boson(line, first_sequence=1))


blobs = st.lists(st.binary(max_size=60), max_size=6)


@given(blobs)
def test_any_answer_is_a_value_or_a_documented_error(pieces: list[bytes]) -> None:
    """Any bytes give a number or a documented error; the emulator answers on after any bytes."""
    camera = Boson(Dialogue([(SERIAL_REQUEST, pieces)]), first_sequence=1)
    with suppress(BosonError):
        assert 0 <= camera.read(boson.SERIAL_NUMBER, repeats=0) < 2**32
    bench = BosonBench()
    for piece in pieces:
        bench.exchange(piece)
    assert bench.camera.serial_number() == 93588


@pytest.mark.parametrize(
    ("command", "data", "request_status"),
    [(0xFFFF, b"", 0xFFFFFFFF), (SERIAL, b"", 0), (SET_GAIN, b"\x00", 0xFFFFFFFF)],
)
def test_the_emulator_refuses_what_the_driver_never_sends(
    bench: BosonBench, command: int, data: bytes, request_status: int
) -> None:
    """Unknown commands, other frames and wrong sizes have a status, an echo and no data."""
    for sequence in (1, 0x8E9EAE00, 0x9E9E9E9E):
        answer = bench.exchange(request(sequence, command, data, status=request_status))
        assert answer == reply(sequence, command, status=0x161)


@pytest.mark.parametrize("stalls", [False, True])
def test_a_correction_is_waited_for(bench: BosonBench, stalls: bool) -> None:
    """A correction is awaited for the shutter's time, also while the camera does not answer."""
    replies, state = bench.device.poll, bench.state
    if stalls:
        vars(bench.device)["poll"] = lambda: [] if bench.clock() < state.ffc_until else replies()
    for number in (1, 2):
        start = bench.clock()
        frame = bench.camera.run_ffc()
        assert FFC_DURATION <= bench.clock() - start < FFC_DURATION + 0.2
        assert (state.ffc_count, state.last_ffc_frame) == (number, frame)
    assert bench.camera.ffc_status() is FfcStatus.COMPLETE
    state.has_frames, state.frame_count = True, 41
    assert bench.camera.run_ffc() == 41  # on the count of the frame source, if there is one


def test_a_correction_that_is_slow_to_start_is_waited_for() -> None:
    """The camera still says that the last correction is complete: not that of this one."""
    complete = (boson.FFC_STATUS.command, struct.pack(">i", FfcStatus.COMPLETE))
    last = boson.LAST_FFC_FRAME.command
    requests = [(last, struct.pack(">I", 700)), complete, (boson.RUN_FFC, b"")]
    for frame in (700, 700, 1234):
        busy = (boson.FFC_IN_PROGRESS.command, b"\x00\x00")
        requests += [busy, complete, (last, struct.pack(">I", frame))]
    pairs: list[Pair] = [
        (request(number, command), reply(number, command, data))
        for number, (command, data) in enumerate(requests, start=1)
    ]
    with Dialogue(pairs) as line:
        assert Boson(line, first_sequence=1).run_ffc() == 1234


@pytest.mark.parametrize("answers", [99, 3])
def test_a_correction_that_takes_too_long_is_an_error(bench: BosonBench, answers: int) -> None:
    """A wait outlasts its limit, which the error gives, by the time of one reply at most."""
    bench.camera.run_ffc()
    start, receive, remaining = bench.clock(), bench.device.receive, iter(range(answers))
    vars(bench.device)["receive"] = lambda data: next(remaining, -1) < 0 or receive(data)
    with pytest.raises(BosonTimeoutError, match=r"No flat-field correction within 0\.2 s"):
        bench.camera.run_ffc(timeout=0.2)
    assert bench.clock() - start <= 0.2 + boson.REPLY_TIMEOUT + 0.2


def test_each_program_begins_at_another_number() -> None:
    """The first sequence number depends on the time of day, which identifies stale replies."""
    sent = []
    for seconds in (0.0, 0.1):
        line = Dialogue([])
        line.clock.sleep(seconds)
        with pytest.raises(AssertionError, match=r"Unexpected 8e .* was written") as unexpected:
            Boson(line).serial_number()
        sent.append(str(unexpected.value))
    assert sent[0] != sent[1]


class Slow(EmulatedBoson):
    """A camera that takes its time, and counts requests before an answer or after its end."""

    overlaps, waits = 0, False

    def write(self, data: bytes) -> None:
        """Take one request."""
        self.overlaps += self.waits
        super().write(data)
        self.waits = True

    def read(self, size: int, timeout: float) -> bytes:
        """Answer late."""
        time.sleep(0.002)
        self.overlaps += self._closed
        self.waits = False
        return super().read(size, timeout)


def test_threads_take_turns_until_the_end() -> None:
    """Exchanges do not overlap, closing waits for one, and the next is a documented error."""
    world = World(clock=SYSTEM)
    world.add_camera("boson", 93588)
    camera = Boson(line := Slow(world, "boson"))

    def ask() -> NoReturn:
        while True:
            assert camera.serial_number() == 93588
            assert camera.fpa_temperature() == pytest.approx(308.15, abs=0.05)

    with ThreadPoolExecutor(2) as pool:
        asked = [pool.submit(ask) for _ in range(2)]
        time.sleep(0.2)
        for _ in range(2):
            camera.close()
    assert {type(future.exception()) for future in asked} == {TransportError}
    assert line.overlaps == 0
