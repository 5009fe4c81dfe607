"""Figures of band emissivities, from a table and by contact."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from dbthermal._coordinates import laid_on
from dbthermal.figures import drawing
from dbthermal.figures.drawing import COLORS, band_label, canvas


def emissivity_bars(table: xr.Dataset) -> Figure:
    """Band emissivities (material, band) [1] as bars, one group per material.

    Parameters
    ----------
    table : Dataset
        From `emissivity.band_table`: `emissivity` (material, band) [1].
    """
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
    """Emissivities from thermocouple and blackbody with their standard deviations.

    Parameters
    ----------
    measured : Dataset
        `emissivity`, `emissivity_std` (material, band) [1].
    table : DataArray, optional
        Tabulated values (material, band) [1], drawn as crosses: of a simulation the truth.
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
    axis.set_title(
        "Emissivity by contact, one standard deviation" + drawing.provenance_note(measured)
    )
    return figure
