"""Arrays to draw, and what all figures have in common."""

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from matplotlib.figure import Figure

BANDS = ["8-14", "9.5"]
TIME = np.arange(2.0)
DEGREE = "\N{DEGREE SIGN}C"


def array(dims: str, *shape: int, **attrs: object) -> xr.DataArray:
    """Random values from 300 to 301 with bands, times and materials named."""
    values = 300.0 + np.random.default_rng(1).random(shape)
    names = {"band": BANDS, "time": TIME, "material": ["glass", "slate"], "case": ["a", "b"]}
    names |= {"first": BANDS, "second": BANDS}
    coords = {dim: names[dim] for dim in dims.split() if dim in names}
    return xr.DataArray(values, dims=dims.split(), coords=coords, attrs=attrs)


def titles(figure: Figure) -> str:
    """Everything that stands above a figure and its axes."""
    return "\n".join([figure.get_suptitle(), *(axis.get_title() for axis in figure.axes)])


def check_measured(figure: Figure, labels: set[str]) -> None:
    """Assert that a figure of measured data is drawn, has units, and is its caller's."""
    figure.draw_without_rendering()
    texts = [text for axis in figure.axes for text in (axis.get_xlabel(), axis.get_ylabel())]
    assert {" ".join(text.split()) for text in texts if text} == labels
    assert "(simulated" not in titles(figure)
    assert "radiometric" not in titles(figure)
    assert plt.get_fignums() == []
