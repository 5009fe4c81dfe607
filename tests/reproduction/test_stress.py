"""Error bars and flags of results with known errors, and the figures of validity and status."""

from collections.abc import Mapping

import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr
from captures import GLASS
from matplotlib.colors import to_rgb
from matplotlib.container import BarContainer
from matplotlib.figure import Figure

from dbthermal import schema
from dbthermal.figures import REASONS, status
from dbthermal.simulation import Background
from reproduction.experiments import limits
from reproduction.experiments.cases import independent_pixels
from reproduction.figures.errors import validity

OBJECT = "object_temperature"


def scene(frames: int = 20, pixels: int = 2000) -> xr.Dataset:
    """A scene of glass."""
    time, rng = np.arange(frames) / 10.0, np.random.default_rng(0)
    return independent_pixels(time, GLASS, Background(), pixels, rng, start=300.0, stop=320.0)


def normal(truth: xr.Dataset, scale: float = 1.0, seed: int = 1) -> xr.Dataset:
    """The truth with normal errors of 0.1 K and 0.01, said to be `scale` times as large."""
    rng = np.random.default_rng(seed)
    result = truth.drop_vars("background_temperature")
    for name, std in {OBJECT: 0.1, "emissivity": 0.01}.items():
        result[name] = truth[name] + rng.normal(0.0, std, truth[name].shape)
        result[f"{name}_std"] = xr.full_like(truth[name], scale * std)
    empty = np.zeros((1, truth.sizes["x"]), dtype=np.uint16)
    return result.assign(status=(("y", "x"), empty, schema.Status.cf_attrs(schema.STATUS)))


def flagged(result: xr.Dataset, pixels: Mapping[str, slice]) -> xr.Dataset:
    """The same with flags set in some pixels."""
    flags = result["status"].copy(deep=True)
    for name, place in pixels.items():
        flags[0, place] |= schema.Status.bits()[name]
    return result.assign(status=flags)


@pytest.mark.parametrize(("scale", "share"), [(0.5, 0.673), (1.0, 0.95), (2.0, 0.99991)])
def test_normal_errors(scale: float, share: float) -> None:
    """The coverage is that of the normal distribution, the width the bars' own scale."""
    truth = scene(frames=40)
    copy, result = truth.copy(deep=True), normal(truth, scale)
    result[OBJECT][1::2] = np.nan  # every other sample is lost
    judged = limits.judge(truth, result)
    covered, width = judged["emissivity_coverage"].values, judged["width"].values
    np.testing.assert_allclose(judged["object_coverage"], share, rtol=0, atol=0.006)  # [1]
    np.testing.assert_allclose(covered, share, rtol=0, atol=0.03)  # [1]
    np.testing.assert_allclose(width, scale, rtol=0.06)
    assert float(judged["object_temperature_rmse"]) == pytest.approx(0.1, abs=0.005)  # K
    np.testing.assert_allclose(judged["emissivity_error"], 0.00674, rtol=0, atol=0.0005)  # [1]
    units = {name: variable.attrs["units"] for name, variable in judged.data_vars.items()}
    assert units == dict.fromkeys(units, "1") | {"object_temperature_rmse": "K"}
    xr.testing.assert_identical(truth, copy)


def test_errors_in_flagged_pixels() -> None:
    """They lower the coverage of all, and not of the unflagged."""
    truth = scene()
    result = flagged(normal(truth), {"gray": slice(0, 500)})
    off = 1.0 * (truth["x"] < 500)
    result[OBJECT] = result[OBJECT] + off  # K
    result["emissivity"] = result["emissivity"] + 0.1 * off
    judged = limits.judge(truth, result)
    for name in ("object_coverage", "emissivity_coverage"):
        among = judged[name]
        np.testing.assert_allclose(among.sel(among="unflagged"), 0.95, rtol=0, atol=0.02)
        np.testing.assert_allclose(among.sel(among="all"), 0.75 * 0.95, rtol=0, atol=0.02)
    assert float(judged["flagged"]) == 0.25


def test_bad_pixels_are_counted_by_kind() -> None:
    """Ten are off in temperature, twenty others in an emissivity; a flag is on 4 and 10 of them."""
    truth = scene(pixels=200)
    result = normal(truth)
    result[OBJECT][:, 0, :10] = truth[OBJECT][:, 0, :10] + 0.41  # K
    result["emissivity"][1, 0, 10:30] = truth["emissivity"][1, 0, 10:30] - 0.041
    both = {"constant_object": slice(6, 16), "saturated": slice(12, 20)}
    judged = limits.judge(truth, flagged(result, both))
    assert judged["bad_pixels"].sel(kind=["object", "any"]).values.tolist() == [10, 30]
    np.testing.assert_allclose(judged["bad_flagged"], [0.4, 14 / 30], rtol=0, atol=1e-12)
    assert np.flatnonzero(judged["bad"].sel(kind="any")).tolist() == list(range(30))
    assert float(judged["flagged"]) == 0.07


def test_ends_of_the_counts() -> None:
    """A pixel is bad by its RMS error over time; of flagged NaN alone shares are NaN."""
    truth = scene(pixels=5)
    result = normal(truth)
    result[OBJECT] = truth[OBJECT] + 0.399  # K
    result[OBJECT][0, 0, 0] += 0.2
    result["emissivity"] = truth["emissivity"] + 0.0399
    assert limits.judge(truth, result)["bad"].values.tolist() == [[True] + [False] * 4] * 2
    values = {name: result[name] * np.nan for name in result.data_vars if name != "status"}
    judged = limits.judge(truth, flagged(result.assign(values), {"gray": slice(None)}))
    for name in ("object_coverage", "emissivity_coverage", "width", "bad_flagged"):
        assert bool(judged[name].isnull().all())
    assert judged["bad_pixels"].values.tolist() == [0, 0]
    assert float(judged["flagged"]) == 1.0


def test_validity_shows_what_is_wrong() -> None:
    """Right, wrong and flagged make up the bar; a pixel with two flags is drawn once."""
    truth = scene(pixels=200)
    result = normal(truth)
    result[OBJECT][:, 0, :10] += 1.0  # K
    result = flagged(result, {"gray": slice(8, 40), "saturated": slice(20, 60)})
    judged = limits.judge(truth, result).expand_dims(case=["a case"])
    figure = validity(judged.assign_attrs(origin="simulated"))
    figure.draw_without_rendering()
    parts = [part for part in figure.axes[0].containers if isinstance(part, BarContainer)]
    lengths = {str(part.get_label()): float(part.patches[0].get_width()) for part in parts}
    wrong = next(label for label in lengths if "wrong" in label)
    assert lengths[wrong] == pytest.approx(4.0)  # %: eight of 200
    assert lengths["no flag and right"] == pytest.approx(70.0)
    assert lengths[REASONS["saturated"][0]] == pytest.approx(20.0)
    assert lengths[REASONS["gray"][0]] == pytest.approx(6.0)
    assert sum(lengths.values()) == pytest.approx(100.0)
    assert [text.get_text() for text in figure.axes[0].texts] == ["4.0 % wrong"]
    assert "(simulated)" in figure.get_suptitle()
    assert plt.get_fignums() == []


def drawn(flags: object) -> Figure:
    """The figure of flags (y, x)."""
    image = xr.DataArray(np.array(flags, dtype=np.uint32), dims=("y", "x"))
    return status(xr.Dataset({"status": image}, attrs={"origin": "simulated"}))


def legend(figure: Figure) -> list[str]:
    """Words of the legend."""
    words = figure.axes[1].get_legend()
    assert words is not None
    return [text.get_text() for text in words.get_texts()]


def test_status_in_words() -> None:
    """Each flag that occurs has colour, words and share; completed is drawn as that."""
    figure = drawn([[0, 0, 1, 64], [0, 5, 4, 0]])
    figure.draw_without_rendering()
    image = np.asarray(figure.axes[0].images[0].get_array())
    motion, signal = (to_rgb(REASONS[n][1]) for n in ("no_background_motion", "constant_signal"))
    np.testing.assert_allclose(image[[0, 1], [2, 1]], [motion, motion], rtol=0, atol=1e-9)
    np.testing.assert_allclose(image[0, 3], signal, rtol=0, atol=1e-9)
    assert [words.split(" %")[0] for words in legend(figure)] == ["50.0", "12.5", "25.0", "12.5"]
    prior = schema.Status.COMPLETED_FROM_PRIOR | schema.Status.COMPLETED_FROM_SURROUNDINGS
    figure = drawn([[0, schema.Status.GRAY | prior, schema.Status.COMPLETED_FRAMES, 4]])
    names = ("completed_from_prior", "completed_frames", "gray")
    assert legend(figure) == ["25.0 %  no flag", *(f"25.0 %  {REASONS[name][0]}" for name in names)]
    assert "25.0 % of the pixels have no flag, 50.0 % are completed" in figure.get_suptitle()
    rare = np.zeros((100, 100))
    rare[3, 4] = schema.Status.DEAD_PIXEL
    assert legend(drawn(rare))[1] == "< 0.1 %  dead pixel"  # and not none


def test_every_flag_has_words_and_a_colour() -> None:
    """Every flag has words and a colour of its own; an unknown bit is an error."""
    assert schema.Status.bits().keys() <= REASONS.keys()
    words, colors = zip(*REASONS.values(), strict=True)
    assert len({*words}) == len({*colors}) == len(REASONS)
    assert all(max(to_rgb(color)) - to_rgb(color)[0] < 0.99 for color in colors)
    with pytest.raises(ValueError, match=f"Unknown bits {1 << 30} of a status"):
        drawn([[0, 1 << 30 | 1]])
