"""Emulated cameras of a `World`: their frames, and the command port of a Boson.

A picture is a function of the scene's time that gives the counts of a band, noise and response
included. The camera adds a frame rate, a clock, buffers that overflow if no program reads, a
shutter that freezes the image, and telemetry. It never flags its shutter: as with a real camera,
that follows from telemetry, serial line and frozen image, see `camera.next_shutter`.

The command port answers every command of `boson` after the public descriptions, refuses all others,
and runs the shutter on command only. The duration of a correction and the settings at
power-on, which the descriptions leave open, are choices made here.
"""

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from scipy.constants import zero_Celsius

from dbthermal import response as responses
from dbthermal import simulation
from dbthermal.bands import FILTERS
from dbthermal.instruments import _fslp as fslp
from dbthermal.instruments import boson, telemetry
from dbthermal.instruments import camera as interface
from dbthermal.instruments.camera import Counts, FfcMode, FfcStatus, Frame
from dbthermal.instruments.emulated import Line, World
from dbthermal.instruments.session import Session
from dbthermal.instruments.transport import Closing

Picture = Callable[[float], Counts]
NETD: Final = 0.1  # noise of the emulated cameras near 25 degrees Celsius [K]
BUFFERS: Final = 32  # frames that are held while no program reads, as by the V4L2 driver
CLOSED: Final = 10_000  # of every pixel where no filter is in the beam [count]
FRAME_RATE: Final = 60  # frames per second of a camera whose frames no source counts [Hz]

MODELS: Final[Mapping[str, tuple[str, float]]] = MappingProxyType(
    {"boson": ("emulated Boson", math.inf), "y16": ("emulated Y16 camera", 120.0)}
)
"""Kind of camera to its model, and the time between the flat-field corrections that it starts by
itself [s]."""

_REFUSED: Final = 0x161  # of `boson.STATUSES`: of every request that the driver does not send


@dataclass
class EmulatedCamera(Closing):
    """A `camera.FrameSource` without a camera; its frames begin with the first `read`.

    It looks through the filter of its `band`, or, where that is None, through the wheel's.
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

    def read(self, timeout: float = interface.FRAME_TIMEOUT) -> Frame:
        """Wait for the next frame; see `camera.FrameSource.read`."""
        if self._start is None:
            self._start = self.world.time + self._state.phase / self.frame_rate
        self._number = self.next_number(self._number, self.world.time - self._start)
        due = self._start + self._number / self.frame_rate
        wait = due - self.world.time
        if wait > timeout:
            self.clock.sleep(timeout)
            raise interface.NoFrameError(
                f"No frame from emulated camera '{self.name}' in {timeout} s."
            )
        if wait > 0:
            self.clock.sleep(wait)
        if not (self._open and self._state.plugged):
            state = "it is unplugged" if self._open else "it is closed"
            raise interface.SourceLostError(
                f"No more frames from emulated camera '{self.name}': {state}."
            )
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
        stamp, now = self.world.epoch + due, self.world.clock()
        return Frame(self._last.copy(), stamp, now, number, interface.GOOD, rows, metadata)

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
    # The cameras, with noise and a fixed pattern.
    rig = simulation.Rig(bands=bands, noise=(NETD,) * len(bands))
    detector = simulation.pattern(rig, session.shape, np.random.default_rng(0))
    response = rig.response()

    curves = {band: responses.curve(response, band) for band in bands}
    generators = {band: np.random.default_rng([0, number]) for number, band in enumerate(bands)}
    patterns = {band: detector.sel(band=band) for band in bands}
    deviations = {band: float(response["noise"].sel(band=band)) for band in bands}

    def picture(band: str, _: float) -> Counts:
        """Picture of the blackbody in a band, at any time of the scene."""
        level = float(curves[band].counts(np.array(world.blackbody_temperature)))
        noise = generators[band].normal(0.0, deviations[band], session.shape)
        return simulation.digitise(level + noise, patterns[band])

    return {band: partial(picture, band) for band in bands}


class EmulatedBoson(Line):
    """The command port of a camera of a world; KeyError if there is no camera of this name."""

    def __init__(self, world: World, name: str) -> None:
        super().__init__(world)
        self.camera = world.camera(name)
        # At power-on, by the identifier that sets them; not those of a real camera.
        self.settings = {setting.set_command: 0 for setting in boson.SETTINGS}
        self.settings[boson.FFC_MODE.set_command] = int(FfcMode.AUTO)
        self._name, self._decoder = name, fslp.Decoder()

    def is_plugged(self) -> bool:
        """False once the camera was pulled out."""
        return self.camera.plugged

    def receive(self, data: bytes) -> None:
        """Take in bytes; frames of channels that have no commands are ignored."""
        for frame in self._decoder.feed(data):
            if frame.channel == fslp.COMMAND_CHANNEL:
                self.request(frame)

    def request(self, frame: fslp.Frame) -> None:
        """Take in one request, and answer at once."""
        self._replies.append(self.reply(frame))

    def reply(self, request: fslp.Frame) -> bytes:
        """Bytes of the reply to a request."""
        with self.world.lock:
            if not self.camera.has_frames:
                self.camera.frame_count = math.floor(self.world.time * FRAME_RATE)
            status, data = self.answer(request)
        return fslp.encode(request.sequence, request.command, data, status)

    def answer(self, request: fslp.Frame) -> tuple[int, bytes]:
        """Status and data of the reply to a request."""
        command, data, readings = request.command, request.data, self._readings()
        size = {boson.RUN_FFC: 0, **dict.fromkeys(self.settings, 4), **dict.fromkeys(readings, 0)}
        if request.status != fslp.REQUEST or len(data) != size.get(command):
            return _REFUSED, b""
        if command == boson.RUN_FFC:
            self.world.start_ffc(self._name)
        elif command in self.settings:
            (self.settings[command],) = struct.unpack(">i", data)
        return 0, readings.get(command, b"")

    def _readings(self) -> dict[int, bytes]:
        """Data of every reading and setting, by the identifier that reads it."""
        camera = self.camera
        status = FfcStatus.COMPLETE if camera.ffc_count else FfcStatus.NONE_PERFORMED
        if self.world.ffc_in_progress(self._name):
            status = FfcStatus.IN_PROGRESS
        values: dict[boson.Reading[Any], tuple[int | bytes, ...]] = {
            boson.SERIAL_NUMBER: (camera.serial_number,),
            boson.PART_NUMBER: (b"EMULATED-BOSON-640",),
            boson.SENSOR_SERIAL_NUMBER: (camera.serial_number,),
            boson.SOFTWARE_REVISION: (0, 0, 0),
            boson.FPA_TEMPERATURE: (round(10 * (camera.fpa_temperature - zero_Celsius)),),
            boson.FFC_IN_PROGRESS: (status == FfcStatus.IN_PROGRESS,),
            boson.FFC_STATUS: (status,),
            boson.LAST_FFC_FRAME: (camera.last_ffc_frame,),
        }
        values |= {key.reading: (self.settings[key.set_command],) for key in boson.SETTINGS}
        return {key.command: struct.pack(key.layout, *value) for key, value in values.items()}
