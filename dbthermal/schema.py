"""Glossary: dimensions, type, unit and meaning of every variable at each stage of the data stream.

A name is agreed here first, then used. `check` holds a dataset against its stage and raises with
the value that offends.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntFlag
from functools import cached_property
from types import MappingProxyType
from typing import Any, Final, Self, TypeVar

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import _numbers

__all__ = [
    "COMPLETED",
    "COORDINATES",
    "EMISSIVITY_LIMITS",
    "EXPOSURE_TIME",
    "FRAME_FLAGS",
    "LARGEST",
    "MEASURED",
    "NOISE",
    "NOISE_FACTOR",
    "OPTIONAL",
    "PATTERN_STD",
    "SEGMENT",
    "SHUTTER_CLOSED",
    "STAGES",
    "UNMEASURED",
    "Status",
    "Variable",
    "check",
    "has_flag",
]
__dir__ = __all__.copy

Laid = TypeVar("Laid", xr.DataArray, xr.Dataset)

_STEP: Final = 1e-4  # share of the smallest step that a rounded coordinate may be off
_ROUNDING: Final = 4.0  # units in the last place of the largest value, likewise


@dataclass(frozen=True)
class Variable:
    """Definition of a variable: dimensions in order, type as written, unit, and meaning.

    Attributes
    ----------
    dims, dtype : tuple of str, str
        Dimensions, in order; type as written: read, any real type of the same kind passes.
    units, long_name, more : str, str, mapping
        Unit, meaning, and further attributes.
    """

    dims: tuple[str, ...]
    dtype: str
    units: str
    long_name: str
    more: Mapping[str, Any] = field(default_factory=dict, hash=False)

    @cached_property
    def attrs(self) -> dict[str, Any]:
        """Attributes to write on the variable, of which xarray keeps a copy."""
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

NOISE_FACTOR: Final = _of("band", "1", "noise after alignment divided by noise before alignment")
"""Variable `noise_factor`: by how much interpolation between frames has lessened the noise."""

PATTERN_STD: Final = _of("band", "count", "standard deviation of the residual fixed pattern")
"""Variable `pattern_std`: what the correction leaves from pixel to pixel, constant in time."""

CAUSES: Final[Mapping[str, str]] = MappingProxyType(  # cause of a deviation -> what shares it
    {
        "noise": "a frame of a pixel",
        "ratio": "all frames of a pixel, or of a material",
        "drift": "all pixels before the same surroundings",
        "pattern": "all frames of a pixel",
        **dict.fromkeys(("offset", "gain", "blackbody", "room", "colour"), "the image"),
    }
)
# Causes that two bands cannot show (`response.accuracy`); causes that no mean over pixels reduces.
CALIBRATION: Final = tuple(CAUSES)[3:]
SHARED: Final = tuple(cause for cause, of in CAUSES.items() if of == "the image")

BUDGETS: Final[Mapping[str, str]] = MappingProxyType(  # quantity -> its deviation by cause
    {
        "object_temperature": "uncertainty",
        "background_temperature": "background_uncertainty",
        "emissivity": "emissivity_uncertainty",
    }
)

SEGMENT: Final = _of("time", "1", "number of shutter events before the frame", "int32")
"""Variable `segment`: how often the offsets were renewed by a shutter event before the frame."""

STATUS: Final = _of("y x", "1", "validity flags, 0 is good", "uint32")

STAGES: Final[Mapping[str, Mapping[str, Variable]]] = MappingProxyType(
    {
        "recording": {"counts": _of("time y x", "count", "raw signal of one camera", "uint16")},
        "capture": {"counts": _of("band time y x", "count", "raw signal", "uint16")},
        "corrected": {"counts": _of("band time y x", "count", "corrected signal", "float32")},
        "reflection_shift": {
            **_with_std("shift", "axis y x", "pixel", "reflection shift"),
            "known": _of("y x", "1", "texture determines the shift", "bool"),
        },
        "separated": {
            **_with_std("object_temperature", "time y x", "K", "object temperature"),
            **_with_std("background_temperature", "time y x", "K", "background temperature"),
            **_with_std("emissivity", "band y x", "1", "band emissivity"),
            **_with_std("reflection_ratio", "band y x", "1", "reflection ratio, (1-e)/(1-e_ref)"),
            "status": STATUS,
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
            "reference_temperature": _of("", "K", "temperature about which counts are linearised"),
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
        "recording": {
            "exposure_time": _of("time", "s", "when the frame was exposed"),
            "frame_flags": _of("time", "1", "flags of the frame, 0 is good", "uint16"),
        },
        "capture": {"exposure_time": EXPOSURE_TIME, "frame_flags": FRAME_FLAGS},
        "corrected": {
            "exposure_time": EXPOSURE_TIME,
            "frame_flags": FRAME_FLAGS,
            "segment": SEGMENT,
            "drift": _of("band time", "count", "drift of the band's level that was subtracted"),
            "noise_factor": NOISE_FACTOR,
            "pattern_std": PATTERN_STD,
            "status": STATUS,
        },
        "separated": {
            "emissivity_covariance": _of(
                "band other_band y x", "1", "covariance of band emissivities", "float32"
            ),
            "drift_std": _of("y x", "1", "part of emissivity_std by background drift", "float32"),
            "noise": _of("band", "count", "noise that was used"),
            "bridged": _of("time y x", "1", "interpolated in time, not measured", "bool"),
            "material": _of("y x", "1", "material, -1 for none", "int32"),
            "reflection_shift": _of("axis y x", "pixel", "reflection shift", "float32"),
            "uncertainty": _of("cause y x", "K", "object temperature's std by cause", "float32"),
            "background_uncertainty": _of(
                "cause y x", "K", "background temperature's std by cause", "float32"
            ),
            "emissivity_uncertainty": _of(
                "cause band y x", "1", "band emissivity's std by cause", "float32"
            ),
        },
        "blackbody_frames": {"noise": NOISE},
        "correction": {
            "bad": _of("band y x", "1", "bad pixel", "bool"),
            "residual": _of("band", "count", "RMS residual over the good pixels"),
            "level": _of("band temperature", "count", "mean blackbody signal of the good pixels"),
            "offset_std": _of("band", "count", "offset's standard deviation at level 'centre'"),
            "gain_std": _of("band", "1", "standard deviation of the gain"),
            "centre": _of("band", "count", "level where offset and gain errors are independent"),
        },
        "response": {
            "noise": NOISE,
            "netd": _of("band", "K", "noise-equivalent temperature difference"),
            "offset_std": _of("band", "K", "standard deviation of the offset's drift"),
            "gain_std": _of("band", "1", "standard deviation of the gain"),
            "pattern_std": _of("band", "K", "standard deviation of the pattern's drift"),
            "blackbody_accuracy": _of("", "K", "std of the blackbody temperatures' shared error"),
            "blackbody_emissivity": _of("", "1", "emissivity of the blackbody"),
            "room_temperature": _of("", "K", "temperature of the room that the blackbody reflects"),
            "background_ratio_std": _of("", "1", "std of the background ratio (1 for gray)"),
        },
    }
)
"""Stage -> variable that it may hold -> its definition."""

LARGEST: Final = 1e9
"""Magnitude from which a number of counts or kelvin is no measurement of any detector."""

EMISSIVITY_LIMITS: Final = (-0.2, 1.05)
"""Limits of a spectral emissivity [1]: beyond, the unit is wrong or the file damaged. The libraries
have -0.16 (trona) to 1.014 (maple bark)."""

MEASURED: Final = "measured"
"""Attribute `origin` of data that a real camera has recorded; other data have another origin."""


def origin(*attrs: Mapping[str, Any]) -> dict[str, str]:
    """Attribute `origin` of a result of several inputs, simulated if one is; empty if unknown."""
    stated = [str(mapping["origin"]) for mapping in attrs if "origin" in mapping]
    artificial = [text for text in stated if text != MEASURED]
    return {"origin": (artificial or stated)[0]} if stated else {}


class Flags(IntFlag):
    """Bits with a name and a sentence each, written as CF `flag_masks` and `flag_meanings`."""

    meaning: str

    def __new__(cls, value: int, meaning: str = "") -> Self:
        """Bit of a value and a sentence."""
        member = int.__new__(cls, value)
        member._value_, member.meaning = value, meaning
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
    """Validity of a pixel, bits of `status` that are combined by OR; 0 is good.

    `Status.GRAY.meaning` says what that bit means; `has_flag` asks for some by name.
    """

    NO_BACKGROUND_MOTION = 1 << 0, "no rapid change of the reflection: nothing is measured"
    CONSTANT_OBJECT = 1 << 1, "constant object: temperature valid; no emissivity or background"
    GRAY = 1 << 2, "the emissivities of the bands hardly differ: no temperature is measured"
    BACKGROUND_NEVER_RESTS = 1 << 3, "reflection at rest in few frames: emissivity may be biased"
    NONPHYSICAL_EMISSIVITY = 1 << 4, "estimated emissivity outside (0, 1): temperature not measured"
    INVALID_SAMPLES = 1 << 5, "too many samples NaN, infinite or masked: nothing is estimated"
    CONSTANT_SIGNAL = 1 << 6, "the signal of a band never changes: nothing is estimated"
    SATURATED = 1 << 7, "samples at the limit of the detector, or many at the same level"
    OBJECT_NOT_SMOOTH = 1 << 8, "object changes too fast for a smooth curve, or noise is too high"
    OUTSIDE_RESPONSE = 1 << 9, "a temperature outside the calibrated range of the response"
    DEAD_PIXEL = 1 << 10, "bad pixel, marked by the correction"
    FROZEN_FRAMES = 1 << 11, "the same counts in a band for several frames in a row"
    NOT_CONVERGED = 1 << 12, "the iteration did not converge, or its result is not a finite number"
    OBJECT_JUMP = 1 << 13, "sudden steps of the object, part of its curve; the values are valid"
    BANDS_APART = 1 << 14, "rapid changes differ between the bands: time offset or parallax"
    ROLES_MAY_BE_SWAPPED = 1 << 15, "object and background may be exchanged in the result"
    COMPLETED_FROM_MATERIAL = 1 << 16, "completed, not measured: emissivity from the same material"
    COMPLETED_FROM_PRIOR = 1 << 17, "completed, not measured: emissivity from a library, or stated"
    COMPLETED_FROM_SURROUNDINGS = 1 << 18, "completed, not measured: background from surroundings"
    COMPLETED_FRAMES = 1 << 19, "completed, not measured: 15 % of the pixel's frames or more"
    NO_REFLECTION_PAIR = 1 << 20, "the second camera does not see this reflection: no estimate"


UNMEASURED: Final = Status.DEAD_PIXEL | Status.SATURATED | Status.INVALID_SAMPLES
"""Bits of a pixel whose samples are no measurement, before it is separated."""

COMPLETED: Final = Status(sum(bit for bit in Status if bit.label.startswith("completed")))
"""Bits of a pixel of which something is completed, not measured."""


def has_flag(flags: xr.DataArray, *names: str) -> xr.DataArray:
    """Mask of the places where any of some flags is set, by the CF attributes of the variable.

    Parameters
    ----------
    flags : DataArray
        `status` or `frame_flags`, whole numbers of any size, with ``flag_masks`` and
        ``flag_meanings``.
    *names : str
        Names of flags, in lower case; ValueError for one that is not among the attributes.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> status = xr.DataArray(np.uint32([0, 1024, 128]), dims="x", attrs=Status.cf_attrs(STATUS))
    >>> has_flag(status, "dead_pixel", "gray").values
    array([False,  True, False])
    """
    meanings = str(flags.attrs.get("flag_meanings", "")).split()
    masks = dict(zip(meanings, np.atleast_1d(flags.attrs.get("flag_masks", [])), strict=True))
    if unknown := [name for name in names if str(name) not in masks]:
        raise ValueError(f"Unknown flag '{unknown[0]}'. Must be one of {meanings}.")
    mask = sum({int(masks[name]) for name in names})
    return flags.copy(data=(flags.values & flags.dtype.type(mask)) != 0).drop_attrs()


def measured(values: npt.NDArray[Any] | xr.DataArray) -> Any:
    """Mask of the samples that are numbers below `LARGEST` in magnitude: not NaN, not infinite."""
    if values.dtype == np.float16:  # all of its numbers are smaller than `LARGEST`
        return np.isfinite(values)
    return np.abs(values) < LARGEST


def require_measured(values: npt.NDArray[Any], label: str) -> None:
    """Refuse samples that are no numbers, see `measured`."""
    if not np.all(measured(values)):
        message = f"Invalid {label}: NaN or infinite, or beyond {LARGEST:g}"
        raise ValueError(f"{message}. Must be finite.")


def check(
    dataset: xr.Dataset, stage: str, names: Sequence[str] = (), label: str = ""
) -> xr.Dataset:
    """Check a dataset against its stage, one of `STAGES`, and return it unchanged.

    Variables of `OPTIONAL` are checked, too, where it has them. A missing `units` attribute is
    taken as the agreed unit; a different one is an error. Of the values only those of the
    coordinates are read.

    TypeError or ValueError if it is not a Dataset of real numbers, a variable, dimension or
    coordinate is missing, misnamed or out of order, a unit is another one, a coordinate does not
    increase strictly, or bands repeat.

    Parameters
    ----------
    dataset, stage : Dataset, str
        Data of a stage, and its name.
    names, label : sequence of str, str
        Variables of the stage that are checked, where not all are needed; what the error calls it,
        "the" and the stage by default.

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
    label = label or f"the {stage}"
    require(dataset, xr.Dataset, label)
    # Name the missing variable, with the stage that the dataset fits.
    optional = [name for name in OPTIONAL.get(stage, ()) if name in dataset]
    for name in names or (*STAGES[stage], *optional):
        if name not in dataset:
            fitting = [key for key in STAGES if STAGES[key].keys() <= set(dataset)]
            nearest = max(fitting, key=lambda key: len(STAGES[key]), default="")
            present = f"{sorted(map(str, dataset))}" + (f", as has a {nearest}" if nearest else "")
            raise ValueError(f"Missing variable '{name}' in {label}: {present}. Must be there.")
        variable = STAGES[stage].get(name) or OPTIONAL[stage][name]
        check_variable(dataset[name], variable, f"'{name}' of {label}")
    return dataset


def check_corrected(dataset: xr.Dataset) -> xr.Dataset:
    """Check a dataset of the stage `corrected`; whole numbers are raw counts and a TypeError."""
    counts = check(dataset, "corrected")["counts"]
    if counts.dtype.kind != "f":
        label = f"dtype {counts.dtype} of 'counts' of the corrected: raw counts"
        rule = "floating: corrected by correction.correct_capture, of a camera that corrects "
        rule += "itself with correction.corrected_by_camera(capture)"
        raise TypeError(f"Invalid {label}. Must be {rule}.")
    return dataset


def check_variable(array: xr.DataArray, variable: Variable, label: str) -> None:
    """Check one array against its definition, with the errors of `check`."""
    require(array, xr.DataArray, label)
    if array.dims != variable.dims:
        raise ValueError(f"Invalid dims {array.dims} of {label}. Must be {variable.dims}.")
    if array.size == 0:
        raise ValueError(f"Empty {label}: sizes {dict(array.sizes)}. Must hold at least one value.")
    if variable.dtype != "bool":
        flags = variable in (STATUS, SEGMENT)  # whole numbers, whose unit says nothing
        check_numbers(array, label, None if flags else variable.units)
        if flags and array.dtype.kind == "f":
            rule = "Must be whole numbers: mask, average or fill single variables, not the Dataset"
            raise TypeError(f"Invalid dtype {array.dtype} of {label}. {rule}.")
    elif array.dtype != bool:
        raise TypeError(f"Invalid dtype {array.dtype} of {label}. Must be bool.")
    for dim in array.dims:
        if dim == "band":
            band_positions(array, [], label)
        elif dim in COORDINATES:
            if dim not in array.coords:
                raise ValueError(f"Missing coordinate '{dim}' of {label}. Must be given.")
            units, name = COORDINATES[str(dim)].units, f"'{dim}' of {label}"
            values = check_numbers(array[dim], name, units).values.astype(np.float64)
            require_rising(values, name, units)


def check_kelvin(result: xr.Dataset) -> xr.Dataset:
    """Refuse a film of degrees or differences, by a row of its first frame: a chunk of a store."""
    film = result.get("object_temperature", xr.DataArray(0.0))
    kind = (film.dims, str(film.attrs.get("units", "K")), film.dtype.kind, film.size > 0)
    is_read = film.chunks is None and kind == (("time", "y", "x"), "K", "f", True)
    if is_read and (level := float(film[0, film.sizes["y"] // 2].median())) < _numbers.KELVIN[0]:
        rule = "Must be in kelvin, not Celsius; a difference must have another name"
        raise ValueError(f"Invalid object temperature {level:.1f}. {rule}.")
    return result


def check_numbers(array: xr.DataArray, label: str, units: str | None = None) -> xr.DataArray:
    """Check that an array holds real numbers, of a unit if it states one, and return it."""
    require(array, xr.DataArray, label)
    if array.dtype.kind not in "fui" or array.dtype.itemsize > 8:
        rule = "Must be a real number of at most 64 bits"
        if array.dtype.kind in "mM":
            rule += ": of dates (time - time[0]) / np.timedelta64(1, 's')"
        raise TypeError(f"Invalid dtype {array.dtype} of {label}. {rule}.")
    if units is not None and array.attrs.get("units", units) != units:
        raise ValueError(f"Invalid units '{array.attrs['units']}' of {label}. Must be '{units}'.")
    return array


def band_positions(array: xr.DataArray | xr.Dataset, wanted: list[str], label: str) -> list[int]:
    """Positions of bands by name; ValueError if a band or the coordinate is missing or repeated."""
    require(array, xr.Dataset if isinstance(array, xr.Dataset) else xr.DataArray, label)
    if "band" not in array.coords:
        raise ValueError(f"Missing coordinate 'band' of {label}. Must name each band.")
    names = [str(name) for name in np.atleast_1d(array["band"].values)]
    if len(set(names)) != len(names):
        raise ValueError(f"Repeated band in {names} of {label}. Must occur once.")
    if missing := [name for name in wanted if name not in names]:
        raise ValueError(f"Missing band '{missing[0]}' in {label}, of {names}. Must be there.")
    return [names.index(name) for name in wanted]


def band_values(
    array: xr.DataArray, wanted: list[str], label: str, units: str
) -> npt.NDArray[np.float64]:
    """Values (band,) of an array over the bands alone, in the order of the wanted bands."""
    if check_numbers(array, label, units).dims != ("band",):
        raise ValueError(f"Invalid dims {array.dims} of {label}. Must be ('band',).")
    return array.values[band_positions(array, wanted, label)].astype(np.float64)


def variables(stage: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Variables of a Dataset of a stage, with the dims and attributes of their definitions."""
    stated = {**STAGES[stage], **OPTIONAL.get(stage, {})}
    return {name: (stated[name].dims, value, stated[name].attrs) for name, value in values.items()}


def require(data: object, kinds: type | tuple[type, ...], label: str) -> None:
    """Refuse a value of another type."""
    if not isinstance(data, kinds):
        names = [kind.__name__ for kind in (kinds if isinstance(kinds, tuple) else (kinds,))]
        message = f"Invalid {label.removeprefix('the ')} of type {type(data).__name__}"
        raise TypeError(f"{message}. Must be a {' or a '.join(names)}.")


def require_rising(values: npt.NDArray[np.float64], label: str, units: str) -> None:
    """Refuse values that are not finite, or do not increase strictly."""
    if not np.all(np.isfinite(values)):
        raise ValueError(f"Invalid {label}: not finite. Must be finite.")
    if np.any(wrong := np.diff(values) <= 0):
        place = int(np.argmax(wrong))
        pair = f"{values[place]} {units} is followed by {values[place + 1]} {units}"
        raise ValueError(f"Unordered {label}: {pair}. Must increase strictly.")


def rising_numbers(values: Any, label: str, units: str, least: int = 2) -> npt.NDArray[np.float64]:
    """Values (n,), so many or more, as a float array, if they increase strictly; else an error."""
    array = _numbers.real_numbers(f"{label} [{units}]", values)
    if array.ndim != 1 or array.size < least:
        raise ValueError(f"Invalid {label} of shape {array.shape}. Must be {least} or more.")
    require_rising(array, label, units)
    return array


def pixel_status(capture: xr.Dataset) -> npt.NDArray[np.uint32]:
    """Bits of `Status` of each pixel (y, x), 0 without a variable `status`."""
    good = np.zeros((capture.sizes["y"], capture.sizes["x"]))
    return np.asarray(capture.get("status", good), dtype=np.uint32)


def segments(capture: xr.Dataset) -> npt.NDArray[np.intp]:
    """Number of shutter events before each frame (time), 0 without a variable `segment`."""
    return np.asarray(capture.get("segment", np.zeros(capture.sizes["time"])), dtype=np.intp)


def noise_factor(capture: xr.Dataset) -> npt.NDArray[np.float64]:
    """Noise (band) [1] over that before an alignment, 1 without a variable `noise_factor`."""
    return np.asarray(capture.get("noise_factor", np.ones(capture.sizes["band"])), dtype=np.float64)


def laid_on(
    array: Laid,
    reference: xr.DataArray | xr.Dataset,
    label: str,
    of: str,
    dims: Sequence[str] = ("band", "time", "temperature", "material", "y", "x"),
) -> Laid:
    """Array with the bands, order and coordinates of a reference; a ValueError names the two."""
    require(array, (xr.DataArray, xr.Dataset), label)
    # Bands by name, then every common dim.
    shared = [dim for dim in dims if dim in array.dims and dim in reference.dims]
    if "band" in shared and "band" in array.coords and "band" in reference.coords:
        names = [str(name) for name in reference["band"].values]
        array = array.isel(band=band_positions(array, names, label))
    for dim in shared:
        if array.sizes[dim] != reference.sizes[dim]:
            rule = f"Must be that of {of}, {reference.sizes[dim]}"
            raise ValueError(f"Invalid size {array.sizes[dim]} of '{dim}' of {label}. {rule}.")
        if dim in array.coords and dim in reference.coords:
            _require_same(array[dim].values, reference[dim].values, f"'{dim}' of {label}", of)
    places = {dim: reference[dim].variable for dim in shared if dim in reference.coords}
    return array.assign_coords(places)


def _require_same(
    values: npt.NDArray[Any], reference: npt.NDArray[Any], label: str, of: str
) -> None:
    """ValueError where two coordinates differ: numbers beyond rounding, all else as text."""
    if {values.dtype.kind, reference.dtype.kind} <= set("iuf"):
        actual, wanted = values.astype(np.float64), reference.astype(np.float64)
        floats = [np.finfo(it.dtype).eps for it in (values, reference) if it.dtype.kind == "f"]
        tolerance = _ROUNDING * max(floats, default=0.0) * np.abs(wanted).max(initial=0.0)
        if wanted.size > 1:
            tolerance += _STEP * np.abs(np.diff(wanted)).min()
        equal = np.abs(actual - wanted) <= tolerance
    else:
        equal = values.astype(str) == reference.astype(str)
    if not equal.all():
        first = int(np.argmin(equal))
        label = f"Invalid {label}: {values[first]} at position {first}, where that of {of} is"
        raise ValueError(f"{label} {reference[first]}. Must be the same.")


def warned(dataset: xr.Dataset, *sentences: str) -> xr.Dataset:
    """Dataset with sentences in its attribute ``warnings``; each is a UserWarning, too."""
    for sentence in dict.fromkeys(sentences):
        warnings.warn(sentence, stacklevel=3)
    notes = dict.fromkeys([*dataset.attrs.get("warnings", []), *sentences])
    return dataset.assign_attrs(warnings=[*notes]) if notes else dataset
