"""Commands that are killed, signalled, or started twice: one whole output, nothing beside it."""

import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile
from captures import RIG, people
from hostile_files import seed_of_week
from marks import slow

from dbthermal import store

COMMANDS = {
    "import": "import a.tif b.tif --bands wide narrow --unit count --clock 10 --offset 0 -o x.zarr",
    "correct": "correct raw.zarr --corrected-by-camera -o x.zarr",
    "align": "align scene.zarr --register none --offset 0 -o x.zarr",
    "separate": "separate scene.zarr response.zarr -o x.zarr",
    "run": "separate scene.zarr response.zarr --method subspace -o x.zarr",
    "export": "export result.zarr -o x.csv",
    "report": "report result.zarr -o x.html",
}
# Before the n-th file operation at the output something is done: a kill, a signal, or a wait; of
# place 0 their number is printed in the end.
HOOK = """
import atexit, itertools, os, re, signal, sys
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # which nohup ignores
place, act, number = sys.argv[1], sys.argv[2], itertools.count(1)
operations = {"open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.link", "os.truncate"}
def hook(event, arguments):
    if event in operations and re.search(r"(^|/)\\.?x\\.(zarr|csv|html)", str(arguments[0])):
        if next(number) == int(place):
            if act == "wait":
                print("waiting", flush=True)
                sys.stdin.readline()
            else:
                os.kill(os.getpid(), int(act))
sys.addaudithook(hook)
if place == "0":
    atexit.register(lambda: print("operations:", next(number), file=sys.stderr))
from dbthermal.__main__ import main
sys.exit(main(sys.argv[3:]))
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files and stores of bands that no library knows."""
    folder, (_, capture) = tmp_path_factory.mktemp("user"), people(1, 64, (8, 12))
    capture = capture.assign_coords(band=["wide", "narrow"])
    store.save(capture, folder / "scene.zarr", {})
    raw = capture[["counts"]].round().astype("uint16", keep_attrs=True)
    store.save(raw, folder / "raw.zarr", {})
    store.save(RIG.response().assign_coords(band=["wide", "narrow"]), folder / "response.zarr", {})
    for name, counts in zip("ab", capture["counts"].values, strict=True):
        tifffile.imwrite(folder / f"{name}.tif", counts.astype("uint16"), photometric="minisblack")
    status, error = end(start(folder, "separate", output="result.zarr"))
    assert status == 0, error
    assert "no library has emissivities of the bands ['wide', 'narrow']" in error
    return folder


def start(
    folder: Path, command: str, place: int = -1, act: str = "-", output: str = ""
) -> subprocess.Popen[str]:
    """Command in a process of its own, which acts at a file operation of its output."""
    words = COMMANDS[command].split()
    words[-1] = output or words[-1]
    return started(folder, HOOK, str(place), act, *words, "--overwrite")


def started(folder: Path, *words: str) -> subprocess.Popen[str]:
    """Program in a process of its own."""
    command, pipe = [sys.executable, "-c", *words], subprocess.PIPE
    return subprocess.Popen(command, cwd=folder, text=True, stdin=pipe, stdout=pipe, stderr=pipe)


def end(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Exit status of a process, and its errors."""
    _, error = process.communicate("\n", timeout=600)
    return process.returncode, error


def beside(folder: Path) -> list[str]:
    """Names of outputs, whole or not."""
    return sorted(path.name for path in folder.iterdir() if "x." in path.name)


def clean(folder: Path) -> None:
    """Remove outputs."""
    for path in folder.glob("x.*"):
        path.rename(folder / f"old-{len([*folder.iterdir()])}")


QUICK = ["import", "export"]
SLOW = slow(*(name for name in COMMANDS if name not in QUICK))


@pytest.mark.parametrize("command", [*QUICK, *SLOW])
def test_killed_and_started_again(folder: Path, command: str) -> None:
    """Killed at any file operation of its output, a command needs no hand: it is started again.

    Of all operations the first, the last and some others are tried, which differ every week.
    """
    output = COMMANDS[command].split()[-1]
    status, error = end(start(folder, command, 0))
    assert status == 0, error
    last = int(error.rpartition("operations: ")[2]) - 1
    clean(folder)
    others = np.random.default_rng(seed_of_week()).integers(2, last, 3 if command in QUICK else 8)
    for place in (1, *others.tolist(), last):
        status, error = end(start(folder, command, place, "9"))
        assert status in {-9, 0}, error  # by chance of threads one operation may be missing
        status, error = end(start(folder, command))
        assert status == 0, error
        assert beside(folder) == [output], place
        if output.endswith(".zarr"):
            store.open_dataset(folder / output).load()
        clean(folder)


@pytest.mark.parametrize("command", [*QUICK, *SLOW])
def test_signals_leave_nothing(folder: Path, command: str) -> None:
    """By SIGTERM and SIGHUP a command ends with their status, and with no draft of an output."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        status, error = end(start(folder, command, 6, str(int(number))))
        assert status == 128 + number, error
        # The parts of a run stay; or its thread has just joined them.
        assert {*beside(folder)} <= ({"x.zarr.parts", "x.zarr"} if command == "run" else set())
        clean(folder)


@pytest.mark.parametrize(
    ("command", "second"), [("import", "import"), ("run", "run"), *slow(("run", "correct"))]
)
def test_two_commands_at_one_output(folder: Path, command: str, second: str) -> None:
    """The second is told the process of the first, which ends well."""
    process = start(folder, command, 5, "wait")
    assert process.stdout is not None
    assert process.stdout.readline() == "waiting\n"
    status, error = end(start(folder, second))
    assert status == 1
    assert f"Busy output '{folder / 'x.zarr'}': process {process.pid} on " in error
    assert end(process)[0] == 0
    assert beside(folder) == ["x.zarr"]
    store.open_dataset(folder / "x.zarr").load()
    clean(folder)


RECORDING = """
import sys
import numpy as np
from dbthermal import schema, store
options = {"sizes": {"y": 3, "x": 4}, "bands": ["a"], "chunk": 2, "attrs": {}}
recording = store.Recording("x.zarr", {"counts": schema.STAGES["capture"]["counts"]}, **options)
print("waiting", flush=True)
sys.stdin.readline()
recording.append("a", {"counts": np.ones((2, 3, 4), "u2")})
recording.commit()
recording.close(time=np.arange(2.0))
"""


def test_two_processes_at_one_recording(folder: Path) -> None:
    """Neither a second recording nor an output replaces one that grows; both say why."""
    first = started(folder, RECORDING)
    assert first.stdout is not None
    assert first.stdout.readline() == "waiting\n"
    for second in (started(folder, RECORDING), start(folder, "correct")):
        status, error = end(second)
        assert status == 1
        assert "Busy output 'x.zarr': a recording writes to it. Must end first" in error
    assert end(first) == (0, "")
    assert store.open_dataset(folder / "x.zarr").sizes["time"] == 2
    assert beside(folder) == ["x.zarr"]
    clean(folder)


def test_control_characters_are_shown(folder: Path) -> None:
    """Names with an escape, a line end or a reversed order of letters do not reach the terminal."""
    name = "c\x1b[31m\n\u202e.tif"
    (folder / name).write_bytes((folder / "a.tif").read_bytes())
    command = [sys.executable, "-m", "dbthermal", "info", name, "--unit", "count", "--clock", "10"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    assert r"c\x1b[31m\n\u202e.tif:" in done.stdout
    assert not {"\x1b", "\u202e"} & {*done.stdout, *done.stderr}


def test_too_little_memory_and_dry_runs(folder: Path) -> None:
    """Out of memory the output is named, with what it needs; before it is, bytes are told."""
    code = """
import sys
from dbthermal import readers
from dbthermal.__main__ import main
def two_bands(*_, **__):
    raise MemoryError("Unable to allocate 1 TB")
readers.two_bands = two_bands if sys.argv[1] == "short" else readers.two_bands
sys.exit(main(sys.argv[2:]))
"""
    words = COMMANDS["import"].split()
    status, error = end(started(folder, code, "short", *words))
    assert status == 1
    assert "Out of memory, 'x.zarr' is not written: Unable to allocate 1 TB. Must" in error
    dry = started(folder, code, "dry", *words, "--dry-run", "--json")
    planned = json.loads(dry.communicate()[0])
    assert dry.returncode == 0
    assert 2 * 64 * 8 * 12 * 2 <= planned["would_write_bytes_at_most"] < 30_000
    assert planned["free_bytes"] > 0
    assert beside(folder) == []


def test_signals_end_the_session(tmp_path: Path) -> None:
    """A test that takes the interrupt for its own is the last one."""
    conftest = (Path(__file__).parent / "conftest.py").read_text(encoding="utf-8")
    start = conftest.index("def pytest_sessionstart")
    hook = conftest[start : conftest.index("\n\n\n", start)]
    head = "import signal, threading, pytest\nfrom types import FrameType\n"
    (tmp_path / "conftest.py").write_text(head + hook)
    (tmp_path / "test_a.py").write_text("""
import os, signal
def test_first():
    try:
        os.kill(os.getpid(), signal.SIGTERM)
    except KeyboardInterrupt:
        pass
def test_second():
    pass
""")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "."]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "ended by SIGTERM" in done.stdout
    assert "1 passed" in done.stdout
