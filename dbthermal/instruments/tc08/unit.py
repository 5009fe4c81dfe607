"""One TC-08 behind the vendor's library: opened, set up, read one by one or as a stream.

Tested against an emulated library object and a compiled stub, not against hardware.
"""

import ctypes
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Self

import numpy as np

from dbthermal.instruments.closing import Closing
from dbthermal.instruments.tc08 import library as usbtc08
from dbthermal.instruments.tc08 import opening
from dbthermal.instruments.tc08.channels import Channels, Conversion
from dbthermal.instruments.tc08.library import CHANNELS, Library, TC08Error
from dbthermal.instruments.tc08.opening import OPEN_TIMEOUT, Identity
from dbthermal.instruments.tc08.readings import Scan
from dbthermal.instruments.tc08.stream import LONGEST, Stream

if TYPE_CHECKING:
    from dbthermal.instruments.emulated.world import World

_WHOLE = 1e-6  # [ms] rounding of an interval
_MAINS = (50, 60)  # [Hz], in the library's order


class TC08(Closing):
    """
    A TC-08; opened by `open`, `from_url` or ``with``, for one thread at a time.

    Parameters
    ----------
    library : Library
        From `load`, or an emulated one.
    clock, sleep : callable
        The host's clock [s], and waiting [s]; injected by tests.
    """

    def __init__(
        self,
        library: Library,
        *,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._library = library
        self._clock, self._sleep = clock, sleep
        self._handle = 0
        self._channels = Channels()
        self._stream: Stream | None = None

    @classmethod
    def from_url(cls, url: str = "tc08:", *, world: "World | None" = None) -> Self:
        """
        Find the library and open the first unit.

        Parameters
        ----------
        url : str
            ``tc08:``, the library being found as `load` does, ``tc08:///path/of/library.so``, or
            ``sim://tc08`` for an emulated unit.
        world : World, optional
            Of the emulated unit.

        Returns
        -------
        TC08
            Open.

        Raises
        ------
        ValueError
            If the URL is another one, or a world is missing, or given to a real unit.
        OSError, TC08Error, TimeoutError
            As `load` and `open`.
        """
        return cls(opening.library_of(url, world)).open()

    @property
    def is_simulated(self) -> bool:
        """True if the library is an emulated one."""
        return opening.is_simulated(self._library)

    def open(self, serial_number: str | None = None, *, timeout: float = OPEN_TIMEOUT) -> Self:
        """
        Open the first free unit, or that of a serial number; others are closed again.

        Parameters
        ----------
        serial_number : str, optional
            As in `Identity`.
        timeout : float
            How long each unit may take [s].

        Returns
        -------
        TC08
            This one.

        Raises
        ------
        RuntimeError
            If it is open already.
        ConnectionError
            If there is no unit, or none of that number; the message names those that were found.
        TC08Error
            If the library says why it failed.
        TimeoutError
            If it takes too long.
        """
        if self._handle:
            raise RuntimeError("The TC-08 is open already. Must be closed first.")
        opened: dict[int, str] = {}
        try:
            while handle := self._open_unit(timeout):
                opened[handle] = "unknown"
                opened[handle] = opening.identify(self._library, handle).serial_number
                if serial_number in {None, opened[handle]}:
                    self._handle = handle
                    return self
        finally:
            for handle in opened.keys() - {self._handle}:
                self._library.usb_tc08_close_unit(handle)
        wanted = "" if serial_number is None else f" '{serial_number}'"
        raise ConnectionError(
            f"No TC-08{wanted}; found: {sorted(opened.values())}. "
            "Must be plugged in, and free: no other program may have it."
        )

    def close(self) -> None:
        """
        Close the unit, which ends a stream; a second call does nothing.

        Raises
        ------
        TC08Error
            If the library could not, as after unplugging; the unit counts as closed.
        """
        handle, self._handle = self._handle, 0
        if self._stream is not None:
            self._stream.abandon()
        if handle and not self._library.usb_tc08_close_unit(handle):
            raise TC08Error("close", self._library.usb_tc08_get_last_error(handle))

    def __enter__(self) -> Self:
        return self if self._handle else self.open()

    def identity(self) -> Identity:
        """
        Identity of the unit, for provenance.

        Returns
        -------
        Identity
            Serial number, date of calibration, versions.

        Raises
        ------
        TC08Error, RuntimeError
            If the library fails, or the unit is not open.
        """
        return opening.identify(self._library, self._open_handle())

    def set_mains(self, frequency: int) -> None:
        """
        Say which mains hum to reject.

        Parameters
        ----------
        frequency : int
            50 or 60 [Hz].

        Raises
        ------
        ValueError
            If it is neither.
        TC08Error, RuntimeError
            If the library fails, the unit is not open, or streams.
        """
        if frequency not in _MAINS:
            raise ValueError(f"Invalid mains frequency {frequency} Hz. Must be 50 or 60 Hz.")
        handle, what = self._idle_handle("set the mains"), "set the mains frequency"
        self._require(self._library.usb_tc08_set_mains(handle, _MAINS.index(frequency)), what)

    def set_channels(self, kinds: Mapping[int, str], *, conversion: Conversion = "library") -> None:
        """
        Say which thermocouples are there; all other channels are switched off.

        Parameters
        ----------
        kinds : mapping
            Channel, 1 to 8, to the thermocouple's letter, one of B E J K N R S T, or X for raw
            millivolts. The cold junction is always read.
        conversion : str
            ``"library"``, or ``"its90"``: type T is read as millivolts and converted here.

        Raises
        ------
        ValueError
            If a channel, a letter or the conversion is another one, there is no channel, or
            ``"its90"`` is asked for a thermocouple other than T.
        TC08Error, RuntimeError
            If the library fails, the unit is not open, or streams.
        """
        channels = Channels(dict(sorted(kinds.items())), conversion)
        if not kinds:
            raise ValueError("Invalid channels {}. Must be one at least.")
        handle = self._idle_handle("set its channels")
        self._channels = Channels()  # until all is done
        for channel, letter in channels.letters.items():
            done = self._library.usb_tc08_set_channel(handle, channel, ord(letter))
            self._require(done, f"set channel {channel} to '{letter}'")
        self._channels = channels

    def minimum_interval(self) -> float:
        """
        Shortest interval of a stream of the channels that are set.

        Returns
        -------
        float
            Interval [s]; about 0.1 for each channel and 0.1 for the cold junction.

        Raises
        ------
        TC08Error, RuntimeError
            If the library fails, the unit is not open, or no channels are set.
        """
        interval = self._library.usb_tc08_get_minimum_interval_ms(self._ready_handle())
        return float(self._require(interval, "give its minimum interval")) / 1000.0

    def single(self) -> Scan:
        """
        Read all channels once; it takes 0.2 s for one thermocouple, 0.9 s for eight.

        Returns
        -------
        Scan
            Temperatures and flags of the nine channels.

        Raises
        ------
        TC08Error, RuntimeError
            If the library fails, the unit is not open, no channels are set, or it streams.
        """
        handle = self._ready_handle()
        values, overflow = (ctypes.c_float * CHANNELS)(), (ctypes.c_int16 * 1)()
        start = self._clock()
        done = self._library.usb_tc08_get_single(handle, values, overflow, usbtc08.KELVIN)
        length = self._clock() - start
        self._require(done, "take a single reading")
        raw = np.array(values, dtype=np.float64)
        return self._channels.scan(start + 0.5 * length, length, raw, overflow[0])

    def cross_check(self, channel: int) -> float:
        """
        Compare the two conversions of one type-T thermocouple, in two readings one after another.

        The channel is read alone meanwhile; afterwards all are as they were.

        Parameters
        ----------
        channel : int
            The channel, 1 to 8; what it is at must be steady.

        Returns
        -------
        float
            Temperature by ITS-90 less that of the library [K]; NaN if one of them is none.

        Raises
        ------
        ValueError, TC08Error, RuntimeError
            As `set_channels` and `single`.
        """
        if self._channels.kinds.get(channel) != "T":
            raise ValueError(f"Invalid channel {channel} to compare. Must be set to type T.")
        before, found = self._channels, []
        ways: tuple[Conversion, Conversion] = ("library", "its90")
        try:
            for way in ways:
                self.set_channels({channel: "T"}, conversion=way)
                found.append(float(self.single().temperature[channel]))
        finally:
            self.set_channels(before.kinds, conversion=before.conversion)
        return found[1] - found[0]

    def stream(self, interval: float) -> Stream:
        """
        Start a stream of the channels that are set.

        Parameters
        ----------
        interval : float
            Time between two samples of a channel [s], a whole number of milliseconds. The unit
            may choose another: `Stream.interval` says which.

        Returns
        -------
        Stream
            Running, a context manager.

        Raises
        ------
        ValueError
            If the interval is shorter than `minimum_interval`, not whole, or beyond 24 days.
        TC08Error, RuntimeError
            If the library fails, the unit is not open, no channels are set, or it streams.
        """
        handle, shortest = self._ready_handle(), self.minimum_interval()
        asked = round(1000.0 * interval) if shortest <= interval <= LONGEST else 0
        if not asked or abs(1000.0 * interval - asked) > _WHOLE:
            raise ValueError(
                f"Invalid interval {interval} s of {len(self._channels.kinds)} channels. "
                f"Must be {shortest} s or longer, to {LONGEST} s, and whole milliseconds."
            )
        actual = self._require(self._library.usb_tc08_run(handle, asked), "start to stream")
        self._stream = Stream(
            self._library, handle, self._channels, interval=actual / 1000.0, clock=self._clock
        )
        return self._stream

    def _open_unit(self, timeout: float) -> int:
        return opening.open_unit(self._library, timeout, clock=self._clock, sleep=self._sleep)

    def _require(self, result: int, what: str) -> int:
        """Return what the library returned, unless that says that it failed."""
        if result <= 0:
            raise TC08Error(what, self._library.usb_tc08_get_last_error(self._handle))
        return result

    def _open_handle(self) -> int:
        if not self._handle:
            raise RuntimeError("The TC-08 is closed. Must be opened first.")
        return self._handle

    def _idle_handle(self, what: str) -> int:
        if self._stream is not None and self._stream.is_running:
            raise RuntimeError(f"The TC-08 cannot {what} while it streams. Must be stopped first.")
        return self._open_handle()

    def _ready_handle(self, what: str = "take readings") -> int:
        handle = self._idle_handle(what)
        if not self._channels.kinds:
            raise RuntimeError(f"The TC-08 cannot {what} yet. Must be told its channels first.")
        return handle
