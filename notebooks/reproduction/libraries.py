"""Readers of two libraries of spectra beside ECOSTRESS: SLUM and MODIS UCSB."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from dbthermal import _text as texts
from dbthermal._arrays import Array
from dbthermal.readers._spectra import spectrum

# Least and largest wavelength [micrometre] that a table must reach: a file that was cut is refused.
_SLUM, _UCSB = (8.005, 13.99), (3.665, 14.5)


def slum(path: str | Path) -> dict[str, xr.Dataset]:
    r"""Spectra of the Spectral Library of impervious Urban Materials, ``LUMA_SLUM_IR.csv``.

    A file with a column ``wavelength`` [micrometre], in steps that change little from one to the
    next, and one of emissivity [1] per sample. Maps the sample code, such as ``"A001"``, to a
    spectrum as `ecostress`.

    OSError or ValueError as `ecostress`, or if the columns are not these, a row is short, missing
    or added, or the table ends before those of the library.

    References
    ----------
    Kotthaus et al. (2014), Derivation of an urban materials spectral library through emittance and
    reflectance spectroscopy, ISPRS Journal of Photogrammetry and Remote Sensing 94, 194-212,
    doi:10.1016/j.isprsjprs.2014.05.005
    """
    path = texts.as_path(path)
    titles, rows = _table(path)
    codes = titles[1:]
    if titles[0] != "wavelength" or not codes or len({*codes}) < len(codes):
        rule = "Must be 'wavelength' and distinct codes"
        raise ValueError(f"Invalid columns {titles} in '{path.name}'. {rule}.")
    wavelength, *samples = texts.numbers(rows, len(titles), path.name).T
    notes, file = {"type": "manmade", "measurement": "emissivity"}, File(path.name, rows)
    return {
        code: _reaching(wavelength, sample, notes | {"name": code, "sample_no": code}, file, _SLUM)
        for code, sample in zip(codes, samples, strict=True)
    }


def ucsb(path: str | Path) -> xr.Dataset:
    r"""Spectrum, as `ecostress`, of the MODIS UCSB emissivity library in comma-separated columns.

    Columns ``x1`` wavelength [micrometre], ``x2`` wavenumber [1/cm] and ``y_<name>`` emissivity
    [1], in steps as for `slum`. OSError or ValueError as `slum`, or if wavelength and wavenumber
    disagree by more than 0.1 %.
    """
    path = texts.as_path(path)
    titles, rows = _table(path)
    if titles[:2] != ["x1", "x2"] or not re.fullmatch("y_.+", ",".join(titles[2:])):
        raise ValueError(f"Invalid columns {titles} in '{path.name}'. Must be x1, x2, y_<name>.")
    wavelength, wavenumber, emissivity = texts.numbers(rows, 3, path.name).T
    file = File(path.name, rows)
    for i in np.flatnonzero(~(np.abs(wavelength * wavenumber / 1e4 - 1) <= 1e-3)):
        message = f"Invalid wavenumber {wavenumber[i]} 1/cm at {wavelength[i]} micrometres"
        raise ValueError(f"{file.at(i)}: {message}. Their product must be 10000.")
    notes = {"name": titles[2].removeprefix("y_"), "measurement": "emissivity"}
    return _reaching(wavelength, emissivity, notes, file, _UCSB)


class File(NamedTuple):
    """Name and rows of a table."""

    name: str
    rows: list[texts.Row]

    def at(self, index: int | np.integer[Any]) -> str:
        """Place of a row in the file."""
        return texts.at(self.name, self.rows[int(index)][0])


def _table(path: Path) -> tuple[list[str], list[texts.Row]]:
    """Titles and rows of a table; the titles are empty if the file is."""
    (_, titles), *rows = texts.table_rows(texts.read_text(path), path.name) or [(1, [""])]
    return titles, rows


def _reaching(
    wavelength: Array,
    emissivity: Array,
    notes: Mapping[str, str],
    file: File,
    reach: tuple[float, float],
) -> xr.Dataset:
    """Spectrum of a table; ValueError if rows are missing, at the ends or between two others."""
    places = [file.at(i) for i in range(len(file.rows))]
    result = spectrum(wavelength, emissivity, notes, file.name, places)
    (low, high), (shortest, longest) = (wavelength.min(), wavelength.max()), reach
    if low > shortest or high < longest:
        raise ValueError(
            f"Truncated '{file.name}': wavelengths from {low:g} to {high:g} micrometres. "
            f"Must reach from {shortest:g} to {longest:g}."
        )
    steps = np.abs(np.diff(1 / wavelength))
    if steps.size < 3:
        return result
    # A missing row makes a step twice as long as those beside it, whatever the grid.
    neighbour = np.maximum(np.r_[steps[1], steps[:-1]], np.r_[steps[1:], steps[-2]])
    for i in np.flatnonzero(steps > 1.6 * neighbour) + 1:
        step = f"Uneven step to {wavelength[i]:g} micrometres, longer than those beside it"
        raise ValueError(f"{file.at(i)}: {step}. Must follow the row before: rows are missing.")
    return result
