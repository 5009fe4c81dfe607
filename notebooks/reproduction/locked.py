"""Run make under the checkout's lock: one make at a time, for two would write the same files.

The Makefile runs this file by itself, before there is an environment, so it needs Python alone::

    GOALS="test reproduce" python3 -I notebooks/reproduction/locked.py make

The lock is one of the operating system on the file `LOCK`. All that make starts holds it too, the
notebooks' kernels among them, so that it is free when the last of them has ended, however it ended.
"""

import fcntl
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Final

LOCK: Final = ".make.lock"
"""File in the checkout that is locked; while it is, it says by whom."""

HELD: Final = "DBTHERMAL_LOCK"
"""Variable with the number of the open file that holds the lock."""

LOCKED: Final = "DBTHERMAL_LOCKED"
"""Variable with the folder that is locked, which tells the Makefile that it is."""

MIRROR: Final = "DBTHERMAL_DATA"
"""Variable that names the folder with a copy of the outside files."""

_PATIENCE: Final = 3.0  # the kernels of a make that was killed notice it within a second [s]
_POLL: Final = 0.2  # [s]


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


def main(make: str) -> int:
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
    # Inherited beside the lock: the pipe by which the makes share their jobs.
    process = subprocess.Popen(command, env=environment, close_fds=False)

    def forward(number: int, _: FrameType | None) -> None:
        if number != signal.SIGINT:  # a Ctrl-C reaches all of them by itself
            process.send_signal(number)

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, forward)
    end_with_parent(process.terminate)
    status = process.wait()
    return status if status >= 0 else 128 - status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
