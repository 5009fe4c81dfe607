"""Capture of several bands, from a recording of each band."""

from collections.abc import Sequence
from datetime import datetime
from itertools import combinations
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.constants import zero_Celsius

from dbthermal import _numbers, schema
from dbthermal._arrays import empty, stretches
from dbthermal.readers._recording import FileFlag

_SCENE: Final = (5.0, 100.0)  # temperatures of a scene [degC]
_FRAMES: Final = 16  # about as many frames are sampled
_ALIKE: Final = 5.0  # largest difference of the medians of two bands [K]


def two_bands(
    first: xr.Dataset,
    second: xr.Dataset,
    *further: xr.Dataset,
    bands: Sequence[str],
    offset: float | Sequence[float] | None = None,
) -> xr.Dataset:
    """Recordings of two cameras, or more, as one capture, with the clock of each.

    Each band keeps its own frames and times; nothing is interpolated. `alignment.time_offset` and
    `alignment.align` bring all onto one clock: cameras' dates are hardly ever right to a frame.

    TypeError or ValueError if a recording is not one of counts in one band, or its times are
    unknown or fall; bands are not different names, one for each; sizes differ; there is no offset
    and no date; or recordings do not overlap in time, or hold the same counts. A UserWarning if the
    counts of all bands read as the same temperatures, in hundredths or tenths.

    Parameters
    ----------
    first, second, *further : Dataset
        Recordings of one band each, from `flir`, `tiff`, `raw` or `array`, of the same pixels.
    bands : sequence of str
        Names of the bands, such as ``("8-14", "9.5")``.
    offset : float or sequence of float, optional
        Time from the beginning of the first recording to that of each other one [s]. By default
        from the dates of the files.

    Returns
    -------
    Dataset
        Stage `capture` of `schema`: `counts` (band, time, y, x), `exposure_time` and `frame_flags`
        (band, time). Shorter bands are filled with their last frame, flagged ``padded``, without a
        time; `time` is the clock of the longest one. ``files`` has all recordings' attributes as a
        mapping by band. Copies the counts: twice their memory is needed.

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
    # Recordings of one size, with names.
    cameras = (first, second, *further)
    names = _names(bands, len(cameras))
    for name, recording in zip(names, cameras, strict=True):
        _check(recording, name)
    shape, *shapes = [(recording.sizes["y"], recording.sizes["x"]) for recording in cameras]
    if unlike := {*shapes} - {shape}:
        label = f"Different sizes {shape} and {unlike.pop()} pixels of the bands {names}"
        raise ValueError(f"{label}. Must be equal: turn, resample or crop a recording.")
    # Offsets of the clocks, by which they must overlap.
    shifts = [0.0, *_offsets(cameras, offset)]
    starts, stops = ([recording["time"].values[n] for recording in cameras] for n in (0, -1))
    overlap = min(np.add(stops, shifts)) - max(np.add(starts, shifts))
    lengths = [recording.sizes["time"] for recording in cameras]
    if not overlap > 0 and max(lengths) > 1:
        later, spans = (" and ".join(f"{it:g}" for it in times) for times in (shifts[1:], stops))
        label = f"Invalid offset {later} s: the recordings of {spans} s do not overlap"
        raise ValueError(f"{label}. Must overlap; give offset= if a camera's clock is wrong.")
    # No two recordings may have the same counts, as of a file that is named twice.
    overlapping = [recording["counts"].values[: min(lengths)] for recording in cameras]
    for film, other_film in combinations(overlapping, 2):
        if all(np.array_equal(film[at], other_film[at]) for at in stretches(film)):
            label = f"Same counts in both recordings, of the bands {names}"
            raise ValueError(f"{label}. Must be those of two cameras: is one file named twice?")
    # Frames of all; shorter recordings are filled up, and flagged.
    counts = empty((len(names), max(lengths), *shape), np.uint16)
    times = np.full(counts.shape[:2], np.nan)
    flags = np.full(counts.shape[:2], FileFlag.PADDED.value, dtype=np.uint16)
    for place, (recording, shift) in enumerate(zip(cameras, shifts, strict=True)):
        length = recording.sizes["time"]
        for at in stretches(recording["counts"].values):
            counts[place, :length][at] = recording["counts"].values[at]
        counts[place, length:] = recording["counts"].values[-1]
        times[place, :length] = recording["exposure_time"].values + shift
        flags[place, :length] = recording["frame_flags"].values
    # The capture, on the clock of the longest recording.
    longest = int(np.argmax(lengths))
    clock = cameras[longest]["time"].values + shifts[longest]
    variables = schema.variables("capture", {"counts": counts, "exposure_time": times})
    variables["frame_flags"] = (("band", "time"), flags, FileFlag.cf_attrs(schema.FRAME_FLAGS))
    time = ("time", clock, schema.COORDINATES["time"].attrs)
    attrs = {
        **schema.origin(*(recording.attrs for recording in cameras)),
        "source": " and ".join(str(recording.attrs.get("source", "")) for recording in cameras),
        "offset": shifts[1] if len(shifts) == 2 else shifts[1:],
        "offset_by": "dates" if offset is None else "caller",
        "files": {name: dict(it.attrs) for name, it in zip(names, cameras, strict=True)},
    }
    capture = schema.check(xr.Dataset(variables, {"band": names, "time": time}, attrs), "capture")
    samples = [film[:: 1 + len(film) // _FRAMES] for film in overlapping]
    return schema.warned(capture, *_temperatures(samples), *_unchanging(samples, names))


def _offsets(cameras: Sequence[xr.Dataset], offset: Any) -> list[float]:
    """Times from the beginning of the first recording to those of the later recordings [s]."""
    if offset is None:
        dates = [recording.attrs.get("start") for recording in cameras]
        if None in dates:
            rule = "Must be given as offset= [s], start of the second minus start of the first"
            raise ValueError(f"Unknown dates of the recordings. {rule}; 0.0 if together.")
        begun, *later = (datetime.fromisoformat(str(date)) for date in dates)
        return [(date - begun).total_seconds() for date in later]
    listed = [*offset] if np.ndim(offset) else [offset]
    offsets = [_numbers.real_number("offset [s]", value, _numbers.FINITE) for value in listed]
    if len(offsets) != len(cameras) - 1:
        raise ValueError(f"Invalid offset {offsets} s. Must be one for each later recording.")
    return offsets


def _names(bands: Any, number: int) -> list[str]:
    """Names of the bands, which must be different texts, as many as stated."""
    listed = [*bands] if isinstance(bands, list | tuple | np.ndarray) else []
    names = [str(name) for name in listed if isinstance(name, str) and name.strip() == name != ""]
    if not len({*names}) == len(listed) == number:
        raise ValueError(f"Invalid bands {bands!r}. Must be {number} different trimmed texts.")
    return names


def _unchanging(samples: list[npt.NDArray[np.uint16]], names: list[str]) -> list[str]:
    """Sentences on pixels that never change: a band, its rows and columns, or places of all."""
    stills, sentences = [(sample == sample[0]).all(axis=0) for sample in samples], list[str]()
    for still, name in zip(stills, names, strict=True):
        rows, columns = (int(still.all(axis=axis).sum()) for axis in (1, 0))
        if rows == len(still) and len(samples[0]) > 1:
            sentences.append(f"Band '{name}' never changes. Must be live: does its camera hang?")
        elif rows < len(still) and rows + columns:
            label = f"Rows ({rows}), columns ({columns}) of band '{name}' never change"
            sentences.append(f"{label}: a border. Its pixels are flagged; better cropped.")
    drawn = np.all(stills, axis=0)
    drawn = drawn[~drawn.all(axis=1)][:, ~drawn.all(axis=0)]
    if np.sqrt(drawn.size) < drawn.sum() < drawn.size / 2:  # more than by chance
        label = f"{drawn.sum()} pixels never change in any band: saturated, or a text that is drawn"
        rule = "Must be none: register cameras that stand apart by a film without it"
        sentences.append(f"{label} into the images. {rule}.")
    return sentences


def _temperatures(samples: list[npt.NDArray[np.uint16]]) -> list[str]:
    """Sentence on counts that read as the same temperatures, in hundredths or tenths."""
    low, middle, high = np.percentile(samples, [1, 50, 99], axis=(1, 2, 3))
    for scale, zero, unit in ((100, 0.0, "degC"), (100, zero_Celsius, "K"), (10, 0.0, "degC")):
        least, most = (scale * (zero + limit) for limit in _SCENE)
        if np.all((low >= least) & (high <= most)) and np.ptp(middle) < scale * _ALIKE:
            medians = " and ".join(f"{median / scale:.1f}" for median in middle)
            label = f"The medians of the bands, over {scale}, are temperatures: {medians} {unit}"
            rule = "Must be counts of the detector; should these be alike by chance, go on"
            return [f"{label}. {rule}."]
    return []


def _check(recording: xr.Dataset, name: str) -> None:
    """Refuse all but a recording of counts in one band: variables, dims, types, rising times."""
    names, label = ("counts", "exposure_time", "frame_flags"), f"the recording of band '{name}'"
    schema.check(recording, "recording", names, label)
    for variable in ("counts", "frame_flags"):
        dtype = recording[variable].dtype
        if (dtype.kind, dtype.itemsize) != ("u", 2):
            raise TypeError(f"Invalid dtype {dtype} of '{variable}' of {label}. Must be uint16.")
    stamps = recording["exposure_time"].dropna("time").values
    schema.rising_numbers(stamps, f"'exposure_time' of {label}", "s", least=1)
