"""Objects that jump: the jump is found, modelled and flagged, without false alarms."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import held

from dbthermal import schema, separation, simulation
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


def test_jump_is_found_and_modelled() -> None:
    """Nine pixels in ten are as good before and after as nine in ten without a jump, within half
    and two thirds; they are flagged as jumping, and 95 % intervals hold at the jump itself.
    """
    clean, plain = experiments.run_case(GLASS, RIG, TIME, 400, seed=1)
    scene, result = experiments.run_case({**GLASS, "jump": SUDDEN}, RIG, TIME, 400, seed=1)
    step = (scene["object_temperature"] - clean["object_temperature"]).values[:, 0]
    number = np.argmax(np.abs(np.diff(step, axis=0)), axis=0) + np.array([[0], [1]])
    far = np.abs(TIME[:, np.newaxis] - TIME[number[1]]) > 1.0
    # After a jump the object is 6 K further from the background: the ratio's error counts for more.
    for name, side, limit in (("before", step < 0.01, 1.5), ("after", step > 5.99, 1.7)):
        without, found = (
            np.quantile(rms(np.where(side & far, part, np.nan)), 0.9, method="higher")
            for part in (errors(clean, plain), errors(scene, result))
        )
        print(f"{name}: 90 % below {found:.3f} K, without a jump below {without:.3f} K")
        assert found < limit * without
    flagged = result["status"].values[0] & JUMP != 0
    score = np.abs(errors(scene, result)) / result["object_temperature_std"].values[:, 0]
    beside = score[number, np.arange(400)]  # the frames before and after
    print(f"{flagged.mean():.3f} flagged; intervals at the jump {np.mean(beside < 1.96):.3f}")
    assert flagged.mean() > 0.98
    assert np.mean(beside < 1.96) > 0.92
    assert np.isfinite(errors(scene, result)).mean() > 0.98


def test_what_takes_a_second_is_no_jump() -> None:
    """An object that changes by 6 K in 1 s has true intervals, mostly without a flag."""
    scene, result = experiments.run_case({**GLASS, "jump": SLOW}, RIG, TIME, 400, seed=1)
    good = result["status"] == 0
    assert float(good.mean()) > 0.95
    assert 0.92 <= held(result, scene, where=good) <= 0.98


@settings(max_examples=15)
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


@pytest.mark.parametrize("height", [0, 30])
def test_jump_beside_a_shutter_event(height: int) -> None:
    """A jump 0.3 s after a shutter event is flagged, and its values have calibrated uncertainty."""
    scene, capture, response = experiments.simulate(GLASS, RIG, TIME, 100, seed=5)
    step = 6.0 * (scene["time"] >= 20.3)
    moved = scene.assign(object_temperature=scene["object_temperature"] + step)
    capture = simulation.observe(moved, response, np.random.default_rng(6))
    closed = (TIME >= 20.0).astype(int)
    shifted = capture["counts"] + height * xr.DataArray(closed, dims="time")
    counts = capture["counts"].copy(data=shifted.transpose(*capture["counts"].dims))
    result = separation.solve(capture.assign(counts=counts, segment=("time", closed)), response)
    jumping = result["status"].values[0] & JUMP != 0
    print(f"camera's step {height} counts: {jumping.mean():.3f} flagged")
    assert jumping.mean() > 0.9
    assert held(result, moved) >= 0.92
    assert np.isfinite(errors(moved, result)).mean() > 0.3
