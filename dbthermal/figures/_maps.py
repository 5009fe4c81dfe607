"""Maps with words and numbers: accuracy to plan with, and pixels to trust."""

from collections.abc import Sequence
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.colors import LogNorm, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from dbthermal import schema
from dbthermal.figures import drawing
from dbthermal.figures.drawing import canvas, percent, plain_decades, provenance_note

_SCALE: Final = (0.1, 10.0)  # std at the ends of the colours [K]: as good, as bad as can be

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
    values, names = std.where(np.isfinite(std)).values, std["filter"].values.tolist()
    drawn = map_axis.imshow(values, cmap="viridis_r", norm=LogNorm(*_SCALE), aspect="auto")
    map_axis.set_facecolor("0.8")
    # Number of each cell, the best of a row framed.
    for row, column in np.ndindex(*values.shape):
        value, framed = values[row, column], expected["best"].values[row] == names[column]
        text = f"{value:.2g}" if np.isfinite(value) else "\N{EM DASH}"
        color = "white" if value > np.sqrt(_SCALE[0] * _SCALE[1]) else "black"
        frame = {"boxstyle": "round,pad=0.2", "fill": False, "edgecolor": color}
        style: dict[str, Any] = {"color": color, "fontsize": 8, "ha": "center", "va": "center"}
        map_axis.text(column, row, text, bbox=frame if framed else None, **style)
    map_axis.set_xticks(range(len(names)), names, fontsize=8)
    map_axis.set_yticks(range(len(values)), std["material"].values.tolist(), fontsize=8)
    bar = figure.colorbar(drawn, ax=map_axis, label="expected std [K]", shrink=0.8, extend="both")
    plain_decades(bar.ax)
    map_axis.set_xlabel(f"filter beside {expected.attrs['beside']} [{_MICRO}]")
    # Lines of the materials over the length.
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


REASONS: Final = MappingProxyType(
    {
        "completed_from_prior": ("completed, by a library's or stated emissivity", "#8e4585"),
        "completed_from_material": ("completed, by the same material elsewhere", "#d6619b"),
        "completed_from_surroundings": ("completed, by the surroundings", "#e78ac3"),
        "completed_frames": ("many frames completed", "#f7cfe2"),
        "dead_pixel": ("dead pixel", "#000000"),
        "saturated": ("saturated", "#4d4d4d"),
        "invalid_samples": ("no samples, as outside a view", "#737373"),
        "constant_signal": ("signal never changes", "#969696"),
        "frozen_frames": ("frozen frames, as by a shutter", "#bdbdbd"),
        "no_reflection_pair": ("reflection not seen by the second camera", "#d9d9d9"),
        "object_jump": ("object jumps", "#7f3b08"),
        "bands_apart": ("bands see the reflection at different times", "#b35806"),
        "object_not_smooth": ("object changes too fast, or noise is another", "#e08214"),
        "roles_may_be_swapped": ("object and reflection may be swapped", "#fdb863"),
        "no_background_motion": ("no motion reflected: nothing can be told", "#08306b"),
        "gray": ("same emissivity in all bands: nothing can be told", "#00868b"),
        "constant_object": ("object constant: emissivity unknown", "#6baed6"),
        "nonphysical_emissivity": ("emissivity outside 0 to 1", "#6a51a3"),
        "outside_response": ("outside the calibrated temperatures", "#9e9ac8"),
        "not_converged": ("not converged", "#dadaeb"),
        "background_never_rests": ("reflection never rests: emissivity doubtful", "#c7b299"),
    }
)
"""Words and colour of each flag, causes before consequences: a pixel with several is drawn as its
first. A completed pixel is drawn as completed, whatever the reason that it is not measured."""

_GOOD: Final = ("no flag", "#a8d5b0")


def status(result: xr.Dataset) -> Figure:
    """Map of the pixels without a flag, and of the most decisive flag of the others, in words.

    A colour for each flag that is the first of a pixel's, in the order of `REASONS`, and its share.

    Parameters
    ----------
    result : Dataset
        From `separation.solve` or `complete`: `status` (y, x), bits of `schema.Status`; ValueError
        for another bit.

    Examples
    --------
    >>> from dbthermal import figures, schema
    >>> bits = np.array([[0, 0, 0, int(schema.Status.DEAD_PIXEL)]], dtype=np.uint32)
    >>> figure = figures.status(xr.Dataset({"status": (("y", "x"), bits)}))
    >>> [text.get_text() for text in figure.axes[1].get_legend().get_texts()]
    ['75.0 %  no flag', '25.0 %  dead pixel']
    """
    schema.require(result, xr.Dataset, "result")
    codes, shown = legend(result["status"])  # the first flag of each pixel
    image = np.array([to_rgb(color) for _, color, _ in shown])[codes]
    height = 5.2 * codes.shape[0] / codes.shape[1]
    figure, axes = canvas(1, 2, (9.6, max(height, 0.25 * len(shown)) + 0.6))
    map_axis, legend_axis = axes[0]
    map_axis.get_gridspec().set_width_ratios([1.3, 1.0])
    map_axis.imshow(image, interpolation="nearest")
    map_axis.set(xticks=[], yticks=[])
    legend_axis.set_axis_off()
    # Legend with shares.
    patches = [
        Patch(facecolor=color, edgecolor="0.5", label=f"{percent(share)}  {words}")
        for words, color, share in shown
    ]
    legend_axis.legend(
        handles=patches, loc="upper left", borderaxespad=0.0, frameon=False, fontsize=9
    )
    shares = {words: share for words, _, share in shown}
    completed = sum(share for words, share in shares.items() if "completed" in words)
    good = f"{percent(shares.get(_GOOD[0], 0.0))} of the pixels have no flag"
    good += f", {percent(completed)} are completed" if completed else ""
    figure.suptitle(f"Status: {good}{provenance_note(result)}", fontsize="medium")
    return figure


def legend(flags: xr.DataArray) -> tuple[npt.NDArray[np.uint8], list[tuple[str, str, float]]]:
    """Place in the legend of each pixel of a `status`, and the legend: words, colour, share."""
    first, texts = first_reason(flags), {"": _GOOD, **REASONS}
    names = [name for name in texts if np.any(first == name)]
    codes = np.select([first == name for name in names], range(len(names))).astype(np.uint8)
    return codes, [(*texts[name], float(np.mean(first == name))) for name in names]


def first_reason(flags: xr.DataArray) -> npt.NDArray[np.str_]:
    """Name of the most decisive flag of each pixel of a `status`; empty without a flag."""
    bits = flags.values.astype(np.uint32)  # of older results they are of 16 bit
    unknown = int(np.bitwise_or.reduce(bits, axis=None)) & ~sum(schema.Status)
    if unknown:
        raise ValueError(f"Unknown bits {unknown} of a status. Must be of {schema.Status.bits()}.")
    names = sorted(schema.Status.bits(), key=list(REASONS).index)
    masks = [(bits & schema.Status.bits()[name]) != 0 for name in names]
    return np.select(masks, [np.array(name) for name in names], default=np.array(""))
