"""Equations that couple the object signals at both cameras' places, of all pixels; see `joint`."""

from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
import xarray as xr
from numpy.polynomial import Polynomial
from scipy.sparse import csr_array, diags_array
from scipy.special import chdtri

from dbthermal import _smooth as smooth
from dbthermal import schema
from dbthermal._arrays import Array, stretches
from dbthermal._compiled import compiled
from dbthermal.response import Curve
from dbthermal.separation import _quality as quality
from dbthermal.separation._apart.displaced import without
from dbthermal.separation._inputs import Inputs
from dbthermal.separation._subspace import reflection_ratio
from dbthermal.separation._subspace.kernels import inlined
from dbthermal.separation._subspace.reflection_ratio import null_combination, ratio_variance
from dbthermal.separation._tiles import Mask, Material, Whole

Floats = npt.NDArray[np.floating[Any]]

_CONTRACTION: Final = 0.95  # share of an error that a step may leave
_MARGIN: Final = 0.02  # of an emissivity to the ends of what the ratios leave [1]
# Degree of the bend between two responses: over 165 K its slope is 0.014 % off, 0.25 % of 4.
_DEGREE: Final = 8
# Steps of the iteration, and the change that ends it [K].
_STEPS: Final = 60
CONVERGED: Final = 1e-3
_ENDLESS: Final = 1e3  # change of an object between two places [K] that no iteration ended at

Rows: TypeAlias = tuple[Whole, Whole, Floats]
"""Starts of the rows, columns and values of a sparse matrix."""

FORWARD, BACKWARD, LOOSE = range(3)  # by which equation a pixel is solved


class Terms(NamedTuple):
    """Equations as the compiled loops take them."""

    shares: Floats  # c (band, pixel) [1]
    bends: Floats  # (band - 1, degree + 1)
    way: Whole  # `FORWARD`, `BACKWARD` or `LOOSE` (pixel)
    place: Whole  # among the pixels of that way (pixel)
    pairing: Rows  # (pixel, pixel)
    onward: Rows  # (backward pixel, pixel)
    beyond: Floats  # c_m at p + d(p) (band - 1, backward pixel) [1]
    change: Floats  # u_1(x(p)) - u_1(x(r)) (loose pixel, frame) [K]


@dataclass(frozen=True)
class Equations:
    """Equations of all pixels, and by which way each is solved."""

    first: Floats  # e_1 (pixel) [1]
    shares: Floats  # c of eq. 6 (band, pixel) [1]
    pairing: csr_array  # weights of x(p) (pixel, pixel), of the linked pixels
    onward: csr_array  # weights of the equation at p + d(p) (backward pixel, pixel)
    ways: tuple[Whole, ...]  # pixels solved for x(r), for x(p), and without such neighbours
    bends: Floats  # coefficients of u_m(x) - u_1(x) of u_1(x) (band - 1, degree + 1), rising

    @cached_property
    def solved(self) -> Whole:
        """Pixels that are solved."""
        return np.sort(np.concatenate(self.ways))

    @cached_property
    def packed(self) -> "Equations":
        """Return the equations of the solved pixels alone, numbered anew."""
        places = self.solved
        return replace(
            self,
            first=self.first[places],
            shares=np.ascontiguousarray(self.shares[:, places]),
            pairing=self.pairing[places][:, places],
            onward=self.onward[:, places],
            ways=tuple(np.searchsorted(places, pixels) for pixels in self.ways),
        )

    def spread(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Values (solved pixel, ...) over all pixels, 0 elsewhere."""
        result = np.zeros((self.first.size, *values.shape[1:]), dtype=values.dtype)
        result[self.solved] = values
        return result

    def solve(self, target: Floats, start: Floats, change: Floats) -> tuple[Floats, Floats, Floats]:
        """Solve for u_1(x(r)) and u_1(x(p)) (pixel, frame) [K]; and the last step (pixel) [K]."""
        way, place = np.zeros((2, self.first.size), dtype=np.intp)
        for number, pixels in enumerate(self.ways):
            way[pixels], place[pixels] = number, np.arange(pixels.size)
        matrices = self.pairing, self.onward
        pairs, onward = ((matrix.indptr, matrix.indices, matrix.data) for matrix in matrices)
        beyond = np.ascontiguousarray((self.onward @ self.shares[1:].T).T)
        # The known change (loose, frame) [K] is e_1 [u_1(x(p)) - u_1(x(r))].
        moved = np.asarray(change / self.first[self.ways[LOOSE], np.newaxis], np.float32)
        terms = Terms(self.shares, self.bends, way, place, pairs, onward, beyond, moved)
        target, signal = (np.array(film, np.float32, order="C") for film in (target, start))
        at_p, step = np.empty_like(signal), np.zeros(len(signal), np.float32)
        relax(terms, target, signal, step)
        second_place(terms, target, signal, at_p)
        return signal, at_p, step


def first_emissivity(inputs: Inputs, result: xr.Dataset) -> Floats:
    """Emissivities (band, pixel) [1] by which a pixel is solved, the quietest band first."""
    emissivity, ratio = (
        result[name].values[inputs.bands].reshape(len(inputs.bands), -1).astype(np.float64)
        for name in ("emissivity", "reflection_ratio")
    )
    ratio = np.where(np.isfinite(ratio), ratio, ratio_of(emissivity))
    # That of a constant object is taken from the middle of what its ratios leave.
    middle = 1.0 - ratio * (0.5 / np.maximum(ratio.max(axis=0), 1.0))
    return np.where(np.isfinite(emissivity), emissivity, middle)


def ratio_of(emissivity: Floats) -> Floats:
    """Reflection ratios (band, pixel) [1] of emissivities."""
    return np.asarray((1.0 - emissivity) / (1.0 - emissivity[0]))


def inside(emissivity: Floats) -> Floats:
    """Emissivities of the same ratios, all of them well inside (0, 1)."""
    ratio = ratio_of(emissivity)
    # e_m > 0 leaves 0 < 1 - e_1 < 1 / kappa.
    limit = 1.0 / np.maximum(ratio.max(axis=0), 1.0)
    place = np.clip((1.0 - emissivity[0]) / limit, _MARGIN, 1.0 - _MARGIN)
    return np.asarray(1.0 - ratio * limit * place)


def weights(inputs: Inputs, emissivity: Floats) -> Floats:
    """Weights w of eq. 5 (band, pixel) [1], of the bands without background."""
    noise = inputs.noise[inputs.bands]
    return null_combination(ratio_of(emissivity).astype(np.float64), noise)[0]


def of_ratio(inputs: Inputs, material: Material) -> Floats:
    """Variance (pixel) [1] of the first weight by the material's ratios, 0 without a material."""
    noise = inputs.noise[inputs.bands]
    std = np.sqrt(ratio_variance(material.ratio, material.inverse_energy, noise))
    ratios = material.ratio, material.ratio + std
    before, after = (null_combination(ratio, noise)[0][0] for ratio in ratios)
    return np.asarray(np.nan_to_num((after - before) ** 2))


def coefficients(inputs: Inputs, emissivity: Floats, solved: Mask) -> Floats:
    """Coefficients c of eq. 6 (band, pixel) [1], of sum 1."""
    shares = np.where(solved, weights(inputs, emissivity) * emissivity, 0.0)
    shares[0, ~solved] = 1.0
    return shares.astype(np.float32)


def equations(inputs: Inputs, emissivity: Floats, solved: Mask) -> Equations:
    """Equations of the solved pixels: each for the place with the larger coefficient."""
    displacement = inputs.displacement
    assert displacement is not None
    shares = coefficients(inputs, emissivity, solved)
    at_p, linked = _among(displacement.resample, solved, displacement.shape[1])
    onward, reached = _among(displacement.onward, solved, displacement.shape[1])
    size, second = np.abs(shares[0]), shares[1:].sum(axis=0)
    strong = np.abs(second) < size
    # The error of a step: only where it contracts, with the weights' signs, are places linked.
    forward, back = abs(at_p).sum(axis=1) * np.abs(second), abs(onward) @ size
    reached &= back < _CONTRACTION * np.abs(onward @ second)
    linked &= np.where(strong, forward < _CONTRACTION * size, reached)
    backward = np.flatnonzero(linked & ~strong)
    return Equations(
        first=np.where(solved, emissivity[0], 1.0),
        shares=shares,
        pairing=csr_array(diags_array(linked.astype(np.float32)) @ at_p.astype(np.float32)),
        onward=csr_array(onward[backward].astype(np.float32)),
        ways=(np.flatnonzero(linked & strong), backward, np.flatnonzero(solved & ~linked)),
        bends=bends(tuple(inputs.curves[band] for band in inputs.bands)),
    )


def _among(weights: csr_array, solved: Mask, width: int) -> tuple[csr_array, Mask]:
    """Weights of solved pixels alone, and the solved pixels for which that is possible."""
    weights = without(weights, ~solved, width)
    weights.eliminate_zeros()
    return weights, solved & (np.diff(weights.indptr) > 0) & (abs(weights) @ ~solved <= 0.0)


@lru_cache
def bends(curves: tuple[Curve, ...]) -> Floats:
    """Polynomials of u_m(x) - u_1(x) in u_1(x), over the calibrated range, for bands m > 1."""
    first = curves[0]
    temperature = np.linspace(first.lowest, first.highest, 64)
    signal = first.signal(temperature)
    place = signal - first.reference
    result = np.zeros((len(curves) - 1, _DEGREE + 1))
    for bend, curve in zip(result, curves[1:], strict=True):
        fit = Polynomial.fit(place, curve.signal(temperature) - signal, _DEGREE).convert()
        bend[: fit.coef.size] = fit.coef  # without the last ones that are zero
    return result


def of_material(inputs: Inputs, raw: Floats, material: Material) -> tuple[Floats, Mask]:
    """Emissivities (band, pixel) [1] of each pixel's material, and the pixels where they hold."""
    ratio = np.where(np.isfinite(material.ratio), material.ratio, ratio_of(raw))
    variance = null_combination(ratio, inputs.noise[inputs.bands])[1]
    # Not beside a gray body, which has no combination without background.
    sharp = material.inverse_energy * variance < 1.0 / chdtri(len(raw) - 1, reflection_ratio.CHANCE)
    ratio = np.where(sharp, ratio, ratio_of(raw))
    first = np.where(np.isfinite(material.emissivity) & sharp, material.emissivity, raw[0])
    return np.asarray(1.0 - ratio * (1.0 - first)), sharp & np.isfinite(material.ratio[-1])


def measured(film: Floats) -> Mask:
    """Pixels of a film (frame, pixel) with a number in some frame."""
    result = np.zeros(film.shape[1], dtype=bool)
    for frames in stretches(film):
        result |= np.isfinite(film[frames]).any(axis=0)
    return result


@dataclass(frozen=True)
class Change:
    """Change of e_1 u_1(x) in the reference band from r to p, of loose pixels: smooth over time."""

    curves: Array  # coefficients (loose, column) [K]
    functions: Array  # of which they are (time, column)
    variance: Array  # (loose) [K^2]

    def at(self, frames: slice | Whole) -> Floats:
        """Change (loose, frame) [K] at some frames."""
        return np.asarray(self.curves @ self.functions[frames].T)


def samples(inputs: Inputs, frames: Whole) -> tuple[Floats, Floats]:
    """Signal (frame, pixel) [K] of the reference band, and the steps of the camera in it."""
    functions, width = smooth_functions(inputs.capture), inputs.capture.sizes["x"]
    # A sample that is no measurement is 0, an outlier of the regression.
    signal = np.nan_to_num(_signal(inputs, time=frames)).reshape(frames.size, -1)
    steps = np.zeros_like(signal)
    if functions.steps:
        of_camera = functions.functions - functions.object_part
        for rows in inputs.blocks:
            pixels = np.arange(rows.start * width, rows.stop * width)
            steps[:, pixels] = of_camera[frames] @ (functions.functions.T @ _film(inputs, pixels))
    return signal, steps


def change(inputs: Inputs, loose: Whole, result: xr.Dataset, threads: Executor) -> Change:
    """Change of the reference band's signal from r to p of loose pixels, smoothed over time."""
    displacement = inputs.displacement
    assert displacement is not None
    functions = smooth_functions(inputs.capture)
    bad = displacement.once("bad", lambda: _bad(inputs, threads))
    at_p = without(displacement.resample[loose], bad, displacement.shape[1])
    unknown = abs(at_p) @ bad > 0.0
    onward = displacement.onward[loose]  # at r + d(r), nearly as far from r as p
    names, second = ("reflection_ratio", "reflection_ratio_std"), inputs.bands[1]
    ratio, std = (result[name].values[second].ravel() for name in names)
    nearest = abs(at_p).argmax(axis=1)
    variance = (std[nearest] ** 2 + std[loose] ** 2) * chdtri(1, reflection_ratio.CHANCE)
    # Where p has another ratio than r it may be of another material, with another signal: the
    # deviation then holds the difference to the change from the other side of r.
    borders = ~unknown & ((ratio[nearest] - ratio[loose]) ** 2 > variance)
    borders &= (abs(onward) @ bad == 0.0) & (onward.sum(axis=1) > 0.0)
    # Only the pixels that they are made of are read.
    pixels = np.unique(np.concatenate([loose, at_p.indices, onward.indices]))
    film = _film(inputs, pixels).T
    at_r = film[np.searchsorted(pixels, loose)]
    moved = at_p[:, pixels] @ film - at_r
    bend = moved + onward[:, pixels] @ film - at_r
    moved[unknown] = 0.0
    # Smoothed, it is the change of e_1 u_1(x) and holds little of the reflection's change.
    curves = moved @ functions.functions
    # The reflection's slow part is as large as its rapid part lets expect.
    error = moved - curves @ functions.functions.T
    frames, columns = functions.functions.shape
    rapid, first = smooth.rapid(inputs.capture["time"].values.astype(np.float64))
    variance = smooth.energy_below((rapid.T @ error.T) ** 2, first) / frames
    # In pieces of time the rapid part is the object's, too: there as of the mean of correlated
    # errors, K / N, times (1 + rho) / (1 - rho).
    divided = inputs.division[:, loose].any(axis=0)
    energy, lagged = (error**2).sum(axis=1), (error[:, 1:] * error[:, :-1]).sum(axis=1)
    lagged = np.nan_to_num(np.clip(lagged / energy, 0.0, 0.98))
    correlated = energy * columns / frames**2 * (1.0 + lagged) / (1.0 - lagged)
    variance = np.where(divided, correlated, variance)
    bend = bend[borders] @ functions.functions @ functions.object_part.T
    variance[borders] += np.mean(bend**2, axis=1)
    # One that is not known, beside bad pixels, may be as large as any other.
    largest = film if unknown.all() else curves @ functions.object_part.T
    variance[unknown] = np.max(largest**2, initial=0.0)
    return Change(curves, functions.object_part, variance)


def _bad(inputs: Inputs, threads: Executor) -> Mask:
    """Bad pixels (pixel) of the reference band."""
    band = inputs.capture.isel(band=[inputs.bands[0]])
    status = threads.map(lambda rows: quality.read(band.isel(y=rows))[2], inputs.blocks)
    return quality.unusable(np.concatenate([*status]))


def _film(inputs: Inputs, pixels: Whole) -> Floats:
    """Signal (time, pixel) [K] of some pixels of the reference band, its gaps bridged."""
    places = np.divmod(pixels, inputs.capture.sizes["x"])
    row, column = (xr.DataArray(place, dims="pixel") for place in places)
    film = _signal(inputs, y=row, x=column)
    return np.asarray(np.nan_to_num(smooth.bridge(film, np.ones(pixels.size, dtype=bool))))


def _signal(inputs: Inputs, **places: Any) -> Floats:
    """Signal [K] of the reference band at some places; NaN for a sample that is no measurement."""
    curve = inputs.curves[inputs.bands[0]]
    counts = inputs.capture["counts"].isel(band=inputs.bands[0], **places).values
    return curve.linearise(np.where(schema.measured(counts), counts, np.nan)) - curve.reference


def smooth_functions(capture: xr.Dataset, frames: Any = slice(None)) -> smooth.Subspace:
    """Smooth functions of the frames of a capture, with the steps of the camera."""
    time = capture["time"].values[frames].astype(np.float64)
    return smooth.largest(time, schema.segments(capture)[frames])


@inlined
def _other_bands(shares: Floats, pixel: int, bends: Floats, signal: Floats, result: Floats) -> None:
    """Sum of a pixel's shares (band - 1, pixel) times u_m(x), of u_1(x) (frame) [K], in place."""
    for t in range(signal.size):
        value, total = np.float64(signal[t]), 0.0
        for band in range(shares.shape[0]):
            # The bend u_m - u_1 is a polynomial of u_1, by Horner's rule.
            bend = 0.0
            for degree in range(bends.shape[1] - 1, -1, -1):
                bend = bend * value + bends[band, degree]
            total += shares[band, pixel] * (value + bend)
        result[t] = total


@compiled
def other_bands(shares: Floats, bends: Floats, signal: Floats, result: Floats) -> None:
    """As `_other_bands`, of all pixels (pixel, frame), in place."""
    for pixel in range(signal.shape[0]):
        _other_bands(shares, pixel, bends, signal[pixel], result[pixel])


@inlined
def _at_p(terms: Terms, pixel: int, signal: Floats, film: Floats) -> None:
    """Signal u_1(x(p)) (frame) [K] of a pixel, from all signals at r (pixel, frame), in place."""
    if terms.way[pixel] == LOOSE:
        change = terms.change[terms.place[pixel]]
        for t in range(film.size):
            film[t] = signal[pixel, t] + change[t]
        return
    starts, columns, values = terms.pairing
    film[:] = 0.0
    for entry in range(starts[pixel], starts[pixel + 1]):
        weight, neighbour = values[entry], signal[columns[entry]]
        for t in range(film.size):
            film[t] += weight * neighbour[t]


@inlined
def _forward(
    terms: Terms, target: Floats, pixel: int, signal: Floats, film: Floats, spare: Floats
) -> None:
    """Next u_1(x(r)) (frame) [K] of a pixel by its own equation, in place."""
    first, loose = terms.shares[0, pixel], terms.way[pixel] == LOOSE
    _at_p(terms, pixel, signal, film)
    _other_bands(terms.shares[1:], pixel, terms.bends, film, spare)
    for t in range(film.size):
        remainder = target[pixel, t] - spare[t]
        # Of a loose pixel a step of Newton, of a slope near sum c = 1.
        film[t] = signal[pixel, t] * (1.0 - first) + remainder if loose else remainder / first


@inlined
def _backward(
    terms: Terms, target: Floats, pixel: int, signal: Floats, film: Floats, spare: Floats
) -> None:
    """Next u_1(x(r)) (frame) [K] of a pixel by the equation at p + d(p), in place."""
    place = terms.place[pixel]
    starts, columns, values = terms.onward
    film[:] = 0.0
    for entry in range(starts[place], starts[place + 1]):
        weight, source = values[entry], columns[entry]
        first = terms.shares[0, source]
        for t in range(film.size):
            film[t] += weight * (target[source, t] - first * signal[source, t])
    _other_bands(terms.beyond, place, terms.bends, signal[pixel], spare)
    slope = terms.beyond[:, place].sum()
    for t in range(film.size):
        film[t] = signal[pixel, t] + (film[t] - spare[t]) / slope


@compiled
def relax(terms: Terms, target: Floats, signal: Floats, step: Floats) -> None:
    """Solve for u_1(x(r)) (pixel, frame) [K] from a start, and its last steps (pixel), in place."""
    film, spare = np.empty(signal.shape[1]), np.empty(signal.shape[1])
    # Method of Gauss and Seidel: each pixel in turn, of the other pixels' values so far.
    for _ in range(_STEPS):
        largest = 0.0
        for pixel in range(len(signal)):
            if terms.way[pixel] == BACKWARD:
                _backward(terms, target, pixel, signal, film, spare)
            else:
                _forward(terms, target, pixel, signal, film, spare)
            moved = 0.0
            for t in range(film.size):
                moved = max(moved, abs(film[t] - signal[pixel, t]))
                signal[pixel, t] = film[t]
            step[pixel] = moved
            largest = max(largest, moved)
        if largest < CONVERGED:
            break


@compiled
def second_place(terms: Terms, target: Floats, signal: Floats, result: Floats) -> None:
    """Signals u_1(x(p)) (pixel, frame) [K] of a solution, in place."""
    film, spare = np.empty(signal.shape[1]), np.empty(signal.shape[1])
    second = terms.shares[1:]
    for pixel in range(len(signal)):
        _at_p(terms, pixel, signal, film)
        if terms.way[pixel] == BACKWARD:
            # Its own equation holds for another x(p) than that between its neighbours.
            slope = second[:, pixel].sum()
            _other_bands(second, pixel, terms.bends, film, spare)
            for t in range(film.size):
                remainder = target[pixel, t] - terms.shares[0, pixel] * signal[pixel, t] - spare[t]
                film[t] += remainder / slope
        result[pixel] = film


@compiled
def changes(signals: Floats, pixels: Whole, shares: Floats, bend: Floats, result: Floats) -> None:
    """Shares (pixel) of the change of u_m, of u_1 at both places (2, node, pixel), 0 if endless."""
    for t in range(result.shape[0]):
        for p in range(pixels.size):
            at_r, at_p = np.float64(signals[0, t, pixels[p]]), np.float64(signals[1, t, pixels[p]])
            change, of_r, of_p = at_p - at_r, 0.0, 0.0
            for degree in range(bend.size - 1, -1, -1):
                of_r, of_p = of_r * at_r + bend[degree], of_p * at_p + bend[degree]
            change = shares[p] * (change + of_p - of_r)
            result[t, p] = change if abs(change) < _ENDLESS else 0.0  # so is NaN
