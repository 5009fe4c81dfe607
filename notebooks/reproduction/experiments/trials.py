"""Trial with sliders: one pixel that mirrors people, of any emissivity, at any noise."""

from functools import lru_cache
from typing import Final

import ipywidgets
import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from scipy.constants import zero_Celsius

from dbthermal import response as responses
from dbthermal import schema, separation, simulation
from reproduction.figures.scenes import truth_and_estimate

DIFFERENCE: Final = 0.14
"""Emissivity of 8-14 um less that of 9.5 um, as of plate glass [1]."""

NOISE: Final = (0.03, 0.35)
"""Noise of the two bands at the slider's middle [K]."""

_PIXELS, _FRAMES, _RATE, _SEED = 12, 350, 10.0, 3


@lru_cache
def trial(emissivity: float, noise: float) -> Figure:
    """Truth, estimate and reading of a pixel of an emissivity [1], with so many times the noise."""
    rig = simulation.Rig(noise=(NOISE[0] * noise, NOISE[1] * noise))
    share = xr.DataArray([emissivity, emissivity - DIFFERENCE], {"band": list(rig.bands)}, "band")
    # Simulate, observe and separate a few pixels, of which one is shown.
    time, rng = np.arange(_FRAMES) / _RATE, np.random.default_rng(_SEED)
    pixels, background = simulation.independent_pixels, simulation.Background()
    scene = pixels(time, share, background, _PIXELS, rng, start=293.15, stop=333.15)  # [K]
    capture = simulation.observe(scene, rig.response(), rng)
    result = separation.solve(capture, rig.response(), workers=1)
    figure = truth_and_estimate(scene, result, (0, 0))
    reading = responses.apparent_temperature(rig.response(), capture["counts"])[0, :, 0, 0]
    figure.axes[0].plot(time, reading - zero_Celsius, color="0.6", linewidth=0.6, zorder=0)
    first = result.isel(y=0, x=0)
    flags = [name for name, bit in schema.Status.bits().items() if int(first["status"]) & bit]
    found = f"{float(first['emissivity'][0]):.3f} +- {float(first['emissivity_std'][0]):.3f}"
    text = f"emissivity {emissivity:.2f}, estimated {found}; flags: {', '.join(flags) or 'none'}"
    figure.axes[0].set_title(text, fontsize=8)
    return figure


def sliders() -> ipywidgets.Widget:
    """Sliders of the emissivity and of the noise over a `trial`."""
    emissivity = ipywidgets.FloatSlider(0.86, min=0.2, max=0.96, step=0.02, continuous_update=False)
    noise = ipywidgets.FloatSlider(1.0, min=0.2, max=5.0, step=0.2, continuous_update=False)
    return ipywidgets.interactive(trial, emissivity=emissivity, noise=noise)
