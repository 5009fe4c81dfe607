"""Steps 1 to 4 of `method`, one pixel after another, compiled."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri, stdtrit

from dbthermal import _smooth as smooth
from dbthermal._arrays import Array
from dbthermal.response import Curve
from dbthermal.separation import _tiles as tiles
from dbthermal.separation._subspace import bars, kernels, pieces, pixel, reflection_ratio
from dbthermal.separation._subspace.kernels import compiled, inlined
from dbthermal.separation._subspace.pixel import Model, Work
from dbthermal.separation._tiles import Mask, Pixels, Survey, Tile, Whole

# Samples that are turned at once, to stay in the cache, and the fewest pixels.
_TURNED: Final = 2**14
_BLOCK: Final = 8
_VECTOR: Final = 64  # numbers that a loop takes at once, at most
_PAGE, _STAGGER = 512, 24  # numbers of a page, and of three lines of the cache
_ZERO, _ONE, _NAN = np.float32(0.0), np.float32(1.0), np.float32(np.nan)
_SIGMAS, _USELESS = np.float32(tiles.RANGE_SIGMAS), np.float32(tiles.USELESS)

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
    ratio: Array  # kappa: rapid change of each band over that of the first (band, pixel) [1]
    ratio_variance: Array  # (band, pixel) [1], with that through the background's level
    inverse_energy: Array  # sigma^2 of eq. 4, infinite without background energy (pixel) [1/K^2]
    null_weights: Array  # w of eq. 5: no background, all of the object (band, pixel) [1]
    null_variance: Array  # of its noise (pixel) [K^2]
    order: Whole  # number of smooth functions used
    freedom: Whole  # frames less the functions of each scatter (3, pixel)
    contrast: Array  # variance along the axis over that across it, at the largest order (pixel)
    reduced_chi2: Array  # variance across the axis over the noise's, 1 if the model holds (pixel)
    pooled: Mask  # the material's ratios are used, and the pixel does not contradict them
    scatter: Array  # noise-whitened, of rapid changes, less noise, at the pixel's order and at
    # two large ones (3, band, band, pixel) [1]
    emissivity: Array  # (band, pixel) [1]
    emissivity_covariance: Array  # (band, band, pixel) [1]
    epsilon_variance: Array  # of the error of the null combination's ratios (pixel) [1]
    noise_variance: Array  # of e_1, from the regression's noise (pixel) [1]
    drift_variance: Array  # of e_1, from the background's slow part (pixel) [1]
    influence: Array  # of the residual in each span of time on e_1 (span, pixel) [1]
    constant: Mask  # the object changes too little for its emissivity (pixel)
    restless: Mask  # the background hardly rests (pixel)
    gray: Mask  # the signals as they are may be those of a gray body (pixel)
    correlation: Array  # of the null residual (pixel)
    delay: Array  # of the bands (pixel)
    unexplained: Mask  # the residual is not noise (pixel)
    sums: Array  # of the null residual and the object's curve (2, block, pixel), see `pieces` [K]

    def survey(self, sound: Mask, plain: Mask) -> Survey:
        """Survey of the pixels whose model is sound, with emissivities of those without a flag."""
        # A selection by the estimate itself would bias the sum over a material.
        return Survey(
            scatter=np.where(sound, self.scatter, 0.0),
            frames=np.where(sound, self.freedom, 0.0),
            ratio=self.ratio,
            null_weights=self.null_weights,
            emissivity=np.where(plain, self.emissivity[0], np.nan),
            noise_variance=self.noise_variance,
            drift_variance=self.drift_variance,
            influence=self.influence,
        )


@inlined
def _film(
    temperature: Array, variance: Array, model: Model, value: Any, std: Any
) -> tuple[Any, Any, Any]:
    """Temperature and deviation (time), NaN where useless; numbers lost, missing, out of range."""
    lost, missing, beyond, zero, unit = _ZERO, _ZERO, _ZERO, _ZERO, _ONE
    lowest, highest = np.float32(model.lowest), np.float32(model.highest)
    for t in range(temperature.size):
        kelvin, deviation = np.float32(temperature[t]), np.sqrt(np.float32(variance[t]))
        missing += unit if np.isnan(kelvin) else zero
        margin = _SIGMAS * (zero if np.isnan(deviation) else deviation)
        beyond += unit if (kelvin < lowest - margin) | (kelvin > highest + margin) else zero
        useful = (abs(kelvin) < _USELESS) & (deviation < _USELESS)
        value[t] = kelvin if useful else _NAN
        std[t] = deviation if useful else _NAN
    for t in range(temperature.size):  # not above: it would not be taken many at once
        lost += unit if np.isnan(value[t]) else zero
    return lost, missing, beyond > zero


_NUMBERS: Final = (
    *("inverse_energy", "null_variance", "contrast", "reduced_chi2", "epsilon_variance"),
    *("noise_variance", "drift_variance", "correlation", "delay"),
)
RECORD: Final = np.dtype(
    [
        *((name, np.float64) for name in _NUMBERS),
        *((name, np.bool_) for name in ("pooled", "gray", "constant", "restless", "unexplained")),
        *((name, np.float64, 2) for name in ("missing", "lost")),
        ("influence", np.float64, tiles.SPANS),
        # There are no arrays of truth values in a record.
        *[("order", np.intp), ("freedom", np.intp, 3), ("beyond", np.intp, 2)],
    ]
)
"""Numbers of a pixel, the fields of a `Solution` without films, sums, and those of the bands."""
_VECTORS: Final = ("ratio", "ratio_variance", "null_weights", "emissivity")


class Solved(NamedTuple):
    """Films, numbers and sums of all pixels."""

    films: npt.NDArray[np.float32]  # object, deviation, background, deviation (4, time, pixel) [K]
    record: Any  # `RECORD` (pixel)
    vectors: Array  # `_VECTORS` (pixel, 4, band)
    matrices: Array  # three scatters, covariance (pixel, 4, band, band)
    sums: Array  # (2, block, pixel) [K]


@inlined
def _bent(work: Work, frames: int) -> bool:
    """Say whether the bend has changed by more energy about its mean than `pixel.BEND`."""
    bent = False
    for m in range(1, work.noise.size):
        total, square = 0.0, 0.0
        for t in range(frames):
            change = work.bend[m, t] - work.removed[m, t]
            total += change
            square += change**2
        bent |= square - total**2 / frames > (pixel.BEND * work.noise[m]) ** 2
    return bent


@kernels.merged
def _pixel(
    model: Model, work: Work, films: Any, record: Any, vectors: Any, covariance: Any
) -> None:
    """Steps 1 to 4, on the exact model where it matters, and all that the flags need."""
    frames, bands = work.first.size, work.noise.size
    for m in range(bands):
        kernels.copy(work.signals[m, :frames], work.straight[m, :frames])
        kernels.fill(work.removed[m, :frames], 0.0)
    gray = False
    for rounds in range(pixel.BENDS + 1):
        pixel.ratios(model, work, record)
        line = pixel.emission(model, record, work, rounds)
        pixel.background(model, work)
        # The bend of a gray body is not known: it is told from the signals as they are.
        if rounds == 0:
            gray = pixel.may_be_gray(model, record, work)
        if rounds == pixel.BENDS or not _bent(work, frames):
            break
        _straighten(work, bands, frames)
    bars.bars(model, record, line, work, covariance)
    _write(work, record, vectors)
    object_ = _film(work.temperature, work.variance, model, films[0], films[1])
    background = _film(work.background, work.background_variance, model, films[2], films[3])
    for i, judged in enumerate((object_, background)):
        record.lost[i], record.missing[i], record.beyond[i] = judged
    record.gray = gray


@inlined
def _straighten(work: Work, bands: int, frames: int) -> None:
    """Take the bend out of the signals, in place."""
    for m in range(1, bands):
        bend, straight = work.bend[m, :frames], work.straight[m, :frames]
        signal, removed = work.signals[m, :frames], work.removed[m, :frames]
        for t in range(frames):
            removed[t] = bend[t]
            straight[t] = signal[t] - bend[t]


@compiled
def _scatters(model: Model, work: Work, record: Any, matrices: Any) -> None:
    """Scatter less noise at the pixel's order and at two large ones, in place."""
    bands, frames, orders = work.noise.size, work.first.size, len(work.scatter)
    # The bend is too small to be seen in a pixel, but not in many; a pixel with the emissivity of
    # its material is not asked for its scatter.
    if np.isnan(work.material[2]) and not _bent(work, frames):
        _straighten(work, bands, frames)
        pixel.scatter(model, work)
    _straight_noise(model, work, work.turned, work.axis)
    for place in range(3):
        order = record.order
        if place > 0:
            order = max(1, orders - reflection_ratio.FEWER * (2 - place))
        record.freedom[place] = frames - model.steps - order
        for m, k in np.ndindex(bands, bands):
            noise = record.freedom[place] * work.turned[m, k]
            matrices[place, m, k] = work.scatter[order - 1, m, k] - noise


@inlined
def _straight_noise(model: Model, work: Work, covariance: Array, rate: Array) -> None:
    r"""Covariance (band, band) of the whitened noise of straightened signals, in place.

    The bend is that of a noisy background. With :math:`r_m = (1 - e_m) u_m'(y) / s_m` its noise is
    :math:`\sum_k r_k n_k / E` of white :math:`n_k` and :math:`E = \sum_k r_k^2`. It enters band m
    by :math:`h_m = r_m - (1 - e_m) u_1'(y) / s_m`, which leaves :math:`\delta_{mk} - (h_m r_k +
    r_m h_k - h_m h_k) / E`. That is too little to be seen in a pixel, but not in many.
    """
    level, energy, physical = kernels.mean(work.background[: work.first.size]), 0.0, True
    slope = kernels.exact(kernels.response(model.tables, 0), level)[1]
    for m in range(rate.size):
        emissivity, response = work.emissivity[m], kernels.response(model.tables, m)
        rate[m] = (1.0 - emissivity) / work.noise[m] * kernels.exact(response, level)[1]
        energy += rate[m] ** 2
        physical &= 0.0 < emissivity < 1.0
    for m, k in np.ndindex(rate.size, rate.size):
        covariance[m, k] = 1.0 if m == k else 0.0
        if physical and energy > 0.0:
            first = rate[m] - (1.0 - work.emissivity[m]) / work.noise[m] * slope
            second = rate[k] - (1.0 - work.emissivity[k]) / work.noise[k] * slope
            shared = first * rate[k] + rate[m] * second - first * second
            covariance[m, k] -= shared / energy


@inlined
def _write(work: Work, record: Any, vectors: Any) -> None:
    """Ratios, their variances, null combination and emissivities, in place."""
    noise = work.noise
    for m in range(noise.size):
        vectors[0, m], vectors[2, m] = work.ratio[m], work.null_weights[m]
        vectors[3, m] = work.emissivity[m]
        error = noise[m] ** 2 + (work.ratio[m] * noise[0]) ** 2 if m > 0 else 0.0  # eq. 4
        vectors[1, m] = record.inverse_energy * error + work.level[m] ** 2 if m > 0 else 0.0


@inlined
def _turn(samples: Any, places: Whole, turned: Any) -> None:
    """Samples (kind, time, pixel) of a few pixels as (pixel, kind, time), in place."""
    for kind in range(turned.shape[1]):
        for t in range(turned.shape[2]):
            row = samples[kind, t]
            for p in range(places.size):
                turned[p, kind, t] = row[np.uintp(places[p])]


@inlined
def _return(turned: Any, places: Whole, samples: Any) -> None:
    """The reverse of `_turn`, in place."""
    for kind in range(turned.shape[1]):
        for t in range(turned.shape[2]):
            row = samples[kind, t]
            for p in range(places.size):
                row[np.uintp(places[p])] = turned[p, kind, t]


@kernels.entered
def _separate(
    model: Model,
    signals: Array,
    places: Whole,
    materials: Array,
    errors: Array,
    work: Work,
    solved: Solved,
) -> None:
    """Steps of some pixels of a tile."""
    samples, outside, pixels = work.inside, work.outside, places.size
    block = len(samples)
    for start in range(0, pixels, block):
        batch = places[start : start + block]
        _turn(signals, batch, samples)
        for p in range(batch.size):
            place = np.uintp(batch[p])
            for m in range(work.noise.size):
                kernels.copy(samples[p, m], work.signals[m])
            kernels.copy(materials[place], work.material)
            kernels.copy(errors[0, place], work.noise)
            kernels.copy(errors[1, place], work.pattern)
            record, matrices = solved.record[place], solved.matrices[place]
            _pixel(model, work, outside[p], record, solved.vectors[place], matrices[3])
            bars.judge(model, work, record, solved.sums[..., place])
            _scatters(model, work, record, matrices)
        _return(outside, batch, solved.films)


def share(tile: Tile, functions: smooth.Subspace, drift: float) -> Model:
    """All that the pixels of a tile share."""
    curve, second_bands = tile.curves[0], len(tile.noise) - 1
    degrees = functions.rising.shape[1]
    freedom = [min(high - 1, degrees) - low + 1 - lost for low, high, lost in bars.OCTAVES]
    edges, limits = bars.blocks(tile.time.size)
    chances = reflection_ratio.CHANCE, reflection_ratio.GRAY_CHANCE
    return Model(
        **_responses(tile.curves),
        **_columns(functions),
        rising=np.ascontiguousarray(functions.rising.T),
        whole=np.full((degrees, 2), [0, tile.time.size]),
        spread=float(np.ptp(functions.rising[:, 0])),
        drift=drift / np.sqrt(3.0),
        chances=(float(chdtri(second_bands, chances[0])), float(chdtri(second_bands, chances[1]))),
        widened=(stdtrit(np.maximum(freedom, 1), 0.975) / bars.NORMAL95) ** 2,
        edges=edges,
        limits=limits,
        parts=pieces.blocks(tile.time.size),
        lowest=curve.lowest,
        highest=curve.highest,
    )


def _columns(functions: smooth.Subspace) -> dict[str, Any]:
    """Fields of a `Model` that hold functions of time, columns along it."""
    columns = np.ascontiguousarray(functions.functions.T)
    stepless = functions.object_part is functions.functions
    # The same array, if it holds the same, stays in the cache.
    of_object = columns if stepless else np.ascontiguousarray(functions.object_part.T)
    return {
        "functions": columns,
        "object_part": of_object,
        "spans": functions.spans,
        "leverage": np.ascontiguousarray(functions.leverage.T),
        "steps": int(functions.steps),
        "stepless": stepless,
    }


@lru_cache
def _responses(curves: tuple[Curve, ...]) -> dict[str, Any]:
    """Fields of a `Model` that hold the responses."""
    first = curves[0]
    temperature = first.reference + np.array([-0.5, 0.5])  # [K]
    temperatures = np.linspace(first.lowest, first.highest, reflection_ratio.TEMPERATURES)
    middle, ratios = (
        np.array([curve.slope(kelvin) / first.slope(kelvin) for curve in curves])
        for kelvin in (temperature, temperatures)
    )
    rates = np.diff(np.log(middle), axis=1)[:, 0]
    return {"tables": kernels.rows(curves), "rates": rates, "gray": ratios.T.copy()}


def _work_space(frames: int, bands: int, degrees: int) -> dict[str, Any]:
    """Arrays for the signals and curves of one pixel."""
    # Places of one frame that lie a multiple of a page apart would drive each other from the cache.
    distance = -(-frames // _PAGE) * _PAGE + _STAGGER
    names = Work._fields
    curves, banded = names[1 : names.index("signals")], names[names.index("signals") :][:6]
    vectors = names[names.index("axis") : names.index("material")]
    block, size = max(_BLOCK, _TURNED // frames), len(curves)
    space = np.empty((size + len(banded) * bands, distance))
    rows = space[size:].reshape(len(banded), bands, distance)
    return {
        "first": rows[0, 0, :frames],  # of the signals
        **dict(zip(curves, space[:size, :frames], strict=True)),
        **dict(zip(banded, rows, strict=True)),
        **dict(zip(vectors, np.empty((len(vectors), bands)), strict=True)),
        # Whole vectors of infinite values behind the last frame: a rank is of those before.
        "few": np.full((5, -(-frames // _VECTOR) * _VECTOR), np.inf, np.float32),
        "spectra": np.empty((2, degrees)),
        "turned": np.empty((bands, bands)),
        "turns": np.empty((bands, bands)),
        "material": np.empty(5 + bands),
        "inside": np.empty((block, bands, frames)),
        "outside": np.empty((block, 4, frames), np.float32),
    }


def solve(
    tile: Tile,
    functions: smooth.Subspace,
    drift: float,
    divided: Iterable[tuple[Whole, smooth.Subspace]] | None = None,
) -> Solution:
    """Steps 1 to 4 of all pixels, with the limit of the background's `drift` [K]."""
    shared, material = share(tile, functions, drift), tile.material
    bands, frames, pixels = tile.signals.shape
    materials = np.full((pixels, 5 + bands), np.nan)
    if material is not None:
        numbers = (material.inverse_energy, material.emissivity)
        spreads = (material.noise_variance, material.drift_variance, material.spread)
        materials[:] = np.stack([*numbers, *spreads, *material.ratio], 1)
    errors = np.empty((2, pixels, bands))  # of one layout: each is compiled by itself
    errors[:] = tile.scaled(tile.noise).T, tile.scaled(tile.pattern or (0.0,) * bands).T
    films = np.empty((4, frames, pixels), np.float32)
    record = np.zeros(pixels, RECORD).view(np.recarray)  # has its names also where not compiled
    sums = np.zeros((2, shared.parts.size - 1, pixels))
    vectors, matrices = np.zeros((pixels, 4, bands)), np.zeros((pixels, 4, bands, bands))
    signals = np.ascontiguousarray(tile.signals, dtype=np.float64)
    solved = Solved(films, record, vectors, matrices, sums)
    space = _work_space(frames, bands, len(shared.rising))
    # Parts of the pixels may have functions of their own, with the same rising ones; part after
    # part: of a long capture the functions of all would be much memory.
    for places, of_part in [(np.arange(pixels), functions)] if divided is None else divided:
        model, count = shared._replace(**_columns(of_part)), of_part.functions.shape[1]
        space["coefficients"], space["columns"] = np.empty((bands, count)), np.empty(count)
        space["scatter"] = np.empty((of_part.orders, bands, bands))
        _separate(model, signals, places, materials, errors, Work(**space), solved)
    named: dict[str, Any] = {name: np.moveaxis(record[name], 0, -1) for name in RECORD.names or ()}
    squares = matrices.transpose(1, 2, 3, 0)
    named |= {
        "beyond": named["beyond"] > 0,
        "sums": sums,
        "scatter": squares[:3],
        "emissivity_covariance": squares[3],
        **dict(zip(_VECTORS, vectors.transpose(1, 2, 0), strict=True)),
        **dict(zip(FILMS, films, strict=True)),
    }
    return Solution(**named)
