"""Band emissivities of materials, and the two bands that tell emission from reflection best.

Spectra become a table of Planck-weighted band averages (`band_table`; `embedded_table` holds 25
common materials). From a table follow the condition number of the mixing matrix for each pair of
bands and the filter to set beside the camera's own band (`rank_filters`), by the criteria of the
supplement of Narayanan et al. (2026), doi:10.48550/arXiv.2509.11334, and by the noise.
"""

from collections.abc import Iterable, Mapping
from importlib import resources
from typing import Final

import numpy as np
import xarray as xr

from dbthermal import _text as texts
from dbthermal import mixing, planck, schema
from dbthermal._arrays import Array
from dbthermal.bands import FILTERS, Band, get

__all__ = [
    "CAMERA_BAND",
    "MINIMUM_COVERAGE",
    "band_table",
    "condition_numbers",
    "embedded_table",
    "filter_noise",
    "library_mixture",
    "pair_summary",
    "rank_filters",
]
__dir__ = __all__.copy

Bands = Mapping[str, Band] | Iterable[Band | str]

CAMERA_BAND: Final = "8-14"
"""Name of the band of the camera without a filter."""

MINIMUM_COVERAGE: Final = 0.98
"""Share of a band's blackbody radiance that a spectrum must cover [1].

Of 993 library spectra 27 stop at 13.86 or 13.9 um, 0.981 to 0.986 of the band 8-14 um at 300 K,
where what is missing can change the average by 0.019 of its own difference from it; 22 stop at
12.5 um (0.781), whose average would be that of another band."""

_TABLE = "emissivity_table.csv"
_MIXTURE = "emissivity_mixture.csv"
# Share of the materials that are none of the libraries' [1], and what is known of them: mean and
# standard deviation of an emissivity, and its correlation between two bands.
_OTHERS = (0.05, 0.7, 0.25, 0.9)
# Steps on which Planck's law is integrated beside those of the spectrum, and nodes in each.
_STEPS = 64
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(3)


def band_table(
    spectra: Mapping[str, xr.Dataset],
    bands: Bands,
    temperature: float = 300.0,
    *,
    minimum_coverage: float = MINIMUM_COVERAGE,
) -> xr.Dataset:
    r"""Planck-weighted band emissivities of materials.

    .. math:: e_m = \frac{\int_m e(\lambda) L(\lambda, T) d\lambda}{\int_m L(\lambda, T) d\lambda}

    over the band's top hat, the spectrum taken as linear between its values. Where the spectrum
    does not cover the whole band both integrals run over the covered part, whose share is
    `coverage`; nothing is extrapolated.

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
        Stage `emissivity_table`: `emissivity` and `coverage` (material, band) [1]. Values of the
        libraries' spectra outside (0, 1] are averaged as they are.

    Raises
    ------
    KeyError
        If a band's name is unknown.
    TypeError
        If the spectra are no mapping, or a band is neither a Band nor a name.
    ValueError
        If there is no spectrum or no band, a band repeats, a spectrum is not as `schema` has it or
        holds NaN, the temperature is outside `bands.TEMPERATURE_RANGE`, or a spectrum covers less
        of a band than `minimum_coverage`.

    Examples
    --------
    >>> import xarray as xr
    >>> wavelength = ("wavelength", [7e-6, 9e-6, 15e-6], {"units": "m"})
    >>> spectrum = xr.Dataset(
    ...     {"emissivity": ("wavelength", [0.9, 0.6, 0.9])}, {"wavelength": wavelength}
    ... )
    >>> table = band_table({"quartz": spectrum}, ["8-14", "9.5"])
    >>> table.emissivity.sel(material="quartz").values.round(3).tolist()
    [0.711, 0.625]
    """
    chosen = _require_bands(bands)
    if not isinstance(spectra, Mapping):
        raise TypeError(
            f"Invalid spectra of type {type(spectra).__name__}. Must map material to spectrum."
        )
    if not spectra:
        raise ValueError("Empty spectra. Must hold at least one material.")
    if not 0 < minimum_coverage <= 1:
        raise ValueError(f"Invalid minimum_coverage {minimum_coverage}. Must lie in (0, 1].")
    whole = [float(band.radiance(temperature)) for band in chosen]
    rows = np.empty((2, len(spectra), len(chosen)))
    for row, (material, spectrum) in enumerate(spectra.items()):
        wavelength, emissivity = _values(spectrum, material)
        for column, band in enumerate(chosen):
            covered = _covered(wavelength, band, temperature, whole[column])
            _require_coverage(covered, minimum_coverage, wavelength, material, band)
            rows[:, row, column] = _average(wavelength, emissivity, band, temperature), covered
    table = _dataset(list(spectra), [band.name for band in chosen], *rows)
    return table.assign_attrs(temperature=float(temperature), minimum_coverage=minimum_coverage)


def embedded_table() -> xr.Dataset:
    """Table of 25 common materials that comes with the package.

    Rounded averages at 300 K over `bands.FILTERS`, made by `band_table` from three public libraries
    [1]_ [2]_ [3]_, whose spectra are not redistributed.

    Returns
    -------
    Dataset
        Stage `emissivity_table`: `emissivity` and `coverage` (material, band) [1]; some metals and
        tiles were measured up to 12.5 um only. Coordinates `library` and `source` (material) name
        the library, and the file or sample in it.

    References
    ----------
    .. [1] Baldridge et al. (2009), doi:10.1016/j.rse.2008.11.007
    .. [2] Meerdink et al. (2019), doi:10.1016/j.rse.2019.05.015
    .. [3] Kotthaus et al. (2014), doi:10.1016/j.isprsjprs.2014.05.005

    Examples
    --------
    >>> embedded_table().emissivity.sel(material="plate window glass", band="9.5").item()
    0.718
    """
    with resources.as_file(resources.files("dbthermal").joinpath(_TABLE)) as path:
        rows = texts.table_rows(texts.read_text(path), _TABLE, comment="#")
    (_, titles), *rows = rows
    names = ["material", "library", "source"]
    if titles != [*names, *FILTERS, "coverage_8_14"]:
        raise ValueError(f"Invalid columns {titles} of '{_TABLE}'. Must be those of the filters.")
    values = texts.numbers([(line, row[3:]) for line, row in rows], len(FILTERS) + 1, _TABLE)
    # The four filters end at 12.35 um: every spectrum of the table covers them whole.
    coverage = np.ones_like(values[:, :-1])
    coverage[:, list(FILTERS).index(CAMERA_BAND)] = values[:, -1]
    table = _dataset([row[0] for _, row in rows], list(FILTERS), values[:, :-1], coverage)
    notes = {name: ("material", [row[i] for _, row in rows]) for i, name in enumerate(names) if i}
    return table.assign_coords(notes).assign_attrs(temperature=300.0)


def library_mixture(bands: Iterable[str]) -> xr.Dataset:
    r"""Joint distribution of the band emissivities of materials, where nothing is known of them.

    A mixture of normal distributions over the 993 spectra of the libraries of `embedded_table`,
    with a wide component for the one material in twenty that is assumed to be none of theirs,

    .. math:: p(e) = \sum_k w_k N(e; \mu_k, C_k)

    Parameters
    ----------
    bands : iterable of str
        Names of `bands.FILTERS`, in the order that is wanted.

    Returns
    -------
    Dataset
        `weight` (component) [1], `mean` (component, band) [1], `covariance` (component, band,
        other) [1].

    Raises
    ------
    ValueError
        If a band is none of the filters, or repeats.

    Examples
    --------
    >>> mixture = library_mixture(["8-14", "9.5"])
    >>> float((mixture["weight"] * mixture["mean"].sel(band="9.5")).sum().round(2))
    0.87
    """
    names = [str(band) for band in bands]
    unknown = [name for name in names if name not in FILTERS]
    if unknown or len(set(names)) < len(names):
        raise ValueError(
            f"Invalid bands {names} of the library's emissivities. Must be of {list(FILTERS)}, "
            "each once; of other bands give a prior on the emissivities."
        )
    with resources.as_file(resources.files("dbthermal").joinpath(_MIXTURE)) as path:
        (_, titles), *rows = texts.table_rows(texts.read_text(path), _MIXTURE, comment="#")
    count = len(FILTERS)
    values = texts.numbers(rows, len(titles), _MIXTURE)
    covariance = np.zeros((len(values), count, count))
    i, j = np.tril_indices(count)
    covariance[:, i, j] = covariance[:, j, i] = values[:, 1 + count :]
    places = [list(FILTERS).index(name) for name in names]
    share, mean, std, shared = _OTHERS
    wide = std**2 * (shared + (1.0 - shared) * np.eye(len(names)))
    means = values[:, 1 : 1 + count][:, places]
    weight = np.append(values[:, 0] / values[:, 0].sum() * (1.0 - share), share)
    return xr.Dataset(
        {
            "weight": ("component", weight),
            "mean": (("component", "band"), np.vstack([means, np.full(len(names), mean)])),
            "covariance": (
                ("component", "band", "other"),
                np.concatenate([covariance[:, places][:, :, places], wide[np.newaxis]]),
            ),
        },
        coords={"band": names, "other": names},
    )


def condition_numbers(table: xr.Dataset) -> xr.DataArray:
    """Condition number of the mixing matrix for each material and pair of bands.

    Parameters
    ----------
    table : Dataset
        Stage `emissivity_table`, of at least two bands.

    Returns
    -------
    DataArray
        Condition numbers (material, first, second) [1], symmetric; infinite on the diagonal and
        where the two emissivities are equal. See `mixing.condition_number`.

    Raises
    ------
    TypeError, ValueError
        If the table is not as `schema` has it, or has one band only.

    Examples
    --------
    >>> numbers = condition_numbers(embedded_table()).sel(first="8-14", second="9.5")
    >>> numbers.sel(material=["plate window glass", "water"]).values.round(1).tolist()
    [9.4, 649.2]
    """
    values = schema.check(table, "emissivity_table")["emissivity"]
    names = values["band"].values
    if len(names) < 2:
        raise ValueError(f"Invalid bands {names.tolist()} of the table. Must be at least two.")
    first, second = np.broadcast_arrays(values.values[:, :, None], values.values[:, None, :])
    return xr.DataArray(
        mixing.condition_number(np.stack([first, second], axis=-1)),
        coords={"material": values["material"].values, "first": names, "second": names},
        dims=("material", "first", "second"),
        name="condition_number",
        attrs={"units": "1", "long_name": "condition number of the mixing matrix"},
    )


def pair_summary(numbers: xr.DataArray) -> xr.Dataset:
    """Condition number of each pair of bands, over the materials.

    Parameters
    ----------
    numbers : DataArray
        Condition numbers (material, first, second) [1], from `condition_numbers`.

    Returns
    -------
    Dataset
        `median` and `mean` (first, second) [1], and `finite` (first, second), the number of
        materials in the mean. A gray material counts in the median as infinite and not in the mean,
        which a few nearly gray ones govern: choose by the median. Both are infinite where every
        material is gray, as on the diagonal.

    Examples
    --------
    >>> summary = pair_summary(condition_numbers(embedded_table()))
    >>> summary["median"].sel(first="8-14", second=["9.5", "10.6"]).values.round(1).tolist()
    [110.7, 342.3]
    """
    finite = numbers.copy(data=np.isfinite(numbers.values))
    count = finite.sum("material")
    total = numbers.where(finite, 0.0).sum("material")
    parts = {
        "median": (numbers.median("material", skipna=False), "condition number, median"),
        "mean": ((total / count.where(count > 0, 1)).where(count > 0, np.inf), "its finite mean"),
        "finite": (count, "materials with a finite condition number"),
    }
    attrs = {name: {"units": "1", "long_name": meaning} for name, (_, meaning) in parts.items()}
    return xr.Dataset({name: part.assign_attrs(attrs[name]) for name, (part, _) in parts.items()})


def filter_noise(netd: float, bands: Bands, temperature: float = 300.0) -> xr.DataArray:
    r"""Noise (band) [K] of a camera behind filters, from its noise without one.

    The noise in counts is the camera's own and does not change, while a kelvin gives fewer counts:

    .. math:: s_m = s_1 \frac{dB_1 / dT}{dB_m / dT}

    with the first of the bands as the camera's own. A filter's emission and losses are left out.

    Parameters
    ----------
    netd : float
        Noise-equivalent temperature difference in the first band [K].
    bands : mapping or iterable of Band or str
        Bands, or names of `bands.FILTERS`; the first is the one that `netd` belongs to.
    temperature : float
        Temperature of the object [K].

    Returns
    -------
    DataArray
        Noise (band) [K].

    Raises
    ------
    KeyError, TypeError, ValueError
        If a band is unknown or repeats, or `netd` or the temperature is out of range.

    Examples
    --------
    >>> filter_noise(0.04, ["8-14", "9.5", "10.6"]).values.round(3).tolist()  # [K]
    [0.04, 0.398, 0.15]
    """
    chosen = _require_bands(bands)
    netd = float(planck.require_positive("netd [K]", netd))
    slopes = np.array([float(band.slope(temperature)) for band in chosen])
    return xr.DataArray(
        netd * slopes[0] / slopes,
        coords={"band": [band.name for band in chosen]},
        dims="band",
        name="noise",
        attrs={"units": "K", "long_name": "noise-equivalent temperature difference"},
    )


def rank_filters(
    table: xr.Dataset, noise: xr.DataArray, *, beside: str = CAMERA_BAND
) -> xr.Dataset:
    """Filters to set beside a band, best conditioned first, by two criteria.

    The paper takes the filter of the lowest condition number (its section 5 says highest, a slip;
    its supplement says lowest) and notes the trade-off with the noise that a narrow filter brings.
    The second criterion settles it: the standard deviation of the object temperature from one
    frame. Both are medians over the materials, for a few nearly gray materials govern any mean.

    Parameters
    ----------
    table : Dataset
        Stage `emissivity_table`.
    noise : DataArray
        Noise (band) [K] of every band of the table, such as from `filter_noise`.
    beside : str
        Name of the camera's own band.

    Returns
    -------
    Dataset
        Each (band), in the order of the first: `condition_number` [1]; `condition_number_mean` [1],
        over the materials where it is finite; `object_temperature_std` [K]; `noise` [K]. Attributes
        `lowest_condition_number` and `lowest_std` name the filter of each criterion.

    Raises
    ------
    TypeError, ValueError
        If the table is not as `schema` has it or has no band `beside` and another, or the noise
        lacks a band, is in another unit, or is not finite and positive.

    Examples
    --------
    >>> ranked = rank_filters(embedded_table(), filter_noise(0.04, FILTERS))
    >>> ranked.band.values.tolist()
    ['9.5', '12.1', '8.5', '10.6']
    >>> ranked.object_temperature_std.values.round(2).tolist()  # [K]
    [1.26, 2.34, 1.85, 2.25]
    """
    std = _single_frame_std(table, noise, beside).median("material", skipna=False)
    pairs = pair_summary(condition_numbers(table)).sel(first=beside, drop=True)
    pairs = pairs.rename(second="band").sel(band=std["band"])
    result = xr.Dataset(
        {
            "condition_number": pairs["median"],
            "condition_number_mean": pairs["mean"],
            "object_temperature_std": std.assign_attrs(units="K", long_name="median of its std"),
            "noise": noise.sel(band=std["band"]).assign_attrs(units="K"),
        }
    ).sortby("condition_number")
    names = [str(name) for name in result["band"].values]
    return result.assign_attrs(
        beside=beside,
        lowest_condition_number=names[0],
        lowest_std=names[int(np.argmin(result["object_temperature_std"].values))],
    )


def _require_bands(bands: Bands) -> list[Band]:
    """Bands, each once, from bands or names of `bands.FILTERS`; of a mapping, its values."""
    if isinstance(bands, (str, Band)):
        bands = [bands]
    listed = list(bands.values()) if isinstance(bands, Mapping) else list(bands)
    odd = [band for band in listed if not isinstance(band, (str, Band))]
    if odd:
        raise TypeError(f"Invalid band {odd[0]!r}. Must be a Band, or the name of a filter.")
    chosen = [get(band) if isinstance(band, str) else band for band in listed]
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
    """Edges [m] of the part of a band that a spectrum covers; upper <= lower if it has none."""
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
            f"{minimum}; a lower minimum_coverage averages over the covered part."
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


def _single_frame_std(table: xr.Dataset, noise: xr.DataArray, beside: str) -> xr.DataArray:
    r"""Standard deviation [K] of the object temperature from one frame (material, band).

    For each band m beside band 1, emissivities known, in the linear approximation,
    :math:`\mathrm{var}(x) = [(1 - e_m)^2 s_1^2 + (1 - e_1)^2 s_m^2] / (e_1 - e_m)^2`; infinite for
    equal emissivities.
    """
    values = schema.check(table, "emissivity_table")["emissivity"]
    names = [str(name) for name in values["band"].values]
    if beside not in names or len(names) < 2:
        raise ValueError(f"Invalid bands {names}. Must hold '{beside}' and at least one more.")
    if np.any(np.isinf(values)):
        raise ValueError("Invalid emissivity of the table: infinite. Must be finite, or NaN.")
    std = planck.require_positive("noise [K]", schema.band_values(noise, names, "the noise", "K"))
    others = [name for name in names if name != beside]
    camera, filtered = values.sel(band=beside).values[:, np.newaxis], values.sel(band=others).values
    noises = std[names.index(beside)], std[[names.index(name) for name in others]]
    error = np.hypot((1 - filtered) * noises[0], (1 - camera) * noises[1])
    contrast = np.abs(camera - filtered)
    return xr.DataArray(
        np.divide(error, contrast, out=np.full_like(error, np.inf), where=contrast > 0),
        coords={"material": values["material"].values, "band": others},
        dims=("material", "band"),
        name="object_temperature_std",
        attrs={"units": "K", "long_name": "standard deviation of the object temperature"},
    )
