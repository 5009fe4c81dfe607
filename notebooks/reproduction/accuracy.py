"""Tables of docs/accuracy.md, and the paper's figure 6 in README.md, from the reference numbers."""

import re
from collections.abc import Iterator, Mapping
from textwrap import fill
from typing import Final

from reproduction.numbers import table
from reproduction.paper import SCENE_ERRORS, Numbers

MARKS: Final = ("<!-- accuracy, by make record -->", "<!-- end of accuracy -->")
"""Marks around the tables in docs/accuracy.md."""

README_MARKS: Final = ("<!-- figure 6, by make record -->", "<!-- end of figure 6 -->")
"""Marks around the paper's figure 6 beside ours in README.md."""

_SCENE: Final = "plate of glass and concrete"
_HELD: Final = "95 % intervals that contain the truth"
_MODERATE: Final = ": error at moderate noise"

_SINGLE: Final[Mapping[str, Mapping[str, tuple[tuple[str, str, str], ...]]]] = {
    "Temperature and emissivity": {
        "03_simulation": (
            ("usual scene: object RMSE", r"0\.86/0\.72, to 60 C: object temperature RMSE", "K"),
            (
                "usual scene: error of the emissivities, median over pixels",
                r"0\.86/0\.72, to 60 C: emissivity error.*",
                "",
            ),
        ),
        "04_separation": (
            (f"{_SCENE}: object RMSE, `solve` (pixel by pixel)", "twin_rmse_subspace_K", "K"),
            (f"{_SCENE}: object RMSE, `separate`", "twin_rmse_whole_K", "K"),
            (
                f"{_SCENE}: object RMSE, `calibrated`, not smoothed",
                "twin_rmse_calibrated_K",
                "K",
            ),
        ),
        "10_limits": (
            (
                "reflection ratio: standard error over its lower (Cramér-Rao) bound",
                "noise x .*: scatter of the ratio over its bound",
                "",
            ),
            (
                "reflection ratio: standard error of a pixel over that of 4 to 400 pooled pixels",
                r"\d+ pixels: gain of the ratio",
                "",
            ),
            (
                "plate of two materials: pixels assigned to the right material",
                "plate: right side of the border",
                "%",
            ),
        ),
    },
    "Error bars": {
        "10_limits": (
            (f"object: {_HELD}, cases of notebook 10", "(least|most) covered object", "%"),
            (
                f"emissivity: {_HELD}, cases of notebook 10 whose assumptions hold",
                ".*: emissivity covered",
                "%",
            ),
            (
                "pixels without a flag, but with an object error above 4 deviations, worst case",
                "wrong objects without a flag, worst case",
                "%",
            ),
        ),
        "04_separation": ((f"{_SCENE}: {_HELD}, `separate`", "twin_coverage_95_whole", "%"),),
    },
    "Methods: error of the object temperature at moderate noise": {
        "05_methods": (
            ("`subspace`, the default", f"subspace{_MODERATE}", "K"),
            (
                "`calibrated`, emissivities known, smoothed",
                f"calibrated{_MODERATE}",
                "K",
            ),
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
    "Two cameras: error with a disturbance, divided by error without it": (
        "11_rig",
        r"(?P<row>.*), (?P<column>as recorded|undone): error \[1\]",
        {"as recorded": "as recorded", "undone": "after alignment and correction"},
    ),
    "Simulated twins of the paper's scenes": (
        "08_twins",
        r"(?P<row>.*, .*): (?P<column>good|object_temperature_rmse|covered)",
        {
            "good": "share of these pixels [%]",
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
    "alone": "`solve`, no flag",
    "pooled": "`separate`, no flag",
    "completed": "`separate`, completed",
    "all at once": "all disturbances",
    "clean": "no disturbance",
}
"""Words of the table for those of the notebooks."""

_NOTES: Final = {
    "Temperature and emissivity": (
        "The usual scene is separated by `solve`, and the temperature that it reflects "
        "changes by 3 K. The plate of glass and concrete is the picture in the README. It "
        "reflects people 12 K warmer than the room, so its errors are smaller. `calibrated` "
        "knows the emissivities, but in this table takes each frame by itself."
    ),
    "Methods: error of the object temperature at moderate noise": (
        "Median over heated plates of materials whose emissivities differ between the bands "
        "by more than 0.05, with the noise of the usual scene (notebook 05)."
    ),
    "Simulated twins of the paper's scenes": (
        'Only pixels with moving reflections count. "Share" is the part of them that has no '
        "flag, or is completed, as the row says; the other columns are medians over this "
        "part. For cameras 4 cm apart `solve` couples neighbouring pixels, which reduces "
        "the error."
    ),
    "From raw counts to temperatures, every step estimated": (
        '"All disturbances" is a rig of two cameras side by side, with everything that '
        'notebook 13 lists. "No disturbance" is a perfect rig, both cameras at one place. '
        '"All" are the pixels with a value, measured or completed.'
    ),
}
"""Title -> sentences below it."""


def markdown(numbers: Numbers) -> str:
    """Tables of what the separation reaches, in Markdown."""
    sections = []
    for title, sources in _SINGLE.items():
        rows = [
            (quantity, _value(numbers, stem, pattern, unit))
            for stem, lines in sources.items()
            for quantity, pattern, unit in lines
        ]
        sections.append(_section(title, table([("quantity", "value"), *rows])))
    for title, (stem, pattern, heads) in _TABLES.items():
        sections.append(_section(title, table(_pivot(numbers.get(stem, {}), pattern, heads))))
    return "\n\n".join(sections) + "\n"


def _section(title: str, lines: str) -> str:
    """Heading, sentences and table."""
    return "\n\n".join([f"## {title}", *filter(None, [fill(_NOTES.get(title, ""), 100)]), lines])


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
    fitting = [v for k, v in values if named.fullmatch(k) and not isinstance(v, str)]
    if not fitting:
        return "not measured"
    ends = dict.fromkeys(_text(end, unit) for end in (min(fitting), max(fitting)))
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
