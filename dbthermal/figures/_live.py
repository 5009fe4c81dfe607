"""Figure of a recording while it goes on: one picture of each band, updated in place.

The artists are made once. An update gives them new pictures and texts, and the layout is computed
again only where these need other room, so that an update is cheap.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from textwrap import fill
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.text import Text
from matplotlib.ticker import MaxNLocator, ScalarFormatter

from dbthermal.figures.drawing import band_label, canvas, draw_image

_WIDTH: Final = 4.8  # of a band [inch]
_TEXT_HEIGHT: Final = 1.15  # of title, lines and foot [inch]
_BAR: Final = 0.76  # of a band's width that its picture takes, beside the colour bar
_LETTERS: Final = 75  # of a line of the foot, per band
_TICKS: Final = 4  # intervals of the colour bar at most: every number costs a millisecond
_CELSIUS: Final = "temperature [\N{DEGREE SIGN}C]"
_ALARM: Final = "#b3001b"


@dataclass(frozen=True, eq=False)
class Panel:
    """Picture and texts of one band.

    Attributes
    ----------
    image : array or None
        Raw signal (y, x) [count], or a temperature [degree Celsius]; None before the first one.
    limits : tuple of float
        Values at both ends of the colours.
    text, warning : str
        Texts below and across the picture.
    """

    image: npt.NDArray[Any] | None
    limits: tuple[float, float]
    text: str
    warning: str = ""


class LiveFigure:
    """Figure whose pictures and texts are replaced while it stays the same.

    Parameters
    ----------
    bands : sequence of str
        Their names, in the order of the pictures.
    shape : tuple of int
        Rows and columns of every picture [pixel].
    temperatures : sequence of str
        Names of pictures of temperatures beside them.

    Attributes
    ----------
    figure : Figure
        Of matplotlib.

    Examples
    --------
    >>> live = LiveFigure(["9.5"], (24, 32))
    >>> live.update({"9.5": Panel(None, (0, 1), "no frame yet")}, title="pot")
    >>> live.pixels().shape[-1]
    4
    """

    def __init__(
        self, bands: Sequence[str], shape: tuple[int, int], temperatures: Sequence[str] = ()
    ) -> None:
        self.bands, self.shape = tuple(bands), shape
        number = len(bands) + len(temperatures)
        height = _BAR * _WIDTH * shape[0] / shape[1] + _TEXT_HEIGHT
        self.figure, axes = canvas(1, number, (_WIDTH * number, height))
        self.figure.set_layout_engine("none")
        self._engine = ConstrainedLayoutEngine()
        self._empty = np.full(shape, np.nan)
        self._room: list[int] = []
        self._title = self.figure.suptitle("")
        self._foot = self.figure.supxlabel("", fontsize=9)
        signal, temperature = ("raw signal [count]", "gray"), (_CELSIUS, "inferno")
        pictures = [(band, band_label(band), *signal) for band in bands]
        pictures += [(name, name, *temperature) for name in temperatures]
        self._artists = {
            name: _artists(self.figure, axis, shape, *labels)
            for (name, *labels), axis in zip(pictures, axes[0], strict=True)
        }

    def update(self, panels: Mapping[str, Panel], *, title: str, foot: str = "") -> None:
        """Show the `Panel` of each picture, a title, and a foot that belongs to none."""
        for band, (image, text, warning) in self._artists.items():
            panel = panels[band]
            data = self._empty if panel.image is None else panel.image
            image.set(data=data, clim=panel.limits)
            text.set_text(panel.text)
            warning.set_text(panel.warning)
        self._title.set_text(title)
        self._foot.set_text(fill(foot, _LETTERS * len(self._artists)))
        # Room is made where a text has other lines than before, or a colour bar other digits.
        texts = [self._title, self._foot, *(text for _, text, _ in self._artists.values())]
        room = [len(f"{limit:.0f}") for panel in panels.values() for limit in panel.limits]
        room += [len(text.get_text().splitlines()) for text in texts]
        if room != self._room:
            self._engine.execute(self.figure)
            self._room = room

    def pixels(self) -> npt.NDArray[np.uint8]:
        """Drawn figure: red, green, blue and opacity, uint8 (rows, columns, 4)."""
        drawing: Any = FigureCanvasAgg(self.figure)  # its methods have no types
        drawing.draw()
        return np.asarray(drawing.buffer_rgba())


def _artists(
    figure: Figure, axis: Axes, shape: tuple[int, int], title: str, label: str, cmap: str
) -> tuple[AxesImage, Text, Text]:
    """Picture, text and warning of one band before its first picture."""
    empty = xr.DataArray(np.full(shape, np.nan), dims=("y", "x"))
    draw_image(figure, axis, empty, title, label, cmap=cmap)
    image = axis.images[0]
    assert image.colorbar is not None  # draw_image gave it one
    image.colorbar.locator = MaxNLocator(_TICKS, integer=True)
    image.colorbar.formatter = ScalarFormatter(useOffset=False)
    box = {"facecolor": "white", "edgecolor": _ALARM, "alpha": 0.85, "pad": 3.0}
    warning = axis.text(
        0.02, 0.97, "", transform=axis.transAxes, va="top", fontsize=9, color=_ALARM, bbox=box
    )
    return image, axis.set_xlabel("", loc="left", fontsize=9), warning
