"""Telemetry rows: public vectors, round trip, and refused inputs."""

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dbthermal.instruments import telemetry

COLUMNS = 640


def numbers(field: telemetry.Field) -> st.SearchStrategy[float]:
    """Values that a field can hold."""
    lowest = -(1 << 16 * field.words - 1) if field.signed else 0
    every = st.integers(lowest, lowest + (1 << 16 * field.words) - 1)
    return every.map(lambda number: number / field.steps + field.zero) if field.steps else every


@pytest.mark.parametrize(
    ("values", "offset", "expected"),
    [
        ({"frame_counter": 1234567}, 84, "12 00 87 D6"),
        ({"fpa_temperature": 311.2}, 94, "28 0C"),
        ({"uptime": 20576.117}, 280, "39 01 75 F7"),
    ],
)
def test_vectors(values: dict[str, float], offset: int, expected: str) -> None:
    """The bytes in the buffer are those of the public decoders, both ways."""
    wanted = bytes.fromhex(expected)
    rows = telemetry.encode(values, COLUMNS)
    found = rows.astype("<u2").tobytes()[offset : offset + len(wanted)]
    assert found == wanted
    buffer = bytearray(2 * telemetry.WORDS)
    buffer[offset : offset + len(wanted)] = wanted
    decoded = telemetry.decode(np.frombuffer(bytes(buffer), dtype="<u2"))
    for name, value in values.items():
        assert decoded[name] == pytest.approx(value, abs=1e-9)


@given(st.fixed_dictionaries({name: numbers(field) for name, field in telemetry.FIELDS.items()}))
def test_fields_come_back(fields: dict[str, float]) -> None:
    """Encoded fields are decoded unchanged, and give the metadata of a frame."""
    rows = telemetry.encode(fields, COLUMNS)
    assert telemetry.decode(rows) == pytest.approx(fields, rel=0, abs=1e-6)
    found = telemetry.metadata(rows)
    assert found.frame_counter == fields["frame_counter"]
    assert found.last_ffc_frame == fields["last_ffc_frame"]
    assert found.fpa_temperature == pytest.approx(fields["fpa_temperature"], abs=1e-6)


@given(rows=arrays(np.uint16, (2, 80)))
def test_anything_is_read(rows: npt.NDArray[np.uint16]) -> None:
    """Any words give a record, as the rows have no checksum."""
    assert 0 <= telemetry.decode(rows)["frame_counter"] < 2**32


def test_other_rows_are_refused() -> None:
    """Too few words are an error that says how many it takes, other types than uint16 are, too."""
    with pytest.raises(ValueError, match=r"Invalid telemetry of 10 words\. Must hold 142"):
        telemetry.decode(np.zeros(10, dtype=np.uint16))
    with pytest.raises(TypeError, match=r"Invalid telemetry of float32\. Must be uint16"):
        telemetry.decode(np.zeros((2, COLUMNS), dtype=np.float32))
    with pytest.raises(ValueError, match="Invalid frame_counter of 4294967296 steps"):
        telemetry.encode({"frame_counter": 2**32}, COLUMNS)
