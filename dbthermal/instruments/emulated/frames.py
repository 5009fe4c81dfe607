"""Emulated cameras: frames of a `World`, with the faults that real ones have.

How the scene looks is handed in: for each band a picture, a function of the scene's time that gives
counts, as of a movie that the simulation computed before (`Movie`). What the emulated camera adds
is what a camera does: a frame rate, a clock, buffers that overflow if nobody reads, a shutter that
freezes the image and leaves other offsets, telemetry, and the faults that it is told to have. It is
no model of a detector: noise and response are in the counts that are handed in.
"""

import math
import time as system_time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from dbthermal.instruments import telemetry
from dbthermal.instruments.camera import (
    DAMAGED,
    FRAME_TIMEOUT,
    GOOD,
    Counts,
    Frame,
    FrameFlag,
    NoFrameError,
    SourceLostError,
)
from dbthermal.instruments.closing import Closing
from dbthermal.instruments.emulated.world import World

Picture = Callable[[float], Counts]

BUFFERS: Final = 32
"""Frames that are held while nobody reads, as by the V4L2 driver; beyond, they are dropped."""

CLOSED: Final = 10_000
"""Counts of every pixel where no filter is in the beam: a closed aperture [count]."""

_LIMITS: Final = np.iinfo(np.uint16)


@dataclass(frozen=True)
class Movie:
    """
    A picture from frames that were computed before.

    Attributes
    ----------
    counts : ndarray of uint16, shape (time, y, x)
        Frames [count].
    rate : float
        Frames of the movie per second [Hz].
    endless : bool
        Whether it begins anew at its end.
    """

    counts: Counts
    rate: float
    endless: bool = False

    def __call__(self, time: float) -> Counts:
        """
        Return the frame that is shown at a time.

        Parameters
        ----------
        time : float
            Since the scene began, see `World.scene_time` [s].

        Returns
        -------
        ndarray of uint16, shape (y, x)
            The frame [count].

        Raises
        ------
        ValueError
            If the movie is over, or has not begun.
        """
        # A time on the edge of a frame is that frame's, whatever its last bit.
        number, frames = math.floor(time * self.rate + 1e-6), self.counts.shape[0]
        if self.endless:
            number %= frames
        if not 0 <= number < frames:
            raise ValueError(
                f"Invalid time {time} s of a movie. Must lie in [0, {frames / self.rate}) s."
            )
        frame: Counts = self.counts[number]
        return frame


@dataclass(frozen=True)
class Faults:
    """
    What goes wrong with an emulated camera; frames are counted from 0 at its opening.

    Attributes
    ----------
    dropped : frozenset of int
        Frames that never come; the sequence number leaps.
    corrupt : frozenset of int
        Frames whose lower half is not of this image; the driver says so.
    unseen : frozenset of int
        Corrupt frames of which the driver says nothing.
    short : frozenset of int
        Frames of which only the first half of the rows comes.
    repeated : frozenset of int
        Frames that show the image before once more, with a number and a time of their own.
    ffc : frozenset of int
        Frames at which the camera starts a flat-field correction of its own accord.
    offset_step : float
        RMS of the change of each pixel's offset by a flat-field correction [count].
    clock_rate : float
        Seconds of the camera's clock per second; other than 1 it is a clock of its own.
    unplugged : int or None
        Frame at which it is pulled out.
    seed : int
        Of what is random.
    """

    dropped: frozenset[int] = frozenset()
    corrupt: frozenset[int] = frozenset()
    unseen: frozenset[int] = frozenset()
    short: frozenset[int] = frozenset()
    repeated: frozenset[int] = frozenset()
    ffc: frozenset[int] = frozenset()
    offset_step: float = 0.0
    clock_rate: float = 1.0
    unplugged: int | None = None
    seed: int = 0


@dataclass
class EmulatedCamera(Closing):
    """
    A `FrameSource` without a camera; its frames begin with the first `read`.

    Attributes
    ----------
    world : World
        The bench it is on; it must have a camera of this name.
    name : str
        Of the camera in the world.
    pictures : mapping
        Band to what is seen in it.
    band : str or None
        Band of a camera without a wheel; None for the one behind the wheel.
    shape : tuple of int
        Rows and columns [pixel].
    frame_rate : float
        [Hz].
    telemetry_rows : int
        0, or `dbthermal.instruments.telemetry.ROWS`.
    faults : Faults
        What goes wrong.
    sleep : callable
        Waits so many seconds; injected by tests, together with the world's clock.
    """

    world: World
    name: str
    pictures: Mapping[str, Picture]
    band: str | None = None
    shape: tuple[int, int] = (512, 640)
    frame_rate: float = 60.0
    telemetry_rows: int = 0
    faults: Faults = field(default_factory=Faults)
    sleep: Callable[[float], None] = system_time.sleep

    is_simulated: Final = True

    def __post_init__(self) -> None:
        self._state = self.world.camera(self.name)
        self._number = 0
        self._start: float | None = None
        self._last: Counts = np.full(self.shape, CLOSED, dtype=np.uint16)
        self._offsets: tuple[int, npt.NDArray[np.int32]] = 0, np.zeros(self.shape, np.int32)
        self._open = True

    @property
    def identity(self) -> Mapping[str, str]:
        """Names that say that it is emulated."""
        return {
            "device": f"sim://camera/{self.name}",
            "model": "emulated Boson",
            "serial_number": str(self._state.serial_number),
        }

    def close(self) -> None:
        """Give no more frames; a second call does nothing."""
        self._open = False

    def read(self, timeout: float = FRAME_TIMEOUT) -> Frame:
        """
        Wait for the next frame; see `dbthermal.instruments.camera.FrameSource.read`.

        Parameters
        ----------
        timeout : float
            How long to wait [s].

        Returns
        -------
        Frame
            As the V4L2 driver would hand it on.

        Raises
        ------
        NoFrameError
            If none is due in time.
        SourceLostError
            If the camera is unplugged or closed.
        """
        if not self._state.streaming:
            self._start = None
            self.sleep(timeout)
            self._check_plugged()
            raise NoFrameError(f"No frame from emulated camera '{self.name}': it takes none now.")
        if self._start is None:
            self._start = self.world.time - self._number / self.frame_rate
        self._skip(self.world.time)
        due = self._start + self._number / self.frame_rate
        wait = due - self.world.time
        if wait > timeout:
            self.sleep(timeout)
            raise NoFrameError(f"No frame from emulated camera '{self.name}' in {timeout} s.")
        if wait > 0:
            self.sleep(wait)
        self._check_plugged()
        number, self._number = self._number, self._number + 1
        return self._frame(number, due)

    def _skip(self, now: float) -> None:
        """Pass over the frames that never come, and those that the buffers have no room for."""
        assert self._start is not None
        latest = math.floor((now - self._start) * self.frame_rate)
        if latest - self._number >= BUFFERS:
            self._number = latest
        while self._number in self.faults.dropped:
            self._number += 1

    def _check_plugged(self) -> None:
        if self.faults.unplugged is not None and self._number >= self.faults.unplugged:
            self._state.plugged = False
        if not (self._open and self._state.plugged):
            state = "it is unplugged" if self._open else "it is closed"
            raise SourceLostError(f"No more frames from emulated camera '{self.name}': {state}.")

    def _frame(self, number: int, due: float) -> Frame:
        with self.world.lock:
            self._state.frame_count = number
            if number in self.faults.ffc:
                self.world.start_ffc(self.name)
            frozen = self.world.ffc_in_progress(self.name)
        if not frozen and number not in self.faults.repeated:
            self._last = self._image(due)
        counts, flags = self._damaged(number)
        flags |= GOOD if self.faults.clock_rate == 1 else FrameFlag.FOREIGN_CLOCK
        # Both clocks have the host's origin, so that rates alone differ.
        device_time = self.faults.clock_rate * (self.world.epoch + due)
        rows = self._telemetry(due)
        metadata = None if rows is None or flags & DAMAGED else telemetry.metadata(rows)
        return Frame(counts, device_time, self.world.clock(), number, flags, rows, metadata)

    def _image(self, time: float) -> Counts:
        """Counts through the filter in the beam, with the offsets since the last correction."""
        band = self.band or self.world.filter_name
        if band is None:
            image = np.full(self.shape, CLOSED, dtype=np.uint16)
        elif band not in self.pictures:
            raise KeyError(f"Unknown band '{band}'. Must be one of {sorted(self.pictures)}.")
        else:
            image = self.pictures[band](self.world.scene_time(time))
        if image.shape != self.shape or image.dtype != np.uint16:
            raise ValueError(
                f"Invalid picture {image.shape} of {image.dtype} in band '{band}'. "
                f"Must be {self.shape} of uint16."
            )
        if self._state.ffc_count == 0 or self.faults.offset_step == 0:
            return image.copy()
        return _in_range(image + self._current_offsets())

    def _current_offsets(self) -> npt.NDArray[np.int32]:
        count = self._state.ffc_count
        if self._offsets[0] != count:
            rng = np.random.default_rng([self.faults.seed, self._state.serial_number, count])
            step = rng.normal(0.0, self.faults.offset_step, self.shape)
            self._offsets = count, np.rint(step).astype(np.int32)
        return self._offsets[1]

    def _damaged(self, number: int) -> tuple[Counts, FrameFlag]:
        faults, half = self.faults, self.shape[0] // 2
        counts = self._last.copy()
        if number in faults.corrupt | faults.unseen:
            rng = np.random.default_rng([faults.seed, number])
            counts[half:] = rng.integers(0, _LIMITS.max, counts[half:].shape, endpoint=True)
        if number in faults.short:
            counts[half:] = 0
            return counts, FrameFlag.WRONG_SIZE
        return counts, FrameFlag.DRIVER_ERROR if number in faults.corrupt else GOOD

    def _telemetry(self, time: float) -> Counts | None:
        if self.telemetry_rows == 0:
            return None
        state = self._state
        fields = telemetry.Telemetry(
            camera_serial=state.serial_number,
            part_number="emulated",
            frame_rate=round(self.frame_rate),
            frame_counter=state.frame_count,
            last_ffc_frame=state.last_ffc_frame,
            fpa_temperature=state.fpa_temperature,
            last_ffc_temperature=state.last_ffc_temperature,
            uptime=time,
        )
        return telemetry.encode(fields, self.shape[1], self.telemetry_rows)


def _in_range(counts: npt.NDArray[np.int32]) -> Counts:
    """Counts as the detector gives them: at its limits it saturates, as a real one does."""
    return np.clip(counts, _LIMITS.min, _LIMITS.max).astype(np.uint16)
