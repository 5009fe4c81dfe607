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
from typing import Final

import numpy as np

from dbthermal import mixing
from dbthermal._compiled import compiled
from dbthermal.separation._tiles import Array, Mask, Tile

# Newton's steps, at most, and the length of the last one in a tile [K].
_STEPS, _CONVERGED = 5, 1e-5
# Step of a numerical slope of B [K].
_STEP: Final = 0.05
# Half-widths grow by this factor; deviations within which estimates agree.
_GROWTH: Final = 1.5
AGREE: Final = 1.5
# Variance that is stated over that of the noise: the rest is what a window bends [1].
_BENT: Final = 1.6
# Half-width from which the polynomial is a parabola, and a line below [frame].
_PARABOLA: Final = 4


@dataclass(frozen=True)
class Frames:
    """Object and background of every frame (time, pixel), with the parts of their variance."""

    signal: Array  # s [K]
    background: Array  # r [K]
    step: Array  # last step of both (2, time, pixel) [K]
    white: Array  # variance of s from noise, independent between frames [K^2]
    shared: Array  # variance of s from the fluctuation, and from a pixel's offset [K^2]
    background_variance: Array  # of r from noise and fluctuation [K^2]
    sensitivity: Array  # of s to the emissivities and the level (band + 1, time, pixel) [K]
    background_sensitivity: Array  # of r


def solve(
    tile: Tile, emissivity: Array, level: Array, fluctuation: Array, *, apart: bool = False
) -> Frames:
    """Solve every frame by Newton's method, at emissivities (band, pixel).

    The background has a level (pixel) [K] and a variance about it (pixel) [K^2]. Of cameras apart,
    what fluctuates in the other bands is another part of it: noise.
    """
    e = emissivity[:, np.newaxis]
    variance = np.array(tile.noise)[:, np.newaxis, np.newaxis] ** 2
    weak = 1.0 / fluctuation
    s = np.broadcast_to(level, tile.signals[0].shape)
    r = s
    own = np.ones_like(e)
    if apart:
        own = own * (np.arange(len(e)) == 0)[:, np.newaxis, np.newaxis]
        variance = variance + (1.0 - own) * (1.0 - e) ** 2 * fluctuation
    for _ in range(_STEPS):
        # Of cameras apart, the other bands see the level alone.
        seen = [r, *[np.broadcast_to(level, (1, level.size)) if apart else r] * (len(e) - 1)]
        (emitted, slope), (behind, rate) = _bands(tile, [s] * len(e)), _bands(tile, seen)
        by_s, by_r = e * slope, (1.0 - e) * rate * own
        ss, sr = (by_s**2 / variance).sum(axis=0), (by_s * by_r / variance).sum(axis=0)
        rr = (by_r**2 / variance).sum(axis=0) + weak
        determinant = ss * rr - sr**2
        gain = (by_s * rr - by_r * sr) / variance / determinant
        other = (by_r * ss - by_s * sr) / variance / determinant
        residual = tile.signals - mixing.mixed(e, emitted, behind)
        pull = weak * (r - level) / determinant  # towards the level
        step = np.stack([(gain * residual).sum(axis=0) + sr * pull, -ss * pull])
        step[1] += (other * residual).sum(axis=0)
        s, r = s + step[0], r + step[1]
        if not np.any(np.abs(step) > _CONVERGED):
            break
    white = (gain**2 * variance).sum(axis=0)
    shared = np.maximum(rr / determinant - white, 0.0)
    if tile.pattern is not None:
        shared = shared + ((gain.T * tile.pattern).T ** 2).sum(axis=0)
    # Of the model with e_m and the level; the background is the level and what is about it.
    changes = [*(emitted - behind), (1.0 - e) * rate]
    of_s, of_r = (
        np.stack(
            [*(-k * changes[m] for m, k in enumerate(part)), -(part * changes[-1]).sum(axis=0)]
        )
        for part in (gain, other)
    )
    of_r[-1] += 1.0
    return Frames(s, r, step, white, shared, ss / determinant, of_s, of_r)


def other_band(tile: Tile, m: int, signal: Array) -> Array:
    """B_m: signal of a band where the first band's blackbody signal is given."""
    return signal if m == 0 else np.asarray(tile.blackbody(m, tile.temperature(0, signal)))


def _bands(tile: Tile, signals: list[Array]) -> tuple[Array, Array]:
    """Signals of all bands (band, time, pixel) and their slopes, of first-band signals of each."""
    at, above = (
        np.stack(
            [
                np.broadcast_to(other_band(tile, m, part + step), tile.signals[0].shape)
                for m, part in enumerate(signals)
            ]
        )
        for step in (0.0, _STEP)
    )
    return at, (above - at) / _STEP


def through(sensitivity: Array, covariance: Array) -> Array:
    """Variance (time, pixel) through parameters, d^T C d."""
    total = np.einsum("itp,ijp,jtp->tp", sensitivity, covariance, sensitivity, optimize=True)
    return np.asarray(np.maximum(total, 0.0))


def smooth(values: Array, variance: Array, valid: Mask, time: Array) -> tuple[Array, Array]:
    """Smooth curves (time, pixel) of white noise of a variance (time, pixel), at valid samples.

    Returns the curves and the variances that are left.
    """
    position = (time - time[0]) / max(time[-1] - time[0], 1e-300)
    rows = [np.ascontiguousarray(one.T) for one in (values, variance, valid)]
    result, left = np.empty((2, *rows[0].shape))
    _smooth(*rows, position, result, left)
    return result.T, left.T


@compiled
def _smooth(
    values: Array, variance: Array, valid: Mask, position: Array, result: Array, left: Array
) -> None:
    """As `smooth`, (pixel, time) in place."""
    frames = position.size
    sums, going = np.zeros((frames + 1, 8)), np.empty(frames, np.bool_)
    lower, upper, narrower, narrower_left = np.empty((4, frames))
    for p in range(len(values)):
        level, noise = _sum_up(values[p], variance[p], valid[p], position, sums)
        for t in range(frames):
            result[p, t] = narrower[t] = values[p, t] - level if valid[p, t] else np.nan
            left[p, t] = narrower_left[t] = variance[p, t]
            lower[t], upper[t], going[t] = -np.inf, np.inf, valid[p, t]
        half = 1
        while half < frames and np.any(going):
            for t in range(frames):
                if not going[t]:
                    continue
                estimate, share = _centre(sums, position, t, half)
                margin = AGREE * np.sqrt(share * noise)
                lower[t] = np.fmax(lower[t], estimate - margin)
                upper[t] = np.fmin(upper[t], estimate + margin)
                going[t] = lower[t] <= upper[t]
                # One window narrower than the widest that agrees: its bias is small beside its
                # noise.
                if going[t] and narrower_left[t] <= left[p, t]:
                    result[p, t], left[p, t] = narrower[t], narrower_left[t]
                narrower[t], narrower_left[t] = estimate, share * noise
            half = max(half + 1, int(half * _GROWTH))
        for t in range(frames):
            result[p, t] += level
            better = left[p, t] < variance[p, t]
            left[p, t] = min(_BENT * left[p, t], variance[p, t]) if better else variance[p, t]


@compiled
def _sum_up(
    values: Array, variance: Array, valid: Mask, position: Array, sums: Array
) -> tuple[float, float]:
    """Means of the valid values and variances of a pixel (time); what is summed up, in place.

    Of the samples before each place (time + 1, 8): their number and sums of powers of their
    positions, and the same of their values about the mean.
    """
    count, level, noise = 0.0, 0.0, 0.0
    for t in range(position.size):
        if valid[t]:
            count, level, noise = count + 1.0, level + values[t], noise + variance[t]
    level, noise = level / max(count, 1.0), noise / max(count, 1.0)
    for t in range(position.size):
        weight = 1.0 if valid[t] else 0.0
        value = values[t] - level if valid[t] else 0.0
        for power in range(5):
            sums[t + 1, power] = sums[t, power] + weight
            weight *= position[t]
        for power in range(5, 8):
            sums[t + 1, power] = sums[t, power] + value
            value *= position[t]
    return level, noise


@compiled
def _centre(sums: Array, position: Array, place: int, half: int) -> tuple[float, float]:
    """Value of a parabola, or line, at the centre of a window, and its variance over the noise's.

    NaN and infinite where the samples do not fix it.
    """
    low, high = max(place - half, 0), min(place + half + 1, position.size)
    width = position[min(high, position.size - 1)] - position[low]
    scale, at = 1.0 / max(width, 1e-300), position[place]
    one, two = sums[low], sums[high]
    a0, a1, a2 = two[0] - one[0], two[1] - one[1], two[2] - one[2]
    b0, b1 = two[5] - one[5], two[6] - one[6]
    # Moments about the window's centre, by the binomial theorem, in units of its width.
    s1 = (a1 - at * a0) * scale
    s2 = (a2 - 2 * at * a1 + at**2 * a0) * scale**2
    z1 = (b1 - at * b0) * scale
    if half < _PARABOLA:
        determinant = a0 * s2 - s1**2
        fixed = determinant > 1e-6 * a0**2
        value, share = s2 * b0 - s1 * z1, s2
    else:
        a3, a4, b2 = two[3] - one[3], two[4] - one[4], two[7] - one[7]
        s3 = (a3 - 3 * at * a2 + 3 * at**2 * a1 - at**3 * a0) * scale**3
        s4 = (a4 - 4 * at * a3 + 6 * at**2 * a2 - 4 * at**3 * a1 + at**4 * a0) * scale**4
        z2 = (b2 - 2 * at * b1 + at**2 * b0) * scale**2
        # First row of the inverse of ((s0 s1 s2) (s1 s2 s3) (s2 s3 s4)).
        c0, c1, c2 = s2 * s4 - s3**2, s2 * s3 - s1 * s4, s1 * s3 - s2**2
        determinant = a0 * c0 + s1 * c1 + s2 * c2
        fixed = determinant > 1e-8 * a0**3
        value, share = c0 * b0 + c1 * z1 + c2 * z2, c0
    if not fixed:
        return np.nan, np.inf
    return value / determinant, share / determinant
