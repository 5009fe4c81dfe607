"""Response of a camera per band from blackbodies: Sakuma-Hattori curve and linear pair."""

from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.optimize import least_squares

from dbthermal import bands, planck, schema
from dbthermal import response as responses

Array = npt.NDArray[np.float64]

AMBIENT: Final = 298.15
"""Ambient temperature [K]; a response refers to the calibrated temperature nearest to it."""

MINIMUM_TEMPERATURES: Final = 4
"""Fewest blackbody temperatures: the Sakuma-Hattori curve has four parameters."""

# Bounds of the two shape parameters: the scale A T + B at the middle temperature relative to
# c2 / 5 (about 1 at 10 um and 300 K), and its relative growth A T / (A T + B), 1 at a single
# wavelength. The largest scale is that of a straight line.
_SHAPE_BOUNDS: Final = ((0.02, 0.3), (1e3, 2.0))
_SHAPE_START: Final = (1.0, 1.0)
_SHAPE_UNIT: Final = planck.SECOND_RADIATION_CONSTANT / 5.0
# Counts may bend downward by so many standard deviations, plus this fraction of their span.
_CURVATURE_SIGMAS: Final = 5.0
_CURVATURE: Final = 0.003


def fit_response(counts: xr.DataArray, noise: xr.DataArray | None = None) -> xr.Dataset:
    r"""
    Fit the response of each band to blackbody measurements.

    .. math:: U(T) = \frac{C}{\exp(c_2 / (A T + B)) - 1} + O, \qquad U(T) \approx a T + b

    the Sakuma-Hattori curve [1]_ and the least-squares line. C and O enter linearly and are
    eliminated [2]_; A and B are found by nonlinear least squares.

    Parameters
    ----------
    counts : DataArray
        Mean counts (band, temperature) [count] of a blackbody, `temperature` [K] increasing, at
        least four.
    noise : DataArray, optional
        Standard deviation of one pixel's counts from frame to frame, (band) [count]. The response
        then has it, and its NETD.

    Returns
    -------
    Dataset
        Stage `response` of `schema`: `amplitude` C, `effective_wavelength` A, `wavelength_shift` B,
        `offset` O, `linear_slope` a, `linear_intercept` b (band); `residual`, `linear_residual`
        (band, temperature) [count] and the measured `counts`; `reference_temperature`,
        `temperature_min`, `temperature_max` [K]; and, with a noise, `noise` (band) [count] and
        `netd` (band) [K].

    Raises
    ------
    TypeError, ValueError
        If the counts are not a DataArray of numbers, dims, units or order are wrong, there are too
        few temperatures, a value is NaN, counts do not grow with temperature, or the noise does not
        fit the bands or is not positive.

    References
    ----------
    .. [1] Sakuma, Hattori (1982), in Temperature: its Measurement and Control in Science and
       Industry 5, 421-427
    .. [2] Golub, Pereyra (2003), Inverse Problems 19, R1, doi:10.1088/0266-5611/19/2/201

    Examples
    --------
    Blackbodies from 10 to 70 degrees Celsius, seen in the band 8-14 um at 100 count W^-1 m^2 sr.

    >>> import numpy as np, xarray as xr
    >>> from dbthermal import bands
    >>> temperature = np.linspace(283.15, 343.15, 7)
    >>> counts = xr.DataArray(
    ...     [15000 + 100 * bands.get("8-14").radiance(temperature)],
    ...     dims=("band", "temperature"),
    ...     coords={"band": ["8-14"], "temperature": temperature},
    ... )
    >>> noise = xr.DataArray([3.0], dims="band", coords={"band": ["8-14"]})
    >>> fitted = fit_response(counts, noise)
    >>> bool(np.abs(fitted.residual).max() < 0.5), round(float(fitted.netd[0]), 3)  # [count], [K]
    (True, 0.038)
    """
    _check_blackbody(counts)
    names = [str(name) for name in counts["band"].values]
    temperature = counts["temperature"].values.astype(np.float64)
    values = counts.values.astype(np.float64)
    rows = [_fit_band(temperature, row) for row in values]
    parameters = [*responses.COEFFICIENTS, "linear_slope", "linear_intercept"]
    stage = schema.STAGES["response"]
    variables: dict[str, xr.DataArray] = {
        name: xr.DataArray([row[index] for row in rows], dims="band", attrs=stage[name].attrs)
        for index, name in enumerate(parameters)
    }
    scalars = {
        "reference_temperature": temperature[np.argmin(np.abs(temperature - AMBIENT))],
        "temperature_min": temperature[0],
        "temperature_max": temperature[-1],
    }
    for name, value in scalars.items():
        variables[name] = xr.DataArray(value, attrs=stage[name].attrs)
    result = xr.Dataset(variables, coords={"band": names, "temperature": temperature})
    result["temperature"].attrs.update(units="K", long_name="blackbody temperature")
    result["counts"] = (("band", "temperature"), values, {"units": "count"})
    for name, kind in (("residual", "exact"), ("linear_residual", "linear")):
        fitted = np.stack(
            [responses.curve(result, band, kind).counts(temperature) for band in names]
        )
        result[name] = (("band", "temperature"), values - fitted, {"units": "count"})
    return result if noise is None else _with_noise(result, noise)


def _check_blackbody(counts: xr.DataArray) -> None:
    if not isinstance(counts, xr.DataArray):
        raise TypeError(f"Invalid counts of type {type(counts).__name__}. Must be a DataArray.")
    schema.check_variable(counts, schema.STAGES["blackbody"]["counts"], "the blackbody counts")
    temperature = planck.require_positive("temperature [K]", counts["temperature"].values)
    if temperature[0] < bands.TEMPERATURE_RANGE[0]:
        raise ValueError(
            f"Invalid temperature {temperature[0]} K of a blackbody. Must be at least "
            f"{bands.TEMPERATURE_RANGE[0]} K; temperatures are in kelvin."
        )
    if temperature.size < MINIMUM_TEMPERATURES:
        raise ValueError(
            f"Invalid number of blackbody temperatures {temperature.size}. "
            f"Must be at least {MINIMUM_TEMPERATURES}."
        )
    for name, row in zip(counts["band"].values, counts.values, strict=True):
        if not np.all(np.isfinite(row)):
            raise ValueError(f"Invalid counts in band '{name}': NaN or infinite. Must be finite.")
        falls = np.diff(row) <= 0
        if np.any(falls):
            place = int(np.argmax(falls))
            raise ValueError(
                f"Invalid counts {row[place + 1]} at {temperature[place + 1]} K in band '{name}', "
                f"after {row[place]} at {temperature[place]} K. Must grow with temperature."
            )
        _check_curvature(str(name), temperature, row.astype(np.float64))


def _check_curvature(band: str, temperature: Array, counts: Array) -> None:
    """Refuse counts that bend downward by more than their scatter explains."""
    middle, half = temperature.mean(), 0.5 * (temperature[-1] - temperature[0])
    design = np.polynomial.legendre.legvander((temperature - middle) / half, 2)
    coefficients, *_ = np.linalg.lstsq(design, counts, rcond=None)
    scatter = np.sqrt(np.sum((counts - design @ coefficients) ** 2) / (counts.size - 3))
    std = scatter * np.sqrt(np.linalg.inv(design.T @ design)[2, 2])
    if -coefficients[2] > _CURVATURE_SIGMAS * std + _CURVATURE * (counts[-1] - counts[0]):
        raise ValueError(
            f"Invalid counts in band '{band}': their slope falls with temperature. "
            "That of a blackbody grows."
        )


def _fit_band(temperature: Array, counts: Array) -> tuple[float, ...]:
    """Amplitude, effective wavelength, shift, offset, linear slope and intercept of one band."""
    middle = 0.5 * (temperature[0] + temperature[-1])
    span = counts[-1] - counts[0]

    def linear_part(shape: Array) -> tuple[Array, Array]:
        # Scale A T + B, and the Planckian 1 / (exp(c2 / scale) - 1) without overflow.
        scale = _SHAPE_UNIT * shape[0] * (1.0 + shape[1] * (temperature - middle) / middle)
        exponent = planck.SECOND_RADIATION_CONSTANT / scale
        planckian = np.exp(-exponent) / -np.expm1(-exponent)
        # Centred columns: the amplitude is 1e5 or more, the offset any size.
        centred = planckian - planckian.mean()
        amplitude = centred @ (counts - counts.mean()) / (centred @ centred)
        offset = counts.mean() - amplitude * planckian.mean()
        return np.array([amplitude, offset]), amplitude * planckian + offset - counts

    fit = least_squares(
        lambda shape: linear_part(shape)[1] / span,
        _SHAPE_START,
        bounds=_SHAPE_BOUNDS,
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
        max_nfev=1000,
    )
    amplitude, offset = linear_part(fit.x)[0]
    slope, intercept = np.polynomial.Polynomial.fit(temperature, counts, 1).convert().coef[::-1]
    wavelength = _SHAPE_UNIT * fit.x[0] * fit.x[1] / middle
    shift = _SHAPE_UNIT * fit.x[0] * (1.0 - fit.x[1])
    return (amplitude, wavelength, shift, offset, slope, intercept)


def _with_noise(response: xr.Dataset, noise: xr.DataArray) -> xr.Dataset:
    """Add noise and NETD (noise over slope at the reference temperature)."""
    names = [str(name) for name in response["band"].values]
    if not isinstance(noise, xr.DataArray):
        raise TypeError(f"Invalid noise of type {type(noise).__name__}. Must be a DataArray.")
    if noise.dims != ("band",):
        raise ValueError(f"Invalid dims {noise.dims} of the noise. Must be ('band',).")
    if noise.attrs.get("units", "count") != "count":
        raise ValueError(f"Invalid units '{noise.attrs['units']}' of the noise. Must be 'count'.")
    places = schema.band_positions(noise, names, "the noise")
    values = noise.values[places].astype(np.float64)
    if not np.all(np.isfinite(values) & (values > 0)):
        raise ValueError(f"Invalid noise {values} count. Must be finite and positive.")
    slopes = np.array([responses.curve(response, name).reference_slope for name in names])
    return response.assign(
        noise=("band", values, {"units": "count", "long_name": "noise of one pixel and frame"}),
        netd=("band", values / slopes, {"units": "K", "long_name": "NETD"}),
    )
