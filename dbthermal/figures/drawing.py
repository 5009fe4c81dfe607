"""Parts that all figures share: canvas, colours, labels, images, limits, plain ticks."""

from typing import Any, Final

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

__all__ = ["COLORS", "band_label", "canvas", "draw_image", "limits_of", "provenance_note"]
__dir__ = __all__.copy

COLORS: Final = ("#0072b2", "#d55e00", "#009e73", "#e69f00", "#cc79a7")
"""Colours of the bands, in their order, told apart by the colour-blind (Wong 2011,
doi:10.1038/nmeth.1618)."""

TALLEST: Final = 12.0  # row of a figure [inch]; codecs of films end at 16384 pixels

MARKERS: Final = "osD^vPX*"  # of lines, in their order


def canvas(
    rows: int, columns: int, size: tuple[float, float]
) -> tuple[Figure, npt.NDArray[np.object_]]:
    """Figure and axes (rows, columns), which are not registered with pyplot.

    Parameters
    ----------
    rows, columns : int
        Numbers of axes.
    size : tuple of float
        Width and height [inch]; both less in proportion if a style in force is narrower. A row is
        at most `TALLEST`, beside which tall images are narrow.
    """
    size = size[0], min(size[1], rows * TALLEST)
    width = mpl.rcParams["figure.figsize"][0]
    if width != mpl.rcParamsDefault["figure.figsize"][0] and width < size[0]:
        size = width, size[1] * width / size[0]
    figure, axes = plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained")
    plt.close(figure)
    return figure, axes


def band_label(name: object) -> str:
    """Label of a band: of wavelengths with their unit, a micro sign in "9.5 um"; else its name.

    Parameters
    ----------
    name : object
        Name of the band.
    """
    is_free = str(name).strip("0123456789.-")  # names of bands are free, such as "wide"
    return str(name) if is_free else f"{name} \N{MICRO SIGN}m"


def provenance_note(data: xr.Dataset | xr.DataArray) -> str:
    """Origin of the data in brackets, for a title; empty for measured radiometric data.

    Parameters
    ----------
    data : Dataset or DataArray
        With the attributes `origin` ("simulated", "measured", ...), `twin` (name of the scene that
        a simulation is a twin of) and `radiometric` (0 if the values are a picture's and not
        counts).
    """
    notes = []
    origin = str(data.attrs.get("origin", ""))
    if origin.startswith("simulated"):
        notes.append("simulated twin" if "twin" in data.attrs else origin)
    if data.attrs.get("radiometric", 1) == 0:
        notes.append("not radiometric")
    if "calibration" in data.attrs:
        notes.append(str(data.attrs["calibration"]))
    return f" ({', '.join(notes)})" if notes else ""


def draw_image(
    figure: Figure,
    axis: Axes,
    image: xr.DataArray,
    title: str,
    label: str,
    *,
    cmap: str = "inferno",
    limits: tuple[float, float] | None = None,
) -> None:
    """Draw an image (y, x) with its colour bar; pixels without a value are gray.

    Parameters
    ----------
    figure, axis, image : Figure, Axes, DataArray
        Where to draw; image (y, x).
    title, label, cmap : str
        Title, label of the colour bar with its unit, and colour map.
    limits : tuple of float, optional
        Values at the ends of the colour map; the image's own if not given.
    """
    lowest, highest = limits or (None, None)
    drawn = axis.imshow(image.values, cmap=cmap, vmin=lowest, vmax=highest, interpolation="nearest")
    axis.set(facecolor="0.8", xticks=[], yticks=[])
    axis.set_title(title, fontsize=min(9.0, mpl.rcParams["font.size"]))
    figure.colorbar(drawn, ax=axis, label=label, shrink=0.85)


def limits_of(image: xr.DataArray, *, symmetric: bool = False) -> tuple[float, float]:
    """Range that holds all but one in a hundred of the values at either end.

    Parameters
    ----------
    image, symmetric : DataArray, bool
        Values, of any shape and unit; True for a range that is symmetric about zero.
    """
    values = image.values[np.isfinite(image.values)]
    if values.size == 0:
        return 0.0, 1.0
    lowest, highest = np.percentile(values, [1, 99])
    if symmetric:
        highest = max(abs(lowest), abs(highest))
        lowest = -highest
    return float(lowest), float(highest) if highest > lowest else float(lowest) + 1.0


def marked_line(index: int) -> dict[str, Any]:
    """Style of one of several lines with markers, by its number."""
    color, marker = COLORS[index % len(COLORS)], MARKERS[index % len(MARKERS)]
    return {"color": color, "marker": marker, "markersize": 4, "linewidth": 1}


def plain_ticks(axis: Axes, places: xr.DataArray) -> None:
    """Ticks at some places of a logarithmic horizontal axis, as plain numbers, and a grid."""
    axis.set_xticks(places.values, [f"{place:g}" for place in places.values], fontsize=8)
    axis.set_xticks([], minor=True)
    axis.grid(visible=True, which="major", color="0.9")


def plain_decades(axis: Axes) -> None:
    """Ticks at 1, 2 and 5 of each decade of a logarithmic vertical axis, as plain numbers."""
    axis.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.yaxis.set_minor_locator(NullLocator())


def percent(share: float) -> str:
    """Share [1] in percent as text; less than 0.1 % is not rounded to zero."""
    return "< 0.1 %" if 0 < share < 0.0005 else f"{100 * share:.1f} %"
