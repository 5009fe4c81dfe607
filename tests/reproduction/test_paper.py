"""The paper's numbers: complete, and judged by their stated rule."""

import json
from pathlib import Path

import pytest

from reproduction import paper, verify
from reproduction.paper import Row

ROOT = Path(__file__).parents[2]
REFERENCE = json.loads((ROOT / "tests" / "reference_numbers.json").read_text(encoding="utf-8"))


def row(published: float, judged: str, **more: float) -> Row:
    """A row with one number of ours."""
    return Row("Fig.", "error", "01_a", ("x",), "simulated", published, "K", judged, **more)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("ours", "judged", "more", "verdict"),
    [
        (0.5, "error", {}, "better"),
        (0.95, "error", {}, "agrees"),
        (1.05, "error", {}, "agrees"),
        (1.2, "error", {}, "worse"),
        (1.2, "value", {"within": 0.25}, "agrees"),
        (1.2, "value", {"within": 0.1}, "differs"),
        (0.7, "distance", {"reference": 0.8}, "better"),  # 0.1 away, the paper 0.2
        (0.5, "distance", {"reference": 0.8}, "worse"),
        (0.99, "distance", {"reference": 0.8, "within": 0.02}, "agrees"),
        (0.5, "no", {}, "no number published"),
    ],
)
def test_verdict(ours: float, judged: str, more: dict[str, float], verdict: str) -> None:
    """An error is judged by its size, a value by its distance, of the paper's or of the truth."""
    assert row(1.0, judged, **more).verdict({"01_a": {"x": ours}}) == verdict


def test_what_was_not_measured_says_so() -> None:
    """A number that no notebook gave is shown as not measured."""
    assert row(1.0, "error").verdict({}) == "not measured"


@pytest.mark.parametrize(("lowest", "verdict"), [(1.0, "differs"), (9.0, "agrees")])
def test_lowest(lowest: float, verdict: str) -> None:
    """The method that the paper names must have the lowest error, and all must be measured."""
    part = Row(
        "Fig.", "", "02_a", ("a", "b"), "", judged="lowest", note="9.5", labels=("8.5", "9.5")
    )
    assert part.verdict({"02_a": {"a": lowest, "b": 5.0}}) == verdict
    assert part.verdict({"02_a": {"b": 5.0}}) == "not measured"


@pytest.mark.parametrize(("second", "verdict"), [(1.5, "agrees"), (4.0, "differs")])
def test_alike(second: float, verdict: str) -> None:
    """The second error must not be far above the first."""
    part = Row("Fig.", "", "01_a", ("a", "b"), "", judged="alike", within=2.0)
    assert part.verdict({"01_a": {"a": 1.0, "b": second}}) == verdict


def test_half_a_row_is_shown() -> None:
    """A row with a part of its numbers shows them with labels, and is not judged."""
    some = {"05_methods": {"naive: error at moderate noise [K]": 2.0}}
    (line,) = [cells for cells in paper.compare(some) if cells[0] == "Figs. 2 left, 10"]
    assert line[3] == "naive 2.00 K"
    assert line[-1] == "not measured"


def test_every_published_number_is_there() -> None:
    """The table has a row for each of the paper's numbers: 10 emissivities, 4 terms, 14 others."""
    numbers = [part.published for part in paper.rows() if part.published is not None]
    assert len(numbers) == 10 + 4 + 10 + 4
    given = (0.43, 0.16, 90.10, 56.73, 11.31, 11.64, 63.6, 63.1, 1.72, 5.04, 14.6, 31.68)
    assert {*given, 5.34, 0.36, 6.62, 45.5, 0.17, 0.15, 0.19} <= {*numbers}


def test_every_figure_and_table_is_there() -> None:
    """Ten figures and two tables."""
    places = " ".join(part.place for part in paper.rows())
    for name in (
        "Fig. 1",
        "Figs. 2 left, 10",
        "Fig. 2 right",
        *(f"Fig. {n}" for n in range(3, 10)),
    ):
        assert name in places
    assert "Table 1" in places
    assert "Table 2" in places


def test_every_number_is_measured() -> None:
    """With the outside data at hand, no row is left without a number."""
    missing = [
        part.quantity
        for part in paper.rows()
        if len(part.ours(REFERENCE["with data"])) < len(part.names)
    ]
    assert missing == []


def test_page_holds_the_table() -> None:
    """The table in docs/paper.md is that of the reference numbers."""
    page = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    assert verify.with_table(page, REFERENCE["with data"]) == page


def test_page_without_marks_is_refused() -> None:
    """A page without marks for the table raises an error."""
    with pytest.raises(ValueError, match="Missing marks"):
        verify.with_table("nothing", {})
