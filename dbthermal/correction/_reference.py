"""Reference in view: patches of known temperature, which renew each camera's level and gain."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import _numbers, _rows, schema
from dbthermal import response as responses
from dbthermal._coordinates import laid_on

_PATCHES = schema.Variable(("patch", "y", "x"), "bool", "1", "pixels of a patch")


@dataclass(frozen=True)
class Reference:
    """Patches in view, nearly black, whose temperature is known, for `correct_capture`.

    TypeError or ValueError if an attribute is not as described.

    Attributes
    ----------
    response : Dataset
        Stage `response` of `schema`: the counts that a patch should have.
    patches : DataArray
        True at the pixels of each patch, (patch, y, x), bool.
    temperatures : tuple of float
        Of each patch, mean over the capture [K]; two or more differ.
    temperature_std : float
        Standard deviation of the error that they share [K].
    """

    response: xr.Dataset
    patches: xr.DataArray
    temperatures: tuple[float, ...]
    temperature_std: float = 0.1

    def __post_init__(self) -> None:
        schema.check(self.response, "response")
        schema.check_variable(self.patches, _PATCHES, "the patches")
        shape = (self.patches.sizes["patch"],)
        values = _numbers.real_numbers("temperatures [K]", self.temperatures, shape=shape)
        if len(values) > 1 and not np.ptp(values) > 0.0:
            raise ValueError(f"Invalid temperatures {values.tolist()} K of patches. Must differ.")
        _numbers.real_number("temperature_std [K]", self.temperature_std, _numbers.POSITIVE)


def refer(corrected: xr.Dataset, reference: Reference, *, lazy: bool) -> xr.Dataset:
    """Counts (band, time, y, x) with the level, and by several patches the gain, of a reference.

    Attribute ``level_reference`` has what remains unknown, see `response.accuracy`.
    """
    counts, names = corrected["counts"], [str(name) for name in corrected["band"].values]
    masks = laid_on(reference.patches, corrected, "the patches", "the capture").values.copy()
    if "status" in corrected:
        masks &= corrected["status"].values == 0
    if np.any(few := masks.sum(axis=(1, 2)) < 2):
        raise ValueError(f"Invalid patch {int(np.argmax(few))}. Must have two good pixels or more.")
    # Mean of the patches over time, and how it scatters over their pixels.
    means, stds = [], []
    for mask in masks:
        rows, columns = (xr.DataArray(places, dims="pixel") for places in np.nonzero(mask))
        pixels = counts.isel(y=rows, x=columns).mean("time", dtype=np.float64)
        means.append(pixels.mean("pixel").values)
        stds.append(pixels.std("pixel", ddof=1).values / np.sqrt(rows.size))
    # Line from the measured to the expected counts of each band.
    temperatures = np.asarray(reference.temperatures, dtype=np.float64)
    remaining, lines = {}, np.empty((2, len(names), 1, 1, 1))
    for band, curve in enumerate(responses.curves(reference.response, names)):
        seen = np.array([mean[band] for mean in means])
        wanted = curve.counts(temperatures)
        gain = np.polyfit(seen, wanted, 1)[0] if len(seen) > 1 else 1.0
        lines[:, band, 0, 0, 0] = gain, np.mean(wanted - gain * seen)
        errors = np.array([std[band] for std in stds]) / curve.count_slope(temperatures)
        remaining[names[band]] = {"offset_std": float(np.sqrt(np.mean(errors**2) / len(errors)))}
        if len(errors) > 1:
            scatter = np.sum((temperatures - temperatures.mean()) ** 2)
            remaining[names[band]]["gain_std"] = float(np.sqrt(np.mean(errors**2) / scatter))

    def referred(window: slice) -> npt.NDArray[np.floating]:
        """Counts of some rows on the line."""
        values = counts.isel(y=window).values
        return np.asarray(lines[0] * values + lines[1], dtype=values.dtype)

    result = _rows.lazy(referred, counts) if lazy else counts.copy(data=referred(slice(None)))
    level = {"temperature": float(temperatures.mean()), "std": reference.temperature_std}
    return corrected.assign(counts=result).assign_attrs(
        level_reference={**level, "bands": remaining}
    )
