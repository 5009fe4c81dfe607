"""A recording session: cameras, wheel, thermocouples and procedure, described in one YAML file.

Every device has its address; one key, ``simulated``, puts emulated ones in the place of all::

    name: plate
    simulated: true
    protocol: emissivity_bench # or gain_offset, response; or scene, without sweep and blackbody
    duration: 2                # of each recording, s
    frame_rate: 60             # Hz
    shape: [512, 640]          # rows, columns
    telemetry_rows: 2
    cameras:
      "8-14":
        video: v4l2:///dev/video0
        control: serial:///dev/ttyACM0
      "9.5":
        kind: boson            # of dbthermal.instruments.camera.KINDS; boson by default
        video: v4l2:///dev/video2
    devices:                   # whatever else is connected
      filter_wheel: serial:///dev/ttyUSB0
      thermocouples: "tc08:"
    filters: {1: "9.5", 2: "11"}
    wheel: {home_offset: 12.5} # settings of this wheel, if it has any
    sweep: ["9.5", "11"]       # filters that the wheel goes through at each temperature
    thermocouples: {1: blackbody, 2: plate}
    blackbody: {temperatures: [293.15, 303.15], stability: 0.02, window: 30, timeout: 1800}

Temperatures are in kelvin, times in seconds. An unknown or repeated key is an error, and so is a
value that YAML 1.1 and 1.2 read differently, see `dbthermal.readers.read_yaml`. The camera whose
band is one of the filters is behind the wheel. No address names a library: the environment variable
``DBTHERMAL_USBTC08`` names that of the thermocouple logger.
"""

import errno
import re
from collections.abc import Iterable, Mapping
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from pydantic import AfterValidator, ConfigDict, Field, StrictBool, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from dbthermal import _text as texts
from dbthermal.instruments import telemetry
from dbthermal.instruments.camera import FFC_READING, FPA_READING, camera_kind
from dbthermal.instruments.filterwheel import Settings
from dbthermal.instruments.transport import parse

__all__ = ["Blackbody", "Camera", "Session"]
__dir__ = __all__.copy

_CHECKED: Final = ConfigDict(extra="forbid", coerce_numbers_to_str=True)

WHEEL: Final = "filter_wheel"  # name of the wheel, and of the reading of its slot
LOGGER: Final = "thermocouples"  # name of the thermocouples' logger
_SCHEMES: Final = {WHEEL: "serial", LOGGER: "tc08"}  # of their addresses
BLACKBODY: Final = "blackbody"  # name of its thermocouple, and of its readings [K]


def _printable(text: str) -> str:
    if not text.isprintable() or text != text.strip():
        raise ValueError("Must be printable, without space at its ends")
    return text


def _address(scheme: str) -> AfterValidator:
    """Validator of an address of a scheme."""
    return AfterValidator(lambda url: (parse(url, scheme), url)[1])


Positive = Annotated[float, Field(strict=True, gt=0, allow_inf_nan=False)]
Temperature = Annotated[float, Field(strict=True, ge=200.0, le=2000.0)]  # no degrees Celsius [K]
Pixels = Annotated[int, Field(strict=True, ge=2, le=8192)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=64)]
Label = Annotated[str, Field(min_length=1, max_length=64), AfterValidator(_printable)]
Slot = Annotated[int, Field(strict=True, ge=1, le=6)]
Channel = Annotated[int, Field(strict=True, ge=1, le=8)]
Video = Annotated[str, _address("v4l2")]


@dataclass(frozen=True, config=_CHECKED)
class Camera:
    """A camera.

    Attributes
    ----------
    video, control, kind : str
        Addresses of its frames, ``"v4l2:///dev/video0"``, and of its command port, if it has one,
        ``"serial:///dev/ttyACM0"``; and its kind, of `dbthermal.instruments.camera.KINDS`.
    """

    video: Video
    control: Annotated[str, _address("serial")] | None = None
    kind: str = "boson"

    def __post_init__(self) -> None:
        if camera_kind(self.kind).control is None and self.control is not None:
            raise ValueError(f"Invalid control of kind '{self.kind}', which has none")


@dataclass(frozen=True, config=_CHECKED)
class Blackbody:
    """Temperatures of a calibration, and the rule by which each counts as reached.

    Attributes
    ----------
    temperatures, tolerance : tuple of float, float
        Set points [K]; largest distance of the mean reading from a set point [K]: thermocouple and
        logger are off by half a kelvin or so each, and the recordings keep the reading.
    stability, window, timeout : float
        Largest range of the readings [K] in a window, how long it is, and longest wait for it [s].
    accuracy, emissivity, room : float, optional
        Standard deviation of the error that all readings share [K], emissivity of the blackbody,
        and temperature of the room that it mirrors [K]: for the bars of results, see
        `calibration.fit_response`.
    """

    temperatures: Annotated[tuple[Temperature, ...], Field(min_length=1, max_length=1000)]
    stability: Annotated[Positive, Field(le=10.0)] = 0.05
    window: Annotated[Positive, Field(le=3600.0)] = 30.0
    tolerance: Annotated[Positive, Field(le=50.0)] = 1.5
    timeout: Annotated[Positive, Field(le=1e5)] = 1800.0
    accuracy: Annotated[Positive, Field(le=50.0)] | None = None
    emissivity: Annotated[Positive, Field(le=1.0)] | None = None
    room: Temperature | None = None

    def __post_init__(self) -> None:
        if self.window >= self.timeout:
            raise ValueError(f"Invalid window {self.window} s. Must be below the timeout")


@dataclass(frozen=True, config=_CHECKED)
class Session:
    """Description of a recording: devices, procedure and duration; see the module.

    Invalid values raise pydantic's ValidationError, a ValueError.

    Attributes
    ----------
    name, simulated : str, bool
        Name, of the recordings too; one switch for all devices: True emulates them.
    protocol, blackbody : str, Blackbody or None
        ``"gain_offset"``, ``"response"``, ``"emissivity_bench"``, which go through the blackbody's
        temperatures, or ``"scene"``, without a blackbody.
    duration, frame_rate : float
        Duration of the recording, or of each of its steps [s]; frame rate [Hz].
    cameras, devices : dict
        Cameras by band, in the order of the recording; addresses of other devices by name.
    shape, telemetry_rows : tuple of int, int
        Rows and columns; rows of telemetry in a frame, 0 or 2.
    filters, thermocouples : dict of int to str
        Slot of the wheel to band; channel to measured object.
    wheel, sweep : filterwheel.Settings, tuple of str
        Settings of the wheel; filters at each temperature, see `swept`.

    Examples
    --------
    >>> Session("pot", True, "scene", 60.0, {"8-14": Camera("v4l2:///dev/video0")}).bands
    ('8-14',)
    """

    name: Name
    simulated: StrictBool
    protocol: Literal["gain_offset", "response", "emissivity_bench", "scene"]
    duration: Annotated[Positive, Field(le=1e6)]
    cameras: Annotated[dict[Name, Camera], Field(min_length=1)]
    frame_rate: Annotated[Positive, Field(le=1e4)] = 60.0
    shape: tuple[Pixels, Pixels] = (512, 640)
    telemetry_rows: Literal[0, 2] = 0
    devices: dict[Literal["filter_wheel", "thermocouples"], str] = field(default_factory=dict)
    filters: dict[Slot, Name] = field(default_factory=dict)
    wheel: Settings = field(default_factory=Settings)
    sweep: tuple[Name, ...] = ()
    thermocouples: dict[Channel, Label] = field(default_factory=dict)
    blackbody: Blackbody | None = None

    def __post_init__(self) -> None:
        # The blackbody.
        if (self.protocol == "scene") != (self.blackbody is None):
            rule = "no blackbody" if self.protocol == "scene" else "a blackbody"
            raise ValueError(f"Invalid session of protocol '{self.protocol}'. Must have {rule}")
        if self.blackbody is not None and self.protocol != "emissivity_bench":
            _check_unique("temperature [K]", self.blackbody.temperatures)
        if self.blackbody is not None and BLACKBODY not in self.thermocouples.values():
            rule = f"Must have one named '{BLACKBODY}'"
            raise ValueError(f"Invalid thermocouples {dict(self.thermocouples)}. {rule}")
        if self.duration * self.frame_rate < 1:
            raise ValueError(f"Invalid duration {self.duration} s. Must be one frame at least")
        self._check_cameras()
        self._check_devices()

    def _check_cameras(self) -> None:
        rows, columns = self.telemetry_rows, self.shape[1]
        for band, camera in self.cameras.items():
            allowed = camera_kind(camera.kind).telemetry_rows
            label = f"Invalid telemetry_rows of band '{band}', a {camera.kind},"
            texts.check_listed(label, rows, allowed)
        if rows and rows * columns < telemetry.WORDS:
            rule = f"Must have {telemetry.WORDS // rows} columns for the telemetry"
            raise ValueError(f"Invalid shape {list(self.shape)}. {rule}")
        if not self.simulated:
            pairs = [(camera.video, camera.control) for camera in self.cameras.values()]
            addresses = [address for pair in pairs for address in pair if address is not None]
            _check_unique("address", [*addresses, *self.devices.values()])

    def _check_devices(self) -> None:
        for name, address in self.devices.items():
            parse(address, _SCHEMES[name])
        # The names of the readings of a recording differ: of the cameras and the wheel, too.
        names = [*self.thermocouples.values(), WHEEL, LOGGER]
        for band in dict.fromkeys((*self.bands, *self.filters.values())):
            names += [band, FPA_READING + band, FFC_READING + band]
        _check_unique("thermocouple", names)
        _check_unique("filter", self.filters.values())
        for device, entries in ((LOGGER, self.thermocouples), (WHEEL, self.filters)):
            if entries and device not in self.devices:
                raise ValueError(f"Missing device '{device}' of {dict(entries)}. Must be listed")
        behind = [band for band in self.bands if band in self.filters.values()]
        if self.filters and len(behind) != 1:
            raise ValueError(f"Invalid cameras {behind} behind the wheel. Must be exactly one")
        for band in self.sweep:
            texts.check_listed("Invalid filter of the sweep", band, self.filters.values())
        _check_unique("filter of the sweep", self.sweep)
        if self.sweep and self.blackbody is None:
            raise ValueError(f"Invalid sweep {list(self.sweep)}. Must have a blackbody")

    @property
    def bands(self) -> tuple[str, ...]:
        """Names of the bands."""
        return tuple(self.cameras)

    @property
    def filtered(self) -> str | None:
        """Band of the camera behind the wheel; None without a wheel."""
        return next((band for band in self.cameras if band in self.filters.values()), None)

    @property
    def swept(self) -> tuple[str, ...]:
        """Filters that are recorded at each temperature: `sweep`, or the one of the camera."""
        return self.sweep or (() if self.filtered is None else (self.filtered,))

    @classmethod
    def load(cls, path: str | Path, changes: Mapping[str, Any] | None = None) -> Self:
        """Read a session from a file, and from the file that it names as its ``rig``.

        FileNotFoundError if a file does not exist. ValueError if it is not YAML, or a key is
        missing, unknown, repeated or in both files, or a value is invalid: a line for each error,
        with file, place and rule.

        Parameters
        ----------
        path : str or Path
            YAML; see the module. Keys that several sessions share, such as the addresses, may stand
            in another file, whose name relative to this one is the key ``rig``.
        changes : mapping, optional
            Values in place of those in the files, by key; of ``blackbody``, key by key.
        """
        # The file, and that of the rig.
        content, files = texts.read_yaml(path), dict[str, str]()  # file of each key of the rig's
        if "rig" in content:
            name = content.pop("rig")
            if not isinstance(name, str) or not name.isprintable():
                raise ValueError(f"{path}: Invalid rig {texts.shown(name)}. Must be a file's name.")
            rig = Path(path).parent / name
            if not rig.exists():
                message = f"Missing file of key 'rig' of session '{path}'. Must be copied with it"
                raise FileNotFoundError(errno.ENOENT, message, str(rig))
            shared = texts.read_yaml(rig)
            for key in texts.repeated([*content, *shared]):
                rule = "Must be listed once"
                raise ValueError(f"{path}: Repeated key of session and rig '{key}'. {rule}.")
            files = dict.fromkeys(shared, str(rig))
            content = {**shared, **content}
        # The changes.
        changed = {**content, **(changes or {})}
        if changes and isinstance(steps := content.get(BLACKBODY), dict) and BLACKBODY in changes:
            changed[BLACKBODY] = {**steps, **changes[BLACKBODY]}
        # The checks, whose errors name the file of the key.
        try:
            session: Self = TypeAdapter(cls).validate_python(changed)
        except ValidationError as error:
            messages = []
            for details in error.errors():
                key = str(details["loc"][0]) if details["loc"] else ""
                messages.append(f"{files.get(key, path)}: {_message(details)}")
            raise ValueError("\n".join(messages)) from None
        return session


def _check_unique(name: str, values: Iterable[Any]) -> None:
    for value in texts.repeated(values):
        raise ValueError(f"Repeated {name} '{value}'. Must be listed once")


def _message(error: Any) -> str:
    """Error of pydantic as a sentence: place, value and rule."""
    keys = (str(key) for key in error["loc"] if key != "[key]")
    place = ".".join(
        key if key.isprintable() and len(key) <= texts.SHOWN else texts.shown(key) for key in keys
    )
    if error["type"] == "missing":
        return f"Missing '{place}'. Must be set."
    if error["type"] in {"unexpected_keyword_argument", "extra_forbidden"}:
        return f"Unknown key '{place}'. Must be one of those in dbthermal.instruments.session."
    rule = re.sub(r"^(Value error, |\w+ should )", "", error["msg"]).rstrip(".")
    rule = re.sub(r"a (valid dictionary|dictionary or an instance of \w+)", "a mapping", rule)
    # A rule of more than one key, or of an address, names its value by itself.
    if re.match("(Invalid|Missing|Repeated|Unknown) ", rule):
        return f"{place}: {rule}." if place else f"{rule}."
    rule = rule if rule.startswith("Must ") else f"Must {rule}"
    return f"Invalid {place} {texts.shown(error['input'])}. {rule}."
