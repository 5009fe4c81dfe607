"""Disturbances of real cameras, added one by one to a perfect capture, each with its truth."""

from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import _numbers, schema
from dbthermal.correction._temporal import time_constants
from dbthermal.simulation import observe

SPOILED: Final = ("good", "noisy", "blinking", "stuck")
"""Kinds of pixel of `spoil_pixels`, by their number."""

_NOISE, _STEP, _DWELL = 15.0, 60.0, 3.0  # of bad pixels: noise and step [count], dwell time [s]


def expose(
    scene: xr.Dataset,
    response: xr.Dataset,
    rng: np.random.Generator,
    *,
    every: int | Sequence[int],
    offsets: Sequence[int],
    frames: int,
) -> xr.Dataset:
    r"""Capture of bands that are exposed at different times, with time stamps.

    The scene, as for `observe`, has a clock finer than the frames; frame n of band m is exposed at
    its step :math:`o_m + n \, q_m`: offsets o, one a band, and steps `every` frame q, of each band
    or of all. The response has `noise`.

    The result has `counts` (band, time, y, x) [count], and `exposure_time` (band, time) [s], the
    true times on the scene's clock: drop the variable for cameras without stamps. `time` is that of
    the first band. ValueError if there are not as many offsets and rates as bands, or a frame lies
    outside the scene.
    """
    bands = schema.check(response, "response").sizes["band"]
    last = schema.check(scene, "separated", ("object_temperature",), "the scene").sizes["time"] - 1
    rates = [every] * bands if isinstance(every, int) else list(every)
    if not len(rates) == len(offsets) == bands:
        raise ValueError(f"Invalid every {every} and offsets {offsets}. Must be one for each band.")
    pairs = zip(offsets, rates, strict=True)
    steps = np.array([offset + np.arange(frames) * rate for offset, rate in pairs])
    if min(rates) < 1 or steps.min() < 0 or steps.max() > last:
        raise ValueError(
            f"Invalid frames at steps {steps.min()} to {steps.max()}, every {every}. Must increase "
            f"and lie in [0, {last}], the steps of the scene."
        )
    stamps = scene["time"].values[steps]
    clock = ("time", stamps[0], scene["time"].attrs)
    views = [scene.isel(time=row).assign_coords(time=clock) for row in steps]
    together = by_cameras(views, response, rng)
    exposed = schema.variables("corrected", {"exposure_time": stamps})
    return schema.check(together.assign(exposed), "corrected")


def by_cameras(
    views: Iterable[xr.Dataset], response: xr.Dataset, rng: np.random.Generator
) -> xr.Dataset:
    """Capture, as of `observe`, of a scene for each band of a response: what its camera sees."""
    pairs = enumerate(views)
    captures = [observe(view, response.isel(band=[band]), rng) for band, view in pairs]
    return xr.concat(captures, "band", combine_attrs="override")


def lose_frames(corrected: xr.Dataset, share: float, rng: np.random.Generator) -> xr.Dataset:
    """Replace lost frames at random by the one before, as a driver does that stamps none.

    The result has no `exposure_time`, but `repeated` (band, time), bool. ValueError if the share of
    lost frames lies outside [0, 1), or the dataset is not of the stage `corrected`.
    """
    counts = schema.check(corrected, "corrected")["counts"]
    if not 0 <= _numbers.real_number("share", share) < 1:
        raise ValueError(f"Invalid share {share} of lost frames. Must lie in [0, 1).")
    lost = rng.random(counts.shape[:2]) < share
    lost[:, 0] = False  # no frame before it to be repeated
    movies = counts.copy(deep=True)
    for band, frame in np.argwhere(lost):
        movies.values[band, frame] = movies.values[band, frame - 1]
    truth = {"units": "1", "long_name": "repeats the frame before"}
    unstamped = corrected.drop_vars("exposure_time", errors="ignore")
    return unstamped.assign(counts=movies, repeated=(("band", "time"), lost, truth))


def fire_shutter(
    corrected: xr.Dataset,
    times: npt.ArrayLike,
    rng: np.random.Generator,
    *,
    duration: float = 0.5,
    offset_std: float = 40.0,
    bands: tuple[str, ...] | None = None,
) -> xr.Dataset:
    """Shutter events: a frozen image while it is closed, new offsets of the pixels afterwards.

    The shutter closes at times (event,) in the capture, stage `corrected`, for a duration [s], and
    the frame before is repeated; then each pixel steps by `offset_std` [count], standard deviation.
    Only the cameras of some bands close, if they are named.
    """
    counts = _floating(corrected)
    _numbers.real_number("duration [s]", duration, _numbers.POSITIVE)
    _numbers.real_number("offset_std [count]", offset_std, (0.0, schema.LARGEST))
    clock = counts["time"].values.astype(np.float64)
    names = [str(name) for name in counts["band"].values] if bands is None else list(bands)
    places = schema.band_positions(counts, names, "the capture")
    for time in np.sort(np.atleast_1d(_numbers.real_numbers("times [s]", times))):
        if not clock[0] <= time <= clock[-1]:
            rule = f"Must lie in [{clock[0]}, {clock[-1]}] s"
            raise ValueError(f"Invalid time {time} s of the shutter. {rule}.")
        first, after = np.searchsorted(clock, [time, time + duration], side="right")
        for band in places:
            movie = counts.values[band]
            movie[first:after] = movie[first - 1]
            movie[after:] += rng.normal(0.0, offset_std, movie.shape[1:]).astype(movie.dtype)
    return corrected.assign(counts=counts)


def spoil_pixels(corrected: xr.Dataset, share: float, rng: np.random.Generator) -> xr.Dataset:
    """Bad pixels: noisy, blinking between two levels (random telegraph signal), or stuck.

    Noisy pixels have 15 counts more noise; blinking ones step by 60, every 3 s on average and at
    least once. The share in [0, 1) is that of a band, a third of each kind on average. The result,
    of the stage `corrected`, has `spoiled` (band, y, x), int8, the position in `SPOILED`.
    """
    counts = _floating(corrected)
    if not 0 <= _numbers.real_number("share", share) < 1:
        raise ValueError(f"Invalid share {share} of bad pixels. Must lie in [0, 1).")
    shape = (counts.sizes["band"], counts.sizes["y"], counts.sizes["x"])
    kind = np.where(rng.random(shape) < share, rng.integers(1, len(SPOILED), shape), 0)
    frames, time = counts.sizes["time"], counts["time"].values.astype(np.float64)
    for band, row, column in np.argwhere(kind > 0):
        signal = counts.values[band, :, row, column]
        match SPOILED[kind[band, row, column]]:
            case "noisy":
                signal += rng.normal(0.0, _NOISE, frames).astype(signal.dtype)
            case "blinking":
                # Random telegraph signal of 0 and 1 with a mean dwell time and at least a step.
                chance, level = -np.expm1(-np.diff(time) / _DWELL), np.zeros(time.size)
                steps = np.flatnonzero(rng.random(chance.size) < chance)
                level[1 + (steps if steps.size else rng.integers(0, chance.size, 1))] = 1.0
                signal += (_STEP * (np.cumsum(level) % 2)).astype(signal.dtype)
            case "stuck":
                signal[:] = signal[0]
    numbers = np.arange(len(SPOILED), dtype=np.int8)
    attrs = {"units": "1", "flag_values": numbers, "flag_meanings": " ".join(SPOILED)}
    spoiled = (("band", "y", "x"), kind.astype(np.int8), attrs)
    return corrected.assign(counts=counts, spoiled=spoiled)


def lag(corrected: xr.Dataset, time_constant: float | xr.DataArray) -> xr.Dataset:
    r"""First-order thermal lag of the pixels behind the scene.

    .. math:: I_n = a_n I_{n-1} + (1 - a_n) z_n, \quad a_n = e^{-(t_n - t_{n-1}) / \tau}

    at rest before the first frame, of a time constant [s], of all bands or (band), by name;
    `correction.undo_lag` is the inverse. The capture, stage `corrected`, is without noise: that of
    the read-out does not pass through the pixel.
    """
    counts = _floating(corrected)
    interval = np.diff(counts["time"].values.astype(np.float64))
    new = -np.expm1(-interval / time_constants(time_constant, counts)[:, np.newaxis])
    for movie, weight in zip(counts.values, new, strict=True):
        for frame in range(1, movie.shape[0]):
            # In place, each frame from the lagging one before.
            step = movie[frame] - movie[frame - 1]
            movie[frame] = movie[frame - 1] + weight[frame - 1] * step
    return corrected.assign(counts=counts)


def _floating(corrected: xr.Dataset) -> xr.DataArray:
    """Floating copy of the counts of a capture."""
    return schema.check_corrected(corrected)["counts"].copy(deep=True)
