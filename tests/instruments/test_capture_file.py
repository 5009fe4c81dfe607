"""A capture file flags impossible time stamps and telemetry, and does not use them."""

import errno
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dbthermal import store
from dbthermal.instruments import telemetry
from dbthermal.instruments.camera import DAMAGED, GOOD, Frame, FrameFlag
from dbthermal.instruments.emulated.camera import EmulatedCamera
from dbthermal.instruments.emulated.world import World
from dbthermal.instruments.recording import notes
from dbthermal.instruments.recording._capture_file import CaptureFile, Note

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
