r"""Frames of a pixel, compiled: null combination, object and background, and gaps between them.

Signals :math:`s = u_1(x), r = u_1(y)` of the first band, with the other responses as functions
:math:`B_m = u_m \circ u_1^{-1}` of them, give two equations or more in two unknowns,

.. math:: z_m = e_m B_m(s) + (1 - e_m) B_m(r) \qquad (1)

weighted by their noise; of the background a level may be known and how much it fluctuates. No prior
in time is set.
"""

from typing import NamedTuple

import numpy as np

from dbthermal import mixing
from dbthermal._compiled import compiled
from dbthermal.separation._subspace import kernels
from dbthermal.separation._tiles import Array, Mask, Tile

# Newton's steps, at most, and the length of the last one in a pixel, which leaves its square over
# a thousand kelvin [K].
_STEPS, _CONVERGED = 8, 1e-2


@kernels.compiled
def null_weights(ratio: Array, noise: Array, weights: Array) -> float:
    """Weights w of eq. 5, in place, and their noise variance; as `reflection_ratio` has them."""
    product, length, square = 0.0, 0.0, 0.0
    for m in range(noise.size):
        product += ratio[m] / noise[m] ** 2
        length += (ratio[m] / noise[m]) ** 2
    for m in range(noise.size):
        weights[m] = (1.0 - product / length * ratio[m]) / noise[m]
        square += weights[m] ** 2
    for m in range(noise.size):
        weights[m] /= square * noise[m]
    return 1.0 / square


@kernels.compiled
def newton(polynomial: tuple[float, ...], target: float, x: float) -> tuple[float, float, float]:
    """Newton's step to where a polynomial has a value; what lacked, and the slope, before it."""
    value, slope = kernels.with_slope(polynomial, x)
    return x + (target - value) / slope, target - value, slope


@kernels.compiled
def bridge(values: Array, variance: Array, time: Array) -> int:
    """Fill the NaN of a curve by lines, its ends by the nearest frame; return their number."""
    last, rate, missing, start = -1, 0.0, 0, -1
    for t in range(time.size):
        if np.isnan(values[t]):
            missing += 1
            continue
        if last >= 0:
            rate += (values[t] - values[last]) ** 2 / (time[t] - time[last])
        last = t
    # The variance grows as that of a random walk of the curve's own steps.
    rate /= max(time.size - missing - 1, 1)
    for stop in range(time.size + 1 if last >= 0 else 0):
        if stop < time.size and np.isnan(values[stop]):
            continue
        before, after = stop if start < 0 else start, start if stop == time.size else stop
        for t in range(start + 1, stop):
            share, walk = 0.0, abs(time[t] - time[before])
            if before != after:
                share = walk / (time[after] - time[before])
                walk *= 1.0 - share
            values[t] = values[before] + share * (values[after] - values[before])
            variance[t] = variance[before] + share * (variance[after] - variance[before])
            variance[t] += rate * walk
        start = stop
    return missing


class Frames(NamedTuple):
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
    pattern = np.square(tile.pattern or np.zeros(bands))
    share = np.ones(bands) if not apart else np.eye(bands)[0]
    unseen = np.outer(fluctuation, 1.0 - share) * np.square(1.0 - emissivity.T)
    result, spare = np.empty((5, pixels, frames)), np.empty((9, frames))
    _solve(
        response_tables(tile),
        np.ascontiguousarray(tile.signals.transpose(2, 0, 1)),
        np.stack([emissivity.T, np.square(tile.noise) + unseen], axis=1),
        np.stack([level, fluctuation], axis=-1),
        np.ascontiguousarray(covariance.transpose(2, 0, 1)),
        np.stack([share, pattern]),
        _Work(*np.empty((4, bands, frames)), *np.empty((2, bands + 1, frames)), *spare),
        result,
    )
    return Frames(*result.transpose(0, 2, 1))


def response_tables(tile: Tile) -> tuple[kernels.Table, ...]:
    """Responses of the bands as polynomials of one range."""
    return tuple(kernels.table(curve, *tile.curves) for curve in tile.curves)


@kernels.compiled
def other_band(
    tables: tuple[kernels.Table, kernels.Table],
    signal: Array,
    value: Array,
    slope: Array,
    spare: Array,
) -> None:
    """B_m and its slope of a band at signals of the first band's, in place; two rows are spare."""
    (first, second), place, rate = tables, spare[0], spare[1]
    kernels.temperature(first, signal, place)
    kernels.blackbody(first, place, value, rate)
    for t in range(signal.size):  # Newton's step
        place[t] += (signal[t] - value[t]) / rate[t]
    kernels.blackbody(second, place, value, slope)
    for t in range(signal.size):
        slope[t] /= rate[t]


class _Work(NamedTuple):
    """Quantities of one pixel (time), and of its bands."""

    emitted: Array  # B_m(s) [K], and its slope with the temperature (band, time)
    slope: Array
    behind: Array  # B_m(r) [K], and its slope
    rate: Array
    of_s: Array  # sensitivities to the emissivities and the level (band + 1, time) [K]
    of_r: Array
    object: Array  # temperatures x, y and that of the level [K]
    background: Array
    room: Array
    ss: Array  # normal equations, or their inverse
    sr: Array
    rr: Array
    to_s: Array  # right sides, or the gains of a band
    to_r: Array
    variance: Array


@compiled
def _solve(
    tables: tuple[kernels.Table, ...],
    signals: Array,
    parameters: Array,
    levels: Array,
    covariance: Array,
    shares: Array,
    work: _Work,
    result: Array,
) -> None:
    """As `solve`, in place (5, pixel, time).

    Of each pixel its signals (band, time), emissivities and variances of the bands (2, band), level
    of the background and variance about it (2), and their covariance; of each band the share of the
    fluctuation that it sees, and the variance of a pixel's offset (2, band).
    """
    for p in range(len(signals)):
        room = kernels.inverse(tables[0], levels[p, 0])
        kernels.temperature(tables[0], signals[p, 0], work.object)
        kernels.fill(work.background, room)
        kernels.fill(work.room, room)
        for t in range(work.object.size):
            work.object[t] = room if np.isnan(work.object[t]) else work.object[t]
        for _ in range(_STEPS):
            for m in range(shares.shape[1]):
                source = work.background if shares[0, m] > 0 else work.room
                kernels.blackbody(tables[m], work.object, work.emitted[m], work.slope[m])
                kernels.blackbody(tables[m], source, work.behind[m], work.rate[m])
            if _step(signals[p], parameters[p], shares[0], levels[p], work, result[:2, p]):
                break
        at_room = kernels.exact(tables[0], room)[1]
        _propagate(parameters[p], shares, at_room, covariance[p], work, result[2:, p])


@kernels.compiled
def _step(
    signal: Array, parameters: Array, share: Array, level: Array, work: _Work, result: Array
) -> bool:
    """Newton's step of a pixel, in place; whether it was a short one in all frames."""
    ss, sr, rr, to_s, to_r = work.ss, work.sr, work.rr, work.to_s, work.to_r
    for t in range(ss.size):
        ss[t], sr[t], rr[t] = 0.0, 0.0, 1.0 / level[1]
        to_s[t], to_r[t] = 0.0, (level[0] - work.behind[0, t]) / level[1]
    for m in range(share.size):
        e, weight = parameters[0, m], 1.0 / parameters[1, m]
        dark = (1.0 - parameters[0, m]) * share[m]
        for t in range(ss.size):
            by_s = e * work.slope[m, t] / work.slope[0, t]
            by_r = dark * work.rate[m, t] / work.rate[0, t]
            error = signal[m, t] - work.behind[m, t] - e * (work.emitted[m, t] - work.behind[m, t])
            ss[t] += weight * by_s**2
            sr[t] += weight * by_s * by_r
            rr[t] += weight * by_r**2
            to_s[t] += weight * by_s * error
            to_r[t] += weight * by_r * error
    failures = 0.0
    for t in range(ss.size):
        inverse = 1.0 / (ss[t] * rr[t] - sr[t] ** 2)
        step = (rr[t] * to_s[t] - sr[t] * to_r[t]) * inverse
        change = (ss[t] * to_r[t] - sr[t] * to_s[t]) * inverse
        ss[t], sr[t], rr[t] = ss[t] * inverse, sr[t] * inverse, rr[t] * inverse
        work.object[t] += step / work.slope[0, t]
        work.background[t] += change / work.rate[0, t]
        solved = abs(step) + abs(change) <= _CONVERGED
        result[0, t] = work.emitted[0, t] + step if solved else np.nan
        result[1, t] = work.behind[0, t] + change if solved else np.nan
        failures += 0.0 if solved else 1.0
    return bool(failures == 0.0)


@kernels.compiled
def _propagate(
    parameters: Array, shares: Array, at_room: float, covariance: Array, work: _Work, result: Array
) -> None:
    """Variances of a pixel, see `Frames` (3, time), in place."""
    ss, sr, rr, to_s, to_r = work.ss, work.sr, work.rr, work.to_s, work.to_r
    white, offset, bands = result[0], work.variance, shares.shape[1]
    for t in range(ss.size):
        white[t], offset[t] = 0.0, 0.0
        work.of_s[bands, t], work.of_r[bands, t] = 0.0, 1.0
    for m in range(bands):
        e, variance, share = parameters[0, m], parameters[1, m], shares[0, m]
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


@kernels.compiled
def _add_through(sensitivity: Array, covariance: Array, total: Array, result: Array) -> None:
    """Add the variance through parameters, d^T C d, (time) in place."""
    kernels.fill(total, 0.0)
    for i, j in np.ndindex(covariance.shape):
        for t in range(total.size):
            total[t] += sensitivity[i, t] * covariance[i, j] * sensitivity[j, t]
    for t in range(total.size):
        result[t] += max(total[t], 0.0)


def background(
    tile: Tile,
    measured: Array,
    valid: Mask,
    emissivity: Array,
    level: Array,
    fluctuation: Array,
    covariance: Array,
) -> tuple[Array, Array]:
    r"""Background behind a measured object (time, pixel) [K], and its variance [K^2].

    What the object's temperatures and deviations (2, time, pixel) [K] leave of the first band,

    .. math:: r_0 = \frac{z_1 - e_1 s}{1 - e_1}, \quad
              r = c + g (\bar r_0 - c) + k (r_0 - \bar r_0)

    The object's error is common to all frames: it makes the mean over time uncertain, which leans
    on the level c, and not the change about it. NaN where no object is; else as in `solve`.
    """
    curve, e, dark = tile.curves[0], emissivity[0], 1.0 - emissivity[0]
    signal = curve.signal(measured[0]) - tile.reference
    reflection = np.where(valid, mixing.background(e, tile.signals[0], signal), np.nan)
    mask = np.isfinite(reflection)
    number = np.maximum(mask.sum(axis=0), 1)

    def mean(values: Array) -> Array:
        return np.asarray(np.where(mask, values, 0.0).sum(axis=0) / number)

    noise = (tile.noise[0] / dark) ** 2
    common = mean((e * measured[1] * curve.slope(measured[0]) / dark) ** 2) + noise / number
    by_change, by_level = fluctuation / (fluctuation + noise), fluctuation / (fluctuation + common)
    middle, off = mean(reflection), (reflection - signal) / dark
    value = level + by_level * (middle - level) + by_change * (reflection - middle)
    # dr_0 = (r_0 - s) / (1 - e_1) de_1
    slope = np.zeros((len(covariance), *reflection.shape))
    slope[0] = by_level * mean(off) + by_change * (off - mean(off))
    slope[-1] = 1.0 - by_level
    through = np.einsum("itp,ijp,jtp->tp", slope, covariance, slope, optimize=True)
    return value, by_level * common + by_change * noise + np.maximum(through, 0.0)


def temperatures(tile: Tile, signal: Array, variance: Array) -> tuple[Array, Array]:
    """Temperatures (time, pixel) [K] of first-band signals, and their standard deviations."""
    result = np.empty((2, *signal.T.shape))
    curves = (np.ascontiguousarray(curve.T) for curve in (signal, variance))
    _temperatures(response_tables(tile)[0], *curves, result)
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
