"""One number or figure of the paper: where it is, what ours is, and how the two stand."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

Numbers = Mapping[str, Mapping[str, float | int | str | bool]]
"""Stem of a notebook -> name -> number, as `verify.read_run` gives them."""

TWIN: Final = "simulated twin"
"""What a row is measured on that stands for a scene of the paper."""

_AGREES: Final = 0.1
_ON_A_TWIN: Final = ", on a twin"


@dataclass(frozen=True)
class Row:
    """
    One published number, or one figure without a number.

    Attributes
    ----------
    place : str
        Where in the paper.
    quantity : str
        What it is.
    stem : str
        Notebook that measures it here.
    names : tuple of str
        Names of the numbers there.
    data : str
        What ours is measured on.
    published : float, optional
        The paper's number.
    unit : str
        Its unit.
    judged : {"error", "value", "distance", "lowest", "alike", "no"}
        As an error (lower is better), as a value (near the paper's is agreement, within `within`),
        by the distance from `reference` (lower is better), as the "lowest" being the one that
        `note` names, as the second being within `within` times the first ("alike"), or not at all,
        for the reason in `note`.
    within : float
        Largest difference that is agreement.
    note : str
        Verdict where none is computed.
    labels : tuple of str
        What each of several numbers is.
    reference : float, optional
        What both the paper and ours should find.
    """

    place: str
    quantity: str
    stem: str = ""
    names: tuple[str, ...] = ()
    data: str = ""
    published: float | None = None
    unit: str = "1"
    judged: str = "no"
    within: float = 0.0
    note: str = "no number published"
    labels: tuple[str, ...] = ()
    reference: float | None = None

    def ours(self, numbers: Numbers) -> dict[str, float]:
        """
        Numbers measured here.

        Parameters
        ----------
        numbers : mapping
            See `Numbers`.

        Returns
        -------
        dict
            Label, or name, -> number; without those that were not measured, as for want of the
            outside data.
        """
        found = numbers.get(self.stem, {})
        pairs = zip(self.labels or self.names, self.names, strict=True)
        return {label: float(found[name]) for label, name in pairs if name in found}

    def verdict(self, numbers: Numbers) -> str:
        """
        Say how ours stands to the paper's.

        Parameters
        ----------
        numbers : mapping
            See `Numbers`.

        Returns
        -------
        str
            "agrees", "better", "worse" or "differs", of a twin with a word that says so, for theirs
            cannot be checked; "not measured"; or the row's note.
        """
        found = self.ours(numbers)
        if len(found) < len(self.names):
            return "not measured"
        if self.judged == "lowest":
            return (
                "agrees" if min(found, key=lambda label: found[label]) == self.note else "differs"
            )
        if self.judged == "alike":
            first, second = found.values()
            return "agrees" if second < self.within * first else "differs"
        if self.published is None or self.judged == "no":
            return self.note
        word = self._word(next(iter(found.values())), self.published)
        return word + _ON_A_TWIN * (self.data == TWIN)

    def _word(self, ours: float, theirs: float) -> str:
        """One word for how ours stands to theirs."""
        if self.judged == "value":
            return "agrees" if abs(ours - theirs) <= self.within else "differs"
        if self.reference is not None:
            ours, theirs = abs(ours - self.reference), abs(theirs - self.reference)
        if abs(ours - theirs) <= max(self.within, _AGREES * theirs):
            return "agrees"
        return "better" if ours < theirs else "worse"
