"""Sessions: their description in YAML, and what is refused, in a line that says why."""

import random
import re
import textwrap
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import yaml
from hostile_files import seed_of_week
from refused import assert_raises, assert_refused
from rig_session import TEXT, from_yaml, replaced

from dbthermal.__main__ import main
from dbthermal.instruments import session as description
from dbthermal.instruments.session import Session
from reproduction import paths

SWEEP, FILTERS = "sweep: [9.5, 11]\n", 'filters: {1: 9.5, 3: "11"}\n'
REAL = ("simulated: true", "simulated: false")


def test_session_is_read() -> None:
    """All keys of the file are read; devices have their addresses, emulated or not."""
    session = from_yaml()
    assert session.bands == ("8-14", "9.5")
    assert session.cameras["9.5"].video == "v4l2:///dev/video2"
    assert session.filters == {1: "9.5", 3: "11"}
    real = from_yaml(replaced(REAL))
    assert real.devices == session.devices
    assert real.devices["filter_wheel"] == "serial:///dev/ttyUSB0"
    assert real.blackbody is not None
    assert real.blackbody.temperatures == (300.0, 290.0, 310.0)
    plain, none = (from_yaml(replaced((SWEEP, ""), *also)) for also in ([], [(FILTERS, "")]))
    assert [sample.filtered for sample in (session, plain, none)] == ["9.5", "9.5", None]
    assert [sample.swept for sample in (session, plain, none)] == [("9.5", "11"), ("9.5",), ()]


# In the session of the tests' rig: what stands there, what is in its place, and the message.
REFUSED = r"""
protocol: response => protocol: sweep => Invalid protocol 'sweep'. Must be 'gain_offset'
protocol: response => protocol: scene => of protocol 'scene'. Must have no blackbody
duration: 0.15\n => => Missing 'duration'. Must be set
simulated: true\n => => Missing 'simulated'. Must be set
duration: 0.15 => duration: -1 => Invalid duration -1. Must be greater than 0
duration: 0.15 => duration: long => Invalid duration 'long'. Must be a valid number
duration: 0.15 => duration: 0.001 => Invalid duration 0.001 s. Must be one frame
duration: 0.15 => duration: 1\nduration: 2 => line 6, column 1: Repeated key 'duration'
simulated: true => simulated: maybe => Invalid simulated 'maybe'. Must be a valid bool
simulated: true => simulated: on => line 3, column 12: Invalid value on. Must be
frame_rate: 100 => frame_rate: 1e9 => Invalid value 1e9. Must be a finite decimal
[4, 80] => [0, 80] => Invalid shape.0 0. Must be greater than or equal to 2
[4, 80] => [4, 60] => Invalid shape [4, 60]. Must have 71 columns for the telemetry
[4, 80] => [true, 80] => Invalid shape.0 True. Must be a valid integer
telemetry_rows: 2 => telemetry_rows: 3 => Invalid telemetry_rows 3. Must be 0 or 2
[300.0, 290.0, 310.0] => [] => Invalid blackbody.temperatures []. Must have at least
[300.0, 290.0, 310.0] => [300.0, 290.0, 300.0] => Repeated temperature [K] '300.0'
[300.0, 290.0 => [26.85, 290.0 => blackbody.temperatures.0 26.85. Must be greater than
window: 3 => window: 20 => blackbody: Invalid window 20.0 s. Must be below the timeout
[9.5, 11] => [ => line 23, column 1: Must be YAML
[9.5, 11] => ["12"] => Invalid filter of the sweep '12'. Must be one of ['9.5', '11']
[9.5, 11] => [11, 11] => Repeated filter of the sweep '11'. Must be listed once
{1: 9.5, 3: "11"} => {7: "9.5"} => Invalid filters.7 7. Must be less than or equal to 6
{1: 9.5, 3: "11"} => {1: "9.5", 2: "9.5"} => Repeated filter '9.5'. Must be listed once
{1: 9.5, 3: "11"} => {1: a, 2: b} => Invalid cameras [] behind the wheel. Must be exactly
{1: 9.5, 3: "11"} => {1: "9.5", 2: "8-14"} => Invalid cameras ['8-14', '9.5'] behind
{1: 9.5, 3: "11"} => {1: 9.5, 2: a/b} => Invalid filters.2 'a/b'. Must match pattern
name: plate => name: ../plate => Invalid name '../plate'. Must match pattern
{1: blackbody, 4: => {4: => Must have one named 'blackbody'
4: plate} => 4: 8-14} => Repeated thermocouple '8-14'. Must be listed once
4: plate} => 4: ffc 11} => Repeated thermocouple 'ffc 11'. Must be listed once
4: plate} => 4: " plate"} => thermocouples.4 ' plate'. Must be printable, without space
velocity: 50.0, h => speed: 50.0, h => Unknown key 'wheel.speed'
velocity: 50.0, h => velocity: 0.0, h => wheel.velocity 0.0. Must be greater than or equal to 0.1
wheel: {velocity => wheel: {home_offset: 400.0, velocity => home_offset 400.0. Must be less than 360
  thermocouples: "tc =>   thermometer: "tc => devices.thermometer 'thermometer'. Must be
  filter_wheel: =>   # => Missing device 'filter_wheel' of {1: '9.5', 3: '11'}
"tc08:" => "tc08:///tmp/x.so" => Invalid address 'tc08:///tmp/x.so'. Must be
"tc08:" => "tc09:" => Invalid address 'tc09:'. Must be tc08:
serial:///dev/ttyACM0 => v4l2:///dev/video0 => Must be serial:///dev/<port>
v4l2:///dev/video0 => v4l2:///tmp/x => Must be v4l2:///dev/<node>
v4l2:///dev/video0 => sim://boson/wide => Invalid address 'sim://boson/wide'. Must be
v4l2:///dev/video2 => v4l2:///dev/../tmp/x => Invalid address 'v4l2:///dev/../tmp/x'
duration: 0.15 => duration: 0.15\ntime: 1 => Unknown key 'time'. Must be one of
"""
CASES = [line.split(" => ") for line in REFUSED.replace("=> =>", "=>  =>").strip().splitlines()]


@pytest.mark.parametrize(("old", "new", "message"), CASES)
def test_invalid_sessions_are_refused(
    old: str, new: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Status 1 and one line with file, key, value and rule, even for a dry run."""
    path = tmp_path / "a.yaml"
    content = replaced((old.replace(r"\n", "\n"), new.replace(r"\n", "\n")))
    path.write_text(content, encoding="utf-8")
    assert main(["record", str(path), str(tmp_path), "--dry-run"]) == 1
    said = capsys.readouterr()
    (line,) = said.err.splitlines()
    assert (said.out, line.startswith(f"dbthermal record: {path}")) == ("", True)
    assert message in line


def test_two_of_a_thing() -> None:
    """A bench may repeat a temperature, emulated cameras an address; those of hardware may not."""
    twice = ("[300.0, 290.0, 310.0]", "[300.0, 290.0, 300.0]")
    bench = replaced(twice, ("protocol: response", "protocol: emissivity_bench"))
    assert from_yaml(bench).blackbody is not None
    shared = ("v4l2:///dev/video2", "v4l2:///dev/video0")
    assert from_yaml(replaced(shared)).simulated
    assert_refused("Repeated address 'v4l2:///dev/video0'", from_yaml, replaced(shared, REAL))


def test_shared_rig_is_in_a_file_of_its_own(tmp_path: Path) -> None:
    """Shared keys come from the rig's file; a key in both files raises a ValueError."""
    lines, shared = ["name: plate", "rig: rig.yaml"], list[str]()
    for line in TEXT.splitlines():
        of_session = line.startswith(("simulated", "protocol", "duration", "blackbody", "sweep"))
        (lines if of_session else shared).append(line)
    shared.remove("name: plate")
    path, rig = tmp_path / "a.yaml", tmp_path / "rig.yaml"
    path.write_text("\n".join(lines), encoding="utf-8")
    rig.write_text("\n".join(shared), encoding="utf-8")
    assert Session.load(path) == from_yaml()
    wrong = [line.replace("telemetry_rows: 2", "telemetry_rows: 1") for line in shared]
    for lines, message in (
        (wrong, r"rig\.yaml: Invalid telemetry_rows 1\. Must be 0 or 2"),
        ([*shared, "duration: 3"], "Repeated key of session and rig 'duration'"),
    ):
        rig.write_text("\n".join(lines), encoding="utf-8")
        assert_refused(message, Session.load, path)
    rig.unlink()
    message = r"Missing file of key 'rig' of session '.*a\.yaml'.*: '.*rig\.yaml'$"
    assert_raises(FileNotFoundError, message, Session.load, path)
    for name in ("[1]", "null", '"a\\0b"', "5", "."):
        path.write_text(f"name: a\nrig: {name}\n", encoding="utf-8")
        assert_refused(r"Invalid (rig|file) .* Must be", Session.load, path)


@pytest.mark.parametrize("name", ["response", "emissivity_bench", "scene"])
def test_rig_of_the_project_has_one_switch(name: str) -> None:
    """All its sessions are emulated as they come, until the one file that they share says not."""
    path = paths.session(name)
    assert "simulated" not in path.read_text(encoding="utf-8")
    assert Session.load(path).simulated
    hardware = Session.load(path, {"simulated": False})
    assert hardware.cameras["8-14"].video == "v4l2:///dev/video0"


def test_described_session_is_valid() -> None:
    """The YAML of the module's docstring is a session, with settings that a wheel has."""
    assert description.__doc__ is not None
    (text,) = re.findall(r"::\n\n(.*?)\n\n\S", description.__doc__, re.DOTALL)
    session = from_yaml(textwrap.dedent(text))
    assert (session.swept, session.wheel.home_offset) == (("9.5", "11"), 12.5)


@pytest.mark.parametrize("content", [b"\xff\xfe", b"\x00", b"name: \xff", b"", b"[" * 10_000])
def test_files_that_are_no_session(content: bytes, tmp_path: Path) -> None:
    """Bytes that are no text and text that is no mapping end with status 1, not in a traceback."""
    path = tmp_path / "a.yaml"
    path.write_bytes(content)
    assert main(["record", str(path), str(tmp_path), "--dry-run"]) == 1
    assert main(["record", str(tmp_path), str(tmp_path), "--dry-run"]) == 1


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
        lines = yaml.safe_load(paths.session(name).read_text(encoding="utf-8"))
        contents.append({**rig, **lines} if lines.pop("rig", None) else lines)
    return contents


def places(content: Any) -> Iterator[tuple[Any, Any]]:
    """Yield each mapping or list, also those inside it, with each of its keys."""
    if isinstance(content, dict | list):
        for key, value in content.items() if isinstance(content, dict) else enumerate(content):
            yield content, key
            yield from places(value)


def mutant(rng: random.Random, original: dict[Any, Any]) -> dict[Any, Any]:
    """Content of a session of which one value is deleted, added or changed."""
    content = deepcopy(original)
    parent, key = rng.choice([*places(content)])
    deed = rng.choice(["delete", "value", "value", "other", "rename", "add"])
    if deed == "delete":
        del parent[key]
    elif deed == "value":
        parent[key] = rng.choice(VALUES)
    elif deed == "other":
        source, place = rng.choice([*places(original)])
        parent[key] = deepcopy(source[place])
    elif isinstance(parent, list):
        parent.append(rng.choice(VALUES))
    else:
        value = parent.pop(key) if deed == "rename" else rng.choice(VALUES)
        parent[rng.choice(NAMES)] = value
    return content


@pytest.mark.parametrize(
    ("number", "seed"),
    [
        (300, 300),
        pytest.param(1000, seed_of_week(), marks=pytest.mark.slow, id="of this week"),
        pytest.param(6000, seed_of_week(), marks=pytest.mark.long, id="long"),
    ],
)
def test_mutants_are_refused_in_words(number: int, seed: int) -> None:
    """Of mutated sessions most are refused, each by place, value and rule; others are meant."""
    print(f"DBTHERMAL_SEED={seed}")
    rng, originals, refused = random.Random(seed), sessions(), 0
    for _ in range(number):
        content = mutant(rng, rng.choice(originals))
        try:
            session = from_yaml(yaml.safe_dump(content, allow_unicode=True))
        except ValueError as error:
            lines = str(error).splitlines()
            refused += 1
            assert all("session.yaml" in line and "Must " in line for line in lines), lines
            assert max(map(len, lines)) < 400, lines
        else:
            assert 0 < session.duration <= 1e6, content
            assert all(2 <= size <= 8192 for size in session.shape), content
            hardware = [camera.video for camera in session.cameras.values()]
            assert all(url.startswith("v4l2:///dev/") for url in hardware), content
    assert refused > number * 2 / 3
