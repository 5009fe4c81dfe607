"""Type-T thermocouples against NIST's tables and against themselves."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from dbthermal.instruments import thermocouple

# NIST's table of type T (SRD 60), every 10 °C from -270 to 400 °C [mV], to 0.001 mV.
TABLE = """
    -6.258 -6.232 -6.180 -6.105 -6.007 -5.888 -5.753 -5.603 -5.439 -5.261 -5.070 -4.865 -4.648
    -4.419 -4.177 -3.923 -3.657 -3.379 -3.089 -2.788 -2.476 -2.153 -1.819 -1.475 -1.121 -0.757
    -0.383 0.000 0.391 0.790 1.196 1.612 2.036 2.468 2.909 3.358 3.814 4.279 4.750 5.228 5.714
    6.206 6.704 7.209 7.720 8.237 8.759 9.288 9.822 10.362 10.907 11.458 12.013 12.574 13.139
    13.709 14.283 14.862 15.445 16.032 16.624 17.219 17.819 18.422 19.030 19.641 20.255 20.872
"""
EMFS = np.array([float(number) for number in TABLE.split()])
CELSIUS = np.arange(-270.0, 401.0, 10.0)

# The same function to 1e-6 mV, by two independent programs.
POINTS = {
    -200: -5.602961,
    -100: -3.378582,
    0: 0.0,
    20: 0.789612,
    25: 0.991977,
    37: 1.486287,
    60: 2.468151,
    100: 4.278519,
    200: 9.288102,
    400: 20.871970,
}
TEMPERATURES = st.floats(73.15, 673.15)
ICE = 273.15


def test_table() -> None:
    """Every point of the table, every 10 °C, is met to half its last digit."""
    kelvin = np.round(CELSIUS + ICE, 2)
    assert_allclose(thermocouple.emf(kelvin), EMFS, rtol=0, atol=0.000501)


def test_inverse_of_the_table() -> None:
    """From -200 °C, the table's voltages give its temperatures, to half a digit's worth of them."""
    known = CELSIUS >= -200.0
    found = thermocouple.temperature(EMFS[known], ICE)
    digit = 0.000501 / np.gradient(EMFS, CELSIUS)[known]
    assert np.all(np.abs(found - ICE - CELSIUS[known]) <= 1.05 * digit)


@pytest.mark.parametrize(("celsius", "emf"), POINTS.items())
def test_points(celsius: float, emf: float) -> None:
    """The reference function is met to 1e-6 mV."""
    assert_allclose(thermocouple.emf(celsius + ICE), emf, rtol=0, atol=0.6e-6)


def test_approximate_inverse_is_the_one_that_was_published() -> None:
    """NIST's inverse alone is off as was measured elsewhere: by 0.038 K below 0 °C, 0.026 above."""
    for inverse, celsius, off in (
        (thermocouple._INVERSE_BELOW, np.linspace(-200.0, 0.0, 2001), 0.038),
        (thermocouple._INVERSE_ABOVE, np.linspace(0.0, 399.9, 2001), 0.026),
    ):
        alone = np.polynomial.polynomial.polyval(thermocouple.emf(celsius + ICE), inverse)
        assert_allclose(np.abs(alone - celsius).max(), off, rtol=0, atol=0.001)


@given(TEMPERATURES, st.floats(253.15, 333.15))
def test_round_trip(temperature: float, junction: float) -> None:
    """Temperature to voltage at the terminals and back is the temperature, to 1e-6 K."""
    voltage = thermocouple.emf(temperature) - thermocouple.emf(junction)
    found = float(thermocouple.temperature(voltage, junction))
    assert found == pytest.approx(temperature, abs=1e-6)


def test_cold_junction() -> None:
    """4.279 mV with the terminals at 25 °C is 120.882 °C, not the 100 °C of the table."""
    found = float(thermocouple.temperature(4.279, 298.15)) - ICE
    assert found == pytest.approx(120.882, abs=0.0005)


def test_equal_ends_give_no_voltage() -> None:
    """Without a voltage the tip is as warm as the terminals."""
    ends = np.array([263.15, 273.15, 296.15, 373.15])
    assert_allclose(thermocouple.temperature(0.0, ends), ends, rtol=0, atol=1e-9)


def test_last_entry_of_the_table_is_in_range() -> None:
    """20.872 mV, 400 °C rounded up, gives 0.0005 K more than the function's end."""
    assert float(thermocouple.temperature(20.872, ICE)) == pytest.approx(673.1505, abs=1e-4)


def test_shapes_broadcast() -> None:
    """Voltages of several channels share a column of cold junctions."""
    found = thermocouple.temperature(np.zeros((3, 4)), np.full((3, 1), 300.0))
    assert found.shape == (3, 4)
    assert thermocouple.emf([[300.0]]).shape == (1, 1)


@pytest.mark.parametrize("bad", [3.14, 673.16, -1.0, np.inf, np.nan])
def test_temperature_out_of_range_is_named(bad: float) -> None:
    """No temperature outside -270 to 400 °C is taken, and the error says which."""
    message = re.escape(f"Invalid temperature {bad} K of a type-T thermocouple. Must lie in 3.15")
    with pytest.raises(ValueError, match=message):
        thermocouple.emf([300.0, bad])
    with pytest.raises(ValueError, match="Invalid temperature"):
        thermocouple.temperature(1.0, bad)


@pytest.mark.parametrize("bad", [-5.7, 20.873, np.inf, np.nan])
def test_voltage_out_of_range_is_named(bad: float) -> None:
    """A voltage outside the range raises an error and is not clipped, also an open input's."""
    message = re.escape(f"Invalid voltage, referred to 0 °C, {bad} mV")
    with pytest.raises(ValueError, match=message):
        thermocouple.temperature([1.0, bad], ICE)
