"""Errors as the paper reports them, and reflections as pictures."""

import xarray as xr
from scipy.constants import zero_Celsius

from dbthermal import schema
from dbthermal._coordinates import laid_on

__all__ = ["reflected_change", "relative_error_celsius"]
__dir__ = __all__.copy


def relative_error_celsius(estimate: xr.DataArray, truth: xr.DataArray) -> xr.DataArray:
    r"""Error in per cent of the true temperature in degrees Celsius, as the paper reports it.

    .. math:: 100 \, |\hat T - T| / (T - 273.15)

    The zero of the Celsius scale is arbitrary, and so is this number; it is here to stand beside
    the published ones (Narayanan et al. 2026, doi:10.48550/arXiv.2509.11334) and is labelled. Both
    are temperatures [K] of the same coordinates.

    Examples
    --------
    Half a kelvin at 25 degrees Celsius:

    >>> import xarray as xr
    >>> truth = xr.DataArray(298.15)
    >>> round(float(relative_error_celsius(truth + 0.5, truth)), 6)  # [percent]
    2.0
    """
    result = 100.0 * abs(estimate - truth) / (truth - zero_Celsius)
    label = "error relative to the true temperature in degrees Celsius"
    bare: xr.DataArray = result.drop_attrs(deep=False).rename("relative_error")
    return bare.assign_attrs(long_name=label, units="percent")


def reflected_change(apparent: xr.DataArray, result: xr.Dataset) -> xr.DataArray:
    r"""Change of the first band's apparent temperature that the reflection causes.

    .. math:: (1 - e_1) (y - \bar y)

    with the mean over time, in the linear response of small changes, (time, y, x) [K], float32; NaN
    where the reflection is unknown. Of a constant object without a completed background it is the
    change of the apparent temperature. That is of the inputs (band, time, y, x) [K], from
    `response.apparent_temperature`; the result from `solve`, `separate` or `complete`, of the same
    capture. ValueError if the first bands, sizes or coordinates differ.

    Examples
    --------
    Plate glass, of reflectivity 0.14, reflects people who are 10 K warmer than the room:

    >>> import numpy as np
    >>> from dbthermal import response, separation, simulation
    >>> rig, rng = simulation.Rig(), np.random.default_rng(1)
    >>> glass = xr.DataArray([0.86, 0.72], coords={"band": list(rig.bands)}, dims="band")
    >>> scene = simulation.walkers(np.arange(200) / 10, (4, 6), glass, rng)
    >>> capture = simulation.observe(scene, rig.response(), rng)
    >>> apparent = response.apparent_temperature(rig.response(), capture["counts"])
    >>> change = reflected_change(apparent, separation.solve(capture, rig.response()))
    >>> bool(1.2 < (change.max("time") - change.min("time")).median() < 1.8)  # 1.4 K and noise
    True
    """
    if str(apparent["band"].values[0]) != str(result["band"].values[0]):
        raise ValueError(
            f"Invalid first band '{apparent['band'].values[0]}'. "
            f"Must be '{result['band'].values[0]}', as in the result."
        )
    first = apparent.isel(band=0, drop=True)
    first = laid_on(first, result, "the apparent temperature", "the result")
    background = result["background_temperature"]
    reflectivity = 1.0 - result["emissivity"].isel(band=0, drop=True)
    change = (background - background.mean("time")) * reflectivity
    constant = (result["status"] & int(schema.Status.CONSTANT_OBJECT)) != 0
    without = constant & background.isnull().all("time")
    change = change.where(~without, first - first.mean("time"))
    attrs = {"units": "K", "long_name": "reflection, change of the apparent temperature"}
    return change.astype("float32").rename("reflected_change").assign_attrs(attrs)
