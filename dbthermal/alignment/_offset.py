r"""The time by which one camera lags another, from the rapid changes that both see.

With the smooth part projected out, the first band holds the background b(t) and the second
:math:`\rho \, b(t + \delta)`, both noise besides. A background moves in steps: its autocovariance R
is a tent, and a parabola through the peak of the covariance C of the bands would be biased. Instead
the second band is predicted from the first, interpolated in a line between the frames m and m + 1:

.. math:: \rho \, b(t + \delta) = h_0 b(t + m) + h_1 b(t + m + 1), \quad
   \delta = m + \frac{h_1}{h_0 + h_1}

Multiplied not by these two frames but by their outer neighbours m - 1 and m + 2 (instrumental
variables), the noise of the first band does not enter, which at lag 0 would:

.. math:: C_{m-1} = h_0 R_1 + h_1 R_2, \quad C_{m+2} = h_0 R_2 + h_1 R_1

The difference and the sum of both give :math:`\delta`. It is exact where R is straight or parabolic
over two frames on either side of its peak: for steps, and for smooth changes.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import _smooth as smooth
from dbthermal import schema
from dbthermal.alignment import _clocks as clocks

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

PIXELS: Final = 16384
"""Pixels, at most, of which a capture is judged; a full frame would say it no better."""

MINIMUM_FRAMES: Final = 32
"""Fewest frames from which an offset is estimated."""

# Groups of pixels whose agreement tells the offset's standard deviation.
_GROUPS: Final = 16
_SIGNIFICANCE: Final = 6.0
_ORDER: Final = 8
_UNUSABLE: Final = np.uint16(
    schema.FLAGS["dead_pixel"] | schema.FLAGS["saturated"] | schema.FLAGS["invalid_samples"]
)


@dataclass(frozen=True)
class _Shared:
    """
    Two bands on one clock of even steps.

    Attributes
    ----------
    signals : ndarray, shape (2, time, pixel)
        Counts [count], NaN in missing frames.
    labels : ndarray of int, shape (2, time)
        Number of shutter events before each frame.
    times : ndarray, shape (time,)
        Times [s].
    """

    signals: Array
    labels: clocks.Indices
    times: Array

    def shifted(self, lag: int) -> "_Shared":
        """Take the first band so many frames later."""
        frames = self.times.size - abs(lag)
        late, early = max(lag, 0), max(-lag, 0)
        signals, labels = (
            np.stack([part[0][late : late + frames], part[1][early : early + frames]])
            for part in (self.signals, self.labels)
        )
        return _Shared(signals, labels, self.times[:frames])


@dataclass(frozen=True)
class _Covariances:
    """
    Covariances of a group of pixels in a row, frames apart in columns.

    Attributes
    ----------
    lags : ndarray of int, shape (lag,)
        Frames by which the first band is taken later.
    cross : ndarray, shape (group, lag)
        C, of the first band with the second.
    auto : ndarray, shape (group, 2)
        R of the first band, one and two frames apart.
    """

    lags: npt.NDArray[np.int_]
    cross: Array
    auto: Array


def time_offset(
    corrected: xr.Dataset, *, band: str | None = None, search: int = 5, precision: float = 0.1
) -> float:
    """
    Time by which a band is exposed later than the first.

    Positive: frame n of this band was exposed that much **later** than frame n of the first.
    Where the capture has the cameras' own stamps, it is what is left of a lag beyond them: this
    band's stamps are to be raised by it.

    Parameters
    ----------
    corrected : Dataset
        Stage `corrected` of `schema`; optionally `status` (y, x), of which dead and saturated
        pixels are left out, `exposure_time` (band, time) [s], and `segment` (time), which counts
        shutter events: their steps are no motion. Missing frames are NaN or copies of the frame
        before. Frames dropped with neither stamp nor copy are not noticed.
    band : str, optional
        Name of the band; the second, unless given.
    search : int
        Largest lag looked for, either way [frame].
    precision : float
        Largest standard deviation of the offset [frame].

    Returns
    -------
    float
        Offset [s].

    Raises
    ------
    TypeError, ValueError
        If the capture is not as `schema` has it, there is no such band, the search does not fit
        the capture's length, or there are fewer than 16 usable pixels; if nothing moves in both
        bands, their likeness is greatest at an end of the search, or the offset is less well known
        than `precision`.

    Notes
    -----
    The standard deviation is a jackknife's, over 16 groups of pixels.

    The views must show the same at the same pixel: `align` registers them before it calls this.
    The standard deviation says nothing of it, for all pixels err alike.

    Cameras side by side see a reflection at different pixels. Where most of what is reflected moves
    one way, it comes to a pixel of one view earlier, and this looks like an offset; what moves
    either way cancels. Where there is such a parallax, measure the offset otherwise and give it.
    """
    place = _check(corrected, band, search)
    pair = corrected.isel(band=[0, place])
    shared = _on_one_clock(sample(pair), clocks.exposures(pair), clocks.segments(pair))
    what = f"of band '{pair['band'].values[1]}' against '{pair['band'].values[0]}'"
    lag = _peak(_covariances(shared, search), what)
    # Whole frames first: smooth functions over the same scene take the same out of both bands.
    found = _covariances(shared.shifted(lag), 1)
    delays = [lag + _delay(part) for part in (found, *_leave_one_out(found))]
    spread = np.sqrt((_GROUPS - 1) * np.var(delays[1:]))
    if not spread <= precision:
        raise ValueError(
            f"Invalid time offset {what}: {delays[0]:.2f} +- {spread:.2f} frames. Must be known "
            f"within {precision}: too little moves, or in too few pixels; give the offset."
        )
    return float(delays[0] * clocks.period(shared.times))


def _check(corrected: xr.Dataset, band: str | None, search: int) -> int:
    """Position of the band."""
    counts = schema.check(corrected, "corrected")["counts"]
    names = [str(name) for name in counts["band"].values]
    if len(names) < 2:
        raise ValueError(f"Invalid bands {names} of the capture. Must be at least two.")
    frames = counts.sizes["time"]
    if frames < MINIMUM_FRAMES:
        raise ValueError(
            f"Invalid capture of {frames} frames for a time offset. "
            f"Must have at least {MINIMUM_FRAMES}."
        )
    if not 1 <= search <= frames // 4:
        raise ValueError(f"Invalid search of {search} frames. Must lie in [1, {frames // 4}].")
    (place,) = schema.band_positions(counts, [names[1] if band is None else band], "the capture")
    if place == 0:
        raise ValueError(f"Invalid band '{names[0]}'. Must be another than the first.")
    return place


def sample(corrected: xr.Dataset) -> Array:
    """
    Counts of usable pixels spread evenly over the image, missing frames NaN.

    Parameters
    ----------
    corrected : Dataset
        Stage `corrected` of `schema`.

    Returns
    -------
    ndarray, shape (band, time, pixel)
        Counts [count] of the pixels that change in every band, and are finite in every frame that
        is not missing.

    Raises
    ------
    ValueError
        If there are fewer than 16 such pixels.
    """
    step = max(1, int(np.sqrt(corrected.sizes["y"] * corrected.sizes["x"] / PIXELS)))
    part = corrected.isel(y=slice(None, None, step), x=slice(None, None, step))
    counts = part["counts"].values.astype(np.float64)
    counts = counts.reshape(*counts.shape[:2], -1)
    usable = np.ones(counts.shape[2], dtype=bool)
    if "status" in part:
        usable &= (part["status"].values.reshape(-1) & _UNUSABLE) == 0
    for movie in counts:
        absent = clocks.missing(movie)
        movie[absent] = np.nan
        usable &= np.all(np.isfinite(movie[~absent]), axis=0) & (np.ptp(movie[~absent], axis=0) > 0)
    if usable.sum() < _GROUPS:
        raise ValueError(
            f"Invalid capture of {usable.sum()} usable pixels. Must be at least {_GROUPS} that are "
            "finite and change."
        )
    return counts[:, :, usable]


def present(frames: npt.NDArray[Any]) -> Mask:
    """
    Frames of a sample that hold something.

    Parameters
    ----------
    frames : ndarray, shape (time, pixel)
        From `sample`.

    Returns
    -------
    ndarray of bool, shape (time,)
        Where they do.
    """
    return np.asarray(~np.isnan(frames[:, 0]))


def _on_one_clock(signals: Array, stamps: Array, segment: clocks.Indices) -> _Shared:
    """Both bands on evenly spaced times; as they are, where they are already."""
    times = clocks.even(stamps)
    if stamps.shape[1] == times.size and np.all(stamps == times):
        return _Shared(signals, np.stack([segment, segment]), times)
    result = np.empty((len(signals), times.size, signals.shape[2]))
    labels = np.empty(result.shape[:2], dtype=np.intp)
    for place, (movie, own) in enumerate(zip(signals, stamps, strict=True)):
        plan = clocks.interpolation(own, present(movie), times).within(segment)
        plan.apply(movie, result[place])
        labels[place] = plan.labels(segment)
    return _Shared(result, labels, times)


def _covariances(shared: _Shared, search: int) -> _Covariances:
    """Covariances of the rapid changes, in groups of pixels."""
    # One step at a shutter event of either band, the same for both.
    _, segment = np.unique(shared.labels, axis=1, return_inverse=True)
    one, other = (present(movie) for movie in shared.signals)
    first, second = (
        _rapid(movie, shared.times, here, segment)
        for movie, here in zip(shared.signals, (one, other), strict=True)
    )
    lags = np.arange(-search - 2, search + 3)
    cross = [_lagged(first, second, one, other, int(lag)) for lag in lags]
    auto = [_lagged(first, first, one, one, lag) for lag in (1, 2)]
    return _Covariances(lags, np.stack(cross, axis=1), np.stack(auto, axis=1))


def _rapid(movie: Array, times: Array, here: Mask, segment: clocks.Indices) -> Array:
    """What smooth functions and steps leave of a signal, (time, pixel); 0 in missing frames."""
    if here.sum() < MINIMUM_FRAMES:
        raise ValueError(
            f"Invalid capture of {here.sum()} frames that hold something. "
            f"Must be at least {MINIMUM_FRAMES} for a time offset."
        )
    steps = segment[here][:, np.newaxis] == np.unique(segment[here])[1:]
    functions, _ = np.linalg.qr(np.hstack([smooth.basis(times[here], _ORDER), steps]))
    left = np.zeros_like(movie)
    left[here] = movie[here] - functions @ (functions.T @ movie[here])
    return left


def _lagged(first: Array, second: Array, one: Mask, other: Mask, lag: int) -> Array:
    """Covariance (group) of the first signal, so many frames later, with the second."""
    frames = len(first)
    late, early = (
        slice(max(lag, 0), frames + min(lag, 0)),
        slice(max(-lag, 0), frames - max(lag, 0)),
    )
    products = np.einsum("tp,tp->p", first[late], second[early])
    size = products.size - products.size % _GROUPS
    grouped = products[:size].reshape(-1, _GROUPS).sum(axis=0)
    return np.asarray(grouped / np.sum(one[late] & other[early]))


def _peak(found: _Covariances, what: str) -> int:
    """Lag at which the bands are most alike [frame]."""
    total = found.cross.sum(axis=0)
    peak = 2 + int(np.argmax(total[2:-2]))
    groups = found.cross[:, peak]
    score = groups.mean() / (groups.std(ddof=1) / np.sqrt(_GROUPS))
    if not score > _SIGNIFICANCE:
        raise ValueError(
            f"Missing time offset {what}: no rapid change that both bands see (a covariance of "
            f"{score:.1f} standard deviations). Must exceed {_SIGNIFICANCE:g}; give the offset."
        )
    if peak in (2, found.lags.size - 3):
        raise ValueError(
            f"Invalid time offset {what}: the bands are most alike {found.lags[peak]} frames "
            "apart, at the end of the search. Must lie inside; search farther."
        )
    return int(found.lags[peak])


def _leave_one_out(found: _Covariances) -> list[_Covariances]:
    """The same without each group of pixels in turn."""
    keep = [np.arange(_GROUPS) != group for group in range(_GROUPS)]
    return [_Covariances(found.lags, found.cross[one], found.auto[one]) for one in keep]


def _delay(found: _Covariances) -> float:
    """Offset [frame] within a frame of lag 0, from the pair of frames it lies best between."""
    cross, (near, far) = found.cross.sum(axis=0), found.auto.sum(axis=0)
    delays = []
    for lag in (-1, 0):
        place = int(np.argmax(found.lags == lag))
        before, after = cross[place - 1], cross[place + 2]
        share = 0.5 - 0.5 * (before - after) / (near - far) * (near + far) / (before + after)
        delays.append((abs(float(share) - 0.5), lag + float(share)))
    return min(delays)[1]
