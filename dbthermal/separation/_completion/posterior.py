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
   :math:`(e_m, c)` are closed forms, for each component of the prior. Rapid changes, of which
   :math:`1 - e_1` is mirrored, weigh the library's prior. Their moments over the grid
   are kept in :math:`a = 1 / e_1`, :math:`\rho_m = e_m / e_1` and c, in which s is nearly linear:
   :math:`s = c + a (z_1 - c)`. The mean of a is taken no farther from 1, the camera's own reading,
   than is no worse than that with a probability of 95 %.
3. Frame by frame s and f are the posterior mean, the latter of a variance that the bins show.
"""

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import xarray as xr

from dbthermal import _numbers, _text, emissivity, schema
from dbthermal._compiled import compiled
from dbthermal._smooth import largest
from dbthermal.separation import _frames as frames
from dbthermal.separation._frames import other_band
from dbthermal.separation._subspace import kernels
from dbthermal.separation._tiles import Array, Mask, Pixels, Tile, Whole

# Deviation of the emissivity of one sample of a material from that of the table [1].
_SAMPLE_STD: Final = 0.02
# Probability that the object is farther off than the camera's own reading, at most [1].
_RISK: Final = 0.04
# Steps of Gauss-Newton, at most, and the change of the level over its deviation that ends them [1].
_STEPS, _SETTLED = 8, 0.02
_CHANCE: Final = 0.001  # chance that an object itself changes rapidly
_NEGLIGIBLE: Final = 1e-9  # share of the largest weight
_BOUNDS: Final = (0.01, 0.999)  # of the emissivities about which the model is linearised
_VAGUE: Final = 1e6  # where nothing bounds the fluctuation of the background: its variance [K^2]
# Bins of time, at most, and frames in each, at least.
_BINS: Final = 32
_BIN_FRAMES: Final = 2
# Nodes of the cubic over a range of [-1, 1], its Chebyshev points; half the range, at least [K].
_NODES: Final = np.cos(np.pi * (np.arange(4) + 0.5) / 4.0)
_LEAST_RANGE: Final = 0.5
# A constant, a quadratic and a cubic, at the nodes: Chebyshev's polynomials.
_SHAPES: Final = np.cos(np.multiply.outer([0.0, 2.0, 3.0], np.arccos(_NODES)))
# The first band's change over its noise, in variance, from which a slope is not attenuated.
_CONTRAST: Final = 25.0
# Grid of the first emissivity for a wide prior, finer towards 1; points and reach of a narrow one.
_GRID: Final = np.concatenate(
    [np.linspace(0.03, 0.78, 16), np.linspace(0.8, 0.97, 18), np.linspace(0.975, 0.9975, 7)]
)
_POINTS: Final = 17
_SIGMAS: Final = 4.0
_LIMITS: Final = (0.005, 0.9995)


@dataclass(frozen=True)
class Mixture:
    """Normal distributions of the emissivities; of more than one component the same everywhere."""

    weight: Array  # (component,)
    mean: Array  # (component, band, pixel) [1]
    covariance: Array  # (component, band, band, pixel) [1]

    @classmethod
    def of_prior(cls, prior: str | xr.DataArray | xr.Dataset | None, bands: list[str]) -> "Mixture":
        """Prior of the libraries, of a material of the table, or of the user; see `complete`."""
        if prior is None:
            table = emissivity.library_mixture(bands)
            arrays = (table[name].values[..., np.newaxis] for name in ("mean", "covariance"))
            return cls(table["weight"].values, *arrays)
        if isinstance(prior, str):
            materials = emissivity.embedded_table()["emissivity"]
            _text.check_listed("Unknown prior", prior, materials["material"].values.tolist())
            prior = materials.sel(material=prior)
        stds = np.full(len(bands), _SAMPLE_STD)
        if isinstance(prior, xr.Dataset):
            if missing := {"emissivity", "emissivity_std"} - set(prior):
                raise ValueError(f"Missing '{min(missing)}' in prior {[*prior]}. Must be there.")
            prior, std = prior["emissivity"], prior["emissivity_std"]
            stds = schema.band_values(std, bands, "emissivity_std of the prior", "1")
        values = schema.band_values(prior, bands, "prior", "1")
        for name, numbers in (("emissivity", values), ("emissivity_std", stds)):
            _numbers.real_numbers(f"{name} of the prior", numbers, _numbers.FRACTION)
        return cls(np.ones(1), values[None, :, None], np.diag(stds**2)[None, ..., None])

    def grid(self) -> Array:
        """Grid (grid, pixel) of the first emissivity."""
        pixels = self.mean.shape[-1]
        if len(self.weight) > 1:
            return np.repeat(_GRID[:, np.newaxis], pixels, axis=1)
        std = np.sqrt(self.covariance[0, 0, 0])
        low = np.maximum(self.mean[0, 0] - _SIGMAS * std, _LIMITS[0])
        high = np.minimum(self.mean[0, 0] + _SIGMAS * std, _LIMITS[1])
        return np.asarray(low + np.linspace(0.0, 1.0, _POINTS)[:, np.newaxis] * (high - low))

    def at(self, places: Whole | int) -> "Mixture":
        """Return the mixture of some pixels, or of labels (pixel,)."""
        return Mixture(self.weight, self.mean[..., places], self.covariance[..., places])


@dataclass(frozen=True)
class Level:
    """Prior on the background: its level, and how much it changes over time."""

    signal: Array | float  # first band's signal, less the reference (pixel) [K]
    std: Array | float  # (pixel) [K]
    fluctuation: float  # standard deviation over time [K]
    rapid: float = np.inf  # standard deviation of its rapid changes [K]
    scatter: float = np.inf  # of the logarithm of rapid changes between pixels [1]

    def at(self, places: Whole) -> "Level":
        """Return the level of some pixels, an array each (pixel)."""
        arrays = (np.asarray(array, dtype=np.float64) for array in (self.signal, self.std))
        signal, std = (
            array[places] if array.ndim else np.full(places.size, array) for array in arrays
        )
        return replace(self, signal=signal, std=std)


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
    size = max(_BIN_FRAMES, -(-tile.time.size // _BINS))
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
    centred = centred * (energy > _CONTRAST * (tile.noise[0] ** 2 * bins_used + stray * total))
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


def _long_run(residual: Array, weight: Array, count: Array, noise: float) -> Array:
    """Variance (pixel) [K^2] of a frame that gives the bins' scatter, with their correlation."""
    scaled = np.sqrt(weight) * residual
    freedom = np.maximum(count - 4, 1)
    variance = (scaled**2).sum(axis=0) / freedom
    power = np.maximum((scaled**2).sum(axis=0), np.finfo(np.float64).tiny)
    lags = [(scaled[lag:] * scaled[:-lag]).sum(axis=0) for lag in (1, 2) if lag < len(scaled)]
    correlated = 1.0 + 2.0 * np.sum([np.maximum(lag / power, 0.0) for lag in lags], axis=0)
    excess = variance > noise * (1.0 + 3.0 * np.sqrt(2.0 / freedom))
    return np.asarray(np.where(excess, variance * correlated, noise))


def moments(tile: Tile, data: Curve, prior: Mixture, level: Level, rapid: Array) -> Moments:
    """Posterior of the emissivities and of the background's level, steps 1 and 2."""
    grid = prior.grid()  # (grid, pixel)
    # The rapid changes (pixel) [K] bound what the pixel mirrors.
    mirrored = _of_rapid(grid, rapid, level) if prior.weight.size > 1 else np.zeros_like(grid)
    (points, pixels), size = grid.shape, len(tile.noise) + 1
    levels = np.stack([np.broadcast_to(array, pixels) for array in (level.signal, level.std)])
    arrays = (grid, prior.mean, prior.covariance, levels, mirrored, *vars(data).values())
    share, means = np.empty((pixels, points)), np.empty((pixels, 2, size))
    spreads = np.empty((pixels, 2, size, size))
    knowledge = tuple(np.ascontiguousarray(np.moveaxis(array, -1, 0)) for array in arrays)
    tables, weight = frames.response_tables(tile), np.log(prior.weight)
    _moments(tables, weight, knowledge, (share, means, spreads))
    plain, mean = np.ascontiguousarray(np.moveaxis(means, 0, -1))
    covariance, spread = np.ascontiguousarray(np.moveaxis(spreads, 0, -1))
    # The blackest emissivity that is as improbable; the grid rises.
    above = np.cumsum(share.T[::-1], axis=0)[::-1] - 0.5 * share.T
    blackest = _crossing(grid, above, _RISK)
    bound = 1.0 + 2.0 * (1.0 / blackest - 1.0) if prior.weight.size > 1 else np.inf
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


def _of_rapid(grid: Array, rapid: Array, level: Level) -> Array:
    """Log-likelihood (grid, pixel) of the rapid changes of a pixel beside the background's."""
    # A surface mirrors 1 - e_1 of the changes, and may face calmer ones. Livelier changes are as
    # probable as their logarithms scatter; or the object itself changes rapidly.
    with np.errstate(divide="ignore"):
        excess = np.nan_to_num(np.maximum(np.log(rapid / level.rapid / (1.0 - grid)), 0.0))
    return np.maximum(-0.5 * (excess / level.scatter) ** 2, math.log(_CHANCE))


def _crossing(grid: Array, falling: Array, level: float) -> Array:
    """Place (pixel) on a grid (grid, pixel) at which a function that falls along it has a value."""
    after = np.clip((falling > level).sum(axis=0), 1, len(grid) - 1)
    ends = np.stack([after - 1, after])
    low, high = np.take_along_axis(grid, ends, axis=0)
    top, bottom = np.take_along_axis(falling, ends, axis=0)
    share = np.clip((top - level) / np.maximum(top - bottom, 1e-300), 0.0, 1.0)
    return np.asarray(low + share * (high - low))


@compiled
def _moments(
    tables: tuple[kernels.Table, ...],
    weight: Array,
    knowledge: tuple[Array, ...],
    result: tuple[Array, Array, Array],
) -> None:
    """Probability on the grid (pixel, grid), and moments of (e, c) and (1 / e_1, e_m / e_1, c)."""
    # Of each pixel its grid, mean and covariance of the prior's components, the background's level
    # and its deviation, the log-likelihood of rapid changes, and the parts of its `Curve`.
    grids, means, covariances, levels, mirrored, nodes, information, linear = knowledge
    points, components, count = grids.shape[1], weight.size, means.shape[2] - 1
    # Prior and posterior of (grid, component), logarithms at first, and the precisions of c.
    density, posterior = np.empty((points, components)), np.empty((points, components))
    stiff = np.empty((points, components))
    # Mean and precision of the other emissivities before, and of the components as one.
    normal, mixture = np.empty((points, components, 2, count)), np.empty((points, 2, count))
    # Mean of (e, c); slopes of the others with c, and their variances at a value of it.
    values = np.empty((points, components, count + 2))
    slope, loose = np.empty((points, components, count)), np.empty((points, components, count))
    place, likelihood = np.empty((points, count + 2)), np.empty((points, count, 6))
    spare = np.empty((5, 5 * points))
    for p in range(len(grids)):
        mean, covariance = means[p], covariances[p]
        if p == 0 or np.any(mean != means[p - 1]) or np.any(covariance != covariances[p - 1]):
            _condition((weight, mean, covariance), grids[p], density, normal, mixture)
        # About the best values at each point of the grid, with the components taken as one, by
        # the method of Gauss and Newton.
        for g in range(points):
            place[g, 0], place[g, 1 + count] = grids[p, g], levels[p, 0]
            place[g, 1 : 1 + count] = mixture[g, 0]
        curve, settled = (nodes[p], information[p], linear[p]), False
        for step in range(_STEPS + 1):
            _quadratic(tables, curve, place, spare, likelihood)
            if step == _STEPS or settled:
                break
            settled = _settled(likelihood, mixture, levels[p], place, slope, loose)
        for g, k in np.ndindex(density.shape):
            values[g, k, 0] = grids[p, g]
            belief, moved = (likelihood[g], normal[g, k], levels[p]), (slope[g, k], loose[g, k])
            evidence, stiff[g, k] = _eliminate(*belief, values[g, k], *moved)
            posterior[g, k] = density[g, k] + evidence + mirrored[p, g]
        _normalise(posterior, values, slope, loose, stiff)
        for g in range(points):
            result[0][p, g] = posterior[g].sum()
        for way in range(2):
            terms = posterior, values, slope, loose, stiff
            _average(terms, way, result[1][p, way], result[2][p, way])


@kernels.allocating
def _condition(
    prior: tuple[Array, Array, Array], grid: Array, density: Array, normal: Array, mixture: Array
) -> None:
    """Log-density of the first emissivity, and mean and precision of the others at it, in place."""
    (weight, mean, covariance), end = prior, grid.size - 1
    for g in range(grid.size):
        low, high = max(g - 1, 0), min(g + 1, end)
        log, off = density[g], grid[g] - mean[:, 0]
        for k in range(weight.size):
            variance = covariance[k, 0, 0]
            log[k] = weight[k] - 0.5 * (np.log(variance) + off[k] ** 2 / variance)
            for m in range(mean.shape[1] - 1):
                slope = covariance[k, 1 + m, 0] / variance
                normal[g, k, 0, m] = mean[k, 1 + m] + slope * off[k]
                # The other emissivities are taken as independent given the first.
                spread = covariance[k, 1 + m, 1 + m] - slope * covariance[k, 1 + m, 0]
                normal[g, k, 1, m] = 1.0 / max(spread, 1e-8)
        share = np.exp(log - log.max())
        share /= share.sum()
        for m in range(mean.shape[1] - 1):
            mixture[g, 0, m] = (share * normal[g, :, 0, m]).sum()
            wide = 1.0 / normal[g, :, 1, m] + (normal[g, :, 0, m] - mixture[g, 0, m]) ** 2
            mixture[g, 1, m] = 1.0 / (share * wide).sum()
        log += np.log((grid[high] - grid[low]) / (high - low))  # of the cell


@kernels.compiled
def _settled(
    likelihood: Array, mixture: Array, level: Array, place: Array, slope: Array, loose: Array
) -> bool:
    """Step to the best values at each point of the grid, in place; whether no level moves."""
    settled = True
    for g in range(len(place)):
        before = place[g, -1]
        _eliminate(likelihood[g], mixture[g], level, place[g], slope[g, 0], loose[g, 0])
        settled &= not abs(place[g, -1] - before) > _SETTLED * level[1]
    return settled


@kernels.allocating
def _quadratic(
    tables: tuple[kernels.Table, ...],
    curve: tuple[Array, Array, Array],
    place: Array,
    spare: Array,
    likelihood: Array,
) -> None:
    """Log-likelihoods of the other bands as quadratic functions about zero, in place."""
    nodes, informations, linears = curve
    signal, emitted, rate = spare[0], spare[1], spare[2]
    base, of_e, of_c = np.empty(4), np.empty(4), np.empty(4)
    for g in range(len(place)):
        c = signal[5 * g + 4] = place[g, -1]
        for i in range(4):
            signal[5 * g + i] = c + (nodes[i] - c) / place[g, 0]
    for m in range(len(linears)):
        information, linear = informations[m], linears[m]
        other_band((tables[0], tables[1 + m]), signal, emitted, rate, spare[3:])
        for g in range(len(place)):
            e = place[g, 1 + m] = min(max(place[g, 1 + m], _BOUNDS[0]), _BOUNDS[1])
            # The model at the nodes, base + of_e e_m + of_c c.
            for i in range(4):
                of_e[i] = emitted[5 * g + i] - emitted[5 * g + 4]
                of_c[i] = e * rate[5 * g + i] * (1.0 - 1.0 / place[g, 0])
                of_c[i] += (1.0 - e) * rate[5 * g + 4]
                base[i] = emitted[5 * g + 4] - of_c[i] * place[g, -1]
            value, by_e, by_c, ee, ec, cc = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for i in range(4):
                hb, he, hc = 0.0, 0.0, 0.0  # H times its parts
                for j in range(4):
                    hb += information[i, j] * base[j]
                    he += information[i, j] * of_e[j]
                    hc += information[i, j] * of_c[j]
                value += base[i] * (linear[i] - 0.5 * hb)
                by_e += of_e[i] * (linear[i] - hb)
                by_c += of_c[i] * (linear[i] - hb)
                ee, ec, cc = ee + of_e[i] * he, ec + of_e[i] * hc, cc + of_c[i] * hc
            # Value; slopes with e_m, with c; curvatures with e_m, with both, with c.
            result = likelihood[g, m]
            result[0], result[1], result[2] = value, by_e, by_c
            result[3], result[4], result[5] = ee, ec, cc


@kernels.compiled
def _eliminate(
    likelihood: Array, normal: Array, level: Array, values: Array, slope: Array, loose: Array
) -> tuple[float, float]:
    """Evidence, precision of c, mean of (e_m, c), and slopes of e_m with c and variances at it."""
    precision, evidence, scale = 1.0 / level[1] ** 2, 0.0, 1.0
    curvature, toward = precision, precision * level[0]
    # Given c the e_m are independent, so they are eliminated first, and c last.
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


@kernels.allocating
def _normalise(weight: Array, values: Array, slope: Array, loose: Array, stiff: Array) -> None:
    """Weights (grid, component) that add up to 1 of logarithms, in place."""
    for g, k in np.ndindex(weight.shape):
        weight[g, k] = weight[g, k] if np.isfinite(weight[g, k]) else -np.inf
    highest = weight.max()
    for g, k in np.ndindex(weight.shape):
        share = np.exp(weight[g, k] - highest)
        for m in range(slope.shape[2] if share > _NEGLIGIBLE else 0):
            # Times the probability that the other emissivities lie between 0 and 1.
            variance = slope[g, k, m] ** 2 / stiff[g, k] + loose[g, k, m]
            value, scale = values[g, k, 1 + m], 1.0 / np.sqrt(2.0 * variance)
            share *= 0.5 * (math.erf((1.0 - value) * scale) + math.erf(value * scale))
        weight[g, k] = share if share > _NEGLIGIBLE else 0.0
    weight /= weight.sum()


@kernels.allocating
def _average(terms: tuple[Array, ...], relative: int, mean: Array, spread: Array) -> None:
    """Mean and covariance of (e, c), or of (1 / e_1, e_m / e_1, c), over grid and components."""
    weights, values, slope, loose, stiff = terms
    size = mean.size
    offset, direction = np.empty(size), np.ones(size)
    mean[:], spread[:], direction[0] = 0.0, 0.0, 0.0
    for turn in range(2):
        for g, k in np.ndindex(weights.shape):
            weight, scale = weights[g, k], 1.0 / values[g, k, 0] if relative else 1.0
            if weight == 0.0:
                continue
            for i in range(size):
                offset[i] = values[g, k, i] * (scale if i < size - 1 else 1.0) - mean[i] * turn
            offset[0] = (scale if relative else values[g, k, 0]) - mean[0] * turn
            if turn == 0:
                mean += weight * offset
                continue
            # Given e_1, c has the variance 1 / stiff, of which e_m follows a share.
            for m in range(size - 2):
                direction[1 + m] = slope[g, k, m] * scale
                spread[1 + m, 1 + m] += weight * loose[g, k, m] * scale**2
            for i, j in np.ndindex(spread.shape):
                moved = offset[i] * offset[j] + direction[i] * direction[j] / stiff[g, k]
                spread[i, j] += weight * moved


def fluctuation(tile: Tile, static: Moments, means: Bins, expected: float) -> Array:
    """Variance (pixel) [K^2] of the background over time: what bins show beyond noise."""
    vague = np.full_like(static.level, _VAGUE)
    bins_alone = replace(tile, signals=means.signals)
    free = frames.solve(bins_alone, static.point, static.level, vague)
    observed, noise = free.background, free.background_variance / np.maximum(means.frames, 1.0)
    mask = means.frames > 0
    count = np.maximum(mask.sum(axis=0), 2)
    centre = np.where(mask, observed, 0.0).sum(axis=0) / count
    total = np.where(mask, (observed - centre) ** 2, 0.0).sum(axis=0) / (count - 1)
    noise = np.where(mask, noise, 0.0).sum(axis=0) / count
    # A variance of n values is known to 2 / n of its square.
    precision = (count - 1) / (2.0 * np.maximum(total, noise) ** 2)
    # What is expected is as uncertain as it is large.
    prior = expected**-4.0
    excess = np.maximum(total - noise, 0.0)
    result = (precision * excess + prior * expected**2) / (precision + prior)
    return np.where(np.isfinite(result), result, expected**2)
