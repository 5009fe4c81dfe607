"""Planck's law against closed forms and constants that it must contain."""

import re
from collections.abc import Callable

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from refused import assert_refused
from scipy import constants
from scipy.integrate import quad
from scipy.optimize import minimize_scalar

from dbthermal import planck
from dbthermal.bands import get

WAVELENGTHS = st.floats(1e-6, 1e-4)
TEMPERATURES = st.floats(100.0, 3000.0)


@pytest.mark.parametrize("temperature", [77.0, 300.0, 1000.0, 5800.0])
def test_stefan_boltzmann(temperature: float) -> None:
    """Over all wavelengths, pi L adds up to sigma T^4."""

    def per_octave(logarithm: float) -> float:
        wavelength = np.exp(logarithm)
        return float(np.pi * wavelength * planck.spectral_radiance(wavelength, temperature))

    centre = np.log(planck.SECOND_RADIATION_CONSTANT / temperature)
    total = quad(per_octave, centre - 5.0, centre + 7.0, epsabs=0, epsrel=1e-11, limit=200)[0]
    assert total / temperature**4 == pytest.approx(constants.Stefan_Boltzmann, rel=1e-9)


@pytest.mark.parametrize("temperature", [77.0, 300.0, 5800.0])
def test_wien_displacement(temperature: float) -> None:
    """The maximum lies at Wien's displacement constant over T."""
    peak = constants.Wien / temperature
    found = minimize_scalar(
        lambda wavelength: -float(planck.spectral_radiance(wavelength, temperature)),
        bracket=(0.5 * peak, peak, 2.0 * peak),
        tol=1e-9,
    )
    assert found.x * temperature == pytest.approx(constants.Wien, rel=1e-6)


def test_far_wien_side_does_not_overflow() -> None:
    """The radiance is zero, without a warning, if exp(c2 / lambda T) overflows."""
    assert float(planck.spectral_radiance(1e-6, 4.0)) == 0.0


@given(WAVELENGTHS, TEMPERATURES)
def test_slope_is_the_derivative(wavelength: float, temperature: float) -> None:
    """The slope is the central difference of the radiance."""
    step = 1e-4 * temperature
    above, below = planck.spectral_radiance(wavelength, [temperature + step, temperature - step])
    difference = float(above - below) / (2.0 * step)
    slope = float(planck.spectral_radiance_slope(wavelength, temperature))
    assert slope == pytest.approx(difference, rel=1e-4)


@given(WAVELENGTHS, TEMPERATURES)
def test_brightness_temperature_inverts(wavelength: float, temperature: float) -> None:
    """Temperature to radiance and back is the temperature."""
    radiance = planck.spectral_radiance(wavelength, temperature)
    back = float(planck.brightness_temperature(wavelength, radiance))
    assert back == pytest.approx(temperature, rel=1e-12)


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
@pytest.mark.parametrize(
    ("name", "function", "arguments"),
    [
        ("wavelength [m]", planck.spectral_radiance, (None, 300.0)),
        ("temperature [K]", planck.spectral_radiance, (1e-5, None)),
        ("spectral radiance [W m^-2 sr^-1 m^-1]", planck.brightness_temperature, (1e-5, None)),
    ],
)
def test_bad_value_is_named(
    name: str, function: planck.Spectral, arguments: tuple[float | None, ...], bad: float
) -> None:
    """Each quantity must be finite and positive, and the error gives name, unit and value."""
    first, second = ([1e-5, bad] if value is None else value for value in arguments)
    assert_refused(re.escape(f"Invalid {name} {bad}. Must be finite"), function, first, second)


@pytest.mark.parametrize(
    "value", ["3", b"3", True, np.timedelta64(3, "s"), np.datetime64(3, "s"), 3j, None, [3, None]]
)
def test_what_is_no_number_is_refused(value: object) -> None:
    """Text, truth values, durations, complex numbers and objects raise a TypeError."""
    with pytest.raises(TypeError, match=r"Invalid temperature \[K\] .* Must be a number, not of"):
        planck.spectral_radiance_slope(1e-5, value)  # type: ignore[arg-type]


def test_stated_units_must_agree() -> None:
    """A DataArray whose units are not those in the name raises a ValueError."""
    celsius, micrometres = (xr.DataArray([10.0], attrs={"units": u}) for u in ("degC", "um"))
    calls: list[tuple[Callable[[], object], str]] = [
        (lambda: planck.spectral_radiance(micrometres, 300.0), "'um' of wavelength [m]"),
        (lambda: planck.spectral_radiance(1e-5, celsius), "'degC' of temperature [K]"),
        (lambda: get("9.5").slope(celsius), "'degC' of temperature [K]"),
    ]
    for call, name in calls:
        assert_refused(re.escape(f"Invalid units {name}"), call)
    radiance = xr.DataArray([1e7], attrs={"units": "W m-2 sr-1 m-1"})
    assert planck.brightness_temperature(1e-5, radiance) > 0
