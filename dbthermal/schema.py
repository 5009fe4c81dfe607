"""Glossary: dimensions, type, unit and meaning of every variable at each stage of the data stream.

A name is agreed here first, then used. `check` holds a dataset against its stage and raises with
the value that offends. The stages follow the stream: capture, corrected, separated; calibration
data, a response and an emissivity table stand beside it. ``python -m dbthermal.schema`` prints the
glossary as text, which is docs/nomenclature.md.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntFlag
from types import MappingProxyType
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt
import xarray as xr

__all__ = [
    "COMPLETED",
    "COORDINATES",
    "EMISSIVITY_LIMITS",
    "EXPOSURE_TIME",
    "FRAME_FLAGS",
    "LARGEST",
    "NOISE",
    "OPTIONAL",
    "SEGMENT",
    "SHUTTER_CLOSED",
    "STAGES",
    "Flags",
    "Status",
    "Variable",
    "band_positions",
    "band_values",
    "check",
    "check_corrected",
    "check_numbers",
    "check_variable",
    "has_flag",
    "measured",
    "nomenclature",
    "status_attrs",
]
__dir__ = __all__.copy


@dataclass(frozen=True)
class Variable:
    """Definition of a variable: dimensions in order, type as written, unit, and meaning.

    Attributes
    ----------
    dims : tuple of str
        Dimensions, in order.
    dtype : str
        Type as written; read, any real type of the same kind passes.
    units, long_name : str
        Unit and meaning.
    more : mapping
        Further attributes.
    """

    dims: tuple[str, ...]
    dtype: str
    units: str
    long_name: str
    more: Mapping[str, Any] = field(default_factory=dict, hash=False)

    @property
    def attrs(self) -> dict[str, Any]:
        """Attributes to write on the variable."""
        return {"units": self.units, "long_name": self.long_name, **self.more}


def _of(dims: str, units: str, long_name: str, dtype: str = "float64") -> Variable:
    return Variable(tuple(dims.split()), dtype, units, long_name)


def _with_std(name: str, dims: str, units: str, long_name: str) -> dict[str, Variable]:
    return {
        name: _of(dims, units, long_name, "float32"),
        f"{name}_std": _of(dims, units, f"standard deviation of {long_name}", "float32"),
    }


COORDINATES: Final = MappingProxyType(
    {
        "time": _of("time", "s", "time since the first frame"),
        "temperature": _of("temperature", "K", "blackbody temperature"),
        "wavelength": _of("wavelength", "m", "wavelength"),
    }
)
"""Coordinates with a unit; they must increase strictly. Coordinate `band` names each band."""

NOISE: Final = _of("band", "count", "noise of one pixel and frame")
"""Variable `noise`: standard deviation of one pixel's counts from frame to frame."""

EXPOSURE_TIME: Final = _of("band time", "s", "when the frame was exposed")
"""Variable `exposure_time`: each camera's own stamps, NaN for a frame that is no measurement."""

FRAME_FLAGS: Final = _of("band time", "1", "flags of the frame, 0 is good", "uint16")
"""Variable `frame_flags` of a recording, bits named by its own CF attributes; see `has_flag`."""

SHUTTER_CLOSED: Final = "shutter_closed"
"""Name, in `frame_flags`, of the bit of a frame taken while the camera's shutter was closed."""

NOISE_FACTOR: Final = _of("band", "1", "noise over that before the alignment")
"""Variable `noise_factor`: by how much interpolation between frames has lessened the noise."""

PATTERN_STD: Final = _of("band", "count", "standard deviation of the residual fixed pattern")
"""Variable `pattern_std`: what the correction leaves from pixel to pixel, constant in time."""

SEGMENT: Final = _of("time", "1", "shutter events before the frame", "int32")
"""Variable `segment`: how often the offsets were renewed by a shutter event before the frame."""

_STATUS: Final = _of("y x", "1", "validity flags, 0 is good", "uint32")

STAGES: Final[Mapping[str, Mapping[str, Variable]]] = MappingProxyType(
    {
        "capture": {"counts": _of("band time y x", "count", "raw signal", "uint16")},
        "corrected": {"counts": _of("band time y x", "count", "corrected signal", "float32")},
        "reflection_shift": {
            **_with_std("shift", "axis y x", "pixel", "shift of what is reflected"),
            "known": _of("y x", "1", "texture tells the shift", "bool"),
        },
        "separated": {
            **_with_std("object_temperature", "time y x", "K", "object temperature"),
            **_with_std("background_temperature", "time y x", "K", "background temperature"),
            **_with_std("emissivity", "band y x", "1", "band emissivity"),
            **_with_std("reflection_ratio", "band y x", "1", "reflection ratio"),
            "status": _STATUS,
        },
        "blackbody": {"counts": _of("band temperature", "count", "mean blackbody signal")},
        "blackbody_movies": {
            "counts": _of("band temperature frame y x", "count", "raw signal", "uint16")
        },
        "blackbody_frames": {
            "counts": _of("band temperature y x", "count", "mean over the frames")
        },
        "correction": {
            "gain": _of("band y x", "1", "gain of the pixel"),
            "offset": _of("band y x", "count", "offset of the pixel"),
        },
        "response": {
            "amplitude": _of("band", "count", "Sakuma-Hattori amplitude"),
            "effective_wavelength": _of("band", "m", "Sakuma-Hattori effective wavelength"),
            "wavelength_shift": _of("band", "m K", "Sakuma-Hattori wavelength shift"),
            "offset": _of("band", "count", "Sakuma-Hattori offset"),
            "linear_slope": _of("band", "count K-1", "slope of the linear response"),
            "linear_intercept": _of("band", "count", "intercept of the linear response"),
            "reference_temperature": _of("", "K", "reference temperature"),
            "temperature_min": _of("", "K", "lowest calibrated temperature"),
            "temperature_max": _of("", "K", "highest calibrated temperature"),
        },
        "contact": {
            "counts": _of("band measurement", "count", "signal"),
            "object_temperature": _of("measurement", "K", "object temperature"),
            "background_temperature": _of("measurement", "K", "background temperature"),
        },
        "reflector": {
            "counts": _of("band measurement", "count", "signal"),
            "reflected_counts": _of("band measurement", "count", "signal of the reflector"),
            "object_temperature": _of("measurement", "K", "object temperature"),
        },
        "spectrum": {"emissivity": _of("wavelength", "1", "spectral emissivity")},
        "emissivity_table": {
            "emissivity": _of("material band", "1", "band emissivity"),
            "coverage": _of("material band", "1", "share of the band that the spectrum covers"),
        },
    }
)
"""Stage -> variable -> its definition."""

OPTIONAL: Final[Mapping[str, Mapping[str, Variable]]] = MappingProxyType(
    {
        "capture": {"exposure_time": EXPOSURE_TIME, "frame_flags": FRAME_FLAGS},
        "corrected": {
            "exposure_time": EXPOSURE_TIME,
            "frame_flags": FRAME_FLAGS,
            "segment": SEGMENT,
            "drift": _of("band time", "count", "drift taken out"),
            "noise_factor": NOISE_FACTOR,
            "pattern_std": PATTERN_STD,
            "status": _STATUS,
        },
        "separated": {
            "emissivity_covariance": _of(
                "band other_band y x", "1", "covariance of band emissivities", "float32"
            )
        },
        "blackbody_frames": {"noise": NOISE},
        "correction": {
            "bad": _of("band y x", "1", "bad pixel", "bool"),
            "residual": _of("band", "count", "RMS residual over the good pixels"),
            "level": _of("band temperature", "count", "mean over the good pixels"),
            "offset_std": _of("band", "count", "standard deviation of the offset at the centre"),
            "gain_std": _of("band", "1", "standard deviation of the gain"),
            "centre": _of("band", "count", "level at which the two errors are independent"),
        },
        "response": {
            "noise": NOISE,
            "netd": _of("band", "K", "noise-equivalent temperature difference"),
        },
    }
)
"""Stage -> variable that it may hold -> its definition."""

LARGEST: Final = 1e9
"""Magnitude from which a number of counts or kelvin is no measurement of any detector."""

EMISSIVITY_LIMITS: Final = (-0.2, 1.05)
"""A spectral emissivity outside is no measurement, but a wrong unit or a damaged file [1].

The extremes of the libraries are -0.16 (trona) and 1.014 (maple bark), from reflectances of 116 %
and -1.4 % relative to the reference."""


class Flags(IntFlag):
    """Bits with a name and a sentence each, written as CF `flag_masks` and `flag_meanings`.

    Attributes
    ----------
    meaning : str
        The sentence.
    """

    meaning: str

    def __new__(cls, value: int, meaning: str = "") -> Self:
        """Make a bit from its value and its sentence."""
        member = int.__new__(cls, value)
        member._value_ = value
        member.meaning = meaning
        return member

    @property
    def label(self) -> str:
        """Name in lower case, as in `flag_meanings`."""
        return str(self.name).lower()

    @classmethod
    def bits(cls) -> dict[str, int]:
        """Values by label."""
        return {bit.label: bit.value for bit in cls}

    @classmethod
    def cf_attrs(cls, variable: Variable) -> dict[str, object]:
        """CF attributes of a variable of these flags: masks, names, a sentence each, unit."""
        return {
            **variable.attrs,
            "flag_masks": np.array(list(cls.bits().values()), dtype=variable.dtype),
            "flag_meanings": " ".join(cls.bits()),
            "comment": "; ".join(f"{bit.label}: {bit.meaning}" for bit in cls),
        }


class Status(Flags):
    """Validity of a pixel, bits of `status`; 0 is good."""

    NO_BACKGROUND_MOTION = 1 << 0, "no rapid change: no reflection ratio, so nothing is estimated"
    CONSTANT_OBJECT = 1 << 1, "a constant object: its temperature holds, nothing else is estimated"
    GRAY = 1 << 2, "the bands' emissivities do not differ: the system is singular"
    BACKGROUND_NEVER_RESTS = 1 << 3, "background at rest in few frames: emissivity may be biased"
    NONPHYSICAL_EMISSIVITY = 1 << 4, "estimate outside (0, 1): no background temperature"
    INVALID_SAMPLES = 1 << 5, "too many samples NaN, infinite or masked: nothing is estimated"
    CONSTANT_SIGNAL = 1 << 6, "the signal of a band never changes: nothing is estimated"
    SATURATED = 1 << 7, "samples at the detector's limit, or heaped on one level"
    OBJECT_NOT_SMOOTH = 1 << 8, "object changes too fast for a smooth curve, or noise is higher"
    OUTSIDE_RESPONSE = 1 << 9, "a temperature outside the calibrated range of the response"
    DEAD_PIXEL = 1 << 10, "bad pixel, marked by the correction"
    FROZEN_FRAMES = 1 << 11, "the same counts in a band for several frames in a row"
    NOT_CONVERGED = 1 << 12, "the optimiser stopped at its limit of steps or at no finite value"
    OBJECT_JUMP = 1 << 13, "sudden steps of the object, taken into its curve; the values hold"
    BANDS_APART = 1 << 14, "rapid changes not simultaneous: a time offset, or a parallax"
    ROLES_MAY_BE_SWAPPED = 1 << 15, "object and background exchanged: low emissivity, lasting step"
    COMPLETED_FROM_MATERIAL = 1 << 16, "completed, not measured: emissivity of the same material"
    COMPLETED_FROM_PRIOR = 1 << 17, "completed, not measured: emissivity of a library, or stated"
    COMPLETED_FROM_SURROUNDINGS = 1 << 18, "completed, not measured: background of surroundings"
    COMPLETED_FRAMES = 1 << 19, "completed, not measured: some frames of the temperatures"
    NO_REFLECTION_PAIR = 1 << 20, "the second camera does not see this reflection: nothing is known"


COMPLETED: Final = (
    Status.COMPLETED_FROM_MATERIAL
    | Status.COMPLETED_FROM_PRIOR
    | Status.COMPLETED_FROM_SURROUNDINGS
    | Status.COMPLETED_FRAMES
)
"""Bits of a pixel of which something is completed, not measured."""


def status_attrs() -> dict[str, object]:
    """CF attributes of a `status` variable: `flag_masks` (uint32), `flag_meanings`, units."""
    return Status.cf_attrs(_STATUS)


def has_flag(flags: xr.DataArray, *names: str) -> xr.DataArray:
    """Mask of the places where any of some flags is set, by the CF attributes of the variable.

    Parameters
    ----------
    flags : DataArray
        `status` or `frame_flags`, whole numbers of any size, with ``flag_masks`` and
        ``flag_meanings``.
    *names : str
        Names of flags, in lower case.

    Returns
    -------
    DataArray of bool
        Of the shape of the flags.

    Raises
    ------
    ValueError
        If a name is not among the attributes.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> bits = np.array([0, 1024, 128], dtype=np.uint32)
    >>> status = xr.DataArray(bits, dims="x", attrs=status_attrs())
    >>> has_flag(status, "dead_pixel", "gray").values
    array([False,  True, False])
    """
    meanings = str(flags.attrs.get("flag_meanings", "")).split()
    masks = dict(zip(meanings, np.atleast_1d(flags.attrs.get("flag_masks", [])), strict=True))
    unknown = [name for name in names if name not in masks]
    if unknown:
        raise ValueError(f"Unknown flag '{unknown[0]}'. Must be one of {meanings}.")
    mask = sum({int(masks[name]) for name in names})
    return flags.copy(data=(flags.values & flags.dtype.type(mask)) != 0).drop_attrs()


def measured(values: npt.NDArray[Any] | xr.DataArray) -> Any:
    """Mask of the samples that are numbers below `LARGEST` in magnitude: not NaN, not infinite.

    Parameters
    ----------
    values : array or DataArray
        Samples, of any shape and unit.
    """
    if values.dtype == np.float16:  # `LARGEST` is none, and all of its numbers are smaller
        return np.isfinite(values)
    return np.abs(values) < LARGEST


def check(dataset: xr.Dataset, stage: str) -> xr.Dataset:
    """Check a dataset against its stage, one of `STAGES`, and return it unchanged.

    A missing `units` attribute is taken as the agreed unit; a different one is an error. Of the
    values only those of the coordinates are read.

    Parameters
    ----------
    dataset : Dataset
        Data of a stage.
    stage : str
        One of `STAGES`.

    Raises
    ------
    TypeError
        If it is not a Dataset, or a variable's dtype is not a real number.
    ValueError
        If a variable, dimension or coordinate is missing, misnamed or out of order, a unit is
        another one, a coordinate does not increase strictly, or bands repeat.

    Examples
    --------
    >>> import xarray as xr
    >>> wavelength = ("wavelength", [8.0, 14.0], {"units": "um"})
    >>> glass = xr.Dataset({"emissivity": ("wavelength", [0.9, 0.8])}, {"wavelength": wavelength})
    >>> check(glass, "spectrum")
    Traceback (most recent call last):
    ValueError: Invalid units 'um' of 'wavelength' of 'emissivity' of the spectrum. Must be 'm'.
    """
    if stage not in STAGES:
        raise ValueError(f"Unknown stage '{stage}'. Must be one of {sorted(STAGES)}.")
    if not isinstance(dataset, xr.Dataset):
        raise TypeError(f"Invalid {stage} of type {type(dataset).__name__}. Must be a Dataset.")
    for name, variable in STAGES[stage].items():
        if name not in dataset:
            raise ValueError(
                f"Missing variable '{name}' in the {stage}. Has {sorted(map(str, dataset))}."
            )
        check_variable(dataset[name], variable, f"'{name}' of the {stage}")
    return dataset


def check_corrected(dataset: xr.Dataset) -> xr.Dataset:
    """Check a dataset against the stage `corrected`, as `check`, and refuse raw counts.

    Parameters
    ----------
    dataset : Dataset
        Capture, returned unchanged.

    Raises
    ------
    TypeError
        For whole numbers: those are raw, and corrected counts need NaN besides.
    """
    counts = check(dataset, "corrected")["counts"]
    if counts.dtype.kind != "f":
        raise TypeError(
            f"Invalid dtype {counts.dtype} of 'counts' of the corrected: raw counts. Must be "
            "floating: corrected by correction.correct_capture or, of a camera that corrects "
            "itself, counts.astype('float32')."
        )
    return dataset


def check_variable(array: xr.DataArray, variable: Variable, label: str) -> None:
    """Check one array against its definition, as `check`.

    Parameters
    ----------
    array : DataArray
        Array to be checked.
    variable : Variable
        Its definition.
    label : str
        Its name in the error.
    """
    if array.dims != variable.dims:
        raise ValueError(f"Invalid dims {array.dims} of {label}. Must be {variable.dims}.")
    if array.size == 0:
        raise ValueError(f"Empty {label}: sizes {dict(array.sizes)}. Must hold at least one value.")
    if variable.dtype != "bool":
        check_numbers(array, label, variable.units)
        if variable is _STATUS and array.dtype.kind == "f":
            raise TypeError(f"Invalid dtype {array.dtype} of {label}. Must be whole numbers.")
    elif array.dtype != bool:
        raise TypeError(f"Invalid dtype {array.dtype} of {label}. Must be bool.")
    for dim in array.dims:
        if dim == "band":
            band_positions(array, [], label)
        elif dim in COORDINATES:
            _check_coordinate(array, str(dim), label)


def check_numbers(array: xr.DataArray, label: str, units: str | None = None) -> xr.DataArray:
    """Check that an array holds real numbers, of a unit if it states one, and return it as it is.

    Parameters
    ----------
    array : DataArray
        Array to be checked.
    label : str
        Its name in the error.
    units : str, optional
        Unit that it has if it states one; any by default.

    Raises
    ------
    TypeError
        If the type or dtype is another one.
    ValueError
        If it states another unit.
    """
    if not isinstance(array, xr.DataArray):
        raise TypeError(f"Invalid {label} of type {type(array).__name__}. Must be a DataArray.")
    if array.dtype.kind not in "fui":
        raise TypeError(f"Invalid dtype {array.dtype} of {label}. Must be a real number.")
    if units is not None and array.attrs.get("units", units) != units:
        raise ValueError(f"Invalid units '{array.attrs['units']}' of {label}. Must be '{units}'.")
    return array


def band_positions(array: xr.DataArray | xr.Dataset, wanted: list[str], label: str) -> list[int]:
    """Positions of bands on the dimension `band`, by name as text.

    Parameters
    ----------
    array : DataArray or Dataset
        Array with a coordinate `band`.
    wanted : list of str
        Names of the bands.
    label : str
        Name of the array in the error.

    Raises
    ------
    ValueError
        If there is no coordinate `band`, or a band is missing or repeated.
    """
    if "band" not in array.coords:
        raise ValueError(f"Missing coordinate 'band' of {label}. Must name each band.")
    names = [str(name) for name in np.atleast_1d(array["band"].values)]
    if len(set(names)) != len(names):
        raise ValueError(f"Repeated band in {names} of {label}. Each band must occur once.")
    missing = [name for name in wanted if name not in names]
    if missing:
        raise ValueError(f"Missing band '{missing[0]}' in {label}. Has {names}.")
    return [names.index(name) for name in wanted]


def band_values(
    array: xr.DataArray, wanted: list[str], label: str, units: str
) -> npt.NDArray[np.float64]:
    """Values (band,) of an array of numbers over the bands alone, in the order of some bands.

    Parameters
    ----------
    array : DataArray
        Values (band).
    wanted : list of str
        Names of the bands, in the order of the result.
    label, units : str
        Name of the array in the error, and the unit that it has if it states one.

    Raises
    ------
    TypeError, ValueError
        As `check_numbers` and `band_positions`; ValueError for other dims, too.
    """
    if check_numbers(array, label, units).dims != ("band",):
        raise ValueError(f"Invalid dims {array.dims} of {label}. Must be ('band',).")
    return array.values[band_positions(array, wanted, label)].astype(np.float64)


def _check_coordinate(array: xr.DataArray, dim: str, label: str) -> None:
    if dim not in array.coords:
        raise ValueError(f"Missing coordinate '{dim}' of {label}. Must be given.")
    coordinate, units = array[dim], COORDINATES[dim].units
    stated = coordinate.attrs.get("units", units)
    if stated != units:
        raise ValueError(f"Invalid units '{stated}' of '{dim}' of {label}. Must be '{units}'.")
    if coordinate.dtype.kind not in "fui":
        raise TypeError(
            f"Invalid dtype {coordinate.dtype} of '{dim}' of {label}. Must be numbers in {units}."
        )
    values = coordinate.values.astype(np.float64)
    steps = np.diff(values)
    if not np.all(np.isfinite(values)):
        raise ValueError(f"Invalid '{dim}' of {label}: not finite. Must be finite.")
    if np.any(steps <= 0):
        place = int(np.argmax(steps <= 0))
        raise ValueError(
            f"Unordered '{dim}' of {label}: {values[place]} {units} is followed by "
            f"{values[place + 1]} {units}. Must increase strictly."
        )


def nomenclature() -> str:
    """Glossary as Markdown, the text of docs/nomenclature.md."""
    parts = [_PREFACE, "## Coordinates", _table(COORDINATES)]
    for stage, variables in STAGES.items():
        parts += [f"## Stage `{stage}`", _table({**variables, **OPTIONAL.get(stage, {})}, stage)]
    bits = [f"| {bit.value} | `{bit.label}` | {bit.meaning} |" for bit in Status]
    head = ["| value | name | meaning |", "| --: | --- | --- |"]
    return "\n\n".join([*parts, "## Bits of `status`", "\n".join([*head, *bits])]) + "\n"


_PREFACE: Final = """# Nomenclature

Variables at each stage of the data stream, made from `dbthermal/schema.py` by
`python -m dbthermal.schema > docs/nomenclature.md`. Temperatures are in kelvin, other units are SI;
`count` is the unit of the detector's signal. A variable in italics is optional."""


def _table(variables: Mapping[str, Variable], stage: str = "") -> str:
    """Markdown table of variables; the optional ones of a stage in italics."""
    rows = ["| variable | dimensions | type | unit | meaning |", "| --- | --- | --- | --- | --- |"]
    optional = OPTIONAL.get(stage, {})
    for name, one in variables.items():
        label = f"*{name}*" if name in optional else f"`{name}`"
        dims = ", ".join(one.dims) or "-"
        rows.append(f"| {label} | {dims} | {one.dtype} | {one.units} | {one.long_name} |")
    return "\n".join(rows)


if __name__ == "__main__":
    sys.stdout.write(nomenclature())
