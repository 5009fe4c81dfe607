"""Recorder of captures, and reader of recordings.

`record` writes the frames of all cameras and the readings beside them; `open_capture` opens a
recording, `notes` its log, `overview` a folder of recordings, and `open_sweep` and `bench_series`
those of a blackbody. See `dbthermal.instruments.protocols` for whole procedures.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr

from dbthermal import schema, store
from dbthermal._arrays import Mask
from dbthermal.alignment import exposure_times, fill_times
from dbthermal.correction import correct
from dbthermal.instruments.camera import UNTIMED, FrameFlag
from dbthermal.instruments.recording._recorder import Limits, Preview, Reading, Summary, record
from dbthermal.instruments.session import BLACKBODY
from dbthermal.store._whole import SignalExit, raised_signals

__all__ = [
    "Limits",
    "Preview",
    "Reading",
    "SignalExit",
    "Summary",
    "bench_series",
    "notes",
    "open_capture",
    "open_sweep",
    "overview",
    "raised_signals",
    "record",
    "require_whole",
]
__dir__ = __all__.copy

Place = tuple[slice, slice]

# Attribute of a sweep, as of `calibration.fit_response`, by the key of the session's blackbody.
_ACCURACY: Final = {
    "blackbody_accuracy": "accuracy",
    "blackbody_emissivity": "emissivity",
    "room_temperature": "room",
}
_WHOLE: Final = 0.95  # share of the promised frames with which a recording is whole [1]


def open_capture(path: str | Path, *, fitted: bool = False) -> xr.Dataset:
    """Open a recording as stage `capture`, also one that was cut short or is being written.

    FileNotFoundError or ValueError if the folder does not exist or is no recording, a band has
    fewer than two frames with a time, or as `dbthermal.store.open_dataset`.

    Parameters
    ----------
    path : str or Path
        Folder ``*.zarr``, from `record`.
    fitted : bool
        True for a camera that stamps frames by its own clock: its exposure times then come from a
        line through both clocks, :math:`h = a + b d` with the device's time d and the host's h, by
        least squares. They are late by the mean time that a frame takes to the host.

    Returns
    -------
    Dataset
        `counts` (band, time, y, x) [count], read when used; `exposure_time` (band, time) [s], NaN
        for a frame that is damaged, missing or not new; `frame_flags` (band, time), with bit
        ``shutter_closed``; `device_time`, `host_time`, `sequence`, and the camera's telemetry, if
        any. `time` is when the first band was exposed [s]. If fitted, attribute ``clock_rates`` has
        b of each band. See the example of `dbthermal.instruments.protocols.record_scene`.
    """
    recording = store.open_dataset(path)
    if "log_time" not in recording:  # its frames would count as a second apart
        raise ValueError(f"No recording '{path}'. Must be, or be opened by store.open_dataset.")
    opened = recording.drop_dims("log").drop_vars("time", errors="ignore")
    opened = _fitted(opened) if fitted else opened
    # Exposure times are checked against a coordinate, which is made of them.
    numbered = opened.assign_coords(time=np.arange(opened.sizes["time"], dtype=np.float64))
    time = fill_times(exposure_times(numbered)[0])
    seconds = {**schema.COORDINATES["time"].attrs, "long_name": "time since the start"}
    return schema.check(numbered.assign_coords(time=("time", time, seconds)), "capture")


def _fitted(recording: xr.Dataset) -> xr.Dataset:
    """Put exposure times of good frames on the host's clock by a line through both."""
    device, host = recording["device_time"].values, recording["host_time"].values
    stamps, rates, valid = np.full(device.shape, np.nan), [], _good(recording, UNTIMED)
    for place, (band, good) in enumerate(zip(recording["band"].values, valid, strict=True)):
        if np.count_nonzero(good) < 2:
            raise ValueError(f"Invalid band '{band}' without two good frames. Must have two.")
        line = np.polynomial.Polynomial.fit(device[place, good], host[place, good], 1)
        stamps[place, good] = line(device[place, good])
        rates.append(float(line.deriv()(0.0)))
    times = ("band", "time"), stamps, recording["exposure_time"].attrs
    return recording.assign(exposure_time=times).assign_attrs(clock_rates=rates)


def notes(path: str | Path) -> list[tuple[float, str, str, float]]:
    """Log of a recording: time [s], kind, source and value of each note, in the order of writing.

    Kinds are ``"reading"``, ``"frames_lost"``, ``"shutter_closed"`` and more; the attributes of the
    store explain their values.

    Parameters
    ----------
    path : str or Path
        Folder ``*.zarr`` of the recording; FileNotFoundError if it does not exist.
    """
    recording = store.open_dataset(path)
    kinds = {number: name for name, number in recording.attrs["log_kinds"].items()}
    sources = recording.attrs["log_sources"]
    columns = (recording[f"log_{name}"].values for name in ("time", "kind", "source", "value"))
    return [
        (float(time), kinds[int(kind)], sources[int(source)], float(value))
        for time, kind, source, value in zip(*columns, strict=True)
    ]


def overview(folder: str | Path) -> xr.Dataset:
    """Table of the recordings in a folder: frames, losses, rate and completeness of each band.

    Parameters
    ----------
    folder : str or Path
        With recordings (ValueError without any); all else in it is ignored.

    Returns
    -------
    Dataset
        One row for each recording and band: `frames`, of which `damaged`; `good` ones, which are
        whole, have a time and show the view, of those `promised` by duration and nominal rate;
        `lost` by camera or driver, and `refused` by a full queue; `frame_rate` by the stamps [Hz],
        NaN without two; `complete`, whether the recording went to its planned end. Coordinates
        `recording` and `band`.
    """
    rows = []
    for path in sorted(Path(folder).glob("*.zarr")):
        attrs = (recording := store.open_dataset(path)).attrs
        is_recording = "log_time" in recording  # what is made of it has its attributes, and no log
        for band, number in attrs["frames_written"].items() if is_recording else ():
            frames = recording.sel(band=band).isel(time=slice(0, number))
            steps = np.diff(frames["device_time"].values[_good(frames, UNTIMED)])
            session = attrs["provenance"]["parameters"]
            row = {
                "good": np.count_nonzero(_good(frames, UNTIMED | FrameFlag.SHUTTER_CLOSED)),
                "promised": round(session["duration"] * session["frame_rate"]),
                "frame_rate": 1.0 / float(np.median(steps)) if steps.size else np.nan,
                "complete": bool(attrs["complete"]),
            }
            rows.append({"recording": path.stem, "band": band, **attrs["totals"][band], **row})
    if not rows:
        raise ValueError(f"Invalid folder '{folder}' without recordings. Must have one.")
    table = xr.Dataset({name: ("row", [row[name] for row in rows]) for name in rows[0]})
    return table.set_coords(["recording", "band"])


def _good(frames: xr.Dataset, bad: FrameFlag, stamp: str = "device_time") -> Mask:
    """True for the frames that have a stamp and none of the flags."""
    flags, stamps = frames["frame_flags"].values, frames[stamp].values
    return np.asarray(np.isfinite(stamps) & ((flags & int(bad)) == 0))


def require_whole(folder: str | Path) -> None:
    """ValueError with each recording and band that was cut short or has too few good frames.

    Parameters
    ----------
    folder : str or Path
        With recordings, see `overview`; a band must have 95 % of the frames that are promised.
    """
    table = overview(folder)
    short = table.isel(row=~table["complete"] | (table["good"] < _WHOLE * table["promised"]))
    if cases := [
        f"'{row['recording']}', band '{row['band']}': {row['good']} good frames of "
        f"{row['promised']} promised" + ("" if row["complete"] else ", cut short")
        for row in short.to_dataframe().to_dict("records")
    ]:
        rule = f"Must have {_WHOLE:.0%} of them: move these away, and record them again"
        raise ValueError(f"Invalid recordings in '{folder}': {'; '.join(cases)}. {rule}.")


def open_sweep(folder: str | Path, name: str, *, frames: int) -> xr.Dataset:
    """Join the recordings of a blackbody sweep into one dataset.

    FileNotFoundError or ValueError if there is no recording of such a session, or one is missing or
    incomplete, has fewer good frames in a band, or no reading of the blackbody, or those of a step
    differ by more than the session's stability.

    Parameters
    ----------
    folder, name, frames : str or Path, str, int
        Of `dbthermal.instruments.protocols.record_sweep`, and of the session; frames to take of
        each recording: the first ones of each band that are whole and show the blackbody.

    Returns
    -------
    Dataset
        Stage `blackbody_movies` of `schema`: `counts` (band, temperature, frame, y, x) [count],
        with the band of the camera without filters from the recordings through the first filter.
        `temperature` is the mean of the blackbody's readings during the recordings of a step [K].
        Attributes as `calibration.fit_response` takes them, where the session states its accuracy.
    """
    steps, stability, shared = _sweep(folder, name)
    movies = [
        _movie(paths, frames).expand_dims(temperature=[_agreed(paths, BLACKBODY, stability)])
        for paths in steps
    ]
    counts = xr.concat(movies, "temperature").sortby("temperature")
    counts["temperature"].attrs = schema.COORDINATES["temperature"].attrs
    joined = counts.transpose("band", "temperature", "frame", "y", "x").to_dataset(name="counts")
    return schema.check(joined.assign_attrs(shared), "blackbody_movies")


def bench_series(
    folder: str | Path, name: str, region: Mapping[str, Place], correction: xr.Dataset | None = None
) -> dict[str, xr.Dataset]:
    """Mean counts and temperatures of an emissivity bench, a measurement for each step.

    Parameters
    ----------
    folder, name : str or Path, str
        Of `dbthermal.instruments.protocols.record_sweep`, and of the session.
    region : mapping
        Material to its rows and columns. The thermocouple named like it is the object's.
    correction : Dataset, optional
        From `dbthermal.correction.fit_correction`, of all bands. With it, the counts are corrected,
        and pixels that are bad or saturated are left out.

    Returns
    -------
    dict
        Material to its series, stage `contact` of `schema`: `counts` (band, measurement), mean over
        the region and the good frames [count]; `object_temperature` and `background_temperature`
        (measurement), means of the readings during the recordings [K]. FileNotFoundError or
        ValueError as for `open_sweep`; or if a region has no pixel or a band no good frame.
    """
    steps, stability, shared = _sweep(folder, name)
    views = [_views(paths) for paths in steps]
    background = [_agreed(paths, BLACKBODY, stability) for paths in steps]
    bands, series = [*views[0]], dict[str, xr.Dataset]()
    for material, place in region.items():
        values = {
            "counts": [[_mean(it[band], place, correction) for it in views] for band in bands],
            "object_temperature": [_agreed(paths, material, stability) for paths in steps],
            "background_temperature": background,
        }
        dataset = xr.Dataset(schema.variables("contact", values), {"band": bands}, shared)
        series[material] = schema.check(dataset.assign_attrs(material=material), "contact")
    return series


def step_path(folder: str | Path, name: str, number: int, band: str | None) -> Path:
    """Path of a recording of a sweep: ``<name>_<number>_<band>.zarr``, without a wheel no band."""
    behind = "" if band is None else f"_{band}"
    return Path(folder) / f"{name}_{number:02d}{behind}.zarr"


def require_filter(path: str | Path, band: str | None) -> None:
    """ValueError unless the filter of a band stayed in the beam throughout a recording."""
    if band is None:
        return
    filters = store.open_dataset(path).attrs["provenance"]["parameters"]["filters"]
    slots = {value for _, _, source, value in notes(path) if source == "filter_wheel"}
    if {filters.get(f"{slot:.0f}") for slot in slots} != {band}:
        label = f"Invalid slots {sorted(slots)} of the wheel in the recording '{path}'"
        rule = f"that of filter '{band}' throughout: move it away, and record it again"
        raise ValueError(f"{label}. Must be {rule}.")


def mean_reading(path: str | Path, source: str) -> float:
    """Mean of an instrument's readings during a recording, in its unit; ValueError without any."""
    if not (values := [note[3] for note in notes(path) if note[1:3] == ("reading", source)]):
        raise ValueError(f"No reading of '{source}' in the recording '{path}'. Must have one.")
    return float(np.mean(values))


def _sweep(folder: str | Path, name: str) -> tuple[list[list[Path]], float, dict[str, Any]]:
    """Recordings of each temperature, one for each filter, stability [K] and origin of a sweep."""
    for path in sorted(Path(folder).glob(f"{name}_[0-9][0-9]*.zarr")):
        attrs = store.open_dataset(path).attrs
        session = attrs["provenance"]["parameters"]
        if session["name"] == name and (blackbody := session["blackbody"]) is not None:
            break
    else:
        raise FileNotFoundError(f"No recording of a sweep '{name}' in '{folder}'. Must have one.")
    # Its recordings, each of which must be whole.
    behind = [band for band in session["cameras"] if band in session["filters"].values()]
    bands, steps = session["sweep"] or behind or [None], []
    for number in range(len(blackbody["temperatures"])):
        steps.append([step_path(folder, name, number, band) for band in bands])
        for path, band in zip(steps[-1], bands, strict=True):
            if not (path.exists() and store.open_dataset(path).attrs.get("complete", False)):
                state = f"{'Incomplete' if path.exists() else 'Missing'} recording '{path}'"
                raise ValueError(f"{state} of the sweep. Must be recorded to its end.")
            require_filter(path, band)
    stated = {key: blackbody.get(name) for key, name in _ACCURACY.items()}
    shared = {key: attrs[key] for key in ("is_simulated", "origin")}
    shared |= {key: value for key, value in stated.items() if value is not None}
    return steps, blackbody["stability"], shared


def _agreed(paths: list[Path], source: str, stability: float) -> float:
    """Mean of a reading over the recordings of a step; ValueError if they differ."""
    means = [mean_reading(path, source) for path in paths]
    if np.ptp(means) > stability:
        raise ValueError(
            f"Invalid readings {means} K of '{source}' in the recordings "
            f"{[path.name for path in paths]}. Must agree within {stability} K: move them "
            "away, and this step is recorded again."
        )
    return float(np.mean(means))


def _views(paths: list[Path]) -> dict[str, xr.Dataset]:
    """Counts of each band in the good frames of the first recording that has it."""
    views: dict[str, xr.Dataset] = {}
    for path in paths:
        capture = open_capture(path).assign_attrs(path=str(path))
        for band in map(str, capture["band"].values):
            # Frames that are whole, have a time, and show the view.
            good = _good(capture.sel(band=band), FrameFlag.SHUTTER_CLOSED, "exposure_time")
            view = capture[["counts"]].sel(band=[band]).isel(time=np.flatnonzero(good))
            views.setdefault(band, view)
    return views


def _movie(paths: list[Path], frames: int) -> xr.DataArray:
    """Counts (band, frame, y, x) of a step."""
    films = []
    for band, view in _views(paths).items():
        if (number := view.sizes["time"]) < frames:
            text = f"with {number} good frames in band '{band}'. Must have {frames}"
            raise ValueError(f"Invalid recording '{view.attrs['path']}' {text}.")
        counts = view["counts"].isel(time=slice(frames)).load()
        films.append(counts.drop_vars("time").rename(time="frame"))
    return xr.concat(films, dim="band")


def _mean(view: xr.Dataset, region: Place, correction: xr.Dataset | None) -> float:
    """Mean counts of a region in a band."""
    place = {"y": region[0], "x": region[1]}
    cropped = view.isel(place)
    counts = cropped["counts"]
    source = f"of band '{view['band'].item()}' in '{view.attrs['path']}'"
    if counts.size == 0:
        raise ValueError(f"No frame or no pixel {source}. Must have one.")
    if correction is not None:
        corrected = correct(cropped, correction.isel(place))
        counts = corrected["counts"].where(corrected["status"] == 0)
    mean = float(counts.astype(np.float64).mean())
    if not np.isfinite(mean):
        raise ValueError(f"No good pixel {source}. Must have one.")
    return mean
