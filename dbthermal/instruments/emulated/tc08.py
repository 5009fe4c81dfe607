"""Emulated TC-08: an object with the functions of the vendor's library, and none of its code.

It writes into the caller's ctypes buffers as the library does, so that the real driver runs above
it. Signatures, error numbers and NaN for channels that are off are those of the header
``usbtc08.h``. The conversion time is from datalogd's documentation, and likely, not certain.
"""

import math
from collections.abc import Callable, MutableSequence
from typing import Any, Final

from dbthermal.instruments.clock import Clock
from dbthermal.instruments.emulated.world import ROOM
from dbthermal.instruments.tc08 import CHANNELS, KELVIN

Numbers = MutableSequence[Any]  # a ctypes array of the caller, written in place
CONVERSION: Final = 0.1  # conversion time of one channel [s]
RANGE: Final = (3.15, 673.15)  # of type T [K]

_HANDLE = 1


class EmulatedTC08:
    """The library and one unit, with type-T thermocouples whatever letter they are set to.

    `temperature` returns that of the tip of a channel, 1 to 8 [K], NaN if it is open; a reading is
    converted on its `clock`. As in the vendor's library, functions return 0 if they fail.
    """

    is_simulated: Final = True

    def __init__(self, temperature: Callable[[int], float], clock: Clock) -> None:
        self._temperature, self.clock = temperature, clock
        self._is_open, self._error = False, 0
        self._kinds: dict[int, str] = {}

    def usb_tc08_open_unit_async(self) -> int:
        """Begin to open the unit."""
        return 1

    def usb_tc08_open_unit_progress(self, handle: Numbers, percent: Numbers) -> int:
        """Progress of opening: 0 pending, 1 complete (handle 0 if no unit is free), -1 failed."""
        handle[0], percent[0] = 0 if self._is_open else _HANDLE, 100
        self._is_open = True
        return 1

    def usb_tc08_close_unit(self, handle: int) -> int:
        """Close the unit."""
        if not self._accepts(handle):
            return 0
        self._is_open, self._kinds = False, {}
        return 1

    def usb_tc08_get_last_error(self, handle: int) -> int:
        """Error of the last function that failed, -1 if the handle is not open."""
        return self._error if handle in {0, _HANDLE} else -1

    def usb_tc08_get_unit_info(self, handle: int, info: Numbers) -> int:
        """Write the identity, which says that it is emulated."""
        if not self._accepts(handle):
            return 0
        if info[0].size != 40:
            return self._fail(3)
        info[0].driver, info[0].serial = b"emulated", b"EMULATED"
        info[0].hardware, info[0].variant, info[0].calibration_date = 1, 8, b"01Jan00"
        return 1

    def usb_tc08_set_channel(self, handle: int, channel: int, kind: int) -> int:
        """Set a channel to a letter; C is for channel 0 alone, a space switches it off."""
        if not self._accepts(handle):
            return 0
        letters = "C " if channel == 0 else "BEJKNRST "
        if channel not in range(CHANNELS) or chr(kind) not in letters:
            return self._fail(3)
        self._kinds.pop(channel, None)
        if chr(kind) != " ":
            self._kinds[channel] = chr(kind)
        return 1

    def usb_tc08_get_single(
        self, handle: int, values: Numbers, overflow: Numbers, units: int
    ) -> int:
        """Convert all channels once [K], NaN for those that are off."""
        if not self._accepts(handle):
            return 0
        if units != KELVIN or not self._kinds:
            return self._fail(2 if units == KELVIN else 3)
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
        tip = self._temperature(channel)
        return (tip if RANGE[0] <= tip <= RANGE[1] else math.nan), False

    def _accepts(self, handle: int) -> bool:
        """True if the unit is open, and the handle is that of the unit."""
        accepted = self._is_open and handle == _HANDLE
        if not accepted:
            self._error = 3
        return accepted

    def _fail(self, error: int) -> int:
        """Note an error, and return the 0 of a failed function."""
        self._error = error
        return 0
