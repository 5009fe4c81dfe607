"""Parameters of a notebook: those of its cell tagged `parameters`, and values that replace them.

Papermill injects whatever it gets, under any name. Here a value is refused unless the cell has its
name, and a default of its kind.
"""

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from dbthermal import readers
from reproduction import paths

INJECTED: Final = "# Parameters\n"
"""First line of the cell that papermill injects."""

_KINDS: Final[Mapping[type, str]] = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "text",
    list: "a list",
    dict: "a mapping",
}


def defaults(stem: str) -> dict[str, Any]:
    """Small values of a notebook, by name; ValueError unless it has one cell of parameters."""
    path = paths.notebook(stem)
    cells = [
        cell["source"]
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]
        if "parameters" in cell["metadata"].get("tags", ())
    ]
    if len(cells) != 1:
        raise ValueError(f"Invalid notebook '{path}'. Must have one cell tagged 'parameters'.")
    return _assigned("".join(cells[0]))


def read(stem: str, files: Iterable[Path], texts: Iterable[tuple[str, str]] = ()) -> dict[str, Any]:
    """Values for a notebook from YAML files, a later one over an earlier one, and from texts.

    The file in ``params/`` must have all of them. `texts` are pairs of name and text. Raises
    a ValueError that names file and parameter for what `check` refuses, for a file that
    `readers.read_yaml` refuses, as one with repeated keys, and for a name twice in `texts`.
    """
    small, values, named = defaults(stem), dict[str, Any](), dict[str, Any]()
    for path in files:
        content = readers.read_yaml(path)
        check(content, small, f"'{path}'")
        if path.absolute() == paths.params(stem) and (missing := small.keys() - content.keys()):
            rule = "Must have all values"
            raise ValueError(f"Missing parameter '{min(missing)}' in '{path}'. {rule}.")
        values |= content
    for name, text in texts:
        if name in named:
            raise ValueError(f"Repeated parameter '{name}' of '{stem}'. Must occur once.")
        named[name] = text
    check(named, small, f"the texts for '{stem}'")
    return values | named


def check(values: Mapping[str, Any], small: Mapping[str, Any], source: str) -> None:
    """Refuse values of other names or kinds than those of a notebook's cell; `source` has them.

    A number must be finite; a whole one must stay whole, and not be negative where the small one is
    not. In lists and mappings the kinds must agree too. A mapping with values of several kinds has
    fixed names, as `{"shape": [2, 3], "rate": 10.0}`; one of like things may have others.
    """
    for name, value in values.items():
        if name not in small:
            message = f"Unknown parameter '{name}' in {source}"
            raise ValueError(f"{message}. Must be one of {sorted(small)}.")
        place, default = f"parameter '{name}' in {source}", small[name]
        _check_kind(place, value, default, whole=type(default) is int)
        if type(default) is int and default >= 0 > value:
            raise ValueError(f"Invalid parameter '{name}' = {value} in {source}. Must be >= 0.")
        if isinstance(value, dict) and len(_kinds(default)) > 1 and value.keys() != default.keys():
            rule = f"Must have the names {[*default]}."
            raise ValueError(f"Invalid names {[*value]} of {place}. {rule}")


def injected(namespace: Mapping[str, Any]) -> dict[str, Any]:
    """Values that papermill put into a notebook's namespace, by its `globals()`."""
    cells = [cell for cell in namespace.get("In", ()) if cell.startswith(INJECTED)]
    return {name: namespace[name] for name in _assigned("\n".join(cells))}


def _assigned(cell: str) -> dict[str, Any]:
    """Names that a cell assigns, with their values; papermill writes ``float("nan")``."""
    values: dict[str, Any] = {}
    exec(cell, {"__builtins__": {"float": float}}, values)
    return values


def _check_kind(place: str, value: Any, default: Any, *, whole: bool = False) -> None:
    """Raise a ValueError if a value is of another kind than the known one, or not finite within."""
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"Invalid {place}: {value}. Must be finite.")
    kind = _kind(default, whole=whole)
    if default is not None and _kind(value, whole=whole) != kind:
        raise ValueError(f"Invalid {place}: {value!r}. Must be {kind}, as {default!r} is.")
    if isinstance(value, dict):
        for name, entry in value.items():
            _check_kind(f"'{name}' of {place}", entry, (default or {}).get(name))
    elif isinstance(value, list):
        example = default[0] if default and len(_kinds(default)) == 1 else None
        for number, entry in enumerate(value):
            _check_kind(f"entry {number} of {place}", entry, example)


def _kinds(default: Any) -> set[str]:
    """Kinds within a list or a mapping."""
    entries = default.values() if isinstance(default, dict) else default or ()
    return {_kind(entry) for entry in entries}


def _kind(value: Any, *, whole: bool = False) -> str:
    """Kind of a value, in words; beside others, in lists and mappings, a number is any."""
    return _KINDS.get(float if type(value) is int and not whole else type(value), "nothing")
