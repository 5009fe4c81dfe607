"""Figures of emissivities: tabulated, measured by contact, condition numbers of band pairs."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from dbthermal._coordinates import laid_on
from dbthermal.figures.drawing import COLORS, band_label, canvas, limits_of, provenance_note


def emissivity_bars(table: xr.Dataset) -> Figure:
    """Band emissivities (material, band) [1] as bars, one group per material."""
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
    axis.set_title("Planck-weighted band emissivity" + provenance_note(table))
    return figure


def condition_matrix(summary: xr.DataArray, materials: int) -> Figure:
    """Condition number of the emissivity matrix for every pair of bands, with its numbers.

    (first, second) [1], averaged over a number of materials; NaN or infinite on the diagonal.
    """
    figure, ((axis,),) = canvas(1, 1, (5.4, 4.6))
    values = np.where(np.isfinite(summary.values), summary.values, np.nan)
    drawn = axis.imshow(values, cmap="viridis_r")
    middle = np.mean(limits_of(summary.copy(data=values)))
    for row, column in np.ndindex(*values.shape):
        if np.isfinite(values[row, column]):
            color = "white" if values[row, column] > middle else "black"
            axis.text(
                column, row, f"{values[row, column]:.0f}", ha="center", va="center", color=color
            )
    for setter, dim in ((axis.set_xticks, "second"), (axis.set_yticks, "first")):
        setter(np.arange(summary.sizes[dim]), [band_label(name) for name in summary[dim].values])
    figure.colorbar(drawn, ax=axis, label="condition number [1]")
    statistic = summary.attrs.get("statistic", "average")
    axis.set_title(
        f"Condition number of band pairs\n({statistic} of {materials} materials; low is good)"
        + provenance_note(summary)
    )
    return figure


def emissivity_by_contact(measured: xr.Dataset, table: xr.DataArray | None = None) -> Figure:
    """Emissivities from thermocouple and blackbody with their standard deviations.

    One point per band and material, of `emissivity` and `emissivity_std` (material, band) [1], with
    tabulated values (material, band) [1] as crosses: of a simulation the truth.
    """
    figure, ((axis,),) = canvas(1, 1, (8.4, 3.8))
    if table is not None:
        table = laid_on(table, measured, "the table", "what was measured")
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
            color=COLORS[index],
            label=band_label(band),
        )
        if table is not None:
            label = "table" if index == 0 else None
            axis.plot(shifted, table.sel(band=band), "x", color="black", markersize=7, label=label)
    axis.set_xticks(place, [str(name).replace(" ", "\n") for name in measured["material"].values])
    axis.set(ylabel="emissivity [1]", ylim=(0, 1.05))
    figure.legend(frameon=False, loc="outside right center", fontsize=8)
    axis.set_title("Emissivity by contact, one standard deviation" + provenance_note(measured))
    return figure
