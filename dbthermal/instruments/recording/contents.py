"""What a recording holds: its variables, the bits of its flags, the kinds of its notes.

All of it is written into the store, too, in words: who opens it may have no more than the store.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag
from types import MappingProxyType
from typing import Any, Final

from dbthermal.instruments import telemetry
from dbthermal.instruments.camera import MEANINGS
from dbthermal.schema import EXPOSURE_TIME, STAGES, Variable


class Note(IntEnum):
    """Kinds of notes in the log; `NOTES` says what the value of each is."""

    READING = 0
    READING_FAILED = 1
    FRAMES_LOST = 2
    FRAMES_REFUSED = 3
    SEQUENCE_STANDS = 4
    DAMAGED = 5
    SHUTTER_CLOSED = 6
    SHUTTER_OPEN = 7
    CORRECTION = 8
    NO_FRAME = 9
    SOURCE_LOST = 10


NOTES: Final = MappingProxyType(
    {
        Note.READING: "the reading",
        Note.READING_FAILED: "NaN, the instrument gave none",
        Note.FRAMES_LOST: "number of frames missing by the driver's numbers",
        Note.FRAMES_REFUSED: "number of frames that came, but for which the queue was full",
        Note.SEQUENCE_STANDS: "step of the driver's number, 0 or less",
        Note.DAMAGED: "flags of the frame",
        Note.SHUTTER_CLOSED: "driver's number of the first frame with a closed shutter",
        Note.SHUTTER_OPEN: "driver's number of the first frame with an open one",
        Note.CORRECTION: "frame_counter at which the camera renewed its offsets, from telemetry",
        Note.NO_FRAME: "time without a frame [s]",
        Note.SOURCE_LOST: "NaN, the source gives no more frames",
    }
)
"""What the value of a note is, by its kind."""


@dataclass(frozen=True)
class Explained(Variable):
    """A variable with more attributes than unit and meaning."""

    more: Mapping[str, Any] = field(default_factory=dict)

    @property
    def attrs(self) -> dict[str, Any]:
        """Attributes to write on the variable."""
        return {**super().attrs, **self.more}


def _codes(meanings: Mapping[Any, str]) -> dict[str, Any]:
    """Attributes of numbers with meanings, by the CF conventions, and a sentence for each."""
    said = {str(code.name).lower(): text for code, text in meanings.items()}
    masks = all(isinstance(code, IntFlag) for code in meanings)
    return {
        "flag_masks" if masks else "flag_values": [int(code) for code in meanings],
        "flag_meanings": " ".join(said),
        "comment": "; ".join(f"{name}: {text}" for name, text in said.items()),
    }


ABOUT: Final = (
    "Raw frames as they came. Frame n of one band and frame n of another are not of one moment: "
    "each has its exposure_time, and the coordinate time is the first band's, without holes. "
    "exposure_time, host_time and log_time count from attribute clock_origin on the host's "
    "monotonic clock, which was attribute started in UTC; device_time is as the device gave it. "
    "exposure_time is NaN where a frame is no measurement; frame_flags say why. A band has the "
    "number of frames that frames_written says; what follows is its last one, repeated. "
    "Note n of the log is of log_sources[log_source], and its log_value is what log_kind says; a "
    "reading is in the unit that log_units says. totals: frames of each band, those lost by the "
    "driver's numbers, refused by a full queue, damaged. ended: why it ended; complete: as was "
    "planned; closed: false if it is being written or was cut short, and then only frames_written "
    "and log_written are valid."
)
"""What a reader of the store must know; its attribute ``comment``."""

_LAYOUT: Final = (
    "16-bit words of a Boson; likely, not certain, are the words (of a longer number the high one "
    "first; value = number / steps + zero): "
    + ", ".join(
        f"{name} {place.word} to {place.word + place.words - 1}"
        + (f" (steps {place.steps}, zero {place.zero:g})" if place.steps else "")
        for name, place in telemetry.FIELDS.items()
    )
)

VARIABLES: Final = MappingProxyType(
    {
        "counts": STAGES["capture"]["counts"],
        "exposure_time": EXPOSURE_TIME,
        "device_time": Variable(
            ("band", "time"), "float64", "s", "device's stamp of the frame, as it came"
        ),
        "host_time": Variable(
            ("band", "time"), "float64", "s", "when the host had the frame, since clock_origin"
        ),
        "sequence": Variable(("band", "time"), "int64", "1", "number of the frame by its driver"),
        "frame_flags": Explained(
            ("band", "time"), "uint16", "1", "flags of the frame, 0 is good", _codes(MEANINGS)
        ),
        "log_time": Variable(("log",), "float64", "s", "time of the note, since clock_origin"),
        "log_kind": Explained(("log",), "int16", "1", "what is noted", _codes(NOTES)),
        "log_source": Variable(
            ("log",), "int16", "1", "whose note it is: place in attribute log_sources"
        ),
        "log_value": Variable(
            ("log",), "float64", "1", "value of the note by its kind; see attribute log_units"
        ),
    }
)
"""What every recording holds; `ABOUT` says how it hangs together."""

TELEMETRY: Final = MappingProxyType(
    {
        "telemetry": Explained(
            ("band", "time", "telemetry_row", "x"),
            "uint16",
            "1",
            "telemetry rows as they came",
            {"comment": _LAYOUT},
        ),
        "fpa_temperature": Variable(
            ("band", "time"), "float32", "K", "temperature of the focal-plane array"
        ),
        "frame_counter": Variable(
            ("band", "time"), "int64", "1", "camera's own number of the frame, -1 if not known"
        ),
    }
)
"""What a recording holds besides, if the cameras give telemetry. Where `frame_counter` leaps and
`sequence` does not, frames were lost before the driver saw them; its usual step is not documented
for all rates, so that the recorder draws no conclusion."""
