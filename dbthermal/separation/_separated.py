"""What every separation method gives back: a tile's temperatures, emissivities and flags."""

from dataclasses import dataclass, fields, replace
from typing import Any, Final, TypeVar

import numpy as np
import numpy.typing as npt

from dbthermal import schema
from dbthermal.curves import Curve

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.uint32]
Mask = npt.NDArray[np.bool_]

_BEYOND: Final = 5.0
# A temperature [K], emissivity [1] or deviation beyond is no result.
_USELESS: Final = 1e6
_RATIO: Final = "reflection_ratio"


@dataclass(frozen=True)
class Separated:
    """
    What a method finds for one tile; NaN where a quantity is undefined, with a flag that says so.

    Attributes
    ----------
    object_temperature, object_temperature_std : ndarray, shape (time, pixel)
        Object temperature and its standard deviation [K].
    background_temperature, background_temperature_std : ndarray, shape (time, pixel)
        Background temperature and its standard deviation [K].
    emissivity, emissivity_std : ndarray, shape (band, pixel)
        Emissivities and their standard deviations [1].
    status : ndarray of uint32, shape (pixel,)
        Bits of `schema.FLAGS`.
    reflection_ratio, reflection_ratio_std : ndarray, shape (band, pixel), optional
        Reflections over that of the first band, and their standard deviations [1]; None for a
        method that does not go through them.
    """

    object_temperature: Array
    object_temperature_std: Array
    background_temperature: Array
    background_temperature_std: Array
    emissivity: Array
    emissivity_std: Array
    status: Flags
    reflection_ratio: Array | None = None
    reflection_ratio_std: Array | None = None

    def without(self, no_object: Mask, no_emissivity: Mask, no_background: Mask) -> "Separated":
        """
        Replace what is undefined by NaN, the standard deviations with the values.

        Parameters
        ----------
        no_object, no_emissivity, no_background : ndarray of bool, shape (pixel,)
            Where the quantity is undefined.

        Returns
        -------
        Separated
            The same with NaN there.
        """
        undefined = {
            "object_temperature": no_object,
            "emissivity": no_emissivity,
            "background_temperature": no_background,
        }
        return replace(
            self,
            **{
                name + ending: np.where(where, np.nan, getattr(self, name + ending))
                for name, where in undefined.items()
                for ending in ("", "_std")
            },
        )

    def of(self, pixels: Mask) -> "Separated":
        """
        Some of the pixels.

        Parameters
        ----------
        pixels : ndarray of bool, shape (pixel,)
            Which.

        Returns
        -------
        Separated
            These pixels alone.
        """
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        chosen: dict[str, Any] = {
            name: None if v is None else v[..., pixels] for name, v in values.items()
        }
        return replace(self, **chosen)

    def spread(self, frames: Mask) -> "Separated":
        """
        Put the frames of a part of the capture in their place.

        Parameters
        ----------
        frames : ndarray of bool, shape (time,)
            Frames that were used.

        Returns
        -------
        Separated
            All frames; the temperatures are NaN in those that were not used.
        """
        values = {}
        for name in ("object_temperature", "background_temperature"):
            for which in (name, f"{name}_std"):
                part = getattr(self, which)
                values[which] = np.full((frames.size, part.shape[1]), np.nan)
                values[which][frames] = part
        return replace(self, **values)

    def ranged(self, curve: Curve, *, deviations: bool = True) -> "Separated":
        """
        Flag temperatures outside the response's range, and what has no usable number.

        Parameters
        ----------
        curve : Curve
            Response of a band, for its calibrated range.
        deviations : bool
            Whether the method estimates standard deviations: a value without one is then lost.

        Returns
        -------
        Separated
            The same with `outside_response` added to the status; samples that no temperature
            gives, or whose deviation is beyond all use, are NaN. A quantity that is NaN in all
            samples needs no further flag where there is one already.
        """
        values: dict[str, Array] = {}
        beyond = np.zeros(self.status.shape, dtype=bool)
        for name in ("object_temperature", "background_temperature", "emissivity", _RATIO):
            if getattr(self, name) is None:
                continue
            value, std = getattr(self, name), getattr(self, f"{name}_std")
            lost = ~((np.abs(value) < _USELESS) & ((std < _USELESS) | (not deviations)))
            explained = np.all(np.isnan(value), axis=0) & (self.status != 0)
            beyond |= np.any(lost, axis=0) & ~explained
            values[name], values[f"{name}_std"] = (
                np.where(lost, np.nan, part) for part in (value, std)
            )
            if name.endswith("temperature"):
                beyond |= outside(value, std, curve)
        return replace(self, **values, status=self.status | flag({"outside_response": beyond}))


@dataclass(frozen=True)
class Survey:
    """
    What one tile's pixels tell of their materials.

    Attributes
    ----------
    scatter : ndarray, shape (band, band, pixel)
        Noise-whitened scatter of the rapid changes less that of the noise; zero where a pixel
        tells nothing.
    frames : ndarray, shape (pixel,)
        Degrees of freedom that it stands on.
    ratio : ndarray, shape (band, pixel)
        Reflection ratios of the pixel alone [1].
    weights : ndarray, shape (band, pixel)
        Combination without background, see `direction.Direction`.
    emissivity : ndarray, shape (pixel,)
        First emissivity of the pixel alone [1]; NaN where it tells nothing.
    own_variance, common_variance : ndarray, shape (pixel,)
        Its variance that is the pixel's own, and that which all pixels may have in common, both
        without what comes from the ratios [1].
    """

    scatter: Array
    frames: Array
    ratio: Array
    weights: Array
    emissivity: Array
    own_variance: Array
    common_variance: Array


Record = TypeVar("Record", Separated, Survey)


def updated(whole: Record, pixels: Mask, part: Record) -> Record:
    """
    Replace some pixels.

    Parameters
    ----------
    whole : Separated or Survey
        All pixels.
    pixels : ndarray of bool, shape (pixel,)
        Which to replace.
    part : Separated or Survey
        These pixels, in their order.

    Returns
    -------
    Separated or Survey
        The whole with the part put in.
    """
    values = {}
    for field in fields(whole):
        value = getattr(whole, field.name)
        if value is not None:
            values[field.name] = value.copy()
            values[field.name][..., pixels] = getattr(part, field.name)
    return replace(whole, **values)


def flag(conditions: dict[str, Mask]) -> Flags:
    """
    Combine named conditions into status bits.

    Parameters
    ----------
    conditions : dict of ndarray of bool, shape (pixel,)
        Names of `schema.FLAGS`, and where each holds.

    Returns
    -------
    ndarray of uint32, shape (pixel,)
        The bits.
    """
    parts = [holds * np.uint32(schema.FLAGS[name]) for name, holds in conditions.items()]
    return np.asarray(np.bitwise_or.reduce(parts), dtype=np.uint32)


def outside(temperature: Array, std: Array, curve: Curve) -> Mask:
    """
    Where a temperature leaves the calibrated range by more than its noise explains.

    Parameters
    ----------
    temperature, std : ndarray, shape (time, pixel)
        Temperature and standard deviation [K].
    curve : Curve
        The response.

    Returns
    -------
    ndarray of bool, shape (pixel,)
        True if any sample is more than five standard deviations outside; a deviation that is not
        estimated counts as zero.
    """
    margin = _BEYOND * np.where(np.isnan(std), 0.0, std)
    below, above = temperature < curve.lowest - margin, temperature > curve.highest + margin
    return np.asarray(np.any(below | above, axis=0))
