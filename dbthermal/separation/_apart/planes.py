r"""What each pixel reflects, along a few functions of time: maps that can be blurred.

Less the signals of the object x and the bend of the background y, the bands are proportional,

.. math:: z_m - e_m u_m(x) - (1 - e_m) [u_m(y) - u_1(y)] = (1 - e_m) u_1(y)

and their products with functions of time V, outside the smooth ones, hold the ratios of the bands.
V spans most of the rapid changes that the reference band shows: a projection leaves the ratios as
they are, and a map of each product is blurred at once, not a film.
"""

from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr
from numpy.polynomial import Polynomial

from dbthermal import _smooth as smooth
from dbthermal import schema
from dbthermal._arrays import Array, Mask, release, select
from dbthermal._compiled import compiled
from dbthermal.response import Curve
from dbthermal.separation import _quality as quality
from dbthermal.separation import _tiles as tiles
from dbthermal.separation._apart import equations as system
from dbthermal.separation._apart.equations import Floats
from dbthermal.separation._inputs import Inputs
from dbthermal.separation._subspace import reflection_ratio
from dbthermal.separation._subspace.kernels import polynomial

TAIL: Final = 3.0
"""Deviations of the blur beyond which it has no weight."""

# Functions of the rapid changes, pixels that make them, and degree of the responses' polynomials.
_PLANES, _SAMPLE = 128, 1024
_DEGREE: Final = 7
_LEAST_SHARE: Final = 1e-3  # share of a neighbourhood without which a blurred pixel is none [1]
_STEP: Final = 0.1  # of the background, by which the slope of a bend is told [K]
# Deviations of noise across the axis of the ratios from which the bands are apart.
_SIGMAS: Final = 8.0


@dataclass(frozen=True)
class Scatters(tiles.Pixels):
    """Scatter of the reflected signals of each pixel, and their noise."""

    scatter: Array  # whitened, less that of the noise (band, band, pixel) [1]
    freedom: Array  # degrees of freedom of the noise (pixel)
    noise: Array  # by which it is whitened (band, pixel) [K]
    usable: Mask  # (pixel)

    @property
    @np.errstate(invalid="ignore", divide="ignore")
    def ratio(self) -> Array:
        """Reflection ratios (band, pixel) [1]: the principal axis."""
        return reflection_ratio.principal_ratio(np.moveaxis(self.scatter, -1, 0), self.noise)

    @np.errstate(invalid="ignore", divide="ignore", over="ignore")
    def variance(self, ratio: Array) -> Array:
        """Variance (band, pixel) [1] of ratios (eq. 4); infinite where nothing is reflected."""
        inverse = reflection_ratio.inverse_energy(self.scatter, ratio, self.noise, self.freedom)
        return np.asarray(inverse * (self.noise**2 + (ratio * self.noise[0]) ** 2))

    @property
    def apart(self) -> Mask:
        """Pixels whose bands do not show the same: what is across the axis is no noise."""
        bands, trace = len(self.scatter), np.einsum("bbp->p", self.scatter)
        matrices = np.moveaxis(self.scatter, -1, 0)
        remainder = trace - np.linalg.eigvalsh(matrices)[:, -1]
        return np.asarray(remainder > _SIGMAS * np.sqrt(2.0 * (bands - 1) * self.freedom))

    @np.errstate(invalid="ignore", divide="ignore", over="ignore")
    def uncontradicted(self, material: tiles.Material) -> tiles.Material:
        """Material with the ratios of a pixel whose bands contradict it, or that has none."""
        white = self.freedom[:, np.newaxis, np.newaxis] * np.eye(len(self.noise))
        matrices = np.moveaxis(self.scatter, -1, 0) + white
        # As where the second camera sees another material at p than the first at r. There the
        # method has the pixel's ratios, too (`pixel.ratios`), and pixels paired with p its object.
        conflict = self.usable & ~reflection_ratio.agrees(matrices, material.ratio / self.noise)
        ratio = self.ratio
        inverse = reflection_ratio.inverse_energy(self.scatter, ratio, self.noise, self.freedom)
        return replace(
            material,
            ratio=np.where(conflict, ratio, material.ratio),
            inverse_energy=np.where(conflict, inverse, material.inverse_energy),
            emissivity=np.where(conflict, np.nan, material.emissivity),
        )


@dataclass(frozen=True)
class Planes:
    """Reflected signals along functions of time, the bands paired by what they reflect."""

    maps: npt.NDArray[np.float32]  # (band, function, y, x) [K]
    smooth: npt.NDArray[np.float32]  # straight signals on smooth functions (band, column, pixel)
    object_part: Array  # these functions, less the steps of the camera in them (time, column)
    steps: int  # columns of every order, beside the constant
    noise: Array  # of a band's samples, resampled or not (2, band, y, x) [K]
    freedom: Array  # sum of the functions' squares (y, x)
    usable: Mask  # (y, x)
    bend: Array  # change of a straight signal with the first band's own (band, pixel) [1]

    @np.errstate(invalid="ignore", divide="ignore", over="ignore")
    def combined(self, weights: Array, pixels: Any) -> tuple[Array, Array]:
        """Combination (column, pixel) [K] of the bands by weights, and its variance at a frame."""
        values = np.einsum("bp,bcp->cp", weights, self.smooth[..., pixels])
        noise = self.noise[0].reshape(len(weights), -1)[:, pixels]
        variance = np.maximum(((weights * noise) ** 2).sum(axis=0), reflection_ratio.TINY)
        frames, orders = len(self.object_part), len(values) - self.steps
        energy = np.cumsum(values[::-1] ** 2, axis=0)[::-1][self.steps :] / variance
        lowest = min(reflection_ratio.LOWEST_ORDER, orders - 1)
        cost = energy[lowest:] + np.arange(lowest, orders)[:, np.newaxis] * np.log(frames)
        # As many functions as the Bayesian information criterion says, plus one.
        order = np.minimum(lowest + cost.argmin(axis=0) + 1, orders)
        values[np.arange(len(values))[:, np.newaxis] >= self.steps + order] = 0.0
        return values, variance * (order + self.steps) / frames

    @np.errstate(invalid="ignore", divide="ignore", over="ignore")
    def scatters(self, blur: float = 0.0) -> Scatters:
        """Scatter of each pixel, of maps that are blurred by a deviation [pixel]."""
        bands, pixels = len(self.maps), self.usable.size
        noise, maps = self.noise[0].reshape(bands, -1), self.maps
        if blur > 0.0:
            reach = int(TAIL * blur)
            taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / blur) ** 2)
            taps /= taps.sum()
            share = np.maximum(_smoothed(self.usable * 1.0, taps), _LEAST_SHARE)
            maps = _smoothed(maps, taps.astype(np.float32)) / share.astype(np.float32)
            # White noise before the resampling: a blur does not see what that did to it.
            factor = np.sqrt(_smoothed(self.usable * 1.0, taps**2)) / share
            noise = (self.noise[1] * factor).reshape(bands, -1)
        flat, freedom = maps.reshape(bands, -1, pixels), self.freedom.ravel()
        scatter = np.empty((bands, bands, pixels))
        bend = self.bend * noise[0] / noise
        for first in range(bands):
            for second in range(first, bands):
                total = np.einsum("fp,fp->p", flat[first], flat[second])
                # The other bands' bend holds the background's noise, which is the first band's.
                share = (first == second) + bend[first] * bend[second] - (first == 0) * bend[second]
                total = total / (noise[first] * noise[second]) - freedom * share
                scatter[first, second] = scatter[second, first] = total
        usable = self.usable.ravel()
        scatter[..., ~usable] = 0.0
        return Scatters(scatter, freedom, noise, usable)


def project(inputs: Inputs, result: xr.Dataset, emissivity: Floats, threads: Executor) -> Planes:
    """Planes of a capture, by the object in a result of it and emissivities (band, pixel) [1]."""
    bands, (height, width) = inputs.bands, result["status"].shape
    rapid, columns = _functions(inputs), system.smooth_functions(inputs.capture)
    maps = np.zeros((len(bands), rapid.shape[1], height, width), np.float32)
    straight = np.zeros((len(bands), columns.functions.shape[1], height * width), np.float32)
    noise, freedom = np.ones((2, len(bands), height, width)), np.ones((height, width))
    usable = np.zeros((height, width), dtype=bool)
    bend = np.zeros((len(bands), height * width))
    noise[1] = (inputs.noise / schema.noise_factor(inputs.capture))[bands, None, None]
    responses = responses_of(tuple(inputs.curves[band] for band in bands))
    film = result["object_temperature"].values.reshape(len(rapid), -1)

    def block(rows: slice) -> None:
        for cut in tiles.cut(inputs, rows):
            for frames, pixels, tile in cut.sections:
                places = cut.places[pixels]
                row, column = np.divmod(places, width)
                # Functions of frames that some pixels lack: no longer orthogonal to the smooth.
                slow = columns.functions[frames]
                inverse = np.linalg.solve(slow.T @ slow, slow.T)
                quick = rapid[frames] - slow @ (inverse @ rapid[frames])
                x = select(film, places) if frames.all() else film[np.ix_(frames, places)]
                shares = emissivity[:, places].astype(np.float64)
                inverse, quick = inverse.astype(np.float32), quick.astype(np.float32)
                signals = np.ascontiguousarray(tile.signals, np.float32)
                bend[:, places] = _straighten(signals, x, shares, responses)
                for band, signal in enumerate(signals):
                    straight[band][:, places] = inverse @ signal
                if inputs.difference is not None:
                    differences = inputs.difference(places)[:, frames]
                    for band, changes in enumerate(differences, 1):
                        straight[band][:, places] += inverse @ changes
                without_object(signals, x, shares, responses)
                for images, signal in zip(maps.reshape(*maps.shape[:2], -1), signals, strict=True):
                    for image, values in zip(images, quick.T @ signal, strict=True):
                        image[places] = values  # all at once take four times as long
                noise[0][:, row, column] = tile.scaled(tile.noise)
                freedom[row, column] = np.sum(quick**2, dtype=np.float64)
                usable[row, column] = True
        release()

    list(threads.map(block, inputs.blocks))
    return Planes(maps, straight, columns.object_part, columns.steps, noise, freedom, usable, bend)


class Response(NamedTuple):
    """Responses of the bands, as polynomials of ten rising coefficients."""

    series: tuple[float, ...]  # signal of the first less the reference [K], over the range
    middle: float  # of the range [K]
    half: float
    bends: Floats  # of u_m - u_1 by u_1 less the reference (band, 10) [K]


@compiled
def _bend(response: Response, band: int) -> tuple[float, ...]:
    """Coefficients of a band's bend, of a length that is compiled into its loops."""
    c = response.bends[band]
    return (c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8], c[9])


@compiled
def _emitted(response: Response, temperature: float) -> float:
    """Signal [K] of a blackbody in the first band less the reference."""
    return float(polynomial(response.series, (temperature - response.middle) / response.half))


@compiled
def _straighten(
    signals: Array, film: npt.NDArray[np.float32], emissivity: Array, response: Response
) -> Array:
    """Take the background's bend out of signals [K], in place; its mean slope (band, pixel) [1]."""
    bands, frames, pixels = signals.shape
    change = np.zeros((bands, pixels))
    low, high = polynomial(response.series, -1.0), polynomial(response.series, 1.0)
    for band in range(1, bands):
        coefficients = _bend(response, band)
        for t in range(frames):
            for p in range(pixels):
                share, factor = emissivity[0, p], 1.0 - emissivity[band, p]
                # What the first band holds beside the object; if unknown, nothing is taken out.
                emitted = share * _emitted(response, film[t, p])
                background = (signals[0, t, p] - emitted) / (1.0 - share)
                factor = 0.0 if np.isnan(background) else factor
                background = low if np.isnan(background) else min(max(background, low), high)
                bend = polynomial(coefficients, background)
                signals[band, t, p] -= factor * bend
                # Change of the bend with the first band's signal.
                rate = (polynomial(coefficients, background + _STEP) - bend) / (_STEP * frames)
                change[band, p] += factor * rate / (1.0 - share) if factor != 0.0 else 0.0
    return change


@compiled
def without_object(
    signals: Array, film: npt.NDArray[np.float32], emissivity: Array, response: Response
) -> None:
    """Take an object's film (time, pixel) [K] out of signals (band, time, pixel) [K], in place."""
    bands, frames, pixels = signals.shape
    for band in range(bands):
        coefficients = _bend(response, band)
        for t in range(frames):
            for p in range(pixels):
                signal = _emitted(response, film[t, p])
                object_part = emissivity[band, p] * (signal + polynomial(coefficients, signal))
                signals[band, t, p] -= 0.0 if np.isnan(object_part) else object_part


def responses_of(curves: tuple[Curve, ...]) -> Response:
    """Polynomials of the responses of the bands, the quietest first."""
    low, high = curves[0].lowest, curves[0].highest
    kelvin = np.linspace(low, high, 64)
    signal = curves[0].signal(kelvin) - curves[0].reference
    series = np.pad(Polynomial.fit(kelvin, signal, _DEGREE, [low, high]).coef, (0, 9 - _DEGREE))
    bends = np.pad(system.bends(curves), ((1, 0), (0, 1)))
    return Response(tuple(series.tolist()), 0.5 * (low + high), 0.5 * (high - low), bends)


def _functions(inputs: Inputs) -> Array:
    """Functions (time, function) of most of the rapid changes of the reference band."""
    capture = inputs.capture
    counts, frames = quality.sample(capture, _SAMPLE, bridged=True)
    basis = system.smooth_functions(capture, frames).functions
    signals = counts[inputs.bands[0]]
    rapid = smooth.leading(signals.T, _PLANES, basis)
    functions = np.zeros((frames.size, rapid.shape[1]))
    functions[frames] = rapid
    return functions


def _smoothed(maps: npt.NDArray[Any], taps: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Maps (..., y, x) with the weights applied along either side, zero outside."""
    result = np.zeros_like(maps)
    images = (film.reshape(-1, *maps.shape[-2:]) for film in (np.ascontiguousarray(maps), result))
    _smooth(*images, taps)
    return result


@compiled
def _smooth(images: Any, result: Any, taps: Any) -> None:
    """Sums of images (image, y, x) with weights along either side, in place, zero before."""
    count, height, width = images.shape
    reach, rows = taps.size // 2, np.empty((height, width), images.dtype)
    for image in range(count):
        rows[:] = 0.0
        for y in range(height):
            for line in range(max(y - reach, 0), min(y + reach + 1, height)):
                weight, source = taps[line - y + reach], images[image, line]
                for x in range(width):
                    rows[y, x] += weight * source[x]
            out = result[image, y]
            for step in range(-reach, reach + 1):
                for x in range(max(-step, 0), width - max(step, 0)):
                    out[x] += taps[step + reach] * rows[y, x + step]
