"""Every fault of the rig: its error or its mark in a recording, and no frame lost for it.

Frames come from two emulated cameras with counts that tell their time, and every recording is
checked against its frames (`CheckedRecording`).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, pairwise, repeat
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import xarray as xr
from faulty_camera import BANDS, Faults, two_bands, two_cameras

from dbthermal import store
from dbthermal.instruments import filterwheel
from dbthermal.instruments.boson import BosonError, BosonTimeoutError
from dbthermal.instruments.camera import DAMAGED, UNTIMED, Counts, Frame, FrameFlag
from dbthermal.instruments.emulated import World
from dbthermal.instruments.recording import Limits, Reading, notes, open_capture, record
from dbthermal.instruments.tc08 import ReadingError, TC08Error
from dbthermal.instruments.transport import TransportError

SHAPE, RATE, MILLI = (16, 24), 100.0, 1e-3
LIMITS = Limits(chunk=5, queue=10_000, reserve=0, reading_period=0.02)
PATTERN = np.random.default_rng(1).integers(5000, 6000, SHAPE).astype(np.uint16)
SOURCE_FLAGS = 0x07  # flags that are the source's to set

Read = Callable[[], float]


def picture(time: float) -> Counts:
    """Counts that tell the time [ms], pixel by pixel."""
    return (PATTERN + round(time / MILLI)).astype(np.uint16)


@dataclass
class CheckedRecording:
    """One recording on two emulated cameras, with their faults and the frames that they gave."""

    path: Path
    faults: Mapping[str, Faults] = field(default_factory=dict)
    world: World = field(default_factory=World)

    def __post_init__(self) -> None:
        self.frames: dict[str, list[Frame]] = {band: [] for band in BANDS}
        self.cameras = two_cameras(picture, SHAPE, RATE, faults=self.faults, world=self.world)
        for band, camera in self.cameras.items():
            vars(camera)["read"] = partial(self.witness, band, camera.read)

    def witness(self, band: str, read: Callable[[float], Frame], timeout: float) -> Frame:
        """Read a frame, and keep a copy."""
        frame = read(timeout)
        self.frames[band].append(replace(frame, counts=frame.counts.copy()))
        return frame

    def record(
        self, duration: float, readings: Mapping[str, Read] | None = None
    ) -> "CheckedRecording":
        """Record for a duration [s], and check the recording."""
        instruments = {name: Reading(read) for name, read in (readings or {}).items()}
        session = two_bands(duration, SHAPE, RATE)
        self.summary = record(
            session, dict(self.cameras), self.path, readings=instruments, limits=LIMITS
        )
        self.log = [note[1:] for note in notes(self.path)]
        for band in BANDS:
            self.check(band)
        return self

    def stored(self, band: str) -> xr.Dataset:
        """The frames of a band, without copies of the last one at the end."""
        frames = slice(0, self.summary.totals[band]["frames"])
        return store.open_dataset(self.path).sel(band=band).isel(time=frames)

    def noted(self, source: str) -> list[tuple[str, float]]:
        """Kinds and values of the notes of one source."""
        return [(kind, value) for kind, name, value in self.log if name == source]

    def kinds(self, source: str) -> list[str]:
        """Kinds of the notes of one source."""
        return [kind for kind, _ in self.noted(source)]

    def check(self, band: str) -> None:
        """Check that all frames are stored unchanged, each with its time, and losses counted."""
        frames, kept, faults = self.frames[band], self.stored(band), self.cameras[band].faults
        flags, totals = kept["frame_flags"].values, self.summary.totals[band]

        def flagged(flag: FrameFlag) -> Any:
            return flags & int(flag) > 0

        # All frames, unchanged.
        assert len(frames) == kept.sizes["time"] > 0
        for name in ("counts", "sequence", "device_time"):
            np.testing.assert_array_equal(kept[name], [getattr(frame, name) for frame in frames])
        np.testing.assert_array_equal(flags & SOURCE_FLAGS, [int(frame.flags) for frame in frames])
        repeats = [np.array_equal(a.counts, b.counts) for a, b in pairwise(frames)]
        np.testing.assert_array_equal(flagged(FrameFlag.IMAGE_REPEATED)[1:], repeats)
        # A frame has the time of its counts, or a flag that explains a missing time.
        stamps = kept["exposure_time"].values
        timed = ~flagged(UNTIMED | FrameFlag.FOREIGN_CLOCK)
        np.testing.assert_array_equal(np.isfinite(stamps), timed)
        still = flagged(FrameFlag.SHUTTER_CLOSED | FrameFlag.IMAGE_REPEATED)
        shown = timed & ~still & ~np.isin(kept["sequence"].values, [*faults.repeated])
        assert shown.any() or faults.clock_rate != 1
        statement = MILLI * (kept["counts"].values[shown] - PATTERN.astype(float))
        since = stamps[shown] + kept.attrs["clock_origin"]
        expected = np.broadcast_to(since[:, None, None], statement.shape)
        np.testing.assert_allclose(statement, expected, rtol=0, atol=0.51 * MILLI)
        # Lost and damaged frames and the shutter are in the log and in the totals.
        leaps, kinds = np.diff([frame.sequence for frame in frames]) - 1, self.kinds(band)
        lost = [value for kind, value in self.noted(band) if kind == "frames_lost"]
        assert lost == list(leaps[leaps > 0])
        assert (totals["lost"], totals["refused"]) == (leaps.sum(), 0)
        np.testing.assert_array_equal(flagged(FrameFlag.FRAMES_LOST_BEFORE)[1:], leaps > 0)
        damaged = sum(bool(frame.flags & DAMAGED) for frame in frames)
        assert kinds.count("damaged") == totals["damaged"] == damaged
        changes = np.count_nonzero(np.diff([False, *flagged(FrameFlag.SHUTTER_CLOSED)]))
        assert sum(kind.startswith("shutter") for kind in kinds) == changes


# Cameras: faults of their frames.

OFTEN = frozenset(range(6, 60, 5))
AFTER = frozenset(number + 1 for number in OFTEN)
LOST, ERROR = FrameFlag.FRAMES_LOST_BEFORE, FrameFlag.DRIVER_ERROR

DAMAGES = {
    "dropped": (Faults(dropped=OFTEN | {7, 8}), LOST, "frames_lost"),
    "corrupt": (Faults(corrupt=OFTEN), ERROR, "damaged"),
    "short": (Faults(short=OFTEN), FrameFlag.WRONG_SIZE, "damaged"),
    "dropped and corrupt": (Faults(dropped=OFTEN, corrupt=AFTER), ERROR | LOST, "damaged"),
    "repeated": (Faults(repeated=OFTEN), FrameFlag.IMAGE_REPEATED, ""),
    "shutter": (Faults(ffc=frozenset(range(6, 15))), FrameFlag.SHUTTER_CLOSED, "shutter_closed"),
}
"""Faults of frames, the flag and the note, if there is one, in the log of each."""


@pytest.mark.parametrize("name", DAMAGES)
def test_damaged_frames(name: str, tmp_path: Path) -> None:
    """Damage is flagged and noted for its own camera, and for no other."""
    faults, flag, kind = DAMAGES[name]
    recorded = CheckedRecording(tmp_path / "a.zarr", {"9.5": faults}).record(0.5)
    flags = [FrameFlag(int(value)) for value in recorded.stored("9.5")["frame_flags"]]
    assert any(flag in entries for entries in flags)
    assert kind in recorded.kinds("9.5") or not kind
    assert recorded.noted("8-14") == []
    assert recorded.summary.ended == "duration"


def test_an_unplugged_camera(tmp_path: Path) -> None:
    """The other camera is recorded to the end, and the store marks the end of each band."""
    recorded = CheckedRecording(tmp_path / "a.zarr", {"9.5": Faults(unplugged=12)}).record(0.6)
    frames = recorded.frames["9.5"]
    assert recorded.summary.ended == "source lost"
    assert recorded.noted("8-14") == []
    assert recorded.kinds("9.5")[-1] == "source_lost"
    assert frames[-1].sequence < 12 < recorded.frames["8-14"][-1].sequence
    opened = open_capture(recorded.path)
    after = opened.sel(band="9.5").isel(time=slice(len(frames), None))
    assert opened.attrs["complete"] is False
    assert np.isnan(after["exposure_time"]).all()


def test_a_clock_that_drifts(tmp_path: Path) -> None:
    """Stamps of a camera's own clock are kept, are no times, and are fitted on demand only."""
    recorded = CheckedRecording(tmp_path / "a.zarr", {"9.5": Faults(clock_rate=1.01)}).record(0.4)
    with pytest.raises(ValueError, match=r"exposure times of band '9\.5' of shape \(0,\)"):
        open_capture(recorded.path)
    fitted = open_capture(recorded.path, fitted=True)["exposure_time"].sel(band="9.5")
    frames = recorded.frames["9.5"]
    device, host = ([getattr(f, name) for f in frames] for name in ("device_time", "host_time"))
    line = np.polynomial.Polynomial.fit(device, host, 1)
    expected = line(np.array(device)) - store.open_dataset(recorded.path).attrs["clock_origin"]
    np.testing.assert_allclose(fitted[: len(frames)], expected, rtol=0, atol=1e-6)


# Instruments: errors of the drivers that are read beside the frames.

TROUBLES: list[Exception] = [
    *(BosonError("refused"), BosonTimeoutError("mute"), TransportError("unplugged")),
    *(filterwheel.WheelError("motor hot"), filterwheel.NoReplyError("silent")),
    *(filterwheel.NotHomedError("lost"), filterwheel.StalledWheelError("stuck")),
    *(ReadingError("open"), TC08Error("be read", 16)),
]


def test_an_instrument_that_fails_costs_no_frame(tmp_path: Path) -> None:
    """Slow readings go on beside a failing one; whatever its driver raises is noted as failed."""
    recorded = CheckedRecording(tmp_path / "a.zarr")
    air = Mock(side_effect=chain([300.0, 301.0], repeat(TimeoutError("no answer"))))

    def fail(error: Exception) -> float:
        recorded.world.clock.sleep(0.002)
        raise error

    failing: dict[str, Read] = {type(error).__name__: partial(fail, error) for error in TROUBLES}
    recorded.record(0.8, {**failing, "air": air, "plate": lambda: 300.0})
    for name in failing:
        assert {*recorded.kinds(name)} == {"reading_failed"}
    assert recorded.noted("air")[:2] == [("reading", 300.0), ("reading", 301.0)]
    assert {*recorded.kinds("air")[2:]} == {"reading_failed"}
    assert {*recorded.noted("plate")} == {("reading", 300.0)}
