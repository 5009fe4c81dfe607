"""Procedures of the rig: wait for the blackbody, record a blackbody sweep, record a scene.

A blackbody at several temperatures calibrates gain, offset and response, and with samples beside it
the emissivity bench. At each temperature the wheel goes through its filters, and there is a
recording for each filter. `dbthermal.instruments.recording` opens the recordings.
"""

from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.constants import zero_Celsius

from dbthermal import store
from dbthermal.instruments import recording
from dbthermal.instruments.camera import SourceLostError
from dbthermal.instruments.devices import Devices
from dbthermal.instruments.recording import Limits, Preview, Summary
from dbthermal.instruments.session import BLACKBODY, Session
from dbthermal.instruments.transport import SYSTEM, Clock

__all__ = ["ask_for_blackbody", "record_scene", "record_sweep", "wait_stable"]
__dir__ = __all__.copy

STABILITY_PERIOD: Final = 1.0  # time from reading to reading while a temperature is awaited [s]


def ask_for_blackbody(name: str, temperature: float) -> None:
    """Ask the user to set the blackbody to a temperature, and wait for Enter.

    RuntimeError if there is no keyboard, as under papermill.

    Parameters
    ----------
    name, temperature : str, float
        Name of the session, for the question; temperature [K].
    """
    celsius = f"{temperature - zero_Celsius:.2f} degC"
    wish = f"set the blackbody to {celsius} and press Enter; then its rest is awaited. "
    try:
        input(f"\n{name}: {wish}")
    except (EOFError, NotImplementedError) as error:
        label = f"Nobody at a keyboard sets the blackbody to {celsius}"
        raise RuntimeError(f"{label}. Must be run in a terminal, or in Jupyter.") from error


def wait_stable(
    session: Session, temperature: float, read: Callable[[], float], *, clock: Clock = SYSTEM
) -> float:
    """Wait until a temperature is stable near its set point, and return its mean [K].

    Within the session's `window` the readings must lie within its `stability` of one another, and
    their mean within its `tolerance` of the set point; TimeoutError after its `timeout`, ValueError
    if it has no blackbody.

    Parameters
    ----------
    session, temperature : Session, float
        Session with a blackbody; set point [K].
    read, clock : callable, Clock
        Reads the temperature [K]; clock of the device.
    """
    if session.blackbody is None:
        raise ValueError(f"Invalid session '{session.name}'. Must have a blackbody.")
    steps, start = session.blackbody, clock()
    readings: deque[tuple[float, float]] = deque()
    while clock() - start <= steps.timeout:
        # The next reading.
        readings.append((clock(), read()))
        values = np.array([value for _, value in readings])
        # The rule of the session.
        whole = readings[-1][0] - readings[0][0] >= steps.window
        near = abs(values.mean() - temperature) <= steps.tolerance
        if whole and near and np.ptp(values) <= steps.stability:
            return float(values.mean())
        # Readings before the window are dropped.
        while whole and readings[-1][0] - readings[0][0] >= steps.window:
            readings.popleft()
        clock.sleep(STABILITY_PERIOD)
    raise TimeoutError(
        f"No rest at {temperature} K within {steps.timeout:g} s: last {values[-1]} K. Must stay "
        f"within {steps.stability} K for {steps.window:g} s, and within {steps.tolerance} K of it."
    )


def record_sweep(
    devices: Devices,
    folder: str | Path,
    *,
    set_temperature: Callable[[float], None],
    limits: Limits | None = None,
    preview: Callable[[Preview], None] | None = None,
) -> list[Summary]:
    """Record a blackbody at each of its temperatures, once it is stable, through each filter.

    The cameras' offsets are corrected at each temperature, for they drift in the hours of a sweep.
    Complete recordings of this sweep that are in the folder are kept, so that an interrupted sweep
    goes on where it was. If the folder is renamed or moved meanwhile the sweep goes on in it. Call
    `Devices.prepare` before.

    ValueError if the session has no blackbody, or no reading of it; or a recording exists that is
    incomplete, of another temperature, or during which the wheel turned. TimeoutError as
    `wait_stable`; SourceLostError or FileNotFoundError if a camera is lost, or the folder deleted.
    What was recorded is kept.

    Parameters
    ----------
    devices : Devices
        Of a session with a blackbody, which the thermocouple of that name reads.
    folder, set_temperature : str or Path, callable
        Where the recordings go (``<name>_<step>_<band>.zarr``); sets the blackbody [K], or asks the
        user to set it.
    limits, preview : optional
        As for `dbthermal.instruments.recording.record`. The camera behind the wheel has the name of
        the filter in the beam.

    Returns
    -------
    list of Summary
        In the order of the session, by temperature, then filter, with those that were kept.
    """
    session = devices.session
    readings = devices.readings()
    if session.blackbody is None or BLACKBODY not in readings:
        raise ValueError(f"Invalid session '{session.name}'. Must have and read a blackbody.")
    Path(folder).mkdir(parents=True, exist_ok=True)
    held = store.HeldFolder(Path(folder))
    plan = [
        (number, temperature, band, recording.step_path(folder, session.name, number, band))
        for number, temperature in enumerate(session.blackbody.temperatures)
        for band in session.swept or (None,)
    ]
    summaries = [_kept(*step) for step in plan]
    resting: int | None = None
    for place, (number, temperature, band, planned) in enumerate(plan):
        path = held.place() / planned.name
        if summaries[place] is None:
            # The blackbody, once for all filters of a temperature.
            if resting != number:
                set_temperature(temperature)
                wait_stable(session, temperature, readings[BLACKBODY].read, clock=devices.clock)
                devices.correct_offsets()
                resting, path = number, held.place() / planned.name
            # The filter, and the recording to its end.
            selected = devices if band is None else devices.select(band)
            summary = _record(selected, path, limits=limits, preview=preview)
            if summary.ended != "duration":
                rule = "Must go to its end"
                raise SourceLostError(f"Recording '{path}' ended: {summary.ended}. {rule}.")
            path = summary.path
            recording.require_filter(path, band)
            summaries[place] = summary
        recording.mean_reading(path, BLACKBODY)  # it must have a reading of the blackbody
    return [summary for summary in summaries if summary is not None]


def record_scene(
    devices: Devices,
    path: str | Path,
    *,
    limits: Limits | None = None,
    preview: Callable[[Preview], None] | None = None,
) -> Summary:
    """Record a scene with all devices; an emulated scene begins with the recording.

    Parameters
    ----------
    devices, path : Devices, str or Path
        Of any session (call `Devices.prepare` before); folder ``*.zarr`` to make.
    limits, preview : optional
        As for `dbthermal.instruments.recording.record`, whose result and errors are those of this.

    Examples
    --------
    >>> from dbthermal.instruments.devices import open_devices
    >>> from dbthermal.instruments.session import Camera, Session
    >>> camera = Camera("v4l2:///dev/video0")
    >>> session = Session("demo", True, "scene", 0.2, {"8-14": camera}, shape=(24, 32))
    >>> with open_devices(session) as devices:
    ...     devices.prepare()
    ...     folder, small = getfixture("tmp_path"), Limits(reserve=0)
    ...     summary = record_scene(devices, folder / "demo.zarr", limits=small)
    >>> summary.ended, summary.totals["8-14"]["lost"]
    ('duration', 0)
    >>> recording.open_capture(summary.path)["counts"].dims
    ('band', 'time', 'y', 'x')
    """
    expected = devices.session.filtered
    if devices.wheel is not None and devices.wheel.band() != expected:
        raise ValueError(f"Invalid filter in the beam. Must be '{expected}': prepare the devices.")
    return _record(devices, Path(path), begins=True, limits=limits, preview=preview)


def _record(devices: Devices, path: Path, *, begins: bool = False, **options: Any) -> Summary:
    """Record all sources and readings of open devices, with the options of `recording.record`."""
    options |= {"readings": devices.readings(), "identities": devices.identities()}
    devices.flush()
    # An emulated scene begins with the recording, or stands.
    if begins and devices.world is not None:
        devices.world.begin()
    return recording.record(devices.session, devices.sources, path, **options)


def _kept(number: int, temperature: float, band: str | None, path: Path) -> Summary | None:
    """Summary of a recording of the sweep that exists already; None if it does not."""
    if not path.exists():
        return None
    attrs = store.open_dataset(path).attrs
    if not attrs.get("complete", False):
        rule = "Must be complete: move it away, and this step is recorded again"
        raise ValueError(f"Incomplete recording '{path}'. {rule}.")
    steps = attrs["provenance"]["parameters"]["blackbody"]["temperatures"]
    if steps[number : number + 1] != [temperature]:
        rule = f"Must be of {temperature} K"
        raise ValueError(f"Recording '{path}' of temperatures {steps} K. {rule}.")
    recording.require_filter(path, band)
    return Summary(path, attrs["ended"], attrs["totals"])
