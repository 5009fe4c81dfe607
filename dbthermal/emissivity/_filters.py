"""Noise of a camera behind filters."""

import numpy as np
import xarray as xr

from dbthermal import _numbers
from dbthermal.emissivity._tables import Bands, chosen_bands

_TEMPERATURE = 300.0  # of the object, at which a noise is stated [K]


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
