"""Figure of a recording while it goes on: a picture of each band, and of separated temperatures."""

from collections.abc import Mapping
from dataclasses import dataclass
from textwrap import fill
from typing import Any, Final

import numpy.typing as npt
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, ScalarFormatter

from dbthermal.figures.drawing import band_label, canvas, draw_image

_WIDTH: Final = 4.8  # of a picture [inch]
_TEXT_HEIGHT: Final = 1.15  # of title, lines and foot [inch]
_BAR: Final = 0.76  # of its width that a picture takes, beside the colour bar
_LETTERS: Final = 75  # of a line of the foot, per picture
_TICKS: Final = 4  # intervals of the colour bar at most: every number costs a millisecond
_ALARM: Final = "#b3001b"
_BOX: Final = {"facecolor": "white", "edgecolor": _ALARM, "alpha": 0.85, "pad": 3.0}


@dataclass(frozen=True, eq=False)
class Panel:
    """Picture and texts of one band, or of one temperature.

    Attributes
    ----------
    image : array
        Raw signal (y, x) [count], or a temperature [degree Celsius]; NaN is gray.
    limits : tuple of float
        Values at both ends of the colours.
    text, warning : str
        Texts below and across the picture.
    is_temperature : bool
        True for a temperature, False for the raw signal of a band.
    """

    image: npt.NDArray[Any]
    limits: tuple[float, float]
    text: str
    warning: str = ""
    is_temperature: bool = False


def live(panels: Mapping[str, Panel], *, title: str, foot: str = "") -> Figure:
    """Figure of the last frames of a recording, side by side.

    Parameters
    ----------
    panels : mapping of str to Panel
        Band, or name of a temperature, to its picture; all of one shape.
    title, foot : str
        Texts above and below, which belong to no picture.

    Examples
    --------
    >>> import numpy as np
    >>> figure = live({"9.5": Panel(np.zeros((24, 32)), (0, 1), "no frame yet")}, title="pot")
    >>> figure.axes[0].get_xlabel()
    'no frame yet'
    """
    rows, columns = next(iter(panels.values())).image.shape
    height = _BAR * _WIDTH * rows / columns + _TEXT_HEIGHT
    figure, axes = canvas(1, len(panels), (_WIDTH * len(panels), height))
    for axis, (name, panel) in zip(axes[0], panels.items(), strict=True):
        # The picture, with few whole numbers at its colour bar.
        shown = name, "temperature [\N{DEGREE SIGN}C]", "inferno"
        if not panel.is_temperature:
            shown = band_label(name), "raw signal [count]", "gray"
        image, (heading, label, cmap) = xr.DataArray(panel.image, dims=("y", "x")), shown
        draw_image(figure, axis, image, heading, label, cmap=cmap, limits=panel.limits)
        bar = axis.images[0].colorbar
        bar.locator, bar.formatter = MaxNLocator(_TICKS, integer=True), ScalarFormatter()
        # Its texts.
        axis.set_xlabel(panel.text, loc="left", fontsize=9)
        if panel.warning:
            place: dict[str, Any] = {"transform": axis.transAxes, "va": "top", "fontsize": 9}
            axis.text(0.02, 0.97, panel.warning, color=_ALARM, bbox=_BOX, **place)
    figure.suptitle(title)
    figure.supxlabel(fill(foot, _LETTERS * len(panels)), fontsize=9)
    return figure
