"""Regions against areas that are known, and deviations of means against closed forms."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dbthermal.explorer import Region
from dbthermal.explorer._regions import common_gain, mean_std

SHAPE = (120, 160)
coordinates = st.tuples(st.floats(-20, 140), st.floats(-20, 180))


def test_areas() -> None:
    """Numbers of pixels: exact for whole rectangles, within 1 % of ellipse and triangle."""
    assert Region("rectangle", ((10, 20), (40, 80))).mask(SHAPE).sum() == 30 * 60
    ellipse = Region("ellipse", ((10, 20), (110, 140))).mask(SHAPE).sum()
    np.testing.assert_allclose(ellipse, math.pi * 50 * 60, rtol=0.01, atol=0)
    triangle = Region("polygon", ((10, 20), (110, 20), (60, 150))).mask(SHAPE).sum()
    np.testing.assert_allclose(triangle, 0.5 * 100 * 130, rtol=0.01, atol=0)


@given(coordinates, coordinates)
def test_a_rectangle_is_a_polygon_of_four_corners(
    first: tuple[float, float], last: tuple[float, float]
) -> None:
    """Both have the same pixels, whatever the order of the corners and beyond the image too."""
    (top, left), (bottom, right) = first, last
    corners = ((top, left), (top, right), (bottom, right), (bottom, left))
    rectangle, polygon = Region("rectangle", (first, last)), Region("polygon", corners)
    np.testing.assert_array_equal(rectangle.mask(SHAPE), polygon.mask(SHAPE))


@pytest.mark.parametrize(
    ("kind", "points", "message"),
    [
        ("circle", ((0, 0), (1, 1)), "Unknown kind of region 'circle'"),
        ("rectangle", ((0, 0),), "Invalid 1 points of a rectangle. Must be 2"),
        ("polygon", ((0, 0), (1, 1)), "Invalid 2 points of a polygon. Must be 3 to 1000"),
        ("ellipse", ((0, 0), (1, math.nan)), "Must be finite"),
        ("ellipse", (1, 2), r"Must be pairs \(row, column\)"),
    ],
)
def test_bad_regions_are_refused(kind: str, points: tuple[object, ...], message: str) -> None:
    """The error names the kind, the points and the rule."""
    with pytest.raises(ValueError, match=message):
        Region(kind, points)  # type: ignore[arg-type]


def test_mean_std_has_its_limits() -> None:
    """Own errors fall with the root of the number, shared ones not at all, both add in squares."""
    std = np.full((1, 100), 0.5)
    shares = {0.0: 0.05, 0.5: 0.5, 0.3: math.hypot(0.3, 0.4 / 10), math.nan: 0.5, 9.0: 0.5}
    for common, expected in shares.items():
        np.testing.assert_allclose(mean_std(std, np.array(common)), expected, rtol=1e-12)
    std[0, 50:] = np.nan  # not known: these do not count
    np.testing.assert_allclose(mean_std(std, np.zeros(100)), 0.5 / math.sqrt(50), rtol=1e-12)
    assert np.isnan(mean_std(np.full((1, 3), np.nan), np.zeros(3))).all()


def test_mean_std_is_what_simulated_errors_have() -> None:
    """Scatter of means of 40 pixels with a shared and an own error is within 3 % of the formula."""
    rng = np.random.default_rng(5)
    shared, own = np.linspace(0.1, 0.4, 40), np.linspace(0.5, 1.5, 40)
    errors = rng.standard_normal((20_000, 1)) * shared + rng.standard_normal((20_000, 40)) * own
    expected = mean_std(np.hypot(shared, own)[np.newaxis], shared)[0]
    scatter = errors.mean(axis=1).std()
    print(f"scatter of the mean {scatter:.4f}, stated {expected:.4f}")
    np.testing.assert_allclose(scatter, expected, rtol=0.03)


def test_gain_is_the_derivative_of_the_inverse() -> None:
    """Object and background, inverted from two bands with emissivities changed, move as stated."""
    warm, cold, error = 320.0, 295.0, np.array([2e-6, -1e-6])
    emissivity = np.array([0.86, 0.72])
    signal = emissivity * warm + (1 - emissivity) * cold
    changed = emissivity + error
    moved = np.linalg.solve(np.column_stack([changed, 1 - changed]), signal) - [warm, cold]
    covariance = np.multiply.outer(error, error)[..., np.newaxis, np.newaxis]
    gains = common_gain(emissivity[:, np.newaxis, np.newaxis], covariance)
    np.testing.assert_allclose(gains.ravel() * (warm - cold), np.abs(moved), rtol=1e-3)


@pytest.mark.parametrize("shared", [0.0, 0.6, 1.0])
def test_neighbours_tell_what_they_share(shared: float) -> None:
    """Of emissivities with a shared and an own error, the shared part of the gain is found."""
    rng, std = np.random.default_rng(8), 0.01
    base = np.array([0.86, 0.72])[:, np.newaxis, np.newaxis] + np.zeros((2, 60, 60))
    base += std * np.sqrt(shared) * rng.standard_normal((2, 1, 1))
    value = base + std * np.sqrt(1.0 - shared) * rng.standard_normal(base.shape)
    covariance = std**2 * np.eye(2)[:, :, np.newaxis, np.newaxis] * np.ones((1, 1, 60, 60))
    whole = common_gain(base, covariance)  # alike: all of it is shared
    part = np.median(common_gain(value, covariance) / whole, axis=(1, 2)) ** 2
    print(f"shared {shared}: found {part.round(3)} of the variance of object and background")
    np.testing.assert_allclose(part, shared, rtol=0, atol=0.08)
    varied = base + 5 * std * rng.standard_normal(base.shape)  # a material, not errors
    assert np.median(common_gain(varied, covariance) / whole) > 0.7
