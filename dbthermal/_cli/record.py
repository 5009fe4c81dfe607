"""Recording of a session: the devices are opened, named and prepared, and its protocol is run.

A scene becomes ``<name>.zarr`` in the folder, a sweep of the blackbody a recording for each
temperature and filter; an interrupted sweep goes on where it was. The user sets the blackbody on
request. If the terminal or pipe that it prints to is closed the recording goes on.
"""

import argparse
import os
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TextIO

from scipy.constants import zero_Celsius

from dbthermal.instruments import inventory, protocols
from dbthermal.instruments.devices import Devices, open_devices
from dbthermal.instruments.live import Watch
from dbthermal.instruments.recording import Preview, SignalExit, raised_signals
from dbthermal.instruments.session import Session


def record(options: argparse.Namespace) -> int:
    """Record a session, and return the exit status; a dry run only opens and names the devices."""
    if (path := options.session).suffix.lower() not in {".yaml", ".yml"} and path.exists():
        raise ValueError(f"Invalid session '{path}'. Must be YAML, as params/sessions/scene.yaml.")
    session = Session.load(path)
    session = replace(session, simulated=True) if options.simulate else session
    try:
        with raised_signals():
            return _run(session, options.folder, dry=options.dry_run)
    except KeyboardInterrupt:
        _say("\nInterrupted: what was recorded is kept.", file=sys.stderr)
        return 130
    except SignalExit as end:
        _say(f"\nEnded by {end.name}: what was recorded is kept.", file=sys.stderr)
        return end.status


def _say(text: str, *, end: str = "\n", file: TextIO | None = None) -> None:
    """Print, ignoring a closed terminal or pipe."""
    stream = file or sys.stdout
    try:
        print(text, end=end, file=stream, flush=True)
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _run(session: Session, folder: Path, *, dry: bool) -> int:
    """Open the devices, print their identities, and record; returns the exit status."""
    path = folder / f"{session.name}.zarr"
    if session.blackbody is None and path.exists() and not dry:
        raise FileExistsError(f"There is something at '{path}'. Must be a new recording.")
    # The devices, as emulated or as plugged in.
    emulated = f"Session '{session.name}': every device is emulated, nothing is measured."
    _say(emulated if session.simulated else inventory.plugged_in(session))
    with open_devices(session) as devices:
        for name, identity in devices.identities().items():
            _say(f"{name}: " + ", ".join(f"{key} {value}" for key, value in identity.items()))
        if dry:
            return 0
        # The protocol of the session.
        _say("Preparing: cameras are set, offsets corrected, the wheel is homed and turned.")
        devices.prepare()
        show = partial(_progress, Watch())
        if session.blackbody is None:
            summaries = [protocols.record_scene(devices, path, preview=show)]
        else:
            ask = partial(_set_blackbody, devices)
            summaries = protocols.record_sweep(devices, folder, set_temperature=ask, preview=show)
        _say("")
    for summary in summaries:
        _say(f"{summary.path}: {summary.ended}, {dict(summary.totals)}")
    return 0 if all(summary.ended == "duration" for summary in summaries) else 1


def _progress(watch: Watch, preview: Preview) -> None:
    """Print the progress of a recording in a line that is written over the line before."""
    watch.note(preview)
    states = watch.status().items()
    rows = {name: [*it.text.splitlines(), *it.warning.splitlines()] for name, it in states}
    bands = "; ".join(f"{band}: {', '.join(row)}" for band, row in rows.items())
    _say(f"\r{preview.time:6.1f} s  {bands}", end="")


def _set_blackbody(devices: Devices, temperature: float) -> None:
    """Set the emulated blackbody, or ask the user to set the real one."""
    if devices.world is None:
        protocols.ask_for_blackbody(devices.session.name, temperature)
        return
    _say(f"\nSetting the emulated blackbody to {temperature - zero_Celsius:.2f} degC.")
    devices.world.blackbody_temperature = temperature
