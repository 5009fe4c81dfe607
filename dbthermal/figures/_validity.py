"""Figures of validity: which pixels to trust, and for those not to trust, why, in words."""

from types import MappingProxyType
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from dbthermal import schema
from dbthermal.figures._canvas import COLORS, band_label, canvas, provenance_note

REASONS: Final = MappingProxyType(
    {
        "dead_pixel": ("dead pixel", "#000000"),
        "saturated": ("saturated", "#4d4d4d"),
        "invalid_samples": ("no samples, as outside a view", "#737373"),
        "constant_signal": ("signal never changes", "#969696"),
        "frozen_frames": ("frozen frames, as by a shutter", "#bdbdbd"),
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
"""Words and colour of each flag, causes before what follows: a pixel with several is drawn as its
first."""

_RIGHT: Final = "#a8d5b0"
_WRONG: Final = "#e3000f"
# What a 95 % interval should hold, and where the axis of the coverage begins [%].
_SPAN: Final = (92.0, 98.0)
_LOWEST: Final = 50.0
_ARROW: Final = 48.5
_DOTS: Final = (COLORS[0], COLORS[3], COLORS[4], COLORS[2])


def validity(stress: xr.Dataset) -> Figure:
    """
    What becomes of the pixels, case by case: right, wrong without a warning, or flagged and why.

    Left, a bar of all pixels: no flag and right; no flag and wrong, in red, the one thing that
    must not be; flagged, by the flag that says most. Right, how many of the 95 % intervals hold
    the truth, over the span from 92 to 98 %: of the object temperature in pixels without a flag,
    of the emissivities in all that have a value. What lies left of the axis is an arrow.

    Parameters
    ----------
    stress : Dataset
        From `experiments.stress.sweep`: `status` (case, pixel), `bad` (case, kind, pixel),
        `object_coverage` (case, among), `emissivity_coverage` (case, among, band) [1].

    Returns
    -------
    Figure
        A row a case.
    """
    figure, axes = canvas(1, 2, (12.5, 5.0))
    left, right = axes[0]
    left.get_gridspec().set_width_ratios([1.4, 1.0])
    _bars(left, stress["status"], stress["bad"].sel(kind="any"))
    found = {"object temperature, no flag": stress["object_coverage"].sel(among="unflagged")}
    for band in stress["band"].values:
        among_all = stress["emissivity_coverage"].sel(among="all", band=band)
        found[f"emissivity, {band_label(band)}, all with a value"] = among_all
    _dots(right, found)
    place = np.arange(stress.sizes["case"])
    left.set_yticks(place, stress["case"].values, fontsize=8)
    right.set_yticks(place, [""] * place.size)
    for axis in (left, right):
        axis.set_ylim(place.size - 0.4, -0.6)
        axis.spines[["top", "right"]].set_visible(False)
    style: dict[str, Any] = {"frameon": False, "fontsize": 8}
    words, dots = (axis.get_legend_handles_labels() for axis in (left, right))
    figure.legend(*words, loc="outside lower left", ncols=2, **style)
    rows = max(-(-len(words[1]) // 2), len(dots[1]))
    figure.set_figheight(0.29 * place.size + 0.18 * rows + 1.7)
    figure.legend(*dots, loc="outside lower right", **style)
    figure.suptitle("Which pixels can be trusted, and why not" + provenance_note(stress))
    return figure


def status(result: xr.Dataset) -> Figure:
    """
    Map of one capture's status in words: which pixels to trust, and for the others why not.

    Parameters
    ----------
    result : Dataset
        From `separation.solve`: `status` (y, x), bits of `schema.FLAGS`.

    Returns
    -------
    Figure
        A map with a colour for each flag that is the first of a pixel's, in the order of `REASONS`,
        and its share.

    Raises
    ------
    ValueError
        If a bit is none of `schema.FLAGS`.
    """
    first = _first_flag(result["status"])
    shares = {name: float(np.mean(first == name)) for name in ("", *REASONS)}
    shown = {name: share for name, share in shares.items() if share > 0}
    image = np.zeros((*first.shape, 3))
    for name in shown:
        image[first == name] = to_rgb(REASONS[name][1] if name else _RIGHT)
    height = 5.2 * first.shape[0] / first.shape[1]
    figure, axes = canvas(1, 2, (9.6, max(height, 0.25 * len(shown)) + 0.6))
    left, right = axes[0]
    left.get_gridspec().set_width_ratios([1.3, 1.0])
    left.imshow(image, interpolation="nearest")
    left.set(xticks=[], yticks=[])
    right.set_axis_off()
    patches = [_patch(name, share) for name, share in shown.items()]
    right.legend(handles=patches, loc="upper left", borderaxespad=0.0, frameon=False, fontsize=9)
    good = f"{_percent(shares[''])} of the pixels have no flag"
    figure.suptitle(f"Status: {good}" + provenance_note(result))
    return figure


def _percent(share: float) -> str:
    """A share in percent, that is not 0.0 where there is a pixel."""
    return "< 0.1 %" if 0 < share < 0.0005 else f"{100 * share:.1f} %"


def _patch(name: str, share: float) -> Patch:
    """Legend of a flag, or of no flag, with its share."""
    words, color = REASONS[name] if name else ("good", _RIGHT)
    return Patch(facecolor=color, edgecolor="0.5", label=f"{_percent(share)}  {words}")


def _first_flag(flags: xr.DataArray) -> npt.NDArray[np.str_]:
    """Name of the most decisive flag of each pixel; empty where there is none."""
    unknown = int(np.bitwise_or.reduce(flags.values, axis=None)) & ~sum(schema.FLAGS.values())
    if unknown:
        raise ValueError(f"Unknown bits {unknown} of a status. Must be of {dict(schema.FLAGS)}.")
    names = sorted(schema.FLAGS, key=list(REASONS).index)
    masks = [(flags.values & schema.FLAGS[name]) != 0 for name in names]
    return np.select(masks, [np.array(name) for name in names], default=np.array(""))


def _bars(axis: Axes, flags: xr.DataArray, bad: xr.DataArray) -> None:
    """Stacked bars (case): right, wrong, and each flag; the wrong ones as a number, too."""
    first, wrong = _first_flag(flags.transpose("case", "pixel")), bad.transpose("case", "pixel")
    parts = {
        "no flag and right": (_RIGHT, (first == "") & ~wrong.values),
        "no flag and wrong (error above 4 standard deviations)": (
            _WRONG,
            (first == "") & wrong.values,
        ),
    }
    parts |= {words: (color, first == name) for name, (words, color) in REASONS.items()}
    place, reached = np.arange(flags.sizes["case"]), np.zeros(flags.sizes["case"])
    for label, (color, mask) in parts.items():
        share = 100 * mask.mean(axis=1)
        if share.any() or color in {_RIGHT, _WRONG}:
            axis.barh(place, share, 0.8, left=reached, color=color, label=label)
        if color == _WRONG:
            _count(axis, share)
        reached += share
    axis.set(xlim=(0, 100), xlabel="share of the pixels [%]")


def _count(axis: Axes, share: npt.NDArray[np.float64]) -> None:
    """Shares of wrong pixels [%] at the end of the bars, for some are too few to be seen."""
    for row in np.flatnonzero(share).tolist():
        text = f"{_percent(share[row] / 100)} wrong"
        axis.text(101, row, text, color=_WRONG, fontsize=8, fontweight="bold", va="center")


def _dots(axis: Axes, coverage: dict[str, xr.DataArray]) -> None:
    """Coverage [%] of several quantities, a dot a case, over the span that it should lie in."""
    axis.axvspan(*_SPAN, color=_RIGHT, alpha=0.6, linewidth=0, label="92 to 98 %")
    for index, (label, share) in enumerate(coverage.items()):
        value = 100 * share.values
        place = np.arange(value.size) + 0.22 * (index - (len(coverage) - 1) / 2)
        color = _DOTS[index % len(_DOTS)]
        axis.plot(value, place, "o", color=color, markersize=5, label=label)
        low = place[value < _LOWEST]
        axis.plot(np.full(low.size, _ARROW), low, "<", color=color, markersize=5)
    empty = np.all([share.isnull() for share in coverage.values()], axis=0)
    for row in np.flatnonzero(empty).tolist():
        axis.text(
            _SPAN[0] - 2, row, "none to judge", color="0.5", fontsize=8, va="center", ha="right"
        )
    axis.set(xlim=(_LOWEST - 3, 100.5), xlabel="95 % intervals that hold the truth [%]")
    axis.set_title(f"arrow: below {_LOWEST:.0f} %", loc="left", fontsize=8, color="0.4")
    axis.grid(visible=True, axis="y", color="0.93")
    axis.set_axisbelow(True)
