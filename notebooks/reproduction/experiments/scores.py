"""Errors of an object temperature, and the share of its intervals that hold."""

from typing import Final

import xarray as xr
from scipy.special import ndtri

INTERVAL: Final = float(ndtri(0.975))
"""Half-width of a 95 % interval, in standard deviations [1]."""


def rmse(error: xr.DataArray) -> xr.DataArray:
    """Root mean square of an error (time, y, x) over time, median over the pixels with a value."""
    return ((error**2).mean("time") ** 0.5).median()


def held(error: xr.DataArray, std: xr.DataArray, width: float = INTERVAL) -> xr.DataArray:
    """Share of the known errors that lie within so many standard deviations [1]."""
    return (abs(error) < width * std).where(error.notnull()).mean()
