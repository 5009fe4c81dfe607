"""Reader of spectra, of the ECOSTRESS library.

Attributes say what the library says of the sample (`NOTES`, empty where it is silent). Values
outside [0, 1], of the calibration of its spectrometers, are kept within `schema.EMISSIVITY_LIMITS`.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import xarray as xr

from dbthermal import _text, schema
from dbthermal._arrays import Array

_KEYS: Final = (
    *("Name", "Type", "Class", "Subclass", "Genus", "Species"),
    *("Particle Size", "Sample No.", "Measurement", "Description"),
)
NOTES: Final = MappingProxyType({k.lower().replace(" ", "_").rstrip("."): k for k in _KEYS})
"""Attribute of a spectrum -> key in the header of an ECOSTRESS file."""

_HEADER_RULES: Final = {
    "Measurement": "hemispherical reflectance",
    "X Units": r"wavelength \(micrometers?\)",
    "Y Units": r"reflect[ae]nce \(percent(age)?\)",  # with the library's misspelling
}


def ecostress(path: str | Path) -> xr.Dataset:
    r"""Spectrum of an ECOSTRESS (or ASTER) library file, ``*.spectrum.txt``.

    The file gives the hemispherical reflectance R [%] of an opaque sample, so that by Kirchhoff's
    law its emissivity is 1 - R / 100. Header and values are compared: units, kind of measurement,
    number of values, first and last wavelength (Meerdink et al. 2019, Remote Sensing of Environment
    230, 111196, doi:10.1016/j.rse.2019.05.015).

    OSError or ValueError if it cannot be opened, is not as long as declared, is no hemispherical
    reflectance [%] over micrometres, has an emissivity outside `schema.EMISSIVITY_LIMITS`, or a
    wavelength outside 0.001 to 1000 um or out of order.

    Parameters
    ----------
    path : str or Path
        File in Latin-1, with either line end and either order of wavelengths.

    Returns
    -------
    Dataset
        `emissivity` (wavelength) [1] over wavelength [m]; attributes: what the library says of the
        sample (``name``, ``class``, ...), ``source`` and ``unphysical_values``.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> lines = ["Name: Window glass", "Measurement: Hemispherical reflectance"]
    >>> lines += ["X Units: Wavelength (micrometers)", "Y Units: Reflectance (percent)"]
    >>> lines += ["First X Value: 8.0", "Last X Value: 14.0", "Number of X Values: 3", ""]
    >>> lines += ["8.0 4.0", "9.5 25.0", "14.0 10.0"]  # wavelength [um], reflectance [%]
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder, "glass.spectrum.txt")
    ...     size = path.write_text("\n".join([*lines, ""]))
    ...     ecostress(path).emissivity.values.tolist()
    [0.96, 0.75, 0.9]
    """
    path = _text.as_path(path)
    lines = _text.whole_lines(_text.read_text(path, encoding="latin-1"), path.name)
    blank = next((i for i, line in enumerate(lines) if not line.strip()), len(lines))
    header = _header(lines[:blank], path)
    rows = [(i, line.split()) for i, line in enumerate(lines, 1) if i > blank and line.strip()]
    wavelength, reflectance = _text.numbers(rows, 2, path.name).T
    stated = {"Number of X Values": wavelength.size}
    stated |= {"First X Value": wavelength[0], "Last X Value": wavelength[-1]}
    for key, value in stated.items():
        declared = header.get(key, "")
        if not abs(_text.number(declared, f"{path.name}, {key}") - value) <= 1e-3:
            label = f"{key} is {value:g}, declared '{declared}'"
            raise ValueError(f"Truncated or altered '{path.name}': {label}. Must be equal.")
    notes = {note: header.get(key, "") for note, key in NOTES.items()}
    places = [_text.at(path.name, number) for number, _ in rows]
    return spectrum(wavelength, 1 - reflectance / 100, notes, path.name, places)


def _header(lines: Sequence[str], path: Path) -> dict[str, str]:
    header: dict[str, str] = {}
    for number, line in enumerate(lines, 1):
        key, colon, text = line.partition(":")
        if not colon or key.strip() in header:
            rule = "Must be a key that is listed once, a colon and a text"
            place = _text.at(path.name, number)
            raise ValueError(f"{place}: Invalid header {_text.shown(line)}. {rule}.")
        header[key.strip()] = " ".join(text.split())
    for key, rule in _HEADER_RULES.items():
        if not re.search(rule, text := header.get(key, ""), re.IGNORECASE):
            raise ValueError(f"Invalid {key} '{text}' in '{path.name}'. Must match '{rule}'.")
    return header


def spectrum(
    wavelength: Array, emissivity: Array, notes: Mapping[str, str], name: str, places: Sequence[str]
) -> xr.Dataset:
    """Dataset of a spectrum given over increasing or decreasing wavelength [micrometre]."""
    # Values in range, over wavelengths in order.
    label, limits = f"'{notes['name']}' of '{name}'", (1e-3, 1e3, *schema.EMISSIVITY_LIMITS)
    quantities = [("wavelength", wavelength, *limits[:2]), ("emissivity", emissivity, *limits[2:])]
    for quantity, values, lowest, highest in quantities:
        for i in np.flatnonzero(~((values >= lowest) & (values <= highest))):
            message = f"Invalid {quantity} {values[i]:g} in {label}"
            raise ValueError(f"{places[int(i)]}: {message}. Must lie in [{lowest}, {highest}].")
    falling = wavelength[0] > wavelength[-1]
    for i in np.flatnonzero(np.diff(-wavelength if falling else wavelength) <= 0):
        message = f"{wavelength[i]:g} micrometres is followed by one not beyond it"
        rule = "Must increase or decrease strictly"
        raise ValueError(f"{places[int(i)]}: Unordered wavelength in {label}: {message}. {rule}.")
    # Spectrum over rising wavelengths.
    if falling:
        wavelength, emissivity = wavelength[::-1], emissivity[::-1]
    attrs: dict[str, Any] = {**dict.fromkeys(NOTES, ""), **notes, "source": name}
    attrs["unphysical_values"] = int(np.sum((emissivity < 0) | (emissivity > 1)))
    axes = {"wavelength": ("wavelength", wavelength * 1e-6, schema.COORDINATES["wavelength"].attrs)}
    return xr.Dataset(schema.variables("spectrum", {"emissivity": emissivity}), axes, attrs)
