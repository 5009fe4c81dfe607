"""The paper's objective in torch: its gradient by autograd, and its descent by Adam.

Written from the equations of Narayanan et al. (2026), doi:10.48550/arXiv.2509.11334, as corrected
in docs/paper.md, to hold the compiled objective and Newton steps of the method "dbvt" against. The
unknowns are those of `objective`; the response is linear, as the paper's.
"""

import copy
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
import torch
import xarray as xr

from dbthermal import response as responses
from dbthermal import simulation
from dbthermal.separation._tiles import Array, Tile
from reproduction.experiments.cases import independent_pixels
from reproduction.methods import dbvt_objective as objective
from reproduction.methods.dbvt import DbvtSettings, Search

INTERVAL: Final = 0.1  # interval of the frames [s]

SETTINGS: Final = DbvtSettings(bend_updates=0)
"""Settings of the method "dbvt" for a linear response."""


def plate(
    emissivity: Sequence[float],
    noise: Sequence[float],
    frames: int,
    pixels: int,
    seed: int,
    **settings: Any,
) -> tuple[Search, xr.DataArray]:
    """Search at random emissivities of a simulated plate, and the plate's temperature.

    It is heated from 20 to 60 C: (pixel, time), less the reference temperature [K].
    """
    rng, rig = np.random.default_rng(seed), simulation.Rig(noise=tuple(noise))
    value = xr.DataArray(list(emissivity), {"band": list(rig.bands)}, "band")
    clock, background = np.arange(frames, dtype=float) * INTERVAL, simulation.Background()
    scene = independent_pixels(clock, value, background, pixels, rng, start=293.15, stop=333.15)
    curves = tuple(responses.curve(rig.response(), band, "linear") for band in rig.bands)
    names = ("object_temperature", "background_temperature")
    warm, cold = (scene[name].values[:, 0] - curves[0].reference for name in names)
    signals = np.stack([share * warm + (1 - share) * cold for share in emissivity])
    signals += rng.standard_normal(signals.shape) * np.array(noise)[:, None, None]
    tile = Tile(signals, clock, curves, tuple(noise), (1, pixels), rng)
    truth = xr.DataArray(warm.T, dims=("pixel", "time"), attrs={"emissivity": list(emissivity)})
    return Search(tile, replace(SETTINGS, **settings)), truth


def losses(films: Any, scalars: Any, search: Search) -> Any:
    """Weighted losses (5, pixel) [1] of films (pixel, 3, time) [K] and rest (pixel, 3), as tensors.

    The deviation that normalises the Huber loss counts as a constant.
    """
    sigma = torch.tensor(search.tile.noise, dtype=torch.float64)[:, None]
    limit, floor = SETTINGS.huber_threshold * sigma, SETTINGS.deviation_floor * sigma
    offset, first, second = scalars[..., None].unbind(1)
    rise = torch.cumsum(second / first * torch.diff(films[:, 0]), -1)  # the smooth signals' ratio
    smooth = torch.stack([films[:, 0], torch.cat([offset, offset + rise], -1)], 1)
    noise, corrected = films[:, 1:], torch.tensor(search.signals) - films[:, 1:]
    residual = corrected - smooth
    scale = torch.maximum(corrected.std(-1, keepdim=True), floor).detach()
    huber = torch.nn.functional.huber_loss(residual / limit, 0 * residual, reduction="none")
    error = residual[:, 1] - (1 - second) / (1 - first) * residual[:, 0]
    bend = torch.diff(smooth, n=2) / (SETTINGS.curvature * INTERVAL**2)
    terms = {
        "smoothness": (bend**2).sum((1, 2)) / films.shape[-1],
        "huber": (limit / scale * huber).mean(-1).sum(-1),
        "reconstruction": ((error / sigma[1]) ** 2).mean(-1),
        "noise": ((noise / sigma) ** 2).mean(-1).sum(-1),
        "noise_mean": ((noise / sigma).mean(-1) ** 2).sum(-1),
    }
    return torch.stack([getattr(SETTINGS, name) * term for name, term in terms.items()])


def newton_gradient(search: Search, column: int) -> tuple[Array, ...]:
    """Losses, and the gradient of a Newton step: by smooth signal, noise, offset, emissivities."""
    films, scalars, signals = search.films[column], search.scalars[column], search.signals[column]
    weights, sigma = search.weights, search.tile.noise
    deviation = [
        objective.deviation(*band, SETTINGS.deviation_floor)
        for band in zip(signals, films[1:], sigma, strict=True)
    ]
    scale = objective.Scale(sigma, tuple(deviation), 1.0)
    _, forces, blocks = objective.system(films, scalars, signals, scale, weights, 1.0)
    # The forces are those of the eliminated noise: q N^-1 pull is put back.
    noise = objective.noise_step(blocks, 0.0 * films, scalars, scale, weights)[1:]
    (_, e1, e2), variance = scalars, np.square(sigma)[:, None]
    k1, k2 = e2 / e1, (1 - e2) / (1 - e1)
    # g_n1, g_n2 = q n + mean - (h p)_m +- w r; beyond the noise's term they are those of I1~, I2~.
    of_noise = forces[:, :2].T - (weights.noise + weights.noise_mean) / variance * noise
    of_noise[0] -= k1 * forces[:, 1]
    error = forces[:, 2] - weights.reconstruction / variance[1] * (k2 * noise[0] - noise[1])
    first, second = blocks[:, :2].T - of_noise
    bend, square = objective.bending(films[0])
    stiff = weights.smoothness / weights.curvature**2
    # I2~(t) = I2~(0) + k1 [I1~(t) - I1~(0)], and the bending (1 + k1^2) |D I1~|^2
    smooth = first + k1 * second + stiff * (1 + k1**2) * bend
    smooth[0] -= k1 * second.sum()
    by_k1 = second @ (films[0] - films[0, 0]) + stiff * k1 * square
    by_k2 = -blocks[:, 4] @ error
    # dk1 = (de2 - k1 de1) / e1, dk2 = (k2 de1 - de2) / (1 - e1)
    by_emissivity = [by_k2 * k2 / (1 - e1) - by_k1 * k1 / e1, by_k1 / e1 - by_k2 / (1 - e1)]
    gradients = smooth, blocks[:, :2].T, second.sum(), np.array(by_emissivity)
    values = objective.losses(films, scalars, signals, scale, weights)
    return values, *(2 / films.shape[1] * gradient for gradient in gradients)


def _tensors(search: Search) -> list[Any]:
    return [torch.tensor(data, requires_grad=True) for data in (search.films, search.scalars)]


def disagreements(search: Search, rng: np.random.Generator) -> xr.DataArray:
    """Relative differences [1] of losses and gradient from torch's (quantity, pixel).

    At random films, where the objective has a derivative.
    """
    search = copy.deepcopy(search)
    search.films += rng.standard_normal(search.films.shape) * np.array([[1.0], [0.1], [0.1]])
    films, scalars = _tensors(search)
    total = losses(films, scalars, search)
    gradient = (data.numpy() for data in torch.autograd.grad(total.sum(), (films, scalars)))
    rows = []
    for column, (film, border) in enumerate(zip(*gradient, strict=True)):
        values = total[:, column].detach().numpy(), film[0], film[1:], border[0], border[1:]
        pairs = zip(newton_gradient(search, column), values, strict=True)
        rows.append([np.linalg.norm(step - value) / np.linalg.norm(value) for step, value in pairs])
    names = ["losses", "by smooth signal", "by noise", "by offset", "by emissivities"]
    return xr.DataArray(np.transpose(rows), {"quantity": names}, ("quantity", "pixel"))


def newton(start: Search, truth: xr.DataArray) -> tuple[Search, xr.Dataset]:
    """Search at the end of its steps, and their mean number with what is `judged`."""
    stages, stopped = np.full(len(start.scalars), SETTINGS.stages), []
    for number in range(1, SETTINGS.steps + 1):
        search, began = copy.deepcopy(start), time.process_time()
        search.settings = replace(SETTINGS, steps=number)
        stopped.append(search._minimise(stages)[1])
    before = SETTINGS.stage_steps * (SETTINGS.stages - 1)
    steps = before + 1 + np.mean(~np.array(stopped[:-1]), axis=1).sum()
    point = steps, time.process_time() - began, *map(torch.tensor, (search.films, search.scalars))
    return search, judged(start, truth, [point])


def adam(start: Search, truth: xr.DataArray, rate: float, looks: Sequence[int]) -> xr.Dataset:
    """What is `judged` at some steps of Adam of a rate [K, and 1 of emissivities]."""
    films, scalars = _tensors(start)
    descent, began, points = torch.optim.Adam([films, scalars], lr=rate), time.process_time(), []
    for number in range(1, max(looks) + 1):
        descent.zero_grad()
        losses(films, scalars, start).sum().backward()
        descent.step()
        with torch.no_grad():
            scalars[:, 1:].clamp_(SETTINGS.margin, 1 - SETTINGS.margin)
        if number in looks:
            at = films.detach().clone(), scalars.detach().clone()
            points.append((number, time.process_time() - began, *at))
    return judged(start, truth, points)


def judged(search: Search, truth: xr.DataArray, points: Sequence[tuple[Any, ...]]) -> xr.Dataset:
    """Judgement (look) of points, each of iteration, seconds, films and rest.

    `iteration`, `time` of one thread a pixel [ms], and medians over the pixels: `objective` [1],
    `object_temperature_rmse` [K], `emissivity_error` of the worse band [1].
    """
    rows, signals = [], np.moveaxis(search.tile.signals, -1, 0)
    for number, seconds, films, scalars in points:
        reached = losses(films, scalars, search).sum(0).numpy()
        corrected, emissivity = signals - films[:, 1:].numpy(), scalars[:, 1:].numpy()
        ratio = np.divide(*(1 - emissivity.T[::-1]))[:, None]
        warm = (corrected[:, 1] - ratio * corrected[:, 0]) / (1 - ratio)
        rmse = np.sqrt(np.mean((warm - truth.values) ** 2, axis=1))
        off = np.abs(emissivity - truth.attrs["emissivity"]).max(axis=1)
        medians = (np.median(values) for values in (reached, rmse, off))
        rows.append([number, 1e3 * seconds / len(scalars), *medians])
    names = ["iteration", "time", "objective", "object_temperature_rmse", "emissivity_error"]
    coords = {"look": np.arange(len(rows)), "quantity": names}
    table = xr.DataArray(np.array(rows), coords, ("look", "quantity"))
    return table.to_dataset("quantity").assign_attrs(origin="simulated")
