"""Measures: against sums done by hand, and nothing left out in silence."""

import re

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from dbthermal import metrics

KELVIN = {"units": "K"}


def movie(values: object, **attrs: str) -> xr.DataArray:
    """Movie (time, y, x) from nested lists."""
    return xr.DataArray(np.asarray(values, dtype=float), dims=("time", "y", "x"), attrs=attrs)


@pytest.fixture
def truth() -> xr.DataArray:
    """Four frames of two by three pixels at 300 K and above."""
    return movie(300.0 + np.arange(24.0).reshape(4, 2, 3), units="K")


@pytest.fixture
def rng() -> np.random.Generator:
    """Seeded random numbers."""
    return np.random.default_rng(7)


def test_rmse_by_hand() -> None:
    """Errors of 3 and 4 K make a root mean square of sqrt(12.5) K, and keep the unit."""
    result = metrics.rmse(movie([[[3.0]], [[4.0]]], units="K"), movie([[[0.0]], [[0.0]]]))
    np.testing.assert_allclose(result.values, [[12.5**0.5]], rtol=0, atol=1e-15)
    assert (result.dims, result.attrs["units"]) == (("y", "x"), "K")


def test_a_curve_is_broadcast(truth: xr.DataArray) -> None:
    """A truth in time alone holds for every pixel."""
    curve = truth.isel(y=0, x=0, drop=True)
    result = metrics.rmse(xr.ones_like(truth) * curve + 2.0, curve)
    np.testing.assert_allclose(result, np.full((2, 3), 2.0), rtol=0, atol=1e-12)


def test_median_rmse_counts_the_mask(truth: xr.DataArray) -> None:
    """A pixel outside the mask does not enter, though it is NaN."""
    estimate = truth + xr.DataArray([[1.0, 2.0, 9.0], [3.0, np.nan, 9.0]], dims=("y", "x"))
    mask = xr.DataArray([[True, True, False], [True, False, False]], dims=("y", "x"))
    assert metrics.median_rmse(estimate, truth, mask) == pytest.approx(2.0, abs=1e-12)


@given(st.floats(-5.0, 5.0))
def test_bias_is_the_shift(shift: float) -> None:
    """A shift of every sample is the bias, and its size the root mean square."""
    truth = movie(np.full((3, 2, 2), 300.0))
    assert metrics.bias(truth + shift, truth) == pytest.approx(shift, abs=1e-12)
    assert metrics.median_rmse(truth + shift, truth) == pytest.approx(abs(shift), abs=1e-12)


@pytest.mark.parametrize(("k", "share"), [(1.0, 0.6827), (2.0, 0.9545), (3.0, 0.9973)])
def test_coverage_of_normal_errors(rng: np.random.Generator, k: float, share: float) -> None:
    """Of normal errors the published shares lie within one, two and three deviations."""
    std = movie(rng.uniform(0.1, 2.0, (100, 30, 30)))
    truth = xr.full_like(std, 300.0)
    estimate = truth + std * rng.standard_normal(std.shape)
    # Standard deviation of a share of 90,000 samples: 0.0016 at most.
    assert metrics.coverage(estimate, std, truth, k=k) == pytest.approx(share, abs=0.006)


def test_coverage_of_a_map_of_std(truth: xr.DataArray) -> None:
    """A standard deviation a pixel holds for all frames."""
    std = xr.DataArray([[2.0, 2.0, 2.0], [0.5, 0.5, 0.5]], dims=("y", "x"))
    assert metrics.coverage(truth + 1.0, std, truth) == 0.5


def test_correlation_agrees_with_numpy(rng: np.random.Generator) -> None:
    """Frame by frame over the mask, the correlation is that of `numpy.corrcoef`."""
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
    np.testing.assert_allclose(
        metrics.correlation(maps, gain * maps + offset), 1, rtol=0, atol=1e-9
    )
    np.testing.assert_allclose(metrics.correlation(maps, -gain * maps), -1, rtol=0, atol=1e-9)


def test_relative_error_is_of_degrees_celsius() -> None:
    """At 50 degrees Celsius an error of 1 K is 2 per cent, and the label says of what."""
    truth = xr.DataArray([323.15], dims="time", attrs=KELVIN)
    result = metrics.relative_error_celsius(truth - 1.0, truth)
    np.testing.assert_allclose(result.values, [2.0], rtol=0, atol=1e-12)
    assert result.attrs["units"] == "percent"
    assert "degrees Celsius" in result.attrs["long_name"]


@pytest.mark.parametrize(
    ("temperature", "units", "message"),
    [(273.15, "K", "true temperature 273.15 K"), (50.0, "degC", "units 'degC'. Must be 'K'")],
)
def test_relative_error_needs_kelvin_above_zero(
    temperature: float, units: str, message: str
) -> None:
    """Degrees Celsius passed as kelvin, or a truth of no positive reading, are refused."""
    truth = xr.DataArray([temperature], dims="time", attrs={"units": units})
    with pytest.raises(ValueError, match=re.escape(message)):
        metrics.relative_error_celsius(truth, truth)


def test_nothing_left_is_an_error(truth: xr.DataArray) -> None:
    """An empty mask has no median."""
    mask = xr.zeros_like(truth.isel(time=0), dtype=bool)
    for measure in (metrics.bias, metrics.median_rmse, metrics.correlation):
        with pytest.raises(ValueError, match="Empty mask: no value is left"):
            measure(truth, truth, mask)


def test_lost_values_are_an_error(truth: xr.DataArray) -> None:
    """A NaN that counts is not averaged away."""
    estimate = truth.where(truth != 305.0)
    for measure in (metrics.bias, metrics.median_rmse, metrics.correlation):
        with pytest.raises(ValueError, match=r"1 of \d+ values that count are not finite"):
            measure(estimate, truth)


def test_units_must_agree(truth: xr.DataArray) -> None:
    """Kelvin is not compared with degrees Celsius."""
    with pytest.raises(ValueError, match=re.escape("Invalid units ['K', 'degC']")):
        metrics.rmse(truth, truth.assign_attrs(units="degC"))


def test_coordinates_must_agree(truth: xr.DataArray) -> None:
    """Frames at other times are not joined to the few that match."""
    first = truth.assign_coords(time=[0.0, 1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="time"):
        metrics.bias(first, first.assign_coords(time=[1.0, 2.0, 3.0, 4.0]))


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (xr.DataArray(np.ones((2, 3)), dims=("y", "x")), "of float64. Must be bool"),
        (xr.DataArray([True], dims="band"), "('band',) of bool. Must be bool, over some of"),
    ],
)
def test_mask_is_bool_over_the_same_dims(
    truth: xr.DataArray, mask: xr.DataArray, message: str
) -> None:
    """Weights, or a mask over another dimension, are no mask."""
    with pytest.raises(ValueError, match=re.escape(message)):
        metrics.bias(truth, truth, mask)


def test_constant_map_has_no_correlation(truth: xr.DataArray) -> None:
    """A map without variation is refused, not given a correlation of NaN."""
    flat = truth.where(truth["time"] != 2, 300.0)
    with pytest.raises(ValueError, match="Constant map in 1 of 4 frames"):
        metrics.correlation(truth, flat)


def test_one_pixel_has_no_correlation(truth: xr.DataArray) -> None:
    """A correlation needs two pixels, and a mask that is the same in each frame."""
    mask = truth.isel(time=0) == 301.0
    with pytest.raises(ValueError, match="1 pixel is left"):
        metrics.correlation(truth, truth, mask)
    with pytest.raises(ValueError, match="of the mask"):
        metrics.correlation(truth, truth, truth > 301.0)


@pytest.mark.parametrize(("k", "std", "message"), [(0.0, 1.0, "k 0.0"), (1.0, -1.0, "-1.0")])
def test_error_bars_have_a_width(truth: xr.DataArray, k: float, std: float, message: str) -> None:
    """No width, or a negative one, is no error bar."""
    with pytest.raises(ValueError, match=message):
        metrics.coverage(truth, xr.full_like(truth, std), truth, k=k)


def test_missing_dimension(truth: xr.DataArray) -> None:
    """A mean over a dimension that is not there, and maps that are none, are refused."""
    with pytest.raises(ValueError, match="Missing dimension 'frame'"):
        metrics.rmse(truth, truth, dim="frame")
    with pytest.raises(ValueError, match="Must hold y and x"):
        metrics.correlation(truth.isel(x=0), truth.isel(x=0))
