r"""Displacement field between movies of one changing picture, matched by its own texture.

Sought is d with :math:`h_m(p, t) = k_m(p) h_1(p + d(p), t)` beside noise, m = 2, 3, ...: first the
whole pixels that explain most, then Gauss-Newton from coarse images to fine ones on a smooth field.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.ndimage import gaussian_filter, spline_filter1d, uniform_filter

from dbthermal.alignment._fields import Field, Information, Spline, weights

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Movie = npt.NDArray[np.float32]

WINDOW: Final = 2.5
"""Deviation of the window in which neighbours share a ratio and a whole-pixel match [pixel]."""
BLUR: Final = 1.2
"""Deviation of the blur of all movies before they are matched, that nothing aliases [pixel]."""

_ROUNDS: Final = 12
_CONVERGED: Final = 2e-3  # mean change of the field at its end [pixel]
_ROWS: Final = 32  # that are resampled at a time
_MISFIT: Final = 0.7  # by how much a residual's variance exceeds noise at half weight, relative
# Explained energy, in variances of noise, that chance does not reach at one of many shifts.
_SIGNIFICANT: Final = 40.0
_TAIL: Final = 4.0  # variances of the residual at which a sample has half its weight
_COLOUR: Final = 0.05  # least variance of coloured noise over that of white noise
_USUAL: Final = 0.95  # share of a pixel's samples that are no rare change
_TEXTURED: Final = 0.3  # least information over that which noise pretends, of a pixel that counts
# Rough matches count as if each were known so well [pixel].
_ROUGH: Final = 0.5


@dataclass(frozen=True)
class Movies:
    """Rapid changes of one picture (y, x, time) [K], blurred alike; 0 where missing."""

    first: Movie
    others: tuple[Movie, ...]
    valid: Mask  # pixels (y, x) with data in all
    noise: tuple[float, ...]  # standard deviation of a sample before the blur, first and others [K]
    freedom: float  # degrees of freedom of a pixel's noise
    factor: int = 1  # pixels of the capture along a side of one of these
    around: tuple[int, int, int] = (3, 3, 5)  # samples among which a residual is judged

    @classmethod
    def blurred(
        cls, movies: list[Movie], valid: Mask, noise: Array, freedom: float, factor: int = 1
    ) -> "Movies":
        """Movies of a factor coarser pixels, blurred."""
        return cls.coarse(
            [binned(movie, factor) for movie in movies],
            coarse_mask(valid, factor),
            noise / factor,
            freedom,
            factor,
        )

    @classmethod
    def coarse(
        cls, movies: list[Movie], valid: Mask, noise: Array, freedom: float, factor: int
    ) -> "Movies":
        """Movies of pixels that are so many times coarser, blurred in place."""
        for movie in movies:
            gaussian_filter(movie, (BLUR, BLUR, 0.0), output=movie)
        levels = tuple(float(level) for level in noise)
        return cls(movies[0], tuple(movies[1:]), valid, levels, freedom, factor)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.valid.shape[0], self.valid.shape[1]

    def centres(self) -> list[Array]:
        """Rows and columns, of the capture, of the pixels' centres."""
        return [np.asarray(self.factor * (np.arange(n) + 0.5) - 0.5) for n in self.shape]


def binned(movie: Movie, factor: int) -> Movie:
    """Means (y, x, time) over squares of pixels, in memory of their own."""
    if factor == 1:
        return movie.copy()
    rows, columns = (size // factor for size in movie.shape[:2])
    parts = movie[: rows * factor, : columns * factor]
    parts = parts.reshape(rows, factor, columns, factor, -1)
    return np.asarray(parts.mean(axis=(1, 3)), dtype=np.float32)


def coarse_mask(valid: Mask, factor: int) -> Mask:
    """Squares of pixels of which most are valid."""
    return np.asarray(binned(valid[..., np.newaxis].astype(np.float32), factor)[..., 0] > 0.5)


def _blur_noise() -> tuple[float, float]:
    """Noise of values and of slopes after the blur, over that before."""
    impulse = np.zeros((33, 33))
    impulse[16, 16] = 1.0
    kernel = gaussian_filter(impulse, BLUR)
    slope = 0.5 * (kernel[2:] - kernel[:-2])
    return float(np.sqrt(np.sum(kernel**2))), float(np.sqrt(np.sum(slope**2)))


def whole_pixels(movies: Movies, reach: tuple[int, int]) -> tuple[Array, Array]:
    """
    Shift (2, y, x) of whole pixels that explains most, and its weight (y, x), 0 of chance.

    Explained is a part of the others' energy in a window; the weight is the share that is.
    """
    noise, window = _blur_noise()[0], 4.0 * np.pi * WINDOW**2
    floor = movies.freedom * (movies.noise[0] * noise) ** 2
    auto = np.einsum("yxt,yxt->yx", movies.first, movies.first)
    energy = sum(
        gaussian_filter(np.einsum("yxt,yxt->yx", part, part), WINDOW) / (level * noise) ** 2
        for part, level in zip(movies.others, movies.noise[1:], strict=True)
    )
    best, where = np.zeros(movies.shape), np.zeros((2, *movies.shape))
    for down in range(-reach[0], reach[0] + 1):
        for right in range(-reach[1], reach[1] + 1):
            here, there = _overlap(movies.shape, (down, right))
            gain, local = np.zeros(movies.shape), np.zeros(movies.shape)
            local[here] = auto[there]
            local = np.maximum(gaussian_filter(local, WINDOW), floor)
            for part, level in zip(movies.others, movies.noise[1:], strict=True):
                cross = np.zeros(movies.shape)
                cross[here] = np.einsum("yxt,yxt->yx", movies.first[there], part[here])
                cross = np.maximum(gaussian_filter(cross, WINDOW), 0.0)
                gain += cross**2 / local / (level * noise) ** 2
            better = gain > best
            best[better], where[0][better], where[1][better] = gain[better], down, right
    share = best / np.maximum(energy, 1e-9) * movies.valid
    # Products of two blurred noises are alike over an area of 2 pi BLUR^2.
    chance = _SIGNIFICANT * 2.0 * np.pi * BLUR**2
    return where, np.where(best * window > chance, share, 0.0)


def _overlap(
    shape: tuple[int, int], shift: tuple[int, int]
) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Pixels here, and those a shift away."""
    sizes = list(zip(shape, shift, strict=True))
    here = tuple(slice(max(-by, 0), size - max(by, 0)) for size, by in sizes)
    return here, tuple(slice(max(by, 0), size - max(-by, 0)) for size, by in sizes)


def interpolation(places: Array, shape: tuple[int, int]) -> list[sparse.csr_array]:
    """
    Matrices from spline coefficients to values, slopes down and right, at places (2, place).

    The coefficients (row, column) are those of `spline_filter1d`, mirrored at the borders.
    """
    nodes, parts = [], []
    for place, size in zip(places, shape, strict=True):
        low = np.clip(np.floor(place), -1, size)
        parts.append(weights(place - low))
        node = np.abs(low.astype(np.intp) + np.arange(-1, 3)[:, np.newaxis])
        nodes.append(np.where(node >= size, np.maximum(2 * size - 2 - node, 0), node))
    columns = (nodes[0][:, np.newaxis] * shape[1] + nodes[1]).reshape(16, -1).T.ravel()
    (row, row_slope), (column, column_slope) = parts
    pointer = np.arange(0, columns.size + 1, 16)
    return [
        sparse.csr_array(
            ((a[:, np.newaxis] * b).reshape(16, -1).T.ravel().astype(np.float32), columns, pointer),
            shape=(places.shape[1], shape[0] * shape[1]),
        )
        for a, b in ((row, column), (row_slope, column), (row, column_slope))
    ]


def inside(places: Array, valid: Mask) -> Mask:
    """Places (2, ...) that lie on valid pixels of an image."""
    near = np.rint(places)
    result = np.all([(n >= 0) & (n < size) for n, size in zip(near, valid.shape, strict=True)], 0)
    row, column = np.where(result, near, 0).astype(np.intp)
    return np.asarray(result & valid[row, column])


@dataclass(frozen=True)
class _Match:
    """Ratio (y, x) of another movie to the moved first one, and its residual's variance."""

    ratio: Array
    variance: Array  # of a sample of the residual [K^2]

    def trust(self, square: Movie, rows: slice) -> Movie:
        """Weight of samples (y, x, time): 1 of noise, 0 of changes that are no reflection."""
        scale = (1.0 / (_TAIL * self.variance[rows, :, np.newaxis])).astype(np.float32)
        return np.asarray(1.0 / (1.0 + (square * scale) ** 2))


def _moderate(movie: Movie) -> Movie:
    """Weight of samples (..., time), smaller where a movie changes as it seldom does."""
    usual = np.quantile(np.abs(movie), _USUAL, axis=-1, keepdims=True)
    return np.asarray(1.0 / (1.0 + (movie / np.maximum(usual, 1e-12)) ** 2), dtype=np.float32)


def _moments(
    movies: Movies, coefficients: Movie, places: Array, matches: list[_Match] | None
) -> Array:
    """
    Products (other, 14, y, x), summed over time, of moved, its slopes, and another movie.

    Weighted by how well samples match; then the number of samples, their residual's variance, and
    the slopes' products with the residual of another time.
    """
    frames = coefficients.shape[1]
    result = np.zeros((len(movies.others), 14, *movies.shape))
    pairs = [(i, j) for i in range(4) for j in range(i, 4)]
    for start in range(0, movies.shape[0], _ROWS):
        rows = slice(start, start + _ROWS)
        matrices = interpolation(places[:, rows].reshape(2, -1), movies.shape)
        moved = [(m @ coefficients).reshape(-1, movies.shape[1], frames) for m in matrices]
        for number, (other, out) in enumerate(zip(movies.others, result, strict=True)):
            four = [*moved, other[rows]]
            if matches is None:
                weight = _moderate(four[0]) * _moderate(four[3])
            else:
                ratio = matches[number].ratio[rows, :, np.newaxis].astype(np.float32)
                residual = four[3] - ratio * four[0]
                square = uniform_filter(residual**2, movies.around)
                weight = matches[number].trust(square, rows)
                out[11, rows] = np.median(square, axis=2)
                other_time = np.roll(weight * residual, frames // 2, axis=2)
                for place in (1, 2):
                    out[11 + place, rows] = np.einsum(
                        "yxt,yxt,yxt->yx", weight, four[place], other_time
                    )
            out[10, rows] = weight.sum(axis=2)
            weighted = [weight * one for one in four]
            for place, (i, j) in enumerate(pairs):
                out[place, rows] = np.einsum("yxt,yxt->yx", weighted[i], four[j])
    return result


def information(
    movies: Movies, coefficients: Movie, shift: Array, matches: list[_Match] | None
) -> tuple[Information, list[_Match]]:
    r"""
    Information on a step of the field at each pixel, by Gauss-Newton, and how well it matches.

    With a ratio k for each window, the residual r of a pixel, and the slope g of the moved movie,

    .. math:: A = k^2 \sum_t w g g^T / s^2, \quad b = k \sum_t w g r / s^2

    less what noise makes of the slopes; s^2 is the noise's variance where the residual is noise,
    and larger where it is not; w takes samples out whose residual is large.
    """
    places = np.indices(movies.shape) + shift / movies.factor
    used = inside(places, movies.valid) & movies.valid
    value_noise, slope_noise = _blur_noise()
    noise = movies.noise[0] * value_noise
    tensor, gradient = np.zeros((3, *used.shape)), np.zeros((2, *used.shape))
    chance, found, scatter, white = np.zeros(used.shape), [], 0.0, 0.0
    for moments, level in zip(
        _moments(movies, coefficients, places, matches) * used, movies.noise[1:], strict=True
    ):
        mm, my, mx, mh, yy, yx, yh, xx, xh, hh, samples, squares, null_y, null_x = moments
        samples *= movies.freedom / coefficients.shape[1]
        number = np.maximum(gaussian_filter(samples, WINDOW), 1e-9)
        # Noise of the moved movie makes its energy larger, not its product with another movie.
        auto = gaussian_filter(mm, WINDOW) - number * noise**2
        ratio = gaussian_filter(mh, WINDOW) / np.maximum(auto, 0.1 * number * noise**2)
        # Summed over pixels, the noise is that before the blur.
        variance = level**2 + (ratio * movies.noise[0]) ** 2
        floor = variance * value_noise**2
        residual = gaussian_filter(hh - 2.0 * ratio * mh + ratio**2 * mm, WINDOW)
        misfit = np.maximum(residual / (number * floor), 1.0)
        spread = misfit * floor if matches is None else gaussian_filter(squares, WINDOW)
        found.append(_Match(ratio, np.maximum(spread, floor)))
        weight = used / (misfit * (1.0 + ((misfit - 1.0) / _MISFIT) ** 2) * variance)
        less = samples * (movies.noise[0] * slope_noise) ** 2
        tensor += weight * ratio**2 * np.stack([yy - less, yx, xx - less])
        gradient += weight * ratio * np.stack([yh - ratio * my, xh - ratio * mx])
        chance += weight * ratio**2 * less
        # Noise that both filters have coloured: its products with the slopes, over white noise's.
        for null, energy in ((null_y, yy), (null_x, xx)):
            scatter += np.sum(gaussian_filter(weight * ratio * null, WINDOW) ** 2)
            white += np.sum((weight * ratio) ** 2 * variance * energy) / (4.0 * np.pi * WINDOW**2)
    tensor, gradient = (
        np.stack([gaussian_filter(one, WINDOW) for one in part]) for part in (tensor, gradient)
    )
    # With noise N in the slopes, var = (A + N) / A^2: as if the information were A^2 / (A + N).
    total, less = tensor[0] + tensor[2], gaussian_filter(chance, WINDOW)
    share = np.where(total > _TEXTURED * less, total / np.maximum(total + less, 1e-300), 0.0)
    share /= max(scatter / white, _COLOUR) if scatter > 0 else 1.0
    tensor, gradient = _positive(tensor) * share, gradient * share
    return Information(tensor / movies.factor**2, gradient / movies.factor), found


def _positive(tensor: Array) -> Array:
    """Tensors (3, y, x) without their negative eigenvalues."""
    a, b, c = tensor
    middle, radius = 0.5 * (a + c), np.hypot(0.5 * (a - c), b)
    high, low = np.maximum(middle + radius, 0.0), np.maximum(middle - radius, 0.0)
    share = 0.5 * (high - low) / np.maximum(radius, 1e-300)
    mean, half = 0.5 * (high + low), 0.5 * share * (a - c)
    return np.stack([mean + half, share * b, mean - half])


def clipped(movies: Movies) -> Movies:
    """Movies of which changes as large as there are seldom are cut: an object's, if rapid."""
    first, *others = (part * np.sqrt(_moderate(part)) for part in (movies.first, *movies.others))
    return replace(movies, first=first, others=tuple(others))


def start(movies: Movies, spline: Spline, reach: tuple[int, int]) -> Field | None:
    """Field of whole-pixel matches, wrong ones taken for outliers; None without any."""
    rough, share = whole_pixels(clipped(movies), reach)
    if not share.any():
        return None
    at_end = np.any(np.abs(rough) == np.reshape(reach, (2, 1, 1)), axis=0)
    if np.sum(share * at_end) > 0.5 * np.sum(share):
        raise ValueError(
            f"Invalid shift of the reflections: most match best {reach[0] * movies.factor} rows or "
            f"{reach[1] * movies.factor} columns away, the end of the search. Must be less than a "
            "third of the image."
        )
    target, weight = rough * movies.factor, share / (_ROUGH * movies.factor) ** 2
    field = None
    for _ in range(8):
        off = 0.0 if field is None else np.sum((field.on(movies.centres()) - target) ** 2, axis=0)
        kept = weight / (1.0 + off / (1.0 * movies.factor) ** 2) ** 2
        tensor = np.stack([kept, 0.0 * kept, kept])
        field = spline.fitted(Information(tensor, kept * target), movies.centres())
    assert field is not None
    return field


def refine(movies: Movies, field: Field) -> tuple[Field, Information]:
    """Field after Gauss-Newton, and the information of each pixel on it."""
    shape = movies.first.shape
    coefficients = movies.first
    for axis in (0, 1):
        coefficients = spline_filter1d(coefficients, 3, axis=axis, output=np.float32)
    coefficients = coefficients.reshape(-1, shape[2])
    matches = None
    for _ in range(_ROUNDS):
        shift = field.on(movies.centres())
        data, matches = information(movies, coefficients, shift, matches)
        field = field.spline.fitted(data, movies.centres(), field)
        change = np.abs(field.on(movies.centres()) - shift)
        if change.mean() < _CONVERGED * movies.factor:
            break
    return field, data
