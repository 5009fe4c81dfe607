"""Sessions: what is read, and what is refused, by place, value and rule."""

import random
import re
import textwrap
from collections.abc import Iterator
from copy import deepcopy
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
import yaml
from rig_session import TEXT, from_yaml, replaced

from dbthermal.__main__ import main
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


VALUES: list[Any] = [
    *(None, [], {}, "", "on", "é\u202e", "x" * 5000, "../x", True, False, [None], {"a": 1}),
    *(-1, 0, -0.0, 0.5, 1e-300, 1e6, 1e309, float("nan"), 10**30, [0, 0], [[0, 0]], [["a"]]),
    *("sim://", "sim://boson/a/b", "tc08:///tmp/x.so", "serial:///etc/passwd", "http://a/b"),
]
NAMES = ["extra", "", None, True, 9, 9.5, "é", "x" * 500]


def sessions() -> list[dict[Any, Any]]:
    """Return the contents of the sessions that come with the project, and of the tests' rig."""
    rig = yaml.safe_load(paths.session("rig").read_text(encoding="utf-8"))
    contents = [yaml.safe_load(TEXT)]
    for name in ("scene", "response", "emissivity_bench", "y16"):
        own = yaml.safe_load(paths.session(name).read_text(encoding="utf-8"))
        contents.append({**rig, **own} if own.pop("rig", None) else own)
    return contents


def places(content: Any, before: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the keys that lead to each value of nested mappings and lists."""
    if isinstance(content, dict | list):
        pairs = content.items() if isinstance(content, dict) else enumerate(content)
        for key, value in pairs:
            yield (*before, key)
            yield from places(value, (*before, key))


def value_at(content: Any, place: tuple[Any, ...]) -> Any:
    """Value to which keys lead."""
    for key in place:
        content = content[key]
    return content


def mutant(rng: random.Random, original: dict[Any, Any]) -> tuple[str, str, dict[Any, Any]]:
    """Deed, key and content of a session of which one value is deleted, added or changed."""
    content = deepcopy(original)
    place = rng.choice([*places(content)])
    inside, key = value_at(content, place[:-1]), place[-1]
    deed = rng.choice(["delete", "value", "value", "other", "rename", "add"])
    if deed == "delete":
        del inside[key]
    elif deed == "value":
        inside[key] = rng.choice(VALUES)
    elif deed == "other":
        inside[key] = deepcopy(value_at(original, rng.choice([*places(original)])))
    elif isinstance(inside, list):
        inside.append(rng.choice(VALUES))
    elif deed == "rename":
        inside[rng.choice(NAMES)] = inside.pop(key)
    else:
        inside[rng.choice(NAMES)] = rng.choice(VALUES)
    return deed, str(place[0]), content


def check(number: int, seed: int) -> int:
    """Count the refused among so many mutants, all of which are refused in words, not wrecked."""
    rng, originals, refused = random.Random(seed), sessions(), 0
    for _ in range(number):
        deed, key, content = mutant(rng, rng.choice(originals))
        try:
            session = from_yaml(yaml.safe_dump(content, allow_unicode=True))
        except ValueError as error:
            lines = str(error).splitlines()
            refused += 1
            assert all(line.startswith("session") and "Must " in line for line in lines), lines
            assert max(map(len, lines)) < 400, lines
        else:
            assert 0 < session.duration <= 1e6, (deed, key)
            assert all(2 <= size <= 8192 for size in session.shape), (deed, key)
            hardware = [camera.video for camera in session.cameras.values()]
            assert all(url.startswith("v4l2:///dev/") for url in hardware), (deed, key)
    return refused


@pytest.mark.parametrize("number", [300, pytest.param(6000, marks=pytest.mark.long)])
def test_mutants_are_refused_in_words(number: int) -> None:
    """Of mutated sessions, others in each week, most are refused, by place, value and rule."""
    year, week, _ = datetime.now(UTC).isocalendar()
    print("seed:", seed := 100 * year + week)
    assert check(number, seed) > 0.6 * number


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("duration: 0.15", "duration: 1\nduration: 2", "line 6, column 1: Repeated key 'duration'"),
        ("simulated: true", "simulated: on", "line 3, column 12: Invalid value on. Must be"),
        ("frame_rate: 100", "frame_rate: 1e9", "Invalid value 1e9. Must be a finite decimal"),
        ("[4, 80]", "[0, 80]", "session: Invalid shape.0 0. Must be greater than or equal to 2"),
        ("[4, 80]", "[4, 60]", "Invalid shape [4, 60]. Must have 71 columns for the telemetry"),
        ("[4, 80]", "[4, 80, 1]", "Invalid shape"),
        ("[4, 80]", "[true, 80]", "Invalid shape.0 True. Must be a valid integer"),
        ("duration: 0.15", "duration: 0.001", "Invalid duration 0.001 s. Must be one frame"),
        ("[300.0, 290.0", "[26.85, 290.0", "blackbody.temperatures.0 26.85. Must be greater than"),
        ("window: 3", "window: 20", "blackbody: Invalid window 20.0 s. Must be below the timeout"),
        ("velocity: 50.0, h", "speed: 50.0, h", "Unknown key 'wheel.speed'"),
        (
            "velocity: 50.0, h",
            'velocity: "50", h',
            "Invalid wheel.velocity '50'. Must be a valid number",
        ),
        ("wheel: {velocity", "wheel: {filters: {1: a}, velocity", "Unknown key 'wheel.filters'"),
        ('"tc08:"', '"tc08:///tmp/x.so"', "Invalid address 'tc08:///tmp/x.so'. Must be"),
        ("serial:///dev/ttyUSB0", "tc08:", "Invalid address 'tc08:'. Must be serial:///dev/"),
        (
            "v4l2:///dev/video2",
            "serial:///dev/ttyS0",
            "video: Invalid address 'serial:///dev/ttyS0'",
        ),
        ("v4l2:///dev/video2", "v4l2:///dev/../tmp/x", "Invalid address 'v4l2:///dev/../tmp/x'"),
        ("4: plate}", '4: " plate"}', "thermocouples.4 ' plate'. Must be printable, without space"),
        ("4: plate}", '4: ""}', "Invalid thermocouples.4 ''. Must have at least 1 character"),
    ],
)
def test_invalid_content_ends_the_command_with_its_line(
    old: str, new: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Status 1 and one line with file, key, value and rule, even for a dry run."""
    path = tmp_path / "a.yaml"
    path.write_text(replaced((old, new)), encoding="utf-8")
    assert main(["record", str(path), str(tmp_path), "--dry-run"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"dbthermal record: {path}")
    assert message.removeprefix("session: ") in line


def test_one_device_is_not_two() -> None:
    """Two bands cannot have one camera's address; emulated ones are told apart by their world."""
    twice = ("v4l2:///dev/video2", "v4l2:///dev/video0")
    assert from_yaml(replaced(twice)).simulated
    with pytest.raises(ValueError, match="Repeated address 'v4l2:///dev/video0'"):
        from_yaml(replaced(twice, ("simulated: true", "simulated: false")))


@pytest.mark.parametrize("content", [b"\xff\xfe", b"\x00", b"name: \xff", b"", b"[" * 10_000])
def test_files_that_are_no_session(content: bytes, tmp_path: Path) -> None:
    """Bytes that are no text and text that is no mapping end with status 1, not in a traceback."""
    path = tmp_path / "a.yaml"
    path.write_bytes(content)
    assert main(["record", str(path), str(tmp_path), "--dry-run"]) == 1
    assert main(["record", str(tmp_path), str(tmp_path), "--dry-run"]) == 1


@pytest.mark.parametrize("rig", ["[1]", "null", '"a\\0b"', "5", "."])
def test_rig_must_be_a_file(rig: str, tmp_path: Path) -> None:
    """The key `rig` is a file's name; another value, or a folder, is refused."""
    path = tmp_path / "a.yaml"
    path.write_text(f"name: a\nrig: {rig}\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"Invalid (rig|file) .* Must be"):
        Session.load(path)
