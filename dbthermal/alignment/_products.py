"""Products of a movie that is moved, of its slopes and of other movies, for Gauss-Newton steps."""

from typing import Final

import numpy as np
import numpy.typing as npt

from dbthermal._arrays import Array
from dbthermal._compiled import compiled
from dbthermal.alignment._views import TAPS, lagrange

Movie = npt.NDArray[np.float32]
Whole = npt.NDArray[np.int32]

BORDER: Final = 4
"""Pixels by which the movie that is moved is mirrored at the border."""
ROWS: Final = 32
"""Rows that are resampled at a time."""

_STEP: Final = 0.5  # on either side, over which a slope is taken [pixel]
# Neighbours along a line from which a value and a slope are made.
_NEAR: Final = TAPS + 2


def products(padded: Movie, others: list[Movie], places: Array) -> Array:
    """
    Products (other, 10, y, x), summed over planes, of moved, its slopes, and another movie.

    Moved is the movie, mirrored at its border, at places (2, y, x).
    """
    shape, planes = places.shape[1:], padded.shape[2]
    result = np.zeros((len(others), 10, *shape))
    for start in range(0, shape[0], ROWS):
        rows = slice(start, min(start + ROWS, shape[0]))
        lines = [
            _weights(place.ravel(), size)
            for place, size in zip(places[:, rows] + BORDER, padded.shape[:2], strict=True)
        ]
        flat = np.zeros((3, lines[0][0].size, planes), np.float32)
        _move(padded, *lines[0], *lines[1], flat)
        moved = flat.reshape(3, -1, shape[1], planes)
        for other, out in zip(others, result, strict=True):
            _sum_products(*moved, other[rows], out[:, rows])
    return result


def _weights(place: Array, size: int) -> tuple[Whole, Movie, Movie]:
    """First neighbour along a line of a size (place), and weights of value and slope (place, near).

    Zero for a place without so many neighbours.
    """
    parts = [lagrange(place + step, size, TAPS) for step in (0.0, _STEP, -_STEP)]
    start = np.floor(np.clip(place - _STEP - (TAPS // 2 - 1), 0, size - _NEAR)).astype(np.int32)
    spread = np.zeros((3, place.size, _NEAR), np.float32)
    for near, (inside, first, weight) in zip(spread, parts, strict=True):
        columns = np.where(inside, first - start, 0)[:, np.newaxis] + np.arange(TAPS)
        np.put_along_axis(near, columns, np.where(inside[:, np.newaxis], weight, 0.0), axis=1)
    return start, spread[0], spread[1] - spread[2]


@compiled
def _move(
    movie: Movie,
    row: Whole,
    down: Movie,
    down_slope: Movie,
    column: Whole,
    right: Movie,
    right_slope: Movie,
    result: Movie,
) -> None:
    """Values, slopes down and right (3, place, time) of a movie, in place, of zeros."""
    frames = movie.shape[2]
    along, slope = np.empty(frames, np.float32), np.empty(frames, np.float32)
    for p in range(row.size):
        for i in range(down.shape[1]):
            if down[p, i] == 0.0 and down_slope[p, i] == 0.0:
                continue
            along[:] = 0.0
            slope[:] = 0.0
            for j in range(right.shape[1]):
                weight, steep = right[p, j], right_slope[p, j]
                if weight == 0.0 and steep == 0.0:
                    continue
                pixel = movie[row[p] + i, column[p] + j]
                for t in range(frames):
                    along[t] += weight * pixel[t]
                    slope[t] += steep * pixel[t]
            value, steep = down[p, i], down_slope[p, i]
            for t in range(frames):
                result[0, p, t] += value * along[t]
                result[1, p, t] += steep * along[t]
                result[2, p, t] += value * slope[t]


@compiled
def _sum_products(moved: Movie, down: Movie, right: Movie, other: Movie, out: Array) -> None:
    """Sums (10, y, x) of `products`, in place."""
    rows, columns, planes = moved.shape
    for y, x in np.ndindex(rows, columns):
        m, a, b, h = moved[y, x], down[y, x], right[y, x], other[y, x]
        mm = my = mx = mh = yy = yx = yh = xx = xh = hh = np.float32(0.0)
        for t in range(planes):
            mm += m[t] * m[t]
            my += m[t] * a[t]
            mx += m[t] * b[t]
            mh += m[t] * h[t]
            yy += a[t] * a[t]
            yx += a[t] * b[t]
            yh += a[t] * h[t]
            xx += b[t] * b[t]
            xh += b[t] * h[t]
            hh += h[t] * h[t]
        sums = (mm, my, mx, mh, yy, yx, yh, xx, xh, hh)
        for place in range(10):
            out[place, y, x] = sums[place]
