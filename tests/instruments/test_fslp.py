"""FSLP frames: public byte vectors, round trips, and what damage does."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dbthermal.instruments._fslp import (
    MAXIMUM_DATA,
    MAXIMUM_FRAME,
    Decoder,
    Frame,
    checksum,
    encode,
    next_sequence,
)

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
