"""Figures of the calibration: pixels, response, emissivities, and the choice of a filter."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from scipy.constants import zero_Celsius

from dbthermal import schema
from dbthermal.figures import drawing
from dbthermal.figures.drawing import COLORS, band_label, canvas, draw_image, limits_of
from dbthermal.schema import laid_on
from reproduction.figures.comparison import number_cells


def gain_offset_maps(correction: xr.Dataset) -> Figure:
    """Maps of gain and offset, one row per band, with the bad pixels marked.

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
    Residuals and noise are counts over the slope of the line. The response is from
    `calibration.fit_response`; `fine` are its fitted counts (band, temperature) on a fine grid of
    temperatures, from `response.counts`.
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
        residual = curve["linear_residual"] * kelvin
        middle.plot(celsius, residual, "s--", color=COLORS[2], markersize=3)
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


def emissivity_bars(table: xr.Dataset) -> Figure:
    """Band emissivities (material, band) [1] of `emissivity.band_table` as bars, by material."""
    materials, bands = table["material"].values, table["band"].values
    figure, ((axis,),) = canvas(1, 1, (max(7.0, 0.62 * len(materials)), 4.6))
    width = 0.8 / len(bands)
    for index, band in enumerate(bands):
        place = np.arange(len(materials)) + width * (index - (len(bands) - 1) / 2)
        values = table["emissivity"].sel(band=band)
        axis.bar(place, values, width, color=COLORS[index % len(COLORS)], label=band_label(band))
    axis.margins(x=0.01)
    axis.set_xticks(np.arange(len(materials)), materials, rotation=45, ha="right", fontsize=8)
    axis.set(ylabel="band emissivity [1]", ylim=(0, 1.12))
    axis.legend(frameon=False, ncols=len(bands), loc="upper center", fontsize=8)
    axis.set_title("Planck-weighted band emissivity" + drawing.provenance_note(table))
    return figure


def emissivity_by_contact(measured: xr.Dataset, table: xr.DataArray | None = None) -> Figure:
    """Emissivities (material, band) [1] by thermocouple and blackbody, with standard deviations.

    `emissivity` and `emissivity_std`; tabulated values, of a simulation the truth, are crosses.
    """
    figure, ((axis,),) = canvas(1, 1, (8.4, 3.8))
    if table is not None:
        table = laid_on(table, measured, "the table", "what was measured")
    place = np.arange(measured.sizes["material"])
    bands = measured["band"].values
    for index, band in enumerate(bands):
        series = measured.sel(band=band)
        shifted = place + 0.14 * (index - (len(bands) - 1) / 2)
        style: dict[str, Any] = {"fmt": "o", "markersize": 4, "capsize": 3, "color": COLORS[index]}
        style["label"] = band_label(band)
        axis.errorbar(shifted, series["emissivity"], series["emissivity_std"], **style)
        if table is not None:
            label = "table" if index == 0 else None
            axis.plot(shifted, table.sel(band=band), "x", color="black", markersize=7, label=label)
    axis.set_xticks(place, [str(name).replace(" ", "\n") for name in measured["material"].values])
    axis.set(ylabel="emissivity [1]", ylim=(0, 1.05))
    figure.legend(frameon=False, loc="outside right center", fontsize=8)
    note = drawing.provenance_note(measured)
    axis.set_title(f"Emissivity by contact, one standard deviation{note}")
    return figure


def condition_matrix(summary: xr.DataArray, materials: int) -> Figure:
    """Condition number of the emissivity matrix for every pair of bands, over some materials.

    (first, second) [1], averaged over the materials; NaN or infinite on the diagonal.
    """
    figure, ((axis,),) = canvas(1, 1, (5.4, 4.6))
    values = np.where(np.isfinite(summary.values), summary.values, np.nan)
    drawn = axis.imshow(values, cmap="viridis_r")
    middle = np.mean(limits_of(summary.copy(data=values)))
    number_cells(axis, values, float(middle), "{:.0f}")
    for setter, dim in ((axis.set_xticks, "second"), (axis.set_yticks, "first")):
        setter(np.arange(summary.sizes[dim]), [band_label(name) for name in summary[dim].values])
    figure.colorbar(drawn, ax=axis, label="condition number [1]")
    statistic = summary.attrs.get("statistic", "average")
    axis.set_title(
        f"Condition number of band pairs\n({statistic} of {materials} materials; low is good)"
        + drawing.provenance_note(summary)
    )
    return figure
