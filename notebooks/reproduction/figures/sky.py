"""Figures of measured bands: a day over grass, and the changes of a sky."""

from collections.abc import Sequence

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from scipy.constants import zero_Celsius

from dbthermal.figures import drawing
from dbthermal.figures.drawing import band_label, canvas


def hours(readings: xr.DataArray, middles: Sequence[float], flags: Sequence[str]) -> Figure:
    """Readings of two bands over a day, above them the flags of the separated stretches.

    Parameters
    ----------
    readings : DataArray
        Temperatures (band, time) [K]; time [s] from midnight.
    middles : sequence of float
        Middle of each stretch [h].
    flags : sequence of str
        Its flags, by commas.
    """
    figure, ((axis,),) = canvas(1, 1, (8.0, 3.6))
    celsius, time = readings - zero_Celsius, readings["time"] / 3600.0
    for name in readings["band"].values:
        axis.plot(time, celsius.sel(band=name), lw=0.7, label=str(name))
    low, high = float(celsius.min()), float(celsius.max())
    for hour, words in zip(middles, flags, strict=True):
        text = words.replace(", ", "\n") or "no flag"
        axis.text(
            hour, high + 0.1 * (high - low), text, ha="center", va="bottom", rotation=90, fontsize=6
        )
    axis.set(ylim=(low - 1.0, high + 0.9 * (high - low)), xlim=(0.0, 24.0))
    axis.set_xlabel("universal time [h]")
    axis.set_ylabel("reading [°C]")
    axis.legend(loc="lower right", fontsize=7)
    axis.set_title("Grass, Oklahoma, 1 June 2019" + drawing.provenance_note(readings))
    return figure


def sky_changes(sky: xr.DataArray, gains: xr.DataArray) -> Figure:
    """Changes of a sky in each band over those in the first one, with their ratio.

    Parameters
    ----------
    sky : DataArray
        Temperatures (band, time) [K].
    gains : DataArray
        Ratios (band) [1].
    """
    names = [str(name) for name in sky["band"].values]
    figure, (axes,) = canvas(1, len(names) - 1, (2.4 * (len(names) - 1), 2.7))
    changes = sky.diff("time")
    reach = 1.1 * float(np.abs(changes).max())
    for axis, name in zip(axes, names[1:], strict=True):
        axis.plot(changes[0], changes.sel(band=name), "k.", ms=3)
        line = np.array([-reach, reach])
        axis.plot(line, line, "0.7", lw=1)
        axis.plot(line, float(gains.sel(band=name)) * line, "C3", lw=1)
        axis.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
        axis.set_xlabel(f"change, {band_label(names[0])} [K]")
        axis.set_ylabel(f"change, {band_label(name)} [K]")
        axis.set_title(f"{float(gains.sel(band=name)):.2f} times")
    note = drawing.provenance_note(sky)
    figure.suptitle(f"The sky overhead from spectrum to spectrum; gray line: a gray sky{note}")
    return figure
