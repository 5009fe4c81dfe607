"""Programs in processes of their own, forked from one that has imported the package.

A process that imports it anew takes three to five seconds of the processor's time.
"""

import multiprocessing
import os
import pkgutil
import sys
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final

import dbthermal

CONTEXT: Final = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(
    [module.name for module in pkgutil.walk_packages(dbthermal.__path__, "dbthermal.")]
)
LONGEST: Final = 600.0  # life of a process, far beyond any load [s]


class Program:
    """A program, its text and its arguments, in a process of its own in a folder."""

    def __init__(self, folder: Path, *words: str) -> None:
        pipes = [CONTEXT.Pipe(duplex=False) for _ in range(3)]
        theirs = [pipes[0][0], pipes[1][1], pipes[2][1]]
        self._input, self._output, self._error = pipes[0][1], pipes[1][0], pipes[2][0]
        self._process = CONTEXT.Process(target=_run, args=(str(folder), theirs, words))
        self._process.start()
        for pipe in theirs:
            pipe.close()
        assert self._process.pid is not None
        self.pid: Final = self._process.pid

    def read_line(self) -> str:
        """Next line of its output."""
        with open(self._output.fileno(), closefd=False) as stream:
            return stream.readline()

    def end(self) -> tuple[int, str]:
        """Exit status of the program, which may wait for a line, and its errors."""
        with suppress(BrokenPipeError):
            os.write(self._input.fileno(), b"\n")
        self._process.join(LONGEST)
        status = self._process.exitcode
        assert status is not None, f"Still running after {LONGEST} s"
        with open(self._error.fileno(), closefd=False) as stream:
            error = stream.read()
        for resource in (self._input, self._output, self._error, self._process):
            resource.close()
        return status, error


def _run(folder: str, pipes: list[Connection], words: tuple[str, ...]) -> None:
    """Run a program in this process, as Python does with ``-c``."""
    for number, pipe in enumerate(pipes):
        os.dup2(pipe.fileno(), number)
    os.chdir(folder)
    sys.argv = ["-c", *words[1:]]
    with open(0, closefd=False) as sys.stdin:
        exec(words[0], {"__name__": "__main__"})
