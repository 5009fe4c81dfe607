"""What to do where Linux does not let the user open a device: udev rules, groups.

The texts name what to type. Nothing is changed here, and nothing asks for more than it needs: who
may not open a camera's nodes is not told to join the group root.
"""

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Final

RULES: Final = "/etc/udev/rules.d/70-dbthermal.rules"
"""Where the rules go; before 73, or ``uaccess`` is too late."""

GROUP: Final = "plugdev"
"""Group that the rules give the devices to; where there is none, ``uaccess`` alone counts."""

_SUBSYSTEMS: Final = {"video": "video4linux", "tty": "tty"}
_SHARED: Final = 0o060  # read and write for the group


def udev_rule(vendor: int, product: int, subsystem: str = "usb") -> str:
    """
    Rule that lets the user at the machine, and the group plugdev, open a device.

    Parameters
    ----------
    vendor, product : int
        The device's USB identity.
    subsystem : str
        ``"usb"`` for the device itself, ``"tty"`` or ``"video4linux"`` for its nodes.

    Returns
    -------
    str
        One line.
    """
    matched = "ATTR" if subsystem == "usb" else "ATTRS"  # of itself, or of one that it hangs below
    return (
        f'SUBSYSTEM=="{subsystem}", {matched}{{idVendor}}=="{vendor:04x}", '
        f'{matched}{{idProduct}}=="{product:04x}", MODE="0660", GROUP="{GROUP}", TAG+="uaccess"'
    )


def denied_device(vendor: int, product: int) -> str:
    """
    Say what to do about a device that may not be opened on the bus.

    Parameters
    ----------
    vendor, product : int
        Its USB identity.

    Returns
    -------
    str
        With the line to type.
    """
    return f"No permission to open it. {_install(udev_rule(vendor, product))}"


def denied_nodes(nodes: Iterable[str], vendor: int, product: int) -> list[str]:
    """
    Say what to do about nodes that may not be read and written.

    Parameters
    ----------
    nodes : iterable of str
        ``/dev/video0``; those that are not there are passed over.
    vendor, product : int
        USB identity of the device that they belong to.

    Returns
    -------
    list of str
        One for each group that is to be joined, or rule that is to be written; empty if all is
        well.
    """
    advice: dict[str, list[str]] = {}
    for node in (Path(node) for node in nodes):
        if node.exists() and not os.access(node, os.R_OK | os.W_OK):
            advice.setdefault(_advice(node, vendor, product), []).append(str(node))
    return [f"No permission for {', '.join(names)}. {text}" for text, names in advice.items()]


def _advice(node: Path, vendor: int, product: int) -> str:
    """Group to join, where that helps; else the rule that gives the node to one."""
    about = _stat(node)
    try:
        group = node.group()
    except KeyError:  # it has no name on this system
        group = str(about.st_gid)
    if about.st_mode & _SHARED != _SHARED or about.st_gid == 0:
        family = node.name.rstrip("0123456789")
        return _install(udev_rule(vendor, product, _SUBSYSTEMS.get(family, "tty")))
    if about.st_gid in os.getgroups():
        return f"Its group '{group}' is yours, yet it is kept from you: are devices passed on here?"
    return (
        f"Must be in its group '{group}': run 'sudo usermod -aG {group} $USER', log in again, and "
        "start the notebook server anew."
    )


def _stat(node: Path) -> os.stat_result:
    return node.stat()


def _install(rule: str) -> str:
    return (
        f"Type this, and plug it in again: echo '{rule}' | sudo tee -a {RULES} "
        "&& sudo udevadm control --reload"
    )
