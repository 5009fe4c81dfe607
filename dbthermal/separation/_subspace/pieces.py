r"""Pieces of time, chosen from the data: where the object changes rapidly they are short.

The object's curve is a polynomial in each piece, and free from one piece to the next. Any division
of the capture by repeated halving may be chosen; it is the one with the least description length

.. math:: L(v) = \sum_i \left[ \mathrm{tr} \, S_i - v^T S_i v \right] + c \, n \qquad (12)

of the n pieces i, with the scatter :math:`S_i` (eq. 3) of the whitened signals outside the piece's
polynomials: the energy across the background's axis v in units of the noise, and a cost of each
piece. Given the division, the axis is the principal one of the sum of the scatters; given the axis,
the best of all divisions is found from the shortest pieces upwards (Donoho 1997, CART and best
basis, doi:10.1214/aos/1069362377). Alternated from many axes, this tells the rapid changes of the
object, which lie along another line, from those of the background: of two lines that explain the
data the object's is the one with fewer pieces.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Final

import numpy as np

from dbthermal import _smooth as smooth
from dbthermal.separation._tiles import Array, Mask, Whole

# Functions of a piece by which the division is chosen. One more is fitted: what the choice leaves
# of the curve is too small to be significant, but it would bias ratio and curve.
FUNCTIONS: Final = 4
# Cost of a function in units of the energy of noise: 1 for none, log N for an information criterion
# that would rather miss a change than find one too many.
COST: Final = 2.5
# Functions by whose cost pieces must be better than a smooth curve to be asked for.
_MARGIN: Final = 3.0
# Levels of the pieces that are enough to see that pieces are better.
_COARSE: Final = 4
# Halvings after which the pieces give the axes to start from.
STARTS: Final = (0, 2, 3, 4, 5)
ROUNDS: Final = 4
# Axes that are refined, of which the two best are kept: joined, they may change places.
AXES: Final = 4
# Costs of pieces that are computed at once: all together would need much memory.
_AT_ONCE: Final = 2**20
# Costs that differ by less are the same but for rounding: of two divisions the finer one is taken,
# whose pieces may be joined, and of two ways to join pieces that of the longest.
TIE: Final = 1e-6
# Standard deviations between two axes that are told apart.
APART: Final = 6.0

Piece = tuple[slice, Array, int]
"""Frames of a piece, its functions, orthonormal, and how many of them are used to choose."""


@dataclass(frozen=True)
class Division:
    """Division of the time of each pixel into pieces, and what it costs."""

    first: Mask  # whether a piece begins with a frame (time, pixel)
    cost: Array  # eq. 12 (pixel); infinite for none


def divide(
    signals: Array, time: Array, noise: Array, segment: Whole | None, known: Array | None = None
) -> list[Division]:
    """
    Divisions by which two different axes explain the signals (band, time, pixel) best.

    The second one is that of the other line, if there is one, and costs more. Reflection ratios of
    a material may be `known` (band, pixel), NaN for others.
    """
    edges, levels = tree(time.tobytes(), None if segment is None else segment.tobytes())
    white = signals / noise[:, np.newaxis, np.newaxis]
    scatters = [_scatters(white, level) for level in levels]
    prices = [COST * (len(noise) - 1) * np.array([p[2] for p in level]) for level in levels]
    starts = [_axis(scatters[level][0]) for level in STARTS if level < len(scatters)]
    axes = np.concatenate(starts)
    if known is not None:
        along = (known / noise[:, np.newaxis]).T
        along = along / np.linalg.norm(along, axis=1, keepdims=True)
        axes = np.concatenate([axes, np.where(np.isfinite(along), along, axes[0])[np.newaxis]])
    parts = 1 + axes[..., 0].size * edges.size // _AT_ONCE
    costs = np.concatenate(
        [_best(scatters, prices, some)[0] for some in np.array_split(axes, parts)]
    )
    divisions: list[Division] = []
    taken = np.full((0, *axes.shape[1:]), np.nan)
    deviation = np.zeros(signals.shape[2])
    for _ in range(AXES):
        same = np.any(_angle(axes, taken) < APART * deviation, axis=0)
        left = np.where(same, np.inf, costs)
        axis = axes[np.argmin(left, axis=0), np.arange(left.shape[1])]
        for _ in range(ROUNDS):
            chosen = _best(scatters, prices, axis)[1]
            total = _total(scatters, chosen)
            axis = _axis(total)
        again = np.any(_angle(axis, taken) < APART * deviation, axis=0)
        none = again | ~np.isfinite(left.min(axis=0))
        first, cost = _joined(white, axis, _first(chosen, edges), time, segment)
        divisions.append(Division(first, np.where(none, np.inf, cost)))
        taken = np.concatenate([taken, axis[np.newaxis]])
        # An axis with an energy E along it, in units of the noise, is known to 1 / sqrt(E).
        deviation = 1.0 / np.sqrt(np.linalg.eigvalsh(total)[:, -1])
    rows = np.argsort([one.cost for one in divisions], axis=0, kind="stable")
    every = np.arange(rows.shape[1])
    firsts, least = (
        np.stack([getattr(one, name) for one in divisions]) for name in ("first", "cost")
    )
    return [Division(firsts[rank, :, every].T, least[rank, every]) for rank in rows[:2]]


@lru_cache(maxsize=4)
def tree(time: bytes, segment: bytes | None) -> tuple[Whole, list[list[Piece]]]:
    """
    First frames of the shortest pieces, and the end; the pieces of each level of halving.

    From times [s] and the number of shutter events before each frame. Pieces begin beside events,
    not at them; the steps of these come first among a piece's functions.
    """
    times = np.frombuffer(time)
    events = None if segment is None else np.frombuffer(segment, dtype=np.intp)
    # The polynomial of the shortest pieces is any curve.
    levels = int(np.ceil(np.log2(times.size / smooth.PIECE_ORDER)))
    edges = np.round(np.linspace(0, times.size, 2**levels + 1)).astype(np.intp)
    for event in [] if events is None else np.flatnonzero(np.diff(events)) + 1:
        edges[1:-1][edges[1:-1] == event] += 1
    halved: list[list[Piece]] = []
    for level in range(levels + 1):
        bounds = edges[:: 2 ** (levels - level)]
        halved.append([])
        for (start, stop), basis in zip(pairwise(bounds), _bases(times, bounds), strict=True):
            one, inside = slice(start, stop), None if events is None else events[start:stop]
            if inside is not None and inside[0] < inside[-1]:
                halved[-1].append((one, *functions(times[one].tobytes(), inside.tobytes())))
            else:
                chosen = FUNCTIONS if len(basis) > smooth.PIECE_ORDER else basis.shape[1]
                halved[-1].append((one, basis, chosen))
    return edges, halved


def _bases(times: Array, bounds: Whole) -> list[Array]:
    """Polynomials (time, function) of each piece; those of one length at once."""
    lengths, bases = np.diff(bounds), [np.empty((0, 0))] * (bounds.size - 1)
    for length in np.unique(lengths):
        places = np.flatnonzero(lengths == length)
        order = min(smooth.PIECE_ORDER, int(length))
        together = times[bounds[places, np.newaxis] + np.arange(length)]
        for place, basis in zip(places, smooth.polynomial_basis(together, order), strict=True):
            bases[place] = basis
    return bases


def _scatters(white: Array, pieces: list[Piece]) -> Array:
    """
    Scatter (2, piece, pixel, band, band) of the whitened signals in each of some pieces.

    Outside the functions by which is chosen, and outside those that are fitted.
    """
    bands, _, pixels = white.shape
    scatter = np.empty((2, len(pieces), pixels, bands, bands))
    for number, (inside, basis, chosen) in enumerate(pieces):
        if basis.shape[0] == basis.shape[1]:  # any curve
            scatter[:, number] = 0.0
            continue
        signal = white[:, inside]
        held = basis.T @ signal
        first, more = held[:, :chosen], held[:, chosen:]
        scatter[0, number] = np.einsum("btp,ctp->pbc", signal, signal)
        scatter[0, number] -= np.einsum("bkp,ckp->pbc", first, first)
        scatter[1, number] = scatter[0, number] - np.einsum("bkp,ckp->pbc", more, more)
    return scatter


def _axis(scatter: Array) -> Array:
    """Principal axis (..., band) of scatters (..., band, band)."""
    return np.asarray(np.linalg.eigh(scatter)[1][..., -1])


def _angle(axes: Array, others: Array) -> Array:
    """Angle (other, ..., pixel) [rad] between axes (..., pixel, band) and others (other, ...)."""
    product = np.einsum("...pb,opb->o...p", axes, others)
    return np.asarray(np.arccos(np.minimum(np.abs(product), 1.0)))


def _best(scatters: list[Array], prices: list[Array], axis: Array) -> tuple[Array, list[Mask]]:
    """
    Least cost (..., pixel) of all divisions, and the pieces (piece, ..., pixel) chosen, by level.

    For axes (..., pixel, band), with the prices of the pieces' functions (piece).
    """
    bands, costs = axis.shape[-1], []
    # v^T S v as a product of matrices of each pixel: (piece, band pair) by (band pair, axis).
    squares = np.moveaxis(axis[..., np.newaxis] * axis[..., np.newaxis, :], -3, 0)
    pairs = squares.reshape(len(squares), -1, bands**2).mT
    for (scatter, _), price in zip(scatters, prices, strict=True):
        along = np.moveaxis(scatter, 1, 0).reshape(len(squares), -1, bands**2) @ pairs
        whole = np.einsum("ipbb->pi", scatter) + price
        cost = np.moveaxis(whole[..., np.newaxis] - along, 0, -1)
        costs.append(cost.reshape(len(scatter), *axis.shape[:-1]))
    return _halve(costs)


def _halve(costs: list[Array]) -> tuple[Array, list[Mask]]:
    """Least sum (...) of the costs of pieces, by level, and those chosen."""
    halved: list[Mask] = []
    least = costs[-1]
    for cost in costs[-2::-1]:
        halves = least[::2] + least[1::2]
        halved.append(halves < cost + TIE)
        least = np.minimum(halves, cost)
    chosen, inside = [], np.ones(least.shape, dtype=bool)
    for halve in halved[::-1]:
        chosen.append(inside & ~halve)
        inside = np.repeat(inside & halve, 2, axis=0)
    return least[0], [*chosen, inside]


def _joined(
    white: Array, axis: Array, first: Mask, time: Array, segment: Whole | None
) -> tuple[Mask, Array]:
    """
    Best division that begins no pieces but those given (time, pixel), and its cost (pixel).

    Halving makes more pieces than are needed: a change at a third of the time needs many. Of the
    ends of pieces at hand the best are found by going through them in their order.
    """
    across = white - np.einsum("pb,btp->tp", axis, white) * axis.T[:, np.newaxis]
    joined, cost = np.zeros_like(first), np.empty(first.shape[1])
    for places in alike(first):
        edges = [*np.flatnonzero(first[:, places[0]]), time.size]
        part = across[..., places]
        least, before = np.full((len(edges), places.size), np.inf), []
        least[0] = 0.0
        for stop in range(1, len(edges)):
            sums = [
                least[start] + _cost(part, edges[start], edges[stop], time, segment)
                for start in range(stop)
            ]
            least[stop] = np.min(sums, axis=0)
            before.append(np.argmax(sums < least[stop] + TIE, axis=0))
        cost[places] = least[-1]
        at = np.full(places.size, len(edges) - 1)
        while np.any(at > 0):
            at = np.where(at > 0, np.array(before)[at - 1, np.arange(at.size)], 0)
            joined[np.array(edges)[at], places] = True
    return joined, cost


def alike(first: Mask) -> list[Whole]:
    """Pixels whose pieces begin with the same frames (time, pixel), together."""
    groups: dict[bytes, list[int]] = {}
    for place, begins in enumerate(first.T):
        groups.setdefault(begins.tobytes(), []).append(place)
    return [np.array(places) for places in groups.values()]


def _cost(across: Array, start: int, stop: int, time: Array, segment: Whole | None) -> Array:
    """Cost (pixel) of one piece for a signal across the axis (band, time, pixel)."""
    inside = slice(start, stop)
    basis, chosen = functions(
        time[inside].tobytes(), None if segment is None else segment[inside].tobytes()
    )
    held = basis[:, :chosen].T @ across[:, inside]
    energy = np.einsum("btp,btp->p", across[:, inside], across[:, inside])
    energy -= np.einsum("bkp,bkp->p", held, held)
    return np.asarray(energy + COST * chosen * (len(across) - 1))


@lru_cache(maxsize=4096)
def functions(time: bytes, segment: bytes | None) -> tuple[Array, int]:
    """Functions of a piece (time, function), orthonormal, and how many are used to choose it."""
    times = np.frombuffer(time)
    steps = [] if segment is None else smooth.camera_steps(np.frombuffer(segment, dtype=np.intp))
    order = max(1, min(smooth.PIECE_ORDER, times.size - len(steps)))
    # Steps of the camera come first.
    columns = [*steps, smooth.polynomial_basis(times, order)]
    chosen = FUNCTIONS if times.size > smooth.PIECE_ORDER else order
    return np.linalg.qr(np.column_stack(columns))[0], len(steps) + chosen


def _total(scatters: list[Array], chosen: list[Mask]) -> Array:
    """Sum of the scatters (pixel, band, band) outside the functions that are fitted."""
    parts = zip(scatters, chosen, strict=True)
    return np.asarray(sum(np.einsum("ip,ipbc->pbc", use, part[1]) for part, use in parts))


def _first(chosen: list[Mask], edges: Whole) -> Mask:
    """Frames (time, pixel) that a chosen piece begins with."""
    result = np.zeros((edges[-1], chosen[0].shape[1]), dtype=bool)
    for pieces in chosen:
        result[edges[: -1 : (edges.size - 1) // len(pieces)]] |= pieces
    return result


@lru_cache(maxsize=16)
def blocks(frames: int) -> Whole:
    """Edges of the blocks of frames whose means tell whether pieces are asked for."""
    levels = min(int(np.log2(frames / FUNCTIONS)), _COARSE + 2)
    return np.round(np.linspace(0, frames, 2**levels + 1)).astype(np.intp)


def asked(residual: Array, curve: Array, time: Array, variance: Array, used: Whole) -> Mask:
    """
    Pixels whose smooth curve is described shorter in pieces.

    Of the sums (block, pixel) [K] over `blocks` of a null residual and of the curve taken from it,
    with noise of a variance (pixel) [K^2] and the number of functions used (pixel).
    """
    edges = blocks(len(time))
    levels = int(np.log2(len(residual)))
    length = np.diff(edges)[:, np.newaxis]
    # Means in units of their noise, about as many frames in each; with the curve and without.
    deviation = np.sqrt(np.where(variance > 0, variance, np.inf) / length.mean())
    places = np.add.reduceat(time, edges[:-1]) / length[:, 0]
    left = residual / (length * deviation)
    mean = left + curve / (length * deviation)
    costs = []
    for level in range(levels - 1):
        parts = mean.reshape(1 << level, -1, mean.shape[1])
        found = [functions(one.tobytes(), None) for one in places.reshape(len(parts), -1)]
        chosen = found[0][1]
        held = np.stack([basis[:, :chosen] for basis, _ in found]).mT @ parts
        energy = np.einsum("itp,itp->ip", parts, parts) - np.einsum("ijp,ijp->ip", held, held)
        costs.append(energy + COST * chosen)
    smoothly = (left**2).sum(axis=0) + COST * used
    least, whole = _halve(costs)
    return np.asarray((smoothly > least + _MARGIN * COST) & ~whole[0][0])
