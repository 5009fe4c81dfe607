"""Moments of a recording: something is done just before the n-th file operation of the process."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache

OPERATIONS = frozenset({"open", "os.rename", "os.mkdir", "os.remove", "os.scandir", "os.rmdir"})
"""Events of Python's audit that touch a file system; a sync comes after an ``open``."""


@dataclass
class _Hook:
    """The process's one audit hook, which cannot be taken off."""

    count: int = 0
    moment: int = -1
    act: Callable[[], object] = lambda: None

    def __call__(self, event: str, _: object) -> None:
        """Count the operation, and act before the chosen one."""
        if self.moment < 0 or event not in OPERATIONS:
            return
        self.count += 1
        if self.count == self.moment:
            self.moment = -1  # what is done now is not counted
            self.act()


@cache
def _hook() -> _Hook:
    sys.addaudithook(hook := _Hook())
    return hook


@contextmanager
def before_operation(number: int, act: Callable[[], object]) -> Iterator[None]:
    """Do something before the n-th file operation from now on, counted from 1."""
    hook = _hook()
    hook.count, hook.moment, hook.act = 0, number, act
    try:
        yield
    finally:
        hook.moment = -1


def operations_of(work: Callable[[], object]) -> int:
    """Number of file operations of a piece of work."""
    with before_operation(sys.maxsize, lambda: None):
        work()
    return _hook().count
