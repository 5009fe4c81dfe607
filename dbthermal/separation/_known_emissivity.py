r"""Object and background at known emissivities: frame by frame, and smoothed.

Signals :math:`s = u_1(x), r = u_1(y)` of the first band, with the other responses as functions
:math:`B_m = u_m \circ u_1^{-1}` of them, give two equations or more in two unknowns,

.. math:: z_m = e_m B_m(s) + (1 - e_m) B_m(r) \qquad (1)

weighted by their noise; of the background a level may be known and how much it fluctuates. No prior
in time is set. The object is then smoothed by local parabolas, over the widest window of which the
estimate agrees with those of all narrower ones, by the intersection of their confidence intervals
[1]_: what is smooth is averaged over many frames, what is rapid over few.

.. [1] Goldenshluger, Nemirovski (1997), On spatially adaptive estimation of nonparametric
   regression, Mathematical Methods of Statistics 6, 135
"""

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from dbthermal._compiled import compiled
from dbthermal.separation._subspace import kernels
from dbthermal.separation._tiles import Array, Mask, Tile, Whole

# Newton's steps, at most, and the length of the last one in a pixel, which leaves its square over
# a thousand kelvin [K].
_STEPS, _CONVERGED = 8, 1e-2
# Half-widths grow by this factor; deviations within which estimates agree.
_GROWTH: Final = 1.5
AGREE: Final = 1.5
# Variance that is stated over that of the noise: the rest is what a window bends [1].
_BENT: Final = 1.6
# Half-width from which the polynomial is a parabola, and a line below [frame].
_PARABOLA: Final = 4


@dataclass(frozen=True)
class Frames:
    """Object and background of every frame (time, pixel), with their variances."""

    signal: Array  # s [K], NaN where Newton's steps do not converge
    background: Array  # r [K]
    white: Array  # variance of s from noise, independent between frames [K^2]
    shared: Array  # of s from fluctuation, a pixel's offset, emissivities and level [K^2]
    background_variance: Array  # of r from all of these but the offset [K^2]


def solve(
    tile: Tile,
    emissivity: Array,
    level: Array,
    fluctuation: Array,
    covariance: Array | None = None,
    *,
    apart: bool = False,
) -> Frames:
    """Solve every frame by Newton's method, at emissivities (band, pixel).

    The background has a level (pixel) [K] and a variance about it (pixel) [K^2]; both are uncertain
    by a covariance (band + 1, band + 1, pixel). Of cameras apart, what fluctuates in the other
    bands is another part of it: noise.
    """
    bands, frames, pixels = tile.signals.shape
    if covariance is None:
        covariance = np.zeros((bands + 1, bands + 1, pixels))
    pattern = np.zeros(bands) if tile.pattern is None else np.square(tile.pattern)
    share = np.ones(bands) if not apart else np.eye(bands)[0]
    unseen = np.outer(fluctuation, 1.0 - share) * np.square(1.0 - emissivity.T)
    result = np.empty((5, pixels, frames))
    _solve(
        response_tables(tile),
        np.ascontiguousarray(tile.signals.transpose(2, 0, 1)),
        np.stack([emissivity.T, np.square(tile.noise) + unseen], axis=1),
        np.stack([level, fluctuation], axis=-1),
        np.ascontiguousarray(covariance.transpose(2, 0, 1)),
        np.stack([share, pattern]),
        result,
    )
    return Frames(*result.transpose(0, 2, 1))


def response_tables(tile: Tile) -> tuple[kernels.Table, ...]:
    """Responses of the bands as polynomials of one range."""
    return tuple(kernels.table(curve, *tile.curves) for curve in tile.curves)


@compiled
def other_band(
    first: kernels.Table,
    other: kernels.Table,
    signal: Array,
    value: Array,
    slope: Array,
    place: Array,
    rate: Array,
) -> None:
    """B_m and its slope of a band at signals of the first band's, in place; the last are spare."""
    kernels.temperature(first, signal, place)
    kernels.blackbody(first, place, value, rate)
    for t in range(signal.size):  # Newton's step
        place[t] += (signal[t] - value[t]) / rate[t]
    kernels.blackbody(other, place, value, slope)
    for t in range(signal.size):
        slope[t] /= rate[t]


class _Work(NamedTuple):
    """Quantities of one pixel (time), or of its bands; of parts of one array none is a vector."""

    emitted: Array  # B_m(s) [K], and its slope with the temperature
    slope: Array
    behind: Array  # B_m(r) [K], and its slope
    rate: Array
    places: Array  # temperatures x and y, and that of the level (3, time) [K]
    ss: Array  # normal equations, or their inverse
    sr: Array
    rr: Array
    to_s: Array  # right sides, or the gains of a band
    to_r: Array
    of_s: Array  # sensitivities to the emissivities and the level (band + 1, time) [K]
    of_r: Array
    variance: Array


@compiled
def _solve(
    tables: tuple[kernels.Table, ...],
    signals: Array,
    known: Array,
    levels: Array,
    covariance: Array,
    shares: Array,
    result: Array,
) -> None:
    """As `solve`, in place (5, pixel, time).

    Of each pixel its signals (band, time), emissivities and variances of the bands (2, band), level
    of the background and variance about it (2), and their covariance; of each band the share of the
    fluctuation that it sees, and the variance of a pixel's offset (2, band).
    """
    pixels, bands, frames = signals.shape
    work = _Work(
        np.empty((bands, frames)),
        np.empty((bands, frames)),
        np.empty((bands, frames)),
        np.empty((bands, frames)),
        np.empty((3, frames)),
        np.empty(frames),
        np.empty(frames),
        np.empty(frames),
        np.empty(frames),
        np.empty(frames),
        np.empty((bands + 1, frames)),
        np.empty((bands + 1, frames)),
        np.empty(frames),
    )
    for p in range(pixels):
        room = kernels.inverse(tables[0], levels[p, 0])
        kernels.temperature(tables[0], signals[p, 0], work.places[0])
        kernels.fill(work.places[1], room)
        kernels.fill(work.places[2], room)
        for t in range(frames):
            work.places[0, t] = room if np.isnan(work.places[0, t]) else work.places[0, t]
        for _ in range(_STEPS):
            for m in range(bands):
                seen = work.places[1 if shares[0, m] > 0 else 2]
                kernels.blackbody(tables[m], work.places[0], work.emitted[m], work.slope[m])
                kernels.blackbody(tables[m], seen, work.behind[m], work.rate[m])
            if _step(signals[p], known[p], shares[0], levels[p], work, result[:2, p]):
                break
        at_room = kernels.exact(tables[0], room)[1]
        _propagate(known[p], shares, at_room, covariance[p], work, result[2:, p])


@compiled
def _step(
    signal: Array, known: Array, share: Array, level: Array, work: _Work, result: Array
) -> bool:
    """Newton's step of a pixel, in place; whether it was a short one in all frames."""
    ss, sr, rr, to_s, to_r = work.ss, work.sr, work.rr, work.to_s, work.to_r
    for t in range(ss.size):
        ss[t], sr[t], rr[t] = 0.0, 0.0, 1.0 / level[1]
        to_s[t], to_r[t] = 0.0, (level[0] - work.behind[0, t]) / level[1]
    for m in range(share.size):
        e, weight, dark = known[0, m], 1.0 / known[1, m], (1.0 - known[0, m]) * share[m]
        for t in range(ss.size):
            by_s = e * work.slope[m, t] / work.slope[0, t]
            by_r = dark * work.rate[m, t] / work.rate[0, t]
            off = signal[m, t] - work.behind[m, t] - e * (work.emitted[m, t] - work.behind[m, t])
            ss[t] += weight * by_s**2
            sr[t] += weight * by_s * by_r
            rr[t] += weight * by_r**2
            to_s[t] += weight * by_s * off
            to_r[t] += weight * by_r * off
    lacking = 0.0
    for t in range(ss.size):
        least = 1.0 / (ss[t] * rr[t] - sr[t] ** 2)
        step = (rr[t] * to_s[t] - sr[t] * to_r[t]) * least
        change = (ss[t] * to_r[t] - sr[t] * to_s[t]) * least
        ss[t], sr[t], rr[t] = ss[t] * least, sr[t] * least, rr[t] * least
        work.places[0, t] += step / work.slope[0, t]
        work.places[1, t] += change / work.rate[0, t]
        solved = abs(step) + abs(change) <= _CONVERGED
        result[0, t] = work.emitted[0, t] + step if solved else np.nan
        result[1, t] = work.behind[0, t] + change if solved else np.nan
        lacking += 0.0 if solved else 1.0
    return bool(lacking == 0.0)


@compiled
def _propagate(
    known: Array, shares: Array, at_room: float, covariance: Array, work: _Work, result: Array
) -> None:
    """Variances of a pixel, see `Frames` (3, time), in place."""
    ss, sr, rr, to_s, to_r = work.ss, work.sr, work.rr, work.to_s, work.to_r
    white, offset, bands = result[0], work.variance, shares.shape[1]
    for t in range(ss.size):
        white[t], offset[t] = 0.0, 0.0
        work.of_s[bands, t], work.of_r[bands, t] = 0.0, 1.0
    for m in range(bands):
        e, variance, share = known[0, m], known[1, m], shares[0, m]
        for t in range(ss.size):
            by_s = e * work.slope[m, t] / work.slope[0, t]
            by_level = (1.0 - e) * work.rate[m, t] / (work.rate[0, t] if share > 0.0 else at_room)
            to_s[t] = (by_s * rr[t] - share * by_level * sr[t]) / variance
            to_r[t] = (share * by_level * ss[t] - by_s * sr[t]) / variance
            white[t] += to_s[t] ** 2 * variance
            offset[t] += to_s[t] ** 2 * shares[1, m]
            contrast = work.emitted[m, t] - work.behind[m, t]
            work.of_s[m, t], work.of_r[m, t] = -to_s[t] * contrast, -to_r[t] * contrast
            work.of_s[bands, t] -= to_s[t] * by_level
            work.of_r[bands, t] -= to_r[t] * by_level
    for t in range(ss.size):
        result[1, t], result[2, t] = max(rr[t] - white[t], 0.0) + offset[t], ss[t]
    _add_through(work.of_s, covariance, work.variance, result[1])
    _add_through(work.of_r, covariance, work.variance, result[2])


@compiled
def _add_through(sensitivity: Array, covariance: Array, total: Array, result: Array) -> None:
    """Add the variance through parameters, d^T C d, (time) in place."""
    kernels.fill(total, 0.0)
    for i in range(len(covariance)):
        for j in range(len(covariance)):
            for t in range(total.size):
                total[t] += sensitivity[i, t] * covariance[i, j] * sensitivity[j, t]
    for t in range(total.size):
        result[t] += max(total[t], 0.0)


def temperatures(tile: Tile, signal: Array, variance: Array) -> tuple[Array, Array]:
    """Temperatures (time, pixel) [K] of first-band signals, and their standard deviations."""
    result = np.empty((2, *signal.T.shape))
    parts = (np.ascontiguousarray(part.T) for part in (signal, variance))
    _temperatures(response_tables(tile)[0], *parts, result)
    return result[0].T, result[1].T


@compiled
def _temperatures(table: kernels.Table, signal: Array, variance: Array, result: Array) -> None:
    """As `temperatures`, (pixel, time) in place."""
    emitted, slope = np.empty(signal.shape[1]), np.empty(signal.shape[1])
    for p in range(len(signal)):
        kernels.temperature(table, signal[p], result[0, p])
        kernels.blackbody(table, result[0, p], emitted, slope)
        for t in range(emitted.size):  # Newton's step
            result[0, p, t] += (signal[p, t] - emitted[t]) / slope[t]
            result[1, p, t] = np.sqrt(variance[p, t]) / slope[t]


def smooth(values: Array, variance: Array, valid: Mask, time: Array) -> tuple[Array, Array]:
    """Smooth curves (time, pixel) of white noise of a variance (time, pixel), at valid samples.

    Returns the curves and the variances that are left.
    """
    position = (time - time[0]) / max(time[-1] - time[0], 1e-300)
    rows = [np.ascontiguousarray(part.T) for part in (values, variance, valid)]
    halves = [1]
    while halves[-1] < time.size:
        halves.append(max(halves[-1] + 1, int(halves[-1] * _GROWTH)))
    result, left = np.empty((2, *rows[0].shape))
    _smooth(*rows, position, np.array(halves[:-1], dtype=np.intp), result, left)
    return result.T, left.T


@compiled
def _smooth(
    values: Array,
    variance: Array,
    valid: Mask,
    position: Array,
    halves: Whole,
    result: Array,
    left: Array,
) -> None:
    """As `smooth`, (pixel, time) in place."""
    frames, pad = position.size, halves[-1] if halves.size else 0
    sums = np.zeros((3, frames + 1 + 2 * pad))
    windows = np.empty((halves.size, 4, frames))
    # Arrays by themselves: of parts of one the compiler takes no vectors.
    estimate, lower, upper = np.empty(frames), np.empty(frames), np.empty(frames)
    going, widest = np.empty(frames), np.empty(frames, np.intp)
    for p in range(len(values)):
        if p == 0 or np.any(valid[p] != valid[p - 1]):
            _lay_windows(valid[p], position, halves, windows)
        level, noise = _sum_up(values[p], variance[p], valid[p], position, sums, pad)
        for t in range(frames):
            lower[t], upper[t], going[t] = -np.inf, np.inf, 1.0 if valid[p, t] else 0.0
            widest[t], left[p, t] = -1, variance[p, t]
        for k in range(halves.size):
            # One window narrower than the widest that agrees: its bias is small beside its noise.
            _estimate(windows[k], sums, pad - halves[k], pad + halves[k] + 1, estimate)
            if not _agree(estimate, windows[k, 3], AGREE * np.sqrt(noise), lower, upper, going):
                break
            if k > 0:
                _widen(going, windows[k - 1, 3], noise, k - 1, left[p], widest)
        for t in range(frames):
            k, total = widest[t], values[p, t] - level if valid[p, t] else np.nan
            if k >= 0:
                low, high, total = pad + t - halves[k], pad + t + halves[k] + 1, 0.0
                for power in range(3):
                    total += windows[k, power, t] * (sums[power, high] - sums[power, low])
            result[p, t] = level + total
            bent = min(_BENT * left[p, t], variance[p, t])
            left[p, t] = bent if left[p, t] < variance[p, t] else variance[p, t]


@compiled
def _estimate(window: Array, sums: Array, low: int, high: int, estimate: Array) -> None:
    """Values at the centres of windows of one half-width (time), in place."""
    frames = estimate.size
    kernels.fill(estimate, 0.0)
    for power in range(3):
        before, after = sums[power, low : low + frames], sums[power, high : high + frames]
        weight = window[power]
        for t in range(frames):
            estimate[t] += weight[t] * (after[t] - before[t])


@compiled
def _agree(
    estimate: Array, share: Array, deviation: float, lower: Array, upper: Array, going: Array
) -> bool:
    """Intersect confidence intervals (time), in place; whether a frame's have a part in common."""
    for t in range(estimate.size):
        margin = deviation * np.sqrt(share[t])
        least, most = estimate[t] - margin, estimate[t] + margin
        lower[t], upper[t] = max(lower[t], least), min(upper[t], most)
    remaining = 0.0
    for t in range(estimate.size):
        going[t] = going[t] if lower[t] <= upper[t] else 0.0
        remaining += going[t]
    return bool(remaining > 0.0)


@compiled
def _widen(
    going: Array, share: Array, noise: float, window: int, left: Array, widest: Whole
) -> None:
    """Take the windows of one half-width where they agree and have less noise (time), in place."""
    for t in range(going.size):
        better = going[t] > 0.0 and share[t] * noise <= left[t]
        widest[t] = window if better else widest[t]
        left[t] = share[t] * noise if better else left[t]


@compiled
def _sum_up(
    values: Array, variance: Array, valid: Mask, position: Array, sums: Array, pad: int
) -> tuple[float, float]:
    """Means of the valid values and variances of a pixel (time); what is summed up, in place.

    Of the samples before each place (3, time + 1), with a pad at both ends: values about the mean,
    times powers of their positions.
    """
    count, level, noise = 0.0, 0.0, 0.0
    for t in range(position.size):
        if valid[t]:
            count, level, noise = count + 1.0, level + values[t], noise + variance[t]
    level, noise = level / max(count, 1.0), noise / max(count, 1.0)
    for t in range(position.size):
        value = values[t] - level if valid[t] else 0.0
        for power in range(3):
            sums[power, pad + t + 1] = sums[power, pad + t] + value
            value *= position[t]
    for power in range(3):
        sums[power, pad + position.size :] = sums[power, pad + position.size]
    return level, noise


@compiled
def _lay_windows(valid: Mask, position: Array, halves: Whole, windows: Array) -> None:
    """Weights of parabolas, or lines, at the centres of windows (half-width, 4, time), in place.

    Of the sums of the values times powers of their positions, and the variance over the noise's;
    Zero and infinite where the samples do not fix it.
    """
    sums = np.zeros((position.size + 1, 5))
    for t in range(position.size):
        weight = 1.0 if valid[t] else 0.0
        for power in range(5):
            sums[t + 1, power] = sums[t, power] + weight
            weight *= position[t]
    for k in range(halves.size):
        for t in range(position.size):
            _centre(sums, position, t, halves[k], windows[k, :, t])


@compiled
def _centre(sums: Array, position: Array, place: int, half: int, window: Array) -> None:
    """Weights of one window, in place."""
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
    if not determinant > least:
        window[:3], window[3] = 0.0, np.inf
        return
    c0, c1, c2 = c0 / determinant, c1 / determinant * scale, c2 / determinant * scale**2
    window[0], window[1], window[2] = c0 - at * c1 + at**2 * c2, c1 - 2 * at * c2, c2
    window[3] = c0
