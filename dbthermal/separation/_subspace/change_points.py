r"""Jumps of the object: found one pixel at a time, and put into the smooth subspace.

A sudden contact or a door that opens breaks the cue that the object is smooth. One such jump can
still be told from the background, which moves along another direction: with the step in the
subspace, what is left across the direction falls to the noise.
"""

from typing import Final

import numpy as np
import numpy.typing as npt

from dbthermal import _smooth as smooth
from dbthermal.separation._tiles import Array, Mask

Whole = npt.NDArray[np.intp]

# Smooth functions beside which a jump is sought.
_ORDER: Final = 7
AROUND: Final = 1.0
"""Time before and after a jump that is left out [s]: what is not sudden about it."""

# A change from frame to frame stands alone if it is so many times the third largest.
_ALONE: Final = 3.0
# Fewest frames before and after a jump.
_MARGIN: Final = 24


def find(
    signals: Array, functions: smooth.Subspace, noise: Array, inside: Whole, ramp: Whole
) -> tuple[Whole, Array]:
    r"""
    Frame of the step that lowers what is across the direction most.

    With the smooth functions projected out, a step at frame t takes from the whitened scatter
    :math:`S` the part :math:`g g^T / n`, with g the sum of the residuals from t on, and n the
    energy of the step orthogonal to the functions.

    Parameters
    ----------
    signals : ndarray, shape (band, time, pixel)
        Signals [K].
    functions : Subspace
        Smooth functions.
    noise : ndarray, shape (band,)
        Noise of the bands [K].
    inside : ndarray of int
        Frames that may be the first after the step, from `candidates`; one or more.
    ramp : ndarray of int
        Frames beside it over which the same change may be spread evenly.

    Returns
    -------
    tuple of ndarray, shape (pixel,)
        First frame after the step, and by how much the information criterion falls: positive
        where a step explains more than chance.
    """
    frames = signals.shape[1]
    basis = functions.functions[:, : functions.steps + _ORDER]
    left = signals / noise[:, np.newaxis, np.newaxis]
    left = left - np.einsum("tc,bcp->btp", basis, np.einsum("tc,btp->bcp", basis, left))
    # Inner products of a step at each frame with the residual, with the functions and with itself.
    after = np.cumsum(left[:, ::-1], axis=1)[:, ::-1]
    held = np.cumsum(basis[::-1], axis=0)[::-1]
    own = np.arange(frames, 0.0, -1.0)
    scatter = np.einsum("btp,ctp->pbc", left, left)
    before = np.linalg.eigvalsh(scatter)[..., :-1].sum(axis=-1)
    first, lowest = np.zeros(before.size, dtype=np.intp), np.full(before.size, np.inf)
    for offsets in (np.zeros(1, dtype=np.intp), ramp):
        places = inside[:, np.newaxis] + offsets
        energy = own[places].mean(axis=1) - np.abs(offsets[:, np.newaxis] - offsets).mean() / 2.0
        energy -= np.sum(held[places].mean(axis=1) ** 2, axis=1)
        # A running sum: side by side, the offsets of a fast film would need a gigabyte.
        mean = np.zeros((len(after), inside.size, after.shape[2]))
        for offset in offsets:
            mean += after[:, inside + offset] / offsets.size
        part = np.einsum("btp,ctp->tpbc", mean, mean) / energy[:, None, None, None]
        across = np.linalg.eigvalsh(scatter - part)[..., :-1].sum(axis=-1)
        best = np.argmin(across, axis=0)
        found = across[best, np.arange(best.size)]
        first = np.where(found < lowest, inside[best], first)
        lowest = np.minimum(found, lowest)
    gain = frames * np.log(before / np.maximum(lowest, np.finfo(np.float64).tiny))
    return first, gain - 4.0 * np.log(frames)


def alone(signal: Array, functions: smooth.Subspace, ramp: Whole) -> Mask:
    """
    Whether one change, from frame to frame or in about a second, is far larger than all others.

    A background comes and goes: its largest changes come in pairs at least.

    Parameters
    ----------
    signal : ndarray, shape (time, pixel)
        Signal of a band.
    functions : Subspace
        Smooth functions, taken out first.
    ramp : ndarray of int
        From `spread`.

    Returns
    -------
    ndarray of bool, shape (pixel,)
        True for such a pixel.
    """
    basis = functions.functions[:, : functions.steps + _ORDER]
    left = signal - basis @ (basis.T @ signal)
    blocks = left.shape[0] // ramp.size
    slow = left[: blocks * ramp.size].reshape(blocks, ramp.size, -1).mean(axis=1)
    return _outstanding(left) | _outstanding(slow)


def _outstanding(signal: Array) -> Mask:
    """Where the largest change is several times the third largest; false for few samples."""
    change = np.abs(np.diff(signal.T, axis=1)).astype(np.float32)
    if change.shape[1] < 3:
        return np.zeros(change.shape[0], dtype=bool)
    largest = np.partition(change, -3, axis=1)[:, -3:]
    return np.asarray(largest.max(axis=1) > _ALONE * largest[:, 0])


def candidates(time: Array) -> Whole:
    """
    Frames that may be the first after a jump.

    Parameters
    ----------
    time : ndarray, shape (time,)
        Times [s].

    Returns
    -------
    ndarray of int
        Those with enough frames before and after, beside those that are left out.
    """
    between = 0.5 * (time[1:] + time[:-1])
    before = np.searchsorted(time, between - AROUND)
    after = np.searchsorted(time, between + AROUND, side="right")
    good = np.minimum(before, time.size - after) >= _MARGIN
    return np.asarray(1 + np.flatnonzero(good))


def spread(time: Array) -> Whole:
    """
    Frames, relative to its middle, of a jump that takes as long as is left out on one side.

    Parameters
    ----------
    time : ndarray, shape (time,)
        Times [s].

    Returns
    -------
    ndarray of int
        From minus a half to a half of that time.
    """
    half = int(0.5 * AROUND / np.median(np.diff(time)))
    return np.arange(-half, half + 1)


def outside(time: Array, jump: int, segment: Whole | None = None) -> Mask:
    """
    Frames that are not close to a jump.

    Parameters
    ----------
    time : ndarray, shape (time,)
        Times [s].
    jump : int
        First frame after it.
    segment : ndarray of int, shape (time,), optional
        Number of shutter events before each frame.

    Returns
    -------
    ndarray of bool, shape (time,)
        True for the frames to use: those before and after; or, where a shutter event as close
        hides how far it jumped, the more numerous of the two.
    """
    between = 0.5 * (time[jump - 1] + time[jump])
    kept = np.abs(time - between) > AROUND
    before, after = kept & (time < between), kept & (time > between)
    if segment is not None and segment[before].max() != segment[after].min():
        return np.asarray(before if before.sum() >= after.sum() else after)
    return np.asarray(kept)
