"""Streams of the TC-08 on an emulated library: times, losses, and samples that are none."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from rig_devices import Clock, LoggerBench
from test_tc08 import FLOAT32

from dbthermal.instruments.emulated.tc08 import EmulatedTC08
from dbthermal.instruments.tc08 import TC08, Flag, TC08Error
from dbthermal.instruments.tc08.stream import LONGEST, Timeline


@pytest.fixture
def rig() -> LoggerBench:
    """Give a rig that is not open yet."""
    return LoggerBench()


@pytest.mark.parametrize("conversion", ["library", "its90"])
def test_stream(rig: LoggerBench, conversion: str) -> None:
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
    clock = Clock(1000.0)
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


def test_stream_that_is_not_read_in_time(rig: LoggerBench) -> None:
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


def test_samples_lost_before_the_first_read(rig: LoggerBench) -> None:
    """The ring overflows before anything was read, and that is counted too."""
    stream = rig.ready().stream(0.3)
    rig.clock.sleep(300.0)
    assert stream.read()[1].lost == 400


def test_read_that_fails_once(rig: LoggerBench) -> None:
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


def test_sample_that_the_host_missed(rig: LoggerBench) -> None:
    """What the library pads with NaN is flagged, and not given as a temperature."""
    rig.unit.faults.starved = {2}
    stream = rig.ready("its90").stream(1.0)
    rig.clock.sleep(3.0)
    samples = stream.read()[1]
    assert list(samples.flag) == [0, Flag.MISSING | Flag.NO_JUNCTION, 0]
    assert list(np.isnan(samples.temperature)) == [False, True, False]


def test_overflow_in_a_stream(rig: LoggerBench) -> None:
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
    rig = LoggerBench(first_ms=2**31 - 5000)
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


def test_single_reading_while_streaming(rig: LoggerBench) -> None:
    """A unit that streams takes no other order; once the stream is closed, it does."""
    driver = rig.ready()
    with driver.stream(1.0) as stream:
        for order in (driver.single, lambda: driver.stream(1.0), lambda: driver.set_mains(50)):
            with pytest.raises(RuntimeError, match=r"while it streams\. Must be stopped first"):
                order()
    assert np.isfinite(driver.single().temperature[1])
    with pytest.raises(RuntimeError, match="stream of the TC-08 is closed"):
        stream.read()


def test_unplugging_while_streaming(rig: LoggerBench) -> None:
    """A stream whose unit is pulled out fails at the next read; closing the unit ends it."""
    stream = rig.ready().stream(1.0)
    rig.unit.faults.unplugged, rig.unit.faults.unplugged_error = True, 7
    with pytest.raises(TC08Error, match="read channel 1 of its stream: error 7"):
        stream.read()
    with pytest.raises(TC08Error, match="does not respond"):
        rig.driver.close()
    stream.close()
    assert not stream.is_running


def test_a_cold_junction_that_is_too_old_is_none() -> None:
    """A sample 1.4 intervals away counts, one 1.6 intervals away does not."""
    timeline = Timeline(2.0)
    timeline.add_junction(np.array([10.0]), np.array([296.15]))
    assert np.isnan(timeline.junction_at(np.array([13.2]))).all()
    assert timeline.junction_at(np.array([12.8])).tolist() == [296.15]


@pytest.mark.parametrize("interval", [np.nan, np.inf, -1.0, LONGEST + 1.0, 1.0005])
def test_an_interval_that_does_not_fit_is_refused(interval: float) -> None:
    """No interval is wrapped to fit 32 bits, and none that is no number reaches the library."""
    driver = LoggerBench().ready()
    with pytest.raises(ValueError, match=r"Must be 0\.3 s or longer, to 2147483\.647 s"):
        driver.stream(interval)
