"""Entries of a session: addresses, steps of the blackbody, and the checks that all entries pass."""

from collections.abc import Collection, Iterable
from dataclasses import MISSING, dataclass, fields
from typing import Any

import yaml


@dataclass(frozen=True)
class Device:
    """
    Addresses of one device.

    Attributes
    ----------
    simulated, hardware : str
        Such as ``"sim://boson/wide"`` and ``"serial:///dev/ttyACM0"``.
    """

    simulated: str
    hardware: str

    def __post_init__(self) -> None:
        for name, is_simulated in (("simulated", True), ("hardware", False)):
            address = getattr(self, name)
            if address.startswith(("sim:", "pty:")) != is_simulated:
                rule = "begin" if is_simulated else "not begin"
                raise ValueError(
                    f"Invalid {name} address '{address}'. Must {rule} with sim: or pty:."
                )


@dataclass(frozen=True)
class Camera:
    """
    One camera.

    Attributes
    ----------
    video : Device
        Where its frames come from.
    control : Device or None
        Where its commands go.
    """

    video: Device
    control: Device | None = None


@dataclass(frozen=True)
class Blackbody:
    """
    The steps of a calibration, and when one is taken to be reached.

    Attributes
    ----------
    temperatures : tuple of float
        In the order of the session [K].
    stability : float
        Largest range of the readings in the window [K].
    window : float
        How long the readings must stay within it [s].
    tolerance : float
        Largest distance of their mean from where it was set [K]; a thermocouple, and its logger,
        are off by half a kelvin or so each, and the recordings keep what was read.
    timeout : float
        How long to wait for it [s].
    """

    temperatures: tuple[float, ...]
    stability: float = 0.05
    window: float = 30.0
    tolerance: float = 1.5
    timeout: float = 1800.0

    def __post_init__(self) -> None:
        wrong = [value for value in self.temperatures if not 0 < value < float("inf")]
        if wrong or not self.temperatures:
            raise ValueError(
                f"Invalid blackbody temperatures {list(self.temperatures)} K. Must be positive."
            )
        for name in ("stability", "window", "tolerance", "timeout"):
            check_positive(name, getattr(self, name))


def read_yaml(text: str, what: str) -> dict[Any, Any]:
    """
    Read a description.

    Parameters
    ----------
    text : str
        YAML.
    what : str
        What it describes, for the error.

    Returns
    -------
    dict
        Its keys.

    Raises
    ------
    ValueError
        If it is no YAML.
    TypeError
        If it is no mapping.
    """
    try:
        content = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ValueError(f"Invalid {what}. Must be YAML: {error}.") from error
    return mapping(content, what)


def mapping(content: Any, what: str) -> dict[Any, Any]:
    """Return what is a mapping; TypeError if it is none."""
    if not isinstance(content, dict):
        raise TypeError(f"Invalid {what} {content!r}. Must be a mapping.")
    return content


def known(content: Any, kind: type[Any], what: str) -> dict[str, Any]:
    """Return the keys of a record; ValueError if one is unknown, or one that it needs missing."""
    values = mapping(content, what)
    names = {part.name for part in fields(kind)}
    unknown = sorted(str(name) for name in values.keys() - names)
    if unknown:
        raise ValueError(f"Unknown '{unknown[0]}' in the {what}. Must be of {sorted(names)}.")
    needed = [
        part.name
        for part in fields(kind)
        if part.default is MISSING and part.default_factory is MISSING
    ]
    missing = [name for name in needed if name not in values]
    if missing:
        raise ValueError(f"Missing '{missing[0]}' in the {what}. Must be given.")
    return dict(values)


def check_one_of(name: str, values: Iterable[Any], allowed: Collection[Any]) -> None:
    """Raise ValueError if one of the values is not allowed."""
    for value in values:
        if isinstance(value, bool) or value not in allowed:
            raise ValueError(f"Invalid {name} {value!r}. Must be one of {list(allowed)}.")


def check_unique(name: str, values: Iterable[Any]) -> None:
    """Raise ValueError if a value is there twice."""
    names = list(values)
    for value in names:
        if names.count(value) > 1:
            raise ValueError(f"Repeated {name} '{value}'. Must be there once.")


def check_positive(name: str, value: Any) -> None:
    """Raise TypeError if it is no number, ValueError if it is not positive and finite."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError(f"Invalid {name} {value!r}. Must be a number.")
    if not 0 < value < float("inf"):
        raise ValueError(f"Invalid {name} {value}. Must be positive.")
