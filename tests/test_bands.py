"""Bands: the exact pair temperature and in-band radiance, against quadrature and tables."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refused import assert_raises, assert_refused
from scipy.integrate import quad

from dbthermal import planck
from dbthermal.bands import FILTERS, TEMPERATURE_RANGE, Band, get

TEMPERATURES = st.floats(100.001, 1999.99)  # at the ends rounding leads out of the range
NAMES = st.sampled_from(sorted(FILTERS))


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("temperature", [*TEMPERATURE_RANGE, 300.0])
def test_radiance_against_quadrature(name: str, temperature: float) -> None:
    """Over the whole range, forty nodes agree with adaptive quadrature."""
    band = FILTERS[name]

    def radiance(micrometres: float) -> float:
        return float(planck.spectral_radiance(micrometres * 1e-6, temperature)) * 1e-6

    expected = quad(radiance, band.lower * 1e6, band.upper * 1e6, epsabs=0, epsrel=1e-12)[0]
    assert float(band.radiance(temperature)) == pytest.approx(expected, rel=1e-11)


@given(NAMES, st.floats(150.0, 1900.0))
def test_slope_is_the_derivative(name: str, temperature: float) -> None:
    """The slope is the central difference of the radiance."""
    band, step = FILTERS[name], 1e-4 * temperature
    above, below = band.radiance([temperature + step, temperature - step])
    difference = float(above - below) / (2.0 * step)
    assert float(band.slope(temperature)) == pytest.approx(difference, rel=1e-5)


@given(NAMES, TEMPERATURES)
def test_temperature_inverts_radiance(name: str, temperature: float) -> None:
    """Temperature to radiance and back is the temperature, to rounding."""
    band = FILTERS[name]
    radiance = band.radiance(temperature)
    back = float(band.temperature(radiance))
    assert back == pytest.approx(temperature, rel=1e-13)
    assert float(band.radiance(back)) == pytest.approx(float(radiance), rel=1e-12)


def test_images_keep_their_shape() -> None:
    """An image of temperatures gives an image of radiances, and back."""
    image = np.linspace(280.0, 340.0, 12).reshape(3, 4)
    band = FILTERS["9.5"]
    np.testing.assert_allclose(band.temperature(band.radiance(image)), image, rtol=0, atol=1e-10)


@pytest.mark.parametrize("bad", [99.9, 2000.1, np.nan, 25.0, -1.0, 0.0, 1e9])
def test_values_outside_the_range(bad: float) -> None:
    """A temperature or radiance outside the range is named with band and range, not clipped."""
    message = f"Invalid temperature [K] in band '9.5' {bad}. Must lie in [100.0, 2000.0]."
    for function in (FILTERS["9.5"].radiance, FILTERS["9.5"].slope):
        assert_refused(re.escape(message), function, [300.0, bad])
    if not 0.0 < bad < 1e6:
        message = f"Invalid radiance [W m-2 sr-1] in band '8-14' {bad}. Must lie in ["
        assert_refused(re.escape(message), FILTERS["8-14"].temperature, [50.0, bad])


@pytest.mark.parametrize(
    "edges", [(9e-6, 8e-6), (0.0, 8e-6), (8e-6, 8e-6), (8e-6, np.inf), (8.0, 14.0)]
)
def test_edges_that_are_no_band(edges: tuple[float, float]) -> None:
    """A band without a positive, finite width, or in micrometres, raises a ValueError."""
    assert_refused(r"edges of band 'odd' .* Must be finite .* metres, not", Band, "odd", *edges)


def test_filters_of_the_paper() -> None:
    """Centres and widths are the published ones, and each filter goes by its own name."""
    found = {name: (band.centre * 1e6, band.width * 1e6) for name, band in FILTERS.items()}
    expected = {"8-14": (11.0, 6.0), "8.5": (8.5, 0.5), "9.5": (9.5, 0.5), "10.6": (10.6, 1.5)}
    expected["12.1"] = (12.1, 0.5)
    assert found.keys() == expected.keys()
    for name, values in expected.items():
        assert found[name] == pytest.approx(values, abs=1e-9)
        assert get(name).name == name
    assert_raises(KeyError, re.escape("Unknown band '9.25'. Must be one of ['10.6'"), get, "9.25")
