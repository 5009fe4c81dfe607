"""The emulated motor and wheel: steps that are counted, and where the wheel really is.

The two agree only as long as no step is lost, and only once the home switch was found: as in a
wheel without an encoder. Speeds are in counts, a move has a ramp at each end; what a real motor
does beyond that is not known here.
"""

import math
from dataclasses import dataclass
from typing import Final

from dbthermal.instruments.apt import StatusBits

SLOWEST: Final = 1.0
"""Velocity below which the motor does not move at all [count/s]."""

WINDOW: Final = 1.0
"""How far from a slot the wheel may be for its filter to be in the beam [deg]."""

_FORWARD, _REVERSE = StatusBits.MOVING_FORWARD, StatusBits.MOVING_REVERSE


@dataclass(frozen=True)
class Drive:
    """
    One motion, as it was planned.

    Attributes
    ----------
    start : float
        When it began [s].
    origin, distance : float
        From where, and how far [count]; the distance infinite if nothing ends it.
    velocity, acceleration : float
        [count/s], [count/s^2].
    homing : bool
        Whether it looks for the home switch.
    stands_after : float
        Way after which it stands, though it should go on [count]; infinite if it does not.
    """

    start: float
    origin: float
    distance: float
    velocity: float
    acceleration: float
    homing: bool = False
    stands_after: float = math.inf

    @property
    def duration(self) -> float:
        """Time that it takes [s]."""
        way, ramp = abs(self.distance), self.velocity**2 / self.acceleration
        if self.stands_after < way:
            return math.inf
        if way < ramp:
            return 2.0 * math.sqrt(way / self.acceleration)
        return way / self.velocity + self.velocity / self.acceleration

    @property
    def end(self) -> float:
        """When it is over [s]."""
        return self.start + self.duration

    def place(self, time: float) -> float:
        """Where it is at a time [count]."""
        if time >= self.end:
            return self.origin + self.distance
        passed = time - self.start
        if math.isinf(self.duration) or passed < self.duration / 2:
            way = self._rise(passed)
        else:
            way = abs(self.distance) - self._rise(self.duration - passed)
        return self.origin + math.copysign(min(way, self.stands_after), self.distance)

    def _rise(self, time: float) -> float:
        """Way from rest in a time, with one ramp [count]."""
        ramp = min(time, self.velocity / self.acceleration)
        return self.acceleration * ramp**2 / 2 + self.velocity * (time - ramp)


class Motor:
    """
    A stepper motor and the wheel on its axis.

    Parameters
    ----------
    turn : int
        Counts of one turn.
    wheel : float
        Where the wheel is when the motor gets power, from its home switch [count].

    Attributes
    ----------
    position : int
        Counter of commanded steps, 0 when the motor gets power [count].
    wheel : float
        Where the wheel is, from its home switch [count].
    enabled, homed : bool
        Whether it has current, and has found its switch.
    drive : Drive or None
        The motion that is in progress.
    """

    def __init__(self, turn: int, wheel: float) -> None:
        self.turn = turn
        self.position = 0
        self.wheel = wheel
        self.enabled = False
        self.homed = False
        self.drive: Drive | None = None

    @property
    def counter(self) -> int:
        """The position as a controller counts it, in 32 bits: a motor that runs on wraps round."""
        return (self.position + (1 << 31)) % (1 << 32) - (1 << 31)

    @property
    def bits(self) -> StatusBits:
        """State, as the controller reports it."""
        bits = StatusBits.CONNECTED
        if self.enabled:
            bits |= StatusBits.ENABLED
        if self.homed:
            bits |= StatusBits.HOMED
        if self.drive is not None:
            bits |= _FORWARD if self.drive.distance > 0 else _REVERSE
            if self.drive.homing:
                bits |= StatusBits.HOMING
        return bits

    def start(self, drive: Drive) -> None:
        """Begin a motion; does nothing if it is too slow to be one."""
        if drive.velocity >= SLOWEST and drive.acceleration > 0:
            self.drive = drive
            self.homed &= not drive.homing

    def advance(self, time: float, *, slip: float = 0.0) -> Drive | None:
        """
        Go on to a time.

        Parameters
        ----------
        time : float
            Now [s].
        slip : float
            Steps that the wheel loses in a motion without anybody's notice [count].

        Returns
        -------
        Drive or None
            The motion that is over now.
        """
        if self.drive is None:
            return None
        drive, before = self.drive, self.position
        self.position = round(drive.place(time))
        self.wheel += self.position - before
        if time < drive.end:
            return None
        self.drive = None
        self.wheel -= math.copysign(slip, drive.distance)
        if drive.homing:
            self.position, self.homed = 0, True
        return drive

    def slot(self, offset: float) -> int | None:
        """
        Slot in the beam.

        Parameters
        ----------
        offset : float
            From the home switch to slot 1 [deg].

        Returns
        -------
        int or None
            1 to 6; None between two slots, and while the wheel turns.
        """
        sixths = (self.wheel / self.turn - offset / 360.0) * 6
        nearest = round(sixths)
        resting = self.drive is None and abs(sixths - nearest) * 60.0 <= WINDOW
        return nearest % 6 + 1 if resting else None
