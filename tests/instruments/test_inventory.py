"""The inventory of the rig on an emulated USB bus and a written sysfs tree."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import usb.backend
import usb.backend.libusb0
import usb.backend.libusb1
import usb.backend.openusb

from dbthermal.instruments import inventory
from dbthermal.instruments.inventory import Device


@dataclass
class EmulatedDevice:
    """A device that is plugged in, and its descriptor; the serial number says it is emulated."""

    idVendor: int  # noqa: N815 - libusb's names
    idProduct: int  # noqa: N815
    serial: str = "EMULATED"
    bus: int = 1
    port_numbers: tuple[int, ...] = (1,)  # on the way
    speed: int = 3  # as libusb numbers it; 2 is full, 3 high
    nodes: tuple[str, ...] = ()  # as sysfs lists them below the device's interfaces

    @property
    def address(self) -> int:
        """Number on the bus."""
        return self.port_numbers[0]

    def __getattr__(self, name: str) -> int:
        """Any other number of the descriptor."""
        return 1


def boson(number: int = 1, **settings: Any) -> EmulatedDevice:
    """A camera with two video nodes and a serial one; `number`, from 1, is in all its names."""
    defaults: dict[str, Any] = {"serial": f"EMULATED{number}", "port_numbers": (number,)}
    video = (f"video4linux/video{index}" for index in (2 * number - 2, 2 * number - 1))
    defaults["nodes"] = (*video, f"tty/ttyACM{number - 1}")
    return EmulatedDevice(0x09CB, 0x4007, **{**defaults, **settings})


def apt(nodes: tuple[str, ...] = ("ttyUSB0",)) -> EmulatedDevice:
    """An APT controller on its FTDI chip, at full speed."""
    return EmulatedDevice(0x0403, 0xFAF0, port_numbers=(3,), speed=2, nodes=nodes)


def tc08(serial: str = "EMULATED") -> EmulatedDevice:
    """A TC-08, at full speed, without a kernel driver."""
    return EmulatedDevice(0x0CE9, 0x1000, serial, port_numbers=(4,), speed=2)


class EmulatedBackend(usb.backend.IBackend):  # type: ignore[misc]
    """A backend of pyusb with devices of its own, which can only be listed.

    Everything that would open or disturb a live device is missing: pyusb then raises an error.
    """

    def __init__(self, *devices: EmulatedDevice) -> None:
        self.devices = devices

    def enumerate_devices(self) -> Iterator[EmulatedDevice]:
        """List what is plugged in."""
        return iter(self.devices)

    def get_device_descriptor(self, dev: EmulatedDevice) -> EmulatedDevice:
        """Give the device descriptor, with what libusb adds: bus, address, ports, speed."""
        return dev


def look(tmp_path: Path, *devices: EmulatedDevice, frame_rate: float = 30.0) -> list[Device]:
    """Find the devices on a bus of their own, with the nodes and the sysfs that belong to it."""
    dev = tmp_path / "dev"
    for device in devices:
        path = f"{device.bus}-{'.'.join(map(str, device.port_numbers))}"
        (folder := tmp_path / "bus" / "usb" / "devices" / path).mkdir(parents=True)
        if device.serial:
            (folder / "serial").write_text(f"{device.serial}\n", encoding="utf-8")
        usb_node = dev / f"bus/usb/{device.bus:03d}" / f"{device.address:03d}"
        usb_node.parent.mkdir(parents=True, exist_ok=True)
        usb_node.touch()
        for node in device.nodes:
            (folder / f"{path}:1.0" / node).mkdir(parents=True)
            (dev / Path(node).name).touch()
    backend = EmulatedBackend(*devices)
    return inventory.find(backend, sysfs=tmp_path, dev=dev, frame_rate=frame_rate)


def test_whole_rig(tmp_path: Path) -> None:
    """Two cameras, the wheel's controller and the logger are listed without a warning."""
    devices = look(tmp_path, tc08(serial=""), apt(), boson(2, bus=2), boson(1))
    assert {device.warnings for device in devices} == {()}
    assert [
        line.replace(str(tmp_path / "dev"), "") for line in inventory.describe(devices).splitlines()
    ] == [
        "FLIR Boson EMULATED1: 1-1, high speed, /video0 /video1 /ttyACM0",
        "FLIR Boson EMULATED2: 2-2, high speed, /video2 /video3 /ttyACM1",
        "Thorlabs APT controller EMULATED: 1-3, full speed, /ttyUSB0",
        "Pico TC-08 without serial number: 1-4, full speed, no nodes",
    ]


def test_nothing_plugged_in(tmp_path: Path) -> None:
    """A mouse and FLIR's other devices are not listed; missing devices and warnings are named."""
    strangers = EmulatedDevice(0x046D, 0xC077), EmulatedDevice(0x09CB, 0x0100, bus=2)
    assert look(tmp_path, *strangers) == []
    assert inventory.describe([]).splitlines()[0] == (
        "FLIR Boson: not found (09cb:4007). Must be plugged in and switched on; "
        "'lsusb -d 09cb:4007' lists it then."
    )
    lines = inventory.describe(look(tmp_path / "slow", boson(speed=2))).splitlines()
    assert lines[1].startswith("  ! It runs at full speed")
    assert lines[2].startswith("Thorlabs APT controller: not found")


def test_nodes_belong_to_their_camera(tmp_path: Path) -> None:
    """Each device has the nodes below its own USB device, in the order of their numbers."""
    nodes = ("video4linux/video10", "video4linux/video9", "tty/ttyACM7")
    cameras = boson(1, nodes=nodes, port_numbers=(1, 2)), boson(2, port_numbers=(1, 3))
    first, second, controller = look(tmp_path, *cameras, apt())
    names = [[Path(node).name for node in device.nodes] for device in (first, second, controller)]
    assert names == [["video9", "video10", "ttyACM7"], ["video2", "video3", "ttyACM1"], ["ttyUSB0"]]
    assert {Path(node).parent for node in first.nodes} == {tmp_path / "dev"}
    assert (first.path, second.path) == ("1-1.2", "1-1.3")


def test_missing_driver(tmp_path: Path) -> None:
    """A device whose kernel driver made no node says which module to load."""
    camera, controller = look(tmp_path, apt(nodes=()), boson(nodes=()))
    assert controller.warnings == (
        "It has no serial node. Must have its kernel driver: run 'sudo modprobe ftdi_sio'.",
    )
    modules = [warning.split("modprobe ")[1] for warning in camera.warnings]
    assert modules == ["uvcvideo'.", "cdc_acm'."]


def test_rates_that_a_bus_cannot_carry(tmp_path: Path) -> None:
    """A camera at full speed and two cameras on one bus have a warning with the rates."""
    (slow,) = look(tmp_path / "slow", boson(speed=2), frame_rate=60.0)
    rule = "It runs at full speed, and 60 frames/s take 314.6 Mbit/s. Must be at high speed"
    assert slow.warnings[0].startswith(rule)
    pair = boson(1, port_numbers=(1, 1)), boson(2, port_numbers=(1, 2))
    devices = look(tmp_path / "shared", *pair, frame_rate=60.0)
    assert " and ".join(devices[0].warnings) == (
        "It shares bus 1 with 1-1.2: 629.1 Mbit/s at 60 frames/s, of 426.0 Mbit/s at most. "
        "Use ports of two controllers, or fewer frames/s."
    )
    assert "with 1-1.1" in devices[1].warnings[0]
    fit = look(tmp_path / "fit", boson(1), boson(2), frame_rate=30.0)
    fit += look(tmp_path / "apart", boson(1), boson(2, bus=2), frame_rate=60.0)
    assert {device.warnings for device in fit} == {()}


def test_node_that_may_not_be_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nodes without permission are named, with the udev rule; without nodes the device's own."""
    monkeypatch.setattr(os, "access", lambda *_: False)
    camera, logger = look(tmp_path, boson(), tc08())
    nodes = ", ".join(str(tmp_path / "dev" / name) for name in ("video0", "video1", "ttyACM0"))
    assert camera.warnings[0].startswith(f"No permission for {nodes}. Type this, and plug it in")
    assert f"No permission for {tmp_path / 'dev' / 'bus/usb/001/004'}." in logger.warnings[0]
    assert (
        """echo 'ATTRS{idVendor}=="0ce9", ATTRS{idProduct}=="1000", MODE="0660", """
        """GROUP="plugdev", TAG+="uaccess"' | sudo tee -a /etc/udev/rules.d/70-dbthermal.rules"""
    ) in logger.warnings[0]


def test_system_without_sysfs() -> None:
    """Without sysfs the devices are listed, and their nodes are reported as unknown."""
    (device,) = inventory.find(EmulatedBackend(boson()), sysfs=Path("/nowhere"))
    assert device.warnings[0].startswith("Its nodes and number are not known: there is no /nowhere")


def test_missing_libusb(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without libusb the error says what to install."""
    for module in (usb.backend.libusb1, usb.backend.libusb0, usb.backend.openusb):
        monkeypatch.setattr(module, "get_backend", lambda: None)
    with pytest.raises(inventory.LibusbMissingError, match=r"No libusb found\. Must be installed"):
        inventory.find()
