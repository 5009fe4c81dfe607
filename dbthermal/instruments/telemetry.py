"""Telemetry rows of a Boson: values that the camera writes beside the image.

With telemetry on, the 640 x 512 image comes with two more rows on USB. The layout is **likely, not
certain**: public decoders that do not depend on one another agree on it (Elphel's
``Boson640Telemetry.java``, the Python class ``BosonWithTelemetry``, belivan/flir_stereo
``flir_ros_sync.cpp``), and none of them is the vendor's. The same holds for the orders: each 16-bit
word is little-endian, and of a longer number the high word comes first. Therefore a recording keeps
the rows as they came. The meaning of the status bits is not public: the shutter follows from
`last_ffc_frame` and the serial line, see `camera.next_shutter`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import numpy as np
from scipy.constants import zero_Celsius

from dbthermal.instruments.camera import Counts, Metadata

__all__ = ["FIELDS", "ROWS", "WORDS", "Field", "decode", "encode", "metadata"]
__dir__ = __all__.copy

ROWS: Final = 2  # of telemetry on USB: 514 rows of the frame are requested instead of 512
WORDS: Final = 142  # least number of words that hold all the fields


@dataclass(frozen=True)
class Field:
    """Position and scale of a number in the row: value = number / steps + zero."""

    word: int  # first 16-bit word
    words: int = 1
    signed: bool = False  # two's complement
    steps: int = 0  # per unit; 0 for a plain whole number
    zero: float = 0.0  # value of the number 0

    @property
    def span(self) -> slice:
        """Words of the number."""
        return slice(self.word, self.word + self.words)


FIELDS: Final = MappingProxyType(
    {
        "revision": Field(0),
        "camera_serial": Field(1, 2),
        "sensor_serial": Field(3, 2),
        "frame_rate": Field(28),
        "status": Field(38, 4),
        "frame_counter": Field(42, 2),
        "last_ffc_frame": Field(44, 2),
        "fpa_temperature": Field(47, steps=10),
        "last_ffc_temperature": Field(48, steps=10),
        "pipeline": Field(55, 2),
        "ffc_frames": Field(57),
        "nuc_table": Field(79),
        "desired_nuc_table": Field(80),
        "core_temperature": Field(81, 2, signed=True, steps=1000, zero=zero_Celsius),
        "uptime": Field(140, 2, steps=1000),
    }
)
"""Rates in Hz, temperatures in kelvin, times in seconds; counters count frames."""


def decode(rows: Counts) -> dict[str, float]:
    """Read the value of each of `FIELDS` from telemetry rows, uint16 (row, x) or (word,).

    Any content is read as if it were telemetry: there is no checksum. TypeError or ValueError if
    the rows are not of uint16, or hold fewer than `WORDS` words.
    """
    words, values = _checked(rows), dict[str, float]()
    for name, field in FIELDS.items():
        data = words[field.span].astype(">u2").tobytes()
        number = int.from_bytes(data, "big", signed=field.signed)
        values[name] = number / field.steps + field.zero if field.steps else number
    return values


def metadata(rows: Counts) -> Metadata:
    """Metadata of a frame, from its telemetry rows."""
    values = decode(rows)
    counter, last = int(values["frame_counter"]), int(values["last_ffc_frame"])
    return Metadata(counter, last, values["fpa_temperature"])


def encode(values: Mapping[str, float], columns: int, rows: int = ROWS) -> Counts:
    """Write fields as telemetry (rows, columns), 0 elsewhere, as an emulated camera does.

    ValueError if these are too few, or a value does not fit its field.
    """
    words = _checked(np.zeros(rows * columns, dtype=np.uint16))
    for name, value in values.items():
        field = FIELDS[name]
        number = round((value - field.zero) * field.steps) if field.steps else int(value)
        try:
            data = number.to_bytes(2 * field.words, "big", signed=field.signed)
        except OverflowError as error:
            rule = f"Must fit {field.words} words: {error}"
            raise ValueError(f"Invalid {name} of {number} steps. {rule}.") from error
        words[field.span] = np.frombuffer(data, ">u2")
    return words.reshape(rows, columns)


def _checked(rows: Counts) -> Counts:
    if rows.dtype != np.uint16:
        raise TypeError(f"Invalid telemetry of {rows.dtype}. Must be uint16.")
    if rows.size < WORDS:
        raise ValueError(f"Invalid telemetry of {rows.size} words. Must hold {WORDS} or more.")
    return rows.ravel()
