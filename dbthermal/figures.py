"""Figures that a thermographer expects. A function draws what it is given and returns the figure.

Nothing is computed here beyond units for the eye, nothing is saved. Temperatures are drawn in
degrees Celsius. Every figure of data that are simulated or not radiometric says so in its title,
from the `origin` and `radiometric` attributes of what it draws.
"""

from collections.abc import Mapping
from typing import Final

import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

ZERO_CELSIUS: Final = 273.15
"""0 degrees Celsius [K]."""

_COLORS: Final = ("#1b6ca8", "#d1495b", "#66a182", "#edae49", "#6c4f77")
_LABELS: Final = {"8-14": "8-14 \N{MICRO SIGN}m"}


def _canvas(
    rows: int, columns: int, size: tuple[float, float]
) -> tuple[Figure, npt.NDArray[np.object_]]:
    """Figure and axes (rows, columns), owned by nobody but the caller."""
    figure, axes = plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained")
    plt.close(figure)
    return figure, axes


def _band(name: object) -> str:
    return _LABELS.get(str(name), f"{name} \N{MICRO SIGN}m")


def provenance_note(data: xr.Dataset | xr.DataArray) -> str:
    """
    Say what the data are, for a title.

    Parameters
    ----------
    data : Dataset or DataArray
        With the attributes `origin` ("simulated", "measured", ...) and `radiometric` (0 if the
        values are a picture's and not counts).

    Returns
    -------
    str
        E.g. " (simulated)" or " (not radiometric)"; empty for measured radiometric data.
    """
    notes = []
    if data.attrs.get("origin") == "simulated":
        notes.append("simulated")
    if data.attrs.get("radiometric", 1) == 0:
        notes.append("not radiometric")
    return f" ({', '.join(notes)})" if notes else ""


def _image(
    figure: Figure,
    axis: Axes,
    image: xr.DataArray,
    title: str,
    label: str,
    *,
    cmap: str = "inferno",
    limits: tuple[float, float] | None = None,
) -> None:
    lowest, highest = limits if limits is not None else (None, None)
    drawn = axis.imshow(image.values, cmap=cmap, vmin=lowest, vmax=highest, interpolation="nearest")
    axis.set_facecolor("0.8")
    axis.set_title(title, fontsize=9)
    axis.set_xticks([])
    axis.set_yticks([])
    figure.colorbar(drawn, ax=axis, label=label, shrink=0.85)


def _limits(image: xr.DataArray, *, symmetric: bool = False) -> tuple[float, float]:
    """Range that holds all but one in a hundred of the values at either end."""
    values = image.values[np.isfinite(image.values)]
    if values.size == 0:
        return 0.0, 1.0
    lowest, highest = np.percentile(values, [1, 99])
    if symmetric:
        highest = max(abs(lowest), abs(highest))
        lowest = -highest
    return float(lowest), float(highest) if highest > lowest else float(lowest) + 1.0


def gain_offset_maps(correction: xr.Dataset) -> Figure:
    """
    Gain and offset of every pixel, a row a band; bad pixels are marked.

    Parameters
    ----------
    correction : Dataset
        From `frames.fit_correction`: `gain` [1], `offset` [count], `bad`, all (band, y, x).

    Returns
    -------
    Figure
        Maps and marks.
    """
    bands = correction["band"].values
    figure, axes = _canvas(len(bands), 2, (8.0, 2.8 * len(bands)))
    for row, band in zip(axes, bands, strict=True):
        here = correction.sel(band=band)
        good = ~here["bad"]
        bad = np.argwhere(here["bad"].values)
        parts = (("gain", "gain [1]", "viridis"), ("offset", "offset [count]", "cividis"))
        for axis, (name, label, cmap) in zip(row, parts, strict=True):
            image = here[name].where(good)
            title = f"{_band(band)}: {name}, {len(bad)} bad pixels"
            _image(figure, axis, image, title, label, cmap=cmap, limits=_limits(image))
            axis.plot(bad[:, 1], bad[:, 0], "x", color="red", markersize=3)
    figure.suptitle("Gain and offset correction" + provenance_note(correction))
    return figure


def response_fit(response: xr.Dataset, fine: xr.DataArray) -> Figure:
    """
    Response of each band with the residuals of both fits.

    Parameters
    ----------
    response : Dataset
        From `calibration.fit_response`.
    fine : DataArray
        Fitted counts (band, temperature) on a fine grid of temperatures, from `response.counts`.

    Returns
    -------
    Figure
        From above: counts over temperature, the line's residuals, and those of the
        Sakuma-Hattori curve on a scale of their own, with the noise of one pixel and frame where
        the response has it.
    """
    bands = response["band"].values
    figure, axes = _canvas(3, len(bands), (4.6 * len(bands), 7.2))
    celsius = response["temperature"] - ZERO_CELSIUS
    for column, band in enumerate(bands):
        here, (top, middle, bottom) = response.sel(band=band), axes[:, column]
        top.plot(fine["temperature"] - ZERO_CELSIUS, fine.sel(band=band), color=_COLORS[0])
        line = here["linear_slope"] * fine["temperature"] + here["linear_intercept"]
        top.plot(fine["temperature"] - ZERO_CELSIUS, line, "--", color=_COLORS[2])
        top.plot(celsius, here["counts"], ".", color=_COLORS[1])
        top.set(title=_band(band), ylabel="signal [count]")
        top.legend(["Sakuma-Hattori", "linear", "blackbody"], frameon=False, fontsize=8)
        middle.plot(celsius, here["linear_residual"], "s--", color=_COLORS[2], markersize=3)
        middle.set(ylabel="residual of the line\n[count]")
        bottom.plot(celsius, here["residual"], "o-", color=_COLORS[0], markersize=3)
        bottom.set(ylabel="residual of the curve\n[count]")
        bottom.set_xlabel("blackbody temperature [\N{DEGREE SIGN}C]")
        if "noise" in here:
            limit = float(here["noise"])
            bottom.set_title(f"noise of one pixel and frame: {limit:.1f} count", fontsize=8)
        for axis in (middle, bottom):
            axis.axhline(0.0, color="0.7", linewidth=0.8)
    figure.suptitle("Camera response" + provenance_note(response))
    return figure


def emissivity_by_contact(measured: xr.Dataset, truth: xr.DataArray | None = None) -> Figure:
    """
    Emissivities from thermocouple and blackbody with their standard deviations.

    Parameters
    ----------
    measured : Dataset
        `emissivity`, `emissivity_std` (material, band) [1].
    truth : DataArray, optional
        (material, band) [1], drawn as crosses.

    Returns
    -------
    Figure
        One point a band and material.
    """
    figure, ((axis,),) = _canvas(1, 1, (8.4, 3.8))
    place = np.arange(measured.sizes["material"])
    bands = measured["band"].values
    for index, band in enumerate(bands):
        here = measured.sel(band=band)
        shifted = place + 0.14 * (index - (len(bands) - 1) / 2)
        axis.errorbar(
            shifted,
            here["emissivity"],
            here["emissivity_std"],
            fmt="o",
            markersize=4,
            capsize=3,
            color=_COLORS[index],
            label=_band(band),
        )
        if truth is not None:
            label = "truth" if index == 0 else None
            axis.plot(shifted, truth.sel(band=band), "x", color="black", markersize=7, label=label)
    axis.set_xticks(place, [str(name).replace(" ", "\n") for name in measured["material"].values])
    axis.set(ylabel="emissivity [1]", ylim=(0, 1.05))
    figure.legend(frameon=False, loc="outside right center", fontsize=8)
    axis.set_title("Emissivity by contact, one standard deviation" + provenance_note(measured))
    return figure


def emissivity_bars(table: xr.Dataset) -> Figure:
    """
    Band emissivities as bars, a group a material.

    Parameters
    ----------
    table : Dataset
        From `emissivity.band_table`: `emissivity` (material, band) [1].

    Returns
    -------
    Figure
        Bars.
    """
    materials, bands = table["material"].values, table["band"].values
    figure, ((axis,),) = _canvas(1, 1, (max(7.0, 0.62 * len(materials)), 4.6))
    width = 0.8 / len(bands)
    for index, band in enumerate(bands):
        place = np.arange(len(materials)) + width * (index - (len(bands) - 1) / 2)
        values = table["emissivity"].sel(band=band)
        axis.bar(place, values, width, color=_COLORS[index % len(_COLORS)], label=_band(band))
    axis.set_xticks(np.arange(len(materials)), materials, rotation=45, ha="right", fontsize=8)
    axis.set(ylabel="band emissivity [1]", ylim=(0, 1.12))
    axis.legend(frameon=False, ncols=len(bands), loc="upper center", fontsize=8)
    axis.set_title("Planck-weighted band emissivity" + provenance_note(table))
    return figure


def condition_matrix(summary: xr.DataArray, materials: int) -> Figure:
    """
    Condition number of the emissivity matrix for every pair of bands.

    Parameters
    ----------
    summary : DataArray
        (first, second) [1], averaged over materials; NaN or infinite on the diagonal.
    materials : int
        Number of materials that the average is over.

    Returns
    -------
    Figure
        Matrix with its numbers.
    """
    figure, ((axis,),) = _canvas(1, 1, (5.4, 4.6))
    values = np.where(np.isfinite(summary.values), summary.values, np.nan)
    drawn = axis.imshow(values, cmap="viridis_r")
    middle = np.mean(_limits(summary.copy(data=values)))
    for row, column in np.ndindex(*values.shape):
        if np.isfinite(values[row, column]):
            color = "white" if values[row, column] > middle else "black"
            axis.text(
                column, row, f"{values[row, column]:.0f}", ha="center", va="center", color=color
            )
    for setter, dim in ((axis.set_xticks, "second"), (axis.set_yticks, "first")):
        setter(np.arange(summary.sizes[dim]), [_band(name) for name in summary[dim].values])
    figure.colorbar(drawn, ax=axis, label="condition number [1]")
    statistic = summary.attrs.get("statistic", "average")
    axis.set_title(
        f"Condition number of band pairs\n({statistic} of {materials} materials; low is good)"
        + provenance_note(summary)
    )
    return figure


def truth_and_estimate(truth: xr.Dataset, result: xr.Dataset, pixel: tuple[int, int]) -> Figure:
    """
    Truth against estimate over time at one pixel, with two standard deviations.

    Parameters
    ----------
    truth : Dataset
        Scene with `object_temperature`, `background_temperature` (time, y, x) [K].
    result : Dataset
        From `separation.solve`.
    pixel : tuple of int
        Row and column.

    Returns
    -------
    Figure
        Object above, background below.
    """
    figure, axes = _canvas(2, 1, (7.4, 5.6))
    place = {"y": pixel[0], "x": pixel[1]}
    known, found = truth.isel(place), result.isel(place)
    for axis, name in zip(
        axes[:, 0], ("object_temperature", "background_temperature"), strict=True
    ):
        value, std = found[name] - ZERO_CELSIUS, found[f"{name}_std"]
        time = found["time"]
        axis.fill_between(time, value - 2 * std, value + 2 * std, color=_COLORS[0], alpha=0.25)
        axis.plot(time, value, color=_COLORS[0], linewidth=1)
        axis.plot(known["time"], known[name] - ZERO_CELSIUS, "--", color="black", linewidth=1)
        axis.set(ylabel=name.replace("_", " ") + " [\N{DEGREE SIGN}C]")
    axes[0, 0].legend(["two standard deviations", "estimate", "truth"], frameon=False, fontsize=8)
    axes[-1, 0].set_xlabel("time [s]")
    figure.suptitle(f"Truth and estimate at pixel {pixel}" + provenance_note(truth))
    return figure


def accuracy(sweep: xr.Dataset) -> Figure:
    """
    Errors of the object temperature and of the emissivities, case by case.

    Parameters
    ----------
    sweep : Dataset
        `object_temperature_rmse` [K], `emissivity_error` (band) [1], over `case`.

    Returns
    -------
    Figure
        Two panels.
    """
    figure, axes = _canvas(1, 2, (11.0, 0.34 * sweep.sizes["case"] + 1.8))
    place = np.arange(sweep.sizes["case"])
    left, right = axes[0]
    left.barh(place, sweep["object_temperature_rmse"], color=_COLORS[0])
    bands = sweep["band"].values
    for index, band in enumerate(bands):
        shifted = place + 0.36 * (index - (len(bands) - 1) / 2)
        values = sweep["emissivity_error"].sel(band=band)
        right.barh(shifted, values, 0.34, color=_COLORS[index], label=_band(band))
    for axis in (left, right):
        axis.set_yticks(place, sweep["case"].values, fontsize=8)
        axis.invert_yaxis()
    right.legend(frameon=False, fontsize=8)
    left.set_xlabel("median RMSE of the object temperature [K]")
    right.set_xlabel("median error of the emissivity [1]")
    right.set_yticklabels([])
    figure.suptitle("Accuracy of the separation" + provenance_note(sweep))
    return figure


def error_bar_calibration(scores: Mapping[str, xr.DataArray]) -> Figure:
    """
    Distribution of error over standard deviation; a true error bar gives the normal curve.

    Parameters
    ----------
    scores : mapping of str to DataArray
        Quantity, and its errors divided by their standard deviation [1].

    Returns
    -------
    Figure
        Histograms over the standard normal density.
    """
    figure, axes = _canvas(1, len(scores), (3.4 * len(scores), 3.0))
    grid = np.linspace(-5, 5, 201)
    normal = np.exp(-(grid**2) / 2) / np.sqrt(2 * np.pi)
    for axis, (name, values) in zip(axes[0], scores.items(), strict=True):
        axis.hist(values.values.ravel(), bins=50, range=(-5, 5), density=True, color=_COLORS[0])
        axis.plot(grid, normal, color="black", linewidth=1)
        axis.set(title=name.replace("_", " "), xlabel="error / standard deviation [1]")
    axes[0, 0].set_ylabel("density [1]")
    figure.suptitle("Error bars against errors (simulated)")
    return figure


def separated_frames(
    inputs: xr.DataArray,
    emission: xr.DataArray,
    reflection: xr.DataArray,
    *,
    title: str,
    labels: tuple[str, str, str],
) -> Figure:
    """
    For a scene: the two inputs, the emission and the mean-subtracted reflection, a row a time.

    Parameters
    ----------
    inputs : DataArray
        (band, time, y, x), any unit.
    emission, reflection : DataArray
        (time, y, x); pixels without a value are gray.
    title : str
        What the scene is.
    labels : tuple of str
        Labels with units of inputs, emission and reflection.

    Returns
    -------
    Figure
        As many rows as there are times.
    """
    bands, frames = inputs["band"].values, inputs.sizes["time"]
    aspect = inputs.sizes["y"] / inputs.sizes["x"]
    columns = len(bands) + 2
    figure, axes = _canvas(frames, columns, (3.3 * columns, (2.6 * aspect + 0.45) * frames))
    scales = [_limits(inputs.sel(band=band)) for band in bands]
    warm, change = _limits(emission), _limits(reflection, symmetric=True)
    for index, row in enumerate(axes):
        moment = f"{float(inputs['time'][index]):.1f} s"
        for axis, band, scale in zip(row, bands, scales, strict=False):
            image = inputs.sel(band=band).isel(time=index)
            _image(figure, axis, image, f"input {_band(band)}, {moment}", labels[0], limits=scale)
        image = emission.isel(time=index)
        _image(figure, row[-2], image, f"emission, {moment}", labels[1], limits=warm)
        image = reflection.isel(time=index)
        title_here = f"reflection less its mean, {moment}"
        _image(figure, row[-1], image, title_here, labels[2], cmap="RdBu_r", limits=change)
    figure.suptitle(title + provenance_note(inputs))
    return figure


def separated_temperatures(
    apparent: xr.DataArray, emission: xr.DataArray, change: xr.DataArray, *, title: str
) -> Figure:
    """
    `separated_frames` of temperatures, in degrees Celsius.

    Parameters
    ----------
    apparent : DataArray
        Apparent temperature of the inputs (band, time, y, x) [K].
    emission : DataArray
        Object temperature (time, y, x) [K].
    change : DataArray
        Background temperature less its mean over time (time, y, x) [K].
    title : str
        What the scene is.

    Returns
    -------
    Figure
        As many rows as there are times.
    """
    labels = ("apparent [\N{DEGREE SIGN}C]", "object [\N{DEGREE SIGN}C]", "background [K]")
    inputs = (apparent - ZERO_CELSIUS).assign_attrs(apparent.attrs)
    return separated_frames(inputs, emission - ZERO_CELSIUS, change, title=title, labels=labels)


def compared_reflections(ours: xr.DataArray, theirs: xr.DataArray, scores: xr.DataArray) -> Figure:
    """
    Our reflection beside the authors' published one, and their correlation frame by frame.

    Parameters
    ----------
    ours, theirs : DataArray
        Magnitude of the reflection at a few times (time, y, x), in units of their own.
    scores : DataArray
        Correlation of the two maps (time) [1], of the frames that were compared.

    Returns
    -------
    Figure
        Two maps a chosen time, and the correlations with their median.
    """
    columns = ours.sizes["time"]
    figure, axes = _canvas(3, columns, (3.2 * columns, 8.0))
    for index in range(columns):
        moment = f"{float(ours['time'][index]):.1f} s"
        for axis, movie, name in (
            (axes[0, index], ours, "ours"),
            (axes[1, index], theirs, "published"),
        ):
            image = movie.isel(time=index)
            _image(
                figure,
                axis,
                image,
                f"{name}, {moment}",
                "own unit",
                cmap="magma",
                limits=_limits(image),
            )
    grid = axes[2, 0].get_gridspec()
    for axis in axes[2]:
        axis.remove()
    bottom = figure.add_subplot(grid[2, :])
    bottom.plot(scores["time"], scores, "o", color=_COLORS[0], markersize=4)
    bottom.axhline(float(scores.median()), color="0.5", linewidth=1)
    bottom.set(xlabel="time [s]", ylabel="correlation [1]", ylim=(min(0.0, float(scores.min())), 1))
    bottom.set_title(f"{scores.size} frames, median {float(scores.median()):.2f}", fontsize=9)
    figure.suptitle("Magnitude of the reflection" + provenance_note(ours))
    return figure


def status_map(status: xr.DataArray, meanings: Mapping[str, int]) -> Figure:
    """
    Where each flag of a separation is set.

    Parameters
    ----------
    status : DataArray
        (y, x), bits.
    meanings : mapping
        Name of each flag and its bit, e.g. `schema.FLAGS`.

    Returns
    -------
    Figure
        One map for each flag that occurs, and one of the good pixels.
    """
    masks = {"good": status == 0}
    masks |= {name: (status & bit) != 0 for name, bit in meanings.items()}
    shown = {name: mask for name, mask in masks.items() if bool(mask.any())}
    figure, axes = _canvas(1, len(shown), (2.5 * len(shown), 2.6))
    for axis, (name, mask) in zip(axes[0], shown.items(), strict=True):
        axis.imshow(mask.values, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        axis.set_title(f"{name.replace('_', ' ')}\n{100 * float(mask.mean()):.1f} %", fontsize=8)
        axis.set_xticks([])
        axis.set_yticks([])
    figure.suptitle("Status, white where set" + provenance_note(status))
    return figure
