"""An emulated TC-08 with faults, each set by an attribute of `faults`."""

from dataclasses import dataclass, field
from typing import Any

from dbthermal.instruments.emulated.tc08 import EmulatedTC08, Numbers
from dbthermal.instruments.emulated.world import ROOM

FULL_SCALE = 673.15
"""What the library makes of an overflow [K]; a choice, the header does not say."""


@dataclass
class Faults:
    """
    Faults of the unit and its library; may be changed at any time.

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
        self.faults = Faults()
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
