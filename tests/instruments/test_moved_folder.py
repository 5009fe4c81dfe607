"""A recording whose folder is moved goes on in it whole; one that loses a part ends and says so."""

import os
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from faulty_camera import BANDS
from file_operations import before_operation, operations_of
from marks import long
from refused import assert_raises, assert_refused
from rig_session import from_yaml, rig
from test_capture_file import Note, begun, shot
from test_killed import check
from test_protocols import TWO, swept
from test_record import SMALL, bench, session

from dbthermal import store
from dbthermal.instruments.recording import Preview, notes, open_sweep, record

FRAMES = 15
EVERY = pytest.mark.parametrize("every", [500, *long(137)])


def renamed(path: Path) -> Path:
    """Rename a folder."""
    return path.rename(path.with_name(f"renamed{path.suffix}"))


def elsewhere(path: Path) -> Path:
    """Move it to another folder, and delete the one that it was in."""
    (folder := path.parent.with_name("other")).mkdir()
    place = path.rename(folder / path.name)
    path.parent.rmdir()
    return place


def replaced_by_another(path: Path) -> Path:
    """Rename it, and put another folder there that looks like it."""
    shutil.copytree(place := renamed(path), path)
    return place


MOVES: dict[str, Callable[[Path], Path]] = {
    "itself": renamed,
    "parent": lambda path: renamed(path.parent) / path.name,
    "elsewhere": elsewhere,
    "replaced by another": replaced_by_another,
    "itself and parent": lambda path: renamed(renamed(path).parent) / "renamed.zarr",
}
"""What is done to the folder of a recording, and where the recording lies then."""


def write(path: Path, then: Callable[[int], object] = lambda _: None) -> Path:
    """Write a whole recording, do something after each frame, and return where it lies."""
    file = begun(path, chunk=3)
    for number in range(FRAMES):
        file.note(Note.READING, "plate", number / 100, number)
        for band in BANDS:
            file.frame(band, shot(number))
        then(number)
    file.close(complete=True, ended="stopped")
    return file.recording.place()


def moments(tmp_path: Path, every: int, case: int) -> range:
    """Every so many-th file operation of a recording since it was begun, others in each case."""
    start = operations_of(lambda: begun(tmp_path / "a.zarr", chunk=3))
    return range(start + 1 + 30 * case, operations_of(lambda: write(tmp_path / "b.zarr")), every)


@EVERY
@pytest.mark.parametrize(("case", "name"), [*enumerate(MOVES)])
def test_moved_at_any_operation_it_goes_on(
    tmp_path: Path, case: int, name: str, every: int
) -> None:
    """Moved before any file operation, the recording is whole at its new place, and says so."""
    move, noted = MOVES[name], 0
    for moment in (chosen := moments(tmp_path, every, case)):
        path, places = tmp_path / f"{moment}" / "deep" / "a.zarr", list[Path]()
        path.parent.mkdir(parents=True)

        def act(to: list[Path] = places, at: Path = path) -> None:
            to.append(move(at))

        with before_operation(moment, act):
            place = write(path)
        assert [place] == places
        opened = store.open_dataset(place)
        assert opened.attrs["frames_written"] == dict.fromkeys(BANDS, FRAMES)
        assert (opened.attrs["closed"], opened.attrs["complete"]) == (True, True)
        check(opened, 2 * [FRAMES])
        readings = [value for _, kind, _, value in notes(place) if kind == "reading"]
        np.testing.assert_array_equal(readings, np.arange(FRAMES))
        assert path.exists() == (name == "replaced by another")
        noted += "folder_moved" in [note[1] for note in notes(place)]
        shutil.rmtree(tmp_path / f"{moment}")
    assert noted >= 0.6 * len(chosen)  # the last operations, of closing, come after the last note


def copied(path: Path) -> Path:
    """Copy a folder, as to another disk, and delete it; the copy."""
    shutil.copytree(path, copy := path.parent.with_name(f"{path.parent.name}-copy"))
    shutil.rmtree(path)
    return copy


LOSSES: dict[str, Callable[[Path], object]] = {
    "deleted": shutil.rmtree,
    "carried off": copied,
    "array moved": lambda path: (path / "counts").rename(path / "old"),
    "array replaced": lambda path: copied(path / "counts").rename(path / "counts"),
}
"""What is done to the folder of a recording, or to that of an array in it."""


@EVERY
@pytest.mark.parametrize(("case", "name"), [*enumerate(LOSSES)])
def test_without_a_part_it_ends(tmp_path: Path, case: int, name: str, every: int) -> None:
    """Without its folder, or an array's, a recording ends with its name, and makes no other."""
    said = "No array 'counts'" if "array" in name else r"a\.zarr"
    for moment in moments(tmp_path, every, case):
        path = tmp_path / f"{moment}" / "a.zarr"
        path.parent.mkdir()
        lose = partial(LOSSES[name], path)
        with pytest.raises(OSError, match=said), before_operation(moment, lose):
            write(path)
        if name == "array moved":
            shutil.rmtree(path / "counts", ignore_errors=True)  # of a chunk that is not valid
            (path / "old").rename(path / "counts")
        if name == "deleted":
            assert not path.exists()
        elif name != "carried off":  # a copy of a moment is whole or refused, by its checksums
            opened = store.open_dataset(path)
            assert opened.attrs["complete"] is False
            check(opened, 2 * [opened.sizes["time"]])


@pytest.mark.parametrize(
    "piece", ["counts/c/0/0", "counts/c", "exposure_time/c/0/1", "log_time/c/0"]
)
def test_without_a_chunk_it_is_not_complete(tmp_path: Path, piece: str) -> None:
    """Chunks that are deleted while it is written are missed by name, and never filled up."""
    gone = (path := tmp_path / "a.zarr") / piece

    def lose(number: int) -> None:
        if number == 8:
            shutil.rmtree(gone) if gone.is_dir() else gone.unlink()

    assert_raises(FileNotFoundError, rf"{piece}.*'", write, path, lose)
    assert_refused(f"Missing file '{piece}", store.open_dataset, path)


def test_a_recorder_follows_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Moved while it records, by a relative path that leads elsewhere since, it goes on."""
    (tmp_path / "a").mkdir()
    monkeypatch.chdir(tmp_path / "a")

    def move(shown: Preview) -> None:
        if shown.totals[BANDS[0]]["frames"] > 10 and Path("b.zarr").exists():
            Path("b.zarr").rename(tmp_path / "c.zarr")
            monkeypatch.chdir(tmp_path)

    summary = record(session(0.4), bench(), "b.zarr", limits=SMALL, preview=move)
    assert (summary.path, summary.ended) == (tmp_path / "c.zarr", "duration")
    opened = store.open_dataset(summary.path)
    for band, place in zip(BANDS, opened["sequence"].values, strict=True):
        numbers = place[: summary.totals[band]["frames"]]
        np.testing.assert_array_equal(np.diff(numbers), 1)
        assert numbers.size > 30
    assert list(tmp_path.glob("**/*.zarr")) == [summary.path]


def test_a_folder_that_is_moved_while_it_is_looked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Moved just after its new place was read, it is found at the next one."""
    (tmp_path / "a").mkdir()
    folder, places = store.HeldFolder(tmp_path / "a"), [tmp_path / name for name in "abcd"]
    read = os.path.realpath

    def moving(path: Path) -> str:
        place = read(path)
        if len(places) > 1:
            places.pop(0).rename(places[0])
        return place

    monkeypatch.setattr(os.path, "realpath", moving)
    assert folder.place() == tmp_path / "d"
    (tmp_path / "d").rmdir()
    assert_raises(FileNotFoundError, "was deleted", folder.place)


def test_a_sweep_follows_its_folder(tmp_path: Path) -> None:
    """The folder of a sweep, renamed on the way, has all its recordings; the old one is gone."""
    before, after = tmp_path / "before", tmp_path / "after"

    def move(_: Preview) -> None:
        if (before / "plate_00_11.zarr").exists():
            before.rename(after)

    with rig(from_yaml(TWO), prepared=True) as devices:
        steps = swept(devices, before, preview=move)
    assert [step.path.parent for step in steps] == [before, after, after, after]
    assert open_sweep(after, "plate", frames=5).sizes["temperature"] == 2
    assert not before.exists()
