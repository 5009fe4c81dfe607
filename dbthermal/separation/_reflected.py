"""The reflection as a picture: what it changes in the first band, where it can be told."""

import xarray as xr

from dbthermal import schema


def reflected_change(apparent: xr.DataArray, result: xr.Dataset) -> xr.DataArray:
    r"""
    Change of the first band's apparent temperature that the reflection makes.

    .. math:: (1 - e_1) (y - \bar y)

    less its mean over time, in the linear response of small changes. Where the object is constant
    its emissivity is undefined, but then all that changes is reflected: there it is the apparent
    temperature less its own mean.

    Parameters
    ----------
    apparent : DataArray
        Apparent temperature of the inputs (band, time, y, x) [K], from
        `response.apparent_temperature`.
    result : Dataset
        From `solve`, of the same capture.

    Returns
    -------
    DataArray
        (time, y, x) [K], float32; NaN where neither is known.

    Raises
    ------
    ValueError
        If the first bands differ.
    """
    if str(apparent["band"].values[0]) != str(result["band"].values[0]):
        raise ValueError(
            f"Invalid first band '{apparent['band'].values[0]}'. "
            f"Must be '{result['band'].values[0]}', as in the result."
        )
    first = apparent.isel(band=0, drop=True)
    background = result["background_temperature"]
    share = 1.0 - result["emissivity"].isel(band=0, drop=True)
    known = (background - background.mean("time")) * share
    constant = (result["status"] & schema.FLAGS["constant_object"]) != 0
    found = known.where(~constant, first - first.mean("time"))
    names = {"units": "K", "long_name": "reflection, change of the apparent temperature"}
    return found.astype("float32").rename("reflected_change").assign_attrs(names)
