"""An emulated TC-08: an object with the functions of the vendor's library, and none of its code.

It writes into the caller's ctypes buffers as the library does, so that the real driver runs above
it. The USB protocol below the library is not public, and nothing here pretends to know it. What the
header ``usbtc08.h`` says is kept: signatures, error numbers, 600 samples, NaN for channels that are
off. What it does not say is a choice, and marked so: conversion times (0.1 s for each channel and
the cold junction, from datalogd's documentation), what an open socket reads, the error after
unplugging.
"""

import math
from collections import deque
from collections.abc import Callable, MutableSequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal, Self

from dbthermal.instruments import thermocouple
from dbthermal.instruments.emulated.world import World
from dbthermal.instruments.tc08.library import CHANNELS, KELVIN, SAMPLES

Numbers = MutableSequence[Any]
"""A ctypes array of the caller, written in place."""

CONVERSION: Final = 0.1
"""Time that one channel takes [s]; likely, not certain."""

LIMIT: Final = 70.0
"""Voltage at which the emulated converter overflows [mV]; likely, not certain."""

_HANDLE = 1
_WRAP = 2**31
# Factor and shift from kelvin to °C, °F, K, °R.
_UNITS: tuple[tuple[float, float], ...] = ((1.0, -273.15), (1.8, -459.67), (1.0, 0.0), (1.8, 0.0))


@dataclass
class Faults:
    """
    What goes wrong; plain attributes, to be set at any time.

    Attributes
    ----------
    open : set of int
        Channels whose thermocouple is open, beside those whose temperature is NaN.
    open_reads : str
        What an open thermocouple reads: ``"nan"``, or ``"ambient"``, a plausible number near the
        cold junction, as the vendor's forum reports; no driver can tell that one.
    overflow : set of int
        Channels whose converter overflows.
    errors : dict
        Function to the error number with which its next call fails.
    firmware_delay : float
        How long opening takes [s].
    units : int
        Units that are plugged in, 0 or 1.
    unplugged : bool
        True once the unit was pulled out: every function fails.
    unplugged_error : int
        With which error; 16 and 7 are plausible.
    starved : set of int
        Samples, counted from 1, that the host was too slow to take: NaN in a stream.
    """

    open: set[int] = field(default_factory=set)
    open_reads: Literal["nan", "ambient"] = "nan"
    overflow: set[int] = field(default_factory=set)
    errors: dict[str, int] = field(default_factory=dict)
    firmware_delay: float = 0.0
    units: int = 1
    unplugged: bool = False
    unplugged_error: int = 16
    starved: set[int] = field(default_factory=set)


class EmulatedTC08:
    """
    The library and one unit, with type-T thermocouples whatever letter they are set to.

    Parameters
    ----------
    temperature : callable
        Temperature [K] of the tip of a channel, 1 to 8, at a time [s]; NaN if it is open.
    clock : callable
        Time [s].
    sleep : callable, optional
        Waits while a single reading is converted [s]; without it, that takes no time.
    junction_temperature : float
        Of the terminals [K]; may be set.
    noise : callable, optional
        Gives the noise of one conversion [mV].
    conversion_error : float
        What the library's own conversion of thermocouples adds [K]; may be set.
    first_ms : int
        Time of the start of a stream [ms], to see it wrap.

    Attributes
    ----------
    faults : Faults
        What goes wrong.
    is_simulated : bool
        True.
    """

    is_simulated: Final = True
    serial: Final = b"EMULATED"

    def __init__(
        self,
        temperature: Callable[[int, float], float],
        *,
        clock: Callable[[], float],
        sleep: Callable[[float], None] | None = None,
        junction_temperature: float = 296.15,
        noise: Callable[[], float] | None = None,
        conversion_error: float = 0.0,
        first_ms: int = 0,
    ) -> None:
        self.faults = Faults()
        self.junction_temperature = junction_temperature
        self.conversion_error = conversion_error
        self._temperature, self._noise, self._first = temperature, noise, first_ms
        self._clock, self._sleep = clock, sleep or (lambda _: None)
        self._is_open, self._error = False, 0
        self._opening: float | None = None
        self._kinds: dict[int, str] = {}
        self._start, self._interval, self._taken = 0.0, 0, 0
        self._rings: dict[int, deque[tuple[int, float, float, bool]]] = {}

    @classmethod
    def from_world(cls, world: World, **settings: Any) -> Self:
        """
        Put the thermocouples where the world has them.

        Parameters
        ----------
        world : World
            Its thermocouples are asked when a reading is made; in a stream, when it is fetched.
        **settings
            As of the class.

        Returns
        -------
        EmulatedTC08
            On the world's clock.
        """
        return cls(
            lambda channel, _: world.thermocouple_temperature(channel),
            **{"clock": world.clock, **settings},
        )

    def usb_tc08_open_unit_async(self) -> int:
        """Begin to open the unit: 1, or 0 if it fails."""
        if self._fails("usb_tc08_open_unit_async"):
            return 0
        if self._opening is not None:
            return self._fail(6)
        self._opening = self._clock()
        return 1

    def usb_tc08_open_unit_progress(self, handle: Numbers, percent: Numbers) -> int:
        """Progress of opening: 0 pending, 1 complete with the handle, or 0 if none; -1 failed."""
        if self._fails("usb_tc08_open_unit_progress") or self._opening is None:
            self._opening = None
            return -1
        passed, delay = self._clock() - self._opening, self.faults.firmware_delay
        percent[0] = 100 if passed >= delay else int(100 * passed / delay)
        if passed < delay:
            return 0
        self._opening = None
        is_free = self.faults.units > 0 and not self._is_open
        self._is_open = self._is_open or is_free
        handle[0] = _HANDLE if is_free else 0
        return 1

    def usb_tc08_close_unit(self, handle: int) -> int:
        """Close the unit: 1, or 0 if it fails."""
        if self._refuses("usb_tc08_close_unit", handle):
            return 0
        self._is_open, self._interval, self._kinds = False, 0, {}
        return 1

    def usb_tc08_get_last_error(self, handle: int) -> int:
        """Error of the last function that failed, -1 for a handle that there is not."""
        return self._error if handle in {0, _HANDLE} else -1

    def usb_tc08_get_unit_info(self, handle: int, info: Numbers) -> int:
        """Write the identity, which says that it is emulated: 1, or 0 if it fails."""
        if self._refuses("usb_tc08_get_unit_info", handle):
            return 0
        if info[0].size != 40:
            return self._fail(3)
        info[0].driver, info[0].serial = b"emulated", self.serial
        info[0].hardware, info[0].variant, info[0].calibration_date = 1, 8, b"01Jan00"
        return 1

    def usb_tc08_set_mains(self, handle: int, sixty_hertz: int) -> int:
        """Take the mains frequency, and do nothing with it: 1, or 0 if it fails."""
        if self._refuses("usb_tc08_set_mains", handle):
            return 0
        return 1 if sixty_hertz in {0, 1} else self._fail(3)

    def usb_tc08_set_channel(self, handle: int, channel: int, kind: int) -> int:
        """Set a channel to a letter; C belongs to channel 0 alone: 1, or 0 if it fails."""
        if self._refuses("usb_tc08_set_channel", handle):
            return 0
        letters = "C " if channel == 0 else "BEJKNRSTX "
        if channel not in range(CHANNELS) or chr(kind) not in letters:
            return self._fail(3)
        kinds = {**self._kinds, channel: chr(kind)}
        self._kinds = {key: letter for key, letter in kinds.items() if letter != " "}
        return 1

    def usb_tc08_get_minimum_interval_ms(self, handle: int) -> int:
        """Shortest interval of the channels that are set [ms], or 0 if it fails."""
        if self._refuses("usb_tc08_get_minimum_interval_ms", handle):
            return 0
        return round(1000 * self._scan_time()) if self._kinds else self._fail(2)

    def usb_tc08_get_single(
        self, handle: int, values: Numbers, overflow: Numbers, units: int
    ) -> int:
        """Convert all channels once, NaN being those that are off: 1, or 0 if it fails."""
        if self._refuses("usb_tc08_get_single", handle):
            return 0
        if self._interval or not self._kinds:
            return self._fail(5 if self._interval else 2)
        self._sleep(self._scan_time())
        readings = [self._convert(channel, self._clock()) for channel in range(CHANNELS)]
        for channel, (value, _) in enumerate(readings):
            values[channel] = self._in_units(channel, value, units)
        overflow[0] = sum(beyond << channel for channel, (_, beyond) in enumerate(readings))
        return 1

    def usb_tc08_run(self, handle: int, interval_ms: int) -> int:
        """Begin to stream: the interval [ms], or 0 if it fails."""
        if self._refuses("usb_tc08_run", handle):
            return 0
        if not self._kinds:
            return self._fail(2)
        if interval_ms < round(1000 * self._scan_time()):
            return self._fail(3)
        self._start, self._interval, self._taken = self._clock(), interval_ms, 0
        self._rings = {channel: deque(maxlen=SAMPLES) for channel in self._kinds}
        return interval_ms

    def usb_tc08_stop(self, handle: int) -> int:
        """End the stream: 1, or 0 if it fails."""
        if self._refuses("usb_tc08_stop", handle):
            return 0
        self._interval = 0
        return 1

    def usb_tc08_get_temp(self, *arguments: Any) -> int:
        """Fetch samples as they were converted, one channel after another: count, or -1."""
        return self._fetch("usb_tc08_get_temp", arguments, deskewed=False)

    def usb_tc08_get_temp_deskew(self, *arguments: Any) -> int:
        """Fetch samples brought to the same times in all channels: count, or -1."""
        return self._fetch("usb_tc08_get_temp_deskew", arguments, deskewed=True)

    def _fetch(self, function: str, arguments: tuple[Any, ...], *, deskewed: bool) -> int:
        handle, values, times, length, overflow, channel, units, _fill = arguments
        if self._refuses(function, handle):
            return -1
        if not self._interval or channel not in self._rings:
            return self._fail(3 if self._interval else 5) - 1
        self._sample()
        ring = self._rings[channel]
        taken = [ring.popleft() for _ in range(min(len(ring), length))]
        for index, (milliseconds, skewed, even, _) in enumerate(taken):
            times[index] = milliseconds
            values[index] = self._in_units(channel, even if deskewed else skewed, units)
        overflow[0] = any(sample[3] for sample in taken)
        return len(taken)

    def _sample(self) -> None:
        """Take the samples that are due; a full ring loses its oldest."""
        due = math.floor(1000.0 * (self._clock() - self._start) / self._interval + 1e-6)
        for count in range(max(self._taken, due - SAMPLES) + 1, due + 1):
            time = self._start + count * self._interval / 1000.0
            milliseconds = (self._first + count * self._interval) % _WRAP
            for place, (channel, ring) in enumerate(sorted(self._rings.items())):
                even, beyond = self._convert(channel, time)
                skewed, _ = self._convert(channel, time + place * CONVERSION)
                if count in self.faults.starved:
                    even = skewed = math.nan
                ring.append((milliseconds, skewed, even, beyond))
        self._taken = max(due, self._taken)

    def _convert(self, channel: int, time: float) -> tuple[float, bool]:
        """Return what the library makes of a channel [K] or [mV], and whether it overflowed."""
        kind = self._kinds.get(channel, " ")
        if channel == 0 or kind == " ":
            return (self.junction_temperature if kind == "C" else math.nan), False
        tip = self._temperature(channel, time)
        if channel in self.faults.open or math.isnan(tip):
            if self.faults.open_reads == "nan":
                return math.nan, False
            tip = self.junction_temperature
        if channel in self.faults.overflow:
            return (LIMIT if kind == "X" else thermocouple.TEMPERATURE.highest), True
        junction = float(thermocouple.emf(self.junction_temperature))
        voltage = float(thermocouple.emf(tip)) - junction + (self._noise() if self._noise else 0.0)
        if kind == "X":
            return voltage, False
        if not thermocouple.EMF.holds(voltage + junction):
            return math.nan, False
        warm = float(thermocouple.temperature(voltage, self.junction_temperature))
        return warm + self.conversion_error, False

    def _in_units(self, channel: int, value: float, units: int) -> float:
        """Bring kelvin to the units that are asked for; millivolts stay what they are."""
        factor, shift = (1.0, 0.0) if self._kinds.get(channel) == "X" else _UNITS[units]
        return value if units == KELVIN else factor * value + shift

    def _scan_time(self) -> float:
        return CONVERSION * len(self._kinds.keys() | {0})

    def _refuses(self, function: str, handle: int) -> bool:
        """Tell whether a call fails: by a fault, or for the handle is none."""
        if self._fails(function):
            return True
        if not self._is_open or handle != _HANDLE:
            self._error = 3
            return True
        return False

    def _fails(self, function: str) -> bool:
        if self.faults.unplugged:
            self._error = self.faults.unplugged_error
        elif function in self.faults.errors:
            self._error = self.faults.errors.pop(function)
        else:
            return False
        return True

    def _fail(self, error: int) -> int:
        """Note an error; 0, which most functions return then."""
        self._error = error
        return 0
