"""Compilation of loops that as passes over arrays would take several times as long."""

from collections.abc import Callable
from contextlib import suppress
from typing import Any

from numba import njit


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function at its first call; where a folder may be written it is kept there.

    Sums may be taken in any order; NaN stays NaN. It must not call compiled functions of
    other files, of which a change would not be seen.
    """
    flags = {"reassoc", "contract", "nsz", "arcp"}
    result = njit(nogil=True, error_model="numpy", fastmath=flags)(function)
    with suppress(RuntimeError):  # without such a folder each process compiles
        result.enable_caching()
    return result
