"""What a recording holds: its variables, the bits of its flags, the kinds of its notes."""

from dataclasses import dataclass
from enum import IntEnum
from types import MappingProxyType
from typing import Any, Final

from dbthermal.alignment import clocks
from dbthermal.instruments.frames_source import MEANINGS
from dbthermal.schema import STAGES, Variable


@dataclass(frozen=True)
class Flags(Variable):
    """A variable of which each bit says something, with the attributes of the CF conventions."""

    @property
    def attrs(self) -> dict[str, Any]:
        """Attributes to write on the variable."""
        names = " ".join(str(flag.name).lower() for flag in MEANINGS)
        masks = [int(flag) for flag in MEANINGS]
        return {**super().attrs, "flag_masks": masks, "flag_meanings": names}


VARIABLES: Final = MappingProxyType(
    {
        "counts": STAGES["capture"]["counts"],
        "exposure_time": clocks.EXPOSURE_TIME,
        "device_time": Variable(("band", "time"), "float64", "s", "device's stamp of the frame"),
        "host_time": Variable(("band", "time"), "float64", "s", "when the host had the frame"),
        "sequence": Variable(("band", "time"), "int64", "1", "number of the frame by its driver"),
        "frame_flags": Flags(("band", "time"), "uint16", "1", "flags of the frame, 0 is good"),
        "log_time": Variable(("log",), "float64", "s", "time of the note"),
        "log_kind": Variable(("log",), "int16", "1", "what is noted"),
        "log_source": Variable(("log",), "int16", "1", "whose note it is"),
        "log_value": Variable(("log",), "float64", "1", "value of the note, in the source's unit"),
    }
)
"""What every recording holds. Times are on the host's clock since ``clock_origin``; `device_time`
is as it came. The attributes name kinds, sources and flags."""

TELEMETRY: Final = MappingProxyType(
    {
        "telemetry": Variable(
            ("band", "time", "telemetry_row", "x"), "uint16", "1", "telemetry rows as they came"
        ),
        "fpa_temperature": Variable(
            ("band", "time"), "float32", "K", "temperature of the focal-plane array"
        ),
    }
)
"""What a recording holds besides, if the cameras give telemetry."""


class Note(IntEnum):
    """Kinds of notes in the log, by what their value is."""

    READING = 0
    """The reading."""
    READING_FAILED = 1
    """NaN: the instrument gave none."""
    FRAMES_LOST = 2
    """Number of frames that the driver or the camera lost."""
    FRAMES_REFUSED = 3
    """Number of frames that came, but for which the queue was full."""
    SEQUENCE_STANDS = 4
    """Step of the sequence number, 0 or less."""
    DAMAGED = 5
    """Flags of the frame."""
    SHUTTER_CLOSED = 6
    """Sequence number of the first frame."""
    SHUTTER_OPEN = 7
    """Sequence number of the first frame."""
    CORRECTION = 8
    """Camera's number of the frame at which it renewed its offsets, from the telemetry."""
    NO_FRAME = 9
    """Time without a frame [s]."""
    SOURCE_LOST = 10
    """NaN: the source gives no more frames."""
