"""Films and maps of a view, read frame by frame from memory, a store, or a computation."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import gettempdir
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.constants import zero_Celsius

from dbthermal import _rows, schema, store
from dbthermal import response as responses
from dbthermal._arrays import Array, Mask, empty, on_disk, release
from dbthermal._coordinates import laid_on

Values = npt.NDArray[np.float32]
Progress = Callable[[str, float], object]

FILMS: Final = {
    "object_temperature": "object temperature",
    "background_temperature": "reflected temperature",
}
_ONE_BAND: Final = schema.Variable(("time", "y", "x"), "uint16", "count", "raw signal")


@dataclass(frozen=True, eq=False)
class Pane:
    """Picture of one quantity."""

    name: str  # in `View.panes`
    label: str  # title
    units: str  # of the values
    array: xr.DataArray  # values (time, y, x) or (y, x), in memory or lazy
    absolute: bool = False  # temperature, also shown in degrees Celsius; not a difference
    std: str = ""  # pane of its standard deviation; empty without one
    curve: responses.Curve | None = None  # response, for counts shown as apparent temperatures

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
        with on_disk(Path(gettempdir())):
            copy = empty(array.shape, array.dtype)
        height = array.encoding.get("preferred_chunks", {}).get("y", 1)
        for block in _rows.blocks(array.shape, max(1, height * array.size // array.shape[1])):
            copy[:, block] = array.isel(y=block).values
            if progress is not None:
                progress(f"reading {self.label}", block.stop / array.shape[1])
            release()
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


def result_panes(data: xr.Dataset) -> Iterator[Pane]:
    """Yield the panes of a result, in the order in which they are shown."""
    if "object_temperature" not in data:
        raise ValueError(
            f"Missing variable 'object_temperature'. Has {sorted(map(str, data))}. Must be a "
            "result of separation, or a capture with 'counts'."
        )
    variables = {**schema.STAGES["separated"], **schema.OPTIONAL["separated"]}
    for name in (name for name in variables if name in data):
        schema.check_variable(data[name], variables[name], f"'{name}' of the result")
        laid_on(data[name], data["object_temperature"], f"'{name}'", "the object temperature")
    # What is estimated, then its deviations: a film each, or a map a band.
    missing = str(data.attrs.get("not_estimated", "")).split()
    stds = [f"{name}_std" for name in (*FILMS, "emissivity") if name not in missing]
    for name in (name for name in [*FILMS, "emissivity", *stds] if name in data):
        base = name.removesuffix("_std")
        if name in missing or base not in data:
            continue
        words = FILMS.get(base, base) + (", deviation" if name != base else "")
        has_std = name == base and f"{name}_std" in data and f"{name}_std" not in missing
        std = f"{name}_std" if has_std else ""
        if base in FILMS:
            yield Pane(name, words, "K", data[name], absolute=name == base, std=std)
            continue
        for place, band in enumerate(map(str, data[name]["band"].values)):
            title, image = f"{band} \N{MICRO SIGN}m {words}", data[name].isel(band=place)
            yield Pane(f"{name} {band}", title, "1", image, std=std and f"{std} {band}")
    if "status" in data:
        yield Pane("status", "status", "1", data["status"])


def input_panes(
    capture: xr.Dataset, response: xr.Dataset | None, reference: xr.Dataset | xr.DataArray | None
) -> Iterator[Pane]:
    """Yield the bands of a capture, as apparent temperatures if there is a response."""
    if "counts" in capture and "band" not in capture["counts"].dims:  # of one camera
        schema.check_variable(capture["counts"], _ONE_BAND, "'counts' of the capture")
        yield Pane("input", "input", "count", capture["counts"])
        return
    counts = schema.check(capture, "capture")["counts"]
    if reference is not None and reference is not capture:
        counts = laid_on(counts, reference, "the capture", "the result")
    for place, band in enumerate(map(str, counts["band"].values)):
        film, label = counts.isel(band=place), f"{band} \N{MICRO SIGN}m input"
        curve = None if response is None else responses.curve(response, band)
        form: Any = {"absolute": curve is not None, "curve": curve}
        yield Pane(f"input {band}", label, "count" if curve is None else "K", film, **form)


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
