"""Readers of spectra: the ECOSTRESS, SLUM and MODIS UCSB libraries.

A spectrum is a Dataset with `emissivity` (wavelength) [1], wavelength [m] increasing, and in its
attributes what the library says of the sample (`NOTES`, empty where it is silent), the file's name
(`source`) and the number of values outside [0, 1] (`unphysical_values`). Those come from the
calibration of the library's spectrometers and are kept as they are. An emissivity outside
`schema.EMISSIVITY_LIMITS` is no measurement, but a wrong unit or a damaged file, and is refused.
"""

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from dbthermal import schema

Floats = NDArray[np.float64]

NOTES: Final = MappingProxyType(
    {
        "name": "Name",
        "type": "Type",
        "class": "Class",
        "subclass": "Subclass",
        "genus": "Genus",
        "species": "Species",
        "particle_size": "Particle Size",
        "sample_no": "Sample No.",
        "measurement": "Measurement",
        "description": "Description",
    }
)
"""Attribute of a spectrum -> key in the header of an ECOSTRESS file."""

_HEADER_RULES: Final = {
    "Measurement": "hemispherical reflectance",
    "X Units": r"wavelength \(micrometers?\)",
    "Y Units": r"reflect[ae]nce \(percent(age)?\)",  # with the library's misspelling
}


def ecostress(path: str | Path) -> xr.Dataset:
    r"""
    Spectrum of an ECOSTRESS (or ASTER) library file, ``*.spectrum.txt``.

    The file gives the hemispherical reflectance R [%] of an opaque sample, so that by Kirchhoff's
    law its emissivity is 1 - R / 100. Header and values are compared: units, kind of measurement,
    number of values, first and last wavelength.

    Parameters
    ----------
    path : str or Path
        File in Latin-1, with either line end and either order of wavelengths.

    Returns
    -------
    Dataset
        `emissivity` (wavelength) [1] over wavelength [m]; attributes: what the library says of the
        sample (``name``, ``class``, ...), ``source`` and ``unphysical_values``.

    Raises
    ------
    FileNotFoundError
        If the file does not exist.
    ValueError
        If it is truncated or longer than declared, is no hemispherical reflectance in percent over
        micrometres, an emissivity is outside `schema.EMISSIVITY_LIMITS`, or a wavelength is outside
        0.001 to 1000 um or out of order.

    References
    ----------
    Meerdink et al. (2019), The ECOSTRESS spectral library version 1.0, Remote Sensing of
    Environment 230, 111196, doi:10.1016/j.rse.2019.05.015

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
    ...     size = path.write_text("\n".join(lines))
    ...     ecostress(path).emissivity.values.tolist()
    [0.96, 0.75, 0.9]
    """
    path = Path(path)
    lines = path.read_text(encoding="latin-1").split("\n")
    blank = next((i for i, line in enumerate(lines) if not line.strip()), len(lines))
    header = _header(lines[:blank], path)
    rows = [line.split() for line in lines[blank:] if line.strip()]
    wavelength, reflectance = _columns(rows, 2, path)
    _check_extent(header, wavelength, path)
    notes = {note: header.get(key, "") for note, key in NOTES.items()}
    return _spectrum(wavelength, 1 - reflectance / 100, notes, path)


def slum(path: str | Path) -> dict[str, xr.Dataset]:
    r"""
    Spectra of the Spectral Library of impervious Urban Materials, ``LUMA_SLUM_IR.csv``.

    Parameters
    ----------
    path : str or Path
        File with a column ``wavelength`` [micrometre] and one of emissivity [1] per sample.

    Returns
    -------
    dict of str to Dataset
        Sample code, such as ``"A001"``, to a spectrum as `ecostress`.

    Raises
    ------
    FileNotFoundError
        If the file does not exist.
    ValueError
        If the columns are not these, a row is short, or a value is refused as by `ecostress`.

    References
    ----------
    Kotthaus et al. (2014), Derivation of an urban materials spectral library through emittance and
    reflectance spectroscopy, ISPRS Journal of Photogrammetry and Remote Sensing 94, 194-212,
    doi:10.1016/j.isprsjprs.2014.05.005

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder, "LUMA_SLUM_IR.csv")
    ...     size = path.write_text("wavelength,A001,A002\n8.0,0.93,0.89\n14.0,0.95,0.97\n")
    ...     slum(path)["A002"].emissivity.values.tolist()
    [0.89, 0.97]
    """
    path = Path(path)
    titles, rows = _table(path)
    codes = titles[1:]
    if titles[0] != "wavelength" or not codes or len({*codes}) < len(codes):
        raise ValueError(
            f"Invalid columns {titles} in '{path.name}'. Must be 'wavelength' and distinct codes."
        )
    wavelength, *samples = _columns(rows, len(titles), path)
    notes = {"type": "manmade", "measurement": "emissivity"}
    return {
        code: _spectrum(wavelength, sample, notes | {"name": code, "sample_no": code}, path)
        for code, sample in zip(codes, samples, strict=True)
    }


def ucsb(path: str | Path) -> xr.Dataset:
    r"""
    Spectrum of the MODIS UCSB emissivity library, converted to comma-separated columns.

    Parameters
    ----------
    path : str or Path
        File with columns ``x1`` wavelength [micrometre], ``x2`` wavenumber [1/cm] and ``y_<name>``
        emissivity [1].

    Returns
    -------
    Dataset
        A spectrum as `ecostress`.

    Raises
    ------
    FileNotFoundError
        If the file does not exist.
    ValueError
        If the columns are not these, wavelength and wavenumber disagree by more than 0.1 %, or a
        value is refused as by `ecostress`.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder, "water.csv")
    ...     size = path.write_text("x1,x2,y_water\n8.0,1250.0,0.985\n12.5,800.0,0.981\n")
    ...     ucsb(path).emissivity.values.tolist()
    [0.985, 0.981]
    """
    path = Path(path)
    titles, rows = _table(path)
    if titles[:2] != ["x1", "x2"] or not re.fullmatch("y_.+", ",".join(titles[2:])):
        raise ValueError(f"Invalid columns {titles} in '{path.name}'. Must be x1, x2, y_<name>.")
    wavelength, wavenumber, emissivity = _columns(rows, 3, path)
    wrong = np.abs(wavelength * wavenumber / 1e4 - 1) > 1e-3
    if wrong.any():
        raise ValueError(
            f"Invalid wavenumber {wavenumber[wrong][0]} 1/cm at {wavelength[wrong][0]} micrometres "
            f"in '{path.name}'. Their product must be 10000."
        )
    notes = {"name": titles[2].removeprefix("y_"), "measurement": "emissivity"}
    return _spectrum(wavelength, emissivity, notes, path)


def _header(lines: Sequence[str], path: Path) -> dict[str, str]:
    pairs = (line.partition(":") for line in lines)
    header = {key.strip(): " ".join(text.split()) for key, _, text in pairs}
    for key, rule in _HEADER_RULES.items():
        if not re.search(rule, header.get(key, ""), re.IGNORECASE):
            raise ValueError(
                f"Invalid {key} '{header.get(key, '')}' in '{path.name}'. Must match '{rule}'."
            )
    return header


def _check_extent(header: Mapping[str, str], wavelength: Floats, path: Path) -> None:
    """Compare the values with the number and the ends that the header declares."""
    actual = {
        "Number of X Values": wavelength.size,
        "First X Value": wavelength[0],
        "Last X Value": wavelength[-1],
    }
    for key, value in actual.items():
        declared = header.get(key, "")
        if not re.fullmatch(r"[0-9.]+", declared) or abs(float(declared) - value) > 1e-3:
            raise ValueError(
                f"Truncated or altered '{path.name}': {key} is {value:g}, declared '{declared}'. "
                "Must be equal."
            )


def _table(path: Path) -> tuple[list[str], list[list[str]]]:
    with path.open(encoding="utf-8", newline="") as file:
        titles, *rows = [*csv.reader(file)] or [[""]]
    return titles, rows


def _columns(rows: Sequence[Sequence[str]], width: int, path: Path) -> Iterator[Floats]:
    """Yield the columns of rows that must all be `width` numbers."""
    for row in rows:
        if len(row) != width:
            raise ValueError(f"Invalid row {list(row)} in '{path.name}'. Must be {width} numbers.")
    if not rows:
        raise ValueError(f"Empty table in '{path.name}'. Must hold at least one row.")
    try:
        yield from np.array(rows, dtype=np.float64).T
    except ValueError as error:
        raise ValueError(f"Invalid value in '{path.name}': {error}. Must be numbers.") from error


def _spectrum(
    wavelength: Floats, emissivity: Floats, notes: Mapping[str, str], path: Path
) -> xr.Dataset:
    """Dataset of a spectrum given over increasing or decreasing wavelength [micrometre]."""
    name, (low, high) = f"'{notes['name']}' of '{path.name}'", schema.EMISSIVITY_LIMITS
    for quantity, values, least, most in (
        ("wavelength", wavelength, 1e-3, 1e3),
        ("emissivity", emissivity, low, high),
    ):
        wrong = ~((values >= least) & (values <= most))
        if wrong.any():
            raise ValueError(
                f"Invalid {quantity} {values[wrong][0]:g} in {name}. Must lie in [{least}, {most}]."
            )
    if wavelength[0] > wavelength[-1]:
        wavelength, emissivity = wavelength[::-1], emissivity[::-1]
    if np.any(still := np.diff(wavelength, append=np.inf) <= 0):
        raise ValueError(
            f"Unordered wavelength in {name}: {wavelength[still][0]:g} micrometres is followed by "
            "one not beyond it. Must increase or decrease strictly."
        )
    unphysical = int(np.sum((emissivity < 0) | (emissivity > 1)))
    attrs = {**dict.fromkeys(NOTES, ""), **notes, "source": path.name}
    variable = schema.STAGES["spectrum"]["emissivity"]
    coordinate = schema.COORDINATES["wavelength"]
    return xr.Dataset(
        {"emissivity": ("wavelength", emissivity, variable.attrs)},
        {"wavelength": ("wavelength", wavelength * 1e-6, coordinate.attrs)},
        {**attrs, "unphysical_values": unphysical},
    )
