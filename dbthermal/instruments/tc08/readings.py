"""Readings of the TC-08: what the library gave, as temperatures, or as what it is instead.

All here is arithmetic on arrays; what reads the unit is in `unit` and `stream`.
"""

from dataclasses import dataclass
from enum import IntFlag

import numpy as np
import numpy.typing as npt

from dbthermal.instruments import thermocouple

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.uint8]


class Flag(IntFlag):
    """Why a reading is no temperature; 0 if it is one."""

    GOOD = 0
    OVERFLOW = 1
    """The voltage was beyond the converter's range; in a stream, at some sample of this read."""
    MISSING = 2
    """The library gave no number: open thermocouple, channel off, sample lost on the way."""
    OUT_OF_RANGE = 4
    """The value belongs to no temperature of the thermocouple."""
    NO_JUNCTION = 8
    """The temperature of the cold junction is not known, or impossible."""
    VOLTAGE = 16
    """The channel is one of raw millivolts."""


@dataclass(frozen=True)
class Scan:
    """
    One reading of all nine channels; index 0 is the cold junction.

    Attributes
    ----------
    time : float
        Middle of the scan on the host's clock [s]; the channels are converted one after another.
    duration : float
        Length of the scan [s].
    temperature : ndarray, shape (9,)
        Temperature [K], NaN unless `flag` is 0.
    emf : ndarray, shape (9,)
        Voltage [mV] of the channels that are read as such, else NaN.
    flag : ndarray of uint8, shape (9,)
        See `Flag`; channels that are off are `Flag.MISSING`.
    """

    time: float
    duration: float
    temperature: Array
    emf: Array
    flag: Flags


@dataclass(frozen=True)
class Samples:
    """
    What a stream brought of one channel since the last read.

    Attributes
    ----------
    time : ndarray
        On the unit's clock, from the start of the stream [s].
    temperature, emf, flag : ndarray
        As in `Scan`, one for each time.
    lost : int
        Samples missing since the last one of the read before.
    late : bool
        True if more than `stream.READ_WITHIN` went by since the read before.
    """

    time: Array
    temperature: Array
    emf: Array
    flag: Flags
    lost: int
    late: bool


def kelvin(raw: npt.ArrayLike, overflow: npt.ArrayLike) -> tuple[Array, Array, Flags]:
    """
    Temperatures that the library converted.

    Parameters
    ----------
    raw : array_like
        The library's values [K].
    overflow : array_like of bool
        Its overflow bits.

    Returns
    -------
    temperature : ndarray
        Temperature [K], NaN unless the flag is 0.
    emf : ndarray
        NaN [mV]: it is not known.
    flag : ndarray of uint8
        See `Flag`; a temperature that is not positive is `Flag.OUT_OF_RANGE`.
    """
    values, flag = _flagged(raw, overflow)
    flag[np.isfinite(values) & (values <= 0.0)] |= np.uint8(Flag.OUT_OF_RANGE)
    return np.where(flag == 0, values, np.nan), np.full_like(values, np.nan), flag


def millivolts(
    raw: npt.ArrayLike, overflow: npt.ArrayLike, junction: npt.ArrayLike | None
) -> tuple[Array, Array, Flags]:
    """
    Raw voltages, and the temperatures of type-T thermocouples that gave them.

    Parameters
    ----------
    raw : array_like
        The library's values [mV].
    overflow : array_like of bool
        Its overflow bits.
    junction : array_like, optional
        Temperature of the cold junction at each value [K], NaN where it is not known. Without it
        the voltage is all that is asked for, and the flag is `Flag.VOLTAGE`.

    Returns
    -------
    temperature : ndarray
        Temperature [K], NaN unless the flag is 0.
    emf : ndarray
        Voltage [mV], NaN where it overflowed or is missing.
    flag : ndarray of uint8
        See `Flag`.
    """
    values, flag = _flagged(raw, overflow)
    emf = np.where(flag == 0, values, np.nan)
    temperature = np.full_like(emf, np.nan)
    if junction is None:
        return temperature, emf, flag | np.uint8(Flag.VOLTAGE)
    ends = np.broadcast_to(np.asarray(junction, dtype=np.float64), emf.shape)
    flag[~thermocouple.TEMPERATURE.holds(ends)] |= np.uint8(Flag.NO_JUNCTION)
    good = flag == 0
    total = np.full_like(emf, np.nan)
    total[good] = emf[good] + thermocouple.emf(ends[good])
    flag[good & ~thermocouple.EMF.holds(total)] |= np.uint8(Flag.OUT_OF_RANGE)
    good = flag == 0
    temperature[good] = thermocouple.temperature(emf[good], ends[good])
    return temperature, emf, flag


def _flagged(raw: npt.ArrayLike, overflow: npt.ArrayLike) -> tuple[Array, Flags]:
    """Return the values, and a flag where one overflowed or is no number."""
    values = np.atleast_1d(np.asarray(raw, dtype=np.float64))
    flag = np.where(np.asarray(overflow, dtype=np.bool_), Flag.OVERFLOW, Flag.GOOD)
    missing = np.where(np.isfinite(values), Flag.GOOD, Flag.MISSING)
    return values, (flag | missing).astype(np.uint8)
