"""Frames that show no scene, repeated streams and patterns that change: of known truth."""

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import xarray as xr
from captures import plain_capture
from scipy.ndimage import gaussian_filter

from dbthermal import separation, simulation
from dbthermal.correction import blackbody_statistics, correct_capture, fit_correction
from dbthermal.schema import Status

Array = np.ndarray[Any, np.dtype[Any]]
BANDS, SHAPE, TIME = ["8-14", "9.5"], (30, 40), np.arange(240) / 10.0
GLASS, PAINT = (0.86, 0.72), (0.93, 0.82)
ROWS, COLUMNS = np.indices(SHAPE)
SEEN = range(100, 106)
Event = Callable[[Array, Array, np.random.Generator], None]


def scene(event: str, rng: np.random.Generator) -> tuple[Array, Array]:
    """Temperatures of object and surroundings (time, y, x) [K] with people, and an event."""
    rise = 15.0 * (1.0 - np.exp(-TIME / 15.0))[:, None, None]
    object_part = 295.0 + rise * (0.8 + 0.2 * COLUMNS / SHAPE[1])
    room = np.full(object_part.shape, 295.0)
    for start in rng.uniform(0.0, TIME[-1], 6):
        place = (20.0 + rng.uniform(8.0, 40.0) * (TIME - start))[:, None, None]
        person = (np.abs(COLUMNS - place) < rng.uniform(2.0, 5.0)) & (rng.uniform(0, 9) < ROWS)
        room += rng.uniform(5.0, 10.0) * gaussian_filter(person * 1.0, (0.0, 0.8, 0.8))
    since = np.maximum(TIME - TIME[120] + 0.1, 0.1)[:, None, None] * 10.0
    later = (TIME[120] <= TIME)[:, None, None]
    place = np.hypot(ROWS - 15, COLUMNS - 20)
    if event == "pour":
        object_part += later * (place < 14) * 20.0 * np.exp(-since / 30.0)
    if event == "touch":
        object_part += 10.0 * (place < 12) * ((TIME > 12.0) & (TIME < 13.0))[:, None, None]
    if event == "flash":
        object_part += later * 8.0 / np.sqrt(since)
    if event == "lamp":
        room += 10.0 * (TIME % 4.0 < 0.5)[:, None, None] * (1.0 + 0.3 * np.cos(ROWS / 9.0))
    if event == "fan":
        turning = np.arctan2(ROWS - 15, COLUMNS - 20) - 5.3 * TIME[:, None, None]
        room += 6.0 * (np.sin(3.0 * turning) > 0.0)
    if event == "near":
        person = np.abs(COLUMNS - 20 - 80.0 * (TIME[:, None, None] - 9.0)) < 25
        room += 8.0 * person * (1.0 + COLUMNS / 40)
    return object_part, room


def recorded(
    seed: int, event: str = "", spoil: Event | None = None, pattern: Array | float = 0.0
) -> tuple[xr.Dataset, xr.Dataset, xr.Dataset]:
    """Raw capture of glass beside paint, its correction, and its truth; a pattern [K] is added."""
    rng = np.random.default_rng(seed)
    object_part, room = scene(event, rng)
    rig = simulation.Rig(bands=tuple(BANDS), bad_fraction=0.0)
    values = [np.where(COLUMNS > 20, *pair) for pair in zip(PAINT, GLASS, strict=True)]
    truth = xr.Dataset(
        {
            "object_temperature": (("time", "y", "x"), object_part, {"units": "K"}),
            "background_temperature": (("time", "y", "x"), room, {"units": "K"}),
            "emissivity": (("band", "y", "x"), values),
        },
        {"time": TIME, "band": BANDS},
    )
    seen = simulation.observe(truth, rig.response(), rng)
    counts = seen["counts"].transpose("band", "time", "y", "x")
    slope = rig.response()["linear_slope"].values.reshape(2, 1, 1, 1)
    counts = counts.copy(data=(counts.values + slope * pattern).astype(np.float32))
    detector = simulation.pattern(rig, SHAPE, rng)
    movies = simulation.blackbody_movies(rig, np.linspace(275.0, 345.0, 6), 32, detector, rng)
    raw = simulation.capture(seen.assign(counts=counts), detector)
    if spoil is not None:
        film = raw["counts"].values.copy()
        spoil(film, detector["gain"].values * 21000.0 + detector["offset"].values, rng)
        raw = raw.assign(counts=raw["counts"].copy(data=film))
    fitted = fit_correction(blackbody_statistics(movies))
    return raw, fitted, truth.assign(slope=("band", slope.ravel()))


def corrected(raw: xr.Dataset, correction: xr.Dataset) -> tuple[xr.Dataset, str, list[set[int]]]:
    """Corrected capture, its warnings, and the frames that are left out of each band."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        result = correct_capture(raw, correction)
    lost = result["counts"].isnull().all(("y", "x")).values
    text = " ".join(str(warning.message) for warning in said)
    return result, text, [set(np.flatnonzero(frames)) for frames in lost]


def uniform(flat: Array, rng: np.random.Generator, frames: int) -> Array:
    """Frames of a shutter, nearly uniform, by the same detector."""
    return np.rint(flat + rng.normal(0.0, 3.6, (frames, *SHAPE)) + COLUMNS / 4.0).astype(np.uint16)


def shutter(film: Array, flat: Array, rng: np.random.Generator) -> None:
    """The first camera's shutter is seen."""
    film[0, SEEN] = uniform(flat[0], rng, len(SEEN))


def shutters(film: Array, flat: Array, rng: np.random.Generator) -> None:
    """Both shutters are seen, half closed at first."""
    for band in (0, 1):
        frames = uniform(flat[band], rng, len(SEEN))
        frames[0, :15] = film[band, SEEN[0], :15]
        film[band, SEEN] = frames


def black(film: Array, *_: object) -> None:
    """Two frames of the first camera are black."""
    film[0, 100:102] = 0


def white(film: Array, *_: object) -> None:
    """A frame of the second camera is at the upper end."""
    film[1, 100] = 65535


def torn(film: Array, *_: object) -> None:
    """A third of a frame is missing."""
    film[0, 100, 20:] = 0


def garbage(film: Array, _: Array, rng: np.random.Generator) -> None:
    """Both cameras begin with frames of random counts."""
    film[:, :3] = rng.integers(0, 65536, (2, 3, *SHAPE))


def gain(film: Array, *_: object) -> None:
    """The first camera switches to a quarter of its gain, for the last third."""
    film[0, 160:] = np.rint(0.25 * film[0, 160:] + 9000.0)


LOST: dict[Event, list[set[int]]] = {
    shutter: [set(SEEN), set()],
    shutters: [set(SEEN), set(SEEN)],
    black: [{100, 101}, set()],
    white: [set(), {100}],
    torn: [{100}, set()],
    garbage: [{0, 1, 2}, {0, 1, 2}],
    gain: [set(range(160, 240)), set()],
}


@pytest.mark.parametrize("spoil", LOST, ids=lambda spoil: spoil.__name__)
@pytest.mark.parametrize("seed", range(2))
def test_frames_without_a_scene_are_left_out(seed: int, spoil: Event) -> None:
    """Each is NaN in its band, no pixel is saturated by it, and the warning names it."""
    raw, correction, _ = recorded(seed, spoil=spoil)
    result, said, lost = corrected(raw, correction)
    for frames, bad in zip(lost, LOST[spoil], strict=True):
        assert bad <= frames
        assert len(frames - bad) <= 2  # beside a shutter, where people move
    assert not (result["status"] & np.uint32(Status.SATURATED)).any()
    assert "are left out" in said
    assert spoil is not black or "predict, 2 in all" in said  # one is a copy
    renewed = spoil in {shutter, shutters}
    assert ("a shutter that is seen" in said) == renewed
    assert np.unique(result["segment"]).size == 1 + renewed


@pytest.mark.parametrize("event", ["", "pour", "touch", "flash", "lamp", "fan", "near"])
def test_scenes_are_no_bad_frames(event: str) -> None:
    """People, pours, hands, flashes, lamps and fans: no frame is left out, or begins a segment."""
    total = 0
    for seed in range(10, 14):
        result, said, lost = corrected(*recorded(seed, event)[:2])
        total += sum(map(len, lost))
        assert not result["segment"].any()
        assert total or not said
    print(f"'{event}': {total} of {4 * 2 * TIME.size} frames left out")
    assert total <= 0.01 * 4 * 2 * TIME.size


def repeated(raw: xr.Dataset, times: tuple[int, int], later: int = 0) -> xr.Dataset:
    """Streams that show each frame so many times in each band, the second some frames later."""
    counts, frames = raw["counts"].values, 240 * min(times)
    places = [np.arange(frames) // times[0], (np.arange(frames) + later) // times[1]]
    films = [band[np.minimum(place, 239)] for band, place in zip(counts, places, strict=True)]
    return plain_capture(np.stack(films), np.arange(frames) / 30.0)


@pytest.mark.parametrize(("times", "later"), [((3, 3), 0), ((3, 3), 1), ((3, 1), 0), ((2, 4), 1)])
def test_distinct_frames_of_a_faster_stream_are_kept(times: tuple[int, int], later: int) -> None:
    """One of each frame of the slower camera is kept, at its time, and one of the other then."""
    raw, correction, _ = recorded(3)
    stream = repeated(raw, times, later)
    result, said, lost = corrected(stream, correction)
    assert "Each frame is repeated" in said
    stamps = result.get("exposure_time", result["time"].expand_dims(band=BANDS)).values
    for band, missing in enumerate(lost):
        frames = np.setdiff1d(np.arange(result.sizes["time"]), list(missing))
        step = np.diff(stamps[band, frames])[2:-2]
        np.testing.assert_allclose(step, max(times) / 30.0, rtol=0, atol=1e-9)  # [s]
        # Each as the stream shows it at its time.
        places = np.rint(stamps[band, frames] * 30.0).astype(int)
        film = stream["counts"].values[band, places].astype(np.float64)
        gain, offset = correction["gain"].values[band], correction["offset"].values[band]
        counts = result["counts"].values[band, frames]
        np.testing.assert_allclose(counts, gain * film + offset, rtol=0, atol=0.1)  # [count]
    assert max(map(len, lost)) <= 2


def holds(result: xr.Dataset, truth: xr.Dataset) -> float:
    """Share of the 95 % intervals of unflagged pixels that hold."""
    good = (result["status"] == 0).values
    error = (result["object_temperature"] - truth["object_temperature"]).values[:, good]
    return float(np.mean(np.abs(error) < 1.96 * result["object_temperature_std"].values[:, good]))


def test_an_unmarked_step_of_the_pattern_begins_a_segment() -> None:
    """A change of 0.3 K, of zero mean, in the second band: found at its frame, and bars hold."""
    step = np.zeros((2, TIME.size, *SHAPE))
    step[1, 120:] = 0.3 * np.random.default_rng(1).standard_normal(SHAPE)
    raw, correction, truth = recorded(4, pattern=step)
    result, said, _ = corrected(raw, correction)
    assert "The fixed pattern of band '9.5' changes at frame 120" in said
    np.testing.assert_array_equal(np.flatnonzero(np.diff(result["segment"])), [120])
    response = simulation.Rig(bands=tuple(BANDS)).response()
    share = holds(separation.separate(result, response), truth)
    print(f"{share:.3f} of the intervals hold")
    assert share > 0.9


def test_a_pattern_since_the_calibration_is_in_the_bars() -> None:
    """Of 0.1 and 0.3 K, a part of it smooth: `pattern_std` states it, and bars hold."""
    rng = np.random.default_rng(2)
    smooth = gaussian_filter(rng.standard_normal((2, *SHAPE)), (0, 10, 10))
    smooth /= smooth.std(axis=(1, 2), keepdims=True)
    pattern = 0.8 * rng.standard_normal((2, *SHAPE)) + 0.6 * smooth
    pattern *= np.array([0.1, 0.3]).reshape(2, 1, 1)
    raw, correction, truth = recorded(5, pattern=pattern[:, np.newaxis])
    result, _, _ = corrected(raw, correction)
    stated = (result["pattern_std"] / truth["slope"]).values
    plain = (corrected(*recorded(5)[:2])[0]["pattern_std"] / truth["slope"]).values
    share = holds(separation.separate(result, simulation.Rig(bands=tuple(BANDS)).response()), truth)
    print(f"{stated.round(3)} K of the pattern, {plain.round(3)} K without; {share:.3f} hold")
    np.testing.assert_allclose(stated, [0.1, 0.3], rtol=0.2)
    assert np.all(plain < [0.005, 0.045])
    assert share > 0.9
