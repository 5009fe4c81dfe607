"""Metrics against sums by hand, and errors for missing values."""

import re
from collections.abc import Callable

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from refused import refused

from reproduction import metrics

KELVIN = {"units": "K"}


def movie(values: object, **attrs: str) -> xr.DataArray:
    """Movie (time, y, x) from nested lists."""
    return xr.DataArray(np.asarray(values, dtype=float), dims=("time", "y", "x"), attrs=attrs)


@pytest.fixture
def truth() -> xr.DataArray:
    """Four frames of two by three pixels at 300 K and above."""
    return movie(300.0 + np.arange(24.0).reshape(4, 2, 3), units="K")


def test_correlation_agrees_with_numpy() -> None:
    """Frame by frame over the mask, the correlation is that of `numpy.corrcoef`."""
    rng = np.random.default_rng(7)
    first, second = (movie(rng.standard_normal((5, 6, 7))) for _ in range(2))
    mask = xr.DataArray(rng.random((6, 7)) < 0.6, dims=("y", "x"))
    result = metrics.correlation(first, second, mask)
    pairs = zip(first.values, second.values, strict=True)
    expected = [np.corrcoef(a[mask.values], b[mask.values])[0, 1] for a, b in pairs]
    np.testing.assert_allclose(result.values, expected, rtol=0, atol=1e-14)
    assert result.dims == ("time",)


@given(st.floats(0.1, 10.0), st.floats(-100.0, 100.0))
def test_correlation_ignores_gain_and_offset(gain: float, offset: float) -> None:
    """A map and its linear image correlate at 1, and at -1 if turned over."""
    maps = movie(np.sin(np.arange(24.0)).reshape(2, 3, 4))
    for other, expected in ((gain * maps + offset, 1), (-gain * maps, -1)):
        found = metrics.correlation(maps, other)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


def test_relative_error_is_of_degrees_celsius() -> None:
    """At 50 degrees Celsius an error of 1 K is 2 per cent, and the label says of what."""
    truth = xr.DataArray([323.15], dims="time", attrs=KELVIN)
    result = metrics.relative_error_celsius(truth - 1.0, truth)
    np.testing.assert_allclose(result.values, [2.0], rtol=0, atol=1e-12)
    assert result.attrs["units"] == "percent"
    assert "degrees Celsius" in result.attrs["long_name"]


@pytest.mark.parametrize(
    ("temperature", "units", "message"),
    [(273.15, "K", "true temperature 273.15 K"), (50.0, "degC", "units 'degC' of the estimate")],
)
def test_relative_error_needs_kelvin_above_zero(
    temperature: float, units: str, message: str
) -> None:
    """Temperatures in degrees Celsius, or at or below 273.15 K, raise a ValueError."""
    truth = xr.DataArray([temperature], dims="time", attrs={"units": units})
    with pytest.raises(ValueError, match=re.escape(message)):
        metrics.relative_error_celsius(truth, truth)


Change = Callable[[xr.DataArray], tuple[xr.DataArray, ...]]
MASK = xr.DataArray(np.ones((2, 3), bool), dims=("y", "x"))


test_what_has_no_correlation_is_refused = refused(
    lambda truth, arguments: metrics.correlation(
        *arguments(truth.assign_coords(time=[0.0, 1.0, 2.0, 3.0]))
    ),
    [
        (lambda one: (one, one, ~MASK), "Invalid mask: 0 pixels remain"),
        (lambda one: (one, one, one.isel(time=0) == 301.0), "1 pixels remain"),
        (lambda one: (one, one, one > 301.0), "Invalid mask"),
        (lambda one: (one, one, MASK.astype(float)), "of float64. Must be bool"),
        (lambda one: (one, one, xr.DataArray([True], dims="band")), "Must be bool, (y, x)"),
        (lambda one: (one.where(one != 305), one), "1 of 24 values that count are not finite"),
        (lambda one: (one, one.assign_coords(time=one["time"] + 1)), "time"),
        (lambda one: (one, one.where(one["time"] != 2, 300.0)), "Constant map in 1 of 4 frames"),
        (lambda one: (one.isel(x=0), one.isel(x=0)), "Must hold y and x"),
        (lambda one: (one, one.rename(time="frame")), "Must be among"),
    ],
    "truth",
)


def test_other_dims_are_refused(truth: xr.DataArray) -> None:
    """A curve in time is broadcast; a dim that the other array lacks raises a ValueError."""
    curve = truth.isel(y=0, x=0, drop=True)
    assert metrics.relative_error_celsius(truth, curve).dims == truth.dims
    for estimate, reference in ((truth.rename(x="column"), truth), (curve, truth)):
        with pytest.raises(ValueError, match=r"Invalid dims .* Must be among"):
            metrics.relative_error_celsius(estimate, reference)
