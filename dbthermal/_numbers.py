"""Strict numbers: text, truth values, durations, complex numbers and objects are refused by name.

A unit in brackets in the name, as in "temperature [K]", is the one that values must have if they
state one, as a DataArray does. A wrong type is a TypeError, a wrong value a ValueError.
"""

from typing import Any, Final

import numpy as np
import numpy.typing as npt

from dbthermal._arrays import Array

Limits = tuple[float, float]

# Limits, and what a value beyond is told.
POSITIVE: Final = (np.nextafter(0.0, 1.0), np.finfo(np.float64).max)
FINITE: Final = (-1e9, 1e9)  # counts or kelvin that a detector may have
KELVIN: Final = (150.0, 3000.0)  # temperature [K]
FRACTION: Final = (POSITIVE[0], np.nextafter(1.0, 0.0))  # neither 0 nor 1
NETD: Final = (POSITIVE[0], 5.0)  # [K]; thermopile arrays have 1 K, the quietest cameras 10 mK
WAVELENGTH: Final = (POSITIVE[0], 0.3)  # [m] of a radiometer, up to microwaves of 1 GHz
_RULES: Final = {
    POSITIVE: "be finite and positive",
    KELVIN: f"lie in {[*KELVIN]}: in kelvin, not in degrees Celsius or counts",
    FRACTION: "lie in (0, 1)",
    NETD: f"be finite and positive, at most {NETD[1]}: in kelvin, not in millikelvin",
    WAVELENGTH: f"be finite and positive, at most {WAVELENGTH[1]}: in metres, not in micrometres",
}


def real_numbers(
    name: str, value: Any, within: Limits | None = None, shape: tuple[int, ...] | None = None
) -> Array:
    """Value as a float array, of a shape and within limits if they are given."""
    try:
        raw = np.asarray(value)
    except (TypeError, ValueError) as error:  # of a Dataset, or of rows of several lengths
        kind = type(value).__name__
        raise TypeError(f"Invalid {name} of type {kind}. Must be numbers in equal rows.") from error
    if raw.dtype.kind not in "fui":
        (first,) = raw.reshape(-1)[:1].tolist() or [value]
        kind = type(first).__name__
        raise TypeError(f"Invalid {name} {first!r:.60}. Must be a number, not of type {kind}.")
    unit = name.partition("[")[2].partition("]")[0].replace("^", "")
    stated = getattr(value, "attrs", {}).get("units", unit)
    if unit and str(stated).replace("^", "") != unit:
        raise ValueError(f"Invalid units '{stated}' of {name}. Must be '{unit}'.")
    if shape not in (None, raw.shape):
        raise ValueError(f"Invalid {name} {value!s:.60} of shape {raw.shape}. Must have {shape}.")
    array = raw.astype(np.float64, copy=False)
    if within and np.any(bad := ~((array >= within[0]) & (array <= within[1]))):
        rule = _RULES.get(within, f"lie in {[*within]}")
        raise ValueError(f"Invalid {name} {raw[bad].flat[0]}. Must {rule}.")
    return array


def real_number(name: str, value: npt.ArrayLike, within: Limits | None = None) -> float:
    """Value as one float."""
    return float(real_numbers(name, value, within, ()))


def whole_number(name: str, value: int, within: tuple[int, int]) -> int:
    """Value as an int; a float is refused, be it whole."""
    real_number(name, value, within)
    if not isinstance(value, int | np.integer):
        raise TypeError(f"Invalid {name} {value}. Must be a whole number.")
    return int(value)


def truth_value(name: str, value: Any) -> bool:
    """Value as True or False."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"Invalid {name} {value!r:.60}. Must be True or False.")
    return bool(value)
