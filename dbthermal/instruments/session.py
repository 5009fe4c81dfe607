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
      thermocouples: {simulated: "sim://tc08", hardware: "tc08:"}
    filters: {1: "9.5", 2: "11"}
    wheel: {home_offset: 12.5} # settings of this wheel, if it has any
    sweep: ["9.5", "11"]       # filters that the wheel goes through at each temperature
    thermocouples: {1: blackbody, 2: plate}
    blackbody: {temperatures: [293.15, 303.15], stability: 0.02, window: 30, timeout: 1800}

Temperatures are in kelvin, times in seconds. A key that is not known is an error. The camera whose
band is one of the filters is the one behind the wheel.
"""

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final, Self

from dbthermal.instruments.entries import (
    Blackbody,
    Camera,
    Device,
    check_one_of,
    check_positive,
    check_unique,
    known,
    mapping,
    read_yaml,
)

__all__ = ["CHANNELS", "DEVICES", "PROTOCOLS", "SLOTS", "Blackbody", "Camera", "Device", "Session"]

PROTOCOLS: Final = ("gain_offset", "response", "emissivity_bench", "scene")
"""What a session is for; all but `scene` go through the blackbody's temperatures."""

DEVICES: Final = ("filter_wheel", "thermocouples")
"""What there may be beside the cameras."""

CHANNELS: Final = range(1, 9)
"""Channels of the thermocouple logger."""

SLOTS: Final = range(1, 7)
"""Slots of the filter wheel."""

TELEMETRY_ROWS: Final = (0, 2)
"""Rows of telemetry that a camera may give over USB."""

_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


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
        Name, of `DEVICES`, to `Device`.
    filters : mapping
        Slot of the wheel to band.
    wheel : mapping
        What differs from `dbthermal.instruments.filterwheel.Settings` in this wheel.
    sweep : tuple of str
        Filters that the wheel goes through at each temperature; see `swept`.
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
    wheel: Mapping[str, Any] = field(default_factory=dict)
    sweep: tuple[str, ...] = ()
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
        for name in (self.name, *self.bands, *self.filters.values()):
            if not _NAME.fullmatch(name):
                raise ValueError(
                    f"Invalid name '{name}'. Must be fit for a file: '{_NAME.pattern}'."
                )
        check_positive("duration", self.duration)
        check_positive("frame_rate", self.frame_rate)
        if (self.protocol == "scene") != (self.blackbody is None):
            rule = "no blackbody" if self.protocol == "scene" else "a blackbody"
            raise ValueError(f"Invalid session of protocol '{self.protocol}'. Must have {rule}.")
        if self.blackbody is not None and self.protocol != "emissivity_bench":
            check_unique("temperature [K]", self.blackbody.temperatures)
        check_one_of("telemetry_rows", [self.telemetry_rows], TELEMETRY_ROWS)
        check_one_of("device", self.devices, DEVICES)
        self._check_thermocouples()
        self._check_wheel()

    def _check_thermocouples(self) -> None:
        names = [*self.thermocouples.values(), *DEVICES]
        check_one_of("channel of a thermocouple", self.thermocouples, CHANNELS)
        for band in dict.fromkeys((*self.bands, *self.filters.values())):
            names += [band, f"fpa {band}", f"ffc {band}"]  # what a recording knows besides
        check_unique("thermocouple", names)
        self._require("thermocouples", self.thermocouples)

    def _check_wheel(self) -> None:
        check_one_of("slot of a filter", self.filters, SLOTS)
        check_unique("filter", self.filters.values())
        self._require("filter_wheel", self.filters)
        behind = [band for band in self.bands if band in self.filters.values()]
        if self.filters and len(behind) != 1:
            raise ValueError(f"Invalid cameras {behind} behind the wheel. Must be exactly one.")
        check_one_of("filter of the sweep", self.sweep, tuple(self.filters.values()))
        check_unique("filter of the sweep", self.sweep)
        if self.sweep and self.blackbody is None:
            raise ValueError(f"Invalid sweep {list(self.sweep)}. Must have a blackbody.")

    def _require(self, device: str, entries: Mapping[int, str]) -> None:
        if entries and device not in self.devices:
            raise ValueError(f"Missing device '{device}' of {dict(entries)}. Must be given.")

    @property
    def bands(self) -> tuple[str, ...]:
        """Names of the bands."""
        return tuple(self.cameras)

    @property
    def filtered(self) -> str | None:
        """Band of the camera behind the wheel; None without a wheel."""
        behind = (band for band in self.cameras if band in self.filters.values())
        return next(behind, None)

    @property
    def swept(self) -> tuple[str, ...]:
        """Filters that are recorded at each temperature: `sweep`, or the camera's own."""
        return self.sweep or (() if self.filtered is None else (self.filtered,))

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
        return cls._of(read_yaml(text, "session"))

    @classmethod
    def load(cls, path: str | Path, changes: Mapping[str, Any] | None = None) -> Self:
        """
        Read a session from a file, and the file that it names as its ``rig``.

        Parameters
        ----------
        path : str or Path
            YAML; see the module. What several sessions share, such as the addresses, may stand in a
            file of its own, whose name is the key ``rig``, relative to this one.
        changes : mapping, optional
            Values in place of those in the files, by key; of ``blackbody``, key by key.

        Returns
        -------
        Session
            Checked.

        Raises
        ------
        FileNotFoundError
            If there is no such file.
        TypeError, ValueError
            As `from_yaml`, or if a key is in both files.
        """
        own = read_yaml(Path(path).read_text(encoding="utf-8"), "session")
        if "rig" in own:
            place = Path(path).parent / str(own.pop("rig"))
            shared = read_yaml(place.read_text(encoding="utf-8"), "rig")
            check_unique("key of session and rig", [*map(str, own), *map(str, shared)])
            own = {**shared, **own}
        changed = {**own, **(changes or {})}
        if changes and "blackbody" in changes and "blackbody" in own:
            changed["blackbody"] = {**own["blackbody"], **changes["blackbody"]}
        return cls._of(changed)

    @classmethod
    def _of(cls, content: Mapping[Any, Any]) -> Self:
        values = known(content, cls, "session")
        values["cameras"] = {
            str(band): _camera(camera, f"camera '{band}'")
            for band, camera in mapping(values["cameras"], "cameras").items()
        }
        values["devices"] = {
            str(name): Device(**known(device, Device, f"device '{name}'"))
            for name, device in mapping(values.get("devices", {}), "devices").items()
        }
        if "shape" in values:
            values["shape"] = tuple(values["shape"])
        values["sweep"] = tuple(str(band) for band in values.get("sweep", ()))
        for name in ("filters", "thermocouples"):
            content = mapping(values.get(name, {}), name)
            values[name] = {number: str(text) for number, text in content.items()}
        if values.get("blackbody") is not None:
            steps = known(values["blackbody"], Blackbody, "blackbody")
            values["blackbody"] = Blackbody(
                **{**steps, "temperatures": tuple(steps["temperatures"])}
            )
        return cls(**values)


def _camera(content: Any, what: str) -> Camera:
    values = known(content, Camera, what)
    return Camera(
        **{
            name: Device(**known(device, Device, f"{name} of {what}"))
            for name, device in values.items()
        }
    )
