"""The capture file frame by frame, telemetry rows, and the rule of the shutter."""

import errno
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dbthermal import store
from dbthermal.correction._shutter import FEWEST_COPIES
from dbthermal.instruments import telemetry
from dbthermal.instruments.camera import (
    DAMAGED,
    GOOD,
    FfcStatus,
    Frame,
    FrameFlag,
    Shutter,
    camera_kind,
    next_shutter,
)
from dbthermal.instruments.emulated.camera import EmulatedCamera
from dbthermal.instruments.emulated.world import World
from dbthermal.instruments.recording import notes
from dbthermal.instruments.recording._capture_file import CaptureFile, Note

__all__ = ["CaptureFile", "Note"]  # other tests take them from here

SHAPE, RATE, BANDS = (4, 80), 100.0, ("8-14", "9.5")
IMAGE = np.full(SHAPE, 5000, dtype=np.uint16)


def begun(path: Path, telemetry_rows: int = 0) -> CaptureFile:
    """A capture file of two bands in chunks of four frames."""
    world, sources = World(), {}
    for number, band in enumerate(BANDS):
        world.add_camera(band, number)
        form = (SHAPE, RATE, telemetry_rows)
        sources[band] = EmulatedCamera(world, band, {band: lambda _: IMAGE}, band, *form)
    return CaptureFile(path, sources, readings={"plate": "K"}, origin=0.0, attrs={}, chunk=4)


def shot(number: int, **changes: Any) -> Frame:
    """A good frame of this number."""
    time = number / RATE
    values = {"device_time": time, "host_time": time + 0.001, "sequence": number}
    image = (IMAGE + number).astype(np.uint16)
    if "telemetry" in changes and not changes.get("flags", GOOD) & DAMAGED:
        changes["metadata"] = telemetry.metadata(changes["telemetry"])
    return Frame(**{"counts": image, **values, **changes})


def rows(last_correction: int, number: int = 0) -> np.ndarray[Any, np.dtype[np.uint16]]:
    """Telemetry rows of a camera whose last correction was at a frame."""
    counts = {"last_ffc_frame": last_correction, "frame_counter": number}
    return telemetry.encode({**counts, "fpa_temperature": 308.2}, SHAPE[1])


@pytest.mark.parametrize("wrong", [500.0, -500.0])
def test_a_stamp_that_cannot_be_spoils_its_own_frame_alone(wrong: float, tmp_path: Path) -> None:
    """A stamp after the host's, or before the start, is invalid for its own frame alone."""
    file = begun(tmp_path / "a.zarr")
    for frame in (shot(0), shot(1, device_time=wrong), shot(2), shot(3)):
        file.frame(BANDS[0], frame)
    file.close(complete=True, ended="stopped")
    opened = store.open_dataset(tmp_path / "a.zarr").isel(band=0)
    np.testing.assert_array_equal(opened["frame_flags"], [0, FrameFlag.TIME_WRONG, 0, 0])
    np.testing.assert_allclose(opened["exposure_time"], [0, math.nan, 0.02, 0.03], atol=1e-12)


def test_a_clock_of_its_own_may_be_ahead(tmp_path: Path) -> None:
    """A camera's own clock has another origin: it is not compared with the host's."""
    file = begun(tmp_path / "a.zarr")
    for number in range(2):
        time = 500.0 + number
        file.frame(BANDS[0], shot(number, device_time=time, flags=FrameFlag.FOREIGN_CLOCK))
    file.close(complete=True, ended="stopped")
    opened = store.open_dataset(tmp_path / "a.zarr").isel(band=0)
    np.testing.assert_array_equal(opened["frame_flags"], 2 * [FrameFlag.FOREIGN_CLOCK])


@pytest.mark.parametrize("flag", DAMAGED)
def test_telemetry_of_a_damaged_frame_is_not_believed(flag: FrameFlag, tmp_path: Path) -> None:
    """Rows of zeros in a cut frame make no correction and no temperature; they are kept."""
    file = begun(tmp_path / "a.zarr", telemetry.ROWS)
    cut = shot(1, flags=flag, telemetry=np.zeros_like(rows(0)))
    for frame in (shot(0, telemetry=rows(7)), cut, shot(2, telemetry=rows(7))):
        file.frame(BANDS[0], frame)
    file.close(complete=True, ended="stopped")
    opened = store.open_dataset(tmp_path / "a.zarr").isel(band=0)
    np.testing.assert_allclose(opened["fpa_temperature"], [308.2, math.nan, 308.2], atol=1e-4)
    assert not opened["telemetry"][1].any()
    assert [note[1] for note in notes(tmp_path / "a.zarr")] == ["damaged"]


def test_a_correction_is_noted(tmp_path: Path) -> None:
    """Offsets that the camera renewed of its own accord are in the log, with its own number."""
    file = begun(tmp_path / "a.zarr", telemetry.ROWS)
    for number, counter in enumerate((7, 7, 90)):
        file.frame(BANDS[0], shot(number, telemetry=rows(counter)))
    file.close(complete=True, ended="stopped")
    found = [note[1:] for note in notes(tmp_path / "a.zarr")]
    assert found[-1] == ("correction", "8-14", 90)


def test_copies_of_the_last_frame_say_so(tmp_path: Path) -> None:
    """Padding after a band's last frame is flagged, and has the sequence number -1."""
    file = begun(tmp_path / "a.zarr")
    for number in range(6):
        file.frame(BANDS[0], shot(number))
    file.frame(BANDS[1], shot(0))
    file.close(complete=True, ended="stopped")
    second = store.open_dataset(tmp_path / "a.zarr").isel(band=1)
    np.testing.assert_array_equal(second["frame_flags"], [0, *(5 * [FrameFlag.PADDED])])
    np.testing.assert_array_equal(second["sequence"], [0, *(5 * [-1])])
    assert (second["counts"] == IMAGE).all()


def test_an_image_that_was_not_taken_anew_says_so(tmp_path: Path) -> None:
    """An unchanged image is flagged and keeps its time; one changed pixel clears the flag."""
    file = begun(tmp_path / "a.zarr")
    other = shot(0).counts.copy()
    other[-1, -1] += 1
    for number, counts in enumerate((IMAGE, IMAGE.copy(), IMAGE.copy(), other)):
        file.frame(BANDS[0], shot(number, counts=counts))
    file.close(complete=True, ended="stopped")
    opened = store.open_dataset(tmp_path / "a.zarr").isel(band=0)
    repeated = FrameFlag.IMAGE_REPEATED
    np.testing.assert_array_equal(opened["frame_flags"], [0, repeated, repeated, 0])
    np.testing.assert_allclose(opened["exposure_time"], np.arange(4) / RATE, rtol=0, atol=1e-12)


def test_the_cameras_own_number_is_kept(tmp_path: Path) -> None:
    """The camera's frame counter is stored beside the driver's sequence number."""
    file = begun(tmp_path / "a.zarr", telemetry.ROWS)
    cut = {"flags": FrameFlag.WRONG_SIZE}
    for number, (counter, changes) in enumerate(((40, {}), (42, {}), (0, cut))):
        file.frame(BANDS[0], shot(number, telemetry=rows(7, counter), **changes))
    file.frame(BANDS[1], shot(0, telemetry=rows(7, 3)))
    file.close(complete=True, ended="stopped")
    opened = store.open_dataset(tmp_path / "a.zarr")
    np.testing.assert_array_equal(opened["frame_counter"], [[40, 42, -1], [3, -1, -1]])
    np.testing.assert_array_equal(opened["sequence"][0], [0, 1, 2])


def test_flags_explain_themselves(tmp_path: Path) -> None:
    """The variable has the masks and meanings of the CF conventions."""
    begun(tmp_path / "a.zarr").close(complete=True, ended="stopped")
    attrs = store.open_dataset(tmp_path / "a.zarr")["frame_flags"].attrs
    names = [name.upper() for name in attrs["flag_meanings"].split()]
    found = {FrameFlag[name]: mask for name, mask in zip(names, attrs["flag_masks"], strict=True)}
    assert found == {flag: int(flag) for flag in FrameFlag}
    assert all(flag.meaning in attrs["comment"] for flag in FrameFlag)


def test_the_store_explains_itself(tmp_path: Path) -> None:
    """The store has every attribute that its comment names, and a sentence for each note."""
    begun(tmp_path / "a.zarr", telemetry.ROWS).close(complete=True, ended="stopped")
    opened = store.open_dataset(tmp_path / "a.zarr")
    named = {"clock_origin", "frames_written", "log_sources", "log_units", "totals", "ended"}
    for name in named | {"complete", "closed", "log_written"}:
        assert name in opened.attrs["comment"]
        assert name in opened.attrs
    kinds = opened["log_kind"].attrs
    assert kinds["flag_meanings"].split() == list(opened.attrs["log_kinds"])
    assert kinds["flag_values"] == list(opened.attrs["log_kinds"].values())
    assert all(kind.meaning in kinds["comment"] for kind in Note)
    assert "frame_counter 42 to 43, " in opened["telemetry"].attrs["comment"]


def test_notes_do_not_wait_for_frames(tmp_path: Path) -> None:
    """Readings are stored within a second even while no frame comes."""
    file = begun(tmp_path / "a.zarr")
    for number in range(5):
        file.note(Note.READING, "plate", 0.3 * number, 300.0)
    assert store.open_dataset(tmp_path / "a.zarr").sizes["log"] == 5


def test_full_disk_leaves_what_was_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A chunk for which there is no space is not in the store; those before are, and it opens."""
    file = begun(tmp_path / "a.zarr")
    for number in range(7):
        for band in BANDS:
            file.frame(band, shot(number))

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "open", full)
    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space left on device"):
        file.frame(BANDS[0], shot(7))
    monkeypatch.undo()
    assert file.broken
    opened = store.open_dataset(tmp_path / "a.zarr")
    assert (opened.sizes["time"], opened.attrs["closed"]) == (4, False)
    expected = IMAGE + np.arange(4)[:, None, None]
    np.testing.assert_array_equal(opened["counts"], np.stack([expected] * 2))
    assert [path.name for path in tmp_path.iterdir()] == ["a.zarr"]


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


def test_short_rows_are_refused() -> None:
    """Too few words are an error that says how many it takes."""
    with pytest.raises(ValueError, match=r"Invalid telemetry of 10 words\. Must hold 142"):
        telemetry.decode(np.zeros(10, dtype=np.uint16))


def test_other_numbers_are_refused() -> None:
    """Rows of another type than uint16 raise a TypeError."""
    with pytest.raises(TypeError, match=r"Invalid telemetry of float32\. Must be uint16"):
        telemetry.decode(np.zeros((2, COLUMNS), dtype=np.float32))


def test_values_that_do_not_fit_are_refused() -> None:
    """A field is not written modulo its size."""
    with pytest.raises(ValueError, match="Invalid frame_counter of 4294967296 steps"):
        telemetry.encode({"frame_counter": 2**32}, COLUMNS)


IMMINENT, BUSY, DONE = FfcStatus.IMMINENT, FfcStatus.IN_PROGRESS, FfcStatus.COMPLETE


def closed(
    copies: str,
    last: Sequence[int | None] | None = None,
    status: Sequence[FfcStatus | None] | None = None,
) -> str:
    """Frames that count as closed, x, of frames that repeat the image before, also x."""
    state, found = Shutter(), ""
    nothing = [None] * len(copies)
    for mark, frame, read in zip(copies, last or nothing, status or nothing, strict=True):
        state = next_shutter(state, repeated=mark == "x", last_ffc_frame=frame, ffc_status=read)
        found += "x" if state.closed else "."
    return found


def test_a_renewal_at_the_start_of_a_correction_closes_all_copies() -> None:
    """The camera counts the correction from its first frozen frame."""
    assert closed("...xxxx..", [0, 0, 0, 3, 3, 3, 3, 3, 3]) == "...xxxx.."


def test_a_renewal_at_the_end_of_a_correction_marks_the_frame_after_it() -> None:
    """The run of copies touches the marked frame, so that `find_shutter` joins them."""
    assert closed("...xxxx..", [0, 0, 0, 0, 0, 0, 0, 7, 7]) == ".......x."


def test_a_renewal_whose_frozen_frames_were_lost_is_marked() -> None:
    """A correction marks one frame without a repeated image; damaged telemetry is not used."""
    assert closed(".....", [0, 0, 3, 3, 3]) == "..x.."
    assert closed(".....", [0, 0, None, 3, 3]) == "...x."


def test_repeated_images_of_a_camera_with_telemetry_are_no_shutter() -> None:
    """With telemetry, repeated images without a correction are not marked as a shutter."""
    assert closed("..x.xxxxx.", [5] * 10) == ".........."


@pytest.mark.parametrize("status", [IMMINENT, BUSY])
def test_the_serial_line_closes_a_frozen_image(status: FfcStatus) -> None:
    """From the first copy after the reading to the last copy, however old the reading is."""
    read = [DONE, DONE, DONE, status, status, DONE, DONE, DONE]
    assert closed("..xxxx..", status=read) == "...xxx.."
    assert closed("........", status=[status] * 8) == "........"


def test_without_telemetry_a_run_of_copies_is_the_shutter() -> None:
    """Without telemetry three copies or more mark a closed shutter, fewer are lost frames."""
    expected = "....xx."
    assert closed("..xxxx.") == expected
    assert closed("..xxxx.", status=[DONE] * 7) == expected
    assert closed("..xx.x.") == "......."
    assert FEWEST_COPIES == 3


@given(
    st.lists(
        st.tuples(
            st.booleans(),
            st.none() | st.integers(0, 3),
            st.none() | st.sampled_from(FfcStatus),
        )
    )
)
def test_a_changing_image_is_closed_by_a_renewal_alone(
    frames: list[tuple[bool, int | None, FfcStatus | None]],
) -> None:
    """A frame with a new image is marked only if the number of the last correction changed."""
    state = Shutter()
    for repeated, last, status in frames:
        after = next_shutter(state, repeated=repeated, last_ffc_frame=last, ffc_status=status)
        renewed = None not in {last, state.last_ffc_frame} and last != state.last_ffc_frame
        assert after.closed is renewed or repeated
        assert after.copies == (state.copies + 1 if repeated else 0)
        state = after


def test_an_unknown_kind_is_named() -> None:
    """An unknown kind of camera raises an error that lists the known ones."""
    with pytest.raises(ValueError, match=r"Unknown kind of camera 'lepton'\. Must be one of \["):
        camera_kind("lepton")
