"""Arrays in files of HDF5, NetCDF and zarr, which are left on disk."""

import math
import re
import struct
import warnings
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr
import zarr

from dbthermal import _text as texts
from dbthermal.readers import _recording as recordings

_CHUNK: Final = r"(c\.)?\d+(\.\d+)*"
_LOSSLESS: Final = "delta|(bit)?shuffle|crc32c?|adler32|fletcher32|transpose(codec)?"
_NO_VARIABLE: Final = "This is a netCDF dimension but not a netCDF variable"


def kind_of(path: Path) -> str:
    """Format of a container, by its first bytes; empty for any other file."""
    if path.is_dir():
        return "zarr"
    with recordings.files([path])[0].open("rb") as stream:
        start = stream.read(8)
    return "HDF5" if start == b"\x89HDF\r\n\x1a\n" else "NetCDF" if start[:3] == b"CDF" else ""


def dims_of(values: Any) -> list[Any]:
    """Dims of an array of zarr (2 or 3), h5py, netCDF4 or xarray; empty of one that has none."""
    if isinstance(values, zarr.Array):
        stored: Any = values.attrs.get("_ARRAY_DIMENSIONS", ())
        return [*(getattr(values.metadata, "dimension_names", None) or stored)]
    dims = getattr(values, "dims", getattr(values, "dimensions", ()))
    if not hasattr(values, "is_virtual"):
        return [*dims]
    return [dim.label or (dim[0].name.rpartition("/")[2] if len(dim) else "") for dim in dims]


def are_times(name: object, values: Any) -> bool:
    """Tell whether an array is a coordinate of times, by its name."""
    return values.ndim == 1 and str(name).rpartition("/")[2].lower() in {"time", "t"}


def read(
    path: Path, name: str | None, check: Callable[..., None], memory: float, stack: ExitStack
) -> Any:
    """Numbers of an array of three dimensions, by its name if there are several, once checked."""
    # Size, for NetCDF is read at once.
    kind = kind_of(path)
    limit = max(2 * memory, 2**20)
    if kind == "NetCDF" and path.stat().st_size > limit:
        rule = f"Must be at most {limit:.3g} bytes, twice memory=, for it is read at once"
        raise ValueError(f"Invalid size of '{path.name}'. {rule}.")
    stack.enter_context(warnings.catch_warnings(action="error", category=RuntimeWarning))
    warnings.simplefilter("error", UserWarning)  # as of one dimension twice
    with recordings.damage_named(f"Damaged '{path.name}'", f"a whole {kind}"):
        arrays = {"zarr": _foreign_store, "HDF5": _hdf5, "NetCDF": _netcdf}[kind](path, stack)
        # The array, by its name, and its times.
        films = [key for key, array in arrays.items() if array.ndim == 3]
        name = recordings.array_name(films, name, path)
        values, dims = arrays[name], dims_of(arrays[name])
        times = arrays.get("/".join([*name.split("/")[:-1], *map(str, dims[:1])]))
        if isinstance(times, zarr.Array):
            _check_chunks(times, path)
        check(values, dims, times if times is not None and times.ndim == 1 else None)
        if isinstance(values, zarr.Array):
            _check_chunks(values, path)
        return recordings.film(values)


def _hdf5(path: Path, stack: ExitStack) -> dict[str, Any]:
    h5py = recordings.optional("h5py", "recordings")
    file = stack.enter_context(h5py.File(path, "r"))
    arrays, headers = dict[str, Any](), [8]

    def visit(name: str, array: Any) -> None:
        headers.append(h5py.h5o.get_info(array.id).addr)
        if isinstance(array, h5py.Dataset) and _NO_VARIABLE not in str(array.attrs.get("NAME")):
            arrays.update({name: array} if array.ndim == 3 or are_times(name, array) else {})

    # All arrays of the file itself: no other file, no overlap, every chunk.
    file.visititems(visit)  # follows no link to another file
    for name, array in arrays.items():
        if array.is_virtual or array.external:
            raise ValueError(f"Invalid '{name}' in other files. Must be in '{path.name}' itself.")
        start = array.id.get_offset() if array.chunks is None else None
        if start is not None and any(start <= place < start + array.nbytes for place in headers):
            raise ValueError(f"Overlapping parts of '{path.name}'. Must lie apart.")
        if array.chunks is None and (stored := array.id.get_storage_size()) != array.nbytes:
            rule = f"Must be all of the {stored} bytes stored"
            raise ValueError(f"Invalid shape {array.shape} of '{name}' of '{path.name}'. {rule}.")
        pieces = zip(array.shape, array.chunks or array.shape, strict=True)
        wanted = math.prod(-(-size // piece) for size, piece in pieces) if array.chunks else 0
        chunks = [
            array.id.get_chunk_info(n) for n in range(array.id.get_num_chunks() if wanted else 0)
        ]
        if len(chunks) != wanted or any(chunk.filter_mask for chunk in chunks):
            raise ValueError(f"Missing chunks or filters of '{name}'. Must be {wanted}, all alike.")
    return arrays


def _netcdf(path: Path, stack: ExitStack) -> dict[str, Any]:
    opened = xr.open_dataset(
        path,
        engine="scipy",
        mmap=False,  # what is mapped cannot be closed while an error refers to it
        decode_times=False,
        decode_coords=False,
        concat_characters=False,
        create_default_indexes=False,
    )
    variables = stack.enter_context(opened).variables
    if not opened.encoding.get("unlimited_dims"):  # else they lie frame by frame
        # One variable after another up to the end: a place in the header that is damaged shows.
        content = np.memmap(path, "u1", "r")
        kinds = [variable.encoding.get("dtype", variable.dtype) for variable in variables.values()]
        sizes = [
            -(-variable.size * kind.itemsize // 4) * 4
            for variable, kind in zip(variables.values(), kinds, strict=True)
        ]
        start = len(content) - sum(sizes)
        for name, kind, size in zip(variables, kinds, sizes, strict=True):
            variable, start = variables[name], start + size
            if variable.ndim == 3 and variable.dtype.kind == "u":
                stored = content[start - size :][: variable[0].size * kind.itemsize].view(">u2")
                if not np.array_equal(variable[0].values.ravel(), stored):
                    raise ValueError(f"Overlapping parts of '{path.name}'. Must lie apart.")
    return {str(n): v for n, v in variables.items() if v.ndim == 3 or are_times(n, v)}


def _foreign_store(path: Path, _: ExitStack) -> dict[str, Any]:
    deque(texts.tree_files(path), maxlen=0)  # nothing is opened that is no file in it
    with warnings.catch_warnings(action="ignore", category=UserWarning):  # of other files beside
        # Each array by its metadata, of which consolidated ones are a copy that may be old.
        root = zarr.open(str(path), mode="r", use_consolidated=False)
        members: dict[str, Any] = {path.stem: root}
        if isinstance(root, zarr.Group):
            members = dict(root.members(max_depth=None))
    arrays = {n: array for n, array in members.items() if isinstance(array, zarr.Array)}
    arrays = {n: array for n, array in arrays.items() if array.ndim == 3 or are_times(n, array)}
    for name, array in arrays.items():
        chunk = (1, 1, *(array.shards or array.chunks))[-3:]
        recordings.check_memory(chunk, 2.0**30, f"a chunk of '{name}'")
        for code in array.filters:
            kind = getattr(code, "codec_id", type(code).__name__)
            if not re.fullmatch(_LOSSLESS, kind, re.IGNORECASE):
                rule = "Must be one that changes no counts: save them without it"
                raise ValueError(f"Invalid filter '{kind}' of '{name}' of '{path.name}'. {rule}.")
        missing = 0 if array.shards else array.nchunks - array.nchunks_initialized
        if array.ndim == 3 and missing:
            raise ValueError(
                f"Missing {missing} chunks of '{name}' of '{path.name}'. Must be whole."
            )
    return arrays


def _check_chunks(values: zarr.Array[Any], path: Path) -> None:
    """Refuse chunks of a false size, and a shape that leaves a part of them out, as if damaged."""
    pieces = values.shards or values.chunks
    grid = [-(-size // piece) for size, piece in zip(values.shape, pieces, strict=True)]
    whole = tuple(number * piece for number, piece in zip(grid, pieces, strict=True))
    # Files of chunks, which must be of their stated size.
    keys = [file for file in (path / values.path).rglob("*") if re.fullmatch(_CHUNK, file.name)]
    keys = [key for key in keys if key.is_file()]
    if values.shards is None and "Blosc" in str(values.compressors[-1:]):
        for key in keys:  # Blosc reads as far as its header says, and past the end of the memory
            with key.open("rb") as stream:
                sizes = struct.unpack("<4xI4xI", stream.read(16).ljust(16, b"\0"))
            if sizes != (values.dtype.itemsize * math.prod(pieces), key.stat().st_size):
                raise ValueError(f"Damaged chunk '{key.name}' of '{path.name}'. Must be whole.")
    # Shards, in which a missing chunk reads as fill values: as other ones with another fill value.
    if values.shards:
        fill = values.dtype.type(values.fill_value == 0)
        metadata: Any = replace(values.metadata, fill_value=fill)
        refilled = zarr.Array(zarr.AsyncArray(metadata, values.store_path))
        for start in range(0, values.shape[0], values.shards[0]):
            frames = slice(start, start + values.shards[0])
            if not np.array_equal(values[frames], refilled[frames]):
                label = f"Missing chunks in the shards of '{values.path or path.stem}'"
                raise ValueError(f"{label} of '{path.name}'. Must be whole.")
    # What pads the last chunks, which is of one value.
    metadata = values.metadata.update_shape(whole)
    padded = zarr.Array(zarr.AsyncArray(metadata, values.store_path))
    more = len(keys) > math.prod(grid)
    for axis, size in enumerate(values.shape):
        beyond = np.asarray(padded[(slice(None),) * axis + (slice(size, None),)])
        more = more or bool(beyond.size and np.ptp(beyond))
    if more:
        rule = "Must be all that its chunks hold: there is more"
        raise ValueError(f"Invalid shape {values.shape} of '{path.name}'. {rule}.")
