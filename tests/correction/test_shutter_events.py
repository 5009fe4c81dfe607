"""Shutter events and lost frames: each simulated with known frames, found, and marked."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import xarray as xr
from captures import RIG, emissivity_of, still, walkers

from dbthermal import separation, simulation
from dbthermal.correction import find_shutter, mark_shutter
from dbthermal.simulation import Background
from reproduction import experiments


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
    capture = simulation.fire_shutter(clean, [8.0, 20.04], rng, duration=0.55)
    capture = simulation.fire_shutter(capture, 30.0, rng, bands=("9.5",))
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
    capture = simulation.lose_frames(clean, 0.05, np.random.default_rng(3))
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


EVENTS = find_shutter(still(), closed=closed_in(59))


BARE: Any = np.zeros((2, 60), bool)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: find_shutter(still() * 0), "Invalid counts of band '8-14': 0 of the 480"),
        (lambda: mark_shutter(still().astype(int)), "Must be floating"),
        (lambda: mark_shutter(still(count=50), EVENTS), r"of frames 59 to 59. Must lie in \[0, 49"),
        (lambda: mark_shutter(still(), EVENTS.drop_vars("renewed")), "Missing 'renewed' of the ev"),
        (
            lambda: find_shutter(still(), closed=closed_in(3)[:50]),
            "Invalid size 50 of 'time' of th",
        ),
        (
            lambda: find_shutter(still(), closed=closed_in(3) * 1),
            "dtype int64 of the closed frames",
        ),
        (lambda: find_shutter(still(), closed=BARE), "closed frames of type ndarray"),
        (lambda: mark_shutter(mark_shutter(still())), "marked before"),
    ],
)
def test_shutter_refuses_nonsense(call: Callable[[], xr.Dataset], message: str) -> None:
    """A frozen or integer capture, events outside it, unlabelled or other frames raise an error."""
    with pytest.raises((TypeError, ValueError), match=message):
        call()


@pytest.mark.parametrize("nuisance", ["shutter", "lost frames"])
def test_separation_stands_a_shutter_and_lost_frames(nuisance: str) -> None:
    """An event of tens of counts, or a frame of twenty lost, costs the object less than 20 %."""
    rng, time = np.random.default_rng(11), np.arange(350) / 10.0
    scene = simulation.independent_pixels(
        time, emissivity_of(0.86, 0.72), Background(), 400, rng, start=293.15, stop=318.15
    )
    capture = simulation.observe(scene, RIG.response(), rng)
    if nuisance == "shutter":
        spoilt = simulation.fire_shutter(capture, 17.0, rng, offset_std=40.0)
    else:
        spoilt = simulation.lose_frames(capture, 0.05, rng)
    results = [separation.solve(one, RIG.response()) for one in (capture, mark_shutter(spoilt))]
    plain, marked = (experiments.score(scene, one)["object_temperature_rmse"] for one in results)
    print(f"{nuisance}: {float(marked):.4f} K, undisturbed {float(plain):.4f} K")
    assert float(marked) <= 1.2 * float(plain)
