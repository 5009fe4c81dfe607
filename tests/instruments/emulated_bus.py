"""An emulated USB bus for pyusb, with its sysfs tree and serial ports, to test the inventory.

Everything that would disturb a live device is refused with an error, so that a test sees it. No
device's own protocol is emulated here.
"""

import errno
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal, NoReturn

import usb.backend
import usb.core

Fault = Literal["", "permission", "unplugged", "timeout", "damaged", "mute", "unsupported"]

_GET_DESCRIPTOR, _STRING, _ENGLISH = 6, 3, 0x0409


@dataclass
class EmulatedDevice:
    """
    One device that is plugged in; its strings say that it is emulated.

    Attributes
    ----------
    vendor, product : int
        USB identity.
    serial : str
        Serial number, none if empty.
    bus : int
        Where it is.
    ports : tuple of int
        Ports on the way.
    speed : int
        As libusb numbers it; 2 is full, 3 high.
    video, tty : tuple of str
        Names of its nodes.
    fault : str
        What happens when its strings are read: ``"damaged"`` are bytes that are no text,
        ``"mute"`` is no strings.
    """

    vendor: int
    product: int
    serial: str
    bus: int = 1
    ports: tuple[int, ...] = (1,)
    speed: int = 3
    video: tuple[str, ...] = ()
    tty: tuple[str, ...] = ()
    fault: Fault = ""

    @property
    def path(self) -> str:
        """Bus and ports."""
        return f"{self.bus}-{'.'.join(str(port) for port in self.ports)}"


def boson(number: int = 1, **settings: Any) -> EmulatedDevice:
    """A camera with two video nodes and a serial one; `number`, from 1, is in all its names."""
    own: dict[str, Any] = {"serial": f"EMULATED{number}", "ports": (number,)}
    own["video"] = (f"video{2 * number - 2}", f"video{2 * number - 1}")
    own["tty"] = (f"ttyACM{number - 1}",)
    return EmulatedDevice(0x09CB, 0x4007, **{**own, **settings})


def apt(**settings: Any) -> EmulatedDevice:
    """An APT controller on its FTDI chip, at full speed."""
    own: dict[str, Any] = {"serial": "EMULATED", "ports": (3,), "speed": 2, "tty": ("ttyUSB0",)}
    return EmulatedDevice(0x0403, 0xFAF0, **{**own, **settings})


def tc08(**settings: Any) -> EmulatedDevice:
    """A TC-08, at full speed, without a kernel driver."""
    own: dict[str, Any] = {"serial": "EMULATED", "ports": (4,), "speed": 2}
    return EmulatedDevice(0x0CE9, 0x1000, **{**own, **settings})


class EmulatedBackend(usb.backend.IBackend):  # type: ignore[misc]
    """
    A backend of pyusb with devices of its own.

    Attributes
    ----------
    devices : list of EmulatedDevice
        What is plugged in.
    opened : int
        Handles that are open now.
    answer : callable
        Gives the descriptor of a device's string; a test may send anything.
    """

    def __init__(self, *devices: EmulatedDevice) -> None:
        self.devices = list(devices)
        self.opened = 0
        self.answer = string_descriptor

    def enumerate_devices(self) -> Iterator[EmulatedDevice]:
        """List what is plugged in."""
        return iter(list(self.devices))

    def get_device_descriptor(self, dev: EmulatedDevice) -> SimpleNamespace:
        """Give the device descriptor, with what libusb adds: bus, address, ports, speed."""
        return SimpleNamespace(
            bLength=18,
            bDescriptorType=1,
            bcdUSB=0x0200,
            bDeviceClass=0,
            bDeviceSubClass=0,
            bDeviceProtocol=0,
            bMaxPacketSize0=64,
            idVendor=dev.vendor,
            idProduct=dev.product,
            bcdDevice=0x0100,
            iManufacturer=0,
            iProduct=0,
            iSerialNumber=1 if dev.serial else 0,
            bNumConfigurations=1,
            address=dev.ports[0],
            bus=dev.bus,
            port_number=dev.ports[-1],
            port_numbers=dev.ports,
            speed=dev.speed,
        )

    def get_configuration_descriptor(self, dev: EmulatedDevice, config: int) -> SimpleNamespace:
        """Give the only configuration of a device, without interfaces."""
        del dev, config
        return SimpleNamespace(
            bLength=9,
            bDescriptorType=2,
            wTotalLength=9,
            bNumInterfaces=0,
            bConfigurationValue=1,
            iConfiguration=0,
            bmAttributes=0x80,
            bMaxPower=250,
            extra_descriptors=[],
        )

    def open_device(self, dev: EmulatedDevice) -> EmulatedDevice:
        """Open a device, or raise the error of its fault."""
        if dev.fault == "permission":
            raise usb.core.USBError("Access denied (emulated)", -3, errno.EACCES)
        if dev.fault == "unplugged":
            raise usb.core.USBError("No such device (emulated)", -4, errno.ENODEV)
        if dev.fault == "unsupported":
            raise NotImplementedError("Operation not supported (emulated)")
        self.opened += 1
        return dev

    def close_device(self, dev_handle: EmulatedDevice) -> None:  # noqa: ARG002
        """Close it."""
        self.opened -= 1

    def ctrl_transfer(
        self,
        dev_handle: EmulatedDevice,
        bmRequestType: int,  # noqa: N803
        bRequest: int,  # noqa: N803
        wValue: int,  # noqa: N803
        wIndex: int,  # noqa: N803, ARG002
        data: "array[int]",
        timeout: int,
    ) -> int:
        """Answer a request for a string, and no other."""
        if (bmRequestType, bRequest, wValue >> 8) != (0x80, _GET_DESCRIPTOR, _STRING):
            self._refuse("ctrl_transfer")
        if dev_handle.fault == "timeout":
            raise usb.core.USBTimeoutError(f"Timed out after {timeout} ms (emulated)", -7, 110)
        answer = self.answer(dev_handle, wValue & 0xFF)[: len(data)]
        data[: len(answer)] = array("B", answer)
        return len(answer)

    def set_configuration(self, *_: Any) -> NoReturn:
        """Fail: this would reset the device."""
        self._refuse("set_configuration")

    def set_interface_altsetting(self, *_: Any) -> NoReturn:
        """Fail: this would stop the stream."""
        self._refuse("set_interface_altsetting")

    def claim_interface(self, *_: Any) -> NoReturn:
        """Fail: the kernel's driver has the interface."""
        self._refuse("claim_interface")

    def detach_kernel_driver(self, *_: Any) -> NoReturn:
        """Fail: the device's nodes would vanish."""
        self._refuse("detach_kernel_driver")

    def reset_device(self, *_: Any) -> NoReturn:
        """Fail: this would disturb the device."""
        self._refuse("reset_device")

    def clear_halt(self, *_: Any) -> NoReturn:
        """Fail: this would disturb the device."""
        self._refuse("clear_halt")

    def _refuse(self, function: str) -> NoReturn:
        raise AssertionError(f"Invalid {function} on a live device. Must only be looked at.")


def write_sysfs(root: Path, devices: tuple[EmulatedDevice, ...]) -> None:
    """Write what Linux's sysfs, here `root`, would hold of the devices' video nodes."""
    for device in devices:
        folder = root / "bus" / "usb" / "devices" / device.path
        folder.mkdir(parents=True)
        for number, node in enumerate(device.video):
            (folder / f"{device.path}:1.{number}" / "video4linux" / node).mkdir(parents=True)


def serial_ports(dev: Path, devices: tuple[EmulatedDevice, ...]) -> list[SimpleNamespace]:
    """Serial ports as pyserial lists them: a converter's is at the device, others at interfaces."""
    return [
        SimpleNamespace(
            device=str(dev / node),
            location=device.path if "USB" in node else f"{device.path}:1.2",
            serial_number=device.serial or None,
        )
        for device in devices
        for node in device.tty
    ]


def string_descriptor(device: EmulatedDevice, index: int) -> bytes:
    """Give a string of a device as its bytes; index 0 lists the languages."""
    if device.fault == "mute":
        return bytes((2, _STRING))
    if index == 0:
        return bytes((4, _STRING)) + _ENGLISH.to_bytes(2, "little")
    text = b"\x00\xd8A" if device.fault == "damaged" else device.serial.encode("utf-16-le")
    return bytes((len(text) + 2 & 0xFE, _STRING)) + text
