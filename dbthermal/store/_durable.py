"""What is on the disk, and not only in its cache, when it must be.

A file system may write names and contents in any order: a file that took the place of another may
come back from a power loss with its new name and without its content. So the new content is brought
to the disk first, then it takes the place, then the folder that holds the name is brought there.
"""

import asyncio
import os
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from zarr.core.buffer import Buffer
from zarr.storage import LocalStore

_THREADS: Final = 8


class DurableStore(LocalStore):
    """
    A zarr store in a folder, in which nothing valid is lost while it is replaced.

    Files that are new are written as `LocalStore` does, and are to be brought to the disk by
    `tree_to_disk`; to do so for many at once takes the time of one.
    """

    def set_sync(self, key: str, value: Buffer) -> None:
        """
        Write a value.

        Parameters
        ----------
        key : str
            Relative name of the file.
        value : Buffer
            Its content.

        Raises
        ------
        OSError
            If it cannot be written; what was there stays.
        """
        path = self.root / key
        if path.exists():
            replace(path, value.to_bytes(), path.with_name(f".{path.name}.part"))
        else:
            super().set_sync(key, value)

    async def set(self, key: str, value: Buffer) -> None:
        """
        Write a value; see `set_sync`.

        Parameters
        ----------
        key : str
            Relative name of the file.
        value : Buffer
            Its content.
        """
        await asyncio.to_thread(self.set_sync, key, value)


def replace(path: Path, content: bytes, part: Path) -> None:
    """
    Replace a file in one step: before and after a power loss it is the one or the other.

    Parameters
    ----------
    path : Path
        File.
    content : bytes
        What is to be in it.
    part : Path
        Where to write meanwhile, on the same file system.

    Raises
    ------
    OSError
        If it cannot be written; what was there stays, and nothing beside it.
    """
    try:
        part.write_bytes(content)
        to_disk([part])
        part.replace(path)
    except OSError:
        part.unlink(missing_ok=True)
        raise
    to_disk([path.parent])


@contextmanager
def made_beside(path: Path, folder: Path) -> Iterator[Path]:
    """
    Make a folder elsewhere, and put it in its place when it is whole and on the disk.

    Parameters
    ----------
    path : Path
        Where it is to be; nothing is there.
    folder : Path
        Where to make it, on the same file system; what a kill leaves there is hidden.

    Yields
    ------
    Path
        The folder to make.
    """
    with TemporaryDirectory(prefix=f".{path.name}-", dir=folder) as place:
        part = Path(place) / path.name
        yield part
        tree_to_disk([part], part)
        part.rename(path)
    to_disk([path.parent])


def to_disk(paths: Iterable[Path]) -> None:
    """
    Wait until files and folders are on the disk, and not only in its cache.

    They are asked for at the same time, for a file system then writes its journal once.

    Parameters
    ----------
    paths : iterable of Path
        Files and folders.
    """
    with ThreadPoolExecutor(_THREADS) as pool:
        list(pool.map(_to_disk, paths))


def tree_to_disk(places: Iterable[Path], root: Path) -> None:
    """
    Bring files, what is in folders, and all the folders on the way to them to the disk.

    Parameters
    ----------
    places : iterable of Path
        Files and folders in `root`.
    root : Path
        Folder that holds all of them; it is brought to the disk too.
    """
    wanted = {path for place in places for path in (place, *place.rglob("*"))}
    folders = {folder for path in wanted for folder in path.parents if folder.is_relative_to(root)}
    to_disk(wanted | folders)


def _to_disk(path: Path) -> None:
    file = os.open(path, os.O_RDONLY)
    try:
        os.fsync(file)
    finally:
        os.close(file)
