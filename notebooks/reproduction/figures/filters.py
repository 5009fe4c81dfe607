"""Figures of the choice of a filter: how well pairs of bands are conditioned."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from dbthermal.figures import drawing
from dbthermal.figures.drawing import band_label, canvas, limits_of


def condition_matrix(summary: xr.DataArray, materials: int) -> Figure:
    """Condition number of the emissivity matrix for every pair of bands.

    Parameters
    ----------
    summary : DataArray
        (first, second) [1], averaged over materials; NaN or infinite on the diagonal.
    materials : int
        Their number.
    """
    figure, ((axis,),) = canvas(1, 1, (5.4, 4.6))
    values = np.where(np.isfinite(summary.values), summary.values, np.nan)
    drawn = axis.imshow(values, cmap="viridis_r")
    middle = np.mean(limits_of(summary.copy(data=values)))
    for row, column in np.ndindex(*values.shape):
        if np.isfinite(values[row, column]):
            color = "white" if values[row, column] > middle else "black"
            text = f"{values[row, column]:.0f}"
            axis.text(column, row, text, ha="center", va="center", color=color)
    for setter, dim in ((axis.set_xticks, "second"), (axis.set_yticks, "first")):
        setter(np.arange(summary.sizes[dim]), [band_label(name) for name in summary[dim].values])
    figure.colorbar(drawn, ax=axis, label="condition number [1]")
    statistic = summary.attrs.get("statistic", "average")
    axis.set_title(
        f"Condition number of band pairs\n({statistic} of {materials} materials; low is good)"
        + drawing.provenance_note(summary)
    )
    return figure
