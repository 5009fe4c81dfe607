"""An emulated filter wheel with faults, each set by an attribute of `faults`."""

import math
import struct
from dataclasses import dataclass, field, fields, replace
from typing import Any

from dbthermal.instruments import _apt as apt
from dbthermal.instruments._apt import Id, StatusBits
from dbthermal.instruments.emulated.apt import Drive, EmulatedApt

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
