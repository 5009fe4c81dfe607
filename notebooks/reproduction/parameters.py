"""Parameters of a notebook: those of its cell tagged `parameters`, and values that replace them.

Papermill injects whatever it gets, under any name. Here a value is refused unless the cell has its
name, and a default of its kind.
"""

import ast
import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from dbthermal import readers
from reproduction import paths

INJECTED: Final = "# Parameters\n"
"""First line of the cell that papermill injects."""

_KINDS: Final = {
    "true or false": bool,
    "a whole number": int,
    "a number": int | float,
    "text": str,
    "a list": list,
    "a mapping": dict,
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
    values: dict[str, Any] = {}
    exec("".join(cells[0]), {"__builtins__": {}}, values)
    return values


def read(stem: str, files: Iterable[Path], texts: Iterable[tuple[str, str]] = ()) -> dict[str, Any]:
    """
    Values for a notebook from YAML files, a later one over an earlier one, and from texts.

    The file in ``params/`` must have all of them. `texts` are pairs of name and text. Raises
    a ValueError that names file and parameter for what `check` refuses, for a file that
    `readers.read_yaml` refuses, as one with repeated keys, and for a name twice in `texts`.
    """
    small, values, named = defaults(stem), dict[str, Any](), dict[str, Any]()
    for path in files:
        content = readers.read_yaml(path)
        check(content, small, f"'{path}'")
        if path.absolute() == paths.params(stem) and (missing := small.keys() - content.keys()):
            raise ValueError(
                f"Missing parameter '{min(missing)}' in '{path}'. Must have all values."
            )
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
            raise ValueError(
                f"Unknown parameter '{name}' in {source}. Must be one of {sorted(small)}."
            )
        _check_kind(f"parameter '{name}' in {source}", value, small[name])
        if (
            isinstance(value, dict)
            and _is_record(small[name])
            and value.keys() != small[name].keys()
        ):
            rule = f"Must have the names {[*small[name]]}."
            raise ValueError(f"Invalid names {[*value]} of parameter '{name}' in {source}. {rule}")
        if type(small[name]) is int and small[name] >= 0 and value < 0:
            raise ValueError(f"Invalid parameter '{name}' = {value} in {source}. Must be >= 0.")


def injected(namespace: Mapping[str, Any]) -> dict[str, Any]:
    """Values that papermill put into a notebook's namespace, by its `globals()`."""
    cells = [cell for cell in namespace.get("In", ()) if cell.startswith(INJECTED)]
    lines = [line for cell in cells for line in ast.parse(cell).body]
    targets = [target for line in lines if isinstance(line, ast.Assign) for target in line.targets]
    return {name.id: namespace[name.id] for name in targets if isinstance(name, ast.Name)}


def _check_kind(place: str, value: Any, small: Any, *, whole: bool = True) -> None:
    """Raise a ValueError if a value is of another kind than a small one, or not finite within."""
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"Invalid {place}: {value}. Must be finite.")
    if small is not None:
        kind = _kind(small, whole=whole)
        is_bool = isinstance(value, bool)
        if not isinstance(value, _KINDS[kind]) or is_bool != (kind == "true or false"):
            raise ValueError(f"Invalid {place}: {value!r}. Must be {kind}, as {small!r} is.")
    if isinstance(value, dict):
        for name, part in value.items():
            known = small.get(name) if isinstance(small, dict) else None
            _check_kind(f"'{name}' of {place}", part, known, whole=False)
    elif isinstance(value, list):
        parts = small if isinstance(small, list) else []
        one = parts[0] if len({_kind(part, whole=False) for part in parts}) == 1 else None
        for number, part in enumerate(value):
            _check_kind(f"entry {number} of {place}", part, one, whole=False)


def _is_record(small: Mapping[str, Any]) -> bool:
    return len({_kind(value, whole=False) for value in small.values()}) > 1


def _kind(value: Any, *, whole: bool) -> str:
    """Kind of a small value, in words; beside others, in lists and mappings, a number is any."""
    if value is None:
        return "nothing"
    kind = next(kind for kind, types in _KINDS.items() if isinstance(value, types))
    return "a number" if kind == "a whole number" and not whole else kind
