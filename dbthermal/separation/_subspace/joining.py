r"""Pieces of time that are joined with adjacent pieces, of one pixel, compiled.

Halving makes more pieces than are needed: a change at a third of the time needs many. Of the ends
of pieces at hand the best are found by going through them in their order. A signal is summed up in
parts of the time by its products with the orthonormal polynomials of each part, :math:`c = Q^T z`,
and its energy beside them. The functions of a piece of several parts, polynomials and steps of the
camera, are combinations V of these, and what the piece leaves is the energy beside the parts'
polynomials and :math:`\min |c - V f|^2`, of a few equations instead of all frames. A part after
another is added to them by rotations.
"""

from math import sqrt
from typing import Final, NamedTuple

import numpy as np

from dbthermal import _smooth as smooth
from dbthermal._arrays import Array, Mask
from dbthermal.separation._subspace import kernels, pieces
from dbthermal.separation._subspace.kernels import compiled
from dbthermal.separation._tiles import Whole

LONGEST: Final = 1024
"""Frames of a part, at most, whose polynomials stay in the cache."""


class Scratch(NamedTuple):
    """Work space of one pixel."""

    begins: Whole  # first frames of the parts, and the end
    edges: Whole  # parts that pieces may begin with, and the end (edge)
    middle: Array  # of each part [s], half its length [s], and its energy beside polynomials (part)
    half: Array
    beside: Array
    products: Array  # with the polynomials of each part (part, degree)
    centre: Array  # of each polynomial's square, in half lengths from the middle (part, degree)
    length: Array  # of each polynomial (part, degree)
    basis: Array  # (degree, time) of one part
    equations: Array  # triangle of the functions of a piece (function, function); the right side
    right: Array
    powers: Array  # of the time, of the polynomials of a part (power, degree)
    row: Array  # equation that is added (function)
    least: Array  # least cost up to each edge, and the edge before it
    before: Whole


@compiled
def _part(time: Array, curve: Array, scratch: Scratch, number: int) -> None:
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
        following, at, square, first, held = basis[k, :size], time[start:stop], 0.0, 0.0, 0.0
        for t in range(size):
            x = (at[t] - middle) * scale
            value = (x - a) * previous[t] - b * last[t] if k > 0 else 1.0
            following[t] = value
            square += value * value
            first += value * value * x
            held += value * section[t]
        energy -= held * held / square
        a, b, before = first / square, square / before if k > 0 else 0.0, square
        scratch.centre[number, k], scratch.length[number, k] = a, sqrt(square)
        scratch.products[number, k] = held / sqrt(square)
    scratch.middle[number], scratch.half[number] = middle, half
    scratch.beside[number] = energy if size > pieces.FUNCTIONS else 0.0


@compiled
def _powers(scratch: Scratch, number: int, end: float) -> None:
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
def _add(scratch: Scratch, number: int, end: float, steps: int) -> float:
    """Add a part to the equations of a piece that ends at a time [s]; return the energy left."""
    matrix, right, row = scratch.equations, scratch.right, scratch.row
    energy, count = scratch.beside[number], pieces.FUNCTIONS + steps
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
def _split(event: Mask, scratch: Scratch, begins: Mask) -> tuple[int, int]:
    """Parts of the time between first frames and steps of the camera: numbers of both."""
    begun, edges, count, pieces = scratch.begins, scratch.edges, 0, 0
    for t in range(begins.size):
        if begins[t]:
            edges[count] = pieces
            count += 1
        if begins[t] or event[t] or t - begun[max(pieces - 1, 0)] == LONGEST:
            begun[pieces] = t
            pieces += 1
    edges[count], begun[pieces] = pieces, begins.size
    return count, pieces


@compiled
def join(time: Array, event: Mask, across: Array, scratch: Scratch, begins: Mask) -> float:
    """Keep the best of the first frames of pieces, in place; the cost (eq. 12)."""
    begun, edges, least, before = scratch.begins, scratch.edges, scratch.least, scratch.before
    count, count_of_pieces = _split(event, scratch, begins)
    for number in range(count_of_pieces):
        _part(time, across, scratch, number)
    least[0] = 0.0
    for stop in range(1, count + 1):
        least[stop], before[stop] = np.inf, 0
        scratch.equations[:], scratch.right[:] = 0.0, 0.0
        number, steps, left, end = edges[stop], 0, 0.0, begun[edges[stop]]
        for start in range(stop - 1, -1, -1):
            while number > edges[start]:
                steps += 1 if number < edges[stop] and event[begun[number]] else 0
                number -= 1
                left += _add(scratch, number, time[end - 1], steps)
            size = end - begun[number]
            functions = pieces.FUNCTIONS if size > smooth.PIECE_ORDER else size - steps
            energy = left if functions + steps < size else 0.0
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
