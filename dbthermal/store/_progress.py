"""How far a store that is being written has come, as it says itself."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from dbthermal.store._durable import replace

GROUP: Final = "zarr.json"
"""File of a zarr group's attributes."""


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


def valid_part(attrs: Mapping[str, Any]) -> dict[str, slice]:
    """
    How much of each growing dim is valid in a recording that was cut short.

    Parameters
    ----------
    attrs : mapping
        Its attributes.

    Returns
    -------
    dict
        For `time` the frames that all bands have, for `log` its rows.
    """
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
    OSError
        If they cannot be written; what was there stays.
    TypeError, ValueError
        If they are no JSON; what was there stays.
    """
    content = {"zarr_format": 3, "node_type": "group", "attributes": dict(attrs)}
    text = json.dumps(content, allow_nan=False)
    # Beside the store: what a kill leaves of it is no part of the store.
    replace(path / GROUP, text.encode(), path.parent / f".{path.name}.part")
