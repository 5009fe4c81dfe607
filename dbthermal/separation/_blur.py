r"""Blurs that differ between the bands, of lenses, diffraction, or rough surfaces, made alike.

With Gaussian blurs of variances s, the rapid changes h of band m are those of the first, blurred,

.. math:: h_m / k_m - h_1 = c \nabla^2 h_1 + \delta h_1, \quad c = (s_m - s_1) / 2

with an error delta of the ratio that is common to a neighbourhood, and least squares over all
pixels. The band that is sharper is blurred, and c is sought again until nothing is left.
"""

from dataclasses import dataclass
from functools import partial
from typing import Final, TypeAlias

import numpy as np
import xarray as xr
from scipy import ndimage
from scipy.signal import fftconvolve

from dbthermal import _smooth as smooth
from dbthermal import schema
from dbthermal._arrays import Array, empty, quotient, release, select
from dbthermal._samples import without_gaps
from dbthermal.separation import _misfit as misfits
from dbthermal.separation._apart.equations import smooth_functions
from dbthermal.separation._inputs import Inputs
from dbthermal.separation._misfit import Misfit, Reading

_ROUNDS, _STEP, _SETTLED = 8, 4.0, 0.05  # turns, largest step [pixel^2], last step over the sum
_WINDOW: Final = 13  # pixels along a side of a neighbourhood with one error of the ratio
# Side [pixel] of what is one material, its largest ratio over the smallest, and the share of the
# pixels that must be so.
_BORDER, _MAX_RATIO, _MOSTLY = 7, 1.05, 0.2
# Blur of both bands [pixel^2], against noise: it leaves their difference as it is.
_BASE: Final = 2.0
_BROAD: Final = 25.0  # blur that tells what is broad [pixel^2]
_FEWEST: Final = 16  # rows and columns of an image, whose edges are left out, at least
_EDGE: Final = 6  # pixels at the image's edge that are left out
_CONTRAST: Final = 1.0  # variance of the changes over that of noise
# Deviations and size [pixel^2] of a difference that counts, and deviations in some rows from which
# it is sought in all: 0 to 2 in plain scenes, 8 to 25 for 0.5 and 1.3 pixels.
_SIGMAS, _SIZE, _HINT = 6.0, 0.1, 3.0
_LIMIT: Final = 100.0  # difference [pixel^2]: wider than that it is no blur
_BLOCKS: Final = 8  # of rows that tell it
# Share of what a blur of the object changes that must be for the better: of lenses .47 to .93, of
# rough surfaces -.5 to -.95; of objects without detail, whose blur does not matter, -.1 to .3.
_OF_LENS: Final = 0.4
_LEADING: Final = 64  # functions of time that hold most of the rapid changes of some rows
_blurred: Final = partial(ndimage.gaussian_filter, mode="nearest")

Sums: TypeAlias = tuple[float, float, float]
"""Of the normal equation of c: its force, its form, and the variance of the force."""


@dataclass(frozen=True)
class Equalised:
    """A capture whose bands are blurred alike in their rapid changes."""

    capture: xr.Dataset
    variances: Array  # of the blur of each band (band) [pixel^2]
    detail: Array  # deviation of the object's signal, if it is blurred as they are (y, x) [K]

    @property
    def sentence(self) -> str:
        """Sentence on how much the reflections in each band were blurred."""
        pairs = zip(self.capture["band"].values, np.sqrt(self.variances), strict=True)
        blurs = ", ".join(f"'{band}' {deviation:.2f}" for band, deviation in pairs)
        return (
            f"The bands are not equally sharp: reflections were blurred by {blurs} pixel, and the "
            "deviations hold what that may do to details of the object."
        )


def equalise(
    corrected: xr.Dataset, inputs: Inputs, result: xr.Dataset, misfit: Misfit
) -> Equalised | None:
    """Blur the sharper bands as much as the others, if they differ; None if not."""
    excess = np.zeros(len(inputs.bands))
    for hints in misfit.answers[sharpness]:
        for place, (force, _, variance) in enumerate(hints, 1):
            if force**2 > _HINT**2 * variance:
                excess[inputs.bands[place]] = _difference(inputs, result, place)
    variances = excess.max() - excess
    if not variances.any():
        return None
    # Smooth functions of time, fitted to the frames with samples, hold the object and its details.
    measured, frames = corrected["counts"], np.ones(corrected.sizes["time"], dtype=bool)
    functions = smooth_functions(inputs.capture, frames).functions.astype(np.float32)
    counts = empty(measured.shape, np.float32)
    maps = np.empty((len(counts), functions.shape[1], *counts.shape[2:]))
    for band, film in enumerate(counts):
        fit = functions.T.copy()
        for number, values in enumerate(measured.values[band]):
            valid = np.isfinite(values) & inputs.good
            film[number] = without_gaps(values, valid)
            fit[:, number] *= valid.any()
        fit = np.linalg.pinv(fit @ functions, hermitian=True) @ fit
        maps[band] = np.tensordot(fit, film, 1) / inputs.curves[band].reference_slope
        release()
    details, error = _details_of_object(maps, variances, inputs.noise)
    # Blur all else.
    for band, film in enumerate(counts):
        slope, deviation = inputs.curves[band].reference_slope, float(np.sqrt(variances[band]))
        outside = 1.0 - ndimage.gaussian_filter(np.ones(maps.shape[2:]), deviation, mode="constant")
        of_object = np.stack([maps[band], details[band]], axis=1)
        for frame, values, weights in zip(film, measured.values[band], functions, strict=True):
            slow, detail = slope * np.tensordot(weights, of_object, 1)
            rapid = _blurred(frame - slow, deviation)
            valid = np.isfinite(values) & inputs.good
            error[band] += valid * (outside * rapid / slope) ** 2
            frame[:] = np.where(valid, slow + detail + rapid, values)
        release()
    # Noise in the smooth functions stays as it was.
    remaining = np.array([_noise_after(variance) for variance in variances])
    noise = (1.0 - remaining) * functions.shape[1] * inputs.noise**2
    square = np.square(misfits.object_weights(inputs, result)) * (error.T + noise).T
    factor = np.sqrt(remaining) * schema.noise_factor(corrected)
    capture = corrected.assign(counts=measured.copy(data=counts), noise_factor=("band", factor))
    return Equalised(capture, variances, np.sqrt(square.sum(axis=0) / len(functions)))


def _details_of_object(maps: Array, variances: Array, noise: Array) -> tuple[Array, Array]:
    """Details that blunter bands lack of the object (band, function, y, x) [K].

    In a neighbourhood the maps of a band are nearly linear in those of another that is as sharp,
    however temperature and emissivities vary. Behind lenses they are so in the sharpest band's,
    blurred as its reflections are, and lack what that takes. A rough surface blurs no object. Also
    returned are the squared errors (band, y, x) of the sum over time.
    """
    details, error, gains = np.zeros(maps.shape), np.zeros((len(maps), *maps.shape[2:])), []
    sharp, level = maps[variances.argmax()], noise[variances.argmax()] ** 2
    for band in np.flatnonzero(variances < variances.max()):
        excess = variances.max() - variances[band]
        blurred = _blurred_maps(sharp, excess)
        explained, slope = _explained(maps[band], blurred, level * _noise_after(excess))
        # The first function, of the mean, holds fixed patterns, too.
        gains.append((explained - _explained(maps[band], sharp, level)[0])[1:])
        details[band] = slope * (sharp - blurred)
        share = quotient(explained, _local(maps[band] ** 2) - _local(maps[band]) ** 2, 0.0)
        error[band] = np.sum(details[band] ** 2 * np.maximum(1.0 - share, 0.0), axis=0)
    gain = np.array(gains)[..., _EDGE:-_EDGE, _EDGE:-_EDGE]
    if gain.sum() > _OF_LENS * np.abs(gain).sum():
        return details, error
    blurred = np.stack([*map(_blurred_maps, maps, variances)])
    return np.zeros(maps.shape), np.sum((blurred - maps) ** 2, axis=1)


def _explained(target: Array, maps: Array, noise: float) -> tuple[Array, Array]:
    """Variance of maps (..., y, x) that others explain in a neighbourhood, and the slope."""
    variance = np.maximum(_local(maps**2) - _local(maps) ** 2 - noise, noise)
    product = _local(maps * target) - _local(maps) * _local(target)
    return product**2 / variance, product / variance


def _local(maps: Array) -> Array:
    return np.asarray(ndimage.uniform_filter(maps, _WINDOW, axes=(-2, -1)))


def _noise_after(variance: float) -> float:
    """Variance of white noise after a blur [pixel^2] over that before."""
    deviation = float(np.sqrt(variance))
    return float(np.sum(_blurred(np.pad([[1.0]], 1 + int(4.0 * deviation)), deviation) ** 2))


def _blurred_maps(maps: Array, variance: float) -> Array:
    """Maps (function, y, x) blurred [pixel^2]; beyond the image they go on as within."""
    deviation = float(np.sqrt(variance))
    reach = 1 + int(4.0 * deviation)
    extended = np.pad(maps, ((0, 0), (reach, reach), (reach, reach)), "reflect", reflect_type="odd")
    blurred: Array = ndimage.gaussian_filter(extended, deviation, axes=(1, 2))
    return blurred[:, reach:-reach, reach:-reach]


def _blocks(inputs: Inputs) -> list[slice]:
    """Rows that may tell a blur."""
    if inputs.capture.sizes["x"] < _FEWEST:
        return []
    return [rows for rows in inputs.blocks if rows.stop - rows.start >= _FEWEST]


def sharpness(inputs: Inputs, result: xr.Dataset, reading: Reading) -> list[Sums] | None:
    """Sums of each other band's blur, from the rows in the middle; None of other rows."""
    blocks = _blocks(inputs)
    if not blocks or reading.rows != blocks[len(blocks) // 2]:
        return None
    places = range(1, len(inputs.bands))
    return [_equations(inputs, result, place, 0.0, reading, _LEADING) for place in places]


def _difference(inputs: Inputs, result: xr.Dataset, place: int) -> float:
    """Variance [pixel^2] of a band's blur less that of the first one; 0 if it may be none."""
    excess, blocks = 0.0, _blocks(inputs)
    rows = blocks[:: max(1, len(blocks) // _BLOCKS)]
    for turn in range(_ROUNDS):
        readings = (misfits.reflected(inputs, result, block) for block in rows)
        sums = [_equations(inputs, result, place, excess, reading) for reading in readings]
        forces, form, variance = np.sum(sums, axis=0)
        if form <= 0.0 or (turn == 0 and forces**2 < _SIGMAS**2 * variance):
            return 0.0
        step = 2.0 * forces / form
        excess += float(np.clip(step, -_STEP, _STEP))
        if abs(step) < _SETTLED * abs(excess):
            return excess if 2.0 * _SIZE < abs(excess) < _LIMIT else 0.0
    return 0.0


def _details(image: Array, excess: float) -> Array:
    """An image blurred by an excess [pixel^2], less its broad part, in which rapid heat spreads."""
    fine, broad = (_blurred(image, float(np.sqrt(blur + excess))) for blur in (_BASE, _BROAD))
    return np.asarray(fine - broad)


def _equations(
    inputs: Inputs,
    result: xr.Dataset,
    place: int,
    excess: float,
    reading: Reading,
    leading: int | None = None,
) -> Sums:
    """Normal equation of c over some rows, of bands blurred by an excess [pixel^2] before."""
    rows, _, films, frames, pixels, gain = reading
    shape = (rows.stop - rows.start, result.sizes["x"])
    ratio = result["reflection_ratio"].values[inputs.bands[place], rows]
    inner = np.pad(np.ones(np.subtract(shape, 2 * _EDGE), dtype=bool), _EDGE)
    moving = pixels.reshape(shape) & np.isfinite(ratio)
    ratio, mask = np.where(moving, ratio, 1.0), inner & moving
    # At the border of a material reflectivities change, not reflections.
    least = ndimage.minimum_filter(ratio, _BORDER)
    interior = ndimage.maximum_filter(ratio, _BORDER) < _MAX_RATIO * least
    mask &= interior | (np.count_nonzero(mask & interior) < _MOSTLY * np.count_nonzero(mask))
    blurs = max(excess, 0.0), max(-excess, 0.0)
    basis = smooth_functions(inputs.capture, frames).functions
    # Leading functions of time hold most of the rapid changes, at less cost.
    if leading is not None:
        changes = smooth.leading(select(films[0], pixels).T, leading, basis)
        films = changes.T @ films
        basis = np.zeros((len(films[0]), 0))
    if not films.size:  # without a pixel
        return 0.0, 0.0, 0.0

    def rapid(film: Array) -> Array:
        return film - np.tensordot(basis, np.tensordot(basis.T, film, 1), 1)

    # Mask and divide before a blur: broad parts do not compare where ratios differ or are missing.
    first, second = (
        np.stack([_details(image * scale, blur) for image in films[order].reshape(-1, *shape)])
        for order, scale, blur in zip((0, place), (moving, moving / ratio), blurs, strict=True)
    )
    remainder, reflection = rapid(second - first), rapid(first)
    curvature = rapid(ndimage.laplace(first, axes=(1, 2)))
    # Noise in the products: that of the first band, in all three.
    free = len(basis) - basis.shape[1]
    levels = inputs.noise[[inputs.bands[0], inputs.bands[place]]] ** 2
    spread = _details(np.pad([[1.0]], int(np.ceil(4.0 * np.sqrt(_BROAD)))), blurs[0])
    bent = ndimage.laplace(spread)
    level, mixed, bending = (
        free * levels[0] * fftconvolve(moving, a * b, mode="same")
        for a, b in ((spread, spread), (spread, bent), (bent, bent))
    )
    products = (
        np.sum(remainder * reflection, axis=0) + level,
        np.sum(remainder * curvature, axis=0) + mixed,
        np.sum(reflection**2, axis=0) - level,
        np.sum(reflection * curvature, axis=0) - mixed,
        np.sum(curvature**2, axis=0) - bending,
    )
    # The error of the ratio, of a neighbourhood, is eliminated.
    local = [
        ndimage.uniform_filter(np.where(mask, values, 0.0), _WINDOW, mode="constant")
        for values in (*products, _CONTRAST * level)
    ]
    mask &= local[2] > local[5]
    share = quotient(local[3], local[2], 0.0)
    forces, form = products[1] - share * products[0], products[4] - share * products[3]
    noisy = levels[1] * np.square(gain[1]).reshape(shape) / ratio**2
    variance = (noisy + levels[0]) * (form + bending)
    return float(forces[mask].sum()), float(form[mask].sum()), float(variance[mask].sum())
