"""The filter wheel's driver: on the emulated wheel, byte for byte, and with faults of either."""

import logging
import struct
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from dialogue import Dialogue, Pair
from faulty_devices import WheelBench, WheelFaults, connected
from hypothesis import given, settings
from hypothesis import strategies as st
from refused import assert_raises, assert_refused

from dbthermal.instruments.filterwheel import (
    NoReplyError,
    NotHomedError,
    StalledWheelError,
    WheelError,
)
from dbthermal.instruments.transport import TransportError

RACK = [0, 68_267, 136_533, 204_800, 273_067, 341_333], (4506, 21_987_328), "0x11, 0x21"
UNIT = [0, 4267, 8533, 12_800, 17_067, 21_333], (25_600, 25_600), "0x50, 0x50"
MODELS = {"BSC201": RACK, "SCC201": RACK, "BSC101": UNIT}
"""Places of the slots [count], rounded each by itself; speeds of 1 turn/s^2 and 1 turn/s in the
numbers that thorlabs_apt_device has; addresses."""


@pytest.mark.parametrize("model", MODELS)
def test_every_slot_turns_into_the_beam(model: str) -> None:
    """Rack or not, and whatever it calls itself: home, then every slot is where it should be."""
    bench, (places, speeds, addresses) = WheelBench(model), MODELS[model]
    wheel, slots = bench.homed(), (6, 1, 2, 5, 3, 4)
    for position in slots:
        wheel.move_to(position)
        assert (wheel.position(), bench.world.wheel_position) == (position, position)
    assert wheel.is_simulated
    identity = wheel.identity()
    assert (identity["model"], identity["addresses"]) == (model, addresses)
    moves = [struct.unpack("<Hi", data)[1] for data in bench.device.sent("MOT_MOVE_ABSOLUTE")]
    assert moves == [places[slot - 1] for slot in slots]
    sent = struct.unpack("<Hiii", bench.device.sent("MOT_SET_VELPARAMS")[0])
    assert sent == (1, 0, *speeds)
    order = [message.id for message in bench.device.received]
    assert max(order.index(0x0210), order.index(0x0440)) < order.index(0x0443)  # enabled, then home


@pytest.fixture
def bench() -> WheelBench:
    """A bench whose wheel was homed."""
    (bench := WheelBench()).homed()
    return bench


@pytest.mark.parametrize("turns", [-1, 1])
def test_slots_of_any_turn(bench: WheelBench, turns: int) -> None:
    """A wheel that was turned on, by a whole turn and a sixth, has the next slot in the beam."""
    bench.device.turn_to(turns * (409_600 + 68_267))
    bench.clock.sleep(30.0)
    assert bench.wheel.position() == bench.world.wheel_position == (2 if turns > 0 else 6)


def test_filters_are_called_by_their_band(bench: WheelBench) -> None:
    """The band that is selected is the one that the world's camera then sees."""
    (wheel := bench.wheel).select("9.5")
    assert (wheel.band(), bench.world.filter_name) == ("9.5", "9.5")
    assert_refused(r"Invalid band 'MW' .* one of \['9.5', 'LW', 'open'\]", wheel.select, "MW")
    for wrong in (0, 7):
        assert_refused(f"Invalid filter position {wrong}. Must lie in", wheel.move_to, wrong)
    wheel.move_to(2)
    assert_raises(WheelError, "No filter in slot 2", wheel.band)
    wheel.move_to(5)
    later = connected(bench.device)  # a new program need not home the wheel again
    assert later.band() == "LW"


def test_a_wheel_that_turns_or_rests_between_two_slots(bench: WheelBench) -> None:
    """It has no position and no filter in the beam, and is moved again once it was stopped."""
    bench.device.turn_to(200_000)
    assert bench.world.wheel_position is None
    assert_raises(WheelError, "still moving", bench.wheel.position)
    bench.clock.sleep(0.5)
    (wheel := bench.wheel).stop()
    assert_raises(WheelError, r"between two slots, at .* deg", wheel.position)
    wheel.move_to(2)
    assert wheel.position() == 2


def test_home_is_as_the_settings_say() -> None:
    """Direction and switch are sent; an offset of slot 1 is undone, and not detected if wrong."""
    bench = WheelBench(home_direction=1, home_limit_switch=4)
    right, wrong = WheelBench(slot_offset=12.5, home_offset=12.5), WheelBench(slot_offset=12.5)
    for turned, slot in ((bench, 2), (right, 2), (wrong, None)):
        turned.homed().move_to(2)
        assert (turned.world.wheel_position, turned.wheel.position()) == (slot, 2)
    assert struct.unpack("<HHHii", bench.device.sent("MOT_SET_HOMEPARAMS")[-1])[1:3] == (1, 4)


def test_a_wheel_that_is_not_homed() -> None:
    """It is neither moved nor said where it is; it is asked from several threads."""
    (wheel := WheelBench().wheel).connect()
    for attempt in (wheel.position, lambda: wheel.move_to(1), lambda: wheel.select("LW")):
        assert_raises(NotHomedError, "Must be homed", attempt)
    with ThreadPoolExecutor(max_workers=4) as pool:
        futures = [pool.submit(wheel.status) for _ in range(200)]
        assert len({status.result().position for status in futures}) == 1


SPEEDS = "01 00 00 00 00 00 9a 11 00 00 00 80 4f 01"
HOMES = "01 00 02 00 01 00 00 00 00 00 00 00 00 00", "01 00 02 00 01 00 9a 19 43 00 00 00 00 00"
GREETING = "18 00 00 00 {0} 01 12 00 00 00 {0} 01 05 00 00 00 {0} 01"
INFO = "06 00 54 00 81 11 00 5a 62 02 42 53 43 32 30 31 00 00 2d 00 00 00 01 00"
# Between a driver and a BSC201 until it is connected: what is written, and the answer.
CONNECTION = [
    (GREETING.format(11), f"{INFO} {'00' * 60} 01 00 00 00 01 00"),
    (f"13 04 0e 00 a1 01 {SPEEDS} 14 04 01 00 21 01", f"15 04 0e 00 81 21 {SPEEDS}"),
    ("41 04 01 00 21 01", f"42 04 0e 00 81 21 {HOMES[0]}"),
    (f"40 04 0e 00 a1 01 {HOMES[1]} 41 04 01 00 21 01", f"42 04 0e 00 81 21 {HOMES[1]}"),
    ("10 02 01 01 21 01 11 02 01 00 21 01", "12 02 01 01 01 21"),
]
PAIRS: list[Pair] = [(bytes.fromhex(sent), bytes.fromhex(answer)) for sent, answer in CONNECTION]
ASK = bytes.fromhex("80 04 01 00 21 01")


def status(position: int, bits: int) -> bytes:
    """Bytes of a status."""
    data = struct.pack("<HiiI", 1, position, 0, bits)
    return bytes.fromhex("81 04 0e 00 81 21") + data


def test_dialogue_of_a_move() -> None:
    """Every byte of a connection and a move, with the report of the end between two answers."""
    move = bytes.fromhex("53 04 06 00 A1 01 01 00 AB 0A 01 00")
    end = bytes.fromhex("64 04 01 00 01 21")
    talk: list[Pair] = [
        (ASK, status(0, 0x80000500)),
        (move + ASK, status(30_000, 0x80000510)),
        (ASK, [end[:2], end[2:] + status(68_267, 0x80000510)]),
        (ASK, status(68_267, 0x80000500)),
    ]
    with Dialogue([*PAIRS, *talk]) as dialogue:
        wheel = connected(dialogue)
        assert wheel.identity()["model"] == "BSC201"
        wheel.move_to(2)


def test_answers_of_others() -> None:
    """Stale answers and those of other bays or channels are ignored."""
    answer, old = status(3, 0), status(1, 0)
    other_bay = status(2, 0)[:5] + b"\x22" + status(2, 0)[6:]
    other_channel = answer[:6] + b"\x02" + answer[7:10] + b"\x01" + answer[11:]
    enabled: Pair = (PAIRS[-1][0], [bytes.fromhex("12 02 01 01 01 21"), old])
    talk: Pair = (ASK, [other_bay + other_channel, answer])
    with Dialogue([*PAIRS[:-1], enabled, talk]) as dialogue:
        assert connected(dialogue).status().position == 3


BANNER = b"Command error CMD_NOT_DEFINED\r\n> "  # of an FW102C
GREETINGS = [bytes.fromhex(GREETING.format(unit)) for unit in (11, 50)]
OTHERS: list[Pair] = [(GREETINGS[0], BANNER), (GREETINGS[1], None)]
STATES: list[Pair] = [(PAIRS[-1][0], bytes((0x12, 2, 1, state, 1, 0x21))) for state in (0, 3)]


@pytest.mark.parametrize(
    ("pairs", "message"),
    [
        (OTHERS, "33 bytes came that are no APT messages"),
        *(([*PAIRS[:-1], state], r"Unknown state . of the motor") for state in STATES),
    ],
)
def test_answers_that_are_none(pairs: list[Pair], message: str) -> None:
    """Text, and a motor that is neither enabled nor not, raise an error on connecting."""
    with Dialogue(pairs) as dialogue, pytest.raises(WheelError, match=message):
        connected(dialogue)


class Babbler(Dialogue):
    """A device that sends bytes whatever it is asked."""

    def write(self, data: bytes) -> None:
        """Take anything."""


@settings(max_examples=60)
@given(st.lists(st.binary(max_size=40), max_size=6))
def test_arbitrary_answers(answers: list[bytes]) -> None:
    """Connecting ends with a documented error for arbitrary answers, also if they never end."""
    with pytest.raises(WheelError):
        connected(Babbler([(None, answers)] if answers else []))
    with pytest.raises(WheelError, match="More than 65536 unsolicited bytes came"):
        connected(Babbler([(None, [bytes(256)] * 513)]))


REFUSED: list[tuple[dict[str, Any], type[WheelError], str]] = [
    ({"deaf_to": "MOT_SET_VELPARAMS"}, WheelError, "velocity 0. Must be 21987328"),
    ({"deaf_to": "MOT_SET_HOMEPARAMS"}, WheelError, "home velocity 0. Must be 4397466"),
    ({"deaf_to": "MOD_SET_CHANENABLESTATE"}, WheelError, "did not enable the motor"),
    ({"weak": 0.98}, WheelError, r"The controller has velocity \d+\. Must be 21987328"),
    ({"deaf_to": "all"}, NoReplyError, "No APT controller answered at 0x11, 0x50. It must be"),
    ({"model": "KDC101"}, WheelError, "Wrong device 'KDC101', number 40000000"),
    ({"serial_number": 7}, WheelError, "Wrong controller 40000000. Must be 7"),
]


@pytest.mark.parametrize(("case", "error", "message"), REFUSED)
def test_controllers_that_are_refused(
    case: dict[str, Any], error: type[WheelError], message: str
) -> None:
    """A controller that would not turn the wheel as it should raises an error on connecting."""
    bench = WheelBench(**case) if {"model", "serial_number"} & {*case} else WheelBench()
    vars(bench.device.faults).update(case)
    assert_raises(error, message, bench.wheel.connect)


@pytest.mark.parametrize(
    "faults",
    [
        {"single_bytes": True},
        {"hold": True},
        {"noise": b"\xff\x12\x04"},
        {"stray_completed": True, "late": 0.4},
        {"unreported": True},
        {"long_reports": True},
        {"late": 0.3},
        {"drop": 1},
        {"stuck": "JOGGING_FORWARD|JOGGING_REVERSE"},
        {"slow": 1.5},
    ],
    ids=lambda faults: next(iter(faults)),
)
def test_harmless_faults(bench: WheelBench, faults: dict[str, object]) -> None:
    """Split, merged, late, missing, unasked and noisy answers: the wheel is where it should be."""
    vars(bench.device.faults).update(faults)
    for position in (3, 6, 2):
        bench.wheel.move_to(position)
        assert bench.world.wheel_position == position == bench.wheel.position()


# Of a move to slot 3: fault, error, its text, if the wheel is stopped, and must then be homed.
STALLS: list[tuple[dict[str, Any], type[WheelError], str, bool, bool]] = [
    ({"stands_at": 20.0}, StalledWheelError, "120.00 deg: .* at 20.00 deg for 2", True, True),
    # It still moves, however near to its target it is seen twice.
    ({"stands_at": 119.95, "unreported": True}, StalledWheelError, "at 119.95 deg", True, True),
    ({"stops_short": 1.5}, StalledWheelError, "stopped at 118.50 deg. Must arrive", False, True),
    ({"deaf_to": "MOT_MOVE_ABSOLUTE"}, StalledWheelError, "did not start and is at 0", False, True),
    ({"stuck": "OVERLOAD"}, StalledWheelError, "OVERLOAD, and the wheel was stopped", True, True),
    ({"slow": 100.0}, WheelError, "deg after 20.0 s, and was stopped", True, False),
    ({"deaf_to": "all"}, NoReplyError, "must be on and in no other program's use", False, False),
    ({"notice": "motor hot"}, WheelError, "error 1 of message 0x0480: motor hot", False, False),
]


@pytest.mark.parametrize(("faults", "error", "message", "stopped", "lost"), STALLS)
def test_moves_that_fail(
    bench: WheelBench,
    faults: dict[str, Any],
    error: type[WheelError],
    message: str,
    stopped: bool,
    lost: bool,
) -> None:
    """A move that fails is an error in bounded time; where steps may be lost, home comes first."""
    wheel, before = bench.wheel, bench.clock()
    bench.device.faults = WheelFaults(**faults)
    assert_raises(error, message, wheel.move_to, 3)
    assert bench.clock() - before < 30.0
    assert bool(bench.device.sent("MOT_MOVE_STOP")) == stopped
    bench.device.faults = WheelFaults()
    if lost:
        assert_raises(NotHomedError, "lost steps", wheel.move_to, 1)
        wheel.home()
    wheel.move_to(3)
    assert bench.world.wheel_position == 3


@pytest.mark.parametrize(
    ("faults", "error", "message"),
    [
        ({"deaf_to": "MOT_MOVE_HOME"}, StalledWheelError, "Search for home: .* did not start"),
        ({"slow": 100.0}, WheelError, "Search for home: .* after 60.0 s"),
    ],
)
def test_searches_for_home_that_fail(
    bench: WheelBench, faults: dict[str, Any], error: type[WheelError], message: str
) -> None:
    """Neither the state nor the report of an earlier search counts, and the position is lost."""
    (wheel := bench.wheel).move_to(4)
    bench.device.receive(bytes.fromhex("43 04 01 00 21 01"))  # a search that no driver follows
    bench.clock.sleep(10.0)
    wheel.status()
    wheel.move_to(4)
    bench.device.faults = WheelFaults(**faults)
    assert_raises(error, message, wheel.home)
    bench.device.faults = WheelFaults()
    wheel.stop()
    assert_raises(NotHomedError, "Must be homed", wheel.position)


def test_moving_bits_that_stick(bench: WheelBench) -> None:
    """With stuck motion bits a move ends by its report, and the next move raises an error."""
    bench.device.faults = WheelFaults(stuck="MOVING_FORWARD", stuck_from=bench.clock() + 0.3)
    bench.wheel.move_to(3)
    assert bench.world.wheel_position == 3
    assert_raises(WheelError, "still moving", bench.wheel.move_to, 4)


def test_errors_of_the_greeting_are_logged_and_forgotten(caplog: pytest.LogCaptureFixture) -> None:
    """A controller need not know its greeting; what it says is logged. Later errors stop homing."""
    bench = WheelBench()
    bench.device.faults.notice = "unknown message"
    with caplog.at_level(logging.WARNING):
        bench.homed()
    assert "unknown message" in caplog.text
    bench.device.faults.notice = "motor cold"
    assert_raises(WheelError, "motor cold", bench.wheel.home)


def test_answers_that_come_too_late(bench: WheelBench, monkeypatch: pytest.MonkeyPatch) -> None:
    """Answers later than the limit may be those of an older question: never a wrong slot."""
    patient, wheel = WheelBench(), bench.wheel
    bench.device.faults.late = patient.device.faults.late = 1.2
    wheel.move_to(3)
    assert bench.world.wheel_position == wheel.position() == 3
    assert_raises(StalledWheelError, "did not start", wheel.move_to, 6)
    monkeypatch.setattr("dbthermal.instruments._apt.REPLY_TIMEOUT", 1.5)
    patient.homed().move_to(6)
    assert patient.world.wheel_position == 6


@settings(max_examples=60)
@given(st.binary(max_size=12), st.integers(0, 3))
def test_noise_on_the_line(noise: bytes, drop: int) -> None:
    """With any bytes before every answer, and some missing: the right slot, or a known error."""
    bench = WheelBench()
    bench.device.faults = WheelFaults(noise=noise, drop=drop)
    try:
        bench.homed().move_to(2)
    except WheelError:
        assert bench.clock() < 200.0
    else:
        assert bench.world.wheel_position == 2


@pytest.mark.parametrize("polls", [*range(1, 60, 2)])
def test_unplugging_at_any_step(polls: int) -> None:
    """Unplugging at any step raises the documented error, and closing still works, twice."""
    bench = WheelBench()
    bench.device.faults.polls = polls
    with pytest.raises(TransportError, match="Lost the emulated device"):
        bench.homed().select("9.5")
    for _ in range(2):
        bench.wheel.close()
