"""Compiled loops of `equations`: the object signals at both cameras' places, pixel after pixel."""

from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from dbthermal._compiled import compiled
from dbthermal._smooth import Whole
from dbthermal.separation._subspace.kernels import inlined

Floats = npt.NDArray[np.floating[Any]]

# Steps of the iteration, and the change that ends it [K].
_STEPS: Final = 60
CONVERGED: Final = 1e-3
_ENDLESS: Final = 1e3  # change of an object between two places [K] that no iteration ended at

Rows: TypeAlias = tuple[Whole, Whole, Floats]
"""Starts of the rows, columns and values of a sparse matrix."""

FORWARD, BACKWARD, LOOSE = range(3)  # by which equation a pixel is solved


class Terms(NamedTuple):
    """Equations as the compiled loops take them."""

    shares: Floats  # c (band, pixel) [1]
    bends: Floats  # (band - 1, degree + 1)
    way: Whole  # `FORWARD`, `BACKWARD` or `LOOSE` (pixel)
    place: Whole  # among the pixels of that way (pixel)
    pairing: Rows  # (pixel, pixel)
    onward: Rows  # (backward pixel, pixel)
    beyond: Floats  # c_m at p + d(p) (band - 1, backward pixel) [1]
    change: Floats  # u_1(x(p)) - u_1(x(r)) (loose pixel, frame) [K]


@inlined
def _other_bands(shares: Floats, pixel: int, bends: Floats, signal: Floats, result: Floats) -> None:
    """Sum of a pixel's shares (band - 1, pixel) times u_m(x), of u_1(x) (frame) [K], in place."""
    for t in range(signal.size):
        value, total = np.float64(signal[t]), 0.0
        for band in range(shares.shape[0]):
            # The bend u_m - u_1 is a polynomial of u_1, by Horner's rule.
            bend = 0.0
            for degree in range(bends.shape[1] - 1, -1, -1):
                bend = bend * value + bends[band, degree]
            total += shares[band, pixel] * (value + bend)
        result[t] = total


@compiled
def other_bands(shares: Floats, bends: Floats, signal: Floats, result: Floats) -> None:
    """As `_other_bands`, of all pixels (pixel, frame), in place."""
    for pixel in range(signal.shape[0]):
        _other_bands(shares, pixel, bends, signal[pixel], result[pixel])


@inlined
def _at_p(terms: Terms, pixel: int, signal: Floats, film: Floats) -> None:
    """Signal u_1(x(p)) (frame) [K] of a pixel, from all signals at r (pixel, frame), in place."""
    if terms.way[pixel] == LOOSE:
        change = terms.change[terms.place[pixel]]
        for t in range(film.size):
            film[t] = signal[pixel, t] + change[t]
        return
    starts, columns, values = terms.pairing
    film[:] = 0.0
    for entry in range(starts[pixel], starts[pixel + 1]):
        weight, neighbour = values[entry], signal[columns[entry]]
        for t in range(film.size):
            film[t] += weight * neighbour[t]


@inlined
def _forward(
    terms: Terms, target: Floats, pixel: int, signal: Floats, film: Floats, spare: Floats
) -> None:
    """Next u_1(x(r)) (frame) [K] of a pixel by its own equation, in place."""
    first, loose = terms.shares[0, pixel], terms.way[pixel] == LOOSE
    _at_p(terms, pixel, signal, film)
    _other_bands(terms.shares[1:], pixel, terms.bends, film, spare)
    for t in range(film.size):
        remainder = target[pixel, t] - spare[t]
        # Of a loose pixel a step of Newton, of a slope near sum c = 1.
        film[t] = signal[pixel, t] * (1.0 - first) + remainder if loose else remainder / first


@inlined
def _backward(
    terms: Terms, target: Floats, pixel: int, signal: Floats, film: Floats, spare: Floats
) -> None:
    """Next u_1(x(r)) (frame) [K] of a pixel by the equation at p + d(p), in place."""
    place = terms.place[pixel]
    starts, columns, values = terms.onward
    film[:] = 0.0
    for entry in range(starts[place], starts[place + 1]):
        weight, beyond = values[entry], columns[entry]
        first = terms.shares[0, beyond]
        for t in range(film.size):
            film[t] += weight * (target[beyond, t] - first * signal[beyond, t])
    _other_bands(terms.beyond, place, terms.bends, signal[pixel], spare)
    slope = terms.beyond[:, place].sum()
    for t in range(film.size):
        film[t] = signal[pixel, t] + (film[t] - spare[t]) / slope


@compiled
def relax(terms: Terms, target: Floats, signal: Floats, step: Floats) -> None:
    """Solve for u_1(x(r)) (pixel, frame) [K] from a start, and its last steps (pixel), in place."""
    film, spare = np.empty(signal.shape[1]), np.empty(signal.shape[1])
    # Method of Gauss and Seidel: each pixel in turn, of the other pixels' values so far.
    for _ in range(_STEPS):
        largest = 0.0
        for pixel in range(len(signal)):
            if terms.way[pixel] == BACKWARD:
                _backward(terms, target, pixel, signal, film, spare)
            else:
                _forward(terms, target, pixel, signal, film, spare)
            moved = 0.0
            for t in range(film.size):
                moved = max(moved, abs(film[t] - signal[pixel, t]))
                signal[pixel, t] = film[t]
            step[pixel] = moved
            largest = max(largest, moved)
        if largest < CONVERGED:
            break


@compiled
def second_place(terms: Terms, target: Floats, signal: Floats, result: Floats) -> None:
    """Signals u_1(x(p)) (pixel, frame) [K] of a solution, in place."""
    film, spare = np.empty(signal.shape[1]), np.empty(signal.shape[1])
    second = terms.shares[1:]
    for pixel in range(len(signal)):
        _at_p(terms, pixel, signal, film)
        if terms.way[pixel] == BACKWARD:
            # Its own equation holds for another x(p) than that between its neighbours.
            slope = second[:, pixel].sum()
            _other_bands(second, pixel, terms.bends, film, spare)
            for t in range(film.size):
                remainder = target[pixel, t] - terms.shares[0, pixel] * signal[pixel, t] - spare[t]
                film[t] += remainder / slope
        result[pixel] = film


@compiled
def changes(signals: Floats, pixels: Whole, shares: Floats, bend: Floats, result: Floats) -> None:
    """Shares (pixel) of the change of u_m, of u_1 at both places (2, node, pixel), 0 if endless."""
    for t in range(result.shape[0]):
        for p in range(pixels.size):
            at_r, at_p = np.float64(signals[0, t, pixels[p]]), np.float64(signals[1, t, pixels[p]])
            change, of_r, of_p = at_p - at_r, 0.0, 0.0
            for degree in range(bend.size - 1, -1, -1):
                of_r, of_p = of_r * at_r + bend[degree], of_p * at_p + bend[degree]
            change = shares[p] * (change + of_p - of_r)
            result[t, p] = change if abs(change) < _ENDLESS else 0.0  # so is NaN
