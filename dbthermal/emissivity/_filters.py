"""Which two bands tell emission from reflection best: condition numbers, noise, choice of a filter.

The criteria are those of the supplement of Narayanan et al. (2026),
doi:10.48550/arXiv.2509.11334, and the statistical one that its remark on the noise asks for.
"""

from collections.abc import Iterable, Mapping
from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import mixing, planck, schema
from dbthermal.bands import Band
from dbthermal.emissivity._table import require_bands

Array = npt.NDArray[np.float64]

CAMERA_BAND: Final = "8-14"
"""Name of the band of the camera without a filter."""


def condition_numbers(table: xr.Dataset) -> xr.DataArray:
    """
    Condition number of the mixing matrix for each material and pair of bands.

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
        If the table is not as `schema` has it or holds a single band.
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
    """
    Condition number of each pair of bands, over the materials.

    Parameters
    ----------
    numbers : DataArray
        Condition numbers (material, first, second) [1], from `condition_numbers`.

    Returns
    -------
    Dataset
        `median` and `mean` (first, second) [1], and `finite` (first, second), the number of
        materials in the mean. A gray material counts in the median as infinite and not in the
        mean, which a few nearly gray ones govern: the median is the one to choose by. Both are
        infinite where every material is gray, as on the diagonal.
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


def filter_noise(
    netd: float, bands: Mapping[str, Band] | Iterable[Band | str], temperature: float = 300.0
) -> xr.DataArray:
    r"""
    Noise of a camera behind filters, from its noise without one.

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
        Temperature at which the noise is meant [K].

    Returns
    -------
    DataArray
        Noise (band) [K].

    Raises
    ------
    KeyError
        If a band's name is unknown.
    ValueError
        If there is no band, a band repeats, or a number is not finite and positive.
    """
    chosen = require_bands(bands)
    netd = float(planck.require_positive("netd [K]", netd))
    slopes = np.array([float(band.slope(temperature)) for band in chosen])
    return xr.DataArray(
        netd * slopes[0] / slopes,
        coords={"band": [band.name for band in chosen]},
        dims="band",
        name="noise",
        attrs={"units": "K", "long_name": "noise-equivalent temperature difference"},
    )


def single_frame_std(
    table: xr.Dataset, noise: xr.DataArray, *, beside: str = CAMERA_BAND
) -> xr.DataArray:
    r"""
    Standard deviation of the object temperature from one frame, emissivities known.

    For each band m beside band 1, in the linear approximation,

    .. math:: \mathrm{var}(x) = \frac{(1 - e_m)^2 s_1^2 + (1 - e_1)^2 s_m^2}{(e_1 - e_m)^2}

    Parameters
    ----------
    table : Dataset
        Stage `emissivity_table`.
    noise : DataArray
        Noise (band) [K] of every band of the table, such as from `filter_noise`.
    beside : str
        Name of band 1.

    Returns
    -------
    DataArray
        Standard deviation (material, band) [K] for the bands but `beside`; infinite where the two
        emissivities are equal.

    Raises
    ------
    TypeError, ValueError
        If the table is not as `schema` has it, lacks the band `beside` or has no other, or the
        noise lacks a band, is in another unit, or is not finite and positive.
    """
    values = schema.check(table, "emissivity_table")["emissivity"]
    names = [str(name) for name in values["band"].values]
    if beside not in names or len(names) < 2:
        raise ValueError(f"Invalid bands {names}. Must hold '{beside}' and at least one more.")
    std = _noise_of(noise, names)
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


def choose_filter(
    table: xr.Dataset, noise: xr.DataArray, *, beside: str = CAMERA_BAND
) -> xr.Dataset:
    """
    Filters to set beside a band, best conditioned first, by two criteria.

    The paper takes the filter of the lowest condition number (its section 5 says highest, a slip;
    its supplement says lowest) and notes the trade-off with the noise that a narrow filter brings.
    The second criterion settles that trade-off: the standard deviation that the object temperature
    has from one frame. Both are medians over the materials, for a few nearly gray materials govern
    any mean.

    Parameters
    ----------
    table : Dataset
        Stage `emissivity_table`.
    noise : DataArray
        Noise (band) [K] of every band of the table, such as from `filter_noise`.
    beside : str
        Name of the band that is given.

    Returns
    -------
    Dataset
        Over band, sorted by the first: `condition_number` [1]; `condition_number_mean` [1], over
        the materials where it is finite; `object_temperature_std` [K]; `noise` [K]. Attributes
        `lowest_condition_number` and `lowest_std` name the filter of each criterion.

    Raises
    ------
    TypeError, ValueError
        As `single_frame_std`.
    """
    std = single_frame_std(table, noise, beside=beside).median("material", skipna=False)
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


def _noise_of(noise: xr.DataArray, names: list[str]) -> Array:
    """Noise [K] of the named bands."""
    if noise.dims != ("band",) or noise.attrs.get("units", "K") != "K":
        raise ValueError(
            f"Invalid noise {noise.dims} [{noise.attrs.get('units')}]. Must be (band,) [K]."
        )
    places = schema.band_positions(noise, names, "the noise")
    return planck.require_positive("noise [K]", noise.values[places])
