"""Measured bands: a tower that looks down on grass, and spectra of the sky above it.

Data of the Atmospheric Radiation Measurement user facility (collection ``arm`` of the manifest).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import xarray as xr
from scipy.constants import Stefan_Boltzmann

import dbthermal as dbt
from dbthermal import response as responses
from dbthermal.schema import Status

TOWER, SPECTRA = "sgpirt25m20sC1.a0.20190601.000000.cdf", "sgpaerich1C1.b1.20190501.000342.nc"
BANDS = ("infrared thermometer", "pyrgeometer")
# Rig with the noise of both instruments, by differences at night, in whose counts they are put.
RIG = dbt.simulation.Rig(noise=(0.16, 0.23), lowest=268.0)
# By the file's attributes: kelvin a millivolt and at zero of the infrared thermometer; W m-2 a
# millivolt, and the correction of the dome, of the pyrgeometer.
_THERMOMETER, _PYRGEOMETER, _DOME = (0.10, 233.20), 194.10, 4.0
# Thermistor YSI 44031, 1 / T = a + b ln R + c ln^3 R: a, b, c of the maker's table [1/K], [ohm].
_THERMISTOR = (1.0295e-3, 2.391e-4, 1.568e-7)
_RATE = 10.0  # of the pane's capture [Hz]
_ATTRS = {"units": "K", "origin": "measured"}


def readings(path: Path) -> xr.DataArray:
    r"""Temperatures (band, time) [K] of the day of a file `TOWER`, as of blackbodies; UTC [s].

    Of the pyrgeometer :math:`(E / \sigma)^{1/4}`, with the voltage U, and the temperatures of case
    and dome, :math:`E = K_1 U + \sigma T_c^4 - K_3 \sigma (T_d^4 - T_c^4)`.
    """
    with xr.open_dataset(path, engine="scipy", decode_times=False) as file:
        data = file.load().astype(np.float64)
    first, second, third = _THERMISTOR
    logs = [np.log(1e3 * data[f"inst_up_long_{place}_resist"]) for place in ("case", "dome")]
    case, dome = (1.0 / (first + second * log + third * log**3) for log in logs)  # from kiloohm
    exitance = _PYRGEOMETER * data["inst_up_long_hemisp_tp"]
    exitance += Stefan_Boltzmann * (case**4 - _DOME * (dome**4 - case**4))
    step, zero = _THERMOMETER
    values = [step * data["inst_sfc_ir_temp"] + zero, (exitance / Stefan_Boltzmann) ** 0.25]
    coords = {"band": [*BANDS], "time": data["time_offset"].values}
    return xr.DataArray(values, coords, ("band", "time"), attrs=_ATTRS)


def capture(temperatures: xr.DataArray, begin: float, end: float) -> xr.Dataset:
    """Capture of one pixel, stage `corrected`, in counts of `RIG`, between two moments [s]."""
    chosen = temperatures.sel(time=slice(begin, end - 1.0))
    curves = responses.curves(RIG.response(), [*RIG.bands])
    counts = [curve.counts(band) for curve, band in zip(curves, chosen.values, strict=True)]
    movie = np.array(counts, np.float32)[..., np.newaxis, np.newaxis]
    coords = {"band": [*RIG.bands], "time": chosen["time"].values - begin}
    variables = dbt.schema.variables("corrected", {"counts": movie})
    return xr.Dataset(variables, coords, {"origin": "measured"})


def flags(result: xr.Dataset) -> str:
    """Flags of the only pixel, in words."""
    status = int(result["status"].values.item())
    return ", ".join(bit.label for bit in Status if status & bit)


def spectra(path: Path, names: Sequence[str]) -> xr.DataArray:
    """Temperatures (band, time) [K] of the sky overhead, as of blackbodies, in bands of `FILTERS`.

    Of a file `SPECTRA`, a spectrum every 18 s.
    """
    with h5py.File(path) as file:
        wavenumber = file["wnum"][:].astype(np.float64)  # [1/cm]
        radiance = 1e-3 * file["mean_rad"][:].astype(np.float64)  # [W m-2 sr-1 cm]
        time = file["time"][:].astype(np.float64)
    temperatures = []
    for band in map(dbt.bands.get, names):
        in_band = (wavenumber > 1e-2 / band.upper) & (wavenumber < 1e-2 / band.lower)
        within = np.trapezoid(radiance[:, in_band], wavenumber[in_band], axis=1)
        temperatures.append(band.temperature(within))
    coords = {"band": [*names], "time": time}
    return xr.DataArray(temperatures, coords, ("band", "time"), attrs=_ATTRS)


def gains(sky: xr.DataArray) -> xr.DataArray:
    """Ratio g (band) [1] of the changes in each band to those in the first one."""
    changes = sky.diff("time")
    first = changes.isel(band=0, drop=True)
    return (changes * first).sum("time") / (first**2).sum("time")


def pane(
    sky: xr.DataArray, emissivity: xr.DataArray, shape: tuple[int, int], faster: float
) -> xr.Dataset:
    """Scene, as of `simulation.scene`, of a pane that warms up, with a background for each band.

    Clouds of a sky, from `spectra`, so much faster than measured, move over the picture of rows and
    columns from left to right. The pane has an emissivity (band) [1].
    """
    span = float(sky["time"][-1] - sky["time"][0]) / faster
    time = np.arange(0.0, 0.8 * span, 1.0 / _RATE)
    delay = np.linspace(0.2 * span, 0.0, shape[1])  # of the moment that a column sees
    moments = float(sky["time"][0]) + faster * (time[:, np.newaxis, np.newaxis] + delay)
    moments = np.broadcast_to(moments, (len(time), *shape))
    background = [np.interp(moments, sky["time"], band) for band in sky.values]
    rise = np.linspace(10.0, 20.0, shape[0])[:, np.newaxis]  # [K]
    warm = 290.0 + rise * (1.0 - np.exp(-time / 12.0))[:, np.newaxis, np.newaxis]
    warm = np.broadcast_to(warm, moments.shape)
    scene: xr.Dataset = dbt.simulation.scene(time, warm, warm, emissivity)
    dims, attrs = ("band", "time", "y", "x"), {"units": "K"}
    skies = xr.DataArray(background, {"band": sky["band"]}, dims, attrs=attrs)
    return scene.assign(background_temperature=skies)


def scores(result: xr.Dataset, scene: xr.Dataset) -> dict[str, Any]:
    """Errors of ratio and object, its deviation, and how many of the 95 % intervals hold."""
    good = result["status"] == 0
    reflectivity = 1.0 - scene["emissivity"]
    ratio = reflectivity[1] / reflectivity[0]
    error = (result["object_temperature"] - scene["object_temperature"]).where(good)
    std = result["object_temperature_std"].where(good)
    holds = (abs(error) < 1.96 * std).where(np.isfinite(error))
    return {
        "no flag [1]": float(good.mean()),
        "error of k [1]": float((result["reflection_ratio"][1].where(good) / ratio - 1).median()),
        "error [K]": float((error**2).mean() ** 0.5),
        "stated [K]": float(std.median()),
        "intervals hold [1]": float(holds.mean()),
    }
