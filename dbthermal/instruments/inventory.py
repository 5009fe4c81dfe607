"""Devices of the rig on the USB bus: their nodes, and warnings about drivers and permissions.

The bus is only listed, through pyusb, and Linux's sysfs is read: nothing is opened, set or reset,
for the devices may be recording. A device's nodes are those below its USB device in sysfs, so that
equal cameras differ by their ports. A Boson's USB serial number may differ from the number that the
camera gives itself.
"""

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import usb.core

from dbthermal.instruments.session import Session

__all__ = ["KINDS", "Device", "Kind", "LibusbMissingError", "describe", "find", "plugged_in"]
__dir__ = __all__.copy


class Kind(NamedTuple):
    """Type of device: name, USB identity, and its families of nodes."""

    name: str
    vendor: int
    product: int
    families: tuple[tuple[str, str, str], ...] = ()  # name, Linux module, place in sysfs


# 09cb:4007 after FLIR/UVC-Boson and flirpy; 0403:faf0, an FTDI chip with Thorlabs's identity, after
# Thorlabs/Motion_Control_Examples; 0ce9:1000 after datalogd's documentation.
_VIDEO = ("video", "uvcvideo", "*:*/video4linux/video*")
BOSON: Final = Kind("FLIR Boson", 0x09CB, 0x4007, (_VIDEO, ("serial", "cdc_acm", "*:*/tty/tty*")))
KINDS: Final = (
    BOSON,
    Kind("Thorlabs APT controller", 0x0403, 0xFAF0, (("serial", "ftdi_sio", "*:*/ttyUSB*"),)),
    Kind("Pico TC-08", 0x0CE9, 0x1000),
)
"""Types of devices that are looked for."""

# Name of each speed of libusb: 1.5, 12, 480, 5000 and 10000 Mbit/s.
SPEEDS: Final = {1: "low", 2: "full", 3: "high", 4: "super", 5: "super plus"}
# Largest data rate of a high-speed bus [Mbit/s]: 13 bulk packets of 512 bytes in 125 us (Universal
# Serial Bus Specification 2.0, table 5-10).
HIGH_SPEED_PAYLOAD: Final = 13 * 512 * 8 * 8000e-6
FRAME: Final = 16e-6 * 640 * 512  # of 16-bit pixels [Mbit]
RULES: Final = "/etc/udev/rules.d/70-dbthermal.rules"  # below 73, or ``uaccess`` comes too late


class LibusbMissingError(RuntimeError):
    """No libusb is installed, without which pyusb lists nothing."""


@dataclass(frozen=True)
class Device:
    """A device that is plugged in, with obstacles to its use, and their remedies, as `warnings`."""

    kind: Kind
    bus: int
    ports: tuple[int, ...]  # of each hub on the way, the root's first
    speed: str
    serial: str = ""  # USB serial number, if it is known
    nodes: tuple[str, ...] = ()  # files below ``/dev``
    warnings: tuple[str, ...] = ()

    @property
    def path(self) -> str:
        """Bus and ports as Linux names them: ``1-2.4``."""
        return f"{self.bus}-{'.'.join(str(port) for port in self.ports)}"


def find(
    backend: Any = None,
    *,
    sysfs: Path = Path("/sys"),
    dev: Path = Path("/dev"),
    frame_rate: float = 60.0,
) -> list[Device]:
    """List the rig's devices that are plugged in, in the order of `KINDS`, then of bus and ports.

    The cameras' frame rate [Hz] is for the bandwidth. LibusbMissingError without a libusb,
    usb.core.USBError if the bus cannot be listed.
    """
    devices = []
    for kind in KINDS:
        identity = {"idVendor": kind.vendor, "idProduct": kind.product}
        try:
            listed = [*usb.core.find(find_all=True, backend=backend, **identity)]
        except usb.core.NoBackendError as error:
            raise LibusbMissingError(
                "No libusb found. Must be installed to see USB devices: "
                "the package libusb-1.0-0 of Debian, libusb of Homebrew or conda."
            ) from error
        of_kind = [_device(kind, raw, sysfs, dev) for raw in listed]
        devices += sorted(of_kind, key=lambda device: (device.bus, device.ports))
    cameras = [device for device in devices if device.kind == BOSON]
    return [
        replace(device, warnings=(*device.warnings, *_bandwidth(device, cameras, frame_rate)))
        for device in devices
    ]


def describe(devices: Iterable[Device]) -> str:
    """Text with a line for each device, its warnings below it, and a line for each missing kind.

    Examples
    --------
    >>> camera = Device(BOSON, bus=1, ports=(2, 4), speed="high", nodes=("/dev/video0",))
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
            usb_id = f"{kind.vendor:04x}:{kind.product:04x}"
            lines.append(
                f"{kind.name}: not found ({usb_id}). Must be plugged in and switched on; "
                f"'lsusb -d {usb_id}' lists it then."
            )
    return "\n".join(lines)


def _device(kind: Kind, raw: Any, sysfs: Path, dev: Path) -> Device:
    """Device of the bus with its nodes and the warnings about their use."""
    # The device, where Linux lists it.
    device = Device(kind, raw.bus, tuple(raw.port_numbers or ()), SPEEDS.get(raw.speed, "unknown"))
    folder = sysfs / "bus" / "usb" / "devices" / device.path
    if not folder.is_dir():
        warning = f"Its nodes and number are not known: there is no {folder}."
        return replace(device, warnings=(warning,))
    # Its nodes, by families.
    nodes, warnings = list[Path](), list[str]()
    for family, module, pattern in kind.families:
        names = sorted((path.name for path in folder.glob(pattern)), key=lambda n: (len(n), n))
        nodes += [dev / name for name in names]
        if not names:
            driver = f"Must have its kernel driver: run 'sudo modprobe {module}'"
            warnings.append(f"It has no {family} node. {driver}.")
    # Without nodes the vendor's library opens the device itself.
    opened = nodes if kind.families else [dev / f"bus/usb/{raw.bus:03d}/{raw.address:03d}"]
    denied = [node for node in opened if node.exists() and not os.access(node, os.R_OK | os.W_OK)]
    if denied:
        # A rule that admits the user at the machine, and the group plugdev.
        rule = (
            f'ATTRS{{idVendor}}=="{kind.vendor:04x}", ATTRS{{idProduct}}=="{kind.product:04x}", '
            'MODE="0660", GROUP="plugdev", TAG+="uaccess"'
        )
        warnings.append(
            f"No permission for {', '.join(map(str, denied))}. Type this, and plug it in again: "
            f"echo '{rule}' | sudo tee -a {RULES} && sudo udevadm control --reload"
        )
    number, paths = folder / "serial", tuple(str(node) for node in nodes)
    serial = number.read_text("utf-8", "backslashreplace").strip() if number.exists() else ""
    return replace(device, serial=serial, nodes=paths, warnings=tuple(warnings))


def _bandwidth(device: Device, cameras: list[Device], frame_rate: float) -> Iterator[str]:
    """Yield a warning if a camera's video does not fit its bus with the rest of the cameras."""
    rate, limit = FRAME * frame_rate, HIGH_SPEED_PAYLOAD
    if device in cameras and device.speed in {"low", "full"}:
        yield (
            f"It runs at {device.speed} speed, and {frame_rate:g} frames/s take {rate:.1f} Mbit/s. "
            "Must be at high speed: use another port or cable."
        )
    on_bus = [camera for camera in cameras if (camera.bus, camera.speed) == (device.bus, "high")]
    total = rate * len(on_bus)
    if device in on_bus and total > limit:
        paths = ", ".join(camera.path for camera in on_bus if camera is not device) or "no other"
        yield (
            f"It shares bus {device.bus} with {paths}: {total:.1f} Mbit/s at {frame_rate:g} "
            f"frames/s, of {limit:.1f} Mbit/s at most. Use ports of two controllers, or fewer "
            "frames/s."
        )


def plugged_in(session: Session) -> str:
    """Report of the USB bus for a session; of an emulated one the bus is not looked at."""
    if session.simulated:
        return f"Session '{session.name}' is emulated: the USB bus was not looked at."
    try:
        return describe(find(frame_rate=session.frame_rate))
    except LibusbMissingError as error:
        return f"The USB bus was not looked at: {error}"
