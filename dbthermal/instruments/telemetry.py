"""Telemetry rows of a Boson: what the camera writes beside the image, and what it means.

With telemetry on, the 640 x 512 image comes with two more rows on USB. The layout is **likely, not
certain**: it is where public decoders that do not depend on one another agree (Elphel's
``Boson640Telemetry.java``, the Python class ``BosonWithTelemetry``, belivan/flir_stereo
``flir_ros_sync.cpp``), and none of them is the vendor's. So are the orders: each 16-bit word is
little-endian, and of a longer number the high word comes first; the latter is a setting here. That
is why a recording keeps the rows as they came. The meaning of the status bits was found nowhere:
whether the shutter is closed is to be asked over the serial line.

Tested against computed vectors and emulators, not against a camera.
"""

from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.constants import zero_Celsius

from dbthermal.instruments.camera import Metadata

Words = npt.NDArray[np.uint16]

ROWS: Final = 2
"""Rows of telemetry on USB: 514 rows of the frame are requested instead of 512."""

WORDS: Final = 142
"""Least number of words that hold all the fields."""

_WORD_BITS: Final = 16


@dataclass(frozen=True)
class Telemetry:
    """
    The fields of a telemetry row that this project reads; all likely, see the module.

    Attributes
    ----------
    revision : int
        Of the layout.
    camera_serial, sensor_serial : int
        Serial numbers.
    part_number : str
        Of the camera; bytes that are no ASCII are written as escapes.
    software_revision : tuple of int
        Major, minor, patch.
    frame_rate : int
        Rate [Hz].
    status : int
        64 bits of unknown meaning.
    frame_counter : int
        Frames since the sensor's start.
    last_ffc_frame : int
        `frame_counter` at the last flat-field correction.
    fpa_temperature, last_ffc_temperature : float
        Of the focal-plane array, now and at the last flat-field correction, in steps of 0.1 [K].
    pipeline : int
        Bits of what is switched on.
    ffc_frames : int
        Frames that a flat-field correction averages.
    nuc_table, desired_nuc_table : int
        Non-uniformity table in use, and the one that the camera would rather use.
    core_temperature : float
        Of the processor, in steps of 0.001 [K].
    uptime : float
        Since the sensor's start, in steps of 0.001 [s].
    """

    revision: int = 0
    camera_serial: int = 0
    sensor_serial: int = 0
    part_number: str = ""
    software_revision: tuple[int, int, int] = (0, 0, 0)
    frame_rate: int = 60
    status: int = 0
    frame_counter: int = 0
    last_ffc_frame: int = 0
    fpa_temperature: float = 0.0
    last_ffc_temperature: float = 0.0
    pipeline: int = 0
    ffc_frames: int = 0
    nuc_table: int = 0
    desired_nuc_table: int = 0
    core_temperature: float = zero_Celsius
    uptime: float = 0.0


@dataclass(frozen=True)
class Field:
    """
    Where a number is in the row.

    Attributes
    ----------
    word : int
        First 16-bit word.
    words : int
        Number of words.
    signed : bool
        Two's complement.
    steps : int
        Steps per unit; 0 for a plain whole number.
    zero : float
        Value of the number 0.
    """

    word: int
    words: int = 1
    signed: bool = False
    steps: int = 0
    zero: float = 0.0


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
"""The numbers; beside them the part number in words 5 to 14, the software's in 22 to 27."""

_PART_NUMBER: Final = slice(5, 15)
_SOFTWARE: Final = tuple(Field(word, 2) for word in (22, 24, 26))


def decode(rows: Words, *, high_word_first: bool = True) -> Telemetry:
    """
    Read the fields from telemetry rows.

    Parameters
    ----------
    rows : ndarray of uint16, shape (row, x) or (word,)
        The rows as they came, words in the host's order.
    high_word_first : bool
        Whether the high word of a longer number comes first: likely, not certain.

    Returns
    -------
    Telemetry
        The fields. Any content is read as if it were telemetry: there is no checksum.

    Raises
    ------
    TypeError, ValueError
        If the rows are not of uint16, or hold fewer than `WORDS` words.
    """
    words = _checked(rows)
    values: dict[str, Any] = {
        name: _scaled(_read(words, field, high_first=high_word_first), field)
        for name, field in FIELDS.items()
    }
    part_number = words[_PART_NUMBER].astype("<u2").tobytes().rstrip(b"\0")
    revision = (_read(words, field, high_first=high_word_first) for field in _SOFTWARE)
    return Telemetry(
        part_number=part_number.decode("ascii", "backslashreplace"),
        software_revision=tuple(revision),  # type: ignore[arg-type]
        **values,
    )


def metadata(rows: Words) -> Metadata:
    """Metadata of a frame, from its telemetry rows; see `decode`."""
    fields = decode(rows)
    return Metadata(fields.frame_counter, fields.last_ffc_frame, fields.fpa_temperature)


def encode(
    telemetry: Telemetry, columns: int, rows: int = ROWS, *, high_word_first: bool = True
) -> Words:
    """
    Write the fields as telemetry rows, as the emulated camera does.

    Parameters
    ----------
    telemetry : Telemetry
        The fields.
    columns : int
        Width of the image [pixel].
    rows : int
        Rows of telemetry.
    high_word_first : bool
        See `decode`.

    Returns
    -------
    ndarray of uint16, shape (rows, columns)
        The rows; 0 where no field is.

    Raises
    ------
    ValueError
        If they do not hold `WORDS` words, or a value does not fit its field.
    """
    words = np.zeros(rows * columns, dtype=np.uint16)
    _checked(words)
    for name, field in FIELDS.items():
        value = _unscaled(getattr(telemetry, name), field)
        _write(words, field, value, name, high_first=high_word_first)
    for field, value in zip(_SOFTWARE, telemetry.software_revision, strict=True):
        _write(words, field, value, "software_revision", high_first=high_word_first)
    words[_PART_NUMBER] = np.frombuffer(_text(telemetry.part_number), dtype="<u2")
    return words.reshape(rows, columns)


def names() -> tuple[str, ...]:
    """
    Names of all fields.

    Returns
    -------
    tuple of str
        As the attributes of `Telemetry`.
    """
    return tuple(field.name for field in fields(Telemetry))


def _checked(rows: Words) -> Words:
    if rows.dtype != np.uint16:
        raise TypeError(f"Invalid telemetry of {rows.dtype}. Must be uint16.")
    if rows.size < WORDS:
        raise ValueError(f"Invalid telemetry of {rows.size} words. Must hold {WORDS} or more.")
    return rows.ravel()


def _read(words: Words, field: Field, *, high_first: bool) -> int:
    part = [int(word) for word in words[field.word : field.word + field.words]]
    number = 0
    for word in part if high_first else reversed(part):
        number = number << _WORD_BITS | word
    bits = _WORD_BITS * field.words
    return number - (1 << bits) if field.signed and number >> (bits - 1) else number


def _write(words: Words, field: Field, value: int, name: str, *, high_first: bool) -> None:
    bits = _WORD_BITS * field.words
    low = -(1 << (bits - 1)) if field.signed else 0
    if not low <= value < low + (1 << bits):
        raise ValueError(
            f"Invalid {name} of {value} steps. Must lie in {low} to {low + (1 << bits) - 1}."
        )
    parts = [value >> _WORD_BITS * place & 0xFFFF for place in range(field.words)]
    words[field.word : field.word + field.words] = parts[::-1] if high_first else parts


def _scaled(number: int, field: Field) -> float:
    return number / field.steps + field.zero if field.steps else number


def _unscaled(value: float, field: Field) -> int:
    return round((value - field.zero) * field.steps) if field.steps else int(value)


def _text(part_number: str) -> bytes:
    length = 2 * (_PART_NUMBER.stop - _PART_NUMBER.start)
    text = part_number.encode("ascii")
    if len(text) > length:
        raise ValueError(f"Invalid part number '{part_number}'. Must have {length} characters.")
    return text.ljust(length, b"\0")
