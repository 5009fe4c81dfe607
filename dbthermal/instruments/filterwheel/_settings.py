"""Properties of one wheel and its controller: scales, filters, speeds, limits of time.

References
----------
pylablib 1.4.5, ``Thorlabs/kinesis.py`` (scales and units of speed); instrumentkit,
``thorlabsapt.py`` (25600 counts for an FW103); thorlabs_apt_device 0.3.8, ``bsc.py`` (the same
units, and addresses). Facts alone, no code.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import chain
from types import MappingProxyType
from typing import Final

from dbthermal import _text as texts
from dbthermal.instruments import apt

POSITIONS: Final = 6  # slots of the wheel, numbered from 1

# Speeds are whole numbers of 32 bits to the controllers, which is 97 turns/s in the finer units.
_LIMITS: Final = {
    **dict.fromkeys(("velocity", "home_velocity"), (1e-3, 90.0)),
    "acceleration": (1e-3, 1e5),
    "tolerance": (1e-3, 180.0 / POSITIONS - 1e-3),
    "home_offset": (-359.999, 359.999),
    **dict.fromkeys(("reply_timeout", "home_timeout", "move_timeout"), (1e-3, 3600.0)),
    **dict.fromkeys(("start_timeout", "stall_timeout", "poll_interval"), (1e-3, 3600.0)),
    "serial_number": (1, 2**32 - 1),
}
_HOME = {"home_direction": (1, 2), "home_limit_switch": (1, 4)}


@dataclass(frozen=True)
class Scale:
    """Units of a controller."""

    turn: int  # counts of one turn of the wheel
    velocity: float  # device units of one count/s
    acceleration: float  # device units of one count/s^2

    def target(self, position: int, offset: float = 0.0) -> int:
        """Absolute place [count] of a slot, 1 to 6; `offset` [deg] is that of slot 1 after homing.

        A sixth of a turn is not a whole number of counts. Each place is rounded by itself, so that
        errors never add up. ValueError if the slot is another.
        """
        if position not in range(1, POSITIONS + 1):
            raise ValueError(f"Invalid filter position {position}. Must lie in 1 to {POSITIONS}.")
        return round(((position - 1) / POSITIONS + offset / 360.0) * self.turn)

    def position(self, count: int, tolerance: float, offset: float = 0.0) -> int | None:
        """Slot within `tolerance` [deg] of a place [count] of any turn; None between two slots."""
        sixths = (count / self.turn - offset / 360.0) * POSITIONS
        nearest = round(sixths)
        near = abs(sixths - nearest) * 360.0 / POSITIONS <= tolerance
        return nearest % POSITIONS + 1 if near else None

    def degrees(self, counts: int) -> float:
        """Angle [deg] of a number of counts."""
        return counts / self.turn * 360.0

    def device_velocity(self, velocity: float) -> int:
        """Velocity in device units, of one in turns/s."""
        return round(velocity * self.turn * self.velocity)

    def device_acceleration(self, acceleration: float) -> int:
        """Acceleration in device units, of one in turns/s^2."""
        return round(acceleration * self.turn * self.acceleration)


BSC20X: Final = Scale(turn=409_600, velocity=53.68, acceleration=53.68 * 204.94e-6)
"""200 full steps of 2048 microsteps."""

BSC10X: Final = Scale(turn=25_600, velocity=1.0, acceleration=1.0)
"""200 full steps of 128 microsteps."""

MODELS: Final[Mapping[str, Scale]] = MappingProxyType(
    {"BSC20": BSC20X, "SCC20": BSC20X, "BSC10": BSC10X, "BSC00": BSC10X}
)
"""Beginnings of the model names that are accepted; some BSC201 call themselves SCC201."""

CHANNEL: Final = 1  # of the motor at its address
FAULTS: Final = apt.StatusBits.POSITION_ERROR | apt.StatusBits.OVERLOAD
"""State that is an error; it is uncertain if a wheel's controller sets these bits."""


@dataclass(frozen=True)
class Settings:
    """Properties of one wheel; ValueError if one is out of its range, or two filters share a name.

    Which direction and switch a wheel needs for homing is uncertain: None keeps what the controller
    has. A BSC20x is a rack and silently ignores messages to a unit, so that both are tried.
    """

    filters: Mapping[int, str] = field(default_factory=dict)  # band in each slot, 1 to 6
    serial_number: int | None = None  # of the controller; another one is then refused
    # Where the controller is looked for, in order: address of its identity, and of its motor.
    addresses: tuple[tuple[int, int], ...] = ((apt.UNIT, apt.UNIT), (apt.RACK, apt.BAY_1))
    home_offset: float = 0.0  # from the home position to slot 1 [deg]; differs by wheel: look
    home_direction: int | None = None  # 1 forward, 2 reverse
    home_limit_switch: int | None = None  # 1 the reverse switch, 4 the forward one
    velocity: float = 1.0  # [turn/s]
    home_velocity: float = 0.2  # [turn/s]
    acceleration: float = 1.0  # [turn/s^2]
    tolerance: float = 0.1  # largest distance from a slot [deg], below half the way to the next
    reply_timeout: float = 1.0  # [s]
    home_timeout: float = 60.0  # [s]
    move_timeout: float = 20.0  # [s]
    start_timeout: float = 1.0  # until a move is seen to start [s]
    stall_timeout: float = 2.0  # for which the position may not change in a move [s]
    poll_interval: float = 0.05  # between two status requests [s]

    def __post_init__(self) -> None:
        for position in self.filters:
            BSC20X.target(position)
        for name in texts.repeated(self.filters.values()):
            raise ValueError(f"Repeated filter '{name}'. Each must have a name of its own.")
        for name, (least, most) in _LIMITS.items():
            value = getattr(self, name)
            if value is not None and not least <= value <= most:
                raise ValueError(f"Invalid {name} {value}. Must lie in [{least}, {most}].")
        if not self.addresses or not {*chain(*self.addresses)} <= apt.CONTROLLERS:
            rule = f"Must be pairs of {sorted(apt.CONTROLLERS)}"
            raise ValueError(f"Invalid addresses {self.addresses}. {rule}.")
        for name, allowed in _HOME.items():
            value = getattr(self, name)
            if value is not None and value not in allowed:
                raise ValueError(f"Invalid {name} {value}. Must be one of {allowed}, or None.")

    def position(self, band: str) -> int:
        """Slot of a band's filter; ValueError if no filter has this name."""
        for position, name in self.filters.items():
            if name == band:
                return position
        bands = sorted(self.filters.values())
        raise ValueError(f"Invalid band '{band}' of the wheel. Must be one of {bands}.")
