"""The paper's published numbers and figures, one by one, beside what is measured here.

Source of all published numbers: Narayanan, Ramanagopal, Narasimhan (2026), Dual Band Thermal
Videography, CVPR, doi:10.48550/arXiv.2509.11334. Its captures are not public: what is measured
here is of simulations, of simulated twins of its scenes, of spectral libraries and of its
published videos, and every row says of which.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from typing import Final

Numbers = Mapping[str, Mapping[str, float | int | str | bool]]
"""Stem of a notebook -> name -> number, as `verify.read_run` gives them."""

COLUMNS: Final = ("in the paper", "quantity", "paper", "here", "measured on", "verdict")
"""Columns of the table."""

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

_AGREES: Final = 0.1
_PERCENT: Final = "%"


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
    judged : {"error", "value", "distance", "no"}
        As an error (lower is better), as a value (near the paper's is agreement, within `within`),
        by the distance from `reference` (lower is better), or not at all, for the reason in `note`.
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

    def ours(self, numbers: Numbers) -> list[float]:
        """
        Numbers measured here.

        Parameters
        ----------
        numbers : mapping
            See `Numbers`.

        Returns
        -------
        list of float
            One a name; empty where the notebook was run without the outside data it needs.
        """
        found = numbers.get(self.stem, {})
        return [float(found[name]) for name in self.names if name in found]

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
            "agrees", "better", "worse", "differs", "not measured", or the row's note.
        """
        found = self.ours(numbers)
        if not found and self.names:
            return "not measured"
        if self.published is None or self.judged == "no":
            return self.note
        ours, theirs = found[0], self.published
        if self.judged == "value":
            return "agrees" if abs(ours - theirs) <= self.within else "differs"
        if self.reference is not None:
            ours, theirs = abs(ours - self.reference), abs(theirs - self.reference)
        if abs(ours - theirs) <= max(self.within, _AGREES * theirs):
            return "agrees"
        return "better" if ours < theirs else "worse"


def compare(numbers: Numbers) -> Iterator[tuple[str, ...]]:
    """
    Set every published number beside ours.

    Parameters
    ----------
    numbers : mapping
        See `Numbers`.

    Yields
    ------
    tuple of str
        Cells of `COLUMNS`.
    """
    for row in rows():
        found = row.ours(numbers)
        texts = [_text(value, row.unit) for value in found]
        if row.labels and found:
            texts = [f"{name} {text}" for name, text in zip(row.labels, texts, strict=True)]
        paper = "-" if row.published is None else _text(row.published, row.unit)
        here = ", ".join(texts) or "-"
        if row.reference is not None:
            paper, here = (f"{text} (for {row.reference:g})" for text in (paper, here))
        yield (row.place, row.quantity, paper, here, row.data, row.verdict(numbers))


def markdown(numbers: Numbers) -> str:
    """
    Write the comparison as a table in Markdown.

    Parameters
    ----------
    numbers : mapping
        See `Numbers`.

    Returns
    -------
    str
        Head, rule, and a line for each row.
    """
    lines = [COLUMNS, ("---",) * len(COLUMNS), *compare(numbers)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def rows() -> tuple[Row, ...]:
    """
    List every number of the paper, and every figure.

    Returns
    -------
    tuple of Row
        In the paper's order.
    """
    return (*_FIRST, *_terms(), *_bench(), *_scenes(), *_LAST)


def _terms() -> Iterator[Row]:
    for term, value in REDUCTIONS.items():
        names, what = (f"{term}: reduction [%]",), f"error saved by the {term} term"
        yield Row(
            "Table 1", what, "06_optimiser", names, "simulated", value, _PERCENT, "value", 10.0
        )


def _bench() -> Iterator[Row]:
    for procedure, name in (("paper", "bench"), ("reflector", "reflector")):
        for thing, value in EMISSIVITIES[procedure].items():
            yield Row(
                "Table 2",
                f"emissivity of the {thing}, {name}",
                "07_bench",
                (f"{thing}: {name} [1]",),
                "simulated twin",
                value,
                judged="distance" if name == "bench" else "value",
                within=0.01 if name == "bench" else 0.03,
                reference=EMISSIVITIES["reference"][thing],
            )


def _scenes() -> Iterator[Row]:
    for scene, errors in SCENE_ERRORS.items():
        shown = scene.replace("_", " ")
        names = (f"{scene}: highest reading [degC]",)
        what = f"{shown}: highest reading of the thermocouple"
        common = ("08_twins", names, "simulated twin", PEAKS[scene], "\N{DEGREE SIGN}C")
        yield Row("Fig. 6", what, *common, note="by construction")
        for method, error in errors.items():
            what = f"{shown}: error at the thermocouple, {_ROLES.get(method, method)}"
            names = (f"{scene}: error of {method} [%]",)
            judged = "error" if method in _ROLES else "no"
            note = "another scene, no target"
            common = ("08_twins", names, "simulated twin", error, _PERCENT)
            yield Row("Fig. 6", what, *common, judged, 0.0, note)


_ROLES: Final = {"subspace": "emissivities unknown", "calibrated": "emissivities calibrated"}
_METHODS: Final = ("subspace", "dbvt", "naive", "ratio, wide", "ratio, narrow", "bcp")
_PAIRS: Final = ("8.5", "9.5", "10.6", "12.1")

_FIRST: Final = (
    Row(
        "Fig. 1",
        "image formation: object, background, path, optics, camera",
        data="`mixing`, its tests",
        note="implemented",
    ),
    Row(
        "Figs. 2 left, 10",
        "error of the object temperature at moderate noise, median over materials",
        "05_methods",
        tuple(f"{name}: error at moderate noise [K]" for name in _METHODS),
        "simulated",
        unit="K",
        labels=_METHODS,
    ),
    Row(
        "Fig. 2 right",
        "error of the emissivity at low noise, median over emissivities",
        "05_methods",
        tuple(f"{name}: emissivity error at the lowest noise [1]" for name in _METHODS[:2]),
        "simulated",
        labels=_METHODS[:2],
    ),
    Row(
        "Fig. 3",
        "error of the bunny's temperature, mean over frames, median over its pixels",
        "08_twins",
        tuple(f"{name}: error on the bunny [K]" for name in ("subspace", "naive")),
        "simulated",
        unit="K",
        labels=("subspace", "naive"),
    ),
)

_LAST: Final = (
    *(
        Row(
            "section 5.2",
            f"emissivity, unknown against calibrated: {scene}, {band} um",
            "08_twins",
            (f"{scene}: emissivity unknown less calibrated, {band} [1]",),
            "simulated twin",
            value,
            judged="error",
        )
        for (scene, band), value in zip(
            product(("wineglass", "coffee_pot"), ("8-14", "9.5")),
            (0.17, 0.15, 0.19, 0.15),
            strict=True,
        )
    ),
    Row(
        "Fig. 4",
        "emissivity of five objects in five bands, largest error in any series",
        "07_bench",
        ("largest error of the bench in any series [1]",),
        "simulated twin",
    ),
    Row(
        "Fig. 5",
        "finger print: share of the emission's change that is found as emission; "
        "finger reflection: of the reflection's as reflection",
        "08_twins",
        tuple(f"{name}: share found [1]" for name in ("fingerprint", "fingers")),
        "simulated twin",
        labels=("print", "reflection"),
    ),
    Row(
        "Fig. 6",
        "coffee pot: map of the reflection, correlation with the authors'",
        "04_separation",
        ("coffeepot_map_correlation",),
        "published video",
    ),
    Row(
        "Fig. 6",
        "glass plate: the same",
        "04_separation",
        ("glass-plate_map_correlation",),
        "published video",
    ),
    Row(
        "Fig. 7",
        "8-14 um: residual of the Sakuma-Hattori curve, and of the line, 0 to 75 \N{DEGREE SIGN}C",
        "01_calibration",
        ("residual_8-14_K", "linear_residual_8-14_K"),
        "simulated",
        unit="K",
        note="differs: the line's residual is far above the noise",
        labels=("curve", "line"),
    ),
    Row(
        "Fig. 8",
        "ablation over noise: the noise terms' share at the highest level",
        "06_optimiser",
        ("noise: reduction at the highest noise [%]",),
        "simulated",
        unit=_PERCENT,
    ),
    Row(
        "Fig. 9",
        "median condition number of 8-14 um with each filter",
        "02_emissivity",
        tuple(f"condition_8-14_{name}" for name in _PAIRS),
        "spectral libraries",
        note="agrees: 9.5 um is lowest",
        labels=_PAIRS,
    ),
)


def _text(value: float, unit: str) -> str:
    """Three significant digits and the unit."""
    shown = f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
    return shown if unit == "1" else f"{shown} {unit}"
