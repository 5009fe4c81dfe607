"""Codecs of the wheel (APT) and the Boson (FSLP): public bytes, round trips, damaged input."""

import struct
from itertools import pairwise
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st
from refused import refused

from dbthermal.instruments import _apt as apt
from dbthermal.instruments import boson
from dbthermal.instruments._apt import Id, Message
from dbthermal.instruments.boson import Packet
from dbthermal.instruments.filterwheel import StatusBits

# Requests quoted in the tests of PnPQ, many of them from the maker's documentation; that of 0018
# from the maker's example program.
SPEEDS = apt.Speeds(1, minimum=0, acceleration=0x35B0, velocity=0x00CCCCCD)
REQUESTS: dict[str, tuple[Id, int, int, bytes, int]] = {
    "53 04 06 00 A2 01 01 00 40 0D 03 00": (
        *(Id.MOT_MOVE_ABSOLUTE, 0, 0, apt.pack(apt.Position(1, 200_000)), 0x22),
    ),
    "13 04 0E 00 A2 01 01 00 00 00 00 00 B0 35 00 00 CD CC CC 00": (
        *(Id.MOT_SET_VELPARAMS, 0, 0, apt.pack(SPEEDS), 0x22),
    ),
    "10 02 01 02 50 01": (Id.MOD_SET_CHANENABLESTATE, 1, apt.NO, b"", apt.UNIT),
    "80 04 01 00 50 01": (Id.MOT_REQ_STATUSUPDATE, 1, 0, b"", apt.UNIT),
    "18 00 00 00 50 01": (Id.HW_NO_FLASH_PROGRAMMING, 0, 0, b"", apt.UNIT),
    "43 04 01 00 50 01": (Id.MOT_MOVE_HOME, 1, 0, b"", apt.UNIT),
    "65 04 01 01 50 01": (Id.MOT_MOVE_STOP, 1, apt.YES, b"", apt.UNIT),
}
INFO = "06 00 54 00 81 22 89 53 9A 05 49 4F 4E 30 30 31 20 00 2C 00 02 01 39 00" + (
    " 00" * 60 + " 01 00 03 00 01 00"
)
STATUS = "81 04 0E 00 81 22 01 00 01 00 00 00 00 00 00 00 07 00 00 00"
LONG_STATUS = STATUS.replace("0E", "1C") + " 01 00" + " 00" * 12
LONG_COMPLETED = "64 04 0E 00 81 50 01 00 68 AA A0 01 00 00 00 00 30 00 00 80"
ENDS = [first + end for first in ("64 04", "66 04") for end in (" 01 00 01 22", LONG_COMPLETED[5:])]
LIMITS = StatusBits(0b111)
RECORDS: list[tuple[str, tuple[Any, ...]]] = [
    (STATUS, apt.Status(1, position=1, encoder=0, bits=LIMITS)),
    (LONG_STATUS, apt.Status(1, position=1, encoder=0, bits=LIMITS)),
    (INFO, apt.Info(94_000_009, b"ION001 \0", 44, 2, 1, 57, bytes(60), 1, 3, 1)),
]
# Identifiers and lengths of data [byte] of PnPQ, thorlabs-apt-protocol and the maker's examples,
# which agree.
PUBLISHED = """
HW_REQ_INFO 0005 0, HW_GET_INFO 0006 84, HW_STOP_UPDATEMSGS 0012 0, HW_NO_FLASH_PROGRAMMING 0018 0,
HW_RESPONSE 0080 0, HW_RICHRESPONSE 0081 68, MOD_SET_CHANENABLESTATE 0210 0,
MOD_REQ_CHANENABLESTATE 0211 0, MOD_GET_CHANENABLESTATE 0212 0, MOT_SET_VELPARAMS 0413 14,
MOT_REQ_VELPARAMS 0414 0, MOT_GET_VELPARAMS 0415 14, MOT_SET_HOMEPARAMS 0440 14,
MOT_REQ_HOMEPARAMS 0441 0, MOT_GET_HOMEPARAMS 0442 14, MOT_MOVE_HOME 0443 0, MOT_MOVE_HOMED 0444 0,
MOT_MOVE_ABSOLUTE 0453 0 6, MOT_MOVE_COMPLETED 0464 0 14, MOT_MOVE_STOP 0465 0,
MOT_MOVE_STOPPED 0466 0 14, MOT_REQ_STATUSUPDATE 0480 0, MOT_GET_STATUSUPDATE 0481 14 28
"""
BITS = [4, 5, 6, 7, 8, 9, 10, 14, 24, 31]  # of `StatusBits`, in its order


def answer(sequence: int, command: int, value: int, size: int) -> Packet:
    """Reply of a Boson with a number of so many bytes."""
    return Packet(0, sequence, command, 0, value.to_bytes(size))


# Frames quoted in thurberdog/ghostCommand, but the third: LJMUAstroecology/flirpy, issue 21.
FRAMES = {
    "8E 00 00 00 00 01 00 05 00 02 FF FF FF FF 01 0B AE": Packet(0, 1, 0x50002, boson.REQUEST),
    "8E 00 00 00 00 01 00 05 00 02 00 00 00 00 00 01 6D 94 30 10 AE": answer(1, 0x50002, 93588, 4),
    "8E 00 00 00 00 00 00 05 00 30 00 00 00 00 01 AF 9E 91 99 AE": answer(0, 0x50030, 431, 2),
    "8E 00 00 00 00 01 00 05 00 30 FF FF FF FF 49 66 AE": Packet(0, 1, 0x50030, boson.REQUEST),
    "8E 00 00 00 00 01 00 05 00 30 00 00 00 00 01 7C BD CE AE": answer(1, 0x50030, 380, 2),
}
REQUEST, REPLY, ESCAPED, _, TEMPERATURE = map(bytes.fromhex, FRAMES)
SERIAL = FRAMES[REPLY.hex(" ").upper()]


def decode(line: str) -> Message:
    """Return the one message that the bytes are."""
    decoder = apt.Decoder()
    (message,) = decoder.feed(bytes.fromhex(line))
    assert (decoder.dropped, decoder.pending) == (0, bytearray())
    return message


def cut(stream: bytes, places: list[int]) -> list[bytes]:
    """Cut a stream at these places."""
    edges = [0, *sorted(place % (len(stream) + 1) for place in places), len(stream)]
    return [stream[start:stop] for start, stop in pairwise(edges)]


def test_messages_have_the_published_bytes() -> None:
    """Requests, ends of a move in both forms, identities and states are those of others."""
    built = {
        apt.encode(Message(name, channel, value, unit, apt.HOST, data)).hex(" ").upper()
        for name, channel, value, data, unit in REQUESTS.values()
    }
    assert built == {*REQUESTS}
    assert [apt.encode(decode(line)) for line in ENDS] == [bytes.fromhex(line) for line in ENDS]
    assert decode(ENDS[0]) == Message(Id.MOT_MOVE_COMPLETED, 1, 0, apt.HOST, 0x22)
    for line, record in RECORDS:
        assert apt.parse(type(record), decode(line)) == record
    entries = [
        f"{sample.name} {sample:04X} " + " ".join(map(str, apt.LENGTHS[sample])) for sample in Id
    ]
    assert entries == PUBLISHED.strip().replace(",\n", ", ").split(", ")
    assert [bit.bit_length() - 1 for bit in StatusBits] == BITS


def test_frames_have_the_published_bytes() -> None:
    """Each public frame is encoded and decoded, with CRC-16/AUG-CCITT and escapes."""
    for line, frame in FRAMES.items():
        assert boson.encode(frame) == bytes.fromhex(line)
        assert boson.Decoder().feed(bytes.fromhex(line)) == [frame]
    assert boson.checksum(b"123456789") == 0xE5CC
    request = Packet(0, 0, 0x0002001C, boson.REQUEST)
    assert boson.encode(request)[-5:] == bytes.fromhex("FF 38 9E 91 AE")
    content = bytes.fromhex("00 000000 9E81 000000 9E91 9E81 9E91 9EA1 00 9EA1")
    sent = boson.encode(Packet(0, 0x8E, 0x9E, 0x8E9EAE00, b"\xae"))
    assert sent[1 : 1 + len(content)] == content
    assert not {0x8E, 0xAE} & {*sent[1:-1]}


number = st.integers(-(2**31), 2**31 - 1)
raw, notes = (st.binary(min_size=size, max_size=size) for size in (8, 60))
byte = st.integers(0, 255)
natural, channel = st.integers(0, 2**32 - 1), st.just(1)
# Fields and message of each record.
RECORD_FIELDS: dict[type[tuple[Any, ...]], tuple[Id, tuple[st.SearchStrategy[Any], ...]]] = {
    apt.Position: (Id.MOT_MOVE_ABSOLUTE, (channel, number)),
    apt.Speeds: (Id.MOT_GET_VELPARAMS, (channel, number, number, number)),
    apt.Home: (Id.MOT_GET_HOMEPARAMS, (channel, st.just(2), st.just(4), number, number)),
    apt.Status: (Id.MOT_GET_STATUSUPDATE, (channel, number, number, natural)),
    apt.Info: (Id.HW_GET_INFO, (natural, raw, *4 * [byte], notes, *3 * [byte])),
}
IDENTIFIERS = {kind: identifier for kind, (identifier, _) in RECORD_FIELDS.items()}
records = st.one_of([st.builds(kind, *parts) for kind, (_, parts) in RECORD_FIELDS.items()])
noisy = st.lists(st.tuples(st.sampled_from([b"", b"\xff", b"\xfe\xfe\xff"]), records), max_size=6)
places = st.lists(st.integers(0, 999), max_size=6)


@given(noisy, places)
def test_messages_come_back(noisy: list[tuple[bytes, tuple[Any, ...]]], where: list[int]) -> None:
    """Records come back from any cutting, with noise before them, which is counted."""
    stream, sent = b"", [record for _, record in noisy]
    for noise, record in noisy:
        message = Message(IDENTIFIERS[type(record)], 0, 0, apt.HOST, apt.BAY_1, apt.pack(record))
        stream += noise + apt.encode(message)
    decoder = apt.Decoder()
    messages = [message for piece in cut(stream, where) for message in decoder.feed(piece)]
    pairs = zip(sent, messages, strict=True)
    assert [apt.parse(type(record), message) for record, message in pairs] == sent
    assert decoder.dropped == sum(len(noise) for noise, _ in noisy)


# Special bytes, and those that follow an escape, are as likely as all others together.
telling = st.one_of(
    st.sampled_from([0x8E, 0xAE, 0x9E, 0x81, 0xA1, 0x91, 0x00]), st.integers(0, 255)
)
blobs = st.lists(telling, max_size=40).map(bytes)
words = st.lists(telling, min_size=4, max_size=4).map(lambda b: int.from_bytes(bytes(b)))
frames = st.builds(Packet, telling, words, words, words, blobs)


@given(st.lists(frames, max_size=4), places, blobs)
def test_frames_come_back(sent: list[Packet], where: list[int], noise: bytes) -> None:
    """Frames come back in order however the stream is cut, with noise between them."""
    between = bytes(byte for byte in noise if byte != 0x8E)
    stream = b"".join(between + boson.encode(frame) for frame in sent)
    decoder = boson.Decoder()
    assert [frame for piece in cut(stream, where) for frame in decoder.feed(piece)] == sent
    assert (decoder.damaged, decoder.pending) == (0, None)


sample = st.sampled_from([bytes.fromhex(line) for line in (INFO, STATUS, LONG_COMPLETED)])
cut_short = st.tuples(sample, st.integers(0, 90)).map(lambda pair: pair[0][: pair[1]])


@given(st.lists(st.one_of(blobs, sample, cut_short), max_size=8).map(b"".join), places)
def test_any_bytes_are_accounted_for(stream: bytes, where: list[int]) -> None:
    """Of any bytes in any pieces each is in a message or frame, counted as damaged, or pending."""
    decoder, whole, framed = apt.Decoder(), apt.Decoder().feed(stream), boson.Decoder()
    messages = [message for piece in cut(stream, where) for message in decoder.feed(piece)]
    assert messages == whole
    read = sum(len(apt.encode(message)) for message in messages)
    assert read + decoder.dropped + len(decoder.pending) == len(stream)
    results = [frame for piece in cut(stream, where) for frame in framed.feed(piece)]
    pending = framed.pending is not None
    assert stream.count(0x8E) == len(results) + framed.damaged + pending
    assert boson.Decoder().feed(stream + REPLY)[-1] == SERIAL  # a start byte begins anew
    decoder.discard()
    assert decoder.pending == b""
    assert len(decoder.feed(bytes.fromhex(STATUS))) == 1


@pytest.mark.parametrize("sent", [REPLY, ESCAPED, TEMPERATURE])
def test_a_flipped_bit_is_never_believed(sent: bytes) -> None:
    """No frame with one wrong bit is returned, and the next good one is."""
    for bit in range(8 * len(sent)):
        spoilt = (int.from_bytes(sent) ^ 1 << bit).to_bytes(len(sent))
        assert boson.Decoder().feed(spoilt + REQUEST) == [FRAMES[REQUEST.hex(" ").upper()]]


def frame_of(size: int) -> bytes:
    """Frame of a number of bytes, none of them escaped."""
    body = bytes(size - 2)
    sent = b"\x8e" + body + boson.checksum(body).to_bytes(2) + b"\xae"
    assert not {0x8E, 0x9E, 0xAE} & {*sent[1:-1]}
    return sent


DAMAGED_FRAMES = {
    "longer than the longest": frame_of(2049),
    "cut short by the next start": REPLY[:-4] + REPLY[:1],
    "no such escape": REPLY[:-1] + b"\x9e\x00\xae",
    "an escape of nothing": REPLY[:-1] + b"\x9e\xae",
    "wrong checksum": REPLY[:-2] + b"\x11\xae",
    "empty": b"\x8e\xae",
    "without end": b"\x8e" + bytes(boson.MAXIMUM_FRAME + 1) + b"\xae",
}


@pytest.mark.parametrize("damage", DAMAGED_FRAMES)
def test_a_damaged_frame_is_dropped_and_counted(damage: str) -> None:
    """Each kind of damage drops the frame, counts one, and does not harm the next."""
    decoder = boson.Decoder()
    assert decoder.feed(DAMAGED_FRAMES[damage]) == []
    assert decoder.damaged == 1
    assert decoder.feed(REPLY) == [SERIAL]
    assert len(decoder.feed(frame_of(2048))) == 1  # the longest


@pytest.mark.parametrize(
    ("header", "heard"),
    [
        *(("64 04 00 00 81 21", 0), ("81 04 00 00 81 21", 0), ("81 04 0E 00 01 21", 0)),  # lengths
        *(("64 04 01 00 01 11", 1), ("64 04 01 00 01 21", 1), ("64 04 01 00 01 2A", 1)),  # senders
        *(("64 04 01 00 01 50", 1), ("64 04 01 00 01 2B", 0), ("64 04 01 00 01 01", 0)),
        ("05 00 00 00 50 01", 0),  # its request comes back
    ],
)
def test_what_a_computer_hears(header: str, heard: int) -> None:
    """Messages of rack, bays and unit are decoded; other addresses and lengths are noise."""
    decoder = apt.Decoder((apt.HOST,), apt.CONTROLLERS)
    assert len(decoder.feed(bytes.fromhex(header))) == heard
    assert decoder.dropped == 1 - heard


def test_an_unknown_message_is_skipped_whole() -> None:
    """Data of a message that the driver does not know are not read as messages."""
    stream = bytes.fromhex("fe 0e 06 00 81 22 44 04 01 00 01 22 fe 0e 01 00 01 22" + STATUS)
    decoder = apt.Decoder((apt.HOST,), apt.CONTROLLERS)
    identifiers = [message.id for message in decoder.feed(stream)]
    assert (identifiers, decoder.dropped) == ([0xEFE, 0xEFE, Id.MOT_GET_STATUSUPDATE], 0)


# Numbers that do not fit their field, or are not whole, are errors, and never rounded into it.
test_what_does_not_fit_is_refused = refused(
    lambda encode, *content: encode(*content),
    [
        (apt.encode, Message(0x10000, 0, 0, 1, 1), "Invalid .*id=65536,.* fields must hold it"),
        (apt.encode, Message(1, 0, 0, 0x80, 1), "Invalid .*destination=128,.* below 128"),
        (apt.encode, Message(1, 0, 0, 1, 1, bytes(256)), "Invalid .*at most 255 bytes of data"),
        (apt.encode, Message(1, 0, 1, 1, 1, b"x"), "Invalid .*parameters must be 0"),
        (apt.pack, apt.Position(1, 2**31), "Invalid Position(channel=1, position=2147483648)"),
        (apt.encode, Message(Id.MOT_SET_VELPARAMS), "Invalid .* 0 bytes of MOT_SET_VELPARAMS"),
        (boson.encode, Packet(0, 0, 0, 0, bytes(752)), "of 752 bytes. Must be at most 751"),
        *((boson.encode, Packet(0, *it, 0), "format|range") for it in ((1 << 32, 0), (0, -1))),
        (boson.encode, Packet(0, 0, cast(Any, 1.5), 0), "integer"),
    ],
    error=(ValueError, struct.error),
)


@given(st.integers(0, (1 << 32) - 1))
def test_sequence_numbers_need_no_escape(sequence: int) -> None:
    """The number after any other is larger, but at the end, holds no special byte, skips few."""
    following = boson.next_sequence(sequence)
    assert not {0x8E, 0x9E, 0xAE} & {*following.to_bytes(4)}
    assert following > sequence or sequence == (1 << 32) - 1
    numbers = [boson.next_sequence(n) for n in (0, 0x8D, 0xADFF, 0xFFFFFFFF)]
    assert numbers == [1, 0x8F, 0xAF00, 0]
