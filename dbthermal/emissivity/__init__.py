"""Band emissivities of materials, and the two bands that tell emission from reflection best.

Spectra become a table of Planck-weighted band averages (`band_table`; `embedded_table` holds 25
common materials); `limits.plan` chooses the filter to set beside the camera's own band, by the
noise behind it (`filter_noise`). A colour of what is mirrored is seen in foil (`background_ratio`).
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any, Final

import numpy as np
import xarray as xr

from dbthermal import _numbers, _text, planck, schema
from dbthermal._arrays import Array
from dbthermal.bands import FILTERS, Band, get

__all__ = [
    "CAMERA_BAND",
    "MINIMUM_COVERAGE",
    "background_ratio",
    "band_table",
    "embedded_table",
    "filter_noise",
    "library_mixture",
]
__dir__ = __all__.copy

Bands = Mapping[str, Band] | Iterable[Band | str]

CAMERA_BAND: Final = "8-14"
"""Name of the band of the camera without a filter."""

MINIMUM_COVERAGE: Final = 0.98
"""Share of a band's blackbody radiance that a spectrum must cover [1].

Library spectra that stop at 13.86 um cover 0.981 of 8-14 um, and the rest can change their average
by 0.019 of its difference from it; others stop at 12.5 um (0.781)."""

_TABLE = "emissivity_table.csv"
_MIXTURE = "emissivity_mixture.csv"
_OTHERS = (0.05, 0.7, 0.25, 0.9)  # unlisted materials: share; mean, std, correlation of bands [1]
_GAP = 1e-6  # step of wavelength across which a spectrum is unknown [m]; libraries have 0.1 um
_STEPS = 64  # of the integral of Planck's law, besides the steps of the spectrum
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(3)
_TEMPERATURE = 300.0  # of the object, at which a noise is stated [K]
_MASK: Final = schema.Variable(("y", "x"), "bool", "1", "pixels of foil")
_FOIL: Final = 0.01  # of its ratio: weathered, 0.947 to 0.956 in all bands of `embedded_table`


def band_table(
    spectra: Mapping[str, xr.Dataset],
    bands: Bands,
    temperature: float = 300.0,
    *,
    minimum_coverage: float = MINIMUM_COVERAGE,
) -> xr.Dataset:
    r"""Planck-weighted band emissivities of materials.

    .. math:: e_m = \frac{\int_m e(\lambda) L(\lambda, T) d\lambda}{\int_m L(\lambda, T) d\lambda}

    over the band's top hat, linear between wavelengths at most 1 um apart. Where a spectrum has a
    gap, or ends, both integrals run over the covered part, whose share is `coverage`.

    KeyError, TypeError or ValueError if there is no spectrum or no band, a band is unknown or
    repeats, a spectrum is not as `schema` has it or holds NaN, the temperature is outside
    `bands.TEMPERATURE_RANGE`, or a spectrum covers less of a band than `minimum_coverage`.

    Parameters
    ----------
    spectra : mapping of str to Dataset
        Material to stage `spectrum` of `schema`: `emissivity` (wavelength) [1], wavelength [m].
    bands : mapping or iterable of Band or str
        Bands, or names of `bands.FILTERS`.
    temperature, minimum_coverage : float
        Temperature of the material [K]; share, in (0, 1], of the band's blackbody radiance that
        each spectrum must cover.

    Returns
    -------
    Dataset
        Stage `emissivity_table`: `emissivity` and `coverage` (material, band) [1]. Values of the
        libraries' spectra outside (0, 1] are averaged as they are.

    Examples
    --------
    >>> import xarray as xr
    >>> wavelength = np.arange(7, 16) * 1e-6  # [m]
    >>> values = 0.6 + 5e4 * abs(wavelength - 9e-6)
    >>> spectrum = xr.Dataset({"emissivity": ("wavelength", values)}, {"wavelength": wavelength})
    >>> table = band_table({"quartz": spectrum}, ["8-14", "9.5"])
    >>> table.emissivity.sel(material="quartz").values.round(3).tolist()
    [0.703, 0.625]
    """
    chosen = chosen_bands(bands)
    schema.require(spectra, Mapping, "spectra")
    if not spectra:
        raise ValueError("Empty spectra. Must hold at least one material.")
    if not 0 < _numbers.real_number("minimum_coverage", minimum_coverage) <= 1:
        raise ValueError(f"Invalid minimum_coverage {minimum_coverage}. Must lie in (0, 1].")
    # Average each spectrum over each band.
    whole = [float(band.radiance(temperature)) for band in chosen]
    rows = np.empty((2, len(spectra), len(chosen)))
    for row, (material, spectrum) in enumerate(spectra.items()):
        wavelength, emissivity = _values(spectrum, material)
        for column, band in enumerate(chosen):
            mean, covered = _average(wavelength, emissivity, band, temperature, whole[column])
            if covered < minimum_coverage:
                reach = f"{wavelength[0]:.4g} to {wavelength[-1]:.4g} m"
                raise ValueError(
                    f"Invalid coverage {covered:.4f} of band '{band.name}' by the spectrum of "
                    f"'{material}', {reach} without gaps. Must be at least {minimum_coverage}; "
                    "a lower minimum_coverage averages over the covered part."
                )
            rows[:, row, column] = mean, covered
    table = _dataset(list(spectra), [band.name for band in chosen], *rows)
    return table.assign_attrs(temperature=float(temperature), minimum_coverage=minimum_coverage)


def embedded_table() -> xr.Dataset:
    """Table of 25 common materials that comes with the package.

    Rounded averages at 300 K over `bands.FILTERS`, made by `band_table` from three public
    libraries, whose spectra are not redistributed: Baldridge et al. (2009,
    doi:10.1016/j.rse.2008.11.007), Meerdink et al. (2019, doi:10.1016/j.rse.2019.05.015) and
    Kotthaus et al. (2014, doi:10.1016/j.isprsjprs.2014.05.005).

    Returns
    -------
    Dataset
        Stage `emissivity_table`: `emissivity` and `coverage` (material, band) [1]; some metals and
        tiles were measured up to 12.5 um only. Coordinates `library` and `source` (material) name
        the library, and the file or sample in it.

    Examples
    --------
    >>> embedded_table().emissivity.sel(material="plate window glass", band="9.5").item()
    0.718
    """
    names = ["material", "library", "source"]
    _, rows = _packaged(_TABLE, [*names, *FILTERS, "coverage_8_14"])
    values = _text.numbers([(line, row[3:]) for line, row in rows], len(FILTERS) + 1, _TABLE)
    # The four filters end at 12.35 um: every spectrum of the table covers them whole.
    coverage = np.ones_like(values[:, :-1])
    coverage[:, list(FILTERS).index(CAMERA_BAND)] = values[:, -1]
    table = _dataset([row[0] for _, row in rows], list(FILTERS), values[:, :-1], coverage)
    notes = {name: ("material", [row[i] for _, row in rows]) for i, name in enumerate(names) if i}
    return table.assign_coords(notes).assign_attrs(temperature=300.0)


def library_mixture(bands: Iterable[str]) -> xr.Dataset:
    r"""Prior of the band emissivities of an unknown material.

    A mixture of normal distributions over the 993 spectra of the libraries of `embedded_table`,
    with a wide component for materials outside the libraries, one in twenty,

    .. math:: p(e) = \sum_k w_k N(e; \mu_k, C_k)

    Parameters
    ----------
    bands : iterable of str
        Names of `bands.FILTERS`, each once, in the order that is wanted; else a ValueError.

    Returns
    -------
    Dataset
        `weight` (component) [1], `mean` (component, band) [1], `covariance` (component, band,
        other) [1].

    Examples
    --------
    >>> mixture = library_mixture(["8-14", "9.5"])
    >>> float((mixture["weight"] * mixture["mean"].sel(band="9.5")).sum().round(2))
    0.87
    """
    names = [str(band) for band in bands]
    if not {*names} <= {*FILTERS} or len({*names}) < len(names):
        label = f"Invalid bands {names} of the library's emissivities. Must be of {[*FILTERS]}"
        rule = "each once, when the capture is made; or give a prior on the emissivities"
        raise ValueError(f"{label}, {rule}.")
    titles, rows = _packaged(_MIXTURE, ["weight", *FILTERS, f"{CAMERA_BAND} {CAMERA_BAND}"])
    count, values = len(FILTERS), _text.numbers(rows, len(titles), _MIXTURE)
    covariance = np.zeros((len(values), count, count))
    i, j = np.tril_indices(count)
    covariance[:, i, j] = covariance[:, j, i] = values[:, 1 + count :]
    places = [list(FILTERS).index(name) for name in names]
    share, mean, std, shared = _OTHERS
    # Of a material outside the libraries, all pairs of bands are correlated alike.
    wide = std**2 * (shared + (1.0 - shared) * np.eye(len(names)))
    means = values[:, 1 : 1 + count][:, places]
    weight = np.append(values[:, 0] / values[:, 0].sum() * (1.0 - share), share)
    chosen = covariance[:, places][:, :, places]
    variables = {
        "weight": ("component", weight),
        "mean": (("component", "band"), np.vstack([means, np.full(len(names), mean)])),
        "covariance": (("component", "band", "other"), np.concatenate([chosen, wide[np.newaxis]])),
    }
    return xr.Dataset(variables, {"band": names, "other": names})


def _packaged(name: str, columns: list[str]) -> tuple[list[str], list[_text.Row]]:
    """Titles and rows of a table that comes with the package; its first columns are named."""
    with resources.as_file(resources.files("dbthermal.emissivity").joinpath(name)) as path:
        (_, titles), *rows = _text.table_rows(_text.read_text(path), name, comment="#")
    if titles[: len(columns)] != columns:  # a filter was added
        raise ValueError(f"Invalid columns {titles} of '{name}'. Must begin with {columns}.")
    return titles, rows


def chosen_bands(bands: Bands) -> list[Band]:
    """Bands from bands, names of `bands.FILTERS` or the values of a mapping, each once."""
    if isinstance(bands, (str, Band)):
        bands = [bands]
    listed = list(bands.values()) if isinstance(bands, Mapping) else list(bands)
    for band in listed:
        schema.require(band, (str, Band), f"band {band!r:.60}")
    chosen = [get(band) if isinstance(band, str) else band for band in listed]
    names = [band.name for band in chosen]
    if not chosen or len(set(names)) < len(names):
        raise ValueError(f"Invalid bands {names}. Must be at least one, each once.")
    return chosen


def _values(spectrum: xr.Dataset, material: str) -> tuple[Array, Array]:
    """Wavelength [m] and emissivity [1] of a spectrum, all finite."""
    values = schema.check(spectrum, "spectrum", label=f"the spectrum of '{material}'")["emissivity"]
    emissivity = values.values.astype(np.float64)
    wavelength = values["wavelength"].values.astype(np.float64)
    lowest, highest = schema.EMISSIVITY_LIMITS
    if (bad := ~((emissivity >= lowest) & (emissivity <= highest))).any():
        label = f"{emissivity[bad][0]} of '{material}' at {wavelength[bad][0]} m"
        rule = f"Must lie in [{lowest}, {highest}]; it is a fraction, not per cent"
        raise ValueError(f"Invalid emissivity {label}. {rule}.")
    return wavelength, emissivity


def _average(
    wavelength: Array, emissivity: Array, band: Band, temperature: float, whole: float
) -> tuple[float, float]:
    """Planck-weighted mean [1] of a piecewise linear spectrum by Gauss's rule, and its coverage."""
    lower, upper = max(band.lower, float(wavelength[0])), min(band.upper, float(wavelength[-1]))
    if upper <= lower:
        return np.nan, 0.0
    # Corners of the spectrum are knots: Gauss's rule needs a smooth integrand between them.
    nodes_inside = wavelength[(wavelength > lower) & (wavelength < upper)]
    knots = np.union1d(np.linspace(lower, upper, _STEPS + 1), nodes_inside)
    half = 0.5 * np.diff(knots)[:, np.newaxis]
    nodes = knots[:-1, np.newaxis] + half * (1.0 + _NODES)
    weights = half * _WEIGHTS * planck.spectral_radiance(nodes, temperature)
    # A gap of the spectrum has no weight, and reduces the coverage.
    gap = np.diff(wavelength) > (1.0 + 1e-9) * _GAP
    weights *= ~gap[np.searchsorted(wavelength, nodes[:, 1:2]) - 1]
    covered = float(np.sum(weights))
    mean = float(np.sum(weights * np.interp(nodes, wavelength, emissivity))) / (covered or np.nan)
    return mean, round(covered / whole, 12)


def _dataset(materials: list[str], names: list[str], values: Array, coverage: Array) -> xr.Dataset:
    """Table in the stage's form."""
    variables = schema.variables("emissivity_table", {"emissivity": values, "coverage": coverage})
    return xr.Dataset(variables, {"material": materials, "band": names})


def filter_noise(netd: float, bands: Bands) -> xr.DataArray:
    r"""Noise (band) [K] of a camera behind filters, from its noise without one.

    The noise in counts is the camera's own and does not change, a kelvin at 300 K gives fewer:

    .. math:: s_m = s_1 \frac{dB_1 / dT}{dB_m / dT}

    with the first of the bands as the camera's own. A filter's emission and losses are left out.

    Parameters
    ----------
    netd : float
        Noise-equivalent temperature difference in the first band [K].
    bands : mapping or iterable of Band or str
        Bands, or names of `bands.FILTERS`, each once; the first is the one that `netd` belongs to.
        TypeError or ValueError for other bands, or an `netd` that is not in (0, 5] K.

    Examples
    --------
    >>> filter_noise(0.04, ["8-14", "9.5", "10.6"]).values.round(3).tolist()  # [K]
    [0.04, 0.398, 0.15]
    """
    chosen = chosen_bands(bands)
    netd = _numbers.real_number("noise [K]", netd, _numbers.NETD)
    slopes = np.array([float(band.slope(_TEMPERATURE)) for band in chosen])
    noise, axes = netd * slopes[0] / slopes, {"band": [band.name for band in chosen]}
    attrs = {"units": "K", "long_name": "noise-equivalent temperature difference"}
    return xr.DataArray(noise, axes, "band", "noise", attrs)


@dataclass(frozen=True)
class Colour:
    r"""Changes of a background's signals that are g times those in the reference band.

    About a level :math:`T_0` they are those of a gray background, with emissivities :math:`e / s`,
    in signals :math:`T_0 + (z - T_0) / s`, of the scales :math:`s = e + g (1 - e)`.
    """

    ratio: Array  # (band) [1]
    std: Array  # relative (band) [1]
    level: float | None  # at which all bands show the same [K]; where it rests if not stated
    level_std: float  # [K]

    @np.errstate(divide="ignore", invalid="ignore")  # in the reference band, which is not scaled
    def scale(self, result: xr.Dataset, before: Array | float = 1.0) -> Array:
        """Scales s (band, y, x), by a result of other scales; 1 where no ratio is valid."""
        place = [*result["band"].values].index(result.attrs["reference_band"])
        value, g = result["emissivity"].values[place], self.ratio[:, np.newaxis, np.newaxis]
        # With the ratio r = g kappa the null combination is u(x) (e_2 - r e_1) / (1 - r). The slope
        # of z_1 over it is e_1 (1 - r) / (e_2 - r e_1), e_2 = 1 - (r / g) (1 - e_1): solve for e_1.
        ratio = result["reflection_ratio"].values * before
        slope = value / (before - ratio)
        first = slope * (1.0 - ratio / g) / (1.0 - slope * ratio * (1.0 / g - 1.0))
        mirrored = ratio / g * (1.0 - first)
        valid = (result["status"].values & np.uint32(schema.UNMEASURED)) == 0
        valid = valid & (mirrored > 0.0) & (mirrored < 1.0)
        return np.where(valid, 1.0 + (g - 1.0) * mirrored, 1.0)

    def deviations(self, value: Array, stds: Array, contrast: Array) -> Array:
        """Deviations (band, y, x) [K] of scaled signals by errors of s, and of the level."""
        g = self.ratio[:, np.newaxis, np.newaxis]
        of_scale = contrast * np.nan_to_num(stds) * g / (1.0 - value + g * value)
        return np.asarray((g - 1.0) / g * np.hypot(of_scale, (1.0 - value) * self.level_std))


def colour_of(
    stated: xr.Dataset | Sequence[float], bands: list[str], reference: int, *level: Any
) -> Colour:
    """Colour of a stated ratio, relative to the reference band; else a TypeError or ValueError."""
    if isinstance(stated, xr.Dataset):
        names = ("background_ratio", "background_ratio_std")
        if lacking := [name for name in names if name not in stated]:
            raise ValueError(f"Missing '{lacking[0]}' in the background_ratio. Must have {names}.")
        ratio, std = (schema.band_values(stated[name], bands, name, "1") for name in names)
    else:
        if len(bands) != 2:
            rule = "Must be a Dataset of all bands"
            raise ValueError(f"Invalid background_ratio {stated} of bands {bands}. {rule}.")
        pair = _numbers.real_numbers("background_ratio and its deviation", stated, shape=(2,))
        ratio, std = np.array([[1.0, pair[0]], [0.0, pair[1]]])
    ratio = _numbers.real_numbers("background_ratio", ratio, _numbers.POSITIVE)
    std = _numbers.real_numbers("background_ratio_std", std, (0.0, schema.LARGEST)) / ratio
    relative = np.hypot(std, std[reference]) * (np.arange(len(bands)) != reference)
    return Colour(ratio / ratio[reference], relative, *level)


def background_ratio(result: xr.Dataset, mask: xr.DataArray) -> xr.Dataset:
    r"""Ratio of what is mirrored in each band to that in the reference band, seen in foil.

    Crumpled aluminium foil reflects all bands alike, from everywhere: its reflection ratio is g.
    TypeError or ValueError if the mask is not as described, or no pixel has a reflection ratio.

    Parameters
    ----------
    result : Dataset
        From `solve` or `separate`, of a capture with foil in it.
    mask : DataArray
        Pixels (y, x) of the foil, boolean; where cameras stand apart, away from its edges.

    Returns
    -------
    Dataset
        `background_ratio` (band) [1], mean over the pixels, and `background_ratio_std`, deviation
        of one pixel and 1 % of the foil itself. For `separation.separate`.

    Examples
    --------
    >>> import numpy as np
    >>> from dbthermal import separation, simulation
    >>> rig, rng = simulation.Rig(), np.random.default_rng(1)
    >>> foil = xr.DataArray([0.05, 0.05], dims="band", coords={"band": list(rig.bands)})
    >>> scene = simulation.walkers(np.arange(200) / 10, (4, 6), foil, rng)
    >>> alone = separation.solve(simulation.observe(scene, rig.response(), rng), rig.response())
    >>> ratio = background_ratio(alone, xr.DataArray(np.ones((4, 6), bool), dims=("y", "x")))
    >>> ratio["background_ratio"].values.round(1).tolist()
    [1.0, 1.0]
    """
    names = ("reflection_ratio", "reflection_ratio_std")
    schema.check(result, "separated", names, "the result")
    schema.check_variable(mask, _MASK, "the mask of foil")
    pixels = schema.laid_on(mask, result, "the mask", "the result").values
    ratio, std = (result[name].values[:, pixels].astype(np.float64) for name in names)
    seen = np.isfinite(ratio).all(axis=0) & np.isfinite(std).all(axis=0)
    if not seen.any():
        raise ValueError("Missing reflection ratio of the foil. Something must move in it.")
    # A pixel of the reference band has no deviation, and every pixel of it the same ratio.
    weights = np.where(std > 0.0, 1.0 / np.maximum(std, 1e-9) ** 2, 1.0)[:, seen]
    mean = np.average(ratio[:, seen], axis=1, weights=weights)
    # Pixels may err together: neither deviations nor scatter are divided by their number.
    square = (ratio[:, seen] - mean[:, np.newaxis]) ** 2
    scatter = np.average(square, axis=1, weights=weights)
    variance = np.maximum(1.0 / weights.mean(axis=1), scatter)
    bands, first = result["band"].values, str(result.attrs["reference_band"])
    variance = np.where(bands == first, 0.0, variance + (_FOIL * mean) ** 2)
    values = {"background_ratio": mean, "background_ratio_std": np.sqrt(variance)}
    variables = {name: ("band", array, {"units": "1"}) for name, array in values.items()}
    return xr.Dataset(variables, {"band": bands})
