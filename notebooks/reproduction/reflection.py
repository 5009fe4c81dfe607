"""Reflections as pictures: of a result, in the first band's unit."""

import xarray as xr

from dbthermal import schema
from dbthermal._coordinates import laid_on


def reflected_change(apparent: xr.DataArray, result: xr.Dataset) -> xr.DataArray:
    r"""Change of the first band's apparent temperature that the reflection causes.

    .. math:: (1 - e_1) (y - \bar y)

    with the mean over time, in the linear response of small changes. Of a constant object without
    a completed background it is the change of the apparent temperature.

    Parameters
    ----------
    apparent : DataArray
        Apparent temperature of the inputs (band, time, y, x) [K], from
        `response.apparent_temperature`.
    result : Dataset
        From `solve`, `separate` or `complete`, of the same capture.

    Returns
    -------
    DataArray
        (time, y, x) [K], float32; NaN where the reflection is unknown.

    Raises
    ------
    ValueError
        If a variable is missing, emissivities are in per cent, or the first bands, dims, sizes or
        coordinates differ.

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
    schema.check_numbers(apparent, "the apparent temperature", "K")
    if not isinstance(result, xr.Dataset):
        raise TypeError(f"Invalid result of type {type(result).__name__}. Must be a Dataset.")
    if apparent.dims != ("band", "time", "y", "x"):
        rule = "Must be ('band', 'time', 'y', 'x')"
        raise ValueError(f"Invalid dims {apparent.dims} of the apparent temperature. {rule}.")
    if str(apparent["band"].values[0]) != str(result["band"].values[0]):
        raise ValueError(
            f"Invalid first band '{apparent['band'].values[0]}'. "
            f"Must be '{result['band'].values[0]}', as in the result."
        )
    needed = ("background_temperature", "emissivity", "status")
    schema.check(result, "separated", needed, "the result")
    if (usual := float(result["emissivity"].median())) > schema.EMISSIVITY_LIMITS[1]:
        message = f"Invalid emissivities of the result, {usual:.3g} in the median"
        raise ValueError(f"{message}. Must be shares of one, not per cent.")
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
