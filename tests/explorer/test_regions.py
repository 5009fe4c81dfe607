"""Regions against areas that are known."""

import math

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st
from refused import refused

from dbthermal.explorer import Region

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
@example((0.5, 0.5), (2.5, 3.5))  # through the centres of pixels
def test_a_rectangle_is_a_polygon_of_four_corners(
    first: tuple[float, float], last: tuple[float, float]
) -> None:
    """Both have the same pixels, whatever the order of the corners and beyond the image too."""
    (top, left), (bottom, right) = first, last
    corners = ((top, left), (top, right), (bottom, right), (bottom, left))
    rectangle, polygon = Region("rectangle", (first, last)), Region("polygon", corners)
    np.testing.assert_array_equal(rectangle.mask(SHAPE), polygon.mask(SHAPE))


test_bad_regions_are_refused = refused(
    Region,
    [
        ("circle", ((0, 0), (1, 1)), "Unknown kind of region 'circle'"),
        ("rectangle", ((0, 0),), "Invalid 1 points of a rectangle. Must be 2"),
        ("polygon", ((0, 0), (1, 1)), "Invalid 2 points of a polygon. Must be 3 to 1000"),
        ("ellipse", ((0, 0), (1, math.nan)), "Must be finite"),
        ("ellipse", (1, 2), r"Must be pairs \(row, column\)"),
    ],
    error=ValueError,
)
