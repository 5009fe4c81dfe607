r"""Displacement field between two movies of one changing picture, matched by their own texture.

Sought is d with :math:`h_2(p, t) = k(p) h_1(p + d(p), t)` beside noise: whole pixels by the largest
explained variance in a window, then Gauss-Newton on a smooth field, a grid of cubic B-splines whose
bending is penalised. The penalty is that of the largest marginal likelihood (restricted maximum
likelihood), so the posterior covariance is the field's.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve
from scipy.ndimage import gaussian_filter, spline_filter1d

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Movie = npt.NDArray[np.float32]

# Deviation of the window in which neighbours share a ratio and a whole-pixel match [pixel].
_WINDOW: Final = 2.5
# Pixels between two nodes of the field, at least, and nodes along a side, at most.
_SPACING: Final = 6.0
_NODES: Final = 28
_ROUNDS: Final = 10
_CONVERGED: Final = 2e-3  # largest change of the field at its end [pixel]
_PIXELS: Final = 4096  # that are resampled at a time
_MISFIT: Final = 1.3  # residual over noise at which a pixel has half its weight
# Bending penalties that are tried, over the mean information of a node.
_PENALTIES: Final = 10.0 ** np.arange(-6.0, 5.0, 0.5)


@dataclass(frozen=True)
class Pair:
    """Rapid changes (y, x, time) of one picture in two movies [K], 0 where missing."""

    first: Movie
    second: Movie
    valid: Mask  # pixels (y, x) with data in both
    noise: tuple[float, float]  # standard deviation of a sample of either [K]
    blurred: tuple[float, float]  # noise over that before both were smoothed, of value and slope


@dataclass(frozen=True)
class Field:
    """Displacement (2, y, x) [pixel], rows then columns, and what is known of it."""

    shift: Array
    covariance: Array  # (3, y, x): of rows, of rows and columns, of columns [pixel^2]
    information: Array  # of each pixel's own data, likewise (3, y, x) [1/pixel^2]


def _weights(offset: Array) -> tuple[Array, Array]:
    """Cubic B-spline and its slope (4, ...) at the four nodes about a place, from 0 to 1."""
    u = offset
    value = [(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3]
    slope = [-((1 - u) ** 2), 3 * u**2 - 4 * u, -3 * u**2 + 2 * u + 1, u**2]
    return np.stack(value) / 6.0, np.stack(slope) / 2.0


def interpolation(places: Array, shape: tuple[int, int]) -> list[sparse.csr_array]:
    """
    Matrices from spline coefficients to values and slopes down and right at places (2, place).

    The coefficients (row, column) are those of `spline_filter1d`, mirrored at the borders.
    """
    nodes, parts = [], []
    for place, size in zip(places, shape, strict=True):
        low = np.clip(np.floor(place), -1, size)
        parts.append(_weights(place - low))
        node = np.abs(low.astype(np.intp) + np.arange(-1, 3)[:, np.newaxis])
        nodes.append(np.where(node >= size, np.maximum(2 * size - 2 - node, 0), node))
    columns = (nodes[0][:, np.newaxis] * shape[1] + nodes[1]).reshape(16, -1).T
    (row, row_slope), (column, column_slope) = parts
    pointer = np.arange(0, columns.size + 1, 16)
    return [
        sparse.csr_array(
            ((a[:, np.newaxis] * b).reshape(16, -1).T.ravel(), columns.ravel(), pointer),
            shape=(places.shape[1], shape[0] * shape[1]),
        )
        for a, b in ((row, column), (row_slope, column), (row, column_slope))
    ]


def _coefficients(movie: Movie) -> Movie:
    """Spline coefficients (pixel, time) of a movie (y, x, time)."""
    for axis in (0, 1):
        movie = spline_filter1d(movie, 3, axis=axis, output=np.float32)
    return movie.reshape(-1, movie.shape[2])


def _inside(places: Array, shape: tuple[int, ...]) -> Mask:
    """Places (2, ...) that lie in an image."""
    return np.asarray(
        (places[0] >= 0)
        & (places[0] <= shape[0] - 1)
        & (places[1] >= 0)
        & (places[1] <= shape[1] - 1)
    )


def whole_pixels(pair: Pair, reach: tuple[int, int]) -> tuple[Array, Array]:
    """
    Displacement (2, y, x) in whole pixels that explains most, and by how much (y, x).

    The explained part of the second movie's energy in a window, in variances of its noise.
    """
    shape, noise = pair.first.shape[:2], pair.noise[1] * pair.blurred[0]
    best, where = np.zeros(shape), np.zeros((2, *shape))
    for down in range(-reach[0], reach[0] + 1):
        for right in range(-reach[1], reach[1] + 1):
            rows, columns = _overlap(shape[0], down), _overlap(shape[1], right)
            cross, auto = np.zeros(shape), np.zeros(shape)
            moved = pair.first[rows[1], columns[1]]
            cross[rows[0], columns[0]] = np.einsum(
                "yxt,yxt->yx", moved, pair.second[rows[0], columns[0]]
            )
            auto[rows[0], columns[0]] = np.einsum("yxt,yxt->yx", moved, moved)
            cross, auto = (gaussian_filter(part, _WINDOW) for part in (cross, auto))
            floor = moved.shape[2] * (pair.noise[0] * pair.blurred[0]) ** 2
            gain = np.where(cross > 0, cross**2 / np.maximum(auto, floor), 0.0) / noise**2
            better = gain > best
            best[better], where[0][better], where[1][better] = gain[better], down, right
    return where, best


def _overlap(size: int, shift: int) -> tuple[slice, slice]:
    """Places here, and the places of what is shown there."""
    return (
        slice(max(-shift, 0), size - max(shift, 0)),
        slice(max(shift, 0), size - max(-shift, 0)),
    )


@dataclass(frozen=True)
class _Basis:
    """Grid of cubic B-splines over an image, and its bending."""

    values: sparse.csr_array  # (pixel, node)
    bending: Array  # (node, node)

    @classmethod
    def over(cls, shape: tuple[int, int]) -> "_Basis":
        """Grid of at most so many nodes over an image."""
        spacing = max(_SPACING, max(shape) / _NODES)
        lines = [max(2, int(np.ceil((size - 1) / spacing)) + 1) for size in shape]
        parts = []
        for size, count in zip(shape, lines, strict=True):
            place = np.linspace(0.0, count - 1.0, size)
            low = np.minimum(np.floor(place), count - 2)
            weights = _weights(place - low)[0].T
            columns = low.astype(np.intp)[:, np.newaxis] + np.arange(4)
            rows = np.repeat(np.arange(size), 4)
            parts.append(sparse.csr_array((weights.ravel(), (rows, columns.ravel()))))
        second = [np.diff(np.eye(count + 2), 2, axis=0) for count in lines]
        first = [np.diff(np.eye(count + 2), 1, axis=0) for count in lines]
        gram = [[d.T @ d for d in group] for group in (first, second)]
        one = [np.eye(count + 2) for count in lines]
        bending = np.kron(gram[1][0], one[1]) + np.kron(one[0], gram[1][1])
        bending += 2.0 * np.kron(gram[0][0], gram[0][1])
        return cls(sparse.csr_array(sparse.kron(parts[0], parts[1])), bending)


@dataclass(frozen=True)
class _Equations:
    """Normal equations of a step at each pixel, (3, y, x) and (2, y, x), and the misfit (y, x)."""

    information: Array
    gradient: Array
    misfit: Array


def _equations(pair: Pair, coefficients: Movie, shift: Array) -> _Equations:
    """Gauss-Newton equations of the displacement, with a ratio for each window."""
    shape, frames = pair.first.shape[:2], pair.first.shape[2]
    places = np.indices(shape) + shift
    inside = _inside(places, shape) & pair.valid
    sums = np.zeros((10, *shape))
    flat, second = sums.reshape(10, -1), pair.second.reshape(-1, frames)
    for start in range(0, inside.size, _PIXELS):
        part = slice(start, start + _PIXELS)
        matrices = interpolation(places.reshape(2, -1)[:, part], shape)
        movies = [matrix.astype(np.float32) @ coefficients for matrix in matrices]
        movies.append(second[part])
        pairs = [(i, j) for i in range(4) for j in range(i, 4)]
        for place, (i, j) in enumerate(pairs):
            flat[place, part] = np.einsum("pt,pt->p", movies[i], movies[j])
    sums *= inside
    mm, my, mx, mh, yy, yx, yh, xx, xh, hh = sums
    number = gaussian_filter(inside.astype(np.float64), _WINDOW) * frames
    noise = [s * pair.blurred[0] for s in pair.noise]
    # Noise of the moved movie makes its energy larger, not its product with the second movie.
    auto = gaussian_filter(mm, _WINDOW) - number * noise[0] ** 2
    floor = 0.1 * np.maximum(number, 1e-9) * noise[0] ** 2
    ratio = gaussian_filter(mh, _WINDOW) / np.maximum(auto, floor)
    variance = noise[1] ** 2 + (ratio * noise[0]) ** 2
    misfit = (hh - 2.0 * ratio * mh + ratio**2 * mm) / (frames * variance)
    # The noise before both were smoothed: what is summed over pixels has that.
    variance = pair.noise[1] ** 2 + (ratio * pair.noise[0]) ** 2
    weight = inside / (1.0 + (misfit / _MISFIT**2) ** 2) / variance
    slope_noise = frames * (pair.noise[0] * pair.blurred[1]) ** 2
    tensor = np.stack([yy - slope_noise, yx, xx - slope_noise])
    residual = np.stack([yh - ratio * my, xh - ratio * mx])
    return _Equations(weight * ratio**2 * tensor, weight * ratio * residual, misfit)


def _normal(basis: _Basis, equations: _Equations) -> tuple[Array, Array]:
    """Normal matrix and gradient of the nodes, of rows and then of columns."""
    b = basis.values
    blocks = [
        np.asarray((b.T @ (b.multiply(part.reshape(-1, 1)).tocsr())).todense())
        for part in equations.information
    ]
    matrix = np.block([[blocks[0], blocks[1]], [blocks[1], blocks[2]]])
    return matrix, np.concatenate([b.T @ part.ravel() for part in equations.gradient])


def _solve(
    matrix: Array, target: Array, bending: Array, prior: float, penalty: float | None = None
) -> tuple[Array, Array, float]:
    """Nodes, their covariance and the penalty of the largest marginal likelihood."""
    zero = np.zeros_like(bending)
    full = np.block([[bending, zero], [zero, bending]])
    ridge = np.eye(len(matrix)) / prior**2
    scale, best = np.trace(matrix) / len(matrix), (-np.inf, 1.0)
    for trial in _PENALTIES * scale if penalty is None else ():
        try:
            after = np.linalg.cholesky(matrix + trial * full + ridge)
        except np.linalg.LinAlgError:
            continue
        before = np.linalg.cholesky(trial * full + ridge)
        fit = np.linalg.solve(after, target)
        logs = [np.sum(np.log(np.diag(part))) for part in (before, after)]
        best = max(best, (logs[0] - logs[1] + 0.5 * fit @ fit, trial))
    penalty = best[1] if penalty is None else penalty
    factor = cho_factor(matrix + penalty * full + ridge)
    return cho_solve(factor, target), cho_solve(factor, np.eye(len(matrix))), penalty


def refine(pair: Pair, start: Array, weight: Array, prior: float) -> Field:
    """Field by Gauss-Newton, from a rough one (2, y, x) with a weight (y, x) [1/pixel^2]."""
    shape = pair.first.shape[:2]
    basis = _Basis.over((shape[0], shape[1]))
    rough = _Equations(np.stack([weight, 0.0 * weight, weight]), weight * start, weight)
    for _ in range(10):  # robust: a wrong match is an outlier
        nodes, _, _ = _solve(*_normal(basis, rough), basis.bending, prior)
        field = _laid(basis, nodes, shape)
        off = np.sum((field - start) ** 2, axis=0)
        kept = weight / (1.0 + off / 0.5) ** 2
        rough = _Equations(np.stack([kept, 0.0 * kept, kept]), kept * start, kept)
    coefficients, penalty = _coefficients(pair.first), None
    for number in range(_ROUNDS):
        equations = _equations(pair, coefficients, field)
        matrix, gradient = _normal(basis, equations)
        target = matrix @ nodes + gradient
        nodes, covariance, penalty = _solve(
            matrix, target, basis.bending, prior, penalty if number > 3 else None
        )
        last, field = field, _laid(basis, nodes, shape)
        if np.abs(field - last).max() < _CONVERGED:
            break
    return Field(field, _variances(basis, covariance, shape), equations.information)


def _laid(basis: _Basis, nodes: Array, shape: tuple[int, ...]) -> Array:
    """Field (2, y, x) of nodes."""
    return np.stack([(basis.values @ part).reshape(shape) for part in np.split(nodes, 2)])


def _variances(basis: _Basis, covariance: Array, shape: tuple[int, ...]) -> Array:
    """Covariance (3, y, x) of the field at each pixel."""
    half, result = len(covariance) // 2, np.empty((3, basis.values.shape[0]))
    parts = (covariance[:half, :half], covariance[:half, half:], covariance[half:, half:])
    for start in range(0, result.shape[1], _PIXELS):
        rows = basis.values[start : start + _PIXELS]
        for out, part in zip(result, parts, strict=True):
            out[start : start + _PIXELS] = rows.multiply(rows @ part).sum(axis=1)
    return result.reshape(3, *shape)
