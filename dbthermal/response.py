"""The camera's response, a Dataset per band (see `schema`), made by `calibration.fit_response`.

`curve` makes a `curves.Curve` of one band of it, in which everything downstream computes.
"""

from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import planck, schema
from dbthermal.curves import Curve, Line, require_range

Array = npt.NDArray[np.float64]

KINDS: Final = ("exact", "linear")
"""Kinds of response: the Sakuma-Hattori curve, and the paper's linear approximation."""

_SLOPE_POINTS: Final = 16

COEFFICIENTS: Final = ("amplitude", "effective_wavelength", "wavelength_shift", "offset")
"""Variables of a response that hold the Sakuma-Hattori curve."""


def curve(response: xr.Dataset, band: str, kind: str = "exact") -> Curve:
    """
    Return the curve of one band.

    Parameters
    ----------
    response : Dataset
        Stage `response` of `schema`.
    band : str
        Name of the band.
    kind : {"exact", "linear"}
        Sakuma-Hattori, or the linear pair.

    Returns
    -------
    Curve
        The curve.

    Raises
    ------
    ValueError
        If the band is missing, the kind unknown, a coefficient not finite, or the slope not
        positive.
    """
    if kind not in KINDS:
        raise ValueError(f"Unknown kind of response '{kind}'. Must be one of {KINDS}.")
    schema.check(response, "response")
    (place,) = schema.band_positions(response, [band], "the response")
    here = response.isel(band=place)
    number = {str(name): float(here[name]) for name in schema.STAGES["response"]}
    bad = [name for name, value in number.items() if not np.isfinite(value)]
    if bad:
        raise ValueError(f"Invalid {bad[0]} of the response in band '{band}'. Must be finite.")
    common = (number["reference_temperature"], number["temperature_min"], number["temperature_max"])
    if kind == "linear":
        slope, intercept = number["linear_slope"], number["linear_intercept"]
        result: Curve = Line(band, slope, 0.0, 0.0, intercept, *common)
    else:
        shape = (number["effective_wavelength"], number["wavelength_shift"], number["offset"])
        result = Curve(band, number["amplitude"], *shape, *common)
    slopes = result.count_slope(np.linspace(result.lowest, result.highest, _SLOPE_POINTS))
    if not np.all(slopes > 0):
        raise ValueError(
            f"Invalid slope {slopes.min()} count/K of the response in band '{band}'. "
            "Must be positive over its whole range."
        )
    return result


def noise(response: xr.Dataset, bands: list[str]) -> Array:
    """
    Noise of some bands of a response.

    Parameters
    ----------
    response : Dataset
        Stage `response` of `schema`, with `noise` (band) [count].
    bands : list of str
        Names.

    Returns
    -------
    ndarray, shape (band,)
        Standard deviation of one pixel's counts [count].

    Raises
    ------
    TypeError, ValueError
        If there is no noise, its dims or unit are others, a band is missing, or a value is not
        finite and positive.
    """
    if "noise" not in response:
        raise ValueError("Missing noise of the response. Must be given to fit_response.")
    schema.check_variable(response["noise"], schema.NOISE, "'noise' of the response")
    places = schema.band_positions(response, bands, "the response")
    return planck.require_positive("noise [count]", response["noise"].values[places])


def counts(response: xr.Dataset, temperature: xr.DataArray, kind: str = "exact") -> xr.DataArray:
    """
    Counts of a blackbody in every band of a response.

    Parameters
    ----------
    response : Dataset
        Stage `response` of `schema`.
    temperature : DataArray
        Temperature [K], any dims but `band`.
    kind : {"exact", "linear"}
        Kind of response.

    Returns
    -------
    DataArray
        Counts (band, ...) [count].

    Raises
    ------
    ValueError
        If a temperature lies outside the calibrated range of the response.
    """
    names = [str(name) for name in response["band"].values]
    curves = [curve(response, name, kind) for name in names]
    values = require_range(temperature.values, curves[0], "temperature")
    parts = [temperature.copy(data=one.counts(values)) for one in curves]
    result = xr.concat(parts, dim=xr.DataArray(names, dims="band", name="band"))
    return result.assign_attrs(schema.STAGES["blackbody"]["counts"].attrs).rename("counts")


def apparent_temperature(
    response: xr.Dataset, counts: xr.DataArray, kind: str = "exact"
) -> xr.DataArray:
    """
    Temperature of the blackbody that would give the same counts, band by band.

    Parameters
    ----------
    response : Dataset
        Stage `response` of `schema`.
    counts : DataArray
        (band, ...) [count].
    kind : {"exact", "linear"}
        Kind of response.

    Returns
    -------
    DataArray
        Apparent temperature (band, ...) [K], extrapolated beyond the calibrated range; NaN where
        no temperature gives such counts.

    Raises
    ------
    ValueError
        If a band is missing in the response.
    """
    names = [str(name) for name in counts["band"].values]
    values = [
        curve(response, name, kind).inverse(part)
        for name, part in zip(names, counts.values, strict=True)
    ]
    result = counts.copy(data=np.stack(values)).rename("apparent_temperature")
    return result.assign_attrs(units="K", long_name="apparent temperature")
