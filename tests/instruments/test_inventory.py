"""The inventory of the rig on an emulated USB bus and a written sysfs tree."""

import os
from collections.abc import Callable
from pathlib import Path

import emulated_bus as emulated
import pytest
import usb.backend.libusb0
import usb.backend.libusb1
import usb.backend.openusb
from emulated_bus import EmulatedBackend, apt, boson, tc08
from hypothesis import given
from hypothesis import strategies as st

from dbthermal.instruments import inventory
from dbthermal.instruments.inventory import Device


def look(
    tmp_path: Path, *devices: emulated.EmulatedDevice, frame_rate: float = 30.0
) -> list[Device]:
    """Find the devices on a bus of their own, with the sysfs that belongs to it."""
    backend, dev = EmulatedBackend(*devices), tmp_path / "dev"
    emulated.write_sysfs(tmp_path, devices)
    ports = emulated.serial_ports(dev, devices)
    found = inventory.find(
        backend, serial_ports=ports, sysfs=tmp_path, dev=dev, frame_rate=frame_rate
    )
    assert backend.opened == 0
    return found


def find_bare(backend: EmulatedBackend) -> list[Device]:
    """Find the devices of a bus on a system without sysfs and serial ports."""
    return inventory.find(backend, serial_ports=[], sysfs=Path("/nowhere"))


def denied_nodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: int, *, group: int, own: set[int]
) -> Path:
    """Nodes of a camera that may not be used, of this mode and group, to a user of other groups."""
    dev = tmp_path / "dev"
    dev.mkdir()
    for name in ("video0", "video1", "ttyACM0"):
        (dev / name).touch()
        (dev / name).chmod(mode)
    about, groups = (dev / "video0").stat(), {0: "root", 44: "video"}
    stat = os.stat_result([*about[:5], group, *about[6:]])
    monkeypatch.setattr(inventory, "_stat", lambda _: stat)
    monkeypatch.setattr(Path, "group", lambda *_: groups[group])
    monkeypatch.setattr(os, "access", lambda *_: False)
    monkeypatch.setattr(os, "getgroups", lambda: list(own))
    return dev


def test_whole_rig(tmp_path: Path) -> None:
    """Two cameras, the wheel's controller and the logger are listed without a warning."""
    found = look(tmp_path, tc08(), apt(), boson(2, bus=2), boson(1))
    assert [device.kind.key for device in found] == ["boson", "boson", "apt", "tc08"]
    assert [device.path for device in found] == ["1-1", "2-2", "1-3", "1-4"]
    assert [device.serial for device in found] == ["EMULATED1", "EMULATED2", "EMULATED", "EMULATED"]
    assert [device.speed for device in found] == ["high", "high", "full", "full"]
    assert {device.warnings for device in found} == {()}


def test_nothing_plugged_in(tmp_path: Path) -> None:
    """An empty bus gives an empty list, and the description names the missing devices."""
    assert look(tmp_path) == []
    told = inventory.describe([]).splitlines()
    assert told[0] == (
        "FLIR Boson: not found (09cb:4007). Must be plugged in and switched on; "
        "'lsusb -d 09cb:4007' lists it then."
    )


def test_other_devices_are_not_listed(tmp_path: Path) -> None:
    """A mouse, and FLIR's devices of another kind, are not listed."""
    others = (
        emulated.EmulatedDevice(0x046D, 0xC077, ""),
        emulated.EmulatedDevice(0x09CB, 0x0100, ""),
    )
    assert look(tmp_path, *others[:1]) == []
    assert find_bare(EmulatedBackend(others[1])) == []


def test_nodes_belong_to_their_camera(tmp_path: Path) -> None:
    """Each camera has the nodes below its own USB device, in the order of their numbers."""
    nodes = {"video": ("video10", "video9"), "tty": ("ttyACM7",)}
    first, second = look(tmp_path, boson(1, **nodes, ports=(1, 2)), boson(2, ports=(1, 3)))
    dev = tmp_path / "dev"
    assert first.video_nodes == (str(dev / "video9"), str(dev / "video10"))
    assert first.serial_nodes == (str(dev / "ttyACM7"),)
    assert second.video_nodes == (str(dev / "video2"), str(dev / "video3"))
    assert (first.path, second.path) == ("1-1.2", "1-1.3")


def test_controller_behind_a_serial_converter(tmp_path: Path) -> None:
    """The node of a USB converter is listed at its device, and is found too."""
    assert look(tmp_path, apt())[0].serial_nodes == (str(tmp_path / "dev" / "ttyUSB0"),)


def test_missing_driver(tmp_path: Path) -> None:
    """A device whose kernel driver made no node says which module to load."""
    controller, camera = sorted(
        look(tmp_path, apt(tty=()), boson(video=(), tty=())), key=lambda d: d.kind.key
    )
    assert " ".join(controller.warnings) == (
        "It has no serial node. Must have its kernel driver: run 'sudo modprobe ftdi_sio', and if "
        "there is still none, 'echo 0403 faf0 | sudo tee "
        "/sys/bus/usb-serial/drivers/ftdi_sio/new_id'."
    )
    modules = [warning.split("modprobe ")[1] for warning in camera.warnings]
    assert modules == ["uvcvideo'.", "cdc_acm'."]


def test_permission(tmp_path: Path) -> None:
    """A device without permission gets a udev rule, unless its nodes and number are known."""
    found = look(tmp_path, tc08(fault="permission"), boson(fault="permission"))
    assert [device.serial for device in found] == ["EMULATED1", None]
    assert (found[0].warnings, len(found[1].warnings)) == ((), 1)
    assert (
        """echo 'SUBSYSTEM=="usb", ATTR{idVendor}=="0ce9", ATTR{idProduct}=="1000", MODE="0660", """
        """GROUP="plugdev", TAG+="uaccess"' | sudo tee -a /etc/udev/rules.d/70-dbthermal.rules"""
    ) in found[1].warnings[0]


@pytest.mark.parametrize("kind", [boson, apt, tc08])
def test_permission_where_no_port_is_listed(
    kind: Callable[..., emulated.EmulatedDevice],
) -> None:
    """A device without permission and serial number gets the udev rule, with or without nodes."""
    device = kind(fault="permission")
    found = find_bare(EmulatedBackend(device))[0]
    assert f'ATTR{{idVendor}}=="{device.vendor:04x}"' in found.warnings[0]


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("unplugged", "was unplugged while"),
        ("timeout", "does not answer"),
        ("damaged", "serial number is damaged"),
        ("mute", "has no strings"),
        ("unsupported", "libusb has no driver"),
    ],
)
def test_device_that_does_not_tell_its_number(fault: emulated.Fault, message: str) -> None:
    """A failure to read a serial number is a warning, and the other devices are listed."""
    backend = EmulatedBackend(tc08(fault=fault), tc08(ports=(5,)))
    found = find_bare(backend)
    assert message in found[0].warnings[0]
    assert (found[0].serial, found[1].serial, found[1].warnings) == (None, "EMULATED", ())


def test_device_without_a_number(tmp_path: Path) -> None:
    """A device without a serial number is listed without a warning."""
    found = look(tmp_path, tc08(serial="", fault="permission"))
    assert (found[0].serial, found[0].warnings) == (None, ())
    assert "without serial number" in inventory.describe(found)


def test_camera_at_full_speed(tmp_path: Path) -> None:
    """A camera on a bad cable runs at full speed, and the rates are given."""
    found = look(tmp_path, boson(speed=2), frame_rate=60.0)
    assert (
        found[0]
        .warnings[0]
        .startswith(
            "It runs at full speed, and 60 frames/s take 314.6 Mbit/s. Must be at high speed"
        )
    )


def test_rates() -> None:
    """A high-speed bus carries 426 Mbit/s."""
    assert abs(inventory.HIGH_SPEED_PAYLOAD - 425.98e6) < 0.01e6


def test_two_cameras_on_one_bus(tmp_path: Path) -> None:
    """Two cameras at 60 Hz exceed the bus, and each has a warning with the rates."""
    found = look(tmp_path, boson(1, ports=(1, 1)), boson(2, ports=(1, 2)), frame_rate=60.0)
    assert " and ".join(found[0].warnings) == (
        "It shares bus 1 and the root port with EMULATED2: 629.1 Mbit/s at 60 frames/s, of 426.0 "
        "Mbit/s at most. Use ports of two controllers, or 30 frames/s: 314.6 Mbit/s."
    )
    assert "with EMULATED1" in found[1].warnings[0]


def test_two_cameras_that_fit(tmp_path: Path) -> None:
    """At 30 Hz two cameras share a bus, at 60 Hz they have one each; neither is warned of."""
    found = look(tmp_path / "slow", boson(1), boson(2), frame_rate=30.0)
    found += look(tmp_path / "apart", boson(1), boson(2, bus=2), frame_rate=60.0)
    assert {device.warnings for device in found} == {()}


def test_two_root_ports(tmp_path: Path) -> None:
    """Two root ports of one bus give a warning that they may share its rate."""
    found = look(tmp_path, boson(1), boson(2), frame_rate=60.0)
    assert "though not the root port (ask the controller)" in found[0].warnings[0]


def test_node_that_may_not_be_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nodes without permission name their group and the command, once for all of a group."""
    dev = denied_nodes(tmp_path, monkeypatch, 0o660, group=44, own={1000})
    found = look(tmp_path, boson())[0]
    assert len(found.warnings) == 1
    nodes = ", ".join(str(dev / name) for name in ("video0", "video1", "ttyACM0"))
    assert found.warnings[0].startswith(f"No permission for {nodes}. Must be in its group 'video'")


@pytest.mark.parametrize(("mode", "group"), [(0o600, 44), (0o660, 0)])
def test_node_that_only_root_may_use(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: int, group: int
) -> None:
    """A node of the group root, or without group access, gets the udev rule as advice."""
    denied_nodes(tmp_path, monkeypatch, mode, group=group, own={1000})
    warnings = look(tmp_path, boson())[0].warnings
    assert ["video4linux" in warning for warning in warnings] == [True, False]
    assert 'SUBSYSTEM=="tty", ATTRS{idVendor}=="09cb"' in warnings[1]
    assert not any("usermod" in warning for warning in warnings)


def test_node_of_the_own_group(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A user who is in the node's group is not advised to join it."""
    denied_nodes(tmp_path, monkeypatch, 0o660, group=44, own={44})
    assert "Its group 'video' is yours, yet" in look(tmp_path, boson())[0].warnings[0]


def test_node_of_a_group_without_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A group without a name is given by its number."""
    denied_nodes(tmp_path, monkeypatch, 0o660, group=4321, own={1000})
    assert "in its group '4321'" in look(tmp_path, boson())[0].warnings[0]


def test_system_without_sysfs() -> None:
    """Without sysfs the devices are listed, and their nodes are reported as unknown."""
    (found,) = find_bare(EmulatedBackend(boson()))
    assert found.warnings == ("Its nodes are not known: there is no /nowhere.",)


def test_ports_of_this_machine() -> None:
    """Serial ports of this machine are not listed for a device on an emulated bus."""
    (found,) = inventory.find(EmulatedBackend(apt(bus=99)))
    assert found.serial_nodes == ()


def test_missing_libusb(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without libusb the error says what to install."""
    for module in (usb.backend.libusb1, usb.backend.libusb0, usb.backend.openusb):
        monkeypatch.setattr(module, "get_backend", lambda: None)
    with pytest.raises(inventory.LibusbMissingError, match=r"No libusb found\. Must be installed"):
        inventory.find()


def test_description(tmp_path: Path) -> None:
    """The description names each device and puts warnings below it."""
    lines = inventory.describe(look(tmp_path, boson(speed=2), tc08())).splitlines()
    nodes = " ".join(str(tmp_path / "dev" / name) for name in ("video0", "video1", "ttyACM0"))
    assert lines[0] == f"FLIR Boson EMULATED1: 1-1, full speed, {nodes}"
    assert lines[1].startswith("  ! It runs at full speed")
    assert lines[2].startswith("Thorlabs APT controller: not found")
    assert lines[3] == "Pico TC-08 EMULATED: 1-4, full speed, no nodes"


@pytest.mark.parametrize("order", ["set_configuration", "reset", "detach_kernel_driver"])
def test_emulated_bus_refuses_what_disturbs(order: str) -> None:
    """The emulated bus raises an error for any request that would disturb a live device."""
    device = next(usb.core.find(find_all=True, backend=EmulatedBackend(boson())))
    with pytest.raises(AssertionError, match=r"on a live device\. Must only be looked at"):
        getattr(device, order)(*([0] if order.startswith("detach") else []))


@given(st.binary(max_size=80))
def test_any_string_descriptor(answer: bytes) -> None:
    """Any bytes of a serial number give text or a warning, never an exception."""
    backend = EmulatedBackend(tc08())
    backend.answer = lambda *_: answer
    found = find_bare(backend)[0]
    assert isinstance(found.serial, str) or found.warnings
