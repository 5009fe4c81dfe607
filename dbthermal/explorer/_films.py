"""Films and maps of a view, read frame by frame from memory, a store, or a computation."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.constants import zero_Celsius

from dbthermal import _rows, schema, store
from dbthermal._arrays import Array, Mask
from dbthermal.response import Curve

Values = npt.NDArray[np.float32]
Progress = Callable[[str, float], object]


@dataclass(frozen=True, eq=False)
class Pane:
    """Picture of one quantity."""

    name: str  # in `View.panes`
    label: str  # title
    units: str  # of the values
    array: xr.DataArray  # values (time, y, x) or (y, x), in memory or lazy
    absolute: bool = False  # temperature, also shown in degrees Celsius; not a difference
    std: str = ""  # pane of its standard deviation; empty without one
    curve: Curve | None = None  # response, for counts shown as apparent temperatures

    @property
    def kind(self) -> Literal["film", "map", "status"]:
        """Film (time, y, x), map (y, x), or the map of the status."""
        if self.name == "status":
            return "status"
        return "film" if self.array.ndim == 3 else "map"

    def unit(self, *, celsius: bool) -> tuple[str, float]:
        """Unit of the shown values, and the offset that is subtracted."""
        if self.absolute and celsius:
            return "\N{DEGREE SIGN}C", zero_Celsius
        return self.units, 0.0

    @cached_property
    def _source(self) -> npt.NDArray[Any]:
        """Values that are indexed: those in memory, or the copy of `stage`."""
        return self.array.values if self.array.ndim == 3 else self.array.values[None]

    def stage(self, progress: Progress | None = None) -> None:
        """Copy a film that is not in memory into a temporary file, chunk by chunk."""
        array = self.array
        if "_source" in vars(self) or array.ndim < 3 or array.variable._in_memory:
            return
        size = array.size * array.dtype.itemsize
        with TemporaryFile() as file:
            try:
                if hasattr(os, "posix_fallocate"):  # or a full disk would end the process later
                    os.posix_fallocate(file.fileno(), 0, size)
            except OSError as error:
                raise OSError(
                    error.errno,
                    f"No room for {size / 1e6:.0f} MB of '{self.name}' in the folder of temporary "
                    "files. Must be free, or TMPDIR name another folder",
                ) from error
            copy = np.memmap(file, array.dtype, "r+", shape=array.shape)
        height = array.encoding.get("preferred_chunks", {}).get("y", 1)
        for block in _rows.blocks(array.shape, max(1, height * array.size // array.shape[1])):
            copy[:, block] = array.isel(y=block).values
            if progress is not None:
                progress(f"reading {self.label}", block.stop / array.shape[1])
        vars(self)["_source"] = copy

    def read(
        self, frames: slice, rows: slice = slice(None), columns: slice = slice(None)
    ) -> Values:
        """Values (time, y, x), float32; of a map one frame."""
        self.stage()
        values = self._source[frames if self.array.ndim == 3 else slice(None), rows, columns]
        if self.curve is not None:
            return np.asarray(self.curve.inverse(values), dtype=np.float32)
        return np.asarray(values, dtype=np.float32)


def opened(data: xr.Dataset | str | Path, label: str) -> xr.Dataset:
    """Dataset, opened if it is the path of a store."""
    if isinstance(data, str | Path):
        return store.open_dataset(data)
    if not isinstance(data, xr.Dataset):
        raise TypeError(
            f"Invalid {label} of type {type(data).__name__}. Must be a Dataset or the path of a "
            "store, as from separation.separate."
        )
    return data


def marks(capture: xr.Dataset, time: Array) -> dict[str, float]:
    """Times [s] of shutter events of a capture, and of the first of flagged frames, by name."""
    marked: dict[str, Mask] = {}
    if "segment" in capture:
        marked["shutter event"] = np.asarray(np.diff(capture["segment"].values, prepend=0) > 0)
    if "frame_flags" in capture:
        flags = capture["frame_flags"]
        for name in str(flags.attrs.get("flag_meanings", "")).split():
            marked[name.replace("_", " ")] = np.asarray(
                schema.has_flag(flags, name).any([dim for dim in flags.dims if dim != "time"])
            )
    events = {}
    for name, where in marked.items():
        begins = np.flatnonzero(where & ~np.roll(np.append(where, False), 1)[:-1])
        events.update({f"{name} {i}": float(time[at]) for i, at in enumerate(begins, 1)})
    return events
