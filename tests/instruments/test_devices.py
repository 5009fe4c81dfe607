"""The devices of a session are opened by their addresses, prepared, and say what they are."""

from collections.abc import Iterator

import numpy as np
import pytest
from faulty_devices import BosonBench, LoggerBench
from refused import assert_raises, assert_refused
from rig_session import bench, from_yaml, pictures, replaced, rig

from dbthermal.instruments import boson
from dbthermal.instruments.boson import Boson, FfcMode, Ir16Mode, Switch
from dbthermal.instruments.camera import FfcStatus
from dbthermal.instruments.devices import Devices, open_devices
from dbthermal.instruments.filterwheel import NotHomedError
from dbthermal.instruments.tc08 import ReadingError
from dbthermal.instruments.transport import TransportError


@pytest.fixture
def devices() -> Iterator[Devices]:
    """Open the whole rig on emulators."""
    with rig(from_yaml()) as opened:
        yield opened


def test_every_device_says_what_it_is(devices: Devices) -> None:
    """Identities label all as emulated; opening neither sets a camera nor turns the wheel."""
    names = devices.identities()
    assert names["8-14"]["serial_number"] == "93588"
    assert (names["9.5"]["serial_number"], names["9.5"]["device"]) == ("93589", "sim://boson/9.5")
    assert names["9.5"]["software_revision"] == "0.0.0"
    assert names["9.5"]["ffc_mode"] == "auto"
    assert names["filter_wheel"]["model"] == "BSC201"
    assert names["thermocouples"]["serial_number"] == "EMULATED"
    assert all(identity["is_simulated"] is True for identity in names.values())
    assert devices.cameras["9.5"].ffc_status() == FfcStatus.NONE_PERFORMED
    assert devices.wheel is not None
    with pytest.raises(NotHomedError):
        devices.wheel.position()


def test_whole_rig_is_closed() -> None:
    """All devices of the file are closed in the end."""
    with rig(from_yaml()) as devices:
        assert devices.wheel is not None
        assert devices.thermocouples is not None
    for ask in (devices.wheel.status, *(port.fpa_temperature for port in devices.cameras.values())):
        assert_raises(TransportError, "must stay connected and open", ask)
    for source in devices.sources.values():
        assert_raises(ConnectionError, "it is closed", source.read)
    assert_raises(RuntimeError, "closed", devices.thermocouples.identity)


def test_readings_are_named(devices: Devices) -> None:
    """Thermocouples, focal planes, shutters and wheel are read by their drivers, with units."""
    devices.world.blackbody_temperature = 300.0
    devices.world.camera("9.5").fpa_temperature = 311.25
    devices.prepare()
    readings = devices.readings()
    kelvin = {"blackbody": 300.0, "plate": 330.0, "fpa 8-14": 308.15, "fpa 9.5": 311.25}
    plain = {"ffc 8-14": 3.0, "ffc 9.5": 3.0, "filter_wheel": 1.0}
    values = {name: reading.read() for name, reading in readings.items()}
    assert values == pytest.approx({**kelvin, **plain}, abs=1e-4)  # a thermocouple is of 32 bits
    units = {name: reading.units for name, reading in readings.items()}
    assert units == {**dict.fromkeys(kelvin, "K"), **dict.fromkeys(plain, "1")}


def test_prepared_for_a_measurement(devices: Devices) -> None:
    """16 bits, telemetry, a correction that was run and no other to come, and the filter in."""
    devices.prepare()
    for camera in devices.cameras.values():
        assert isinstance(camera, Boson)
        assert camera.read(boson.IR16_MODE) == Ir16Mode.COUNTS_16
        assert camera.read(boson.FFC_MODE) == FfcMode.MANUAL
        assert camera.read(boson.TELEMETRY) == Switch.ON
        assert camera.ffc_status() == FfcStatus.COMPLETE
    assert devices.wheel is not None
    assert (devices.wheel.band(), devices.world.filter_name) == ("9.5", "9.5")
    assert devices.world.camera("8-14").ffc_count == 1


class Kept(dict[int, int]):
    """Settings that stay as they are."""

    def __setitem__(self, key: int, value: int) -> None:
        """Ignore the new value."""


def test_setting_that_is_not_taken_is_an_error() -> None:
    """A camera that acknowledges a setting but does not change raises an error."""
    bench = BosonBench()
    bench.device.settings = Kept({**bench.device.settings, boson.IR16_MODE.command: 2})
    message = r"Invalid IR16 mode .*TLINEAR.* of camera 93588, set to .*COUNTS_16.* Must be"
    with pytest.raises(ValueError, match=message):
        Devices(from_yaml(), {}, {"9.5": bench.camera}).prepare()


def test_camera_is_called_by_the_filter_in_the_beam(devices: Devices) -> None:
    """Turned to another filter, source, command port and identity of the camera bear its name."""
    devices.prepare()
    swept = devices.select("11")
    assert list(swept.sources) == list(swept.cameras) == list(swept.session.bands) == ["8-14", "11"]
    assert swept.sources["11"] is devices.sources["9.5"]
    assert {"fpa 11", "ffc 11"} < swept.readings().keys()
    assert swept.identities()["11"]["serial_number"] == "93589"
    assert swept.select("9.5").session.bands == ("8-14", "9.5")
    assert_refused(r"Invalid band '8-14' of the wheel", devices.select, "8-14")
    with pytest.raises(ValueError, match="Invalid band '11' of a session without a wheel"):
        Devices(devices.session, {}).select("11")


def test_frames_that_wait_are_thrown_away(devices: Devices) -> None:
    """After a flush the next frame is one that was exposed after it."""
    source = devices.sources["8-14"]
    source.read()
    devices.clock.sleep(0.05)
    start = devices.world.clock()
    devices.flush()
    assert source.read().device_time >= start


def test_one_scan_gives_all_channels_once() -> None:
    """One scan of the logger serves all channels, and each value is read once."""
    bench = LoggerBench()
    thermocouples = bench.ready()

    def read(channel: int, rise: float) -> float:
        """Reading of a channel [K] where the tips are warmer than at first by a rise [K]."""
        bench.tips = {"plate": 350.0 + rise, "room": 300.0 + rise}
        return round(thermocouples.read(channel), 3)

    assert [read(1, 0.0), read(2, 1.0)] == [350.0, 300.0]
    assert [read(2, 2.0), read(2, 3.0)] == [302.0, 303.0]
    bench.clock.sleep(1.1)  # the value that was not read yet is too old
    assert read(1, 4.0) == 354.0
    for fault, tip in (("open", (np.nan, False)), ("overflow", (673.15, True))):
        convert = {1: (354.0, False), 2: tip}.get
        vars(bench.unit)["convert"] = lambda channel, tips=convert: tips(channel, (296.15, False))
        bench.clock.sleep(1.1)
        with pytest.raises(ReadingError, match=f"thermocouple 'room' in channel 2: {fault}. Must"):
            thermocouples.read(2)
        assert thermocouples.read(1) == pytest.approx(354.0, abs=1e-3)


def test_frames_and_commands_of_two_cameras_are_told(devices: Devices) -> None:
    """Exchanged cables are detected where the frames carry a serial number."""
    crossed = dict(zip(devices.cameras, list(devices.cameras.values())[::-1], strict=True))
    wrong = Devices(devices.session, devices.sources, crossed)
    assert_refused(r"Invalid cameras \('93588', '93589'\) of band '8-14'", wrong.identities)


def test_hardware_has_no_emulated_world() -> None:
    """A session of hardware with an emulated world raises an error."""
    real = from_yaml(replaced(("simulated: true", "simulated: false")))
    world = bench(real)
    for extra in ((world, None), (None, pictures(world))):
        with (
            pytest.raises(ValueError, match="Invalid world for the hardware of 'plate'"),
            open_devices(real, *extra),
        ):
            pass
