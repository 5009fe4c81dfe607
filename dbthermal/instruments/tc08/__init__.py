"""Pico TC-08: eight thermocouples and their cold junction, in kelvin, one by one or streaming.

A value that is not one is never given as a number: where the converter overflowed, the library has
no number (an open thermocouple, a sample that was lost on the way), or the voltage belongs to no
temperature, the temperature is NaN and `Flag` says why. Not every open thermocouple can be told:
the vendor's support forum (picotech.com, topic 29871) says that one may also read like a noisy
room, which no driver can see. Move the blackbody, and see whether the reading follows.

Type T can be converted by the library, or by `dbthermal.instruments.thermocouple` from raw
millivolts and the cold junction; `TC08.cross_check` compares the two.

The driver was tested against an emulated library object and a stub compiled from the public
signatures, not against hardware.
"""

from dbthermal.instruments.tc08.library import ERRORS, TC08Error, load
from dbthermal.instruments.tc08.opening import Identity
from dbthermal.instruments.tc08.readings import Flag, Samples, Scan
from dbthermal.instruments.tc08.stream import Stream
from dbthermal.instruments.tc08.unit import TC08

__all__ = ["ERRORS", "TC08", "Flag", "Identity", "Samples", "Scan", "Stream", "TC08Error", "load"]
