"""The Boson's driver: byte dialogues, and its errors for invalid replies."""

from contextlib import suppress
from typing import Any

import pytest
from dialogue import Dialogue
from faulty_boson import DEBUG_CHANNEL
from hypothesis import given
from hypothesis import strategies as st
from test_fslp import ESCAPED_REPLY, SERIAL_REPLY, SERIAL_REQUEST

from dbthermal.instruments import _fslp as fslp
from dbthermal.instruments.boson import (
    MAXIMUM_RECEIVED,
    Boson,
    BosonError,
    BosonReplyError,
    BosonStatusError,
    BosonTimeoutError,
    commands,
)
from dbthermal.instruments.boson.commands import Setting
from dbthermal.instruments.camera import GainMode

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
