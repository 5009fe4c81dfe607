"""Tables of docs/accuracy.md, and the paper's figure 6 in README.md, from the reference numbers.

Quantities, words and sources of the tables are in accuracy.yaml.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from textwrap import fill
from typing import Any, Final

from dbthermal import readers
from reproduction.numbers import table
from reproduction.paper import SCENE_ERRORS, Numbers

MARKS: Final = ("<!-- accuracy, by make record -->", "<!-- end of accuracy -->")
"""Marks around the tables in docs/accuracy.md."""

README_MARKS: Final = ("<!-- figure 6, by make record -->", "<!-- end of figure 6 -->")
"""Marks around the paper's figure 6 beside ours in README.md."""


def markdown(numbers: Numbers) -> str:
    """Tables of what the separation reaches, in Markdown."""
    page = readers.read_yaml(Path(__file__).with_suffix(".yaml"))
    sections = (_section(numbers, section, page["words"]) for section in page["sections"])
    return "\n\n".join(sections) + "\n"


def _section(numbers: Numbers, section: Mapping[str, Any], words: Mapping[str, str]) -> str:
    """Heading, sentences and table."""
    rows = [("quantity", "value")]
    rows += [(name, _value(numbers, *source)) for name, *source in section.get("rows", ())]
    cells = rows if "rows" in section else _pivot(numbers, section, words)
    sentences = fill(section.get("note", ""), 100)
    return "\n\n".join(filter(None, [f"## {section['title']}", sentences, table(cells)]))


def figure_6(numbers: Numbers) -> str:
    """Errors at the thermocouple of the paper's figure 6, beside ours, in Markdown."""
    rows = [("scene", "paper, measured", "dbthermal, simulated twin")]
    for scene, errors in SCENE_ERRORS.items():
        ours = _value(numbers, "08_twins", f"{scene}: error of subspace", "")
        rows.append((scene.replace("_", " "), f"{errors['subspace']:g} %", f"{ours} %"))
    return table(rows) + "\n"


def _value(numbers: Numbers, stem: str, pattern: str, unit: str) -> str:
    """Range of the numbers of a notebook whose names, without their unit, fit a pattern."""
    named = re.compile(rf"({pattern})( \[.*\])?")
    values = numbers.get(stem, {}).items()
    fitting = [v for k, v in values if named.fullmatch(k) and not isinstance(v, str)]
    if not fitting:
        return "not measured"
    ends = dict.fromkeys(_text(end, unit) for end in (min(fitting), max(fitting)))
    return " to ".join(ends) + (f" {unit}" if unit else "")


def _pivot(
    numbers: Numbers, section: Mapping[str, Any], words: Mapping[str, str]
) -> Iterator[tuple[str, ...]]:
    """Head and rows of a table of the numbers whose names fit a pattern of row and column."""
    heads: dict[str, str] = section["columns"]
    cells: dict[str, dict[str, str]] = {}
    for name, value in numbers.get(section["notebook"], {}).items():
        if (named := re.fullmatch(section["numbers"], name)) and named["column"] in heads:
            head = heads[named["column"]]
            unit = "%" if head.endswith("[%]") else ""
            cells.setdefault(named["row"], {})[head] = _text(float(value), unit)
    yield ("case", *heads.values())
    for row, values in cells.items():
        case = ", ".join(words.get(word, word) for word in row.split(", "))
        case = f"clocks {case}" if case.endswith(" frames apart") else case
        yield (case, *(values.get(head, "") for head in heads.values()))


def _text(value: float, unit: str) -> str:
    """Number to two digits, a share in per cent to a tenth; whole numbers as they are."""
    if unit == "%":
        return f"{100 * value:.1f}"
    return str(value) if isinstance(value, int) else f"{value:#.2g}".rstrip(".")
