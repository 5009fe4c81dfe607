"""An emulated USB bus for pyusb, on which the rig's devices are plugged in, and Linux's view of it.

`EmulatedBackend` takes the place of libusb. It answers what an inventory may ask: which devices
there are, and their strings. Everything that would disturb a live device is refused with an error,
so that a test sees it. No device's own protocol is emulated here.
"""

import errno
from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any, Final, Literal, NoReturn

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
    bus, address : int
        Where it is.
    ports : tuple of int
        Ports on the way.
    speed : int
        As libusb numbers it; 2 is full, 3 high.
    nodes : dict
        Interface, from 0, to its kernel driver and the node that it makes: ``("uvcvideo",
        "video0")``; see `write_sysfs`.
    fault : str
        What happens when its strings are read: ``"permission"``, ``"unplugged"``, ``"timeout"``,
        ``"damaged"`` (bytes that are no text), ``"mute"`` (no strings), ``"unsupported"``.
    """

    vendor: int
    product: int
    serial: str
    bus: int = 1
    address: int = 1
    ports: tuple[int, ...] = (1,)
    speed: int = 3
    nodes: dict[int, tuple[str, str]] = field(default_factory=dict)
    fault: Fault = ""


def boson(number: int = 1, **settings: Any) -> EmulatedDevice:
    """
    Give a camera with two video nodes and a serial one.

    Parameters
    ----------
    number : int
        From 1; it gives the serial number, the port and the nodes.
    **settings
        Of `EmulatedDevice`, in place of these.

    Returns
    -------
    EmulatedDevice
        The camera.
    """
    nodes = {
        0: ("uvcvideo", f"video{2 * number - 2}"),
        1: ("uvcvideo", f"video{2 * number - 1}"),
        2: ("cdc_acm", f"ttyACM{number - 1}"),
    }
    own = {"serial": f"EMULATED{number}", "ports": (number,), "address": number, "nodes": nodes}
    return EmulatedDevice(0x09CB, 0x4007, **{**own, **settings})


def apt(**settings: Any) -> EmulatedDevice:
    """
    Give an APT controller on its FTDI chip, at full speed.

    Parameters
    ----------
    **settings
        Of `EmulatedDevice`.

    Returns
    -------
    EmulatedDevice
        The controller.
    """
    own = {"serial": "EMULATED", "ports": (3,), "address": 3, "speed": 2}
    own["nodes"] = {0: ("ftdi_sio", "ttyUSB0")}
    return EmulatedDevice(0x0403, 0xFAF0, **{**own, **settings})


def tc08(**settings: Any) -> EmulatedDevice:
    """
    Give a TC-08, at full speed, without a kernel driver.

    Parameters
    ----------
    **settings
        Of `EmulatedDevice`.

    Returns
    -------
    EmulatedDevice
        The logger.
    """
    own: dict[str, Any] = {"serial": "EMULATED", "ports": (4,), "address": 4, "speed": 2}
    return EmulatedDevice(0x0CE9, 0x1000, **{**own, **settings})


class EmulatedBackend(usb.backend.IBackend):  # type: ignore[misc]
    """
    A backend of pyusb with devices of its own.

    Parameters
    ----------
    *devices : EmulatedDevice
        What is plugged in; `devices` may be changed at any time.

    Attributes
    ----------
    devices : list of EmulatedDevice
        What is plugged in.
    opened : int
        Handles that are open now.
    answer : callable
        Gives the descriptor of a device's string; a test may send anything.
    is_simulated : bool
        True.
    """

    is_simulated: Final = True

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
            address=dev.address,
            bus=dev.bus,
            port_number=dev.ports[-1] if dev.ports else None,
            port_numbers=dev.ports or None,
            speed=dev.speed,
        )

    def get_configuration_descriptor(self, dev: EmulatedDevice, config: int) -> SimpleNamespace:
        """Give the only configuration there is, without interfaces."""
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
        """Open a device, if one may."""
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
        """Refuse: it resets the device."""
        self._refuse("set_configuration")

    def set_interface_altsetting(self, *_: Any) -> NoReturn:
        """Refuse: it stops the stream."""
        self._refuse("set_interface_altsetting")

    def claim_interface(self, *_: Any) -> NoReturn:
        """Refuse: the kernel has it."""
        self._refuse("claim_interface")

    def detach_kernel_driver(self, *_: Any) -> NoReturn:
        """Refuse: the nodes would vanish."""
        self._refuse("detach_kernel_driver")

    def reset_device(self, *_: Any) -> NoReturn:
        """Refuse."""
        self._refuse("reset_device")

    def clear_halt(self, *_: Any) -> NoReturn:
        """Refuse."""
        self._refuse("clear_halt")

    def _refuse(self, function: str) -> NoReturn:
        raise AssertionError(f"Invalid {function} on a live device. Must only be looked at.")


def write_sysfs(root: Path, backend: EmulatedBackend) -> None:
    """
    Write what Linux's sysfs would hold of the devices that are plugged in.

    Parameters
    ----------
    root : Path
        Folder that takes the place of ``/sys``.
    backend : EmulatedBackend
        The bus.
    """
    for device in backend.devices:
        name = f"{device.bus}-{'.'.join(str(port) for port in device.ports)}"
        real = root / "devices" / f"usb{device.bus}" / name
        real.mkdir(parents=True)
        if device.serial:
            (real / "serial").write_text(f"{device.serial}\n", encoding="utf-8")
        for number, (driver, node) in device.nodes.items():
            interface = real / f"{name}:1.{number}"
            family = "video4linux" if node.startswith("video") else "tty"
            above = interface / node if node.startswith("ttyUSB") else interface
            (above / family / node).mkdir(parents=True)
            (interface / "driver").symlink_to(root / "bus" / "usb" / "drivers" / driver)
        link = root / "bus" / "usb" / "devices" / name
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(real)


@contextmanager
def rig() -> Iterator[dict[str, Any]]:
    """
    Plug in two cameras on a bus each, a wheel's controller and a thermocouple logger.

    Yields
    ------
    dict
        Arguments for `dbthermal.instruments.inventory.find`; the files behind them are removed in
        the end.
    """
    backend = EmulatedBackend(boson(1), boson(2, bus=2), apt(), tc08())
    with TemporaryDirectory() as folder:
        root = Path(folder)
        write_sysfs(root, backend)
        for node in (node for device in backend.devices for _, node in device.nodes.values()):
            (root / "dev").mkdir(exist_ok=True)
            (root / "dev" / node).touch()
        yield {"backend": backend, "sysfs": root, "dev": root / "dev"}


def string_descriptor(device: EmulatedDevice, index: int) -> bytes:
    """
    Give a string of a device as its bytes.

    Parameters
    ----------
    device : EmulatedDevice
        The device.
    index : int
        Of the string; 0 lists the languages.

    Returns
    -------
    bytes
        The descriptor.
    """
    if device.fault == "mute":
        return bytes((2, _STRING))
    if index == 0:
        return bytes((4, _STRING)) + _ENGLISH.to_bytes(2, "little")
    text = b"\x00\xd8A" if device.fault == "damaged" else device.serial.encode("utf-16-le")
    return bytes((len(text) + 2 & 0xFE, _STRING)) + text
