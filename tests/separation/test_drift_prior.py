"""Prior on the background's drift: the emissivity's intervals hold on slow backgrounds."""

from typing import Any

import numpy as np
import pytest
import xarray as xr

from dbthermal import separation, simulation
from dbthermal.schema import Status
from dbthermal.simulation import Rig
from reproduction import experiments

RIG = Rig()
TIME = np.arange(350) / 10.0
GLASS: dict[str, Any] = {"emissivity": [0.86, 0.72], "start": 20, "stop": 60}


def coverage(scene: xr.Dataset, result: xr.Dataset) -> np.ndarray:
    """Share of the 95 % intervals of the emissivity that hold, in each band."""
    error = abs(result["emissivity"] - scene["emissivity"])
    within = (error < 1.96 * result["emissivity_std"]).where(error.notnull())
    return np.asarray(within.mean(("y", "x")).values)


@pytest.mark.parametrize(("stop", "noise_known"), [(60, True), (45, False)])
@pytest.mark.parametrize(
    "background",
    [{}, {"drift": 5.0}, {"amplitude": 12.0}]
    + [{"kind": "random walk", "correlation_time": time} for time in (0.3, 3.0, 30.0)],
    ids=str,
)
def test_no_background_raises_a_false_alarm(
    background: dict[str, Any], stop: int, noise_known: bool
) -> None:
    """92 % of the emissivity's 95 % intervals hold, whatever the background does; fewer than one
    pixel in 200 of synchronous bands is said to be apart, and fewer than one in 100 to jump.
    """
    case = {**GLASS, "stop": stop, "background": background, "noise_known": noise_known}
    scene, result = experiments.run_case(case, Rig(highest=370.0), TIME, 1000, seed=1)
    share = coverage(scene, result)
    bits = [Status.BANDS_APART, Status.OBJECT_JUMP]
    apart, jumping = (float((result["status"].values & bit != 0).mean()) for bit in bits)
    print(f"{background} to {stop} C: intervals {share.round(3)}, {apart:.4f}, {jumping:.4f}")
    assert np.all(share >= 0.92)
    assert apart < 0.005
    assert jumping < 0.01


@pytest.mark.parametrize("stop", [45, 60])
def test_an_object_as_linear_as_the_drift_has_wide_intervals(stop: int) -> None:
    """Where the object's own curve is nearly a line as well, the intervals are wide, not wrong."""
    rng = np.random.default_rng(3)
    glass = xr.DataArray(GLASS["emissivity"], dims="band", coords={"band": list(RIG.bands)})
    background, response = simulation.Background(drift=8.0), RIG.response()
    ends: dict[str, Any] = {"start": 293.15, "stop": stop + 273.15, "time_constant": (25.0, 80.0)}
    parts = (TIME, glass, background, 300, rng)
    scene = simulation.independent_pixels(*parts, **ends)
    share = coverage(scene, separation.solve(simulation.observe(scene, response, rng), response))
    print(f"to {stop} C, nearly linearly: intervals {share.round(3)}")
    assert np.all(share >= 0.92)


@pytest.mark.parametrize("stop", [45, 60])
def test_clean_intervals_are_not_too_wide(stop: int) -> None:
    """Without a slow background the intervals are at most three times too wide."""
    scene, result = experiments.run_case({**GLASS, "stop": stop}, RIG, TIME, 1000, seed=2)
    error = (result["emissivity"] - scene["emissivity"]).values[:, 0]
    spread = np.diff(np.nanquantile(error, [0.1587, 0.8413], axis=1), axis=0)[0] / 2
    width = np.nanmedian(result["emissivity_std"].values[:, 0], axis=1) / spread
    print(f"to {stop} C: stated over true {width.round(2)}")
    assert np.all(width <= 3.0)
    assert np.all(width >= 0.8)


def test_prior_widens_emissivity_and_background_alone() -> None:
    """A larger drift widens the emissivity's and background's deviations alone."""
    _, capture, response = experiments.simulate(GLASS, RIG, TIME, 100, seed=3)
    none, some, much = [
        separation.solve(capture, response, settings=separation.SubspaceSettings(drift))
        for drift in (0.0, 2.0, 20.0)
    ]
    for name in ("object_temperature", "background_temperature", "emissivity"):
        np.testing.assert_array_equal(none[name].values, much[name].values)
    xr.testing.assert_identical(none["object_temperature_std"], much["object_temperature_std"])
    for name in ("emissivity_std", "background_temperature_std"):
        assert bool((none[name] <= some[name]).all())
        assert float((some[name] < much[name]).mean()) > 0.99


def test_drift_is_that_of_the_closed_form() -> None:
    """Over an object that warms by w a drift of up to d costs (1 - e) d / (w sqrt(3))."""
    _, capture, response = experiments.simulate(GLASS, RIG, TIME, 50, seed=4)
    none, much = (
        separation.solve(capture, response, settings=separation.SubspaceSettings(drift))
        for drift in (0.0, 20.0)
    )
    variances = [result["emissivity_std"].values[0, 0] ** 2 for result in (none, much)]
    added = np.sqrt(variances[1] - variances[0])
    warming = np.ptp(none["object_temperature"].values[:, 0], axis=0)
    expected = (1.0 - none["emissivity"].values[0, 0]) * 20.0 / np.sqrt(3.0) / warming
    print(f"added {np.median(added):.4f}, expected {np.median(expected):.4f}")
    np.testing.assert_allclose(added, expected, rtol=0.15)  # the response bends over 40 K


@pytest.mark.parametrize("drift", [-1.0, np.nan, np.inf])
def test_bad_drift_is_a_clear_error(drift: float) -> None:
    """A prior is zero or a positive number of kelvins."""
    _, capture, response = experiments.simulate(GLASS, RIG, TIME, 2, seed=6)
    with pytest.raises(ValueError, match=f"Invalid background_drift {drift} K"):
        separation.solve(capture, response, settings=separation.SubspaceSettings(drift))
