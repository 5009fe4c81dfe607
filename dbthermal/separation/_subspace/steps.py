"""Steps 1 to 4 of `method` for the pixels of a tile, and what its flags are judged by.

In arrays (time, pixel) of any number of bands. `fused` repeats them for two bands, compiled.
"""

import importlib
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

import numpy as np

from dbthermal import _smooth as smooth
from dbthermal._arrays import host, like, namespace
from dbthermal.separation._subspace import background as backgrounds
from dbthermal.separation._subspace import emission as emissions
from dbthermal.separation._subspace import pieces, reflection_ratio, residuals
from dbthermal.separation._tiles import USELESS, Array, Mask, Pixels, Tile, Whole, out_of_range

FILMS: Final = (
    *("object_temperature", "object_temperature_std"),
    *("background_temperature", "background_temperature_std"),
)
"""Names of the films of a solution."""


@dataclass(frozen=True)
class Solution(Pixels):
    """Object, background, ratios and emissivities of each pixel, and statistics of the fit."""

    object_temperature: Array  # (time, pixel) [K]; NaN where its deviation is of no use
    object_temperature_std: Array
    background_temperature: Array  # (time, pixel) [K]
    background_temperature_std: Array
    missing: Array  # samples without a number (2, pixel), of object and background
    lost: Array  # samples without a number or a deviation of use (2, pixel)
    beyond: Mask  # temperatures outside the calibrated range (2, pixel)
    ratio: Array  # see `reflection_ratio.ReflectionRatio` for this and what follows
    ratio_variance: Array  # (band, pixel) [1], with that through the background's level
    inverse_energy: Array
    null_weights: Array
    null_variance: Array
    order: Whole
    freedom: Whole  # frames less the functions used (pixel)
    contrast: Array
    reduced_chi2: Array
    pooled: Mask
    scatter: Array
    rapid_scatter: Array
    emissivity: Array  # see `emission.Emission` for this and what follows
    emissivity_covariance: Array
    epsilon_variance: Array
    noise_variance: Array
    drift_variance: Array
    constant: Mask
    restless: Mask
    gray: Mask  # the signals as they are may be those of a gray body (pixel)
    correlation: Array  # of the null residual, see `residuals` (pixel)
    delay: Array  # of the bands (pixel)
    unexplained: Mask  # the residual is not noise (pixel)
    sums: Array  # of the null residual and the object's curve (2, block, pixel), see `pieces` [K]


def solve(
    tile: Tile, functions: smooth.Subspace, drift: float, least: float = emissions.BEND
) -> Solution:
    """
    Steps 1 to 4, where it matters again on signals with proportional reflections.

    With the limit of the background's `drift` [K], and the `least` bend that matters.
    """
    result, bend, line = _steps(tile, tile, functions, drift)
    xp, noise = namespace(bend), like(tile.noise[1:], bend)[:, np.newaxis]
    part, removed, places = tile, 0.0 * bend, like(np.arange(len(result.gray)), bend)
    for _ in range(emissions.BENDS):
        change = bend - removed
        change -= change.mean(axis=1, keepdims=True)
        energy = xp.einsum("btp,btp->bp", change, change)
        bent = xp.any(energy > (least * noise) ** 2, axis=0)
        if not bent.any():
            break
        part, removed, places = part.select_pixels(bent), bend[..., bent], places[bent]
        least = emissions.BEND
        straight = xp.concatenate([part.signals[:1], part.signals[1:] - removed])
        line = line.select_pixels(bent)
        as_they_are = result.gray[places], result.cost[places]
        again, bend, line = _steps(
            part, replace(part, signals=straight), functions, drift, as_they_are, line
        )
        result.replace_pixels(places, again)
    return result


def solve_on(
    device: str, tile: Tile, functions: smooth.Subspace, drift: float, least: float
) -> Solution:
    """As `solve`, on tensors of torch on a device; the solution is in arrays again."""
    tensor = partial(importlib.import_module("torch").tensor, device=device)
    material = None if tile.material is None else tile.material.each(tensor)
    there = replace(tile, signals=tensor(tile.signals), material=material)
    names = ("functions", "object_part", "rising", "of_pieces")
    parts = {name: getattr(functions, name) for name in names}
    columns: dict[str, Any] = {name: tensor(v) for name, v in parts.items() if v is not None}
    return solve(there, replace(functions, **columns), drift, least).each(host)


def _steps(
    tile: Tile,
    straight: Tile,
    functions: smooth.Subspace,
    drift: float,
    as_they_are: tuple[Mask, Array] | None = None,
    start: residuals.Line | None = None,
) -> tuple[Solution, Array, residuals.Line]:
    """
    Steps 1 to 4, the first three on signals whose reflections are proportional; and the bend.

    The bend of a gray body is not known: whether it is one is told from signals `as_they_are`, and
    their cost as one smooth curve.
    """
    signals, frames = straight.signals, tile.time.size
    noise, xp = like(tile.noise, signals), namespace(signals)
    ratios = reflection_ratio.estimate(signals, functions, noise, tile.material)
    if as_they_are is None:
        curve = tile.curves[0]
        temperature = np.linspace(curve.lowest, curve.highest, reflection_ratio.TEMPERATURES)
        slopes = np.stack([curve.slope(temperature) for curve in tile.curves], axis=1)
        used = ratios.order + functions.steps
        cost = ratios.reduced_chi2 * (frames - used) + pieces.COST * used
        gray = reflection_ratio.may_be_gray(ratios, noise, like(slopes, noise))
        as_they_are = gray, (len(noise) - 1) * cost
    emission = emissions.estimate(straight, functions, ratios, drift, start)
    background, variance = backgrounds.estimate(tile, emission, ratios)
    of_object, of_background = backgrounds.pattern_variances(tile, emission, ratios, background)
    films = xp.stack([emission.temperature, background])
    stds = xp.sqrt(xp.stack([emission.temperature_std**2 + of_object, variance + of_background]))
    lost = ~((xp.abs(films) < USELESS) & (stds < USELESS))
    beyond = out_of_range(films, stds, tile.curves[0])
    values = xp.where(lost, np.nan, xp.stack([films, stds]))
    residual = residuals.null_residual(signals, functions, ratios)
    smoothed = xp.einsum("bp,bcp->cp", ratios.null_weights, ratios.coefficients)
    rapid = signals[0] - functions.functions @ ratios.coefficients[0]
    common = ratios.null_weights[0] * noise[0] ** 2
    curves = residual, functions.object_part @ smoothed
    edges = pieces.blocks(frames)
    parts = vars(ratios) | vars(emission)
    solution = Solution(
        object_temperature=values[0, 0],
        object_temperature_std=values[1, 0],
        background_temperature=values[0, 1],
        background_temperature_std=values[1, 1],
        missing=xp.isnan(films).sum(axis=1),
        lost=lost.sum(axis=1),
        beyond=xp.any(beyond, axis=1),
        ratio_variance=ratios.variance + emission.level_std**2,
        freedom=frames - functions.steps - ratios.order,
        gray=as_they_are[0],
        correlation=residuals.autocorrelation(residual),
        delay=residuals.interband_delay(residual, signals[0], functions, ratios, noise[0]),
        unexplained=residuals.unexplained(residual, rapid, ratios.null_variance, common),
        sums=xp.stack([residuals.block_sums(curve, edges) for curve in curves]),
        **{name: parts[name] for name in parts if name in Solution.__dataclass_fields__},
    )
    return solution, backgrounds.bend(tile, emission, background), emission.line
