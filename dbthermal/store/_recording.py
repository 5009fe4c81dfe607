"""A recording that grows in chunks along time and is readable at any moment.

The folder is a zarr store (format 3) from the first moment on. Chunks are synced to the disk; then
``zarr.json``, with the number of valid frames, is replaced in one step. Valid chunks are never
overwritten in place. A kill or a power loss costs the chunk being written: ``complete`` is False
and ``frames_written`` is where each band ends. The folder is held by its descriptor if it moves.
"""

import errno
import json
import math
import os
import weakref
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import zarr
from zarr.codecs import BloscCodec, Crc32cCodec
from zarr.core.buffer import Buffer

from dbthermal.schema import COORDINATES, Variable
from dbthermal.store import _integrity as integrity
from dbthermal.store._whole import raised_signals, replace, take, tree_to_disk, whole

Values = npt.NDArray[Any]

_LOG_CHUNK: Final = 4096  # rows of a chunk of the log
_LOOKS: Final = 10  # for a folder, which may be moved while its path is read and compared
_STAY: Final = "Must stay while it is written to"
_FORM: Final[Any] = {  # chunks of zeros are written, too: a missing chunk was never recorded
    "compressors": (BloscCodec(cname="lz4", clevel=1, shuffle="bitshuffle"), Crc32cCodec()),
    "config": {"write_empty_chunks": True},
}


class Recording:
    """A recording that is being written, in a new folder ``*.zarr``; FileExistsError if it exists.

    `frames` is the number of frames of each band and `rows` that of the log, as far as they are
    written; `commit` declares them valid. `root` leads into the folder wherever it is moved. After
    the folder was deleted, or one of an array moved, FileNotFoundError: nothing more is written.

    Parameters
    ----------
    path : str or Path
        Folder ``*.zarr`` to make.
    variables, sizes : mapping
        Name to `schema.Variable`, of dims (band, time, ...), frame by frame, or (log,), row by row;
        and sizes of their other dims.
    bands, chunk : sequence of str, int
        Names of the bands; number of frames that a kill costs at most.
    attrs, fills : mapping
        Attributes, as JSON; values behind a band's last frame, instead of NaN or 0.
    """

    def __init__(
        self,
        path: str | Path,
        variables: Mapping[str, Variable],
        sizes: Mapping[str, int],
        bands: Sequence[str],
        *,
        chunk: int,
        attrs: Mapping[str, Any],
        fills: Mapping[str, float] | None = None,
    ) -> None:
        # A new path, and the attributes of an empty recording.
        self.path, self.chunk, self._closed = Path(path), chunk, False
        self.frames, self.rows = dict.fromkeys(bands, 0), 0
        attrs = {**integrity.GROWING, **attrs, "complete": False, "closed": False}
        self._attrs = json.loads(json.dumps(attrs, allow_nan=False))
        self._attrs.update(frames_written=dict(self.frames), log_written=0)
        sizes = {**sizes, "band": len(bands), "time": chunk}
        # The store with empty arrays, on the disk before it has its name.
        with raised_signals(deferred=True), whole(self.path, ".zarr") as draft:
            if self.path.exists():
                raise FileExistsError(f"There is something at '{path}'. Must be a new recording.")
            draft.mkdir()
            self._store = DurableStore(draft)
            group = zarr.open_group(self._store, mode="w-", zarr_format=3, attributes=self._attrs)
            self._arrays = {
                name: _create(group, name, variable, sizes, (fills or {}).get(name))
                for name, variable in variables.items()
            }
            names = np.array(bands, dtype=np.dtypes.StringDType())
            self._arrays["band"] = group.create_array(
                "band", data=names, dimension_names=("band",), **_FORM
            )
            self._folder = HeldFolder(draft, self.path)
        # From here on the recording is written wherever its folder is moved.
        self.root = self._store.root = self._folder.root
        self._inside = {name: (self.root / name).stat() for name in self._arrays}

    def place(self) -> Path:
        """Path at which the recording lies now; FileNotFoundError if a part of it is missing."""
        if self._closed:
            return self.path
        place = self._folder.place()
        for name, held in self._inside.items():
            folder = self.root / name
            if not (folder.exists() and os.path.samestat(folder.stat(), held)):
                state = "any more: its folder was moved, replaced or deleted"
                label = f"No array '{name}' in the recording '{place}' {state}"
                raise FileNotFoundError(f"{label}. {_STAY}.")
        return place

    @contextmanager
    def _held(self) -> Iterator[None]:
        """Raise what is missing of the folder, and errors with paths in it."""
        self.place()
        try:
            yield
        except OSError as error:
            self.place()
            if isinstance(error.filename, str):
                error.filename = os.path.realpath(error.filename)
            raise

    def append(self, band: str, block: Mapping[str, Values]) -> None:
        """Write a chunk (frame, ...) of a band behind its others; valid with the next `commit`."""
        with self._held():
            place = list(self.frames).index(band)
            self.frames[band] = self._write(block, (place,), self.frames[band], self.chunk)

    def append_log(self, columns: Mapping[str, Values]) -> None:
        """Write rows of the log, every variable (row,); valid with the next `commit`."""
        with self._held():
            self.rows = self._write(columns, (), self.rows, _LOG_CHUNK)

    def _write(
        self, block: Mapping[str, Values], place: tuple[int, ...], start: int, chunk: int
    ) -> int:
        """Write rows, (row, ...), of variables at a place from a start on; return their end."""
        stop = start + len(next(iter(block.values())))
        for name, values in block.items():
            array, axis = self._arrays[name], len(place)
            size = array.shape[axis]
            if size < stop:  # twice the room, so that the array's metadata are written seldom
                room = max(2 * size, -(-stop // chunk) * chunk)
                array.resize((*array.shape[:axis], room, *array.shape[axis + 1 :]))
            array[(*place, slice(start, stop))] = values
        # Bring the chunks, their checksums and the folders around them to the disk.
        chunks = [
            self.root.joinpath(name, "c", *map(str, place), str(number))
            for name in block
            for number in range(start // chunk, (stop - 1) // chunk + 1)
        ]
        tree_to_disk([*chunks, self.root / integrity.SUMS], self.root)
        return stop

    def read(self, name: str, band: str) -> Values:
        """Values (frame, ...) of a band, as many as the longest band has frames."""
        with self._held():
            place, frames = list(self.frames).index(band), max(self.frames.values())
            return np.asarray(self._arrays[name][place, :frames])

    def commit(self, **attrs: Any) -> None:
        """Declare valid, in one step, all that was appended, and set attributes (JSON)."""
        with self._held():
            self._attrs.update(attrs, frames_written=dict(self.frames), log_written=self.rows)
            content = {"zarr_format": 3, "node_type": "group", "attributes": self._attrs}
            self._store.replace(integrity.GROUP, json.dumps(content, allow_nan=False).encode())

    def close(self, *, complete: bool = True, time: Values | None = None, **attrs: Any) -> None:
        """Bring all bands to one number of frames, once, with `time` [s] as coordinate."""
        if self._closed:
            return
        with self._held():
            # As many frames as the longest band has, by copies of the last one, without stamps.
            self.commit()
            frames = max(self.frames.values())
            for place, recorded in enumerate(self.frames.values()):
                if 0 < recorded < frames:
                    last = np.asarray(self._arrays["counts"][place, recorded - 1])
                    copies = np.broadcast_to(last, (frames - recorded, *last.shape))
                    self._write({"counts": copies}, (place,), recorded, self.chunk)
            # All arrays without empty room.
            for array in self._arrays.values():
                valid, dims = {"time": frames, "log": self.rows}, array.metadata.dimension_names
                sizes = zip(dims, array.shape, strict=True)
                array.resize(tuple(valid.get(dim, size) for dim, size in sizes))
            # The common clock.
            if time is not None:
                about = {**COORDINATES["time"].attrs, "long_name": "time since the start"}
                form = {"data": time.astype(np.float64), "dimension_names": ("time",), **_FORM}
                zarr.create_array(self._store, name=integrity.TIME, attributes=about, **form)
                tree_to_disk([self.root / integrity.TIME, self.root / integrity.SUMS], self.root)
            # Nothing was lost, and one state of every file counts from here on.
            listed = integrity.last_sums(self.root).keys()
            if lost := sorted(listed - integrity.files_of(self.root)):
                state = f"any more, of {len(lost)} that were deleted"
                label = f"No file '{lost[0]}' in the recording '{self.place()}' {state}"
                raise FileNotFoundError(f"{label}. {_STAY}.")
            self.commit(complete=complete, closed=True, **integrity.MARK, **attrs)
            replace(self.root / integrity.SUMS, integrity.sums_file(integrity.last_sums(self.root)))
            self.path, self._closed = self.place(), True
            self._folder.close()


def _create(
    group: zarr.Group, name: str, variable: Variable, sizes: dict[str, int], fill: float | None
) -> Any:
    """Make an empty array with room for one chunk of frames, or for no row of the log."""
    chunks = {**sizes, "band": 1, "log": _LOG_CHUNK}
    missing = math.nan if np.dtype(variable.dtype).kind == "f" else 0
    form: Any = {"dtype": variable.dtype, "fill_value": missing if fill is None else fill, **_FORM}
    form |= {"dimension_names": variable.dims, "attributes": dict(variable.attrs)}
    form["chunks"] = tuple(chunks[dim] for dim in variable.dims)
    shape = tuple({**sizes, "log": 0}[dim] for dim in variable.dims)
    return group.create_array(name, shape=shape, **form)


class HeldFolder:
    """A folder held by its descriptor, wherever it is renamed or moved on its disk.

    Parameters
    ----------
    folder, path : Path
        Existing folder (OSError otherwise); where it will be moved next, by default nowhere.

    Attributes
    ----------
    root, close : Path, callable
        Path into the folder, wherever it is moved (its path without /proc, as on macOS); frees it.
    """

    def __init__(self, folder: Path, path: Path | None = None) -> None:
        self._path, self._descriptor = path or folder, os.open(folder, os.O_RDONLY)
        self.close = weakref.finalize(self, os.close, self._descriptor)
        take(self._descriptor)  # so that no output replaces it
        self._link = Path(f"/proc/self/fd/{self._descriptor}")
        self.root = self._link if self._link.exists() else self._path.absolute()

    def place(self) -> Path:
        """Path at which the folder lies now: FileNotFoundError if it was deleted."""
        for _ in range(_LOOKS):
            for path in (self._path, Path(os.path.realpath(self._link))):
                with suppress(OSError):
                    if os.path.samestat(os.fstat(self._descriptor), path.stat()):
                        return path
        state = "any more: it was deleted, replaced or taken to another disk"
        raise FileNotFoundError(f"No folder '{self._path}' {state}. {_STAY}.")


class DurableStore(integrity.SummedStore):
    """Zarr store in a folder in which an existing file is replaced in one step."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self._written: set[str] = set()

    def set_sync(self, key: str, value: Buffer) -> None:
        """Write a file by its relative name; if that fails, the old one stays, if it exists."""
        path = self.root / key
        if path.exists():
            self.replace(key, value.to_bytes())
        elif key in self._written:
            raise FileNotFoundError(errno.ENOENT, "Deleted while it was written to", str(path))
        else:  # brought to the disk by `tree_to_disk`: many at once take the time of one
            super().set_sync(key, value)
        self._written.add(key)

    def replace(self, key: str, content: bytes) -> None:
        """Replace a file by its relative name, when its checksum is on the disk; see `replace`."""
        replace(self.root / key, content, before=[integrity.add_sum(self.root, key, content)])
