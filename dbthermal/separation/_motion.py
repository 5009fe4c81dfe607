r"""Cameras that move: the image's motion, told by what it does to a separation, and undone.

The bands' null combination holds no reflection, but the motion s of each band's image, times the
gradient of its mean:

.. math:: r(t) = \sum_b w_b \, s_b(t) \cdot \nabla \bar z_b

Rapid motion is told by what is left of the combination beside the object, frame by frame: least
squares over all pixels, with a prior for s, as cameras on one support move alike. Slow motion is
told by the object, which takes it up: its change in time, in details of the image, along these
gradients. That an object changes where its own temperature or the signals have details, or where
the temperature has a gradient, as before a front of heat, is no motion.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.ndimage import gaussian_filter
from scipy.ndimage import shift as shifted

from dbthermal import _smooth as smooth
from dbthermal._arrays import Array, Mask, empty, quotient, release
from dbthermal.noise import MAD
from dbthermal.separation._blur import good_pixels, without_gaps
from dbthermal.separation._inputs import Inputs
from dbthermal.separation._misfit import Misfit, object_weights, reflected, smooth_functions

_COMMON, _APART = 1.0, 0.1  # prior deviations [pixel] of a motion that the bands share, or do not
# Mean square of a motion over its variance, from which it is undone, and undone further: of 10^5
# frames without motion none has a mean over 250 of more than 1.5; rapid heat feigns up to 7.4 in
# eight scenes at random, and a shake of 0.2 pixel shows 27 or more.
_SURE, _FURTHER = 10.0, 1.5
_SLOW: Final = 3  # smooth functions in which the image's gradients change
_LEAST: Final = 0.1  # motion that matters, root mean square [pixel]; two depths feign 0.06
_SEEN: Final = 1e-6  # share of the largest eigenvalue, below which a motion is not seen
# Of slow motion, of which pixels at one place feign up to 9, and a drift by one pixel shows 80 or
# more: polynomials of the time, and spans whose means tell them; a band's motion by itself [pixel].
_DEGREES, _SPANS, _ALONE = 6, 24, 1.0
_DETAIL, _SIDE = 3.0, 2  # of an image: deviation of what is around [pixel], pixels left out
_WINDOWS: Final = 4  # along a side of the image, for a jackknife
_OUTLIER, _ROUNDS = 1.5, 4  # deviations, and rounds of weights


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
    steps += _slow(inputs, result)
    motion = np.asarray(steps if before is None else steps + before)
    if not np.any(steps) or np.sqrt(np.mean(motion**2)) < _LEAST:
        return None
    counts, good = empty(shape, np.float32), good_pixels(inputs)
    for film, moved, path in zip(counts, corrected["counts"].values, motion, strict=True):
        for frame, image, step in zip(film, moved, path, strict=True):
            valid = good & np.isfinite(image)
            whole = shifted(without_gaps(image, valid), step, order=3, mode="nearest")
            frame[:] = np.where(valid, whole, image)
        release()
    return Stabilised(corrected.assign(counts=corrected["counts"].copy(data=counts)), motion, rapid)


def _precision(count: int, apart: float, unit: float = 1.0) -> Array:
    """Inverse covariance of the motion (band, axis) of so many bands, by its prior, in a unit."""
    prior = _COMMON**2 * np.ones((count, count)) + apart**2 * np.eye(count)
    return np.kron(np.linalg.inv(prior * unit**2), np.eye(2))


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
    steps = np.linalg.solve(form + _precision(count, _APART), forces[..., np.newaxis])
    return np.swapaxes(steps.reshape(-1, count, 2), 0, 1)[np.argsort(inputs.bands)]


def _slow(inputs: Inputs, result: xr.Dataset) -> Array:
    """Motion (band, time, axis) [pixel] that the object has taken up; zero without any."""
    bands, time = inputs.bands, result["time"].values.astype(np.float64)
    none, sound = np.zeros((len(bands), time.size, 2)), result["status"].values == 0
    if min(sound.shape) < 2 * _WINDOWS:
        return none
    # The object and each band along polynomials of the time.
    basis = smooth.polynomial_basis(time, _DEGREES + 1)
    film, curves = result["object_temperature"].values, [inputs.curves[band] for band in bands]
    courses = [_course(film, basis, curves[0].signal)]
    for band, curve in zip(bands, curves, strict=True):
        courses.append(_course(inputs.capture["counts"].values[band], basis, curve.linearise))
    maps = np.stack(courses)
    sound &= np.isfinite(maps).all(axis=(0, 1))
    places = np.nonzero(np.pad(sound[_SIDE:-_SIDE, _SIDE:-_SIDE], _SIDE))
    # Details of what an object may change by, and of what motion of each band changes in it.
    images = np.stack([without_gaps(image, sound) for image in maps[:, 0] * basis[0, 0]])
    slopes = np.array([np.gradient(image) for image in images])
    beside = _details(np.concatenate([images, slopes[0]]), sound, places)
    if places[0].size < 4 * _WINDOWS**2 * len(beside):
        return none
    row, column = (
        place * _WINDOWS // side for place, side in zip(places, sound.shape, strict=True)
    )
    window, form, force = row * _WINDOWS + column, np.zeros(1), np.zeros(1)
    weights = np.nan_to_num(object_weights(inputs, result)[bands])
    shares = [weights, *np.eye(len(bands))[..., np.newaxis, np.newaxis]]
    for share, course in zip(shares, maps, strict=True):
        moving = (share[:, np.newaxis] * slopes[1:]).reshape(-1, *sound.shape)
        moving, changes = (_details(part, sound, places) for part in (moving, course[1:]))
        terms = _equations(moving, beside, changes, window)
        form, force = form + terms[0], force + terms[1]
    # Solve with the prior, and without each window of the image in turn: a jackknife.
    prior = _precision(len(bands), _ALONE, np.sqrt(time.size / _DEGREES))
    steps = np.linalg.solve(form.sum(axis=0) + prior, force.sum(axis=0))[..., 0]
    less = np.linalg.solve(form.sum(axis=0) - form + prior, force.sum(axis=0) - force)[..., 0]
    variance = np.var(less, axis=0) * (len(less) - 1)
    if not np.any(np.mean(quotient(steps**2, variance, 0.0), axis=0) > _SURE):
        return none
    motion = (basis[:, 1:] @ steps).reshape(time.size, len(bands), 2)
    return np.swapaxes(motion, 0, 1)[np.argsort(bands)]


def _course(film: Any, basis: Array, signal: Callable[[Array], Array]) -> Array:
    """Signal (number, y, x) [K] of a film (time, y, x) along polynomials (time, number)."""
    spans = np.array_split(np.arange(len(basis)), min(_SPANS, len(basis) // 2))
    means = np.empty((len(spans), *film.shape[1:]))
    for mean, span in zip(means, spans, strict=True):
        counted = np.isfinite(film[span]).sum(axis=0)
        total = np.nansum(film[span], axis=0, dtype=np.float64)
        mean[:] = signal(quotient(total, counted + 0.0 * total, np.nan))
        release()
    design = np.stack([basis[span].mean(axis=0) for span in spans])
    return np.asarray(np.tensordot(np.linalg.pinv(design), means, 1))


def _equations(
    slopes: Array, beside: Array, changes: Array, window: npt.NDArray[np.intp]
) -> tuple[Array, Array]:
    """Normal equations by window of changes (function, pixel) along slopes (cause, pixel).

    Without outliers, and without what an object may change by `beside` (cause, pixel).
    """
    causes, weight = np.concatenate([slopes, beside]), np.ones(window.size)
    for _ in range(_ROUNDS):
        inverse = np.linalg.pinv((causes * weight) @ causes.T)
        left = changes - (changes * weight) @ causes.T @ inverse @ causes
        scale = MAD * np.median(np.abs(left), axis=1)
        far = np.sqrt(np.mean((left / scale[:, np.newaxis]) ** 2, axis=0))
        weight = _OUTLIER / np.maximum(far, _OUTLIER)
    # Less what an object may change by; neighbours share what is left.
    inverse = np.linalg.pinv((beside * weight) @ beside.T)
    slopes, changes = (
        values - (values * weight) @ beside.T @ inverse @ beside for values in (slopes, changes)
    )
    parts = [weight * (window == number) for number in np.unique(window)]
    form = np.stack([(slopes * part) @ slopes.T for part in parts])[:, np.newaxis]
    force = np.stack([(changes * part) @ slopes.T for part in parts])
    variance = (_DETAIL * scale[:, np.newaxis]) ** 2
    return form / variance[..., np.newaxis], (force / variance)[..., np.newaxis]


def _details(maps: Array, sound: Mask, places: tuple[Any, ...]) -> Array:
    """Maps (map, y, x) less their means around, at some places (map, pixel) of sound pixels."""
    filled = np.where(sound, maps, 0.0)
    weight = gaussian_filter(1.0 * sound, _DETAIL)
    around = quotient(gaussian_filter(filled, (0, _DETAIL, _DETAIL)), weight + 0.0 * maps, 0.0)
    return np.asarray((filled - around)[:, *places])


def _add_equations(
    inputs: Inputs, result: xr.Dataset, weights: Array, rows: slice, form: Array, forces: Array
) -> None:
    """Add the normal equations of all bands' motion over some rows, by frame, in place."""
    signals, films, frames, pixels, gain = reflected(inputs, result, rows)
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
