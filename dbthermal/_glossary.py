"""Definitions of the glossary: every variable of every stage, its dims, type, unit and meaning."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Any, Final


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

NOISE_FACTOR: Final = _of("band", "1", "noise over that before the alignment")
"""Variable `noise_factor`: by how much interpolation between frames has lessened the noise."""

PATTERN_STD: Final = _of("band", "count", "standard deviation of the residual fixed pattern")
"""Variable `pattern_std`: what the correction leaves from pixel to pixel, constant in time."""

SEGMENT: Final = _of("time", "1", "shutter events before the frame", "int32")
"""Variable `segment`: how often the offsets were renewed by a shutter event before the frame."""

STATUS: Final = _of("y x", "1", "validity flags, 0 is good", "uint32")

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
            "status": STATUS,
        },
        "separated": {
            "emissivity_covariance": _of(
                "band other_band y x", "1", "covariance of band emissivities", "float32"
            ),
            "noise": _of("band", "count", "noise, as used"),
            "bridged": _of("time y x", "1", "sample bridged in time, not measured", "bool"),
            "material": _of("y x", "1", "material, -1 for none", "int32"),
            "reflection_shift": _of("axis y x", "pixel", "shift of what is reflected", "float32"),
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

MEASURED: Final = "measured"
"""Attribute `origin` of what a real camera has recorded; of all else it begins otherwise."""


def origin(*attrs: Mapping[str, Any]) -> dict[str, str]:
    """Attribute `origin` of what is made of several inputs: simulated where one of them is.

    Parameters
    ----------
    attrs : mapping
        Attributes of each input. The result is empty if none of them states its origin.
    """
    stated = [str(mapping["origin"]) for mapping in attrs if "origin" in mapping]
    artificial = [text for text in stated if text != MEASURED]
    return {"origin": (artificial or stated)[0]} if stated else {}
