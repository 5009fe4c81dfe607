"""Emulated devices at the other end of the drivers' lines, and the bench that all of them share.

`World` is the bench. `camera` and `devices` answer as the devices do, byte for byte where the
protocol is public; `camera` gives frames, too. All say that they are emulated. They were built from
public descriptions; real devices may do more than these say.

The wheel's emulator turns `World.wheel_position`, and the view of the camera behind it changes; the
camera's emulator starts a flat-field correction, and its frames freeze; a program sets
`World.blackbody_temperature`, and thermocouples and frames follow. There is no physics here.
Temperatures are in kelvin, times in seconds since the world began, on its clock; the scene has a
time of its own, so that a recording can begin with it.
"""

import math
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from dbthermal.instruments.clock import Clock, EmulatedClock
from dbthermal.instruments.session import Session
from dbthermal.instruments.transport import Closing, TransportError

ROOM: Final = 296.15  # default temperature of the room [K]
FPA: Final = 308.15  # default temperature of a focal-plane array [K]
FFC_DURATION: Final = 0.5  # of a flat-field correction [s]; the real one is not documented publicly
PHASE: Final = 0.382  # by which each camera of a session is exposed after the one before [frame]
SERIAL_NUMBERS: Final = 93588  # number of the first emulated camera of a session; the next follow
TICK: Final = 0.01  # shortest wait until a device is asked again if it has something to say [s]


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


class World:
    """An emulated bench: wheel, blackbody, scene and cameras, on one `clock` [s], from an `epoch`.

    Its clock is an `EmulatedClock`, or `dbthermal.instruments.clock.SYSTEM` for real time.
    `filters` has the band in each slot of the wheel, 1 to 6, and `wheel_position` is the slot in
    the beam, None while the wheel turns or is between two slots. `scene` has temperatures [K] by
    name at a time of the scene [s]; if it `waits` it stands at its beginning until `begin`.
    `thermocouples` has the place of each channel, 1 to 8: a name in the scene, ``"blackbody"``,
    ``"room"`` or ``"open"``. Single attributes may be read and set from any thread; to change
    several together, hold `lock`.
    """

    def __init__(
        self,
        *,
        clock: Clock | None = None,
        filters: Mapping[int, str] | None = None,
        wheel_position: int = 1,
        blackbody_temperature: float = ROOM,
        scene: Callable[[float], Mapping[str, float]] | None = None,
        waits: bool = False,
    ) -> None:
        self.lock = threading.RLock()
        self.clock = clock or EmulatedClock()
        self.filters = dict(filters or {})
        self.thermocouples: dict[int, str] = {}
        self.cameras: dict[str, CameraState] = {}
        self.blackbody_temperature = blackbody_temperature
        self.epoch = self.clock()
        self.scene_began = math.inf if waits else self.epoch
        self._scene = scene
        self.wheel_position: int | None = wheel_position

    @property
    def time(self) -> float:
        """Time since the world began [s]."""
        return self.clock() - self.epoch

    def begin(self) -> None:
        """Let the scene begin now, or anew."""
        self.scene_began = self.clock()

    def scene_time(self, time: float | None = None) -> float:
        """Time since the scene began [s], 0 before; at a time since the world began, or now."""
        now = self.time if time is None else time
        return max(0.0, self.epoch + now - self.scene_began)

    @property
    def filter_name(self) -> str | None:
        """Band of the filter in the beam; None between two slots, or where the slot is empty."""
        return None if self.wheel_position is None else self.filters.get(self.wheel_position)

    def scene_temperatures(self) -> dict[str, float]:
        """Temperatures [K] in the scene by name, with ``"blackbody"`` and ``"room"``."""
        scene = {} if self._scene is None else self._scene(self.scene_time())
        return {"room": ROOM, **scene, "blackbody": self.blackbody_temperature}

    def thermocouple_temperature(self, channel: int) -> float:
        """Temperature of the tip of a thermocouple [K]; NaN if it is open or missing.

        KeyError if its place is not in the scene.
        """
        place = self.thermocouples.get(channel, "open")
        if place == "open":
            return math.nan
        temperatures = self.scene_temperatures()
        if place not in temperatures:
            rule = f"Must be one of {sorted(temperatures)}"
            raise KeyError(f"Unknown place '{place}' of thermocouple {channel}. {rule}.")
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
        if name not in self.cameras:
            raise KeyError(f"Unknown camera '{name}'. Must be one of {sorted(self.cameras)}.")
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
            state.ffc_until = self.time + duration
            state.last_ffc_frame = state.frame_count
            state.last_ffc_temperature = state.fpa_temperature

    def ffc_in_progress(self, name: str) -> bool:
        """True while a camera's shutter is closed for a correction."""
        return self.time < self.camera(name).ffc_until


def emulated_world(session: Session, **settings: Any) -> World:
    """Bench of an emulated session, at room temperature unless the settings say otherwise.

    The thermocouples are at the places that they are named after.
    """
    room = dict.fromkeys(session.thermocouples.values(), ROOM)
    world = World(filters=session.filters, **{"scene": lambda _: room, **settings})
    world.furnish(session)
    return world


class Line(Closing):
    """An emulated device at the end of a line: a `transport.Transport`, for any number of threads.

    A device takes bytes by `receive`, and `poll` gives its replies. Bytes that a driver does not
    read are kept. `TransportError` once the device is pulled out.
    """

    is_simulated = True

    def __init__(self, world: World) -> None:
        self.world, self.clock = world, world.clock
        self._replies, self._pieces = list[bytes](), list[bytes]()
        self._lock, self._closed = threading.Lock(), False

    def is_plugged(self) -> bool:
        """False once it was pulled out."""
        return True

    def receive(self, data: bytes) -> None:
        """Take in bytes from the driver."""
        raise NotImplementedError

    def poll(self) -> list[bytes]:
        """Give the replies that are due, each piece to be read by itself."""
        replies, self._replies = self._replies, []
        return replies

    def next_due(self) -> float:
        """Time until something may be due [s]; infinite if it waits for bytes."""
        return 0.0 if self._replies else math.inf

    def write(self, data: bytes) -> None:
        """Give bytes to the device; see `Transport.write`."""
        with self._lock:
            self._check()
            self.receive(data)

    def read(self, size: int, timeout: float) -> bytes:
        """Give one piece of the device's output; see `Transport.read`."""
        deadline = self.clock() + timeout
        while True:
            with self._lock:
                self._check()
                self._pieces += self.poll()
                if self._pieces:
                    piece = self._pieces.pop(0)
                    if piece[size:]:
                        self._pieces.insert(0, piece[size:])
                    return piece[:size]
                pause = max(self.next_due(), TICK)
            remaining = deadline - self.clock()
            if remaining <= 0:
                return b""
            self.clock.sleep(min(remaining, pause))

    def close(self) -> None:
        """End; a second call does nothing."""
        self._closed = True

    def _check(self) -> None:
        if self._closed or not self.is_plugged():
            raise TransportError("Lost the emulated device. It must stay connected and open.")
