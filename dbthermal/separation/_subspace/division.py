"""Divisions of the time into pieces, of one pixel of two bands after another, compiled.

The equations and choices of `pieces.divide`. In two bands the part of a signal across an axis v is
one number, along the normal n: of a scatter the energy :math:`n^T S n`.
"""

from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from math import acos, sqrt
from typing import Final, NamedTuple

import numpy as np

from dbthermal import _smooth as smooth
from dbthermal._arrays import Array, Mask
from dbthermal.separation._subspace import kernels, pieces
from dbthermal.separation._subspace.kernels import compiled
from dbthermal.separation._tiles import Whole

_ROUNDED: Final = 1e-9  # an energy, or a part of one, that is rounding


class Tree(NamedTuple):
    """Pieces of all levels of halving, the whole first: those of piece i are 2 i + 1, 2 i + 2."""

    edges: Whole  # first frames of each piece, and the last one's end (piece, 2)
    columns: Whole  # number of its functions (piece)
    chosen: Whole  # of these, by which is chosen (piece)
    places: Whole  # of its first function among the values (piece)
    values: Array  # of all functions of all pieces
    starts: Whole  # pieces that give the axes to start from
    time: Array  # [s]
    event: Mask  # whether a shutter event comes before a frame (time)


class Scratch(NamedTuple):
    """Work space of one pixel."""

    white: Array  # whitened signals (2, time)
    across: Array  # (time)
    scatter: Array  # outside the functions by which is chosen (piece, 3), and those that are fitted
    fitted: Array
    axes: Array  # to start from (2, axis)
    least: Array  # cost of the best division of a piece (piece, axis)
    halved: Mask  # (piece)
    starting: Array  # cost of the best division (axis)
    basis: Array  # functions of a joined piece (function, time), and their squared lengths
    lengths: Array
    joined: Whole  # first frames of pieces, and the end; costs, and the piece before
    cheapest: Array
    before: Whole
    taken: Array  # axes of divisions (division, 2), costs, and the frames that pieces begin with
    costs: Array
    begins: Mask  # (division, time)


def divide(
    signals: Array, time: Array, noise: Array, segment: Whole | None, known: Array | None = None
) -> list[pieces.Division]:
    """As `pieces.divide`, of two bands."""
    tree = _packed(time.tobytes(), None if segment is None else segment.tobytes())
    frames, pixels = signals.shape[1:]
    count, axes = len(tree.edges), len(tree.starts) + (known is not None)
    functions = smooth.PIECE_ORDER + int(tree.event.sum())
    scratch = Scratch(
        white=np.empty((2, frames)),
        across=np.empty(frames),
        scatter=np.empty((count, 3)),
        fitted=np.empty((count, 3)),
        axes=np.empty((2, axes)),
        least=np.empty((count, axes)),
        halved=np.empty(count, dtype=bool),
        starting=np.empty(axes),
        basis=np.empty((functions, frames)),
        lengths=np.empty(functions),
        joined=np.empty(frames + 1, np.intp),
        cheapest=np.empty(max(count, frames + 1)),
        before=np.empty(frames + 1, np.intp),
        taken=np.empty((pieces.AXES, 2)),
        costs=np.empty(pieces.AXES),
        begins=np.empty((pieces.AXES, frames), dtype=bool),
    )
    ratio = np.full(pixels, np.nan) if known is None else np.ascontiguousarray(known[1])
    first, cost = np.zeros((2, frames, pixels), dtype=bool), np.empty((2, pixels))
    _divide(tree, np.ascontiguousarray(signals), noise, ratio, scratch, first, cost)
    return [pieces.Division(*one) for one in zip(first, cost, strict=True)]


@lru_cache(maxsize=4)
def _packed(times: bytes, events: bytes | None) -> Tree:
    levels, time = pieces.tree(times, events)[1], np.frombuffer(times)
    every = [piece for level in levels for piece in level]
    sizes = np.array([basis.size for _, basis, _ in every])
    begun = [np.arange(2**level - 1, 2 ** (level + 1) - 1) for level in pieces.STARTS]
    event = np.zeros(time.size, dtype=bool)
    if events is not None:
        event[1:] = np.diff(np.frombuffer(events, dtype=np.intp)) > 0
    return Tree(
        edges=np.array([(inside.start, inside.stop) for inside, _, _ in every]),
        columns=np.array([basis.shape[1] for _, basis, _ in every]),
        chosen=np.array([chosen for _, _, chosen in every]),
        places=np.cumsum(sizes) - sizes,
        values=np.concatenate([basis.T.ravel() for _, basis, _ in every]),
        starts=np.concatenate([one for one in begun if one[-1] < len(every)]),
        time=time,
        event=event,
    )


@compiled
def _axis(a: float, b: float, d: float) -> tuple[float, float, float]:
    """Principal axis of a scatter, and the energy along it."""
    largest = 0.5 * (a + d) + sqrt(0.25 * (a - d) ** 2 + b * b)
    one, two = (largest - d, b) if a >= d else (b, largest - a)
    length = sqrt(one * one + two * two)
    if length > 0.0:
        return one / length, two / length, largest
    return 0.0, 1.0, largest


@compiled
def _scatters(tree: Tree, scratch: Scratch) -> None:
    """Scatter of each piece, first, mixed and last element, in place."""
    for i in range(len(tree.edges)):
        start, stop = tree.edges[i]
        size = stop - start
        one, two = scratch.white[0, start:stop], scratch.white[1, start:stop]
        a, b, d = 0.0, 0.0, 0.0
        if tree.columns[i] < size:  # or they are any curve
            a, b, d = kernels.dot(one, one), kernels.dot(one, two), kernels.dot(two, two)
        for j in range(tree.columns[i]):
            if j == tree.chosen[i]:
                scratch.scatter[i, 0], scratch.scatter[i, 1], scratch.scatter[i, 2] = a, b, d
            if tree.columns[i] < size:
                place = tree.places[i] + j * size
                column = tree.values[place : place + size]
                held, other = kernels.dot(column, one), kernels.dot(column, two)
                a, b, d = a - held * held, b - held * other, d - other * other
        scratch.fitted[i, 0], scratch.fitted[i, 1], scratch.fitted[i, 2] = a, b, d
        if tree.chosen[i] >= tree.columns[i]:
            kernels.copy(scratch.fitted[i], scratch.scatter[i])


@compiled
def _best(tree: Tree, scratch: Scratch) -> None:
    """Least cost of all divisions of each piece, by axis to start from."""
    least, axes, inner = scratch.least, scratch.axes, len(tree.edges) // 2
    for i in range(len(tree.edges) - 1, -1, -1):
        a, b, d = scratch.scatter[i]
        price = pieces.COST * tree.chosen[i]
        result = least[i]
        for j in range(result.size):
            one, two = axes[0, j], axes[1, j]
            result[j] = two * two * a - 2.0 * one * two * b + one * one * d + price
        if i < inner:
            left, right = least[2 * i + 1], least[2 * i + 2]
            for j in range(result.size):
                halves = left[j] + right[j]
                result[j] = min(result[j], halves)


@compiled
def _halve(tree: Tree, scratch: Scratch, one: float, two: float) -> None:
    """Find the pieces that are halved in the best division, by one axis."""
    least, scatter, inner = scratch.cheapest, scratch.scatter, len(tree.edges) // 2
    for i in range(len(tree.edges)):
        least[i] = two * two * scatter[i, 0] - 2.0 * one * two * scatter[i, 1]
        least[i] += one * one * scatter[i, 2] + pieces.COST * tree.chosen[i]
        scratch.halved[i] = False
    for i in range(inner - 1, -1, -1):
        halves = least[2 * i + 1] + least[2 * i + 2]
        scratch.halved[i] = halves < least[i] + pieces.TIE
        least[i] = min(halves, least[i])


@compiled
def _chosen(tree: Tree, scratch: Scratch, begins: Mask) -> tuple[float, float, float]:
    """Sum of the fitted scatters of the best division's pieces, and the frames they begin with."""
    begins[:] = False
    a, b, d = 0.0, 0.0, 0.0
    used = scratch.halved
    for i in range(len(tree.edges)):
        parent = (i - 1) // 2
        # A piece is looked at if all that hold it are halved.
        looked_at = i == 0 or used[parent]
        if looked_at and not used[i]:
            a += scratch.fitted[i, 0]
            b += scratch.fitted[i, 1]
            d += scratch.fitted[i, 2]
            begins[tree.edges[i, 0]] = True
        used[i] = looked_at and used[i]
    return a, b, d


@compiled
def _piece(tree: Tree, scratch: Scratch, start: int, stop: int) -> tuple[float, float]:
    """Energy across the axis that one piece leaves, and the price, as `pieces._cost`."""
    size, steps = stop - start, 0
    for t in range(start + 1, stop):
        steps += 1 if tree.event[t] else 0
    order = max(1, min(smooth.PIECE_ORDER, size - steps))
    chosen = steps + (pieces.FUNCTIONS if size > smooth.PIECE_ORDER else order)
    across, basis, lengths = scratch.across[start:stop], scratch.basis, scratch.lengths
    degrees = min(chosen - steps, order)
    if degrees + steps >= size:
        return 0.0, pieces.COST * chosen
    middle = 0.5 * (tree.time[start] + tree.time[stop - 1])
    scale = 1.0 / (tree.time[stop - 1] - middle)
    # Orthogonal polynomials: p_k = (x - a) p_k-1 - b p_k-2.
    energy, a, b = kernels.dot(across, across), 0.0, 0.0
    for k in range(degrees):
        one, before = basis[max(k - 1, 0), :size], basis[max(k - 2, 0), :size]
        length, first, held = 0.0, 0.0, 0.0
        for t in range(size):
            x = (tree.time[start + t] - middle) * scale
            value = (x - a) * one[t] - b * before[t] if k > 0 else 1.0
            basis[k, t] = value
            length += value * value
            first += value * value * x
            held += value * across[t]
        energy -= held * held / length
        a, b = first / length, length / lengths[k - 1] if k > 0 else 0.0
        lengths[k] = length
    count = degrees
    for event in range(start + 1, stop):
        if tree.event[event]:
            energy -= _step(scratch, event - start, size, count, across)
            count += 1
    return energy, pieces.COST * chosen


@compiled
def _step(scratch: Scratch, event: int, size: int, count: int, across: Array) -> float:
    """Energy of a signal along a step of the camera, beside functions that are there before it."""
    column = scratch.basis[count, :size]
    column[:event], column[event:] = 0.0, 1.0
    for k in range(count):
        other = scratch.basis[k, :size]
        part = kernels.dot(other, column) / scratch.lengths[k]
        for t in range(size):
            column[t] -= part * other[t]
    length = kernels.dot(column, column)
    scratch.lengths[count] = length if length > _ROUNDED * size else np.inf
    return float(kernels.dot(column, across) ** 2 / scratch.lengths[count])


@compiled
def _join(tree: Tree, scratch: Scratch, begins: Mask) -> float:
    """Keep the best of the first frames of pieces, in place; the cost, as `pieces._joined`."""
    edges, least, before = scratch.joined, scratch.cheapest, scratch.before
    count = 0
    for t in range(begins.size):
        if begins[t]:
            edges[count] = t
            count += 1
    edges[count], least[0] = begins.size, 0.0
    for stop in range(1, count + 1):
        least[stop], before[stop] = np.inf, 0
        for start in range(stop - 1, -1, -1):
            energy, price = _piece(tree, scratch, edges[start], edges[stop])
            total = least[start] + energy + price
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
        begins[edges[at]] = True
    return float(least[count])


@compiled
def _refine(
    tree: Tree, scratch: Scratch, one: float, two: float, begins: Mask
) -> tuple[float, float, float]:
    """Axis and division in turns: the axis, and the energy along it."""
    energy = 0.0
    for _ in range(pieces.ROUNDS):
        _halve(tree, scratch, one, two)
        one, two, energy = _axis(*_chosen(tree, scratch, begins))
    return one, two, energy


@compiled
def _pixel(tree: Tree, scratch: Scratch, ratio: float, begins: Mask) -> None:
    """Divisions by four axes, and their costs, in place; infinite for none."""
    axes, costs, taken, across = scratch.axes, scratch.costs, scratch.taken, scratch.across
    _scatters(tree, scratch)
    for i in range(len(tree.starts)):
        a, b, d = scratch.scatter[tree.starts[i]]
        axes[0, i], axes[1, i], _ = _axis(a, b, d)
    if axes.shape[1] > len(tree.starts):
        length = sqrt(1.0 + ratio * ratio)
        known = not np.isnan(ratio)
        axes[0, -1] = 1.0 / length if known else axes[0, 0]
        axes[1, -1] = ratio / length if known else axes[1, 0]
    _best(tree, scratch)
    kernels.copy(scratch.least[0], scratch.starting)
    apart = 0.0
    for number in range(pieces.AXES):
        place, lowest = 0, np.inf
        for i in range(axes.shape[1]):
            if scratch.starting[i] < lowest and not _near(axes[:, i], taken, number, apart):
                place, lowest = i, scratch.starting[i]
        one, two, energy = _refine(tree, scratch, axes[0, place], axes[1, place], begins[number])
        taken[number, 0], taken[number, 1] = one, two
        again = _near(taken[number], taken, number, apart)
        costs[number] = np.inf
        if not again and lowest < np.inf:
            for t in range(across.size):
                across[t] = two * scratch.white[0, t] - one * scratch.white[1, t]
            costs[number] = _join(tree, scratch, begins[number])
        # An axis with an energy E along it, in units of the noise, is known to 1 / sqrt(E).
        apart = pieces.APART / sqrt(energy)


@compiled
def _near(axis: Array, taken: Array, count: int, apart: float) -> bool:
    """Compare an axis with those that are taken: is it within an angle [rad] of one."""
    near = False
    for i in range(count):
        product = abs(axis[0] * taken[i, 0] + axis[1] * taken[i, 1])
        near |= acos(min(product, 1.0)) < apart
    return near


def _compiled(digest: str) -> Callable[..., None]:
    """Divisions of all pixels of a tile, compiled once for sources of one digest."""

    @kernels.entered
    def divide(
        tree: Tree,
        signals: Array,
        noise: Array,
        ratio: Array,
        scratch: Scratch,
        first: Mask,
        cost: Array,
    ) -> None:
        if not digest:  # a constant of the compiled code, which is kept with it
            return
        frames, begins = signals.shape[1], scratch.begins
        for p in range(signals.shape[2]):
            for band in range(2):
                for t in range(frames):
                    scratch.white[band, t] = signals[band, t, p] / noise[band]
            _pixel(tree, scratch, ratio[p] * noise[0] / noise[1], begins)
            for rank in range(2):
                best = 0
                for number in range(1, pieces.AXES):
                    if scratch.costs[number] < scratch.costs[best]:
                        best = number
                cost[rank, p], scratch.costs[best] = scratch.costs[best], np.inf
                for t in range(frames):
                    first[rank, t, p] = begins[best, t]

    with suppress(RuntimeError):  # without a folder that may be written each process compiles
        divide.enable_caching()
    return divide


_divide: Final = _compiled(kernels.DIGEST)
