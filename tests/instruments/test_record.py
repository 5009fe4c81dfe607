"""A recording says what made it, and survives faults; see `test_faults` for its frames."""

import errno
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import NoReturn

import numpy as np
import pytest
import xarray as xr
from faulty_camera import BANDS, Faults, FaultyCamera, two_bands, two_cameras

from dbthermal import alignment, correction, store
from dbthermal.instruments.camera import Counts, FrameSource
from dbthermal.instruments.emulated import World
from dbthermal.instruments.recording import Limits, Preview, Reading, notes, open_capture, record
from dbthermal.instruments.session import Camera, Session

SHAPE, RATE, CHUNK = (16, 24), 100.0, 5
SMALL = Limits(chunk=CHUNK, reserve=0, silence=0.1, reading_period=0.05, preview_period=0.0)
PATTERN = np.random.default_rng(1).integers(5000, 6000, SHAPE).astype(np.uint16)
GONE = Faults(unplugged=6)


def picture(time: float) -> Counts:
    """Counts that tell the time, in hundredths of a second, pixel by pixel."""
    return (PATTERN + round(RATE * time)).astype(np.uint16)


def session(duration: float = 0.3) -> Session:
    """Two emulated cameras with small frames."""
    return two_bands(duration, SHAPE, RATE)


def bench(
    first: Faults | None = None,
    second: Faults | None = None,
    *,
    rows: int = 0,
    world: World | None = None,
) -> dict[str, FrameSource]:
    """Two cameras on one bench, with their faults."""
    faults = dict(zip(BANDS, (first or Faults(), second or Faults()), strict=True))
    return dict(two_cameras(picture, SHAPE, RATE, rows, faults=faults, world=world))


def test_recording_says_what_made_it(tmp_path: Path) -> None:
    """Identities, further ones beside them, the session and the versions are in the store."""
    camera: dict[str, str | bool] = {"software_revision": "1.2.3", "is_simulated": True}
    identities: dict[str, dict[str, str | bool]] = {"9.5": camera, "wheel": {"model": "a"}}
    path = tmp_path / "a.zarr"
    record(session(), bench(rows=12), path, identities=identities, limits=SMALL)
    opened = open_capture(path)
    assert opened.attrs["is_simulated"] is True
    assert opened.attrs["provenance"]["parameters"]["name"] == "test"
    assert (opened.attrs["complete"], opened.attrs["ended"]) == (True, "duration")
    np.testing.assert_allclose(opened["fpa_temperature"][0, 0], 308.2, rtol=0, atol=0.06)
    entries = opened.attrs["identities"]
    source = {"device": "sim://boson/9.5", "model": "emulated Boson", "serial_number": "101"}
    assert entries["9.5"] == {**source, **camera}
    assert (set(entries), entries["wheel"]) == ({*BANDS, "wheel"}, {"model": "a"})


def test_frames_from_before_are_not_taken(tmp_path: Path) -> None:
    """Frames that the driver held from before the start are discarded."""
    sources = bench()
    for source in sources.values():
        source.read()
    sources["9.5"].clock.sleep(0.05)
    summary = record(session(), sources, tmp_path / "a.zarr", limits=SMALL)
    opened = open_capture(tmp_path / "a.zarr")
    assert float(opened["exposure_time"].min()) >= 0
    assert int(opened["sequence"][:, 0].min()) > 4
    assert all(total["lost"] == 0 for total in summary.totals.values())


def test_duration_begins_with_the_first_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The duration counts from the first frame, however long the file takes to create."""
    world, rate = World(), 60.0
    world.add_camera("8-14", 1)
    source = FaultyCamera(world, "8-14", {"8-14": picture}, "8-14", SHAPE, rate)
    source.read()  # from now on it holds frames
    delays, usage = iter([0.44]), shutil.disk_usage

    def slowly(folder: Path) -> object:
        world.clock.sleep(next(delays, 0.0))
        return usage(folder)

    monkeypatch.setattr(shutil, "disk_usage", slowly)
    plan = Session("test", True, "scene", 2.0, {"8-14": Camera("v4l2:///dev/video0")}, rate, SHAPE)
    limits = Limits(chunk=200, reserve=0, queue=200)
    summary = record(plan, {"8-14": source}, tmp_path / "a.zarr", limits=limits)
    opened = open_capture(tmp_path / "a.zarr")
    times = opened["exposure_time"][0]
    assert abs(summary.totals["8-14"]["frames"] - 2.0 * rate) <= 1
    assert 0 <= times[0] < 1 / rate
    assert abs(times[-1] - 2.0) <= 1 / rate
    assert opened.attrs["clock_origin"] == 0.44


@pytest.mark.parametrize("rows", [0, 12])
def test_recording_goes_on_to_alignment(rows: int, tmp_path: Path) -> None:
    """Losses and a shutter event, from telemetry or images, go through correction and alignment."""
    first = Faults(dropped=frozenset({7, 8}), corrupt=frozenset({20}))
    second = Faults(ffc=frozenset({10}), offset_step=20.0)
    record(session(0.9), bench(first, second, rows=rows), tmp_path / "a.zarr", limits=SMALL)
    capture = open_capture(tmp_path / "a.zarr")
    ones = xr.DataArray(np.ones((2, *SHAPE)), dims=("band", "y", "x"), coords={"band": [*BANDS]})
    unity = xr.Dataset({"gain": ones, "offset": 0 * ones, "bad": ones > 1})
    corrected = correction.correct_capture(capture, unity, bad_pixels=None)
    assert corrected.attrs["shutter_events"] == 1
    assert [number > 0 for number in corrected.attrs["shutter_closed_frames"]] == [False, True]
    aligned = alignment.align(corrected, offset=0.0)
    assert int(aligned["segment"].max()) == 1
    exact = aligned["counts"].sel(band="8-14").values - PATTERN
    level = exact - RATE * aligned["time"].values[:, None, None]
    expected = np.where(np.isnan(level), np.nan, 0)
    np.testing.assert_allclose(level - np.nanmedian(level), expected, atol=1.0)


def test_last_source_lost_ends_it(tmp_path: Path) -> None:
    """The loss of the last camera ends it; without any frame it opens, but is no capture."""
    sources, path = bench(GONE, GONE), tmp_path / "a.zarr"
    assert record(session(60.0), sources, path, limits=SMALL).ended == "source lost"
    assert sources["9.5"].clock() < 1.0
    never = Faults(unplugged=0)
    record(session(), bench(never, never), tmp_path / "b.zarr", limits=SMALL)
    assert store.open_dataset(tmp_path / "b.zarr").sizes["time"] == 0
    with pytest.raises(ValueError, match="Empty 'counts' of the corrected"):
        open_capture(tmp_path / "b.zarr")


def test_readings_come_beside_the_frames(tmp_path: Path) -> None:
    """Readings are noted with their time; a failure is NaN, and the recording goes on."""
    answers = iter([300.0, 301.0])

    def read() -> float:
        if (value := next(answers, None)) is None:
            raise TimeoutError("No answer.")
        return value

    readings = {"plate": Reading(read)}
    record(session(), bench(), tmp_path / "a.zarr", readings=readings, limits=SMALL)
    entries = [note[1:] for note in notes(tmp_path / "a.zarr")]
    assert entries[:2] == [("reading", "plate", 300.0), ("reading", "plate", 301.0)]
    assert {kind for kind, _, _ in entries[2:]} == {"reading_failed"}


def test_errors_end_it_and_keep_what_came(tmp_path: Path) -> None:
    """An error in a reading or a preview is raised after the frames are stored."""
    sources = bench()

    def wrong() -> float:
        sources["9.5"].clock.sleep(0.1)
        raise KeyError("plate")

    def show(_: Preview) -> NoReturn:
        raise ZeroDivisionError

    with pytest.raises(KeyError, match="plate"):
        record(session(9.0), sources, tmp_path / "a.zarr", readings={"a": Reading(wrong)})
    with pytest.raises(ZeroDivisionError):
        record(session(9.0), bench(), tmp_path / "b.zarr", limits=SMALL, preview=show)
    for name, ended in (("a.zarr", "error"), ("b.zarr", "interrupted")):
        opened = store.open_dataset(tmp_path / name)
        assert (opened.attrs["complete"], opened.attrs["ended"]) == (False, ended)
        assert opened.sizes["time"] >= 1


def test_what_is_refused(tmp_path: Path) -> None:
    """An existing folder, emulated frames in a session of hardware, and wrong bands are named."""
    path = tmp_path / "a.zarr"
    hardware = Session("test", False, "scene", 1.0, session().cameras, RATE, SHAPE)
    with pytest.raises(ValueError, match=r"is_simulated is True\. Must be False, as the session"):
        record(hardware, bench(), path)
    with pytest.raises(ValueError, match=r"Invalid sources \['9\.5', '8-14'\]"):
        record(session(), dict(reversed(bench().items())), path)
    assert not path.exists()
    path.mkdir()
    with pytest.raises(FileExistsError, match="Must be a new recording"):
        record(session(), bench(), path, limits=SMALL)


def test_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Too little space is an error before it begins, and ends it on the way with all it has."""
    limits, path = Limits(chunk=CHUNK, reserve=1000), tmp_path / "a.zarr"
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=5000))
    with pytest.raises(OSError, match=r"Too little space: 5000 bytes are free\. Must be 47080"):
        record(session(), bench(), path, limits=limits)
    answers = iter([10**9, 10**9, 999])
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=next(answers)))
    with pytest.raises(OSError, match="Too little space: 999 bytes") as raised:
        record(session(), bench(), path, limits=limits)
    assert raised.value.errno == errno.ENOSPC
    opened = store.open_dataset(path)
    assert (opened.attrs["ended"], opened.attrs["complete"]) == ("no space", False)
    assert opened.sizes["time"] >= CHUNK


def test_device_that_hangs(tmp_path: Path) -> None:
    """A device that never answers costs an error that names it, and no frame."""
    limits, path, sources = Limits(chunk=CHUNK, reserve=0, patience=0.1), tmp_path / "a", bench()

    def hang() -> float:
        sources["9.5"].clock.sleep(20.0)
        return 0.0

    readings = {"plate": Reading(hang)}
    with pytest.raises(TimeoutError, match="No answer of the device of 'readings' within 0"):
        record(session(), sources, path.with_suffix(".zarr"), readings=readings, limits=limits)
    opened = store.open_dataset(path.with_suffix(".zarr"))
    assert opened.attrs["frames_written"]["9.5"] > 20
