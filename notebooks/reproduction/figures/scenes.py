"""Figure of a pixel beside its truth, and film of a separated scene."""

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.figure import Figure
from scipy.constants import zero_Celsius

from dbthermal import schema
from dbthermal._coordinates import laid_on
from dbthermal.figures import FilmPanel, drawing, film
from dbthermal.figures.drawing import COLORS, band_label, canvas


def truth_and_estimate(truth: xr.Dataset, result: xr.Dataset, pixel: tuple[int, int]) -> Figure:
    """Truth against estimate over time at one pixel, with two standard deviations.

    Object above, background below.

    Parameters
    ----------
    truth : Dataset
        Scene with `object_temperature`, `background_temperature` (time, y, x) [K].
    result : Dataset
        From `separation.solve`.
    pixel : tuple of int
        Row and column.
    """
    names = ("object_temperature", "background_temperature")
    for dataset, label in ((truth, "the truth"), (result, "the result")):
        schema.check(dataset, "separated", names, label)
    figure, axes = canvas(2, 1, (7.4, 5.6))
    truth = laid_on(truth, result, "the truth", "the result", dims=("y", "x"))
    place = {"y": pixel[0], "x": pixel[1]}
    true, estimate = truth.isel(place), result.isel(place)
    for axis, name in zip(axes[:, 0], names, strict=True):
        value, std = estimate[name] - zero_Celsius, estimate[f"{name}_std"]
        time = estimate["time"]
        axis.fill_between(time, value - 2 * std, value + 2 * std, color=COLORS[0], alpha=0.25)
        axis.plot(time, value, color=COLORS[0], linewidth=1)
        axis.plot(true["time"], true[name] - zero_Celsius, "--", color="black", linewidth=1)
        axis.set(ylabel=name.replace("_", " ") + " [\N{DEGREE SIGN}C]")
    axes[0, 0].legend(["two standard deviations", "estimate", "truth"], frameon=False, fontsize=8)
    axes[-1, 0].set_xlabel("time [s]")
    figure.suptitle(f"Truth and estimate at pixel {pixel}" + drawing.provenance_note(truth))
    return figure


def separated_film(
    apparent: xr.DataArray, emission: xr.DataArray, change: xr.DataArray, *, title: str
) -> Iterator[npt.NDArray[np.uint8]]:
    """Frames of a film: the inputs, the emission and the mean-subtracted reflection side by side.

    Parameters
    ----------
    apparent, emission, change, title
        As for `dbthermal.figures.separated_temperatures` [K]; pixels without a value are gray.

    Yields
    ------
    ndarray of uint8, shape (rows, columns, 3)
        As from `dbthermal.figures.film`.
    """
    labels = ("the inputs", "the emission", "the reflection")
    for temperature, label in zip((apparent, emission, change), labels, strict=True):
        schema.check_numbers(temperature, label, "K")
    emission = laid_on(emission, apparent, "the emission", "the inputs")
    change = laid_on(change, apparent, "the reflection", "the inputs")
    names = apparent["band"].values
    panels = [
        FilmPanel(apparent.sel(band=band) - zero_Celsius, f"input {band_label(band)}")
        for band in names
    ]
    panels.append(FilmPanel(emission - zero_Celsius, "emission"))
    panels.append(FilmPanel(change, "reflection less its mean", "[K]", symmetric=True))
    yield from film(panels, title=title + drawing.provenance_note(apparent))
