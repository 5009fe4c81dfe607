"""Figures of the experiments are drawn with units and name the kind of their data."""

import re
from collections.abc import Callable

import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure
from sketches import BANDS, array, check_measured, titles

from reproduction import figures


def two(dim: str, **attrs: object) -> xr.DataArray:
    """Two values of a and b."""
    return array(dim, 2, **attrs).assign_coords({dim: ["a", "b"]})


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


def draw_descents(**attrs: object) -> Figure:
    """Draw the end of one optimiser, and the course of another."""
    names = ("iteration", "time", "objective", "object_temperature_rmse")
    courses = xr.Dataset({name: array("optimiser look", 2, 3) for name in names}, attrs=attrs)
    courses = courses.assign_coords(optimiser=["a", "b"])
    return figures.descents(courses.where((courses["optimiser"] == "b") | (courses["look"] == 0)))


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


def draw_thermocouples(**attrs: object) -> Figure:
    """Draw the reading and two methods in two scenes."""
    parts = {"reading": array("scene time", 2, 2)}
    parts["temperature"] = array("scene variant time", 2, 2, 2)
    parts["relative_error"] = array("scene variant", 2, 2) - 300
    scores = xr.Dataset(parts, {"scene": ["pot", "glass"], "variant": ["a", "b"]}, attrs)
    return figures.thermocouples(scores)


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


def separated(fill: float = 1.0) -> xr.Dataset:
    """Temperatures of a scene with their deviations."""
    names = ("object_temperature", "background_temperature")
    movie = fill * array("time y x", 2, 5, 6)
    parts = dict.fromkeys(names, movie) | {f"{name}_std": movie - 300 for name in names}
    return xr.Dataset(parts)


def draw_contact(**attrs: object) -> Figure:
    """Draw the emissivities of two materials beside their truth."""
    value = array("material band", 2, 2) - 300
    measured = xr.Dataset({"emissivity": value, "emissivity_std": 0.01 * value}, attrs=attrs)
    return figures.emissivity_by_contact(measured, value)


def draw_bars(**attrs: object) -> Figure:
    """Draw the band emissivities of two materials."""
    table = {"emissivity": array("material band", 2, 2) - 300}
    return figures.emissivity_bars(xr.Dataset(table, attrs=attrs))


def draw_truth(fill: float = 1.0, **attrs: object) -> Figure:
    """Draw the truth of a pixel beside its estimate."""
    return figures.truth_and_estimate(separated().assign_attrs(attrs), separated(fill), (1, 2))


def test_film() -> None:
    """A frame a time, of even size, that says what the data are and changes only where it may."""
    movie = array("time y x", 2, 5, 6)
    apparent = array("band time y x", 2, 2, 5, 6, origin="simulated")
    frames = list(figures.separated_film(apparent, movie, movie - 300, title="scene"))
    assert len(frames) == 2
    assert all(frame.dtype == np.uint8 and frame.shape == frames[0].shape for frame in frames)
    assert frames[0].shape[0] % 2 == frames[0].shape[1] % 2 == 0
    changed = np.any(frames[0] != frames[1], axis=-1)
    assert 0.05 < changed.mean() < 0.6  # the images and the time, not the frame around them


def test_truth_and_estimate_in_celsius() -> None:
    """Kelvin go in, degrees Celsius are drawn."""
    kelvin = separated()["object_temperature"].isel(y=1, x=2)
    estimate, truth = draw_truth().axes[0].lines
    for line in (estimate, truth):
        np.testing.assert_allclose(np.asarray(line.get_ydata()), kelvin - 273.15, rtol=0, atol=1e-9)


def test_temperatures_in_another_unit_are_refused() -> None:
    """Data in degrees Celsius are not drawn as if they were kelvins."""
    movie = array("time y x", 2, 5, 6).assign_attrs(units="degC")
    inputs = array("band time y x", 2, 2, 5, 6)
    with pytest.raises(ValueError, match="Invalid units 'degC' of the emission"):
        next(figures.separated_film(inputs, movie, movie, title="scene"))
    scene = separated()
    celsius = scene.assign(object_temperature=scene["object_temperature"].assign_attrs(units="C"))
    with pytest.raises(ValueError, match="Invalid units 'C' of 'object_temperature' of the result"):
        figures.truth_and_estimate(scene, celsius, (1, 2))


def test_nothing_but_nan() -> None:
    """A figure of nothing but NaN is drawn empty and without a warning."""
    for draw in (draw_compared, draw_condition, draw_pooled, draw_truth):
        figure = draw(fill=np.nan)
        figure.draw_without_rendering()
        assert figure.axes


def test_condition_numbers_of_pairs() -> None:
    """Each pair of different bands has its number, and the bar says what it is."""
    matrix, bar = draw_condition().axes
    expected = array("first second", 2, 2).values[[0, 1], [1, 0]]
    assert [text.get_text() for text in matrix.texts] == [f"{value:.0f}" for value in expected]
    assert bar.get_ylabel() == "condition number [1]"


def test_errors_are_in_units_of_their_bound() -> None:
    """Two bounds and one row of errors above; below an error of 1.2 times its bound at 1.2."""
    above, _, below, _ = draw_over_bound().axes
    assert [line.get_label() for line in above.lines] == ["known, bound", "free, bound", "measured"]
    assert len(below.lines) == 3
    np.testing.assert_allclose(np.asarray(below.lines[0].get_ydata()), 1.2, rtol=1e-12)


DRAWN: dict[str, Callable[..., Figure]] = {
    "accuracy": draw_accuracy,
    "emissivity_bars": draw_bars,
    "emissivity_by_contact": draw_contact,
    "truth_and_estimate": draw_truth,
    "error_bar_calibration": draw_scores,
    "compared_reflections": draw_compared,
    "condition_matrix": draw_condition,
    "error_over_noise": draw_noise,
    "descents": draw_descents,
    "emissivity_errors": draw_emissivity,
    "reductions": lambda **attrs: figures.reductions(two("term", **attrs), [90.0, 5.0]),
    "emissivity_procedures": draw_procedures,
    "thermocouples": draw_thermocouples,
    "error_maps": draw_error_maps,
    "sensitivity": lambda **attrs: figures.sensitivity(two("variant", **attrs), 0.5),
    "error_over_bound": draw_over_bound,
    "error_over_bands": draw_over_bands,
    "pooling": draw_pooling,
    "pooled_materials": draw_pooled,
    "validity": draw_validity,
    "offsets": draw_offsets,
    "disturbances": lambda **attrs: figures.disturbances(treated("nuisance", **attrs)),
    "parallax": lambda **attrs: figures.parallax(treated("parallax", **attrs)),
}
"""How to draw the figure of each function."""


@pytest.mark.parametrize("name", [name for name in figures.__all__ if name != "separated_film"])
def test_figure_of_an_experiment(name: str) -> None:
    """Every figure is drawn without a warning, has units, is its caller's, and says what it shows:
    simulated data and pictures are called so, and measured ones are not.
    """
    figure = DRAWN[name](origin="measured", radiometric=1)
    texts = {text for axis in figure.axes for text in (axis.get_xlabel(), axis.get_ylabel())}
    check_measured(figure, {" ".join(text.split()) for text in texts if text})
    assert texts - {""}
    assert [text for text in texts if text and not re.search(r"\[.+\]$|^own unit$", text)] == []
    if name != "error_bar_calibration":
        assert "(simulated, not radiometric)" in titles(
            DRAWN[name](origin="simulated", radiometric=0)
        )
