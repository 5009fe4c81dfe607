"""An emulated camera with faults."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from dbthermal.instruments.camera import GOOD, Counts, Frame, FrameFlag, FrameSource
from dbthermal.instruments.emulated import EmulatedCamera, Picture, World
from dbthermal.instruments.session import Camera, Session

LIMITS = np.iinfo(np.uint16)
BANDS = ("8-14", "9.5")


@dataclass(frozen=True)
class Faults:
    """Faults of an emulated camera; frames are counted from 0 at its opening."""

    dropped: frozenset[int] = frozenset()  # never come; the sequence number leaps
    corrupt: frozenset[int] = frozenset()  # lower half is not of this image; the driver says so
    short: frozenset[int] = frozenset()  # only the first half of the rows comes
    repeated: frozenset[int] = frozenset()  # show the image before once more
    ffc: frozenset[int] = frozenset()  # a flat-field correction starts of the camera's own accord
    offset_step: float = 0.0  # RMS change of a pixel's offset by a correction [count]
    clock_rate: float = 1.0  # camera's seconds per second; other than 1 it is a clock of its own
    unplugged: int | None = None  # frame at which it is pulled out


@dataclass
class FaultyCamera(EmulatedCamera):
    """An emulated camera with faults; see `Faults`."""

    faults: Faults = field(default_factory=Faults)
    _repeats: bool = field(default=False, init=False)

    def next_number(self, number: int, elapsed: float) -> int:
        """Skip the frames that are dropped, and unplug the camera when its fault says so."""
        number = super().next_number(number, elapsed)
        while number in self.faults.dropped:
            number += 1
        if self.faults.unplugged is not None and number >= self.faults.unplugged:
            self.world.camera(self.name).plugged = False
        return number

    def frame(self, number: int, due: float) -> Frame:
        """Damage a frame."""
        self._repeats = number in self.faults.repeated
        if number in self.faults.ffc:
            with self.world.lock:
                self.world.camera(self.name).frame_count = number
                self.world.start_ffc(self.name)
        frame, half, flags = super().frame(number, due), self.shape[0] // 2, GOOD
        if number in self.faults.corrupt:
            noise = np.random.default_rng(number).integers(0, LIMITS.max, self.shape, endpoint=True)
            frame.counts[half:], flags = noise[half:], FrameFlag.DRIVER_ERROR
        elif number in self.faults.short:
            frame.counts[half:], flags = 0, FrameFlag.WRONG_SIZE
        return replace(
            frame,
            # Both clocks have the host's origin, so that rates alone differ.
            device_time=self.faults.clock_rate * frame.device_time,
            flags=flags | (FrameFlag.FOREIGN_CLOCK if self.faults.clock_rate != 1 else GOOD),
            metadata=None if flags else frame.metadata,
        )

    def image(self, time: float) -> Counts:
        """Repeat an image, or add the offsets since the last correction."""
        if self._repeats:
            return self._last
        image, count = super().image(time), self.world.camera(self.name).ffc_count
        if count == 0 or self.faults.offset_step == 0:
            return image
        step = np.random.default_rng(count).normal(0.0, self.faults.offset_step, self.shape)
        counts: Counts = np.clip(image + np.rint(step), 0, LIMITS.max).astype(np.uint16)
        return counts


def frames(source: FrameSource, number: int) -> Iterator[Frame]:
    """Yield a number of frames."""
    for _ in range(number):
        yield source.read()


def two_cameras(
    picture: Picture,
    shape: tuple[int, int],
    rate: float,
    rows: int = 0,
    *,
    faults: Mapping[str, Faults] | None = None,
    world: World | None = None,
) -> dict[str, FaultyCamera]:
    """Two emulated cameras on one bench that see one picture, with the faults of each band."""
    world, sources = world or World(), {}
    for number, band in enumerate(BANDS):
        world.add_camera(band, 100 + number)
        form, fault = (band, {band: picture}, band, shape, rate, rows), (faults or {}).get(band)
        sources[band] = FaultyCamera(world, *form, faults=fault or Faults())
    return sources


def two_bands(duration: float, shape: tuple[int, int], rate: float, rows: int = 0) -> Session:
    """Session of two emulated cameras that records a scene for a duration [s]."""
    cameras = {band: Camera(f"v4l2:///dev/video{place}") for place, band in enumerate(BANDS)}
    telemetry_rows: Literal[0, 2] = 2 if rows else 0
    return Session("test", True, "scene", duration, cameras, rate, shape, telemetry_rows)
