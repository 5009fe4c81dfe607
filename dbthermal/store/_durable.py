"""Files and folders that survive a power loss: written, then synced, then renamed.

A file system may write names and contents in any order: after a power loss a renamed file may have
its new name and no content. So the new content is synced first, then it is renamed, then the folder
that holds the name is synced.
"""

import errno
import os
import weakref
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from zarr.core.buffer import Buffer

from dbthermal.store._integrity import SummedStore, add_sums

_THREADS: Final = 8


class HeldFolder:
    """A folder held by its descriptor, wherever it is renamed or moved on its disk.

    Parameters
    ----------
    folder, path : Path
        That exists (OSError otherwise); where it will be moved next, if that is another place.

    Attributes
    ----------
    root, close : Path, callable
        Leads into it, wherever it is; without a /proc, as on macOS, its path. Lets it go.
    """

    def __init__(self, folder: Path, path: Path | None = None) -> None:
        self._path, self._descriptor = path or folder, os.open(folder, os.O_RDONLY)
        self.close = weakref.finalize(self, os.close, self._descriptor)
        self._link = Path(f"/proc/self/fd/{self._descriptor}")
        self.root = self._link if self._link.exists() else self._path.absolute()

    def place(self) -> Path:
        """Path at which the folder lies now: FileNotFoundError if it was deleted."""
        paths = (self._path, Path(os.path.realpath(self._link)))
        for path in paths:
            with suppress(OSError):
                if os.path.samestat(os.fstat(self._descriptor), path.stat()):
                    return path
        raise FileNotFoundError(
            f"No folder '{paths[0]}' any more: it was deleted, replaced or taken to another disk. "
            "Must stay while it is written to."
        )


class DurableStore(SummedStore):
    """Zarr store in a folder in which an existing file is replaced in one step.

    New files are brought to the disk by `tree_to_disk`, for many at once take the time of one.
    """

    def __init__(self, root: Path, *, read_only: bool = False) -> None:
        super().__init__(root, read_only=read_only)
        self._written: set[str] = set()

    def set_sync(self, key: str, value: Buffer) -> None:
        """Write a file by its relative name; if that fails, the old one stays, if it is there."""
        path = self.root / key
        if path.exists():
            self.replace(key, value.to_bytes(), path.with_name(f".{path.name}.part"))
        elif key in self._written:
            raise FileNotFoundError(errno.ENOENT, "Deleted while it was written to", str(path))
        else:
            super().set_sync(key, value)
        self._written.add(key)

    def replace(self, key: str, content: bytes, part: Path) -> None:
        """Replace a file by its relative name, when its checksum is on the disk; see `replace`."""
        replace(self.root / key, content, part, before=[add_sums(self.root, {key: content})])


def replace(path: Path, content: bytes, part: Path, before: Iterable[Path] = ()) -> None:
    """Replace a file in one step: a power loss leaves the old content or the new one.

    The new content is written to `part`, on the same file system. If that fails, the old file
    stays, and nothing beside it. The files `before` are brought to the disk with it.
    """
    try:
        part.write_bytes(content)
        to_disk([part, *before])
        part.replace(path)
    except OSError:
        part.unlink(missing_ok=True)
        raise
    to_disk([path.parent])


@contextmanager
def made_beside(path: Path) -> Iterator[Path]:
    """Yield a folder to make beside `path`; move it there when it is complete and on the disk."""
    # Interrupted, zarr's threads may still write there: what then stays hides no interrupt.
    with TemporaryDirectory(
        prefix=f".{path.name}-", dir=path.parent, ignore_cleanup_errors=True
    ) as place:
        part = Path(place) / path.name
        yield part
        tree_to_disk([part], part)
        part.rename(path)
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
    file = os.open(path, os.O_RDONLY)
    try:
        os.fsync(file)
    finally:
        os.close(file)
