r"""What each pixel reflects, along a few functions of time: maps that can be blurred.

Less the signals of the object x and the bend of the background y, the bands are proportional,

.. math:: z_m - e_m u_m(x) - (1 - e_m) [u_m(y) - u_1(y)] = (1 - e_m) u_1(y)

and their products with functions of time V, outside the smooth ones, hold the ratios of the bands.
V spans most of the rapid changes that the reference band shows: a projection leaves the ratios as
they are, and a map of each product is blurred at once, not a film.
"""

from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from numpy.polynomial import Polynomial
from scipy.ndimage import correlate1d

from dbthermal import _smooth as smooth
from dbthermal._arrays import Array, Mask, release
from dbthermal._compiled import compiled
from dbthermal.response import Curve
from dbthermal.separation import _quality as quality
from dbthermal.separation import _tiles as tiles
from dbthermal.separation._inputs import Inputs
from dbthermal.separation._subspace import reflection_ratio

TAIL: Final = 3.0
"""Deviations of the blur beyond which it has no weight."""

# Pixels whose rapid changes make the functions, and degree of the responses' polynomials.
_SAMPLE: Final = 1024
_DEGREE: Final = 7
# Share of a neighbourhood without which a blurred pixel is none [1].
_LEAST_SHARE: Final = 1e-3
# Deviations of noise across the axis of the ratios from which the bands are apart.
_APART: Final = 8.0


@dataclass(frozen=True)
class Scatters:
    """Scatter of the reflected signals of each pixel, and their noise."""

    scatter: Array  # whitened, less that of the noise (band, band, pixel) [1]
    freedom: Array  # degrees of freedom of the noise (pixel)
    noise: Array  # by which it is whitened (band, pixel) [K]

    @property
    def ratio(self) -> Array:
        """Reflection ratios (band, pixel) [1]: the principal axis."""
        axis = np.linalg.eigh(np.moveaxis(self.scatter, -1, 0))[1][..., -1].T * self.noise
        return np.asarray(axis / axis[0])

    def variance(self, ratio: Array) -> Array:
        """Variance (band, pixel) [1] of ratios (eq. 4); infinite where nothing is reflected."""
        whitened = ratio / self.noise
        length = (whitened**2).sum(axis=0)
        energy = np.einsum("bp,bcp,cp->p", whitened, self.scatter, whitened) / length**2
        inverse = reflection_ratio.inverse_energy(np.maximum(energy, 0.0), length, self.freedom)
        return np.asarray(inverse * (self.noise**2 + (ratio * self.noise[0]) ** 2))

    @property
    def apart(self) -> Mask:
        """Pixels whose bands do not show the same: what is across the axis is no noise."""
        bands, trace = len(self.scatter), np.einsum("bbp->p", self.scatter)
        whole = np.moveaxis(self.scatter, -1, 0)
        across = trace - np.linalg.eigvalsh(whole)[:, -1]
        return np.asarray(across > _APART * np.sqrt(2.0 * (bands - 1) * self.freedom))

    def whitened(self, noise: Array) -> Array:
        """Scatter (band, band, pixel) [1] whitened by another noise (band) [K]."""
        scale = self.noise / noise[:, np.newaxis]
        return np.asarray(self.scatter * scale * scale[:, np.newaxis])


@dataclass(frozen=True)
class Planes:
    """Reflected signals along functions of time, the bands paired by what they reflect."""

    maps: npt.NDArray[np.float32]  # (band, function, y, x) [K]
    noise: Array  # of a band's samples, resampled or not (2, band, y, x) [K]
    freedom: Array  # sum of the functions' squares (y, x)
    usable: Mask  # (y, x)

    def scatters(self, blur: float = 0.0) -> Scatters:
        """Scatter of each pixel, of maps that are blurred by a deviation [pixel]."""
        bands, pixels = len(self.maps), self.usable.size
        noise, maps = self.noise[0].reshape(bands, -1), self.maps
        if blur > 0.0:
            taps = _gaussian(blur)
            share = np.maximum(_smoothed(self.usable * 1.0, taps), _LEAST_SHARE)
            maps = _smoothed(maps, taps.astype(np.float32)) / share.astype(np.float32)
            # White noise before the resampling: a blur does not see what that did to it.
            less = np.sqrt(_smoothed(self.usable * 1.0, taps**2)) / share
            noise = (self.noise[1] * less).reshape(bands, -1)
        flat, freedom = maps.reshape(bands, -1, pixels), self.freedom.ravel()
        scatter = np.empty((bands, bands, pixels))
        for first in range(bands):
            for second in range(first, bands):
                total = np.einsum("fp,fp->p", flat[first], flat[second])
                total = total / (noise[first] * noise[second]) - freedom * (first == second)
                scatter[first, second] = scatter[second, first] = total
        scatter[..., ~self.usable.ravel()] = 0.0
        return Scatters(scatter, freedom, noise)


def project(inputs: Inputs, result: xr.Dataset, threads: Executor) -> Planes:
    """Planes of a capture, of the object and background in a result of it."""
    bands, shape = inputs.bands, result["status"].shape
    functions = _functions(inputs)
    maps = np.zeros((len(bands), functions.shape[1], *shape), np.float32)
    noise, freedom = np.ones((2, len(bands), *shape)), np.ones(shape)
    usable = np.zeros(shape, dtype=bool)
    before = inputs.noise[bands] / _interpolated(inputs)[bands]
    responses = _polynomials([inputs.curves[band] for band in bands])
    films = [result[name].values for name in ("object_temperature", "background_temperature")]
    emissivity = result["emissivity"].values[bands]

    def block(rows: slice) -> None:
        for cut in tiles.cut(inputs, rows):
            for frames, pixels, tile in cut.parts:
                row, column = (
                    place[pixels] + part.start
                    for place, part in zip(
                        np.divmod(np.arange(pixels.size), cut.window[1].stop - cut.window[1].start),
                        cut.window,
                        strict=True,
                    )
                )
                rest = functions[frames]
                basis = _smooth_functions(tile.time, tile.segment)
                rest = rest - basis @ (basis.T @ rest)
                signals = np.ascontiguousarray(tile.signals)
                x, y = (film[frames][:, row, column] for film in films)
                shares = emissivity[:, row, column].astype(np.float64)
                _take_out(signals, x, y, np.nan_to_num(shares), *responses)
                for band, signal in enumerate(signals):
                    maps[band][:, row, column] = rest.T @ signal
                noise[0][:, row, column] = np.array(tile.noise)[:, np.newaxis]
                noise[1][:, row, column] = before[:, np.newaxis]
                freedom[row, column] = np.sum(rest**2)
                usable[row, column] = True
        release()

    list(threads.map(block, inputs.blocks))
    return Planes(maps, noise, freedom, usable)


@compiled
def _take_out(
    signals: Array,
    x: npt.NDArray[np.float32],
    y: npt.NDArray[np.float32],
    emissivity: Array,
    coefficients: Array,
    middle: float,
    half: float,
) -> None:
    """Take the object and the bend of the background out of signals (band, time, pixel) [K]."""
    bands, frames, pixels = signals.shape
    last = coefficients.shape[1] - 1
    for t in range(frames):
        for p in range(pixels):
            at_object, at_background = (x[t, p] - middle) / half, (y[t, p] - middle) / half
            known, bent = np.isfinite(at_object), np.isfinite(at_background)
            for band in range(bands):
                emitted, bend = coefficients[band, last], 0.0
                for degree in range(last - 1, -1, -1):
                    emitted = emitted * at_object + coefficients[band, degree]
                if band > 0:
                    for degree in range(last, -1, -1):
                        difference = coefficients[band, degree] - coefficients[0, degree]
                        bend = bend * at_background + difference
                share = emissivity[band, p]
                if known:
                    signals[band, t, p] -= share * emitted
                if bent:
                    signals[band, t, p] -= (1.0 - share) * bend


def _polynomials(curves: list[Curve]) -> tuple[Array, float, float]:
    """Signals less the reference (band, degree) of temperatures over a middle and a half [K]."""
    low, high = curves[0].lowest, curves[0].highest
    kelvin = np.linspace(low, high, 64)
    fits = [
        Polynomial.fit(kelvin, curve.signal(kelvin) - curve.reference, _DEGREE, [low, high])
        for curve in curves
    ]
    return np.array([fit.coef for fit in fits]), 0.5 * (low + high), 0.5 * (high - low)


def _interpolated(inputs: Inputs) -> Array:
    """Noise (band) [1] over that before a registration interpolated it."""
    capture = inputs.capture
    whole = np.ones(capture.sizes["band"])
    return np.asarray(capture["noise_factor"].values if "noise_factor" in capture else whole)


def _smooth_functions(time: Array, segment: Any) -> Array:
    """Smooth functions of time (time, column), with the steps of the camera."""
    order = min(reflection_ratio.HIGHEST_ORDER, time.size // 4)
    return smooth.subspace(time, order, segment=segment).functions


def _functions(inputs: Inputs) -> Array:
    """Functions (time, function) of most of the rapid changes of the reference band."""
    capture = inputs.capture
    counts, frames = quality.sample(capture, _SAMPLE)
    segment = capture["segment"].values.astype(np.intp)[frames] if "segment" in capture else None
    basis = _smooth_functions(capture["time"].values.astype(np.float64)[frames], segment)
    signals = counts[inputs.bands[0]]
    rapid = smooth.leading((signals - basis @ (basis.T @ signals)).T)
    functions = np.zeros((frames.size, rapid.shape[1]))
    functions[frames] = rapid
    return functions


def _gaussian(deviation: float) -> Array:
    """Weights of a Gaussian, which sum to 1."""
    reach = int(TAIL * deviation)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / deviation) ** 2)
    return np.asarray(weights / weights.sum())


def _smoothed(maps: npt.NDArray[Any], taps: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Maps (..., y, x) with the weights applied along either side, zero outside."""
    for axis in (-2, -1):
        maps = correlate1d(maps, taps, axis, mode="constant")
    return np.asarray(maps)
