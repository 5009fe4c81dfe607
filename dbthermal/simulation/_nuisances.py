"""What a real camera adds to a perfect capture, one nuisance a function, each with its truth."""

from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import planck, schema
from dbthermal.correction import lag_coefficients
from dbthermal.simulation._clocks import repeat_frames

Array = npt.NDArray[np.float64]

SPOILED: Final = ("good", "noisy", "blinking", "stuck")
"""Kinds of pixel of `spoil_pixels`, by their number."""

_MEANINGS = " ".join(SPOILED)


def fire_shutter(
    corrected: xr.Dataset,
    times: npt.ArrayLike,
    rng: np.random.Generator,
    *,
    duration: float = 0.5,
    offset_std: float = 40.0,
    bands: tuple[str, ...] | None = None,
) -> xr.Dataset:
    """
    Close the shutter: a frozen image, then offsets that are new.

    Parameters
    ----------
    corrected : Dataset
        Stage `corrected` of `schema`.
    times : array_like, shape (event,)
        When the shutter closes [s]; the last frame taken by then is repeated.
    rng : Generator
        Source of the offsets.
    duration : float
        How long it stays closed [s].
    offset_std : float
        Standard deviation of a pixel's step [count].
    bands : tuple of str, optional
        Bands whose cameras fire; by default all.

    Returns
    -------
    Dataset
        The capture with the frames repeated and the steps added.

    Raises
    ------
    TypeError, ValueError
        If the capture is not as `schema` has it, a time does not lie in it, the duration is not
        positive, or a band is missing.
    """
    counts = _floating(corrected).copy(deep=True)
    planck.require_positive("duration [s]", duration)
    clock = counts["time"].values.astype(np.float64)
    names = [str(name) for name in counts["band"].values] if bands is None else list(bands)
    places = schema.band_positions(counts, names, "the capture")
    for time in np.sort(np.atleast_1d(np.asarray(times, dtype=np.float64))):
        if not clock[0] <= time <= clock[-1]:
            raise ValueError(
                f"Invalid time {time} s of the shutter. Must lie in [{clock[0]}, {clock[-1]}] s."
            )
        first, after = np.searchsorted(clock, [time, time + duration], side="right")
        for band in places:
            movie = counts.values[band]
            movie[first:after] = movie[first - 1]
            movie[after:] += rng.normal(0.0, offset_std, movie.shape[1:]).astype(movie.dtype)
    return corrected.assign(counts=counts)


def lose_frames(corrected: xr.Dataset, share: float, rng: np.random.Generator) -> xr.Dataset:
    """
    Lose frames on the way: the driver hands on the one before, in each band by itself.

    Parameters
    ----------
    corrected : Dataset
        Stage `corrected` of `schema`.
    share : float
        Share of frames that are lost [1].
    rng : Generator
        Source of the losses.

    Returns
    -------
    Dataset
        The capture with frames repeated, and `repeated` (band, time), bool.

    Raises
    ------
    TypeError, ValueError
        If the capture is not as `schema` has it, or the share does not lie in [0, 1).
    """
    counts = schema.check(corrected, "corrected")["counts"]
    if not 0 <= share < 1:
        raise ValueError(f"Invalid share {share} of lost frames. Must lie in [0, 1).")
    lost = rng.random(counts.shape[:2]) < share
    lost[:, 0] = False  # there is none before
    truth = {"units": "1", "long_name": "repeats the frame before"}
    return repeat_frames(corrected, lost).assign(repeated=(("band", "time"), lost, truth))


def drift_pattern(
    corrected: xr.Dataset,
    rng: np.random.Generator,
    *,
    common: float = 0.0,
    pattern_std: float = 0.0,
) -> xr.Dataset:
    """
    Let the offsets drift, in proportion to time from the first frame to the last.

    Parameters
    ----------
    corrected : Dataset
        Stage `corrected` of `schema`, of two frames or more.
    rng : Generator
        Source of the pattern.
    common : float
        Drift that all pixels of all bands share [count].
    pattern_std : float
        Standard deviation of each pixel's own drift [count].

    Returns
    -------
    Dataset
        The drifting capture, and `drifted` (band, y, x) [count]: the offsets at the last frame.

    Raises
    ------
    TypeError, ValueError
        If the capture is not as `schema` has it, or has one frame.
    """
    counts = _floating(corrected)
    time = counts["time"].values.astype(np.float64)
    planck.require_positive("length of the capture [s]", time[-1] - time[0])
    share = ((time - time[0]) / (time[-1] - time[0])).astype(counts.dtype)
    last = (common + pattern_std * rng.standard_normal(counts.isel(time=0).shape)).astype(
        counts.dtype
    )
    drifting = counts.values + share[:, np.newaxis, np.newaxis] * last[:, np.newaxis]
    return corrected.assign(
        counts=(counts.dims, drifting, counts.attrs),
        drifted=(("band", "y", "x"), last, {"units": "count", "long_name": "drift at the end"}),
    )


def spoil_pixels(
    corrected: xr.Dataset,
    share: float,
    rng: np.random.Generator,
    *,
    noise_std: float = 15.0,
    amplitude: float = 60.0,
    dwell: float = 3.0,
) -> xr.Dataset:
    """
    Let pixels go bad: noisy, blinking between two levels (random telegraph signal), or stuck.

    Parameters
    ----------
    corrected : Dataset
        Stage `corrected` of `schema`.
    share : float
        Share of pixels that are bad in a band, a third of each kind on average [1].
    rng : Generator
        Source of the pixels and of their signals.
    noise_std : float
        Noise added to a noisy pixel [count].
    amplitude : float
        Step of a blinking pixel [count].
    dwell : float
        Mean time between its steps [s]; there is at least one step.

    Returns
    -------
    Dataset
        The capture with bad pixels, and `spoiled` (band, y, x), int8: position in `SPOILED`.

    Raises
    ------
    TypeError, ValueError
        If the capture is not as `schema` has it, the share does not lie in [0, 1), or the time
        between steps is not positive.
    """
    counts = _floating(corrected).copy(deep=True)
    if not 0 <= share < 1:
        raise ValueError(f"Invalid share {share} of bad pixels. Must lie in [0, 1).")
    planck.require_positive("dwell [s]", dwell)
    shape = (counts.sizes["band"], counts.sizes["y"], counts.sizes["x"])
    kind = np.where(rng.random(shape) < share, rng.integers(1, len(SPOILED), shape), 0)
    frames, time = counts.sizes["time"], counts["time"].values.astype(np.float64)
    for band, row, column in np.argwhere(kind > 0):
        signal = counts.values[band, :, row, column]
        match SPOILED[kind[band, row, column]]:
            case "noisy":
                signal += rng.normal(0.0, noise_std, frames).astype(signal.dtype)
            case "blinking":
                signal += (amplitude * _telegraph(time, dwell, rng)).astype(signal.dtype)
            case "stuck":
                signal[:] = signal[0]
    attrs = {"flag_values": np.arange(len(SPOILED), dtype=np.int8), "flag_meanings": _MEANINGS}
    spoiled = (("band", "y", "x"), kind.astype(np.int8), {"units": "1", **attrs})
    return corrected.assign(counts=counts, spoiled=spoiled)


def lag(corrected: xr.Dataset, time_constant: float | xr.DataArray) -> xr.Dataset:
    r"""
    Let the pixels follow the scene with a first-order lag.

    .. math:: I_n = a_n I_{n-1} + (1 - a_n) z_n, \quad a_n = e^{-(t_n - t_{n-1}) / \tau}

    the exact solution of :math:`\tau \dot I = z - I` for a signal held from each frame to the
    next, at rest before the first. What is given should be without noise: that of the read-out
    does not pass through the pixel. `correction.undo_lag` is the inverse.

    Parameters
    ----------
    corrected : Dataset
        Stage `corrected` of `schema`.
    time_constant : float or DataArray
        Time constant [s], of all bands or (band), by name.

    Returns
    -------
    Dataset
        The lagging capture.

    Raises
    ------
    TypeError, ValueError
        If the capture is not as `schema` has it, or a time constant is not finite and positive or
        a band has none.
    """
    counts = _floating(corrected).copy(deep=True)
    _, new = lag_coefficients(time_constant, counts)
    for movie, weight in zip(counts.values, new, strict=True):
        for frame in range(1, movie.shape[0]):
            # In place, each frame from the lagging one before.
            step = movie[frame] - movie[frame - 1]
            movie[frame] = movie[frame - 1] + weight[frame - 1] * step
    return corrected.assign(counts=counts)


def _floating(corrected: xr.Dataset) -> xr.DataArray:
    """Counts of a capture, which whole numbers would round and wrap around."""
    counts = schema.check(corrected, "corrected")["counts"]
    if counts.dtype.kind != "f":
        raise TypeError(f"Invalid dtype {counts.dtype} of the counts. Must be floating.")
    return counts


def _telegraph(time: Array, dwell: float, rng: np.random.Generator) -> Array:
    """Random telegraph signal (time) of 0 and 1, that changes at least once."""
    chance = -np.expm1(-np.diff(time) / dwell)
    steps = np.flatnonzero(rng.random(chance.size) < chance)
    if steps.size == 0:
        steps = rng.integers(0, chance.size, 1)
    level = np.zeros(time.size)
    level[steps + 1] = 1.0
    return np.asarray(np.cumsum(level) % 2)
