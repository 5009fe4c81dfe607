"""The TC-08 driver above an emulated library, and above a stub that a C compiler built."""

import ctypes
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from dbthermal.instruments import tc08, thermocouple
from dbthermal.instruments.emulated.tc08 import EmulatedTC08
from dbthermal.instruments.emulated.world import World
from dbthermal.instruments.tc08 import TC08, Flag, TC08Error, library, readings
from dbthermal.instruments.tc08.channels import Channels
from dbthermal.instruments.tc08.stream import Timeline

FLOAT32 = 4e-5  # [K] the library's numbers have 24 bits


class Clock:
    """A clock that moves only when it is told to."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        """Time [s]."""
        return self.now

    def sleep(self, seconds: float) -> None:
        """Move on."""
        self.now += seconds


class Rig:
    """A driver on an emulated unit, a clock, and tips whose temperatures a test sets."""

    def __init__(self, **settings: float) -> None:
        self.clock = Clock()
        self.tips = {1: 350.0, 2: 300.0}
        self.unit = EmulatedTC08(
            lambda channel, _: self.tips.get(channel, np.nan),
            clock=self.clock,
            sleep=self.clock.sleep,
            **settings,  # type: ignore[arg-type]
        )
        self.driver = TC08(self.unit, clock=self.clock, sleep=self.clock.sleep)

    def ready(self, conversion: str = "library") -> TC08:
        """Open the unit with two thermocouples of type T."""
        self.driver.open().set_channels({1: "T", 2: "T"}, conversion=conversion)  # type: ignore[arg-type]
        return self.driver


@pytest.fixture
def rig() -> Rig:
    """Give a rig that is not open yet."""
    return Rig()


def test_single_reading_in_kelvin(rig: Rig) -> None:
    """Two tips and the cold junction are read; the seven sockets without one are missing."""
    scan = rig.ready().single()
    assert_allclose(scan.temperature[:3], [296.15, 350.0, 300.0], rtol=0, atol=FLOAT32)
    assert list(scan.flag) == [0, 0, 0] + [Flag.MISSING] * 6
    assert np.isnan(scan.temperature[3:]).all()


def test_time_of_a_single_reading(rig: Rig) -> None:
    """A scan of two thermocouples takes 0.3 s, and its time is the middle of it."""
    scan = rig.ready().single()
    assert (scan.time, scan.duration) == pytest.approx((1000.15, 0.3))


def test_own_conversion(rig: Rig) -> None:
    """Converted here, the same tips have the same temperatures, and their voltages are kept."""
    scan = rig.ready("its90").single()
    assert_allclose(scan.temperature[:3], [296.15, 350.0, 300.0], rtol=0, atol=FLOAT32)
    voltage = thermocouple.emf(350.0) - thermocouple.emf(296.15)
    assert scan.emf[1] == pytest.approx(float(voltage), abs=1e-6)


@pytest.mark.parametrize("error", [0.0, 0.04, -1.5])
def test_cross_check_sees_the_librarys_error(error: float) -> None:
    """What the library's conversion is off by is found, and the channels are as before."""
    rig = Rig(conversion_error=error)
    driver = rig.ready()
    assert driver.cross_check(1) == pytest.approx(-error, abs=2 * FLOAT32)
    assert np.isfinite(driver.single().temperature[:3]).all()


def test_raw_voltage(rig: Rig) -> None:
    """A channel of raw millivolts has a voltage, no temperature, and says so."""
    rig.driver.open().set_channels({1: "X"})
    scan = rig.driver.single()
    assert scan.flag[1] == Flag.VOLTAGE
    assert np.isnan(scan.temperature[1])
    assert np.isfinite(scan.emf[1])


@pytest.mark.parametrize("conversion", ["library", "its90"])
def test_open_thermocouple_is_no_number(rig: Rig, conversion: str) -> None:
    """An open thermocouple is NaN and flagged, and its neighbour is not touched."""
    rig.unit.faults.open = {1}
    scan = rig.ready(conversion).single()
    assert np.isnan(scan.temperature[1])
    assert scan.flag[1] == Flag.MISSING
    assert scan.temperature[2] == pytest.approx(300.0, abs=FLOAT32)


def test_open_thermocouple_that_reads_ambient_is_not_seen(rig: Rig) -> None:
    """Where the unit itself gives a plausible number, no driver can tell: it is the junction's."""
    rig.unit.faults.open, rig.unit.faults.open_reads = {1}, "ambient"
    scan = rig.ready().single()
    assert scan.flag[1] == Flag.GOOD
    assert scan.temperature[1] == pytest.approx(296.15, abs=FLOAT32)


@pytest.mark.parametrize("conversion", ["library", "its90"])
@pytest.mark.parametrize("channel", [1, 8])
def test_overflow_is_no_number(rig: Rig, conversion: str, channel: int) -> None:
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


def test_identity(rig: Rig) -> None:
    """The unit says that it is emulated, and so does the driver."""
    with rig.driver as driver:
        info = driver.info()
    assert (info.serial, info.driver, info.is_simulated) == ("EMULATED", "emulated", True)
    assert info.calibration_date == "01Jan00"


def test_nothing_happens_before_it_is_opened(rig: Rig) -> None:
    """The constructor opens nothing; a closed unit says what to do."""
    rig.unit.faults.unplugged = True
    TC08(rig.unit)
    with pytest.raises(RuntimeError, match=r"closed\. Must be opened first"):
        rig.driver.info()


def test_close_is_idempotent(rig: Rig) -> None:
    """A second close does nothing, and the unit can be opened again."""
    rig.ready().close()
    rig.driver.close()
    assert rig.driver.open().info().serial == "EMULATED"
    with pytest.raises(RuntimeError, match="open already"):
        rig.driver.open()


def test_firmware_download_is_waited_for(rig: Rig) -> None:
    """Opening takes as long as the firmware's download."""
    rig.unit.faults.firmware_delay = 6.0
    rig.driver.open()
    assert rig.clock.now == pytest.approx(1006.0, abs=0.051)


def test_opening_gives_up(rig: Rig) -> None:
    """A download that does not end is given up, with how far it came."""
    rig.unit.faults.firmware_delay = 1e3
    with pytest.raises(TimeoutError, match=r"not open after 5.0 s, at 0 %"):
        rig.driver.open(timeout=5.0)


def test_no_unit(rig: Rig) -> None:
    """Where nothing is plugged in, that is what is said."""
    rig.unit.faults.units = 0
    with pytest.raises(ConnectionError, match=r"No TC-08; found: \[\]. Must be plugged in"):
        rig.driver.open()


def test_wrong_unit(rig: Rig) -> None:
    """A unit of another serial number is named, and left closed."""
    with pytest.raises(ConnectionError, match=r"No TC-08 'AB/123'; found: \['EMULATED'\]"):
        rig.driver.open("AB/123")
    assert rig.driver.open("EMULATED").info().serial == "EMULATED"


@pytest.mark.parametrize("code", range(1, 17))
def test_each_error_is_explained(rig: Rig, code: int) -> None:
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
def test_each_failing_step_of_opening_is_seen(rig: Rig, function: str) -> None:
    """A step that fails is an error, and leaves no unit open and no channel half set."""
    rig.unit.faults.errors[f"usb_tc08_{function}"] = 9
    with pytest.raises(TC08Error, match="EEPROM"), rig.driver:
        rig.ready() if not rig.driver._handle else rig.driver.set_channels({1: "T"})
    with pytest.raises(RuntimeError):
        rig.driver.single()


def test_numbers_15_and_16_are_not_exchanged() -> None:
    """16 is the lost communication; 15 is a driver function."""
    assert "communication" in tc08.ERRORS[16]
    assert "communication" not in tc08.ERRORS[15]


def test_unplugging(rig: Rig) -> None:
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
def test_channel_out_of_range(rig: Rig, channel: int) -> None:
    """The cold junction is no socket, and there are eight."""
    with pytest.raises(ValueError, match=f"Invalid channel {channel}. Must lie in 1 to 8"):
        rig.driver.open().set_channels({channel: "T"})


@pytest.mark.parametrize(
    ("kind", "conversion"), [("C", "library"), ("", "library"), ("K", "its90")]
)
def test_thermocouple_that_there_is_not(rig: Rig, kind: str, conversion: str) -> None:
    """A letter must be one, and the conversion of this package is for type T alone."""
    with pytest.raises(ValueError, match=f"Invalid thermocouple '{kind}' of channel 1. Must be"):
        rig.driver.open().set_channels({1: kind}, conversion=conversion)  # type: ignore[arg-type]


def test_other_settings_are_checked(rig: Rig) -> None:
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


def test_channels_come_first(rig: Rig) -> None:
    """A reading needs channels."""
    with pytest.raises(RuntimeError, match="Must be told its channels first"):
        rig.driver.open().single()


@pytest.mark.parametrize(("count", "interval"), [(1, 0.2), (8, 0.9)])
def test_minimum_interval(rig: Rig, count: int, interval: float) -> None:
    """One thermocouple takes 0.2 s, eight take 0.9 s; a shorter interval is refused."""
    rig.driver.open().set_channels(dict.fromkeys(range(1, count + 1), "T"))
    assert rig.driver.minimum_interval() == pytest.approx(interval)
    with pytest.raises(ValueError, match=f"Invalid interval 0.1 s .* Must be {interval} s or long"):
        rig.driver.stream(0.1)
    with pytest.raises(ValueError, match="whole milliseconds"):
        rig.driver.stream(1.00025)


@pytest.mark.parametrize("conversion", ["library", "its90"])
def test_stream(rig: Rig, conversion: str) -> None:
    """Ten seconds at 1 s give ten samples of each channel and the junction, none lost."""
    with rig.ready(conversion).stream(1.0) as stream:
        rig.clock.sleep(10.0)
        samples = stream.read()
        assert stream.read()[1].time.size == 0
    assert list(samples) == [0, 1, 2]
    assert_allclose(samples[1].time, np.arange(1.0, 11.0), rtol=0, atol=1e-9)
    assert_allclose(samples[1].temperature, 350.0, rtol=0, atol=FLOAT32)
    assert (samples[2].lost, samples[2].late) == (0, False)


def test_stream_is_deskewed() -> None:
    """On a ramp of 1 K/s the channels agree where the library brings them to the same times."""
    clock = Clock()
    unit = EmulatedTC08(lambda _, time: time - 700.0, clock=clock)
    driver = TC08(unit, clock=clock).open()
    driver.set_channels(dict.fromkeys(range(1, 9), "T"))
    stream = driver.stream(1.0)
    clock.sleep(3.0)
    even = stream.read()
    clock.sleep(3.0)
    skewed = stream.read(deskew=False)
    assert_allclose(even[8].temperature, even[1].temperature, rtol=0, atol=FLOAT32)
    assert_allclose(skewed[8].temperature - skewed[1].temperature, 0.7, rtol=0, atol=2 * FLOAT32)


def test_stream_that_is_not_read_in_time(rig: Rig) -> None:
    """After 100 s at 0.3 s nothing is lost, but it is late; 200 s later, 67 samples are."""
    stream = rig.ready().stream(0.3)
    assert stream.time_left == pytest.approx(60.0)
    rig.clock.sleep(100.0)
    first = stream.read()[1]
    rig.clock.sleep(200.1)
    second = stream.read()[1]
    assert (first.late, first.lost, first.time.size) == (True, 0, 333)
    assert (second.late, second.lost, second.time.size) == (True, 67, 600)
    assert second.time[-1] == pytest.approx(300.0)


def test_samples_lost_before_the_first_read(rig: Rig) -> None:
    """The ring overflows before anything was read, and that is counted too."""
    stream = rig.ready().stream(0.3)
    rig.clock.sleep(300.0)
    assert stream.read()[1].lost == 400


def test_read_that_fails_once(rig: Rig) -> None:
    """After a failure in the middle of a read, the rest is there and the gap is counted."""
    stream = rig.ready().stream(1.0)
    rig.clock.sleep(3.0)
    fetch = rig.unit.usb_tc08_get_temp_deskew
    rig.unit.usb_tc08_get_temp_deskew = (  # type: ignore[method-assign]
        lambda *call: -1 if call[5] == 2 else fetch(*call)
    )
    with pytest.raises(TC08Error, match="read channel 2 of its stream"):
        stream.read()
    rig.unit.usb_tc08_get_temp_deskew = fetch  # type: ignore[method-assign]
    rig.clock.sleep(2.0)
    samples = stream.read()
    assert [samples[channel].lost for channel in (0, 1, 2)] == [0, 3, 0]
    assert [samples[channel].time.size for channel in (0, 1, 2)] == [5, 2, 5]


def test_sample_that_the_host_missed(rig: Rig) -> None:
    """What the library pads with NaN is flagged, and not given as a temperature."""
    rig.unit.faults.starved = {2}
    stream = rig.ready("its90").stream(1.0)
    rig.clock.sleep(3.0)
    samples = stream.read()[1]
    assert list(samples.flag) == [0, Flag.MISSING | Flag.NO_JUNCTION, 0]
    assert list(np.isnan(samples.temperature)) == [False, True, False]


def test_overflow_in_a_stream(rig: Rig) -> None:
    """The library says that some sample overflowed, not which: none of that read counts."""
    stream = rig.ready().stream(1.0)
    rig.unit.faults.overflow = {1}
    rig.clock.sleep(2.0)
    bad = stream.read()
    rig.unit.faults.overflow = set()
    rig.clock.sleep(2.0)
    assert list(bad[1].flag) == [Flag.OVERFLOW] * 2
    assert list(bad[2].flag) == [0, 0]
    assert list(stream.read()[1].flag) == [0, 0]


def test_times_do_not_wrap() -> None:
    """The library's milliseconds begin anew after 24 days; the times go on, and none is lost."""
    timeline = Timeline(1.0, {1: 2**31 - 1500})
    times, lost = timeline.times(1, np.array([2**31 - 500, 500, 1500]))
    assert_allclose(np.diff(times), 1.0, rtol=0, atol=1e-9)
    assert (lost, times[0]) == (0, pytest.approx((2**31 - 500) / 1000.0))


def test_emulated_stream_wraps() -> None:
    """A stream through the wrap of the emulated library has no gap within a read."""
    rig = Rig(first_ms=2**31 - 5000)
    stream = rig.ready().stream(1.0)
    rig.clock.sleep(10.0)
    assert_allclose(np.diff(stream.read()[1].time), 1.0, rtol=0, atol=1e-9)


@given(st.lists(st.integers(-(2**31), 2**31 - 1), max_size=20))
def test_any_times(milliseconds: list[int]) -> None:
    """Whatever the library calls the times, they do not go back, and losses are not negative."""
    times, lost = Timeline(1.0).times(1, np.array(milliseconds, dtype=np.int64))
    assert np.all(np.diff(times, prepend=0.0) >= 0.0)
    assert lost >= 0


@given(
    st.lists(st.floats(0.0, 100.0), max_size=12).map(sorted),
    st.lists(st.floats(0.0, 100.0), max_size=12).map(sorted),
)
def test_cold_junction_is_the_nearest_sample(known: list[float], times: list[float]) -> None:
    """A sample takes the cold junction nearest in time, if it is near, else none."""
    timeline = Timeline(1.0)
    timeline.add_junction(np.array(known), np.array(known))
    for time, found in zip(times, timeline.junction_at(np.array(times)), strict=True):
        nearest = min((abs(time - moment) for moment in known), default=np.inf)
        assert (np.isnan(found) and nearest > 1.5) or abs(time - found) == nearest


def test_single_reading_while_streaming(rig: Rig) -> None:
    """A unit that streams takes no other order; once the stream is closed, it does."""
    driver = rig.ready()
    with driver.stream(1.0) as stream:
        for order in (driver.single, lambda: driver.stream(1.0), lambda: driver.set_mains(50)):
            with pytest.raises(RuntimeError, match=r"while it streams\. Must be stopped first"):
                order()
    assert np.isfinite(driver.single().temperature[1])
    with pytest.raises(RuntimeError, match="stream of the TC-08 is closed"):
        stream.read()


def test_unplugging_while_streaming(rig: Rig) -> None:
    """A stream whose unit is pulled out fails at the next read; closing the unit ends it."""
    stream = rig.ready().stream(1.0)
    rig.unit.faults.unplugged, rig.unit.faults.unplugged_error = True, 7
    with pytest.raises(TC08Error, match="read channel 1 of its stream: error 7"):
        stream.read()
    with pytest.raises(TC08Error, match="does not respond"):
        rig.driver.close()
    stream.close()
    assert not stream.is_running


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


def test_missing_library(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Without the vendor's library the error says where to get it and how to name it."""
    monkeypatch.setattr(ctypes.util, "find_library", lambda _: None)
    with pytest.raises(FileNotFoundError, match=r"No library 'usbtc08'.*DBTHERMAL_USBTC08"):
        library.load(environment={})
    with pytest.raises(OSError, match=r"gone\.so"):
        library.load(environment={library.ENVIRONMENT: str(tmp_path / "gone.so")})


def test_importing_the_driver_loads_no_library() -> None:
    """The driver's module asks for neither pyusb nor pyserial nor the vendor's library."""
    code = "import sys, dbthermal.instruments.tc08; print({'usb', 'serial'} & {*sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


STUB = r"""
#include <math.h>
#include <stdint.h>
#include <string.h>
typedef struct { int16_t size; int8_t driver[12]; int16_t kernel, hardware, variant;
                 int8_t serial[11]; int8_t date[9]; } info_t;
static int16_t sixty = -1; static int8_t kinds[9];
int16_t usb_tc08_open_unit_async(void) { return 1; }
int16_t usb_tc08_open_unit_progress(int16_t *handle, int16_t *percent)
{ *handle = 32767; *percent = 100; return 1; }
int16_t usb_tc08_close_unit(int16_t handle) { return handle == 32767; }
int16_t usb_tc08_get_last_error(int16_t handle) { return handle == 0 ? 10 : 16; }
int16_t usb_tc08_set_mains(int16_t handle, int16_t hertz) { sixty = hertz; return handle == 32767; }
int16_t usb_tc08_set_channel(int16_t handle, int16_t channel, int8_t kind)
{ kinds[channel] = kind; return handle == 32767; }
int32_t usb_tc08_get_minimum_interval_ms(int16_t handle) { return handle == 32767 ? 70000 : 0; }
int16_t usb_tc08_get_single(int16_t handle, float *temp, int16_t *flags, int16_t units)
{ for (int i = 0; i < 9; i++) temp[i] = kinds[i] == 32 ? NAN : 290.0f + i + 100.0f * (units - 2);
  *flags = 1 << 8; return handle == 32767; }
int32_t usb_tc08_run(int16_t handle, int32_t ms) { return handle == 32767 ? ms : 0; }
int16_t usb_tc08_stop(int16_t handle) { return handle == 32767; }
int32_t usb_tc08_get_temp(int16_t handle, float *temp, int32_t *times, int32_t length,
                          int16_t *overflow, int16_t channel, int16_t units, int16_t fill)
{ temp[0] = 300.0f + channel; temp[599] = 1.0f; times[0] = 100000; *overflow = 0;
  return handle == 32767 && length == 600 && units == 2 && fill == 0 ? 1 : -1; }
int32_t usb_tc08_get_temp_deskew(int16_t handle, float *temp, int32_t *times, int32_t length,
                          int16_t *overflow, int16_t channel, int16_t units, int16_t fill)
{ return channel == 2 ? -1 : usb_tc08_get_temp(handle, temp, times, length, overflow, channel,
                                               units, fill); }
int16_t usb_tc08_get_unit_info(int16_t handle, info_t *info)
{ if (info->size != sizeof(info_t)) return 0;
  memcpy(info->driver, "2.0.17.1441", 12); memcpy(info->serial, "STUB/00/123", 11);
  memcpy(info->date, "01Jan2000", 9); info->hardware = 1; info->variant = sixty; return 1; }
"""


@pytest.fixture(scope="module")
def stub(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Build a library with the vendor's signatures from C, to see the types for real."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler 'cc': the argument types cannot be checked for real")
    source = tmp_path_factory.mktemp("stub") / "usbtc08.c"
    source.write_text(STUB)
    shared = source.with_suffix(".so")
    options = ["-std=c99", "-Wall", "-Werror", "-shared", "-fPIC"]
    subprocess.run([compiler, *options, str(source), "-o", str(shared)], check=True)
    return str(shared)


def test_types_of_a_real_library(stub: str) -> None:
    """Strings, structures, floats and 32-bit results come through C as they are."""
    with TC08.from_url(f"tc08://{stub}") as driver:
        assert not driver.is_simulated
        driver.set_mains(60)
        driver.set_channels({2: "T", 8: "T"})
        info, scan = driver.info(), driver.single()
        assert driver.minimum_interval() == 70.0
    assert (info.serial, info.calibration_date) == ("STUB/00/123", "01Jan2000")
    assert (info.driver, info.variant) == ("2.0.17.1441", 1)
    assert (scan.temperature[0], scan.temperature[2]) == (290.0, 292.0)
    assert list(scan.flag[[1, 8]]) == [Flag.MISSING, Flag.OVERFLOW]


def test_stream_of_a_real_library(stub: str) -> None:
    """Eight arguments and an interval beyond 16 bits come through C; so does an error."""
    with TC08.from_url(f"tc08://{stub}") as driver:
        driver.set_channels({2: "T"})
        with driver.stream(100.0) as stream:
            samples = stream.read(deskew=False)
            with pytest.raises(TC08Error, match="read channel 2 of its stream: error 16"):
                stream.read()
    assert (stream.interval, samples[2].temperature[0], samples[2].time[0]) == (100.0, 302.0, 100.0)


def test_other_library_is_refused(stub: str, tmp_path: Path) -> None:
    """A library without the functions is named, before anything is called."""
    source, shared = tmp_path / "other.c", tmp_path / "other.so"
    source.write_text("int nothing;")
    subprocess.run(["cc", "-shared", "-fPIC", str(source), "-o", str(shared)], check=True)
    with pytest.raises(OSError, match=r"other.so' without usb_tc08_\w+. Must be libusbtc08"):
        library.load(str(shared))
    assert library.load(environment={library.ENVIRONMENT: stub}).usb_tc08_stop(32767) == 1


@pytest.mark.hardware
def test_hardware() -> None:
    """A real unit with a type T in socket 1 reads a room, by both conversions alike."""
    with TC08.from_url() as driver:
        driver.set_channels({1: "T"})
        scan = driver.single()
        assert 273.0 < scan.temperature[0] < 320.0
        assert abs(driver.cross_check(1)) < 0.5
