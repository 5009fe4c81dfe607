r"""Time by which one camera lags another, from the rapid changes that both see.

With the smooth part projected out, the first band holds the background b(t) and the second
:math:`\rho \, b(t + \delta)`, both noise besides. A background moves in steps: its autocovariance R
is a tent, and a parabola through the peak of the covariance C would be biased. Instead the second
band is predicted from the first, interpolated in a line between the frames m and m + 1:

.. math:: \rho \, b(t + \delta) = h_0 b(t + m) + h_1 b(t + m + 1), \quad
   \delta = m + \frac{h_1}{h_0 + h_1}

Multiplied not by these two frames but by their outer neighbours m - 1 and m + 2 (instrumental
variables), the noise of the first band does not enter, which at lag 0 would:

.. math:: C_{m-1} = h_0 R_1 + h_1 R_2, \quad C_{m+2} = h_0 R_2 + h_1 R_1

The difference and the sum of both give :math:`\delta`. It is exact where R is straight or parabolic
over two frames on either side of its peak: for steps, and for smooth changes.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import _numbers, schema
from dbthermal import _smooth as smooth
from dbthermal import noise as noises
from dbthermal._arrays import Array, Mask, stride
from dbthermal.alignment import _clocks as clocks
from dbthermal.noise import MAD

_PIXELS, _SAMPLES = 16384, 2**25  # compared pixels, and samples of a band, at most
SEARCH: Final = 5  # largest lag that is searched by default, either way [frame]
# Step of one clock against the other from which a lost frame or a set clock is suspected [frame].
_CLOCK_STEP: Final = 0.5
_COVERAGE: Final = 0.5  # least share of the frames that both bands must have [1]
_MINIMUM_FRAMES: Final = 32  # fewest frames from which an offset is estimated
_GROUPS: Final = 16  # groups of pixels of the jackknife
_SIGNIFICANCE: Final = 6.0  # least covariance of the bands [standard deviation]
_PRECISION: Final = 0.1  # largest standard deviation of an offset [frame]
_ORDER: Final = 8  # smooth functions that are projected out
TELLING: Final = 2**22  # samples of a band from which the share of a bend is estimated, at most
# Largest share of the cubic's bend, and its largest standard deviation (1.0 to 1.5 +- 0.12 half a
# frame late); and the difference of frame rates below which neighbouring frames compare [1].
_MAX_BEND, _MAX_STD, _RATE_ERROR = 2.0, 0.25, 0.01


@dataclass(frozen=True)
class _Pair:
    """Two bands on one clock of even steps."""

    signals: Array  # counts (2, time, pixel) [count], NaN in missing frames
    segments: smooth.Whole  # number of shutter events before each frame (2, time)
    times: Array  # (time) [s]

    def shifted(self, lag: int) -> "_Pair":
        """Pair with the first band taken `lag` frames later."""
        frames = self.times.size - abs(lag)
        late, early = (slice(start, start + frames) for start in (max(lag, 0), max(-lag, 0)))
        signals = np.stack([self.signals[0, late], self.signals[1, early]])
        segments = np.stack([self.segments[0, late], self.segments[1, early]])
        return _Pair(signals, segments, self.times[:frames])


def time_offset(corrected: xr.Dataset, *, band: str | None = None, search: int = SEARCH) -> float:
    """Delay of a band's exposures behind the first band's [s]; negative if it is ahead.

    Positive: frame n of this band was exposed that much **later** than frame n of the first. Where
    the capture has the cameras' own stamps, it is the delay beyond them.

    Cameras side by side see a reflection at different pixels. Where most of what is reflected moves
    one way, it comes to a pixel of one view earlier, and this looks like an offset, of which the
    standard deviation says nothing; motion either way cancels. There, measure it otherwise.

    TypeError or ValueError if the band is missing, the search does not fit the capture's length,
    there are fewer than 16 usable pixels, nothing moves in both bands, their covariance is greatest
    at an end of the search, the bands share less than half of their frames, the offset is not known
    within 0.1 frame, a clock was set while it ran, or times are of arrival, in bursts.

    Parameters
    ----------
    corrected : Dataset
        Stage `corrected` of `schema`, of registered views; optionally `status` (y, x), of which
        dead and saturated pixels are left out, `exposure_time` (band, time) [s], and `segment`
        (time): the steps of shutter events are no motion. Missing frames are NaN or copies of the
        frame before. Frames dropped with neither stamp nor copy are not noticed. A pause of the
        recording is skipped.
    band : str, optional
        Name of the band; by default the second.
    search : int
        Largest lag to search, either way [frame].

    Examples
    --------
    A background that steps at random, seen by the second camera half a frame later.

    >>> import numpy as np, xarray as xr
    >>> rng, time = np.random.default_rng(1), np.arange(200) / 10.0
    >>> steps = rng.normal(0, 20, (802, 64)) * (rng.random((802, 64)) < 0.05)
    >>> signal = np.cumsum(steps, axis=0)
    >>> counts = np.stack([signal[:800:4], signal[2:802:4]]).reshape(2, 200, 8, 8)
    >>> counts += rng.normal(0, 1, counts.shape)
    >>> axes = {"band": ["8-14", "9.5"], "time": time}
    >>> corrected = xr.Dataset({"counts": (("band", "time", "y", "x"), counts)}, axes)
    >>> round(time_offset(corrected), 2)  # the frame period is 0.1 s
    0.05
    """
    return measured_offset(corrected, band, search)[0]


def measured_offset(
    corrected: xr.Dataset, band: str | None = None, search: int = SEARCH
) -> tuple[float, float]:
    """Delay as `time_offset`, and its standard deviation by the jackknife [s]."""
    place = check(corrected, band, search)
    pair = corrected.isel(band=[0, place])
    signals, stamps = sample(pair), clocks.exposure_times(pair)
    clocks.require_steady(stamps, [str(name) for name in pair["band"].values])
    require_one_clock(pair, signals, stamps, search)
    return _offset(pair, signals, stamps, search)


def require_one_clock(
    pair: xr.Dataset, signals: Array, stamps: Array, search: int = SEARCH
) -> None:
    """Refuse exposure times (band, time) [s] of two bands if the clock of one of them was set."""
    rows = np.flatnonzero(np.all(np.isfinite(stamps), axis=0))
    steps = np.diff(stamps[:, rows], axis=1)
    slip = steps[1] - steps[0]
    if not slip.size or np.abs(slip).max() <= _CLOCK_STEP * clocks.frame_period(stamps[0]):
        return
    place = int(np.argmax(np.abs(slip)))
    excess = steps[:, place] - np.median(steps, axis=1)
    band, frame = int(np.argmax(np.abs(excess))), int(rows[place])
    # Offsets before the step, after it, and after it with the step undone. A clock was set if the
    # last is nearer to the first, frames were lost if the second is.
    before, after, undone = (stamps.copy() for _ in range(3))
    before[band, frame + 1 :] = after[band, : frame + 1] = undone[band, : frame + 1] = np.nan
    undone[band] -= excess[band]
    trials = before, after, undone
    reference, stepped, without = (_try(pair, signals, times, search) for times in trials)
    # NaN, of no motion before or after the step, refuses nothing.
    if abs(without - reference) < np.nan_to_num(abs(stepped - reference), nan=np.inf):
        raise ValueError(
            f"Invalid exposure times of band '{pair['band'].values[band]}': a step of "
            f"{steps[band, place]:.6g} s after {stamps[band, frame]:.6g} s, but the images go on "
            "as without it. Must be of a clock that is not set while it runs; give the capture "
            "before or after."
        )


def _try(pair: xr.Dataset, signals: Array, stamps: Array, search: int) -> float:
    """Offset [s] as `_offset`; NaN where it cannot be measured."""
    if np.isfinite(stamps).sum(axis=1).min() < _MINIMUM_FRAMES:
        return np.nan
    try:
        return _offset(pair, signals, stamps, search)[0]
    except ValueError:
        return np.nan


@np.errstate(divide="ignore", invalid="ignore")
def _offset(pair: xr.Dataset, signals: Array, stamps: Array, search: int) -> tuple[float, float]:
    """Offset of two bands and its standard deviation [s], from signals at their exposure times."""
    names = [str(name) for name in pair["band"].values]
    start = [row[np.isfinite(row)][0] for row in stamps]
    times = f"times begin at {start[1]:.4g} and {start[0]:.4g} s"
    label = f"of band '{names[1]}' against '{names[0]}', whose {times}"
    # Frames on either side of a pause never meet, at any lag.
    shared = _on_one_clock(signals, stamps, schema.segments(pair), search + 3)
    lag = _peak(_covariances(shared, search, names)[0], label)
    # Shift by whole frames first, so that the smooth functions span the same scene in both bands.
    lags = lag + _delays(*_covariances(shared.shifted(lag), 1, names))
    # The side of the lag on which the offset of all pixels lies, for the groups as well.
    delays = lags[:, np.argmin(np.abs(lags[0] - lag - np.array([-0.5, 0.5])))]
    # Jackknife over n groups: var = (n - 1) mean (d_i - mean d)^2.
    std = np.sqrt((_GROUPS - 1) * np.var(delays[1:]))
    if not std <= _PRECISION:
        rule = f"within {_PRECISION}: too little moves, or in too few pixels; give offset= [s]"
        estimate = f"{delays[0]:.2f} +- {std:.2f} frames"
        raise ValueError(f"Invalid time offset {label}: {estimate}. Must be known {rule}.")
    period = clocks.frame_period(shared.times)
    return float(delays[0] * period), float(std * period)


def check(corrected: xr.Dataset, band: str | None, search: int) -> int:
    """Check a capture and a band whose offset is measured; return the position of the band."""
    counts = schema.check(corrected, "corrected")["counts"]
    names = [str(name) for name in counts["band"].values]
    if len(names) < 2:
        raise ValueError(f"Invalid bands {names} of the capture. Must be at least two.")
    frames = counts.sizes["time"]
    if frames < _MINIMUM_FRAMES:
        rule = f"Must have at least {_MINIMUM_FRAMES}"
        raise ValueError(f"Invalid number {frames} of frames for a time offset. {rule}.")
    _numbers.whole_number("search [frame]", search, (1, frames // 4))
    (place,) = schema.band_positions(counts, [names[1] if band is None else band], "the capture")
    if place == 0:
        raise ValueError(f"Invalid band '{names[0]}'. Must be another than the first.")
    return place


def sample(corrected: xr.Dataset) -> Array:
    """Counts (band, time, pixel) of usable pixels on an even grid, NaN in missing frames."""
    pixels = corrected.sizes["y"] * corrected.sizes["x"]
    # Fewer pixels of a long capture.
    fitting = int(np.ceil(np.sqrt(pixels * corrected.sizes["time"] / _SAMPLES)))
    step = max(stride((corrected.sizes["y"], corrected.sizes["x"]), _PIXELS), fitting)
    subsample = corrected.isel(y=slice(None, None, step), x=slice(None, None, step))
    counts = subsample["counts"].values.astype(np.float64)
    counts[~schema.measured(counts)] = np.nan
    counts = counts.reshape(*counts.shape[:2], -1)
    # Usable: not dead, saturated or invalid; finite in recorded frames, changing in all bands.
    usable = (schema.pixel_status(subsample).ravel() & np.uint32(schema.UNMEASURED)) == 0
    for movie in counts:
        absent = clocks.missing(movie)
        movie[absent], recorded = np.nan, movie[~absent]
        changes = recorded.max(axis=0, initial=-np.inf) > recorded.min(axis=0, initial=np.inf)
        usable &= np.all(np.isfinite(recorded), axis=0) & changes
    if usable.sum() < _GROUPS:
        rule = f"Must be at least {_GROUPS} that are finite and change"
        raise ValueError(f"Invalid number {usable.sum()} of usable pixels. {rule}.")
    return counts[:, :, usable]


def noise_levels(signals: Array, stamps: Array) -> Array:
    """Noise of each band from second differences in time, in counts and over its signal."""
    levels = []
    for frames, times in zip(signals, stamps, strict=True):
        valid = present(frames) & np.isfinite(times)
        signal = frames[valid]
        rough = noises.second_difference(signal, times[valid])
        if not rough.size:  # too few frames to tell
            levels.append((0.0, 0.0))
            continue
        scatter, change = MAD * np.median(np.abs(rough), axis=0), signal.std(axis=0)
        relative = np.divide(scatter, change, out=np.zeros_like(change), where=change > 0)
        levels.append((np.median(scatter), np.median(relative)))
    return np.array(levels).T


def present(frames: npt.NDArray[Any]) -> Mask:
    """Frames (time) of a `sample` (time, pixel) that are not missing."""
    return np.asarray(~np.isnan(frames[:, 0]))


def _on_one_clock(signals: Array, stamps: Array, segment: smooth.Whole, reach: int) -> _Pair:
    """Both bands at evenly spaced times, interpolated where they are not already."""
    times = clocks.even_times(stamps, reach)
    if stamps.shape[1] == times.size and np.all(stamps == times):
        return _Pair(signals, np.stack([segment, segment]), times)
    result = np.empty((len(signals), times.size, signals.shape[2]))
    segments = np.empty(result.shape[:2], dtype=np.intp)
    for place, (movie, row) in enumerate(zip(signals, stamps, strict=True)):
        plan = clocks.interpolation(row, present(movie), times, segment)
        result[place] = plan.matrix(0.0) @ np.nan_to_num(movie)
        result[place, ~plan.valid] = np.nan
        segments[place] = plan.labels(segment)
    return _Pair(result, segments, times)


def _covariances(shared: _Pair, search: int, names: list[str]) -> tuple[Array, Array]:
    """Covariances of rapid changes by group: C (group, lag); R (group, 2) of the first band."""
    # One step at a shutter event of either band, the same for both.
    _, segment = np.unique(shared.segments, axis=1, return_inverse=True)
    frames = _common(shared, names)
    first, second = (_rapid(movie, shared.times, frames, segment) for movie in shared.signals)
    # The first band is later by up to `search` lags, and two more that `_delays` needs, either way.
    cross = [_lagged(first, second, frames, lag) for lag in range(-search - 2, search + 3)]
    auto = [_lagged(first, first, frames, lag) for lag in (1, 2)]
    return np.stack(cross, axis=1), np.stack(auto, axis=1)


def _common(shared: _Pair, names: list[str]) -> Mask:
    """Frames (time) that both bands have, over which the smooth part is removed from both."""
    valid = np.stack([present(movie) for movie in shared.signals])
    frames, total = valid.all(axis=0), valid.any(axis=0).sum()
    if frames.sum() < _COVERAGE * total:
        band = int(np.argmin(valid.sum(axis=1)))
        share = 1.0 - valid[band].sum() / total
        raise ValueError(
            f"Invalid frames of band '{names[band]}': {100 * share:.0f} % are missing, and the "
            f"bands '{names[0]}' and '{names[1]}' share {100 * frames.sum() / total:.0f} %. Must "
            f"share at least {100 * _COVERAGE:.0f} %, for a time offset; give the offset."
        )
    if frames.sum() < _MINIMUM_FRAMES:
        label = f"{frames.sum()} of valid frames of both bands '{names[0]}' and '{names[1]}'"
        rule = f"Must be at least {_MINIMUM_FRAMES} for a time offset"
        raise ValueError(f"Invalid number {label}. {rule}.")
    return np.asarray(frames)


def _rapid(movie: Array, times: Array, valid: Mask, segment: smooth.Whole) -> Array:
    """Residual of a signal (time, pixel) on smooth functions and steps; 0 in invalid frames."""
    functions = smooth.subspace(times[valid], _ORDER, segment=segment[valid]).functions
    residual = np.zeros_like(movie)
    residual[valid] = movie[valid] - functions @ (functions.T @ movie[valid])
    return residual


def _lagged(first: Array, second: Array, valid: Mask, lag: int) -> Array:
    """Covariance (group) of the first signal, later by a lag [frame], with the second."""
    frames = len(first) - abs(lag)
    late, early = (slice(start, start + frames) for start in (max(lag, 0), max(-lag, 0)))
    products = np.einsum("tp,tp->p", first[late], second[early])
    size = products.size - products.size % _GROUPS
    grouped = products[:size].reshape(-1, _GROUPS).sum(axis=0)
    return np.asarray(grouped / np.sum(valid[late] & valid[early]))


def _peak(cross: Array, label: str) -> int:
    """Lag of the largest covariance (group, lag) of the bands [frame]; it must be significant."""
    middle: int = cross.shape[1] // 2
    lag = 2 + int(np.argmax(cross.sum(axis=0)[2:-2])) - middle
    groups = cross[:, lag + middle]
    score = groups.mean() / (groups.std(ddof=1) / np.sqrt(_GROUPS))
    if not score > _SIGNIFICANCE:
        raise ValueError(
            f"Missing time offset {label}: no rapid change that both bands see within {middle - 2} "
            f"frames of these (a covariance of {score:.1f} standard deviations, over "
            f"{_SIGNIFICANCE:g} if there is one). Must be seen: mend the times if they are not "
            "right, search farther by search= [frame], or give offset= [s] beyond the times."
        )
    if abs(lag) == middle - 2:
        peak = f"the largest covariance is at {lag} frames, the end of the search"
        rule = "Must lie inside: correct offset=, or search farther by search= [frame]"
        raise ValueError(f"Invalid time offset {label}: {peak}. {rule}.")
    return lag


def _delays(cross: Array, auto: Array) -> Array:
    """Sub-frame offsets (group, 2) [frame], if they lie in (-1, 0), and if in (0, 1)."""
    # First row: all groups of pixels; each other row omits a group, for the jackknife.
    groups, middle = np.vstack([np.ones(_GROUPS), 1.0 - np.eye(_GROUPS)]), cross.shape[1] // 2
    cross, (auto1, auto2) = groups @ cross, (groups @ auto).T
    delays = []
    for lag in (-1, 0):
        # C_-1 -+ C_2 = (h0 -+ h1)(R1 -+ R2) of the frames m - 1 and m + 2: delta = h1 / (h0 + h1).
        before, after = cross[:, middle + lag - 1], cross[:, middle + lag + 2]
        share = 0.5 - 0.5 * (before - after) / (auto1 - auto2) * (auto1 + auto2) / (before + after)
        delays.append(lag + share)
    return np.stack(delays, axis=1)


@np.errstate(divide="ignore", invalid="ignore")
def bent(
    plan: clocks.Interpolation, pair: Array, times: Array, segment: smooth.Whole, largest: float
) -> clocks.Interpolation:
    r"""Interpolation of a band x whose rapid changes are as large as those of the reference y.

    Products of neighbouring frames give the ratio k = y / x without noise. Total least squares with
    covariances C, of samples without a step of `largest`, gives the same k if the share of the
    cubic's bend (1 where it cannot be estimated) solves

    .. math:: \sigma_y^2 (C_{yx} - k C_{xx}) + k \sigma_x^2 (C_{yy} - k C_{yx}) = 0

    The `pair` (2, time, pixel) [count] holds y at the `times` [s], and x at its own times.
    """
    timed, valid = present(pair[1]) & np.isfinite(plan.stamps), plan.valid & present(pair[0])
    shared, rate = present(pair[0]) & timed, clocks.frame_period(plan.stamps)
    agreement = abs(clocks.frame_period(times) - rate) < _RATE_ERROR * rate
    if not (agreement and plan.bend.any() and min(valid.sum(), timed.sum()) >= _MINIMUM_FRAMES):
        return plan
    try:
        power = np.square(noises.estimate(pair[0, shared], pair[1, shared], times[shared]))
    except ValueError:  # without noise
        return plan
    # Rapid changes of y, and of x by the line and by the cubic; samples without a step.
    matrices, dot = (plan.matrix(0.0), plan.matrix()), partial(np.einsum, "tp,tp->p")
    films = pair[0], *(matrix @ np.nan_to_num(pair[1]) for matrix in matrices)
    y, line, x = (_rapid(film, times, valid, segment) for film in films)
    replace(plan, swing=np.inf).apply(pair[1], film := np.empty_like(y), largest)
    mask = np.isfinite(film)
    # Without the smooth functions white noise adds -_ORDER / n of its variance to the products of
    # neighbouring frames: it is taken out.
    pairs = (y, valid), (_rapid(pair[1], plan.stamps, timed, segment), timed)
    autos = [dot(z[1:], z[:-1]) / np.sum(use[1:] & use[:-1]) for z, use in pairs]
    auto_y, auto_x = np.array(autos) + _ORDER / valid.sum() * power[:, np.newaxis]
    late, early = dot(y[1:], x[:-1]), dot(y[:-1], x[1:])
    # Interpolated frames vary less: scale their products, alike in all pixels, to the samples'.
    cross = 0.5 * (late + early) * np.sqrt(np.sum(auto_y * auto_x) / np.sum(late * early))
    white, forces = mask.sum(axis=0) * (1.0 - _ORDER / valid.sum()), []
    for film, matrix in zip((line, x), matrices, strict=True):
        common, noisy = dot(y, film * mask), (matrix**2).sum() / valid.sum() * white * power[1]
        force = power[0] * (common * auto_x - (dot(film, film * mask) - noisy) * cross)
        level = (dot(y, y * mask) - white * power[0]) * cross - common * auto_y
        force += power[1] * cross.sum() / auto_x.sum() * level
        forces.append([group.sum() for group in np.array_split(force, _GROUPS)])
    # The share at which no force is left, from the line (0) to the cubic (1); jackknife as above.
    before, after = forces @ np.column_stack([np.ones(_GROUPS), 1.0 - np.eye(_GROUPS)])
    share, *replicates = before / (before - after)
    if np.sqrt((_GROUPS - 1) * np.var(replicates)) <= _MAX_STD and 0.0 <= share <= _MAX_BEND:
        return replace(plan, bend=share * plan.bend)
    return plan
