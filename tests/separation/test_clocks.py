"""Clocks that are not even: solved from the real times as well as at even ones, or refused."""

import tracemalloc

import numpy as np
import numpy.typing as npt
import pytest
import xarray as xr
from captures import GLASS, RIG
from scenes import held
from worlds import RESPONSE, World, seen

from dbthermal import separation, simulation
from dbthermal.schema import Status
from dbthermal.simulation import Background
from reproduction.experiments.cases import independent_pixels

FRAME = np.arange(350.0)
EVEN = FRAME / 10.0  # s

CLOCKS: dict[str, npt.NDArray[np.float64]] = {
    "nanoseconds": FRAME * 1e-9,
    "microseconds": FRAME * 1e-6,
    "a frame every 10 minutes": FRAME * 600.0,
    "since 1970": EVEN + 1.7e9,
    "jitter": EVEN + np.random.default_rng(1).uniform(-0.04, 0.04, FRAME.size),
    "at random": np.cumsum(np.random.default_rng(2).exponential(0.1, FRAME.size)),
    "bursts of 8 in 0.7 ms": FRAME // 8 * 0.8 + FRAME % 8 * 1e-4,
    "bursts of 32 in 31 us": FRAME // 32 * 3.2 + FRAME % 32 * 1e-6,
    "5 frames a minute": FRAME // 5 * 60.0 + FRAME % 5 * 0.1,
    "two bursts an hour apart": EVEN + 3600.0 * (FRAME >= 175),
    "two rapid bursts an hour apart": FRAME * 1e-4 + 3600.0 * (FRAME >= 175),
    "two pauses": EVEN + 3600.0 * (FRAME >= 117) + 1800.0 * (FRAME >= 233),
    "a pause of 30 years": EVEN + 1e9 * (FRAME >= 175),
    "slower by five": np.where(FRAME < 175, EVEN, EVEN[175] + (FRAME - 175) * 0.5),
    "slower and slower": np.expm1(FRAME / 44.0),
}
"""Times [s] of 350 frames."""


def seen_at(
    time: npt.NDArray[np.float64], pixels: int, seed: int, *, slow: bool = False
) -> tuple[xr.Dataset, xr.Dataset]:
    """Scene and capture of glass that warms in the real time, people passing frame by frame."""
    rng = np.random.default_rng(seed)
    since = time - time[0]
    # Enough frames for rapid warming.
    quick = not slow and since[-1] > 5.0 and np.sum(since < 20.0) > 150
    constants = (8.0, 20.0) if quick else (0.25 * since[-1], 0.6 * since[-1])  # s
    passing, warming = (
        independent_pixels(
            clock, GLASS, Background(), pixels, rng, start=293.15, stop=323.15, time_constant=tau
        )
        for clock, tau in ((np.arange(time.size) / 10.0, (8.0, 20.0)), (since, constants))
    )
    warm, cold = warming["object_temperature"].values, passing["background_temperature"].values
    scene = simulation.scene(time, warm, cold, GLASS)
    return scene, simulation.observe(scene, RIG.response(), rng)


@pytest.mark.parametrize("clock", CLOCKS)
def test_real_times_are_as_good_as_even_ones(clock: str) -> None:
    """At any times the object is known as at even ones, no pixel is flagged, intervals hold."""
    errors: list[npt.NDArray[np.float64]] = []
    results: list[xr.Dataset] = []
    for time in (EVEN, CLOCKS[clock]):
        scene, capture = seen_at(time, 200, seed=4)
        results.append(separation.solve(capture, RIG.response()))
        errors.append((results[-1]["object_temperature"] - scene["object_temperature"]).values)
    rmse = [float(np.nanmedian(np.sqrt(np.mean(error**2, axis=0)))) for error in errors]
    score = np.abs(errors[1]) / results[1]["object_temperature_std"].values
    covered, flagged = float(np.mean(score < 1.96)), float((results[1]["status"] != 0).mean())
    assert rmse[1] < 1.15 * rmse[0]
    assert 0.93 <= covered <= 0.98
    assert flagged < 0.01
    assert np.nanmax(score) < 6.0


@pytest.mark.parametrize("pixels", [12, 200])
@pytest.mark.parametrize(
    "clock",
    ["bursts of 8 in 0.7 ms", "bursts of 32 in 31 us", "at random", "slower by five", "set by 2 s"],
)
def test_times_of_arrival_are_refused(clock: str, pixels: int) -> None:
    """Times at which evenly exposed frames arrived, or of a clock that was set, are refused."""
    _, capture = seen_at(EVEN, pixels, seed=5)
    time = EVEN + 2.0 * (FRAME >= 175) if clock == "set by 2 s" else CLOCKS[clock]
    message = r"Invalid 'time' of the capture, in steps of .* to .* s: slow changes are not smooth"
    with pytest.raises(ValueError, match=message):
        separation.solve(capture.assign_coords(time=time), RIG.response())


@pytest.mark.long
def test_no_real_clock_is_refused() -> None:
    """Of 100 captures with gaps, at real times, none is refused, whatever the object does."""
    for seed in range(100):
        rng = np.random.default_rng(seed)
        kept = np.sort(rng.permutation(450)[:350]) / 10.0
        gap = rng.uniform(1.0, 3600.0) * (rng.integers(30, 320) <= FRAME)
        time = (kept, EVEN + gap)[seed % 2]
        scene, _ = seen_at(time, int(rng.integers(1, 60)), seed, slow=bool(seed % 3))
        moved = 6.0 * (scene["time"] >= time[rng.integers(350)]) * (seed % 5 == 0)
        wave = 2.0 * np.sin(scene["time"] / rng.uniform(1.0, 10.0)) * (seed % 7 == 0)
        scene["object_temperature"] += (moved + wave).drop_attrs()
        capture = simulation.observe(scene, RIG.response(), rng)
        separation.solve(capture, RIG.response())


@pytest.mark.parametrize("place", [60, 175, 300])
def test_a_jump_beside_a_pause_is_found(place: int) -> None:
    """A jump is found at its frame in a recording that pauses for an hour, with true intervals."""
    time = EVEN + 3600.0 * (FRAME >= 175)
    scene, _ = seen_at(time, 100, seed=6, slow=True)
    step = 6.0 * (scene["time"] >= time[place])
    moved = scene.assign(object_temperature=scene["object_temperature"] + step)
    capture = simulation.observe(moved, RIG.response(), np.random.default_rng(7))
    result = separation.solve(capture, RIG.response())
    jumping = result["status"].values[0] & Status.OBJECT_JUMP != 0
    assert held(result, moved) > 0.92
    assert float(result["object_temperature"].notnull().mean()) > 0.9
    if place != 175:  # a jump in the pause is not sudden: the object has had an hour
        assert jumping.mean() > 0.95
        assert held(result.isel(time=[place]), moved) > 0.85  # of 100 pixels


def peak(scene: xr.Dataset, frame: int, rng: np.random.Generator) -> int:
    """Most memory [byte] by which a scene is separated whose object steps at a frame."""
    step = 6.0 * (scene["time"] >= scene["time"][frame])  # every clock asks for pieces of time
    moved = scene.assign(object_temperature=scene["object_temperature"] + step)
    capture = simulation.observe(moved, RIG.response(), rng)
    tracemalloc.start()
    separation.solve(capture, RIG.response())
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return most


def test_memory_is_that_of_the_frames() -> None:
    """A clock of nanoseconds, or with a pause of 30 years, takes no more memory than another."""
    clocks = EVEN, CLOCKS["nanoseconds"], CLOCKS["a pause of 30 years"]
    scenes = [seen_at(time, 50, seed=1)[0] for time in clocks]
    peaks = [peak(scene, 100, np.random.default_rng(7)) for scene in scenes]
    assert max(peaks) < 1.5 * peaks[0]


def test_memory_grows_with_the_frames_and_not_with_their_square() -> None:
    """An object that steps in a recording of 20 minutes: four times the frames of 5 minutes."""
    peaks = []
    for frames in (3000, 12000):
        time, rng = np.arange(frames) / 10.0, np.random.default_rng(1)
        peaks.append(peak(simulation.walkers(time, (4, 4), GLASS, rng), 1000, rng))
    print(f"peaks [byte]: {peaks}")
    assert peaks[1] < 6.0 * peaks[0]


@pytest.mark.slow
@pytest.mark.parametrize(("lag", "parallax"), [(0.05, 0.0), (0.14, 0.0), (0.14, 2.0)])
def test_clocks_that_differ_are_undone(lag: float, parallax: float) -> None:
    """Cameras at one place or apart, whose clocks differ by a part of a frame or more."""
    capture, truth = seen(World(lag=lag, parallax=parallax), 2)
    with pytest.warns(UserWarning, match="The clocks differ") as said:
        result = separation.separate(capture, RESPONSE)
    (found,) = (text for text in map(str, (it.message for it in said)) if "clocks" in text)
    assert float(found.split("taken ")[1].split(" s")[0]) == pytest.approx(lag, abs=0.002)
    np.testing.assert_array_equal(result["time"], capture["time"])
    sound = result["status"].values == 0
    error = np.abs(result["object_temperature"].values - truth)[:, sound]
    holds = np.nanmean(error < 1.96 * result["object_temperature_std"].values[:, sound])
    print(f"{holds:.3f} of the intervals hold, {sound.mean():.3f} without a flag")
    assert sound.mean() > 0.9
    assert holds > 0.92
