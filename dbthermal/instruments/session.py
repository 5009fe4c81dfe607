"""A session: what is recorded, with which devices, described in one YAML file.

One key, ``simulated``, switches the whole rig; every device has an address for either case::

    name: coffee_pot
    simulated: true
    protocol: scene            # gain_offset, response, emissivity_bench or scene
    duration: 60               # s
    frame_rate: 60             # Hz
    shape: [512, 640]          # rows, columns
    telemetry_rows: 2
    cameras:
      "8-14":
        video: {simulated: "sim://camera/wide", hardware: "v4l2:///dev/video0"}
        control: {simulated: "sim://boson/wide", hardware: "serial:///dev/ttyACM0"}
      "9.5":
        video: {simulated: "sim://camera/narrow", hardware: "v4l2:///dev/video2"}
    devices:                   # whatever else there is
      filter_wheel: {simulated: "sim://apt/wheel", hardware: "serial:///dev/ttyUSB0"}
    filters: {1: "9.5", 2: "11"}
    thermocouples: {1: plate, 2: room}
    blackbody: {temperatures: [293.15, 303.15], stability: 0.02, window: 30, timeout: 1800}

Temperatures are in kelvin, times in seconds. A key that is not known is an error.
"""

from collections.abc import Mapping
from dataclasses import MISSING, asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Final, Self

import yaml

PROTOCOLS: Final = ("gain_offset", "response", "emissivity_bench", "scene")
"""What a session is for; all but `scene` go through the blackbody's temperatures."""


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
    timeout : float
        How long to wait for it [s].
    """

    temperatures: tuple[float, ...]
    stability: float = 0.05
    window: float = 30.0
    timeout: float = 1800.0

    def __post_init__(self) -> None:
        wrong = [value for value in self.temperatures if not 0 < value < float("inf")]
        if wrong or not self.temperatures:
            raise ValueError(
                f"Invalid blackbody temperatures {list(self.temperatures)} K. Must be positive."
            )
        for name in ("stability", "window", "timeout"):
            _check_positive(name, getattr(self, name))


@dataclass(frozen=True)
class Session:
    """
    What is recorded, and with what.

    Attributes
    ----------
    name : str
        Of the session.
    simulated : bool
        Whether the rig is emulated: one switch for all devices.
    protocol : str
        One of `PROTOCOLS`.
    duration : float
        Of the recording, or of each of its steps [s].
    cameras : mapping
        Band to `Camera`; the order of the bands is that of the recording.
    frame_rate : float
        [Hz].
    shape : tuple of int
        Rows and columns [pixel].
    telemetry_rows : int
        Rows of telemetry besides.
    devices : mapping
        Name to `Device`: wheel, thermocouples.
    filters : mapping
        Slot of the wheel to band.
    thermocouples : mapping
        Channel to what it measures.
    blackbody : Blackbody or None
        Steps of a calibration.
    """

    name: str
    simulated: bool
    protocol: str
    duration: float
    cameras: Mapping[str, Camera]
    frame_rate: float = 60.0
    shape: tuple[int, int] = (512, 640)
    telemetry_rows: int = 0
    devices: Mapping[str, Device] = field(default_factory=dict)
    filters: Mapping[int, str] = field(default_factory=dict)
    thermocouples: Mapping[int, str] = field(default_factory=dict)
    blackbody: Blackbody | None = None

    def __post_init__(self) -> None:
        if self.protocol not in PROTOCOLS:
            raise ValueError(
                f"Unknown protocol '{self.protocol}'. Must be one of {list(PROTOCOLS)}."
            )
        if not isinstance(self.simulated, bool):
            raise TypeError(f"Invalid simulated {self.simulated!r}. Must be true or false.")
        if not self.cameras:
            raise ValueError(f"Invalid session '{self.name}' without cameras. Must have one.")
        _check_positive("duration", self.duration)
        _check_positive("frame_rate", self.frame_rate)
        if (self.protocol == "scene") != (self.blackbody is None):
            rule = "no blackbody" if self.protocol == "scene" else "a blackbody"
            raise ValueError(f"Invalid session of protocol '{self.protocol}'. Must have {rule}.")

    @property
    def bands(self) -> tuple[str, ...]:
        """Names of the bands."""
        return tuple(self.cameras)

    def url(self, device: Device) -> str:
        """
        Address of a device in this session.

        Parameters
        ----------
        device : Device
            One of its devices.

        Returns
        -------
        str
            The simulated one, or the hardware's.
        """
        return device.simulated if self.simulated else device.hardware

    def content(self) -> dict[str, Any]:
        """
        What the session says, for the record of a recording.

        Returns
        -------
        dict
            JSON; keys that are numbers become text.
        """
        return asdict(self)

    @classmethod
    def from_yaml(cls, text: str) -> Self:
        """
        Read a session.

        Parameters
        ----------
        text : str
            YAML; see the module.

        Returns
        -------
        Session
            Checked.

        Raises
        ------
        ValueError
            If it is no YAML, a key is missing or unknown, or a value is invalid.
        TypeError
            If a value is of another type.
        """
        try:
            content = yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise ValueError(f"Invalid session. Must be YAML: {error}.") from error
        values = _known(content, cls, "session")
        values["cameras"] = {
            str(band): _camera(camera, f"camera '{band}'")
            for band, camera in _mapping(values["cameras"], "cameras").items()
        }
        values["devices"] = {
            str(name): Device(**_known(device, Device, f"device '{name}'"))
            for name, device in _mapping(values.get("devices", {}), "devices").items()
        }
        if "shape" in values:
            values["shape"] = tuple(values["shape"])
        if values.get("blackbody") is not None:
            steps = _known(values["blackbody"], Blackbody, "blackbody")
            values["blackbody"] = Blackbody(
                **{**steps, "temperatures": tuple(steps["temperatures"])}
            )
        return cls(**values)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """
        Read a session from a file.

        Parameters
        ----------
        path : str or Path
            YAML; see the module.

        Returns
        -------
        Session
            Checked.

        Raises
        ------
        FileNotFoundError
            If there is no such file.
        TypeError, ValueError
            As `from_yaml`.
        """
        return cls.from_yaml(Path(path).read_text(encoding="utf-8"))


def _camera(content: Any, what: str) -> Camera:
    values = _known(content, Camera, what)
    return Camera(
        **{
            name: Device(**_known(device, Device, f"{name} of {what}"))
            for name, device in values.items()
        }
    )


def _mapping(content: Any, what: str) -> dict[Any, Any]:
    if not isinstance(content, dict):
        raise TypeError(f"Invalid {what} {content!r}. Must be a mapping.")
    return content


def _known(content: Any, kind: type[Any], what: str) -> dict[str, Any]:
    """Return the keys of a record, none of them unknown, none that it needs missing."""
    values = _mapping(content, what)
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


def _check_positive(name: str, value: Any) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError(f"Invalid {name} {value!r}. Must be a number.")
    if not 0 < value < float("inf"):
        raise ValueError(f"Invalid {name} {value}. Must be positive.")
