"""Tasks of the Makefile, in a small checkout of its own: killed, two at a time, odd names."""

import fcntl
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import nbformat
import pytest
from marks import long, slow

from reproduction import locked

ROOT = Path(__file__).parents[2]
NOTEBOOK = """\
import os
import time
from pathlib import Path

from reproduction.run import Run

run = Run("01_tiny", globals())
with Path("../kernels").open("a") as file:
    file.write(f"{os.getpid()}\\n")
run.finish({"number": number})
while Path("../hold").exists():
    time.sleep(0.02)
"""
TARGET = "results/full/01_tiny.ipynb"


def script(path: Path, text: str) -> Path:
    """Make a program of the shell."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


def write_notebook(root: Path, stem: str, text: str) -> None:
    """Make a notebook of two cells, and its parameters."""
    small = nbformat.v4.new_code_cell('results = "smoke"\nnumber = 1')
    small.metadata["tags"] = ["parameters"]
    notebook = nbformat.v4.new_notebook(cells=[small, nbformat.v4.new_code_cell(text)])
    notebook.metadata.kernelspec = {"name": "python3", "language": "python", "display_name": ""}
    nbformat.write(notebook, root / f"notebooks/{stem}.ipynb")
    (root / f"params/{stem}.yaml").write_text("results: full\nnumber: 2\n")


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Checkout with one notebook, which waits while the file `hold` is there; its name is odd."""
    root = tmp_path / "it's $HOME; here"
    shutil.copytree(ROOT / "notebooks/reproduction", root / "notebooks/reproduction")
    shutil.copy(ROOT / "Makefile", root)
    for name in ("data_manifest.yaml", "pyproject.toml", "requirements.lock"):
        (root / name).touch()
    (root / "params/recorded").mkdir(parents=True)
    write_notebook(root, "01_tiny", NOTEBOOK)
    packages = f'PYTHONPATH="$PYTHONPATH:{ROOT}" exec {sys.executable} "$@"'
    script(root / ".venv/bin/python", packages)
    (root / ".venv/share/ipython").mkdir(parents=True)
    (root / ".venv/installed").touch()
    for name in (locked.HELD, locked.LOCKED, "MAKEFLAGS", "MFLAGS", "MAKELEVEL", "DBTHERMAL_DATA"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("PYTHON", sys.executable)
    monkeypatch.chdir(root)
    return root


def make(*goals: str) -> subprocess.CompletedProcess[str]:
    """Run make to its end."""
    return subprocess.run(["make", *goals], capture_output=True, text=True, check=False)


@pytest.fixture
def started() -> Iterator[Callable[..., subprocess.Popen[bytes]]]:
    """Starter of a make in a process group of its own, which is killed at the end.

    The signals of a keyboard and of a terminal reach it where the tests themselves, in the
    background of a shell, ignore them.
    """
    processes: list[subprocess.Popen[bytes]] = []

    def heard() -> None:
        for number in (signal.SIGINT, signal.SIGHUP):
            signal.signal(number, signal.SIG_DFL)

    def start(*goals: str) -> subprocess.Popen[bytes]:
        process = subprocess.Popen(["make", *goals], start_new_session=True, preexec_fn=heard)  # noqa: PLW1509
        processes.append(process)
        return process

    yield start
    for process in processes:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def wait_for(path: Path) -> None:
    """Wait until a file is there."""
    end = time.monotonic() + 600  # far beyond any load
    while not path.exists():
        assert time.monotonic() < end, path
        time.sleep(0.01)


def assert_goes_on(root: Path) -> None:
    """Make the notebook, and compare the numbers that it kept."""
    done = make(TARGET)
    assert done.returncode == 0, done.stderr
    kept = json.loads((root / "results/full/01_tiny.json").read_text())
    assert kept["numbers"] == {"number": 2}


Start = Callable[..., subprocess.Popen[bytes]]


def test_a_killed_notebook_runs_again(checkout: Path, started: Start) -> None:
    """Killed in a cell, the notebook has no name, its numbers are refused, and it runs anew."""
    (checkout / "hold").touch()
    process = started(TARGET)
    wait_for(checkout / "results/full/01_tiny.json")
    beside = make("check")  # any task
    assert beside.returncode == 2
    assert f"Another make is at work in '{checkout}': 'make {TARGET}', process" in beside.stderr
    os.killpg(process.pid, signal.SIGKILL)
    assert not (checkout / TARGET).exists()
    refused = make("verify")
    assert refused.returncode == 2
    assert "Unfinished notebook '01_tiny' of run 'full'" in refused.stderr
    (checkout / "hold").unlink()
    assert_goes_on(checkout)
    names = sorted(path.name for path in (checkout / "results/full").iterdir())
    assert names == [".01_tiny.sums", "01_tiny.ipynb", "01_tiny.json"]
    assert "up to date" in make(TARGET).stdout


SIGNALS = {name: getattr(signal, f"SIG{name}") for name in ("TERM", "INT", "HUP", "KILL")}


def wait_for_end(root: Path, process: "subprocess.Popen[bytes]", numbers: list[int]) -> None:
    """Wait until a make and all that it started are no more, and its lock is free."""
    process.wait(600)
    end = time.monotonic() + 600  # far beyond any load
    with (root / locked.LOCK).open() as file:
        while True:
            with suppress(BlockingIOError):
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if not {*numbers} & {*locked.descendants(0)}:
                    return
            assert time.monotonic() < end, numbers
            time.sleep(0.05)


MOMENTS = (".01_tiny.part.ipynb", "01_tiny.json")
VICTIMS = [(name, moment) for name in (*SIGNALS, "ctrl-c", "group") for moment in MOMENTS]
FOUR = [("TERM", MOMENTS[1]), ("ctrl-c", MOMENTS[0]), ("KILL", MOMENTS[0]), ("kernel", MOMENTS[1])]


@pytest.mark.parametrize(
    ("victim", "moment"), slow(*FOUR) + long(*(one for one in VICTIMS if one not in FOUR))
)
def test_whatever_is_killed(checkout: Path, started: Start, victim: str, moment: str) -> None:
    """Without make, the runner or the kernel nothing goes on, and the next make does all anew."""
    (checkout / "hold").touch()
    process = started(TARGET)
    wait_for(checkout / "results/full" / moment)
    running = locked.descendants(process.pid)
    assert len(running) >= 3
    if victim == "kernel":
        os.kill(int((checkout / "kernels").read_text()), signal.SIGKILL)
    elif victim in SIGNALS:
        process.send_signal(SIGNALS[victim])
    else:
        os.killpg(process.pid, signal.SIGINT if victim == "ctrl-c" else signal.SIGKILL)
    wait_for_end(checkout, process, running)
    assert process.returncode != 0
    (checkout / "hold").unlink()
    assert not (checkout / TARGET).exists()
    assert_goes_on(checkout)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(40))
def test_killed_at_any_moment(checkout: Path, started: Start, seed: int) -> None:
    """Ten random moments of each signal: all ends, and the next make goes on to the end."""
    rng, name = random.Random(seed), [*SIGNALS][seed % 4]
    process = started(TARGET)
    time.sleep(rng.uniform(0.0, 12.0))  # the whole takes some ten seconds
    running = locked.descendants(process.pid)
    process.send_signal(SIGNALS[name])
    wait_for_end(checkout, process, running)
    assert_goes_on(checkout)


MAKER = """\
import xarray as xr
from reproduction.run import Run

run = Run("01_calibration", globals())
run.save(xr.Dataset({"counts": ("time", range(50))}), "_response")
run.finish({"frames": 50})
"""
READER = """\
from reproduction.run import Run

run = Run("02_emissivity", globals())
read = run.open("01_calibration", "_response")
run.finish({"sum": int(read["counts"].sum())})
"""


@pytest.mark.slow
def test_what_is_spoilt_is_mended(checkout: Path) -> None:
    """A reader names the notebook of a spoilt input; the next make makes both, by itself."""
    (checkout / "notebooks/01_tiny.ipynb").unlink()
    for stem, text in (("01_calibration", MAKER), ("02_emissivity", READER)):
        write_notebook(checkout, stem, text)
    assert make("reproduce").returncode == 0
    folder = checkout / "results/full"
    (folder / "01_calibration_response.zarr/counts/c/0").write_bytes(b"spoilt")
    (folder / "02_emissivity.ipynb").unlink()
    failed = make("full")
    assert failed.returncode == 2
    assert "'make results/full/01_calibration.ipynb'" in failed.stderr + failed.stdout
    assert make("reproduce").returncode == 0
    path = folder / "02_emissivity.json"
    numbers = json.loads(path.read_text())["numbers"]
    path.unlink()
    mended = make("reproduce")
    assert mended.returncode == 0
    assert f"Missing file '{path}'. The notebook is run again." in mended.stderr
    assert json.loads(path.read_text())["numbers"] == numbers


def test_names_are_no_programs(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Names of files and folders, and values from outside, are never read by a shell."""
    odd = ["'; touch pwned; '", "$(touch pwned)", "`touch pwned`", "a;touch pwned", "a b\nc", "#%:"]
    for name in odd:
        for folder in ("data", "dbthermal", "notebooks/reproduction", "params/recorded"):
            (checkout / folder).mkdir(exist_ok=True)
            (checkout / folder / f"{name}.yaml").touch()
        (checkout / "notebooks" / f"02_{name}.ipynb").touch()
        mirror = checkout / "mirrors" / name
        mirror.mkdir(parents=True)
        monkeypatch.setenv("DBTHERMAL_DATA", str(mirror))
        done = make("results/inputs.txt")
        assert (done.returncode, done.stderr) == (0, "")
        assert (checkout / "results/inputs.txt").read_text().startswith(f"DBTHERMAL_DATA={mirror}")
        assert "up to date" in make("results/inputs.txt").stdout
        monkeypatch.setenv("PYTHON", f"./python {name.replace('/', '')}")
        assert "Invalid Python './python" in make("smoke").stderr
        monkeypatch.setenv("PYTHON", sys.executable)
    done = make("results/inputs.txt", "DBTHERMAL_DATA=mirrors")
    inputs = (checkout / "results/inputs.txt").read_text().splitlines()
    assert inputs[0] == f"DBTHERMAL_DATA={checkout}/mirrors"
    planned = make("--dry-run", "full", "smoke", "chain")
    assert planned.returncode == 0, planned.stderr
    assert "reproduction.execute full 01_tiny" in planned.stdout
    assert "02_" not in planned.stdout
    assert not list(checkout.rglob("pwned"))


def test_values_are_refused(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A value that make cannot use is refused before anything runs."""
    values = [("JOBS", "2; touch pwned"), ("JOBS", "0"), ("DBTHERMAL_DATA", "$(touch pwned)")]
    for name, value in values:
        with monkeypatch.context() as patch:
            patch.setenv(name, value)
            done = make("results/inputs.txt")
        assert done.returncode == 2
        assert f"Invalid {name} '{value}'. Must" in done.stderr
    assert not list(checkout.rglob("pwned"))
    assert not (checkout / "results").exists()


@pytest.fixture
def python(checkout: Path) -> str:
    """Setting of a Python that makes environments whose pip does what the file `pip` says."""
    pip = 'if test "$2" = pip; then echo "$@" >> calls; . ./pip; fi'
    venv = f"mkdir -p .venv/bin; printf '#!/bin/sh\\n%s\\n' '{pip}' > .venv/bin/python"
    script(
        checkout / "fake python",
        f'if test "$2" = venv; then {venv}; chmod +x .venv/bin/python\n'
        f'else exec {sys.executable} "$@"; fi',
    )
    return "PYTHON=./fake python"


def state(root: Path) -> dict[str, int]:
    """Files of the environment but that of the fake pip, with their times [ns]."""
    every = (one for one in root.glob(".venv/**/*") if one.name not in {"bin", "python", "lib"})
    return {one.name: one.stat().st_mtime_ns for one in every if one.is_file()}


def test_an_update_that_fails_leaves_the_environment(checkout: Path, python: str) -> None:
    """Without a network an older environment stays whole, however often it is tried."""
    script(checkout / ".venv/lib/package", "")
    os.utime(checkout / ".venv/installed", (1e9, 1e9))
    before = state(checkout)
    for pip in ("exit 1", "mkdir -p .venv/lib && exit 2"):
        (checkout / "pip").write_text(pip)
        failed = make("check", python)
        assert failed.returncode == 2
        assert ".venv is not up to date, and as it was" in failed.stderr
        assert state(checkout) == before
    (checkout / "pip").write_text("exit 0")
    assert make("install", python).returncode == 0
    assert state(checkout).keys() == before.keys()
    assert state(checkout)["installed"] > before["installed"]
    assert "is up to date" not in make("install", python).stderr


def test_an_interrupted_install_is_done_anew(checkout: Path, python: str, started: Start) -> None:
    """What a killed pip left is put aside until a new environment is whole, then it goes."""
    (checkout / "pip").write_text("mkdir -p .venv/lib/half; touch .venv/lib/half/file; sleep 60")
    os.utime(checkout / ".venv/installed", (1e9, 1e9))
    process = started("install", python)
    wait_for(checkout / ".venv/lib/half/file")
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert state(checkout).keys() == {"installing", "file"}
    for _ in range(2):  # without a network
        (checkout / "pip").write_text("exit 1")
        assert make("install", python).returncode == 2
        assert state(checkout).keys() == {"installing", "file"}
    (checkout / "pip").write_text("exit 0")
    (checkout / "calls").unlink()
    done = make("install", python)
    assert done.returncode == 0, done.stderr
    assert state(checkout).keys() == {"installed"}
    assert not (checkout / ".venv-interrupted").exists()
    assert len((checkout / "calls").read_text().splitlines()) == 2  # pip itself, then the packages


@pytest.mark.parametrize(("pip", "installed"), [("exit 0", 1), ("exit 1", 1), ("kill $PPID", 0)])
def test_the_site_s_packages_come_beside(checkout: Path, pip: str, installed: int) -> None:
    """Added to the environment, they make nothing out of date; a failure leaves it as it was."""
    script(checkout / ".venv/bin/python", pip)
    os.utime(checkout / ".venv/installed", (2e9, 2e9))
    done = make(".venv/documenting")
    assert (done.returncode == 0) == (pip == "exit 0")
    assert (checkout / ".venv/documenting").exists() == (pip == "exit 0")
    assert [path.stat().st_mtime for path in checkout.glob(".venv/installed")] == [2e9] * installed
    assert (checkout / ".venv/installing").exists() == (not installed)
