"""Errors that two bands cannot show are in the bars by cause, and apart from those of the noise."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
import xarray as xr
from numpy.typing import NDArray
from scipy.constants import Boltzmann, Planck, speed_of_light

from dbthermal import calibration, separation

Floats = NDArray[np.float64]
TIME, SHAPE = np.arange(250) / 10.0, (16, 24)
EDGES = {"8-14": (8.0, 14.0), "9.5": (9.2, 9.8)}  # um
COUNTS, OFFSET = (115.0, 11.0), 14000.0  # count per kelvin at 300 K, count
NETD, ROOM = (0.03, 0.35), 295.15  # K
LEFT, RIGHT = (0.86, 0.72), (0.93, 0.82)  # emissivities


def radiance(band: str, temperature: Any) -> Floats:
    """Radiance by quadrature over a band with soft edges, in any unit."""
    wavelength = np.linspace(7.0, 15.5, 240)
    low, high = EDGES[band]
    passed = 1.0 / (1.0 + np.exp((low - wavelength) / 0.05))
    passed /= 1.0 + np.exp((wavelength - high) / 0.05)
    constant = Planck * speed_of_light / Boltzmann * 1e6  # um K
    grid = np.linspace(240.0, 400.0, 400)
    spectrum = passed / wavelength**5 / np.expm1(constant / np.outer(grid, wavelength))
    return np.interp(np.asarray(temperature), grid, spectrum.sum(axis=1))


def counts_of(band: int, temperature: Any) -> Floats:
    """Counts of a blackbody of a temperature [K]."""
    name = [*EDGES][band]
    slope = (radiance(name, 300.4) - radiance(name, 299.6)) / 0.8
    return OFFSET + COUNTS[band] * radiance(name, temperature) / slope


def response(emissivity: float = 1.0, **stated: Any) -> xr.Dataset:
    """Response to blackbodies of an emissivity, in a room, that are taken for black."""
    levels = np.linspace(278.15, 343.15, 6)
    seen = [
        emissivity * counts_of(band, levels) + (1.0 - emissivity) * counts_of(band, ROOM)
        for band in range(2)
    ]
    coords = {"band": [*EDGES], "temperature": levels}
    noise = xr.DataArray(np.multiply(NETD, COUNTS), {"band": [*EDGES]}, "band")
    return calibration.fit_response(xr.DataArray(seen, coords), noise, **stated)


def glass(
    seed: int, offset: Floats | tuple[float, ...] = (0.0, 0.0), gain: tuple[float, ...] = (0.0, 0.0)
) -> tuple[xr.Dataset, xr.Dataset]:
    """Two panes that warm up while people pass; cameras whose level [K] and gain have drifted."""
    rng = np.random.default_rng(seed)
    rows, columns = np.indices(SHAPE)
    left = columns < SHAPE[1] // 2
    rise = 5.0 + 20.0 * np.exp(-((rows - 8) ** 2 + (columns - 14) ** 2) / 90.0)
    warm = 293.15 + rise * (1.0 - np.exp(-TIME / 12.0))[:, None, None]
    cold = np.full(warm.shape, ROOM)
    for _ in range(6):
        begin, speed, height = rng.uniform(0, 22), rng.choice([-1, 1]) * rng.uniform(12, 20), 14.0
        place = (TIME - begin) * speed + (0.0 if speed > 0 else SHAPE[1])
        near = np.abs(columns - place[:, None, None]) < 2.5
        near &= np.abs(rows - rng.uniform(4, 12)) < height / 2
        cold[near] = 295.15 + rng.uniform(5, 10)
    values = np.array([np.where(left, *pair) for pair in zip(LEFT, RIGHT, strict=True)])
    movie = []
    for band in range(2):
        clean = values[band] * counts_of(band, warm) + (1 - values[band]) * counts_of(band, cold)
        clean += gain[band] * (clean - counts_of(band, 300.0)) + offset[band] * COUNTS[band]
        movie.append(clean + NETD[band] * COUNTS[band] * rng.standard_normal(clean.shape))
    dims, coords = ("time", "y", "x"), {"band": [*EDGES], "time": TIME}
    films = {"object_temperature": (dims, warm), "background_temperature": (dims, cold)}
    truth = xr.Dataset({**films, "emissivity": (("band", "y", "x"), values)}, coords)
    capture = xr.Dataset({"counts": (("band", *dims), np.array(movie, np.float32))}, coords)
    return truth, capture


def holds(result: xr.Dataset, truth: xr.Dataset, name: str = "object_temperature") -> float:
    """Share of the 95 % intervals of the pixels without a flag that hold."""
    good = result["status"] == 0
    inside = abs(result[name] - truth[name]) < 1.96 * result[f"{name}_std"]
    return float(inside.where(good & result[name].notnull()).mean())


WORLD: Mapping[str, dict[str, Any]] = {
    "plain": {},
    "offset": {"offset": (0.5, -0.3)},
    "gain": {"gain": (0.0, 0.01)},
    "gains": {"gain": (-0.01, 0.01)},
    "blackbody": {"emissivity": 0.97},
}
