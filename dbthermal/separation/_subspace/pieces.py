"""Pieces of time for an object that changes rapidly: which pixels need them; see `division`."""

from collections.abc import Iterable
from functools import lru_cache
from typing import Final

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from dbthermal import _smooth as smooth
from dbthermal.separation._subspace import bars, kernels, reflection_ratio
from dbthermal.separation._tiles import Array, Mask, Whole

# Functions of a piece by which the division is chosen. One more is fitted: what the choice leaves
# of the curve is too small to be significant, but it would bias ratio and curve.
FUNCTIONS: Final = 4
# Cost of a function in units of the energy of noise: 1 for none, log N for an information criterion
# that would rather miss a change than find one too many.
COST: Final = 2.5
# Functions by whose cost pieces must be better than a smooth curve to be asked for.
_MARGIN: Final = 3.0
_COARSE: Final = 4  # levels of the pieces that are enough to see that pieces are better
# Halvings after which the pieces give the axes to start from.
STARTS: Final = (0, 2, 3, 4, 5)
ROUNDS: Final = 4
# Axes that are refined, of which the two best are kept: joined, they may change places.
AXES: Final = 4
# Costs that differ by less are the same but for rounding: of two divisions the finer is taken,
# whose pieces may be joined, and of two ways to join pieces the one with the longest pieces.
TIE: Final = 1e-6
APART: Final = 6.0  # standard deviations between two axes that are told apart

# Time in which a sudden step is so large a share of the object's change [s].
_WINDOW: Final = 1.0
_SHARE: Final = 2.0 / 3.0
# Parts of the capture; total variation of their means over its range, at which a signal returns.
_SPANS: Final = 24
_RETURNED: Final = 1.7

# Gain of the information criterion by the numbers of the frames, in units of a function's cost:
# in the median over many pixels, and what is added for one by chance.
_GAIN: Final = 0.5
_CHANCE: Final = 6.0
_SIGMAS: Final = 3.0
# Excess of the reduced chi-square over the times, at least so many times that over the numbers.
_EXCESS: Final = 5.0


@lru_cache(maxsize=16)
def blocks(frames: int) -> Whole:
    """Edges of the blocks of frames whose means tell whether pieces are asked for."""
    levels = min(int(np.log2(frames / FUNCTIONS)), _COARSE + 2)
    return np.round(np.linspace(0, frames, 2**levels + 1)).astype(np.intp)


@lru_cache(maxsize=64)
def _polynomials(places: bytes, pieces: int) -> Array:
    """Polynomials over the times of blocks in pieces of equal numbers: most tiles have the same."""
    return smooth.polynomial_basis(np.frombuffer(places).reshape(pieces, -1), FUNCTIONS)


def asked(sums: Array, time: Array, variance: Array, used: Whole) -> Mask:
    """Pixels whose smooth curve is described shorter in pieces."""
    # Sums (block, pixel) [K] of the null residual and of the curve taken from it.
    (residual, curve), edges = sums, blocks(len(time))
    levels = int(np.log2(len(residual)))
    length = np.diff(edges)[:, np.newaxis]
    # Means in units of their noise, about as many frames in each; with the curve and without.
    deviation = np.sqrt(np.where(variance > 0, variance, np.inf) / length.mean())
    places = np.add.reduceat(time, edges[:-1]) / length[:, 0]
    remainder = residual / (length * deviation)
    mean = remainder + curve / (length * deviation)
    least = halves = cost = np.full((2, 1), np.inf)
    for level in range(levels - 2, -1, -1):
        # Energy outside the functions of each piece of this level, and their cost.
        means = mean.reshape(1 << level, -1, mean.shape[1])
        terms = _polynomials(places.tobytes(), len(means)).mT @ means
        energy = np.einsum("itp,itp->ip", means, means) - np.einsum("ijp,ijp->ip", terms, terms)
        cost = energy + COST * FUNCTIONS
        halves = least[::2] + least[1::2] if level < levels - 2 else np.full_like(cost, np.inf)
        least = np.minimum(halves, cost)
    smoothly = (remainder**2).sum(axis=0) + COST * used
    return np.asarray((smoothly > least[0] + _MARGIN * COST) & (halves[0] < cost[0] + TIE))


def outside(
    signals: Array, noise: Array, divided: Iterable[tuple[Whole, smooth.Subspace]]
) -> tuple[Array, Array]:
    """Scatter (band, band, pixel) [1] outside the functions of parts, less noise, and freedom."""
    pixels, bands, frames = signals.shape
    scatter, freedom = np.empty((pixels, bands, bands)), np.empty(pixels)
    for places, of_part in divided:
        columns = np.ascontiguousarray(of_part.functions.T)
        _outside(columns, of_part.spans, signals, places, np.empty((bands, len(columns))), scatter)
        freedom[places] = frames - len(columns)
    # Whitened by the noise (band, pixel) [K].
    whitened = scatter.transpose(1, 2, 0) / (noise[:, np.newaxis] * noise)
    return whitened - freedom * np.eye(bands)[..., np.newaxis], freedom


@kernels.entered
def _outside(
    columns: Array, spans: Whole, signals: Array, places: Whole, terms: Array, scatter: Array
) -> None:
    """Products of signals (pixel, band, time) outside columns (column, time), in place."""
    for p in range(places.size):
        signal = signals[places[p]]
        for m in range(len(signal)):
            kernels.projected(columns, spans, len(columns), signal[m], terms[m])
            for n in range(m + 1):
                product = kernels.dot(signal[m], signal[n]) - kernels.dot(terms[m], terms[n])
                scatter[places[p], m, n] = scatter[places[p], n, m] = product


def plane(signals: Array, noise: Array) -> tuple[Array, Array]:
    """Combinations (2, time, pixel) of signals (band, time, pixel) with unit noise, and axes."""
    white = signals / noise[:, np.newaxis]
    if len(noise) == 2:
        return white, np.repeat(np.eye(2)[..., np.newaxis], signals.shape[2], axis=2)
    # Object and background change the bands along two lines: all but the noise lies in a plane.
    changes = white - white.mean(axis=1, keepdims=True)
    scatter = np.einsum("btp,ctp->pbc", changes, changes)
    axes = np.linalg.eigh(scatter)[1][..., -2:].transpose(2, 1, 0)
    return np.einsum("abp,btp->atp", axes, white), axes


def null_energy(white: Array, functions: smooth.Subspace, axis: Array) -> tuple[Array, Whole]:
    """Energy across the axis of rapid changes of a `plane`, and the number of functions used."""
    terms = np.einsum("tf,btp->bfp", functions.functions, white, optimize=True)
    pairs = ((0, 0), (0, 1), (1, 1))
    a, b, d = (
        np.einsum("tp,tp->p", white[i], white[j])
        - np.cumsum(terms[i] * terms[j], axis=0)[functions.steps :]
        for i, j in pairs
    )
    principal = 0.5 * (a + d) - np.sqrt(0.25 * (a - d) ** 2 + b * b)
    pooled = axis[1] ** 2 * a - 2.0 * axis[0] * axis[1] * b + axis[0] ** 2 * d
    # Across a known axis (2, pixel) where it is not NaN.
    energy = np.where(np.isnan(pooled), principal, pooled)
    frames, orders = white.shape[1], len(energy)
    # The functions that the lowest information criterion selects, and one more.
    criterion = frames * np.log(np.maximum(energy, reflection_ratio.TINY))
    criterion += np.arange(1, orders + 1)[:, np.newaxis] * np.log(frames)
    lowest = min(reflection_ratio.LOWEST_ORDER, orders - 1)
    order = lowest + np.argmin(criterion[lowest - 1 : -1], axis=0)
    return energy[order, np.arange(order.size)], order + 1 + functions.steps


def returning(signal: Array) -> Mask:
    """Pixels of a signal (time, pixel) that falls again by most of what it rose, or the reverse."""
    starts = [span[0] for span in np.array_split(np.arange(len(signal)), min(_SPANS, len(signal)))]
    means = np.add.reduceat(signal, starts, axis=0) / np.diff(starts, append=len(signal))[:, None]
    # Total variation over range: 1 for a change that stays, 2 for one that comes and goes.
    variation = np.abs(np.diff(means, axis=0)).sum(axis=0)
    return np.asarray(variation > _RETURNED * np.ptp(means, axis=0))


def sudden(curve: Array, std: Array, time: Array) -> Mask:
    """Pixels of which a curve (time, pixel) [K] steps from one frame to the next."""
    interval = np.diff(time)
    usual = float(np.median(interval))
    # A clock of bursts has a median far below its mean.
    frames = min(time.size, max(3, 2 * int(np.ceil(0.5 * _WINDOW / usual))))
    step = np.abs(np.diff(curve, axis=0))
    noise = np.sqrt(std[1:] ** 2 + std[:-1] ** 2)
    # By more than its deviations, and not over a pause.
    jumps = (step > bars.CHANGE * noise) & (interval < 2.0 * usual)[:, np.newaxis]
    result = np.any(jumps, axis=0)
    jumping, size = curve[:, result], (frames, 1)  # smooth pixels need no surroundings
    change_around = maximum_filter(jumping, size)[1:] - minimum_filter(jumping, size)[1:]
    # By more than most of its change within a second.
    result[result] = np.any(jumps[:, result] & (step[:, result] > _SHARE * change_around), axis=0)
    return np.asarray(result)


def check_clock(signals: Array, time: Array, noise: Array, segment: Whole | None) -> None:
    r"""Refuse times [s] over which slow changes are not smooth, but smooth in the frames' numbers.

    So are those at which frames arrived in bursts, and those of a clock that was set. Of signals
    (band, time, pixel) [K], quietest band first, with `noise` (band) [K], the energy E across the
    axis is compared, pixel by pixel, by :math:`N \ln(E_{time} / E_{number})`. Where it is as large
    in both, the object does not change smoothly, or its changes are too small to tell.
    """
    frames, white = time.size, plane(signals, noise[:, np.newaxis])[0]
    any_axis = np.full((2, white.shape[2]), np.nan)
    chi2 = []
    for clock in (time, np.arange(frames, dtype=np.float64)):
        functions = smooth.largest(clock, segment)
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            energy, number = null_energy(white, functions, any_axis)
            chi2.append(energy / (frames - number))
    good = (chi2[0] > 0) & (chi2[1] > 0)
    if not np.any(good):
        return
    over_times, over_numbers = (float(np.median(values[good])) for values in chi2)
    gain = frames * np.log(chi2[0][good] / chi2[1][good]) / np.log(frames)
    gained = np.median(gain) > _GAIN + _CHANCE / np.sqrt(gain.size)
    # A reduced chi-square of f degrees of freedom has the standard deviation sqrt(2 / f).
    chance = _SIGMAS * np.sqrt(2.0 / (frames * gain.size))
    if gained and over_times - 1.0 > _EXCESS * max(over_numbers - 1.0 - chance, 0.0):
        steps = np.diff(time)
        raise ValueError(
            f"Invalid 'time' of the capture, in steps of {steps.min():.3g} to {steps.max():.3g} s: "
            "slow changes are not smooth over these times (reduced chi-square "
            f"{over_times:.3f}), but over the numbers of the frames ({over_numbers:.3f}). Must be "
            "times of exposure, not of arrival, of a clock that is not set meanwhile."
        )
