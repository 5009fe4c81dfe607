"""Smooth subspace of time: the curves that a slowly changing object temperature can take.

Orthonormal polynomials over the time stamps, nested, so that one set of coefficients gives the fit
of every order; of an object that changes rapidly now and then, in pieces of the time.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.linalg import svd

from dbthermal._arrays import Array, Mask, stretches
from dbthermal._compiled import compiled

Whole = npt.NDArray[np.intp]

HIGHEST_ORDER: Final = 14  # of a smooth subspace that data may choose
PIECE_ORDER: Final = 5  # number of polynomials in a piece of time
# Of slow noise: powers of time's functions, and white noise over it.
_POWERS, _WHITES = np.linspace(0.0, 2.0, 9), (0.0, 0.1, 1.0, 10.0)
# Functions that a change point costs as much as: to choose where the polynomial changes fits noise,
# too (Ninomiya 2015, doi:10.1007/s10463-014-0481-x). Half of them on either side.
CHANGE_POINT: Final = 3.0
# Share of a polynomial that is new beside those of lower degree, below which it is rounding [1].
_ROUNDED: Final = 1e-6
_FOR_EACH: Final = 8  # pixels of which a function of what changes is made


@dataclass(frozen=True)
class Subspace:
    """Functions of time that are projected out of a signal, nested by order."""

    functions: Array  # (time, steps + order), orthonormal: constant, steps, rising polynomials
    object_part: Array  # `functions` less the steps of the camera in them
    steps: int  # columns of every order, beside the constant
    rising: Array  # polynomials (time, degree) from 1 up, less the steps of the camera
    pieces: npt.NDArray[np.intp] | None = None  # frames with a column, if not all (column, 2)
    of_pieces: Array | None = None  # leverage (time, 1) of pieces of one order, see `piecewise`

    @property
    def orders(self) -> int:
        """Largest order."""
        return int(self.functions.shape[1]) - self.steps

    @property
    def spans(self) -> npt.NDArray[np.intp]:
        """First frame with each column, and the end (column, 2)."""
        frames, columns = self.functions.shape
        return np.full((columns, 2), [0, frames]) if self.pieces is None else self.pieces

    @cached_property
    def leverage(self) -> Array:
        r"""Variance :math:`\sum_i \Phi_i(t)^2` (time, order) of fits to white noise of 1."""
        if self.of_pieces is not None:
            return self.of_pieces
        result = np.zeros_like(self.object_part.T[self.steps :])
        for column, (start, stop) in enumerate(self.spans):
            result[max(column - self.steps, 0) :, start:stop] += (
                self.object_part[start:stop, column] ** 2
            )
        return result.T


def leading(samples: npt.NDArray[Any], count: int, slow: Array | None = None) -> Array:
    """Orthonormal functions (time, function) of most of samples (pixel, time), less slow ones."""
    sample = np.asarray(samples[:: max(1, len(samples) // (_FOR_EACH * count))], np.float64)
    sample = sample if slow is None else sample - sample @ slow @ slow.T
    if len(sample) < sample.shape[1]:
        # LAPACK's default algorithm, gesdd, does not converge on some samples that are finite.
        sizes, functions = svd(sample, full_matrices=False, lapack_driver="gesvd")[1:]
    else:
        squares, functions = (array.T[::-1] for array in np.linalg.eigh(sample.T @ sample))
        sizes = np.sqrt(squares.clip(0.0))
    # Of what was projected out rounding is left, 1e-8 of the largest; noise of 1 mK is 1e-5.
    number = max(1, np.count_nonzero(sizes > _ROUNDED * sizes.max(initial=0.0)))
    return np.asarray(functions[: min(count, number)].T)


def subspace(
    time: npt.ArrayLike, order: int, *, segment: npt.NDArray[np.integer] | None = None
) -> Subspace:
    """Smooth functions of an order over times (time,) [s], with a step for each shutter event."""
    # A step where `segment` (time) changes, the number of shutter events before, is the camera's.
    plain, steps = np.asfortranarray(polynomial_basis(time, order)), camera_steps(segment)
    if not steps:
        return Subspace(plain, plain, 0, plain[:, 1:])
    if order + len(steps) > len(plain):
        message = f"Invalid order {order} with {len(steps)} steps over {len(plain)} frames"
        raise ValueError(f"{message}. Must not be more functions than frames.")
    columns = np.column_stack([plain[:, :1], *steps, plain[:, 1:]])
    # QR makes the columns orthonormal, F = Q R; the object's part of Q is F R^-1 with the camera's
    # columns of F set to zero.
    functions, triangle = np.linalg.qr(columns)
    columns[:, 1 : 1 + len(steps)] = 0.0
    object_part = np.linalg.solve(triangle.T, columns.T).T
    return Subspace(functions, object_part, len(steps), functions[:, len(steps) + 1 :])


def largest(
    time: npt.NDArray[np.floating], segment: npt.NDArray[np.integer] | None = None
) -> Subspace:
    """Largest smooth subspace that data may choose, see `subspace`."""
    return subspace(time, min(HIGHEST_ORDER, time.size // 4), segment=segment)


def rapid(time: Array) -> tuple[Array, int]:
    """Functions (time, function) three octaves above the smooth ones, and the number of these."""
    first = min(HIGHEST_ORDER, time.size // 4)
    return polynomial_basis(time, min(8 * first, 3 * time.size // 4))[:, first:], first


def energy_below(squares: Array, first: int) -> Array:
    """Expected sum of squares below the `first` function, of those above (function, direction).

    Variances are A (j^-b + r) in function j: white noise to a random walk, b = 2, by likelihood.
    """
    order = np.arange(1.0, first + len(squares))
    shapes = np.array([order**-b + r * first**-b for b in _POWERS for r in _WHITES])
    below, above = np.split(shapes, [first - 1], axis=1)
    size = np.mean(squares / above[..., np.newaxis], axis=1) + np.finfo(float).tiny
    likely = -0.5 * (np.log(above).sum(axis=1)[:, np.newaxis] + len(squares) * np.log(size))
    weights = np.exp(likely - likely.max(axis=0))
    return np.asarray(np.average(size * below.sum(axis=1, keepdims=True), 0, weights))


def piecewise(
    time: npt.ArrayLike,
    first: Mask,
    rising: Array,
    *,
    segment: npt.NDArray[np.integer] | None = None,
    number: int = PIECE_ORDER,
) -> Subspace:
    """Polynomials, `number` at most, in each piece of the time between `first` frames (time,)."""
    time = np.asarray(time, dtype=np.float64)
    if segment is not None and segment[0] == segment[-1]:  # it only rises
        segment = None
    edges = np.append(np.flatnonzero(first), time.size)
    # No piece may begin with a shutter event: its step would be the object's as well.
    events = np.zeros(edges.size - 1, dtype=np.intp)
    if segment is not None:
        rises = (np.diff(segment, prepend=segment[0]) > 0) & ~first
        events = np.add.reduceat(rises.astype(np.intp), edges[:-1])
    counts, steps = np.minimum(number, np.diff(edges) - events), camera_steps(segment)
    # A column after another, of which a piece fills a part.
    size = int(counts.sum())
    columns = np.zeros((size + len(steps), time.size))
    spans = np.empty((len(columns), 2), dtype=np.intp)
    chosen, leverage = np.empty((2, time.size, 1))
    _polynomials(time, edges, counts, columns, spans, chosen, leverage)
    functions = object_part = columns.T
    if steps:
        # The pieces' polynomials P are orthonormal: [P, C] = Q R with Q = [P, S], of the camera's
        # steps C. What P leaves of these, C - P P^T C = S R, lies in the pieces with an event. The
        # object's part of S is that less the camera's, S - C R^-1.
        uneven = np.flatnonzero(events)
        span = slice(edges[uneven[0]], edges[uneven[-1] + 1])
        places = np.append(0, np.cumsum(counts))
        plain = functions[span, places[uneven[0]] : places[uneven[-1] + 1]]
        camera = np.stack(steps)
        remainder = camera[:, span].T - plain @ (plain.T @ camera[:, span].T)
        remainder -= plain @ (plain.T @ remainder)  # once more, against rounding
        basis, triangle = np.linalg.qr(remainder)
        columns[size:, span] = basis.T
        with_object = columns.copy()
        with_object[size:] -= np.linalg.solve(triangle.T, camera)
        leverage += chosen * (with_object[size:].T ** 2).sum(axis=1, keepdims=True)
        # Four columns are taken together, from the first one's begin to the last one's end.
        spans[size:, 0], tail = span.start, spans[max(size - 3, 0) :]
        tail[:, 0], tail[:, 1] = np.minimum(tail[:, 0], span.start), time.size
        object_part = with_object.T
    return Subspace(functions, object_part, len(columns) - 1, rising, spans, leverage)


@compiled
def _make_orthonormal(columns: Array, degree: int, start: int, stop: int) -> None:
    """Make a column (column, time) orthogonal to those before it and of length 1, in place."""
    column = columns[degree, start:stop]
    for _ in range(2):  # once more, against rounding
        for k in range(degree):
            previous = columns[k, start:stop]
            product = 0.0
            for t in range(column.size):
                product += previous[t] * column[t]
            for t in range(column.size):
                column[t] -= product * previous[t]
    square = 0.0
    for t in range(column.size):
        square += column[t] ** 2
    length = np.sqrt(square)
    for t in range(column.size):
        column[t] /= length


@compiled
def _polynomials(
    time: Array,
    edges: Whole,
    counts: Whole,
    columns: Array,
    spans: Whole,
    chosen: Array,
    leverage: Array,
) -> None:
    """Fill columns (column, time) of zeros with the polynomials of pieces, and their leverage."""
    column = 0
    for piece in range(counts.size):
        start, stop, count = edges[piece], edges[piece + 1], counts[piece]
        middle = 0.5 * (time[start] + time[stop - 1])
        ends = (1.0 if piece > 0 else 0.0) + (1.0 if piece < counts.size - 1 else 0.0)
        # An end of a piece that was chosen from the data raises the leverage, see `CHANGE_POINT`.
        factor = 1.0 + 0.5 * CHANGE_POINT * ends / count
        chosen[start:stop] = factor
        at, total = time[start:stop], leverage[start:stop, 0]
        total[:] = 0.0
        for degree in range(count):
            polynomial = columns[column + degree, start:stop]
            before = columns[column + max(degree - 1, 0), start:stop]
            for t in range(polynomial.size):
                polynomial[t] = (at[t] - middle) * before[t] if degree > 0 else 1.0
            _make_orthonormal(columns[column:], degree, start, stop)
            for t in range(polynomial.size):
                total[t] += factor * polynomial[t] ** 2
            spans[column + degree, 0], spans[column + degree, 1] = start, stop
        column += count


def camera_steps(segment: npt.NDArray[np.integer] | None) -> list[Array]:
    """Steps (time,) of the camera, one for each shutter event between the frames."""
    if segment is None:
        return []
    return [np.where(segment >= number, 1.0, 0.0) for number in np.unique(segment)[1:]]


def polynomial_basis(time: npt.ArrayLike, order: int) -> Array:
    r"""Orthonormal polynomials over given times, the discrete Legendre polynomials.

    Column j (..., time, order) is a polynomial of degree j, and :math:`\Phi^T \Phi = 1`. The times
    (..., time) [s] increase, and are at least as many as the functions, or a ValueError.
    """
    time = np.asarray(time, dtype=np.float64)
    frames = time.shape[-1]
    if not 1 <= order <= frames:
        rule = f"Must lie in [1, {frames}], the number of frames"
        raise ValueError(f"Invalid order {order} of the smooth subspace. {rule}.")
    span = time[..., -1:] - time[..., :1] if frames > 1 else 1.0
    position = 2.0 * (time - time[..., :1]) / span - 1.0
    columns, triangle = np.linalg.qr(np.polynomial.legendre.legvander(position, order - 1))
    size = np.abs(np.einsum("...jj->...j", triangle))
    for place in np.argwhere(size.min(axis=-1) <= _ROUNDED * size.max(axis=-1)):
        columns[tuple(place)] = _arnoldi(position[tuple(place)], order)
    return np.asarray(columns)


def _arnoldi(position: Array, order: int) -> Array:
    """Columns of `polynomial_basis`, where frames in few places make them nearly dependent."""
    columns = np.full((position.size, order), 1.0 / np.sqrt(position.size))
    for degree in range(1, order):
        # The previous function times the position, made orthogonal (Brubeck, Nakatsukasa,
        # Trefethen 2021, doi:10.1137/19M130839X).
        following = position * columns[:, degree - 1]
        for _ in range(2):  # once more, against rounding
            previous = columns[:, :degree]
            following = following - previous @ (previous.T @ following)
        columns[:, degree] = following / np.linalg.norm(following)
    return columns


def bridge(film: npt.NDArray[Any], pixels: Mask) -> npt.NDArray[Any]:
    """Fill missing samples of some pixels of a film (time, pixel) by lines, in place; return it."""
    last = np.full(pixels.size, -1)
    for frames in stretches(film):
        _bridge(film, frames.start, min(frames.stop, len(film)), pixels, last)
    # A curve ends as its last number.
    for pixel in np.flatnonzero(pixels & (last >= 0) & (last < len(film) - 1)):
        film[last[pixel] + 1 :, pixel] = film[last[pixel], pixel]
    return film


@compiled
def _bridge(film: Any, start: int, stop: int, pixels: Mask, last: Any) -> None:
    """Fill the gaps that end in some frames, in place, and note the last frame with a number."""
    for frame in range(start, stop):
        for pixel in range(pixels.size):
            if not pixels[pixel] or not np.isfinite(film[frame, pixel]):
                continue
            before = last[pixel]
            if before < frame - 1:
                # A curve begins as its first number.
                first = film[before if before >= 0 else frame, pixel]
                slope = (np.float64(film[frame, pixel]) - first) / (frame - before)
                for place in range(before + 1, frame):
                    film[place, pixel] = slope * (place - before) + first
            last[pixel] = frame
