"""Tests of what the model leaves: white noise, if the model holds."""

from typing import Final

import numpy as np

from dbthermal import _smooth as smooth
from dbthermal.separation._subspace.reflection_ratio import Direction
from dbthermal.separation._tiles import Array

MEMORY_LAGS: Final = 5
"""Frames over which `memory` looks for a correlation."""

# Deviations of noise from which a difference between frames is a change.
_CHANGE: Final = 5.0


def of_combination(signals: Array, functions: smooth.Subspace, found: Direction) -> Array:
    """
    What is left of the combination of bands without background, smooth part taken out.

    Parameters
    ----------
    signals : ndarray, shape (band, time, pixel)
        Signals.
    functions : Subspace
        Smooth functions.
    found : Direction
        From `direction.estimate`.

    Returns
    -------
    ndarray, shape (time, pixel)
        Residual [K], of variance `found.across` where the model holds.
    """
    left = np.einsum("bp,btp->tp", found.weights, signals)
    left -= functions.functions @ np.einsum("bp,bcp->cp", found.weights, found.coefficients)
    return np.asarray(left)


def memory(left: Array) -> Array:
    """
    Mean autocorrelation over a few frames.

    White noise leaves nothing but scatter. A change of the object that the smooth functions do not
    follow, or a background along another direction, leaves a correlation.

    Parameters
    ----------
    left : ndarray, shape (time, pixel)
        From `of_combination`.

    Returns
    -------
    ndarray, shape (pixel,)
        Mean over lags of 1 to `MEMORY_LAGS` frames, in standard deviations of white noise.
    """
    energy = np.einsum("tp,tp->p", left, left)
    lagged = np.zeros_like(energy)
    for lag in range(1, MEMORY_LAGS + 1):
        lagged += np.einsum("tp,tp->p", left[lag:], left[:-lag])
    mean = np.divide(lagged, MEMORY_LAGS * energy, out=np.zeros_like(energy), where=energy > 0)
    return np.asarray(mean * np.sqrt(MEMORY_LAGS * left.shape[0]))


def lateness(
    left: Array, first: Array, functions: smooth.Subspace, found: Direction, noise: float
) -> Array:
    r"""
    Whether the bands' rapid changes are not simultaneous.

    A band that is a frame late, or early, leaves the difference between two frames of what the
    others show. The residual r is therefore held against both differences of the first band, a
    matched filter,

    .. math:: \sum_t r(t) \, (z_1(t \pm 1) - z_1(t)) + n \, w_1 s_1^2

    where the last term takes out that the residual holds the noise of :math:`z_1(t)`. What comes
    now late, now early, as after an interpolation between frames, is seen in the energy of the
    residual in the frames at a change, over that of the noise.

    Parameters
    ----------
    left : ndarray, shape (time, pixel)
        From `of_combination`.
    first : ndarray, shape (time, pixel)
        Signal of the first band [K].
    functions : Subspace
        Smooth functions.
    found : Direction
        From `direction.estimate`.
    noise : float
        Noise of the first band [K].

    Returns
    -------
    ndarray, shape (pixel,)
        The largest score in magnitude, in standard deviations of white noise.
    """
    rapid = first - functions.functions @ found.coefficients[0]
    change = np.diff(rapid, axis=0)
    own = (left.shape[0] - found.order - functions.steps) * found.weights[0] * noise**2
    late = np.einsum("tp,tp->p", left[:-1], change) + own
    early = np.einsum("tp,tp->p", left[1:], change) - own
    strongest = np.maximum(np.abs(late), np.abs(early))
    variance = found.across * np.einsum("tp,tp->p", change, change)
    score = np.divide(
        strongest, np.sqrt(variance), out=np.zeros_like(strongest), where=variance > 0
    )
    return np.asarray(np.maximum(score, _excess(left, change, found.across, noise)))


def _excess(left: Array, change: Array, across: Array, noise: float) -> Array:
    """
    Energy beyond that of the noise in frames at a change, in standard deviations.

    A chi-square variable of few degrees of freedom has a long tail: its cube root is nearly normal
    (Wilson, Hilferty 1931, doi:10.1073/pnas.17.12.684).
    """
    steps = np.abs(change) > _CHANGE * np.sqrt(2.0) * noise
    at = np.zeros(left.shape, dtype=bool)
    at[1:] |= steps
    at[:-1] |= steps
    count = at.sum(axis=0)
    energy = np.einsum("tp,tp->p", left * at, left) / across
    mean = np.divide(energy, count, out=np.ones_like(energy), where=count > 0)
    spread = 2.0 / (9.0 * np.maximum(count, 1))
    return np.asarray((np.cbrt(mean) - (1.0 - spread)) / np.sqrt(spread))
