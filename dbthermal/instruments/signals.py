"""Signals that end a program, SIGTERM and SIGHUP, as exceptions: what is open is closed.

A terminal that is closed sends SIGHUP; ``kill``, a service manager and a shutdown send SIGTERM.
Both end a Python program at once, unless they are raised, as an interrupt by the keyboard is.
"""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, Final

__all__ = ["SignalExit", "raised_signals"]
__dir__ = __all__.copy

_ENDING: Final = tuple(
    number for name in ("SIGTERM", "SIGHUP") if (number := getattr(signal, name, None)) is not None
)
_STATUS: Final = 128  # exit status of a shell's program that a signal ended, less its number


class SignalExit(SystemExit):
    """End of the program by a signal, with the exit status of a shell: 128 and its number."""

    def __init__(self, number: int) -> None:
        super().__init__(_STATUS + number)
        self.status, self.name = _STATUS + number, signal.Signals(number).name


@contextmanager
def raised_signals() -> Iterator[None]:
    """Raise SIGTERM and SIGHUP as `SignalExit` in the main thread, while a block lasts.

    The first one is raised, those after it are passed over: a closed terminal sends several, and
    what is being closed must be left to end. Nothing changes for a signal that the program handles
    by itself or ignores, as under ``nohup``.
    """
    previous: dict[int, Any] = {}
    raised: list[int] = []
    late: list[int] = []  # came while the handlers were put back
    closing = False

    def end(number: int, _: FrameType | None) -> None:
        if closing:
            late.append(number)
        elif not raised:
            raised.append(number)
            raise SignalExit(number)

    try:
        if threading.current_thread() is threading.main_thread():
            for number in _ENDING:
                if signal.getsignal(number) is signal.SIG_DFL:
                    previous[number] = signal.signal(number, end)
        yield
    finally:
        closing = True
        for number, handler in previous.items():
            signal.signal(number, handler)
        if not raised:
            for number in late:
                signal.raise_signal(number)
