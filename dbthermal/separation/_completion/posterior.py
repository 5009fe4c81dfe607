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

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import ndtr

from dbthermal.separation import _known_emissivity as known_emissivity
from dbthermal.separation._completion.prior import Mixture
from dbthermal.separation._tiles import Array, Mask, Tile, Whole

# Bins of time, at most, and frames in each, at least.
_BINS: Final = 32
_LEAST: Final = 2
# Nodes of the cubic over a range of [-1, 1], its Chebyshev points; half the range, at least [K].
_NODES: Final = np.cos(np.pi * (np.arange(4) + 0.5) / 4.0)
_LEAST_RANGE: Final = 0.5
# A quadratic and a cubic that are no part of a line, at the nodes: Chebyshev's polynomials.
_BENDS: Final = np.cos(np.multiply.outer([2.0, 3.0], np.arccos(_NODES)))
# The first band's change over its noise, in variance, from which a slope is not attenuated.
_SEEN: Final = 25.0
# Probability that the object is farther off than the camera's own reading, at most [1].
_WORSE: Final = 0.04
_STEPS: Final = 2
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
    starts: Whole  # first frame of each bin

    def mean(self, values: Array, valid: Mask) -> Array:
        """Means (bin, pixel) of values (time, pixel)."""
        total = np.add.reduceat(np.where(valid, values, 0.0), self.starts, axis=0)
        return np.asarray(total / np.maximum(self.frames, 1.0))


@dataclass(frozen=True)
class Moments:
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
    return Bins(total / np.maximum(frames, 1.0), frames, starts)


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
        if offset[m - 1] > 0:  # an offset of variance p^2: H - H 1 1^T H / (1 / p^2 + 1^T H 1)
            row = inverse.sum(axis=1)
            share = 1.0 / (offset[m - 1] ** -2 + row.sum(axis=0))
            right = right - row * (share * right.sum(axis=0))
            inverse = inverse - share * row[:, np.newaxis] * row
        for one in _BENDS:  # the same, of a quadratic and a cubic of variance p^2
            row = np.einsum("ijp,j->ip", inverse, one)
            share = bends[m - 1] ** 2 / (1.0 + bends[m - 1] ** 2 * (one @ row))
            right = right - row * (share * (one @ right))
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


def moments(tile: Tile, data: Curve, prior: Mixture, level: Level) -> Moments:
    """Posterior of the emissivities and of the background's level, steps 1 and 2."""
    grid, spacing = prior.grid()  # (grid, pixel)
    density, mean, variance = prior.conditional(grid)  # (component, [band - 1,] grid, pixel)
    share = np.exp(density - density.max(axis=0))
    share = (share / share.sum(axis=0))[:, np.newaxis]
    centre = (share * mean).sum(axis=0, keepdims=True)
    wide = (share * (variance + (mean - centre) ** 2)).sum(axis=0, keepdims=True)
    e, c = np.clip(centre[0], *_BOUNDS), np.broadcast_to(level.signal, grid.shape)
    for _ in range(_STEPS):  # Gauss-Newton, with the components of the prior taken as one
        curvature = _quadratic(tile, data, grid, e, c)
        _, values, _ = _eliminate(curvature, centre, wide, level)
        e, c = np.clip(values[0, :-1], *_BOUNDS), values[0, -1]
    curvature = _quadratic(tile, data, grid, e, c)
    evidence, values, covariance = _eliminate(curvature, mean, variance, level)
    std = np.sqrt(np.einsum("kiigp->kigp", covariance)[:, :-1])
    inside = ndtr((1.0 - values[:, :-1]) / std) - ndtr(-values[:, :-1] / std)
    log = density + evidence + np.log(spacing) + np.log(inside).sum(axis=1)
    log = np.where(np.isfinite(log), log, -np.inf)
    weight = np.exp(log - log.max(axis=(0, 1)))
    weight = weight / weight.sum(axis=(0, 1))
    plain = _average(weight, grid, np.ones_like(grid), values, covariance)
    mean, spread = _average(weight, 1.0 / grid, 1.0 / grid, values, covariance)
    # The blackest emissivity that is as improbable; the grid rises.
    share = weight.sum(axis=0)
    above = 1.0 - np.cumsum(share, axis=0) + 0.5 * share
    blackest = _crossing(grid, above, _WORSE)
    moved = np.minimum(mean[0], 1.0 + 2.0 * (1.0 / blackest - 1.0)) - mean[0]
    mean[0] += moved
    spread[0, 0] += moved**2
    # e_1 = 1 / a, e_m = rho_m / a; de_1 = -e_1 / a da, de_m = (drho_m - e_m da) / a.
    a = mean[0]
    point = np.concatenate([np.ones((1, a.size)), mean[1:-1]]) / a
    change = np.eye(len(mean))[..., np.newaxis] / a
    change[:-1, 0] = -point / a
    change[-1, -1] = 1.0
    spread = np.einsum("imp,mnp,jnp->ijp", change, spread, change, optimize=True)
    return Moments(point, mean[-1], spread, plain[0][:-1], plain[1][:-1, :-1])


def _crossing(grid: Array, falling: Array, level: float) -> Array:
    """Place (pixel) on a grid (grid, pixel) at which a function that falls along it meets a level."""
    after = np.clip((falling > level).sum(axis=0), 1, len(grid) - 1)
    (low, high), (more, less) = (
        np.take_along_axis(part, np.stack([after - 1, after]), 0) for part in (grid, falling)
    )
    part = np.clip((more - level) / np.maximum(more - less, 1e-300), 0.0, 1.0)
    return np.asarray(low + part * (high - low))


def _quadratic(tile: Tile, data: Curve, grid: Array, e: Array, c: Array) -> Array:
    """Log-likelihoods as quadratic functions about zero, near emissivities e and a level c.

    (6, band - 1, grid, pixel): value; slopes with e_m, with c; curvatures with e_m, both, c.
    """
    nodes, step = data.nodes[:, np.newaxis], 0.05  # [K]
    parts = []
    for m in range(1, len(tile.noise)):
        one, information = e[m - 1], data.information[m - 1]
        level, above = (
            known_emissivity.other_band(tile, m, c),
            known_emissivity.other_band(tile, m, c + step),
        )
        by_e = known_emissivity.other_band(tile, m, c + (nodes - c) / grid) - level
        raised = known_emissivity.other_band(tile, m, c + step + (nodes - c - step) / grid) - above
        by_c = (above - level + one * (raised - by_e)) / step
        model = np.stack([level + one * by_e, by_e, by_c])  # (3, node, grid, pixel)
        weighted = np.einsum("ijp,ajgp->aigp", information, model)
        products = np.einsum("aigp,bigp->abgp", model, weighted)
        given = np.einsum("ip,aigp->agp", data.linear[m - 1], model)
        value = given[0] - 0.5 * products[0, 0]
        slope = given[1:] - products[0, 1:]
        (ee, ec), (_, cc) = products[1:, 1:]
        # L = L0 + g d - d A d / 2 with d = (e, c) less the point.
        value = value - slope[0] * one - slope[1] * c
        value = value - 0.5 * (ee * one**2 + 2.0 * ec * one * c + cc * c**2)
        slope = slope[0] + ee * one + ec * c, slope[1] + ec * one + cc * c
        parts.append([value, *slope, ee, ec, cc])
    return np.moveaxis(np.array(parts), 1, 0)


def _eliminate(
    likelihood: Array, mean: Array, variance: Array, level: Level
) -> tuple[Array, Array, Array]:
    """Evidence (component, grid, pixel), mean and covariance of (e_m, c).

    Given c the e_m are independent, so they are eliminated first, and c last.
    """
    value, by_e, by_c, ee, ec, cc = likelihood
    precision = 1.0 / np.square(level.std)
    stiff = ee + 1.0 / variance
    right = by_e + mean / variance
    curvature = precision + (cc - ec**2 / stiff).sum(axis=1)
    toward = precision * level.signal + (by_c - ec * right / stiff).sum(axis=1)
    c = toward / curvature
    evidence = value - 0.5 * (np.log(stiff * variance) + mean**2 / variance - right**2 / stiff)
    evidence = evidence.sum(axis=1) + 0.5 * (np.log(precision / curvature) + toward * c)
    slope = -ec / stiff
    e = right / stiff + slope * c[:, np.newaxis]
    slope = np.concatenate([slope, np.ones_like(c)[:, np.newaxis]], axis=1)
    covariance = slope[:, :, None] * slope[:, None] / curvature[:, None, None]
    for m in range(e.shape[1]):
        covariance[:, m, m] += 1.0 / stiff[:, m]
    return evidence, np.concatenate([e, c[:, np.newaxis]], axis=1), covariance


def _average(
    weight: Array, first: Array, scale: Array, values: Array, covariance: Array
) -> tuple[Array, Array]:
    """Mean and covariance, over components and grid, of a first, of e_m by a scale, and of c."""
    scales = np.ones((values.shape[1], *scale.shape))
    scales[:-1] = scale
    head = np.broadcast_to(first, (values.shape[0], 1, *first.shape))
    parts = np.concatenate([head, values * scales], axis=1)
    parts = np.where(weight[:, np.newaxis] > 0, parts, 0.0)
    mean = np.einsum("kgp,kigp->ip", weight, parts)
    off = parts - mean[:, np.newaxis]
    total = np.einsum("kgp,kigp,kjgp->ijp", weight, off, off, optimize=True)
    inner = np.where(weight[:, np.newaxis, np.newaxis] > 0, covariance, 0.0)
    within = np.einsum("kgp,kijgp,igp,jgp->ijp", weight, inner, scales, scales, optimize=True)
    total[1:, 1:] += within
    return mean, total


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
    return value, spread + known_emissivity.through(slope, static.covariance)


def fluctuation(tile: Tile, static: Moments, means: Bins, valid: Mask, expected: float) -> Array:
    """Variance (pixel) [K^2] of the background over time: what bins show beyond noise.

    Weighed against what is expected, as uncertain as it is large.
    """
    vague = np.full_like(static.level, _VAGUE)
    free = known_emissivity.solve(tile, static.point, static.level, vague)
    observed = means.mean(free.background, valid)
    noise = means.mean(free.background_variance, valid) / np.maximum(means.frames, 1.0)
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
