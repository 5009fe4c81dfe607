"""A recording on two emulated cameras whose pictures tell the time, held against what came."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from faulty_camera import Faults, FaultyCamera

from dbthermal import store
from dbthermal.instruments.camera import (
    DAMAGED,
    UNTIMED,
    Counts,
    Frame,
    FrameFlag,
    FrameSource,
)
from dbthermal.instruments.emulated.world import World
from dbthermal.instruments.recording import Limits, Reading, notes, record
from dbthermal.instruments.session import Camera, Device, Session

BANDS, SHAPE, RATE, MILLI = ("8-14", "9.5"), (16, 24), 100.0, 1e-3
LIMITS = Limits(chunk=5, queue=10_000, reserve=0, reading_period=0.02)
PATTERN = np.random.default_rng(1).integers(5000, 6000, SHAPE).astype(np.uint16)
SOURCES_OWN = 0x07  # flags that are the source's to set

Read = Callable[[], float]


def picture(time: float) -> Counts:
    """Counts that tell the time [ms], pixel by pixel."""
    return (PATTERN + round(time / MILLI)).astype(np.uint16)


def session(duration: float = 1.0) -> Session:
    """Two emulated cameras with small frames."""
    camera = Camera(Device("sim://boson/any", "v4l2:///dev/video0"))
    return Session("faults", True, "scene", duration, dict.fromkeys(BANDS, camera), RATE, SHAPE)


class Witness(FaultyCamera):
    """An emulated camera that keeps what it gave."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.given: list[Frame] = []

    def read(self, timeout: float = 1.0) -> Frame:
        """Give a frame, and keep a copy."""
        frame = super().read(timeout)
        self.given.append(replace(frame, counts=frame.counts.copy()))
        return frame


@dataclass
class Take:
    """One recording on two emulated cameras, with their faults, and what came meanwhile."""

    path: Path
    faults: Mapping[str, Faults] = field(default_factory=dict)
    world: World = field(default_factory=World)

    def __post_init__(self) -> None:
        self.cameras: dict[str, Witness] = {}
        for number, band in enumerate(BANDS):
            self.world.add_camera(band, number)
            faults = self.faults.get(band, Faults())
            pictures = {band: picture}
            self.cameras[band] = Witness(
                self.world, band, pictures, band, SHAPE, RATE, faults=faults
            )

    def record(self, duration: float, readings: Mapping[str, Read] | None = None) -> "Take":
        """Record so long [s], and hold it against what came."""
        asked = {name: Reading(read) for name, read in (readings or {}).items()}
        sources: dict[str, FrameSource] = dict(self.cameras)
        self.summary = record(session(duration), sources, self.path, readings=asked, limits=LIMITS)
        self.log = [note[1:] for note in notes(self.path)]
        for band in BANDS:
            self.check(band)
        return self

    def stored(self, band: str) -> xr.Dataset:
        """The frames of a band, without copies of the last one at the end."""
        frames = slice(0, self.summary.totals[band]["frames"])
        return store.open_dataset(self.path).sel(band=band).isel(time=frames)

    def noted(self, source: str) -> list[tuple[str, float]]:
        """Notes of one source."""
        return [(kind, value) for kind, name, value in self.log if name == source]

    def kinds(self, source: str) -> list[str]:
        """Kinds of the notes of one source."""
        return [kind for kind, _ in self.noted(source)]

    def check(self, band: str) -> None:
        """Every frame that came is there as it came, has its own time, and losses are counted."""
        given, kept = self.cameras[band].given, self.stored(band)
        assert len(given) == kept.sizes["time"] > 0
        np.testing.assert_array_equal(kept["counts"], [frame.counts for frame in given])
        np.testing.assert_array_equal(kept["sequence"], [frame.sequence for frame in given])
        np.testing.assert_array_equal(kept["device_time"], [frame.device_time for frame in given])
        flags = kept["frame_flags"].values
        np.testing.assert_array_equal(flags & SOURCES_OWN, [int(frame.flags) for frame in given])
        same = [np.array_equal(a.counts, b.counts) for a, b in pairwise(given)]
        np.testing.assert_array_equal(flags[1:] & int(FrameFlag.IMAGE_REPEATED) > 0, same)
        self.check_times(kept, flags, self.cameras[band].faults)
        self.check_losses(band, given, flags)

    def check_times(self, kept: xr.Dataset, flags: Any, faults: Faults) -> None:
        """A frame has the time that its picture tells, or says that it has none, and why."""
        stamps = kept["exposure_time"].values
        timed = (flags & int(UNTIMED | FrameFlag.FOREIGN_CLOCK)) == 0
        np.testing.assert_array_equal(np.isfinite(stamps), timed)
        lies = np.isin(kept["sequence"].values, [*faults.repeated, *faults.unseen])
        still = FrameFlag.SHUTTER_CLOSED | FrameFlag.IMAGE_REPEATED
        seen = timed & ((flags & int(still)) == 0) & ~lies
        assert seen.any() or faults.clock_rate != 1
        told = MILLI * (kept["counts"].values[seen] - PATTERN.astype(float))
        since = stamps[seen] + kept.attrs["clock_origin"] - self.world.epoch
        expected = np.broadcast_to(since[:, None, None], told.shape)
        np.testing.assert_allclose(told, expected, rtol=0, atol=0.51 * MILLI)

    def check_losses(self, band: str, given: list[Frame], flags: Any) -> None:
        """Leaps of the numbers, damage and the shutter are in the log and the totals, no more."""
        leaps = np.diff([frame.sequence for frame in given]) - 1
        found, totals = self.noted(band), self.summary.totals[band]
        assert [value for kind, value in found if kind == "frames_lost"] == list(leaps[leaps > 0])
        assert (totals["lost"], totals["refused"]) == (leaps.sum(), 0)
        told = flags[1:] & int(FrameFlag.FRAMES_LOST_BEFORE) > 0
        np.testing.assert_array_equal(told, leaps > 0)
        damaged = sum(bool(frame.flags & DAMAGED) for frame in given)
        assert self.kinds(band).count("damaged") == totals["damaged"] == damaged
        closed = [bool(flag & int(FrameFlag.SHUTTER_CLOSED)) for flag in flags]
        changes = sum(before != after for before, after in pairwise([False, *closed]))
        assert sum(kind.startswith("shutter") for kind, _ in found) == changes
