"""Figures of the calibration: gain and offset of the pixels, response of the bands."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from scipy.constants import zero_Celsius

from dbthermal import schema
from dbthermal.figures import drawing
from dbthermal.figures.drawing import COLORS, band_label, canvas, draw_image, limits_of


def gain_offset_maps(correction: xr.Dataset) -> Figure:
    """Maps of gain and offset, one row per band, with the bad pixels marked.

    Parameters
    ----------
    correction : Dataset
        From `correction.fit_correction`: `gain` [1], `offset` [count], `bad`, all (band, y, x).
    """
    bands = correction["band"].values
    figure, axes = canvas(len(bands), 2, (8.0, 2.8 * len(bands)))
    for row, band in zip(axes, bands, strict=True):
        fitted = correction.sel(band=band)
        good = ~fitted["bad"]
        bad = np.argwhere(fitted["bad"].values)
        maps = (("gain", "gain [1]", "viridis"), ("offset", "offset [count]", "cividis"))
        for axis, (name, label, cmap) in zip(row, maps, strict=True):
            image = fitted[name].where(good)
            title = f"{band_label(band)}: {name}, {len(bad)} bad pixels"
            draw_image(figure, axis, image, title, label, cmap=cmap, limits=limits_of(image))
            axis.plot(bad[:, 1], bad[:, 0], "x", color="red", markersize=3)
    figure.suptitle("Gain and offset correction" + drawing.provenance_note(correction))
    return figure


def response_fit(response: xr.Dataset, fine: xr.DataArray) -> Figure:
    """Response of each band with the residuals of both fits.

    From above: counts over temperature, the line's residuals, and those of the Sakuma-Hattori curve
    on a scale of their own, with the noise of one pixel and frame where the response has it.
    Residuals and noise are counts over the slope of the line.

    Parameters
    ----------
    response : Dataset
        From `calibration.fit_response`.
    fine : DataArray
        Fitted counts (band, temperature) on a fine grid of temperatures, from `response.counts`.
    """
    bands = response["band"].values
    schema.check_numbers(response["temperature"], "'temperature' of the response", "K")
    figure, axes = canvas(3, len(bands), (4.6 * len(bands), 7.2))
    celsius = response["temperature"] - zero_Celsius
    for column, band in enumerate(bands):
        curve, (top, middle, bottom) = response.sel(band=band), axes[:, column]
        top.plot(fine["temperature"] - zero_Celsius, fine.sel(band=band), color=COLORS[0])
        line = curve["linear_slope"] * fine["temperature"] + curve["linear_intercept"]
        top.plot(fine["temperature"] - zero_Celsius, line, "--", color=COLORS[2])
        top.plot(celsius, curve["counts"], ".", color=COLORS[1])
        top.set(title=band_label(band), ylabel="signal [count]")
        top.legend(["Sakuma-Hattori", "linear", "blackbody"], frameon=False, fontsize=8)
        kelvin = 1.0 / curve["linear_slope"]
        middle.plot(
            celsius, curve["linear_residual"] * kelvin, "s--", color=COLORS[2], markersize=3
        )
        middle.set(ylabel="residual of the line\n[K]")
        millikelvin = 1e3 * curve["residual"] * kelvin
        bottom.plot(celsius, millikelvin, "o-", color=COLORS[0], markersize=3)
        bottom.set(ylabel="residual of the curve\n[mK]")
        bottom.set_xlabel("blackbody temperature [\N{DEGREE SIGN}C]")
        if "noise" in curve:
            noise = 1e3 * float(curve["noise"] * kelvin)
            bottom.set_title(f"noise of one pixel and frame: {noise:.0f} mK", fontsize=8)
        for axis in (middle, bottom):
            axis.axhline(0.0, color="0.7", linewidth=0.8)
    figure.suptitle("Camera response" + drawing.provenance_note(response))
    return figure
