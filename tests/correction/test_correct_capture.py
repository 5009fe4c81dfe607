"""All corrections of a raw capture: each mechanism matters, and together they leave the noise."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import xarray as xr
from captures import GLASS, drift

from dbthermal import schema, simulation
from dbthermal.correction import blackbody_statistics, correct_capture, fit_correction
from dbthermal.schema import Status
from reproduction import disturbances

SHAPE, FRAMES, RATE = (24, 30), 240, 60.0  # pixels; frames at so many a second [Hz]
NOISE, LAG = 2.0, 0.012  # [count], [s]
SHUTTER = 3.0  # when it closes, for 0.2 s [s]
PATCH = xr.DataArray(np.indices(SHAPE).max(axis=0) < 10, dims=("y", "x"))


@dataclass(frozen=True)
class Recorded:
    """A raw capture with every nuisance, what it should be, and what was recorded beside it."""

    clean: xr.Dataset
    raw: xr.Dataset
    spoiled: xr.DataArray
    correction: xr.Dataset
    options: dict[str, Any]


@pytest.fixture(scope="module")
def recorded() -> Recorded:
    """Walkers at 60 Hz by cameras that lag, drift, close a shutter, and have bad pixels."""
    rng, rig = np.random.default_rng(4), simulation.Rig(noise=(1e-6, 1e-6), bad_fraction=0.0)
    scene = simulation.walkers(np.arange(FRAMES) / RATE, SHAPE, GLASS, rng)
    clean = simulation.observe(scene, rig.response(), rng)
    clean["counts"] = clean["counts"].where(~PATCH, 17000.0).transpose("band", "time", "y", "x")
    # In the order of the instrument: thermal lag, read-out noise, drift, bad pixels, shutter.
    seen = disturbances.lag(clean, LAG)
    noise = rng.normal(0.0, NOISE, seen["counts"].shape).astype(np.float32)
    seen = drift(seen.assign(counts=seen["counts"] + noise), 60.0)
    seen = disturbances.spoil_pixels(seen, 0.01, rng)
    seen = disturbances.fire_shutter(seen, SHUTTER, rng, duration=0.2)
    detector = simulation.pattern(rig, SHAPE, rng)
    movies = simulation.blackbody_movies(
        simulation.Rig(), np.array([285.0, 300.0, 315.0, 330.0]), 60, detector, rng
    )
    # Since the calibration every offset has changed; a flat image is taken before the capture.
    changed = rng.normal(0.0, 25.0, detector["offset"].shape)
    detector = detector.assign(offset=detector["offset"] + changed)
    flat = detector["gain"] * 17500.0 + detector["offset"]
    return Recorded(
        clean,
        simulation.capture(seen, detector),
        (seen["spoiled"] > 0).any("band"),
        fit_correction(blackbody_statistics(movies)),
        {"flat": flat, "time_constant": LAG, "drift_reference": PATCH},
    )


def error(recorded: Recorded, **changes: Any) -> float:
    """RMS error of the unflagged pixels until the shutter opens, less each band's mean [count].

    A stuck pixel, told as saturated or frozen in any case, counts unless the search flagged it.
    """
    options = {**recorded.options, **changes}
    corrected = correct_capture(recorded.raw, recorded.correction, **options)
    flags = corrected["status"] & ~np.uint32(Status.FROZEN_FRAMES | Status.SATURATED)
    apart = (corrected["counts"] - recorded.clean["counts"]).where(flags == 0)
    apart = apart.where(apart["time"] < SHUTTER + 0.2)
    return float((apart - apart.mean(("time", "y", "x"))).std())


def test_everything_undone_leaves_the_noise(recorded: Recorded) -> None:
    """The error is the read-out noise, raised by undoing the lag as its attribute states."""
    corrected = correct_capture(recorded.raw, recorded.correction, **recorded.options)
    schema.check(corrected, "corrected")
    expected = NOISE * corrected.attrs["lag_noise_amplification"][0]
    assert error(recorded) < 1.2 * expected
    assert (corrected["segment"].diff("time") != 0).sum() == 1
    stuck = (corrected["status"] & np.uint32(Status.DEAD_PIXEL)) != 0
    assert float(stuck.where(recorded.spoiled).mean()) > 0.8
    assert float(stuck.where(~recorded.spoiled).mean()) < 0.01


@pytest.mark.filterwarnings("ignore:Fixed pattern")  # of offsets that were not renewed
@pytest.mark.parametrize(
    ("step", "off"),
    [
        ("flat", None),
        ("shutter", False),
        ("time_constant", None),
        ("bad_pixels", None),
        ("drift_reference", None),
    ],
)
def test_each_step_matters(recorded: Recorded, step: str, off: object) -> None:
    """Without any one of the steps the error is larger by a quarter at least."""
    without, error_with = error(recorded, **{step: off}), error(recorded)
    assert without > 1.25 * error_with


def test_provenance_of_every_step(recorded: Recorded) -> None:
    """Attributes record the steps and their parameters; the raw capture is not changed."""
    before = recorded.raw.copy(deep=True)
    attrs = correct_capture(recorded.raw, recorded.correction, **recorded.options).attrs
    xr.testing.assert_identical(recorded.raw, before)
    expected = {
        "gain_offset_offset_renewed": 1,
        "shutter_events": 2,
        "frames_taken_out": [12, 12],
        "lag_time_constant": [LAG, LAG],
        "bad_threshold": 6.0,
        "drift_order": 5,
        "shutter_closed_frames": -1,
    }
    assert {name: attrs[name] for name in expected} == expected
    plain = correct_capture(recorded.raw, recorded.correction, shutter=False, bad_pixels=None)
    steps = {"shutter_events", "lag_time_constant", "bad_threshold", "drift_order"}
    assert not steps & plain.attrs.keys()


@pytest.mark.filterwarnings("ignore:Fixed pattern")
def test_recorded_flags_tell_the_shutter(recorded: Recorded) -> None:
    """Frames with the recorded flag of a closed shutter are left out though their images differ."""
    flags = np.zeros((2, 100), dtype=np.uint16)
    flags[1, 40:45] = 8
    attrs = {"flag_masks": [4, 8], "flag_meanings": "foreign_clock shutter_closed"}
    raw = recorded.raw.isel(time=slice(100)).assign(frame_flags=(("band", "time"), flags, attrs))
    corrected = correct_capture(raw, recorded.correction)
    lost = corrected["counts"].isnull().all(("y", "x")).values
    assert np.flatnonzero(lost[1]).tolist() == [40, 41, 42, 43, 44]
    assert not lost[0].any()
    assert np.flatnonzero(np.diff(corrected["segment"])).tolist() == [44]
    assert corrected.attrs["shutter_closed_frames"] == [0, 5]
    unknown = raw["frame_flags"].assign_attrs(flag_meanings="foreign_clock closed")
    # Flags that say nothing of a shutter, as of a file from elsewhere: its images tell.
    by_images = correct_capture(raw.assign(frame_flags=unknown), recorded.correction)
    without = correct_capture(raw.drop_vars("frame_flags"), recorded.correction)
    xr.testing.assert_equal(by_images, without.assign(frame_flags=unknown)[list(by_images)])
    assert by_images.attrs["shutter_closed_frames"] == without.attrs["shutter_closed_frames"]


@pytest.mark.filterwarnings("ignore:Fixed pattern")
def test_damaged_frames_are_left_out(recorded: Recorded) -> None:
    """A frame without an exposure time is NaN, and after the lag is undone so is the next."""
    raw = recorded.raw.isel(time=slice(100))
    stamps = np.tile(raw["time"].values, (2, 1))
    stamps[0, 50] = np.nan
    raw = raw.assign(exposure_time=(("band", "time"), stamps, {"units": "s"}))
    corrected = correct_capture(raw, recorded.correction, time_constant=LAG)
    lost = corrected["counts"].isnull().all(("y", "x")).values
    assert np.flatnonzero(lost[0]).tolist() == [0, 50, 51]
    assert np.flatnonzero(lost[1]).tolist() == [0]
    assert corrected.attrs["damaged_frames"] == [1, 0]
