r"""Splines over images: images moved to other places with their slopes, and displacement fields.

A field is a grid of cubic B-splines with nodes c. Data with information A about it, the penalty of
the second differences q of neighbouring nodes, and a wide prior of nodes and slopes, R, make

.. math:: (A + \lambda Q^T W Q + R) c = A c_0 + b

whose inverse matrix is the covariance. The penalty has the largest marginal likelihood (Patterson,
Thompson 1971, doi:10.1093/biomet/58.3.545); W lets the field bend sharply in few places, as from
one body to the next: differences follow Student's distribution, not a normal one.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.interpolate import BSpline
from scipy.linalg import block_diag, cho_solve, cholesky

from dbthermal._arrays import Array
from dbthermal._compiled import compiled
from dbthermal._samples import gaussian

Movie = npt.NDArray[np.float32]

_ROWS: Final = 4  # rows that are moved at a time, and stay in the cache
_EDGE: Final = 3  # pixels by which an image on splines is mirrored at its border
_VARIANCE: Final = 1.0 / 3.0  # of a cubic B-spline [pixel^2]
# Pixels between two nodes, at least, and nodes along the longer side, at most.
_SPACING, _NODES = 6.0, 13
_FREEDOM: Final = 3.0  # degrees of freedom of a bending's distribution
# Penalties that are tried, over the mean information of a node; and over the last one.
_PENALTIES: Final = 10.0 ** np.arange(-3.0, 5.0)
_STEPS: Final = np.array([0.4, 1.0, 2.5])
_SLOPE: Final = 0.1  # deviation of a field's slope without data, where it goes on level [1]


def binned(image: npt.NDArray[Any], factor: int) -> npt.NDArray[Any]:
    """Means (y, x, ...) over squares of pixels, in memory of their own."""
    rows, columns = (size // factor * factor for size in image.shape[:2])
    corners = [image[i:rows:factor, j:columns:factor] for i, j in np.ndindex(factor, factor)]
    return np.asarray(sum(corners[1:], corners[0]) * image.dtype.type(factor**-2))


def blurred(image: npt.NDArray[Any], width: float) -> npt.NDArray[Any]:
    """Image (y, x, ...) blurred by a Gaussian of a width [pixel], mirrored at the border."""
    rows, columns = (gaussian(size, width).astype(image.dtype) for size in image.shape[:2])
    down = (rows @ image.reshape(len(rows), -1)).reshape(*image.shape[:2], -1)
    return np.asarray((columns @ down).reshape(image.shape))


def splines(movie: Movie, width: float) -> Movie:
    """Coefficients of cubic B-splines that are a movie blurred by a width [pixel]."""
    # A B-spline blurs as well, by a part of the width: no filter undoes its blur.
    smooth = blurred(movie, float(np.sqrt(width**2 - _VARIANCE)))
    return np.pad(smooth, ((_EDGE, _EDGE), (_EDGE, _EDGE), (0, 0)), mode="symmetric")


def products(
    movie: Movie, movies: list[Movie], places: Array, weights: Movie, rate: Movie | None = None
) -> tuple[Array, Movie]:
    """Sums over planes (movie, y, x, pair) of the products of signals at places (2, y, x).

    Signals are the moved movie, of `splines`, its slopes down and right, and another movie, each
    with itself and all that follow: 10 pairs. With a matrix (plane, plane) of the rate of change
    the rate follows the slopes: 15 pairs. Events with weights (movie, y, x, event) take turns along
    the planes. Second, of each event the pairs (movie, y, x, 3, event) of the two movies.
    """
    (height, width), count = places.shape[1:], 4 if rate is None else 5
    result = np.empty((len(movies), height, width, count * (count + 1) // 2))
    number = weights.shape[3]
    events = np.empty((len(movies), height, width, 3, number), np.float32)
    for start in range(0, height, _ROWS):
        rows = slice(start, min(start + _ROWS, height))
        signals = sampled(movie, places[:, rows].reshape(2, -1) + _EDGE)
        if rate is not None:
            signals = np.concatenate([signals, (signals[0] @ rate)[np.newaxis]])
        signals = signals.reshape(count - 1, -1, width, signals.shape[2] // number, number)
        for place, target in enumerate(movies):
            arrays = weights[place, rows], result[place, rows], events[place, rows]
            _sum_pairs(signals, target[rows].reshape(signals.shape[1:]), *arrays)
    return result, events


def normal_equations(sums: Array, noise: Array) -> Array:
    """Normal equations A d = g (..., 4, 3) of steps down, right and in time, see `products`.

    Of sums (..., 15) over pixels, with a rate, less the noise's part (..., 4) of the squares of the
    moved movie and of its changes.
    """
    rows, columns = np.triu_indices(5)
    full = np.zeros((*sums.shape[:-1], 5, 5))
    full[..., rows, columns] = full[..., columns, rows] = sums
    places = np.arange(4)
    squares = full[..., places, places]
    # Half of a square, at most, is noise.
    full[..., places, places] -= np.minimum(noise, 0.5 * squares)
    size, cross = full[..., :1, :1], full[..., :1, 1:4]
    size = np.maximum(size, np.finfo(np.float64).tiny)
    # The ratio of the other movie to the moved one is eliminated.
    ratio = full[..., :1, 4:] / size
    tensor = ratio**2 * (full[..., 1:4, 1:4] - cross.mT * cross / size)
    force = ratio * (full[..., 4:, 1:4] - ratio * cross)
    return np.concatenate([tensor, force], axis=-2)


@compiled
def sampled(splines: Any, places: Array) -> Any:
    """Values, slopes over a pixel down and right (3, place, plane) of splines at rows, columns."""
    count, planes = places.shape[1], splines.shape[2]
    result = np.zeros((3, count, planes), splines.dtype)
    along, slope = np.empty(planes, splines.dtype), np.empty(planes, splines.dtype)
    start, weights = np.empty(2, np.intp), np.empty((2, 2, 5), splines.dtype)
    for p in range(count):
        for axis in range(2):
            low = int(np.floor(places[axis, p] - 0.5)) - 1
            start[axis] = min(max(low, 0), splines.shape[axis] - 5)
            for i in range(5):
                offset = start[axis] + i - places[axis, p]
                weights[axis, 0, i] = _cubic(offset)
                weights[axis, 1, i] = _cubic(offset - 0.5) - _cubic(offset + 0.5)
        for i in range(5):
            along[:] = 0.0
            slope[:] = 0.0
            for j in range(5):
                value, steep = weights[1, 0, j], weights[1, 1, j]
                pixel = splines[start[0] + i, start[1] + j]
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
def _cubic(offset: float) -> float:
    """Cubic B-spline at a distance from its middle [pixel]."""
    distance = abs(offset)
    return (max(2.0 - distance, 0.0) ** 3 - 4.0 * max(1.0 - distance, 0.0) ** 3) / 6.0


@compiled
def _sum_pairs(signals: Movie, target: Movie, weights: Movie, sums: Array, events: Movie) -> None:
    """Sums over planes of the products of signals (signal, y, x, turn, event), in place."""
    count, height, width, turns, number = signals.shape
    products = np.empty(number, signals.dtype)
    for y, x in np.ndindex(height, width):
        pair = 0
        for i in range(count + 1):
            first = signals[i, y, x] if i < count else target[y, x]
            for j in range(i, count + 1):
                second = signals[j, y, x] if j < count else target[y, x]
                products[:] = 0.0
                for turn in range(turns):
                    for event in range(number):
                        products[event] += first[turn, event] * second[turn, event]
                sums[y, x, pair] = 0.0
                for event in range(number):
                    sums[y, x, pair] += products[event] * weights[y, x, event]
                if i in (0, count) and j in (0, count):
                    events[y, x, (i + j) // count] = products
                pair += 1


@dataclass(frozen=True)
class Information:
    """Information on a step of a field: A as its three numbers (3, y, x), and b (2, y, x)."""

    tensor: Array  # of rows, of rows with columns, of columns [1/pixel^2]
    gradient: Array  # [1/pixel]


@dataclass(frozen=True)
class Spline:
    """Grid of nodes over an image of so many rows and columns, and its wide prior [pixel]."""

    shape: tuple[int, int]
    prior: float

    @cached_property
    def nodes(self) -> tuple[int, int]:
        """Nodes along either side."""
        spacing = max(_SPACING, max(self.shape) / _NODES)
        rows, columns = (max(2, int(np.ceil((size - 1) / spacing)) + 1) + 2 for size in self.shape)
        return rows, columns

    @cached_property
    def _differences(self) -> list[list[Array]]:
        """Differences of order 0, 1 and 2 of the nodes along either side."""
        return [
            [np.diff(np.eye(count), order, axis=0) for order in (0, 1, 2)] for count in self.nodes
        ]

    @cached_property
    def bending(self) -> sparse.csr_array:
        """Second differences of the nodes: down, right, and twice the mixed one."""
        (row, *rows), (column, *columns) = self._differences
        mixed = np.sqrt(2.0) * np.kron(rows[0], columns[0])
        terms = [np.kron(rows[1], column), np.kron(row, columns[1]), mixed]
        return sparse.csr_array(np.concatenate(terms))

    @cached_property
    def before(self) -> Array:
        """Information (node, node) before there are data: on each node, and on a level field."""
        (row, down, _), (column, right, _) = self._differences
        height, width = (np.array(self.shape) - 1) / (np.array(self.nodes) - 3)
        level = np.kron(down.T @ down, column) / height**2
        level += np.kron(row, right.T @ right) / width**2
        return np.asarray(np.eye(len(level)) / self.prior**2 + level / _SLOPE**2)

    def values(self, centres: list[Array]) -> list[Array]:
        """Splines (place, node) at rows and at columns."""
        values = []
        for places, size, count in zip(centres, self.shape, self.nodes, strict=True):
            knots, inner = np.arange(count + 4) - 3.0, places / (size - 1) * (count - 3)
            values.append(BSpline.design_matrix(inner, knots, 3).toarray())
        return values

    def fitted(
        self, data: Information, centres: list[Array], guess: "Field | None" = None
    ) -> "Field":
        """Field of information at places, which is on steps from another field, or from 0."""
        rows, columns = self.values(centres)
        matrix = _normal(data.tensor, rows, columns)
        target = np.concatenate([(rows.T @ array @ columns).ravel() for array in data.gradient])
        bends = self.bending
        sharp, trials = np.ones((2, bends.shape[0])), np.trace(matrix) / len(matrix) * _PENALTIES
        if guess is not None:
            target += matrix @ guess.nodes
            steps = _STEPS[1:2] if guess.settled else _STEPS
            sharp, trials = guess.sharpness, guess.penalty * steps
        best = -np.inf
        blocks = np.stack([(bends.T @ (bends * row[:, np.newaxis])).toarray() for row in sharp])
        for trial in trials:
            # log p = (log |lambda P + R| - log |A + lambda P + R| + target' c) / 2
            before = block_diag(*(trial * blocks + self.before))
            trial_factor = cholesky(matrix + before, lower=True)
            trial_nodes, likelihood = cho_solve((trial_factor, True), target), np.inf
            if trials.size > 1:
                factors = cholesky(before, lower=True), trial_factor
                logs = [np.log(np.diagonal(array)).sum() for array in factors]
                likelihood = 2.0 * (logs[0] - logs[1]) + target @ trial_nodes
            if likelihood > best:
                best, penalty, factor, nodes = likelihood, trial, trial_factor, trial_nodes
        squares = np.stack([(bends @ array) ** 2 for array in np.split(nodes, 2)])
        sharp = (_FREEDOM + 1.0) / (_FREEDOM + penalty * squares)
        settled = guess is not None and penalty == guess.penalty
        return Field(self, nodes, factor, float(penalty), sharp, settled)


@dataclass(frozen=True)
class Field:
    """Nodes (rows', then columns') [pixel] of a displacement field, and their information."""

    spline: Spline
    nodes: Array
    factor: Array  # of the information, by Cholesky
    penalty: float
    sharpness: Array  # weight of each bending (2, bending) [1]
    settled: bool  # the penalty is better than the penalties near it

    def on(self, centres: list[Array]) -> Array:
        """Displacement (2, y, x) [pixel] at rows and columns."""
        rows, columns = self.spline.values(centres)
        nodes = self.nodes.reshape(2, *self.spline.nodes)
        return np.stack([rows @ plane @ columns.T for plane in nodes])

    def variances(self, centres: list[Array]) -> Array:
        """Variance (2, y, x) of the displacement at each place [pixel^2]."""
        rows, columns = (_pairs(pair) for pair in self.spline.values(centres))
        height, width = self.spline.nodes
        covariance = cho_solve((self.factor, True), np.eye(self.nodes.size))
        blocks = covariance.reshape(2, height, width, 2, height, width)
        planes = [blocks[axis, :, :, axis].transpose(0, 2, 1, 3) for axis in (0, 1)]
        return np.stack([rows @ plane.reshape(height**2, width**2) @ columns.T for plane in planes])


def _pairs(values: Array) -> Array:
    """Products of all pairs of splines (place, node * node)."""
    return (values[:, :, np.newaxis] * values[:, np.newaxis]).reshape(len(values), -1)


def _normal(tensor: Array, rows: Array, columns: Array) -> Array:
    """Normal matrix of the nodes, of rows and then of columns, from the tensors of the pixels."""
    (height, width), blocks = (rows.shape[1], columns.shape[1]), []
    for block in tensor:
        sums = (_pairs(rows).T @ block @ _pairs(columns)).reshape(height, height, width, width)
        blocks.append(sums.transpose(0, 2, 1, 3).reshape(height * width, -1))
    return np.block([[blocks[0], blocks[1]], [blocks[1], blocks[2]]])
