"""A running stream of the TC-08: samples in the unit's own rhythm, read at least once a minute.

The library keeps the last 600 samples of each channel; what a program does not fetch in time is
overwritten. That is seen in the times, and counted. Tested against an emulated library object, not
against hardware.
"""

import ctypes
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from dbthermal.instruments.closing import Closing
from dbthermal.instruments.tc08 import library as usbtc08
from dbthermal.instruments.tc08 import readings
from dbthermal.instruments.tc08.channels import Channels
from dbthermal.instruments.tc08.library import SAMPLES, Library, TC08Error
from dbthermal.instruments.tc08.readings import Array, Samples

READ_WITHIN: Final = 60.0
"""Longest time between two reads [s], by the library's header; later, it may have lost samples."""

Fetched = tuple[npt.NDArray[np.int64], Array, bool]

# [ms] The library's times begin anew after 24 days: at 2^31 ms, if they are what their type holds.
_WRAP = 2**31

LONGEST: Final = (_WRAP - 1) / 1000.0
"""Longest interval of a stream [s], for which 32 bits hold the milliseconds."""

# [interval] Farthest a sample of the cold junction may lie from that of a channel.
_NEAR = 1.5


@dataclass
class Timeline:
    """
    What a running stream remembers from one read to the next.

    Attributes
    ----------
    interval : float
        Time between two samples of a channel [s].
    last : dict
        Of each channel, the time of its last sample, not wrapped [ms].
    junction : tuple of ndarray
        Times [s] and temperatures [K] of the cold junction: of this read, and the last before it.
    """

    interval: float
    last: dict[int, int] = field(default_factory=dict)
    junction: tuple[Array, Array] = field(default_factory=lambda: (np.empty(0), np.empty(0)))

    def times(self, channel: int, wrapped: npt.NDArray[np.int64]) -> tuple[Array, int]:
        """
        Times of new samples on one line, and how many are missing before and between them.

        The stream is taken to begin within one interval, so that samples overwritten before the
        first read are counted too.

        Parameters
        ----------
        channel : int
            Of the samples.
        wrapped : ndarray of int64
            The library's times [ms], which begin anew every 24 days.

        Returns
        -------
        times : ndarray
            Times from the start of the stream [s].
        lost : int
            Samples that did not come.
        """
        before = self.last.get(channel, 0)
        steps = np.diff(wrapped, prepend=before % _WRAP) % _WRAP
        times = before + np.cumsum(steps)
        if times.size:
            self.last[channel] = int(times[-1])
        missing = np.rint(steps / (1000.0 * self.interval)) - 1.0
        return times / 1000.0, int(np.maximum(missing, 0.0).sum())

    def add_junction(self, times: Array, temperatures: Array) -> None:
        """
        Note the cold junction's new samples, and keep the last one before them.

        Parameters
        ----------
        times : ndarray
            Times [s].
        temperatures : ndarray
            Temperatures [K], NaN where not known.
        """
        kept_times, kept = (values[-1:] for values in self.junction)
        self.junction = np.append(kept_times, times), np.append(kept, temperatures)

    def junction_at(self, times: Array) -> Array:
        """
        Cold junction at the times of another channel: its nearest sample, never an old one.

        Parameters
        ----------
        times : ndarray
            Times [s].

        Returns
        -------
        ndarray
            Temperature [K]; NaN where no sample lies within one interval and a half.
        """
        known, temperatures = self.junction
        if known.size == 0:
            return np.full_like(times, np.nan)
        after = np.clip(np.searchsorted(known, times), 1, max(known.size - 1, 1))
        pair = np.stack([after - 1, np.minimum(after, known.size - 1)])
        distance = np.abs(known[pair] - times)
        nearest = pair[np.argmin(distance, axis=0), np.arange(times.size)]
        near = distance.min(axis=0) <= _NEAR * self.interval
        return np.where(near, temperatures[nearest], np.nan)


class Stream(Closing):
    """
    A stream that runs; made by `TC08.stream`, ended by `close` or by ``with``.

    Parameters
    ----------
    library : Library
        Of the unit.
    handle : int
        Of the unit, which streams already.
    channels : Channels
        That are set; beside them, the cold junction is read.
    interval : float
        Time between two samples of a channel [s].
    clock : callable
        The host's clock [s].
    """

    def __init__(
        self,
        library: Library,
        handle: int,
        channels: Channels,
        *,
        interval: float,
        clock: Callable[[], float],
    ) -> None:
        self.interval = interval
        self._library, self._handle = library, handle
        self._channels = channels
        self._clock, self._read = clock, clock()
        self._timeline = Timeline(interval)

    @property
    def is_running(self) -> bool:
        """True until it is closed."""
        return bool(self._handle)

    @property
    def time_left(self) -> float:
        """Time within which `read` must be called so that nothing is lost [s]."""
        return min(READ_WITHIN, SAMPLES * self.interval) - (self._clock() - self._read)

    def read(self, *, deskew: bool = True) -> dict[int, Samples]:
        """
        Fetch what came since the last read; call it at least once a minute, see `time_left`.

        Parameters
        ----------
        deskew : bool
            True for samples that the library brings to the same times in all channels, which it
            converts one after another.

        Returns
        -------
        dict
            Samples of each channel, 0 being the cold junction; empty arrays if none came yet.

        Raises
        ------
        TC08Error
            If the library fails. What this call had fetched of other channels is gone then, and
            the next read counts it as lost.
        RuntimeError
            If the stream was closed, or the library gives an impossible number of samples.
        """
        if not self._handle:
            raise RuntimeError("The stream of the TC-08 is closed. Must be started again.")
        now = self._clock()
        late, self._read = now - self._read > READ_WITHIN, now
        # The cold junction comes last, so that it reaches as far as the others do.
        fetched = {key: self._fetch(key, deskew) for key in (*self._channels.kinds, 0)}
        junction = self._samples(0, fetched[0], late)
        self._timeline.add_junction(junction.time, junction.temperature)
        others = {key: self._samples(key, fetched[key], late) for key in self._channels.kinds}
        return {0: junction, **others}

    def close(self) -> None:
        """
        End the stream; a second call does nothing. Samples that were not read are gone.

        Raises
        ------
        TC08Error
            If the library could not; the stream counts as closed.
        """
        handle, self._handle = self._handle, 0
        if handle and not self._library.usb_tc08_stop(handle):
            raise TC08Error("stop its stream", self._library.usb_tc08_get_last_error(handle))

    def abandon(self) -> None:
        """Forget the stream of a unit that is being closed, which ends it."""
        self._handle = 0

    def _fetch(self, channel: int, deskew: bool) -> Fetched:  # noqa: FBT001
        """Return times [ms], values and the overflow flag of a channel."""
        function = "usb_tc08_get_temp_deskew" if deskew else "usb_tc08_get_temp"
        values, times = (ctypes.c_float * SAMPLES)(), (ctypes.c_int32 * SAMPLES)()
        overflow = (ctypes.c_int16 * 1)()
        count = getattr(self._library, function)(
            *(self._handle, values, times, SAMPLES, overflow, channel, usbtc08.KELVIN, 0)
        )
        if count == -1:
            code = self._library.usb_tc08_get_last_error(self._handle)
            raise TC08Error(f"read channel {channel} of its stream", code)
        if not 0 <= count <= SAMPLES:
            raise RuntimeError(f"Invalid number of samples {count}. Must lie in 0 to {SAMPLES}.")
        milliseconds = np.array(times[:count], dtype=np.int64)
        return milliseconds, np.array(values[:count], dtype=np.float64), bool(overflow[0])

    def _samples(self, channel: int, fetched: Fetched, late: bool) -> Samples:  # noqa: FBT001
        """Give what was fetched its times and its meaning."""
        milliseconds, raw, overflow = fetched
        times, lost = self._timeline.times(channel, milliseconds)
        bits = np.full(raw.shape, overflow)
        if self._channels.letters[channel] == "X":
            junction = self._timeline.junction_at(times) if channel in self._channels.own else None
            temperature, emf, flag = readings.millivolts(raw, bits, junction)
        else:
            temperature, emf, flag = readings.kelvin(raw, bits)
        return Samples(times, temperature, emf, flag, lost, late)
