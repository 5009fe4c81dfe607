"""What is done with the rig: wait for the blackbody, sweep it, record a scene.

Gain, offset and response are calibrated before a blackbody that goes through several temperatures;
the emissivity bench goes through them with samples. At each temperature the wheel goes through its
filters, and each of these is a recording of its own, begun only when the temperature rests. What
was recorded is opened by `open_sweep` and `bench_series`, a scene by
`dbthermal.instruments.recording.capture.open_capture`.
"""

import threading
import time as system_time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from dbthermal import store
from dbthermal.instruments.camera import SourceLostError
from dbthermal.instruments.devices import Devices
from dbthermal.instruments.recording.capture import mean_reading
from dbthermal.instruments.recording.fetching import Limits, Reading
from dbthermal.instruments.recording.record import Preview, Summary, record
from dbthermal.instruments.recording.sweep import (
    BLACKBODY,
    bench_series,
    is_complete,
    open_sweep,
    require_filter,
    step_path,
)
from dbthermal.instruments.session import Session

__all__ = ["Step", "bench_series", "open_sweep", "record_scene", "record_sweep", "wait_stable"]

STABILITY_PERIOD: Final = 1.0
"""Time from reading to reading while a temperature is awaited [s]."""


@dataclass(frozen=True)
class Step:
    """
    One recording of a sweep.

    Attributes
    ----------
    number : int
        Of the temperature, from 0.
    temperature : float
        What the blackbody was set to [K].
    blackbody : float
        Mean of what was read of it during the recording [K].
    band : str or None
        Of the filter in the beam; None without a wheel.
    summary : Summary
        How the recording went.
    """

    number: int
    temperature: float
    blackbody: float
    band: str | None
    summary: Summary


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
        With a blackbody: its `stability` and `tolerance` [K], `window` and `timeout` [s].
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
        their mean within `tolerance` of `temperature`.
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
        near = abs(values.mean() - temperature) <= steps.tolerance
        if whole and near and np.ptp(values) <= steps.stability:
            return float(values.mean())
        while whole and readings[-1][0] - readings[0][0] >= steps.window:
            readings.popleft()
        sleep(STABILITY_PERIOD)
    raise TimeoutError(
        f"No rest at {temperature} K within {steps.timeout} s: last {values[-1]} K. Must stay "
        f"within {steps.stability} K for {steps.window} s, and within {steps.tolerance} K of it."
    )


def record_sweep(
    devices: Devices,
    folder: str | Path,
    *,
    set_temperature: Callable[[float], None],
    read_blackbody: Callable[[], float] | None = None,
    limits: Limits | None = None,
    preview: Callable[[Preview], None] | None = None,
    clock: Callable[[], float] = system_time.monotonic,
    sleep: Callable[[float], None] = system_time.sleep,
) -> list[Step]:
    """
    Record at each temperature of the blackbody, as soon as it rests there, through each filter.

    The cameras' offsets are corrected at each temperature, for they drift in the hours of a sweep,
    and a scene too is recorded after a correction. Recordings of this sweep that are in the folder
    and complete are kept, so that a sweep that was interrupted goes on where it was. Call
    `Devices.prepare` before.

    Parameters
    ----------
    devices : Devices
        Of a session with a blackbody.
    folder : str or Path
        Where the recordings go: ``<name>_<step>_<band>.zarr``.
    set_temperature : callable
        Sets the blackbody [K], or asks the user to.
    read_blackbody : callable, optional
        Reads it [K]; by default the thermocouple named ``"blackbody"`` does.
    limits, preview : optional
        As for `instruments.recording.record.record`. The camera behind the wheel is called by
        the band of the filter in the beam.
    clock, sleep : callable
        Time [s], for the wait.

    Returns
    -------
    list of Step
        In the order of the session, those that were kept too.

    Raises
    ------
    ValueError
        If there is no blackbody in the session or the readings; or a recording is there that is
        incomplete, or of another temperature, or during which the wheel turned.
    TimeoutError
        As `wait_stable`; the steps before are kept.
    SourceLostError
        If a camera is lost on the way.
    BosonError, WheelError, ReadingError, OSError
        As `Devices.correct_offsets`, `Devices.select`, `Devices.readings` and `record`.
    """
    session = devices.session
    extra = {} if read_blackbody is None else {BLACKBODY: Reading(read_blackbody)}
    known = {**devices.readings(), **extra}
    if session.blackbody is None or BLACKBODY not in known:
        raise ValueError(f"Invalid session '{session.name}'. Must have and read a blackbody.")
    plan = _plan(session, folder)
    kept = [_kept(number, temperature, band, path) for number, temperature, band, path in plan]
    steps: list[Step] = []
    resting: int | None = None
    for (number, temperature, band, path), was in zip(plan, kept, strict=True):
        if was is None and resting != number:
            set_temperature(temperature)
            wait_stable(session, temperature, known[BLACKBODY].read, clock=clock, sleep=sleep)
            devices.correct_offsets()
            resting = number
        summary = was or _record_step(devices, band, path, extra, limits, preview)
        steps.append(Step(number, temperature, mean_reading(path, BLACKBODY), band, summary))
    return steps


def record_scene(
    devices: Devices,
    path: str | Path,
    *,
    limits: Limits | None = None,
    preview: Callable[[Preview], None] | None = None,
    stop: threading.Event | None = None,
) -> Summary:
    """
    Record a scene with all devices; an emulated scene begins with the recording.

    Call `Devices.prepare` before.

    Parameters
    ----------
    devices : Devices
        Of any session.
    path : str or Path
        Store to make, ``*.zarr``.
    limits, preview, stop : optional
        As for `dbthermal.instruments.recording.record.record`.

    Returns
    -------
    Summary
        How it went.

    Raises
    ------
    FileExistsError, OSError, ValueError
        As `record`.
    """
    identities, own = devices.identities(), devices.session.filtered
    if devices.wheel is not None and devices.wheel.band() != own:
        raise ValueError(f"Invalid filter in the beam. Must be '{own}': prepare the devices.")
    devices.flush()
    if devices.world is not None:
        devices.world.begin()
    return record(
        devices.session,
        devices.sources,
        path,
        readings=devices.readings(),
        identities=identities,
        limits=limits,
        preview=preview,
        stop=stop,
    )


def _plan(session: Session, folder: str | Path) -> list[tuple[int, float, str | None, Path]]:
    """Step, temperature [K], band behind the wheel and recording, in their order."""
    assert session.blackbody is not None
    return [
        (number, temperature, band, step_path(folder, session.name, number, band))
        for number, temperature in enumerate(session.blackbody.temperatures)
        for band in session.swept or (None,)
    ]


def _kept(number: int, temperature: float, band: str | None, path: Path) -> Summary | None:
    """How a recording of the sweep went that is there already; None if there is none."""
    if not path.exists():
        return None
    if not is_complete(path):
        raise ValueError(
            f"Incomplete recording '{path}'. Must be complete: move it away, and this step is "
            "recorded again."
        )
    attrs = store.open_dataset(path).attrs
    was = attrs["provenance"]["parameters"]["blackbody"]["temperatures"]
    if was[number : number + 1] != [temperature]:
        raise ValueError(f"Recording '{path}' of temperatures {was} K. Must be of {temperature} K.")
    require_filter(path, band)
    return Summary(path, attrs["ended"], attrs["totals"])


def _record_step(
    devices: Devices,
    band: str | None,
    path: Path,
    extra: Mapping[str, Reading],
    limits: Limits | None,
    preview: Callable[[Preview], None] | None,
) -> Summary:
    """Turn the filter into the beam, and record to the end."""
    here = devices if band is None else devices.select(band)
    identities = here.identities()
    here.flush()
    summary = record(
        here.session,
        here.sources,
        path,
        readings={**here.readings(), **extra},
        identities=identities,
        limits=limits,
        preview=preview,
    )
    if summary.ended != "duration":
        raise SourceLostError(f"Recording '{path}' ended: {summary.ended}. Must go to its end.")
    require_filter(path, band)
    return summary
