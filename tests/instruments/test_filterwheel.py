"""The filter wheel: its places, its settings, and the emulated wheel in memory and on a line."""

from concurrent.futures import ThreadPoolExecutor

import pytest
from device_benches import FILTERS, WheelBench

from dbthermal.instruments import _apt as apt
from dbthermal.instruments._controller import BSC10X, BSC20X
from dbthermal.instruments.emulated.apt import EmulatedApt
from dbthermal.instruments.emulated.line import Line
from dbthermal.instruments.emulated.world import World
from dbthermal.instruments.filterwheel import (
    FilterWheel,
    NoReplyError,
    NotHomedError,
    Settings,
    WheelError,
    WrongDeviceError,
)


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
