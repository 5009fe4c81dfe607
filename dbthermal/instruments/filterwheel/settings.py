"""What depends on one wheel and its controller: scales, filters, speeds, limits of time.

What the public descriptions leave uncertain is a setting here, and says so.

References
----------
pylablib 1.4.5, ``Thorlabs/kinesis.py`` (scales and units of speed); instrumentkit,
``thorlabsapt.py`` (25600 counts for an FW103); thorlabs_apt_device 0.3.8, ``bsc.py`` (the same
units, and addresses). Facts alone, no code.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Final

from dbthermal.instruments import apt

POSITIONS: Final = 6
"""Slots of the wheel, numbered from 1."""

_DEGREES = 360.0
_POSITIVE = (
    *("velocity", "home_velocity", "acceleration", "tolerance", "reply_timeout", "home_timeout"),
    *("move_timeout", "start_timeout", "stall_timeout", "poll_interval"),
)
_HOME = {"home_direction": (1, 2), "home_limit_switch": (1, 4)}


@dataclass(frozen=True)
class Scale:
    """
    Units of a controller.

    Attributes
    ----------
    turn : int
        Counts of one turn of the wheel.
    velocity : float
        Device units of a velocity of one count/s.
    acceleration : float
        Device units of an acceleration of one count/s^2.
    """

    turn: int
    velocity: float
    acceleration: float

    def target(self, position: int, offset: float = 0.0) -> int:
        """
        Absolute place of a slot.

        A sixth of a turn is no whole number of counts. Each place is rounded by itself, so that
        errors of up to half a count never add up.

        Parameters
        ----------
        position : int
            Slot, 1 to 6.
        offset : float
            From where the wheel is after homing to slot 1 [deg].

        Returns
        -------
        int
            [count].

        Raises
        ------
        ValueError
            If there is no such slot.
        """
        if position not in range(1, POSITIONS + 1):
            raise ValueError(f"Invalid filter position {position}. Must lie in 1 to {POSITIONS}.")
        return round(((position - 1) / POSITIONS + offset / _DEGREES) * self.turn)

    def position(self, count: int, tolerance: float, offset: float = 0.0) -> int | None:
        """
        Slot at a place of the wheel.

        Parameters
        ----------
        count : int
            Place, of any turn [count].
        tolerance : float
            Largest distance from the slot [deg].
        offset : float
            As in `target` [deg].

        Returns
        -------
        int or None
            1 to 6, or None between two slots.
        """
        sixths = (count / self.turn - offset / _DEGREES) * POSITIONS
        nearest = round(sixths)
        near = abs(sixths - nearest) * _DEGREES / POSITIONS <= tolerance
        return nearest % POSITIONS + 1 if near else None

    def degrees(self, counts: int) -> float:
        """Angle [deg] of a number of counts."""
        return counts / self.turn * _DEGREES

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
"""How the names of controllers that drive a wheel begin. A unit sold as BSC201 says SCC201."""


@dataclass(frozen=True)
class Settings:
    """
    One wheel.

    Attributes
    ----------
    filters : mapping
        Band in each slot, by its number 1 to 6. Slots left out hold no filter.
    serial_number : int, optional
        Of the controller; another one is then refused.
    home_offset : float
        From where the wheel is after homing to slot 1 [deg]. Differs from wheel to wheel: look.
    home_direction, home_limit_switch : int, optional
        1 forward, 2 reverse; 1 the reverse switch, 4 the forward one. Which a wheel needs is
        uncertain: what the controller has is kept unless they are given.
    velocity, home_velocity : float
        [turn/s].
    acceleration : float
        [turn/s^2].
    tolerance : float
        How far from a slot the wheel may be [deg], less than half the way to the next, 30.
    models : mapping
        How the names of the controllers begin that are accepted, and their scales.
    addresses : tuple of tuple
        Where to look for the controller, in this order: the address that tells who it is, and the
        motor's. A BSC20x is a rack and ignores in silence what is sent to a unit.
    channel : int
        Of the motor at its address, from 1.
    faults : StatusBits
        State that is an error. That a wheel's controller sets these is uncertain.
    reply_timeout, home_timeout, move_timeout : float
        Longest wait for a reply, for the home switch, for a move [s].
    start_timeout : float
        Longest wait until a move is seen to start [s].
    stall_timeout : float
        Longest time in which the position may stand in a move [s].
    poll_interval : float
        From one look at the motor to the next [s].

    Raises
    ------
    ValueError
        If a filter is in no slot, or two have one name, or a number is out of its range.
    """

    filters: Mapping[int, str] = field(default_factory=dict)
    serial_number: int | None = None
    home_offset: float = 0.0
    home_direction: int | None = None
    home_limit_switch: int | None = None
    velocity: float = 1.0
    home_velocity: float = 0.2
    acceleration: float = 1.0
    tolerance: float = 0.1
    models: Mapping[str, Scale] = field(default_factory=lambda: MODELS)
    addresses: tuple[tuple[int, int], ...] = ((apt.UNIT, apt.UNIT), (apt.RACK, apt.BAY_1))
    channel: int = 1
    faults: apt.StatusBits = apt.StatusBits.POSITION_ERROR | apt.StatusBits.OVERLOAD
    reply_timeout: float = 1.0
    home_timeout: float = 60.0
    move_timeout: float = 20.0
    start_timeout: float = 1.0
    stall_timeout: float = 2.0
    poll_interval: float = 0.05

    def __post_init__(self) -> None:
        self._check_filters()
        for name in _POSITIVE:
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"Invalid {name} {value} of the wheel. Must be positive.")
        if self.tolerance >= _DEGREES / POSITIONS / 2:
            raise ValueError(f"Invalid tolerance {self.tolerance} deg. Must be less than 30 deg.")
        if not self.addresses:
            raise ValueError("Invalid addresses () of the wheel. Must be one pair at least.")
        if not -_DEGREES < self.home_offset < _DEGREES:
            raise ValueError(f"Invalid home_offset {self.home_offset}. Must lie in (-360, 360).")
        for name, allowed in _HOME.items():
            value = getattr(self, name)
            if value is not None and value not in allowed:
                raise ValueError(f"Invalid {name} {value}. Must be one of {allowed}, or None.")

    def position(self, band: str) -> int:
        """
        Slot of a band's filter.

        Parameters
        ----------
        band : str
            One of `filters`.

        Returns
        -------
        int
            1 to 6.

        Raises
        ------
        ValueError
            If no filter is called so.
        """
        for position, name in self.filters.items():
            if name == band:
                return position
        bands = sorted(self.filters.values())
        raise ValueError(f"Invalid band '{band}' of the wheel. Must be one of {bands}.")

    def _check_filters(self) -> None:
        """Raise if a filter is nowhere, or two have the same name."""
        for position in self.filters:
            BSC20X.target(position)
        names = list(self.filters.values())
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"Repeated filter '{name}'. Each must have a name of its own.")
