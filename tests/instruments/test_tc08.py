"""The TC-08 driver on an emulated library: opening, channels, single readings."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from rig_devices import LoggerBench

from dbthermal.instruments import tc08, thermocouple
from dbthermal.instruments.emulated.world import World
from dbthermal.instruments.tc08 import TC08, Flag, TC08Error, readings
from dbthermal.instruments.tc08.channels import Channels

FLOAT32 = 4e-5  # [K] the library's numbers have 24 bits


@pytest.fixture
def rig() -> LoggerBench:
    """Give a rig that is not open yet."""
    return LoggerBench()


def test_single_reading_in_kelvin(rig: LoggerBench) -> None:
    """Two tips and the cold junction are read; the seven sockets without one are missing."""
    scan = rig.ready().single()
    assert_allclose(scan.temperature[:3], [296.15, 350.0, 300.0], rtol=0, atol=FLOAT32)
    assert list(scan.flag) == [0, 0, 0] + [Flag.MISSING] * 6
    assert np.isnan(scan.temperature[3:]).all()


def test_time_of_a_single_reading(rig: LoggerBench) -> None:
    """A scan of two thermocouples takes 0.3 s, and its time is the middle of it."""
    scan = rig.ready().single()
    assert (scan.time, scan.duration) == pytest.approx((1000.15, 0.3))


def test_own_conversion(rig: LoggerBench) -> None:
    """Converted here, the same tips have the same temperatures, and their voltages are kept."""
    scan = rig.ready("its90").single()
    assert_allclose(scan.temperature[:3], [296.15, 350.0, 300.0], rtol=0, atol=FLOAT32)
    voltage = thermocouple.emf(350.0) - thermocouple.emf(296.15)
    assert scan.emf[1] == pytest.approx(float(voltage), abs=1e-6)


@pytest.mark.parametrize("error", [0.0, 0.04, -1.5])
def test_cross_check_sees_the_librarys_error(error: float) -> None:
    """What the library's conversion is off by is found, and the channels are as before."""
    rig = LoggerBench(conversion_error=error)
    driver = rig.ready()
    assert driver.cross_check(1) == pytest.approx(-error, abs=2 * FLOAT32)
    assert np.isfinite(driver.single().temperature[:3]).all()


def test_raw_voltage(rig: LoggerBench) -> None:
    """A channel of raw millivolts has a voltage, no temperature, and says so."""
    rig.driver.open().set_channels({1: "X"})
    scan = rig.driver.single()
    assert scan.flag[1] == Flag.VOLTAGE
    assert np.isnan(scan.temperature[1])
    assert np.isfinite(scan.emf[1])


@pytest.mark.parametrize("conversion", ["library", "its90"])
def test_open_thermocouple_is_no_number(rig: LoggerBench, conversion: str) -> None:
    """An open thermocouple is NaN and flagged, and its neighbour is not touched."""
    rig.unit.faults.open = {1}
    scan = rig.ready(conversion).single()
    assert np.isnan(scan.temperature[1])
    assert scan.flag[1] == Flag.MISSING
    assert scan.temperature[2] == pytest.approx(300.0, abs=FLOAT32)


def test_open_thermocouple_that_reads_ambient_is_not_seen(rig: LoggerBench) -> None:
    """Where the unit itself gives a plausible number, no driver can tell: it is the junction's."""
    rig.unit.faults.open, rig.unit.faults.open_reads = {1}, "ambient"
    scan = rig.ready().single()
    assert scan.flag[1] == Flag.GOOD
    assert scan.temperature[1] == pytest.approx(296.15, abs=FLOAT32)


@pytest.mark.parametrize("conversion", ["library", "its90"])
@pytest.mark.parametrize("channel", [1, 8])
def test_overflow_is_no_number(rig: LoggerBench, conversion: str, channel: int) -> None:
    """A converter that overflowed gives no temperature, whatever number came with the bit."""
    rig.unit.faults.overflow, rig.tips[channel] = {channel}, 300.0
    rig.driver.open().set_channels({channel: "T"}, conversion=conversion)  # type: ignore[arg-type]
    scan = rig.driver.single()
    assert scan.flag[channel] == Flag.OVERFLOW
    assert np.isnan(scan.temperature[channel])
    assert np.isnan(scan.emf[channel])


def test_voltage_beyond_the_scale() -> None:
    """A voltage that no type T gives is kept as a voltage, and is no temperature."""
    temperature, emf, flag = readings.millivolts([30.0], [False], 296.15)
    assert (emf[0], flag[0]) == (30.0, Flag.OUT_OF_RANGE)
    assert np.isnan(temperature[0])


@pytest.mark.parametrize("junction", [np.nan, 0.0, 1e9])
def test_unknown_cold_junction(junction: float) -> None:
    """Without a possible cold junction there is no temperature."""
    temperature, _, flag = readings.millivolts([1.0], [False], junction)
    assert flag[0] == Flag.NO_JUNCTION
    assert np.isnan(temperature[0])


@given(
    st.lists(st.floats(width=32), min_size=9, max_size=9),
    st.integers(-(2**15), 2**15 - 1),
    st.sampled_from(["library", "its90"]),
)
def test_any_answer_of_the_library(raw: list[float], bits: int, conversion: str) -> None:
    """Whatever the library writes, a temperature is finite and possible, or flagged and NaN."""
    channels = Channels({1: "T", 2: "X", 8: "T"}, conversion)  # type: ignore[arg-type]
    scan = channels.scan(0.0, 0.0, np.array(raw), bits)
    good = scan.flag == 0
    assert np.all(scan.temperature[good] > 0.0)
    assert np.isfinite(scan.temperature[good]).all()
    assert np.isnan(scan.temperature[~good]).all()


def test_identity(rig: LoggerBench) -> None:
    """The unit says that it is emulated, and so does the driver."""
    with rig.driver as driver:
        info = driver.identity()
    assert (info.serial_number, info.driver, info.is_simulated) == ("EMULATED", "emulated", True)
    assert info.calibration_date == "01Jan00"


def test_nothing_happens_before_it_is_opened(rig: LoggerBench) -> None:
    """The constructor opens nothing; a closed unit says what to do."""
    rig.unit.faults.unplugged = True
    TC08(rig.unit)
    with pytest.raises(RuntimeError, match=r"closed\. Must be opened first"):
        rig.driver.identity()


def test_close_is_idempotent(rig: LoggerBench) -> None:
    """A second close does nothing, and the unit can be opened again."""
    rig.ready().close()
    rig.driver.close()
    assert rig.driver.open().identity().serial_number == "EMULATED"
    with pytest.raises(RuntimeError, match="open already"):
        rig.driver.open()


def test_firmware_download_is_waited_for(rig: LoggerBench) -> None:
    """Opening takes as long as the firmware's download."""
    rig.unit.faults.firmware_delay = 6.0
    rig.driver.open()
    assert rig.clock.now == pytest.approx(1006.0, abs=0.051)


def test_opening_gives_up(rig: LoggerBench) -> None:
    """A download that does not end is given up, with how far it came."""
    rig.unit.faults.firmware_delay = 1e3
    with pytest.raises(TimeoutError, match=r"not open after 5.0 s, at 0 %"):
        rig.driver.open(timeout=5.0)


def test_no_unit(rig: LoggerBench) -> None:
    """Where nothing is plugged in, that is what is said."""
    rig.unit.faults.units = 0
    with pytest.raises(ConnectionError, match=r"No TC-08; found: \[\]. Must be plugged in"):
        rig.driver.open()


def test_wrong_unit(rig: LoggerBench) -> None:
    """A unit of another serial number is named, and left closed."""
    with pytest.raises(ConnectionError, match=r"No TC-08 'AB/123'; found: \['EMULATED'\]"):
        rig.driver.open("AB/123")
    assert rig.driver.open("EMULATED").identity().serial_number == "EMULATED"


@pytest.mark.parametrize("code", range(1, 17))
def test_each_error_is_explained(rig: LoggerBench, code: int) -> None:
    """Each of the 16 error numbers is an exception with its meaning."""
    rig.ready()
    rig.unit.faults.errors["usb_tc08_get_single"] = code
    with pytest.raises(TC08Error, match=f"take a single reading: error {code}, ") as caught:
        rig.driver.single()
    assert caught.value.code == code
    assert tc08.ERRORS[code] in str(caught.value)


@pytest.mark.parametrize(
    "function", ["open_unit_async", "open_unit_progress", "get_unit_info", "set_channel"]
)
def test_each_failing_step_of_opening_is_seen(rig: LoggerBench, function: str) -> None:
    """A step that fails is an error, and leaves no unit open and no channel half set."""
    rig.unit.faults.errors[f"usb_tc08_{function}"] = 9
    with pytest.raises(TC08Error, match="EEPROM"), rig.driver:
        rig.ready() if not rig.driver._handle else rig.driver.set_channels({1: "T"})
    with pytest.raises(RuntimeError):
        rig.driver.single()


# What the vendor's header says of each error number, in a word.
MEANINGS = (
    *("no error", "operating system", "no channels", "argument", "version", "mode", "enumerated"),
    *("respond", "firmware", "EEPROM", "not found", "threading", "pipes", "calibration", "picopp"),
    *("function of Pico's driver", "communication"),
)


def test_error_numbers_are_the_published_ones() -> None:
    """Each number has its meaning, from 0 to 16; 15 and 16 are not exchanged."""
    assert [*tc08.ERRORS] == [*range(17)]
    wrong = [code for code, word in enumerate(MEANINGS) if word not in tc08.ERRORS[code]]
    assert (len(MEANINGS), wrong) == (17, [])


def test_unplugging(rig: LoggerBench) -> None:
    """A unit that is pulled out fails at the next reading; closing fails too, and both are told."""
    rig.ready()
    rig.unit.faults.unplugged = True
    with (
        pytest.raises(TC08Error, match="communication with the unit is lost") as caught,
        rig.driver,
    ):
        rig.driver.single()
    assert caught.value.__notes__[0].startswith("Closing failed too. The TC-08 could not close")
    rig.driver.close()


@pytest.mark.parametrize("channel", [0, 9, -1])
def test_channel_out_of_range(rig: LoggerBench, channel: int) -> None:
    """The cold junction is no socket, and there are eight."""
    with pytest.raises(ValueError, match=f"Invalid channel {channel}. Must lie in 1 to 8"):
        rig.driver.open().set_channels({channel: "T"})


@pytest.mark.parametrize(
    ("kind", "conversion"), [("C", "library"), ("", "library"), ("K", "its90")]
)
def test_thermocouple_that_there_is_not(rig: LoggerBench, kind: str, conversion: str) -> None:
    """A letter must be one, and the conversion of this package is for type T alone."""
    with pytest.raises(ValueError, match=f"Invalid thermocouple '{kind}' of channel 1. Must be"):
        rig.driver.open().set_channels({1: kind}, conversion=conversion)  # type: ignore[arg-type]


def test_other_settings_are_checked(rig: LoggerBench) -> None:
    """A mains frequency, a conversion, no channel at all, another channel to compare."""
    driver = rig.ready()
    driver.set_mains(60)
    with pytest.raises(ValueError, match=r"Invalid mains frequency 55 Hz\. Must be 50 or 60"):
        driver.set_mains(55)
    with pytest.raises(ValueError, match="Invalid conversion 'nist'"):
        driver.set_channels({1: "T"}, conversion="nist")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="Must be one at least"):
        driver.set_channels({})
    with pytest.raises(ValueError, match="Invalid channel 3 to compare"):
        driver.cross_check(3)


def test_channels_come_first(rig: LoggerBench) -> None:
    """A reading needs channels."""
    with pytest.raises(RuntimeError, match="Must be told its channels first"):
        rig.driver.open().single()


@pytest.mark.parametrize(("count", "interval"), [(1, 0.2), (8, 0.9)])
def test_minimum_interval(rig: LoggerBench, count: int, interval: float) -> None:
    """One thermocouple takes 0.2 s, eight take 0.9 s; a shorter interval is refused."""
    rig.driver.open().set_channels(dict.fromkeys(range(1, count + 1), "T"))
    assert rig.driver.minimum_interval() == pytest.approx(interval)
    with pytest.raises(ValueError, match=f"Invalid interval 0.1 s .* Must be {interval} s or long"):
        rig.driver.stream(0.1)
    with pytest.raises(ValueError, match="whole milliseconds"):
        rig.driver.stream(1.00025)


def test_thermocouples_of_the_world() -> None:
    """In the emulated world a thermocouple at the blackbody follows it, from URL to kelvin."""
    world = World(blackbody_temperature=320.0)
    world.thermocouples = {1: "blackbody", 2: "open"}
    with TC08.from_url("sim://tc08", world=world) as driver:
        driver.set_channels({1: "T", 2: "T"})
        assert driver.is_simulated
        before = driver.single().temperature[1]
        world.blackbody_temperature = 340.0
        after = driver.single().temperature
    assert (before, after[1]) == pytest.approx((320.0, 340.0), abs=FLOAT32)
    assert np.isnan(after[2])


@pytest.mark.parametrize("url", ["usb:", "tc08:relative.so", "sim://tc08", ""])
def test_url_is_checked(url: str) -> None:
    """A URL names the library, or the emulated unit of a world."""
    with pytest.raises(ValueError, match="Invalid URL"):
        TC08.from_url(url)


def test_flags_keep_their_numbers() -> None:
    """They are stored with recordings, so that each is a bit of its own for ever."""
    assert {flag.name: flag.value for flag in Flag} == {
        "OVERFLOW": 1,
        "MISSING": 2,
        "OUT_OF_RANGE": 4,
        "NO_JUNCTION": 8,
        "VOLTAGE": 16,
    }
