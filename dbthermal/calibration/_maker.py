"""Response from the maker's constants, where there is no blackbody."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import xarray as xr

from dbthermal import planck, schema
from dbthermal.calibration._response import fit_band
from dbthermal.response import COEFFICIENTS

NO_BARS: Final = "maker's constants, without error bars"

_POINTS: Final = 64  # at which the curve is fitted, over the camera's range
_LARGEST_ERROR: Final = 0.2  # of the Sakuma-Hattori form of a maker's curve [K]


def maker_response(files: Mapping[str, Mapping[str, Any]]) -> xr.Dataset:
    r"""Response of each band from the Planck constants that its maker wrote into the file.

    .. math:: I(T) = \frac{R_1}{R_2 (\exp(B / T) - F)} - O

    is, for F = 1, the Sakuma-Hattori curve with :math:`C = R_1 / R_2`, :math:`A = c_2 / B` and no
    shift; for another F the curve is fitted over the camera's range, with an error that is stated.

    These constants have no error bars, and what a filter in front of the lens takes away is not in
    them. So all deviations of a result count noise alone: results say so in ``calibration``. The
    maker states 2 K or 2 % as a rule; a blackbody and `fit_response` are the better way.

    Emissivity, distance and reflected temperature of the file are not used.

    Parameters
    ----------
    files : mapping
        Attributes of a recording by band: ``capture.attrs["files"]`` of `readers.two_bands`, or
        ``{"8-14": recording.attrs}`` with a recording from `readers.flir`.

    Returns
    -------
    Dataset
        Stage `response` of `schema`, without `noise`, over the range of temperatures that the
        cameras share. Attributes ``calibration`` ("maker's constants, without error bars") and
        ``form_error`` [K], the largest error of the form.

    Raises
    ------
    ValueError
        If a constant is missing or not positive, the ranges do not overlap, or the form does not
        fit.

    References
    ----------
    .. [1] Tattersall (2017), Thermimage, doi:10.5281/zenodo.1069704, for the maker's formula

    Examples
    --------
    >>> from dbthermal import response
    >>> constants = {"R1": 21106.77, "R2": 0.012545258, "B": 1501.0, "F": 1.0, "O": -7340}
    >>> attrs = {f"file_planck_{key}": value for key, value in constants.items()}
    >>> made = maker_response({"8-14": attrs | {"file_range_min": 253.0, "file_range_max": 393.0}})
    >>> round(float(response.curve(made, "8-14").inverse(18000.0)), 2)  # [K]
    296.18
    """
    if not files:
        raise ValueError("Empty mapping of files. Must have the attributes of one band at least.")
    ranges = [
        [_constant(attrs, f"range_{end}", band) for end in ("min", "max")]
        for band, attrs in files.items()
    ]
    lowest, highest = max(low for low, _ in ranges), min(high for _, high in ranges)
    if not lowest < highest:
        raise ValueError(f"Invalid ranges {ranges} K of the bands {[*files]}. Must overlap.")
    temperature = np.linspace(lowest, highest, _POINTS)
    error, rows = 0.0, []
    for band, attrs in files.items():
        r1, r2, b, f = (_constant(attrs, f"planck_{key}", band) for key in ("R1", "R2", "B", "F"))
        offset = -_constant(attrs, "planck_O", band, positive=False)
        if not np.exp(b / highest) > f:
            raise ValueError(f"Invalid planck_F {f} of '{band}'. Must be below exp(B / T).")
        counts = r1 / (r2 * (np.exp(b / temperature) - f)) + offset
        curve = fit_band(band, temperature, counts)
        error = max(error, float(np.max(np.abs(curve.inverse(counts) - temperature))))
        if error > _LARGEST_ERROR:
            rule = f"Must be at most {_LARGEST_ERROR} K: fit a blackbody, by fit_response"
            raise ValueError(f"Invalid form of '{band}', F = {f:g}: {error:.2g} K off. {rule}.")
        line = np.polynomial.Polynomial.fit(temperature, counts, 1).convert().coef[::-1]
        rows.append([curve.amplitude, curve.wavelength, curve.shift, curve.offset, *line])
    stage = schema.STAGES["response"]
    names = [*COEFFICIENTS, "linear_slope", "linear_intercept"]
    columns = {
        name: ("band", values, stage[name].attrs)
        for name, values in zip(names, np.transpose(rows), strict=True)
    }
    scalars = {
        "reference_temperature": ((), curve.reference, stage["reference_temperature"].attrs),
        "temperature_min": ((), lowest, stage["temperature_min"].attrs),
        "temperature_max": ((), highest, stage["temperature_max"].attrs),
    }
    attrs = {"calibration": NO_BARS, "form_error": error}
    return xr.Dataset({**columns, **scalars}, {"band": [*files]}, attrs)


def _constant(attrs: Mapping[str, Any], key: str, band: str, *, positive: bool = True) -> float:
    """Constant of a file; ValueError by band if it is missing or not positive."""
    if f"file_{key}" not in attrs:
        rule = "Must be in the file, as in FLIR's: else fit a blackbody, by fit_response"
        raise ValueError(f"Missing {key} of band '{band}'. {rule}.")
    value = float(attrs[f"file_{key}"])
    if positive:
        planck.require_positive(f"{key} of band '{band}'", value)
    return value
