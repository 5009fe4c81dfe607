"""What every separation method is given, and what it is."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from dbthermal import mixing
from dbthermal.curves import Curve
from dbthermal.separation._separated import Array, Mask, Separated, Survey


@dataclass(frozen=True)
class Shared:
    """
    What the pixels of one material share, spread over a tile.

    Attributes
    ----------
    ratio : ndarray, shape (band, pixel)
        Reflection ratios [1]; NaN for a pixel that shares nothing.
    spread : ndarray, shape (pixel,)
        Their variance, see `direction.Direction` [1/K^2].
    emissivity : ndarray, shape (pixel,)
        Emissivity of the first band [1]; NaN for a pixel that has its own.
    own_variance, common_variance : ndarray, shape (pixel,)
        Its variances, as those of `Survey` [1].
    """

    ratio: Array
    spread: Array
    emissivity: Array
    own_variance: Array
    common_variance: Array


@dataclass(frozen=True)
class Problem:
    """
    One tile of a corrected capture, the quietest band first.

    Attributes
    ----------
    signals : ndarray, shape (band, time, pixel)
        Linearised signals less the reference temperature [K]; finite.
    time : ndarray, shape (time,)
        Times [s].
    curves : tuple of Curve
        Response of each band, with one reference temperature.
    noise : tuple of float
        Standard deviation of the signals' noise [K], at the reference temperature.
    shape : tuple of int
        Rows and columns of the tile; its pixels follow one another along the rows.
    rng : Generator
        The tile's own source of randomness, for random starts.
    segment : ndarray of int, shape (time,), optional
        Number of shutter events before each frame.
    shared : Shared, optional
        What the pixels of one material share.
    emissivity, emissivity_std : ndarray, shape (band, pixel), optional
        Known emissivities and their standard deviations [1], for methods that need them.
    """

    signals: Array
    time: Array
    curves: tuple[Curve, ...]
    noise: tuple[float, ...]
    shape: tuple[int, int]
    rng: np.random.Generator
    segment: npt.NDArray[np.intp] | None = None
    shared: Shared | None = None
    emissivity: Array | None = None
    emissivity_std: Array | None = None

    @property
    def reference(self) -> float:
        """Reference temperature [K] that the signals are relative to."""
        return self.curves[0].reference

    def blackbody(self, band: int, temperature: Array) -> Array:
        """
        Signal of a blackbody in a band, relative to the reference.

        Parameters
        ----------
        band : int
            Position of the band.
        temperature : ndarray
            Temperature [K].

        Returns
        -------
        ndarray
            Signal [K].
        """
        return self.curves[band].signal(temperature) - self.reference

    def temperature(self, band: int, signal: Array) -> Array:
        """
        Inverse of `blackbody`.

        Parameters
        ----------
        band : int
            Position of the band.
        signal : ndarray
            Signal relative to the reference [K].

        Returns
        -------
        ndarray
            Temperature [K]; NaN where there is none.
        """
        return self.curves[band].temperature(signal + self.reference)

    def mixed(self, emissivity: Array, temperatures: Array) -> Array:
        """Signals (band, time, pixel) [K] of object and background (2, time, pixel) [K]."""
        x, y = temperatures
        return np.stack(
            [
                mixing.mixed(share, self.blackbody(band, x), self.blackbody(band, y))
                for band, share in enumerate(emissivity)
            ]
        )

    def at(self, frames: Mask) -> "Problem":
        """
        Some of the frames.

        Parameters
        ----------
        frames : ndarray of bool, shape (time,)
            Which.

        Returns
        -------
        Problem
            The same problem with these frames alone.
        """
        return replace(
            self,
            signals=self.signals[:, frames],
            time=self.time[frames],
            segment=None if self.segment is None else self.segment[frames],
        )

    def of(self, pixels: Mask) -> "Problem":
        """
        Some of the pixels.

        Parameters
        ----------
        pixels : ndarray of bool, shape (pixel,)
            Which.

        Returns
        -------
        Problem
            The same problem of these pixels alone, as one row.
        """
        shared = self.shared
        if shared is not None:
            values = (getattr(shared, field.name)[..., pixels] for field in fields(shared))
            shared = Shared(*values)
        given: dict[str, Any] = {
            name: None if getattr(self, name) is None else getattr(self, name)[..., pixels]
            for name in ("emissivity", "emissivity_std")
        }
        signals = self.signals[..., pixels]
        return replace(self, signals=signals, shape=(1, signals.shape[2]), shared=shared, **given)


@dataclass(frozen=True)
class Method:
    """
    A method of separation: what its module hands to `solve`.

    Attributes
    ----------
    separate : callable
        From a `Problem`, and the settings where there are any, to a `Separated`.
    settings : type, optional
        Frozen dataclass of the method's options; a field `batch` is the pixels in a tile.
    minimum_frames : int
        Fewest frames.
    knows_emissivity : bool
        Whether it must be given the emissivities.
    whole_image : bool
        Whether it looks at a pixel's neighbours, so that a tile is the whole image.
    every_frame : bool
        Whether all pixels must have the same frames: one that lacks any of them is not solved.
    survey : callable, optional
        For methods that pool the pixels of one material: from the same arguments to a `Survey`.
    any_bands : bool
        Whether it takes more than two bands.
    not_estimated : tuple of str
        Names of `Separated` that it leaves NaN everywhere.
    """

    separate: Callable[..., Separated]
    settings: type[Any] | None = None
    minimum_frames: int = 1
    knows_emissivity: bool = False
    whole_image: bool = False
    every_frame: bool = False
    survey: Callable[..., Survey] | None = None
    any_bands: bool = False
    not_estimated: tuple[str, ...] = ()
