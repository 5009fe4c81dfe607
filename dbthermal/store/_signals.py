"""Signals that end a program, raised as an error, so that a file or recording is ended first."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, Final

_STATUS: Final = 128  # exit status of a shell's program that a signal ended, less its number
_ENDING: Final = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]


class SignalExit(SystemExit):
    """End of the program by a signal, with the exit status of a shell: 128 and its number.

    Parameters
    ----------
    number : int
        Of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(_STATUS + number)
        self.status, self.name = _STATUS + number, signal.Signals(number).name


@contextmanager
def raised_signals() -> Iterator[None]:
    """Raise SIGTERM and SIGHUP as `SignalExit` in the main thread, while a block lasts.

    A closed terminal sends SIGHUP; ``kill``, a service manager and a shutdown send SIGTERM. The
    first signal is raised, those after it are ignored: what is being closed must be left to end. A
    signal that the program handles by itself or ignores, as under ``nohup``, stays so.
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
        # Only signals that would end the program, and only in the main thread, which gets them.
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
