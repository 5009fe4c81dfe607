"""An emulated FLIR Boson: the command port, after the public descriptions.

It knows every command of `boson.commands`, refuses as a camera would, and runs a shutter on the
clock of its world, on command only. The duration of a correction and the settings at power-on,
which the public descriptions leave open, are choices made here.
"""

import math
import struct
from typing import Any, Final

from scipy.constants import zero_Celsius

from dbthermal.instruments import _fslp as fslp
from dbthermal.instruments.boson import commands
from dbthermal.instruments.camera import FfcMode, FfcStatus
from dbthermal.instruments.emulated.line import Line
from dbthermal.instruments.emulated.world import SERIAL_NUMBERS, World

FRAME_RATE: Final = 60  # frames per second of a camera whose frames no source counts [Hz]

_STATUS, _RANGE, _FEW, _MANY, _UNKNOWN = 0x162, 0x203, 0x17D, 0x17E, 0x161

# Number of the states of each setting, which are numbered from 0.
_CHOICES = {setting.set_command: len(setting.kind.__members__) for setting in commands.SETTINGS}


class EmulatedBoson:
    """One emulated camera of a world, as an `emulated.line.Device`.

    Its clock is the world's; KeyError if the world has no camera of this name.
    """

    def __init__(self, world: World, name: str) -> None:
        self.camera = world.camera(name)
        # By the identifier that sets them, at power-on; not those of a real camera.
        self.settings = {setting.set_command: 0 for setting in commands.SETTINGS}
        self.settings[commands.FFC_MODE.set_command] = int(FfcMode.AUTO)
        self._world = world
        self._name = name
        self._decoder = fslp.Decoder()
        self._replies: list[bytes] = []

    @property
    def plugged(self) -> bool:
        """False once it was pulled out."""
        return self.camera.plugged

    def receive(self, data: bytes) -> None:
        """Take in bytes; frames of other channels than that of commands are ignored."""
        for frame in self._decoder.feed(data):
            if frame.channel == fslp.COMMAND_CHANNEL:
                self.request(frame)

    def request(self, frame: fslp.Frame) -> None:
        """Take in one request, and answer at once."""
        self._replies.append(self.reply(frame))

    def poll(self) -> list[bytes]:
        """Give the replies that are due, each piece for a write of its own."""
        replies, self._replies = self._replies, []
        return replies

    def next_due(self) -> float:
        """Time until a reply is due [s]; infinite without a request."""
        return 0.0 if self._replies else math.inf

    def reply(self, request: fslp.Frame) -> bytes:
        """Bytes of the reply to a request."""
        with self._world.lock:
            if not self.camera.has_frames:
                self.camera.frame_count = math.floor(self._world.time * FRAME_RATE)
            status, data = self.answer(request)
        return fslp.encode(request.sequence, request.command, data, status)

    def answer(self, request: fslp.Frame) -> tuple[int, bytes]:
        """Status and data of the reply to a request."""
        command, data, readings = request.command, request.data, self._readings()
        if request.status != fslp.REQUEST:
            return _STATUS, b""
        if command not in {commands.RUN_FFC, *self.settings, *readings}:
            return _UNKNOWN, b""
        size = 4 if command in self.settings else 0
        if len(data) != size:
            return (_FEW if len(data) < size else _MANY), b""
        if command == commands.RUN_FFC:
            self._world.start_ffc(self._name)
        elif command in self.settings:
            (value,) = struct.unpack(">i", data)
            if value not in range(_CHOICES[command]):
                return _RANGE, b""
            self.settings[command] = value
        return 0, readings.get(command, b"")

    def _readings(self) -> dict[int, bytes]:
        """Data of every reading and setting, by the identifier that reads it."""
        camera, status = self.camera, FfcStatus.NONE_PERFORMED
        if self._world.ffc_in_progress(self._name):
            status = FfcStatus.IN_PROGRESS
        elif camera.ffc_count:
            status = FfcStatus.COMPLETE
        values: dict[commands.Reading[Any], tuple[int | bytes, ...]] = {
            commands.SERIAL_NUMBER: (camera.serial_number,),
            commands.PART_NUMBER: (b"EMULATED-BOSON-640",),
            commands.SENSOR_SERIAL_NUMBER: (camera.serial_number,),
            commands.SOFTWARE_REVISION: (0, 0, 0),
            commands.FPA_TEMPERATURE: (round(10 * (camera.fpa_temperature - zero_Celsius)),),
            commands.FFC_IN_PROGRESS: (status == FfcStatus.IN_PROGRESS,),
            commands.FFC_STATUS: (status,),
            commands.LAST_FFC_FRAME: (camera.last_ffc_frame,),
        }
        for setting in commands.SETTINGS:
            values[setting.reading] = (self.settings[setting.set_command],)
        return {one.command: struct.pack(one.layout, *value) for one, value in values.items()}


def start(name: str, world: World | None) -> Line:
    """Line to an emulated camera of a world; without one, to the only camera of a new one.

    KeyError if the world has no camera of this name.
    """
    if world is None:
        world = World()
        world.add_camera(name, SERIAL_NUMBERS)
    return Line(EmulatedBoson(world, name), world.clock)
