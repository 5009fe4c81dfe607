"""Two cameras side by side: pixels alone and together in turns, and materials told between them."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from test_displaced import GLASS, RIG, SMALL, TIME, field, film

from dbthermal import separation, simulation
from dbthermal.schema import Status
from dbthermal.separation._apart import displaced, equations, joint
from dbthermal.separation._inputs import Inputs, Labels, check
from dbthermal.separation._solve import get_method, separated
from dbthermal.separation._tiles import Material
from reproduction.experiments.pictures import ROOM, Picture, smooth_shift

SHIFT = smooth_shift(SMALL.shape, 2.4, 1.2)
HALVES = xr.DataArray(np.repeat([[0, 1]], 24, axis=1) + np.zeros((20, 1), int), dims=("y", "x"))


@pytest.fixture(scope="module")
def plate() -> tuple[xr.Dataset, xr.Dataset, xr.Dataset]:
    """Scene and capture of a plate of glass displaced by 2.4 pixels, and each pixel alone."""
    scene, capture = film(SMALL, SHIFT, 4)
    return (
        scene,
        capture,
        separation.solve(capture, RIG.response(), reflection_shift=field(SHIFT)),
    )


def pooled_inputs(capture: xr.Dataset, labels: xr.DataArray) -> Inputs:
    """Checked inputs of the default method with materials and the known field."""
    method, shift = get_method("subspace"), field(SHIFT)
    return check(capture, RIG.response(), method, "subspace", pool=labels, reflection_shift=shift)


def test_solve_pools_from_each_pixel_alone(plate: tuple[xr.Dataset, ...]) -> None:
    """With a result at hand the pooled one is bit for bit that without."""
    _, capture, alone = plate
    again = separated(pooled_inputs(capture, HALVES), alone=alone)
    whole = separation.solve(
        capture, RIG.response(), pool=HALVES, reflection_shift=field(SHIFT), workers=1
    )
    xr.testing.assert_identical(again, whole)


def test_object_of_the_second_place_is_told_from_a_result(plate: tuple[xr.Dataset, ...]) -> None:
    """What the second camera sees of the object is nearer to the truth than that of the first."""
    scene, capture, alone = plate
    inputs = pooled_inputs(capture, HALVES)
    both = joint.from_result(inputs, alone)
    resample = displaced.check(field(SHIFT), capture, inputs.bands[0]).resample
    true = scene["object_temperature"].values.reshape(TIME.size, -1)
    inside = (np.abs(resample.sum(axis=1) - 1.0) < 1e-6) & (alone["status"].values.ravel() == 0)
    there = (resample @ true.T)[inside].T
    film = both.result["background_temperature"].values.reshape(TIME.size, -1)[:, inside]
    here = alone["object_temperature"].values.reshape(TIME.size, -1)[:, inside]
    errors = [float(np.sqrt(np.nanmean((one - there) ** 2))) for one in (film, here)]
    print(f"RMSE of the object at the second place {errors[0]:.3f} K, of the first {errors[1]:.3f}")
    assert errors[0] < 0.5 * errors[1]


def test_materials_are_regrouped_by_what_is_told(plate: tuple[xr.Dataset, ...]) -> None:
    """Two halves of one glass are told apart by noise; as one they have one emissivity."""
    scene, capture, alone = plate
    told: list[Material | None] = []

    def as_one(material: Material | None) -> Labels:
        told.append(material)
        return np.zeros(HALVES.size, dtype=np.intp)

    one = separated(pooled_inputs(capture, HALVES), alone=alone, regroup=as_one)
    two = separated(pooled_inputs(capture, HALVES), alone=alone)
    assert len(told) == 1
    assert told[0] is not None
    halves = told[0].ratio[1].reshape(HALVES.shape)[10, [4, -4]]
    true = float((1.0 - GLASS[1]) / (1.0 - GLASS[0]))
    print(f"ratios of the halves {halves}, true {true:.3f}")
    assert halves[0] != halves[1]
    assert np.allclose(halves, true, rtol=0.05)
    good = (one["status"] == 0) & (two["status"] == 0)
    errors = [
        float(((it["object_temperature"] - scene["object_temperature"]) ** 2).where(good).mean())
        for it in (one, two, alone)
    ]
    print(f"mean square errors [K^2] of one material, of halves, alone: {errors}")
    assert errors[0] < errors[2]
    assert not one["emissivity"].equals(two["emissivity"])


def test_cameras_at_one_place_are_regrouped_too() -> None:
    """Without a shift materials are told once and regrouped by that."""
    capture = film(SMALL, np.zeros((2, *SMALL.shape)), 5)[1]
    inputs = replace(pooled_inputs(capture, HALVES), displacement=None)
    one = separated(inputs, regroup=lambda _: np.zeros(HALVES.size, dtype=np.intp))
    whole = separation.solve(capture, RIG.response(), pool=xr.zeros_like(HALVES))
    xr.testing.assert_identical(one, whole)


@pytest.mark.parametrize("wrong", [-1.0, 3.0])
def test_nothing_stands_where_no_object_fits(plate: tuple[xr.Dataset, ...], wrong: float) -> None:
    """By a wrong field no temperature is without a deviation, none of an impossible emissivity."""
    _, capture, _ = plate
    result = separation.solve(capture, RIG.response(), reflection_shift=field(wrong * SHIFT))
    for name in ("object_temperature", "background_temperature"):
        known = result[name].notnull()
        assert bool((known == result[f"{name}_std"].notnull()).all())
        print(f"{name}: {float(known.mean()):.3f} of the samples")
    impossible = (result["status"] & int(Status.NONPHYSICAL_EMISSIVITY)) != 0
    print(f"{int(impossible.sum())} pixels of an impossible emissivity")
    assert int(impossible.sum()) > 0
    assert not bool(result["object_temperature"].where(impossible).notnull().any())


def test_a_pixel_without_a_solution_has_no_object(plate: tuple[xr.Dataset, ...]) -> None:
    """Where the equations of both places grow nothing is told of the object, with a flag."""
    _, capture, alone = plate
    told = joint.from_result(pooled_inputs(capture, HALVES), alone)
    factor = np.ones(alone["status"].size)
    factor[333] = np.nan
    result = alone.copy(deep=True)
    replace(told, result=result, factor=factor).finish()
    place = divmod(333, alone.sizes["x"])
    assert alone["status"].values[place] == 0
    assert result["status"].values[place] == int(Status.NOT_CONVERGED)
    for name in ("object_temperature", "background_temperature", "emissivity"):
        for one in (name, f"{name}_std"):
            lost = alone[one].notnull() & result[one].isnull()
            lost = lost.any([dim for dim in lost.dims if dim not in ("y", "x")])
            assert np.argwhere(lost.values).tolist() == [list(place)]


@pytest.mark.slow
def test_a_rapid_object_does_not_hide_that_cameras_are_apart() -> None:
    """Paired by their reflections, more pixels show the object apart, and yet more have no flag."""
    rng, picture = np.random.default_rng(1), Picture((40, 56), 6, rise=(0.5, 2.0), still=0.5)
    nearly_black = GLASS.copy(data=[0.95, 0.88])
    true = smooth_shift(picture.shape, 4.2, 1.0)
    scene = picture.draw(np.arange(200) / 10.0, nearly_black, rng, true)
    result = separation.separate(simulation.observe(scene, RIG.response(), rng), RIG.response())
    good = result["status"] == 0
    error = abs(result["object_temperature"] - scene["object_temperature"]).where(good)
    inside = (error < 1.96 * result["object_temperature_std"]).where(good)
    print(f"{float(good.mean()):.2f} without a flag, median error {float(error.median()):.2f} K")
    print(f"{float(inside.mean()):.3f} of the intervals hold")
    assert result.attrs["reflection_shift"] == "found"
    assert good.mean() > 0.3
    assert inside.mean() > 0.9


@pytest.mark.parametrize("apart", [0.0, -4.0])
def test_a_switched_lamp_shows_that_cameras_are_apart(apart: float) -> None:
    """The bands of each pixel are simultaneous, with a false ratio: the outline tells."""
    time, shape = TIME[:200], (40, 56)
    rows, columns = np.indices(shape)
    lit = sum((begin < time) & (time < begin + 2.0) for begin in (3.0, 8.0, 14.0))
    views = []
    for moved in (0.0, apart):
        disc = 1.0 / (1.0 + np.exp(np.hypot(rows - 19.0, columns + moved - 27.0) - 11.0))
        views.append(ROOM + 4.0 * np.multiply.outer(lit, disc))
    warm = ROOM + 15.0 * simulation.heating(time, 0.0, 1.0, 8.0)[:, None, None] * np.ones(shape)
    scene = simulation.scene(time, warm, views[0], GLASS)
    scene["background_temperature"] = ("band", *scene["object_temperature"].dims), np.array(views)
    scene["background_temperature"].attrs["units"] = "K"
    capture = simulation.observe(scene, RIG.response(), np.random.default_rng(1))
    result = separation.separate(capture, RIG.response())
    good = (result["status"] == 0).values
    score = (result["object_temperature"] - warm) / result["object_temperature_std"]
    far = (score**2).mean("time").values[good] > 5.0**2
    print(f"{good.mean():.2f} without a flag, {far.mean():.3f} of them far off")
    assert result.attrs["reflection_shift"] == ("found" if apart else "none")
    assert "warnings" not in result.attrs
    assert good.mean() > 0.2
    assert far.mean() < 0.02


@pytest.mark.filterwarnings("ignore:The bands of")
@pytest.mark.parametrize("depths", [(2.0, 2.0), (1.0, 4.0)])
def test_two_depths_in_one_pixel_are_doubted(depths: tuple[float, float]) -> None:
    """No shift of the reflections explains a window before a wall; of one depth nothing is said."""
    picture, mirrored = Picture((32, 48), walkers=6), []
    for seed, depth in enumerate(depths):
        shift = np.stack([np.zeros(picture.shape), np.full(picture.shape, depth)])
        mirrored.append(picture.draw(TIME[:200], GLASS, np.random.default_rng(seed), shift))
    scene, other = mirrored
    scene["background_temperature"] += other["background_temperature"] - ROOM
    capture = simulation.observe(scene, RIG.response(), np.random.default_rng(2))
    result = separation.separate(capture, RIG.response())
    said = [one for one in result.attrs.get("warnings", []) if "no shift of the reflec" in one]
    print(result.attrs["reflection_shift"], said)
    assert result.attrs["reflection_shift"] == "found"
    assert len(said) == (depths[0] != depths[1])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_gaps_of_a_film_are_bridged_by_lines(dtype: type[np.floating]) -> None:
    """As by NumPy's interpolation pixel by pixel, at the ends too; what has no number stays."""
    rng = np.random.default_rng(0)
    film = rng.normal(300.0, 1.0, (90, 40)).astype(dtype)
    film[rng.random(film.shape) < 0.3] = np.nan
    film[[0, 1, 50, -1]] = np.nan
    film[:, 7] = np.nan
    solved, frames, expected = rng.random(40) < 0.8, np.arange(90), film.copy()
    solved[7] = True
    for pixel in np.flatnonzero(solved):
        known = np.isfinite(film[:, pixel])
        if known.any():
            line = np.interp(frames[~known], frames[known], film[known, pixel])
            expected[~known, pixel] = line
    np.testing.assert_array_equal(equations.bridge(film, solved), expected)
