"""Experiments on limits and nuisances: known numbers, and one run of each."""

import numpy as np
import pytest
import xarray as xr

from dbthermal import limits as bounds
from dbthermal import simulation
from dbthermal.simulation import Rig
from reproduction.experiments import cases, limits, nuisances

CLOCK = [350, 10.0]
GLASS = [0.86, 0.72]
COMMON = {"ends": [20.0, 45.0], "clock": CLOCK}
PAIR = ["8-14", "9.5"]


def measured(error: float, bound: float) -> xr.Dataset:
    """Errors of 1000 pixels, normal for the ratio, beside one bound; every tenth has no value."""
    draws = np.random.default_rng(1).standard_normal(1000)
    known = xr.DataArray(np.arange(1000) % 10 > 0, dims="pixel")
    parts = {
        "reflection_ratio_error": ("pixel", error * draws),
        "object_temperature_error": ("pixel", np.full(1000, error)),
        "reflection_ratio_bound": (("knowing", "pixel"), np.full((1, 1000), bound)),
        "object_temperature_bound": (("knowing", "pixel"), np.full((1, 1000), bound)),
    }
    masked = xr.Dataset(parts, {"knowing": ["rest"]}).where(known)
    return masked.assign(status=("pixel", np.where(known, 0, 4)))


def test_summary_of_known_errors() -> None:
    """Errors 1.2 times their bound are so in the summary, over the pixels with a value."""
    found = limits.summary(measured(0.12, 0.1)).isel(knowing=0)
    assert float(found["scatter"]) == pytest.approx(1.2, rel=0.05)
    assert float(found["excess"]) == pytest.approx(1.2, rel=1e-12)
    assert float(found["solved"]) == pytest.approx(0.9, abs=1e-12)
    assert float(found["flagged"]) == pytest.approx(0.1, abs=1e-12)


@pytest.mark.slow
def test_ratio_is_at_the_bound() -> None:
    """Glass, noise and subspace unknown: the ratio scatters by its closed form's bound."""
    found = limits.near_bound(GLASS, [0.03, 0.35], bands=PAIR, pixels=600, seed=3, **COMMON)
    summary = limits.summary(found)
    scatter, excess = (summary[name].values for name in ("scatter", "excess"))
    print(f"knowing {limits.KNOWING}: ratio {scatter.round(3)}, object {excess.round(3)}")
    assert scatter[1] == pytest.approx(1.0, abs=0.1)
    assert excess[0] <= 1.15
    assert np.isnan(excess[1])
    assert np.all(found["object_temperature_bound"][2] <= found["object_temperature_bound"][0])


def test_slope_is_the_closed_form() -> None:
    """The bound that knows the slopes is `ratio_variance_bound` at the noise in kelvin."""
    noise, size = (0.03, 0.35), 30
    found = limits.near_bound(GLASS, noise, bands=PAIR, pixels=size, seed=4, **COMMON)
    case = {"emissivity": GLASS, "start": 20.0, "stop": 45.0}
    time = np.arange(350) / 10.0
    truth, _, _ = cases.simulate(case, Rig(noise=noise), time, size, 4)
    cold = truth["background_temperature"].values[:, 0]
    orders = [
        np.sqrt(
            bounds.ratio_variance_bound(
                (0.86, 0.72), noise, cold, bounds.polynomial_basis(time, order)
            )
        )
        for order in range(3, 13)
    ]
    apart = np.abs(np.array(orders) / found["reflection_ratio_bound"].values[1] - 1).min(axis=0)
    np.testing.assert_allclose(apart, 0, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_pooling_falls_as_the_root() -> None:
    """The bound falls as 1/sqrt(n), and the error follows it."""
    found = limits.pooled([1, 16], GLASS, pixels=800, seed=7, **COMMON)
    errors, limit = (found[f"reflection_ratio_{kind}"].values for kind in ("error", "bound"))
    print(f"1 and 16 pixels: errors {np.round(errors, 4)}, bounds {np.round(limit, 4)}")
    assert limit[0] / limit[1] == pytest.approx(4.0, rel=1e-6)
    assert errors[0] / errors[1] > 3.0


def test_groups_are_whole() -> None:
    """A number of pixels that is not a multiple of the group raises a ValueError."""
    with pytest.raises(ValueError, match=r"Invalid size 3 of a group. Must divide the 400 pixels"):
        limits.pooled([3], GLASS, pixels=400, seed=1, **COMMON)


def test_truth_on_another_clock() -> None:
    """Truth is interpolated between its times, and NaN past its end."""
    ramp = xr.Dataset({"x": ("time", [0.0, 1.0, 2.0])}, {"time": [0.0, 0.1, 0.2]})
    wanted = xr.DataArray([0.05, 0.25], dims="time")
    np.testing.assert_allclose(limits.on_clock(ramp, wanted)["x"], [0.5, np.nan], atol=1e-12)


@pytest.mark.parametrize(
    ("moved", "right", "bleeding"), [(0, 1.0, 0), (2, 1.0, 0), (5, 1 - 3 / 36, 1)]
)
def test_border_is_judged_beyond_two_pixels(moved: int, right: float, bleeding: int) -> None:
    """A border moved by two pixels is kept, and one moved by five bleeds three columns of 36."""
    sides = xr.DataArray(np.indices((10, 40))[1] >= 20, dims=("y", "x")).astype(int)
    labels = xr.DataArray(np.indices((10, 40))[1] >= 20 + moved, dims=("y", "x")).astype(int)
    found = limits.border_kept(labels, sides)
    assert float(found["right"]) == pytest.approx(right, abs=1e-12)
    assert int(found["bleeding"]) == bleeding


def test_labels_of_nothing() -> None:
    """Labels without a material score 0; one panel raises a ValueError."""
    sides = xr.DataArray([[0] * 5 + [1] * 5], dims=("y", "x"))
    assert float(limits.border_kept(sides * 0 - 1, sides)["right"]) == 0.0
    with pytest.raises(ValueError, match=r"1 panels. Must be alike, of two panels or more"):
        limits.border_kept(sides, sides * 0)


@pytest.mark.slow
def test_alignment_makes_the_bars_true() -> None:
    """Two frames apart nearly all pixels are flagged; aligned, few are, and intervals hold."""
    case = {"emissivity": GLASS, "start": 20.0, "stop": 45.0, "offset": 2.0}
    late, aligned = (
        limits.stressed(case, clock=CLOCK, pixels=200, seed=7, aligned=aligned)
        for aligned in (False, True)
    )
    covered = float(aligned["object_coverage"].sel(among="unflagged"))
    print(f"flagged {float(late['flagged']):.3f} -> {float(aligned['flagged']):.3f}, {covered:.3f}")
    assert float(late["flagged"]) > 0.9
    assert float(aligned["flagged"]) < 0.1
    assert 0.92 <= covered <= 0.98
    assert (int(late["frames_lost"]), int(aligned["frames_lost"])) == (0, 2)


@pytest.mark.slow
def test_offset_is_undone() -> None:
    """An offset of 1.5 frames is estimated to 0.1 frame, and undone to 20 % of the error."""
    found = nuisances.apart(1.5, pixels={"pixels": 1000}, seed=3)
    rmse = found["object_temperature_rmse"].values
    print(f"found {float(found['found']):.3f} frames; {nuisances.TREATMENTS}: {rmse.round(3)} K")
    assert abs(float(found["found"]) - 1.5) < 0.1
    assert rmse[0] > 2 * rmse[2]
    assert rmse[1] <= 1.2 * rmse[2]


def test_what_is_late_was_not_early() -> None:
    """A negative delay raises a ValueError."""
    with pytest.raises(ValueError, match=r"Invalid delay -1 frames. Must be zero or positive"):
        nuisances.apart(-1, pixels={}, seed=1)


@pytest.mark.parametrize(
    "name",
    ["lost frames", *(pytest.param(n, marks=pytest.mark.slow) for n in nuisances.NUISANCES[1:])],
)
def test_nuisances_are_undone(name: str) -> None:
    """A marked nuisance costs at most a quarter; an unmarked shutter event flags the pixels."""
    nuisance = {"share": 0.05, "shutter": [0.4]}
    found = nuisances.disturbed(name, pixels={"pixels": 800}, nuisance=nuisance, seed=3)
    rmse, flagged = found["object_temperature_rmse"].values, found["flagged"].values
    print(f"{name}: {rmse.round(3)} K, flagged {flagged.round(3)}")
    assert rmse[1] <= 1.25 * rmse[2]
    assert flagged[1] < 0.05
    if "shutter" in name:
        assert rmse[0] > 5 * rmse[2]
        assert flagged[0] > 0.9


def test_unknown_nuisance() -> None:
    """An unknown nuisance raises a ValueError with its name."""
    with pytest.raises(ValueError, match=r"Unknown nuisance 'rain'. Must be one of"):
        nuisances.disturbed("rain", pixels={}, nuisance={}, seed=1)


@pytest.mark.slow
def test_parallax_costs_and_is_flagged() -> None:
    """With no parallax resampling costs little; two pixels cost much, and are flagged."""
    pytest.importorskip("cv2", exc_type=ImportError)
    none, two = (
        nuisances.parallax(distance, shape=[24, 32], clock=CLOCK, shift=[3.25, -2.0], seed=3)
        for distance in (0.0, 2.0)
    )
    for one in (none, two):
        print(one["object_temperature_rmse"].values.round(3), one["flagged"].values.round(3))
    assert float(none["misregistered"]) < 0.03  # [pixel]
    rmse = none["object_temperature_rmse"].values
    assert rmse[1] < 1.5 * rmse[2]
    assert np.all(two["object_temperature_rmse"].values[:2] > 3 * rmse[2])
    assert np.all(two["flagged"].values[:2] > 0.9)


@pytest.mark.parametrize(("distance", "shift"), [(0.1, [0.0, 0.0]), (1.0, [12.0, 0.0])])
def test_views_stay_in_the_scene(distance: float, shift: list[float]) -> None:
    """A view is of whole columns of the scene, and within its margin."""
    with pytest.raises(ValueError, match=r"Must be multiples of 1/4 along x"):
        nuisances.parallax(distance, shape=[24, 32], clock=[50, 10.0], shift=shift, seed=1)


def test_cost_of_the_truth() -> None:
    """A constant error of 0.1 K costs as much; flagged pixels do not count in the coverage."""
    emissivity = xr.DataArray(GLASS, dims="band", coords={"band": PAIR})
    rng = np.random.default_rng(0)
    truth = simulation.independent_pixels(
        np.arange(20) / 10.0, emissivity, simulation.Background(), 8, rng, start=300.0, stop=320.0
    )
    result = truth.assign(
        object_temperature=truth["object_temperature"] + 0.1,
        object_temperature_std=xr.full_like(truth["object_temperature"], 0.06),
        status=(("y", "x"), np.array([[0] * 6 + [4] * 2])),
    )
    found = nuisances.cost(truth, result)
    assert float(found["object_temperature_rmse"]) == pytest.approx(0.1, abs=1e-9)  # [K]
    assert float(found["flagged"]) == pytest.approx(0.25)
    assert float(found["covered"]) == 1.0
