"""Addresses of devices: one rule for each scheme, which sessions and drivers share.

An address never names a program or a library: that of the TC-08 is told by an environment variable.
"""

import re
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Final, NamedTuple

from dbthermal import _text as texts

_NODE = r"/dev/(?!\S*\.\.)[^\s?#\\]+"
_WORD = r"[A-Za-z0-9][A-Za-z0-9._-]*"
_OPTION = r"[a-z]+=[^\s=&?#]+"

RULES: Final[Mapping[str, tuple[str, str]]] = MappingProxyType(
    {
        "v4l2": ("v4l2:///dev/<node>", f"v4l2://(?P<target>{_NODE})"),
        "serial": ("serial:///dev/<port>", f"serial://(?P<target>{_NODE}|COM[0-9]+)"),
        "pty": ("pty:///dev/<terminal>", f"pty://(?P<target>{_NODE})"),
        "tc08": ("tc08:", "tc08:(?P<target>)"),
        "sim": (
            "sim://<emulator>/<name>?<option>=<value>",
            rf"sim://(?P<target>[a-z0-9]+)(/(?P<name>{_WORD}))?(\?(?P<options>{_OPTION}(&{_OPTION})*))?",
        ),
    }
)
"""Form of the addresses of each scheme, and its regular expression."""

_LONGEST: Final = 200  # [character]

# Schemes of a device's simulated address, and of that of the hardware.
_SCHEMES: Final[Mapping[str, tuple[tuple[str, ...], str]]] = {
    "video": (("sim",), "v4l2"),
    "control": (("sim", "pty"), "serial"),
    "filter_wheel": (("sim", "pty"), "serial"),
    "thermocouples": (("sim",), "tc08"),
}


class Address(NamedTuple):
    """Parts of an address: `target` is the device's file, or the kind of emulator."""

    scheme: str
    target: str
    name: str = ""
    options: Mapping[str, str] = MappingProxyType({})


def parse(url: str, schemes: Iterable[str] = tuple(RULES)) -> Address:
    """Parts of an address of one of the schemes; ValueError names it and their forms."""
    schemes = tuple(schemes)
    scheme = url.partition(":")[0]
    found = re.fullmatch(RULES[scheme][1], url) if scheme in schemes else None
    if found is None or len(url) > _LONGEST:
        forms = " or ".join(RULES[name][0] for name in schemes)
        raise ValueError(f"Invalid address {texts.shown(url)}. Must be {forms}.")
    parts = {name: text or "" for name, text in found.groupdict().items()}
    pairs = [pair.split("=") for pair in parts.get("options", "").split("&") if pair]
    named = ["name"] if parts.get("name") else []
    for option in texts.repeated([*named, *(option for option, _ in pairs)]):
        raise ValueError(f"Repeated option '{option}' in address '{url}'. Must be listed once.")
    return Address(scheme, parts["target"], parts.get("name", ""), dict(pairs))


def check_schemes(name: str, simulated: str, hardware: str) -> None:
    """ValueError unless a device's addresses are of its schemes, by the name of its use."""
    allowed, real = _SCHEMES[name]
    url = parse(simulated, allowed)
    parse(hardware, (real,))
    emulator = {"filter_wheel": "apt", "thermocouples": "tc08"}.get(name, url.target)
    if url.scheme == "sim" and (url.target != emulator or (emulator == "tc08" and url.name)):
        raise ValueError(f"Invalid address '{simulated}' of {name}. Must be sim://{emulator}")
