"""Images on splines: blurred, moved to other places with their slopes, and products of these."""

from typing import Any, Final, TypeVar

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter

from dbthermal._arrays import Array
from dbthermal._compiled import compiled

Movie = npt.NDArray[np.float32]
Image = TypeVar("Image", bound=npt.NDArray[Any])

_ROWS: Final = 4  # rows that are moved at a time, and stay in the cache
_EDGE: Final = 3  # pixels by which an image on splines is mirrored at its border
_VARIANCE: Final = 1.0 / 3.0  # of a cubic B-spline [pixel^2]


def binned(image: npt.NDArray[Any], factor: int) -> npt.NDArray[Any]:
    """Means (y, x, ...) over squares of pixels, in memory of their own."""
    rows, columns = (size // factor * factor for size in image.shape[:2])
    corners = [image[i:rows:factor, j:columns:factor] for i, j in np.ndindex(factor, factor)]
    return np.asarray(sum(corners[1:], corners[0]) * image.dtype.type(factor**-2))


def blurred(image: Image, width: float) -> Image:
    """Image (y, x, plane) blurred by a Gaussian of a width [pixel], mirrored at the border."""
    impulse = np.zeros(2 * int(4.0 * width + 0.5) + 1)
    impulse[impulse.size // 2] = 1.0
    weights = gaussian_filter(impulse, width).astype(image.dtype)
    lines = np.ascontiguousarray(image).reshape(1, len(image), -1)
    result: Image = _blurred(_blurred(lines, weights).reshape(image.shape), weights)
    return result


def splines(movie: Movie, width: float) -> Movie:
    """Coefficients of cubic B-splines that are a movie blurred by a width [pixel].

    A B-spline blurs as well: so these are blurred by less, and no filter undoes it.
    """
    smooth = blurred(movie, float(np.sqrt(width**2 - _VARIANCE)))
    return np.pad(smooth, ((_EDGE, _EDGE), (_EDGE, _EDGE), (0, 0)), mode="symmetric")


def products(movie: Movie, movies: list[Movie], places: Array, rate: Movie | None = None) -> Array:
    """Sums over planes (movie, y, x, pair) of the products of signals at places (2, y, x).

    Signals are the moved movie, of `splines`, its slopes down and right, and another movie, each
    with itself and all that follow: 10 pairs. With a matrix (plane, plane) of the rate of change
    the rate follows the slopes: 15 pairs.
    """
    shape, planes = places.shape[1:], movie.shape[2]
    count = 4 if rate is None else 5
    result = np.zeros((len(movies), *shape, count * (count + 1) // 2))
    for start in range(0, shape[0], _ROWS):
        rows = slice(start, min(start + _ROWS, shape[0]))
        signals = sampled(movie, places[:, rows].reshape(2, -1) + _EDGE)
        if rate is not None:
            signals = np.concatenate([signals, (signals[0] @ rate)[np.newaxis]])
        for second, out in zip(movies, result, strict=True):
            sums = out[rows].reshape(-1, out.shape[2])
            _sum_pairs(signals, second[rows].reshape(-1, planes), sums)
    return result


def normal_equations(sums: Array, noise: Array) -> Array:
    """Normal equations A d = g (..., 4, 3) of steps down, right and in time, see `products`.

    Of sums (..., 15) over pixels, with a rate; the noise's part of the squares of the moved movie
    and of its changes (..., 4) is subtracted, half of them at most. The other movie is a ratio of
    the moved one, which is eliminated.
    """
    rows, columns = np.triu_indices(5)
    full = np.zeros((*sums.shape[:-1], 5, 5))
    full[..., rows, columns] = full[..., columns, rows] = sums
    places = np.arange(4)
    squares = full[..., places, places]
    full[..., places, places] -= np.minimum(noise, 0.5 * squares)
    size, cross = full[..., :1, :1], full[..., :1, 1:4]
    size = np.maximum(size, np.finfo(np.float64).tiny)
    ratio = full[..., :1, 4:] / size
    tensor = ratio**2 * (full[..., 1:4, 1:4] - cross.mT * cross / size)
    force = ratio * (full[..., 4:, 1:4] - ratio * cross)
    return np.concatenate([tensor, force], axis=-2)


@compiled
def _blurred(movie: Any, weights: Any) -> Any:
    """Image (line, place, plane) with weighted means over the places of each line."""
    lines, size, planes = movie.shape
    reach, result = weights.size // 2, np.zeros_like(movie)
    for line, place in np.ndindex(lines, size):
        out = result[line, place]
        for i in range(weights.size):
            # A place beyond an end is mirrored, as often as needed.
            near = (place + i - reach) % (2 * size)
            source = movie[line, min(near, 2 * size - 1 - near)]
            weight = weights[i]
            for t in range(planes):
                out[t] += weight * source[t]
    return result


@compiled
def sampled(splines: Any, places: Array) -> Any:
    """Values, slopes over a pixel down and right (3, place, plane) of splines at rows, columns."""
    count, planes = places.shape[1], splines.shape[2]
    result = np.zeros((3, count, planes), splines.dtype)
    along, slope = np.empty(planes, splines.dtype), np.empty(planes, splines.dtype)
    first, weights = np.empty(2, np.intp), np.empty((2, 2, 5), splines.dtype)
    for p in range(count):
        for axis in range(2):
            low = int(np.floor(places[axis, p] - 0.5)) - 1
            first[axis] = min(max(low, 0), splines.shape[axis] - 5)
            for i in range(5):
                away = first[axis] + i - places[axis, p]
                weights[axis, 0, i] = _cubic(away)
                weights[axis, 1, i] = _cubic(away - 0.5) - _cubic(away + 0.5)
        for i in range(5):
            along[:] = 0.0
            slope[:] = 0.0
            for j in range(5):
                value, steep = weights[1, 0, j], weights[1, 1, j]
                pixel = splines[first[0] + i, first[1] + j]
                for t in range(planes):
                    along[t] += value * pixel[t]
                    slope[t] += steep * pixel[t]
            value, steep = weights[0, 0, i], weights[0, 1, i]
            for t in range(planes):
                result[0, p, t] += value * along[t]
                result[1, p, t] += steep * along[t]
                result[2, p, t] += value * slope[t]
    return result


@compiled
def _cubic(away: float) -> float:
    """Cubic B-spline at a distance from its middle [pixel]."""
    far = abs(away)
    return (max(2.0 - far, 0.0) ** 3 - 4.0 * max(1.0 - far, 0.0) ** 3) / 6.0


@compiled
def _sum_pairs(signals: Movie, last: Movie, out: Array) -> None:
    """Sums over planes (pixel, pair) of the products of signals, in place."""
    count, pixels, planes = signals.shape
    for p in range(pixels):
        place = 0
        for i in range(count + 1):
            first = signals[i, p] if i < count else last[p]
            for j in range(i, count + 1):
                second, total = signals[j, p] if j < count else last[p], np.float32(0.0)
                for t in range(planes):
                    total += first[t] * second[t]
                out[p, place] = total
                place += 1
