"""Objects that jump: the jump is found, modelled and flagged, without false alarms."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from dbthermal import schema, separation, simulation
from dbthermal.separation._subspace import residuals
from dbthermal.simulation import Rig
from reproduction import experiments

RIG = Rig()
TIME = np.arange(350) / 10.0
GLASS: dict[str, Any] = {"emissivity": [0.86, 0.72], "start": 20, "stop": 50}
SUDDEN = {"height": 6.0}
SLOW = {"height": 6.0, "duration": 1.0}
JUMP = schema.Status.OBJECT_JUMP


def errors(scene: xr.Dataset, result: xr.Dataset) -> np.ndarray:
    """Error of the object temperature (time, pixel) [K]."""
    return (result["object_temperature"] - scene["object_temperature"]).values[:, 0]


def rms(error: np.ndarray) -> np.ndarray:
    """Root mean square of each pixel over the frames that it has [K]; infinite for none."""
    number = np.isfinite(error).sum(axis=0)
    total = np.nansum(error**2, axis=0)
    mean = np.divide(total, number, out=np.full(number.shape, np.inf), where=number > 0)
    return np.asarray(np.sqrt(mean))


@pytest.mark.parametrize("jump", [SUDDEN, SLOW], ids=["sudden", "over 1 s"])
def test_jump_is_found_and_modelled(jump: dict[str, Any]) -> None:
    """Nine pixels in ten are as good before and after as nine in ten without a jump, within half
    and two thirds; they are flagged, and have no value at the jump.
    """
    clean, plain = experiments.run_case(GLASS, RIG, TIME, 400, seed=1)
    scene, result = experiments.run_case({**GLASS, "jump": jump}, RIG, TIME, 400, seed=1)
    step = (scene["object_temperature"] - clean["object_temperature"]).values[:, 0]
    # After a jump the object is 6 K further from the background: the ratio's error counts for more.
    for name, side, limit in (("before", step < 0.01, 1.5), ("after", step > 5.99, 1.7)):
        without, found = (
            np.quantile(rms(np.where(side, part, np.nan)), 0.9, method="higher")
            for part in (errors(clean, plain), errors(scene, result))
        )
        print(f"{jump}, {name}: 90 % below {found:.3f} K, without a jump below {without:.3f} K")
        assert found < limit * without
    flagged = result["status"].values[0] & JUMP != 0
    number = np.argmax(np.abs(np.diff(step, axis=0)), axis=0) + np.array([[0], [1]])
    beside = errors(scene, result)[number, np.arange(400)]  # the frames before and after
    print(f"{jump}: {100 * flagged.mean():.1f} % flagged")
    assert flagged.mean() > 0.99
    assert np.all(result["status"] != 0)
    assert np.mean(np.isnan(beside).any(axis=0)) > 0.98
    assert np.isfinite(errors(scene, result)).mean() > 0.9


def test_intervals_hold_beside_a_jump() -> None:
    """95 % intervals of the object hold in at least 92 % of the samples of flagged pixels."""
    scene, result = experiments.run_case({**GLASS, "jump": SUDDEN}, RIG, TIME, 400, seed=2)
    within = np.abs(errors(scene, result)) < 1.96 * result["object_temperature_std"].values[:, 0]
    share = float(within[np.isfinite(errors(scene, result))].mean())
    print(f"intervals beside a jump: {share:.3f}")
    assert share >= 0.92


@pytest.mark.parametrize(
    "background",
    [{}, {"amplitude": 12.0}, {"drift": 5.0}]
    + [{"kind": "random walk", "correlation_time": time} for time in (0.3, 3.0, 30.0)],
    ids=str,
)
def test_nothing_jumps_where_nothing_jumps(background: dict[str, Any]) -> None:
    """Fewer than 1 % of clean pixels are flagged as jumping, for any background."""
    case = {**GLASS, "stop": 60, "background": background}
    _, result = experiments.run_case(case, Rig(highest=370.0), TIME, 400, seed=3)
    share = float((result["status"].values & JUMP != 0).mean())
    print(f"{background}: {100 * share:.2f} % said to jump")
    assert share < 0.01


@settings(max_examples=15, deadline=None)
@given(
    frames=st.integers(32, 120),
    rate=st.sampled_from([1.0, 10.0, 30.0, 60.0, 240.0]),
    seed=st.integers(0, 1000),
)
def test_a_jump_needs_no_least_length(frames: int, rate: float, seed: int) -> None:
    """Short and fast films whose objects jump never raise; what is good is complete."""
    time = np.arange(frames) / rate
    jump = {"height": 6.0, "between": (0.3 * time[-1], 0.7 * time[-1])}
    quick = {"duration": (time[-1] / 20, time[-1] / 10)}
    case = {**GLASS, "jump": jump, "background": quick}
    _, result = experiments.run_case(case, RIG, time, 12, seed)
    good = result["status"].values == 0
    assert np.all(np.isfinite(result["object_temperature"].values[:, good]))


def test_candidates_leave_room() -> None:
    """Candidate frames of a jump leave enough frames on both sides."""
    time = np.arange(120) / 20.0
    inside = residuals.candidates(time)
    assert inside.size > 0
    for jump in (inside[0], inside[-1]):
        kept = residuals.beside_jump(time, int(jump))
        assert min(kept[:jump].sum(), kept[jump:].sum()) == 24
        between = time[jump] - 0.5 / 20.0
        assert np.abs(time[kept] - between).min() > residuals.AROUND
    assert residuals.candidates(time[:60]).size == 0


@pytest.mark.parametrize("height", [0, 30])
def test_jump_beside_a_shutter_event(height: int) -> None:
    """A jump 0.3 s after a shutter event is flagged, and its values have calibrated uncertainty."""
    scene, capture, response = experiments.simulate(GLASS, RIG, TIME, 100, seed=5)
    step = 6.0 * (scene["time"] >= 20.3)
    moved = scene.assign(object_temperature=scene["object_temperature"] + step)
    capture = simulation.observe(moved, response, np.random.default_rng(6))
    closed = (TIME >= 20.0).astype(int)
    shifted = capture["counts"] + height * xr.DataArray(closed, dims="time")
    result = separation.solve(
        capture.assign(
            counts=shifted.transpose(*capture["counts"].dims), segment=("time", closed)
        ).assign(counts=lambda c: c["counts"].assign_attrs(capture["counts"].attrs)),
        response,
    )
    error = errors(moved, result)
    within = np.abs(error) < 1.96 * result["object_temperature_std"].values[:, 0]
    share = float(within[np.isfinite(error)].mean())
    print(f"camera's step {height} counts: intervals {share:.3f}")
    assert np.all(result["status"] != 0)
    assert share >= 0.92
    assert np.isfinite(error).mean() > 0.3
