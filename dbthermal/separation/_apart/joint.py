r"""Object temperature where two cameras see each reflection at different places of the surface.

Paired by what is reflected (`displaced`), the bands hold the object of two places, r of the
reference band and p of the second camera. The combination without background (eq. 5 and 6 of
`_subspace.method`) is

.. math:: c_1 u_1(x(r)) + \sum_{m > 1} c_m u_m(x(p)) = q(r), \quad c_m = w_m e_m, \quad \sum c_m = 1

A method solves it as if x(p) were x(r), which gives q. Then the equations of all pixels are solved
together, frame by frame, each for the term of the larger coefficient:

.. math:: u_1(x(r)) \leftarrow \left[q(r) - \sum_{m > 1} c_m u_m(x(p))\right] / c_1

contracts by :math:`g = |\sum_{m > 1} c_m / c_1|` a step, for two bands
:math:`(e_2 / e_1) / \kappa`; where that is above 1 the equation solved for x(p) contracts by 1/g.
Both fail for a gray body alone. Errors of single pixels are averaged along the chain of places,
with the weights :math:`(1 - g) g^j`.
"""

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, TypeAlias

import numpy as np
import xarray as xr
from scipy.ndimage import convolve, distance_transform_edt, gaussian_filter, gaussian_filter1d

from dbthermal import _smooth as smooth
from dbthermal._arrays import copied, release
from dbthermal.schema import Status
from dbthermal.separation._apart import equations as system
from dbthermal.separation._apart import neighbours
from dbthermal.separation._apart.equations import Floats
from dbthermal.separation._apart.planes import Planes
from dbthermal.separation._inputs import Inputs
from dbthermal.separation._subspace import regression
from dbthermal.separation._subspace.reflection_ratio import null_combination
from dbthermal.separation._tiles import USELESS, Mask, Material, Whole

_OBJECT: Final = ("object_temperature", "object_temperature_std")
# Rounds of the emissivities and the object, and the change that ends them [1].
_ROUNDS: Final = 20
_SETTLED: Final = 1e-3
_LEAST_CHANGE: Final = 0.1  # change of the object [K] below which its emissivity is not told
_FRAMES, _PIXELS = 16, 4096  # frames, and pixels, that are solved together
# Frames from which it is told whether the object's gradient matters, and the share of the object's
# deviation from which it does, in more than a few of the samples.
_LOOKED_AT: Final = 32
_MATTERS: Final = 0.2
_MOST: Final = 0.99
# Frames for each polynomial that tell a smooth film, and the share of a deviation below which it is
# no matter that a film is not smooth.
_NODES: Final = 2
_NO_MATTER: Final = 0.1
# Draws of noise by which the deviations are propagated, and the variance over that of a pixel alone
# from which the iteration is taken to grow.
_DRAWS: Final = 64
_GROWN: Final = 1e3


@dataclass(frozen=True)
class Frames:
    """Frames at which a film is solved: a few of a smooth film, else all."""

    nodes: Whole  # (node)
    weights: Floats | None  # of the nodes in each frame (frame, node); None of all frames

    @property
    def smooth(self) -> bool:
        """The film changes smoothly: a few frames tell all."""
        return self.weights is not None

    @classmethod
    @np.errstate(invalid="ignore", divide="ignore")
    def of(cls, result: xr.Dataset) -> "Frames":
        """Frames at which a result's object is solved: few if it changes smoothly, else all."""
        film, std = (result[name].values.reshape(result.sizes["time"], -1) for name in _OBJECT)
        time, frames = result["time"].values, np.arange(len(film))
        functions = smooth.largest(time).functions
        count = _NODES * functions.shape[1]
        # Polynomials through nodes close together near the ends (Chebyshev) repeat a smooth film.
        place = 0.5 * (1.0 - np.cos(np.pi * (np.arange(count) + 0.5) / count)) * np.ptp(time)
        nodes = np.unique(np.abs(time - time[0] - place[:, np.newaxis]).argmin(axis=1))
        weights = np.asarray(functions @ np.linalg.pinv(functions[nodes]), np.float32)
        sampled = looked_at(time.size)
        # Off by more than a share of the deviation, in more than a few samples: a rapid object.
        off = np.abs(weights[sampled] @ film[nodes] - film[sampled]) / std[sampled]
        if nodes.size == time.size or not _most(off) < _NO_MATTER:
            return cls(frames, None)
        return cls(nodes, weights)


def _most(values: Floats) -> float:
    """Value that all but a few of the finite values do not exceed; NaN without such values."""
    numbers = values[np.isfinite(values)]
    return float(np.quantile(numbers, _MOST)) if numbers.size else np.nan


def looked_at(frames: int) -> Whole:
    """Some of the frames, evenly spaced."""
    return np.unique(np.linspace(0, frames - 1, _LOOKED_AT).astype(np.intp))


@dataclass(frozen=True)
class Joint:
    """Object of all pixels, of which each camera sees another place."""

    inputs: Inputs
    frames: Frames
    signals: Floats  # of the object at r and at p (2, node, pixel) [K]; NaN unknown
    emissivity: Floats  # of which it is made (band, pixel) [1]
    factor: Callable[[Executor], Floats]  # variance over that of a pixel alone (pixel) [1]
    unsettled: Mask  # the iteration did not come to an end (pixel)

    def difference(self, pixels: Whole, frames: slice | Whole = slice(None)) -> Floats:
        """Signals (band - 1, frame, pixel) [K] of x(p) over x(r), of some pixels; 0 unknown."""
        weights = self.frames.weights
        # Of a rapid film the frames that are needed, else all nodes.
        signals = self.signals[:, frames if weights is None else slice(None)]
        bends = system.bends(tuple(self.inputs.curves[band] for band in self.inputs.bands))
        changes = np.empty((len(bends), signals.shape[1], pixels.size), np.float32)
        for film, share, bend in zip(changes, self.emissivity[1:, pixels], bends, strict=True):
            system.changes(signals, pixels, share, bend, film)
        return changes if weights is None else weights[frames] @ changes

    def finish(self, result: xr.Dataset, threads: Executor) -> None:
        """Give the object of a result its deviation, in place; flag what is unsettled."""
        displacement, status = self.inputs.displacement, result["status"].values
        assert displacement is not None
        time, std = self.inputs.capture["time"].values, result["object_temperature_std"].values
        background = result["background_temperature"].values
        basis = smooth.largest(time).functions.astype(np.float32)

        def smoothed(rows: slice) -> Floats:
            film = np.array(background[:, rows]).reshape(time.size, -1)
            release()
            film = smooth.bridge(film, np.ones(film.shape[1], dtype=bool))
            return np.asarray(basis.T @ film)

        curves = np.concatenate([*threads.map(smoothed, self.inputs.blocks)], axis=1)
        curves = curves.reshape(-1, *status.shape)
        # Beside a pixel without a background it is taken to go on.
        lost = np.isnan(curves[0])
        place = distance_transform_edt(lost, return_distances=False, return_indices=True)
        curves = np.nan_to_num(curves[:, place[0], place[1]])
        # A reflection resampled off by dd: dq = sum_m w_m (1 - e_m) grad(y) . dd, smoothed in time.
        weights = system.weights(self.inputs, self.emissivity)
        error = ((1.0 - self.emissivity) * weights)[1:].sum(0) * displacement.std
        error = np.nan_to_num(error).reshape(2, *status.shape)
        slopes = [
            gaussian_filter1d(curves, 1.0, axis=axis, order=1) * component.astype(np.float32)
            for axis, component in zip((1, 2), error, strict=True)
        ]
        # Without a solution x(p) was taken for x(r): they differ as at the nearest solution, and
        # farther off by as much more as the difference changes where it is solved.
        unsolved = np.isnan(self.signals[0]).all(axis=0).reshape(status.shape)
        distance, place = distance_transform_edt(unsolved, return_indices=True)
        films = self.signals[:, looked_at(self.signals.shape[1])].reshape(2, -1, *status.shape)
        difference = films[1] - films[0]
        steps = [np.diff(difference, axis=axis) ** 2 for axis in (1, 2)]
        growth = sum(np.nansum(step) / max(np.isfinite(step).sum(), 1) for step in steps)
        square = (difference**2).mean(axis=0)[place[0], place[1]] + growth * distance**2
        share = (weights * self.emissivity)[1:].sum(0).reshape(status.shape)
        square = np.nan_to_num(unsolved * share**2 * square)
        factor = self.factor(threads).reshape(status.shape)

        def widen(rows: slice) -> None:
            squares = [np.tensordot(basis, component[:, rows], 1) ** 2 for component in slopes]
            std[:, rows] = np.sqrt(factor[rows] * std[:, rows] ** 2 + sum(squares, square[rows]))
            release()

        list(threads.map(np.errstate(invalid="ignore")(widen), self.inputs.blocks))
        unsettled = self.unsettled.reshape(status.shape) & (status == 0)
        grown = np.isnan(factor)  # without a solution, whatever stands there
        status[unsettled | grown] |= np.uint32(Status.NOT_CONVERGED)
        for name in result.data_vars:
            if str(name).startswith(("object", "background", "emissivity")):
                result[name].values[..., grown] = np.nan
            release()


def solve(
    inputs: Inputs,
    result: xr.Dataset,
    threads: Executor,
    frames: Frames,
    *,
    maps: Planes | None = None,
    material: Material | None = None,
    before: Joint | None = None,
    blur: float = 0.0,
) -> Joint | None:
    """Solve the object of all pixels at both cameras' places; None if it hardly differs there."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        maps = maps if frames.smooth else None
        raw, variance, solved = _solvable(inputs, result, maps, material)
        equations = system.equations(inputs, system.inside(raw), solved)
        pooled = material is not None and np.isfinite(material.emissivity).any()
        sampled = frames.nodes if pooled and frames.smooth else looked_at(result.sizes["time"])
        places = equations.solved
        change = system.change(inputs, equations.ways[system.LOOSE], result, threads)
        shares = system.coefficients(inputs, raw, solved)[:, places]
        # Of a smooth object the combination without background is that of the maps, at a material's
        # ratios; else that of the result, which takes x(p) for x(r) or holds `before`.
        if maps is not None:
            target, size = _by_maps(inputs, maps, raw, material, result, places)
        else:
            target, size = _by_film(inputs, result, raw, equations, shares, before)
        objects_at = partial(_objects_at, target, change, threads)
        # The object at both places at a few frames: does its gradient matter?
        start = None
        if sampled is frames.nodes and before is not None and before.frames.smooth:
            start = before.signals[0][:, places]
        films, step = objects_at(sampled, equations, start)
        if not _most(np.abs(shares[1:].sum(axis=0) * (films[1] - films[0])) / size) > _MATTERS:
            return None
        # The emissivities, unless a material states them.
        emissivity = system.inside(raw)
        of_slope: Floats = np.zeros(solved.size)
        of_ratio: Floats = np.zeros(solved.size)
        if material is not None and pooled:
            unknown = np.isnan(material.emissivity)
            of_slope = np.where(unknown, np.nan_to_num(variance), material.noise_variance)
            of_ratio = system.of_ratio(inputs, material)
        elif not inputs.method.knows_emissivity:
            band = [values[:, places] for values in system.samples(inputs, sampled)]
            solve_at = partial(objects_at, sampled)
            equations, emissivity, of_slope = _emissivities(
                inputs, result, raw, equations, solve_at, films, band, threads
            )
            films, _ = objects_at(sampled, equations, films[0])
        off = equations.spread(np.mean((films[1] - films[0]) ** 2, axis=0))
        if sampled is not frames.nodes:
            films, step = objects_at(frames.nodes, equations)
        signals, unsettled = _spread(films, step, equations)
        # An error of c_1 = w_1 e_1 is one of all c: dq = (de_1 w_1 + e_1 dw_1) [u(x(r)) - u(x(p))].
        off *= system.weights(inputs, emissivity)[0] ** 2 * of_slope + emissivity[0] ** 2 * of_ratio
        sizes = equations.spread(size), np.where(solved, np.sqrt(np.nan_to_num(off)), 0.0)
    errors = partial(_factor, inputs, equations, np.array(sizes), change.variance, blur)
    return Joint(inputs, frames, signals, emissivity, errors, unsettled)


def _solvable(
    inputs: Inputs, result: xr.Dataset, maps: Planes | None, material: Material | None
) -> tuple[Floats, Floats, Mask]:
    """Emissivities (band, pixel) [1] of pixels or as around, the first's variance, and where."""
    film = result["object_temperature"].values.reshape(result.sizes["time"], -1)
    measured = np.isfinite(result["emissivity"].values[inputs.bands[0]].ravel())
    leaning, variance = neighbours.emissivities(inputs, result)
    raw = np.where(measured, system.first_emissivity(inputs, result), leaning)
    solved = system.measured(film)
    if maps is not None and material is not None:
        raw, sharp = system.of_material(inputs, raw, material)
        solved |= sharp & maps.usable.ravel()
    return raw, variance, solved & np.all(np.isfinite(raw), axis=0)


def _spread(films: Floats, step: Floats, equations: system.Equations) -> tuple[Floats, Mask]:
    """Signals (2, node, pixel) [K] of solved pixels, and the pixels that go on moving."""
    signals = np.full((*films.shape[:2], equations.first.size), np.nan, np.float32)
    signals[..., equations.solved] = np.where(np.abs(films) > USELESS, np.nan, films)
    return signals, equations.spread(step > 10.0 * system.CONVERGED)


Target: TypeAlias = Callable[[Whole], tuple[Floats, Floats]]
"""Combination without background, and a start (solved, frame) [K], at some frames."""


def _objects_at(
    target: Target,
    change: system.Change,
    threads: Executor,
    frames: Whole,
    equations: system.Equations,
    start: Floats | None = None,
) -> tuple[Floats, Floats]:
    """Object at both places (2, frame, solved) [K] and its last step, of some frames."""
    packed, films = equations.packed, np.empty((2, frames.size, equations.solved.size), np.float32)

    @np.errstate(invalid="ignore", divide="ignore", over="ignore")  # of the thread
    def solve_some(span: slice) -> Floats:
        combination, guess = target(frames[span])
        if start is not None:
            guess = np.where(np.isfinite(start[span].T), start[span].T, guess)
        at_r, at_p, step = packed.solve(combination, guess, change.at(frames[span]))
        films[0, span], films[1, span] = at_r.T, at_p.T
        return step

    spans = [slice(first, first + _FRAMES) for first in range(0, frames.size, _FRAMES)]
    return films, np.fmax.reduce([*threads.map(solve_some, spans)])


def _by_maps(
    inputs: Inputs,
    maps: Planes,
    raw: Floats,
    material: Material | None,
    result: xr.Dataset,
    places: Whole,
) -> tuple[Target, Floats]:
    """Combination without background from the maps, and its deviation (solved) [K]."""
    noise = inputs.noise[inputs.bands]
    ratio = system.ratio_of(raw)[:, places].astype(np.float64)
    weights = null_combination(ratio, noise)[0]
    combined, variance = maps.combined(weights, places)
    # Ratios of single pixels add their deviation to that of the noise.
    if material is not None:
        std = result["reflection_ratio_std"].values[inputs.bands].reshape(len(noise), -1)[:, places]
        size = np.sqrt(noise[:, np.newaxis] ** 2 + (ratio * noise[0]) ** 2)  # eq. 4
        pooled = np.sqrt(material.inverse_energy[places]) * size
        std = np.where(np.isnan(pooled), std, pooled)
        off = ratio + np.where(np.isnan(material.emissivity[places]), np.nan_to_num(std), 0.0)
        off[0] = 1.0
        change, _ = maps.combined(null_combination(off, noise)[0] - weights, places)
        # The mean square over time of a sum of functions, by their products.
        products = maps.object_part.T @ maps.object_part / len(maps.object_part)
        variance = variance + (change * (products @ change)).sum(axis=0)

    def target(at: Whole) -> tuple[Floats, Floats]:
        q = np.ascontiguousarray((maps.object_part[at] @ combined).T, np.float32)
        return q, q

    return target, np.sqrt(variance)


def _by_film(
    inputs: Inputs,
    result: xr.Dataset,
    raw: Floats,
    equations: system.Equations,
    shares: Floats,
    before: Joint | None,
) -> tuple[Target, Floats]:
    """Combination that an object of a result has by its shares, and its deviation (solved) [K]."""
    frames, places = result.sizes["time"], equations.solved
    film, stds = (result[name].values.reshape(frames, -1) for name in _OBJECT)
    stds = stds[looked_at(frames)][:, places]
    # In units of the deviation or, of a method without deviations, of the noise.
    stds = np.where(np.isfinite(stds), stds, inputs.noise.min())
    film = smooth.bridge(copied(film), np.isin(np.arange(film.shape[1]), places))
    weights, curve = system.weights(inputs, raw)[1:, places], inputs.curves[inputs.bands[0]]

    def target(at: Whole) -> tuple[Floats, Floats]:
        signal = np.asarray(curve.signal(film[at][:, places]) - curve.reference)
        signal = np.ascontiguousarray(signal.T, dtype=np.float32)
        second = np.empty(signal.shape)
        system.other_bands(np.ascontiguousarray(shares[1:]), equations.bends, signal, second)
        q = shares[0][:, np.newaxis] * signal
        q += second
        if before is not None:  # part of q that the inputs of the result were without
            q += np.einsum("bp,btp->pt", weights, before.difference(places, at))
        return q, signal

    return target, np.sqrt(np.mean(stds**2, axis=0))


def _emissivities(
    inputs: Inputs,
    result: xr.Dataset,
    raw: Floats,
    equations: system.Equations,
    solve_at: Callable[[system.Equations, Floats], tuple[Floats, Floats]],
    films: Floats,
    band: list[Floats],
    threads: Executor,
) -> tuple[system.Equations, Floats, Floats]:
    """Equations and emissivities of the object at its own place, and the variance of e_1."""
    emissivity, noise = system.inside(raw), inputs.noise[inputs.bands[0]]
    measured = np.isfinite(result["emissivity"].values[inputs.bands[0]].ravel())
    solved, step = equations.spread(np.ones(films.shape[2], dtype=bool)), np.zeros(len(raw[0]))
    spans = [slice(first, first + _PIXELS) for first in range(0, films.shape[2], _PIXELS)]
    for _ in range(_ROUNDS):
        emit = partial(_emission, films, band, emissivity[0, solved], noise)
        estimates = map(np.concatenate, zip(*threads.map(emit, spans), strict=True))
        slope, variance, sound = (equations.spread(values) for values in estimates)
        likely = 1.0 - system.ratio_of(raw) * (1.0 - slope)
        sound &= measured & np.all((likely > 0.0) & (likely < 1.0), axis=0)
        slope, sound = np.where(sound, slope, emissivity[0]), sound & (variance > 0)
        slope, variance = neighbours.shared(slope, variance, sound, result["status"].shape)
        last, step = step, slope - emissivity[0]
        step[step * last < 0] *= 0.5  # it swings to and fro
        slope = emissivity[0] + step
        before, emissivity = emissivity, system.inside(1.0 - system.ratio_of(raw) * (1.0 - slope))
        equations = replace(
            equations,
            first=np.where(solved, emissivity[0], 1.0),
            shares=system.coefficients(inputs, emissivity, solved),
        )
        if _most(np.abs(emissivity - before)[0, solved]) < _SETTLED:
            break
        films, _ = solve_at(equations, films[0])
    return equations, emissivity, variance


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def _emission(
    films: Floats, band: list[Floats], emissivity: Floats, noise: float, span: slice
) -> tuple[Floats, Floats, Mask]:
    """Emissivity of the first band as its slope over the object, its variance, and its validity."""
    # Object at both places (2, frame, solved) [K]; band: signal, steps of the camera in it [K].
    signal, at_p = films[..., span].astype(np.float64)
    slope, variance, energy, kernel = regression.lines(signal, band[0][:, span], noise)
    # A gradient as steep as the object's own change turns the step round: divide by it.
    centred = signal - signal.mean(axis=0)
    steep = (centred * at_p).sum(axis=0) / (centred**2).sum(axis=0)
    steep = np.where(np.isfinite(steep) & (steep > 1.0), steep, 1.0)
    # Its variance: of the noise, and what the steps of the camera are as a slope.
    variance = (variance + (kernel * band[1][:, span]).sum(axis=0) ** 2) / steep**2
    sound = energy > _LEAST_CHANGE**2 * len(signal)
    return emissivity[span] + (slope - emissivity[span]) / steep, variance, sound


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def _factor(
    inputs: Inputs,
    equations: system.Equations,
    std: Floats,
    variance: Floats,
    blur: float,
    threads: Executor,
) -> Floats:
    """Variance of the object over that of a pixel alone (pixel) [1], by draws; NaN if unsettled."""
    displacement = inputs.displacement
    assert displacement is not None
    rng = np.random.default_rng(inputs.seed)
    # Deviations of a pixel alone, and of its target through the emissivity (pixel) [K].
    size, off = std[..., np.newaxis]
    # Errors of single pixels, of the drawn noise scaled to their deviations.
    drawn = displacement.resample @ rng.standard_normal((size.size, _DRAWS))
    if blur > 0.0:  # ratios of blurred bands have errors that neighbours share
        image = drawn.reshape(*displacement.shape, _DRAWS)
        gaussian_filter(image, blur, axes=(0, 1), output=image)
    gain = np.sqrt(np.einsum("pd,pd->p", drawn, drawn) / _DRAWS)[:, np.newaxis]
    drawn *= np.divide(size, gain, out=np.zeros_like(gain), where=gain > 0)
    errors = drawn.astype(np.float32)
    del drawn
    # Those of a material are common to its pixels.
    labels = np.arange(len(size)) if inputs.labels is None else inputs.labels
    target = rng.standard_normal((len(size), _DRAWS), dtype=np.float32)[labels]
    target *= off
    target += errors
    change = np.sqrt(variance)[:, np.newaxis] * rng.standard_normal((variance.size, _DRAWS))
    # Propagated by the equations without their bend, a few draws at a time.
    linear = replace(equations, bends=np.zeros_like(equations.bends)).packed
    places = equations.solved

    def power_of(span: slice) -> Floats:
        signal, _, _ = linear.solve(target[places, span], errors[places, span], change[:, span])
        return np.asarray(np.square(signal, dtype=np.float64).sum(axis=1) / _DRAWS)

    spans = [slice(start, start + _FRAMES) for start in range(0, _DRAWS, _FRAMES)]
    sized, power = size[:, 0] > 0, equations.spread(np.sum([*threads.map(power_of, spans)], axis=0))
    settled = power < _GROWN * size[:, 0] ** 2  # elsewhere the iteration grows
    # Over a few pixels: neighbours have nearly the same, and the draws are few.
    powers = np.where(settled, [power, size[:, 0] ** 2], 0.0).reshape(2, *displacement.shape)
    sums, pixels = convolve(powers, np.ones((1, 3, 3))).reshape(2, -1), powers.reshape(2, -1)
    factor, sharp = (energy / np.where(settled, total, np.nan) for energy, total in (sums, pixels))
    # Not beside a pixel that is far less certain, whose error has a share in this.
    factor = np.where(sharp > (1.0 + 3.0 * np.sqrt(2.0 / _DRAWS)) * factor, sharp, factor)
    return np.where(sized, factor, 1.0)
