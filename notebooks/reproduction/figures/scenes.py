"""Figures of a scene beside its truth, and film of a separated scene."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.figure import Figure
from scipy.constants import zero_Celsius

from dbthermal import schema
from dbthermal._coordinates import laid_on
from dbthermal.figures import FilmPanel, drawing, film
from dbthermal.figures.drawing import COLORS, band_label, canvas, draw_image, limits_of

_CELSIUS: Final = "[\N{DEGREE SIGN}C]"


def camera_readings(
    apparent: xr.DataArray, truth: xr.Dataset | None, pixel: tuple[int, int]
) -> Figure:
    """Reading of each band (band, time, y, x) [K] over time at a pixel, and the true object."""
    figure, ((axis,),) = canvas(1, 1, (7.4, 3.4))
    place = {"y": pixel[0], "x": pixel[1]}
    for color, (name, reading) in zip(COLORS, apparent.isel(place).groupby("band"), strict=False):
        label = f"camera, {band_label(name)}"
        curve = reading.squeeze("band") - zero_Celsius
        axis.plot(apparent["time"], curve, color=color, linewidth=0.8, label=label)
    if truth is not None:
        true = truth["object_temperature"].isel(place) - zero_Celsius
        axis.plot(true["time"], true, "--", color="black", linewidth=1.2, label="true")
    axis.set(xlabel="time [s]", ylabel="temperature [\N{DEGREE SIGN}C]")
    axis.legend(frameon=False, fontsize=8)
    figure.suptitle(f"Readings at pixel {pixel}" + drawing.provenance_note(apparent))
    return figure


def raw_pictures(capture: xr.Dataset, time: float) -> Figure:
    """Raw counts (band, time, y, x) of each band at a time [s]."""
    counts = capture["counts"].sel(time=time, method="nearest")
    figure, axes = canvas(1, counts.sizes["band"], (4.2 * counts.sizes["band"], 3.4))
    for axis, (name, image) in zip(axes[0], counts.groupby("band"), strict=True):
        picture, title = image.squeeze("band"), f"{band_label(name)}, {time:.1f} s"
        draw_image(figure, axis, picture, title, "[count]", limits=limits_of(picture))
    figure.suptitle("Raw counts" + drawing.provenance_note(capture))
    return figure


def compared_pictures(
    films: Mapping[str, xr.DataArray],
    truth: xr.DataArray | None,
    times: Sequence[float],
    title: str,
) -> Figure:
    """Pictures of films (time, y, x) [K], a row a time [s], beside the truth, less it on the right.

    The first film's attributes say what the data are.
    """
    known = {} if truth is None else {"true": truth}
    shown = {
        name: values.sel(time=list(times), method="nearest") - zero_Celsius
        for name, values in {**films, **known}.items()
    }
    off = {f"{name} less true": shown[name] - shown["true"].values for name in films if known}
    first = next(iter(films.values()))
    rows, columns = len(times), len(shown) + len(off)
    size = (3.0 * columns, (2.4 * first.sizes["y"] / first.sizes["x"] + 0.5) * rows)
    figure, axes = canvas(rows, columns, size)
    # One range of colour for all temperatures, that of the last film, and one for all errors.
    last = list(shown.values())[-1]
    limits = (float(last.min()), float(last.max()))
    errors = limits_of(next(iter(off.values()), last), symmetric=True)
    for index, moment in enumerate(times):
        row = axes[index].tolist()
        for axis, (name, images) in zip(row, shown.items(), strict=False):
            text = f"{name}, {moment:.1f} s"
            draw_image(figure, axis, images[index], text, _CELSIUS, limits=limits)
        for axis, (name, images) in zip(row[len(shown) :], off.items(), strict=True):
            draw_image(figure, axis, images[index], name, "[K]", cmap="RdBu_r", limits=errors)
    figure.suptitle(title + drawing.provenance_note(first))
    return figure


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
