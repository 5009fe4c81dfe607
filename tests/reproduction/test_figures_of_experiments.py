"""Figures of the experiments: what they draw of known data; the notebooks draw them all."""

import inspect

import numpy as np
import pytest
import xarray as xr
from captures import FILMS
from matplotlib.figure import Figure
from sketches import array

from reproduction import figures


def draw_compared(fill: float = 1.0) -> Figure:
    """Draw two maps of the reflection at two times."""
    movie = fill * array("time y x", 2, 5, 6)
    return figures.comparison.compared_reflections(movie, movie, array("time", 2) - 300.5)


def draw_condition(fill: float = 1.0) -> Figure:
    """Draw the condition number of a pair of bands, infinite on the diagonal."""
    matrix = fill * array("first second", 2, 2)
    matrix = matrix.where(matrix["first"] != matrix["second"], np.inf)
    return figures.calibration.condition_matrix(matrix, 9)


def draw_pooled(fill: float = 1.0) -> Figure:
    """Draw the ratios of two materials, one pixel without a label."""
    ratio = fill * array("y x", 5, 6)
    panels = xr.DataArray(np.indices((5, 6))[1] // 3, dims=("y", "x"))
    labels = panels.copy()
    labels[0, 0] = -1
    return figures.comparison.pooled_materials(ratio, ratio, labels, panels)


def separated(fill: float = 1.0) -> xr.Dataset:
    """Temperatures of a scene with their deviations."""
    movie = fill * array("time y x", 2, 5, 6)
    parts = dict.fromkeys(FILMS, movie) | {f"{name}_std": movie - 300 for name in FILMS}
    return xr.Dataset(parts)


def draw_truth(fill: float = 1.0) -> Figure:
    """Draw the truth of a pixel beside its estimate."""
    return figures.scenes.truth_and_estimate(separated(), separated(fill), (1, 2))


def test_film() -> None:
    """A frame a time, of even size, that says what the data are and changes only where it may."""
    movie = array("time y x", 2, 5, 6)
    apparent = array("band time y x", 2, 2, 5, 6, origin="simulated")
    frames = list(figures.scenes.separated_film(apparent, movie, movie - 300, title="scene"))
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
    """Bounds, one of which is missing once, and errors above; below, errors over bounds."""
    over = {"noise": [0.01, 0.03, 0.1], "case": ["known", "free"]}
    bound = np.array([[1.0, 2.0, 4.0], [0.5, 1.0, 2.0]])
    parts: dict[str, tuple[object, np.ndarray]] = {}
    for name in ("reflection_ratio", "object_temperature"):
        parts[f"{name}_error"] = ("noise", 1.2 * bound[0])
        parts[f"{name}_bound"] = (("case", "noise"), bound.copy())
    parts["object_temperature_bound"][1][1, 0] = np.nan
    above, _, below, _ = figures.comparison.error_over_bound(xr.Dataset(parts, over)).axes
    assert [line.get_label() for line in above.lines] == ["known, bound", "free, bound", "measured"]
    assert len(below.lines) == 3
    np.testing.assert_allclose(np.asarray(below.lines[0].get_ydata()), 1.2, rtol=1e-12)


@pytest.mark.parametrize("name", figures.__all__)
def test_a_figure_names_the_kind_of_its_data(name: str) -> None:
    """Simulated data and pictures are called so in the title; that labels have units, see `Run`."""
    assert "provenance_note(" in inspect.getsource(getattr(figures, name))


def test_pictures_beside_the_truth() -> None:
    """Films and truth in one range of colour, then each less the truth; without it, films alone."""
    movie = array("time y x", 2, 5, 6, origin="simulated")
    films, times = {"camera": movie - 2.0, "dbthermal": movie}, [0.0, 1.0]
    figure = figures.scenes.compared_pictures(films, movie, times, "plate")
    pictures = [np.asarray(axis.images[0].get_array()) for axis in figure.axes if axis.images]
    assert len(pictures) == 2 * 5
    np.testing.assert_allclose(pictures[3], -2.0, rtol=0, atol=1e-9)  # K
    np.testing.assert_allclose(pictures[4], 0.0, rtol=0, atol=1e-9)
    alone = figures.scenes.compared_pictures(films, None, times, "plate")
    assert len([axis for axis in alone.axes if axis.images]) == 2 * 2
