"""Steps 1 to 4 of `method` on tensors of torch, all pixels of a tile at once, on any device.

The equations of `fused`, whose results are repeated within rounding: the form to read. Tensors are
(band, time, pixel) or end so; numbers of a pixel are its last axis.
"""

from typing import Any, Final, NamedTuple

import numpy as np
import torch
from scipy.special import chdtrc

from dbthermal import _smooth as smooth
from dbthermal import mixing, planck
from dbthermal.separation import _tiles as tiles
from dbthermal.separation._subspace import (
    bars,
    fused,
    pixel,
    reflection_ratio,
    regression,
    residuals,
)
from dbthermal.separation._subspace.fused import FILMS, Solution
from dbthermal.separation._tiles import Tile

Tensor = torch.Tensor
Model = Any
"""A `pixel.Model`, its arrays as tensors."""
Known = dict[str, Tensor]
"""Each pixel's material: the fields of a `Material`, none without one."""
einsum: Final = torch.einsum


class Ratio(NamedTuple):
    """Reflection ratios (step 1); not explained, a field of a `Solution`."""

    ratio: Tensor
    ratio_variance: Tensor
    inverse_energy: Tensor
    null_weights: Tensor
    null_variance: Tensor
    order: Tensor
    contrast: Tensor
    reduced_chi2: Tensor
    coefficients: Tensor  # of the signals on the functions in use (band, column, pixel) [K]
    smoothed: Tensor  # of the null combination (column, pixel) [K]
    columns: Tensor  # whether a column is in use (column, pixel)
    scatter: Tensor
    pooled: Tensor


class Line(NamedTuple):
    """Robust line through each pixel's points."""

    slope: Tensor  # (pixel)
    scale: Tensor  # of the residuals, at least the noise (pixel)
    residual: Tensor  # (time, pixel)
    energy: Tensor  # of the abscissa about its mean, weighted (pixel)
    variance: Tensor  # of the slope (pixel)
    weights: Tensor  # in [0, 1] (time, pixel)


class Fit(NamedTuple):
    """Object and first emissivity, by steps 2 and 3 in turns."""

    temperature: Tensor  # (time, pixel) [K]
    steepness: Tensor  # h'(x) before the last step (time, pixel) [1]
    signals: Tensor  # of the object (band, time, pixel) [K]
    emitted: Tensor  # u_1(x) of the last regression (time, pixel) [K]
    line: Line
    first: Tensor  # emissivity of the first band (pixel) [1]
    constant: Tensor
    known: Tensor  # the emissivity is the material's (pixel)


class Emission(NamedTuple):
    """Variances of object and emissivities; not explained, a field of a `Solution`."""

    variance: Tensor  # of the object (time, pixel) [K^2]
    sensitivity: Tensor  # derivative of the object with epsilon (time, pixel) [K]
    smooth_variance: Tensor  # from the smoothed noise (time, pixel) [K^2]
    level: Tensor  # deviation of the ratios by the background's level (band, pixel)
    emissivity: Tensor
    emissivity_covariance: Tensor
    epsilon_variance: Tensor
    noise_variance: Tensor
    drift_variance: Tensor
    restless: Tensor


def solve(device: str, tile: Tile, functions: smooth.Subspace, drift: float) -> Solution:
    """As `fused.solve`, on a device; the solution is in arrays."""

    def tensor(values: Any) -> Any:
        return torch.tensor(values, device=device) if isinstance(values, np.ndarray) else values

    model = pixel.Model(*map(tensor, fused.share(tile, functions, drift)))
    material = {} if tile.material is None else dict(vars(tile.material.each(tensor)))
    signals = tensor(tile.signals)
    result, straight, bent, line = _steps(model, material, signals, signals)
    places = torch.arange(signals.shape[2], device=device)
    for _ in range(pixel.BENDS):
        if not bent.any():
            break
        # Again, on signals whose reflections are proportional.
        places, signals, straight = places[bent], signals[..., bent], straight[..., bent]
        line = Line(*(values[..., bent] for values in line))
        material = {name: values[..., bent] for name, values in material.items()}
        again, straight, bent, line = _steps(model, material, signals, straight, line)
        # The bend of a gray body is not known: it is told from the signals as they are.
        for name in again.keys() - {"gray"}:
            result[name][..., places] = again[name]
    return Solution(**{name: values.cpu().numpy() for name, values in result.items()})


def _steps(
    model: Model, material: Known, signals: Tensor, straight: Tensor, start: Line | None = None
) -> tuple[dict[str, Tensor], Tensor, Tensor, Line]:
    """Steps 1 to 4, the first three on signals whose reflections are proportional.

    And the signals less the bend, and the pixels in which that has changed.
    """
    ratios = _ratios(model, material, straight)
    fit = _alternate(model, material, ratios, straight[0], start)
    emission = _emission(model, material, ratios, fit, straight[0])
    background, variance = _background(model, ratios, fit, emission, signals)
    films = torch.stack([fit.temperature, background])
    patterns = _pattern_variances(model, ratios, fit.temperature, emission.emissivity, background)
    stds = (torch.stack([emission.variance, variance]) + patterns).sqrt()
    margin = tiles.RANGE_SIGMAS * stds.nan_to_num(posinf=np.inf)
    beyond = (films < model.lowest - margin) | (films > model.highest + margin)
    lost = ~((films.abs() < tiles.USELESS) & (stds < tiles.USELESS))
    values = torch.stack([films, stds], dim=1).where(~lost[:, None], np.nan).flatten(0, 1)
    # Null residual, rapid part of the first band, and the object's curve.
    residual = _weighted(straight, ratios.null_weights) - model.functions.T @ ratios.smoothed
    rapid = straight[0] - model.functions.T @ ratios.coefficients[0]
    curve = model.object_part.T @ ratios.smoothed
    common = ratios.null_weights[0] * model.noise[0] ** 2
    further = torch.cat([signals[:1], signals[1:] - _bend(model, emission.emissivity, background)])
    energy = (further - straight)[1:].var(dim=1, correction=0) * signals.shape[1]
    bent = (energy > (pixel.BEND * model.noise[1:, None]) ** 2).any(dim=0)
    # Together pixels show a bend that is too small to be seen in each.
    known = material["noise_variance"].isfinite() if material else torch.zeros_like(bent)
    scatter, free = _less_noise(model, _scatter(model, further)[1], ratios.order)
    parts = {**ratios._asdict(), **fit._asdict(), **emission._asdict()}
    result = {
        **{name: part for name, part in parts.items() if name in Solution.__dataclass_fields__},
        **dict(zip(FILMS, values, strict=True)),
        "missing": films.isnan().sum(dim=1),
        "lost": lost.sum(dim=1),
        "beyond": beyond.any(dim=1),
        "ratio_variance": ratios.ratio_variance + emission.level**2,
        "scatter": ratios.scatter.where(bent | known, scatter),
        "freedom": free,
        "gray": _may_be_gray(model, ratios),
        "correlation": _autocorrelation(residual),
        "delay": _delay(residual, rapid, ratios.null_variance, free[0] * common, model.noise[0]),
        "unexplained": _unexplained(model, residual, rapid, ratios.null_variance, common),
        "sums": torch.stack([_block_sums(part, model.parts) for part in (residual, curve)]),
    }
    return result, further, bent, fit.line


def _blackbody(
    model: Model, temperature: Tensor, bands: int | slice = slice(None)
) -> tuple[Tensor, Tensor]:
    """Signal less the reference [K] and slope [1] of a blackbody in bands at a temperature [K]."""
    linear, amplitude, wavelength, shift, offset = _numbers(model, bands)
    if linear.any():
        return amplitude * temperature + offset, amplitude + 0.0 * temperature
    scale = wavelength * temperature + shift
    exponent = planck.SECOND_RADIATION_CONSTANT / scale
    excess = exponent.expm1()
    share = amplitude / excess
    return share + offset, share * (1.0 + 1.0 / excess) * exponent * wavelength / scale


def _temperature(model: Model, signal: Tensor, band: int) -> Tensor:
    """Temperature [K] of a blackbody with a signal less the reference [K]; NaN where undefined."""
    linear, amplitude, wavelength, shift, offset = _numbers(model, band)
    excess = signal - offset
    if linear.any():
        return excess / amplitude
    ratio = amplitude / excess.where(excess > 0, np.nan)
    return (planck.SECOND_RADIATION_CONSTANT / ratio.log1p() - shift) / wavelength


def _numbers(model: Model, bands: int | slice) -> Tensor:
    """Numbers of the exact responses of some bands, the last of a row of `kernels.rows`."""
    return model.tables[bands, -5:].movedim(-1, 0)[..., None, None]


def _weighted(parts: Tensor, weights: Tensor) -> Tensor:
    """Sum over the bands of (band, time, pixel), weighted by (band, pixel)."""
    return einsum("btp,bp->tp", parts, weights)


def _quotient(numerator: Tensor, denominator: Tensor, otherwise: float) -> Tensor:
    """Quotient where the denominator is positive, and another value elsewhere."""
    return (numerator / denominator).where(denominator > 0, otherwise)


def _ratios(model: Model, material: Known, signals: Tensor) -> Ratio:
    """Step 1 (eq. 2 to 5), see `pixel.ratios`."""
    (bands, frames, pixels), noise = signals.shape, model.noise[:, None]
    # Eq. 3: scatter (order, pixel, band, band) of the whitened signals outside the functions.
    held, scatter = _scatter(model, signals)
    orders = torch.arange(1, len(scatter) + 1, device=signals.device)
    freedom, rows = frames - model.steps - orders, torch.arange(pixels, device=signals.device)
    # Its energy is the largest eigenvalue along the axis, noise alone across it.
    trace = einsum("opbb->op", scatter)
    largest = torch.linalg.eigvalsh(scatter)[..., -1]
    pooled = torch.zeros_like(rows, dtype=torch.bool)
    if material:
        axis = material["ratio"] / noise
        axis = axis / axis.norm(dim=0)
        along = einsum("bp,opbc,cp->op", axis, scatter, axis)
        turned = einsum("pbc,cp->bp", scatter[_order(trace - along, frames), rows], axis)
        product = (axis * turned).sum(dim=0)
        pooled = (turned**2).sum(dim=0) / product - product < model.chances[0]
        largest = along.where(pooled, largest)
    across = trace - largest
    order = _order(across, frames)
    chosen, free = scatter[order, rows], freedom[order]
    values, vectors = torch.linalg.eigh(chosen)
    ratio = vectors[..., -1].T * noise
    ratio = ratio / ratio[0]
    # Energy along the axis less the noise's n, over |v|^2: S of the first band, for eq. 4.
    length = ((ratio / noise) ** 2).sum(dim=0)
    energy = (values[:, -1] - free) / length
    inverse = _quotient(_quotient(energy + free / length, energy, np.inf), energy, np.inf)
    if material:
        # The mean of the posterior, of the material's ratio for a prior with its spread.
        spread = material["spread"]
        own = _quotient(spread, spread + inverse, 0.0)
        mean = material["ratio"] + own * (ratio - material["ratio"])
        ratio = torch.where(pooled, mean.where(own > 0, material["ratio"]), ratio)
        common = (1.0 - own) * (spread + (1.0 - own) * material["inverse_energy"])
        inverse = common.where(pooled, inverse)
    # Whitened, the constraints of eq. 5 are the vectors v = kappa / s and u = 1 / s; the part of u
    # that is orthogonal to v, r = u - v (u.v) / |v|^2, gives w = r / (s |r|^2).
    v, u = ratio / noise, 1.0 / noise
    rest = u - v * (u * v).sum(dim=0) / (v**2).sum(dim=0)
    null_variance = 1.0 / (rest**2).sum(dim=0)
    weights = rest * null_variance / noise
    error = noise**2 + (ratio * noise[0]) ** 2
    error[0] = 0.0
    columns = torch.arange(held.shape[1], device=signals.device)[:, None] < order + 1 + model.steps
    return Ratio(
        ratio=ratio,
        ratio_variance=inverse * error,
        inverse_energy=inverse,
        null_weights=weights,
        null_variance=null_variance,
        order=order + 1,
        contrast=_quotient(largest[-1] * (bands - 1), across[-1], np.inf),
        reduced_chi2=across[order, rows] / ((bands - 1) * free),
        coefficients=held * columns,
        smoothed=einsum("bp,bcp->cp", weights, held) * columns,
        columns=columns,
        scatter=_less_noise(model, scatter, order + 1)[0],
        pooled=pooled,
    )


def _scatter(model: Model, signals: Tensor) -> tuple[Tensor, Tensor]:
    """Coefficients of signals; scatter (order, pixel, band, band) outside the functions (eq. 3)."""
    noise, held = model.noise[:, None], model.functions @ signals
    white = held / noise[..., None]
    total = einsum("btp,ctp->pbc", signals, signals) / (noise * noise.T)
    return held, total - einsum("bfp,cfp->fpbc", white, white).cumsum(0)[model.steps :]


def _less_noise(model: Model, scatter: Tensor, order: Tensor) -> tuple[Tensor, Tensor]:
    """Scatter less noise (3, band, band, pixel) at the orders of a survey, and its freedom."""
    rapid = reflection_ratio.rapid_orders(len(scatter))
    orders = torch.stack([order, *(torch.full_like(order, int(one)) for one in rapid)])
    free = model.functions.shape[1] - model.steps - orders
    unit = torch.eye(scatter.shape[-1], device=scatter.device)[..., None]
    chosen = scatter[orders - 1, torch.arange(len(order), device=scatter.device)]
    return chosen.movedim(1, -1) - free[:, None, None] * unit, free


def _order(across: Tensor, frames: int) -> Tensor:
    """Order less one (pixel) of the lowest information criterion of an energy (order, pixel)."""
    orders = torch.arange(1, len(across) + 1, device=across.device)[:, None]
    criterion = frames * across.clip(min=reflection_ratio.TINY).log() + orders * np.log(frames)
    lowest = min(reflection_ratio.LOWEST_ORDER, len(across) - 1) - 1
    if len(across) == 1:
        return torch.zeros_like(criterion[0], dtype=torch.int64)
    return lowest + criterion[lowest:-1].argmin(dim=0) + 1


def _may_be_gray(model: Model, ratios: Ratio) -> Tensor:
    """Pixels of which equal emissivities are not excluded, see `pixel.may_be_gray`."""
    unit = ratios.ratio / model.noise[:, None]
    unit, gray = unit / unit.norm(dim=0), model.gray / model.noise
    # The part of g / s orthogonal to v; its variance is sigma^2.
    off = gray[..., None] - (gray @ unit)[:, None] * unit
    start, step = off[:-1], off.diff(dim=0)
    length = (step**2).sum(dim=1).clip(min=reflection_ratio.TINY)
    share = (-(start * step).sum(dim=1) / length).clip(0.0, 1.0)
    nearest = ((start + share[:, None] * step) ** 2).sum(dim=1) / ratios.inverse_energy
    # The mean is no larger than the largest chance: few pixels need it.
    near = nearest.amin(dim=0) < model.chances[1]
    chance = chdtrc(len(unit) - 1, nearest[:, near].cpu().numpy()).mean(axis=0)
    result = torch.zeros_like(near)
    result[near] = torch.as_tensor(chance > reflection_ratio.GRAY_CHANCE, device=near.device)
    return result


def _alternate(model: Model, material: Known, ratios: Ratio, z: Tensor, line: Line | None) -> Fit:
    """Steps 2 and 3 in turns (eq. 5 to 7)."""
    target = model.object_part.T @ ratios.smoothed
    temperature = _temperature(model, target, 1)
    # Middle of the interval that the ratios leave for e_1, for a constant object.
    largest = ratios.ratio.amax(dim=0)
    middle = 0.5 + 0.5 * (1.0 - 1.0 / largest).where(largest > 1.0, 0.0)
    known = torch.zeros_like(ratios.pooled)
    if material:
        told = ratios.pooled & material["emissivity"].isfinite()
        middle = material["emissivity"].where(told, middle)
        known = told & material["noise_variance"].isfinite()

    def approach(emissivity: Tensor, temperature: Tensor) -> tuple[Tensor, Tensor]:
        """Return the object after a step of Newton towards h(x) = q (eq. 6), and h'(x) before."""
        factors = ratios.null_weights * (1.0 - ratios.ratio * (1.0 - emissivity))
        value, slope = (_weighted(part, factors) for part in _blackbody(model, temperature))
        return temperature + (target - value) / slope, slope

    # The robust line is sought on a curve that is right to second order, or it locks elsewhere.
    guess = _fit(_blackbody(model, temperature, 0)[0], z, torch.ones_like(z))[0]
    first = guess.where((guess > 0) & (guess < 1), middle)
    temperature = approach(first, temperature)[0]
    before = slope_before = torch.full_like(first, np.nan)
    for _ in range(pixel.ROUNDS):
        emitted = _blackbody(model, temperature, 0)[0]
        line = regress(emitted, z, float(model.noise[0]), line)
        least = pixel.OBJECT_TO_NOISE * (ratios.order + model.steps) * ratios.null_variance
        constant = (line.energy < least) & ~known
        rate = (line.slope - slope_before) / (first - before)
        rate = rate.where(rate.abs() < pixel.FASTEST, 0.0)
        before, slope_before = first, line.slope
        first = line.slope + (line.slope - before) * rate / (1.0 - rate)
        first = middle.where(constant | known, first)
        temperature, steepness = approach(first, temperature)
    signals = _blackbody(model, temperature)[0]
    assert line is not None
    return Fit(temperature, steepness, signals, emitted, line, first, constant, known)


def _emission(model: Model, material: Known, ratios: Ratio, fit: Fit, z: Tensor) -> Emission:
    """Variances (eq. 8) of what follows from the first band's signal (time, pixel), see `bars`."""
    noise, frames, line, first, emitted = model.noise, len(z), fit.line, fit.first, fit.emitted
    used = ratios.order + model.steps
    # Variance of the slope: of the ordinate's noise, and of the abscissa's.
    kernel = line.weights * emitted
    kernel = (kernel - line.weights * (kernel.sum(0) / line.weights.sum(0))) / line.energy
    noise_variance = line.variance + first**2 * _curve_variance(model, ratios, kernel)
    walk, upper = _walk(model, line, emitted, first**2 * ratios.null_variance, used)
    limit = (1.0 - first) * model.drift
    linear = _linear(model, ratios, line, emitted, first, limit)
    change = emitted.amax(dim=0) - emitted.amin(dim=0)
    drift_variance = (limit / change) ** 2 + torch.maximum(upper, linear)
    if material:
        noise_variance = material["noise_variance"].where(fit.known, noise_variance)
        drift_variance = material["drift_variance"].where(fit.known, drift_variance)
    # Of the ratios, through the background's level.
    level = (z - emitted).mean(dim=0).abs() * (noise_variance + walk).sqrt() / (1.0 - first) ** 2
    widest = (model.highest - model.lowest) / np.sqrt(12.0)
    level = ratios.ratio * model.rates[:, None] * level.where(level < widest, widest)
    epsilon = ratios.inverse_energy * ratios.null_variance
    epsilon = epsilon + (ratios.null_weights * level).sum(dim=0) ** 2
    # Eq. 6 by implicit differentiation; the error of w.kappa moves weight from the other bands to
    # the first, by their share in it.
    shares = (ratios.null_weights**2 * (noise[:, None] ** 2 + (ratios.ratio * noise[0]) ** 2))[1:]
    others = _weighted(fit.signals[1:], shares / shares.sum(dim=0))
    partial = mixing.mixed(first, fit.signals[0], others)
    sensitivity = (partial - model.object_part.T @ ratios.coefficients[0]) / fit.steepness
    leverage = model.leverage[ratios.order - 1].T
    smooth_variance = leverage * ratios.null_variance / fit.steepness**2
    square = sensitivity**2 * epsilon
    expected = square + smooth_variance * (1.0 + np.log(frames) / used)
    resting = line.residual**2 < bars.WITHIN**2 * (noise[0] ** 2 + first**2 * expected)
    return Emission(
        variance=square / (1.0 - bars.NORMAL95**2 * epsilon) ** 2 + smooth_variance,
        sensitivity=sensitivity,
        smooth_variance=smooth_variance,
        emissivity=1.0 - ratios.ratio * (1.0 - first),
        emissivity_covariance=_covariance(
            model, ratios, first, noise_variance + drift_variance, level
        ),
        epsilon_variance=epsilon,
        level=level,
        noise_variance=noise_variance,
        drift_variance=drift_variance,
        restless=resting.sum(dim=0) < bars.RESTING * frames,
    )


def _covariance(
    model: Model, ratios: Ratio, first: Tensor, slope_variance: Tensor, level: Tensor
) -> Tensor:
    """Covariance of the emissivities (band, band, pixel) (eq. 8), see `bars`."""
    ratio, weights, energy = ratios.ratio, ratios.null_weights, ratios.inverse_energy
    reflectivity, squares = 1.0 - first, (model.noise**2)[:, None]
    pairs = ratio[:, None] * ratio
    # Of kappa_m with epsilon, over sigma^2, and with one another.
    with_epsilon = squares * weights - ratio * squares[0] * weights[0]
    with_epsilon[0] = 0.0
    between = pairs * squares[0] + torch.diag_embed(squares.T)[0][..., None]
    between[0], between[:, 0] = 0.0, 0.0
    cross = ratio[:, None] * with_epsilon
    through = (first * reflectivity) ** 2 * pairs * ratios.null_variance
    through = through + first * reflectivity**2 * (cross + cross.transpose(0, 1))
    by_level = reflectivity * (ratio * first * (weights * level).sum(dim=0) + level)
    covariance = pairs * slope_variance + (through + reflectivity**2 * between) * energy
    return covariance + by_level[:, None] * by_level


def _curve_variance(model: Model, ratios: Ratio, kernel: Tensor) -> Tensor:
    """Variance (pixel) of the sum of a kernel (time, pixel) over the object's smoothed noise."""
    part = (model.object_part @ kernel) * ratios.columns
    return ratios.null_variance * (part**2).sum(dim=0)


def _walk(
    model: Model, line: Line, emitted: Tensor, curve_variance: Tensor, used: Tensor
) -> tuple[Tensor, Tensor]:
    r"""
    Variance (pixel) [1] of the slope from a background that walks; its upper bound.

    With the unit coefficients :math:`\xi_j` of the object's curve `emitted` (time, pixel) of norm
    :math:`|u|`, and the energy A of a random walk in the residual's spectrum, the larger of those
    of two octaves; for the bound, at the upper end of their 95 % interval,

    .. math:: \mathrm{var}(e_1) = \frac{A}{|u|^2} \sum_j \frac{\xi_j^2}{j^2}
    """
    degree = torch.arange(1.0, len(model.rising) + 1.0, device=emitted.device)[:, None]
    # Spectra of the residual, over the share of frames that the weights keep, and of the curve.
    share = line.weights.mean(dim=0)
    spectrum = model.rising @ (line.residual * line.weights) / share
    curve = model.rising @ emitted
    energy = (curve**2).sum(dim=0)
    unit = curve / energy.sqrt()
    # The part orthogonal to the object's curve is the background's alone.
    spectrum = spectrum - unit * (unit * spectrum).sum(dim=0)
    # Energy of a walk at degree 1: j^2 times that at degree j, less the noise's.
    walk = spectrum**2 - model.noise[0] ** 2 / share - curve_variance * (degree < used)
    walk, expected, upper = degree**2 * walk, 0.0 * energy, 0.0 * energy
    for (low, high, lost), widened in zip(bars.OCTAVES, model.widened, strict=True):
        if (freedom := len(walk[low - 1 : high - 1]) - lost) > 0:
            energies = walk[low - 1 : high - 1].sum(dim=0) / freedom
            expected = torch.maximum(expected, energies)
            upper = torch.maximum(upper, energies * widened)
    scale = (unit**2 / degree**2).sum(dim=0) / energy
    return scale * expected, scale * upper


def _linear(
    model: Model, ratios: Ratio, line: Line, emitted: Tensor, first: Tensor, limit: Tensor
) -> Tensor:
    r"""
    Variance (pixel) [1] of the slope from a linear drift of size d, seen with a variance v.

    :math:`\gamma^2 k (k d^2 + v)`, k = D / (D + v), with D of the `limit` [K] or of what is seen.
    Weighted twice, for a large drift takes the weight from the frames that tell it best.
    """
    drift, weights = model.rising[0][:, None].expand_as(emitted), line.weights
    for last in (False, True):
        slope, _, beside, _ = _fit(emitted, drift, weights)
        kernel = weights * beside
        kernel = kernel / (kernel * drift).sum(dim=0)
        size = (kernel * line.residual).sum(dim=0)
        if not last:
            weights = _tukey(line.residual - size * beside, line.scale)
    variance = model.noise[0] ** 2 * (kernel**2).sum(dim=0)
    variance = variance + first**2 * _curve_variance(model, ratios, kernel)
    before = torch.maximum((limit / model.spread) ** 2, size**2 + variance)
    share = before / (before + variance)
    return slope**2 * share * (share * size**2 + variance)


def _background(
    model: Model, ratios: Ratio, fit: Fit, emission: Emission, signals: Tensor
) -> tuple[Tensor, Tensor]:
    """Step 4 (eq. 9), (time, pixel) [K], and its variance [K^2] (eq. 10), see `bars`."""
    emissivity, noise, first = emission.emissivity, model.noise[:, None], fit.first
    precision = ((1.0 - emissivity) / noise) ** 2
    weights = precision / precision.sum(dim=0)
    reflected = mixing.background(emissivity[:, None], signals, fit.signals)
    # From the temperature of the mean signal, one Gauss-Newton step on the exact responses.
    start = _temperature(model, _weighted(reflected, weights), 0)
    signal, slope = _blackbody(model, start)
    curvature = _weighted(slope**2, weights)
    background = start + _weighted(slope * (reflected - signal), weights) / curvature
    # Eq. 10, term by term.
    share = (weights * emissivity / (1.0 - emissivity)).sum(dim=0)
    contrast = background - fit.temperature
    through = contrast * first + share * emission.sensitivity
    covariance = 2.0 * noise[0] ** 2 * ratios.null_weights[0] * ratios.inverse_energy
    of_first = noise[0] ** 2 - 1.0 / ((ratios.ratio / noise) ** 2).sum(dim=0)
    steady = (emission.noise_variance + emission.drift_variance) / (1.0 - first) ** 2
    variance = 1.0 / (precision.sum(dim=0) * curvature) + share**2 * emission.smooth_variance
    variance = variance + through * (through * emission.epsilon_variance - contrast * covariance)
    return background, variance + contrast**2 * (of_first * ratios.inverse_energy + steady)


def _pattern_variances(
    model: Model, ratios: Ratio, temperature: Tensor, emissivity: Tensor, background: Tensor
) -> Tensor:
    """Variances (2, time, pixel) [K^2] of both temperatures by a residual pattern, see `bars`."""
    if not model.pattern.any():
        return torch.zeros(())
    slopes = emissivity[:, None] * _blackbody(model, temperature)[1]
    precision = ((1.0 - emissivity) / model.noise[:, None]) ** 2
    direct = precision / precision.sum(dim=0) / (1.0 - emissivity)
    through = _weighted(slopes, direct)
    parts = ratios.null_weights[:, None] / _weighted(slopes, ratios.null_weights)
    others = (direct[:, None] - through * parts) / _blackbody(model, background, 0)[1]
    return einsum("b,xbtp->xtp", model.pattern**2, torch.stack([parts, others]) ** 2)


def _bend(model: Model, emissivity: Tensor, background: Tensor) -> Tensor:
    """Part of the reflections (band - 1, time, pixel) [K] that is bent (eq. 11), see `pixel`."""
    signal = _blackbody(model, background)[0]
    bend = (signal[1:] - signal[0]) * (1.0 - emissivity[1:, None])
    physical = ((emissivity > 0) & (emissivity < 1)).all(dim=0) & bend.isfinite().all(0).all(0)
    return bend.where(physical, 0.0)


def regress(abscissa: Tensor, ordinate: Tensor, noise: float, start: Line | None = None) -> Line:
    """Robust line of an ordinate over an abscissa (time, pixel), see `regression`."""
    if start is None:
        residual = _first_residual(abscissa, ordinate, noise)
    else:
        residual = _fit(abscissa, ordinate, start.weights)[2]
    for _ in range(regression.STEPS):
        scale = (regression.TO_STD * _ranked_magnitude(residual)).clip(min=noise)
        weights = _tukey(residual, scale)
        slope, _, residual, energy = _fit(abscissa, ordinate, weights)
    # var(slope) = s^2 / sum w (x - mean)^2, over the fraction of independent points.
    kept = residual * weights
    lagged = _quotient((kept[1:] * kept[:-1]).sum(dim=0), (kept**2).sum(dim=0), 0.0)
    correlation = lagged.clip(0.0, regression.MOST_CORRELATED)
    independent = (1.0 - correlation) / (1.0 + correlation)
    return Line(slope, scale, residual, energy, scale**2 / energy / independent, weights)


def _first_residual(abscissa: Tensor, ordinate: Tensor, noise: float) -> Tensor:
    """Residual from the best of three starts: all points, those above, those below the line."""
    count = min(len(abscissa), regression.STARTING_POINTS)
    every = torch.arange(count, device=abscissa.device) * len(abscissa) // count
    # About its mean, or single precision would not resolve a small range.
    centred, up = abscissa - abscissa.mean(dim=0), ordinate - ordinate.mean(dim=0)
    x, z = centred[every].float(), up[every].float()
    plain = _fit(x, z, torch.ones_like(x))[2]
    slope = intercept = smallest = torch.full_like(centred[0], np.inf)
    for start in (torch.ones_like(plain), plain >= 0, plain <= 0):
        weights = start.float()
        for _ in range(regression.STARTING_STEPS):
            one, other, residual, _ = _fit(x, z, weights)
            deviation = _ranked_magnitude(residual)
            scale = regression.ANNEALING * regression.TO_STD * deviation
            weights = _tukey(residual, scale.clip(min=noise)).float()
        better = deviation < smallest
        slope, intercept = one.where(better, slope), other.where(better, intercept)
        smallest = deviation.where(better, smallest)
    return up - intercept - slope * centred


def _fit(
    abscissa: Tensor, ordinate: Tensor, weights: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Weighted least squares: slope, intercept, residual (time, pixel), energy of the abscissa."""
    total, weighted = weights.sum(dim=0), weights * abscissa
    middle, centre = weighted.sum(dim=0) / total, (weights * ordinate).sum(dim=0) / total
    energy = (weighted * abscissa).sum(dim=0) - total * middle**2
    slope = ((weighted * ordinate).sum(dim=0) - total * middle * centre) / energy
    intercept = centre - slope * middle
    return slope, intercept, ordinate - intercept - slope * abscissa, energy


def _ranked_magnitude(residual: Tensor) -> Tensor:
    """Absolute value of rank `SHARE` over time, in single precision, as in `regression`."""
    rank = int(regression.SHARE * residual.shape[0])
    return residual.T.float().abs().kthvalue(rank + 1).values.double()


def _tukey(residual: Tensor, scale: Tensor) -> Tensor:
    """Tukey's bisquare weights, (1 - (r / c s)^2)^2 inside c s."""
    return (1.0 - (residual / (regression.TUNING * scale)) ** 2).clip(min=0.0) ** 2


def _autocorrelation(residual: Tensor) -> Tensor:
    """Mean autocorrelation (pixel) over some lags, in standard deviations of white noise."""
    lags = range(1, residuals.LAGS + 1)
    lagged = torch.stack([(residual[lag:] * residual[:-lag]).sum(dim=0) for lag in lags]).sum(0)
    mean = _quotient(lagged, residuals.LAGS * (residual**2).sum(dim=0), 0.0)
    return mean * np.sqrt(residuals.LAGS * residual.shape[0])


def _delay(
    residual: Tensor, rapid: Tensor, null_variance: Tensor, common: Tensor, noise: Tensor
) -> Tensor:
    r"""
    Score (pixel) of rapid changes that are not simultaneous in all bands.

    A band that is a frame late, or early, leaves the difference between two frames of the others'
    signal. The null residual r is therefore held against both differences of the first band's
    signal, a matched filter,

    .. math:: \sum_t r(t) \, (z_1(t \pm 1) - z_1(t)) + n \, w_1 s_1^2

    where the last term takes out that the residual holds the noise of :math:`z_1(t)`. A delay that
    changes sign, as after an interpolation between frames, is seen in the energy of the residual
    in the frames at a change, over that of the noise: a chi-square variable of few degrees of
    freedom, whose cube root is nearly normal (Wilson, Hilferty 1931, doi:10.1073/pnas.17.12.684).
    The score is the largest in magnitude, in standard deviations of white noise.
    """
    change = rapid.diff(dim=0)
    late = (residual[:-1] * change).sum(dim=0) + common
    early = (residual[1:] * change).sum(dim=0) - common
    variance = null_variance * (change**2).sum(dim=0)
    score = _quotient(torch.maximum(late.abs(), early.abs()), variance.sqrt(), 0.0)
    steps = change.abs() > residuals.CHANGE * np.sqrt(2.0) * noise
    at = torch.zeros_like(residual, dtype=torch.bool)
    at[1:] |= steps
    at[:-1] |= steps
    count = at.sum(dim=0).double()
    mean = _quotient((residual**2 * at).sum(dim=0) / null_variance, count, 1.0)
    # The cube root of a chi-square over its n degrees has the mean 1 - v and the variance v.
    spread = 2.0 / (9.0 * count.clip(min=1.0))
    return torch.maximum(score, (mean ** (1.0 / 3.0) - (1.0 - spread)) / spread.sqrt())


def _unexplained(
    model: Model, residual: Tensor, rapid: Tensor, null_variance: Tensor, common: Tensor
) -> Tensor:
    r"""
    Pixels of which the null residual r (time, pixel) [K] is not white noise in some part of time.

    Its sum over some block, of those of repeated halving, is beyond that of noise: a change of the
    object that the smooth functions do not follow. Or blocks differ in its correlation with the
    rapid changes: these have not one ratio,

    .. math:: \sum_b \frac{(\sum_t r h)^2}{\sigma^2 \sum_t h^2}, \quad
              h = z_1 - r \, w_1 s_1^2 / \sigma^2

    which is a chi-square variable, for the noise of h is independent of that of r.
    """
    (most, limit), length = model.limits, model.edges.diff()[:, None]
    variance = null_variance.where(null_variance > 0, np.inf)
    rapid = rapid - common / variance * residual
    sums, products, squares = (
        _block_sums(part, model.edges) for part in (residual, residual * rapid, rapid**2)
    )
    result = _quotient(products**2, squares, 0.0).sum(dim=0) / variance > most
    while len(sums) > 1:
        result |= (sums**2 > limit * variance * length).any(dim=0)
        sums, length = sums[::2] + sums[1::2], length[::2] + length[1::2]
    return result


def _block_sums(values: Tensor, edges: Tensor) -> Tensor:
    """Sums (block, pixel) of values (time, pixel) between edges, of which none are the same."""
    total = values.cumsum(dim=0)[edges[1:] - 1]
    return torch.cat([total[:1], total.diff(dim=0)])
