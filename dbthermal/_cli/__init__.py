"""Subcommands of the command line, thin calls of the library, and the line that says their stage.

See `dbthermal.__main__`.
"""

import sys
import threading
import time
from argparse import Namespace
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from inspect import signature
from pathlib import Path
from typing import Any, Final

PLUS: Final = Path("+")  # between the files of two cameras
_QUIET, _STEP = 1.5, 0.5  # without a word, and between two looks [s]
_STAGES: Final = {
    "numba.core": "compiling, once after an installation for about a minute",
    "dbthermal.separation._completion": "completing",
    "dbthermal.separation._pooling": "grouping pixels by material",
    "dbthermal.separation": "separating",
    "dbthermal.alignment": "aligning",
    "dbthermal.correction": "correcting",
    "dbthermal.readers": "reading",
    "dbthermal.store": "reading or writing",
    "dbthermal.figures": "drawing",
}
"""Modules -> what is done in them; the innermost of a thread counts."""


def leaves(value: Any) -> Iterator[Any]:
    """Yield the values of an argument, whose lists may hold lists."""
    for entry in value if isinstance(value, list) else [value]:
        yield from leaves(entry) if isinstance(entry, list) else [entry]


def is_source(name: str, value: Any) -> bool:
    """Tell whether a value of an argument is a path that is read."""
    return isinstance(value, Path) and value != PLUS and not name.endswith(("output", "folder"))


def accepted(function: Callable[..., Any], options: Namespace) -> dict[str, Any]:
    """Options that a function takes by name; paths, which are opened first, are not among them."""
    names = signature(function).parameters
    return {
        name: value
        for name, value in vars(options).items()
        if name in names and value is not None and not isinstance(value, Path)
    }


class _Stream:
    """Stream that notes when something was written."""

    def __init__(self, stream: Any) -> None:
        self.stream, self.last = stream, time.monotonic()

    def write(self, text: str) -> Any:
        """Write a text."""
        self.last = time.monotonic()
        return self.stream.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


@contextmanager
def stage_shown(command: str) -> Iterator[None]:
    """Show the stage of this thread on the terminal, and at the end the seconds that it took."""
    thread, start, ended, plain = (
        threading.get_ident(),
        time.monotonic(),
        threading.Event(),
        sys.stderr,
    )
    stream: Any = _Stream(plain)

    def show() -> None:
        while not ended.wait(_STEP):
            if time.monotonic() - stream.last > _QUIET:
                seconds = time.monotonic() - start
                plain.write(f"\r{command}: {_stage(thread)}, {seconds:.0f} s\x1b[K")
                plain.flush()

    showing = threading.Thread(target=show, daemon=True)
    if is_terminal := plain.isatty():
        sys.stderr = stream
        showing.start()
    try:
        yield
        seconds = time.monotonic() - start
    finally:
        ended.set()
        if is_terminal:
            showing.join()
            sys.stderr = plain
            plain.write("\r\x1b[K")
    plain.write(f"{command}: {seconds:.1f} s\n")


def _stage(thread: int) -> str:
    """What a thread does, by the modules of its calls."""
    frame = sys._current_frames().get(thread)
    while frame is not None:
        module = str(frame.f_globals.get("__name__"))
        for name, stage in _STAGES.items():
            if module.startswith(name):
                return stage
        frame = frame.f_back
    return "working"
