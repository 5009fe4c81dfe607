"""Devices of the rig on the USB bus: their nodes, and warnings about drivers and permissions.

Linux's list of the bus, sysfs, is read: nothing is opened, set or reset, for the devices may be
recording. A device's nodes are those below its USB device there, so that equal cameras differ by
their ports. A Boson's USB serial number may differ from the number that the camera gives itself.
"""

import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from dbthermal.instruments.session import Session

__all__ = ["KINDS", "Device", "Kind", "describe", "find", "plugged_in"]
__dir__ = __all__.copy


class Kind(NamedTuple):
    """Type of device: name, USB identity, and its families of nodes.

    A family of nodes has a name, the Linux module that makes it, and where sysfs lists its nodes.
    """

    name: str
    usb_id: str  # vendor and product
    families: tuple[tuple[str, str, str], ...] = ()


# 09cb:4007 after FLIR/UVC-Boson and flirpy; 0403:faf0, an FTDI chip with Thorlabs's identity, after
# Thorlabs/Motion_Control_Examples; 0ce9:1000 after datalogd's documentation.
_VIDEO = ("video", "uvcvideo", "*:*/video4linux/video*")
BOSON: Final = Kind("FLIR Boson", "09cb:4007", (_VIDEO, ("serial", "cdc_acm", "*:*/tty/tty*")))
KINDS: Final = (
    BOSON,
    Kind("Thorlabs APT controller", "0403:faf0", (("serial", "ftdi_sio", "*:*/ttyUSB*"),)),
    Kind("Pico TC-08", "0ce9:1000"),
)
"""Types of devices that are looked for."""

# Name of each speed [Mbit/s].
SPEEDS: Final = {"1.5": "low", "12": "full", "480": "high", "5000": "super", "10000": "super plus"}
# Largest data rate of a high-speed bus [Mbit/s]: 13 bulk packets of 512 bytes in 125 us (Universal
# Serial Bus Specification 2.0, table 5-10).
HIGH_SPEED_PAYLOAD: Final = 13 * 512 * 8 * 8000e-6
FRAME: Final = 16e-6 * 640 * 512  # of 16-bit pixels [Mbit]
RULES: Final = "/etc/udev/rules.d/70-dbthermal.rules"  # below 73, or ``uaccess`` comes too late


@dataclass(frozen=True)
class Device:
    """A device that is plugged in, with obstacles to its use, and their remedies, as `warnings`."""

    kind: Kind
    path: str  # bus and ports as Linux names them: ``1-2.4``
    speed: str
    serial: str = ""  # USB serial number, if it is known
    nodes: tuple[str, ...] = ()  # files below ``/dev``
    warnings: tuple[str, ...] = ()


def find(
    *, sysfs: Path = Path("/sys"), dev: Path = Path("/dev"), frame_rate: float = 60.0
) -> list[Device]:
    """List the rig's devices that are plugged in, in the order of `KINDS`, then of bus and ports.

    Linux's trees of devices and nodes are replaced in tests. The cameras' frame rate [Hz] is for
    the bandwidth. OSError on another system than Linux.
    """
    bus = sysfs / "bus" / "usb" / "devices"
    if not bus.is_dir():
        raise OSError(f"No list of USB devices, '{bus}'. Must be Linux, with USB.")
    # Interfaces have a colon in their names, and root hubs no ports.
    folders = [folder for folder in bus.glob("*-*") if ":" not in folder.name]
    folders.sort(key=lambda folder: [int(number) for number in re.findall(r"\d+", folder.name)])
    devices = [
        _device(kind, folder, dev)
        for kind in KINDS
        for folder in folders
        if kind.usb_id == f"{_text(folder, 'idVendor')}:{_text(folder, 'idProduct')}"
    ]
    cameras = [device for device in devices if device.kind == BOSON]
    return [
        replace(device, warnings=(*device.warnings, *_bandwidth(device, cameras, frame_rate)))
        for device in devices
    ]


def describe(devices: Iterable[Device]) -> str:
    """Text with a line for each device, its warnings below it, and a line for each missing kind.

    Examples
    --------
    >>> camera = Device(BOSON, "1-2.4", "high", nodes=("/dev/video0",))
    >>> print(describe([camera]).splitlines()[0])
    FLIR Boson without serial number: 1-2.4, high speed, /dev/video0
    """
    plugged, lines = list(devices), list[str]()
    for kind in KINDS:
        of_kind = [device for device in plugged if device.kind == kind]
        for device in of_kind:
            nodes, serial = " ".join(device.nodes), device.serial or "without serial number"
            place = f"{device.path}, {device.speed} speed, {nodes or 'no nodes'}"
            lines.append(f"{kind.name} {serial}: {place}")
            lines += [f"  ! {warning}" for warning in device.warnings]
        if not of_kind:
            lines.append(
                f"{kind.name}: not found ({kind.usb_id}). Must be plugged in and switched on; "
                f"'lsusb -d {kind.usb_id}' lists it then."
            )
    return "\n".join(lines)


def _device(kind: Kind, folder: Path, dev: Path) -> Device:
    """Device of a folder of sysfs, with its nodes and the warnings about their use."""
    # Its nodes, by families.
    nodes, warnings = list[Path](), list[str]()
    for family, module, pattern in kind.families:
        names = sorted((path.name for path in folder.glob(pattern)), key=lambda n: (len(n), n))
        nodes += [dev / name for name in names]
        if not names:
            driver = f"Must have its kernel driver: run 'sudo modprobe {module}'"
            warnings.append(f"It has no {family} node. {driver}.")
    # Without nodes the vendor's library opens the device itself.
    numbers = [int(_text(folder, name) or 0) for name in ("busnum", "devnum")]
    opened = nodes if kind.families else [dev / "bus/usb/{:03d}/{:03d}".format(*numbers)]
    denied = [node for node in opened if node.exists() and not os.access(node, os.R_OK | os.W_OK)]
    if denied:
        # A rule that admits the user at the machine, and the group plugdev.
        vendor, _, product = kind.usb_id.partition(":")
        rule = (
            f'ATTRS{{idVendor}}=="{vendor}", ATTRS{{idProduct}}=="{product}", '
            'MODE="0660", GROUP="plugdev", TAG+="uaccess"'
        )
        warnings.append(
            f"No permission for {', '.join(map(str, denied))}. Type this, and plug it in again: "
            f"echo '{rule}' | sudo tee -a {RULES} && sudo udevadm control --reload"
        )
    speed, paths = SPEEDS.get(_text(folder, "speed"), "unknown"), tuple(map(str, nodes))
    serial = _text(folder, "serial")
    return Device(kind, folder.name, speed, serial, paths, tuple(warnings))


def _text(folder: Path, name: str) -> str:
    """Text of a file of sysfs; empty without one."""
    file = folder / name
    return file.read_text("utf-8", "backslashreplace").strip() if file.exists() else ""


def _bandwidth(device: Device, cameras: list[Device], frame_rate: float) -> Iterator[str]:
    """Yield a warning if a camera's video does not fit its bus with the rest of the cameras."""
    rate, limit = FRAME * frame_rate, HIGH_SPEED_PAYLOAD
    if device in cameras and device.speed in {"low", "full"}:
        yield (
            f"It runs at {device.speed} speed, and {frame_rate:g} frames/s take {rate:.1f} Mbit/s. "
            "Must be at high speed: use another port or cable."
        )
    bus = device.path.partition("-")[0]
    on_bus = [
        camera for camera in cameras if camera.path.startswith(f"{bus}-") and camera.speed == "high"
    ]
    total = rate * len(on_bus)
    if device in on_bus and total > limit:
        paths = ", ".join(camera.path for camera in on_bus if camera is not device) or "no other"
        yield (
            f"It shares bus {bus} with {paths}: {total:.1f} Mbit/s at {frame_rate:g} "
            f"frames/s, of {limit:.1f} Mbit/s at most. Use ports of two controllers, or fewer "
            "frames/s."
        )


def plugged_in(session: "Session") -> str:
    """Report of the USB bus for a session; of an emulated one the bus is not looked at."""
    if session.simulated:
        return f"Session '{session.name}' is emulated: the USB bus was not looked at."
    try:
        return describe(find(frame_rate=session.frame_rate))
    except OSError as error:
        return f"The USB bus was not looked at: {error}"
