"""Figures: each draws its arguments, labels them with a unit, and says what the data are."""

from collections.abc import Callable
from itertools import combinations

import numpy as np
import pytest
import xarray as xr
from matplotlib import style
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from sketches import BANDS, DEGREE, array, check_measured, titles

from dbthermal import emissivity, figures, limits
from dbthermal.figures import drawing
from reproduction import figures as drawings

LABELS = ("input [1]", "emission [1]", "reflection [1]")
SHIFTS = ("shift down [pixel]", "shift right [pixel]")


def correction(fill: float = 1.0, **attrs: object) -> xr.Dataset:
    """Gain and offset of two bands with one bad pixel, or all of them bad."""
    maps = fill * array("band y x", 2, 5, 6)
    bad = xr.zeros_like(maps, dtype=bool)
    bad[0, 1, 2] = True
    return xr.Dataset({"gain": maps, "offset": maps, "bad": bad}, attrs=attrs)


def draw_maps(fill: float = 1.0, **attrs: object) -> Figure:
    """Draw gain and offset."""
    return drawings.calibration.gain_offset_maps(correction(fill, **attrs))


def draw_response(**attrs: object) -> Figure:
    """Draw a response at five temperatures."""
    temperature = np.linspace(290.0, 330.0, 5)
    names = {"band": BANDS, "temperature": temperature}
    counts = xr.DataArray([115 * temperature, 11 * temperature], names)
    pair = {"linear_slope": ("band", [115.0, 11.0]), "linear_intercept": ("band", [0.0, 0.0])}
    parts = {"counts": counts, "residual": 0 * counts, "linear_residual": 0 * counts}
    return drawings.calibration.response_fit(xr.Dataset(parts | pair, attrs=attrs), counts)


def draw_frames(fill: float = 1.0, **attrs: object) -> Figure:
    """Draw the inputs, emission and reflection of two times."""
    inputs = (fill * array("band time y x", 2, 2, 5, 6)).assign_attrs(attrs)
    movie = fill * array("time y x", 2, 5, 6)
    return figures.separated_frames(inputs, movie, movie - 300, title="scene", labels=LABELS)


def draw_temperatures(**attrs: object) -> Figure:
    """Draw the same as temperatures."""
    movie = array("time y x", 2, 5, 6)
    apparent = array("band time y x", 2, 2, 5, 6, **attrs)
    return figures.separated_temperatures(apparent, movie, movie - 300, title="scene")


def draw_plan(**attrs: object) -> Figure:
    """Draw the expected accuracy of two materials by filter and by length of the film."""
    names = {"material": ["glass", "slate"], "filter": ["9.5", "10.6"]}
    std = array("material filter", 2, 2).assign_coords(names) - 300
    best = xr.DataArray(["9.5", "none"], dims="material", coords={"material": names["material"]})
    expected = xr.Dataset({"object_temperature_std": std, "best": best})
    longer = std.expand_dims(seconds=[10.0, 20.0]).to_dataset(name="object_temperature_std")
    return figures.plan(expected.assign_attrs(beside="8-14", **attrs), longer, names["material"])


def draw_reasons(**attrs: object) -> Figure:
    """Draw a map of two flags in words."""
    flags = {"status": (("y", "x"), [[0, 1, 4], [5, 0, 0]])}
    return figures.status(xr.Dataset(flags, attrs=attrs))


def draw_shift(fill: float = 1.0, **attrs: object) -> Figure:
    """Draw a shift that is known at all pixels but one, where it is extrapolated."""
    shift = (fill * array("axis y x", 2, 5, 6)).assign_coords(axis=["y", "x"])
    known = xr.ones_like(shift[0], dtype=bool)
    known[1, 2] = False
    field = {"shift": shift, "shift_std": abs(0.1 * shift), "known": known}
    bands = {"reference_band": BANDS[0], "bands": list(BANDS[1:])}
    return figures.reflection_shift(xr.Dataset(field, attrs={**attrs, **bands}))


KELVINS = (f"apparent [{DEGREE}]", f"object [{DEGREE}]", "background change [K]")
RESIDUALS = ("residual of the line [K]", "residual of the curve [mK]")
FILTER = "filter beside 8-14 [\N{MICRO SIGN}m]"
DRAWN: dict[str, tuple[Callable[..., Figure], tuple[str, ...]]] = {
    "gain_offset_maps": (draw_maps, ("gain [1]", "offset [count]")),
    "response_fit": (
        draw_response,
        ("signal [count]", *RESIDUALS, f"blackbody temperature [{DEGREE}]"),
    ),
    "separated_frames": (draw_frames, LABELS),
    "separated_temperatures": (draw_temperatures, KELVINS),
    "reflection_shift": (draw_shift, (*SHIFTS, "standard deviation [pixel]")),
    "plan": (draw_plan, (FILTER, "length of the film [s]", "expected std [K]")),
    "status": (draw_reasons, ()),
}
"""Name of each function -> how to draw it, and the labels of its axes and bars."""


def test_every_figure_is_tested() -> None:
    """The table of figures above holds every public figure."""
    elsewhere = {"FilmPanel", "Panel", "REASONS", "drawing", "film", "live"}
    of_notebook_1 = {"gain_offset_maps", "response_fit"}
    assert {*figures.__all__} - elsewhere | of_notebook_1 == DRAWN.keys()


@pytest.mark.parametrize("name", DRAWN)
def test_figure(name: str) -> None:
    """Drawn without a warning, with units, its caller's; the title names simulated data."""
    draw, labels = DRAWN[name]
    check_measured(draw(origin="measured", radiometric=1), {*labels})
    assert "(simulated, not radiometric)" in titles(draw(origin="simulated", radiometric=0))


@pytest.mark.parametrize("name", ["gain_offset_maps", "separated_frames"])
def test_nothing_but_nan(name: str) -> None:
    """A figure of nothing but NaN is drawn empty and without a warning."""
    figure = DRAWN[name][0](fill=np.nan)
    figure.draw_without_rendering()
    assert figure.axes


def test_labels_of_bands() -> None:
    """Wavelengths have their unit; a free name of a band is none."""
    assert [*map(drawing.band_label, ("8-14", 9.5, "wide"))] == [
        "8-14 \N{MICRO SIGN}m",
        "9.5 \N{MICRO SIGN}m",
        "wide",
    ]


def test_celsius_on_the_axes() -> None:
    """Kelvin go in, degrees Celsius are drawn."""
    image = draw_temperatures().axes[0].images[0].get_array()
    apparent = array("band time y x", 2, 2, 5, 6)[0, 0] - 273.15
    np.testing.assert_allclose(np.asarray(image), apparent, rtol=0, atol=1e-9)


def test_bad_pixels_are_marked() -> None:
    """The bad pixel is blank, crossed at its column and row, and counted."""
    axis = drawings.calibration.gain_offset_maps(correction()).axes[0]
    image = axis.images[0].get_array()
    assert image is not None
    assert np.argwhere(np.ma.getmaskarray(image)).tolist() == [[1, 2]]
    np.testing.assert_array_equal(axis.lines[0].get_xydata(), [[2, 1]])
    assert "1 bad pixel" in axis.get_title()


def test_plan_frames_the_best_filter() -> None:
    """The best filter of each material is framed; a material without one has no line."""
    table = emissivity.embedded_table()
    noise = emissivity.filter_noise(0.03, table["band"].values.tolist())
    table = table.sel(material=["plate window glass", "brass plate", "water"])
    expected = limits.plan(table, noise)
    durations = limits.plan_durations(table, noise, [20.0, 40.0])
    axes = figures.plan(expected, durations, ["plate window glass", "brass plate"]).axes
    framed = [text.get_text() for text in axes[0].texts if text.get_bbox_patch()]
    assert framed == [f"{v:.2g}" for v in expected["object_temperature_std"].min("filter")[::2]]
    assert len(axes[1].lines) == 1


def test_style_of_a_journal() -> None:
    """A wide figure is as wide as a page, a narrow one as it was, and letters are of 7 points."""
    plain = drawing.canvas(1, 4, (13.2, 3.0))[0]
    with style.context("dbthermal.figures.publication"):
        wide, narrow = drawing.canvas(1, 4, (13.2, 3.0))[0], drawing.canvas(1, 1, (3.5, 2.6))[0]
        letters = narrow.axes[0].xaxis.label.get_fontsize()
    np.testing.assert_allclose(plain.get_size_inches(), (13.2, 3.0))
    np.testing.assert_allclose(wide.get_size_inches(), (7.2, 3.0 * 7.2 / 13.2))
    np.testing.assert_allclose(narrow.get_size_inches(), (3.5, 2.6))
    assert letters == 7


# Machado, Oliveira and Fernandes 2009, doi:10.1109/TVCG.2009.113: linear RGB as it is seen by
# protanopes and deuteranopes.
SEEN = {
    "protanopia": "0.1521 1.0526 -0.2046 0.1148 0.7862 0.0990 -0.0039 -0.0481 1.0520",
    "deuteranopia": "0.3673 0.8606 -0.2280 0.2801 0.6727 0.0472 -0.0118 0.0429 0.9689",
}


@pytest.mark.parametrize("matrix", SEEN.values(), ids=SEEN)
def test_colours_are_told_apart_by_the_colour_blind(matrix: str) -> None:
    """Any two colours of bands differ by ten just noticeable steps in CIELAB, as they are seen."""
    color = pytest.importorskip("skimage.color")
    rgb = np.array([to_rgb(one) for one in drawing.COLORS])
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(linear @ np.reshape([*map(float, matrix.split())], (3, 3)).T, 0.0, 1.0)
    companded = np.where(seen <= 0.0031308, 12.92 * seen, 1.055 * seen ** (1 / 2.4) - 0.055)
    lab = color.rgb2lab(companded)
    pairs = combinations(range(len(lab)), 2)
    steps = [float(np.linalg.norm(lab[one] - lab[other])) for one, other in pairs]
    assert min(steps) > 10
