"""Objects that heat rapidly: followed with true error bars, or flagged, in several scenes."""

from itertools import product

import numpy as np
import pytest
import xarray as xr
from captures import GLASS, RIG, emissivity_of
from numpy.testing import assert_allclose

from dbthermal import separation, simulation
from dbthermal.schema import Status
from dbthermal.separation._inputs import check
from dbthermal.separation._solve import get_method, separated
from reproduction.experiments.pictures import Picture

TIME = np.arange(300) / 10.0
FOUR = simulation.Rig(bands=("8-14", "9.5", "10.6", "12.1"), noise=(0.03, 0.35, 0.15, 0.2))
RISES = {"6-20 s": (6.0, 20.0), "2-6 s": (2.0, 6.0), "0.5-2 s": (0.5, 2.0)}


def heated(kind: str, rng: np.random.Generator, emissivity: xr.DataArray = GLASS) -> xr.Dataset:
    """Scene of walkers before an object of curves with kinks: (time, y, x) at random times."""
    scene = Picture((32, 48)).draw(TIME, emissivity, rng)
    rows, columns = np.indices((32, 48)) / 32.0
    since = TIME[:, None, None] - (4.0 + 16.0 * (1.0 - rows) + np.sin(5.0 * columns))
    constant = 0.3 + 2.0 * columns
    rise = -np.expm1(-np.maximum(since, 0.0) / constant)
    again = -np.expm1(-np.maximum(since - 5.0, 0.0) / constant)
    curves = {
        "kink": 35.0 * rise,
        "two steps": 20.0 * rise + 15.0 * again,
        "touch": 30.0 * rise * np.exp(-np.maximum(since, 0.0) / 8.0),
        "cooling": 40.0 - 25.0 * rise,
    }
    warm = scene["object_temperature"]
    return scene.assign(object_temperature=(warm.dims, 295.15 + curves[kind], warm.attrs))


def assert_followed(
    name: str, scene: xr.Dataset, rng: np.random.Generator, rig: simulation.Rig = RIG
) -> None:
    """Of the moving pixels 70 % have no flag; intervals hold in the rise and at the ends too."""
    result = separation.solve(simulation.observe(scene, rig.response(), rng), rig.response())
    moving = scene["background_temperature"].std("time") > 0.3
    good, truth = moving & (result["status"] == 0), scene["object_temperature"]
    error = abs(result["object_temperature"] - truth)
    within = (error < 1.96 * result["object_temperature_std"]).where(good)
    rate = abs(truth.differentiate("time"))
    shares = {
        "cover": within,
        "rise": within.where(rate > 0.2 * rate.max("time")),
        "first": within.isel(time=slice(None, 10)),
        "last": within.isel(time=slice(-10, None)),
    }
    scored = {key: float(value.mean()) for key, value in shares.items()}
    share = float(good.sum() / moving.sum())
    print(f"{name}: {share:.2f} without a flag", scored)
    assert share >= 0.7
    assert 0.92 <= scored.pop("cover") <= 0.98
    assert min(scored.values()) >= 0.9


@pytest.mark.parametrize(
    ("rig", "values"), [(RIG, (0.86, 0.72)), (FOUR, (0.86, 0.72, 0.8, 0.78))], ids=["two", "four"]
)
def test_a_kinked_rise_is_followed(rig: simulation.Rig, values: tuple[float, ...]) -> None:
    """A front of kinked rises of 0.3 to 3 s: most pixels without a flag, true intervals."""
    rng = np.random.default_rng(1)
    assert_followed("kink", heated("kink", rng, emissivity_of(*values, bands=rig.bands)), rng, rig)


def test_pieces_are_kept_for_the_next_pass() -> None:
    """A second pass takes the pieces of the first, and tells the same; a flag asks anew."""
    rng = np.random.default_rng(1)
    capture = simulation.observe(heated("kink", rng), RIG.response(), rng)
    inputs = check(capture, RIG.response(), get_method("subspace"))
    first, _ = separated(inputs)
    kept = inputs.division.any(axis=0).reshape(first["status"].shape)
    jump = np.uint32(Status.OBJECT_JUMP)
    assert kept.mean() > 0.5
    assert not np.any(first["status"].values[kept] & ~jump)
    second, _ = separated(inputs)
    for name in ("object_temperature", "object_temperature_std", "status"):
        assert_allclose(second[name], first[name], rtol=0, atol=1e-3)  # K, and bits


def switched(rng: np.random.Generator, pair: tuple[float, float], rate: float) -> xr.Dataset:
    """Scene of walkers before a heater that is switched on for 2 of 6 s, at a frame rate [Hz]."""
    time = np.arange(int(20.0 * rate)) / rate
    scene = Picture((28, 40)).draw(time, emissivity_of(*pair), rng)
    level = np.zeros(time.size)
    for frame in range(1, time.size):
        aim = 30.0 * (time[frame] % 6.0 < 2.0)
        level[frame] = aim + (level[frame - 1] - aim) * np.exp(-1.0 / (0.5 * rate))
    rows, columns = np.indices((28, 40))
    warm, profile = scene["object_temperature"], 1.0 + 0.2 * np.cos(columns / 9 + rows / 13)
    curves = np.multiply.outer(level, profile)
    return scene.assign(object_temperature=(warm.dims, 295.15 + curves, warm.attrs))


QUICK = {("front", (0.60, 0.45), 10.0), ("heater", (0.86, 0.72), 10.0)}
HEATED = product(("front", "heater"), ((0.86, 0.72), (0.60, 0.45), (0.95, 0.85)), (10.0, 30.0))


@pytest.mark.parametrize(
    ("kind", "pair", "rate"),
    [pytest.param(*case, marks=[] if case in QUICK else [pytest.mark.slow]) for case in HEATED],
)
def test_an_object_that_heats_within_seconds_is_no_parallax(
    kind: str, pair: tuple[float, float], rate: float
) -> None:
    """Cameras at one place: no shift is found, and nobody is warned of bands apart."""
    rng = np.random.default_rng(1)
    scene = switched(rng, pair, rate)
    if kind == "front":
        front = Picture((28, 40), rise=(0.5, 2.0))
        scene = front.draw(scene["time"].values, emissivity_of(*pair), rng)
    result = separation.separate(simulation.observe(scene, RIG.response(), rng), RIG.response())
    assert result.attrs["reflection_shift"] == "none"
    assert "warnings" not in result.attrs


@pytest.mark.long
@pytest.mark.parametrize("kind", [*RISES, "kink", "two steps", "touch", "cooling"])
def test_rapid_curves_are_followed(kind: str) -> None:
    """Fronts of any speed, two steps, a touch that fades, and cooling."""
    for seed in (1, 2, 3):
        rng = np.random.default_rng(seed)
        front = Picture((40, 56), rise=RISES.get(kind))
        scene = front.draw(TIME, GLASS, rng) if kind in RISES else heated(kind, rng)
        assert_followed(f"{kind}, seed {seed}", scene, rng)
