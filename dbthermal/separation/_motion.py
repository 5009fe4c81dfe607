r"""Cameras that shake: the image's motion from frame to frame, told by what is left, and undone.

What a separation leaves, the bands' null combination less the object, holds no reflection, but the
motion s of each band's image, times the gradient of its mean:

.. math:: r(t) = \sum_b w_b \, s_b(t) \cdot \nabla \bar z_b

Least squares over all pixels, frame by frame, with a prior for s: cameras on one support move
alike. Motion that is slow, as smooth functions of time, is not seen.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import xarray as xr
from scipy.ndimage import shift as shifted

from dbthermal._arrays import Array, empty, quotient, release
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


@dataclass(frozen=True)
class Stabilised:
    """A capture whose frames lie on one another."""

    capture: xr.Dataset
    motion: Array  # of each band's image (band, time, axis) [pixel]

    @property
    def sentence(self) -> str:
        """Sentence on how far the image of each band moved."""
        sizes = ", ".join(
            f"'{band}' {np.sqrt(np.mean(path**2)):.2f}"
            for band, path in zip(self.capture["band"].values, self.motion, strict=True)
        )
        return f"The image moved from frame to frame, by {sizes} pixel (rms), which was undone."


def stabilise(
    corrected: xr.Dataset,
    inputs: Inputs,
    result: xr.Dataset,
    misfit: Misfit,
    before: Array | None = None,
) -> Stabilised | None:
    """Move each frame back by the cameras' motion, beside one found before; None without motion."""
    if not misfit.common(result["status"].values == 0):
        return None
    count = len(inputs.bands)
    size, frames = 2 * count, corrected.sizes["time"]
    form, forces = np.zeros((frames, size, size)), np.zeros((frames, size))
    weights = object_weights(inputs, result)[inputs.bands]
    for rows in inputs.blocks:
        _add_equations(inputs, result, weights[:, rows], rows, form, forces)
    # Is there any?
    level, axes = np.linalg.eigh(form)
    pull = np.einsum("tba,tb->ta", axes, forces)
    seen = level > _SEEN * level[:, -1:]
    square = np.sum(quotient(pull**2, level * seen, 0.0), axis=0) / np.maximum(seen.sum(axis=0), 1)
    if not np.any(square > (_SURE if before is None else _FURTHER)):
        return None
    prior = _COMMON**2 * np.ones((count, count)) + _APART**2 * np.eye(count)
    precision = np.kron(np.linalg.inv(prior), np.eye(2))
    steps = np.linalg.solve(form + precision, forces[..., np.newaxis]).reshape(-1, count, 2)
    steps = np.swapaxes(steps, 0, 1)[np.argsort(inputs.bands)]
    motion = np.asarray(steps if before is None else steps + before)
    if np.sqrt(np.mean(motion**2)) < _LEAST:
        return None
    counts, good = empty(corrected["counts"].shape, np.float32), good_pixels(inputs)
    for film, moved, path in zip(counts, corrected["counts"].values, motion, strict=True):
        for frame, image, step in zip(film, moved, path, strict=True):
            valid = good & np.isfinite(image)
            whole = shifted(without_gaps(image, valid), step, order=3, mode="nearest")
            frame[:] = np.where(valid, whole, image)
        release()
    return Stabilised(corrected.assign(counts=corrected["counts"].copy(data=counts)), motion)


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
