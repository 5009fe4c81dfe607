"""The filter wheel: messages, places, dialogues, faults."""

import logging
import struct
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import pytest
from device_benches import FILTERS, Clock, WheelBench
from dialogue import Dialogue, Pair
from hypothesis import given, settings
from hypothesis import strategies as st

from dbthermal.instruments import _apt as apt
from dbthermal.instruments._apt import LENGTHS, Id, command
from dbthermal.instruments._controller import BSC10X, BSC20X, MAXIMUM_UNSOLICITED
from dbthermal.instruments.emulated.apt import EmulatedApt
from dbthermal.instruments.emulated.line import Line
from dbthermal.instruments.emulated.world import World
from dbthermal.instruments.filterwheel import (
    FilterWheel,
    NoReplyError,
    NotHomedError,
    Settings,
    StalledWheelError,
    WheelError,
    WheelTimeoutError,
    WrongDeviceError,
)
from dbthermal.instruments.transport import Closing, TransportError

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


def test_places_are_sixths_of_a_turn() -> None:
    """Slots are at sixths of a turn, rounded one by one, for both families of controllers."""
    places = [BSC20X.target(position) for position in range(1, 7)]
    assert places == [0, 68_267, 136_533, 204_800, 273_067, 341_333]
    assert [BSC10X.target(k) for k in range(1, 7)] == [0, 4267, 8533, 12_800, 17_067, 21_333]
    assert [BSC20X.position(place, 0.001) for place in places] == [1, 2, 3, 4, 5, 6]
    assert BSC20X.position(409_600 + 68_267, 0.001) == 2
    assert BSC20X.position(-68_267, 0.001) == 6
    assert BSC20X.position(1000, 0.5) is None


def test_speeds_are_those_of_others() -> None:
    """1 turn/s and 1 turn/s^2 are the numbers that thorlabs_apt_device has."""
    assert BSC20X.device_speeds(1.0, 1.0) == (21_987_328, 4506)
    assert BSC10X.device_speeds(1.0, 1.0) == (25_600, 25_600)


@pytest.mark.parametrize("model", ["BSC201", "SCC201", "BSC101"])
def test_every_slot_turns_into_the_beam(model: str) -> None:
    """Rack or not, and whatever it calls itself: home, then every slot is where it should be."""
    bench = WheelBench(model)
    wheel = bench.homed()
    for position in (6, 1, 2, 5, 3, 4):
        wheel.move_to(position)
        assert (wheel.position(), bench.world.wheel_position) == (position, position)
    assert wheel.is_simulated
    assert wheel.identity()["model"] == model


def test_filters_are_called_by_their_band() -> None:
    """The band that is selected is the one that the world's camera then sees."""
    bench = WheelBench()
    wheel = bench.homed()
    wheel.select("9.5")
    assert (wheel.band(), bench.world.filter_name) == ("9.5", "9.5")
    with pytest.raises(ValueError, match=r"Invalid band 'MW' .* one of \['9.5', 'LW', 'open'\]"):
        wheel.select("MW")
    wheel.move_to(2)
    with pytest.raises(WheelError, match="No filter in slot 2"):
        wheel.band()


def test_no_other_messages() -> None:
    """The driver sends these messages and no others, and enables the motor before it moves."""
    bench = WheelBench()
    bench.homed().move_to(3)
    assert {message.id for message in bench.device.received} <= {*apt.Id}
    order = [message.id for message in bench.device.received]
    for before in (apt.Id.MOD_SET_CHANENABLESTATE, apt.Id.MOT_SET_HOMEPARAMS):
        assert order.index(before) < order.index(apt.Id.MOT_MOVE_HOME)


def test_the_beam_is_empty_while_the_wheel_turns() -> None:
    """Until it has arrived, no filter is in the beam of the world."""
    bench = WheelBench()
    bench.homed()
    bench.move(68_267)
    assert bench.world.wheel_position is None
    with pytest.raises(WheelError, match="still moving"):
        bench.wheel.position()


def test_offset_from_the_home_switch() -> None:
    """An offset of slot 1 from the home switch is a setting; a wrong one is not detected."""
    right, wrong = WheelBench(slot_offset=12.5, home_offset=12.5), WheelBench(slot_offset=12.5)
    right.homed().move_to(2)
    wrong.homed().move_to(2)
    assert right.world.wheel_position == right.wheel.position() == 2
    assert (wrong.world.wheel_position, wrong.wheel.position()) == (None, 2)


def test_home_direction_is_a_setting() -> None:
    """Home settings that are stated are sent, and the others stay as in the controller."""
    bench = WheelBench(home_direction=1, home_limit_switch=4)
    bench.homed().move_to(2)
    parameters = apt.HomeParameters.parse(bench.sent(apt.Id.MOT_SET_HOMEPARAMS)[-1])
    assert (parameters.direction, parameters.limit_switch, parameters.offset) == (1, 4, 0)
    assert bench.world.wheel_position == 2


def test_a_wheel_must_be_homed() -> None:
    """Before it was homed, the driver does not turn the wheel."""
    bench = WheelBench()
    bench.wheel.connect()
    for attempt in (bench.wheel.position, lambda: bench.wheel.move_to(1)):
        with pytest.raises(NotHomedError, match="Must be homed"):
            attempt()


def test_a_controller_that_was_homed_before_is_taken_over() -> None:
    """A new program need not home the wheel again if the controller kept its power."""
    bench = WheelBench()
    bench.homed().move_to(5)
    loop = Line(bench.device, bench.clock)
    with FilterWheel(loop, FILTERS) as wheel:
        wheel.connect()
        assert wheel.band() == "LW"


def test_stop() -> None:
    """A wheel stopped between two slots has no position, and can be moved again."""
    bench = WheelBench()
    wheel = bench.homed()
    bench.move(200_000)
    bench.clock.sleep(0.5)
    wheel.stop()
    with pytest.raises(WheelError, match=r"between two slots, at .* deg"):
        wheel.position()
    wheel.move_to(2)
    assert wheel.position() == 2


@pytest.mark.parametrize("model", ["BSC201", "BSC101"])
def test_addresses_are_looked_for(model: str) -> None:
    """A rack ignores what is sent to a unit, a unit what is sent to a rack: both are tried."""
    bench = WheelBench(model)
    bench.wheel.connect()
    expected = "0x11, 0x21" if model == "BSC201" else "0x50, 0x50"
    assert bench.wheel.identity()["addresses"] == expected
    bench.device.faults.silent = True
    with pytest.raises(NoReplyError, match=r"No APT controller answered at 0x11, 0x50. It must be"):
        bench.wheel.connect()


def test_wrong_devices() -> None:
    """Another model or serial number raises an error that names it."""
    with pytest.raises(WrongDeviceError, match="Wrong device 'KDC101', number 40000000"):
        WheelBench("KDC101").wheel.connect()
    with pytest.raises(WrongDeviceError, match=r"Wrong controller 40000000. Must be 7"):
        WheelBench(serial_number=7).wheel.connect()


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"velocity": 0.0}, r"velocity\n.* greater than or equal to 0.1 .*input_value=0.0"),
        ({"velocity": 100.0}, r"velocity\n.* less than or equal to 90 .*input_value=100.0"),
        ({"velocity": float("nan")}, r"velocity\n.* less than or equal to 90 .*=nan"),
        ({"home_offset": 400.0}, r"home_offset\n.* less than 360 .*input_value=400.0"),
        ({"home_direction": 3}, r"home_direction\n.* 1 or 2 .*input_value=3"),
    ],
)
def test_settings_are_checked(options: dict[str, object], error: str) -> None:
    """Invalid settings and slots raise a ValueError before the wheel moves."""
    with pytest.raises(ValueError, match=error):
        Settings(**options)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="Invalid filter position 0"):
        WheelBench().homed().move_to(0)


def test_by_name_of_an_emulator() -> None:
    """A wheel in a world is opened by its name, and turns what the world's camera sees."""
    world = World(filters=FILTERS, wheel_position=3)
    with FilterWheel.from_url("sim://apt/wheel", FILTERS, world=world) as wheel:
        assert wheel.is_simulated
        with pytest.raises(NotHomedError):
            wheel.select("LW")
    with pytest.raises(ValueError, match="Invalid model 'X'"):
        EmulatedApt(world, model="X")


def test_the_largest_number_of_a_controller() -> None:
    """The largest serial number has room in the emulator's answer."""
    device = EmulatedApt(World(), serial_number=2**32 - 1)
    assert len(device.info.pack()) == 84


def test_several_threads_may_ask() -> None:
    """A recorder that reads the status in its own thread takes no other thread's reply."""
    with (
        FilterWheel.from_url("sim://apt", FILTERS) as wheel,
        ThreadPoolExecutor(max_workers=4) as pool,
    ):
        asked = [pool.submit(wheel.status) for _ in range(200)]
        assert len({status.result().position for status in asked}) == 1


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


def test_unset_speeds_make_homing_do_nothing() -> None:
    """A controller that ignores the speeds fails on connecting, before it is homed."""
    bench = WheelBench()
    bench.device.faults.deaf_to = {apt.Id.MOT_SET_VELPARAMS}
    with pytest.raises(WheelError, match=r"velocity 0. Must be 21987328"):
        bench.wheel.connect()
    bench.device.faults.deaf_to = {apt.Id.MOT_SET_HOMEPARAMS}
    with pytest.raises(WheelError, match=r"home velocity 0. Must be 4397466"):
        bench.wheel.connect()
    bench.device.faults.deaf_to = {apt.Id.MOT_MOVE_HOME}
    with pytest.raises(StalledWheelError, match="Search for home: the wheel did not start"):
        bench.homed()


def test_an_earlier_search_for_home_does_not_count() -> None:
    """Neither the bit nor the report of an earlier search for home ends the next one."""
    bench = WheelBench()
    wheel = bench.homed()
    bench.device.receive(apt.command(apt.Id.MOT_MOVE_HOME, 1, destination=apt.BAY_1))
    bench.clock.sleep(10.0)
    wheel.status()
    bench.device.faults.deaf_to = {apt.Id.MOT_MOVE_HOME}
    with pytest.raises(StalledWheelError, match="did not start"):
        wheel.home()


def test_motor_that_is_not_enabled() -> None:
    """A controller that does not power the motor is detected on connecting."""
    bench = WheelBench()
    bench.device.faults.deaf_to = {apt.Id.MOD_SET_CHANENABLESTATE}
    with pytest.raises(WheelError, match="did not enable the motor"):
        bench.wheel.connect()


@pytest.mark.parametrize(
    "faults",
    [
        {"single_bytes": True},
        {"hold": True},
        {"noise": b"\xff\x12\x04"},
        {"stray_completed": True},
        {"unreported": True},
        {"long_reports": True},
        {"late": 0.3},
        {"drop": 1},
        {"stuck": apt.StatusBits.JOGGING_FORWARD | apt.StatusBits.JOGGING_REVERSE},
        {"slow": 1.5},
    ],
    ids=lambda faults: next(iter(faults)),
)
def test_harmless_faults(faults: dict[str, object]) -> None:
    """Split, merged, late, missing, unasked and noisy answers: the wheel is where it should be."""
    bench = WheelBench()
    wheel = bench.homed()
    for name, value in faults.items():
        setattr(bench.device.faults, name, value)
    for position in (3, 6, 2):
        wheel.move_to(position)
        assert bench.world.wheel_position == position == wheel.position()


def test_moving_bits_that_stick() -> None:
    """With stuck motion bits a move ends by its report, and the next move raises an error."""
    bench = WheelBench()
    wheel = bench.homed()

    def stick() -> None:
        bench.device.faults.stuck = apt.StatusBits.MOVING_FORWARD

    bench.clock.events.append((bench.clock.now + 0.3, stick))
    wheel.move_to(3)
    assert bench.world.wheel_position == 3
    with pytest.raises(WheelError, match="still moving"):
        wheel.move_to(4)


def test_stall() -> None:
    """A wheel that stands though it should move is stopped, and must be homed again."""
    bench = WheelBench()
    wheel = bench.homed()
    bench.device.faults.stands_after = 20.0
    message = r"Move to 120.00 deg: the wheel stood at 20.00 deg for 2.0 s .* was stopped"
    with pytest.raises(StalledWheelError, match=message):
        wheel.move_to(3)
    assert bench.sent(apt.Id.MOT_MOVE_STOP)
    with pytest.raises(NotHomedError, match="lost steps"):
        wheel.move_to(1)
    bench.device.faults.stands_after = 360.0
    wheel.home()
    wheel.move_to(3)
    assert bench.world.wheel_position == 3


def test_move_that_ends_elsewhere() -> None:
    """A reported end of a move away from its target raises an error."""
    bench = WheelBench()
    wheel = bench.homed()
    bench.device.faults.stops_short = 1.5
    with pytest.raises(StalledWheelError, match=r"the wheel stopped at 118.50 deg. Must arrive"):
        wheel.move_to(3)


def test_move_that_does_not_start() -> None:
    """A move that the controller ignores is an error after a while."""
    bench = WheelBench()
    wheel = bench.homed()
    bench.device.faults.deaf_to = {apt.Id.MOT_MOVE_ABSOLUTE}
    with pytest.raises(StalledWheelError, match=r"the wheel did not start and is at 0.00 deg"):
        wheel.move_to(3)
    assert bench.clock.now < 60.0


def test_slow_wheel() -> None:
    """A move or a search for home that takes too long is stopped, and says where it was."""
    bench = WheelBench()
    wheel = bench.homed()
    bench.device.faults.slow = 30.0
    with pytest.raises(WheelTimeoutError, match=r"still at .* deg after 20.0 s, and was stopped"):
        wheel.move_to(4)
    bench.device.faults.slow = 1.0
    wheel.move_to(4)
    bench.device.faults.slow = 30.0
    with pytest.raises(WheelTimeoutError, match=r"Search for home: .* after 60.0 s"):
        wheel.home()
    with pytest.raises(NotHomedError):
        wheel.move_to(1)


def test_lost_steps_are_seen_by_nobody() -> None:
    """Without an encoder lost steps are not detected; homing restores the position."""
    bench = WheelBench()
    wheel = bench.homed()
    bench.device.faults.slips = 5.0
    wheel.move_to(3)
    assert (wheel.position(), bench.world.wheel_position) == (3, None)
    bench.device.faults.slips = 0.0
    wheel.home()
    wheel.move_to(3)
    assert bench.world.wheel_position == 3


def test_errors_of_the_controller() -> None:
    """An error that the controller reports stops the next command once, with its text."""
    bench = WheelBench()
    wheel = bench.homed()
    bench.device.faults.notice = "motor hot"
    with pytest.raises(WheelError, match="It reported error 1 of message 0x0480: motor hot"):
        wheel.move_to(3)
    assert not bench.sent(apt.Id.MOT_MOVE_ABSOLUTE)
    wheel.move_to(3)
    bench.device.faults.notice = "motor cold"
    with pytest.raises(WheelError, match="motor cold"):
        wheel.home()


def test_an_overload_costs_the_position() -> None:
    """After an overload steps may be lost: the wheel has to be homed before it turns again."""
    bench = WheelBench()
    wheel = bench.homed()
    bench.device.faults.stuck = apt.StatusBits.OVERLOAD
    with pytest.raises(StalledWheelError, match="reports OVERLOAD, and the wheel was stopped"):
        wheel.move_to(3)
    assert bench.sent(apt.Id.MOT_MOVE_STOP)
    bench.device.faults.stuck = apt.StatusBits(0)
    with pytest.raises(NotHomedError):
        wheel.move_to(3)
    wheel.home()
    wheel.move_to(3)
    assert bench.world.wheel_position == 3


def test_answers_that_come_too_late(monkeypatch: pytest.MonkeyPatch) -> None:
    """Answers later than the limit may be those of an older question: never a wrong slot."""
    bench, patient = WheelBench(), WheelBench()
    wheel = bench.homed()
    bench.device.faults.late = patient.device.faults.late = 1.2
    wheel.move_to(3)
    assert bench.world.wheel_position == wheel.position() == 3
    with pytest.raises(StalledWheelError, match="did not start"):
        wheel.move_to(6)
    monkeypatch.setattr("dbthermal.instruments._controller.REPLY_TIMEOUT", 1.5)
    patient.homed().move_to(6)
    assert patient.world.wheel_position == 6


def test_silence_in_a_move() -> None:
    """A controller that falls silent is an error in bounded time, not a wait for ever."""
    bench = WheelBench()
    wheel = bench.homed()
    bench.device.faults.silent = True
    before = bench.clock.now
    with pytest.raises(NoReplyError, match="must be on and in no other program's use"):
        wheel.move_to(2)
    assert bench.clock.now - before < 3.0


def test_unplugged() -> None:
    """A cable that was pulled out is an error at once, and closing is still allowed, twice."""
    bench = WheelBench()
    wheel = bench.homed()
    bench.device.plugged = False
    with pytest.raises(TransportError, match="Lost the emulated device"):
        wheel.move_to(2)
    wheel.close()
    wheel.close()


def test_late_report_of_an_earlier_move() -> None:
    """A stale report before the wheel starts does not end the move, nor make it a stall."""
    bench = WheelBench()
    wheel = bench.homed()
    bench.device.faults.stray_completed = True
    bench.device.faults.late = 0.4
    wheel.move_to(4)
    assert bench.world.wheel_position == 4


@settings(max_examples=60)
@given(st.binary(max_size=12), st.integers(0, 3))
def test_noise_on_the_line(noise: bytes, drop: int) -> None:
    """With any bytes before every answer, and some missing: the right slot, or a known error."""
    bench = WheelBench()
    bench.device.faults.noise = noise
    bench.device.faults.drop = drop
    try:
        bench.homed().move_to(2)
    except WheelError:
        assert bench.clock.now < 200.0
    else:
        assert bench.world.wheel_position == 2


class Endless(Closing):
    """A device that talks without end."""

    is_simulated = True

    def __init__(self, limit: int) -> None:
        self.left, self.clock = limit, Clock()

    def write(self, data: bytes) -> None:
        """Take anything."""

    def read(self, size: int, timeout: float) -> bytes:  # noqa: ARG002 - it never waits
        """Talk; far beyond what the driver should listen to, the test fails."""
        self.left -= size
        if self.left < 0:
            pytest.fail("The driver listens without end.")
        return bytes(size)

    def close(self) -> None:
        """End."""


def test_a_device_that_never_ends_is_another_one() -> None:
    """An endless stream of bytes ends the wait with an error."""
    line = Endless(2 * MAXIMUM_UNSOLICITED)
    wheel = FilterWheel(line, {})
    with pytest.raises(WrongDeviceError, match="More than 65536 unsolicited bytes came"):
        wheel.connect()


class Unplugged(Closing):
    """A line that is gone after a number of reads and writes."""

    is_simulated = True

    def __init__(self, line: Line, steps: int) -> None:
        self.line, self.steps, self.clock = line, steps, line.clock

    def _step(self, name: str, *arguments: object) -> bytes:
        self.steps -= 1
        if self.steps < 0:
            raise TransportError("unplugged")
        found: bytes = getattr(self.line, name)(*arguments)
        return found

    def write(self, data: bytes) -> None:
        """Send."""
        self._step("write", data)

    def read(self, size: int, timeout: float) -> bytes:
        """Receive."""
        return self._step("read", size, timeout)

    def close(self) -> None:
        """End."""
        self.line.close()


@pytest.mark.parametrize("steps", [*range(0, 90, 3)])
def test_unplugging_at_any_step(steps: int) -> None:
    """Unplugging at any step raises the documented error, and closing still works."""
    bench = WheelBench()
    line = Unplugged(Line(bench.device, bench.clock), steps)
    wheel = FilterWheel(line, FILTERS)

    def use() -> None:
        wheel.connect()
        wheel.home()
        wheel.select("9.5")

    with pytest.raises(TransportError, match="unplugged"):
        use()
    for _ in range(2):
        wheel.close()


def test_a_lost_position_stays_lost() -> None:
    """Though the controller still says that it was homed, the driver does not believe it."""
    bench = WheelBench()
    wheel = bench.homed()
    bench.device.faults.deaf_to = {apt.Id.MOT_MOVE_HOME}
    with pytest.raises(StalledWheelError):
        wheel.home()
    bench.device.faults.deaf_to = set()
    wheel.stop()
    assert wheel.status().bits & apt.StatusBits.HOMED
    with pytest.raises(NotHomedError, match="Must be homed"):
        wheel.position()


def test_errors_of_the_greeting_are_logged_and_forgotten(caplog: pytest.LogCaptureFixture) -> None:
    """A controller need not know all that it is greeted with; what it says is in the log."""
    bench = WheelBench()
    bench.device.faults.notice = "unknown message"
    with caplog.at_level(logging.WARNING):
        bench.wheel.connect()
    assert "unknown message" in caplog.text


def test_a_speed_that_is_a_little_off_is_refused() -> None:
    """A controller that sets a speed 2 % lower raises an error."""
    bench = WheelBench()
    bench.device.faults.weak = 0.98
    with pytest.raises(WheelError, match=r"The controller has velocity \d+\. Must be 21987328"):
        bench.wheel.connect()


def test_passing_a_target_is_no_arrival() -> None:
    """A wheel that still moves is not there, however near to its target it is seen twice."""
    bench = WheelBench()
    bench.homed()
    bench.device.faults.stands_after = 60.05
    bench.device.faults.unreported = True
    with pytest.raises(StalledWheelError, match=r"stood at 60\.05 deg for 2\.0 s"):
        bench.wheel.move_to(3)
    assert bench.sent(apt.Id.MOT_MOVE_STOP)
