"""The camera's response: curve, slope, inverse and linearised signal, exact and linear."""

import re
from typing import Any, cast

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from refused import refused

from dbthermal import planck, response, schema
from dbthermal.response import Curve, LinearCurve

TEMPERATURES = st.floats(250.0, 400.0)
# Published constants of a laboratory's FLIR Boson: R / (exp(B / T) - F) + O with F = 1.
BOSON = Curve(
    "8-14", 1.08e6, planck.SECOND_RADIATION_CONSTANT / 1524.0, 0.0, 15500.0, 300.0, 250.0, 400.0
)
LINE = LinearCurve("8-14", 115.0, 0.0, 0.0, -12000.0, 300.0, 250.0, 400.0)
CURVES = st.builds(
    Curve,
    band=st.just("9.5"),
    amplitude=st.floats(1e4, 1e7),
    wavelength=st.floats(7e-6, 14e-6),
    shift=st.floats(-2e-4, 2e-4),
    offset=st.floats(-2e4, 2e4),
    reference=st.just(298.15),
    lowest=st.just(250.0),
    highest=st.just(400.0),
)


@pytest.fixture
def two_bands() -> xr.Dataset:
    """Response of a wide band and of a filter, with both its kinds of coefficient."""
    band = {
        "amplitude": [1.08e6, 1.5e5],
        "effective_wavelength": [10.6e-6, 9.5e-6],
        "wavelength_shift": [1e-5, 0.0],
        "offset": [15500.0, 17000.0],
        "linear_slope": [115.0, 11.0],
        "linear_intercept": [-12000.0, 14000.0],
    }
    single = {"reference_temperature": 298.15, "temperature_min": 280.0, "temperature_max": 340.0}
    parts = {name: ("band", values) for name, values in band.items()} | single
    return schema.check(xr.Dataset(parts, {"band": ["8-14", "9.5"]}), "response")


@given(TEMPERATURES, st.floats(7e-6, 14e-6))
def test_without_shift_it_is_planck(temperature: float, wavelength: float) -> None:
    """With B = 0 the excess over the offset is Planck's law at the effective wavelength."""
    curve = Curve("m", 1e6, wavelength, 0.0, 500.0, 300.0, 250.0, 400.0)
    counts, reference = curve.counts([temperature, 300.0]) - 500.0
    radiances = planck.spectral_radiance(wavelength, [temperature, 300.0])
    assert counts / reference == pytest.approx(float(radiances[0] / radiances[1]), rel=1e-10)


@given(CURVES, TEMPERATURES)
def test_inverse_of_counts(curve: Curve, temperature: float) -> None:
    """Temperature to counts and back is the temperature, to the counts' rounding."""
    counts = curve.counts(temperature)
    rounding = 4 * np.spacing(abs(float(counts)) + abs(curve.offset))
    tolerance = rounding / float(curve.count_slope(temperature)) + 1e-10
    assert float(curve.inverse(counts)) == pytest.approx(temperature, abs=tolerance)


@given(CURVES, TEMPERATURES)
def test_slope_is_the_derivative(curve: Curve, temperature: float) -> None:
    """The slope is the central difference of the counts."""
    above, below = curve.counts([temperature + 0.05, temperature - 0.05])
    slope = float(curve.count_slope(temperature))
    rounding = 20 * np.spacing(abs(curve.offset) + abs(float(above)))
    assert slope == pytest.approx(float(above - below) / 0.1, rel=1e-6, abs=10 * rounding)


@pytest.mark.parametrize("curve", [BOSON, LINE], ids=["exact", "linear"])
def test_linearise_is_the_signal(curve: Curve) -> None:
    """A blackbody's counts, linearised, are its signal: the temperature at 300 K, with slope 1."""
    assert float(curve.signal(300.0)) == pytest.approx(300.0, abs=1e-12)
    assert float(curve.slope(300.0)) == pytest.approx(1.0, abs=1e-15)
    temperatures = np.linspace(250.0, 400.0, 31).reshape(1, 31)
    signal = curve.linearise(curve.counts(temperatures))
    np.testing.assert_array_equal(signal, curve.signal(temperatures))
    np.testing.assert_allclose(curve.temperature(signal), temperatures, rtol=0, atol=1e-9)


def test_exact_kind_is_no_line() -> None:
    """Linearised at 300 K, a blackbody of 330 K reads 4.79 K too high; of the linear kind, 330."""
    assert float(LINE.signal(330.0)) == pytest.approx(330.0, abs=1e-10)
    assert float(LINE.counts(330.0)) == pytest.approx(115.0 * 330.0 - 12000.0, abs=1e-9)
    excess = 1.0 / np.expm1(1524.0 / np.array([300.0, 330.0]))
    slope = excess[0] ** 2 * np.exp(1524.0 / 300.0) * 1524.0 / 300.0**2
    expected = 300.0 + (excess[1] - excess[0]) / slope
    assert float(BOSON.signal(330.0)) == pytest.approx(expected, abs=1e-9)
    assert expected == pytest.approx(334.79, abs=0.005)


def test_no_temperature_has_such_counts() -> None:
    """The inverse is NaN at and below the offset, and finite above."""
    result = BOSON.inverse([15499.0, 15500.0, 15501.0])
    assert np.isnan(result).tolist() == [True, True, False]


def test_curve_of_a_response(two_bands: xr.Dataset) -> None:
    """The curve of a band has the coefficients of its kind."""
    exact, linear = (response.curve(two_bands, "9.5", kind) for kind in response.KINDS)
    assert exact == Curve("9.5", 1.5e5, 9.5e-6, 0.0, 17000.0, 298.15, 280.0, 340.0)
    assert isinstance(linear, LinearCurve)
    assert float(linear.counts(300.0)) == pytest.approx(11.0 * 300.0 + 14000.0, abs=1e-9)


@pytest.mark.parametrize("temperature", [279.9, 340.1, np.nan, 25.0])
def test_temperature_outside_the_calibration(two_bands: xr.Dataset, temperature: float) -> None:
    """A temperature that was not calibrated is named, with the range, to which its ends belong."""
    ends = response.counts(two_bands, xr.DataArray([280.0, 340.0], dims="x"))
    assert np.isfinite(ends).all()
    message = f"temperature {temperature} K in band '8-14'. Must lie in the response's range"
    with pytest.raises(ValueError, match=re.escape(message)):
        response.counts(two_bands, xr.DataArray([300.0, temperature], dims="x"))


def curve_of(two_bands: xr.Dataset, kind: str = "exact", band: str = "9.5", **to: float) -> Curve:
    """Curve of a band whose response has other values."""
    for name, value in to.items():
        two_bands[name][... if two_bands[name].ndim == 0 else 1] = value
    return response.curve(two_bands, band, kind)


MILLI, NOTHING = xr.DataArray([300.0], dims="x", attrs={"units": "mK"}), cast(Any, None)


test_what_is_no_response = refused(
    lambda known, call, options: call(known, **options),
    [
        (curve_of, {"band": "10.6"}, "Missing band '10.6' in the response, of ['8-14', '9.5']"),
        (curve_of, {"kind": "cubic"}, "Unknown kind of response 'cubic'. Must be one of"),
        (lambda r: curve_of(r.drop_vars("offset")), {}, "Missing variable 'offset' in the"),
        (curve_of, {"offset": np.nan}, "Invalid offset of the response in band '9.5'"),
        (curve_of, {"amplitude": -1.0}, "Invalid slope"),
        (curve_of, {"kind": "linear", "linear_slope": 0.0}, "Invalid slope 0.0 count/K of the"),
        (curve_of, {"temperature_max": 80.0}, "Invalid range 280.0 to 80.0 K of the response"),
        (curve_of, {"temperature_min": -10.0}, "Invalid range -10.0 to 340.0 K of the"),
        (curve_of, {"reference_temperature": 25.0}, "280.0 to 340.0 K of the response, refer"),
        (curve_of, {"reference_temperature": 29815.0}, "of the response, reference 29815.0"),
        (response.counts, {"temperature": MILLI}, "Invalid units 'mK' of the temperature"),
        (response.counts, {"temperature": 300.0}, "Invalid temperature of type float"),
        (response.counts, {"temperature": MILLI.astype(str)}, "temperature. Must be a real numb"),
        (lambda _: response.noise(NOTHING, ["9.5"]), {}, "Invalid response of type NoneType"),
    ],
    "two_bands",
)
