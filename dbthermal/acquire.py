"""Record a session from the command line: ``python -m dbthermal.acquire session.yaml folder``.

The devices are opened, named and prepared, and the session's protocol is run: a scene becomes
``<name>.zarr`` in the folder, a sweep of the blackbody a recording for each temperature and filter.
An interrupted sweep goes on where it was. The user sets the blackbody on request. With
``--simulate`` the same drivers talk to emulated devices, whose cameras see a blackbody.

Exit status: 0 if all was recorded, 1 if a device or a recording failed, 2 if the session is
invalid, 130 if it was interrupted, 143 and 129 if SIGTERM or SIGHUP ended it; what was recorded is
kept. If the terminal or pipe that it prints to is closed the recording goes on. Never tried on
hardware.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final, TextIO

from scipy.constants import zero_Celsius

from dbthermal.instruments import inventory, protocols
from dbthermal.instruments.devices import Devices, open_devices
from dbthermal.instruments.live import Watch
from dbthermal.instruments.recording import Preview, Summary
from dbthermal.instruments.session import Session
from dbthermal.instruments.signals import SignalExit, raised_signals

__all__ = ["ask_for_blackbody", "main", "plugged_in"]
__dir__ = __all__.copy

_FAILURES: Final = (OSError, RuntimeError, ValueError, KeyError)
"""Errors of devices and recordings: the drivers' own ones are of these kinds."""


def ask_for_blackbody(name: str, temperature: float) -> None:
    """Ask the user to set the blackbody to a temperature [K], and wait for Enter.

    RuntimeError if there is no keyboard, as under papermill.
    """
    celsius = f"{temperature - zero_Celsius:.2f} degC"
    question = (
        f"\n{name}: set the blackbody to {celsius} and press Enter; then its rest is awaited. "
    )
    try:
        input(question)
    except (EOFError, NotImplementedError) as error:
        raise RuntimeError(
            f"Nobody at a keyboard sets the blackbody to {celsius}. Must be run in a terminal, or "
            "in Jupyter."
        ) from error


def plugged_in(session: Session) -> str:
    """Report of the USB bus, which an emulated session does not need; see `inventory.describe`."""
    if session.simulated:
        return f"Session '{session.name}' is emulated: the USB bus was not looked at."
    try:
        return inventory.describe(inventory.find(frame_rate=session.frame_rate))
    except inventory.LibusbMissingError as error:
        return f"The USB bus was not looked at: {error}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Record a session, as the command line tells, and return the exit status; see the module."""
    options = _parser().parse_args(arguments)
    try:
        session = Session.load(options.session)
    except (OSError, ValueError) as error:
        print(f"Invalid session: {error}", file=sys.stderr)
        return 2
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
    except _FAILURES as error:
        _say(f"\nFailed: {error}", file=sys.stderr)
        return 1


def _say(text: str, *, end: str = "\n", file: TextIO | None = None) -> None:
    """Print a text; where nobody reads any more, this and all that follows is passed over."""
    stream = file or sys.stdout
    try:
        print(text, end=end, file=stream, flush=True)
    except OSError:
        with Path(os.devnull).open("wb") as nothing:
            os.dup2(nothing.fileno(), stream.fileno())


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m dbthermal.acquire",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("session", type=Path, help="YAML file, see dbthermal.instruments.session")
    parser.add_argument("folder", type=Path, help="where the recordings go")
    parser.add_argument("--simulate", action="store_true", help="use emulated devices")
    parser.add_argument("--dry-run", action="store_true", help="open and name the devices, no more")
    return parser


def _run(session: Session, folder: Path, *, dry: bool) -> int:
    """Open the devices, print their identities, and record; returns the exit status."""
    path = folder / f"{session.name}.zarr"
    if session.blackbody is None and path.exists() and not dry:
        raise FileExistsError(f"There is something at '{path}'. Must be a new recording.")
    if session.simulated:
        _say(f"Session '{session.name}': every device is emulated, nothing is measured.")
    else:
        _say(plugged_in(session))
    with open_devices(session) as devices:
        for name, identity in devices.identities().items():
            _say(f"{name}: " + ", ".join(f"{key} {value}" for key, value in identity.items()))
        if dry:
            return 0
        _say("Preparing: cameras are set, offsets corrected, the wheel is homed and turned.")
        devices.prepare()
        summaries = _record(devices, folder)
    for summary in summaries:
        _say(f"{summary.path}: {summary.ended}, {dict(summary.totals)}")
    return 0 if all(summary.ended == "duration" for summary in summaries) else 1


def _record(devices: Devices, folder: Path) -> list[Summary]:
    """Run the session's protocol."""
    watch, name = Watch(), devices.session.name

    def show(preview: Preview) -> None:
        _say(_progress(watch, preview), end="")

    if devices.session.blackbody is None:
        summaries = [protocols.record_scene(devices, folder / f"{name}.zarr", preview=show)]
    else:
        set_temperature = partial(_set_blackbody, devices)
        steps = protocols.record_sweep(
            devices, folder, set_temperature=set_temperature, preview=show
        )
        summaries = [step.summary for step in steps]
    _say("")
    return summaries


def _progress(watch: Watch, preview: Preview) -> str:
    """Progress of a recording in one line, written over the one before."""
    watch.note(preview)
    bands = "; ".join(
        f"{band}: " + ", ".join([*status.text.splitlines(), *status.warning.splitlines()])
        for band, status in watch.status().items()
    )
    return f"\r{preview.time:6.1f} s  {bands}"


def _set_blackbody(devices: Devices, temperature: float) -> None:
    """Set the emulated blackbody, or ask the user to set the real one."""
    if devices.world is None:
        ask_for_blackbody(devices.session.name, temperature)
        return
    _say(f"\nSetting the emulated blackbody to {temperature - zero_Celsius:.2f} degC.")
    devices.world.blackbody_temperature = temperature


if __name__ == "__main__":
    sys.exit(main())
