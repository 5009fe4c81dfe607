"""How far a store that is being written has come, as it says itself."""

import json
import os
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final

GROUP: Final = "zarr.json"
"""File of a zarr group's attributes."""

_THREADS: Final = 8


def attributes(path: str | Path) -> dict[str, Any]:
    """
    Attributes of a store, without a look at its arrays.

    Parameters
    ----------
    path : str or Path
        Folder ``*.zarr``.

    Returns
    -------
    dict
        As they are on the disk.
    """
    content = json.loads((Path(path) / GROUP).read_text(encoding="utf-8"))
    return dict(content.get("attributes", {}))


def valid_part(path: str | Path) -> dict[str, slice]:
    """
    How much of each growing dim is valid in a recording that was cut short.

    Parameters
    ----------
    path : str or Path
        Folder ``*.zarr``.

    Returns
    -------
    dict
        For `time` the frames that all bands have, for `log` its rows.
    """
    attrs = attributes(path)
    frames = min(attrs["frames_written"].values())
    return {"time": slice(0, frames), "log": slice(0, attrs["log_written"])}


def write_attributes(path: Path, attrs: Mapping[str, Any]) -> None:
    """
    Replace the attributes of a store in one step, on the disk too.

    Parameters
    ----------
    path : Path
        Folder ``*.zarr``.
    attrs : mapping
        All its attributes, JSON with finite numbers.

    Raises
    ------
    TypeError, ValueError
        If they are no JSON; what was there stays.
    """
    content = {"zarr_format": 3, "node_type": "group", "attributes": dict(attrs)}
    text = json.dumps(content, allow_nan=False)
    # Beside the store: what a kill leaves of it is no part of the store.
    part = path.parent / f".{path.name}.part"
    part.write_text(text, encoding="utf-8")
    to_disk([part])
    part.replace(path / GROUP)
    to_disk([path])


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


def _to_disk(path: Path) -> None:
    file = os.open(path, os.O_RDONLY)
    try:
        os.fsync(file)
    finally:
        os.close(file)
