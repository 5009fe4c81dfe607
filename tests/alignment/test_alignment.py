"""Alignment of two cameras in time: offsets estimated and undone, lost frames left missing."""

from itertools import product
from typing import Any

import numpy as np
import pytest
import xarray as xr
from captures import GLASS, RIG, drop_frames, plain_capture, still, transform_of
from hypothesis import given, settings
from hypothesis import strategies as st
from marks import slow
from refused import assert_refused, refused
from scipy.interpolate import BarycentricInterpolator

from dbthermal import separation
from dbthermal.alignment import align, exposure_times, fill_times, time_offset
from dbthermal.simulation import Background
from reproduction.disturbances import expose
from reproduction.experiments.cases import independent_pixels

FRAMES, STEPS, START = 350, 20, 80
PERIOD = 0.1
FINE = np.arange(STEPS * (FRAMES + 10)) * PERIOD / STEPS


def repeat_frames(capture: xr.Dataset, lost: np.ndarray) -> xr.Dataset:
    """Capture in which each lost frame (band, time) is a copy of the one before, unstamped."""
    counts = capture["counts"].copy(deep=True)
    for band, frame in np.argwhere(lost):
        counts.values[band, frame] = counts.values[band, frame - 1]
    return capture.drop_vars("exposure_time", errors="ignore").assign(counts=counts)


def glass(
    pixels: int = 400, stop: float = 333.15, seed: int = 3, **background: object
) -> xr.Dataset:
    """Glass that warms from 20 C, on a clock of 20 steps a frame."""
    rng, moves = np.random.default_rng(seed), Background(**background)  # type: ignore[arg-type]
    return independent_pixels(FINE, GLASS, moves, pixels, rng, start=293.15, stop=stop)


def exposed(
    scene: xr.Dataset, offsets: Any, frames: int = FRAMES, seed: int = 1, every: Any = STEPS
) -> xr.Dataset:
    """Stamped capture of a scene, the bands exposed from so many steps on."""
    rng = np.random.default_rng(seed)
    return expose(scene, RIG.response(), rng, every=every, offsets=offsets, frames=frames)


def recorded(
    scene: xr.Dataset, delay: float, *, stamped: bool = False, seed: int = 1
) -> xr.Dataset:
    """Capture in which the second band is so many frames late."""
    capture = exposed(scene, (START, START + round(delay * STEPS)), seed=seed)
    return capture if stamped else capture.drop_vars("exposure_time")


def object_rmse(scene: xr.Dataset, capture: xr.Dataset) -> float:
    """Root mean square over time of the object's error, median over the pixels [K]."""
    result = separation.solve(capture, RIG.response())["object_temperature"]
    error = result - scene["object_temperature"].interp(time=result["time"])
    return float(((error**2).mean("time") ** 0.5).median())


def ramp(bands: int = 2, frames: int = 40) -> xr.Dataset:
    """Counts that rise by 10 a second, and noise that tells the frames apart, in 16 pixels."""
    time = np.arange(frames) * PERIOD
    counts = np.broadcast_to(10.0 * time[:, np.newaxis, np.newaxis], (bands, frames, 4, 4))
    names = [f"b{band}" for band in range(bands)]
    return plain_capture(counts.astype(np.float32), time, names)


@pytest.fixture(scope="module")
def scene() -> xr.Dataset:
    """Glass to 60 C, someone walking by."""
    return glass()


@pytest.mark.parametrize(
    ("walk", "delay", "within"),  # an offset of 400 pixels scatters by 0.01 frame
    [(None, delay, 0.04) for delay in (0, 0.3, 0.5, 1, 1.7, 2, 3, -0.75)]
    + [(time, delay, 0.1) for time in (0.3, 3.0, 30.0) for delay in (0.3, 1.5)],
)
def test_time_offset_is_found(
    scene: xr.Dataset, walk: float | None, delay: float, within: float
) -> None:
    """The offset is found with its sign, of a background that steps or walks at random."""
    moves = scene if walk is None else glass(kind="random walk", correlation_time=walk)
    error = time_offset(recorded(moves, delay)) / PERIOD - delay
    assert abs(error) < within


def lacking(kind: str, seed: int) -> np.ndarray:
    """Frames (band, time), 10 to 40 %, that one band lacks at an end, the middle or in blocks."""
    rng = np.random.default_rng(seed)
    lost = np.zeros((2, FRAMES), dtype=bool)
    row = lost[rng.integers(2)]
    width = rng.integers(FRAMES // 10, 2 * FRAMES // 5)
    if kind == "several":
        for first in rng.integers(0, FRAMES - width // 4, 4):
            row[first : first + width // 4] = True
    else:
        first = {"start": 0, "end": FRAMES - width, "middle": rng.integers(20, FRAMES - 20 - width)}
        row[first[kind] : first[kind] + width] = True
    return lost


KINDS = ("start", "middle", "end", "several")
LACKING = slow(*product(KINDS, (-3, -1.5, -0.75, 0, 0.3, 0.5, 1, 1.7, 3), [5]))
LATE = slow(*zip((-2.4, -0.75, 0.3, 1.5, 3.0), ("whole", *KINDS), [(4, 5)] * 5, strict=True))


@pytest.mark.parametrize(
    ("kind", "delay", "seed"),
    [("start", -3, 1), ("middle", 0.5, 2), ("end", -1.7, 3), ("several", 2.25, 4), *LACKING],
)
@pytest.mark.parametrize("driver", ["nan", "stamps"])
def test_a_block_of_frames_of_one_band(
    scene: xr.Dataset, kind: str, delay: float, seed: int, driver: str
) -> None:
    """Where one band lacks 10 to 40 % of its frames the offset is right within a tenth."""
    capture, lost = recorded(scene, delay, stamped=driver == "stamps"), lacking(kind, seed)
    if driver == "stamps":
        capture, delay = drop_frames(capture, lost), 0.0
    else:
        capture["counts"].values[lost] = np.nan
    error = time_offset(capture) / PERIOD - delay
    assert abs(error) < 0.1


def test_times_that_are_wrong(scene: xr.Dataset) -> None:
    """Times 3 s apart that are not right are named with the remedies, of which two help."""
    capture = recorded(scene, 0, stamped=True)
    capture["exposure_time"][1] += 3.0
    begin = capture["exposure_time"].values[:, 0]
    expected = rf"times begin at {begin[1]:.4g} and {begin[0]:.4g} s: .* search farther by search="
    assert_refused(expected, align, capture)
    found = align(capture, search=60).attrs["time_offset"][1]
    assert abs(found + 3.0) < 0.1 * PERIOD
    assert align(capture, offset=-3.0).attrs["time_offset"] == [0.0, -3.0]


@pytest.mark.parametrize(("delay", "kept"), [(0.05, True), (0.4, False)])
def test_a_stated_offset_is_kept_or_contradicted(
    scene: xr.Dataset, delay: float, kept: bool
) -> None:
    """An offset that was stated at the import is kept within a tenth of a frame, or it warns."""
    capture = recorded(scene, delay).assign_attrs(offset=0.0, offset_by="caller")
    if kept:
        assert align(capture).attrs["time_offset"] == [0.0, 0.0]
        return
    with pytest.warns(UserWarning, match=r"stated offset .*, 0\.0 s, is contradicted by .*\+- 0"):
        aligned = align(capture)
    assert abs(aligned.attrs["time_offset"][1] - delay * PERIOD) < 0.04 * PERIOD
    assert aligned.attrs["time_offset_std"] < 0.04 * PERIOD
    assert align(capture, offset=0.0).attrs["time_offset"] == [0.0, 0.0]


def test_shutter_steps_are_no_motion(scene: xr.Dataset) -> None:
    """A step in both bands after a shutter event does not pull the offset to zero."""
    capture, segment = recorded(scene, 1.5), (np.arange(FRAMES) >= 150).astype(np.int64)
    capture["counts"].values[...] += 60.0 * segment[:, np.newaxis, np.newaxis]  # [count]
    error = time_offset(capture.assign(segment=("time", segment))) / PERIOD - 1.5
    assert abs(error) < 0.06


@pytest.mark.parametrize("seed", range(20))
def test_noise_gives_no_offset_by_chance(seed: int) -> None:
    """A capture in which nothing moves gives no offset."""
    noise = ramp(frames=100)
    noise["counts"].values[...] = np.random.default_rng(seed).normal(size=noise["counts"].shape)
    assert_refused(r"no rapid change that both|the end of the search", time_offset, noise)


@pytest.mark.parametrize(
    ("stop", "delay"),
    [
        *((318.15, 0.5), (333.15, 1.7), (318.15, 3)),
        *slow((318.15, 0.3), (318.15, 1.7), (333.15, 0.5), (333.15, 1), (333.15, 3)),
    ],
)
def test_offset_is_undone(stop: float, delay: float) -> None:
    """Aligned, the object is within 20 % of a synchronous capture of the same frames."""
    warm = glass(stop=stop)
    capture = recorded(warm, delay)
    aligned = align(capture)
    late = exposed(warm, [START + round(delay * STEPS)] * 2)
    values = [object_rmse(warm, one) for one in (late, aligned, capture)]
    assert aligned.attrs["clock"] == "9.5"
    assert aligned.sizes["time"] == FRAMES
    assert values[1] < 1.2 * values[0]


@pytest.mark.parametrize(("delay", "kind", "seeds"), [(0.5, "middle", (3, 4)), *LATE])
def test_intervals_hold_after_an_alignment(delay: float, kind: str, seeds: tuple[int, ...]) -> None:
    """95 % intervals hold in 93 to 97 %, of interpolated frames and where a band lacks a block."""
    scores = []
    for seed in seeds:
        warm = glass(seed=seed)
        capture = recorded(warm, delay, seed=seed)
        if kind != "whole":
            capture["counts"].values[lacking(kind, seed)] = np.nan
        result = separation.solve(align(capture), RIG.response())
        truth = warm["object_temperature"].interp(time=result["time"])
        score = abs(result["object_temperature"] - truth) / result["object_temperature_std"]
        unflagged = score.values[:, result["status"].values == 0]
        scores.append(unflagged[np.isfinite(unflagged)])
    covered = float(np.mean(np.concatenate(scores) < 1.96))
    assert 0.93 <= covered <= 0.97


def test_noise_factor_is_that_of_the_interpolation() -> None:
    """White noise between two frames is lessened as the factor says, and the separation uses it."""
    capture = ramp(frames=400)
    capture["counts"].values[...] = np.random.default_rng(1).normal(size=capture["counts"].shape)
    aligned = align(capture, offset=0.3 * PERIOD, clock="b1")
    factor = aligned["noise_factor"].values
    line = np.sqrt(0.3**2 + 0.7**2)
    assert line - 1e-3 <= factor[0] <= 1.2 * line  # noise alone does not tell a line from a curve
    assert factor[1] == 1.0
    scatter = np.nanstd(aligned["counts"].values, axis=(1, 2, 3))
    np.testing.assert_allclose(scatter, factor, rtol=0.04, atol=0)


def test_noise_factor_of_a_warp() -> None:
    """Interpolation over pixels lessens noise and residual pattern of the warped band alone."""
    capture = still(level=0.0, count=100, noise=1.0).assign(pattern_std=("band", [3.0, 3.0]))
    transform = transform_of([[1.0, 0.0, 0.5], [0.0, 1.0, 0.25], [0.0, 0.0, 1.0]])  # [pixel]
    aligned = align(capture, offset=0.0, transform=transform)
    factor = aligned["noise_factor"].values
    # Lines between pixels and, where there are six pixels either way, polynomials through these.
    through = BarycentricInterpolator(np.arange(6), np.eye(6))
    fine = np.prod([np.sum(through(2.0 + part) ** 2) for part in (0.5, 0.25)])
    rows, columns = capture.sizes["y"] - 1, capture.sizes["x"] - 1
    middle = (rows - 4) * (columns - 4) / (rows * columns)
    mean = middle * fine + (1.0 - middle) * 0.5 * 0.625
    np.testing.assert_allclose(factor, [1.0, np.sqrt(mean)], rtol=0, atol=1e-6)
    np.testing.assert_allclose(aligned["pattern_std"], 3.0 * factor, rtol=0, atol=1e-6)
    noise = aligned["counts"].std("time").mean(("y", "x"))
    np.testing.assert_allclose(noise, factor, rtol=0.02, atol=0)


@pytest.mark.parametrize("driver", ["stamps", "copies"])
def test_dropped_frames(scene: xr.Dataset, driver: str) -> None:
    """With 5 % of either band's frames lost the object is within 20 % of the whole capture."""
    whole = recorded(scene, 0.3, stamped=True)
    lost = np.random.default_rng(8).random((2, FRAMES)) < 0.05
    lost[:, 0] = False
    stamps = driver == "stamps"
    aligned = (
        align(drop_frames(whole, lost), offset=0.0) if stamps else align(repeat_frames(whole, lost))
    )
    reference, value = (object_rmse(scene, one) for one in (recorded(scene, 0), aligned))
    assert value < 1.2 * reference
    assert min(aligned.attrs["frames_lost"]) >= lost.sum(axis=1).min() - 1


def test_different_rates(scene: xr.Dataset) -> None:
    """Cameras of 10 and 9.5 frames/s with stamps; a lag beyond the stamps is found as well."""
    capture = exposed(scene, (START, START), frames=330, every=(STEPS, STEPS + 1))
    wrong = capture["exposure_time"].copy()
    wrong[1] -= 0.7 * PERIOD
    offset = time_offset(capture.assign(exposure_time=wrong))
    aligned = align(capture, offset=0.0)
    values = [object_rmse(scene, one) for one in (recorded(scene, 0), aligned)]
    assert offset == pytest.approx(0.07, abs=0.01)
    assert values[1] < 1.2 * values[0]


@given(frames=st.integers(-7, 7))
def test_whole_frames_are_a_pure_shift(frames: int) -> None:
    """An offset of whole frames moves samples and changes none."""
    capture = ramp()
    capture["counts"].values[...] = np.random.default_rng(1).normal(size=capture["counts"].shape)
    aligned = align(capture, offset=0.3 * frames / 3, clock="b1")
    shifted = capture["counts"].isel(band=0).shift(time=-frames)
    np.testing.assert_array_equal(aligned["counts"].isel(band=0).values, shifted.values)
    np.testing.assert_array_equal(aligned["counts"][1], capture["counts"][1])


@given(st.floats(-1.0, 1.0), st.lists(st.floats(-0.02, 0.02), min_size=80, max_size=80))
@settings(max_examples=30)
def test_a_line_is_kept(offset: float, jitter: list[float]) -> None:
    """A linear ramp is interpolated exactly at any stamps and offset, and never extrapolated."""
    capture = ramp()
    stamps = capture["time"].values + np.reshape(jitter, (2, 40))
    seen = stamps + np.array([[0.0], [offset]])
    capture["counts"].values[...] = 10.0 * seen[..., np.newaxis, np.newaxis]
    capture["exposure_time"] = (("band", "time"), stamps)
    aligned = align(capture, offset=offset, clock="b1")
    known = aligned["counts"].isel(band=0, y=0, x=0).dropna("time")
    # A sample within a hundredth of a frame is taken as it is: 0.001 s of 10 count/s.
    np.testing.assert_allclose(known, 10.0 * known["time"], rtol=0, atol=0.0145)
    assert known["time"].size >= 40 - abs(offset) / PERIOD - 3
    np.testing.assert_array_equal(aligned["time"], seen[1])


@pytest.mark.parametrize("missing", [None, 21])
def test_a_wave_keeps_its_crests(missing: int | None) -> None:
    """A curve at uneven stamps has a third of a line's error; beside a lost frame it is a line."""
    capture = ramp()
    stamps = capture["time"].values + 0.1 * PERIOD * np.random.default_rng(1).uniform(-1.0, 1.0, 40)

    def wave(time: np.ndarray) -> np.ndarray:
        return 100.0 * np.sin(2.0 * np.pi * time / (8.0 * PERIOD))

    capture["exposure_time"] = (("band", "time"), np.stack([stamps, stamps]))
    capture["counts"].values[...] = wave(stamps)[:, np.newaxis, np.newaxis]
    if missing is not None:
        capture["counts"].values[0, missing] = np.nan
    aligned = align(capture, offset=0.5 * PERIOD, clock="b1")
    found, wanted = aligned["counts"].values[0, :, 0, 0], aligned["time"].values
    lines = np.interp(wanted, stamps, wave(stamps))
    curved = np.abs(found - lines) > 1e-3
    if missing is not None:
        assert np.isnan(found[missing - 1 : missing + 1]).all()
        assert not curved[[missing - 2, missing + 1]].any()
    assert curved[2:18].all()
    error, before = (np.abs(it - wave(wanted))[2:18].max() for it in (found, lines))
    assert error < 0.3 * before


def test_gaps_are_not_bridged() -> None:
    """NaN frames, copies and holes in the stamps stay holes, and only the frames next to them."""
    capture = ramp()
    capture["counts"].values[0, 10] = np.nan
    capture["counts"].values[0, 21] = capture["counts"].values[0, 20]
    aligned = align(capture, offset=0.25 * PERIOD, clock="b1")["counts"]
    holes = np.flatnonzero(np.isnan(aligned.values[0]).any(axis=(1, 2)))
    assert holes.tolist() == [9, 10, 20, 21, 39]
    assert not np.isnan(aligned.values[1]).any()
    exact = align(capture, offset=0.0)["counts"]
    assert np.flatnonzero(np.isnan(exact.values[0]).any(axis=(1, 2))).tolist() == [10, 21]


def test_a_step_does_not_swing() -> None:
    """A curve would overshoot beside a sudden step: no sample there, and none of it in the rest."""
    capture = ramp()
    wave = np.sin(2.0 * np.pi * np.arange(40.0) / 8.0)[:, np.newaxis, np.newaxis]
    capture["counts"].values[...] = wave
    capture["counts"].values[:, 20:, 1, 2] += 100.0
    aligned = align(capture, offset=0.5 * PERIOD, clock="b1")["counts"].values[0]
    stepped, rest = aligned[:, 1, 2], aligned[:, 0, 0]
    assert np.flatnonzero(np.isnan(rest)).tolist() == [39]
    assert np.flatnonzero(np.isnan(stepped)).tolist() == [18, 19, 20, 39]
    np.testing.assert_allclose(stepped[:18], rest[:18], rtol=0, atol=1e-5)
    np.testing.assert_allclose(stepped[21:39], rest[21:39] + 100.0, rtol=0, atol=1e-4)


def test_frames_beside_lost_ones_are_not_bridged() -> None:
    """The frame period is that of the slots: with most stamps lost, no pause counts as a step."""
    capture = ramp(frames=400)
    stamps = np.stack([capture["time"].values] * 2)
    stamps[0, np.random.default_rng(1).random(400) < 0.95] = np.nan
    capture["counts"].values[0, np.isnan(stamps[0])] = np.nan
    capture["exposure_time"] = ("band", "time"), stamps
    there = align(capture, offset=0.03, clock="b1")["counts"].notnull().all(("y", "x")).values[0]
    pairs = np.isfinite(stamps[0])[:-1] & np.isfinite(stamps[0])[1:]
    assert there.sum() <= pairs.sum()


def test_segments_are_not_mixed() -> None:
    """No frame is made of samples from both sides of a shutter event, or moved across one."""
    segment = ("time", (np.arange(40) >= 20).astype(np.int64))
    capture = ramp().assign(segment=segment)
    half = align(capture, offset=1.5 * PERIOD, clock="b1")
    assert np.flatnonzero(half["counts"].isnull().any(("y", "x"))[0]).tolist() == [18, 19, 38, 39]
    assert half["segment"].values.tolist() == segment[1].tolist()


def test_three_bands() -> None:
    """Each band has an offset of its own against the first."""
    capture = ramp(3)
    late = xr.DataArray([0.0, 0.02, -0.04], {"band": ["b0", "b1", "b2"]}, "band")
    counts = 10.0 * (capture["time"].values + late.values[:, np.newaxis])
    capture["counts"].values[...] = counts[..., np.newaxis, np.newaxis]
    aligned = align(capture, offset=late, clock="b1")
    middle = aligned["counts"].isel(time=slice(2, 38), y=0, x=0)
    expected = np.broadcast_to(10.0 * middle["time"].values, middle.shape)
    np.testing.assert_allclose(middle, expected, rtol=0, atol=1e-5)


def test_what_was_done_is_written_down(scene: xr.Dataset) -> None:
    """Attributes hold the clock, the offsets and the lost frames; the capture is not changed."""
    capture = recorded(scene, 0.5, stamped=True)
    before = capture.copy(deep=True)
    aligned = align(capture)
    xr.testing.assert_identical(capture, before)
    assert "exposure_time" not in aligned
    assert aligned.attrs["clock"] == "9.5"
    assert aligned.attrs["time_offset"] == pytest.approx([0.0, 0.0], abs=0.1 * PERIOD)
    assert aligned.attrs["frames_lost"] == [1, 0]
    assert aligned["counts"].dtype == np.float32


def unordered() -> xr.Dataset:
    """A ramp whose second band's stamps step back."""
    stamps = np.tile(ramp()["time"].values, (2, 1))
    stamps[1, 5] = 0.0
    return ramp().assign(exposure_time=(("band", "time"), stamps))


def half_lost(scene: xr.Dataset) -> xr.Dataset:
    """Capture in which the second band lacks 200 of 350 frames."""
    capture = recorded(scene, 0.5)
    capture["counts"].values[1, 100:300] = np.nan
    return capture


TEXT: Any = "0.1"
HALF: Any = 2.5
NOTHING: Any = None
MILLISECONDS = xr.DataArray([0.0, 20.0], {"band": ["b0", "b1"]}, "band", attrs={"units": "ms"})


test_what_gives_no_alignment = refused(
    lambda scene, call: call(scene),
    [
        (lambda s: time_offset(half_lost(s)), r"'9.5': 57 % are missing, .* share 43 %. Must sha"),
        (lambda _: time_offset(recorded(glass(kind="still"), 0)), r"no rapid change|Must be known"),
        (lambda s: time_offset(recorded(s, 3), search=2), r"at .*2 frames, the end of the search"),
        (lambda s: recorded(s, 20), "Must increase and lie in"),
        (lambda _: align(unordered(), offset=0.0), r"exposure times of band 'b1': 0\.4 s"),
        (lambda _: align(ramp(), offset=10.0, clock="b1"), r", 10\.0\] s: it leaves no frame"),
        (lambda _: align(ramp(), offset=-10.0, clock="b1"), r", -10\.0\] s: it leaves no frame"),
        (lambda _: align(ramp(), offset=np.nan), r"Invalid offset \[0\.0, nan\] s"),
        (lambda _: align(ramp(), offset=TEXT), r"Invalid offset \[s\] '0.1'"),
        (lambda _: align(ramp(), offset=MILLISECONDS), "Invalid units 'ms' of the time offset"),
        (lambda _: align(ramp(), offset=0.1, clock="7"), r"Unknown clock '7'\. Must be one of"),
        (lambda _: align(ramp(3), offset=0.1), "Must be one for each"),
        (lambda _: time_offset(ramp(), band="b0"), r"band 'b0'\. Must be another than the fi"),
        (lambda _: time_offset(ramp(), search=11), r"Invalid search \[frame\] 11"),
        (lambda _: time_offset(ramp(), search=HALF), r"search \[frame\] 2.5. Must be a whole num"),
        (lambda _: exposure_times(ramp().drop_vars("counts")), "Missing variable 'counts'"),
        (lambda _: fill_times(NOTHING), r"Invalid exposure times \[s\] None"),
    ],
    "scene",
)


def test_filled_stamps_increase() -> None:
    """A slot without a frame lies between its neighbours, or a period beyond the last."""
    filled = fill_times(np.array([np.nan, 0.0, 0.1, np.nan, 0.3, 0.4, np.nan, np.nan]))
    np.testing.assert_allclose(filled, np.arange(-1, 7) / 10.0, rtol=0, atol=1e-12)


def test_nothing_is_left_on_the_clocks_before() -> None:
    """Variables on the old clock are dropped."""
    told = (("band", "time"), np.zeros((2, 40)), {"units": "count"})
    aligned = align(ramp().assign(drift=told), offset=0.02)
    assert set(aligned.data_vars) == {"counts", "noise_factor"}
