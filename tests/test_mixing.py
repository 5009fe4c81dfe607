"""Image formation: forward, inverse, and the matrix of several bands."""

import re

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from dbthermal import mixing

FRACTIONS = st.floats(0.0, 1.0)
SIGNALS = st.floats(0.0, 1e4)


@given(FRACTIONS, SIGNALS, SIGNALS)
def test_background_is_the_inverse(emissivity: float, x: float, y: float) -> None:
    """The background's signal follows from the surface's and the object's."""
    assume(emissivity < 0.99)
    signal = mixing.mixed(emissivity, x, y)
    assert float(mixing.background(emissivity, signal, x)) == pytest.approx(y, abs=1e-7)


@given(FRACTIONS, FRACTIONS, SIGNALS, SIGNALS)
def test_swap_gives_the_same_images(first: float, second: float, x: float, y: float) -> None:
    """Object and background swapped, with emissivities 1 - e, give the same signals."""
    bands = np.array([first, second])
    swapped = mixing.leaving(1.0 - bands, y, x)
    np.testing.assert_allclose(mixing.leaving(bands, x, y), swapped, rtol=0, atol=1e-8)


@given(st.floats(0.0, 0.9), st.floats(0.0, 0.9), SIGNALS, SIGNALS)
def test_reflection_ratio_alone_gives_the_object(
    first: float, second: float, x: float, y: float
) -> None:
    """The object is (z2 - k2 z1) / (1 - k2): of the emissivities only k2 is needed."""
    assume(abs(first - second) > 0.01)
    z = mixing.leaving([first, second], x, y)
    ratio = (1.0 - second) / (1.0 - first)
    assert float((z[1] - ratio * z[0]) / (1.0 - ratio)) == pytest.approx(x, abs=1e-7)


def test_matrix_mixes() -> None:
    """The matrix times object and background is what leaves the surface, pixel by pixel."""
    emissivity = np.array([[0.9, 0.7], [0.5, 0.2]])  # (pixel, band)
    mixed = mixing.matrix(emissivity) @ np.array([320.0, 290.0])
    np.testing.assert_allclose(mixed, mixing.leaving(emissivity, 320.0, 290.0), rtol=0, atol=1e-10)


@given(st.lists(FRACTIONS, min_size=2, max_size=4))
def test_condition_number_against_numpy(bands: list[float]) -> None:
    """The closed form is `numpy.linalg.cond` unless the matrix is nearly singular."""
    assume(np.ptp(bands) > 1e-6)
    expected = float(np.linalg.cond(mixing.matrix(bands)))
    assert float(mixing.condition_number(bands)) == pytest.approx(expected, rel=1e-9)


def test_extremes_of_the_condition_number() -> None:
    """A mirror beside a blackbody is perfect, gray is singular, plate glass has 9.58."""
    numbers = mixing.condition_number([[1.0, 0.0], [0.9, 0.9], [0.0, 0.0]])
    np.testing.assert_array_equal(numbers, [1.0, np.inf, np.inf])
    assert float(mixing.condition_number([0.86, 0.72])) == pytest.approx(9.58, abs=0.005)


@pytest.mark.parametrize("emissivity", [-0.1, 1.2, np.nan])
def test_bad_emissivity(emissivity: float) -> None:
    """An emissivity outside [0, 1] is named."""
    rule = re.escape(f"Invalid emissivity {emissivity}. Must lie in")
    with pytest.raises(ValueError, match=rule):
        mixing.leaving([0.5, emissivity], 1.0, 2.0)
