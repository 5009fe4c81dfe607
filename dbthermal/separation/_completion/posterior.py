r"""Posterior of object, background and emissivities of one tile, given a prior on the latter.

The image formation (`mixing`) in signals :math:`s = u_1(x)` of the first band, with the other
responses as functions :math:`B_m = u_m \circ u_1^{-1}` of it, a background of the level c and the
fluctuation f(t), and any object at all:

.. math:: z_1 = c + e_1 (s - c) + (1 - e_1) f, \quad
          z_m = B_m(c) + e_m (B_m(s) - B_m(c)) + (1 - e_m) B_m'(c) f \qquad (1)

1. Means over bins of time, less s, leave a curve of each band over the first, :math:`z_m(z_1)`. It
   tells :math:`e_m / e_1` by its slope and c by where both bands agree, but never :math:`e_1`
   itself. A cubic in the base of its values at four nodes holds all that the bins say.
2. For each :math:`e_1` on a grid the rest is linear and Gaussian: evidence, mean and covariance of
   :math:`(e_m, c)` are closed forms, for each component of the prior. Their moments over the grid
   are kept in :math:`a = 1 / e_1`, :math:`\rho_m = e_m / e_1` and c, in which s is nearly linear:
   :math:`s = c + a (z_1 - c)`. The mean of a is taken no farther from 1, the camera's own reading,
   than is no worse than that with a probability of 95 %.
3. Frame by frame s and f are the posterior mean, the latter of a variance that the bins show.
"""

import math
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from dbthermal._compiled import compiled
from dbthermal.separation import _frames as frames
from dbthermal.separation._completion.prior import Mixture
from dbthermal.separation._subspace import kernels
from dbthermal.separation._tiles import Array, Mask, Pixels, Tile, Whole

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
# Probability that the object is farther off than the camera's own reading, at most [1].
_WORSE: Final = 0.04
# Steps of Gauss-Newton, at most, and the change of the level over its deviation that ends them [1].
_STEPS, _SETTLED = 8, 0.02
_NEGLIGIBLE: Final = 1e-9  # share of the largest weight
_BOUNDS: Final = (0.01, 0.999)  # of the emissivities about which the model is linearised
# Where nothing bounds the fluctuation of the background: its variance [K^2].
_VAGUE: Final = 1e6


@dataclass(frozen=True)
class Level:
    """Prior on the background: its level, and how much it fluctuates over time."""

    signal: Array | float  # first band's signal, less the reference (pixel) [K]
    std: Array | float  # (pixel) [K]
    fluctuation: float  # standard deviation over time [K]

    def at(self, places: Whole) -> "Level":
        """Return the level of some pixels, each of its own."""
        parts = (np.asarray(part, dtype=np.float64) for part in (self.signal, self.std))
        signal, std = (part[places] if part.ndim else np.full(places.size, part) for part in parts)
        return Level(signal, std, self.fluctuation)


@dataclass(frozen=True)
class Bins:
    """Means over bins of time."""

    signals: Array  # (band, bin, pixel) [K]
    frames: Array  # (bin, pixel)


@dataclass(frozen=True)
class Moments(Pixels):
    """Posterior of the emissivities and of the background's level."""

    point: Array  # emissivities at the mean of a and rho_m (band, pixel) [1]
    level: Array  # c (pixel) [K]
    covariance: Array  # of both about the point (band + 1, band + 1, pixel)
    emissivity: Array  # mean (band, pixel) [1]
    emissivity_covariance: Array  # (band, band, pixel) [1]

    def reflection_ratio(self) -> tuple[Array, Array]:
        """Ratios (band, pixel) of the mean emissivities, and their covariance to first order."""
        dark = 1.0 - self.emissivity
        ratio = dark / dark[0]
        # dkappa_m = (kappa_m de_1 - de_m) / (1 - e_1)
        change = np.zeros((len(ratio), len(ratio), ratio.shape[1]))
        change[:, 0] += ratio
        change -= np.eye(len(ratio))[..., np.newaxis]
        change /= dark[0]
        return ratio, np.einsum("imp,mnp,jnp->ijp", change, self.emissivity_covariance, change)


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
    return Bins(total / np.maximum(frames, 1.0), frames)


def curve(
    tile: Tile, means: Bins, offset: Array, stray: Array | float = 0.0, bend: Array | float = 0.0
) -> Curve:
    """Other bands over the first; offsets (band - 1) [K] of a pixel against them are not known.

    Nor is what a slow change of the background bends them by, of deviations (band - 1, pixel) [K].
    It would pass for the bend of the responses, which is large for a hot metal alone.

    The variance is that of the noise, or the bins' if it is more: there the background fluctuates.
    The first band has a variance of strays [K^2], beside the noise, which the others do not follow.
    """
    weight, first = means.frames, means.signals[0]
    total = np.maximum(weight.sum(axis=0), 1.0)
    middle = (weight * first).sum(axis=0) / total
    centred = np.where(weight > 0, first - middle, 0.0)
    energy = (weight * centred**2).sum(axis=0)
    bins_used = np.count_nonzero(weight, axis=0)
    centred = centred * (energy > _SEEN * (tile.noise[0] ** 2 * bins_used + stray * total))
    half = np.maximum(np.abs(centred).max(axis=0), _LEAST_RANGE)
    base = _lagrange(centred / half)  # (node, bin, pixel)
    gram = np.einsum("ibp,bp,jbp->ijp", base, weight, base)
    information, linear = [], []
    bends = np.broadcast_to(bend, (len(tile.noise) - 1, total.size))
    ridge = 1e-9 * total * np.eye(4)[..., np.newaxis]
    for m in range(1, len(tile.noise)):
        moment = np.einsum("ibp,bp,bp->ip", base, weight, means.signals[m])
        fitted = np.linalg.solve(np.moveaxis(gram + ridge, -1, 0), moment.T[..., np.newaxis])
        residual = means.signals[m] - np.einsum("ibp,pi->bp", base, fitted[..., 0])
        noise = tile.noise[m] ** 2 + tile.noise[0] ** 2  # of one frame
        variance = _long_run(residual, weight, bins_used, noise)
        inverse, right = gram / variance, moment / variance
        # Of a constant, quadratic and cubic part of variance p^2 is told nothing:
        # H - H b b^T H / (1 / p^2 + b^T H b).
        for shape, deviation in zip(
            _SHAPES, (offset[m - 1], bends[m - 1], bends[m - 1]), strict=True
        ):
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
    parts = []
    for node in _NODES:
        others = _NODES[node != _NODES]
        parts.append(np.prod([(places - one) / (node - one) for one in others], axis=0))
    return np.asarray(parts)


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


class _Given(NamedTuple):
    """What is known of each pixel."""

    grid: Array  # of the first emissivity (pixel, grid) [1]
    mean: Array  # of the prior's components (pixel, component, band) [1]
    covariance: Array  # (pixel, component, band, band) [1]
    level: Array  # of the background, and its deviation (pixel, 2) [K]
    nodes: Array  # see `Curve`, of pixels first
    information: Array
    linear: Array


class _Work(NamedTuple):
    """Quantities on the grid of one pixel: (grid, component, ...), or (grid, band - 1, ...)."""

    density: Array  # prior of the first emissivity, a logarithm; of the cells
    weight: Array  # of the posterior, a logarithm first
    normal: Array  # mean and precision of the other emissivities (grid, component, 2, band - 1)
    whole: Array  # the same of the components as one (grid, 2, band - 1)
    place: Array  # where the model is linearised, (e, c) (grid, band + 1)
    likelihood: Array  # quadratic functions, see `_quadratic` (grid, band - 1, 6)
    values: Array  # mean of (e, c) (grid, component, band + 1)
    slope: Array  # of the other emissivities with c (grid, component, band - 1) [1/K]
    loose: Array  # their variances at a value of c (grid, component, band - 1)
    stiff: Array  # precision of c (grid, component) [1/K^2]
    signals: Array  # spare (5, 5 * grid)


def moments(tile: Tile, data: Curve, prior: Mixture, level: Level) -> Moments:
    """Posterior of the emissivities and of the background's level, steps 1 and 2."""
    grid = prior.grid()  # (grid, pixel)
    (points, pixels), size, parts = grid.shape, len(tile.noise) + 1, prior.weight.size
    levels = np.stack([np.broadcast_to(part, pixels) for part in (level.signal, level.std)])
    curve_parts = (data.nodes, data.information, data.linear)
    shapes = {"whole": (2, size - 2), "place": (size,), "likelihood": (size - 2, 6)}
    shapes |= {"normal": (parts, 2, size - 2), "values": (parts, size)}
    shapes |= dict.fromkeys(("slope", "loose"), (parts, size - 2))
    work = {name: np.empty((points, *shapes.get(name, (parts,)))) for name in _Work._fields}
    work["signals"] = np.empty((5, 5 * points))
    share = np.empty((pixels, points))
    mean, spread = np.empty((pixels, 2, size)), np.empty((pixels, 2, size, size))
    _moments(
        frames.response_tables(tile),
        np.log(prior.weight),
        _Given(
            *(
                np.ascontiguousarray(np.moveaxis(part, -1, 0))
                for part in (grid, prior.mean, prior.covariance, levels, *curve_parts)
            )
        ),
        _Work(**work),
        share,
        mean,
        spread,
    )
    (plain, mean), (covariance, spread) = (
        np.ascontiguousarray(np.moveaxis(part, 0, -1)) for part in (mean, spread)
    )
    # The blackest emissivity that is as improbable; the grid rises.
    above = np.cumsum(share.T[::-1], axis=0)[::-1] - 0.5 * share.T
    blackest = _crossing(grid, above, _WORSE)
    bound = 1.0 + 2.0 * (1.0 / blackest - 1.0) if parts > 1 else np.inf
    moved = np.minimum(mean[0], bound) - mean[0]
    mean[0] += moved
    spread[0, 0] += moved**2
    # e_1 = 1 / a, e_m = rho_m / a; de_1 = -e_1 / a da, de_m = (drho_m - e_m da) / a.
    a = mean[0]
    point = np.concatenate([np.ones((1, a.size)), mean[1:-1]]) / a
    change = np.eye(len(mean))[..., np.newaxis] / a
    change[:-1, 0] = -point / a
    change[-1, -1] = 1.0
    spread = np.einsum("imp,mnp,jnp->ijp", change, spread, change, optimize=True)
    return Moments(point, mean[-1], spread, plain[:-1], covariance[:-1, :-1])


def _crossing(grid: Array, falling: Array, level: float) -> Array:
    """Place (pixel) on a grid (grid, pixel) at which a function that falls along it has a value."""
    after = np.clip((falling > level).sum(axis=0), 1, len(grid) - 1)
    (low, high), (more, less) = (
        np.take_along_axis(part, np.stack([after - 1, after]), 0) for part in (grid, falling)
    )
    part = np.clip((more - level) / np.maximum(more - less, 1e-300), 0.0, 1.0)
    return np.asarray(low + part * (high - low))


@compiled
def _moments(
    tables: tuple[kernels.Table, ...],
    weight: Array,
    given: _Given,
    work: _Work,
    share: Array,
    means: Array,
    spreads: Array,
) -> None:
    """Probability on the grid (pixel, grid), and moments of (e, c) and (1 / e_1, e_m / e_1, c).

    (pixel, 2, band + 1), (pixel, 2, band + 1, band + 1), in place; the weights are logarithms.
    """
    for p in range(len(share)):
        mean, covariance = given.mean[p], given.covariance[p]
        if (
            p == 0
            or np.any(mean != given.mean[p - 1])
            or np.any(covariance != given.covariance[p - 1])
        ):
            _condition(mean, covariance, weight, given.grid[p], work)
        _linearise(tables, given, p, work)
        for g in range(share.shape[1]):
            for k in range(weight.size):
                work.values[g, k, 0] = given.grid[p, g]
                evidence, work.stiff[g, k] = _eliminate(
                    work.likelihood[g],
                    work.normal[g, k],
                    given.level[p],
                    work.values[g, k],
                    work.slope[g, k],
                    work.loose[g, k],
                )
                work.weight[g, k] = work.density[g, k] + evidence
        _normalise(work)
        for g in range(share.shape[1]):
            share[p, g] = work.weight[g].sum()
        for way in range(2):
            _average(work, way, means[p, way], spreads[p, way])


@compiled
def _condition(mean: Array, covariance: Array, weight: Array, grid: Array, work: _Work) -> None:
    """Log-density of the first emissivity, and mean and precision of the others at it, in place.

    The others are taken as independent given the first.
    """
    points, bands = grid.size, mean.shape[1]
    for g in range(points):
        low, high = grid[max(g - 1, 0)], grid[min(g + 1, points - 1)]
        cell = np.log((high - low) / (min(g + 1, points - 1) - max(g - 1, 0)))
        log, normal, whole = work.density[g], work.normal[g], work.whole[g]
        for k in range(weight.size):
            variance, off = covariance[k, 0, 0], grid[g] - mean[k, 0]
            log[k] = weight[k] - 0.5 * (np.log(variance) + off**2 / variance)
            for m in range(bands - 1):
                slope = covariance[k, 1 + m, 0] / variance
                normal[k, 0, m] = mean[k, 1 + m] + slope * off
                rest = covariance[k, 1 + m, 1 + m] - slope * covariance[k, 1 + m, 0]
                normal[k, 1, m] = 1.0 / max(rest, 1e-8)
        share = np.exp(log - log.max())
        share /= share.sum()
        for m in range(bands - 1):
            whole[0, m] = (share * normal[:, 0, m]).sum()
            wide = 1.0 / normal[:, 1, m] + (normal[:, 0, m] - whole[0, m]) ** 2
            whole[1, m] = 1.0 / (share * wide).sum()
        log += cell


@compiled
def _linearise(tables: tuple[kernels.Table, ...], given: _Given, p: int, work: _Work) -> None:
    """Log-likelihoods of a pixel about its best values at each point of the grid, in place.

    Those of a Gauss-Newton method, with the components of the prior taken as one.
    """
    points, others, settled = work.whole.shape[0], work.whole.shape[2], False
    for g in range(points):
        work.place[g, 0], work.place[g, 1 + others] = given.grid[p, g], given.level[p, 0]
        for m in range(others):
            work.place[g, 1 + m] = work.whole[g, 0, m]
    for step in range(_STEPS + 1):
        for m in range(others):
            for g in range(points):
                work.place[g, 1 + m] = min(max(work.place[g, 1 + m], _BOUNDS[0]), _BOUNDS[1])
            _quadratic(tables[0], tables[1 + m], given, p, m, work)
        if step == _STEPS or settled:
            break
        settled = True
        for g in range(points):
            before = work.place[g, 1 + others]
            spare = work.slope[g, 0], work.loose[g, 0]
            knowledge = work.likelihood[g], work.whole[g], given.level[p]
            _eliminate(*knowledge, work.place[g], *spare)
            change = abs(work.place[g, 1 + others] - before)
            settled &= not change > _SETTLED * given.level[p, 1]


@compiled
def _quadratic(
    first: kernels.Table, other: kernels.Table, given: _Given, p: int, band: int, work: _Work
) -> None:
    """Log-likelihoods of another band as quadratic functions about zero, in place.

    Near (e_1, e_m, c): value; slopes with e_m, with c; curvatures with e_m, both, c.
    """
    nodes, linear, information = given.nodes[p], given.linear[p, band], given.information[p, band]
    signal, emitted, rate = work.signals[0], work.signals[1], work.signals[2]
    of_e, of_c = np.empty(4), np.empty(4)
    for g in range(len(work.place)):
        c = signal[5 * g + 4] = work.place[g, -1]
        for i in range(4):
            signal[5 * g + i] = c + (nodes[i] - c) / work.place[g, 0]
    spare = work.signals[3], work.signals[4]
    frames.other_band(first, other, signal, emitted, rate, *spare)
    for g in range(len(work.place)):
        share, e, c = 1.0 / work.place[g, 0], work.place[g, 1 + band], work.place[g, -1]
        level, by_level = emitted[5 * g + 4], (1.0 - e) * rate[5 * g + 4]
        for i in range(4):
            of_e[i] = emitted[5 * g + i] - level
            of_c[i] = by_level + e * rate[5 * g + i] * (1.0 - share)
        square, value, by_e, by_c, ee, ec, cc = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(4):
            here, here_e, here_c = 0.0, 0.0, 0.0  # H times the model and its slopes
            for j in range(4):
                here += information[i, j] * (level + e * of_e[j])
                here_e += information[i, j] * of_e[j]
                here_c += information[i, j] * of_c[j]
            model, left = level + e * of_e[i], linear[i] - here
            value, square = value + linear[i] * model, square + model * here
            by_e, by_c = by_e + of_e[i] * left, by_c + of_c[i] * left
            ee, ec, cc = ee + of_e[i] * here_e, ec + of_e[i] * here_c, cc + of_c[i] * here_c
        # L = L0 + g d - d A d / 2 with d = (e, c) less the point.
        result = work.likelihood[g, band]
        result[0] = value - 0.5 * square - by_e * e - by_c * c
        result[0] -= 0.5 * (ee * e**2 + 2.0 * ec * e * c + cc * c**2)
        result[1], result[2] = by_e + ee * e + ec * c, by_c + ec * e + cc * c
        result[3], result[4], result[5] = ee, ec, cc


@compiled
def _eliminate(
    likelihood: Array, normal: Array, level: Array, values: Array, slope: Array, loose: Array
) -> tuple[float, float]:
    """Evidence, and the precision of c; mean of (e_m, c), slopes of e_m with c and variances at it.

    Given c the e_m are independent, so they are eliminated first, and c last.
    """
    precision, evidence, scale = 1.0 / level[1] ** 2, 0.0, 1.0
    curvature, toward = precision, precision * level[0]
    for m in range(loose.size):
        mean, weight, ec = normal[0, m], normal[1, m], likelihood[m, 4]
        variance, right = 1.0 / (likelihood[m, 3] + weight), likelihood[m, 1] + mean * weight
        loose[m], slope[m], values[1 + m] = variance, -ec * variance, right * variance
        scale *= variance * weight
        evidence += likelihood[m, 0] - 0.5 * (mean**2 * weight - right**2 * variance)
        curvature += likelihood[m, 5] - ec**2 * variance
        toward += likelihood[m, 2] - ec * right * variance
    c = toward / curvature
    values[-1] = c
    for m in range(loose.size):
        values[1 + m] += slope[m] * c
    return evidence + 0.5 * (np.log(scale * precision / curvature) + toward * c), curvature


@compiled
def _normalise(work: _Work) -> None:
    """Weights (grid, component) that add up to 1 of logarithms, in place.

    Each times the probability that the other emissivities lie between 0 and 1.
    """
    weight = work.weight
    for g, k in np.ndindex(weight.shape):
        weight[g, k] = weight[g, k] if np.isfinite(weight[g, k]) else -np.inf
    highest = weight.max()
    for g, k in np.ndindex(weight.shape):
        share = np.exp(weight[g, k] - highest)
        for m in range(work.slope.shape[2] if share > _NEGLIGIBLE else 0):
            variance = work.slope[g, k, m] ** 2 / work.stiff[g, k] + work.loose[g, k, m]
            value, scale = work.values[g, k, 1 + m], 1.0 / np.sqrt(2.0 * variance)
            share *= 0.5 * (math.erf((1.0 - value) * scale) + math.erf(value * scale))
        weight[g, k] = share if share > _NEGLIGIBLE else 0.0
    weight /= weight.sum()


@compiled
def _average(work: _Work, relative: int, mean: Array, spread: Array) -> None:
    """Mean and covariance of (e, c), or of (1 / e_1, e_m / e_1, c), over grid and components."""
    size = mean.size
    part, direction = np.empty(size), np.ones(size)
    mean[:], spread[:], direction[0] = 0.0, 0.0, 0.0
    for second in range(2):
        for g, k in np.ndindex(work.weight.shape):
            weight = work.weight[g, k]
            if weight == 0.0:
                continue
            scale = 1.0 / work.values[g, k, 0] if relative else 1.0
            for i in range(size):
                part[i] = work.values[g, k, i] * (scale if i < size - 1 else 1.0) - mean[i] * second
            part[0] = (scale if relative else work.values[g, k, 0]) - mean[0] * second
            if second == 0:
                for i in range(size):
                    mean[i] += weight * part[i]
                continue
            # Given e_1, c has the variance 1 / stiff, of which e_m follows a share.
            inner = 1.0 / work.stiff[g, k]
            for m in range(size - 2):
                direction[1 + m] = work.slope[g, k, m] * scale
                spread[1 + m, 1 + m] += weight * work.loose[g, k, m] * scale**2
            for i in range(size):
                for j in range(size):
                    moved = part[i] * part[j] + inner * direction[i] * direction[j]
                    spread[i, j] += weight * moved


def behind(
    tile: Tile, static: Moments, measured: Array, valid: Mask, fluctuation: Array
) -> tuple[Array, Array]:
    r"""Background behind a measured object (time, pixel) [K], and its variance [K^2].

    What the object's temperatures and deviations (2, time, pixel) [K] leave of the first band,

    .. math:: r_0 = \frac{z_1 - e_1 s}{1 - e_1}, \quad
              r = c + g (\bar r_0 - c) + k (r_0 - \bar r_0)

    The object's error is common to all frames: it makes the mean over time uncertain, which leans
    on the level c, and not the change about it. NaN where no object temperature was measured.
    """
    curve, e = tile.curves[0], static.emissivity[0]
    signal, dark = curve.signal(measured[0]) - tile.reference, 1.0 - e
    seen = np.where(valid, (tile.signals[0] - e * signal) / dark, np.nan)
    used = np.isfinite(seen)
    number = np.maximum(used.sum(axis=0), 1)

    def mean(values: Array) -> Array:
        return np.asarray(np.where(used, values, 0.0).sum(axis=0) / number)

    noise = (tile.noise[0] / dark) ** 2
    common = mean((e * measured[1] * curve.slope(measured[0]) / dark) ** 2) + noise / number
    change, level = fluctuation / (fluctuation + noise), fluctuation / (fluctuation + common)
    middle, off = mean(seen), (seen - signal) / dark
    value = static.level + level * (middle - static.level) + change * (seen - middle)
    # dr_0 = (r_0 - s) / (1 - e_1) de_1
    slope = np.zeros((len(static.covariance), *seen.shape))
    slope[0], slope[-1] = level * mean(off) + change * (off - mean(off)), 1.0 - level
    spread = level * common + change * noise
    through = np.einsum("itp,ijp,jtp->tp", slope, static.covariance, slope, optimize=True)
    return value, spread + np.maximum(through, 0.0)


def fluctuation(tile: Tile, static: Moments, means: Bins, expected: float) -> Array:
    """Variance (pixel) [K^2] of the background over time: what bins show beyond noise.

    Weighed against what is expected, as uncertain as it is large.
    """
    vague = np.full_like(static.level, _VAGUE)
    bins_alone = replace(tile, signals=means.signals)
    free = frames.solve(bins_alone, static.point, static.level, vague)
    observed, noise = free.background, free.background_variance / np.maximum(means.frames, 1.0)
    used = means.frames > 0
    count = np.maximum(used.sum(axis=0), 2)
    centre = np.where(used, observed, 0.0).sum(axis=0) / count
    total = np.where(used, (observed - centre) ** 2, 0.0).sum(axis=0) / (count - 1)
    noise = np.where(used, noise, 0.0).sum(axis=0) / count
    # A variance of n values is known to 2 / n of its square.
    precision = (count - 1) / (2.0 * np.maximum(total, noise) ** 2)
    prior = expected**-4.0
    excess = np.maximum(total - noise, 0.0)
    result = (precision * excess + prior * expected**2) / (precision + prior)
    return np.where(np.isfinite(result), result, expected**2)
