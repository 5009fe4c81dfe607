"""An emulated FLIR Boson: answers on the command port as the public descriptions say one does.

It knows every command of `dbthermal.instruments.boson.commands`, refuses what a camera would, runs
a shutter on the clock of its world, and has the faults that are reported of real ones, to order. It
is no camera: what the public descriptions leave open (how long the shutter is closed, what is lost
at power-off, whether a reboot is acknowledged first) is a choice made here.
"""

import math
import struct
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from scipy.constants import zero_Celsius

from dbthermal.instruments import fslp
from dbthermal.instruments.boson import commands
from dbthermal.instruments.boson.commands import Setting, SyncMode
from dbthermal.instruments.camera import FfcMode, FfcStatus
from dbthermal.instruments.emulated.boson_faults import Fault, Faults, misshapen
from dbthermal.instruments.emulated.options import number, require_known
from dbthermal.instruments.emulated.port import EmulatedPort
from dbthermal.instruments.emulated.world import FFC_DURATION, FPA, CameraState, World

SERIAL_NUMBER: Final = 93588
"""Of an emulated camera that nobody numbered: that of the public example."""

FRAME_RATE: Final = 60
"""Frames that the sensor takes [Hz]."""

BOOT_DURATION: Final = 3.0
"""How long it is mute after a reboot [s]."""

IMMINENT: Final = 0.5
"""How long before a flat-field correction of its own it says so [s]."""

DEFAULTS: Final = MappingProxyType(
    {
        **{setting.command: 0 for setting in commands.SETTINGS},
        commands.FFC_MODE.command: FfcMode.AUTO,
        commands.APPLY_FFC.command: 1,
        commands.FFC_FRAMES.command: 8,
        commands.FFC_TEMPERATURE_STEP.command: 20,
        commands.FFC_FRAME_STEP.command: 18000,
    }
)
"""Settings at first power-on, by the identifier that reads them; not those of a real camera."""

_SERIAL_NUMBERS = (0, (1 << 32) - 1)
_FPA_TEMPERATURES = (0.0, 655.0)  # [K] what its counts, 100 /K in 16 bits, hold
_STATUS, _RANGE, _FEW, _MANY, _UNKNOWN = 0x162, 0x203, 0x17D, 0x17E, 0x161
_BUSY = 0x283


class _RefusedError(Exception):
    """The status of a refusal."""

    def __init__(self, status: int) -> None:
        super().__init__(status)
        self.status = status


@dataclass(frozen=True)
class _Request:
    frame: fslp.Frame
    fault: Fault | None
    not_before: float


class EmulatedBoson:
    """
    One emulated camera of a world, as an `emulated.port.Device`.

    Parameters
    ----------
    world : World
        What it is part of; its clock is the camera's.
    name : str
        Of the camera in the world.
    free_running : bool
        Whether this counts the frames of the world's camera, at `FRAME_RATE`; False where an
        emulated frame source does.

    Attributes
    ----------
    faults : Faults
        Knobs.
    flash_writes : int
        How often settings were saved.
    is_simulated : bool
        True.

    Raises
    ------
    KeyError
        If the world has no such camera.
    """

    is_simulated: Final = True

    def __init__(self, world: World, name: str, *, free_running: bool = True) -> None:
        self.faults = Faults()
        self.flash_writes = 0
        self._world = world
        self._name = name
        self._camera = world.camera(name)
        self._free_running = free_running
        self._saved = dict(DEFAULTS)
        self._settings = dict(DEFAULTS)
        self._inbox: deque[_Request] = deque()
        self._held = b""
        self._decoder = fslp.Decoder()
        self._started = self._counted = world.time
        self._mute_until = -math.inf
        self._imminent_until = math.inf
        self._handlers = self._all_handlers()

    @property
    def camera(self) -> CameraState:
        """State of the camera in its world."""
        return self._camera

    @property
    def plugged(self) -> bool:
        """False once it was pulled out."""
        return self._camera.plugged

    @property
    def streaming(self) -> bool:
        """Whether the sensor takes frames: not without the pulses that it waits for."""
        slave = self._settings[commands.SYNC_MODE.command] == SyncMode.SLAVE
        return (self.faults.pulses or not slave) and self._world.time >= self._mute_until

    def receive(self, data: bytes) -> None:
        """Take in bytes; while it boots they are lost."""
        now = self._world.time
        if now < self._mute_until:
            return
        for frame in self._decoder.feed(data):
            if frame.channel != fslp.COMMAND_CHANNEL:
                continue
            fault = self.faults.once.popleft() if self.faults.once else None
            delay = self.faults.late if fault is Fault.LATE else 0.0
            self._inbox.append(_Request(frame, fault, now + delay))

    def poll(self) -> list[bytes]:
        """Give the replies that are due, each piece for a write of its own."""
        with self._world.lock:
            self._advance()
            replies = []
            while self._inbox and self.next_due() <= 0:
                replies.append(self._spoilt(self._inbox.popleft()))
        if self.faults.single_bytes:
            return [bytes([byte]) for reply in replies for byte in reply]
        return [reply for reply in replies if reply]

    def next_due(self) -> float:
        """Time until a reply is due [s]; infinite without a request."""
        if not self._inbox:
            return math.inf
        due = self._inbox[0].not_before
        if self.faults.ffc_stalls:
            due = max(due, self._camera.ffc_until)
        return due - self._world.time

    def _advance(self) -> None:
        """Let the time that went by since the last call have its effects."""
        now = self._world.time
        self._camera.streaming = self.streaming  # an emulated frame source looks at it
        if self._free_running:
            frames = math.floor((now - self._counted) * FRAME_RATE + 1e-6)
            self._camera.frame_count += frames if self.streaming else 0
            self._counted += frames / FRAME_RATE
        if self._settings[commands.FFC_MODE.command] != FfcMode.AUTO or not self._ffc_is_due():
            self._imminent_until = math.inf
        elif self._imminent_until == math.inf:
            self._imminent_until = now + IMMINENT
        elif now >= self._imminent_until:
            self._run_ffc()

    def _ffc_is_due(self) -> bool:
        """Whether temperature or frame count went far enough from the last correction."""
        camera = self._camera
        if self._world.ffc_in_progress(self._name):
            return False
        step = 0.1 * self._settings[commands.FFC_TEMPERATURE_STEP.command]
        frames = self._settings[commands.FFC_FRAME_STEP.command]
        drifted = 0 < step <= abs(camera.fpa_temperature - camera.last_ffc_temperature)
        return drifted or 0 < frames <= camera.frame_count - camera.last_ffc_frame

    def _ffc_status(self) -> FfcStatus:
        if self._world.ffc_in_progress(self._name):
            return FfcStatus.IN_PROGRESS
        if self._imminent_until < math.inf:
            return FfcStatus.IMMINENT
        return FfcStatus.COMPLETE if self._camera.ffc_count else FfcStatus.NONE_PERFORMED

    def _run_ffc(self) -> None:
        self._imminent_until = math.inf
        self._world.start_ffc(self._name, FFC_DURATION)

    def _reboot(self) -> None:
        self._settings = dict(self._saved)
        self._started = self._counted = self._world.time
        self._mute_until = self._started + BOOT_DURATION
        self._camera.frame_count = self._camera.last_ffc_frame = 0
        self._inbox.clear()
        self._decoder = fslp.Decoder()

    def _save(self) -> None:
        self._saved = dict(self._settings)
        self.flash_writes += 1

    def _answer(self, request: fslp.Frame) -> tuple[int, bytes]:
        """Status and data of the reply to a request."""
        if request.status != fslp.REQUEST:
            return _STATUS, b""
        if request.command not in self._handlers:
            return _UNKNOWN, b""
        size, handle = self._handlers[request.command]
        if len(request.data) != size:
            return (_FEW if len(request.data) < size else _MANY), b""
        try:
            return 0, handle(request.data)
        except _RefusedError as refusal:
            return refusal.status, b""

    def _spoilt(self, request: _Request) -> bytes:
        """Bytes of the reply to a request, with its fault."""
        frame, fault = request.frame, request.fault
        status, data = (_BUSY, b"") if fault is Fault.BUSY else self._answer(frame)
        command = frame.command + (fault is Fault.WRONG_COMMAND)
        data = data[:-1] if fault is Fault.SHORT else data
        reply = self._held + misshapen(fslp.encode(frame.sequence, command, data, status), fault)
        self._held = reply if fault is Fault.HOLD else b""
        return b"" if fault in {Fault.HOLD, Fault.DROP} else reply

    def _all_handlers(self) -> dict[int, tuple[int, Callable[[bytes], bytes]]]:
        """Size of the data and function of each command."""
        handlers: dict[int, tuple[int, Callable[[bytes], bytes]]] = {}
        values = self._values()
        for reading in commands.READINGS:
            handlers[reading.command] = 0, _packed(reading.layout, values[reading.command])
        for setting in commands.SETTINGS:
            handlers[setting.command] = 0, self._getter(setting)
            handlers[setting.set_command] = struct.calcsize(setting.layout), self._setter(setting)
        for action, run in (
            (commands.RUN_FFC, self._run_ffc),
            (commands.REBOOT, self._reboot),
            (commands.SAVE_DEFAULTS, self._save),
        ):
            handlers[action.command] = 0, _done(run)
        return handlers

    def _values(self) -> dict[int, Callable[[], tuple[int | bytes, ...]]]:
        """What each reading gives."""
        camera, world = self._camera, self._world
        fpa: Callable[[], float] = lambda: camera.fpa_temperature  # noqa: E731 - one of a table
        return {
            commands.SERIAL_NUMBER.command: lambda: (camera.serial_number,),
            commands.PART_NUMBER.command: lambda: (b"EMULATED-BOSON-640",),
            commands.SENSOR_SERIAL_NUMBER.command: lambda: (camera.serial_number,),
            commands.SENSOR_PART_NUMBER.command: lambda: (b"EMULATED-SENSOR",),
            commands.SOFTWARE_REVISION.command: lambda: (0, 0, 0),
            commands.FPA_TEMPERATURE.command: lambda: (round(10 * (fpa() - zero_Celsius)),),
            commands.FPA_TEMPERATURE_KELVIN.command: lambda: (round(10 * fpa()),),
            commands.FPA_COUNTS.command: lambda: (round(100 * fpa()),),
            commands.FFC_IN_PROGRESS.command: lambda: (world.ffc_in_progress(self._name),),
            commands.FFC_STATUS.command: lambda: (self._ffc_status(),),
            commands.FFC_DESIRED.command: lambda: (self._ffc_is_due(),),
            commands.LAST_FFC_FRAME.command: lambda: (camera.last_ffc_frame,),
            commands.LAST_FFC_TEMPERATURE.command: lambda: (
                round(10 * camera.last_ffc_temperature),
            ),
            commands.TABLE_SWITCH_DESIRED.command: lambda: (0,),
            commands.RADIOMETRY_CAPABLE.command: lambda: (0,),
            commands.FRAME_COUNT.command: lambda: (camera.frame_count,),
            commands.ISP_FRAME_COUNT.command: lambda: (camera.frame_count,),
            commands.FRAME_RATE.command: lambda: (FRAME_RATE,),
            commands.UPTIME.command: lambda: (int(world.time - self._started),),
        }

    def _getter(self, setting: Setting[int]) -> Callable[[bytes], bytes]:
        return lambda _: struct.pack(setting.layout, self._settings[setting.command])

    def _setter(self, setting: Setting[int]) -> Callable[[bytes], bytes]:
        def handle(data: bytes) -> bytes:
            (value,) = struct.unpack(setting.layout, data)
            if value not in setting.allowed:
                raise _RefusedError(_RANGE)
            self._settings[setting.command] = value
            return b""

        return handle


def _packed(layout: str, values: Callable[[], tuple[int | bytes, ...]]) -> Callable[[bytes], bytes]:
    return lambda _: struct.pack(layout, *values())


def _done(run: Callable[[], None]) -> Callable[[bytes], bytes]:
    def handle(_: bytes) -> bytes:
        run()
        return b""

    return handle


def start(options: Mapping[str, str], world: World | None) -> EmulatedPort:
    """
    Start an emulated camera for ``sim://boson``, on a pseudo-terminal of its own.

    Parameters
    ----------
    options : mapping
        ``name``, its name in the world (``"boson"`` unless given); ``sn``, its serial number, and
        ``fpa``, the temperature of its focal-plane array [K], if the world has no such camera;
        ``frames``, ``"source"`` where an emulated frame source counts the frames.
    world : World or None
        What it is part of, or None for one of its own.

    Returns
    -------
    EmulatedPort
        Close it to end the camera.

    Raises
    ------
    ValueError
        If an option is not known, is no number, or disagrees with the world.
    """
    require_known(options, ("name", "sn", "fpa", "frames"))
    world = World() if world is None else world
    name = options.get("name", "boson")
    serial_number = number(options, "sn", SERIAL_NUMBER, _SERIAL_NUMBERS)
    fpa_temperature = number(options, "fpa", FPA, _FPA_TEMPERATURES)
    if name not in world.cameras:
        camera = world.add_camera(name, serial_number)
        camera.fpa_temperature = camera.last_ffc_temperature = fpa_temperature
    elif {"sn", "fpa"} & options.keys():
        raise ValueError(f"Invalid options sn, fpa of camera '{name}'. Must be set in its world.")
    if options.get("frames", "source") != "source":
        raise ValueError(f"Invalid option frames '{options['frames']}'. Must be 'source'.")
    return EmulatedPort(EmulatedBoson(world, name, free_running="frames" not in options))
