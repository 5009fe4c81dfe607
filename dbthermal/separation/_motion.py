r"""Cameras that move: the image's motion, told by what it does to a separation, and undone.

The bands' null combination holds no reflection, but the motion s of each band's image, times the
gradient of its mean:

.. math:: r(t) = \sum_b w_b \, s_b(t) \cdot \nabla \bar z_b

Rapid motion is told by what is left of the combination beside the object, frame by frame: least
squares over all pixels, with a prior for s, as cameras on one support move alike. Slow motion the
object takes up; where only one band's image moves, its reflections h move against those of the
first band, beside a delay of the clocks:

.. math:: h_b / k_b - h_1 = s_b(t) \cdot \nabla h_1 + \tau(t) \, \partial_t h_1
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import xarray as xr
from scipy.ndimage import binary_erosion
from scipy.ndimage import shift as shifted

from dbthermal import _smooth as smooth
from dbthermal._arrays import Array, empty, quotient, release
from dbthermal.separation._blur import good_pixels, without_gaps
from dbthermal.separation._inputs import Inputs
from dbthermal.separation._misfit import (
    Misfit,
    Reading,
    Whole,
    object_weights,
    reflected,
    smooth_functions,
)

_COMMON, _APART = 1.0, 0.1  # prior deviations [pixel] of a motion that the bands share, or do not
# Mean square of a motion over its variance, from which it is undone, and undone further: of 10^5
# frames without motion none has a mean over 250 of more than 1.5; rapid heat feigns up to 7.4 in
# eight scenes at random, and a shake of 0.2 pixel shows 27 or more.
_SURE, _FURTHER = 10.0, 1.5
_SLOW: Final = 3  # smooth functions in which the image's gradients change
_LEAST: Final = 0.1  # motion of a band that matters, rms [pixel]: two depths feign 0.06
_SEEN: Final = 1e-6  # share of the largest eigenvalue, below which a motion is not seen
# Of slow motion: polynomials of the time, windows along a side of the image, and frames at most. By
# the square above a drift of one pixel shows 34 or more, 31 plain scenes at most 9; 30 of 24x32
# pixels, with half the windows, up to 93, but of less than 0.06 pixel.
_DEGREES, _WINDOWS, _FRAMES = 6, 4, 128


@dataclass(frozen=True)
class Stabilised:
    """A capture whose frames lie on one another."""

    capture: xr.Dataset
    motion: Array  # of each band's image (band, time, axis) [pixel]
    rapid: bool  # seen in what a separation leaves, or in its object

    @property
    def sentence(self) -> str:
        """Sentence on how far the image of each band moved."""
        sizes = ", ".join(
            f"'{band}' {np.sqrt(np.mean(path**2)):.2f}"
            for band, path in zip(self.capture["band"].values, self.motion, strict=True)
        )
        return f"The image moved, by {sizes} pixel (rms), which was undone."


def stabilise(
    corrected: xr.Dataset,
    inputs: Inputs,
    result: xr.Dataset,
    misfit: Misfit,
    before: Array | None = None,
) -> Stabilised | None:
    """Move each frame back by the cameras' motion, beside one found before; None without motion."""
    shape = corrected["counts"].shape
    steps, least = np.zeros((shape[0], shape[1], 2)), _SURE if before is None else _FURTHER
    if misfit.common(result["status"].values == 0):
        steps += _rapid(inputs, result, least)
    rapid = bool(np.any(steps))
    steps += _slow(inputs, misfit)
    motion = np.asarray(steps if before is None else steps + before)
    if not np.any(steps) or np.sqrt(np.mean(motion**2, axis=(1, 2)).max()) < _LEAST:
        return None
    counts, good = empty(shape, np.float32), good_pixels(inputs)
    for film, moved, path in zip(counts, corrected["counts"].values, motion, strict=True):
        for frame, image, step in zip(film, moved, path, strict=True):
            valid = good & np.isfinite(image)
            whole = shifted(without_gaps(image, valid), step, order=3, mode="nearest")
            frame[:] = np.where(valid, whole, image)
        release()
    return Stabilised(corrected.assign(counts=corrected["counts"].copy(data=counts)), motion, rapid)


def _precision(count: int) -> Array:
    """Inverse covariance of the motion (band, axis) of so many bands, by its prior."""
    prior = _COMMON**2 * np.ones((count, count)) + _APART**2 * np.eye(count)
    return np.kron(np.linalg.inv(prior), np.eye(2))


def _rapid(inputs: Inputs, result: xr.Dataset, least: float) -> Array:
    """Motion (band, time, axis) [pixel] in what a separation leaves; zero without any."""
    count, frames = len(inputs.bands), result.sizes["time"]
    size = 2 * count
    form, forces = np.zeros((frames, size, size)), np.zeros((frames, size))
    weights = object_weights(inputs, result)[inputs.bands]
    for rows in inputs.blocks:
        _add_equations(inputs, result, weights[:, rows], rows, form, forces)
    # Is there any?
    level, axes = np.linalg.eigh(form)
    pull = np.einsum("tba,tb->ta", axes, forces)
    seen = level > _SEEN * level[:, -1:]
    square = np.sum(quotient(pull**2, level * seen, 0.0), axis=0) / np.maximum(seen.sum(axis=0), 1)
    if not np.any(square > least):
        return np.zeros((count, frames, 2))
    steps = np.linalg.solve(form + _precision(count), forces[..., np.newaxis])
    return np.swapaxes(steps.reshape(-1, count, 2), 0, 1)[np.argsort(inputs.bands)]


def _slow(inputs: Inputs, misfit: Misfit) -> Array:
    """Motion (band, time, axis) [pixel] of the bands against the first one; zero without any."""
    time = inputs.capture["time"].values.astype(np.float64)
    motion, windows = np.zeros((len(inputs.bands), time.size, 2)), misfit.answers[drift]
    # A delay, which feigns motion of what walks by, is that of clocks: it hardly changes.
    wanted = np.ones((_DEGREES + 1, 3), dtype=bool)
    wanted[2:, 2] = False
    for place, band in enumerate(inputs.bands[1:]) if windows else ():
        form, force = (np.concatenate([sums[place][it] for sums in windows]) for it in (0, 1))
        form, force = form[:, wanted.ravel()][..., wanted.ravel()], force[:, wanted.ravel()]
        # Solve with a prior, and without each window of the image in turn: a jackknife.
        whole = form.sum(axis=0) + np.eye(form.shape[1]) / _COMMON**2
        steps = np.linalg.solve(whole, force.sum(axis=0))
        less = np.linalg.solve(whole - form, (force.sum(axis=0) - force)[..., np.newaxis])[..., 0]
        variance = np.var(less, axis=0) * (len(less) - 1)
        # What does not change in time is no motion.
        score, path = np.zeros((2, *wanted.shape))
        score[wanted], path[wanted] = quotient(steps**2, variance, 0.0), steps
        if np.any(score[1:, :2].mean(axis=0) > _SURE):
            motion[band] = _course(time)[:, 1:] @ path[1:, :2]
    return motion


def _course(time: Array) -> Array:
    """Polynomials (time, degree) of slow motion."""
    return np.asarray(smooth.polynomial_basis(time, _DEGREES + 1) * np.sqrt(time.size))


def drift(inputs: Inputs, result: xr.Dataset, reading: Reading) -> list[tuple[Array, Array]] | None:
    """Normal equations (window, ...) of each other band's motion and delay along functions of time.

    Of windows of some rows; what does not change rapidly has no part in them.
    """
    blocks = [rows for rows in inputs.blocks if rows.stop - rows.start > 1]
    blocks = blocks[:: max(1, len(blocks) // _WINDOWS)]
    # Of cameras apart parallax that changes as people come and go is like motion.
    small = min(result["status"].shape) < 2 * _WINDOWS
    if inputs.displacement is not None or small or reading.rows not in blocks:
        return None
    ratios = result["reflection_ratio"].values[inputs.bands, reading.rows].astype(np.float64)
    pixels = reading.pixels.reshape(ratios.shape[1:])
    basis = smooth_functions(inputs, reading.frames)
    # Rapid changes in some frames, and in those before and after them.
    at = np.arange(1, len(basis) - 1, -(-len(basis) // _FRAMES))
    course = _course(inputs.capture["time"].values.astype(np.float64))[reading.frames][at]
    smoothed = basis.T @ reading.reflections

    def rapid(place: int, at: Whole) -> Array:
        film = reading.reflections[place][at] - basis[at] @ smoothed[place]
        return np.asarray(film.reshape(-1, *pixels.shape))

    first, noise = rapid(0, at), inputs.noise[inputs.bands] ** 2
    in_time = 0.5 * (rapid(0, at + 1) - rapid(0, at - 1))
    slopes = np.stack([*np.gradient(first, axis=(1, 2)), in_time])
    equations = []
    for place, ratio in enumerate(ratios[1:], 1):
        used = binary_erosion(pixels & (ratio > 0.0), border_value=1)
        second, forms, forces = rapid(place, at), list[Array](), list[Array]()
        for columns in np.array_split(np.arange(ratio.shape[1]), _WINDOWS):
            y, x = np.nonzero(used[:, columns])
            window = y, columns[x]
            slope, kappa = slopes[:, :, *window], ratio[window]
            remainder = second[:, *window] / kappa - first[:, *window]
            weighted = slope / (noise[0] + noise[place] / kappa**2)
            form = np.einsum("atp,btp->tab", weighted, slope, optimize=True)
            force = np.einsum("atp,tp->ta", weighted, remainder)
            forms.append(np.einsum("tj,tk,tab->jakb", course, course, form, optimize=True))
            forces.append(np.einsum("tj,ta->ja", course, force))
        size = course.shape[1] * 3
        equations.append((np.reshape(forms, (-1, size, size)), np.reshape(forces, (-1, size))))
    return equations


def _add_equations(
    inputs: Inputs, result: xr.Dataset, weights: Array, rows: slice, form: Array, forces: Array
) -> None:
    """Add the normal equations of all bands' motion over some rows, by frame, in place."""
    _, signals, films, frames, pixels, gain = reflected(inputs, result, rows)
    weights = weights.reshape(len(signals), -1)
    used = pixels & (weights[0] != 0.0)
    basis = smooth_functions(inputs, frames)
    # Gradients of the image, which changes slowly; a side of one pixel shows no motion.
    shape = (_SLOW, len(films), rows.stop - rows.start, result.sizes["x"])
    images = np.einsum("tj,btp->jbp", basis[:, :_SLOW], signals).reshape(shape)
    whole = pixels.reshape(shape[2:])
    for image in images.reshape(-1, *images.shape[2:]):
        image[:] = without_gaps(image, whole)
    sides = [np.gradient(images, axis=it) if shape[it] > 1 else 0.0 * images for it in (2, 3)]
    slopes = np.stack(sides, axis=2)
    slopes = slopes.reshape(_SLOW, len(signals), 2, -1) * weights[:, np.newaxis]
    slopes = slopes[..., used].reshape(_SLOW * 2 * len(signals), -1)
    noise = inputs.noise[inputs.bands, np.newaxis] * gain
    weighted = slopes / np.sum((weights * noise)[:, used] ** 2, axis=0)
    remainder = np.einsum("bp,btp->tp", weights[:, used], films[..., used])
    pull = weighted @ remainder.T
    pull -= pull @ basis @ basis.T
    # In each frame the gradients are sums over these functions of time.
    course = basis[:, :_SLOW]
    forces[frames] += np.einsum("tj,jbt->tb", course, pull.reshape(_SLOW, -1, len(course)))
    products = (weighted @ slopes.T).reshape(_SLOW, 2 * len(signals), _SLOW, -1)
    form[frames] += np.einsum("tj,tk,jbkc->tbc", course, course, products, optimize=True)
    release()
