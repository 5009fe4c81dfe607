"""Measures of how far an estimate lies from the truth, and how well maps agree.

All take labelled arrays of one unit and the same coordinates; a shorter array, such as a curve in
time, is broadcast over the pixels. What is left out is said by a `mask`, true where a pixel counts.
A value inside the mask that is not finite is an error: an average over the pixels that happened to
work would flatter the method.
"""

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.constants import zero_Celsius

Array = npt.NDArray[np.float64]


def rmse(estimate: xr.DataArray, truth: xr.DataArray, dim: str = "time") -> xr.DataArray:
    r"""
    Root mean square error along one dimension, of each pixel.

    .. math:: \sqrt{\overline{(\hat x - x)^2}}

    Parameters
    ----------
    estimate, truth : DataArray
        Values, in one unit.
    dim : str
        Dimension to average over.

    Returns
    -------
    DataArray
        Error without `dim`, in the unit of the estimate. NaN where a sample is NaN.

    Raises
    ------
    ValueError
        If the coordinates differ, the units differ, or `dim` is missing.
    """
    error = _error(estimate, truth)
    if dim not in error.dims:
        raise ValueError(f"Missing dimension '{dim}' of the estimate. Has {error.dims}.")
    result = (error**2).mean(dim, skipna=False) ** 0.5
    units = [error.attrs["units"]] if "units" in error.attrs else []
    return _labelled(result, "rmse", "root mean square error", *units)


def median_rmse(
    estimate: xr.DataArray,
    truth: xr.DataArray,
    mask: xr.DataArray | None = None,
    dim: str = "time",
) -> float:
    """
    Median over the pixels of `rmse`.

    Parameters
    ----------
    estimate, truth : DataArray
        Values, in one unit.
    mask : DataArray of bool, optional
        Pixels that count; all by default.
    dim : str
        Dimension of the root mean square.

    Returns
    -------
    float
        Error, in the unit of the estimate.

    Raises
    ------
    ValueError
        As `rmse`, or if no pixel is left, or one that counts is not finite.
    """
    return float(np.median(_selected(rmse(estimate, truth, dim), mask)))


def bias(estimate: xr.DataArray, truth: xr.DataArray, mask: xr.DataArray | None = None) -> float:
    r"""
    Mean error, :math:`\overline{\hat x - x}`, over all samples that count.

    Parameters
    ----------
    estimate, truth : DataArray
        Values, in one unit.
    mask : DataArray of bool, optional
        Pixels or samples that count; all by default.

    Returns
    -------
    float
        Error, in the unit of the estimate; positive where the estimate is too high.

    Raises
    ------
    ValueError
        If coordinates or units differ, no sample is left, or one that counts is not finite.
    """
    return float(np.mean(_selected(_error(estimate, truth), mask)))


def coverage(
    estimate: xr.DataArray,
    std: xr.DataArray,
    truth: xr.DataArray,
    mask: xr.DataArray | None = None,
    *,
    k: float = 1.0,
) -> float:
    r"""
    Share of the samples whose truth lies within k standard deviations of the estimate.

    Of honest and normal errors 0.683 lie within k = 1 and 0.954 within k = 2.

    Parameters
    ----------
    estimate, std, truth : DataArray
        Values and their standard deviation, in one unit.
    mask : DataArray of bool, optional
        Pixels or samples that count; all by default.
    k : float
        Half width of the error bar, in standard deviations [1].

    Returns
    -------
    float
        Share [1].

    Raises
    ------
    ValueError
        If coordinates or units differ, `k` is not positive, a standard deviation that counts is
        negative, no sample is left, or one that counts is not finite.
    """
    if not k > 0:
        raise ValueError(f"Invalid k {k} of the error bars. Must be positive.")
    error, std = xr.broadcast(*_aligned(_error(estimate, truth), std))
    errors, stds = _selected(error, mask), _selected(std, mask)
    if np.any(stds < 0):
        raise ValueError(f"Invalid standard deviation {stds.min()}. Must not be negative.")
    return float(np.mean(np.abs(errors) <= k * stds))


def correlation(
    first: xr.DataArray, second: xr.DataArray, mask: xr.DataArray | None = None
) -> xr.DataArray:
    """
    Pearson's correlation of two maps, frame by frame.

    Parameters
    ----------
    first, second : DataArray
        Maps (..., y, x), each in a unit of its own.
    mask : DataArray of bool, optional
        Pixels (y, x) that count; all by default.

    Returns
    -------
    DataArray
        Correlation without y and x [1], in [-1, 1].

    Raises
    ------
    ValueError
        If coordinates differ, y or x is missing, fewer than two pixels are left, one that counts
        is not finite, or a map is the same in every pixel.
    """
    first, second = xr.broadcast(*_aligned(first, second))
    left, right = (_centred(values, mask) for values in (first, second))
    norm = np.linalg.norm(left, axis=-1) * np.linalg.norm(right, axis=-1)
    if np.any(norm <= 0):
        raise ValueError(f"Constant map in {np.sum(norm <= 0)} of {norm.size} frames. Must vary.")
    result = first.isel(y=0, x=0, drop=True).copy(data=np.sum(left * right, axis=-1) / norm)
    return _labelled(result, "correlation", "correlation of the maps", "1")


def relative_error_celsius(estimate: xr.DataArray, truth: xr.DataArray) -> xr.DataArray:
    r"""
    Error in per cent of the true temperature in degrees Celsius, as the paper reports it.

    .. math:: 100 \, |\hat T - T| / (T - 273.15)

    The zero of the Celsius scale is arbitrary, and so is this number; it is here to stand beside
    the published ones (Narayanan et al. 2026, doi:10.48550/arXiv.2509.11334) and is labelled.

    Parameters
    ----------
    estimate, truth : DataArray
        Temperatures [K].

    Returns
    -------
    DataArray
        Error [percent], of the broadcast shape. NaN where the estimate is NaN.

    Raises
    ------
    ValueError
        If coordinates differ, a unit is not K, or a true temperature is not above 273.15 K.
    """
    for values in (estimate, truth):
        if values.attrs.get("units", "K") != "K":
            raise ValueError(f"Invalid units '{values.attrs['units']}'. Must be 'K'.")
    bad = ~(truth.values > zero_Celsius)
    if np.any(bad):
        raise ValueError(
            f"Invalid true temperature {truth.values[bad].flat[0]} K. Must be above "
            f"{zero_Celsius} K, the zero of degrees Celsius."
        )
    estimate, truth = _aligned(estimate, truth)
    result = 100.0 * abs(estimate - truth) / (truth - zero_Celsius)
    label = "error relative to the true temperature in degrees Celsius"
    return _labelled(result, "relative_error", label, "percent")


def _aligned(first: xr.DataArray, second: xr.DataArray) -> tuple[xr.DataArray, xr.DataArray]:
    """Refuse what xarray would join in silence: coordinates that differ."""
    first, second = xr.align(first, second, join="exact")
    return first, second


def _error(estimate: xr.DataArray, truth: xr.DataArray) -> xr.DataArray:
    """Estimate less truth, in float64; a unit that one of them does not name is the other's."""
    units = {values.attrs["units"] for values in (estimate, truth) if "units" in values.attrs}
    if len(units) > 1:
        raise ValueError(f"Invalid units {sorted(units)}. Must be the same.")
    estimate, truth = _aligned(estimate, truth)
    return _labelled(estimate.astype(np.float64) - truth, "error", "error", *units)


def _selected(values: xr.DataArray, mask: xr.DataArray | None) -> Array:
    """Values that count, at least one and all finite."""
    chosen = values.values.ravel() if mask is None else values.values[_mask(values, mask)]
    if chosen.size == 0:
        raise ValueError("Empty mask: no value is left. Must keep at least one.")
    lost = int(np.sum(~np.isfinite(chosen)))
    if lost:
        raise ValueError(
            f"Invalid {values.name}: {lost} of {chosen.size} values that count are not finite. "
            "Must be finite; the mask says which count."
        )
    return np.asarray(chosen, dtype=np.float64)


def _mask(values: xr.DataArray, mask: xr.DataArray) -> npt.NDArray[np.bool_]:
    """Mask of the shape of the values."""
    if mask.dtype != bool or not {*mask.dims} <= {*values.dims}:
        raise ValueError(
            f"Invalid mask {mask.dims} of {mask.dtype}. Must be bool, over some of {values.dims}."
        )
    mask = _aligned(mask, values)[0]
    return np.asarray(mask.broadcast_like(values).transpose(*values.dims).values)


def _centred(maps: xr.DataArray, mask: xr.DataArray | None) -> Array:
    """Deviations from the mean of each map, (..., pixel)."""
    if not {"y", "x"} <= {*maps.dims}:
        raise ValueError(f"Invalid dims {maps.dims} of the maps. Must hold y and x.")
    if mask is not None and not {*mask.dims} <= {"y", "x"}:
        raise ValueError(f"Invalid dims {mask.dims} of the mask. Must be y and x.")
    maps = maps.transpose(..., "y", "x")
    chosen = _selected(maps, mask).reshape(*maps.shape[:-2], -1)
    if chosen.shape[-1] < 2:
        raise ValueError("Invalid mask: 1 pixel is left. Must keep at least 2.")
    return np.asarray(chosen - chosen.mean(axis=-1, keepdims=True))


def _labelled(result: xr.DataArray, name: str, long_name: str, *units: str) -> xr.DataArray:
    """Result with a name and, where it is known, its unit."""
    attrs = {"long_name": long_name} | ({"units": units[0]} if units else {})
    return result.drop_attrs(deep=False).rename(name).assign_attrs(attrs)
