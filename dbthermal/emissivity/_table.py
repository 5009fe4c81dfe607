"""Spectra to band emissivities: Planck-weighted averages, and a table of common materials."""

import csv
from collections.abc import Iterable, Mapping
from importlib import resources
from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import planck, schema
from dbthermal.bands import FILTERS, Band, get

Array = npt.NDArray[np.float64]

MINIMUM_COVERAGE: Final = 0.98
"""Share of a band's blackbody radiance that a spectrum must cover [1].

Of 993 library spectra 27 stop at 13.86 or 13.9 um, 0.981 to 0.986 of the band 8-14 um at 300 K,
where what is missing can change the average by 0.019 of its own difference from it; 22 stop at
12.5 um (0.781), whose average would be that of another band."""

_TABLE = "emissivity_table.csv"
_CAMERA_BAND = "8-14"
# Steps on which Planck's law is integrated beside those of the spectrum, and nodes in each.
_STEPS = 64
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(3)


def band_table(
    spectra: Mapping[str, xr.Dataset],
    bands: Mapping[str, Band] | Iterable[Band | str],
    temperature: float = 300.0,
    *,
    minimum_coverage: float = MINIMUM_COVERAGE,
) -> xr.Dataset:
    r"""
    Planck-weighted band emissivities of materials.

    .. math:: e_m = \frac{\int_m e(\lambda) L(\lambda, T) d\lambda}{\int_m L(\lambda, T) d\lambda}

    over the band's top hat, the spectrum taken as linear between its values. Where the spectrum
    does not cover the whole band both integrals run over what it covers, and `coverage` tells
    how much that is; nothing is extrapolated.

    Parameters
    ----------
    spectra : mapping of str to Dataset
        Material to stage `spectrum` of `schema`: `emissivity` (wavelength) [1], wavelength [m].
    bands : mapping or iterable of Band or str
        Bands, or names of `bands.FILTERS`.
    temperature : float
        Temperature of the material [K].
    minimum_coverage : float
        Share of the band's blackbody radiance that each spectrum must cover, in (0, 1].

    Returns
    -------
    Dataset
        Stage `emissivity_table`: `emissivity` (material, band) [1], `coverage` (material, band)
        [1], and `unphysical_values` (material, band), how many of the spectrum's values in the
        band lie outside (0, 1]. Those come from the libraries and are averaged as they are.

    Raises
    ------
    KeyError
        If a band's name is unknown.
    ValueError
        If there is no spectrum or no band, a band repeats, a spectrum is not as `schema` has it or
        holds NaN, the temperature is outside `bands.TEMPERATURE_RANGE`, or a spectrum covers less
        of a band than `minimum_coverage`.
    """
    chosen = require_bands(bands)
    if not isinstance(spectra, Mapping):
        raise TypeError(
            f"Invalid spectra of type {type(spectra).__name__}. Must map material to spectrum."
        )
    if not spectra:
        raise ValueError("Empty spectra. Must hold at least one material.")
    if not 0 < minimum_coverage <= 1:
        raise ValueError(f"Invalid minimum_coverage {minimum_coverage}. Must lie in (0, 1].")
    whole = [float(band.radiance(temperature)) for band in chosen]
    rows = np.empty((3, len(spectra), len(chosen)))
    for row, (material, spectrum) in enumerate(spectra.items()):
        wavelength, emissivity = _values(spectrum, material)
        for column, band in enumerate(chosen):
            covered = _covered(wavelength, band, temperature, whole[column])
            _require_coverage(covered, minimum_coverage, wavelength, material, band)
            mean = _average(wavelength, emissivity, band, temperature)
            rows[:, row, column] = mean, covered, _unphysical(wavelength, emissivity, band)
    table = _dataset(list(spectra), [band.name for band in chosen], rows[0], rows[1])
    counts = {"units": "1", "long_name": "values of the spectrum in the band outside (0, 1]"}
    return table.assign(
        unphysical_values=(("material", "band"), rows[2].astype(np.int64), counts)
    ).assign_attrs(temperature=float(temperature), minimum_coverage=minimum_coverage)


def embedded_table() -> xr.Dataset:
    """
    Table of 25 common materials that comes with the package.

    Rounded averages at 300 K over `bands.FILTERS`, made by `band_table` from three public
    libraries, which the head of ``emissivity_table.csv`` cites. The spectra themselves are not
    redistributed.

    Returns
    -------
    Dataset
        Stage `emissivity_table`: `emissivity` (material, band) [1] to 4 decimals and `coverage`
        (material, band) [1]: some metals and tiles were measured up to 12.5 um only. Coordinates
        `library` and `source` (material) name the library, and the file or sample in it.

    References
    ----------
    .. [1] Baldridge et al. (2009), Remote Sensing of Environment 113, 711,
       doi:10.1016/j.rse.2008.11.007
    .. [2] Meerdink et al. (2019), Remote Sensing of Environment 230, 111196,
       doi:10.1016/j.rse.2019.05.015
    .. [3] Kotthaus et al. (2014), ISPRS Journal of Photogrammetry and Remote Sensing 94, 194,
       doi:10.1016/j.isprsjprs.2014.05.005
    """
    text = resources.files("dbthermal").joinpath(_TABLE).read_text(encoding="utf-8")
    rows = list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))
    values = np.array([[float(row[name]) for name in FILTERS] for row in rows])
    # The four filters end at 12.35 um: every spectrum of the table covers them whole.
    coverage = np.ones_like(values)
    coverage[:, list(FILTERS).index(_CAMERA_BAND)] = [float(row["coverage_8_14"]) for row in rows]
    table = _dataset([row["material"] for row in rows], list(FILTERS), values, coverage)
    notes = {name: ("material", [row[name] for row in rows]) for name in ("library", "source")}
    return table.assign_coords(notes).assign_attrs(temperature=300.0)


def require_bands(bands: Mapping[str, Band] | Iterable[Band | str]) -> list[Band]:
    """
    Return bands given as such or by name, each once.

    Parameters
    ----------
    bands : mapping or iterable of Band or str
        Bands, or names of `bands.FILTERS`; of a mapping, its values.

    Returns
    -------
    list of Band
        The bands in their order.

    Raises
    ------
    KeyError
        If a name is unknown.
    TypeError
        If one is neither a band nor a name.
    ValueError
        If there is no band, or one repeats.
    """
    if isinstance(bands, (str, Band)):
        bands = [bands]
    given = list(bands.values()) if isinstance(bands, Mapping) else list(bands)
    odd = [band for band in given if not isinstance(band, (str, Band))]
    if odd:
        raise TypeError(f"Invalid band {odd[0]!r}. Must be a Band, or the name of a filter.")
    chosen = [get(band) if isinstance(band, str) else band for band in given]
    names = [band.name for band in chosen]
    if not chosen or len(set(names)) < len(names):
        raise ValueError(f"Invalid bands {names}. Must be at least one, each once.")
    return chosen


def _values(spectrum: xr.Dataset, material: str) -> tuple[Array, Array]:
    """Wavelength [m] and emissivity [1] of a spectrum, all finite."""
    try:
        values = schema.check(spectrum, "spectrum")["emissivity"]
    except (TypeError, ValueError) as error:
        error.add_note(f"In the spectrum of '{material}'.")
        raise
    emissivity = values.values.astype(np.float64)
    wavelength = values["wavelength"].values.astype(np.float64)
    bad = ~np.isfinite(emissivity)
    if bad.any():
        raise ValueError(
            f"Invalid emissivity {emissivity[bad][0]} of '{material}' at {wavelength[bad][0]} m. "
            "Must be finite."
        )
    lowest, highest = schema.EMISSIVITY_LIMITS
    bad = (emissivity < lowest) | (emissivity > highest)
    if bad.any():
        raise ValueError(
            f"Invalid emissivity {emissivity[bad][0]} of '{material}' at {wavelength[bad][0]} m. "
            f"Must lie in [{lowest}, {highest}]; it is a fraction, not per cent."
        )
    return wavelength, emissivity


def _overlap(wavelength: Array, band: Band) -> tuple[float, float]:
    """Edges [m] of what a spectrum covers of a band; upper <= lower where that is nothing."""
    return max(band.lower, float(wavelength[0])), min(band.upper, float(wavelength[-1]))


def _covered(wavelength: Array, band: Band, temperature: float, whole: float) -> float:
    """Share [1] of the band's blackbody radiance that a spectrum covers."""
    lower, upper = _overlap(wavelength, band)
    if upper <= lower:
        return 0.0
    if (lower, upper) == (band.lower, band.upper):
        return 1.0
    return float(Band(band.name, lower, upper).radiance(temperature)) / whole


def _require_coverage(
    covered: float, minimum: float, wavelength: Array, material: str, band: Band
) -> None:
    """Refuse a spectrum that is too short."""
    if covered < minimum:
        raise ValueError(
            f"Invalid coverage {covered:.4f} of band '{band.name}' by the spectrum of "
            f"'{material}', {wavelength[0]:.4g} to {wavelength[-1]:.4g} m. Must be at least "
            f"{minimum}; a lower minimum_coverage averages over what there is."
        )


def _average(wavelength: Array, emissivity: Array, band: Band, temperature: float) -> float:
    """Planck-weighted mean [1] of a piecewise linear spectrum, by Gauss's rule on each piece."""
    lower, upper = _overlap(wavelength, band)
    inside = wavelength[(wavelength > lower) & (wavelength < upper)]
    knots = np.union1d(np.linspace(lower, upper, _STEPS + 1), inside)
    half = 0.5 * np.diff(knots)[:, np.newaxis]
    nodes = knots[:-1, np.newaxis] + half * (1.0 + _NODES)
    weights = half * _WEIGHTS * planck.spectral_radiance(nodes, temperature)
    return float(np.sum(weights * np.interp(nodes, wavelength, emissivity)) / np.sum(weights))


def _unphysical(wavelength: Array, emissivity: Array, band: Band) -> int:
    """Count a spectrum's values in a band outside (0, 1]."""
    inside = (wavelength >= band.lower) & (wavelength <= band.upper)
    return int(np.sum(inside & ~((emissivity > 0) & (emissivity <= 1))))


def _dataset(materials: list[str], names: list[str], values: Array, coverage: Array) -> xr.Dataset:
    """Table in the stage's form."""
    stage, dims = schema.STAGES["emissivity_table"], ("material", "band")
    return xr.Dataset(
        {
            "emissivity": (dims, values, stage["emissivity"].attrs),
            "coverage": (dims, coverage, stage["coverage"].attrs),
        },
        coords={"material": materials, "band": names},
    )
