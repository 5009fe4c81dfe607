"""Figures of scenes: beside their truth, as twins, under a sky, as a film."""

from collections.abc import Iterator, Mapping, Sequence
from math import isfinite
from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.figure import Figure
from scipy.constants import zero_Celsius

from dbthermal import schema
from dbthermal.figures import FilmPanel, drawing, film
from dbthermal.figures.drawing import COLORS, band_label, canvas, draw_image, limits_of
from dbthermal.schema import laid_on

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
    reference = {} if truth is None else {"true": truth}
    shown = {
        name: values.sel(time=list(times), method="nearest") - zero_Celsius
        for name, values in {**films, **reference}.items()
    }
    off = {f"{name} less true": shown[name] - shown["true"].values for name in films if reference}
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
    """Truth against estimate over time at a pixel (row, column), with two standard deviations.

    Object above, background below, of a scene with `object_temperature` and
    `background_temperature` (time, y, x) [K] and a result from `separation.solve`.
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
    """Frames, as of `film`, of the inputs, the emission and the mean-subtracted reflection.

    All as for `dbthermal.figures.separated_temperatures` [K]; pixels without a value are gray.
    """
    labels = ("the inputs", "the emission", "the reflection")
    for temperature, label in zip((apparent, emission, change), labels, strict=True):
        schema.check_numbers(temperature, label, "K")
    emission = laid_on(emission, apparent, "the emission", "the inputs")
    change = laid_on(change, apparent, "the reflection", "the inputs")
    names = apparent["band"].values
    inputs = {name: apparent.sel(band=name) - zero_Celsius for name in names}
    panels = [FilmPanel(image, f"input {band_label(name)}") for name, image in inputs.items()]
    panels.append(FilmPanel(emission - zero_Celsius, "emission"))
    panels.append(FilmPanel(change, "reflection less its mean", "[K]", symmetric=True))
    yield from film(panels, title=title + drawing.provenance_note(apparent))


def thermocouples(scores: xr.Dataset) -> Figure:
    """Reading of the thermocouple and estimates of all methods there, a panel a scene.

    `reading` (scene, time) and `temperature` (scene, variant, time) [K], `relative_error`
    (scene, variant) [percent of degrees Celsius].
    """
    count = scores.sizes["scene"]
    figure, axes = canvas(1, count, (5.6 * count, 4.0))
    for axis, name in zip(axes[0], scores["scene"].values, strict=True):
        of_scene = scores.sel(scene=name)
        for index, variant in enumerate(of_scene["variant"].values):
            of_variant = of_scene.sel(variant=variant)
            error = float(of_variant["relative_error"])
            read = of_variant["temperature"].dropna("time") - zero_Celsius
            label = f"{variant}, {error:.2g} %" if isfinite(error) else f"{variant}, no value"
            line = {"color": COLORS[index % len(COLORS)], "linewidth": 1, "label": label}
            axis.plot(read["time"], read, "-" if index < len(COLORS) else "--", **line)
        reading = of_scene["reading"] - zero_Celsius
        axis.plot(reading["time"], reading, color="black", linewidth=1.5, label="thermocouple")
        axis.set(xlabel="time [s]", title=str(name).replace("_", " "))
        axis.legend(frameon=False, fontsize=8)
    axes[0, 0].set_ylabel("object temperature [\N{DEGREE SIGN}C]")
    figure.suptitle("At the thermocouple" + drawing.provenance_note(scores))
    return figure


def error_maps(picture: xr.DataArray, errors: Mapping[str, xr.DataArray]) -> Figure:
    """Maps of the error (y, x) [K] of each method, beside the apparent temperature (y, x) [K].

    Pixels without a value are gray; each map has its own scale.
    """
    count = 1 + len(errors)
    aspect = picture.sizes["y"] / picture.sizes["x"]
    figure, axes = canvas(1, count, (4.2 * count, 3.3 * aspect + 1.0))
    shown = picture - zero_Celsius
    unit = "apparent [\N{DEGREE SIGN}C]"
    draw_image(figure, axes[0, 0], shown, "input", unit, limits=limits_of(shown))
    for axis, (name, error) in zip(axes[0, 1:], errors.items(), strict=True):
        scale = (0.0, limits_of(error)[1])
        draw_image(figure, axis, error, name, "mean error [K]", cmap="magma_r", limits=scale)
    note = drawing.provenance_note(next(iter(errors.values())))
    figure.suptitle(f"Error of the object temperature, mean over frames{note}")
    return figure


def hours(readings: xr.DataArray, middles: Sequence[float], flags: Sequence[str]) -> Figure:
    """Readings of two bands over a day, above them the flags of the separated stretches.

    Temperatures (band, time) [K], time [s] from midnight; the middle of each stretch [h], and its
    flags, by commas.
    """
    figure, ((axis,),) = canvas(1, 1, (8.0, 3.6))
    celsius, time = readings - zero_Celsius, readings["time"] / 3600.0
    for name in readings["band"].values:
        axis.plot(time, celsius.sel(band=name), lw=0.7, label=str(name))
    low, high = float(celsius.min()), float(celsius.max())
    for hour, words in zip(middles, flags, strict=True):
        text, place = words.replace(", ", "\n") or "no flag", high + 0.1 * (high - low)
        axis.text(hour, place, text, ha="center", va="bottom", rotation=90, fontsize=6)
    axis.set(ylim=(low - 1.0, high + 0.9 * (high - low)), xlim=(0.0, 24.0))
    axis.set_xlabel("universal time [h]")
    axis.set_ylabel("reading [°C]")
    axis.legend(loc="lower right", fontsize=7)
    axis.set_title("Grass, Oklahoma, 1 June 2019" + drawing.provenance_note(readings))
    return figure


def sky_changes(sky: xr.DataArray, gains: xr.DataArray) -> Figure:
    """Changes of a sky (band, time) [K] in each band over those in the first, with their ratio."""
    names = [str(name) for name in sky["band"].values]
    figure, (axes,) = canvas(1, len(names) - 1, (2.4 * (len(names) - 1), 2.7))
    changes = sky.diff("time")
    reach = 1.1 * float(np.abs(changes).max())
    for axis, name in zip(axes, names[1:], strict=True):
        axis.plot(changes[0], changes.sel(band=name), "k.", ms=3)
        line = np.array([-reach, reach])
        axis.plot(line, line, "0.7", lw=1)
        axis.plot(line, float(gains.sel(band=name)) * line, "C3", lw=1)
        axis.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
        axis.set_xlabel(f"change, {band_label(names[0])} [K]")
        axis.set_ylabel(f"change, {band_label(name)} [K]")
        axis.set_title(f"{float(gains.sel(band=name)):.2f} times")
    note = drawing.provenance_note(sky)
    figure.suptitle(f"The sky overhead from spectrum to spectrum; gray line: a gray sky{note}")
    return figure
