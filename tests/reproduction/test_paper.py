"""The paper's numbers: complete, and judged by their stated rule."""

import json
from pathlib import Path
from typing import Any

import pytest

from reproduction import paper, verify
from reproduction.paper import Row

STEM = "01_calibration"
ROOT = Path(__file__).parents[2]
REFERENCE = json.loads((ROOT / "tests" / "reference_numbers.json").read_text(encoding="utf-8"))


LOWEST = {"judged": "lowest", "note": "9.5", "labels": ("8.5", "9.5")}


@pytest.mark.parametrize(
    ("ours", "rule", "expected"),
    [
        ([0.5], {"judged": "error"}, "smaller error"),
        ([0.95], {"judged": "error"}, "agrees"),
        ([1.05], {"judged": "error"}, "agrees"),
        ([1.2], {"judged": "error"}, "larger error"),
        ([1.2], {"judged": "value", "within": 0.25}, "agrees"),
        ([1.2], {"judged": "value", "within": 0.1}, "differs"),
        ([0.7], {"judged": "distance", "reference": 0.8}, "smaller error"),  # 0.1; the paper 0.2
        ([0.5], {"judged": "distance", "reference": 0.8}, "larger error"),
        ([0.99], {"judged": "distance", "reference": 0.8, "within": 0.02}, "agrees"),
        ([0.5], {"judged": "no"}, "no number published"),
        ([1.0, 5.0], LOWEST, "differs"),
        ([9.0, 5.0], LOWEST, "agrees"),
        ([1.0, 1.5], {"judged": "alike", "within": 2.0}, "agrees"),
        ([1.0, 4.0], {"judged": "alike", "within": 2.0}, "differs"),
    ],
)
def test_verdict(ours: list[float], rule: dict[str, Any], expected: str) -> None:
    """Errors by size, values by distance, named methods as the lowest, equal ones as alike."""
    numbers = dict(zip("ab", ours, strict=False))
    row = Row("Fig.", "error", STEM, tuple(numbers), published=1.0, unit="K", **rule)
    assert row.verdict({STEM: numbers}) == expected
    assert row.verdict({STEM: dict([*numbers.items()][1:])}) == "not measured"


def test_half_a_row_is_shown() -> None:
    """A row with a part of its numbers shows them with labels, and is not judged."""
    some = {"05_methods": {"naive: error at moderate noise [K]": 2.0}}
    (line,) = [cells for cells in paper.compare(some) if cells[0] == "Figs. 2 left, 10"]
    assert (line[3], line[-1]) == ("naive 2.00 K", "not measured")


def test_everything_published_is_there() -> None:
    """Ten figures, two tables, 28 numbers; with the outside data each has ours beside it."""
    numbers = [part.published for part in paper.rows() if part.published is not None]
    assert len(numbers) == 10 + 4 + 10 + 4
    shown = (0.43, 0.16, 90.10, 56.73, 11.31, 11.64, 63.6, 63.1, 1.72, 5.04, 14.6, 31.68)
    assert {*shown, 5.34, 0.36, 6.62, 45.5, 0.17, 0.15, 0.19} <= {*numbers}
    places = " ".join(part.place for part in paper.rows())
    figures = ["Fig. 1", "Figs. 2 left, 10", "Fig. 2 right", *(f"Fig. {n}" for n in range(3, 10))]
    assert [name for name in (*figures, "Table 1", "Table 2") if name not in places] == []
    ours = {part: part.ours(REFERENCE["with data"]) for part in paper.rows()}
    assert [part.quantity for part, values in ours.items() if len(values) < len(part.names)] == []


def test_pages_hold_the_tables() -> None:
    """README.md, docs/paper.md and docs/accuracy.md have the tables of the reference numbers."""
    for page, text in verify.pages(REFERENCE["with data"]):
        assert page.read_text(encoding="utf-8") == text, page
        assert "not measured" not in text
    with pytest.raises(ValueError, match="Missing marks"):
        verify.enclosed("nothing", verify.MARKS, "", "docs/paper.md")
