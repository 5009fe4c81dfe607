"""Error bars and flags of results with known errors, and the figures of validity."""

from collections.abc import Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.colors import to_rgb
from matplotlib.container import BarContainer
from matplotlib.figure import Figure

from dbthermal import schema
from dbthermal.figures import REASONS, status
from dbthermal.simulation import Background, Rig, independent_pixels
from reproduction.experiments import stress
from reproduction.experiments.cases import run_case
from reproduction.figures import validity

TIME = np.arange(350) / 10.0  # s
GLASS: dict[str, Any] = {"case": "glass", "emissivity": [0.86, 0.72], "start": 20, "stop": 45}
PIXELS = 2000


def scene(frames: int = 20, pixels: int = PIXELS) -> xr.Dataset:
    """A scene of glass."""
    pair = xr.DataArray([0.86, 0.72], dims="band", coords={"band": ["8-14", "9.5"]})
    rng = np.random.default_rng(0)
    return independent_pixels(
        TIME[:frames], pair, Background(), pixels, rng, start=300.0, stop=320.0
    )


def normal(truth: xr.Dataset, scale: float = 1.0, seed: int = 1) -> xr.Dataset:
    """The truth with normal errors of 0.1 K and 0.01, said to be `scale` times as large."""
    rng = np.random.default_rng(seed)
    result = truth.drop_vars("background_temperature")
    for name, std in {"object_temperature": 0.1, "emissivity": 0.01}.items():
        result[name] = truth[name] + rng.normal(0.0, std, truth[name].shape)
        result[f"{name}_std"] = xr.full_like(truth[name], scale * std)
    empty = np.zeros((1, truth.sizes["x"]), dtype=np.uint16)
    return result.assign(status=(("y", "x"), empty, schema.status_attrs()))


def with_flag(result: xr.Dataset, name: str, pixels: slice) -> xr.Dataset:
    """The same with a flag set in some pixels."""
    flags = result["status"].copy(deep=True)
    flags[0, pixels] |= schema.Status.bits()[name]
    return result.assign(status=flags)


@pytest.mark.parametrize(("scale", "share"), [(0.5, 0.673), (1.0, 0.95), (2.0, 0.99991)])
def test_normal_errors(scale: float, share: float) -> None:
    """The coverage is that of the normal distribution, the width the bars' own scale."""
    truth = scene()
    found = stress.judge(truth, normal(truth, scale))
    covered, width = found["emissivity_coverage"].values, found["width"].values
    print(f"scale {scale}: object {found['object_coverage'].values}, emissivity {covered}, {width}")
    np.testing.assert_allclose(found["object_coverage"], share, rtol=0, atol=0.006)  # [1]
    np.testing.assert_allclose(covered, share, rtol=0, atol=0.03)  # [1]
    np.testing.assert_allclose(width, scale, rtol=0.06)
    assert float(found["object_temperature_rmse"]) == pytest.approx(0.1, abs=0.005)  # K
    np.testing.assert_allclose(found["emissivity_error"], 0.00674, rtol=0, atol=0.0005)  # [1]


def test_an_unflagged_pixel_is_told_from_all() -> None:
    """Errors in flagged pixels lower the coverage of all, and not of the unflagged."""
    truth = scene()
    result = with_flag(normal(truth), "gray", slice(0, 500))
    off = 1.0 * (truth["x"] < 500)
    result["object_temperature"] = result["object_temperature"] + off  # K
    result["emissivity"] = result["emissivity"] + 0.1 * off
    found = stress.judge(truth, result)
    for name in ("object_coverage", "emissivity_coverage"):
        among = found[name]
        np.testing.assert_allclose(among.sel(among="unflagged"), 0.95, rtol=0, atol=0.02)
        np.testing.assert_allclose(among.sel(among="all"), 0.75 * 0.95, rtol=0, atol=0.02)
    assert float(found["flagged"]) == 0.25


def test_bad_pixels_are_counted_by_kind() -> None:
    """Ten are off in temperature, twenty others in an emissivity; a flag is on 4 and 10 of them."""
    truth = scene(pixels=200)
    result = normal(truth)
    result["object_temperature"][:, 0, :10] = truth["object_temperature"][:, 0, :10] + 0.41  # K
    result["emissivity"][1, 0, 10:30] = truth["emissivity"][1, 0, 10:30] - 0.041
    found = stress.judge(truth, with_flag(result, "constant_object", slice(6, 16)))
    assert found["bad_pixels"].sel(kind="object") == 10
    assert found["bad_pixels"].sel(kind="any") == 30
    np.testing.assert_allclose(found["bad_flagged"], [0.4, 10 / 30], rtol=0, atol=1e-12)
    assert np.flatnonzero(found["bad"].sel(kind="any")).tolist() == list(range(30))


def test_just_below_four_deviations_is_not_bad() -> None:
    """A pixel is bad by its RMS error over time, and not by one frame."""
    truth = scene(pixels=3)
    result = normal(truth)
    result["object_temperature"] = truth["object_temperature"] + 0.399  # K
    result["object_temperature"][0, 0, 0] += 0.2
    result["emissivity"] = truth["emissivity"] + 0.0399
    assert stress.judge(truth, result)["bad"].values.tolist() == [[True] + [False] * 2] * 2


def test_each_flag_has_its_share() -> None:
    """A pixel with two flags counts for both, and once as flagged."""
    truth = scene(pixels=100)
    result = with_flag(normal(truth), "gray", slice(0, 30))
    found = stress.judge(truth, with_flag(result, "saturated", slice(20, 40)))
    shares = {str(name): float(value) for name, value in found["by_flag"].to_series().items()}
    assert shares == dict.fromkeys(schema.Status.bits(), 0.0) | {"gray": 0.3, "saturated": 0.2}
    assert float(found["flagged"]) == 0.4


def test_nothing_to_count() -> None:
    """With every pixel flagged and NaN the shares are NaN and no pixel is bad."""
    truth = scene(pixels=5)
    result = normal(truth)
    values = {name: result[name] * np.nan for name in result.data_vars if name != "status"}
    found = stress.judge(truth, with_flag(result.assign(values), "gray", slice(None)))
    for name in ("object_coverage", "emissivity_coverage", "width", "bad_flagged"):
        assert bool(found[name].isnull().all())
    assert found["bad_pixels"].values.tolist() == [0, 0]
    assert float(found["flagged"]) == 1.0


def test_missing_samples_are_left_out() -> None:
    """A NaN in every other frame and band of a pixel changes no share of the others."""
    truth = scene()
    result = normal(truth)
    result["object_temperature"] = result["object_temperature"].where(result["time"] % 0.2 < 0.05)
    found = stress.judge(truth, result)
    np.testing.assert_allclose(found["object_coverage"], 0.95, rtol=0, atol=0.006)  # [1]
    assert found["bad_pixels"].sel(kind="object") == 0


@settings(max_examples=20)
@given(factor=st.floats(0.01, 100.0), seed=st.integers(0, 1000))
def test_only_the_ratio_counts(factor: float, seed: int) -> None:
    """Errors and deviations scaled by one factor give the same scores."""
    truth = scene(10, 50)
    result = with_flag(normal(truth, 0.6, seed), "gray", slice(0, 20))
    grown = result.copy()
    for name in ("object_temperature", "emissivity"):
        grown[name] = truth[name] + factor * (result[name] - truth[name])
        grown[f"{name}_std"] = factor * result[f"{name}_std"]
    first, second = (stress.judge(truth, one) for one in (result, grown))
    errors = ["object_temperature_rmse", "emissivity_error"]
    xr.testing.assert_allclose(first.drop_vars(errors), second.drop_vars(errors), rtol=1e-6)


def test_units_and_inputs() -> None:
    """Every variable has a unit, and the inputs are not changed."""
    truth = scene(pixels=5)
    result = normal(truth)
    copies = truth.copy(deep=True), result.copy(deep=True)
    found = stress.judge(truth, result)
    units = {name: variable.attrs["units"] for name, variable in found.data_vars.items()}
    assert units == dict.fromkeys(units, "1") | {"object_temperature_rmse": "K"}
    for given_one, kept in zip((truth, result), copies, strict=True):
        xr.testing.assert_identical(given_one, kept)


def test_clean_glass() -> None:
    """Clean glass has at most 10 % of its pixels flagged, and the stated coverage of the object."""
    found = stress.judge(*run_case(GLASS, Rig(), TIME, 400, seed=7))
    covered, width = found["object_coverage"].values, found["width"].values
    print(f"flagged {float(found['flagged']):.3f}, object {covered}, widths {width}")
    assert float(found["flagged"]) <= 0.1
    assert 0.92 <= covered[0] <= 0.98
    assert (found["emissivity_coverage"] >= 0.92).all()
    assert (width < 3.0).all()


def judged(flags: Mapping[str, slice]) -> xr.Dataset:
    """A case of 200 pixels: ten off, some with flags."""
    truth = scene(pixels=200)
    result = normal(truth)
    result["object_temperature"][:, 0, :10] += 1.0  # K
    for name, pixels in flags.items():
        result = with_flag(result, name, pixels)
    one = stress.judge(truth, result).expand_dims(case=["a case"])
    return one.assign_attrs(origin="simulated")


def bars(figure: Figure) -> dict[str, float]:
    """Lengths of the first row's bars [%], by their labels."""
    found = [part for part in figure.axes[0].containers if isinstance(part, BarContainer)]
    return {str(part.get_label()): float(part.patches[0].get_width()) for part in found}


def test_validity_shows_what_is_wrong() -> None:
    """Right, wrong and flagged make up the bar; the wrong ones stand in red, and as a number."""
    figure = validity(judged({"gray": slice(8, 50)}))
    figure.draw_without_rendering()
    found = bars(figure)
    wrong = next(label for label in found if "wrong" in label)
    assert found[wrong] == pytest.approx(4.0)  # %: eight of 200
    assert found["no flag and right"] == pytest.approx(75.0)
    assert found[REASONS["gray"][0]] == pytest.approx(21.0)
    assert sum(found.values()) == pytest.approx(100.0)
    assert [text.get_text() for text in figure.axes[0].texts] == ["4.0 % wrong"]
    assert "(simulated)" in figure.get_suptitle()
    assert plt.get_fignums() == []


def test_validity_counts_a_pixel_once() -> None:
    """A pixel with two flags is drawn as that which comes first in the list of reasons."""
    found = bars(validity(judged({"gray": slice(0, 40), "saturated": slice(20, 60)})))
    assert found[REASONS["saturated"][0]] == pytest.approx(20.0)  # %
    assert found[REASONS["gray"][0]] == pytest.approx(10.0)


def test_validity_shows_low_coverage_as_an_arrow() -> None:
    """A coverage below the axis is drawn at its edge."""
    stressed = judged({})
    stressed["object_coverage"] = stressed["object_coverage"] * 0.1
    axis = validity(stressed).axes[1]
    arrows = [line for line in axis.lines if line.get_marker() == "<"]
    places = [np.asarray(line.get_xdata()) for line in arrows]
    assert [place.size for place in places] == [1, 0, 0]
    assert axis.get_xlim()[0] < places[0][0] < 50.0  # %


def test_validity_of_nothing() -> None:
    """A row with every pixel flagged and NaN is labelled as having none to judge."""
    stressed = judged({"gray": slice(None)})
    for name in ("object_coverage", "emissivity_coverage"):
        stressed[name] = stressed[name] * np.nan
    figure = validity(stressed)
    figure.draw_without_rendering()
    assert [text.get_text() for text in figure.axes[1].texts] == ["none to judge"]


def test_status_in_words() -> None:
    """Each flag that occurs has its colour, its words and its share; others are left out."""
    flags = xr.DataArray(np.array([[0, 0, 1, 64], [0, 5, 4, 0]], dtype=np.uint16), dims=("y", "x"))
    figure = status(xr.Dataset({"status": flags}, attrs={"origin": "simulated"}))
    figure.draw_without_rendering()
    image = np.asarray(figure.axes[0].images[0].get_array())
    motion, signal = (to_rgb(REASONS[n][1]) for n in ("no_background_motion", "constant_signal"))
    np.testing.assert_allclose(image[[0, 1], [2, 1]], [motion, motion], rtol=0, atol=1e-9)
    np.testing.assert_allclose(image[0, 3], signal, rtol=0, atol=1e-9)
    legend = figure.axes[1].get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == [
        "50.0 %  good",
        "12.5 %  signal never changes",
        f"25.0 %  {REASONS['no_background_motion'][0]}",
        f"12.5 %  {REASONS['gray'][0]}",
    ]
    assert figure.get_suptitle() == "Status: 50.0 % of the pixels have no flag (simulated)"
    assert plt.get_fignums() == []


def test_completed_is_told_from_measured() -> None:
    """What is completed is drawn as that, not as good and not as the reason to complete it."""
    prior = schema.Status.COMPLETED_FROM_PRIOR | schema.Status.COMPLETED_FROM_SURROUNDINGS
    flags = np.array([[0, schema.Status.GRAY | prior, schema.Status.COMPLETED_FRAMES, 4]])
    figure = status(xr.Dataset({"status": (("y", "x"), flags.astype(np.uint32))}))
    legend = figure.axes[1].get_legend()
    assert legend is not None
    names = ("completed_from_prior", "completed_frames", "gray")
    shown = ["25.0 %  good", *(f"25.0 %  {REASONS[name][0]}" for name in names)]
    assert [text.get_text() for text in legend.get_texts()] == shown
    of_all = "25.0 % of the pixels have no flag, 50.0 % are completed"
    assert figure.get_suptitle() == f"Status: {of_all}"


def test_a_few_pixels_are_not_none() -> None:
    """One pixel in 10,000 is not shown as a share of zero."""
    flags = np.zeros((100, 100), dtype=np.uint16)
    flags[3, 4] = schema.Status.DEAD_PIXEL
    legend = status(xr.Dataset({"status": (("y", "x"), flags)})).axes[1].get_legend()
    assert legend is not None
    assert legend.get_texts()[1].get_text() == "< 0.1 %  dead pixel"


def test_unknown_bit() -> None:
    """An unknown status bit raises an error."""
    unknown = 1 << 30
    flags = xr.DataArray(np.array([[0, unknown | 1]], dtype=np.uint32), dims=("y", "x"))
    with pytest.raises(ValueError, match=f"Unknown bits {unknown} of a status"):
        status(xr.Dataset({"status": flags}))


def test_every_flag_has_words_and_a_colour() -> None:
    """Every flag has words and a colour of its own."""
    assert schema.Status.bits().keys() <= REASONS.keys()
    words, colors = zip(*REASONS.values(), strict=True)
    assert len({*words}) == len({*colors}) == len(REASONS)
    assert all(max(to_rgb(color)) - to_rgb(color)[0] < 0.99 for color in colors)
