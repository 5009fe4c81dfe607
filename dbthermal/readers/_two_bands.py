"""Two recordings as one capture of two bands."""

from collections.abc import Sequence
from datetime import datetime
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.constants import zero_Celsius

from dbthermal import schema
from dbthermal._arrays import empty, parts
from dbthermal._text import shown
from dbthermal._warnings import warned
from dbthermal.readers import _recording as recordings
from dbthermal.readers._recording import FileFlag

_SCENE: Final = (5.0, 100.0)  # temperatures of a scene [degC]
_FRAMES: Final = 16  # about as many of them tell
_ALIKE: Final = 5.0  # between the medians of two bands [K]


def two_bands(
    first: xr.Dataset,
    second: xr.Dataset,
    *,
    bands: tuple[str, str],
    offset: float | None = None,
) -> xr.Dataset:
    """Two cameras' recordings as one capture, with both clocks.

    Each band keeps its own frames and times; nothing is interpolated. `alignment.time_offset` and
    `alignment.align` bring the two onto one clock: two cameras' dates are hardly ever right to a
    frame.

    Parameters
    ----------
    first, second : Dataset
        Recordings of one band each, from `flir`, `tiff`, `raw` or `array`, of the same pixels.
    bands : (str, str)
        Names of the two bands, such as ``("8-14", "9.5")``.
    offset : float, optional
        Time from the beginning of the first to that of the second recording [s]. By default from
        the dates of both files.

    Returns
    -------
    Dataset
        Stage `capture` of `schema`: `counts` (band, time, y, x), `exposure_time` and `frame_flags`
        (band, time). The shorter band is filled with its last frame, flagged ``padded``, without a
        time; `time` is the clock of the longer one. ``files`` has both recordings' attributes as a
        mapping by band. Copies the counts: twice their memory is needed.

    Raises
    ------
    TypeError, ValueError
        If a recording is not one of counts in one band, or its times are unknown, infinite or fall;
        bands are not two different names; sizes differ; an offset is no number, or there is none
        and no date; the recordings do not overlap in time, or they hold the same counts.

    Warns
    -----
    UserWarning
        If the counts of both bands read as the same temperatures in hundredths of a degree.

    Examples
    --------
    >>> import numpy as np
    >>> from dbthermal import readers
    >>> counts = np.arange(18000, 18060, dtype=np.uint16).reshape(5, 3, 4)
    >>> first = readers.array(counts, unit="count", clock=30.0)
    >>> second = readers.array(counts[:4] + 900, unit="count", clock=30.0)
    >>> capture = two_bands(first, second, bands=("8-14", "9.5"), offset=0.01)
    >>> capture.exposure_time.sel(band="9.5").values.round(3)  # [s]
    array([0.01 , 0.043, 0.077, 0.11 ,   nan])
    """
    # Two recordings of one size, with names.
    pair = (first, second)
    names = _names(bands)
    for name, recording in zip(names, pair, strict=True):
        _check(recording, name)
    if offset is not None:
        recordings.check_number(offset, "offset")
    shapes = [(recording.sizes["y"], recording.sizes["x"]) for recording in pair]
    if shapes[0] != shapes[1]:
        raise ValueError(
            f"Different sizes {shapes[0]} and {shapes[1]} pixels of the bands {names}. Must be "
            "equal: resample the second recording, or crop the first."
        )
    # Offset of the clocks, by which they must overlap.
    late = _between_dates(pair) if offset is None else offset
    starts, stops = ([recording["time"].values[place] for recording in pair] for place in (0, -1))
    overlap = np.minimum(stops[0], stops[1] + late) - np.maximum(starts[0], starts[1] + late)
    if not overlap > 0 and max(recording.sizes["time"] for recording in pair) > 1:
        raise ValueError(
            f"Invalid offset {late:g} s: the recordings of {stops[0]:g} and {stops[1]:g} s do not "
            "overlap. Must overlap; give offset= if a camera's clock is wrong."
        )
    # Two cameras, not a file named twice.
    shared = min(recording.sizes["time"] for recording in pair)
    overlapping = [recording["counts"].values[:shared] for recording in pair]
    film, second_film = overlapping
    if all(np.array_equal(film[at], second_film[at]) for at in parts(film)):
        raise ValueError(
            f"Same counts in both recordings, of the bands {names}. Must be those of two cameras: "
            "is one file named twice?"
        )
    # Frames of both; the shorter recording is filled up, and flagged.
    frames = max(recording.sizes["time"] for recording in pair)
    counts = empty((2, frames, *shapes[0]), np.uint16)
    times = np.full((2, frames), np.nan)
    flags = np.full((2, frames), FileFlag.PADDED.value, dtype=np.uint16)
    for place, (recording, shift) in enumerate(zip(pair, (0.0, late), strict=True)):
        length = recording.sizes["time"]
        for at in parts(recording["counts"].values):
            counts[place, :length][at] = recording["counts"].values[at]
        counts[place, length:] = recording["counts"].values[-1]
        times[place, :length] = recording["exposure_time"].values + shift
        flags[place, :length] = recording["frame_flags"].values
    # The capture, on the clock of the longer recording.
    longer = int(second.sizes["time"] > first.sizes["time"])
    clock = pair[longer]["time"].values + (0.0, late)[longer]
    variables = schema.variables("capture", {"counts": counts, "exposure_time": times})
    variables["frame_flags"] = (("band", "time"), flags, FileFlag.cf_attrs(schema.FRAME_FLAGS))
    time = ("time", clock, schema.COORDINATES["time"].attrs)
    attrs = {
        **schema.origin(first.attrs, second.attrs),
        "source": " and ".join(str(recording.attrs.get("source", "")) for recording in pair),
        "offset": late,
        "offset_by": "dates" if offset is None else "caller",
        "files": {name: dict(recording.attrs) for name, recording in zip(names, pair, strict=True)},
    }
    capture = schema.check(xr.Dataset(variables, {"band": names, "time": time}, attrs), "capture")
    borders = map(_border, overlapping, names)
    return warned(capture, *_temperatures(overlapping), *filter(None, borders))


def _between_dates(pair: tuple[xr.Dataset, xr.Dataset]) -> float:
    """Time from the date of the first recording to that of the second [s]."""
    dates = [recording.attrs.get("start") for recording in pair]
    if None in dates:
        raise ValueError("Unknown dates of the recordings. Must be given as offset= [s].")
    begun, later = (datetime.fromisoformat(str(date)) for date in dates)
    return (later - begun).total_seconds()


def _names(bands: Any) -> list[str]:
    """Names of two bands, which must be texts, and differ."""
    is_pair = isinstance(bands, Sequence) and not isinstance(bands, str) and len(bands) == 2
    listed = bands if is_pair else []
    names = [str(name) for name in listed if isinstance(name, str) and name.strip()]
    if len({*names}) != 2:
        raise ValueError(f"Invalid bands {bands!r}. Must be two different names, as texts.")
    return names


def _border(counts: npt.NDArray[np.uint16], name: str) -> str:
    """Sentence on rows and columns at the border of a band that have one value in all frames."""
    sample = counts[:: 1 + len(counts) // _FRAMES]
    padded = (sample == sample[0, 0, 0]) | (sample == sample[0, -1, -1])
    rows, columns = (int(padded.all(axis=axes).sum()) for axes in ((0, 2), (0, 1)))
    if rows == padded.shape[1] or not rows + columns:
        return ""
    label = f"{rows} rows and {columns} columns of band '{name}' have one value in all frames"
    return f"{label}: a border, which is no measurement. Its pixels are flagged; better cropped."


def _temperatures(films: list[npt.NDArray[np.uint16]]) -> list[str]:
    """Sentence on counts of two cameras that read as the same temperatures in hundredths."""
    samples = [counts[:: 1 + len(counts) // _FRAMES].ravel() for counts in films]
    low, middle, high = np.percentile(samples, [1, 50, 99], axis=1)
    for zero, unit in ((0.0, "degC"), (zero_Celsius, "K")):
        plausible = np.all((low >= 100 * (zero + _SCENE[0])) & (high <= 100 * (zero + _SCENE[1])))
        if plausible and np.ptp(middle) < 100 * _ALIKE:
            medians = " and ".join(f"{median / 100:.1f}" for median in middle)
            label = f"The medians of both bands, over 100, are temperatures: {medians} {unit}"
            rule = "Must be counts of the detector; should these be alike by chance, go on"
            return [f"{label}. {rule}."]
    return []


def _check(recording: xr.Dataset, name: str) -> None:
    """Refuse what is no recording of counts in one band."""
    # Variables and dims.
    over_time = dict.fromkeys(("time", "exposure_time", "frame_flags"), ("time",))
    for variable, dims in {"counts": ("time", "y", "x"), **over_time}.items():
        if variable not in recording or recording[variable].dims != dims:
            actual = recording[variable].dims if variable in recording else "nothing"
            raise ValueError(
                f"Invalid recording of band '{name}': '{variable}' is {actual}. Must be {dims}, as "
                "from a reader of recordings."
            )
    # Times that rise.
    for variable in ("time", "exposure_time"):
        values = schema.check_numbers(
            recording[variable], f"'{variable}' of band '{name}'", "s"
        ).values
        valid = values[~np.isnan(values)] if variable == "exposure_time" else values
        if not valid.size or not np.isfinite(valid).all() or np.any(np.diff(valid) <= 0):
            rule = "Must be known, finite and rise; an exposure time may be NaN, not all"
            raise ValueError(f"Invalid '{variable}' of band '{name}' {shown(values)}. {rule}.")
    # Types.
    for variable in ("counts", "frame_flags"):
        if ((dtype := recording[variable].dtype).kind, dtype.itemsize) != ("u", 2):
            actual = f"dtype {dtype} of the {variable} of band '{name}'"
            raise TypeError(f"Invalid {actual}. Must be uint16.")
