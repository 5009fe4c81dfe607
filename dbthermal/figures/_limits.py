"""Figures of the statistical limits: what to expect of a recording, and errors at their bound."""

from collections.abc import Sequence
from typing import Final

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

from dbthermal.figures._canvas import COLORS, canvas, provenance_note

_MARKERS: Final = "osD^v"
# Deviations [K] at the ends of the colour map; beyond, a filter is as good or as bad as can be.
_SCALE: Final = (0.1, 10.0)
_MICRO: Final = "\N{MICRO SIGN}m"


def plan(expected: xr.Dataset, durations: xr.Dataset, materials: Sequence[str]) -> Figure:
    """
    What accuracy to expect with which filter, and what a longer film gains.

    Parameters
    ----------
    expected : Dataset
        From `limits.plan`: `object_temperature_std` (material, filter) [K], `best` (material),
        the attribute `beside`.
    durations : Dataset
        From `limits.plan_durations`: `object_temperature_std` (seconds, material, filter) [K].
    materials : sequence of str
        Whose lines to draw on the right, each with its best filter; a material with none is left
        out.

    Returns
    -------
    Figure
        Left, a map with its numbers, the best filter of each material framed.
        Right, lines over the length of the film.
    """
    std = expected["object_temperature_std"]
    height = 0.24 * std.sizes["material"] + 1.9
    width = 2.6 + 0.75 * std.sizes["filter"]
    figure, ((left, right),) = canvas(1, 2, (width + 5.2, max(4.2, height)))
    drawn = _map(left, std, expected["best"])
    bar = figure.colorbar(drawn, ax=left, label="expected std [K]", shrink=0.8, extend="both")
    _plain_decades(bar.ax)
    left.set_xlabel(f"filter beside {expected.attrs['beside']} [{_MICRO}]")
    best = expected["best"].sel(material=list(materials))
    known = best[np.isin(best.values, std["filter"].values)]
    for index, name in enumerate(known["material"].values):
        chosen = str(known.sel(material=name).item())
        right.loglog(
            durations["seconds"],
            durations["object_temperature_std"].sel(material=name, filter=chosen),
            color=COLORS[index % len(COLORS)],
            marker=_MARKERS[index % len(_MARKERS)],
            markersize=4,
            linewidth=1,
            label=f"{name}, {chosen} {_MICRO}",
        )
    _plain_ticks(right, durations["seconds"])
    _plain_decades(right)
    right.set(xlabel="length of the film [s]", ylabel="expected std [K]")
    if known.size:
        right.legend(frameon=False, fontsize=8, loc="upper right")
    title = "Object temperature of one pixel, expected standard deviation"
    figure.suptitle(title + provenance_note(expected))
    return figure


def error_over_bound(measured: xr.Dataset) -> Figure:
    """
    Errors of an estimate beside the bound that no estimate can beat, over the noise.

    Parameters
    ----------
    measured : Dataset
        Over `noise` (that of the quieter band [K]): `reflection_ratio_error` [1] and
        `object_temperature_error` [K], root mean square over the pixels, and their bounds
        `reflection_ratio_bound` and `object_temperature_bound`. A further dimension `case` gives
        lines of several colours; where the bounds alone have it, the errors are drawn once.

    Returns
    -------
    Figure
        Above, errors as markers and bounds as lines; below, errors in units of their bound.
    """
    cases = measured if "case" in measured.dims else measured.expand_dims(case=[""])
    figure, axes = canvas(2, 2, (9.0, 6.2))
    for (above, below), name, unit in zip(
        axes.T, ("reflection_ratio", "object_temperature"), ("1", "K"), strict=True
    ):
        once = "case" not in cases[f"{name}_error"].dims
        for index, case in enumerate(cases["case"].values):
            here, color = cases.sel(case=case), COLORS[index % len(COLORS)]
            error, bound = here[f"{name}_error"], here[f"{name}_bound"]
            mark = {"color": color, "marker": _MARKERS[index % len(_MARKERS)], "markersize": 5}
            label = f"{case}, " if str(case) else ""
            above.plot(here["noise"], bound, color=color, linewidth=1, label=f"{label}bound")
            below.plot(here["noise"], error / bound, linewidth=1, **mark)
            if not once:
                above.plot(here["noise"], error, linestyle="", label=f"{label}measured", **mark)
        if once:
            above.plot(cases["noise"], cases[f"{name}_error"], "ko", markersize=4, label="measured")
        above.set(xscale="log", yscale="log", ylabel=f"error of the {_words(name)} [{unit}]")
        below.set(xscale="log", ylabel="error / bound [1]", xlabel="noise of the quieter band [K]")
        below.axhline(1.0, color="black", linewidth=0.6)
        _plain_decades(above)
        for axis in (above, below):
            _plain_ticks(axis, cases["noise"])
    axes[0, 0].legend(frameon=False, fontsize=8)
    figure.suptitle("Errors at the statistical limit" + provenance_note(measured))
    return figure


def pooling(measured: xr.Dataset) -> Figure:
    """
    What pixels gain that are known to be of one material.

    Parameters
    ----------
    measured : Dataset
        Over `size`, pixels in a group: `reflection_ratio_error`, its bound
        `reflection_ratio_bound` and the separation's own deviation `stated` [1];
        `object_temperature_error` [K].

    Returns
    -------
    Figure
        Left, the error of the ratio beside its bound and what is stated; right, the object's.
    """
    figure, ((left, right),) = canvas(1, 2, (9.0, 3.6))
    size = measured["size"]
    left.plot(size, measured["reflection_ratio_bound"], color="black", linewidth=0.8, label="bound")
    left.plot(size, measured["stated"], color=COLORS[3], linewidth=1.2, label="stated")
    left.plot(size, measured["reflection_ratio_error"], "o", color=COLORS[0], label="measured")
    right.plot(size, measured["object_temperature_error"], "o-", color=COLORS[1], linewidth=1)
    left.set(ylabel="error of the reflection ratio [1]")
    right.set(ylabel="error of the object temperature [K]")
    for axis in (left, right):
        axis.set(xscale="log", yscale="log", xlabel="pixels of one material [1]")
        _plain_ticks(axis, size)
        _plain_decades(axis)
    left.legend(frameon=False, fontsize=8)
    figure.suptitle("Pixels that share a material" + provenance_note(measured))
    return figure


def error_over_bands(measured: xr.Dataset) -> Figure:
    """
    What a third and a fourth band gain.

    Parameters
    ----------
    measured : Dataset
        Over `bands`, names of the bands in use: `object_temperature_error` [K] and, over `case`
        too, `object_temperature_bound` [K].

    Returns
    -------
    Figure
        Left, the error beside its bounds; right, in units of them.
    """
    figure, ((left, right),) = canvas(1, 2, (9.0, 3.8))
    error, place = measured["object_temperature_error"], np.arange(measured.sizes["bands"])
    for index, case in enumerate(measured["case"].values):
        bound = measured["object_temperature_bound"].sel(case=case)
        mark = {"color": COLORS[index], "marker": _MARKERS[index], "markersize": 5, "linewidth": 1}
        left.plot(place, bound, color=COLORS[index], linewidth=1, label=f"{case}, bound")
        right.plot(place, error / bound, **mark)
    left.plot(place, error, "ko", markersize=5, label="measured")
    left.set(ylabel="error of the object temperature [K]")
    left.set_ylim(bottom=0)
    right.set(ylabel="error / bound [1]")
    right.axhline(1.0, color="black", linewidth=0.6)
    for axis in (left, right):
        axis.set(xlabel=f"bands [{_MICRO}]")
        names = [str(name).replace(" + ", "\n") for name in measured["bands"].values]
        axis.set_xticks(place, names, fontsize=8)
        axis.grid(visible=True, color="0.9")
    left.legend(frameon=False, fontsize=8)
    figure.suptitle("More bands" + provenance_note(measured))
    return figure


def _map(axis: Axes, std: xr.DataArray, best: xr.DataArray) -> AxesImage:
    """Map of deviations (material, filter) with numbers, the best of each row framed."""
    values = np.where(np.isfinite(std.values), std.values, np.nan)
    drawn = axis.imshow(values, cmap="viridis_r", norm=LogNorm(*_SCALE), aspect="auto")
    axis.set_facecolor("0.8")
    names = std["filter"].values.tolist()
    for row, column in np.ndindex(*values.shape):
        value, framed = values[row, column], best.values[row] == names[column]
        text = f"{value:.2g}" if np.isfinite(value) else "\N{EM DASH}"
        color = "white" if value > np.sqrt(_SCALE[0] * _SCALE[1]) else "black"
        frame = {"boxstyle": "round,pad=0.2", "fill": False, "edgecolor": color}
        axis.text(
            column,
            row,
            text,
            color=color,
            fontsize=8,
            ha="center",
            va="center",
            bbox=frame if framed else None,
        )
    axis.set_xticks(range(len(names)), names, fontsize=8)
    axis.set_yticks(range(len(values)), std["material"].values.tolist(), fontsize=8)
    return drawn


def _plain_ticks(axis: Axes, places: xr.DataArray) -> None:
    """Ticks at some places of a logarithmic axis, as plain numbers, and a grid."""
    axis.set_xticks(places.values, [f"{place:g}" for place in places.values], fontsize=8)
    axis.set_xticks([], minor=True)
    axis.grid(visible=True, which="major", color="0.9")


def _plain_decades(axis: Axes) -> None:
    """Ticks at 1, 2 and 5 of each decade of a logarithmic vertical axis, as plain numbers."""
    axis.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.yaxis.set_minor_locator(NullLocator())


def _words(name: str) -> str:
    return name.replace("_", " ")
