"""How far apart two cameras side by side see what a surface mirrors."""

from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.ndimage import distance_transform_edt, gaussian_filter

from dbthermal import _smooth as smooth
from dbthermal import noise as noises
from dbthermal import response as responses
from dbthermal import schema
from dbthermal.alignment import _clocks as clocks
from dbthermal.alignment import _matching as matching
from dbthermal.alignment._offset import sample
from dbthermal.schema import Status

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

_ORDER: Final = 10
_BLUR: Final = 0.8  # of both bands before they are matched [pixel]
_ROWS: Final = 32  # that are read at a time
_UNUSABLE: Final = int(Status.DEAD_PIXEL | Status.SATURATED | Status.INVALID_SAMPLES)
_JUDGED: Final = 4096  # pixels by which a frame is judged
_COMMON: Final = 0.5  # share of them that must be measured
_SMALLEST: Final = 24  # rows and columns of an image, at least
_KNOWN: Final = 0.2  # largest deviation of a shift from the data of a window alone [pixel]
_NEAR: Final = 0.125  # of the image's smaller side, by which a field is extrapolated


def reflection_shift(corrected: xr.Dataset, response: xr.Dataset) -> xr.Dataset:
    r"""
    Displacement between the reflections that two cameras side by side see in one surface.

    Work in progress: see the class of the result. What the other bands show at p, the reference
    band shows at p + d(p), :math:`z_2(p) = k(p) z_1(p + d(p))` of what is mirrored.

    Parameters
    ----------
    corrected : Dataset
        Stage `corrected` of `schema`, registered on the object's surface.
    response : Dataset
        Stage `response` of `schema`.

    Returns
    -------
    Dataset
        Stage `reflection_shift` of `schema`.

    Raises
    ------
    TypeError, ValueError
        If an input is not as described, or nothing is found to match.
    """
    schema.check_corrected(corrected)
    names = [str(name) for name in corrected["band"].values]
    shape = (corrected.sizes["y"], corrected.sizes["x"])
    if len(names) < 2:
        raise ValueError(f"Invalid bands {names} of the corrected. Must be two or more.")
    if min(shape) < _SMALLEST:
        raise ValueError(
            f"Invalid image of {shape[0]} rows and {shape[1]} columns. Must have at least "
            f"{_SMALLEST} of each to find a reflection's shift."
        )
    noise = _noise(corrected, response, names)
    order = [int(band) for band in np.argsort(noise, kind="stable")]
    valid = _valid(corrected)
    frames = _frames(corrected)
    first, second = (_rapid(corrected, response, band, frames, valid) for band in order[:2])
    blurred = _blurred()
    pair = matching.Pair(first, second, valid, (noise[order[0]], noise[order[1]]), blurred)
    reach = (shape[0] // 6, shape[1] // 6)
    rough, gain = matching.whole_pixels(pair, reach)
    if not np.any(gain > 50.0):
        raise ValueError("Missing texture: nothing that both bands mirror changes rapidly.")
    field = matching.refine(pair, rough, np.where(gain > 50.0, gain, 0.0) / 100.0, max(shape) / 3.0)
    return _result(corrected, field, names[order[0]], [names[band] for band in order[1:]])


def _result(
    corrected: xr.Dataset, field: matching.Field, reference: str, others: list[str]
) -> xr.Dataset:
    """Field as a dataset, NaN far from where it is known."""
    shape = field.shift.shape[1:]
    window = 2.0 * np.pi * 3.0**2
    down, both, right = (gaussian_filter(part, 3.0) * window for part in field.information)
    largest = 0.5 * (down + right) + np.hypot(0.5 * (down - right), both)
    inside = matching._inside(np.indices(shape) + field.shift, shape)
    known = (largest > 1.0 / _KNOWN**2) & inside
    near = np.asarray(distance_transform_edt(~known)) <= _NEAR * min(shape)
    near &= inside
    std = np.sqrt(np.maximum(field.covariance[[0, 2]], 0.0))
    definitions = schema.STAGES["reflection_shift"]
    values = {
        "shift": np.where(near, field.shift, np.nan).astype(np.float32),
        "shift_std": np.where(near, std, np.nan).astype(np.float32),
        "known": known,
    }
    places = {name: corrected[name] for name in ("y", "x") if name in corrected.coords}
    result = xr.Dataset(
        {name: (one.dims, values[name], one.attrs) for name, one in definitions.items()},
        coords={"axis": ["y", "x"], **places},
        attrs={**corrected.attrs, "reference_band": reference, "bands": others},
    )
    return schema.check(result, "reflection_shift")


def _noise(corrected: xr.Dataset, response: xr.Dataset, names: list[str]) -> Array:
    """Noise (band) [K], of the response or else of the capture."""
    slopes = np.array([responses.curve(response, name).reference_slope for name in names])
    if "noise" in response:
        factor = corrected["noise_factor"].values if "noise_factor" in corrected else 1.0
        return np.asarray(responses.noise(response, names) / slopes * factor)
    signals = sample(corrected)
    here = np.all(np.isfinite(signals), axis=(0, 2))
    parts = [signal[here] / slope for signal, slope in zip(signals, slopes, strict=True)]
    return noises.estimate_bands(parts, corrected["time"].values[here])


def _valid(corrected: xr.Dataset) -> Mask:
    """Pixels (y, x) that are not marked as bad."""
    if "status" not in corrected:
        return np.ones((corrected.sizes["y"], corrected.sizes["x"]), dtype=bool)
    return np.asarray((corrected["status"].values & _UNUSABLE) == 0)


def _frames(corrected: xr.Dataset) -> Mask:
    """Frames (time) in which most pixels of every band are measured."""
    step = max(1, int(np.sqrt(corrected.sizes["y"] * corrected.sizes["x"] / _JUDGED)))
    some = corrected["counts"].isel(y=slice(None, None, step), x=slice(None, None, step))
    used = np.asarray(schema.measured(some.values).mean(axis=(2, 3)).min(axis=0) > _COMMON)
    if used.sum() < noises.MINIMUM_FRAMES:
        raise ValueError(
            f"Invalid capture of {used.sum()} frames that both bands have. Must be at least "
            f"{noises.MINIMUM_FRAMES}."
        )
    return used


def _rapid(
    corrected: xr.Dataset, response: xr.Dataset, band: int, frames: Mask, valid: Mask
) -> matching.Movie:
    """What a smooth curve leaves of a band (y, x, time) [K], slightly blurred."""
    counts = corrected["counts"].isel(band=band)
    curve = responses.curve(response, str(corrected["band"].values[band]))
    times, segment = corrected["time"].values[frames], clocks.segments(corrected)[frames]
    functions = smooth.subspace(times, min(_ORDER, times.size // 4), segment=segment).functions
    result = np.zeros((*valid.shape, times.size), dtype=np.float32)
    for start in range(0, valid.shape[0], _ROWS):
        block = counts.isel(y=slice(start, start + _ROWS)).values[frames]
        flat = block.reshape(len(block), -1) / curve.reference_slope
        flat = np.where(schema.measured(flat), flat, np.nan)
        flat -= _mean(flat)
        np.nan_to_num(flat, copy=False)
        flat -= functions @ (functions.T @ flat)
        result[start : start + _ROWS] = np.moveaxis(flat.reshape(block.shape), 0, -1)
    result[~valid] = 0.0
    return np.asarray(gaussian_filter(result, (_BLUR, _BLUR, 0.0)))


def _mean(flat: Array) -> Array:
    """Mean over the frames (pixel) of samples (time, pixel) of which some are NaN."""
    number = np.isfinite(flat).sum(axis=0)
    return np.asarray(np.nansum(flat, axis=0) / np.maximum(number, 1))


def _blurred() -> tuple[float, float]:
    """Noise of value and slope over that before the blur."""
    impulse = np.zeros((33, 33, 1), dtype=np.float32)
    impulse[16, 16] = 1.0
    kernel = gaussian_filter(impulse, (_BLUR, _BLUR, 0.0))
    slope = 0.5 * (kernel[2:] - kernel[:-2])
    return float(np.sqrt(np.sum(kernel**2))), float(np.sqrt(np.sum(slope**2)))
