"""Figures of the experiments are drawn with units and name the kind of their data."""

from collections.abc import Callable

import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure
from sketches import BANDS, DEGREE, array, check_measured, titles

from reproduction import figures

NOISE = "noise of the quieter band [K]"
OBJECT, RMSE = "error of the object temperature [K]", "RMSE of the object temperature [K]"
RATIO = "error of the reflection ratio [1]"


def draw_accuracy(**attrs: object) -> Figure:
    """Draw the errors of two cases."""
    errors = {"object_temperature_rmse": array("case", 2)}
    sweep = xr.Dataset(errors | {"emissivity_error": array("case band", 2, 2)}, attrs=attrs)
    return figures.accuracy(sweep)


def draw_compared(fill: float = 1.0, **attrs: object) -> Figure:
    """Draw two maps of the reflection at two times."""
    movie = (fill * array("time y x", 2, 5, 6)).assign_attrs(attrs)
    return figures.compared_reflections(movie, movie, array("time", 2) - 300.5)


def draw_condition(fill: float = 1.0, **attrs: object) -> Figure:
    """Draw the condition number of a pair of bands, infinite on the diagonal."""
    matrix = fill * array("first second", 2, 2, **attrs)
    return figures.condition_matrix(matrix.where(matrix["first"] != matrix["second"], np.inf), 9)


def draw_scores(**attrs: object) -> Figure:
    """Draw the scores of two quantities."""
    parts = {"object_temperature": array("pixel", 50) - 300, "k2": array("pixel", 50) - 301}
    return figures.error_bar_calibration({n: part.assign_attrs(attrs) for n, part in parts.items()})


def draw_noise(**attrs: object) -> Figure:
    """Draw the errors of two methods on two materials, one of them missing once."""
    errors = array("material noise variant", 2, 3, 2, **attrs).assign_coords(noise=[0.01, 0.1, 1.0])
    errors[0, 2, 1] = np.nan
    return figures.error_over_noise(errors, title="sweep")


def draw_emissivity(**attrs: object) -> Figure:
    """Draw the errors of two methods over emissivity and noise."""
    coords = {"noise": [0.01, 0.1, 1.0], "emissivity": [0.3, 0.9], "variant": ["a", "b"]}
    errors = (array("variant emissivity noise", 2, 2, 3) - 300).assign_coords(coords)
    return figures.emissivity_errors(errors.assign_attrs(attrs), title="emissivity")


def draw_procedures(**attrs: object) -> Figure:
    """Draw the emissivity of two objects by two procedures beside a published one."""
    names = {"object": ["ball", "cup"], "procedure": ["bench", "reflector"], "band": BANDS}
    value = array("object procedure band", 2, 2, 2).assign_coords(names) - 300
    parts = {"true": value.isel(procedure=0, drop=True), "mean": value, "spread": 0.1 * value}
    published = {"the paper": {"ball": 0.1, "cup": 0.2}}
    return figures.emissivity_procedures(xr.Dataset(parts, attrs=attrs), published, "8-14")


def draw_thermocouples(lost: str = "", **attrs: object) -> Figure:
    """Draw the reading and two methods in two scenes."""
    parts = {"reading": array("scene time", 2, 2)}
    parts["temperature"] = array("scene variant time", 2, 2, 2)
    parts["relative_error"] = array("scene variant", 2, 2) - 300
    scores = xr.Dataset(parts, {"scene": ["pot", "glass"], "variant": ["a", "b"]}, attrs)
    kept = scores["relative_error"].where(scores["variant"] != lost)
    return figures.thermocouples(scores.assign(relative_error=kept))


def draw_error_maps(**attrs: object) -> Figure:
    """Draw the errors of two methods over an image."""
    error = (array("y x", 5, 6) - 300).assign_attrs(attrs)
    return figures.error_maps(array("y x", 5, 6), {"a": error, "b": 2 * error})


def draw_over_bound(**attrs: object) -> Figure:
    """Draw errors of 1.2 times one of two bounds, the other of which is missing once."""
    over = {"noise": [0.01, 0.03, 0.1], "case": ["known", "free"]}
    bound = np.array([[1.0, 2.0, 4.0], [0.5, 1.0, 2.0]])
    parts: dict[str, tuple[object, np.ndarray]] = {}
    for name in ("reflection_ratio", "object_temperature"):
        parts[f"{name}_error"] = ("noise", 1.2 * bound[0])
        parts[f"{name}_bound"] = (("case", "noise"), bound.copy())
    parts["object_temperature_bound"][1][1, 0] = np.nan
    return figures.error_over_bound(xr.Dataset(parts, over, attrs))


def draw_over_bands(**attrs: object) -> Figure:
    """Draw the errors of two and three bands beside two bounds."""
    bound = array("case bands", 2, 2) - 300
    parts = {"object_temperature_error": bound.isel(case=0, drop=True)}
    measured = xr.Dataset(parts | {"object_temperature_bound": bound}, attrs=attrs)
    return figures.error_over_bands(measured.assign_coords(bands=["a + b", "a + b + c"]))


def draw_pooling(**attrs: object) -> Figure:
    """Draw the errors of groups of three sizes."""
    kinds = ("reflection_ratio_error", "reflection_ratio_bound", "stated")
    parts = dict.fromkeys((*kinds, "object_temperature_error"), array("size", 3) - 299)
    return figures.pooling(xr.Dataset(parts, {"size": [1, 4, 25]}, attrs))


def draw_pooled(fill: float = 1.0, **attrs: object) -> Figure:
    """Draw the ratios of two materials, one pixel without a label."""
    ratio = (fill * array("y x", 5, 6)).assign_attrs(attrs)
    panels = xr.DataArray(np.indices((5, 6))[1] // 3, dims=("y", "x"))
    labels = panels.copy()
    labels[0, 0] = -1
    return figures.pooled_materials(ratio, ratio, labels, panels)


def draw_validity(**attrs: object) -> Figure:
    """Draw two cases, one of them without flags and errors."""
    nothing = [[[np.nan] * 2, [0.95, 0.9]], [[np.nan] * 2, [1.0, 0.97]]]
    parts = {
        "status": (("case", "pixel"), [[0, 0, 4], [0, 0, 0]]),
        "bad": (("case", "kind", "pixel"), [[[False, True, True]], [[False] * 3]]),
        "object_coverage": (("case", "among"), [[0.95, np.nan], [0.2, np.nan]]),
        "emissivity_coverage": (("case", "among", "band"), nothing),
    }
    coords = {"case": ["a", "b"], "kind": ["any"], "band": BANDS, "among": ["unflagged", "all"]}
    return figures.validity(xr.Dataset(parts, coords, attrs))


def treated(over: str, **attrs: object) -> xr.Dataset:
    """Errors of two treatments over two values, one share missing."""
    values = {"delay": [0.0, 1.0], "parallax": [0.0, 2.0], "nuisance": ["lost", "shutter"]}
    coords = {over: values[over], "treatment": ["as recorded", "undone"]}
    part = (array(f"{over} treatment", 2, 2) - 299.5).assign_coords(coords)
    measured = xr.Dataset(dict.fromkeys(("object_temperature_rmse", "flagged"), part), attrs=attrs)
    return measured.assign(covered=part.where(part["treatment"] == "undone"))


def draw_offsets(**attrs: object) -> Figure:
    """Draw two offsets as found, and what undoing them is worth."""
    return figures.offsets(treated("delay", **attrs).assign(found=("delay", [0.01, 0.98])))


DRAWN: dict[str, tuple[Callable[..., Figure], set[str]]] = {
    "accuracy": (
        draw_accuracy,
        {"median RMSE of the object temperature [K]", "median error of the emissivity [1]"},
    ),
    "error_bar_calibration": (draw_scores, {"density [1]", "error / standard deviation [1]"}),
    "compared_reflections": (draw_compared, {"own unit", "time [s]", "correlation [1]"}),
    "condition_matrix": (draw_condition, {"condition number [1]"}),
    "error_over_noise": (draw_noise, {"median error [K]", NOISE}),
    "emissivity_errors": (
        draw_emissivity,
        {"error [1]", NOISE, "emissivity, 8-14 \N{MICRO SIGN}m [1]"},
    ),
    "reductions": (
        lambda **attrs: figures.reductions(
            array("term", 2, **attrs).assign_coords(term=["a", "b"]), [90.0, 5.0]
        ),
        {"reduction of the error by the term [%]"},
    ),
    "emissivity_procedures": (draw_procedures, {"emissivity, 8-14 \N{MICRO SIGN}m [1]"}),
    "thermocouples": (draw_thermocouples, {"time [s]", f"object temperature [{DEGREE}]"}),
    "error_maps": (draw_error_maps, {f"apparent [{DEGREE}]", "mean error [K]"}),
    "sensitivity": (
        lambda **attrs: figures.sensitivity(
            array("variant", 2, **attrs).assign_coords(variant=["a", "b"]), 0.5
        ),
        {"median error of the object temperature [K]"},
    ),
    "error_over_bound": (draw_over_bound, {RATIO, OBJECT, "error / bound [1]", NOISE}),
    "error_over_bands": (
        draw_over_bands,
        {OBJECT, "error / bound [1]", "bands [\N{MICRO SIGN}m]"},
    ),
    "pooling": (draw_pooling, {RATIO, OBJECT, "pixels of one material [1]"}),
    "pooled_materials": (draw_pooled, {"reflection ratio [1]"}),
    "validity": (
        draw_validity,
        {"share of the pixels [%]", "95 % intervals that hold the truth [%]"},
    ),
    "offsets": (
        draw_offsets,
        {
            "error of the offset [frame]",
            RMSE,
            "flagged [%]",
            "offset of the second band [frame]",
        },
    ),
    "disturbances": (lambda **attrs: figures.disturbances(treated("nuisance", **attrs)), {RMSE}),
    "parallax": (
        lambda **attrs: figures.parallax(treated("parallax", **attrs)),
        {
            RMSE,
            "flagged [%]",
            "95 % intervals that hold, no flag [%]",
            "parallax of the reflection [pixel]",
        },
    ),
}
"""Name of each function -> how to draw it, and the labels of its axes and bars."""


@pytest.mark.parametrize("name", figures.__all__)
def test_figure_of_an_experiment(name: str) -> None:
    """Every figure is drawn without a warning, has units, is its caller's, and says what it shows:
    simulated data and pictures are called so, and measured ones are not.
    """
    draw, labels = DRAWN[name]
    check_measured(draw(origin="measured", radiometric=1), labels)
    if name != "error_bar_calibration":
        assert "(simulated, not radiometric)" in titles(draw(origin="simulated", radiometric=0))


@pytest.mark.parametrize("draw", [draw_compared, draw_condition, draw_pooled])
def test_nothing_but_nan(draw: Callable[..., Figure]) -> None:
    """A figure of nothing but NaN is drawn empty and without a warning."""
    figure = draw(fill=np.nan)
    figure.draw_without_rendering()
    assert figure.axes


def test_errors_are_in_units_of_their_bound() -> None:
    """Two bounds and one row of errors above; below an error of 1.2 times its bound at 1.2."""
    above, _, below, _ = draw_over_bound().axes
    assert [line.get_label() for line in above.lines] == ["known, bound", "free, bound", "measured"]
    assert len(below.lines) == 3
    np.testing.assert_allclose(np.asarray(below.lines[0].get_ydata()), 1.2, rtol=1e-12)


def test_bars_say_what_is_flagged() -> None:
    """Each treatment of each nuisance has its error and its share as text."""
    (axis,) = figures.disturbances(treated("nuisance")).axes
    values = treated("nuisance").transpose("treatment", "nuisance")["flagged"].values.flat
    expected = [f"{value:.2f} K\n{100 * value:.0f} % flagged" for value in values]
    assert [text.get_text() for text in axis.texts] == expected


def test_a_method_without_a_value_says_so() -> None:
    """In the legend, in place of its error."""
    legend = draw_thermocouples(lost="b").axes[0].get_legend()
    assert legend is not None
    first, second = (text.get_text() for text in legend.get_texts()[:2])
    assert second == "b, no value"
    assert first.endswith(" %")
