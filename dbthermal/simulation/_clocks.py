"""Cameras that do not expose together: offsets, other rates, and frames that are lost."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import schema
from dbthermal.simulation._rig import observe

Mask = npt.NDArray[np.bool_]

_STAMP = {"units": "s", "long_name": "when the frame was exposed"}


def expose(
    scene: xr.Dataset,
    response: xr.Dataset,
    rng: np.random.Generator,
    *,
    every: int | Sequence[int],
    offsets: Sequence[int],
    frames: int,
) -> xr.Dataset:
    r"""
    Let each band expose its frames at times of its own: the stage `corrected`, with stamps.

    The scene is given on a fine clock. Frame n of band m is exposed at its step

    .. math:: o_m + n \, q_m

    Parameters
    ----------
    scene : Dataset
        See `observe`; its times are finer than the frames'.
    response : Dataset
        With `noise`, e.g. from `Rig.response`.
    rng : Generator
        Source of the noise.
    every : int or sequence of int
        q, steps of the fine clock from frame to frame; of each band, or of all.
    offsets : sequence of int
        o, step of each band's first frame.
    frames : int
        Number of frames.

    Returns
    -------
    Dataset
        `counts` (band, time, y, x) [count], and `exposure_time` (band, time) [s], the true times
        on the scene's clock: drop the variable for cameras without stamps. `time` is that of the
        first band.

    Raises
    ------
    ValueError
        If there are not as many offsets and rates as bands, or a frame lies outside the scene.
    """
    bands, last = response.sizes["band"], scene.sizes["time"] - 1
    rates = [every] * bands if isinstance(every, int) else list(every)
    if not len(rates) == len(offsets) == bands:
        raise ValueError(f"Invalid every {every} and offsets {offsets}. Must be one for each band.")
    steps = np.array(
        [offset + np.arange(frames) * rate for offset, rate in zip(offsets, rates, strict=True)]
    )
    if min(rates) < 1 or steps.min() < 0 or steps.max() > last:
        raise ValueError(
            f"Invalid frames at steps {steps.min()} to {steps.max()}, every {every}. Must increase "
            f"and lie in [0, {last}], the steps of the scene."
        )
    stamps = scene["time"].values[steps]
    parts = [
        observe(scene.isel(time=row), response.isel(band=[place]), rng).assign_coords(
            time=("time", stamps[0], scene["time"].attrs)
        )
        for place, row in enumerate(steps)
    ]
    together = xr.concat(parts, dim="band", combine_attrs="override")
    return schema.check(
        together.assign(exposure_time=(("band", "time"), stamps, _STAMP)), "corrected"
    )


def drop_frames(corrected: xr.Dataset, lost: Mask) -> xr.Dataset:
    """
    Lose frames as a driver does that stamps the others: they follow one another without a hole.

    Parameters
    ----------
    corrected : Dataset
        With `exposure_time` (band, time) [s], see `expose`.
    lost : ndarray of bool, shape (band, time)
        Which frames.

    Returns
    -------
    Dataset
        Counts and stamps with each band's remaining frames first, NaN behind them.
    """
    _check(corrected, lost)
    counts, stamps = (
        corrected[name].values.astype(np.float64 if name == "exposure_time" else np.float32)
        for name in ("counts", "exposure_time")
    )
    for band, gone in enumerate(lost):
        kept = np.count_nonzero(~gone)
        for values in (counts[band], stamps[band]):
            values[:kept] = values[~gone]
            values[kept:] = np.nan
    return _replaced(corrected, counts=counts, exposure_time=stamps)


def repeat_frames(corrected: xr.Dataset, lost: Mask) -> xr.Dataset:
    """
    Lose frames as a driver does that hands out the last one again, and stamps none.

    Parameters
    ----------
    corrected : Dataset
        A capture.
    lost : ndarray of bool, shape (band, time)
        Which frames; not a first one.

    Returns
    -------
    Dataset
        Counts in which a lost frame is a copy of the one before; no `exposure_time`.

    Raises
    ------
    ValueError
        If a first frame is to be lost.
    """
    _check(corrected, lost)
    if lost[:, 0].any():
        raise ValueError("Invalid lost frames: a first one. Must have one before to be repeated.")
    counts = corrected["counts"].values.copy()
    for band, gone in enumerate(lost):
        for frame in np.flatnonzero(gone):
            counts[band, frame] = counts[band, frame - 1]
    return _replaced(corrected.drop_vars("exposure_time", errors="ignore"), counts=counts)


def _check(corrected: xr.Dataset, lost: Mask) -> None:
    wanted = corrected["counts"].shape[:2]
    if lost.shape != wanted or lost.dtype != bool:
        raise ValueError(
            f"Invalid lost frames {lost.shape} of {lost.dtype}. Must be {wanted} of bool."
        )


def _replaced(corrected: xr.Dataset, **values: npt.NDArray[Any]) -> xr.Dataset:
    return corrected.assign(
        {name: corrected[name].copy(data=part) for name, part in values.items()}
    )
