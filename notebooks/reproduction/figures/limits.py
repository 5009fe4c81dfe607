"""Figures of errors at their statistical limit: over noise, bands and pixels of one material."""

from typing import Final

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from dbthermal.figures import drawing
from dbthermal.figures.drawing import COLORS, canvas, draw_image, limits_of

_MICRO: Final = "\N{MICRO SIGN}m"


def error_over_bound(measured: xr.Dataset) -> Figure:
    """Errors of an estimate over the noise, beside the bound that no estimate can beat.

    Above, errors as markers and bounds as lines; below, errors in units of their bound. Over
    `noise` (that of the quieter band [K]): `reflection_ratio_error` [1] and
    `object_temperature_error` [K], root mean square over the pixels, and their bounds
    `reflection_ratio_bound` and `object_temperature_bound`. A further dimension `case` gives lines
    of several colours; where the bounds alone have it, the errors are drawn once.
    """
    cases = measured if "case" in measured.dims else measured.expand_dims(case=[""])
    figure, axes = canvas(2, 2, (9.0, 6.2))
    for (above, below), name, unit in zip(
        axes.T, ("reflection_ratio", "object_temperature"), ("1", "K"), strict=True
    ):
        once = "case" not in cases[f"{name}_error"].dims
        for index, case in enumerate(cases["case"].values):
            here, mark = cases.sel(case=case), drawing.marked_line(index)
            error, bound = here[f"{name}_error"], here[f"{name}_bound"]
            label = f"{case}, " if str(case) else ""
            line = {"color": mark["color"], "linewidth": 1, "label": f"{label}bound"}
            above.plot(here["noise"], bound, **line)
            below.plot(here["noise"], error / bound, **mark)
            if not once:
                above.plot(
                    here["noise"], error, label=f"{label}measured", **mark | {"linewidth": 0}
                )
        if once:
            above.plot(cases["noise"], cases[f"{name}_error"], "ko", markersize=4, label="measured")
        label = f"error of the {name.replace('_', ' ')} [{unit}]"
        above.set(xscale="log", yscale="log", ylabel=label)
        below.set(xscale="log", ylabel="error / bound [1]", xlabel="noise of the quieter band [K]")
        below.axhline(1.0, color="black", linewidth=0.6)
        drawing.plain_decades(above)
        for axis in (above, below):
            drawing.plain_ticks(axis, cases["noise"])
    axes[0, 0].legend(frameon=False, fontsize=8)
    figure.suptitle("Errors at the statistical limit" + drawing.provenance_note(measured))
    return figure


def pooling(measured: xr.Dataset) -> Figure:
    """
    Gain of pooling pixels of one material: error of the ratio beside its bound, and of the object.

    Over `size`, pixels in a group: `reflection_ratio_error`, its bound `reflection_ratio_bound` and
    the separation's own deviation `stated` [1]; `object_temperature_error` [K].
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
        drawing.plain_ticks(axis, size)
        drawing.plain_decades(axis)
    left.legend(frameon=False, fontsize=8)
    figure.suptitle("Pixels that share a material" + drawing.provenance_note(measured))
    return figure


def error_over_bands(measured: xr.Dataset) -> Figure:
    """Gain of a third and a fourth band: error beside its bounds, and in units of them.

    Over `bands`, names of the bands in use: `object_temperature_error` [K] and, over `case` too,
    `object_temperature_bound` [K].
    """
    figure, ((left, right),) = canvas(1, 2, (9.0, 3.8))
    error, place = measured["object_temperature_error"], np.arange(measured.sizes["bands"])
    for index, case in enumerate(measured["case"].values):
        bound = measured["object_temperature_bound"].sel(case=case)
        left.plot(place, bound, color=COLORS[index], linewidth=1, label=f"{case}, bound")
        right.plot(place, error / bound, **drawing.marked_line(index))
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
    figure.suptitle("More bands" + drawing.provenance_note(measured))
    return figure


def pooled_materials(
    single: xr.DataArray, pooled: xr.DataArray, labels: xr.DataArray, panels: xr.DataArray
) -> Figure:
    """
    Maps of the reflection ratio (y, x) [1] of single pixels and pooled, and of the material labels.

    Labels (y, x) of -1 are of no material; the borders of the true panels (y, x) are drawn as
    lines.
    """
    figure, ((left, middle, right),) = canvas(1, 3, (12.0, 3.4))
    limits = limits_of(single)
    for axis, ratio, title in ((left, single, "pixel by pixel"), (middle, pooled, "pooled")):
        label = "reflection ratio [1]"
        draw_image(figure, axis, ratio, title, label, cmap="viridis", limits=limits)
    labelled = labels.where(labels >= 0)
    title = f"materials found: {np.unique(labelled.values[labelled.notnull().values]).size}"
    right.imshow(labelled % 10, cmap="tab10", vmin=0, vmax=9, interpolation="nearest")
    right.set_facecolor("0.8")
    right.set_title(title, fontsize=9)
    for axis in (left, middle, right):
        for one in np.unique(panels.values)[1:]:
            axis.contour(panels.values >= one, levels=[0.5], colors="white", linewidths=0.8)
        axis.set(xticks=[], yticks=[])
    figure.suptitle("Pixels of one material share their ratio" + drawing.provenance_note(single))
    return figure
