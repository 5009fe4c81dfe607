"""Delay of the second camera, told apart from the shift of what it sees mirrored."""

from typing import Final

import numpy as np
from scipy.ndimage import gaussian_filter

from dbthermal._arrays import Array
from dbthermal.alignment import _matching as matching
from dbthermal.alignment._matching import Movies
from dbthermal.alignment._resampling import interpolation

_ROWS: Final = 32  # that are resampled at a time
_TAPS: Final = 6  # neighbours a side, of which movies are interpolated
_RIDGE: Final = 1e-4  # of the largest information on a shift, where there is none


def delay(movies: Movies, shift: Array, times: Array) -> float:
    r"""
    Time by which the others show what the first movie shows at a shift [s].

    The shift is (2, y, x) [pixel], the frames are those of some times [s]. What moves one way only
    is shifted or late. One Newton step of both, the shift free in each window: with the slopes g of
    the moved movie :math:`h`, its change :math:`\dot h`, the residual r of the others over their
    ratio to it, and sums over time and a window,

    .. math:: \delta = \sum (\dot h r - c^T A^{-1} \, g r) / \sum (\dot h^2 - c^T A^{-1} c),
              \quad A = g g^T, \; c = g \dot h
    """
    places, (_, width, count) = np.indices(movies.shape) + shift, movies.first.shape
    steps = 0.5 * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])[..., np.newaxis, np.newaxis]
    weights = [interpolation(places + step, _TAPS) for step in steps]
    used = matching.inside(places, movies.valid) & movies.valid
    for part in weights:  # none near the border
        used &= (np.diff(part.indptr) > 0).reshape(used.shape)
    sums = np.zeros((len(movies.others), 14, *movies.shape))
    for start in range(0, movies.shape[0], _ROWS):
        rows = slice(start, min(start + _ROWS, movies.shape[0]))
        pixels = slice(rows.start * width, rows.stop * width)
        moved, below, above, left, right = (
            (part[pixels] @ movies.first.reshape(-1, count)).reshape(-1, width, count)
            for part in weights
        )
        four = [below - above, right - left, np.gradient(moved, times, axis=2), moved]
        for other, out in zip(movies.others, sums, strict=True):
            pairs = [(a, b) for i, a in enumerate(four) for b in four[i:]]
            pairs += [(a, other[rows]) for a in four]
            for place, (one, two) in enumerate(pairs):
                out[place, rows] = np.einsum("yxt,yxt->yx", one, two)
    gradient = information = 0.0
    for part, level in zip(sums * used, movies.noise[1:], strict=True):
        yy, yx, yt, ym, xx, xt, xm, tt, tm, mm, yh, xh, th, mh = gaussian_filter(
            part, matching.WINDOW, axes=(-2, -1)
        )
        # Noise of the slopes: half of them at most.
        less = gaussian_filter(used * 1.0, matching.WINDOW) * movies.freedom
        less *= (movies.noise[0] * matching.SLOPE_NOISE) ** 2
        yy, xx = (one - np.minimum(less, 0.5 * one) for one in (yy, xx))
        ratio = mh / np.maximum(mm, np.finfo(np.float64).tiny)
        ridge = _RIDGE * (yy + xx).max()
        both = np.moveaxis(np.array([[yy + ridge, yx], [yx, xx + ridge]]), (0, 1), (-2, -1))
        cross, slope = np.stack([yt, xt], axis=-1), np.stack([yh, xh], axis=-1)
        slope -= ratio[..., np.newaxis] * np.stack([ym, xm], axis=-1)
        share = np.linalg.solve(both, cross[..., np.newaxis])[..., 0]
        late = th - ratio * tm - (share * slope).sum(axis=-1)
        gradient += np.sum((ratio / level**2 * late)[used])
        information += np.sum((ratio**2 / level**2 * (tt - (share * cross).sum(axis=-1)))[used])
    return float(gradient / information)
