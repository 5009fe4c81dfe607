r"""Response of a camera: counts of a blackbody as a function of its temperature, per band.

A response is a Dataset of the stage `response` of `schema`, made by `calibration.fit_response`;
`curve` makes the `Curve` of one of its bands, in which everything downstream computes: with the
linearised signal :math:`z = T_r + (I - U(T_r)) / a`, in kelvin, and the blackbody's own signal
:math:`u(T)`, with :math:`u(T_r) = T_r` and slope 1 there.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import _numbers, planck, schema
from dbthermal._arrays import Array

__all__ = [
    "ACCURACY",
    "COEFFICIENTS",
    "EXACT",
    "KINDS",
    "Curve",
    "LinearCurve",
    "apparent_temperature",
    "counts",
    "curve",
    "noise",
]
__dir__ = __all__.copy

KINDS: Final = ("exact", "linear")
"""Kinds of response: the Sakuma-Hattori curve, and the paper's linear approximation."""

COEFFICIENTS: Final = ("amplitude", "effective_wavelength", "wavelength_shift", "offset")
"""Variables of a response that hold the Sakuma-Hattori curve."""

ACCURACY: Final[Mapping[str, float]] = MappingProxyType(
    {
        "offset_std": 0.5,
        "gain_std": 0.01,
        "pattern_std": 0.1,
        "blackbody_accuracy": 0.1,
        "blackbody_emissivity": 0.97,
        "room_temperature": 295.15,
        "background_ratio_std": 0.02,
    }
)
"""What a calibration is taken for where its response states nothing else; see `fit_response`.

An uncooled camera in a laboratory is accurate to 0.5 K (Kelly et al. 2019, doi:10.3390/rs11050567);
corrected for its own temperature, it leaves 0.2 K over time and pixels (Nugent, Shaw, Pust 2013,
doi:10.1117/1.OE.52.6.061304): here 1 % of 20 K, and 0.1 K from pixel to pixel. An area blackbody is
known to 0.1 K, and black within 1 to 3 % (Clausen 2007, International Journal of Thermophysics 28,
2145). What is mirrored indoors emits alike in both bands within 2 %: skin 0.98, fabrics 0.80 to
0.97, of a person that moves a part.
"""

EXACT: Final[Mapping[str, float]] = MappingProxyType(
    dict.fromkeys(ACCURACY, 0.0) | {"blackbody_emissivity": 1.0, "room_temperature": 295.15}
)
"""Accuracy of a simulated calibration without any error: bars are then those of noise alone."""

_SLOPE_POINTS: Final = 16  # temperatures at which the slope of a curve is checked
_MARGIN: Final = 100.0  # beyond the range, in which the reference temperature must lie [K]


@dataclass(frozen=True)
class Curve:
    r"""Sakuma-Hattori response of one band.

    .. math:: U(T) = \frac{C}{\exp(c_2 / (A T + B)) - 1} + O

    (1982, in Temperature: its Measurement and Control in Science and Industry 5, 421-427; Saunders,
    White 2003, doi:10.1088/0026-1394/40/4/309).

    Attributes
    ----------
    band : str
        Name of the band.
    amplitude, wavelength, shift, offset : float
        C [count], A (effective wavelength) [m], B [m K] and O [count].
    reference, lowest, highest : float
        Reference temperature :math:`T_r`, and calibrated range [K].
    """

    band: str
    amplitude: float
    wavelength: float
    shift: float
    offset: float
    reference: float
    lowest: float
    highest: float

    def counts(self, temperature: npt.ArrayLike) -> Array:
        """Counts of a blackbody at a temperature [K] that fills the pixel, extrapolated [count]."""
        exponent = planck.SECOND_RADIATION_CONSTANT / self._scale(temperature)
        return self.amplitude / np.expm1(exponent) + self.offset

    def count_slope(self, temperature: npt.ArrayLike) -> Array:
        """Derivative of `counts` with the temperature [count/K]."""
        scale = self._scale(temperature)
        exponent = planck.SECOND_RADIATION_CONSTANT / scale
        excess = np.expm1(exponent)
        return self.amplitude / excess * (1.0 + 1.0 / excess) * exponent * self.wavelength / scale

    def inverse(self, counts: npt.ArrayLike) -> Array:
        """Temperature [K] of a blackbody of given counts; NaN at and below the offset."""
        excess = np.asarray(counts, dtype=np.float64) - self.offset
        ratio = self.amplitude / np.where((excess > 0) & np.isfinite(excess), excess, np.nan)
        return (planck.SECOND_RADIATION_CONSTANT / np.log1p(ratio) - self.shift) / self.wavelength

    @cached_property
    def reference_counts(self) -> float:
        """Counts at the reference temperature [count]."""
        return float(self.counts(self.reference))

    @cached_property
    def reference_slope(self) -> float:
        """Slope a at the reference temperature [count/K]."""
        return float(self.count_slope(self.reference))

    def linearise(self, counts: npt.ArrayLike) -> Array:
        """Linearised signal z of counts [K]."""
        excess = np.asarray(counts, dtype=np.float64) - self.reference_counts
        return self.reference + excess / self.reference_slope

    def signal(self, temperature: npt.ArrayLike) -> Array:
        """Linearised signal u(T) of a blackbody at a temperature [K]."""
        return self.linearise(self.counts(temperature))

    def slope(self, temperature: npt.ArrayLike) -> Array:
        """Derivative of `signal` with the temperature [1]."""
        return self.count_slope(temperature) / self.reference_slope

    def temperature(self, signal: npt.ArrayLike) -> Array:
        """Temperature [K] of the blackbody with a linearised signal [K]; NaN where undefined."""
        excess = np.asarray(signal, dtype=np.float64) - self.reference
        return self.inverse(self.reference_counts + self.reference_slope * excess)

    def _scale(self, temperature: npt.ArrayLike) -> Array:
        return self.wavelength * np.asarray(temperature, dtype=np.float64) + self.shift


@dataclass(frozen=True)
class LinearCurve(Curve):
    """The paper's linear response, counts = slope * T + intercept, with the methods of `Curve`.

    Attributes
    ----------
    amplitude, offset : float
        Slope [count/K] and intercept [count]; `wavelength` and `shift` are not used.
    """

    def counts(self, temperature: npt.ArrayLike) -> Array:
        """Counts at a temperature [K]."""
        return self.amplitude * np.asarray(temperature, dtype=np.float64) + self.offset

    def count_slope(self, temperature: npt.ArrayLike) -> Array:
        """Slope, the same at each temperature [count/K]."""
        temperature = np.asarray(temperature, dtype=np.float64)
        return np.full_like(temperature, self.amplitude)

    def inverse(self, counts: npt.ArrayLike) -> Array:
        """Temperature of counts [K]."""
        return (np.asarray(counts, dtype=np.float64) - self.offset) / self.amplitude


@dataclass(frozen=True)
class Accuracy:
    """Standard deviations of what a calibration is taken for, see `ACCURACY`."""

    offset: Array  # (band) [K]
    gain: Array  # (band) [1], about the middle of the calibrated range
    pattern: Array  # (band) [K]
    blackbody: float  # [K]
    reflected: float  # by the blackbody, of the room [1]
    room: float  # [K]
    colour: float  # std of a reflection's changes in a band over its changes in the first [1]
    centre: float  # of the calibrated range [K]

    def reading(self, band: int, temperature: npt.ArrayLike) -> Array:
        """Standard deviation [K] that all pixels share of a reading in one band."""
        value = np.asarray(temperature, dtype=np.float64)
        gain, mirrored = self.gain[band] * (value - self.centre), value - self.room
        fixed = self.offset[band] ** 2 + self.blackbody**2
        return np.asarray(np.sqrt(fixed + gain**2 + (self.reflected * mirrored) ** 2))


def accuracy(
    response: xr.Dataset, bands: list[str], reference: Mapping[str, Any] | None = None
) -> Accuracy:
    """Accuracy of some bands of a response, by default `ACCURACY`; ValueError outside limits."""
    places, stated = schema.band_positions(response, bands, "the response"), dict[str, Array]()
    limits = {"blackbody_emissivity": (1e-3, 1.0), "room_temperature": _numbers.KELVIN}
    limits |= {"gain_std": (0.0, 1.0), "background_ratio_std": (0.0, 1.0)}  # relative, not in %
    for name, default in ACCURACY.items():
        value = np.asarray(response.get(name, default), np.float64)
        stated[name], within = value, limits.get(name, (0.0, schema.LARGEST))
        if not np.all((value >= within[0]) & (value <= within[1])):
            _numbers.real_numbers(f"{name} of the response", value, within)  # says which and why
    offset, gain, pattern = (
        np.broadcast_to(stated[name], response.sizes["band"])[places]
        for name in ("offset_std", "gain_std", "pattern_std")
    )
    blackbody, black = (float(stated[f"blackbody_{name}"]) for name in ("accuracy", "emissivity"))
    centre = 0.5 * float(response["temperature_min"] + response["temperature_max"])
    room, colour = (float(stated[name]) for name in ("room_temperature", "background_ratio_std"))
    # A reference in view (attribute of a capture) renews the levels at its temperature, where
    # nothing counts that the blackbody mirrored, and perhaps the gains.
    if reference is not None:
        left = [reference["bands"][band] for band in bands]
        offset = np.array([of_band["offset_std"] for of_band in left])
        blackbody, centre, room = reference["std"], *2 * (reference["temperature"],)
        if all("gain_std" in of_band for of_band in left):
            gain, black = np.array([of_band["gain_std"] for of_band in left]), 1.0
    return Accuracy(offset, gain, pattern, blackbody, 1.0 - black, room, colour, centre)


def require_range(temperature: npt.ArrayLike, curve: Curve, name: str) -> Array:
    """Temperatures [K] as float64; ValueError for one outside the calibrated range, or NaN."""
    values = np.asarray(temperature, dtype=np.float64)
    bad = ~((values >= curve.lowest) & (values <= curve.highest))
    if np.any(bad):
        rule = f"Must lie in the response's range [{curve.lowest}, {curve.highest}] K"
        raise ValueError(f"Invalid {name} {values[bad].flat[0]} K in band '{curve.band}'. {rule}.")
    return values


def curve(response: xr.Dataset, band: str, kind: str = "exact") -> Curve:
    """Curve of one band, by its name, of a response (stage `response` of `schema`).

    Its methods take temperatures [K] to counts [count] and back, see `Curve`.

    ValueError if the band is missing, the kind unknown, a coefficient not finite, the slope not
    positive, or the calibrated range does not increase or lies more than 100 K off the reference.

    Parameters
    ----------
    response, band : Dataset, str
        Stage `response` of `schema`; name of the band.
    kind : {"exact", "linear"}
        Sakuma-Hattori, or the linear pair.
    """
    return curves(response, [band], kind)[0]


def curves(response: xr.Dataset, bands: Sequence[str], kind: str = "exact") -> list[Curve]:
    """Curves of bands by name, see `curve`; the response is checked once."""
    if kind not in KINDS:
        raise ValueError(f"Unknown kind of response '{kind}'. Must be one of {KINDS}.")
    schema.check(response, "response")
    places = schema.band_positions(response, list(bands), "the response")
    values = {str(name): response[name].values for name in schema.STAGES["response"]}
    return [
        _curve({name: float(v[place] if v.ndim else v) for name, v in values.items()}, band, kind)
        for band, place in zip(bands, places, strict=True)
    ]


def _curve(number: dict[str, float], band: str, kind: str) -> Curve:
    """Curve of one band, from the coefficients of its response."""
    # Refuse coefficients and a range that are no response.
    if bad := [name for name, value in number.items() if not np.isfinite(value)]:
        raise ValueError(f"Invalid {bad[0]} of the response in band '{band}'. Must be finite.")
    common = (number["reference_temperature"], number["temperature_min"], number["temperature_max"])
    reference, lowest, highest = common
    if not (0 < lowest < highest and lowest - _MARGIN <= reference <= highest + _MARGIN):
        label = f"Invalid range {lowest} to {highest} K of the response, reference {reference} K"
        raise ValueError(f"{label}. Must increase, be positive, and within {_MARGIN} K of it.")
    if kind == "linear":
        slope, intercept = number["linear_slope"], number["linear_intercept"]
        result: Curve = LinearCurve(band, slope, 0.0, 0.0, intercept, *common)
    else:
        shape = (number["effective_wavelength"], number["wavelength_shift"], number["offset"])
        result = Curve(band, number["amplitude"], *shape, *common)
    with np.errstate(over="ignore"):  # of a wavelength far too short: a slope of zero, refused
        slopes = result.count_slope(np.linspace(result.lowest, result.highest, _SLOPE_POINTS))
    if not np.all(slopes > 0):
        message = f"Invalid slope {slopes.min()} count/K of the response in band '{band}'"
        raise ValueError(f"{message}. Must be positive over its whole range.")
    return result


def noise(response: xr.Dataset, bands: list[str]) -> Array:
    """Noise (band) [count] of some bands of a response: standard deviation of one pixel's counts.

    Parameters
    ----------
    response : Dataset
        Stage `response` of `schema`, with a finite and positive `noise` of each band, or a
        ValueError.
    bands : list of str
        Names of the bands, in the order of the result.
    """
    if "noise" not in schema.check(response, "response"):
        raise ValueError("Missing noise of the response. Must be given to fit_response.")
    places = schema.band_positions(response, bands, "the response")
    values = np.asarray(response["noise"].values[places], dtype=np.float64)
    if np.any(bad := ~((values > 0) & np.isfinite(values))):
        label = f"Invalid noise [count] {values[bad][0]} in band '{bands[int(np.argmax(bad))]}'"
        raise ValueError(f"{label}. Must be finite and positive.")
    return values


def counts(response: xr.Dataset, temperature: xr.DataArray) -> xr.DataArray:
    """Counts (band, ...) [count] of a blackbody in every band of a response.

    Parameters
    ----------
    response : Dataset
        Stage `response` of `schema`.
    temperature : DataArray
        Temperature [K] in the calibrated range, or a ValueError; any dims but `band`. TypeError
        for what is no DataArray.
    """
    schema.check_numbers(temperature, "the temperature", "K")
    names = [str(name) for name in schema.check(response, "response")["band"].values]
    of_bands = curves(response, names)
    if "band" in temperature.dims:
        raise ValueError(f"Invalid dims {temperature.dims} of the temperature. Must lack 'band'.")
    values = require_range(temperature.values, of_bands[0], "temperature")
    films = [temperature.copy(data=band_curve.counts(values)) for band_curve in of_bands]
    result = xr.concat(films, dim=xr.DataArray(names, dims="band", name="band"))
    return result.assign_attrs(schema.STAGES["blackbody"]["counts"].attrs).rename("counts")


def apparent_temperature(response: xr.Dataset, counts: xr.DataArray) -> xr.DataArray:
    """Temperature (band, ...) [K] of the blackbody that would give the same counts, band by band.

    Extrapolated beyond the calibrated range; NaN where no temperature gives such counts.

    Parameters
    ----------
    response, counts : Dataset, DataArray
        Stage `response` of `schema`; counts (band, ...) [count].

    Examples
    --------
    >>> import xarray as xr
    >>> from dbthermal import simulation
    >>> response = simulation.Rig(bands=("8-14", "9.5")).response()
    >>> blackbody = counts(response, xr.DataArray([293.15, 313.15], dims="time"))
    >>> apparent_temperature(response, blackbody).sel(band="9.5").values.round(2)
    array([293.15, 313.15])
    """
    schema.check_numbers(counts, "the counts", "count")
    if counts.dims[:1] != ("band",):
        raise ValueError(f"Invalid dims {counts.dims} of the counts. Must begin with 'band'.")
    names = [str(name) for name in counts["band"].values]
    pairs = zip(curves(response, names), counts.values, strict=True)
    values = [band_curve.inverse(band_counts) for band_curve, band_counts in pairs]
    result = counts.copy(data=np.stack(values)).rename("apparent_temperature")
    return result.assign_attrs(units="K", long_name="apparent temperature")
