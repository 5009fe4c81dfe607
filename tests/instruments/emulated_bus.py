"""An emulated USB bus for pyusb, with its sysfs tree, to test the inventory.

Everything that would open or disturb a live device is missing: pyusb then raises an error. No
device's own protocol is emulated here.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import usb.backend


@dataclass
class EmulatedDevice:
    """One device that is plugged in; its serial number says that it is emulated."""

    vendor: int
    product: int
    serial: str = "EMULATED"
    bus: int = 1
    ports: tuple[int, ...] = (1,)  # on the way
    speed: int = 3  # as libusb numbers it; 2 is full, 3 high
    nodes: tuple[str, ...] = ()  # as sysfs lists them below the device's interfaces

    @property
    def path(self) -> str:
        """Bus and ports."""
        return f"{self.bus}-{'.'.join(str(port) for port in self.ports)}"


def boson(number: int = 1, **settings: Any) -> EmulatedDevice:
    """A camera with two video nodes and a serial one; `number`, from 1, is in all its names."""
    own: dict[str, Any] = {"serial": f"EMULATED{number}", "ports": (number,)}
    video = (f"video4linux/video{index}" for index in (2 * number - 2, 2 * number - 1))
    own["nodes"] = (*video, f"tty/ttyACM{number - 1}")
    return EmulatedDevice(0x09CB, 0x4007, **{**own, **settings})


def apt(**settings: Any) -> EmulatedDevice:
    """An APT controller on its FTDI chip, at full speed."""
    own: dict[str, Any] = {"ports": (3,), "speed": 2, "nodes": ("ttyUSB0",)}
    return EmulatedDevice(0x0403, 0xFAF0, **{**own, **settings})


def tc08(**settings: Any) -> EmulatedDevice:
    """A TC-08, at full speed, without a kernel driver."""
    return EmulatedDevice(0x0CE9, 0x1000, **{"ports": (4,), "speed": 2, **settings})


class EmulatedBackend(usb.backend.IBackend):  # type: ignore[misc]
    """A backend of pyusb with devices of its own, which can only be listed."""

    def __init__(self, *devices: EmulatedDevice) -> None:
        self.devices = devices

    def enumerate_devices(self) -> Iterator[EmulatedDevice]:
        """List what is plugged in."""
        return iter(self.devices)

    def get_device_descriptor(self, dev: EmulatedDevice) -> SimpleNamespace:
        """Give the device descriptor, with what libusb adds: bus, address, ports, speed."""
        fixed = {
            **dict.fromkeys(("bDeviceClass", "bDeviceSubClass", "bDeviceProtocol"), 0),
            **dict.fromkeys(("bDescriptorType", "iSerialNumber", "bNumConfigurations"), 1),
            **dict(zip(("bLength", "bcdUSB", "bMaxPacketSize0"), (18, 0x0200, 64), strict=True)),
            **dict(zip(("bcdDevice", "iManufacturer", "iProduct"), (0x0100, 0, 0), strict=True)),
        }
        return SimpleNamespace(
            **fixed,
            idVendor=dev.vendor,
            idProduct=dev.product,
            address=dev.ports[0],
            bus=dev.bus,
            port_number=dev.ports[-1],
            port_numbers=dev.ports,
            speed=dev.speed,
        )


def write_trees(sysfs: Path, dev: Path, devices: tuple[EmulatedDevice, ...]) -> None:
    """Write what Linux's sysfs would hold of the devices, and their nodes."""
    for device in devices:
        folder = sysfs / "bus" / "usb" / "devices" / device.path
        folder.mkdir(parents=True)
        if device.serial:
            (folder / "serial").write_text(f"{device.serial}\n", encoding="utf-8")
        usb_node = dev / f"bus/usb/{device.bus:03d}" / f"{device.ports[0]:03d}"
        usb_node.parent.mkdir(parents=True, exist_ok=True)
        usb_node.touch()
        for node in device.nodes:
            (folder / f"{device.path}:1.0" / node).mkdir(parents=True)
            (dev / Path(node).name).touch()
