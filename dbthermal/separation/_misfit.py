r"""Bars for what the model leaves in the bands, seen in averages that hold little noise.

The bands' null combination, scaled to the object's signal,

.. math:: q = \sum_m w_m (z_m / k_m - z_1), \quad \sum_m w_m (1 - k_m) / k_m = 1

holds no reflection; less the object's own signal it holds noise alone. If not, the object is as
uncertain: by the reflection's leak into q, where the ratio is not that of the events (coloured
bodies, unlike blurs, median filters, a camera that shakes), and by changes that no reflection
explains (rapid heat that the model misses, pixels that drift).
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.ndimage import uniform_filter
from scipy.special import chdtr, chdtri

from dbthermal import _smooth as smooth
from dbthermal import schema
from dbthermal._arrays import Array, Mask, quotient, release, stretches
from dbthermal.separation import _tiles as tiles
from dbthermal.separation._apart import planes
from dbthermal.separation._apart.equations import smooth_functions
from dbthermal.separation._inputs import Inputs
from dbthermal.separation._quality import MOST_BRIDGED
from dbthermal.separation._subspace.fused import FILMS

Whole = npt.NDArray[np.intp]

_BLOCK: Final = 4  # pixels along a side of what is averaged for changes
_WINDOWS: Final = 4  # of some rows, that tell what a frame has in common
# Blocks along a side of a neighbourhood, for changes and for events, whose blocks are wider: behind
# a blur of 1.3 pixels in one band 0.87 of the intervals hold, in blocks as for changes 0.70.
_SIDE, _EVENT_SIDE, _WIDER = 5, 3, 2
# Samples of a row of a band, beyond which rows are not read two at a time: an hour of 640 columns
# at 30 Hz takes 4.7 GB, not 5.7.
_ROW_SAMPLES: Final = 2**25
# Deviations of its noise from which a remainder counts; and of single pixels' means, share of their
# noise. In plain scenes the bars stay as they are.
_SIGMAS, _SHARE = 3.0, 0.1
# Share of a pixel's changes that are noise, at least, and their variance over that of all.
_STEADY: Final = 0.8
_OF_ALL: Final = float(chdtr(3, chdtri(1, 1.0 - _STEADY))) / _STEADY
_CONTRAST: Final = 3.0  # variance of a reflection's changes in an event over their noise
# Octaves of time in smooth functions, for the octave that is seen: 1/f noise is alike in all.
_OCTAVES: Final = float(np.log2(smooth.HIGHEST_ORDER))


class Reading(NamedTuple):
    """Samples of some rows, and what they hold beside the object; signals in kelvin."""

    rows: slice
    signals: Array  # (band, frame, pixel) [K]
    reflections: Array  # signals less the object's signal, in pixels without a flag
    frames: Mask  # that are read (time)
    pixels: Mask  # without a flag (pixel)
    gain: Array  # noise over that of a sample (band, pixel) [1]


Probe: TypeAlias = Callable[[Inputs, xr.Dataset, Reading], Any]
"""Asks a reading for a cause of what the model leaves; None where it asks nothing."""


@dataclass(frozen=True)
class Misfit:
    """Maps of how far the model fails the measured signals; zero where noise may explain it."""

    leak: Array  # deviation of the object's signal over that of the reflection (y, x) [1]
    change: Array  # deviation of the object's signal, at any time (y, x) [K]
    single: Array  # deviation of that signal by noise of single pixels that is not white (y, x) [K]
    answers: dict[Probe, list[Any]]  # to each probe, of the rows that it asks
    levels: tuple[Array, Array]  # normal equations (window, ...) of what a frame has in common

    @property
    def size(self) -> float:
        """Typical deviation of the object's signal beside a contrast of a kelvin [K]."""
        return float(np.mean(self.leak) + np.mean(self.change))


class _Blocks(NamedTuple):
    """Of each block of some rows (..., row, column): averages of its pixels without a flag."""

    pixels: Array  # their number
    rough: Array  # variance of the remainder's means in time, and its part of noise (2, ...) [K^2]
    single: Array  # such variances of single pixels, of all and the smaller changes (2, 2, ...)


class _Events(NamedTuple):
    """Reflections in each event, of blocks twice as long and wide as those of changes."""

    pixels: Array  # number of pixels without a flag
    noise: Array  # variances of remainder and reflection, and their covariance (3, ...) [K^2]
    products: Array  # remainder times reflection, and reflection squared (2, event, ...) [K^2]
    freedom: Array  # degrees of freedom of each event (event, ...)


def measure(inputs: Inputs, result: xr.Dataset, workers: int, *probes: Probe) -> Misfit:
    """Measure how far unflagged pixels deviate from a model; the probes are asked in passing."""

    def examine(rows: slice) -> tuple[_Blocks, _Events, tuple[Array, Array], list[Any]]:
        reading = reflected(inputs, result, rows)
        sums = [probe(inputs, result, reading) for probe in probes]
        return *_of_rows(inputs, result, reading), sums

    is_long = inputs.capture["counts"][0, :, 0].size > _ROW_SAMPLES
    with ThreadPoolExecutor(1 if is_long else workers) as threads:
        sections, parts, levels, sums = zip(*threads.map(examine, inputs.blocks), strict=True)
    blocks = _Blocks(*(np.concatenate(maps, axis=-2) for maps in zip(*sections, strict=True)))
    events = _Events(*(np.concatenate(maps, axis=-2) for maps in zip(*parts, strict=True)))
    answers = {
        probe: [value for value in values if value is not None]
        for probe, values in zip(probes, zip(*sums, strict=True), strict=False)
    }
    # Changes that no reflection explains; 1/f noise of single pixels, alike in all octaves.
    sure = _SIGMAS * np.sqrt(2.0 / (_number(blocks.pixels, _SIDE) * smooth.HIGHEST_ORDER))
    change = _excess(blocks, blocks.rough, sure, 1.0)
    single = np.minimum(*(_excess(blocks, pair, _SHARE, _OCTAVES) for pair in blocks.single))

    def of_pixels(values: Array, side: int) -> Array:
        pairs = [(it.start, y // side) for it in inputs.blocks for y in range(it.stop - it.start)]
        row = np.unique(pairs, axis=0, return_inverse=True)[1].ravel()
        return values[np.ix_(row, np.arange(result.sizes["x"]) // side)]

    # Give each pixel the values of its block.
    leak = of_pixels(_leak(events), _WIDER * _BLOCK)
    change, single = (of_pixels(values, _BLOCK) for values in (change, single))
    forms, forces = map(np.concatenate, zip(*levels, strict=True))
    return Misfit(leak, change, single, answers, (forms, forces))


def _local_mean(pixels: Array, values: Array, side: int) -> Array:
    """Mean (..., row, column) over the pixels of the blocks around each."""
    size = (1,) * (values.ndim - 2) + (side, side)
    weight = uniform_filter(pixels, side, mode="constant")
    mean = uniform_filter(values * pixels, size, mode="constant")
    return np.asarray(quotient(mean, weight + 0.0 * mean, 0.0))


def _number(pixels: Array, side: int) -> Array:
    """Blocks (row, column) around each that tell something."""
    counted = (pixels > 0).astype(np.float64)
    number: Array = uniform_filter(counted, side, mode="constant") * side**2
    return np.maximum(number, 1.0)


def _excess(blocks: _Blocks, variances: Array, least: Array | float, number: float) -> Array:
    """Deviation (row, column) [K] by a number of changes that exceed so much of their noise."""
    variance, noise = _local_mean(blocks.pixels, variances, _SIDE)
    excess = np.maximum(variance - noise, 0.0)
    return np.asarray(np.sqrt(np.where(excess > least * noise, number * excess, 0.0)))


def _leak(events: _Events) -> Array:
    """Deviation (row, column) of the share of the reflection that is left, over the events."""
    cross, energy = _local_mean(events.pixels, events.products, _EVENT_SIDE)
    remainder, reflection, _ = _local_mean(events.pixels, events.noise, _EVENT_SIDE)
    freedom = _local_mean(events.pixels, events.freedom, _EVENT_SIDE)
    energy = np.where(energy > _CONTRAST * freedom * reflection, energy, 0.0)
    share = quotient(cross, energy, 0.0)
    number = _number(events.pixels, _EVENT_SIDE)
    noise = remainder * (energy + freedom * reflection) / number
    variance = quotient(noise, energy**2, 0.0)
    # Mean square of the events' shares, less noise, by the weight of each: what all events leave
    # alike is an error of the ratio, too.
    weight = quotient(energy, energy.sum(axis=0) + 0.0 * energy, 0.0)
    scatter = (weight * (share**2 - variance)).sum(axis=0)
    doubt = np.sqrt(2.0 * ((weight * variance) ** 2).sum(axis=0))
    return np.asarray(np.sqrt(np.where(scatter > _SIGMAS * doubt, scatter, 0.0)))


def _block_sums(film: Array, width: int, side: int = _BLOCK) -> Array:
    """Sums (time, block) over the blocks of a film (time, pixel) of an image's width."""
    image = film.reshape(len(film), -1, width)
    for axis in (1, 2):
        image = np.add.reduceat(image, range(0, image.shape[axis], side), axis=axis)
    return np.asarray(image.reshape(len(film), -1))


def _of_rows(
    inputs: Inputs, result: xr.Dataset, reading: Reading
) -> tuple[_Blocks, _Events, tuple[Array, Array]]:
    """Averages over the blocks of some rows, and what they tell of the frames' levels."""
    rows, signals, reflections, frames, pixels, gain = reading
    ratio = result["reflection_ratio"].values[inputs.bands, rows].reshape(len(signals), -1)
    pixels = pixels & np.isfinite(ratio).all(axis=0)
    # Number the blocks, and count their pixels.
    width = result.sizes["x"]
    shape = -(-pixels.size // width // _BLOCK), -(-width // _BLOCK)
    row, column = np.divmod(np.arange(pixels.size), width)
    place = np.where(pixels, row // _BLOCK * shape[1] + column // _BLOCK, -1)
    number = _block_sums(1.0 * pixels[np.newaxis], width)[0]
    # Weigh the bands, and average what is left beside the object, and the reflection.
    terms = _weights(np.where(pixels, ratio, 0.5), inputs.noise[inputs.bands, None] * gain)
    weights, noise = (np.where(pixels, term, 0.0) for term in terms)
    # A span of time is an octave beyond the smooth functions, half of an event.
    length = _length(frames.size)
    event, half = np.divmod(np.flatnonzero(frames), length)
    span = np.unique(2 * event + (2 * half >= length), return_inverse=True)[1]
    sums = np.zeros((2, signals.shape[1], number.size))
    for chunk in stretches(signals[0]):
        sums[0, chunk] = _block_sums(np.einsum("btp,bp->tp", reflections[:, chunk], weights), width)
        sums[1, chunk] = _block_sums(signals[0, chunk] * pixels, width)
    single = _single_pixels(inputs, signals, weights, frames, place, number.size)
    release()
    # Take the smooth functions out, for changes and for events, and sum over means and events.
    basis = smooth_functions(inputs.capture, frames).functions
    noise, filled = _block_sums(noise, width), np.maximum(number, 1.0)
    remainder, variances = _means(inputs, number, noise, sums, basis)[::2]
    mean_weights, mean_noise = _block_sums(weights, width) / filled, noise[0] / filled**2
    levels = _levels(mean_weights, mean_noise, remainder, frames, shape)
    # Deviations of objects in pieces of time hold a part already.
    stated, start = np.zeros(pixels.size), rows.start * width
    divided = pixels & inputs.division[:, start : start + pixels.size].any(axis=0)
    if divided.any():
        film = result["object_temperature_std"].values[:, rows].reshape(-1, pixels.size)
        stated[divided] = np.nanmean(np.square(film[:, divided]), axis=0)
    stated = _block_sums(stated[np.newaxis], width)[0] / filled
    means = np.eye(span[-1] + 1)[span].T / np.bincount(span)[:, np.newaxis]
    leverage = np.mean(np.sum(means**2, axis=1) - np.sum((means @ basis) ** 2, axis=1))
    rough = np.stack([np.mean((means @ remainder) ** 2, axis=0), leverage * variances[0] + stated])
    blocks = np.where(number < 0.5 * _BLOCK**2, 0.0, number), rough, single
    changes = _Blocks(*(values.reshape(*values.shape[:-1], *shape) for values in blocks))
    return changes, _events(inputs, number, noise, sums, basis, event, shape[1]), levels


def _events(
    inputs: Inputs, number: Array, noise: Array, sums: Array, basis: Array, event: Whole, width: int
) -> _Events:
    """What reflections leave in each event, of blocks that are wider than those of changes."""
    size = _BLOCK**2 * _block_sums(np.ones((1, number.size)), width, _WIDER)[0]
    number = _block_sums(number[np.newaxis], width, _WIDER)[0]
    noise = _block_sums(noise, width, _WIDER)
    sums = np.array([_block_sums(film, width, _WIDER) for film in sums])
    remainder, reflection, noise = _means(inputs, number, noise, sums, basis)
    events = np.eye(event[-1] + 1)[event].T
    freedom = np.outer(events @ (1.0 - np.sum(basis**2, axis=1)), np.ones(number.size))
    averages: tuple[Array, ...] = (
        np.where(number < 0.5 * size, 0.0, number),
        noise,
        np.stack([events @ (remainder * reflection), events @ reflection**2])
        - freedom * noise[2:0:-1, np.newaxis],
        freedom,
    )
    width = -(-width // _WIDER)
    return _Events(*(values.reshape(*values.shape[:-1], -1, width) for values in averages))


def _means(
    inputs: Inputs, number: Array, noise: Array, sums: Array, basis: Array
) -> tuple[Array, Array, Array]:
    """Remainder and reflection (time, block) beside smooth functions; variances (3, block)."""
    filled = np.maximum(number, 1.0)
    noise, means = noise / filled**2, sums / filled
    remainder, reflection = means - basis @ (basis.T @ means)
    if inputs.displacement is not None or np.any(schema.noise_factor(inputs.capture) < 1.0):
        jumps = np.diff(remainder, 2, axis=0)  # neighbours share noise
        noise[0] = np.maximum(noise[0], np.mean(jumps**2, axis=0) / 6.0)
    return remainder, reflection, noise


def _levels(
    weights: Array, noise: Array, remainder: Array, frames: Mask, shape: tuple[int, int]
) -> tuple[Array, Array]:
    """Normal equations of what each frame has in common, see `Misfit.levels`."""
    precise = quotient(weights, noise, 0.0)
    windows = np.array_split(np.arange(noise.size).reshape(shape), _WINDOWS, axis=1)
    places = [window.ravel() for window in windows]
    force = np.zeros((_WINDOWS, len(weights), frames.size))
    force[..., frames] = [precise[:, place] @ remainder[:, place].T for place in places]
    return np.array([precise[:, place] @ weights[:, place].T for place in places]), force


def _single_pixels(
    inputs: Inputs, signals: Array, weights: Array, frames: Mask, place: Whole, blocks: int
) -> Array:
    """Variances (2, 2, block) [K^2] of single pixels' means: measured, and of white noise."""
    # Differences of neighbours, which have the object's rapid changes in common.
    column = np.arange(place.size - 1) % inputs.capture.sizes["x"]
    middle = np.flatnonzero(column % _BLOCK == 1)
    mask = (place[middle - 1] == place[middle]) & (place[middle] == place[middle + 1])
    middle = middle[mask & (place[middle] >= 0)]
    segment, length = schema.segments(inputs.capture)[frames], _length(len(frames)) // 2
    segments = segment[: len(segment) // length * length].reshape(-1, length)

    # Of all changes, and of the smaller: rapid heating at some time in each pixel is no noise.
    def variance(films: Array, segments: Whole) -> Array:
        squares = np.diff(films, 2, axis=0)[segments[:-2, 0] == segments[2:, -1]] ** 2
        smaller = np.sort(squares, axis=0)[: int(_STEADY * len(squares))]
        chosen = (squares, 36.0), (smaller, 36.0 * _OF_ALL)
        return np.stack([data.sum(axis=0) / (times * max(len(data), 1)) for data, times in chosen])

    def compared(middle: Whole) -> list[Array]:
        values = np.zeros((len(segment), middle.size))
        for pixels, share in ((middle - 1, -1.0), (middle, 2.0), (middle + 1, -1.0)):
            for film, weight in zip(signals, weights, strict=True):
                values += share * weight[pixels] * film.take(pixels, axis=1)
        means = values[: segments.size].reshape(*segments.shape, -1).mean(axis=1)
        return [variance(means, segments), variance(values, segment[:, np.newaxis]) / length]

    # Second differences in time, too, of means over some frames and of frames; none across a
    # shutter event. Of independent noise both have 36 times its variance.
    squares = np.dstack([compared(it) for it in np.array_split(middle, _SIDE)]).swapaxes(0, 1)
    # Between frames that were interpolated in time, noise differs less than means of them tell.
    white = np.square(inputs.noise / schema.noise_factor(inputs.capture))
    rapid = white * np.square(inputs.capture.attrs.get("rapid_noise_factor", 1.0))
    white, rapid = (term[inputs.bands] @ np.square(weights[:, middle]) for term in (white, rapid))
    squares[:, 1] *= quotient(white, rapid, 1.0)
    sums = [[np.bincount(place[middle], values, blocks) for values in kinds] for kinds in squares]
    return np.array(sums) / np.maximum(np.bincount(place[middle], minlength=blocks), 1.0)


def read(inputs: Inputs, result: xr.Dataset, rows: slice) -> tuple[Array, Mask, Mask, Array]:
    """As `tiles.read`, with an object that changes rapidly at its place in the first band."""
    signals, frames, pixels, gain = tiles.read(inputs, rows)
    if inputs.displacement is None or not inputs.division.any():
        return signals, frames, pixels, gain
    source = inputs.displacement.source(rows)
    weights = inputs.displacement.weights(rows, source)
    film = result["object_temperature"].values[:, source][frames]
    within = slice(rows.start - source.start, rows.stop - source.start)
    missing = ~np.isfinite(film).all(axis=0)
    pixels &= abs(weights) @ missing.ravel() == 0.0
    # Displaced cameras see the object resampled as a product: W [e_m U_m(x)].
    for order, band in enumerate(inputs.bands[1:], 1):
        curve = inputs.curves[band]
        emitted = curve.signal(np.where(missing, curve.reference, film)) - curve.reference
        emitted *= result["emissivity"].values[band, source]
        np.nan_to_num(emitted, copy=False)
        shown = (weights @ emitted.reshape(len(film), -1).T).T
        signals[order] -= shown - emitted[:, within].reshape(shown.shape)
    return signals, frames, pixels, gain


def reflected(inputs: Inputs, result: xr.Dataset, rows: slice) -> Reading:
    """Read some rows, and take the object's signal from those of pixels without a flag."""
    signals, frames, pixels, gain = read(inputs, result, rows)
    film = result["object_temperature"].values[:, rows].reshape(len(frames), -1)[frames]
    emissivity = result["emissivity"].values[inputs.bands, rows].reshape(len(signals), -1)
    # A bridged sample has no object temperature: it is interpolated between measured samples.
    pixels &= (result["status"].values[rows].ravel() == 0) & np.isfinite(emissivity).all(axis=0)
    finite = np.isfinite(film)
    pixels &= np.mean(finite, axis=0) > 1.0 - MOST_BRIDGED
    film = film if finite.all() else smooth.bridge(film, pixels)
    reflections, shares = signals.copy(), np.where(pixels, emissivity, np.nan).astype(np.float64)
    responses = planes.responses_of(tuple(inputs.curves[band] for band in inputs.bands))
    planes.without_object(reflections, film, shares, responses)
    return Reading(rows, signals, reflections, frames, pixels, gain)


def object_weights(inputs: Inputs, result: xr.Dataset) -> Array:
    """Weights (band, y, x) of the bands, in their order, for the object's signal."""
    ratio = result["reflection_ratio"].values[inputs.bands]
    sound = (result["status"].values == 0) & np.isfinite(ratio).all(axis=0)
    weights = np.zeros(ratio.shape)
    noise = np.tile(inputs.noise[inputs.bands, np.newaxis], np.count_nonzero(sound))
    weights[:, sound] = _weights(ratio[:, sound], noise)[0]
    return weights[np.argsort(inputs.bands)]


def _length(frames: int) -> int:
    """Frames of an event, which is as long as two smooth functions have changes of sign."""
    return frames // min(smooth.HIGHEST_ORDER, frames // 4)


def _weights(ratio: Array, deviation: Array) -> tuple[Array, Array]:
    """Weights (band, pixel) for the object's signal at the least noise; variances (3, pixel)."""
    contrast = (1.0 - ratio[1:]) / ratio[1:]
    weights = contrast / ((deviation[1:] / ratio[1:]) ** 2 + deviation[0] ** 2)
    weights /= np.sum(weights * contrast, axis=0)
    result = np.concatenate([-weights.sum(axis=0, keepdims=True), weights / ratio[1:]])
    total, first = np.sum((result * deviation) ** 2, axis=0), deviation[0] ** 2
    # Variances of the weighted sum and of the reflection, and their covariance [K^2].
    return result, np.stack([total, first, result[0] * first])


def widen(inputs: Inputs, result: xr.Dataset, misfit: Misfit) -> None:
    """Widen the deviations of a result by what the model leaves, in place."""
    reference = inputs.bands[0]
    emissivity, ratio = result["emissivity"].values[reference], result["reflection_ratio"].values
    deviation = np.maximum(misfit.change, misfit.single)
    sound = (result["status"].values == 0) & ((misfit.leak > 0.0) | (deviation > 0.0))
    # Of the ratios, whose error makes a leak, and of the emissivities that follow from them.
    ratios = np.where(sound, misfit.leak * (1.0 - ratio), 0.0)
    emissivities = (1.0 - emissivity) * ratios
    covariance = result["emissivity_covariance"].values
    covariance += np.where(sound, emissivities[:, np.newaxis] * emissivities, 0.0)
    for name, added in (("reflection_ratio_std", ratios), ("emissivity_std", emissivities)):
        result[name].values[:] = np.where(sound, np.hypot(result[name].values, added), result[name])
    # Of the object in every frame, and of the reflection beside it.
    films = [result[name].values for name in FILMS]
    curve = inputs.curves[reference]
    for row in map(int, np.flatnonzero(sound.any(axis=1))):
        columns = np.flatnonzero(sound[row])
        chosen = [film[:, row].take(columns, axis=1).astype(np.float64) for film in films]
        leak, change = misfit.leak[row, columns], deviation[row, columns]
        share = emissivity[row, columns]
        counted = np.isfinite(chosen[0]).sum(axis=0)
        mean = quotient(np.nansum(chosen[0], axis=0), counted, curve.reference)
        slope = curve.slope(mean)
        contrast = (1.0 - share) * (chosen[0] - chosen[2])
        added = np.hypot(leak * contrast, change / slope)
        films[1][:, row, columns] = np.hypot(chosen[1], added)
        films[3][:, row, columns] = np.hypot(chosen[3], share / (1.0 - share) * added)
        release()
