"""Two cameras side by side: the object as certain as from one place, right or flagged."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from dbthermal import alignment, separation, simulation
from dbthermal._arrays import on_disk
from dbthermal._samples import Grain
from dbthermal.schema import Status
from dbthermal.separation import _quality as quality
from dbthermal.separation._apart import displaced
from reproduction.experiments.pictures import ROOM, Picture, smooth_shift

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


def test_backgrounds_of_two_materials_are_told_before_the_pooled_object() -> None:
    """The bend between the responses is that of the right background, not of one far off."""
    width, shift, rig = 24, np.zeros((2, 20, 48)), simulation.Rig(noise=(0.003, 0.03))
    shift[1] = 4.0
    concrete = GLASS.copy(data=[0.928, 0.871])
    emissivity = xr.concat([GLASS] * width + [concrete] * width, "x").expand_dims(y=20)
    emissivity, rng = emissivity.transpose("band", "y", "x"), np.random.default_rng(1)
    scene = SMALL.draw(TIME, emissivity, rng, shift)
    capture = simulation.observe(scene, rig.response(), rng)
    # The second camera sees glass beside the first columns of concrete: a ratio of its own.
    columns = np.repeat([0, 1, 2], [width, 4, width - 4])
    labels = xr.DataArray(np.tile(columns, (20, 1)), dims=("y", "x"))
    known = field(shift)
    result = separation.solve(capture, rig.response(), pool=labels, reflection_shift=known)
    got = judged(scene, result)
    print(got)
    assert got["good"] > 0.85
    assert got["rmse"] < 0.005
    assert got["cover"] > 0.88


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


def test_what_is_at_hand_is_not_separated_again(moved: tuple[xr.Dataset, ...]) -> None:
    """`separate` gives bit for bit the same with a result of `solve`, and refuses another's."""
    _, capture, shift, alone = moved
    whole = partial(separation.separate, capture, RIG.response(), reflection_shift=shift)
    xr.testing.assert_identical(whole(alone=alone), whole())
    pooled = alone.assign_attrs(pooled=1)
    unlike = alone.assign_attrs(settings="SubspaceSettings(background_drift=1.0, device=None)")
    wrong = [(pooled, "without materials"), (unlike, "background_drift=3.0")]
    for other, message in (*wrong, (alone.isel(x=slice(9)), "size 9")):
        with pytest.raises(ValueError, match=message):
            whole(alone=other)


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


def test_bad_pixels_cost_no_more_than_their_surroundings() -> None:
    """A dead pixel and one that lacks samples spoil the samples that are mostly made of them."""
    shift = smooth_shift(SMALL.shape, 2.5, 0.0)
    _, capture = film(SMALL, shift, 1)
    counts = capture["counts"].copy()
    counts[1, :, 8, 20] = np.nan
    counts[1, 100:103, 12, 30] = np.nan
    counts[0, 50, 14, 40] = np.nan
    result = separation.solve(
        capture.assign(counts=counts), RIG.response(), reflection_shift=field(shift)
    )
    lost = np.argwhere((result["status"] & int(Status.INVALID_SAMPLES)).values != 0)
    # The two pixels whose samples of the second camera lie half on it.
    assert lost.tolist() == [[8, 22], [8, 23]]
    plain = separation.solve(capture, RIG.response(), reflection_shift=field(shift))
    good = (result["status"] == 0) & (plain["status"] == 0)
    assert float(good.mean()) > 0.85
    apart = abs(result["object_temperature"] - plain["object_temperature"]).where(good)
    assert float(apart.max()) < 0.5  # K


def test_stuck_pixels_do_not_reach_their_surroundings() -> None:
    """A pixel that is far too warm in the first band passes for no change of the object."""
    shift = smooth_shift(SMALL.shape, 2.5, 0.0)
    scene, capture = film(SMALL, shift, 1)
    stuck = np.zeros(SMALL.shape, dtype=np.uint32)
    stuck[4::6, 7::9] = int(Status.DEAD_PIXEL)
    counts = capture["counts"].where(stuck == 0, 2.0 * float(capture["counts"][0].max()))
    noisy = counts + np.random.default_rng(1).normal(0.0, 3.0, counts.shape)
    bad = capture.assign(counts=noisy.astype(np.float32), status=(("y", "x"), stuck))
    result = separation.solve(bad, RIG.response(), reflection_shift=field(shift))
    error = abs(result["object_temperature"] - scene["object_temperature"]).mean("time")
    error = error.where(result["status"] == 0)
    print(f"without a flag {float(error.notnull().mean()):.2f}, largest error {error.max():.2f} K")
    assert float(error.notnull().mean()) > 0.75
    assert float(error.max()) < 0.5


def test_known_emissivities_and_rapid_heating() -> None:
    """Frame by frame, the two places make the object more certain than one place does."""
    picture = Picture(shape=(20, 48), walkers=6, rise=(2.0, 6.0))
    shift = smooth_shift(picture.shape, 2.4, 1.2)
    got = {}
    for name, moved_by in (("apart", shift), ("one place", np.zeros_like(shift))):
        scene, capture = film(picture, moved_by, 4)
        got[name] = judged(
            scene,
            separation.solve(
                capture,
                RIG.response(),
                "calibrated",
                emissivity=GLASS,
                reflection_shift=field(moved_by),
            ),
        )
    print(got)
    assert got["apart"]["good"] > 0.85
    assert got["apart"]["rmse"] < 0.8 * got["one place"]["rmse"]
    assert 0.92 < got["apart"]["cover"] < 0.98


@pytest.mark.slow
@pytest.mark.parametrize(
    ("far", "cover", "good"), [(7.0, 0.92, (0.7, 1.0)), (9.0, 0.85, (0.3, 0.7))]
)
def test_people_at_two_depths_in_a_flat_mirror(
    far: float, cover: float, good: tuple[float, float]
) -> None:
    """Those near are displaced by 6 pixels, those behind by more: right or, of 3 more, flagged."""
    shape, rng = (32, 72), np.random.default_rng(5)
    picture, (rows, columns) = Picture(shape=shape, walkers=3), np.indices(shape, dtype=np.float64)
    warm = picture._object(TIME, rng)
    films = [np.full((TIME.size, *shape), ROOM)] * 2
    for shift in (6.0, far):
        mirror = picture._mirror(TIME, rng)
        views = mirror(rows, columns), mirror(rows, columns + shift)
        films = [np.maximum(one, other) for one, other in zip(films, views, strict=True)]
    scene = simulation.scene(TIME, warm, films[0], GLASS)
    background = scene["background_temperature"]
    scene["background_temperature"] = (("band", *background.dims), np.stack(films))
    scene["background_temperature"].attrs = background.attrs
    capture = simulation.observe(scene, RIG.response(), np.random.default_rng(1))
    found = alignment.reflection_shift(capture, RIG.response())
    result = separation.solve(capture, RIG.response(), reflection_shift=found)
    got = judged(scene, result)
    apart = float(((result["status"] & int(Status.BANDS_APART)) != 0).mean())
    print(f"behind {far} pixel: {got}, apart {apart:.2f}")
    assert cover < got["cover"] < 0.98
    assert (1.0 - got["cover"]) * got["good"] < 0.05  # wrong without a flag, of all samples
    assert got["rmse"] < 0.1
    assert good[0] < got["good"] < good[1]
    assert apart > 0.3 if far > 7.0 else apart < 0.05


def test_noise_of_a_registration_is_not_taken_for_white() -> None:
    """Pixels that a registration has averaged share noise, which a resampling leaves: measured."""
    shape, noise = (20, 48), np.random.default_rng(3).normal(20000.0, 10.0, (2, 300, 20, 49))
    noise[1, ..., :-1] = 0.5 * (noise[1, ..., :-1] + noise[1, ..., 1:])
    places = {"band": list(RIG.bands), "time": TIME}
    capture = xr.Dataset({"counts": (("band", "time", "y", "x"), noise[..., :-1])}, places)
    capture["noise_factor"] = "band", [1.0, 0.5**0.5]
    moved = displaced.check(field(smooth_shift(shape, 2.5, 0.5)), capture, 0)
    whole, grains = slice(0, 20), quality.grains(capture)
    counts, _, _, gain = displaced.read(capture, moved, whole, whole, 1, grains)
    paired = gain[1] > 0
    ratio = counts[1].std(axis=0)[paired] / (10.0 * 0.5**0.5 * gain[1, paired])
    print(f"noise over what is said: {ratio.mean():.3f}")
    assert abs(ratio.mean() - 1.0) < 0.03
    assert ratio.std() < 0.1
    outside = capture.assign(counts=capture["counts"].where(capture["band"] == "8-14"))
    _, _, status, gain = displaced.read(outside, moved, slice(0, 4), whole, 1, grains)
    assert quality.unusable(status).all()  # rows that the second camera does not see at all
    assert np.isfinite(gain).all()


def test_surveyed_pixels_are_kept_on_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of films on disk any chosen pixels are read once, and come the same the next time."""
    monkeypatch.setattr(displaced, "_KEPT", 0)  # nothing in memory
    shape, counts = (20, 48), np.random.default_rng(3).normal(20000.0, 10.0, (2, 300, 20, 48))
    places = {"band": list(RIG.bands), "time": TIME}
    capture = xr.Dataset({"counts": (("band", "time", "y", "x"), counts)}, places)
    with on_disk(tmp_path):
        moved = displaced.check(field(smooth_shift(shape, 2.5, 0.5)), capture, 0)
    read: list[xr.Dataset] = []

    def load() -> tuple[xr.Dataset, list[Grain]]:
        read.append(capture)
        return capture, quality.grains(capture)

    rows, some = slice(0, 20), np.arange(100, 700)
    first = displaced.paired(load, moved, rows, rows, some, 1)
    kept = [part.copy() for part in first]
    first[0][:] = 0.0  # a tile is made of it, in place
    for part, again in zip(kept, displaced.paired(load, moved, rows, rows, some, 1), strict=True):
        np.testing.assert_array_equal(again, part)
    assert len(read) == 1


FIELD = field(np.zeros((2, *SMALL.shape)))
BAD = {
    "size": (FIELD.isel(x=slice(40)), "Invalid size 40 of 'x' of the reflection shift"),
    "coordinates": (FIELD.assign_coords(x=np.arange(48) + 1.0), "Invalid 'x' of the reflection"),
    "reference": (FIELD.assign_attrs(reference_band="9.5"), "Invalid reference_band .'9.5'. of"),
    "bands": (FIELD.assign_attrs(bands=["3-5"]), "Invalid bands .'3-5'. of the reflection shift"),
    "axis": (FIELD.assign_coords(axis=["x", "y"]), "Invalid axis .'x', 'y'. of the reflection"),
    "not finite": (FIELD.assign(shift=FIELD["shift"] * np.nan), "without a number"),
    "part of it": (FIELD.assign(shift=FIELD["shift"].where(FIELD["x"] > 3)), "where it is known"),
    "std": (FIELD.assign(shift_std=FIELD["shift_std"] - 1.0), "Invalid shift_std"),
    "large": (FIELD.assign(shift=FIELD["shift"] + 30.0), "reflection shift of 30 pixel. Must be l"),
    "missing": (FIELD.drop_vars("known"), "Missing variable 'known' in the reflection_shift"),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_field_is_a_clear_error(what: str) -> None:
    """A field that is none of this capture is refused, by its name and the rule."""
    bad, message = BAD[what]
    rng = np.random.default_rng(1)
    flat = np.full((TIME.size, *SMALL.shape), 300.0)
    capture = simulation.observe(simulation.scene(TIME, flat, flat, GLASS), RIG.response(), rng)
    capture = capture.assign_coords(x=np.arange(48.0))
    with pytest.raises(ValueError, match=message):
        separation.solve(capture, RIG.response(), reflection_shift=bad)


@pytest.mark.slow
@pytest.mark.parametrize(("emissivity", "seeds"), [((0.86, 0.72), (21, 22)), ((0.72, 0.86), (21,))])
def test_displacements(emissivity: tuple[float, float], seeds: tuple[int, ...]) -> None:
    """Issue 13: four fifths of the pixels without a flag, as accurate as without displacement."""
    glass = GLASS.copy(data=list(emissivity))
    for seed in seeds:
        still = np.zeros((2, *Picture().shape))
        scene, capture = film(Picture(), still, seed, glass)
        one = judged(scene, separation.solve(capture, RIG.response()))
        for size, varying in ((0.7, 0.0), (2.4, 1.2), (6.0, 2.0)):
            shift = smooth_shift(Picture().shape, size, varying)
            scene, capture = film(Picture(), shift, seed, glass)
            result = separation.solve(capture, RIG.response(), reflection_shift=field(shift))
            got = judged(scene, result)
            print(f"seed {seed}, {size} pixel: {got}, one place {one}")
            assert got["good"] > 0.8
            assert got["rmse"] < 1.1 * one["rmse"]
            assert 0.92 < got["cover"] < 0.98


def test_materials_too_narrow_for_a_blur_are_pooled_all_the_same() -> None:
    """Stripes of six columns keep their common ratio, of sharp bands, where none is wider."""
    shift = np.zeros((2, *SMALL.shape))
    shift[1] = 4.0
    (_, capture), known = film(SMALL, shift, 3), field(shift)
    stripes = np.arange(SMALL.shape[1]) // 6
    labels = xr.DataArray(np.tile(stripes, (SMALL.shape[0], 1)), dims=("y", "x"))
    pooled = separation.solve(capture, RIG.response(), pool=labels, reflection_shift=known)
    alone = separation.solve(capture, RIG.response(), reflection_shift=known)
    stds = [float(one["reflection_ratio_std"][1].median()) for one in (pooled, alone)]
    print(f"deviation of the ratio: pooled {stds[0]:.3f}, alone {stds[1]:.3f}")
    assert stds[0] < 0.5 * stds[1]
