"""Headline numbers of a notebook: strict JSON with their provenance and a checksum."""

import hashlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
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
    """
    content: dict[str, Any] = {
        "numbers": {name: _number(name, value) for name, value in numbers.items()},
        "provenance": dict(provenance),
    }
    content["sha256"] = _digest(content)
    with store.whole(path, ".json") as draft:
        draft.write_text(as_json(content, indent=2) + "\n", encoding="utf-8")


def read(path: str | Path) -> dict[str, Number]:
    """Read a file of `save`: name to value; ValueError with the file if it is not as written."""
    text = texts.read_text(path)
    try:
        content = json.loads(text)
        whole = content.pop("sha256") == _digest(content)
    # What is no JSON, no mapping, without a checksum, or beyond finite numbers.
    except (ValueError, RecursionError, AttributeError, TypeError, KeyError):
        whole = False
    if not whole:
        raise ValueError(f"Damaged file '{path}'. {AS_WRITTEN}")
    return dict(content["numbers"])


def table(rows: Iterable[Sequence[str]]) -> str:
    """Table in Markdown, the first row as its head."""
    rows = [*rows]
    head, *lines = [f"| {' | '.join(cells)} |" for cells in rows]
    return "\n".join([head, "|---" * len(rows[0]) + "|", *lines])


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
