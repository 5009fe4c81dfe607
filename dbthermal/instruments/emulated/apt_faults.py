"""What the emulated APT controllers are, and what can go wrong with them."""

import math
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Final

from dbthermal.instruments import apt

_NONE = apt.StatusBits(0)


@dataclass(frozen=True)
class Model:
    """
    What distinguishes controllers; the driver has these numbers from a place of its own.

    Attributes
    ----------
    turn : int
        Counts of a turn of the wheel.
    velocity, acceleration : float
        Device units of one count/s and of one count/s^2.
    is_rack : bool
        Whether its motor is in a bay, which has an address of its own.
    """

    turn: int
    velocity: float
    acceleration: float
    is_rack: bool


_RACK = Model(409_600, 53.68, 53.68 * 204.94e-6, is_rack=True)
_UNIT = Model(25_600, 1.0, 1.0, is_rack=False)
MODELS: Final = MappingProxyType(
    {"BSC201": _RACK, "BSC203": _RACK, "SCC201": _RACK, "BSC101": _UNIT, "KDC101": _UNIT}
)
"""Controllers by the name they say; KDC101 drives no wheel."""


@dataclass
class Faults:
    """
    Knobs that make the emulated wheel misbehave; may be turned at any time.

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
        Way that is left when a move is said to be over [deg].
    slips : float
        Way that the wheel loses in every motion, unnoticed [deg].
    deaf_to : set of int
        Identifiers of messages that it ignores.
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
    stuck: apt.StatusBits = _NONE
    slow: float = 1.0
    stands_after: float = math.inf
    stops_short: float = 0.0
    slips: float = 0.0
    deaf_to: set[int] = field(default_factory=set)
    notice: str = ""
