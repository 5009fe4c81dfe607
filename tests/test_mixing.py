"""Image formation: five components, their gain and offset, and the matrix of several bands."""

import re
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from dbthermal import mixing

FRACTIONS = st.floats(0.0, 1.0)
SIGNALS = st.floats(0.0, 1e4)


@st.composite
def optics(draw: st.DrawFn) -> mixing.Optics:
    """Any path and optics that energy allows."""
    transmissivity = draw(FRACTIONS)
    emissivity = draw(FRACTIONS) * (1.0 - transmissivity)
    signals = [draw(SIGNALS) for _ in range(3)]
    return mixing.Optics(draw(FRACTIONS), signals[0], transmissivity, emissivity, *signals[1:])


@given(optics(), FRACTIONS, SIGNALS, SIGNALS)
def test_gain_and_offset_are_the_five_components(
    through: mixing.Optics, emissivity: float, emitted: float, reflected: float
) -> None:
    """The sum of object, background, path, optics and camera is gain times surface plus offset."""
    path, passed = through.path_transmissivity, through.transmissivity
    components = [
        passed * path * emissivity * emitted,
        passed * path * (1.0 - emissivity) * reflected,
        passed * (1.0 - path) * through.path_signal,
        through.emissivity * through.optics_signal,
        (1.0 - passed - through.emissivity) * through.camera_signal,
    ]
    surface = mixing.leaving(emissivity, emitted, reflected)
    assert float(mixing.received(surface, through)) == pytest.approx(sum(components), abs=1e-8)
    linear = through.gain * float(surface) + through.offset
    assert float(mixing.received(surface, through)) == pytest.approx(linear, abs=1e-8)


@given(optics(), SIGNALS)
def test_all_at_one_temperature(through: mixing.Optics, signal: float) -> None:
    """In equilibrium nothing can be told apart: the detector sees the blackbody signal."""
    even = mixing.Optics(
        through.path_transmissivity,
        signal,
        through.transmissivity,
        through.emissivity,
        signal,
        signal,
    )
    assert float(mixing.received(signal, even)) == pytest.approx(signal, abs=1e-8)


def test_clear_optics_change_nothing() -> None:
    """Without path and optics the surface's signal arrives as it is."""
    image = np.arange(6.0).reshape(2, 3)
    np.testing.assert_array_equal(mixing.received(image), image)
    assert (mixing.CLEAR.gain, mixing.CLEAR.offset, mixing.CLEAR.reflectivity) == (1.0, 0.0, 0.0)


@given(FRACTIONS, FRACTIONS, SIGNALS, SIGNALS)
def test_swap_gives_the_same_images(first: float, second: float, x: float, y: float) -> None:
    """Object and background swapped, with emissivities 1 - e, cannot be told by the equation."""
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


def test_condition_number_of_glass() -> None:
    """Plate glass at 0.86 and 0.72 has a condition number of 9.58."""
    assert float(mixing.condition_number([0.86, 0.72])) == pytest.approx(9.58, abs=0.005)


@given(FRACTIONS, FRACTIONS)
def test_condition_number_against_numpy(first: float, second: float) -> None:
    """It is that of `numpy.linalg.cond` wherever the matrix is not close to singular."""
    assume(abs(first - second) > 1e-6)
    expected = float(np.linalg.cond(mixing.matrix([first, second])))
    assert float(mixing.condition_number([first, second])) == pytest.approx(expected, rel=1e-9)


def test_extremes_of_the_condition_number() -> None:
    """A mirror in one band and a blackbody in the other are perfect; gray is singular."""
    numbers = mixing.condition_number([[1.0, 0.0], [0.9, 0.9], [0.0, 0.0]])
    np.testing.assert_array_equal(numbers, [1.0, np.inf, np.inf])


def test_third_band_helps() -> None:
    """The number of three bands uses all of them: one that differs saves a gray pair."""
    assert float(mixing.condition_number([0.9, 0.9, 0.5])) < 10.0


@pytest.mark.parametrize("emissivity", [-0.1, 1.2, np.nan])
def test_bad_emissivity(emissivity: float) -> None:
    """An emissivity outside [0, 1] is named."""
    with pytest.raises(
        ValueError, match=re.escape(f"Invalid emissivity {emissivity}. Must lie in")
    ):
        mixing.leaving([0.5, emissivity], 1.0, 2.0)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"transmissivity": 1.2}, "Invalid transmissivity 1.2 of the optics"),
        ({"path_transmissivity": -0.1}, "Invalid path_transmissivity -0.1 of the optics"),
        ({"emissivity": np.nan}, "Invalid emissivity nan of the optics"),
        (
            {"transmissivity": 0.9, "emissivity": 0.2},
            "Invalid transmissivity 0.9 and emissivity 0.2 of the optics",
        ),
    ],
)
def test_bad_optics(values: dict[str, Any], message: str) -> None:
    """Fractions lie in [0, 1], and energy is not made."""
    with pytest.raises(ValueError, match=re.escape(message)):
        mixing.Optics(**values)
