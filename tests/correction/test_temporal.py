"""Drift in time and lag of the detector: each simulated with a known truth, and undone."""

from functools import partial
from typing import Any

import numpy as np
import pytest
import xarray as xr
from captures import RIG, drift, movie, still
from hypothesis import given, settings
from hypothesis import strategies as st

from dbthermal import schema, simulation
from dbthermal.correction import mark_shutter, undo_drift, undo_lag

ORDERS: tuple[Any, ...] = (np.inf, 61, 2.5, "3", True, 1)
CONSTANTS: tuple[Any, ...] = (0.0, "0.01", b"3", True, np.timedelta64(10, "ms"), [0.01], 10.0)


def patch() -> xr.DataArray:
    """The upper left ten by ten pixels."""
    return xr.DataArray(np.indices((20, 24)).max(axis=0) < 10, dims=("y", "x"))


def test_common_drift_is_undone() -> None:
    """A bend of 60 counts goes, to 0.4 of a count: 0.1 of noise over the patch's 100 pixels."""
    capture = still(count=350)
    curve = 60.0 * (1.0 - np.exp(-np.arange(350) / 150.0))
    drifting = capture.assign(counts=capture["counts"] + xr.DataArray(curve, dims="time"))
    before = drifting.astype(np.float32).copy(deep=True)
    drifting = before.copy(deep=True)
    undone = undo_drift(drifting, patch())
    xr.testing.assert_identical(drifting, before)
    error = (undone["counts"] - capture["counts"]).values
    print(f"largest error of the drift {np.abs(error).max():.2f} count of 60")
    assert np.abs(error).max() < 0.4
    np.testing.assert_allclose(undone["drift"] - curve, 0.0, rtol=0, atol=0.4)
    assert undone["counts"].dims == capture["counts"].dims
    assert undone.attrs["drift_order"] == 5
    assert undone.attrs["drift_pixels"] == 100


def test_drift_leaves_the_steps() -> None:
    """Each segment is undone by itself; frames taken out stay out, and steps stay in."""
    drifting = drift(still(count=300), 50.0)
    stepped = simulation.fire_shutter(drifting, 15.0, np.random.default_rng(1))
    marked = mark_shutter(stepped)
    undone = undo_drift(marked, patch(), order=2)
    gone = np.isnan(undone["drift"])
    np.testing.assert_array_equal(gone, marked["counts"].isnull().any(("y", "x")))
    before, after = (undone["counts"].where(undone["segment"] == n).mean("time") for n in (0, 1))
    shift = (stepped["counts"] - drifting["counts"]).isel(time=-1)
    assert float(shift.std()) == pytest.approx(40.0, rel=0.1)  # count
    # Of the drift the second segment keeps what it had at its first frame.
    np.testing.assert_allclose(after - before - shift, 50.0 * 156 / 299, rtol=0, atol=2.5)


HOLED = still()
HOLED["counts"][1, 7, 2, 3] = np.nan
NO_PATCH: Any = {}
NAMED = xr.DataArray([10.0, 12.0], {"band": ["8-14", "9.5"]}, "band")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (partial(undo_drift, still(), patch(), order=order), "Invalid order of the drift")
        for order in ORDERS
    ]
    + [
        (partial(undo_lag, still(), constant), r"Invalid time_constant \[s\]")
        for constant in CONSTANTS
    ]
    + [
        (lambda: undo_drift(still(), patch() & False), "it marks no good pixel"),
        (lambda: undo_drift(still(), patch()[:, :5]), "Invalid size 5 of 'x' of the reference"),
        (lambda: undo_drift(still(), patch().astype(int)), "Invalid dtype int64 of the reference"),
        (lambda: undo_drift(still(), NO_PATCH), "Invalid reference of type dict"),
        (lambda: undo_drift(undo_drift(still(), patch()), patch()), "the drift was undone before"),
        (lambda: undo_drift(HOLED, patch()), "NaN in frame 7 of band '9.5'"),
        (lambda: undo_lag(still(), NAMED), r"\[s\] 12.0. Must be at most 1: seconds, not millisec"),
        (lambda: undo_lag(still(), NAMED[1:] / 1e3), "Missing band '8-14' in the time constants"),
        (lambda: undo_lag(still().isel(time=[0]), 0.01), "Invalid capture of 1 frame"),
        (lambda: undo_lag(still().astype(int), 0.01), "Must be floating"),
        (lambda: undo_lag(undo_lag(still(), 0.01), 0.01), "the lag was undone before"),
    ],
)
def test_what_is_not_undone(call: Any, message: str) -> None:
    """Patches, orders, time constants, captures that do not fit, a second time are named."""
    with pytest.raises((TypeError, ValueError), match=message):
        call()


def test_a_bad_pixel_of_the_reference_is_left_out() -> None:
    """A pixel with a status, whose counts may be NaN, is not of the patch."""
    status = xr.zeros_like(patch(), dtype=np.uint16)
    status[2, 3] = schema.Status.INVALID_SAMPLES
    assert undo_drift(HOLED.assign(status=status), patch()).attrs["drift_pixels"] == 99


SECONDS = st.floats(0.001, 0.03)


@settings(max_examples=50)
@given(
    st.lists(st.floats(0.002, 0.2), min_size=1, max_size=20),
    st.tuples(SECONDS, SECONDS),
    st.integers(0, 1000),
)
def test_lag_round_trip(steps: list[float], constants: tuple[float, float], seed: int) -> None:
    """A simulated lag is undone, for any spacing of the frames and a time constant of each band."""
    time = np.concatenate([[0.0], np.cumsum(steps)])
    scene = movie(np.random.default_rng(seed).uniform(15000.0, 20000.0, time.size), time)
    # By name and not by place.
    constant = xr.DataArray(list(constants[::-1]), {"band": list(RIG.bands[::-1])}, "band")
    undone = undo_lag(simulation.lag(scene, constant), constant)
    off = (undone["counts"] - scene["counts"])[:, 1:]
    np.testing.assert_allclose(off, 0.0, rtol=0, atol=1e-5)  # [count]
    assert np.isnan(undone["counts"][:, 0]).all()
    assert undone.attrs["lag_time_constant"] == list(constants)


def test_undoing_the_lag_raises_the_noise() -> None:
    """Undoing the lag raises the noise by the stated factor, and correlates successive frames."""
    rng, time = np.random.default_rng(0), np.arange(40000) / 60.0
    undone = undo_lag(movie(rng.standard_normal(time.size), time), 0.010)
    signal = undone["counts"].values[0, 1:, 0, 0]
    kept = np.exp(-1.0 / 0.6)
    factor, correlation = signal.std(), np.corrcoef(signal[1:], signal[:-1])[0, 1]
    print(f"noise times {factor:.3f}, correlation {correlation:.3f}")
    assert factor == pytest.approx(np.sqrt(1 + kept**2) / (1 - kept), rel=0.02)
    assert correlation == pytest.approx(-kept / (1 + kept**2), abs=0.02)
    np.testing.assert_allclose(undone.attrs["lag_noise_amplification"], factor, rtol=0.02)
    movies = [movie(signal[:9], np.arange(9) / rate) for rate in (10.0, 60.0, 100.0)]
    factors = [undo_lag(one, 0.010).attrs["lag_noise_amplification"][0] for one in movies]
    np.testing.assert_allclose(factors, [1.0, 1.255, 1.686], rtol=0, atol=0.001)


def test_lag_of_marked_frames() -> None:
    """The frame after a missing one is lost, too; at 10 Hz the others hardly change."""
    capture = still()
    capture["counts"].values[0, 30] = np.nan
    before = capture.copy(deep=True)
    undone = undo_lag(capture, 0.010)["counts"]
    xr.testing.assert_identical(capture, before)
    gone = [np.flatnonzero(np.isnan(part).all(("y", "x"))).tolist() for part in undone]
    assert gone == [[0, 30, 31], [0]]
    assert float(abs(undone - capture["counts"]).max()) < 0.01  # count
    assert undone.dtype == np.float32
