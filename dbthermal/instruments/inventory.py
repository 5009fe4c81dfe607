"""Devices of the rig on the USB bus: their nodes, and warnings about drivers and permissions.

The bus is only listed, through pyusb, and the serial ports by pyserial: no configuration is set,
nothing is reset or claimed, for the devices may be recording. A camera's video nodes are those
below its USB device in Linux's sysfs, so that two equal cameras are told apart by their ports. A
Boson's USB serial number may not always be the camera's own: ask the camera itself. Tested against
an emulated backend and a written sysfs tree, not against hardware.
"""

import errno
import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

import usb.core
import usb.util
from serial.tools import list_ports

if TYPE_CHECKING:
    from dbthermal.instruments.session import Session

__all__ = ["KINDS", "Device", "Kind", "LibusbMissingError", "describe", "find", "plugged_in"]
__dir__ = __all__.copy


@dataclass(frozen=True)
class Kind:
    """Type of device: its USB identity, and the Linux module that makes each family of nodes."""

    key: str
    name: str
    vendor: int
    product: int
    modules: tuple[tuple[str, str], ...] = ()


# 09cb:4007 after FLIR/UVC-Boson and flirpy; 0403:faf0, an FTDI chip with Thorlabs's identity, after
# Thorlabs/Motion_Control_Examples; 0ce9:1000 after datalogd's documentation.
KINDS: Final = (
    Kind("boson", "FLIR Boson", 0x09CB, 0x4007, (("video", "uvcvideo"), ("serial", "cdc_acm"))),
    Kind("apt", "Thorlabs APT controller", 0x0403, 0xFAF0, (("serial", "ftdi_sio"),)),
    Kind("tc08", "Pico TC-08", 0x0CE9, 0x1000),
)
"""Types of devices that are looked for."""

SPEEDS: Final = MappingProxyType({1: "low", 2: "full", 3: "high", 4: "super", 5: "super plus"})
"""Name of each speed of libusb: 1.5, 12, 480, 5000 and 10000 Mbit/s."""

HIGH_SPEED_PAYLOAD: Final = 13 * 512 * 8 * 8000
"""Largest data rate of a high-speed bus [bit/s]: 13 bulk packets of 512 bytes in 125 us.

Universal Serial Bus Specification 2.0, table 5-10.
"""

PIXELS: Final = 640 * 512  # of a frame, 16 bits each
SLOW: Final = 30.0  # [Hz] lower of the two frame rates that a Boson offers over USB
RULES: Final = "/etc/udev/rules.d/70-dbthermal.rules"  # below 73, or ``uaccess`` comes too late


class LibusbMissingError(RuntimeError):
    """No libusb is installed, without which pyusb lists nothing."""


@dataclass(frozen=True)
class Device:
    """One device that is plugged in.

    `bus` is the number of its bus, `ports` the port of each hub on the way, the root's first,
    `serial` its USB serial number, from its serial port where the device itself may not be opened.
    `warnings` are obstacles to its use, each with the remedy.
    """

    kind: Kind
    bus: int
    ports: tuple[int, ...]
    speed: str
    serial: str | None = None
    video_nodes: tuple[str, ...] = ()
    serial_nodes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def path(self) -> str:
        """Bus and ports as Linux names them: ``1-2.4``."""
        return f"{self.bus}-{'.'.join(str(port) for port in self.ports)}"

    def warned(self, *warnings: str | None) -> "Device":
        """Device with further warnings; None is skipped."""
        return replace(self, warnings=(*self.warnings, *(text for text in warnings if text)))


def find(
    backend: Any = None,
    *,
    serial_ports: Iterable[Any] | None = None,
    sysfs: Path = Path("/sys"),
    dev: Path = Path("/dev"),
    frame_rate: float = 60.0,
) -> list[Device]:
    """List the rig's devices that are plugged in, in the order of `KINDS`, then of bus and ports.

    By default with the libusb and the serial ports that are installed and Linux's trees of devices
    and nodes; all are replaced in tests. The cameras' frame rate [Hz] is for the bandwidth.
    LibusbMissingError without a libusb, usb.core.USBError if the bus cannot be listed.
    """
    terminals = list(list_ports.comports() if serial_ports is None else serial_ports)
    devices = []
    for kind in KINDS:
        of_kind = [_device(kind, raw, terminals, sysfs, dev) for raw in _enumerate(backend, kind)]
        devices += sorted(of_kind, key=lambda device: (device.bus, device.ports))
    cameras = [device for device in devices if device.kind.key == "boson"]
    return [
        device.warned(_bandwidth(device, cameras, frame_rate)) if device in cameras else device
        for device in devices
    ]


def describe(devices: Iterable[Device]) -> str:
    """Text with a line for each device, its warnings below it, and one for each missing kind.

    Examples
    --------
    >>> camera = Device(KINDS[0], bus=1, ports=(2, 4), speed="high", video_nodes=("/dev/video0",))
    >>> print(describe([camera]).splitlines()[0])
    FLIR Boson without serial number: 1-2.4, high speed, /dev/video0
    """
    listed = list(devices)
    lines = []
    for kind in KINDS:
        of_kind = [device for device in listed if device.kind == kind]
        for device in of_kind:
            nodes = " ".join((*device.video_nodes, *device.serial_nodes)) or "no nodes"
            serial = device.serial or "without serial number"
            lines.append(f"{kind.name} {serial}: {device.path}, {device.speed} speed, {nodes}")
            lines += [f"  ! {warning}" for warning in device.warnings]
        if not of_kind:
            usb_id = f"{kind.vendor:04x}:{kind.product:04x}"
            lines.append(
                f"{kind.name}: not found ({usb_id}). Must be plugged in and switched on; "
                f"'lsusb -d {usb_id}' lists it then."
            )
    return "\n".join(lines)


def _enumerate(backend: Any, kind: Kind) -> Iterator[Any]:
    """Yield pyusb's devices of one kind."""
    identity = {"idVendor": kind.vendor, "idProduct": kind.product}
    try:
        yield from usb.core.find(find_all=True, backend=backend, **identity)
    except usb.core.NoBackendError as error:
        raise LibusbMissingError(
            "No libusb found. Must be installed to see USB devices: "
            "the package libusb-1.0-0 of Debian, libusb of Homebrew or conda."
        ) from error


def _device(kind: Kind, raw: Any, terminals: list[Any], sysfs: Path, dev: Path) -> Device:
    """Device of the bus with its nodes and the warnings about their use."""
    ports = tuple(raw.port_numbers or ())
    device = Device(kind, raw.bus, ports, SPEEDS.get(raw.speed, "unknown"))
    serial, problem = _serial_number(kind, raw)
    # A port's location is that of its device, or of one of the device's interfaces: 1-2.4:1.2.
    tty = [port for port in terminals if (port.location or "").split(":")[0] == device.path]
    entries = (sysfs / "bus" / "usb" / "devices" / device.path).glob("*:*/video4linux/video*")
    nodes = {
        "video": _ordered(str(dev / entry.name) for entry in entries),
        "serial": _ordered(port.device for port in tty),
    }
    if serial is None and tty:
        serial = tty[0].serial_number
        if serial and problem == _denied_device(kind):
            problem = None  # its serial number is known, and its kernel drivers open its nodes
    missing = [_missing(kind, name, module) for name, module in kind.modules if not nodes[name]]
    if missing and not sysfs.is_dir():
        missing = [f"Its nodes are not known: there is no {sysfs}."]
    device = replace(
        device, serial=serial, video_nodes=nodes["video"], serial_nodes=nodes["serial"]
    )
    return device.warned(problem, *missing, *_denied_nodes(kind, device))


def _serial_number(kind: Kind, raw: Any) -> tuple[str | None, str | None]:
    """Serial number of a device, and the reason if it cannot be read."""
    if not raw.iSerialNumber:
        return None, None
    try:
        languages = usb.util.get_langids(raw)
        if not languages:
            return None, "It has no strings, so that its serial number is not known."
        return usb.util.get_string(raw, raw.iSerialNumber, languages[0]), None
    except usb.core.USBError as error:
        return None, _problem(kind, error)
    except NotImplementedError:
        return None, "It cannot be opened: libusb has no driver for it on this system."
    except (ValueError, IndexError) as error:
        return None, f"Its serial number is damaged: {error}."
    finally:
        usb.util.dispose_resources(raw)


def _problem(kind: Kind, error: Any) -> str:
    """Meaning of an error of the bus, and the remedy."""
    if error.errno in {errno.EACCES, errno.EPERM}:
        return _denied_device(kind)
    if error.errno in {errno.ENODEV, errno.ENOENT}:
        return "It was unplugged while it was looked at."
    return f"It does not answer: {error}. Plug it in again."


def _ordered(nodes: Iterable[str]) -> tuple[str, ...]:
    """Nodes in the order of their numbers."""
    return tuple(sorted(nodes, key=lambda node: (len(re.sub(r"\D", "", node)), node)))


def _missing(kind: Kind, family: str, module: str) -> str:
    """Advice for nodes that no kernel driver made; an old ftdi_sio does not know 0403:faf0."""
    text = f"It has no {family} node. Must have its kernel driver: run 'sudo modprobe {module}'"
    if module != "ftdi_sio":
        return f"{text}."
    return (
        f"{text}, and if there is still none, 'echo {kind.vendor:04x} {kind.product:04x} | "
        "sudo tee /sys/bus/usb-serial/drivers/ftdi_sio/new_id'."
    )


def _bandwidth(device: Device, cameras: list[Device], frame_rate: float) -> str | None:
    """Warning if a camera's video does not fit its bus, alone or with the others on it."""
    rate = 16e-6 * PIXELS * frame_rate  # [Mbit/s]
    if device.speed in {"low", "full"}:
        return (
            f"It runs at {device.speed} speed, and {frame_rate:g} frames/s take {rate:.1f} Mbit/s. "
            "Must be at high speed: use another port or cable."
        )
    same = [camera for camera in cameras if (camera.bus, camera.speed) == (device.bus, "high")]
    total, limit = rate * len(same), HIGH_SPEED_PAYLOAD / 1e6
    if device not in same or total <= limit:
        return None
    together = len({camera.ports[:1] for camera in same}) == 1
    how = "and the root port" if together else "though not the root port (ask the controller)"
    others = ", ".join(str(camera.serial) for camera in same if camera is not device) or "no other"
    return (
        f"It shares bus {device.bus} {how} with {others}: {total:.1f} Mbit/s at {frame_rate:g} "
        f"frames/s, of {limit:.1f} Mbit/s at most. Use ports of two controllers, or "
        f"{SLOW:g} frames/s: {total * SLOW / frame_rate:.1f} Mbit/s."
    )


def _denied_device(kind: Kind) -> str:
    """Advice for a device that may not be opened on the bus."""
    return f"No permission to open it. {_udev_advice(kind, 'usb')}"


def _denied_nodes(kind: Kind, device: Device) -> list[str]:
    """Advice for nodes that may not be read and written, once for each group or rule."""
    families = {"video4linux": device.video_nodes, "tty": device.serial_nodes}
    advice: dict[str, list[str]] = {}
    for subsystem, nodes in families.items():
        for node in (Path(node) for node in nodes):
            if node.exists() and not os.access(node, os.R_OK | os.W_OK):
                advice.setdefault(_node_advice(kind, subsystem, node), []).append(str(node))
    return [f"No permission for {', '.join(names)}. {text}" for text, names in advice.items()]


def _node_advice(kind: Kind, subsystem: str, node: Path) -> str:
    """Group to join, where that helps, but never root; else the udev rule."""
    status = _stat(node)
    try:
        group = node.group()
    except KeyError:  # it has no name on this system
        group = str(status.st_gid)
    if status.st_mode & 0o060 != 0o060 or status.st_gid == 0:  # the group may not read and write
        return _udev_advice(kind, subsystem)
    if status.st_gid in os.getgroups():
        return f"Its group '{group}' is yours, yet it is kept from you: are devices passed on here?"
    return (
        f"Must be in its group '{group}': run 'sudo usermod -aG {group} $USER', log in again, and "
        "start the notebook server anew."
    )


def _stat(node: Path) -> os.stat_result:
    return node.stat()


def _udev_advice(kind: Kind, subsystem: str) -> str:
    """Line to type: a rule that admits the user at the machine, and the group plugdev."""
    matched = "ATTR" if subsystem == "usb" else "ATTRS"  # of itself, or of a parent device
    rule = (
        f'SUBSYSTEM=="{subsystem}", {matched}{{idVendor}}=="{kind.vendor:04x}", '
        f'{matched}{{idProduct}}=="{kind.product:04x}", MODE="0660", GROUP="plugdev", '
        'TAG+="uaccess"'
    )
    return (
        f"Type this, and plug it in again: echo '{rule}' | sudo tee -a {RULES} "
        "&& sudo udevadm control --reload"
    )


def plugged_in(session: "Session") -> str:
    """Report of the USB bus for a session; of an emulated one the bus is not looked at."""
    if session.simulated:
        return f"Session '{session.name}' is emulated: the USB bus was not looked at."
    try:
        return describe(find(frame_rate=session.frame_rate))
    except LibusbMissingError as error:
        return f"The USB bus was not looked at: {error}"
