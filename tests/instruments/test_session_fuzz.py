"""Sessions of which one thing is wrong: each is meaningful, or refused in a line that says why."""

import random
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import yaml
from rig_session import TEXT, from_yaml, replaced

from dbthermal.__main__ import main
from dbthermal.instruments.session import Session
from reproduction import paths

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


def check(number: int) -> int:
    """Count the refused among so many mutants, all of which are refused in words, not wrecked."""
    rng, originals, refused = random.Random(number), sessions(), 0
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


def test_mutants_are_refused_in_words() -> None:
    """Of 300 mutated sessions most are refused, each by place, value and rule."""
    assert check(300) > 200


@pytest.mark.slow
def test_many_mutants_are_refused_in_words() -> None:
    """The same of 6,000."""
    print("refused of 6000:", refused := check(6000))
    assert refused > 4000


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
