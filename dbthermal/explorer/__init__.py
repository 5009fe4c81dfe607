"""Explore a result, a capture or a store in JupyterLab: pictures, regions and curves.

Begin with `explore(result)`. `View` has the same frames, region curves and files without a browser;
"copy as code" writes the calls.
"""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import xarray as xr

from dbthermal._text import missing_library
from dbthermal.explorer._films import Region
from dbthermal.explorer._view import View

if TYPE_CHECKING:
    from dbthermal.explorer._widget import Explorer

__all__ = ["Explorer", "Region", "View", "explore"]
__dir__ = __all__.copy


def __getattr__(name: str) -> "type[Explorer]":
    """Import the explorer's page when it is first used; `View` and `Region` do without."""
    if name != "Explorer":
        raise AttributeError(f"Unknown name {name!r} in {__name__}. Must be one of {__all__}.")
    try:
        from dbthermal.explorer._widget import Explorer  # noqa: PLC0415 - asks for the extra
    except ImportError as error:
        raise ImportError(missing_library(error.name, "explorer")) from error
    return Explorer


def explore(
    data: xr.Dataset | str | Path,
    capture: xr.Dataset | str | Path | None = None,
    response: xr.Dataset | str | Path | None = None,
    *,
    events: Mapping[str, float] = MappingProxyType({}),
    celsius: bool = True,
) -> "Explorer":
    """Explore a separated scene or a capture, with regions and their curves.

    Slider, arrow keys or space change the time; wheel and drag zoom all pictures; rectangle,
    ellipse and polygon make regions, whose mean, least and greatest values are drawn with the
    standard deviation of the mean (`View.curve`). Flagged pixels are hatched. Without a browser, as
    in papermill or HTML, a picture takes the place.

    nbconvert prefers a widget's saved state, which shows nothing without a kernel, to that picture,
    unless ``--NbConvertBase.display_data_priority="['image/png', 'text/html', 'text/plain']"``.

    Parameters
    ----------
    data : Dataset, str or Path
        Result of `separation`, or a capture, or the store of one; see `View`.
    capture : Dataset, str or Path, optional
        Capture that the result was made of: its bands are shown beside it.
    response : Dataset, str or Path, optional
        Response of the cameras: the bands are shown as apparent temperatures instead of counts.
    events, celsius : mapping of str to float, bool
        Name to time [s] of what is marked on the time axis, beside the flags of the capture; True
        for degrees Celsius instead of kelvin, for which the explorer has a button.

    Returns
    -------
    Explorer
        Shown by the notebook as the last value of a cell. TypeError or ValueError as `View`.

    Examples
    --------
    >>> import numpy as np, xarray as xr, dbthermal
    >>> dims = ("time", "y", "x")
    >>> film = xr.DataArray(np.full((3, 4, 6), 300.0), {"time": [0.0, 0.1, 0.2]}, dims)
    >>> explorer = dbthermal.explore(film.to_dataset(name="object_temperature"))
    >>> list(explorer.view.panes)
    ['object_temperature']
    """
    return __getattr__("Explorer")(View(data, capture, response, events=events), celsius=celsius)
