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
EDGE: Final = 3
"""Pixels by which an image on splines is mirrored at its border."""
_VARIANCE: Final = 1.0 / 3.0  # of a cubic B-spline [pixel^2]


def binned(image: npt.NDArray[Any], factor: int) -> npt.NDArray[Any]:
    """Means (y, x, ...) over squares of pixels, in memory of their own."""
    rows, columns = (size // factor * factor for size in image.shape[:2])
    parts = [image[i:rows:factor, j:columns:factor] for i, j in np.ndindex(factor, factor)]
    return np.asarray(sum(parts[1:], parts[0]) * image.dtype.type(factor**-2))


def blurred(image: Image, width: float) -> Image:
    """Image (y, x, ...) blurred by a Gaussian of a width [pixel], mirrored at the border."""
    result: Image = gaussian_filter(image, width, axes=(0, 1))
    return result


def splines(movie: Movie, width: float) -> Movie:
    """Coefficients of cubic B-splines that are a movie blurred by a width [pixel].

    A B-spline blurs as well: so these are blurred by less, and no filter undoes it.
    """
    part = blurred(movie, float(np.sqrt(width**2 - _VARIANCE)))
    return np.pad(part, ((EDGE, EDGE), (EDGE, EDGE), (0, 0)), mode="symmetric")


def products(movie: Movie, others: list[Movie], places: Array, rate: Movie | None = None) -> Array:
    """Sums over planes (other, y, x, signal, signal) of products of signals at places (2, y, x).

    Signals are the moved movie, of `splines`, its slopes down and right, with a matrix (plane,
    plane) of the rate of change its rate, and last another movie.
    """
    shape, count = places.shape[1:], 4 if rate is None else 5
    result = np.empty((len(others), *shape, count, count))
    for start in range(0, shape[0], _ROWS):
        rows = slice(start, min(start + _ROWS, shape[0]))
        # Moved movie with its slopes and rate, once for all other movies.
        signals = np.empty((count, places[0, rows].size, movie.shape[2]), movie.dtype)
        signals[:3] = sampled(movie, places[:, rows].reshape(2, -1) + EDGE)
        if rate is not None:
            np.matmul(signals[0], rate, out=signals[3])
        for other, out in zip(others, result, strict=True):
            # Products of every pair of signals, summed over the planes.
            signals[-1] = other[rows].reshape(signals.shape[1:])
            pairs = np.einsum("ipt,jpt->pij", signals, signals)
            out[rows] = pairs.reshape(out[rows].shape)
    return result


def normal_equations(sums: Array, noise: Array) -> Array:
    """Normal equations A d = g (..., 4, 3) of steps down, right and in time, see `products`.

    Of sums (..., 5, 5) over pixels, with a rate; the noise's part of the squares of the moved movie
    and of its changes (..., 4) is subtracted, half of them at most. The other movie is a ratio of
    the moved one, which is eliminated.
    """
    full, places = sums.copy(), np.arange(4)
    full[..., places, places] -= np.minimum(noise, 0.5 * sums[..., places, places])
    size, cross = full[..., :1, :1], full[..., :1, 1:4]
    size = np.maximum(size, np.finfo(np.float64).tiny)
    # Ratio k = m h / m m; A = k^2 (g g - g m m g / m m), and its right side.
    ratio = full[..., :1, 4:] / size
    tensor = ratio**2 * (full[..., 1:4, 1:4] - cross.mT * cross / size)
    residual = ratio * (full[..., 4:, 1:4] - ratio * cross)
    return np.concatenate([tensor, residual], axis=-2)


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
