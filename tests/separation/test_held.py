"""`separate` on scenes in which pooling led astray: no pixel is right alone and wrong pooled."""

import numpy as np
import pytest
import xarray as xr
from scipy.ndimage import gaussian_filter
from test_displaced import SMALL, film

from dbthermal import separation, simulation
from dbthermal.alignment._reflections import seen_apart
from dbthermal.schema import Status
from dbthermal.separation._separate import _pixels_apart, _unflagged, cameras_apart
from reproduction.experiments.pictures import smooth_shift

RIG = simulation.Rig()
TIME = np.arange(240) / 15.0
SHAPE = (32, 44)
Y, X = np.indices(SHAPE)
MADE = np.uint32(
    Status.COMPLETED_FROM_MATERIAL
    | Status.COMPLETED_FROM_PRIOR
    | Status.COMPLETED_FROM_SURROUNDINGS
)


def materials(*pairs: tuple[float, float], of: np.ndarray) -> xr.DataArray:
    """Emissivities (band, y, x) of materials by their number (y, x)."""
    return xr.DataArray(
        np.array(pairs).T[:, of], {"band": list(RIG.bands)}, dims=("band", "y", "x")
    )


def judged(scene: xr.Dataset, result: xr.Dataset, name: str) -> tuple[float, float, float]:
    """Share of measured pixels, what their 95 % intervals hold, and the share of silent errors."""
    off = (result["object_temperature"] - scene["object_temperature"]).values
    std = result["object_temperature_std"].values
    good = result["status"].values == 0
    held = float((np.abs(off) < 1.96 * std)[:, good].mean())
    size, bar = (np.sqrt(np.mean(one.astype(float) ** 2, axis=0)) for one in (off, std))
    silent = float(((size > 4.0 * bar) & (size > 0.3))[good].mean())
    print(f"{name}: measured {good.mean():.2f}, intervals {held:.3f}, silent {silent:.4f}")
    return float(good.mean()), held, silent


@pytest.mark.parametrize("seed", [2, 5])
def test_materials_are_not_joined_where_nothing_moves(seed: int) -> None:
    """One above the other, both hot, people mirrored on the right: each has its own values."""
    rng, rig = np.random.default_rng(seed), simulation.Rig(noise=(0.05, 0.1), highest=403.0)
    pairs = materials((0.95, 0.88), (0.6, 0.45), of=np.where(16 + 2 * np.sin(X / 6) > Y, 0, 1))
    scene = simulation.walkers(TIME, SHAPE, pairs, rng, temperatures=(300.0, 308.0, 302.0))
    scene["object_temperature"] += 40.0
    room = scene["background_temperature"].min("time")
    share = xr.DataArray(0.5 * (1.0 + np.tanh((X - 0.5 * SHAPE[1]) / 2.0)), dims=("y", "x"))
    scene["background_temperature"] = room + share * (scene["background_temperature"] - room)
    scene["background_temperature"] = scene["background_temperature"].transpose("time", "y", "x")
    capture = simulation.observe(scene, rig.response(), rng)
    part, held, silent = judged(scene, separation.separate(capture, rig.response()), "half still")
    assert part > 0.3
    assert held > 0.92
    assert silent < 0.01


@pytest.mark.parametrize("seed", [1, 2])
def test_an_undulating_emissivity_is_in_the_bars(seed: int) -> None:
    """Emissivities that undulate over some pixels, seen by slow and weak reflections."""
    rng = np.random.default_rng(seed)
    wave = gaussian_filter(rng.standard_normal(SHAPE), 4.0)
    wave *= 0.02 / wave.std()
    pairs = materials((0.9, 0.8), of=np.zeros(SHAPE, dtype=int)) + xr.DataArray(
        np.stack([wave, 0.4 * wave]), dims=("band", "y", "x")
    )
    scene = simulation.walkers(TIME, SHAPE, pairs, rng, temperatures=(295.0, 302.0, 310.0))
    slow = gaussian_filter(rng.standard_normal((TIME.size, *SHAPE)), (8, 5, 5))
    scene["background_temperature"][:] = 295.0 + 2.0 * slow / slow.std()
    capture = simulation.observe(scene, RIG.response(), rng)
    _, held, silent = judged(scene, separation.separate(capture, RIG.response()), "undulating")
    assert held > 0.92
    assert silent < 0.01


def test_a_hot_part_that_rests_is_told_by_its_material() -> None:
    """Half of a hot plate does not change: its background is that of its material's emissivity."""
    rng = np.random.default_rng(3)
    pairs = materials((0.93, 0.8), of=np.zeros(SHAPE, dtype=int))
    scene = simulation.walkers(TIME, SHAPE, pairs, rng, temperatures=(295.0, 305.0, 366.0))
    still = xr.DataArray(0.5 * SHAPE[1] > X, dims=("y", "x"))
    film = scene["object_temperature"]
    scene["object_temperature"] = film.where(~still, 363.0).transpose(*film.dims)
    response = simulation.Rig(highest=403.0).response()
    result = separation.separate(simulation.observe(scene, response, rng), response)
    share, held, silent = judged(scene, result, "hot")
    assert share > 0.8
    assert held > 0.92
    assert silent == 0.0


@pytest.mark.parametrize("seed", [1, 2])
def test_bars_of_weak_reflections_are_those_of_their_noise(seed: int) -> None:
    """Most pixels are gray alone; the few that are not are off by selection, and widen nothing."""
    rng = np.random.default_rng(seed)
    pairs = materials((0.95, 0.85), of=np.zeros(SHAPE, dtype=int))
    scene = simulation.walkers(TIME, SHAPE, pairs, rng, temperatures=(295.0, 297.0, 310.0))
    capture = simulation.observe(scene, RIG.response(), rng)
    alone = separation.solve(capture, RIG.response())
    gray = float(((alone["status"] & np.uint32(Status.GRAY)) != 0).mean())
    result = separation.separate(capture, RIG.response(), alone=alone)
    _, held, silent = judged(scene, result, f"weak, {gray:.2f} gray alone")
    off = result["object_temperature"] - scene["object_temperature"]
    square = (off / result["object_temperature_std"]).where(result["status"] == 0) ** 2
    print(f"mean square in deviations {float(square.mean()):.2f}")
    assert result.attrs["reflection_shift"] == "none"
    assert "warnings" not in result.attrs
    assert gray > 0.5
    assert 0.92 < held < 0.98
    assert float(square.mean()) > 0.7
    assert silent < 0.01


def slow_and_apart(shift: int, seed: int) -> tuple[xr.Dataset, xr.Dataset]:
    """Scene whose reflections change over seconds, and what cameras see of it, shifted [pixel]."""
    rng = np.random.default_rng(seed)
    pairs = materials((0.92, 0.84), of=np.zeros(SHAPE, dtype=int))
    scene = simulation.walkers(TIME, SHAPE, pairs, rng, temperatures=(295.0, 302.0, 310.0))
    slow = gaussian_filter(rng.standard_normal((TIME.size, SHAPE[0], SHAPE[1] + 8)), (6, 5, 5))
    slow = 296.0 + 2.0 * slow / slow.std()
    views = []
    for start in (0, shift):
        seen = scene.copy(deep=True)
        seen["background_temperature"][:] = slow[:, :, start : start + SHAPE[1]]
        views.append(simulation.observe(seen, RIG.response(), rng))
    both = views[0].copy(deep=True)
    both["counts"][1] = views[1]["counts"][1]
    return scene, both


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_slow_reflections_are_seen_apart(seed: int) -> None:
    """Bands that change at the same time, but elsewhere: found by their displacement."""
    response = RIG.response()
    assert cameras_apart(slow_and_apart(0, seed)[1], response)[0] == 0.0
    scene, capture = slow_and_apart(4, seed)
    assert cameras_apart(capture, response)[0] > 0.5
    result = separation.separate(capture, response)
    assert result.attrs["reflection_shift"] == "found"
    _, held, silent = judged(scene, result, "slow reflections, apart")
    assert held > 0.9
    assert silent < 0.01


def test_a_response_of_another_band_is_warned_of() -> None:
    """Counts outside the response: a warning that stays, and no completed value without a flag."""
    rng = np.random.default_rng(4)
    pairs = materials((0.86, 0.72), of=np.zeros((8, 12), dtype=int))
    scene = simulation.walkers(TIME, (8, 12), pairs, rng)
    capture, response = simulation.observe(scene, RIG.response(), rng), RIG.response()
    exchanged = response.assign_coords(band=response["band"].values[::-1])
    with pytest.warns(UserWarning, match="lie outside"):
        result = separation.separate(capture, exchanged)
    assert any("lie outside" in one for one in result.attrs["warnings"])
    made = (result["status"].values & MADE) != 0
    beyond = (result["status"].values & np.uint32(Status.OUTSIDE_RESPONSE)) != 0
    assert made.any()
    assert beyond[made].mean() > 0.9


def test_a_result_in_per_cent_is_not_completed() -> None:
    """Emissivities of measured pixels lie between 0 and 1, or the result is refused."""
    rng = np.random.default_rng(6)
    pairs = materials((0.86, 0.72), of=np.zeros((8, 12), dtype=int))
    scene = simulation.walkers(TIME, (8, 12), pairs, rng)
    capture, response = simulation.observe(scene, RIG.response(), rng), RIG.response()
    result = separation.solve(capture, response)
    wrong = result.assign(emissivity=100.0 * result["emissivity"])
    with pytest.raises(ValueError, match=r"Invalid emissivity \d+.* of the result"):
        separation.complete(wrong, capture, response)


@pytest.mark.parametrize("slow", [True, False])
def test_what_has_no_samples_hides_no_displacement(slow: bool) -> None:
    """Cameras are told apart by the measured pixels, however few of the image these are."""
    if slow:
        capture = slow_and_apart(4, 1)[1]
    else:
        capture = film(SMALL, smooth_shift(SMALL.shape, 2.4, 1.2), 4)[1]
    around = {dim: (capture.sizes[dim], 5 * capture.sizes[dim]) for dim in ("y", "x")}
    padded = capture.drop_vars(["y", "x"], errors="ignore").pad(around, constant_values=np.nan)
    shares, good = zip(
        *(cameras_apart(one, RIG.response()) for one in (capture, padded)), strict=True
    )
    print(f"{shares[0]:.2f} of the pixels apart, {shares[1]:.2f} in a part of the image")
    assert min(shares) > 0.3
    # What a shift leaves without a flag is compared with this, of other pixels of the same scene.
    every = _unflagged(separation.solve(padded, RIG.response()))
    np.testing.assert_allclose(good, every, rtol=0, atol=0.05)


@pytest.mark.parametrize(("metal", "seed"), [((0.1, 0.15), 1), ((0.2, 0.18), 3), ((0.05, 0.06), 0)])
def test_a_metal_is_not_pooled_with_glass(metal: tuple[float, float], seed: int) -> None:
    """A gray metal tells no emissivity: its ratios alone say that it is not the glass beside it."""
    rng, of = np.random.default_rng(seed), 22.0 + 1.5 * np.sin(Y / 6.0 + seed) < X
    pairs = materials((0.86, 0.72), metal, of=of.astype(int))
    scene = simulation.walkers(
        TIME, SHAPE, pairs, rng, temperatures=(295.0, 305.0, 325.0), crossings=7
    )
    result = separation.separate(simulation.observe(scene, RIG.response(), rng), RIG.response())
    share, held, silent = judged(scene, result, f"{metal} beside glass")
    assert 0.4 < share < 0.55  # the glass, which is half of the picture
    assert held > 0.92
    assert silent < 0.01
    assert np.mean(result["status"].values[of] == 0) < 0.01  # at the border, of both


@pytest.mark.parametrize("ripple", [0.3, 1.0])
def test_a_plate_on_a_thermostat_is_no_constant_object(ripple: float) -> None:
    """It goes up and down before a room at rest: what changes is not what it mirrors."""
    heat, level, on = np.empty(TIME.size), 25.0, True
    for frame in range(TIME.size):
        level += ((40.0 if on else 0.0) - level) * (TIME[1] - TIME[0]) / 10.0
        on = level < 25.0 - ripple or (on and level < 25.0 + ripple)
        heat[frame] = level
    profile = np.exp(-((X / SHAPE[1] - 0.5) ** 2 + (Y / SHAPE[0] - 0.5) ** 2))
    plate, room = 295.0 + heat[:, np.newaxis, np.newaxis] * profile, np.full((1, *SHAPE), 295.0)
    pairs = materials((0.86, 0.72), of=np.zeros(SHAPE, dtype=int))
    scene = simulation.scene(TIME, plate, np.broadcast_to(room, plate.shape), pairs)
    capture = simulation.observe(scene, RIG.response(), np.random.default_rng(1))
    result = separation.separate(capture, RIG.response())
    off = abs(result["object_temperature"] - scene["object_temperature"])
    held = float((off < 1.96 * result["object_temperature_std"]).mean())
    print(f"ripple {ripple} K: median error {float(off.median()):.2f} K, intervals {held:.3f}")
    assert held > 0.97
    assert float(off.median()) < 1.0  # the camera's own reading is 2.4 K off
    status = result["status"].values
    both = np.uint32(Status.CONSTANT_OBJECT | Status.ROLES_MAY_BE_SWAPPED)
    assert np.mean((status & both) == np.uint32(Status.CONSTANT_OBJECT)) < 0.01


def shift_field(
    shift: tuple[float, float], std: tuple[float, float], known: np.ndarray
) -> xr.Dataset:
    """Shift of the reflections, the same at all pixels, where it is known (y, x)."""
    pairs = {"shift": shift, "shift_std": std}
    maps = {
        name: (("axis", "y", "x"), np.where(known, np.reshape(pair, (2, 1, 1)), np.nan))
        for name, pair in pairs.items()
    }
    return xr.Dataset({**maps, "known": (("y", "x"), known)}, {"axis": ["y", "x"]})


def test_a_shift_is_seen_along_one_axis() -> None:
    """Upright people tell a shift along the baseline, and none across it."""
    known = np.ones(SHAPE, dtype=bool)
    assert seen_apart(shift_field((1.3, 4.0), (10.0, 0.08), known))
    assert not seen_apart(shift_field((1.3, 0.2), (10.0, 0.08), known))
    assert not seen_apart(shift_field((0.05, 0.05), (0.01, 0.01), known))
    assert not seen_apart(shift_field((1.3, 4.0), (10.0, 0.08), ~known))


def test_pixels_without_a_pair_are_not_explained() -> None:
    """But for those whose pair lies beyond the image's end."""
    field = shift_field((0.0, 4.0), (0.1, 0.1), np.ones(SHAPE, dtype=bool))
    status = np.zeros(SHAPE, dtype=np.uint32)
    status[:, -4:] = Status.NO_REFLECTION_PAIR
    result = xr.Dataset({"status": (("y", "x"), status)})
    assert _pixels_apart(result, field) == (0, status.size)
    status[:, 10:20] = Status.NO_REFLECTION_PAIR
    assert _pixels_apart(result, field) == (10 * SHAPE[0], status.size)
    assert _pixels_apart(result) == (0, status.size)
