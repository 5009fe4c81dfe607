"""Emissivities, and captures of reflected people, of a uniform view, of one signal in time."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import simulation
from dbthermal.simulation import Rig

RIG = Rig()
SHAPE = (64, 80)


def emissivity_of(*values: float, bands: tuple[str, ...] = RIG.bands) -> xr.DataArray:
    """Emissivity (band)."""
    return xr.DataArray(list(values), dims="band", coords={"band": list(bands)})


GLASS = emissivity_of(0.86, 0.72)
FILMS = ("object_temperature", "background_temperature")


def plain_capture(
    counts: np.ndarray, time: object = None, bands: Sequence[str] = RIG.bands, **variables: Any
) -> xr.Dataset:
    """Capture of counts (band, time, y, x), at 10 Hz unless the times [s] are others."""
    time = np.arange(counts.shape[1]) / 10.0 if time is None else time
    films = {"counts": (("band", "time", "y", "x"), counts, {"units": "count"})}
    return xr.Dataset(films | variables, {"band": list(bands), "time": time})


def people(
    seed: int | np.random.Generator,
    frames: int,
    shape: tuple[int, int],
    emissivity: xr.DataArray = GLASS,
    rig: Rig = RIG,
    **options: Any,
) -> tuple[xr.Dataset, xr.Dataset]:
    """Scene of people before glass or another material, at 10 Hz, and its capture."""
    rng = np.random.default_rng(seed)
    scene = simulation.walkers(np.arange(frames) / 10.0, shape, emissivity, rng, **options)
    return scene, simulation.observe(scene, rig.response(), rng)


def polynomials(time: np.ndarray, order: int) -> np.ndarray:
    """Orthonormal polynomials (time, order) over the frames, of degrees below the order."""
    share = 2.0 * (time - time[0]) / (time[-1] - time[0]) - 1.0
    found: np.ndarray = np.linalg.qr(np.polynomial.legendre.legvander(share, order - 1))[0]
    return found


def transform_of(matrix: npt.ArrayLike) -> xr.DataArray:
    """Transform that moves the second band alone."""
    bands = {"band": list(RIG.bands)}
    return xr.DataArray(np.stack([np.eye(3), matrix]), bands, ("band", "row", "column"))


def panels(*, size: int = 16) -> xr.DataArray:
    """A checkerboard of two materials: edges and corners everywhere."""
    rows, columns = np.indices(SHAPE)
    other = (rows // size + columns // size) % 2 == 1
    values = [np.where(other, *pair) for pair in ((0.3, 0.95), (0.5, 0.85))]
    return xr.DataArray(values, dims=("band", "y", "x"), coords={"band": list(RIG.bands)})


def walkers(seed: int, *, rate: float = 10.0, frames: int = 350) -> xr.Dataset:
    """A clean capture of people reflected in panels of two materials."""
    rng = np.random.default_rng(seed)
    scene = simulation.walkers(np.arange(frames) / rate, SHAPE, panels(), rng)
    return simulation.observe(scene, RIG.response(), rng)


def still(level: float = 16000.0, count: int = 60, noise: float = 4.0) -> xr.Dataset:
    """A uniform view with noise, 20 by 24 pixels."""
    rng = np.random.default_rng(5)
    counts = level + noise * rng.standard_normal((2, count, 20, 24))
    return plain_capture(counts.astype(np.float32), ("time", np.arange(count) / 10, {"units": "s"}))


def movie(signal: np.ndarray, time: object) -> xr.Dataset:
    """Counts (band, time, y, x), double precision, of one signal (time) in two bands."""
    counts = np.broadcast_to(np.asarray(signal)[:, np.newaxis, np.newaxis], (2, len(signal), 1, 1))
    return plain_capture(counts.copy(), np.asarray(time))


def drop_frames(corrected: xr.Dataset, lost: np.ndarray) -> xr.Dataset:
    """Remove lost frames (band, time), as a driver that stamps the others does: the next move up.

    Each band's remaining counts and stamps come first, and NaN behind them.
    """
    counts, stamps = corrected["counts"].values.copy(), corrected["exposure_time"].values.copy()
    for band, gone in enumerate(lost):
        kept = np.count_nonzero(~gone)
        for values in (counts[band], stamps[band]):
            values[:kept] = values[~gone]
            values[kept:] = np.nan
    replaced = {"counts": counts, "exposure_time": stamps}
    return corrected.assign({name: corrected[name].copy(data=it) for name, it in replaced.items()})


def drift(corrected: xr.Dataset, last: float) -> xr.Dataset:
    """A capture whose offsets drift in proportion to time, by some counts at the last frame."""
    counts, time = corrected["counts"], corrected["time"].values
    share = ((time - time[0]) / (time[-1] - time[0])).astype(counts.dtype)
    drifting = counts.values + share[:, np.newaxis, np.newaxis] * counts.dtype.type(last)
    return corrected.assign(counts=counts.copy(data=drifting))
