"""Response of a camera per band, of blackbodies or its maker: Sakuma-Hattori and linear pair."""

from collections.abc import Mapping, Sequence
from itertools import permutations
from typing import Any, Final

import numpy as np
import xarray as xr
from scipy.constants import zero_Celsius
from scipy.optimize import least_squares
from scipy.special import chdtri

from dbthermal import _numbers, bands, planck, schema
from dbthermal import response as responses
from dbthermal._arrays import Array
from dbthermal.response import ACCURACY, Curve

AMBIENT: Final = 298.15
"""Ambient temperature [K]; a response refers to the calibrated temperature nearest to it."""

MINIMUM_TEMPERATURES: Final = 4
"""Fewest blackbody temperatures: the Sakuma-Hattori curve has four parameters."""

TEMPERATURE_STD: Final = 0.1  # of an area blackbody about its reading [K]

NO_BARS: Final = "maker's constants, without error bars"
"""Attribute ``calibration`` of a response, and of what is made with it."""

_WAVELENGTH_MARGIN: Final = 1.2  # on a band's edges, for A + B / T: a detector is no top hat
_THERMAL: Final = bands.Band("thermal infrared", 2e-6, 20e-6)  # range of A + B / T, band unknown
# Range of A T / (A T + B): 1 at one wavelength, 0.94 in 8-14 um, 0.65 in 3-14 um; above 1 only by
# the nonlinearity of a detector.
_GROWTH: Final = (0.6, 1.1)
_SHAPE_UNIT: Final = planck.SECOND_RADIATION_CONSTANT / 5.0
_FALSE_ALARM: Final = 1e-4  # share of good sweeps that are refused
_FALLING: Final = 5.0  # standard deviations of a difference by which noise may let counts fall
_QUIETER: Final = 0.5  # NETD over a containing band's, below which the bands may be exchanged
_ROUNDING: Final = 1.0 / 12.0  # variance of rounding to whole counts [count^2]
_MAKER_ACCURACY: Final = 2.0 / 3.0**0.5  # of a stated accuracy of 2 K, uniform [K]
_POINTS, _LARGEST_ERROR = 64, 0.2  # of a fit to a maker's curve: temperatures, error [K]


def fit_response(  # noqa: PLR0913 - what is known of blackbody and cameras, by name
    counts: xr.DataArray,
    noise: xr.DataArray | None = None,
    *,
    temperature_std: float = TEMPERATURE_STD,
    offset_std: float | Sequence[float] | None = None,
    gain_std: float | Sequence[float] = ACCURACY["gain_std"],
    pattern_std: float | Sequence[float] = ACCURACY["pattern_std"],
    blackbody_accuracy: float = ACCURACY["blackbody_accuracy"],
    blackbody_emissivity: float = ACCURACY["blackbody_emissivity"],
    room_temperature: float = ACCURACY["room_temperature"],
    background_ratio_std: float = ACCURACY["background_ratio_std"],
) -> xr.Dataset:
    r"""Fit the response of each band to blackbody measurements.

    .. math:: U(T) = \frac{C}{\exp(c_2 / (A T + B)) - 1} + O, \qquad U(T) \approx a T + b

    the Sakuma-Hattori curve (see `response.Curve`) and the least-squares line. C and O enter
    linearly and are eliminated (Golub, Pereyra 2003, doi:10.1088/0266-5611/19/2/201); A and B are
    found by nonlinear least squares, with the mean wavelength A + B / T within the band.

    Counts are refused whose n residuals r are larger than noise s, rounding and the error of the
    blackbody explain, of good counts once in 1e4 sweeps:

    .. math:: \sum_T r^2 > \left( s^2 + \tfrac{1}{12} + (a \, s_T)^2 \right) \chi^2_{n-2}

    Parameters
    ----------
    counts : DataArray
        Mean counts (band, temperature) [count] of a blackbody, `temperature` [K] increasing, at
        least four.
    noise : DataArray, optional
        Standard deviation of one pixel's counts from frame to frame, (band) [count], for `noise`
        and NETD of the response. Without it the counts have no noise but rounding.
    temperature_std : float
        Standard deviation of the blackbody's temperature from reading to reading, s_T [K].
    offset_std, gain_std, pattern_std : float or sequence of float, optional
        Of all bands or of each, for the bars of results: drift of the camera's level after the
        sweep [K], by default 0.5 and what the counts are off the curve; error of its gain about the
        middle of the temperatures [1]; drift of its pixels about the level [K].
    blackbody_accuracy, blackbody_emissivity, room_temperature : float
        Error that all temperatures share [K], emissivity, for which the counts are not corrected,
        and temperature of the room that is mirrored [K].
    background_ratio_std : float
        Colour of what surfaces mirror: changes of the reflection in a band over those in the
        quietest, about 1, standard deviation [1]. See `response.ACCURACY` for the defaults;
        ``**response.EXACT`` states a simulation without these errors.

    Returns
    -------
    Dataset
        Stage `response` of `schema`: `amplitude` C, `effective_wavelength` A, `wavelength_shift` B,
        `offset` O, `linear_slope` a, `linear_intercept` b (band); `residual`, `linear_residual`
        (band, temperature) [count] and the measured `counts`; `reference_temperature`,
        `temperature_min`, `temperature_max` [K]; and, with a noise, `noise` (band) [count] and
        `netd` (band) [K]. `offset_std`, `gain_std`, `pattern_std` (band), `blackbody_accuracy`,
        `blackbody_emissivity`, `room_temperature` and `background_ratio_std` as stated. Attribute
        ``blackbody``, the temperatures and their deviations in words, which results repeat.
        TypeError or ValueError if an input is not as described, a value is NaN, or the counts
        follow no Planck curve, as of a camera that saturates, changes its range, or gives counts
        linear in temperature; the error names the temperature. UserWarning if the NETD of a band of
        `bands.FILTERS` is less than half that of one that contains it: then their names or files
        may be exchanged.

    Examples
    --------
    Blackbodies from 10 to 70 degrees Celsius, seen in the band 8-14 um at 100 count W^-1 m^2 sr.

    >>> import numpy as np, xarray as xr
    >>> from dbthermal import bands
    >>> axes = {"band": ["8-14"], "temperature": np.linspace(283.15, 343.15, 7)}
    >>> values = [15000 + 100 * bands.get("8-14").radiance(axes["temperature"])]
    >>> noise = xr.DataArray([3.0], {"band": ["8-14"]}, "band")
    >>> fitted = fit_response(xr.DataArray(values, axes, ("band", "temperature")), noise)
    >>> bool(np.abs(fitted.residual).max() < 0.5), round(float(fitted.netd[0]), 3)  # [count], [K]
    (True, 0.038)
    """
    _check_blackbody(counts)
    _numbers.real_number("temperature_std [K]", temperature_std, _numbers.POSITIVE)
    names = [str(name) for name in counts["band"].values]
    temperature = counts["temperature"].values.astype(np.float64)
    values = counts.values.astype(np.float64)
    noises = np.zeros(len(names))
    if noise is not None:
        noises = schema.band_values(noise, names, "the noise", "count")
        _numbers.real_numbers("noise [count]", noises, _numbers.POSITIVE)
    # Fit curve and line of each band, and refuse counts that follow no Planck curve.
    curves, lines = [], []
    for name, row, std in zip(names, values, noises, strict=True):
        line = _line(temperature, row)
        reading = np.hypot(std, np.sqrt(_ROUNDING) if np.all(row == np.rint(row)) else 0.0)
        _check_growth(name, temperature, row, float(np.hypot(reading, temperature_std * line[0])))
        curve = fit_band(name, temperature, row)
        slope = np.max(np.diff(curve.counts(temperature)) / np.diff(temperature))
        _check_residuals(curve, temperature, row, float(np.hypot(reading, temperature_std * slope)))
        curves.append(curve)
        lines.append(line)
    attrs = {"units": "K", "long_name": "blackbody temperature"}
    result = _response(curves, lines).assign_coords(temperature=("temperature", temperature, attrs))
    # Keep the measured counts with the residuals of both fits.
    result["counts"] = (("band", "temperature"), values, {"units": "count"})
    for name, kind in (("residual", "exact"), ("linear_residual", "linear")):
        fitted = [curve.counts(temperature) for curve in responses.curves(result, names, kind)]
        result[name] = (("band", "temperature"), values - fitted, {"units": "count"})
    celsius = ", ".join(f"{kelvin - zero_Celsius:.2f}" for kelvin in temperature)
    stated = f"standard deviation of a reading {temperature_std:g} K"
    # State what drifts after the sweep, and what it cannot see.
    if offset_std is None:
        slopes = [curve.reference_slope for curve in curves]
        scatter = np.sqrt((result["residual"].values ** 2).mean(axis=1)) / slopes
        offset_std = np.hypot(ACCURACY["offset_std"], scatter).tolist()
    drifts = {"offset_std": offset_std, "gain_std": gain_std, "pattern_std": pattern_std}
    accuracies: dict[str, Any] = {
        **drifts,
        "blackbody_accuracy": _numbers.real_number("blackbody_accuracy", blackbody_accuracy),
        "blackbody_emissivity": _numbers.real_number("blackbody_emissivity", blackbody_emissivity),
        "room_temperature": _numbers.real_number("room_temperature", room_temperature),
        "background_ratio_std": _numbers.real_number("background_ratio_std", background_ratio_std),
    }
    for name in drifts:
        values = _numbers.real_numbers(name, accuracies[name])
        if values.shape not in {(), (1,), (len(names),)}:
            rule = f"Must be one for all bands, or {len(names)}"
            raise ValueError(f"Invalid {name} of shape {values.shape}. {rule}.")
        accuracies[name] = np.broadcast_to(values, len(names)).copy()
    result = result.assign(schema.variables("response", accuracies))
    responses.accuracy(result, names)  # refuses what is none
    stated += f", of all {blackbody_accuracy:g} K, emissivity {blackbody_emissivity:g}"
    result.attrs["blackbody"] = f"{temperature.size} temperatures of {celsius} degC; {stated}"
    if noise is None:
        return result
    # Noise in kelvin at the reference temperature.
    netd = noises / np.array([curve.reference_slope for curve in curves])
    result = result.assign(schema.variables("response", {"noise": noises, "netd": netd}))
    return schema.warned(result, *_exchanged(dict(zip(names, netd, strict=True))))


def _exchanged(netd: Mapping[str, float]) -> list[str]:
    """Sentences on bands that are much quieter than a wider band that contains them."""
    filters = [name for name in netd if name in bands.FILTERS]
    return [
        f"Noise of {netd[inner]:.3g} K in band '{inner}', of {netd[outer]:.3g} K in '{outer}', "
        "which contains it. A filter must raise the noise: are the names of the bands, or the "
        "files of the blackbody, exchanged?"
        for inner, outer in permutations(filters, 2)
        if bands.get(outer).lower <= bands.get(inner).lower
        and bands.get(inner).upper <= bands.get(outer).upper
        and netd[inner] < _QUIETER * netd[outer]
    ]


def maker_response(files: Mapping[str, Mapping[str, Any]]) -> xr.Dataset:
    r"""Response of each band from the Planck constants that its maker wrote into the file.

    .. math:: I(T) = \frac{R_1}{R_2 (\exp(B / T) - F)} - O

    (Tattersall 2017, Thermimage, doi:10.5281/zenodo.1069704) is, for F = 1, the Sakuma-Hattori
    curve with :math:`C = R_1 / R_2`, :math:`A = c_2 / B` and no shift; for another F the curve is
    fitted over the camera's range, with an error that is stated.

    These constants have no error bars, and what a filter in front of the lens takes away is not in
    them; results say so in ``calibration``. The maker states 2 K or 2 % as a rule: the bars of a
    result contain 2 K, uniform and common to both bands, and `response.ACCURACY` for all else.
    Emissivity, distance and reflected temperature are not used.

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
        TypeError or ValueError if the files, or those of a band, are no mapping; a constant is
        missing or not positive, the ranges do not overlap, or the form does not fit.

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
    schema.require(files, Mapping, "files by band")
    for attrs in files.values():
        schema.require(attrs, Mapping, "files of a band")
    ranges = [
        [_constant(attrs, f"range_{end}", band) for end in ("min", "max")]
        for band, attrs in files.items()
    ]
    lowest, highest = max(low for low, _ in ranges), min(high for _, high in ranges)
    if not lowest < highest:
        raise ValueError(f"Invalid ranges {ranges} K of the bands {[*files]}. Must overlap.")
    # Fit the form to the maker's curve over the shared range.
    temperature = np.linspace(lowest, highest, _POINTS)
    error, curves, lines = 0.0, [], []
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
        curves.append(curve)
        lines.append(_line(temperature, counts))
    stated = schema.variables("response", {"blackbody_accuracy": _MAKER_ACCURACY})
    result = _response(curves, lines).assign(stated)
    return result.assign_attrs(calibration=NO_BARS, form_error=error)


def _line(temperature: Array, counts: Array) -> Array:
    """Slope [count/K] and intercept [count] of the line of least squares."""
    fit = np.polynomial.Polynomial.fit(temperature, counts, 1)
    return np.asarray(fit.convert().coef[::-1])


def _response(curves: list[Curve], lines: list[Array]) -> xr.Dataset:
    """Curve and line of each band in the form of the stage `response`."""
    rows = [
        [curve.amplitude, curve.wavelength, curve.shift, curve.offset, *line]
        for curve, line in zip(curves, lines, strict=True)
    ]
    names = [*responses.COEFFICIENTS, "linear_slope", "linear_intercept"]
    values = dict(zip(names, np.transpose(rows), strict=True)) | {
        "reference_temperature": curves[0].reference,
        "temperature_min": curves[0].lowest,
        "temperature_max": curves[0].highest,
    }
    bands = [curve.band for curve in curves]
    return xr.Dataset(schema.variables("response", values), {"band": bands})


def _check_blackbody(counts: xr.DataArray) -> None:
    schema.check_variable(counts, schema.STAGES["blackbody"]["counts"], "the blackbody counts")
    temperature = counts["temperature"].values
    _numbers.real_numbers("temperature [K] of a blackbody", temperature, _numbers.KELVIN)
    if temperature.size < MINIMUM_TEMPERATURES:
        rule = f"Must be at least {MINIMUM_TEMPERATURES}"
        raise ValueError(f"Invalid number of blackbody temperatures {temperature.size}. {rule}.")
    for name, row in zip(counts["band"].values, counts.values, strict=True):
        schema.require_measured(row, f"counts in band '{name}'")


def _check_growth(band: str, temperature: Array, counts: Array, std: float) -> None:
    """Refuse counts that stand or fall where errors of a standard deviation do not explain it."""
    change, step = np.diff(counts), np.diff(temperature)
    expected = (counts[-1] - counts[0]) / (temperature[-1] - temperature[0]) * step
    falls = (change <= 0) & (expected - change > _FALLING * np.sqrt(2.0) * std)
    if np.any(falls) or counts[-1] <= counts[0]:
        place = int(np.argmax(np.where(change <= 0, expected - change, -np.inf)))
        raise ValueError(
            f"Invalid counts {counts[place + 1]} at {temperature[place + 1]} K in band '{band}', "
            f"after {counts[place]} at {temperature[place]} K. Must grow with temperature."
        )


def _check_residuals(curve: Curve, temperature: Array, counts: Array, std: float) -> None:
    """Refuse counts farther from their Planck curve than errors of a standard deviation explain."""
    # The nearest curve of any shape is no farther from the counts than that of the true shape,
    # whose two linear parameters leave a chi-square of n - 2 degrees of freedom.
    band, deviation = curve.band, counts - curve.counts(temperature)
    if np.sum(deviation**2) <= std**2 * chdtri(counts.size - 2, _FALSE_ALARM):
        return
    explained = f"noise and blackbody explain {std:.3g} count"
    # Readings without which the remaining readings lie on a curve.
    fitting = []
    for place in range(counts.size):
        remaining = np.arange(counts.size) != place
        refitted = fit_band(band, temperature[remaining], counts[remaining])
        residual = counts - refitted.counts(temperature)
        if np.sum(residual[remaining] ** 2) <= std**2 * chdtri(counts.size - 3, _FALSE_ALARM):
            read = float(refitted.inverse(counts[place])) - zero_Celsius
            fitting.append((place, residual[place], read))
    if len(fitting) == 1:
        ((place, distance, read),) = fitting
        raise ValueError(
            f"Invalid counts {counts[place]:.6g} at {temperature[place]:.6g} K in band '{band}', "
            f"{distance:+.4g} count off the Planck curve of the others, on which they read as "
            f"{read:.1f} degC. Must lie on one; {explained}."
        )
    place = int(np.argmax(np.abs(deviation)))
    shortest, longest = (1e6 * edge for edge in _wavelengths(band))
    raise ValueError(
        f"Invalid counts in band '{band}', off every Planck curve of {shortest:.3g} to "
        f"{longest:.3g} um, most at {temperature[place]:.6g} K, by {deviation[place]:+.4g} count. "
        f"Must follow one; {explained}."
    )


def _wavelengths(band: str) -> tuple[float, float]:
    """Least and greatest mean wavelength [m] of a response in a band, by its name."""
    passband = bands.FILTERS.get(band)
    if passband is None:
        return _THERMAL.lower, _THERMAL.upper
    return passband.lower / _WAVELENGTH_MARGIN, passband.upper * _WAVELENGTH_MARGIN


def fit_band(band: str, temperature: Array, counts: Array) -> Curve:
    """Least-squares curve of one band."""
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

    shortest, longest = np.array(_wavelengths(band)) * middle / _SHAPE_UNIT
    options: Any = {"bounds": ((shortest, _GROWTH[0]), (longest, _GROWTH[1])), "max_nfev": 1000}
    options |= dict.fromkeys(("xtol", "ftol", "gtol"), 1e-15)
    start = np.sqrt(shortest * longest), 1.0
    fit = least_squares(lambda shape: linear_part(shape)[1] / span, start, **options)
    amplitude, offset = linear_part(fit.x)[0]
    wavelength = _SHAPE_UNIT * fit.x[0] * fit.x[1] / middle
    shift = _SHAPE_UNIT * fit.x[0] * (1.0 - fit.x[1])
    reference = temperature[np.argmin(np.abs(temperature - AMBIENT))]
    range_ = (temperature[0], temperature[-1])
    return Curve(band, amplitude, wavelength, shift, offset, reference, *range_)


def _constant(attrs: Any, key: str, band: str, *, positive: bool = True) -> float:
    """Constant of a file; ValueError by band if it is missing or not positive."""
    if f"file_{key}" not in attrs:
        rule = "Must be in the file, as in FLIR's: else fit a blackbody, by fit_response"
        raise ValueError(f"Missing {key} of band '{band}'. {rule}.")
    limits = _numbers.POSITIVE if positive else _numbers.FINITE
    return _numbers.real_number(f"{key} of band '{band}'", float(attrs[f"file_{key}"]), limits)
