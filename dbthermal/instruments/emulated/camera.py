"""Emulated cameras: frames of a `World`, of pictures that are handed in, for each band one.

A picture is a function of the scene's time that gives counts, noise and response included. The
camera adds a frame rate, a clock, buffers that overflow if no program reads, a shutter that freezes
the image, and telemetry. It never flags its shutter: as with a real camera, that follows from
telemetry, serial line and frozen image, see `camera.next_shutter`.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Final

import numpy as np

from dbthermal import response as responses
from dbthermal import simulation
from dbthermal.bands import FILTERS
from dbthermal.instruments import telemetry
from dbthermal.instruments.camera import (
    FRAME_TIMEOUT,
    GOOD,
    Counts,
    Frame,
    NoFrameError,
    SourceLostError,
)
from dbthermal.instruments.emulated.world import World
from dbthermal.instruments.session import Session
from dbthermal.instruments.transport import Closing

Picture = Callable[[float], Counts]
NETD: Final = 0.1  # noise of the emulated cameras near 25 degrees Celsius [K]
BUFFERS: Final = 32  # frames that are held while no program reads, as by the V4L2 driver
CLOSED: Final = 10_000  # of every pixel where no filter is in the beam [count]

MODELS: Final[Mapping[str, tuple[str, float]]] = MappingProxyType(
    {"boson": ("emulated Boson", math.inf), "y16": ("emulated Y16 camera", 120.0)}
)
"""Kind of camera, as in ``sim://boson/wide``, to its model, and the time between the flat-field
corrections that it starts by itself [s]."""


@dataclass
class EmulatedCamera(Closing):
    """A `camera.FrameSource` without a camera; its frames begin with the first `read`.

    Through a filter of its own, or, where `band` is None, the one in the beam of the wheel.
    """

    world: World
    name: str
    pictures: Mapping[str, Picture]  # band to the counts that are seen in it
    band: str | None = None
    shape: tuple[int, int] = (512, 640)
    frame_rate: float = 60.0  # [Hz]
    telemetry_rows: int = 0
    kind: str = "boson"  # of `MODELS`

    is_simulated: bool = field(default=True, init=False)

    def __post_init__(self) -> None:
        if self.kind not in MODELS:
            rule = f"Must be one of {sorted(MODELS)}"
            raise ValueError(f"Unknown emulated camera '{self.kind}'. {rule}.")
        self.clock, self._state = self.world.clock, self.world.camera(self.name)
        self._state.has_frames = True
        self.identity: Mapping[str, str] = {
            "device": f"sim://{self.kind}/{self.name}",
            "model": MODELS[self.kind][0],
            "serial_number": str(self._state.serial_number),
        }
        self._number = 0
        self._start: float | None = None
        self._last: Counts = np.full(self.shape, CLOSED, dtype=np.uint16)
        self._open = True

    def close(self) -> None:
        """Give no more frames; a second call does nothing."""
        self._open = False

    def read(self, timeout: float = FRAME_TIMEOUT) -> Frame:
        """Wait for the next frame; see `camera.FrameSource.read`."""
        if self._start is None:
            self._start = self.world.time + self._state.phase / self.frame_rate
        self._number = self.next_number(self._number, self.world.time - self._start)
        due = self._start + self._number / self.frame_rate
        wait = due - self.world.time
        if wait > timeout:
            self.clock.sleep(timeout)
            raise NoFrameError(f"No frame from emulated camera '{self.name}' in {timeout} s.")
        if wait > 0:
            self.clock.sleep(wait)
        if not (self._open and self._state.plugged):
            state = "it is unplugged" if self._open else "it is closed"
            raise SourceLostError(f"No more frames from emulated camera '{self.name}': {state}.")
        number, self._number = self._number, self._number + 1
        return self.frame(number, due)

    def next_number(self, number: int, elapsed: float) -> int:
        """Number of the next frame, some time [s] after the first; full buffers drop frames."""
        latest = math.floor(elapsed * self.frame_rate)
        return latest if latest - number >= BUFFERS else number

    def frame(self, number: int, due: float) -> Frame:
        """Frame of a number, exposed at a time since the world began [s]."""
        with self.world.lock:
            self._state.frame_count = number
            if due >= max(self._state.ffc_until, 0.0) + MODELS[self.kind][1]:
                self.world.start_ffc(self.name)
            frozen = self.world.ffc_in_progress(self.name)
        if not frozen:
            self._last = self.image(due)
        rows = self._telemetry(due) if self.telemetry_rows else None
        metadata = None if rows is None else telemetry.metadata(rows)
        stamp, now = self.world.epoch + due, self.world.clock()
        return Frame(self._last.copy(), stamp, now, number, GOOD, rows, metadata)

    def image(self, time: float) -> Counts:
        """Counts through the filter in the beam at a time since the world began [s]."""
        band = self.band or self.world.filter_name
        if band is None:
            return np.full(self.shape, CLOSED, dtype=np.uint16)
        if band not in self.pictures:
            raise KeyError(f"Unknown band '{band}'. Must be one of {sorted(self.pictures)}.")
        image = self.pictures[band](self.world.scene_time(time))
        if image.shape != self.shape or image.dtype != np.uint16:
            raise ValueError(
                f"Invalid picture {image.shape} of {image.dtype} in band '{band}'. "
                f"Must be {self.shape} of uint16."
            )
        return image

    def _telemetry(self, time: float) -> Counts:
        state = self._state
        values = {
            "camera_serial": state.serial_number,
            "frame_rate": round(self.frame_rate),
            "frame_counter": state.frame_count,
            "last_ffc_frame": state.last_ffc_frame,
            "fpa_temperature": state.fpa_temperature,
            "last_ffc_temperature": state.last_ffc_temperature,
            "uptime": time,
        }
        return telemetry.encode(values, self.shape[1], self.telemetry_rows)


def blackbody_pictures(session: Session, world: World) -> dict[str, Picture]:
    """Raw frames, by band, of the world's blackbody as the cameras of a session see it.

    Counts follow Planck's law in the band at `World.blackbody_temperature`, with noise of `NETD`,
    a fixed pattern (see `dbthermal.simulation.pattern`) and 16 bits. Bands that are not in
    `dbthermal.bands.FILTERS` get no picture.
    """
    names = dict.fromkeys((*session.bands, *session.filters.values()))
    bands = tuple(name for name in names if name in FILTERS)
    if not bands:
        return {}
    rig = simulation.Rig(bands=bands, noise=(NETD,) * len(bands))
    detector = simulation.pattern(rig, session.shape, np.random.default_rng(0))
    response = rig.response()

    def of_band(number: int, band: str) -> Picture:
        curve, pattern = responses.curve(response, band), detector.sel(band=band)
        noise = float(response["noise"].sel(band=band))
        rng = np.random.default_rng([0, number])

        def picture(_: float) -> Counts:
            level = float(curve.counts(np.array(world.blackbody_temperature)))
            return simulation.digitise(level + rng.normal(0.0, noise, session.shape), pattern)

        return picture

    return {band: of_band(number, band) for number, band in enumerate(bands)}
