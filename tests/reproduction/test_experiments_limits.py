"""Experiments on limits and nuisances: known numbers; notebooks 10 and 11 assert what they find."""

from typing import Any

import numpy as np
import pytest
import xarray as xr

from dbthermal import simulation
from dbthermal._smooth import polynomial_basis
from dbthermal.simulation import Rig
from reproduction.closed_form import ratio_variance_bound
from reproduction.experiments import cases, limits, nuisances

GLASS, PAIR = [0.86, 0.72], ["8-14", "9.5"]
COMMON = {"ends": [20.0, 45.0], "clock": [350, 10.0]}
VIEWS: dict[str, Any] = {"shape": [24, 32], "clock": [50, 10.0], "seed": 1}


def test_summary_of_known_errors() -> None:
    """Errors 1.2 times their bound are so in the summary, over the pixels with a value."""
    draws = np.random.default_rng(1).standard_normal(1000)
    known = xr.DataArray(np.arange(1000) % 10 > 0, dims="pixel")
    bound = (("knowing", "pixel"), np.full((1, 1000), 0.1))
    parts = {
        "reflection_ratio_error": ("pixel", 0.12 * draws),
        "object_temperature_error": ("pixel", np.full(1000, 0.12)),
        "reflection_ratio_bound": bound,
        "object_temperature_bound": bound,
    }
    masked = xr.Dataset(parts, {"knowing": ["rest"]}).where(known)
    measured = masked.assign(status=("pixel", np.where(known, 0, 4)))
    summary = limits.summary(measured).isel(knowing=0)
    assert float(summary["scatter"]) == pytest.approx(1.2, rel=0.05)
    assert float(summary["excess"]) == pytest.approx(1.2, rel=1e-12)
    assert float(summary["solved"]) == pytest.approx(0.9, abs=1e-12)
    assert float(summary["flagged"]) == pytest.approx(0.1, abs=1e-12)


def test_slope_is_the_closed_form() -> None:
    """The bound that knows the slopes is `ratio_variance_bound` at the noise in kelvin."""
    noise, size = (0.03, 0.35), 30
    measured = limits.near_bound(GLASS, noise, bands=PAIR, pixels=size, seed=4, **COMMON)
    case = {"emissivity": GLASS, "start": 20.0, "stop": 45.0}
    time = np.arange(350) / 10.0
    truth, _, _ = cases.simulate(case, Rig(noise=noise), time, size, 4)
    cold = truth["background_temperature"].values[:, 0]
    smooth = [polynomial_basis(time, order) for order in range(3, 13)]
    orders = [np.sqrt(ratio_variance_bound((0.86, 0.72), noise, cold, f)) for f in smooth]
    apart = np.abs(np.array(orders) / measured["reflection_ratio_bound"].values[1] - 1)
    np.testing.assert_allclose(apart.min(axis=0), 0, rtol=0, atol=1e-6)


def test_truth_on_another_clock() -> None:
    """Truth is interpolated between its times, and NaN past its end."""
    ramp = xr.Dataset({"x": ("time", [0.0, 1.0, 2.0])}, {"time": [0.0, 0.1, 0.2]})
    wanted = xr.DataArray([0.05, 0.25], dims="time")
    np.testing.assert_allclose(limits.on_clock(ramp, wanted)["x"], [0.5, np.nan], atol=1e-12)


@pytest.mark.parametrize(
    ("moved", "right", "bleeding"), [(0, 1.0, 0), (2, 1.0, 0), (5, 1 - 3 / 36, 1), (None, 0.0, 0)]
)
def test_border_is_judged_beyond_two_pixels(moved: int | None, right: float, bleeding: int) -> None:
    """A border two pixels off is kept; five off, three columns of 36 bleed; without labels 0."""
    columns = xr.DataArray(np.indices((10, 40))[1], dims=("y", "x"))
    labels = columns * 0 - 1 if moved is None else (columns >= 20 + moved).astype(int)
    kept = limits.border_kept(labels, (columns >= 20).astype(int))
    assert float(kept["right"]) == pytest.approx(right, abs=1e-12)
    assert int(kept["bleeding"]) == bleeding


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: limits.pooled([3], GLASS, pixels=400, seed=1, **COMMON),
            "Invalid size 3 of a group. Must divide the 400 pixels",
        ),
        (
            lambda: limits.border_kept(*[xr.DataArray([[0, 0]], dims=("y", "x"))] * 2),
            "1 panels. Must be alike, of two panels or more",
        ),
        (
            lambda: nuisances.apart(-1, pixels={}, seed=1),
            "Invalid delay -1 frames. Must be zero or positive",
        ),
        (
            lambda: nuisances.disturbed("rain", pixels={}, nuisance={}, seed=1),
            "Unknown nuisance 'rain'. Must be one of",
        ),
        (
            lambda: nuisances.parallax(0.1, shift=[0.0, 0.0], **VIEWS),
            "Must be multiples of 1/4 along x",
        ),
        (lambda: nuisances.parallax(1.0, shift=[12.0, 0.0], **VIEWS), "within 12 together"),
    ],
)
def test_experiments_that_cannot_be_made(call: object, message: str) -> None:
    """Groups that are not whole, panels, delays, nuisances and views are refused by their rule."""
    with pytest.raises(ValueError, match=message):
        call()  # type: ignore[operator]


def test_cost_of_the_truth() -> None:
    """A constant error of 0.1 K costs as much; flagged pixels do not count in the coverage."""
    emissivity = xr.DataArray(GLASS, dims="band", coords={"band": PAIR})
    rng, times, still = np.random.default_rng(0), np.arange(20) / 10.0, simulation.Background()
    truth = simulation.independent_pixels(times, emissivity, still, 8, rng, start=300.0, stop=320.0)
    result = truth.assign(
        object_temperature=truth["object_temperature"] + 0.1,
        object_temperature_std=xr.full_like(truth["object_temperature"], 0.06),
        status=(("y", "x"), np.array([[0] * 6 + [4] * 2])),
    )
    cost = nuisances.cost(truth, result)
    assert float(cost["object_temperature_rmse"]) == pytest.approx(0.1, abs=1e-9)  # [K]
    assert float(cost["flagged"]) == pytest.approx(0.25)
    assert float(cost["covered"]) == 1.0
