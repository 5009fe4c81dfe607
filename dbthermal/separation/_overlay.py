r"""Images of the bands that lie beside one another: told by the detail of what warms, and undone.

A registration may be off by a fraction of a pixel, or never made. In a small window, the rise of
the signals of a band b, displaced by s, is that of the first one but for a scale a of the material
and what is smooth there, as all else that changes slowly is:

.. math:: \bar z_b(x + s(x)) = a \, \bar z_1(x) + \text{a cubic polynomial of } x

What rests tells nothing, for it may be mirrored, which cameras apart see displaced.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import xarray as xr
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter

from dbthermal import _smooth as smooth
from dbthermal import schema
from dbthermal._arrays import Array, Mask, empty, quotient, release
from dbthermal._samples import without_gaps
from dbthermal.separation._inputs import Inputs
from dbthermal.separation._misfit import Whole

# Parameters of a motion [pixel]: down and right; and a turn and a growth, as they displace what is
# at the rms distance from the middle, so that the mean square along an axis is half their squares.
PARAMETERS: Final = 4
# Square of a motion over its variance by a jackknife of windows, from which it is undone.
SURE: Final = 20.0
# Functions of time in which an object changes, the mean among them; in which reflections do, too;
# and energy of the second kind over that of the first, at most, in a window: 0.01 to 0.1 of an
# object's detail, 0.2 or more of people who walk by slowly. A lamp that is switched is as slow, but
# the largest energy of more functions is 0.23 of the first kind or more in all of its windows, and
# at most 0.18 in half of an object's.
_ORDER, _HIGHEST, _RAPID, _FUNCTIONS, _LAMP = 3, 8, 0.1, 16, 0.2
_SIDE, _DEGREE = 10, 3  # of a window [pixel], and of the polynomial that is smooth in it
_BLURS: Final = (2.0, 1.0, 0.5)  # deviations, from coarse to fine [pixel]
# Whole displacements [pixel] that are tried first, along an axis; and what of the most in common
# is nearly as much, so that no displacement by a period of a pattern is preferred to none.
_REACH, _NEARLY = 4, 0.9
_WINDOWS, _FEWEST = 64, 4  # windows, of most detail; with detail that both bands show, at least
# Share of a window's detail that the bands have in common, at least; and share of all else that a
# displacement leaves at its best blur, at most: 0.9, less 0.25 for each of its first 1.6 pixels. So
# 18 of 24 scenes are displaced by 0.3 pixel, 84 of 84 by 1 to 4, and of 350 with little detail
# none, of which noise that looks alike at the finest blur alone displaced 23.
_SHARE, _REMAINDER, _FALL = 0.5, 0.9, 0.25
_PRIOR: Final = 2.0  # deviation [pixel] of a parameter
_TURNS, _SETTLED, _STEP = 8, 0.01, 1.0  # steps at most; rms that ends them; longest [pixel]
_THRESHOLD: Final = 0.1  # displacement that matters, rms along an axis [pixel]
# Orthonormal polynomials (pixel, power) of the places in a window.
_PLACES: Final = np.indices((_SIDE, _SIDE)).reshape(2, -1) / _SIDE - 0.5
_POWERS: Final = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
_SMOOTH: Final = np.linalg.qr(np.stack([np.prod(_PLACES.T**it, axis=1) for it in _POWERS], 1))[0]


@dataclass(frozen=True)
class Moved:
    """A capture whose frames were moved back."""

    capture: xr.Dataset
    motion: Array  # of each band's image (band, time, parameter) [pixel]
    remainder: Array  # expected motion that is left (parameter) [pixel]

    def detail(self, inputs: Inputs, result: xr.Dataset) -> Array:
        """Deviation (y, x) [K] of the object's signal by the motion that is left."""
        curve, film = inputs.curves[inputs.bands[0]], result["object_temperature"].values
        sound = np.isfinite(film).any(axis=0)
        mean = np.full(sound.shape, np.nan)
        mean[sound] = curve.signal(np.nanmean(film[:, sound], axis=0, dtype=np.float64))
        slopes = along(gradients(without_gaps(np.nan_to_num(mean), sound)), places_of(mean.shape))
        return np.asarray(np.sqrt(np.einsum("ayx,a->yx", slopes**2, self.remainder**2)))


def size_of(path: Array) -> float:
    """Root mean square along an axis [pixel], over the image, of a motion (..., parameter)."""
    return float(np.sqrt(np.mean(np.sum(path**2, axis=-1)) / 2.0))


def places_of(shape: tuple[int, ...]) -> Array:
    """Places (axis, y, x) from the image's middle, over their rms distance from it."""
    middle = 0.5 * (np.reshape(shape, (2, 1, 1)) - 1.0)
    places = np.indices(shape) - middle
    return np.asarray(places / np.sqrt(np.mean(np.sum(places**2, axis=0)) or 1.0))


def along(slopes: Array, places: Array) -> Array:
    """Changes (parameter, ..., pixel) by a motion, of slopes (axis, ..., pixel) at places."""
    (down, right), (y, x) = slopes, places
    return np.stack([down, right, down * x - right * y, down * y + right * x])


def sources_of(step: Array, places: Array, pixels: Whole | None = None) -> Array:
    """Places (axis, ...) [pixel] in an image that become pixels of the image moved by a step."""
    down, right, turn, growth = step
    y, x = places
    displacement = np.stack([down + turn * x + growth * y, right - turn * y + growth * x])
    # Pixels are counted from the first of the places, or stated (axis, ...).
    return np.asarray((np.indices(y.shape) if pixels is None else pixels) - displacement)


def resampled(image: Array, sources: Array) -> Array:
    """Image at places (axis, y, x) [pixel], between its pixels by cubic splines."""
    return np.asarray(map_coordinates(image, sources, order=3, mode="nearest"))


def gradients(images: Array) -> Array:
    """Gradients (axis, ..., y, x) [1 / pixel] of images; zero across a single row or column."""
    axes = images.ndim - 2, images.ndim - 1
    sides = [np.gradient(images, axis=it) if images.shape[it] > 1 else 0.0 * images for it in axes]
    return np.stack(sides)


def moved(corrected: xr.Dataset, inputs: Inputs, motion: Array) -> xr.Dataset:
    """Capture whose frames are moved (band, time, parameter) [pixel], or all of a band alike."""
    shape = corrected["counts"].shape
    counts, good = empty(shape, np.float32), inputs.good
    places, end = places_of(shape[2:]), np.reshape(shape[2:], (2, 1, 1)) - 1.0
    motion = np.broadcast_to(motion, (*shape[:2], PARAMETERS))
    for film, images, path in zip(counts, corrected["counts"].values, motion, strict=True):
        for frame, image, step in zip(film, images, path, strict=True):
            frame[:] = image
            if not step.any():
                continue
            valid, sources = good & np.isfinite(image), sources_of(step, places)
            frame[valid] = resampled(without_gaps(image, valid), sources)[valid]
            # What was outside of the image was not seen.
            outside = np.any((sources < -_THRESHOLD) | (sources > end + _THRESHOLD), axis=0)
            frame[outside & good] = np.nan
        release()
    return corrected.assign(counts=corrected["counts"].copy(data=counts))


def solved(form: Array, force: Array) -> Array:
    return np.asarray(np.linalg.solve(form, force[..., np.newaxis])[..., 0])


def jackknife(form: Array, force: Array, prior: Array, before: Array) -> tuple[Array, Array]:
    """Solution of normal equations (window, ...) with a prior, and its variance by a jackknife."""
    # The prior is on the sum of this solution and what was solved before.
    matrix, total = form.sum(axis=0) + prior, force.sum(axis=0) - before @ prior
    reduced = solved(matrix - form, total - force)
    return solved(matrix, total), np.var(reduced, axis=0) * (len(reduced) - 1)


@dataclass(frozen=True)
class Laid(Moved):
    """A capture whose bands' images lie on that of the first."""

    reference: str

    def sentences(self) -> list[str]:
        """Sentences on how far the image of a band lay off."""
        return [
            f"The image of band '{name}' lay {size_of(path):.2f} pixel (rms) off that of "
            f"'{self.reference}', which was undone."
            for name, path in zip(self.capture["band"].values, self.motion, strict=True)
            if path.any()
        ]

    def remaining_shift(self, field: xr.Dataset | None) -> xr.Dataset | None:
        """Shift of the reflections between the images as laid, of that between them before."""
        if field is None:
            return None
        schema.check(field, "reflection_shift")
        motion = self.motion[self.capture["band"].values != self.reference, 0]
        places = places_of(field["known"].shape)
        displacement = sources_of(-motion.mean(axis=0), places) - np.indices(places.shape[1:])
        return field.assign(shift=field["shift"] - displacement.astype(np.float32))


def overlay(corrected: xr.Dataset, inputs: Inputs) -> Laid | None:
    """Lay the images of the other bands on that of the first; None if they lie there."""
    frames = np.flatnonzero(inputs.frames)
    if "segment" in corrected and frames.size:  # the longest: another pattern is detail
        numbers = corrected["segment"].values[frames]
        frames = frames[numbers == np.bincount(numbers).argmax()]
    small = min(corrected.sizes["y"], corrected.sizes["x"]) < 2 * _SIDE
    if small or frames.size < inputs.method.minimum_frames:
        return None
    motion, variance = np.zeros((2, corrected.sizes["band"], 1, PARAMETERS))
    maps, drift = _slow_maps(corrected, inputs, frames)
    for band, images in zip(inputs.bands[1:], maps[1:], strict=True):
        noise = inputs.noise[[inputs.bands[0], band]]
        motion[band], variance[band] = _displacement(maps[0], images, drift, noise)
    if not motion.any():
        return None
    reference = str(corrected["band"].values[inputs.bands[0]])
    capture, std = moved(corrected, inputs, motion), np.sqrt(variance.max(axis=(0, 1)))
    return Laid(capture, motion, std, reference)


def _slow_maps(corrected: xr.Dataset, inputs: Inputs, frames: Whole) -> tuple[Array, Array]:
    """Maps (band, function, y, x) [K] of slow functions of time in some frames; their drift."""
    counts, good = corrected["counts"], inputs.good
    course = smooth.polynomial_basis(corrected["time"].values[frames], _FUNCTIONS)
    slow = course[:, :_ORDER]
    # What a drift along time brings of each (..., function) into the functions without the mean.
    drift = (slow[:, 1:] * slow[:, [1]]).T @ slow / np.abs(slow[:, 1]).max()
    weights, span = course.T.astype(np.float32), slice(frames[0], frames[-1] + 1)
    selection = span if span.stop - span.start == frames.size else frames
    maps = np.zeros((len(inputs.bands), _FUNCTIONS, *good.shape))
    for rows in inputs.blocks:
        films = counts[:, selection, rows].values
        for rise, band in zip(maps, inputs.bands, strict=True):
            rise[:, rows] = np.tensordot(weights, films[band], 1)
            rise[:, rows] /= inputs.curves[band].reference_slope
    good &= np.isfinite(maps).all(axis=(0, 1))
    maps = np.where(good, maps, 0.0)
    return np.array([[without_gaps(image, good) for image in images] for images in maps]), drift


def _detail(values: Array) -> Array:
    """What is not smooth in windows (..., pixel)."""
    return np.asarray(values - values @ _SMOOTH @ _SMOOTH.T)


class _Views:
    """Windows of maps (function, y, x) of two bands, blurred, to be laid on one another."""

    def __init__(
        self, first: Array, second: Array, drift: Array, pixels: Whole, blur: float
    ) -> None:
        smoothed = gaussian_filter(first, blur, axes=(1, 2))
        self.images = gaussian_filter(second[1:], blur, axes=(1, 2))
        self.splines = [spline_filter(image, mode="mirror") for image in self.images]
        self.pixels, self.places = pixels, places_of(first.shape[1:])[:, *pixels]
        # Slopes of the first band: their noise is independent of the other band's.
        slopes = gradients(smoothed)[:, :, *pixels]
        self.detail = _detail(smoothed[1:, *pixels])
        self.energy = np.sum(self.detail**2, axis=(0, 2))
        drifting = np.einsum("jk,akwp->ajwp", drift, slopes)
        # Slopes (parameter, ...) of a motion, and of a drift down and to the right.
        slopes = _detail(np.concatenate([along(slopes[:, 1:], self.places), drifting]))
        common = quotient(np.sum(slopes * self.detail, axis=(1, 3)), self.energy, 0.0)
        self.slopes = slopes - common[:, np.newaxis, :, np.newaxis] * self.detail

    def nearest(self) -> Array:
        """Least whole displacement (parameter) at which the bands have nearly most in common."""
        end = np.reshape(self.images.shape[1:], (2, 1, 1)) - 1
        trials = np.indices((2 * _REACH + 1,) * 2).reshape(2, -1, 1, 1) - _REACH
        common = []
        for displacement in trials.swapaxes(0, 1):
            sources = np.clip(self.pixels - displacement, 0, end)
            values = _detail(self.images[:, *sources])
            shared = np.sum(self.detail * values, axis=(0, 2))
            energy = self.energy * np.sum(values**2, axis=(0, 2))
            common.append(np.sum(quotient(shared**2, energy, 0.0)))
        size = np.sum(trials**2, axis=0).ravel()
        size[common < _NEARLY * max(common)] = size.max() + 1
        return np.append(trials[:, np.argmin(size), 0, 0], [0.0, 0.0])

    def compared(self, path: Array) -> tuple[Array, Array, Mask]:
        """Of each window: scale, remainder (function, window, pixel), and if both show detail."""
        sources = sources_of(path, self.places, self.pixels)
        options: dict[str, Any] = {"order": 3, "mode": "mirror", "prefilter": False}
        images = [map_coordinates(spline, sources, **options) for spline in self.splines]
        values = _detail(np.array(images))
        shared = np.sum(self.detail * values, axis=(0, 2))
        agreement = shared**2 > _SHARE * self.energy * np.sum(values**2, axis=(0, 2))
        scale = quotient(shared, self.energy, 0.0)
        return scale, values - scale[:, np.newaxis] * self.detail, agreement


def _displacement(first: Array, second: Array, drift: Array, noise: Array) -> tuple[Array, Array]:
    """Motion (parameter) [pixel] that lays maps (function, y, x) on the first, and its variance."""
    zero = np.zeros(PARAMETERS)
    # Choose the windows of most detail, which changes as the object does: all in slow functions.
    height, width = (size // _SIDE for size in first.shape[1:])
    corners = np.indices((height, width)).reshape(2, -1, 1) * _SIDE
    pixels = corners + np.indices((_SIDE, _SIDE)).reshape(2, 1, -1)
    smoothed = gaussian_filter(first[1:], _BLURS[0], axes=(1, 2))
    energy = np.sum(_detail(smoothed[:, *pixels]) ** 2, axis=2)
    slow, rapid = energy[: _ORDER - 1].mean(axis=0), energy[_ORDER - 1 :]
    mask = rapid[: _HIGHEST - _ORDER].mean(axis=0) < _RAPID * slow
    if np.count_nonzero(mask & (rapid.max(axis=0) < _LAMP * slow)) < _FEWEST:
        return zero, zero
    pixels, order = pixels[:, mask], np.argsort(slow[mask])[-_WINDOWS:]
    first, second = first[:_ORDER], second[:_ORDER]
    path, levels, finest = zero, list[_Views](), None
    # From coarse detail to fine, as far as both bands show it.
    for blur in _BLURS:
        views = _Views(first, second, drift, pixels[:, order], blur)
        # Few coarse windows may lead astray: begin where most show the same.
        start = max((path, views.nearest()), key=lambda it: np.count_nonzero(views.compared(it)[2]))
        level = _refined(views, start, noise**2 / (4.0 * np.pi * blur**2))
        if level is None:
            break
        levels.append(views)
        path, spread, agreement = level
        # The coarsest detail tells where to begin; finer detail counts if most windows show it
        # (with fewer, 1 of 400 scenes was moved that lay right), or if it is the finest.
        if blur == _BLURS[-1] or (blur < _BLURS[0] and np.mean(agreement) > 0.5):
            finest = path, spread
    if finest is None:
        return zero, zero
    path, spread = finest
    # Compare what the bands do not have in common with the motion and without it, in all windows
    # at all blurs: moving reflections spoil most windows; noise looks alike at one blur only.
    squares = [[np.sum(it.compared(shift)[1] ** 2) for it in levels] for shift in (path, zero)]
    shares = quotient(np.array(squares[0]), np.array(squares[1]), 1.0)
    explained = shares.max() < 1.0 and shares.min() < _REMAINDER - _FALL * min(size_of(path), 1.6)
    # A growth is no evidence: heat that spreads feigns it.
    sure = np.any(quotient(path**2, spread, 0.0)[:-1] > SURE)
    # No motion that is unsure, too small to matter, or does not explain the difference.
    return (path, spread) if sure and explained and size_of(path) > _THRESHOLD else (zero, zero)


def _refined(views: _Views, path: Array, variance: Array) -> tuple[Array, Array, Mask] | None:
    """Motion (parameter) [pixel] by Gauss-Newton, its variance, and windows alike; None of few."""
    for _ in range(_TURNS):
        scale, remainder, agreement = views.compared(path)
        if np.count_nonzero(agreement) < _FEWEST:
            return None
        least = variance[1] + scale**2 * variance[0]
        weight = (scale / np.maximum(np.mean(remainder**2, axis=(0, 2)), least))[agreement]
        slopes, residual = views.slopes[:, :, agreement], remainder[:, agreement]
        form = np.einsum("w,afwp,bfwp->wab", weight * scale[agreement], slopes, slopes)
        force = np.einsum("w,afwp,fwp->wa", weight, slopes, residual)
        prior, before = np.eye(len(slopes)) / _PRIOR**2, np.append(path, [0.0, 0.0])
        step, spread = (values[:PARAMETERS] for values in jackknife(form, force, prior, before))
        path = path + np.clip(step, -_STEP, _STEP)
        if np.sqrt(np.mean(step**2)) < _SETTLED:
            break
    return path, spread, agreement
