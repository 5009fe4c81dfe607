"""Live separation: against the truth, against the whole capture at once, and with frames lost."""

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import xarray as xr
from captures import GLASS, emissivity_of, people
from refused import assert_raises, assert_refused
from scenes import field, held

from dbthermal import schema, simulation
from dbthermal.schema import Status
from dbthermal.separation import Stream
from dbthermal.simulation import Rig

RATE = 10.0  # [Hz]
Data = tuple[xr.Dataset, xr.Dataset, xr.Dataset]


def walkers(seed: int, seconds: float, shape: tuple[int, int] = (12, 20), **rig: Any) -> Data:
    """Scene, capture and response of plate glass that warms up while people walk by."""
    made = Rig(**rig)
    return *people(seed, round(seconds * RATE), shape, rig=made), made.response()


def live(
    capture: xr.Dataset, response: xr.Dataset, frames: Any = slice(None), **options: Any
) -> tuple[Stream, xr.Dataset]:
    """Stream that has taken some frames, one at a time, and all that it has returned."""
    stream = Stream(capture.isel(time=[0]), response, frame_rate=RATE, refresh=5.0, **options)
    counts, time = capture["counts"].values, capture["time"].values
    parts = [stream.update(time[i], counts[:, i]) for i in np.arange(time.size)[frames]]
    films = [part[["object_temperature", "object_temperature_std"]] for part in parts]
    return stream, xr.concat(films, "time").assign(parts[-1].drop_dims("time").data_vars)


@pytest.fixture(scope="module")
def glass() -> Data:
    """Half a minute of glass."""
    return walkers(3, 30.0)


@pytest.fixture(scope="module")
def plain(glass: Data) -> tuple[Stream, xr.Dataset]:
    """Stream that has taken all frames of it, and what it has returned."""
    return live(*glass[1:])


def test_frames_together_are_frames_one_by_one(
    glass: Data, plain: tuple[Stream, xr.Dataset]
) -> None:
    """Several frames in one call give the same as one after another, to the last bit."""
    _, capture, response = glass
    one = plain[0]
    other = Stream(capture.isel(time=[0]), response, frame_rate=RATE, refresh=5.0)
    other.update(capture["time"].values[:77], capture["counts"].values[:, :77])
    result = other.update(capture["time"].values[77:], capture["counts"].values[:, 77:])
    last = one.result()
    xr.testing.assert_identical(result.isel(time=slice(-last.sizes["time"], None)), last)
    schema.check(last, "separated")


def test_a_long_gap_is_not_smoothed_over(glass: Data) -> None:
    """After five seconds without a frame the object is that of the frames since."""
    scene, capture, response = glass
    stream, result = live(capture, response, np.r_[0:180, 230:300])
    assert stream.lost_frames == 50
    after = result.sel(time=result["time"] > 23.0)
    assert held(after, scene, where=result["status"] == 0) > 0.90


def test_samples_that_are_nan_stay_nan(glass: Data, plain: tuple[Stream, xr.Dataset]) -> None:
    """A sample that is NaN has no temperatures; its pixel keeps those of the other frames."""
    _, capture, response = glass
    spoiled = capture.copy(deep=True)
    spoiled["counts"].values[0, 250:252, 3, 4] = np.nan
    spoiled["counts"].values[1, :, 5, 6] = np.nan
    result = live(spoiled, response)[1].sel(time=slice(24.5, 26.0))
    clean = plain[1].sel(time=slice(24.5, 26.0))
    at = np.isclose(result["time"], 25.0) | np.isclose(result["time"], 25.1)
    pixel = result["object_temperature"][:, 3, 4]
    assert clean["object_temperature"][:, 3, 4].notnull().all()
    np.testing.assert_array_equal(pixel.isnull(), at)
    assert int(result["status"][5, 6]) & Status.INVALID_SAMPLES
    assert result["object_temperature"][:, 5, 6].isnull().all()


def test_memory_does_not_grow_and_the_past_is_forgotten() -> None:
    """A long stream takes no more memory than a new one, and a new object replaces the old."""
    _, first, response = walkers(6, 60.0)
    stream = Stream(first.isel(time=[0]), response, frame_rate=RATE, memory=12.0)
    size = stream.nbytes
    stream.update(first["time"].values, first["counts"].values)
    scene, second = people(7, 600, (12, 20), emissivity_of(0.6, 0.45))
    stream.update(second["time"].values[:300] + 60.0, second["counts"].values[:, :300])
    result = stream.result()
    good = result["status"] == 0
    off = abs(result["emissivity"] - scene["emissivity"]).where(good).median(["y", "x"])
    assert stream.nbytes == size
    assert float(off.max()) < 0.05


def test_a_shift_of_nothing_changes_nothing(glass: Data, plain: tuple[Stream, xr.Dataset]) -> None:
    """Cameras in one place: the second one's frames are resampled to themselves."""
    _, capture, response = glass
    none = field(np.zeros((2, capture.sizes["y"], capture.sizes["x"])))
    shifted = live(capture, response, reflection_shift=none)[0].result()
    xr.testing.assert_allclose(shifted, plain[0].result(), rtol=1e-5)


def test_a_shutter_event_is_told_by_the_segment(glass: Data) -> None:
    """Offsets renewed in the middle are told by the segment, and fewer pixels are flagged."""
    _, capture, response = glass
    spoiled = capture["counts"].values.copy()
    rng = np.random.default_rng(8)
    spoiled[:, 150:] += rng.normal(0, 10.0, (2, 1, *spoiled.shape[2:])).astype(np.float32)  # count
    stream = Stream(capture.isel(time=[0]), response, frame_rate=RATE, refresh=5.0)
    time = capture["time"].values
    stream.update(time[:150], spoiled[:, :150])
    stream.update(time[150:], spoiled[:, 150:], segment=1)
    told = stream.result()["status"].values == 0
    changed = capture.assign(counts=capture["counts"].copy(data=spoiled))
    hidden = live(changed, response)[0].result()["status"].values == 0
    assert told.mean() > max(0.6, hidden.mean())


BAD: list[tuple[dict[str, Any], type[Exception], str]] = [
    ({"frames": np.zeros((2, 12, 20), np.uint16)}, TypeError, "Invalid dtype uint16 of the frames"),
    ({"frames": np.zeros((2, 12, 21), np.float32)}, ValueError, r"Invalid shape \(2, 12, 21\)"),
    ({"time": -1.0}, ValueError, "Invalid time -1.0 s of a frame, after 0.0 s. Must rise"),
    ({"time": np.nan}, ValueError, "Invalid time nan s"),
    ({"segment": -1}, ValueError, "Invalid segment -1 after 0. Must not fall"),
]


@pytest.mark.parametrize(("change", "error", "match"), BAD, ids=[match for _, _, match in BAD])
def test_a_bad_frame_is_named(
    glass: Data, change: dict[str, Any], error: type[Exception], match: str
) -> None:
    """A frame that does not belong to the stream is refused, and the stream goes on."""
    _, capture, response = glass
    stream = Stream(capture.isel(time=[0]), response, frame_rate=RATE)
    good: npt.NDArray[np.float32] = capture["counts"].values[:, 0]
    stream.update(0.0, good)
    arguments: dict[str, Any] = {"time": 1.0, "frames": capture["counts"].values[:, 1]} | change
    assert_raises(error, match, stream.update, **arguments)
    assert_refused("no temperatures are known", stream.result)
    assert stream.update(0.1, capture["counts"].values[:, 1]).sizes["time"] == 0


@pytest.mark.bench
def test_rate_of_full_frames() -> None:
    """Frames of 640x512 in both bands: processor time of a frame, all rows separated."""
    from time import perf_counter, process_time  # noqa: PLC0415

    time, rng, made = np.arange(1500) / 60.0, np.random.default_rng(1), Rig()
    scene = simulation.walkers(time, (16, 20), GLASS, rng)
    capture = simulation.observe(scene, made.response(), rng)
    wide = xr.concat([xr.concat([capture.isel(time=[0])] * 32, "y")] * 32, "x")
    stream = Stream(wide.drop_vars(["y", "x"], errors="ignore"), made.response(), frame_rate=60.0)
    used, passed = [], []
    for now, frame in zip(time, capture["counts"].values.swapaxes(0, 1), strict=True):
        frames = np.tile(frame, (1, 32, 32))
        start, clock = process_time(), perf_counter()
        stream.update(now, frames)
        used.append(process_time() - start)
        passed.append(perf_counter() - clock)
    steady = slice(1500 - 15 * 15, None)
    cost, wall = np.mean(used[steady]), np.mean(passed[steady])
    good = float((stream.result()["status"] == 0).mean())
    print(f"{1e3 * cost:.1f} ms of processor, {1e3 * wall:.1f} ms, a pair; {good:.2f} good")
    print(f"{stream.nbytes / 1e6:.0f} MB, latency {stream.latency} s")
    assert cost < 2.0 / 60.0  # s, on two cores


def test_bands_come_by_name_and_masked_samples_are_missing(glass: Data) -> None:
    """Frames whose bands stand the other way, and masked samples, which are as if missing."""
    _, capture, response = glass
    counts, time = capture["counts"].values[:, :200], capture["time"].values[:200]
    wrong = np.random.default_rng(0).random(counts[:, 0].shape) < 0.02
    kinds: dict[str, list[Any]] = {"plain": [], "named": [], "missing": [], "masked": []}
    for frame in np.moveaxis(counts, 1, 0):
        named = capture["counts"][:, 0].copy(data=frame).isel(band=[1, 0])
        kinds["plain"].append(frame)
        kinds["named"].append(named)
        kinds["missing"].append(np.where(wrong, np.nan, frame))
        kinds["masked"].append(np.ma.masked_array(np.where(wrong, frame + 3000, frame), wrong))
    results = {}
    for kind, frames in kinds.items():
        stream = Stream(capture.isel(time=[0]), response, frame_rate=RATE)
        for now, frame in zip(time, frames, strict=True):
            stream.update(now, frame)
        results[kind] = stream.result()
    xr.testing.assert_identical(results["plain"], results["named"])
    xr.testing.assert_identical(results["missing"], results["masked"])
