"""A recording after a kill or a power loss opens, with all frames but the last chunk's."""

import multiprocessing
import os
import time
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from test_capture_file import CaptureFile, Note

from dbthermal import store
from dbthermal.instruments.camera import Counts, Frame
from dbthermal.instruments.emulated.camera import EmulatedCamera
from dbthermal.instruments.emulated.world import World
from dbthermal.instruments.recording import (
    Limits,
    Reading,
    notes,
    open_capture,
    record,
)
from dbthermal.instruments.session import Camera, Session
from dbthermal.store import _recording as durable

SHAPE, RATE, CHUNK = (32, 40), 200.0, 6
BANDS = ("8-14", "9.5")
DENSE = ((True, 11), (False, 11))


def picture(time: float) -> Counts:
    """Counts that tell the time, in frames."""
    return np.full(SHAPE, 1000 + round(RATE * time), dtype=np.uint16)


def record_until_killed(path: Path, duration: float, pipe: Connection) -> None:
    """Record, and print the number of frames of each band after every frame."""
    world, sources = World(), {}
    for number, band in enumerate(BANDS):
        world.add_camera(band, number)
        sources[band] = EmulatedCamera(world, band, {band: picture}, band, SHAPE, RATE)
    camera = Camera("v4l2:///dev/video0")
    cameras = dict.fromkeys(BANDS, camera)
    session = Session("killed", True, "scene", duration, cameras, RATE, SHAPE)
    limits = Limits(chunk=CHUNK, reserve=0, preview_period=0.0, reading_period=0.02)
    readings = {"plate": Reading(lambda: 300.0)}
    record(
        session,
        dict(sources),
        path,
        limits=limits,
        readings=readings,
        preview=lambda shown: pipe.send([shown.totals[band]["frames"] for band in BANDS]),
    )


def killed(path: Path, delay: float, duration: float = 60.0) -> list[int]:
    """Kill a recording some time after its first frame; frames that it had taken by then."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__, "dbthermal.store", "dbthermal.instruments.recording"])
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=record_until_killed, args=(path, duration, theirs))
    process.start()
    theirs.close()
    assert ours.poll(60)
    taken: list[int] = ours.recv()
    time.sleep(delay)
    process.kill()
    process.join()
    try:
        while True:
            taken = ours.recv()
    except EOFError:
        return taken


def check(opened: xr.Dataset, frames: list[int]) -> None:
    """Each frame is whole, shows what it must, and follows on the one before."""
    for place, number in enumerate(frames):
        counts = opened["counts"][place, :number].values.astype(int)
        assert (counts == counts[:, :1, :1]).all()
        np.testing.assert_array_equal(
            np.diff(counts[:, 0, 0]), np.diff(opened["sequence"][place, :number])
        )
        assert np.isfinite(opened["exposure_time"][place, :number]).all()


@pytest.mark.parametrize("kills", [2, pytest.param(20, marks=pytest.mark.slow)])
def test_kill_costs_the_last_chunk(tmp_path: Path, kills: int) -> None:
    """Killed at any moment, a recording opens and lacks less than a chunk of each band."""
    moments = np.random.default_rng(7).uniform(0.0, 0.5, kills)
    for number, moment in enumerate(moments):
        path = tmp_path / f"{number}.zarr"
        taken = killed(path, float(moment))
        opened = store.open_dataset(path)
        written = [opened.attrs["frames_written"][band] for band in BANDS]
        assert opened.attrs["complete"] is False
        assert opened.sizes["time"] == min(written)
        for had, kept in zip(taken, written, strict=True):
            assert had - had % CHUNK <= kept <= had + 2 * CHUNK
        check(opened, 2 * [min(written)])
        if min(written) > 1:
            assert open_capture(path).sizes["time"] == min(written)
        assert all(note[1:] == ("reading", "plate", 300.0) for note in notes(path))


@pytest.mark.parametrize("kills", [1, pytest.param(8, marks=pytest.mark.slow)])
def test_kill_while_it_is_closed(tmp_path: Path, kills: int) -> None:
    """A recording killed near its end opens, and is marked complete only if it is."""
    for number, moment in enumerate(np.linspace(0.3, 0.15, kills)):
        path = tmp_path / f"{number}.zarr"
        killed(path, float(moment), duration=0.2)
        opened = store.open_dataset(path)
        written = list(opened.attrs["frames_written"].values())
        closed = opened.attrs["closed"]
        assert opened.attrs["complete"] is closed
        assert opened.sizes["time"] == (max(written) if closed else min(written))
        check(opened, written if closed else 2 * [min(written)])


class Disk:
    """Durable state of a disk: contents of files and names in folders, as last synced."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.contents: dict[int, bytes] = {}
        self.names: dict[int, list[tuple[str, int, bool]]] = {}

    def sync(self, path: Path) -> None:
        """Bring to the disk what a file or a folder has in it now."""
        number = path.stat().st_ino
        if path.is_dir():
            self.names[number] = listed(path)
            return
        # A second name, so that the file's number is not given away.
        kept = self.root.parent / f"kept-{number}"
        kept.unlink(missing_ok=True)
        kept.hardlink_to(path)
        self.contents[number] = path.read_bytes()

    def power_loss(self, left: Path, *, early: bool) -> None:
        """Write the durable state to a folder; with `early` also names that were not synced."""
        folders = [self.root, *(path for path in self.root.rglob("*") if path.is_dir())]
        now = {path.stat().st_ino: listed(path) for path in folders}
        self._restore(left, self.root.stat().st_ino, now if early else self.names)

    def _restore(
        self, left: Path, number: int, names: dict[int, list[tuple[str, int, bool]]]
    ) -> None:
        left.mkdir()
        for name, inside, is_folder in names.get(number, []):
            if is_folder:
                self._restore(left / name, inside, names)
            else:
                (left / name).write_bytes(self.contents.get(inside, b""))


def listed(folder: Path) -> list[tuple[str, int, bool]]:
    """Name, number and kind of what is in a folder."""
    return [(entry.name, entry.inode(), entry.is_dir()) for entry in os.scandir(folder)]


def frame(number: int) -> Frame:
    """A good frame of this number."""
    time = number / RATE
    return Frame(picture(time), time, time, number)


def two_bands(path: Path) -> CaptureFile:
    """A capture file of two bands, in chunks of three frames, which is handed frames by hand."""
    world, sources = World(), {}
    for number, band in enumerate(BANDS):
        world.add_camera(band, number)
        sources[band] = EmulatedCamera(world, band, {band: picture}, band, SHAPE, RATE)
    return CaptureFile(path, sources, readings={"plate": "K"}, origin=0.0, attrs={}, chunk=3)


def check_left(left: Path, committed: list[int]) -> None:
    """Check that all frames and notes that were declared valid are in the store."""
    opened = store.open_dataset(left)
    written = list(opened.attrs["frames_written"].values())
    assert all(np.greater_equal(written, committed))
    closed = opened.attrs["closed"]
    assert opened.sizes["time"] == (max(written) if closed else min(written))
    check(opened, written if closed else 2 * [min(written)])
    assert opened.sizes["log"] == opened.attrs["log_written"]
    np.testing.assert_array_equal(opened["log_value"], np.arange(opened.sizes["log"]))


@pytest.mark.parametrize(
    ("early", "every"),
    [(True, 60), (False, 60), *(pytest.param(*case, marks=pytest.mark.slow) for case in DENSE)],
)
def test_power_loss_costs_the_last_chunk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, early: bool, every: int
) -> None:
    """After a power loss all that was declared valid is on the disk."""
    (tmp_path / "disk").mkdir()
    disk, committed, syncs = Disk(tmp_path / "disk"), [0, 0], 0

    def lose() -> None:
        left = tmp_path / f"left-{syncs}"
        disk.power_loss(left, early=early)
        check_left(left / "a.zarr", committed)

    def sync(path: Path) -> None:
        nonlocal syncs
        syncs += 1
        if recorded and syncs % every == 0:
            lose()
        disk.sync(path)

    recorded: CaptureFile | None = None
    monkeypatch.setattr(durable, "_THREADS", 1)
    monkeypatch.setattr(durable, "_to_disk", sync)
    recorded = two_bands(tmp_path / "disk" / "a.zarr")
    for number in range(15):
        band = BANDS[number % 2 if number < 14 else 0]
        recorded.note(Note.READING, "plate", number / RATE, number)
        recorded.frame(band, frame(number // 2))
        committed = list(recorded.recording.frames.values())
    recorded.close(complete=True, ended="stopped")
    syncs, committed = -1, [8, 7]
    lose()
