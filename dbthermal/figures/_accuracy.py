"""Figures of accuracy: truth and estimate, errors case by case, error bars."""

from collections.abc import Mapping

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from scipy.constants import zero_Celsius

from dbthermal.figures._canvas import COLORS, band_label, canvas, provenance_note


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
    figure, axes = canvas(2, 1, (7.4, 5.6))
    place = {"y": pixel[0], "x": pixel[1]}
    known, found = truth.isel(place), result.isel(place)
    for axis, name in zip(
        axes[:, 0], ("object_temperature", "background_temperature"), strict=True
    ):
        value, std = found[name] - zero_Celsius, found[f"{name}_std"]
        time = found["time"]
        axis.fill_between(time, value - 2 * std, value + 2 * std, color=COLORS[0], alpha=0.25)
        axis.plot(time, value, color=COLORS[0], linewidth=1)
        axis.plot(known["time"], known[name] - zero_Celsius, "--", color="black", linewidth=1)
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
    figure, axes = canvas(1, 2, (11.0, 0.34 * sweep.sizes["case"] + 1.8))
    place = np.arange(sweep.sizes["case"])
    left, right = axes[0]
    left.barh(place, sweep["object_temperature_rmse"], color=COLORS[0])
    bands = sweep["band"].values
    for index, band in enumerate(bands):
        shifted = place + 0.36 * (index - (len(bands) - 1) / 2)
        values = sweep["emissivity_error"].sel(band=band)
        right.barh(shifted, values, 0.34, color=COLORS[index], label=band_label(band))
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
        Quantity, and its errors divided by their standard deviation [1]; the first one's
        attributes say what the data are.

    Returns
    -------
    Figure
        Histograms over the standard normal density.
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
    figure.suptitle("Error bars against errors" + provenance_note(data))
    return figure
