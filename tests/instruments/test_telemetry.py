"""Telemetry rows: the public vectors, the round trip, and what no telemetry does."""

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dbthermal.instruments import telemetry
from dbthermal.instruments.telemetry import Telemetry

COLUMNS = 640
U16, U32 = st.integers(0, 2**16 - 1), st.integers(0, 2**32 - 1)
TENTHS = U16.map(lambda steps: steps / 10)
TELEMETRY = st.builds(
    Telemetry,
    revision=U16,
    camera_serial=U32,
    sensor_serial=U32,
    part_number=st.text(st.characters(min_codepoint=33, max_codepoint=126), max_size=20),
    software_revision=st.tuples(U32, U32, U32),
    frame_rate=U16,
    status=st.integers(0, 2**64 - 1),
    frame_counter=U32,
    last_ffc_frame=U32,
    fpa_temperature=TENTHS,
    last_ffc_temperature=TENTHS,
    pipeline=U32,
    ffc_frames=U16,
    nuc_table=U16,
    desired_nuc_table=U16,
    core_temperature=st.integers(-(2**31), 2**31 - 1).map(lambda steps: steps / 1000 + 273.15),
    uptime=U32.map(lambda steps: steps / 1000),
)


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
    rows = telemetry.encode(Telemetry(**values), COLUMNS)  # type: ignore[arg-type]
    found = rows.astype("<u2").tobytes()[offset : offset + len(wanted)]
    assert found == wanted
    buffer = bytearray(2 * telemetry.WORDS)
    buffer[offset : offset + len(wanted)] = wanted
    decoded = telemetry.decode(np.frombuffer(bytes(buffer), dtype="<u2"))
    for name, value in values.items():
        assert getattr(decoded, name) == pytest.approx(value, abs=1e-9)


@given(fields=TELEMETRY, high=st.booleans())
def test_fields_come_back(fields: Telemetry, *, high: bool) -> None:
    """What the emulator writes is what is read, in either order of the words."""
    rows = telemetry.encode(fields, COLUMNS, high_word_first=high)
    found = telemetry.decode(rows, high_word_first=high)
    for name in telemetry.names():
        expected = getattr(fields, name)
        if isinstance(expected, float):
            expected = pytest.approx(expected, abs=1e-6)
        assert getattr(found, name) == expected


@given(rows=arrays(np.uint16, (2, 80)))
def test_anything_is_read(rows: npt.NDArray[np.uint16]) -> None:
    """Any words give a record: there is no checksum that could tell."""
    assert 0 <= telemetry.decode(rows).frame_counter < 2**32


def test_text_that_is_none_is_shown() -> None:
    """Bytes of a part number that are no ASCII are seen as they are."""
    rows = np.full((2, COLUMNS), 0x8EFF, dtype=np.uint16)
    assert telemetry.decode(rows).part_number.startswith(r"\xff\x8e")


def test_short_rows_are_refused() -> None:
    """Too few words are an error that says how many it takes."""
    with pytest.raises(ValueError, match=r"Invalid telemetry of 10 words\. Must hold 142"):
        telemetry.decode(np.zeros(10, dtype=np.uint16))


def test_other_numbers_are_refused() -> None:
    """Rows that were converted are no telemetry."""
    with pytest.raises(TypeError, match=r"Invalid telemetry of float32\. Must be uint16"):
        telemetry.decode(np.zeros((2, COLUMNS), dtype=np.float32))


def test_values_that_do_not_fit_are_refused() -> None:
    """A field is not written modulo its size."""
    with pytest.raises(ValueError, match="Invalid frame_counter of 4294967296 steps"):
        telemetry.encode(Telemetry(frame_counter=2**32), COLUMNS)
    with pytest.raises(ValueError, match=r"Invalid part number 'A{21}'\. Must have 20"):
        telemetry.encode(Telemetry(part_number=21 * "A"), COLUMNS)
