"""Choice of a filter by condition number and noise, as the paper chooses its own.

By the supplement of Narayanan et al. (2026), doi:10.48550/arXiv.2509.11334.
"""

import numpy as np
import xarray as xr

from dbthermal import _numbers, mixing, schema
from dbthermal._numbers import POSITIVE, real_numbers
from dbthermal.emissivity import CAMERA_BAND

_NUMBERS = schema.Variable(("material", "first", "second"), "float64", "1", "condition number")


def condition_numbers(table: xr.Dataset) -> xr.DataArray:
    """Condition number (material, first, second) [1] of the mixing matrix of each pair of bands.

    Of a table, stage `emissivity_table`, of at least two bands, its emissivities NaN or within
    `schema.EMISSIVITY_LIMITS`, or a ValueError. Symmetric; infinite on the diagonal and where the
    two emissivities are equal. See `mixing.condition_number`.
    """
    values = schema.check(table, "emissivity_table")["emissivity"]
    tabulated = values.values[~np.isnan(values.values)]  # averages of measured spectra may exceed 1
    _numbers.real_numbers("emissivity of the table", tabulated, within=schema.EMISSIVITY_LIMITS)
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
    """Condition number of each pair of bands, over the materials, of `condition_numbers`.

    `median` and `mean` (first, second) [1], and `finite` (first, second), the number of materials
    in the mean. A gray material counts in the median as infinite and not in the mean, which a few
    nearly gray ones govern: choose by the median. Both are infinite where every material is gray,
    as on the diagonal.
    """
    schema.check_variable(numbers, _NUMBERS, "the condition numbers")
    finite = numbers.copy(data=np.isfinite(numbers.values))
    mean = numbers.where(finite).mean("material").fillna(np.inf)
    median, count = numbers.median("material", skipna=False), finite.sum("material")
    statistics = {
        "median": median.assign_attrs(long_name="condition number, median"),
        "mean": mean.assign_attrs(long_name="its finite mean"),
        "finite": count.assign_attrs(long_name="materials with a finite condition number"),
    }
    return xr.Dataset({name: it.assign_attrs(units="1") for name, it in statistics.items()})


def rank_filters(
    table: xr.Dataset, noise: xr.DataArray, *, beside: str = CAMERA_BAND
) -> xr.Dataset:
    """Filters to set beside a band, best conditioned first, by two criteria.

    The first criterion is the paper's, the lowest condition number (its section 5 says highest, a
    slip). The second is the standard deviation of the object temperature from one frame, which
    includes the noise of a narrow filter, (band) [K] as from `filter_noise`. Both are medians over
    the materials of a table, stage `emissivity_table`.

    TypeError or ValueError if the table is not as for `condition_numbers` or has no band `beside`,
    the camera's own, and another, or the noise lacks a band, is in another unit, or is not finite
    and positive.

    The result has, each (band) in the order of the first criterion: `condition_number` [1];
    `condition_number_mean` [1], over the materials where it is finite; `object_temperature_std`
    [K]; `noise` [K]. Attributes `lowest_condition_number` and `lowest_std` name the filter of each
    criterion.
    """
    std = _single_frame_std(table, noise, beside).median("material", skipna=False)
    # Both criteria over the materials, sorted by the first.
    pairs = pair_summary(condition_numbers(table)).sel(first=beside, drop=True)
    pairs = pairs.rename(second="band").sel(band=std["band"])
    columns = {"condition_number": pairs["median"], "condition_number_mean": pairs["mean"]}
    columns["object_temperature_std"] = std.assign_attrs(units="K", long_name="median of its std")
    columns["noise"] = noise.sel(band=std["band"]).assign_attrs(units="K")
    result = xr.Dataset(columns).sortby("condition_number")
    names = [str(name) for name in result["band"].values]
    return result.assign_attrs(
        beside=beside,
        lowest_condition_number=names[0],
        lowest_std=names[int(np.argmin(result["object_temperature_std"].values))],
    )


def _single_frame_std(table: xr.Dataset, noise: xr.DataArray, camera_band: str) -> xr.DataArray:
    r"""Standard deviation [K] of the object temperature from one frame (material, band).

    For each band m beside band 1, emissivities known, in the linear approximation,
    :math:`\mathrm{var}(x) = [(1 - e_m)^2 s_1^2 + (1 - e_1)^2 s_m^2] / (e_1 - e_m)^2`; infinite for
    equal emissivities.
    """
    values = schema.check(table, "emissivity_table")["emissivity"]
    names = [str(name) for name in values["band"].values]
    if camera_band not in names or len(names) < 2:
        raise ValueError(f"Invalid bands {names}. Must hold '{camera_band}' and at least one more.")
    std = real_numbers("noise [K]", schema.band_values(noise, names, "the noise", "K"), POSITIVE)
    filters = [name for name in names if name != camera_band]
    camera, filtered = (values.sel(band=it).values for it in ([camera_band], filters))
    noises = std[names.index(camera_band)], std[[names.index(name) for name in filters]]
    error = np.hypot((1 - filtered) * noises[0], (1 - camera) * noises[1])
    contrast = np.abs(camera - filtered)
    return xr.DataArray(
        np.divide(error, contrast, out=np.full_like(error, np.inf), where=contrast > 0),
        coords={"material": values["material"].values, "band": filters},
        dims=("material", "band"),
        name="object_temperature_std",
        attrs={"units": "K", "long_name": "standard deviation of the object temperature"},
    )
