"""Which thermocouple is in which socket of the TC-08, and which of the two ways converts it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np

from dbthermal.instruments.tc08 import readings
from dbthermal.instruments.tc08.library import CHANNELS
from dbthermal.instruments.tc08.readings import Array, Scan

Conversion = Literal["library", "its90"]

KINDS: Final = "BEJKNRSTX"
"""Letters of the thermocouples, and X for raw millivolts."""


@dataclass(frozen=True)
class Channels:
    """
    The channels of a unit, and their conversion.

    Parameters
    ----------
    kinds : mapping
        Channel, 1 to 8, to the thermocouple's letter, see `KINDS`; empty before they are set.
    conversion : str
        ``"library"``, or ``"its90"``: type T is read as millivolts and converted here.

    Attributes
    ----------
    letters : dict
        What each of the nine channels is set to in the library: C is the cold junction.
    own : frozenset of int
        Channels whose millivolts are converted here.

    Raises
    ------
    ValueError
        If a channel, a letter or the conversion is another one, or ``"its90"`` is asked for a
        thermocouple other than T.
    """

    kinds: Mapping[int, str] = field(default_factory=dict)
    conversion: Conversion = "library"

    def __post_init__(self) -> None:
        if self.conversion not in {"library", "its90"}:
            raise ValueError(
                f"Invalid conversion '{self.conversion}'. Must be 'library' or 'its90'."
            )
        allowed = "TX" if self.conversion == "its90" else KINDS
        for channel, kind in self.kinds.items():
            if channel not in range(1, CHANNELS):
                raise ValueError(f"Invalid channel {channel}. Must lie in 1 to {CHANNELS - 1}.")
            if len(kind) != 1 or kind not in allowed:
                raise ValueError(
                    f"Invalid thermocouple '{kind}' of channel {channel}. Must be one of "
                    f"{' '.join(allowed)} with conversion '{self.conversion}'."
                )

    @property
    def letters(self) -> dict[int, str]:
        """What each of the nine channels is set to in the library."""
        sockets = range(1, CHANNELS)
        kinds = {channel: self.kinds.get(channel, " ") for channel in sockets}
        return {0: "C", **{key: "X" if key in self.own else kind for key, kind in kinds.items()}}

    @property
    def own(self) -> frozenset[int]:
        """Channels whose millivolts are converted here."""
        if self.conversion == "library":
            return frozenset()
        return frozenset(channel for channel, kind in self.kinds.items() if kind == "T")

    def scan(self, time: float, duration: float, raw: Array, overflow_bits: int) -> Scan:
        """
        Give a single reading its meaning.

        Parameters
        ----------
        time, duration : float
            Of the scan, on the host's clock [s].
        raw : ndarray, shape (9,)
            The library's values [K] or [mV].
        overflow_bits : int
            Bit n is channel n.

        Returns
        -------
        Scan
            Temperatures and flags.
        """
        overflow = (overflow_bits >> np.arange(CHANNELS)) & 1
        temperature, emf, flag = readings.kelvin(raw, overflow)
        for channel, letter in self.letters.items():
            if letter == "X":
                one = slice(channel, channel + 1)
                junction = temperature[0] if channel in self.own else None
                converted = readings.millivolts(raw[one], overflow[one], junction)
                temperature[one], emf[one], flag[one] = converted
        return Scan(time, duration, temperature, emf, flag)
