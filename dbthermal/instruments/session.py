"""A recording session: cameras, wheel, thermocouples and procedure, described in one YAML file.

One key, ``simulated``, switches the whole rig; every device has an address for either case::

    name: plate
    simulated: true
    protocol: emissivity_bench # or gain_offset, response; or scene, without sweep and blackbody
    duration: 2                # of each recording, s
    frame_rate: 60             # Hz
    shape: [512, 640]          # rows, columns
    telemetry_rows: 2
    cameras:
      "8-14":
        video: {simulated: "sim://boson/wide", hardware: "v4l2:///dev/video0"}
        control: {simulated: "sim://boson/wide", hardware: "serial:///dev/ttyACM0"}
      "9.5":
        kind: boson            # of dbthermal.instruments.camera.KINDS; boson by default
        video: {simulated: "sim://boson/narrow", hardware: "v4l2:///dev/video2"}
    devices:                   # whatever else is connected
      filter_wheel: {simulated: "sim://apt/wheel", hardware: "serial:///dev/ttyUSB0"}
      thermocouples: {simulated: "sim://tc08", hardware: "tc08:"}
    filters: {1: "9.5", 2: "11"}
    wheel: {home_offset: 12.5} # settings of this wheel, if it has any
    sweep: ["9.5", "11"]       # filters that the wheel goes through at each temperature
    thermocouples: {1: blackbody, 2: plate}
    blackbody: {temperatures: [293.15, 303.15], stability: 0.02, window: 30, timeout: 1800}

Temperatures are in kelvin, times in seconds. A key that is not known is an error. The camera whose
band is one of the filters is the one behind the wheel. The simulated address of its frames names
the camera's kind.
"""

import errno
import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

import yaml
from pydantic import (
    ConfigDict,
    Field,
    StrictBool,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic.dataclasses import dataclass

from dbthermal.instruments.camera import FFC_READING, FPA_READING, KINDS

__all__ = ["Blackbody", "Camera", "Device", "Session"]


def __dir__() -> list[str]:
    return __all__


_CHECKED: Final = ConfigDict(extra="forbid", coerce_numbers_to_str=True)

Positive = Annotated[float, Field(strict=True, gt=0, allow_inf_nan=False)]
Count = Annotated[int, Field(strict=True, gt=0)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]
Slot = Annotated[int, Field(strict=True, ge=1, le=6)]
Channel = Annotated[int, Field(strict=True, ge=1, le=8)]
DeviceName = Literal["filter_wheel", "thermocouples"]


@dataclass(frozen=True, config=_CHECKED)
class Device:
    """Addresses of one device, such as ``"sim://boson/wide"`` and ``"serial:///dev/ttyACM0"``."""

    simulated: str
    hardware: str

    @field_validator("simulated", "hardware")
    @classmethod
    def _check_kind(cls, address: str, info: ValidationInfo) -> str:
        is_simulated = info.field_name == "simulated"
        if address.startswith(("sim:", "pty:")) != is_simulated:
            rule = "begin" if is_simulated else "not begin"
            raise ValueError(f"Must {rule} with sim: or pty:")
        return address


@dataclass(frozen=True, config=_CHECKED)
class Camera:
    """One camera: addresses of its frames and of its command port, if any, and its kind."""

    video: Device
    control: Device | None = None
    # One of `dbthermal.instruments.camera.KINDS`, and that of its simulated address.
    kind: Annotated[str, Field(validate_default=True)] = "boson"

    @field_validator("kind")
    @classmethod
    def _check_kind(cls, kind: str, info: ValidationInfo) -> str:
        if kind not in KINDS:
            raise ValueError(f"Must be one of {sorted(KINDS)}")
        video: Device | None = info.data.get("video")
        if video is not None and not video.simulated.startswith(f"sim://{kind}/"):
            raise ValueError(
                f"Must be the kind in its simulated address '{video.simulated}': that of a {kind} "
                f"is sim://{kind}/<name>"
            )
        return kind


@dataclass(frozen=True, config=_CHECKED)
class Blackbody:
    """Temperatures of a calibration, and the rule by which each counts as reached."""

    temperatures: Annotated[tuple[Positive, ...], Field(min_length=1)]  # in their order [K]
    stability: Positive = 0.05  # largest range of the readings in the window [K]
    window: Positive = 30.0  # how long the readings must stay within it [s]
    # Largest distance of their mean from the set point [K]: a thermocouple and its logger are off
    # by half a kelvin or so each, and the recordings keep the reading.
    tolerance: Positive = 1.5
    timeout: Positive = 1800.0  # longest wait for it [s]


@dataclass(frozen=True, config=_CHECKED)
class Session:
    """
    Description of a recording: devices, procedure and duration; see the module.

    All protocols but ``scene`` go through the blackbody's temperatures. Invalid values raise
    pydantic's ValidationError, a ValueError.

    Examples
    --------
    >>> video = Device("sim://boson/wide", "v4l2:///dev/video0")
    >>> Session("pot", True, "scene", 60.0, {"8-14": Camera(video)}).bands
    ('8-14',)
    """

    name: Name  # of the recordings, too
    simulated: StrictBool  # one switch for all devices
    protocol: Literal["gain_offset", "response", "emissivity_bench", "scene"]
    duration: Positive  # of the recording, or of each of its steps [s]
    cameras: Annotated[dict[Name, Camera], Field(min_length=1)]  # by band, in recording order
    frame_rate: Positive = 60.0  # [Hz]
    shape: tuple[Count, Count] = (512, 640)  # rows, columns
    telemetry_rows: Literal[0, 2] = 0
    devices: dict[DeviceName, Device] = field(default_factory=dict)
    filters: dict[Slot, Name] = field(default_factory=dict)  # slot of the wheel to band
    wheel: dict[str, Any] = field(default_factory=dict)  # see `filterwheel.Settings`
    sweep: tuple[Name, ...] = ()  # filters at each temperature; see `swept`
    thermocouples: dict[Channel, str] = field(default_factory=dict)  # channel to measured object
    blackbody: Blackbody | None = None

    @model_validator(mode="after")
    def _check_protocol(self) -> Self:
        if (self.protocol == "scene") != (self.blackbody is None):
            rule = "no blackbody" if self.protocol == "scene" else "a blackbody"
            raise ValueError(f"Invalid session of protocol '{self.protocol}'. Must have {rule}")
        if self.blackbody is not None and self.protocol != "emissivity_bench":
            _check_unique("temperature [K]", self.blackbody.temperatures)
        return self

    @model_validator(mode="after")
    def _check_thermocouples(self) -> Self:
        # The readings of a recording have one name each: of the cameras and the wheel, too.
        names = [*self.thermocouples.values(), "filter_wheel", "thermocouples"]
        for band in dict.fromkeys((*self.bands, *self.filters.values())):
            names += [band, FPA_READING + band, FFC_READING + band]
        _check_unique("thermocouple", names)
        self._require("thermocouples", self.thermocouples)
        return self

    @model_validator(mode="after")
    def _check_wheel(self) -> Self:
        _check_unique("filter", self.filters.values())
        self._require("filter_wheel", self.filters)
        behind = [band for band in self.bands if band in self.filters.values()]
        if self.filters and len(behind) != 1:
            raise ValueError(f"Invalid cameras {behind} behind the wheel. Must be exactly one")
        check_one_of("filter of the sweep", self.sweep, tuple(self.filters.values()))
        _check_unique("filter of the sweep", self.sweep)
        if self.sweep and self.blackbody is None:
            raise ValueError(f"Invalid sweep {list(self.sweep)}. Must have a blackbody")
        return self

    def _require(self, device: DeviceName, entries: Mapping[int, str]) -> None:
        if entries and device not in self.devices:
            raise ValueError(f"Missing device '{device}' of {dict(entries)}. Must be listed")

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
        """Filters that are recorded at each temperature: `sweep`, or the one of the camera."""
        return self.sweep or (() if self.filtered is None else (self.filtered,))

    def url(self, device: Device) -> str:
        """Address of a device in this session: the simulated one, or the hardware's."""
        return device.simulated if self.simulated else device.hardware

    @classmethod
    def from_yaml(cls, text: str) -> Self:
        """
        Read a session from YAML, see the module; ValueError as from `load`.

        Examples
        --------
        >>> text = '''
        ... {name: pot, simulated: true, protocol: scene, duration: 60, cameras: {"8-14":
        ...   {video: {simulated: "sim://boson/wide", hardware: "v4l2:///dev/video0"}}}}
        ... '''
        >>> session = Session.from_yaml(text)
        >>> session.url(session.cameras["8-14"].video)
        'sim://boson/wide'
        >>> Session.from_yaml(text.replace("60", "-60"))
        Traceback (most recent call last):
        ValueError: session: Invalid duration -60. Must be greater than 0.
        """
        return cls._checked(_read_yaml(text, "session"), {}, "session")

    @classmethod
    def load(cls, path: str | Path, changes: Mapping[str, Any] | None = None) -> Self:
        """
        Read a session from a file, and from the file that it names as its ``rig``.

        Parameters
        ----------
        path : str or Path
            YAML; see the module. Keys that several sessions share, such as the addresses, may stand
            in another file, whose name relative to this one is the key ``rig``.
        changes : mapping, optional
            Values in place of those in the files, by key; of ``blackbody``, key by key.

        Raises
        ------
        FileNotFoundError
            If a file does not exist.
        ValueError
            If it is not YAML, or a key is missing, unknown or in both files, or a value is invalid:
            the message has the file, the place in it, the value and the rule.
        """
        content = _read_yaml(Path(path).read_text(encoding="utf-8"), str(path))
        files = {}
        if "rig" in content:
            rig = Path(path).parent / str(content.pop("rig"))
            if not rig.exists():
                message = f"Missing file of key 'rig' of session '{path}'. Must be copied with it"
                raise FileNotFoundError(errno.ENOENT, message, str(rig))
            shared = _read_yaml(rig.read_text(encoding="utf-8"), str(rig))
            _check_unique("key of session and rig", [*map(str, content), *map(str, shared)])
            files = dict.fromkeys(shared, str(rig))
            content = {**shared, **content}
        changed = {**content, **(changes or {})}
        if changes and "blackbody" in changes and "blackbody" in content:
            changed["blackbody"] = {**content["blackbody"], **changes["blackbody"]}
        return cls._checked(changed, files, str(path))

    @classmethod
    def _checked(cls, content: Any, files: Mapping[str, str], path: str) -> Self:
        """Session of a YAML content; `files` has the file of each key that is not from `path`."""
        try:
            session: Self = TypeAdapter(cls).validate_python(content)
        except ValidationError as error:
            messages = [
                f"{files.get(str(one['loc'][0]), path) if one['loc'] else path}: {_message(one)}"
                for one in error.errors()
            ]
            raise ValueError("\n".join(messages)) from None
        return session


def check_one_of(name: str, values: Iterable[Any], allowed: Collection[Any]) -> None:
    """Raise ValueError if one of the values is not allowed."""
    for value in values:
        if isinstance(value, bool) or value not in allowed:
            raise ValueError(f"Invalid {name} {value!r}. Must be one of {list(allowed)}")


def _check_unique(name: str, values: Iterable[Any]) -> None:
    names = list(values)
    for value in names:
        if names.count(value) > 1:
            raise ValueError(f"Repeated {name} '{value}'. Must be listed once")


def _read_yaml(text: str, file: str) -> dict[Any, Any]:
    try:
        content = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ValueError(f"{file}: Must be YAML: {error}.") from error
    if not isinstance(content, dict):
        raise ValueError(f"{file}: Invalid content {content!r}. Must be a mapping.")
    return content


def _message(error: Any) -> str:
    """One error of pydantic as a sentence: place, value and rule."""
    place = ".".join(str(part) for part in error["loc"] if part != "[key]")
    if error["type"] == "missing":
        return f"Missing '{place}'. Must be set."
    if error["type"] in {"unexpected_keyword_argument", "extra_forbidden"}:
        return f"Unknown key '{place}'. Must be one of those in dbthermal.instruments.session."
    rule = re.sub(r"^(Value error, |\w+ should )", "", error["msg"])
    if not place:
        return f"{rule}."
    rule = rule if rule.startswith("Must ") else f"Must {rule}"
    return f"Invalid {place} {error['input']!r}. {rule}."
