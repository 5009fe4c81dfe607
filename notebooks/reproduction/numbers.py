"""Headline numbers of a notebook: strict JSON with their provenance and a checksum."""

import hashlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dbthermal import _text as texts
from dbthermal import store
from dbthermal.store._integrity import AS_WRITTEN
from dbthermal.store._results import as_json

Number = float | int | str | bool


def save(
    numbers: Mapping[str, Number | np.generic], path: str | Path, provenance: Mapping[str, Any]
) -> None:
    """Save headline numbers as strict JSON, with sorted names, and a provenance, see `store.save`.

    Name, unit included (``"object_rmse_K"``), to a finite number, a string or a boolean; TypeError
    or ValueError for any other value.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     save({"object_rmse_K": 0.21}, f"{folder}/wall.json", {"parameters": {"frames": 2}})
    ...     read(f"{folder}/wall.json")
    {'object_rmse_K': 0.21}
    """
    content: dict[str, Any] = {
        "numbers": {name: _number(name, value) for name, value in numbers.items()},
        "provenance": dict(provenance),
    }
    content["sha256"] = _digest(content)
    with store.whole(path, ".json") as part:
        part.write_text(as_json(content, indent=2) + "\n", encoding="utf-8")


def read(path: str | Path) -> dict[str, Number]:
    """Read a file of `save`: name to value.

    ValueError with the file if it is not such a file, a name is listed twice, a number is not
    finite, or it differs from what was written.
    """
    content = _parse_json(texts.read_text(path), str(path))
    if not isinstance(content, dict) or not isinstance(content.get("numbers"), dict):
        raise ValueError(f"No 'numbers' in '{path}'. Must be a file that numbers.save wrote.")
    if content.pop("sha256", None) != _digest(content):
        raise ValueError(f"Damaged file '{path}'. {AS_WRITTEN}")
    return dict(content["numbers"])


def table(rows: Iterable[Sequence[str]]) -> str:
    """Table in Markdown, the first row as its head."""
    head, *lines = rows
    rule = "|---" * len(head) + "|"
    return "\n".join([_row(head), rule, *map(_row, lines)])


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _digest(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(as_json(content).encode()).hexdigest()


def _number(name: str, value: object) -> Number:
    """Headline value as a plain Python one."""
    plain = value.item() if isinstance(value, np.generic) else value
    if not isinstance(plain, (bool, int, float, str)):
        raise TypeError(f"Invalid {name!r} = {value!r}. Must be a number, a string or a boolean.")
    if isinstance(plain, float) and not math.isfinite(plain):
        raise ValueError(f"Invalid {name!r} = {value!r}. Must be finite.")
    return plain


def _parse_json(text: str, source: str) -> Any:
    """Content of JSON; ValueError by place if a key repeats or a number is not finite."""

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        for key in texts.repeated(key for key, _ in pairs):
            raise ValueError(f"{source}: Repeated key {texts.shown(key)}. Must be listed once.")
        return dict(pairs)

    def whole(digits: str) -> int:
        texts.number(digits, source)  # a whole number of thousands of digits is none
        return int(digits)

    finite = partial(texts.number, place=source)
    hooks: Any = {"parse_float": finite, "parse_int": whole, "parse_constant": finite}
    try:
        return json.loads(text, object_pairs_hook=unique, **hooks)
    except json.JSONDecodeError as error:
        place = texts.at(source, error.lineno, error.colno)
        raise ValueError(f"{place}: Must be JSON: {error.msg}.") from error
    except RecursionError as error:
        raise ValueError(f"{source}: Invalid nesting. Must be less deep.") from error
