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

STEPS = st.lists(st.floats(0.01, 10.0), min_size=12, max_size=40).map(np.cumsum)
TIMES = st.builds(
    lambda t, unit, start: start + unit * t, STEPS, st.floats(0.1, 10), st.floats(-1e3, 1e3)
)
ORDERS = st.integers(1, 6)


@given(TIMES, ORDERS, st.integers(0, 1000))
def test_basis_is_that_of_the_polynomials(time: Array, order: int, seed: int) -> None:
    """Orthonormal, at any times in any unit, and a polynomial of a degree below is its own fit."""
    functions = smooth.polynomial_basis(time, order)
    np.testing.assert_allclose(functions.T @ functions, np.eye(order), rtol=0, atol=1e-12)
    coefficients = np.random.default_rng(seed).standard_normal(order)
    signal = np.polynomial.Polynomial(coefficients, domain=[time[0], time[-1]])(time)
    np.testing.assert_allclose(functions @ (functions.T @ signal), signal, rtol=0, atol=1e-9)


@pytest.mark.parametrize("order", [0, -1, 6])
def test_bad_order(order: int) -> None:
    """An order of zero, or more functions than frames, raises an error with the numbers."""
    with pytest.raises(ValueError, match=re.escape(f"Invalid order {order} of the smooth")):
        smooth.polynomial_basis(np.arange(5.0), order)
    with pytest.raises(ValueError, match="Invalid order 6 with 19 steps over 20 frames"):
        smooth.subspace(np.arange(20.0), 6, segment=np.arange(20))


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


EVENTS = st.lists(st.integers(5, 55), max_size=3, unique=True).map(sorted)


@given(st.floats(-50, 50), EVENTS)
def test_own_part_is_without_the_steps_of_the_camera(height: float, events: list[int]) -> None:
    """The object's part of a curve with steps of the camera is the curve alone."""
    time = np.arange(60.0)
    curve = 0.01 * (time - 20.0) ** 2
    functions = smooth.subspace(time, 4, segment=segmented(60, *events))
    own = functions.object_part @ (
        functions.functions.T @ (curve + height * segmented(60, *events))
    )
    np.testing.assert_allclose(own, curve, rtol=0, atol=1e-9)
    assert functions.steps == len(events)


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
