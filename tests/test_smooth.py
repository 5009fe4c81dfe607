"""The smooth subspace: orthonormal, nested, and exactly the polynomials."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dbthermal import smooth

TIMES = st.lists(st.floats(0.01, 10.0), min_size=12, max_size=40).map(np.cumsum)
ORDERS = st.integers(1, 6)


@given(TIMES, ORDERS)
def test_basis_is_orthonormal(time: smooth.Array, order: int) -> None:
    """The functions are orthonormal over the capture's own times, evenly spaced or not."""
    functions = smooth.basis(time, order)
    np.testing.assert_allclose(functions.T @ functions, np.eye(order), rtol=0, atol=1e-12)


@given(TIMES, ORDERS, st.integers(0, 1000))
def test_basis_spans_the_polynomials(time: smooth.Array, order: int, seed: int) -> None:
    """A polynomial of a degree below the order is its own projection."""
    coefficients = np.random.default_rng(seed).standard_normal(order)
    signal = np.polynomial.Polynomial(coefficients, domain=[time[0], time[-1]])(time)
    functions = smooth.basis(time, order)
    np.testing.assert_allclose(functions @ (functions.T @ signal), signal, rtol=0, atol=1e-10)


def test_bases_are_nested() -> None:
    """A higher order keeps the functions of the lower one, up to their sign."""
    time = np.arange(30.0)
    small, large = smooth.basis(time, 3), smooth.basis(time, 7)
    np.testing.assert_allclose(np.abs(large[:, :3]), np.abs(small), rtol=0, atol=1e-12)


@given(st.floats(0.01, 100.0), st.floats(-1e4, 1e4))
def test_basis_ignores_unit_and_start_of_time(scale: float, start: float) -> None:
    """Seconds or minutes, from whenever: the functions are the same."""
    time = np.arange(20.0) ** 1.2
    functions = smooth.basis(start + scale * time, 5)
    np.testing.assert_allclose(np.abs(functions), np.abs(smooth.basis(time, 5)), rtol=0, atol=1e-6)


def test_single_frame() -> None:
    """One frame has the constant alone."""
    np.testing.assert_allclose(np.abs(smooth.basis([3.0], 1)), [[1.0]], rtol=0, atol=0)


@pytest.mark.parametrize("order", [0, -1, 6])
def test_bad_order(order: int) -> None:
    """An order of nothing, or of more functions than frames, is refused."""
    with pytest.raises(ValueError, match=re.escape(f"Invalid order {order} of the smooth")):
        smooth.basis(np.arange(5.0), order)


def test_leverage_is_the_hat_matrix() -> None:
    """For each order the leverage is the diagonal of the projection, and adds up to the order."""
    time = np.cumsum(np.linspace(0.1, 0.5, 25))
    result = smooth.subspace(time, 5).leverage()
    for order in range(1, 6):
        design = np.vander(time - time.mean(), order)
        hat = design @ np.linalg.pinv(design)
        np.testing.assert_allclose(result[:, order - 1], np.diag(hat), rtol=0, atol=1e-9)
    np.testing.assert_allclose(result.sum(axis=0), np.arange(1.0, 6.0), rtol=0, atol=1e-12)


def test_residual_energy_against_least_squares() -> None:
    """For each order and pixel it is the inner product of the residuals of two polynomial fits."""
    rng = np.random.default_rng(4)
    time = np.arange(40.0)
    first, second = rng.standard_normal((2, 40, 3))
    result = smooth.residual_energy(smooth.basis(time, 4), first, second)
    for order in range(1, 5):
        design = np.vander(time / 40.0, order)
        residuals = [
            signal - design @ np.linalg.lstsq(design, signal, rcond=None)[0]
            for signal in (first, second)
        ]
        expected = np.sum(residuals[0] * residuals[1], axis=0)
        np.testing.assert_allclose(result[order - 1], expected, rtol=0, atol=1e-10)
