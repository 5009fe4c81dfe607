"""Rows of a dataset that several processes make, each whole in a folder of its own, and joined."""

import json
import os
import shutil
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import xarray as xr

from dbthermal.store._integrity import SUMS, last_sums, sums_file
from dbthermal.store._results import save_parts, whole


def save_part(
    part: xr.Dataset, path: str | Path, provenance: Mapping[str, Any], height: int
) -> None:
    """Save some rows of a dataset as `save` does, for `join_parts`.

    Parameters
    ----------
    part : Dataset
        Rows that follow one another.
    path : str or Path
        Folder ``*.zarr`` of its own.
    provenance : mapping
        See `save`.
    height : int
        Rows of each part but the last, which has no more.
    """
    save_parts([part], path, provenance, height)


def join_parts(parts: Iterable[str | Path], path: str | Path) -> None:
    """Join datasets of rows that follow one another; their chunks are linked, and not read.

    Parameters
    ----------
    parts : iterable of str or Path
        Folders from `save_part`, of one height but the last. They stay as they are; on a disk
        without hard links their chunks are copied.
    path : str or Path
        Folder ``*.zarr`` of the whole, with the attributes of the first.

    Examples
    --------
    >>> import xarray as xr
    >>> from tempfile import TemporaryDirectory
    >>> from dbthermal import store
    >>> rows = [xr.Dataset({"status": (("y", "x"), [[row, 0]])}) for row in range(3)]
    >>> with TemporaryDirectory() as folder:
    ...     parts = [f"{folder}/{number}.zarr" for number in range(3)]
    ...     for row, part in zip(rows, parts):
    ...         store.save_part(row, part, store.provenance({}), 1)
    ...     store.join_parts(parts, f"{folder}/wall.zarr")
    ...     store.open_dataset(f"{folder}/wall.zarr").status.values.tolist()
    [[0, 0], [1, 0], [2, 0]]
    """
    first, *rest = [Path(part) for part in parts]
    with whole(path, ".zarr") as folder:
        shutil.copytree(first, folder, copy_function=_link)
        metadata = {one: json.loads(one.read_text()) for one in folder.glob("*/zarr.json")}
        along = {one: array for one, array in metadata.items() if "y" in array["dimension_names"]}
        sums = last_sums(folder)
        for part in rest:
            for one, array in along.items():
                sums |= _added(part / one.parent.name, one.parent, array)
        for one, array in along.items():
            one.unlink()
            one.write_text(json.dumps(array, indent=2))
            sums[one.relative_to(folder).as_posix()] = f"{zlib.crc32(one.read_bytes()):08x}"
        (folder / SUMS).unlink()
        (folder / SUMS).write_bytes(sums_file(sums))


def _link(source: str | Path, target: str | Path) -> None:
    """Link a file at a second place; a kill then leaves the parts whole."""
    try:
        os.link(source, target)
    except OSError:  # a disk that knows no links
        shutil.copyfile(source, target)


def _added(part: Path, whole: Path, array: dict[str, Any]) -> dict[str, str]:
    """Add the chunks of a part of an array behind those of the whole; their checksums by name."""
    place = array["dimension_names"].index("y")
    end, rows = array["shape"][place], array["chunk_grid"]["configuration"]["chunk_shape"][place]
    own, sums = last_sums(part.parent), {}
    if end % rows:
        raise ValueError(
            f"Invalid part '{part.parent}' after {end} rows in chunks of {rows}. Must follow whole "
            "chunks."
        )
    for chunk in [one for one in (part / "c").rglob("*") if one.is_file()]:
        numbers = list(chunk.relative_to(part / "c").parts)
        numbers[place] = str(int(numbers[place]) + end // rows)
        added = whole.joinpath("c", *numbers)
        sums[added.relative_to(whole.parent).as_posix()] = own[
            chunk.relative_to(part.parent).as_posix()
        ]
        added.parent.mkdir(parents=True, exist_ok=True)
        _link(chunk, added)
    array["shape"][place] += json.loads((part / "zarr.json").read_text())["shape"][place]
    return sums
