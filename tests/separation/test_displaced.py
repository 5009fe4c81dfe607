"""Two cameras side by side: the object as certain as from one place, right or flagged."""

import numpy as np
import pytest
import xarray as xr

from dbthermal import separation, simulation
from dbthermal.schema import Status
from reproduction.experiments.pictures import Picture, smooth_shift

RIG = simulation.Rig()
GLASS = xr.DataArray([0.86, 0.72], dims="band", coords={"band": list(RIG.bands)})
TIME = np.arange(300) / 10
SMALL = Picture(shape=(20, 48), walkers=6)
_TO_95 = 1.96


def field(shift: np.ndarray, std: float = 0.0, **attrs: object) -> xr.Dataset:
    """Field of the reflections' shift as `alignment.reflection_shift` gives it."""
    units = {"units": "pixel"}
    return xr.Dataset(
        {
            "shift": (("axis", "y", "x"), shift.astype(np.float32), units),
            "shift_std": (("axis", "y", "x"), np.full(shift.shape, std, np.float32), units),
            "known": (("y", "x"), np.all(np.isfinite(shift), axis=0)),
        },
        coords={"axis": ["y", "x"]},
        attrs={"reference_band": RIG.bands[0], "bands": list(RIG.bands[1:]), **attrs},
    )


def film(
    picture: Picture, shift: np.ndarray, seed: int, emissivity: xr.DataArray = GLASS
) -> tuple[xr.Dataset, xr.Dataset]:
    """Scene and capture of a picture, seen from two places."""
    rng = np.random.default_rng(seed)
    scene = picture.draw(TIME, emissivity, rng, shift)
    return scene, simulation.observe(scene, RIG.response(), rng)


def judged(scene: xr.Dataset, result: xr.Dataset) -> dict[str, float]:
    """Share of pixels without a flag; of these median RMSE [K] and cover of the 95 % intervals."""
    good = result["status"] == 0
    error: xr.DataArray = result["object_temperature"] - scene["object_temperature"]
    held = abs(error) < _TO_95 * result["object_temperature_std"]
    return {
        "good": float(good.mean()),
        "rmse": float((error**2).mean("time").where(good).median() ** 0.5),
        "cover": float(held.where(good).mean()),
    }


@pytest.fixture(scope="module")
def moved() -> tuple[xr.Dataset, xr.Dataset, xr.Dataset, xr.Dataset]:
    """Scene, capture and field of a small picture displaced by 2.4 pixels, and its result."""
    shift = smooth_shift(SMALL.shape, 2.4, 1.2)
    scene, capture = film(SMALL, shift, 1)
    result = separation.solve(capture, RIG.response(), reflection_shift=field(shift))
    return scene, capture, field(shift), result


def test_cameras_apart_are_as_good_as_at_one_place(moved: tuple[xr.Dataset, ...]) -> None:
    """A displaced reflection costs no pixel but at the border, and no accuracy."""
    scene, capture, _, result = moved
    got = judged(scene, result)
    without = judged(scene, separation.solve(capture, RIG.response()))
    one_place = film(SMALL, np.zeros((2, *SMALL.shape)), 1)
    one = judged(one_place[0], separation.solve(one_place[1], RIG.response()))
    print(f"field {got}\nwithout {without}\none place {one}")
    assert without["good"] < 0.6
    assert got["good"] > 0.9
    assert got["rmse"] < 1.1 * one["rmse"]
    assert 0.92 < got["cover"] < 0.98


def test_pixels_without_a_pair_are_flagged(moved: tuple[xr.Dataset, ...]) -> None:
    """Where the second camera does not see the reflection nothing is estimated, with a reason."""
    *_, shift, result = moved
    width = SMALL.shape[1]
    unpaired = (result["status"] & int(Status.NO_REFLECTION_PAIR)) != 0
    # p lies more than half a pixel outside where r is less than the shift, less a half.
    outside = np.arange(width) < shift["shift"].sel(axis="x").values[:, :4].min() - 0.6
    assert outside.any()
    assert unpaired.values[:, outside].all()
    assert not unpaired.values[:, width // 2 :].any()
    assert np.isnan(result["object_temperature"].where(unpaired)).all()


def test_result_does_not_depend_on_workers(moved: tuple[xr.Dataset, ...]) -> None:
    """Bit for bit the same with one thread and with two."""
    _, capture, shift, result = moved
    one = separation.solve(capture, RIG.response(), reflection_shift=shift, workers=1)
    xr.testing.assert_identical(one, result)


def test_a_field_of_zero_changes_nothing() -> None:
    """Cameras at one place: the result is that without a field."""
    capture = film(SMALL, np.zeros((2, *SMALL.shape)), 2)[1]
    zero = field(np.zeros((2, *SMALL.shape)))
    plain = separation.solve(capture, RIG.response())
    result = separation.solve(capture, RIG.response(), reflection_shift=zero)
    assert np.array_equal(result["status"], plain["status"])
    for name in ("object_temperature", "emissivity"):
        good = plain["status"] == 0
        np.testing.assert_allclose(
            result[name].where(good), plain[name].where(good), rtol=0, atol=1e-3
        )
