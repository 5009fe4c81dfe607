"""Products of a movie that is moved, of its slopes and of other movies, for Gauss-Newton steps."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import uniform_filter

from dbthermal._arrays import Array
from dbthermal._compiled import compiled
from dbthermal.alignment._views import TAPS, lagrange

Movie = npt.NDArray[np.float32]
Whole = npt.NDArray[np.int32]

BORDER: Final = 4
"""Pixels by which the movie that is moved is mirrored at the border."""
ROWS: Final = 32
"""Rows that are resampled at a time."""

_AROUND: Final = (3, 3, 5)  # samples among which a residual is judged
_TAIL: Final = 4.0  # variances of the residual at which a sample has half its weight
_STEP: Final = 0.5  # on either side, over which a slope is taken [pixel]
# Neighbours along a line from which a value and a slope are made.
_NEAR: Final = TAPS + 2


@dataclass(frozen=True)
class Match:
    """Ratio (y, x) of another movie to the moved first one, and its residual's variance."""

    ratio: Array
    variance: Array  # of a sample of the residual [K^2]


def products(
    padded: Movie, others: list[Movie], places: Array, matches: Sequence[Match | None]
) -> Array:
    """
    Products (other, 14, y, x), summed over time, of moved, its slopes, and another movie.

    Moved is the movie, mirrored at its border, at places (2, y, x). Weighted by how well samples
    match; then the sum of weights, their residual's variance, and the slopes' products with the
    residual of another time.
    """
    shape, frames = places.shape[1:], padded.shape[2]
    result = np.zeros((len(others), 14, *shape))
    for start in range(0, shape[0], ROWS):
        rows = slice(start, min(start + ROWS, shape[0]))
        lines = [
            _weights(place.ravel(), size)
            for place, size in zip(places[:, rows] + BORDER, padded.shape[:2], strict=True)
        ]
        flat = np.zeros((3, lines[0][0].size, frames), np.float32)
        _move(padded, *lines[0], *lines[1], flat)
        moved = flat.reshape(3, -1, shape[1], frames)
        for other, match, out in zip(others, matches, result, strict=True):
            residual = square = most = np.zeros((0, 0, 0), np.float32)
            if match is not None:
                ratio = match.ratio[rows, :, np.newaxis].astype(np.float32)
                residual = other[rows] - ratio * moved[0]
                square = uniform_filter(residual**2, _AROUND)
                most = (_TAIL * match.variance[rows, :, np.newaxis]).astype(np.float32)
                out[11, rows] = np.median(square, axis=2)
            _sum_products(*moved, other[rows], residual, square, most, out[:, rows])
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
def _sum_products(
    moved: Movie,
    down: Movie,
    right: Movie,
    other: Movie,
    residual: Movie,
    square: Movie,
    most: Movie,
    out: Array,
) -> None:
    """Sums (14, y, x) of `products` but one, in place; of weight 1 without a residual."""
    rows, columns, frames = moved.shape
    weight, pull = np.ones(frames, np.float32), np.empty(frames, np.float32)
    for y, x in np.ndindex(rows, columns):
        m, a, b, h = moved[y, x], down[y, x], right[y, x], other[y, x]
        if residual.size > 0:
            _weigh(residual[y, x], square[y, x], most[y, x, 0], weight, pull)
            out[12, y, x], out[13, y, x] = _another_time(a, b, weight, pull)
        total = mm = my = mx = mh = np.float32(0.0)
        for t in range(frames):
            total += weight[t]
            of_m = weight[t] * m[t]
            mm += of_m * m[t]
            my += of_m * a[t]
            mx += of_m * b[t]
            mh += of_m * h[t]
        yy = yx = yh = xx = xh = hh = np.float32(0.0)
        for t in range(frames):
            of_y, of_x = weight[t] * a[t], weight[t] * b[t]
            yy += of_y * a[t]
            yx += of_y * b[t]
            yh += of_y * h[t]
            xx += of_x * b[t]
            xh += of_x * h[t]
            hh += weight[t] * h[t] * h[t]
        sums = (mm, my, mx, mh, yy, yx, yh, xx, xh, hh, total)
        for place in range(11):
            out[place, y, x] = sums[place]


@compiled
def _weigh(residual: Movie, square: Movie, most: Any, weight: Movie, pull: Movie) -> None:
    """Weights of a pixel's samples (time) by their squares, and their residual's, in place."""
    scale, one = np.float32(1.0) / most, np.float32(1.0)
    for t in range(weight.size):
        share = square[t] * scale
        weight[t] = one / (one + share * share)
        pull[t] = weight[t] * residual[t]


@compiled
def _another_time(down: Movie, right: Movie, weight: Movie, pull: Movie) -> tuple[Any, Any]:
    """Products of a pixel's slopes (time) with the residual of half the frames before."""
    half, one, two = weight.size // 2, np.float32(0.0), np.float32(0.0)
    for start, stop, away in ((half, weight.size, -half), (0, half, weight.size - half)):
        for t in range(start, stop):
            product = weight[t] * pull[t + away]
            one += down[t] * product
            two += right[t] * product
    return one, two
