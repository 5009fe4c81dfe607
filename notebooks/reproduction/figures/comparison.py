"""Figures that set methods, settings and bounds beside one another."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dbthermal.figures import drawing
from dbthermal.figures.drawing import COLORS, band_label, canvas, draw_image, limits_of


def error_over_noise(errors: xr.DataArray, *, title: str) -> Figure:
    """Error of the object temperature over noise, a line a method, a panel a material.

    The errors are medians (material, noise, variant) [K]; without the dimension `material`, one
    panel. `noise` is that of the quieter band [K]. Both axes are logarithmic; a missing value is
    left out.
    """
    panels = errors if "material" in errors.dims else errors.expand_dims(material=[""])
    columns = min(4, panels.sizes["material"])
    rows = -(-panels.sizes["material"] // columns)
    width = 3.0 if panels.sizes["material"] > 1 else 5.5
    figure, axes = canvas(rows, columns, (width * columns + 1.6, 0.85 * width * rows + 0.5))
    for axis in axes.ravel()[1:]:
        axis.sharey(axes[0, 0])
    names = panels["material"].values
    for axis, name in zip(axes.ravel().tolist(), names, strict=False):
        _lines(axis, panels.sel(material=name))
        axis.set_title(str(name), fontsize=9)
    for axis in axes.flat[panels.sizes["material"] :]:
        axis.remove()
    positive = errors.values[errors.values > 0]
    if positive.size:
        axes[0, 0].set_ylim(0.6 * float(positive.min()), 1.6 * float(positive.max()))
    for axis in axes[:, 0]:
        axis.set_ylabel("median error [K]")
    for axis in axes[-1]:
        axis.set_xlabel("noise of the quieter band [K]")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", frameon=False, fontsize=8)
    figure.suptitle(title + drawing.provenance_note(errors))
    return figure


def _lines(axis: Axes, errors: xr.DataArray) -> None:
    """One line a variant, over the noise; a word where there is no value."""
    noise = errors["noise"].values
    axis.set(xscale="log", xlim=(0.8 * noise.min(), 1.25 * noise.max()))
    if not np.isfinite(errors).any():
        axis.text(0.5, 0.5, "flagged at every noise", ha="center", transform=axis.transAxes)
    for index, name in enumerate(errors["variant"].values):
        style = drawing.marked_line(index) | {"linestyle": "-" if index < len(COLORS) else "--"}
        axis.loglog(errors["noise"], errors.sel(variant=name), label=str(name), **style)
    drawing.plain_ticks(axis, errors["noise"])


def emissivity_errors(errors: xr.DataArray, *, title: str) -> Figure:
    """Maps, a method each, of median errors (variant, emissivity, noise) [1] with numbers."""
    count = errors.sizes["variant"]
    figure, axes = canvas(1, count, (4.6 * count, 4.0))
    highest = float(np.nanpercentile(errors.values, 98))
    for axis, name in zip(axes[0], errors["variant"].values, strict=True):
        image = errors.sel(variant=name).transpose("emissivity", "noise")[::-1]
        scale = (0.0, highest)
        draw_image(figure, axis, image, str(name), "error [1]", cmap="magma_r", limits=scale)
        number_cells(axis, image.values, highest / 2, "{:.3f}", fontsize=7)
        axis.set_xticks(range(image.sizes["noise"]), [f"{v:g}" for v in image["noise"].values])
        rows = [f"{v:.2f}" for v in image["emissivity"].values]
        axis.set_yticks(range(image.sizes["emissivity"]), rows)
        axis.set(xlabel="noise of the quieter band [K]")
    axes[0, 0].set_ylabel(f"emissivity, {band_label('8-14')} [1]")
    figure.suptitle(title + drawing.provenance_note(errors))
    return figure


def reductions(reduction: xr.DataArray, published: Sequence[float]) -> Figure:
    """Reduction of the error by each loss term (term) [%] beside the published ones, as bars."""
    figure, ((axis,),) = canvas(1, 1, (6.0, 3.4))
    place = np.arange(reduction.sizes["term"])
    ours, theirs = (-0.2, reduction.values, "here", COLORS[0]), (0.2, published, "the paper", "0.6")
    for shift, values, label, color in (ours, theirs):
        bars = axis.bar(place + shift, values, 0.38, label=label, color=color)
        axis.bar_label(bars, fmt="%.1f", fontsize=8, padding=2)
    axis.axhline(0.0, color="black", linewidth=0.6)
    axis.margins(y=0.12)
    axis.set_xticks(place, [str(name) for name in reduction["term"].values])
    axis.set_ylabel("reduction of the error by the term [%]")
    axis.legend(frameon=False, fontsize=8)
    axis.set_title("Error saved by each loss term" + drawing.provenance_note(reduction))
    return figure


def sensitivity(errors: xr.DataArray, base: float) -> Figure:
    """Bars of the error (variant) [K] with one setting changed, and a line at the defaults'."""
    figure, ((axis,),) = canvas(1, 1, (7.5, 0.24 * errors.sizes["variant"] + 1.4))
    place = np.arange(errors.sizes["variant"])
    axis.barh(place, errors.values, color=COLORS[0])
    axis.axvline(base, color="black", linewidth=1, label="defaults")
    axis.set_yticks(place, [str(name) for name in errors["variant"].values], fontsize=8)
    axis.invert_yaxis()
    axis.set_xlabel("median error of the object temperature [K]")
    axis.legend(frameon=False, fontsize=8)
    note = drawing.provenance_note(errors)
    axis.set_title(f"Settings of the optimiser, one changed at a time{note}")
    return figure


def descents(courses: xr.Dataset) -> Figure:
    """Objective over iterations and error over time (optimiser, look), each optimiser a line.

    `iteration`, `time` [ms], `objective` [1] and `object_temperature_rmse` [K], all on logarithmic
    axes; an optimiser with one look, the others missing, is a mark.
    """
    figure, axes = canvas(1, 2, (9.0, 3.6))
    names = (("iteration", "objective"), ("time", "object_temperature_rmse"))
    for axis, (across, up) in zip(axes[0], names, strict=True):
        for index, name in enumerate(courses["optimiser"].values):
            course = courses.sel(optimiser=name)
            axis.loglog(course[across], course[up], label=str(name), **drawing.marked_line(index))
    axes[0, 0].set(xlabel="iterations [1]", ylabel="median objective [1]")
    axes[0, 1].set(xlabel="time of one thread, a pixel [ms]", ylabel="median error [K]")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", frameon=False, fontsize=8)
    figure.suptitle("Descents from random emissivities" + drawing.provenance_note(courses))
    return figure


def emissivity_procedures(
    compared: xr.Dataset, published: Mapping[str, Mapping[str, float]], band: str
) -> Figure:
    """Emissivity of several objects by each procedure, beside the truth and the published values.

    `true` (object, band), `mean` and `spread` (object, procedure, band) [1], drawn for one band
    with lines of one standard deviation; published: label -> object -> the paper's value [1].
    """
    in_band = compared.sel(band=band)
    objects, procedures = in_band["object"].values, in_band["procedure"].values
    figure, ((axis,),) = canvas(1, 1, (8.5, 3.8))
    place = np.arange(objects.size)
    axis.bar(place, in_band["true"], 0.85, color="0.88", label="truth")
    marks = len(procedures) + len(published)
    shifts = iter(0.14 * (np.arange(marks) - (marks - 1) / 2))
    for index, name in enumerate(procedures):
        mean, spread = (in_band[it].sel(procedure=name) for it in ("mean", "spread"))
        style = {"fmt": "o", "markersize": 4, "color": COLORS[index], "label": str(name)}
        axis.errorbar(place + next(shifts), mean, spread, **style)
    for marker, (label, values) in zip("sD", published.items(), strict=False):
        shown = [values[str(name)] for name in objects]
        style = {"color": "0.3", "label": label, "fillstyle": "none"}
        axis.plot(place + next(shifts), shown, marker, **style)
    axis.set_xticks(place, list(objects))
    axis.set(ylabel=f"emissivity, {band_label(band)} [1]", ylim=(0, 1.05))
    axis.legend(frameon=False, fontsize=8, loc="upper left", ncols=2)
    axis.set_title("Emissivity by each procedure" + drawing.provenance_note(compared))
    return figure


def compared_reflections(ours: xr.DataArray, theirs: xr.DataArray, scores: xr.DataArray) -> Figure:
    """Our reflection beside the authors' published one, and their correlation frame by frame.

    Both magnitudes (time, y, x) are in units of their own; `scores` (time) [1] of all compared
    frames.
    """
    columns = ours.sizes["time"]
    figure, axes = canvas(3, columns, (3.2 * columns, 8.0))
    for index in range(columns):
        moment = f"{float(ours['time'][index]):.1f} s"
        rows = zip(axes[:2, index], (ours, theirs), ("ours", "published"), strict=True)
        for axis, movie, name in rows:
            image, title = movie.isel(time=index), f"{name}, {moment}"
            scale = limits_of(image)
            draw_image(figure, axis, image, title, "own unit [1]", cmap="magma", limits=scale)
    grid = axes[2, 0].get_gridspec()
    for axis in axes[2]:
        axis.remove()
    bottom = figure.add_subplot(grid[2, :])
    bottom.plot(scores["time"], scores, "o", color=COLORS[0], markersize=4)
    bottom.axhline(float(scores.median()), color="0.5", linewidth=1)
    bottom.set(xlabel="time [s]", ylabel="correlation [1]", ylim=(min(0.0, float(scores.min())), 1))
    bottom.set_title(f"{scores.size} frames, median {float(scores.median()):.2f}", fontsize=9)
    figure.suptitle("Magnitude of the reflection" + drawing.provenance_note(ours))
    return figure


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
    quantities = ("reflection_ratio", "object_temperature")
    for (above, below), name, unit in zip(axes.T, quantities, ("1", "K"), strict=True):
        once = "case" not in cases[f"{name}_error"].dims
        for index, case in enumerate(cases["case"].values):
            of_case, mark = cases.sel(case=case), drawing.marked_line(index)
            error, bound = of_case[f"{name}_error"], of_case[f"{name}_bound"]
            label = f"{case}, " if str(case) else ""
            line = {"color": mark["color"], "linewidth": 1, "label": f"{label}bound"}
            above.plot(of_case["noise"], bound, **line)
            below.plot(of_case["noise"], error / bound, **mark)
            if not once:
                mark |= {"linewidth": 0, "label": f"{label}measured"}
                above.plot(of_case["noise"], error, **mark)
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
    figure, ((first, second),) = canvas(1, 2, (9.0, 3.6))
    size = measured["size"]
    bound = measured["reflection_ratio_bound"]
    first.plot(size, bound, color="black", linewidth=0.8, label="bound")
    first.plot(size, measured["stated"], color=COLORS[3], linewidth=1.2, label="stated")
    first.plot(size, measured["reflection_ratio_error"], "o", color=COLORS[0], label="measured")
    second.plot(size, measured["object_temperature_error"], "o-", color=COLORS[1], linewidth=1)
    first.set(ylabel="error of the reflection ratio [1]")
    second.set(ylabel="error of the object temperature [K]")
    for axis in (first, second):
        axis.set(xscale="log", yscale="log", xlabel="pixels of one material [1]")
        drawing.plain_ticks(axis, size)
        drawing.plain_decades(axis)
    first.legend(frameon=False, fontsize=8)
    figure.suptitle("Pixels that share a material" + drawing.provenance_note(measured))
    return figure


def error_over_bands(measured: xr.Dataset) -> Figure:
    """Gain of a third and a fourth band: error beside its bounds, and in units of them.

    Over `bands`, names of the bands in use: `object_temperature_error` [K] and, over `case` too,
    `object_temperature_bound` [K].
    """
    figure, ((first, second),) = canvas(1, 2, (9.0, 3.8))
    error, place = measured["object_temperature_error"], np.arange(measured.sizes["bands"])
    for index, case in enumerate(measured["case"].values):
        bound = measured["object_temperature_bound"].sel(case=case)
        first.plot(place, bound, color=COLORS[index], linewidth=1, label=f"{case}, bound")
        second.plot(place, error / bound, **drawing.marked_line(index))
    first.plot(place, error, "ko", markersize=5, label="measured")
    first.set(ylabel="error of the object temperature [K]")
    first.set_ylim(bottom=0)
    second.set(ylabel="error / bound [1]")
    second.axhline(1.0, color="black", linewidth=0.6)
    for axis in (first, second):
        axis.set(xlabel=f"bands [{_MICRO}]")
        names = [str(name).replace(" + ", "\n") for name in measured["bands"].values]
        axis.set_xticks(place, names, fontsize=8)
        axis.grid(visible=True, color="0.9")
    first.legend(frameon=False, fontsize=8)
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
    figure, ((first, second, third),) = canvas(1, 3, (12.0, 3.4))
    limits = limits_of(single)
    for axis, ratio, title in ((first, single, "pixel by pixel"), (second, pooled, "pooled")):
        label = "reflection ratio [1]"
        draw_image(figure, axis, ratio, title, label, cmap="viridis", limits=limits)
    labelled = labels.where(labels >= 0)
    title = f"materials found: {np.unique(labelled.values[labelled.notnull().values]).size}"
    third.imshow(labelled % 10, cmap="tab10", vmin=0, vmax=9, interpolation="nearest")
    third.set_facecolor("0.8")
    third.set_title(title, fontsize=9)
    for axis in (first, second, third):
        for material in np.unique(panels.values)[1:]:
            axis.contour(panels.values >= material, levels=[0.5], colors="white", linewidths=0.8)
        axis.set(xticks=[], yticks=[])
    figure.suptitle("Pixels of one material share their ratio" + drawing.provenance_note(single))
    return figure


def number_cells(
    axis: Axes, values: npt.NDArray[np.floating], middle: float, form: str, **style: Any
) -> None:
    """Write the finite values (row, column) of a map on it, white where they are above a middle."""
    for row, column in np.argwhere(np.isfinite(values)):
        color = "white" if values[row, column] > middle else "black"
        text = form.format(values[row, column])
        axis.text(column, row, text, ha="center", va="center", color=color, **style)
