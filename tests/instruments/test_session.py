"""Sessions: their description in YAML, and the checks of its keys."""

import re
import textwrap
from pathlib import Path

import pytest
from rig_session import TEXT, from_yaml, replaced

from dbthermal.instruments import session as description
from dbthermal.instruments.session import Session
from reproduction import paths

SWEEP, FILTERS = "sweep: [9.5, 11]\n", 'filters: {1: 9.5, 3: "11"}\n'


def test_session_is_read(tmp_path: Path) -> None:
    """All keys of the file are read; devices have their addresses, emulated or not."""
    (tmp_path / "a.yaml").write_text(TEXT, encoding="utf-8")
    session = Session.load(tmp_path / "a.yaml")
    assert session.bands == ("8-14", "9.5")
    assert session.cameras["9.5"].video == "v4l2:///dev/video2"
    assert session.filters == {1: "9.5", 3: "11"}
    real = from_yaml(replaced(("simulated: true", "simulated: false")))
    assert real.devices == session.devices
    assert real.devices["filter_wheel"] == "serial:///dev/ttyUSB0"
    assert real.blackbody is not None
    assert real.blackbody.temperatures == (300.0, 290.0, 310.0)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "protocol: response",
            "protocol: sweep",
            "Invalid protocol 'sweep'. Must be 'gain_offset'",
        ),
        ("protocol: response", "protocol: scene", "of protocol 'scene'. Must have no blackbody"),
        ("duration: 0.15\n", "", "session: Missing 'duration'. Must be set"),
        ("duration: 0.15", "duration: -1", "Invalid duration -1. Must be greater than 0"),
        ("duration: 0.15", "time: 1", "Unknown key 'time'. Must be one of"),
        ("simulated: true", "simulated: maybe", "Invalid simulated 'maybe'. Must be a valid bool"),
        ("duration: 0.15", "duration: long", "Invalid duration 'long'. Must be a valid number"),
        ("[300.0, 290.0, 310.0]", "[290.0, -3]", "blackbody.temperatures.1 -3. Must be"),
        ("[300.0, 290.0, 310.0]", "[]", "Invalid blackbody.temperatures []. Must have at least"),
        (SWEEP, "sweep: [", "session, line 22, column 1: Must be YAML"),
        (
            SWEEP,
            'sweep: ["12"]\n',
            "Invalid filter of the sweep '12'. Must be one of ['9.5', '11']",
        ),
        (SWEEP, "sweep: [11, 11]\n", "Repeated filter of the sweep '11'. Must be listed once"),
        (FILTERS, 'filters: {7: "9.5"}\n', "Invalid filters.7 7. Must be less than or equal to 6"),
        (FILTERS, 'filters: {1: "9.5", 2: "9.5"}\n', "Repeated filter '9.5'. Must be listed once"),
        (
            FILTERS,
            "filters: {1: a, 2: b}\n",
            "Invalid cameras [] behind the wheel. Must be exactly",
        ),
        (FILTERS, 'filters: {1: "9.5", 2: "8-14"}\n', "Invalid cameras ['8-14', '9.5'] behind"),
        (FILTERS, "filters: {1: 9.5, 2: a/b}\n", "Invalid filters.2 'a/b'. Must match pattern"),
        ("name: plate", "name: ../plate", "Invalid name '../plate'. Must match pattern"),
        (
            "{1: blackbody, 4",
            "{9: blackbody, 4",
            "Invalid thermocouples.9 9. Must be less than or equal to 8",
        ),
        ("4: plate}", "4: 8-14}", "Repeated thermocouple '8-14'. Must be listed once"),
        ("4: plate}", "4: ffc 11}", "Repeated thermocouple 'ffc 11'. Must be listed once"),
        (
            "telemetry_rows: 2",
            "telemetry_rows: 3",
            "Invalid telemetry_rows 3. Must be 0 or 2",
        ),
        (
            '  thermocouples: "tc',
            '  thermometer: "tc',
            "Invalid devices.thermometer 'thermometer'. Must be",
        ),
        ("  filter_wheel:", "  #", "Missing device 'filter_wheel' of {1: '9.5', 3: '11'}"),
        ('"tc08:"', "sim://tc08", "Invalid address 'sim://tc08'. Must be tc08:"),
        (
            "v4l2:///dev/video0",
            "file://a",
            "8-14.video: Invalid address 'file://a'. Must be",
        ),
    ],
)
def test_invalid_sessions_are_refused(old: str, new: str, message: str) -> None:
    """An invalid session raises a ValueError with the key, the value and the rule."""
    with pytest.raises(ValueError, match=re.escape(message)):
        from_yaml(replaced((old, new)))


def test_shared_rig_is_in_a_file_of_its_own(tmp_path: Path) -> None:
    """Shared keys come from the rig's file; a key in both files raises a ValueError."""
    own, shared = ["name: plate", "rig: rig.yaml"], list[str]()
    for line in TEXT.splitlines():
        of_session = line.startswith(("simulated", "protocol", "duration", "blackbody", "sweep"))
        (own if of_session else shared).append(line)
    shared.remove("name: plate")
    (tmp_path / "a.yaml").write_text("\n".join(own), encoding="utf-8")
    (tmp_path / "rig.yaml").write_text("\n".join(shared), encoding="utf-8")
    assert Session.load(tmp_path / "a.yaml") == from_yaml(TEXT)
    wrong = [line.replace("telemetry_rows: 2", "telemetry_rows: 1") for line in shared]
    (tmp_path / "rig.yaml").write_text("\n".join(wrong), encoding="utf-8")
    with pytest.raises(ValueError, match=r"rig\.yaml: Invalid telemetry_rows 1\. Must be 0 or 2"):
        Session.load(tmp_path / "a.yaml")
    (tmp_path / "rig.yaml").write_text("\n".join([*shared, "duration: 3"]), encoding="utf-8")
    with pytest.raises(ValueError, match="Repeated key of session and rig 'duration'"):
        Session.load(tmp_path / "a.yaml")
    (tmp_path / "rig.yaml").unlink()
    message = r"Missing file of key 'rig' of session '.*a\.yaml'.*: '.*rig\.yaml'$"
    with pytest.raises(FileNotFoundError, match=message):
        Session.load(tmp_path / "a.yaml")


def test_described_session_is_valid() -> None:
    """The YAML of the module's docstring is a session, with settings that a wheel has."""
    assert description.__doc__ is not None
    (text,) = re.findall(r"::\n\n(.*?)\n\n\S", description.__doc__, re.DOTALL)
    session = from_yaml(textwrap.dedent(text))
    assert session.swept == ("9.5", "11")
    assert session.wheel.home_offset == 12.5


def test_camera_behind_the_wheel() -> None:
    """The camera behind the wheel is the one whose band is a filter of the wheel."""
    session = from_yaml(TEXT)
    assert (session.filtered, session.swept) == ("9.5", ("9.5", "11"))
    alone = from_yaml(replaced((SWEEP, "")))
    assert (alone.filtered, alone.swept) == ("9.5", ("9.5",))
    none = from_yaml(replaced((SWEEP, ""), (FILTERS, "")))
    assert (none.filtered, none.swept) == (None, ())


def test_one_temperature_is_no_calibration_twice() -> None:
    """A bench may repeat a temperature of the blackbody; a calibration raises a ValueError."""
    twice = ("[300.0, 290.0, 310.0]", "[300.0, 290.0, 300.0]")
    bench = replaced(twice, ("protocol: response", "protocol: emissivity_bench"))
    assert from_yaml(bench).blackbody is not None
    with pytest.raises(ValueError, match=r"Repeated temperature \[K\] '300\.0'"):
        from_yaml(replaced(twice))


@pytest.mark.parametrize("name", ["response", "emissivity_bench", "scene"])
def test_rig_of_the_project_has_one_switch(name: str) -> None:
    """All its sessions are emulated as they come, until the one file that they share says not."""
    path = paths.session(name)
    assert "simulated" not in path.read_text(encoding="utf-8")
    assert Session.load(path).simulated
    hardware = Session.load(path, {"simulated": False})
    assert hardware.cameras["8-14"].video == "v4l2:///dev/video0"
