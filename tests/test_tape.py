"""A tape believes no stamp and no telemetry that cannot be, and says what it doubts."""

import errno
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dbthermal import store
from dbthermal.instruments import telemetry
from dbthermal.instruments.capture import notes
from dbthermal.instruments.emulated.frames import EmulatedCamera
from dbthermal.instruments.emulated.world import World
from dbthermal.instruments.frames_source import MEANINGS, Frame, FrameFlag
from dbthermal.instruments.tape import Note, Tape
from dbthermal.instruments.telemetry import Telemetry

SHAPE, RATE, BANDS = (4, 80), 100.0, ("8-14", "9.5")
IMAGE = np.full(SHAPE, 5000, dtype=np.uint16)
DAMAGES = (FrameFlag.DRIVER_ERROR, FrameFlag.WRONG_SIZE)


def begun(path: Path, telemetry_rows: int = 0) -> Tape:
    """A tape of two bands in chunks of four frames."""
    world, sources = World(), {}
    for number, band in enumerate(BANDS):
        world.add_camera(band, number)
        form = (SHAPE, RATE, telemetry_rows)
        sources[band] = EmulatedCamera(world, band, {band: lambda _: IMAGE}, band, *form)
    return Tape(path, sources, readings={"plate": "K"}, origin=0.0, attrs={}, chunk=4)


def shot(number: int, **changes: Any) -> Frame:
    """A good frame of this number."""
    time = number / RATE
    values = {"device_time": time, "host_time": time + 0.001, "sequence": number}
    return Frame(**{"counts": IMAGE, **values, **changes})


def rows(counter: int, temperature: float = 308.2) -> np.ndarray[Any, np.dtype[np.uint16]]:
    """Telemetry rows of a camera whose last correction was at a frame."""
    fields = Telemetry(last_ffc_frame=counter, fpa_temperature=temperature)
    return telemetry.encode(fields, SHAPE[1])


def test_a_stamp_of_the_future_spoils_its_own_frame_alone(tmp_path: Path) -> None:
    """A stamp that leaps ahead of the host's clock is no time; those that follow it are."""
    tape = begun(tmp_path / "a.zarr")
    for frame in (shot(0), shot(1, device_time=500.0), shot(2), shot(3)):
        tape.frame(BANDS[0], frame)
    tape.close(complete=True, ended="stopped")
    opened = store.open_dataset(tmp_path / "a.zarr").isel(band=0)
    np.testing.assert_array_equal(opened["frame_flags"], [0, FrameFlag.TIME_AHEAD, 0, 0])
    np.testing.assert_allclose(opened["exposure_time"], [0, math.nan, 0.02, 0.03], atol=1e-12)


def test_a_clock_of_its_own_may_be_ahead(tmp_path: Path) -> None:
    """A camera's own clock has another origin: it is not compared with the host's."""
    tape = begun(tmp_path / "a.zarr")
    for number in range(2):
        time = 500.0 + number
        tape.frame(BANDS[0], shot(number, device_time=time, flags=FrameFlag.FOREIGN_CLOCK))
    tape.close(complete=True, ended="stopped")
    opened = store.open_dataset(tmp_path / "a.zarr").isel(band=0)
    np.testing.assert_array_equal(opened["frame_flags"], 2 * [FrameFlag.FOREIGN_CLOCK])


@pytest.mark.parametrize("flag", DAMAGES)
def test_telemetry_of_a_damaged_frame_is_not_believed(flag: FrameFlag, tmp_path: Path) -> None:
    """Rows of zeros in a cut frame make no correction and no temperature; they are kept."""
    tape = begun(tmp_path / "a.zarr", telemetry.ROWS)
    cut = shot(1, flags=flag, telemetry=np.zeros_like(rows(0)))
    for frame in (shot(0, telemetry=rows(7)), cut, shot(2, telemetry=rows(7))):
        tape.frame(BANDS[0], frame)
    tape.close(complete=True, ended="stopped")
    opened = store.open_dataset(tmp_path / "a.zarr").isel(band=0)
    np.testing.assert_allclose(opened["fpa_temperature"], [308.2, math.nan, 308.2], atol=1e-4)
    assert not opened["telemetry"][1].any()
    assert [note[1] for note in notes(tmp_path / "a.zarr")] == ["damaged"]


def test_a_correction_is_noted(tmp_path: Path) -> None:
    """Offsets that the camera renewed of its own accord are in the log, with its own number."""
    tape = begun(tmp_path / "a.zarr", telemetry.ROWS)
    for number, counter in enumerate((7, 7, 90)):
        tape.frame(BANDS[0], shot(number, telemetry=rows(counter)))
    tape.close(complete=True, ended="stopped")
    found = [note[1:] for note in notes(tmp_path / "a.zarr")]
    assert found == [("correction", "8-14", 90)]


def test_copies_of_the_last_frame_say_so(tmp_path: Path) -> None:
    """Where a band has no frame any more, or never had one, its flags and numbers tell."""
    tape = begun(tmp_path / "a.zarr")
    for number in range(6):
        tape.frame(BANDS[0], shot(number))
    tape.frame(BANDS[1], shot(0))
    tape.close(complete=True, ended="stopped")
    second = store.open_dataset(tmp_path / "a.zarr").isel(band=1)
    np.testing.assert_array_equal(second["frame_flags"], [0, *(5 * [FrameFlag.PADDED])])
    np.testing.assert_array_equal(second["sequence"], [0, *(5 * [-1])])
    assert (second["counts"] == IMAGE).all()


def test_flags_explain_themselves(tmp_path: Path) -> None:
    """The variable has the masks and meanings of the CF conventions."""
    begun(tmp_path / "a.zarr").close(complete=True, ended="stopped")
    attrs = store.open_dataset(tmp_path / "a.zarr")["frame_flags"].attrs
    names = [name.upper() for name in attrs["flag_meanings"].split()]
    found = {FrameFlag[name]: mask for name, mask in zip(names, attrs["flag_masks"], strict=True)}
    assert found == {flag: int(flag) for flag in MEANINGS}


def test_notes_do_not_wait_for_frames(tmp_path: Path) -> None:
    """While no frame comes, readings are in the store after a second, and not only at its end."""
    tape = begun(tmp_path / "a.zarr")
    for number in range(5):
        tape.note(Note.READING, "plate", 0.3 * number, 300.0)
    assert store.open_dataset(tmp_path / "a.zarr").sizes["log"] == 5


def test_full_disk_leaves_what_was_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A chunk for which there is no space is not in the store; those before are, and it opens."""
    tape = begun(tmp_path / "a.zarr")
    for number in range(7):
        for band in BANDS:
            tape.frame(band, shot(number))

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "open", full)
    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space left on device"):
        tape.frame(BANDS[0], shot(7))
    monkeypatch.undo()
    assert tape.broken
    opened = store.open_dataset(tmp_path / "a.zarr")
    assert (opened.sizes["time"], opened.attrs["closed"]) == (4, False)
    assert (opened["counts"] == IMAGE).all()
    assert [path.name for path in tmp_path.iterdir()] == ["a.zarr"]
