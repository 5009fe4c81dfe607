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
from dbthermal.separation._tiles import Array, Mask, Tile

_STEPS: Final = 5
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
        (emitted, slope), (behind, rate) = _bands(tile, s), _bands(tile, level + own * (r - level))
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


def _bands(tile: Tile, signal: Array) -> tuple[Array, Array]:
    """Signals of all bands (band, ...) and their slopes, of first-band signals ([band,] ...)."""
    each = np.broadcast_to(signal, (len(tile.noise), *tile.signals[0].shape))
    at, above = (
        np.stack([other_band(tile, m, part + step) for m, part in enumerate(each)])
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
    count = np.maximum(valid.sum(axis=0), 1)
    level = np.where(valid, values, 0.0).sum(axis=0) / count
    noise = np.where(valid, variance, 0.0).sum(axis=0) / count
    centred = np.where(valid, values - level, 0.0)
    position = (time - time[0]) / max(time[-1] - time[0], 1e-300)
    powers = position[:, np.newaxis] ** np.arange(5)
    # Sums of the samples before each place (time + 1, pixel).
    sums, values_sums = (
        [np.pad(np.cumsum(part * powers[:, [i]], axis=0), ((1, 0), (0, 0))) for i in range(orders)]
        for part, orders in ((valid, 5), (centred, 3))
    )
    result, left = centred, variance
    lower, upper = np.full_like(result, -np.inf), np.full_like(result, np.inf)
    going = valid
    narrower = (result, left)
    half = 1
    while half < len(values) and np.any(going):
        estimate, share = _fit(sums, values_sums, position, half)
        deviation = np.sqrt(share * noise)
        lower = np.fmax(lower, estimate - AGREE * deviation)
        upper = np.fmin(upper, estimate + AGREE * deviation)
        going = going & (lower <= upper)
        # One window narrower than the widest that agrees: its bias is small beside its noise.
        better = going & (narrower[1] <= left)
        result, left = (
            np.where(better, *one) for one in zip(narrower, (result, left), strict=True)
        )
        narrower = (estimate, share * noise)
        half = max(half + 1, int(half * _GROWTH))
    left = np.where(left < variance, np.minimum(_BENT * left, variance), variance)
    return np.where(valid, result + level, np.nan), left


def _fit(sums: list[Array], values: list[Array], position: Array, half: int) -> tuple[Array, Array]:
    """Value at the centre of each window, and its variance over the noise's; NaN if not fixed."""
    frames = len(position)
    place = np.arange(frames)
    low, high = np.maximum(place - half, 0), np.minimum(place + half + 1, frames)
    width = position[np.minimum(high, frames - 1)] - position[low]
    scale = (1.0 / np.maximum(width, 1e-300))[:, np.newaxis]
    at = position[:, np.newaxis]
    raw = [part[high] - part[low] for part in sums]
    data = [part[high] - part[low] for part in values]
    # Moments about the window's centre, by the binomial theorem, in units of its width.
    s0 = raw[0]
    s1 = (raw[1] - at * raw[0]) * scale
    s2 = (raw[2] - 2 * at * raw[1] + at**2 * raw[0]) * scale**2
    z0 = data[0]
    z1 = (data[1] - at * data[0]) * scale
    with np.errstate(all="ignore"):
        if half < _PARABOLA:
            determinant = s0 * s2 - s1**2
            value, share = (s2 * z0 - s1 * z1) / determinant, s2 / determinant
            fixed = determinant > 1e-6 * s0**2
        else:
            s3 = (raw[3] - 3 * at * raw[2] + 3 * at**2 * raw[1] - at**3 * raw[0]) * scale**3
            s4 = (
                raw[4] - 4 * at * raw[3] + 6 * at**2 * raw[2] - 4 * at**3 * raw[1] + at**4 * raw[0]
            ) * scale**4
            z2 = (data[2] - 2 * at * data[1] + at**2 * data[0]) * scale**2
            # First row of the inverse of ((s0 s1 s2) (s1 s2 s3) (s2 s3 s4)).
            c0, c1, c2 = s2 * s4 - s3**2, s2 * s3 - s1 * s4, s1 * s3 - s2**2
            determinant = s0 * c0 + s1 * c1 + s2 * c2
            value, share = (c0 * z0 + c1 * z1 + c2 * z2) / determinant, c0 / determinant
            fixed = determinant > 1e-8 * s0**3
    return np.where(fixed, value, np.nan), np.where(fixed, share, np.inf)
