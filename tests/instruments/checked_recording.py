"""A recording on two emulated cameras whose counts tell the time, checked against their frames."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from faulty_camera import BANDS, Faults, FaultyCamera, two_bands, two_cameras

from dbthermal import store
from dbthermal.instruments.camera import DAMAGED, UNTIMED, Counts, Frame, FrameFlag
from dbthermal.instruments.emulated import World
from dbthermal.instruments.recording import Limits, Reading, notes, record

SHAPE, RATE, MILLI = (16, 24), 100.0, 1e-3
LIMITS = Limits(chunk=5, queue=10_000, reserve=0, reading_period=0.02)
PATTERN = np.random.default_rng(1).integers(5000, 6000, SHAPE).astype(np.uint16)
SOURCE_FLAGS = 0x07  # flags that are the source's to set

Read = Callable[[], float]


def picture(time: float) -> Counts:
    """Counts that tell the time [ms], pixel by pixel."""
    return (PATTERN + round(time / MILLI)).astype(np.uint16)


class Witness(FaultyCamera):
    """An emulated camera that keeps a copy of every frame that it gave."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.frames: list[Frame] = []

    def read(self, timeout: float = 1.0) -> Frame:
        """Give a frame, and keep a copy."""
        frame = super().read(timeout)
        self.frames.append(replace(frame, counts=frame.counts.copy()))
        return frame


@dataclass
class CheckedRecording:
    """One recording on two emulated cameras, with their faults and the frames that they gave."""

    path: Path
    faults: Mapping[str, Faults] = field(default_factory=dict)
    world: World = field(default_factory=World)

    def __post_init__(self) -> None:
        self.cameras = two_cameras(
            picture, SHAPE, RATE, faults=self.faults, world=self.world, kind=Witness
        )

    def frames(self, band: str) -> list[Frame]:
        """Frames that the camera of a band gave."""
        camera = self.cameras[band]
        assert isinstance(camera, Witness)
        return camera.frames

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
        frames, kept = self.frames(band), self.stored(band)
        assert len(frames) == kept.sizes["time"] > 0
        np.testing.assert_array_equal(kept["counts"], [frame.counts for frame in frames])
        np.testing.assert_array_equal(kept["sequence"], [frame.sequence for frame in frames])
        np.testing.assert_array_equal(kept["device_time"], [frame.device_time for frame in frames])
        flags = kept["frame_flags"].values
        np.testing.assert_array_equal(flags & SOURCE_FLAGS, [int(frame.flags) for frame in frames])
        repeats = [np.array_equal(a.counts, b.counts) for a, b in pairwise(frames)]
        np.testing.assert_array_equal(flags[1:] & int(FrameFlag.IMAGE_REPEATED) > 0, repeats)
        self.check_times(kept, flags, self.cameras[band].faults)
        self.check_losses(band, frames, flags)

    def check_times(self, kept: xr.Dataset, flags: Any, faults: Faults) -> None:
        """Check that a frame has the time of its counts, or a flag that explains a missing time."""
        stamps = kept["exposure_time"].values
        timed = (flags & int(UNTIMED | FrameFlag.FOREIGN_CLOCK)) == 0
        np.testing.assert_array_equal(np.isfinite(stamps), timed)
        lies = np.isin(kept["sequence"].values, [*faults.repeated])
        still = FrameFlag.SHUTTER_CLOSED | FrameFlag.IMAGE_REPEATED
        view_mask = timed & ((flags & int(still)) == 0) & ~lies
        assert view_mask.any() or faults.clock_rate != 1
        statement = MILLI * (kept["counts"].values[view_mask] - PATTERN.astype(float))
        since = stamps[view_mask] + kept.attrs["clock_origin"] - self.world.epoch
        expected = np.broadcast_to(since[:, None, None], statement.shape)
        np.testing.assert_allclose(statement, expected, rtol=0, atol=0.51 * MILLI)

    def check_losses(self, band: str, frames: list[Frame], flags: Any) -> None:
        """Check that lost and damaged frames and the shutter are in the log and in the totals."""
        leaps = np.diff([frame.sequence for frame in frames]) - 1
        entries, totals = self.noted(band), self.summary.totals[band]
        assert [value for kind, value in entries if kind == "frames_lost"] == list(leaps[leaps > 0])
        assert (totals["lost"], totals["refused"]) == (leaps.sum(), 0)
        statement = flags[1:] & int(FrameFlag.FRAMES_LOST_BEFORE) > 0
        np.testing.assert_array_equal(statement, leaps > 0)
        damaged = sum(bool(frame.flags & DAMAGED) for frame in frames)
        assert self.kinds(band).count("damaged") == totals["damaged"] == damaged
        closed = [bool(flag & int(FrameFlag.SHUTTER_CLOSED)) for flag in flags]
        changes = sum(before != after for before, after in pairwise([False, *closed]))
        assert sum(kind.startswith("shutter") for kind, _ in entries) == changes
