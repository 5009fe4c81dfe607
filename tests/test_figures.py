"""Figures: each draws what it is given, labels it with a unit, and says what the data are."""

from collections.abc import Callable

import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure

from dbthermal import figures, schema

BANDS = ["8-14", "9.5"]
TIME = np.arange(2.0)
DEGREE = "\N{DEGREE SIGN}C"


def array(dims: str, *shape: int, **attrs: object) -> xr.DataArray:
    """Random values from 300 to 301 with bands, times and materials named."""
    values = 300.0 + np.random.default_rng(1).random(shape)
    names = {"band": BANDS, "time": TIME, "material": ["glass", "slate"], "case": ["a", "b"]}
    names |= {"first": BANDS, "second": BANDS}
    coords = {dim: names[dim] for dim in dims.split() if dim in names}
    return xr.DataArray(values, dims=dims.split(), coords=coords, attrs=attrs)


def correction(fill: float = 1.0, **attrs: object) -> xr.Dataset:
    """Gain and offset of two bands with one bad pixel, or all of them bad."""
    maps = fill * array("band y x", 2, 5, 6)
    bad = xr.zeros_like(maps, dtype=bool)
    bad[0, 1, 2] = True
    return xr.Dataset({"gain": maps, "offset": maps, "bad": bad}, attrs=attrs)


def draw_response(**attrs: object) -> Figure:
    """Draw a response at five temperatures."""
    temperature = np.linspace(290.0, 330.0, 5)
    counts = xr.DataArray(
        [115 * temperature, 11 * temperature],
        dims=("band", "temperature"),
        coords={"band": BANDS, "temperature": temperature},
    )
    pair = {"linear_slope": ("band", [115.0, 11.0]), "linear_intercept": ("band", [0.0, 0.0])}
    parts = {"counts": counts, "residual": 0 * counts, "linear_residual": 0 * counts}
    return figures.response_fit(xr.Dataset(parts | pair, attrs=attrs), counts)


def separated(fill: float = 1.0) -> xr.Dataset:
    """Temperatures of a scene with their deviations."""
    names = ("object_temperature", "background_temperature")
    movie = fill * array("time y x", 2, 5, 6)
    parts = dict.fromkeys(names, movie) | {f"{name}_std": movie - 300 for name in names}
    return xr.Dataset(parts)


def draw_accuracy(**attrs: object) -> Figure:
    """Draw the errors of two cases."""
    errors = {"object_temperature_rmse": array("case", 2)}
    sweep = xr.Dataset(errors | {"emissivity_error": array("case band", 2, 2)}, attrs=attrs)
    return figures.accuracy(sweep)


def draw_contact(**attrs: object) -> Figure:
    """Draw the emissivities of two materials beside their truth."""
    value = array("material band", 2, 2) - 300
    measured = xr.Dataset({"emissivity": value, "emissivity_std": 0.01 * value}, attrs=attrs)
    return figures.emissivity_by_contact(measured, value)


def draw_frames(fill: float = 1.0, **attrs: object) -> Figure:
    """Draw the inputs, emission and reflection of two times."""
    inputs = (fill * array("band time y x", 2, 2, 5, 6)).assign_attrs(attrs)
    movie = fill * array("time y x", 2, 5, 6)
    labels = ("input [1]", "emission [1]", "reflection [1]")
    return figures.separated_frames(inputs, movie, movie - 300, title="scene", labels=labels)


def draw_temperatures(**attrs: object) -> Figure:
    """Draw the same as temperatures."""
    movie = array("time y x", 2, 5, 6)
    apparent = array("band time y x", 2, 2, 5, 6, **attrs)
    return figures.separated_temperatures(apparent, movie, movie - 300, title="scene")


def draw_compared(fill: float = 1.0, **attrs: object) -> Figure:
    """Draw two maps of the reflection at two times."""
    movie = (fill * array("time y x", 2, 5, 6)).assign_attrs(attrs)
    return figures.compared_reflections(movie, movie, array("time", 2) - 300.5)


def draw_status(**attrs: object) -> Figure:
    """Draw a map with two flags."""
    status = xr.DataArray([[0, 1, 4], [5, 0, 0]], dims=("y", "x"), attrs=attrs)
    return figures.status_map(status, schema.FLAGS)


def draw_bars(**attrs: object) -> Figure:
    """Draw the band emissivities of two materials."""
    table = {"emissivity": array("material band", 2, 2) - 300}
    return figures.emissivity_bars(xr.Dataset(table, attrs=attrs))


def draw_truth(fill: float = 1.0, **attrs: object) -> Figure:
    """Draw the truth of a pixel beside its estimate."""
    return figures.truth_and_estimate(separated().assign_attrs(attrs), separated(fill), (1, 2))


def draw_condition(fill: float = 1.0, **attrs: object) -> Figure:
    """Draw the condition number of a pair of bands, infinite on the diagonal."""
    matrix = fill * array("first second", 2, 2, **attrs)
    return figures.condition_matrix(matrix.where(matrix["first"] != matrix["second"], np.inf), 9)


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
    """Draw what two loss terms are worth."""
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


DRAWN: dict[str, tuple[Callable[..., Figure], set[str]]] = {
    "gain_offset_maps": (
        lambda fill=1.0, **attrs: figures.gain_offset_maps(correction(fill, **attrs)),
        {"gain [1]", "offset [count]"},
    ),
    "response_fit": (
        draw_response,
        {
            "signal [count]",
            "residual of the line [K]",
            "residual of the curve [mK]",
            f"blackbody temperature [{DEGREE}]",
        },
    ),
    "emissivity_by_contact": (draw_contact, {"emissivity [1]"}),
    "emissivity_bars": (draw_bars, {"band emissivity [1]"}),
    "condition_matrix": (draw_condition, {"condition number [1]"}),
    "truth_and_estimate": (
        draw_truth,
        {f"object temperature [{DEGREE}]", f"background temperature [{DEGREE}]", "time [s]"},
    ),
    "accuracy": (
        draw_accuracy,
        {"median RMSE of the object temperature [K]", "median error of the emissivity [1]"},
    ),
    "error_bar_calibration": (draw_scores, {"density [1]", "error / standard deviation [1]"}),
    "separated_frames": (draw_frames, {"input [1]", "emission [1]", "reflection [1]"}),
    "separated_temperatures": (
        draw_temperatures,
        {f"apparent [{DEGREE}]", f"object [{DEGREE}]", "background change [K]"},
    ),
    "compared_reflections": (draw_compared, {"own unit", "time [s]", "correlation [1]"}),
    "status_map": (draw_status, set()),
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
}
"""Name of each function -> how to draw it, and the labels of its axes and bars."""


def titles(figure: Figure) -> str:
    """Everything that stands above a figure and its axes."""
    return "\n".join([figure.get_suptitle(), *(axis.get_title() for axis in figure.axes)])


def test_every_figure_is_tested() -> None:
    """The list above is complete."""
    assert {*figures.__all__} - {"provenance_note", "separated_film"} == DRAWN.keys()


@pytest.mark.parametrize("name", DRAWN)
def test_figure(name: str) -> None:
    """A figure of measured data is drawn without a warning, has units, and is its caller's."""
    draw, labels = DRAWN[name]
    figure = draw(origin="measured", radiometric=1)
    figure.draw_without_rendering()
    found = [text for axis in figure.axes for text in (axis.get_xlabel(), axis.get_ylabel())]
    assert {" ".join(text.split()) for text in found if text} == labels
    assert "simulated" not in titles(figure) or name == "error_bar_calibration"
    assert "radiometric" not in titles(figure)
    assert plt.get_fignums() == []


@pytest.mark.parametrize("name", sorted(DRAWN.keys() - {"error_bar_calibration"}))
def test_title_says_what_the_data_are(name: str) -> None:
    """Simulated data and pictures are called so."""
    draw, _ = DRAWN[name]
    assert "(simulated, not radiometric)" in titles(draw(origin="simulated", radiometric=0))


@pytest.mark.parametrize(
    "name",
    [
        "gain_offset_maps",
        "separated_frames",
        "compared_reflections",
        "truth_and_estimate",
        "condition_matrix",
    ],
)
def test_nothing_but_nan(name: str) -> None:
    """Where no pixel has a value, the empty figure is drawn without a warning."""
    figure = DRAWN[name][0](fill=np.nan)
    figure.draw_without_rendering()
    assert figure.axes


def test_celsius_on_the_axes() -> None:
    """Kelvin go in, degrees Celsius are drawn."""
    kelvin = separated()["object_temperature"].isel(y=1, x=2)
    estimate, truth = draw_truth().axes[0].lines
    for line in (estimate, truth):
        np.testing.assert_allclose(np.asarray(line.get_ydata()), kelvin - 273.15, rtol=0, atol=1e-9)
    image = draw_temperatures().axes[0].images[0].get_array()
    apparent = array("band time y x", 2, 2, 5, 6)[0, 0] - 273.15
    np.testing.assert_allclose(np.asarray(image), apparent, rtol=0, atol=1e-9)


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


def test_a_method_without_a_value_says_so() -> None:
    """In the legend, in place of its error."""
    legend = draw_thermocouples(lost="b").axes[0].get_legend()
    assert legend is not None
    texts = [text.get_text() for text in legend.get_texts()]
    assert texts[1] == "b, no value"
    assert texts[0].endswith(" %")


def test_bad_pixels_are_marked() -> None:
    """The bad pixel is blank, crossed at its column and row, and counted."""
    axis = figures.gain_offset_maps(correction()).axes[0]
    image = axis.images[0].get_array()
    assert image is not None
    assert np.argwhere(np.ma.getmaskarray(image)).tolist() == [[1, 2]]
    np.testing.assert_array_equal(axis.lines[0].get_xydata(), [[2, 1]])
    assert "1 bad pixel" in axis.get_title()


def test_status_map_shows_the_flags_that_occur() -> None:
    """The good pixels, and each flag with its share."""
    found = [axis.get_title().split("\n") for axis in draw_status().axes]
    assert found == [
        ["good", "50.0 %"],
        ["no background motion", "33.3 %"],
        ["gray", "33.3 %"],
    ]
