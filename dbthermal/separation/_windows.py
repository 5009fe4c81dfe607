"""Curves smoothed over the widest window that agrees with all narrower ones, compiled.

Local parabolas, of which the confidence intervals are intersected (Goldenshluger, Nemirovski 1997,
On spatially adaptive estimation of nonparametric regression, Mathematical Methods of Statistics 6,
135): what is smooth is averaged over many frames, what is rapid over few.
"""

from math import sqrt
from typing import Final

import numpy as np

from dbthermal._compiled import compiled
from dbthermal.separation._subspace import kernels
from dbthermal.separation._tiles import Array, Mask, Whole

# Half-widths grow by this factor; deviations within which estimates agree.
_GROWTH: Final = 1.5
_AGREE: Final = 1.5
# Variance that is stated over that of the noise: the rest is what a window bends [1].
_BENT: Final = 1.6
_PARABOLA: Final = 4  # half-width from which the polynomial is a parabola, and a line below [frame]


@kernels.compiled
def intersect(low: float, high: float, value: float, variance: float) -> tuple[float, float]:
    """Interval that an estimate agrees with, within a bound of each."""
    margin = _AGREE * sqrt(variance)
    return max(low, value - margin), min(high, value + margin)


def smooth(values: Array, variance: Array, valid: Mask, time: Array) -> tuple[Array, Array]:
    """Smoothed curves (time, pixel), with white noise of a variance (time, pixel); variances."""
    position = (time - time[0]) / max(time[-1] - time[0], 1e-300)
    rows = [np.ascontiguousarray(array.T) for array in (values, variance, valid)]
    halves = [1]
    while halves[-1] < time.size:
        halves.append(max(halves[-1] + 1, int(halves[-1] * _GROWTH)))
    result, spread = np.empty((2, *rows[0].shape))
    _smooth(*rows, position, np.array(halves[:-1], dtype=np.intp), result, spread)
    return result.T, spread.T


@compiled
def _smooth(
    values: Array,
    variance: Array,
    valid: Mask,
    position: Array,
    halves: Whole,
    result: Array,
    spread: Array,
) -> None:
    """As `smooth`, (pixel, time) in place."""
    frames, pad = position.size, halves[-1] if halves.size else 0
    sums = np.zeros((3, frames + 1 + 2 * pad))
    windows = np.empty((halves.size, 4, frames))
    # Separate arrays: the compiler does not vectorise parts of a common array.
    bounds = lower, upper, agreeing = np.empty(frames), np.empty(frames), np.empty(frames)
    estimate, unbounded = np.empty(frames), np.full(frames, np.inf)
    widest = np.empty(frames, np.intp)
    for p in range(len(values)):
        if p == 0 or np.any(valid[p] != valid[p - 1]):
            _lay_windows(valid[p], position, halves, windows)
        level, noise = _sum_up(values[p], variance[p], valid[p], position, sums, pad)
        for t in range(frames):
            lower[t], upper[t], agreeing[t] = -np.inf, np.inf, 1.0 if valid[p, t] else 0.0
            widest[t], spread[p, t] = -1, variance[p, t]
        for k in range(halves.size):
            _estimate(windows[k], sums, pad - halves[k], pad + halves[k] + 1, estimate)
            # One window narrower than the widest that agrees: its bias is small beside its noise.
            shares = windows[k, 3], windows[k - 1, 3] if k > 0 else unbounded
            if not _widen(estimate, shares, noise, k - 1, bounds, spread[p], widest):
                break
        for t in range(frames):
            k, total = widest[t], values[p, t] - level if valid[p, t] else np.nan
            if k >= 0:
                low, high, total = pad + t - halves[k], pad + t + halves[k] + 1, 0.0
                for power in range(3):
                    total += windows[k, power, t] * (sums[power, high] - sums[power, low])
            result[p, t] = level + total
            bent = min(_BENT * spread[p, t], variance[p, t])
            spread[p, t] = bent if spread[p, t] < variance[p, t] else variance[p, t]


@kernels.compiled
def _estimate(window: Array, sums: Array, low: int, high: int, estimate: Array) -> None:
    """Values at the centres of windows of one half-width (time), in place."""
    frames = estimate.size
    kernels.fill(estimate, 0.0)
    for power in range(3):
        before, after = sums[power, low : low + frames], sums[power, high : high + frames]
        weight = window[power]
        for t in range(frames):
            estimate[t] += weight[t] * (after[t] - before[t])


@kernels.compiled
def _widen(
    estimate: Array,
    shares: tuple[Array, Array],
    noise: float,
    window: int,
    bounds: tuple[Array, Array, Array],
    spread: Array,
    widest: Whole,
) -> bool:
    """Intersect confidence intervals (time), in place; return whether any still overlap."""
    (wide, share), (lower, upper, agreeing), remaining = shares, bounds, 0.0
    for t in range(estimate.size):
        lower[t], upper[t] = intersect(lower[t], upper[t], estimate[t], wide[t] * noise)
        agreeing[t] = agreeing[t] if lower[t] <= upper[t] else 0.0
        remaining += agreeing[t]
        # Where they agree take the window before, if it has less noise.
        better = (agreeing[t] > 0.0) & (share[t] * noise <= spread[t])
        widest[t] = window if better else widest[t]
        spread[t] = share[t] * noise if better else spread[t]
    return bool(remaining > 0.0)


@kernels.compiled
def _sum_up(
    values: Array, variance: Array, valid: Mask, position: Array, sums: Array, pad: int
) -> tuple[float, float]:
    """Means of a pixel's valid values and variances (time); sums (3, time + 1) in place, padded."""
    count, level, noise = 0.0, 0.0, 0.0
    for t in range(position.size):
        if valid[t]:
            count, level, noise = count + 1.0, level + values[t], noise + variance[t]
    level, noise = level / max(count, 1.0), noise / max(count, 1.0)
    # Sums before each place, of values about the mean times powers of their positions.
    for t in range(position.size):
        value = values[t] - level if valid[t] else 0.0
        for power in range(3):
            sums[power, pad + t + 1] = sums[power, pad + t] + value
            value *= position[t]
    for power in range(3):
        sums[power, pad + position.size :] = sums[power, pad + position.size]
    return level, noise


@kernels.allocating
def _lay_windows(valid: Mask, position: Array, halves: Whole, windows: Array) -> None:
    """Weights of parabolas, or lines, at the centres of windows (half-width, 4, time), in place."""
    sums = np.zeros((position.size + 1, 5))
    for t in range(position.size):
        weight = 1.0 if valid[t] else 0.0
        for power in range(5):
            sums[t + 1, power] = sums[t, power] + weight
            weight *= position[t]
    for k in range(halves.size):
        for t in range(position.size):
            _centre(sums, position, t, halves[k], windows[k, :, t])


@kernels.compiled
def _centre(sums: Array, position: Array, place: int, half: int, window: Array) -> None:
    """Weights of one window's sums of `_sum_up`, and its variance over the noise's, in place."""
    low, high = max(place - half, 0), min(place + half + 1, position.size)
    width = position[min(high, position.size - 1)] - position[low]
    scale, at = 1.0 / max(width, 1e-300), position[place]
    before, after = sums[low], sums[high]
    a0, a1, a2 = after[0] - before[0], after[1] - before[1], after[2] - before[2]
    # Moments about the window's centre, by the binomial theorem, in units of its width.
    s1 = (a1 - at * a0) * scale
    s2 = (a2 - 2 * at * a1 + at**2 * a0) * scale**2
    if half < _PARABOLA:
        c0, c1, c2 = s2, -s1, 0.0
        determinant, least = a0 * s2 - s1**2, 1e-6 * a0**2
    else:
        a3, a4 = after[3] - before[3], after[4] - before[4]
        s3 = (a3 - 3 * at * a2 + 3 * at**2 * a1 - at**3 * a0) * scale**3
        s4 = (a4 - 4 * at * a3 + 6 * at**2 * a2 - 4 * at**3 * a1 + at**4 * a0) * scale**4
        # First row of the inverse of ((s0 s1 s2) (s1 s2 s3) (s2 s3 s4)).
        c0, c1, c2 = s2 * s4 - s3**2, s2 * s3 - s1 * s4, s1 * s3 - s2**2
        determinant, least = a0 * c0 + s1 * c1 + s2 * c2, 1e-8 * a0**3
    # Samples that do not determine the polynomial: no weight, and no certainty.
    if not determinant > least:
        window[:3], window[3] = 0.0, np.inf
        return
    c0, c1, c2 = c0 / determinant, c1 / determinant * scale, c2 / determinant * scale**2
    window[0], window[1], window[2] = c0 - at * c1 + at**2 * c2, c1 - 2 * at * c2, c2
    window[3] = c0
