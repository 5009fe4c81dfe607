"""Errors of temperatures as the paper states them, relative to degrees Celsius."""

import numpy as np
import xarray as xr
from scipy.constants import zero_Celsius

from dbthermal import schema
from dbthermal._coordinates import laid_on


def relative_error_celsius(estimate: xr.DataArray, truth: xr.DataArray) -> xr.DataArray:
    r"""Error in per cent of the true temperature in degrees Celsius, as the paper reports it.

    .. math:: 100 \, |\hat T - T| / (T - 273.15)

    The zero of the Celsius scale is arbitrary, and so is this number; it is here to stand beside
    the published ones (Narayanan et al. 2026, doi:10.48550/arXiv.2509.11334) and is labelled.

    Parameters
    ----------
    estimate, truth : DataArray
        Temperatures [K] of the same coordinates, the true ones above 273.15 K, or a ValueError.
        The result is NaN where the estimate is.

    Examples
    --------
    Half a kelvin at 25 degrees Celsius:

    >>> import xarray as xr
    >>> truth = xr.DataArray(298.15)
    >>> round(float(relative_error_celsius(truth + 0.5, truth)), 6)  # [percent]
    2.0
    """
    schema.check_numbers(estimate, "the estimate", "K")
    schema.check_numbers(truth, "the truth", "K")
    if not {*truth.dims} <= {*estimate.dims}:
        rule = f"Must be among {estimate.dims}"
        raise ValueError(f"Invalid dims {truth.dims} of the reference. {rule}.")
    bad = ~(truth.values > zero_Celsius)
    if np.any(bad):
        rule = f"Must be above {zero_Celsius} K, the zero of degrees Celsius"
        raise ValueError(f"Invalid true temperature {truth.values[bad].flat[0]} K. {rule}.")
    truth = laid_on(truth, estimate, "the truth", "the estimate")
    result = 100.0 * abs(estimate - truth) / (truth - zero_Celsius)
    label = "error relative to the true temperature in degrees Celsius"
    bare: xr.DataArray = result.drop_attrs(deep=False).rename("relative_error")
    return bare.assign_attrs(long_name=label, units="percent")
