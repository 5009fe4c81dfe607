"""Steps 1 to 4 of the default method on tensors of torch, all pixels of a tile at once.

The readable twin of the compiled `fused`, whose results it repeats within rounding. Tensors are
(band, time, pixel) or end so; numbers of a pixel are its last axis. What a step finds is kept in
the work space under its name in `fused.Solution` or `pixel.Work`.
"""

from types import SimpleNamespace
from typing import Any, Final

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
)
from dbthermal.separation._subspace.fused import FILMS, Solution
from dbthermal.separation._tiles import SPANS, Tile

Tensor = torch.Tensor
Work = SimpleNamespace
Model = Any
"""A `pixel.Model`, its arrays as tensors."""
Known = dict[str, Tensor]
"""Each pixel's material: the fields of a `Material`, none without one."""
einsum: Final = torch.einsum


def solve(device: str, tile: Tile, functions: smooth.Subspace, drift: float) -> Solution:
    """As `fused.solve`, on a device; the solution is in arrays."""

    def tensor(values: Any) -> Any:
        return torch.tensor(values, device=device) if isinstance(values, np.ndarray) else values

    shared = fused.share(tile, functions, drift)._asdict()
    shared |= {"noise": np.array(tile.noise), "pattern": np.array(tile.pattern or [0.0, 0.0])}
    model = SimpleNamespace(**{name: tensor(values) for name, values in shared.items()})
    material = {} if tile.material is None else vars(tile.material)
    material = {name: tensor(values) for name, values in material.items()}
    signals = tensor(tile.signals)
    work = _steps(model, material, signals, signals)
    result = {name: getattr(work, name) for name in Solution.__dataclass_fields__}
    places = torch.arange(signals.shape[2], device=device)
    for _ in range(pixel.BENDS):
        bent = work.bent
        if not bent.any():
            break
        # Again, on signals whose reflections are proportional.
        places, signals, straight = places[bent], signals[..., bent], work.further[..., bent]
        material = {name: values[..., bent] for name, values in material.items()}
        work = _steps(model, material, signals, straight, work.weights[..., bent])
        # The bend of a gray body is not known: it is told from the signals as they are.
        for name in result.keys() - {"gray"}:
            result[name][..., places] = getattr(work, name)
    return Solution(**{name: values.cpu().numpy() for name, values in result.items()})


def _steps(
    model: Model, material: Known, signals: Tensor, straight: Tensor, weights: Tensor | None = None
) -> Work:
    """Steps 1 to 4, the first three on signals whose reflections are proportional.

    The robust line starts from weights, or anew.
    """
    work = Work(signals=signals, straight=straight, weights=weights)
    _ratios(model, material, work)
    work.gray = _may_be_gray(model, work)
    _alternate(model, material, work)
    _emission(model, material, work)
    _background(model, work)
    _films(model, work)
    _straighten(model, material, work)
    _judge(model, work)
    return work


def _films(model: Model, work: Work) -> None:
    """Temperatures and deviations, NaN where these are of no use, and the bend (eq. 11)."""
    films = torch.stack([work.temperature, work.background])
    stds = torch.stack([work.variance, work.background_variance]).sqrt()
    margin = tiles.RANGE_SIGMAS * stds.nan_to_num(posinf=np.inf)
    lost = ~((films.abs() < tiles.USELESS) & (stds < tiles.USELESS))
    work.missing, work.lost = films.isnan().sum(dim=1), lost.sum(dim=1)
    work.beyond = ((films < model.lowest - margin) | (films > model.highest + margin)).any(dim=1)
    for place, name in enumerate(FILMS):
        film = (films, stds)[place % 2][place // 2]
        setattr(work, name, film.where(~lost[place // 2], np.nan))


def _straighten(model: Model, material: Known, work: Work) -> None:
    """Signals less the bend (eq. 11), pixels where it changed, and the scatter without it."""
    # Part of the reflections (band - 1, time, pixel) [K] that the responses bend, see `pixel`.
    signal, emissivity = _blackbody(model, work.background)[0], work.emissivity
    bend = (signal[1:] - signal[0]) * (1.0 - emissivity[1:, None])
    physical = ((emissivity > 0) & (emissivity < 1)).all(dim=0) & bend.isfinite().all(0).all(0)
    work.further = torch.cat([work.signals[:1], work.signals[1:] - bend.where(physical, 0.0)])
    energy = (work.further - work.straight)[1:].var(dim=1, correction=0) * work.signals.shape[1]
    work.bent = (energy > (pixel.BEND * model.noise[1:, None]) ** 2).any(dim=0)
    # Together pixels show a bend that is too small to be seen in each.
    stated = material["noise_variance"].isfinite() if material else torch.zeros_like(work.bent)
    scatter, free = _less_noise(model, _scatter(model, work.further)[1], work.order)
    # The bend is that of a noisy background: what its noise is in the bands, less theirs alone.
    slopes = _blackbody(model, work.background.mean(dim=0)[None])[1][:, 0]
    dark = (1.0 - emissivity) / model.noise[:, None]
    rate, other = dark * slopes, dark * (slopes - slopes[0])
    shared = einsum("mp,kp->mkp", other, rate) + einsum("mp,kp->mkp", rate, other)
    shared = (shared - einsum("mp,kp->mkp", other, other)) / (rate**2).sum(dim=0)
    shared = free[:, None, None] * shared.where(physical, 0.0)
    work.scatter = work.scatter.where(work.bent | stated, scatter) + shared


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


def _weighted(curves: Tensor, weights: Tensor) -> Tensor:
    """Sum over the bands of (band, time, pixel), weighted by (band, pixel)."""
    return einsum("btp,bp->tp", curves, weights)


def _quotient(numerator: Tensor, denominator: Tensor, otherwise: float) -> Tensor:
    """Quotient where the denominator is positive, and another value elsewhere."""
    return (numerator / denominator).where(denominator > 0, otherwise)


def _ratios(model: Model, material: Known, work: Work) -> None:
    """Step 1 (eq. 2 to 5), see `pixel.ratios`."""
    signals, noise = work.straight, model.noise[:, None]
    bands, frames, pixels = signals.shape
    # Eq. 3: scatter (order, pixel, band, band) of the whitened signals outside the functions.
    held, scatter = _scatter(model, signals)
    orders = torch.arange(1, len(scatter) + 1, device=signals.device)
    freedom, rows = frames - model.steps - orders, torch.arange(pixels, device=signals.device)
    # Its energy is the largest eigenvalue along the axis, noise alone across it.
    trace = einsum("opbb->op", scatter)
    largest = torch.linalg.eigvalsh(scatter)[..., -1]
    work.pooled = torch.zeros_like(rows, dtype=torch.bool)
    if material:
        axis = material["ratio"] / noise
        axis = axis / axis.norm(dim=0)
        along = einsum("bp,opbc,cp->op", axis, scatter, axis)
        turned = einsum("pbc,cp->bp", scatter[_order(trace - along, frames), rows], axis)
        product = (axis * turned).sum(dim=0)
        work.pooled = (turned**2).sum(dim=0) / product - product < model.chances[0]
        largest = along.where(work.pooled, largest)
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
        blend = _quotient(spread, spread + inverse, 0.0)
        mean = material["ratio"] + blend * (ratio - material["ratio"])
        ratio = torch.where(work.pooled, mean.where(blend > 0, material["ratio"]), ratio)
        common = (1.0 - blend) * (spread + (1.0 - blend) * material["inverse_energy"])
        inverse = common.where(work.pooled, inverse)
    weights, variance = reflection_ratio.null_combination(ratio, model.noise)
    work.ratio, work.inverse_energy = ratio, inverse
    work.null_weights, work.null_variance = weights, variance
    work.order, work.used = order + 1, order + 1 + model.steps
    work.contrast = _quotient(largest[-1] * (bands - 1), across[-1], np.inf)
    work.reduced_chi2 = across[order, rows] / ((bands - 1) * free)
    # Coefficients of the signals, and of the null combination, on the columns in use.
    columns = torch.arange(held.shape[1], device=signals.device)[:, None]
    work.columns = columns < work.used
    work.coefficients = held * work.columns
    work.smoothed = einsum("bp,bcp->cp", weights, held) * work.columns
    work.scatter, work.freedom = _less_noise(model, scatter, work.order)


def _scatter(model: Model, signals: Tensor) -> tuple[Tensor, Tensor]:
    """Coefficients of signals; scatter (order, pixel, band, band) outside the functions (eq. 3)."""
    noise, held = model.noise[:, None], model.functions @ signals
    white = held / noise[..., None]
    total = einsum("btp,ctp->pbc", signals, signals) / (noise * noise.T)
    return held, total - einsum("bfp,cfp->fpbc", white, white).cumsum(0)[model.steps :]


def _less_noise(model: Model, scatter: Tensor, order: Tensor) -> tuple[Tensor, Tensor]:
    """Scatter less noise (3, band, band, pixel) at the orders of a survey, and its freedom."""
    rapid = np.array([max(1, len(scatter) - reflection_ratio.FEWER), len(scatter)])
    orders = torch.stack([order, *(torch.full_like(order, int(one)) for one in rapid)])
    free = model.functions.shape[1] - model.steps - orders
    unit = torch.eye(scatter.shape[-1], device=scatter.device)[..., None]
    chosen = scatter[orders - 1, torch.arange(len(order), device=scatter.device)]
    return chosen.movedim(1, -1) - free[:, None, None] * unit, free


def _order(across: Tensor, frames: int) -> Tensor:
    """Order less one (pixel) of the lowest information criterion of an energy (order, pixel)."""
    if len(across) == 1:
        return torch.zeros_like(across[0], dtype=torch.int64)
    orders = torch.arange(1, len(across) + 1, device=across.device)[:, None]
    criterion = frames * across.clip(min=reflection_ratio.TINY).log() + orders * np.log(frames)
    lowest = min(reflection_ratio.LOWEST_ORDER, len(across) - 1) - 1
    return lowest + criterion[lowest:-1].argmin(dim=0) + 1


def _may_be_gray(model: Model, work: Work) -> Tensor:
    """Pixels of which equal emissivities are not excluded, see `pixel.may_be_gray`."""
    unit = work.ratio / model.noise[:, None]
    unit, gray = unit / unit.norm(dim=0), model.gray / model.noise
    # The part of g / s orthogonal to v; its variance is sigma^2.
    off = gray[..., None] - (gray @ unit)[:, None] * unit
    start, step = off[:-1], off.diff(dim=0)
    length = (step**2).sum(dim=1).clip(min=reflection_ratio.TINY)
    share = (-(start * step).sum(dim=1) / length).clip(0.0, 1.0)
    nearest = ((start + share[:, None] * step) ** 2).sum(dim=1) / work.inverse_energy
    # The mean is no larger than the largest chance: few pixels need it.
    near = nearest.amin(dim=0) < model.chances[1]
    chance = chdtrc(len(unit) - 1, nearest[:, near].cpu().numpy()).mean(axis=0)
    result = torch.zeros_like(near)
    result[near] = torch.as_tensor(chance > reflection_ratio.GRAY_CHANCE, device=near.device)
    return result


def _alternate(model: Model, material: Known, work: Work) -> None:
    """Steps 2 and 3 in turns (eq. 5 to 7), see `pixel.emission`."""
    target, z, ratio = model.object_part.T @ work.smoothed, work.straight[0], work.ratio
    # Middle of the interval that the ratios leave for e_1, for a constant object.
    largest = ratio.amax(dim=0)
    middle = 0.5 + 0.5 * (1.0 - 1.0 / largest).where(largest > 1.0, 0.0)
    fixed = torch.zeros_like(work.pooled)
    if material:
        material_emissivity = work.pooled & material["emissivity"].isfinite()
        middle = material["emissivity"].where(material_emissivity, middle)
        fixed = material_emissivity & material["noise_variance"].isfinite()

    def approach(emissivity: Tensor, temperature: Tensor) -> tuple[Tensor, Tensor]:
        """Return the object after a step of Newton towards h(x) = q (eq. 6), and h'(x) before."""
        factors = work.null_weights * (1.0 - ratio * (1.0 - emissivity))
        value, slope = (_weighted(values, factors) for values in _blackbody(model, temperature))
        return temperature + (target - value) / slope, slope

    # The robust line is sought on a curve that is right to second order, or it locks elsewhere.
    temperature = _temperature(model, target, 1)
    guess = _fit(_blackbody(model, temperature, 0)[0], z, torch.ones_like(z))[0]
    first = guess.where((guess > 0) & (guess < 1), middle)
    temperature = approach(first, temperature)[0]
    before = slope_before = torch.full_like(first, np.nan)
    for _ in range(pixel.ROUNDS):
        work.emitted = _blackbody(model, temperature, 0)[0]
        slope = _regress(work, float(model.noise[0]))
        least = pixel.OBJECT_TO_NOISE * work.used * work.null_variance
        work.constant = (work.energy < least) & ~fixed
        rate = (slope - slope_before) / (first - before)
        rate = rate.where(rate.abs() < pixel.FASTEST, 0.0)
        before, slope_before = first, slope
        first = slope + (slope - before) * rate / (1.0 - rate)
        first = middle.where(work.constant | fixed, first)
        temperature, work.steepness = approach(first, temperature)
    work.temperature, work.at_object = temperature, _blackbody(model, temperature)[0]
    work.known, work.emissivity = fixed, 1.0 - ratio * (1.0 - first)


def _emission(model: Model, material: Known, work: Work) -> None:
    """Variances (eq. 8) of emissivities and object, see `bars`."""
    noise, z, emitted, weights = model.noise, work.straight[0], work.emitted, work.weights
    first, w = work.emissivity[0], work.null_weights
    # Variance of the slope: of the ordinate's noise, and of the abscissa's.
    centred = (emitted - (weights * emitted).sum(0) / weights.sum(0)) / work.energy
    noise_variance = work.line_variance
    noise_variance = noise_variance + first**2 * _curve_variance(model, work, weights * centred)
    # Frames that the line leaves out, beside reflections, show how much of them it still holds.
    near = _tukey(work.residual, work.scale * (bars.FARTHEST / regression.TUNING))
    edges = -(-torch.arange(SPANS + 1) * len(z) // SPANS)
    influence = _block_sums(near * centred * work.residual, edges)
    work.influence = influence.where(~work.known, 0.0)
    walk, upper = _walk(model, work)
    limit = (1.0 - first) * model.drift
    change = emitted.amax(dim=0) - emitted.amin(dim=0)
    drift_variance = (limit / change) ** 2 + torch.maximum(upper, _linear(model, work, limit))
    if material:
        noise_variance = material["noise_variance"].where(work.known, noise_variance)
        drift_variance = material["drift_variance"].where(work.known, drift_variance)
    work.noise_variance, work.drift_variance = noise_variance, drift_variance
    # Of the ratios, through the background's level.
    level = (z - emitted).mean(dim=0).abs() * (noise_variance + walk).sqrt() / (1.0 - first) ** 2
    widest = (model.highest - model.lowest) / np.sqrt(12.0)
    level = work.ratio * model.rates[:, None] * level.where(level < widest, widest)
    epsilon = work.inverse_energy * work.null_variance + (w * level).sum(dim=0) ** 2
    variance = reflection_ratio.ratio_variance(work.ratio, work.inverse_energy, noise)
    work.epsilon_variance, work.ratio_variance = epsilon, variance + level**2
    # Eq. 6 by implicit differentiation; the error of w.kappa moves weight from the other bands to
    # the first, by their share in it.
    shares = (w**2 * (noise[:, None] ** 2 + (work.ratio * noise[0]) ** 2))[1:]
    mean_signal = _weighted(work.at_object[1:], shares / shares.sum(dim=0))
    partial = mixing.mixed(first, work.at_object[0], mean_signal)
    sensitivity = (partial - model.object_part.T @ work.coefficients[0]) / work.steepness
    leverage = model.leverage[work.order - 1].T
    smooth_variance = leverage * work.null_variance / work.steepness**2
    square = sensitivity**2 * epsilon
    work.sensitivity, work.smooth_variance = sensitivity, smooth_variance
    work.variance = square / (1.0 - bars.NORMAL95**2 * epsilon) ** 2 + smooth_variance
    expected = square + smooth_variance * (1.0 + np.log(len(z)) / work.used)
    resting = work.residual**2 < bars.WITHIN**2 * (noise[0] ** 2 + first**2 * expected)
    work.restless = resting.sum(dim=0) < bars.RESTING * len(z)
    work.emissivity_covariance = _covariance(model, work, level)


def _covariance(model: Model, work: Work, level: Tensor) -> Tensor:
    """Covariance of the emissivities (band, band, pixel) (eq. 8), see `bars`."""
    ratio, first, squares = work.ratio, work.emissivity[0], (model.noise**2)[:, None]
    unit = torch.eye(len(ratio), dtype=ratio.dtype, device=ratio.device)[..., None]
    pairs = ratio[:, None] * ratio
    # Of the ratios (eq. 4), and through the background's level; the first one is 1.
    error = work.inverse_energy * (unit * squares + pairs * squares[0])
    error[0], error[:, 0] = 0.0, 0.0
    error = error + level[:, None] * level
    # de_m = kappa_m do - (1 - e_1) (kappa_m e_1 w.dkappa + dkappa_m).
    change = (1.0 - first) * (first * ratio[:, None] * work.null_weights + unit)
    through = einsum("imp,mnp,jnp->ijp", change, error, change)
    return pairs * (work.noise_variance + work.drift_variance) + through


def _curve_variance(model: Model, work: Work, kernel: Tensor) -> Tensor:
    """Variance (pixel) of the sum of a kernel (time, pixel) over the object's smoothed noise."""
    projected = (model.object_part @ kernel) * work.columns
    return work.null_variance * (projected**2).sum(dim=0)


def _walk(model: Model, work: Work) -> tuple[Tensor, Tensor]:
    """Variance (pixel) [1] of the slope from a background that walks, and its bound; see `bars`."""
    degree = torch.arange(1.0, len(model.rising) + 1.0, device=work.emitted.device)[:, None]
    # Spectra of the residual, over the share of frames that the weights keep, and of the curve.
    share = work.weights.mean(dim=0)
    spectrum = model.rising @ (work.residual * work.weights) / share
    curve = model.rising @ work.emitted
    energy = (curve**2).sum(dim=0)
    unit = curve / energy.sqrt()
    # The part orthogonal to the object's curve is the background's alone.
    spectrum = spectrum - unit * (unit * spectrum).sum(dim=0)
    # Energy of a walk at degree 1: j^2 times that at degree j, less the noise's.
    noise = model.noise[0] ** 2 / share
    noise = noise + work.emissivity[0] ** 2 * work.null_variance * (degree < work.used)
    walk, expected, upper = degree**2 * (spectrum**2 - noise), 0.0 * energy, 0.0 * energy
    for (low, high, lost), widened in zip(bars.OCTAVES, model.widened, strict=True):
        if (freedom := len(walk[low - 1 : high - 1]) - lost) > 0:
            energies = walk[low - 1 : high - 1].sum(dim=0) / freedom
            expected = torch.maximum(expected, energies)
            upper = torch.maximum(upper, energies * widened)
    scale = (unit**2 / degree**2).sum(dim=0) / energy
    return scale * expected, scale * upper


def _linear(model: Model, work: Work, limit: Tensor) -> Tensor:
    """Variance (pixel) [1] of the slope from a linear drift, weighted twice; see `bars`."""
    drift, weights = model.rising[0][:, None].expand_as(work.emitted), work.weights
    for last in (False, True):
        slope, _, centred, _ = _fit(work.emitted, drift, weights)
        kernel = weights * centred
        kernel = kernel / (kernel * drift).sum(dim=0)
        size = (kernel * work.residual).sum(dim=0)
        if not last:
            weights = _tukey(work.residual - size * centred, work.scale)
    variance = model.noise[0] ** 2 * (kernel**2).sum(dim=0)
    variance = variance + work.emissivity[0] ** 2 * _curve_variance(model, work, kernel)
    before = torch.maximum((limit / model.spread) ** 2, size**2 + variance)
    share = before / (before + variance)
    return slope**2 * share * (share * size**2 + variance)


def _background(model: Model, work: Work) -> None:
    """Step 4 (eq. 9), and its variance [K^2] (eq. 10), see `bars`; those of a residual pattern."""
    emissivity, noise, first = work.emissivity, model.noise[:, None], work.emissivity[0]
    precision = ((1.0 - emissivity) / noise) ** 2
    weights = precision / precision.sum(dim=0)
    reflected = mixing.background(emissivity[:, None], work.signals, work.at_object)
    # From the temperature of the mean signal, one Gauss-Newton step on the exact responses.
    start = _temperature(model, _weighted(reflected, weights), 0)
    signal, slope = _blackbody(model, start)
    curvature = _weighted(slope**2, weights)
    work.background = start + _weighted(slope * (reflected - signal), weights) / curvature
    # Eq. 10, term by term.
    share = (weights * emissivity / (1.0 - emissivity)).sum(dim=0)
    contrast = work.background - work.temperature
    through = contrast * first + share * work.sensitivity
    covariance = 2.0 * noise[0] ** 2 * work.null_weights[0] * work.inverse_energy
    steady = noise[0] ** 2 - 1.0 / ((work.ratio / noise) ** 2).sum(dim=0)
    steady = steady * work.inverse_energy
    steady = steady + (work.noise_variance + work.drift_variance) / (1.0 - first) ** 2
    variance = 1.0 / (precision.sum(dim=0) * curvature) + share**2 * work.smooth_variance
    variance = variance + through * (through * work.epsilon_variance - contrast * covariance)
    work.background_variance = variance + contrast**2 * steady
    if model.pattern.any():
        slopes = emissivity[:, None] * _blackbody(model, work.temperature)[1]
        direct = weights / (1.0 - emissivity)
        of_object = work.null_weights[:, None] / _weighted(slopes, work.null_weights)
        of_background = direct[:, None] - _weighted(slopes, direct) * of_object
        of_background = of_background / _blackbody(model, work.background, 0)[1]
        for name, weight in (("variance", of_object), ("background_variance", of_background)):
            squares = einsum("b,btp->tp", model.pattern**2, weight**2)
            setattr(work, name, getattr(work, name) + squares)


def _regress(work: Work, noise: float) -> Tensor:
    """Slope (pixel) of the robust line of the first band over `emitted`, see `regression`.

    From the weights in the work space, or anew; its scale, residual, energy, variance and weights
    in place.
    """
    z = work.straight[0]
    if work.weights is None:
        residual = _first_residual(work.emitted, z, noise)
    else:
        residual = _fit(work.emitted, z, work.weights)[2]
    for step in range(1, regression.STEPS + 1):
        scale = (regression.TO_STD * _ranked_magnitude(residual)).clip(min=noise)
        weights = _tukey(residual, scale)
        if step == regression.STEPS:  # none beside points without, if half is kept
            lost, width = (weights == 0.0).double().T, 1 + 2 * regression.EDGE
            lost = torch.nn.functional.max_pool1d(lost, width, 1, regression.EDGE).T
            kept = weights.where(lost == 0.0, 0.0)
            weights = kept.where(kept.sum(dim=0) >= 0.5 * weights.sum(dim=0), weights)
        slope, _, residual, energy = _fit(work.emitted, z, weights)
    # var(slope) = s^2 / sum w (x - mean)^2, over the fraction of independent points.
    kept = residual * weights
    lagged = _quotient((kept[1:] * kept[:-1]).sum(dim=0), (kept**2).sum(dim=0), 0.0)
    correlation = lagged.clip(0.0, regression.MOST_CORRELATED)
    independent = (1.0 - correlation) / (1.0 + correlation)
    work.scale, work.residual, work.energy, work.weights = scale, residual, energy, weights
    work.line_variance = scale**2 / energy / independent
    return slope


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
            trial_slope, trial_intercept, residual, _ = _fit(x, z, weights)
            deviation = _ranked_magnitude(residual)
            scale = regression.ANNEALING * regression.TO_STD * deviation
            weights = _tukey(residual, scale.clip(min=noise)).float()
        better = deviation < smallest
        slope, intercept = (
            trial_slope.where(better, slope),
            trial_intercept.where(better, intercept),
        )
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


def _judge(model: Model, work: Work) -> None:
    """Is the null residual noise? And its sums over blocks, with those of the object's curve."""
    residual = _weighted(work.straight, work.null_weights) - model.functions.T @ work.smoothed
    rapid = work.straight[0] - model.functions.T @ work.coefficients[0]
    curve = model.object_part.T @ work.smoothed
    work.sums = torch.stack([_block_sums(film, model.parts) for film in (residual, curve)])
    # Mean autocorrelation over some lags, in standard deviations of white noise.
    lags = range(1, bars.LAGS + 1)
    lagged = torch.stack([(residual[lag:] * residual[:-lag]).sum(dim=0) for lag in lags]).sum(0)
    mean = _quotient(lagged, bars.LAGS * (residual**2).sum(dim=0), 0.0)
    work.correlation = mean * np.sqrt(bars.LAGS * len(residual))
    # A matched filter with the differences between frames, of a band that is late or early.
    common, change = work.null_weights[0] * model.noise[0] ** 2, rapid.diff(dim=0)
    late = (residual[:-1] * change).sum(dim=0) + work.freedom[0] * common
    early = (residual[1:] * change).sum(dim=0) - work.freedom[0] * common
    variance = work.null_variance * (change**2).sum(dim=0)
    score = _quotient(torch.maximum(late.abs(), early.abs()), variance.sqrt(), 0.0)
    # Energy in the frames at a change; the cube root of a chi-square over its n degrees has the
    # mean 1 - v and the variance v.
    steps = change.abs() > bars.CHANGE * np.sqrt(2.0) * model.noise[0]
    at = torch.zeros_like(residual, dtype=torch.bool)
    at[1:] |= steps
    at[:-1] |= steps
    count = at.sum(dim=0).double()
    mean = _quotient((residual**2 * at).sum(dim=0) / work.null_variance, count, 1.0)
    spread = 2.0 / (9.0 * count.clip(min=1.0))
    at_changes = (mean ** (1.0 / 3.0) - (1.0 - spread)) / spread.sqrt()
    work.delay = torch.maximum(score, at_changes)
    # White noise in all parts of time: its correlation with independent changes, and its sums.
    (most, limit), length = model.limits, model.edges.diff()[:, None]
    variance = work.null_variance.where(work.null_variance > 0, np.inf)
    rapid = rapid - common / variance * residual
    sums, products, squares = (
        _block_sums(film, model.edges) for film in (residual, residual * rapid, rapid**2)
    )
    unexplained = _quotient(products**2, squares, 0.0).sum(dim=0) / variance > most
    while len(sums) > 1:
        unexplained |= (sums**2 > limit * variance * length).any(dim=0)
        sums, length = sums[::2] + sums[1::2], length[::2] + length[1::2]
    work.unexplained = unexplained


def _block_sums(values: Tensor, edges: Tensor) -> Tensor:
    """Sums (block, pixel) of values (time, pixel) between edges, of which none are the same."""
    total = values.cumsum(dim=0)[edges[1:] - 1]
    return torch.cat([total[:1], total.diff(dim=0)])
