"""Pictures of a capture in which borders show: means over time, and what of them is reflected."""

from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.special import ndtri

from dbthermal import response as responses

Array = npt.NDArray[np.float64]

_ROWS: Final = 64
"""Rows of a capture that are read at a time."""

_MAD: Final = 1.0 / float(ndtri(0.75))


def means(
    corrected: xr.Dataset, response: xr.Dataset, bands: list[int], noise: Array
) -> tuple[Array, Array]:
    """
    Linearised signals, mean over the frames, and their variances.

    Where neighbours differ by more than the noise explains, as by a fixed pattern that is left,
    that is added to the variance.

    Parameters
    ----------
    corrected, response : Dataset
        As of `materials`.
    bands : list of int
        Positions of the bands, the reference first.
    noise : ndarray, shape (band,)
        Their noise [K].

    Returns
    -------
    tuple of ndarray, shape (band, y, x)
        Means [K], NaN where there is no sample, and variances [K2].
    """
    counts = corrected["counts"]
    shape = (len(bands), counts.sizes["y"], counts.sizes["x"])
    found, frames = np.empty(shape), np.empty(shape)
    for index, band in enumerate(bands):
        curve = responses.curve(response, str(counts["band"].values[band]))
        for top in range(0, shape[1], _ROWS):
            rows = slice(top, top + _ROWS)
            part = counts.isel(band=band, y=rows).astype(np.float64)
            found[index, rows] = curve.linearise(part.mean("time").values)
            frames[index, rows] = part.count("time").values
    share = np.divide(1.0, frames, out=np.full(shape, np.inf), where=frames > 0)
    variances = noise[:, np.newaxis, np.newaxis] ** 2 * share
    for index in range(1, len(bands)):
        known = float(np.median(variances[0] + variances[index]))
        pattern = _scatter(found[index] - found[0]) ** 2 - known
        variances[index] += max(pattern, 0.0)
    return found, variances


def change(corrected: xr.Dataset, response: xr.Dataset, band: int) -> Array:
    """
    Mean linearised signal of the last third of the frames, less that of the first.

    Parameters
    ----------
    corrected, response : Dataset
        As of `materials`.
    band : int
        Position of the band.

    Returns
    -------
    ndarray, shape (y, x)
        The object's change as that band sees it [K].
    """
    counts = corrected["counts"].isel(band=band)
    curve = responses.curve(response, str(corrected["band"].values[band]))
    third = max(counts.sizes["time"] // 3, 1)
    first, last = (
        counts.isel(time=part).mean("time", dtype=np.float64).values
        for part in (slice(third), slice(-third, None))
    )
    return np.asarray((last - first) / curve.reference_slope)


def reflected(result: xr.Dataset, bands: list[int]) -> tuple[Array, Array]:
    r"""
    Reflection in the differences of the bands' mean signals, and its variance.

    .. math:: (k_m - 1) (1 - e_{ref}) (\bar y - \mathrm{median}\, y)

    The median is the background at rest, which makes no edges. 0 where there is no background:
    that is where nothing moved.

    Parameters
    ----------
    result : Dataset
        As of `materials`.
    bands : list of int
        Positions of the bands, the reference first.

    Returns
    -------
    tuple of ndarray, shape (band - 1, y, x)
        Reflection [K] and variance [K2].
    """
    share = (result["reflection_ratio"].values[bands[1:]] - 1.0) * (
        1.0 - result["emissivity"].values[bands[0]]
    )
    shape, frames = share.shape[1:], result.sizes["time"]
    excess, deviation = np.empty(shape), np.empty(shape)
    for top in range(0, shape[0], _ROWS):
        rows = slice(top, top + _ROWS)
        background = result["background_temperature"].isel(y=rows).values
        excess[rows] = background.mean(axis=0) - np.median(background, axis=0)
        deviation[rows] = result["background_temperature_std"].isel(y=rows).values.mean(axis=0)
    # Variance of a mean less a median of normal noise, times the number of samples.
    variance = (np.pi / 2 - 1) * (share * deviation) ** 2 / frames
    known = np.isfinite(share * excess * variance)
    return np.where(known, share * excess, 0.0), np.where(known, variance, 0.0)


def _scatter(picture: Array) -> float:
    """Robust standard deviation from pixel to pixel [K], a fixed pattern's included; 0 if none."""
    bend = (picture[2:] - 2.0 * picture[1:-1] + picture[:-2]) / np.sqrt(6.0)
    known = np.abs(bend[np.isfinite(bend)])
    return _MAD * float(np.median(known)) if known.size else 0.0
