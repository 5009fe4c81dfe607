"""APT messages: public byte vectors, published numbers, and arbitrary bytes."""

import struct
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dbthermal.instruments import _apt as apt
from dbthermal.instruments._apt import LENGTHS, Id, command

BAY_2 = 0x22
INFO = (
    bytes.fromhex("06 00 54 00 81 22 89 53 9A 05 49 4F 4E 30 30 31 20 00 2C 00 02 01 39 00")
    + bytes(60)
    + bytes.fromhex("01 00 03 00 01 00")
)
STATUS = "81 04 0E 00 81 22 01 00 01 00 00 00 00 00 00 00 07 00 00 00"
LONG_STATUS = STATUS.replace("0E", "1C") + " 01 00" + " 00" * 12
LONG_COMPLETED = "64 04 0E 00 81 50 01 00 68 AA A0 01 00 00 00 00 30 00 00 80"
PARAMETERS = apt.VelocityParameters(1, minimum=0, acceleration=0x35B0, maximum=0x00CCCCCD)
LIMITS = apt.StatusBits(0b111)

# Quoted in the tests of PnPQ, many of them from the maker's documentation; that of identifier 0018
# from the maker's example program.
REQUESTS = {
    "53 04 06 00 A2 01 01 00 40 0D 03 00": command(
        Id.MOT_MOVE_ABSOLUTE, data=apt.Position(1, 200_000).pack(), destination=BAY_2
    ),
    "13 04 0E 00 A2 01 01 00 00 00 00 00 B0 35 00 00 CD CC CC 00": command(
        Id.MOT_SET_VELPARAMS, data=PARAMETERS.pack(), destination=BAY_2
    ),
    "10 02 01 02 50 01": command(Id.MOD_SET_CHANENABLESTATE, 1, apt.NO, destination=apt.UNIT),
    "80 04 01 00 50 01": command(Id.MOT_REQ_STATUSUPDATE, 1, destination=apt.UNIT),
    "18 00 00 00 50 01": command(Id.HW_NO_FLASH_PROGRAMMING, destination=apt.UNIT),
    "43 04 01 00 50 01": command(Id.MOT_MOVE_HOME, 1, destination=apt.UNIT),
    "65 04 01 01 50 01": command(Id.MOT_MOVE_STOP, 1, apt.YES, destination=apt.UNIT),
}


# Published identifiers, and the lengths of the data that follow [byte]: those of PnPQ, of
# thorlabs-apt-protocol and of the maker's examples, which agree.
PUBLISHED = {
    "HW_REQ_INFO": (0x0005, 0),
    "HW_GET_INFO": (0x0006, 84),
    "HW_STOP_UPDATEMSGS": (0x0012, 0),
    "HW_NO_FLASH_PROGRAMMING": (0x0018, 0),
    "HW_RESPONSE": (0x0080, 0),
    "HW_RICHRESPONSE": (0x0081, 68),
    "MOD_SET_CHANENABLESTATE": (0x0210, 0),
    "MOD_REQ_CHANENABLESTATE": (0x0211, 0),
    "MOD_GET_CHANENABLESTATE": (0x0212, 0),
    "MOT_SET_VELPARAMS": (0x0413, 14),
    "MOT_REQ_VELPARAMS": (0x0414, 0),
    "MOT_GET_VELPARAMS": (0x0415, 14),
    "MOT_SET_HOMEPARAMS": (0x0440, 14),
    "MOT_REQ_HOMEPARAMS": (0x0441, 0),
    "MOT_GET_HOMEPARAMS": (0x0442, 14),
    "MOT_MOVE_HOME": (0x0443, 0),
    "MOT_MOVE_HOMED": (0x0444, 0),
    "MOT_MOVE_ABSOLUTE": (0x0453, 0, 6),
    "MOT_MOVE_COMPLETED": (0x0464, 0, 14),
    "MOT_MOVE_STOP": (0x0465, 0),
    "MOT_MOVE_STOPPED": (0x0466, 0, 14),
    "MOT_REQ_STATUSUPDATE": (0x0480, 0),
    "MOT_GET_STATUSUPDATE": (0x0481, 14, 28),
    "MOT_GET_DCSTATUSUPDATE": (0x0491, 14),
}
BITS = {
    "MOVING_FORWARD": 4,
    "MOVING_REVERSE": 5,
    "JOGGING_FORWARD": 6,
    "JOGGING_REVERSE": 7,
    "CONNECTED": 8,
    "HOMING": 9,
    "HOMED": 10,
    "POSITION_ERROR": 14,
    "OVERLOAD": 24,
    "ENABLED": 31,
}


def decode(text: str | bytes) -> apt.Message:
    """Return the one message that the bytes are."""
    decoder = apt.Decoder()
    (message,) = decoder.feed(bytes.fromhex(text) if isinstance(text, str) else text)
    assert (decoder.dropped, decoder.pending) == (0, bytearray())
    return message


@pytest.mark.parametrize("expected", REQUESTS)
def test_requests_have_the_published_bytes(expected: str) -> None:
    """Requests have the bytes that independent sources publish."""
    assert REQUESTS[expected].hex(" ").upper() == expected


def test_move_completed_has_two_forms() -> None:
    """The end of a move comes alone, or with a status that a K10CR1 appended (and that moves)."""
    short, long = decode("64 04 01 00 01 22"), decode(LONG_COMPLETED)
    assert short == apt.Message(apt.Id.MOT_MOVE_COMPLETED, 1, 0, apt.HOST, BAY_2)
    assert (long.id, long.source, long.param1) == (apt.Id.MOT_MOVE_COMPLETED, apt.UNIT, 0)
    assert len(long.data) == 14


@pytest.mark.parametrize("identifier", ["64 04", "66 04"])
@pytest.mark.parametrize("form", [" 01 00 01 22", LONG_COMPLETED[5:]])
def test_completed_and_stopped_are_alike(identifier: str, form: str) -> None:
    """The end of a move and a stop have the same two forms, and both are encoded back."""
    assert apt.encode(decode(identifier + form)) == bytes.fromhex(identifier + form)


@pytest.mark.parametrize("text", [STATUS, LONG_STATUS])
def test_status_of_either_length(text: str) -> None:
    """A status of either length gives position and bits; a K10CR2's further fields are not read."""
    assert apt.Status.parse(decode(text)) == apt.Status(1, position=1, encoder=0, bits=LIMITS)


def test_info_of_the_documentation() -> None:
    """The documentation's example of a controller's identity is decoded."""
    info = apt.Info.parse(decode(INFO))
    assert info == apt.Info(94_000_009, "ION001", "57.1.2")


@pytest.mark.parametrize(
    ("payload", "identifier"),
    [
        (apt.Position(1, -(2**31)), apt.Id.MOT_MOVE_ABSOLUTE),
        (PARAMETERS, apt.Id.MOT_GET_VELPARAMS),
        (apt.HomeParameters(1, 2, 1, 4_397_466, -5), apt.Id.MOT_GET_HOMEPARAMS),
        (apt.Status(1, -1, 0, apt.StatusBits(0x80001410)), apt.Id.MOT_GET_STATUSUPDATE),
        (apt.Info(40_000_000, "SCC201", "1.2.3"), apt.Id.HW_GET_INFO),
    ],
)
def test_payloads_come_back(
    payload: apt.Position | apt.Status | apt.Info, identifier: apt.Id
) -> None:
    """A record reads back the data that it packs, in one of the lengths that its message has."""
    message = apt.Message(identifier, 0, 0, apt.HOST, apt.BAY_1, payload.pack())
    assert type(payload).parse(decode(apt.encode(message))) == payload


def test_errors_of_a_controller() -> None:
    """An error has the message that caused it, a code and a text; a short one has none."""
    data = struct.pack("<HH64s", 0x0453, 7, b"no motor")
    message = apt.Message(Id.HW_RICHRESPONSE, 0, 0, apt.HOST, apt.BAY_1, data)
    assert apt.Notice.parse(decode(apt.encode(message))) == apt.Notice(0x0453, 7, "no motor")
    assert apt.Notice.parse(decode("80 00 00 00 01 21")).notes == "an error without a text"


@pytest.mark.parametrize(
    ("message", "error"),
    [
        (apt.Message(0x10000, 0, 0, 1, 1), "Invalid Message.id=65536,.* fields must hold it"),
        (apt.Message(1, 256, 0, 1, 1), "Invalid Message.*param1=256,.* fields must hold it"),
        (apt.Message(1, 0, -1, 1, 1), "Invalid Message.*param2=-1,.* fields must hold it"),
        (apt.Message(1, 0, 0, 0x80, 1), "Invalid Message.*destination=128,.* below 128"),
        (
            apt.Message(1, 0, 0, 1, 1, bytes(256)),
            "Invalid Message.* at most 255 bytes of data",
        ),
        (apt.Message(1, 0, 1, 1, 1, b"x"), "Invalid Message.* parameters must be 0"),
    ],
)
def test_what_does_not_fit_is_refused(message: apt.Message, error: str) -> None:
    """A number that does not fit its field raises a ValueError."""
    with pytest.raises(ValueError, match=error):
        apt.encode(message)
    with pytest.raises(ValueError, match=r"Invalid Position\(channel=1, position=2147483648\)"):
        apt.Position(1, 2**31).pack()
    with pytest.raises(ValueError, match="Invalid data of 0 bytes of MOT_SET_VELPARAMS"):
        command(Id.MOT_SET_VELPARAMS, 1, destination=apt.BAY_1)


@pytest.mark.parametrize("wrong", [1.5, float("nan"), "1", None])
def test_a_number_must_be_whole(wrong: object) -> None:
    """A fractional number raises an error rather than being rounded into a field."""
    with pytest.raises(ValueError, match="fields must hold it: required argument is not an int"):
        command(Id.MOT_MOVE_HOME, wrong, destination=apt.UNIT)  # type: ignore[arg-type]


known = st.sampled_from([INFO, *map(bytes.fromhex, (STATUS, LONG_STATUS, LONG_COMPLETED))])
cut_short = st.tuples(known, st.integers(0, 90)).map(lambda pair: pair[0][: pair[1]])
streams = st.lists(st.one_of(st.binary(max_size=9), known, cut_short), max_size=8).map(b"".join)


@given(streams, st.lists(st.integers(0, 400), max_size=8))
def test_arbitrary_bytes(stream: bytes, cuts: list[int]) -> None:
    """Any bytes in any pieces: the same messages, no exception, and every byte accounted for."""
    decoder, pieces = apt.Decoder(), apt.Decoder()
    messages = decoder.feed(stream)
    edges = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
    found = [
        message for start, end in pairwise(edges) for message in pieces.feed(stream[start:end])
    ]
    assert (found, pieces.dropped, pieces.pending) == (messages, decoder.dropped, decoder.pending)
    read = sum(len(apt.encode(message)) for message in messages)
    assert read + decoder.dropped + len(decoder.pending) == len(stream)


@given(st.lists(st.tuples(st.sampled_from([b"", b"\xff", b"\xfe\xfe\xff"]), known), max_size=6))
def test_messages_are_found_behind_noise(parts: list[tuple[bytes, bytes]]) -> None:
    """Noise before a message is dropped and counted, and the message is decoded."""
    decoder = apt.Decoder()
    messages = decoder.feed(b"".join(noise + message for noise, message in parts))
    assert [apt.encode(message) for message in messages] == [message for _, message in parts]
    assert decoder.dropped == sum(len(noise) for noise, _ in parts)


PARSERS: dict[apt.Id, type[apt.Record]] = {
    Id.HW_GET_INFO: apt.Info,
    Id.HW_RICHRESPONSE: apt.Notice,
    Id.MOT_MOVE_ABSOLUTE: apt.Position,
    Id.MOT_GET_HOMEPARAMS: apt.HomeParameters,
    Id.MOT_GET_STATUSUPDATE: apt.Status,
    Id.MOT_GET_VELPARAMS: apt.VelocityParameters,
}


@given(st.binary(min_size=84, max_size=84), st.sampled_from(list(PARSERS)))
def test_parsers_meet_arbitrary_data(content: bytes, identifier: apt.Id) -> None:
    """A parser returns its record of any data of each length that the decoder lets pass."""
    for length in filter(None, LENGTHS[identifier]):
        message = apt.Message(identifier, 0, 0, apt.HOST, apt.BAY_1, content[:length])
        parser = PARSERS[identifier]
        assert isinstance(parser.parse(decode(apt.encode(message))), parser)


def test_half_a_message_is_given_up() -> None:
    """Pending bytes can be discarded, and are counted; the next message is then decoded."""
    decoder = apt.Decoder()
    assert decoder.feed(INFO[:50]) == []
    decoder.discard()
    assert (decoder.dropped, decoder.pending) == (50, bytearray())
    assert len(decoder.feed(bytes.fromhex(STATUS))) == 1


@pytest.mark.parametrize("header", ["64 04 00 00 81 21", "81 04 00 00 81 21", "81 04 0E 00 01 21"])
def test_lengths_that_no_message_has(header: str) -> None:
    """Impossible data lengths are dropped as noise."""
    decoder = apt.Decoder()
    assert decoder.feed(bytes.fromhex(header)) == []
    assert decoder.dropped == 1


def test_what_a_host_sends_is_not_heard_by_a_host() -> None:
    """An echo of the host's own messages is not decoded as an answer."""
    decoder = apt.Decoder((apt.HOST,), apt.CONTROLLERS)
    assert decoder.feed(command(Id.HW_REQ_INFO, destination=apt.UNIT) + bytes(6)) == []
    assert decoder.dropped == 7


@pytest.mark.parametrize("kind", [bytes, bytearray, memoryview])
def test_a_line_is_read_in_both_directions(kind: type) -> None:
    """Requests and replies on a logged line are all decoded, byte by byte."""
    decoder, reply = apt.Decoder(), bytes.fromhex(LONG_COMPLETED)
    for expected in REQUESTS:
        line = bytes.fromhex(expected) + reply
        found = [m for place in range(len(line)) for m in decoder.feed(kind(line[place:][:1]))]
        assert [apt.encode(message) for message in found] == [line[: -len(reply)], reply]
    assert decoder.feed(kind(b"")) == []
    assert (decoder.dropped, decoder.pending) == (0, bytearray())


def test_identifiers_and_lengths_are_the_published_ones() -> None:
    """Each message has the identifier and the lengths of data that others have."""
    found = {known.name: (known.value, *LENGTHS[known]) for known in apt.Id}
    assert found == PUBLISHED


def test_bits_are_the_published_ones() -> None:
    """Each bit of a motor's state is where others have it."""
    assert {bit.name: bit.bit_length() - 1 for bit in apt.StatusBits} == BITS


@pytest.mark.parametrize(
    ("source", "heard"), [(0x11, 1), (0x21, 1), (0x2A, 1), (0x50, 1), (0x2B, 0), (0x01, 0)]
)
def test_a_computer_hears_controllers_alone(source: int, heard: int) -> None:
    """Messages of the rack, its ten bays and a unit are decoded; all other addresses are noise."""
    decoder = apt.Decoder((apt.HOST,), apt.CONTROLLERS)
    assert len(decoder.feed(bytes((0x64, 0x04, 1, 0, 1, source)))) == heard
    assert decoder.dropped == 1 - heard


@pytest.mark.parametrize(
    ("payload", "message"),
    [
        (apt.Status(1, 2**31, 0, apt.StatusBits(0)), "Invalid Status.* fields must hold it"),
        (apt.Info(1 << 32, "BSC201", "1.0.0"), "Invalid Info.* fields must hold it"),
        (apt.Info(1, "BSC201-LONG", "1.0.0"), "Invalid model 'BSC201-LONG'"),
    ],
)
def test_numbers_that_do_not_fit_a_reply(payload: apt.Status | apt.Info, message: str) -> None:
    """A record with a number that does not fit its field raises an error that shows it."""
    with pytest.raises(ValueError, match=message):
        payload.pack()
