"""Other bands over the first in a pixel, by means over bins of time: step 1 of `posterior`."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from dbthermal._smooth import largest
from dbthermal.separation._tiles import Array, Mask, Tile

# Bins of time, at most, and frames in each, at least.
_BINS: Final = 32
_LEAST: Final = 2
# Nodes of the cubic over a range of [-1, 1], its Chebyshev points; half the range, at least [K].
_NODES: Final = np.cos(np.pi * (np.arange(4) + 0.5) / 4.0)
_LEAST_RANGE: Final = 0.5
# A constant, a quadratic and a cubic, at the nodes: Chebyshev's polynomials.
_SHAPES: Final = np.cos(np.multiply.outer([0.0, 2.0, 3.0], np.arccos(_NODES)))
# The first band's change over its noise, in variance, from which a slope is not attenuated.
_SEEN: Final = 25.0


@dataclass(frozen=True)
class Bins:
    """Means over bins of time."""

    signals: Array  # (band, bin, pixel) [K]
    frames: Array  # (bin, pixel)
    time: Array  # (bin) [s]

    def rapid(self, noise: float) -> Array:
        """Deviation (pixel) [K] of the first band about a smooth curve, less noise; NaN of gaps."""
        smooth = largest(self.time).functions
        residual = self.signals[0] - smooth @ (smooth.T @ self.signals[0])
        variance = (residual**2).sum(axis=0) / (len(smooth) - smooth.shape[1])
        with np.errstate(divide="ignore", invalid="ignore"):
            expected = noise**2 * np.mean(1.0 / self.frames, axis=0)
        return np.sqrt(np.maximum(np.where(np.isinf(expected), np.nan, variance - expected), 0.0))


@dataclass(frozen=True)
class Curve:
    """Information of the bins on the values at the nodes: log-likelihood -g H g / 2 + h g."""

    nodes: Array  # (node, pixel) [K]
    information: Array  # H (band - 1, node, node, pixel) [1/K^2]
    linear: Array  # h (band - 1, node, pixel) [1/K]


def bins(tile: Tile, valid: Mask) -> Bins:
    """Means of the tile's signals over bins of as many frames each."""
    size = max(_LEAST, -(-tile.time.size // _BINS))
    starts = np.arange(0, max(tile.time.size - size // 2, 1), size)
    frames = np.add.reduceat(valid.astype(np.float64), starts, axis=0)
    total = np.add.reduceat(np.where(valid, tile.signals, 0.0), starts, axis=1)
    time = np.add.reduceat(tile.time, starts) / np.diff(starts, append=tile.time.size)
    return Bins(total / np.maximum(frames, 1.0), frames, time)


def curve(
    tile: Tile, means: Bins, offset: Array, stray: Array | float = 0.0, bend: Array | float = 0.0
) -> Curve:
    """Other bands over the first, of unknown offsets (band - 1) and bends (band - 1, pixel) [K]."""
    weight, first = means.frames, means.signals[0]
    total = np.maximum(weight.sum(axis=0), 1.0)
    middle = (weight * first).sum(axis=0) / total
    centred = np.where(weight > 0, first - middle, 0.0)
    energy = (weight * centred**2).sum(axis=0)
    bins_used = np.count_nonzero(weight, axis=0)
    # Strays of the first band [K^2], beside the noise, are not followed by the other bands.
    centred = centred * (energy > _SEEN * (tile.noise[0] ** 2 * bins_used + stray * total))
    half = np.maximum(np.abs(centred).max(axis=0), _LEAST_RANGE)
    base = _lagrange(centred / half)  # (node, bin, pixel)
    gram = np.einsum("ibp,bp,jbp->ijp", base, weight, base)
    information, linear = [], []
    # A slow change of the background bends the bands: it would pass for the bend of the responses,
    # which is large for a hot metal alone.
    bends = np.broadcast_to(bend, (len(tile.noise) - 1, total.size))
    ridge = 1e-9 * total * np.eye(4)[..., np.newaxis]
    for m in range(1, len(tile.noise)):
        moment = np.einsum("ibp,bp,bp->ip", base, weight, means.signals[m])
        fitted = np.linalg.solve(np.moveaxis(gram + ridge, -1, 0), moment.T[..., np.newaxis])
        residual = means.signals[m] - np.einsum("ibp,pi->bp", base, fitted[..., 0])
        noise = tile.noise[m] ** 2 + tile.noise[0] ** 2  # of one frame
        # That of the noise, or the bins' if it is more: there the background fluctuates.
        variance = _long_run(residual, weight, bins_used, noise)
        inverse, right = gram / variance, moment / variance
        # Of a constant, quadratic and cubic part of variance p^2 is told nothing:
        # H - H b b^T H / (1 / p^2 + b^T H b).
        deviations = offset[m - 1], bends[m - 1], bends[m - 1]
        for shape, deviation in zip(_SHAPES, deviations, strict=True):
            row = np.einsum("ijp,j->ip", inverse, shape)
            share = deviation**2 / (1.0 + deviation**2 * (shape @ row))
            right = right - row * (share * (shape @ right))
            inverse = inverse - share * row[:, np.newaxis] * row
        information.append(inverse)
        linear.append(right)
    nodes = middle + half * _NODES[:, np.newaxis]
    return Curve(nodes, np.array(information), np.array(linear))


def _lagrange(places: Array) -> Array:
    """Cubics (node, ...) at places in [-1, 1] that are 1 at one of the nodes, 0 at the others."""
    cubics = []
    for node in _NODES:
        roots = _NODES[node != _NODES]
        cubics.append(np.prod([(places - root) / (node - root) for root in roots], axis=0))
    return np.asarray(cubics)


def _long_run(residual: Array, weight: Array, used: Array, noise: float) -> Array:
    """Variance (pixel) [K^2] of a frame that gives the bins' scatter, with their correlation."""
    scaled = np.sqrt(weight) * residual
    freedom = np.maximum(used - 4, 1)
    variance = (scaled**2).sum(axis=0) / freedom
    power = np.maximum((scaled**2).sum(axis=0), np.finfo(np.float64).tiny)
    lags = [(scaled[lag:] * scaled[:-lag]).sum(axis=0) for lag in (1, 2) if lag < len(scaled)]
    correlated = 1.0 + 2.0 * np.sum([np.maximum(lag / power, 0.0) for lag in lags], axis=0)
    more = variance > noise * (1.0 + 3.0 * np.sqrt(2.0 / freedom))
    return np.asarray(np.where(more, variance * correlated, noise))
