"""The paper's published numbers and figures, one by one, beside ours.

Source of all published numbers: Narayanan, Ramanagopal, Narasimhan (2026), Dual Band Thermal
Videography, CVPR, doi:10.48550/arXiv.2509.11334. Its captures are not public: ours are
of simulations, of simulated twins of its scenes, of spectral libraries and of its published
videos, and every row says of which. Rows that stand in no table of the paper are in paper.yaml.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from dbthermal import readers
from reproduction.numbers import table

_OBJECTS: Final = ("chrome ball", "aluminium cup", "blue paint", "glass jar", "wineglass")

EMISSIVITIES: Final = {
    "reference": dict(zip(_OBJECTS, (0.10, 0.05, 0.87, 0.95, 0.95), strict=True)),
    "reflector": dict(zip(_OBJECTS, (0.43, 0.16, 0.88, 0.93, 0.97), strict=True)),
    "paper": dict(zip(_OBJECTS, (0.12, 0.10, 0.88, 0.93, 0.96), strict=True)),
}
"""Table 2, 8-14 um: reference, reflector method and the paper's bench, by object [1]."""

REDUCTIONS: Final = {"reconstruction": 90.10, "smoothing": 56.73, "huber": 11.31, "noise": 11.64}
"""Table 1: reduction of the error by adding a loss term to the other three [%]."""

SCENE_ERRORS: Final = {
    "wineglass": {"subspace": 1.72, "calibrated": 5.04, "bcp": 14.6, "naive": 31.68},
    "coffee_pot": {"subspace": 5.34, "calibrated": 0.36, "bcp": 6.62, "naive": 45.5},
}
"""Figure 6: error at the thermocouple relative to degrees Celsius [%]; the paper's uncalibrated
method is its optimiser, ours is the default one."""

PEAKS: Final = {"wineglass": 63.6, "coffee_pot": 63.1}
"""Figure 6: highest reading of the thermocouple [degree Celsius]."""

Numbers = Mapping[str, Mapping[str, float | int | str | bool]]
"""Stem of a notebook -> name -> number, as `verify.read_run` gives them."""

TWIN: Final = "simulated twin"
DATA: Final = {
    **dict.fromkeys(("01_calibration", "05_methods", "06_optimiser"), "simulated"),
    **dict.fromkeys(("07_bench", "08_twins"), TWIN),
    "02_emissivity": "spectral libraries",
    "12_published": "published video",
}
"""What each notebook measures on; a twin stands for a scene of the paper."""

_AGREES: Final = 0.1
_ON_A_TWIN: Final = ", on a twin"


@dataclass(frozen=True)
class Row:
    """One published number, or one figure without a number.

    It is judged as an "error" (lower is better), as a "value" (near the paper's is agreement,
    within `within`), by the "distance" from `reference` (lower is better), as the "lowest" being
    the one that `note` names, as the second being within `within` times the first ("alike"), or
    "no", not at all, for the reason in `note`.
    """

    place: str  # in the paper
    quantity: str
    stem: str = ""  # of the notebook that measures it here
    names: tuple[str, ...] = ()  # of its numbers there
    published: float | None = None
    unit: str = "1"
    judged: str = "no"
    within: float = 0.0  # largest difference that is agreement
    note: str = "no number published"  # verdict where none is computed
    labels: tuple[str, ...] = ()  # of several numbers
    reference: float | None = None  # true value for the paper and for ours

    @property
    def data(self) -> str:
        """What ours is measured on."""
        return DATA[self.stem] if self.stem else "`mixing`, its tests"

    def ours(self, numbers: Numbers) -> dict[str, float]:
        """Numbers measured here, by label or name; without those that were not measured."""
        measured = numbers.get(self.stem, {})
        pairs = zip(self.labels or self.names, self.names, strict=True)
        return {label: float(measured[name]) for label, name in pairs if name in measured}

    def verdict(self, numbers: Numbers) -> str:
        """Verdict on ours against the paper's.

        "agrees", "smaller error", "larger error" or "differs", on a twin with a note that says so,
        since the authors' cannot be checked; "not measured"; or the row's note.
        """
        values = self.ours(numbers)
        if len(values) < len(self.names):
            return "not measured"
        if self.judged == "lowest":
            return (
                "agrees" if min(values, key=lambda label: values[label]) == self.note else "differs"
            )
        if self.judged == "alike":
            first, second = values.values()
            return "agrees" if second < self.within * first else "differs"
        if self.published is None or self.judged == "no":
            return self.note
        word = self._word(next(iter(values.values())), self.published)
        return word + _ON_A_TWIN * (self.data == TWIN)

    def _word(self, ours: float, theirs: float) -> str:
        """One word for ours against theirs."""
        if self.judged == "value":
            return "agrees" if abs(ours - theirs) <= self.within else "differs"
        if self.reference is not None:
            ours, theirs = abs(ours - self.reference), abs(theirs - self.reference)
        if abs(ours - theirs) <= max(self.within, _AGREES * theirs):
            return "agrees"
        return "smaller error" if ours < theirs else "larger error"


COLUMNS: Final = ("in the paper", "quantity", "paper", "project", "measured on", "comparison")
"""Columns of the table."""


def compare(numbers: Numbers) -> Iterator[tuple[str, ...]]:
    """Cells of `COLUMNS` for every published number beside ours."""
    for row in rows():
        values = row.ours(numbers)
        texts = [
            f"{label} {_text(value, row.unit)}" if row.labels else _text(value, row.unit)
            for label, value in values.items()
        ]
        paper = "-" if row.published is None else f"{row.published:g}{_after(row.unit)}"
        ours = ", ".join(texts) or "-"
        if row.reference is not None:
            paper, ours = (f"{text} (reference {row.reference:g})" for text in (paper, ours))
        yield (row.place, row.quantity, paper, ours, row.data, row.verdict(numbers))


def markdown(numbers: Numbers) -> str:
    """Comparison as a table in Markdown."""
    return table([COLUMNS, *compare(numbers)]) + "\n"


def rows() -> tuple[Row, ...]:
    """Every number of the paper, and every figure, in the paper's order."""
    listed = readers.read_yaml(Path(__file__).with_suffix(".yaml"))
    first, last = (map(_row, listed[part]) for part in ("first", "last"))
    return (*first, *_terms(), *_bench(), *_scenes(), *last)


def _row(entry: dict[str, Any]) -> Row:
    """Row of an entry of paper.yaml, whose lists are tuples here."""
    lists = {key: tuple(value) for key, value in entry.items() if isinstance(value, list)}
    return Row(**entry | lists)


def _terms() -> Iterator[Row]:
    for term, value in REDUCTIONS.items():
        names = (f"{term}: reduction [%]",)
        quantity = f"reduction of the error by adding the {term} term"
        yield Row("Table 1", quantity, "06_optimiser", names, value, "%", "value", 10.0)


def _bench() -> Iterator[Row]:
    for procedure, name in (("paper", "bench"), ("reflector", "reflector")):
        judged, within = ("distance", 0.01) if name == "bench" else ("value", 0.03)
        for thing, value in EMISSIVITIES[procedure].items():
            quantity, names = f"emissivity of the {thing}, {name}", (f"{thing}: {name} [1]",)
            row = Row("Table 2", quantity, "07_bench", names, value, "1", judged, within)
            yield replace(row, reference=EMISSIVITIES["reference"][thing])


def _scenes() -> Iterator[Row]:
    for scene, errors in SCENE_ERRORS.items():
        shown, unit = scene.replace("_", " "), "\N{DEGREE SIGN}C"
        highest = (f"{scene}: highest reading [degC]",)
        quantity = f"{shown}: highest reading of the thermocouple"
        common = ("08_twins", highest, PEAKS[scene], unit)
        yield Row("Fig. 6", quantity, *common, note="by construction")
        for method, error in errors.items():
            quantity = f"{shown}: error at the thermocouple, {_ROLES.get(method, method)}"
            names = (f"{scene}: error of {method} [%]",)
            yield Row("Fig. 6", quantity, "08_twins", names, error, "%", "error")


_ROLES: Final = {"subspace": "emissivities unknown", "calibrated": "emissivities calibrated"}


def _text(value: float, unit: str) -> str:
    """Three significant digits and the unit."""
    shown = f"{value:#.3g}".rstrip(".") if abs(value) < 1000 else f"{value:.0f}"
    return shown + _after(unit)


def _after(unit: str) -> str:
    return "" if unit == "1" else f" {unit}"
