"""Figures of the cost of a real rig's nuisances, before and after their correction."""

from typing import Final

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dbthermal.figures.drawing import COLORS, canvas, marked_line, plain_decades, provenance_note

_RMSE: Final = "object_temperature_rmse"
_RMSE_LABEL: Final = "RMSE of the object temperature [K]"


def offsets(measured: xr.Dataset) -> Figure:
    """Bands exposed apart: error of the estimated offset; error and flags of the object.

    Over `delay`, the true offset [frame]: `found` [frame]; and over `treatment` too,
    `object_temperature_rmse` [K] and `flagged` [1].
    """
    figure, ((left, middle, right),) = canvas(1, 3, (12.0, 3.6))
    left.axhline(0.0, color="black", linewidth=0.6)
    left.plot(measured["delay"], measured["found"] - measured["delay"], "o", color=COLORS[0])
    left.set(ylabel="error of the offset [frame]", ylim=(-0.1, 0.1))
    _lines(middle, measured[_RMSE], "delay")
    _lines(right, 100 * measured["flagged"], "delay")
    _kelvin(middle)
    right.set(ylabel="flagged [%]", ylim=(-3, 103))
    for axis in (left, middle, right):
        axis.set(xlabel="offset of the second band [frame]")
        axis.grid(visible=True, color="0.9")
    middle.legend(frameon=False, fontsize=8)
    figure.suptitle("Bands exposed apart" + provenance_note(measured))
    return figure


def disturbances(measured: xr.Dataset) -> Figure:
    """Error with each nuisance as recorded, corrected, and without: bars, and the share flagged.

    Over `nuisance` and `treatment`: `object_temperature_rmse` [K] and `flagged` [1].
    """
    figure, ((axis,),) = canvas(1, 1, (8.0, 3.8))
    names, treatments = measured["nuisance"].values, measured["treatment"].values
    width = 0.8 / treatments.size
    for index, treatment in enumerate(treatments):
        here = measured.sel(treatment=treatment)
        place = np.arange(names.size) + width * (index - (treatments.size - 1) / 2)
        axis.bar(place, here[_RMSE], width, color=COLORS[index % len(COLORS)], label=treatment)
        for at, value, share in zip(place, here[_RMSE].values, here["flagged"].values, strict=True):
            text = f"{value:.2f} K\n{100 * share:.0f} % flagged"
            axis.text(at, value, text, ha="center", va="bottom", fontsize=7)
    axis.set_xticks(np.arange(names.size), names)
    _kelvin(axis)
    axis.margins(y=0.2)
    axis.legend(frameon=False, fontsize=8)
    axis.set_title("Lost frames and a closed shutter" + provenance_note(measured))
    return figure


def parallax(measured: xr.Dataset) -> Figure:
    """Cost of the parallax of the reflection in two registered views: error, flags, coverage.

    Over `parallax` [pixel] and `treatment`: `object_temperature_rmse` [K], `flagged` and `covered`
    [1].
    """
    figure, ((left, middle, right),) = canvas(1, 3, (12.0, 3.6))
    _lines(left, measured[_RMSE], "parallax")
    _lines(middle, 100 * measured["flagged"], "parallax")
    _lines(right, 100 * measured["covered"], "parallax")
    _kelvin(left)
    middle.set(ylabel="flagged [%]", ylim=(-3, 103))
    right.axhspan(92, 98, color=COLORS[2], alpha=0.3, linewidth=0)
    right.set(ylabel="95 % intervals that hold, no flag [%]", ylim=(-3, 103))
    for axis in (left, middle, right):
        axis.set(xlabel="parallax of the reflection [pixel]")
        axis.grid(visible=True, color="0.9")
    left.legend(frameon=False, fontsize=8)
    figure.suptitle("Two cameras side by side" + provenance_note(measured))
    return figure


def _lines(axis: Axes, values: xr.DataArray, over: str) -> None:
    """A line a treatment, thinner than those before: where they coincide, all are seen."""
    for index, treatment in enumerate(values["treatment"].values):
        line, thin = values.sel(treatment=treatment), max(0, 2 - index)
        style = marked_line(index) | {"linewidth": 1.2 + 1.6 * thin, "markersize": 4.0 + 2.5 * thin}
        axis.plot(values[over], line, label=treatment, **style)


def _kelvin(axis: Axes) -> None:
    """A logarithmic axis of errors, with plain numbers."""
    axis.set(yscale="log", ylabel=_RMSE_LABEL)
    plain_decades(axis)
