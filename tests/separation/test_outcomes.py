"""What comes out of the default way, on small simulated scenes, whatever is inside of it.

Bounds are what the code reached on three seeds when they were written, with a tenth to spare.
"""

from typing import Final, NamedTuple

import numpy as np
import pytest
import xarray as xr
from captures import emissivity_of
from scenes import GLASS, SHAPE, TIME, Shelf, field, held, judged, observed
from scipy.ndimage import gaussian_filter
from scipy.signal import lfilter

from dbthermal import separation, simulation
from dbthermal.schema import COMPLETED, Status


class Bounds(NamedTuple):
    """Bounds of the figures of `scenes.judged`; nothing is asked of what is not stated."""

    measured: float = 0.0  # at least
    rmse: float = np.inf  # at most [K]
    cover: tuple[float, float] = (0.92, 0.98)
    silent: float = 0.0  # at most
    emissivity: float = np.inf  # at most
    p90: float = np.inf  # at most [K]
    whole: float = 0.92  # at least
    empty: float = 0.0  # at most
    shift: str = "none"
    said: str | None = None  # how the only warning begins; of any or none: ""


BOUNDS: Final[dict[str, Bounds]] = {
    "one place": Bounds(0.93, 0.067, emissivity=0.003, p90=0.08),
    "apart": Bounds(0.87, 0.059, emissivity=0.003, p90=0.15, shift="found"),
    "two materials": Bounds(0.91, 0.088, emissivity=0.005, p90=0.11),
    "two materials, apart": Bounds(
        0.88, 0.125, (0.92, 0.985), 0.012, 0.006, p90=0.2, shift="found"
    ),
    "still half": Bounds(0.58, 0.06, emissivity=0.003, p90=0.17),
    # The intervals hold in 80 to 96 %, as the seed wills.
    "still half, apart": Bounds(
        0.56, 0.14, (0.78, 0.98), emissivity=0.02, p90=0.19, whole=0.86, shift="found"
    ),
    "rapid": Bounds(0.79, 0.20, emissivity=0.003, p90=0.27),
    "rapid, apart": Bounds(
        0.86, 0.225, (0.89, 0.98), 0.007, 0.004, p90=0.28, whole=0.89, shift="found"
    ),
    "rapid before a still half": Bounds(0.40, 0.23, (0.92, 0.99), emissivity=0.005, p90=0.29),
    "samples lost": Bounds(0.88, 0.065, emissivity=0.003, p90=0.085, empty=0.035),
    "gray": Bounds(p90=2.6, whole=0.91),
    # Intervals of the metal, which is completed, are too short: they hold in 30 to 50 %.
    "metal beside glass": Bounds(0.53, 0.40, silent=0.005, emissivity=0.003, p90=8.5, whole=0.63),
    "nearly black": Bounds(0.97, 0.041, emissivity=0.003, p90=0.055),
    "weak reflections": Bounds(0.97, 0.030, emissivity=0.004, p90=0.041),
    "swapped order": Bounds(0.95, 0.142, emissivity=0.003, p90=0.15),
    "three bands": Bounds(0.96, 0.055, emissivity=0.002, p90=0.057),
    "shutter events": Bounds(0.97, 0.155, emissivity=0.009, p90=0.245),
    "two frames late": Bounds(0.98, 0.06, p90=0.1, shift="none", said="The clocks differ"),
    "uneven times": Bounds(0.93, 0.065, emissivity=0.003, p90=0.084),
    # More of a drift than the prior's, along the object's curve: emissivities are 0.08 off.
    "drift": Bounds(0.79, 0.058, emissivity=0.095, p90=0.37, whole=0.82),
    "nobody": Bounds(p90=0.23),
    "slow, apart": Bounds(0.82, 0.065, (0.92, 0.99), emissivity=0.02, p90=0.195, shift="found"),
    "hot, half still": Bounds(0.60, 0.095, (0.91, 1.0), emissivity=0.012, p90=12.0),
    "hot, half constant": Bounds(0.96, 0.027, emissivity=0.001, p90=0.039),
    "thermostat": Bounds(p90=0.88, whole=0.97),
    "undulating": Bounds(0.80, 0.13, (0.90, 0.98), 0.004, 0.042, p90=0.22, whole=0.90),
    "bowl": Bounds(0.97, 0.063, emissivity=0.03, p90=0.088),
    "dust": Bounds(0.67, 0.255, (0.91, 0.98), 0.005, 0.016, p90=0.385),
    # Of two other seeds 2 and 14 % of the pixels are measured.
    "rapid, nearly black, apart": Bounds(
        0.30, silent=0.07, cover=(0.90, 0.99), whole=0.9, shift="found"
    ),
    "lamp": Bounds(0.96, 0.070, (0.91, 0.98), emissivity=0.004, p90=0.095),
    # Too short intervals of too few pixels, where one outline tells the shift.
    "lamp, apart": Bounds(0.20, 0.165, (0.83, 0.99), 0.03, 0.007, 0.15, 0.87, shift="found"),
    # What no shift explains is warned of; the rest is as good as it comes.
    "two depths": Bounds(
        0.5, 0.5, (0.92, 0.99), 0.04, 0.026, p90=0.6, whole=0.9, shift="found", said="The bands"
    ),
}
# Bounds that are missed since the ratios of cameras apart are those of maps.
MISSED: Final = {
    "rapid, nearly black, apart": "measured 0.20, and a warning: flags of a first pass are lost",
}
SLOW: Final = {
    *("still half, apart", "rapid, apart", "rapid, nearly black, apart"),
    *("slow, apart", "lamp, apart", "two depths"),
}


def marks(name: str) -> list[pytest.MarkDecorator]:
    """Marks of a scene that takes long, or misses its bounds."""
    missed = [pytest.mark.xfail(reason=MISSED[name], strict=True)] if name in MISSED else []
    return missed + ([pytest.mark.slow] if name in SLOW else [])


@pytest.mark.parametrize("name", [pytest.param(name, marks=marks(name)) for name in BOUNDS])
def test_separate(shelf: Shelf, name: str) -> None:
    """Temperatures, intervals, emissivities, flags, the shift and the warnings of each scene."""
    outcome, bounds = shelf.outcome(name), BOUNDS[name]
    figures = judged(shelf.scene(name), outcome.result)
    print(name, {key: round(value, 4) for key, value in figures.items()})
    assert outcome.result.attrs["reflection_shift"] == bounds.shift
    assert list(outcome.said) == outcome.result.attrs.get("warnings", [])
    if bounds.said is None:
        assert outcome.said == ()
    elif bounds.said:
        assert outcome.said
        assert all(sentence.startswith(bounds.said) for sentence in outcome.said)
    assert figures["measured"] >= bounds.measured
    assert figures["empty"] <= bounds.empty
    assert figures["whole"] >= bounds.whole
    assert figures["p90"] <= bounds.p90
    if bounds.measured:
        assert figures["rmse"] <= bounds.rmse
        assert bounds.cover[0] <= figures["cover"] <= bounds.cover[1]
        assert figures["silent"] <= bounds.silent
        assert figures["emissivity"] <= bounds.emissivity


@pytest.mark.parametrize("name", ["still half", "gray", "nobody", "samples lost"])
def test_what_is_completed_says_so(shelf: Shelf, name: str) -> None:
    """Whatever a pixel alone does not tell is flagged; nothing measured passes as completed."""
    alone, result = shelf.outcome(name, "solve").result, shelf.outcome(name).result
    missing = alone["object_temperature"].isnull().all("time")
    there = result["object_temperature"].notnull().any("time")
    told = (result["status"] & np.uint32(COMPLETED)) != 0
    by_material = result["material"] >= 0
    assert bool((told | by_material | ~(missing & there)).all())
    if name in ("gray", "nobody"):
        assert bool((told | ~there).all())


@pytest.mark.parametrize("name", ["gray", "nobody", "still half", "weak reflections"])
def test_no_picture_is_worse_than_the_reading(shelf: Shelf, name: str) -> None:
    """Half of the samples are nearer to the truth than half of what the camera reads."""
    truth = shelf.scene(name).truth["object_temperature"]
    errors = [
        float(abs(shelf.outcome(name, way).result["object_temperature"] - truth).median())
        for way in ("separate", "apparent")
    ]
    assert errors[0] < errors[1]


def test_lost_samples_cost_themselves_alone(shelf: Shelf) -> None:
    """Bad pixels stay empty without a bit of completion, lost frames NaN and counted."""
    scene, result = shelf.scene("samples lost"), shelf.outcome("samples lost").result
    bad = (scene.capture["status"] != 0).values
    bad[3, 4] = True  # of a constant signal
    empty = result["object_temperature"].isnull()
    np.testing.assert_array_equal(empty.all("time"), bad)
    assert not bool((result["status"].values[bad] & np.uint32(COMPLETED)).any())
    lost = [0, 50, 51, 52, 120, 219]
    np.testing.assert_array_equal(np.flatnonzero(empty.all(("y", "x"))), lost)
    assert result.attrs["frames_missing"] == len(lost)
    bridged = shelf.outcome("samples lost", "solve").result["object_temperature"].isnull() & ~empty
    assert held(result, scene.truth, where=bridged) > 0.9
    plain = judged(shelf.scene("one place"), shelf.outcome("one place").result)
    assert judged(scene, result)["p90"] < 1.2 * plain["p90"]


def test_a_displacement_that_one_window_tells_is_none(shelf: Shelf) -> None:
    """Of a capture that lacks samples nearly everywhere, the rest of the image tells nothing."""
    result = shelf.outcome("samples lost", seed=2).result
    assert result.attrs["reflection_shift"] == "none"


def test_cameras_apart_are_as_good_as_at_one_place(shelf: Shelf) -> None:
    """A displaced reflection costs no accuracy; pixels whose pair is outside are told."""
    scene, result = shelf.scene("apart"), shelf.outcome("apart").result
    one = judged(shelf.scene("one place"), shelf.outcome("one place").result)
    assert judged(scene, result)["rmse"] < 1.1 * one["rmse"]
    alone = shelf.outcome("apart", "solve").result  # without the shift
    assert float((alone["status"] == 0).mean()) < 0.6
    true = scene.truth["shift"].values
    unpaired = (result["status"] & np.uint32(Status.NO_REFLECTION_PAIR)).values != 0
    outside = np.arange(SHAPE[1]) < true[1, :, :4].min() - 0.6
    assert outside.any()
    assert unpaired[:, outside].all()
    assert unpaired[:, SHAPE[1] // 2 :].mean() < 0.01


def test_shutter_events_that_nobody_marks_are_flagged(shelf: Shelf) -> None:
    """Without the numbers of the segments fewer than three pixels in ten have no flag."""
    scene = shelf.scene("shutter events")
    result = separation.solve(scene.capture.drop_vars("segment"), scene.response)
    good = result["status"] == 0
    assert float(good.mean()) < 0.3


def test_a_thermostat_is_no_constant_object(shelf: Shelf) -> None:
    """What changes before a room at rest is not what the plate mirrors."""
    status = shelf.outcome("thermostat").result["status"].values
    both = np.uint32(Status.CONSTANT_OBJECT | Status.ROLES_MAY_BE_SWAPPED)
    assert np.mean((status & both) == np.uint32(Status.CONSTANT_OBJECT)) < 0.01


def test_a_metal_is_not_taken_for_the_glass_beside_it(shelf: Shelf) -> None:
    """A gray metal tells no emissivity: of its pixels next to none has no flag."""
    scene, result = shelf.scene("metal beside glass"), shelf.outcome("metal beside glass").result
    of = scene.truth["emissivity"][0].values < 0.5
    assert np.mean(result["status"].values[of] == 0) < 0.01


@pytest.mark.slow
def test_what_is_around_hides_no_displacement(shelf: Shelf) -> None:
    """Cameras are told apart by the measured pixels, few of the image as these are."""
    scene = shelf.scene("apart")
    around = {"y": (10, 18), "x": (20, 20)}
    padded = scene.capture.drop_vars(["y", "x"], errors="ignore").pad(
        around, constant_values=np.nan
    )
    result = separation.separate(padded, scene.response)
    assert result.attrs["reflection_shift"] == "found"
    inside = result["status"].values[10 : 10 + SHAPE[0], 20 : 20 + SHAPE[1]]
    plain = float((shelf.outcome("apart").result["status"] == 0).mean())
    assert float((inside == 0).mean()) > plain - 0.05


def test_a_shift_of_zero_changes_nothing(shelf: Shelf) -> None:
    """Cameras at one place: the result is that without a shift."""
    scene, plain = shelf.scene("one place"), shelf.outcome("one place", "solve").result
    none = field(np.zeros((2, *SHAPE)))
    result = separation.solve(scene.capture, scene.response, reflection_shift=none)
    np.testing.assert_array_equal(result["status"], plain["status"])
    for name in ("object_temperature", "emissivity"):
        good = plain["status"] == 0
        np.testing.assert_allclose(
            result[name].where(good), plain[name].where(good), rtol=0, atol=1e-3
        )


def test_what_is_measured_stays_when_the_rest_is_completed(shelf: Shelf) -> None:
    """`complete` leaves values and bits of a measured pixel, and fills all others, flagged."""
    scene, alone = shelf.scene("still half"), shelf.outcome("still half", "solve").result
    whole = separation.complete(alone, scene.capture, scene.response)
    for name in alone.data_vars:
        if name not in ("status", "noise"):
            assert bool(whole[name].notnull().all()), name
            xr.testing.assert_identical(whole[name].where(alone[name].notnull()), alone[name])
    missing = alone["object_temperature"].isnull().any("time")
    assert bool(missing.any())
    told = (whole["status"] & np.uint32(Status.COMPLETED_FROM_PRIOR)) != 0
    assert bool((told | ~missing).all())
    xr.testing.assert_equal(whole["status"] & ~np.uint32(COMPLETED), alone["status"])


def test_material_elsewhere_completes_within_noise(shelf: Shelf) -> None:
    """With the labels of one material the still half is right within 0.1 K, and says from what."""
    scene, alone = shelf.scene("still half"), shelf.outcome("still half", "solve").result
    labels = xr.zeros_like(alone["status"]).astype(int)
    whole = separation.complete(alone, scene.capture, scene.response, labels)
    missing = alone["object_temperature"].isnull()
    error = abs(whole["object_temperature"] - scene.truth["object_temperature"]).where(missing)
    assert float(error.median()) < 0.1  # K
    assert held(whole, scene.truth, where=missing) > 0.9
    still = whole["status"].where(missing.any("time"), 0).astype(int)
    assert bool((((still & int(Status.COMPLETED_FROM_MATERIAL)) != 0) | (still == 0)).all())


def test_a_stream_agrees_with_the_whole_capture(shelf: Shelf) -> None:
    """Frame by frame: intervals hold the truth at all times, and what is known at the end."""
    scene, batch = shelf.scene("one place"), shelf.outcome("one place", "solve").result
    counts, time = scene.capture["counts"].values, scene.capture["time"].values
    template = scene.capture.isel(time=[0])
    stream = separation.Stream(template, scene.response, frame_rate=10.0, refresh=5.0)
    parts = [stream.update(now, counts[:, i]) for i, now in enumerate(time)]
    films = xr.concat(
        [part[["object_temperature", "object_temperature_std"]] for part in parts], "time"
    )
    last = stream.result()
    good = (last["status"] == 0) & (batch["status"] == 0)
    for name, one, least in (("all", films, 0.92), ("end", last, 0.90)):
        for other, lowest in ((scene.truth, least), (batch, 0.95)):
            assert held(one, other, where=good) > lowest, name
    assert float(good.sum() / (batch["status"] == 0).sum()) > 0.95


@pytest.mark.parametrize("seed", [2, 3])
def test_reflections_that_fade_out_are_right(seed: int) -> None:
    """Where a switched heater is hardly mirrored, what an order hides of the object is no ratio."""
    rng, shape = np.random.default_rng(seed), (48, 64)
    middle, period = rng.uniform(0.3, 0.7, 2) * shape, rng.uniform(2.0, 4.0)
    lit = lfilter([0.25], [1.0, -0.75], np.floor(TIME / period) % 2)
    away = np.indices(shape) - middle[:, np.newaxis, np.newaxis]
    cold = 294.0 + 12.0 * np.multiply.outer(lit, np.exp(-0.5 * (away**2).sum(axis=0) / 12.0**2))
    warmth = gaussian_filter(rng.standard_normal(shape), 9.0)
    warmth = 7.5 + 7.5 * (warmth - warmth.min()) / np.ptp(warmth)
    rise = TIME / TIME[-1] + 0.1 * np.sin(2.0 * np.pi * TIME / TIME[-1])
    warm = 295.5 + np.multiply.outer(rise, warmth)
    truth = simulation.scene(TIME, warm, cold, emissivity_of(*GLASS))
    scene = observed(truth, rng, simulation.Rig(noise=(0.03, 0.2)))
    figures = judged(scene, separation.separate(scene.capture, scene.response))
    assert figures["measured"] > 0.7
    assert figures["rmse"] < 0.06  # K
    assert figures["cover"] >= 0.93
    assert figures["silent"] == 0.0
