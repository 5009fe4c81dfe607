"""Shutter events, lost frames, drift, lag, bad pixels, clipped samples: each of known truth."""

from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import xarray as xr
from captures import RIG, drift, movie, plain_capture, still, walkers
from hypothesis import given, settings
from hypothesis import strategies as st
from marks import slow
from refused import refused

from dbthermal import schema, separation
from dbthermal.correction import (
    correct_capture,
    find_shutter,
    mark_bad,
    mark_shutter,
    undo_drift,
    undo_lag,
)
from dbthermal.schema import Status
from reproduction import disturbances
from reproduction.experiments import cases


@pytest.fixture(scope="module")
def clean() -> xr.Dataset:
    """350 frames at 10 Hz without a nuisance."""
    return walkers(1)


def rows(events: xr.Dataset) -> list[tuple[str, int, int, bool]]:
    """Events as tuples."""
    names = ("band", "first_frame", "frames", "renewed")
    return list(zip(*(events[name].values.tolist() for name in names), strict=True))


def test_shutter_events_are_found(clean: xr.Dataset) -> None:
    """Each shutter event of each camera is found with all of its frames, without false ones."""
    rng = np.random.default_rng(2)
    capture = disturbances.fire_shutter(clean, [8.0, 20.04], rng, duration=0.55)
    capture = disturbances.fire_shutter(capture, 30.0, rng, bands=("9.5",))
    before, events = capture.copy(deep=True), find_shutter(capture)
    both = [(band, first, 5, True) for first in (81, 201) for band in RIG.bands]
    assert rows(events) == [*both, ("9.5", 301, 5, True)]
    np.testing.assert_allclose(events["start"], [8.1, 8.1, 20.1, 20.1, 30.1], rtol=0, atol=1e-9)
    np.testing.assert_allclose(events["stop"] - events["start"], 0.4, rtol=0, atol=1e-9)  # [s]
    marked = mark_shutter(capture)
    xr.testing.assert_identical(capture, before)
    told = {"shutter_events": 5, "repeated_frames": 0, "frames_taken_out": [10, 15]}
    assert marked.attrs == {**capture.attrs, **told}
    assert marked["counts"].dtype == np.float32
    whole = capture.assign(counts=np.rint(capture["counts"]).astype(np.uint16))
    assert rows(find_shutter(whole)) == rows(events)
    gone = marked["counts"].isnull().any(("y", "x"))
    np.testing.assert_array_equal(gone.sum("time"), [10, 15])
    np.testing.assert_array_equal(marked["counts"], capture["counts"].where(~gone))
    np.testing.assert_array_equal(np.flatnonzero(np.diff(marked["segment"])), [85, 205, 305])
    assert marked["segment"].dtype.kind == "i"


def test_repeated_frames_are_found(clean: xr.Dataset) -> None:
    """All of the frames that a driver repeats are found; a lost one starts no segment."""
    capture = disturbances.lose_frames(clean, 0.05, np.random.default_rng(3))
    marked = mark_shutter(capture)
    found = np.isnan(marked["counts"].values).all(axis=(2, 3))
    np.testing.assert_array_equal(found, capture["repeated"])
    events = find_shutter(capture)
    np.testing.assert_array_equal(events["renewed"], events["frames"] > 1)
    lost = events.isel(event=~events["renewed"].values)
    assert not mark_shutter(capture, lost)["segment"].any()
    assert marked.attrs["repeated_frames"] == lost.sizes["event"]


def test_a_copy_is_a_copy_in_every_pixel() -> None:
    """One pixel that differs, off the pixels looked at first, makes a frame a real one."""
    rng = np.random.default_rng(0)
    counts = rng.normal(16000.0, 4.0, (1, 20, 200, 220)).astype(np.float32)
    counts[0, [7, 12]] = counts[0, [6, 11]]
    counts[0, 12, 101, 33] += 1.0
    capture = plain_capture(counts, np.arange(20.0), ["9.5"])
    assert rows(find_shutter(capture)) == [("9.5", 7, 1, False)]


def closed_in(*frames: int) -> xr.DataArray:
    """Frames known to be closed (time)."""
    return xr.DataArray(np.isin(np.arange(60), frames), dims="time")


def test_frames_known_to_be_closed() -> None:
    """Telemetry marks the first frame, too, and joins the copies that touch it."""
    capture, closed = still(), closed_in(29, 30, 50)
    capture["counts"].values[0, 31:34] = capture["counts"].values[0, [30]]
    found = sorted(rows(find_shutter(capture, closed=closed)))
    assert found == [
        ("8-14", 29, 5, True),
        ("8-14", 50, 1, True),
        ("9.5", 29, 2, True),
        ("9.5", 50, 1, True),
    ]
    one = closed.expand_dims(band=list(RIG.bands)) & xr.DataArray([False, True], dims="band")
    by_band = find_shutter(capture, closed=one.transpose("band", "time"))
    assert rows(by_band)[-1] == ("9.5", 50, 1, True)


@pytest.mark.parametrize(
    ("runs", "segments"),
    [
        ([("8-14", 10, 5), ("9.5", 12, 6)], [15]),
        ([("8-14", 10, 5), ("9.5", 15, 3)], [15]),
        ([("8-14", 10, 5), ("9.5", 17, 3)], [15, 20]),
        ([("8-14", 10, 20), ("9.5", 12, 3), ("9.5", 20, 3)], [15, 23]),
        ([("8-14", 0, 5), ("9.5", 55, 5)], []),
    ],
    ids=["overlap", "touch", "apart", "two in one", "ends"],
)
def test_events_that_overlap_are_one(runs: list[tuple[str, int, int]], segments: list[int]) -> None:
    """Overlapping events share a segment, with a change between real frames of each camera."""
    names = ("band", "first_frame", "frames")
    parts = zip(*runs, strict=True)
    columns = {name: ("event", list(part)) for name, part in zip(names, parts, strict=True)}
    events = xr.Dataset(columns).assign(renewed=("event", [True] * len(runs)))
    segment = mark_shutter(still(), events)["segment"].values
    np.testing.assert_array_equal(1 + np.flatnonzero(np.diff(segment)), segments)
    for _, first, number in runs:
        if first > 0 and first + number < 60:
            assert segment[first - 1] < segment[first + number]


@pytest.mark.parametrize("nuisance", ["shutter", "lost frames"])
def test_separation_stands_a_shutter_and_lost_frames(nuisance: str) -> None:
    """An event of tens of counts, or a frame of twenty lost, costs the object less than 20 %."""
    rng, case = np.random.default_rng(11), {"emissivity": [0.86, 0.72], "start": 20, "stop": 45}
    scene, capture, response = cases.simulate(case, RIG, np.arange(350) / 10.0, 400, seed=11)
    if nuisance == "shutter":
        spoilt = disturbances.fire_shutter(capture, 17.0, rng, offset_std=40.0)
    else:
        spoilt = disturbances.lose_frames(capture, 0.05, rng)
    results = [separation.solve(one, response) for one in (capture, mark_shutter(spoilt))]
    plain, marked = (cases.score(scene, one)["object_temperature_rmse"] for one in results)
    assert float(marked) <= 1.2 * float(plain)


ORDERS: tuple[Any, ...] = (np.inf, 61, 2.5, "3", True, 1)
CONSTANTS: tuple[Any, ...] = (0.0, "0.01", b"3", True, np.timedelta64(10, "ms"), [0.01], 10.0)


def patch() -> xr.DataArray:
    """The upper left ten by ten pixels."""
    return xr.DataArray(np.indices((20, 24)).max(axis=0) < 10, dims=("y", "x"))


def test_common_drift_is_undone() -> None:
    """A bend of 60 counts goes, to 0.4 of a count: 0.1 of noise over the patch's 100 pixels."""
    capture = still(count=350)
    curve = 60.0 * (1.0 - np.exp(-np.arange(350) / 150.0))
    drifting = capture.assign(counts=capture["counts"] + xr.DataArray(curve, dims="time"))
    before = drifting.astype(np.float32).copy(deep=True)
    drifting = before.copy(deep=True)
    undone = undo_drift(drifting, patch())
    xr.testing.assert_identical(drifting, before)
    error = (undone["counts"] - capture["counts"]).values
    assert np.abs(error).max() < 0.4
    np.testing.assert_allclose(undone["drift"] - curve, 0.0, rtol=0, atol=0.4)
    assert undone["counts"].dims == capture["counts"].dims
    assert undone.attrs["drift_order"] == 5
    assert undone.attrs["drift_pixels"] == 100


def test_drift_leaves_the_steps() -> None:
    """Each segment is undone by itself; frames taken out stay out, and steps stay in."""
    drifting = drift(still(count=300), 50.0)
    stepped = disturbances.fire_shutter(drifting, 15.0, np.random.default_rng(1))
    marked = mark_shutter(stepped)
    undone = undo_drift(marked, patch(), order=2)
    gone = np.isnan(undone["drift"])
    np.testing.assert_array_equal(gone, marked["counts"].isnull().any(("y", "x")))
    before, after = (undone["counts"].where(undone["segment"] == n).mean("time") for n in (0, 1))
    shift = (stepped["counts"] - drifting["counts"]).isel(time=-1)
    assert float(shift.std()) == pytest.approx(40.0, rel=0.1)  # count
    # Of the drift the second segment keeps what it had at its first frame.
    np.testing.assert_allclose(after - before - shift, 50.0 * 156 / 299, rtol=0, atol=2.5)


HOLED = still()
HOLED["counts"][1, 7, 2, 3] = np.nan
NO_PATCH: Any = {}
NAMED = xr.DataArray([10.0, 12.0], {"band": ["8-14", "9.5"]}, "band")


def test_a_bad_pixel_of_the_reference_is_left_out() -> None:
    """A pixel with a status, whose counts may be NaN, is not of the patch."""
    status = xr.zeros_like(patch(), dtype=np.uint16)
    status[2, 3] = schema.Status.INVALID_SAMPLES
    assert undo_drift(HOLED.assign(status=status), patch()).attrs["drift_pixels"] == 99


SECONDS = st.floats(0.001, 0.03)


@settings(max_examples=50)
@given(
    st.lists(st.floats(0.002, 0.2), min_size=1, max_size=20),
    st.tuples(SECONDS, SECONDS),
    st.integers(0, 1000),
)
def test_lag_round_trip(steps: list[float], constants: tuple[float, float], seed: int) -> None:
    """A simulated lag is undone, for any spacing of the frames and a time constant of each band."""
    time = np.concatenate([[0.0], np.cumsum(steps)])
    scene = movie(np.random.default_rng(seed).uniform(15000.0, 20000.0, time.size), time)
    # By name and not by place.
    constant = xr.DataArray(list(constants[::-1]), {"band": list(RIG.bands[::-1])}, "band")
    lagging = disturbances.lag(scene, constant)
    before, undone = lagging.copy(deep=True), undo_lag(lagging, constant)
    xr.testing.assert_identical(lagging, before)
    assert undo_lag(lagging.astype(np.float32), constant)["counts"].dtype == np.float32
    off = (undone["counts"] - scene["counts"])[:, 1:]
    np.testing.assert_allclose(off, 0.0, rtol=0, atol=1e-5)  # [count]
    assert np.isnan(undone["counts"][:, 0]).all()
    assert undone.attrs["lag_time_constant"] == list(constants)


def test_undoing_the_lag_raises_the_noise() -> None:
    """Undoing the lag raises the noise by the stated factor, and correlates successive frames."""
    rng, time = np.random.default_rng(0), np.arange(40000) / 60.0
    undone = undo_lag(movie(rng.standard_normal(time.size), time), 0.010)
    signal = undone["counts"].values[0, 1:, 0, 0]
    kept = np.exp(-1.0 / 0.6)
    factor, correlation = signal.std(), np.corrcoef(signal[1:], signal[:-1])[0, 1]
    assert factor == pytest.approx(np.sqrt(1 + kept**2) / (1 - kept), rel=0.02)
    assert correlation == pytest.approx(-kept / (1 + kept**2), abs=0.02)
    np.testing.assert_allclose(undone.attrs["lag_noise_amplification"], factor, rtol=0.02)
    movies = [movie(signal[:9], np.arange(9) / rate) for rate in (10.0, 60.0, 100.0)]
    factors = [undo_lag(one, 0.010).attrs["lag_noise_amplification"][0] for one in movies]
    np.testing.assert_allclose(factors, [1.0, 1.255, 1.686], rtol=0, atol=0.001)


DEAD = schema.Status.DEAD_PIXEL
THRESHOLDS: tuple[Any, ...] = (0, "6", True, [6.0], np.inf)


@pytest.mark.parametrize("seed", range(2))
def test_bad_pixels_are_found(seed: int) -> None:
    """Noisy, blinking and stuck pixels are marked; walkers and edges of materials are not."""
    capture = walkers(seed)
    false = float((mark_bad(capture)["status"] != 0).mean())
    spoiled = disturbances.spoil_pixels(capture, 0.005, np.random.default_rng(seed))
    marked = mark_bad(spoiled)["status"].values == DEAD
    kinds = spoiled["spoiled"].max("band").values
    rates = [float(marked[kinds == kind].mean()) for kind in range(len(disturbances.SPOILED))]
    assert false < 1e-4
    assert rates[0] < 5e-4
    assert min(rates[1:]) >= 0.95


def test_fast_frames_are_no_bad_pixels() -> None:
    """At 60 Hz the slow edge of a silhouette is not marked as a blinking pixel."""
    false = [float((mark_bad(walkers(n, rate=60.0))["status"] != 0).mean()) for n in (2, 4)]
    assert np.mean(false) < 1e-4


@pytest.mark.filterwarnings("ignore:Fixed pattern")  # of offsets that the shutter renewed
def test_shutter_makes_no_bad_pixel() -> None:
    """New offsets after a known shutter event are not marked as blinking pixels."""
    capture = disturbances.fire_shutter(walkers(1), 17.0, np.random.default_rng(4))
    assert float((mark_bad(capture)["status"] != 0).mean()) > 0.01
    marked = mark_bad(mark_shutter(capture))
    assert not marked["status"].any()
    assert marked.attrs["jumping_pixels"] == 0
    assert "warnings" not in marked.attrs  # of offsets that were right until then


def holes(kind: str, seed: int = 3) -> npt.NDArray[np.bool_]:
    """Samples (band, time, y, x) that are no measurement: a share of all, or of a band, or rows."""
    shape = (2, 350, 64, 80)
    if kind.endswith("%"):
        return np.random.default_rng(seed).random(shape) < float(kind[:-1]) / 100.0
    band, frame, row, _ = np.indices(shape, sparse=True)
    places = {
        "rows": (row >= 5) & (row < 8),
        "frames of a band": (band == 0) & (frame >= 40) & (frame < 90),
        "every other frame": (frame % 2 == 0) & (row % 2 == 0),
    }
    return np.broadcast_to(places[kind], shape)


@pytest.mark.parametrize(
    "kind", ["10%", *slow("1%", "40%", "rows", "frames of a band", "every other frame")]
)
def test_holes_do_not_hide_bad_pixels(kind: str) -> None:
    """Bad pixels are found, and few others, where up to 40 %, rows or every other frame lack."""
    capture = walkers(0)
    spoiled = disturbances.spoil_pixels(capture, 0.005, np.random.default_rng(0))
    valid = ~holes(kind)
    found = [mark_bad(one.assign(counts=one["counts"].where(valid))) for one in (capture, spoiled)]
    judged = valid.sum(axis=1).min(axis=0) >= 16
    assert found[0].attrs["unjudged_pixels"] == np.count_nonzero(~judged)
    false, marked = ((part["status"].values & DEAD != 0)[judged] for part in found)
    bad = spoiled["spoiled"].max("band").values[judged] > 0
    assert false.mean() < 3e-3
    assert marked[bad].mean() > 0.85


def test_bad_pixels_are_added_to_the_status() -> None:
    """Bits that were set stay, the counts stay, the input stays, and numbers are written."""
    capture = still()
    capture["counts"].values[1, :, 5, 6] = 16000.0
    before = capture.assign(status=(("y", "x"), np.full((20, 24), 128, dtype=np.uint16)))
    kept = before.copy(deep=True)
    marked = mark_bad(before)
    xr.testing.assert_identical(before, kept)
    xr.testing.assert_identical(marked["counts"], before["counts"])
    np.testing.assert_array_equal(np.argwhere(marked["status"].values != 128), [[5, 6]])
    assert marked["status"].values[5, 6] == 128 | DEAD
    names = ("noisy_pixels", "jumping_pixels", "bad_threshold")
    assert [marked.attrs[name] for name in names] == [1, 0, 6.0]


SPARSE = still().where(
    xr.DataArray(~holes("90%")[:, :60, :20, :24], dims=("band", "time", "y", "x"))
)


Floats = npt.NDArray[np.float64]
BANDS, SHAPE, FRAMES = ["8-14", "9.5"], (16, 24), 200


def recorded(seed: int, noise: float = 3.4) -> tuple[Floats, xr.Dataset]:
    """Whole counts (band, time, y, x) of a warming wall and its reflections, and its correction."""
    rng, time = np.random.default_rng(seed), np.arange(FRAMES) / 10.0
    gain = 1.0 + 0.02 * rng.standard_normal((2, *SHAPE))
    offset = 40.0 * rng.standard_normal((2, *SHAPE))
    rise, share = 300.0 * (1.0 - np.exp(-time / 8.0)), np.linspace(1.0, 1.5, SHAPE[0])
    wall = rise[:, None, None] * share[:, None]
    mirrored = np.zeros((FRAMES, *SHAPE))
    for start in rng.integers(0, FRAMES - 20, 6):
        column = rng.integers(0, SHAPE[1] - 8)
        mirrored[start : start + rng.integers(5, 40), :, column : column + 8] += (
            400.0 * rng.random()
        )
    signal = np.stack([0.86 * wall + 0.14 * mirrored, 0.18 * wall + 0.07 * mirrored])
    level = 20000.0 + signal + noise * rng.standard_normal(signal.shape)
    maps = ("band", "y", "x")
    correction = {"gain": (maps, gain), "offset": (maps, offset), "bad": (maps, gain < 0)}
    raw = np.rint((level - offset[:, np.newaxis]) / gain[:, np.newaxis])
    return raw, xr.Dataset(correction, {"band": BANDS})


def marked(raw: Floats, correction: xr.Dataset, bit: Status) -> npt.NDArray[np.bool_]:
    """Pixels (y, x) that the correction marks with a bit."""
    capture = plain_capture(raw.astype(np.uint16))
    status = correct_capture(capture, correction, bad_pixels=None)["status"].values
    return np.asarray(status & np.uint32(bit) != 0)


@pytest.mark.parametrize("band", [0, 1])
@pytest.mark.parametrize("share", [0.99, 0.9, 0.5])
def test_a_level_within_the_type_clips_all_that_reach_it(band: int, share: float) -> None:
    """Each pixel with a sample at the camera's level is saturated, above or below, and no other."""
    for sign in (1, -1):
        raw, correction = recorded(1)
        level = sign * np.rint(np.quantile(sign * raw[band], share))
        raw[band] = sign * np.minimum(sign * raw[band], sign * level)
        reached = np.any(raw[band] == level, axis=0)
        np.testing.assert_array_equal(marked(raw, correction, Status.SATURATED), reached)


@pytest.mark.parametrize("band", [0, 1])
def test_a_region_that_stands_is_frozen(band: int) -> None:
    """A part of one image that repeats for 12 frames is marked, and nothing else."""
    raw, correction = recorded(1)
    raw[band, 50:62, :10] = raw[band, 49, :10]
    found = marked(raw, correction, Status.FROZEN_FRAMES)
    assert found[:10].all()
    assert not found[10:].any()


@pytest.mark.parametrize("noise", [0.3, 1.2, 12.0])
def test_clean_counts_are_not_marked(noise: float) -> None:
    """Rounded counts of any noise neither heap nor stand."""
    for seed in range(2):
        raw, correction = recorded(seed, noise)
        for bit in (Status.SATURATED, Status.FROZEN_FRAMES):
            assert not marked(raw, correction, bit).any()


STILL = still()
EVENTS = find_shutter(STILL, closed=closed_in(59))
BARE: Any = np.zeros((2, 60), bool)


test_what_is_refused = refused(
    lambda call: call(),
    [
        (lambda: find_shutter(STILL * 0), "band '8-14': 0 of the 480 pixels change in 60 f"),
        (lambda: mark_shutter(STILL.astype(int)), "Must be floating"),
        (lambda: mark_shutter(still(count=50), EVENTS), r"of frames 59 to 59. Must lie in \[0, 49"),
        (lambda: mark_shutter(STILL, EVENTS.drop_vars("renewed")), "Missing 'renewed' of the ev"),
        (lambda: find_shutter(STILL, closed=closed_in(3)[:50]), "Invalid size 50 of 'time' of"),
        (lambda: find_shutter(STILL, closed=closed_in(3) * 1), "dtype int64 of the closed fra"),
        (lambda: find_shutter(STILL, closed=BARE), "closed frames of type ndarray"),
        (lambda: mark_shutter(mark_shutter(STILL)), "marked before"),
        *((partial(undo_drift, STILL, patch(), order=it), "order of the drift") for it in ORDERS),
        *((partial(undo_lag, STILL, it), r"Invalid time_constant \[s\]") for it in CONSTANTS),
        (lambda: undo_drift(STILL, patch() & False), "it marks no good pixel"),
        (lambda: undo_drift(STILL, patch()[:, :5]), "Invalid size 5 of 'x' of the reference"),
        (lambda: undo_drift(STILL, patch().astype(int)), "Invalid dtype int64 of the reference"),
        (lambda: undo_drift(STILL, NO_PATCH), "Invalid reference of type dict"),
        (lambda: undo_drift(undo_drift(STILL, patch()), patch()), "the drift was undone before"),
        (lambda: undo_drift(HOLED, patch()), "NaN in frame 7 of band '9.5'"),
        (lambda: undo_lag(STILL, NAMED), r"\[s\] 12.0. Must be at most 1: seconds, not millisec"),
        (lambda: undo_lag(STILL, NAMED[1:] / 1e3), "Missing band '8-14' in the time constants"),
        (lambda: undo_lag(STILL.isel(time=[0]), 0.01), "Invalid capture of 1 frame"),
        (lambda: undo_lag(STILL.astype(int), 0.01), "Must be floating"),
        (lambda: undo_lag(undo_lag(STILL, 0.01), 0.01), "the lag was undone before"),
        *((partial(mark_bad, STILL, threshold=it), "threshold of bad pixels") for it in THRESHOLDS),
        (lambda: mark_bad(STILL.isel(time=slice(15))), "Invalid band '8-14' of 15 frames"),
        (lambda: mark_bad(SPARSE.isel(time=slice(16))), "'8-14': no pixel has 16 samples that are"),
    ],
)
