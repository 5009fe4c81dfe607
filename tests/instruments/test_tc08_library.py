"""The vendor's library behind the TC-08 driver: found, loaded, and called with the right types."""

import ctypes
import shutil
import subprocess
import sys
from ctypes import c_int8, c_int16, c_int32
from pathlib import Path

import pytest

from dbthermal.instruments.tc08 import TC08, Flag, TC08Error, library
from dbthermal.instruments.tc08.library import SIGNATURES


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


def test_types_of_the_library_are_those_of_its_header() -> None:
    """Four functions return 32 bits, where the vendor's own wrapper has 16; a letter is 8 bits."""
    names = {
        name.removeprefix("usb_tc08_")
        for name, (result, _) in SIGNATURES.items()
        if result is c_int32
    }
    assert names == {"get_minimum_interval_ms", "run", "get_temp", "get_temp_deskew"}
    assert {result for result, _ in SIGNATURES.values()} == {c_int16, c_int32}
    assert SIGNATURES["usb_tc08_set_channel"][1] == [c_int16, c_int16, c_int8]


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
        info, scan = driver.identity(), driver.single()
        assert driver.minimum_interval() == 70.0
    assert (info.serial_number, info.calibration_date) == ("STUB/00/123", "01Jan2000")
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
