"""Arrays of a recording: made before it is known how long they become, and grown along time."""

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import zarr
from zarr.codecs import BloscCodec

from dbthermal.schema import Variable

LOG_CHUNK: Final = 4096
"""Rows of a chunk of the log."""

_COMPRESSOR: Final = BloscCodec(cname="lz4", clevel=1, shuffle="bitshuffle")


def create(
    group: zarr.Group,
    name: str,
    variable: Variable,
    sizes: dict[str, int],
    *,
    fill: float | None = None,
) -> None:
    """
    Make an empty array, with room for one chunk of frames, or none of rows.

    Parameters
    ----------
    group : Group
        Of zarr.
    name : str
        Of the array.
    variable : Variable
        Of dims (band, time, ...) or (log,).
    sizes : dict
        Size of each dim; of `time` that of a chunk.
    fill : float, optional
        What it holds where nothing was written; NaN, or 0 in whole numbers.

    Raises
    ------
    ValueError
        If the variable has other dims.
    """
    if variable.dims[:2] != ("band", "time") and variable.dims != ("log",):
        raise ValueError(
            f"Invalid dims {variable.dims} of '{name}'. Must be ('band', 'time', ...) or ('log',)."
        )
    whole, chunks = {**sizes, "log": 0}, {**sizes, "band": 1, "log": LOG_CHUNK}
    nothing = math.nan if np.dtype(variable.dtype).kind == "f" else 0
    group.create_array(
        name,
        shape=tuple(whole[dim] for dim in variable.dims),
        chunks=tuple(chunks[dim] for dim in variable.dims),
        dtype=variable.dtype,
        compressors=_COMPRESSOR,
        fill_value=nothing if fill is None else fill,
        dimension_names=variable.dims,
        attributes=dict(variable.attrs),
    )


def create_text(group: zarr.Group, name: str, values: Sequence[str]) -> None:
    """
    Make an array of text along a dim of its own name.

    Parameters
    ----------
    group : Group
        Of zarr.
    name : str
        Of array and dim.
    values : sequence of str
        Its values.
    """
    array = group.create_array(name, shape=(len(values),), dtype=str, dimension_names=(name,))
    array[:] = np.array(values, dtype=np.dtypes.StringDType())


def dims(array: Any) -> tuple[str, ...]:
    """
    Name the dims of an array.

    Parameters
    ----------
    array : Array
        Of zarr.

    Returns
    -------
    tuple of str
        In their order.
    """
    return tuple(array.metadata.dimension_names)


def is_movie(array: Any) -> bool:
    """
    Tell whether an array grows by frames.

    Parameters
    ----------
    array : Array
        Of zarr.

    Returns
    -------
    bool
        True for dims (band, time, ...).
    """
    return dims(array)[:2] == ("band", "time")


def grow(array: Any, axis: int, size: int) -> None:
    """
    Make room, twice as much each time, so that the array's metadata are written seldom.

    Parameters
    ----------
    array : Array
        Of zarr.
    axis : int
        Along which it grows.
    size : int
        What it must hold [element].
    """
    if array.shape[axis] < size:
        chunk = array.chunks[axis]
        room = max(2 * array.shape[axis], math.ceil(size / chunk) * chunk)
        array.resize((*array.shape[:axis], room, *array.shape[axis + 1 :]))
