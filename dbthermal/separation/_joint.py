r"""The object of two cameras that stand side by side, where each sees another place of it.

Paired by what is reflected (`_displaced`), the bands hold the object of two places, r of the
reference band and p of the second camera. The combination without background (eq. 5 and 6 of
`_subspace.method`) is

.. math:: c_1 u_1(x(r)) + \sum_{m > 1} c_m u_m(x(p)) = q(r), \quad c_m = w_m e_m, \quad \sum c_m = 1

A method solves it as if x(p) were x(r), which gives q. Then the equations of all pixels are solved
together, frame by frame, each for the term of the larger coefficient:

.. math:: u_1(x(r)) \leftarrow \Big[q(r) - \sum_{m > 1} c_m u_m(x(p))\Big] / c_1

contracts by :math:`g = |\sum_{m > 1} c_m / c_1|` a step, for two bands
:math:`(e_2 / e_1) / \kappa`; where that is above 1 the equation solved for x(p) contracts by 1/g.
Both fail for a gray body alone. Errors of single pixels are averaged along the chain of places,
with the weights :math:`(1 - g) g^j`.
"""

from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from numpy.polynomial import Polynomial
from scipy.ndimage import convolve, gaussian_filter, gaussian_filter1d
from scipy.sparse import csr_array, diags_array

from dbthermal import _smooth as smooth
from dbthermal import schema
from dbthermal.response import Curve
from dbthermal.schema import Status
from dbthermal.separation import _quality as quality
from dbthermal.separation._displaced import without
from dbthermal.separation._inputs import Inputs
from dbthermal.separation._subspace import residuals
from dbthermal.separation._subspace.reflection_ratio import null_combination

Array = npt.NDArray[np.floating[Any]]
Mask = npt.NDArray[np.bool_]
Whole = npt.NDArray[np.intp]
Signal = npt.NDArray[np.float64]

# Steps of the iteration, and the change that ends it [K].
_STEPS: Final = 60
_CONVERGED: Final = 1e-3
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
# Draws of noise by which the deviations are propagated, and the variance over that of a pixel alone
# from which the iteration is taken to grow.
_DRAWS: Final = 64
_GROWN: Final = 1e3
# Deviation of the neighbourhood that tells an emissivity, over the image's smaller side.
_AROUND: Final = 0.125
# Share of an error that a step may leave.
_LARGEST: Final = 0.95
# Emissivities by which x(p) is told: no closer to the ends of what the ratios leave [1].
_MARGIN: Final = 0.02
# Rows of the capture that are read at once.
_ROWS: Final = 32
# Smooth functions of the change beside a pixel that is not solved.
_ORDER: Final = 14
# Degree of the polynomial that the bend between two responses is.
_DEGREE: Final = 4


@dataclass(frozen=True)
class Joint:
    """Object of all pixels, of which each camera sees another place; its films are in a result."""

    inputs: Inputs
    result: xr.Dataset  # its object temperature is x(r), its background temperature x(p)
    emissivity: Array  # of which it is made (band, pixel) [1]
    factor: Array  # variance of the object over that of a pixel alone (pixel) [1]
    unsettled: Mask  # the iteration did not come to an end (pixel)

    def difference(self, rows: slice) -> Array:
        """Signals (band - 1, time, pixel) [K] of x(p) over x(r), of rows; 0 where not known."""
        here, beside = (
            self.result[f"{one}_temperature"].values[:, rows].astype(np.float64)
            for one in ("object", "background")
        )
        here, beside = (one.reshape(len(one), -1) for one in (here, beside))
        pixels = slice(rows.start * self.result.sizes["x"], rows.stop * self.result.sizes["x"])
        parts = []
        for one, place in zip(self.emissivity[1:], self.inputs.bands[1:], strict=True):
            curve = self.inputs.curves[place]
            parts.append(one[pixels] * (curve.signal(beside) - curve.signal(here)))
        return np.asarray(np.nan_to_num(parts, nan=0.0))

    def finish(self) -> None:
        """Give the object its deviation, in place, when all is solved; flag what is unsettled."""
        displacement, status = self.inputs.displacement, self.result["status"].values
        assert displacement is not None
        # A reflection resampled off by dd: dq = sum_m w_m (1 - e_m) grad(y) . dd, in the mean.
        background = self.result["background_temperature"].values.mean(axis=0, dtype=np.float64)
        slopes = [gaussian_filter1d(background, 1.0, axis=axis, order=1) for axis in (0, 1)]
        weight = ((1.0 - self.emissivity[1:]) * _weights(self.inputs, self.emissivity)[1:]).sum(0)
        off = weight * np.reshape(slopes, (2, -1)) * displacement.std
        off = np.nan_to_num(np.sqrt((off**2).sum(axis=0)))
        std = self.result["object_temperature_std"].values
        std *= np.sqrt(self.factor).reshape(status.shape)
        np.hypot(std, off.reshape(status.shape).astype(std.dtype), out=std)
        unsettled = self.unsettled.reshape(status.shape) & (status == 0)
        status[unsettled] |= np.uint32(Status.NOT_CONVERGED)


@dataclass(frozen=True)
class _Equations:
    """Equations of all pixels, and by which way each is solved."""

    first: Array  # e_1 (pixel) [1]
    shares: Array  # c of eq. 6 (band, pixel) [1]
    there: csr_array  # weights of x(p) (pixel, pixel), of the linked pixels
    onward: csr_array  # weights of the equation at p + d(p) (backward pixel, pixel)
    forward: Whole  # pixels solved for x(r)
    backward: Whole  # pixels solved for x(p)
    loose: Whole  # solved pixels without such neighbours
    bends: list[Polynomial]  # u_m(x) - u_1(x) of u_1(x), for all bands but the first

    def _there(self, signal: Array, change: Array) -> Array:
        """Signal u_1(x(p)) (pixel, frame) [K]; of loose pixels by the change of e_1 u_1(x)."""
        result = np.asarray(self.there @ signal)
        result[self.loose] = signal[self.loose] + change / self.first[self.loose, np.newaxis]
        return result

    def other_bands(self, shares: Array, signal: Array) -> Array:
        """Sum of shares (band - 1, pixel) times u_m(x), of u_1(x) (pixel, frame) [K]."""
        parts = zip(shares, self.bends, strict=True)
        return np.asarray(sum(one[:, np.newaxis] * (signal + bend(signal)) for one, bend in parts))

    def solve(self, target: Array, alone: Array, change: Array) -> tuple[Array, Array, Array]:
        """
        Solve for u_1(x(r)) and u_1(x(p)) (pixel, frame) [K], of a target q and from a start.

        The `change` (loose, frame) [K] is e_1 [u_1(x(p)) - u_1(x(r))] where it is known
        beforehand. Also returns the last step (pixel) [K].
        """
        own, forward, backward = self.shares[0][:, np.newaxis], self.forward, self.backward
        others, back = self.shares[1:], self.shares[1:, self.backward]
        beyond = np.asarray((self.onward @ others.T).T)
        slope = beyond.sum(axis=0)[:, np.newaxis]
        rest = np.setdiff1d(self.loose, backward)
        signal, step = alone, np.zeros_like(alone)
        for _ in range(_STEPS):
            there = self._there(signal, change)
            right = target - self.other_bands(others, there)
            following = signal.copy()
            following[forward] = right[forward] / own[forward]
            # Newton's steps, of a slope near sum c = 1.
            following[rest] += right[rest] - own[rest] * signal[rest]
            # The same for x(p), of the equation at p + d(p).
            right = np.asarray(self.onward @ (target - own * signal))
            following[backward] += (right - self.other_bands(beyond, signal[backward])) / slope
            step, signal = np.abs(following - signal), following
            if step.max(initial=0.0) < _CONVERGED:
                break
        there = self._there(signal, change)
        # A backward pixel's own equation holds for another x(p) than that between its neighbours.
        right = target[backward] - own[backward] * signal[backward]
        right -= self.other_bands(back, there[backward])
        there[backward] += right / back.sum(axis=0)[:, np.newaxis]
        return signal, there, step.max(axis=1)


def solve(
    inputs: Inputs, result: xr.Dataset, threads: Executor, *, pooled: bool = False
) -> Joint | None:
    """
    Solve the equations of all pixels, from a result that takes x(p) for x(r).

    Writes x(r) as the object temperature and x(p) as the background temperature of the result.
    None, and nothing is written, where the object hardly differs between the two places.
    """
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        film, there, stds = (
            result[name].values.reshape(result.sizes["time"], -1)
            for name in ("object_temperature", "background_temperature", "object_temperature_std")
        )
        raw = _emissivity(inputs, result)
        solved = np.all(np.isfinite(raw), axis=0) & np.isfinite(np.fmax.reduce(film, axis=0))
        emissivity = _inside(raw)
        equations = _equations(inputs, emissivity, solved)
        some = np.unique(np.linspace(0, len(film) - 1, _LOOKED_AT).astype(np.intp))
        first, steps, change, variance = _first_band(inputs, equations.loose, some)
        curve = inputs.curves[inputs.bands[0]]
        shares = _coefficients(inputs, raw, solved)
        told = np.isfinite(result["emissivity"].values[inputs.bands[0]].ravel())

        @np.errstate(invalid="ignore", divide="ignore", over="ignore")  # of the thread it runs in
        def both(alone: Array, change: Array) -> tuple[Array, Array, Array]:
            signal = np.where(solved, curve.signal(alone) - curve.reference, 0.0)
            signal = np.ascontiguousarray(signal.T, dtype=np.float32)
            target = shares[0][:, np.newaxis] * signal + equations.other_bands(shares[1:], signal)
            return equations.solve(target, signal, change)

        looked_at = _bridge(film[some], solved)
        here, beside, _ = both(looked_at, change[:, some])
        # In units of the deviation or, of a method without one, of the noise.
        std = np.where(np.isfinite(stds[some]), stds[some], inputs.noise.min())
        share = np.abs(equations.shares[1:].sum(axis=0) * (beside - here).T) / std
        if not np.any(solved) or np.nanquantile(share[:, solved], _MOST) <= _MATTERS:
            return None
        of_slope = np.zeros(solved.size)
        for _ in range(0 if pooled or inputs.method.knows_emissivity else _ROUNDS):
            # A gradient as steep as the object's own change turns the step round: divide by it.
            own = here.T.astype(np.float64)
            line = residuals.regress(own, first, inputs.noise[inputs.bands[0]])
            steep = np.maximum(_slope(here, beside), 1.0)
            slope = emissivity[0] + (line.slope - emissivity[0]) / steep
            # Its variance: of the noise, and what the steps of the camera are as a slope.
            by_steps = (line.kernel(own) * steps).sum(axis=0)
            of_slope = (line.variance + by_steps**2) / steep**2
            known = line.energy > _LEAST_CHANGE**2 * len(some)
            likely = 1.0 - _ratio(raw) * (1.0 - slope)
            known &= told & np.all((likely > 0.0) & (likely < 1.0), axis=0)
            error = np.where(known & (line.variance > 0), of_slope, np.inf)
            slope = np.where(known, slope, emissivity[0])
            slope = _shared(slope, error, result["status"].shape)
            before, emissivity = emissivity, _inside(1.0 - _ratio(raw) * (1.0 - slope))
            equations = replace(
                equations,
                first=np.where(solved, emissivity[0], 1.0),
                shares=_coefficients(inputs, emissivity, solved),
            )
            here, beside, _ = both(looked_at, change[:, some])
            if np.nanquantile(np.abs(emissivity - before), _MOST) < _SETTLED:
                break
        _bridge(film, solved)
        unsettled = np.zeros(solved.size, dtype=bool)
        parts = [slice(at, at + _FRAMES) for at in range(0, len(film), _FRAMES)]
        results = threads.map(lambda part: both(film[part], change[:, part]), parts)
        for part, (*pair, step) in zip(parts, results, strict=True):
            film[part], there[part] = (
                np.where(solved, curve.temperature(one.T + curve.reference), np.nan) for one in pair
            )
            unsettled |= step > 10.0 * _CONVERGED
        # An error of e_1 is one of all c: dq = de_1 w_1 [u(x(r)) - u(x(p))].
        off = _weights(inputs, emissivity)[0] ** 2 * of_slope * np.mean((beside - here) ** 2, 1)
        size = np.where(solved, np.sqrt(np.nan_to_num([np.mean(std**2, axis=0), off])), 0.0)
        factor = _factor(inputs, equations, size, variance)
        unsettled |= np.isnan(factor)
    return Joint(inputs, result, emissivity, factor, unsettled)


def _emissivity(inputs: Inputs, result: xr.Dataset) -> Array:
    """Emissivities (band, pixel) [1] by which a pixel is solved, the quietest band first."""
    emissivity, ratio = (
        result[name].values[inputs.bands].reshape(len(inputs.bands), -1).astype(np.float64)
        for name in ("emissivity", "reflection_ratio")
    )
    ratio = np.where(np.isfinite(ratio), ratio, _ratio(emissivity))
    # That of a constant object is taken from the middle of what its ratios leave.
    middle = 1.0 - ratio * (0.5 / np.maximum(ratio.max(axis=0), 1.0))
    return np.where(np.isfinite(emissivity), emissivity, middle)


def _shared(slope: Array, variance: Array, shape: tuple[int, ...]) -> Array:
    """
    Slopes (pixel) [1] that lean on those around, the more the less they are known.

    The mean of their posterior, of a normal prior with the mean and variance of the neighbourhood.
    """

    def around(part: Array) -> Array:
        image = np.where(weight > 0, weight * part, 0.0).reshape(shape)
        filtered = gaussian_filter(image, _AROUND * min(shape), mode="constant")
        return np.asarray(filtered).ravel()

    weight = 1.0 / variance
    total = around(np.ones_like(weight))
    mean = np.where(total > 0, around(slope) / total, slope)
    own = weight * np.nan_to_num(around((slope - mean) ** 2) / total)
    return np.asarray((own * slope + mean) / (own + 1.0))


def _ratio(emissivity: Array) -> Array:
    """Reflection ratios (band, pixel) [1] of emissivities."""
    return np.asarray((1.0 - emissivity) / (1.0 - emissivity[0]))


def _inside(emissivity: Array) -> Array:
    """Emissivities of the same ratios, none of them outside or at the end of (0, 1)."""
    ratio = _ratio(emissivity)
    # e_m > 0 leaves 0 < 1 - e_1 < 1 / kappa.
    most = 1.0 / np.maximum(ratio.max(axis=0), 1.0)
    place = np.clip((1.0 - emissivity[0]) / most, _MARGIN, 1.0 - _MARGIN)
    return np.asarray(1.0 - ratio * most * place)


def _weights(inputs: Inputs, emissivity: Array) -> Array:
    """Weights w of eq. 5 (band, pixel) [1], of the bands without background."""
    noise = inputs.noise[inputs.bands]
    return null_combination(_ratio(emissivity).astype(np.float64), noise)[0]


def _coefficients(inputs: Inputs, emissivity: Array, solved: Mask) -> Array:
    """Coefficients c of eq. 6 (band, pixel) [1], of sum 1."""
    shares = np.where(solved, _weights(inputs, emissivity) * emissivity, 0.0)
    shares[0, ~solved] = 1.0
    return shares.astype(np.float32)


def _slope(abscissa: Array, ordinate: Array) -> Array:
    """Slope (pixel) of signals (pixel, frame) over others."""
    abscissa = abscissa - abscissa.mean(axis=1, keepdims=True)
    slope = (abscissa * ordinate).sum(axis=1) / (abscissa**2).sum(axis=1)
    return np.where(np.isfinite(slope), slope, 1.0)


def _bridge(film: Array, solved: Mask) -> Array:
    """Bridge the frames of solved pixels without a number, in place, by a line; return the film."""
    frames = np.arange(len(film))
    for pixel in np.flatnonzero(solved & ~np.isfinite(film.sum(axis=0))):
        known = np.isfinite(film[:, pixel])
        if known.any():
            film[~known, pixel] = np.interp(frames[~known], frames[known], film[known, pixel])
    return film


def _equations(inputs: Inputs, emissivity: Array, solved: Mask) -> _Equations:
    """Equations of the solved pixels: each for the place with the larger coefficient."""
    displacement = inputs.displacement
    assert displacement is not None
    shares = _coefficients(inputs, emissivity, solved)
    there, linked = _among(displacement.resample, solved, displacement.shape[1])
    onward, reached = _among(displacement.onward, solved, displacement.shape[1])
    own, others = np.abs(shares[0]), shares[1:].sum(axis=0)
    strong = np.abs(others) < own
    # The error of a step: only where it contracts, with the weights' signs, are places linked.
    forward, back = abs(there).sum(axis=1) * np.abs(others), abs(onward) @ own
    reached &= back < _LARGEST * np.abs(onward @ others)
    linked &= np.where(strong, forward < _LARGEST * own, reached)
    backward = np.flatnonzero(linked & ~strong)
    return _Equations(
        first=np.where(solved, emissivity[0], 1.0),
        shares=shares,
        there=csr_array(diags_array(linked.astype(np.float32)) @ there.astype(np.float32)),
        onward=csr_array(onward[backward].astype(np.float32)),
        forward=np.flatnonzero(linked & strong),
        backward=backward,
        loose=np.flatnonzero(solved & ~linked),
        bends=_bends([inputs.curves[band] for band in inputs.bands]),
    )


def _among(weights: csr_array, solved: Mask, width: int) -> tuple[csr_array, Mask]:
    """Weights of solved pixels alone, and the solved pixels for which that is possible."""
    weights = without(weights, ~solved, width)
    weights.eliminate_zeros()
    used = np.diff(weights.indptr) > 0
    return weights, solved & used & (abs(weights) @ ~solved <= 0.0)


def _first_band(inputs: Inputs, loose: Whole, frames: Whole) -> tuple[Signal, Signal, Array, Array]:
    """
    Signal (frame, pixel) [K] of the reference band at some frames, and how it changes to p.

    Beside it the steps of the camera in it, which are no change. The change from r to p (loose,
    time) [K] and its variance (loose): smoothed over time, it is that of e_1 u_1(x) and holds
    little of that of the reflection. Bad pixels have no part in it.
    """
    displacement, capture = inputs.displacement, inputs.capture
    assert displacement is not None
    (height, width), curve = displacement.shape, inputs.curves[displacement.reference]
    change, unknown = (
        np.zeros((loose.size, capture.sizes["time"])),
        np.zeros(loose.size, dtype=bool),
    )
    segment = capture["segment"].values if "segment" in capture else None
    order = min(_ORDER, change.shape[1] // 4)
    functions = smooth.subspace(capture["time"].values, order, segment=segment)
    basis, own = functions.functions, functions.object_part
    first, steps = np.empty((2, frames.size, height * width))
    for top in range(0, height, _ROWS):
        rows = slice(top, min(top + _ROWS, height))
        source, chosen = displacement.source(rows), (loose // width >= top)
        chosen &= loose // width < rows.stop
        counts = capture["counts"].isel(band=displacement.reference, y=source).values
        counts = np.where(schema.measured(counts), counts, np.nan).reshape(len(counts), -1)
        signal = curve.linearise(counts) - curve.reference
        inside = slice((top - source.start) * width, (rows.stop - source.start) * width)
        here = slice(top * width, rows.stop * width)
        first[:, here] = signal[frames, inside]
        both = np.nan_to_num(_bridge(signal, np.ones(signal.shape[1], dtype=bool))).T
        steps[:, here] = (basis - own)[frames] @ (both[inside] @ basis).T
        at = displacement.weights(rows, source)[loose[chosen] - top * width]
        *_, flags = quality.read(capture.isel(band=[displacement.reference], y=source))
        bad = quality.unusable(flags)
        at = without(at, bad, width)
        unknown[chosen] = abs(at) @ bad > 0.0
        change[chosen] = at @ both - both[loose[chosen] - source.start * width]
    change[unknown] = 0.0
    smoothed = (change @ basis) @ own.T
    # The mean of correlated errors: K / N, times (1 + rho) / (1 - rho).
    error = change - (change @ basis) @ basis.T
    energy = (error**2).sum(axis=1)
    lagged = np.clip((error[:, 1:] * error[:, :-1]).sum(axis=1) / energy, 0.0, 0.98)
    variance = energy * basis.shape[1] / change.shape[1] ** 2 * (1.0 + lagged) / (1.0 - lagged)
    # One that is not known, beside bad pixels, may be as large as any other.
    variance[unknown] = np.max((first.T if unknown.all() else smoothed[~unknown]) ** 2, initial=0)
    # A sample that is no measurement is an outlier of the regression.
    return np.nan_to_num(first), steps, smoothed, np.nan_to_num(variance)


def _factor(inputs: Inputs, equations: _Equations, std: Array, variance: Array) -> Array:
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
    gain = np.sqrt(np.asarray((displacement.resample**2).sum(axis=1)).ravel())[:, np.newaxis]
    alone = np.where(gain > 0, size * drawn / gain, 0.0).astype(np.float32)
    target = alone + off * rng.standard_normal(drawn.shape, dtype=np.float32)
    change = np.sqrt(variance)[:, np.newaxis] * rng.standard_normal((variance.size, _DRAWS))
    linear = replace(equations, bends=[Polynomial([0.0])] * len(equations.bends))
    signal, _, _ = linear.solve(target, alone, change)
    own, power = size[:, 0] > 0, (signal.astype(np.float64) ** 2).mean(axis=1)
    settled = power < _GROWN * size[:, 0] ** 2  # elsewhere the iteration grows
    # Over a few pixels: neighbours have nearly the same, and the draws are few.
    energy, total = (
        convolve(np.where(settled, one, 0.0).reshape(displacement.shape), np.ones((3, 3))).ravel()
        for one in (power, size[:, 0] ** 2)
    )
    factor = np.divide(energy, total, out=np.full_like(energy, np.nan), where=settled)
    return np.where(own, factor, 1.0)


def _bends(curves: list[Curve]) -> list[Polynomial]:
    """Polynomials of u_m(x) - u_1(x) in u_1(x), over the calibrated range, for bands m > 1."""
    first = curves[0]
    temperature = np.linspace(first.lowest, first.highest, 64)
    own = first.signal(temperature)
    place = own - first.reference
    return [Polynomial.fit(place, one.signal(temperature) - own, _DEGREE) for one in curves[1:]]
