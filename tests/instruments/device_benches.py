"""Emulated devices with the faults that real ones have, and their drivers, on emulated time."""

import math
import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from enum import Enum, auto
from typing import Any

import numpy as np

from dbthermal.instruments import _apt as apt
from dbthermal.instruments import _fslp as fslp
from dbthermal.instruments._apt import Id, StatusBits
from dbthermal.instruments.boson import Boson
from dbthermal.instruments.emulated.apt import Drive, EmulatedApt
from dbthermal.instruments.emulated.boson import EmulatedBoson
from dbthermal.instruments.emulated.clock import EmulatedClock
from dbthermal.instruments.emulated.line import Line
from dbthermal.instruments.emulated.tc08 import EmulatedTC08, Numbers
from dbthermal.instruments.emulated.world import ROOM, World
from dbthermal.instruments.filterwheel import FilterWheel, Settings
from dbthermal.instruments.tc08 import TC08

_NONE = StatusBits(0)


@dataclass
class Faults:
    """
    Faults of the wheel and its line; may be changed at any time.

    Attributes
    ----------
    silent : bool
        It answers nothing.
    drop : int
        Next answers that never come.
    late : float
        Delay of every answer [s].
    single_bytes : bool
        Every byte comes in a piece of its own.
    hold : bool
        An answer comes only with the next one, until this is False again.
    noise : bytes
        Come before every answer.
    stray_completed : bool
        A report of the end of some move comes before every answer.
    unreported : bool
        The end of a move is not reported.
    long_reports : bool
        Reports of an end have the status behind, as 20 bytes.
    stuck : StatusBits
        State that it always reports.
    slow : float
        Factor by which moves take longer [1].
    stands_after : float
        Way after which the counter stands, though the controller tries on [deg].
    stops_short : float
        Way that remains when a move is said to be over [deg].
    slips : float
        Way that the wheel loses in every motion, unnoticed [deg].
    deaf_to : set of int
        Identifiers of messages that it ignores.
    weak : float
        Factor of the speeds that it takes [1].
    notice : str
        Error that it reports at the next message, once.
    """

    silent: bool = False
    drop: int = 0
    late: float = 0.0
    single_bytes: bool = False
    hold: bool = False
    noise: bytes = b""
    stray_completed: bool = False
    unreported: bool = False
    long_reports: bool = False
    stuck: StatusBits = _NONE
    slow: float = 1.0
    stands_after: float = math.inf
    stops_short: float = 0.0
    slips: float = 0.0
    deaf_to: set[int] = field(default_factory=set)
    weak: float = 1.0
    notice: str = ""


@dataclass(frozen=True)
class StandingDrive(Drive):
    """A motion that never ends."""

    way: float = 0.0

    @property
    def duration(self) -> float:
        """Infinite: the motion never ends."""
        return math.inf

    def place(self, time: float) -> float:
        """Position at rest: the wheel does not move."""
        way = min(self._rise(time - self.start), self.way)
        return self.origin + math.copysign(way, self.distance)


class FaultyApt(EmulatedApt):
    """
    The emulated controller with faults.

    Attributes
    ----------
    faults : Faults
        What goes wrong.
    received : list of Message
        What came to one of its addresses.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.faults = Faults()
        self.received: list[apt.Message] = []
        self._waiting: list[tuple[float, bytes]] = []

    def obey(self, message: apt.Message) -> None:
        """Carry out a message, or ignore it by a fault."""
        self.received.append(message)
        if self.faults.silent or message.id in self.faults.deaf_to:
            return
        if self.faults.notice:
            notice = struct.pack("<HH64s", message.id, 1, self.faults.notice.encode())
            self.faults.notice = ""
            self.reply(Id.HW_RICHRESPONSE, notice)
        if message.id == Id.MOT_SET_VELPARAMS and self.faults.weak != 1.0:
            speeds = apt.VelocityParameters.parse(message)
            weak = [round(self.faults.weak * v) for v in (speeds.acceleration, speeds.maximum)]
            data = replace(speeds, acceleration=weak[0], maximum=weak[1]).pack()
            message = replace(message, data=data)
        super().obey(message)

    def poll(self) -> list[bytes]:
        """Messages that are due, split, merged or delayed by a fault."""
        now = self.world.clock()
        self._waiting += [(now + self.faults.late, piece) for piece in super().poll()]
        due = [data for time, data in self._waiting if time <= now]
        if not due or (self.faults.hold and len(due) < 2):
            return []
        self._waiting = [item for item in self._waiting if item[0] > now]
        joined = b"".join(due)
        return [bytes([byte]) for byte in joined] if self.faults.single_bytes else [joined]

    def next_due(self) -> float:
        """Time until something may be due [s]."""
        times = [time - self.world.clock() for time, _ in self._waiting]
        return max(0.0, min([super().next_due(), *times]))

    def reply(self, identifier: Id, *arguments: Any, **options: Any) -> None:
        """Send an answer, or lose it or add to it by a fault."""
        if self.faults.drop > 0:
            self.faults.drop -= 1
            return
        if self.faults.noise:
            self._replies.append(self.faults.noise)
        if self.faults.stray_completed:
            super().reply(Id.MOT_MOVE_COMPLETED, param1=1)
        super().reply(identifier, *arguments, **options)

    def report(self, identifier: Id) -> None:
        """Report the end of a motion, in another form or not at all by a fault."""
        if self.faults.long_reports and identifier != Id.MOT_MOVE_HOMED:
            self.reply(identifier, self.status().pack())
        elif not self.faults.unreported:
            super().report(identifier)

    def plan(self, drive: Drive) -> Drive:
        """Motion that is slower, shorter or endless by a fault."""
        degree = self.model.turn / 360.0
        faults, way = self.faults, abs(drive.distance)
        short = 0.0 if drive.homing else min(faults.stops_short * degree, way)
        planned = replace(
            drive,
            distance=math.copysign(way - short, drive.distance),
            velocity=drive.velocity / faults.slow,
            acceleration=drive.acceleration / faults.slow**2,
        )
        if faults.stands_after * degree >= way:
            return planned
        given = {entry.name: getattr(planned, entry.name) for entry in fields(Drive)}
        return StandingDrive(**given, way=faults.stands_after * degree)

    def finish(self, drive: Drive) -> None:
        """Lose steps."""
        self.wheel -= math.copysign(self.faults.slips / 360.0 * self.model.turn, drive.distance)
        super().finish(drive)

    def status(self) -> apt.Status:
        """State with bits that stick."""
        status = super().status()
        return replace(status, bits=status.bits | self.faults.stuck)


DEBUG_CHANNEL = 0x99
"""Channel on which a camera sends text that nobody asked for."""

BUSY = 0x283


class Fault(Enum):
    """BosonFaults of one reply."""

    DROP = auto()  # it never comes
    LATE = auto()  # it comes after `BosonFaults.late`, and so do those behind it
    HOLD = auto()  # it comes together with the next one
    BAD_CHECKSUM = auto()
    ILLEGAL_ESCAPE = auto()
    CUT = auto()  # its second half is lost
    WRONG_COMMAND = auto()
    SHORT = auto()  # its last byte of data is missing, and the checksum is right
    BUSY = auto()  # it refuses
    DEBUG_TEXT = auto()  # text on another channel comes first


@dataclass
class BosonFaults:
    """
    BosonFaults of a camera's command port; may be changed at any time.

    Attributes
    ----------
    once : deque of Fault
        For the next requests, one each; None for none.
    late : float
        Delay of `Fault.LATE` [s].
    single_bytes : bool
        Replies come byte by byte.
    ffc_stalls : bool
        No reply while the shutter is closed.
    """

    once: deque[Fault | None] = field(default_factory=deque)
    late: float = 1.5
    single_bytes: bool = False
    ffc_stalls: bool = False


class FaultyBoson(EmulatedBoson):
    """The emulated camera with faults."""

    def __init__(self, world: World, name: str) -> None:
        super().__init__(world, name)
        self.faults = BosonFaults()
        self._inbox: deque[tuple[fslp.Frame, Fault | None, float]] = deque()
        self._held = b""

    def request(self, frame: fslp.Frame) -> None:
        """Take in one request with its fault, to be answered when it is due."""
        fault = self.faults.once.popleft() if self.faults.once else None
        delay = self.faults.late if fault is Fault.LATE else 0.0
        self._inbox.append((frame, fault, self._world.time + delay))

    def poll(self) -> list[bytes]:
        """Give the replies that are due, with their faults."""
        replies = []
        while self._inbox and self.next_due() <= 0:
            frame, fault, _ = self._inbox.popleft()
            replies.append(self._spoilt(frame, fault))
        if self.faults.single_bytes:
            return [bytes([byte]) for reply in replies for byte in reply]
        return [reply for reply in replies if reply]

    def next_due(self) -> float:
        """Time until a reply is due [s]; infinite without a request."""
        if not self._inbox:
            return math.inf
        due = self._inbox[0][2]
        if self.faults.ffc_stalls:
            due = max(due, self.camera.ffc_until)
        return due - self._world.time

    def _spoilt(self, frame: fslp.Frame, fault: Fault | None) -> bytes:
        """Bytes of the reply to a request, with its fault."""
        reply = _misshapen(self.reply(frame), fault)
        if fault in {Fault.BUSY, Fault.SHORT, Fault.WRONG_COMMAND}:
            status, data = (BUSY, b"") if fault is Fault.BUSY else self.answer(frame)
            command = frame.command + (fault is Fault.WRONG_COMMAND)
            data = data[:-1] if fault is Fault.SHORT else data
            reply = fslp.encode(frame.sequence, command, data, status)
        reply = self._held + reply
        self._held = reply if fault is Fault.HOLD else b""
        return b"" if fault in {Fault.HOLD, Fault.DROP} else reply


def _misshapen(reply: bytes, fault: Fault | None) -> bytes:
    """Damage the bytes of a reply."""
    match fault:
        case Fault.BAD_CHECKSUM:
            # The byte before the end, to a value that needs no escape.
            return reply[:-2] + bytes([0x00 if reply[-2] else 0x01]) + reply[-1:]
        case Fault.ILLEGAL_ESCAPE:
            return reply[:-1] + b"\x9e\x00" + reply[-1:]
        case Fault.CUT:
            return reply[: len(reply) // 2]
        case Fault.DEBUG_TEXT:
            return fslp.encode(0, 0, b"emulated debug text", 0, channel=DEBUG_CHANNEL) + reply
        case _:
            return reply


FULL_SCALE = 673.15
"""What the library makes of an overflow [K]; a choice, the header does not say."""


@dataclass
class LoggerFaults:
    """
    LoggerFaults of the unit and its library; may be changed at any time.

    Attributes
    ----------
    open : set of int
        Channels whose thermocouple is open, and then reads NaN.
    reads_ambient : bool
        An open thermocouple reads as the cold junction instead, as the vendor's forum reports.
    overflow : set of int
        Channels whose converter overflows.
    errors : dict
        Function to the error number with which its next call fails.
    firmware_delay : float
        How long opening takes [s].
    no_unit : bool
        Nothing is plugged in.
    unplugged : bool
        The unit was pulled out: every function fails with error 16.
    """

    open: set[int] = field(default_factory=set)
    reads_ambient: bool = False
    overflow: set[int] = field(default_factory=set)
    errors: dict[str, int] = field(default_factory=dict)
    firmware_delay: float = 0.0
    no_unit: bool = False
    unplugged: bool = False


class FaultyTC08(EmulatedTC08):
    """The emulated library with faults."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.faults = LoggerFaults()
        self._opening = 0.0

    def __getattribute__(self, name: str) -> Any:
        """Give a function of the library, or one that fails."""
        if name.startswith("usb_tc08_") and name != "usb_tc08_get_last_error":
            code = 16 if self.faults.unplugged else self.faults.errors.pop(name, 0)
            if code:
                self._error = code
                return lambda *_: -1 if name.endswith("progress") else 0
        return super().__getattribute__(name)

    def usb_tc08_open_unit_async(self) -> int:
        """Begin the firmware's download."""
        self._opening = self.clock()
        return super().usb_tc08_open_unit_async()

    def usb_tc08_open_unit_progress(self, handle: Numbers, percent: Numbers) -> int:
        """Wait for the firmware."""
        if self.clock() - self._opening < self.faults.firmware_delay:
            return 0
        self._is_open |= self.faults.no_unit
        return super().usb_tc08_open_unit_progress(handle, percent)

    def convert(self, channel: int) -> tuple[float, bool]:
        """Open thermocouples and overflows."""
        if channel in self.faults.overflow:
            return FULL_SCALE, True
        if channel in self.faults.open:
            return (ROOM if self.faults.reads_ambient else float("nan")), False
        return super().convert(channel)


FILTERS = {1: "open", 3: "9.5", 5: "LW"}
QUICK = Settings(velocity=50.0, home_velocity=20.0, acceleration=1e3)
"""A wheel that turns in no time."""


class Clock(EmulatedClock):
    """Emulated time from a start [s], with things to do at some times [s]."""

    def __init__(self, now: float = 100.0) -> None:
        super().__init__()
        super().sleep(now)
        self.events: list[tuple[float, Callable[[], None]]] = []

    @property
    def now(self) -> float:
        """The time [s]."""
        return self()

    def sleep(self, seconds: float) -> None:
        """Let time pass [s], and do what is due."""
        super().sleep(seconds)
        due = [event for event in self.events if event[0] <= self()]
        for event in due:
            self.events.remove(event)
            event[1]()


class BosonBench:
    """An emulated camera and its driver, on one clock."""

    def __init__(self, serial_number: int = 93588) -> None:
        self.clock = Clock()
        self.world = World(clock=self.clock)
        self.state = self.world.add_camera("boson", serial_number)
        self.device = FaultyBoson(self.world, "boson")
        self.loop = Line(self.device, self.clock)
        self.camera = Boson(self.loop, first_sequence=1)

    def spoil(self, *faults: Fault | None) -> None:
        """Set faults of the next requests."""
        self.device.faults.once = deque(faults)

    def exchange(self, request: bytes) -> list[fslp.Frame]:
        """Send bytes without the driver, and decode the answer."""
        self.loop.write(request)
        return fslp.Decoder().feed(self.loop.read(4096, 0.1))


class WheelBench:
    """An emulated wheel and its driver, on one simulated clock."""

    def __init__(self, model: str = "BSC201", slot_offset: float = 0.0, **options: object) -> None:
        self.clock = Clock(0.0)
        self.world = World(clock=self.clock, filters=FILTERS, wheel_position=4)
        self.device = FaultyApt(self.world, model=model, slot_offset=slot_offset)
        loop = Line(self.device, self.clock)
        chosen = Settings(**options)  # type: ignore[arg-type]
        self.wheel = FilterWheel(loop, FILTERS, chosen)

    def homed(self) -> FilterWheel:
        """Connect and home the wheel."""
        self.wheel.connect()
        self.wheel.home()
        return self.wheel

    def move(self, position: int) -> None:
        """Move the motor without the driver."""
        data = apt.Position(1, position).pack()
        self.device.receive(apt.command(apt.Id.MOT_MOVE_ABSOLUTE, data=data, destination=apt.BAY_1))

    def sent(self, identifier: apt.Id) -> list[apt.Message]:
        """Messages of one identifier that the driver has sent."""
        return [message for message in self.device.received if message.id == identifier]


class LoggerBench:
    """A driver on an emulated unit, a clock, and tips whose temperatures a test sets."""

    def __init__(self) -> None:
        self.clock = Clock(1000.0)
        self.tips = {1: 350.0, 2: 300.0}
        self.unit = FaultyTC08(lambda channel: self.tips.get(channel, np.nan), self.clock)
        self.driver = TC08(self.unit)

    def ready(self) -> TC08:
        """Open the unit with two thermocouples of type T."""
        self.driver.open().set_channels([1, 2])
        return self.driver
