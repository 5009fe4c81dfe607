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
from typing import Final

import numpy as np
import xarray as xr
from scipy.ndimage import convolve, distance_transform_edt, gaussian_filter, gaussian_filter1d

from dbthermal import _smooth as smooth
from dbthermal._arrays import Array, copied, empty, release
from dbthermal.response import Curve
from dbthermal.schema import Status
from dbthermal.separation._apart import equations as system
from dbthermal.separation._apart import neighbours
from dbthermal.separation._apart.equations import Floats, Mask, Whole
from dbthermal.separation._inputs import Inputs
from dbthermal.separation._subspace import residuals
from dbthermal.separation._subspace.reflection_ratio import HIGHEST_ORDER
from dbthermal.separation._tiles import Material

# Rounds of the emissivities and the object, and the change that ends them [1].
_ROUNDS: Final = 20
_SETTLED: Final = 1e-3
# Change of the object [K] below which its emissivity is not told.
_LEAST_CHANGE: Final = 0.1
# Frames that are solved together.
_FRAMES: Final = 8
# Frames from which it is told whether the object's gradient matters, and the share of the object's
# deviation from which it does, in more than a few of the samples.
_LOOKED_AT: Final = 32
_MATTERS: Final = 0.2
_MOST: Final = 0.99
# Frames for each polynomial that tell a smooth film, pixels that are written at once, and the share
# of a deviation below which it is no matter that a film is not smooth.
_NODES: Final = 2
_AT_ONCE: Final = 2048
_NO_MATTER: Final = 0.1
# Draws of noise by which the deviations are propagated, and the variance over that of a pixel alone
# from which the iteration is taken to grow.
_DRAWS: Final = 64
_GROWN: Final = 1e3


@dataclass(frozen=True)
class Joint:
    """Object of all pixels, of which each camera sees another place; its films are in a result."""

    inputs: Inputs
    result: xr.Dataset  # its object temperature is x(r), its background temperature x(p)
    emissivity: Floats  # of which it is made (band, pixel) [1]
    factor: Floats  # variance of the object over that of a pixel alone (pixel) [1]
    unsettled: Mask  # the iteration did not come to an end (pixel)

    def difference(
        self, rows: slice, some: slice | Whole, frames: slice | Whole = slice(None)
    ) -> Floats:
        """Signals (band - 1, time, pixel) [K] of x(p) over x(r), of some pixels; 0 unknown."""
        here, beside = (
            self.result[f"{one}_temperature"].values[frames, rows]
            for one in ("object", "background")
        )
        here, beside = (
            one.reshape(len(one), -1)[:, some].astype(np.float64) for one in (here, beside)
        )
        pixels = slice(rows.start * self.result.sizes["x"], rows.stop * self.result.sizes["x"])
        parts = []
        for one, place in zip(self.emissivity[1:], self.inputs.bands[1:], strict=True):
            curve = self.inputs.curves[place]
            parts.append(one[pixels][some] * (curve.signal(beside) - curve.signal(here)))
        return np.asarray(np.nan_to_num(parts, nan=0.0))

    def kept(self) -> "Joint":
        """Return it with films of its own: those of the result may be written anew."""
        own = {
            name: (("time", "y", "x"), copied(self.result[name].values))
            for name in ("object_temperature", "background_temperature")
        }
        return replace(self, result=xr.Dataset(own))

    def finish(self) -> None:
        """Give the object its deviation, in place, when all is solved; flag what is unsettled."""
        displacement, status = self.inputs.displacement, self.result["status"].values
        assert displacement is not None
        time, std = self.inputs.capture["time"].values, self.result["object_temperature_std"].values
        background = self.result["background_temperature"].values
        basis = smooth.subspace(time, min(HIGHEST_ORDER, time.size // 4)).functions
        every = []
        for part in self.inputs.blocks:
            film = background[:, part].reshape(time.size, -1).astype(np.float64)
            every.append(basis.T @ system.bridge(film, np.ones(film.shape[1], dtype=bool)))
            release()
        curves = np.concatenate(every, axis=1).reshape(-1, *status.shape)
        # Beside a pixel without a background it is taken to go on.
        lost = np.isnan(curves[0])
        near = distance_transform_edt(lost, return_distances=False, return_indices=True)
        curves = np.nan_to_num(curves[:, near[0], near[1]])
        # A reflection resampled off by dd: dq = sum_m w_m (1 - e_m) grad(y) . dd, smoothed in time.
        weight = (
            (1.0 - self.emissivity[1:]) * system.weights(self.inputs, self.emissivity)[1:]
        ).sum(0)
        off = np.nan_to_num(weight * displacement.std).reshape(2, *status.shape)
        slopes = [
            gaussian_filter1d(curves, 1.0, axis=axis, order=1) * one
            for axis, one in zip((1, 2), off, strict=True)
        ]
        factor = self.factor.reshape(status.shape)
        for part in self.inputs.blocks:
            squares = [np.tensordot(basis, one[:, part], 1) ** 2 for one in slopes]
            std[:, part] = np.sqrt(factor[part] * std[:, part] ** 2 + sum(squares))
            release()
        unsettled = self.unsettled.reshape(status.shape) & (status == 0)
        grown = np.isnan(factor)  # without a solution, whatever stands there
        status[unsettled | grown] |= np.uint32(Status.NOT_CONVERGED)
        for name in self.result.data_vars:
            if str(name).startswith(("object", "background", "emissivity")):
                self.result[name].values[..., grown] = np.nan
            release()


def solve(
    inputs: Inputs,
    result: xr.Dataset,
    threads: Executor,
    *,
    material: Material | None = None,
    before: Joint | None = None,
    blur: float = 0.0,
) -> Joint | None:
    """
    Solve the equations of all pixels, from a result that takes x(p) for x(r).

    Or from one of inputs with the difference of a solution `before`, and with emissivities that are
    pooled by `material`. Writes x(r) as the object temperature and x(p) as the background
    temperature of the result. None, and nothing is written, where the object hardly differs between
    the two places.
    """
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        film, there, stds = (
            result[name].values.reshape(result.sizes["time"], -1)
            for name in ("object_temperature", "background_temperature", "object_temperature_std")
        )
        raw = system.first_emissivity(inputs, result)
        solved = np.all(np.isfinite(raw), axis=0) & system.told(film)[0]
        equations = system.equations(inputs, system.inside(raw), solved)
        some = np.unique(np.linspace(0, len(film) - 1, _LOOKED_AT).astype(np.intp))
        first, steps, change, variance = system.first_band(inputs, equations.loose, some)
        curve = inputs.curves[inputs.bands[0]]
        weights, every = system.weights(inputs, raw)[1:], slice(0, result.sizes["y"])

        def moved(frames: slice | Whole) -> Floats:
            """Part (solved, frame) [K] of q that the inputs of the result were without."""
            apart = 0.0 if before is None else before.difference(every, places, frames).T
            return np.asarray(np.sum(weights.T[places, np.newaxis] * apart, axis=2))

        shares, places = system.coefficients(inputs, raw, solved), equations.solved
        both = partial(_both, curve, shares[:, places])
        few = system.bridge(film[some], solved)[:, places], moved(some), change(some)

        def looked_at(equations: system.Equations) -> tuple[Floats, Floats]:
            """Object's signals (solved, some frame) [K] at both places."""
            return both(*few, equations)[:2]

        here, beside = looked_at(equations)
        # In units of the deviation or, of a method without one, of the noise.
        std = np.where(np.isfinite(stds[some]), stds[some], inputs.noise.min())
        share = np.abs(shares[1:, places].sum(axis=0) * (beside - here).T) / std[:, places]
        if not np.any(solved) or np.nanquantile(share, _MOST) <= _MATTERS:
            return None
        emissivity, (of_slope, of_ratio) = system.inside(raw), np.zeros((2, solved.size))
        if material is not None:
            of_slope = np.nan_to_num(material.noise_variance)
            of_ratio = system.of_ratio(inputs, material)
        elif not inputs.method.knows_emissivity:
            band = first[:, places], steps[:, places]
            equations, emissivity, of_slope = _emissivities(
                inputs, result, raw, solved, equations, looked_at, band
            )
            here, beside = looked_at(equations)
        system.bridge(film, solved)
        unsettled = np.zeros(solved.size, dtype=bool)
        nodes, spread = _nodes(film, result["time"].values, std, places, some)
        parts = [nodes[part] for part in _parts(nodes)]
        results = threads.map(
            lambda part: both(film[part][:, places], moved(part), change(part), equations), parts
        )
        signals = np.empty((2, nodes.size, places.size), np.float32)
        for part, (*pair, step) in zip(_parts(nodes), results, strict=True):
            signals[:, part] = np.swapaxes(pair, 1, 2)
            unsettled[places] |= step > 10.0 * system.CONVERGED
        for whole, signal in zip((film, there), signals, strict=True):
            _write(whole, places, curve, signal, spread)
        release()
        # An error of c_1 = w_1 e_1 is one of all c: dq = (de_1 w_1 + e_1 dw_1) [u(x(r)) - u(x(p))].
        weight = system.weights(inputs, emissivity)[0]
        off = weight**2 * of_slope + emissivity[0] ** 2 * of_ratio
        off *= equations.spread(np.mean((beside - here) ** 2, axis=1))
        size = np.where(solved, np.sqrt(np.nan_to_num([np.mean(std**2, axis=0), off])), 0.0)
        factor = _factor(inputs, equations, size, variance, blur)
    return Joint(inputs, result, emissivity, factor, unsettled | np.isnan(factor))


def from_result(inputs: Inputs, result: xr.Dataset) -> Joint:
    """Object of both places of a result that is solved already."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        film = copied(result["object_temperature"].values).reshape(result.sizes["time"], -1)
        emissivity = system.inside(system.first_emissivity(inputs, result))
        solved = np.all(np.isfinite(emissivity), axis=0) & system.told(film)[0]
        equations = system.equations(inputs, emissivity, solved)
        change = system.first_band(inputs, equations.loose, np.zeros(1, dtype=np.intp))[2]
        curve, there = inputs.curves[inputs.bands[0]], empty(film.shape, film.dtype)
        places = equations.solved
        system.bridge(film, solved)
        for part in _parts(film):
            signal = curve.signal(film[part, places]).T - curve.reference
            beside = equations.packed.beside(signal, change(part))
            there[part] = np.nan
            there[part, places] = curve.temperature(beside.T + curve.reference)
            release()
    shape, unsettled = result["object_temperature"].shape, np.zeros(solved.size, dtype=bool)
    films = {
        name: (("time", "y", "x"), part.reshape(shape))
        for name, part in (("object_temperature", film), ("background_temperature", there))
    }
    return Joint(inputs, xr.Dataset(films), emissivity, np.ones(solved.size), unsettled)


def _parts(film: Floats | Whole) -> list[slice]:
    """Frames of a film that are solved together."""
    return [slice(at, at + _FRAMES) for at in range(0, len(film), _FRAMES)]


def _nodes(
    film: Floats, time: Array, std: Floats, places: Whole, some: Whole
) -> tuple[Whole, Floats | None]:
    """Frames (node) that tell a smooth film, and weights (frame, node) of these; else all, None.

    Polynomials through the nodes, which lie close together near the ends as Chebyshev's do, repeat
    a film that is one of them. Where they are off by more than a share of the deviation (some
    frame, pixel), in more than a few of the samples, the object changes rapidly.
    """
    order = min(HIGHEST_ORDER, time.size // 4)
    ends = np.cos(np.pi * (np.arange(_NODES * order) + 0.5) / (_NODES * order))
    place = time[0] + 0.5 * (1.0 - ends) * (time[-1] - time[0])
    nodes = np.unique(np.abs(time - place[:, np.newaxis]).argmin(axis=1))
    functions = smooth.subspace(time, order).functions
    weights = np.asarray(functions @ np.linalg.pinv(functions[nodes]), np.float32)
    few, apart = weights[some] @ film[nodes][:, places], 0.0
    apart = np.abs(few - film[some][:, places]) / std[:, places]
    if nodes.size == time.size or not np.nanquantile(apart, _MOST) < _NO_MATTER:
        return np.arange(time.size), None
    return nodes, weights


def _write(
    film: Floats, places: Whole, curve: Curve, signal: Floats, weights: Floats | None
) -> None:
    """Write a film of temperatures, of signals (node, solved pixel) and their weights, in place."""
    for start in range(0, places.size, _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        kelvin = curve.temperature(signal[:, part] + curve.reference).astype(np.float32)
        film[:, places[part]] = kelvin if weights is None else weights @ kelvin
    film[:, ~np.isin(np.arange(film.shape[1]), places)] = np.nan


def _both(
    curve: Curve,
    shares: Floats,
    alone: Floats,
    moved: Floats,
    change: Floats,
    equations: system.Equations,
) -> tuple[Floats, Floats, Floats]:
    """Object at both places and the last step [K], of a film (frame, pixel) by its shares."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):  # of the thread it runs in
        signal = curve.signal(alone) - curve.reference
        signal = np.ascontiguousarray(signal.T, dtype=np.float32)
        packed = equations.packed
        target = shares[0][:, np.newaxis] * signal + packed.other_bands(shares[1:], signal)
        target += moved
        return packed.solve(target, signal, change)


def _emissivities(
    inputs: Inputs,
    result: xr.Dataset,
    raw: Floats,
    solved: Mask,
    equations: system.Equations,
    looked_at: Callable[[system.Equations], tuple[Floats, Floats]],
    band: tuple[Array, Array],
) -> tuple[system.Equations, Floats, Floats]:
    """Equations of the emissivities of the object at its own place, these, and e_1's variance."""
    emissivity, noise = system.inside(raw), inputs.noise[inputs.bands[0]]
    told = np.isfinite(result["emissivity"].values[inputs.bands[0]].ravel())
    step = np.zeros(solved.size)
    for _ in range(_ROUNDS):
        found = _emission(looked_at(equations), band, emissivity[0, solved], noise)
        slope, variance, known = (equations.spread(one) for one in found)
        likely = 1.0 - system.ratio_of(raw) * (1.0 - slope)
        known &= told & np.all((likely > 0.0) & (likely < 1.0), axis=0)
        slope, known = np.where(known, slope, emissivity[0]), known & (variance > 0)
        slope, variance = neighbours.shared(slope, variance, known, result["status"].shape)
        last, step = step, slope - emissivity[0]
        step[step * last < 0] *= 0.5  # it swings to and fro
        slope = emissivity[0] + step
        before, emissivity = emissivity, system.inside(1.0 - system.ratio_of(raw) * (1.0 - slope))
        equations = replace(
            equations,
            first=np.where(solved, emissivity[0], 1.0),
            shares=system.coefficients(inputs, emissivity, solved),
        )
        change = np.abs(emissivity - before)[0, solved]
        if np.nanquantile(change, _MOST) < _SETTLED:
            break
    return equations, emissivity, variance


def _emission(
    places: tuple[Floats, Floats], band: tuple[Array, Array], emissivity: Floats, noise: float
) -> tuple[Floats, Floats, Mask]:
    """
    Emissivity of the first band as its slope over the object, its variance, and where it is told.

    Of the object's signals at both places (solved, frame), and those of the band and the steps of
    the camera in it (frame, solved).
    """
    own = places[0].T.astype(np.float64)
    line = residuals.regress(own, band[0], noise)
    # A gradient as steep as the object's own change turns the step round: divide by it.
    steep = np.maximum(_slope(*places), 1.0)
    # Its variance: of the noise, and what the steps of the camera are as a slope.
    by_steps = (line.kernel(own) * band[1]).sum(axis=0)
    variance = (line.variance + by_steps**2) / steep**2
    known = line.energy > _LEAST_CHANGE**2 * len(own)
    return emissivity + (line.slope - emissivity) / steep, variance, known


def _slope(abscissa: Floats, ordinate: Floats) -> Floats:
    """Slope (pixel) of signals (pixel, frame) over others."""
    abscissa = abscissa - abscissa.mean(axis=1, keepdims=True)
    slope = (abscissa * ordinate).sum(axis=1) / (abscissa**2).sum(axis=1)
    return np.where(np.isfinite(slope), slope, 1.0)


def _factor(
    inputs: Inputs, equations: system.Equations, std: Floats, variance: Floats, blur: float
) -> Floats:
    """
    Variance (pixel) [1] of the object over that of a pixel alone, by draws; NaN where unsettled.

    The `std` (2, pixel) [K] is that of a pixel alone, and of its target through the emissivity; the
    `variance` (loose) [K^2] that of the change.
    """
    displacement = inputs.displacement
    assert displacement is not None
    rng = np.random.default_rng(inputs.seed)
    size, off = std[..., np.newaxis]
    drawn = displacement.resample @ rng.standard_normal((size.size, _DRAWS))
    # Ratios of blurred bands have errors that neighbours share.
    image = drawn.reshape(*displacement.shape, _DRAWS)
    drawn = gaussian_filter(image, blur, axes=(0, 1)).reshape(drawn.shape)
    gain = np.sqrt((drawn**2).mean(axis=1, keepdims=True))
    alone = np.where(gain > 0, size * drawn / gain, 0.0).astype(np.float32)
    # Those of a material are common to its pixels.
    labels = np.arange(len(size)) if inputs.labels is None else inputs.labels
    common = rng.standard_normal((len(size), _DRAWS), dtype=np.float32)[labels]
    target = alone + off * common
    change = np.sqrt(variance)[:, np.newaxis] * rng.standard_normal((variance.size, _DRAWS))
    linear = replace(equations, bends=np.zeros_like(equations.bends))
    places = linear.solved
    signal, _, _ = linear.packed.solve(target[places], alone[places], change)
    own, power = size[:, 0] > 0, linear.spread((signal.astype(np.float64) ** 2).mean(axis=1))
    settled = power < _GROWN * size[:, 0] ** 2  # elsewhere the iteration grows
    # Over a few pixels: neighbours have nearly the same, and the draws are few.
    energy, total = (
        convolve(np.where(settled, one, 0.0).reshape(displacement.shape), np.ones((3, 3))).ravel()
        for one in (power, size[:, 0] ** 2)
    )
    factor = np.divide(energy, total, out=np.full_like(energy, np.nan), where=settled)
    return np.where(own, factor, 1.0)
