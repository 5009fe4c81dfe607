r"""Divisions of the time into pieces, of one pixel after another, compiled.

The object's curve is a polynomial in each piece, and free from one piece to the next. Any division
of the capture by repeated halving may be chosen; it is the one with the least description length

.. math:: L(v) = \sum_i \left[ \mathrm{tr} \, S_i - v^T S_i v \right] + c \, n \qquad (12)

of the n pieces i, with the scatter :math:`S_i` (eq. 3) of the signals in their plane, see
`pieces.plane`, outside the piece's polynomials: the energy across the background's axis v
in units of the noise, and a cost of each piece. In a plane the part across an axis is one number,
along its normal n: the energy is :math:`n^T S n`. Given the division, the axis is the principal one
of the sum of the scatters; given the axis, the best of all divisions is found from the shortest
pieces upwards (Donoho 1997, CART and best basis, doi:10.1214/aos/1069362377). Alternated from many
axes, this tells the rapid changes of the object, which lie along another line, from those of the
background: of two lines that explain the data the object's is the one with fewer pieces.

Halving makes more pieces than are needed: a change at a third of the time needs many. Of the ends
of pieces at hand the best are found by going through them in their order. A signal is summed up in
parts of the time by its products with the orthonormal polynomials of each part, :math:`c = Q^T z`,
and its energy beside them. The functions of a piece of several parts, polynomials and steps of the
camera, are combinations V of these, and what the piece leaves is the energy beside the parts'
polynomials and :math:`\min |c - V f|^2`, of a few equations instead of all frames. A part after
another is added to them by rotations.
"""

from collections.abc import Iterator
from functools import lru_cache
from math import acos, sqrt
from typing import Any, Final, NamedTuple

import numpy as np

from dbthermal import _smooth as smooth
from dbthermal._arrays import Array, Mask
from dbthermal.separation._subspace import kernels, pieces
from dbthermal.separation._subspace.kernels import compiled
from dbthermal.separation._tiles import Whole

_LONGEST: Final = 1024  # frames of a part, at most, whose polynomials stay in the cache
_FRAMES: Final = 2048  # frames whose functions are made in one matrix, of their number squared


class Tree(NamedTuple):
    """Pieces of all levels of halving, the whole first: those of piece i are 2 i + 1, 2 i + 2."""

    edges: Whole  # first frames of each piece, and the last one's end (piece, 2)
    columns: Whole  # number of its functions (piece)
    chosen: Whole  # number of functions by which pieces are chosen (piece)
    places: Whole  # of its first function among the values (piece)
    values: Array  # of functions: at the frames, or their products with those of both halves
    held: Whole  # of its first product among those of a pixel, and the last one's end (piece)
    starts: Whole  # pieces that give the axes to start from
    time: Array  # [s]
    event: Mask  # whether a shutter event comes before a frame (time)


class Joining(NamedTuple):
    """Work space of one pixel, to join its pieces."""

    begins: Whole  # first frames of the parts, and the end
    edges: Whole  # parts that pieces may begin with, and the end (edge)
    before: Whole  # edge before each one, of the least cost
    middle: Array  # of each part [s], half its length [s], and its energy beside polynomials (part)
    half: Array
    remainder: Array
    products: Array  # with the polynomials of each part (part, degree)
    centre: Array  # of each polynomial's square, in half lengths from the middle (part, degree)
    length: Array  # of each polynomial (part, degree)
    basis: Array  # (degree, time) of one part
    equations: Array  # triangle of the functions of a piece (function, function); the right side
    right: Array
    powers: Array  # of the time, of the polynomials of a part (power, degree)
    row: Array  # equation that is added (function)
    least: Array  # least cost up to each edge


class Scratch(NamedTuple):
    """Work space of one pixel."""

    across: Array  # (time)
    products: Array  # with all functions of the pieces (2, product)
    energy: Array  # first, mixed and last element of the scatter of each piece (3, piece)
    scatter: Array  # outside the functions by which is chosen, and those that are fitted
    fitted: Array
    axes: Array  # to start from (2, axis), and the weights of the elements of a scatter (3, axis)
    weights: Array
    least: Array  # cost of the best division of each piece (piece, axis)
    joined: Joining
    reached: Whole  # pieces whose halves may be used
    axis: Array  # axes, weights and costs as above, of a single axis
    weight: Array
    cheapest: Array
    taken: Array  # axes of divisions (division, 2), costs, and the frames that pieces begin with
    costs: Array
    begins: Mask  # (division, time)


def divide(white: Array, time: Array, segment: Whole | None, stated: Array) -> tuple[Mask, Array]:
    """Two divisions by axes that explain signals (2, time, pixel) of unit noise best, and costs."""
    tree = _tree(time.tobytes(), None if segment is None else segment.tobytes())
    frames, pixels = white.shape[1:]
    # The axis of a material may be stated (2, pixel), NaN for other pixels.
    count, axes = len(tree.edges), len(tree.starts) + bool(np.isfinite(stated).any())
    scratch = Scratch(
        across=np.empty(frames),
        products=np.empty((2, tree.held[-1])),
        energy=np.empty((3, count)),
        scatter=np.empty((3, count)),
        fitted=np.empty((3, count)),
        axes=np.empty((2, axes)),
        weights=np.empty((3, axes)),
        least=np.empty((count, axes)),
        joined=_joining(count // 2 + 1, tree.event),
        reached=np.empty(count, np.intp),
        axis=np.empty((2, 1)),
        weight=np.empty((3, 1)),
        cheapest=np.empty((count, 1)),
        taken=np.empty((pieces.AXES, 2)),
        costs=np.empty(pieces.AXES),
        begins=np.empty((pieces.AXES, frames), dtype=bool),
    )
    # Whether a piece begins with a frame, and the cost (eq. 12). The second division is that of the
    # other line, and costs more, infinitely if there is none.
    first, cost = np.empty((2, pixels, frames), dtype=bool), np.empty((2, pixels))
    rows = np.ascontiguousarray(white.transpose(2, 0, 1)), np.ascontiguousarray(stated.T)
    _divide(tree, *rows, scratch, first, cost)
    return first.mT, cost


def _joining(limit: int, event: Mask) -> Joining:
    """Work space for pieces that may begin with so many frames, at most."""
    events, degrees = int(event.sum()), pieces.FUNCTIONS
    count, functions = limit + events + event.size // _LONGEST, degrees + events
    counts = count + 1, limit + 1, limit + 1
    curves = count, count, count, (count, degrees), (count, degrees), (count, degrees)
    basis, equations = (degrees, _LONGEST), (functions, functions)
    shapes = *curves, basis, equations, functions, (degrees, degrees), functions, limit + 1
    arrays: list[Any] = [np.empty(count, np.intp) for count in counts]
    return Joining(*arrays, *(np.empty(shape) for shape in shapes))


@lru_cache(maxsize=4)
def _tree(times: bytes, events: bytes | None) -> Tree:
    """Pieces of each level of halving, down to those whose polynomial is any curve."""
    time = np.frombuffer(times)
    segment = np.zeros(time.size, np.intp) if events is None else np.frombuffer(events, np.intp)
    event = np.diff(segment, prepend=segment[0]) > 0
    levels = int(np.ceil(np.log2(time.size / smooth.PIECE_ORDER)))
    edges = np.round(np.linspace(0, time.size, 2**levels + 1)).astype(np.intp)
    # No piece begins at a shutter event.
    for place in np.flatnonzero(event):
        edges[1:-1][edges[1:-1] == place] += 1
    bounds = [edges[:: 2 ** (levels - level)] for level in range(levels + 1)]
    spans = np.concatenate([np.stack([bound[:-1], bound[1:]], 1) for bound in bounds])
    if event.any():
        pairs = [_functions(time[start:stop], segment[start:stop]) for start, stop in spans]
    else:
        pairs = [functions for bound in bounds for functions in _of_level(time, bound)]
    bases = [basis for basis, _ in pairs]
    values = [_values(bases, i) for i in range(len(bases))]
    sizes, columns = (np.array([*map(len, rows)]) for rows in (values, [b.T for b in bases]))
    starts = [np.arange(2**level - 1, 2 ** (level + 1) - 1) for level in pieces.STARTS]
    return Tree(
        edges=spans,
        columns=columns,
        chosen=np.array([chosen for _, chosen in pairs]),
        places=np.cumsum(sizes) - sizes,
        values=np.concatenate(values),
        held=np.append(0, np.cumsum(np.where(np.arange(len(pairs)) < len(pairs) // 2, columns, 0))),
        starts=np.concatenate([start for start in starts if start[-1] < len(pairs)]),
        time=time,
        event=event,
    )


def _of_level(time: Array, edges: Whole) -> Iterator[tuple[Array, int]]:
    """Yield the `_functions` of pieces without a shutter event, between edges; quicker together."""
    step = max(1, _FRAMES * (len(edges) - 1) // time.size)
    for group in range(0, len(edges) - 1, step):
        bounds, start = edges[group : group + step + 1], 0
        span = time[bounds[0] : bounds[-1]]
        first = np.isin(np.arange(bounds[0], bounds[-1]), bounds)
        columns = smooth.piecewise(span, first, np.empty((span.size, 0))).functions
        for begin, stop in zip(bounds[:-1] - bounds[0], bounds[1:] - bounds[0], strict=True):
            order = min(smooth.PIECE_ORDER, stop - begin)
            basis = np.ascontiguousarray(columns[begin:stop, start : start + order])
            yield basis, pieces.FUNCTIONS if stop - begin > smooth.PIECE_ORDER else order
            start += order


def _functions(time: Array, segment: Whole) -> tuple[Array, int]:
    """Functions of a piece (time, function), orthonormal, and how many are used to choose it."""
    steps = smooth.camera_steps(segment)
    order = max(1, min(smooth.PIECE_ORDER, time.size - len(steps)))
    basis = smooth.polynomial_basis(time, order)
    # Steps of the camera come first.
    functions = np.linalg.qr(np.column_stack([*steps, basis]))[0] if steps else basis
    return functions, len(steps) + (pieces.FUNCTIONS if time.size > smooth.PIECE_ORDER else order)


def _values(bases: list[Array], i: int) -> Array:
    """Functions (time, function) of a piece, one after another, as `_scatters` takes them."""
    basis, inner = bases[i], len(bases) // 2
    if i >= inner and basis.shape[0] == basis.shape[1]:  # any curve
        return np.empty(0)
    # Combinations of the halves' functions, except on the shortest pieces.
    if 2 * i + 1 < inner:
        earlier, later = bases[2 * i + 1 : 2 * i + 3]
        basis = np.concatenate([earlier.T @ basis[: len(earlier)], later.T @ basis[len(earlier) :]])
    return basis.T.ravel()


@compiled
def _axis(a: float, b: float, d: float) -> tuple[float, float, float]:
    """Principal axis of a scatter, and the energy along it."""
    largest = 0.5 * (a + d) + sqrt(0.25 * (a - d) ** 2 + b * b)
    x, y = (largest - d, b) if a >= d else (b, largest - a)
    length = sqrt(x * x + y * y)
    if length > 0.0:
        return x / length, y / length, largest
    return 0.0, 1.0, largest


@compiled
def _scatters(tree: Tree, scratch: Scratch, white: Array) -> None:
    """Scatter of each piece of signals (2, time), in place."""
    inner, energy, products = len(tree.edges) // 2, scratch.energy, scratch.products
    # From the shortest upwards: energies and products follow from those of a piece's halves.
    for i in range(len(tree.edges) - 1, -1, -1):
        start, stop = tree.edges[i]
        columns, free = tree.columns[i], tree.columns[i] < stop - start
        x, y = white[0, start:stop], white[1, start:stop]
        if 2 * i + 1 < inner:
            first, last = tree.held[2 * i + 1], tree.held[2 * i + 3]
            x, y = products[0, first:last], products[1, first:last]
            for k in range(3):
                energy[k, i] = energy[k, 2 * i + 1] + energy[k, 2 * i + 2]
        else:
            energy[0, i], energy[2, i] = kernels.dot(x, x), kernels.dot(y, y)
            energy[1, i] = kernels.dot(x, y)
        a, b, d = energy[0, i], energy[1, i], energy[2, i]
        for j in range(columns if free or i < inner else 0):
            if j == tree.chosen[i]:
                scratch.scatter[0, i], scratch.scatter[1, i], scratch.scatter[2, i] = a, b, d
            column = tree.values[tree.places[i] + j * x.size :]
            dot, cross = 0.0, 0.0
            for t in range(x.size):
                dot += column[t] * x[t]
                cross += column[t] * y[t]
            a, b, d = a - dot * dot, b - dot * cross, d - cross * cross
            if i < inner:
                products[0, tree.held[i] + j], products[1, tree.held[i] + j] = dot, cross
        if not free:  # any curve
            a, b, d = 0.0, 0.0, 0.0
        if tree.chosen[i] >= columns or not free:
            scratch.scatter[0, i], scratch.scatter[1, i], scratch.scatter[2, i] = a, b, d
        scratch.fitted[0, i], scratch.fitted[1, i], scratch.fitted[2, i] = a, b, d


@compiled
def _best(tree: Tree, scratch: Scratch, axes: Array, weights: Array, least: Array) -> None:
    """Cost of the best division of each piece by some axes (2, axis), in place (eq. 12)."""
    for j in range(axes.shape[1]):
        x, y = axes[0, j], axes[1, j]
        weights[0, j], weights[1, j], weights[2, j] = y * y, -2.0 * x * y, x * x
    inner = len(tree.edges) // 2
    for i in range(len(tree.edges) - 1, -1, -1):
        # The piece as it is, or its halves.
        a, b, d = scratch.scatter[0, i], scratch.scatter[1, i], scratch.scatter[2, i]
        price, result = pieces.COST * tree.chosen[i], least[i]
        for j in range(result.size):
            result[j] = weights[0, j] * a + weights[1, j] * b + weights[2, j] * d + price
        if i < inner:
            earlier, later = least[2 * i + 1], least[2 * i + 2]
            for j in range(result.size):
                result[j] = min(result[j], earlier[j] + later[j])


@compiled
def _chosen(tree: Tree, scratch: Scratch, begins: Mask) -> tuple[float, float, float]:
    """Sum of the fitted scatters of the best division's pieces, and the frames they begin with."""
    begins[:] = False
    a, b, d = 0.0, 0.0, 0.0
    reached, count = scratch.reached, 1
    reached[0] = 0
    inner, n, (p, q, r) = len(tree.edges) // 2, 0, scratch.weight[:, 0]
    while n < count:
        i = reached[n]
        # Halves that cost the same may be joined.
        price = p * scratch.scatter[0, i] + q * scratch.scatter[1, i] + r * scratch.scatter[2, i]
        price += pieces.COST * tree.chosen[i] + pieces.TIE
        if i < inner and scratch.cheapest[2 * i + 1, 0] + scratch.cheapest[2 * i + 2, 0] < price:
            reached[count], reached[count + 1] = 2 * i + 1, 2 * i + 2
            count += 2
        else:
            a += scratch.fitted[0, i]
            b += scratch.fitted[1, i]
            d += scratch.fitted[2, i]
            begins[tree.edges[i, 0]] = True
        n += 1
    return a, b, d


@compiled
def _refine(
    tree: Tree, scratch: Scratch, x: float, y: float, begins: Mask
) -> tuple[float, float, float]:
    """Axis and division in turns: the axis, and the energy along it."""
    energy = 0.0
    for _ in range(pieces.ROUNDS):
        scratch.axis[0, 0], scratch.axis[1, 0] = x, y
        _best(tree, scratch, scratch.axis, scratch.weight, scratch.cheapest)
        x, y, energy = _axis(*_chosen(tree, scratch, begins))
    return x, y, energy


@compiled
def _part(time: Array, curve: Array, scratch: Joining, number: int) -> None:
    """Sum up a curve in a part of the time, in place."""
    start, stop = scratch.begins[number], scratch.begins[number + 1]
    section, basis, size = curve[start:stop], scratch.basis, stop - start
    middle = 0.5 * (time[start] + time[stop - 1])
    half = time[stop - 1] - middle if size > 1 else 1.0
    scale, energy, a, b, before = 1.0 / half, kernels.dot(section, section), 0.0, 0.0, 1.0
    for k in range(pieces.FUNCTIONS):
        scratch.products[number, k], scratch.centre[number, k] = 0.0, 0.0
        scratch.length[number, k] = 0.0
        if k >= size:  # they are any curve
            energy = 0.0
            continue
        # Orthogonal polynomials: p_k = (x - a) p_k-1 - b p_k-2.
        previous, last = basis[max(k - 1, 0), :size], basis[max(k - 2, 0), :size]
        following, at, square, first, product = basis[k, :size], time[start:stop], 0.0, 0.0, 0.0
        for t in range(size):
            x = (at[t] - middle) * scale
            value = (x - a) * previous[t] - b * last[t] if k > 0 else 1.0
            following[t] = value
            square += value * value
            first += value * value * x
            product += value * section[t]
        energy -= product * product / square
        a, b, before = first / square, square / before if k > 0 else 0.0, square
        scratch.centre[number, k], scratch.length[number, k] = a, sqrt(square)
        scratch.products[number, k] = product / sqrt(square)
    scratch.middle[number], scratch.half[number] = middle, half
    scratch.remainder[number] = energy if size > pieces.FUNCTIONS else 0.0


@compiled
def _powers(scratch: Joining, number: int, end: float) -> None:
    """Powers of the time before an end [s], of a part's orthonormal polynomials q_j, in place.

    :math:`x q_j = g_{j+1} q_{j+1} + a_j q_j + g_j q_{j-1}`, with the length g_j of a polynomial
    over that of the one before.
    """
    powers, length, half = scratch.powers, scratch.length[number], scratch.half[number]
    for k in range(pieces.FUNCTIONS):
        for j in range(pieces.FUNCTIONS):
            value = length[0] if j == k == 0 else 0.0
            if 0 < j <= k and length[j] > 0.0:
                value = half * length[j] / length[j - 1] * powers[k - 1, j - 1]
            if j < k:
                centre = half * scratch.centre[number, j] + scratch.middle[number] - end
                value += centre * powers[k - 1, j]
            if j + 1 < k:
                value += half * length[j + 1] / length[j] * powers[k - 1, j + 1]
            powers[k, j] = value if length[j] > 0.0 else 0.0


@compiled
def _add(scratch: Joining, number: int, end: float, steps: int) -> float:
    """Add a part to the equations of a piece that ends at a time [s]; return the energy left."""
    matrix, right, row = scratch.equations, scratch.right, scratch.row
    energy, count = scratch.remainder[number], pieces.FUNCTIONS + steps
    _powers(scratch, number, end)
    for j in range(pieces.FUNCTIONS):
        for k in range(count):
            # A step of the camera that comes after the part is a constant over it.
            constant = scratch.powers[0, j]
            row[k] = scratch.powers[k, j] if k < pieces.FUNCTIONS else constant
        value = scratch.products[number, j]
        for k in range(count):
            if row[k] != 0.0:
                size = sqrt(matrix[k, k] ** 2 + row[k] ** 2)
                cosine, sine = matrix[k, k] / size, row[k] / size
                for column in range(k, count):
                    above, below = matrix[k, column], row[column]
                    matrix[k, column] = cosine * above + sine * below
                    row[column] = cosine * below - sine * above
                right[k], value = cosine * right[k] + sine * value, cosine * value - sine * right[k]
        energy += value * value
    return float(energy)


@compiled
def _split(event: Mask, scratch: Joining, begins: Mask) -> tuple[int, int]:
    """Parts of the time between first frames and steps of the camera: numbers of both."""
    begun, edges, count, pieces = scratch.begins, scratch.edges, 0, 0
    for t in range(begins.size):
        if begins[t]:
            edges[count] = pieces
            count += 1
        if begins[t] or event[t] or t - begun[max(pieces - 1, 0)] == _LONGEST:
            begun[pieces] = t
            pieces += 1
    edges[count], begun[pieces] = pieces, begins.size
    return count, pieces


@compiled
def _join(time: Array, event: Mask, across: Array, scratch: Joining, begins: Mask) -> float:
    """Keep the best of the first frames of pieces, in place; the cost (eq. 12)."""
    begun, edges, least, before = scratch.begins, scratch.edges, scratch.least, scratch.before
    count, count_of_pieces = _split(event, scratch, begins)
    for number in range(count_of_pieces):
        _part(time, across, scratch, number)
    least[0] = 0.0
    for stop in range(1, count + 1):
        least[stop], before[stop] = np.inf, 0
        scratch.equations[:], scratch.right[:] = 0.0, 0.0
        number, steps, remainder, end = edges[stop], 0, 0.0, begun[edges[stop]]
        for start in range(stop - 1, -1, -1):
            while number > edges[start]:
                steps += 1 if number < edges[stop] and event[begun[number]] else 0
                number -= 1
                remainder += _add(scratch, number, time[end - 1], steps)
            size = end - begun[number]
            functions = pieces.FUNCTIONS if size > smooth.PIECE_ORDER else size - steps
            energy = remainder if functions + steps < size else 0.0
            total = least[start] + energy + pieces.COST * (functions + steps)
            if total < least[stop] + pieces.TIE:
                least[stop], before[stop] = min(total, least[stop]), start
            # A longer piece leaves more than this one and the best before it. It costs no less, but
            # for the one function that the shortest pieces have more.
            if least[start] + energy > least[stop] + 1.5 * pieces.COST:
                break
    begins[:] = False
    at = count
    while at > 0:
        at = before[at]
        begins[begun[edges[at]]] = True
    return float(least[count])


@compiled
def _pixel(tree: Tree, scratch: Scratch, white: Array, axis: Array, begins: Mask) -> None:
    """Divisions by four axes, and their costs, in place; infinite for none."""
    axes, costs, taken, across = scratch.axes, scratch.costs, scratch.taken, scratch.across
    _scatters(tree, scratch, white)
    for i in range(len(tree.starts)):
        a, b, d = scratch.scatter[:, tree.starts[i]]
        axes[0, i], axes[1, i], _ = _axis(a, b, d)
    if axes.shape[1] > len(tree.starts):
        stated = not np.isnan(axis[0])
        axes[0, -1] = axis[0] if stated else axes[0, 0]
        axes[1, -1] = axis[1] if stated else axes[1, 0]
    _best(tree, scratch, axes, scratch.weights, scratch.least)
    angle, starting = 0.0, scratch.least[0]
    for number in range(pieces.AXES):
        place, lowest = 0, np.inf
        for i in range(axes.shape[1]):
            if starting[i] < lowest and not _near(axes[:, i], taken, number, angle):
                place, lowest = i, starting[i]
        x, y, energy = _refine(tree, scratch, axes[0, place], axes[1, place], begins[number])
        taken[number, 0], taken[number, 1] = x, y
        repeated = _near(taken[number], taken, number, angle)
        costs[number] = np.inf
        if not repeated and lowest < np.inf:
            for t in range(across.size):
                across[t] = y * white[0, t] - x * white[1, t]
            costs[number] = _join(tree.time, tree.event, across, scratch.joined, begins[number])
        # An axis with an energy E along it, in units of the noise, is known to 1 / sqrt(E).
        angle = pieces.APART / sqrt(energy)


@compiled
def _near(axis: Array, taken: Array, count: int, angle: float) -> bool:
    """Say whether an axis lies within an angle [rad] of an axis that is taken."""
    result = False
    for i in range(count):
        product = abs(axis[0] * taken[i, 0] + axis[1] * taken[i, 1])
        result |= acos(min(product, 1.0)) < angle
    return result


@kernels.entered
def _divide(
    tree: Tree, white: Array, stated: Array, scratch: Scratch, first: Mask, cost: Array
) -> None:
    """Divisions of all pixels of signals (pixel, 2, time)."""
    for p in range(len(white)):
        _pixel(tree, scratch, white[p], stated[p], scratch.begins)
        for rank in range(2):
            best = np.argmin(scratch.costs)
            cost[rank, p], scratch.costs[best] = scratch.costs[best], np.inf
            kernels.copy(scratch.begins[best], first[rank, p])
