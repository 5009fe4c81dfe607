"""Colour of what surfaces mirror: ratio of its changes in the bands, as of a sky."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import xarray as xr

from dbthermal import _numbers, planck, schema
from dbthermal._arrays import Array
from dbthermal._coordinates import laid_on

_FOIL: Final = 0.01  # of its ratio: weathered, 0.947 to 0.956 in all bands of `embedded_table`


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
        """Scales s (band, y, x) by what is found with others; 1 where nothing is known."""
        place = [*result["band"].values].index(result.attrs["reference_band"])
        value, g = result["emissivity"].values[place], self.ratio[:, np.newaxis, np.newaxis]
        # With the ratio r = g kappa the null combination is u(x) (e_2 - r e_1) / (1 - r). The slope
        # of z_1 over it is e_1 (1 - r) / (e_2 - r e_1), e_2 = 1 - (r / g) (1 - e_1): solve for e_1.
        ratio = result["reflection_ratio"].values * before
        slope = value / (before - ratio)
        first = slope * (1.0 - ratio / g) / (1.0 - slope * ratio * (1.0 / g - 1.0))
        mirrored = ratio / g * (1.0 - first)
        known = (result["status"].values & np.uint32(schema.UNMEASURED)) == 0
        known = known & (mirrored > 0.0) & (mirrored < 1.0)
        return np.where(known, 1.0 + (g - 1.0) * mirrored, 1.0)

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
    ratio = planck.require_positive("background_ratio", ratio)
    std = _numbers.real_numbers("background_ratio_std", std, (0.0, schema.LARGEST)) / ratio
    relative = np.hypot(std, std[reference]) * (np.arange(len(bands)) != reference)
    return Colour(ratio / ratio[reference], relative, *level)


def background_ratio(result: xr.Dataset, mask: xr.DataArray) -> xr.Dataset:
    r"""Ratio of what is mirrored in each band to that in the reference band, seen in foil.

    Crumpled aluminium foil reflects all bands alike, from everywhere: its reflection ratio is g.


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

    Raises
    ------
    TypeError, ValueError
        If the mask is not as described, or no pixel of it has a reflection ratio.


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
    dims, dtype = getattr(mask, "dims", None), getattr(mask, "dtype", None)
    if dims != ("y", "x") or getattr(dtype, "kind", "") != "b":
        raise TypeError("Invalid mask of foil. Must be a DataArray of dims ('y', 'x'), boolean.")
    pixels = laid_on(mask, result, "the mask", "the result").values
    ratio, std = (result[name].values[:, pixels].astype(np.float64) for name in names)
    seen = np.isfinite(ratio).all(axis=0) & np.isfinite(std).all(axis=0)
    if not seen.any():
        raise ValueError("Missing reflection ratio of the foil. Something must move in it.")
    weights = np.where(std > 0.0, 1.0 / np.maximum(std, 1e-9) ** 2, 1.0)[:, seen]
    mean = np.average(ratio[:, seen], axis=1, weights=weights)
    square = (ratio[:, seen] - mean[:, np.newaxis]) ** 2
    scatter = np.average(square, axis=1, weights=weights)
    variance = np.maximum(1.0 / weights.mean(axis=1), scatter)
    bands, first = result["band"].values, str(result.attrs["reference_band"])
    variance = np.where(bands == first, 0.0, variance + (_FOIL * mean) ** 2)
    values = {"background_ratio": mean, "background_ratio_std": np.sqrt(variance)}
    variables = {name: ("band", array, {"units": "1"}) for name, array in values.items()}
    return xr.Dataset(variables, {"band": bands})
