"""Reader of recordings: the stage `capture`, the log, and an overview of a folder."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import schema, store
from dbthermal.alignment import exposure_times, fill_times
from dbthermal.instruments.camera import UNTIMED, FrameFlag


def open_capture(path: str | Path, *, fitted: bool = False) -> xr.Dataset:
    r"""Open a recording as stage `capture`, also one that was cut short or is being written.

    Parameters
    ----------
    path : str or Path
        Folder ``*.zarr``, from `record`.
    fitted : bool
        True for a camera whose stamps are on a clock of its own: its exposure times then come from
        a line through both clocks, :math:`h = a + b d` with the device's time d and the host's h,
        by least squares. They are late by the mean time that a frame takes to the host.

    Returns
    -------
    Dataset
        `counts` (band, time, y, x) [count], read when used; `exposure_time` (band, time) [s], NaN
        for a frame that is damaged, missing or not new; `frame_flags` (band, time), with bit
        ``shutter_closed``; `device_time`, `host_time`, `sequence`, and the camera's telemetry, if
        any. `time` is when the first band was exposed [s]. If fitted, attribute ``clock_rates`` has
        b of each band.

    Raises
    ------
    FileNotFoundError, ValueError
        If the folder does not exist; if a band has fewer than two frames with a time, or a file is
        not as it was written, see `dbthermal.store.open_dataset`.

    Examples
    --------
    >>> from dbthermal.instruments import devices, protocols, recording, session
    >>> camera = session.Camera(session.Device("sim://boson/wide", "v4l2:///dev/video0"))
    >>> plan = session.Session("pot", True, "scene", 0.2, {"8-14": camera}, shape=(24, 32))
    >>> path, limits = getfixture("tmp_path") / "pot.zarr", recording.Limits(reserve=0)
    >>> with devices.open_devices(plan) as rig:
    ...     summary = protocols.record_scene(rig, path, limits=limits)
    >>> capture = recording.open_capture(path)
    >>> capture["counts"].dims, round(float(capture["time"].diff("time").median()), 3)  # s
    (('band', 'time', 'y', 'x'), 0.017)
    """
    recording = store.open_dataset(path)
    opened = recording.drop_dims("log", errors="ignore").drop_vars("time", errors="ignore")
    if fitted:
        opened = _fitted(opened)
    # Exposure times are checked against a coordinate, which is made of them.
    numbered = opened.assign_coords(time=np.arange(opened.sizes["time"], dtype=np.float64))
    time = fill_times(exposure_times(numbered)[0])
    seconds = {**schema.COORDINATES["time"].attrs, "long_name": "time since the start"}
    return schema.check(numbered.assign_coords(time=("time", time, seconds)), "capture")


def notes(path: str | Path) -> list[tuple[float, str, str, float]]:
    """Log of a recording: time [s], kind, source and value of each note, in the order of writing.

    Kinds are ``"reading"``, ``"frames_lost"``, ``"shutter_closed"`` and others; the attributes of
    the store explain their values.

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


def mean_reading(path: str | Path, source: str) -> float:
    """Mean of an instrument's readings during a recording, in its unit, without failed ones.

    FileNotFoundError if the recording does not exist; ValueError if it has no such reading.
    """
    values = [note[3] for note in notes(path) if note[1:3] == ("reading", source)]
    if not values:
        raise ValueError(f"No reading of '{source}' in the recording '{path}'. Must have one.")
    return float(np.mean(values))


def overview(folder: str | Path) -> xr.Dataset:
    """Table of the recordings in a folder: frames, losses, rate and completeness of each band.

    Parameters
    ----------
    folder : str or Path
        With recordings (ValueError without any); other files in it are passed over.

    Returns
    -------
    Dataset
        One row for each recording and band: `frames`, of which `damaged`; `lost` by camera or
        driver, and `refused` by a full queue; `frame_rate` by the good frames' stamps [Hz], NaN
        without two; `complete`, whether the recording went to its planned end. Coordinates
        `recording` and `band`.
    """
    rows = [
        {"recording": path.stem, "band": band, **totals, **_rate_and_end(opened, band)}
        for path in sorted(Path(folder).glob("*.zarr"))
        if "frames_written" in (opened := store.open_dataset(path)).attrs
        for band, totals in opened.attrs["totals"].items()
    ]
    if not rows:
        raise ValueError(f"Invalid folder '{folder}' without recordings. Must have one.")
    table = xr.Dataset({name: ("row", [row[name] for row in rows]) for name in rows[0]})
    return table.set_coords(["recording", "band"])


def _rate_and_end(recording: xr.Dataset, band: str) -> dict[str, float | bool]:
    stamps = recording["device_time"].sel(band=band)
    usable = (recording["frame_flags"].sel(band=band) & int(UNTIMED)) == 0
    steps = np.diff(stamps.values[usable.values & np.isfinite(stamps.values)])
    rate = 1.0 / float(np.median(steps)) if steps.size else np.nan
    return {"frame_rate": rate, "complete": bool(recording.attrs["complete"])}


def good_frames(capture: xr.Dataset, band: str) -> npt.NDArray[np.intp]:
    """Positions in `time` of a band's frames that are whole, have a time, and show the view."""
    one = capture.sel(band=band)
    has_view = (one["frame_flags"].values & int(FrameFlag.SHUTTER_CLOSED)) == 0
    return np.flatnonzero(np.isfinite(one["exposure_time"].values) & has_view)


def _fitted(recording: xr.Dataset) -> xr.Dataset:
    """Put exposure times of good frames on the host's clock by a line through both."""
    unusable = recording["frame_flags"].values & int(UNTIMED)
    device, host = recording["device_time"].values, recording["host_time"].values
    stamps, rates = np.full(device.shape, np.nan), []
    for place, band in enumerate(recording["band"].values):
        good = (unusable[place] == 0) & np.isfinite(device[place])
        if np.count_nonzero(good) < 2:
            raise ValueError(f"Invalid band '{band}' without two good frames. Must have two.")
        line = np.polynomial.Polynomial.fit(device[place, good], host[place, good], 1)
        stamps[place, good] = line(device[place, good])
        rates.append(float(line.deriv()(0.0)))
    attrs = recording["exposure_time"].attrs
    return recording.assign(exposure_time=(("band", "time"), stamps, attrs)).assign_attrs(
        clock_rates=rates
    )
