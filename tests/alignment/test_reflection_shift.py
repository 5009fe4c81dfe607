"""Shift of the reflections between two cameras side by side, against simulated truth."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from captures import GLASS, RIG, plain_capture
from marks import long, slow
from refused import assert_refused, refused
from scenes import heard, painted
from scipy.ndimage import gaussian_filter
from worlds import RESPONSE as WORLD
from worlds import World, seen

from dbthermal import alignment, schema, separation, simulation, store
from reproduction import disturbances, twins
from reproduction.experiments.pictures import Picture, smooth_shift
from reproduction.experiments.twins import capture_of
from reproduction.twins import stage

RESPONSE = RIG.response()
QUIET = simulation.Rig(noise=(0.03, 0.08)).response()
SHIFTS = [*slow(((0.0, 0.0),), ((2.4, 1.2),)), *long(((0.7, 0.0),), ((6.0, 2.0),))]


def drawn(
    seed: int,
    shift: tuple[float, float],
    picture: Picture | None = None,
    frames: int = 300,
    emissivity: xr.DataArray = GLASS,
) -> tuple[xr.Dataset, np.ndarray]:
    """Capture of people mirrored, by default in glass, and the true shift (2, y, x) [pixel]."""
    picture = picture or Picture()
    true = smooth_shift(picture.shape, *shift)
    return painted(seed, emissivity, picture, true, time=np.arange(frames) / 10.0).capture, true


def errors(field: xr.Dataset, true: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors (2, pixel) [pixel] where the shift is known, and those in standard deviations."""
    error = (field["shift"].values - true)[:, field["known"].values]
    return error, error / field["shift_std"].values[:, field["known"].values]


def check(capture: xr.Dataset, true: np.ndarray, share: float, within: float) -> xr.Dataset:
    """The shift is known in a share of the pixels, its median error small [pixel]."""
    field = schema.check(alignment.reflection_shift(capture, RESPONSE), "reflection_shift")
    error, _ = errors(field, true)
    assert error.shape[1] > share * true[0].size
    assert np.median(np.abs(error[1])) < within
    return field


def test_finds_a_smooth_field() -> None:
    """Along the baseline the field is right to a few hundredths of a pixel, beside bad samples."""
    capture, true = drawn(21, (2.4, 1.2))
    status = np.zeros(true[0].shape, dtype=np.uint32)
    status[30, 40:44] = schema.Status.DEAD_PIXEL
    capture["counts"][:, :, 30, 40:44] = 1e6
    capture["counts"][1, 50] = np.nan
    capture["counts"][0, 70:73, 10, 10] = np.nan
    capture["status"] = ("y", "x"), status, schema.Status.cf_attrs(schema.STATUS)
    field = check(capture, true, 0.8, 0.03)
    assert field.attrs["reference_band"] == "8-14"
    assert field.attrs["bands"] == ["9.5"]


@pytest.mark.parametrize("seed", [2, 3])
def test_borders_of_materials_do_not_bend_the_field(seed: int) -> None:
    """A blur moves a reflection at a border of materials, by half a pixel between unlike ones."""
    squares = np.add.outer(np.arange(48) // 12, np.arange(64) // 16) % 2
    of_pixel = np.array([[0.86, 0.6], [0.72, 0.7]])[:, squares]
    tiles = xr.DataArray(of_pixel, {"band": GLASS["band"]}, ("band", "y", "x"))
    picture = Picture(shape=squares.shape, walkers=7)
    capture, true = drawn(seed, (2.4, 1.2), picture, 200, tiles)
    error, _ = errors(alignment.reflection_shift(capture, RESPONSE), true)
    off = np.sqrt(np.mean(error[1] ** 2))
    print(f"{off:.4f} pixel off")
    assert off < 0.04


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_border_of_the_image(seed: int) -> None:
    """Near the border, too, the field along the baseline is right to hundredths of a pixel."""
    shift = alignment.reflection_shift(seen(World(parallax=2.0), seed)[0], WORLD)
    inner, known = np.zeros(shift["known"].shape, dtype=bool), shift["known"].values
    inner[6:-6, 6:-6] = True
    error = (np.abs(shift["shift"].sel(axis="x").values) - 2.0)[known & ~inner]
    assert np.sqrt(np.mean(error**2)) < 0.03


def test_parts_that_are_late_differently_make_the_delay_uncertain() -> None:
    """Half of the second view is a frame late, half early: no delay, but a large deviation."""
    capture, _ = drawn(23, (2.4, 1.2), Picture(shape=(40, 56), walkers=5), 200)
    torn, middle = capture.isel(time=slice(1, -1)).copy(deep=True), capture.sizes["x"] // 2
    torn["counts"][1, :, :, :middle] = capture["counts"].values[1, 2:, :, :middle]
    torn["counts"][1, :, :, middle:] = capture["counts"].values[1, :-2, :, middle:]
    both = [alignment.reflection_shift(one, RESPONSE).attrs for one in (capture, torn)]
    frames = [[10.0 * one[name] for name in ("delay", "delay_std")] for one in both]
    assert abs(frames[0][0]) < 0.05
    assert frames[0][1] < 0.05
    assert abs(frames[1][0]) < 3.0 * frames[1][1]
    assert frames[1][1] > 0.1


def test_clocks_of_cameras_apart_that_may_be_off_are_doubted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Where the images tell the clocks less surely than is asked, it is said by how much."""
    capture, _ = drawn(23, (2.4, 1.2), Picture(shape=(28, 40), walkers=5), 120)
    monkeypatch.setattr("dbthermal.alignment._joint._PRECISION", 0.001)  # [frame]
    with pytest.warns(UserWarning, match=r"clocks may be off by 0\.0\d+ frames, more than 0.001"):
        aligned = alignment.align(capture).attrs
    assert 0.0001 < aligned["time_offset_std"] < 0.01  # [s]
    assert abs(aligned["time_offset"][1]) < 4.0 * aligned["time_offset_std"]


def test_a_band_between_its_frames() -> None:
    """The rapid noise of a band that is interpolated half-way between its frames is not white."""
    rng, picture = np.random.default_rng(13), Picture(shape=(40, 56), walkers=5)
    true = smooth_shift(picture.shape, 2.4, 1.2)
    scene = picture.draw(np.arange(720) / 40.0, GLASS, rng, true)
    seen = disturbances.expose(scene, RESPONSE, rng, every=2, offsets=(0, 1), frames=359)
    seen = seen.drop_vars("exposure_time")
    found = alignment.align(seen).attrs["time_offset"][1]
    assert found == pytest.approx(0.025, abs=0.0025)  # 0.05 of a frame [s]
    aligned = alignment.align(seen, offset=0.025)
    check(aligned, true, 0.7, 0.1)


def test_an_object_that_fills_a_third_of_the_image() -> None:
    """Pixels without data, beside a registered object, say nothing of the noise."""
    capture, true = drawn(22, (2.4, 1.2))
    capture["counts"][..., : 2 * true.shape[2] // 3] = np.nan
    check(capture, true, 0.2, 0.05)


def test_deviation_of_a_field_finer_than_its_grid() -> None:
    """Where windows ask for other shifts than a smooth field can have, its deviation is larger."""
    picture, true = Picture(shape=(48, 64)), smooth_shift((48, 64), 2.4, 1.2)
    true[1] += np.sin(2.0 * np.pi * np.arange(48) / 9.0)[:, np.newaxis]
    capture = painted(62, GLASS, picture, true, time=np.arange(200) / 10.0).capture
    _, score = errors(alignment.reflection_shift(capture, RESPONSE), true)
    assert np.sqrt(np.mean(score[1] ** 2)) < 10.0


def test_opened_capture_with_steps_between_segments(tmp_path: Path) -> None:
    """Steps at shutter events are no reflection; a capture on disk is read block by block.

    Half of the reflection is still: no shift is known far from what moves, and nearer its deviation
    allows for the field to go on changing.
    """
    capture, true = drawn(47, (2.4, 1.2), Picture(still=0.5))
    segment = np.repeat([0, 1, 2], 100)
    steps = np.random.default_rng(0).normal(0.0, 300.0, (2, 3, *true[0].shape))
    capture["counts"] = (capture["counts"] + steps[:, segment]).astype(np.float32)
    capture["segment"] = "time", segment, {"units": "1"}
    store.save(capture, tmp_path / "capture.zarr", {})
    field = check(store.open_dataset(tmp_path / "capture.zarr"), true, 0.1, 0.03)
    assert not field["known"].values[:, : true.shape[2] // 3].any()
    off = field["shift"].notnull().values[1] & ~field["known"].values
    beyond = ((field["shift"] - true) / field["shift_std"]).values[1, off]
    assert np.sqrt(np.mean(beyond**2)) < 2.5


@pytest.mark.parametrize("shift", SHIFTS)
def test_error_is_what_it_is_said_to_be(shift: tuple[float, float]) -> None:
    """Over seeds, errors along the baseline are small, and as large as their deviation."""
    made = [drawn(seed, shift) for seed in (41, 42, 43)]
    found = [errors(alignment.reflection_shift(c, RESPONSE), t) for c, t in made]
    error, score = (np.concatenate(part, axis=1) for part in zip(*found, strict=True))
    assert np.median(np.abs(error[1])) < 0.03
    assert 0.6 < np.sqrt(np.mean(score[1] ** 2)) < 1.6


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rise", "shift"),
    [((0.5, 2.0), (0.0, 0.0)), ((2.0, 6.0), (2.4, 1.2)), ((0.5, 2.0), (6.0, 2.0))],
)
def test_rapid_object_does_not_pull_the_field(
    rise: tuple[float, float], shift: tuple[float, float]
) -> None:
    """Emission that changes rapidly is at one place in both bands, and still no shift of 0."""
    capture, true = drawn(44, shift, Picture(rise=rise))
    check(capture, true, 0.7, 0.03)


@pytest.mark.parametrize("seed", [1, 2])
def test_touches_are_no_reflections(seed: int) -> None:
    """Where an object is touched it changes as rapidly as the spots that switch before it."""
    rng, time = np.random.default_rng(seed), np.arange(250) / 10.0
    true, (y, x) = np.zeros((2, 48, 64)), np.indices((48, 64))
    true[1] = 3.0
    films = np.full((3, 250, 48, 64), 296.0)  # of the object, and what either camera sees mirrored
    for touched in np.arange(20) % 3 == 0:
        begin, row, column, width = rng.uniform([1.0, 0.0, 0.0, 2.0], [23.0, 48.0, 64.0, 4.0])
        since = np.maximum(time - begin, 0.0)[:, np.newaxis, np.newaxis]
        curve = np.exp(-since / 2.0) if touched else np.sin(2.5 * since) > 0.0
        for film, shift in ((0, 0.0),) if touched else ((1, 0.0), (2, 3.0)):
            place = np.hypot(y - row, x + shift - column) / width
            films[film] += 8.0 * (since > 0.0) * curve * np.exp(-0.5 * place**2)
    scene = simulation.scene(time, films[0], films[1], GLASS)
    dims = ("band", *scene["object_temperature"].dims)
    scene["background_temperature"] = dims, films[1:], {"units": "K"}
    field = alignment.reflection_shift(simulation.observe(scene, QUIET, rng), QUIET)
    error, score = errors(field, true)
    late = 10.0 * field.attrs["delay"]  # [frame]
    print(f"{np.median(np.abs(error[1])):.4f} pixel off, {np.sqrt(np.mean(score[1] ** 2)):.1f}")
    print(f"{late:.4f} frames late")
    assert np.median(np.abs(error[1])) < 0.04
    assert np.quantile(np.abs(error[1]), 0.95) < 0.2
    assert abs(late) < 0.012


@pytest.mark.parametrize("seed", [*slow(2), *long(11, 17)])
def test_reflections_that_mostly_change_slowly(seed: int) -> None:
    """In a simulated twin of the wineglass the fastest changes tell little, and lead nobody astray.

    The registration on the object may leave a shift of all pixels, which is no error of the field.
    """
    rng = np.random.default_rng(seed)
    drawing = replace(capture_of("plate window glass", (84, 112), (300, 10.0), 0.04), rays=2)
    scene = twins.twin("wineglass", drawing, rng)
    capture = stage.registered(scene, stage.observe(scene, RESPONSE, rng))
    field = alignment.reflection_shift(capture, RESPONSE)
    moving = scene["background_temperature"].std("time").values > 0.1
    moving &= scene["on_object"].values & np.isfinite(scene["shift"].values).all(axis=0)
    known = float(field["known"].values[moving].mean())
    error = (field["shift"].values - scene["shift"].values)[1][moving & field["known"].values]
    apart = np.median(np.abs(error - np.median(error)))
    assert known > 0.9
    assert apart < 0.1
    assert abs(np.median(error)) < 0.2


@pytest.mark.long
def test_large_field() -> None:
    """Tens of pixels are found from coarse pictures to fine ones."""
    capture, true = drawn(45, (45.0, 8.0), Picture(shape=(160, 240)), frames=150)
    error, _ = errors(alignment.reflection_shift(capture, RESPONSE), true)
    assert error.shape[1] > 0.5 * true[0].size
    assert np.median(np.abs(error[1])) < 0.05


STILL = plain_capture(np.random.default_rng(1).normal(2e4, 4.0, (2, 60, 30, 32)).astype(np.float32))
DEAD = xr.DataArray(np.full((30, 32), schema.Status.DEAD_PIXEL, np.uint32), dims=("y", "x"))
DEAD.attrs.update(schema.Status.cf_attrs(schema.STATUS))


test_refuses_what_tells_no_shift = refused(
    lambda capture: alignment.reflection_shift(capture, RESPONSE),
    [
        (STILL, "Missing texture"),
        (STILL.assign(status=DEAD), "Missing texture"),
        (STILL.isel(band=[0]), "Must be two or more"),
        (STILL.isel(y=slice(20)), "20 rows"),
        (STILL.isel(time=slice(10)), "number 10 of frames"),
    ],
)


@pytest.mark.slow
def test_refuses_a_shift_beyond_a_third_of_the_image() -> None:
    """What matches at the end of the search is no shift."""
    capture, _ = drawn(46, (22.0, 0.0), Picture(shape=(40, 48)), frames=150)
    assert_refused("less than a third of the image", alignment.reflection_shift, capture, RESPONSE)


def lamp(
    seed: int, shift: int, texture: float, emissivity: list[list[float]], bend: float = 0.0
) -> tuple[xr.Dataset, xr.DataArray]:
    """Capture of a lamp whose picture the cameras see displaced, before two materials; the object.

    The emissivities are those of either material in both bands; the heating bends by a share.
    """
    rng, time = np.random.default_rng(seed), np.arange(250) / 10.0
    picture = gaussian_filter(rng.standard_normal((64, 80 + shift)), texture)
    picture = 7.0 * (picture - picture.min()) / np.ptp(picture)
    lit = np.searchsorted([2.0, 5.0, 9.0, 11.0, 16.0, 20.0], time)[:, np.newaxis, np.newaxis] % 2
    rise = 15.0 * (1.0 - np.exp(-time / 12.0))[:, np.newaxis, np.newaxis]
    heating = rise * (1.0 + bend * np.sin(2.0 * np.pi * np.arange(80) / 40.0))
    warm = np.broadcast_to(300.0 + heating, (250, 64, 80))
    right = np.add.outer(0.5 * np.arange(64), np.arange(80)) > 50
    of_pixel = np.transpose(emissivity)[:, right.astype(int)]
    plastic = xr.DataArray(of_pixel, {"band": GLASS["band"]}, ("band", "y", "x"))
    scene = simulation.scene(time, warm, warm, plastic)
    lamps = [295.0 + lit * view for view in (picture[:, :80], picture[:, shift:])]
    dims = ("band", *scene["object_temperature"].dims)
    scene["background_temperature"] = dims, np.array(lamps), {"units": "K"}
    return simulation.observe(scene, QUIET, rng), scene["object_temperature"]


# Of a fine picture, what is left of a shift may look like a blur.
@pytest.mark.filterwarnings("ignore:The bands are not equally sharp")
@pytest.mark.parametrize(("shift", "texture"), [(4, 5.0), (12, 3.0)])
def test_a_switched_lamp_shows_the_shift(shift: int, texture: float) -> None:
    """Its picture is displaced between cameras apart, though it changes everywhere at once."""
    capture, _ = lamp(1, shift, texture, [[0.6, 0.7]] * 2)
    field = alignment.reflection_shift(capture, QUIET)
    error, _ = errors(field, np.full((2, 64, 80), [[[0.0]], [[float(shift)]]]))
    assert error.shape[1] > 0.95 * 64 * (80 - shift)  # of the pixels that have a pair
    assert np.median(np.abs(error), axis=1).max() < 0.05
    result = separation.separate(capture, QUIET)
    assert result.attrs["reflection_shift"] == "found"


@pytest.mark.parametrize("seed", [1, 2])
def test_a_border_of_materials_does_not_bend_the_shift_before_a_lamp(seed: int) -> None:
    """One function of time does not tell a border from the lamp's picture; the pixels around do."""
    capture, warm = lamp(seed, 4, 4.0, [[0.6, 0.7], [0.85, 0.65]])
    field = alignment.reflection_shift(capture, QUIET)
    error, _ = errors(field, np.full((2, 64, 80), [[[0.0]], [[4.0]]]))
    off = np.sqrt(np.mean(error**2, axis=1))
    print(f"{off} pixel off")
    assert off.max() < 0.05
    holds(separation.separate(capture, QUIET), warm)


def test_the_last_pair_of_displaced_cameras_is_in_the_bars() -> None:
    """Beyond it, the object's change from place to place holds the slow part of a lamp's light."""
    capture, warm = lamp(3, 6, 4.0, [[0.6, 0.7]] * 2, bend=0.6)
    holds(separation.separate(capture, QUIET), warm)


def holds(result: xr.Dataset, warm: xr.DataArray) -> None:
    """Check that a shift is found, and intervals hold in most of the many pixels without a flag."""
    sound = result["status"].values == 0
    error = np.abs(result["object_temperature"].values - warm.values)
    share = np.mean((error < 1.96 * result["object_temperature_std"].values)[:, sound])
    print(f"{sound.mean():.2f} without a flag, {share:.3f} hold")
    assert result.attrs["reflection_shift"] == "found"
    assert sound.mean() > 0.85
    assert share > 0.92


@pytest.mark.parametrize("colour", [0.0, 1.0])
def test_coloured_clouds_are_not_displaced(colour: float) -> None:
    """What clouds show in one band alone, or an object that heats, is no shift between cameras."""
    rng, time, knots = np.random.default_rng(1), np.arange(350) / 10.0, np.arange(0.0, 45.0, 0.5)
    first, alone = np.cumsum(rng.normal(0.0, 1.0, (2, knots.size)), axis=1)
    skies = first - first.mean(), 1.48 * (first - first.mean()) + colour * (alone - alone.mean())
    shape = (time.size, 48, 64)
    moments = np.broadcast_to(time[:, np.newaxis, np.newaxis] + np.linspace(8.0, 0.0, 64), shape)
    rise = np.linspace(10.0, 20.0, 48)[:, np.newaxis] * (1.0 - np.exp(-time / 12.0))[:, None, None]
    warm = np.broadcast_to(290.0 + rise, shape)
    scene = simulation.scene(time, warm, warm, GLASS)
    clouds = [np.interp(moments, knots, 286.0 + sky) for sky in skies]
    dims = ("band", *scene["object_temperature"].dims)
    scene["background_temperature"] = dims, np.array(clouds), {"units": "K"}
    capture = simulation.observe(scene, RESPONSE, rng)
    field = alignment.reflection_shift(capture, RESPONSE)
    assert np.median(np.abs(errors(field, np.zeros((2, 48, 64)))[1]), axis=1).max() < 3.0
    result = heard(lambda: separation.separate(capture, RESPONSE)).result
    assert result.attrs["reflection_shift"] == "none"
