"""The steps of a session: open its cameras, wait for the blackbody, record at each temperature.

Gain, offset and response are calibrated before a blackbody that goes through several temperatures;
the emissivity bench goes through them with a sample. Each step is a recording of its own, begun
only when the temperature rests. A scene is one recording: `dbthermal.instruments.record.record`.
"""

import time as system_time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

import numpy as np
import xarray as xr

from dbthermal import schema
from dbthermal.instruments.capture import open_capture
from dbthermal.instruments.emulated.frames import EmulatedCamera, Faults, Picture
from dbthermal.instruments.emulated.world import World
from dbthermal.instruments.fetching import Limits, Reading
from dbthermal.instruments.frames_source import FrameFlag, FrameSource
from dbthermal.instruments.record import Summary, record
from dbthermal.instruments.session import Session

STABILITY_PERIOD: Final = 1.0
"""Time from reading to reading while a temperature is awaited [s]."""

_NO_VIEW: Final = int(FrameFlag.SHUTTER_CLOSED)


@contextmanager
def open_sources(
    session: Session,
    world: World | None = None,
    pictures: Mapping[str, Picture] | None = None,
    faults: Mapping[str, Faults] | None = None,
) -> Iterator[dict[str, FrameSource]]:
    """
    Open the cameras of a session: the real ones, or, by its one switch, the emulated ones.

    Parameters
    ----------
    session : Session
        Cameras at ``v4l2:///dev/video0``, or ``sim://camera/<name>`` with the name of a camera of
        the world. The band of a slot of the wheel is the band in the beam, else the camera's own.
    world : World, optional
        The emulated bench; needed for emulated cameras.
    pictures : mapping, optional
        Band to what the emulated cameras see in it.
    faults : mapping, optional
        Band to what goes wrong with its emulated camera.

    Yields
    ------
    dict
        Band to its source, closed in the end.

    Raises
    ------
    ValueError
        If an address is of another kind, or there is no world for it.
    OSError
        If a camera cannot be opened.
    """
    with ExitStack() as stack:
        sources: dict[str, FrameSource] = {}
        for band, camera in session.cameras.items():
            address = urlsplit(session.url(camera.video))
            if address.scheme == "v4l2" and not session.simulated:
                from dbthermal.instruments import v4l2, v4l2_calls  # noqa: PLC0415 - Linux only

                stream = v4l2_calls.Stream(
                    session.shape, session.frame_rate, session.telemetry_rows
                )
                sources[band] = stack.enter_context(v4l2.Capture.open(address.path, stream))
            elif address.scheme == "sim" and session.simulated and world is not None:
                emulated = EmulatedCamera(
                    world,
                    address.path.lstrip("/"),
                    pictures or {},
                    None if band in session.filters.values() else band,
                    session.shape,
                    session.frame_rate,
                    session.telemetry_rows,
                    (faults or {}).get(band, Faults()),
                )
                sources[band] = stack.enter_context(emulated)
            else:
                raise ValueError(
                    f"Invalid address '{address.geturl()}' of the camera of band '{band}'. Must be "
                    "'v4l2:///dev/...', or 'sim://camera/<name>' with a world if simulated."
                )
        yield sources


def wait_stable(
    session: Session,
    temperature: float,
    read: Callable[[], float],
    *,
    clock: Callable[[], float] = system_time.monotonic,
    sleep: Callable[[float], None] = system_time.sleep,
) -> float:
    """
    Wait until a temperature rests where it was set.

    Parameters
    ----------
    session : Session
        With a blackbody: its `stability` [K], `window` [s] and `timeout` [s].
    temperature : float
        Where it was set [K].
    read : callable
        Reads it [K].
    clock, sleep : callable
        Time [s].

    Returns
    -------
    float
        Mean of the readings in the window [K].

    Raises
    ------
    TimeoutError
        If within `timeout` the readings of no window lay within `stability` of one another and
        their mean as near to `temperature`.
    ValueError
        If the session has no blackbody.
    """
    if session.blackbody is None:
        raise ValueError(f"Invalid session '{session.name}'. Must have a blackbody.")
    steps, start = session.blackbody, clock()
    readings: deque[tuple[float, float]] = deque()
    while clock() - start <= steps.timeout:
        readings.append((clock(), read()))
        values = np.array([value for _, value in readings])
        whole = readings[-1][0] - readings[0][0] >= steps.window
        near = abs(values.mean() - temperature) <= steps.stability
        if whole and near and np.ptp(values) <= steps.stability:
            return float(values.mean())
        while whole and readings[-1][0] - readings[0][0] >= steps.window:
            readings.popleft()
        sleep(STABILITY_PERIOD)
    raise TimeoutError(
        f"No rest at {temperature} K within {steps.timeout} s: last {values[-1]} K. Must stay "
        f"within {steps.stability} K for {steps.window} s."
    )


def record_steps(
    session: Session,
    sources: Mapping[str, FrameSource],
    folder: str | Path,
    *,
    set_temperature: Callable[[float], None],
    readings: Mapping[str, Reading],
    limits: Limits | None = None,
    clock: Callable[[], float] = system_time.monotonic,
    sleep: Callable[[float], None] = system_time.sleep,
) -> list[Summary]:
    """
    Record one step at each temperature of the blackbody, as soon as it rests there.

    Parameters
    ----------
    session : Session
        With a blackbody.
    sources : mapping
        As for `dbthermal.instruments.record.record`.
    folder : str or Path
        Where the recordings go: ``<name>_<number>.zarr``.
    set_temperature : callable
        Sets the blackbody [K], or asks the user to.
    readings : mapping
        As for `record`; ``"blackbody"`` is awaited.
    limits : Limits, optional
        As for `record`.
    clock, sleep : callable
        Time [s], for the wait.

    Returns
    -------
    list of Summary
        Of each step.

    Raises
    ------
    ValueError
        If there is no blackbody in the session or the readings.
    TimeoutError
        As `wait_stable`; the steps before are kept.
    """
    if session.blackbody is None or "blackbody" not in readings:
        raise ValueError(f"Invalid session '{session.name}'. Must have and read a blackbody.")
    done = []
    for number, temperature in enumerate(session.blackbody.temperatures):
        set_temperature(temperature)
        wait_stable(session, temperature, readings["blackbody"].read, clock=clock, sleep=sleep)
        step = replace(session, name=f"{session.name}_{number:02d}")
        path = Path(folder) / f"{step.name}.zarr"
        done.append(record(step, sources, path, readings=readings, limits=limits))
    return done


def blackbody_movies(paths: Mapping[float, str | Path], *, frames: int) -> xr.Dataset:
    """
    Put the steps of a calibration together.

    Parameters
    ----------
    paths : mapping
        Temperature [K] to the recording at it.
    frames : int
        Frames of each to take, the first ones of each band that are whole and show the blackbody.

    Returns
    -------
    Dataset
        Stage `blackbody_movies` of `schema`: `counts` (band, temperature, frame, y, x).

    Raises
    ------
    ValueError
        If a recording has fewer good frames in a band.
    """
    movies = []
    for _, path in sorted(paths.items()):
        capture = open_capture(path)
        movies.append(
            xr.concat([_good(capture, band, frames, path) for band in capture["band"]], dim="band")
        )
    axis = xr.DataArray(
        sorted(paths),
        dims="temperature",
        name="temperature",
        attrs=schema.COORDINATES["temperature"].attrs,
    )
    counts = xr.concat(movies, dim=axis).transpose("band", "temperature", "frame", "y", "x")
    return schema.check(counts.to_dataset(name="counts"), "blackbody_movies")


def _good(capture: xr.Dataset, band: xr.DataArray, frames: int, path: str | Path) -> xr.DataArray:
    """Counts (frame, y, x) of good frames of one band."""
    one = capture.sel(band=band)
    good = np.flatnonzero(
        np.isfinite(one["exposure_time"].values) & ((one["frame_flags"].values & _NO_VIEW) == 0)
    )
    if good.size < frames:
        raise ValueError(
            f"Invalid recording '{path}' with {good.size} good frames in band '{band.item()}'. "
            f"Must have {frames}."
        )
    counts = one["counts"].isel(time=slice(0, int(good[frames - 1]) + 1)).load()
    return counts.isel(time=good[:frames]).drop_vars("time").rename(time="frame")
