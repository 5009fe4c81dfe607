"""Datasets on disk as zarr: saved whole, or by rows, and opened; recordings opened too."""

import json
import math
import os
import re
import shutil
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr
import zarr
from zarr.codecs import BloscCodec, Crc32cCodec

from dbthermal import _text as texts
from dbthermal import schema
from dbthermal.store import _integrity as integrity
from dbthermal.store._results import as_json
from dbthermal.store._whole import whole

# Fast beside the writing, and smaller than Zstandard without a shuffle of bytes.
_COMPRESSORS = (BloscCodec(cname="lz4", clevel=1, shuffle="shuffle"), Crc32cCodec())
_CHUNK_BYTES: Final = 2**20  # of a full chunk, at least: below, a read costs more in files

_NAME: Final = re.compile(  # of a variable, a folder on any disk; spaces part coordinates
    r"(?!__|.{61}|(?i:con|prn|aux|nul|(com|lpt)\d)(\.|$))\w([\w.()+-]| (?=[\w(]))*(?<!\.)"
)
_RESERVED: Final = {integrity.GROUP, integrity.SUMS}

# Attributes by which other values would be opened than are saved.
_DECODED: Final = {"_FillValue", "missing_value", "scale_factor", "add_offset"} | {
    *("dtype", "_Unsigned", "calendar", "grid_mapping")
}


def _chunks(variable: xr.Variable | xr.DataArray, height: int | None = None) -> tuple[int, ...]:
    """Chunk sizes for a variable: pieces of rows, whole in every dimension but y and x."""
    # Every stage works pixel by pixel on all frames and bands, and reads rows of the image.
    sizes = {str(dim): max(1, size) for dim, size in variable.sizes.items()}
    sizes |= {"y": height} if height and "y" in sizes else {}
    if not {"y", "x"} <= sizes.keys():
        return tuple(sizes.values())
    # The fewest whole rows that have the bytes before compression, or equal pieces of one row.
    pixel_bytes = variable.dtype.itemsize * math.prod(sizes.values()) // (sizes["y"] * sizes["x"])
    pixels = math.ceil(_CHUNK_BYTES / pixel_bytes)
    width = math.ceil(sizes["x"] / max(1, sizes["x"] // pixels))
    rows = min(sizes["y"], math.ceil(pixels / width))
    # Chunks divide a height, so that the next block of rows begins one.
    if height:
        rows = next(count for count in range(rows, height + 1) if height % count == 0)
    return tuple((sizes | {"y": rows, "x": width}).values())


def save(dataset: xr.Dataset, path: str | Path, provenance: Mapping[str, Any]) -> None:
    """Save a dataset as zarr (format 3, not consolidated), in place of an earlier one.

    Parameters
    ----------
    dataset : Dataset
        Of any stage; it is not changed. TypeError for a DataArray and for values or attributes that
        zarr cannot hold, ValueError for attributes by which other values would be opened, such as
        `_FillValue`, `scale_factor` and times since a date.
    path, provenance : str or Path, mapping
        Folder ``*.zarr`` (ValueError if it has another suffix), whose parents are made; record from
        `dbthermal.store.provenance`, which becomes ``attrs["provenance"]``.

    Examples
    --------
    >>> import xarray as xr
    >>> from tempfile import TemporaryDirectory
    >>> from dbthermal import store
    >>> wall = xr.Dataset({"object_temperature": ("time", [295.2, 295.3], {"units": "K"})})
    >>> with TemporaryDirectory() as folder:
    ...     store.save(wall, f"{folder}/wall.zarr", store.provenance({"frames": 2}))
    ...     saved = store.open_dataset(f"{folder}/wall.zarr").load()
    >>> saved.equals(wall), saved.attrs["provenance"]["parameters"]
    (True, {'frames': 2})
    """
    schema.require(dataset, xr.Dataset, "dataset")
    _save([dataset], path, provenance)


def save_rows(
    blocks: Iterable[xr.Dataset],
    path: str | Path,
    provenance: Mapping[str, Any],
    height: int | None = None,
) -> None:
    """Save a dataset as `save` does, by blocks of rows from the first to the last.

    Parameters
    ----------
    blocks : iterable of Dataset
        Rows that follow one another, made when they are asked for: one block is held at a time.
        What has no y, and the attributes, are those of the first block. ValueError without a block,
        and for a block of other variables, coordinates or units.
    path, provenance : str or Path, mapping
        See `save`.
    height : int, optional
        Rows of each block, by default of the first; only the last block may have fewer.

    See the example of `join_parts`.
    """
    following = iter(blocks)
    if (first := next(following, None)) is None:
        raise ValueError(f"No rows to save as '{path}'. Must be at least one part.")
    if height is not None and (type(height) is not int or height < 1):
        raise ValueError(f"Invalid height {height!r} of the rows. Must be a whole number from 1.")
    _save(chain([first], following), path, provenance, height or first.sizes.get("y"))


def _save(
    blocks: Iterable[xr.Dataset], path: str | Path, provenance: Any, height: int | None = None
) -> None:
    """Save blocks of rows, of a height that chunks then divide."""
    schema.require(provenance, Mapping, "provenance")
    first, attrs = xr.Dataset(), {"provenance": json.loads(as_json(provenance))}
    with whole(path, ".zarr") as folder:
        folder.mkdir()
        for number, rows in enumerate(blocks):
            _check(rows)
            if number == 0:
                first = rows.isel(y=slice(0), missing_dims="ignore")
                attrs = {**integrity.MARK, **rows.attrs, **attrs}
            _check_same(rows, first, number)
            # Of all kinds of text zarr's format 3 specifies only that of variable length.
            plain = _with_text_as(rows.drop_encoding(), "U", np.dtypes.StringDType())
            plain.attrs = attrs  # each block has them, or zarr drops the store's attributes
            chunks = {n: _chunks(array, height) for n, array in plain.variables.items()}
            encoding = {n: {"chunks": c, "compressors": _COMPRESSORS} for n, c in chunks.items()}
            options: dict[str, Any] = {"mode": "w-", "encoding": encoding}
            if number > 0:
                options = {"mode": "a", "append_dim": "y"}
                lasting = [name for name in plain.variables if "y" not in plain[name].dims]
                plain = plain.drop_vars(lasting)
            # Arrays of dask are written in the chunks of the store.
            for name, array in plain.variables.items():
                if array.chunks:
                    plain[name] = array.chunk(dict(zip(array.dims, chunks[name], strict=True)))
            options |= {"zarr_format": 3, "consolidated": False, "write_empty_chunks": True}
            plain.to_zarr(integrity.SummedStore(folder), **options)
        (folder / integrity.SUMS).write_bytes(integrity.sums_file(integrity.last_sums(folder)))


def chunks_in_turn() -> AbstractContextManager[Any]:
    """Context in which chunks are read and written one after another, for a process of one core."""
    # There zarr's threads would wait for each other, for a fifth of the time of writing.
    context: AbstractContextManager[Any] = zarr.config.set({"async.concurrency": 1})
    return context


def _check(dataset: xr.Dataset) -> None:
    """Refuse values and attributes that zarr cannot hold, and attributes that decode values."""
    # Unit of the temperatures; attributes of the dataset and its variables.
    schema.check_kelvin(dataset)
    attributes = {f"'{name}'": variable.attrs for name, variable in dataset.variables.items()}
    for owner, attrs in {"the dataset": dataset.attrs, **attributes}.items():
        for key, value in attrs.items():
            if not isinstance(key, str):
                raise TypeError(f"Invalid attribute {key!r} of {owner}. Must have text as name.")
            decoded = key in _DECODED or (key == "units" and " since " in str(value))
            if (decoded and attrs is not dataset.attrs) or key == "coordinates":
                label = f"Invalid attribute '{key}' of {owner}"
                raise ValueError(f"{label}. Must be left out: values are kept as they are.")
            try:
                json.dumps(value, default=lambda element: element.tolist())  # what NumPy made
            except (AttributeError, TypeError) as error:
                label = f"Invalid attribute '{key}' of {owner}, of type {type(value).__name__}"
                raise TypeError(f"{label}. Must be text, numbers, or lists of these.") from error
    # Names and types of the variables; some disks tell no capitals apart.
    repeated = texts.repeated(str(name).lower() for name in dataset.variables)
    for name, variable in dataset.variables.items():
        listed = isinstance(name, str) and _NAME.fullmatch(name) and name not in _RESERVED
        listed = listed and str(name).lower() not in repeated
        if not listed or (" " in str(name) and name in dataset.coords):
            rule = "Must be at most 60 letters, digits, _ - + . ( ), or blanks unless of a "
            rule += "coordinate, of no device, and differ in more than capitals"
            raise ValueError(f"Invalid name {texts.shown(name)}. {rule}: a folder has it.")
        if not all(length >= 0 for length in variable.shape):  # NaN in arrays of dask
            rule = "Must have known sizes, as from compute_chunk_sizes() of dask"
            raise ValueError(f"Invalid shape {variable.shape} of '{name}'. {rule}.")
        real = variable.dtype.kind in "biuf" and variable.dtype.itemsize <= 8
        kinds = {*map(type, variable.values.flat)} if variable.dtype.kind == "O" else {object}
        text = all(issubclass(kind, str) for kind in kinds)
        if not (real or text or variable.dtype.kind in "UTMm"):
            rule = "Must be real numbers of at most 64 bits, truth values, or text"
            raise TypeError(f"Invalid dtype {variable.dtype} of '{name}'. {rule}.")


def _check_same(rows: xr.Dataset, first: xr.Dataset, number: int) -> None:
    """Refuse a block whose variables, units or coordinates differ from the first block's."""
    for name in rows.variables.keys() ^ first.variables.keys():
        raise ValueError(f"Invalid rows {number} with, or without, '{name}'. Must be as the first.")
    for name, variable in rows.isel(y=slice(0), missing_dims="ignore").variables.items():
        reference = first.variables[name]
        equal = (variable.dims, variable.shape) == (reference.dims, reference.shape)
        equal &= variable.dtype == reference.dtype
        equal &= variable.attrs.get("units") == reference.attrs.get("units")
        if equal and name in rows.coords:
            equal = bool(variable.equals(reference))  # type: ignore[no-untyped-call]
        if not equal:
            rule = "Must have the dims, type, unit and, of a coordinate, the values of the first"
            raise ValueError(f"Invalid '{name}' of rows {number}. {rule}.")


def open_dataset(path: str | Path) -> xr.Dataset:
    """Open a saved dataset or a recording; values are read when they are used.

    A recording that was cut short, or is being written, opens as far as all bands are valid; its
    attributes have ``complete`` = False and, in ``frames_written``, the end of each band.

    ValueError, with file, array and store, if a file of it, or of the valid part of a recording
    that was cut short, is not as it was written, missing, or foreign; of a chunk, when it is read.

    Parameters
    ----------
    path : str or Path
        Folder ``*.zarr``; FileNotFoundError if it does not exist.

    Returns
    -------
    Dataset
        Identical to the one saved, with ``attrs["provenance"]`` added, as in the example of `save`.
        Text is of NumPy's fixed-length kind. UserWarning if the store has no checksums, as of
        dbthermal 0.1.0, so that damage cannot be seen.
    """
    if not texts.as_path(path).is_dir():
        rule = "Must be a zarr folder, as from: dbthermal import, or a later step, or `save`"
        raise FileNotFoundError(f"No dataset '{path}'. {rule}.")
    checked = integrity.CheckedStore(path)
    if checked.closed:
        dataset = _open(checked)
    else:  # a recording, whose variables differ in their room while it grows: one by one
        ends = {"time": min(checked.attrs["frames_written"].values())}  # of all bands
        ends["log"] = checked.attrs["log_written"]
        names = {array.parent.name for array in checked.root.glob("*/zarr.json")}
        opened = (_open(checked, leave=names - {name}) for name in sorted(names))
        valid = {dim: slice(end) for dim, end in ends.items()}
        arrays = [array.isel(valid, missing_dims="ignore") for array in opened]
        # Attributes as checked: the recording may have grown since.
        dataset = xr.merge(arrays, combine_attrs="override").assign_attrs(checked.attrs)
    for name in integrity.MARK:
        dataset.attrs.pop(name, None)
    return _with_text_as(dataset, "T", np.dtype(str))


def _open(checked: integrity.CheckedStore, leave: Iterable[str] = ()) -> xr.Dataset:
    options: dict[str, Any] = {"chunks": None, "consolidated": False, "zarr_format": 3}
    try:
        dataset: xr.Dataset = xr.open_zarr(checked, drop_variables=list(leave), **options)
    except KeyError as error:  # of arrays without names of their dims
        rule = "Must name the dims of its arrays; readers.array and 'dbthermal import' read others"
        raise ValueError(f"Invalid store '{checked.root}'. {rule}.") from error
    return dataset


def join_parts(folders: Iterable[str | Path], path: str | Path) -> None:
    """Join datasets of rows that follow one another; chunks are linked, and not read.

    Parameters
    ----------
    folders : iterable of str or Path
        From `save_rows`, all of one `height` except the last. They stay as they are; on a disk
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
    ...     paths = [f"{folder}/{number}.zarr" for number in range(3)]
    ...     for row, path in zip(rows, paths):
    ...         store.save_rows([row], path, store.provenance({}))
    ...     store.join_parts(paths, f"{folder}/wall.zarr")
    ...     store.open_dataset(f"{folder}/wall.zarr").status.values.tolist()
    [[0, 0], [1, 0], [2, 0]]
    """
    if not (sources := [texts.as_path(folder) for folder in folders]):
        raise ValueError(f"No parts to join as '{path}'. Must be at least one.")
    with whole(path, ".zarr") as folder:
        # The first folder, and a list of its files that is not linked.
        shutil.copytree(sources[0], folder, copy_function=_link)
        sums = integrity.last_sums(folder)
        (folder / integrity.SUMS).unlink()
        (folder / integrity.SUMS).write_bytes(integrity.sums_file(sums))
        # Chunks of the further folders in their places; zarr replaces files, and writes in no link.
        for name, array in zarr.open_group(integrity.SummedStore(folder), mode="r+").arrays():
            metadata: Any = array.metadata
            dims, shape = [*(metadata.dimension_names or ())], [*array.shape]
            for source in sources[1:] if "y" in dims else ():
                axis = dims.index("y")
                number, remainder = divmod(shape[axis], array.chunks[axis])
                if remainder:
                    label = f"{shape[axis]} rows in chunks of {array.chunks[axis]}"
                    rule = "Must follow whole chunks"
                    raise ValueError(f"Invalid part '{source}' after {label}. {rule}.")
                for key, crc in integrity.last_sums(source).items():
                    if key.startswith(f"{name}/c/"):
                        place = key.split("/")
                        place[axis + 2] = str(int(place[axis + 2]) + number)
                        target = folder.joinpath(*place)
                        target.parent.mkdir(parents=True, exist_ok=True)
                        _link(source / key, target)
                        sums["/".join(place)] = crc
                shape[axis] += zarr.open_array(source / name, mode="r").shape[axis]
            array.resize(tuple(shape))
        sums |= integrity.last_sums(folder)
        (folder / integrity.SUMS).write_bytes(integrity.sums_file(sums))


def _link(source: str | Path, target: str | Path) -> None:
    """Link a file at a second place; a kill then leaves the parts whole."""
    try:
        os.link(source, target)
    except OSError:  # a disk that knows no links
        shutil.copyfile(source, target)


def _with_text_as(dataset: xr.Dataset, kind: str, dtype: np.dtype[Any]) -> xr.Dataset:
    """Convert text from a kind of NumPy to another kind."""
    kept = {name: it for name, it in dataset.variables.items() if it.dtype.kind == kind}
    texts = {n: it.to_numpy().astype(object).astype(dtype) for n, it in kept.items()}
    return dataset.assign({n: (it.dims, texts[n], it.attrs) for n, it in kept.items()})
