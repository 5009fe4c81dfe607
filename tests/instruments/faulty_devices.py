"""Emulated wheel, camera and logger with faults, and their drivers on a simulated clock.

The tests speak to the emulated devices in bytes that `request` and `reply` make, and name the
messages and states of a wheel as its maker does, such as ``MOT_MOVE_HOME`` and ``OVERLOAD``.
"""

import math
import struct
from dataclasses import dataclass
from functools import partial
from typing import Any
from unittest.mock import Mock

from dbthermal.instruments import _apt as apt
from dbthermal.instruments import boson
from dbthermal.instruments._apt import Id
from dbthermal.instruments.boson import Boson
from dbthermal.instruments.emulated import World
from dbthermal.instruments.emulated.devices import EmulatedApt, EmulatedBoson, EmulatedTC08
from dbthermal.instruments.filterwheel import BSC10X, FilterWheel, Settings, StatusBits
from dbthermal.instruments.tc08 import TC08
from dbthermal.instruments.transport import EmulatedClock, Transport

_ENDS = {Id.MOT_MOVE_COMPLETED, Id.MOT_MOVE_STOPPED, Id.MOT_MOVE_HOMED}  # of a motion


@dataclass
class WheelFaults:
    """Faults of the wheel and its line; may be changed at any time."""

    drop: int = 0  # next answers that never come
    late: float = 0.0  # delay of every answer [s]
    single_bytes: bool = False  # every byte in a piece of its own
    hold: bool = False  # an answer comes only with the next one, until this is False again
    noise: bytes = b""  # before every answer
    stray_completed: bool = False  # a report of the end of some move before every answer
    unreported: bool = False  # the end of a move is not reported
    long_reports: bool = False  # reports of an end have the status behind, as 20 bytes
    stuck: str = ""  # states that it reports whatever it does, joined by |
    stuck_from: float = 0.0  # time from when it does [s]
    slow: float = 1.0  # factor by which moves are slower
    stands_at: float = math.inf  # angle beyond which the counter stands, as if moving on [deg]
    stops_short: float = 0.0  # way that remains when a move is said to be over [deg]
    deaf_to: str = ""  # name of the message that it ignores, or "all"
    weak: float = 1.0  # factor of the speed that it takes
    notice: str = ""  # error that it reports at the next message, once
    polls: float = math.inf  # after which it is pulled out


class FaultyApt(EmulatedApt):
    """The emulated controller with faults; `received` are the messages to its addresses."""

    def __init__(self, world: World, model: str = "BSC201", slot_offset: float = 0.0) -> None:
        if model.startswith(("BSC10", "KDC")):
            self.model, self.unit, self.address = BSC10X, apt.UNIT, apt.UNIT
        self.info = self.info._replace(model=model.encode())
        self.slot_offset = slot_offset
        super().__init__(world)
        self.faults = WheelFaults()
        self.received: list[apt.Message] = []
        self._waiting: list[tuple[float, bytes]] = []

    def sent(self, name: str) -> list[bytes]:
        """Data of the messages of a name that a driver has sent."""
        return [message.data for message in self.received if message.id == Id[name]]

    def turn_to(self, position: int) -> None:
        """Begin a move to a place [count] without the driver."""
        data = apt.pack(apt.Position(1, position))
        message = apt.Message(Id.MOT_MOVE_ABSOLUTE, destination=apt.BAY_1, data=data)
        self.receive(apt.encode(message))

    def obey(self, message: apt.Message) -> None:
        """Carry out a message, or ignore it by a fault."""
        self.received.append(message)
        faults = self.faults
        if faults.deaf_to in {"all", Id(message.id).name}:
            return
        if faults.notice:
            notice = struct.pack("<HH64s", message.id, 1, faults.notice.encode())
            faults.notice = ""
            self.reply(Id.HW_RICHRESPONSE, notice)
        if message.id == Id.MOT_SET_VELPARAMS:
            speeds = apt.parse(apt.Speeds, message)
            weak = speeds._replace(velocity=round(faults.weak * speeds.velocity))
            message = message._replace(data=apt.pack(weak))
        super().obey(message)

    def poll(self) -> list[bytes]:
        """Messages that are due, split, merged or delayed by a fault."""
        now, self.faults.polls = self.world.clock(), self.faults.polls - 1
        self.plugged &= self.faults.polls > 0
        self._waiting += [(now + self.faults.late, piece) for piece in super().poll()]
        due = [data for time, data in self._waiting if time <= now]
        if not due or (self.faults.hold and len(due) < 2):
            return []
        self._waiting = [item for item in self._waiting if item[0] > now]
        joined = b"".join(due)
        return [bytes([byte]) for byte in joined] if self.faults.single_bytes else [joined]

    def reply(self, identifier: Id, *arguments: Any, **options: Any) -> None:
        """Send an answer or a report, or lose it, change its form or add to it by a fault."""
        if identifier in _ENDS - {Id.MOT_MOVE_HOMED} and self.faults.long_reports:
            arguments = (apt.pack(self.status()),)
        elif identifier in _ENDS and self.faults.unreported:
            return
        if self.faults.drop > 0:
            self.faults.drop -= 1
            return
        if self.faults.noise:
            self._replies.append(self.faults.noise)
        if self.faults.stray_completed:
            super().reply(Id.MOT_MOVE_COMPLETED)
        super().reply(identifier, *arguments, **options)

    def start(self, distance: float, velocity: float, *, homing: bool = False) -> None:
        """Begin a motion that is slower or shorter by a fault."""
        short = 0.0 if homing else self.faults.stops_short * self.model.turn / 360.0
        way = math.copysign(max(0.0, abs(distance) - short), distance)
        super().start(way, velocity / self.faults.slow, homing=homing)

    def status(self) -> apt.Status:
        """State with bits that stick, and a counter that stands."""
        (channel, position, encoder, bits), faults = super().status(), self.faults
        if faults.stuck and self.clock() >= faults.stuck_from:
            bits |= sum(StatusBits[name] for name in faults.stuck.split("|"))
        if position >= faults.stands_at * self.model.turn / 360.0:
            position = round(faults.stands_at * self.model.turn / 360.0)
            bits |= StatusBits.MOVING_FORWARD
        return apt.Status(channel, position, encoder, bits)


def request(
    sequence: int, command: int, data: bytes = b"", status: int = boson.REQUEST, channel: int = 0
) -> bytes:
    """Bytes of a request to a Boson."""
    return boson.encode(boson.Packet(channel, sequence, command, status, data))


reply = partial(request, status=0)
"""Bytes of its reply."""


FILTERS = {1: "open", 3: "9.5", 5: "LW"}
QUICK = Settings(velocity=50.0, home_velocity=20.0, acceleration=1e3)
"""A wheel that turns in no time."""


def connected(line: Transport, settings: Settings | None = None) -> FilterWheel:
    """A wheel's driver that is connected."""
    (wheel := FilterWheel(line, FILTERS, settings)).connect()
    return wheel


def clock_at(time: float) -> EmulatedClock:
    """Emulated clock that is at a time [s]."""
    (clock := EmulatedClock()).sleep(time)
    return clock


class BosonBench:
    """An emulated camera and its driver, on one clock."""

    def __init__(self, serial_number: int = 93588) -> None:
        self.clock = clock_at(100.0)
        self.world = World(clock=self.clock)
        self.state = self.world.add_camera("boson", serial_number)
        self.device = EmulatedBoson(self.world, "boson")
        self.camera = Boson(self.device, first_sequence=1)

    def exchange(self, request: bytes) -> bytes:
        """Send bytes without the driver, and return the answer."""
        self.device.write(request)
        return self.device.read(4096, 0.1)


class WheelBench:
    """An emulated wheel and its driver, on one simulated clock."""

    def __init__(self, model: str = "BSC201", slot_offset: float = 0.0, **options: object) -> None:
        self.world = World(filters=FILTERS, wheel_position=4)
        self.clock = self.world.clock
        self.device = FaultyApt(self.world, model=model, slot_offset=slot_offset)
        chosen = Settings(**options)  # type: ignore[arg-type]
        self.wheel = FilterWheel(self.device, FILTERS, chosen)

    def homed(self) -> FilterWheel:
        """Connect and home the wheel."""
        self.wheel.connect()
        self.wheel.home()
        return self.wheel


class LoggerBench:
    """A driver on an emulated unit, a clock, and tips whose temperatures a test sets."""

    def __init__(self) -> None:
        self.tips, self.clock = {"plate": 350.0, "room": 300.0}, clock_at(1000.0)
        places = {1: "plate", 2: "room"}
        world = World(clock=self.clock, scene=lambda _: self.tips, thermocouples=places)
        self.unit = EmulatedTC08(world)
        self.driver = TC08(self.unit)

    def fail(self, code: int, *functions: str) -> None:
        """Let functions of the library fail with an error number from now on."""
        self.unit.error = code
        for name in functions:
            failing = Mock(return_value=-1 if name.endswith("progress") else 0)
            setattr(self.unit, f"usb_tc08_{name}", failing)

    def ready(self) -> TC08:
        """Open the unit with two thermocouples of type T."""
        self.driver.open().set_channels({1: "plate", 2: "room"})
        return self.driver
