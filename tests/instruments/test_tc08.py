"""The TC-08 driver on an emulated library, and on a stub compiled from the header's types."""

import ctypes
import shutil
import subprocess
from ctypes import c_int8, c_int16
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from faulty_devices import LoggerBench
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from refused import assert_raises

from dbthermal.instruments import tc08
from dbthermal.instruments.tc08 import TC08, TC08Error

FLOAT32 = 4e-5  # [K] the library's numbers have 24 bits


@pytest.fixture
def rig() -> LoggerBench:
    """Give a rig that is not open yet."""
    return LoggerBench()


def test_single_reading_in_kelvin(rig: LoggerBench) -> None:
    """Two tips and the cold junction are read, in the middle of 0.3 s; six sockets are off."""
    scan = rig.ready().single()
    assert_allclose(scan.temperature[:3], [296.15, 350.0, 300.0], rtol=0, atol=FLOAT32)
    assert np.isnan(scan.temperature[3:]).all()
    assert scan.time == pytest.approx(1000.15)


@given(st.lists(st.floats(width=32), min_size=9, max_size=9), st.integers(0, 2**9 - 1))
def test_any_answer_of_the_library(raw: list[float], bits: int) -> None:
    """Any raw values give a finite positive temperature, as it is, or NaN."""
    driver, unit = (rig := LoggerBench()).ready(), rig.unit
    with patch.object(unit, "convert", lambda channel: (raw[channel], bits >> channel & 1)):
        scan = driver.single()
    valid = np.isfinite(scan.temperature)
    assert np.all(scan.temperature[valid] > 0.0)
    np.testing.assert_array_equal(scan.overflow, [bits >> channel & 1 for channel in range(9)])
    assert not np.any(valid & scan.overflow)
    assert_allclose(scan.temperature[valid], np.array(raw)[valid], rtol=0, atol=0)


def test_unit_is_opened_and_closed(rig: LoggerBench) -> None:
    """The constructor opens nothing, a second close does nothing; channels are set anew."""
    assert_raises(RuntimeError, r"closed\. Must be opened first", rig.driver.identity)
    rig.ready().close()
    rig.driver.close()
    info = rig.driver.open().identity()
    assert (info["serial_number"], info["driver"]) == ("EMULATED", "emulated")
    assert (info["is_simulated"], info["calibration_date"]) == (True, "01Jan00")
    assert_raises(RuntimeError, "open already", rig.driver.open)
    for channels in ({0: "a"}, {9: "a"}, {}):
        with pytest.raises(ValueError, match=r"channel \d\. Must lie in|Must be one at"):
            rig.driver.set_channels(channels)
    assert_raises(RuntimeError, "Must be set by set_channels first", rig.driver.single)


def test_channels_that_are_set_later_are_read(rig: LoggerBench) -> None:
    """A scan from before a channel was set says nothing of it."""
    rig.driver.open().set_channels({1: "plate"})
    assert rig.driver.read(1) == pytest.approx(350.0, abs=FLOAT32)
    rig.driver.set_channels({1: "plate", 2: "room"})
    assert rig.driver.read(2) == pytest.approx(300.0, abs=FLOAT32)


def test_firmware_download_is_waited_for(rig: LoggerBench) -> None:
    """Opening takes as long as the firmware's download, if that ends and a unit is there."""
    start, opened = rig.clock(), rig.unit.usb_tc08_open_unit_progress
    with patch.object(rig.unit, "usb_tc08_open_unit_progress") as progress:
        progress.side_effect = lambda *args: opened(*args) if rig.clock() >= start + 6.0 else 0
        assert_raises(TimeoutError, r"not open after 5.0 s, at 0 %", rig.driver.open, timeout=5.0)
        rig.driver.open()
    assert rig.clock() - start == pytest.approx(6.0, abs=0.051)
    rig.driver.close()
    rig.unit.is_open = True  # by another program
    assert_raises(ConnectionError, r"No TC-08\. Must be plugged in, and free", rig.driver.open)


# What the vendor's header says of each error number, in a word.
MEANINGS = (
    *("no error", "operating system", "no channels", "argument", "version", "mode", "enumerated"),
    *("respond", "firmware", "EEPROM", "not found", "threading", "pipes", "calibration", "picopp"),
    *("function of Pico's driver", "communication"),
)


def test_each_error_is_explained(rig: LoggerBench) -> None:
    """Each of the 16 error numbers is an exception with its published meaning."""
    rig.ready()
    assert len(tc08.ERRORS) == len(MEANINGS) == 17
    for code in range(1, 17):
        rig.fail(code, "get_single")
        with pytest.raises(TC08Error, match=f"single reading: error {code}, .*{MEANINGS[code]}"):
            rig.driver.single()


@pytest.mark.parametrize("function", ["open_unit_async", "open_unit_progress", "set_channel"])
def test_each_failing_step_of_opening_is_seen(rig: LoggerBench, function: str) -> None:
    """A step that fails is an error, and leaves no channel half set."""
    rig.fail(9, function)
    assert_raises(TC08Error, "EEPROM", rig.ready)
    with pytest.raises(RuntimeError):
        rig.driver.single()


def test_unplugging(rig: LoggerBench) -> None:
    """An unplugged unit raises an error at the next reading, noting that closing fails too."""
    rig.ready()
    rig.fail(16, "get_single", "close_unit")
    with (
        pytest.raises(TC08Error, match="communication with the unit is lost") as caught,
        rig.driver,
    ):
        rig.driver.single()
    assert caught.value.__notes__[0].startswith("Closing failed too. The TC-08 could not close")
    rig.driver.close()


def test_missing_library(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Without the vendor's library the error says where to get it."""
    monkeypatch.setattr(ctypes.util, "find_library", lambda _: None)
    monkeypatch.delenv(tc08.ENVIRONMENT, raising=False)
    assert_raises(FileNotFoundError, r"No library 'usbtc08'.*DBTHERMAL_USBTC08", tc08.load)
    monkeypatch.setenv(tc08.ENVIRONMENT, str(tmp_path / "gone.so"))
    assert_raises(OSError, r"gone\.so", tc08.load)


STUB = r"""
#include <math.h>
#include <stdint.h>
#include <string.h>
typedef struct { int16_t size; int8_t driver[12]; int16_t kernel, hardware, variant;
                 int8_t serial[11]; int8_t date[9]; } info_t;
static int8_t kinds[9];
int16_t usb_tc08_open_unit_async(void) { return 1; }
int16_t usb_tc08_open_unit_progress(int16_t *handle, int16_t *percent)
{ *handle = 32767; *percent = 100; return 1; }
int16_t usb_tc08_close_unit(int16_t handle) { return handle == 32767; }
int16_t usb_tc08_get_last_error(int16_t handle) { return handle == 0 ? 10 : 16; }
int16_t usb_tc08_set_channel(int16_t handle, int16_t channel, int8_t kind)
{ kinds[channel] = kind; return handle == 32767 && !(channel == 1 && kind == 'T'); }
int16_t usb_tc08_get_single(int16_t handle, float *temp, int16_t *flags, int16_t units)
{ for (int i = 0; i < 9; i++) temp[i] = kinds[i] == 32 ? NAN : 290.0f + i + 100.0f * (units - 2);
  *flags = 1 << 8; return handle == 32767; }
int16_t usb_tc08_get_unit_info(int16_t handle, info_t *info)
{ if (info->size != sizeof(info_t)) return 0;
  memcpy(info->driver, "2.0.17.1441", 12); memcpy(info->serial, "STUB/00/123", 11);
  memcpy(info->date, "01Jan2000", 9); info->hardware = 1; info->variant = 8; return 1; }
"""


def compiled(folder: Path, text: str) -> str:
    """Build a shared library from C."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler 'cc': the argument types cannot be checked for real")
    source, shared = folder / "stub.c", folder / "stub.so"
    source.write_text(text)
    options = ["-std=c99", "-Wall", "-Werror", "-shared", "-fPIC"]
    subprocess.run([compiler, *options, str(source), "-o", str(shared)], check=True)
    return str(shared)


def test_types_of_a_real_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Strings, structures, floats and an error come through C as they are."""
    monkeypatch.setenv(tc08.ENVIRONMENT, compiled(tmp_path, STUB))
    with TC08(tc08.load()).open() as driver:
        assert not driver.is_simulated
        driver.set_channels({2: "plate", 8: "room"})
        info, scan = driver.identity(), driver.single()
        with pytest.raises(TC08Error, match="set channel 1 to 'T': error 16"):
            driver.set_channels({1: "plate"})
    assert (info["serial_number"], info["calibration_date"]) == ("STUB/00/123", "01Jan2000")
    assert (info["driver"], info["variant"]) == ("2.0.17.1441", "8")
    assert (scan.temperature[0], scan.temperature[2]) == (290.0, 292.0)
    assert np.isnan(scan.temperature[[1, 8]]).all()
    assert np.flatnonzero(scan.overflow).tolist() == [8]


def test_other_library_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A library without the functions is named, before anything is called."""
    monkeypatch.setenv(tc08.ENVIRONMENT, compiled(tmp_path, "int nothing;"))
    assert_raises(OSError, r"stub.so' without usb_tc08_\w+. Must be libusbtc08", tc08.load)
    assert tc08.SIGNATURES["usb_tc08_set_channel"] == [c_int16, c_int16, c_int8]
