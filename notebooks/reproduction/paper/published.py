"""Published numbers of the paper, and one row of the comparison with ours."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

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
"""What a row is measured on that stands for a scene of the paper."""

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
    data: str = ""  # that ours is measured on
    published: float | None = None
    unit: str = "1"
    judged: str = "no"
    within: float = 0.0  # largest difference that is agreement
    note: str = "no number published"  # verdict where none is computed
    labels: tuple[str, ...] = ()  # of several numbers
    reference: float | None = None  # true value for the paper and for ours

    def ours(self, numbers: Numbers) -> dict[str, float]:
        """Numbers measured here, by label or name; without those that were not measured."""
        measured = numbers.get(self.stem, {})
        pairs = zip(self.labels or self.names, self.names, strict=True)
        return {label: float(measured[name]) for label, name in pairs if name in measured}

    def verdict(self, numbers: Numbers) -> str:
        """Verdict on ours against the paper's.

        "agrees", "better", "worse" or "differs", of a twin with a note that says so, since theirs
        cannot be checked; "not measured"; or the row's note.
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
        return "better" if ours < theirs else "worse"
