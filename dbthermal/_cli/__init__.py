"""Subcommands of the command line, thin calls of the library; see `dbthermal.__main__`."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

PLUS: Final = Path("+")  # between the files of two cameras


def leaves(value: Any) -> Iterator[Any]:
    """Yield the values of an argument, whose lists may hold lists."""
    for entry in value if isinstance(value, list) else [value]:
        yield from leaves(entry) if isinstance(entry, list) else [entry]


def is_source(name: str, value: Any) -> bool:
    """Tell whether a value of an argument is a path that is read."""
    return isinstance(value, Path) and value != PLUS and not name.endswith("output")
