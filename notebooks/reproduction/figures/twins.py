"""Figures of twins: the thermocouple beside each method, and errors over the image."""

from collections.abc import Mapping
from math import isfinite

import xarray as xr
from matplotlib.figure import Figure
from scipy.constants import zero_Celsius

from dbthermal.figures.drawing import COLORS, canvas, draw_image, limits_of, provenance_note


def thermocouples(scores: xr.Dataset) -> Figure:
    """Reading of the thermocouple and estimates of all methods there, a panel a scene.

    `reading` (scene, time) and `temperature` (scene, variant, time) [K], `relative_error`
    (scene, variant) [percent of degrees Celsius].
    """
    count = scores.sizes["scene"]
    figure, axes = canvas(1, count, (5.6 * count, 4.0))
    for axis, name in zip(axes[0], scores["scene"].values, strict=True):
        here = scores.sel(scene=name)
        for index, variant in enumerate(here["variant"].values):
            part = here.sel(variant=variant)
            error = float(part["relative_error"])
            known = part["temperature"].dropna("time")
            axis.plot(
                known["time"],
                known - zero_Celsius,
                color=COLORS[index % len(COLORS)],
                linewidth=1,
                linestyle="-" if index < len(COLORS) else "--",
                label=f"{variant}, {error:.2g} %" if isfinite(error) else f"{variant}, no value",
            )
        reading = here["reading"] - zero_Celsius
        axis.plot(reading["time"], reading, color="black", linewidth=1.5, label="thermocouple")
        axis.set(xlabel="time [s]", title=str(name).replace("_", " "))
        axis.legend(frameon=False, fontsize=8)
    axes[0, 0].set_ylabel("object temperature [\N{DEGREE SIGN}C]")
    figure.suptitle("At the thermocouple" + provenance_note(scores))
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
    data = next(iter(errors.values()))
    figure.suptitle("Error of the object temperature, mean over frames" + provenance_note(data))
    return figure
