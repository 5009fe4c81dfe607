"""Two cameras side by side: the object as certain as from one place, right or flagged."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import xarray as xr
from captures import emissivity_of
from scenes import GLASS, RIG, field, held, judged, painted
from scipy.sparse import csr_array
from worlds import MARGIN, RESPONSE, SHAPE, World, seen

from dbthermal import alignment, response, separation, simulation
from dbthermal.schema import Status
from dbthermal.separation._apart import equations
from dbthermal.separation._apart.equations import Equations
from reproduction.experiments.pictures import Picture, smooth_shift

TIME = np.arange(300) / 10.0
SMALL = Picture(shape=(20, 48), walkers=6)
STRAIGHT = smooth_shift(SMALL.shape, 2.5, 0.0)


@pytest.mark.parametrize("seed", [1, 2])
def test_responses_over_a_wide_range_are_followed(seed: int) -> None:
    """Of quiet cameras the ratio of a material is within its deviations, over 160 K."""
    quiet = simulation.Rig(noise=(0.003, 0.005), lowest=263.15, highest=423.15)
    scene = painted(seed, picture=SMALL, time=TIME, shift=STRAIGHT, rig=quiet)
    one_material = xr.DataArray(np.zeros(SMALL.shape, dtype=np.int32), dims=("y", "x"))
    result = separation.solve(
        scene.capture, scene.response, reflection_shift=field(STRAIGHT), pool=one_material
    )
    ratio, std = (result[f"reflection_ratio{end}"][1].median().item() for end in ("", "_std"))
    true = (1.0 - GLASS[1]) / (1.0 - GLASS[0])
    print(f"ratio {ratio / true - 1.0:+.4%} off, deviation {std / true:.4%}")
    assert abs(ratio - true) < 3.0 * std


def test_no_pixel_with_all_frames() -> None:
    """Where each pixel lacks a frame of its own, intervals hold as with all frames."""
    scene = painted(1, picture=SMALL, time=TIME, shift=STRAIGHT)
    frame = np.arange(scene.capture["counts"][0, 0].size) % TIME.size
    lost = (np.arange(TIME.size)[:, np.newaxis] == frame).reshape(TIME.size, *SMALL.shape)
    capture = scene.capture.assign(counts=scene.capture["counts"].where(~lost))
    result = separation.solve(capture, scene.response, reflection_shift=field(STRAIGHT))
    share = held(result, scene.truth, where=result["status"] == 0)
    assert float((result["status"] == 0).mean()) > 0.8
    assert share > 0.9


@pytest.mark.parametrize("seed", [1, 2])
def test_border_of_the_image(seed: int) -> None:
    """Of quiet cameras the rows at the border, resampled beyond it, are as right as all others."""
    picture, quiet = Picture(shape=(40, 56), walkers=7), simulation.Rig(noise=(0.05, 0.05))
    shift = smooth_shift(picture.shape, 2.4, 1.2)
    scene = painted(seed, (0.9, 0.8), picture, shift, quiet, TIME)
    result = separation.separate(scene.capture, scene.response)
    error = (result["object_temperature"] - scene.truth["object_temperature"])[:, [0, -1]]
    far = abs(error) > 5.0 * result["object_temperature_std"]
    sound = (result["status"] == 0)[[0, -1]]
    share = float(far.where(sound).mean())
    print(f"{share:.1%} far off, rms {float(np.sqrt((error.where(sound) ** 2).mean())):.3f} K")
    assert float(sound.mean()) > 0.35  # others are mirrored outside of the image
    assert share < 0.02


@pytest.mark.parametrize("seed", [1, 2])
def test_border_of_materials(seed: int) -> None:
    """Pixels that mix two materials, one in each camera, are right within their bars."""
    capture, truth = seen(World(parallax=2.0), seed)
    result = separation.separate(capture, RESPONSE)
    row, column = np.indices(SHAPE) + MARGIN
    border = 0.55 * (SHAPE[1] + 2 * MARGIN) + 3.0 * np.sin(row / 9.0)
    near = (np.abs(column - border) < 5.0) & (result["status"].values == 0)
    error = np.abs(result["object_temperature"].values - truth)[:, near]
    holds = np.mean(error < 1.96 * result["object_temperature_std"].values[:, near])
    print(f"{holds:.3f} of the intervals hold, of {near.sum()} pixels")
    assert near.sum() > 380
    assert holds > 0.92


def test_bad_pixels_cost_no_more_than_their_surroundings() -> None:
    """A dead pixel and one that lacks samples spoil the samples that are mostly made of them."""
    capture, shift = painted(1, picture=SMALL, time=TIME, shift=STRAIGHT).capture, STRAIGHT
    counts = capture["counts"].copy()
    counts[1, :, 8, 20] = np.nan
    counts[1, 100:103, 12, 30] = np.nan
    counts[0, 50, 14, 40] = np.nan
    lossy = capture.assign(counts=counts)
    result = separation.solve(lossy, RIG.response(), reflection_shift=field(shift))
    lost = np.argwhere((result["status"] & int(Status.INVALID_SAMPLES)).values != 0)
    # The two pixels whose samples of the second camera lie half on it.
    assert lost.tolist() == [[8, 22], [8, 23]]
    plain = separation.solve(capture, RIG.response(), reflection_shift=field(shift))
    good = (result["status"] == 0) & (plain["status"] == 0)
    assert float(good.mean()) > 0.85
    apart = abs(result["object_temperature"] - plain["object_temperature"]).where(good)
    assert float(apart.max()) < 0.5  # K


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_stuck_pixels_do_not_reach_their_surroundings(seed: int) -> None:
    """A pixel that is far too warm in the first band passes for no change of the object."""
    scene = painted(seed, picture=SMALL, time=TIME, shift=STRAIGHT)
    capture, shift = scene.capture, STRAIGHT
    stuck = np.zeros(SMALL.shape, dtype=np.uint32)
    stuck[4::6, 7::9] = int(Status.DEAD_PIXEL)
    counts = capture["counts"].where(stuck == 0, 2.0 * float(capture["counts"][0].max()))
    noisy = counts + np.random.default_rng(1).normal(0.0, 3.0, counts.shape)
    bad = capture.assign(counts=noisy.astype(np.float32), status=(("y", "x"), stuck))
    with pytest.warns(UserWarning, match="The noise of the capture, which is used"):
        result = separation.solve(bad, RIG.response(), reflection_shift=field(shift))
    error = abs(result["object_temperature"] - scene.truth["object_temperature"]).mean("time")
    std = result["object_temperature_std"].mean("time").where(result["status"] == 0)
    assert float(std.notnull().mean()) > 0.87
    # At the upper border hardly anything is mirrored, and the deviations say so.
    assert float((error / std).max()) < 4.0
    assert float(error.where(std < 0.2).max()) < 0.4
    assert float((std < 0.2).mean()) > 0.85


def test_known_emissivities_and_rapid_heating() -> None:
    """Frame by frame, the two places make the object more certain than one place does."""
    picture, got = replace(SMALL, rise=(2.0, 6.0)), {}
    shift = smooth_shift(picture.shape, 2.4, 1.2)
    options: dict[str, Any] = {"method": "calibrated", "emissivity": emissivity_of(*GLASS)}
    for name, moved in (("apart", shift), ("one place", np.zeros_like(shift))):
        scene = painted(4, picture=picture, time=TIME, shift=moved)
        options["reflection_shift"] = field(moved)
        got[name] = judged(scene, separation.solve(scene.capture, scene.response, **options))
    assert got["apart"]["measured"] > 0.85
    assert got["apart"]["typical"] < 0.8 * got["one place"]["typical"]
    assert 0.92 < got["apart"]["cover"] < 0.98


@pytest.mark.parametrize("wrong", [-1.0, 3.0])
def test_nothing_stands_where_no_object_fits(wrong: float) -> None:
    """By a wrong field no temperature is without a deviation, none of an impossible emissivity."""
    shift = smooth_shift(SMALL.shape, 2.4, 1.2)
    capture = painted(4, picture=SMALL, time=TIME, shift=shift).capture
    result = separation.solve(capture, RIG.response(), reflection_shift=field(wrong * shift))
    for name in ("object_temperature", "background_temperature"):
        known = result[name].notnull()
        assert bool((known == result[f"{name}_std"].notnull()).all())
    impossible = (result["status"] & int(Status.NONPHYSICAL_EMISSIVITY)) != 0
    assert int(impossible.sum()) > 0
    assert not bool(result["object_temperature"].where(impossible).notnull().any())


def test_the_quietest_camera_stays_the_reference() -> None:
    """Whatever noise a blur or resampling takes from another band; the field's is the same."""
    shift = smooth_shift((24, 48), 2.5, 0.0)
    capture = painted(1, picture=replace(SMALL, shape=(24, 48)), time=TIME, shift=shift).capture
    smooth = capture.assign(noise_factor=("band", [1.0, 0.01]))
    response = RIG.response().assign_attrs(noise_source="response")
    result = separation.solve(smooth, response, reflection_shift=field(shift))
    assert result.attrs["reference_band"] == "8-14"
    found = alignment.reflection_shift(smooth, response)
    assert found.attrs["reference_band"] == "8-14"


def test_a_camera_whose_counts_are_rounded_is_the_noisier() -> None:
    """Steps of 1.5 K make the quietest camera the noisiest, in all parts of a separation."""
    shift = smooth_shift((32, 48), 3.0, 0.0)
    capture = painted(1, picture=replace(SMALL, shape=(32, 48)), time=TIME, shift=shift).capture
    step = 1.5 * response.curves(RIG.response(), ["8-14"])[0].reference_slope
    capture["counts"][0] = step * np.rint(capture["counts"][0] / step)
    result = separation.separate(capture, RIG.response())
    assert result.attrs["reflection_shift"] == "found"
    assert result.attrs["reference_band"] == "9.5"


def test_materials_too_narrow_for_a_blur_are_pooled_all_the_same() -> None:
    """Stripes of six columns keep their common ratio, of sharp bands, where none is wider."""
    shift = np.zeros((2, *SMALL.shape))
    shift[1] = 4.0
    capture, known = painted(3, picture=SMALL, time=TIME, shift=shift).capture, field(shift)
    stripes = np.arange(SMALL.shape[1]) // 6
    labels = xr.DataArray(np.tile(stripes, (SMALL.shape[0], 1)), dims=("y", "x"))
    pooled = separation.solve(capture, RIG.response(), pool=labels, reflection_shift=known)
    alone = separation.solve(capture, RIG.response(), reflection_shift=known)
    stds = [float(one["reflection_ratio_std"][1].median()) for one in (pooled, alone)]
    assert stds[0] < 0.5 * stds[1]


def test_the_object_of_both_places_solves_the_equations() -> None:
    """A row of pixels that each see the next one: by its own equation, by that before, or alone."""
    pixels, loose, frames = 60, 30, 7
    bends = np.array([[0.0, 0.05, 2e-3, 0.0, 0.0]])
    object_ = 5.0 * np.random.default_rng(1).standard_normal((pixels + 1, frames))  # [K]
    beyond = object_[1:] * (1.0 + bends[0, 1]) + bends[0, 2] * object_[1:] ** 2  # u_2(x(p))
    strong = np.arange(pixels) < loose
    shares = np.where(strong, [[1.8], [-0.8]], [[-0.8], [1.8]])
    places, following = np.arange(pixels), np.arange(loose + 1, pixels)
    linked = np.delete(places, [loose, pixels - 1])
    there = csr_array((np.ones(linked.size), (linked, linked + 1)), (pixels, pixels))
    onward = csr_array(
        (np.ones(following.size), (following - following[0], following - 1)),
        (following.size, pixels),
    )
    first = np.full(pixels, 0.9)
    ways = places[:loose], following, places[[loose]]
    equations = Equations(first, shares, there, onward, ways, bends)
    target = shares[0][:, np.newaxis] * object_[:-1] + shares[1][:, np.newaxis] * beyond
    change = first[loose] * (object_[loose + 1] - object_[loose])[np.newaxis]
    solution = equations.solve(target, np.zeros((pixels, frames)), change)
    for signal, expected in zip(solution[:2], (object_[:-1], object_[1:]), strict=True):
        np.testing.assert_allclose(signal[:-1], expected[:-1], rtol=0, atol=0.01)  # [K]
    assert solution[2].max() < 1e-3  # the last step [K]


def test_an_iteration_without_end_changes_no_sample() -> None:
    """An object that grows without bound at one place leaves the other camera's samples."""
    signals, result = np.array([[[0.0, 0.0]], [[0.5, 1e4]]]), np.empty((1, 2))
    equations.changes(signals, np.arange(2), np.array([0.5, 0.5]), np.zeros(9), result)
    np.testing.assert_allclose(result, [[0.25, 0.0]])
