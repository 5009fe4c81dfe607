"""A recording after a kill or a power loss opens, with all frames but the last chunk's."""

import multiprocessing
import os
import signal
import stat
import threading
from collections.abc import Iterable
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from faulty_camera import BANDS, two_bands, two_cameras
from file_operations import before_operation, operations_of
from marks import long
from rig_session import LIMIT
from test_capture_file import CaptureFile, Note, begun, shot

from dbthermal import store
from dbthermal.instruments.camera import Counts
from dbthermal.instruments.recording import Limits, Reading, notes, open_capture, record

SHAPE, RATE, CHUNK = (32, 40), 200.0, 6
MOMENTS = (0.7, 0.999)  # parts of a recording's file operations
Names = list[tuple[str, int, bool]]


def picture(time: float) -> Counts:
    """Counts that tell the time, in frames."""
    return np.full(SHAPE, 1000 + round(RATE * time), dtype=np.uint16)


def record_until_killed(folder: Path, share: float, pipe: Connection) -> None:
    """Record a whole recording, and one that is killed after a part of as many operations."""
    limits = Limits(chunk=CHUNK, reserve=0, preview_period=0.0, reading_period=0.02)
    readings = {"plate": Reading(lambda: 300.0)}

    def run(name: str, duration: float = 0.3) -> None:
        record(
            two_bands(duration, SHAPE, RATE),
            dict(two_cameras(picture, SHAPE, RATE)),
            folder / name,
            limits=limits,
            readings=readings,
            preview=lambda shown: pipe.send(
                [name, *(shown.totals[band]["frames"] for band in BANDS)]
            ),
        )

    run("first.zarr", 0.05)  # later ones import nothing
    operations = operations_of(lambda: run("whole.zarr"))
    with before_operation(round(share * operations), lambda: os.kill(os.getpid(), signal.SIGKILL)):
        run("killed.zarr")


def killed(folder: Path, share: float) -> list[int]:
    """Kill a recording after a part of it; frames that it had taken by then."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__, "dbthermal.store", "dbthermal.instruments.recording"])
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=record_until_killed, args=(folder, share, theirs))
    process.start()
    theirs.close()
    taken = [0, 0]
    try:
        while ours.poll(LIMIT):
            name, *frames = ours.recv()
            taken = frames if name == "killed.zarr" else [0, 0]
    except EOFError:
        process.join(LIMIT)
    assert process.exitcode == -signal.SIGKILL
    return taken


def check(opened: xr.Dataset, frames: Iterable[int]) -> None:
    """Each frame is whole, shows what it must, and follows on the one before."""
    for place, number in enumerate(frames):
        counts = opened["counts"][place, :number].values.astype(int)
        assert (counts == counts[:, :1, :1]).all()
        steps = np.diff(opened["sequence"][place, :number])
        np.testing.assert_array_equal(np.diff(counts[:, 0, 0]), steps)
        assert np.isfinite(opened["exposure_time"][place, :number]).all()


def check_written(opened: xr.Dataset) -> list[int]:
    """Check that the frames that are there are those of the store's attributes."""
    written = list(opened.attrs["frames_written"].values())
    closed = opened.attrs["closed"]
    assert opened.sizes["time"] == (max(written) if closed else min(written))
    check(opened, written if closed else 2 * [min(written)])
    return written


@pytest.mark.parametrize("share", [*MOMENTS, *long(*np.linspace(0.1, 1, 19))])
def test_kill_costs_the_last_chunk(tmp_path: Path, share: float) -> None:
    """Killed at any moment, a recording opens and lacks less than a chunk of each band."""
    taken, path = killed(tmp_path, share), tmp_path / "killed.zarr"
    if not path.exists():  # it came before there was one
        assert taken == [0, 0]
        return
    opened = store.open_dataset(path)
    written = check_written(opened)
    assert opened.attrs["complete"] is opened.attrs["closed"]
    for had, kept in zip(taken, written, strict=True):
        assert had - had % CHUNK <= kept <= had + 2 * CHUNK
    if min(written) > 1:
        assert open_capture(path).sizes["time"] == opened.sizes["time"]
    assert all(note[1:] == ("reading", "plate", 300.0) for note in notes(path))


class Disk:
    """Durable state of a disk: contents of files and names in folders, as last synced."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.contents: dict[int, bytes] = {}
        self.names: dict[int, Names] = {}
        self.kept: list[int] = []

    def sync(self, file: int) -> None:
        """Bring to the disk what an open file or folder has in it now."""
        status = os.fstat(file)
        self.kept.append(os.dup(file))  # so that its number is not given away
        if stat.S_ISDIR(status.st_mode):
            self.names[status.st_ino] = listed(file)
        else:
            self.contents[status.st_ino] = os.pread(file, status.st_size, 0)

    def power_loss(self, remains: Path, *, early: bool) -> None:
        """Write the durable state to a folder; with `early` also names that were not synced."""
        folders = [self.root, *(path for path in self.root.rglob("*") if path.is_dir())]
        now = {path.stat().st_ino: listed(path) for path in folders}
        self._restore(remains, self.root.stat().st_ino, now if early else self.names)

    def _restore(self, remains: Path, number: int, names: dict[int, Names]) -> None:
        remains.mkdir()
        for name, inode, is_folder in names.get(number, []):
            if is_folder:
                self._restore(remains / name, inode, names)
            else:
                (remains / name).write_bytes(self.contents.get(inode, b""))


def listed(folder: Path | int) -> Names:
    """Name, number and kind of what is in a folder."""
    with os.scandir(folder) as entries:
        return [
            (entry.name, entry.inode(), entry.is_dir(follow_symlinks=False)) for entry in entries
        ]


@pytest.mark.parametrize("every", [60, *long(11)])
@pytest.mark.parametrize("early", [True, False])
def test_power_loss_costs_the_last_chunk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, early: bool, every: int
) -> None:
    """After a power loss all that was declared valid is on the disk."""
    (tmp_path / "disk").mkdir()
    disk, lock = Disk(tmp_path / "disk"), threading.Lock()
    committed, syncs, recorded = [0, 0], 0, list[CaptureFile]()

    def lose() -> None:
        remains = tmp_path / f"left-{syncs}"
        disk.power_loss(remains, early=early)
        opened = store.open_dataset(remains / "a.zarr")
        assert all(np.greater_equal(check_written(opened), committed))
        assert opened.sizes["log"] == opened.attrs["log_written"]
        np.testing.assert_array_equal(opened["log_value"], np.arange(opened.sizes["log"]))

    def sync(file: int) -> None:
        nonlocal syncs
        with lock:
            syncs += 1
            if recorded and syncs % every == 0:
                lose()
            disk.sync(file)

    monkeypatch.setattr(os, "fsync", sync)
    recorded.append(file := begun(tmp_path / "disk" / "a.zarr", chunk=3))
    for number in range(15):
        band = BANDS[number % 2 if number < 14 else 0]
        file.note(Note.READING, "plate", number / 100, number)
        file.frame(band, shot(number // 2))
        committed = list(file.recording.frames.values())
    file.close(complete=True, ended="stopped")
    assert syncs > every
    syncs, committed = -1, [8, 7]
    lose()
    for number in disk.kept:
        os.close(number)
