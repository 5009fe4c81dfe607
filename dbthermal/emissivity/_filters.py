"""Condition numbers and noise of pairs of bands, from a table of band emissivities."""

import numpy as np
import xarray as xr

from dbthermal import _numbers, mixing, schema
from dbthermal.emissivity._tables import Bands, chosen_bands

_TEMPERATURE = 300.0  # of the object, at which a noise is stated [K]


def condition_numbers(table: xr.Dataset) -> xr.DataArray:
    """Condition number of the mixing matrix for each material and pair of bands.

    Parameters
    ----------
    table : Dataset
        Stage `emissivity_table` of `schema`, of at least two bands, its emissivities NaN or within
        `schema.EMISSIVITY_LIMITS`, or a ValueError.

    Returns
    -------
    DataArray
        Condition numbers (material, first, second) [1], symmetric; infinite on the diagonal and
        where the two emissivities are equal. See `mixing.condition_number`.

    Examples
    --------
    >>> from dbthermal.emissivity import embedded_table
    >>> numbers = condition_numbers(embedded_table()).sel(first="8-14", second="9.5")
    >>> numbers.sel(material=["plate window glass", "water"]).values.round(1).tolist()
    [9.4, 649.2]
    """
    values = _emissivities(table)
    names = values["band"].values
    if len(names) < 2:
        raise ValueError(f"Invalid bands {names.tolist()} of the table. Must be at least two.")
    first, second = np.broadcast_arrays(values.values[:, :, None], values.values[:, None, :])
    return xr.DataArray(
        mixing.condition_number(np.stack([first, second], axis=-1)),
        coords={"material": values["material"].values, "first": names, "second": names},
        dims=("material", "first", "second"),
        name="condition_number",
        attrs={"units": "1", "long_name": "condition number of the mixing matrix"},
    )


def filter_noise(netd: float, bands: Bands) -> xr.DataArray:
    r"""Noise (band) [K] of a camera behind filters, from its noise without one.

    The noise in counts is the camera's own and does not change, a kelvin at 300 K gives fewer:

    .. math:: s_m = s_1 \frac{dB_1 / dT}{dB_m / dT}

    with the first of the bands as the camera's own. A filter's emission and losses are left out.

    Parameters
    ----------
    netd : float
        Noise-equivalent temperature difference in the first band [K].
    bands : mapping or iterable of Band or str
        Bands, or names of `bands.FILTERS`, each once; the first is the one that `netd` belongs to.
        TypeError or ValueError for other bands, or an `netd` that is not positive.

    Examples
    --------
    >>> filter_noise(0.04, ["8-14", "9.5", "10.6"]).values.round(3).tolist()  # [K]
    [0.04, 0.398, 0.15]
    """
    chosen = chosen_bands(bands)
    netd = _numbers.real_number("netd [K]", netd, _numbers.POSITIVE)
    slopes = np.array([float(band.slope(_TEMPERATURE)) for band in chosen])
    return xr.DataArray(
        netd * slopes[0] / slopes,
        coords={"band": [band.name for band in chosen]},
        dims="band",
        name="noise",
        attrs={"units": "K", "long_name": "noise-equivalent temperature difference"},
    )


def _emissivities(table: xr.Dataset) -> xr.DataArray:
    """Checked emissivity (material, band) of a table; averages of measured spectra may exceed 1."""
    values = schema.check(table, "emissivity_table")["emissivity"]
    tabulated = values.values[~np.isnan(values.values)]
    _numbers.real_numbers("emissivity of the table", tabulated, within=schema.EMISSIVITY_LIMITS)
    return values
