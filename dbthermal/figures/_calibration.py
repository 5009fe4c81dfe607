"""Figures of the calibration: gain and offset of the pixels, response of the bands."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from scipy.constants import zero_Celsius

from dbthermal.figures.drawing import (
    COLORS,
    band_label,
    canvas,
    draw_image,
    limits_of,
    provenance_note,
)


def gain_offset_maps(correction: xr.Dataset) -> Figure:
    """Maps of gain and offset, one row per band, with the bad pixels marked.

    Of `gain` [1], `offset` [count] and `bad`, all (band, y, x), from `correction.fit_correction`.
    """
    bands = correction["band"].values
    figure, axes = canvas(len(bands), 2, (8.0, 2.8 * len(bands)))
    for row, band in zip(axes, bands, strict=True):
        here = correction.sel(band=band)
        good = ~here["bad"]
        bad = np.argwhere(here["bad"].values)
        parts = (("gain", "gain [1]", "viridis"), ("offset", "offset [count]", "cividis"))
        for axis, (name, label, cmap) in zip(row, parts, strict=True):
            image = here[name].where(good)
            title = f"{band_label(band)}: {name}, {len(bad)} bad pixels"
            draw_image(figure, axis, image, title, label, cmap=cmap, limits=limits_of(image))
            axis.plot(bad[:, 1], bad[:, 0], "x", color="red", markersize=3)
    figure.suptitle("Gain and offset correction" + provenance_note(correction))
    return figure


def response_fit(response: xr.Dataset, fine: xr.DataArray) -> Figure:
    """Response of each band with the residuals of both fits.

    Of a response from `calibration.fit_response`, and the fitted counts (band, temperature) on a
    fine grid of temperatures, from `response.counts`. From above: counts over temperature, the
    line's residuals, and those of the Sakuma-Hattori curve on a scale of their own, with the noise
    of one pixel and frame where the response has it; residuals and noise over the slope of the
    line.
    """
    bands = response["band"].values
    figure, axes = canvas(3, len(bands), (4.6 * len(bands), 7.2))
    celsius = response["temperature"] - zero_Celsius
    for column, band in enumerate(bands):
        here, (top, middle, bottom) = response.sel(band=band), axes[:, column]
        top.plot(fine["temperature"] - zero_Celsius, fine.sel(band=band), color=COLORS[0])
        line = here["linear_slope"] * fine["temperature"] + here["linear_intercept"]
        top.plot(fine["temperature"] - zero_Celsius, line, "--", color=COLORS[2])
        top.plot(celsius, here["counts"], ".", color=COLORS[1])
        top.set(title=band_label(band), ylabel="signal [count]")
        top.legend(["Sakuma-Hattori", "linear", "blackbody"], frameon=False, fontsize=8)
        kelvin = 1.0 / here["linear_slope"]
        middle.plot(celsius, here["linear_residual"] * kelvin, "s--", color=COLORS[2], markersize=3)
        middle.set(ylabel="residual of the line\n[K]")
        millikelvin = 1e3 * here["residual"] * kelvin
        bottom.plot(celsius, millikelvin, "o-", color=COLORS[0], markersize=3)
        bottom.set(ylabel="residual of the curve\n[mK]")
        bottom.set_xlabel("blackbody temperature [\N{DEGREE SIGN}C]")
        if "noise" in here:
            noise = 1e3 * float(here["noise"] * kelvin)
            bottom.set_title(f"noise of one pixel and frame: {noise:.0f} mK", fontsize=8)
        for axis in (middle, bottom):
            axis.axhline(0.0, color="0.7", linewidth=0.8)
    figure.suptitle("Camera response" + provenance_note(response))
    return figure
