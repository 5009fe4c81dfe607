"""What of the rig is plugged in, which node belongs to which device, and what stands in the way.

The bus is only looked at: no configuration is set, nothing is reset, claimed or taken from its
kernel driver, for the devices may be recording. What a device says of itself is read through pyusb;
which ``/dev/video*`` and ``/dev/ttyACM*`` belong to it, from Linux's sysfs: both hang below the
same USB device there, so that two equal cameras are told apart by the ports they are in.

Whether a Boson's USB serial number is always the camera's own is not certain: ask the camera
itself. Tested against an emulated backend and a written sysfs tree, not against hardware.
"""

import errno
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import usb.core
import usb.util

from dbthermal.instruments import permissions


@dataclass(frozen=True)
class Kind:
    """
    A device of the rig, as the bus knows it.

    Attributes
    ----------
    key, name : str
        Short name, and that for people.
    vendor, product : int
        Its USB identity.
    nodes : tuple of str
        Families of nodes that its kernel drivers make: ``"video"``, ``"serial"``.
    """

    key: str
    name: str
    vendor: int
    product: int
    nodes: tuple[str, ...] = ()


# 09cb:4007 after FLIR/UVC-Boson and flirpy; 0403:faf0, an FTDI chip with Thorlabs's identity, after
# Thorlabs/Motion_Control_Examples; 0ce9:1000 after datalogd's documentation.
KINDS: Final = (
    Kind("boson", "FLIR Boson", 0x09CB, 0x4007, ("video", "serial")),
    Kind("apt", "Thorlabs APT controller", 0x0403, 0xFAF0, ("serial",)),
    Kind("tc08", "Pico TC-08", 0x0CE9, 0x1000),
)
"""The devices that are looked for."""

SPEEDS: Final = MappingProxyType({1: "low", 2: "full", 3: "high", 4: "super", 5: "super plus"})
"""Name of each speed of libusb: 1.5, 12, 480, 5000 and 10000 Mbit/s."""

HIGH_SPEED_PAYLOAD: Final = 13 * 512 * 8 * 8000
"""Most that a high-speed bus carries [bit/s]: 13 bulk packets of 512 bytes in 125 us.

Universal Serial Bus Specification 2.0, table 5-10.
"""

SLOW: Final = 30.0
"""The slower of the two frame rates that a Boson offers over USB [Hz]."""

MODULES: Final = MappingProxyType(
    {("boson", "video"): "uvcvideo", ("boson", "serial"): "cdc_acm", ("apt", "serial"): "ftdi_sio"}
)
"""Linux module that makes the nodes of a kind and family; an old ftdi_sio is told of 0403:faf0."""


class LibusbMissingError(RuntimeError):
    """There is no libusb, without which pyusb sees nothing."""


@dataclass(frozen=True)
class Device:
    """
    One device that is plugged in.

    Attributes
    ----------
    kind : Kind
        What it is.
    bus, address : int
        Where it is; the address is new each time it is plugged in.
    ports : tuple of int
        Port of each hub on the way, the root's first; stays the same.
    speed : str
        One of `SPEEDS`, or ``"unknown"``.
    serial : str, optional
        Its USB serial number; from sysfs where the device itself may not be opened.
    video_nodes, serial_nodes : tuple of str
        ``/dev/video0``, ``/dev/ttyACM0``. A camera has several of the former, one for pictures.
    warnings : tuple of str
        What stands in the way, each with what to do.
    is_simulated : bool
        True on an emulated backend.
    """

    kind: Kind
    bus: int
    address: int
    ports: tuple[int, ...]
    speed: str
    serial: str | None = None
    video_nodes: tuple[str, ...] = ()
    serial_nodes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = field(default=())
    is_simulated: bool = False

    @property
    def path(self) -> str:
        """Bus and ports as Linux names them: ``1-2.4``."""
        return f"{self.bus}-{'.'.join(str(port) for port in self.ports)}"

    def warned(self, *warnings: str | None) -> "Device":
        """Return it with more warnings; None is none."""
        return replace(self, warnings=(*self.warnings, *(text for text in warnings if text)))


def video_rate(frame_rate: float, width: int = 640, height: int = 512) -> float:
    """
    Data rate of a camera's 16-bit video.

    Parameters
    ----------
    frame_rate : float
        Frame rate [Hz].
    width, height : int
        Size of a frame [pixel].

    Returns
    -------
    float
        Rate [bit/s], without what the bus adds: 314.6e6 at 640 x 512 and 60 Hz.
    """
    return 16.0 * width * height * frame_rate


def find(
    backend: Any = None,
    *,
    sysfs: Path = Path("/sys"),
    dev: Path = Path("/dev"),
    frame_rate: float = 60.0,
) -> list[Device]:
    """
    Look for the devices of the rig.

    Parameters
    ----------
    backend : IBackend, optional
        Of pyusb; without it, the libusb that is installed.
    sysfs, dev : Path
        Where Linux keeps its devices and nodes; tests have their own.
    frame_rate : float
        At which the cameras are to run [Hz], for the bandwidth.

    Returns
    -------
    list of Device
        In the order of `KINDS`, then of bus and ports; empty if nothing is plugged in.

    Raises
    ------
    LibusbMissingError
        If no backend is given and there is no libusb.
    usb.core.USBError
        If the bus itself cannot be listed.
    """
    found = []
    for kind in KINDS:
        devices = [_device(kind, raw, sysfs, dev) for raw in _enumerate(backend, kind)]
        found += sorted(devices, key=lambda device: (device.bus, device.ports))
    is_simulated = bool(getattr(backend, "is_simulated", False))
    found = [replace(device, is_simulated=is_simulated) for device in found]
    cameras = [device for device in found if device.kind.key == "boson"]
    return [_with_bandwidth(device, cameras, frame_rate) for device in found]


def describe(devices: Iterable[Device]) -> str:
    """
    Say in words what was found, what is missing and what to do.

    Parameters
    ----------
    devices : iterable of Device
        From `find`.

    Returns
    -------
    str
        A line for each device, warnings below it, and one for each kind that is not there.
    """
    known = list(devices)
    lines = []
    for kind in KINDS:
        of_kind = [device for device in known if device.kind == kind]
        for device in of_kind:
            nodes = " ".join((*device.video_nodes, *device.serial_nodes)) or "no nodes"
            name = f"{'emulated ' if device.is_simulated else ''}{kind.name}"
            serial = device.serial or "without serial number"
            lines.append(f"{name} {serial}: {device.path}, {device.speed} speed, {nodes}")
            lines += [f"  ! {warning}" for warning in device.warnings]
        if not of_kind:
            usb_id = f"{kind.vendor:04x}:{kind.product:04x}"
            lines.append(
                f"{kind.name}: not found ({usb_id}). Must be plugged in and switched on; "
                f"'lsusb -d {usb_id}' lists it then."
            )
    return "\n".join(lines)


def _enumerate(backend: Any, kind: Kind) -> Iterator[Any]:
    """List pyusb's devices of one kind."""
    wanted = {"idVendor": kind.vendor, "idProduct": kind.product}
    try:
        yield from usb.core.find(find_all=True, backend=backend, **wanted)
    except usb.core.NoBackendError as error:
        raise LibusbMissingError(
            "No libusb found. Must be installed to see USB devices: "
            "the package libusb-1.0-0 of Debian, libusb of Homebrew or conda."
        ) from error


def _device(kind: Kind, raw: Any, sysfs: Path, dev: Path) -> Device:
    """Say all of one device that it, and sysfs, know."""
    ports = tuple(raw.port_numbers or ())
    device = Device(kind, raw.bus, raw.address, ports, SPEEDS.get(raw.speed, "unknown"))
    serial, problem = _serial_number(kind, raw)
    folder = sysfs / "bus" / "usb" / "devices" / device.path
    if not ports or not folder.is_dir():
        return replace(device, serial=serial).warned(
            problem, f"Its nodes are not known: there is no {folder}." if kind.nodes else None
        )
    serial = _written(folder / "serial") if serial is None else serial
    video = _nodes(dev, folder.glob("*:*/video4linux/video*"))
    tty = _nodes(dev, [*folder.glob("*:*/tty/tty*"), *folder.glob("*:*/ttyUSB*/tty/tty*")])
    device = replace(device, serial=serial, video_nodes=video, serial_nodes=tty)
    families = {"video": video, "serial": tty}
    lacking = [_lacking(kind, name) for name in kind.nodes if not families[name]]
    denied = permissions.denied_nodes([*video, *tty], kind.vendor, kind.product)
    if problem == permissions.denied_device(kind.vendor, kind.product) and serial and kind.nodes:
        problem = None  # its number is known from sysfs, and its drivers open its nodes
    return device.warned(problem, *lacking, *denied)


def _lacking(kind: Kind, family: str) -> str:
    """Say what to do for nodes that no kernel driver made."""
    module = MODULES[kind.key, family]
    text = f"It has no {family} node. Must have its kernel driver: run 'sudo modprobe {module}'"
    if module != "ftdi_sio":
        return f"{text}."
    return (
        f"{text}, and if there is still none, 'echo {kind.vendor:04x} {kind.product:04x} | "
        "sudo tee /sys/bus/usb-serial/drivers/ftdi_sio/new_id'."
    )


def _serial_number(kind: Kind, raw: Any) -> tuple[str | None, str | None]:
    """Read the serial number; where that fails, say why."""
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


def _problem(kind: Kind, error: Exception) -> str:
    """Say what an error of the bus means, and what to do."""
    number = getattr(error, "errno", None)
    if number in {errno.EACCES, errno.EPERM}:
        return permissions.denied_device(kind.vendor, kind.product)
    if number in {errno.ENODEV, errno.ENOENT}:
        return "It was unplugged while it was looked at."
    return f"It does not answer: {error}. Plug it in again."


def _written(entry: Path) -> str | None:
    """Text of an entry of sysfs; None if there is none, as of a device that was just pulled out."""
    try:
        return entry.read_text(encoding="utf-8", errors="backslashreplace").strip()
    except OSError:
        return None


def _nodes(dev: Path, entries: Iterable[Path]) -> tuple[str, ...]:
    """Give the nodes of sysfs entries, in the order of their numbers."""
    names = {entry.name for entry in entries}
    ordered = sorted(names, key=lambda name: (len(re.sub(r"\D", "", name)), name))
    return tuple(str(dev / name) for name in ordered)


def _with_bandwidth(device: Device, cameras: list[Device], frame_rate: float) -> Device:
    """Warn if a camera's video does not fit the bus, alone or with the others on it."""
    if device.kind.key != "boson":
        return device
    one = video_rate(frame_rate) / 1e6
    if device.speed in {"low", "full"}:
        return device.warned(
            f"It runs at {device.speed} speed, and {frame_rate:g} frames/s take {one:.1f} Mbit/s. "
            "Must be at high speed: use another port or cable."
        )
    same = [camera for camera in cameras if (camera.bus, camera.speed) == (device.bus, "high")]
    total, most = one * len(same), HIGH_SPEED_PAYLOAD / 1e6
    if device not in same or total <= most:
        return device
    together = len({camera.ports[:1] for camera in same}) == 1
    how = "and the root port" if together else "though not the root port (ask the controller)"
    others = ", ".join(str(camera.serial) for camera in same if camera is not device) or "no other"
    return device.warned(
        f"It shares bus {device.bus} {how} with {others}: {total:.1f} Mbit/s at {frame_rate:g} "
        f"frames/s, of {most:.1f} Mbit/s at most. Use ports of two controllers, or "
        f"{SLOW:g} frames/s: {total * SLOW / frame_rate:.1f} Mbit/s."
    )
