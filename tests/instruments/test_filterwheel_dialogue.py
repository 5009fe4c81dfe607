"""The filter wheel's driver byte for byte, and among foreign and invalid answers."""

import pytest
from device_benches import FILTERS
from dialogue import Dialogue, Pair
from hypothesis import given, settings
from hypothesis import strategies as st

from dbthermal.instruments import _apt as apt
from dbthermal.instruments._apt import Id, command
from dbthermal.instruments.filterwheel import FilterWheel, WheelError, WrongDeviceError


def _greeting(unit: int) -> bytes:
    greeting = (Id.HW_NO_FLASH_PROGRAMMING, Id.HW_STOP_UPDATEMSGS, Id.HW_REQ_INFO)
    return b"".join(command(identifier, destination=unit) for identifier in greeting)


def _reply(identifier: Id, data: bytes, *, source: int = apt.BAY_1) -> bytes:
    return apt.encode(apt.Message(identifier, 0, 0, apt.HOST, source, data))


def _connection() -> list[Pair]:
    """Bytes between a driver and a BSC201 until it is connected."""
    to, info = apt.BAY_1, apt.Info(40_000_000, "BSC201", "1.0.0")
    speeds = apt.VelocityParameters(1, 0, 4506, 21_987_328)
    before, home = apt.HomeParameters(1, 2, 1, 0, 0), apt.HomeParameters(1, 2, 1, 4_397_466, 0)
    return [
        (_greeting(apt.RACK), _reply(Id.HW_GET_INFO, info.pack(), source=apt.RACK)),
        (
            command(Id.MOT_SET_VELPARAMS, data=speeds.pack(), destination=to)
            + command(Id.MOT_REQ_VELPARAMS, 1, destination=to),
            _reply(Id.MOT_GET_VELPARAMS, speeds.pack()),
        ),
        (
            command(Id.MOT_REQ_HOMEPARAMS, 1, destination=to),
            _reply(Id.MOT_GET_HOMEPARAMS, before.pack()),
        ),
        (
            command(Id.MOT_SET_HOMEPARAMS, data=home.pack(), destination=to)
            + command(Id.MOT_REQ_HOMEPARAMS, 1, destination=to),
            _reply(Id.MOT_GET_HOMEPARAMS, home.pack()),
        ),
        (bytes.fromhex("10 02 01 01 21 01 11 02 01 00 21 01"), bytes.fromhex("12 02 01 01 01 21")),
    ]


def _status(position: int, bits: int) -> bytes:
    packed = apt.Status(1, position, 0, apt.StatusBits(bits)).pack()
    return _reply(Id.MOT_GET_STATUSUPDATE, packed)


def test_dialogue_of_a_move() -> None:
    """Every byte of a connection and a move, with the report of the end between two answers."""
    ask = bytes.fromhex("80 04 01 00 21 01")
    move = bytes.fromhex("53 04 06 00 A1 01 01 00 AB 0A 01 00")
    end = bytes.fromhex("64 04 01 00 01 21")
    dialogue = Dialogue(
        [
            *_connection(),
            (ask, _status(0, 0x80000500)),
            (move + ask, _status(30_000, 0x80000510)),
            (ask, [end[:2], end[2:] + _status(68_267, 0x80000510)]),
            (ask, _status(68_267, 0x80000500)),
        ]
    )
    with dialogue:
        wheel = FilterWheel(dialogue, FILTERS)
        assert wheel.connect().model == "BSC201"
        wheel.move_to(2)


def test_answers_of_others() -> None:
    """Stale answers and those of other bays or channels are ignored."""
    ask, answer = bytes.fromhex("80 04 01 00 21 01"), _status(3, 0)
    old, other_bay = _status(1, 0), _status(2, 0)[:5] + b"\x22" + _status(2, 0)[6:]
    other_channel = answer[:6] + b"\x02" + answer[7:10] + b"\x01" + answer[11:]
    greeted = _connection()[-1]
    pairs = [*_connection()[:-1], (greeted[0], [bytes.fromhex("12 02 01 01 01 21"), old])]
    with Dialogue([*pairs, (ask, [other_bay + other_channel, answer])]) as dialogue:
        wheel = FilterWheel(dialogue, FILTERS)
        wheel.connect()
        assert wheel.status().position == 3


@settings(max_examples=60)
@given(st.lists(st.binary(max_size=40), max_size=6))
def test_arbitrary_answers(answers: list[bytes]) -> None:
    """Connecting ends with a documented error for arbitrary answers."""

    class Babbler(Dialogue):
        """A device that sends arbitrary bytes."""

        def write(self, data: bytes) -> None:
            """Take anything."""

    babbler = Babbler([(None, answers)] if answers else [])
    with pytest.raises(WheelError):
        FilterWheel(babbler, FILTERS).connect()


@pytest.mark.parametrize("bits", [b"\x12\x02\x01\x00\x01\x21", b"\x12\x02\x01\x03\x01\x21"])
def test_neither_enabled_nor_not(bits: bytes) -> None:
    """An invalid state of the channel raises an error of the wheel."""
    dialogue = Dialogue([*_connection()[:-1], (_connection()[-1][0], bits)])
    with dialogue, pytest.raises(WheelError, match=r"Unknown state . of the motor"):
        FilterWheel(dialogue, FILTERS).connect()


def test_another_language() -> None:
    """A device that answers in text, such as an FW102C, raises an error."""
    banner = b"Command error CMD_NOT_DEFINED\r\n> "
    with (
        Dialogue([(_greeting(apt.RACK), banner), (_greeting(apt.UNIT), None)]) as device,
        pytest.raises(WrongDeviceError, match="33 bytes came that are no APT messages"),
    ):
        FilterWheel(device, FILTERS).connect()
