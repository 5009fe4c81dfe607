"""Run make under the checkout's lock: one make at a time, for two would write the same files.

The Makefile runs this file by itself, before there is an environment, so it needs Python alone::

    GOALS="test reproduce" python3 -I notebooks/reproduction/locked.py make $$

The number is that of the outer make, or of another process that this one is to end with.

The lock is one of the operating system on the file `LOCK`. All that make starts holds it too, the
notebooks' kernels among them, so that it is free when the last of them has ended, however it ended.

This process ends all that make started, kernels and their workers too: at a signal, when the outer
make has one, or is no more, and when the inner make has ended. What does not end by itself in
`_GRACE` is killed. Without /proc (macOS) a signal must reach this process, as a Ctrl-C does.
"""

import ctypes
import fcntl
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Final

LOCK: Final = ".make.lock"  # file in the checkout that is locked; while it is, it says by whom

HELD: Final = "DBTHERMAL_LOCK"  # variable with the number of the open file that holds the lock

LOCKED: Final = "DBTHERMAL_LOCKED"
"""Variable with the folder that is locked, which tells the Makefile that it is."""

MIRROR: Final = "DBTHERMAL_DATA"  # variable that names the folder with a copy of the outside files

_PATIENCE: Final = 3.0  # the kernels of a make that was killed notice it within a second [s]
_POLL: Final = 0.2  # [s]
_GRACE: Final = 1.2  # [s]
_CHILD_SUBREAPER, _DEATH_SIGNAL = 36, 1  # of Linux's prctl


def lock(folder: Path, task: str) -> int:
    """Open file, by its number, that holds the lock of a folder; RuntimeError if another has it."""
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW
    file, end = os.open(folder / LOCK, flags, 0o666), time.monotonic() + _PATIENCE
    while not _locked(file):
        if time.monotonic() > end:
            holder = os.read(file, 1000).decode("utf-8", "replace").strip()
            os.close(file)
            raise RuntimeError(
                f"Another make is at work in '{folder}': {holder}. Only one may run at a time in a "
                "checkout: wait for it, or end it and the programs that it started."
            )
        time.sleep(_POLL)
    os.ftruncate(file, 0)
    since = time.strftime("%Y-%m-%d %H:%M:%S")
    os.write(file, f"'{task}', process {os.getpid()}, since {since}\n".encode())
    os.set_inheritable(file, True)
    return file


def _locked(file: int) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        rule = "Must be on a file system with locks."
        raise RuntimeError(f"No lock on '{LOCK}': {error}. {rule}") from error
    return True


def end_with_parent(end: Callable[[], object]) -> None:
    """Call `end` in a thread when the parent of this process is no more, as after kill -9."""
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_POLL)
        end()

    threading.Thread(target=watch, daemon=True).start()


def settings() -> dict[str, str]:
    """Environment for make: JOBS, and DBTHERMAL_DATA as an absolute path, both checked."""
    if not re.fullmatch("[1-9][0-9]{0,3}", jobs := os.environ.get("JOBS", "1")):
        raise ValueError(f"Invalid JOBS {jobs!r}. Must be a whole number of 1 or more.")
    if os.pathsep in (folder := str(Path.cwd())):
        rule = f"Must hold no '{os.pathsep}', which ends a path in PYTHONPATH."
        raise ValueError(f"Invalid folder {folder!r} of the checkout. {rule}")
    copies = str(mirror() or "")
    # The second name is for the Makefile: what was said to make itself goes over the environment.
    return {**os.environ, MIRROR: copies, "DBTHERMAL_MIRROR": copies}


def mirror() -> Path | None:
    """Folder that DBTHERMAL_DATA names, None if it is unset or empty."""
    if not (folder := os.environ.get(MIRROR, "").strip()):
        return None
    if not Path(folder).is_dir():
        raise ValueError(f"Invalid {MIRROR} {folder!r}. Must name a folder.")
    return Path(folder).absolute()


def descendants(of: int) -> list[int]:
    """Process numbers of all that a process started, and of what that started, but of the dead."""
    parents = {number: parent for number, parent, dead in _processes() if not dead}
    family = {of}
    while more := {number for number, parent in parents.items() if parent in family} - family:
        family |= more
    return sorted(family - {of})


def _processes() -> Iterable[tuple[int, int, bool]]:
    """Number and parent of every process, and whether it is dead and only to be reaped."""
    if Path("/proc/self/stat").exists():
        for path in Path("/proc").glob("[0-9]*/stat"):
            with suppress(OSError):  # ended since
                state, parent = path.read_text(errors="replace").rpartition(")")[2].split()[:2]
                yield int(path.parent.name), int(parent), state == "Z"
        return
    command = ["ps", "-A", "-o", "pid=,ppid=,stat="]
    done = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    for line in done.communicate()[0].splitlines():
        number, parent, state = line.split()
        if int(number) != done.pid:
            yield int(number), int(parent), state.startswith("Z")


def end_descendants() -> None:
    """End all that this process started: by SIGTERM, and after `_GRACE` by SIGKILL."""
    start = time.monotonic()
    asked, foreign = set[int](), set[int]()  # foreign: of another user
    while living := {*descendants(os.getpid())} - foreign:
        killed = time.monotonic() > start + _GRACE
        for number in living if killed else living - asked:
            with suppress(ProcessLookupError):
                try:
                    os.kill(number, signal.SIGKILL if killed else signal.SIGTERM)
                except PermissionError:
                    foreign.add(number)
        asked.update(living)
        time.sleep(0.02)


def _wait_for_end(make: int) -> None:
    """Wait until the outer make is no more, or has a signal and waits for this process to end.

    At SIGTERM it ends its children. At SIGINT or SIGHUP it waits for them, and does not catch that
    signal any more.
    """
    parent, caught = os.getppid(), _caught(make)
    if os.getpid() in descendants(make):
        while os.getppid() == parent and not caught & ~_caught(make):
            time.sleep(_POLL)


def _caught(process: int) -> int:
    """Bits of SIGINT and SIGHUP if a process catches them; 0 where the system does not tell."""
    bits = 1 << signal.SIGINT - 1 | 1 << signal.SIGHUP - 1
    with suppress(OSError):
        text = Path(f"/proc/{process}/status").read_text()
        if line := re.search(r"^SigCgt:\s*([0-9a-f]+)$", text, re.MULTILINE):
            return int(line[1], 16) & bits
    return 0


def _prctl(option: int, value: int) -> None:
    """Set an option of this process; elsewhere than on Linux there is none."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(option, value, 0, 0, 0)


def main(make: str, outer: int) -> int:
    """Run make for the tasks in the variable GOALS; its exit status, 1 if it may not run."""
    goals, folder = os.environ["GOALS"].split(), Path.cwd()
    try:
        environment = settings()
        file = lock(folder, " ".join(["make", *goals]))
    except (OSError, RuntimeError, ValueError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    environment |= {LOCKED: str(folder), HELD: str(file)}
    command = [make, "--no-print-directory", *goals]

    def end(number: int, _: FrameType | None) -> None:
        for caught in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(caught, signal.SIG_IGN)
        end_descendants()
        os._exit(128 + number)

    def watch() -> None:
        _wait_for_end(outer)
        os.kill(os.getpid(), signal.SIGTERM)

    _prctl(_CHILD_SUBREAPER, 1)  # what loses its parent becomes a child of this process
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number == signal.SIGTERM or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, end)
    # Inherited beside the lock: the pipe by which the makes share their jobs. Should this process
    # be killed, make gets a SIGTERM.
    first = partial(_prctl, _DEATH_SIGNAL, signal.SIGTERM)  # before there is a thread
    process = subprocess.Popen(command, env=environment, close_fds=False, preexec_fn=first)  # noqa: PLW1509
    threading.Thread(target=watch, daemon=True).start()
    status = process.wait()
    end_descendants()
    return status if status >= 0 else 128 - status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], int(sys.argv[2])))
