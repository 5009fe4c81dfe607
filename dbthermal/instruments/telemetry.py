"""Telemetry rows of a Boson: values that the camera writes beside the image.

With telemetry on, the 640 x 512 image comes with two more rows on USB. The layout, and the order of
words, is **likely, not certain**: public decoders that do not depend on one another agree on it
(Elphel's ``Boson640Telemetry.java``, the Python class ``BosonWithTelemetry``, belivan/flir_stereo
``flir_ros_sync.cpp``), and none of them is the vendor's. Each 16-bit word is little-endian, and of
a longer number the high word comes first. The meaning of the status bits is not public.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np
from scipy.constants import zero_Celsius

from dbthermal.instruments.camera import Counts, Metadata

__all__ = ["FIELDS", "ROWS", "WORDS", "Field", "decode", "encode", "metadata"]
__dir__ = __all__.copy

ROWS: Final = 2  # of telemetry on USB: 514 rows of the frame are requested instead of 512
WORDS: Final = 142  # least number of words that hold all the fields


class Field(NamedTuple):
    """Position and scale of a number in the row: value = number / steps + zero."""

    word: int  # first 16-bit word
    dtype: str = ">u2"  # once the bytes of each word are swapped
    steps: int = 0  # per unit; 0 for a plain whole number
    zero: float = 0.0  # value of the number 0


FIELDS: Final = MappingProxyType(
    {
        "revision": Field(0),
        "camera_serial": Field(1, ">u4"),
        "sensor_serial": Field(3, ">u4"),
        "frame_rate": Field(28),
        "status": Field(38, ">u8"),
        "frame_counter": Field(42, ">u4"),
        "last_ffc_frame": Field(44, ">u4"),
        "fpa_temperature": Field(47, steps=10),
        "last_ffc_temperature": Field(48, steps=10),
        "pipeline": Field(55, ">u4"),
        "ffc_frames": Field(57),
        "nuc_table": Field(79),
        "desired_nuc_table": Field(80),
        "core_temperature": Field(81, ">i4", steps=1000, zero=zero_Celsius),
        "uptime": Field(140, ">u4", steps=1000),
    }
)
"""Rates in Hz, temperatures in kelvin, times in seconds; counters count frames."""

_ROW = np.dtype(
    {
        "names": [*FIELDS],
        "formats": [field.dtype for field in FIELDS.values()],
        "offsets": [2 * field.word for field in FIELDS.values()],
        "itemsize": 2 * WORDS,
    }
)


def decode(rows: Counts) -> dict[str, float]:
    """Read each of `FIELDS` from telemetry, uint16 (row, x) or (word,); TypeError, ValueError."""
    # There is no checksum: any content is read as if it were telemetry.
    (numbers,) = _checked(rows)[:WORDS].astype(">u2").view(_ROW).tolist()
    return {
        name: number / field.steps + field.zero if field.steps else number
        for (name, field), number in zip(FIELDS.items(), numbers, strict=True)
    }


def metadata(rows: Counts) -> Metadata:
    """Metadata of a frame, from its telemetry rows."""
    values = decode(rows)
    counter, last = int(values["frame_counter"]), int(values["last_ffc_frame"])
    return Metadata(counter, last, values["fpa_temperature"])


def encode(values: Mapping[str, float], columns: int, rows: int = ROWS) -> Counts:
    """Write fields as telemetry (rows, columns), 0 elsewhere; ValueError if they do not fit."""
    words, row = _checked(np.zeros(rows * columns, dtype=np.uint16)), np.zeros(1, _ROW)
    for name, value in values.items():
        field = FIELDS[name]
        number = round((value - field.zero) * field.steps) if field.steps else int(value)
        try:
            row[name] = number
        except OverflowError as error:
            raise ValueError(f"Invalid {name} of {number} steps. Must fit: {error}.") from error
    words[:WORDS] = row.view(">u2")
    return words.reshape(rows, columns)


def _checked(rows: Counts) -> Counts:
    if rows.dtype != np.uint16:
        raise TypeError(f"Invalid telemetry of {rows.dtype}. Must be uint16.")
    if rows.size < WORDS:
        raise ValueError(f"Invalid telemetry of {rows.size} words. Must hold {WORDS} or more.")
    return rows.ravel()
