"""Files and folders that appear whole under their names, and belong to one process meanwhile.

What is written lies in a hidden folder beside its place until it is whole and on the disk; then it
is renamed. A file system may write names and contents in any order: after a power loss a renamed
file may have its new name and no content. So the new content is synced first, then it is renamed,
then the folder that holds the name is synced.
"""

import errno
import os
import platform
import re
import shutil
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from dbthermal import _text as texts
from dbthermal.store._integrity import SUMS
from dbthermal.store._signals import raised_signals

try:
    import fcntl
except ImportError:  # Windows: there two processes may write to one place
    fcntl = None  # type: ignore[assignment]

_THREADS: Final = 8
_LOOKS: Final = 100  # for a folder, which its holder may remove between its making and its locking
_HOLDER: Final = ".holder"  # file that is locked, and names its process
_CUT: Final = re.compile(r"\d+ requested and \d+ written")  # NumPy's words for a full disk
_LOCKED: Final[set[int]] = set()  # descriptors of locked files, of this process


def _leave_to_parent() -> None:
    """Close locked files in a process that was forked: a lock must die with its holder."""
    while _LOCKED:
        os.close(_LOCKED.pop())


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_leave_to_parent)


def check_place(path: str | Path, suffix: str) -> Path:
    """Refuse the path of a file or folder of another end than this, or inside a store."""
    path = texts.as_path(path)
    if path.suffix != suffix:
        raise ValueError(f"Invalid path '{path}'. Must end in '{suffix}'.")
    if path.is_dir() and not (path / SUMS).is_file() and any(path.iterdir()):
        rule = "Must be a store of dbthermal, which is replaced, an empty folder, or none"
        raise ValueError(f"Foreign folder '{path}'. {rule}: delete it if it is not needed.")
    for folder in path.resolve().parents:
        if (folder / SUMS).is_file():
            raise ValueError(f"Invalid path '{path}', inside a store. Must be outside '{folder}'.")
    return path


@contextmanager
def whole(path: str | Path, suffix: str) -> Iterator[Path]:
    """Yield a place beside `path` to write to, which becomes `path` unless an error is raised.

    SIGTERM and SIGHUP are raised meanwhile (`raised_signals`), so that nothing is left behind. What
    a killed process left is removed by the next that writes to `path`.

    Parameters
    ----------
    path : str or Path
        File or folder that is to be whole, or as it was. Its parents are made; ValueError if one
        is a store, which would then be another than was written. BlockingIOError while another
        process writes to it; OSError, with the path, if it cannot be written.
    suffix : str
        End of its name; ValueError for another one.
    """
    path = check_place(path, suffix)
    folder = path.with_name(f".{path.name}.draft")
    draft, replaced = folder / path.name, folder / "replaced"
    with raised_signals(), _reasons(path, folder), held(folder, path):
        _remove_remains(folder, path)
        try:
            yield draft
            tree_to_disk([draft], folder)
            if path.is_dir():  # a folder cannot be renamed onto another
                path.rename(replaced)
            draft.replace(path)
            to_disk([path.parent])
        finally:
            _remove_remains(folder, path)
            # Interrupted, zarr's threads may still write: what stays hides no interrupt.
            shutil.rmtree(folder, ignore_errors=True)


def _remove_remains(folder: Path, path: Path) -> None:
    """Put an earlier result back, if no new one has come to its place; remove all else."""
    with suppress(OSError):
        if not path.exists():
            (folder / "replaced").rename(path)
    for place in folder.iterdir() if folder.is_dir() else ():
        if place.is_dir() and not place.is_symlink():
            shutil.rmtree(place, ignore_errors=True)
        elif place.name != _HOLDER:
            place.unlink(missing_ok=True)


@contextmanager
def _reasons(path: Path, folder: Path) -> Iterator[None]:
    """Name the output, and what it needs, in an error of the system while it is written."""
    try:
        yield
    except OSError as error:
        place = Path(str(error.filename or folder))
        related = place.is_relative_to(folder) or folder.is_relative_to(place)
        if not related or not (error.errno or _CUT.search(str(error))):
            raise
        room = next(parent for parent in path.absolute().parents if parent.is_dir())
        failed = type(error)(
            f"Output '{path}' is not written: {error.strerror or os.strerror(errno.ENOSPC)}. Must "
            "be in a folder that can be written to, on a disk with room: "
            f"{shutil.disk_usage(room).free / 1e6:.3g} MB are free."
        )
        failed.errno = error.errno
        raise failed from error


@contextmanager
def held(folder: Path, path: Path) -> Iterator[None]:
    """Hold a folder for this process alone, while a block lasts.

    The system's lock dies with the process, however that ends, so that what a dead one left can be
    held anew. On a disk without locks nothing is held.

    Parameters
    ----------
    folder, path : Path
        Folder, which is made if it is missing; what it is for, as an error names it:
        BlockingIOError if another process holds it, with that process.
    """
    number = _lock(folder, path)
    try:
        yield
    finally:
        if number in _LOCKED:
            _LOCKED.remove(number)
            os.close(number)


def _lock(folder: Path, path: Path) -> int:
    """Descriptor of the locked file in a folder."""
    file = folder / _HOLDER
    for _ in range(_LOOKS):
        folder.mkdir(parents=True, exist_ok=True)
        if folder.is_symlink():
            raise ValueError(f"Invalid folder '{folder}', a link. Must be a folder: delete it.")
        with suppress(FileNotFoundError):  # removed by its holder
            number = os.open(file, os.O_RDWR | os.O_CREAT, 0o666)
            try:
                _lock_file(number, path)
                if os.path.samestat(os.fstat(number), file.stat()):
                    _LOCKED.add(number)
                    return number
            finally:
                if number not in _LOCKED:
                    os.close(number)
    raise BlockingIOError(f"Busy output '{path}'. Must be written by one process at a time.")


def _lock_file(number: int, path: Path) -> None:
    """Lock an open file, and write the name of this process into it."""
    try:
        if fcntl:
            fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        holder = os.read(number, 200).decode(errors="replace") or "another process"
        raise BlockingIOError(
            f"Busy output '{path}': {holder} writes to it. Must end first, or another output be "
            "named."
        ) from error
    except OSError:  # a disk that knows no locks
        return
    os.ftruncate(number, 0)
    os.write(number, f"process {os.getpid()} on {platform.node()}".encode())


def replace(path: Path, content: bytes, before: Iterable[Path] = ()) -> None:
    """Replace a file in one step: a power loss leaves the old content or the new one.

    The new content is written beside it first. If that fails, the old file stays, and nothing
    beside it. The files `before` are brought to the disk with it.
    """
    draft = path.with_name(f".{path.name}.part")
    try:
        draft.write_bytes(content)
        to_disk([draft, *before])
        draft.replace(path)
    except OSError:
        draft.unlink(missing_ok=True)
        raise
    to_disk([path.parent])


def to_disk(paths: Iterable[Path]) -> None:
    """Wait until files and folders are on the disk, and not only in its cache.

    All are synced at the same time, for a file system then writes its journal once.

    Parameters
    ----------
    paths : iterable of Path
        Files and folders (OSError if one cannot be synced); not what is in these.
    """
    with ThreadPoolExecutor(_THREADS) as pool:
        list(pool.map(_to_disk, paths))


def tree_to_disk(places: Iterable[Path], root: Path) -> None:
    """Bring files, the contents of folders, and all their parents up to `root` to the disk."""
    wanted = {path for place in places for path in (place, *place.rglob("*"))}
    folders = {folder for path in wanted for folder in path.parents if folder.is_relative_to(root)}
    to_disk(wanted | folders)


def _to_disk(path: Path) -> None:
    if os.name == "nt":  # which syncs no file that is only read, and no folder
        return
    file = os.open(path, os.O_RDONLY)
    try:
        os.fsync(file)
    except OSError as error:
        if error.errno not in {errno.EINVAL, errno.ENOTSUP}:  # of disks that sync no folder
            raise
    finally:
        os.close(file)
