"""The smooth subspace: orthonormal, nested, and exactly the polynomials."""

import itertools
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import block_diag

from dbthermal import _smooth as smooth
from dbthermal._arrays import Array

TIMES = st.lists(st.floats(0.01, 10.0), min_size=12, max_size=40).map(np.cumsum)
ORDERS = st.integers(1, 6)


@given(TIMES, ORDERS)
def test_basis_is_orthonormal(time: Array, order: int) -> None:
    """The functions are orthonormal over the capture's own times, evenly spaced or not."""
    functions = smooth.polynomial_basis(time, order)
    np.testing.assert_allclose(functions.T @ functions, np.eye(order), rtol=0, atol=1e-12)


@given(TIMES, ORDERS, st.integers(0, 1000))
def test_basis_spans_the_polynomials(time: Array, order: int, seed: int) -> None:
    """A polynomial of a degree below the order is its own projection."""
    coefficients = np.random.default_rng(seed).standard_normal(order)
    signal = np.polynomial.Polynomial(coefficients, domain=[time[0], time[-1]])(time)
    functions = smooth.polynomial_basis(time, order)
    np.testing.assert_allclose(functions @ (functions.T @ signal), signal, rtol=0, atol=1e-10)


@given(st.floats(0.01, 100.0), st.floats(-1e4, 1e4))
def test_basis_ignores_unit_and_start_of_time(scale: float, start: float) -> None:
    """Seconds or minutes, from whenever: the functions are the same."""
    time = np.arange(20.0) ** 1.2
    functions = smooth.polynomial_basis(start + scale * time, 5)
    np.testing.assert_allclose(
        np.abs(functions), np.abs(smooth.polynomial_basis(time, 5)), rtol=0, atol=1e-6
    )


@pytest.mark.parametrize("order", [0, -1, 6])
def test_bad_order(order: int) -> None:
    """An order of zero, or above the number of frames, raises an error."""
    with pytest.raises(ValueError, match=re.escape(f"Invalid order {order} of the smooth")):
        smooth.polynomial_basis(np.arange(5.0), order)


def test_leverage_is_the_hat_matrix() -> None:
    """For each order the leverage is the diagonal of the projection, and adds up to the order."""
    time = np.cumsum(np.linspace(0.1, 0.5, 25))
    result = smooth.subspace(time, 5).leverage
    for order in range(1, 6):
        design = np.vander(time - time.mean(), order)
        hat = design @ np.linalg.pinv(design)
        np.testing.assert_allclose(result[:, order - 1], np.diag(hat), rtol=0, atol=1e-9)
    np.testing.assert_allclose(result.sum(axis=0), np.arange(1.0, 6.0), rtol=0, atol=1e-12)


def segmented(frames: int, *events: int) -> np.ndarray:
    """Number of events before each frame."""
    return np.searchsorted(events, np.arange(frames), side="right")


def test_steps_and_pieces_are_in_the_subspace() -> None:
    """Steps of the camera and a polynomial in each piece are their own projection."""
    time = np.cumsum(np.random.default_rng(3).uniform(0.5, 1.5, 60))
    first = np.isin(np.arange(60), [0, 20, 23, 41])
    rising = smooth.subspace(time, 6, segment=segmented(60, 30)).rising
    functions = smooth.piecewise(time, first, rising, segment=segmented(60, 30))
    assert (functions.orders, functions.steps) == (1, 3 * smooth.PIECE_ORDER + 3)
    piece = np.cumsum(first)
    curve = piece * (3.0 + 0.1 * (time - time[35]) ** 3) + np.sin(7.0 * time) * (piece == 2)
    fit = functions.functions.T @ (curve + 2.0 * segmented(60, 30))
    np.testing.assert_allclose(
        functions.object_part @ fit, curve, rtol=0, atol=1e-8 * np.ptp(curve)
    )
    identity = functions.functions.T @ functions.functions
    np.testing.assert_allclose(identity, np.eye(functions.steps + 1), rtol=0, atol=1e-12)


@pytest.mark.parametrize("events", [(30,), (5, 8), (5, 50), (23, 30, 58)])
def test_columns_of_pieces_have_the_length_of_these(events: tuple[int, ...]) -> None:
    """With steps of the camera in one piece or several they are zero outside of their spans."""
    time = np.cumsum(np.random.default_rng(3).uniform(0.5, 1.5, 60))
    first, segment = np.isin(np.arange(60), [0, 20, 41]), segmented(60, *events)
    functions = smooth.piecewise(time, first, time[:, np.newaxis], segment=segment)
    for columns in (functions.functions, functions.object_part):
        for column, (start, stop) in zip(columns.T, functions.spans, strict=True):
            assert np.count_nonzero(column) == np.count_nonzero(column[start:stop])
    # The projection of a dense basis, and what of it is the object's.
    plain = [time**power * (np.cumsum(first) == piece) for power in range(5) for piece in (1, 2, 3)]
    dense = np.stack([*plain, *smooth.camera_steps(segment)], axis=1)
    signal = np.random.default_rng(4).standard_normal(60)
    fit = np.linalg.lstsq(dense, signal, rcond=None)[0]
    own = functions.object_part @ (functions.functions.T @ signal)
    expected = dense[:, : len(plain)] @ fit[: len(plain)]
    np.testing.assert_allclose(own, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("events", [(), (30,)])
def test_leverage_of_chosen_pieces(events: tuple[int, ...]) -> None:
    """A change point adds as much leverage as three functions do, one piece alone has its own."""
    time = np.arange(60.0)
    segment = segmented(60, *events) if events else None
    rising = smooth.subspace(time, 6, segment=segment).rising
    whole, divided = (
        smooth.piecewise(time, np.isin(np.arange(60), first), rising, segment=segment)
        for first in ([0], [0, 20, 41])
    )
    own = [(functions.object_part**2).sum(axis=1) for functions in (whole, divided)]
    np.testing.assert_allclose(whole.leverage[:, 0], own[0], rtol=1e-12, atol=0)
    added = divided.leverage[:, 0] - own[1]
    parts = [added[:20].sum(), added[20:41].sum(), added[41:].sum()]
    if not events:
        np.testing.assert_allclose(parts, [1.5, 3.0, 1.5], rtol=1e-9, atol=0)
    # In each piece it is a share of what the piece has.
    shares = np.repeat([0.3, 0.6, 0.3], [20, 21, 19])
    np.testing.assert_allclose(added, shares * own[1], rtol=1e-9, atol=0)


@given(
    st.floats(-50, 50),
    st.lists(st.integers(5, 55), min_size=1, max_size=3, unique=True).map(sorted),
)
def test_own_part_is_without_the_steps_of_the_camera(height: float, events: list[int]) -> None:
    """The object's part of a curve with steps of the camera is the curve alone."""
    time = np.arange(60.0)
    curve = 0.01 * (time - 20.0) ** 2
    signal = curve + height * segmented(60, *events)
    functions = smooth.subspace(time, 4, segment=segmented(60, *events))
    own = functions.object_part @ (functions.functions.T @ signal)
    np.testing.assert_allclose(own, curve, rtol=0, atol=1e-9)


def test_without_steps_the_subspace_is_the_basis() -> None:
    """No event: the polynomials, all of them the object's own."""
    time = np.arange(30.0)
    for segment in (None, np.zeros(30, int), np.full(30, 7)):
        found = smooth.subspace(time, 5, segment=segment)
        np.testing.assert_array_equal(found.functions, smooth.polynomial_basis(time, 5))
        np.testing.assert_array_equal(found.object_part, found.functions)
        assert found.steps == 0


def test_more_steps_than_frames() -> None:
    """More functions than frames raise an error with both numbers."""
    with pytest.raises(ValueError, match="Invalid order 6 with 19 steps over 20 frames"):
        smooth.subspace(np.arange(20.0), 6, segment=np.arange(20))


@pytest.mark.parametrize("pause", [3.6e3, 1e9])
def test_recordings_far_apart_have_each_their_curve(pause: float) -> None:
    """Across a pause of an hour or of 30 years the functions hold a curve of each recording."""
    since = np.arange(100) / 10.0
    time = np.concatenate([since, pause + since])
    functions = smooth.polynomial_basis(time, 14)
    np.testing.assert_allclose(functions.T @ functions, np.eye(14), rtol=0, atol=1e-10)
    curve = np.concatenate([np.exp(-since / 5.0), 2.0 - (since / 10.0) ** 3])
    fitted = functions @ (functions.T @ curve)
    np.testing.assert_allclose(fitted, curve, rtol=0, atol=1e-4)


@pytest.mark.parametrize("events", [(), (30,)])
def test_pieces_are_the_polynomials_of_their_frames(events: tuple[int, ...]) -> None:
    """Each piece has the basis of its own times, up to signs: five, or as many as it has frames."""
    time = np.cumsum(np.random.default_rng(8).uniform(0.5, 1.5, 60))
    edges = [0, 20, 23, 41, 60]
    first, segment = np.isin(np.arange(60), edges), segmented(60, *events) if events else None
    rising = smooth.subspace(time, 6, segment=segment).rising
    functions = smooth.piecewise(time, first, rising, segment=segment)
    spans = itertools.pairwise(edges)
    parts = [smooth.polynomial_basis(time[a:b], min(5, b - a)) for a, b in spans]
    whole = block_diag(*parts)
    if not events:
        np.testing.assert_allclose(np.abs(functions.functions), np.abs(whole), rtol=0, atol=1e-12)
    left = whole - functions.functions @ (functions.functions.T @ whole)
    np.testing.assert_allclose(left, 0.0, rtol=0, atol=1e-12)
