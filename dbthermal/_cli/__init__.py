"""Subcommands of the command line, thin calls of the library; see `dbthermal.__main__`."""

from argparse import Namespace
from collections.abc import Callable, Iterator
from inspect import signature
from pathlib import Path
from typing import Any, Final

PLUS: Final = Path("+")  # between the files of two cameras


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
