"""Smallest standard deviations of what a film is separated into, from its Fisher information."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from dbthermal import _smooth as smooth
from dbthermal.limits._information import (
    HIGHEST_ORDER,
    REMAINDER,
    Blackbody,
    Film,
    film,
    smallest_order,
    spread,
)

Array = npt.NDArray[np.float64]
Order = npt.NDArray[np.intp]

QUANTITIES: Final = (
    "object_temperature",
    "background_temperature",
    "emissivity",
    "reflection_ratio",
    "emission_ratio",
)
"""What a bound is given of."""

# Pixels at once: their working memory, some 200 kB each at 350 frames, stays below 100 MB.
_PIXELS: Final = 512


@dataclass(frozen=True)
class Truth:
    """
    What is filmed.

    Attributes
    ----------
    time : ndarray, shape (time,)
        Times [s].
    warm, cold : ndarray, shape (time, pixel)
        Object and background temperature [K].
    emissivity : ndarray, shape (band, pixel)
        Emissivity [1].
    resting : ndarray of bool, shape (time, pixel)
        Frames in which the background is at one level.
    """

    time: Array
    warm: Array
    cold: Array
    emissivity: Array
    resting: npt.NDArray[np.bool_]

    def film(self, blackbodies: Sequence[Blackbody], noise: Array) -> Film:
        """Derivatives at this truth; see `information.film`."""
        return film(blackbodies, noise, (self.warm, self.cold, self.emissivity), self.resting)

    def smooth(self, order: Order) -> "Truth":
        """The same with the object put into each pixel's smooth subspace of given order."""
        warm = self.warm.copy()
        for count in np.unique(order):
            functions = smooth.basis(self.time, int(count))
            warm[:, order == count] = functions @ (functions.T @ warm[:, order == count])
        return replace(self, warm=warm)


def orders(truth: Truth, seen: Film) -> Order:
    """
    Smallest order that holds each pixel's object; see `information.smallest_order`.

    Parameters
    ----------
    truth : Truth
        What is filmed.
    seen : Film
        Derivatives at it.

    Returns
    -------
    ndarray of int, shape (pixel,)
        Number of functions.

    Raises
    ------
    ValueError
        If no order up to `information.HIGHEST_ORDER` suffices for a pixel.
    """
    highest = min(HIGHEST_ORDER, truth.time.size)
    functions, order = smooth.basis(truth.time, highest), np.empty(truth.warm.shape[1], np.intp)
    for chosen in _blocks(np.arange(order.size)):
        order[chosen] = smallest_order(seen.of(chosen), truth.warm[:, chosen], functions)
    if np.any(order > highest):
        raise ValueError(
            f"Invalid object_temperature of pixel {int(np.argmax(order > highest))}: {highest} "
            f"smooth functions leave more than {REMAINDER} of the noise's variance. "
            "Must be smooth; or give the order."
        )
    return order


def deviations(
    seen: Film, time: Array, order: Order, reference: int, *, emissivity_std: float = np.inf
) -> dict[str, Array]:
    """
    Smallest standard deviation of every quantity, pixel by pixel.

    Parameters
    ----------
    seen : Film
        Derivatives, at a truth whose object lies in the smooth subspace.
    time : ndarray, shape (time,)
        Times [s].
    order : ndarray of int, shape (pixel,)
        Size of each pixel's smooth subspace.
    reference : int
        Band that the ratios are relative to.
    emissivity_std : float
        What is known of the emissivities beforehand, 0 if all, infinite if nothing [1].

    Returns
    -------
    dict of str to ndarray
        Each of `QUANTITIES`: temperatures (time, pixel) [K], emissivity and ratios (band, pixel)
        [1]; infinite where the film does not tell it.
    """
    size, pixels = seen.resting.shape
    if emissivity_std == 0:
        seen = replace(seen, contrast=np.zeros_like(seen.contrast))
    prior = 1.0 / emissivity_std**2 if emissivity_std > 0 else 1.0
    rows = {name: size if "temperature" in name else len(seen.emissivity) for name in QUANTITIES}
    result = {name: np.empty((rows[name], pixels)) for name in QUANTITIES}
    for count in np.unique(order):
        functions = smooth.basis(time, int(count))
        for chosen in _blocks(np.flatnonzero(order == count)):
            part = _deviations(seen.of(chosen), functions, reference, prior)
            for name, values in part.items():
                known = emissivity_std == 0 and "temperature" not in name
                result[name][:, chosen] = 0.0 if known else values
    return result


def _blocks(pixels: Order) -> list[Order]:
    """Some pixels in blocks, for the memory that each takes."""
    return np.split(pixels, range(_PIXELS, pixels.size, _PIXELS))


def _deviations(seen: Film, functions: Array, reference: int, prior: float) -> dict[str, Array]:
    """Deviations of pixels of one order."""
    bands, (size, order) = len(seen.emissivity), functions.shape
    found = spread(seen, functions, prior)
    own = np.eye(bands, bands + order + 1)[np.newaxis]
    of_object = np.zeros((1, size, bands + order + 1))
    of_object[0, :, bands:-1] = functions
    of_background, alone = _background(seen, functions)
    variances = {
        "object_temperature": found.variance(of_object),
        "background_temperature": found.variance(of_background) + alone,
        "emissivity": found.variance(own),
        "reflection_ratio": found.variance(_of_ratio(1.0 - seen.emissivity, reference) @ -own),
        "emission_ratio": found.variance(_of_ratio(seen.emissivity, reference) @ own),
    }
    return {name: np.sqrt(variance.T) for name, variance in variances.items()}


def _background(seen: Film, functions: Array) -> tuple[Array, Array]:
    """Gradient (pixel, time, unknown) of each frame's background, and its own variance."""
    energy = np.sum(seen.reflection**2, axis=0)
    along = seen.reflection * ~seen.resting / energy
    of_object = np.sum(along * seen.emission, axis=0)
    parts = [
        -np.moveaxis(along * seen.contrast, 0, -1),
        -of_object[..., np.newaxis] * functions[:, np.newaxis],
        seen.resting[..., np.newaxis],
    ]
    gradient = np.concatenate(parts, axis=-1)
    return np.swapaxes(gradient, 0, 1), (~seen.resting / energy).T


def _of_ratio(part: Array, reference: int) -> Array:
    """Derivative (pixel, band, band) of each band's part over the reference's, with all parts."""
    below = part[reference]
    result = np.eye(len(part)) / below[:, np.newaxis, np.newaxis]
    result[:, :, reference] -= (part / below**2).T
    result[:, reference] = 0.0  # 1 by definition, not but for rounding
    return np.asarray(result)
