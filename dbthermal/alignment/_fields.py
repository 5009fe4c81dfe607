r"""Smooth displacement field, of which bending is penalised as far as the data do not ask for it.

A grid of cubic B-splines with nodes c. Data with information A about it, the penalty of the second
differences q of neighbouring nodes, and a wide prior make

.. math:: (A + \lambda Q^T W Q + R) c = A c_0 + b

whose inverse matrix is the covariance. The penalty has the largest marginal likelihood (Patterson,
Thompson 1971, doi:10.1093/biomet/58.3.545); W lets the field bend sharply in few places, as from
one body to the next: differences follow Student's distribution, not a normal one.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.linalg import block_diag, cho_factor, cho_solve

Array = npt.NDArray[np.float64]

# Pixels between two nodes, at least, and nodes along the longer side, at most.
_SPACING: Final = 6.0
_NODES: Final = 18
# Degrees of freedom of a bending's distribution.
_FREEDOM: Final = 3.0
# Penalties that are tried, over the mean information of a node; and over the last one.
_PENALTIES: Final = 10.0 ** np.arange(-3.0, 5.0)
_STEPS: Final = np.array([0.4, 1.0, 2.5])


def weights(offset: Array) -> tuple[Array, Array]:
    """Cubic B-spline and its slope (4, ...) at the four nodes about a place between two, 0 to 1."""
    u = offset
    value = [(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3]
    slope = [-((1 - u) ** 2), 3 * u**2 - 4 * u, -3 * u**2 + 2 * u + 1, u**2]
    return np.stack(value) / 6.0, np.stack(slope) / 2.0


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
    def bending(self) -> sparse.csr_array:
        """Second differences of the nodes: down, right, and twice the mixed one."""
        first, second = (
            [np.diff(np.eye(n), order, axis=0) for n in self.nodes] for order in (1, 2)
        )
        one = [np.eye(n) for n in self.nodes]
        parts = [
            np.kron(second[0], one[1]),
            np.kron(one[0], second[1]),
            np.sqrt(2.0) * np.kron(first[0], first[1]),
        ]
        return sparse.csr_array(np.concatenate(parts))

    def values(self, centres: list[Array]) -> list[Array]:
        """Splines (place, node) at rows and at columns."""
        result = []
        for place, size, count in zip(centres, self.shape, self.nodes, strict=True):
            along = place / (size - 1) * (count - 3)
            low = np.clip(np.floor(along), 0, count - 4)
            matrix = np.zeros((place.size, count))
            rows = np.arange(place.size)
            for step, part in enumerate(weights(along - low)[0]):
                matrix[rows, low.astype(np.intp) + step] = part
            result.append(matrix)
        return result

    def fitted(
        self, data: Information, centres: list[Array], around: "Field | None" = None
    ) -> "Field":
        """Field of information at places, which is on steps from another field, or from 0."""
        values = self.values(centres)
        matrix = _normal(data.tensor, values)
        target = np.concatenate([_projected(part, values) for part in data.gradient])
        bends = self.bending
        sharp, trials = np.ones((2, bends.shape[0])), np.trace(matrix) / len(matrix) * _PENALTIES
        if around is not None:
            target += matrix @ around.nodes
            sharp, trials = around.sharpness, around.penalty * _STEPS
        ridge = np.eye(len(matrix)) / self.prior**2
        blocks = [(bends.T @ (bends * part[:, np.newaxis])).toarray() for part in sharp]
        bending, best = block_diag(*blocks), -np.inf
        for trial in trials:
            # log p = (log |lambda P + R| - log |A + lambda P + R| + target' c) / 2
            trial_factor = cho_factor(matrix + trial * bending + ridge)
            trial_nodes = cho_solve(trial_factor, target)
            before = np.linalg.cholesky(trial * bending + ridge)
            logs = [2.0 * np.sum(np.log(np.diag(part))) for part in (before, trial_factor[0])]
            likelihood = logs[0] - logs[1] + target @ trial_nodes
            if likelihood > best:
                best, penalty, factor, nodes = likelihood, trial, trial_factor, trial_nodes
        squares = np.stack([(bends @ part) ** 2 for part in np.split(nodes, 2)])
        sharp = (_FREEDOM + 1.0) / (_FREEDOM + penalty * squares)
        covariance = cho_solve(factor, np.eye(len(matrix)))
        return Field(self, nodes, covariance, float(penalty), sharp)


@dataclass(frozen=True)
class Field:
    """Nodes (rows', then columns') [pixel] of a displacement field, and their covariance."""

    spline: Spline
    nodes: Array
    covariance: Array
    penalty: float
    sharpness: Array  # weight of each bending (2, bending) [1]

    def on(self, centres: list[Array]) -> Array:
        """Displacement (2, y, x) [pixel] at rows and columns."""
        rows, columns = self.spline.values(centres)
        parts = self.nodes.reshape(2, *self.spline.nodes)
        return np.stack([rows @ part @ columns.T for part in parts])

    def variances(self, centres: list[Array]) -> Array:
        """Covariance (3, y, x) of the displacement at each place [pixel^2]."""
        rows, columns = (_pairs(part) for part in self.spline.values(centres))
        height, width = self.spline.nodes
        half = height * width
        parts = [(0, 0), (0, half), (half, half)]
        result = []
        for i, j in parts:
            square = self.covariance[i : i + half, j : j + half]
            block = square.reshape(height, width, height, width).transpose(0, 2, 1, 3)
            pairs = block.reshape(height**2, width**2)
            result.append(rows @ pairs @ columns.T)
        return np.stack(result)


def _pairs(values: Array) -> Array:
    """Products of all pairs of splines (place, node * node)."""
    return (values[:, :, np.newaxis] * values[:, np.newaxis]).reshape(len(values), -1)


def _projected(image: Array, values: list[Array]) -> Array:
    """Sums of an image (y, x) over each spline (node)."""
    return np.asarray(values[0].T @ image @ values[1]).ravel()


def _normal(tensor: Array, values: list[Array]) -> Array:
    """Normal matrix of the nodes, of rows and then of columns, from the tensors of the pixels."""
    rows, columns = (_pairs(part) for part in values)
    height, width = (part.shape[1] for part in values)
    blocks = []
    for part in tensor:
        sums = (rows.T @ part @ columns).reshape(height, height, width, width)
        blocks.append(sums.transpose(0, 2, 1, 3).reshape(height * width, -1))
    return np.block([[blocks[0], blocks[1]], [blocks[1], blocks[2]]])
