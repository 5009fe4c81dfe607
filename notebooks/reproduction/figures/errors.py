"""Figures of errors: accuracy and error bars, pixels to trust, limits, disturbances, flags."""

from collections.abc import Iterable, Mapping
from typing import Any, Final

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dbthermal.figures import REASONS, drawing, first_reason
from dbthermal.figures.drawing import COLORS, band_label, canvas, marked_line

_RIGHT, _WRONG = "#a8d5b0", "#e3000f"
# What a 95 % interval should hold, where the axis of the coverage begins, and its arrow lies [%].
_SPAN, _LOWEST, _ARROW = (92.0, 98.0), 50.0, 48.5
_DOTS: Final = (COLORS[0], COLORS[3], COLORS[4], COLORS[2])


def accuracy(sweep: xr.Dataset) -> Figure:
    """Errors of the object temperature and of the emissivities, case by case, as bars.

    Of `object_temperature_rmse` [K] and `emissivity_error` (band) [1], over `case`.
    """
    figure, axes = canvas(1, 2, (11.0, 0.34 * sweep.sizes["case"] + 1.8))
    place = np.arange(sweep.sizes["case"])
    first, second = axes[0]
    first.barh(place, sweep["object_temperature_rmse"], color=COLORS[0])
    bands = sweep["band"].values
    for index, band in enumerate(bands):
        shifted = place + 0.36 * (index - (len(bands) - 1) / 2)
        values = sweep["emissivity_error"].sel(band=band)
        second.barh(shifted, values, 0.34, color=COLORS[index], label=band_label(band))
    for axis in (first, second):
        axis.set_yticks(place, sweep["case"].values, fontsize=8)
        axis.invert_yaxis()
    second.legend(frameon=False, fontsize=8)
    first.set_xlabel("median RMSE of the object temperature [K]")
    second.set_xlabel("median error of the emissivity [1]")
    second.set_yticklabels([])
    figure.suptitle("Accuracy of the separation" + drawing.provenance_note(sweep))
    return figure


def error_bar_calibration(scores: Mapping[str, xr.DataArray]) -> Figure:
    """
    Histograms of error over standard deviation [1], by quantity, over the standard normal density.

    The attributes of the first quantity say what the data are.
    """
    figure, axes = canvas(1, len(scores), (3.4 * len(scores), 3.0))
    grid = np.linspace(-5, 5, 201)
    normal = np.exp(-(grid**2) / 2) / np.sqrt(2 * np.pi)
    for axis, (name, values) in zip(axes[0], scores.items(), strict=True):
        axis.hist(values.values.ravel(), bins=50, range=(-5, 5), density=True, color=COLORS[0])
        axis.plot(grid, normal, color="black", linewidth=1)
        axis.set(title=name.replace("_", " "), xlabel="error / standard deviation [1]")
    axes[0, 0].set_ylabel("density [1]")
    data = next(iter(scores.values()))
    figure.suptitle("Error bars against errors" + drawing.provenance_note(data))
    return figure


def validity(stress: xr.Dataset) -> Figure:
    """Pixels case by case: right, wrong without a warning, or flagged, with the reason.

    Left, a bar of all pixels: no flag and right; no flag and wrong, in red; flagged, by the most
    telling flag. Right, the share of the 95 % intervals that hold the truth, over the span from 92
    to 98 %: of the object temperature in pixels without a flag, of the emissivities in all that
    have a value; an arrow lies left of the axis. Of `experiments.limits.stressed`: `status` (case,
    pixel), `bad` (case, kind, pixel), `object_coverage` (case, among), `emissivity_coverage` (case,
    among, band) [1].
    """
    figure, axes = canvas(1, 2, (12.5, 5.0))
    first, second = axes[0]
    first.get_gridspec().set_width_ratios([1.4, 1.0])
    _bars(first, stress["status"], stress["bad"].sel(kind="any"))
    coverage = {"object temperature, no flag": stress["object_coverage"].sel(among="unflagged")}
    for band in stress["band"].values:
        among_all = stress["emissivity_coverage"].sel(among="all", band=band)
        coverage[f"emissivity, {band_label(band)}, all with a value"] = among_all
    _dots(second, coverage)
    place = np.arange(stress.sizes["case"])
    first.set_yticks(place, stress["case"].values, fontsize=8)
    second.set_yticks(place, [""] * place.size)
    for axis in (first, second):
        axis.set_ylim(place.size - 0.4, -0.6)
        axis.spines[["top", "right"]].set_visible(False)
    style: dict[str, Any] = {"frameon": False, "fontsize": 8}
    words, dots = (axis.get_legend_handles_labels() for axis in (first, second))
    figure.legend(*words, loc="outside lower left", ncols=2, **style)
    rows = max(-(-len(words[1]) // 2), len(dots[1]))
    figure.set_figheight(0.29 * place.size + 0.18 * rows + 1.7)
    figure.legend(*dots, loc="outside lower right", **style)
    figure.suptitle("Which pixels can be trusted, and why not" + drawing.provenance_note(stress))
    return figure


def _bars(axis: Axes, flags: xr.DataArray, bad: xr.DataArray) -> None:
    """Stacked bars (case): right, wrong, and each flag; the wrong ones as a number, too."""
    first, wrong = first_reason(flags.transpose("case", "pixel")), bad.transpose("case", "pixel")
    colors = {"no flag and right": (_RIGHT, (first == "") & ~wrong.values)}
    unseen = (_WRONG, (first == "") & wrong.values)
    colors["no flag and wrong (error above 4 standard deviations)"] = unseen
    colors |= {words: (color, first == name) for name, (words, color) in REASONS.items()}
    place, reached = np.arange(flags.sizes["case"]), np.zeros(flags.sizes["case"])
    for label, (color, mask) in colors.items():
        share = 100 * mask.mean(axis=1)
        if share.any() or color in {_RIGHT, _WRONG}:
            axis.barh(place, share, 0.8, left=reached, color=color, label=label)
        # Some of the wrong ones are too small to see.
        for row in np.flatnonzero(share).tolist() if color == _WRONG else ():
            text = f"{drawing.percent(share[row] / 100)} wrong"
            axis.text(101, row, text, color=_WRONG, fontsize=8, fontweight="bold", va="center")
        reached += share
    axis.set(xlim=(0, 100), xlabel="share of the pixels [%]")


def _dots(axis: Axes, coverage: dict[str, xr.DataArray]) -> None:
    """Coverage [%] of several quantities, a dot a case, over the span that it should lie in."""
    axis.axvspan(*_SPAN, color=_RIGHT, alpha=0.6, linewidth=0, label="92 to 98 %")
    for index, (label, share) in enumerate(coverage.items()):
        value = 100 * share.values
        place = np.arange(value.size) + 0.22 * (index - (len(coverage) - 1) / 2)
        color = _DOTS[index % len(_DOTS)]
        axis.plot(value, place, "o", color=color, markersize=5, label=label)
        low = place[value < _LOWEST]
        axis.plot(np.full(low.size, _ARROW), low, "<", color=color, markersize=5)
    empty = np.all([share.isnull() for share in coverage.values()], axis=0)
    for row in np.flatnonzero(empty).tolist():
        text, end = "none to judge", _SPAN[0] - 2
        axis.text(end, row, text, color="0.5", fontsize=8, va="center", ha="right")
    axis.set(xlim=(_LOWEST - 3, 100.5), xlabel="95 % intervals that hold the truth [%]")
    axis.set_title(f"arrow: below {_LOWEST:.0f} %", loc="left", fontsize=8, color="0.4")
    axis.grid(visible=True, axis="y", color="0.93")
    axis.set_axisbelow(True)


_RMSE: Final = "object_temperature_rmse"
_RMSE_LABEL: Final = "RMSE of the object temperature [K]"


def offsets(measured: xr.Dataset) -> Figure:
    """Bands exposed apart: error of the estimated offset; error and flags of the object.

    Over `delay`, the true offset [frame]: `found` [frame]; and over `treatment` too,
    `object_temperature_rmse` [K] and `flagged` [1].
    """
    figure, ((first, second, third),) = canvas(1, 3, (12.0, 3.6))
    first.axhline(0.0, color="black", linewidth=0.6)
    first.plot(measured["delay"], measured["found"] - measured["delay"], "o", color=COLORS[0])
    first.set(ylabel="error of the offset [frame]", ylim=(-0.1, 0.1))
    _lines(second, measured[_RMSE], "delay")
    _lines(third, 100 * measured["flagged"], "delay")
    _kelvin(second)
    third.set(ylabel="flagged [%]", ylim=(-3, 103))
    _over((first, second, third), "offset of the second band [frame]")
    second.legend(frameon=False, fontsize=8)
    figure.suptitle("Bands exposed apart" + drawing.provenance_note(measured))
    return figure


def disturbances(measured: xr.Dataset) -> Figure:
    """Error with each nuisance as recorded, corrected, and without: bars, and the share flagged.

    Over `nuisance` and `treatment`: `object_temperature_rmse` [K] and `flagged` [1].
    """
    figure, ((axis,),) = canvas(1, 1, (8.0, 3.8))
    names, treatments = measured["nuisance"].values, measured["treatment"].values
    width = 0.8 / treatments.size
    for index, treatment in enumerate(treatments):
        rows = measured.sel(treatment=treatment)
        place = np.arange(names.size) + width * (index - (treatments.size - 1) / 2)
        axis.bar(place, rows[_RMSE], width, color=COLORS[index % len(COLORS)], label=treatment)
        for at, value, share in zip(place, rows[_RMSE].values, rows["flagged"].values, strict=True):
            text = f"{value:.2f} K\n{100 * share:.0f} % flagged"
            axis.text(at, value, text, ha="center", va="bottom", fontsize=7)
    axis.set_xticks(np.arange(names.size), names)
    _kelvin(axis)
    axis.margins(y=0.2)
    axis.legend(frameon=False, fontsize=8)
    axis.set_title("Lost frames and a closed shutter" + drawing.provenance_note(measured))
    return figure


def parallax(measured: xr.Dataset) -> Figure:
    """Cost of the parallax of the reflection in two registered views: error, flags, coverage.

    Over `parallax` [pixel] and `treatment`: `object_temperature_rmse` [K], `flagged` and `covered`
    [1].
    """
    figure, ((first, second, third),) = canvas(1, 3, (12.0, 3.6))
    _lines(first, measured[_RMSE], "parallax")
    _lines(second, 100 * measured["flagged"], "parallax")
    _lines(third, 100 * measured["covered"], "parallax")
    _kelvin(first)
    second.set(ylabel="flagged [%]", ylim=(-3, 103))
    third.axhspan(92, 98, color=COLORS[2], alpha=0.3, linewidth=0)
    third.set(ylabel="95 % intervals that hold, no flag [%]", ylim=(-3, 103))
    _over((first, second, third), "parallax of the reflection [pixel]")
    first.legend(frameon=False, fontsize=8)
    figure.suptitle("Two cameras side by side" + drawing.provenance_note(measured))
    return figure


def _lines(axis: Axes, values: xr.DataArray, over: str) -> None:
    """A line a treatment, thinner than those before: where they coincide, all are seen."""
    for index, treatment in enumerate(values["treatment"].values):
        line, thin = values.sel(treatment=treatment), max(0, 2 - index)
        style = marked_line(index) | {"linewidth": 1.2 + 1.6 * thin, "markersize": 4.0 + 2.5 * thin}
        axis.plot(values[over], line, label=treatment, **style)


def _over(axes: Iterable[Axes], label: str) -> None:
    """Label and grid of axes over one quantity."""
    for axis in axes:
        axis.set(xlabel=label)
        axis.grid(visible=True, color="0.9")


def _kelvin(axis: Axes) -> None:
    """A logarithmic axis of errors, with plain numbers."""
    axis.set(yscale="log", ylabel=_RMSE_LABEL)
    drawing.plain_decades(axis)
