"""The filter wheel: byte dialogues, the emulated wheel in memory and on a line, and its faults."""

import os
from collections.abc import Callable, Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dbthermal.instruments import apt
from dbthermal.instruments.dialogue import Dialogue, Pair
from dbthermal.instruments.emulated.apt import EmulatedApt, start
from dbthermal.instruments.emulated.port import EmulatedPort, Loop
from dbthermal.instruments.emulated.world import World
from dbthermal.instruments.filterwheel import (
    BSC10X,
    BSC20X,
    ControllerError,
    FilterWheel,
    NoReplyError,
    NotHomedError,
    Settings,
    StalledWheelError,
    WheelError,
    WheelTimeoutError,
    WrongDeviceError,
)
from dbthermal.instruments.transport import TransportError

FILTERS = {1: "open", 3: "9.5", 5: "LW"}
SETTINGS = Settings(filters=FILTERS)


class Clock:
    """Time that passes only when somebody waits."""

    def __init__(self) -> None:
        self.time = 0.0
        self.events: list[tuple[float, Callable[[], None]]] = []

    def __call__(self) -> float:
        """Time [s]."""
        return self.time

    def sleep(self, duration: float) -> None:
        """Let time pass [s], and do what is due."""
        self.time += duration
        due = [event for event in self.events if event[0] <= self.time]
        for event in due:
            self.events.remove(event)
            event[1]()


class Bench:
    """An emulated wheel, and the driver that turns it, on one clock that takes no time."""

    def __init__(self, model: str = "BSC201", slot_offset: float = 0.0, **options: object) -> None:
        self.clock = Clock()
        self.world = World(clock=self.clock, filters=FILTERS, wheel_position=4)
        self.device = EmulatedApt(self.world, model=model, slot_offset=slot_offset)
        loop = Loop(self.device, clock=self.clock, sleep=self.clock.sleep)
        chosen = Settings(filters=FILTERS, **options)  # type: ignore[arg-type]
        self.wheel = FilterWheel(loop, chosen, clock=self.clock, sleep=self.clock.sleep)

    def homed(self) -> FilterWheel:
        """Connect and home the wheel."""
        self.wheel.connect()
        self.wheel.home()
        return self.wheel

    def sent(self, identifier: apt.Id) -> list[apt.Message]:
        """What the driver sent of one kind."""
        return [message for message in self.device.received if message.id == identifier]


def test_places_are_sixths_of_a_turn() -> None:
    """Each place is rounded by itself, for both families of controllers, and comes back."""
    places = [BSC20X.target(position) for position in range(1, 7)]
    assert places == [0, 68_267, 136_533, 204_800, 273_067, 341_333]
    assert [BSC10X.target(k) for k in range(1, 7)] == [0, 4267, 8533, 12_800, 17_067, 21_333]
    assert [BSC20X.position(place, 0.001) for place in places] == [1, 2, 3, 4, 5, 6]
    assert BSC20X.position(409_600 + 68_267, 0.001) == 2
    assert BSC20X.position(-68_267, 0.001) == 6
    assert BSC20X.position(1000, 0.5) is None


def test_speeds_are_those_of_others() -> None:
    """1 turn/s and 1 turn/s^2 are the numbers that thorlabs_apt_device has."""
    assert BSC20X.device_velocity(1.0) == 21_987_328
    assert BSC20X.device_acceleration(1.0) == 4506
    assert BSC10X.device_velocity(1.0) == 25_600


@pytest.mark.parametrize("model", ["BSC201", "SCC201", "BSC101"])
def test_every_slot_turns_into_the_beam(model: str) -> None:
    """Rack or not, and whatever it calls itself: home, then every slot is where it should be."""
    bench = Bench(model)
    wheel = bench.homed()
    for position in (6, 1, 2, 5, 3, 4):
        wheel.move_to(position)
        assert (wheel.position(), bench.world.wheel_position) == (position, position)
    assert wheel.is_simulated
    assert wheel.identity["model"] == model


def test_filters_are_called_by_their_band() -> None:
    """The band that is selected is the one that the world's camera then sees."""
    bench = Bench()
    wheel = bench.homed()
    wheel.select("9.5")
    assert (wheel.band(), bench.world.filter_name) == ("9.5", "9.5")
    with pytest.raises(ValueError, match=r"Invalid band 'MW' .* one of \['9.5', 'LW', 'open'\]"):
        wheel.select("MW")
    wheel.move_to(2)
    with pytest.raises(WheelError, match="No filter in slot 2"):
        wheel.band()


def test_only_absolute_moves_and_no_updates() -> None:
    """The driver never moves relatively, never starts updates, and enables before it moves."""
    bench = Bench()
    bench.homed().move_to(3)
    assert not bench.sent(apt.Id.MOT_MOVE_RELATIVE)
    assert not bench.sent(apt.Id.HW_START_UPDATEMSGS)
    order = [message.id for message in bench.device.received]
    for before in (apt.Id.MOD_SET_CHANENABLESTATE, apt.Id.MOT_SET_HOMEPARAMS):
        assert order.index(before) < order.index(apt.Id.MOT_MOVE_HOME)


def test_the_beam_is_empty_while_the_wheel_turns() -> None:
    """Until it has arrived, no filter is in the beam of the world."""
    bench = Bench()
    bench.homed()
    bench.device.receive(apt.move_absolute(1, 68_267, destination=apt.BAY_1))
    assert bench.world.wheel_position is None
    with pytest.raises(WheelError, match="still moving"):
        bench.wheel.position()


def test_offset_from_the_home_switch() -> None:
    """Where slot 1 is not at the home switch, a setting says so; what it says is not checked."""
    right, wrong = Bench(slot_offset=12.5, home_offset=12.5), Bench(slot_offset=12.5)
    right.homed().move_to(2)
    wrong.homed().move_to(2)
    assert right.world.wheel_position == right.wheel.position() == 2
    assert (wrong.world.wheel_position, wrong.wheel.position()) == (None, 2)


def test_home_direction_is_a_setting() -> None:
    """What is given is set, the rest stays as the controller has it."""
    bench = Bench(home_direction=1, home_limit_switch=4)
    bench.homed().move_to(2)
    parameters = apt.HomeParameters.parse(bench.sent(apt.Id.MOT_SET_HOMEPARAMS)[-1])
    assert (parameters.direction, parameters.limit_switch, parameters.offset) == (1, 4, 0)
    assert bench.world.wheel_position == 2


def test_a_wheel_must_be_homed() -> None:
    """Before it was homed, and after an immediate stop, the driver does not turn the wheel."""
    bench = Bench()
    bench.wheel.connect()
    with pytest.raises(NotHomedError, match="Must be homed"):
        bench.wheel.move_to(1)
    bench.wheel.home()
    bench.wheel.stop(immediate=True)
    with pytest.raises(NotHomedError, match="has lost steps"):
        bench.wheel.position()


def test_a_controller_that_was_homed_before_is_taken_over() -> None:
    """A new program need not home the wheel again if the controller kept its power."""
    bench = Bench()
    bench.homed().move_to(5)
    loop = Loop(bench.device, clock=bench.clock, sleep=bench.clock.sleep)
    with FilterWheel(loop, SETTINGS, clock=bench.clock, sleep=bench.clock.sleep) as wheel:
        wheel.connect()
        assert wheel.band() == "LW"


def test_stop() -> None:
    """A wheel that was stopped between two slots says so, and goes on when it is told to."""
    bench = Bench()
    wheel = bench.homed()
    bench.device.receive(apt.move_absolute(1, 200_000, destination=apt.BAY_1))
    bench.clock.sleep(0.5)
    wheel.stop()
    with pytest.raises(WheelError, match=r"between two slots, at .* deg"):
        wheel.position()
    wheel.move_to(2)
    assert wheel.position() == 2


def test_no_raw_move_without_current() -> None:
    """The emulated motor runs away if it is moved before it is enabled, as users report."""
    bench = Bench()
    parameters = apt.VelocityParameters(1, 0, 4506, 21_987_328)
    bench.device.receive(apt.set_velocity_parameters(parameters, destination=apt.BAY_1))
    bench.device.receive(apt.move_absolute(1, 100, destination=apt.BAY_1))
    bench.clock.sleep(100.0)
    bench.device.poll()
    assert bench.device.motor.position > 10_000_000


def test_started_updates_end_in_silence() -> None:
    """The emulated controller stops answering 5 s after its updates were started."""
    bench = Bench()
    bench.wheel.connect()
    bench.device.receive(apt.start_updates(destination=apt.RACK))
    for _ in range(60):
        bench.clock.sleep(0.1)
        bench.device.poll()
    with pytest.raises(NoReplyError, match="No answer MOT_GET_STATUSUPDATE from address 0x21"):
        bench.wheel.status()


def test_unset_speeds_make_homing_do_nothing() -> None:
    """A controller that does not take the speeds is found out before it is asked to home."""
    bench = Bench()
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
    bench = Bench()
    wheel = bench.homed()
    bench.device.receive(apt.home(1, destination=apt.BAY_1))
    bench.clock.sleep(10.0)
    wheel.status()
    bench.device.faults.deaf_to = {apt.Id.MOT_MOVE_HOME}
    with pytest.raises(StalledWheelError, match="did not start"):
        wheel.home()


def test_motor_that_is_not_enabled() -> None:
    """A controller that gives the motor no current is found out when it is connected."""
    bench = Bench()
    bench.device.faults.deaf_to = {apt.Id.MOD_SET_CHANENABLESTATE}
    with pytest.raises(WheelError, match="did not enable the motor"):
        bench.wheel.connect()


@pytest.mark.parametrize("model", ["BSC201", "BSC101"])
def test_addresses_are_looked_for(model: str) -> None:
    """A rack ignores what is sent to a unit, a unit what is sent to a rack: both are tried."""
    bench = Bench(model)
    bench.wheel.connect()
    expected = "0x11, 0x21" if model == "BSC201" else "0x50, 0x50"
    assert bench.wheel.identity["addresses"] == expected
    wrong = Bench(model, addresses=((0x22, 0x23),))
    with pytest.raises(NoReplyError, match=r"No APT controller answered at 0x22. It must be on"):
        wrong.wheel.connect()


def test_motor_at_another_address() -> None:
    """A controller that answers while its motor does not says which address is silent."""
    bench = Bench(addresses=((apt.RACK, 0x22),))
    with pytest.raises(NoReplyError, match="MOT_GET_VELPARAMS from address 0x22"):
        bench.wheel.connect()


def test_wrong_devices() -> None:
    """Another model, another number, and another language are each refused by name."""
    with pytest.raises(WrongDeviceError, match="Wrong device 'KDC101', number 40000000"):
        Bench("KDC101").wheel.connect()
    with pytest.raises(WrongDeviceError, match=r"Wrong controller 40000000. Must be 7"):
        Bench(serial_number=7).wheel.connect()
    request = apt.no_flash_programming(destination=apt.UNIT)
    request += apt.stop_updates(destination=apt.UNIT) + apt.request_info(destination=apt.UNIT)
    other = Dialogue([(request, b"Command error CMD_NOT_DEFINED\r\n> ")])
    chosen = Settings(addresses=((apt.UNIT, apt.UNIT),))
    with other, pytest.raises(WrongDeviceError, match="33 bytes came that are no APT messages"):
        FilterWheel(other, chosen).connect()


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
    bench = Bench()
    wheel = bench.homed()
    for name, value in faults.items():
        setattr(bench.device.faults, name, value)
    for position in (3, 6, 2):
        wheel.move_to(position)
        assert bench.world.wheel_position == position == wheel.position()


def test_moving_bits_that_stick() -> None:
    """Where the bits of a move stick, its report ends it; the next one is refused."""
    bench = Bench()
    wheel = bench.homed()

    def stick() -> None:
        bench.device.faults.stuck = apt.StatusBits.MOVING_FORWARD

    bench.clock.events.append((bench.clock.time + 0.3, stick))
    wheel.move_to(3)
    assert bench.world.wheel_position == 3
    with pytest.raises(WheelError, match="still moving"):
        wheel.move_to(4)


def test_stall() -> None:
    """A wheel that stands though it should move is stopped, and must be homed again."""
    bench = Bench()
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
    """That the controller says it is done is not believed where the wheel is elsewhere."""
    bench = Bench()
    wheel = bench.homed()
    bench.device.faults.stops_short = 1.5
    with pytest.raises(StalledWheelError, match=r"the wheel stopped at 118.50 deg. Must arrive"):
        wheel.move_to(3)


def test_move_that_does_not_start() -> None:
    """A move that the controller ignores is an error after a while."""
    bench = Bench()
    wheel = bench.homed()
    bench.device.faults.deaf_to = {apt.Id.MOT_MOVE_ABSOLUTE}
    with pytest.raises(StalledWheelError, match=r"the wheel did not start and is at 0.00 deg"):
        wheel.move_to(3)
    assert bench.clock.time < 60.0


def test_slow_wheel() -> None:
    """A move or a search for home that takes too long is stopped, and says where it was."""
    bench = Bench(move_timeout=5.0, home_timeout=10.0)
    wheel = bench.homed()
    bench.device.faults.slow = 30.0
    with pytest.raises(WheelTimeoutError, match=r"still at .* deg after 5.0 s, and was stopped"):
        wheel.move_to(4)
    bench.device.faults.slow = 1.0
    wheel.move_to(4)
    bench.device.faults.slow = 30.0
    with pytest.raises(WheelTimeoutError, match=r"Search for home: .* after 10.0 s"):
        wheel.home()
    with pytest.raises(NotHomedError):
        wheel.move_to(1)


def test_lost_steps_are_seen_by_nobody() -> None:
    """Without an encoder a slip goes unnoticed, which the driver says; homing undoes it."""
    bench = Bench()
    wheel = bench.homed()
    bench.device.faults.slips = 5.0
    wheel.move_to(3)
    assert (wheel.position(), bench.world.wheel_position) == (3, None)
    bench.device.faults.slips = 0.0
    wheel.home()
    wheel.move_to(3)
    assert bench.world.wheel_position == 3


def test_errors_of_the_controller() -> None:
    """What the controller reports by itself stops what is to come, with its text, once."""
    bench = Bench()
    wheel = bench.homed()
    bench.device.faults.notice = "motor hot"
    with pytest.raises(ControllerError, match="It reported error 1 of message 0x0480: motor hot"):
        wheel.move_to(3)
    assert not bench.sent(apt.Id.MOT_MOVE_ABSOLUTE)
    wheel.move_to(3)
    bench.device.faults.notice = "motor cold"
    with pytest.raises(ControllerError, match="motor cold"):
        wheel.home()


def test_overload() -> None:
    """A motor whose controller reports an overload is stopped."""
    bench = Bench()
    wheel = bench.homed()
    bench.device.faults.stuck = apt.StatusBits.OVERLOAD
    with pytest.raises(WheelError, match=r"The controller reports .*OVERLOAD"):
        wheel.move_to(3)
    assert bench.sent(apt.Id.MOT_MOVE_STOP)


def test_answers_that_come_too_late() -> None:
    """Answers later than the limit may be those of an older question: never a wrong slot."""
    bench, patient = Bench(), Bench(reply_timeout=1.5)
    wheel = bench.homed()
    bench.device.faults.late = patient.device.faults.late = 1.2
    wheel.move_to(3)
    assert bench.world.wheel_position == wheel.position() == 3
    with pytest.raises(StalledWheelError, match="did not start"):
        wheel.move_to(6)
    patient.homed().move_to(6)
    assert patient.world.wheel_position == 6


def test_silence_in_a_move() -> None:
    """A controller that falls silent is an error in bounded time, not a wait for ever."""
    bench = Bench()
    wheel = bench.homed()
    bench.device.faults.silent = True
    before = bench.clock.time
    with pytest.raises(NoReplyError, match="must be on and in no other program's use"):
        wheel.move_to(2)
    assert bench.clock.time - before < 3.0


def test_unplugged() -> None:
    """A cable that was pulled out is an error at once, and closing is still allowed, twice."""
    bench = Bench()
    wheel = bench.homed()
    bench.device.plugged = False
    with pytest.raises(TransportError, match="Lost the emulated device"):
        wheel.move_to(2)
    wheel.close()
    wheel.close()


def _greeting(unit: int) -> bytes:
    start_ = apt.no_flash_programming(destination=unit) + apt.stop_updates(destination=unit)
    return start_ + apt.request_info(destination=unit)


def _reply(identifier: apt.Id, data: bytes, *, source: int = apt.BAY_1) -> bytes:
    return apt.encode(apt.Message(identifier, 0, 0, apt.HOST, source, data))


def _connection() -> list[Pair]:
    """What a driver and a BSC201 say to each other, byte for byte, until it is connected."""
    to, info = apt.BAY_1, apt.Info(40_000_000, "BSC201", 45, "1.0.0", 1, 0, 1)
    speeds = apt.VelocityParameters(1, 0, 4506, 21_987_328)
    before, home = apt.HomeParameters(1, 2, 1, 0, 0), apt.HomeParameters(1, 2, 1, 4_397_466, 0)
    return [
        (_greeting(apt.UNIT), None),
        (_greeting(apt.RACK), _reply(apt.Id.HW_GET_INFO, info.pack(), source=apt.RACK)),
        (
            apt.set_velocity_parameters(speeds, destination=to)
            + apt.request_velocity_parameters(1, destination=to),
            _reply(apt.Id.MOT_GET_VELPARAMS, speeds.pack()),
        ),
        (
            apt.request_home_parameters(1, destination=to),
            _reply(apt.Id.MOT_GET_HOMEPARAMS, before.pack()),
        ),
        (
            apt.set_home_parameters(home, destination=to)
            + apt.request_home_parameters(1, destination=to),
            _reply(apt.Id.MOT_GET_HOMEPARAMS, home.pack()),
        ),
        (bytes.fromhex("10 02 01 01 21 01 11 02 01 00 21 01"), bytes.fromhex("12 02 01 01 01 21")),
    ]


def _status(position: int, bits: int) -> bytes:
    packed = apt.Status(1, position, 0, apt.StatusBits(bits)).pack()
    return _reply(apt.Id.MOT_GET_STATUSUPDATE, packed)


def test_dialogue_of_a_move() -> None:
    """Every byte of a connection and a move, with the report of the end between two answers."""
    clock, ask = Clock(), bytes.fromhex("80 04 01 00 21 01")
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
        wheel = FilterWheel(dialogue, SETTINGS, clock=clock, sleep=clock.sleep)
        assert wheel.connect().model == "BSC201"
        wheel.move_to(2)


def test_answers_of_others() -> None:
    """What came before a question, from another bay or of another channel is no answer to it."""
    ask, answer = bytes.fromhex("80 04 01 00 21 01"), _status(3, 0)
    old, other_bay = _status(1, 0), _status(2, 0)[:5] + b"\x22" + _status(2, 0)[6:]
    other_channel = answer[:6] + b"\x02" + answer[7:10] + b"\x01" + answer[11:]
    later = [old, b"", other_bay + other_channel, answer]
    settings_ = Settings(addresses=((apt.RACK, apt.BAY_1),))
    with Dialogue([(None, later[:2]), (ask, later[2:])]) as dialogue:
        assert FilterWheel(dialogue, settings_).status().position == 3


def test_late_report_of_an_earlier_move() -> None:
    """A stale report before the wheel starts does not end the move, nor make it a stall."""
    bench = Bench()
    wheel = bench.homed()
    bench.device.faults.stray_completed = True
    bench.device.faults.late = 0.4
    wheel.move_to(4)
    assert bench.world.wheel_position == 4


@settings(max_examples=60, deadline=None)
@given(st.lists(st.binary(max_size=40), max_size=6))
def test_arbitrary_answers(answers: list[bytes]) -> None:
    """Whatever a device says, connecting ends, and fails with an error that is documented."""
    clock = Clock()

    class Babbler(Dialogue):
        """A device that says what it likes."""

        def write(self, data: bytes) -> None:
            """Take anything."""

    babbler = Babbler([(None, answers)] if answers else [])
    with pytest.raises(WheelError):
        FilterWheel(babbler, SETTINGS, clock=clock, sleep=clock.sleep).connect()


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=12), st.integers(0, 3))
def test_noise_on_the_line(noise: bytes, drop: int) -> None:
    """With any bytes before every answer, and some missing: the right slot, or a known error."""
    bench = Bench()
    bench.device.faults.noise = noise
    bench.device.faults.drop = drop
    try:
        bench.homed().move_to(2)
    except WheelError:
        assert bench.clock.time < 200.0
    else:
        assert bench.world.wheel_position == 2


@pytest.mark.parametrize("bits", [b"\x12\x02\x01\x00\x01\x21", b"\x12\x02\x01\x03\x01\x21"])
def test_neither_enabled_nor_not(bits: bytes) -> None:
    """An answer that is neither yes nor no is an error of the wheel, not of the program."""
    dialogue = Dialogue([*_connection()[:-1], (_connection()[-1][0], bits)])
    with dialogue, pytest.raises(WheelError, match="does not say what the motor does"):
        FilterWheel(dialogue, SETTINGS).connect()


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"filters": {7: "LW"}}, "Invalid filter position 7. Must lie in 1 to 6"),
        ({"filters": {1: "LW", 2: "LW"}}, "Repeated filter 'LW'"),
        ({"velocity": 0.0}, "Invalid velocity 0.0"),
        ({"tolerance": float("nan")}, "Invalid tolerance nan"),
        ({"home_offset": 400.0}, "Invalid home_offset 400.0"),
        ({"home_direction": 3}, "Invalid home_direction 3"),
    ],
)
def test_settings_are_checked(options: dict[str, object], error: str) -> None:
    """What a wheel cannot have is refused before anything moves."""
    with pytest.raises(ValueError, match=error):
        Settings(**options)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="Invalid filter position 0"):
        Bench().homed().move_to(0)


@pytest.fixture(name="port")
def _port() -> Iterator[EmulatedPort]:
    """An emulated wheel on a real pseudo-terminal, a hundred times as fast as a real one."""
    with start({"model": "SCC201", "sn": "40000123"}, None) as port:
        assert isinstance(port.device, EmulatedApt)
        port.device.faults.slow = 0.01
        yield port


def test_over_a_pseudo_terminal(port: EmulatedPort) -> None:
    """Through a serial port, which here has no RTS to raise, in real time."""
    chosen = Settings(filters=FILTERS, reply_timeout=0.3, poll_interval=0.005)
    with FilterWheel.open(f"pty://{port.path}", chosen) as wheel:
        wheel.home()
        wheel.select("LW")
        assert wheel.band() == "LW"
        assert wheel.identity["serial_number"] == "40000123"
        port.device.plugged = False  # type: ignore[misc]
        port.close()
        with pytest.raises(TransportError, match=f"'pty://{port.path}'"):
            wheel.status()


def test_by_name_of_an_emulator() -> None:
    """A wheel in a world is opened by its name, and turns what the world's camera sees."""
    world = World(filters=FILTERS, wheel_position=3)
    chosen = Settings(filters=FILTERS, reply_timeout=0.3, velocity=50.0, acceleration=500.0)
    with FilterWheel.open("sim://apt?offset=0", chosen, world=world) as wheel:
        assert wheel.is_simulated
        with pytest.raises(NotHomedError):
            wheel.select("LW")
    with pytest.raises(ValueError, match="Unknown option 'colour'"):
        FilterWheel.open("sim://apt?colour=red", chosen)
    with pytest.raises(ValueError, match="Invalid model 'X'"):
        FilterWheel.open("sim://apt?model=X", chosen)


@pytest.mark.hardware
def test_a_real_wheel() -> None:
    """With DBTHERMAL_WHEEL, the name of a real wheel: home it, and look for every slot."""
    with FilterWheel.open(os.environ["DBTHERMAL_WHEEL"], Settings()) as wheel:
        wheel.home()
        for position in (1, 4, 2, 6, 3, 5):
            wheel.move_to(position)
            assert wheel.position() == position
