"""Outputs that appear whole, and belong to one process while they are written."""

import errno
import os
import resource
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
import xarray as xr

from dbthermal import store
from dbthermal._arrays import empty, on_disk
from dbthermal.store import _whole

RANDOM = np.random.default_rng(1).random((40, 2**17))
WRITER = """
import os, signal, sys, time
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # which nohup ignores
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored behind a shell
from dbthermal import store
with store.whole(sys.argv[1], ".md") as draft:
    draft.write_text("half")
    if sys.argv[2] == "fork" and os.fork():
        time.sleep(600)
    print("writing", flush=True)
    time.sleep(600)
"""


@contextmanager
def writer(path: Path, way: str = "") -> Iterator[subprocess.Popen[str]]:
    """Process that has begun to write an output, and does not end."""
    command = [sys.executable, "-c", WRITER, str(path), way]
    pipe: Any = {"stdout": subprocess.PIPE, "text": True, "start_new_session": True}
    with subprocess.Popen(command, **pipe) as process:
        assert process.stdout is not None
        try:
            assert process.stdout.readline() == "writing\n"
            yield process
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


def names(folder: Path) -> list[str]:
    """Names in a folder, the hidden ones too."""
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("way", ["", "fork"])
def test_a_place_belongs_to_one_process(tmp_path: Path, way: str) -> None:
    """The second is told the first; killed, that leaves nothing behind the next, nor in a fork."""
    path = tmp_path / "a.md"
    store.save_text("earlier", path, {})
    with writer(path, way) as process:
        with pytest.raises(BlockingIOError, match=rf"Busy output '{path}': process {process.pid} "):
            store.save_text("later", path, {})
        process.kill()
        process.wait()
        assert path.read_text().startswith("earlier")
        assert names(tmp_path) == [".a.md.draft", "a.md"]
        store.save_text("later", path, {})
    assert path.read_text().startswith("later")
    assert names(tmp_path) == ["a.md"]


def test_two_threads_at_one_place(tmp_path: Path) -> None:
    """Each writes a draft of its own; one of them is there in the end, whole."""
    texts = [f"{number}" * 100 for number in range(8)]

    def save(text: str) -> None:
        for _ in range(5):
            with store.whole(tmp_path / "a.md", ".md") as draft:
                draft.write_text(text)

    with store.reserved(tmp_path / "a.md"):
        threads = [threading.Thread(target=save, args=(text,)) for text in texts]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert (tmp_path / "a.md").read_text() in texts
    assert names(tmp_path) == ["a.md"]


def test_an_earlier_store_comes_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between its two renames an error, or the next writer after a kill, puts it in its place."""
    path, first = tmp_path / "a.zarr", xr.Dataset({"counts": ("time", np.arange(3))})
    store.save(first, path, {})

    def interrupted(*_: Any) -> Path:
        raise KeyboardInterrupt

    def interrupt() -> None:
        with monkeypatch.context() as patch, store.whole(path, ".zarr") as draft:
            draft.mkdir()
            patch.setattr(Path, "replace", interrupted)

    with pytest.raises(KeyboardInterrupt):
        interrupt()
    assert names(tmp_path) == ["a.zarr"]
    (tmp_path / ".a.zarr.draft" / "draft-x").mkdir(parents=True)
    path.rename(tmp_path / ".a.zarr.draft" / "draft-x" / "replaced")
    with pytest.raises(ZeroDivisionError), store.reserved(path):
        raise ZeroDivisionError
    assert names(tmp_path) == ["a.zarr"]
    assert store.open_dataset(path)["counts"].equals(first["counts"])


def test_content_is_on_the_disk_before_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Files and folders of a result are synced, then renamed, then the folder of the name is."""
    done, sync, rename = list[str](), _whole._to_disk, Path.replace

    def synced(path: Path) -> None:
        done.append(path.name)
        sync(path)

    def renamed(path: Path, target: Path) -> Path:
        done.extend(["rename"] if target == tmp_path / "a.zarr" else [])
        return rename(path, target)

    monkeypatch.setattr(_whole, "_to_disk", synced)
    monkeypatch.setattr(Path, "replace", renamed)
    store.save(xr.Dataset({"counts": ("time", np.arange(3))}), tmp_path / "a.zarr", {})
    before, after = done[: done.index("rename")], done[done.index("rename") + 1 :]
    assert {"checksums.sfv", "zarr.json", "counts", "c", "0", "a.zarr"} <= set(before)
    assert after == [tmp_path.name]


@contextmanager
def file_limit(size: int) -> Iterator[None]:
    """Files of at most so many bytes, as on a disk that is full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def _films(path: Path) -> None:
    with on_disk(path.parent):
        empty((2**22,), "u1")


@pytest.mark.parametrize(
    "write",
    [
        lambda path: store.save(xr.Dataset({"a": (("t", "x"), RANDOM)}), path, {}),
        lambda path: tiff(path.with_suffix(".tif")),
        lambda path: store.save_text("a" * 2**21, path.with_suffix(".md"), {}),
        _films,
    ],
    ids=["store", "tiff", "text", "film"],
)
def test_a_full_disk(write: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """The output is named with what it needs; nothing is left, and no library says more."""
    rule = r"(Output '.*a\.\w+' is not written|No film of 4\.19 MB in '.*): .*\. Must .*room"
    for size, command in ((2**20, False), (2**20, True), (0, False)):
        with (
            file_limit(size),
            pytest.raises(OSError, match=rule),
            store.reserved(tmp_path / "a.zarr") if command else nullcontext(),
        ):
            write(tmp_path / "a.zarr")
        assert not names(tmp_path)
    assert capfd.readouterr() == ("", "")


def tiff(path: Path) -> None:
    """Write numbers that NumPy writes by itself."""
    with store.whole(path, ".tif") as draft:
        tifffile.imwrite(draft, RANDOM)


@pytest.mark.parametrize("code", [errno.EROFS, errno.EACCES, errno.EDQUOT])
def test_a_folder_that_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    """The output is named, not its draft; an error of an input stays as it is."""

    def refused(path: Path, *_: Any, **__: Any) -> None:
        raise OSError(code, os.strerror(code), str(path))

    with monkeypatch.context() as patch:
        patch.setattr(Path, "mkdir", refused)
        with pytest.raises(OSError, match=r"^Output '.*a\.md' is not written: .*\. Must") as found:
            store.save_text("a", tmp_path / "a.md", {})
    assert ".draft" not in str(found.value)
    with pytest.raises(FileNotFoundError, match="input"), store.whole(tmp_path / "a.md", ".md"):
        (tmp_path / "input").read_text()


def test_nothing_behind_a_link_is_removed(tmp_path: Path) -> None:
    """A link, or a file of the user, at the place of the drafts is kept, and all in it."""
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "draft-1").mkdir()
    (tmp_path / ".a.md.draft").symlink_to("mine")
    with pytest.raises(ValueError, match=r"a link\. Must be a folder"):
        store.save_text("a", tmp_path / "a.md", {})
    assert names(tmp_path / "mine") == ["draft-1"]
    (tmp_path / ".a.md.draft").unlink()
    (tmp_path / ".a.md.draft" / "mine").mkdir(parents=True)
    store.save_text("a", tmp_path / "a.md", {})
    assert names(tmp_path) == [".a.md.draft", "a.md", "mine"]
