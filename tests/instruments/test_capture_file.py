"""The capture file frame by frame, telemetry rows, and the rule of the shutter."""

import errno
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import xarray as xr
from faulty_camera import BANDS, two_cameras
from hypothesis import given
from hypothesis import strategies as st
from refused import assert_raises, refused

from dbthermal import store
from dbthermal.instruments import camera, telemetry
from dbthermal.instruments.camera import DAMAGED, GOOD, FfcStatus, Frame, FrameFlag, next_shutter
from dbthermal.instruments.recording import notes
from dbthermal.instruments.recording._capture_file import CaptureFile, Note

__all__ = ["CaptureFile", "Note", "begun", "shot"]  # other tests take them from here

SHAPE, RATE = (4, 80), 100.0
IMAGE = np.full(SHAPE, 5000, dtype=np.uint16)
COLUMNS = 640


def begun(path: Path, telemetry_rows: int = 0, chunk: int = 4) -> CaptureFile:
    """A capture file of two bands in chunks of a few frames."""
    sources = dict(two_cameras(lambda _: IMAGE, SHAPE, RATE, telemetry_rows))
    return CaptureFile(path, sources, {"plate": "K"}, {}, chunk)


def shot(number: int, **changes: Any) -> Frame:
    """A good frame of this number, whose counts rise by one from frame to frame."""
    time = number / RATE
    values = {"device_time": time, "host_time": time + 0.001, "sequence": number}
    image = (IMAGE + number).astype(np.uint16)
    if "telemetry" in changes and not changes.get("flags", GOOD) & DAMAGED:
        changes["metadata"] = telemetry.metadata(changes["telemetry"])
    return Frame(**{"counts": image, **values, **changes})


def rows(last_correction: int, number: int = 0) -> npt.NDArray[np.uint16]:
    """Telemetry rows of a camera whose last correction was at a frame."""
    counts = {"last_ffc_frame": last_correction, "frame_counter": number}
    return telemetry.encode({**counts, "fpa_temperature": 308.2}, SHAPE[1])


def stored(path: Path, *frames: Iterable[Frame], telemetry_rows: int = 0) -> xr.Dataset:
    """Write the frames of each band to a file, and open it."""
    file = begun(path, telemetry_rows)
    for band, shots in zip(BANDS, frames, strict=False):
        for frame in shots:
            file.frame(band, frame)
    file.close(complete=True, ended="stopped")
    return store.open_dataset(path)


STANDS = FrameFlag.SEQUENCE_STANDS | FrameFlag.TIME_STANDS | FrameFlag.IMAGE_REPEATED
OTHER = IMAGE.copy()
OTHER[-1, -1] += 1
RESTARTED = [shot(n, device_time=t, host_time=t + 0.01) for n, t in enumerate((0.04, 0.05))]
FRAMES: dict[str, tuple[list[Frame], list[int], list[float]]] = {
    # A repeated number or time is flagged, and a restart of the numbers is no loss.
    "numbers that stand": (
        [shot(0), shot(1), shot(1), shot(2, device_time=0.005), shot(3), *RESTARTED],
        [0, 0, STANDS, FrameFlag.TIME_STANDS, 0, FrameFlag.SEQUENCE_STANDS, 0],
        [0, 0.01, math.nan, math.nan, 0.03, math.nan, 0.05],
    ),
    # A stamp after the host's, or before the start, is invalid for its own frame alone.
    "stamps of the future and the past": (
        [shot(0), shot(1, device_time=500.0), shot(2), shot(3, device_time=-500.0), shot(4)],
        [0, FrameFlag.TIME_WRONG, 0, FrameFlag.TIME_WRONG, 0],
        [0, math.nan, 0.02, math.nan, 0.04],
    ),
    # An unchanged image is flagged and keeps its time; one changed pixel clears the flag.
    "a repeated image": (
        [shot(n, counts=image) for n, image in enumerate([IMAGE, IMAGE, IMAGE, OTHER])],
        [0, FrameFlag.IMAGE_REPEATED, FrameFlag.IMAGE_REPEATED, 0],
        [0, 0.01, 0.02, 0.03],
    ),
}


@pytest.mark.parametrize("name", FRAMES)
def test_flags_and_times(name: str, tmp_path: Path) -> None:
    """Each frame has the flags and the time that its stamps, number and image allow."""
    frames, flags, times = FRAMES[name]
    opened = stored(tmp_path / "a.zarr", frames).isel(band=0)
    np.testing.assert_array_equal(opened["frame_flags"], flags)
    np.testing.assert_allclose(opened["exposure_time"], times, rtol=0, atol=1e-12)
    steps = [note[3] for note in notes(tmp_path / "a.zarr") if note[1] != "damaged"]
    assert steps == ([0, -3] if name == "numbers that stand" else [])


@pytest.mark.parametrize("flag", DAMAGED)
def test_telemetry_of_a_damaged_frame_is_not_believed(flag: FrameFlag, tmp_path: Path) -> None:
    """Rows of zeros in a cut frame make no correction and no temperature; they are kept."""
    cut = shot(1, flags=flag, telemetry=np.zeros_like(rows(0)))
    frames = [shot(0, telemetry=rows(7)), cut, shot(2, telemetry=rows(7))]
    opened = stored(tmp_path / "a.zarr", frames, telemetry_rows=telemetry.ROWS).isel(band=0)
    np.testing.assert_allclose(opened["fpa_temperature"], [308.2, math.nan, 308.2], atol=1e-4)
    assert not opened["telemetry"][1].any()
    assert [note[1] for note in notes(tmp_path / "a.zarr")] == ["damaged"]


def test_a_correction_and_the_cameras_own_number_are_kept(tmp_path: Path) -> None:
    """Renewed offsets are in the log, and the camera's counter is beside the driver's number."""
    frames = [shot(0, telemetry=rows(7, 40)), shot(1, telemetry=rows(90, 42))]
    frames += [shot(2, telemetry=rows(7, 0), flags=FrameFlag.WRONG_SIZE)]
    second_band = [shot(0, telemetry=rows(7, 3))]
    opened = stored(tmp_path / "a.zarr", frames, second_band, telemetry_rows=telemetry.ROWS)
    np.testing.assert_array_equal(opened["frame_counter"], [[40, 42, -1], [3, -1, -1]])
    np.testing.assert_array_equal(opened["sequence"][0], [0, 1, 2])
    assert ("correction", "8-14", 90) in [note[1:] for note in notes(tmp_path / "a.zarr")]


def test_a_frame_of_another_shape_is_refused_at_once(tmp_path: Path) -> None:
    """The frames before it are kept."""
    capture = begun(tmp_path / "raw.zarr")
    capture.frame(BANDS[0], shot(0))
    with pytest.raises(ValueError, match=r"Invalid frame of \(3, 80\) in .*Must be \(4, 80\)"):
        capture.frame(BANDS[0], shot(1, counts=IMAGE[:3]))
    assert capture.totals[BANDS[0]]["frames"] == 1


def test_copies_of_the_last_frame_say_so(tmp_path: Path) -> None:
    """Padding after a band's last frame is flagged, and has the sequence number -1."""
    second = stored(tmp_path / "a.zarr", map(shot, range(6)), [shot(0)]).isel(band=1)
    np.testing.assert_array_equal(second["frame_flags"], [0, *(5 * [FrameFlag.PADDED])])
    np.testing.assert_array_equal(second["sequence"], [0, *(5 * [-1])])
    assert (second["counts"] == IMAGE).all()


def test_the_store_explains_itself(tmp_path: Path) -> None:
    """Flags and notes have CF masks and meanings."""
    opened = stored(tmp_path / "a.zarr", telemetry_rows=telemetry.ROWS)
    attrs = opened["frame_flags"].attrs
    names = [name.upper() for name in attrs["flag_meanings"].split()]
    result = {FrameFlag[name]: mask for name, mask in zip(names, attrs["flag_masks"], strict=True)}
    assert result == {flag: int(flag) for flag in FrameFlag}
    kinds = opened["log_kind"].attrs
    assert kinds["flag_meanings"].split() == list(opened.attrs["log_kinds"])
    assert kinds["flag_values"] == list(opened.attrs["log_kinds"].values())


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
    assert_raises(OSError, "No space left on device", file.frame, BANDS[0], shot(7))
    monkeypatch.undo()
    assert file.broken
    opened = store.open_dataset(tmp_path / "a.zarr")
    assert (opened.sizes["time"], opened.attrs["closed"]) == (4, False)
    expected = IMAGE + np.arange(4)[:, None, None]
    np.testing.assert_array_equal(opened["counts"], np.stack([expected] * 2))
    assert [path.name for path in tmp_path.iterdir()] == ["a.zarr"]


def numbers(field: telemetry.Field) -> st.SearchStrategy[float]:
    """Values that a field can hold."""
    limits = np.iinfo(field.dtype)
    every = st.integers(int(limits.min), int(limits.max))
    return every.map(lambda number: number / field.steps + field.zero) if field.steps else every


# Field, value, byte and bytes of it, by the public decoders.
VECTORS = [
    ("frame_counter", 1234567, 84, "12 00 87 D6"),
    ("fpa_temperature", 311.2, 94, "28 0C"),
    ("uptime", 20576.117, 280, "39 01 75 F7"),
]


def test_fields_have_the_published_bytes() -> None:
    """The bytes in the buffer are those of the public decoders, both ways, and 0 elsewhere."""
    values, buffer = {name: value for name, value, _, _ in VECTORS}, bytearray(2 * telemetry.WORDS)
    for _, _, offset, line in VECTORS:
        buffer[offset : offset + len(bytes.fromhex(line))] = bytes.fromhex(line)
    encoded = telemetry.encode(values, COLUMNS).astype("<u2").tobytes()
    assert encoded == bytes(buffer).ljust(len(encoded), b"\0")
    decoded = telemetry.decode(np.frombuffer(bytes(buffer), dtype="<u2"))
    assert {name: decoded[name] for name in values} == pytest.approx(values, abs=1e-9)


@given(st.fixed_dictionaries({name: numbers(field) for name, field in telemetry.FIELDS.items()}))
def test_fields_come_back(fields: dict[str, float]) -> None:
    """Encoded fields are decoded unchanged, and give the metadata of a frame."""
    encoded = telemetry.encode(fields, COLUMNS)
    assert telemetry.decode(encoded) == pytest.approx(fields, rel=0, abs=1e-6)
    result = telemetry.metadata(encoded)
    assert result.frame_counter == fields["frame_counter"]
    assert result.last_ffc_frame == fields["last_ffc_frame"]
    assert result.fpa_temperature == pytest.approx(fields["fpa_temperature"], abs=1e-6)


test_wrong_telemetry_is_refused = refused(
    lambda call, *content: call(*content),
    [
        (telemetry.decode, np.zeros(10, np.uint16), "telemetry of 10 words. Must hold 142"),
        (telemetry.decode, np.zeros(1280, np.float32), "telemetry of float32. Must be uint16"),
        (telemetry.encode, {"frame_counter": 2**32}, COLUMNS, "Invalid frame_counter of 42949672"),
        (camera.camera_kind, "lepton", "Unknown kind of camera 'lepton'. Must be one of ['"),
    ],
)


IMMINENT, BUSY, DONE = FfcStatus.IMMINENT, FfcStatus.IN_PROGRESS, FfcStatus.COMPLETE


@pytest.mark.parametrize(
    ("copies", "last", "status", "expected"),
    [
        # A renewal at the start of a correction closes all copies, one at its end a frame after.
        ("...xxxx..", [0, 0, 0, 3, 3, 3, 3, 3, 3], None, "...xxxx.."),
        ("...xxxx..", [0, 0, 0, 0, 0, 0, 0, 7, 7], None, ".......x."),
        # Frozen frames that were lost leave one frame; damaged telemetry is not used.
        (".....", [0, 0, 3, 3, 3], None, "..x.."),
        (".....", [0, 0, None, 3, 3], None, "...x."),
        # Repeated images of a camera with telemetry are no shutter.
        ("..x.xxxxx.", [5] * 10, None, ".........."),
        # From the first copy after the reading to the last, however old the reading is.
        ("..xxxx..", None, [DONE] * 3 + [BUSY] * 2 + [DONE] * 3, "...xxx.."),
        ("..xxxx..", None, [DONE] * 3 + [IMMINENT] * 2 + [DONE] * 3, "...xxx.."),
        ("........", None, [BUSY] * 8, "........"),
        # Without telemetry three copies or more mark a closed shutter, fewer are lost frames.
        ("..xxxx.", None, None, "....xx."),
        ("..xxxx.", None, [DONE] * 7, "....xx."),
        ("..xx.x.", None, None, "......."),
    ],
)
def test_rule_of_the_shutter(
    copies: str, last: list[int | None] | None, status: list[FfcStatus] | None, expected: str
) -> None:
    """The shutter is closed, x, by a renewal, a reading or a run of copies, also x."""
    state, closed, nothing = camera.Shutter(), "", [None] * len(copies)
    for mark, frame, read in zip(copies, last or nothing, status or nothing, strict=True):
        state = next_shutter(state, repeated=mark == "x", last_ffc_frame=frame, ffc_status=read)
        closed += "x" if state.closed else "."
    assert closed == expected


FFC_STATUS = st.none() | st.sampled_from(FfcStatus)


@given(st.lists(st.tuples(st.booleans(), st.none() | st.integers(0, 3), FFC_STATUS)))
def test_a_changing_image_is_closed_by_a_renewal_alone(
    frames: list[tuple[bool, int | None, FfcStatus | None]],
) -> None:
    """A frame with a new image is marked only if the number of the last correction changed."""
    state = camera.Shutter()
    for repeated, last, status in frames:
        after = next_shutter(state, repeated=repeated, last_ffc_frame=last, ffc_status=status)
        renewed = None not in {last, state.last_ffc_frame} and last != state.last_ffc_frame
        assert after.closed is renewed or repeated
        assert after.copies == (state.copies + 1 if repeated else 0)
        state = after
