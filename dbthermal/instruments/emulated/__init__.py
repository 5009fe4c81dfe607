"""Emulated devices at the other end of the drivers' lines, and the bench that all of them share.

`World` is the bench, `EmulatedCamera` gives frames, and `devices` answer as the devices do, byte
for byte where the protocol is public. All say that they are emulated. They were built from public
descriptions; real devices may do more than these say.

Wheel, shutter, blackbody and thermocouples act on what the cameras see through the `World`; there
is no physics here. The scene has a time of its own, so that a recording can begin with it. A
picture is a function of that time that gives the counts of a band, noise and response included. The
camera adds a frame rate, a clock, buffers that overflow if no program reads, a shutter that freezes
the image, and telemetry; as a real one, it never flags its shutter, see `camera.next_shutter`.
"""

import math
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import xarray as xr

from dbthermal import _text as texts
from dbthermal import response as responses
from dbthermal import simulation
from dbthermal.bands import FILTERS
from dbthermal.instruments import camera, telemetry
from dbthermal.instruments.camera import Counts, Frame
from dbthermal.instruments.session import Session
from dbthermal.instruments.transport import Clock, Closing, EmulatedClock
from dbthermal.response import Curve

Picture = Callable[[float], Counts]

ROOM: Final = 296.15  # default temperature of the room [K]
FPA: Final = 308.15  # default temperature of a focal-plane array [K]
FFC_DURATION: Final = 0.5  # of a flat-field correction [s]; the real one is not documented publicly
PHASE: Final = 0.382  # by which each camera of a session is exposed after the one before [frame]
SERIAL_NUMBERS: Final = 93588  # number of the first emulated camera of a session; the next follow
NETD: Final = 0.1  # noise of the emulated cameras near 25 degrees Celsius [K]
BUFFERS: Final = 32  # frames that are held while no program reads, as by the V4L2 driver
CLOSED: Final = 10_000  # of every pixel where no filter is in the beam [count]

MODELS: Final[Mapping[str, tuple[str, float]]] = MappingProxyType(
    {"boson": ("emulated Boson", math.inf), "y16": ("emulated Y16 camera", 120.0)}
)
"""Kind of camera to its model, and the time between the flat-field corrections that it starts by
itself [s]."""


@dataclass
class CameraState:
    """State of an emulated camera; plain attributes, read and set by emulators."""

    serial_number: int
    fpa_temperature: float = FPA  # of its focal-plane array [K]
    plugged: bool = True  # False once it was pulled out
    phase: float = 0.0  # of its frames against those of the first camera [frame]
    has_frames: bool = False  # True if an emulated frame source counts its frames
    frame_count: int = 0  # frames since its sensor started
    ffc_count: int = 0  # flat-field corrections started
    ffc_until: float = -math.inf  # end of the last correction [s]
    last_ffc_frame: int = 0  # frame_count at its start, 0 before the first
    last_ffc_temperature: float = FPA  # fpa_temperature at its start [K]


@dataclass(kw_only=True, eq=False)
class World:
    """An emulated bench: wheel, blackbody, scene and cameras, on one clock.

    Single attributes may be read and set from any thread; to change several together, hold `lock`.
    """

    clock: Clock = field(default_factory=EmulatedClock)  # or `SYSTEM`, for real time [s]
    filters: Mapping[int, str] = field(default_factory=dict)  # band in each slot, 1 to 6
    wheel_position: int | None = 1  # slot in the beam; None while it turns, or is between two slots
    blackbody_temperature: float = ROOM  # [K]
    # Temperatures [K] by name at a time of the scene [s]; if it waits, it stands until `begin`.
    scene: Callable[[float], Mapping[str, float]] = lambda _: {}
    waits: bool = False
    # Place of each channel, 1 to 8: a name in the scene, "blackbody", "room" or "open".
    thermocouples: dict[int, str] = field(default_factory=dict)
    cameras: dict[str, CameraState] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.lock, self.scene_began = threading.RLock(), math.inf if self.waits else self.clock()

    def begin(self) -> None:
        """Let the scene begin now, or anew."""
        self.scene_began = self.clock()

    def scene_time(self, time: float | None = None) -> float:
        """Time since the scene began [s], 0 before; at a time on the clock, or now."""
        return max(0.0, (self.clock() if time is None else time) - self.scene_began)

    @property
    def filter_name(self) -> str | None:
        """Band of the filter in the beam; None between two slots, or where the slot is empty."""
        return None if self.wheel_position is None else self.filters.get(self.wheel_position)

    def scene_temperatures(self) -> dict[str, float]:
        """Temperatures [K] in the scene by name, with ``"blackbody"`` and ``"room"``."""
        scene = self.scene(self.scene_time())
        return {"room": ROOM, **scene, "blackbody": self.blackbody_temperature}

    def thermocouple_temperature(self, channel: int) -> float:
        """Temperature of the tip of a thermocouple [K]; NaN if open, KeyError if in no scene."""
        place = self.thermocouples.get(channel, "open")
        temperatures = {**self.scene_temperatures(), "open": math.nan}
        label = f"Unknown place of thermocouple {channel}"
        texts.check_listed(label, place, sorted(temperatures), KeyError)
        return temperatures[place]

    def add_camera(self, name: str, serial_number: int) -> CameraState:
        """Put a camera on the bench; ValueError if one has this name."""
        with self.lock:
            if name in self.cameras:
                raise ValueError(f"Repeated camera '{name}'. Each must have a name of its own.")
            self.cameras[name] = CameraState(serial_number)
            return self.cameras[name]

    def camera(self, name: str) -> CameraState:
        """State of a camera, shared by all emulators; KeyError if none has this name."""
        texts.check_listed("Unknown camera", name, sorted(self.cameras), KeyError)
        return self.cameras[name]

    def furnish(self, session: Session) -> None:
        """Put the cameras, by band, and thermocouples of an emulated session on the bench."""
        self.thermocouples.update(session.thermocouples)
        for number, band in enumerate(session.bands):
            self.add_camera(band, SERIAL_NUMBERS + number).phase = PHASE * number % 1.0

    def start_ffc(self, name: str, duration: float = FFC_DURATION) -> None:
        """Start a correction, maybe anew: the shutter closes, the image freezes until its end."""
        with self.lock:
            state = self.camera(name)
            state.ffc_count += 1
            state.ffc_until = self.clock() + duration
            state.last_ffc_frame = state.frame_count
            state.last_ffc_temperature = state.fpa_temperature

    def ffc_in_progress(self, name: str) -> bool:
        """True while a camera's shutter is closed for a correction."""
        return self.clock() < self.camera(name).ffc_until


def emulated_world(session: Session, **settings: Any) -> World:
    """Bench of an emulated session, at room temperature unless the settings say otherwise."""
    # The thermocouples are at the places that they are named after.
    room = dict.fromkeys(session.thermocouples.values(), ROOM)
    world = World(filters=session.filters, **{"scene": lambda _: room, **settings})
    world.furnish(session)
    return world


@dataclass
class EmulatedCamera(Closing):
    """A `camera.FrameSource` without a camera; its frames begin with the first `read`."""

    world: World
    name: str
    pictures: Mapping[str, Picture]  # band to the counts that are seen in it
    band: str | None = None  # of its filter; None behind the wheel
    shape: tuple[int, int] = (512, 640)
    frame_rate: float = 60.0  # [Hz]
    telemetry_rows: int = 0
    kind: str = "boson"  # of `MODELS`

    is_simulated: bool = field(default=True, init=False)

    def __post_init__(self) -> None:
        texts.check_listed("Unknown emulated camera", self.kind, sorted(MODELS))
        self.clock, self._state = self.world.clock, self.world.camera(self.name)
        self._state.has_frames = True
        self.identity: Mapping[str, str] = {
            "device": f"sim://{self.kind}/{self.name}",
            "model": MODELS[self.kind][0],
            "serial_number": str(self._state.serial_number),
        }
        self._number, self._start, self._open = 0, math.nan, True
        self._corrected = self.clock()  # end of the last correction, or power-on
        self._last: Counts = np.full(self.shape, CLOSED, dtype=np.uint16)

    def close(self) -> None:
        """Give no more frames; a second call does nothing."""
        self._open = False

    def read(self, timeout: float = camera.FRAME_TIMEOUT) -> Frame:
        """Wait for the next frame; see `camera.FrameSource.read`."""
        if math.isnan(self._start):
            self._start = self.clock() + self._state.phase / self.frame_rate
        self._number = self.next_number(self._number, self.clock() - self._start)
        due = self._start + self._number / self.frame_rate
        wait, label = due - self.clock(), f"from emulated camera '{self.name}'"
        if wait > timeout:
            self.clock.sleep(timeout)
            raise camera.NoFrameError(f"No frame {label} in {timeout} s.")
        if wait > 0:
            self.clock.sleep(wait)
        if not (self._open and self._state.plugged):
            state = "it is unplugged" if self._open else "it is closed"
            raise camera.SourceLostError(f"No more frames {label}: {state}.")
        number, self._number = self._number, self._number + 1
        return self.frame(number, due)

    def next_number(self, number: int, elapsed: float) -> int:
        """Number of the next frame, some time [s] after the first; full buffers drop frames."""
        latest = math.floor(elapsed * self.frame_rate)
        return latest if latest - number >= BUFFERS else number

    def frame(self, number: int, due: float) -> Frame:
        """Frame of a number, exposed at a time [s]."""
        with self.world.lock:
            self._state.frame_count = number
            self._corrected = max(self._corrected, self._state.ffc_until)
            if due >= self._corrected + MODELS[self.kind][1]:
                self.world.start_ffc(self.name)
            frozen = self.world.ffc_in_progress(self.name)
        # The image, unless the shutter is closed.
        if not frozen:
            self._last = self.image(due)
        # The telemetry.
        rows = metadata = None
        if self.telemetry_rows:
            values = {
                "camera_serial": self._state.serial_number,
                "frame_rate": round(self.frame_rate),
                "frame_counter": self._state.frame_count,
                "last_ffc_frame": self._state.last_ffc_frame,
                "fpa_temperature": self._state.fpa_temperature,
                "last_ffc_temperature": self._state.last_ffc_temperature,
                "uptime": due,
            }
            rows = telemetry.encode(values, self.shape[1], self.telemetry_rows)
            metadata = telemetry.metadata(rows)
        return Frame(self._last.copy(), due, self.clock(), number, camera.GOOD, rows, metadata)

    def image(self, time: float) -> Counts:
        """Counts through the filter in the beam at a time [s]."""
        band = self.band or self.world.filter_name
        if band is None:
            return np.full(self.shape, CLOSED, dtype=np.uint16)
        texts.check_listed("Unknown band", band, sorted(self.pictures), KeyError)
        image = self.pictures[band](self.world.scene_time(time))
        if image.shape != self.shape or image.dtype != np.uint16:
            label = f"Invalid picture {image.shape} of {image.dtype} in band '{band}'"
            raise ValueError(f"{label}. Must be {self.shape} of uint16.")
        return image


def blackbody_pictures(session: Session, world: World) -> dict[str, Picture]:
    """Raw frames, by known band, of the world's blackbody as the cameras of a session see it."""
    names = dict.fromkeys((*session.bands, *session.filters.values()))
    bands = tuple(name for name in names if name in FILTERS)
    if not bands:
        return {}
    # The cameras, with noise and a fixed pattern.
    rig = simulation.Rig(bands=bands, noise=(NETD,) * len(bands))
    detector = simulation.pattern(rig, session.shape, np.random.default_rng(0))
    response, pictures = rig.response(), dict[str, Picture]()

    def picture(curve: Curve, draw: Callable[[], Any], pattern: xr.Dataset, _: float) -> Counts:
        """Picture of the blackbody in a band, at any time of the scene."""
        level = float(curve.counts(np.array(world.blackbody_temperature)))
        return simulation.digitise(level + draw(), pattern)

    for number, (band, noise) in enumerate(zip(bands, response["noise"].values, strict=True)):
        draw = partial(np.random.default_rng([0, number]).normal, 0.0, noise, session.shape)
        curve, pattern = responses.curve(response, band), detector.sel(band=band)
        pictures[band] = partial(picture, curve, draw, pattern)
    return pictures
