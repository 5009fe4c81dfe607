"""The Boson: its frames and commands, its driver in dialogues, and its driver on the emulator."""

import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from itertools import pairwise
from typing import Any

import pytest
from device_benches import DEBUG_CHANNEL, BosonBench, Clock, Fault, FaultyBoson
from dialogue import Dialogue, Pair
from hypothesis import given
from hypothesis import strategies as st

from dbthermal.instruments import _fslp as fslp
from dbthermal.instruments._fslp import (
    MAXIMUM_DATA,
    MAXIMUM_FRAME,
    Decoder,
    Frame,
    checksum,
    encode,
    next_sequence,
)
from dbthermal.instruments.boson import (
    MAXIMUM_RECEIVED,
    REPLY_TIMEOUT,
    Boson,
    BosonError,
    BosonReplyError,
    BosonStatusError,
    BosonTimeoutError,
    commands,
)
from dbthermal.instruments.boson.commands import Ir16Mode, Reading, Setting
from dbthermal.instruments.camera import FfcStatus, GainMode
from dbthermal.instruments.clock import SYSTEM
from dbthermal.instruments.emulated.boson import EmulatedBoson
from dbthermal.instruments.emulated.line import Line
from dbthermal.instruments.emulated.world import FFC_DURATION, World
from dbthermal.instruments.transport import Closing, TransportError

REQUEST = 0xFFFFFFFF
# Quoted in thurberdog/ghostCommand, but the third: LJMUAstroecology/flirpy, issue 21.
SERIAL_REQUEST = bytes.fromhex("8E 00 00 00 00 01 00 05 00 02 FF FF FF FF 01 0B AE")
SERIAL_REPLY = bytes.fromhex("8E 00 00 00 00 01 00 05 00 02 00 00 00 00 00 01 6D 94 30 10 AE")
ESCAPED_REPLY = bytes.fromhex("8E 00 00 00 00 00 00 05 00 30 00 00 00 00 01 AF 9E 91 99 AE")
FPA_REQUEST = bytes.fromhex("8E 00 00 00 00 01 00 05 00 30 FF FF FF FF 49 66 AE")
FPA_REPLY = bytes.fromhex("8E 00 00 00 00 01 00 05 00 30 00 00 00 00 01 7C BD CE AE")
VECTORS = [
    (SERIAL_REQUEST, Frame(0, 1, 0x00050002, REQUEST)),
    (SERIAL_REPLY, Frame(0, 1, 0x00050002, 0, (93588).to_bytes(4, "big"))),
    (ESCAPED_REPLY, Frame(0, 0, 0x00050030, 0, (431).to_bytes(2, "big"))),
    (FPA_REQUEST, Frame(0, 1, 0x00050030, REQUEST)),
    (FPA_REPLY, Frame(0, 1, 0x00050030, 0, (380).to_bytes(2, "big"))),
]

# Special bytes, and those that follow an escape, are as likely as all others together.
telling_bytes = st.one_of(
    st.sampled_from([0x8E, 0xAE, 0x9E, 0x81, 0xA1, 0x91, 0x00]), st.integers(0, 255)
)
blobs = st.lists(telling_bytes, max_size=40).map(bytes)
words = st.lists(telling_bytes, min_size=4, max_size=4).map(lambda b: int.from_bytes(bytes(b)))
frames = st.builds(Frame, telling_bytes, words, words, words, blobs)


def encoded(frame: Frame) -> bytes:
    """Encode a frame as it is."""
    return encode(frame.sequence, frame.command, frame.data, frame.status, channel=frame.channel)


def cut(stream: bytes, places: list[int]) -> list[bytes]:
    """Cut a stream at these places."""
    edges = [0, *sorted(place % (len(stream) + 1) for place in places), len(stream)]
    return [stream[start:stop] for start, stop in pairwise(edges)]


@pytest.mark.parametrize(("sent", "frame"), VECTORS)
def test_public_frames_are_read_and_written(sent: bytes, frame: Frame) -> None:
    """Each public frame is what encoding gives, and decoding gives it back."""
    decoder = Decoder()
    assert encoded(frame) == sent
    assert decoder.feed(sent) == [frame]
    assert (decoder.damaged, decoder.is_open) == (0, False)


def test_checksum_is_the_published_kind() -> None:
    """CRC-16/AUG-CCITT has the check value E5CC."""
    assert checksum(b"123456789") == 0xE5CC


def test_a_checksum_is_escaped() -> None:
    """The request 0002001C has the checksum 389E, whose last byte needs an escape."""
    assert encode(0, 0x0002001C)[-5:] == bytes.fromhex("FF 38 9E 91 AE")


def test_each_special_byte_is_escaped_everywhere() -> None:
    """Start, end and escape byte are replaced in header, status and data."""
    sent = encode(0x8E, 0x9E, b"\xae", 0x8E9EAE00)
    content = bytes.fromhex("00 000000 9E81 000000 9E91 9E81 9E91 9EA1 00 9EA1")
    assert sent[1 : 1 + len(content)] == content
    assert not {0x8E, 0xAE} & {*sent[1:-1]}


def test_the_shortest_frame_has_17_bytes() -> None:
    """Without data a frame is 17 bytes long, unless some are escaped."""
    assert len(SERIAL_REQUEST) == len(encode(0, 0)) == 17


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ({"sequence": 1 << 32}, "Invalid sequence number 4294967296"),
        ({"command": -1}, "Invalid command -1. Must lie in 0 to 4294967295"),
        ({"channel": 256}, "Invalid channel 256"),
        ({"data": bytes(MAXIMUM_DATA + 1)}, "Invalid data of 752 bytes. Must be at most 751"),
    ],
)
def test_what_does_not_fit_is_refused(field: dict[str, int], message: str) -> None:
    """Numbers that do not fit their field, and too many data, are errors."""
    with pytest.raises(ValueError, match=message):
        encode(**{"sequence": 0, "command": 0, **field})  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", [bytes, bytearray, memoryview])
def test_any_kind_of_bytes_is_taken(kind: type) -> None:
    """Data and stream may be of any kind that holds bytes; no bytes complete no frame."""
    decoder = Decoder()
    assert decoder.feed(kind(encode(1, 0x00050002, kind(b"\x8e"), 0))) == [
        Frame(0, 1, 0x00050002, 0, b"\x8e")
    ]
    assert decoder.feed(kind(b"")) == []


@pytest.mark.parametrize("wrong", [1.5, float("nan"), "1", None])
def test_a_number_must_be_whole(wrong: object) -> None:
    """Nothing is rounded into a field."""
    with pytest.raises(TypeError, match="cannot be interpreted as an integer"):
        encode(wrong, 0x00050002)  # type: ignore[arg-type]


@given(st.lists(frames, max_size=4), st.lists(st.integers(0, 999), max_size=6), blobs)
def test_frames_survive_any_cutting(sent: list[Frame], places: list[int], noise: bytes) -> None:
    """Frames are decoded in order however the stream is cut, with noise between them."""
    between = bytes(byte for byte in noise if byte != 0x8E)
    stream = b"".join(between + encoded(frame) for frame in sent)
    decoder = Decoder()
    assert [frame for piece in cut(stream, places) for frame in decoder.feed(piece)] == sent
    assert (decoder.damaged, decoder.is_open) == (0, False)


@given(st.lists(blobs, max_size=8))
def test_any_bytes_are_taken(pieces: list[bytes]) -> None:
    """Every start byte begins a frame that is decoded, counted as damaged, or open."""
    decoder = Decoder()
    found = [frame for piece in pieces for frame in decoder.feed(piece)]
    starts = b"".join(pieces).count(0x8E)
    assert starts == len(found) + decoder.damaged + decoder.is_open
    assert all(encoded(frame) for frame in found)


@given(blobs)
def test_a_good_frame_is_found_after_any_bytes(noise: bytes) -> None:
    """A start byte begins anew, whatever came before it."""
    assert Decoder().feed(noise + SERIAL_REPLY)[-1] == VECTORS[1][1]


@pytest.mark.parametrize("sent", [SERIAL_REPLY, ESCAPED_REPLY, FPA_REPLY])
def test_a_flipped_bit_is_never_believed(sent: bytes) -> None:
    """No frame with one wrong bit is returned, and the next good one is."""
    for bit in range(8 * len(sent)):
        spoilt = (int.from_bytes(sent) ^ 1 << bit).to_bytes(len(sent))
        assert Decoder().feed(spoilt + SERIAL_REQUEST) == [VECTORS[0][1]]


@pytest.mark.parametrize(
    "sent",
    [
        SERIAL_REPLY[:-4] + SERIAL_REPLY[:1],  # cut short by the next start
        SERIAL_REPLY[:-1] + b"\x9e\x00\xae",  # no such escape
        SERIAL_REPLY[:-1] + b"\x9e\xae",  # an escape of nothing
        SERIAL_REPLY[:-2] + b"\x11\xae",  # wrong checksum
        b"\x8e\xae",  # empty
        b"\x8e" + bytes(MAXIMUM_FRAME + 1) + b"\xae",  # without end
    ],
)
def test_a_damaged_frame_is_dropped_and_counted(sent: bytes) -> None:
    """Each kind of damage drops the frame, and counts one."""
    decoder = Decoder()
    assert decoder.feed(sent) == []
    assert decoder.damaged == 1
    assert decoder.feed(SERIAL_REPLY) == [VECTORS[1][1]]


def test_the_longest_frame_is_read() -> None:
    """A frame of the longest size is decoded, and one byte more is an error."""
    for size, found in ((MAXIMUM_FRAME, 1), (MAXIMUM_FRAME + 1, 0)):
        body = bytes(size - 2)
        sent = b"\x8e" + body + checksum(body).to_bytes(2) + b"\xae"
        assert not {0x8E, 0x9E, 0xAE} & {*sent[1:-1]}
        assert len(Decoder().feed(sent)) == found
    assert MAXIMUM_FRAME == 2048


@given(st.integers(0, (1 << 32) - 1))
def test_sequence_numbers_need_no_escape(sequence: int) -> None:
    """The number after any other is larger, but at the end, and holds no special byte."""
    following = next_sequence(sequence)
    assert not {0x8E, 0x9E, 0xAE} & {*following.to_bytes(4)}
    assert following > sequence or sequence == (1 << 32) - 1


def test_sequence_numbers_skip_as_few_as_needed() -> None:
    """The numbers that would be escaped are left out, and no others."""
    assert [next_sequence(n) for n in (0, 0x8D, 0xADFF, 0xFFFFFFFF)] == [1, 0x8F, 0xAF00, 0]


# Identifiers and layouts of openmv/openmv, drivers/boson (commit cbbb877): to read; to set and to
# read, and the values; to do.
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
    "FFC_MODE": (0x00050012, 0x00050013, ">i", ("MANUAL", "AUTO", "EXTERNAL", "SHUTTER_TEST")),
    "GAIN_MODE": (0x00050014, 0x00050015, ">i", ("HIGH", "LOW", "AUTO", "DUAL", "MANUAL")),
    "TELEMETRY": (0x00040001, 0x00040002, ">i", ("OFF", "ON")),
    "TELEMETRY_LOCATION": (0x00040003, 0x00040004, ">i", ("TOP", "BOTTOM")),
    "IR16_MODE": (0x000E000D, 0x000E000E, ">i", ("COUNTS_16", "COUNTS_14", "TLINEAR")),
}
STATUSES = [
    *(0x161, 0x162, 0x17D, 0x17E, 0x17F, 0x180, 0x181, 0x1B0, 0x201, 0x202, 0x203, 0x204),
    *(0x205, 0x206, 0x207, 0x208, 0x20B, 0x26D, 0x26E, 0x26F, 0x281, 0x283),
    *range(0x6A4, 0x6AE),
]


def of_kind(kind: type) -> dict[str, object]:
    """All commands of a kind, by name."""
    return {name: value for name, value in vars(commands).items() if isinstance(value, kind)}


def test_readings_are_the_published_ones() -> None:
    """Each reading has the published identifier and layout."""
    found = {
        name: (reading.command, reading.layout)
        for name, reading in of_kind(Reading).items()
        if isinstance(reading, Reading)
    }
    assert found == READINGS


def test_settings_are_the_published_ones() -> None:
    """Each setting has the published identifiers, layout and values, numbered from 0."""
    found = {}
    for name, setting in of_kind(Setting).items():
        assert isinstance(setting, Setting)
        kind: Any = setting.kind
        members = [*kind]
        assert [member.value for member in members] == [*range(len(members))]
        values = tuple(member.name for member in members)
        reading = setting.reading
        found[name] = (setting.set_command, reading.command, reading.layout, values)
    assert found == SETTINGS


def test_the_correction_is_the_published_one() -> None:
    """The command that starts it has the published identifier, its states their numbers."""
    assert commands.RUN_FFC == 0x00050007
    assert [state.name for state in FfcStatus] == [
        *("NONE_PERFORMED", "IMMINENT", "IN_PROGRESS", "COMPLETE")
    ]
    assert [state.value for state in FfcStatus] == [0, 1, 2, 3]


def test_statuses_are_the_published_ones() -> None:
    """Each published status has a meaning of its own, but those of the flash memory."""
    assert [*commands.STATUSES] == STATUSES
    assert len({*commands.STATUSES.values()}) == len(STATUSES) - 9


def test_a_temperature_in_celsius_has_a_sign() -> None:
    """Tenths of a degree Celsius are signed, and give kelvin."""
    assert commands.FPA_TEMPERATURE.value(b"\x80\x00") == pytest.approx(-3003.65, abs=1e-9)


def test_the_message_of_a_wrong_value_names_the_right_ones() -> None:
    """The error of an invalid value lists the valid ones."""
    choices = r"Invalid gain mode 7\. Must be one of 0 \(HIGH\), 1 \(LOW\), 2 \(AUTO\)"
    wrong: Any = 7
    with pytest.raises(ValueError, match=choices):
        commands.GAIN_MODE.data(wrong)


def test_no_identifier_is_used_twice() -> None:
    """All readings, settings and actions have different identifiers."""
    used = [identifier for identifier, _ in READINGS.values()]
    used += [number for s in commands.SETTINGS for number in (s.reading.command, s.set_command)]
    used.append(commands.RUN_FFC)
    assert len({*used}) == len(used)


def test_enumerations_travel_in_32_bits() -> None:
    """TLinear is mode 2 of the video."""
    assert commands.IR16_MODE.data(Ir16Mode.TLINEAR) == b"\x00\x00\x00\x02"


SERIAL, FPA, SET_GAIN = 0x00050002, 0x00050030, 0x00050014


def reply(sequence: int, command: int, data: bytes = b"", status: int = 0) -> bytes:
    """Bytes of a reply."""
    return fslp.encode(sequence, command, data, status)


def camera_of(line: Dialogue, first_sequence: int = 1) -> Boson:
    """Driver that takes part in a dialogue."""
    return Boson(line, first_sequence=first_sequence)


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
    """A late reply is discarded, and the request is sent again."""
    both = reply(1, FPA, b"\x00\x01") + reply(2, FPA, b"\x01\x7c")
    with Dialogue([(fslp.encode(1, FPA), None), (fslp.encode(2, FPA), both)]) as line:
        camera = camera_of(line)
        assert camera.fpa_temperature() == pytest.approx(311.15, abs=1e-9)


def test_frames_of_other_channels_and_echoes_are_discarded() -> None:
    """Frames of the debug channel and echoes of the request are discarded."""
    text = fslp.encode(1, SERIAL, b"text", 0, channel=DEBUG_CHANNEL)
    with Dialogue([(SERIAL_REQUEST, text + SERIAL_REQUEST + SERIAL_REPLY)]) as line:
        camera = camera_of(line)
        assert camera.serial_number() == 93588


def test_a_damaged_reply_is_asked_for_again() -> None:
    """A reply with a wrong checksum is dropped, and requested again."""
    spoilt = SERIAL_REPLY[:-2] + b"\x11\xae"
    again = (fslp.encode(2, SERIAL), reply(2, SERIAL, b"\x00\x00\x00\x07"))
    with Dialogue([(SERIAL_REQUEST, spoilt), again]) as line:
        camera = camera_of(line)
        assert camera.serial_number() == 7


def test_a_mute_camera_is_asked_three_times() -> None:
    """A reading is requested three times, and then raises a timeout error."""
    line = Dialogue([(fslp.encode(n, SERIAL), None) for n in (1, 2, 3)])
    with line, pytest.raises(BosonTimeoutError, match="No reply to 'serial number' within 1 s"):
        camera_of(line).serial_number()


def test_a_change_is_sent_once() -> None:
    """A command that changes the camera is never sent twice."""
    line = Dialogue([(fslp.encode(1, SET_GAIN, b"\x00\x00\x00\x01"), None)])
    with line, pytest.raises(BosonTimeoutError, match="No reply to 'set gain mode'"):
        camera_of(line).set(commands.GAIN_MODE, GainMode.LOW)


@pytest.mark.parametrize(
    ("status", "text"),
    [(0x203, "value out of range"), (0x283, "camera busy"), (0x6A4, "flash"), (0x999, "unknown")],
)
def test_a_refusal_says_why(status: int, text: str) -> None:
    """A status of failure is in the exception, and its meaning in the message."""
    line = Dialogue([(SERIAL_REQUEST, reply(1, SERIAL, status=status))])
    with line, pytest.raises(BosonStatusError, match=f"0x{status:X}, {text}") as refusal:
        camera_of(line).serial_number()
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
    """A reply to another command, or of the wrong size, raises an error."""
    line = Dialogue([(SERIAL_REQUEST, answer)])
    with line, pytest.raises(BosonReplyError, match=message.replace(".", r"\.")):
        camera_of(line).serial_number()


def test_a_value_without_meaning_is_an_error() -> None:
    """An unknown status and a part number that is not text raise an error."""
    wrong = reply(1, 0x00050054, b"\x00\x00\x00\x09")
    line = Dialogue([(fslp.encode(1, 0x00050054), wrong)])
    with line, pytest.raises(BosonReplyError, match="9 is not a valid FfcStatus"):
        camera_of(line).ffc_status()
    wrong = reply(1, 0x00050004, b"\xff" * 20)
    line = Dialogue([(fslp.encode(1, 0x00050004), wrong)])
    with line, pytest.raises(BosonReplyError, match="Invalid reply to 'part number'"):
        camera_of(line).read(commands.PART_NUMBER)


def test_an_acknowledgement_with_data_is_an_error() -> None:
    """A command that changes the camera is answered without data."""
    line = Dialogue([(fslp.encode(1, SET_GAIN, bytes(4)), reply(1, SET_GAIN, b"\x00"))])
    with line, pytest.raises(BosonReplyError, match="Invalid reply of 1 bytes to 'set gain mode'"):
        camera_of(line).set(commands.GAIN_MODE, GainMode.HIGH)


def test_a_line_that_never_ends_is_an_error() -> None:
    """The wait for a reply ends after a maximum number of other bytes."""
    line = Dialogue([(SERIAL_REQUEST, [bytes(4096)] * (MAXIMUM_RECEIVED // 4096 + 1))])
    with line, pytest.raises(BosonReplyError, match="within 65536 bytes"):
        camera_of(line).serial_number()


@given(st.lists(st.binary(max_size=60), max_size=6))
def test_any_answer_is_a_value_or_a_documented_error(answer: list[bytes]) -> None:
    """Any bytes give a number or a documented error, in bounded time."""
    camera = camera_of(Dialogue([(SERIAL_REQUEST, answer)]))
    with suppress(BosonError):
        assert 0 <= camera.read(commands.SERIAL_NUMBER, repeats=0) < 2**32


@pytest.mark.parametrize("setting", commands.SETTINGS, ids=lambda setting: setting.name)
def test_what_is_not_allowed_is_not_sent(setting: Setting[Any]) -> None:
    """A value outside the range of a setting raises an error before a byte is sent."""
    line = Dialogue([])
    with line, pytest.raises(ValueError, match=r"Invalid .* -1\. Must be one of"):
        camera_of(line).set(setting, -1)


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


def in_thread(work: Callable[[], object]) -> threading.Thread:
    """Start a thread."""
    thread = threading.Thread(target=work)
    thread.start()
    return thread


def test_a_correction_that_is_slow_to_start_is_waited_for() -> None:
    """The camera still says that the last correction is complete: not that of this one."""
    asked: list[tuple[int, bytes]] = [
        (commands.LAST_FFC_FRAME.command, struct.pack(">I", 700)),
        (commands.FFC_STATUS.command, struct.pack(">i", FfcStatus.COMPLETE)),
        (commands.RUN_FFC, b""),
    ]
    for frame in (700, 700, 1234):
        asked += [
            (commands.FFC_IN_PROGRESS.command, b"\x00\x00"),
            (commands.FFC_STATUS.command, struct.pack(">i", FfcStatus.COMPLETE)),
            (commands.LAST_FFC_FRAME.command, struct.pack(">I", frame)),
        ]
    pairs: list[Pair] = [
        (fslp.encode(number, command), reply(number, command, data))
        for number, (command, data) in enumerate(asked, start=1)
    ]
    with Dialogue(pairs) as line:
        camera = Boson(line, first_sequence=1)
        assert camera.run_ffc() == 1234


def test_a_mute_camera_ends_a_wait_in_time() -> None:
    """A wait for a correction outlasts its limit by one reply at most, not by three repeated."""
    bench = BosonBench()
    bench.camera.run_ffc()
    bench.spoil(None, None, None, *[Fault.DROP] * 99)
    start = bench.clock.now
    with pytest.raises(BosonError, match="No flat-field correction within 3 s"):
        bench.camera.run_ffc(timeout=3.0)
    assert bench.clock.now - start <= 3.0 + REPLY_TIMEOUT + 0.2


def test_each_program_begins_at_another_number() -> None:
    """The first sequence number depends on the time of day, which identifies stale replies."""
    asked = []
    for later in (0.0, 0.1):
        line = Dialogue([])
        line.clock.sleep(later)
        with pytest.raises(AssertionError, match="Must be nothing more") as sent:
            Boson(line).serial_number()
        asked.append(str(sent.value))
    assert asked[0] != asked[1]


class Slow(Closing):
    """
    A camera that answers with a delay, and notes requests before its answer.

    Attributes
    ----------
    overlaps : int
        Requests that came before the last was answered, or after the line was closed.
    """

    is_simulated, clock = True, SYSTEM

    def __init__(self) -> None:
        self.overlaps = 0
        self.reading = threading.Event()
        self._answers: list[bytes] = []
        self._closed = False

    def write(self, data: bytes) -> None:
        """Take one request."""
        if self._closed:
            raise TransportError("closed")
        self.overlaps += bool(self._answers)
        (frame,) = fslp.Decoder().feed(data)
        self._answers.append(
            reply(frame.sequence, frame.command, bytes(4 if frame.command == 0x00050002 else 2))
        )

    def read(self, size: int, timeout: float) -> bytes:  # noqa: ARG002 - as a line has
        """Answer."""
        self.reading.set()
        time.sleep(0.002)
        self.overlaps += self._closed
        return self._answers.pop(0)

    def close(self) -> None:
        """End."""
        self._closed = True


def test_threads_take_turns() -> None:
    """Two threads that ask at once each get their reply, one exchange after the other."""
    line = Slow()
    camera = Boson(line)
    threads = [
        in_thread(lambda: [camera.serial_number() for _ in range(20)]),
        in_thread(lambda: [camera.fpa_temperature() for _ in range(20)]),
    ]
    for thread in threads:
        thread.join()
    assert line.overlaps == 0


def test_closing_waits_for_an_exchange_of_another_thread() -> None:
    """The line is closed between two exchanges, and the next one is an error that is documented."""
    line = Slow()
    errors: list[TransportError] = []

    def ask() -> None:
        try:
            while True:
                camera.serial_number()
                time.sleep(0.001)
        except TransportError as error:
            errors.append(error)

    camera = Boson(line)
    thread = in_thread(ask)
    line.reading.wait()
    camera.close()
    thread.join()
    assert (len(errors), line.overlaps) == (1, 0)


def test_a_camera_may_be_closed_twice() -> None:
    """A second close does nothing."""
    camera = Boson(Slow())
    for _ in range(2):
        camera.close()
    with pytest.raises(TransportError):
        camera.serial_number()
