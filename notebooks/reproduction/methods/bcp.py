r"""Blackbody channel prior: a labelled reconstruction, on whole images, frame by frame.

Grimming et al. (2023) take the brightest pixels of a neighbourhood for nearly black. Their code is
not public and their equations could not be had: this is **our reconstruction**, by analogy with the
dark channel prior of He et al. (2011), doi:10.1109/TPAMI.2010.168, and no figure published for
their method is its target.

With I the linearised signal of the quieter band, linear in radiance, and A the reflected signal:

1. M, the largest I in the patch around a pixel, is taken for the signal of a blackbody at the
   object's temperature there.
2. :math:`t = (I - A) / (M - A)`, since :math:`I = t M + (1 - t) A` for an emissivity t; **clipped
   to [0, 1]**, and smoothed by a guided filter whose guide is the image: He et al. (2013),
   doi:10.1109/TPAMI.2012.213.
3. :math:`I' = (I - A) / \max(t, t_0) + A` is the object's signal; its temperature follows from the
   response.

Clipping is part of the algorithm, as of the dark channel prior; nothing in the library clips.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.ndimage import maximum_filter, uniform_filter

from dbthermal._numbers import POSITIVE, real_numbers
from dbthermal.response import require_range
from dbthermal.separation import Method
from dbthermal.separation._inputs import check_fields
from dbthermal.separation._tiles import WITHOUT_STD, Array, Estimate, Mask, Tile
from reproduction.methods.naive import require


@dataclass(frozen=True)
class BcpSettings:
    """Options of the blackbody channel prior; none is published.

    In a patch the object's temperature should not change: on a plate with a hot middle, 240 pixels
    wide, a patch of 5 is better than 15, and 31 worse. The guided filter's epsilon is the variance
    below which the guide counts as flat, relative to the square of the frame's span [1].
    """

    patch: int = 15  # side of what is searched for the brightest pixel [pixel], odd
    window: int = 31  # side of the guided filter's window [pixel], odd
    regularisation: float = 1e-3  # the guided filter's epsilon
    percentile: float = 1.0  # of the frame, that is the reflected signal without a temperature [%]
    reflected_temperature: float | None = None  # reflected apparent temperature [K], if known
    least_transmission: float = 0.1  # t0, below which the emissivity is not divided by [1]

    def __post_init__(self) -> None:
        """Refuse windows without a centre, and numbers outside their range."""
        check_fields(self, "bcp")
        for name in ("patch", "window"):
            side = getattr(self, name)
            require(self, "bcp", name, side >= 1 and side % 2 == 1, "be odd")
        real_numbers("regularisation of method 'bcp'", self.regularisation, POSITIVE)
        require(self, "bcp", "percentile", 0 <= self.percentile <= 100, "lie in [0, 100]")
        least = self.least_transmission
        require(self, "bcp", "least_transmission", 0 < least <= 1, "lie in (0, 1]")


def separate(tile: Tile, settings: BcpSettings) -> Estimate:
    """Remove the reflection from a whole image, each frame by itself.

    The object temperature is that of the quieter band, the background's that of A; the emissivity
    of a band is the mean of its t over time. Pixels without a temperature are NaN.
    """
    object_signal, reflected, transmission = _remove(tile, settings, 0)
    transmissions = np.stack([transmission, _remove(tile, settings, 1)[2]])
    temperature = np.where(_usable(tile, 0), tile.temperature(0, object_signal), np.nan)
    background = np.tile(tile.temperature(0, reflected)[:, np.newaxis], temperature.shape[1])
    status = np.zeros(temperature.shape[1], dtype=np.uint32)
    estimate = Estimate.without_std(tile, temperature, status, transmissions, background)
    return estimate.check_range(tile.curves[0], not_estimated=WITHOUT_STD)


def _remove(tile: Tile, settings: BcpSettings, band: int) -> tuple[Array, Array, Array]:
    """Object signal (time, pixel) [K], reflected signal A (time) [K], mean t (pixel), of a band."""
    cleaned = np.empty_like(tile.signals[band])
    reflected, total = np.empty(tile.time.size), np.zeros(cleaned.shape[1])
    fixed = None
    if settings.reflected_temperature is not None:
        curve = tile.curves[band]
        value = require_range(settings.reflected_temperature, curve, "reflected_temperature")
        fixed = float(tile.blackbody(band, value))
    frames = zip(tile.signals[band], _usable(tile, band), strict=True)
    for frame, (signal, usable) in enumerate(frames):
        mixed = usable.any() and not usable.all()
        filled = np.where(usable, signal, np.median(signal[usable])) if mixed else signal
        image = filled.reshape(tile.shape)
        level = float(np.percentile(image, settings.percentile)) if fixed is None else fixed
        transmission = _transmission(image, level, settings)
        # I' = (I - A) / max(t, t0) + A
        excess = (image - level) / np.maximum(transmission, settings.least_transmission)
        cleaned[frame], reflected[frame] = (excess + level).ravel(), level
        total += transmission.ravel()
    return cleaned, reflected, total / tile.time.size


def _usable(tile: Tile, band: int) -> Mask:
    """Samples (time, pixel) that have a temperature: all, where a frame's lowest signal has one."""
    signals = tile.signals[band]
    lost = np.isnan(tile.temperature(band, signals.min(axis=1)))
    usable = np.ones(signals.shape, dtype=bool)
    usable[lost] = np.isfinite(tile.temperature(band, signals[lost]))
    return usable


def _transmission(image: Array, level: float, settings: BcpSettings) -> Array:
    """The smooth t of one frame; 1 where nothing in the patch is brighter than the reflection."""
    # t = (I - A) / (M - A)
    brightest = maximum_filter(image, settings.patch)
    coarse = np.ones_like(image)
    np.divide(image - level, brightest - level, out=coarse, where=brightest > level)
    coarse, epsilon = np.clip(coarse, 0.0, 1.0), settings.regularisation * np.ptp(image) ** 2
    if epsilon == 0:  # one value: neither a guide, nor anything to smooth
        return coarse
    return np.clip(guided_filter(image, coarse, settings.window, float(epsilon)), 0.0, 1.0)


def guided_filter(guide: Array, image: Array, window: int, epsilon: float) -> Array:
    r"""Smooth an image (y, x) along the edges of a guide (y, x), mirrored at the border.

    In every window of that side [pixel] the result is :math:`a\,\mathrm{guide} + b` with
    :math:`a = \mathrm{cov}(\mathrm{guide}, \mathrm{image}) / (\mathrm{var}(\mathrm{guide}) +
    \epsilon)`; a pixel takes the mean of all windows that hold it (He et al. 2013).
    """
    guide = guide - guide.mean()  # the variance is a difference of squares
    mean_guide, mean_image = uniform_filter(guide, window), uniform_filter(image, window)
    covariance = uniform_filter(guide * image, window) - mean_guide * mean_image
    variance = uniform_filter(guide * guide, window) - mean_guide**2
    slope = covariance / (variance + epsilon)
    intercept = mean_image - slope * mean_guide
    return np.asarray(uniform_filter(slope, window) * guide + uniform_filter(intercept, window))


METHOD: Final = Method(separate, BcpSettings, "bcp", whole_image=True, not_estimated=WITHOUT_STD)
"""The reconstructed blackbody channel prior, for `solve`."""
