"""Calibration: the camera's response per band from blackbodies, and emissivities.

`fit_response` fits the four-parameter Sakuma-Hattori curve beside the paper's linear pair;
`maker_response` takes a maker's constants, which have no error bars. The
emissivity of a material, with its uncertainty, follows from thermocouple readings and a reflected
blackbody (`fit_emissivity`), or by the standards' reflector method (`reflector_emissivity`).

Both emissivities are by generalised least squares of :math:`I_i - W_{b,i} = e (W_{o,i} - W_{b,i})`,
with counts I, blackbody signal :math:`W_o` at the object's temperature and reflected signal
:math:`W_b`, all with errors, some of them common to all measurements.
"""

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import xarray as xr

from dbthermal import _numbers, schema
from dbthermal import response as responses
from dbthermal._arrays import Array
from dbthermal.calibration._response import (
    AMBIENT,
    MINIMUM_TEMPERATURES,
    NO_BARS,
    fit_response,
    maker_response,
)
from dbthermal.response import Curve, require_range

__all__ = [
    "AMBIENT",
    "MINIMUM_TEMPERATURES",
    "NO_BARS",
    "NO_BIAS",
    "Bias",
    "fit_emissivity",
    "fit_response",
    "maker_response",
    "reflector_emissivity",
]
__dir__ = __all__.copy

Pair = tuple[float, float]

_ITERATIONS: Final = 50
_CONVERGED: Final = 1e-12
_BEYOND: Final = 3.0  # standard deviations by which an emissivity may lie outside its limits


@dataclass(frozen=True)
class Bias:
    r"""Errors that all readings of one series have in common, each uniform in a range.

    The middle of a range is corrected for; its standard deviation, the width over
    :math:`\sqrt{12}`, is part of the result's (JCGM 100:2008, 4.3.7).

    Attributes
    ----------
    object_tolerance, background_tolerance : float
        Largest offset of the thermocouple's readings and of the reflected body's temperature,
        either way [K].
    contact : tuple of float
        Least and largest fraction of the object's excess over the air that the thermocouple misses,
        because it conducts heat away [1].
    air_temperature : float
        Temperature of the air, and of the room [K].
    stray : tuple of float
        Least and largest fraction of the reflection that comes from the room and not from the
        blackbody: a surface that is not quite smooth, a blackbody not quite black [1].

    Examples
    --------
    A thermocouple misses up to a tenth of an object's excess of 20 K over the air.

    >>> import numpy as np
    >>> bias = Bias(contact=(0.0, 0.1), air_temperature=293.15)
    >>> round(float(bias.corrected(np.array(313.15))), 2)  # [K]
    314.2
    """

    object_tolerance: float = 0.0
    contact: Pair = (0.0, 0.0)
    air_temperature: float = 295.15
    background_tolerance: float = 0.0
    stray: Pair = (0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("object_tolerance", "background_tolerance"):
            _numbers.real_number(f"{name} [K]", getattr(self, name), (0.0, schema.LARGEST))
        for name in ("contact", "stray"):
            least, largest = _numbers.real_numbers(name, getattr(self, name), shape=(2,))
            if not 0 <= least <= largest < 1:
                rule = "Must be a range within [0, 1)"
                raise ValueError(f"Invalid {name} ({least}, {largest}). {rule}.")
        _numbers.real_number("air_temperature [K]", self.air_temperature, _numbers.KELVIN)

    def corrected(self, reading: Array) -> Array:
        """Object temperature [K], T = T_a + (R - T_a) / (1 - m), m the mean contact error."""
        excess = reading - self.air_temperature
        return self.air_temperature + excess / (1.0 - np.mean(self.contact))

    def emitted(self, curve: Curve, temperature: Array, std: float) -> tuple[Array, Array]:
        """Errors of the object's signal [count]: independent (n), and common ones (2, n)."""
        # dT = dR / (1 - m) + (T - T_a) dm / (1 - m), and dW = U'(T) dT; m is uniform in its range.
        scale = curve.count_slope(temperature) / (1.0 - np.mean(self.contact))
        contact = np.ptp(self.contact) / np.sqrt(12.0) * (temperature - self.air_temperature)
        offset = np.full_like(temperature, self.object_tolerance / 3.0**0.5)
        return np.asarray(scale * std), np.asarray(scale * np.stack([offset, contact]))

    def reflection(self, curve: Curve, temperature: Array) -> Array:
        """Reflected signal [count], (1 - s) U(T_b) + s U(T_a), s the mean stray fraction."""
        room = curve.counts(self.air_temperature)
        excess = curve.counts(temperature) - room
        return np.asarray(room + (1.0 - np.mean(self.stray)) * excess)

    def reflected(self, curve: Curve, temperature: Array, std: float) -> tuple[Array, Array]:
        """Errors of the reflected signal [count] as `emitted`; common: offset, stray fraction."""
        # dW = (1 - s) U'(T_b) dT_b - (U(T_b) - U(T_a)) ds.
        scale = (1.0 - np.mean(self.stray)) * curve.count_slope(temperature)
        offset = scale * self.background_tolerance / 3.0**0.5
        excess = curve.counts(temperature) - curve.counts(self.air_temperature)
        stray = np.ptp(self.stray) / np.sqrt(12.0) * excess
        return np.asarray(scale * std), np.stack([offset, stray])


NO_BIAS: Final = Bias()
"""Readings whose errors are independent."""


class _Signals(NamedTuple):
    """Counts I (n) of a band, their noise, W_o and W_b (n) [count], and covariances (n, n)."""

    counts: Array
    noise: float
    emitted: Array
    emitted_covariance: Array
    reflected: Array
    reflected_covariance: Array

    def weighted(self, emissivity: float, values: Array) -> Array:
        """Inverse covariance of the residual y - e x, times values (n)."""
        # s_I^2 + e^2 cov(W_o) + (1 - e)^2 cov(W_b)
        covariance = self.noise**2 * np.eye(values.size)
        covariance += emissivity**2 * self.emitted_covariance
        covariance += (1.0 - emissivity) ** 2 * self.reflected_covariance
        return np.asarray(np.linalg.solve(covariance, values))


def fit_emissivity(
    measured: xr.Dataset, response: xr.Dataset, reading_std: Pair, bias: Bias = NO_BIAS
) -> xr.Dataset:
    r"""Emissivity of a material per band, by contact thermometry and a reflected blackbody.

    Each measurement i has counts :math:`I_i`, the object's temperature by thermocouple and the
    reflected blackbody's temperature (equation 10 of Narayanan, Ramanagopal, Narasimhan 2026,
    doi:10.48550/arXiv.2509.11334, by least squares):

    .. math:: I_i - U(T_{b,i}) = e \, (U(T_{o,i}) - U(T_{b,i}))

    weighted by the covariance of both sides, iterated in e: the independent part :math:`s_i^2 =
    s_I^2 + (e U'(T_o) s_o)^2 + ((1-e) U'(T_b) s_b)^2`, and for each common error the outer product
    of its effects (Aitken 1936, doi:10.1017/S0370164600014346). The differences on the right are
    weighted as the fit adjusts them (York et al. 2004, doi:10.1119/1.1632486), because their
    scatter would pass for contrast.

    Parameters
    ----------
    measured : Dataset
        Stage `contact`: `counts` of the material (band, measurement) [count]; `object_temperature`
        by the thermocouple and `background_temperature` of the blackbody (measurement) [K].
    response, bias : Dataset, Bias
        From `fit_response`, with its noise; errors that all readings have in common, by default 0.
    reading_std : tuple of float
        Standard deviation of one reading of the thermocouple and of the blackbody [K], independent.

    Returns
    -------
    Dataset
        `emissivity`, `emissivity_std` (band) [1]; `reduced_chi2` (band) [1], near 1 if the
        uncertainties are realistic; `residual` (band, measurement) [count].
        TypeError, ValueError or ArithmeticError if an input is not as described or not finite,
        there are fewer than two measurements, a temperature lies outside the response, object and
        background differ by less than three standard deviations, a result lies outside
        `schema.EMISSIVITY_LIMITS` by more than three, or the fit does not converge.

    Examples
    --------
    Emissivity 0.85 in both bands; the object is warmed while the blackbody cools.

    >>> import xarray as xr
    >>> from dbthermal import response, simulation
    >>> camera = simulation.Rig(bands=("8-14", "9.5")).response()
    >>> warm = xr.DataArray([303.15, 318.15, 333.15], dims="measurement")  # [K]
    >>> cold = xr.DataArray([323.15, 308.15, 293.15], dims="measurement")
    >>> counts = 0.85 * response.counts(camera, warm) + 0.15 * response.counts(camera, cold)
    >>> measured = xr.Dataset({"counts": counts, "object_temperature": warm})
    >>> measured["background_temperature"] = cold
    >>> fit_emissivity(measured, camera, reading_std=(0.1, 0.05)).emissivity.values.round(3)
    array([0.85, 0.85])
    """
    warm, stds, bands = _readings(measured, response, "contact", reading_std, bias)
    if measured.sizes["measurement"] < 2:
        raise ValueError("Invalid number of measurements 1. Must be at least 2.")
    cold = measured["background_temperature"].values.astype(np.float64)
    _require_contrast(warm - cold, stds, "background")
    signals = {}
    for curve, noise, counts in bands:
        require_range(cold, curve, "background temperature")
        reflected = _covariance(*bias.reflected(curve, cold, float(stds[1])))
        emitted = curve.counts(warm), _covariance(*bias.emitted(curve, warm, float(stds[0])))
        signals[curve.band] = _Signals(
            counts, noise, *emitted, bias.reflection(curve, cold), reflected
        )
    return _fit(signals)


def reflector_emissivity(
    measured: xr.Dataset, response: xr.Dataset, reading_std: Pair, bias: Bias = NO_BIAS
) -> xr.Dataset:
    r"""Emissivity of a material per band by the reflector method of ISO 18434-1, ASTM E1862, E1933.

    A crumpled foil in the object's place gives the reflected signal :math:`W_r`, a contact
    thermometer the object's own :math:`W_o = U(T_o)`, and the camera the object's W:

    .. math:: e = \frac{W - W_r}{W_o - W_r}, \qquad
              s_e = \frac{\sqrt{s_W^2 + e^2 s_{W_o}^2 + (1 - e)^2 s_{W_r}^2}}{|W_o - W_r|}

    Several measurements are combined by least squares. A foil reflects the whole surroundings, a
    smooth object one direction of them; at low emissivity the difference is taken for emission.

    Parameters
    ----------
    measured : Dataset
        Stage `reflector`: `counts` of the object and `reflected_counts` of the foil (band,
        measurement) [count]; `object_temperature` by contact (measurement) [K].
    reading_std : tuple of float
        Standard deviation of one reading of the contact thermometer, and of the reflected
        temperature beyond the camera's noise [K].
    response, bias
        As for `fit_emissivity`; the terms of the background are not used.

    Returns
    -------
    Dataset
        As `fit_emissivity`, and its errors, but one measurement is enough: the reduced chi-square
        is then NaN.

    Examples
    --------
    One reading of an object at 50 degrees Celsius in a room at 22, of emissivity 0.3.

    >>> import xarray as xr
    >>> from dbthermal import response, simulation
    >>> camera = simulation.Rig(bands=("8-14", "9.5")).response()
    >>> warm, room = (xr.DataArray([kelvin], dims="measurement") for kelvin in (323.15, 295.15))
    >>> foil = response.counts(camera, room)
    >>> counts = 0.3 * response.counts(camera, warm) + 0.7 * foil
    >>> measured = xr.Dataset({"counts": counts, "reflected_counts": foil})
    >>> measured["object_temperature"] = warm
    >>> reflector_emissivity(measured, camera, reading_std=(0.2, 0.3)).emissivity.values.round(3)
    array([0.3, 0.3])
    """
    warm, stds, bands = _readings(measured, response, "reflector", reading_std, bias)
    signals = {}
    foils = measured["reflected_counts"].values.astype(np.float64)
    for (curve, noise, counts), foil in zip(bands, foils, strict=True):
        cold = curve.inverse(foil)
        _require_contrast(warm - cold, stds, f"reflection in band '{curve.band}'")
        emitted = curve.counts(warm), _covariance(*bias.emitted(curve, warm, float(stds[0])))
        reflected = foil, np.diag(np.hypot(noise, curve.count_slope(cold) * stds[1]) ** 2)
        signals[curve.band] = _Signals(counts, noise, *emitted, *reflected)
    return _fit(signals)


def _readings(
    measured: xr.Dataset, response: xr.Dataset, stage: str, reading_std: Pair, bias: Bias
) -> tuple[Array, Array, list[tuple[Curve, float, Array]]]:
    """Object temperature (n) and deviations of a reading [K]; curve, noise, counts (n) by band."""
    schema.check(measured, stage)
    for name, variable in measured.data_vars.items():
        schema.require_measured(variable.values, str(name))
    warm = bias.corrected(measured["object_temperature"].values.astype(np.float64))
    stds = _numbers.real_numbers("reading_std [K]", reading_std, _numbers.POSITIVE, (2,))
    names = [str(name) for name in measured["band"].values]
    noises, curves = responses.noise(response, names).tolist(), responses.curves(response, names)
    for curve in curves:
        require_range(warm, curve, "object temperature")
    counts = measured["counts"].values.astype(np.float64)
    return warm, stds, list(zip(curves, noises, counts, strict=True))


def _covariance(std: Array, bias: Array) -> Array:
    """Covariance (n, n) of a signal, by independent errors (n) and common ones (term, n)."""
    return np.asarray(np.diag(std**2) + bias.T @ bias)


def _require_contrast(difference: Array, stds: Array, partner: str) -> None:
    """Refuse temperatures that differ by less than the readings resolve."""
    contrast, limit = np.abs(difference).max(), 3.0 * float(np.hypot(*stds))
    if not contrast > limit:
        raise ValueError(
            f"Invalid contrast {contrast} K between object and {partner}. Must exceed {limit} K, "
            "three standard deviations of the difference, in some measurement."
        )


def _fit(signals: dict[str, _Signals]) -> xr.Dataset:
    """Emissivities of all bands; the reduced chi-square of a single measurement is NaN."""
    fits = [_fit_band(band, name) for name, band in signals.items()]
    *values, residual = (np.array(column) for column in zip(*fits, strict=True))
    pairs = zip(("emissivity", "emissivity_std", "reduced_chi2"), values, strict=True)
    variables: dict[str, Any] = {name: ("band", value, {"units": "1"}) for name, value in pairs}
    variables["residual"] = (("band", "measurement"), residual, {"units": "count"})
    return xr.Dataset(variables, {"band": list(signals)})


def _fit_band(signals: _Signals, name: str) -> tuple[float, float, float, Array]:
    """Emissivity, its standard deviation, reduced chi-square and residuals of one band."""
    # Line through the origin, of I - W_b over W_o - W_b [count].
    x = signals.emitted - signals.reflected
    y = signals.counts - signals.reflected
    emissivity = float(x @ y / (x @ x))
    for _ in range(_ITERATIONS):
        # York et al. (2004): weigh by the abscissa as the fit adjusts it, without its scatter,
        # x - cov(x, r) cov(r)^-1 r with cov(x, r) = -e cov(W_o) + (1 - e) cov(W_b).
        weighted = signals.weighted(emissivity, y - emissivity * x)
        adjusted = x + emissivity * signals.emitted_covariance @ weighted
        adjusted = adjusted - (1.0 - emissivity) * signals.reflected_covariance @ weighted
        weights = signals.weighted(emissivity, adjusted)
        previous, emissivity = emissivity, float((weights @ y) / (weights @ x))
        if abs(emissivity - previous) < _CONVERGED:
            break
    else:
        raise ArithmeticError(
            f"No convergence in band '{name}': emissivity {emissivity} after {_ITERATIONS} steps, "
            f"{previous} before. Must change by less than {_CONVERGED}; readings of more contrast "
            "converge."
        )
    residual = y - emissivity * x
    squares = residual @ signals.weighted(emissivity, residual)
    freedom = residual.size - 1
    chi2 = float(squares / freedom) if freedom else float("nan")
    std, (lowest, highest) = float((weights @ adjusted) ** -0.5), schema.EMISSIVITY_LIMITS
    if max(lowest - emissivity, emissivity - highest) > _BEYOND * std:
        raise ValueError(
            f"Invalid emissivity {emissivity:.4g} +- {std:.2g} in band '{name}'. Must lie in "
            f"[{lowest}, {highest}] within {_BEYOND:g} deviations: are the bands' names or files "
            "exchanged, or temperatures not in kelvin?"
        )
    return emissivity, std, chi2, residual
