"""Films of separated scenes, frame by frame: what `separated_temperatures` shows, moving."""

from collections.abc import Iterator
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.image import AxesImage
from matplotlib.text import Text
from scipy.constants import zero_Celsius

from dbthermal.figures._canvas import band_label, canvas, draw_image, limits_of, provenance_note

_WIDTH: Final = 3.2
_DPI: Final = 100


def separated_film(
    apparent: xr.DataArray, emission: xr.DataArray, change: xr.DataArray, *, title: str
) -> Iterator[npt.NDArray[np.uint8]]:
    """
    Frames of a film: the inputs, the emission and the mean-subtracted reflection side by side.

    Parameters
    ----------
    apparent : DataArray
        Apparent temperature of the inputs (band, time, y, x) [K].
    emission : DataArray
        Object temperature (time, y, x) [K]; pixels without a value are gray.
    change : DataArray
        What the reflection changes, `separation.reflected_change` (time, y, x) [K].
    title : str
        What the scene is.

    Yields
    ------
    ndarray of uint8, shape (rows, columns, 3)
        Colours; both sizes even, as video codecs want them.
    """
    parts = [apparent.sel(band=band) - zero_Celsius for band in apparent["band"].values]
    titles = [f"input {band_label(band)}" for band in apparent["band"].values]
    parts += [emission - zero_Celsius, change]
    titles += ["emission", "reflection less its mean"]
    aspect = apparent.sizes["y"] / apparent.sizes["x"]
    size = (_WIDTH * len(parts), round((0.8 * _WIDTH * aspect + 1.0) * _DPI / 2) * 2 / _DPI)
    figure, axes = canvas(1, len(parts), size)
    figure.set_dpi(_DPI)
    for axis, part, name in zip(axes[0], parts, titles, strict=True):
        last = part is parts[-1]
        unit = "[K]" if last else "[\N{DEGREE SIGN}C]"
        scale = limits_of(part, symmetric=last)
        cmap = "RdBu_r" if last else "inferno"
        draw_image(figure, axis, part.isel(time=0), name, unit, cmap=cmap, limits=scale)
    heading = figure.suptitle(f"{title}, {' ' * 7}" + provenance_note(apparent))
    images = [axis.images[0] for axis in axes[0]]
    yield from _frames(FigureCanvasAgg(figure), images, parts, (heading, title, apparent))


def _frames(
    drawing: Any,  # FigureCanvasAgg, whose methods have no types
    images: list[AxesImage],
    parts: list[xr.DataArray],
    heading: tuple[Text, str, xr.DataArray],
) -> Iterator[npt.NDArray[np.uint8]]:
    """Draw what stands still once, and over it the images of each time."""
    text, title, data = heading
    for artist in (*images, text):
        artist.set_animated(True)
    drawing.draw()
    still = drawing.copy_from_bbox(drawing.figure.bbox)
    note = provenance_note(data)
    for index, moment in enumerate(data["time"].values):
        drawing.restore_region(still)
        text.set_text(f"{title}{note}, {moment:.1f} s")
        for image, part in zip(images, parts, strict=True):
            image.set_data(part.values[index])
            image.axes.draw_artist(image)
        drawing.figure.draw_artist(text)
        yield np.asarray(drawing.buffer_rgba())[..., :3].copy()
