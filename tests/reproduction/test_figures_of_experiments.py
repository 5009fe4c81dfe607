"""Figures of the experiments are drawn with units and name the kind of their data."""

from collections.abc import Callable

import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure
from sketches import BANDS, DEGREE, array, check_measured, titles

from reproduction import figures


def draw_accuracy(**attrs: object) -> Figure:
    """Draw the errors of two cases."""
    errors = {"object_temperature_rmse": array("case", 2)}
    sweep = xr.Dataset(errors | {"emissivity_error": array("case band", 2, 2)}, attrs=attrs)
    return figures.accuracy(sweep)


def draw_compared(fill: float = 1.0, **attrs: object) -> Figure:
    """Draw two maps of the reflection at two times."""
    movie = (fill * array("time y x", 2, 5, 6)).assign_attrs(attrs)
    return figures.compared_reflections(movie, movie, array("time", 2) - 300.5)


def draw_scores(**attrs: object) -> Figure:
    """Draw the scores of two quantities."""
    parts = {"object_temperature": array("pixel", 50) - 300, "k2": array("pixel", 50) - 301}
    scores = {name: part.assign_attrs(attrs) for name, part in parts.items()}
    return figures.error_bar_calibration(scores)


def draw_noise(**attrs: object) -> Figure:
    """Draw the errors of two methods on two materials, one of them missing once."""
    errors = array("material noise variant", 2, 3, 2, **attrs).assign_coords(noise=[0.01, 0.1, 1.0])
    errors[0, 2, 1] = np.nan
    return figures.error_over_noise(errors, title="sweep")


def draw_emissivity(**attrs: object) -> Figure:
    """Draw the errors of two methods over emissivity and noise."""
    errors = array("variant emissivity noise", 2, 2, 3, **attrs) - 300
    coords = {"noise": [0.01, 0.1, 1.0], "emissivity": [0.3, 0.9], "variant": ["a", "b"]}
    errors = errors.assign_coords(coords).assign_attrs(attrs)
    return figures.emissivity_errors(errors, title="emissivity")


def draw_reductions(**attrs: object) -> Figure:
    """Draw the error reduced by two loss terms."""
    return figures.reductions(array("term", 2, **attrs).assign_coords(term=["a", "b"]), [90.0, 5.0])


def draw_sensitivity(**attrs: object) -> Figure:
    """Draw the error with two settings changed."""
    return figures.sensitivity(array("variant", 2, **attrs).assign_coords(variant=["a", "b"]), 0.5)


def draw_procedures(**attrs: object) -> Figure:
    """Draw the emissivity of two objects by two procedures beside a published one."""
    names = {"object": ["ball", "cup"], "procedure": ["bench", "reflector"], "band": BANDS}
    value = array("object procedure band", 2, 2, 2).assign_coords(names) - 300
    parts = {"true": value.isel(procedure=0, drop=True), "mean": value, "spread": 0.1 * value}
    published = {"the paper": {"ball": 0.1, "cup": 0.2}}
    return figures.emissivity_procedures(xr.Dataset(parts, attrs=attrs), published, "8-14")


def draw_thermocouples(**attrs: object) -> Figure:
    """Draw the reading and two methods in two scenes."""
    names = {"scene": ["pot", "glass"], "variant": ["a", "b"]}
    parts = {
        "reading": array("scene time", 2, 2),
        "temperature": array("scene variant time", 2, 2, 2),
        "relative_error": array("scene variant", 2, 2) - 300,
    }
    scores = xr.Dataset(parts).assign_coords(names).assign_attrs(attrs)
    scores["relative_error"] = scores["relative_error"].where(
        scores["variant"] != attrs.get("lost")
    )
    return figures.thermocouples(scores)


def draw_error_maps(fill: float = 1.0, **attrs: object) -> Figure:
    """Draw the errors of two methods over an image."""
    error = (fill * (array("y x", 5, 6) - 300)).assign_attrs(attrs)
    return figures.error_maps(array("y x", 5, 6), {"a": error, "b": 2 * error})


def draw_over_bound(**attrs: object) -> Figure:
    """Draw errors at three noise levels beside two bounds, one of which is missing once."""
    over = {"noise": [0.01, 0.03, 0.1], "case": ["free", "known"]}
    parts = {}
    for name in ("reflection_ratio", "object_temperature"):
        parts[f"{name}_error"] = array("noise", 3) - 299
        parts[f"{name}_bound"] = array("case noise", 2, 3).assign_coords(case=over["case"]) - 299
    measured = xr.Dataset(parts).assign_coords(over).assign_attrs(attrs)
    measured["object_temperature_bound"][1, 0] = np.nan
    return figures.error_over_bound(measured)


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
    stress = xr.Dataset(
        {
            "status": (("case", "pixel"), [[0, 0, 4], [0, 0, 0]]),
            "bad": (("case", "kind", "pixel"), [[[False, True, True]], [[False] * 3]]),
            "object_coverage": (("case", "among"), [[0.95], [0.2]]),
            "emissivity_coverage": (("case", "among", "band"), [[[0.95, 0.9]], [[1.0, 0.97]]]),
        },
        {"case": ["a", "b"], "kind": ["any"], "band": BANDS},
        attrs,
    )
    labels = {"object_coverage": ["unflagged"], "emissivity_coverage": ["all"]}
    parts = {name: stress[name].assign_coords(among=label) for name, label in labels.items()}
    both = {name: part.reindex(among=["unflagged", "all"]) for name, part in parts.items()}
    return figures.validity(stress.drop_dims("among").assign(both))


def treated(over: str, *names: str, **attrs: object) -> xr.Dataset:
    """Errors of two treatments over two values."""
    values = {"delay": [0.0, 1.0], "parallax": [0.0, 2.0], "nuisance": ["lost", "shutter"]}
    here = array(f"{over} treatment", 2, 2) - 299
    coords = {over: values[over], "treatment": ["as recorded", "undone"]}
    parts = dict.fromkeys(("object_temperature_rmse", *names), here - 0.5)
    return xr.Dataset(parts).assign_coords(coords).assign_attrs(attrs)


def draw_offsets(**attrs: object) -> Figure:
    """Draw two offsets as found, and what undoing them is worth."""
    measured = treated("delay", "flagged", **attrs)
    return figures.offsets(measured.assign(found=("delay", [0.01, 0.98])))


def draw_disturbances(**attrs: object) -> Figure:
    """Draw two nuisances."""
    return figures.disturbances(treated("nuisance", "flagged", **attrs))


def draw_parallax(**attrs: object) -> Figure:
    """Draw two views, one of them with a missing value."""
    measured = treated("parallax", "flagged", "covered", **attrs)
    measured["covered"][1, 0] = np.nan
    return figures.parallax(measured)


DRAWN: dict[str, tuple[Callable[..., Figure], set[str]]] = {
    "accuracy": (
        draw_accuracy,
        {"median RMSE of the object temperature [K]", "median error of the emissivity [1]"},
    ),
    "error_bar_calibration": (draw_scores, {"density [1]", "error / standard deviation [1]"}),
    "compared_reflections": (draw_compared, {"own unit", "time [s]", "correlation [1]"}),
    "error_over_noise": (draw_noise, {"median error [K]", "noise of the quieter band [K]"}),
    "emissivity_errors": (
        draw_emissivity,
        {"error [1]", "noise of the quieter band [K]", "emissivity, 8-14 \N{MICRO SIGN}m [1]"},
    ),
    "reductions": (draw_reductions, {"reduction of the error by the term [%]"}),
    "emissivity_procedures": (
        draw_procedures,
        {"emissivity, 8-14 \N{MICRO SIGN}m [1]"},
    ),
    "thermocouples": (draw_thermocouples, {"time [s]", f"object temperature [{DEGREE}]"}),
    "error_maps": (draw_error_maps, {f"apparent [{DEGREE}]", "mean error [K]"}),
    "sensitivity": (draw_sensitivity, {"median error of the object temperature [K]"}),
    "error_over_bound": (
        draw_over_bound,
        {
            "error of the reflection ratio [1]",
            "error of the object temperature [K]",
            "error / bound [1]",
            "noise of the quieter band [K]",
        },
    ),
    "error_over_bands": (
        draw_over_bands,
        {"error of the object temperature [K]", "error / bound [1]", "bands [\N{MICRO SIGN}m]"},
    ),
    "pooling": (
        draw_pooling,
        {
            "error of the reflection ratio [1]",
            "error of the object temperature [K]",
            "pixels of one material [1]",
        },
    ),
    "pooled_materials": (draw_pooled, {"reflection ratio [1]"}),
    "validity": (
        draw_validity,
        {"share of the pixels [%]", "95 % intervals that hold the truth [%]"},
    ),
    "offsets": (
        draw_offsets,
        {
            "error of the offset [frame]",
            "RMSE of the object temperature [K]",
            "flagged [%]",
            "offset of the second band [frame]",
        },
    ),
    "disturbances": (draw_disturbances, {"RMSE of the object temperature [K]"}),
    "parallax": (
        draw_parallax,
        {
            "RMSE of the object temperature [K]",
            "flagged [%]",
            "95 % intervals that hold, no flag [%]",
            "parallax of the reflection [pixel]",
        },
    ),
}
"""Name of each function -> how to draw it, and the labels of its axes and bars."""


def test_every_figure_of_the_experiments_is_tested() -> None:
    """The list above is complete."""
    assert {*figures.__all__} == DRAWN.keys()


@pytest.mark.parametrize("name", DRAWN)
def test_figure_of_an_experiment(name: str) -> None:
    """A figure of measured data is drawn without a warning, has units, and is its caller's."""
    draw, labels = DRAWN[name]
    check_measured(draw(origin="measured", radiometric=1), labels)


@pytest.mark.parametrize("name", sorted(DRAWN.keys() - {"error_bar_calibration"}))
def test_title_says_what_the_data_are(name: str) -> None:
    """Simulated data and pictures are called so."""
    draw, _ = DRAWN[name]
    assert "(simulated, not radiometric)" in titles(draw(origin="simulated", radiometric=0))


@pytest.mark.parametrize("name", ["compared_reflections", "pooled_materials"])
def test_nothing_but_nan(name: str) -> None:
    """A figure of nothing but NaN is drawn empty and without a warning."""
    figure = DRAWN[name][0](fill=np.nan)
    figure.draw_without_rendering()
    assert figure.axes


def test_errors_without_a_case_are_drawn_once() -> None:
    """Two bounds, and one row of errors above; two rows in units of them, and 1, below."""
    above, _, below, _ = draw_over_bound().axes
    assert [line.get_label() for line in above.lines] == ["free, bound", "known, bound", "measured"]
    assert len(below.lines) == 3


def test_bars_say_what_is_flagged() -> None:
    """Each treatment of each nuisance has its error and its share as text."""
    (axis,) = draw_disturbances().axes
    found = treated("nuisance", "flagged").transpose("treatment", "nuisance")
    pairs = zip(
        found["object_temperature_rmse"].values.flat, found["flagged"].values.flat, strict=True
    )
    expected = [f"{error:.2f} K\n{100 * share:.0f} % flagged" for error, share in pairs]
    assert [text.get_text() for text in axis.texts] == expected


def test_a_method_without_a_value_says_so() -> None:
    """In the legend, in place of its error."""
    legend = draw_thermocouples(lost="b").axes[0].get_legend()
    assert legend is not None
    texts = [text.get_text() for text in legend.get_texts()]
    assert texts[1] == "b, no value"
    assert texts[0].endswith(" %")


def test_errors_are_in_units_of_their_bound() -> None:
    """An error of 1.2 times its bound is drawn at 1.2."""
    level = {"noise": [0.01, 0.03, 0.1]}
    parts = {
        f"{name}_{kind}": ("noise", scale * np.array([1.0, 2.0, 4.0]))
        for name in ("reflection_ratio", "object_temperature")
        for kind, scale in (("bound", 0.1), ("error", 0.12))
    }
    figure = figures.error_over_bound(xr.Dataset(parts, level))
    ratio = np.asarray(figure.axes[2].lines[0].get_ydata())
    np.testing.assert_allclose(ratio, 1.2, rtol=1e-12)
