"""Readers of spectra: the ECOSTRESS, SLUM and MODIS UCSB libraries.

A spectrum is a Dataset with `emissivity` (wavelength) [1], wavelength [m] increasing, and in its
attributes what the library says of the sample (`NOTES`, empty where it is silent), the file's name
(`source`) and the number of values outside [0, 1] (`unphysical_values`). Those come from the
calibration of the library's spectrometers and are kept as they are. An emissivity outside
`schema.EMISSIVITY_LIMITS` is no measurement, but a wrong unit or a damaged file, and is refused.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np
import xarray as xr

from dbthermal import _text as texts
from dbthermal import schema
from dbthermal._arrays import Array

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
    r"""Spectrum of an ECOSTRESS (or ASTER) library file, ``*.spectrum.txt``.

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
    OSError
        If the file cannot be opened.
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
    ...     size = path.write_text("\n".join([*lines, ""]))
    ...     ecostress(path).emissivity.values.tolist()
    [0.96, 0.75, 0.9]
    """
    path = texts.as_path(path)
    lines = texts.whole_lines(texts.read_text(path, encoding="latin-1"), path.name)
    blank = next((i for i, line in enumerate(lines) if not line.strip()), len(lines))
    header = _header(lines[:blank], path)
    rows = [(i, line.split()) for i, line in enumerate(lines, 1) if i > blank and line.strip()]
    wavelength, reflectance = texts.numbers(rows, 2, path.name).T
    stated = {"Number of X Values": wavelength.size}
    stated |= {"First X Value": wavelength[0], "Last X Value": wavelength[-1]}
    for key, value in stated.items():
        declared = header.get(key, "")
        if not abs(texts.number(declared, f"{path.name}, {key}") - value) <= 1e-3:
            raise ValueError(
                f"Truncated or altered '{path.name}': {key} is {value:g}, declared '{declared}'. "
                "Must be equal."
            )
    notes = {note: header.get(key, "") for note, key in NOTES.items()}
    return _spectrum(wavelength, 1 - reflectance / 100, notes, _File(path.name, rows))


def slum(path: str | Path, *, reach: tuple[float, float] = (8.005, 13.99)) -> dict[str, xr.Dataset]:
    r"""Spectra of the Spectral Library of impervious Urban Materials, ``LUMA_SLUM_IR.csv``.

    Parameters
    ----------
    path : str or Path
        File with a column ``wavelength`` [micrometre], in steps that change little from one to the
        next, and one of emissivity [1] per sample.
    reach : tuple of float
        Wavelengths that the table must reach [micrometre], so that a file that was cut is refused;
        by default those of the library.

    Returns
    -------
    dict of str to Dataset
        Sample code, such as ``"A001"``, to a spectrum as `ecostress`.

    Raises
    ------
    OSError, ValueError
        As `ecostress`, or if the columns are not these, a row is short, missing or added, or the
        table does not reach so far.

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
    path = texts.as_path(path)
    titles, rows = _table(path)
    codes = titles[1:]
    if titles[0] != "wavelength" or not codes or len({*codes}) < len(codes):
        raise ValueError(
            f"Invalid columns {titles} in '{path.name}'. Must be 'wavelength' and distinct codes."
        )
    wavelength, *samples = texts.numbers(rows, len(titles), path.name).T
    notes, file = {"type": "manmade", "measurement": "emissivity"}, _File(path.name, rows, reach)
    return {
        code: _spectrum(wavelength, sample, notes | {"name": code, "sample_no": code}, file)
        for code, sample in zip(codes, samples, strict=True)
    }


def ucsb(path: str | Path, *, reach: tuple[float, float] = (3.665, 14.5)) -> xr.Dataset:
    r"""Spectrum, as `ecostress`, of the MODIS UCSB emissivity library in comma-separated columns.

    Parameters
    ----------
    path : str or Path
        File with columns ``x1`` wavelength [micrometre], ``x2`` wavenumber [1/cm] and ``y_<name>``
        emissivity [1], in steps as for `slum`.
    reach : tuple of float
        Wavelengths that the table must reach [micrometre], as for `slum`.

    Raises
    ------
    OSError, ValueError
        As `slum`, or if wavelength and wavenumber disagree by more than 0.1 %.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder, "water.csv")
    ...     size = path.write_text("x1,x2,y_water\n8.0,1250.0,0.985\n12.5,800.0,0.981\n")
    ...     ucsb(path, reach=(8.0, 12.5)).emissivity.values.tolist()
    [0.985, 0.981]
    """
    path = texts.as_path(path)
    titles, rows = _table(path)
    if titles[:2] != ["x1", "x2"] or not re.fullmatch("y_.+", ",".join(titles[2:])):
        raise ValueError(f"Invalid columns {titles} in '{path.name}'. Must be x1, x2, y_<name>.")
    wavelength, wavenumber, emissivity = texts.numbers(rows, 3, path.name).T
    file = _File(path.name, rows, reach)
    for i in np.flatnonzero(~(np.abs(wavelength * wavenumber / 1e4 - 1) <= 1e-3)):
        message = f"Invalid wavenumber {wavenumber[i]} 1/cm at {wavelength[i]} micrometres"
        raise ValueError(f"{file.at(i)}: {message}. Their product must be 10000.")
    notes = {"name": titles[2].removeprefix("y_"), "measurement": "emissivity"}
    return _spectrum(wavelength, emissivity, notes, file)


class _File(NamedTuple):
    """Name and rows of a table, and the wavelengths that it must reach [micrometre]."""

    name: str
    rows: Sequence[texts.Row]
    reach: tuple[float, float] | None = None

    def at(self, index: np.integer[Any]) -> str:
        """Place of a row in the file."""
        return texts.at(self.name, self.rows[int(index)][0])


def _header(lines: Sequence[str], path: Path) -> dict[str, str]:
    header: dict[str, str] = {}
    for number, line in enumerate(lines, 1):
        key, colon, text = line.partition(":")
        if not colon or key.strip() in header:
            rule = "Must be a key that is listed once, a colon and a text"
            place = texts.at(path.name, number)
            raise ValueError(f"{place}: Invalid header {texts.shown(line)}. {rule}.")
        header[key.strip()] = " ".join(text.split())
    for key, rule in _HEADER_RULES.items():
        if not re.search(rule, text := header.get(key, ""), re.IGNORECASE):
            raise ValueError(f"Invalid {key} '{text}' in '{path.name}'. Must match '{rule}'.")
    return header


def _table(path: Path) -> tuple[list[str], list[texts.Row]]:
    """Titles and rows of a table; the titles are empty if the file is."""
    (_, titles), *rows = texts.table_rows(texts.read_text(path), path.name) or [(1, [""])]
    return titles, rows


def _check_reach(wavelength: Array, reach: tuple[float, float], file: _File) -> None:
    """Raise ValueError if rows are missing, at the ends or between two others."""
    (low, high), (shortest, longest) = (wavelength.min(), wavelength.max()), reach
    if low > shortest or high < longest:
        raise ValueError(
            f"Truncated '{file.name}': wavelengths from {low:g} to {high:g} micrometres. "
            f"Must reach from {shortest:g} to {longest:g}, or as far as you say by reach=."
        )
    steps = np.abs(np.diff(1 / wavelength))
    if steps.size < 3:
        return
    # A missing row makes a step twice as long as those beside it, whatever the grid.
    neighbour = np.maximum(np.r_[steps[1], steps[:-1]], np.r_[steps[1:], steps[-2]])
    for i in np.flatnonzero(steps > 1.6 * neighbour) + 1:
        step = f"Uneven step to {wavelength[i]:g} micrometres, longer than those beside it"
        raise ValueError(f"{file.at(i)}: {step}. Must follow the row before: rows are missing.")


def _spectrum(
    wavelength: Array, emissivity: Array, notes: Mapping[str, str], file: _File
) -> xr.Dataset:
    """Dataset of a spectrum given over increasing or decreasing wavelength [micrometre]."""
    # Values in range, over wavelengths in order, without a missing row.
    name, (low, high) = f"'{notes['name']}' of '{file.name}'", schema.EMISSIVITY_LIMITS
    for quantity, values, lowest, highest in (
        ("wavelength", wavelength, 1e-3, 1e3),
        ("emissivity", emissivity, low, high),
    ):
        for i in np.flatnonzero(~((values >= lowest) & (values <= highest))):
            message = f"Invalid {quantity} {values[i]:g} in {name}"
            raise ValueError(f"{file.at(i)}: {message}. Must lie in [{lowest}, {highest}].")
    falling = wavelength[0] > wavelength[-1]
    for i in np.flatnonzero(np.diff(-wavelength if falling else wavelength) <= 0):
        message = f"{wavelength[i]:g} micrometres is followed by one not beyond it"
        rule = "Must increase or decrease strictly"
        raise ValueError(f"{file.at(i)}: Unordered wavelength in {name}: {message}. {rule}.")
    if file.reach is not None:
        _check_reach(wavelength, file.reach, file)
    # Spectrum over rising wavelengths.
    if falling:
        wavelength, emissivity = wavelength[::-1], emissivity[::-1]
    unphysical = int(np.sum((emissivity < 0) | (emissivity > 1)))
    attrs = {**dict.fromkeys(NOTES, ""), **notes, "source": file.name}
    coordinate = ("wavelength", wavelength * 1e-6, schema.COORDINATES["wavelength"].attrs)
    return xr.Dataset(
        schema.variables("spectrum", {"emissivity": emissivity}),
        {"wavelength": coordinate},
        {**attrs, "unphysical_values": unphysical},
    )
