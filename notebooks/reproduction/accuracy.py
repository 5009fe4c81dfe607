"""Tables of docs/accuracy.md, and the paper's figure 6 in README.md, from the reference numbers."""

import re
from collections.abc import Iterator, Mapping
from typing import Final

from reproduction.numbers import table
from reproduction.paper import SCENE_ERRORS, Numbers

MARKS: Final = ("<!-- accuracy, by make record -->", "<!-- end of accuracy -->")
"""Marks around the tables in docs/accuracy.md."""

README_MARKS: Final = ("<!-- figure 6, by make record -->", "<!-- end of figure 6 -->")
"""Marks around the paper's figure 6 beside ours in README.md."""

_SCENE: Final = "scene of README"
_HELD: Final = "95 % intervals that contain the truth"
_MODERATE: Final = ": error at moderate noise"

_SINGLE: Final[Mapping[str, Mapping[str, tuple[tuple[str, str, str], ...]]]] = {
    "Temperature and emissivity": {
        "03_simulation": (
            ("object: median RMSE", r"0\.86/0\.72, to 60 C: object temperature RMSE", "K"),
            ("emissivities: median error", r"0\.86/0\.72, to 60 C: emissivity error.*", ""),
        ),
        "04_separation": (
            (f"{_SCENE}: object RMSE, pixel by pixel (`solve`)", "twin_rmse_subspace_K", "K"),
            (f"{_SCENE}: object RMSE, `separate`", "twin_rmse_whole_K", "K"),
            (f"{_SCENE}: object RMSE, `calibrated`, per frame", "twin_rmse_calibrated_K", "K"),
        ),
        "10_limits": (
            (
                "reflection ratio: standard error over Cramér-Rao bound, noise factor 0.1 to 2",
                "noise x .*: scatter of the ratio over its bound",
                "",
            ),
            *(
                (
                    f"reflection ratio: standard error of one pixel over that of {n} pooled pixels",
                    f"{n} pixels: gain of the ratio",
                    "",
                )
                for n in (4, 25, 100, 400)
            ),
            ("two materials: pixels in the right material", "plate: right side of the border", "%"),
        ),
    },
    "Error bars": {
        "10_limits": (
            (f"object: {_HELD}, stress cases", "(least|most) covered object", "%"),
            (f"emissivity: {_HELD}, stress cases", ".*: emissivity covered", "%"),
            (
                "unflagged objects with an error above four deviations, worst case",
                "wrong objects without a flag, worst case",
                "%",
            ),
        ),
        "04_separation": ((f"{_SCENE}: {_HELD}, `separate`", "twin_coverage_95_whole", "%"),),
    },
    "Methods: error of the object temperature at moderate noise": {
        "05_methods": (
            ("`subspace`, the default", f"subspace{_MODERATE}", "K"),
            ("`calibrated`, emissivities known", f"calibrated{_MODERATE}", "K"),
            ("`dbvt`, the paper's optimiser", f"dbvt{_MODERATE}", "K"),
            ("`apparent`, the camera's reading", f"apparent{_MODERATE}", "K"),
        ),
    },
    "Other data": {
        "02_emissivity": (
            ("measured spectra of materials in public libraries", "materials", ""),
            (
                "spectra with emissivities in 8-14 and 9.5 µm that differ by more than 0.05",
                "separable_materials",
                "",
            ),
        ),
        "12_published": (
            (
                "published videos, not radiometric: correlation with the authors' reflection map",
                "(coffeepot|glass-plate)_map_correlation",
                "",
            ),
        ),
        "00_acquisition": (
            ("emulated cameras: good frames recorded", "good", ""),
            ("emulated cameras: frames lost or damaged", "lost|damaged", ""),
        ),
        "14_live": (("emulated cameras: delay of the live separation", "latency", "s"),),
    },
}
"""Title -> notebook -> quantity, pattern of the names of its numbers, unit."""

_TABLES: Final = {
    "Two cameras: error with a disturbance over error without it": (
        "11_rig",
        r"(?P<row>.*), (?P<column>as recorded|undone): error \[1\]",
        {"as recorded": "as recorded", "undone": "after alignment and correction"},
    ),
    "Simulated twins of the paper's scenes: medians over pixels with moving reflections": (
        "08_twins",
        r"(?P<row>.*, .*): (?P<column>good|object_temperature_rmse|covered)",
        {
            "good": "share of the pixels [%]",
            "object_temperature_rmse": "object RMSE [K]",
            "covered": "95 % intervals that contain the truth [%]",
        },
    ),
    "From raw counts to temperatures, every step estimated": (
        "13_whole",
        r"(?P<row>clean|all at once): (?P<column>.*) \[(1|K)\]",
        {
            "pixels measured": "pixels measured [%]",
            "pixels with a value": "pixels with a value [%]",
            "object RMSE, measured": "object RMSE, measured [K]",
            "object RMSE, all": "object RMSE, all [K]",
            "95 % intervals hold, measured": "95 % intervals that contain the truth, measured [%]",
            "95 % intervals hold, all": "95 % intervals that contain the truth, all [%]",
        },
    ),
}
"""Title -> notebook, pattern of the names of its numbers, heads of the columns."""

_WORDS: Final = {
    "coffee_pot": "coffee pot",
    "glass_plate": "glass plate",
    "found": "views registered by the plate's details",
    "perfect": "views registered exactly",
    "one place": "cameras at one place",
    "side by side": "cameras 4 cm apart",
    "alone": "`solve`, pixel by pixel",
    "pooled": "`separate`, pooled pixels",
    "completed": "`separate`, completed pixels",
    "all at once": "all disturbances together",
    "clean": "no disturbance",
}
"""Words of the table for those of the notebooks."""


def markdown(numbers: Numbers) -> str:
    """Tables of what the separation reaches, in Markdown."""
    parts = []
    for title, sources in _SINGLE.items():
        rows = [
            (quantity, _value(numbers, stem, pattern, unit))
            for stem, lines in sources.items()
            for quantity, pattern, unit in lines
        ]
        parts.append(f"## {title}\n\n{table([('quantity', 'value'), *rows])}")
    for title, (stem, pattern, heads) in _TABLES.items():
        parts.append(f"## {title}\n\n{table(_pivot(numbers.get(stem, {}), pattern, heads))}")
    return "\n\n".join(parts) + "\n"


def figure_6(numbers: Numbers) -> str:
    """Errors at the thermocouple of the paper's figure 6, beside ours, in Markdown."""
    rows = [("scene", "paper, measured", "dbthermal, simulated twin")]
    for scene, errors in SCENE_ERRORS.items():
        ours = _value(numbers, "08_twins", f"{scene}: error of subspace", "")
        rows.append((_WORDS.get(scene, scene), f"{errors['subspace']:g} %", f"{ours} %"))
    return table(rows) + "\n"


def _value(numbers: Numbers, stem: str, pattern: str, unit: str) -> str:
    """Range of the numbers of a notebook whose names, without their unit, fit a pattern."""
    named = re.compile(rf"({pattern})( \[.*\])?")
    values = numbers.get(stem, {}).items()
    found = [v for k, v in values if named.fullmatch(k) and not isinstance(v, str)]
    if not found:
        return "not measured"
    ends = dict.fromkeys(_text(end, unit) for end in (min(found), max(found)))
    return " to ".join(ends) + (f" {unit}" if unit else "")


def _pivot(
    numbers: Mapping[str, object], pattern: str, heads: Mapping[str, str]
) -> Iterator[tuple[str, ...]]:
    """Head and rows of a table of the numbers whose names fit a pattern of row and column."""
    cells: dict[str, dict[str, str]] = {}
    for name, value in numbers.items():
        if (named := re.fullmatch(pattern, name)) and named["column"] in heads:
            head = heads[named["column"]]
            unit = "%" if head.endswith("[%]") else ""
            cells.setdefault(named["row"], {})[head] = _text(float(str(value)), unit)
    yield ("case", *heads.values())
    for row, values in cells.items():
        case = ", ".join(_WORDS.get(word, word) for word in row.split(", "))
        case = f"clocks {case}" if case.endswith(" frames apart") else case
        yield (case, *(values.get(head, "") for head in heads.values()))


def _text(value: float, unit: str) -> str:
    """Number to two digits, a share in per cent to a tenth; whole numbers as they are."""
    if unit == "%":
        return f"{100 * value:.1f}"
    return str(value) if isinstance(value, int) else f"{value:#.2g}".rstrip(".")
