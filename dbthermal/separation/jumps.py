r"""Jumps of the object: found one pixel at a time, and put into the smooth subspace.

A sudden contact or a door that opens breaks the cue that the object is smooth. One such jump can
still be told from the background, which moves along another direction: with the step in the
subspace, what is left across the direction falls to the noise.
"""

from typing import Final

import numpy as np
import numpy.typing as npt

from dbthermal import smooth
from dbthermal.separation.separated import Array, Mask

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
    signals: Array, functions: smooth.Subspace, noise: Array, inside: Whole
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
    after = np.cumsum(left[:, ::-1], axis=1)[:, ::-1]
    held = np.cumsum(basis[::-1], axis=0)[::-1]
    energy = np.arange(frames, 0.0, -1.0) - np.sum(held**2, axis=1)
    scatter = np.einsum("btp,ctp->pbc", left, left)
    part = np.einsum("btp,ctp->tpbc", after[:, inside], after[:, inside])
    part /= energy[inside, np.newaxis, np.newaxis, np.newaxis]
    across = np.linalg.eigvalsh(scatter - part)[..., :-1].sum(axis=-1)
    best = np.argmin(across, axis=0)
    before = np.linalg.eigvalsh(scatter)[..., :-1].sum(axis=-1)
    lowest = np.maximum(across[best, np.arange(best.size)], np.finfo(np.float64).tiny)
    gain = frames * np.log(before / lowest) - 4.0 * np.log(frames)
    return inside[best], gain


def alone(signal: Array) -> Mask:
    """
    Whether one change from frame to frame is far larger than all others.

    A background comes and goes: its largest changes come in pairs at least.

    Parameters
    ----------
    signal : ndarray, shape (time, pixel)
        Signal of a band.

    Returns
    -------
    ndarray of bool, shape (pixel,)
        True for such a pixel.
    """
    change = np.abs(np.diff(signal.T, axis=1)).astype(np.float32)
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
