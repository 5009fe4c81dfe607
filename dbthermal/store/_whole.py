"""Files and folders that appear whole under their names, and belong to one process meanwhile.

Output lies in a hidden folder beside its place until it is whole and synced to the disk; then it is
renamed, and its folder synced: a power loss leaves no name without content. Signals that end the
program are raised as errors, so that the writing ends first.
"""

import errno
import os
import platform
import shutil
import signal
import threading
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import Any, Final

from dbthermal import _text as texts
from dbthermal.store._integrity import SUMS

try:
    import fcntl
except ImportError:  # Windows: there two processes may write to one place
    fcntl = None  # type: ignore[assignment]

_THREADS: Final = 8
_BUSY: Final = "Busy output '{}': {} writes to it. Must end first, or another output be named."
_STATUS: Final = 128  # exit status of a shell's program that a signal ended, less its number
_ENDING: Final = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
_REPLACED: Final = "replaced"  # an earlier result, until the new one has its name
_LOCKED: Final[set[int]] = set()  # open locks, which a fork must not inherit: they end with us


def _leave_to_parent() -> None:
    while _LOCKED:
        os.close(_LOCKED.pop())


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_leave_to_parent)


def check_place(path: str | Path, suffix: str) -> Path:
    """Path of an output; refuses another suffix, a link, foreign content, a place in a store."""
    path = texts.as_path(path)
    if path.suffix != suffix:
        raise ValueError(f"Invalid path '{path}'. Must end in '{suffix}', after a name.")
    if path.is_symlink():  # which would be replaced, and not what it leads to
        raise ValueError(f"Invalid path '{path}', a link. Must be '{path.readlink()}' itself.")
    foreign = path.is_dir() and not (path / SUMS).is_file() and any(path.iterdir())
    if foreign or (suffix == ".zarr" and path.is_file()):
        rule = "Must be a store of dbthermal, an empty folder, or none: delete what is not needed"
        raise ValueError(f"Foreign {'folder' if foreign else 'file'} '{path}'. {rule}.")
    if path.is_dir() and os.name != "nt":
        folder = os.open(path, os.O_RDONLY)
        try:
            if not take(folder, shared=True):
                raise BlockingIOError(_BUSY.format(path, "a recording"))
        finally:
            os.close(folder)
    for parent in path.resolve().parents:
        if (parent / SUMS).is_file():
            raise ValueError(f"Invalid path '{path}', inside a store. Must be outside '{parent}'.")
    return path


@contextmanager
def whole(path: str | Path, suffix: str) -> Iterator[Path]:
    """Yield a place beside `path` to write to, which becomes `path` unless an error is raised.

    Parameters
    ----------
    path : str or Path
        File or folder that is to be whole, or as it was; ValueError if a parent is a store, which
        would then be another than was written. For other errors see `reserved`.
    suffix : str
        End of its name; ValueError for another one.
    """
    path = check_place(path, suffix)
    # Interrupted, zarr's threads may still write there: what then stays hides no interrupt.
    with (
        reserved(path) as folder,
        TemporaryDirectory(prefix="draft-", dir=folder, ignore_cleanup_errors=True) as place,
    ):
        draft = Path(place) / path.name
        yield draft
        tree_to_disk([draft], draft.parent)
        try:
            if path.is_dir():  # a folder cannot be renamed onto another
                path.rename(draft.with_name(_REPLACED))
            draft.replace(path)
        finally:
            _restore(draft.parent, path)
        to_disk([path.parent])


@contextmanager
def reserved(path: str | Path) -> Iterator[Path]:
    """Reserve the place of an output for this process, and yield a hidden folder beside it.

    The system's lock dies with its process, however that ends: what a dead one left is removed by
    the next that writes to `path`. SIGTERM and SIGHUP are raised meanwhile (`raised_signals`), so
    that nothing is left. On a disk without locks nothing is reserved.

    Parameters
    ----------
    path : str or Path
        File or folder, whose parents are made. BlockingIOError while another process has it, with
        that process; OSError, with what it needs, if it cannot be written.
    """
    path = texts.as_path(path).absolute()
    folder = path.with_name(f".{path.name}.draft")
    lock = None
    with raised_signals(), _reasons(path, folder):
        try:
            with raised_signals(deferred=True):
                if (lock := _lock(folder, path)) is not None:  # else locked by this process
                    _remove_remains(folder, path)
            yield folder
        finally:
            if lock in _LOCKED:  # not in a fork
                with raised_signals(deferred=True):
                    _remove_remains(folder, path)
                    _remove_holder(folder)
                    _LOCKED.remove(lock)
                    os.close(lock)


def _restore(place: Path, path: Path) -> None:
    """Put an earlier result back, if no new result has taken its place."""
    with suppress(OSError):
        if not path.exists():
            (place / _REPLACED).rename(path)


def _remove_remains(folder: Path, path: Path) -> None:
    """Remove drafts, and nothing else, from a folder."""
    for place in folder.glob("draft-*"):
        _restore(place, path)
        shutil.rmtree(place, ignore_errors=True)


def _lock(folder: Path, path: Path) -> int | None:
    """Lock a file in a folder, which names this process; None if this process has done so."""
    name, file = f"process {os.getpid()} on {platform.node()}", folder / "holder"
    while True:  # its holder may remove the file before it is locked
        folder.mkdir(parents=True, exist_ok=True)
        if folder.is_symlink():  # to a folder in which nothing may be removed
            raise ValueError(f"Invalid folder '{folder}', a link. Must be a folder: delete it.")
        with suppress(FileNotFoundError):
            lock = os.open(file, os.O_RDWR | os.O_CREAT, 0o666)
            try:
                if not take(lock):
                    holder = os.read(lock, 200).decode(errors="replace") or "another process"
                    if holder == name:
                        return None
                    raise BlockingIOError(_BUSY.format(path, holder))
                if os.path.samestat(os.fstat(lock), file.stat()):
                    with suppress(OSError):
                        os.ftruncate(lock, 0)
                    try:
                        os.write(lock, name.encode())
                    except OSError:  # no room
                        _remove_holder(folder)
                        raise
                    _LOCKED.add(lock)
                    return lock
            finally:
                if lock not in _LOCKED:
                    os.close(lock)


def _remove_holder(folder: Path) -> None:
    """Remove the file that names the holder of a folder, and the folder if it is empty."""
    with suppress(OSError):
        (folder / "holder").unlink()
        folder.rmdir()


def take(descriptor: int, *, shared: bool = False) -> bool:
    """Lock an open file or folder until it is closed; False if another process has done so."""
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except (AttributeError, OSError):  # a system, or a disk, that knows no locks
        pass
    return True


@contextmanager
def _reasons(path: Path, folder: Path) -> Iterator[None]:
    """Name the output, and what it needs, in an error of the system while it is written."""
    try:
        yield
    except OSError as error:
        place = Path(str(error.filename or folder)).absolute()
        related = place.is_relative_to(folder) or folder.is_relative_to(place)
        if not related or not (error.errno or " requested and " in str(error)):  # NumPy's words
            raise
        reason = error.strerror or os.strerror(errno.ENOSPC)
        room = next(parent for parent in folder.parents if parent.is_dir())
        raise type(error)(
            f"Output '{path}' is not written: {reason}. Must be in a folder that can be written "
            f"to, with room: {shutil.disk_usage(room).free / 1e6:.3g} MB are free."
        ) from error


def replace(path: Path, content: bytes, before: Iterable[Path] = ()) -> None:
    """Replace a file in one step, once `before` is on the disk; a power loss leaves old or new."""
    draft = path.with_name(f".{path.name}.part")
    try:
        draft.write_bytes(content)
        to_disk([draft, *before])
        draft.replace(path)
    except OSError:  # the old file stays, and nothing beside it
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


class SignalExit(SystemExit):
    """End of the program by a signal, with the exit status of a shell: 128 and its number.

    Parameters
    ----------
    number : int
        Of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(_STATUS + number)
        self.status, self.name = _STATUS + number, signal.Signals(number).name


@contextmanager
def raised_signals(*, deferred: bool = False) -> Iterator[None]:
    """Raise SIGTERM and SIGHUP as `SignalExit` in the main thread, while a block lasts.

    A closed terminal sends SIGHUP; ``kill``, a service manager and a shutdown send SIGTERM. The
    first signal is raised, those after it are ignored: what is being closed must be left to end. A
    signal that the program handles by itself or ignores, as under ``nohup``, stays so.

    Parameters
    ----------
    deferred : bool
        Whether signals, of those that the program handles too, come only when the block has ended.
    """
    previous: dict[int, Any] = {}
    raised: list[int] = []
    late: list[int] = []  # came while they are deferred, or while the handlers are put back

    def end(number: int, _: FrameType | None) -> None:
        if deferred:
            late.append(number)
        elif not raised:
            raised.append(number)
            raise SignalExit(number)

    try:
        # Only the main thread gets signals; signals that the program ignores stay ignored.
        if threading.current_thread() is threading.main_thread():
            for number in _ENDING:
                handler = signal.getsignal(number)
                if handler is signal.SIG_DFL or (deferred and callable(handler)):
                    previous[number] = signal.signal(number, end)
        yield
    finally:
        deferred = True
        for number, handler in previous.items():
            signal.signal(number, handler)
        for number in late if not raised else ():
            signal.raise_signal(number)
