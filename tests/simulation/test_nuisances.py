"""Nuisances of one camera: each put into a capture of known truth, detected, and undone."""

import re
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from dbthermal import _smooth as smooth
from dbthermal import schema, separation, simulation
from dbthermal.correction import (
    blackbody_statistics,
    correct,
    find_shutter,
    fit_correction,
    mark_bad,
    mark_shutter,
    renew_offset,
    undo_drift,
    undo_lag,
)
from dbthermal.simulation import Background, Rig
from dbthermal.simulation import _nuisances as nuisances
from reproduction import experiments

RIG = Rig()
TIME = np.arange(350) / 10.0
SHAPE = (64, 80)
DEAD = schema.Status.DEAD_PIXEL


def panels(*, size: int = 16) -> xr.DataArray:
    """A checkerboard of two materials: edges and corners everywhere."""
    rows, columns = np.indices(SHAPE)
    other = (rows // size + columns // size) % 2 == 1
    values = [np.where(other, *pair) for pair in ((0.3, 0.95), (0.5, 0.85))]
    return xr.DataArray(values, dims=("band", "y", "x"), coords={"band": list(RIG.bands)})


def walkers(seed: int, *, rate: float = 10.0, frames: int = 350) -> xr.Dataset:
    """A clean capture of people reflected in panels of two materials."""
    rng = np.random.default_rng(seed)
    scene = simulation.walkers(np.arange(frames) / rate, SHAPE, panels(), rng)
    return simulation.observe(scene, RIG.response(), rng)


@pytest.fixture(scope="module")
def clean() -> xr.Dataset:
    """350 frames at 10 Hz without a nuisance."""
    return walkers(1)


def still(level: float = 16000.0, count: int = 60, noise: float = 4.0) -> xr.Dataset:
    """A uniform view with noise, 20 by 24 pixels."""
    rng = np.random.default_rng(5)
    counts = level + noise * rng.standard_normal((2, count, 20, 24))
    return xr.Dataset(
        {"counts": (("band", "time", "y", "x"), counts.astype(np.float32), {"units": "count"})},
        coords={"band": list(RIG.bands), "time": ("time", np.arange(count) / 10, {"units": "s"})},
    )


def rows(events: xr.Dataset) -> list[tuple[str, int, int, bool]]:
    """Events as tuples."""
    names = ("band", "first_frame", "frames", "renewed")
    return list(zip(*(events[name].values.tolist() for name in names), strict=True))


def test_shutter_events_are_found(clean: xr.Dataset) -> None:
    """Each shutter event of each camera is found with all of its frames, without false ones."""
    rng = np.random.default_rng(2)
    capture = nuisances.fire_shutter(clean, [8.0, 20.04], rng, duration=0.55)
    capture = nuisances.fire_shutter(capture, 30.0, rng, bands=("9.5",))
    both = [(band, first, 5, True) for first in (81, 201) for band in RIG.bands]
    assert rows(find_shutter(capture)) == [*both, ("9.5", 301, 5, True)]
    events = find_shutter(capture)
    np.testing.assert_allclose(events["start"], [8.1, 8.1, 20.1, 20.1, 30.1], rtol=0, atol=1e-9)
    np.testing.assert_allclose(events["stop"] - events["start"], 0.4, rtol=0, atol=1e-9)  # [s]
    marked = mark_shutter(capture)
    gone = marked["counts"].isnull().any(("y", "x"))
    np.testing.assert_array_equal(gone.sum("time"), [10, 15])
    np.testing.assert_array_equal(np.flatnonzero(np.diff(marked["segment"])), [85, 205, 305])
    assert marked["segment"].dtype.kind == "i"


@pytest.mark.parametrize("seed", range(3))
def test_clean_capture_has_no_event(seed: int) -> None:
    """Neither floating nor whole-number counts of a clean capture repeat a frame."""
    capture = walkers(seed, frames=120)
    whole = capture.assign(counts=np.rint(capture["counts"]).astype(np.uint16))
    for made in (capture, whole):
        assert find_shutter(made).sizes["event"] == 0
    marked = mark_shutter(capture)
    xr.testing.assert_identical(marked["counts"], capture["counts"])
    assert not marked["segment"].any()


def test_repeated_frames_are_found(clean: xr.Dataset) -> None:
    """All of the frames that a driver repeats are found; a lost one starts no segment."""
    capture = nuisances.lose_frames(clean, 0.05, np.random.default_rng(3))
    marked = mark_shutter(capture)
    found = np.isnan(marked["counts"].values).all(axis=(2, 3))
    print(f"repeated {int(capture['repeated'].sum())}, found {int(found.sum())}")
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
    capture = xr.Dataset(
        {"counts": (("band", "time", "y", "x"), counts)},
        coords={"band": ["9.5"], "time": np.arange(20.0)},
    )
    assert rows(find_shutter(capture)) == [("9.5", 7, 1, False)]


def test_frames_known_to_be_closed() -> None:
    """Telemetry marks the first frame, too, and joins the copies that touch it."""
    capture = still()
    capture["counts"].values[0, 31:34] = capture["counts"].values[0, [30]]
    closed = xr.DataArray(np.isin(np.arange(60), [29, 30, 50]), dims="time")
    found = rows(find_shutter(capture, closed=closed))
    assert sorted(found) == [
        ("8-14", 29, 5, True),
        ("8-14", 50, 1, True),
        ("9.5", 29, 2, True),
        ("9.5", 50, 1, True),
    ]
    one = closed.expand_dims(band=list(RIG.bands)) & xr.DataArray([False, True], dims="band")
    by_band = find_shutter(capture, closed=one.transpose("band", "time"))
    assert rows(by_band)[-1] == ("9.5", 50, 1, True)
    with pytest.raises(ValueError, match="Invalid closed frames of sizes"):
        find_shutter(capture, closed=closed[:50])
    with pytest.raises(TypeError, match="Invalid dtype int64 of the closed frames"):
        find_shutter(capture, closed=closed.astype(int))


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


def test_shutter_is_marked_once_and_says_so(clean: xr.Dataset) -> None:
    """Provenance is written, the input is not changed, and a second marking raises an error."""
    capture = nuisances.fire_shutter(clean, 20.0, np.random.default_rng(2), bands=("8-14",))
    before = capture.copy(deep=True)
    marked = mark_shutter(capture)
    xr.testing.assert_identical(capture, before)
    assert marked.attrs == {
        **capture.attrs,
        "shutter_events": 1,
        "repeated_frames": 0,
        "frames_taken_out": [5, 0],
    }
    assert marked["counts"].attrs == capture["counts"].attrs
    assert marked["counts"].dtype == np.float32
    with pytest.raises(ValueError, match="marked before"):
        mark_shutter(marked)


def test_shutter_refuses_nonsense() -> None:
    """A frozen capture, an integer capture and events outside it raise an error."""
    capture = still()
    with pytest.raises(ValueError, match=re.escape("Invalid counts of band '8-14': 0 of the 480")):
        find_shutter(capture.assign(counts=0 * capture["counts"]))
    with pytest.raises(TypeError, match="Must be floating"):
        mark_shutter(capture.astype(int))
    events = find_shutter(capture, closed=xr.DataArray(np.arange(60) == 59, dims="time"))
    with pytest.raises(ValueError, match=r"Invalid event of frames 59 to 59. Must lie in \[0, 49"):
        mark_shutter(capture.isel(time=slice(50)), events)
    with pytest.raises(ValueError, match="Missing 'renewed' of the events"):
        mark_shutter(capture, events.drop_vars("renewed"))


def glass(pixels: int = 400) -> tuple[xr.Dataset, xr.Dataset, np.random.Generator]:
    """Scene and capture of plate glass that warms from 20 to 45 C."""
    rng = np.random.default_rng(11)
    emissivity = xr.DataArray([0.86, 0.72], dims="band", coords={"band": list(RIG.bands)})
    scene = simulation.independent_pixels(
        TIME, emissivity, Background(), pixels, rng, start=293.15, stop=318.15
    )
    return scene, simulation.observe(scene, RIG.response(), rng), rng


def rmse(scene: xr.Dataset, capture: xr.Dataset) -> float:
    """Error of the object temperature of glass [K]."""
    result = separation.solve(capture, RIG.response())
    return float(experiments.score(scene, result)["object_temperature_rmse"])


def shutter(capture: xr.Dataset, rng: np.random.Generator) -> xr.Dataset:
    """One event, of half a second and tens of counts."""
    return nuisances.fire_shutter(capture, 17.0, rng, offset_std=40.0)


def lost(capture: xr.Dataset, rng: np.random.Generator) -> xr.Dataset:
    """One frame of twenty is lost."""
    return nuisances.lose_frames(capture, 0.05, rng)


@pytest.mark.parametrize("nuisance", [shutter, lost])
def test_separation_stands_a_shutter_and_lost_frames(
    nuisance: Callable[[xr.Dataset, np.random.Generator], xr.Dataset],
) -> None:
    """The object temperature is within 20 % of that of the undisturbed capture."""
    scene, capture, rng = glass()
    undisturbed = rmse(scene, capture)
    marked = rmse(scene, mark_shutter(nuisance(capture, rng)))
    print(f"{nuisance.__name__}: {marked:.4f} K, undisturbed {undisturbed:.4f} K")
    assert marked <= 1.2 * undisturbed


@pytest.mark.parametrize(("times", "factor"), [((17.5,), 1.90), ((11.0, 24.0), 2.71)])
def test_a_step_costs_accuracy(times: tuple[float, ...], factor: float) -> None:
    """The smooth part's deviation rises as stated, steps being fitted beside five functions."""
    functions = smooth.polynomial_basis(TIME, 5)
    steps = (TIME[:, np.newaxis] > np.array(times)).astype(float)
    both = np.hstack([functions, steps])
    covariance = np.linalg.inv(both.T @ both)[:5, :5]
    np.testing.assert_allclose(np.sqrt(np.trace(covariance) / 5), factor, rtol=0, atol=0.01)


def patch() -> xr.DataArray:
    """The upper left ten by ten pixels."""
    return xr.DataArray(np.indices((20, 24)).max(axis=0) < 10, dims=("y", "x"))


def test_common_drift_is_undone() -> None:
    """A bend of 60 counts goes, to 0.4 of a count: 0.1 of noise over the patch's 100 pixels."""
    capture = still(count=350)
    curve = 60.0 * (1.0 - np.exp(-np.arange(350) / 150.0))
    drifting = capture.assign(counts=capture["counts"] + xr.DataArray(curve, dims="time"))
    drifting = drifting.astype(np.float32)
    undone = undo_drift(drifting, patch())
    error = (undone["counts"] - capture["counts"]).values
    print(f"largest error of the drift {np.abs(error).max():.2f} count of 60")
    assert np.abs(error).max() < 0.4
    np.testing.assert_allclose(undone["drift"] - curve, 0.0, rtol=0, atol=0.4)
    assert undone["counts"].dims == capture["counts"].dims
    assert undone.attrs["drift_order"] == 5
    assert undone.attrs["drift_pixels"] == 100


def test_drift_leaves_the_steps() -> None:
    """Each segment is undone by itself; frames taken out stay out, and steps stay in."""
    capture = still(count=300)
    drifting = nuisances.drift_pattern(capture, np.random.default_rng(0), common=50.0)
    stepped = nuisances.fire_shutter(drifting, 15.0, np.random.default_rng(1))
    marked = mark_shutter(stepped)
    undone = undo_drift(marked, patch(), order=2)
    gone = np.isnan(undone["drift"])
    np.testing.assert_array_equal(gone, marked["counts"].isnull().any(("y", "x")))
    level = undone["counts"].where(undone["segment"] == 1).mean("time")
    step = level - undone["counts"].where(undone["segment"] == 0).mean("time")
    shift = (stepped["counts"] - drifting["counts"]).isel(time=-1)
    difference = step - shift
    assert float(shift.std()) == pytest.approx(40.0, rel=0.1)  # count
    # Of the drift the second segment keeps what it had at its first frame.
    np.testing.assert_allclose(difference, 50.0 * 156 / 299, rtol=0, atol=2.5)


def test_drift_refuses_nonsense() -> None:
    """A patch without good pixels, of another size, incomplete or used twice raises an error."""
    capture = still()
    with pytest.raises(ValueError, match="it marks no good pixel"):
        undo_drift(capture, patch() & False)
    with pytest.raises(ValueError, match=re.escape("Invalid reference of sizes {'y': 20, 'x': 5}")):
        undo_drift(capture, patch()[:, :5])
    with pytest.raises(TypeError, match="Invalid dtype int64 of the reference"):
        undo_drift(capture, patch().astype(int))
    with pytest.raises(ValueError, match="Invalid order 1 of the drift"):
        undo_drift(capture, patch(), order=1)
    with pytest.raises(ValueError, match="the drift was undone before"):
        undo_drift(undo_drift(capture, patch()), patch())
    capture["counts"].values[1, 7, 2, 3] = np.nan
    with pytest.raises(ValueError, match=re.escape("NaN in frame 7 of band '9.5'")):
        undo_drift(capture, patch())
    status = xr.zeros_like(patch(), dtype=np.uint16)
    status[2, 3] = schema.Status.INVALID_SAMPLES
    assert undo_drift(capture.assign(status=status), patch()).attrs["drift_pixels"] == 99


@pytest.fixture(scope="module")
def drifting() -> tuple[xr.Dataset, xr.Dataset, list[xr.Dataset]]:
    """A clean capture, the raw one of a pattern that drifts, and the corrections at its ends."""
    rng, rig = np.random.default_rng(8), Rig(bad_fraction=0.01)
    shape, temperatures = (24, 30), np.linspace(285.0, 330.0, 4)
    emissivity = xr.DataArray([0.86, 0.72], dims="band", coords={"band": list(rig.bands)})
    scene = simulation.walkers(TIME[:100], shape, emissivity, rng)
    seen = simulation.observe(scene, rig.response(), rng)
    first = simulation.pattern(rig, shape, rng)
    moved = nuisances.drift_pattern(seen, rng, pattern_std=25.0)
    last = first.assign(offset=first["offset"] + moved["drifted"] * first["gain"])
    movies = simulation.blackbody_movies(rig, temperatures, 60, first, rng)
    correction = fit_correction(blackbody_statistics(movies))
    flats = [
        simulation.blackbody_movies(rig, np.array([300.0]), 60, detector, rng)["counts"]
        .isel(temperature=0)
        .mean("frame")
        for detector in (first, last)
    ]
    ends = [renew_offset(correction, flat) for flat in flats]
    return seen, simulation.capture(moved, first), ends


def pattern_error(corrected: xr.Dataset, seen: xr.Dataset) -> float:
    """Standard deviation over the good pixels of the error at the last frames [count]."""
    error = (corrected["counts"] - seen["counts"]).isel(time=slice(-10, None)).mean("time")
    return float(error.where(corrected["status"] & DEAD == 0).std(("y", "x")).max())


def test_pattern_drift_is_interpolated(
    drifting: tuple[xr.Dataset, xr.Dataset, list[xr.Dataset]],
) -> None:
    """Pictures before and after the capture take a drift of 25 counts a pixel down to the noise."""
    seen, raw, (before, after) = drifting
    fixed, undone = correct(raw, before), correct(raw, before, after=after)
    errors = pattern_error(fixed, seen), pattern_error(undone, seen)
    print(f"fixed correction {errors[0]:.1f} count, interpolated {errors[1]:.2f} count")
    assert errors[0] > 15.0
    assert errors[1] < 1.5
    np.testing.assert_array_equal(undone["status"], fixed["status"])
    schema.check(undone, "corrected")
    assert (undone.attrs["offset_interpolated"], fixed.attrs["offset_interpolated"]) == (1, 0)


def test_interpolation_has_its_ends(
    drifting: tuple[xr.Dataset, xr.Dataset, list[xr.Dataset]],
) -> None:
    """The first frame is corrected by the first correction, the last by the last."""
    _, raw, ends = drifting
    undone = correct(raw, ends[0], after=ends[1])["counts"]
    for frame, correction in zip((0, -1), ends, strict=True):
        expected = correct(raw, correction)["counts"]
        np.testing.assert_allclose(undone[:, frame], expected[:, frame], rtol=0, atol=0.01)
    wide = correct(raw, ends[0], after=ends[0])["counts"]
    expected = correct(raw, ends[0])["counts"]
    np.testing.assert_allclose(wide, expected, rtol=0, atol=1e-6)
    with pytest.raises(ValueError, match="Invalid size 24 of 'y'"):
        correct(raw, ends[0], after=ends[1].isel(y=slice(3)))


def test_renewed_offset_evens_the_picture(
    drifting: tuple[xr.Dataset, xr.Dataset, list[xr.Dataset]],
) -> None:
    """A picture corrected by itself is uniform, and its mean is the one it had."""
    _, raw, (correction, _) = drifting
    flat = raw["counts"].isel(time=3).astype(float)
    renewed = renew_offset(correction, flat)
    good = ~correction["bad"]
    seen, even = (
        (part["gain"] * flat + part["offset"]).where(good) for part in (correction, renewed)
    )
    assert float(even.std(("y", "x")).max()) < 1e-6
    np.testing.assert_allclose(even.mean(("y", "x")), seen.mean(("y", "x")), rtol=0, atol=1e-6)
    assert renewed.attrs["offset_renewed"] == 1
    with pytest.raises(ValueError, match="a good pixel is not finite"):
        renew_offset(correction, flat * np.nan)
    with pytest.raises(ValueError, match="Invalid flat image of sizes"):
        renew_offset(correction, flat.isel(x=slice(3)))


@pytest.mark.parametrize("seed", range(2))
def test_bad_pixels_are_found(seed: int) -> None:
    """Noisy, blinking and stuck pixels are marked; walkers and edges of materials are not."""
    capture = walkers(seed)
    false = float((mark_bad(capture)["status"] != 0).mean())
    spoiled = nuisances.spoil_pixels(capture, 0.005, np.random.default_rng(seed))
    marked = mark_bad(spoiled)["status"].values == DEAD
    kinds = spoiled["spoiled"].max("band").values
    rates = [float(marked[kinds == kind].mean()) for kind in range(len(nuisances.SPOILED))]
    print(f"false alarms {false:.1e}; {dict(zip(nuisances.SPOILED, rates, strict=True))}")
    assert false < 1e-4
    assert rates[0] < 5e-4
    assert min(rates[1:]) >= 0.95


def test_fast_frames_are_no_bad_pixels() -> None:
    """At 60 Hz the slow edge of a silhouette is not marked as a blinking pixel."""
    false = [float((mark_bad(walkers(n, rate=60.0))["status"] != 0).mean()) for n in (2, 4)]
    print(f"false alarms at 60 Hz {false}")
    assert np.mean(false) < 1e-4


def test_shutter_makes_no_bad_pixel(clean: xr.Dataset) -> None:
    """New offsets after a known shutter event are not marked as blinking pixels."""
    capture = shutter(clean, np.random.default_rng(4))
    assert float((mark_bad(capture)["status"] != 0).mean()) > 0.01
    marked = mark_bad(mark_shutter(capture))
    assert not marked["status"].any()
    assert marked.attrs["jumping_pixels"] == 0


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


def test_bad_pixels_refuse_nonsense() -> None:
    """Too few frames and an invalid threshold raise a ValueError."""
    capture = still()
    with pytest.raises(ValueError, match=re.escape("Invalid band '8-14' of 15 frames")):
        mark_bad(capture.isel(time=slice(15)))
    with pytest.raises(ValueError, match="Invalid threshold 0 of bad pixels"):
        mark_bad(capture, threshold=0)


def movie(signal: np.ndarray, time: object) -> xr.Dataset:
    """Counts (band, time, y, x), double precision, of one signal (time) in two bands."""
    counts = np.broadcast_to(np.asarray(signal)[:, np.newaxis, np.newaxis], (2, len(signal), 1, 1))
    return xr.Dataset(
        {"counts": (("band", "time", "y", "x"), counts.copy(), {"units": "count"})},
        coords={"band": list(RIG.bands), "time": np.asarray(time)},
    )


def test_lag_is_that_of_a_small_body() -> None:
    """A step is followed as 1 - exp(-t / tau), however the frames are spaced."""
    time = np.array([0.0, 0.004, 0.010, 0.011, 0.030])
    seen = nuisances.lag(movie(np.array([0.0, 1.0, 1.0, 1.0, 1.0]), time), 0.010)["counts"]
    np.testing.assert_allclose(seen[0, :, 0, 0], -np.expm1(-time / 0.010), rtol=0, atol=1e-12)


@settings(max_examples=50, deadline=None)
@given(
    steps=st.lists(st.floats(0.002, 0.2), min_size=1, max_size=20),
    constants=st.tuples(st.floats(0.001, 0.03), st.floats(0.001, 0.03)),
    seed=st.integers(0, 1000),
)
def test_lag_round_trip(steps: list[float], constants: tuple[float, float], seed: int) -> None:
    """A simulated lag is undone, for any spacing of the frames and a time constant of each band."""
    time = np.concatenate([[0.0], np.cumsum(steps)])
    scene = movie(np.random.default_rng(seed).uniform(15000.0, 20000.0, time.size), time)
    # By name and not by place.
    constant = xr.DataArray(
        list(constants[::-1]), dims="band", coords={"band": list(RIG.bands[::-1])}
    )
    undone = undo_lag(nuisances.lag(scene, constant), constant)
    np.testing.assert_allclose(
        undone["counts"][:, 1:], scene["counts"][:, 1:], rtol=0, atol=1e-5
    )  # [count]
    assert np.isnan(undone["counts"][:, 0]).all()
    assert undone.attrs["lag_time_constant"] == list(constants)


def test_undoing_the_lag_raises_the_noise() -> None:
    """Undoing the lag raises the noise by the stated factor, and correlates successive frames."""
    rng, time = np.random.default_rng(0), np.arange(40000) / 60.0
    undone = undo_lag(movie(rng.standard_normal(time.size), time), 0.010)
    signal = undone["counts"].values[0, 1:, 0, 0]
    kept = np.exp(-1.0 / 0.6)
    factor, correlation = signal.std(), np.corrcoef(signal[1:], signal[:-1])[0, 1]
    print(f"noise times {factor:.3f}, correlation {correlation:.3f}")
    assert factor == pytest.approx(np.sqrt(1 + kept**2) / (1 - kept), rel=0.02)
    assert correlation == pytest.approx(-kept / (1 + kept**2), abs=0.02)
    np.testing.assert_allclose(undone.attrs["lag_noise_amplification"], factor, rtol=0.02)
    movies = [movie(signal[:9], np.arange(9) / rate) for rate in (10.0, 60.0, 100.0)]
    factors = [undo_lag(one, 0.010).attrs["lag_noise_amplification"][0] for one in movies]
    np.testing.assert_allclose(factors, [1.0, 1.255, 1.686], rtol=0, atol=0.001)


def test_lag_of_marked_frames() -> None:
    """The frame after a missing one is lost, too; at 10 Hz the others hardly change."""
    capture = still()
    capture["counts"].values[0, 30] = np.nan
    undone = undo_lag(capture, 0.010)["counts"]
    gone = [np.flatnonzero(np.isnan(part).all(("y", "x"))).tolist() for part in undone]
    assert gone == [[0, 30, 31], [0]]
    assert float(abs(undone - capture["counts"]).max()) < 0.01  # count
    assert undone.dtype == np.float32


def test_lag_refuses_nonsense() -> None:
    """A missing time constant, one frame, integer counts and a second correction raise an error."""
    capture = still()
    with pytest.raises(ValueError, match=re.escape("Invalid time_constant [s] 0.0")):
        undo_lag(capture, 0.0)
    named = xr.DataArray([0.01], dims="band", coords={"band": ["9.5"]})
    with pytest.raises(ValueError, match="Missing band '8-14' in the time constants"):
        undo_lag(capture, named)
    with pytest.raises(ValueError, match="Invalid capture of 1 frame"):
        undo_lag(capture.isel(time=[0]), 0.01)
    with pytest.raises(TypeError, match="Must be floating"):
        undo_lag(capture.astype(int), 0.01)
    with pytest.raises(ValueError, match="the lag was undone before"):
        undo_lag(undo_lag(capture, 0.01), 0.01)


def test_steps_leave_their_input(clean: xr.Dataset) -> None:
    """A new dataset comes out of each step, simulated or undone, and the old one is as it was."""
    rng, before = np.random.default_rng(0), clean.copy(deep=True)
    mask = xr.DataArray(np.indices(SHAPE).max(axis=0) < 8, dims=("y", "x"))
    chain = [clean, nuisances.lag(clean, 0.01), nuisances.spoil_pixels(clean, 0.01, rng)]
    chain += [nuisances.drift_pattern(clean, rng, pattern_std=5.0)]
    chain += [undo_lag(clean, 0.01), undo_drift(clean, mask), mark_bad(clean)]
    xr.testing.assert_identical(clean, before)
    assert all(one is not other for one, other in pairwise(chain))


def test_simulated_nuisances_refuse_nonsense(clean: xr.Dataset) -> None:
    """Shares, times and bands outside their range raise a ValueError."""
    rng = np.random.default_rng(0)
    for step in (nuisances.lose_frames, nuisances.spoil_pixels):
        with pytest.raises(ValueError, match=re.escape("Invalid share 1.0")):
            step(clean, 1.0, rng)
    with pytest.raises(ValueError, match=re.escape("Invalid time 99.0 s of the shutter")):
        nuisances.fire_shutter(clean, 99.0, rng)
    with pytest.raises(ValueError, match=re.escape("Missing band '10.6'")):
        nuisances.fire_shutter(clean, 9.0, rng, bands=("10.6",))


@pytest.mark.parametrize("name", ["fire_shutter", "drift_pattern", "spoil_pixels", "lag"])
def test_whole_numbers_are_refused(name: str) -> None:
    """Integer counts raise an error: a lagging pixel of 1000 counts would wrap to 57,580."""
    counts = np.full((2, 5, 2, 2), 1000, dtype=np.uint16)
    raw = xr.Dataset(
        {"counts": (("band", "time", "y", "x"), counts)},
        coords={"band": ["8-14", "9.5"], "time": np.arange(5) / 10.0},
    )
    rng = np.random.default_rng(0)
    arguments = {
        "fire_shutter": ([0.2], rng),
        "drift_pattern": (rng,),
        "spoil_pixels": (0.1, rng),
        "lag": (0.05,),
    }
    with pytest.raises(TypeError, match="uint16 of the counts"):
        getattr(simulation, name)(raw, *arguments[name])
