"""Figures of materials: band emissivities, condition numbers of band pairs."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from dbthermal.figures._canvas import (
    COLORS,
    band_label,
    canvas,
    draw_image,
    limits_of,
    provenance_note,
)


def emissivity_bars(table: xr.Dataset) -> Figure:
    """
    Band emissivities as bars, a group a material.

    Parameters
    ----------
    table : Dataset
        From `emissivity.band_table`: `emissivity` (material, band) [1].

    Returns
    -------
    Figure
        Bars.
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
    axis.set_title("Planck-weighted band emissivity" + provenance_note(table))
    return figure


def condition_matrix(summary: xr.DataArray, materials: int) -> Figure:
    """
    Condition number of the emissivity matrix for every pair of bands.

    Parameters
    ----------
    summary : DataArray
        (first, second) [1], averaged over materials; NaN or infinite on the diagonal.
    materials : int
        Number of materials that the average is over.

    Returns
    -------
    Figure
        Matrix with its numbers.
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


def pooled_materials(
    single: xr.DataArray, pooled: xr.DataArray, labels: xr.DataArray, panels: xr.DataArray
) -> Figure:
    """
    The reflection ratio pixel by pixel, and pooled over the materials found.

    Parameters
    ----------
    single, pooled : DataArray
        Reflection ratio (y, x) [1] without and with pooling.
    labels : DataArray
        Materials found (y, x), -1 for none.
    panels : DataArray
        True materials (y, x), whose borders are drawn.

    Returns
    -------
    Figure
        Three maps, with the true borders as lines.
    """
    figure, ((left, middle, right),) = canvas(1, 3, (12.0, 3.4))
    limits = limits_of(single)
    for axis, ratio, title in ((left, single, "pixel by pixel"), (middle, pooled, "pooled")):
        draw_image(
            figure, axis, ratio, title, "reflection ratio [1]", cmap="viridis", limits=limits
        )
    found = labels.where(labels >= 0)
    title = f"materials found: {np.unique(found.values[found.notnull().values]).size}"
    right.imshow(found % 10, cmap="tab10", vmin=0, vmax=9, interpolation="nearest")
    right.set_facecolor("0.8")
    right.set_title(title, fontsize=9)
    for axis in (left, middle, right):
        for one in np.unique(panels.values)[1:]:
            axis.contour(panels.values >= one, levels=[0.5], colors="white", linewidths=0.8)
        axis.set(xticks=[], yticks=[])
    figure.suptitle("Pixels of one material share their ratio" + provenance_note(single))
    return figure
