"""Figure of the planner: accuracy to expect of a recording, filter by filter."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from dbthermal.figures import drawing
from dbthermal.figures.drawing import canvas, plain_decades

# Deviations [K] at the ends of the colour map; beyond, a filter is as good or as bad as can be.
_SCALE: Final = (0.1, 10.0)

_MICRO: Final = "\N{MICRO SIGN}m"


def plan(expected: xr.Dataset, durations: xr.Dataset, materials: Sequence[str]) -> Figure:
    """Expected accuracy of the object temperature by filter, and by length of the film.

    Left, a map with its numbers, the best filter of each material framed; right, lines over the
    length.

    Parameters
    ----------
    expected : Dataset
        From `limits.plan`: `object_temperature_std` (material, filter) [K], `best` (material),
        the attribute `beside`.
    durations : Dataset
        From `limits.plan_durations`: `object_temperature_std` (seconds, material, filter) [K].
    materials : sequence of str
        Materials of the lines, each with its best filter; one with none is left out.
    """
    std = expected["object_temperature_std"]
    size = (7.8 + 0.75 * std.sizes["filter"], max(4.2, 0.24 * std.sizes["material"] + 1.9))
    figure, ((map_axis, bar_axis),) = canvas(1, 2, size)
    drawn = _map(map_axis, std, expected["best"])
    bar = figure.colorbar(drawn, ax=map_axis, label="expected std [K]", shrink=0.8, extend="both")
    plain_decades(bar.ax)
    map_axis.set_xlabel(f"filter beside {expected.attrs['beside']} [{_MICRO}]")
    best = expected["best"].sel(material=list(materials))
    filtered = best[np.isin(best.values, std["filter"].values)]
    for index, name in enumerate(filtered["material"].values):
        chosen = str(filtered.sel(material=name).item())
        bar_axis.loglog(
            durations["seconds"],
            durations["object_temperature_std"].sel(material=name, filter=chosen),
            label=f"{name}, {chosen} {_MICRO}",
            **drawing.marked_line(index),
        )
    drawing.plain_ticks(bar_axis, durations["seconds"])
    plain_decades(bar_axis)
    bar_axis.set(xlabel="length of the film [s]", ylabel="expected std [K]")
    if filtered.size:
        bar_axis.legend(frameon=False, fontsize=8, loc="upper right")
    title = "Object temperature of one pixel, expected standard deviation"
    figure.suptitle(title + drawing.provenance_note(expected))
    return figure


def _map(axis: Axes, std: xr.DataArray, best: xr.DataArray) -> AxesImage:
    """Map of deviations (material, filter) with numbers, the best of each row framed."""
    values = np.where(np.isfinite(std.values), std.values, np.nan)
    drawn = axis.imshow(values, cmap="viridis_r", norm=LogNorm(*_SCALE), aspect="auto")
    axis.set_facecolor("0.8")
    names = std["filter"].values.tolist()
    for row, column in np.ndindex(*values.shape):
        value, framed = values[row, column], best.values[row] == names[column]
        text = f"{value:.2g}" if np.isfinite(value) else "\N{EM DASH}"
        color = "white" if value > np.sqrt(_SCALE[0] * _SCALE[1]) else "black"
        frame = {"boxstyle": "round,pad=0.2", "fill": False, "edgecolor": color}
        style: dict[str, Any] = {"color": color, "fontsize": 8, "ha": "center", "va": "center"}
        axis.text(column, row, text, bbox=frame if framed else None, **style)
    axis.set_xticks(range(len(names)), names, fontsize=8)
    axis.set_yticks(range(len(values)), std["material"].values.tolist(), fontsize=8)
    return drawn
