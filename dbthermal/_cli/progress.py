"""Line on a terminal that says what a command is doing, while nothing else is written."""

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

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
def shown(command: str) -> Iterator[None]:
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
