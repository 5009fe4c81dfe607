"""Emulated devices at the end of a line: a Boson's command port, an APT controller, a TC-08.

The command port answers every command of `boson` after the public descriptions, refuses all others,
and runs the shutter on command only. The duration of a correction and the settings at
power-on, which the descriptions leave open, are choices made here.

The controller answers byte for byte, with the quirks that users report: speeds near 0 and a motor
without current after power-up, silence if it is addressed wrongly, and reports of moves at any
time. They are from issues 6, 14, 17, 74 and 83 of AlexShkarin/pyLabLib and the documentation of
thorlabs_apt_device; the rest as in `_apt`.

The TC-08 has the functions of the vendor's library, by its header ``usbtc08.h``, and none of its
code. The conversion time is from datalogd's documentation, and likely, not certain.
"""

import math
import struct
import threading
from collections.abc import MutableSequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Final

from scipy.constants import zero_Celsius

from dbthermal.instruments import _apt, boson
from dbthermal.instruments._apt import Id
from dbthermal.instruments.camera import FfcStatus
from dbthermal.instruments.emulated import ROOM, World
from dbthermal.instruments.filterwheel import BSC20X, StatusBits
from dbthermal.instruments.session import WHEEL
from dbthermal.instruments.tc08 import CHANNELS
from dbthermal.instruments.transport import Closing, TransportError

Numbers = MutableSequence[Any]  # a ctypes array of the caller, written in place

TICK: Final = 0.01  # wait until a device is asked again if it has something to say [s]
FRAME_RATE: Final = 60  # frames per second of a camera whose frames no source counts [Hz]
SERIAL_NUMBER: Final = 40_000_000
SLOWEST: Final = 1.0  # [count/s] velocity below which the motor does not move at all
CONVERSION: Final = 0.1  # conversion time of one channel of the TC-08 [s]
RANGE: Final = (3.15, 673.15)  # of its thermocouples of type T [K]
WINDOW: Final = 1.0  # [deg] largest distance of the wheel from a slot that is in the beam

_REFUSED: Final = 0x161  # of `boson.STATUSES`: of every request that the driver does not send


class Line(Closing):
    """An emulated device at the end of a line: a `transport.Transport`, for several threads."""

    is_simulated, plugged = True, True  # False once it was pulled out

    def __init__(self, world: World) -> None:
        self.world, self.clock = world, world.clock
        self._replies, self._pieces = list[bytes](), list[bytes]()
        self._lock, self._closed = threading.Lock(), False

    def receive(self, data: bytes) -> None:
        """Take in bytes from the driver."""
        raise NotImplementedError

    def poll(self) -> list[bytes]:
        """Give the replies that are due, each piece to be read by itself."""
        replies, self._replies = self._replies, []
        return replies

    def write(self, data: bytes) -> None:
        """Send all bytes; see `Transport.write`."""
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
            remaining = deadline - self.clock()
            if remaining <= 0:
                return b""
            self.clock.sleep(min(remaining, TICK))

    def close(self) -> None:
        """End; a second call does nothing."""
        self._closed = True

    def _check(self) -> None:
        if self._closed or not self.plugged:
            raise TransportError("Lost the emulated device. It must stay connected and open.")


class EmulatedBoson(Line):
    """The command port of a camera of a world; KeyError if there is no camera of this name."""

    def __init__(self, world: World, name: str) -> None:
        super().__init__(world)
        self.camera = world.camera(name)
        # At power-on, by the identifier that reads them; not those of a real camera.
        self.settings = {setting.command: 0 for setting in boson.SETTINGS}
        self.settings[boson.FFC_MODE.command] = int(boson.FfcMode.AUTO)
        self._name, self._decoder = name, boson.Decoder()

    @property
    def plugged(self) -> bool:  # type: ignore[override]
        """False once the camera was pulled out."""
        return self.camera.plugged

    def receive(self, data: bytes) -> None:
        """Take in bytes; frames of channels that have no commands are ignored."""
        for frame in self._decoder.feed(data):
            if frame.channel == boson.COMMAND_CHANNEL:
                self._replies.append(self.reply(frame))

    def reply(self, request: boson.Packet) -> bytes:
        """Bytes of the reply to a request, with status and data."""
        command, data, status, answer = request.command, request.data, 0, b""
        with self.world.lock:
            if not self.camera.has_frames:
                self.camera.frame_count = math.floor(self.clock() * FRAME_RATE)
            readings, is_setting = self._readings(), command + 1 in self.settings
            size = 4 if is_setting else 0 if command in {boson.RUN_FFC, *readings} else None
            if request.status != boson.REQUEST or len(data) != size:
                status = _REFUSED
            elif command == boson.RUN_FFC:
                self.world.start_ffc(self._name)
            elif is_setting:
                (self.settings[command + 1],) = struct.unpack(">i", data)
            else:
                answer = readings[command]
        return boson.encode(replace(request, status=status, data=answer))

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
        values |= {setting: (self.settings[setting.command],) for setting in boson.SETTINGS}
        return {key.command: struct.pack(key.layout, *value) for key, value in values.items()}


@dataclass(frozen=True)
class Drive:
    """One motion with a ramp at each end: start [s], origin and distance [count], speeds."""

    start: float
    origin: float
    distance: float
    velocity: float
    acceleration: float
    homing: bool

    @property
    def ramp(self) -> float:
        """Time of the first and of the last ramp [s], which meet in a short motion."""
        meeting = math.sqrt(abs(self.distance) / self.acceleration)
        return min(self.velocity / self.acceleration, meeting)

    @property
    def duration(self) -> float:
        """Time that it takes [s]."""
        way = abs(self.distance)
        return self.ramp + way / (self.acceleration * self.ramp) if way else 0.0

    def place(self, time: float) -> float:
        """Place at a time [count]."""
        passed = min(time - self.start, self.duration)
        first, last = min(passed, self.ramp), max(0.0, passed + self.ramp - self.duration)
        way = self.acceleration * (self.ramp * (passed - first) + (first**2 - last**2) / 2)
        return self.origin + math.copysign(way, self.distance)


class EmulatedApt(Line):
    """A controller that turns the world's wheel, whose slot 1 is `slot_offset` [deg] from home."""

    info = _apt.Info(SERIAL_NUMBER, b"BSC201", notes=b"emulated, not hardware")
    model, unit, address, slot_offset = BSC20X, _apt.RACK, _apt.BAY_1, 0.0

    def __init__(self, world: World) -> None:
        super().__init__(world)
        # The counter of commanded steps, and the place of the wheel from its home switch [count].
        self.position, self.enabled, self.homed = 0, False, False
        slot = 1 if world.wheel_position is None else world.wheel_position
        self.wheel = ((slot - 1) / 6 + self.slot_offset / 360.0) * self.model.turn
        self._drive: Drive | None = None
        self._kept: dict[int, Any] = {
            Id.MOT_SET_VELPARAMS: _apt.Speeds(1, 0, 0, 0),
            Id.MOT_SET_HOMEPARAMS: _apt.Home(1, 2, 1, 0, 0),
        }
        self._decoder = _apt.Decoder(_apt.CONTROLLERS, (_apt.HOST,))

    def receive(self, data: bytes) -> None:
        """Take in bytes from the driver."""
        for message in self._decoder.feed(data):
            self._advance()
            if message.destination in {self.unit, self.address}:
                self.obey(message)

    def poll(self) -> list[bytes]:
        """Messages that are due to be sent now."""
        self._advance()
        return super().poll()

    def obey(self, message: _apt.Message) -> None:
        """Carry out a message; an unknown one is ignored."""
        match message.id:
            case Id.HW_REQ_INFO:
                self.reply(Id.HW_GET_INFO, _apt.pack(self.info), source=message.destination)
            case Id.MOD_SET_CHANENABLESTATE:
                self.enabled = message.param2 == _apt.YES
            case Id.MOD_REQ_CHANENABLESTATE:
                self.reply(Id.MOD_GET_CHANENABLESTATE, value=_apt.YES if self.enabled else _apt.NO)
            case Id.MOT_SET_VELPARAMS | Id.MOT_SET_HOMEPARAMS:
                self._kept[message.id] = _apt.parse(type(self._kept[message.id]), message)
            case Id.MOT_REQ_VELPARAMS | Id.MOT_REQ_HOMEPARAMS:
                self.reply(Id(message.id + 1), _apt.pack(self._kept[message.id - 1]))
            case Id.MOT_REQ_STATUSUPDATE:
                self.reply(Id.MOT_GET_STATUSUPDATE, _apt.pack(self.status()))
            case Id.MOT_MOVE_HOME:
                # Back to the home switch, or on to it, and further by the controller's own offset.
                way, home = -(self.wheel % self.model.turn), self._kept[Id.MOT_SET_HOMEPARAMS]
                way += self.model.turn if home.direction == 1 and way else 0
                self.start(way + home.offset, home.velocity, homing=True)
            case Id.MOT_MOVE_ABSOLUTE if message.data:
                target = _apt.parse(_apt.Position, message).position
                self.start(target - self.position, self._kept[Id.MOT_SET_VELPARAMS].velocity)
            case Id.MOT_MOVE_STOP:  # at once, ramps are left out
                self._drive = None
                self.reply(Id.MOT_MOVE_STOPPED)

    def start(self, distance: float, velocity: float, *, homing: bool = False) -> None:
        """Begin a motion [count], unless the motor has no current or is too slow [device units]."""
        speed = velocity / self.model.velocity
        acceleration = self._kept[Id.MOT_SET_VELPARAMS].acceleration / self.model.acceleration
        if self.enabled and speed >= SLOWEST and acceleration > 0:
            now = self.world.clock()
            self._drive = Drive(now, self.position, distance, speed, acceleration, homing)
            self.homed &= not homing
            self._advance()

    def reply(self, identifier: Id, data: bytes = b"", value: int = 0, source: int = 0) -> None:
        """Send a message, of channel 1 without data; by default from the motor's address."""
        address, channel = source or self.address, 0 if data else 1
        message = _apt.Message(identifier, channel, value, _apt.HOST, address, data)
        self._replies.append(_apt.encode(message))

    def status(self) -> _apt.Status:
        """State of the motor, as the controller reports it."""
        bits, drive = StatusBits.CONNECTED, self._drive
        bits |= StatusBits.ENABLED if self.enabled else 0
        bits |= StatusBits.HOMED if self.homed else 0
        if drive is not None:
            bits |= StatusBits.MOVING_FORWARD if drive.distance > 0 else StatusBits.MOVING_REVERSE
            bits |= StatusBits.HOMING if drive.homing else 0
        return _apt.Status(1, self.position, 0, bits)

    def _advance(self) -> None:
        """Go on to now: move the motor, report the end of a motion, turn the world's wheel."""
        now, drive = self.world.clock(), self._drive
        if drive is not None:
            before, self.position = self.position, round(drive.place(now))
            self.wheel += self.position - before
            if now >= drive.start + drive.duration:
                self._drive = None
                if drive.homing:
                    self.position, self.homed = 0, True
                self.reply(Id.MOT_MOVE_HOMED if drive.homing else Id.MOT_MOVE_COMPLETED)
        # The slot that is in the beam of a wheel at rest.
        slot = self.model.position(self.wheel, self.slot_offset, WINDOW)
        self.world.wheel_position = slot if self._drive is None else None


class EmulatedTC08:
    """The library and one unit, with type-T thermocouples whatever letter they are set to."""

    is_simulated: Final = True

    def __init__(self, world: World) -> None:
        self._world, self.clock = world, world.clock
        self.is_open, self.error = False, 0
        self._kinds: dict[int, str] = {}

    def usb_tc08_open_unit_async(self) -> int:
        """Begin to open the unit."""
        return 1

    def usb_tc08_open_unit_progress(self, handle: Numbers, percent: Numbers) -> int:
        """Progress of opening: 0 pending, 1 complete (handle 0 if no unit is free), -1 failed."""
        handle[0], percent[0] = int(not self.is_open), 100
        self.is_open = True
        return 1

    def usb_tc08_close_unit(self, _: int) -> int:
        """Close the unit."""
        self.is_open, self._kinds = False, {}
        return 1

    def usb_tc08_get_last_error(self, _: int) -> int:
        """Error of the last function that failed."""
        return self.error

    def usb_tc08_get_unit_info(self, _: int, info: Numbers) -> int:
        """Write the identity, which says that it is emulated."""
        info[0].driver, info[0].serial = b"emulated", b"EMULATED"
        info[0].hardware, info[0].variant, info[0].calibration_date = 1, 8, b"01Jan00"
        return 1

    def usb_tc08_set_channel(self, _: int, channel: int, kind: int) -> int:
        """Set a channel to a letter; a space switches it off."""
        self._kinds.pop(channel, None)
        if chr(kind) != " ":
            self._kinds[channel] = chr(kind)
        return 1

    def usb_tc08_get_single(self, _: int, values: Numbers, overflow: Numbers, __: int) -> int:
        """Convert all channels once [K], NaN for those that are off."""
        self.clock.sleep(CONVERSION * len(self._kinds))
        readings = [self.convert(channel) for channel in range(CHANNELS)]
        values[:] = [value for value, _ in readings]
        overflow[0] = sum(beyond << channel for channel, (_, beyond) in enumerate(readings))
        return 1

    def convert(self, channel: int) -> tuple[float, bool]:
        """Temperature of a channel as the library reports it [K], and whether it overflowed."""
        if channel not in self._kinds:
            return math.nan, False
        if channel == 0:
            return ROOM, False
        tip = self._world.thermocouple_temperature(channel)
        return (tip if RANGE[0] <= tip <= RANGE[1] else math.nan), False


LINES: Final = MappingProxyType({WHEEL: EmulatedApt, "boson": EmulatedBoson})
"""Emulators at the end of a serial line: the wheel, and the command port of a kind of camera."""
