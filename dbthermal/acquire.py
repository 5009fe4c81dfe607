"""Record a session from the command line: ``python -m dbthermal.acquire session.yaml folder``.

The devices are opened, named and prepared, and the session's protocol is run: a scene becomes
``<name>.zarr`` in the folder, a sweep of the blackbody a recording for each temperature and filter,
and where it was interrupted it goes on. The blackbody is set by the one who sits at it. With
``--simulate`` the same drivers talk to emulated devices, whose cameras see a blackbody.

Exit status: 0 if all was recorded, 1 if a device or a recording failed, 2 if the session is none,
130 if it was interrupted; what was recorded is kept. Nothing here was ever run on hardware.
"""

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Final

from scipy.constants import zero_Celsius

from dbthermal.instruments import inventory, protocols
from dbthermal.instruments.devices import Devices, open_devices
from dbthermal.instruments.emulated import blackbody
from dbthermal.instruments.emulated.camera import Picture
from dbthermal.instruments.emulated.world import World, emulated_world
from dbthermal.instruments.live import Watch
from dbthermal.instruments.recording.record import Preview, Summary
from dbthermal.instruments.session import Session

FAILURES: Final = (OSError, RuntimeError, ValueError, KeyError)
"""What devices and recordings raise: the drivers' own errors are of these kinds."""

Pictures = Callable[[Session, World], Mapping[str, Picture]]


@dataclass
class Progress:
    """
    One line that says how a recording goes, written again and again.

    Attributes
    ----------
    write : callable
        Takes the line.
    """

    write: Callable[[str], object]
    _watch: Watch = field(default_factory=Watch)

    def __call__(self, preview: Preview) -> None:
        """
        Write the line.

        Parameters
        ----------
        preview : Preview
            Of the recording.
        """
        self._watch.note(preview)
        bands = "; ".join(
            f"{band}: " + ", ".join([*status.text.splitlines(), *status.warning.splitlines()])
            for band, status in self._watch.status().items()
        )
        self.write(f"\r{preview.time:6.1f} s  {bands}")


def ask_for_blackbody(name: str, temperature: float) -> None:
    """
    Ask who sits at the blackbody to set it, and wait for Enter.

    Parameters
    ----------
    name : str
        Of the session.
    temperature : float
        What it is to be set to [K].

    Raises
    ------
    RuntimeError
        If there is no keyboard, as under papermill.
    """
    celsius = f"{temperature - zero_Celsius:.2f} degC"
    question = f"\n{name}: set the blackbody to {celsius} and press Enter; its rest is awaited. "
    try:
        input(question)
    except (EOFError, NotImplementedError) as error:
        raise RuntimeError(
            f"Nobody at a keyboard sets the blackbody to {celsius}. Must be run in a terminal, or "
            "in Jupyter."
        ) from error


def plugged_in(session: Session) -> str:
    """
    Report of the USB bus; the devices may open even where it cannot be listed.

    Parameters
    ----------
    session : Session
        Its frame rate determines the bandwidth that is needed.

    Returns
    -------
    str
        See `dbthermal.instruments.inventory.describe`; for an emulated session, or without
        libusb, that the bus was not looked at.
    """
    if session.simulated:
        return f"Session '{session.name}' is emulated: the USB bus was not looked at."
    try:
        return inventory.describe(inventory.find(frame_rate=session.frame_rate))
    except inventory.LibusbMissingError as error:
        return f"The USB bus was not looked at: {error}"


def main(
    arguments: Sequence[str] | None = None,
    world: World | None = None,
    pictures: Pictures = blackbody.pictures,
) -> int:
    """
    Record a session.

    Parameters
    ----------
    arguments : sequence of str, optional
        Command line: session, folder, ``--simulate``, ``--dry-run``.
    world : World, optional
        The emulated bench of an emulated session; by default one that is made for it.
    pictures : callable
        Gives what the emulated cameras see, of session and world.

    Returns
    -------
    int
        Exit status, see the module.
    """
    options = _parser().parse_args(arguments)
    try:
        session = Session.load(options.session)
    except (OSError, ValueError) as error:
        print(f"Invalid session: {error}", file=sys.stderr)
        return 2
    session = replace(session, simulated=True) if options.simulate else session
    try:
        return _run(session, options.folder, world, pictures, dry=options.dry_run)
    except KeyboardInterrupt:
        print("\nInterrupted: what was recorded is kept.", file=sys.stderr)
        return 130
    except FAILURES as error:
        print(f"\nFailed: {error}", file=sys.stderr)
        return 1


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


def _run(
    session: Session, folder: Path, world: World | None, pictures: Pictures, *, dry: bool
) -> int:
    """Open the devices, say what they are, and record."""
    seen: Mapping[str, Picture] = {}
    if session.simulated:
        print(f"Session '{session.name}': every device is emulated, nothing is measured.")
        world = _world(session) if world is None else world
        seen = pictures(session, world)
    else:
        print(plugged_in(session))
    with open_devices(session, world, seen) as devices:
        for name, identity in devices.identities().items():
            print(f"{name}: " + ", ".join(f"{key} {value}" for key, value in identity.items()))
        if dry:
            return 0
        print("Preparing: cameras are set, offsets corrected, the wheel is homed and turned.")
        devices.prepare()
        summaries = _record(devices, folder)
    for summary in summaries:
        print(f"{summary.path}: {summary.ended}, {dict(summary.totals)}")
    return 0 if all(summary.ended == "duration" for summary in summaries) else 1


def _record(devices: Devices, folder: Path) -> list[Summary]:
    """Run the session's protocol."""
    progress = Progress(lambda line: print(line, end="", flush=True))
    name = devices.session.name
    if devices.session.blackbody is None:
        found = [protocols.record_scene(devices, folder / f"{name}.zarr", preview=progress)]
    else:
        steps = protocols.record_sweep(
            devices, folder, set_temperature=_setter(devices), preview=progress
        )
        found = [step.summary for step in steps]
    print()
    return found


def _setter(devices: Devices) -> Callable[[float], None]:
    """What sets the blackbody: the emulated one by itself, the real one by who sits at it."""
    world = devices.world
    if world is None:
        return partial(ask_for_blackbody, devices.session.name)

    def set_temperature(temperature: float) -> None:
        print(f"\nSetting the emulated blackbody to {temperature - zero_Celsius:.2f} degC.")
        world.blackbody_temperature = temperature

    return set_temperature


def _world(session: Session) -> World:
    """Bench at room temperature except the blackbody."""
    return emulated_world(session, waits=True)


if __name__ == "__main__":
    sys.exit(main())
