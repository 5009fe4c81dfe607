"""A recording while it grows: appended to in chunks along time, readable at any moment.

The folder is a zarr store (format 3) from the first moment on. Chunks are written first, to
the disk and not only to its cache; then ``zarr.json``, which says how much is valid, is replaced in
one step. What was declared valid is never written over, but replaced in one step, too. What a kill
or a power loss leaves is thus a store without the chunk that was being written, and it says so:
``complete`` is False and ``frames_written`` is where each band ends.
`dbthermal.store.open_dataset` opens that much of it.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import numpy.typing as npt
import zarr

from dbthermal.schema import COORDINATES, Variable
from dbthermal.store import _growing as growing
from dbthermal.store._durable import DurableStore, made_beside, tree_to_disk
from dbthermal.store._progress import attributes, write_attributes

Values = npt.NDArray[Any]


class Recording:
    """
    A store that is being written; make one with `Recording.create`.

    It is a context manager: left by an exception it stays incomplete, with all that was appended.

    Parameters
    ----------
    path : Path
        Its folder.
    group : Group
        Of zarr.
    chunk : int
        Frames of a chunk.
    attrs : dict
        Attributes of the group, as they are on the disk.
    """

    def __init__(self, path: Path, group: zarr.Group, chunk: int, attrs: dict[str, Any]) -> None:
        self.path, self.chunk = path, chunk
        # A chunk of zeros is written too: one that is not there was never recorded.
        config: Any = {"write_empty_chunks": True}
        self._arrays = {name: array.with_config(config) for name, array in group.arrays()}
        self._attrs = attrs
        self._closed = False
        self.frames: dict[str, int] = dict(attrs["frames_written"])
        self.rows: int = attrs["log_written"]

    @classmethod
    def create(
        cls,
        path: str | Path,
        variables: Mapping[str, Variable],
        sizes: Mapping[str, int],
        bands: Sequence[str],
        *,
        chunk: int,
        attrs: Mapping[str, Any],
        fills: Mapping[str, float] | None = None,
    ) -> Self:
        """
        Make the folder, with nothing in it but what is to come.

        Parameters
        ----------
        path : str or Path
            Folder to make, ``*.zarr``.
        variables : mapping
            What is recorded: of dims (band, time, ...), frame by frame, or (log,), row by row.
        sizes : mapping
            Size of every other dim, such as ``y`` and ``x``.
        bands : sequence of str
            Names of the bands.
        chunk : int
            Frames of a chunk: a kill costs at most that many of a band.
        attrs : mapping
            JSON: identities, provenance.
        fills : mapping, optional
            What a variable holds where a band has no frame any more; else it is NaN, or 0.

        Returns
        -------
        Recording
            Open.

        Raises
        ------
        FileExistsError
            If there is something at `path`: a recording is never overwritten.
        ValueError
            If `path` does not end in ``.zarr``, or a variable has other dims.
        """
        path = Path(path)
        if path.suffix != ".zarr":
            raise ValueError(f"Invalid path '{path}'. Must end in '.zarr'.")
        if path.exists():
            raise FileExistsError(f"There is something at '{path}'. Must be a new recording.")
        progress = {
            "complete": False,
            "closed": False,
            "frames_written": dict.fromkeys(bands, 0),
            "log_written": 0,
        }
        values = json.loads(json.dumps({**attrs, **progress}, allow_nan=False))
        whole = {**sizes, "band": len(bands), "time": chunk}
        with made_beside(path, path.absolute().parent) as part:
            group = zarr.open_group(part, mode="w-", zarr_format=3, attributes=values)
            for name, variable in variables.items():
                growing.create(group, name, variable, whole, fill=(fills or {}).get(name))
            growing.create_text(group, "band", bands)
        return cls(path, _open(path), chunk, values)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()

    def append(self, band: str, block: Mapping[str, Values]) -> None:
        """
        Write frames of one band behind those that it has; valid with the next `commit`.

        Parameters
        ----------
        band : str
            Its name.
        block : mapping
            Every variable of frames, by its name, (frame, ...). A whole chunk, or, last, less.

        Raises
        ------
        ValueError
            If the variables are not all there, differ in their frames, are more than a chunk, or
            follow on a chunk that is not whole.
        """
        wanted = {name for name, array in self._arrays.items() if growing.is_movie(array)}
        if block.keys() != wanted:
            raise ValueError(f"Invalid variables {sorted(block)}. Must be {sorted(wanted)}.")
        lengths = {values.shape[0] for values in block.values()}
        start, length = self.frames[band], max(lengths)
        if len(lengths) > 1 or length > self.chunk or start % self.chunk:
            raise ValueError(
                f"Invalid block of {sorted(lengths)} frames at frame {start} of band '{band}'. "
                f"Must be one chunk of {self.chunk} frames, or the last one."
            )
        place = list(self.frames).index(band)
        for name, values in block.items():
            growing.grow(self._arrays[name], 1, start + length)
            self._arrays[name][place, start : start + length] = values
        self._to_disk(block, [Path("c", str(place), str(start // self.chunk))])
        self.frames[band] += length

    def append_log(self, columns: Mapping[str, Values]) -> None:
        """
        Write rows of the log behind those that it has; valid with the next `commit`.

        Parameters
        ----------
        columns : mapping
            Every variable of dims (log,), by its name, (row,).

        Raises
        ------
        ValueError
            If the columns are not all there.
        """
        wanted = {name for name, array in self._arrays.items() if growing.dims(array) == ("log",)}
        if columns.keys() != wanted:
            raise ValueError(f"Invalid columns {sorted(columns)}. Must be {sorted(wanted)}.")
        start, end = self.rows, self.rows + len(next(iter(columns.values())))
        for name, values in columns.items():
            growing.grow(self._arrays[name], 0, end)
            self._arrays[name][start:end] = values
        chunks = range(start // growing.LOG_CHUNK, (end - 1) // growing.LOG_CHUNK + 1)
        self._to_disk(columns, [Path("c", str(number)) for number in chunks])
        self.rows = end

    def read(self, name: str, band: str) -> Values:
        """
        Read back what was appended of one band.

        Parameters
        ----------
        name : str
            Of a variable of frames.
        band : str
            Name of the band.

        Returns
        -------
        ndarray, shape (frame, ...)
            Its values, as many as the longest band has frames.
        """
        place, frames = list(self.frames).index(band), max(self.frames.values())
        return np.asarray(self._arrays[name][place, :frames])

    def commit(self, **attrs: Any) -> None:
        """
        Declare valid what was appended, in one step.

        Parameters
        ----------
        **attrs
            Attributes to set besides, JSON.
        """
        self._attrs.update(attrs, frames_written=dict(self.frames), log_written=self.rows)
        write_attributes(self.path, self._attrs)

    def close(self, *, complete: bool = True, time: Values | None = None, **attrs: Any) -> None:
        """
        Bring all bands to one number of frames and say that the recording is complete.

        A band with fewer frames than another gets copies of its last one, without stamps: as a
        driver that lost frames, see `dbthermal.correction.mark_shutter`. A second call does
        nothing.

        Parameters
        ----------
        complete : bool
            What to say.
        time : ndarray, optional
            Coordinate `time` [s], one for each frame of the longest band.
        **attrs
            Attributes to set besides, JSON.
        """
        if self._closed:
            return
        self.commit()
        frames = max(self.frames.values())
        for place, own in enumerate(self.frames.values()):
            if 0 < own < frames:
                self._repeat_last(place, own, frames)
        for array in self._arrays.values():
            shape = {"time": frames, "log": self.rows}
            sizes = zip(growing.dims(array), array.shape, strict=True)
            array.resize(tuple(shape.get(dim, size) for dim, size in sizes))
        if time is not None:
            self._create_time(time)
        self.commit(complete=complete, closed=True, **attrs)
        self._closed = True

    def _repeat_last(self, place: int, own: int, frames: int) -> None:
        counts = self._arrays["counts"]
        growing.grow(counts, 1, frames)
        last = np.asarray(counts[place, own - 1])
        while own < frames:
            number = own // self.chunk
            after = min(frames, (number + 1) * self.chunk)
            counts[place, own:after] = np.broadcast_to(last, (after - own, *last.shape))
            self._to_disk(["counts"], [Path("c", str(place), str(number))])
            own = after

    def _create_time(self, time: Values) -> None:
        with made_beside(self.path / "time", self.path.absolute().parent) as part:
            zarr.create_array(
                part,
                data=time.astype(np.float64),
                dimension_names=("time",),
                attributes={**COORDINATES["time"].attrs, "long_name": "time since the start"},
            )

    def _to_disk(self, names: Iterable[str], chunks: Sequence[Path]) -> None:
        """Bring chunks of some arrays to the disk, and the folders that they are in."""
        tree_to_disk([self.path / name / chunk for name in names for chunk in chunks], self.path)


def recover(path: str | Path) -> None:
    """
    Close a recording that was cut short: all its frames are kept, and it stays incomplete.

    Attribute ``ended`` is then ``"cut short"``.

    Not needed for reading: without it, `dbthermal.store.open_dataset` opens as many frames as all
    bands have.

    Parameters
    ----------
    path : str or Path
        Folder ``*.zarr`` that nobody writes to.

    Raises
    ------
    FileNotFoundError
        If there is none.
    ValueError
        If it is no recording that was cut short.
    """
    attrs = attributes(path)
    if attrs.get("complete", True) or attrs.get("closed", False):
        raise ValueError(f"Invalid recording '{path}'. Must be one that was cut short.")
    group = _open(path)
    arrays = [array for array in dict(group.arrays()).values() if growing.is_movie(array)]
    recording = Recording(Path(path), group, arrays[0].chunks[1], attrs)
    recording.close(complete=False, ended="cut short")


def _open(path: str | Path) -> zarr.Group:
    return zarr.open_group(DurableStore(path), mode="r+", use_consolidated=False)
