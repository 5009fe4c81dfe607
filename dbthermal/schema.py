"""The glossary: every variable's dims, unit and meaning at each stage of the data stream.

A name is agreed here first, then used. `check` holds a dataset against its stage and raises with
the value that offends. The stages follow the stream: capture, corrected, separated; a response
and an emissivity table stand beside it.
"""

from dataclasses import dataclass
from enum import IntFlag
from types import MappingProxyType
from typing import Final

import numpy as np
import xarray as xr

Dims = tuple[str, ...]


@dataclass(frozen=True)
class Variable:
    """
    What a variable of a stage must be.

    Attributes
    ----------
    dims : tuple of str
        Dimensions in their order.
    dtype : str
        Dtype as written by this project; read, any real dtype of the same kind passes.
    units : str
        Unit as in the attribute `units`.
    long_name : str
        Meaning, for people and axis labels.
    """

    dims: Dims
    dtype: str
    units: str
    long_name: str

    @property
    def attrs(self) -> dict[str, str]:
        """Attributes to write on the variable."""
        return {"units": self.units, "long_name": self.long_name}


_MOVIE: Final = ("band", "time", "y", "x")
_FRAMES: Final = ("time", "y", "x")
_IMAGE: Final = ("y", "x")


def _with_std(name: str, dims: Dims, units: str, long_name: str) -> dict[str, Variable]:
    return {
        name: Variable(dims, "float32", units, long_name),
        f"{name}_std": Variable(dims, "float32", units, f"standard deviation of {long_name}"),
    }


COORDINATES: Final = MappingProxyType(
    {
        "time": Variable(("time",), "float64", "s", "time since the first frame"),
        "temperature": Variable(("temperature",), "float64", "K", "blackbody temperature"),
        "wavelength": Variable(("wavelength",), "float64", "m", "wavelength"),
    }
)
"""Coordinates with a unit; they must increase strictly."""

STAGES: Final = MappingProxyType(
    {
        "capture": {"counts": Variable(_MOVIE, "uint16", "count", "raw signal")},
        "corrected": {"counts": Variable(_MOVIE, "float32", "count", "corrected signal")},
        "blackbody": {
            "counts": Variable(("band", "temperature"), "float64", "count", "mean blackbody signal")
        },
        "blackbody_movies": {
            "counts": Variable(
                ("band", "temperature", "frame", "y", "x"), "uint16", "count", "raw signal"
            )
        },
        "blackbody_frames": {
            "counts": Variable(
                ("band", "temperature", "y", "x"), "float64", "count", "mean over the frames"
            )
        },
        "correction": {
            "gain": Variable(("band", "y", "x"), "float64", "1", "gain of the pixel"),
            "offset": Variable(("band", "y", "x"), "float64", "count", "offset of the pixel"),
        },
        "contact": {
            "counts": Variable(("band", "measurement"), "float64", "count", "signal"),
            "object_temperature": Variable(("measurement",), "float64", "K", "object temperature"),
            "background_temperature": Variable(
                ("measurement",), "float64", "K", "background temperature"
            ),
        },
        "reflector": {
            "counts": Variable(("band", "measurement"), "float64", "count", "signal"),
            "reflected_counts": Variable(
                ("band", "measurement"), "float64", "count", "signal of the reflector"
            ),
            "object_temperature": Variable(("measurement",), "float64", "K", "object temperature"),
        },
        "response": {
            "amplitude": Variable(("band",), "float64", "count", "Sakuma-Hattori amplitude"),
            "effective_wavelength": Variable(
                ("band",), "float64", "m", "Sakuma-Hattori effective wavelength"
            ),
            "wavelength_shift": Variable(
                ("band",), "float64", "m K", "Sakuma-Hattori wavelength shift"
            ),
            "offset": Variable(("band",), "float64", "count", "Sakuma-Hattori offset"),
            "linear_slope": Variable(
                ("band",), "float64", "count K-1", "slope of the linear response"
            ),
            "linear_intercept": Variable(
                ("band",), "float64", "count", "intercept of the linear response"
            ),
            "reference_temperature": Variable((), "float64", "K", "reference temperature"),
            "temperature_min": Variable((), "float64", "K", "lowest calibrated temperature"),
            "temperature_max": Variable((), "float64", "K", "highest calibrated temperature"),
        },
        "spectrum": {
            "emissivity": Variable(("wavelength",), "float64", "1", "spectral emissivity")
        },
        "emissivity_table": {
            "emissivity": Variable(("material", "band"), "float64", "1", "band emissivity"),
            "coverage": Variable(
                ("material", "band"), "float64", "1", "share of the band that the spectrum covers"
            ),
        },
        "separated": {
            **_with_std("object_temperature", _FRAMES, "K", "object temperature"),
            **_with_std("background_temperature", _FRAMES, "K", "background temperature"),
            **_with_std("emissivity", ("band", "y", "x"), "1", "band emissivity"),
            **_with_std("reflection_ratio", ("band", "y", "x"), "1", "reflection ratio"),
            "status": Variable(_IMAGE, "uint32", "1", "validity flags, 0 is good"),
        },
    }
)
"""Stage -> variable -> what it must be. A response and blackbody frames may also hold `noise`
(band) [count]; a correction holds `bad` (band, y, x), bool, too."""

NOISE: Final = Variable(("band",), "float64", "count", "noise of one pixel and frame")
"""Optional variable `noise` of a response: standard deviation of one pixel's counts."""

EMISSIVITY_LIMITS: Final = (-0.2, 1.05)
"""A spectral emissivity outside is no measurement, but a wrong unit or a damaged file [1].

The extremes of the libraries are -0.16 (trona) and 1.014 (maple bark), from reflectances of 116 %
and -1.4 % relative to the reference."""


class Status(IntFlag):
    """Bits of `status`, the validity of a pixel; 0 is good. `FLAG_MEANINGS` explains each."""

    NO_BACKGROUND_MOTION = 1 << 0
    CONSTANT_OBJECT = 1 << 1
    GRAY = 1 << 2
    BACKGROUND_NEVER_RESTS = 1 << 3
    NONPHYSICAL_EMISSIVITY = 1 << 4
    INVALID_SAMPLES = 1 << 5
    CONSTANT_SIGNAL = 1 << 6
    SATURATED = 1 << 7
    OBJECT_NOT_SMOOTH = 1 << 8
    OUTSIDE_RESPONSE = 1 << 9
    DEAD_PIXEL = 1 << 10
    FROZEN_FRAMES = 1 << 11
    NOT_CONVERGED = 1 << 12
    OBJECT_JUMP = 1 << 13
    BANDS_APART = 1 << 14
    ROLES_MAY_BE_SWAPPED = 1 << 15


FLAGS: Final = MappingProxyType({str(bit.name).lower(): int(bit) for bit in Status})
"""Bits of `status`, by name."""

FLAG_MEANINGS: Final = MappingProxyType(
    {
        "no_background_motion": "no rapid change: the direction of the reflection is undefined; "
        "no temperature and no emissivity",
        "constant_object": "object constant: emissivity and background are undefined, the object "
        "temperature holds, if it is the object that is constant",
        "gray": "the bands' emissivities do not differ: the system is singular",
        "background_never_rests": "the background rests in few frames: emissivity may be biased "
        "beyond its standard deviation; a drift parallel to the object's curve cannot be seen",
        "nonphysical_emissivity": "estimated emissivity outside (0, 1): no background temperature",
        "invalid_samples": "more than half of the samples, or more than the method can spare, are "
        "NaN, infinite or masked: nothing is estimated",
        "constant_signal": "a band's signal never changes: nothing is estimated",
        "saturated": "samples at the detector's limit: whole-number counts at an end of their "
        "type, or as marked by the frame correction",
        "object_not_smooth": "the combination of bands that holds no background is more than white "
        "noise about a smooth curve: the object changes too fast, or the noise is another",
        "outside_response": "a temperature lies outside the calibrated range of the response",
        "dead_pixel": "marked as bad by the frame correction",
        "frozen_frames": "the same counts in both bands for several frames, as while a shutter is "
        "closed: what stands still in them is read as signal",
        "object_jump": "the object jumped once: the jump was taken into its curve, the frames "
        "around it are left out, and the values that are given hold",
        "bands_apart": "the rapid changes of the bands are not simultaneous: a time offset "
        "between the cameras, or a reflection seen from two places",
        "roles_may_be_swapped": "mean emissivity below a half: a bright reflector, or what moves "
        "smoothly is the background, and object and background are exchanged",
        "not_converged": "the optimiser stopped at its limit of steps, or at no finite value",
    }
)
"""A sentence for each bit of `status`."""


def status_attrs() -> dict[str, object]:
    """
    CF attributes of a `status` variable.

    Returns
    -------
    dict
        `flag_masks` (uint32), `flag_meanings` (names, blank-separated), units and long_name.
    """
    return {
        **STAGES["separated"]["status"].attrs,
        "flag_masks": np.array(list(FLAGS.values()), dtype=np.uint32),
        "flag_meanings": " ".join(FLAGS),
    }


def check(dataset: xr.Dataset, stage: str) -> xr.Dataset:
    """
    Hold a dataset against its stage.

    A missing `units` attribute is taken as the agreed unit; a different one is an error.
    Values are not read, except those of coordinates and of variables without pixels.

    Parameters
    ----------
    dataset : Dataset
        What a stage hands on.
    stage : str
        One of `STAGES`.

    Returns
    -------
    Dataset
        The dataset itself, unchanged.

    Raises
    ------
    TypeError
        If it is not a Dataset, or a variable's dtype is not a real number.
    ValueError
        If a variable, dimension or coordinate is missing, misnamed or out of order, a unit is
        another one, a coordinate does not increase strictly, or bands repeat.
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


def check_variable(array: xr.DataArray, variable: Variable, what: str) -> None:
    """
    Hold one array against its definition; see `check`.

    Parameters
    ----------
    array : DataArray
        The array.
    variable : Variable
        What it must be.
    what : str
        Its name, for the error.

    Raises
    ------
    TypeError, ValueError
        As `check`.
    """
    if array.dims != variable.dims:
        raise ValueError(f"Invalid dims {array.dims} of {what}. Must be {variable.dims}.")
    if array.size == 0:
        raise ValueError(f"Empty {what}: sizes {dict(array.sizes)}. Must hold at least one value.")
    if array.dtype.kind not in "fui":
        raise TypeError(f"Invalid dtype {array.dtype} of {what}. Must be a real number.")
    units = array.attrs.get("units", variable.units)
    if units != variable.units:
        raise ValueError(f"Invalid units '{units}' of {what}. Must be '{variable.units}'.")
    for dim in array.dims:
        if dim == "band":
            _check_bands(array, what)
        elif dim in COORDINATES:
            _check_coordinate(array, str(dim), what)


def band_positions(array: xr.DataArray | xr.Dataset, wanted: list[str], what: str) -> list[int]:
    """
    Where each of some bands is, by its name as text.

    Parameters
    ----------
    array : DataArray or Dataset
        With a dimension `band`.
    wanted : list of str
        Names.
    what : str
        What it is, for the error.

    Returns
    -------
    list of int
        Positions on `band`, in the order of the names.

    Raises
    ------
    ValueError
        If there is no coordinate `band`, or a band is missing.
    """
    if "band" not in array.coords:
        raise ValueError(f"Missing coordinate 'band' of {what}. Must name each band.")
    names = [str(name) for name in np.atleast_1d(array["band"].values)]
    missing = [name for name in wanted if name not in names]
    if missing:
        raise ValueError(f"Missing band '{missing[0]}' in {what}. Has {names}.")
    return [names.index(name) for name in wanted]


def _check_bands(array: xr.DataArray, what: str) -> None:
    if "band" not in array.coords:
        raise ValueError(f"Missing coordinate 'band' of {what}. Must name each band.")
    names = [str(name) for name in array["band"].values]
    if len(set(names)) != len(names):
        raise ValueError(f"Repeated band in {names} of {what}. Each band must occur once.")


def _check_coordinate(array: xr.DataArray, dim: str, what: str) -> None:
    if dim not in array.coords:
        raise ValueError(f"Missing coordinate '{dim}' of {what}. Must be given.")
    coordinate, units = array[dim], COORDINATES[dim].units
    found = coordinate.attrs.get("units", units)
    if found != units:
        raise ValueError(f"Invalid units '{found}' of '{dim}' of {what}. Must be '{units}'.")
    if coordinate.dtype.kind not in "fui":
        raise TypeError(
            f"Invalid dtype {coordinate.dtype} of '{dim}' of {what}. Must be numbers in {units}."
        )
    values = coordinate.values.astype(np.float64)
    steps = np.diff(values)
    if not np.all(np.isfinite(values)):
        raise ValueError(f"Invalid '{dim}' of {what}: not finite. Must be finite.")
    if np.any(steps <= 0):
        place = int(np.argmax(steps <= 0))
        raise ValueError(
            f"Unordered '{dim}' of {what}: {values[place]} {units} is followed by "
            f"{values[place + 1]} {units}. Must increase strictly."
        )
