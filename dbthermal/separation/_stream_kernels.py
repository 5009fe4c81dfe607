"""Compiled arithmetic of a stream: frames into means, and both into temperatures, row by row.

Planes (y, x) are in single precision: the loops along a row take many pixels at once.
"""

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from dbthermal._compiled import compiled
from dbthermal.schema import LARGEST, Status
from dbthermal.separation._frames import bridge, newton, null_weights
from dbthermal.separation._inputs import Inputs
from dbthermal.separation._subspace import bars, kernels
from dbthermal.separation._subspace.kernels import Table
from dbthermal.separation._tiles import RANGE_SIGMAS, USELESS, Array
from dbthermal.separation._windows import intersect

Planes = npt.NDArray[np.float32]

# Latencies before and after a frame that its object is smoothed over, and the degree of the fit.
WINDOWS: Final = ((0.0, 0.0, 1), (0.5, 0.5, 1), (2.0, 1.0, 2), (4.0, 1.0, 2))
APART: Final = 2.0  # lengths of a mean, from which two are not neighbours
_NEWTON: Final = 3  # steps towards the object, at most
_TOLERANCE: Final = 1e-5  # length of the last step [K]
_ZERO, _ONE, _TWO = np.float32(0.0), np.float32(1.0), np.float32(2.0)
_NAN, _SIGMAS, _LARGEST = np.float32(np.nan), np.float32(RANGE_SIGMAS), np.float32(LARGEST)
_UNDEFINED: Final = int(
    Status.NO_BACKGROUND_MOTION
    | Status.GRAY
    | Status.INVALID_SAMPLES
    | Status.NONPHYSICAL_EMISSIVITY
)
_RANGE_FLAG: Final = np.uint32(Status.OUTSIDE_RESPONSE)
_AMBIGUOUS: Final = int(Status.CONSTANT_OBJECT | Status.ROLES_MAY_BE_SWAPPED)


class Camera(NamedTuple):
    """Responses of both bands and their signals, the quietest band first."""

    first: Table
    second: Table
    counts: tuple[float, float]  # of the reference temperature [count]
    slopes: tuple[float, float]  # [count/K]
    noise: tuple[float, float]  # of one frame [K]
    pattern: tuple[float, float]  # [K]
    lowest: float  # calibrated temperatures [K]
    highest: float


class Fit(NamedTuple):
    """Local polynomials over the means around a mean, from the narrowest to the widest."""

    weights: npt.NDArray[np.float64]  # of the means in value and slope (fit, 2, mean) [1, 1/s]
    ends: npt.NDArray[np.intp]  # first mean that has a weight, and the first after (fit, 2)
    variance: npt.NDArray[np.float64]  # of the value, over that of a frame (fit)
    time: npt.NDArray[np.float64]  # of the frames about the mean's time (frame) [s]


def camera(inputs: Inputs) -> tuple[Camera, Camera]:
    """Responses and noise of both bands in double and in single precision."""
    quiet, second = inputs.curves
    double = Camera(
        *(kernels.table(quiet, second), kernels.table(second, quiet)),
        (quiet.reference_counts, second.reference_counts),
        (quiet.reference_slope, second.reference_slope),
        (float(inputs.noise[0]), float(inputs.noise[1])),
        (float(inputs.pattern[0]), float(inputs.pattern[1])),
        *(quiet.lowest, quiet.highest),
    )
    return double, _single(double)


def _single(record: Any) -> Any:
    """Record of numbers and tuples of numbers in single precision."""
    if not isinstance(record, tuple):
        return np.float32(record) if isinstance(record, float) else record
    numbers = [_single(number) for number in record]
    return type(record)(*numbers) if hasattr(record, "_fields") else tuple(numbers)


def fit(means: Array, centre: int, latency: int, interval: float, frames: Array) -> Fit:
    """Local polynomials, from narrow to wide, over the means without a gap around a centre."""
    # Times [s] and segments of the means, an interval [s] apart; the latency is in means.
    times, segments = means
    gap = (np.diff(times) > (1.0 + APART) * interval) | (np.diff(segments) > 0)
    interval_number = np.concatenate([[0], np.cumsum(gap)])
    joined, steps = interval_number == interval_number[centre], np.arange(times.size) - centre
    weights = np.zeros((len(WINDOWS), 2, times.size))
    ends = np.empty((len(WINDOWS), 2), np.intp)
    for weight, end, (before, after, degree) in zip(weights, ends, WINDOWS, strict=True):
        selected = joined & (steps >= -max(1, int(before * latency)))
        selected &= steps <= max(1, int(after * latency))
        order = min(int(degree) + 1, int(np.count_nonzero(selected)))
        powers = (times[selected, np.newaxis] - times[centre]) ** np.arange(order)
        weight[:order, selected] = np.linalg.pinv(powers)[:2]
        end[:] = np.flatnonzero(selected)[[0, -1]] + (0, 1)
    variance = (weights[:, 0] ** 2).sum(axis=1) / frames.size
    return Fit(weights, ends, variance, frames - times[centre])


class Block(NamedTuple):
    """Frames of one mean, the maps of their pixels, and their temperatures."""

    frames: Planes  # (band, frame, y, x) [count]
    means: Planes  # around the frames (mean, band, y, x) [count]
    order: npt.NDArray[np.intp]  # places of the means, by time
    maps: Planes  # ratio, its variance, emissivities, elements of their covariance (map, y, x)
    gain: Planes  # noise of the second band over that of a frame (y, x)
    status: npt.NDArray[np.uint32]  # (y, x)
    films: Planes  # object, deviation, background, deviation (film, frame, y, x) [K]


ROWS: Final = (18, 5)
"""Numbers of scratch rows: terms of each pixel, see `_object`; films of a frame and their range."""


@compiled
def absorb(frames: Planes, mean: Planes, top: int, stop: int) -> None:
    """Means (band, y, x) of frames (band, frame, y, x) [count] in some rows, in place."""
    number = np.empty(frames.shape[3], np.float32)
    for y in range(top, stop):
        first, second = mean[0, y], mean[1, y]
        first[:], second[:], number[:] = 0.0, 0.0, 0.0
        for f in range(frames.shape[1]):
            _add(frames[0, f, y], frames[1, f, y], first, second, number)
        for x in range(number.size):
            # NaN if less than half of the samples are numbers in both bands.
            count = number[x] if 2 * number[x] >= frames.shape[1] else _NAN
            first[x] /= count
            second[x] /= count


@kernels.compiled
def _add(first: Any, second: Any, total: Any, second_total: Any, number: Any) -> None:
    """Add a frame's row to the sums, and to the number of samples that are numbers in both."""
    for x in range(first.size):
        valid = abs(first[x]) < _LARGEST and abs(second[x]) < _LARGEST
        total[x] += first[x] if valid else _ZERO
        second_total[x] += second[x] if valid else _ZERO
        number[x] += _ONE if valid else _ZERO


@kernels.allocating
def _fitted(
    means: Any, slopes: tuple[float, float], fit: Fit, w: Any, null: float, curve: Any
) -> float:
    """Value and slope (band, 2) [K] of the widest fit that agrees with all narrower, in place."""
    low, high, variance, trial = -np.inf, np.inf, np.nan, curve[2:]
    for j in range(fit.variance.size):
        start, stop = fit.ends[j]
        for band in range(2):
            for power in range(2):
                weights = fit.weights[j, power, start:stop]
                trial[band, power] = kernels.dot(weights, means[band, start:stop]) / slopes[band]
        # Null combination, whose variance is returned; see `_windows`.
        combined = w[0] * trial[0, 0] + w[1] * trial[1, 0]
        low, high = intersect(low, high, combined, null * fit.variance[j])
        if j > 0 and low > high:
            break
        curve[:2] = trial
        variance = null * fit.variance[j]
    return variance


@kernels.compiled
def _object(
    camera: Camera, curve: Any, maps: Any, noise: Any, variance: float, w: Any, line: Any, x: int
) -> None:
    """Object, and the terms of its frames' background, of a pixel (eq. 6, 9 and 10)."""
    e0, e1, table, second = maps[2], maps[3], camera.first, camera.second
    # Newton's steps to the temperature of the null combination.
    f0, f1 = w[0] * e0, w[1] * e1
    target = w[0] * curve[0, 0] + w[1] * curve[1, 0]
    start = kernels.polynomial(second.inverse, (target - second.middle_signal) / second.half_signal)
    mixed = kernels.mixed(f0, table.signal, f1, second.signal)
    place, scale = (start - table.middle) / table.half, 1.0 / table.half
    for _ in range(_NEWTON + 1):
        place, lack, slope = newton(mixed, target, place)
        if abs(lack) < _TOLERANCE * scale * abs(slope):
            break
    u, du = kernels.with_slope(table.signal, place)
    v, dv = kernels.with_slope(second.signal, place)
    du, dv, steepness = du * scale, dv * scale, (f0 * du + f1 * dv) * scale
    # Its variance, by implicit differentiation of eq. 6, as in `_subspace.bars`.
    sensitivity = (v + e0 * (u - v) - curve[0, 0]) / steepness
    epsilon = w[1] ** 2 * maps[1]
    through = sensitivity**2 * epsilon / (1.0 - bars.NORMAL95**2 * epsilon) ** 2
    smooth = variance / steepness**2
    pattern0, pattern1 = camera.pattern[0] * w[0] / steepness, camera.pattern[1] * w[1] / steepness
    std = np.sqrt(through + smooth + pattern0**2 + pattern1**2)
    useful = abs(place) <= 1.0 and std < USELESS
    line[0][x] = table.middle + table.half * place if useful else np.nan
    line[1][x] = (w[0] * curve[0, 1] + w[1] * curve[1, 1]) / steepness
    line[2][x] = std if useful else np.nan
    # Terms of the background (eq. 9) and its variance, by the emissivities and their covariance:
    # d u(y) = sum_m p_m (y - x) / (1 - e_m) de_m - r dx, dx = sum_m a_m de_m.
    scale = 1.0 / ((e1 - e0) * steepness)
    a0 = ((1.0 - e1) * u - curve[1, 0] + e1 * v) * scale
    a1 = (curve[0, 0] - e0 * u - (1.0 - e0) * v) * scale
    weight0, weight1 = ((1.0 - e0) / noise[0]) ** 2, ((1.0 - e1) / noise[1]) ** 2
    total = weight0 + weight1
    direct0, direct1 = weight0 / total / (1.0 - e0), weight1 / total / (1.0 - e1)
    share = direct0 * e0 + direct1 * e1
    slope = direct0 * e0 * du + direct1 * e1 * dv
    offset0 = camera.pattern[0] * direct0 - slope * pattern0
    offset1 = camera.pattern[1] * direct1 - slope * pattern1
    physical = 0 < e0 < 1 and 0 < e1 < 1
    line[3][x] = 1.0 / (1.0 - e0) if physical else np.nan
    line[4][x] = 1.0 / (1.0 - e1) if physical else np.nan
    line[5][x], line[6][x] = e0 * u, e0 * du * line[1][x]
    line[7][x], line[8][x] = e1 * v, e1 * dv * line[1][x]
    line[9][x], line[10][x] = share * a0, share * a1
    line[11][x], line[12][x] = 1.0 / total, share**2 * smooth + offset0**2 + offset1**2
    line[13][x], line[14][x] = weight0 / total, weight1 / total
    for i in range(3):
        line[15 + i][x] = maps[4 + i]


@kernels.compiled
def _frame(first: Any, second: Any, line: Any, camera: Camera, dt: float, out: Any) -> None:
    """Temperatures of a row of one frame, their deviations, and if they are in range, in place."""
    table, second_table, scale = camera.first, camera.second, _ONE / camera.first.half
    for x in range(first.size):
        z0 = (first[x] - camera.counts[0]) / camera.slopes[0]
        z1 = (second[x] - camera.counts[1]) / camera.slopes[1]
        valid = _ZERO * (z0 + z1)  # NaN where a sample is missing
        # Reflected signals, and one Gauss-Newton step of eq. 9 from that of their mean.
        share0, share1 = line[13][x], line[14][x]
        r0 = line[3][x] * (z0 - line[5][x] - line[6][x] * dt)
        r1 = line[4][x] * (z1 - line[7][x] - line[8][x] * dt)
        guess = (share0 * r0 + share1 * r1 - table.middle_signal) / table.half_signal
        t = kernels.polynomial(table.inverse, guess)
        p = (t - table.middle) * scale
        du, dv = kernels.polynomial(table.slope, p), kernels.polynomial(second_table.slope, p)
        step = share0 * du * (r0 - kernels.polynomial(table.signal, p))
        step += share1 * dv * (r1 - kernels.polynomial(second_table.signal, p))
        curvature = share0 * du * du + share1 * dv * dv
        x_now = line[0][x] + line[1][x] * dt + valid
        y_now = t + step / curvature
        contrast = y_now - x_now
        c0 = share0 * line[3][x] * contrast - line[9][x]
        c1 = share1 * line[4][x] * contrast - line[10][x]
        variance = line[11][x] / curvature + line[12][x]
        variance += c0 * (c0 * line[15][x] + _TWO * c1 * line[16][x]) + c1 * c1 * line[17][x]
        y_std = np.sqrt(variance) + (_ZERO if abs(p) <= _ONE else _NAN)
        out[0][x], out[1][x] = x_now, line[2][x] + valid
        out[2][x], out[3][x] = y_now + _ZERO * y_std, y_std
        wide, y_wide = _SIGMAS * line[2][x], _SIGMAS * y_std
        high = (x_now > camera.highest + wide) | (y_now > camera.highest + y_wide)
        low = (x_now < camera.lowest - wide) | (y_now < camera.lowest - y_wide)
        out[4][x] = _ONE if high | low else out[4][x]


@kernels.compiled
def _terms(block: Block, fit: Fit, camera: Camera, y: int, x: int, work: Any) -> None:
    """Terms of one pixel of a row, NaN where the object is not defined; see `_object`."""
    (line, means, curve, maps, pairs), status = work, block.status[y, x]
    size, (ratio, noise, w), missing = block.order.size, pairs, 0
    defined = (status & _UNDEFINED) == 0 and (status & _AMBIGUOUS) != _AMBIGUOUS
    # Means by time, NaN in both bands where either is missing.
    for i in range(size if defined else 0):
        first, second = block.means[block.order[i], 0, y, x], block.means[block.order[i], 1, y, x]
        lost = np.nan if np.isnan(first) or np.isnan(second) else 0.0
        means[0, i], means[1, i] = first - camera.counts[0] + lost, second - camera.counts[1] + lost
        means[2, i], means[3, i], missing = 0.0, i, missing + (1 if np.isnan(lost) else 0)
    if not defined or 3 * missing > size:
        for row in line:
            row[x] = np.nan
        return
    for band in range(2 if missing > 0 else 0):  # a line between the same means in both
        bridge(means[band], means[2], means[3])
    for i in range(7):
        maps[i] = block.maps[i, y, x]
    ratio[1], noise[0], noise[1] = maps[0], camera.noise[0], camera.noise[1] * block.gain[y, x]
    if np.isnan(maps[2]):  # of a constant object, as in `_subspace.pixel`
        largest = max(1.0, ratio[1])
        maps[2] = 0.5 * (1.0 + (largest - 1.0) / largest)
        maps[3] = 1.0 - ratio[1] * (1.0 - maps[2])
    null = null_weights(ratio, noise, w)
    variance = _fitted(means, camera.slopes, fit, w, null, curve)
    _object(camera, curve, maps, noise, variance, w, line, x)


@compiled
def emit(
    block: Block, fit: Fit, camera: Camera, single: Camera, scratch: Any, top: int, stop: int
) -> None:
    """Films of the frames of one mean, and in the status the calibrated range, in place."""
    # The scratch rows are separate arrays, so that the compiler sees that none overlap.
    line, out = scratch
    pairs = np.ones(2), np.empty(2), np.empty(2)
    work = line, np.empty((4, block.order.size)), np.empty((4, 2)), np.empty(7), pairs
    for y in range(top, stop):
        for x in range(block.films.shape[3]):
            _terms(block, fit, camera, y, x, work)
        out[4][:] = 0.0
        for f in range(block.films.shape[1]):
            first, second, time = block.frames[0, f, y], block.frames[1, f, y], fit.time[f]
            _frame(first, second, line, single, np.float32(time), out)
            for film in range(4):
                block.films[film, f, y] = out[film]
        for x in range(block.films.shape[3]):
            block.status[y, x] |= _RANGE_FLAG if out[4][x] > 0.0 else np.uint32(0)
